"""The joint fit: contact angle, characteristic curve, friction and presliding angle from motor current and angle.

The estimator's own stiffness and torque paths are run over the training with trial parameters; what motor torque they leave
unexplained is made small (Levenberg-Marquardt with Huber weights). Dynamics, effects, torque constant and inertia stay those
of the calibration. Thesis 2.4 and 3.4 take pairs of passes at equal angle instead; they start and check this fit, which also
uses the samples in between, knows of the pads' dynamics, and comes with a covariance.
"""

from math import exp, log, sqrt

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.algebra import back_substitute, cholesky, inverse
from emb_daemon.adapt.pairs import ANGLE, CYCLE_S, FORCE, WEIGHT, curve_from_pairs, friction_from_pairs, pairs_of_passes
from emb_daemon.estimator.records import CURVE_TERMS
from emb_daemon.estimator.step import position, rest, stiffness_path, torque_path
from emb_daemon.jit import njit
from emb_daemon.models.contact import torque_sigma
from emb_daemon.models.stiffness import characteristic_curve, travel_at

#: Order of the fitted values: contact angle, load friction, offset friction, logarithm of the presliding angle, curve.
CONTACT, LOAD, OFFSET, PRESLIDING, CURVE = range(5)
_ITERATIONS = 40
#: The fit has converged when an iteration lowers the cost by less than this share.
_CONVERGED = 1e-7
#: Residuals beyond this many standard deviations count linearly (Huber).
_HUBER = 2.5
#: Lags over which the residual's autocorrelation inflates the covariance.
_LAGS = 12
_LEAST_SAMPLES = 1000
_RANGES = 5
#: Points of the travel at which the curve is looked at.
_TRAVELS = 40


@njit
def settle(s, p, row):
    """Bring the path models of a STATE to rest at the first sample of a training."""
    s.started = True
    s.angle, s.slid_angle, s.speed = row.angle, row.angle, row.speed
    s.friction_state, s.friction_variance = 0.0, 1.0
    rest(s, p, position(s, p, row), row.factor)


@njit
def unexplained_step(s, p, row):
    """Advance both paths by one TRAINING row; motor torque (N m) that the clamp force leaves unexplained, or NaN."""
    before = s.force
    stiffness_path(s, p, row, row.factor)
    torque, leverage, _ = torque_path(s, p, row)
    s.angle, s.speed = row.angle, row.speed
    return torque - leverage * 0.5 * (before + s.force)


@njit
def unexplained(s, p, rows, residual, force):
    """`unexplained_step` and stiffness force (N) at each row from the settled state ``s``; the first residual is NaN."""
    residual[0], force[0] = np.nan, s.force
    for i in range(1, len(rows)):
        residual[i] = unexplained_step(s, p, rows[i])
        force[i] = s.force


@njit
def _put(p, s, x, scale, terms):
    """Trial values into a PARAMETERS record and the contact angle of a STATE."""
    s.contact_angle = x[CONTACT]
    p.load_friction = x[LOAD] * p.gear_gain
    p.offset_friction = x[OFFSET]
    p.presliding_angle = exp(min(max(x[PRESLIDING], -12.0), 2.0))
    for i in range(terms):
        p.curve[i] = x[CURVE + i] * scale[i]


@njit
def _simulate(states, parameters, rows, x, scale, terms, residual, force):
    s, p = states[1], parameters[1]
    states[1] = states[0]
    parameters[1] = parameters[0]
    _put(p, s, x, scale, terms)
    settle(s, p, rows[0])
    unexplained(s, p, rows, residual, force)


@njit
def _huber(residual, sigma):
    """Mean Huber cost of the finite residuals, in units of ``sigma`` squared."""
    cost, count = 0.0, 0
    for value in residual:
        if np.isfinite(value):
            size = abs(value) / sigma
            cost += size * size if size < _HUBER else _HUBER * (2.0 * size - _HUBER)
            count += 1
    return cost / max(count, 1)


@njit
def _normal_equations(residual, jacobian, sigma, normal, gradient):
    """Weighted normal matrix and gradient; returns the number of samples in them."""
    size = len(gradient)
    normal[:, :] = 0.0
    gradient[:] = 0.0
    count = 0
    for i in range(len(residual)):
        value = residual[i]
        if not np.isfinite(value):
            continue
        count += 1
        weight = min(1.0, _HUBER * sigma / max(abs(value), 1e-300)) / (sigma * sigma)
        for j in range(size):
            gradient[j] += weight * jacobian[j, i] * value
            for k in range(j + 1):
                normal[j, k] += weight * jacobian[j, i] * jacobian[k, i]
    for j in range(size):
        for k in range(j):
            normal[k, j] = normal[j, k]
    return count


@njit
def _improve(states, parameters, rows, x, scale, terms, sigma, residual, force, normal):
    """Levenberg-Marquardt from ``x``, in place; leaves residual, force and normal matrix of the end.

    Returns the iterations taken, or -1 if it did not converge."""
    size = CURVE + terms
    jacobian, trial_residual = np.zeros((size, len(rows))), np.zeros(len(rows))
    gradient, damped, trial = np.zeros(size), np.zeros((size, size)), np.zeros(size)
    move = np.zeros(size)
    steps = np.full(size, 1e-4)
    steps[CONTACT], steps[PRESLIDING] = 1e-3, 1e-2
    steps[OFFSET] = 1e-3 * max(parameters[0].offset_friction, 1e-4)
    _simulate(states, parameters, rows, x, scale, terms, residual, force)
    cost, damping = _huber(residual, sigma), 1e-3
    for iteration in range(_ITERATIONS):
        for j in range(size):
            trial[:] = x
            trial[j] += steps[j]
            _simulate(states, parameters, rows, trial, scale, terms, trial_residual, force)
            for i in range(len(rows)):
                jacobian[j, i] = (trial_residual[i] - residual[i]) / steps[j]
        _normal_equations(residual, jacobian, sigma, normal, gradient)
        before = cost
        while damping < 1e10:
            for j in range(size):
                for k in range(size):
                    damped[j, k] = normal[j, k]
                damped[j, j] += damping * normal[j, j] + 1e-12
                move[j] = -gradient[j]
            solved = cholesky(damped)
            if solved:
                back_substitute(damped, move)
                for j in range(size):
                    trial[j] = x[j] + move[j]
            # Force rises from contact: a curve that falls there belongs to a contact angle that lies too early.
            if solved and trial[CURVE] > 0.0:
                _simulate(states, parameters, rows, trial, scale, terms, trial_residual, force)
                attempt = _huber(trial_residual, sigma)
                if attempt <= cost:
                    x[:] = trial
                    residual[:] = trial_residual
                    cost, damping = attempt, max(0.1 * damping, 1e-9)
                    break
            damping *= 10.0
        if before - cost <= _CONVERGED * before:
            _simulate(states, parameters, rows, x, scale, terms, residual, force)
            return iteration + 1
    return -1


@njit
def _inflation(residual):
    """Factor by which autocorrelated residuals widen a covariance: 1 + 2 sum of their autocorrelation."""
    total, square = 1.0, 0.0
    for value in residual:
        if np.isfinite(value):
            square += value * value
    for lag in range(1, _LAGS + 1):
        product = 0.0
        for i in range(lag, len(residual)):
            if np.isfinite(residual[i]) and np.isfinite(residual[i - lag]):
                product += residual[i] * residual[i - lag]
        total += 2.0 * max(product / square, 0.0)
    return total


@njit
def _median_size(residual):
    """Standard deviation of normal residuals from the median of their size."""
    sizes, count = np.zeros(len(residual)), 0
    for value in residual:
        if np.isfinite(value):
            sizes[count] = abs(value)
            count += 1
    return 1.4826 * np.median(sizes[:count])


@njit
def _force_sigma(p, x, scale, terms, covariance, top, out):
    """Standard deviation of the clamp force from the covariance of contact angle and curve together, as the straight
    line s0^2 + (s1 F)^2 through its square over the travel (least squares, neither part negative)."""
    direction = np.zeros(CURVE + terms)
    sums = np.zeros(5)
    largest = 0.0
    for step in range(1, _TRAVELS + 1):
        travel = top * step / _TRAVELS
        force, slope = characteristic_curve(travel, p.curve)
        direction[:] = 0.0
        direction[CONTACT] = -slope
        for i in range(terms):
            direction[CURVE + i] = scale[i] * travel ** (i + 1)
        variance = 0.0
        for j in range(CURVE + terms):
            for k in range(CURVE + terms):
                variance += direction[j] * covariance[j, k] * direction[k]
        largest = max(largest, variance)
        square = force * force
        sums += np.array([1.0, square, variance, square * square, square * variance])
    spread = sums[0] * sums[3] - sums[1] * sums[1]
    share = max((sums[0] * sums[4] - sums[1] * sums[2]) / spread, 0.0)
    constant = max((sums[2] - share * sums[1]) / sums[0], 0.25 * sums[2] / sums[0])
    out.stiffness_sigma, out.stiffness_relative_sigma = sqrt(constant), sqrt(share)
    out.force_sigma = sqrt(largest)


@njit
def _excited(rows, force, residual, low, high, needed):
    """Whether each of equal force ranges, and the clearance, was passed in both directions by enough samples."""
    count = np.zeros((2, _RANGES + 1))
    for i in range(1, len(rows)):
        if not np.isfinite(residual[i]):
            continue
        side = 0 if rows[i].angle > rows[i - 1].angle else 1
        if force[i] <= low:
            count[side, _RANGES] += 1
        elif force[i] <= high:
            count[side, min(int(_RANGES * (force[i] - low) / (high - low)), _RANGES - 1)] += 1
    return count.min() >= needed


@njit
def fit_training(rows, parameters, states, limits, out):
    """What one training teaches.

    Args:
        rows: TRAINING array, the samples in order.
        parameters: PARAMETERS array, shape (2,): now in use, and scratch.
        states: STATE array, shape (2,): the estimator's at the end of the training, and scratch.
        limits: LIMITS record.
        out: LEARNED record, filled; ``out.verdict`` says whether it may be used.
    """
    now = parameters[0]
    out.samples = len(rows)
    if len(rows) < _LEAST_SAMPLES:
        out.verdict = r.TOO_FEW
        return
    terms = 1
    for i in range(CURVE_TERMS):
        if now.curve[i] != 0.0:
            terms = i + 1
    pairs = pairs_of_passes(rows, now)
    start_curve = np.zeros(CURVE_TERMS)
    contact = curve_from_pairs(pairs, terms, start_curve)
    offset, load = friction_from_pairs(pairs)
    if not (np.isfinite(contact) and np.isfinite(load)):
        out.verdict = r.NOT_EXCITED
        return
    top = 0.0
    for i in range(len(rows)):
        top = max(top, rows[i].angle - contact)
    x, scale = np.zeros(CURVE + terms), np.zeros(terms)
    total = 0.0
    for i in range(terms):
        total += start_curve[i] * top ** (i + 1)
    for i in range(terms):
        scale[i] = max(total, 1.0) / top ** (i + 1)
        x[CURVE + i] = start_curve[i] / scale[i]
    x[CONTACT], x[LOAD], x[OFFSET] = contact, max(load, 0.0) / now.gear_gain, max(offset, 1e-5)
    x[PRESLIDING] = log(now.presliding_angle)

    expected, _ = torque_sigma(now.torque_constant * now.current_sigma, now.inertia * now.speed_sigma / CYCLE_S)
    residual, force = np.zeros(len(rows)), np.zeros(len(rows))
    normal = np.zeros((CURVE + terms, CURVE + terms))
    out.iterations = _improve(states, parameters, rows, x, scale, terms, expected, residual, force, normal)
    p = parameters[1]

    sigma = _median_size(residual)
    out.correlation = _inflation(residual)
    covariance = inverse(normal) * (out.correlation * (sigma / expected) ** 2)
    out.residual = sigma / now.torque_constant
    out.residual_ratio = sigma / expected
    out.contact_angle = x[CONTACT]
    out.contact_sigma = sqrt(covariance[CONTACT, CONTACT])
    out.contact_given_curve_sigma = sqrt(out.correlation / max(normal[CONTACT, CONTACT], 1e-300)) * sigma / expected
    out.curve[:] = p.curve
    out.load_friction, out.offset_friction = p.load_friction, p.offset_friction
    out.presliding_angle = p.presliding_angle
    top = 0.0
    for i in range(len(rows)):
        top = max(top, rows[i].angle - out.contact_angle)
    out.top_force, _ = characteristic_curve(top, p.curve)
    _force_sigma(p, x, scale, terms, covariance, top, out)
    # What the fit cannot see: the dynamics' own error, and the torque constant's, which the curve inherits.
    out.stiffness_sigma = sqrt(out.stiffness_sigma**2 + limits.dynamics_sigma**2)
    out.stiffness_relative_sigma = sqrt(out.stiffness_relative_sigma**2 + limits.torque_constant_sigma**2)
    out.pairs_difference = _pairs_difference(pairs, out.contact_angle, p.curve, out.top_force)
    out.curve_change = _curve_change(out.curve, now.curve, limits.high_force)
    out.verdict = _judge(rows, force, residual, top, now, limits, out)


@njit
def _pairs_difference(pairs, contact, curve, top_force):
    """RMS difference of the pairs' forces from the curve, as a share of the largest force."""
    total = weights = 0.0
    for k in range(len(pairs)):
        force, _ = characteristic_curve(pairs[k, ANGLE] - contact, curve)
        total += pairs[k, WEIGHT] * (pairs[k, FORCE] - force) ** 2
        weights += pairs[k, WEIGHT]
    return sqrt(total / weights) / max(top_force, 1.0)


@njit
def _curve_change(curve, before, force):
    """Relative change of the travel that it takes to reach ``force``."""
    travel, past = travel_at(force, curve), travel_at(force, before)
    return abs(travel - past) / past if past > 0.0 else np.inf


@njit
def _judge(rows, force, residual, top, now, limits, out):
    """ACCEPTED, or the first reason against it."""
    if out.iterations < 0 or not np.isfinite(out.contact_sigma + out.force_sigma + out.residual) or out.contact_sigma == 0.0:
        return r.NOT_CONVERGED
    if out.top_force < limits.coverage * limits.high_force:
        return r.NOT_COVERED
    if not _excited(rows, force, residual, 0.01 * limits.high_force, limits.coverage * limits.high_force,
                    limits.samples_per_range):  # fmt: skip
        return r.NOT_EXCITED
    if out.residual_ratio > limits.residual_ratio:
        return r.RESIDUAL
    for step in range(_TRAVELS + 1):
        if characteristic_curve(max(top * step / _TRAVELS, 1e-6), out.curve)[1] <= 0.0:
            return r.NOT_PHYSICAL
    if not 0.0 <= out.load_friction <= limits.maximum_friction_share * now.gear_gain or not out.offset_friction >= 0.0:
        return r.NOT_PHYSICAL
    if out.curve_change > limits.curve_change:
        return r.CHANGED_TOO_MUCH
    high = limits.high_force
    friction, past = out.offset_friction + out.load_friction * high, now.offset_friction + now.load_friction * high
    if abs(friction - past) > limits.friction_change * past:
        return r.CHANGED_TOO_MUCH
    if out.force_sigma > limits.maximum_sigma:
        return r.TOO_UNCERTAIN
    if out.pairs_difference > limits.pairs_difference:
        return r.PAIRS_DISAGREE
    return r.ACCEPTED
