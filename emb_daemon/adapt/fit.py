"""The joint fit: contact angle, characteristic curve, friction and presliding angle from motor current and angle.

The estimator's own stiffness and torque paths are run over the training with trial parameters; what motor torque they leave
unexplained is made small (Levenberg-Marquardt with Huber weights). Dynamics, effects, torque constant and inertia stay those
of the calibration. Thesis 2.4 and 3.4 take pairs of passes at equal angle instead; they start and check this fit, which also
uses the samples in between, knows of the pads' dynamics, and comes with a covariance.

Only the paths are compiled. The fit is done once in a park brake's life of minutes, beside the loop, and what little it
computes itself would take far longer to compile than to run.
"""

from math import exp, inf, log, sqrt

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.pairs import ANGLE, CYCLE_S, FORCE, WEIGHT, curve_from_pairs, friction_from_pairs, pairs_of_passes
from emb_daemon.estimator.paths import position, rest, stiffness_path, torque_path
from emb_daemon.estimator.records import PARAMETERS, STATE
from emb_daemon.jit import njit
from emb_daemon.models.contact import torque_sigma
from emb_daemon.models.stiffness import characteristic_curve, travel_at

#: Order of the fitted values: contact angle, load friction, offset friction, logarithm of the presliding angle, curve.
_CONTACT, _LOAD, _OFFSET, _PRESLIDING, _CURVE = range(5)
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
def _run(states, parameters, rows, residual, force):
    settle(states[0], parameters[0], rows[0])
    unexplained(states[0], parameters[0], rows, residual, force)


class _Training:
    """One training as a function of the fitted values.

    Args:
        rows: TRAINING array, the samples in order.
        now, state: PARAMETERS and STATE records of the estimator at its end.
        scale: what one unit of each curve term is, N/rad^(n+1).
    """

    def __init__(self, rows, now, state, scale):
        self._rows, self._now, self._state, self._scale = rows, now, state, scale
        self._parameters, self._states = np.zeros(1, PARAMETERS), np.zeros(1, STATE)

    def parameters(self, x):
        """PARAMETERS record with the trial values ``x``."""
        self._parameters[0] = self._now
        p = self._parameters[0]
        p["load_friction"] = x[_LOAD] * p["gear_gain"]
        p["offset_friction"] = x[_OFFSET]
        p["presliding_angle"] = exp(min(max(x[_PRESLIDING], -12.0), 2.0))
        p["curve"][: len(self._scale)] = x[_CURVE:] * self._scale
        return p

    def simulate(self, x):
        """Unexplained motor torque (N m; NaN where unknown) and stiffness force (N) at each row."""
        self.parameters(x)
        self._states[0] = self._state
        self._states["contact_angle"] = x[_CONTACT]
        residual, force = np.zeros(len(self._rows)), np.zeros(len(self._rows))
        _run(self._states, self._parameters, self._rows, residual, force)
        return residual, force


def compile_fit(now, state):
    """Compile, or load from the cache, all that a fit calls; PARAMETERS and STATE records as `fit_training` gets them."""
    rows = np.zeros(2, r.TRAINING)
    _Training(rows, now, state, np.ones(1)).simulate(np.zeros(_CURVE + 1))
    pairs_of_passes(rows, now)
    travel_at(0.0, now["curve"])
    characteristic_curve(0.0, now["curve"])


def _huber(residual, sigma):
    """Mean Huber cost of the finite residuals, in units of ``sigma`` squared."""
    size = np.abs(residual[np.isfinite(residual)]) / sigma
    return np.where(size < _HUBER, size * size, _HUBER * (2.0 * size - _HUBER)).sum() / max(len(size), 1)


def _normal_equations(residual, jacobian, sigma):
    """Weighted normal matrix (n, n) and gradient (n,); ``jacobian`` has shape (n, samples)."""
    known = np.isfinite(residual)
    value, derivative = residual[known], jacobian[:, known]
    weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(value), 1e-300)) / sigma**2
    return (derivative * weight) @ derivative.T, derivative @ (weight * value)


def _improve(training, x, steps, sigma):
    """Levenberg-Marquardt from ``x`` with difference quotients over ``steps``.

    Returns ``(x, residual, force, normal matrix, iterations)`` at the end; -1 iterations if it did not converge."""
    residual, force = training.simulate(x)
    cost, damping = _huber(residual, sigma), 1e-3
    normal = np.zeros((len(x), len(x)))
    for iteration in range(_ITERATIONS):
        moved = [training.simulate(x + step)[0] for step in np.diag(steps)]
        normal, gradient = _normal_equations(residual, (moved - residual) / steps[:, np.newaxis], sigma)
        before = cost
        while damping < 1e10:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            try:
                trial = x - np.linalg.solve(damped, gradient)
            except np.linalg.LinAlgError:
                trial = np.full(len(x), np.nan)
            # Force rises from contact: a curve that falls there belongs to a contact angle that lies too early.
            if trial[_CURVE] > 0.0:
                attempt = training.simulate(trial)
                attempt_cost = _huber(attempt[0], sigma)
                if attempt_cost <= cost:
                    x, (residual, force), cost, damping = trial, attempt, attempt_cost, max(0.1 * damping, 1e-9)
                    break
            damping *= 10.0
        if before - cost <= _CONVERGED * before:
            return x, residual, force, normal, iteration + 1
    return x, residual, force, normal, -1


def _inverse(normal):
    """Inverse of a positive definite matrix, scaled by its diagonal first; zeros if it is none."""
    diagonal = np.diag(normal)
    if not np.all(diagonal > 0.0):
        return np.zeros_like(normal)
    scale = 1.0 / np.sqrt(diagonal)
    both = np.outer(scale, scale)
    try:
        factor = np.linalg.inv(np.linalg.cholesky(normal * both))
    except np.linalg.LinAlgError:
        return np.zeros_like(normal)
    return factor.T @ factor * both


def _inflation(residual):
    """Factor by which autocorrelated residuals widen a covariance: 1 + 2 sum of their autocorrelation."""
    value = np.nan_to_num(residual)
    products = (value[lag:] @ value[:-lag] for lag in range(1, _LAGS + 1))
    return 1.0 + 2.0 * sum(max(product, 0.0) for product in products) / (value @ value)


def _force_sigma(curve, scale, covariance, top):
    """Standard deviation of the clamp force from the covariance of contact angle and curve together.

    Returns ``(s0, s1, largest)``: the straight line s0^2 + (s1 F)^2 through its square over the travel (least squares,
    neither part negative), and its largest value."""
    travel = top * np.arange(1, _TRAVELS + 1) / _TRAVELS
    force, slope = np.array([characteristic_curve(x, curve) for x in travel]).T
    direction = np.zeros((_TRAVELS, len(covariance)))
    direction[:, _CONTACT] = -slope
    direction[:, _CURVE:] = scale * travel[:, np.newaxis] ** np.arange(1, len(scale) + 1)
    variance = np.einsum("ti,ij,tj->t", direction, covariance, direction)
    square = force * force
    spread = _TRAVELS * (square @ square) - square.sum() ** 2
    share = max((_TRAVELS * (square @ variance) - square.sum() * variance.sum()) / spread, 0.0)
    constant = max(variance.mean() - share * square.mean(), 0.25 * variance.mean())
    return sqrt(constant), sqrt(share), sqrt(variance.max())


def _excited(angle, force, residual, low, high, needed):
    """Whether each of equal force ranges, and the clearance, was passed in both directions by enough samples."""
    known = np.isfinite(residual)
    known[0] = False
    clamping = np.diff(angle, prepend=angle[0]) > 0.0
    place = np.minimum(_RANGES * (force - low) / (high - low), _RANGES - 1).astype(int)
    place[force <= low] = _RANGES
    known &= force <= high
    counts = [np.bincount(place[known & side], minlength=_RANGES + 1) for side in (clamping, ~clamping)]
    return np.min(counts) >= needed


def fit_training(rows, now, state, limits):
    """What one training teaches.

    Args:
        rows: TRAINING array, the samples in order.
        now: PARAMETERS record in use.
        state: STATE record, the estimator's at the end of the training.
        limits: LIMITS record.

    Returns:
        LEARNED record; its ``verdict`` says whether it may be used.
    """
    out = np.zeros(1, r.LEARNED)[0]
    out["samples"] = len(rows)
    if len(rows) < _LEAST_SAMPLES:
        out["verdict"] = r.TOO_FEW
        return out
    terms = max(np.flatnonzero(now["curve"]), default=0) + 1
    pairs = pairs_of_passes(rows, now)
    contact, start = curve_from_pairs(pairs, terms)
    offset, load = friction_from_pairs(pairs)
    if not (np.isfinite(contact) and np.isfinite(load)):
        out["verdict"] = r.NOT_EXCITED
        return out
    powers = np.arange(1, terms + 1)
    highest = rows["angle"].max()
    top = highest - contact
    scale = max(start @ top**powers, 1.0) / top**powers
    x = np.array([contact, max(load, 0.0) / now["gear_gain"], max(offset, 1e-5), log(now["presliding_angle"]), *start / scale])
    steps = np.full(len(x), 1e-4)
    steps[_CONTACT], steps[_PRESLIDING], steps[_OFFSET] = 1e-3, 1e-2, 1e-3 * max(now["offset_friction"], 1e-4)

    expected, _ = torque_sigma(now["torque_constant"] * now["current_sigma"], now["inertia"] * now["speed_sigma"] / CYCLE_S)
    training = _Training(rows, now, state, scale)
    x, residual, force, normal, out["iterations"] = _improve(training, x, steps, expected)
    p = training.parameters(x)

    sigma = 1.4826 * np.median(np.abs(residual[np.isfinite(residual)]))
    out["correlation"] = _inflation(residual)
    spread = out["correlation"] * (sigma / expected) ** 2
    covariance = _inverse(normal) * spread
    out["residual"] = sigma / now["torque_constant"]
    out["residual_ratio"] = sigma / expected
    out["contact_angle"] = x[_CONTACT]
    out["contact_sigma"] = sqrt(covariance[_CONTACT, _CONTACT])
    out["contact_given_curve_sigma"] = sqrt(spread / max(normal[_CONTACT, _CONTACT], 1e-300))
    for name in ("curve", "load_friction", "offset_friction", "presliding_angle"):
        out[name] = p[name]
    top = highest - x[_CONTACT]
    out["top_force"] = characteristic_curve(top, p["curve"])[0]
    constant, relative, out["force_sigma"] = _force_sigma(p["curve"], scale, covariance, top)
    # What the fit cannot see: the dynamics' own error, and the torque constant's, which the curve inherits.
    out["stiffness_sigma"] = sqrt(constant**2 + limits["dynamics_sigma"] ** 2)
    out["stiffness_relative_sigma"] = sqrt(relative**2 + limits["torque_constant_sigma"] ** 2)
    out["pairs_difference"] = _pairs_difference(pairs, x[_CONTACT], p["curve"], out["top_force"])
    out["curve_change"] = _curve_change(p["curve"], now["curve"], limits["high_force"])
    out["verdict"] = _judge(rows, force, residual, top, now, limits, out)
    return out


def _pairs_difference(pairs, contact, curve, top_force):
    """RMS difference of the pairs' forces from the curve, as a share of the largest force."""
    force = np.array([characteristic_curve(angle - contact, curve)[0] for angle in pairs[:, ANGLE]])
    return sqrt(np.average((pairs[:, FORCE] - force) ** 2, weights=pairs[:, WEIGHT])) / max(top_force, 1.0)


def _curve_change(curve, before, force):
    """Relative change of the travel that it takes to reach ``force``."""
    travel, past = travel_at(force, curve), travel_at(force, before)
    return abs(travel - past) / past if past > 0.0 else inf


def _judge(rows, force, residual, top, now, limits, out):
    """ACCEPTED, or the first reason against it."""
    high = limits["high_force"]
    covered = limits["coverage"] * high
    uncertain = out["contact_sigma"] + out["force_sigma"] + out["residual"]
    if out["iterations"] < 0 or not np.isfinite(uncertain) or out["contact_sigma"] == 0.0:
        return r.NOT_CONVERGED
    if out["top_force"] < covered:
        return r.NOT_COVERED
    if not _excited(rows["angle"], force, residual, 0.01 * high, covered, limits["samples_per_range"]):
        return r.NOT_EXCITED
    if out["residual_ratio"] > limits["residual_ratio"]:
        return r.RESIDUAL
    travels = np.maximum(top * np.arange(_TRAVELS + 1) / _TRAVELS, 1e-6)
    if any(characteristic_curve(travel, out["curve"])[1] <= 0.0 for travel in travels):
        return r.NOT_PHYSICAL
    load, offset = out["load_friction"], out["offset_friction"]
    if not 0.0 <= load <= limits["maximum_friction_share"] * now["gear_gain"] or not offset >= 0.0:
        return r.NOT_PHYSICAL
    if out["curve_change"] > limits["curve_change"]:
        return r.CHANGED_TOO_MUCH
    friction, past = offset + load * high, now["offset_friction"] + now["load_friction"] * high
    if abs(friction - past) > limits["friction_change"] * past:
        return r.CHANGED_TOO_MUCH
    if out["force_sigma"] > limits["maximum_sigma"]:
        return r.TOO_UNCERTAIN
    if out["pairs_difference"] > limits["pairs_difference"]:
        return r.PAIRS_DISAGREE
    return r.ACCEPTED
