"""Disc thickness variation: the disc is a few micrometres thicker at one side than at the other.

The wheel angle comes from the wheel's pulse counter, carried on by the wheel speed between its messages. Its zero is where
the counter was at power-on, which is arbitrary, so each order has a cosine and a sine.

The counter's range is no whole number of turns. Who has not heard it go over its range cannot know which of `PHASES` phases
the disc has; the thickness is then their mean by how likely they are (`estimator.phases`), and sigma their spread.
"""

from math import cos, gcd, pi, sin, sqrt

import numpy as np

from emb_daemon.effects.base import Effect, Parameter, Placebo
from emb_daemon.jit import Record, hypot, njit
from emb_daemon.models.wheel import WHEEL, track
from emb_daemon.wire.contract import PULSE_MODULO, PULSES_PER_TURN

ORDERS = 4
#: Those that discs commonly have.
_COMMON_ORDERS = 2
#: Error of the wheel speed while the counter does not correct it: a hundredth, and half a count on the bus, rad/s.
_SPEED_ERROR, _SPEED_ERROR_RAD_PER_S = 0.01, 0.025
#: What a wheel of a car may turn at, rad/s: 65 m/s on tyres of 0.33 m.
_FASTEST_RAD_PER_S = 200.0
#: Phases that a counter leaves open once it may have gone over its range, and what one is ahead of the one before, rad.
PHASES = PULSES_PER_TURN // gcd(PULSE_MODULO, PULSES_PER_TURN)
_AHEAD_RAD = 2.0 * pi * PULSE_MODULO / PULSES_PER_TURN
#: What a counter that begins with the daemon may stand at when it is first heard: a count, and what the wheel turns by in two
#: cycles of the message, s. One that has run for long stands there by chance once in 2000 times at rest, in 200 at 60 rad/s.
_JUST_BEGUN, _JUST_S = 1, 0.02
#: Phase error, rad, from which the mean thickness is the better estimate; and half of the counter's range, from which the turn
#: is unknown.
_GUESSED_RAD, _LOST_RAD = 1.0, pi * PULSE_MODULO / PULSES_PER_TURN

#: ``unseen``: possible phase error (rad) since the last value of the counter; ``sigma``: standard deviation of the thickness
#: (m) that follows; ``likely``: probability of each phase that is open, zeros where the phase is known; ``beside``: by how
#: much the disc is thicker with each of them than the mean, m.
_STATE = np.dtype(
    [("wheel", WHEEL), ("unseen", "f8"), ("sigma", "f8"), ("likely", "f8", (PHASES,)), ("beside", "f8", (PHASES,))], align=True
)


@njit
def _amplitudes(p):
    """Cosines and sines in µm, by order."""
    cosines = p.order_1_cosine_um, p.order_2_cosine_um, p.order_3_cosine_um, p.order_4_cosine_um
    return cosines, (p.order_1_sine_um, p.order_2_sine_um, p.order_3_sine_um, p.order_4_sine_um)


@njit
def _steepness(p):
    """Twice the mean square of the slope over the angle, µm²/rad²."""
    cosines, sines = _amplitudes(p)
    square = 0.0
    for k in range(ORDERS):
        square += (k + 1) * (k + 1) * (cosines[k] * cosines[k] + sines[k] * sines[k])
    return square


@njit
def _thickness(cosines, sines, angle):
    """Thickness in m above the mean at a wheel angle."""
    thickness = 0.0
    for k in range(ORDERS):
        thickness += cosines[k] * cos((k + 1) * angle)
        thickness += sines[k] * sin((k + 1) * angle)
    return 1e-6 * thickness


@njit
def is_open(s: Record) -> bool:
    """Whether several phases are possible."""
    return s.likely[0] > 0.0


@njit
def _open(s):
    for phase in range(PHASES):
        s.likely[phase] = 1.0 / PHASES


@njit
def term(p: Record, s: Record, m: Record) -> float:
    """Disc thickness in m above its mean, where the pads stand."""
    cosines, sines = _amplitudes(p)
    square = _steepness(p)
    if square == 0.0:
        return 0.0
    if m.has_wheel_pulse:
        if s.unseen >= _LOST_RAD:
            s.wheel.known = False
            _open(s)
        angle = track(s.wheel, m.wheel_pulse, m.wheel_speed if m.has_wheel_speed else 0.0, m.dt)
        s.unseen = 0.0
    elif s.wheel.known and m.has_wheel_speed:
        # Without new values of the counter the wheel speed continues the angle.
        s.wheel.turned += m.wheel_speed * m.dt
        s.unseen += (_SPEED_ERROR * m.wheel_speed + _SPEED_ERROR_RAD_PER_S) * m.dt
        angle = s.wheel.turned
    elif s.wheel.known:
        s.unseen += _FASTEST_RAD_PER_S * m.dt
        angle = s.wheel.turned
    else:
        return 0.0
    s.sigma = 1e-6 * sqrt(0.5 * square) * min(s.unseen, 1.0)
    if s.unseen > _GUESSED_RAD:
        return 0.0
    if not is_open(s):
        return _thickness(cosines, sines, angle)
    mean = variance = 0.0
    for phase in range(PHASES):
        s.beside[phase] = _thickness(cosines, sines, angle + phase * _AHEAD_RAD)
        mean += s.likely[phase] * s.beside[phase]
    for phase in range(PHASES):
        s.beside[phase] -= mean
        variance += s.likely[phase] * s.beside[phase] * s.beside[phase]
    s.sigma = hypot(s.sigma, sqrt(variance))
    return mean


@njit
def doubt_phase(p: Record, s: Record, m: Record) -> None:
    """Before the first sample with the counter: one that stands at more than it can have counted just now has run before, and
    may have gone over its range."""
    if m.has_wheel_pulse and not s.wheel.known and _steepness(p) > 0.0:
        speed = m.wheel_speed if m.has_wheel_speed else 0.0
        if m.wheel_pulse > _JUST_BEGUN + _JUST_S * speed * PULSES_PER_TURN / (2.0 * pi):
            _open(s)


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
