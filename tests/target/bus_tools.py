"""can-utils as the tests use them: a log played onto the bus, frames recorded from it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Self

import pytest

CHANNEL = "vcan0"
PROJECT = Path(__file__).resolve().parents[2]
RIG = PROJECT.parent / "shared" / "rig"
RESOLVER, CLAMP_FORCE = 0x100, 0x200  # of the first corner
PREDICTED = 3
_LOST = "DROPCOUNT"


def wait_for(what: str, condition: Callable[[], object], timeout_s: float, poll_s: float = 0.05) -> float:
    """Waits until the condition is true and returns how long that took; fails the test if it takes too long."""
    start = time.monotonic()
    while not condition():
        if time.monotonic() - start > timeout_s:
            pytest.fail(f"{what}: not within {timeout_s} s")
        time.sleep(poll_s)
    return time.monotonic() - start


class Frame(NamedTuple):
    time_s: float
    can_id: int
    data: bytes


def read_log(path: Path) -> list[Frame]:
    """Classic data frames of a candump log, which may still be written and say between them how many it lost."""
    frames, text = [], path.read_text()
    for line in text[: text.rfind("\n") + 1].splitlines():
        if line.startswith(_LOST):
            continue
        stamp, _, frame = line.split()[:3]
        can_id, _, data = frame.partition("#")
        if len(can_id) == 3:
            frames.append(Frame(float(stamp[1:-1]), int(can_id, 16), bytes.fromhex(data)))
    return frames


class Recording:
    """candump on a channel, from the moment it listens until the `with` block ends.

    A recording of which candump lost frames judges nobody: its test is skipped, which .ci/run says."""

    def __init__(self, path: Path, filters: str = "") -> None:
        self.path = path
        # A large buffer: in a guest with one CPU the real-time daemon and player go before it.
        self._command = ["candump", "-L", "-d", "-r", str(32 << 20), f"{CHANNEL}{filters}"]
        self.frames: list[Frame] = []

    def __enter__(self) -> Self:
        self._output = self.path.open("w")
        self._process = subprocess.Popen(self._command, stdout=self._output)
        wait_for("candump listens", self.has_read_all, timeout_s=60)
        return self

    def has_read_all(self) -> bool:
        """It has its socket and sleeps: there is no frame that it has not read."""
        with contextlib.suppress(FileNotFoundError):
            process = Path("/proc", str(self._process.pid))
            sockets = [fd for fd in (process / "fd").iterdir() if os.readlink(fd).startswith("socket:")]
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
            return bool(sockets) and state == "S"
        return False

    def is_answered(self, but: int = 0) -> bool:
        """All that was on the bus is read, and all samples ``but`` so many have their answers. What is read so far is answered
        but for the last of it, however much is still to be read and to be answered."""
        if not self.has_read_all():
            return False
        frames = read_log(self.path)
        return sum(frame.can_id == RESOLVER for frame in frames) - len(answers(frames)) <= but

    def __exit__(self, *_: object) -> None:
        # On a machine with little time, what was on the bus is still in its socket.
        wait_for("candump has read its frames", self.has_read_all, timeout_s=60)
        self._process.send_signal(signal.SIGINT)
        self._process.wait(60)
        self._output.close()
        self.frames = read_log(self.path)
        if lost := [line for line in self.path.read_text().splitlines() if line.startswith(_LOST)]:
            pytest.skip(f"NOT RUN: the machine kept candump from its frames: {lost[-1]}")


@contextlib.contextmanager
def running() -> Iterator[subprocess.Popen[bytes]]:
    """The daemon with the shipped configuration. No fixture: a test that is tried again must not find the first one's."""
    config = PROJECT / "config" / "emb.yaml"
    command = [sys.executable, "-m", "emb_daemon.cli.main", "run", "--config", str(config)]
    process = subprocess.Popen([*command, "--interface", "socketcan", "--channel", CHANNEL])
    try:
        yield process
    finally:
        process.terminate()
        process.wait(20)


@contextlib.contextmanager
def playing(log: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """canplayer plays the log, in its own time unless options say otherwise, until it or the `with` block ends.

    Before the daemon: a car's other controllers do not wait for it, but in a guest they would share its only CPU."""
    recorded_on = re.findall(r"\) (\S+) ", log.open().readline())[0]
    command = ["canplayer", "-I", str(log), *options, f"{CHANNEL}={recorded_on}"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(70))
    try:
        yield process
    finally:
        process.kill()
        process.wait(60)


def answering(frames: list[Frame]) -> list[Frame]:
    """The clamp force frames that answer a resolver sample, not the predictions."""
    return [frame for frame in frames if frame.can_id == CLAMP_FORCE and frame.data[6] >> 4 < PREDICTED]


def answers(frames: list[Frame]) -> list[bytes]:
    """Payloads behind the E2E header of those."""
    return [frame.data[2:] for frame in answering(frames)]


def waits(frames: list[Frame]) -> list[float]:
    """Time from each resolver sample to its answer, s."""
    asked = [frame.time_s for frame in frames if frame.can_id == RESOLVER]
    return [answer.time_s - time_s for time_s, answer in zip(asked, answering(frames), strict=False)]


def assert_same(live: list[bytes], replayed: list[bytes]) -> None:
    """Answers are those of replay, bit for bit."""
    fields = struct.Struct("<HHBB")
    pairs = enumerate(zip(map(fields.unpack, live), map(fields.unpack, replayed), strict=False))
    differ = [(number, *pair) for number, pair in pairs if pair[0] != pair[1]]
    print(f"{len(differ)} answers differ from replay's (number, live, replayed): {differ[:20]}")
    assert not differ


def replayed(log: Path, environment: dict[str, str] | None = None) -> list[bytes]:
    """Answers that `emb-daemon replay` gives to a log."""
    output = log.with_suffix(".replayed.log")
    command = [sys.executable, "-m", "emb_daemon.cli.main", "replay", str(log), "--output", str(output)]
    subprocess.run(command, check=True, stdout=sys.stdout, env=os.environ | (environment or {}))
    return answers(read_log(output))
