"""Files of the state directory: JSON with a checksum, whole at every moment, and out of the way when they are no use."""

import hashlib
import os
from pathlib import Path

import msgspec

from emb_daemon.atomic import write_atomically
from emb_daemon.bounded import read_bounded

#: A hundred times what any file of ours has.
_MOST_BYTES = 4_000_000


class _Sealed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sha256: str
    content: msgspec.Raw


def encode(content: msgspec.Struct) -> bytes:
    """A file's bytes."""
    body = msgspec.json.format(msgspec.json.encode(content), indent=1)
    return msgspec.json.encode(_Sealed(hashlib.sha256(body).hexdigest(), msgspec.Raw(body))) + b"\n"


def read(path: Path) -> bytes:
    """Raises OSError; also for what is no regular file, or larger than any of ours."""
    return read_bounded(path, _MOST_BYTES)


def decode(data: bytes, kind: type):
    """What `encode` was given, of type ``kind``.

    Raises:
        ValueError: not one of our files, or damaged; says which.
    """
    try:
        file = msgspec.json.decode(data, type=_Sealed)
        if hashlib.sha256(bytes(file.content)).hexdigest() != file.sha256:
            raise ValueError("checksum is wrong")
        return msgspec.json.decode(file.content, type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(str(error)) from None


def write(path: Path, content: msgspec.Struct) -> None:
    """Raises OSError; the old file is then untouched."""
    write_atomically(path, encode(content))


def set_aside(path: Path) -> str:
    """Rename a file that cannot be used; says what became of it."""
    for number in range(1, 1000):
        aside = path.with_name(f"{path.name}.unusable-{number}")
        if not aside.exists():
            break
    try:
        os.replace(path, aside)
    except OSError as error:
        return f"not used, and not set aside: {error.strerror}"
    return f"set aside as {aside.name}"
