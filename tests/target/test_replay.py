"""What the daemon says on a real bus is what replay says of the same log."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from bus_tools import RIG, Frame, Recording, playing, read_log, wait_for

pytestmark = pytest.mark.target("systemd")

UNIT = "emb-daemon.service"
LOG = RIG / "static" / "random_6p5mm.log.gz"
CLAMP_FORCE = 0x200
PREDICTED = 3


def answers(frames: list[Frame]) -> list[bytes]:
    """Payloads behind the E2E header of the clamp force frames that answer a resolver sample, not of the predictions."""
    return [f.data[2:] for f in frames if f.can_id == CLAMP_FORCE and f.data[6] >> 4 < PREDICTED]


def test_live_payloads_equal_replayed_ones(record: Callable[..., Recording], tmp_path: Path) -> None:
    """Every resolver sample that the daemon received is answered by the payload that replay gives it."""
    plain = tmp_path / "random_6p5mm.log"
    plain.write_bytes(gzip.decompress(LOG.read_bytes()))
    subprocess.run(["systemctl", "restart", UNIT], check=True)
    with record(",200:7FF,100:7FF") as recording:
        time.sleep(1)
        with playing(plain) as player:
            wait_for("the log is played", lambda: player.poll() is not None, timeout_s=90, poll_s=0.5)
        time.sleep(0.5)
    live = answers(recording.frames)
    received = sum(frame.can_id == 0x100 for frame in recording.frames)
    replayed_log = tmp_path / "replayed.log"
    command = ["emb-daemon", "replay", str(plain), "--output", str(replayed_log)]
    # With the daemon's own compiled code: compiling anew beside the running daemon takes minutes in a guest with one CPU.
    environment = os.environ | {"NUMBA_CACHE_DIR": "/var/cache/emb_daemon/numba"}
    subprocess.run(command, check=True, stdout=sys.stdout, env=environment)
    replayed = answers(read_log(replayed_log))
    equal = sum(a == b for a, b in zip(live, replayed, strict=False))
    print(f"{received} resolver samples on the bus, {len(live)} answered, {equal} of {len(replayed)} payloads equal replay's")
    assert len(live) == received == len(replayed)
    assert equal == len(replayed)
