"""State of adaptation between ticks: its phases, the outcomes of a training, and their records. SI units, degC."""

import numpy as np

from emb_daemon.calibration.types import Calibration
from emb_daemon.estimator.records import STATE
from emb_daemon.jit import fields

#: Phases of a corner's adaptation: none; motion is requested; motion without request; a training is being evaluated.
IDLE, ASKING, WATCHING, EVALUATING = range(4)

#: Outcomes of a training. Those before NOT_CONVERGED aborted it; from NOT_CONVERGED on its evaluation was rejected.
(ACCEPTED, BRAKE_REQUESTED, PARK_BRAKE_LEFT, VEHICLE_MOVED, BAD_INPUT, NO_ANSWER, TOO_LONG, NOT_IN_TIME, AMBIENT,
 OTHERS_NOT_HOLDING, NOT_CONVERGED, TOO_FEW, NOT_COVERED, NOT_EXCITED, RESIDUAL, OUT_OF_BOUNDS, TOO_UNCERTAIN,
 PAIRS_DISAGREE) = range(18)  # fmt: skip
OUTCOMES = (
    "accepted", "brake requested", "park brake released", "vehicle moved", "input lost or implausible",
    "training motion did not come", "training motion took too long", "evaluation was not ready in time",
    "too warm or too cold outside", "another corner does not hold the car", "fit did not converge", "too few samples",
    "force range not covered",
    "a force range not excited in both directions", "residual too large", "outside the bounds of this brake",
    "too uncertain", "pairs of passes disagree with the model",
)  # fmt: skip

#: Samples of one training: the fields of SAMPLE that the path models read, and at that time the stiffness factor and the share
#: by which the motor's heat has changed its torque (``faded``), as far as driving had shown it before the training.
TRAINING = np.dtype(
    [
        *fields("f8", "dt angle speed current_q wheel_speed wheel_pulse caliper factor faded"),
        *fields("?", "has_current has_thermocouple has_wheel_speed has_wheel_pulse"),
    ],
    align=True,
)

#: Limits that the tick reads, from the calibration; see `calibration.types.AdaptationLimits` for their meaning. ``estimated``:
#: whether this process estimates the corner at all.
LIMITS = np.dtype(
    [
        *fields("?", "estimated enabled"),
        *fields(
            "f8",
            "minimum_ambient maximum_ambient parking_force low_force high_force dither_amplitude dither_frequency "
            "settling_time answer_time longest_training coverage",
        ),
    ],
    align=True,
)

#: Results of an `Evaluation` that the tick gets in addition to PARAMETERS.
FOUND = ("contact_angle", "contact_sigma", "torque_error", "torque_error_sigma", "inertia_error", "inertia_sigma")

#: What driving had shown of torque constant and inertia before a training, as shares of the calibration's: errors, their
#: variances and their covariance.
DRIVEN = ("driven_gain", "driven_inertia", "driven_gain_variance", "driven_inertia_variance", "driven_covariance")

#: State of one corner's adaptation. ``evaluation_wanted`` requests an evaluation of the first ``training_rows`` of ``rows``;
#: ``generation`` identifies it. ``evaluation_ready``: the result is there, that is its outcome and, if it was accepted, what
#: it `FOUND` (the contact angle's standard deviation is for the learned curve). ``ended`` requests that the outcome is logged
#: and stored. ``force``: that of the torque path without the torque's offset, smoothed. ``holding``: whether the corner
#: certainly clamps with its parking force at ``time_ns``. ``rewinds``: see STATE, at the last estimate. ``driven``: whether
#: a stop had been seen before the training. ``pulse``: count of
#: the wheel's pulses when the car came to a stand. ``snapshot_wanted`` requests a snapshot of the estimator; the last one was
#: at ``snapshot_ns``.
ADAPTER = np.dtype(
    [
        *fields("i8", "phase result outcome"),
        *fields("?", "asked tried started was_low was_high driven"),
        *fields("f8", "power_on_angle parked_time phase_time still_time still_angle tail_time force pulse fade housing_fade"),
        ("parked", "?"),
        ("snapshot_ns", "i8"),
        *fields("?", "snapshot_wanted holding"),
        *fields("i8", "rows training_rows generation rewinds"),
        *fields("?", "evaluation_wanted evaluation_ready"),
        ("evaluation", "i8"),
        *((name, "f8") for name in (*DRIVEN, *FOUND)),
        ("ended", "?"),
        *fields("f8", "ambient rise factor_sigma"),
        ("time_ns", "i8"),
    ],
    align=True,
)

#: What a calibration's effects remember.
REMEMBERED = STATE["effects"]

#: Largest number of samples of one training, and number of samples from the end of a training until its outcome takes effect,
#: at 4 ms. The latter is fixed, so that a replay does the same as the daemon.
TRAINING_SAMPLES = 15_000
EVALUATION_SAMPLES = 750
CAPACITY = TRAINING_SAMPLES + EVALUATION_SAMPLES


def to_limits(calibration: Calibration) -> np.void:
    """LIMITS record of a `Calibration`."""
    a, limits = calibration.adaptation, np.zeros(1, LIMITS)[0]
    limits["estimated"], limits["enabled"] = True, a.enabled
    limits["minimum_ambient"], limits["maximum_ambient"] = a.minimum_ambient_C, a.maximum_ambient_C
    limits["parking_force"], limits["low_force"] = a.parking_force_N, a.low_force_N
    limits["high_force"], limits["coverage"] = calibration.training_force_N, a.coverage
    limits["dither_amplitude"], limits["dither_frequency"] = a.dither_amplitude_rad, a.dither_frequency_Hz
    limits["settling_time"], limits["answer_time"] = a.settling_time_s, a.answer_time_s
    limits["longest_training"] = a.longest_training_s
    return limits
