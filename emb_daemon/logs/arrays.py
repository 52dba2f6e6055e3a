"""Variables of MATLAB and NumPy files as columns."""

import io
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError

ENDINGS = (".mat", ".npz")


def read_arrays(path: Path, content: bytes, ending: str) -> dict[str, np.ndarray]:
    """Columns, shape (n,) each, by name: a variable with more than one value, `S.x` of the field of a structure, `X column 2`
    of a matrix, whose rows are its longer side.

    Raises:
        InputError: unreadable.
    """
    try:
        if ending == ".npz":
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                variables = {name: file[name] for name in file.files}
        else:
            from scipy.io import loadmat

            variables = loadmat(io.BytesIO(content), squeeze_me=True)
    except NotImplementedError:
        raise InputError(f"{path}: is of MATLAB 7.3 (HDF5); expected one saved with -v7, or a table") from None
    except Exception as error:
        text = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not readable: {text}") from None
    columns: dict[str, np.ndarray] = {}
    for name, variable in variables.items():
        if name.startswith("__"):
            # What the file says of itself.
            continue
        _add(columns, name, np.asarray(variable))
    return columns


def _add(columns: dict[str, np.ndarray], name: str, variable: np.ndarray) -> None:
    variable = variable.squeeze()
    if variable.dtype.names:
        for field in variable.dtype.names:
            part = variable[field]
            _add(columns, f"{name}.{field}", np.asarray(part.item() if part.dtype == object and part.ndim == 0 else part))
    elif variable.dtype.kind in "biuf" and variable.ndim == 1:
        columns[name] = variable
    elif variable.dtype.kind in "biuf" and variable.ndim == 2:
        rows = variable if variable.shape[0] >= variable.shape[1] else variable.T
        columns |= {f"{name} column {number + 1}": rows[:, number] for number in range(rows.shape[1])}
