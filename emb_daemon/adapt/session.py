"""What adaptation does in a tick: watch for the chance, ask, collect, wait for the evaluation, take its outcome over.

Training is asked for once per application of the park brake. Motion that comes unasked while the park brake is applied is
used too; then whoever moves the brake may raise BrakeRequest with it, so that only an asked training ends on it.
"""

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.fit import settle, unexplained_step
from emb_daemon.estimator.answer import answer_row
from emb_daemon.jit import njit
from emb_daemon.models.fusion import OFFSET
from emb_daemon.wire import contract as e

_NONE, _RUN = 0, 1
_PARK_APPLIED = 1.0
_STANDING_RAD_S = 0.1
#: Time between two samples from which some are missing.
_GAP_S = 0.006
#: Motor travel that counts as motion, and the time without any after which unasked motion is over.
_MOTION_RAD, _STILL_S = 0.3, 3.0
#: Time constant of the smoothed torque force, the share of the high force below which the pads count as released, and the
#: time over which collecting goes on after a full stroke.
_SMOOTHING_S, _LOW, _TAIL_S = 0.25, 0.04, 1.0
#: Rows over which the path models are run up to the moment at which learned values take effect: many time constants.
_RUN_UP = 700
_BAD = (
    e.RESOLVER_LOST | e.CURRENT_LOST | e.THERMOCOUPLE_LOST | e.VEHICLE_STATUS_LOST | e.E2E_ERROR | e.OUT_OF_RANGE
    | e.STUCK | e.TEMPERATURE_UNCERTAIN
)  # fmt: skip


@njit
def _obstacle(a, m, estimate, limits):
    """ACCEPTED if training may go on, or what forbids it. A gap is bridged for as long as the estimate is."""
    if not estimate.is_sample:
        return r.BAD_INPUT if estimate.source == e.INVALID else r.ACCEPTED
    if estimate.reasons & _BAD or not m.has_status:
        return r.BAD_INPUT
    if m.park_brake != _PARK_APPLIED:
        return r.PARK_BRAKE_LEFT
    if m.vehicle_speed > 0.0 or (m.has_wheel_speed and m.wheel_speed > _STANDING_RAD_S):
        return r.VEHICLE_MOVED
    if a.asked and m.brake_request != 0.0:
        return r.BRAKE_REQUESTED
    if not limits.minimum_ambient <= a.ambient <= limits.maximum_ambient or abs(a.rise) > limits.maximum_rise:
        return r.TOO_WARM
    return r.ACCEPTED


@njit
def end(a, verdict, result):
    """Back to idle; nothing that was collected survives."""
    a.phase = r.IDLE
    a.rows = 0
    a.wanted = a.ready = False
    a.parked_time = 0.0
    if a.asked or result != r.RESULT_ABORTED:
        a.result, a.verdict = result, verdict
        a.settled = True
    a.asked = False


@njit
def _begin(a, phase):
    a.phase = phase
    a.asked = phase == r.ASKING
    a.phase_time = a.tail_time = 0.0
    a.was_low = a.was_high = False
    a.rows = 0


@njit
def _collect(a, rows, m, estimate):
    row = rows[a.rows]
    row.dt, row.angle, row.speed = m.dt, m.angle, m.speed
    # The current is a cycle's mean: it does not tell of the acceleration over a gap.
    row.current_q, row.has_current = m.current_q, m.has_current and m.dt < _GAP_S
    row.wheel_speed, row.has_wheel_speed = m.wheel_speed, m.has_wheel_speed
    row.wheel_pulse, row.has_wheel_pulse = m.wheel_pulse, m.has_wheel_pulse
    row.caliper, row.has_thermocouple = m.caliper, m.has_thermocouple
    row.factor = estimate.stiffness_factor
    a.rows += 1


@njit
def _stroke(a, limits, dt):
    """Whether a whole stroke lies behind: released, clamped, released, and a little more."""
    low = a.force < _LOW * limits.high_force
    if a.was_high:
        if low or a.tail_time > 0.0:
            a.tail_time += dt
    elif low:
        a.was_low = True
    elif a.was_low and a.force > limits.coverage * limits.high_force:
        a.was_high = True
    return a.tail_time > _TAIL_S


@njit
def _progress(a, limits):
    if a.phase == r.EVALUATING:
        return 95
    share = min(max(a.force / limits.high_force, 0.0), 1.0)
    if a.was_high:
        return int(90 - 40 * share)
    return int(5 + 45 * share) if a.was_low else 0


@njit
def take_over(s, p, scratch, rows, learned):
    """Put learned values into a corner's parameters and bring its path models to the last of ``rows`` with them."""
    for i in range(len(p.curve)):
        p.curve[i] = learned.curve[i]
    p.load_friction, p.offset_friction = learned.load_friction, learned.offset_friction
    p.presliding_angle = learned.presliding_angle
    p.stiffness_sigma, p.stiffness_relative_sigma = learned.stiffness_sigma, learned.stiffness_relative_sigma
    if np.isfinite(learned.clearance):
        p.clearance = learned.clearance
    first = max(0, len(rows) - _RUN_UP)
    scratch[0] = s
    t = scratch[0]
    t.contact_angle = learned.contact_angle
    settle(t, p, rows[first])
    for i in range(first + 1, len(rows)):
        unexplained_step(t, p, rows[i])
    s.contact_angle, s.past_contact = t.contact_angle, t.past_contact
    s.drive, s.drive_slope, s.force, s.slope = t.drive, t.drive_slope, t.force, t.slope
    s.friction_state, s.friction_variance, s.slid_angle = t.friction_state, t.friction_variance, t.slid_angle
    s.effects = t.effects
    # Curve and contact angle err together, which the stiffness path's sigma covers; the filter's own contact state holds
    # what may still differ for this very curve.
    for i in range(len(s.error)):
        # An offset of the current sensor is no part of what was learned.
        if i != OFFSET:
            s.error[i] = 0.0
        for j in range(len(s.error)):
            if i != j:
                s.covariance[i, j] = 0.0
    s.covariance[0, 0] = 1.0
    s.covariance[1, 1] = s.contact.prior = learned.contact_given_curve_sigma**2
    s.contact.confirmed, s.contact.lost = True, False


@njit
def _effect(a, s, p, scratch, rows):
    """The moment for the outcome of an evaluation."""
    if not a.ready:
        end(a, r.NOT_IN_TIME, r.RESULT_ABORTED)
    elif a.learned.verdict == r.ACCEPTED:
        take_over(s, p, scratch, rows[: a.rows], a.learned)
        end(a, r.ACCEPTED, r.RESULT_ACCEPTED)
    else:
        end(a, a.learned.verdict, r.RESULT_REJECTED)
    a.tried = True


@njit
def observe(a, s, p, limits, scratch, rows, m, estimate):
    """Advance one corner's adaptation by one estimate, and state it there.

    Args:
        a: ADAPTER record.
        s, p: STATE and PARAMETERS records of the corner.
        limits: LIMITS record.
        scratch: STATE array, shape (1,).
        rows: TRAINING array, shape (CAPACITY,).
        m, estimate: SAMPLE and ESTIMATE; the sample is old if the estimate is a prediction.
    """
    if not limits.enabled:
        return
    if estimate.is_sample:
        _follow(a, s, m, estimate)
    obstacle = _obstacle(a, m, estimate, limits)
    if obstacle == r.PARK_BRAKE_LEFT:
        a.tried = False
    if obstacle != r.ACCEPTED:
        if a.phase != r.IDLE:
            end(a, obstacle, r.RESULT_ABORTED)
        a.parked_time = 0.0
    elif not estimate.is_sample:
        pass
    elif a.phase == r.IDLE:
        a.parked_time = 0.0 if m.brake_request != 0.0 else a.parked_time + m.dt
        if not a.tried:
            if a.still_time == 0.0:
                _begin(a, r.WATCHING)
            elif a.parked_time >= limits.settling_time:
                _begin(a, r.ASKING)
    else:
        _advance(a, s, p, limits, scratch, rows, m, estimate)
    estimate.adapt_request = _RUN if a.phase == r.ASKING else _NONE
    estimate.adapt_progress = 100 if a.result == r.RESULT_ACCEPTED else 0
    if a.phase != r.IDLE:
        estimate.adapt_progress = _progress(a, limits)
        # Reasons say what is degraded meanwhile, and Status with them.
        if estimate.mode == e.RUNNING or estimate.mode == e.DEGRADED:
            estimate.mode = e.ADAPTING
    estimate.adapt_result = a.result if a.phase == r.IDLE else r.NO_RESULT


@njit
def _follow(a, s, m, estimate):
    """Keep account of motion, smoothed force and temperature."""
    if not a.started:
        a.started = True
        a.power_on_angle = a.still_angle = m.angle
        a.still_time = _STILL_S
    if abs(m.angle - a.still_angle) > _MOTION_RAD:
        a.still_angle, a.still_time = m.angle, 0.0
    else:
        a.still_time += m.dt
    if np.isfinite(estimate.torque_force):
        a.force += min(1.0, m.dt / _SMOOTHING_S) * (estimate.torque_force - a.force)
    a.ambient = m.ambient if m.has_status else np.nan
    a.rise = 0.5 * (s.mean[0] + s.mean[1]) - m.ambient if s.temperature_known and m.has_status else np.nan
    a.time_ns = estimate.time_ns


@njit
def _advance(a, s, p, limits, scratch, rows, m, estimate):
    """A phase other than idle, nothing being in the way."""
    a.phase_time += m.dt
    if a.phase == r.EVALUATING:
        _collect(a, rows, m, estimate)
        if a.rows - a.training_rows >= r.EVALUATION_SAMPLES:
            _effect(a, s, p, scratch, rows)
        return
    if a.phase == r.ASKING and a.rows == 0 and a.still_time > 0.0:
        if a.phase_time > limits.answer_time:
            a.tried = True
            end(a, r.NO_ANSWER, r.RESULT_ABORTED)
        return
    _collect(a, rows, m, estimate)
    if _stroke(a, limits, m.dt):
        a.phase, a.training_rows, a.ready, a.wanted = r.EVALUATING, a.rows, False, True
        a.generation += 1
    elif a.phase == r.WATCHING and a.still_time > _STILL_S:
        end(a, r.ACCEPTED, r.RESULT_ABORTED)
    elif a.rows >= r.TRAINING_SAMPLES or a.phase_time > limits.answer_time + limits.longest_training:
        a.tried = True
        end(a, r.TOO_LONG, r.RESULT_ABORTED)


@njit
def answer_adapting(samples, first, count, states, parameters, estimates, adapters, limits, scratch, rows):
    """`pipeline.answer` from row ``first``, with adaptation.

    Returns the row at which to go on: ``count``, or earlier if a training then waits for its evaluation."""
    for number in range(first, count):
        m, estimate = samples[number], estimates[number]
        index = m.corner
        answer_row(m, states[index], parameters[index], estimate)
        a = adapters[index]
        observe(a, states[index], parameters[index], limits[index], scratch, rows[index], m, estimate)
        if a.wanted:
            return number + 1
    return count
