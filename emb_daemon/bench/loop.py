"""Measures the running daemon: parts of a tick, missed ticks, latency of an estimate, memory, start."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emb_daemon.ahead import library
from emb_daemon.bench import empty
from emb_daemon.resources import shipped_configuration
from emb_daemon.runtime.rawcan import connected_sockets
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.layout import CORNERS

#: Priority of the daemon; the car's is higher, because senders on a bus do not wait for the daemon.
_PRIORITY = 60
_CAR_PRIORITY = 65
_PATIENCE_S = 300.0
#: A late wake-up counts as held up by the machine if the process worked for at most this share of the delay. A helper thread
#: that had kept the loop from waking would have worked throughout.
_IDLE = 0.1


class _Child:
    """A module of this package in a process of its own, which prints a line when it is ready and one at its end. The last of
    its arguments is its socket. ``ready``: ``wall_s`` and ``cpu_s`` from its start to its first line."""

    def __init__(self, module: str, *arguments, environment: dict | None = None):
        *words, bus = arguments
        command = [sys.executable, "-m", f"emb_daemon.bench.{module}", *map(str, words), str(bus.fileno())]
        begin = time.monotonic()
        environment = os.environ | (environment or {})
        self._process = subprocess.Popen(command, pass_fds=[bus.fileno()], stdout=subprocess.PIPE, text=True, env=environment)
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        wall = time.monotonic() - begin
        word, _, cpu = said.partition(" ")
        if word != "ready":
            raise RuntimeError(f"bench: {module} ended with status {self._process.wait()} before it was ready")
        self.ready = {"wall_s": wall, "cpu_s": float(cpu)}

    def result(self, patience_s: float = _PATIENCE_S) -> dict:
        """Waits for the end of the process; returns what it printed."""
        return json.loads(self._process.communicate(timeout=patience_s)[0])

    def stop(self) -> dict:
        self._process.terminate()
        return self.result()

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()


@contextmanager
def _temporary_configuration(corners: int) -> Iterator[list]:
    """Configuration and state folder, as arguments of `bench.daemon`."""
    with tempfile.TemporaryDirectory() as folder:
        yield [shipped_configuration(Path(folder), CORNERS[:corners], "log_level: error"), Path(folder) / "state"]


def measure_loop(corners: int, seconds: float, kernels: str | None = None, share: Path | None = None) -> dict[str, Any]:
    """Run the real daemon and a simulated car, each in a process of its own, together with an empty loop and, if it is
    installed, cyclictest.

    ``kernels`` is the library that the daemon uses; empty: it uses numba; None: what it would use by itself. ``share``: file
    in which it shares its estimates. Returns the figures that `bench.daemon` prints; under ``answers`` those that `bench.car`
    prints; ``empty_loop``; ``cyclictest``, None where it is missing; and ``ready``: the daemon's start in ``wall_s`` and
    ``cpu_s``."""
    ours, theirs = connected_sockets()
    car = _Child("car", corners, seconds, _CAR_PRIORITY, theirs)
    daemon = None
    try:
        with _temporary_configuration(corners) as arguments:
            environment = None if kernels is None else {library.VARIABLE: kernels}
            daemon = _Child("daemon", *arguments, share or "", ours, environment=environment)
            command = [sys.executable, empty.__file__, str(seconds), str(_PRIORITY)]
            with subprocess.Popen(command, stdout=subprocess.PIPE) as nothing:
                latency = cyclictest(seconds)
                answers = car.result(seconds + _PATIENCE_S)
                result = daemon.stop()
                result["empty_loop"] = json.loads(nothing.communicate()[0])
    finally:
        for child in filter(None, (car, daemon)):
            child.kill()
        # Not earlier: a bus continues without the car, but a socket fails without its other end.
        ours.close()
        theirs.close()
    figures = {"corners": corners, "seconds": seconds, "ready": daemon.ready}
    return figures | result | {"answers": answers, "cyclictest": latency}


def quantiles(us: np.ndarray) -> dict[str, float]:
    """Median and 99th percentile; NaN of nothing."""
    median, tail = np.percentile(us, (50, 99)) if len(us) else (np.nan, np.nan)
    return {"p50_us": float(median), "p99_us": float(tail)}


def is_held_up(late_ns: int, worked_ns: int) -> bool:
    """Whether the machine caused a wake-up ``late_ns`` too late, by the CPU time of the whole process meanwhile."""
    return late_ns >= CYCLE_NS and worked_ns < _IDLE * late_ns


def measure_start(cold: bool = False) -> dict[str, float]:
    """``wall_s`` and ``cpu_s`` from start to ready with numba, with cached kernels or, if ``cold``, without."""
    ours, theirs = connected_sockets()
    with ours, theirs, _temporary_configuration(len(CORNERS)) as arguments, tempfile.TemporaryDirectory() as empty_cache:
        environment = {library.VARIABLE: ""} | ({"NUMBA_CACHE_DIR": empty_cache} if cold else {})
        daemon = _Child("daemon", *arguments, "", ours, environment=environment)
        try:
            daemon.stop()
        finally:
            daemon.kill()
    return daemon.ready


def cyclictest(seconds: float) -> dict[str, float] | None:
    """Wake-up latency by rt-tests' cyclictest at 250 Hz; None if it is not installed or not permitted."""
    command = ["cyclictest", "-q", "-t1", f"-p{_PRIORITY}", "-i4000", f"-D{max(1, round(seconds))}", "-h5000"]
    try:
        output = subprocess.run(command, capture_output=True, text=True, check=True, timeout=seconds + 30).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    counts = [line.split() for line in output.splitlines() if line[:1].isdigit()]
    latency = np.repeat([int(us) for us, _ in counts], [int(count) for _, count in counts])
    return quantiles(latency) | {"ticks": len(latency)} if len(latency) else None


def machine() -> str:
    """Processor, cores and kernel, for the table's heading."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = (line.partition(":")[2].strip() for line in lines if line.lower().startswith("model name"))
    model, python = next(models, "unknown processor"), sys.version.split()[0]
    return f"{model}, {os.cpu_count()} CPUs, Linux {os.uname().release}, CPython {python}"
