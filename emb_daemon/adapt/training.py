"""The part of adaptation in a tick: wait for an opportunity, request motion, collect, wait for the evaluation, apply the
result.

Training is requested once per application of the park brake. Motion without a request while the park brake is applied is used
too. The controller may then raise BrakeRequest for this motion, so BrakeRequest ends only a requested training.
"""

from math import exp, log

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.fit import unexplained_step
from emb_daemon.estimator.answer import answer_row, forget_contested
from emb_daemon.estimator.common import forget_common, weigh_common
from emb_daemon.estimator.hypotheses import DRIFT, covariance_of, drift_share_odds, expected, jump_odds, open_all, open_changes
from emb_daemon.estimator.paths import ONE_CYCLE_S
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, STATE
from emb_daemon.estimator.restart import SNAPSHOT_S
from emb_daemon.estimator.rewind import keep_all
from emb_daemon.estimator.unknown import contact_jump
from emb_daemon.jit import Array, Record, Records, entry, hypot, njit, sq
from emb_daemon.models.fusion import CONTACT, FADE, FAST, GAIN, HOUSING, INERTIA, OF_THE_MODEL, OFFSET, SCALE
from emb_daemon.wire import contract as e

#: Wheel speed up to which a wheel counts as standing, rad/s: some 3 cm/s at the rim.
_STANDING_RAD_S = 0.1
#: Number of pulses that shows a turning wheel: a single one may come from an edge that stands just at the sensor.
_ROLLED_PULSES = 2
#: Age of another corner's estimate from which it is not used.
_SILENT_NS = 100_000_000
#: Motor travel that counts as motion, and the time without motion after which motion without request has ended.
_MOTION_RAD, _STILL_S = 0.3, 3.0
#: Time constant of the smoothed torque force, the share of the high force below which the pads count as released, and the
#: time over which collecting goes on after a full stroke.
_SMOOTHING_S, _LOW, _TAIL_S = 0.25, 0.04, 1.0
#: Standard deviations within which a stroke's contact angle agrees with the filter's: 95 % of those of a brake that is as it
#: was, which thus pays nothing for the others.
_AGREE = 2.0
#: States of the motor and its current sensor.
_OF_THE_MOTOR = (GAIN, OFFSET, FADE, HOUSING, INERTIA)
#: Reasons that prevent or end training: what it learns from is missing or doubted.
_PREVENTING = (
    e.RESOLVER_LOST | e.CURRENT_LOST | e.THERMOCOUPLE_LOST | e.VEHICLE_STATUS_LOST | e.E2E_ERROR | e.OUT_OF_RANGE
    | e.STUCK | e.TEMPERATURE_UNCERTAIN
)  # fmt: skip


@njit
def _obstacle(a, m, estimate, limits, others_hold):
    """ACCEPTED if training may continue, else the reason why not. Gaps in the input are tolerated as long as the estimate is
    predicted."""
    if a.phase == r.ASKING and not others_hold:
        return r.OTHERS_NOT_HOLDING
    if not estimate.is_sample:
        return r.BAD_INPUT if estimate.source == e.INVALID else r.ACCEPTED
    if estimate.reasons & _PREVENTING or not m.has_status:
        return r.BAD_INPUT
    if m.park_brake != e.PARK_APPLIED:
        return r.PARK_BRAKE_LEFT
    if m.vehicle_speed > 0.0 or (m.has_wheel_speed and m.wheel_speed > _STANDING_RAD_S) or _has_rolled(a, m):
        return r.VEHICLE_MOVED
    if a.asked and m.brake_request != 0.0:
        return r.BRAKE_REQUESTED
    if not limits.minimum_ambient <= a.ambient <= limits.maximum_ambient:
        return r.AMBIENT
    return r.ACCEPTED


@njit
def _has_rolled(a, m):
    """Whether the wheel has turned since the car came to a stand."""
    if not m.has_wheel_pulse:
        return False
    pulses = (m.wheel_pulse - a.pulse) % e.PULSE_MODULO
    if min(pulses, e.PULSE_MODULO - pulses) < _ROLLED_PULSES:
        return False
    a.pulse = m.wheel_pulse
    return True


@njit
def others_hold(adapters: Records, limits: Records, k: int, time_ns: int) -> bool:
    """Whether every other corner that this process estimates holds its parking force, so that the car does not move while
    corner ``k`` is opened. A corner that is being trained, or that sends nothing, does not count as holding."""
    for other in range(len(adapters)):
        o = adapters[other]
        silent = time_ns - o.time_ns > _SILENT_NS
        if other != k and limits[other].estimated and (silent or not o.holding or o.phase == r.ASKING):
            return False
    return True


@njit
def end_training(a: Record, outcome: int, result: int) -> None:
    """Return to idle and discard everything collected."""
    a.phase = r.IDLE
    a.rows = 0
    a.evaluation_wanted = a.evaluation_ready = False
    a.parked_time = 0.0
    if a.asked or result != e.RESULT_ABORTED:
        a.result, a.outcome = result, outcome
        a.ended = True
    a.asked = False


@njit
def _begin(a, phase):
    a.phase = phase
    a.asked = phase == r.ASKING
    a.phase_time = a.tail_time = 0.0
    a.was_low = a.was_high = False
    a.rows = 0


@njit
def _collect(a, s, remembered, rows, m):
    if a.rows == 0:
        remembered[0] = s.effects
        # Neither the training nor a start with unknown pads teaches it: other pads may look like a motor that fades.
        a.fade, a.housing_fade = (s.error[FADE], s.error[HOUSING]) if s.stops > 0.0 else (0.0, 0.0)
        a.driven = s.stops > 0.0
        a.driven_gain, a.driven_inertia = expected(s, GAIN), expected(s, INERTIA)
        # A share that pads, motor and rotor have in common no motion shows.
        a.driven_gain_variance = covariance_of(s, GAIN, GAIN) + s.common
        a.driven_inertia_variance = covariance_of(s, INERTIA, INERTIA) + s.common
        a.driven_covariance = covariance_of(s, GAIN, INERTIA) + s.common
    row = rows[a.rows]
    # As the estimator took them: those of a sample that belong to another moment are aligned.
    row.dt, row.angle, row.speed = m.dt, s.angle, s.speed
    # The current is the mean of one cycle, and does not belong to the acceleration over a gap.
    row.current_q, row.has_current = s.current_before, m.has_current and m.dt <= ONE_CYCLE_S
    row.wheel_speed, row.has_wheel_speed = m.wheel_speed, m.has_wheel_speed
    row.wheel_pulse, row.has_wheel_pulse = m.wheel_pulse, m.has_wheel_pulse
    row.caliper, row.has_thermocouple = m.caliper, m.has_thermocouple
    row.factor, row.faded = s.factor, a.fade * s.winding + a.housing_fade * s.housing
    a.rows += 1


@njit
def _stroke(a, limits, dt):
    """Whether a complete stroke has been made: released, clamped, released, and some time after."""
    low = a.force < _LOW * limits.high_force + limits.low_force
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
def _replace(s, state, error, sigma):
    """Set one state to ``error`` with standard deviation ``sigma``, regardless of its earlier value."""
    for i in range(len(s.error)):
        s.covariance[state, i] = s.covariance[i, state] = 0.0
    s.error[state], s.covariance[state, state] = error, sigma * sigma


@njit
def _reset_fitted(x, P):
    """Zero the errors that the stroke has fitted anew (friction and the stiffness path), and all correlations with states
    other than those of motor and current sensor. Variances stay, except that of FAST, which becomes the stationary one."""
    for i in range(len(x)):
        if i not in _OF_THE_MOTOR:
            if i not in OF_THE_MODEL:
                x[i] = 0.0
            for j in range(len(x)):
                if i != j:
                    P[i, j] = P[j, i] = 0.0
    P[FAST, FAST] = 1.0


@njit
def _brake_of(s, p, kind):
    """Contact angle over the filter's (rad), its variance, and log odds of a brake that is the filter's (0), one whose contact
    has jumped since driving showed it (1), and one that drifts (2)."""
    known = s.covariance[CONTACT, CONTACT]
    if kind == 0:
        return 0.0, known, 0.0
    if kind == 1:
        return 0.0, known + sq(contact_jump(p)), jump_odds(s)
    drift = s.alternatives[DRIFT]
    return drift.error[CONTACT], drift.covariance[CONTACT, CONTACT], drift_share_odds(s)


@njit
def _combine(s, p, moved, variance):
    """How far the contact angle moves when a stroke has found it ``moved`` rad from the filter's, with this ``variance``, and
    the variance that is left, rad^2.

    Where both agree they are weighed by their variances. Otherwise each brake of `_brake_of` may have made the stroke. Their
    odds are those that driving left, times the likelihood of ``moved``; the result has the mean and the variance of the
    mixture."""
    known = s.covariance[CONTACT, CONTACT]
    if sq(moved) < sq(_AGREE) * (known + variance):
        return known / (known + variance) * moved, known * variance / (known + variance)
    likeliest = -np.inf
    total = mean = square = 0.0
    for kind in range(3):
        mean_of, own, log_odds = _brake_of(s, p, kind)
        off, both = moved - mean_of, own + variance
        log_odds -= 0.5 * (off * off / both + log(both))
        # Sums are kept relative to the likeliest so far: far apart, the likelihoods are no numbers.
        before = exp(min(likeliest - log_odds, 0.0))
        likeliest = max(likeliest, log_odds)
        odds = exp(log_odds - likeliest)
        shift = mean_of + own / both * off
        total = before * total + odds
        mean = before * mean + odds * shift
        square = before * square + odds * (shift * shift + own * variance / both)
    mean /= total
    return mean, square / total - mean * mean


@njit
def apply_learned(s: Record, p: Record, reached: Record, rows: Records, learned: Record, a: Record) -> None:
    """Change from ``p`` to ``learned`` PARAMETERS and to the other results of the evaluation in ``a`` (ADAPTER).

    The path models go on from ``reached``, the STATE that they have with the learned values at the end of the training
    (`adapt.fit.reach`), over ``rows``, what has been collected since.

    If the curve is unchanged, driving has shown more of contact and stiffness than one stroke. The stroke's contact angle is
    then combined with the filter's (`_combine`), unless the pads have moved, and the drift hypothesis keeps its odds."""
    moved = a.contact_angle - s.contact_angle
    kept = abs(moved) < contact_jump(p)
    for i in range(len(p.curve)):
        kept = kept and learned.curve[i] == p.curve[i]
    shift, left = _combine(s, p, moved, sq(a.contact_sigma)) if kept else (moved, sq(a.contact_sigma))
    scale = s.scale if kept else 1.0
    apart = s.contact_angle + shift - reached.contact_angle
    reached.contact_angle += apart
    reached.past_contact -= apart
    for i in range(len(rows)):
        unexplained_step(reached, learned, rows[i])
    s.contact_angle, s.past_contact = reached.contact_angle, reached.past_contact
    s.drive, s.drive_slope, s.force, s.slope = reached.drive, reached.drive_slope, reached.force, reached.slope
    for i in range(len(s.held)):
        s.held[i] = reached.held[i]
    s.friction_state, s.friction_variance, s.slid_angle = reached.friction_state, reached.friction_variance, reached.slid_angle
    s.effects = reached.effects
    _reset_fitted(s.error, s.covariance)
    s.covariance[CONTACT, CONTACT] = left
    if not kept:
        # A new curve depends on the torque constant and the inertia of the stroke, and on how the motor had faded before it.
        since = (s.error[FADE] - a.fade) * s.winding + (s.error[HOUSING] - a.housing_fade) * s.housing
        _replace(s, GAIN, -a.torque_error - since, a.torque_error_sigma)
        _replace(s, INERTIA, a.inertia_error, a.inertia_sigma)
        # Driving may still correct what the stroke left uncertain of the new curve.
        s.covariance[SCALE, SCALE] = sq(learned.stiffness_relative_sigma)
    s.scale = scale
    s.contact.confirmed, s.contact.lost = True, False
    drift = s.alternatives[DRIFT]
    if kept:
        _reset_fitted(drift.error, drift.covariance)
        known = drift.covariance[CONTACT, CONTACT]
        share = known / (known + sq(a.contact_sigma))
        drift.error[CONTACT] += share * (moved - drift.error[CONTACT]) - shift
        drift.covariance[CONTACT, CONTACT] = (1.0 - share) * known
        open_changes(s, learned)
    else:
        s.contact_anchor = s.contact_angle
        open_all(s, learned)
        forget_common(s)
    weigh_common(s, learned)
    # What was known before is of a brake with other parameters.
    keep_all(s)


@njit
def _conclude(a, s, parameters, learned, reached, rows):
    """Apply the outcome of an evaluation at its fixed time; ``parameters`` has shape (1,)."""
    if not a.evaluation_ready:
        end_training(a, r.NOT_IN_TIME, e.RESULT_ABORTED)
    elif a.evaluation == r.ACCEPTED:
        apply_learned(s, parameters[0], reached, rows[a.training_rows : a.rows], learned, a)
        parameters[0] = learned
        # Earlier snapshots belong to the values that were in use until now.
        a.snapshot_ns, a.snapshot_wanted = a.time_ns, True
        end_training(a, r.ACCEPTED, e.RESULT_ACCEPTED)
    else:
        end_training(a, a.evaluation, e.RESULT_REJECTED)
    a.tried = True


@njit
def observe(
    a: Record, s: Record, parameters: Records, learned: Record, reached: Record, remembered: Records, limits: Record,
    others_hold: bool, rows: Records, m: Record, estimate: Record,
) -> None:  # fmt: skip
    """Advance one corner's adaptation by one estimate, and write its state into the estimate.

    Args:
        a: ADAPTER record.
        s: STATE record of the corner.
        parameters: its PARAMETERS, shape (1,); ``learned``: the PARAMETERS record that an accepted evaluation copies there.
        reached: STATE record that belongs to them, see `apply_learned`.
        remembered: what the effects of ``s`` remember at the beginning of the training, shape (1,).
        limits: LIMITS record.
        others_hold: whether the other corners hold the car while this corner is opened.
        rows: TRAINING array, shape (CAPACITY,).
        m, estimate: SAMPLE and ESTIMATE; the sample is old if the estimate is a prediction.
    """
    if estimate.is_sample:
        _follow(a, s, parameters[0], limits, m, estimate)
    if not limits.enabled:
        return
    obstacle = _obstacle(a, m, estimate, limits, others_hold)
    if s.rewinds != a.rewinds and obstacle == r.ACCEPTED:
        # What has been collected so far was found to be wrong, for example by a current that comes late.
        obstacle = r.BAD_INPUT
    a.rewinds = s.rewinds
    if obstacle == r.PARK_BRAKE_LEFT:
        a.tried = False
    if obstacle != r.ACCEPTED:
        if a.phase != r.IDLE:
            end_training(a, obstacle, e.RESULT_ABORTED)
        a.parked_time = 0.0
    elif not estimate.is_sample:
        pass
    elif a.phase == r.IDLE:
        a.parked_time = 0.0 if m.brake_request != 0.0 else a.parked_time + m.dt
        if not a.tried:
            if a.still_time == 0.0:
                _begin(a, r.WATCHING)
            elif a.parked_time >= limits.settling_time and others_hold:
                _begin(a, r.ASKING)
    else:
        _advance(a, s, parameters, learned, reached, remembered, limits, rows, m)
    estimate.adapt_request = e.REQUEST_RUN if a.phase == r.ASKING else e.REQUEST_NONE
    estimate.adapt_progress = 100 if a.result == e.RESULT_ACCEPTED else 0
    if a.phase != r.IDLE:
        estimate.adapt_progress = _progress(a, limits)
        if estimate.mode == e.RUNNING:
            estimate.mode = e.ADAPTING
    estimate.adapt_result = a.result if a.phase == r.IDLE else e.NO_RESULT


@njit
def _follow(a, s, p, limits, m, estimate):
    """Update the records of motion, force and temperature."""
    if not a.started:
        a.started = True
        a.power_on_angle = a.still_angle = m.angle
        a.still_time = _STILL_S
        a.pulse = m.wheel_pulse
    if abs(m.angle - a.still_angle) > _MOTION_RAD:
        a.still_angle, a.still_time = m.angle, 0.0
    else:
        a.still_time += m.dt
    if np.isfinite(estimate.torque_force):
        force = estimate.torque_force - s.error[OFFSET] / p.gear_gain
        a.force += min(1.0, m.dt / _SMOOTHING_S) * (force - a.force)
    a.holding = estimate.source != e.INVALID and estimate.force - 2.0 * estimate.sigma >= limits.parking_force
    a.ambient = m.ambient if m.has_status else np.nan
    a.rise = 0.5 * (s.mean[0] + s.mean[1]) - m.ambient if s.temperature_known and m.has_status else np.nan
    # The temperature comes from the thermal model; the learned curve inherits its error.
    t = p.thermal
    a.factor_sigma = (
        t.softening * hypot(s.temperature_sigma, t.sigma) + t.softening_history * hypot(s.history_sigma, t.sigma)
    ) / s.factor
    a.time_ns = estimate.time_ns
    parked = m.has_status and m.park_brake == e.PARK_APPLIED
    if (parked and not a.parked) or a.time_ns - a.snapshot_ns >= 1e9 * SNAPSHOT_S:
        a.snapshot_ns, a.snapshot_wanted = a.time_ns, True
    a.parked = parked


@njit
def _advance(a, s, parameters, learned, reached, remembered, limits, rows, m):
    """Advance a phase other than idle; no obstacle is present."""
    a.phase_time += m.dt
    if a.phase == r.EVALUATING:
        _collect(a, s, remembered, rows, m)
        if a.rows - a.training_rows >= r.EVALUATION_SAMPLES:
            _conclude(a, s, parameters, learned, reached, rows)
        return
    if a.phase == r.ASKING and a.rows == 0 and a.still_time > 0.0:
        if a.phase_time > limits.answer_time:
            a.tried = True
            end_training(a, r.NO_ANSWER, e.RESULT_ABORTED)
        return
    _collect(a, s, remembered, rows, m)
    if _stroke(a, limits, m.dt):
        a.phase, a.training_rows, a.evaluation_ready, a.evaluation_wanted = r.EVALUATING, a.rows, False, True
        a.generation += 1
    elif a.phase == r.WATCHING and a.still_time > _STILL_S:
        end_training(a, r.ACCEPTED, e.RESULT_ABORTED)
    elif a.rows >= r.TRAINING_SAMPLES or a.phase_time > limits.answer_time + limits.longest_training:
        a.tried = True
        end_training(a, r.TOO_LONG, e.RESULT_ABORTED)


@entry(
    Array(SAMPLE), int, int, Array(STATE), Array(PARAMETERS), Array(PARAMETERS), Array(STATE), Array(r.REMEMBERED),
    Array(ESTIMATE), Array(r.ADAPTER), Array(r.LIMITS), Array(r.TRAINING, 2), returns=1,
)  # fmt: skip
def answer_adapting(
    samples: Records, first: int, count: int, states: Records, parameters: Records, learned: Records, reached: Records,
    remembered: Records, estimates: Records, adapters: Records, limits: Records, rows: Records,
) -> int:  # fmt: skip
    """Estimate samples from row ``first``, with adaptation.

    Returns the row at which to go on: ``count``, or earlier if a training then waits for its evaluation or has ended."""
    for number in range(first, count):
        m, estimate = samples[number], estimates[number]
        k = m.corner
        forget_contested(states, k, m)
        answer_row(m, states[k], parameters[k], estimate)
        a, own, hold = adapters[k], parameters[k : k + 1], others_hold(adapters, limits, k, estimate.time_ns)
        begun = remembered[k : k + 1]
        observe(a, states[k], own, learned[k], reached[k], begun, limits[k], hold, rows[k], m, estimate)
        if a.evaluation_wanted or a.ended:
            return number + 1
    return count
