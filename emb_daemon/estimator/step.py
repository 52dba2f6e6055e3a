"""One step of one corner: what runs in a tick, on one screen.

`step` is pure but for the state it is given. The daemon, replay, identify and diagnose all call it and nothing else
computes a clamp force.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.estimator.records import (
    CONTACT_UNCERTAIN,
    DEPTHS_M,
    FUSED,
    INIT,
    INVALID,
    OUT_OF_RANGE,
    OUTSIDE_RANGE,
    PATHS_DISAGREE,
    PREDICTED,
    RUNNING,
    STIFFNESS_ONLY,
    STUCK,
    TEMPERATURE_UNCERTAIN,
    TORQUE_ONLY,
)
from emb_daemon.jit import njit
from emb_daemon.models.contact import (
    NOTHING,
    TOO_EARLY,
    clearance_level,
    clearly_above,
    engaged,
    start_anew,
    threshold,
    torque_bias,
    torque_sigma,
    watch_closing,
)
from emb_daemon.models.fusion import OFFSET, STATES, maximum_likelihood, predict_errors, update_errors, variance_along
from emb_daemon.models.plausibility import (
    AGREE,
    STIFFNESS_WRONG,
    TORQUE_FROZEN,
    UNDECIDED,
    beyond_friction,
    count_doubt,
    force_of_torque_alone,
    frozen,
    watch,
)
from emb_daemon.models.stiffness import characteristic_curve, first_order_lag, mean_slope, travel_at
from emb_daemon.models.thermal import (
    NODES,
    at_depth,
    disc_loss,
    friction_power,
    heat_step,
    mean_temperature,
    stiffness_factor,
)
from emb_daemon.models.torque import friction_state, slid_angle, torque_balance, unexplained_torque

#: The current is averaged over this time before its sample (wire contract), s.
_CYCLE_S = 0.004
_ONE_CYCLE_S = 1.5 * _CYCLE_S
#: Without a resolver sample for this long the last force is no estimate any more: the brake may have opened and closed, s.
SILENCE_S = 0.1
#: Clamp force from which pads and disc exchange heat by contact, N.
TOUCHING_N = 200.0
#: Wheel speed from which pads heat: the sensor's noise at standstill does not.
TURNING_RAD_PER_S = 0.5
#: Doubt of the pads' temperature, after a start with hot pads, that is reported.
_DOUBTED_K = 10.0
#: Time between conduction steps, s: twelve samples, less half a sample against rounding.
_HEAT_STEP_S = 0.046
#: Vibration dissolves what is known of the friction state at this rate while the motor stands, 1/s.
_DISSOLVING_PER_S = 0.05
#: Torque force is unusable where its denominator nears zero (self-locking), as a share of the gear gain.
_SELF_LOCKING = 0.2
#: Half a count of a 4096-count resolver.
FLICKER_RAD = 0.0008
#: A speed beyond the motor's maximum by this factor, and an angle by this many rad more, is no motion.
_SPEED_MARGIN = 1.2
_ANGLE_MARGIN = 0.5
#: Standard deviations of the contact angle, rad: doubtful from, known again below, reported as uncertain from, and unknown.
_DOUBTFUL_RAD, _KNOWN_RAD, _UNCERTAIN_RAD, _UNKNOWN_RAD = 0.05, 0.3, 0.5, 1.0
#: Share of the largest force that the torque must show at power-on for the brake to count as clamped.
_CLAMPED = 0.1
#: A time after which everything has settled, s.
_LONG_S = 1e6
#: Variance that the torque path's relative error gains, 1/s: friction changes over months.
_TORQUE_GAIN_WALK = 1e-9
#: Offset that the motor torque may have, as a standard deviation: share of the torque that the largest force needs; and time
#: in which it drifts as far again, s. An offset that turns out larger is a fault of the current sensor.
_OFFSET, _OFFSET_DRIFTS_S = 0.1, 36000.0
#: Standard deviations of the innovation beyond which a sample teaches the filter nothing: sensors jump, what it learns walks.
_GATE = 5.0


@njit
def _start(s, p, m):
    s.started = True
    s.angle = s.slid_angle = m.angle
    s.speed = m.speed
    s.contact_angle = m.angle + p.clearance
    s.past_contact = -p.clearance
    s.friction_variance = 1.0
    s.torque_age = 1e9
    s.covariance[:, :] = 0.0
    s.covariance[0, 0] = 1.0
    s.covariance[1, 1] = s.contact.prior = p.clearance_sigma * p.clearance_sigma
    s.covariance[2, 2] = p.torque_relative_sigma * p.torque_relative_sigma
    s.covariance[3, 3] = (p.torque_constant * p.current_sigma) ** 2
    s.covariance[OFFSET, OFFSET] = _torque_offset(p) ** 2
    s.balance = np.nan


@njit
def _torque_offset(p):
    """Standard deviation of the motor torque's offset at power-on, N m."""
    return _OFFSET * p.gear_gain * p.maximum_force


@njit
def _follow_zero(s, p, m):
    """Whether the angle jumped as no motor can: then the resolver has a new zero, and the contact angle goes with it.

    What the motor may have turned meanwhile is unknown, so the contact angle becomes uncertain by as much.
    """
    jump = m.angle - s.angle
    # While the resolver was stuck the motor turned on.
    reach = p.maximum_speed * (m.dt + s.plausibility.frozen_s)
    if abs(jump) <= _SPEED_MARGIN * reach + _ANGLE_MARGIN:
        return False
    s.angle += jump
    s.slid_angle += jump
    s.contact_angle += jump
    s.covariance[1, 1] += reach * reach
    s.contact.prior += reach * reach
    s.contact.confirmed = False
    return True


@njit
def _start_heat(s, t, m):
    """Profiles out of the backing plates alone: right for pads at rest, and doubted by how far the plates are off the caliper.

    The disc takes the plates' mean and the pads lie between.
    """
    s.disc = 0.5 * (m.inner_backplate + m.outer_backplate)
    for node in range(NODES):
        share = t.node_position[node] / t.thickness
        s.pads[0, node] = s.disc + share * (m.inner_backplate - s.disc)
        s.pads[1, node] = s.disc + share * (m.outer_backplate - s.disc)
    s.ambient = s.disc
    s.temperature_doubt = s.history_doubt = abs(s.disc - m.caliper)
    _tell_temperatures(s, t)
    s.history = 0.5 * (s.mean[0] + s.mean[1]) - t.reference
    s.factor = stiffness_factor(t, s.history, s.history)
    s.temperature_known = True


@njit
def _tell_temperatures(s, t):
    for side in range(2):
        s.mean[side] = mean_temperature(s.pads[side], t.node_position)
        for index in range(len(DEPTHS_M)):
            s.depth[side, index] = at_depth(s.pads[side], t.node_position, DEPTHS_M[index])


@njit
def _flow(s, t, e, m):
    """Let the heat of the time since the last heat step flow, and find the stiffness factor anew."""
    dt = s.heat_time
    wheel_speed = s.heat_travel / dt
    # Without vehicle status the last ambient temperature stands: it changes slowly, and a jump would cool the disc.
    if m.has_status:
        s.ambient = m.ambient
    ambient = s.ambient
    # Without thermocouples the backing plates follow the pads' own last nodes: no heat passes.
    inner = m.inner_backplate if m.has_thermocouple else s.pads[0, NODES - 1]
    outer = m.outer_backplate if m.has_thermocouple else s.pads[1, NODES - 1]
    inner, outer = effects.backplates(e, s.effects, inner, outer, dt)
    s.disc = heat_step(t, s.pads, s.disc, inner, outer, ambient, s.heat_energy / dt, s.touching, wheel_speed, dt, s.work)
    s.disc += effects.disc_cooling(e, t.disc_heat_capacity, s.disc, ambient, dt)
    _tell_temperatures(s, t)
    rise = 0.5 * (s.mean[0] + s.mean[1]) - t.reference
    forgotten = exp(-dt / t.history_time)
    s.history = forgotten * s.history + (1.0 - forgotten) * rise
    s.factor = stiffness_factor(t, rise, s.history)
    # A wrong start dies out as the disc, which stores most of it, cools.
    s.temperature_doubt *= exp(-dt * disc_loss(t, s.disc, ambient, wheel_speed) / t.disc_heat_capacity)
    s.history_doubt *= forgotten
    s.heat_time = s.heat_energy = s.heat_travel = 0.0


@njit
def _heat(s, p, m):
    """Pads and disc up to this sample, heated by what the last estimate says.

    A conduction step costs more than all the rest: one serves several samples, as long as the pads' contact stays the same.
    """
    t = p.thermal
    if not s.temperature_known:
        s.factor = 1.0
        if m.has_thermocouple:
            _start_heat(s, t, m)
        return
    touching = s.fused > TOUCHING_N
    if touching != s.touching and s.heat_time > 0.0:
        _flow(s, t, p.effects, m)
    s.touching = touching
    wheel_speed = m.wheel_speed if m.has_wheel_speed else 0.0
    s.heat_time += m.dt
    s.heat_travel += wheel_speed * m.dt
    s.power = 0.0
    if touching and wheel_speed > TURNING_RAD_PER_S:
        if np.isnan(m.brake_torque):
            surface = 0.5 * (s.pads[0, 0] + s.pads[1, 0])
            s.power = friction_power(t, s.fused, wheel_speed, surface) * effects.friction_factor(p.effects, surface)
        else:
            s.power = max(m.brake_torque, 0.0) * wheel_speed
        s.heat_energy += s.power * m.dt
    if s.heat_time >= _HEAT_STEP_S:
        _flow(s, t, p.effects, m)


@njit
def position(s, p, m):
    """Motor angle past contact at this sample, rad; advances the effects that act on it."""
    e, state = p.effects, s.effects
    gained = effects.thickness(e, state, m, s.disc, s.temperature_known, s.power)
    return m.angle + effects.motor_angle(e, state, m) + gained / p.gear_gain - s.contact_angle


@njit
def stiffness_path(s, p, m, factor):
    """Stiffness path: advances the dynamic force and its slope."""
    x = position(s, p, m)
    dt = m.dt
    if dt > _ONE_CYCLE_S:
        # Over a gap the way is unknown but for its end, which the speed tells and the lag remembers best.
        dt = min(0.5 * m.dt, 2.0 * p.relaxation_time)
        _deform(s, p, x - dt * m.speed, m.dt - dt, factor)
    _deform(s, p, x, dt, factor)


@njit
def _deform(s, p, x, dt, factor):
    """The motor turns steadily to ``x`` rad past contact within ``dt`` s."""
    static, slope = characteristic_curve(x, p.curve)
    travel = max(x, 0.0) - max(s.past_contact, 0.0)
    s.past_contact = x
    doubt = s.covariance[1, 1]
    if doubt > _DOUBTFUL_RAD * _DOUBTFUL_RAD:
        slope = mean_slope(x, sqrt(doubt), p.curve)
    drive = effects.static_force(p.effects, s.effects, factor * static, travel, dt)
    s.force = first_order_lag(s.force, s.drive, drive, dt, p.relaxation_time)
    s.slope = first_order_lag(s.slope, s.drive_slope, factor * slope, dt, p.relaxation_time)
    s.drive = drive
    s.drive_slope = factor * slope


@njit
def rest(s, p, x, factor):
    """Bring the stiffness path to where it settles ``x`` rad past contact."""
    s.past_contact = x
    _deform(s, p, x, _LONG_S, factor)


@njit
def torque_path(s, p, m):
    """Torque path over the cycle that ends at this sample.

    Returns (torque left to the clamp force in N m, its leverage gamma + mu s in m/rad, variance of the friction state);
    the torque is NaN where it says nothing.
    """
    travel = m.angle - s.angle
    slid = slid_angle(s.slid_angle, m.angle, FLICKER_RAD) - s.slid_angle
    s.slid_angle += slid
    s.friction_state, mean, s.friction_variance = friction_state(
        s.friction_state, s.friction_variance, slid, p.presliding_angle, _DISSOLVING_PER_S, m.dt
    )
    s.friction_mean = mean
    e, mean_speed = p.effects, 0.5 * (m.speed + s.speed)
    gear, friction = effects.gear(e, m.angle, travel, mean_speed, mean)
    leverage = p.gear_gain * gear + p.load_friction * friction * mean
    if not m.has_current or m.dt <= 0.0 or leverage < _SELF_LOCKING * p.gear_gain:
        return np.nan, leverage, 1.0
    motor_torque = effects.motor_torque(e, m, p.torque_constant, travel, mean_speed, s.disc, s.temperature_known)
    offset_friction = p.offset_friction * friction
    torque = unexplained_torque(motor_torque, p.inertia, m.speed - s.speed, m.dt, offset_friction, mean)
    turning = p.presliding_sigma * (1.0 - mean * mean)
    return torque, leverage, s.friction_variance + turning * turning


@njit
def _watch_contact(s, p, m, force_before, torque, leverage):
    """Whether the pads touch; and if the torque contradicts the believed contact angle, start that anew."""
    c, x, doubt = s.contact, s.past_contact, sqrt(s.covariance[1, 1])
    if p.clearance_sigma == 0.0:
        # Held as exactly known, as diagnose does; no calibration file can say so.
        engaged(c, x, 0.0)
        return
    sigma, current_share = torque_sigma(p.torque_constant * p.current_sigma, p.inertia * p.speed_sigma / _CYCLE_S)
    limit = threshold(current_share, p.current_correlation_time, _CYCLE_S)
    predicted = leverage * 0.5 * (force_before + s.force)
    offset, offset_sigma = s.error[OFFSET], sqrt(s.covariance[OFFSET, OFFSET])
    found = watch_closing(c, torque, predicted, s.friction_mean, sigma, limit, x, doubt, offset, offset_sigma)
    offset, offset_sigma = clearance_level(c, sigma, offset, offset_sigma)
    seen = predicted + c.excess
    if found != NOTHING:
        # Under a wrong belief the filter took for an offset what it was not.
        s.error[OFFSET] = offset
        for i in range(STATES):
            s.covariance[OFFSET, i] = s.covariance[i, OFFSET] = 0.0
        s.covariance[OFFSET, OFFSET] = offset_sigma * offset_sigma
    noticeable = max(leverage * _CLAMPED * p.maximum_force, clearly_above(c, sigma))
    if found == TOO_EARLY:
        _start_contact(s, p, m, 0.0, p.curve[0] * _UNKNOWN_RAD, leverage)
    elif found != NOTHING:
        _start_contact(s, p, m, max(seen, 0.0) / leverage, sigma / leverage, leverage)
    elif not c.confirmed and c.excess > max(predicted, noticeable):
        # Power came while the brake was clamped: no angle from which to count the clearance. Or the torque has an offset.
        s.covariance[OFFSET, OFFSET] += seen * seen
        force = seen / leverage
        friction = (p.offset_friction + p.load_friction * force) * sqrt(s.friction_variance)
        c.level = c.samples = 0.0
        c.engaged = True
        _start_contact(s, p, m, force, (sigma + friction) / leverage, leverage)
    doubt = sqrt(s.covariance[1, 1])
    if doubt < _KNOWN_RAD:
        c.lost = False
    engaged(c, s.past_contact, doubt)


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
    lag = p.relaxation_time * m.speed
    misread = 1.0 / (leverage * slope)
    for i in range(STATES):
        s.covariance[1, i] = s.covariance[i, 1] = misread * s.covariance[OFFSET, i]
    own = (sigma / slope) ** 2 + lag * lag + _KNOWN_RAD * _KNOWN_RAD
    s.covariance[1, 1] = own + misread * misread * s.covariance[OFFSET, OFFSET]
    start_anew(s.contact, s.covariance[1, 1])


@njit
def _fuse(s, p, m, force_before, torque, leverage, friction_variance, out):
    """Kalman filter over the errors of both paths; fills force, sigma and innovation of ``out``."""
    x, P, h = s.error, s.covariance, s.sensitivity
    softening = p.thermal.softening * s.temperature_doubt + p.thermal.softening_history * s.history_doubt
    relative = (p.stiffness_relative_sigma + softening) * s.force
    spread = sqrt(p.stiffness_sigma * p.stiffness_sigma + relative * relative)
    current_torque = p.torque_constant * p.current_sigma
    decay, noise_decay = exp(-m.dt / p.stiffness_correlation_time), exp(-m.dt / p.current_correlation_time)
    walked = p.contact_walk * p.contact_walk * m.dt
    drifted = _torque_offset(p) ** 2 * m.dt / _OFFSET_DRIFTS_S
    predict_errors(x, P, decay, walked, _TORQUE_GAIN_WALK * m.dt, noise_decay, current_torque * current_torque, drifted)
    if m.dt > _ONE_CYCLE_S:
        lag_error = p.relaxation_time * s.slope * (m.speed - (m.angle - s.angle) / m.dt)
        P[0, 0] += (lag_error / spread) ** 2
    s.contact.prior += walked
    # What friction's offset may be wrong by, the torque reads as contact angle, and no number of samples averages it out.
    misread = p.torque_relative_sigma * p.offset_friction / (p.gear_gain * p.curve[0])
    offset = torque_bias(s.contact, P[1, 1], misread)
    h[0], h[1], h[2], h[3], h[4] = spread, -s.slope, 0.0, 0.0, 0.0
    out.stiffness_sigma = sqrt(variance_along(P, h) + (s.slope * offset) ** 2)
    out.innovation = out.innovation_sigma = np.nan
    mean_force = 0.5 * (force_before + s.force)
    friction_torque = p.offset_friction + p.load_friction * max(mean_force, 0.0)
    unknown_speed = p.speed_sigma if m.dt <= _ONE_CYCLE_S else p.speed_sigma + abs(m.speed) + abs(s.speed)
    speed_torque = p.inertia * unknown_speed / _CYCLE_S
    white = 2.0 * speed_torque * speed_torque + friction_torque * friction_torque * friction_variance
    gain_error = p.torque_relative_sigma * mean_force
    offset_error = x[OFFSET] * x[OFFSET] + P[OFFSET, OFFSET]
    noise = white + current_torque * current_torque
    out.torque_sigma = sqrt((noise + offset_error) / (leverage * leverage) + gain_error * gain_error)
    if np.isfinite(torque):
        # At standstill the friction state's error stays what it is: however many samples repeat it, they say it once.
        white += (friction_torque * s.friction_variance) ** 2 / (_DISSOLVING_PER_S * m.dt)
        h[0], h[1], h[2], h[3], h[4] = leverage * spread, -leverage * s.slope, leverage * mean_force, 1.0, 1.0
        innovation = torque - leverage * mean_force
        for i in range(STATES):
            innovation -= h[i] * x[i]
        out.innovation = innovation / leverage
        variance = white + variance_along(P, h)
        if s.plausibility.verdict == AGREE and innovation * innovation < _GATE * _GATE * variance:
            update_errors(x, P, s.gain, innovation, h, white)
            s.torque_age = 0.0
        else:
            s.torque_age += m.dt
        out.innovation_sigma = sqrt(variance) / leverage
    else:
        s.torque_age += m.dt
    # What was learned of the contact angle moves the contact angle itself: the curve is not straight.
    s.contact_angle += x[1]
    s.force -= s.slope * x[1]
    x[1] = 0.0
    h[0], h[1], h[2], h[3], h[4] = spread, -s.slope, 0.0, 0.0, 0.0
    out.force = s.force + spread * x[0]
    # Not max(): of a number and what is none it may return the number, and a broken estimate would look like an open brake.
    if out.force < 0.0:
        out.force = 0.0
    out.sigma = sqrt(variance_along(P, h) + (s.slope * offset) ** 2)
    out.contact_sigma = sqrt(P[1, 1] + offset * offset)


@njit
def _take_sides(s, p, m, out):
    """Where the paths contradict each other, go on with the one that can be right; returns the reasons."""
    c = s.plausibility
    motor_torque = p.torque_constant * m.current_q - s.error[OFFSET]
    force, sigma = force_of_torque_alone(c, motor_torque, m.has_current, m.dt, p.gear_gain, p.load_friction, p.offset_friction)
    if np.isfinite(out.innovation):
        torque = motor_torque - p.inertia * (m.speed - s.speed) / m.dt
        doubt = p.gear_gain * sqrt(out.stiffness_sigma * out.stiffness_sigma + out.torque_sigma * out.torque_sigma)
        beyond = beyond_friction(torque, s.force, doubt, p.gear_gain, p.load_friction, p.offset_friction)
        count_doubt(c, max(beyond, abs(out.innovation) / out.innovation_sigma))
    if s.contact.lost:
        # The contact angle was found wrong and explains what came before.
        c.doubt = 0.0
    if c.verdict == AGREE:
        return PATHS_DISAGREE if abs(s.error[OFFSET]) > _torque_offset(p) else 0
    out.source = STIFFNESS_ONLY
    if c.verdict == STIFFNESS_WRONG:
        out.source = TORQUE_ONLY if m.has_current else INVALID
        out.force, out.sigma = force, sqrt(sigma * sigma + s.covariance[OFFSET, OFFSET] / (p.gear_gain * p.gear_gain))
        return PATHS_DISAGREE | STUCK
    if c.verdict == UNDECIDED and np.isfinite(out.innovation):
        out.sigma = sqrt(out.sigma * out.sigma + out.innovation * out.innovation)
    return PATHS_DISAGREE | STUCK if c.verdict == TORQUE_FROZEN else PATHS_DISAGREE


@njit
def step(s, p, m, out):
    """Advance one corner by one resolver sample.

    Args:
        s: STATE record, changed in place.
        p: PARAMETERS record.
        m: SAMPLE record; ``m.dt`` seconds since the last one, 0 at the first.
        out: ESTIMATE record to fill; the caller owns time, corner, counter and cycle.
    """
    if not s.started:
        _start(s, p, m)
    moved_zero = _follow_zero(s, p, m)
    if 0.0 < m.dt <= _ONE_CYCLE_S and not moved_zero:
        watch(s.plausibility, m, s.angle, s.speed, s.past_contact, sqrt(s.covariance[1, 1]), s.contact.confirmed)
    _heat(s, p, m)
    force_before = s.force
    stiffness_path(s, p, m, s.factor)
    torque, leverage, friction_variance = torque_path(s, p, m)
    if moved_zero:
        torque = np.nan
    # Over a gap the current of its last cycle and the mean acceleration say nothing of each other.
    if m.dt <= _ONE_CYCLE_S and not frozen(s.plausibility):
        _watch_contact(s, p, m, force_before, torque, leverage)
    _fuse(s, p, m, force_before, torque, leverage, friction_variance, out)
    out.stiffness_force = s.force
    # Two cycles: over one, the noise of both speeds counts in full; over more, the mean lags.
    out.torque_force, out.ml_force = np.nan, s.force
    if np.isfinite(torque):
        paired = np.isfinite(s.balance)
        force = torque_balance(torque + s.balance, leverage + s.leverage) if paired else torque_balance(torque, leverage)
        out.torque_force = max(force, 0.0)
        out.ml_force, _ = maximum_likelihood(s.force, out.stiffness_sigma, out.torque_force, out.torque_sigma)
    out.source = FUSED if s.torque_age < 0.05 else STIFFNESS_ONLY
    reasons = _take_sides(s, p, m, out)
    s.angle, s.speed, s.balance, s.leverage = m.angle, m.speed, torque, leverage
    s.fused, s.fused_sigma = out.force, out.sigma
    out.contact_angle = s.contact_angle
    out.stiffness_factor = s.factor
    _temperatures(s, out)
    out.mode = RUNNING
    if moved_zero:
        reasons |= OUT_OF_RANGE
    if not s.temperature_known or s.temperature_doubt > _DOUBTED_K:
        reasons |= TEMPERATURE_UNCERTAIN
    out.engaged = s.contact.engaged
    if s.contact.lost or out.contact_sigma > _UNCERTAIN_RAD:
        reasons |= CONTACT_UNCERTAIN
        if out.stiffness_sigma > out.torque_sigma and out.source == FUSED:
            out.source = TORQUE_ONLY
    if out.force > p.maximum_force or abs(m.speed) > _SPEED_MARGIN * p.maximum_speed:
        reasons |= OUTSIDE_RANGE
    out.reasons = reasons
    if not (np.isfinite(out.force) and np.isfinite(out.sigma)):
        out.source = INVALID


@njit
def _temperatures(s, out):
    known = s.temperature_known
    for side in range(2):
        out.surface[side] = s.pads[side, 0] if known else np.nan
        out.mean[side] = s.mean[side] if known else np.nan
        for index in range(len(DEPTHS_M)):
            out.depth[side, index] = s.depth[side, index] if known else np.nan
    out.disc = s.disc if known else np.nan


@njit
def predict(s, p, age, out):
    """What can be said ``age`` seconds after the last sample: the last force, and how far it may have moved since.

    After `SILENCE_S` nothing can: then the source is Invalid.
    """
    out.mode = RUNNING if s.started else INIT
    out.source = PREDICTED if s.started and age <= SILENCE_S else INVALID
    out.reasons = 0
    # The motor cannot have gone faster than its limit, and no further than full clamp. Clamping changes more than releasing.
    reached, _ = characteristic_curve(s.past_contact + p.maximum_speed * age, p.curve)
    start, _ = characteristic_curve(s.past_contact, p.curve)
    moved = min(s.factor * (reached - start), p.maximum_force)
    out.force = s.fused
    out.sigma = sqrt(s.fused_sigma * s.fused_sigma + moved * moved)
    out.stiffness_force = out.torque_force = out.ml_force = np.nan
    out.contact_angle = s.contact_angle
    out.contact_sigma = sqrt(s.covariance[1, 1])
    out.stiffness_factor = s.factor if s.started else 1.0
    out.innovation = out.innovation_sigma = np.nan
    _temperatures(s, out)
