"""Characteristic curves and dynamics of the stiffness path by output error: the estimator's own path, sample by sample."""

from dataclasses import dataclass, field, replace

import numpy as np

from emb_daemon.calibration.types import Curve
from emb_daemon.effects import REGISTRY
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.offline import Log
from emb_daemon.offline.fit import Block, Fit, Free, fit
from emb_daemon.offline.run import stiffness_force

#: Terms of the characteristic curve, the thesis's cubic.
TERMS = 3
_RELAXATION, _DELAY = "relaxation_time_s", "signal_delay.delay_s"
_SLIP = "stiffness_hysteresis.slip_angle_rad"
#: Parameters of the dynamics that all pads of an actuator share.
DYNAMICS = (
    _RELAXATION,
    "second_relaxation.share",
    "second_relaxation.time_constant_s",
    "stiffness_hysteresis.share",
    _SLIP,
    _DELAY,
)
#: Effects that a fit may leave out; the delay of the reference against the resolver is a nuisance that always stays in.
OPTIONAL = ("second_relaxation", "stiffness_hysteresis")
#: Further starting points of the slip angle, times the first, and evaluations that each is given to prove itself.
_SLIP_STARTS = (0.3, 3.0)
_TRIAL = 8
#: Residuals of this many samples count as one observation: a second, in which a random angle takes ten targets.
EPISODE = 250


@dataclass(frozen=True)
class Pads:
    """Logs with one pair of pads, which share a characteristic curve."""

    thickness_mm: float
    logs: tuple[Log, ...]

    @property
    def slow(self) -> tuple[Log, ...]:
        return tuple(log for log in self.logs if is_slow(log))

    @property
    def random(self) -> tuple[Log, ...]:
        return tuple(log for log in self.logs if not is_slow(log))


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
        return powers(x, len(self.coefficients)) @ self.coefficients

    def force_sigma(self, x: np.ndarray) -> np.ndarray:
        """Its standard deviation from the covariance of the coefficients."""
        basis = powers(x, len(self.coefficients))
        return np.sqrt(np.einsum("ti,ij,tj->t", basis, self.covariance, basis))


@dataclass(frozen=True)
class DynamicsFit:
    """Joint fit over pads of several thicknesses.

    Attributes:
        values, sigmas: shared dynamics by name (`DYNAMICS`); an effect left out has no entries, what was held no sigma.
        residuals: simulated minus reference force, by log path.
        rms: over all samples fitted, N.
    """

    values: dict[str, float]
    sigmas: dict[str, float]
    curves: list[CurveFit]
    rms: float
    residuals: dict[str, np.ndarray] = field(repr=False)

    def effects(self) -> dict[str, dict[str, float]]:
        """Effects as a calibration holds them; the delay of the rig's reference is none of the brake's."""
        found: dict[str, dict[str, float]] = {}
        for name, value in self.values.items():
            effect, _, key = name.partition(".")
            if effect in OPTIONAL:
                found.setdefault(effect, {})[key] = value
        return found


def powers(x: np.ndarray, terms: int = TERMS) -> np.ndarray:
    """x, x², x³ ... of the travel past contact, zero before it; shape (n, terms)."""
    return np.maximum(x, 0.0)[:, None] ** np.arange(1, terms + 1)


def with_dynamics(values: dict[str, float]) -> np.ndarray:
    """PARAMETERS, shape (1,), of a brake with only the shared dynamics set: no curve, no clearance."""
    parameters = np.zeros(1, PARAMETERS)
    # What effects add to the pads' way is divided by it, even when it is nothing.
    parameters["gear_gain"] = 1.0
    for name, value in values.items():
        effect, _, key = name.partition(".")
        if key:
            parameters["effects"][effect][key] = value
        else:
            parameters["relaxation_time"] = value
    return parameters


def simulate(log: Log, values: dict[str, float], coefficients: np.ndarray, clearance: float) -> np.ndarray:
    """Force in N of the stiffness path over a log; dynamics by name as in `DYNAMICS`."""
    parameters = with_dynamics(values)
    parameters["curve"][0, : len(coefficients)] = coefficients
    parameters["clearance"] = clearance
    return stiffness_force(log.samples, parameters)


def in_service(values: dict[str, float]) -> dict[str, float]:
    """Dynamics as the daemon has them: the delay of the rig's reference is none of the brake's."""
    return {**values, _DELAY: 0.0}


def is_slow(log: Log) -> bool:
    """Whether the motor passes its travel less than once in four seconds: a slow clamp, no random motion."""
    angle = log.samples["angle"]
    return float(np.sum(np.abs(np.diff(angle)))) < 0.25 * float(np.ptp(angle)) * log.time_s[-1]


def clearance_guess(log: Log) -> float:
    """Motor angle from the start of a log to where the reference force first stands clear of its noise, rad."""
    clear = np.flatnonzero(log.force_N > 8.0 * max(_rest_noise(log), 1e-9))
    return float(log.samples["angle"][clear[0]] - log.samples["angle"][0]) if len(clear) else 0.0


def _rest_noise(log: Log) -> float:
    """Standard deviation in N of the reference force before the motor first moves by a hundredth of its travel."""
    angle = log.samples["angle"]
    moved = np.flatnonzero(np.abs(angle - angle[0]) > 0.01 * max(np.ptp(angle), 1e-9))
    return float(np.nanstd(log.force_N[: max(moved[0] if len(moved) else 0, 5)]))


def _travel(log: Log) -> np.ndarray:
    return log.samples["angle"] - log.samples["angle"][0]


def regress_free(log: Log, clearance: float) -> tuple[np.ndarray, float]:
    """Thesis 3-5: F(i) = a3 x^3 + a2 x^2 + a1 x + a0 F(i-1) by least squares.

    Returns:
        (coefficients of the static curve, time constant in s).
    """
    x, force = _travel(log) - clearance, log.force_N
    rows = np.flatnonzero(np.isfinite(force[1:]) & np.isfinite(force[:-1]) & (x[1:] > 0.0)) + 1
    span = max(float(x.max()), 1e-9) ** np.arange(1, TERMS + 1)
    top = np.max(force[rows])
    solution = np.linalg.lstsq(np.column_stack([powers(x[rows]) / span, force[rows - 1] / top]), force[rows], rcond=None)[0]
    decay = float(np.clip(solution[-1] / top, 0.01, 0.999))
    cycle = float(np.median(log.samples["dt"][1:]))
    return solution[:-1] / span / (1.0 - decay), -cycle / np.log(decay)


def starting_values(groups: list[Pads]) -> dict[str, float]:
    """Where a search for the dynamics starts: thesis 3-5 for the time constant, the rest by proportion."""
    logs = [log for pads in groups for log in pads.logs]
    # Slow logs hardly show the lag: they count only where there are no others.
    fast = [log for log in logs if not is_slow(log)] or logs
    time = float(np.clip(np.median([regress_free(log, clearance_guess(log))[1] for log in fast]), 2e-3, 0.5))
    span = max(float(_travel(log).max()) - clearance_guess(log) for log in logs)
    return {
        _RELAXATION: time,
        "second_relaxation.share": 0.1,
        "second_relaxation.time_constant_s": float(np.clip(10.0 * time, 0.06, 10.0)),
        "stiffness_hysteresis.share": 0.02,
        _SLIP: float(np.clip(0.05 * span, 0.06, 9.0)),
        _DELAY: 0.0,
    }


def _free_dynamics(name: str, start: float) -> Free:
    """Positive ones are searched as logarithms: with plain ones the slip angle can cross zero and not come back."""
    if name == _DELAY:
        return Free(start, 1e-7, -0.01, 0.01)
    low, high = 1e-3, 1.0
    effect, _, key = name.partition(".")
    for known in REGISTRY:
        if known.name == effect:
            parameter = next(p for p in known.parameters if p.name == key)
            low, high = max(parameter.low, 1e-4), parameter.high
    return Free(start, 5e-5, low, high, logarithmic=True)


def _free_curve(pads: Pads, curve: CurveFit | None, scale: np.ndarray) -> list[Free]:
    """A curve's coefficients in N at full travel, one for each term."""
    log = pads.logs[-1]
    start = (curve.coefficients if curve else regress_free(log, clearance_guess(log))[0]) * scale
    if start[0] <= 0.0:
        start = np.full(TERMS, np.nanmax(log.force_N) / TERMS)
    full = float(np.sum(np.abs(start)))
    # Force rises from contact: the first coefficient stays positive.
    return [Free(value, 2e-5 * full, 1e-3 * full if n == 0 else -np.inf) for n, value in enumerate(start)]


class _Model:
    """What is fitted: keys are names of `DYNAMICS`, (group, term) of a curve and (group, log's number) of a clearance."""

    def __init__(self, groups, names, held, fraction):
        self.groups, self.names, self.held = groups, names, held
        self.fraction = fraction
        self.spans = [max(float(_travel(log).max()) - clearance_guess(log) for log in pads.logs) for pads in groups]
        self.scales = [span ** np.arange(1, TERMS + 1) for span in self.spans]

    def free(self, start: dict[str, float], curves: list[CurveFit] | None) -> dict:
        free = {name: _free_dynamics(name, start[name]) for name in self.names}
        for g, pads in enumerate(self.groups):
            terms = _free_curve(pads, curves[g] if curves else None, self.scales[g])
            free |= {("curve", g, n): term for n, term in enumerate(terms)}
        for g, pads in enumerate(self.groups):
            for number, log in enumerate(pads.logs):
                # Force stands clear of its noise somewhat past contact.
                free["clearance", g, number] = Free(clearance_guess(log) - 0.02 * self.spans[g], 5e-6 * self.spans[g])
        return free

    def blocks(self) -> list[Block]:
        return [self._block(g, number, log) for g, pads in enumerate(self.groups) for number, log in enumerate(pads.logs)]

    def _block(self, g: int, number: int, log: Log) -> Block:
        rows = len(log.samples) if self.fraction == 1.0 or is_slow(log) else int(self.fraction * len(log.samples))
        samples, force = log.samples[:rows], log.force_N[:rows]
        known = np.isfinite(force)
        curve = [("curve", g, n) for n in range(TERMS)]

        def residual(values):
            parameters = with_dynamics(self.held | {name: values[name] for name in self.names})
            parameters["curve"][0, :TERMS] = [values[key] for key in curve] / self.scales[g]
            parameters["clearance"] = values["clearance", g, number]
            return (stiffness_force(samples, parameters) - force)[known]

        keys = (*self.names, *curve, ("clearance", g, number))
        return Block(residual, keys, np.arange(np.count_nonzero(known)) // EPISODE)

    def result(self, found: Fit) -> DynamicsFit:
        curves = []
        for g, pads in enumerate(self.groups):
            own = [("curve", g, n) for n in range(TERMS)]
            contacts = [("clearance", g, number) for number in range(len(pads.logs))]
            clearances = np.array([found.values[key] for key in contacts])
            curves.append(
                CurveFit(
                    pads.thickness_mm,
                    np.array([found.values[key] for key in own]) / self.scales[g],
                    found.block(own) / np.outer(self.scales[g], self.scales[g]),
                    clearances,
                    np.array([found.sigmas[key] for key in contacts]),
                    float(max(_travel(log).max() - c for log, c in zip(pads.logs, clearances, strict=True))),
                )
            )
        logs = [log for pads in self.groups for log in pads.logs]
        residuals = {str(log.path): r for log, r in zip(logs, found.residuals, strict=True)}
        values = self.held | {name: found.values[name] for name in self.names}
        return DynamicsFit(values, {name: found.sigmas[name] for name in self.names}, curves, found.rms, residuals)


def fit_dynamics(
    groups: list[Pads],
    effects: tuple[str, ...] = OPTIONAL,
    start: dict[str, float] | None = None,
    curves: list[CurveFit] | None = None,
    fraction: float = 1.0,
    fixed: bool = False,
) -> DynamicsFit:
    """One set of dynamics, a curve for each pair of pads, a contact angle for each log.

    Args:
        effects: which of `OPTIONAL` take part.
        start: dynamics to start from, by name; without it several starting points are tried.
        curves: curves to start from, one per group.
        fraction: share that is fitted of each log that is not slow, from its beginning.
        fixed: keep the dynamics at ``start`` and fit curves and contact angles alone.
    """
    names = [name for name in DYNAMICS if name in (_RELAXATION, _DELAY) or name.partition(".")[0] in effects]
    first = start or starting_values(groups)
    held = {name: first[name] for name in names if name in first} if fixed else {}
    model = _Model(groups, [] if fixed else names, held, fraction)
    blocks = model.blocks()
    first = model.free(first, curves)
    if start is None and _SLIP in names:
        # A loop's width and its turning length trade off: other turning lengths may lead to another valley.
        starts = [first, *(first | {_SLIP: _free_dynamics(_SLIP, factor * first[_SLIP].start)} for factor in _SLIP_STARTS)]
        tried = [fit(blocks, free, tolerance=1e-5, evaluations=_TRIAL) for free in starts]
        best = min(tried, key=lambda found: found.rms).values
        first = {key: replace(free, start=best[key]) for key, free in first.items()}
    return model.result(fit(blocks, first, tolerance=1e-6))
