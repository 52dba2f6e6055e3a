"""Time by which the current is late, or early, beside the motion that it causes.

Angle and current travel in two messages. A gateway, or another sampling instant, moves one against the other by some cycles;
where the torque changes, the balance of torques then fails by kilonewtons, which pass for another contact, stiffness or
friction. While the pads are apart, inertia and friction alone need a torque. Its changes are compared with the current's at
several shifts in whole cycles; the least sum of squares and its two neighbours give the shift (Knapp and Carter, The
generalized correlation method for estimation of time delay, IEEE Trans. Acoustics, Speech and Signal Processing 24(4), 1976).
Then the earlier of both is delayed as the other is. Of 24 phases with a current that is up to 12 ms late 14 fail without this
and none with it, of 29 with a resolver that is one or two cycles late 13 and 2 (`studies.silent grid --faults
current_delayed,resolver_delayed --count 8 --seed 5`).
"""

import numpy as np

from emb_daemon.jit import Record, fields, njit
from emb_daemon.wire.contract import CYCLE_S

#: Cycles by which a current may be early or late: sample, frame and gateway each a cycle.
EARLIEST, LATEST = 3, 4
_SHIFTS = EARLIEST + LATEST + 1
#: Change of the needed torque that tells shifts apart, in standard deviations of a torque; way within the samples that are
#: kept which noise of angle or speed does not make, rad. Without a fault one cycle then makes some twenty times the sum of
#: squares.
_CLEAR, _MOVED_RAD = 6.0, 0.05
#: Samples that tell, over which the sums forget: some stops. Fewest of them that are enough: one stroke has as many.
_KEPT, _ENOUGH = 100.0, 6.0
#: Least shift that is taken out, cycles. Half of one is within what the estimate allows for, and interpolation costs as much.
_WORTH = 0.6
#: Standard deviations of a torque that its changes must be off by on the average: three of a difference's.
_BEYOND = 4.2
#: Least part of the sum of squares that a shift must explain: a right one leaves a twentieth, and friction that the
#: calibration does not know, as of grease at -20 degC, has made a wrong one explain half.
_EXPLAINS = 0.6
#: Cycles after a change of torque in which it still counts where torques are averaged (`models.contact`).
_SETTLED = 16.0
#: Samples that are kept, one more than the largest shift. A motor stands that moved by less than three counts of a resolver of
#: 12 bit meanwhile, rad.
_KEPT_SAMPLES, _STANDS_RAD = LATEST + 2, 0.005

#: Torque ``shown`` by the current and ``needed`` by the motion, N m, the newest first; sums of squares, (N m)^2, by shift, of
#: what they change by beside each other, of what the shown one ``changed`` by, and of noise (``noisy``). ``heard`` cycles
#: without a gap, ``told`` of them that tell, ``restless``: those left until the last is settled. ``late`` cycles: by which the
#: current is behind, beyond the ``delay`` cycles that are taken out; negative where the motion is. The last samples: ``age``
#: s, ``angle``, ``speed``, ``current``.
ALIGNMENT = np.dtype(
    [
        *((name, "f8", (_SHIFTS + 1,)) for name in ("shown", "needed")),
        ("square", "f8", (_SHIFTS,)),
        *fields("f8", "changed noisy heard told restless late delay"),
        *((name, "f8", (_KEPT_SAMPLES,)) for name in ("age", "angle", "speed", "current")),
    ],
    align=True,
)


@njit
def align(a: Record, m: Record) -> None:
    """Replace motion or current of SAMPLE ``m``, whichever is early, by what belongs to the other."""
    _keep(a, m)
    a.restless = max(a.restless - 1.0, 0.0)
    if a.late != 0.0 and _range(a.angle) < _STANDS_RAD:
        a.delay = min(max(a.delay + a.late, -EARLIEST), LATEST)
        _forget(a)
    if a.delay > 0.0:
        m.angle, m.speed = _at(a.age, a.angle, a.delay * CYCLE_S), _at(a.age, a.speed, a.delay * CYCLE_S)
    elif a.delay < 0.0:
        m.current_q = _at(a.age, a.current, -a.delay * CYCLE_S)


@njit
def _keep(a, m):
    if a.age[1] == 0.0:
        for i in range(_KEPT_SAMPLES):
            a.age[i], a.angle[i], a.speed[i], a.current[i] = i * CYCLE_S, m.angle, m.speed, m.current_q
        return
    for i in range(_KEPT_SAMPLES - 1, 0, -1):
        a.age[i], a.angle[i], a.speed[i], a.current[i] = a.age[i - 1] + m.dt, a.angle[i - 1], a.speed[i - 1], a.current[i - 1]
    a.age[0], a.angle[0], a.speed[0], a.current[0] = 0.0, m.angle, m.speed, m.current_q


@njit
def _range(values):
    least = most = values[0]
    for value in values:
        least, most = min(least, value), max(most, value)
    return most - least


@njit
def _at(ages, values, age):
    """Value of ``age`` s ago, between samples."""
    i = 1
    while i < len(ages) - 1 and ages[i] < age:
        i += 1
    share = min(max((age - ages[i - 1]) / (ages[i] - ages[i - 1]), 0.0), 1.0)
    return values[i - 1] + share * (values[i] - values[i - 1])


@njit
def compare(a: Record, shown: float, needed: float, noise: float) -> None:
    """Take one cycle's torque by the current and by the motion while the pads are apart, N m; ``noise`` N m: standard
    deviation by which they may differ from noise of the speed and the part of a cycle that is allowed for."""
    for i in range(_SHIFTS, 0, -1):
        a.shown[i], a.needed[i] = a.shown[i - 1], a.needed[i - 1]
    a.shown[0], a.needed[0] = shown, needed
    a.heard += 1.0
    if a.heard <= _SHIFTS or _range(a.needed) < _CLEAR * noise or _range(a.angle) < _MOVED_RAD:
        return
    a.restless = _SETTLED
    a.told += 1.0 - a.told / _KEPT
    # By what they change in a cycle: friction that the calibration does not know changes slowly.
    changed = a.shown[EARLIEST] - a.shown[EARLIEST + 1]
    a.changed, a.noisy = _add(a.changed, changed), _add(a.noisy, _BEYOND * noise)
    for i in range(_SHIFTS):
        a.square[i] = _add(a.square[i], changed - (a.needed[i] - a.needed[i + 1]))
    a.late = _least(a)


@njit
def _add(total, off):
    return total + off * off - total / _KEPT


@njit
def _least(a):
    """Shift of the least sum of squares, cycles, between the whole ones by a parabola; 0 where it explains too little."""
    best = 0
    for i in range(1, _SHIFTS):
        if a.square[i] < a.square[best]:
            best = i
    shift, least = float(best - EARLIEST), a.square[best]
    if 0 < best < _SHIFTS - 1:
        before, after = a.square[best - 1], a.square[best + 1]
        curvature = before - 2.0 * least + after
        if curvature > 0.0:
            shift += 0.5 * (before - after) / curvature
            least -= 0.125 * (before - after) * (before - after) / curvature
    # A current that shows nothing is explained by no shift.
    tells = (
        a.told >= _ENOUGH and a.square[EARLIEST] > a.noisy and least < (1.0 - _EXPLAINS) * min(a.square[EARLIEST], a.changed)
    )
    return shift if tells and abs(shift) > _WORTH else 0.0


@njit
def interrupt(a: Record) -> None:
    """Begin anew after a sample that is missing or not to be compared."""
    a.heard = 0.0


@njit
def _forget(a):
    """Compare anew: what was seen so far was of other signals."""
    a.late = a.told = a.heard = a.changed = a.noisy = 0.0
    for i in range(_SHIFTS):
        a.square[i] = 0.0


@njit
def at_bound(a: Record) -> bool:
    """Whether current and motion may be further apart than is taken out."""
    return a.delay in (-EARLIEST, LATEST)


@njit
def aligned(a: Record) -> bool:
    """Whether a torque of now may be used before the contact angle is known: nothing has changed of late, or the changes were
    seen to belong together."""
    return a.late == 0.0 and (a.told >= _ENOUGH or a.restless == 0.0)
