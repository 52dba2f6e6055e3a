"""Frames in a table with a header of its own, as loggers and viewers export them: a time, an id and bytes in each row."""

import csv
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from emb_daemon.wire.units import UNITS, stated_in

#: What tools call the columns, in small letters, without a unit and with blanks for underscores.
_TIME = ("time", "timestamp", "time stamp", "seconds", "t")
_ID = ("id", "can id", "canid", "arbitration id", "arb id", "addr", "address", "identifier", "message id", "msg id")
_DATA = ("data", "payload", "data bytes", "databytes", "data hex", "frame data")
_BUS = ("bus", "channel", "chan", "can channel", "bus id", "busnum")
_EXTENDED, _YES = ("extended", "ext", "ide", "is extended", "extended id"), ("1", "true", "x", "yes", "ext")
#: One byte of the data in a column of its own: D0, B1, Data2, Byte 3.
_BYTE = re.compile(r"(?:d|b|db|data|byte|data byte) ?\d{1,2}")
#: A unit in brackets, or behind a blank.
_UNIT, _UNITS_BEHIND = re.compile(r"\s*[\[(].*?[\])]"), (" ms", " us", " ns", " s")
#: python-can's own table, whose bytes are in base 64.
_PYTHON_CAN = {"arbitration id", "remote", "error", "dlc"}
#: Separators, and number of bytes among which the header is looked for.
_MARKS, _HEADER_BYTES = (";", "\t", "|", ","), 4000
#: A date and a time of day without separators, as CSS Electronics' loggers write them, with milliseconds.
_BASIC = re.compile(r"(\d{8}T\d{6})(\d{3})")
#: From where on a number of seconds since 1970 is one of ms, µs or ns.
_FROM = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
#: Number of different ids without any letter from which they are decimal: of eight hexadecimal ones of three digits one in
#: 80 000 times none has a letter.
_DECIMAL_FROM = 8
_LAST_STANDARD, _CLASSIC_BYTES = 0x7FF, 8


class _Columns(NamedTuple):
    """Places of columns; what makes seconds of a time, 0 for what its size says; base of the ids."""

    time: int
    can_id: int
    octets: Sequence[int]
    bus: int | None
    extended: int | None
    to_s: float
    base: int = 16


def frame_table(content: bytes) -> bytes | None:
    """A table of frames converted to candump's log format row by row; None where no header names time, id and bytes. A row
    that cannot be read stays as it is."""
    for row, first in enumerate(content[:_HEADER_BYTES].split(b"\n")):
        line = first.decode(errors="replace").strip()
        mark = next((mark for mark in _MARKS if mark in line), ",")
        if (columns := _columns([cell.strip(' "') for cell in line.lstrip("#% ").split(mark)])) is None:
            continue
        lines = content.decode(errors="replace").splitlines()[row + 1 :]
        rows = list(csv.reader(lines, delimiter=mark, skipinitialspace=True))
        ids = {cells[columns.can_id].strip() for cells in rows if len(cells) > columns.can_id}
        if len(ids) >= _DECIMAL_FROM and all(map(str.isdecimal, ids)):
            columns = columns._replace(base=10)
        # The lines above stay empty, so that the line numbers stay the same.
        written = [_frame(cells, columns) or mark.join(cells).encode() for cells in rows]
        # A last line without an end was cut off.
        return b"\n".join([b""] * (row + 1) + written + [b""] * content.endswith(b"\n"))
    return None


def _columns(cells: Sequence[str]) -> _Columns | None:
    """Where a header has what a frame consists of; None if it is none of frames."""
    names = [_UNIT.sub("", cell.strip().lower()).replace("_", " ") for cell in cells]
    plain = [next((name.removesuffix(unit) for unit in _UNITS_BEHIND if name.endswith(unit)), name) for name in names]
    time, can_id, bus, extended, data = (_place(plain, known) for known in (_TIME, _ID, _BUS, _EXTENDED, _DATA))
    octets = [data] if data is not None else [n for n, name in enumerate(names) if _BYTE.fullmatch(name)]
    if time is None or can_id is None or not octets or {*names} >= _PYTHON_CAN:
        return None
    stated = stated_in(cells[time]) or next((unit[1:] for unit in _UNITS_BEHIND if names[time].endswith(unit)), "")
    return _Columns(time, can_id, octets, bus, extended, UNITS[stated][1] if stated else 0.0)


def _place(names: Sequence[str], known: Sequence[str]) -> int | None:
    return next((n for n, name in enumerate(names) if name in known), None)


def _seconds(text: str, to_s: float) -> float:
    try:
        number = float(text.replace(",", "."))
    except ValueError:
        when = datetime.fromisoformat(_BASIC.sub(r"\1.\2", text))
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    return number * (to_s or next((factor for least, factor in _FROM if number > least), 1.0))


def _frame(cells: Sequence[str], columns: _Columns) -> bytes | None:
    """A row as a line of candump's log; None if it is no frame."""
    try:
        text = cells[columns.can_id].strip().lower().rstrip("xh")
        can_id, seconds = int(text, 16 if text.startswith("0x") else columns.base), _seconds(cells[columns.time], columns.to_s)
        octets = [cells[n].strip().lower().removeprefix("0x") for n in columns.octets if n < len(cells)]
        # Of bytes in columns of their own those of a short frame are empty.
        data = bytes.fromhex("".join(byte.zfill(2) if len(octets) > 1 else byte for byte in octets if byte))
        is_long = columns.extended is not None and cells[columns.extended].strip().lower() in _YES
    except (ValueError, IndexError):
        return None
    channel = "0" if columns.bus is None else cells[columns.bus].strip() or "0"
    channel = f"can{channel}" if channel.isdecimal() else channel.replace(" ", "_")
    written = f"{can_id:08X}" if can_id > _LAST_STANDARD or is_long else f"{can_id:03X}"
    return f"({seconds:.6f}) {channel} {written}{'##0' if len(data) > _CLASSIC_BYTES else '#'}{data.hex().upper()}".encode()
