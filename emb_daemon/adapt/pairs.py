"""Clamp force without a friction model: pairs of a clamping and a releasing pass over the same motor angle.

Thesis 2.4, equation 2-7 (Schwarz): friction has the same size in both passes, so it drops out of their sum, and their
difference is friction alone. The pairs give a start that needs no prior knowledge of curve or friction, and a check that
does not share the model of the fit that follows.
"""

import numpy as np

from emb_daemon.adapt.algebra import back_substitute, cholesky
from emb_daemon.jit import njit
from emb_daemon.models.contact import torque_sigma
from emb_daemon.models.torque import friction_state, unexplained_torque

#: Width of an angle bin, as a share of the travel, and how far friction must have turned over for a sample to count.
_BINS = 100
_TURNED_OVER = 0.97
#: Passes whose torque is averaged in a bin need this many samples each.
_SAMPLES = 4
#: Samples so many standard deviations from their bin's mean are left out.
_FAR = 8.0
#: The current is averaged over this time, s (wire contract).
CYCLE_S = 0.004
#: Contact is searched below the angle at which this share of the largest force is reached.
_SEARCHED_SHARE = 0.2
_CANDIDATES = 60

#: Columns of a pair: angle, clamp force, friction torque, weight.
ANGLE, FORCE, FRICTION, WEIGHT = range(4)


@njit
def pairs_of_passes(rows, p):
    """Pairs of one training (TRAINING rows, PARAMETERS record); returns (pairs, 4): rad, N, N m, samples."""
    low, high = rows[0].angle, rows[0].angle
    for i in range(len(rows)):
        low, high = min(low, rows[i].angle), max(high, rows[i].angle)
    width = max(high - low, 1e-9) / _BINS
    sigma, _ = torque_sigma(p.torque_constant * p.current_sigma, p.inertia * p.speed_sigma / CYCLE_S)
    count, angle, torque = np.zeros((2, _BINS)), np.zeros((2, _BINS)), np.zeros((2, _BINS))
    before = np.zeros((2, _BINS))
    for sweep in range(2):
        # The second time without what lies far from the first's mean.
        before[:, :] = torque / np.maximum(count, 1.0)
        count[:, :], angle[:, :], torque[:, :] = 0.0, 0.0, 0.0
        state, variance = 0.0, 1.0
        for i in range(1, len(rows)):
            row, last = rows[i], rows[i - 1]
            state, mean, variance = friction_state(state, variance, row.angle - last.angle, p.presliding_angle, 0.0, row.dt)
            if not row.has_current or abs(mean) < _TURNED_OVER:
                continue
            side = 0 if mean > 0.0 else 1
            middle = 0.5 * (row.angle + last.angle)
            place = min(int((middle - low) / width), _BINS - 1)
            motor = p.torque_constant * row.current_q
            value = unexplained_torque(motor, p.inertia, row.speed - last.speed, row.dt, 0.0, mean)
            if sweep == 1 and abs(value - before[side, place]) > _FAR * sigma:
                continue
            count[side, place] += 1.0
            angle[side, place] += middle
            torque[side, place] += value
    pairs, found = np.zeros((_BINS, 4)), 0
    for place in range(_BINS):
        up, down = count[0, place], count[1, place]
        if up < _SAMPLES or down < _SAMPLES:
            continue
        clamping, releasing = torque[0, place] / up, torque[1, place] / down
        pairs[found, ANGLE] = 0.5 * (angle[0, place] / up + angle[1, place] / down)
        pairs[found, FORCE] = 0.5 * (clamping + releasing) / p.gear_gain
        pairs[found, FRICTION] = 0.5 * (clamping - releasing)
        pairs[found, WEIGHT] = 2.0 * up * down / (up + down)
        found += 1
    return pairs[:found]


@njit
def _fit_curve(pairs, robust, contact, terms, curve):
    """Weighted least squares of the curve's ``terms`` coefficients for a given contact angle; returns the cost."""
    normal, right = np.zeros((terms, terms)), np.zeros(terms)
    travel = max(pairs[-1, ANGLE] - contact, 1e-9)
    for k in range(len(pairs)):
        x = max(pairs[k, ANGLE] - contact, 0.0) / travel
        weight = pairs[k, WEIGHT] * robust[k]
        for i in range(terms):
            right[i] += weight * x ** (i + 1) * pairs[k, FORCE]
            for j in range(terms):
                normal[i, j] += weight * x ** (i + j + 2)
    if not cholesky(normal):
        return np.inf
    back_substitute(normal, right)
    cost = 0.0
    for k in range(len(pairs)):
        x = max(pairs[k, ANGLE] - contact, 0.0) / travel
        force = 0.0
        for i in range(terms):
            force += right[i] * x ** (i + 1)
        cost += pairs[k, WEIGHT] * robust[k] * (pairs[k, FORCE] - force) ** 2
    for i in range(terms):
        curve[i] = right[i] / travel ** (i + 1)
    return cost


@njit
def curve_from_pairs(pairs, terms, curve):
    """Contact angle (rad) of the best curve through the pairs, whose coefficients go into ``curve``; NaN if there is none.

    Robust: pairs that lie far from a first fit lose weight in the second (Cauchy weights on the median residual).
    """
    if len(pairs) < 2 * terms + 2:
        return np.nan
    top = pairs[:, FORCE].max()
    low, high = pairs[0, ANGLE], pairs[0, ANGLE]
    for k in range(len(pairs)):
        if pairs[k, FORCE] > _SEARCHED_SHARE * top:
            break
        high = pairs[k, ANGLE]
    robust, trial = np.ones(len(pairs)), np.zeros(len(curve))
    best = np.nan
    for _ in range(2):
        least = np.inf
        for candidate in range(_CANDIDATES + 1):
            contact = low + (high - low) * candidate / _CANDIDATES
            cost = _fit_curve(pairs, robust, contact, terms, trial)
            if cost < least and trial[0] > 0.0:
                least, best = cost, contact
                curve[:] = trial
        if not np.isfinite(least):
            return np.nan
        residual = np.zeros(len(pairs))
        for k in range(len(pairs)):
            x, force = max(pairs[k, ANGLE] - best, 0.0), 0.0
            for i in range(terms):
                force += curve[i] * x ** (i + 1)
            residual[k] = pairs[k, FORCE] - force
        scale = 1.5 * np.median(np.abs(residual)) + 1e-9
        for k in range(len(pairs)):
            robust[k] = 1.0 / (1.0 + (residual[k] / (3.0 * scale)) ** 2)
    return best


@njit
def friction_from_pairs(pairs):
    """(offset N m, load m/rad) of the straight line of friction torque over clamp force; thesis 4.1."""
    n = force = friction = square = product = 0.0
    for k in range(len(pairs)):
        weight, f = pairs[k, WEIGHT], max(pairs[k, FORCE], 0.0)
        n += weight
        force += weight * f
        friction += weight * pairs[k, FRICTION]
        square += weight * f * f
        product += weight * f * pairs[k, FRICTION]
    spread = n * square - force * force
    if not spread > 0.0:
        return np.nan, np.nan
    load = (n * product - force * friction) / spread
    return (friction - load * force) / n, load
