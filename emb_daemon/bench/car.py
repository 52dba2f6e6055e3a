"""The simulated car in a process of its own, on an inherited socket; measures when the daemon's answers leave.

Run as ``python -m emb_daemon.bench.car FD CORNERS SECONDS PRIORITY``; waits for the daemon's first frame, prints a JSON line.
"""

import json
import socket
import sys
import threading

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.resources import resource
from emb_daemon.runtime.rawcan import RawCanSocket
from emb_daemon.runtime.realtime import settle_memory, use_fifo
from emb_daemon.wire.layout import CORNERS

_CLAMP_FORCE = 0x200


class _Answers:
    """Time from a sample's last frame to its answer, matched by the InputCounter."""

    def __init__(self, live: LiveCar):
        self._live = live
        self._sent = np.zeros((4, 15), np.int64)
        self.latency_us: list[float] = []
        self.samples = 0

    def sent(self, time_ns: int, truth: np.ndarray) -> None:
        if time_ns:
            corners = range(len(truth))
            self._sent[list(corners), truth["counter"]] = time_ns
            self.samples += len(truth)

    def heard(self, frames: np.ndarray) -> None:
        mine = frames[(frames["can_id"] >= _CLAMP_FORCE) & (frames["can_id"] < _CLAMP_FORCE + 4)]
        source = (mine["data"] >> np.uint64(52)) & np.uint64(15)
        for frame in mine[source < 3]:
            counter = int(frame["data"] >> np.uint64(48)) & 15
            self.latency_us.append((int(frame["time_ns"]) - self._sent[frame["can_id"] - _CLAMP_FORCE, counter]) / 1e3)


def main() -> None:
    descriptor, corners, seconds, priority = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    bus = RawCanSocket(socket.socket(fileno=descriptor), stamped=True)
    calibration = load_calibration(resource("config/calibration.yaml"))
    plants = np.array([plant_from_calibration(calibration, seed) for seed in range(corners)])
    live = LiveCar(Car(plants, CORNERS[:corners], reference=False), bus, city_drive())
    live.warm_up()
    answers = _Answers(live)
    settle_memory()
    use_fifo(priority)
    bus.wait(300.0)
    bus.drain()
    live.run(threading.Event(), seconds, answers.sent, answers.heard)
    latency = np.array(answers.latency_us or [np.nan])
    result = {"samples": answers.samples, "answered": len(answers.latency_us), "late": live.late, "lost": live.lost}
    print(json.dumps(result | {"p50_us": float(np.median(latency)), "p99_us": float(np.percentile(latency, 99))}))


if __name__ == "__main__":
    main()
