"""The speed of a machine that turns itself and clamps nothing, without the noise that hides its acceleration.

A brake's motor changes its speed by much more than its noise in a cycle when its inertia matters. A joint that turns slowly
changes it by less than a step of our message, and an encoder read every millisecond has steps of its own: the difference of
two speeds is then mostly noise, which as a regressor of the inertia makes that too small (regression dilution; Fuller,
"Measurement Error Models", 1987), and what is left of the current too large. Where a motor is thrown to and fro its
changes are so large that noise which is next to nothing beside them is still most of what is left of the current.
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
#: A longer window is taken only if it leaves at most this share of the current's residual; a smaller gain may come from
#: cutting off motion.
_LESS = 0.9


def denoised(samples: np.ndarray, turns_free: bool) -> np.ndarray:
    """SAMPLE rows with speeds smoothed as far as their noise asks for, and where a motor ``turns_free`` as far as its current
    needs it beside friction and acceleration; the same rows where noise hides nothing."""
    in_turn = samples["dt"] <= ONE_CYCLE_S
    moving = in_turn[1:] & (np.abs(samples["speed"][1:]) > STEP_RAD_PER_S)
    if np.sum(moving) < _FEWEST:
        return samples
    window = _by_noise(samples["speed"], in_turn, moving)
    result = _with_speed(samples, _smoothed(samples["speed"], in_turn, window)) if window else samples
    if not turns_free:
        return result
    left = _left_of_current(result, moving)
    for longer in (w for w in _WINDOWS if w > window):
        tried = _with_speed(samples, _smoothed(samples["speed"], in_turn, longer))
        less = _left_of_current(tried, moving)
        if not less < _LESS * left:
            break
        result, left = tried, less
    return result


def _with_speed(samples: np.ndarray, speed: np.ndarray) -> np.ndarray:
    result = samples.copy()
    result["speed"] = speed
    return result


def _by_noise(speed: np.ndarray, in_turn: np.ndarray, moving: np.ndarray) -> int:
    """The window that the noise of the changes of speed asks for, by which those are ``moving``; 0 for none."""
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
        return 0
    for window in _WINDOWS:
        left = variance * float(np.sum(np.diff(savgol_coeffs(window, 2), prepend=0.0, append=0.0) ** 2))
        if left <= _MOST * np.mean(np.diff(_smoothed(speed, in_turn, window))[moving] ** 2):
            break
    return window


def _smoothed(speed: np.ndarray, in_turn: np.ndarray, window: int) -> np.ndarray:
    """Speeds smoothed over so many samples, not across what ``in_turn`` says is missing."""
    result = speed.copy()
    for first, last in pairwise([0, *np.flatnonzero(~in_turn[1:]) + 1, len(speed)]):
        if last - first >= window:
            result[first:last] = savgol_filter(speed[first:last], window, 2)
    return result


def _left_of_current(samples: np.ndarray, moving: np.ndarray) -> float:
    """RMS of the current (A) of a motor that turns free, beside acceleration, friction, speed and an offset."""
    speed = samples["speed"]
    rows = np.flatnonzero(moving & samples["has_current"][1:])
    if len(rows) < _FEWEST:
        return 0.0
    mean, change = 0.5 * (speed[1:] + speed[:-1])[rows], np.diff(speed)[rows] / samples["dt"][1:][rows]
    table = np.column_stack([change, np.sign(mean), mean, np.ones(len(rows))])
    current = samples["current_q"][1:][rows]
    return float(np.std(current - table @ np.linalg.lstsq(table, current, rcond=None)[0]))
