"""Variables of MATLAB, NumPy, HDF5, TDMS and JSON files as columns."""

import io
import json
from collections.abc import Callable, Iterator
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
    of a group, `S(2).x` of one of several structures, `c{2}` of cells, `X column 2` of a matrix, whose rows are its longer
    side. Of a bare array `column 2` is one. Raises InputError: unreadable."""
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


def _of_matlab(path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    for name, variable in loadmat(io.BytesIO(content), squeeze_me=True).items():
        if isinstance(variable, MatlabOpaque):
            named, _, kind, _ = variable.item() if variable.ndim == 0 else variable[0]
            _tell_object(path, named.decode(), kind.decode())
        # Names with two lines before them are what the file says of itself.
        elif not name.startswith("__"):
            yield name, np.asarray(variable)


def _tell_object(path: Path, name: str, kind: str) -> None:
    tell(f"{path}: {name} is a {kind} of MATLAB, which only MATLAB reads; save its columns as variables of their own")


def _of_numpy(_path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    found = np.load(io.BytesIO(content), allow_pickle=False)
    if isinstance(found, np.ndarray):
        yield "", found
    else:
        with found:
            yield from found.items()


def _of_hdf5(path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Datasets by their groups, `group.dataset`; those of a MATLAB 7.3 file are its variables, of which cells and arrays of
    structures refer to their parts."""
    import h5py

    def parts(group, name: str, item) -> Iterator[tuple[str, np.ndarray]]:
        if isinstance(item, h5py.Group):
            for key, part in item.items():
                # What begins with a # is MATLAB's own, not a variable.
                if key[0] != "#":
                    yield from parts(name, _within(name, key), part)
        elif "MATLAB_object_decode" in item.attrs:
            _tell_object(path, name, bytes(item.attrs["MATLAB_class"]).decode())
        elif item.dtype == h5py.ref_dtype:
            key = name.removeprefix(group).removeprefix(".")
            in_cells = not group or item.attrs.get("MATLAB_class") == b"cell"
            for number, reference in enumerate(item[()].ravel(), 1):
                called = f"{name}{{{number}}}" if in_cells else f"{group}({number}).{key}"
                yield from parts(called, called, item.file[reference])
        elif item.size:
            yield name, item[()]

    with h5py.File(io.BytesIO(content)) as file:
        yield from parts("", "", file)


def _of_tdms(_path: Path, content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    from nptdms import TdmsFile

    for group in TdmsFile.read(io.BytesIO(content)).groups():
        for channel in group.channels():
            yield f"{group.name}.{channel.name}", channel[:]


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
        if any(variable) and all(row is None or isinstance(row, dict) for row in variable):
            rows = [row or {} for row in variable]
            keys = dict.fromkeys(key for row in rows for key in row)
            _add(columns, name, {key: [row.get(key) for row in rows] for key in keys})
            return
        if any(isinstance(value, str) for value in variable):
            columns[name] = [value if value is None else str(value) for value in variable]
            return
        parts = [part for part in variable if part is not None]
        if all(isinstance(part, list) for part in parts) and len({len(part) for part in parts}) > 1:
            # Batches of a buffer, steps of a sequence: one recording, part after part.
            _add(columns, name, [value for part in parts for value in part])
            return
        try:
            variable = np.array(variable, float)
        except (TypeError, ValueError):
            # Objects among numbers are no column.
            return
    variable = np.asarray(variable).squeeze()
    if variable.dtype.names:
        for field in variable.dtype.names:
            part = variable[field]
            if part.dtype == object and part.ndim == 1:
                _add_parts(columns, _within(name, field), part, lambda number, field=field: f"{name}({number}).{field}")
            else:
                _add(columns, _within(name, field), part.item() if part.dtype == object and part.ndim == 0 else part)
    elif variable.dtype == object and variable.ndim == 1:
        _add_parts(columns, name, variable, lambda number: f"{name}{{{number}}}")
    elif variable.dtype.kind == "U" and variable.ndim == 1:
        columns[name] = variable.tolist()
    elif variable.dtype.kind in "biufMm" and variable.ndim == 1:
        columns[name or "column 1"] = variable
    elif variable.dtype.kind in "biuf" and variable.ndim == 2:
        rows = variable if variable.shape[0] >= variable.shape[1] else variable.T
        columns |= {f"{name} column {number + 1}".lstrip(): rows[:, number] for number in range(rows.shape[1])}


def _add_parts(
    columns: dict[str, np.ndarray | list[object]], name: str, parts: np.ndarray, called: Callable[[int], str]
) -> None:
    """MATLAB's cells, or one field of an array of structures: a column if each is a number or a text, otherwise as many
    variables, ``called`` by their number."""
    parts = [np.asarray(part).squeeze() for part in parts]
    if all(part.ndim == 0 and part.dtype.kind in "biufU" for part in parts):
        _add(columns, name, [part.item() for part in parts])
    else:
        for number, part in enumerate(parts, 1):
            _add(columns, called(number), part)


def _within(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key
