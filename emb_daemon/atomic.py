"""Files that are complete at every moment."""

import contextlib
import ctypes
import errno
import os
import tempfile
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_libc = ctypes.CDLL(None, use_errno=True)


@contextlib.contextmanager
def name_in_errors(path: Path):
    """Inside this context an OSError, such as for a full disk, names ``path`` and not the temporary file."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Replace ``path`` by ``content``: a reader, or a kill at any moment, finds the old file or the new one. Raises OSError:
    the folder cannot be written, or ``path`` is a folder, device or pipe, which a file would replace; what was there is
    untouched."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "expected a regular file or none", str(path))
    with name_in_errors(path):
        _write_beside(path, content)


def _write_beside(path: Path, content: bytes | memoryview) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise
    _sync_folder(path.parent)


def write_in_reserve(path: Path, content: bytes, size: int) -> None:
    """`write_atomically` for a file that must be replaced on a full disk too: at least ``size`` bytes long, filled up with
    blanks, it takes turns with a second file, whose room on the disk is taken with the first call. Raises OSError: the folder
    cannot be written; what was there is untouched."""
    spare = path.with_name(f".{path.name}.spare")
    with name_in_errors(path):
        _fill(spare, content.ljust(size))
        if not (path.is_file() and _exchange(spare, path)):
            os.replace(spare, path)
            # Needed at the next call only.
            with contextlib.suppress(OSError):
                _fill(spare, bytes(size))
        _sync_folder(path.parent)


def _fill(path: Path, content: bytes) -> None:
    """Write over a file, in the room that it has."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644), "wb") as file:
        file.write(content)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())


def _exchange(one: Path, other: Path) -> bool:
    """Let two files change places; False where the file system cannot do that."""
    return _libc.renameat2(_AT_FDCWD, bytes(one), _AT_FDCWD, bytes(other), _RENAME_EXCHANGE) == 0


def _sync_folder(path: Path) -> None:
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
