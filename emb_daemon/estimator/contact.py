"""The contact angle of one corner: where it is sought from power-on, and torque that contradicts what is believed of it."""

from math import sqrt

import numpy as np

from emb_daemon.estimator.fuse import needed_torque, torque_change
from emb_daemon.estimator.hypotheses import learned_torque, likely_shift, nearer_proven, open_again, to_torque
from emb_daemon.estimator.nearer import nearer_force, unlearn_mistaken
from emb_daemon.estimator.paths import CYCLE_S, ONE_CYCLE_S, doubt_memory, ordinary_stop, rest, turned
from emb_daemon.estimator.resolver import nobody_brakes
from emb_daemon.estimator.rewind import keep_all
from emb_daemon.estimator.unknown import offset_walk
from emb_daemon.jit import Record, hypot, njit, sq
from emb_daemon.models.contact import (
    NOTHING,
    TOO_EARLY,
    age_level,
    clearance_level,
    clearly_above,
    engaged,
    forget_level,
    start_anew,
    threshold,
    torque_sigma,
    watch_closing,
)
from emb_daemon.models.fusion import CONTACT, GAIN, OFFSET, STATES
from emb_daemon.models.gear import steepest, through_gear
from emb_daemon.models.plausibility import stays
from emb_daemon.models.stiffness import characteristic_curve, travel_at

#: Samples for which the angle has stood, from which the motor does: it turns by less than 0.4 rad/s.
_STANDS = 3
#: Standard deviations of the contact angle, rad, below which it is known again, and of an unknown one.
_KNOWN_RAD, _UNKNOWN_RAD = 0.3, 1.0
#: Largest torque of a released brake, as a share of what the largest force needs: the offset of an ordinary current sensor;
#: times over which a start is observed, for which a released motor must stand, and after which it must be off, s.
_LOOSE, _SEEN_S, _STILL_S, _OFF_S = 0.03, 0.1, 0.1, 1.0
#: Time for which a motor that has closed from where it was open further stands, before that counts as released, s: longer than
#: a light brake that nobody requests, and than a pause of one.
_WAITS_S = 10.0
#: Friction state from which the motor slides; share of the clearance that must be passed; share of the largest force's torque
#: that counts as none, because a clamped brake would have gained more over that travel.
_SLIDING, _PASSED, _FREE = 0.9, 0.3, 0.02
#: Force at power-on, as a share of the largest, from which the brake counts as clamped.
_CLAMPED = 0.1


@njit
def seek_release(s: Record, p: Record, m: Record) -> None:
    """Contact is unknown until the brake has been observed released: no brake request, park brake off, the motor standing
    without torque. The clearance counts from there. A latched brake needs no current either."""
    released = nobody_brakes(m)
    still = m.angle == s.angle or stays(s.plausibility, m.angle)
    s.still_s = s.still_s + m.dt if released and still else 0.0
    torque = abs(s.plausibility.torque_mean)
    loose = torque < p.offset_friction + _LOOSE * p.gear_gain * p.maximum_force
    # A gap may be lost frames, also the first: only a log none of whose samples come a cycle apart is at a reduced rate.
    s.full_rate = s.full_rate or 0.0 < m.dt <= ONE_CYCLE_S
    s.lowest = min(s.lowest, m.angle)
    if not s.seen and s.since_start_s < _SEEN_S:
        # The torque must be averaged over some samples.
        s.since_start_s += m.dt
        s.unknown = not released
        return
    if s.unknown and _passed_clearance(s, p, m):
        place_contact(s, p, s.start_angle)
        s.unknown = False
    elif s.unknown and released and s.still_s >= (_STILL_S if loose else _OFF_S) and _is_open(s, p, m):
        place_contact(s, p, m.angle)
        # It was clamped until now, perhaps.
        doubt_memory(s, p, ordinary_stop(p, 1.0), 0.0)
        s.unknown, s.start_angle = False, m.angle
        if not loose:
            # A released brake is not held for so long: the measured current is an offset of the sensor.
            s.error[OFFSET] += s.plausibility.torque_mean
    elif _was_on_its_way(s, p, m) and released and loose and s.still_s >= _STILL_S and s.past_contact < 0.0:
        place_contact(s, p, m.angle)
        s.start_angle = m.angle
    elif not s.seen:
        # At a request the brake may be clamped, which friction may hold without torque, or on its way. Frames at a reduced
        # rate tell nothing of it, and such logs begin with an open brake.
        open_yet = m.has_status and m.park_brake == 0.0 and not s.full_rate
        s.unknown = not (loose and released) and not open_yet
    s.seen = True


@njit
def _was_on_its_way(s, p, m):
    """Whether the motor was on its way where it was believed to be released: in a log at a reduced rate that began so, or
    because it has opened further before any stroke has shown the contact."""
    opened, _ = through_gear(p.gear, s.start_angle - m.angle)
    return s.start_angle == np.inf or (not s.contact.confirmed and opened > _PASSED * s.clearance)


@njit
def _is_open(s, p, m):
    """Whether the motor stands where it is open. One that has closed by a good part of the clearance since the start may press
    lightly, as brakes that are dried or held ready do without a request, and less than shows in the torque."""
    return _is_lowest(s, p, m.angle) or s.still_s >= _WAITS_S


@njit
def _is_lowest(s, p, angle):
    """Whether the motor has been no more than a part of the clearance lower than ``angle``, rad."""
    closed, _ = through_gear(p.gear, angle - s.lowest)
    return closed <= _PASSED * s.clearance


@njit
def _passed_clearance(s, p, m):
    """Whether the motor has closed from where it stood at the start, or from where it has stood lower since, by a good part of
    the clearance, and no force opposed it: then it was released there, whatever was requested."""
    if m.angle <= s.start_angle:
        # A torque while opening does not count against the closing motion.
        s.passed = s.opposing = 0.0
        if s.stood_s > _OFF_S:
            # A reversal while half open is no released position.
            s.start_angle = m.angle
    elif s.friction_mean > _SLIDING and np.isfinite(s.balance):
        s.passed += 1.0
        s.opposing += (s.balance - s.opposing) / s.passed
    passed, _ = through_gear(p.gear, m.angle - s.start_angle)
    closed = s.clearance > 0.0 and passed > _PASSED * s.clearance and _is_lowest(s, p, s.start_angle)
    sigma, _ = torque_sigma(p.torque_constant * s.current_sigma, p.inertia * s.speed_sigma / CYCLE_S)
    free = abs(s.opposing) < _FREE * p.gear_gain * p.maximum_force
    return closed and s.passed > 0.0 and sigma / sqrt(s.passed) < 0.3 * _FREE * p.gear_gain * p.maximum_force and free


@njit
def place_contact(s: Record, p: Record, released: float) -> None:
    """Believe that the motor angle ``released`` rad is the released position, from which the clearance counts, whatever was
    believed before."""
    s.gear_zero = released
    angle, sigma = released + s.clearance, s.clearance_sigma
    x = turned(s, p, s.angle)[0] - angle
    # Pads that have just opened still relax, but not from a force that was computed with a wrong contact angle.
    if abs(angle - s.contact_angle) < _KNOWN_RAD:
        s.past_contact = x
    else:
        rest(s, p, x, s.factor * s.scale)
    s.contact_angle, s.contact_anchor = angle, released + p.clearance
    s.contact_age_s = s.straying.known = 0.0
    for i in range(STATES):
        s.covariance[CONTACT, i] = s.covariance[i, CONTACT] = 0.0
    s.covariance[CONTACT, CONTACT] = sigma * sigma
    s.error[CONTACT] = 0.0
    start_anew(s.contact)
    s.contact.lost = False
    open_again(s, p)
    # Going back (`estimator.rewind`) must not restore what was believed before this.
    keep_all(s)


@njit
def watch_contact(s: Record, p: Record, m: Record, force_before: float, torque: float, leverage: float) -> None:
    """Detect whether the pads touch, and start the contact angle anew if the torque contradicts it."""
    c, x, contact_sigma = s.contact, s.past_contact, sqrt(s.covariance[CONTACT, CONTACT])
    if p.clearance_sigma == 0.0:
        # The contact angle is held, as in diagnose; no calibration file can state that.
        engaged(c, x, 0.0)
        return
    sigma, current_share = torque_sigma(p.torque_constant * s.current_sigma, p.inertia * s.speed_sigma / CYCLE_S)
    limit = threshold(current_share, p.current_correlation_time, CYCLE_S)
    mean_force = 0.5 * (force_before + s.force)
    predicted = leverage * mean_force
    h = s.sensitivity[0]
    slow, accelerating, needed = needed_torque(s, p, m, mean_force, leverage)
    speed = 0.5 * (m.speed + s.speed)
    slope = s.gear_slope
    load = mean_force + s.spring_force
    changed = torque_change(s, p, m, s.motor_torque - torque + predicted)
    to_torque(h, leverage, slope, s.friction_mean, load, speed, slow, accelerating, needed, changed, s.winding, s.housing)
    learned, learned_sigma = learned_torque(s.error, s.covariance, h)
    # No force needs more. A single sample that is beyond it then leaves a fifteenth in the mean, less than counts as a clamp.
    largest = leverage * p.maximum_force
    torque = min(max(torque - learned, -largest), largest)
    offset, offset_sigma = s.error[OFFSET], sqrt(s.covariance[OFFSET, OFFSET])
    age_level(c, offset_walk(p, s.offset_walk) * m.dt, sigma)
    unsure = hypot(offset_sigma, learned_sigma)
    turns = s.plausibility.held < _STANDS
    found = watch_closing(c, torque, predicted, s.friction_mean, sigma, limit, x, contact_sigma, offset, unsure, turns)
    if nearer_proven(s, p):
        _take_nearer(s, p, m, leverage)
        return
    # If a change explains the torque, the contact angle is not moved for the same reason.
    explained = likely_shift(s) != 0.0
    if explained:
        found = NOTHING
    offset, offset_sigma = clearance_level(c, sigma, offset, offset_sigma)
    noticeable = max(leverage * _CLAMPED * p.maximum_force, clearly_above(c, sigma))
    if found != NOTHING:
        force = max(predicted + c.excess, 0.0) / leverage
        _believe_offset(s, offset, offset_sigma)
        if found == TOO_EARLY:
            _start_contact(s, p, m, 0.0, p.curve[0] * _UNKNOWN_RAD, leverage)
        else:
            _start_contact(s, p, m, force, sigma / leverage, leverage)
    elif not c.confirmed and not explained and c.excess > max(predicted, noticeable):
        _start_clamped(s, p, m, predicted + c.excess, sigma, leverage)
    contact_sigma = sqrt(s.covariance[CONTACT, CONTACT])
    if contact_sigma < _KNOWN_RAD:
        c.lost = False
    engaged(c, s.past_contact, contact_sigma)


@njit
def _believe_offset(s, offset, sigma):
    """Replace the torque's offset that was learned with a wrong contact angle: it is ``offset``, with standard deviation
    ``sigma`` (N m)."""
    s.error[OFFSET] = offset
    for i in range(STATES):
        s.covariance[OFFSET, i] = s.covariance[i, OFFSET] = 0.0
    s.covariance[OFFSET, OFFSET] = sigma * sigma


@njit
def _take_nearer(s, p, m, leverage):
    """Believe that the contact is nearer."""
    force, sigma = nearer_force(s.nearer)
    unlearn_mistaken(s.nearer, s.error)
    s.error[CONTACT] = 0.0
    forget_level(s.contact)
    s.contact.engaged = True
    _start_contact(s, p, m, s.force + force, sigma, leverage)


@njit
def _start_clamped(s, p, m, torque, sigma, leverage):
    """Power came while the brake was clamped: no angle from which to count the clearance, but ``torque`` N m of standard
    deviation ``sigma`` that the clamp force makes. Or the torque has an offset."""
    s.covariance[OFFSET, OFFSET] += torque * torque
    force = torque / leverage
    friction = (p.offset_friction + p.load_friction * force * s.gear_slope) * sqrt(s.friction_variance)
    # With the released position the gear's slope is unknown, too.
    least, most = steepest(p.gear)
    s.covariance[GAIN, GAIN] += sq(0.5 * (most / least - 1.0))
    forget_level(s.contact)
    s.contact.engaged = True
    _start_contact(s, p, m, force, (sigma + friction) / leverage, leverage)


@njit
def _start_contact(s, p, m, force, sigma, leverage):
    """Set the contact angle to that of the clamp force ``force`` with standard deviation ``sigma`` (N).

    The force was computed from a torque with ``leverage`` m/rad and contains its offset: the errors of contact angle and
    offset are correlated until the clearance shows the offset.
    """
    travel = travel_at(min(force, p.maximum_force) / s.factor, p.curve) if force > 0.0 else 0.0
    if not np.isfinite(travel):
        return
    s.contact_angle += s.past_contact - travel
    rest(s, p, travel, s.factor)
    slope = s.factor * max(characteristic_curve(max(travel, 1.0), p.curve)[1], p.curve[0])
    lag = p.relaxation_time * m.speed * s.gear_slope
    misread = 1.0 / (leverage * slope)
    for i in range(STATES):
        s.covariance[CONTACT, i] = s.covariance[i, CONTACT] = misread * s.covariance[OFFSET, i]
    own = sq(sigma / slope) + lag * lag + _KNOWN_RAD * _KNOWN_RAD
    s.covariance[CONTACT, CONTACT] = own + misread * misread * s.covariance[OFFSET, OFFSET]
    s.contact_anchor = s.contact_angle
    s.contact_age_s = s.straying.known = 0.0
    start_anew(s.contact)
    open_again(s, p)
