"""The wire contract's codes, words and cycle: what numbers on the bus mean, in one place.

Ids, bit positions, scales and ranges are defined in the DBC alone and read from it (`wire.layout`). Repeated here are the
constants that compiled code (`emb_daemon.jit`) contains and that programs use by name; `wire.layout.load_layout` refuses a DBC
with another cycle, and a test compares the shipped DBC's value names with the words here.
"""

#: Cycle of the resolver's and the current's messages, and of the clamp force.
CYCLE_NS = 4_000_000
CYCLE_S = 0.004

#: Status of an E2E protected message: whether its values may be used.
STATUS_OK, STATUS_DEGRADED, STATUS_FAULT, STATUS_NOT_AVAILABLE = 0, 1, 2, 15
STATUSES = {STATUS_OK: "ok", STATUS_DEGRADED: "degraded", STATUS_FAULT: "fault", STATUS_NOT_AVAILABLE: "not available"}

#: Source of the clamp force (ForceSource).
FUSED, STIFFNESS_ONLY, TORQUE_ONLY, PREDICTED, INVALID = 0, 1, 2, 3, 15
SOURCES = {FUSED: "fused", STIFFNESS_ONLY: "stiffness", TORQUE_ONLY: "torque", PREDICTED: "predicted", INVALID: "invalid"}

#: Mode of a corner (Mode).
INIT, RUNNING, ADAPTING, DEGRADED, FAULT = range(5)
MODES = ("init", "running", "adapting", "degraded", "fault")

#: Request to the brake controller, and result of the last training (EMB_c_AdaptRequest).
REQUEST_NONE, REQUEST_RUN, REQUEST_ABORT = range(3)
REQUESTS = ("none", "run", "abort")
NO_RESULT, RESULT_ACCEPTED, RESULT_REJECTED, RESULT_ABORTED = range(4)
RESULTS = ("none", "accepted", "rejected", "aborted")

#: Park brake (VEH_Status).
PARK_RELEASED, PARK_APPLIED, PARK_IN_TRANSITION, PARK_FAULT = range(4)

#: Wheel pulses of one turn, and of the counter's.
PULSES_PER_TURN, PULSE_MODULO = 96, 4096

#: Bits of DegradedReasons.
RESOLVER_LOST = 1 << 0
CURRENT_LOST = 1 << 1
THERMOCOUPLE_LOST = 1 << 2
WHEEL_SPEED_LOST = 1 << 3
WHEEL_PULSE_LOST = 1 << 4
VEHICLE_STATUS_LOST = 1 << 5
E2E_ERROR = 1 << 6
OUT_OF_RANGE = 1 << 7
STUCK = 1 << 8
PATHS_DISAGREE = 1 << 9
CONTACT_UNCERTAIN = 1 << 10
TEMPERATURE_UNCERTAIN = 1 << 11
BUS_DISTURBED = 1 << 12
DEADLINE_MISSED = 1 << 13
OUTSIDE_RANGE = 1 << 14
SECOND_SENDER = 1 << 15
#: A bit without room in DegradedReasons: two senders contradict each other on the resolver or the current, or the key that
#: would show who sent them is missing. Mode and Status are Fault, and E2E_ERROR is set as well.
CONTESTED = 1 << 16
REASONS = (
    "resolver lost", "current lost", "thermocouple lost", "wheel speed lost", "wheel pulse lost", "vehicle status lost",
    "E2E error", "signal out of range", "signal stuck", "paths disagree", "contact angle uncertain",
    "pad temperature uncertain", "bus disturbed", "deadline missed", "outside calibrated range", "second sender",
)  # fmt: skip


def reason_words(bits: int) -> tuple[str, ...]:
    """DegradedReasons in words, lowest bit first."""
    return tuple(word for bit, word in enumerate(REASONS) if int(bits) >> bit & 1)
