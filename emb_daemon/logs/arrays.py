"""Variables of MATLAB, NumPy, HDF5, TDMS and JSON files as columns."""

import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError, tell
from emb_daemon.logs.read import needs_extra

ENDINGS = (".mat", ".npz", ".npy", ".h5", ".hdf5", ".tdms", ".json", ".jsonl", ".ndjson")
#: How files of some formats begin, whatever they are called: the format's ending.
_BEGINNINGS = {b"\x89HDF": ".h5", b"TDSm": ".tdms", b"\x93NUMPY": ".npy", b"MATLAB 5.0": ".mat", b"MATLAB 7.3": ".h5"}


def array_ending(content: bytes, ending: str) -> str:
    """The format of a file of variables as one of `ENDINGS`, by how it begins or else by its ``ending``; empty of others."""
    found = next((format for beginning, format in _BEGINNINGS.items() if content.startswith(beginning)), "")
    return found or (ending if ending in ENDINGS else "")


def read_arrays(path: Path, content: bytes, ending: str) -> dict[str, np.ndarray | list[object]]:
    """Columns, n values each, by name: a variable with more than one value, `S.x` of the field of a structure or the dataset
    of a group, `X column 2` of a matrix, whose rows are its longer side. Of a bare array `column 2` is one.

    Raises:
        InputError: unreadable.
    """
    columns: dict[str, np.ndarray | list[object]] = {}
    try:
        for name, variable in _READERS[ending](path, content):
            _add(columns, name, variable)
    except ImportError as error:
        raise needs_extra(path, error, "formats") from None
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not readable: {text}") from None
    return columns


def _of_matlab(_path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    from scipy.io import loadmat

    for name, variable in loadmat(io.BytesIO(content), squeeze_me=True).items():
        # Names with two lines before them are what the file says of itself.
        if not name.startswith("__"):
            yield name, np.asarray(variable)


def _of_numpy(_path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    found = np.load(io.BytesIO(content), allow_pickle=False)
    if isinstance(found, np.ndarray):
        yield "", found
    else:
        with found:
            yield from found.items()


def _of_hdf5(_path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Datasets by their groups, `group.dataset`; those of a MATLAB 7.3 file are its variables."""
    import h5py

    found = []
    with h5py.File(io.BytesIO(content)) as file:
        # What begins with a # is MATLAB's own, not a variable.
        file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) and name[0] != "#" else None)
        for name in found:
            if file[name].size:
                yield name.replace("/", "."), file[name][()]


def _of_tdms(_path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """LabVIEW's channels, `group.channel`."""
    from nptdms import TdmsFile

    for group in TdmsFile.read(io.BytesIO(content)).groups():
        for channel in group.channels():
            values = channel[:]
            if values.dtype.kind == "M":
                values = 1e-9 * values.astype("datetime64[ns]").astype(np.int64)
            yield f"{group.name}.{channel.name}", values


def _of_json(path: Path, content: bytes) -> Iterator[tuple[str, object]]:
    """One value, or one on each line, as loggers write them; a last line that was cut off is left out."""
    text = content.decode("utf-8-sig")
    try:
        yield "", json.loads(text)
        return
    except ValueError as error:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2:
            raise error
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(json.loads(line))
        except ValueError:
            if number < len(lines):
                raise
            tell(f"{path}: its last line is cut off, left out")
    yield "", rows


_READERS = {
    ".mat": _of_matlab, ".npz": _of_numpy, ".npy": _of_numpy, ".h5": _of_hdf5, ".hdf5": _of_hdf5, ".tdms": _of_tdms,
    ".json": _of_json, ".jsonl": _of_json, ".ndjson": _of_json,
}  # fmt: skip


def _add(columns: dict[str, np.ndarray | list[object]], name: str, variable) -> None:
    if isinstance(variable, dict) and all(key.isdigit() and not isinstance(v, (dict, list)) for key, v in variable.items()):
        # pandas numbers the rows of a column.
        variable = list(variable.values())
    if isinstance(variable, dict):
        for key, value in variable.items():
            _add(columns, _within(name, key), value)
        return
    if isinstance(variable, list):
        if variable and all(isinstance(row, dict) for row in variable):
            keys = dict.fromkeys(key for row in variable for key in row)
            _add(columns, name, {key: [row.get(key) for row in variable] for key in keys})
            return
        if any(isinstance(value, str) for value in variable):
            columns[name] = [value if value is None else str(value) for value in variable]
            return
        try:
            variable = np.array(variable, float)
        except (TypeError, ValueError):
            # Lists of several lengths and objects among numbers are no column.
            return
    variable = np.asarray(variable).squeeze()
    if variable.dtype.names:
        for field in variable.dtype.names:
            part = variable[field]
            _add(columns, _within(name, field), np.asarray(part.item() if part.dtype == object and part.ndim == 0 else part))
    elif variable.dtype.kind in "biuf" and variable.ndim == 1:
        columns[name or "column 1"] = variable
    elif variable.dtype.kind in "biuf" and variable.ndim == 2:
        rows = variable if variable.shape[0] >= variable.shape[1] else variable.T
        columns |= {f"{name} column {number + 1}".lstrip(): rows[:, number] for number in range(rows.shape[1])}


def _within(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key
