"""Columns of tables and channels of measurements: logs that hold signals instead of CAN frames."""

import hashlib
import io
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.logs.read import log_ending, needs_extra, read_file, unpack_gzip
from emb_daemon.wire.units import UNITS

_MEASUREMENTS = (".mf4", ".mdf", ".dat")
_DELIMITERS = (",", ";", "\t")


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
    columns = _columns(path, content, ending, [time.signal, *names])
    factor = UNITS[time.unit][1]
    seconds = columns.pop(time.signal) * factor
    known = np.isfinite(seconds)
    stamps = np.rint(1e9 * seconds[known]).astype(np.int64)
    return {name: (stamps, values[known]) for name, values in columns.items()}, digest


def _columns(path: Path, content: bytes, ending: str, names: list[str]) -> dict[str, np.ndarray]:
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    try:
        if ending == ".parquet":
            table = pyarrow.parquet.read_table(io.BytesIO(content))
        else:
            header, _, rest = content.partition(b"\n")
            delimiter = max(_DELIMITERS, key=header.decode(errors="replace").count)
            # Where a comma does not separate, it is a decimal one.
            point = "," if delimiter != "," and b"," in rest.partition(b"\n")[0] else "."
            table = pyarrow.csv.read_csv(
                io.BytesIO(content),
                parse_options=pyarrow.csv.ParseOptions(delimiter=delimiter),
                convert_options=pyarrow.csv.ConvertOptions(decimal_point=point),
            )
    except pyarrow.ArrowException as error:
        raise InputError(f"{path}: not readable: {str(error).splitlines()[0]}") from None
    columns = {}
    for name in dict.fromkeys(names):
        if (count := table.column_names.count(name)) != 1:
            there = "no such column" if count == 0 else f"{count} such columns"
            raise InputError(f"{path}: {name}: {there}; the table has {', '.join(table.column_names)}")
        try:
            columns[name] = table[name].cast(pyarrow.float64()).to_numpy()
        except pyarrow.ArrowException:
            raise InputError(f"{path}: {name}: expected a column of numbers, found {table[name].type}") from None
    return columns


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
                stamps = start_ns + np.rint(1e9 * signal.timestamps).astype(np.int64)
                found[name] = (stamps, np.asarray(signal.samples).astype(float))
            return found
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not readable as a measurement: {text}") from None
