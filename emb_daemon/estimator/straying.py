"""A resolver whose zero strays: which share of what its angle gains over its speed moves the contact angle.

`models.wander` finds what the motor angle gains over the integrated speed. The speed's offset may cause that as well as the
angle. Two things tell: nothing turns the motor of an open brake, so that what moves then is the angle's fault, and what the
speed shows is its own offset; and a zero that strays takes the contact angle with it, which the torque shows. Stop by stop,
what the filter saw the contact angle move by is regressed on what had strayed since the last one. The share found so is taken
out as it strays, and its standard deviation counts in the contact angle's.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.estimator.paths import shift_places, shift_zero
from emb_daemon.estimator.rewind import go_back
from emb_daemon.jit import Record, fields, njit, sq
from emb_daemon.models.fusion import CONTACT
from emb_daemon.models.lateness import SLOWEST_S
from emb_daemon.models.wander import COUNTS_RAD, OFFSET_RAD_PER_S, take_offset
from emb_daemon.wire.contract import CYCLE_S

#: ``share`` of what strays that is the angle's fault, and ``told``: what stops have told of it, as an inverse variance. The
#: last release left the contact angle at ``contact`` rad with variance ``known`` rad² (0: placed anew since); since then the
#: zero may have ``strayed`` by so many rad, and the contact angle ``gained`` that variance beside, rad². ``walked``: the
#: variance that the contact angle gains with the present sample because of what strays, rad². ``speed`` rad/s, smoothed, and
#: ``creeps``: whether the motor may stand although its angle creeps. That of an open brake has stood for ``rest_s`` s of late,
#: in which its angle and its integrated speed changed by ``rest_travel`` and ``rest_turned`` rad; ``rate`` rad/s: at which the
#: zero then drifted, 0 if that is not certain, and ``drifted`` rad: so far since the last release. ``rest_begun`` rad: way of
#: the angle in the rest's first half. ``lately_…``: time and ways of the last moments, which count if it goes on to stand.
STRAYING = np.dtype(
    [
        *fields("f8", "share told strayed contact known gained walked speed rest_s rest_travel rest_turned rate drifted"),
        ("rest_begun", "f8"),
        *fields("f8", "lately_s lately_travel lately_turned"),
        ("creeps", "?"),
    ],
    align=True,
)

#: Inverse variance of the share before a stop has told anything: nothing or all of it.
_OPEN = 1.0 / 0.5**2
#: What of the evidence is kept from stop to stop: an offset of the speed is joined by a drift of the angle within minutes.
_KEPT = 0.9
#: Time over which the speed is smoothed, s; of a motor that stands it is at most the speed's offset and so many standard
#: deviations of its noise, then as now.
_SMOOTHED_S, _NOISE = 0.2, 3.0
#: Time for which a motor must stand to tell, s: the noise of the speed then leaves a drift of some hundredths of a rad/s; and
#: standard deviations of that which what strays must reach to tell whose fault it is.
_REST_S, _SHOWN = 2.0, 3.0
#: Fastest drift, rad/s, as `models.wander` has it, and standard deviations of the speed's noise that chance does not reach in
#: a rest, beyond which a sample's way is no drift; and share of its whole way by which half of a drift's differs from half.
_FASTEST, _CHANCE, _UNSTEADY = 1.0, 6.0, 0.25
#: Share by which a drift may change until the motor stands again; and standard deviation, as a share, of what has strayed
#: until it was found, because nobody knows when it began.
_CHANGES, _SINCE = 0.1, 0.3


@njit
def _variance(a):
    return 1.0 / (_OPEN + a.told)


@njit
def straying_sigma(s: Record, seconds: float) -> float:
    """Standard deviation of what the zero strays by in so many seconds with the share that is not known of it, rad."""
    return sqrt(_variance(s.straying)) * abs(s.wander.rate) * seconds


@njit
def follow_straying(s: Record, p: Record, travel: float, turned: float, speed: float, open_brake: bool, dt: float) -> None:
    """Take out what the zero strays by in ``dt`` s, in which the angle moves by ``travel`` rad and the integrated speed by
    ``turned`` rad, at the ``speed`` rad/s; ``open_brake``: whether nothing turns the motor."""
    a, w = s.straying, s.wander
    if open_brake and a.creeps:
        _rest(s, p, travel, turned, dt)
    else:
        # The motor has begun to turn, and a late speed may not have shown it at once.
        a.lately_s = a.lately_travel = a.lately_turned = 0.0
    drifts, lost = a.rate * dt, w.loss * abs(travel)
    strays = w.drift * dt + lost
    a.strayed += strays
    a.drifted += drifts
    shift_zero(s, drifts + a.share * lost if drifts != 0.0 else a.share * strays)
    # The share is the same all the time, so that its error adds up.
    variance = 2.0 * sq(_CHANGES) * a.drifted * drifts if drifts != 0.0 else 2.0 * _variance(a) * a.strayed * strays
    a.walked = (max(variance, 0.0) + w.unseen * w.unseen) * sq(s.gear_slope)
    w.unseen = 0.0
    # What is certainly motion counts as just that: a fast stroke would otherwise be remembered for a second.
    most, noise = OFFSET_RAD_PER_S + _NOISE * s.speed_sigma, s.speed_sigma * sqrt(0.5 * dt / _SMOOTHED_S)
    a.speed += (1.0 - exp(-dt / _SMOOTHED_S)) * (min(max(speed, -most), most) - a.speed)
    a.creeps = abs(speed) < most and abs(a.speed) < OFFSET_RAD_PER_S + _NOISE * noise


@njit
def _rest(s, p, travel, turned, dt):
    """Take one sample of a motor that stands."""
    a = s.straying
    if abs(travel - turned) > COUNTS_RAD + (_FASTEST + _CHANCE * s.speed_sigma) * dt:
        # A rotor that slips is no drift, nor is what came before and after it one rest.
        a.rest_s = a.rest_travel = a.rest_turned = a.lately_s = a.lately_travel = a.lately_turned = 0.0
        return
    a.lately_s += dt
    a.lately_travel += travel
    a.lately_turned += turned
    if a.lately_s < SLOWEST_S:
        return
    if a.rest_s < 0.5 * _REST_S:
        a.rest_begun = a.rest_travel + a.lately_travel
    a.rest_s += a.lately_s
    a.rest_travel += a.lately_travel
    a.rest_turned += a.lately_turned
    a.lately_s = a.lately_travel = a.lately_turned = 0.0
    if a.rest_s < _REST_S:
        return
    slip, variance = a.rest_travel - a.rest_turned, sq(s.speed_sigma) * CYCLE_S * a.rest_s + sq(COUNTS_RAD)
    known, a.rate = a.rate != 0.0 or s.wander.found, 0.0
    # Where angle and speed show the same motion, the motor may creep after all.
    if abs(slip) >= abs(a.rest_turned):
        take_offset(s.wander, a.rest_turned, variance, a.rest_s)
        if slip * slip > sq(_SHOWN) * variance:
            _learn_share(a, slip, a.rest_travel, variance)
            steady = abs(a.rest_begun - 0.5 * a.rest_travel) < _UNSTEADY * abs(a.rest_travel)
            if a.rest_travel / slip > 0.5 and steady:
                a.rate = a.rest_travel / a.rest_s
    if a.rate != 0.0 and not known:
        _undo(s, p)
    a.rest_s = a.rest_travel = a.rest_turned = 0.0


@njit
def _undo(s, p):
    """The zero has drifted for a while: forget what the stops since have taught, and place the contact where it was before,
    moved by what has strayed since."""
    strayed = s.wander.strayed
    s.wander.strayed = 0.0
    shift_places(s, strayed)
    go_back(s, p)
    s.covariance[CONTACT, CONTACT] += sq(_SINCE * strayed * s.gear_slope)


@njit
def _learn_share(a, strayed, moved, variance):
    """Update the share of the straying that is the angle's fault: of ``strayed`` rad the zero has moved by ``moved`` rad,
    known with ``variance`` rad²."""
    known = _variance(a) * strayed
    a.share = min(max(a.share + known * (moved - a.share * strayed) / (known * strayed + variance), 0.0), 1.0)
    a.told += strayed * strayed / variance


@njit
def attribute_straying(s: Record) -> None:
    """A stop and its release have shown the contact angle: learn the share of what has strayed that moved it."""
    a, known, contact = s.straying, s.covariance[CONTACT, CONTACT], s.contact_angle - s.contact_anchor
    strayed, walked = a.strayed * s.gear_slope, a.known + a.gained
    predicted = walked + _variance(a) * strayed * strayed
    if a.known > 0.0 and known < predicted:
        # What this stop alone says of the contact angle, and its variance: the posterior with the prediction taken out.
        whole = predicted / (predicted - known)
        moved, told = (contact - a.contact) * whole, known * whole
        _learn_share(a, strayed, a.share * strayed + moved, walked + told)
    a.told *= _KEPT
    a.contact, a.known, a.strayed, a.gained = contact, known, 0.0, 0.0
    a.drifted = 0.0
