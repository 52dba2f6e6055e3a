"""How pads soften with heat and its history, from bursts of clamps while they cool (thesis 8.4)."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.identify.dynamics import TERMS
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.offline import Log
from emb_daemon.offline.fit import left_out_covariance, valley
from emb_daemon.offline.recording import Recording, simulate
from emb_daemon.offline.run import stiffness_force
from emb_daemon.offline.score import rmse
from emb_daemon.offline.stretches import stretches_of
from emb_daemon.report.figures import MODEL, Panel, Style, Trace, xy_figure
from emb_daemon.report.page import Section

#: A burst is full-rate motor frames for at least this long, over at least this range of force.
_SLOWEST_SAMPLE_S = 0.02
_LEAST_BURST_S = 2.0
_LEAST_RANGE_N = 1000.0
#: Bursts of a log from which its softening is known, and kelvins that the pads must differ by between them.
_LEAST_BURSTS, _LEAST_RISE_K = 6, 30.0
#: Relative amount by which the history term must lower the residual on bursts left out.
_WORTH_IT = 0.95
#: Step of the derivative by the contact angle, rad.
_STEP_RAD = 0.01
#: Number of samples that count as one: residuals within a tenth of a second are correlated.
_TOGETHER = 25.0
#: Where the calibration keeps the law and the temperature that it counts from.
_LAW = tuple(f"thermal.softening.{name}" for name in ("per_K", "history_per_K", "history_time_s"))
PER_K, _HISTORY, _REFERENCE = _LAW[0], _LAW[1], "thermal.softening.reference_C"
_POINTS = Style("#1d2430", mode="markers")


@dataclass(frozen=True)
class SofteningFit:
    """Softening, per burst where shapes are (bursts,)."""

    values: dict[str, float]  #: by the calibration's keys; fitted to every other burst from the first
    sigmas: dict[str, float]  #: likewise: from bursts left out in turn, and from the residual
    time_s: np.ndarray
    rise_K: np.ndarray
    #: ``factor`` and ``factor_sigma``: measured stiffness factor.
    factor: np.ndarray
    factor_sigma: np.ndarray
    modelled: np.ndarray  #: factor by the first-order history
    shift_rad: np.ndarray  #: contact shift, if that is fitted too
    ours_N: float  #: RMSE of force over the bursts that were not fitted
    uncorrected_N: float  #: the same with cold stiffness throughout

    def figures(self) -> dict[str, float]:
        """RMSE of force on bursts that were not fitted."""
        name = "pad_cooling: force, bursts left out"
        return {f"{name}, kN": 1e-3 * self.ours_N, f"{name}, cold stiffness, kN": 1e-3 * self.uncorrected_N}

    def note(self) -> str:
        kept = "first-order history" if self.values[_HISTORY] else "no history: it does not help on bursts left out"
        return (
            f"softening: {kept}; fitted on bursts 1, 3, 5, ..., judged on the others; contact, if left free, would shift by "
            f"at most {1e3 * np.abs(self.shift_rad).max():.0f} mrad"
        )


@dataclass(frozen=True)
class Bursts:
    """Bursts of clamps, and the stiffness path of cold pads over them."""

    log: Log
    rows: list[slice]  #: of the log, one slice per burst
    contact: float
    #: PARAMETERS of each burst, shape (1,): one curve, refined on the cold burst, and one contact angle.
    parameters: list[np.ndarray]
    #: ``time_s`` and ``rise_K``: middle of each, and rise of the pads' mean temperature over the first burst's, shape
    #: (bursts,).
    time_s: np.ndarray
    rise_K: np.ndarray
    reference_C: float  #: mean temperature of the pads at the first burst
    #: ``grid_s`` and ``grid_rise_K``: the rise over the whole log.
    grid_s: np.ndarray
    grid_rise_K: np.ndarray

    def force_N(self, index: int) -> np.ndarray:
        return self.log.force_N[self.rows[index]]

    def error(self, index: int, factor: np.ndarray) -> np.ndarray:
        """Of the stiffness path with a factor, N, where there is a reference."""
        error = stiffness_force(self.log.samples[self.rows[index]], self.parameters[index], factor) - self.force_N(index)
        return error[np.isfinite(error)]


def first_order_history(rise: np.ndarray, step_s: float, time_constant_s: float) -> np.ndarray:
    """``rise`` through a first-order lag that starts settled, exact for steps."""
    keep = np.exp(-step_s / time_constant_s)
    delayed = np.concatenate([rise[:1], rise[:-1]])
    return lfilter([1.0 - keep], [1.0, -keep], delayed, zi=[keep * rise[0]])[0]


def find_bursts(log: Log) -> list[slice]:
    """Stretches of full-rate clamping at standstill with a reference force."""
    samples = log.samples
    fast = samples["dt"] <= _SLOWEST_SAMPLE_S
    found = []
    for start, end in stretches_of(fast):
        rows = slice(max(start - 1, 0), end)
        force = log.force_N[rows]
        long = log.time_s[rows.stop - 1] - log.time_s[rows.start] >= _LEAST_BURST_S
        turning = np.nanmedian(samples["wheel_speed"][rows]) > TURNING_RAD_PER_S
        if long and not turning and np.isfinite(force).any() and np.nanmax(force) - np.nanmin(force) >= _LEAST_RANGE_N:
            found.append(rows)
    return found


def _cold_curve(samples: np.ndarray, reference: np.ndarray, parameters: np.ndarray) -> tuple[float, np.ndarray]:
    """(clearance, coefficients) fitted to the cold burst with given dynamics; the force is linear in the coefficients."""
    unit = parameters.copy()
    known = np.isfinite(reference)
    expected = float(parameters["clearance"][0])
    travel = max(float(samples["angle"].max() - samples["angle"][0]) - expected, 1e-3)
    scale = travel ** np.arange(1, TERMS + 1)

    def solve(clearance):
        unit["clearance"] = clearance
        columns = []
        for term in range(TERMS):
            unit["curve"] = 0.0
            unit["curve"][0, term] = 1.0 / scale[term]
            columns.append(stiffness_force(samples, unit)[known])
        design = np.array(columns).T
        coefficients = np.linalg.lstsq(design, reference[known], rcond=None)[0]
        return coefficients / scale, float(np.mean((design @ coefficients - reference[known]) ** 2))

    reach = 0.2 * travel
    clearance = minimize_scalar(lambda c: solve(c)[1], bounds=(expected - reach, expected + reach), method="bounded").x
    return float(clearance), solve(clearance)[0]


def cold_bursts(log: Log, heat: Recording, calibration: Calibration) -> Bursts:
    """Bursts of a log, the curve refined on the first; arguments and errors as in `fit_softening`."""
    stiffness = np.atleast_1d(to_parameters(calibration))
    rows = find_bursts(log)
    if len(rows) < _LEAST_BURSTS:
        raise InputError(f"{log.path}: {len(rows)} bursts of clamps; at least {_LEAST_BURSTS} are needed for softening")
    mean_C = simulate(stiffness, heat)[:, 11:13].mean(axis=1)
    middle = np.array([log.time_s[part].mean() for part in rows])
    reference_C = float(np.interp(middle[0], heat.time_s, mean_C))
    rise = mean_C - reference_C
    at_burst = np.interp(middle, heat.time_s, rise)
    if (spread := float(np.ptp(at_burst))) < _LEAST_RISE_K:
        raise InputError(f"{log.path}: pads differ by {spread:.0f} K between bursts; softening needs {_LEAST_RISE_K:.0f} K")
    clearance, coefficients = _cold_curve(log.samples[rows[0]], log.force_N[rows[0]], stiffness)
    contact = float(log.samples["angle"][rows[0].start]) + clearance
    parameters = []
    for part in rows:
        own = stiffness.copy()
        own["curve"] = 0.0
        own["curve"][0, :TERMS] = coefficients
        own["clearance"] = contact - log.samples["angle"][part.start]
        parameters.append(own)
    return Bursts(log, rows, contact, parameters, middle, at_burst, reference_C, heat.time_s, rise)


def _factors(bursts: Bursts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(stiffness factor, its standard deviation, contact shift in rad if that is fitted as well) of each burst."""
    factor, sigma, shift = np.empty((3, len(bursts.rows)))
    for index, rows in enumerate(bursts.rows):
        samples, force = bursts.log.samples[rows], bursts.force_N(index)
        nearer = bursts.parameters[index].copy()
        nearer["clearance"] += _STEP_RAD
        known = np.isfinite(force)
        cold, moved = (stiffness_force(samples, p)[known] for p in (bursts.parameters[index], nearer))
        force = force[known]
        factor[index] = cold @ force / (cold @ cold)
        sigma[index] = np.sqrt(_TOGETHER * (force - factor[index] * cold).var() / (cold @ cold))
        both = np.linalg.lstsq(np.array([cold, (moved - cold) / _STEP_RAD]).T, force, rcond=None)[0]
        shift[index] = both[1] / factor[index]
    return factor, sigma, shift


class _Law:
    """Loss of stiffness = a rise + b history(rise, time constant), fitted to some of the bursts."""

    def __init__(self, bursts: Bursts, loss: np.ndarray):
        self.bursts, self.loss = bursts, loss
        self.step_s = float(bursts.grid_s[1] - bursts.grid_s[0])
        self.search = np.geomspace(0.01, 2.0, 40) * float(bursts.grid_s[-1])

    def history(self, time_constant_s: float) -> np.ndarray:
        b = self.bursts
        return np.interp(b.time_s, b.grid_s, first_order_history(b.grid_rise_K, self.step_s, time_constant_s))

    def losses(self, x: np.ndarray) -> np.ndarray:
        """At each burst, of x = (a in 1/K, b in 1/K, time constant in s)."""
        return x[0] * self.bursts.rise_K + x[1] * self.history(x[2])

    def without_history(self, rows: np.ndarray) -> np.ndarray:
        rise = self.bursts.rise_K[rows]
        return np.array([rise @ self.loss[rows] / (rise @ rise), 0.0, self.search[-1]])

    def fit(self, rows: np.ndarray) -> np.ndarray:
        """Over the time constants to search, then between the neighbours of the best."""

        def solve(time_constant):
            columns = np.array([self.bursts.rise_K[rows], self.history(time_constant)[rows]]).T
            terms = np.linalg.lstsq(columns, self.loss[rows], rcond=None)[0]
            return terms, rmse(columns @ terms - self.loss[rows])

        time_constant = valley(lambda value: solve(value)[1], self.search)
        return np.array([*solve(time_constant)[0], time_constant])

    def sigmas(self, x: np.ndarray, rows: np.ndarray, left_out: np.ndarray) -> np.ndarray:
        """From fits without one burst each, ``left_out`` (bursts, 3), of which there are few, and from the residual."""
        variance = np.diag(left_out_covariance(left_out))
        steps = 1e-3 * np.maximum(np.abs(x), [1e-4, 1e-4, 1.0])
        slopes = np.array([(self.losses(x + step) - self.losses(x - step))[rows] for step in np.diag(steps)]).T / (2.0 * steps)
        noise = np.sum((self.losses(x) - self.loss)[rows] ** 2) / max(len(rows) - 3, 1)
        unit = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
        inverse = np.linalg.pinv((slopes / unit).T @ (slopes / unit), rcond=1e-10)
        return np.sqrt(variance + noise * np.diag(inverse) / unit**2)


def fit_softening(log: Log, heat: Recording, calibration: Calibration) -> SofteningFit:
    """Softening from a log with bursts of clamps on pads that heat up and cool down; ``heat`` is of the same log. Raises
    InputError: too few bursts, or no heat between them.

    The curve's scale is taken from the first, cold burst; then each burst has a stiffness factor, and these are explained by
    the mean pad temperature of the heat model and its history. Bursts 0, 2, 4, ... are fitted, the others validate. The
    calibration has pads and disc already identified, relaxation, effects and clearance; the curve is refined on the cold
    burst."""
    bursts = cold_bursts(log, heat, calibration)
    factor, factor_sigma, shift = _factors(bursts)
    law = _Law(bursts, 1.0 - factor)
    own, others = np.arange(0, len(factor), 2), np.arange(1, len(factor), 2)
    found = law.fit(own)
    rests = [np.delete(own, index) for index in range(len(own))]
    left_out = np.array([law.fit(rest) for rest in rests])
    both = [law.losses(x)[row] for row, x in zip(own, left_out, strict=True)]
    alone = [law.losses(law.without_history(rest))[row] for row, rest in zip(own, rests, strict=True)]
    if rmse(both - law.loss[own]) >= _WORTH_IT * rmse(alone - law.loss[own]):
        found = np.array([*law.without_history(own)[:2], found[2]])
    history = first_order_history(bursts.grid_rise_K, law.step_s, found[2])
    modelled = 1.0 - found[0] * bursts.grid_rise_K - found[1] * history
    errors = [bursts.error(i, np.interp(log.time_s[bursts.rows[i]], bursts.grid_s, modelled)) for i in others]
    return SofteningFit(
        values=dict(zip(_LAW, found.tolist(), strict=True)) | {_REFERENCE: round(bursts.reference_C, 2)},
        sigmas=dict(zip(_LAW, law.sigmas(found, own, left_out).tolist(), strict=True)),
        time_s=bursts.time_s,
        rise_K=bursts.rise_K,
        factor=factor,
        factor_sigma=factor_sigma,
        modelled=np.interp(bursts.time_s, bursts.grid_s, modelled),
        shift_rad=shift,
        ours_N=rmse(np.concatenate(errors)),
        uncorrected_N=rmse(np.concatenate([bursts.error(i, np.ones(1)) for i in others])),
    )


def figure(section: Section, found: SofteningFit) -> None:
    section.heading("Stiffness over temperature and its history")
    hours = found.time_s / 3600.0
    factors = [
        Trace("each burst", hours, found.factor, _POINTS, found.factor_sigma),
        Trace("first-order history", hours, found.modelled, MODEL),
    ]
    residual = [Trace("first-order history", hours, 100.0 * (found.modelled - found.factor), MODEL)]
    panels = [Panel("Stiffness over that of the cold pads", "1", factors, 280), Panel("Residual", "%", residual, 170)]
    section.figure(xy_figure(panels, "time / h"), "Bursts 1, 3, 5, ... fitted; the others judge.")
