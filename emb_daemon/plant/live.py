"""The simulated car in real time on a bus."""

import time
from collections.abc import Callable

import numpy as np

from emb_daemon.plant.car import Car
from emb_daemon.plant.records import CYCLE_NS
from emb_daemon.plant.scenarios import Schedule, commands_of
from emb_daemon.runtime.bus import Bus

#: If the machine delays the frames of a cycle by more than this, they are lost, as on a real bus; the car's time and counters
#: follow the clock.
_LOST_NS = 2 * CYCLE_NS


class LiveCar:
    """Drives a schedule repeatedly, one cycle every 4 ms, and receives the daemon's frames between two cycles. ``ticks``:
    cycles run; ``late``: cycles that left more than half a cycle after their time, caused by the machine; ``lost``: cycles
    whose frames were not sent at all because their time had passed."""

    def __init__(self, car: Car, bus: Bus, schedule: Schedule):
        self.car = car
        self._bus = bus
        self._drives = schedule.drives
        self._commands = commands_of(schedule, car.corners)
        self.ticks: int = 0
        self.late: int = 0
        self.lost: int = 0

    def warm_up(self) -> None:
        """Compile, or load from the cache, what a cycle calls; the car stays as it is."""
        spare = Car(self.car.plants, self.car.corners)
        spare.receive(spare.tick(self._commands[0], self._drives[0]))

    def run(
        self, stopped: Callable[[], bool], seconds: float | None = None, sent: Callable[[int, np.ndarray], None] | None = None,
        received: Callable[[np.ndarray], None] | None = None,
    ) -> None:  # fmt: skip
        """Run until ``stopped()`` or ``seconds`` are over.

        ``sent(time_ns, truth)`` is called after each cycle, with its TRUTH rows and the time when it left, 0 if it was lost;
        ``received(frames)`` is called with the frames received since. Both views are valid during the call only."""
        last = None if seconds is None else round(seconds * 1e9 / CYCLE_NS)
        deadline = time.monotonic_ns()
        while not stopped() and self.ticks != last:
            row = self.ticks % len(self._drives)
            frames = self.car.tick(self._commands[row], self._drives[row])
            self.ticks += 1
            now = time.monotonic_ns()
            lost = now - deadline > _LOST_NS
            self.lost += lost
            if not lost:
                self._bus.send(frames)
                now = time.monotonic_ns()
                self.late += now - deadline > CYCLE_NS // 2
            if sent is not None:
                sent(0 if lost else now, self.car.truth)
            deadline += CYCLE_NS
            self._listen(deadline, received)

    def _listen(self, deadline: int, received: Callable[[np.ndarray], None] | None) -> None:
        while True:
            remaining = deadline - time.monotonic_ns()
            if remaining > 0:
                self._bus.wait(1e-9 * remaining)
            frames = self._bus.drain()
            if len(frames):
                self.car.receive(frames)
                if received is not None:
                    received(frames)
            if remaining <= 0:
                return
