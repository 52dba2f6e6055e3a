"""Frames in other tools' text formats, converted to can-utils' log format, which is read in bulk."""

import re
from collections.abc import Iterator

#: What candump shows on a terminal with its option for times: ``(seconds)  interface  id   [length]  bytes``.
_SHOWN = re.compile(
    rb"\s*\((\d+\.\d+)\)\s+(\S+)\s+(?:[RT]X\s[^\[]*?\s)?([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})\s+\[(\d+)\]((?:\s+[0-9A-Fa-f]{2})*)"
    rb"\s*(remote request|'.*)?"
)
#: How SavvyCAN's tables (GVRET) begin, times in microseconds.
_GVRET = b"Time Stamp,ID,Extended,Dir,Bus,LEN"
#: How BUSMASTER's logs begin, and a frame in one: ``hh:mm:ss:fraction Rx|Tx channel id type length bytes``, of type s(tandard)
#: or (e)x(tended), with r where it is remote. All other lines begin with stars.
_BUSMASTER = b"***BUSMASTER"
_BUSMASTER_FRAME = re.compile(
    rb"(\d+):(\d+):(\d+):(\d+)\s+[RT]x\s+(\d+)\s+(?:0x)?([0-9A-Fa-f]+)\s+([sx]r?)(?:-fd)?\s+(\d+)((?:\s+[0-9A-Fa-f]+)*)", re.I
)
_DECIMAL = b"***DEC***"
_HALF_A_DAY_S = 43_200


def as_candump(content: bytes) -> bytes | None:
    """A text in another format converted to candump's log format line by line; None if the format is unknown. A line that
    cannot be read stays as it is."""
    first = content[:1000].lstrip().split(b"\n", 1)[0]
    if first.startswith(_GVRET):
        # The header becomes an empty line, so that the line numbers stay the same.
        return b"\n".join([b"", *map(_of_gvret, content.split(b"\n")[1:])])
    if first.startswith(_BUSMASTER):
        return b"\n".join(_of_busmaster(content.split(b"\n")))
    if _SHOWN.fullmatch(first.strip()):
        return b"\n".join(map(_of_terminal, content.split(b"\n")))
    return None


def _of_terminal(line: bytes) -> bytes:
    found = _SHOWN.fullmatch(line.rstrip())
    if not found:
        return line
    stamp, interface, can_id, length, data, more = found.groups()
    # Lengths of CAN FD have two digits.
    mark = b"##0" if len(length) > 1 else b"#"
    return b"(%s) %s %s%s%s" % (
        stamp,
        interface,
        can_id,
        mark,
        b"R" if (more or b"").startswith(b"r") else b"".join(data.split()),
    )


def _of_gvret(line: bytes) -> bytes:
    cells = [cell.strip() for cell in line.split(b",")]
    try:
        micros, can_id, bus, length = int(cells[0]), int(cells[1], 16), cells[4], int(cells[5])
        data = b"".join(b"%02X" % int(cell, 16) for cell in cells[6 : 6 + length])
    except (ValueError, IndexError):
        return line
    width = b"%08X" if cells[2].lower() == b"true" else b"%03X"
    return b"(%d.%06d) %s %s%s%s" % (*divmod(micros, 1_000_000), bus, width % can_id, b"##0" if length > 8 else b"#", data)


def _of_busmaster(lines: list[bytes]) -> Iterator[bytes]:
    """Times count from midnight before the first frame; a log of more than a day goes on, session by session."""
    base, day, last = 16, 0, 0
    for line in lines:
        found = _BUSMASTER_FRAME.fullmatch(line.strip())
        if not found:
            base = 10 if line.strip() == _DECIMAL else base
            yield b"" if line.startswith(b"***") else line
            continue
        hours, minutes, seconds, fraction, channel, can_id, kind, length, data = found.groups()
        second = 3600 * int(hours) + 60 * int(minutes) + int(seconds)
        # Back by more than half a day is another day; by less it is what `stamps` makes of it.
        day += last - second > _HALF_A_DAY_S
        last = second
        extended, remote = kind[:1] in b"xX", len(kind) > 1
        octets = b"R" if remote else b"".join(b"%02X" % int(octet, base) for octet in data.split()[: int(length)])
        yield b"(%d.%s) %s %s%s%s" % (
            second + 2 * _HALF_A_DAY_S * day,
            fraction,
            channel,
            (b"%08X" if extended else b"%03X") % int(can_id, base),
            b"##0" if int(length) > 8 else b"#",
            octets,
        )
