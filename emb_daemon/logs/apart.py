"""Readers for which a damaged file may mean a crash, an endless loop or exhausted memory, in a process of their own.

python-can's BLF reader trusts sizes that the file states, and asammdf is compiled code: neither was written for hostile files.
Here such a reader gets the file's content on its standard input and bounded time and memory, and returns arrays or nothing.
"""

import io
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.wire.frames import FRAME, row_of

#: CPU time that a reader may take: to start, s, and for each megabyte, s. BLF takes python-can up to 5 s a megabyte.
_START_S, _PER_MEGABYTE_S = 30.0, 60.0
#: Readers that number channels from zero where the tools number them from one.
_FROM_ZERO = ("BLFReader", "ASCReader")
#: What the child reports for a library that is not installed.
_MISSING = 3


def frames_of(content: bytes, reader_name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """FRAME array, payloads, one after the other, and channels, as texts, of a log's content, by python-can's reader of that
    name. Raises whatever that raises."""
    import can
    from can.io.generic import TextIOMessageReader

    kind, file, octets, rows = getattr(can, reader_name), io.BytesIO(content), bytearray(), []
    channels = []
    for message in kind(io.TextIOWrapper(file) if issubclass(kind, TextIOMessageReader) else file):
        octets += message.data
        channels.append(str(message.channel + 1 if reader_name in _FROM_ZERO else message.channel))
        rows.append(row_of(message, round(message.timestamp * 1e9)))
    return np.array(rows, FRAME), np.frombuffer(octets, np.uint8), np.array(channels, "U32")


def frames_apart(path: Path, content: bytes, reader_name: str, most_bytes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`frames_of` in another process, which gets ``most_bytes`` of memory.

    Raises:
        InputError: not readable, or not with that much time and memory.
        ImportError: the reader's library is not installed.
    """
    seconds = _START_S + _PER_MEGABYTE_S * 1e-6 * len(content)
    command = [sys.executable, "-m", __name__, reader_name, str(round(seconds)), str(most_bytes)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, input=content, capture_output=True, env=environment)
    said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if done.returncode == _MISSING:
        raise ImportError(said)
    if done.returncode == -signal.SIGXCPU:
        raise InputError(f"{path}: python-can's {reader_name} did not come to an end within {seconds:.0f} s: damaged")
    if done.returncode < 0:
        raise InputError(f"{path}: python-can's {reader_name} crashed ({signal.Signals(-done.returncode).name}): damaged")
    if done.returncode:
        raise InputError(f"{path}: not readable by python-can's {reader_name}: {said}")
    arrays = np.load(io.BytesIO(done.stdout))
    return arrays["frames"], arrays["octets"], arrays["channels"]


def main() -> int:
    reader_name, seconds, most_bytes = sys.argv[1], *(int(word) for word in sys.argv[2:])
    for kind, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_DATA, most_bytes), (resource.RLIMIT_CORE, 0)):
        # A lower hard limit cannot be raised.
        bound = resource.getrlimit(kind)[1]
        most = most if bound == resource.RLIM_INFINITY else min(most, bound)
        resource.setrlimit(kind, (most, bound))
    content, output = sys.stdin.buffer.read(), io.BytesIO()
    try:
        frames, octets, channels = frames_of(content, reader_name)
        np.savez(output, frames=frames, octets=octets, channels=channels)
    except ImportError as error:
        print(error, file=sys.stderr)
        return _MISSING
    except BaseException as error:
        print(str(error) or type(error).__name__, file=sys.stderr)
        return 1
    sys.stdout.buffer.write(output.getbuffer())
    return 0


if __name__ == "__main__":
    sys.exit(main())
