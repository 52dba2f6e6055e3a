"""Clamp force without a friction model: pairs of a clamping and a releasing pass over the same motor angle.

Thesis 2.4, equation 2-7 (Schwarz): friction has the same size in both passes, so it drops out of their sum, and their
difference is friction alone. The pairs give a start that needs no prior knowledge of curve or friction, and a check that
does not share the model of the fit that follows.
"""

import numpy as np

from emb_daemon.adapt.records import TRAINING
from emb_daemon.estimator.paths import settle_paths, stiffness_path, torque_path
from emb_daemon.estimator.records import PARAMETERS, STATE, new_state
from emb_daemon.jit import Array, entry
from emb_daemon.models.contact import torque_sigma
from emb_daemon.models.gear import through_gear
from emb_daemon.models.torque import unexplained_torque
from emb_daemon.wire.contract import CYCLE_S

#: Width of an angle bin, as a share of the travel, and the friction state that a sample must have reached to count.
_BINS = 100
_TURNED_OVER = 0.97
#: Least number of samples of each pass in a bin.
_SAMPLES = 4
#: Samples so many standard deviations from their bin's mean are left out.
_FAR = 8.0
#: Contact is searched below the angle at which this share of the largest force is reached, at so many angles.
_SEARCHED_SHARE, _CANDIDATES = 0.2, 60

#: Columns of a pair: angle, clamp force, friction torque, weight, and the clamp force by the stiffness path.
ANGLE, FORCE, FRICTION, WEIGHT, MODEL = range(5)


@entry(Array(TRAINING), PARAMETERS, float, Array(np.float64))
def _turn(rows, p, gear_zero, turned):
    """Equivalent angles (`models.gear`), rad."""
    for i in range(len(rows)):
        turned[i] = gear_zero + through_gear(p.gear, rows[i].angle - gear_zero)[0] if p.gear.step > 0.0 else rows[i].angle


@entry(Array(TRAINING), PARAMETERS, Array(STATE), Array(np.float64), Array(np.float64), Array(np.float64))
def _run_passes(rows, p, states, direction, torque, force):
    """``direction``: +1 where friction has fully developed in clamping, -1 in releasing, else 0. ``torque``: motor torque (N
    m) without inertia and release spring, over the gear's slope. ``force``: of the stiffness path, N. All with the
    calibration's effects."""
    s = states[0]
    settle_paths(s, p, rows[0], rows[0].factor)
    direction[0] = 0.0
    for i in range(1, len(rows)):
        row, angle, speed, before = rows[i], s.angle, s.speed, s.force
        stiffness_path(s, p, row, row.factor)
        torque_path(s, p, row)
        s.angle, s.speed, mean = row.angle, row.speed, s.friction_mean
        force[i] = 0.5 * (before + s.force)
        usable = row.has_current and abs(mean) >= _TURNED_OVER
        direction[i] = (1.0 if mean > 0.0 else -1.0) if usable else 0.0
        motor_torque = s.motor_torque * (1.0 + row.faded)
        torque[i] = unexplained_torque(motor_torque, p.inertia, row.speed - speed, row.dt, 0.0, mean)
        past_zero, slope = through_gear(p.gear, 0.5 * (row.angle + angle) - s.gear_zero)
        torque[i] = torque[i] / (slope * s.gear_gain) - p.gear_gain * p.spring * p.gear_gain * max(past_zero, 0.0)


def turned_angles(rows: np.ndarray, p: np.void, gear_zero: float) -> np.ndarray:
    """Equivalent angles (`models.gear`) of TRAINING rows, rad; PARAMETERS record ``p``, STATE's ``gear_zero``."""
    turned = np.empty(len(rows))
    _turn(rows, p, gear_zero, turned)
    return turned


def pairs_of_passes(rows: np.ndarray, p: np.void, state: np.void | None = None) -> np.ndarray:
    """Pairs of one training: TRAINING rows, PARAMETERS record ``p``, STATE record at its end (None: of a brake that is not
    known); returns (pairs, 5): equivalent angle in rad, N, N m, samples, N."""
    states = new_state(1)
    if state is not None:
        states[0] = state
    angle = turned_angles(rows, p, float(states["gear_zero"][0]))
    low = angle.min()
    width = max(angle.max() - low, 1e-9) / _BINS
    sigma, _ = torque_sigma(p["torque_constant"] * p["current_sigma"], p["inertia"] * p["speed_sigma"] / CYCLE_S)
    direction, torque, force = np.zeros((3, len(rows)))
    _run_passes(rows, p, states, direction, torque, force)
    middle = 0.5 * (angle + np.concatenate([angle[:1], angle[:-1]]))
    # Clamping passes in the first half of the bins, releasing ones in the second.
    bins = np.minimum((middle - low) / width, _BINS - 1).astype(int) + np.where(direction > 0.0, 0, _BINS)

    def mean(used, values):
        return np.bincount(bins[used], values[used], 2 * _BINS) / np.maximum(np.bincount(bins[used], minlength=2 * _BINS), 1)

    used = direction != 0.0
    used &= np.abs(torque - mean(used, torque)[bins]) <= _FAR * sigma
    count = np.bincount(bins[used], minlength=2 * _BINS).reshape(2, _BINS)
    up, down = count[:, np.min(count, axis=0) >= _SAMPLES]
    angles, torques, forces = (
        mean(used, values).reshape(2, _BINS)[:, np.min(count, axis=0) >= _SAMPLES] for values in (middle, torque, force)
    )
    pairs = np.zeros((len(up), 5))
    pairs[:, ANGLE] = angles.mean(axis=0)
    pairs[:, FORCE] = torques.mean(axis=0) / p["gear_gain"]
    pairs[:, FRICTION] = 0.5 * (torques[0] - torques[1])
    pairs[:, WEIGHT] = 2.0 * up * down / (up + down)
    pairs[:, MODEL] = forces.mean(axis=0)
    return pairs


def _fit_curve(pairs, weight, contact, terms):
    """Weighted least squares of the curve's ``terms`` coefficients for a given contact angle: ``(cost, coefficients)``."""
    travel = max(pairs[-1, ANGLE] - contact, 1e-9)
    powers = np.arange(1, terms + 1)
    shapes = (np.maximum(pairs[:, ANGLE] - contact, 0.0) / travel)[:, np.newaxis] ** powers
    root = np.sqrt(weight)
    solution = np.linalg.lstsq(shapes * root[:, np.newaxis], pairs[:, FORCE] * root)[0]
    return weight @ (pairs[:, FORCE] - shapes @ solution) ** 2, solution / travel**powers


def curve_from_pairs(pairs: np.ndarray, terms: int) -> tuple[float, np.ndarray]:
    """Contact angle (rad) and ``terms`` coefficients of the best curve through the pairs; NaN if there is none.

    Robust: pairs that lie far from a first fit lose weight in the second (Cauchy weights on the median residual)."""
    best, curve = np.nan, np.zeros(terms)
    if len(pairs) < 2 * terms + 2:
        return best, curve
    angle, force = pairs[:, ANGLE], pairs[:, FORCE]
    above = np.argmax(force > _SEARCHED_SHARE * force.max())
    candidates = np.linspace(angle[0], angle[max(above - 1, 0)], _CANDIDATES + 1)
    robust = np.ones(len(pairs))
    for _ in range(2):
        least = np.inf
        for contact in candidates:
            cost, trial = _fit_curve(pairs, pairs[:, WEIGHT] * robust, contact, terms)
            if cost < least and trial[0] > 0.0:
                least, best, curve = cost, contact, trial
        if not np.isfinite(least):
            return np.nan, curve
        travel = np.maximum(angle - best, 0.0)
        residual = force - travel[:, np.newaxis] ** np.arange(1, terms + 1) @ curve
        scale = 1.5 * np.median(np.abs(residual)) + 1e-9
        robust = 1.0 / (1.0 + (residual / (3.0 * scale)) ** 2)
    return best, curve


def friction_from_pairs(pairs: np.ndarray) -> tuple[float, float]:
    """(offset N m, load m/rad) of the straight line of friction torque over clamp force; thesis 4.1."""
    weight, force, friction = pairs[:, WEIGHT], np.maximum(pairs[:, FORCE], 0.0), pairs[:, FRICTION]
    total = weight.sum()
    spread = total * (weight @ force**2) - (weight @ force) ** 2
    if not spread > 0.0:
        return np.nan, np.nan
    load = (total * (weight @ (force * friction)) - (weight @ force) * (weight @ friction)) / spread
    return (weight @ friction - load * (weight @ force)) / total, load
