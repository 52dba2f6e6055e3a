"""Plausibility between the force paths: whether they contradict each other, and which of them is wrong.

The filter's normalised innovation says by how many of its own standard deviations the torque is off what stiffness and
everything learned let expect. Its squares, less what model errors may make of them, are summed one-sidedly (Page, "Continuous
inspection schemes", Biometrika 41, 1954): a few samples far off or many less far off raise the alarm, and as many good ones
end it. Which path is wrong is decided by what only one of them uses:

    resolver   angle and speed repeat to the bit although torque or speed must turn the motor, the angle stands while the
               torque swings up and down by more than friction at rest can carry, or the angle does not follow the speed
    current    repeats to the bit, or asks for force while the pads do not touch

Otherwise it stays open; then stiffness goes on, and its standard deviation covers the difference.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.jit import fields, njit

#: ``contradiction``: summed squares. ``apart`` rad: angle less integrated speed, leaky. ``still``, ``idle``: samples in
#: which angle and speed, or the current, repeated to the bit. ``alike``: samples in which the angle moved as the speed says.
#: ``flickered``: samples in which the speed changed while the angle stood; ``current_flickered``: in which the current
#: changed. ``frozen_s``: time for which the resolver has been implausible. ``verdict``: as below. ``torque_mean``,
#: ``torque_variance``: motor torque (N m), smoothed; ``averaged``: whether there was one; ``held_low``, ``held_high``:
#: between what it has been since the angle left ``held_angle`` (rad), ``held`` samples ago, or the torque last swung,
#: ``swings`` times since then, upwards (``swing`` 1) or downwards (-1); ``pinned``: samples in a row in which the current
#: repeated to the bit while the motor turned; ``limit`` A: of either sign, as far as its sensor then goes, 0 if unknown;
#: ``due_acceleration`` (rad/s²), ``due_speed`` (rad/s), ``due_angle`` (rad): how it should have turned.
PLAUSIBILITY = np.dtype(
    [
        ("contradiction", "f8"),
        ("verdict", "i8"),
        ("apart", "f8"),
        *fields("i8", "still idle alike flickered current_flickered"),
        *fields("f8", "current frozen_s"),
        ("averaged", "?"),
        *fields("f8", "torque_mean torque_variance held_angle held_low held_high due_acceleration due_speed due_angle"),
        *fields("i8", "held swing swings pinned"),
        ("limit", "f8"),
    ],
    align=True,
)

#: What `watch` finds: both paths agree, or the one that is wrong, or that it is one of them.
AGREE, TORQUE_WRONG, TORQUE_FROZEN, STIFFNESS_WRONG, UNDECIDED = range(5)

#: Squared normalised innovation that model errors make, at most counted, and sums that raise and end the alarm. Innovations
#: of twelve standard deviations raise it within five samples, of six within forty, of four never. No log of the simulated
#: rig, with effects that its calibration does not know, brings the sum above a third of the alarm.
_TOLERATED, _COUNTED, _RAISE, _CLEAR = 20.0, 144.0, 600.0, 150.0
#: Times as much before the contact angle is confirmed.
_UNCONFIRMED = 5.0
#: Samples that repeat to the bit although torque should change them, or although the speed is not zero.
_REPEATED, _NEVER_REPEATED = 8, 50
#: A speed that has changed in so many samples while the angle stood is noise, and noise does not repeat to the bit so often:
#: at one repetition in five by chance, once in 1e8.
_FLICKERED, _FROZEN = 50, 12
#: Time constant over which angle and integrated speed are compared (s), and their difference that is a fault (rad) beyond what
#: a signal delay of 10 ms makes. A resolver is believed again after this many samples in each of which the angle moved
#: and went where the speed says within this angle (rad).
_COMPARED_S, _APART_RAD, _DELAY_S = 0.1, 0.6, 0.01
_RETURNED, _ALIKE_RAD = 25, 0.05
#: Share by which friction at rest may exceed what sliding takes.
_STICTION = 0.3
#: Standard deviations of one sample's torque that its mean over `_AVERAGED_S` does not reach.
_CERTAIN = 6.0
#: An angle that stands changes by less, rad: three counts of a resolver of 12 bit. By so many times as much may friction turn
#: over as the calibration's does within that.
_STANDS_RAD, _PRESLIDING_TURNS = 0.005, 2.0
#: Samples of a motor that turns in which the current repeats to the bit: its sensor goes no further. By chance, at one
#: repetition in five, once in 600; then that one value is disbelieved until the current has exceeded it.
_PINNED = 4
#: Angle by which a motor must have turned to be contradicted by one that stands, rad: eight times as much it would turn from
#: rest where in truth it came from one side and went back there. And the torque's standard deviations that do not turn it:
#: chance shows as much in one sample of 700, and this takes three in a row.
_DUE_RAD, BEYOND_CHANCE = 10.0 * _STANDS_RAD, 3.0
#: Standard deviations of the contact angle by which the motor is clear of it when the pads do not touch.
_CLEAR_OF_CONTACT = 6.0
#: Time over which torque is averaged when it must do without the resolver, s.
_AVERAGED_S = 0.04


@njit
def watch(c, m, angle_before, speed_before, past_contact, contact_sigma, confirmed):
    """Judge one sample that came within a cycle of the last, before it is fused; ``c.contradiction`` is of those before.

    Args:
        c: PLAUSIBILITY record.
        m: SAMPLE record.
        angle_before, speed_before: rad and rad/s of the last sample.
        past_contact, contact_sigma: rad past the believed contact angle, and its standard deviation.
        confirmed: whether the contact angle has been seen to be right. Until then `models.contact` has the first word.

    Returns:
        The verdict, also kept in ``c.verdict``.
    """
    travel = m.angle - angle_before
    step = travel - 0.5 * (m.speed + speed_before) * m.dt
    delay = _DELAY_S * abs(m.speed)
    c.apart = c.apart * exp(-m.dt / _COMPARED_S) + step
    if abs(step) > _ALIKE_RAD + delay:
        c.alike = 0
    elif abs(travel) > _STANDS_RAD:
        c.alike += 1
    c.still = c.still + 1 if travel == 0.0 and m.speed == speed_before else 0
    if m.has_current:
        c.idle = c.idle + 1 if m.current_q == c.current else 0
        c.current_flickered += c.idle == 0
        c.current = m.current_q
        _look_for_limit(c, m.current_q, travel)
    was = c.verdict
    if was == STIFFNESS_WRONG:
        c.frozen_s += m.dt
        if c.alike >= _RETURNED:
            # What was summed against the resolver is not held against the current.
            c.contradiction = c.apart = c.frozen_s = 0.0
            c.verdict = AGREE
        return c.verdict
    patience = 1.0 if confirmed or max(c.still, c.idle) >= _REPEATED else _UNCONFIRMED
    disagree = c.contradiction > (patience * _RAISE if was == AGREE else _CLEAR)
    if travel == 0.0 and m.speed != speed_before:
        c.flickered += 1
    repeated = c.still >= (_FROZEN if c.flickered >= _FLICKERED else _NEVER_REPEATED)
    repeated = repeated and (m.speed != 0.0 or c.flickered >= _FLICKERED)
    if repeated or abs(c.apart) > _APART_RAD + delay or (disagree and c.still >= _REPEATED and c.idle < _REPEATED):
        c.verdict = STIFFNESS_WRONG
        c.frozen_s = c.still * m.dt
        c.alike = 0
        return c.verdict
    repeated = c.idle >= _FROZEN and c.current_flickered >= _FLICKERED and c.still < _FROZEN
    if repeated or (m.has_current and 0.0 < c.limit == abs(m.current_q)):
        c.verdict = TORQUE_FROZEN
    elif not disagree:
        c.verdict = AGREE
    elif c.idle >= _REPEATED and c.still < _REPEATED:
        c.verdict = TORQUE_FROZEN
    elif was in (TORQUE_WRONG, TORQUE_FROZEN) or past_contact < -_CLEAR_OF_CONTACT * contact_sigma:
        c.verdict = TORQUE_WRONG
    else:
        c.verdict = UNDECIDED
    return c.verdict


@njit
def _look_for_limit(c, current, travel):
    """Whether the ``current`` (A) is as far as its sensor goes: then that much flows, or more."""
    c.pinned = c.pinned + 1 if c.idle > 0 and abs(travel) > _STANDS_RAD else 0
    if c.pinned >= _PINNED and c.current_flickered >= _FLICKERED:
        c.limit = abs(current)
    elif abs(current) > c.limit:
        c.limit = 0.0


@njit
def frozen(c):
    """Whether one sensor repeats itself while the other goes on: then their difference tells nothing of the contact angle."""
    return c.verdict in (STIFFNESS_WRONG, TORQUE_FROZEN) or (c.still > 0) != (c.idle > 0) or c.still < _REPEATED <= c.idle


@njit
def beyond_friction(torque, force, sigma, gear_gain, load_friction, offset_friction):
    """Torque (N m) that neither the clamp force ``force`` (N) nor friction at rest can carry, in units of its standard
    deviation ``sigma``: where it is not zero, the motor turns."""
    band = (1.0 + _STICTION) * (offset_friction + load_friction * force)
    return max(abs(torque - gear_gain * force) - band, 0.0) / sigma


@njit
def stands(c, angle):
    """Whether the motor angle ``angle``, rad, stands."""
    if abs(angle - c.held_angle) <= _STANDS_RAD:
        c.held += 1
        return True
    c.held_angle, c.held_low, c.held_high = angle, c.torque_mean, c.torque_mean
    c.held = c.swing = c.swings = 0
    c.due_acceleration = c.due_speed = c.due_angle = 0.0
    return False


@njit
def hold(c, force, sigma, gear_gain, load_friction, offset_friction, presliding_angle):
    """How often the motor must have turned though the angle stands: the smoothed torque went up or down by more than friction
    at rest carries in both directions under a clamp force of ``force`` N, as far as it turns over within that angle. Once
    alone may be an offset of the current, there and back is none.

    ``sigma``: standard deviation of the torque, N m; ``presliding_angle`` rad."""
    c.held_low, c.held_high = min(c.held_low, c.torque_mean), max(c.held_high, c.torque_mean)
    carried = (1.0 + _STICTION) * (offset_friction + load_friction * max(force, c.held_high / gear_gain))
    turned_over = 1.0 - exp(-_PRESLIDING_TURNS * _STANDS_RAD / presliding_angle)
    if c.held_high - c.held_low > 2.0 * turned_over * carried + _CERTAIN * sigma:
        way = 1 if c.torque_mean > 0.5 * (c.held_low + c.held_high) else -1
        c.swings += way != c.swing
        c.swing = way
        c.held_low = c.held_high = c.torque_mean
    return c.swings


@njit
def due(c, acceleration, delay, dt):
    """Whether the motor must have turned though the angle stands, which is ``delay`` s late, by an ``acceleration``, rad/s²,
    that is beyond doubt."""
    # What a torque does at a sample it has done since the last only if it did it then: it may have just begun.
    lasting = min(acceleration, c.due_acceleration)
    c.due_acceleration = acceleration
    if c.held < 2:
        # Any acceleration turns a motor that comes in back to where it was a sample ago.
        return False
    c.due_speed = c.due_speed + lasting * dt if lasting > 0.0 else 0.0
    c.due_angle += c.due_speed * dt
    return c.due_angle - c.due_speed * delay > _DUE_RAD


@njit
def disbelieve_resolver(c):
    """Until the angle moves as the speed says."""
    if c.verdict != STIFFNESS_WRONG:
        c.verdict, c.alike, c.frozen_s = STIFFNESS_WRONG, 0, _AVERAGED_S


@njit
def count_contradiction(c, ratio):
    """Add one contradiction, in standard deviations, to the sum; NaN says nothing."""
    if np.isfinite(ratio):
        total = max(c.contradiction + min(ratio * ratio, _COUNTED) - _TOLERATED, 0.0)
        c.contradiction = min(total, 1.5 * _UNCONFIRMED * _RAISE)


@njit
def force_of_torque_alone(c, torque, has_current, dt, gear_gain, load_friction, offset_friction):
    """Clamp force (N) and its standard deviation from motor torque without a resolver.

    Which way friction acts and what accelerates the motor is unknown: friction counts in full, and inertia as the torque's
    own variation over `_AVERAGED_S`, which is kept up to date here and so must be called with every sample.
    """
    if has_current:
        # The first torque counts in full: a start may be clamped.
        share = 1.0 - exp(-dt / _AVERAGED_S) if c.averaged else 1.0
        c.averaged = True
        off = torque - c.torque_mean
        c.torque_mean += share * off
        c.torque_variance = (1.0 - share) * (c.torque_variance + share * off * off)
    force = max(c.torque_mean / gear_gain, 0.0)
    friction = offset_friction + load_friction * force
    return force, sqrt(friction * friction + c.torque_variance) / gear_gain
