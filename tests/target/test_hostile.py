"""Foreign frames beside a running daemon on a real CAN interface."""

from __future__ import annotations

import gzip
import itertools
from collections.abc import Callable
from pathlib import Path

import pytest
from bus_tools import (
    CLAMP_FORCE,
    PROJECT,
    RESOLVER,
    Recording,
    answers,
    assert_same,
    playing,
    replayed,
    running,
    wait_for,
)

pytestmark = pytest.mark.target("can")

ROAD = PROJECT.parent / "shared" / "measured" / "road_can" / "rav4" / "rav4_60s.log.gz"


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
    record: Callable[..., Recording], rig_log: Path, traffic: Path, tmp_path: Path
) -> None:
    """With a road car's frames at full rate beside the samples, the daemon answers what was on the bus as replay does, which
    has all the time it wants: sample for sample, bit for bit. What the machine held up on its way to the bus, both hear
    late."""
    with running() as daemon:
        with record(f",{CLAMP_FORCE:X}:7FF") as waiting:
            wait_for("the daemon speaks", lambda: waiting.path.read_text().strip(), timeout_s=300)
        with record(f",{CLAMP_FORCE:X}:7FF,100:700") as recording, playing(traffic), playing(rig_log) as player:
            wait_for(
                "ten seconds of samples", lambda: recording.path.read_text().count(f" {RESOLVER:03X}#") > 2500, timeout_s=60
            )
            player.terminate()
            player.wait(60)
            wait_for("answers to the last of them", lambda: recording.is_answered(but=2), timeout_s=60, poll_s=0.5)
        assert daemon.poll() is None
    heard = tmp_path / "heard.log"
    heard.write_text("".join(f"{line}\n" for line in recording.path.read_text().splitlines() if line.split()[2][0] == "1"))
    live, alone = answers(recording.frames), replayed(heard)
    print(f"{len(live)} samples answered live, {len(alone)} by replay")
    assert len(live) > 2000
    # The player may have ended between the last sample and its current, which live waits for and replay has no time to.
    assert abs(len(alone) - len(live)) <= 2
    assert_same(live, alone)
