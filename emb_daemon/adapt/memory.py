"""What adaptation has learned, kept over a power cycle: one JSON file per corner, whole at every moment.

A file belongs to one actuator and one calibration; it holds the values now in use and a bounded history. A file that cannot
be read, or whose checksum is wrong, is set aside under another name and named, and the corner starts from its calibration.
"""

import contextlib
import hashlib
import os
import time
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.adapt.records import ACCEPTED, LEARNED, VERDICTS
from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError

#: Trainings that a file remembers, and the age from which an unfinished file is nobody's, s.
_HISTORY = 50
_ABANDONED_S = 3600.0


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The outcome of one training. Only an accepted one is ever in use."""

    #: ISO 8601.
    date: str
    verdict: str
    ambient_C: float | None
    pad_rise_K: float | None
    #: Learned values; None unless accepted.
    curve: tuple[float, ...] | None = None
    load_friction_m_per_rad: float | None = None
    offset_friction_Nm: float | None = None
    presliding_angle_rad: float | None = None
    stiffness_sigma_N: float | None = None
    stiffness_relative_sigma: float | None = None
    #: Motor angle from the released position to contact; None if the release position was not known.
    clearance_rad: float | None = None
    #: Evidence.
    samples: int
    residual_A: float | None
    residual_ratio: float | None
    contact_sigma_rad: float | None
    force_sigma_N: float | None
    top_force_N: float | None
    pairs_difference: float | None
    curve_change: float | None


class Store(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One corner's file."""

    format: int
    corner: str
    actuator: str
    calibration: str
    current: Entry | None
    history: tuple[Entry, ...]


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sha256: str
    adaptation: msgspec.Raw


def entry_of(learned: np.void, verdict: int, date: str, ambient_C: float, pad_rise_K: float) -> Entry:
    """An entry from a LEARNED record and the verdict of the whole training."""

    def known(value):
        return float(value) if np.isfinite(value) else None

    values = {}
    if verdict == ACCEPTED:
        values = {
            "curve": tuple(float(value) for value in learned["curve"]),
            "load_friction_m_per_rad": float(learned["load_friction"]),
            "offset_friction_Nm": float(learned["offset_friction"]),
            "presliding_angle_rad": float(learned["presliding_angle"]),
            "stiffness_sigma_N": float(learned["stiffness_sigma"]),
            "stiffness_relative_sigma": float(learned["stiffness_relative_sigma"]),
            "clearance_rad": known(learned["clearance"]),
        }
    return Entry(
        date=date,
        verdict=VERDICTS[verdict],
        ambient_C=known(ambient_C),
        pad_rise_K=known(pad_rise_K),
        samples=int(learned["samples"]),
        residual_A=known(learned["residual"]),
        residual_ratio=known(learned["residual_ratio"]),
        contact_sigma_rad=known(learned["contact_sigma"]),
        force_sigma_N=known(learned["force_sigma"]),
        top_force_N=known(learned["top_force"]),
        pairs_difference=known(learned["pairs_difference"]),
        curve_change=known(learned["curve_change"]),
        **values,
    )


def apply_entry(entry: Entry, parameters: np.void) -> None:
    """Put an accepted entry's values into a PARAMETERS record."""
    parameters["curve"] = 0.0
    parameters["curve"][: len(entry.curve)] = entry.curve
    parameters["load_friction"] = entry.load_friction_m_per_rad
    parameters["offset_friction"] = entry.offset_friction_Nm
    parameters["presliding_angle"] = entry.presliding_angle_rad
    parameters["stiffness_sigma"] = entry.stiffness_sigma_N
    parameters["stiffness_relative_sigma"] = entry.stiffness_relative_sigma
    if entry.clearance_rad is not None:
        parameters["clearance"] = entry.clearance_rad


def encode(store: Store) -> bytes:
    """The file's content."""
    body = msgspec.json.format(msgspec.json.encode(store), indent=1)
    return msgspec.json.encode(_File(hashlib.sha256(body).hexdigest(), msgspec.Raw(body))) + b"\n"


def decode(content: bytes) -> Store:
    """Read a file's content.

    Raises:
        ValueError: not one of our files, or damaged; says which.
    """
    try:
        file = msgspec.json.decode(content, type=_File)
        if hashlib.sha256(bytes(file.adaptation)).hexdigest() != file.sha256:
            raise ValueError("checksum is wrong")
        store = msgspec.json.decode(file.adaptation, type=Store)
    except msgspec.MsgspecError as error:
        raise ValueError(str(error)) from None
    if store.format != 1:
        raise ValueError(f"format {store.format}, expected 1")
    current = store.current
    if current is not None:
        numbers = (*(current.curve or ()), current.load_friction_m_per_rad, current.offset_friction_Nm,
                   current.presliding_angle_rad, current.stiffness_sigma_N, current.stiffness_relative_sigma)  # fmt: skip
        curve = current.curve or ()
        if None in numbers or not 1 <= len(curve) <= LEARNED["curve"].shape[0] or not curve[0] > 0.0:
            raise ValueError("current: incomplete")
    return store


def state_directory(configured: str | None, relative_to: Path, environment=os.environ) -> Path | None:
    """Folder for learned values: systemd's STATE_DIRECTORY, or else the configured one; None if there is neither."""
    if given := environment.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    return relative_to / configured if configured else None


class Memory:
    """The folder of learned values."""

    def __init__(self, folder: Path):
        """Raises InputError if the folder cannot be made."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: not a usable state directory: {error.strerror}") from None

    def path(self, corner: str) -> Path:
        return self.folder / f"adaptation-{corner}.json"

    def read(self, corner: str) -> Store | None:
        """A corner's file; None if there is none.

        Raises:
            ValueError: damaged.
            OSError: not readable.
        """
        try:
            content = self.path(corner).read_bytes()
        except FileNotFoundError:
            return None
        return decode(content)

    def load(self, corner: str, calibration: Calibration) -> tuple[Store, str | None]:
        """What is known of a corner with this calibration, and a warning for the log or None.

        A damaged file is renamed; one of another actuator or calibration stays until something new is learned, but nothing
        of it is used.
        """
        empty = Store(
            format=1, corner=corner, actuator=calibration.actuator, calibration=calibration_hash(calibration),
            current=None, history=(),
        )  # fmt: skip
        self._sweep()
        try:
            store = self.read(corner)
        except ValueError as error:
            aside = self._set_aside(corner)
            return empty, f"{self.path(corner)}: damaged ({error}), set aside as {aside.name}"
        except OSError as error:
            return empty, f"{self.path(corner)}: not readable: {error.strerror}"
        if store is None:
            return empty, None
        for name in ("corner", "actuator", "calibration"):
            if getattr(store, name) != getattr(empty, name):
                theirs, ours = getattr(store, name), getattr(empty, name)
                return empty, f"{self.path(corner)}: belongs to {name} {theirs}, not {ours}; not used"
        return store, None

    def _sweep(self) -> None:
        """Remove what writers left that were killed long ago."""
        for path in self.folder.glob(".adaptation-*.json.*"):
            with contextlib.suppress(OSError):
                if time.time() - path.stat().st_mtime > _ABANDONED_S:
                    path.unlink()

    def _set_aside(self, corner: str) -> Path:
        path = self.path(corner)
        for number in range(1, 1000):
            aside = path.with_name(f"{path.name}.damaged-{number}")
            if not aside.exists():
                break
        os.replace(path, aside)
        return aside

    def save(self, store: Store) -> None:
        """Raises OSError; the old file is then untouched."""
        write_atomically(self.path(store.corner), encode(store))

    def reset(self, corner: str) -> bool:
        """Forget a corner; False if there was nothing to forget."""
        try:
            self.path(corner).unlink()
        except FileNotFoundError:
            return False
        return True


def with_entry(store: Store, entry: Entry) -> Store:
    """A store that has also seen ``entry``; an accepted one is now in use."""
    current = entry if entry.curve is not None else store.current
    return msgspec.structs.replace(store, current=current, history=(*store.history, entry)[-_HISTORY:])
