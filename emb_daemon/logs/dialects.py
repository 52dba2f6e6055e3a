"""Frames in other tools' text formats, converted to can-utils' log format, which is read in bulk."""

import re

#: What candump shows on a terminal with its option for times: ``(seconds)  interface  id   [length]  bytes``.
_SHOWN = re.compile(
    rb"\s*\((\d+\.\d+)\)\s+(\S+)\s+(?:[RT]X\s[^\[]*?\s)?([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})\s+\[(\d+)\]((?:\s+[0-9A-Fa-f]{2})*)"
    rb"\s*(remote request|'.*)?"
)
#: How SavvyCAN's tables (GVRET) begin, times in microseconds.
_GVRET = b"Time Stamp,ID,Extended,Dir,Bus,LEN"


def as_candump(content: bytes) -> bytes | None:
    """A text in another format converted to candump's log format line by line; None if the format is unknown. A line that
    cannot be read stays as it is."""
    first = content[:1000].lstrip().split(b"\n", 1)[0]
    if first.startswith(_GVRET):
        # The header becomes an empty line, so that the line numbers stay the same.
        return b"\n".join([b"", *map(_of_gvret, content.split(b"\n")[1:])])
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
