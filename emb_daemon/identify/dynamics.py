"""Characteristic curves and dynamics of the stiffness path by output error: the estimator's own path, sample by sample."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import structs
from scipy.optimize import nnls

from emb_daemon.calibration.curves import Curve, rising_force
from emb_daemon.calibration.parameters import CLEARANCE, moved, parameter, value_of
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import Effect
from emb_daemon.models.gear import all_through_gear
from emb_daemon.offline import Log
from emb_daemon.offline.fit import Block, Fit, Free, fit, valley
from emb_daemon.offline.run import stiffness_force
from emb_daemon.offline.score import rmse

#: Terms of the characteristic curve, the thesis's cubic.
TERMS = 3
RELAXATION = "stiffness.relaxation_time_s"
#: Delay of the rig's reference relative to its resolver, s; fitted together with the calibration's keys, but no property of
#: the brake.
DELAY = "reference delay"
#: Effects on the force that may be added to the dynamics, and those that are a further element beside another.
_STATIC = tuple(effect for effect in REGISTRY if effect.hook in ("stiffness", "force"))
OPTIONAL = tuple(effect for effect in _STATIC if not effect.beside)
FURTHER = tuple(effect for effect in _STATIC if effect.beside)
#: Those of the former that none of them opposes.
_USUAL = tuple(effect for effect in OPTIONAL if not effect.opposes)
#: Starting values of these effects' time constants over that of the lag, and of their angles over the travel; by unit, those
#: of a further element over those of the first.
_TIMES, _SHARE_OF_TRAVEL = 10.0, 0.05
_MORE = {"s": 10.0, "rad": 0.25}
#: Further starting values of angles, over the first, and number of evaluations after which they are compared.
_ANGLE_STARTS = (0.3, 3.0)
_TRIAL = 8
#: Share of a log's travel, to either side of the contact by a fit to all logs, in which a fit to the others looks for it.
_CONTACT = 0.1
#: Share of a log's largest force below which the force is zero: the error of a force sensor's zero.
_NO_FORCE = 0.01
#: Number of samples and of contact angles over which a log's contact is guessed before anything is fitted.
_PLACES, _CONTACTS = 1000, 60
#: Number of places in the travel at which a curve has to rise, and its least slope there over the mean slope.
_SLOPES, _LEAST_SLOPE = 200, 0.02
#: Least lower bound of parameters that are searched as logarithms, in their own units.
_LEAST = 1e-4
#: Residuals of this many samples count as one observation: a second, in which a random angle takes ten targets.
EPISODE = 250

#: (error of the stiffness path, reference force) in N on one log, where there is a reference.
Errors = tuple[np.ndarray, np.ndarray]


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
    """A characteristic curve past its contact."""

    thickness_mm: float
    coefficients: np.ndarray  #: N/rad^(n+1), shape (TERMS,)
    covariance: np.ndarray  #: of the coefficients
    clearances_rad: np.ndarray  #: of each log, from its first angle to contact
    clearance_sigmas_rad: np.ndarray  #: their standard deviations
    travel_rad: float  #: largest travel past contact

    def curve(self) -> Curve:
        return Curve(pad_thickness_mm=self.thickness_mm, coefficients=tuple(float(c) for c in self.coefficients))

    def force(self, x: np.ndarray) -> np.ndarray:
        """Static force in N at ``x`` rad past contact."""
        return powers(x, len(self.coefficients)) @ self.coefficients

    @property
    def rises(self) -> bool:
        """Whether the force rises over the travel as far as it gets there."""
        return bool(rising_force(self.coefficients) >= self.force(np.array([self.travel_rad]))[0])

    def force_sigma(self, x: np.ndarray) -> np.ndarray:
        """Its standard deviation from the covariance of the coefficients."""
        return self._sigma(powers(x, len(self.coefficients)))

    def rise_sigma(self, start_rad: float, end_rad: float) -> float:
        """Standard deviation, N, of what the force rises by between two travels past contact."""
        start, end = powers(np.array([start_rad, end_rad]), len(self.coefficients))
        return float(self._sigma((end - start)[np.newaxis])[0])

    def _sigma(self, basis: np.ndarray) -> np.ndarray:
        return np.sqrt(np.einsum("ti,ij,tj->t", basis, self.covariance, basis))


@dataclass(frozen=True)
class DynamicsFit:
    """Joint fit over pads of several thicknesses."""

    calibration: Calibration  #: with what was found
    delay_s: float  #: by which the reference is late
    sigmas: dict[str, float]  #: of the shared dynamics, by key and for `DELAY`; none where they were held
    curves: list[CurveFit]  #: of the pads that were fitted
    rms: float  #: over all samples fitted, N
    residuals: dict[str, np.ndarray] = field(repr=False)  #: simulated minus reference force, by log path

    def value(self, key: str) -> float:
        """One of `sigmas`' keys."""
        return self.delay_s if key == DELAY else value_of(self.calibration, key)

    def values(self) -> dict[str, float]:
        """What was found, by the calibration's keys."""
        found = [*dynamics(self.calibration)]
        for curve in self.curves:
            found += curve_keys(self.calibration, curve.thickness_mm)
        return {key: value_of(self.calibration, key) for key in found}


def dynamics(calibration: Calibration) -> tuple[str, ...]:
    """Keys of the dynamics that all pads of an actuator share."""
    effects = calibration.effects.items()
    return (RELAXATION, *(f"effects.{effect}.{name}" for effect, parameters in effects for name in parameters))


def curve_keys(calibration: Calibration, thickness_mm: float) -> list[str]:
    """Keys of the coefficients of one thickness's curve."""
    number = [curve.pad_thickness_mm for curve in calibration.stiffness.curves].index(thickness_mm)
    return [f"stiffness.curves[{number}].coefficients[{n}]" for n in range(TERMS)]


def powers(x: np.ndarray, terms: int = TERMS) -> np.ndarray:
    """x, x², x³ ... of the travel past contact, zero before it; shape (n, terms)."""
    return np.maximum(x, 0.0)[:, None] ** np.arange(1, terms + 1)


def simulate(log: Log, calibration: Calibration, thickness_mm: float, clearance: float, delay_s: float = 0.0) -> np.ndarray:
    """Force in N of the stiffness path over a log with pads of a thickness."""
    here = moved(calibration, {"pad_thickness_mm": thickness_mm, CLEARANCE: clearance})
    samples = log.samples.copy()
    _delay(samples, log.samples, delay_s)
    return stiffness_force(samples, to_parameters(here))


def path_errors(log: Log, calibration: Calibration, thickness_mm: float, clearance: float, delay_s: float = 0.0) -> Errors:
    """Errors of the stiffness path on a log. With ``delay_s`` 0 they are the daemon's, which knows nothing of the reference's
    delay."""
    return where_known(simulate(log, calibration, thickness_mm, clearance, delay_s) - log.force_N, log.force_N)


def where_known(error: np.ndarray, force_N: np.ndarray) -> Errors:
    """Errors at samples with a reference force, and that force."""
    known = np.isfinite(force_N)
    return error[known], force_N[known]


def errors_unseen(groups: list[Pads], fit: DynamicsFit, delay_s: float = 0.0, slow: bool = True) -> list[Errors]:
    """Errors of a fit to first halves: on the second halves of random logs and, if ``slow``, on whole slow logs."""
    found = []
    for pads, curve in zip(groups, fit.curves, strict=True):
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            if is_slow(log) and not slow:
                continue
            force = log.force_N.copy()
            force[: 0 if is_slow(log) else len(force) // 2] = np.nan
            found.append(path_errors(replace(log, force_N=force), fit.calibration, pads.thickness_mm, clearance, delay_s))
    return found


def errors_left_out(groups: list[Pads], every: DynamicsFit, fit: Callable[[list[Pads]], DynamicsFit]) -> list[Errors]:
    """Errors on every log, of a ``fit`` to all others where its pads have another one, and else of that to ``every`` log.

    The contact of a log is its own, and found in it; how unsure it is has a standard deviation of its own."""
    found = []
    for g, (pads, curve) in enumerate(zip(groups, every.curves, strict=True)):
        for number, (log, clearance) in enumerate(zip(pads.logs, curve.clearances_rad, strict=True)):
            there = every.calibration
            if rest := pads.logs[:number] + pads.logs[number + 1 :]:
                there = fit([*groups[:g], replace(pads, logs=rest), *groups[g + 1 :]]).calibration
                clearance = _contact(log, there, pads.thickness_mm, clearance)
            found.append(path_errors(log, there, pads.thickness_mm, clearance))
    return found


def _contact(log: Log, calibration: Calibration, thickness_mm: float, near: float) -> float:
    """The clearance ``near`` another that leaves least errors on a log, rad."""
    reach = _CONTACT * float(np.ptp(_travel(log, calibration)))
    return valley(
        lambda clearance: rmse(path_errors(log, calibration, thickness_mm, clearance)[0]),
        near + reach * np.linspace(-1.0, 1.0, 9),
        xatol=1e-3 * reach,
    )


def _delay(into: np.ndarray, samples: np.ndarray, delay_s: float) -> None:
    """Replace the angles of samples by those ``delay_s`` earlier; the first stays, because the clearance counts from it."""
    into["angle"][1:] = (samples["angle"] - delay_s * samples["speed"])[1:]


def is_slow(log: Log) -> bool:
    """Whether the motor passes its travel less than once in four seconds: a slow clamp and not random motion."""
    angle = log.samples["angle"]
    return float(np.sum(np.abs(np.diff(angle)))) < 0.25 * float(np.ptp(angle)) * log.time_s[-1]


def clearance_guess(log: Log, travel: np.ndarray) -> float:
    """The first ``travel`` (rad, at each sample) at which a log's reference force exceeds its noise, and from which it rises:
    the drag of joints and seals before contact is a force, but a constant one."""
    clear = np.flatnonzero(log.force_N > 8.0 * max(_rest_noise(log), 1e-9))
    return max(float(travel[clear[0]]) if len(clear) else 0.0, _rises_from(log.force_N, travel))


def _rises_from(force_N: np.ndarray, travel: np.ndarray) -> float:
    """The ``travel`` from which a force that is constant before it, and rises ever more steeply past it, fits best."""
    known = np.flatnonzero(np.isfinite(force_N))
    known = known[:: max(len(known) // _PLACES, 1)]
    x, force = travel[known], force_N[known]
    half = x[force > 0.5 * np.max(force)]
    places = np.linspace(np.min(x), np.min(half), _CONTACTS) if len(half) else np.zeros(1)

    def left(place: float) -> float:
        table = powers((x - place) / max(np.ptp(x), 1e-9))
        return float(nnls(np.column_stack([np.ones(len(x)), -np.ones(len(x)), table]), force)[1])

    return float(min(places, key=left))


def _rest_noise(log: Log) -> float:
    """Standard deviation in N of the reference force before the motor first moves by a hundredth of its travel."""
    angle = log.samples["angle"]
    left = np.flatnonzero(np.abs(angle - angle[0]) > 0.01 * max(np.ptp(angle), 1e-9))
    return float(np.nanstd(log.force_N[: max(left[0] if len(left) else 0, 5)]))


def _begins_free(log: Log) -> bool:
    """Whether the first samples' reference force is none."""
    first = np.median(log.force_N[np.isfinite(log.force_N)][:5])
    return bool(abs(first) < _NO_FORCE * np.nanmax(log.force_N))


def _travel(log: Log, calibration: Calibration) -> np.ndarray:
    """Equivalent angle (`models.gear`) from the start of a log, rad."""
    return all_through_gear(calibration.motor.gear(), log.samples["angle"] - log.samples["angle"][0])[0]


def _past_contact(log: Log, calibration: Calibration) -> np.ndarray:
    """`_travel` beyond `clearance_guess`."""
    travel = _travel(log, calibration)
    return travel - clearance_guess(log, travel)


def regress_free(log: Log, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Thesis 3-5: F(i) = a3 x^3 + a2 x^2 + a1 x + a0 F(i-1) by least squares, ``x`` rad past contact at each sample. Returns
    (coefficients of the static curve, time constant in s)."""
    force = log.force_N
    rows = np.flatnonzero(np.isfinite(force[1:]) & np.isfinite(force[:-1]) & (x[1:] > 0.0)) + 1
    span = max(float(x.max()), 1e-9) ** np.arange(1, TERMS + 1)
    top = np.max(force[rows])
    solution = np.linalg.lstsq(np.column_stack([powers(x[rows]) / span, force[rows - 1] / top]), force[rows], rcond=None)[0]
    decay = float(np.clip(solution[-1] / top, 0.01, 0.999))
    cycle = float(np.median(log.samples["dt"][1:]))
    return solution[:-1] / span / (1.0 - decay), -cycle / np.log(decay)


def starting_point(groups: list[Pads], calibration: Calibration, effects: tuple[Effect, ...] = _USUAL) -> Calibration:
    """Where a search for curves and dynamics starts: thesis 3-5 for curves and time constant, the rest by proportion."""
    logs = [log for pads in groups for log in pads.logs]
    # Slow logs hardly show the lag; they are used only if there are no others.
    fast = [log for log in logs if not is_slow(log)] or logs
    time = float(np.clip(np.median([regress_free(log, _past_contact(log, calibration))[1] for log in fast]), 2e-3, 0.5))
    usual = {"s": _TIMES * time, "rad": _SHARE_OF_TRAVEL * max(_span(log, calibration) for log in logs)}
    values = {RELAXATION: time}
    for effect in effects:
        for p in effect.parameters:
            more = _MORE.get(p.unit, 1.0) if effect.beside else 1.0
            start = more * usual.get(p.unit, p.prior) if p.starts else p.prior
            values[f"effects.{effect.name}.{p.name}"] = float(np.clip(start, p.low, p.high))
    for pads in groups:
        log = pads.logs[-1]
        x = _past_contact(log, calibration)
        if is_slow(log):
            # Its force hardly changes from sample to sample, so that a regression over the sample before fits noise.
            known, span = np.isfinite(log.force_N), float(x.max()) ** np.arange(1, TERMS + 1)
            coefficients = nnls(powers(x[known]) / span, log.force_N[known])[0] / span
        elif (coefficients := regress_free(log, x)[0])[0] <= 0.0:
            coefficients = np.nanmax(log.force_N) / TERMS / _scale(pads, calibration)
        values |= dict(zip(curve_keys(calibration, pads.thickness_mm), coefficients, strict=True))
    return moved(structs.replace(calibration, effects={}), values)


def _span(log: Log, calibration: Calibration) -> float:
    """Travel past contact, rad."""
    return float(_past_contact(log, calibration).max())


def _scale(pads: Pads, calibration: Calibration) -> np.ndarray:
    """Factors from a curve's coefficients to newtons at full travel."""
    return max(_span(log, calibration) for log in pads.logs) ** np.arange(1, TERMS + 1)


def _free(calibration: Calibration, key: str) -> Free:
    """Positive parameters are searched as logarithms; otherwise a slip angle can become negative and stay so."""
    known = parameter(calibration, key)
    return Free(known.value, 5e-5, max(known.low, _LEAST), known.high, logarithmic=True)


class _Model:
    """What is fitted: the calibration's keys, `DELAY`, and for each log its clearance under (group, log's number)."""

    def __init__(self, groups: list[Pads], start: Calibration, delay_s: float, fraction: float, shared: tuple[str, ...]):
        self.groups, self.start, self.delay_s, self.fraction, self.shared = groups, start, delay_s, fraction, shared
        self.curves = [curve_keys(start, pads.thickness_mm) for pads in groups]
        self.free = self._free()

    def _free(self) -> dict:
        free = {key: _free(self.start, key) for key in self.shared if key != DELAY}
        if DELAY in self.shared:
            free[DELAY] = Free(self.delay_s, 1e-7, -0.01, 0.01)
        for pads, own in zip(self.groups, self.curves, strict=True):
            values, scale = [value_of(self.start, key) for key in own], _scale(pads, self.start)
            full = float(np.abs(values) @ scale)
            # The force rises from contact, so that the first coefficient is positive.
            for n, key in enumerate(own):
                free[key] = Free(values[n], 2e-5 * full / scale[n], -np.inf if n else 1e-3 * full / scale[0])
        for g, pads in enumerate(self.groups):
            span = max(_span(log, self.start) for log in pads.logs)
            for number, log in enumerate(pads.logs):
                # The force exceeds its noise only somewhat past contact; a log that begins without one begins before contact.
                guess = clearance_guess(log, _travel(log, self.start)) - 0.02 * span
                free[g, number] = Free(guess, 5e-6 * span, 0.0 if _begins_free(log) else -np.inf)
        return free

    def blocks(self) -> list[Block]:
        return [self._block(g, number, log) for g, pads in enumerate(self.groups) for number, log in enumerate(pads.logs)]

    def rising(self) -> list[Block]:
        """Residuals that keep each curve rising over its travel: what its slope lacks of the least one, as force over all the
        travel, N."""
        blocks = []
        for pads, own in zip(self.groups, self.curves, strict=True):
            span = max(float(_travel(log, self.start).max()) for log in pads.logs)
            places = span * np.linspace(0.0, 1.0, _SLOPES)[:, None]
            weight = np.sqrt(sum(len(log.samples) for log in pads.logs))
            cost = weight * span * np.arange(1, TERMS + 1) * places ** np.arange(TERMS)
            least = weight * _LEAST_SLOPE * max(float(np.nanmax(log.force_N)) for log in pads.logs)

            def residual(values, own=own, cost=cost, least=least):
                return np.minimum(cost @ [values[key] for key in own] - least, 0.0)

            blocks.append(Block(residual, tuple(own), np.zeros(_SLOPES, int)))
        return blocks

    def _block(self, g: int, number: int, log: Log) -> Block:
        rows = len(log.samples) if self.fraction == 1.0 or is_slow(log) else int(self.fraction * len(log.samples))
        samples, force = log.samples[:rows], log.force_N[:rows]
        known, own = np.isfinite(force), samples.copy()
        start = moved(self.start, {"pad_thickness_mm": self.groups[g].thickness_mm})
        keys = (*self.shared, *self.curves[g])

        def residual(values):
            trial = {key: values[key] for key in keys} | {CLEARANCE: values[g, number]}
            _delay(own, samples, trial.pop(DELAY, self.delay_s))
            return (stiffness_force(own, to_parameters(moved(start, trial))) - force)[known]

        return Block(residual, (*keys, (g, number)), np.arange(np.count_nonzero(known)) // EPISODE)

    def result(self, found: Fit) -> DynamicsFit:
        curves = []
        for g, (pads, own) in enumerate(zip(self.groups, self.curves, strict=True)):
            contacts = [(g, number) for number in range(len(pads.logs))]
            clearances = np.array([found.values[key] for key in contacts])
            covariance = found.block([*own, *contacts])
            if found.values[own[0]] < 1.01 * self.free[own[0]].low and 0.0 < covariance[0, 0] < np.inf:
                # The bound holds the first slope, so that an error of the contact no longer makes up for one of the slope.
                covariance -= np.outer(covariance[0], covariance[0]) / covariance[0, 0]
            curves.append(
                CurveFit(
                    pads.thickness_mm,
                    np.array([found.values[key] for key in own]),
                    covariance[:TERMS, :TERMS],
                    clearances,
                    np.sqrt(np.maximum(np.diag(covariance)[TERMS:], 0.0)),
                    float(max(_travel(log, self.start).max() - c for log, c in zip(pads.logs, clearances, strict=True))),
                )
            )
        logs = [log for pads in self.groups for log in pads.logs]
        return DynamicsFit(
            calibration=moved(
                self.start, {key: value for key, value in found.values.items() if isinstance(key, str) and key != DELAY}
            ),
            delay_s=found.values.get(DELAY, self.delay_s),
            sigmas={key: found.sigmas[key] for key in self.shared},
            curves=curves,
            rms=rmse(np.concatenate(found.residuals[: len(logs)])),
            residuals={str(log.path): r for log, r in zip(logs, found.residuals[: len(logs)], strict=True)},
        )


def fit_dynamics(
    groups: list[Pads],
    start: Calibration,
    delay_s: float = 0.0,
    *,
    fraction: float = 1.0,
    search: bool = False,
    shared: tuple[str, ...] | None = None,
) -> DynamicsFit:
    """One set of dynamics, a curve for each pair of pads, a contact angle for each log. ``start``: dynamics, with the effects
    that take part, and curves to start from, as ``delay_s`` of the reference.

    ``fraction``: share that is fitted of each log that is not slow, from its beginning; ``search``: try several starting
    points for angles that shape an effect; ``shared``: which of the dynamics are fitted beside curves and contact angles; all
    of them and the reference's delay if left out."""
    model = _Model(groups, start, delay_s, fraction, (*dynamics(start), DELAY) if shared is None else shared)
    blocks, first = model.blocks(), model.free
    angles = [key for key in model.shared if key.startswith("effects.") and key.endswith("_rad")]
    if search and angles:
        # A loop's width and its turning length compensate each other: another turning length may lead to another minimum.
        starts = [first]
        for factor in _ANGLE_STARTS:
            starts.append(first | {key: replace(first[key], start=factor * first[key].start) for key in angles})
        tried = [fit(blocks, free, tolerance=1e-5, evaluations=_TRIAL) for free in starts]
        best = min(tried, key=lambda found: found.rms).values
        first = {key: replace(free, start=best[key]) for key, free in first.items()}
    found = model.result(fit(blocks, first, tolerance=1e-6))
    if all(curve.rises for curve in found.curves):
        return found
    return model.result(fit([*blocks, *model.rising()], model.free, tolerance=1e-6))
