"""The simulated car and the daemon's pipeline in a closed loop: what the car sends is answered, what is answered is heard."""

from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.learned import (
    LOAD_FRICTION,
    OFFSET_FRICTION,
    PRESLIDING_ANGLE,
    STIFFNESS_RELATIVE_SIGMA,
    STIFFNESS_SIGMA,
    Evaluation,
    curve_values,
)
from emb_daemon.adapt.memory import Memory, entry_of, with_entry
from emb_daemon.adapt.records import ACCEPTED
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.records import TRUTH
from emb_daemon.plant.scenarios import commands_of, park, rest

ROOT = Path(__file__).parent.parent


_SHIPPED = shipped_calibration()


def shipped(**changes):
    """The shipped calibration, with changes."""
    return msgspec.structs.replace(_SHIPPED, **changes)


def accepted(store):
    """A store that has accepted one more training: twice the friction offset."""
    calibration = shipped()
    values = curve_values(calibration, to_parameters(calibration)["curve"]) | {
        LOAD_FRICTION: calibration.friction.load_m_per_rad,
        OFFSET_FRICTION: 2.0 * calibration.friction.offset_Nm,
        PRESLIDING_ANGLE: calibration.friction.presliding_angle_rad,
        STIFFNESS_SIGMA: 60.0,
        STIFFNESS_RELATIVE_SIGMA: 0.01,
    }
    return with_entry(store, entry_of(ACCEPTED, Evaluation(ACCEPTED, values=values), "2026-11-21", 20.0, 3.0))


class ClosedLoop:
    """The simulated car and the daemon's pipeline that learns in ``state``.

    Args:
        pads_mm: what is mounted; the daemon believes in ``calibration``.
        corners: that the car has and the daemon estimates.
    """

    def __init__(self, state: Path, calibration=None, pads_mm: float = 9.5, corners=("FL",)):
        self.calibration, self.corners = calibration or shipped(), corners
        plant = plant_from_calibration(self.calibration, pad_thickness_mm=pads_mm)
        self.car = Car(np.repeat(np.atleast_1d(plant), len(corners)), corners, 1)
        calibrations = dict.fromkeys(corners, self.calibration)
        self.adaptation = Adaptation(calibrations, Memory(state), int)
        self.parameters = np.zeros(4, PARAMETERS)
        self.pipeline = Pipeline(self.parameters, corners, capacity=64, adaptation=self.adaptation)
        self.pipeline.begin(0)
        self.sent = []

    def run(self, schedule, until=None, spoil=None):
        """Drive ``schedule`` until it, or ``until(estimate)``, ends; returns (ESTIMATE rows, TRUTH rows), the truth being the
        first corner's or, of several, all corners' in a row each.

        ``spoil(frames)`` may return other frames in their place."""
        # By their bytes: numpy copies records field by field, which would take as long as all the rest.
        estimates, truths, counts = bytearray(), bytearray(), []
        commands = commands_of(schedule, self.corners)
        for row in range(len(schedule)):
            frames = self.car.tick(commands[row], schedule.drives[row])
            _, count = self.pipeline.consume(frames if spoil is None else spoil(frames))
            answers = self.pipeline.broadcast(count)
            self.car.receive(answers)
            truths += self.car.truth.tobytes()
            estimates += self.pipeline.estimates[:count].tobytes()
            counts.append(count)
            if until is not None and count and until(self.pipeline.estimates[count - 1]):
                break
        truths = np.repeat(np.frombuffer(truths, TRUTH).reshape(len(counts), -1), counts, axis=0)
        return np.frombuffer(estimates, ESTIMATE), truths if len(self.corners) > 1 else truths[:, 0]


def parked(seconds: float, force_N: float = 0.0):
    """Rest, then the park brake applied for ``seconds``, clamped by the motor with ``force_N``."""
    schedule = rest(1.0) + park(max(force_N, 1.0), seconds)
    if not force_N:
        schedule.commands["mode"], schedule.commands["target"] = 0, 0.0
    return schedule
