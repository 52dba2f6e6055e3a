"""Brakes of another mechanism: gears that are not constant, drives at their current's limit, latches, release springs.

    python -m studies.mechanisms --seeds 0 1 2 3 [--kept DIR]

Four brakes, of which each seed draws one: a ball ramp on a weak drive (12 V: slow, and limited to little more than the
current of the largest force), a cam on a fast one (400 V), a roller ramp that a latch holds without current in the drive that
judges, and a screw with such a latch and a spring that helps release. The datasheet states travel over angle at a dozen
points, to the micrometre; the brake follows the curve itself. Recorded, identified and judged like `studies.strangers`.
"""

import msgspec
import numpy as np

from emb_daemon.calibration.types import Calibration, Travel
from emb_daemon.models.stiffness import travel_at
from emb_daemon.plant import scenarios as sc
from studies.drives import park_on_latch, rig_stop
from studies.strangers import Stranger, draw_brake, main, plan

#: Points of the brake's own table and of the datasheet's, which are every so many of them.
_FINE, _EVERY = 121, 10
#: Stiffness and hysteresis of an ordinary caliper.
_ORDINARY = {
    "second_relaxation": {"share": 0.1, "time_constant_s": 0.35},
    "stiffness_hysteresis": {"share": 0.02, "slip_angle_rad": 1.0},
}


def _ramp(rng: np.random.Generator, u: np.ndarray) -> np.ndarray:
    """Slope of balls in grooves that begin steep, to close the clearance, and go over to flat, for force."""
    steep, change = rng.uniform(2.0, 3.0), rng.uniform(0.15, 0.3)
    return 1.0 + (steep - 1.0) * np.exp(-u / change)


def _cam(rng: np.random.Generator, u: np.ndarray) -> np.ndarray:
    """Slope of an eccentric, from before the middle of its lift to well behind it."""
    return np.cos(rng.uniform(-0.6, -0.3) + rng.uniform(1.3, 1.6) * u)


def with_travel(calibration: Calibration, slope, rng: np.random.Generator) -> Calibration:
    """The brake with a gear of a slope over the share of its range, of the same gain in the mean."""
    motor, stiffness = calibration.motor, calibration.stiffness
    softest = max(travel_at(stiffness.maximum_force_N, np.array(c.coefficients)) for c in stiffness.curves)
    end, u = 1.15 * (calibration.contact.clearance_rad + softest), np.linspace(0.0, 1.0, 50 * (_FINE - 1) + 1)
    lift = np.concatenate([[0.0], np.cumsum(0.5 * (h := slope(rng, u))[1:] + 0.5 * h[:-1])])[::50]
    angle, travel = end * u[::50], 1e3 * motor.gear_gain_m_per_rad * end * lift / lift[-1]
    table = Travel(angle_rad=tuple(angle.tolist()), travel_mm=tuple(travel.tolist()))
    return msgspec.structs.replace(calibration, motor=msgspec.structs.replace(motor, travel=table))


def _latched(calibration: Calibration, rng: np.random.Generator) -> sc.Schedule:
    """Parked, held by the latch without current, released, and driven on."""
    high = calibration.stiffness.maximum_force_N
    park = park_on_latch(high * rng.uniform(0.4, 0.6)) + sc.rest(1.0)
    return park + rig_stop(0.3 * high, 40.0) + park + sc.rest(1.0)


def draw_mechanism(seed: int) -> Stranger:
    """The brake of a seed; the seed modulo four selects its kind."""
    rng = np.random.default_rng(seed)
    calibration, kind = draw_brake(rng), seed % 4
    if kind < 3:
        calibration = with_travel(calibration, _cam if kind == 1 else _ramp, rng)
    motor = calibration.motor
    faster = (rng.uniform(0.5, 0.7), rng.uniform(1.5, 2.0), 1.0, 1.0)[kind]
    motor = msgspec.structs.replace(motor, maximum_speed_rad_per_s=faster * motor.maximum_speed_rad_per_s)
    if kind == 3:
        # At full clamp a tenth of the force or so, several times the friction of the open brake.
        full_m = 25.0 * motor.gear_gain_m_per_rad
        spring = calibration.stiffness.maximum_force_N / full_m * rng.uniform(0.08, 0.15)
        motor = msgspec.structs.replace(motor, release_spring_N_per_m=float(round(spring)))
    calibration = msgspec.structs.replace(calibration, motor=motor)
    table = motor.travel
    sheet = {"release_spring_N_per_m": motor.release_spring_N_per_m}
    if table.angle_rad:
        travel = {"angle_rad": [round(a, 4) for a in table.angle_rad], "travel_mm": [round(mm, 3) for mm in table.travel_mm]}
        sheet["travel"] = {name: values[::_EVERY] for name, values in travel.items()}
    # The usual limit is one and a half times what the largest force needs without friction.
    stranger = Stranger(calibration, _ORDINARY, sheet, limit=0.8 if kind == 0 else 1.0)
    plan(stranger, seed, rng)
    if kind > 1:
        schedule, thickness = stranger.logs["val"]
        stranger.logs["val"] = _latched(calibration, rng) + schedule, thickness
    return stranger


if __name__ == "__main__":
    main(draw_mechanism, __doc__)
