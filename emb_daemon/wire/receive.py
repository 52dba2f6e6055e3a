"""Reception: a frame changes the receiver's data wholly or not at all."""

import numpy as np

from emb_daemon.jit import njit
from emb_daemon.wire.e2e import COUNTER_MODULO, crc
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, REMOTE
from emb_daemon.wire.layout import OURS, SIGNALS, SLOTS, unpack

#: Verdicts on a frame, in the order in which they are tested.
ACCEPTED, IGNORED, SECOND_SENDER, BAD_LENGTH, BAD_CRC, BAD_COUNTER, BAD_STATUS, BAD_RANGE = range(8)
VERDICTS = ("accepted", "foreign", "second sender", "length", "CRC", "counter", "sender's status", "range")

#: Counter steps tolerated after a gap: this many, plus those that the time passed accounts for.
_TOLERATED_LOSS = 2
_NEVER = np.iinfo(np.int64).min // 2

#: Per slot: ``values``, ``time_ns`` and ``counter`` of the last accepted frame; ``sequence_ns`` and ``sequence`` of the last
#: frame that stood in sequence; ``candidate`` the counter of the last frame that did not, or -1; ``refused_ns`` when a
#: frame was last refused for its form or sequence; ``range_ns`` when one was last refused for a value out of range;
#: ``count[verdict]``.
RECEPTION = np.dtype(
    [
        ("values", "f8", (SIGNALS,)),
        ("time_ns", "i8"),
        ("counter", "i8"),
        ("sequence_ns", "i8"),
        ("sequence", "i8"),
        ("candidate", "i8"),
        ("refused_ns", "i8"),
        ("range_ns", "i8"),
        ("count", "i8", (len(VERDICTS),)),
    ],
    align=True,
)


def new_reception() -> np.ndarray:
    """Receivers of all slots, shape (SLOTS,), that have heard nothing."""
    reception = np.zeros(SLOTS, RECEPTION)
    for field in ("time_ns", "sequence_ns", "refused_ns", "range_ns"):
        reception[field] = _NEVER
    reception["counter"] = reception["sequence"] = reception["candidate"] = -1
    reception["values"] = np.nan
    return reception


@njit
def _in_sequence(counter, time_ns, reception, cycle_ns):
    """Whether a counter follows the last one. Time passed explains lost frames; a counter that stands still or runs ahead
    of the clock is a repetition or a stranger, unless two such frames in a row follow each other: then the sender has
    started anew. After a whole turn of silence the counter may stand where it stood."""
    step = (counter - reception.sequence) % COUNTER_MODULO
    if step == 0 and reception.candidate < 0:
        step = COUNTER_MODULO
    elapsed = (time_ns - reception.sequence_ns) // cycle_ns
    restarted = reception.candidate >= 0 and 1 <= (counter - reception.candidate) % COUNTER_MODULO <= _TOLERATED_LOSS
    if reception.sequence < 0 or 1 <= step <= _TOLERATED_LOSS + elapsed or restarted:
        reception.sequence = counter
        reception.sequence_ns = time_ns
        reception.candidate = -1
        return True
    reception.candidate = counter
    return False


@njit
def _verdict(frame, slot, reception, layout):
    if frame.length != 8:
        return BAD_LENGTH
    if np.uint8(frame.data & np.uint64(0xFF)) != crc(frame.can_id, frame.data):
        return BAD_CRC
    counter = np.int64((frame.data >> np.uint64(8)) & np.uint64(0xF))
    if counter >= COUNTER_MODULO:
        return BAD_COUNTER
    if not _in_sequence(counter, frame.time_ns, reception, layout.cycle_ns[slot]):
        return BAD_COUNTER
    if (frame.data >> np.uint64(12)) & np.uint64(0xF) > np.uint64(1):
        return BAD_STATUS
    for column in range(layout.received_count[slot]):
        signal = layout.received[slot, column]
        value = unpack(frame.data, signal)
        rounding = 0.5 * signal.factor
        if value < signal.low - rounding or value > signal.high + rounding:
            return BAD_RANGE
    return ACCEPTED


@njit
def receive(frame, receptions, layout):
    """Judge one FRAME record and, if it is accepted, take its signals.

    Returns (slot, verdict); the slot is negative for a frame that is none of ours.
    """
    if frame.flags & (EXTENDED | REMOTE | ERROR | FD) or frame.can_id > 2047:
        return -1, IGNORED
    slot = np.int64(layout.slot[frame.can_id])
    if slot < 0:
        return -1, SECOND_SENDER if slot == OURS else IGNORED
    reception = receptions[slot]
    verdict = _verdict(frame, slot, reception, layout)
    reception.count[verdict] += 1
    if verdict != ACCEPTED:
        if verdict == BAD_RANGE:
            reception.range_ns = frame.time_ns
        else:
            reception.refused_ns = frame.time_ns
        return slot, verdict
    reception.time_ns = frame.time_ns
    reception.counter = reception.sequence
    for column in range(layout.received_count[slot]):
        reception.values[column] = unpack(frame.data, layout.received[slot, column])
    return slot, verdict
