"""Contact of pads and disc: when the brake engages, and when the estimated contact angle cannot be right.

Thesis 2.5 signals contact when lambda = dT_m/dtheta exceeds a threshold. A difference of torques at 4 ms is mostly noise, so
lambda is used in its integrated form: the rise of the torque over its level in the clearance, summed one-sidedly (Page,
"Continuous inspection schemes", Biometrika 41, 1954). The level is learned in each clearance, so that an offset of current or
friction raises no alarm. At speed the torque cannot show contact within a few radians; there contact is signalled as soon as
the motor has passed the tracked contact angle by several of its standard deviations.
"""

from math import exp, log, sqrt

import numpy as np

from emb_daemon.jit import Record, fields, njit, sq

#: ``rise``, ``shortfall``: summed torque above and below that of clearance level and estimated force, in standard deviations
#: of one sample. ``level``: torque in the clearance, N m, mean of ``samples``. ``early``: torque above the level, N m, mean of
#: the first ``begun`` samples of this stroke. ``excess``: the same, smoothed over the last ``watched``
#: samples. ``agreed``: number of closing samples that confirm the contact angle.
CONTACT = np.dtype(
    [
        *fields("?", "engaged lost confirmed"),
        *fields("f8", "level samples early begun rise shortfall"),
        ("agreed", "i8"),
        *fields("f8", "excess watched"),
    ],
    align=True,
)

#: Result of `watch_closing`: no contradiction; force where clearance was assumed; clearance where force was assumed.
NOTHING, TOO_LATE, TOO_EARLY = range(3)

#: Torque (standard deviations of one sample) that is subtracted from a sum with each sample, and logarithm of the mean number
#: of samples between false alarms: an hour of closing has 1e6 samples.
_DRIFT, _LOG_RUN = 0.45, 17.0
#: Share of the alarm threshold that one sample adds at most, so that none raises an alarm alone.
_OF_ONE = 0.6
#: Friction state from which the torque counts: friction must have developed in the closing direction.
_TURNED_OVER = 0.9
#: Samples from which the clearance level may raise an alarm, and over which it averages at most.
_LEAST, _MOST = 100.0, 500.0
#: Samples over which torque is smoothed, and closing samples in agreement that confirm the contact angle.
_SMOOTHED, _CONFIRMING = 15.0, 100
#: Error of curve and friction, as a share of the force, that is not attributed to the contact angle; torque (standard
#: deviations of one sample) above which agreement confirms it.
_TOLERANCE, _TELLING = 0.07, 3.0
#: Number of clearance samples whose mean replaces the filter's offset, and factor by which correlated noise enlarges the
#: standard deviation of that mean.
_SHOWN, _CORRELATED = 20.0, 1.5
#: An offset is present from the first sample of a stroke; a force grows. To distinguish them: number of first samples that are
#: averaged, least number, and share of the excess that must have been present in them if it is an offset.
_BEGINNING, _BEGUN, _AT_ONCE = 8.0, 3.0, 0.5
#: Standard deviations of the contact angle beyond which it counts as passed.
_CERTAIN = 4.0


@njit
def threshold(current_share: float, correlation_time: float, dt: float) -> float:
    """Alarm threshold of the sums for noise of which ``current_share`` of the variance is correlated over
    ``correlation_time``: the sum of correlated noise wanders further (Siegmund, Sequential Analysis, 1985, ch. 2)."""
    rho = exp(-dt / correlation_time)
    inflation = current_share * (1.0 + rho) / (1.0 - rho) + 1.0 - current_share
    return 0.5 * inflation * (_LOG_RUN + log(2.0 * _DRIFT * _DRIFT)) / _DRIFT


@njit
def engaged(state: Record, x: float, contact_sigma: float) -> bool:
    """Whether the pads touch, ``x`` rad past the contact angle of standard deviation ``contact_sigma``; unchanged while
    neither is certain."""
    if x > _CERTAIN * contact_sigma:
        state.engaged = True
    elif x < -_CERTAIN * contact_sigma or (x < 0.0 and state.rise == 0.0):
        state.engaged = False
    return state.engaged


@njit
def watch_closing(
    state: Record, torque: float, predicted: float, friction_mean: float, sigma: float, limit: float, x: float,
    contact_sigma: float, offset: float, offset_sigma: float, turns: bool,
) -> int:  # fmt: skip
    """Compare the torque of one sample with that of the estimated force.

    Args:
        state: CONTACT record.
        torque: motor torque left to the clamp force, N m; NaN if it cannot be used.
        predicted: torque of the estimated clamp force, N m.
        friction_mean: friction state over the cycle; near +1 while closing.
        sigma: standard deviation of ``torque``, N m.
        limit: `threshold`.
        x, contact_sigma: rad past the estimated contact angle, and its standard deviation.
        offset, offset_sigma: the filter's offset of ``torque``, N m; used until enough clearance samples have shown it.
        turns: whether the motor turns. If it does not, a torque in the clearance is an offset.

    Returns:
        NOTHING, TOO_LATE or TOO_EARLY: in which direction the estimated contact angle is wrong.
    """
    if not np.isfinite(torque):
        return NOTHING
    state.watched = min(state.watched + 1.0, _SMOOTHED)
    level, level_sigma = clearance_level(state, sigma, offset, offset_sigma)
    state.excess += (torque - predicted - level - state.excess) / state.watched
    if friction_mean < _TURNED_OVER:
        state.begun = state.early = 0.0
        return NOTHING
    clear = x < -_CERTAIN * contact_sigma
    if clear and state.begun < _BEGINNING:
        state.begun += 1.0
        state.early += (torque - predicted - level - state.early) / state.begun
    if clear:
        state.samples = min(state.samples + 1.0, _MOST)
        state.level += (torque - state.level) / state.samples
    above, tolerated = torque - predicted - level, _TOLERANCE * predicted + level_sigma
    most = _OF_ONE * limit
    if (state.samples >= _LEAST and turns) or not clear:
        state.rise = max(0.0, state.rise + min((above - tolerated) / sigma - _DRIFT, most))
    state.shortfall = max(0.0, state.shortfall + min(-(above + tolerated) / sigma - _DRIFT, most))
    if state.rise > limit:
        state.rise, state.agreed = 0.0, 0
        if state.begun >= _BEGUN and state.early > _AT_ONCE * state.excess:
            forget_level(state)
            return NOTHING
        was_engaged, state.engaged = state.engaged, True
        if clear or (was_engaged and not state.confirmed):
            return TOO_LATE
    if state.shortfall > limit:
        state.shortfall, state.agreed = 0.0, 0
        if x > 0.0 and not state.confirmed:
            state.engaged = False
            return TOO_EARLY
    if x > 0.0 and predicted > _TELLING * sigma and max(state.rise, state.shortfall) < 0.5 * limit:
        state.agreed += 1
        state.confirmed = state.confirmed or state.agreed >= _CONFIRMING
    return NOTHING


@njit
def clearance_level(state: Record, sigma: float, offset: float, offset_sigma: float) -> tuple[float, float]:
    """Torque in the clearance and its standard deviation, N m: the mean of the clearance's samples, each of standard deviation
    ``sigma``, once there are enough; before that the filter's offset."""
    if state.samples < _SHOWN:
        return offset, offset_sigma
    return state.level, max(_CORRELATED * sigma / sqrt(state.samples), offset_sigma)


@njit
def age_level(state: Record, walked: float, sigma: float) -> None:
    """Let the clearance level count for fewer samples of standard deviation ``sigma`` (N m), because the torque's offset has
    walked since, with variance ``walked`` ((N m)^2)."""
    state.samples /= 1.0 + state.samples * walked / sq(_CORRELATED * sigma)


@njit
def forget_level(state: Record) -> None:
    """Learn the clearance level anew, because the offset of the torque has changed."""
    state.level = state.samples = 0.0


@njit
def start_anew(state: Record) -> None:
    """Forget all sums, because the estimated contact angle has changed."""
    state.lost, state.confirmed, state.agreed = True, False, 0
    state.rise = state.shortfall = state.excess = state.watched = 0.0


@njit
def clearly_above(state: Record, sigma: float) -> float:
    """Smoothed excess (N m) that noise of standard deviation ``sigma`` per sample does not reach; infinite before the first
    sample."""
    return 5.0 * sigma / sqrt(state.watched) if state.watched > 0.0 else np.inf


@njit
def torque_sigma(current_torque: float, speed_torque: float) -> tuple[float, float]:
    """Standard deviation of one sample's torque from noise of current and of both speeds, N m, and the current's share."""
    variance = current_torque * current_torque + 2.0 * speed_torque * speed_torque
    return sqrt(variance), current_torque * current_torque / variance
