"""One step of one corner: what runs in a tick, on one screen.

`step` is pure but for the state it is given. The daemon, replay, identify and diagnose all call it and nothing else
computes a clamp force.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.estimator.common import forget_common, weigh_common
from emb_daemon.estimator.contact import place_contact, seek_release, watch_contact
from emb_daemon.estimator.force_sensor import with_sensor
from emb_daemon.estimator.fuse import fuse, take_sides
from emb_daemon.estimator.heat import heat, tell
from emb_daemon.estimator.hypotheses import open_all
from emb_daemon.estimator.monitor import bound, contradicts
from emb_daemon.estimator.paths import (
    AT_A_START,
    ONE_CYCLE_S,
    doubt_friction,
    doubt_memory,
    ordinary_stop,
    pads_rise,
    stiffness_path,
    torque_path,
)
from emb_daemon.estimator.resolver import (
    ANGLE_MARGIN,
    LONG_AGO_S,
    MOST_SLIP_RAD,
    SPEED_MARGIN,
    at_rest,
    believe_speed,
    follow_zero,
    may_come_back,
)
from emb_daemon.estimator.restart import rest_unwatched, unseen_heating
from emb_daemon.estimator.rewind import forget_stroke, go_back, keep_all
from emb_daemon.estimator.status import (
    BEYOND_RANGE,
    BOUND_REACHED,
    BOUNDS_CONTRADICT,
    CONTACT_SOUGHT,
    CONTACT_UNKNOWN,
    CURRENT_IMPLAUSIBLE,
    FORCE_UNCERTAIN,
    NOT_A_NUMBER,
    RESOLVER_IMPLAUSIBLE,
    TEMPERATURE_UNKNOWN,
    TEMPERATURE_VAGUE,
    THERMOCOUPLE_STUCK,
    WHEEL_CONTRADICTED,
    ZERO_MOVED,
    ZERO_WANDERS,
    tell_status,
)
from emb_daemon.estimator.straying import follow_straying
from emb_daemon.estimator.unknown import (
    LEAST_SCALE,
    MOST_CREEP,
    MOST_SCALE,
    WARM_C,
    add_softening,
    excess,
    set_friction,
    set_priors,
    softening_sigma,
)
from emb_daemon.jit import Record, hypot, njit, sq
from emb_daemon.models.alignment import align, aligned
from emb_daemon.models.contact import forget_level
from emb_daemon.models.fusion import CONTACT, CREEPS, SCALE, maximum_likelihood
from emb_daemon.models.gear import back_through_gear, steepest, through_gear
from emb_daemon.models.lateness import find_filter, follow, interrupt, speed_then, stand, unfilter, way_beside
from emb_daemon.models.plausibility import AGREE, STIFFNESS_WRONG, believe_resolver, disbelieve_resolver, frozen, watch
from emb_daemon.models.stiffness import characteristic_curve, first_order_lag
from emb_daemon.models.torque import torque_balance
from emb_daemon.models.wander import STANDING_RAD_PER_S, forget_wander, leave_stretch, watch_wander
from emb_daemon.wire.contract import CYCLE_S, INIT, INVALID, PREDICTED, RUNNING

#: Time without a resolver sample, s, after which there is no estimate: the brake may have opened and closed.
SILENCE_S = 0.1
#: Factor on the time between the samples before, from which one is missing.
_RARELY = 1.5
#: Time for which a motor of which nothing is heard goes on as it went, s. Chosen by how long a force goes on to change on the
#: validation logs of two rigs that are simulated by others: of 12 to 72 ms this time is within 2 % of the best at every age
#: up to a tenth of a second on their other logs (`studies.predicted`).
_GOES_ON_S = 0.032
#: Share of what the pads gain between the moment of the estimate and the sample that may be wrong: the motor accelerates.
_LED = 0.2
#: Samples in which a motor that stands must have done so, and time over which its speed's noise is averaged, s.
_HELD, _NOISE_S = 25, 0.5
#: Standard deviations of the current's noise up to which a change counts as noise.
_STEP = 5.0
#: Factor on the calibration's noise of the current from which it is another: units scatter by a fifth, and so few samples tell
#: it to a twentieth.
_NOISIER = 1.25
#: Standard deviation of the pads' temperature that is reported, K: it moves the force by half a hundredth.
_TEMPERATURE_UNCERTAIN_K = 10.0
#: Standard deviations within which a stiffness is at its bound.
_CERTAINLY = 3.0
#: Factor on the calibration's largest force above which no clamp force is possible.
_POSSIBLE = 1.3
#: Standard deviation of the contact angle, rad, from which it is reported as uncertain.
_UNCERTAIN_RAD = 0.5
#: Standard deviation of the force from which it is reported as uncertain: 1 % of an ordinary brake's 30 kN, N, so that an
#: error of 1 kN within three of them is never silent on a larger brake either; and of a smaller one this share of its largest
#: force.
_UNCERTAIN_N, _UNCERTAIN_SHARE = 300.0, 0.02


@njit
def _start(s, p, m):
    s.started = True
    s.angle = s.slid_angle = m.angle
    s.speed, s.speed_sigma, s.current_sigma = m.speed, p.speed_sigma, p.current_sigma
    if not s.resumed:
        s.clearance, s.clearance_sigma, s.scale = p.clearance, p.clearance_sigma, 1.0
        set_priors(s.covariance, p)
        if p.clearance_sigma == 0.0:
            s.covariance[SCALE, SCALE] = 0.0
            for i in CREEPS:
                s.covariance[i, i] = 0.0
        else:
            doubt_memory(s, p, ordinary_stop(p, AT_A_START), 0.0)
    _begin_at(s, p, m)
    forget_common(s)
    if s.resumed:
        weigh_common(s, p)
    s.largest_slip[:] = MOST_SLIP_RAD
    keep_all(s)


@njit
def _begin_at(s, p, m):
    """Begin where the motor is now: it is released there, until the start says something else."""
    s.gear_zero = m.angle
    # Of a motor that turns at the first sample the released position is unknown.
    s.start_angle = m.angle if abs(m.speed) < STANDING_RAD_PER_S else np.inf
    s.lowest = m.angle
    s.contact_angle, s.contact_anchor = m.angle + s.clearance, m.angle + p.clearance
    s.past_contact = -s.clearance
    s.friction_variance = 1.0
    s.torque_age = s.no_current_s = 1e9
    s.away.seconds = LONG_AGO_S
    open_all(s, p)
    s.balance = np.nan


@njit
def _may_have_restarted(s, p, m):
    """Whether the motor's controller has been silent, and may count from another zero: by what it counts it is elsewhere. In a
    log at a reduced rate it is no more silent than before, of which its second sample tells nothing yet."""
    silent = m.was_silent and s.dt_before > 0.0 and m.dt > max(SILENCE_S, _RARELY * s.dt_before)
    return silent and abs(m.angle - s.angle) > ANGLE_MARGIN and p.clearance_sigma > 0.0


@njit
def _begin_again(s, p, m):
    """After a silence of the motor's controller: as after a restart of this program what was learned stays, and where the
    contact is has to be seen."""
    if not (s.unknown or s.contact.lost):
        s.clearance, s.clearance_sigma = p.clearance + s.contact_angle - s.contact_anchor, sqrt(s.covariance[CONTACT, CONTACT])
    rest_unwatched(s, p, m.dt)
    if s.temperature_known:
        s.temperature_sigma += unseen_heating(m.dt)
    # What is asked of the brake may have been heard before the silence: only a motor that stands shows that it is released.
    s.unknown, s.seen, s.braked = True, True, False
    # In the silence nobody saw it stand.
    s.still_s, s.passed, s.opposing = -m.dt, 0.0, 0.0
    s.angle = s.slid_angle = m.angle
    s.speed, s.friction_state, s.strayed = m.speed, 0.0, np.nan
    s.drifted = s.stood_s = s.drifting_s = s.contact_age_s = s.offset_age_s = 0.0
    believe_resolver(s.plausibility)
    forget_wander(s.wander)
    place_contact(s, p, m.angle)
    forget_level(s.contact)
    s.contact.engaged = False
    _begin_at(s, p, m)
    keep_all(s)


@njit
def step(s: Record, p: Record, m: Record, out: Record) -> None:
    """Advance one corner by one resolver sample.

    Args:
        s: STATE record, changed in place.
        p: PARAMETERS record.
        m: SAMPLE record; ``m.dt`` seconds since the last one, 0 at the first.
        out: ESTIMATE record to fill; the caller owns time, corner, counter and cycle.
    """
    angle, speed, current = m.angle, m.speed, m.current_q
    unfilter(s.lateness, m)
    if align(s.alignment, m) and p.clearance_sigma > 0.0:
        go_back(s, p)
    _advance(s, p, m, angle, speed, out)
    m.angle, m.speed, m.current_q = angle, speed, current


@njit
def _lead(s, p, m, angle, speed, out):
    """Carry the force forward from the moment to which the sample was delayed to that in which ``angle`` (rad) and ``speed``
    (rad/s) came: the pads move on to where the motor is now."""
    delay, filtered = CYCLE_S * s.alignment.delay, CYCLE_S * max(-s.alignment.lag, 0.0)
    apart = abs(delay) + filtered
    way = angle - m.angle + filtered * speed if delay > 0.0 else apart * speed
    gained = _gained_by(s, p, way, apart)
    out.force = max(out.force + gained, 0.0)
    out.stiffness_force = max(out.stiffness_force + gained, 0.0)
    out.sigma = hypot(out.sigma, _LED * gained)


@njit
def _advance(s, p, m, angle, speed, out):
    """`step` with current and motion of one moment; ``angle`` and ``speed`` as they came."""
    if not s.started:
        _start(s, p, m)
    elif _may_have_restarted(s, p, m):
        _begin_again(s, p, m)
    believe_speed(s, p, m)
    if p.clearance_sigma > 0.0:
        effects.doubt_phase(p.effects, s.effects, m)
    turned = way_beside(s.lately, m.angle - s.angle, m.speed, s.speed, effects.known_delay(p.effects), m.dt)
    was_wrong = s.plausibility.verdict == STIFFNESS_WRONG
    moved_zero = follow_zero(s, p, m, turned)
    if 0.0 < m.dt <= ONE_CYCLE_S and not moved_zero:
        sigma = sqrt(s.covariance[CONTACT, CONTACT])
        # A speed that replaces a wrong one has no noise, and must not pass for one that repeats.
        before, limit = np.nan if s.speed_wrong else s.speed, s.plausibility.limit
        watch(s.plausibility, m, s.angle, before, turned, s.past_contact, sigma, s.contact.confirmed)
        if s.plausibility.limit > 0.0 and limit == 0.0 and not s.plausibility.coarse and p.clearance_sigma > 0.0:
            # The stroke's current up to here was less than what flowed.
            forget_stroke(s, p)
    other_speed = _follow_age(s, p, m, turned, moved_zero)
    if s.drifting_s > 0.0:
        disbelieve_resolver(s.plausibility)
    knew = s.temperature_known
    if was_wrong and s.plausibility.verdict != STIFFNESS_WRONG:
        # What the pads have been through meanwhile the angle has not shown.
        doubt_memory(s, p, max(ordinary_stop(p, 1.0), s.fused), 0.0)
    if p.clearance_sigma > 0.0:
        seek_release(s, p, m)
    heat(s, p, m)
    if s.temperature_known and not knew and not s.resumed:
        _begin_warm(s, p, m)
    _follow_noise(s, p, m)
    force_before = s.force
    stiffness_path(s, p, m, s.factor * s.scale)
    torque, leverage, friction_variance = torque_path(s, p, m)
    doubtful = may_come_back(s)
    if moved_zero or other_speed or doubtful:
        torque = np.nan
    # Over a gap the current of its last cycle does not belong to the mean acceleration.
    if m.dt <= ONE_CYCLE_S and not frozen(s.plausibility) and not s.unknown and aligned(s.alignment) and not doubtful:
        watch_contact(s, p, m, force_before, torque, leverage)
    turning_sigma, standing_sigma = fuse(s, p, m, force_before, torque, leverage, friction_variance, out)
    _tell_paths(s, torque, leverage, out)
    facts = take_sides(s, p, m, turning_sigma, standing_sigma, friction_variance if np.isfinite(torque) else 1.0, out)
    by_torque = facts & (RESOLVER_IMPLAUSIBLE | CONTACT_UNKNOWN | CONTACT_SOUGHT) != 0
    if (s.alignment.delay != 0.0 or s.alignment.lag < 0.0) and not by_torque:
        _lead(s, p, m, angle, speed, out)
    if p.sensor.limit > 0.0 and by_torque:
        out.force, out.sigma = with_sensor(s.sensor, out.force, out.sigma)
    bound(s.monitor, p, m, s.gear_friction)
    if m.late_ns > 0:
        out.sigma = hypot(out.sigma, _gained_since(s, p, 1e-9 * m.late_ns))
    s.angle_before, s.dt_before = s.angle, m.dt
    s.angle, s.speed, s.balance, s.leverage = m.angle, m.speed, torque, leverage
    _tell_contact(s, p, out.contact_sigma, out)
    out.stiffness_factor = s.factor * s.scale
    out.engaged = s.contact.engaged
    tell(s, out)
    out.mode = RUNNING
    tell_status(_look(s, p, m, facts, out) | (ZERO_MOVED if moved_zero else 0), out)
    s.fused, s.fused_sigma = out.force, out.sigma


@njit
def _begin_warm(s, p, m):
    """Once temperatures are known for the first time: what heat has done to the brake before power-on."""
    s.growth_start = s.disc
    set_friction(s.covariance, p, m.caliper)
    if p.clearance_sigma > 0.0:
        rise = pads_rise(s, p.thermal)
        add_softening(s.covariance, p, rise, s.temperature_sigma)
        s.softening = softening_sigma(p, rise, s.temperature_sigma, s.history_sigma)
    open_all(s, p)
    keep_all(s)


@njit
def _tell_paths(s, torque, leverage, out):
    """The force by each path, and by both without a filter."""
    out.stiffness_force = s.force
    # Two cycles: over one, the noise of both speeds counts in full; over more, the mean lags.
    out.torque_force, out.ml_force = np.nan, s.force
    if np.isfinite(torque):
        paired = np.isfinite(s.balance)
        force = torque_balance(torque + s.balance, leverage + s.leverage) if paired else torque_balance(torque, leverage)
        out.torque_force = max(force, 0.0)
        out.ml_force, _ = maximum_likelihood(s.force, out.stiffness_sigma, out.torque_force, out.torque_sigma)


@njit
def _follow_age(s, p, m, turned, moved_zero):
    """Age of the angle beyond the calibration's, and whether its zero wanders; whether the speed is another from now on."""
    travel, gained = m.angle - s.angle, m.speed - s.speed
    seen = 0.0 < m.dt <= ONE_CYCLE_S and not moved_zero and s.drifting_s == 0.0
    if seen and s.plausibility.verdict != STIFFNESS_WRONG:
        watch_wander(s.wander, travel, turned, m.speed, gained, s.speed_sigma, m.dt)
    else:
        leave_stretch(s.wander)
    if p.clearance_sigma > 0.0:
        follow_straying(s, p, travel, turned, m.speed, seen and at_rest(s, m), m.dt)
    if not seen or frozen(s.plausibility):
        interrupt(s.lateness)
        return False
    follow(s.lateness, travel, turned, gained, s.speed_sigma, m.dt)
    s.late = s.lateness.age if p.clearance_sigma > 0.0 else 0.0
    if p.clearance_sigma == 0.0 or not find_filter(s.lateness):
        return False
    # The way so far was beside another speed, and what it told of the brake is wrong.
    s.strayed, s.plausibility.apart = np.nan, 0.0
    leave_stretch(s.wander)
    go_back(s, p)
    return True


@njit
def _follow_current_noise(s, p, m):
    """Mean squares of the current's noise, A2, while the motor stands: by its changes, and by how they differ from cycle to
    cycle, because a current that rises and falls with what is asked for, beside an angle that is frozen, is no noise. One that
    is far larger than noise is a step of that."""
    if m.has_current and s.had_current and p.current_sigma > 0.0:
        alike = exp(-CYCLE_S / p.current_correlation_time) if p.current_correlation_time > 0.0 else 0.0
        change, share = m.current_q - s.current_before, min(m.dt / _NOISE_S, 1.0)
        turned = change - s.current_change / p.torque_constant
        largest = sq(_STEP * s.current_sigma)
        s.current_square += share * (min(sq(change) / (2.0 - 2.0 * alike), largest) - s.current_square)
        shown = sq(turned) / (6.0 - 8.0 * alike + 2.0 * alike * alike)
        s.turned_square += share * (min(shown, largest) - s.turned_square)


@njit
def _follow_noise(s, p, m):
    """How noisy the speed is, and how far it is off: a motor that stands has none."""
    if s.plausibility.held > _HELD and m.angle == s.angle and m.dt <= ONE_CYCLE_S:
        _follow_current_noise(s, p, m)
    if s.plausibility.held > _HELD and m.angle == s.angle:
        # An angle that is late still stays where it is while the motor turns.
        age = s.late + effects.known_delay(p.effects)
        then = speed_then(s.lately, age)
        s.speed_square += min(m.dt / _NOISE_S, 1.0) * (then * then - s.speed_square)
        believed = s.plausibility.verdict == AGREE or s.drifting_s > 0.0
        if (
            believed
            and p.clearance_sigma > 0.0
            and at_rest(s, m)
            and stand(s.lateness, then if age > 0.0 else m.speed, s.speed_sigma)
        ):
            s.strayed = np.nan
            if s.drifting_s > 0.0 or s.wander.found:
                # The zero has not drifted. What stops have taught beside a contact that moved with it is forgotten, and the
                # contact counts anew from the released position, in which the motor stands.
                s.drifting_s = 0.0
                believe_resolver(s.plausibility)
                go_back(s, p)
                place_contact(s, p, m.angle)
            forget_wander(s.wander)
            # Friction had seemed to turn over in a motor that stands.
            doubt_friction(s, m.angle)
            forget_level(s.contact)
    s.speed_sigma = max(sqrt(s.speed_square), p.speed_sigma)
    noisy = s.current_square > sq(_NOISIER * p.current_sigma)
    s.current_sigma = sqrt(s.current_square) if noisy else p.current_sigma


@njit
def _tell_contact(s, p, sigma, out):
    """The contact angle as the resolver reads it, and its standard deviation; ``sigma`` in rad of equivalent angle."""
    out.contact_angle, out.contact_sigma = s.contact_angle, sigma
    if p.gear.step > 0.0:
        past_zero = back_through_gear(p.gear, s.contact_angle - s.gear_zero)
        out.contact_angle = s.gear_zero + past_zero
        out.contact_sigma = sigma / through_gear(p.gear, past_zero)[1]


@njit
def _look(s, p, m, facts, out):
    """``facts`` of the paths and those beside them; keeps force and sigma within what the brake can do."""
    if not s.temperature_known:
        facts |= TEMPERATURE_UNKNOWN
    elif s.temperature_sigma > _TEMPERATURE_UNCERTAIN_K:
        facts |= TEMPERATURE_VAGUE
    if s.plate_stuck:
        facts |= THERMOCOUPLE_STUCK
    if s.wheel.contradicted:
        facts |= WHEEL_CONTRADICTED
    if (s.wander.found or s.straying.rate != 0.0) and p.clearance_sigma > 0.0:
        facts |= ZERO_WANDERS
    more = excess(s.error, p, m.caliper if s.temperature_known else WARM_C, s.winding, s.housing)
    out.sigma *= more
    unsure = min(_CERTAINLY * sqrt(s.covariance[SCALE, SCALE]), 1.0)
    at_bound = s.scale * (1.0 - unsure) <= LEAST_SCALE or s.scale * (1.0 + unsure) >= MOST_SCALE
    if more > 1.0 or at_bound or max(abs(s.creep[0]), abs(s.creep[1])) >= MOST_CREEP:
        facts |= BOUND_REACHED
    if out.force > p.maximum_force or s.speed_wrong or abs(m.speed) > SPEED_MARGIN * p.maximum_speed:
        facts |= BEYOND_RANGE
    # A frozen current gives no bounds. Otherwise current or estimate is wrong, and sigma covers the difference.
    if contradicts(s.monitor, out.force, out.sigma, m.dt) and not facts & CURRENT_IMPLAUSIBLE:
        facts |= BOUNDS_CONTRADICT
        low, high = s.monitor.low, s.monitor.high
        middle = 0.5 * (low + high)
        out.sigma = max(0.5 * (high - low), out.sigma, abs(out.force - middle))
        out.force = middle
    number = np.isfinite(s.force) and np.isfinite(out.force) and np.isfinite(out.sigma)
    if not number or out.force > _POSSIBLE * p.maximum_force:
        facts |= NOT_A_NUMBER
        out.force, out.sigma = 0.0, p.maximum_force
    out.sigma = min(out.sigma, p.maximum_force)
    if (
        out.sigma > min(_UNCERTAIN_N, _UNCERTAIN_SHARE * p.maximum_force)
        or s.covariance[CONTACT, CONTACT] > _UNCERTAIN_RAD * _UNCERTAIN_RAD
    ):
        facts |= FORCE_UNCERTAIN
    return facts


@njit
def _gained_by(s, p, way, time):
    """Force (N) that the pads gain while the motor goes on by ``way`` rad within ``time`` s."""
    here, _ = characteristic_curve(s.past_contact, p.curve)
    there, _ = characteristic_curve(s.past_contact + s.gear_slope * way, p.curve)
    drive = s.drive + s.factor * s.scale * (there - here)
    return first_order_lag(s.force, s.drive, drive, time, p.relaxation_time) - s.force


@njit
def _gained(s, p, age):
    """Largest change of force (N) in ``age`` s: the motor cannot have gone faster than its limit, and no further than full
    clamp. Clamping changes more than releasing."""
    _, steep = steepest(p.gear)
    reached, _ = characteristic_curve(s.past_contact + p.maximum_speed * steep * age, p.curve)
    start, _ = characteristic_curve(s.past_contact, p.curve)
    return min(s.factor * s.scale * (reached - start), p.maximum_force)


@njit
def _gained_since(s, p, age):
    """Change of force (N) since a sample that came ``age`` s later than others: as the motor turned, within a cycle."""
    return s.slope * s.gear_slope * abs(s.speed) * age if age <= CYCLE_S else _gained(s, p, age)


@njit
def predict(s: Record, p: Record, age: float, out: Record) -> None:
    """Prediction ``age`` seconds after the last sample: a motor that turned goes on for a while, and sigma covers any motion.

    After `SILENCE_S` the source is Invalid.
    """
    out.mode = RUNNING if s.started else INIT
    out.source = PREDICTED if s.started and age <= SILENCE_S else INVALID
    out.reasons = out.facts = 0
    out.force, out.sigma = s.fused, hypot(s.fused_sigma, _gained(s, p, age))
    if abs(s.speed) > STANDING_RAD_PER_S and not s.unknown and s.plausibility.verdict != STIFFNESS_WRONG:
        out.force = max(out.force + _gained_by(s, p, s.speed * min(age, _GOES_ON_S), age), 0.0)
    out.stiffness_force = out.torque_force = out.ml_force = np.nan
    _tell_contact(s, p, sqrt(s.covariance[CONTACT, CONTACT]), out)
    out.stiffness_factor = s.factor * s.scale if s.started else 1.0
    out.innovation = out.innovation_sigma = np.nan
    tell(s, out)
