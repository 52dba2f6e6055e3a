"""How pads soften with heat and its history, from bursts of clamps while they cool (thesis 8.4)."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.calibration.types import Softening
from emb_daemon.errors import InputError
from emb_daemon.estimator.heat import TURNING_RAD_PER_S
from emb_daemon.identify.heat import Recording, simulate
from emb_daemon.identify.stiffness import simulate as stiffness_force
from emb_daemon.offline import Log

#: A burst is full-rate motor frames for at least this long, over at least this range of force.
_SLOWEST_SAMPLE_S = 0.02
_LEAST_BURST_S = 2.0
_LEAST_RANGE_N = 1000.0
_LEAST_BURSTS = 6
_LEAST_RISE_K = 30.0
#: The history term must lower the residual on bursts left out by this much.
_WORTH_IT = 0.95
_TERMS = 3


@dataclass(frozen=True)
class SofteningFit:
    """Softening, per burst where shapes are (bursts,).

    Attributes:
        softening: for the calibration; fitted on every other burst from the first.
        sigmas: ``per_K``, ``history_per_K``, ``history_time_s``, bursts left out in turn, and the residual's own part.
        factor, factor_sigma: measured stiffness factor, from the full static form.
        exponential, window: factors modelled with the first-order history and with the thesis's moving window.
        shift_rad: contact shift, were it free.
        rmse_N: of the force through each burst.
        ours_N, thesis_N: RMSE of force over the bursts that fitted nothing: our form, and the thesis's static curve with
            its moving window.
        uncorrected_N: ours with cold stiffness throughout.
        widths_s, width_residuals: rms of the factor for each window width searched.
        width_s: the best one.
    """

    softening: Softening
    sigmas: dict[str, float]
    time_s: np.ndarray
    rise_K: np.ndarray
    factor: np.ndarray
    factor_sigma: np.ndarray
    exponential: np.ndarray
    window: np.ndarray
    shift_rad: np.ndarray
    fitted: np.ndarray
    rmse_N: np.ndarray
    ours_N: float
    thesis_N: float
    uncorrected_N: float
    widths_s: np.ndarray
    width_residuals: np.ndarray
    width_s: float


def first_order_history(rise: np.ndarray, step_s: float, time_constant_s: float) -> np.ndarray:
    """``rise`` through a first-order lag that starts settled, exact for steps."""
    from scipy.signal import lfilter

    keep = np.exp(-step_s / time_constant_s)
    delayed = np.concatenate([rise[:1], rise[:-1]])
    return lfilter([1.0 - keep], [1.0, -keep], delayed, zi=[keep * rise[0]])[0]


def moving_window(rise: np.ndarray, step_s: float, width_s: float) -> np.ndarray:
    """Thesis zeta: integral of ``rise`` over the last ``width_s``, K s."""
    total = np.concatenate([[0.0], np.cumsum(rise) * step_s])
    row = np.arange(1, len(rise) + 1)
    return total[row] - total[np.maximum(row - max(round(width_s / step_s), 1), 0)]


def find_bursts(log: Log) -> list[slice]:
    """Stretches of full-rate clamping at standstill with a reference force."""
    samples = log.samples
    fast = samples["dt"] <= _SLOWEST_SAMPLE_S
    edges = np.flatnonzero(np.diff(np.concatenate([[False], fast, [False]]).astype(np.int8)))
    found = []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        rows = slice(max(start - 1, 0), end)
        force = log.force_N[rows]
        long = log.time_s[rows.stop - 1] - log.time_s[rows.start] >= _LEAST_BURST_S
        turning = np.nanmedian(samples["wheel_speed"][rows]) > TURNING_RAD_PER_S
        if long and not turning and np.isfinite(force).any() and np.nanmax(force) - np.nanmin(force) >= _LEAST_RANGE_N:
            found.append(rows)
    return found


def _cold_curve(samples, reference, parameters):
    """(contact angle, coefficients) that suit the cold burst with the dynamics given: the force is linear in coefficients."""
    from scipy.optimize import minimize_scalar

    unit = parameters.copy()
    known = np.isfinite(reference)
    expected = samples["angle"][0] + float(parameters["clearance"][0])
    travel = max(float(samples["angle"].max()) - expected, 1e-3)
    scale = travel ** np.arange(1, _TERMS + 1)

    def solve(contact):
        columns = []
        for term in range(_TERMS):
            unit["curve"] = 0.0
            unit["curve"][0, term] = 1.0 / scale[term]
            columns.append(stiffness_force(samples, contact, unit)[known])
        design = np.array(columns).T
        coefficients = np.linalg.lstsq(design, reference[known], rcond=None)[0]
        return coefficients / scale, float(np.mean((design @ coefficients - reference[known]) ** 2))

    reach = 0.2 * travel
    contact = minimize_scalar(lambda c: solve(c)[1], bounds=(expected - reach, expected + reach), method="bounded").x
    return float(contact), solve(contact)[0]


def _regress(columns, loss):
    return np.linalg.lstsq(np.array(columns).T, loss, rcond=None)[0]


def _best(search, residual):
    """Where ``residual`` is least: over the values to search, then between the neighbours of the best."""
    from scipy.optimize import minimize_scalar

    found = np.array([residual(value) for value in search])
    best = int(np.argmin(found))
    low, high = search[max(best - 1, 0)], search[min(best + 1, len(search) - 1)]
    return float(minimize_scalar(residual, bounds=(low, high), method="bounded").x), found


def fit_softening(log: Log, heat: Recording, thermal: np.ndarray, stiffness: np.ndarray) -> SofteningFit:
    """Softening from a log with bursts of clamps on pads that heat up and cool down.

    The curve's scale is taken from the first, cold burst; then each burst has a stiffness factor, and these are explained by
    the mean pad temperature of the heat model and its history. Bursts 0, 2, 4, ... fit, the others judge.

    Args:
        heat: the same log.
        thermal: THERMAL, shape (1,), pads and disc already identified.
        stiffness: PARAMETERS, shape (1,): relaxation, effects and clearance; the curve is refined on the cold burst.

    Raises:
        InputError: too few bursts, or no heat between them.
    """
    bursts = find_bursts(log)
    if len(bursts) < _LEAST_BURSTS:
        raise InputError(f"{log.path}: {len(bursts)} bursts of clamps; at least {_LEAST_BURSTS} are needed for softening")
    mean_C = simulate(thermal, heat)[:, 11:13].mean(axis=1)
    middle = np.array([log.time_s[rows].mean() for rows in bursts])
    reference_C = float(np.interp(middle[0], heat.time_s, mean_C))
    rise = mean_C - reference_C
    at_burst = np.interp(middle, heat.time_s, rise)
    spread = float(np.ptp(at_burst))
    if spread < _LEAST_RISE_K:
        raise InputError(f"{log.path}: pads differ by {spread:.0f} K between bursts; softening needs {_LEAST_RISE_K:.0f} K")

    p = stiffness.copy()
    first = bursts[0]
    contact, coefficients = _cold_curve(log.samples[first], log.force_N[first], p)
    p["curve"] = 0.0
    p["curve"][0, :_TERMS] = coefficients
    line = _static_line(log, first, contact)

    cold = [stiffness_force(log.samples[rows], contact, p) for rows in bursts]
    static = [_line_force(log.samples["angle"][rows] - contact, line) for rows in bursts]
    known = [np.isfinite(log.force_N[rows]) for rows in bursts]
    factor, factor_sigma, shift, thesis_factor = np.empty((4, len(bursts)))
    for index, rows in enumerate(bursts):
        force, k = log.force_N[rows], known[index]
        moved = (stiffness_force(log.samples[rows], contact + 0.01, p) - cold[index]) / 0.01
        factor[index] = cold[index][k] @ force[k] / (cold[index][k] @ cold[index][k])
        error = force[k] - factor[index] * cold[index][k]
        # Residuals within a tenth of a second count once.
        factor_sigma[index] = np.sqrt(25.0 * error.var() / (cold[index][k] @ cold[index][k]))
        shift[index] = np.linalg.lstsq(np.array([cold[index][k], moved[k]]).T, force[k], rcond=None)[0][1] / factor[index]
        thesis_factor[index] = static[index][k] @ force[k] / (static[index][k] @ static[index][k])

    fitted = np.arange(len(bursts)) % 2 == 0
    grid = heat.time_s

    def history(time_constant):
        return np.interp(middle, grid, first_order_history(rise, heat.step_s, time_constant))

    def window(width):
        return np.interp(middle, grid, moving_window(rise, heat.step_s, width))

    def residual_of(term, losses, rows):
        def residual(value):
            columns = [at_burst[rows], term(value)[rows]]
            return float(np.sqrt(np.mean((_regress(columns, losses[rows]) @ np.array(columns) - losses[rows]) ** 2)))

        return residual

    span = float(grid[-1])
    search = np.geomspace(0.01 * span, 2.0 * span, 40)
    loss = 1.0 - factor

    def exponential_fit(rows):
        time_constant, _ = _best(search, residual_of(history, loss, rows))
        return np.array([*_regress([at_burst[rows], history(time_constant)[rows]], loss[rows]), time_constant])

    own = np.flatnonzero(fitted)
    found = exponential_fit(own)
    left = np.array([exponential_fit(np.delete(own, index)) for index in range(len(own))])
    predicted = np.array([at_burst[b] * x[0] + history(x[2])[b] * x[1] for b, x in zip(own, left, strict=True)])
    alone = np.array(
        [at_burst[b] * _regress([at_burst[np.delete(own, i)]], loss[np.delete(own, i)])[0] for i, b in enumerate(own)]
    )
    keeps = np.mean((predicted - loss[own]) ** 2) < _WORTH_IT**2 * np.mean((alone - loss[own]) ** 2)
    if not keeps:
        found = np.array([_regress([at_burst[own]], loss[own])[0], 0.0, found[2]])
    count = len(own)
    variance = (count - 1) / count * np.sum((left - left.mean(axis=0)) ** 2, axis=0)

    # So few bursts leave the jackknife itself unsure: the residual's own share comes on top.
    def losses(x):
        return x[0] * at_burst[own] + x[1] * history(x[2])[own]

    steps = 1e-3 * np.maximum(np.abs(found), [1e-4, 1e-4, 1.0])
    slopes = np.array([(losses(found + step) - losses(found - step)) for step in np.diag(steps)]).T / (2.0 * steps)
    noise = np.sum((losses(found) - loss[own]) ** 2) / max(count - 3, 1)
    unit = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    inverse = np.linalg.pinv((slopes / unit).T @ (slopes / unit), rcond=1e-10)
    sigmas = np.sqrt(variance + noise * np.diag(inverse) / unit**2)

    widths = np.geomspace(max(0.005 * span, 2.0 * heat.step_s), span, 60)
    thesis_loss = 1.0 - thesis_factor
    width, width_residuals = _best(widths, residual_of(window, thesis_loss, own))
    thesis_terms = _regress([at_burst[own], window(width)[own]], thesis_loss[own])

    exponential_grid = 1.0 - found[0] * rise - found[1] * first_order_history(rise, heat.step_s, found[2])
    window_grid = 1.0 - thesis_terms[0] * rise - thesis_terms[1] * moving_window(rise, heat.step_s, width)
    rmse, ours, thesis, uncorrected = np.empty(len(bursts)), [], [], []
    for index, rows in enumerate(bursts):
        factors = np.interp(log.time_s[rows], grid, exponential_grid)
        error = (stiffness_force(log.samples[rows], contact, p, factors) - log.force_N[rows])[known[index]]
        rmse[index] = np.sqrt(np.mean(error**2))
        if not fitted[index]:
            ours.append(error)
            simple = static[index] * np.interp(log.time_s[rows], grid, window_grid) - log.force_N[rows]
            thesis.append(simple[known[index]])
            uncorrected.append((cold[index] - log.force_N[rows])[known[index]])
    return SofteningFit(
        softening=Softening(
            reference_C=round(reference_C, 2),
            per_K=float(found[0]),
            history_per_K=float(found[1]),
            history_time_s=float(found[2]),
        ),
        sigmas=dict(zip(("per_K", "history_per_K", "history_time_s"), map(float, sigmas), strict=True)),
        time_s=middle,
        rise_K=at_burst,
        factor=factor,
        factor_sigma=factor_sigma,
        exponential=np.interp(middle, grid, exponential_grid),
        window=np.interp(middle, grid, window_grid),
        shift_rad=shift,
        fitted=fitted.astype(float),
        rmse_N=rmse,
        ours_N=_rms(ours),
        thesis_N=_rms(thesis),
        uncorrected_N=_rms(uncorrected),
        widths_s=widths,
        width_residuals=width_residuals,
        width_s=width,
    )


def _rms(errors: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def _static_line(log: Log, rows: slice, contact: float) -> np.ndarray:
    """Thesis 2.1: cubic line of best fit through the cold burst's loop."""
    x = np.maximum(log.samples["angle"][rows] - contact, 0.0)
    known = np.isfinite(log.force_N[rows])
    scale = max(float(x.max()), 1e-9) ** np.arange(1, _TERMS + 1)
    powers = np.stack([x**n for n in range(1, _TERMS + 1)], axis=1) / scale
    return np.linalg.lstsq(powers[known], log.force_N[rows][known], rcond=None)[0] / scale


def _line_force(x: np.ndarray, line: np.ndarray) -> np.ndarray:
    x = np.maximum(x, 0.0)
    return sum(coefficient * x ** (order + 1) for order, coefficient in enumerate(line))
