"""The simulated car in a process of its own, on an inherited socket; measures when the daemon's answers leave.

Run as ``python -m emb_daemon.bench.car CORNERS SECONDS PRIORITY FD``; prints a line when it is ready, waits for the daemon's
first frame, and prints a JSON line at the end.
"""

import json
import select
import socket
import sys
import time

import numpy as np

from emb_daemon.bench.loop import quantiles
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.demo.recorder import Recorder
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.records import CYCLE_NS
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.runtime.rawcan import RawCanSocket
from emb_daemon.runtime.realtime import settle_memory, use_fifo
from emb_daemon.wire.layout import CORNERS

#: Time from the beginning of a cycle's computation until its frames leave, as by a timer; independent of how long it takes.
_COMPUTING_NS = 500_000


class _Bus:
    """The bus, on which frames leave at their time in the cycle."""

    def __init__(self, descriptor: int):
        self._descriptor, self._epoch_ns = descriptor, 0
        self._bus = RawCanSocket(socket.socket(fileno=descriptor), stamped=True)
        self.drain = self._bus.drain

    def wait(self, timeout_s: float) -> bool:
        # poll() is not used: it counts in ms, and the car's delay would count as the daemon's latency.
        return bool(select.select([self._descriptor], [], [], timeout_s)[0])

    def send(self, frames: np.ndarray) -> None:
        now = time.monotonic_ns()
        self._epoch_ns = self._epoch_ns or now + _COMPUTING_NS
        early = (self._epoch_ns - now) % CYCLE_NS
        if early < 2 * _COMPUTING_NS:
            time.sleep(1e-9 * early)
        self._bus.send(frames)


def main() -> None:
    corners, seconds, priority, descriptor = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    bus = _Bus(descriptor)
    calibration = shipped_calibration()
    plants = np.array([plant_from_calibration(calibration, seed) for seed in range(corners)])
    live = LiveCar(Car(plants, CORNERS[:corners]), bus, city_drive())
    live.warm_up()
    recorder = Recorder(CORNERS[:corners], seconds)
    # Load compiled code now, not while answers are timed.
    recorder.compare(0)
    settle_memory()
    use_fifo(priority)
    print("ready", time.process_time(), flush=True)
    bus.wait(300.0)
    bus.drain()
    live.run(lambda: False, seconds, recorder.note_sent, recorder.note_received)
    compared = [recorder.compare(row) for row in range(corners)]
    latency_us = 1e6 * np.concatenate([corner.response_s for corner in compared])
    result = {"samples": sum(corner.samples for corner in compared), "answered": len(latency_us)}
    result |= {"late": live.late, "lost": live.lost, "in_time": int(np.sum(latency_us <= CYCLE_NS / 1e3))}
    print(json.dumps(result | quantiles(latency_us)))


if __name__ == "__main__":
    main()
