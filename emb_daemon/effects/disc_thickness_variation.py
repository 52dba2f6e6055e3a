"""Disc thickness variation: the disc is a few micrometres thicker at one side than at the other.

The wheel angle comes from the wheel's pulse counter, carried on by the wheel speed between its messages. Its zero is where
the counter was at power-on, which is arbitrary, so each order has a cosine and a sine.
"""

from math import cos, pi, sin, sqrt

import numpy as np

from emb_daemon.effects.base import Effect, Parameter, Placebo
from emb_daemon.jit import Record, njit
from emb_daemon.models.wheel import WHEEL, track
from emb_daemon.wire.contract import PULSE_MODULO, PULSES_PER_TURN

ORDERS = 4
#: Those that discs commonly have.
_COMMON_ORDERS = 2
#: Error of the wheel speed while the counter does not correct it: a hundredth, and half a count on the bus, rad/s.
_SPEED_ERROR, _SPEED_ERROR_RAD_PER_S = 0.01, 0.025
#: Phase error, rad, from which the mean thickness is the better estimate; and half of the counter's range, from which the turn
#: is unknown.
_GUESSED_RAD, _LOST_RAD = 1.0, pi * PULSE_MODULO / PULSES_PER_TURN

#: ``unseen``: possible phase error (rad) since the last value of the counter; ``sigma``: standard deviation of the thickness
#: (m) that follows.
_STATE = np.dtype([("wheel", WHEEL), ("unseen", "f8"), ("sigma", "f8")], align=True)


@njit
def _amplitudes(p):
    """Cosines and sines in µm, by order."""
    cosines = p.order_1_cosine_um, p.order_2_cosine_um, p.order_3_cosine_um, p.order_4_cosine_um
    return cosines, (p.order_1_sine_um, p.order_2_sine_um, p.order_3_sine_um, p.order_4_sine_um)


@njit
def term(p: Record, s: Record, m: Record) -> float:
    """Disc thickness in m above its mean, where the pads stand."""
    cosines, sines = _amplitudes(p)
    # Twice the mean square of the slope over the angle, µm²/rad².
    square = 0.0
    for k in range(ORDERS):
        square += (k + 1) * (k + 1) * (cosines[k] * cosines[k] + sines[k] * sines[k])
    if square == 0.0:
        return 0.0
    if m.has_wheel_pulse and s.unseen < _LOST_RAD:
        angle = track(s.wheel, m.wheel_pulse, m.wheel_speed if m.has_wheel_speed else 0.0, m.dt)
        s.unseen = 0.0
    elif s.wheel.known and m.has_wheel_speed:
        # Without new values of the counter the wheel speed continues the angle.
        s.wheel.turned += m.wheel_speed * m.dt
        s.unseen += (_SPEED_ERROR * m.wheel_speed + _SPEED_ERROR_RAD_PER_S) * m.dt
        angle = s.wheel.turned
    elif s.wheel.known:
        s.unseen, angle = _LOST_RAD, 0.0
    else:
        return 0.0
    s.sigma = 1e-6 * sqrt(0.5 * square) * min(s.unseen, 1.0)
    if s.unseen > _GUESSED_RAD:
        return 0.0
    thickness = 0.0
    for k in range(ORDERS):
        thickness += cosines[k] * cos((k + 1) * angle)
        thickness += sines[k] * sin((k + 1) * angle)
    return 1e-6 * thickness


def _from_anywhere(samples, episode, random):
    """Placebo: each episode begins at another angle of the disc."""
    disturbed = samples.copy()
    offset = random.integers(0, PULSES_PER_TURN, episode[-1] + 1)[episode]
    disturbed["wheel_pulse"] = np.mod(samples["wheel_pulse"] + offset, PULSE_MODULO)
    return disturbed


def _of_another_size(samples, _episode, random):
    """Placebo: a wheel that turns at another ratio, which gives orders that no disc has."""
    ratio = random.choice((0.63, 1.41, 2.57, 3.37))
    disturbed = samples.copy()
    known = samples["has_wheel_pulse"]
    count = np.unwrap(samples["wheel_pulse"][known], period=PULSE_MODULO)
    disturbed["wheel_pulse"][known] = np.mod(np.floor(ratio * count), PULSE_MODULO)
    disturbed["wheel_speed"] *= ratio
    return disturbed


EFFECT = Effect(
    name="disc_thickness_variation",
    hook="thickness",
    term=term,
    parameters=tuple(
        Parameter(
            f"order_{order}_{part}_um",
            "µm",
            -60.0,
            60.0,
            10.0,
            f"{part} of {order} per turn",
            drawn=(-60.0, 60.0) if order <= _COMMON_ORDERS else (0.0, 0.0),
            group=f"order {order}",
        )
        for order in range(1, ORDERS + 1)
        for part in ("cosine", "sine")
    ),
    equation="θ → θ + Σ (aₙ cos nφ + bₙ sin nφ) / γ",
    source="Jacobsson, Aspects of disc brake judder, Proc. IMechE D 217, 2003: 10 to 20 µm, orders 1 to 4 when cold",
    state=_STATE,
    signal="disc_angle",
    manoeuvre="hold the clamp force on a turning wheel for several turns",
    placebos=(
        Placebo("wheel angle starting at random in each episode", samples=_from_anywhere),
        Placebo("orders that no disc has", samples=_of_another_size),
    ),
)
