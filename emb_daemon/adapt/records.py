"""What adaptation keeps between ticks: its phases, how a training can end, and the records of both. SI units, degC."""

import numpy as np

from emb_daemon.jit import fields

#: Phases of a corner's adaptation: nothing; motion was asked for; motion came unasked; a training is being evaluated.
IDLE, ASKING, WATCHING, EVALUATING = range(4)

#: How a training ended. Before NOT_CONVERGED it was aborted, from there on its evaluation was rejected.
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

#: Samples of one training: what the path models read of a SAMPLE, and the stiffness factor that held then.
TRAINING = np.dtype(
    [
        *fields("f8", "dt angle speed current_q wheel_speed wheel_pulse caliper factor"),
        *fields("?", "has_current has_thermocouple has_wheel_speed has_wheel_pulse"),
    ],
    align=True,
)

#: Limits that the tick reads, from the calibration; see `calibration.types.Adaptation` for their meaning. ``estimated``:
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

#: What an `Evaluation` hands to the tick beside PARAMETERS.
FOUND = ("contact_angle", "contact_sigma", "torque_error", "torque_error_sigma", "inertia_error", "inertia_sigma")

#: One corner's adaptation as it runs. ``evaluation_wanted`` asks whoever computes for an evaluation of the first
#: ``training_rows`` of ``rows``, told apart by ``generation``; ``evaluation_ready`` says that it is there: how it ended, and
#: if it was accepted what it `FOUND`, the contact angle's standard deviation for the learned curve. ``ended`` asks for the
#: outcome to be logged and kept. ``force`` is the torque path's without the torque's offset, smoothed; ``holding`` whether the
#: corner surely clamps with its parking force at ``time_ns``; ``pulse`` the wheel's count since which the car stood.
#: ``snapshot_wanted`` asks for what the estimator knows to be kept, last at ``snapshot_ns``.
ADAPTER = np.dtype(
    [
        *fields("i8", "phase result outcome"),
        *fields("?", "asked tried started was_low was_high"),
        *fields("f8", "power_on_angle parked_time phase_time still_time still_angle tail_time force pulse"),
        ("parked", "?"),
        ("snapshot_ns", "i8"),
        *fields("?", "snapshot_wanted holding"),
        *fields("i8", "rows training_rows generation"),
        *fields("?", "evaluation_wanted evaluation_ready"),
        ("evaluation", "i8"),
        *((name, "f8") for name in FOUND),
        ("ended", "?"),
        *fields("f8", "ambient rise factor_sigma"),
        ("time_ns", "i8"),
    ],
    align=True,
)

#: Samples that one training may have, and time between the end of training and the moment at which its outcome takes
#: effect: a fixed number of samples, so that a replay does what the daemon did. At 4 ms.
TRAINING_SAMPLES = 15_000
EVALUATION_SAMPLES = 750
CAPACITY = TRAINING_SAMPLES + EVALUATION_SAMPLES


def to_limits(calibration) -> np.void:
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
