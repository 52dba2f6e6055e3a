"""The speed of a machine that turns itself and clamps nothing, without the noise that hides its acceleration.

A brake's motor changes its speed by much more than its noise in a cycle when its inertia matters. A joint that turns slowly
changes it by less than a step of our message, and an encoder read every millisecond has steps of its own: the difference of
two speeds is then mostly noise, which as a regressor of the inertia makes that too small (regression dilution; Fuller,
"Measurement Error Models", 1987), and what is left of the current too large.
"""

from itertools import pairwise

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from emb_daemon.estimator.paths import ONE_CYCLE_S
from emb_daemon.logs.resample import STEP_RAD_PER_S

#: Largest share of noise in the squared changes of speed: it is the share by which an inertia comes out too small.
_MOST = 0.1
#: Numbers of samples over which a parabola replaces the speeds, at most a quarter of a second, and the fewest changes of speed
#: that tell their noise.
_WINDOWS, _FEWEST = (5, 9, 25, 63), 100


def denoised(samples: np.ndarray) -> np.ndarray:
    """SAMPLE rows with speeds smoothed as far as their noise asks for; the same rows where it hides nothing."""
    speed, in_turn = samples["speed"], samples["dt"] <= ONE_CYCLE_S
    moving = in_turn[1:] & (np.abs(speed[1:]) > STEP_RAD_PER_S)
    both = moving[1:] & moving[:-1]
    if np.sum(both) < _FEWEST:
        return samples
    changes = np.diff(speed)
    # Of white noise neighbouring changes have minus half of its share in their squares; those of a motion are alike.
    variance = float(np.mean(changes[1:][both] ** 2 - changes[1:][both] * changes[:-1][both])) / 3.0
    if 2.0 * variance <= _MOST * np.mean(changes[moving] ** 2):
        return samples
    cuts = [0, *np.flatnonzero(~in_turn[1:]) + 1, len(samples)]
    result = samples.copy()
    for window in _WINDOWS:
        for first, last in pairwise(cuts):
            if last - first >= window:
                result["speed"][first:last] = savgol_filter(speed[first:last], window, 2)
        left = variance * float(np.sum(np.diff(savgol_coeffs(window, 2), prepend=0.0, append=0.0) ** 2))
        if left <= _MOST * np.mean(np.diff(result["speed"])[moving] ** 2):
            break
    return result
