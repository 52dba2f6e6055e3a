"""MDF4 bus logs (.mf4), read by asammdf in a process of its own.

It is compiled code that was not written for hostile files: a damaged one may mean a crash, an endless loop or exhausted
memory. Here it gets the file's content on its standard input and bounded time and memory, and returns arrays or nothing. The
process imports nothing of this package that needs a compiler, because it begins anew for each file.
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

#: CPU time that the reader may take: to start, s, and for each megabyte, s.
_START_S, _PER_MEGABYTE_S = 30.0, 60.0
#: What the child reports for a library that is not installed.
_MISSING = 3
#: Groups of the standard's bus logging, by the names of what they record.
_KINDS = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")


def _columns_of(content: bytes) -> dict[str, np.ndarray]:
    """Frames in order of time, by the names that `mdf_columns` states. Raises whatever asammdf raises."""
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
    width = max(group["octets"].shape[1] for group in groups)
    for group in groups:
        group["octets"] = np.pad(group["octets"], ((0, 0), (0, width - group["octets"].shape[1])))
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


def mdf_columns(path: Path, content: bytes, most_bytes: int) -> dict[str, np.ndarray]:
    """Columns of all CAN frames of an MDF4 log, with ``most_bytes`` of memory: ``time_ns``, ``can_id``, ``length``, whether
    ``extended``, ``remote``, ``error`` or ``fd``, ``channel``, shape (n,), and ``octets``, shape (n, widest payload). Empty if
    there is none.

    Raises:
        InputError: not readable, or not with that much time and memory.
        ImportError: asammdf is not installed.
    """
    seconds = _START_S + _PER_MEGABYTE_S * 1e-6 * len(content)
    command = [sys.executable, "-m", __name__, str(round(seconds)), str(most_bytes)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, input=content, capture_output=True, env=environment)
    said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if done.returncode == _MISSING:
        raise ImportError(said)
    if done.returncode == -signal.SIGXCPU:
        raise InputError(f"{path}: asammdf did not come to an end within {seconds:.0f} s: damaged")
    if done.returncode < 0:
        raise InputError(f"{path}: asammdf crashed ({signal.Signals(-done.returncode).name}): damaged")
    if done.returncode:
        raise InputError(f"{path}: not readable by asammdf: {said}")
    with np.load(io.BytesIO(done.stdout)) as arrays:
        return dict(arrays)


def main() -> int:
    seconds, most_bytes = map(int, sys.argv[1:])
    for kind, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_DATA, most_bytes), (resource.RLIMIT_CORE, 0)):
        # A lower hard limit cannot be raised.
        bound = resource.getrlimit(kind)[1]
        most = most if bound == resource.RLIM_INFINITY else min(most, bound)
        resource.setrlimit(kind, (most, bound))
    content, output = sys.stdin.buffer.read(), io.BytesIO()
    try:
        np.savez(output, **_columns_of(content))
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
