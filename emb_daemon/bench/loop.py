"""The daemon at its cadence: what a tick costs in parts, what is missed, how soon a sample is answered."""

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from emb_daemon.bench import empty
from emb_daemon.calibration.configuration import Setup
from emb_daemon.resources import resource
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.runtime.rawcan import RawCanSocket
from emb_daemon.runtime.realtime import settle_memory, use_fifo
from emb_daemon.wire.layout import CORNERS

_PRIORITY = 60
_PARTS = (("drain", "bus"), ("collect", "pipeline"), ("answer", "pipeline"), ("broadcast", "pipeline"), ("send", "bus"))
_LABELS = {"drain": "drain", "collect": "decode", "answer": "step", "broadcast": "encode", "send": "send"}


class _Stopwatch:
    """Calls through to a method and keeps how long each took, ns."""

    def __init__(self, method, room: int):
        self._method = method
        self._taken = np.zeros(room, np.int64)
        self._count = 0

    def __call__(self, *arguments, **options):
        begin = time.perf_counter_ns()
        result = self._method(*arguments, **options)
        if self._count < len(self._taken):
            self._taken[self._count] = time.perf_counter_ns() - begin
            self._count += 1
        return result

    def figures(self) -> dict[str, float]:
        taken = self._taken[: self._count] / 1e3
        return {"p50_us": float(np.median(taken)), "p99_us": float(np.percentile(taken, 99))} if len(taken) else {}


def _resident_kib() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def measure_loop(corners: int, seconds: float) -> dict:
    """Run the real daemon for ``corners`` brakes of a simulated car in a process of its own, and an empty loop beside it.

    Returns cost of a tick and of its parts, latency from a sample's last frame to its answer, ticks missed here and by the
    empty loop, share of one core, and resident memory at start and end.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    with tempfile.TemporaryDirectory() as folder:
        lines = [f"  {name}: {{calibration: {str(resource('config/calibration.yaml'))!r}}}" for name in CORNERS[:corners]]
        config = Path(folder) / "emb.yaml"
        config.write_text("\n".join(["format: 1", "corners:", *lines, ""]))
        setup = Setup(config)
    bus = RawCanSocket(ours, stamped=True)
    daemon = Daemon(setup, bus)
    daemon.warm_up()
    room = int(seconds * 600)
    watches = {}
    for name, owner in _PARTS:
        holder = bus if owner == "bus" else daemon.pipeline
        watches[name] = _Stopwatch(getattr(holder, name), room)
        setattr(holder, name, watches[name])
    daemon.tick = whole = _Stopwatch(daemon.tick, room)

    car = [sys.executable, "-m", "emb_daemon.bench.car", str(theirs.fileno()), str(corners), str(seconds), str(_PRIORITY + 5)]
    beside = [sys.executable, empty.__file__, str(seconds), str(_PRIORITY)]
    with subprocess.Popen(car, pass_fds=[theirs.fileno()], stdout=subprocess.PIPE, text=True) as driving:
        theirs.close()
        # The car says nothing before it hears us; its first frames are the sign that it has finished compiling.
        result: dict = {"corners": corners, "seconds": seconds}

        def run() -> None:
            result["scheduling"] = use_fifo(_PRIORITY)
            daemon.run()

        settle_memory()
        loop = threading.Thread(target=run)
        loop.start()
        while not daemon.pipeline.corners["started"][0] and driving.poll() is None:
            time.sleep(0.05)
        memory, missed, ticks, used = _resident_kib(), daemon.missed, daemon.ticks, time.process_time()
        begin = time.monotonic()
        with subprocess.Popen(beside, stdout=subprocess.PIPE, text=True) as nothing:
            answers = json.loads(driving.communicate()[0])
            result["core_share"] = (time.process_time() - used) / (time.monotonic() - begin)
            result["missed"], result["ticks"] = daemon.missed - missed, daemon.ticks - ticks
            result["resident_KiB"] = [memory, _resident_kib()]
            result["empty_loop"] = json.loads(nothing.communicate()[0])
        daemon.stop()
        loop.join()
    bus.close()
    result["answers"] = answers
    result["tick"] = whole.figures()
    result["parts"] = {_LABELS[name]: watch.figures() for name, watch in watches.items()}
    return result


def cyclictest(seconds: float) -> dict | None:
    """Wake-up latency that rt-tests' cyclictest sees at 250 Hz; None where it is not installed or not allowed."""
    command = ["cyclictest", "-q", "-t1", f"-p{_PRIORITY}", "-i4000", f"-D{max(1, round(seconds))}", "-h5000"]
    try:
        output = subprocess.run(command, capture_output=True, text=True, check=True, timeout=seconds + 30).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    counts = [line.split() for line in output.splitlines() if line[:1].isdigit()]
    latency = np.repeat([int(us) for us, _ in counts], [int(count) for _, count in counts])
    if not len(latency):
        return None
    return {"p50_us": float(np.median(latency)), "p99_us": float(np.percentile(latency, 99)), "ticks": len(latency)}


def machine() -> str:
    """Processor, cores and kernel, for the table's heading."""
    model = "unknown processor"
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.lower().startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{model}, {os.cpu_count()} CPUs, Linux {os.uname().release}, CPython {sys.version.split()[0]}"
