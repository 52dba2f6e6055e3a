"""A resolver whose zero strays: which share of what its angle gains over its speed moves the contact angle.

`models.wander` finds what the motor angle gains over the integrated speed. The speed's offset may cause that as well as the
angle; only the torque can tell, because a zero that strays takes the contact angle with it. Stop by stop, what the filter saw
the contact angle move by is regressed on what had strayed since the last one. The share found so is taken out as it strays,
and its standard deviation counts in the contact angle's.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.estimator.paths import shift_zero
from emb_daemon.jit import Record, fields, njit, sq
from emb_daemon.models.fusion import CONTACT
from emb_daemon.models.wander import OFFSET_RAD_PER_S

#: ``share`` of what strays that is the angle's fault, and ``told``: what stops have told of it, as an inverse variance. The
#: last release left the contact angle at ``contact`` rad with variance ``known`` rad² (0: placed anew since); since then the
#: zero may have ``strayed`` by so many rad, and the contact angle ``gained`` that variance beside, rad². ``walked``: the
#: variance that the contact angle gains with the present sample because of what strays, rad². ``speed`` rad/s, smoothed, and
#: ``creeps``: whether the motor may stand although its angle creeps.
STRAYING = np.dtype([*fields("f8", "share told strayed contact known gained walked speed"), ("creeps", "?")], align=True)

#: Inverse variance of the share before a stop has told anything: nothing or all of it.
_OPEN = 1.0 / 0.5**2
#: What of the evidence is kept from stop to stop: an offset of the speed is joined by a drift of the angle within minutes.
_KEPT = 0.9
#: Time over which the speed is smoothed, s; of a motor that stands it is at most the speed's offset and so many standard
#: deviations of its noise, then as now.
_SMOOTHED_S, _NOISE = 0.2, 3.0


@njit
def _variance(a):
    return 1.0 / (_OPEN + a.told)


@njit
def follow_straying(s: Record, travel: float, speed: float, dt: float) -> None:
    """Take out what the zero strays by in ``dt`` s, in which the angle moves by ``travel`` rad, at the ``speed`` rad/s."""
    a, w = s.straying, s.wander
    strays = w.drift * dt + w.loss * abs(travel)
    a.strayed += strays
    shift_zero(s, a.share * strays)
    # The share is the same all the time, so that its error adds up.
    a.walked = (max(2.0 * _variance(a) * a.strayed * strays, 0.0) + w.unseen * w.unseen) * sq(s.gear_slope)
    w.unseen = 0.0
    # What is certainly motion counts as just that: a fast stroke would otherwise be remembered for a second.
    most, noise = OFFSET_RAD_PER_S + _NOISE * s.speed_sigma, s.speed_sigma * sqrt(0.5 * dt / _SMOOTHED_S)
    a.speed += (1.0 - exp(-dt / _SMOOTHED_S)) * (min(max(speed, -most), most) - a.speed)
    a.creeps = abs(speed) < most and abs(a.speed) < OFFSET_RAD_PER_S + _NOISE * noise


@njit
def attribute_straying(s: Record) -> None:
    """A stop and its release have shown the contact angle: learn the share of what has strayed that moved it."""
    a, known, contact = s.straying, s.covariance[CONTACT, CONTACT], s.contact_angle - s.contact_anchor
    strayed, walked = a.strayed * s.gear_slope, a.known + a.gained
    predicted = walked + _variance(a) * strayed * strayed
    if a.known > 0.0 and known < predicted:
        # What the stop alone has told of the contact angle, and how well.
        whole = predicted / (predicted - known)
        moved, told = (contact - a.contact) * whole, known * whole
        a.share = min(max(a.share + _variance(a) * strayed * moved / (predicted + told), 0.0), 1.0)
        a.told += strayed * strayed / (walked + told)
    a.told *= _KEPT
    a.contact, a.known, a.strayed, a.gained = contact, known, 0.0, 0.0
