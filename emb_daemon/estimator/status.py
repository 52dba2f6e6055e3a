"""What the estimator says of itself: one table of named facts, from which reasons, source, mode and Status follow.

The order counts: the torque alone goes on without stiffness, whatever was said of the torque while both were compared.

docs/safety.md's table is generated from `TABLE`.
"""

from typing import NamedTuple

import numpy as np

from emb_daemon.jit import Record, njit
from emb_daemon.wire.contract import (
    CONTACT_UNCERTAIN,
    FUSED,
    INVALID,
    OUT_OF_RANGE,
    OUTSIDE_RANGE,
    PATHS_DISAGREE,
    STIFFNESS_ONLY,
    STUCK,
    TEMPERATURE_UNCERTAIN,
    TORQUE_ONLY,
)


class Fact(NamedTuple):
    """Something true of one estimate: the sentence that says it, the reasons it gives, and the source that is left."""

    sentence: str
    reasons: int
    source: int


TABLE = {
    "zero_moved": Fact("the motor angle changed although the motor did not move so far", OUT_OF_RANGE, FUSED),
    "zero_wanders": Fact("the motor angle drifts or loses counts beside the motor speed", OUT_OF_RANGE, FUSED),
    "current_implausible": Fact("the current is frozen while the motor must turn", PATHS_DISAGREE | STUCK, STIFFNESS_ONLY),
    "paths_contradict": Fact("the paths contradict each other, and either may be wrong", PATHS_DISAGREE, STIFFNESS_ONLY),
    "torque_old": Fact("the torque path has given no force for some time", 0, STIFFNESS_ONLY),
    "jump_suspected": Fact("contact, stiffness, friction or current offset may have jumped", PATHS_DISAGREE, FUSED),
    "model_error": Fact("over 1 % of the largest force is left that noise does not explain", PATHS_DISAGREE, FUSED),
    "offset_large": Fact("the offset of the motor torque exceeds a healthy current sensor's", PATHS_DISAGREE, FUSED),
    "disc_uneven": Fact("the disc may vary in thickness beyond the calibration", PATHS_DISAGREE, FUSED),
    "angle_late": Fact("motor angle and motor speed of a sample are over two cycles apart", PATHS_DISAGREE, FUSED),
    "current_apart": Fact("current and motor angle are apart in time by more than is taken out", PATHS_DISAGREE, FUSED),
    "force_sensor_wrong": Fact("the force sensor contradicts angle and current, or is stuck", PATHS_DISAGREE, FUSED),
    "resolver_implausible": Fact("the resolver is frozen, or contradicts itself", PATHS_DISAGREE | STUCK, TORQUE_ONLY),
    "contact_unknown": Fact("the brake has not been seen released since the start", CONTACT_UNCERTAIN, TORQUE_ONLY),
    "contact_lost": Fact("the contact angle was found to be wrong and is being searched for", CONTACT_UNCERTAIN, FUSED),
    "contact_sought": Fact("during this search the torque path is more accurate", CONTACT_UNCERTAIN, TORQUE_ONLY),
    "force_uncertain": Fact("the force's sigma is over 300 N, or 2 % of the largest force", CONTACT_UNCERTAIN, FUSED),
    "temperature_unknown": Fact("pad temperatures are unknown", TEMPERATURE_UNCERTAIN, FUSED),
    "temperature_uncertain": Fact("the pad temperatures' sigma is over 10 K", TEMPERATURE_UNCERTAIN, FUSED),
    "thermocouple_stuck": Fact("a backing plate's temperature does not follow its pad", STUCK, FUSED),
    "wheel_contradicted": Fact("the wheel speed is zero while pulses or vehicle speed show motion", OUT_OF_RANGE, FUSED),
    "bounds_contradict": Fact("the independent monitor excludes the force", PATHS_DISAGREE, TORQUE_ONLY),
    "bound_reached": Fact("a learned value is at its physical bound", OUTSIDE_RANGE, FUSED),
    "beyond_range": Fact("force or motor speed is beyond the range of the calibration", OUTSIDE_RANGE, FUSED),
    "no_source": Fact("neither path can be used", PATHS_DISAGREE, INVALID),
    "not_a_number": Fact("an input or the estimate is not a number, or impossible for the brake", OUTSIDE_RANGE, INVALID),
}  # fmt: skip

#: Bit of each fact.
(
    ZERO_MOVED, ZERO_WANDERS, CURRENT_IMPLAUSIBLE, PATHS_CONTRADICT, TORQUE_OLD, JUMP_SUSPECTED, MODEL_ERROR, OFFSET_LARGE,
    DISC_UNEVEN, ANGLE_LATE, CURRENT_APART, FORCE_SENSOR_WRONG, RESOLVER_IMPLAUSIBLE, CONTACT_UNKNOWN, CONTACT_LOST,
    CONTACT_SOUGHT, FORCE_UNCERTAIN, TEMPERATURE_UNKNOWN, TEMPERATURE_VAGUE, THERMOCOUPLE_STUCK, WHEEL_CONTRADICTED,
    BOUNDS_CONTRADICT, BOUND_REACHED, BEYOND_RANGE, NO_SOURCE, NOT_A_NUMBER,
) = (1 << bit for bit in range(len(TABLE)))  # fmt: skip

_REASONS = np.array([fact.reasons for fact in TABLE.values()])
_SOURCES = np.array([fact.source for fact in TABLE.values()])


@njit
def tell_status(facts: int, out: Record) -> None:
    """Facts of an ESTIMATE, with reasons and source: the last in the table that leaves less than both paths decides."""
    out.facts, out.reasons = facts, 0
    out.source = FUSED
    for bit in range(len(_REASONS)):
        if facts >> bit & 1:
            out.reasons |= _REASONS[bit]
            if _SOURCES[bit] != FUSED:
                out.source = _SOURCES[bit]


def names(facts: int) -> tuple[str, ...]:
    """Names of the facts in a bit mask."""
    return tuple(name for bit, name in enumerate(TABLE) if facts >> bit & 1)


def sentences(facts: int) -> str:
    """What the facts in a bit mask say, in words."""
    return "; ".join(TABLE[name].sentence for name in names(facts))
