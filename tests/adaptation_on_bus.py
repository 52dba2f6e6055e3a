"""The daemon and the simulated car on a real bus: a parked car is asked for training motion, gives it, and it is accepted.

    python tests/adaptation_on_bus.py -i socketcan -c vcan0
    python tests/adaptation_on_bus.py -i udp_multicast -c 239.74.163.2

Runs `emb-daemon run` and `emb-daemon simulate` as processes of their own and listens to what passes between them.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from emb_daemon.adapt.memory import Memory
from emb_daemon.adapt.records import RESULT_ABORTED, RESULT_ACCEPTED
from emb_daemon.resources import resource
from emb_daemon.runtime.bus import open_bus
from emb_daemon.wire.layout import CORNERS

_REQUEST_ID, _FORCE_ID = 0x230, 0x200
_RUN = 1
_INVALID = 15


def request_is_accepted(interface: str, channel: str, corners: int = 1, patience_s: float = 90.0) -> dict:
    """Whether a request leads to Accepted on every corner, and its values to a file.

    Returns what was seen: ``asked`` and ``accepted`` corners, whether any force ``invalid`` passed after the first request,
    ``remembered`` corners.
    """
    bus_options = ["-i", interface, "-c", channel]
    command = [sys.executable, "-m", "emb_daemon.cli.main"]
    with tempfile.TemporaryDirectory() as folder:
        config, state = Path(folder, "emb.yaml"), Path(folder, "state")
        names = ", ".join(f"{name}: {{calibration: {resource('config/calibration.yaml')}}}" for name in CORNERS[:corners])
        config.write_text(f"format: 1\ncorners: {{{names}}}\nrealtime: {{fifo_priority: null, lock_memory: false}}\n")
        environment = os.environ | {"STATE_DIRECTORY": str(state)}
        daemon = subprocess.Popen([*command, "run", "--config", str(config), *bus_options], env=environment)
        car = subprocess.Popen([*command, "simulate", "--scenario", "park", "--corners", str(corners), *bus_options])
        try:
            ids = [base + corner for base in (_REQUEST_ID, _FORCE_ID) for corner in range(corners)]
            bus = open_bus(interface, channel, ids)
            seen = _listen(bus, corners, time.monotonic() + patience_s)
            bus.close()
        finally:
            for process in (car, daemon):
                process.send_signal(signal.SIGTERM)
            for process in (car, daemon):
                process.wait(20)
        seen["remembered"] = {name for name in CORNERS[:corners] if (store := Memory(state).read(name)) and store.current}
    return seen


def _listen(bus, corners: int, end: float) -> dict:
    asked, accepted, aborted, invalid = set(), set(), 0, 0
    while len(accepted) < corners and time.monotonic() < end:
        # In batches: the two processes that are watched share the machine, perhaps its only CPU, with this one.
        time.sleep(0.1)
        for frame in bus.drain():
            can_id, payload = int(frame["can_id"]), int(frame["data"])
            corner = CORNERS[can_id & 3]
            if can_id & ~3 == _REQUEST_ID:
                result = payload >> 25 & 15
                if payload >> 16 & 3 == _RUN:
                    asked.add(corner)
                if result == RESULT_ACCEPTED:
                    accepted.add(corner)
                aborted += result == RESULT_ABORTED
            elif can_id & ~3 == _FORCE_ID and asked:
                invalid += payload >> 52 & 15 == _INVALID
    return {"asked": asked, "accepted": accepted, "aborted_messages": aborted, "invalid": invalid}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-i", "--interface", default="socketcan")
    parser.add_argument("-c", "--channel", default="vcan0")
    parser.add_argument("--corners", type=int, default=1)
    arguments = parser.parse_args()
    seen = request_is_accepted(arguments.interface, arguments.channel, arguments.corners)
    print(seen)
    expected = set(CORNERS[: arguments.corners])
    return 0 if seen["accepted"] == seen["asked"] == seen["remembered"] == expected and not seen["invalid"] else 1


if __name__ == "__main__":
    sys.exit(main())
