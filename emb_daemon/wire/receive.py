"""Reception: the receiver takes a frame completely or not at all."""

import numpy as np

from emb_daemon.jit import Integer, Record, Records, fields, njit
from emb_daemon.wire.contract import STATUS_DEGRADED
from emb_daemon.wire.e2e import COUNTER_MODULO, counter_of, crc, status_of
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, REMOTE, UNAUTHENTIC
from emb_daemon.wire.layout import OURS, SIGNALS, SLOTS, unpack

#: Verdicts on a frame, in the order of the tests, except that NOT_AUTHENTIC is tested first.
ACCEPTED, IGNORED, SECOND_SENDER, BAD_LENGTH, BAD_CRC, BAD_COUNTER, BAD_STATUS, BAD_RANGE, NOT_AUTHENTIC = range(9)
VERDICTS = ("accepted", "foreign", "second sender", "length", "CRC", "counter", "sender's status", "range", "authentication")

#: Counter steps tolerated after a gap, in addition to those that the elapsed time explains: one frame lost.
_TOLERATED_LOSS = 2
#: Number of frames that must all be late before the sender's schedule is moved later: at first, and once the schedule is
#: known. A bus or sender that was held up for less catches up, and its frames then do not count as early; a sender's clock
#: that runs slower than ours is followed.
_FIRST_WINDOW, _WINDOW = 128, 1024
#: Cycles behind its schedule after which a sender gets a new one: a second of the resolver's, longer than a bus holds it up.
_NEW_SCHEDULE = 250
_NEVER = np.iinfo(np.int64).min // 2
_LONG = np.iinfo(np.int64).max

#: Per slot. Of the last accepted frame: ``values``, ``time_ns``, ``counter``, and whether its sender reported ``degraded``.
#: Of the last frame in sequence: ``sequence_ns`` and ``sequence`` (time and counter), ``due_ns`` (its time by the schedule),
#: ``data``. ``later_ns``: least lateness among the ``seen`` frames of the present ``window``. ``candidate`` and
#: ``candidate_ns``: counter (-1: none) and time of the last frame out of sequence. ``refused_ns``: when a frame was last
#: refused for its form or sequence; ``range_ns``: for a value out of range; ``contested_ns``: when another frame last claimed
#: to be the one in sequence. ``count[verdict]``: number of frames.
RECEPTION = np.dtype(
    [
        ("values", "f8", (SIGNALS,)),
        *fields("i8", "time_ns counter"),
        ("degraded", "?"),
        *fields("i8", "sequence_ns sequence due_ns later_ns seen window candidate candidate_ns refused_ns range_ns"),
        ("data", "u8"),
        ("contested_ns", "i8"),
        ("count", "i8", (len(VERDICTS),)),
    ],
    align=True,
)


def new_reception() -> np.ndarray:
    """Receivers of all slots, shape (SLOTS,), that have not received anything."""
    reception = np.zeros(SLOTS, RECEPTION)
    for field in ("time_ns", "sequence_ns", "due_ns", "candidate_ns", "refused_ns", "range_ns", "contested_ns"):
        reception[field] = _NEVER
    reception["counter"] = reception["sequence"] = reception["candidate"] = -1
    reception["values"] = np.nan
    return reception


@njit
def _in_sequence(counter, time_ns, reception, cycle_ns):
    """Whether a counter follows the last one, and not earlier than its sender can have sent it.

    The elapsed time explains lost frames. A counter that repeats or runs ahead of the clock is a repeated frame, or comes from
    another sender. So does a frame that comes half a cycle before its time: a bus delays frames, which may then come in a
    burst, but never makes them early. Two frames out of sequence that follow each other after half a cycle or more, with no
    frame in sequence between them, come from a sender that has restarted. After a silence of one turn of the counter, the
    counter may be the same as before."""
    if reception.sequence < 0:
        return _start_schedule(counter, time_ns, reception, cycle_ns)
    step = (counter - reception.sequence) % COUNTER_MODULO
    if step == 0 and reception.candidate < 0:
        step = COUNTER_MODULO
    elapsed = (time_ns - reception.sequence_ns) // cycle_ns
    due = reception.due_ns + step * cycle_ns
    if 1 <= step <= _TOLERATED_LOSS + elapsed and time_ns >= due - cycle_ns // 2:
        if time_ns - due > _NEW_SCHEDULE * cycle_ns:
            return _start_schedule(counter, time_ns, reception, cycle_ns)
        reception.sequence = counter
        reception.sequence_ns = time_ns
        reception.candidate = -1
        _follow_schedule(due, time_ns, reception)
        return True
    follows = 1 <= (counter - reception.candidate) % COUNTER_MODULO <= _TOLERATED_LOSS
    if reception.candidate >= 0 and follows and time_ns - reception.candidate_ns >= cycle_ns // 2:
        return _start_schedule(counter, time_ns, reception, cycle_ns)
    reception.candidate = counter
    reception.candidate_ns = time_ns
    return False


@njit
def _start_schedule(counter, time_ns, reception, cycle_ns):
    """Begin the sender's schedule with this frame; always True.

    A single frame does not determine a schedule, because it may be the first of a delayed burst. The schedule therefore begins
    one turn of the counter earlier, which allows frames to come earlier by that much, until the first window has shown it."""
    reception.sequence = counter
    reception.sequence_ns = time_ns
    reception.due_ns = time_ns - COUNTER_MODULO * cycle_ns
    reception.later_ns, reception.seen, reception.window = _LONG, 0, _FIRST_WINDOW
    reception.candidate = -1
    return True


@njit
def _follow_schedule(due, time_ns, reception):
    """A frame before its time moves the schedule at once. Late frames move it only when all of a window are late."""
    reception.due_ns = min(due, time_ns)
    reception.later_ns = min(reception.later_ns, time_ns - reception.due_ns)
    reception.seen += 1
    if reception.seen == reception.window:
        reception.due_ns += reception.later_ns
        reception.later_ns, reception.seen = _LONG, 0
        reception.window = min(2 * reception.window, _WINDOW)


@njit
def lateness(reception: Record, cycle_ns: int) -> Integer:
    """By how much the last frame in sequence came later than the promptest, ns: of the last window, or, before one is full, of
    those that were seen. Of a silence the schedule knows no whole turns of the counter, after which an early frame seems late
    by nearly one."""
    late = reception.sequence_ns - reception.due_ns
    if reception.window == _FIRST_WINDOW:
        late -= reception.later_ns
    turn = COUNTER_MODULO * cycle_ns
    late %= turn
    return late if late < turn - cycle_ns else 0


@njit
def _contests(frame, reception, cycle_ns):
    """Whether a frame has the counter of the last one in sequence but other content. One sender never does that, so there are
    two, and the receiver cannot know which is genuine."""
    same = np.int64(counter_of(frame.data)) == reception.sequence and frame.time_ns - reception.sequence_ns < cycle_ns
    return same and (np.uint64(frame.data) >> np.uint64(12)) != (reception.data >> np.uint64(12))


@njit
def _verdict(frame, slot, reception, layout):
    if frame.length != 8:
        return BAD_LENGTH
    if np.uint8(frame.data & np.uint64(0xFF)) != crc(frame.can_id, frame.data):
        return BAD_CRC
    counter = np.int64(counter_of(frame.data))
    if counter >= COUNTER_MODULO:
        return BAD_COUNTER
    if _contests(frame, reception, layout.cycle_ns[slot]):
        reception.contested_ns = frame.time_ns
    if not _in_sequence(counter, frame.time_ns, reception, layout.cycle_ns[slot]):
        return BAD_COUNTER
    reception.data = frame.data
    if status_of(frame.data) > STATUS_DEGRADED:
        return BAD_STATUS
    for column in range(layout.received_count[slot]):
        signal = layout.received[slot, column]
        value = unpack(frame.data, signal)
        rounding = 0.5 * signal.factor
        if value < signal.low - rounding or value > signal.high + rounding:
            return BAD_RANGE
    return ACCEPTED


@njit
def receive(frame: Record, receptions: Records, layout: Record) -> tuple[Integer, int]:
    """Check one FRAME record and, if it is accepted, store its signals.

    Returns (slot, verdict); the slot is negative for a frame that the daemon does not receive."""
    if frame.flags & (EXTENDED | REMOTE | ERROR | FD) or frame.can_id > 2047:
        return -1, IGNORED
    slot = np.int64(layout.slot[frame.can_id])
    if slot < 0:
        return -1, SECOND_SENDER if slot == OURS else IGNORED
    reception = receptions[slot]
    verdict = NOT_AUTHENTIC if frame.flags & UNAUTHENTIC else _verdict(frame, slot, reception, layout)
    reception.count[verdict] += 1
    if verdict != ACCEPTED:
        if verdict == BAD_RANGE:
            reception.range_ns = frame.time_ns
        else:
            reception.refused_ns = frame.time_ns
        return slot, verdict
    reception.time_ns = frame.time_ns
    reception.counter = reception.sequence
    reception.degraded = status_of(frame.data) == STATUS_DEGRADED
    for column in range(layout.received_count[slot]):
        reception.values[column] = unpack(frame.data, layout.received[slot, column])
    return slot, verdict
