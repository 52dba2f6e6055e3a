"""Files of the state directory: JSON with a checksum, complete at every moment, set aside when they cannot be used."""

import hashlib
import os
from pathlib import Path
from typing import TypeVar

import msgspec

from emb_daemon.atomic import write_atomically
from emb_daemon.bounded import read_bounded
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration

#: A hundred times the size of the largest file that is written here.
_MOST_BYTES = 4_000_000


class _Sealed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sha256: str
    content: msgspec.Raw


class Owned(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The first fields of a corner's file: to whom it belongs."""

    format: int
    corner: str
    actuator: str
    #: Hash of the calibration.
    calibration: str


_Kept = TypeVar("_Kept", bound=msgspec.Struct)
_Mine = TypeVar("_Mine", bound=Owned)


def owner(version: int, corner: str, calibration: Calibration) -> dict[str, str | int]:
    """Fields of `Owned`."""
    mine = {"format": version, "corner": corner, "actuator": calibration.actuator}
    return mine | {"calibration": calibration_hash(calibration)}


def encode(content: msgspec.Struct) -> bytes:
    body = msgspec.json.format(msgspec.json.encode(content), indent=1)
    return msgspec.json.encode(_Sealed(hashlib.sha256(body).hexdigest(), msgspec.Raw(body))) + b"\n"


def read(path: Path) -> bytes:
    """Raises OSError; also if it is not a regular file, or larger than any file written here."""
    return read_bounded(path, _MOST_BYTES)


def decode(data: bytes, kind: type[_Kept], version: int) -> _Kept:
    """The object that `encode` was given. Raises ValueError, which says what is wrong: the file is damaged, is not of type
    ``kind``, or its ``format`` is not ``version``."""
    try:
        file = msgspec.json.decode(data, type=_Sealed)
        if hashlib.sha256(bytes(file.content)).hexdigest() != file.sha256:
            raise ValueError("checksum is wrong")
        content = msgspec.json.decode(file.content, type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(str(error)) from None
    if content.format != version:
        raise ValueError(f"format {content.format}, expected {version}")
    return content


def read_own(path: Path, kind: type[_Mine], ours: dict[str, str | int]) -> tuple[_Mine | None, str | None]:
    """A file's content of type ``kind``, or None, and a warning for the log, or None.

    A damaged file is set aside; one that does not belong to ``ours`` (`owner`) is not used."""
    try:
        found = decode(read(path), kind, ours["format"])
    except FileNotFoundError:
        return None, None
    except ValueError as error:
        return None, f"{path}: damaged ({error}), {set_aside(path)}"
    except OSError as error:
        return None, f"{path}: not readable: {error.strerror}"
    for name, expected in ours.items():
        if getattr(found, name) != expected:
            return None, f"{path}: belongs to {name} {getattr(found, name)}, not {expected}; not used"
    return found, None


def write(path: Path, content: msgspec.Struct) -> None:
    """Raises OSError; the old file is then untouched."""
    write_atomically(path, encode(content))


def set_aside(path: Path) -> str:
    """Rename a file that cannot be used; returns the result in words."""
    for number in range(1, 1000):
        aside = path.with_name(f"{path.name}.unusable-{number}")
        if not aside.exists():
            break
    try:
        os.replace(path, aside)
    except OSError as error:
        return f"not used, and not set aside: {error.strerror}"
    return f"set aside as {aside.name}"
