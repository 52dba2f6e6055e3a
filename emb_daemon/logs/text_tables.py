"""Tables as text, as measurement tools write them."""

import contextlib
import csv
import io
import itertools
import re
from collections.abc import Iterator
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

from emb_daemon.errors import InputError, tell
from emb_daemon.wire.units import known_as

#: What parts cells; last, any run of blanks.
_DELIMITERS = (",", ";", "\t", "|", " ")
#: Largest number of lines of text before a table's header, and of units between header and numbers.
PREAMBLE, _UNITS = 60, 3
#: Keys in a column's metadata: of its unit, and of the decimal comma of its table.
UNIT, DECIMAL = b"unit", b"decimal comma"
#: Number of column names listed if one was not found.
LISTED = 20
#: Name of a column by its number.
_BY_PLACE = re.compile(r"column ([1-9]\d*)")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
#: Number of octets of which every second is zero in UTF-16 without a byte order mark.
_MARK = 200
#: Letters of older tools of Western and Central Europe, Russia, China, Japan and Korea.
_LETTERS = ("latin-1", "cp1252", "cp1250", "cp1251", "gb18030", "cp932", "cp949")
#: A value that its line names, as a serial port's text does: ``Time: 5001 Force=3.2 N``; share of the first lines that must
#: name the same values.
_LABELLED, _MOSTLY = re.compile(rb"([A-Za-z_]\w*)\s*[:=]\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?=[\s,;|]|$)"), 0.8
#: Fewest values of a signal that has a line of its own.
_ACROSS = 200
#: A line's end before a separator.
_LEFT_IN_CELLS = re.compile(rb"\r(?=[,;|\t])")
#: How a trace of a PLC begins, and a time in it.
_TRACE, _TIME = re.compile(rb"\s*\[key\]\s*;\s*\[value\]", re.IGNORECASE), re.compile(rb"-?\d+(?:[.,]\d+)?")
#: A semicolon at the end of a line.
_ENDED = re.compile(rb"(?m);[ \t]*(?=\r?$)")
#: A name in quotes of a few lines, which begins and ends a cell.
_BROKEN = re.compile(rb'(?m)(?:(?<=[,;|\t ])|^)"[^",;|\t\n]{,50}(?:\r?\n[^",;|\t\n]{,50}){1,3}"(?=[,;|\t\r]|$)')
#: Lines at the end of a text that do not begin with a number.
_WORDS = re.compile(rb'(?:(?:^|\n)(?![ \t"]*[+-]?[\d.,]).*)+\Z')
#: Cells that mean that nothing was measured.
_NOTHING = ["", "-", "--", "---", "NA", "N/A", "#N/A", "n/a", "NaN", "nan", "NULL", "null", "None"]


def place_of(name: str, names: list[str]) -> int | None:
    """Index of a column among a table's ``names``, by name or by number; None if there is none, or several."""
    # A blank that breaks no line looks like any other, and the mark of a comment before a header is none of its first name.
    alike = [" ".join(known.split()) for known in names] if name not in names else names
    name = name if name in alike else name.lstrip("#% ")
    if alike.count(name) == 1:
        return alike.index(name)
    place = _BY_PLACE.fullmatch(name)
    return int(place[1]) - 1 if place and int(place[1]) <= len(names) else None


def some_of(wanted: str, names: list[str]) -> str:
    """Names to list if one was misspelt: all, or the most similar ones."""
    return ", ".join(names if len(names) <= LISTED else [*get_close_matches(wanted, names, LISTED, 0.0), "…"]) or "none"


def read_text(path: Path, content: bytes, names: list[str]) -> Any:
    """A table (pyarrow) from text, as measurement tools write it: text before the header and units after it are skipped, rows
    with another number of cells (a truncated last one) left out, with a note on stderr."""
    content = _as_utf8(content, names)
    if b"\n" not in content:
        content = content.replace(b"\r", b"\n")
    # Where Windows' files of one column each were put side by side, a line's end is left in every cell.
    content = _LEFT_IN_CELLS.sub(b"", content)
    content = _in_one_line(_upright(path, _unlabelled(_unterminated(_traced(content)))))
    lines = [
        line.decode(errors="replace").rstrip("\r") for line in content.split(b"\n", PREAMBLE + _UNITS)[: PREAMBLE + _UNITS]
    ]
    header, delimiter = _find_header(lines, names)
    content = _under_one_header(path, content, header)
    header, delimiter, cells = _find_names(lines, header, delimiter, names)
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
    parse = partial(_parse, content, header + 1 + units, delimiter)
    table, odd = parse(cells, ".")
    reached = odd[0].actual_columns if len(odd) > table.num_rows else len(cells)
    if reached < len(cells) and {*names} <= {*cells[:reached]} | {f"column {n + 1}" for n in range(reached)}:
        more = ", ".join(filter(None, cells[reached:]))
        tell(f"{path}: rows have {reached} cells, the header {len(cells)}; its last name nothing: {more}")
        cells = cells[:reached]
        table, odd = parse(cells, ".")
    # A comma that does not separate is decimal; it may occur for the first time after many rows.
    commas = delimiter != "," and any(map(_DECIMAL_COMMA.fullmatch, _words(table, names)))
    if commas:
        table, odd = parse(cells, ",")
    if len(odd) > table.num_rows:
        raise InputError(
            f"{path}: {len(odd)} of {len(odd) + table.num_rows} rows have another number of cells than {len(cells)}, the "
            f"first of them {odd[0].actual_columns}; expected a table with the columns {some_of('', cells)}"
        )
    if odd:
        tell(f"{path}: {len(odd)} rows with another number of cells than {len(cells)} left out")
    return _with_units(table, rows[:units], {DECIMAL: b","} if commas else {})


def _find_header(lines: list[str], names: list[str]) -> tuple[int, str]:
    """Row of the header, and its separator: the line with most of the names, below which lines have its separator. What stands
    before it is the tool's own text."""
    return max(
        ((row, mark) for row in range(min(len(lines), PREAMBLE)) for mark in _DELIMITERS),
        key=lambda at: (
            len({*names} & {*_cells(lines[at[0]], at[1])}) * _parts(lines[at[0] + 1 : at[0] + 2 + _UNITS], at[1]),
            -at[0],
            at[1] != " ",
            lines[at[0]].count(at[1]),
        ),
    )


def _find_names(lines: list[str], header: int, delimiter: str, names: list[str]) -> tuple[int, str, list[str]]:
    """(row after which the table begins, separator, names of the columns); where no header has any of the ``names``, places
    stand for them, or what stands above the numbers is told."""
    cells = _cells(lines[header], delimiter)
    if {*names} & {*cells}:
        return header, delimiter, cells
    if not (found := _without_header(lines, all(map(_BY_PLACE.fullmatch, names)))):
        header, delimiter = _above_numbers(lines) or (header, delimiter)
        return header, delimiter, _cells(lines[header], delimiter)
    header, delimiter = found
    above = _cells(lines[header], delimiter) if header >= 0 else []
    cells = [f"column {number + 1}" for number in range(len(_cells(lines[header + 1], delimiter)))]
    # By their names columns of times are known to be such.
    return header, delimiter, above if len(above) == len(cells) and not any(map(_is_number, above)) else cells


def _parse(content: bytes, skipped: int, delimiter: str, cells: list[str], decimal_point: str) -> tuple[Any, list]:
    """(table of the lines after those that are ``skipped``, rows with another number of cells, which it lacks)."""
    import pyarrow.csv

    odd = []

    def leave_out(row) -> str:
        odd.append(row)
        return "skip"

    table = pyarrow.csv.read_csv(
        io.BytesIO(content),
        # The handler is called from one thread only.
        pyarrow.csv.ReadOptions(skip_rows=skipped, column_names=cells, use_threads=False),
        pyarrow.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=leave_out),
        pyarrow.csv.ConvertOptions(decimal_point=decimal_point, null_values=_NOTHING, strings_can_be_null=True),
    )
    return table, odd


def _words(table: Any, names: list[str]) -> Iterator[str]:
    """Cells of the named columns that are text."""
    import pyarrow

    places = (place_of(name, table.column_names) for name in names)
    columns = (table.column(place) for place in places if place is not None)
    return (cell.strip() for text in columns if pyarrow.types.is_string(text.type) for cell in text.to_pylist() if cell)


def _with_units(table: Any, above: list[list[str]], marks: dict) -> Any:
    """The table with ``marks`` on its columns, and the unit that one of the rows ``above`` states of each."""
    import pyarrow

    stated = [next(filter(None, map(known_as, column)), "") for column in itertools.zip_longest(*above, fillvalue="")]
    fields = [
        field.with_metadata(marks | ({UNIT: unit} if unit else {}))
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
    *lines, rest = content.split(b"\n", PREAMBLE)
    above = _BROKEN.sub(lambda found: b" ".join(found[0].split()), b"\n".join(lines))
    return b"\n".join([above, rest]) if lines else content


def _are_pairs(names: list[str], rows: list[list[str]]) -> bool:
    """Whether each name stands over two columns, of which the first are the same time in each row."""
    alternate = len(names) > 2 and all(names[::2]) and not any(names[1::2])
    return alternate and any(rows) and all(len({*row[: len(names) : 2]} - {""}) == 1 for row in rows if row)


def _unterminated(content: bytes) -> bytes:
    """Rows without the semicolon that ends each of a matrix as MATLAB writes it, if another separator parts their cells."""
    lines = [line.rstrip() for line in content.split(b"\n", PREAMBLE)[:PREAMBLE] if line.strip()]
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


def _traced(content: bytes) -> bytes:
    """A trace of a PLC (CODESYS, ctrlX), which has keys and then each variable's times and values, one variable below the
    other, as a table of the variables by ``Time``; any other text as it is."""
    if _TRACE.match(content) is None:
        return content
    names: dict[bytes, bytes] = {}
    rows: dict[bytes, dict[bytes, bytes]] = {}
    number = b""
    for line in content.split(b"\n"):
        key, *cells = (cell.strip() for cell in line.split(b";"))
        if key.endswith(b".Variable"):
            names[key.removesuffix(b".Variable")] = cells[0] if cells else b""
        elif key.endswith(b".Data"):
            number = key.removesuffix(b".Data")
        elif not key and len(cells) == 2 and number in names and _TIME.fullmatch(cells[0]):
            rows.setdefault(cells[0], {})[number] = cells[1]
    # Variables of several tasks come at times of their own.
    times = sorted(rows, key=lambda time: float(time.replace(b",", b".")))
    table = [[b"Time", *names.values()], *([time, *(rows[time].get(n, b"") for n in names)] for time in times)]
    return b"\n".join(map(b";".join, table))


def _unlabelled(content: bytes) -> bytes:
    """A serial port's lines that name each value in it (``Time: 5001 Position: 594``) as a table with these names as header;
    any other text as it is. A line that has not the same names stays as it is."""
    lines = content.split(b"\n")
    told = [tuple(name for name, _ in _LABELLED.findall(line)) for line in lines[:PREAMBLE] if line.strip()]
    names = max(told, key=told.count, default=())
    if len(set(names)) < 2 or told.count(names) < _MOSTLY * len(told):
        return content
    result = [b",".join(names)]
    for line in lines:
        found = _LABELLED.findall(line)
        result.append(b",".join(value for _, value in found) if tuple(name for name, _ in found) == names else line)
    return b"\n".join(result)


def _upright(path: Path, content: bytes) -> bytes:
    """A table that has a line for each signal, with its name or without, with a column for each; any other text as it is."""
    lines = [line for line in content.split(b"\n", PREAMBLE) if line.strip()]
    # The comma last, because it may be decimal.
    marks = (mark for mark in (";", "\t", "|", ",", " ") if lines and lines[0].count(mark.encode()) >= _ACROSS - 1)
    if (mark := next(marks, None)) is None or not 1 < len(lines) < PREAMBLE:
        return content
    rows = [_cells(line.decode(errors="replace"), mark) for line in lines]
    if len({*map(len, rows)}) > 1 or not all(_is_number(cell) for row in rows for cell in row[1:] if cell not in _NOTHING):
        return content
    tell(f"{path}: each of the {len(rows)} lines has {len(rows[0])} cells: each is taken for a signal")
    text = io.StringIO()
    csv.writer(text, delimiter=mark).writerows(zip(*rows, strict=True))
    return text.getvalue().encode()


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
