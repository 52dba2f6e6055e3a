"""Both paths made one: the filter over their errors, and whom to follow where they contradict each other."""

from math import exp, sqrt

import numpy as np

from emb_daemon.estimator.paths import CYCLE_S, DISSOLVING_PER_S, ONE_CYCLE_S
from emb_daemon.estimator.records import INVALID, PATHS_DISAGREE, STIFFNESS_ONLY, STUCK, TORQUE_ONLY
from emb_daemon.jit import njit
from emb_daemon.models.contact import torque_bias
from emb_daemon.models.fusion import OFFSET, STATES, predict_errors, update_errors, variance_along
from emb_daemon.models.plausibility import (
    AGREE,
    STIFFNESS_WRONG,
    TORQUE_FROZEN,
    UNDECIDED,
    beyond_friction,
    count_doubt,
    force_of_torque_alone,
)

#: Variance that the torque path's relative error gains, 1/s: friction changes over months.
_TORQUE_GAIN_WALK = 1e-9
#: Offset that the motor torque may have, as a standard deviation: share of the torque that the largest force needs; and time
#: in which it drifts as far again, s. An offset that turns out larger is a fault of the current sensor.
_OFFSET, _OFFSET_DRIFTS_S = 0.1, 36000.0
#: Standard deviations of the innovation beyond which a sample teaches the filter nothing: sensors jump, what it learns walks.
_GATE = 5.0


@njit
def torque_offset(p):
    """Standard deviation of the motor torque's offset at power-on, N m."""
    return _OFFSET * p.gear_gain * p.maximum_force


@njit
def fuse(s, p, m, force_before, torque, leverage, friction_variance, out):
    """Kalman filter over the errors of both paths; fills force, sigma and innovation of ``out``."""
    x, P, h = s.error, s.covariance, s.sensitivity
    softening = p.thermal.softening * s.temperature_doubt + p.thermal.softening_history * s.history_doubt
    relative = (p.stiffness_relative_sigma + softening) * s.force
    spread = sqrt(p.stiffness_sigma * p.stiffness_sigma + relative * relative)
    current_torque = p.torque_constant * p.current_sigma
    decay, noise_decay = exp(-m.dt / p.stiffness_correlation_time), exp(-m.dt / p.current_correlation_time)
    walked = p.contact_walk * p.contact_walk * m.dt
    drifted = torque_offset(p) ** 2 * m.dt / _OFFSET_DRIFTS_S
    predict_errors(x, P, decay, walked, _TORQUE_GAIN_WALK * m.dt, noise_decay, current_torque * current_torque, drifted)
    if m.dt > ONE_CYCLE_S:
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
    unknown_speed = p.speed_sigma if m.dt <= ONE_CYCLE_S else p.speed_sigma + abs(m.speed) + abs(s.speed)
    speed_torque = p.inertia * unknown_speed / CYCLE_S
    white = 2.0 * speed_torque * speed_torque + friction_torque * friction_torque * friction_variance
    gain_error = p.torque_relative_sigma * mean_force
    offset_error = x[OFFSET] * x[OFFSET] + P[OFFSET, OFFSET]
    noise = white + current_torque * current_torque
    out.torque_sigma = sqrt((noise + offset_error) / (leverage * leverage) + gain_error * gain_error)
    if np.isfinite(torque):
        # At standstill the friction state's error stays what it is: however many samples repeat it, they say it once.
        white += (friction_torque * s.friction_variance) ** 2 / (DISSOLVING_PER_S * m.dt)
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
def take_sides(s, p, m, out):
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
        return PATHS_DISAGREE if abs(s.error[OFFSET]) > torque_offset(p) else 0
    out.source = STIFFNESS_ONLY
    if c.verdict == STIFFNESS_WRONG:
        out.source = TORQUE_ONLY if m.has_current else INVALID
        out.force, out.sigma = force, sqrt(sigma * sigma + s.covariance[OFFSET, OFFSET] / (p.gear_gain * p.gear_gain))
        return PATHS_DISAGREE | STUCK
    if c.verdict == UNDECIDED and np.isfinite(out.innovation):
        out.sigma = sqrt(out.sigma * out.sigma + out.innovation * out.innovation)
    return PATHS_DISAGREE | STUCK if c.verdict == TORQUE_FROZEN else PATHS_DISAGREE
