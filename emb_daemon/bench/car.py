"""The simulated car in a process of its own, on an inherited socket; measures when the daemon's answers leave.

Run as ``python -m emb_daemon.bench.car CORNERS SECONDS PRIORITY FD...``; prints a line when it is ready, waits for the
daemon's first frame, and prints a JSON line at the end. All buses get the same frames; the car listens to the first only.
"""

import json
import select
import socket
import sys
import time

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.records import CYCLE_NS
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.resources import resource
from emb_daemon.runtime.rawcan import RawCanSocket
from emb_daemon.runtime.realtime import settle_memory, use_fifo
from emb_daemon.wire.layout import CORNERS

_CLAMP_FORCE = 0x200
#: Time from the beginning of a cycle's computation until its frames leave, as by a timer; independent of how long it takes.
_COMPUTING_NS = 500_000


class _Buses:
    """Several buses that get the same frames; frames are received from the first only."""

    def __init__(self, descriptors: list[int]):
        self._descriptor = descriptors[0]
        self._first, *self._others = [RawCanSocket(socket.socket(fileno=fd), stamped=True) for fd in descriptors]
        self._epoch_ns = 0

    def wait(self, timeout_s: float) -> bool:
        # poll() is not used: it counts in ms, and the car's delay would count as the daemon's latency.
        return bool(select.select([self._descriptor], [], [], timeout_s)[0])

    def drain(self) -> np.ndarray:
        for bus in self._others:
            bus.drain()
        return self._first.drain()

    def send(self, frames: np.ndarray) -> None:
        now = time.monotonic_ns()
        self._epoch_ns = self._epoch_ns or now + _COMPUTING_NS
        early = (self._epoch_ns - now) % CYCLE_NS
        if early < 2 * _COMPUTING_NS:
            time.sleep(1e-9 * early)
        # The first bus last, because its answers are timed from here.
        for bus in (*self._others, self._first):
            bus.send(frames)


class _Answers:
    """Time from a sample's last frame to its answer, matched by the InputCounter."""

    def __init__(self):
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
    corners, seconds, priority, descriptors = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
    bus = _Buses([int(descriptor) for descriptor in descriptors])
    calibration = load_calibration(resource("config/calibration.yaml"))
    plants = np.array([plant_from_calibration(calibration, seed) for seed in range(corners)])
    live = LiveCar(Car(plants, CORNERS[:corners], reference=False), bus, city_drive())
    live.warm_up()
    answers = _Answers()
    settle_memory()
    use_fifo(priority)
    print("ready", time.process_time(), flush=True)
    bus.wait(300.0)
    bus.drain()
    live.run(lambda: False, seconds, answers.sent, answers.heard)
    latency = np.array(answers.latency_us or [np.nan])
    result = {"samples": answers.samples, "answered": len(answers.latency_us), "late": live.late, "lost": live.lost}
    result["in_time"] = int(np.sum(latency <= CYCLE_NS / 1e3))
    print(json.dumps(result | {"p50_us": float(np.median(latency)), "p99_us": float(np.percentile(latency, 99))}))


if __name__ == "__main__":
    main()
