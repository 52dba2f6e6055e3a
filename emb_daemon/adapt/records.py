"""Records of park brake adaptation: what is collected, within which limits, what is learned. SI units, degC."""

import numpy as np

from emb_daemon.estimator.records import CURVE_TERMS

#: Phases of a corner's adaptation.
IDLE, ASKING, WATCHING, EVALUATING = range(4)

#: Result of the last training (wire: Result).
NO_RESULT, RESULT_ACCEPTED, RESULT_REJECTED, RESULT_ABORTED = range(4)

#: Why training came to nothing. Up to NOT_CONVERGED it was aborted, from there on its result was rejected.
(ACCEPTED, BRAKE_REQUESTED, PARK_BRAKE_LEFT, VEHICLE_MOVED, BAD_INPUT, NO_ANSWER, TOO_LONG, NOT_IN_TIME, TOO_WARM,
 NOT_CONVERGED, TOO_FEW, NOT_COVERED, NOT_EXCITED, RESIDUAL, NOT_PHYSICAL, CHANGED_TOO_MUCH, TOO_UNCERTAIN,
 PAIRS_DISAGREE) = range(18)  # fmt: skip
VERDICTS = (
    "accepted", "brake requested", "park brake released", "vehicle moved", "input lost or implausible",
    "training motion did not come", "training motion took too long", "evaluation was not ready in time",
    "pads too warm or too cold", "fit did not converge", "too few samples", "force range not covered",
    "a force range not excited in both directions", "residual too large", "outside physical bounds",
    "too far from the last accepted values", "too uncertain", "pairs of passes disagree with the model",
)  # fmt: skip

#: Samples of one training: what the path models read of a SAMPLE, and the stiffness factor that held then.
TRAINING = np.dtype(
    [
        ("dt", "f8"),
        ("angle", "f8"),
        ("speed", "f8"),
        ("current_q", "f8"),
        ("wheel_speed", "f8"),
        ("wheel_pulse", "f8"),
        ("caliper", "f8"),
        ("factor", "f8"),
        ("has_current", "?"),
        ("has_thermocouple", "?"),
        ("has_wheel_speed", "?"),
        ("has_wheel_pulse", "?"),
    ],
    align=True,
)

#: Limits of adaptation, from the calibration; see `calibration.types.Adaptation` for their meaning.
LIMITS = np.dtype(
    [
        ("enabled", "?"),
        ("minimum_ambient", "f8"),
        ("maximum_ambient", "f8"),
        ("maximum_rise", "f8"),
        ("high_force", "f8"),
        ("dither_amplitude", "f8"),
        ("dither_frequency", "f8"),
        ("settling_time", "f8"),
        ("answer_time", "f8"),
        ("longest_training", "f8"),
        ("coverage", "f8"),
        ("samples_per_range", "i8"),
        ("residual_ratio", "f8"),
        ("curve_change", "f8"),
        ("clearance_change", "f8"),
        ("friction_change", "f8"),
        ("maximum_friction_share", "f8"),
        ("maximum_sigma", "f8"),
        ("pairs_difference", "f8"),
        ("torque_constant_sigma", "f8"),
        ("dynamics_sigma", "f8"),
    ],
    align=True,
)

#: What one training teaches. ``verdict`` is ACCEPTED or why not; the figures after ``clearance`` are its evidence.
LEARNED = np.dtype(
    [
        ("verdict", "i8"),
        ("contact_angle", "f8"),
        ("contact_sigma", "f8"),
        ("contact_given_curve_sigma", "f8"),
        ("curve", "f8", (CURVE_TERMS,)),
        ("load_friction", "f8"),
        ("offset_friction", "f8"),
        ("presliding_angle", "f8"),
        ("stiffness_sigma", "f8"),
        ("stiffness_relative_sigma", "f8"),
        ("clearance", "f8"),
        ("samples", "i8"),
        ("iterations", "i8"),
        ("residual", "f8"),
        ("residual_ratio", "f8"),
        ("correlation", "f8"),
        ("top_force", "f8"),
        ("force_sigma", "f8"),
        ("pairs_difference", "f8"),
        ("curve_change", "f8"),
    ],
    align=True,
)

#: One corner's adaptation as it runs. ``wanted`` asks whoever computes for an evaluation of the first ``training_rows`` of
#: ``rows``, told apart by ``generation``; ``ready`` says that ``learned`` holds it; ``settled`` asks for the outcome to be
#: logged and kept. ``force`` is the torque path's, smoothed.
ADAPTER = np.dtype(
    [
        ("phase", "i8"),
        ("result", "i8"),
        ("verdict", "i8"),
        ("asked", "?"),
        ("tried", "?"),
        ("started", "?"),
        ("was_low", "?"),
        ("was_high", "?"),
        ("power_on_angle", "f8"),
        ("parked_time", "f8"),
        ("phase_time", "f8"),
        ("still_time", "f8"),
        ("still_angle", "f8"),
        ("tail_time", "f8"),
        ("force", "f8"),
        ("rows", "i8"),
        ("training_rows", "i8"),
        ("generation", "i8"),
        ("wanted", "?"),
        ("ready", "?"),
        ("settled", "?"),
        ("ambient", "f8"),
        ("rise", "f8"),
        ("time_ns", "i8"),
        ("learned", LEARNED),
    ],
    align=True,
)

#: Samples that one training may have, and time between the end of training and the moment at which its outcome takes
#: effect: a fixed number of samples, so that a replay does what the daemon did. At 4 ms.
TRAINING_SAMPLES = 15_000
EVALUATION_SAMPLES = 750
CAPACITY = TRAINING_SAMPLES + EVALUATION_SAMPLES
