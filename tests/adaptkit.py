"""The simulated car and the daemon's pipeline in a closed loop: what the car sends is answered, what is answered is heard."""

from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.records import TRUTH
from emb_daemon.plant.scenarios import commands_of, park, rest

ROOT = Path(__file__).parent.parent


def shipped(**changes):
    """The shipped calibration, with changes."""
    return msgspec.structs.replace(load_calibration(ROOT / "config" / "calibration.yaml"), **changes)


class ClosedLoop:
    """One corner of the simulated car and the daemon's pipeline that learns in ``state``.

    Args:
        pads_mm: what is mounted; the daemon believes in ``calibration``.
    """

    def __init__(self, state: Path, calibration=None, pads_mm: float = 9.5, seed: int = 1):
        self.calibration = calibration or shipped()
        self.car = Car(np.atleast_1d(plant_from_calibration(self.calibration, pad_thickness_mm=pads_mm)), ("FL",), seed)
        self.adaptation = Adaptation({"FL": self.calibration}, Memory(state), lambda time_ns: f"{1e-9 * time_ns:.1f}")
        self.parameters = np.zeros(4, PARAMETERS)
        self.parameters[0] = to_parameters(self.calibration)
        self.pipeline = Pipeline(self.parameters, ("FL",), capacity=64, adaptation=self.adaptation)
        self.pipeline.begin(0)
        self.sent = []

    def run(self, schedule, until=None, spoil=None):
        """Drive ``schedule`` until it, or ``until(estimate)``, ends; returns (ESTIMATE rows, TRUTH rows).

        ``spoil(frames)`` may return other frames in their place."""
        estimates, truths = [], []
        commands = commands_of(schedule, ("FL",))
        for row in range(len(schedule)):
            frames = self.car.tick(commands[row], schedule.drives[row])
            truth = self.car.truth[0].copy()
            _, count = self.pipeline.consume(frames if spoil is None else spoil(frames))
            answers = self.pipeline.broadcast(count)
            self.car.hear(answers)
            for estimate in self.pipeline.estimates[:count]:
                estimates.append(estimate.copy())
                truths.append(truth)
            if until is not None and count and until(self.pipeline.estimates[count - 1]):
                break
        return np.array(estimates), np.array(truths, TRUTH)


def parked(seconds: float, force_N: float = 0.0):
    """Rest, then the park brake applied for ``seconds``, clamped by the motor with ``force_N``."""
    schedule = rest(1.0) + park(max(force_N, 1.0), seconds)
    if not force_N:
        schedule.commands["mode"], schedule.commands["target"] = 0, 0.0
    return schedule
