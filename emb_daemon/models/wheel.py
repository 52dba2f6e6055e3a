"""Angle of a wheel from its pulse counter, carried on by the wheel speed between the counter's messages."""

from math import floor, pi

import numpy as np

from emb_daemon.jit import Record, njit
from emb_daemon.wire.contract import PULSE_MODULO, PULSES_PER_TURN

#: Speed above which a wheel turns, rad/s: sensors' noise at standstill stays below.
TURNING_RAD_PER_S = 0.5
#: Share of the difference between count and carried angle that a new count corrects: the count is coarse, the speed drifts.
_CORRECTION = 0.2

WHEEL = np.dtype([("known", "?"), ("count", "f8"), ("turned", "f8")], align=True)


@njit
def track(s: Record, pulse: float, wheel_speed: float, dt: float) -> float:
    """Wheel angle in rad: carried on by ``wheel_speed`` rad/s, corrected when the pulse counter has moved."""
    width = 2.0 * pi / PULSES_PER_TURN
    if not s.known:
        s.known = True
        s.count = pulse
        s.turned = (pulse + 0.5) * width
        return s.turned
    s.turned += wheel_speed * dt
    # The counter wraps: of all counts that it may mean, take the one nearest to the carried angle.
    wraps = floor((s.turned / width - 0.5 - pulse) / PULSE_MODULO + 0.5)
    count = pulse + wraps * PULSE_MODULO
    if count != s.count:
        s.count = count
        # The count came at some time since the last sample, and the wheel has turned on: without this a fast disc would lag
        # more than a slow one.
        error = (s.count + 0.5) * width + 0.5 * wheel_speed * dt - s.turned
        # An error of more than two pulses is no interpolation error: frames were missing.
        s.turned += error if abs(error) > 2.0 * width + 0.02 * wheel_speed else _CORRECTION * error
    return s.turned


@njit
def _wheel_angle(samples, s, angle):
    for row in range(len(samples)):
        m = samples[row]
        if m.has_wheel_pulse:
            angle[row] = track(s, m.wheel_pulse, m.wheel_speed if m.has_wheel_speed else 0.0, m.dt)
        else:
            angle[row] = angle[row - 1] if row else 0.0


def wheel_angle(samples: np.ndarray) -> np.ndarray:
    """Wheel angle (rad, unwrapped) at each SAMPLE row, as the estimator tracks it."""
    angle = np.zeros(len(samples))
    _wheel_angle(samples, np.zeros(1, WHEEL)[0], angle)
    return angle
