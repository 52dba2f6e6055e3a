"""Size and correlation time of a clamp force's error, as the filter needs them."""

from collections.abc import Iterable

import numpy as np

from emb_daemon.estimator.unknown import GAIN_SIGMA
from emb_daemon.wire.contract import CYCLE_S

#: Largest lag of an autocorrelation, in cycles: ten seconds; correlation below which it counts as zero.
_LAGS, _GONE = 2500, 0.05
#: Least load for a relative error, as a share of the largest; cycles of a manoeuvre; least number of manoeuvres, and least
#: mean in its standard errors, from which a lasting error is accepted.
_LOADED, _MANOEUVRE, _MANOEUVRES, _SURE = 0.1, 250, 8, 3.0


def autocorrelation(series: list[np.ndarray], lags: int) -> np.ndarray:
    """Covariance at lags 0 to ``lags``, shape (lags + 1,), over gap-free series of zero mean."""
    total, count = np.zeros(lags + 1), np.zeros(lags + 1)
    for s in series:
        # By the spectrum, zero-padded so that no lag wraps around.
        total += np.fft.irfft(np.abs(np.fft.rfft(s, 2 * len(s))) ** 2)[: lags + 1]
        count += len(s) - np.arange(lags + 1)
    return total / np.maximum(count, 1)


def integral_time(series: list[np.ndarray]) -> float:
    """Correlation time of an error, s: the integral of its autocorrelation up to the first lag at which it counts as zero.

    A first-order process with this time constant has the error's spectral density at low frequency, where the filter works; a
    white part of the error makes it shorter."""
    covariance = autocorrelation(series, min(_LAGS, min(len(s) for s in series) // 4))
    correlation = covariance / covariance[0]
    gone = np.flatnonzero(correlation < _GONE)
    end = gone[0] if len(gone) else len(correlation)
    return float(max(CYCLE_S * (np.sum(correlation[:end]) - 0.5), 0.5 * CYCLE_S))


def force_error_levels(errors: np.ndarray, force: np.ndarray) -> tuple[float, float]:
    """Maximum-likelihood (floor in N, relative part) of an error with variance floor^2 + (relative F)^2."""
    from scipy.optimize import minimize

    squared, load = errors**2, np.maximum(force, 0.0) ** 2
    total = float(np.mean(squared))
    floor_start = 0.5 * np.log(total)
    relative_start = 0.5 * np.log(0.1 * total / max(float(np.mean(load)), 1.0))

    def cost(p):
        variance = np.exp(2.0 * p[0]) + np.exp(2.0 * p[1]) * load
        return float(np.mean(np.log(variance) + squared / variance))

    found = minimize(cost, [floor_start, relative_start], method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-7})
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))


def lasting_share(pairs: Iterable[tuple[np.ndarray, np.ndarray]], largest: float) -> float:
    """Relative error of a torque that lasts for a manoeuvre; 0 if noise may explain it. The estimator's prior of the torque
    constant is subtracted.

    Both halves of a manoeuvre have the same lasting error and independent noise, so that the mean product of their errors is
    its variance. ``pairs``: error and load of gap-free series, one value for each cycle, in the same unit; ``largest``: the
    load of the largest force."""
    products = []
    for error, load in pairs:
        count = len(load) // _MANOEUVRE
        errors, loads = (values[: count * _MANOEUVRE].reshape(count, 2, _MANOEUVRE // 2) for values in (error, load))
        loaded = np.all(loads.mean(axis=2) > _LOADED * largest, axis=1)
        errors, loads = errors[loaded], loads[loaded]
        products.append(np.prod(np.sum(errors * loads, axis=2) / np.sum(loads * loads, axis=2), axis=1))
    shown = np.concatenate(products) if products else np.zeros(0)
    if len(shown) < _MANOEUVRES or not np.mean(shown) > _SURE * np.std(shown) / np.sqrt(len(shown)):
        return 0.0
    return float(np.sqrt(max(np.mean(shown) - GAIN_SIGMA**2, 0.0)))
