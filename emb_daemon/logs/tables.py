"""Columns of tables and channels of measurements: logs that hold signals instead of CAN frames."""

import csv
import hashlib
import io
import sys
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.logs.read import log_ending, needs_extra, read_file, unpack_gzip
from emb_daemon.logs.stamps import in_time
from emb_daemon.wire.units import UNITS

_MEASUREMENTS = (".mf4", ".mdf", ".dat")
_DELIMITERS = (",", ";", "\t")
#: Lines of words that measurement tools write before a table's header at most, and of units between header and numbers.
_PREAMBLE, _UNITS = 60, 3
#: What int64 nanoseconds hold: the year 2262, s.
_LATEST_S = 9.2e9
#: Cells that say that nothing was measured.
_NOTHING = ["", "-", "--", "---", "NA", "N/A", "#N/A", "n/a", "NaN", "nan", "NULL", "null", "None"]


def read_table(path: Path, names: list[str], time) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], str]:
    """Times (int64 ns) and values of the named columns or channels, and the SHA-256 of the file.

    Args:
        time: `logs.mapping.Time`, the column of times of a table; None for a measurement.

    Raises:
        InputError: unreadable, or without one of the columns, or one that holds no numbers.
    """
    raw = read_file(path)
    ending = log_ending(path)
    content, digest = unpack_gzip(path, raw), hashlib.sha256(raw).hexdigest()
    if ending in _MEASUREMENTS:
        return _channels(path, content, names), digest
    if ending not in (".csv", ".parquet"):
        raise InputError(f"{path}: expected a table (.csv, .parquet) or a measurement ({', '.join(_MEASUREMENTS)}): no dbc")
    if time is None:
        raise InputError(f"{path}: is a table, and the mapping names no column of times; expected `time: {{signal: NAME}}`")
    table = _table(path, content, ending, [time.signal, *names])
    columns = {name: _numbers(path, table, name) for name in names}
    # Of a clock, seconds already.
    seconds = _numbers(path, table, time.signal) * (1.0 if _is_clock(table[time.signal].type) else UNITS[time.unit][1])
    known = np.isfinite(seconds)
    if np.any(np.abs(seconds[known]) > _LATEST_S):
        raise InputError(
            f"{path}: {time.signal}: {np.max(np.abs(seconds[known])):g} s are no time; is `time.unit`, {time.unit}, right?"
        )
    columns = {name: values[known] for name, values in columns.items()}
    stamps, rows = in_time(f"{path}", np.rint(1e9 * seconds[known]).astype(np.int64), list(columns.values()))
    return {name: (stamps, values[rows]) for name, values in columns.items()}, digest


def _table(path: Path, content: bytes, ending: str, names: list[str]):
    """The table in a file (pyarrow.Table), which has each of ``names`` once."""
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(io.BytesIO(content)) if ending == ".parquet" else _text_table(path, content, names)
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: not readable: {str(error).splitlines()[0]}") from None
    for name in names:
        if (count := table.column_names.count(name)) != 1:
            there = "no such column" if count == 0 else f"{count} such columns"
            raise InputError(f"{path}: {name}: {there}; the table has {', '.join(table.column_names)}")
    return table


def _is_clock(kind) -> bool:
    import pyarrow

    return pyarrow.types.is_timestamp(kind) or pyarrow.types.is_time(kind)


def _numbers(path: Path, table, name: str) -> np.ndarray:
    """A column's values; of dates and times of day, seconds."""
    import pyarrow

    column = table[name]
    if pyarrow.types.is_timestamp(column.type):
        return 1e-9 * column.cast(pyarrow.timestamp("ns", column.type.tz)).cast(pyarrow.int64()).to_numpy()
    if pyarrow.types.is_time(column.type):
        return 1e-9 * column.cast(pyarrow.time64("ns")).cast(pyarrow.int64()).to_numpy()
    try:
        return column.cast(pyarrow.float64()).to_numpy()
    except pyarrow.ArrowException:
        raise InputError(f"{path}: {name}: expected a column of numbers, found {column.type}") from None


def _text_table(path: Path, content: bytes, names: list[str]):
    """A table as text, as measurement tools write it: words before the header and units after it are skipped, rows of another
    number of cells (a last one that was cut off) left out, with a word on stderr."""
    import pyarrow.csv

    content = _as_utf8(content)
    lines = [
        line.decode(errors="replace").rstrip("\r") for line in content.split(b"\n", _PREAMBLE + _UNITS)[: _PREAMBLE + _UNITS]
    ]
    # The header has most of the names; before it stands what the tool has to say.
    header, delimiter = max(
        ((row, mark) for row in range(min(len(lines), _PREAMBLE)) for mark in _DELIMITERS),
        key=lambda at: (len({*names} & {*_cells(lines[at[0]], at[1])}), -at[0], lines[at[0]].count(at[1])),
    )
    cells = _cells(lines[header], delimiter)
    rows = [_cells(line, delimiter) for line in lines[header + 1 : header + 1 + _UNITS]]
    units = next((row for row, found in enumerate(rows) if any(map(_is_number, found))), 0)
    first = rows[units] if rows else cells
    if len(cells) - len(first) == 1 and not cells[-1]:
        cells.pop()
    elif len(first) - len(cells) == 1 and not first[-1]:
        cells.append("")
    odd = []

    def leave_out(row) -> str:
        odd.append(row)
        return "skip"

    table = pyarrow.csv.read_csv(
        io.BytesIO(content),
        # The handler is called from one thread only.
        pyarrow.csv.ReadOptions(skip_rows=header + 1 + units, column_names=cells, use_threads=False),
        pyarrow.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=leave_out),
        # Where a comma does not separate, it is a decimal one.
        pyarrow.csv.ConvertOptions(
            decimal_point="," if delimiter != "," and any("," in cell for cell in first) else ".", null_values=_NOTHING
        ),
    )
    if odd:
        print(f"{path}: {len(odd)} rows with another number of cells than {len(cells)} left out", file=sys.stderr)
    return table


def _as_utf8(content: bytes) -> bytes:
    """Text as UTF-8 without a mark of byte order; what is neither UTF-8 nor UTF-16 is Latin-1, as older tools write it."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", errors="replace").encode()
    try:
        content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1").encode()
    return content.removeprefix(b"\xef\xbb\xbf")


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]


def _is_number(cell: str) -> bool:
    return cell.lstrip("+-.,")[:1].isdigit()


def _channels(path: Path, content: bytes, names: list[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    try:
        from asammdf import MDF
    except ImportError as error:
        raise needs_extra(path, error) from None
    try:
        with MDF(io.BytesIO(content)) as file:
            start_ns = round(1e9 * file.header.start_time.timestamp())
            found = {}
            for name in names:
                signal = file.get(name)
                values = np.asarray(signal.samples).astype(float)
                stamps = start_ns + np.rint(1e9 * signal.timestamps).astype(np.int64)
                stamps, rows = in_time(f"{path}: {name}", stamps, [values])
                found[name] = (stamps, values[rows])
            return found
    except InputError:
        raise
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not readable as a measurement: {text}") from None
