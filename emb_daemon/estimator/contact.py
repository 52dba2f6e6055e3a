"""The contact angle of one corner: a resolver that lost its zero, and what torque says against what is believed."""

from math import hypot, sqrt

import numpy as np

from emb_daemon.estimator.fuse import needed_torque
from emb_daemon.estimator.hypotheses import learned_torque, likely_shift, open_again, to_torque
from emb_daemon.estimator.paths import CYCLE_S, ONE_CYCLE_S, rest, turned
from emb_daemon.jit import njit
from emb_daemon.models.contact import (
    NOTHING,
    TOO_EARLY,
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
from emb_daemon.models.stiffness import characteristic_curve, travel_at

#: A speed beyond the motor's maximum by this factor (overspeed of IEC 60034-1), and an angle by this many rad more (half of
#: what a contact angle jumps by at once), is no motion.
SPEED_MARGIN = 1.2
_ANGLE_MARGIN = 0.5
#: Travel in one sample, rad, that the speed does not account for and that is no motion, beyond what a delay of this many
#: seconds between both makes: 60 turns a second that nobody saw. And how well such a jump is known, rad.
SLIP_RAD, _SLIP_DELAY_S, _ZERO_RAD = 0.3, 0.01, 0.1
#: A motor stands below this speed; offset that a resolver's speed may have: one count of the wire, rad/s; standard deviations
#: of its noise; and time after which a zero that drifted counts as healed, s: a car that stands once in a minute shows it.
_STANDING_RAD_PER_S, _SPEED_OFFSET_RAD_PER_S, _CERTAIN, _DRIFTING_S = 3.0, 0.02, 6.0, 60.0
#: From one standstill to the next angle and integrated speed must agree, whatever their delay. For that the motor has to stand
#: for twice the longest delay of a resolver that a calibration may state, s.
_AT_REST_S = 0.1
#: Of a standstill no more than this counts before the next way, s: the speed's offset makes a fifth of `_ZERO_RAD` in it.
_STOOD_S = 1.0
#: Share of the way by which the integral of the speeds may be off: a step of the acceleration a within a cycle T puts the
#: trapezoid off by up to a T^2 / 8, and four of them on a way a t^2, sped up for t and slowed down for as long, by
#: T^2 / (2 t^2) of it, t being 40 ms. On the simulated rig's logs no way strays by more than 0.35 of the limit.
_SPEED_SCALE = 0.005
#: Standard deviations of the contact angle, rad: known again below, and unknown.
_KNOWN_RAD, _UNKNOWN_RAD = 0.3, 1.0
#: Torque that a released brake may seem to need, share of what the largest force needs: the offset of an ordinary current
#: sensor; time over which a start is looked at, for which a released motor stands, and after which
#: it is off, s.
_LOOSE, _SEEN_S, _STILL_S, _OFF_S = 0.03, 0.1, 0.1, 1.0
#: Friction state from which the motor slides; share of the clearance that must be passed; and share of the largest force's
#: torque that counts as none: a clamped brake would have gained more over that way; share of the Coulomb friction that an open
#: brake may seem to need.
_SLIDING, _PASSED, _FREE, _OPEN = 0.9, 0.3, 0.02, 0.5
#: Share of the largest force that the torque must show at power-on for the brake to count as clamped.
_CLAMPED = 0.1


@njit
def follow_zero(s, p, m):
    """Whether the resolver has another zero now, because its angle went where the speed says that the motor did not; then the
    contact angle goes with it.

    How far it went is known from the speed. Where the resolver had been repeating itself the motor may have turned on, and
    what is no motion at all may be anything: then the contact angle becomes uncertain by as much. A resolver that loses counts
    does so a little in each sample, which shows when the motor stands again; it will lose more, and is disbelieved.
    """
    jump = m.angle - s.angle
    frozen_s = s.plausibility.frozen_s if s.drifting_s == 0.0 else 0.0
    stuck = s.plausibility.still > 1 or frozen_s > 0.0
    reach = p.maximum_speed * (m.dt + frozen_s)
    moved, sigma = 0.0, 0.0
    seen = 0.0 < m.dt <= ONE_CYCLE_S and not stuck
    turned = 0.5 * (m.speed + s.speed) * m.dt
    slip = jump - turned
    unsure = _SLIP_DELAY_S * abs(m.speed - s.speed) + SLIP_RAD
    if abs(jump) > SPEED_MARGIN * reach + _ANGLE_MARGIN:
        moved, sigma = jump, reach
    elif seen and abs(slip) > unsure and abs(s.plausibility.apart + slip) > unsure:
        moved, sigma = slip, _ZERO_RAD
    elif seen:
        moved = _drift(s, m, slip, turned)
        if moved != 0.0:
            sigma = abs(moved)
            s.drifting_s = _DRIFTING_S
    s.drifting_s = max(s.drifting_s - m.dt, 0.0)
    if moved != 0.0 or not seen:
        # Of a way that was not seen whole nothing can be said at its end.
        s.strayed = np.nan
    if moved != 0.0:
        _move_zero(s, p, moved, sigma)
    return moved != 0.0


@njit
def _drift(s, m, slip, turned):
    """How far (rad) the zero has drifted by what shows at standstill or at the end of a way, else 0; ``slip`` and ``turned``
    rad are what this sample adds to the angle beside the speed, and by it."""
    s.strayed += slip
    s.turned += turned
    s.turned_s += m.dt
    if max(abs(m.speed), abs(s.speed)) > _STANDING_RAD_PER_S:
        s.drifted = s.stood_s = 0.0
    else:
        s.drifted += slip
        s.stood_s += m.dt
    if abs(s.drifted) > _unaccounted(s, s.stood_s):
        return s.drifted
    moved = 0.0
    if s.stood_s > _AT_REST_S:
        # Only where a way has just ended: at the beginning of the next, a late speed has not yet seen what the angle has.
        ended = s.stood_s - m.dt <= _AT_REST_S
        if ended and abs(s.strayed) > _unaccounted(s, s.turned_s) + _SPEED_SCALE * abs(s.turned):
            moved = s.strayed
        if ended or s.turned_s > _STOOD_S:
            s.strayed = s.turned = s.turned_s = 0.0
    return moved


@njit
def _move_zero(s, p, moved, sigma):
    """Let every angle that is remembered be read from a zero ``moved`` rad further on, known with ``sigma`` rad."""
    s.drifted = s.stood_s = 0.0
    s.angle += moved
    s.angle_before += moved
    s.slid_angle += moved
    s.contact_angle += moved
    s.contact_anchor += moved
    s.start_angle += moved
    s.gear_zero += moved
    sigma *= s.gear_slope
    s.covariance[CONTACT, CONTACT] += sigma * sigma
    open_again(s, p)
    s.contact.confirmed = False


@njit
def _unaccounted(s, seconds):
    """Travel (rad) beyond the integrated speed of so many ``seconds`` that neither its noise nor its offset make."""
    return _ZERO_RAD + _SPEED_OFFSET_RAD_PER_S * seconds + _CERTAIN * s.speed_sigma * sqrt(CYCLE_S * seconds)


@njit
def seek_release(s, p, m):
    """Contact is unknown until the brake was seen released: nobody brakes, the park brake is off, the motor stands and needs
    no torque. From there the clearance counts. A brake that is latched needs no current either."""
    released = m.has_status and m.park_brake == 0.0 and m.brake_request == 0.0
    s.still_s = s.still_s + m.dt if released and m.angle == s.angle else 0.0
    torque = abs(s.plausibility.torque_mean)
    loose = torque < p.offset_friction + _LOOSE * p.gear_gain * p.maximum_force
    if not s.seen and s.since_start_s < _SEEN_S and m.dt <= ONE_CYCLE_S:
        # Until some samples have been averaged the torque of the first ones says little.
        s.since_start_s += m.dt
        s.unknown = not released
        return
    if s.unknown and _passed_clearance(s, p, m):
        place_contact(s, p, s.start_angle)
        s.unknown = False
    elif s.unknown and released and s.still_s >= (_STILL_S if loose else _OFF_S):
        place_contact(s, p, m.angle)
        s.unknown = False
        if not loose:
            # Nobody holds a released brake for so long: what is measured flows in no motor.
            s.error[OFFSET] += s.plausibility.torque_mean
    elif not s.seen:
        # A request may find the brake still open: a clamped one needs torque against which friction is small.
        # Frames at a reduced rate tell no torque, and such logs begin with an open brake.
        easy = torque < _OPEN * p.offset_friction or m.dt > ONE_CYCLE_S
        open_yet = m.has_status and m.park_brake == 0.0 and easy
        s.unknown = not (loose and released) and not open_yet
    s.seen = True


@njit
def _passed_clearance(s, p, m):
    """Whether the motor has closed from where it started, or from where it has stood lower since, by a good part of the
    clearance and no force opposed it: then it was released there, whatever was asked of it."""
    if m.angle <= s.start_angle:
        # What opposes it on a way back to there says nothing of the way from there.
        s.passed = s.opposing = 0.0
        if s.stood_s > _OFF_S:
            # Where it only turned round, half open, nobody had released it.
            s.start_angle = m.angle
    elif s.friction_mean > _SLIDING and np.isfinite(s.balance):
        s.passed += 1.0
        s.opposing += (s.balance - s.opposing) / s.passed
    passed, _ = through_gear(p.gear, m.angle - s.start_angle)
    closed = s.clearance > 0.0 and passed > _PASSED * s.clearance
    sigma, _ = torque_sigma(p.torque_constant * p.current_sigma, p.inertia * s.speed_sigma / CYCLE_S)
    free = abs(s.opposing) < _FREE * p.gear_gain * p.maximum_force
    return closed and s.passed > 0.0 and sigma / sqrt(s.passed) < 0.3 * _FREE * p.gear_gain * p.maximum_force and free


@njit
def place_contact(s, p, released):
    """Believe that the motor angle ``released`` rad is the released position, from which the clearance counts, whatever was
    believed before."""
    s.gear_zero = released
    angle, sigma = released + s.clearance, s.clearance_sigma
    x = turned(s, p, s.angle)[0] - angle
    # Pads that have just opened still relax; but what was believed of a contact elsewhere is no force to relax from.
    if abs(angle - s.contact_angle) < _KNOWN_RAD:
        s.past_contact = x
    else:
        rest(s, p, x, s.factor * s.scale)
    s.contact_angle, s.contact_anchor = angle, released + p.clearance
    for i in range(STATES):
        s.covariance[CONTACT, i] = s.covariance[i, CONTACT] = 0.0
    s.covariance[CONTACT, CONTACT] = sigma * sigma
    s.error[CONTACT] = 0.0
    start_anew(s.contact)
    s.contact.lost = False
    open_again(s, p)


@njit
def watch_contact(s, p, m, force_before, torque, leverage):
    """Whether the pads touch; and if the torque contradicts the believed contact angle, start that anew."""
    c, x, contact_sigma = s.contact, s.past_contact, sqrt(s.covariance[CONTACT, CONTACT])
    if p.clearance_sigma == 0.0:
        # Held as exactly known, as diagnose does; no calibration file can say so.
        engaged(c, x, 0.0)
        return
    sigma, current_share = torque_sigma(p.torque_constant * p.current_sigma, p.inertia * s.speed_sigma / CYCLE_S)
    limit = threshold(current_share, p.current_correlation_time, CYCLE_S)
    mean_force = 0.5 * (force_before + s.force)
    predicted = leverage * mean_force
    h = s.sensitivity[0]
    slow, accelerating, needed = needed_torque(s, p, m, mean_force, leverage)
    speed = 0.5 * (m.speed + s.speed)
    slope = s.gear_slope
    load = mean_force + s.spring_force
    to_torque(h, leverage, slope, s.friction_mean, load, speed, slow, accelerating, needed, s.winding, s.housing)
    learned, learned_sigma = learned_torque(s.error, s.covariance, h)
    torque -= learned
    offset, offset_sigma = s.error[OFFSET], sqrt(s.covariance[OFFSET, OFFSET])
    unsure = hypot(offset_sigma, learned_sigma)
    found = watch_closing(c, torque, predicted, s.friction_mean, sigma, limit, x, contact_sigma, offset, unsure)
    # A change that explains the torque is not found a second time as a contact angle that is somewhere else.
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
    """Forget what the filter took for an offset of the torque under a wrong belief: it is ``offset``, known with ``sigma``
    (N m)."""
    s.error[OFFSET] = offset
    for i in range(STATES):
        s.covariance[OFFSET, i] = s.covariance[i, OFFSET] = 0.0
    s.covariance[OFFSET, OFFSET] = sigma * sigma


@njit
def _start_clamped(s, p, m, torque, sigma, leverage):
    """Power came while the brake was clamped: no angle from which to count the clearance, but ``torque`` N m of standard
    deviation ``sigma`` that the clamp force makes. Or the torque has an offset."""
    s.covariance[OFFSET, OFFSET] += torque * torque
    force = torque / leverage
    friction = (p.offset_friction + p.load_friction * force * s.gear_slope) * sqrt(s.friction_variance)
    # The gear's slope is as unknown as the released position.
    least, most = steepest(p.gear)
    s.covariance[GAIN, GAIN] += (0.5 * (most / least - 1.0)) ** 2
    forget_level(s.contact)
    s.contact.engaged = True
    _start_contact(s, p, m, force, (sigma + friction) / leverage, leverage)


@njit
def _start_contact(s, p, m, force, sigma, leverage):
    """Believe the contact angle that the clamp force ``force`` of standard deviation ``sigma`` (N) stands for, and no more.

    The force was read from a torque of ``leverage`` m/rad whose offset it takes over: contact angle and offset err together,
    until the clearance shows the offset.
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
    own = (sigma / slope) ** 2 + lag * lag + _KNOWN_RAD * _KNOWN_RAD
    s.covariance[CONTACT, CONTACT] = own + misread * misread * s.covariance[OFFSET, OFFSET]
    s.contact_anchor = s.contact_angle
    start_anew(s.contact)
    open_again(s, p)
