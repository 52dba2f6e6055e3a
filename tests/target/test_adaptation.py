"""The daemon and the simulated car on a real bus: a parked car is asked for training motion, gives it, and it is accepted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from bus_tools import CHANNEL, RESOLVER, wait_for

from emb_daemon.adapt.memory import Memory
from emb_daemon.resources import resource
from emb_daemon.runtime.bus import open_bus
from emb_daemon.wire.contract import RESULT_ACCEPTED

pytestmark = pytest.mark.target("can")

_REQUEST_ID, _FORCE_ID, _STATUS_ID = 0x230, 0x200, 0x220
_RUN, _INVALID = 1, 15
# Two samples of three.
_MISSING_NS = 10_000_000
_PATIENCE_S = 200.0
# It must hear the drive from its beginning: started after the first stops it does not know how warm the pads are, and asks
# nothing for minutes.
_START_S = 200.0


def test_a_parked_car_is_asked_and_its_answer_accepted(tmp_path: Path) -> None:
    """`emb-daemon run` and `emb-daemon simulate`, processes of their own; the forces stay valid, but where
    the machine took the car's samples and no force could be."""
    for _ in range(2):
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        seen = _train(folder)
        # A training ends if its inputs are lost. Where the machine takes samples from each, none can be accepted.
        if seen["accepted"] or not seen["disturbed"] or seen["undisturbed"]:
            break
    else:
        pytest.skip(f"NOT RUN: the machine took samples from each of {seen['disturbed']} trainings, twice")
    assert seen["requests"] and seen["accepted"]
    assert not seen["invalid"], "the estimate goes on during training"
    store = Memory(folder / "state").read("FL")
    assert store is not None and store.current is not None, "what was accepted is kept"


def _train(tmp_path: Path) -> dict[str, int]:
    """What `_listen` sees of a daemon and a car."""
    config, state = tmp_path / "emb.yaml", tmp_path / "state"
    corner = f"{{FL: {{calibration: {resource('config/calibration.yaml')}}}}}"
    config.write_text(f"format: 1\ncorners: {corner}\nrealtime: {{fifo_priority: 60, lock_memory: false}}\n")
    command = [sys.executable, "-m", "emb_daemon.cli.main"]
    on_bus = ["-i", "socketcan", "-c", CHANNEL]
    environment = os.environ | {"STATE_DIRECTORY": str(state)}
    bus = open_bus("socketcan", CHANNEL, [_REQUEST_ID, _FORCE_ID, _STATUS_ID, RESOLVER])
    processes = [subprocess.Popen([*command, "run", "--config", str(config), *on_bus], env=environment)]
    try:
        wait_for("the daemon speaks", lambda: len(bus.drain()), _START_S)
        car = ["chrt", "-f", "70", *command, "simulate", "--scenario", "park", "--corners", "1", *on_bus]
        processes.insert(0, subprocess.Popen(car))
        seen = _listen(bus, time.monotonic() + _PATIENCE_S)
    finally:
        for process in processes:
            process.send_signal(signal.SIGTERM)
        statuses = [process.wait(20) for process in processes]
        bus.close()
    print(seen)
    assert statuses == [0, 0]
    return seen


def _listen(bus, end: float) -> dict[str, int]:
    """Messages seen until one says Accepted: requests to run, accepted results, and forces that are invalid from the first
    request on. Not those until the next training, if samples were missing on the bus: such trainings are disturbed."""
    seen = dict.fromkeys(("requests", "accepted", "invalid", "disturbed", "undisturbed"), 0)
    invalid, asked, missing, sample_ns = 0, False, False, 0
    while not seen["accepted"] and time.monotonic() < end:
        # In batches: the two processes that are watched share the machine, perhaps its only CPU, with this one.
        time.sleep(0.2)
        for frame in bus.drain():
            can_id, payload = int(frame["can_id"]), int(frame["data"])
            if can_id == _REQUEST_ID:
                asks = payload >> 16 & 3 == _RUN
                if asks and not asked:
                    seen["invalid"] += 0 if missing else invalid
                    invalid, missing = 0, False
                elif asked and not asks:
                    seen["disturbed" if missing else "undisturbed"] += 1
                asked = asks
                seen["requests"] += asks
                seen["accepted"] += payload >> 25 & 15 == RESULT_ACCEPTED
            elif can_id == _FORCE_ID and seen["requests"]:
                invalid += payload >> 52 & 15 == _INVALID
            elif can_id == RESOLVER:
                missing |= int(frame["time_ns"]) - sample_ns > _MISSING_NS
                sample_ns = int(frame["time_ns"])
    # In a training that is accepted none is missing.
    seen["invalid"] += invalid
    return seen
