"""Columns of tables and channels of measurements: logs that hold signals instead of CAN frames."""

import contextlib
import csv
import hashlib
import io
import itertools
import re
from datetime import UTC, datetime
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.errors import InputError, tell
from emb_daemon.logs import arrays
from emb_daemon.logs.read import ZIP, ending_of_content, log_ending, needs_extra, read_file, unpack
from emb_daemon.logs.stamps import LATEST_S, in_time
from emb_daemon.wire.units import UNITS, known_as, stated_in

if TYPE_CHECKING:
    from emb_daemon.logs.mapping import Time

_MEASUREMENTS = (".mf4", ".mdf", ".dat")
_TABLES = (".csv", ".txt", ".tsv", ".dat", ".xlsx", ".xls", ".ods", ".parquet", ".feather", *arrays.ENDINGS)
#: Endings of logs of frames alone; all others may be a table's.
_FRAMES = (".blf", ".asc", ".trc")
#: How columnar files and workbooks begin.
_PARQUET, _FEATHER, _WORKBOOKS = b"PAR1", b"ARROW1", (ZIP, b"\xd0\xcf\x11\xe0")
#: What parts cells; last, any run of blanks.
_DELIMITERS = (",", ";", "\t", "|", " ")
#: Largest number of lines of text before a table's header, and of units between header and numbers.
_PREAMBLE, _UNITS = 60, 3
#: Share of a column's cells that may be no numbers; half of them if they are a few words, as from an instrument out of range.
_MOST_ODD, _FEW_WORDS = 0.01, 3
#: A time of day with parts of a second, or minutes and seconds, after a date, days or none; pyarrow reads ISO 8601.
_CLOCK = re.compile(
    r"(?:(?P<date>\d{1,4}[./-](?:\d{1,2}|[A-Za-z]{3})[./-]\d{1,4}),?[ T]|(?P<days>\d+) days? )?"
    r"(?:(?P<h>\d{1,2}):)?(?P<m>\d{1,2}):(?P<s>\d{1,2}(?:[.,:]\d+)?)(?: ?(?P<half>[AaPp])\.?[Mm]\.?)?"
)
#: A number with thousands separators or a decimal comma; separators that are never decimal.
_GROUPED, _SPACES = re.compile(r"[+-]?\d[\d.,'’\s]*(?:[eE][+-]?\d+)?"), re.compile(r"['’\s]")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:,\d{3})+(?:\.\d*)?")
#: Months as tools abbreviate them, and number of digits of a year at the beginning of a date.
_MONTHS, _YEAR = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"], 4
#: Keys in a column's metadata: of its unit, and of the decimal comma of its table.
_UNIT, _DECIMAL = b"unit", b"decimal comma"
#: Name of a column by its number.
_BY_PLACE = re.compile(r"column ([1-9]\d*)")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
#: After how much a clock without hours or a date starts anew, s, and a logger's counter of 16 or 32 bits or the part of a
#: second that stands in a column of its own (µs, ns), in its unit; how many ordinary steps may pass meanwhile.
_CLOCKS_S, _COUNTERS, _ORDINARY_STEPS = (3600, 86_400), (2**16, 10**6, 10**9, 2**32), 10.0
#: Share of the fewer rows that two columns have in common if they were written together.
_TOGETHER = 0.5
#: What separates a channel's name from its group, and the channel of raw frames in bus loggers' files.
_IN_GROUP, _BUS = " group ", "CAN_DataFrame"
#: Number of octets of which every second is zero in UTF-16 without a byte order mark.
_MARK = 200
#: Number of column names listed if one was not found.
_LISTED = 20
#: Letters of older tools of Western and Central Europe, Russia, China, Japan and Korea.
_LETTERS = ("latin-1", "cp1252", "cp1250", "cp1251", "gb18030", "cp932", "cp949")
#: A value that its line names, as a serial port's text does: ``Time: 5001 Force=3.2 N``; share of the first lines that must
#: name the same values.
_LABELLED, _MOSTLY = re.compile(rb"([A-Za-z_]\w*)\s*[:=]\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?=[\s,;|]|$)"), 0.8
#: A semicolon at the end of a line.
_ENDED = re.compile(rb"(?m);[ \t]*(?=\r?$)")
#: A name in quotes of a few lines, which begins and ends a cell.
_BROKEN = re.compile(rb'(?m)(?:(?<=[,;|\t ])|^)"[^",;|\t\n]{,50}(?:\r?\n[^",;|\t\n]{,50}){1,3}"(?=[,;|\t\r]|$)')
#: Lines at the end of a text that do not begin with a number.
_WORDS = re.compile(rb'(?:(?:^|\n)(?![ \t"]*[+-]?[\d.,]).*)+\Z')
#: Cells that mean that nothing was measured.
_NOTHING = ["", "-", "--", "---", "NA", "N/A", "#N/A", "n/a", "NaN", "nan", "NULL", "null", "None"]


def read_table(
    path: Path, names: list[str], time: "Time | None"
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[str, str], str]:
    """Times (int64 ns) and values of the named columns or channels, the units that the file states of them, and its SHA-256.

    Args:
        time: `logs.mapping.Time`, the column of times of a table; None for a measurement.

    Raises:
        InputError: unreadable, or without one of the columns, or one that holds no numbers.
    """
    raw = read_file(path)
    ending = log_ending(path)
    content, digest = unpack(path, raw), hashlib.sha256(raw).hexdigest()
    begins = ending_of_content(content)
    # `.dat` is the ending of INCA's measurements, and of other tools' text tables.
    if begins == ".mf4" or (ending in _MEASUREMENTS and ending != ".dat"):
        return *_channels(path, content, names), digest
    if begins or ending in _FRAMES:
        tables, measurements = ", ".join(_TABLES), ", ".join(_MEASUREMENTS)
        raise InputError(f"{path}: expected a table ({tables}) or a measurement ({measurements}): no dbc")
    if time is None:
        raise InputError(
            f"{path}: is a table, and the mapping names no column of times; expected `time: {{signal: NAME}}`, or "
            "`time: {rate_Hz: 100}` where it has none"
        )
    if time.name is not None:
        table = _table(path, content, ending, [time.signal, time.name, time.value])
        parts = {name: table.filter(_named(path, table[time.name], name)) for name in names}
        found = {name: _in_time(f"{path}: {name}", part, [time.value], time)[time.value] for name, part in parts.items()}
        return found, {}, digest
    table = _table(path, content, ending, [*([] if time.signal is None else [time.signal]), *names])
    units = {field.name: field.metadata[_UNIT].decode() for field in table.schema if _UNIT in (field.metadata or {})}
    return _in_time(f"{path}", table, names, time), units, digest


def _named(path: Path, column, name: str):
    """Which rows of a column (pyarrow) of names have a name."""
    import pyarrow.compute

    texts = pyarrow.compute.utf8_trim_whitespace(column.cast(pyarrow.string()))
    mine = pyarrow.compute.equal(texts, name)
    if not pyarrow.compute.any(mine).as_py():
        known = sorted(text for text in texts.unique().to_pylist() if text)
        raise InputError(f"{path}: {name}: no row has this name; the table has {_some(name, known)}")
    return mine


def _in_time(source: str, table, names: list[str], time) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times (int64 ns, rising) and values of the columns with ``names``; ``source`` is what messages call them."""
    columns = {name: _numbers(source, table, name) for name in names}
    seconds = _seconds(source, table, time)
    known = np.isfinite(seconds)
    if len(seconds[known]) and (largest := float(np.max(np.abs(seconds[known])))) > LATEST_S:
        told = f"`rate_Hz`, {time.rate_Hz:g}," if time.rate_Hz else f"`time.unit`, {time.unit},"
        hint = "" if time.rate_Hz else _other_unit(largest, time)
        raise InputError(f"{source}: {time.signal}: {largest:g} s are no time; is {told} right?{hint}")
    columns = {name: values[known] for name, values in columns.items()}
    stamps = np.rint(1e9 * seconds[known]).astype(np.int64)
    parts, found = _written_together(columns), {}
    for part, there in parts:
        rows = np.flatnonzero(there) if len(parts) > 1 else np.arange(len(stamps))
        called = f"{source}: {', '.join(part)}" if len(parts) > 1 else source
        times, kept = in_time(called, stamps[rows], [columns[name][rows] for name in part])
        found |= {name: (times, columns[name][rows[kept]]) for name in part}
    return found


def _written_together(columns: dict[str, np.ndarray]) -> list[tuple[list[str], np.ndarray]]:
    """Names of columns that have their values in the same rows, and these rows: where several senders' topics are joined into
    one table each has rows of its own, and two of them close together are no burst."""
    parts: list[tuple[list[str], np.ndarray]] = []
    for name, values in columns.items():
        there = np.isfinite(values)
        for part, rows in parts:
            if np.sum(rows & there) >= _TOGETHER * min(np.sum(rows), np.sum(there)):
                part.append(name)
                rows |= there
                break
        else:
            parts.append(([name], there))
    return parts


def _seconds(path: str, table, time) -> np.ndarray:
    """When each row was written, s."""
    if time.signal is None:
        return np.arange(table.num_rows) / time.rate_Hz
    times = np.array(_numbers(path, table, time.signal), float)
    is_clock = _is_clock(table[time.signal])
    known = np.isfinite(times)
    if is_clock or np.all(times[known] == np.rint(times[known])):
        times[known] = _going_on(times[known], _CLOCKS_S if is_clock else _COUNTERS)
    # Times of a clock are in seconds already.
    if is_clock:
        return times
    stated = stated_in(time.signal) or (table.schema.field(time.signal).metadata or {}).get(_UNIT, b"").decode()
    if stated and time.rate_Hz is None and UNITS[stated] != UNITS[time.unit]:
        tell(f"{path}: {time.signal} says {stated} and is taken in {time.unit}: which is right?")
    return times * UNITS[time.unit][1] if time.rate_Hz is None else times / time.rate_Hz


def _going_on(times: np.ndarray, periods: tuple[int, ...]) -> np.ndarray:
    """Times that wrap around, as a clock at midnight or a counter on overflow, made continuous; unchanged if a step back does
    not match the least of ``periods`` that contains them."""
    steps = np.diff(times)
    period = next((period for period in periods if len(steps) and np.max(times) < period), None)
    anew = steps < -0.5 * (period or np.inf)
    if not anew.any() or np.max(steps[anew]) + period > _ORDINARY_STEPS * np.quantile(steps[~anew], 0.95):
        return times
    return times + period * np.concatenate([[0], np.cumsum(anew)])


def _other_unit(largest_s: float, time) -> str:
    """The largest time in the largest smaller unit in which it is plausible, in words."""
    for unit in ("ms", "us", "ns"):
        seconds = largest_s * UNITS[unit][1] / UNITS[time.unit][1]
        if seconds <= LATEST_S:
            return f" As {unit} it is {seconds:.10g} s"
    return ""


def _table(path: Path, content: bytes, ending: str, names: list[str]):
    """The table in a file (pyarrow.Table), with ``names`` as its columns."""
    import pyarrow
    import pyarrow.feather
    import pyarrow.parquet

    if format := arrays.array_ending(content, ending):
        return _of_arrays(path, arrays.read_arrays(path, content, format), names)
    try:
        if ending == ".parquet" or content.startswith(_PARQUET):
            table = pyarrow.parquet.read_table(io.BytesIO(content))
        elif content.startswith(_FEATHER):
            table = pyarrow.feather.read_table(io.BytesIO(content))
        else:
            table = _text_table(path, _of_workbook(path, content, names), names)
    except (pyarrow.ArrowException, csv.Error) as error:
        raise InputError(f"{path}: not readable: {str(error).splitlines()[0]}") from None
    while any(pyarrow.types.is_struct(field.type) for field in table.schema):
        # Its fields are columns, called `struct.field`.
        table = table.flatten()
    found = {name: _place(name, table.column_names) for name in names}
    for name, place in found.items():
        if place is None:
            count = table.column_names.count(name)
            there = f"{count} such columns, of which `column N` is one by its place" if count else "no such column"
            raise InputError(f"{path}: {name}: {there}; the table has {_some(name, table.column_names)}")
    return table.select(list(found.values())).rename_columns(list(found))


def _of_workbook(path: Path, content: bytes, names: list[str]) -> bytes:
    """The sheet of a workbook that has most of the names, as a text; any other content as it is."""
    if not content.startswith(_WORKBOOKS):
        return content
    try:
        from python_calamine import CalamineError, CalamineWorkbook
    except ImportError as error:
        raise needs_extra(path, error, "formats") from None
    try:
        book = CalamineWorkbook.from_filelike(io.BytesIO(content))
        sheets = [book.get_sheet_by_name(name).to_python() for name in book.sheet_names]
    except CalamineError as error:
        text = str(error).splitlines()[0]
        raise InputError(f"{path}: not readable as a workbook: {text}; unpack an archive first") from None
    with_names = [len({*names} & {cell for row in rows[:_PREAMBLE] for cell in row}) for rows in sheets]
    most = max(with_names, default=0)
    alike = [name for name, count in zip(book.sheet_names, with_names, strict=True) if count == most > 0]
    if len(alike) > 1:
        listed = ", ".join(alike[:_LISTED]) + (", …" if len(alike) > _LISTED else "")
        tell(f"{path}: {len(alike)} sheets have these columns ({listed}); the first alone is read")
    rows = sheets[with_names.index(most)] if sheets else []
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


def _of_arrays(path: Path, found: dict[str, np.ndarray | list], names: list[str]):
    import pyarrow

    for name in names:
        if name not in found:
            raise InputError(f"{path}: {name}: no such variable of numbers; it has {_some(name, list(found))}")
    lengths = {name: len(found[name]) for name in names}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"{path}: variables of one length expected, found {told}")
    return pyarrow.table({name: _column(found[name]) for name in names})


def _column(values: np.ndarray | list):
    """A column (pyarrow.Array); texts are times where all are such as ISO 8601 has."""
    import pyarrow

    column = pyarrow.array(values)
    if pyarrow.types.is_string(column.type):
        for zone in ("UTC", None):
            with contextlib.suppress(pyarrow.ArrowInvalid):
                return column.cast(pyarrow.timestamp("ns", zone))
    return column


def _place(name: str, names: list[str]) -> int | None:
    """Index of a column among a table's ``names``, by name or by number; None if there is none, or several."""
    # A blank that breaks no line looks like any other, and the mark of a comment before a header is none of its first name.
    alike = [" ".join(known.split()) for known in names] if name not in names else names
    name = name if name in alike else name.lstrip("#% ")
    if alike.count(name) == 1:
        return alike.index(name)
    place = _BY_PLACE.fullmatch(name)
    return int(place[1]) - 1 if place and int(place[1]) <= len(names) else None


def _some(wanted: str, names: list[str]) -> str:
    """Names to list if one was misspelt: all, or the most similar ones."""
    return ", ".join(names if len(names) <= _LISTED else [*get_close_matches(wanted, names, _LISTED, 0.0), "…"]) or "none"


def _is_clock(column) -> bool:
    import pyarrow

    if pyarrow.types.is_string(column.type):
        return any(cell and _CLOCK.fullmatch(cell.strip()) for cell in column.slice(0, _PREAMBLE).to_pylist())
    return any(test(column.type) for test in (pyarrow.types.is_timestamp, pyarrow.types.is_time, pyarrow.types.is_duration))


def _numbers(path: str, table, name: str) -> np.ndarray:
    """A column's values; of dates and times of day, seconds. A few cells that are no numbers, as tools write for an overflow
    or a division by zero, are left out, with a note on stderr."""
    import pyarrow

    column = table[name]
    if pyarrow.types.is_timestamp(column.type):
        return 1e-9 * column.cast(pyarrow.timestamp("ns", column.type.tz)).cast(pyarrow.int64()).to_numpy()
    if pyarrow.types.is_time(column.type):
        return 1e-9 * column.cast(pyarrow.time64("ns")).cast(pyarrow.int64()).to_numpy()
    if pyarrow.types.is_duration(column.type):
        return 1e-9 * column.cast(pyarrow.duration("ns")).cast(pyarrow.int64()).to_numpy()
    if not pyarrow.types.is_string(column.type):
        try:
            return column.cast(pyarrow.float64(), safe=False).to_numpy()
        except pyarrow.ArrowException:
            raise InputError(f"{path}: {name}: expected a column of numbers, found {column.type}") from None
    cells = column.to_pylist()
    # Typesetters have a minus of their own.
    decimal_comma = _DECIMAL in (table.schema.field(name).metadata or {})
    texts = _ungrouped(
        [cell if cell is None else cell.strip().replace("\N{MINUS SIGN}", "-") for cell in cells], decimal_comma
    )
    dates = [found["date"] for text in texts if text and (found := _CLOCK.fullmatch(text)) and found["date"]]
    # After a number the name of a month, as a point, tells that it is the day's.
    day_first = any(re.search("[.A-Za-z]", date) or int(re.split("[/-]", date)[0]) > len(_MONTHS) for date in dates)
    values = np.array([_number(text, day_first) for text in texts])
    odd = [row for row in np.flatnonzero(np.isnan(values)).tolist() if cells[row] is not None]
    if not odd:
        return values
    first = f"the first of them {cells[odd[0]]!r}, value {odd[0] + 1}"
    few = len({cells[row] for row in odd}) <= _FEW_WORDS
    if len(odd) > (0.5 if few else _MOST_ODD) * len(cells):
        raise InputError(f"{path}: {name}: expected a column of numbers; {len(odd)} cells are none, {first}")
    tell(f"{path}: {name}: {len(odd)} cells are no numbers, left out, {first}")
    return values


def _ungrouped(cells: list[str | None], decimal_comma: bool) -> list[str | None]:
    """A column's numbers without thousands separators and with a decimal point, other texts unchanged; ``decimal_comma`` of a
    table with such."""
    numbers = [cell for cell in cells if cell and _GROUPED.fullmatch(cell)]
    both = next((cell for cell in numbers if "," in cell and "." in cell), None)
    if both is not None:
        group = min(",.", key=both.rindex)
    else:
        commas = [cell for cell in numbers if "," in cell]
        group = "," if commas and all(map(_THOUSANDS.fullmatch, commas)) else "."
        points = [cell for cell in numbers if "." in cell]
        # No thousands begin with a zero.
        grouped = decimal_comma and not commas and all(re.fullmatch(r"[+-]?[1-9]\d{,2}(\.\d{3})+", cell) for cell in points)

    def plain(cell: str) -> str:
        text = _SPACES.sub("", cell)
        # A single point is a decimal point, unless the table's other decimals are commas.
        return (text.replace(group, "") if both or group == "," or grouped else text).replace(",", ".")

    return [plain(cell) if cell and _GROUPED.fullmatch(cell) else cell for cell in cells]


def _number(cell: str | None, day_first: bool) -> float:
    """Number in a cell's text; seconds of a date, a time of day, or both; NaN for anything else."""
    if cell is None:
        return np.nan
    try:
        return float(cell)
    except ValueError:
        found = _CLOCK.fullmatch(cell)
    if not found:
        return np.nan
    hours, minutes, seconds = (float(re.sub("[,:]", ".", found[part] or "0")) for part in ("h", "m", "s"))
    if found["half"]:
        hours = hours % 12.0 + 12.0 * (found["half"] in "Pp")
    of_day = 86400.0 * float(found["days"] or 0.0) + 3600.0 * hours + 60.0 * minutes + seconds
    if not found["date"]:
        return of_day
    parts = re.split("[./-]", found["date"])
    year, month, day = parts if len(parts[0]) == _YEAR else (parts[2], *(parts[1::-1] if day_first else parts[:2]))
    try:
        number = int(month) if month.isdigit() else _MONTHS.index(month.lower()) + 1
        return of_day + datetime(int(year), number, int(day), tzinfo=UTC).timestamp()
    except ValueError:
        return np.nan


def _text_table(path: Path, content: bytes, names: list[str]):
    """A table as text, as measurement tools write it: text before the header and units after it are skipped, rows with another
    number of cells (a truncated last one) left out, with a note on stderr."""
    import pyarrow.csv

    content = _as_utf8(content, names)
    if b"\n" not in content:
        content = content.replace(b"\r", b"\n")
    content = _in_one_line(_unlabelled(_unterminated(content)))
    lines = [
        line.decode(errors="replace").rstrip("\r") for line in content.split(b"\n", _PREAMBLE + _UNITS)[: _PREAMBLE + _UNITS]
    ]
    # The header is the line with most of the names, and the lines below it have its separator; before it is the tool's own
    # text.
    header, delimiter = max(
        ((row, mark) for row in range(min(len(lines), _PREAMBLE)) for mark in _DELIMITERS),
        key=lambda at: (
            len({*names} & {*_cells(lines[at[0]], at[1])}) * _parts(lines[at[0] + 1 : at[0] + 2 + _UNITS], at[1]),
            -at[0],
            at[1] != " ",
            lines[at[0]].count(at[1]),
        ),
    )
    content = _under_one_header(path, content, header)
    cells = _cells(lines[header], delimiter)
    by_place = all(map(_BY_PLACE.fullmatch, names))
    if not {*names} & {*cells} and (found := _without_header(lines, by_place)):
        header, delimiter = found
        cells = [f"column {number + 1}" for number in range(len(_cells(lines[header + 1], delimiter)))]
    elif not {*names} & {*cells}:
        # What is then said of the names is of what stands above the numbers.
        header, delimiter = _above_numbers(lines) or (header, delimiter)
        cells = _cells(lines[header], delimiter)
    if delimiter == " ":
        content = b"\n".join(b" ".join(line.split()) for line in content.split(b"\n"))
    rows = [_cells(line, delimiter) for line in lines[header + 1 : header + 1 + _UNITS]]
    units = next((row for row, found in enumerate(rows) if any(map(_is_number, found))), 0)
    first = rows[units] if rows else cells
    if len(cells) - len(first) == 1 and not cells[-1]:
        cells.pop()
    elif len(first) > len(cells):
        cells = _with_nameless(path, cells, rows[units:], lines[header + 1 + units])
    if _are_pairs(cells, rows[units:]):
        tell(f"{path}: a name stands over two columns, a time and its value: the value is taken; `column 1` is a time")
        cells = ["", *cells[:-1]]
    odd = []

    def leave_out(row) -> str:
        odd.append(row)
        return "skip"

    def read(decimal_point: str):
        odd.clear()
        return pyarrow.csv.read_csv(
            io.BytesIO(content),
            # The handler is called from one thread only.
            pyarrow.csv.ReadOptions(skip_rows=header + 1 + units, column_names=cells, use_threads=False),
            pyarrow.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=leave_out),
            pyarrow.csv.ConvertOptions(decimal_point=decimal_point, null_values=_NOTHING, strings_can_be_null=True),
        )

    table = read(".")
    reached = odd[0].actual_columns if len(odd) > table.num_rows else len(cells)
    if reached < len(cells) and {*names} <= {*cells[:reached]} | {f"column {n + 1}" for n in range(reached)}:
        more = ", ".join(filter(None, cells[reached:]))
        tell(f"{path}: rows have {reached} cells, the header {len(cells)}; its last name nothing: {more}")
        cells = cells[:reached]
        table = read(".")
    wanted = [table.column(place) for name in names if (place := _place(name, table.column_names)) is not None]
    texts = [column for column in wanted if pyarrow.types.is_string(column.type)]
    # A comma that does not separate is decimal; it may occur for the first time after many rows.
    commas = delimiter != "," and any(_DECIMAL_COMMA.fullmatch(cell.strip()) for t in texts for cell in t.to_pylist() if cell)
    if commas:
        table = read(",")
    if len(odd) > table.num_rows:
        raise InputError(
            f"{path}: {len(odd)} of {len(odd) + table.num_rows} rows have another number of cells than {len(cells)}, the "
            f"first of them {odd[0].actual_columns}; expected a table with the columns {_some('', cells)}"
        )
    if odd:
        tell(f"{path}: {len(odd)} rows with another number of cells than {len(cells)} left out")
    stated = [next(filter(None, map(known_as, column)), "") for column in itertools.zip_longest(*rows[:units], fillvalue="")]
    marks = {_DECIMAL: b","} if commas else {}
    fields = [
        field.with_metadata(marks | ({_UNIT: unit} if unit else {}))
        for field, unit in itertools.zip_longest(table.schema, stated[: table.num_columns], fillvalue="")
    ]
    return pyarrow.Table.from_arrays(table.columns, schema=pyarrow.schema(fields))


def _under_one_header(path: Path, content: bytes, header: int) -> bytes:
    """A table whose header is repeated, over each segment that LabVIEW writes or by a logger switched on again, without that
    and the words above it."""
    line = content.split(b"\n", header + 1)[header]
    over, *parts = (b"\n" + content).split(b"\n" + line + b"\n")
    if len(parts) < 2 or not line.strip() or _is_number(line.decode(errors="replace").strip()):
        return content
    told = f"the header is repeated {len(parts) - 1} times; that and the words above it are left out"
    tell(f"{path}: {told}")
    above = [_WORDS.sub(b"", part) if header else part for part in parts[:-1]]
    return b"\n".join([over, line, *above, parts[-1]])[1:]


def _in_one_line(content: bytes) -> bytes:
    """A table without the line breaks within its header's quotes, as spreadsheets put a unit under a name."""
    *lines, rest = content.split(b"\n", _PREAMBLE)
    above = _BROKEN.sub(lambda found: b" ".join(found[0].split()), b"\n".join(lines))
    return b"\n".join([above, rest]) if lines else content


def _are_pairs(names: list[str], rows: list[list[str]]) -> bool:
    """Whether each name stands over two columns, of which the first are the same time in each row."""
    alternate = len(names) > 2 and all(names[::2]) and not any(names[1::2])
    return alternate and any(rows) and all(len({*row[: len(names) : 2]} - {""}) == 1 for row in rows if row)


def _unterminated(content: bytes) -> bytes:
    """Rows without the semicolon that ends each of a matrix as MATLAB writes it, if another separator parts their cells."""
    lines = [line.rstrip() for line in content.split(b"\n", _PREAMBLE)[:_PREAMBLE] if line.strip()]
    ended = sum(line.endswith(b";") and line.count(b";") == 1 and any(mark in line for mark in b",\t ") for line in lines)
    return _ENDED.sub(b"", content) if ended > 0.5 * len(lines) else content


def _parts(lines: list[str], delimiter: str) -> bool:
    """Whether a separator occurs in any of the lines below a header; true if there are none."""
    return not any(lines) or any(len(_cells(line, delimiter)) > 1 for line in lines)


def _with_nameless(path: Path, names: list[str], rows: list[list[str]], line: str) -> list[str]:
    """Names of a table whose rows, the first of which is ``line``, have more cells than its header: the unnamed column is the
    first if that numbers or names the rows, as R and pandas write it; otherwise the last ones are unnamed."""
    more = len(rows[0]) - len(names)
    if more == 1 and not rows[0][-1]:
        return [*names, ""]
    counts = [row[0] for row in rows if row]
    numbered = counts in ([str(n) for n in range(first, first + len(counts))] for first in (0, 1))
    if more == 1 and (numbered or line.lstrip().startswith('"')):
        return ["", *names]
    last = ", ".join(f"column {len(names) + n + 1}" for n in range(more))
    tell(f"{path}: rows have {len(rows[0])} cells, the header names {len(names)}; the last are {last}")
    return [*names, *[""] * more]


def _as_utf8(content: bytes, names: list[str]) -> bytes:
    """Text as UTF-8 without a mark of byte order; what is neither UTF-8 nor UTF-16 is as older tools write it, in the letters
    in which the columns' ``names`` stand in it, and otherwise Latin-1."""
    if content[:4] in (b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff"):
        return content.decode("utf-32", errors="replace").encode()
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", errors="replace").encode()
    for first, order in ((1, "le"), (0, "be")):
        if content[first:_MARK:2].count(0) > 0.9 * len(content[first:_MARK:2]) > 0.0:
            return content.decode(f"utf-16-{order}", errors="replace").encode()
    try:
        content.decode()
    except UnicodeDecodeError:
        foreign = [name for name in names if not name.isascii()]
        for letters in _LETTERS if foreign else ():
            with contextlib.suppress(UnicodeError):
                if all(name.encode(letters) in content for name in foreign):
                    return content.decode(letters).encode()
        return content.decode("latin-1").encode()
    return content.removeprefix(b"\xef\xbb\xbf")


def _unlabelled(content: bytes) -> bytes:
    """A serial port's lines that name each value in it (``Time: 5001 Position: 594``) as a table with these names as header;
    any other text as it is. A line that has not the same names stays as it is."""
    lines = content.split(b"\n")
    told = [tuple(name for name, _ in _LABELLED.findall(line)) for line in lines[:_PREAMBLE] if line.strip()]
    names = max(told, key=told.count, default=())
    if len(set(names)) < 2 or told.count(names) < _MOSTLY * len(told):
        return content
    result = [b",".join(names)]
    for line in lines:
        found = _LABELLED.findall(line)
        result.append(b",".join(value for _, value in found) if tuple(name for name, _ in found) == names else line)
    return b"\n".join(result)


def _cells(line: str, delimiter: str) -> list[str]:
    # numpy.savetxt and MATLAB write a header like this.
    line = line.lstrip("#%")
    if delimiter == " ":
        line = " ".join(line.split())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def _without_header(lines: list[str], words: bool) -> tuple[int, str] | None:
    """Index of the line before a table of numbers without header (-1: none), and its separator; None if there is text above
    it, unless ``words`` allows it."""
    for row, line in enumerate(lines):
        if not line.strip() or line.lstrip().startswith(("#", "%")):
            continue
        # Of separators other than blanks the comma last, because it may be decimal.
        mark = next((mark for mark in (";", "\t", "|", ",", " ") if len(_cells(line, mark)) > 1), ",")
        # A number by itself above a table is none of its rows.
        alone = len(_cells(line, mark)) == 1 < max(len(_cells(below, " ")) for below in lines[row + 1 : row + 3] or [""])
        if not alone and all(map(_is_number, filter(None, _cells(line, mark)))):
            return row - 1, mark
        if not words:
            return None
    # Where no line is of numbers alone, rows begin with words, such as the name of what was measured.
    for row, line in enumerate(lines):
        if mark := next((mark for mark in (";", "\t", "|", ",", " ") if len(_cells(line, mark)) > 1), ""):
            return row - 1, mark
    return None


def _above_numbers(lines: list[str]) -> tuple[int, str] | None:
    """Index of the highest line above the first of numbers alone that has as many cells, and their separator."""
    for row, line in enumerate(lines):
        mark = next((mark for mark in _DELIMITERS if len(_cells(line, mark)) > 1), "")
        if mark and all(map(_is_number, filter(None, cells := _cells(line, mark)))):
            above = [len(_cells(text, mark)) == len(cells) for text in lines[max(row - 1 - _UNITS, 0) : row]]
            count = next((n for n, alike in enumerate(reversed(above)) if not alike), len(above))
            return (row - count, mark) if count else None
    return None


def _is_number(cell: str) -> bool:
    return cell.lstrip("+-.,")[:1].isdigit() or cell.lstrip("+-").lower() in ("inf", "nan")


def _group_and_index(path: Path, file, name: str) -> tuple[int, int]:
    """Group and index of a channel in a measurement; several of the same name are distinguished by their group. Raises
    InputError: there is none, or several."""
    plain, _, group = name.rpartition(_IN_GROUP)
    places = [place for place in file.channels_db.get(plain, ()) if group.isdigit() and place[0] == int(group)]
    if not (places := places or list(file.channels_db.get(name, ()))):
        if _BUS in file.channels_db:
            raise InputError(f"{path}: {name}: the file holds CAN frames, which a mapping with `dbc` reads")
        known = _some(name, list(file.channels_db))
        raise InputError(f"{path}: {name}: no such channel; the measurement has {known}")
    if len(places) > 1:
        these = ", ".join(f"`{name}{_IN_GROUP}{group}`" for group, _ in places)
        raise InputError(f"{path}: {name}: {len(places)} channels have that name; expected one of {these}")
    return places[0]


def _channels(path: Path, content: bytes, names: list[str]) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[str, str]]:
    """Times and values of a measurement's channels, and their units."""
    try:
        from asammdf import MDF
    except ImportError as error:
        raise needs_extra(path, error) from None
    try:
        with MDF(io.BytesIO(content)) as file:
            start_ns = round(1e9 * file.header.start_time.timestamp())
            found, units = {}, {}
            for name in names:
                place = _group_and_index(path, file, name)
                signal = file.get(None, *place)
                if signal.samples.dtype.names or signal.samples.ndim > 1:
                    raise InputError(f"{path}: {name}: each of its samples has several values; expected a channel of one")
                try:
                    values = signal.samples.astype(float)
                except ValueError:
                    # Words stand for numbers, as of a switch.
                    values = file.get(None, *place, raw=True).samples.astype(float)
                stamps = start_ns + np.rint(1e9 * signal.timestamps).astype(np.int64)
                stamps, rows = in_time(f"{path}: {name}", stamps, [values])
                found[name], units[name] = (stamps, values[rows]), signal.unit
            return found, units
    except InputError:
        raise
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not readable as a measurement: {text}") from None
