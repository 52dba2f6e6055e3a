"""Plausibility between the force paths: whether they contradict each other, and which of them is wrong.

The filter's normalised innovation is the difference between the torque and what the stiffness path and the learned errors
predict, in its standard deviations. Its squares, less what model errors account for, are summed one-sidedly (Page, "Continuous
inspection schemes", Biometrika 41, 1954): a few large differences or many smaller ones raise the alarm, and as many good
samples end it. Which path is wrong is decided by the sensor that only one of them uses:

    resolver   angle and speed repeat to the bit although torque or speed must turn the motor, the angle stands while the
               torque swings up and down by more than friction at rest can carry, or the angle does not follow the speed
    current    repeats to the bit, or asks for force while the pads do not touch

Otherwise it is undecided: the estimate goes on with the stiffness path, and its standard deviation covers the difference.
"""

from math import exp, log, sqrt

import numpy as np

from emb_daemon.jit import Record, fields, hypot, njit

#: ``contradiction``: summed squares. ``apart`` rad: angle less integrated speed, leaky. ``still``, ``idle``: samples in which
#: angle and speed, or the current, repeated to the bit. ``alike``: samples in which the angle moved as the integrated speed.
#: ``flickered``: samples in which the speed changed while the angle stood; ``current_flickered``: in which the current
#: changed, ``current_stepped`` of them by ``current_step`` A, the least so far; ``current_repeated``: in which it repeated
#: while the motor turned, but not for so long that it was frozen. ``idled``: ``idle`` as of a fine current, which repeats in
#: one sample of five. ``frozen_s``: time for which the resolver has been implausible. ``verdict``: as below. ``torque_mean``,
#: ``torque_variance``: motor torque (N m), smoothed; ``averaged``: whether there was one; ``steady``: the same less what
#: accelerates the motor. The angle has stood at ``held_angle`` (rad) for ``held`` samples; meanwhile ``steady`` swung
#: ``swings`` times, the last time upwards (``swing`` 1) or downwards (-1); ``held_low``, ``held_high``: its least and largest
#: value since the last swing. ``pinned``: samples in a row in which the current repeated to the bit while the motor turned;
#: ``limit`` A: of either sign, as far as its sensor then goes, 0 if unknown; ``largest`` A: of either sign, so far;
#: ``coarse``: whether a limit was exceeded. ``due_acceleration`` (rad/s²), ``due_speed`` (rad/s), ``due_angle`` (rad): motion
#: that the torque must have caused since the angle stands.
PLAUSIBILITY = np.dtype(
    [
        ("contradiction", "f8"),
        ("verdict", "i8"),
        ("apart", "f8"),
        *fields("i8", "still idle alike flickered current_flickered current_stepped current_repeated"),
        *fields("f8", "idled current current_step frozen_s"),
        ("averaged", "?"),
        *fields("f8", "torque_mean torque_variance steady held_angle held_low held_high due_acceleration due_speed due_angle"),
        *fields("i8", "held swing swings pinned"),
        *fields("f8", "limit largest"),
        ("coarse", "?"),
    ],
    align=True,
)

#: What `watch` finds: both paths agree, the path that is wrong, or that one of them is wrong but not which.
AGREE, TORQUE_WRONG, TORQUE_FROZEN, STIFFNESS_WRONG, UNDECIDED = range(5)

#: Squared normalised innovation that is attributed to model errors, the most that one sample counts, and the sums that raise
#: and end the alarm. Innovations of twelve standard deviations raise it within five samples, of six within forty, of four
#: never. No log of the simulated rig, with effects that its calibration does not know, reaches a third of the alarm.
_TOLERATED, _COUNTED, _RAISE, _CLEAR = 20.0, 144.0, 600.0, 150.0
#: Factor on the sum that raises the alarm while the contact angle is not confirmed.
_UNCONFIRMED = 5.0
#: Number of samples that repeat to the bit although the torque should change them, or although the speed is not zero, from
#: which the sensor counts as frozen.
_REPEATED, _NEVER_REPEATED = 8, 50
#: A speed that changed in `_FLICKERED` samples while the angle stood is noise, which does not repeat to the bit `_FROZEN`
#: times in a row: with one repetition in five by chance, once in 1e8.
_FLICKERED, _FROZEN = 50, 12
#: Share of samples in which a fine current repeats to the bit. One in steps that are coarse beside its noise does more often,
#: and to repeat on and on is as rare for it only after so many times more samples as the logarithms of both shares say.
_BY_CHANCE = 0.2
#: Share of a step of the current that a smaller step is below, whatever the rounding of both.
_LESS = 0.75
#: Time constant over which angle and integrated speed are compared (s), and difference (rad) that is a fault, in addition to
#: what a signal delay of `_DELAY_S` causes. A resolver is used again after `_RETURNED` samples in which the angle moved and
#: followed the speed within `_ALIKE_RAD`.
_COMPARED_S, _APART_RAD, _DELAY_S = 0.1, 0.6, 0.01
_RETURNED, _ALIKE_RAD = 25, 0.05
#: Share by which friction at rest may exceed what sliding takes.
_STICTION = 0.3
#: Standard deviations of a smoothed torque that it does not swing by in an hour, one hold in 2000; and of what is the same all
#: the time, or all the turn of a disc.
_CERTAIN, _SURELY = 10.0, 3.0
#: Change below which an angle counts as standing, rad: three counts of a resolver of 12 bit; samples whose mean it stands at,
#: because the one that left the last such place is the farthest out of a noisy angle; and factor on the share of friction that
#: may turn over within that change, over the calibration's.
_STANDS_RAD, _CENTRED, _PRESLIDING_TURNS = 0.005, 10, 2.0
#: Samples of a motor that turns in which the current repeats to the bit: its sensor goes no further. By chance, at one
#: repetition in five, once in 3000; at the largest current so far fewer are as rare, and a motor that is asked to turn needs
#: that for some cycles only. A sensor that has gone beyond such a limit repeats more often than that.
_PINNED, _PINNED_AT_LARGEST = 5, 3
#: Angle by which the torque must have turned the motor, rad, to contradict an angle that stands: eight times what a motor
#: would get that turns back between two samples, if it were taken to start from rest. Torque beyond friction that noise may
#: cause, in standard deviations: one sample of 700 has more, and three in a row are needed.
_DUE_RAD, BEYOND_CHANCE = 10.0 * _STANDS_RAD, 3.0
#: Distance from the contact angle, in its standard deviations, from which the pads certainly do not touch.
_CLEAR_OF_CONTACT = 6.0
#: Time over which torque is averaged when it must do without the resolver, s.
_AVERAGED_S = 0.04


@njit
def watch(
    c: Record, m: Record, angle_before: float, speed_before: float, turned: float, past_contact: float, contact_sigma: float,
    confirmed: bool,
) -> int:  # fmt: skip
    """Judge one sample that came within a cycle of the last, before it is fused; ``c.contradiction`` is of those before.

    Args:
        c: PLAUSIBILITY record.
        m: SAMPLE record.
        angle_before, speed_before: rad and rad/s of the last sample; turned: rad since then by the speed.
        past_contact, contact_sigma: rad past the estimated contact angle, and its standard deviation.
        confirmed: whether the contact angle is confirmed. Until then `models.contact` decides first.

    Returns:
        The verdict, also kept in ``c.verdict``.
    """
    travel = m.angle - angle_before
    delay = _DELAY_S * abs(m.speed)
    _count_repetitions(c, m, travel, travel - turned, delay, speed_before)
    was = c.verdict
    if was == STIFFNESS_WRONG:
        c.frozen_s += m.dt
        if c.alike >= _RETURNED:
            # The sum was the resolver's fault, and must not count against the current.
            believe_resolver(c)
        return c.verdict
    patience = 1.0 if confirmed or max(c.still, c.idled) >= _REPEATED else _UNCONFIRMED
    disagree = c.contradiction > (patience * _RAISE if was == AGREE else _CLEAR)
    if travel == 0.0 and m.speed != speed_before:
        c.flickered += 1
    repeated = c.still >= (_FROZEN if c.flickered >= _FLICKERED else _NEVER_REPEATED)
    repeated = repeated and (m.speed != 0.0 or c.flickered >= _FLICKERED)
    if repeated or abs(c.apart) > _APART_RAD + delay or (disagree and c.still >= _REPEATED and c.idled < _REPEATED):
        c.verdict = STIFFNESS_WRONG
        c.frozen_s = c.still * m.dt
        c.alike = 0
        return c.verdict
    repeated = c.idled >= _FROZEN and c.current_flickered >= _FLICKERED and c.still < _FROZEN
    if repeated or (m.has_current and 0.0 < c.limit == abs(m.current_q)):
        c.verdict = TORQUE_FROZEN
    elif not disagree:
        c.verdict = AGREE
    elif c.idled >= _REPEATED and c.still < _REPEATED:
        c.verdict = TORQUE_FROZEN
    elif was in (TORQUE_WRONG, TORQUE_FROZEN) or past_contact < -_CLEAR_OF_CONTACT * contact_sigma:
        c.verdict = TORQUE_WRONG
    else:
        c.verdict = UNDECIDED
    return c.verdict


@njit
def _count_repetitions(c, m, travel, step, delay, speed_before):
    """Update what is known of each sensor alone: how long it repeats its value, and whether angle and speed agree. ``travel``
    rad of the angle, ``step`` rad beyond the integrated speed, ``delay`` rad that a late angle explains."""
    c.apart = c.apart * exp(-m.dt / _COMPARED_S) + step
    if abs(step) > _ALIKE_RAD + delay:
        c.alike = 0
    elif abs(travel) > _STANDS_RAD:
        c.alike += 1
    c.still = c.still + 1 if travel == 0.0 and m.speed == speed_before else 0
    if m.has_current:
        c.idle = c.idle + 1 if m.current_q == c.current else 0
        c.current_flickered += c.idle == 0
        _count_steps(c, abs(m.current_q - c.current))
        c.current_repeated += c.idle > 0 and c.idled < _FROZEN and c.still < _FROZEN
        stretch = _stretch(c)
        c.idled = c.idle / stretch
        c.current = m.current_q
        _look_for_limit(c, m.current_q, travel, stretch)


@njit
def _count_steps(c, change):
    """Count what changes the current, by ``change`` A, as little as anything did."""
    if change == 0.0:
        return
    if c.current_step == 0.0 or change < _LESS * c.current_step:
        c.current_step, c.current_stepped = change, 0
    c.current_stepped += _LESS * change < c.current_step


@njit
def _stretch(c):
    """Factor on the number of repetitions that are as rare for this current as for a fine one. One that repeats because its
    steps are coarse mostly changes by one step; one whose sender has no newer value changes by many."""
    if c.current_flickered < _FLICKERED or c.current_stepped < 0.5 * c.current_flickered:
        return 1.0
    share = c.current_repeated / (c.current_repeated + c.current_flickered)
    return log(_BY_CHANCE) / log(max(share, _BY_CHANCE))


@njit
def _look_for_limit(c, current, travel, stretch):
    """Learn the current (A) beyond which the sensor does not measure: one that repeats to the bit while the motor turns. A
    limit that a later ``current`` exceeds is forgotten, and the sensor is coarse."""
    c.pinned = c.pinned + 1 if c.idle > 0 and abs(travel) > _STANDS_RAD else 0
    needed = _PINNED if c.coarse or abs(current) < c.largest else _PINNED_AT_LARGEST
    c.largest = max(c.largest, abs(current))
    if c.pinned >= needed * stretch and c.current_flickered >= _FLICKERED:
        c.limit = abs(current)
    elif abs(current) > c.limit:
        c.coarse = c.coarse or c.limit > 0.0
        c.limit = 0.0


@njit
def frozen(c: Record) -> bool:
    """Whether one sensor repeats its value while the other changes: then their difference is no evidence about the contact
    angle."""
    return c.verdict in (STIFFNESS_WRONG, TORQUE_FROZEN) or (c.still > 0) != (c.idled >= 1.0) or c.still < _REPEATED <= c.idled


@njit
def beyond_friction(
    torque: float, force: float, sigma: float, gear_gain: float, load_friction: float, offset_friction: float
) -> float:
    """Torque that neither the clamp force ``force`` (N) nor friction at rest can carry, over its standard deviation ``sigma``
    (N m); where it is not zero, the motor turns."""
    band = (1.0 + _STICTION) * (offset_friction + load_friction * force)
    return max(abs(torque - gear_gain * force) - band, 0.0) / sigma


@njit
def steady(c: Record, torque: float, accelerating: float, dt: float) -> None:
    """Smooth the motor's ``torque`` less what is ``accelerating`` it, N m. Its mean alone goes on to rise for a while when the
    motor stops."""
    c.steady += (1.0 - exp(-dt / _AVERAGED_S)) * (torque - accelerating - c.steady)


@njit
def stays(c: Record, angle: float) -> bool:
    """Whether the motor angle ``angle``, rad, is where it stood at the last sample, whatever it flickers by."""
    return abs(angle - c.held_angle) <= _STANDS_RAD


@njit
def stands(c: Record, angle: float) -> bool:
    """Whether the motor angle ``angle``, rad, stands."""
    if stays(c, angle):
        c.held += 1
        if c.held < _CENTRED:
            c.held_angle += (angle - c.held_angle) / (c.held + 1)
        return True
    c.held_angle, c.held_low, c.held_high = angle, c.steady, c.steady
    c.held = c.swing = c.swings = 0
    c.due_acceleration = c.due_speed = c.due_angle = 0.0
    return False


@njit
def hold(
    c: Record, force: float, sigma: float, gear_gain: float, load_friction: float, offset_friction: float,
    friction_sigma: float, load_sigma: float, presliding_angle: float,
) -> int:  # fmt: skip
    """How often the motor must have turned although the angle stands: number of times that the smoothed torque rose or fell by
    more than friction at rest can carry, from fully one way to fully the other, under a clamp force of ``force`` N. Of the
    friction that the load adds only what turns over within a resolver's counts is subtracted. A single swing may be an offset
    of the current, a swing back cannot.

    Standard deviations, N m: ``sigma`` of the smoothed torque by its noise, ``friction_sigma`` of the friction, ``load_sigma``
    of what the load changes by while the motor stands; ``presliding_angle`` rad."""
    c.held_low, c.held_high = min(c.held_low, c.steady), max(c.held_high, c.steady)
    turned_over = 1.0 - exp(-_PRESLIDING_TURNS * _STANDS_RAD / presliding_angle)
    # The offset friction (seals, bearings) may turn over in full without a motion; what the load adds turns over with the
    # angle.
    loaded = turned_over * load_friction * max(force, c.held_high / gear_gain)
    carried = 2.0 * (1.0 + _STICTION) * (offset_friction + loaded)
    lasting = hypot(2.0 * friction_sigma, load_sigma)
    if c.held_high - c.held_low > carried + _SURELY * lasting + _CERTAIN * sigma:
        way = 1 if c.steady > 0.5 * (c.held_low + c.held_high) else -1
        c.swings += way != c.swing
        c.swing = way
        c.held_low = c.held_high = c.steady
    return c.swings


@njit
def due(c: Record, acceleration: float, delay: float, dt: float) -> bool:
    """Whether the motor must have turned although the angle, which is ``delay`` s late, stands; ``acceleration``, rad/s²: what
    the torque causes at least."""
    # The torque may have begun just before this sample: only what it also did at the last one has lasted a cycle.
    lasting = min(acceleration, c.due_acceleration)
    c.due_acceleration = acceleration
    if c.held < 2:
        # A motor that arrives and turns back within a sample is where it was before, at any acceleration.
        return False
    c.due_speed = c.due_speed + lasting * dt if lasting > 0.0 else 0.0
    c.due_angle += c.due_speed * dt
    return c.due_angle - c.due_speed * delay > _DUE_RAD


@njit
def believe_resolver(c: Record) -> None:
    """Use the resolver again: its fault is over, or was none."""
    c.contradiction = c.apart = c.frozen_s = 0.0
    c.verdict = AGREE


@njit
def disbelieve_resolver(c: Record) -> None:
    """Do not use the resolver until its angle again follows the speed."""
    if c.verdict != STIFFNESS_WRONG:
        c.verdict, c.alike, c.frozen_s = STIFFNESS_WRONG, 0, _AVERAGED_S


@njit
def count_contradiction(c: Record, ratio: float) -> None:
    """Add one normalised innovation to the sum of contradictions; NaN, none was made, adds nothing."""
    if np.isfinite(ratio):
        total = max(c.contradiction + min(ratio * ratio, _COUNTED) - _TOLERATED, 0.0)
        c.contradiction = min(total, 1.5 * _UNCONFIRMED * _RAISE)


@njit
def smoothed_sigma(sigma: float, correlation_time: float) -> float:
    """Standard deviation of the smoothed torque by first-order noise of a standard deviation of ``sigma`` and of
    ``correlation_time`` s."""
    return sigma * sqrt(correlation_time / (correlation_time + _AVERAGED_S))


@njit
def force_of_torque_alone(
    c: Record, torque: float, has_current: bool, dt: float, gear_gain: float, load_friction: float, offset_friction: float,
    spring: float,
) -> tuple[float, float]:  # fmt: skip
    """Clamp force (N) and its standard deviation from motor torque without a resolver, less the ``spring`` force in N.

    The direction of friction and the motor's acceleration are unknown: friction counts in full, and inertia as the torque's
    variation over `_AVERAGED_S`. Must be called with every sample, because it keeps that variation up to date.
    """
    if has_current:
        # The first torque counts in full, because the brake may be clamped at the start.
        share = 1.0 - exp(-dt / _AVERAGED_S) if c.averaged else 1.0
        if not c.averaged:
            c.averaged, c.steady = True, torque
        off = torque - c.torque_mean
        c.torque_mean += share * off
        c.torque_variance = (1.0 - share) * (c.torque_variance + share * off * off)
    force = max(c.torque_mean / gear_gain - spring, 0.0)
    friction = offset_friction + load_friction * force
    return force, sqrt(friction * friction + c.torque_variance) / gear_gain


@njit
def force_beside_friction(
    c: Record, state: float, variance: float, gear_gain: float, load_friction: float, offset_friction: float, spring: float
) -> tuple[float, float]:
    """The same beside a resolver whose motion is believed: inertia is taken out, and of friction what its ``state`` in [-1, 1]
    and the state's ``variance`` tell (`models.torque.friction_state`).

    The variance is the chance that the state has been forgotten, and that friction then has either direction."""
    mean = (1.0 - variance) * state
    leverage = gear_gain + load_friction * mean
    force = max((c.steady - offset_friction * mean) / leverage - spring, 0.0)
    unsure = (offset_friction + load_friction * force) * sqrt(variance + variance * (1.0 - variance) * state * state)
    return force, hypot(unsure, sqrt(c.torque_variance)) / leverage
