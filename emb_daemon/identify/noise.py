"""Noise levels of both paths as the filter needs them, from data that did not fit the models.

The daemon's standard deviation is judged against a reference instrument, so that it has to contain that instrument's noise:
what is held out contains it too.
"""

import numpy as np

from emb_daemon.calibration.types import Noise
from emb_daemon.identify.torque import TorqueFit, unexplained_current
from emb_daemon.jit import njit
from emb_daemon.offline import Log
from emb_daemon.wire.contract import CYCLE_S

#: Resolver movement that still counts as standing, rad.
_STANDING = 2.5e-3


def autocorrelation(series: list[np.ndarray], lags: int) -> np.ndarray:
    """Covariance at lags 0 to ``lags``, shape (lags + 1,), over gap-free series of zero mean."""
    return np.array([
        sum(float(s[: len(s) - k] @ s[k:]) for s in series) / max(sum(len(s) - k for s in series), 1)
        for k in range(lags + 1)
    ])  # fmt: skip


def integral_time(series: list[np.ndarray]) -> float:
    """Seconds over which an error stays: the integral of its autocorrelation up to the first lag at which it is gone.

    A first-order process with this time constant has the error's own density at the slow end of the spectrum, where the
    filter works; white parts shorten it as they should.
    """
    covariance = autocorrelation(series, min(2500, min(len(s) for s in series) // 4))
    correlation = covariance / covariance[0]
    gone = np.flatnonzero(correlation < 0.05)
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


def speed_noise(logs: list[Log]) -> float | None:
    """Standard deviation in rad/s of the motor speed while the motor stands; None if it never stands for 0.2 s."""
    squares = count = 0.0
    for log in logs:
        angle, speed = log.samples["angle"], log.samples["speed"]
        window = 50
        for start in range(0, len(angle) - window, window):
            rows = slice(start, start + window)
            if np.ptp(angle[rows]) <= _STANDING:
                squares += float(np.sum((speed[rows] - speed[rows].mean()) ** 2))
                count += window - 1
    return float(np.sqrt(squares / count)) if count else None


@njit
def _innovation_cost(residual, variance, decay, white):
    """Mean negative log likelihood (without constants) of first-order noise under white noise, by its Kalman filter."""
    state, spread, cost = 0.0, variance, 0.0
    for value in residual:
        total = spread + white
        innovation = value - state
        cost += np.log(total) + innovation * innovation / total
        gain = spread / total
        state = decay * (state + gain * innovation)
        spread = decay * decay * (1.0 - gain) * spread + (1.0 - decay * decay) * variance
    return cost


def current_noise(residuals: list[np.ndarray], white: float) -> tuple[float, float]:
    """First-order coloured noise of the current by maximum likelihood: (standard deviation in A, correlation time in s).

    Args:
        residuals: unexplained current, gap-free stretches.
        white: standard deviation in A of the white noise that the filter takes the speed's noise for.
    """
    from scipy.optimize import minimize

    total = float(np.mean(np.concatenate(residuals) ** 2))
    samples = sum(len(r) for r in residuals)

    def cost(p):
        decay = float(np.exp(-CYCLE_S / np.exp(p[1])))
        return sum(_innovation_cost(r, float(np.exp(2.0 * p[0])), decay, white**2) for r in residuals) / samples

    start = [0.5 * np.log(max(total - white**2, 0.1 * total)), np.log(2.0 * CYCLE_S)]
    bounds = [(start[0] - 5.0, start[0] + 2.0), (np.log(0.25 * CYCLE_S), np.log(1.0))]
    found = minimize(cost, start, method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3, "fatol": 1e-7})
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))


def torque_levels(held_out: list[tuple[Log, TorqueFit]], gear_gain: float, speed_sigma: float) -> dict[str, float]:
    """Fields of `Noise` that belong to the torque path, from logs each with a fit that did not see it."""
    series, turning, excess, gains = [], [], [], []
    fit = held_out[0][1]
    white = np.sqrt(2.0) * fit.inertia * speed_sigma / CYCLE_S / fit.torque_constant
    for log, fit in held_out:
        rows, current, mean, force = unexplained_current(log, fit, gear_gain)
        torque = fit.torque_constant * current
        series += [s for s in np.split(current, np.flatnonzero(np.diff(rows) != 1) + 1) if len(s) > 50]
        sliding = 1.0 - mean**2
        turning.append((sliding * (fit.offset_friction + fit.load_friction * np.maximum(force, 0.0))) ** 2)
        excess.append(torque**2 - np.mean(torque[sliding < 0.1] ** 2))
        load = (gear_gain + fit.load_friction * mean) * force
        # Slope of torque error over explained torque: what a wrong torque constant or friction leaves for the whole log.
        gains.append(float(load @ torque / (load @ load)))
    turning, excess = np.concatenate(turning), np.concatenate(excess)
    share = float(turning @ excess / (turning @ turning)) if np.any(turning > 0.0) else 0.0
    sigma, time = current_noise(series, white)
    own = np.sqrt(held_out[0][1].covariance[0, 0]) / held_out[0][1].torque_constant
    return {
        "current_A": sigma,
        "current_correlation_s": time,
        "speed_rad_per_s": speed_sigma,
        "presliding": float(np.sqrt(np.clip(share, 0.0, 1.0))),
        "torque_relative": float(np.hypot(np.sqrt(np.mean(np.square(gains))), own)),
    }


def noise_levels(
    stiffness: list[tuple[np.ndarray, np.ndarray]],
    torque: list[tuple[Log, TorqueFit]],
    gear_gain: float,
    speed_sigma: float,
    interpolation_relative: float = 0.0,
) -> Noise:
    """Noise for a calibration.

    Args:
        stiffness: for each held-out log (error of the stiffness path in N, reference force in N).
        torque: for each held-out log, a torque fit that did not see it.
        interpolation_relative: relative force error that a curve between two measured pad thicknesses adds.
    """
    errors = [e for e, _ in stiffness]
    floor, relative = force_error_levels(np.concatenate(errors), np.concatenate([f for _, f in stiffness]))
    return Noise(
        stiffness_N=floor,
        stiffness_relative=float(np.hypot(relative, interpolation_relative)),
        stiffness_correlation_s=integral_time(errors),
        **torque_levels(torque, gear_gain, speed_sigma),
    )
