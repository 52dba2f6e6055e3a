"""Reads files of others so that none can block the reader or use up the machine's memory."""

import errno
import os
import stat
from pathlib import Path

from emb_daemon.errors import InputErrors

#: Bytes that are read at least: files of /proc state a size of zero.
_UNKNOWN_SIZE = 1 << 20


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Content of a regular file; never blocks. Raises OSError: not readable, not a regular file, or larger than
    ``most_bytes``; ``strerror`` says which."""
    # open() of a pipe would wait for a writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as file:
        mode, size = os.fstat(handle).st_mode, os.fstat(handle).st_size
        if not stat.S_ISREG(mode):
            raise OSError(errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL, "not a regular file", str(path))
        # Python reserves what read() may return: not more than the file has, nor too little where a file system does not know.
        content = file.read(min(most_bytes, max(size, _UNKNOWN_SIZE)) + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes} bytes", str(path))
    return content


def read_input(path: Path, most_bytes: int) -> bytes:
    """`read_bounded` of a file that the user named; raises InputErrors if it cannot be read."""
    try:
        return read_bounded(path, most_bytes)
    except FileNotFoundError:
        raise InputErrors([f"{path}: no such file"]) from None
    except OSError as error:
        raise InputErrors([f"{path}: {error.strerror}"]) from None
