"""Dynamic stiffness: clamp force from the motor angle.

Thesis 2.1 (characteristic curve), 3.3.2 and 3.4 (first-order dynamics), discretised exactly for the time that passed
instead of with the thesis's backward difference, so that the calibration holds the time constant and not a coefficient
that belongs to one sample time.
"""

from math import exp

import numpy as np

from emb_daemon.jit import Floats, njit


@njit
def characteristic_curve(x: float, coefficients: Floats) -> tuple[float, float]:
    """Static clamp force (N) and its slope (N/rad) at ``x`` rad past contact; zero in the clearance.

    ``coefficients[n]`` in N/rad^(n+1): the thesis's A0, A1, A2 of F = A0 x + A1 x^2 + A2 x^3.
    """
    if x <= 0.0:
        return 0.0, 0.0
    force = slope = 0.0
    for order in range(len(coefficients) - 1, -1, -1):
        slope = slope * x + (order + 1) * coefficients[order]
        force = (force + coefficients[order]) * x
    return force, slope


@njit
def mean_slope(x: float, spread: float, coefficients: Floats) -> float:
    """Slope (N/rad) of the curve between ``spread`` rad below and above ``x``: how the force depends on an uncertain contact
    angle (statistical linearisation; Särkkä, Bayesian Filtering and Smoothing, 2013, ch. 5). Not zero just before contact."""
    above, _ = characteristic_curve(x + spread, coefficients)
    below, _ = characteristic_curve(x - spread, coefficients)
    return (above - below) / (2.0 * spread)


@njit
def _short_of(x, force, coefficients):
    """Whether a curve that rises from contact is still rising at ``x`` rad, towards ``force`` (N)."""
    there, slope = characteristic_curve(x, coefficients)
    return there < force and slope > 0.0


@njit
def travel_at(force: float, coefficients: Floats) -> float:
    """Travel past contact (rad) at which a rising curve reaches ``force`` (N), or where it stops rising below; infinite beyond
    1000 rad."""
    low, high = 0.0, 1.0
    while _short_of(high, force, coefficients):
        high *= 2.0
        if high > 1000.0:
            return np.inf
    for _ in range(50):
        middle = 0.5 * (low + high)
        if _short_of(middle, force, coefficients):
            low = middle
        else:
            high = middle
    return high


@njit
def first_order_lag(state: float, before: float, now: float, dt: float, time_constant: float) -> float:
    """State after ``dt`` of tau dy/dt + y = u, with u running straight from ``before`` to ``now``: exact for such inputs.

    A time constant of zero lets ``now`` through.
    """
    if time_constant <= 0.0:
        return now
    if dt <= 0.0:
        return state
    ratio = dt / time_constant
    decay = exp(-ratio)
    # Mean of the decaying weight over the interval; the series avoids cancellation for short intervals.
    weight = (1.0 - decay) / ratio if ratio > 1e-6 else 1.0 - 0.5 * ratio
    return decay * state + (weight - decay) * before + (1.0 - weight) * now
