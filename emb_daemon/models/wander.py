"""A resolver whose zero wanders: its angle drifts, or counts of one direction are lost, a little in each sample.

Over strokes and stops the angle must change by the integrated speed. A difference is explained by a drift with time, a loss
with the travelled way in either direction, and two errors that vanish when the motor returns: a gain error of the resolver,
proportional to the travel, and an age of the angle, proportional to the speed. All four are fitted together over some stops,
so that the noise of the speed averages out. The fit cannot tell whether angle or speed is wrong; the contact angle becomes
uncertain by the difference.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.jit import Record, fields, njit, sq
from emb_daemon.wire.contract import CYCLE_S

#: What explains the angle less integrated speed, over integrated speed (1), gained speed (s), time (rad/s), and way (1).
_GAIN, _AGE, _RATE, _LOSS, _CAUSES = 0, 1, 2, 3, 4

#: The present stretch: its duration, angle less integrated speed (``slip``, rad), integrated speed (``net`` rad), the same
#: without sign while the motor turned (``way`` rad), and gained speed (rad/s). ``normal``, ``right``: weighted normal
#: equations, which forget; ``lower``, ``half``: scratch. ``offset_weight``, ``offset_sum``: what the speed's offset was so
#: far. ``strayed`` rad: recent slip, leaky. ``drift`` rad/s: of the angle relative to the integrated speed; ``rate`` rad/s:
#: its part that the speed's offset does not explain; ``loss``: share of the way; each 0 unless it is likely. ``found``:
#: whether rate or loss is certain; ``unseen`` rad: ``strayed`` at that moment, until it has been taken into account.
WANDER = np.dtype(
    [
        *fields("f8", "seconds slip net way gained"),
        ("normal", "f8", (_CAUSES, _CAUSES)),
        ("right", "f8", (_CAUSES,)),
        ("lower", "f8", (_CAUSES, _CAUSES)),
        ("half", "f8", (_CAUSES,)),
        *fields("f8", "offset_weight offset_sum strayed drift rate loss unseen"),
        ("found", "?"),
    ],
    align=True,
)

#: A stretch lasts at least this long, s, and ends where the motor stands, so that an age of the angle does not show; or at
#: latest after the second time.
_LEAST_S, _MOST_S = 0.5, 2.0
#: Time over which evidence is kept, s: some stops.
_KEPT_S = 40.0
#: A motor stands below this speed, rad/s: ten times the noise of a resolver's speed.
STANDING_RAD_PER_S = 3.0
#: Priors as inverse variances: gain (share) and age (s) as `models.lateness` has them, drift (rad/s) and loss (share) unknown.
_POSSIBLE = np.array([1.0 / 0.02**2, 1.0 / 0.01**2, 1.0 / 1.0**2, 1.0 / 0.1**2])
#: Noise of a stretch in addition to the speed's: two counts of a 12-bit resolver, rad; and share of the way that the
#: trapezoidal rule misses. A step a of the acceleration at the share x of a cycle T leaves a T² (x (1 - x) - 1/6) / 2, whose
#: standard deviation is 0.037 a T²: four steps of 8000 rad/s² in a stroke of 10 rad make a thousandth of it.
COUNTS_RAD, _MISSED = 0.003, 0.001
#: Offset of a healthy resolver's speed when nothing is known of it, rad/s, standard deviation: one count of the wire, which a
#: speed that is cut off instead of rounded is off by, and a tenth of its noise. It shows as a drift that was always there, and
#: is learned from what differs from it by less than so many standard deviations. Time in which it becomes another, s.
OFFSET_RAD_PER_S, _OFFSET_OF_NOISE, _LIKE_BEFORE, _OFFSET_CHANGES_S = 0.02, 0.1, 2.0, 600.0
#: Standard deviations from which a drift or a loss counts in the force's sigma, and from which it is reported: the
#: evidence renews itself in 40 s, so that chance reaches the first once in a few hours of driving, the second once in a week.
_LIKELY, _SURELY = 3.0, 4.0


@njit
def watch_wander(a: Record, travel: float, turned: float, speed: float, gained: float, noise: float, dt: float) -> None:
    """Take one sample: ``travel`` rad by the angle, ``turned`` rad by the speed in ``dt`` s, which is now ``speed`` rad/s and
    ``gained`` rad/s more than before; ``noise`` rad/s of the speed."""
    a.seconds += dt
    a.slip += travel - turned
    a.net += turned
    a.gained += gained
    if abs(speed) > STANDING_RAD_PER_S:
        a.way += abs(turned)
    if a.seconds >= _MOST_S or (a.seconds >= _LEAST_S and abs(speed) < STANDING_RAD_PER_S):
        _take_stretch(a, noise)
        leave_stretch(a)


@njit
def take_offset(a: Record, turned: float, variance: float, seconds: float) -> None:
    """Learn the speed's offset: a motor that stood for ``seconds`` has turned by ``turned`` rad (variance ``variance`` rad²)
    by its integrated speed."""
    weight = seconds * seconds / variance
    a.offset_weight += weight
    a.offset_sum -= weight * turned / seconds


@njit
def leave_stretch(a: Record) -> None:
    """Begin a new stretch, also after a missing sample."""
    a.seconds = a.slip = a.net = a.way = a.gained = 0.0


@njit
def forget_wander(a: Record) -> None:
    """Begin anew, because the sums so far belong to a speed with another offset."""
    leave_stretch(a)
    a.offset_weight = a.offset_sum = a.strayed = a.drift = a.rate = a.loss = a.unseen = 0.0
    a.found = False
    for i in range(_CAUSES):
        a.right[i] = 0.0
        for j in range(_CAUSES):
            a.normal[i, j] = 0.0


@njit
def _take_stretch(a, noise):
    variance = noise * noise * CYCLE_S * a.seconds + COUNTS_RAD * COUNTS_RAD + sq(_MISSED * a.way)
    keep = exp(-a.seconds / _KEPT_S)
    causes = a.half
    causes[_RATE], causes[_LOSS], causes[_GAIN], causes[_AGE] = a.seconds, a.way, a.net, a.gained
    for i in range(_CAUSES):
        a.right[i] = keep * a.right[i] + causes[i] * a.slip / variance
        for j in range(_CAUSES):
            a.normal[i, j] = keep * a.normal[i, j] + causes[i] * causes[j] / variance
    _factorise(a)
    loss_sigma = 1.0 / a.lower[_LOSS, _LOSS]
    loss = a.half[_LOSS] * loss_sigma
    rate = (a.half[_RATE] - a.lower[_LOSS, _RATE] * loss) / a.lower[_RATE, _RATE]
    rate_sigma = sqrt(1.0 + sq(a.lower[_LOSS, _RATE] * loss_sigma)) / a.lower[_RATE, _RATE]
    offset, offset_sigma = _offset(a, noise)
    a.strayed = keep * a.strayed + a.slip - offset * a.seconds
    apart = rate - offset
    apart_sigma = sqrt(rate_sigma * rate_sigma + offset_sigma * offset_sigma)
    a.drift = rate if abs(rate) > _LIKELY * rate_sigma else 0.0
    a.rate = apart if abs(apart) > _LIKELY * apart_sigma else 0.0
    a.loss = loss if abs(loss) > _LIKELY * loss_sigma else 0.0
    was, a.found = a.found, abs(apart) > _SURELY * apart_sigma or abs(loss) > _SURELY * loss_sigma
    if a.found and not was:
        a.unseen, a.strayed = a.strayed, 0.0
    if abs(apart) < _LIKE_BEFORE * apart_sigma:
        # The estimate of the rate renews itself in `_KEPT_S`, so it counts once in that time.
        weight = a.seconds / (_KEPT_S * rate_sigma * rate_sigma)
        a.offset_weight += weight
        a.offset_sum += weight * rate


@njit
def _offset(a, noise):
    """Drift that the speed's offset causes, rad/s, and its standard deviation."""
    keep = exp(-a.seconds / _OFFSET_CHANGES_S)
    a.offset_weight *= keep
    a.offset_sum *= keep
    weight = a.offset_weight + 1.0 / (sq(OFFSET_RAD_PER_S) + sq(_OFFSET_OF_NOISE * noise))
    return a.offset_sum / weight, 1.0 / sqrt(weight)


@njit
def _factorise(a):
    """Cholesky factor of the normal equations with what is possible, and their right side solved by it."""
    for i in range(_CAUSES):
        for j in range(i + 1):
            total = a.normal[i, j] + (_POSSIBLE[i] if i == j else 0.0)
            for k in range(j):
                total -= a.lower[i, k] * a.lower[j, k]
            a.lower[i, j] = sqrt(total) if i == j else total / a.lower[j, j]
    for i in range(_CAUSES):
        total = a.right[i]
        for k in range(i):
            total -= a.lower[i, k] * a.half[k]
        a.half[i] = total / a.lower[i, i]
