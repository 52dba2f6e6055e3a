"""Columns of tables and channels of measurements: logs that hold signals instead of CAN frames."""

import contextlib
import csv
import hashlib
import io
import re
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.errors import InputError, tell
from emb_daemon.logs import arrays
from emb_daemon.logs.mapping_file import Time
from emb_daemon.logs.read import ZIP, ending_of_content, log_ending, needs_extra, read_file, unpack
from emb_daemon.logs.stamps import LATEST_S, in_time, renewed_rows, since_the_row_before
from emb_daemon.logs.text_tables import DECIMAL, LISTED, PREAMBLE, UNIT, place_of, read_text, some_of
from emb_daemon.wire.units import UNITS, stated_in

_MEASUREMENTS = (".mf4", ".mdf", ".dat")
_TABLES = (".csv", ".txt", ".tsv", ".dat", ".xlsx", ".xls", ".ods", ".parquet", ".feather", *arrays.ENDINGS)
#: Endings of logs of frames alone; all others may be a table's.
_FRAMES = (".blf", ".asc", ".trc")
#: How columnar files and workbooks begin.
_PARQUET, _FEATHER, _WORKBOOKS = b"PAR1", b"ARROW1", (ZIP, b"\xd0\xcf\x11\xe0")
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
#: After how much a clock without hours or a date starts anew, s, and a counter of 8, 16 or 32 bits or the part of a
#: second that stands in a column of its own (ms, µs, ns), in its unit; how many ordinary steps may pass meanwhile.
_CLOCKS_S, _COUNTERS, _ORDINARY_STEPS = (3600, 86_400), (2**8, 1000, 2**16, 10**6, 10**9, 2**32), 10.0
#: What the part of a unit of time in a column of its own counts to; share of that which it reaches, and of its steps that rise
#: within one unit and fall at a new one: what is sampled twice a second or more often does.
_PARTS, _REACHED, _IN_ORDER = (1e3, 1e6, 1e9), 0.4, 0.9
#: Share of the fewer rows that two columns have in common if they were written together.
_TOGETHER = 0.5
#: What separates a channel's name from its group, and the channel of raw frames in bus loggers' files.
_IN_GROUP, _BUS = " group ", "CAN_DataFrame"


def read_table(
    path: Path, names: list[str], time: Time | None
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[str, str], str]:
    """Times (int64 ns) and values of the named columns or channels, the units that the file states of them, and its SHA-256.
    ``time``: the column of times of a table; None for a measurement. Raises InputError: unreadable, or without one of the
    columns, or one that holds no numbers."""
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
    table = _table(path, content, ending, [*([] if time.signal is None else [time.signal]), *names], time.signal)
    units = {field.name: field.metadata[UNIT].decode() for field in table.schema if UNIT in (field.metadata or {})}
    found, clocks = {}, _by_clock(table, names, time.signal)
    if len(clocks) > 1:
        tell(f"{path}: several columns have the name of {time.signal}: each value goes by the last of them before it")
    for clock, own in clocks.items():
        found |= _in_time(f"{path}", table, own, msgspec.structs.replace(time, signal=clock))
    return found, units, digest


def _named(path: Path, column, name: str):
    """Which rows of a column (pyarrow) of names have a name."""
    import pyarrow.compute

    texts = pyarrow.compute.utf8_trim_whitespace(column.cast(pyarrow.string()))
    mine = pyarrow.compute.equal(texts, name)
    if not pyarrow.compute.any(mine).as_py():
        known = sorted(text for text in texts.unique().to_pylist() if text)
        raise InputError(f"{path}: {name}: no row has this name; the table has {some_of(name, known)}")
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
        if (new := renewed_rows([columns[name][rows[kept]] for name in part])) is not None:
            times, kept = times[new], kept[new]
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
    if not is_clock and since_the_row_before(times[known]):
        tell(f"{path}: {time.signal} holds the time since the row before: added up")
        times[known] = np.cumsum(times[known])
    elif is_clock or np.all(times[known] == np.rint(times[known])):
        times[known] = _going_on(times[known], _CLOCKS_S if is_clock else _COUNTERS)
    # Times of a clock are in seconds already.
    if is_clock:
        return times
    stated = stated_in(time.signal) or (table.schema.field(time.signal).metadata or {}).get(UNIT, b"").decode()
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


def _by_clock(table, names: list[str], clock: str | None) -> dict[str | None, list[str]]:
    """Which of a table's columns with ``names`` go by which column of times: where several stand in it under one name, as of
    recorders that write a time beside each value, by the next one before them."""
    places = {name: place for place, name in enumerate(table.column_names)}
    clocks = [name for name in table.column_names if name not in names]
    found: dict[str | None, list[str]] = {}
    for name in names:
        before = [other for other in clocks if places[other] < places[name]]
        found.setdefault(before[-1] if before and len(clocks) > 1 else clock, []).append(name)
    return found


def _table(path: Path, content: bytes, ending: str, names: list[str], clock: str | None = None):
    """The table in a file (pyarrow.Table), with ``names`` as its columns; where several have the name of the ``clock`` among
    them, these too, in their places."""
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
            table = read_text(path, _of_workbook(path, content, names), names)
    except (pyarrow.ArrowException, csv.Error) as error:
        raise InputError(f"{path}: not readable: {str(error).splitlines()[0]}") from None
    while any(pyarrow.types.is_struct(field.type) for field in table.schema):
        # Its fields are columns, called `struct.field`.
        table = table.flatten()
    found = {name: place_of(name, table.column_names) for name in names}
    its = found.get(clock)
    table = table if its is None else _with_parts(path, table, its)
    clocks = [place for place, name in enumerate(table.column_names) if its is not None and name == table.column_names[its]]
    every = {place: f"column {place + 1}" for place in clocks} | {place: name for name, place in found.items()}
    if len(clocks) > 1 and None not in every and {*found} <= {*every.values()}:
        return table.select(sorted(every)).rename_columns([every[place] for place in sorted(every)])
    for name, place in found.items():
        if place is None:
            count = table.column_names.count(name)
            there = f"{count} such columns, of which `column N` is one by its place" if count else "no such column"
            raise InputError(f"{path}: {name}: {there}; the table has {some_of(name, table.column_names)}")
    return table.select(list(found.values())).rename_columns(list(found))


def _with_parts(path: Path, table, place: int):
    """The table with whole and part in the column of times at ``place`` if the one beside it has the other of the two, as
    ROS writes seconds and nanoseconds."""
    import pyarrow

    for other in (place + 1, place - 1):
        for whole, part in ((place, other), (other, place)):
            if 0 <= other < table.num_columns and (size := _part_of(table[whole], table[part])):
                names = table.column_names
                tell(f"{path}: {names[part]} is the part of what {names[whole]} counts: times are both together")
                once = size if place == part else 1.0
                values = once * table[whole].to_numpy() + once / size * table[part].to_numpy()
                return table.set_column(place, table.schema.field(place).with_type(pyarrow.float64()), pyarrow.array(values))
    return table


def _part_of(whole, part) -> float:
    """How many of a column ``part`` make one of ``whole``; 0 where it is not its part."""
    import pyarrow

    for column in (whole, part):
        if column.null_count or not (pyarrow.types.is_integer(column.type) or pyarrow.types.is_floating(column.type)):
            return 0.0
    units, parts = whole.to_numpy(), part.to_numpy()
    size = next((size for size in _PARTS if len(parts) and _REACHED * size < np.max(parts) < size), 0.0)
    if not size or np.min(parts) < 0 or not all(np.all(values == np.rint(values)) for values in (units, parts)):
        return 0.0
    steps, anew = np.diff(parts), np.diff(units) != 0
    both = anew.any() and not anew.all()
    return size if both and min(np.mean(steps[~anew] > 0), np.mean(steps[anew] < 0)) > _IN_ORDER else 0.0


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
    with_names = [len({*names} & {cell for row in rows[:PREAMBLE] for cell in row}) for rows in sheets]
    most = max(with_names, default=0)
    alike = [name for name, count in zip(book.sheet_names, with_names, strict=True) if count == most > 0]
    if len(alike) > 1:
        listed = ", ".join(alike[:LISTED]) + (", …" if len(alike) > LISTED else "")
        tell(f"{path}: {len(alike)} sheets have these columns ({listed}); the first alone is read")
    rows = sheets[with_names.index(most)] if sheets else []
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


def _of_arrays(path: Path, found: dict[str, np.ndarray | list], names: list[str]):
    import pyarrow

    for name in names:
        if name not in found:
            # What describes a recording is shorter than its signals, and as often called alike.
            longest = max(map(len, found.values()), default=0)
            signals = [other for other, values in found.items() if 2 * len(values) > longest]
            raise InputError(f"{path}: {name}: no such variable of numbers; it has {some_of(name, signals)}")
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


def _is_clock(column) -> bool:
    import pyarrow

    if pyarrow.types.is_string(column.type):
        return any(cell and _CLOCK.fullmatch(cell.strip()) for cell in column.slice(0, PREAMBLE).to_pylist())
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
    decimal_comma = DECIMAL in (table.schema.field(name).metadata or {})
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


def _group_and_index(path: Path, file, name: str) -> tuple[int, int]:
    """Group and index of a channel in a measurement; several of the same name are distinguished by their group. Raises
    InputError: there is none, or several."""
    plain, _, group = name.rpartition(_IN_GROUP)
    places = [place for place in file.channels_db.get(plain, ()) if group.isdigit() and place[0] == int(group)]
    if not (places := places or list(file.channels_db.get(name, ()))):
        if _BUS in file.channels_db:
            raise InputError(f"{path}: {name}: the file holds CAN frames, which a mapping with `dbc` reads")
        known = some_of(name, list(file.channels_db))
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
