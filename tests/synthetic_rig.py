"""Logs of rigs with known parameters: the estimator's own physics with drawn values, plus every sensor's noise."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np

from emb_daemon.calibration.parameters import INERTIA, LOAD_FRICTION, OFFSET_FRICTION, PRESLIDING_ANGLE, TORQUE_CONSTANT, moved
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import Calibration
from emb_daemon.estimator.records import SAMPLE
from emb_daemon.identify.calibration import nominal
from emb_daemon.identify.campaign_file import Actuator, Datasheet, Resolver
from emb_daemon.identify.dynamics import RELAXATION, Pads, curve_keys, simulate
from emb_daemon.identify.example import FILES
from emb_daemon.models.torque import friction_state
from emb_daemon.offline import Log
from emb_daemon.wire.contract import CYCLE_S

GEAR_GAIN = 4e-5
COUNT_RAD = 2.0 * np.pi / 4096


@dataclass(frozen=True)
class Truth:
    """Parameters of one actuator, by the calibration's keys where it has one."""

    dynamics: dict[str, float]
    delay_s: float
    torque: dict[str, float]
    curves: dict[float, np.ndarray]
    clearance: float
    reference_noise_N: float

    def nominal(self) -> Calibration:
        """What identification starts from."""
        return nominal(datasheet(0.05, 1e-4), "rig", next(iter(self.curves)), list(self.curves))


def draw(rng: np.random.Generator, thicknesses=(4.0, 9.0)) -> Truth:
    """An actuator unlike the last one: every parameter from a wide range."""
    travel = rng.uniform(10.0, 25.0)
    full = rng.uniform(12e3, 28e3)
    shares = np.array([rng.uniform(0.1, 0.4), rng.uniform(0.4, 0.8), rng.uniform(0.05, 0.3)])
    curves = {
        thickness: full * shares / shares.sum() / travel ** np.arange(1, 4) * (1.2 - 0.03 * thickness)
        for thickness in thicknesses
    }
    relaxation = rng.uniform(0.012, 0.05)
    return Truth(
        dynamics={
            RELAXATION: relaxation,
            "effects.second_relaxation.share": rng.uniform(0.03, 0.25),
            "effects.second_relaxation.time_constant_s": relaxation * rng.uniform(6.0, 20.0),
            "effects.stiffness_hysteresis.share": rng.uniform(0.008, 0.05),
            "effects.stiffness_hysteresis.slip_angle_rad": rng.uniform(0.4, 2.0),
        },
        delay_s=rng.uniform(-5e-4, 1e-3),
        torque={
            TORQUE_CONSTANT: rng.uniform(0.03, 0.08),
            INERTIA: rng.uniform(0.6e-4, 2e-4),
            OFFSET_FRICTION: rng.uniform(0.015, 0.05),
            LOAD_FRICTION: rng.uniform(0.05, 0.3) * GEAR_GAIN,
            PRESLIDING_ANGLE: rng.uniform(0.015, 0.1),
        },
        curves=curves,
        clearance=rng.uniform(3.0, 9.0),
        reference_noise_N=rng.uniform(15.0, 50.0),
    )


def datasheet(torque_constant: float, inertia: float, tolerance: float = 0.3) -> Datasheet:
    """Of an actuator with the synthetic rig's geometry, and of usual pads and disc."""
    actuator = Actuator(
        gear_gain_m_per_rad=GEAR_GAIN,
        motor_torque_constant_Nm_per_A=torque_constant,
        motor_torque_constant_tolerance=tolerance,
        lumped_inertia_kg_m2=inertia,
        lumped_inertia_tolerance=tolerance,
        max_motor_speed_rad_per_s=200.0,
        rated_clamp_force_N=20e3,
        pad_clearance_rad=5.0,
    )
    usual = load_yaml(FILES / "datasheet.yaml", Datasheet)
    resolver = Resolver(counts_per_revolution=round(2.0 * np.pi / COUNT_RAD))
    return msgspec.structs.replace(usual, actuator=actuator, resolver=resolver)


def _slow(travel: float, seconds: float = 24.0) -> np.ndarray:
    """Two clamps and releases from rest, each of half the time."""
    time = np.arange(round(seconds / CYCLE_S)) * CYCLE_S
    rest = 0.4
    phase = np.clip((time - rest) / (seconds - 2 * rest), 0.0, 1.0)
    return travel * (1.0 - np.cos(4.0 * np.pi * phase)) / 2.0


def _random(rng: np.random.Generator, clearance: float, travel: float) -> np.ndarray:
    """Twelve seconds of random targets, a new one every 100 ms, reached as a second-order motor loop reaches them."""
    samples, angle, speed = round(12.0 / CYCLE_S), 0.0, 0.0
    path, target = np.zeros(samples), 0.0
    for row in range(samples):
        if row > 100 and row % 25 == 0:
            target = clearance + rng.uniform(-0.05, 1.0) * (travel - clearance)
        for _ in range(8):
            speed += (40.0**2 * (target - angle) - 2.0 * 40.0 * speed) * CYCLE_S / 8.0
            angle += speed * CYCLE_S / 8.0
        path[row] = angle
    return path


def _log(truth: Truth, thickness: float, path: np.ndarray, name: str, rng: np.random.Generator) -> Log:
    """A log of one movement, with resolver counts, speed noise, coloured current noise and noise of the reference."""
    samples = np.zeros(len(path), SAMPLE)
    samples["dt"] = CYCLE_S
    samples["dt"][0] = 0.0
    speed = np.gradient(path, CYCLE_S)
    samples["angle"], samples["speed"] = path, speed
    samples["has_current"] = True
    samples["brake_torque"] = samples["ambient"] = np.nan
    log = Log(Path(name), "FL", samples, np.arange(len(path)) * 4_000_000, SimpleNamespace(), np.zeros(len(path)))
    known = truth.nominal()
    curve = dict(zip(curve_keys(known, thickness), truth.curves[thickness], strict=True))
    force = simulate(log, moved(known, truth.dynamics | curve), thickness, truth.clearance, truth.delay_s)
    t = truth.torque
    mean, state = np.zeros(len(path)), 0.0
    for row, travel in enumerate(np.diff(path), 1):
        state, mean[row], _ = friction_state(state, 0.0, travel, t[PRESLIDING_ANGLE], 0.0, CYCLE_S)
    half = np.r_[0.0, 0.5 * (force[1:] + force[:-1])]
    # What the estimator sees of force: without the delay of the reference's clock, a detail of half a millisecond.
    torque = GEAR_GAIN * half + t[INERTIA] * np.r_[0.0, np.diff(speed)] / CYCLE_S
    torque += (t[OFFSET_FRICTION] + t[LOAD_FRICTION] * half) * mean
    coloured = np.zeros(len(path))
    drive = rng.normal(size=len(path))
    for row in range(1, len(path)):
        coloured[row] = 0.5 * coloured[row - 1] + 0.3 * np.sqrt(1.0 - 0.25) * drive[row]
    samples["current_q"] = torque / t[TORQUE_CONSTANT] + coloured
    samples["angle"] = np.round(path / COUNT_RAD) * COUNT_RAD
    samples["speed"] = speed + rng.normal(0.0, 0.3, len(path))
    log.force_N[:] = force + rng.normal(0.0, truth.reference_noise_N, len(path))
    return log


def pads(truth: Truth, rng: np.random.Generator) -> list[Pads]:
    """A slow and a random log for each thickness of an actuator."""
    groups = []
    for thickness, curve in truth.curves.items():
        past = np.linspace(0.0, 40.0, 4000)
        travel = truth.clearance + float(past[np.searchsorted(sum(c * past ** (n + 1) for n, c in enumerate(curve)), 20e3)])
        logs = (
            _log(truth, thickness, _slow(travel), f"slow {thickness}", rng),
            _log(truth, thickness, _random(rng, truth.clearance, travel), f"random {thickness}", rng),
        )
        groups.append(Pads(thickness, logs))
    return groups
