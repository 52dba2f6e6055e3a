"""Delay or lead of the current relative to the motion that it causes, and filters of either signal.

Angle and current come in two messages. A gateway, or another sampling instant, delays one by some cycles relative to the
other; another converter or tracking loop filters one of them. Wherever the torque changes, the torque balance is then wrong by
kilonewtons, which looks like another contact, stiffness or friction. While the pads are apart, the motor torque is that of
inertia and friction alone. Its changes are compared with those of the current in three ways: at several shifts in whole
cycles, where the least sum of squares and its two neighbours give a shift (Knapp and Carter, The generalized correlation
method for estimation of time delay, IEEE Trans. Acoustics, Speech and Signal Processing 24(4), 1976); with the change that a
first-order filter makes in the current, by linear regression; and with the current through several filters, because the motion
may have been filtered. The hypothesis that explains most is undone: the earlier signal is delayed or filtered like the other
one, and a filtered current is replaced by the input of its filter.

Of 24 phases with a current that is up to 12 ms late 14 fail without this and none with it, of 29 with a resolver that is one
or two cycles late 13 and 2 (`studies.silent grid --faults current_delayed,resolver_delayed --count 8 --seed 5`). Of 53 with
filtered currents and angles 26 fail where only shifts are undone, 16 with filters, and 8 if what the filter learned in
between is discarded as well (`estimator.rewind`; `--faults current_filtered,angle_filtered --count 8 --seed 63`).
"""

from math import exp, log

import numpy as np

from emb_daemon.jit import Record, fields, njit
from emb_daemon.wire.contract import CYCLE_S

#: Cycles by which a current may be early or late: sample, frame and gateway each a cycle.
EARLIEST, LATEST = 3, 4
_SHIFTS = EARLIEST + LATEST + 1
#: Longest time constant of a filter that is undone, cycles: undoing it multiplies white noise of a current by about one and a
#: half times this number.
#: Time constants of the filters through which the current is compared with the motion, an octave apart.
SLOWEST, _FILTERS = 12.0, (1.0, 2.0, 4.0, 8.0)
#: Conditions for a comparison: least range of the torque by motion, in standard deviations of a torque, and least range of the
#: angle within the stored samples, rad, which noise does not reach. A shift of one cycle then multiplies the sum of squares by
#: about twenty.
_CLEAR, _MOVED_RAD = 6.0, 0.05
#: Informative samples over which the leaky sums forget: a few strokes, so that a change while driving is found in spite of
#: earlier samples. Of 34 phases with a filtered current (`studies.silent grid --faults current_filtered --count 10 --seed 61`)
#: 11 fail with 100. Least number of informative samples for a decision: one stroke has as many.
_KEPT, _ENOUGH = 20.0, 6.0
#: Least shift and least time constant that are undone, cycles. Half a cycle is within the estimate's tolerance, and
#: interpolation costs as much; a current that is late by a third of a cycle looks like a filter of that time constant.
_WORTH, _WORTH_SLOW = 0.6, 0.5
#: RMS difference between the changes of both torques, in standard deviations of one torque, from which a shift or a filter is
#: searched for. By noise alone it is 1.4. For a shift it must be three times as large, because some shift always explains
#: much of the noise; for a filter, which explains little of it, somewhat more than 1.4. The shortest filter that is undone
#: makes 2 if changes are just large enough to be compared.
_BEYOND, _BEYOND_SLOW = 4.2, 1.75
#: Least share of the sum of squares that a shift, or a filter of the current, must explain: a correct one leaves a twentieth
#: to a fifth; with friction unknown to the calibration, such as grease at -20 degC, a wrong one has explained half. The same
#: for a filter of the motion: a current sensor with twice the gain looks like such a filter, which explains two thirds.
_EXPLAINS, _EXPLAINS_MOTION = 0.6, 0.8
#: Share of the changes' sum of squares, beyond that of noise, by which both may differ if they are part of a cycle apart:
#: twice the square of that part, if changes follow each other at random. 0 to 0.35 in a drive with a third of a cycle, 0.5 and
#: more after a stroke with a filter of five cycles, which must not pass for a delay (tests/test_rewind.py).
_PART = 0.4
#: Cycles for which a change of torque remains in averaged torques (`models.contact`).
_SETTLED = 16.0
#: Stored samples, one more than the largest shift. Range of the angle over these samples below which the motor counts as
#: standing, rad: three counts of a 12-bit resolver.
_KEPT_SAMPLES, _STANDS_RAD = LATEST + 2, 0.005

#: Torques by the last cycles, N m, the newest first: ``by_current``, ``by_motion``, which inertia and friction need, and the
#: ``friction`` of that. Leaky sums of squares, (N m)^2: of changes in a cycle by current and by motion (``current_square``,
#: ``motion_square``), of their difference at each shift (``shift_square``) and with each filter (``low_pass_square``), of
#: noise (``noise_square``), of second differences by the current (``curvature_square``), and of their product with the
#: difference of both changes (``curvature_product``). ``consecutive`` cycles without a gap; ``informative`` ones, in which the
#: torque by motion changed enough, leaky; ``unsettled``: cycles until the last of those has no effect. Found, not yet undone:
#: ``delay_left``, delay of the current in cycles, negative for a delay of the motion, and ``lag_left``, time constant of a
#: filter of the current in cycles, negative for one of the motion. Undone: ``delay`` and ``lag``, with the same signs.
#: ``filtered`` A: the last current as received or, if the motion is filtered, through that filter. ``low_pass`` N m: torque by
#: the current less friction through each filter, and its change in this cycle (``low_pass_change``). The last samples: ``age``
#: s, ``angle``, ``speed``, ``current``.
ALIGNMENT = np.dtype(
    [
        *((name, "f8", (_SHIFTS + 1,)) for name in ("by_current", "by_motion", "friction")),
        ("shift_square", "f8", (_SHIFTS,)),
        *fields("f8", "current_square motion_square noise_square curvature_square curvature_product"),
        *fields("f8", "consecutive informative unsettled delay_left delay lag_left lag filtered"),
        *((name, "f8", (len(_FILTERS),)) for name in ("low_pass", "low_pass_change", "low_pass_square")),
        *((name, "f8", (_KEPT_SAMPLES,)) for name in ("age", "angle", "speed", "current")),
    ],
    align=True,
)


@njit
def align(a: Record, m: Record) -> bool:
    """Replace the motion or the current of SAMPLE ``m``, whichever is early, by its value at the time of the other, and a
    filtered current by the input of its filter. Returns whether the correction has just changed."""
    _keep(a, m)
    a.unsettled = max(a.unsettled - 1.0, 0.0)
    found = out_of_step(a) and _range(a.angle) < _STANDS_RAD
    if found:
        a.delay = min(max(a.delay + a.delay_left, -EARLIEST), LATEST)
        a.lag = min(max(a.lag + a.lag_left, -SLOWEST), SLOWEST)
        _forget(a)
    if a.delay > 0.0:
        m.angle, m.speed = _at(a.age, a.angle, a.delay * CYCLE_S), _at(a.age, a.speed, a.delay * CYCLE_S)
    elif a.delay < 0.0:
        m.current_q = _at(a.age, a.current, -a.delay * CYCLE_S)
    _filter(a, m)
    return found


@njit
def _filter(a, m):
    current, dt = m.current_q, a.age[1]
    if a.lag > 0.0 and dt > 0.0:
        m.current_q += a.lag * CYCLE_S * (current - a.filtered) / dt
    elif a.lag < 0.0:
        kept = exp(log(a.lag / (a.lag - 1.0)) * dt / CYCLE_S)
        current = m.current_q = current + kept * (a.filtered - current)
    a.filtered = current


@njit
def out_of_step(a: Record) -> bool:
    """Whether a delay or a filter was found that is not yet undone."""
    return a.delay_left != 0.0 or a.lag_left != 0.0


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
    """Value ``age`` s ago, linear between samples."""
    i = 1
    while i < len(ages) - 1 and ages[i] < age:
        i += 1
    share = min(max((age - ages[i - 1]) / (ages[i] - ages[i - 1]), 0.0), 1.0)
    return values[i - 1] + share * (values[i] - values[i - 1])


@njit
def compare(a: Record, by_current: float, by_motion: float, friction: float, noise: float) -> None:
    """Take one cycle's torque by the current and by the motion, and the friction of the latter, N m, while the pads are apart.

    ``noise`` N m: standard deviation of their difference, by the noise of the speed and by the tolerated fraction of a cycle
    of delay."""
    for i in range(_SHIFTS, 0, -1):
        a.by_current[i], a.by_motion[i], a.friction[i] = a.by_current[i - 1], a.by_motion[i - 1], a.friction[i - 1]
    a.by_current[0], a.by_motion[0], a.friction[0] = by_current, by_motion, friction
    a.consecutive += 1.0
    _low_pass(a)
    if a.consecutive <= _SHIFTS or _range(a.by_motion) < _CLEAR * noise or _range(a.angle) < _MOVED_RAD:
        return
    a.unsettled = _SETTLED
    a.informative += 1.0 - a.informative / _KEPT
    # Changes in a cycle are compared: friction that the calibration does not know changes slowly.
    changed = a.by_current[EARLIEST] - a.by_current[EARLIEST + 1]
    moved = a.by_motion[EARLIEST] - a.by_motion[EARLIEST + 1]
    curved = changed - (a.by_current[EARLIEST + 1] - a.by_current[EARLIEST + 2])
    a.current_square = _add(a.current_square, changed * changed)
    a.motion_square = _add(a.motion_square, moved * moved)
    a.noise_square = _add(a.noise_square, noise * noise)
    a.curvature_square = _add(a.curvature_square, curved * curved)
    a.curvature_product = _add(a.curvature_product, (moved - changed) * curved)
    for i in range(_SHIFTS):
        off = changed - (a.by_motion[i] - a.by_motion[i + 1])
        a.shift_square[i] = _add(a.shift_square[i], off * off)
    for i in range(len(_FILTERS)):
        off = a.low_pass_change[i] - (moved - (a.friction[EARLIEST] - a.friction[EARLIEST + 1]))
        a.low_pass_square[i] = _add(a.low_pass_square[i], off * off)
    a.delay_left, a.lag_left = _found(a)


@njit
def _low_pass(a):
    """The torque that accelerates the motor, through each filter. Friction does not go through a filter of the motion."""
    accelerates = a.by_current[EARLIEST] - a.friction[EARLIEST]
    for i in range(len(_FILTERS)):
        if a.consecutive <= EARLIEST + 1:
            a.low_pass[i] = accelerates
        a.low_pass_change[i] = (accelerates - a.low_pass[i]) / (1.0 + _FILTERS[i])
        a.low_pass[i] += a.low_pass_change[i]


@njit
def _add(total, term):
    return total + term - total / _KEPT


@njit
def _found(a):
    """Delay and time constant, cycles, at most one of them not 0: the one that explains most, if that is enough."""
    apart = a.shift_square[EARLIEST]
    if a.informative < _ENOUGH or apart < _BEYOND_SLOW * _BEYOND_SLOW * a.noise_square:
        return 0.0, 0.0
    # A shift or filter must explain more than zero current would: a dead current sensor is neither late nor filtered.
    place, least = _least(a.shift_square)
    left, shift, slow = least / min(apart, a.current_square), place - EARLIEST, 0.0
    if a.curvature_product > 0.0:
        undone = 1.0 - a.curvature_product * a.curvature_product / (a.curvature_square * apart)
        if undone < left:
            left, slow = undone, a.curvature_product / a.curvature_square
    place, least = _least(a.low_pass_square)
    filtered = least / min(apart, a.motion_square)
    if filtered < left and filtered < 1.0 - _EXPLAINS_MOTION:
        left, slow = filtered, -_FILTERS[0] * exp(log(2.0) * place)
    if left > 1.0 - _EXPLAINS:
        return 0.0, 0.0
    if slow != 0.0:
        return 0.0, slow if abs(slow) > _WORTH_SLOW else 0.0
    return shift if abs(shift) > _WORTH and apart > _BEYOND * _BEYOND * a.noise_square else 0.0, 0.0


@njit
def _least(squares):
    """Place of the least of several, and its size, between the whole ones by a parabola."""
    best = 0
    for i in range(1, len(squares)):
        if squares[i] < squares[best]:
            best = i
    place, least = float(best), squares[best]
    if 0 < best < len(squares) - 1:
        before, after = squares[best - 1], squares[best + 1]
        curvature = before - 2.0 * least + after
        if curvature > 0.0:
            place += 0.5 * (before - after) / curvature
            least -= 0.125 * (before - after) * (before - after) / curvature
    return place, least


@njit
def interrupt(a: Record) -> None:
    """Begin anew after a sample that is missing or not to be compared."""
    a.consecutive = 0.0


@njit
def _forget(a):
    """Compare anew: the sums are of signals that are now changed."""
    a.delay_left = a.lag_left = a.informative = a.consecutive = 0.0
    a.current_square = a.motion_square = a.noise_square = a.curvature_square = a.curvature_product = 0.0
    for i in range(_SHIFTS):
        a.shift_square[i] = 0.0
    for i in range(len(_FILTERS)):
        a.low_pass_square[i] = 0.0


@njit
def at_bound(a: Record) -> bool:
    """Whether the delay or filter may be larger than can be undone."""
    return a.delay in (-EARLIEST, LATEST) or abs(a.lag) == SLOWEST


@njit
def in_step(a: Record) -> bool:
    """Whether the changes of both torques were found to coincide, but for part of a cycle."""
    changes = max(a.current_square, a.motion_square)
    coincide = a.shift_square[EARLIEST] < 2.0 * a.noise_square + _PART * changes
    return coincide and a.informative >= _ENOUGH and not out_of_step(a)


@njit
def aligned(a: Record) -> bool:
    """Whether the present torque may be used before the contact angle is known: either no recent change of torque is in it, or
    the changes of both torques were found to coincide."""
    return not out_of_step(a) and (a.informative >= _ENOUGH or a.unsettled == 0.0)
