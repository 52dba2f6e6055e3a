"""Foreign frames beside a running daemon on a real CAN interface."""

from __future__ import annotations

import gzip
import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bus_tools import CHANNEL, PROJECT, Recording, playing, wait_for

pytestmark = pytest.mark.target("can")

ROAD = PROJECT.parent / "shared" / "measured" / "road_can" / "rav4" / "rav4_60s.log.gz"
RESOLVER, CLAMP_FORCE = 0x100, 0x200
SECOND_SENDER = 1 << 15


@pytest.fixture
def daemon() -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "emb_daemon.cli.main", "run", "--config", str(PROJECT / "config" / "emb.yaml")]
    process = subprocess.Popen([*command, "--interface", "socketcan", "--channel", CHANNEL])
    try:
        yield process
    finally:
        process.terminate()
        process.wait(20)


@pytest.fixture
def traffic(tmp_path: Path) -> Path:
    """Ten seconds of a road car's bus, without the ids on which our own answers are recorded."""
    path = tmp_path / "road.log"
    with gzip.open(ROAD, "rt") as packed, path.open("w") as plain:
        lines = (
            line for line in packed if line.split()[2].partition("#")[0] not in {f"{CLAMP_FORCE + k:03X}" for k in range(4)}
        )
        for line in itertools.islice(lines, 22_000):
            stamp, _, frame = line.split()[:3]
            plain.write(f"{stamp} can0 {frame}\n")
    return path


def test_no_sample_is_lost_in_road_traffic(
    daemon: subprocess.Popen[bytes], record: Callable[..., Recording], rig_log: Path, traffic: Path
) -> None:
    """Every resolver sample is answered once by its counter, with a road car's frames at full rate beside it."""
    with record(f",{CLAMP_FORCE:X}:7FF") as waiting:
        wait_for("the daemon speaks", lambda: waiting.path.read_text().strip(), timeout_s=120)
    with record(f",{RESOLVER:X}:7FF,{CLAMP_FORCE:X}:7FF") as recording, playing(traffic), playing(rig_log) as player:
        wait_for("ten seconds of samples", lambda: recording.path.read_text().count(f" {RESOLVER:03X}#") > 2500, timeout_s=60)
        player.terminate()
    assert daemon.poll() is None
    asked = [frame.data[1] & 15 for frame in recording.frames if frame.can_id == RESOLVER]
    answered = [
        frame.data[6] & 15 for frame in recording.frames if frame.can_id == CLAMP_FORCE and frame.data[6] >> 4 in (0, 1, 2)
    ]
    assert len(asked) > 2500 and len(answered) >= 0.99 * (len(asked) - 2)
