"""Tables of estimates and logs of frames, by the output file's ending; a file is written completely or not at all."""

import datetime
import importlib
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from emb_daemon.atomic import name_in_errors, write_atomically
from emb_daemon.interface.signals import OUTPUTS
from emb_daemon.logs.candump import format_candump
from emb_daemon.logs.columns import DEPTHS_MM, References, latest
from emb_daemon.logs.read import needs_extra
from emb_daemon.wire.contract import MODES, SOURCES, reason_words
from emb_daemon.wire.frames import message_of
from emb_daemon.wire.layout import CORNERS

TABLE_ENDINGS = (".csv", ".parquet", ".signals.mf4")
FRAME_ENDINGS = (".log", ".blf", ".asc", ".trc", ".mf4")

#: Descriptions of table columns, for formats that can store them.
_COMMENTS = {signal.name: signal.meaning for signal in OUTPUTS}
_COMMENTS |= {"reasons": "why not to trust the row, joined by '; '", "corner": "wheel"}
_UNITS = {"N": "N", "Nm": "Nm", "rad": "rad", "C": "degC"}
#: Signals without a column.
_NOT_WRITTEN = ("stiffness_force_sigma_N", "torque_force_sigma_N", "contact_angle_sigma_rad", "reasons", "facts")


def ending_of(path: Path) -> str:
    """The ending that decides an output's format: the last one, or ``.signals.mf4`` for measurement channels instead of CAN
    frames."""
    return ".signals.mf4" if path.name.lower().endswith(".signals.mf4") else path.suffix.lower()


def table_columns(estimates: np.ndarray, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of the command-line contract, from ESTIMATE rows."""
    columns: dict[str, np.ndarray] = {"time_s": time_s, "corner": _texts(CORNERS, estimates["corner"])}
    for signal in OUTPUTS:
        if signal.name not in _NOT_WRITTEN:
            name, *indices = re.findall(r"\w+", signal.field)
            columns[signal.name] = estimates[name][:, *map(int, indices)]
    columns["mode"] = _texts(MODES, columns["mode"])
    columns["source"] = _texts([SOURCES.get(code, "") for code in range(16)], columns["source"])
    raised, codes = np.unique(estimates["reasons"], return_inverse=True)
    columns["reasons"] = _texts(["; ".join(reason_words(value)) for value in raised], codes)
    return columns


def _texts(known: Sequence[str], codes: np.ndarray) -> np.ndarray:
    """The text of each code, shape (n,), as references: written out, the reasons of a week take a gigabyte."""
    return np.array(known, dtype=object)[codes]


def reference_columns(reference: References, time_ns: np.ndarray, force_N: np.ndarray) -> dict[str, np.ndarray]:
    """Measurements of a rig's instruments at the samples, as far as it has them: force and torque of the nearest frame (NaN
    where none is near), temperatures as last heard."""
    columns = {
        "clamp_force_ref_N": force_N,
        "brake_torque_ref_Nm": reference.at(time_ns, reference.brake_torque_Nm),
        "disc_ref_C": reference.latest(time_ns, reference.disc_C),
    }
    for side, (stamps, depths) in reference.pads.items():
        for depth, values in zip(DEPTHS_MM, depths, strict=True):
            columns[f"{side}_{depth}mm_ref_C"] = latest(stamps, values, time_ns)
    return {name: values for name, values in columns.items() if np.isfinite(values).any()}


def write_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    """CSV, Parquet or an MDF4 measurement by ending; a NaN is an empty cell, or an invalid sample."""
    if ending_of(path) == ".signals.mf4":
        return _write_measurement(path, columns)
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    table = pyarrow.table({name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()})
    sink = pyarrow.BufferOutputStream()
    if path.suffix.lower() == ".csv":
        pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(quoting_style="none"))
    else:
        pyarrow.parquet.write_table(table, sink)
    write_atomically(path, memoryview(sink.getvalue()))


def _write_measurement(path: Path, columns: dict[str, np.ndarray]) -> None:
    """MDF4 as measurement tools open it: one channel group, channels with unit and comment, texts as value tables."""
    try:
        from asammdf import MDF, Signal
    except ImportError as error:
        raise needs_extra(path, error) from None
    # A measurement's times count from its start, because viewers add the two.
    start_s = np.floor(columns["time_s"][0]) if len(columns["time_s"]) else 0.0
    signals = []
    for name, values in columns.items():
        if name == "time_s":
            continue
        unit = _UNITS.get(name.rpartition("_")[2], "")
        comment = "reference instrument of the rig" if "_ref_" in name else _COMMENTS.get(name, "")
        conversion = None
        if values.dtype.kind in "UO":
            texts, values = np.unique(values, return_inverse=True)
            values = values.astype(np.uint8)
            conversion = {f"val_{code}": code for code in range(len(texts))}
            conversion |= {f"text_{code}": text.encode() for code, text in enumerate(texts.tolist())}
        signals.append(
            Signal(values, columns["time_s"] - start_s, name=name, unit=unit, comment=comment, conversion=conversion)
        )
    with name_in_errors(path), tempfile.TemporaryDirectory(dir=path.parent) as folder:
        with MDF(version="4.10") as file:
            file.header.start_time = datetime.datetime.fromtimestamp(start_s, datetime.UTC)
            file.append(signals, acq_name="emb_daemon", comment="estimates of emb_daemon replay", common_timebase=True)
            part = file.save(Path(folder) / "signals.mf4", compression=2)
        os.replace(part, path)


def write_frames(path: Path, frames: np.ndarray) -> None:
    """A CAN log of FRAME rows, by ending."""
    if path.suffix.lower() == ".log":
        return write_atomically(path, format_candump(frames).encode())
    import can

    if path.suffix.lower() == ".mf4":
        # Commands have imported it without asammdf (`wire.light_can`).
        importlib.reload(can.io.mf4)
    with name_in_errors(path), tempfile.TemporaryDirectory(dir=path.parent) as folder:
        # python-can takes everything after the first dot of a name for the format.
        part = Path(folder) / f"frames{path.suffix.lower()}"
        try:
            with can.Logger(part) as logger:
                for frame in frames:
                    logger(message_of(frame))
        except ImportError as error:
            raise needs_extra(path, error) from None
        os.replace(part, path)
