"""How long the machine kept its CPU from the guest: what a real-time process that does nothing loses."""

from __future__ import annotations

import mmap
import os
import signal
import struct
import time
from collections.abc import Callable, Generator

import pytest

# Before the daemon (60) and the players (70): what it loses, they do not take.
PRIORITY = 80
PERIOD_S = 0.02
# One of the daemon's periods: what the guest's kernel does in between is shorter.
LATE_S = 0.004
# Share of the time. Beside nothing 1 to 3 %; 15 and 25 % where another program takes 2 and 4 ms of each 8 on both CPUs, and
# there the simulated car itself loses a quarter of its cycles and more.
HELD_UP = 0.05
# Of this time, a share after which a daemon may have been ended, or its inputs lost, however calm the rest was.
SHORT_S, HELD_UP_SHORTLY = 5.0, 0.2
# Before a test is tried again, so that what held it up may end.
CALM_S, PATIENCE_S = 5.0, 60.0
# Makes a test that is tried again find what it found the first time.
BEFORE_ANOTHER = pytest.StashKey[Callable[[], None]]()


class Watch:
    """A process that wakes fifty times a second. A wake that is late is a sample of a machine that was taken by another: it
    counts as the whole time until the next, and if it came later than that, as all that it was late."""

    def __init__(self) -> None:
        self._lost = mmap.mmap(-1, 16)
        self._process = os.fork()
        if self._process == 0:
            try:
                _watch(self._lost)
            finally:
                os._exit(1)

    def lost_s(self) -> float:
        """Seconds lost since it began."""
        return struct.unpack("2d", self._lost[:])[0]

    def badly_s(self) -> float:
        """When `HELD_UP_SHORTLY` of `SHORT_S` was last lost, on the monotonic clock."""
        return struct.unpack("2d", self._lost[:])[1]

    def close(self) -> None:
        os.kill(self._process, signal.SIGKILL)
        os.waitpid(self._process, 0)


def _watch(lost: mmap.mmap) -> None:
    parent = os.getppid()
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    total_s, badly_s, before = 0.0, 0.0, (time.monotonic(), 0.0)
    while os.getppid() == parent:
        asleep_since = time.monotonic()
        time.sleep(PERIOD_S)
        late_s = time.monotonic() - asleep_since - PERIOD_S
        if late_s > LATE_S:
            total_s += max(late_s, PERIOD_S)
        now_s = time.monotonic()
        if total_s - before[1] > HELD_UP_SHORTLY * SHORT_S:
            badly_s = now_s
        if now_s - before[0] > SHORT_S:
            before = now_s, total_s
        lost[:] = struct.pack("2d", total_s, badly_s)


def tried_again(item: pytest.Item, watch: Watch | None) -> Generator[None, object, object]:
    """What is left of a `pytest_runtest_call`: a test that fails is run once more if the machine was held up meanwhile."""
    begun_s, lost_s = time.monotonic(), watch.lost_s() if watch else 0.0
    try:
        return (yield)
    except (Exception, pytest.fail.Exception) as error:
        share = (watch.lost_s() - lost_s) / (time.monotonic() - begun_s) if watch else 0.0
        badly = watch is not None and watch.badly_s() > begun_s
        print(f"an empty real-time process lost {share:.1%} of the time{', much of it at once' if badly else ''}")
        if share < HELD_UP and not badly:
            raise
        said = str(error).partition("\n")[0]
    item.warn(pytest.PytestWarning(f"HELD UP for {share:.0%} of the time, tried again: {item.name}: {said}"))
    _wait_for_calm(watch)
    item.stash.get(BEFORE_ANOTHER, lambda: None)()
    return item.runtest()


def _wait_for_calm(watch: Watch) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        lost_s = watch.lost_s()
        time.sleep(CALM_S)
        if watch.lost_s() - lost_s < HELD_UP * CALM_S:
            return
