"""The daemon in a process of its own, on an inherited socket, set up as ``emb-daemon run`` sets it up, with a stopwatch.

Run as ``python -m emb_daemon.bench.daemon CONFIG STATE SHARE FD``. Prints a line when it is ready, with the CPU time that
took, and, after SIGTERM, a JSON line with what its ticks cost. SHARE is as in ``emb-daemon run --share``, empty for none.
"""

# Before modules with kernels are imported.
from typing import Any

from emb_daemon.ahead import library

if _refusal := library.load():
    raise SystemExit(_refusal)

import gc
import json
import math
import mmap
import os
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np

from emb_daemon import jit
from emb_daemon.bench.loop import is_held_up, quantiles
from emb_daemon.calibration.configuration import Setup
from emb_daemon.runtime import daemon as loop
from emb_daemon.runtime.journal import set_up_logging
from emb_daemon.runtime.rawcan import RawCanSocket
from emb_daemon.runtime.realtime import set_up, settle_memory

#: Parts of a tick: name, and object and method that do them.
_PARTS = (("drain", "bus", "drain"), ("decode", "pipeline", "collect"), ("step", "pipeline", "answer"),
          ("encode", "pipeline", "broadcast"), ("send", "bus", "send"))  # fmt: skip
#: Ticks after which memory counts as settled: a second.
_SETTLED = 250
#: Number of recorded ticks, enough for an hour.
_ROOM = 1_000_000


class Pacer(loop.Pacer):
    """Records whether the loop sleeps (it waits on the bus while a sample is overdue), when that ends at the latest, and the
    process's CPU time before."""

    sleeps: bool = False
    deadline_ns: int = 0
    worked_ns: int = 0

    def next_wake(self, now_ns: int) -> int:
        wake = super().next_wake(now_ns)
        self.sleeps = wake > now_ns
        self.deadline_ns = wake if self.sleeps else now_ns + loop.QUEUED_NS
        self.worked_ns = time.process_time_ns()
        return wake


class Ledger:
    """Records the cost of ticks with a sample, by parts, the delay of wake-ups, and the cause of missed ticks."""

    def __init__(self, daemon: loop.Daemon, bus: RawCanSocket):
        self._daemon, self._daemons_tick = daemon, daemon.tick
        self._rows = _allocate_shared(_ROOM, len(_PARTS) + 1)
        self._late = _allocate_shared(_ROOM)
        self._used = self._woken = 0
        self._spent = [0] * len(_PARTS)
        self._missed = self._held_up = 0
        self._settled_KiB = resident_KiB()
        self._begun = self._ended = self._counts()
        for column, (_, owner, name) in enumerate(_PARTS):
            self._watch(bus if owner == "bus" else daemon.pipeline, name, column)
        daemon.tick = self._tick

    def _watch(self, holder, name: str, column: int) -> None:
        method, spent = getattr(holder, name), self._spent

        def timed(*arguments, **options):
            begin = time.perf_counter_ns()
            result = method(*arguments, **options)
            spent[column] += time.perf_counter_ns() - begin
            return result

        setattr(holder, name, timed)

    def _tick(self, now_ns: int, pacer: Pacer) -> None:
        self._attribute(now_ns, pacer)
        corners = self._daemon.pipeline.corners
        cycles = corners["cycle"].sum()
        begin = time.perf_counter_ns()
        self._spent[:] = [0] * len(_PARTS)
        self._daemons_tick(now_ns, pacer)
        taken = time.perf_counter_ns() - begin
        if not corners["started"].any():
            return
        if pacer.sleeps and self._woken < _ROOM:
            self._late[self._woken] = now_ns - pacer.deadline_ns
            self._woken += 1
        if corners["cycle"].sum() > cycles and self._used < _ROOM:
            self._rows[self._used] = [*self._spent, taken]
            self._used += 1
            # The ending car, at a priority above the daemon's, is a load that a real daemon does not have.
            self._ended = self._counts()
            if self._used == _SETTLED:
                self._begun, self._settled_KiB = self._ended, resident_KiB()

    def _attribute(self, now_ns: int, pacer: Pacer) -> None:
        """Count missed periods that the machine caused: the loop was not woken, and nothing of the process ran."""
        missed, self._missed = self._daemon.missed - self._missed, self._daemon.missed
        if missed and is_held_up(now_ns - pacer.deadline_ns, time.process_time_ns() - pacer.worked_ns):
            self._held_up += missed

    def _counts(self) -> tuple:
        return time.monotonic(), time.process_time(), self._daemon.ticks, self._daemon.missed, self._held_up

    def figures(self) -> dict[str, Any]:
        """Share of a core, ticks, missed ticks, those held up by the machine and memory at both ends, from the time when
        memory has settled to the last sample; and costs since the start, us."""
        # Before the figures themselves take memory: 48 bytes a tick.
        resident = [self._settled_KiB, resident_KiB()]
        (begin, used, ticks, missed, held), end = self._begun, self._ended if self._used else self._counts()
        *parts, whole = (self._rows[: self._used] / 1e3).T
        return {
            "core_share": (end[1] - used) / (end[0] - begin),
            "ticks": end[2] - ticks,
            "missed": end[3] - missed,
            "held_up": end[4] - held,
            "resident_KiB": resident,
            "tick": quantiles(whole),
            "parts": {name: quantiles(part) for (name, *_), part in zip(_PARTS, parts, strict=True)}
            | {"rest": quantiles(whole - sum(parts))},
            "wake_up": quantiles(self._late[: self._woken] / 1e3),
        }


def _allocate_shared(*shape: int) -> np.ndarray:
    """Zeros in shared memory, ns. It does not count as the daemon's memory, and unwritten pages cost nothing."""
    return np.frombuffer(mmap.mmap(-1, 8 * math.prod(shape)), np.int64).reshape(shape)


def resident_KiB() -> int:
    """Resident memory of this process, without shared memory."""
    held = ("RssAnon:", "RssFile:")
    lines = Path("/proc/self/status").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(held))


def main() -> None:
    # As in emb-daemon run: cantools and python-can import it where it is installed, and with it pandas.
    sys.modules.setdefault("asammdf", None)
    config, state, share, descriptor = sys.argv[1:]
    setup = Setup(Path(config))
    set_up_logging(setup.configuration.log_level)
    bus = RawCanSocket(socket.socket(fileno=int(descriptor)), stamped=True)
    loop.Pacer = Pacer
    daemon = loop.Daemon(setup, bus, state=Path(state))
    if share:
        daemon.share(Path(share))
    daemon.warm_up()
    if jit.compiled_for_the_next_start():
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    signal.signal(signal.SIGTERM, lambda *_: daemon.stop())
    ledger = Ledger(daemon, bus)
    realtime = setup.configuration.realtime
    measures = list(set_up(realtime.lock_memory, realtime.fifo_priority, realtime.cpu))
    settle_memory()
    # Including the CPU time of child processes, one of which may have compiled.
    print("ready", sum(os.times()[:4]), flush=True)
    daemon.run()
    gc.enable()
    print(json.dumps({"measures": measures, **ledger.figures()}))


if __name__ == "__main__":
    main()
