"""Fusion of both paths: the filter over their errors, and the choice of a path where they contradict each other."""

from math import exp, sqrt

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.estimator import uneven
from emb_daemon.estimator.common import common_sigma, follow_common, weigh_common
from emb_daemon.estimator.consistency import forget, model_error, remember
from emb_daemon.estimator.force_sensor import hear_sensor
from emb_daemon.estimator.hypotheses import (
    ALTERNATIVES,
    DRIFT,
    PROVEN,
    contact_sigma,
    drift_odds,
    exists,
    fold,
    learn,
    mix,
    open_again,
    open_all,
    open_others,
    place,
    settle,
    stay_finite,
    suspected,
    to_force,
    to_torque,
    unproven,
    watch_steps,
    weigh,
    weigh_step,
)
from emb_daemon.estimator.nearer import follow_nearer, place_nearer, rest_nearer
from emb_daemon.estimator.paths import (
    CYCLE_S,
    DISSOLVING_PER_S,
    FLICKER_RAD,
    ONE_CYCLE_S,
    SELF_LOCKING,
    count_creep,
    crept,
    disc_warmth,
    follow_creep,
    pads_rise,
    untold_creep,
)
from emb_daemon.estimator.phases import follow_phases, undecided, weigh_phases
from emb_daemon.estimator.rewind import keep
from emb_daemon.estimator.status import (
    ANGLE_LATE,
    CONTACT_LOST,
    CONTACT_SOUGHT,
    CONTACT_UNKNOWN,
    CURRENT_APART,
    CURRENT_IMPLAUSIBLE,
    DISC_UNEVEN,
    FORCE_SENSOR_WRONG,
    JUMP_SUSPECTED,
    MODEL_ERROR,
    NO_SOURCE,
    OFFSET_LARGE,
    PATHS_CONTRADICT,
    RESOLVER_IMPLAUSIBLE,
    TORQUE_OLD,
)
from emb_daemon.estimator.straying import attribute_straying, straying_sigma
from emb_daemon.estimator.unknown import (
    HOUSING_S,
    LATE_CYCLES,
    SLOW_RAD_PER_S,
    WINDING_S,
    add_drift_walks,
    set_walks,
    softening_sigma,
    torque_offset,
)
from emb_daemon.jit import Record, hypot, njit, sq
from emb_daemon.models.alignment import at_bound, compare, in_step, interrupt, out_of_step
from emb_daemon.models.contact import forget_level
from emb_daemon.models.fusion import (
    CONTACT,
    COULOMB,
    CREEPS,
    FADE,
    FAST,
    GAIN,
    HOUSING,
    LOAD,
    OFFSET,
    SCALE,
    SLOW,
    VISCOUS,
    force_variance,
    predict_errors,
)
from emb_daemon.models.gear import most_of_spring, steepest
from emb_daemon.models.lateness import SLOWEST_S
from emb_daemon.models.plausibility import (
    AGREE,
    BEYOND_CHANCE,
    STIFFNESS_WRONG,
    TORQUE_FROZEN,
    TORQUE_WRONG,
    UNDECIDED,
    beyond_friction,
    count_contradiction,
    disbelieve_resolver,
    due,
    force_beside_friction,
    force_of_torque_alone,
    hold,
    smoothed_sigma,
    stands,
    steady,
)
from emb_daemon.models.wander import STANDING_RAD_PER_S
from emb_daemon.models.wheel import TURNING_RAD_PER_S

#: Least motor torque over current times the calibration's torque constant: half of the loss that the monitor allows; and time
#: without torque, s, after which the force rests on stiffness alone: half of `SILENCE_S`.
_LEAST_GAIN, _OLD_S = 0.3, 0.05
#: Share of the largest force by which an unproven jump must move the force to be reported.
_NOTED = 0.003
#: Share of the largest force from which a model error is reported. Sigma contains a smaller one, and is itself not reported
#: from less than this.
_NOTED_ERROR = 0.01
#: Samples for which a motor must have stood until the smoothed torque is no more that of its motion: five time constants.
_SMOOTHED = 50
#: Offset of the motor torque, over its standard deviation at power-on, beyond which no healthy current sensor is off.
_OFFSET_LARGE = 2.0
#: Log odds that a change reaches only after more samples than it takes to find a sensor's sudden fault (at most 12.5 a sample,
#: and five samples): from then on it may explain a contradiction by the sliding motor.
_LONG_LIKELY = 62.5
#: Standard deviation of an innovation, as a share of the largest force, above which it is not used.
_TELLING = 0.1
#: Cycles of delay from which a late angle is reported: sampling in the cycle before, in a frame that waits for the next, is no
#: fault.
_TOLD_CYCLES = 2.0
#: Time for which an unexplained error of the torque is constant, s: until temperature and force of the brake are others, which
#: takes some stops.
_LASTS_S = 10.0
#: Time over which a torque with such an error is averaged, s, shorter than a stroke; share of the variance of its noise that
#: goes in that, if the noise is correlated over up to ten milliseconds; and squared standard deviations of what remains that
#: are certain.
_BEYOND_S, _AVERAGED, _SURELY = 0.05, 0.8, 9.0
#: Share of the force, as standard deviation of the stiffness path, from which it tells none. A curve that is not measured up
#: to the largest force is given one of all of it at most (`identify`); as much again are errors that logs have shown. Errors
#: of that size last, and what motor and friction would learn beside them is wrong.
_TELLS_NOTHING = sqrt(2.0)
#: Way of a whole stroke, over which counts are lost in the same direction, as time at the motor's maximum speed, s.
_STROKE_S = 0.25
#: Share of the clearance by which pads are certainly apart: the motor must have gone back so far before a jump is proven, and
#: only there do inertia and friction alone need a torque, whose moment is known whatever the contact angle is.
_BACK = 0.3
#: Counts of the resolver that the second difference of its angle must exceed, and standard deviations that a change of torque
#: must: what noise then makes of a delay is a thirtieth of a cycle.
_CLEAR = 4.0
#: Part of a change of torque that a current which is up to half a cycle late shows in that cycle and the one before.
_SHOWN = 0.5
#: Cycles by which a current may be later than is known while it is being found out, and standard deviations of its noise that
#: are no change.
_LATER, _NOISES = 2.0, 2.0


@njit
def _clear_acceleration(s, m):
    """Acceleration (rad/s^2) from three angles where it is clear of their quantisation, else 0.

    A gain error is found by regression on the needed torque, which must not contain the noise of current and speed: otherwise
    their noise would look like a gain that is too small."""
    if m.dt != CYCLE_S or s.dt_before != CYCLE_S:
        return 0.0
    acceleration = (m.angle - 2.0 * s.angle + s.angle_before) / (CYCLE_S * CYCLE_S)
    return acceleration if abs(acceleration) > _CLEAR * 2.0 * FLICKER_RAD / (CYCLE_S * CYCLE_S) else 0.0


@njit
def needed_torque(s: Record, p: Record, m: Record, mean_force: float, leverage: float) -> tuple[float, float, float]:
    """Torques (N m): friction as far as it is slow, what inertia took, and what force, friction and inertia took together."""
    accelerating, load = p.inertia * _clear_acceleration(s, m), mean_force + s.spring_force
    friction = s.friction_mean * (p.offset_friction + p.load_friction * load * s.gear_slope)
    slow = friction * exp(-0.5 * abs(m.speed + s.speed) / SLOW_RAD_PER_S)
    return slow, accelerating, leverage * load + p.offset_friction * s.gear_friction * s.friction_mean + accelerating


@njit
def torque_change(s: Record, p: Record, m: Record, wanted: float) -> float:
    """Change in a cycle of the torque that force and motion want, ``wanted`` now, N m, of which a current that is not of the
    same moment shows but a part; 0 where that is not known.

    It must be clear of the noise of the speeds, which is in the unexplained torque as well and would look like a current that
    is half a cycle late; the current's own noise would look like one that is early. And the current must have changed, too,
    or one wrong speed would pass for a late current."""
    if m.dt != CYCLE_S or s.dt_before != CYCLE_S or not (s.had_current and in_step(s.alignment)):
        return 0.0
    change = wanted - s.wanted
    # Three speeds make a change: one of them twice.
    clear = abs(change) > _CLEAR * sqrt(6.0) * p.inertia * s.speed_sigma / CYCLE_S
    shown = abs(p.torque_constant * (m.current_q - s.current_before)) + abs(s.current_change) > _SHOWN * abs(change)
    return change if clear and shown else 0.0


@njit
def _spread(s, p, m):
    """Standard deviation (N) of the fast part of the stiffness path's error."""
    relative = (p.stiffness_relative_sigma + p.thermal.softening * p.thermal.sigma) * s.force
    relative = hypot(relative, s.effects.terms.sigma)
    relative = hypot(relative, s.slope * effects.thickness_sigma(s.effects) / p.gear_gain)
    if s.late > 0.0 and m.dt > 0.0:
        # Whether the speed beside a late angle is of its moment or of an earlier one nobody knows: it gained this meanwhile.
        relative = hypot(relative, 0.5 * s.late * s.late * s.slope * s.gear_slope * (m.speed - s.speed) / m.dt)
    return sqrt(p.stiffness_sigma * p.stiffness_sigma + relative * relative)


@njit
def _predict(s, p, m, spread, warmth, known):
    """Time update of all hypotheses, then of the motor's heat."""
    current_torque = p.torque_constant * s.current_sigma
    noise = current_torque * current_torque
    decay, noise_decay = exp(-m.dt / p.stiffness_correlation_time), exp(-m.dt / p.current_correlation_time)
    walked = s.sensitivity[1]
    rise = pads_rise(s, p.thermal) if s.temperature_known else 0.0
    softening = softening_sigma(p, rise, s.temperature_sigma, s.history_sigma)
    set_walks(walked, p, s.error, s.covariance, s.winding, s.housing, softening, s.power, s.offset_walk, m.dt)
    walked[CONTACT] += s.contact_walk * m.dt
    s.straying.gained += walked[CONTACT]
    walked[CONTACT] += s.straying.walked
    if s.offset_age_s > 0.0:
        s.offset_age_s += m.dt
    if s.contact_age_s > 0.0:
        s.contact_age_s += m.dt
    # New uncertainty of the pads' temperature adds to that of the stiffness.
    walked[SCALE] += max(softening - s.softening, 0.0) * (softening + s.softening)
    s.softening = softening
    if known:
        walked[CONTACT] = walked[SCALE] = 0.0
        for i in CREEPS:
            walked[i] = 0.0
    predict_errors(s.error, s.covariance, decay, noise_decay, noise, walked)
    for kind in range(ALTERNATIVES):
        a = s.alternatives[kind]
        if not exists(a):
            continue
        if kind == DRIFT:
            add_drift_walks(walked, p, m.wheel_speed != 0.0, a.log_odds > PROVEN, m.dt)
        predict_errors(a.error, a.covariance, decay, noise_decay, noise, walked)
        place(s, a, p, s.factor * s.scale, warmth)
    if m.dt > ONE_CYCLE_S:
        lag_error = p.relaxation_time * s.slope * s.gear_slope * (m.speed - (m.angle - s.angle) / m.dt)
        s.covariance[FAST, FAST] += sq(lag_error / spread)
    share = p.torque_constant * m.current_q / ((p.gear_gain + p.load_friction) * p.maximum_force)
    for_ever = share * share if m.has_current else s.housing
    s.winding += (1.0 - exp(-m.dt / WINDING_S)) * (for_ever - s.winding)
    s.housing += (1.0 - exp(-m.dt / HOUSING_S)) * (for_ever - s.housing)


@njit
def _moving_variance(s, p, m):
    """Variance, (N m)^2, of one torque from noise of the speeds, from the difference in time between current and angle, and
    from what a filter's inverse adds to the noise of a current, whatever part of it is behind the filter."""
    unknown_speed = s.speed_sigma if m.dt <= ONE_CYCLE_S else s.speed_sigma + abs(m.speed) + abs(s.speed)
    speed_torque = p.inertia * unknown_speed / CYCLE_S
    apart = LATE_CYCLES + (s.late + abs(effects.known_delay(p.effects))) / CYCLE_S
    late = apart * p.torque_constant * (m.current_q - s.current_before) if s.had_current else 0.0
    lag = max(s.alignment.lag, 0.0)
    added = 2.0 * lag * (1.0 + lag) * sq(p.torque_constant * s.current_sigma)
    return 2.0 * speed_torque * speed_torque + late * late + added


@njit
def _changing(s, p, m):
    """What the motor torque has changed by in this cycle and the one before, beyond noise, N m."""
    changed = abs(p.torque_constant * (m.current_q - s.current_before)) if s.had_current else 0.0
    return max(changed + abs(s.current_change) - _NOISES * p.torque_constant * s.current_sigma, 0.0)


@njit
def _follow_nearer(s, p, m, h, leverage, innovation, variance):
    """Weigh a nearer contact by what the first hypothesis has just learned from."""
    n = s.nearer
    place_nearer(n, s.past_contact, p.curve, s.factor * s.scale)
    if m.angle != s.angle:
        decay, noise_decay = exp(-m.dt / p.stiffness_correlation_time), exp(-m.dt / p.current_correlation_time)
        doubted = sq(_LATER * _changing(s, p, m))
        follow_nearer(n, h, s.gain, leverage, innovation, variance, decay, noise_decay, doubted)
    elif s.past_contact < -_BACK * s.clearance:
        rest_nearer(n)


@njit
def _presses_open(s, p, m, torque):
    """Whether the motor stands or stops as far open as it has been, and more than friction says that it would open on: against
    a stop, of whose force nothing is known."""
    stands = m.angle <= s.lowest + FLICKER_RAD and abs(m.speed) < STANDING_RAD_PER_S
    return (
        stands and s.past_contact < 0.0 and torque < -p.offset_friction - BEYOND_CHANCE * p.torque_constant * s.current_sigma
    )


@njit
def _take_torque(s, p, m, torque, leverage, mean_force, friction_variance, spread, warmth, trusted, known, out):
    """Update all hypotheses, and their odds, with one torque; fills torque sigma and innovation of ``out``.

    Returns the standard deviation of the torque (N m) but for what is not known of the friction state, of a motor that turns
    and of one that stands."""
    h, speed, s_mean = s.sensitivity[0], 0.5 * (m.speed + s.speed), s.friction_mean
    moving = _moving_variance(s, p, m)
    friction_torque = p.offset_friction + p.load_friction * max(mean_force + s.spring_force, 0.0) * s.gear_slope
    friction_torque *= s.gear_friction
    doubted = s.effects.terms.torque_sigma
    lasting = p.torque_lasting_sigma * leverage * max(mean_force + s.spring_force, 0.0)
    white = moving + friction_torque * friction_torque * friction_variance + doubted * doubted + lasting * lasting
    out.torque_sigma = sqrt(white) / leverage
    # At standstill the errors of the friction state, and of a term outside its range, are constant, so that many samples
    # contain no more information than one. So is an error that no model explains, for some stops.
    white += (sq(friction_torque * s.friction_variance) + doubted * doubted) / (DISSOLVING_PER_S * m.dt)
    white += lasting * lasting * _LASTS_S / m.dt
    slow_friction, accelerating, needed = needed_torque(s, p, m, mean_force, leverage)
    to_force(h, s, spread, s.slope, s.force, warmth)
    slope = s.gear_slope
    load = mean_force + s.spring_force
    wanted = s.motor_torque - torque + leverage * mean_force
    changed = torque_change(s, p, m, wanted)
    s.wanted = wanted
    to_torque(h, leverage, slope, s_mean, load, speed, slow_friction, accelerating, needed, changed, s.winding, s.housing)
    if not known and m.dt <= ONE_CYCLE_S and s.past_contact < -_BACK * s.clearance:
        wanted += s.error[OFFSET]
        compare(s.alignment, s.motor_torque, wanted, wanted - p.inertia * (m.speed - s.speed) / m.dt, sqrt(moving))
    else:
        interrupt(s.alignment)
    fast, followed = h[FAST] * h[FAST] * s.covariance[FAST, FAST], h[FAST] * s.error[FAST]
    periodic = leverage * uneven.applied(s.uneven)
    unexplained = torque - leverage * mean_force - periodic
    first, variance = learn(s.error, s.covariance, s.gain, h, unexplained, white, trusted)
    slow = max(variance - white - fast, 0.0)
    out.torque_sigma = sqrt(out.torque_sigma * out.torque_sigma + slow / (leverage * leverage))
    out.innovation, out.innovation_sigma = first / leverage, sqrt(variance) / leverage
    s.beyond = first / leverage if trusted and m.angle != s.angle else np.nan
    noise = (moving + sq(p.torque_constant * s.current_sigma)) / sq(leverage)
    s.beyond_variance = max(sq(out.torque_sigma) - _AVERAGED * noise, 0.0)
    if trusted and not known:
        watch_steps(s, p, first / sqrt(variance), m.speed, m.dt)
        _follow_nearer(s, p, m, h, leverage, first, variance)
    for kind in range(ALTERNATIVES):
        a = s.alternatives[kind]
        if not exists(a):
            continue
        to_force(h, s, spread, a.slope, s.force + a.shift, warmth)
        taken = needed + leverage * a.shift
        load_a = load + a.shift
        to_torque(h, leverage, slope, s_mean, load_a, speed, slow_friction, accelerating, taken, changed, s.winding, s.housing)
        second, variance_a = learn(a.error, a.covariance, s.gain, h, unexplained - leverage * a.shift, white, trusted)
        if trusted:
            least, most = drift_odds(s) if kind == DRIFT else (a.least, np.inf)
            weigh(a, least, most, first, variance, second, variance_a)
        if kind != DRIFT and abs(second) / sqrt(variance_a) < abs(out.innovation) / out.innovation_sigma:
            out.innovation, out.innovation_sigma = second / leverage, sqrt(variance_a) / leverage
    stay_finite(s)
    if trusted and not known and m.angle != s.angle and m.wheel_speed > TURNING_RAD_PER_S and not suspected(s):
        if effects.open_phases(s.effects):
            weigh_phases(s.phases, s.effects, leverage, first + followed, variance - fast)
        if not undecided(s.effects):
            uneven.learn(s.uneven, leverage, first + periodic, variance, m.dt)
    current = p.torque_constant * s.current_sigma
    slow += lasting * lasting
    return sqrt(moving + slow), sqrt(current * current + slow)


@njit
def fuse(
    s: Record, p: Record, m: Record, force_before: float, torque: float, leverage: float, friction_variance: float, out: Record
) -> tuple[float, float]:
    """All hypotheses over the errors of both paths; fills force, sigma and innovation of ``out``.

    Returns the standard deviation of the torque (N m) but for what is not known of the friction state, of a motor that turns
    and of one that stands; infinite without a torque."""
    warmth = disc_warmth(s)
    known, h, spread = p.clearance_sigma == 0.0, s.sensitivity[0], _spread(s, p, m)
    _predict(s, p, m, spread, warmth, known)
    follow_phases(s.phases, s.effects, m, s.drive_slope, p.gear_gain, p.relaxation_time)
    uneven.turn(s.uneven, m, s.drive_slope, p.gear_gain, p.relaxation_time)
    if p.sensor.limit > 0.0 and not known:
        hear_sensor(s, p, m, h, spread, warmth, force_before)
    to_force(h, s, spread, s.slope, s.force, warmth)
    out.stiffness_sigma = hypot(sqrt(force_variance(s.covariance, h)), s.memory_sigma)
    out.innovation = out.innovation_sigma = np.nan
    out.torque_sigma = turning_sigma = standing_sigma = np.inf
    if np.isfinite(torque):
        trusted = s.plausibility.verdict == AGREE and not s.unknown and not out_of_step(s.alignment) and _tells(p)
        if trusted != s.trusted:
            # What the alternatives learned around a sensor's fault is not due to the brake.
            open_all(s, p)
            s.trusted = trusted
        mean_force = 0.5 * (force_before + s.force)
        taken = trusted and not _presses_open(s, p, m, torque)
        turning_sigma, standing_sigma = _take_torque(
            s, p, m, torque, leverage, mean_force, friction_variance, spread, warmth, taken, known, out
        )
        # At rest friction's error is constant: neither noise nor new information.
        if trusted and m.angle != s.angle and out.innovation_sigma < _TELLING * p.maximum_force:
            remember(s.consistency, out.innovation, out.innovation_sigma, m.dt)
        s.torque_age = 0.0 if trusted or not _tells(p) else s.torque_age + m.dt
        weigh_step(s, leverage)
        fold(s, warmth, True)
        _learn(s, p, m, trusted, known, warmth)
    else:
        s.torque_age += m.dt
        s.wanted = np.nan
    s.current_change = p.torque_constant * (m.current_q - s.current_before) if s.had_current else 0.0
    s.current_before, s.had_current = m.current_q, m.has_current
    if s.plausibility.verdict == TORQUE_FROZEN:
        # Nothing has jumped; a frozen current was evidence for every jump until it was found.
        open_again(s, p)
    out.force, out.sigma = mix(s, h, spread, warmth)
    if not known:
        if s.contact.engaged:
            out.sigma = hypot(out.sigma, s.stepping.apart)
        _follow_beyond(s, p, m, out)
        _add_beside(s, p, m, out)
    # Not max(), which may return the number if the other is NaN, so that a broken estimate would look like an open brake.
    if out.force < 0.0:
        out.force = 0.0
    out.contact_sigma = contact_sigma(s)
    return turning_sigma, standing_sigma


@njit
def _follow_beyond(s, p, m, out):
    """Where the torque has an error that lasts, which the hypotheses take for noise of so many samples: what the torque of a
    turning motor has said of late beyond the fused force, and the variance of that."""
    if not s.contact.engaged or p.torque_lasting_sigma == 0.0:
        s.mean_beyond = s.beyond_square = 0.0
    elif np.isfinite(s.beyond) and out.torque_sigma < _TELLING * p.maximum_force:
        share = 1.0 - exp(-m.dt / _BEYOND_S)
        s.mean_beyond += share * (s.beyond - (out.force - s.force) - s.mean_beyond)
        s.beyond_square += share * (s.beyond_variance - s.beyond_square)
    if contradicts(s):
        out.sigma = hypot(out.sigma, s.mean_beyond)


@njit
def contradicts(s: Record) -> bool:
    """Whether the torque says more, or less, than its error that lasts explains."""
    return sq(s.mean_beyond) > _SURELY * s.beyond_square


@njit
def _learn(s, p, m, trusted, known, warmth):
    """From a proven change, and from stops that have ended."""
    stops = s.stops
    if trusted and not known and settle(s, p, s.past_contact < -_BACK * p.clearance, m.dt):
        fold(s, warmth, False)
        open_others(s, p)
        forget(s.consistency)
        forget_level(s.contact)
    if s.contact.engaged:
        follow_creep(s)
    if s.stops > stops:
        count_creep(s)
        weigh_common(s, p)
        attribute_straying(s)
        keep(s)
    elif trusted and s.contact.engaged:
        follow_common(s, p, m.dt)


@njit
def _add_beside(s, p, m, out):
    """To force and sigma of all hypotheses what is beside them: the uneven disc, and errors that no hypothesis has."""
    out.force += uneven.applied(s.uneven)
    out.sigma = hypot(out.sigma, hypot(uneven.force_sigma(s.uneven), s.memory_sigma))
    # Error of the travel from the released position by a resolver with a wrong gain.
    out.sigma = hypot(out.sigma, s.slope * s.gear_slope * s.lateness.gain * (m.angle - s.gear_zero))
    # What the zero strays by until torque has shown it.
    strays = straying_sigma(s, _LASTS_S) + abs(s.wander.loss) * _STROKE_S * p.maximum_speed
    out.sigma = hypot(out.sigma, s.slope * s.gear_slope * strays)
    out.sigma = hypot(out.sigma, common_sigma(s, p) * out.force)
    if s.past_contact <= 0.0:
        # Whether pads that are apart still push with what they creep was never seen.
        out.sigma = hypot(out.sigma, crept(s, 0.0))
    else:
        out.sigma = hypot(out.sigma, untold_creep(s))


@njit
def _motor_torque(s, x):
    """Motor torque (N m) from the current, by a hypothesis with the errors ``x``."""
    gain = 1.0 + x[GAIN] + x[FADE] * s.winding + x[HOUSING] * s.housing
    return s.motor_torque * max(gain, _LEAST_GAIN) - x[OFFSET]


@njit
def _beside_force(s, p):
    """Slope of the gear, and how far it may be off, share; force of the release spring, N, and how far that may be off: if the
    angle from the released position is not known, both are anywhere in the brake's range."""
    if s.unknown or s.plausibility.verdict == STIFFNESS_WRONG:
        least, most = steepest(p.gear)
        middle = 0.5 * (least + most)
        half = 0.5 * most_of_spring(p)
        return middle, middle / least - 1.0, half, half
    return s.gear_slope, 0.0, s.spring_force, 0.0


@njit
def _gear(s, p, m, x, slope):
    """Gear gain and load friction (m/rad) and offset friction (N m) of a hypothesis with the errors ``x``, effects and a rise
    at low speed included: a motor that stands is held by all of it."""
    rise = s.gear_friction + x[SLOW] * exp(-abs(m.speed) / SLOW_RAD_PER_S)
    load, coulomb = rise * p.load_friction + x[LOAD], rise * p.offset_friction + x[COULOMB]
    return p.gear_gain * s.gear_gain * slope, max(load, 0.0) * slope, max(coulomb, 0.0)


@njit
def _beyond_friction(s, p, m, x, force, accelerating, spread):
    """`beyond_friction` of a hypothesis with the errors ``x`` and the clamp force ``force`` N."""
    torque = _motor_torque(s, x) - accelerating - x[VISCOUS] * m.speed
    gain, load, coulomb = _gear(s, p, m, x, s.gear_slope)
    return beyond_friction(torque, force + s.spring_force, spread, gain, load, coulomb)


@njit
def _torque_alone(s, p, m):
    """Clamp force and its standard deviation (N) by the torque alone, then that torque if nothing has jumped (N m), the gear
    gain, load friction (m/rad) and offset friction (N m)."""
    slope, slope_unsure, spring, spring_unsure = _beside_force(s, p)
    gain, load, coulomb = _gear(s, p, m, s.error, slope)
    learned = torque = _motor_torque(s, s.error)
    if s.plausibility.verdict == STIFFNESS_WRONG:
        # Beside a wrong angle the motor seemed to have whatever offset made up for it: only what a current sensor may have is
        # taken off.
        most = _OFFSET_LARGE * torque_offset(p)
        torque += s.error[OFFSET] - min(max(s.error[OFFSET], -most), most)
    force, sigma = force_of_torque_alone(s.plausibility, torque, m.has_current, m.dt, gain, load, coulomb, spring)
    sigma = hypot(sigma, hypot(sqrt(s.covariance[OFFSET, OFFSET]) / gain, p.torque_lasting_sigma * force))
    if slope_unsure > 0.0 or spring_unsure > 0.0:
        sigma = hypot(sigma, hypot(slope_unsure * (force + spring), spring_unsure))
    if s.plausibility.verdict == STIFFNESS_WRONG:
        friction = max(p.offset_friction - coulomb, 0.0) + max(p.load_friction * slope - load, 0.0) * force
        # The resolver may have been wrong for a while, and what motor and friction have learned beside it.
        sigma = hypot(sigma, hypot(learned - s.motor_torque, friction) / gain)
    return force, sigma, torque - gain * spring, gain, load, coulomb


@njit
def _tells(p):
    """Whether the stiffness path tells a force at all, by its own calibration."""
    return p.stiffness_relative_sigma < _TELLS_NOTHING


@njit
def _torque_beside_motion(s, p, m, friction_variance):
    """Clamp force and its standard deviation (N) by the torque and by the motion that friction follows, while the contact
    angle says nothing; ``friction_variance`` of the friction state, 1 without a torque."""
    slope, slope_unsure, spring, spring_unsure = _beside_force(s, p)
    gain, load, coulomb = _gear(s, p, m, s.error, slope)
    P = s.covariance
    if gain + load * s.friction_mean < SELF_LOCKING * gain:
        friction_variance = 1.0
    force, sigma = force_beside_friction(s.plausibility, s.friction_mean, friction_variance, gain, load, coulomb, spring)
    of_motor = P[OFFSET, OFFSET] + sq(s.plausibility.steady) * P[GAIN, GAIN] + sq(m.speed) * P[VISCOUS, VISCOUS]
    known = sqrt(P[COULOMB, COULOMB] + sq(force) * P[LOAD, LOAD] + of_motor) / gain
    lasting = p.torque_lasting_sigma * force
    return force, hypot(hypot(sigma, known), hypot(lasting, hypot(slope_unsure * (force + spring), spring_unsure)))


@njit
def _standing_sigmas(s, p, m):
    """Standard deviations (N m) of friction that holds a standing motor, and of what an uneven disc changes the load by."""
    P, load = s.covariance, max(s.force + s.spring_force, 0.0) * s.gear_slope
    known = s.gear_friction * (p.offset_friction + p.load_friction * load)
    friction = P[COULOMB, COULOMB] + sq(load) * P[LOAD, LOAD] + sq(known) * P[SLOW, SLOW]
    wheel_stands = m.has_wheel_speed and m.wheel_speed <= TURNING_RAD_PER_S
    return sqrt(friction), 0.0 if wheel_stands else s.slope * uneven.SWING_M


@njit
def _least_beyond_friction(s, p, m, accelerating, spread):
    """`beyond_friction` of the hypothesis that explains the torque best, among those that may explain it; ``accelerating``:
    what accelerates the motor, N m."""
    beyond = _beyond_friction(s, p, m, s.error, s.force, accelerating, spread)
    for kind in range(DRIFT):
        a = s.alternatives[kind]
        if a.log_odds > _LONG_LIKELY:
            beyond = min(beyond, _beyond_friction(s, p, m, a.error, s.force + a.shift, accelerating, spread))
    return beyond


@njit
def _least_acceleration(s, p, m, stiffness, standing_sigma, friction_sigma):
    """Acceleration, rad/s2, that torque beyond friction causes at least in a motor that seems to stand, by this sample or by
    the smoothed torque, which tells a slow stroke of less. Standard deviations, N m: ``stiffness`` of the load,
    ``standing_sigma`` of the torque, ``friction_sigma``."""
    spread = hypot(stiffness, standing_sigma)
    torque = (_least_beyond_friction(s, p, m, 0.0, spread) - BEYOND_CHANCE) * spread
    if s.plausibility.held > _SMOOTHED:
        P, off = s.covariance, _motor_torque(s, s.error) - s.plausibility.steady
        of_motor = P[OFFSET, OFFSET] + sq(s.plausibility.steady) * P[GAIN, GAIN]
        current = max(sqrt(s.turned_square), p.current_sigma)
        noise = smoothed_sigma(p.torque_constant * current, p.current_correlation_time)
        spread = sqrt(sq(stiffness) + sq(friction_sigma) + sq(noise) + of_motor)
        torque = max(torque, (_least_beyond_friction(s, p, m, off, spread) - BEYOND_CHANCE) * spread)
    return torque / p.inertia


@njit
def _count_against_resolver(s, p, m, turning_sigma, standing_sigma, torque, gain, load, coulomb, out):
    """Counts what the torque says against the angle, by `take_sides`' sigmas and `_torque_alone`'s torque and gear: 1 if a
    motor that seems to stand has more torque than friction carries, 2 if that proves that it turned, else 0."""
    c, swings = s.plausibility, 0
    accelerating = p.inertia * (m.speed - s.speed) / m.dt if m.dt > 0.0 else 0.0
    if m.has_current:
        steady(c, _motor_torque(s, s.error), accelerating, m.dt)
    if m.has_current and stands(c, m.angle):
        noise = smoothed_sigma(p.torque_constant * s.current_sigma, p.current_correlation_time)
        friction_sigma, load_sigma = _standing_sigmas(s, p, m)
        swings = hold(c, s.force, noise, gain, load, coulomb, friction_sigma, load_sigma, p.presliding_angle)
        # A latch holds the motor against any torque, and the stop of an open brake against one that opens it.
        if m.has_status and m.park_brake == 0.0 and (s.force > 0.0 or torque > 0.0):
            acceleration = _least_acceleration(s, p, m, gain * out.stiffness_sigma, standing_sigma, friction_sigma)
            if due(c, acceleration, s.late + effects.known_delay(p.effects), m.dt):
                swings = max(swings, 1)
    if np.isfinite(out.innovation):
        spread = hypot(gain * out.stiffness_sigma, turning_sigma)
        beyond = _least_beyond_friction(s, p, m, accelerating, spread)
        count_contradiction(c, max(beyond, abs(out.innovation) / out.innovation_sigma))
    if swings > 1:
        disbelieve_resolver(c)
    return swings


@njit
def _facts_of_torque(s, p):
    """Facts of the torque path that change neither force nor sigma."""
    facts = 0
    if s.torque_age >= _OLD_S and not (s.unknown or s.plausibility.verdict == STIFFNESS_WRONG):
        # Else the force is the torque's alone.
        facts |= TORQUE_OLD
    jump = max(unproven(s), abs(s.mean_beyond) if contradicts(s) else 0.0)
    if s.contact.engaged:
        jump = max(jump, s.stepping.apart)
    if jump > _NOTED * p.maximum_force:
        facts |= JUMP_SUSPECTED
    if abs(s.error[OFFSET]) > _OFFSET_LARGE * torque_offset(p):
        facts |= OFFSET_LARGE
    if uneven.unproven(s.uneven) > _NOTED * p.maximum_force:
        facts |= DISC_UNEVEN
    if s.late > _TOLD_CYCLES * CYCLE_S or s.lateness.filtered == SLOWEST_S:
        facts |= ANGLE_LATE
    if out_of_step(s.alignment) or at_bound(s.alignment):
        facts |= CURRENT_APART
    if s.sensor.wrong:
        facts |= FORCE_SENSOR_WRONG
    return facts


@njit
def take_sides(
    s: Record, p: Record, m: Record, turning_sigma: float, standing_sigma: float, friction_variance: float, out: Record
) -> int:  # fmt: skip
    """Where the paths contradict each other, use the one that is not implausible; returns the facts. ``turning_sigma`` and
    ``standing_sigma`` N m, as `fuse` returns them; ``friction_variance`` of the friction state, 1 if the torque path says
    nothing."""
    c = s.plausibility
    force, sigma, torque, gain, load, coulomb = _torque_alone(s, p, m)
    swings = _count_against_resolver(s, p, m, turning_sigma, standing_sigma, torque, gain, load, coulomb, out)
    s.no_current_s = 0.0 if m.has_current else s.no_current_s + m.dt
    facts = _facts_of_torque(s, p)
    # A latched brake needs no current: the torque alone then says that nothing is known.
    latched = 0.5 * p.maximum_force if not m.has_status or m.park_brake != 0.0 else 0.0
    if (s.unknown or not _tells(p)) and c.verdict == AGREE and swings == 0:
        # What force belongs to the angle is unknown, but friction follows its motion.
        force, sigma = _torque_beside_motion(s, p, m, friction_variance)
    if s.unknown:
        c.contradiction = 0.0
        if s.seen:
            out.force, out.sigma = force, hypot(sigma, latched)
        else:
            # The torque of the first samples is only noise.
            out.sigma = hypot(sigma, max(latched, force))
        return facts | CONTACT_UNKNOWN | (NO_SOURCE if s.no_current_s > _OLD_S else 0)
    if s.contact.lost:
        # The contact angle was found to be wrong, which explains the contradiction before.
        c.contradiction = 0.0
        facts |= CONTACT_LOST
    error = model_error(s.consistency) if out.force > 0.0 else 0.0
    if error > 0.0:
        out.sigma = hypot(out.sigma, min(error, out.force))
        if error > _NOTED_ERROR * p.maximum_force:
            facts |= MODEL_ERROR
    if c.verdict == STIFFNESS_WRONG:
        out.force, out.sigma = force, hypot(sigma, latched)
        return facts | RESOLVER_IMPLAUSIBLE | (NO_SOURCE if s.no_current_s > _OLD_S else 0)
    if c.verdict == UNDECIDED and np.isfinite(out.innovation):
        out.sigma = hypot(out.sigma, out.innovation)
    elif c.verdict == TORQUE_WRONG:
        # An open brake has no force, unless its angle is frozen.
        out.sigma = hypot(out.sigma, max(force - out.force, 0.0))
    if swings > 0 and c.verdict == AGREE:
        out.sigma = hypot(out.sigma, hypot(sigma, force - out.force))
        facts |= PATHS_CONTRADICT
    if c.verdict == TORQUE_FROZEN:
        facts |= CURRENT_IMPLAUSIBLE
    elif c.verdict != AGREE:
        facts |= PATHS_CONTRADICT
    elif (s.contact.lost and out.stiffness_sigma > out.torque_sigma) or (np.isfinite(out.torque_sigma) and not _tells(p)):
        out.force, out.sigma = force, sigma
        facts |= CONTACT_SOUGHT
    return facts
