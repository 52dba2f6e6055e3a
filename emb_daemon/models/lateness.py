"""Age of the resolver's angle relative to the speed that comes with it, or of the speed, and error of the resolver's gain.

A late angle lags the integrated speed by its age times the speed; an angle of wrong gain lags it by a share of the travel.
Both are followed over a tenth of a second and fitted together, because otherwise a gain error of seven hundredths looks like
an age. Neither signal can be ahead of the motor. If the angle leads, the speed was filtered, for example by a tracking loop or
by firmware; the torque of the inertia would then be wrong by kilonewtons of clamp force. The input of that filter is
reconstructed and replaces the speed.

The speed of a motor at rest is an offset, and is subtracted; integrated, it would look like a drifting zero of the resolver.
"""

from math import copysign, exp, sqrt

import numpy as np

from emb_daemon.jit import Record, fields, njit
from emb_daemon.models.torque import friction_state, slid_angle
from emb_daemon.models.wander import STANDING_RAD_PER_S
from emb_daemon.wire.contract import CYCLE_S

#: Time over which angle and speed are followed, s: that of a stroke, in which neither an offset of the speed nor a slip of the
#: resolver adds up much. Time over which the normal equations forget, s: some stops; and standard deviation of an age to which
#: recent ones remember, s, so that a filter that comes while driving is found within a stroke or two.
_FOLLOWED_S, _KEPT_S, _PRECISE_S = 0.1, 60.0, 1e-4
#: Noise of the angle less integrated speed, rad, standard deviation: 0.3 rad/s of the speed, added up over the time above in
#: samples of 4 ms, make 0.004, a resolver's own error of ten arc minutes 0.003, counts 0.002. Number of samples with the same
#: error: those of the time above.
_NOISE_RAD, _ALIKE = 0.01, 25.0
#: Standard deviation of the age before anything is known, s: any moment of the last cycle of 4 ms. Largest age, s: sample,
#: frame and gateway each a cycle late; `plausibility` finds an older angle as a fault.
_AGE_S, _OLDEST_S = 0.002, 0.015
#: Standard deviation of a resolver's gain, share; and share of a stroke's way that the trapezoidal rule may miss: T² / 8 of an
#: acceleration of 8000 rad/s² at each of its two changes, on some 10 rad.
_GAIN, _MISSED = 0.02, 0.003
#: Standard deviations from which a gain error is certain.
_SURELY = 3.0
#: Difference (rad) beyond that of the largest age up to which a sample is used: ten times its noise. More is another fault.
_BEYOND_RAD = 0.1
#: Least and largest time constant of the speed's filter, s: a speed that is the mean of its cycle is half a cycle old, as it
#: was at calibration; through more than twelve cycles a stroke is not seen.
_WORTH_S, SLOWEST_S = 0.5 * CYCLE_S, 12.0 * CYCLE_S
#: Standard deviation of an age up to which a filter is sought, s, and as a share of the age: at the beginning of a stroke a
#: late speed looks like one through any filter. Chosen on our own plant: without it a speed two cycles late was taken for a
#: filter of twelve, and without the share a filter of 25 ms was found a stroke too late.
_CLEAR_S, _CLEAR = 2.5e-4, 0.04
#: Samples of a motor that stands over which its speed is averaged, standard deviations of that mean from which it is an
#: offset, and largest offset, rad/s: a motor that went faster for as long would have gone a turn. Samples over which an offset
#: is refined, to a hundredth of the noise.
_FEWEST, _MOST, _CERTAIN, LARGEST_OFFSET, _REMEMBERED = 50.0, 250.0, 5.0, 6.0, 10_000.0

#: Speeds that are kept: at 250 Hz as old as the oldest angle that a calibration may state, 50 ms.
_KEPT = 14

#: Normal equations of age and gain: sums of products of gained speed, way, and what is apart.
_SS, _SW, _WW, _AS, _AW, _SUMS = 0, 1, 2, 3, 4, 5

#: ``apart``, ``gained`` and ``gone``: angle less integrated speed (rad), speed (rad/s) and way (rad), leaky. ``sums`` of some
#: stops, and ``recent`` ones; ``age`` s, and ``gain``, the gain error if it is certain, or 0. ``ahead`` s: by which the angle
#: leads the speed by the recent sums, or lags it if negative, if that is certain, or 0. ``filtered`` s: time constant of the
#: speed's filter, which is undone; ``reported`` rad/s: the last speed as it came. ``offset`` rad/s of it, which is taken off,
#: a mean of ``known`` samples, and the rest that a standing motor shows: ``standing`` rad/s, the sum over ``stood`` samples.
#: ``interrupted``: the last sample was not followed.
LATENESS = np.dtype(
    [
        *((name, "f8", (_SUMS,)) for name in ("sums", "recent")),
        *fields("f8", "apart gained gone age gain ahead filtered reported offset known standing stood"),
        ("interrupted", "?"),
    ],
    align=True,
)
#: The last speeds (rad/s), the newest ``at`` its place, each with the time since the one before (s, 0 at the first).
LATELY = np.dtype([("at", "i8"), ("speed", "f8", (_KEPT,)), ("dt", "f8", (_KEPT,))], align=True)


@njit
def remember(w: Record, speed: float, dt: float) -> None:
    """Keep the ``speed`` rad/s of a sample in LATELY, ``dt`` s after the last one."""
    w.at = (w.at + 1) % _KEPT
    w.speed[w.at], w.dt[w.at] = speed, dt


@njit
def turned_within(w: Record, age: float) -> float:
    """Angle (rad) that the motor has turned in the last ``age`` s by its speeds, the negative of it for a negative age.

    Age times speed would be off by what the speed has gained meanwhile, with which a relaxation makes up a fifth of an age of
    six milliseconds. Before the first speed that is kept, the motor turned at that."""
    if age == 0.0:
        return 0.0
    left, turned, here = abs(age), 0.0, w.at
    for _ in range(_KEPT - 1):
        dt, before = w.dt[here], (here - 1) % _KEPT
        if left <= 0.0 or dt <= 0.0:
            break
        part = min(left, dt)
        turned += part * (w.speed[here] + 0.5 * (w.speed[before] - w.speed[here]) * part / dt)
        left, here = left - part, before
    return (turned + left * w.speed[here]) * copysign(1.0, age)


@njit
def friction_since(w: Record, state: float, mean: float, age: float, noise: float, presliding_angle: float) -> float:
    """Mean friction state over the last cycle where the angle is ``age`` s old. Begins with the ``state`` at that angle and
    its ``mean`` over the cycle before, and slides on by the speeds since. Speeds within their ``noise`` rad/s count only once
    their sum exceeds what noise adds up to.

    The stored state follows the angle alone, so that what noisy speeds turned over by mistake lasts only until the angle has
    come."""
    steps, left = 0, age
    while steps < _KEPT - 2 and left > w.dt[(w.at - steps) % _KEPT] > 0.0:
        left -= w.dt[(w.at - steps) % _KEPT]
        steps += 1
    whole, unsure = steps > 0, noise * sqrt(CYCLE_S * age)
    way = slid = 0.0
    while steps >= 0:
        here = (w.at - steps) % _KEPT
        dt = w.dt[here]
        if dt > 0.0:
            part = min(left, dt)
            moved = part * (w.speed[here] + 0.5 * (w.speed[(here - 1) % _KEPT] - w.speed[here]) * part / dt)
            way += moved
            if abs(w.speed[here]) < noise:
                moved = slid_angle(slid, way, unsure) - slid
            slid += moved
            state, last, _ = friction_state(state, 0.0, moved, presliding_angle, 0.0, dt)
            mean = last if whole else mean + part / dt * (last - mean)
        left, steps = np.inf, steps - 1
    return mean


@njit
def speed_then(w: Record, age: float) -> float:
    """Speed (rad/s) of the last sample in LATELY that is ``age`` s older than its newest, or more."""
    here = w.at
    while age > 0.0 and w.dt[here] > 0.0 and (here - 1) % _KEPT != w.at:
        age, here = age - w.dt[here], (here - 1) % _KEPT
    return w.speed[here]


@njit
def beyond_speeds(w: Record, travel: float, dt: float) -> float:
    """By how much ``travel`` rad in ``dt`` s is more or less than at any of LATELY's speeds, rad: what no age of the angle
    explains."""
    least = most = w.speed[0]
    for i in range(1, _KEPT):
        least, most = min(least, w.speed[i]), max(most, w.speed[i])
    return max(least * dt - travel, travel - most * dt, 0.0)


@njit
def way_beside(w: Record, travel: float, speed: float, before: float, age: float, dt: float) -> float:
    """Way (rad) in ``dt`` s by the speeds, to be compared with the ``travel`` rad of the angle: by ``speed`` rad/s and the one
    ``before``, or, if the angle is known to be ``age`` s late, by the speeds ``age`` s ago, of which LATELY ``w`` holds all
    but the newest.

    Of the two the one nearer to ``travel``, because what made the angle late may have made the speed late as well."""
    now = 0.5 * (speed + before) * dt
    if age <= 0.0 or dt <= 0.0:
        return now
    since = max(dt - age, 0.0)
    then = turned_within(w, age) - turned_within(w, max(age - dt, 0.0))
    then += since * (before + 0.5 * (speed - before) * since / dt)
    return then if abs(travel - then) < abs(travel - now) else now


@njit
def unfilter(a: Record, m: Record) -> None:
    """Replace the speed of SAMPLE ``m`` by what went into its filter, without its offset."""
    reported = m.speed
    if a.filtered > 0.0 and m.dt > 0.0:
        m.speed += a.filtered * (reported - a.reported) / m.dt
    a.reported = reported
    m.speed -= a.offset


@njit
def stand(a: Record, speed: float, noise: float) -> bool:
    """Take a ``speed`` (rad/s, with a standard deviation of ``noise`` rad/s) of a motor whose angle does not move.

    Returns whether a new offset of the speed was found; it is subtracted from the next sample on."""
    if abs(a.stood * speed - a.standing) > _CERTAIN * noise * sqrt(a.stood * (a.stood + 1.0)):
        # The motor has begun to turn while its angle is late, or the offset has changed.
        a.standing = a.stood = 0.0
        return False
    a.standing += speed
    a.stood += 1.0
    mean = a.standing / a.stood
    found = a.stood >= _FEWEST and abs(mean) > _CERTAIN * noise / sqrt(a.stood) and abs(a.offset + mean) < LARGEST_OFFSET
    if found:
        a.offset += mean
        a.known = a.stood
    elif a.known > 0.0:
        a.known = min(a.known + 1.0, _REMEMBERED)
        a.offset += speed / a.known
    if found or a.stood >= _MOST:
        a.standing = a.stood = 0.0
    return found


@njit
def follow(a: Record, travel: float, turned: float, gained: float, noise: float, dt: float) -> None:
    """Take one sample: ``travel`` rad by the angle, ``turned`` rad and ``gained`` rad/s by the speed, in ``dt`` s; ``noise``
    rad/s of the speed."""
    if a.interrupted:
        # After a gap the angle has moved further than the last speeds account for.
        a.interrupted = False
        return
    keep = exp(-dt / _FOLLOWED_S)
    a.apart = keep * a.apart + travel - turned
    a.gained = keep * a.gained + gained
    a.gone = keep * a.gone + turned
    leads = a.apart if a.gained > 0.0 else -a.apart
    if not -_OLDEST_S * abs(a.gained) - _BEYOND_RAD <= leads <= SLOWEST_S * abs(a.gained) + _BEYOND_RAD:
        return
    variance, old = _ALIKE * max(_NOISE_RAD * _NOISE_RAD, 0.5 * noise * noise * dt * _FOLLOWED_S), exp(-dt / _KEPT_S)
    _add(a.sums, old, a.apart, a.gained, a.gone)
    age, _, gain, gain_sigma = _solve(a.sums, variance, _AGE_S)
    a.age = min(max(age, 0.0), _OLDEST_S)
    a.gain = abs(gain) if abs(gain) > _MISSED + _SURELY * gain_sigma else 0.0
    if abs(a.gained) < STANDING_RAD_PER_S:
        return
    _add(a.recent, min(old, variance / (_PRECISE_S * _PRECISE_S) / max(a.recent[_SS], 1.0)), a.apart, a.gained, a.gone)
    # Nothing is known of a filter beforehand, so its prior is as wide as the slowest.
    age, age_sigma, _, _ = _solve(a.recent, variance, SLOWEST_S)
    a.ahead = -age if abs(age) > _WORTH_S and age_sigma < max(_CLEAR_S, _CLEAR * abs(age)) else 0.0


@njit
def _add(sums, old, apart, gained, gone):
    sums[_SS] = old * sums[_SS] + gained * gained
    sums[_SW] = old * sums[_SW] + gained * gone
    sums[_WW] = old * sums[_WW] + gone * gone
    sums[_AS] = old * sums[_AS] + apart * gained
    sums[_AW] = old * sums[_AW] + apart * gone


@njit
def _solve(sums, variance, age_sigma):
    """Age of the angle (s), of which before only its standard deviation ``age_sigma`` is known, and gain error (share), each
    with its standard deviation."""
    ss, ww = sums[_SS] + variance / (age_sigma * age_sigma), sums[_WW] + variance / (_GAIN * _GAIN)
    determinant = ss * ww - sums[_SW] * sums[_SW]
    age = (sums[_AW] * sums[_SW] - sums[_AS] * ww) / determinant
    gain = (sums[_AW] * ss - sums[_AS] * sums[_SW]) / determinant
    return age, sqrt(variance * ww / determinant), gain, sqrt(variance * ss / determinant)


@njit
def find_filter(a: Record) -> bool:
    """Whether the speed's filter was found to have changed; the new one is undone from the next sample on."""
    filtered = min(max(a.filtered + a.ahead, 0.0), SLOWEST_S)
    if filtered == a.filtered:
        return False
    # The sums belong to the speed before this change.
    a.filtered = filtered
    a.age = a.gain = a.ahead = a.apart = a.gained = a.gone = 0.0
    for i in range(len(a.sums)):
        a.sums[i] = a.recent[i] = 0.0
    return True


@njit
def interrupt(a: Record) -> None:
    """Begin to follow anew after a missing sample or a standstill."""
    a.apart = a.gained = a.gone = 0.0
    a.interrupted = True
