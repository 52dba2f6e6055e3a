"""Tables of estimates and logs of frames, by the output file's ending; whole or not at all."""

import os
import tempfile
from pathlib import Path

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import MODES, SOURCES
from emb_daemon.logs.candump import format_candump
from emb_daemon.wire.layout import CORNERS

TABLE_ENDINGS = (".csv", ".parquet")
FRAME_ENDINGS = (".log", ".blf", ".asc", ".trc", ".mf4")


def table_columns(estimates: np.ndarray, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of the command-line contract, from ESTIMATE rows."""
    e = estimates
    columns: dict[str, np.ndarray] = {
        "time_s": time_s,
        "corner": np.array(CORNERS)[e["corner"]],
        "clamp_force_N": e["force"],
        "clamp_force_sigma_N": e["sigma"],
        "stiffness_force_N": e["stiffness_force"],
        "torque_force_N": e["torque_force"],
        "ml_force_N": e["ml_force"],
        "contact_angle_rad": e["contact_angle"],
        "stiffness_factor": e["stiffness_factor"],
        "inner_surface_C": e["surface"][:, 0],
        "inner_mean_C": e["mean"][:, 0],
        "outer_surface_C": e["surface"][:, 1],
        "outer_mean_C": e["mean"][:, 1],
    }
    for side, name in enumerate(("inner", "outer")):
        for index, depth in enumerate((2, 4, 6, 8)):
            columns[f"{name}_{depth}mm_C"] = e["depth"][:, side, index]
    columns["disc_C"] = e["disc"]
    columns["mode"] = np.array(MODES)[e["mode"]]
    names = np.full(16, "", dtype=object)
    for code, name in SOURCES.items():
        names[code] = name
    columns["source"] = names[e["source"]].astype(str)
    return columns


def write_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    """CSV or Parquet by ending; a NaN is an empty cell."""
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    table = pyarrow.table({name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()})
    sink = pyarrow.BufferOutputStream()
    if path.suffix.lower() == ".csv":
        pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(quoting_style="none"))
    else:
        pyarrow.parquet.write_table(table, sink)
    _write(path, sink.getvalue().to_pybytes())


def write_frames(path: Path, frames: np.ndarray) -> None:
    """A CAN log of FRAME rows, by ending."""
    if path.suffix.lower() == ".log":
        return _write(path, format_candump(frames).encode())
    import can

    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        part = Path(folder) / path.name
        try:
            with can.Logger(part) as logger:
                for frame in frames:
                    data = int(frame["data"]).to_bytes(8, "little")[: frame["length"]]
                    logger(
                        can.Message(
                            timestamp=1e-9 * int(frame["time_ns"]),
                            arbitration_id=int(frame["can_id"]),
                            data=data,
                            is_extended_id=False,
                        )
                    )
        except ImportError as error:
            raise InputError(f"{path}: writing this format needs an extra: pip install emb_daemon[mf4] ({error})") from None
        os.replace(part, path)


def _write(path: Path, content: bytes) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
