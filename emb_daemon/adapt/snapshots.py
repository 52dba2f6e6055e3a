"""Snapshots of an estimator's state, stored over a restart: one JSON file per corner.

The estimator decides which quantities a snapshot contains, and by how much their uncertainty has grown at the restart (a
record dtype, with functions that fill it and start from it). This module stores the record under its field names, with the
time of the real-time clock, and returns it only for the same actuator with the same calibration, learned values included.
"""

from pathlib import Path

import numpy as np

from emb_daemon.adapt import files
from emb_daemon.calibration.types import Calibration

_FORMAT = 1


class Snapshot(files.Owned, frozen=True, kw_only=True):
    """One corner's file, of the calibration in use, learned values included."""

    #: Time of the snapshot, CLOCK_REALTIME.
    time_ns: int
    #: Values by field name of the dtype; arrays as nested lists, null for NaN.
    state: dict[str, object]


def to_fields(record: np.void) -> dict[str, object]:
    """A record, nested ones included, as names and plain values. An infinite value is stored as NaN; both mean unknown."""
    names = record.dtype.names
    return {name: to_fields(record[name]) if record[name].dtype.names else record[name].tolist() for name in names}


def from_fields(fields: dict[str, object], dtype: np.dtype) -> np.void:
    """The record of ``dtype`` that `to_fields` was given. Raises ValueError: other fields, or another shape or type of one;
    names it."""
    if not isinstance(fields, dict) or fields.keys() != set(dtype.names):
        raise ValueError(f"state: expected the fields {', '.join(dtype.names)}")
    record = np.zeros(1, dtype)[0]
    for name in dtype.names:
        kind = dtype[name]
        if kind.names:
            record[name] = from_fields(fields[name], kind)
            continue
        try:
            value = np.array(fields[name], object)
            value[value == None] = np.nan  # noqa: E711
            value = value.astype(kind.base, casting="unsafe")
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"state.{name}: expected {kind}") from None
        if value.shape != kind.shape:
            raise ValueError(f"state.{name}: expected {kind}")
        record[name] = value
    return record


class Snapshots:
    """The snapshots, records of ``dtype``, of an existing folder."""

    def __init__(self, folder: Path, dtype: np.dtype):
        self._folder, self._dtype = folder, dtype

    def path(self, corner: str) -> Path:
        return self._folder / f"restart-{corner}.json"

    def save(self, corner: str, calibration: Calibration, record: np.void, time_ns: int) -> None:
        """Store a record of ``dtype``. Raises OSError; the old file is then unchanged."""
        ours = files.owner(_FORMAT, corner, calibration)
        files.write(self.path(corner), Snapshot(**ours, time_ns=time_ns, state=to_fields(record)))

    def load(self, corner: str, calibration: Calibration) -> tuple[np.void | None, int, str | None]:
        """The snapshot of a corner with this calibration in use, or None; its time in ns (CLOCK_REALTIME); and a warning for
        the log or None. A file that is damaged, or of a version of this program whose state is another, is set aside; one of
        another actuator or calibration is not used."""
        path = self.path(corner)
        found, warning = files.read_own(path, Snapshot, files.owner(_FORMAT, corner, calibration))
        if found is None:
            return None, 0, warning
        try:
            return from_fields(found.state, self._dtype), found.time_ns, None
        except ValueError as error:
            return None, 0, f"{path}: of another version of emb_daemon ({error}), {files.set_aside(path)}"
