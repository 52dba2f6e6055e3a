"""Learned values, stored over a power cycle: one JSON file per corner, complete at every moment.

A file belongs to one actuator and one calibration; it contains the values in use and a bounded history. A file that cannot
be read, whose checksum is wrong or whose values are impossible for this brake is renamed and reported, and the corner starts
from its calibration.
"""

import contextlib
import fcntl
import os
import time
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.adapt import files
from emb_daemon.adapt.learned import Evaluation, why_out_of_bounds
from emb_daemon.adapt.records import ACCEPTED, OUTCOMES
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError, Unavailable

FORMAT = 2
#: Number of trainings in a file's history; age from which an unfinished file is no longer being written, s.
_HISTORY = 50
_ABANDONED_S = 3600.0


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The outcome of one training."""

    #: ISO 8601.
    date: str
    outcome: str
    #: Details of the outcome, such as a value and its bounds.
    note: str
    ambient_C: float | None
    pad_rise_K: float | None
    #: A partial calibration and its standard deviations, by the calibration's keys; empty unless accepted.
    values: dict[str, float]
    sigmas: dict[str, float]
    #: Figures for people, by name.
    evidence: dict[str, float | None]


class Store(files.Owned, frozen=True, kw_only=True):
    """One corner's file."""

    #: The last accepted training, whose values are in use.
    current: Entry | None
    history: tuple[Entry, ...]


def entry_of(outcome: int, evaluation: Evaluation, date: str, ambient_C: float, pad_rise_K: float) -> Entry:
    """An entry from a training's outcome and its evaluation."""

    def known(value) -> float | None:
        return float(value) if np.isfinite(value) else None

    accepted = outcome == ACCEPTED
    return Entry(
        date=date,
        outcome=OUTCOMES[outcome],
        note=evaluation.note,
        ambient_C=known(ambient_C),
        pad_rise_K=known(pad_rise_K),
        values=evaluation.values if accepted else {},
        sigmas=evaluation.sigmas if accepted else {},
        evidence={name: known(value) for name, value in evaluation.evidence.items()},
    )


def state_directory(configured: str | None, relative_to: Path) -> Path | None:
    """Folder for learned values: systemd's STATE_DIRECTORY, or else the configured one; None if there is neither."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    return relative_to / configured if configured else None


def hold(folder: Path) -> int:
    """Reserve a state directory, which may be read-only, for this process until it ends or the returned descriptor is closed.
    Raises InputError: it cannot be made. Raises Unavailable: another process uses it."""
    descriptor = os.open(Memory(folder).folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise Unavailable(f"{folder}: state directory is in use by another running process") from None
    return descriptor


class Memory:
    """The folder of learned values."""

    def __init__(self, folder: Path):
        """Raises InputError if the folder cannot be made."""
        self.folder: Path = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: not a usable state directory: {error.strerror}") from None

    def path(self, corner: str) -> Path:
        return self.folder / f"adaptation-{corner}.json"

    def read(self, corner: str) -> Store | None:
        """A corner's file; None if there is none. Raises ValueError: damaged. Raises OSError: not readable."""
        try:
            content = files.read(self.path(corner))
        except FileNotFoundError:
            return None
        return files.decode(content, Store, FORMAT)

    def load(self, corner: str, calibration: Calibration) -> tuple[Store, str | None]:
        """A corner's store for this calibration, empty if there is none; and a warning for the log or None.

        A file that is damaged, or contains values that are impossible for this brake, is set aside. A file of another actuator
        or calibration is not used, and stays until something new is learned."""
        path, ours = self.path(corner), files.owner(FORMAT, corner, calibration)
        self._sweep()
        store, warning = files.read_own(path, Store, ours)
        if store and store.current and (fault := why_out_of_bounds(calibration, store.current.values)):
            store, warning = None, f"{path}: refused ({fault}), {files.set_aside(path)}"
        return store or Store(**ours, current=None, history=()), warning

    def _sweep(self) -> None:
        """Remove unfinished files of writers that were killed long ago."""
        for path in self.folder.glob(".*.json.*"):
            with contextlib.suppress(OSError):
                if time.time() - path.stat().st_mtime > _ABANDONED_S:
                    path.unlink()

    def save(self, store: Store) -> None:
        """Raises OSError; the old file is then untouched."""
        files.write(self.path(store.corner), store)

    def reset(self, corner: str) -> bool:
        """Delete a corner's file, and keep a copy (`path_of_forgotten`); False if there was none."""
        try:
            self.path(corner).replace(self.path_of_forgotten(corner))
        except FileNotFoundError:
            return False
        return True

    def path_of_forgotten(self, corner: str) -> Path:
        """Path of the copy that the last reset kept."""
        return self.path(corner).with_suffix(".forgotten")


def with_entry(store: Store, entry: Entry) -> Store:
    """A store that has also seen ``entry``; an accepted one is now in use."""
    current = entry if entry.values else store.current
    return msgspec.structs.replace(store, current=current, history=(*store.history, entry)[-_HISTORY:])
