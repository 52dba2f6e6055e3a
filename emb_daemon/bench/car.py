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

from emb_daemon.calibration.files import load_calibration
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.records import CYCLE_NS
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.resources import resource
from emb_daemon.runtime.rawcan import RawCanSocket
from emb_daemon.runtime.realtime import settle_memory, use_fifo
from emb_daemon.wire.contract import PREDICTED
from emb_daemon.wire.e2e import COUNTER_MODULO
from emb_daemon.wire.layout import CLAMP_FORCE, CORNERS, default_layout, load_database, signal_columns, unpack

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


class _Answers:
    """Time from a sample's last frame to its answer, matched by the InputCounter."""

    def __init__(self):
        self._sent = np.zeros((len(CORNERS), COUNTER_MODULO), np.int64)
        self._ids = default_layout()[0]["sent_id"][CLAMP_FORCE].tolist()
        database, names = load_database(resource("dbc/emb.dbc")), ("InputCounter", "ForceSource")
        self._counter, self._source = signal_columns(database, f"EMB_{CORNERS[0]}_ClampForce", names)
        # Compile now, not while answers are timed.
        unpack(np.uint64(0), self._source)
        self.latency_us: list[float] = []
        self.samples = 0

    def note_sent(self, time_ns: int, truth: np.ndarray) -> None:
        if time_ns:
            corners = range(len(truth))
            self._sent[list(corners), truth["counter"]] = time_ns
            self.samples += len(truth)

    def note_heard(self, frames: np.ndarray) -> None:
        for frame in frames[np.isin(frames["can_id"], self._ids)]:
            if unpack(frame["data"], self._source) < PREDICTED:
                corner, counter = self._ids.index(frame["can_id"]), int(unpack(frame["data"], self._counter))
                self.latency_us.append((int(frame["time_ns"]) - self._sent[corner, counter]) / 1e3)


def main() -> None:
    corners, seconds, priority, descriptor = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    bus = _Bus(descriptor)
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
    live.run(lambda: False, seconds, answers.note_sent, answers.note_heard)
    latency = np.array(answers.latency_us or [np.nan])
    result = {"samples": answers.samples, "answered": len(answers.latency_us), "late": live.late, "lost": live.lost}
    result["in_time"] = int(np.sum(latency <= CYCLE_NS / 1e3))
    print(json.dumps(result | {"p50_us": float(np.median(latency)), "p99_us": float(np.percentile(latency, 99))}))


if __name__ == "__main__":
    main()
