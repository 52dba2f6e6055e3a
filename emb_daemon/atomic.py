"""Files that are complete at every moment."""

import contextlib
import errno
import os
import tempfile
from pathlib import Path


@contextlib.contextmanager
def name_in_errors(path: Path):
    """Inside this context an OSError, such as for a full disk, names ``path`` and not the temporary file."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Replace ``path`` by ``content``: a reader, or a kill at any moment, finds the old file or the new one.

    Raises:
        OSError: the folder cannot be written, or ``path`` is a folder, device or pipe, which a file would replace; what was
            there is untouched.
    """
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
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
