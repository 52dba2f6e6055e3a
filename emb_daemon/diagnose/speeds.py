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
#: Number of cycles over which changes are compared; correlation of neighbouring ones below minus which they are no noise's;
#: largest difference of those further apart, as a share of the squared changes, of a slow motion.
_LAGS, _OF_NOISE, _ALIKE = 7, 0.55, 0.2
#: Numbers of samples over which a parabola replaces the speeds, at most a quarter of a second, and the fewest changes of speed
#: that tell their noise.
_WINDOWS, _FEWEST = (5, 9, 25, 63), 100


def denoised(samples: np.ndarray) -> np.ndarray:
    """SAMPLE rows with speeds smoothed as far as their noise asks for; the same rows where it hides nothing."""
    speed, in_turn = samples["speed"], samples["dt"] <= ONE_CYCLE_S
    moving = in_turn[1:] & (np.abs(speed[1:]) > STEP_RAD_PER_S)
    if np.sum(moving) < _FEWEST:
        return samples
    changes = np.where(moving, np.diff(speed), 0.0)
    square, first, second, *apart = (
        float(changes[lag:] @ changes[: len(changes) - lag]) / np.sum(moving) for lag in range(_LAGS)
    )
    # White noise makes neighbouring changes opposite by its variance and leaves the second ones as the motion has them. A
    # ripple may do more. Where two of its values were averaged, it is over after two cycles, and a slow motion goes on.
    white = second - first if first > -_OF_NOISE * square else 0.0
    over = 0.5 * (square - float(np.mean(apart))) if np.ptp(apart) < _ALIKE * square else 0.0
    variance = max(white, over)
    if 2.0 * variance <= _MOST * square:
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
