"""A guest's test is tried again where the machine was held up, and nowhere else."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace

import machine
import pytest
from machine import Watch, tried_again


class _Item(SimpleNamespace):
    """Of a test as pytest has it, what is asked for."""

    def __init__(self) -> None:
        super().__init__(name="test", stash=pytest.Stash(), said=[], runs=0)

    def warn(self, warning: Warning) -> None:
        self.said.append(str(warning))

    def runtest(self) -> None:
        self.runs += 1


def _watch(*lost_s: float, badly_s: float = 0.0) -> SimpleNamespace:
    values = iter(lost_s)
    return SimpleNamespace(lost_s=lambda: next(values), badly_s=lambda: badly_s)


def _fail(item: _Item, share: float | None, badly_s: float = 0.0) -> None:
    """The item fails after 50 ms, of which this share was lost; None: where nothing watches."""
    running = tried_again(item, None if share is None else _watch(1.0, 1.0 + 0.05 * share, 2.0, 2.0, badly_s=badly_s))
    next(running)
    time.sleep(0.05)
    with pytest.raises(StopIteration):
        running.throw(AssertionError("too late"))


@pytest.mark.parametrize("share", [None, 0.0, 0.03])
def test_what_fails_on_a_machine_that_was_there_has_failed(share: float | None) -> None:
    item = _Item()
    with pytest.raises(AssertionError, match="too late"):
        _fail(item, share)
    assert item.runs == 0 and not item.said


def test_what_fails_while_the_machine_was_held_up_is_tried_once_more_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    item = _Item()
    monkeypatch.setattr(machine, "CALM_S", 0.01)
    _fail(item, 0.9)
    assert item.runs == 1
    [said] = item.said
    assert said.startswith("HELD UP") and "too late" in said


def test_what_fails_while_it_was_held_up_shortly_is_tried_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a test of minutes that is a small share, but long enough for a watchdog."""
    item = _Item()
    monkeypatch.setattr(machine, "CALM_S", 0.01)
    _fail(item, 0.01, badly_s=time.monotonic() + 0.02)
    assert item.runs == 1
    with pytest.raises(AssertionError, match="too late"):
        _fail(item, 0.01, badly_s=time.monotonic() - 1.0)


def test_it_is_tried_once_the_machine_is_there_again(monkeypatch: pytest.MonkeyPatch) -> None:
    item, asleep = _Item(), []
    monkeypatch.setattr(machine, "CALM_S", 0.01)
    monkeypatch.setattr("machine.time.sleep", asleep.append)
    running = tried_again(item, _watch(1.0, 2.0, 2.0, 2.1, 2.1, 2.1))
    next(running)
    with pytest.raises(StopIteration):
        running.throw(AssertionError("too late"))
    assert asleep == [0.01, 0.01] and item.runs == 1


@pytest.mark.target("can")
@pytest.mark.parametrize(("priority", "counts"), [(60, False), (99, True)])
def test_what_the_daemon_takes_is_no_machine_that_was_held_up(priority: int, counts: bool) -> None:
    """A process of the daemon's priority that takes the only CPU, and one that goes before the one that watches. What the
    machine itself takes meanwhile is lost, too: the least of some times counts."""
    anywhere = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(anywhere)})
    watch = Watch()
    try:
        lost_s = [_lost_beside(priority, watch) for _ in range(5)]
    finally:
        watch.close()
        os.sched_setaffinity(0, anywhere)
    print(f"{lost_s} s of 0.5 s lost each")
    assert (min(lost_s) > 0.4) == counts


def _lost_beside(priority: int, watch: Watch) -> float:
    """Seconds, beside a process that takes its CPU for 0.5 s."""
    time.sleep(0.2)
    before_s = watch.lost_s()
    if not (child := os.fork()):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        end_s = time.monotonic() + 0.5
        while time.monotonic() < end_s:
            pass
        os._exit(0)
    os.waitpid(child, 0)
    time.sleep(0.2)
    return watch.lost_s() - before_s
