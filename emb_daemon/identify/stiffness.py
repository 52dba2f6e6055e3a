"""Stiffness path: characteristic curves and dynamics from the motor angle and the reference force.

Thesis 2.1, 3.3.2 and 3.4 as they stand (`thesis_curve`, `regress_free`, `regress_damping`), and the output-error fit of the
production model with its effects (`fit_dynamics`). What is fitted is the estimator's own stiffness path, sample by sample.
"""

from dataclasses import dataclass, field

import numpy as np

from emb_daemon.calibration.types import Curve
from emb_daemon.effects import REGISTRY
from emb_daemon.estimator.paths import stiffness_path
from emb_daemon.estimator.records import PARAMETERS, STATE
from emb_daemon.identify.fitting import Block, Solution, least_squares
from emb_daemon.jit import njit
from emb_daemon.offline import Log

#: Terms of the characteristic curve, the thesis's cubic.
TERMS = 3
#: Parameters of the dynamics that all pads of an actuator share: name, effect that it belongs to.
DYNAMICS = (
    ("relaxation_time_s", None),
    ("second_relaxation.share", "second_relaxation"),
    ("second_relaxation.time_constant_s", "second_relaxation"),
    ("stiffness_hysteresis.share", "stiffness_hysteresis"),
    ("stiffness_hysteresis.slip_angle_rad", "stiffness_hysteresis"),
    ("signal_delay.delay_s", "signal_delay"),
)
#: Effects that a fit may leave out; the delay of the reference against the resolver is a nuisance that always stays in.
OPTIONAL = ("second_relaxation", "stiffness_hysteresis")
_DELAY_UNIT_S = 1e-3
#: Further starting points of the slip angle, times the first, and iterations that each is given to prove itself.
_SLIP_STARTS = (0.3, 3.0)
_TRIAL = 8


@njit
def _simulate(samples, contact_angle, factor, parameters, state, force):
    p, s = parameters[0], state[0]
    s.contact_angle = contact_angle
    s.past_contact = samples[0].angle - contact_angle
    for row in range(len(samples)):
        stiffness_path(s, p, samples[row], factor[row] if len(factor) > 1 else factor[0])
        force[row] = s.force


_COLD = np.ones(1)


def simulate(samples: np.ndarray, contact_angle: float, parameters: np.ndarray, factor: np.ndarray = _COLD) -> np.ndarray:
    """Force in N of the estimator's stiffness path, contact angle held.

    Args:
        samples: SAMPLE rows.
        contact_angle: rad on the log's own zero.
        parameters: PARAMETERS, shape (1,).
        factor: stiffness factor, one for all rows or one each.
    """
    force = np.empty(len(samples))
    _simulate(samples, contact_angle, factor, parameters, np.zeros(1, STATE), force)
    return force


@dataclass(frozen=True)
class Pads:
    """Logs with one pair of pads, which share a characteristic curve."""

    thickness_mm: float
    logs: tuple[Log, ...]


@dataclass(frozen=True)
class Dynamics:
    """Shared dynamics by name (`DYNAMICS`), and their standard deviations; an effect left out has no entries."""

    values: dict[str, float]
    sigmas: dict[str, float]

    def effects(self) -> dict[str, dict[str, float]]:
        """Effects as a calibration holds them; the delay of the rig's reference is none of the brake's."""
        found: dict[str, dict[str, float]] = {}
        for name, effect in DYNAMICS:
            if effect in OPTIONAL and name in self.values:
                found.setdefault(effect, {})[name.split(".")[1]] = self.values[name]
        return found


@dataclass(frozen=True)
class CurveFit:
    """A characteristic curve past its contact.

    Attributes:
        coefficients: N/rad^(n+1), shape (TERMS,).
        covariance: of the coefficients.
        clearances_rad: of each log, from its first angle to contact.
        clearance_sigmas_rad: their standard deviations.
        travel_rad: largest travel past contact.
    """

    thickness_mm: float
    coefficients: np.ndarray
    covariance: np.ndarray
    clearances_rad: np.ndarray
    clearance_sigmas_rad: np.ndarray
    travel_rad: float

    def curve(self) -> Curve:
        return Curve(pad_thickness_mm=self.thickness_mm, coefficients=tuple(float(c) for c in self.coefficients))

    def force(self, x: np.ndarray) -> np.ndarray:
        """Static force in N at ``x`` rad past contact."""
        return sum(c * np.maximum(x, 0.0) ** (n + 1) for n, c in enumerate(self.coefficients))

    def force_sigma(self, x: np.ndarray) -> np.ndarray:
        """Its standard deviation from the covariance of the coefficients."""
        basis = np.stack([np.maximum(x, 0.0) ** (n + 1) for n in range(len(self.coefficients))])
        return np.sqrt(np.einsum("it,ij,jt->t", basis, self.covariance, basis))


@dataclass(frozen=True)
class DynamicsFit:
    """Joint fit over pads of several thicknesses.

    Attributes:
        residuals: simulated minus reference force, by log path.
        rms: over all samples fitted, N.
    """

    dynamics: Dynamics
    curves: list[CurveFit]
    rms: float
    residuals: dict[str, np.ndarray] = field(repr=False)


def _blank() -> np.ndarray:
    """PARAMETERS, shape (1,), of a brake without curve, lag or effects."""
    parameters = np.zeros(1, PARAMETERS)
    # What effects add to the pads' way is divided by it, even when it is nothing.
    parameters["gear_gain"] = 1.0
    return parameters


def with_dynamics(values: dict[str, float]) -> np.ndarray:
    """PARAMETERS, shape (1,), in which only the shared dynamics are set."""
    parameters = _blank()
    for name, effect in DYNAMICS:
        value = values.get(name, 0.0)
        if effect is None:
            parameters["relaxation_time"] = value
        else:
            parameters["effects"][effect][name.split(".")[1]] = value
    return parameters


def is_slow(log: Log) -> bool:
    """Whether the motor passes its travel less than once in four seconds: a slow clamp, no random motion."""
    angle = log.samples["angle"]
    return float(np.sum(np.abs(np.diff(angle)))) < 0.25 * float(np.ptp(angle)) * log.time_s[-1]


def contact_guess(log: Log, noise_N: float) -> float:
    """Motor angle at which the reference force first stands clear of its noise, on the log's own zero."""
    clear = np.flatnonzero(log.force_N > 8.0 * max(noise_N, 1e-9))
    return float(log.samples["angle"][clear[0]]) if len(clear) else float(log.samples["angle"][0])


def rest_noise(log: Log) -> float:
    """Standard deviation in N of the reference force before the motor first moves by a hundredth of its travel."""
    angle = log.samples["angle"]
    moved = np.flatnonzero(np.abs(angle - angle[0]) > 0.01 * max(np.ptp(angle), 1e-9))
    at_rest = log.force_N[: max(moved[0] if len(moved) else 0, 5)]
    return float(np.nanstd(at_rest))


def _powers(x: np.ndarray) -> np.ndarray:
    x = np.maximum(x, 0.0)
    return np.stack([x ** (n + 1) for n in range(TERMS)], axis=1)


def thesis_curve(log: Log) -> tuple[float, np.ndarray, np.ndarray]:
    """Thesis 2.1: line of best fit through the loop of a slow clamp and release.

    Returns:
        (contact angle in rad, coefficients, residual in N at each sample with a reference).
    """
    angle, known = log.samples["angle"], np.isfinite(log.force_N)
    force = log.force_N[known]
    guess = contact_guess(log, rest_noise(log))
    span = float(angle.max() - guess)

    def solve(contact):
        powers = _powers(angle[known] - contact) / span ** np.arange(1, TERMS + 1)
        coefficients = np.linalg.lstsq(powers, force, rcond=None)[0]
        return powers @ coefficients - force, coefficients

    contacts = guess - np.linspace(0.0, 0.15, 61) * span
    contact = contacts[int(np.argmin([np.sum(solve(c)[0] ** 2) for c in contacts]))]
    residual, coefficients = solve(contact)
    return float(contact), coefficients / span ** np.arange(1, TERMS + 1), residual


def regress_free(log: Log, contact_angle: float) -> tuple[np.ndarray, float, float]:
    """Thesis 3-5: F(i) = a3 x^3 + a2 x^2 + a1 x + a0 F(i-1) by least squares.

    Returns:
        (coefficients of the static curve, time constant in s, rms of the one-step residual in N).
    """
    angle, force = log.samples["angle"], log.force_N
    powers = _powers(angle - contact_angle)
    rows = np.flatnonzero(np.isfinite(force[1:]) & np.isfinite(force[:-1]) & (angle[1:] > contact_angle)) + 1
    span = max(float(angle.max() - contact_angle), 1e-9) ** np.arange(1, TERMS + 1)
    design = np.column_stack([powers[rows] / span, force[rows - 1] / np.max(force[rows])])
    solution = np.linalg.lstsq(design, force[rows], rcond=None)[0]
    decay = float(np.clip(solution[-1] / np.max(force[rows]), 0.01, 0.999))
    cycle = float(np.median(log.samples["dt"][1:]))
    residual = design @ solution - force[rows]
    return solution[:-1] / span / (1.0 - decay), -cycle / np.log(decay), float(np.sqrt(np.mean(residual**2)))


def regress_damping(log: Log, contact_angle: float, coefficients: np.ndarray) -> tuple[float, float]:
    """Thesis 3-8 with the static curve known: F(i) = b1 [F_s(i) + b0 F(i-1)], b1 = 1 / (1 + b0), by least squares.

    Returns:
        (time constant b0 dt in s, its standard deviation for independent residuals).
    """
    force = log.force_N
    static = _powers(log.samples["angle"] - contact_angle) @ coefficients
    rows = np.flatnonzero(np.isfinite(force[1:]) & np.isfinite(force[:-1])) + 1
    change = force[rows] - force[rows - 1]
    lag = static[rows] - force[rows]
    ratio = float(change @ lag / (change @ change))
    residual = lag - ratio * change
    cycle = float(np.median(log.samples["dt"][1:]))
    return ratio * cycle, cycle * float(np.sqrt(np.mean(residual**2) / (change @ change)))


def _bounds(name: str) -> tuple[float, float]:
    effect, _, key = name.partition(".")
    for candidate in REGISTRY:
        if candidate.name == effect:
            parameter = next(p for p in candidate.parameters if p.name == key)
            return max(parameter.low, 1e-4), parameter.high
    return 1e-3, 1.0


def starting_values(groups: list[Pads]) -> dict[str, float]:
    """Where a search for the dynamics starts: thesis 3-5 for the time constant, the rest by proportion."""
    times, spans = [], []
    for pads in groups:
        for log in pads.logs:
            contact = contact_guess(log, rest_noise(log))
            spans.append(float(log.samples["angle"].max() - contact))
            times.append((is_slow(log), regress_free(log, contact)[1]))
    # Slow logs hardly show the lag: they count only where there are no others.
    fast = [time for slow, time in times if not slow] or [time for _, time in times]
    time = float(np.clip(np.median(fast), 2e-3, 0.5))
    return {
        "relaxation_time_s": time,
        "second_relaxation.share": 0.1,
        "second_relaxation.time_constant_s": float(np.clip(10.0 * time, 0.06, 10.0)),
        "stiffness_hysteresis.share": 0.02,
        "stiffness_hysteresis.slip_angle_rad": float(np.clip(0.05 * max(spans), 0.06, 9.0)),
        "signal_delay.delay_s": 0.0,
    }


def fit_dynamics(
    groups: list[Pads],
    effects: tuple[str, ...] = OPTIONAL,
    start: dict[str, float] | None = None,
    curves: list[CurveFit] | None = None,
    fraction: float = 1.0,
    fixed: bool = False,
) -> DynamicsFit:
    """Output-error fit of the production stiffness path: one set of dynamics, a curve for each pair of pads, a contact
    angle for each log.

    Positive parameters are sought as logarithms: with plain ones the slip angle can cross zero and not come back.

    Args:
        effects: which of `OPTIONAL` take part.
        start: dynamics to start from, by name; without it several starting points are tried.
        curves: curves to start from, one per group.
        fraction: share that is fitted of each log that is not slow, from its beginning.
        fixed: keep the dynamics at ``start`` and fit curves and contact angles alone.
    """
    given = start is not None
    start = dict(start) if given else starting_values(groups)
    names = [name for name, effect in DYNAMICS if effect is None or effect == "signal_delay" or effect in effects]
    logs = [(g, log) for g, pads in enumerate(groups) for log in pads.logs]
    noises = [rest_noise(log) for _, log in logs]
    guesses = [contact_guess(log, noise) for (_, log), noise in zip(logs, noises, strict=True)]
    spans = np.array(
        [
            max(log.samples["angle"].max() - guess for (owner, log), guess in zip(logs, guesses, strict=True) if owner == g)
            for g in range(len(groups))
        ]
    )
    powers = spans[:, None] ** np.arange(1, TERMS + 1)

    x, scale, low, high = [], [], [], []

    def add(value, size, least=-np.inf, most=np.inf):
        x.append(value)
        scale.append(size)
        low.append(least)
        high.append(most)

    for name in [] if fixed else names:
        if name == "signal_delay.delay_s":
            add(start.get(name, 0.0) / _DELAY_UNIT_S, 0.1, -10.0, 10.0)
        else:
            add(np.log(start[name]), 0.05, *np.log(_bounds(name)))
    shared = len(x)
    for g, pads in enumerate(groups):
        if curves:
            scaled = curves[g].coefficients * powers[g]
        else:
            log = pads.logs[-1]
            scaled = regress_free(log, contact_guess(log, rest_noise(log)))[0] * powers[g]
            if scaled[0] <= 0.0:
                scaled = np.full(TERMS, np.nanmax(log.force_N) / TERMS)
        full = float(np.sum(np.abs(scaled)))
        for n, value in enumerate(scaled):
            add(value, 0.02 * full, 1e-3 * full if n == 0 else -np.inf)
    first_contact = len(x)
    for (g, _), guess in zip(logs, guesses, strict=True):
        add(guess - 0.02 * spans[g], 0.005 * spans[g])
    scratch = _blank()

    def set_dynamics(values):
        for index, name in enumerate(names):
            if fixed:
                value = start.get(name, 0.0)
            elif name == "signal_delay.delay_s":
                value = values[index] * _DELAY_UNIT_S
            else:
                value = np.exp(values[index])
            effect, _, key = name.partition(".")
            if key:
                scratch["effects"][effect][key] = value
            else:
                scratch["relaxation_time"] = value

    def block(index):
        g, log = logs[index]
        rows = len(log.samples)
        if fraction < 1.0 and not is_slow(log):
            rows = int(fraction * rows)
        samples, force = log.samples[:rows], log.force_N[:rows]
        known = np.isfinite(force)
        force = force[known]
        own = shared + TERMS * g + np.arange(TERMS)

        def residual(values):
            set_dynamics(values)
            scratch["curve"][0, :TERMS] = values[own] / powers[g]
            return simulate(samples, values[first_contact + index], scratch)[known] - force

        return Block(residual, np.concatenate([np.arange(shared), own, [first_contact + index]]))

    blocks = [block(index) for index in range(len(logs))]
    limits = np.array(scale), np.array(low), np.array(high)
    starts = [np.array(x)]
    slip = "stiffness_hysteresis.slip_angle_rad"
    if not given and slip in names:
        # A loop's width and its turning length trade off: other turning lengths may lead to another valley.
        for factor in _SLIP_STARTS:
            starts.append(starts[0].copy())
            starts[-1][names.index(slip)] += np.log(factor)
    if len(starts) > 1:
        tried = [least_squares(blocks, start, *limits, iterations=_TRIAL) for start in starts]
        starts = [min(tried, key=lambda found: found.rms).x]
    solution = least_squares(blocks, starts[0], *limits)
    return _unpack(
        solution, groups, logs, [] if fixed else names, start if fixed else {}, powers, spans, shared, first_contact
    )


def _unpack(solution: Solution, groups, logs, names, held, powers, spans, shared, first_contact) -> DynamicsFit:
    deviations = np.sqrt(np.diag(solution.covariance))
    values, sigmas = dict(held), {}
    for index, name in enumerate(names):
        if name == "signal_delay.delay_s":
            values[name], sigmas[name] = solution.x[index] * _DELAY_UNIT_S, deviations[index] * _DELAY_UNIT_S
        else:
            values[name] = float(np.exp(solution.x[index]))
            sigmas[name] = values[name] * deviations[index]
    curves = []
    for g, pads in enumerate(groups):
        own = shared + TERMS * g + np.arange(TERMS)
        mine = [index for index, (owner, _) in enumerate(logs) if owner == g]
        contacts = first_contact + np.array(mine)
        starts = np.array([logs[index][1].samples["angle"][0] for index in mine])
        curves.append(
            CurveFit(
                pads.thickness_mm,
                solution.x[own] / powers[g],
                solution.covariance[np.ix_(own, own)] / np.outer(powers[g], powers[g]),
                solution.x[contacts] - starts,
                deviations[contacts],
                float(max(logs[i][1].samples["angle"].max() - solution.x[first_contact + i] for i in mine)),
            )
        )
    residuals = {str(log.path): r for (_, log), r in zip(logs, solution.residuals, strict=True)}
    return DynamicsFit(Dynamics(values, sigmas), curves, solution.rms, residuals)
