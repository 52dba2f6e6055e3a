"""What an error of a clamp force is like, as the filter needs it: how large, and how long it stays."""

import numpy as np

from emb_daemon.wire.contract import CYCLE_S

#: Cycles up to which an error is followed, ten seconds, and correlation below which nothing of it is left.
_LAGS, _GONE = 2500, 0.05


def autocorrelation(series: list[np.ndarray], lags: int) -> np.ndarray:
    """Covariance at lags 0 to ``lags``, shape (lags + 1,), over gap-free series of zero mean."""
    total, count = np.zeros(lags + 1), np.zeros(lags + 1)
    for s in series:
        # By the spectrum, padded with as many zeros as no lag wraps around.
        total += np.fft.irfft(np.abs(np.fft.rfft(s, 2 * len(s))) ** 2)[: lags + 1]
        count += len(s) - np.arange(lags + 1)
    return total / np.maximum(count, 1)


def integral_time(series: list[np.ndarray]) -> float:
    """Seconds over which an error stays: the integral of its autocorrelation up to the first lag at which it is gone.

    A first-order process with this time constant has the error's own density at the slow end of the spectrum, where the
    filter works; white parts shorten it as they should.
    """
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
