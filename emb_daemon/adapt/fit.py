"""The joint fit: contact angle, characteristic curve, friction and presliding angle from motor current and angle.

The fit runs the estimator's own stiffness and torque paths over the training with trial parameters and minimises the motor
torque that they leave unexplained (Levenberg-Marquardt with Huber weights). Dynamics, effects and inertia stay those of the
calibration.

An offset of the torque and the torque constant are fitted as well, but not learned, because they belong to the current sensor
and the magnets and not to the pads. Motor current alone cannot distinguish a stronger motor from softer pads. The inertia can,
because it never changes, if the unit is the one that was calibrated. If the pads have changed too, the unit may be another.
What stops have shown of torque constant and inertia then counts for more than one slow stroke; without any stop the torque
constant is put halfway between both explanations, with a standard deviation that covers both.

Thesis 2.4 and 3.4 use pairs of passes at equal angle instead. Here they start and check the fit, which also uses the samples
in between, models the pads' dynamics, and gives a covariance.

Only the paths are compiled. A fit runs once per training, outside of the loop, and compiling its own small computations would
take far longer than running them.
"""

from math import exp, expm1, hypot, log, log1p, sqrt
from typing import NamedTuple

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.learned import (
    STIFFNESS_RELATIVE_SIGMA,
    STIFFNESS_SIGMA,
    TRAVELS,
    Evaluation,
    curve_terms,
    curve_values,
    why_out_of_bounds,
)
from emb_daemon.adapt.pairs import FORCE, MODEL, WEIGHT, curve_from_pairs, friction_from_pairs, pairs_of_passes, turned_angles
from emb_daemon.calibration.parameters import (
    INERTIA,
    LOAD_FRICTION,
    OFFSET_FRICTION,
    PRESLIDING_ANGLE,
    TORQUE_CONSTANT,
    moved,
    value_of,
)
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.estimator.paths import begin_paths, stiffness_path, torque_path
from emb_daemon.estimator.records import PARAMETERS, STATE
from emb_daemon.estimator.unknown import INERTIA_SIGMA, SLOW_RAD_PER_S
from emb_daemon.jit import Array, Record, entry, njit
from emb_daemon.models.contact import torque_sigma
from emb_daemon.models.fusion import SLOW, VISCOUS
from emb_daemon.models.stiffness import characteristic_curve, travel_at
from emb_daemon.wire.contract import CYCLE_S

#: Order of the fitted values, see `_Training`.
_CONTACT, _TORQUE_OFFSET, _GAIN, _LOAD, _OFFSET, _PRESLIDING, _INERTIA, _CURVE = range(8)
#: Standard deviation of the logarithm of the torque constant, relative to the calibration: magnets lose 0.1 to 0.2 %/K, and
#: the motor's own current heats them by up to 100 K. A loss beyond the limit would be permanent.
_GAIN_SIGMA, _GAIN_LIMIT = 0.1, 0.3
#: The same of the inertia (rotors and screws of one drawing differ by a tenth), and of the torque constant as a calibration
#: knows it.
_INERTIA_SIGMA, _GAIN_KEPT_SIGMA = 0.1, 0.01
#: Most iterations; the fit has converged when one of them lowers the cost by less than this share.
_ITERATIONS, _CONVERGED = 40, 1e-7
#: Residuals beyond this many standard deviations count linearly (Huber): over 99 % as efficient as squares on normal noise.
_HUBER = 2.5
#: Samples in a block, whose mean torque is fitted: the noise of the acceleration falls with their number, and the requested
#: motion has a period of ten blocks.
_BLOCK = 5
#: Blocks beyond this many standard deviations are left out of a second round, if they are at most this share of all.
_FAR, _FEW = 8.0, 0.05
#: The pads count as changed only if fitting a new curve lowers the cost by this much, per correlated block: with three
#: coefficients noise alone does so once in a thousand trainings (chi-square).
_UNCHANGED = 16.0
#: ... and if its forces differ by this many standard deviations of the torque path's lasting error (95 %).
_LASTING = 2.0
#: Lags over which the residual's autocorrelation inflates the covariance.
_LAGS = 12
#: Least number of samples of a training, and of those that are in blocks whose torque is known, four seconds; number of equal
#: force ranges that must be passed in each direction.
_LEAST_SAMPLES, _RANGES = 1000, 5


@njit
def unexplained_step(s: Record, p: Record, row: Record) -> float:
    """Advance both paths by one TRAINING row; motor torque (N m) that the clamp force leaves unexplained, or NaN."""
    before, speed = s.force, s.speed
    stiffness_path(s, p, row, row.factor)
    torque, leverage, _ = torque_path(s, p, row)
    # Over a training that heats the motor no torque constant explains it.
    torque += row.faded * s.motor_torque
    s.angle, s.speed = row.angle, row.speed
    force = 0.5 * (before + s.force)
    # Driving also learns friction at low and at high speed; the fit of a training has neither.
    slow = (
        s.friction_mean
        * (p.offset_friction + p.load_friction * (force + s.spring_force) * s.gear_slope)
        * exp(-0.5 * abs(row.speed + speed) / SLOW_RAD_PER_S)
    )
    return torque - leverage * force - s.error[SLOW] * slow - s.error[VISCOUS] * 0.5 * (row.speed + speed)


@entry(Array(STATE), Array(PARAMETERS), Array(r.TRAINING), Array(np.float64), Array(np.float64))
def _run(states, parameters, rows, residual, force):
    """`unexplained_step` and stiffness force (N) at each row. At the first, whose residual is NaN, the motor stands, and
    effects remember what they do in ``states``, shape (1,)."""
    s, p = states[0], parameters[0]
    begin_paths(s, p, rows[0], rows[0].factor)
    residual[0], force[0] = np.nan, s.force
    for i in range(1, len(rows)):
        residual[i] = unexplained_step(s, p, rows[i])
        force[i] = s.force


def reach(rows: np.ndarray, state: np.void, contact_angle: float, learned: np.void) -> np.void:
    """STATE of the path models at the last of ``rows`` with the ``learned`` PARAMETERS and contact angle (rad).

    ``state``: as in `fit_training`."""
    reached = np.atleast_1d(state.copy())
    reached["contact_angle"] = contact_angle
    _run(reached, np.atleast_1d(learned), rows, *np.zeros((2, len(rows))))
    return reached[0]


class Driven(NamedTuple):
    """What driving had shown before a training of torque constant and inertia, as shares of the calibration's: errors, their
    variances and their covariance."""

    gain: float
    inertia: float
    gain_variance: float
    inertia_variance: float
    covariance: float = 0.0

    @classmethod
    def of(cls, adapter: np.void) -> "Driven | None":
        """That of an ADAPTER; None if it had not seen a stop."""
        return cls(*(float(adapter[name]) for name in r.DRIVEN)) if adapter["driven"] else None


class _Training:
    """One training as a function of the fitted values: contact angle (rad), offset of the motor torque (N m), logarithm of the
    torque constant over the calibration's, load friction over gear gain, offset friction (N m), logarithms of the presliding
    angle and of the inertia over the calibration's, and the curve's coefficients in units of ``scale`` (N/rad^(n+1)).
    ``rows``: TRAINING array, the samples in order; ``calibration``: in use until now; ``state``: STATE record, as in
    `fit_training`."""

    def __init__(self, rows, calibration, state, scale):
        self._rows, self.calibration, self._state, self.scale = rows, calibration, state, scale
        self._states = np.zeros(1, STATE)
        self.left_out = np.zeros((len(rows) - 1) // _BLOCK, bool)

    def values(self, x) -> dict[str, float]:
        """Values of the calibration's keys for the fitted values ``x``."""
        return curve_values(self.calibration, x[_CURVE:] * self.scale) | {
            LOAD_FRICTION: x[_LOAD] * self.calibration.motor.gear_gain_m_per_rad,
            OFFSET_FRICTION: x[_OFFSET],
            PRESLIDING_ANGLE: exp(min(max(x[_PRESLIDING], -12.0), 2.0)),
        }

    def trial(self, x):
        """The calibration with the fitted values ``x``, motor and inertia included."""
        motor = self.calibration.motor
        torque_constant = motor.torque_constant_Nm_per_A * exp(min(max(x[_GAIN], -1.0), 1.0))
        inertia = motor.inertia_kg_m2 * exp(min(max(x[_INERTIA], -1.0), 1.0))
        return moved(self.calibration, self.values(x) | {TORQUE_CONSTANT: torque_constant, INERTIA: inertia})

    def simulate(self, x):
        """Residuals that `_improve` minimises; unexplained motor torque (N m; NaN: unknown) and stiffness force (N) at each
        row.

        A residual is the mean torque of `_BLOCK` samples, in standard deviations of its noise *with the trial's torque
        constant*. Current and acceleration are both measured (Deming's regression): without this scaling a small torque
        constant would seem to explain more, only because it makes the current's noise small."""
        trial = self.trial(x)
        self._states[0] = self._state
        self._states["contact_angle"] = x[_CONTACT]
        residual, force = np.zeros(len(self._rows)), np.zeros(len(self._rows))
        _run(self._states, np.atleast_1d(to_parameters(trial)), self._rows, residual, force)
        residual -= x[_TORQUE_OFFSET]
        blocks = residual[1 : 1 + len(self.left_out) * _BLOCK].reshape(-1, _BLOCK).mean(axis=1) / _block_noise(trial)
        blocks[self.left_out] = np.nan
        return blocks, residual, force


def _noises(calibration):
    """Torque equivalent to the noise of one sample's current and speed, N m."""
    motor, noise = calibration.motor, calibration.noise
    return motor.torque_constant_Nm_per_A * noise.current_A, motor.inertia_kg_m2 * noise.speed_rad_per_s / CYCLE_S


def _block_noise(calibration):
    """Standard deviation (N m) of the mean torque of `_BLOCK` samples, from the correlated noise of the current and from the
    noise of the speeds at both ends."""
    current, speed = _noises(calibration)
    rho = exp(-CYCLE_S / calibration.noise.current_correlation_s)
    correlated = 1.0 + 2.0 * sum((1.0 - lag / _BLOCK) * rho**lag for lag in range(1, _BLOCK))
    return sqrt(current**2 * correlated / _BLOCK + 2.0 * (speed / _BLOCK) ** 2)


def compile_fit(calibration: Calibration, state: np.void) -> None:
    """Compile, or load from the cache, all that a fit calls; as `fit_training` gets them."""
    rows, p = np.zeros(2, r.TRAINING), to_parameters(calibration)
    x = np.zeros(_CURVE + curve_terms(calibration))
    x[_CURVE] = 1.0
    _Training(rows, calibration, state, np.ones(len(x) - _CURVE)).simulate(x)
    pairs_of_passes(rows, p)
    travel_at(0.0, p["curve"])
    characteristic_curve(0.0, p["curve"])


class _Prior(NamedTuple):
    """What is expected of the fitted values, shape (n,), and with what information, (n, n)."""

    expected: np.ndarray
    information: np.ndarray

    def cost(self, x):
        return (x - self.expected) @ self.gradient(x)

    def gradient(self, x):
        return self.information @ (x - self.expected)


def _cost(blocks, x, prior):
    """Huber cost of the finite blocks, plus that of ``x`` by the `_Prior`."""
    size = np.abs(blocks[np.isfinite(blocks)])
    return np.where(size < _HUBER, size * size, _HUBER * (2.0 * size - _HUBER)).sum() + prior.cost(x)


def _normal_equations(blocks, jacobian):
    """Weighted normal matrix (n, n) and gradient (n,); ``jacobian`` has shape (n, blocks)."""
    known = np.isfinite(blocks)
    value, derivative = blocks[known], jacobian[:, known]
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(value), 1e-300))
    return (derivative * weight) @ derivative.T, derivative @ (weight * value)


def _improve(training, x, steps, prior, free):
    """Levenberg-Marquardt from ``x`` in the values ``free`` (indices), with difference quotients over ``steps`` and ``prior``.

    Returns a `_Fit`; -1 iterations if it did not converge."""
    best = training.simulate(x)
    cost, damping = _cost(best[0], x, prior), 1e-3
    normal, iterations = np.zeros((len(free), len(free))), -1
    for count in range(1, _ITERATIONS + 1):
        moves = [training.simulate(x + step)[0] for step in np.diag(steps)[free]]
        normal, gradient = _normal_equations(best[0], (moves - best[0]) / steps[free, np.newaxis])
        normal += prior.information[np.ix_(free, free)]
        gradient += prior.gradient(x)[free]
        before = cost
        while damping < 1e10:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            trial = x.copy()
            try:
                trial[free] -= np.linalg.solve(damped, gradient)
            except np.linalg.LinAlgError:
                trial[:] = np.nan
            # Force rises from contact. A curve that falls there means that the contact angle is too early.
            if trial[_CURVE] > 0.0:
                attempt = training.simulate(trial)
                attempt_cost = _cost(attempt[0], trial, prior)
                if attempt_cost <= cost:
                    x, best, cost, damping = trial, attempt, attempt_cost, max(0.1 * damping, 1e-9)
                    break
            damping *= 10.0
        if before - cost <= _CONVERGED * before:
            iterations = count
            break
    blocks, residual, force = best
    correlation = _inflation(blocks)
    spread = correlation * _deviation(blocks) ** 2
    covariance = np.zeros((len(x), len(x)))
    covariance[np.ix_(free, free)] = _inverse(normal) * spread
    # The contact angle's standard deviation with the curve held: the error that the filter may have with this curve.
    contact_sigma = sqrt(spread / max(normal[_CONTACT, _CONTACT], 1e-300))
    return _Fit(x, blocks, residual, force, cost, iterations, correlation, spread, covariance, contact_sigma)


class _Fit(NamedTuple):
    """Result of `_improve`: fitted values, result of `_Training.simulate` for them, cost, iterations, factor by which the
    blocks' correlation widens the covariance, the same including their size, and the covariance, zero for values that were
    held."""

    x: np.ndarray
    blocks: np.ndarray
    residual: np.ndarray
    force: np.ndarray
    cost: float
    iterations: int
    correlation: float
    spread: float
    covariance: np.ndarray
    contact_sigma: float


#: What is known of motor and rotor beside a training, without any stop.
_UNDRIVEN = Driven(0.0, 0.0, _GAIN_SIGMA**2, _INERTIA_SIGMA**2)


def _fit(training, x, steps, free, known=_UNDRIVEN):
    """`_improve` twice. The second round weighs correlated blocks and what is ``known`` (`Driven`) against each other by the
    first round's correlation, and leaves outliers out."""
    prior, own = _Prior(np.zeros(len(x)), np.zeros((len(x), len(x)))), [_GAIN, _INERTIA]
    prior.expected[own] = log1p(known.gain), log1p(known.inertia)
    both = np.array([[known.gain_variance, known.covariance], [known.covariance, known.inertia_variance]])
    prior.information[np.ix_(own, own)] = np.linalg.inv(both)
    first = _improve(training, x, steps, prior, free)
    far = np.abs(first.blocks) > _FAR * _deviation(first.blocks)
    if np.mean(far) <= _FEW:
        training.left_out |= far
    return _improve(training, first.x, steps, prior._replace(information=first.spread * prior.information), free)


def _guess(highest, pairs, now, terms):
    """(fitted values by the pairs of passes, NaN where there are none; unit of each of the curve's coefficients)."""
    contact, start = curve_from_pairs(pairs, terms)
    offset, load = friction_from_pairs(pairs)
    powers = np.arange(1, terms + 1)
    top = highest - contact
    scale = max(start @ top**powers, 1.0) / top**powers
    friction = max(load, 0.0) / now["gear_gain"], max(offset, 1e-5), log(now["presliding_angle"])
    return np.array([contact, 0.0, 0.0, *friction, 0.0, *start / scale]), scale


def _fit_with_and_without_curve(training, x, curve, offset_friction, driven):
    """(`_Fit`, whether the pads are unchanged). Unchanged pads keep the ``curve`` of the campaign (in the fit's units), even
    if a curve with more freedom fits the noise better. ``driven``: `Driven` or None."""
    steps = np.full(len(x), 1e-4)
    steps[_CONTACT], steps[_PRESLIDING], steps[_OFFSET] = 1e-3, 1e-2, 1e-3 * max(offset_friction, 1e-4)
    with_curve, without = np.delete(np.arange(len(x)), _INERTIA), np.delete(np.arange(_CURVE), _INERTIA)
    free = _fit(training, x, steps, with_curve)
    kept = np.concatenate([free.x[:_CURVE], curve])
    held = _fit(training, kept, steps, without)
    if held.cost < free.cost:
        # A fit with more freedom cannot be worse: it started too far off and ended at a curve that does not rise at contact.
        free = _fit(training, held.x, steps, with_curve)
    if _as_good(training, held, free):
        # The inertia distinguishes torque constant and stiffness only as well as it is known itself.
        return _fit(training, held.x, steps, np.arange(_CURVE), _UNDRIVEN._replace(inertia_variance=INERTIA_SIGMA**2)), True
    # An inertia that differs from the calibration makes motor and pads look stronger by the same share.
    kept = np.concatenate([free.x[:_CURVE], curve])
    kept[_GAIN] = 0.0
    held = _fit(training, kept, steps, np.arange(_CURVE), _UNDRIVEN._replace(gain_variance=_GAIN_KEPT_SIGMA**2))
    if _as_good(training, held, free):
        return held, True
    # Either the magnets have lost strength or the rotor is another unit's. The contradiction between inertia and torque
    # constant may be an error of either; its size gives the standard deviation of both (the most likely one of two values, by
    # their difference).
    apart = max(abs(free.x[_GAIN]) / sqrt(2.0), _GAIN_KEPT_SIGMA)
    known = driven if driven and driven.gain_variance < apart**2 else Driven(0.0, 0.0, apart**2, apart**2)
    return _fit(training, free.x, steps, np.arange(len(x)), known), False


def _as_good(training, held, fit):
    """Whether a fit with the curve held explains a training as well as one with a curve of its own, or by forces that differ
    by less than the torque path may be off for the length of a training."""
    if held.iterations < 0:
        return False
    apart = np.linalg.norm(held.force - fit.force) / np.linalg.norm(fit.force)
    lasting = training.calibration.noise.torque_lasting
    return (held.cost - fit.cost) / fit.spread < _UNCHANGED or apart < _LASTING * lasting


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


def _deviation(values):
    """Standard deviation of the finite ``values``, without outliers."""
    return 1.4826 * np.median(np.abs(values[np.isfinite(values)]))


def _inflation(residual):
    """Factor by which autocorrelated residuals widen a covariance: 1 + 2 sum of their autocorrelation."""
    value = np.nan_to_num(residual)
    products = (value[lag:] @ value[:-lag] for lag in range(1, _LAGS + 1))
    return 1.0 + 2.0 * sum(max(product, 0.0) for product in products) / (value @ value)


def _force_sigma(curve, scale, covariance, top):
    """Standard deviation of the clamp force from the covariance of contact angle and curve together.

    Returns ``(s0, s1, largest)``: the straight line s0^2 + (s1 F)^2 through its square over the travel (least squares,
    neither part negative), and its largest value."""
    travel = top * np.arange(1, TRAVELS + 1) / TRAVELS
    force, slope = np.array([characteristic_curve(x, curve) for x in travel]).T
    direction = np.zeros((TRAVELS, len(covariance)))
    direction[:, _CONTACT] = -slope
    direction[:, _CURVE:] = scale * travel[:, np.newaxis] ** np.arange(1, len(scale) + 1)
    variance = np.einsum("ti,ij,tj->t", direction, covariance, direction)
    square = force * force
    spread = TRAVELS * (square @ square) - square.sum() ** 2
    share = max((TRAVELS * (square @ variance) - square.sum() * variance.sum()) / spread, 0.0)
    constant = max(variance.mean() - share * square.mean(), 0.25 * variance.mean())
    return sqrt(constant), sqrt(share), sqrt(variance.max())


def _is_excited(angle, contact_angle, force, residual, low, high, limits):
    """Whether each of equal force ranges, and the clearance if it was requested, was passed in both directions with enough
    samples. Pads that have just opened still relax, so the ``angle`` too tells the clearance."""
    known = np.isfinite(residual)
    known[0] = False
    clamping = np.diff(angle, prepend=angle[0]) > 0.0
    place = np.minimum(_RANGES * (force - low) / (high - low), _RANGES - 1).astype(int)
    place[(force <= low) | (angle <= contact_angle)] = _RANGES
    known &= force <= high
    counts = [np.bincount(place[known & side], minlength=_RANGES + 1) for side in (clamping, ~clamping)]
    asked = _RANGES if limits.low_force_N > 0.0 else _RANGES + 1
    return np.min(counts, axis=0)[:asked].min() >= limits.samples_per_range


def fit_training(
    rows: np.ndarray,
    calibration: Calibration,
    base: Calibration,
    state: np.void,
    factor_sigma: float = 0.0,
    driven: Driven | None = None,
) -> Evaluation:
    """Evaluate one training; the result's ``outcome`` says whether it may be used.

    ``rows``: TRAINING array, the samples in order; ``calibration`` is in use until now, ``base`` that of the file; ``state``:
    STATE record, the estimator's at the end of the training, with what its effects remembered at the beginning;
    ``factor_sigma``: standard deviation of the rows' stiffness factor, as a share of it; ``driven``: what stops
    had shown before."""
    now, limits = to_parameters(calibration), calibration.adaptation
    if len(rows) < _LEAST_SAMPLES:
        return Evaluation(r.TOO_FEW, evidence={"samples": len(rows)})
    terms = curve_terms(calibration)
    pairs, turned = pairs_of_passes(rows, now, state), turned_angles(rows, now, float(state["gear_zero"]))
    highest = turned.max()
    x, scale = _guess(highest, pairs, now, terms)
    if not np.all(np.isfinite(x)):
        return Evaluation(r.NOT_EXCITED, evidence={"samples": len(rows)})
    training = _Training(rows, calibration, state, scale)
    known = _BLOCK * int(np.isfinite(training.simulate(x)[0]).sum())
    if known < _LEAST_SAMPLES:
        return Evaluation(r.TOO_FEW, evidence={"samples": known})
    fit, unchanged = _fit_with_and_without_curve(training, x, now["curve"][:terms] / scale, now["offset_friction"], driven)
    x, sigmas = fit.x, np.sqrt(np.diag(fit.covariance))
    values, of_curve = _learned_values(training, fit, unchanged, base, highest - x[_CONTACT], factor_sigma)
    found = Evaluation(
        r.ACCEPTED,
        values={key: float(value) for key, value in values.items()},
        sigmas=curve_values(calibration, sigmas[_CURVE:] * scale)
        | {
            LOAD_FRICTION: float(sigmas[_LOAD] * now["gear_gain"]),
            OFFSET_FRICTION: float(sigmas[_OFFSET]),
            PRESLIDING_ANGLE: float(sigmas[_PRESLIDING] * values[PRESLIDING_ANGLE]),
        },
        contact_angle=float(x[_CONTACT]),
        contact_sigma=float(sigmas[_CONTACT]) if unchanged else fit.contact_sigma,
        torque_error=expm1(-x[_GAIN]),
        torque_error_sigma=hypot(sigmas[_GAIN], limits.torque_constant_relative) * exp(-x[_GAIN]),
        inertia_error=expm1(x[_INERTIA]),
        inertia_sigma=hypot(sigmas[_INERTIA], INERTIA_SIGMA),
        evidence=_residual_evidence(fit, calibration)
        | {
            "samples": len(rows),
            "curve_changed": float(not unchanged),
            "contact_sigma_rad": float(sigmas[_CONTACT]),
            **of_curve,
            "torque_gain": exp(x[_GAIN]),
            "torque_gain_sigma": float(sigmas[_GAIN]),
            "torque_offset_Nm": float(x[_TORQUE_OFFSET]),
            "pairs_difference": _pairs_difference(rows, to_parameters(training.trial(x)), state, x),
        },
    )
    found.outcome, found.note = _judge(turned, fit, base, found)
    return found


def _learned_values(training, fit, unchanged, base, top, factor_sigma):
    """Values to be learned, by the calibration's keys, and as evidence the highest force, at angle ``top`` behind the contact,
    and its standard deviation, N. A curve that is ``unchanged`` keeps its values and their standard deviations."""
    calibration, x = training.calibration, fit.x
    values = training.values(x)
    if unchanged:
        values |= {key: value_of(calibration, key) for key in curve_values(calibration, ())}
    curve = to_parameters(moved(calibration, values))["curve"]
    gain_sigma = sqrt(fit.covariance[_GAIN, _GAIN])
    # An error of the torque constant scales the whole curve; the shape is known better than the scale.
    along = fit.covariance[_GAIN] / max(gain_sigma, 1e-300)
    constant, relative, force_sigma = _force_sigma(curve, training.scale, fit.covariance - np.outer(along, along), top)
    if unchanged:
        values |= {key: value_of(calibration, key) for key in (STIFFNESS_SIGMA, STIFFNESS_RELATIVE_SIGMA)}
    else:
        # Errors that the fit cannot see but the curve inherits: of the dynamics, the gear gain, the torque path and the pad
        # temperature.
        unseen = calibration.adaptation.torque_constant_relative, calibration.noise.torque_lasting, factor_sigma
        scale_sigma = hypot(gain_sigma, *unseen)
        values[STIFFNESS_SIGMA] = hypot(constant, base.noise.stiffness_N)
        values[STIFFNESS_RELATIVE_SIGMA] = hypot(relative, scale_sigma)
    return values, {"force_sigma_N": force_sigma, "top_force_N": float(characteristic_curve(top, curve)[0])}


def _residual_evidence(fit, calibration):
    """Size of the unexplained torque, over the torque constant and relative to noise, and its correlation."""
    expected, _ = torque_sigma(*_noises(calibration))
    sigma = _deviation(fit.residual)
    return {
        "residual_A": float(sigma / calibration.motor.torque_constant_Nm_per_A),
        "residual_ratio": float(sigma / expected),
        "correlation": float(fit.correlation),
    }


def _pairs_difference(rows, p, state, x):
    """RMS difference between the pairs' forces and those of the stiffness path, as a share of the largest force, with the
    fitted PARAMETERS ``p``, contact angle and torque offset."""
    found = state.copy()
    found["contact_angle"] = x[_CONTACT]
    pairs = pairs_of_passes(rows, p, found)
    seen, force = pairs[:, FORCE] - x[_TORQUE_OFFSET] / p["gear_gain"], pairs[:, MODEL]
    if not len(pairs):
        return np.inf
    return sqrt(np.average((seen - force) ** 2, weights=pairs[:, WEIGHT])) / max(force.max(), 1.0)


def _judge(angle, fit, base, found):
    """(ACCEPTED or the first reason for a rejection, a note with numbers); ``angle``: equivalent angle (rad) of each row."""
    limits, evidence = base.adaptation, found.evidence
    covered = limits.coverage * base.training_force_N
    uncertain = evidence["contact_sigma_rad"] + evidence["force_sigma_N"] + evidence["residual_A"]
    if fit.iterations < 0 or not np.isfinite(uncertain) or evidence["contact_sigma_rad"] == 0.0:
        return r.NOT_CONVERGED, ""
    if evidence["top_force_N"] < covered:
        return r.NOT_COVERED, f"{evidence['top_force_N']:.0f} N of {covered:.0f} N"
    low = max(0.01 * base.training_force_N, limits.low_force_N)
    if not _is_excited(angle, found.contact_angle, fit.force, fit.residual, low, covered, limits):
        return r.NOT_EXCITED, ""
    if evidence["residual_ratio"] > limits.residual_ratio:
        return r.RESIDUAL, f"{evidence['residual_ratio']:.2f} times the noise"
    if abs(fit.x[_GAIN]) > _GAIN_LIMIT:
        return r.OUT_OF_BOUNDS, f"torque constant {evidence['torque_gain']:.2f} times the calibration's"
    if out_of_bounds := why_out_of_bounds(base, found.values):
        return r.OUT_OF_BOUNDS, out_of_bounds
    if evidence["force_sigma_N"] > limits.maximum_sigma_N:
        return r.TOO_UNCERTAIN, f"{evidence['force_sigma_N']:.0f} N"
    if evidence["pairs_difference"] > limits.pairs_difference:
        return r.PAIRS_DISAGREE, f"by {100.0 * evidence['pairs_difference']:.1f} % of full force"
    return r.ACCEPTED, ""
