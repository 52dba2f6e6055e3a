"""A contact that is nearer than any stroke explains to the filter: pads that were knocked far in, or that drag.

Far from contact a force does not depend on the contact angle, so that a linearised filter there takes the torque of pads which
touch long before they should for whatever it can learn: an offset of the current. Such an offset is the same all the way; the
force of pads that are squeezed grows with it. So the contact is held to be nearer by a number of ways from the smallest that a
jump of the stiffness path does not reach to one at which the pads of an open brake drag. For each of them, what the torque
would show and what the first hypothesis would mistake for something else follow from that hypothesis's own gain, and the
likelihood from its innovations (Willsky, Jones, A generalized likelihood ratio approach to the detection and estimation of
jumps in linear systems, IEEE Trans. Automatic Control 21, 1976); the same for an offset of any size, beside which a nearer
contact must be the likelier.
"""

from math import exp, log, sqrt

import numpy as np

from emb_daemon.estimator.unknown import contact_jump, torque_offset
from emb_daemon.jit import Floats, Record, fields, njit, sq
from emb_daemon.models.fusion import CONTACT, FAST, NOISE, STATES
from emb_daemon.models.stiffness import characteristic_curve, travel_at

#: Number of ways. On the largest brakes they are then a tenth of a millimetre apart.
WAYS = 16
#: Logarithm of the odds that the contact is nearer by one of the ways since the last stop: once in three thousand stops.
NEARER_ODDS = -6.0
#: Least way, in standard deviations of a jump of the stiffness path, and share of the largest force with which an open brake
#: drags at the most.
_LEAST, _DRAGS = 2.0, 0.1
#: Log odds over those before from which there is evidence, which a rest does not end.
_SPEAKS = 4.0
#: Squared standard deviations beyond which an innovation counts as at them, and is not learned from.
_EDGE = 25.0
#: Largest gain of the log odds by one sample, as from two standard deviations: what takes a few samples is a sensor's fault or
#: a jolt, the force of pads grows over tens of them.
_MOST = 2.0

#: ``first`` and ``apart`` rad: the least way and the distance of two. Of each way: log ``odds`` over no change, ``force`` N
#: over the first hypothesis's, its ``slope`` N/rad, what that has ``mistaken`` for errors of its own, and its ``share``. Of an
#: offset of 1 N m: what the first hypothesis takes of it (``absorbed``), what the innovations ``told`` of the offset, as an
#: inverse variance, and the ``sum`` of them by it. ``lowered``: by how much odds count less than they are.
NEARER = np.dtype(
    [
        *fields("f8", "first apart"),
        *((name, "f8", (WAYS,)) for name in ("odds", "force", "slope", "share")),
        ("mistaken", "f8", (WAYS, STATES)),
        ("absorbed", "f8", (STATES,)),
        *fields("f8", "told sum lowered"),
    ],
    align=True,
)


@njit
def forget_nearer(n: Record) -> None:
    """Begin anew, without evidence."""
    for j in range(WAYS):
        n.odds[j] = n.force[j] = n.slope[j] = n.share[j] = 0.0
        for i in range(STATES):
            n.mistaken[j, i] = 0.0
    for i in range(STATES):
        n.absorbed[i] = 0.0
    n.told = n.sum = n.lowered = 0.0


@njit
def set_ways(n: Record, p: Record, clearance: float) -> None:
    """Set the ways of a brake with ``clearance`` rad of clearance."""
    n.first = _LEAST * contact_jump(p)
    most = max(clearance + min(travel_at(_DRAGS * p.maximum_force, p.curve), clearance), n.first)
    n.apart = (most - n.first) / (WAYS - 1)


@njit
def way(n: Record, j: int) -> float:
    """How much nearer (rad) the contact is by way number ``j``."""
    return n.first + n.apart * j


@njit
def best_nearer(n: Record) -> float:
    """Largest log evidence for one of the ways."""
    best = -np.inf
    for j in range(WAYS):
        best = max(best, n.odds[j])
    return best


@njit
def nearer_odds(n: Record) -> float:
    """Log odds of a nearer contact against none, comparable with those of other changes."""
    best, total = best_nearer(n), 0.0
    for j in range(WAYS):
        total += exp(n.odds[j] - best)
    return NEARER_ODDS + best + log(total / WAYS) - n.lowered


@njit
def offset_odds(n: Record, p: Record) -> float:
    """The same of an offset of the torque, of any size that a current sensor may jump by."""
    prior = sq(torque_offset(p))
    return NEARER_ODDS + 0.5 * (n.sum * n.sum / (n.told + 1.0 / prior) - log(1.0 + n.told * prior)) - n.lowered


@njit
def rest_nearer(n: Record) -> None:
    """The motor stands open: whatever may have changed has done so since."""
    if best_nearer(n) < _SPEAKS:
        forget_nearer(n)


@njit
def place_nearer(n: Record, x: float, curve: Floats, factor: float) -> None:
    """Set force and slope of all ways ``x`` rad past the believed contact."""
    here, _ = characteristic_curve(x, curve)
    for j in range(WAYS):
        there, slope = characteristic_curve(x + way(n, j) + n.mistaken[j, CONTACT], curve)
        n.force[j], n.slope[j] = factor * (there - here), factor * slope


@njit
def follow_nearer(
    n: Record, h: Floats, gain: Floats, leverage: float, innovation: float, variance: float, decay: float, noise_decay: float,
    doubted: float,
) -> None:  # fmt: skip
    """Weigh all ways, and an offset, by one innovation (N m) of the first hypothesis and its ``variance``; ``h`` and ``gain``:
    its sensitivity and P h' with which it has learned from that; ``decay`` of FAST and ``noise_decay`` of NOISE; ``doubted``:
    variance, (N m)^2, by which this torque tells less than that hypothesis takes it for."""
    scale, weight, square = 1.0 / variance, 1.0 / (variance + doubted), sq(innovation)
    learns = square < _EDGE * variance
    first = min(square * weight, _EDGE)
    for j in range(WAYS):
        m = n.mistaken[j]
        m[FAST] *= decay
        m[NOISE] *= noise_decay
        # What it mistakes for the contact angle is in the force already.
        left = leverage * n.force[j] + h[CONTACT] * m[CONTACT]
        for i in range(STATES):
            left -= h[i] * m[i]
        told = 0.5 * (first - min(sq(innovation - left) * weight, _EDGE))
        n.odds[j] += min(told, _MOST)
        if learns:
            for i in range(STATES):
                m[i] += gain[i] * scale * left
            # The first hypothesis's gain, made for its own slope, would overshoot on a steeper one.
            m[CONTACT] = min(max(m[CONTACT], -way(n, j)), way(n, j))
    left = 1.0
    n.absorbed[FAST] *= decay
    n.absorbed[NOISE] *= noise_decay
    for i in range(STATES):
        left -= h[i] * n.absorbed[i]
    if learns:
        n.told += left * left * weight
        n.sum += left * innovation * weight
        for i in range(STATES):
            n.absorbed[i] += gain[i] * scale * left


@njit
def nearer_force(n: Record) -> tuple[float, float]:
    """Force (N) over the first hypothesis's, and its standard deviation, if the contact is nearer; shares as the mixture left
    them."""
    total = mean = square = 0.0
    for j in range(WAYS):
        total += n.share[j]
        mean += n.share[j] * n.force[j]
        square += n.share[j] * (sq(n.force[j]) + sq(n.slope[j] * n.apart) / 12.0)
    if total <= 0.0:
        return 0.0, 0.0
    mean /= total
    return mean, sqrt(max(square / total - mean * mean, 0.0))


@njit
def unlearn_mistaken(n: Record, x: Floats) -> None:
    """Take from the errors ``x`` what the first hypothesis has mistaken; shares as the mixture left them."""
    total = 0.0
    for j in range(WAYS):
        total += n.share[j]
    for j in range(WAYS):
        for i in range(STATES):
            x[i] -= n.share[j] / total * n.mistaken[j, i]
