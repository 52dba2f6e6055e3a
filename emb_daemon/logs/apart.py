"""MDF4 bus logs (.mf4), read by asammdf in processes of their own.

It is compiled code that was not written for hostile files: a damaged one may mean a crash, an endless loop or exhausted
memory. Importing it takes longer than reading a log of minutes. A process beside this one therefore imports it once and waits;
for each log it forks another, which has bounded time and memory and returns arrays or nothing.
"""

import contextlib
import io
import os
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import threading
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from emb_daemon.errors import InputError

#: CPU time that a log may take: s, and for each megabyte, s.
_START_S, _PER_MEGABYTE_S = 30.0, 60.0
#: Exit status for a library that is not installed.
_MISSING = 3
#: Asked for a log: its CPU time, s, its memory and its size, bytes. Answered: the exit status, and the size of what follows.
_QUESTION, _ANSWER = struct.Struct("<QQQ"), struct.Struct("<iQ")
#: Groups of the standard's bus logging, by the names of what they record.
_KINDS = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_one_at_a_time = threading.Lock()


def mdf_columns(path: Path, content: bytes, most_bytes: int) -> dict[str, np.ndarray]:
    """Columns of all CAN frames of an MDF4 log in order of time, read with ``most_bytes`` of memory: ``time_ns``, ``can_id``,
    ``length``, whether ``extended``, ``remote``, ``error`` or ``fd``, ``channel``, shape (n,), and ``octets``, shape (n, w).
    Empty if there is none. Raises InputError: not readable, or not with that much time and memory. Raises ImportError: asammdf
    is not installed."""
    seconds = round(_START_S + _PER_MEGABYTE_S * 1e-6 * len(content))
    with _one_at_a_time:
        reader = _reader(os.pathsep.join(filter(None, sys.path)))
        try:
            reader.stdin.write(_QUESTION.pack(seconds, most_bytes, len(content)) + content)
            reader.stdin.flush()
            code, size = _ANSWER.unpack(reader.stdout.read(_ANSWER.size))
        except (OSError, struct.error):
            _reader.cache_clear()
            raise InputError(f"{path}: the process that reads MDF4 files is gone; try again") from None
        answer = reader.stdout.read(size)
    if code == 0:
        with np.load(io.BytesIO(answer)) as arrays:
            return dict(arrays)
    said = answer.decode(errors="replace").strip().rpartition("\n")[2]
    if code == _MISSING:
        raise ImportError(said)
    if code == -signal.SIGXCPU:
        raise InputError(f"{path}: asammdf did not come to an end within {seconds} s: damaged")
    if code < 0:
        raise InputError(f"{path}: asammdf crashed ({signal.Signals(-code).name}): damaged")
    raise InputError(f"{path}: not readable by asammdf: {said}")


@lru_cache(maxsize=1)
def _reader(search_path: str) -> subprocess.Popen:
    """The process that waits for logs; it ends with this one."""
    environment = os.environ | {"PYTHONPATH": search_path, "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        start_new_session=True,
    )


def main() -> None:
    # Who forks from here says that it is missing.
    with contextlib.suppress(ImportError):
        import asammdf  # noqa: F401
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    # What a library prints is no answer.
    os.dup2(2, 1)
    while question := requests.read(_QUESTION.size):
        seconds, most_bytes, size = _QUESTION.unpack(question)
        content = requests.read(size)
        with tempfile.TemporaryFile() as output:
            child = os.fork()
            if child == 0:
                os._exit(_read_bounded(content, seconds, most_bytes, output))
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            output.seek(0)
            answer = output.read()
        answers.write(_ANSWER.pack(code, len(answer)) + answer)
        answers.flush()


def _read_bounded(content: bytes, seconds: int, most_bytes: int, output: BinaryIO) -> int:
    """Write a log's columns, or why there are none; returns the exit status."""
    for kind, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_DATA, most_bytes), (resource.RLIMIT_CORE, 0)):
        # A lower hard limit cannot be raised.
        bound = resource.getrlimit(kind)[1]
        most = most if bound == resource.RLIM_INFINITY else min(most, bound)
        resource.setrlimit(kind, (most, bound))
    code = 0
    try:
        np.savez(output, **_columns_of(content))
    except ImportError as error:
        output.write(str(error).encode())
        code = _MISSING
    except BaseException as error:
        output.write((str(error) or type(error).__name__).encode())
        code = 1
    output.flush()
    return code


def _columns_of(content: bytes) -> dict[str, np.ndarray]:
    """What `mdf_columns` returns. Raises whatever asammdf raises."""
    from asammdf import MDF

    file, groups = MDF(io.BytesIO(content), process_bus_logging=False), []
    for index, group in enumerate(file.groups):
        names = {channel.name for channel in group.channels}
        for kind in _KINDS:
            if kind in names and group.channel_group.cycles_nr:
                groups.append(_frames_of(kind, file.get(kind, index)))
                break
    if not groups:
        return {}
    width = max(int(group["length"].max()) for group in groups)
    for group in groups:
        octets = group["octets"][:, :width]
        group["octets"] = np.pad(octets, ((0, 0), (0, width - octets.shape[1])))
    columns = {name: np.concatenate([group[name] for group in groups]) for name in groups[0]}
    rows = np.argsort(columns["time_ns"], kind="stable")
    columns = {name: values[rows] for name, values in columns.items()}
    columns["time_ns"] += round(1e6 * file.header.start_time.timestamp()) * 1000
    return columns


def _frames_of(kind: str, signal) -> dict[str, np.ndarray]:
    """Columns of one group from asammdf's signal of records."""
    records, count = signal.samples, len(signal.timestamps)

    def column(name: str) -> np.ndarray:
        name = f"{kind}.{name}"
        return records[name] if name in records.dtype.names else np.zeros(count, np.uint8)

    remote = np.full(count, kind == "CAN_RemoteFrame") | (column("RTR") != 0)
    octets = column("DataBytes")
    octets = octets if octets.ndim == 2 else np.zeros((count, 8), np.uint8)
    return {
        "time_ns": np.rint(1e9 * signal.timestamps).astype(np.int64),
        "can_id": column("ID").astype(np.uint32) & np.uint32(0x1FFF_FFFF),
        "length": np.where(remote, 0, np.minimum(column("DataLength"), octets.shape[1])).astype(np.uint8),
        "extended": column("IDE") != 0,
        "remote": remote,
        "error": np.full(count, kind == "CAN_ErrorFrame"),
        "fd": column("EDL") != 0,
        "channel": column("BusChannel").astype(np.uint16),
        "octets": octets,
    }


if __name__ == "__main__":
    main()
