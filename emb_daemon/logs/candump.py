"""can-utils' log format, read in bulk: ``(seconds.fraction) interface id#data [flags]``."""

import numpy as np

from emb_daemon.jit import njit
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, FRAME, REMOTE

_OPEN, _CLOSE, _POINT, _ZERO, _NINE, _REMOTE, _REMOTE_SMALL, _SPACE, _HASH = b"().09Rr #"
_RETURN, _NEWLINE = b"\r\n"
#: Entry of `_HEX` for a byte that is no hexadecimal digit.
_NO_HEX = 255


#: Value of each byte that is a hexadecimal digit.
_HEX = np.full(256, _NO_HEX, np.uint8)
_HEX[[*b"0123456789abcdef"]] = _HEX[[*b"0123456789ABCDEF"]] = np.arange(16)
_NOWHERE = np.zeros(0, np.uint8)


@njit
def _parse_payload(text, at, stop, octets):
    """Position behind the payload, its first eight bytes and its length; position -1 if a byte has one digit only."""
    data, length = np.uint64(0), 0
    while at + 1 < stop and _HEX[text[at]] != _NO_HEX:
        low = _HEX[text[at + 1]]
        if low == _NO_HEX:
            return -1, data, length
        octet = _HEX[text[at]] * 16 + low
        if length < 8:
            data |= np.uint64(octet) << np.uint64(8 * length)
        if length < len(octets):
            octets[length] = octet
        length += 1
        at += 2
    return at, data, length


@njit
def _parse_time(text, start, stop):
    """Place after ``(seconds.fraction)`` in ``text[start:stop]``, and the time in ns; place -1 if it is malformed."""
    if text[start] != _OPEN:
        return -1, np.int64(0)
    at = start + 1
    whole, fraction, digits = np.int64(0), np.int64(0), 0
    while at < stop and _ZERO <= text[at] <= _NINE:
        whole = whole * 10 + (text[at] - _ZERO)
        at += 1
    if at < stop and text[at] == _POINT:
        at += 1
        while at < stop and _ZERO <= text[at] <= _NINE:
            if digits < 9:
                fraction = fraction * 10 + (text[at] - _ZERO)
                digits += 1
            at += 1
    if at >= stop or text[at] != _CLOSE or digits == 0:
        return -1, np.int64(0)
    while digits < 9:
        fraction *= 10
        digits += 1
    return at + 1, whole * 1_000_000_000 + fraction


@njit
def _parse_line(text, start, stop, frame, octets):
    """Fill ``frame`` from ``text[start:stop]``, and ``octets`` with its payload if there is room; False if the line is
    malformed."""
    at, time_ns = _parse_time(text, start, stop)
    if at < 0:
        return False
    frame.time_ns = time_ns
    if at >= stop or text[at] != _SPACE:
        return False
    at += 1
    interface = at
    while at < stop and text[at] != _SPACE:
        at += 1
    if at == interface or at >= stop:
        return False
    at += 1
    can_id, width = np.int64(0), 0
    while at < stop and _HEX[text[at]] != _NO_HEX:
        can_id = can_id * 16 + _HEX[text[at]]
        width += 1
        at += 1
    if (width != 3 and width != 8) or at >= stop or text[at] != _HASH:
        return False
    flags = 0
    if width == 8:
        flags |= ERROR if can_id & 0x2000_0000 else EXTENDED
        can_id &= 0x1FFF_FFFF
    at += 1
    data, length = np.uint64(0), 0
    if at < stop and text[at] == _HASH:
        # A digit of flags follows, which is not needed.
        flags |= FD
        at += 2
    if at < stop and (text[at] == _REMOTE or text[at] == _REMOTE_SMALL):
        # A remote request; a length may follow, which is not needed.
        flags |= REMOTE
        at += 1
        while at < stop and text[at] != _SPACE:
            at += 1
    else:
        at, data, length = _parse_payload(text, at, stop, octets)
        if at < 0:
            return False
    if at < stop and text[at] == _SPACE:
        at += 1
        while at < stop and text[at] != _SPACE:
            at += 1
    if at < stop or length > (64 if flags & FD else 8):
        return False
    frame.can_id = can_id
    frame.data = data
    frame.length = length
    frame.flags = flags
    return True


@njit
def _parse(text, frames, octets):
    """Returns (frames filled, line number of the first malformed line or 0, whether that line is an unfinished last one)."""
    count, line, start, size, filled = 0, 0, 0, len(text), 0
    while start < size:
        stop = start
        while stop < size and text[stop] != _NEWLINE:
            stop += 1
        line += 1
        end = stop - 1 if stop > start and text[stop - 1] == _RETURN else stop
        if end > start:
            if not _parse_line(text, start, end, frames[count], octets[filled:]):
                return count, line, stop == size
            filled += np.int64(frames[count].length)
            count += 1
        start = stop + 1
    return count, 0, False


def parse_candump(text: bytes, octets: np.ndarray = _NOWHERE) -> tuple[np.ndarray, int, bool]:
    """FRAME array of a whole candump log, the number of the first malformed line (0: none) and whether that line is the last
    one and lacks its newline, as in a log whose writer was killed.

    ``octets``, a uint8 array of half the text's length, takes the payloads, one after the other, those of CAN FD whole."""
    array = np.frombuffer(text, np.uint8)
    frames = np.zeros(text.count(b"\n") + 1, FRAME)
    count, bad_line, unfinished = _parse(array, frames, octets)
    return frames[:count], bad_line, unfinished


def format_candump(frames: np.ndarray) -> str:
    """The same format back; classic data frames only, as the daemon sends them, on an interface called can0."""
    lines = []
    for time_ns, data, can_id, length, _ in frames.tolist():
        seconds, fraction = divmod(time_ns, 1_000_000_000)
        payload = data.to_bytes(8, "little")[:length].hex().upper()
        lines.append(f"({seconds}.{fraction // 1000:06d}) can0 {can_id:03X}#{payload}\n")
    return "".join(lines)
