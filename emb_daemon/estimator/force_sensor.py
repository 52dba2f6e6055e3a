"""Clamp force sensor of low range: below its limit a third source, above it what the models learned from it there.

Its errors are a drifting zero, which it shows itself while the pads do not touch, a gain error, and an age that is only known
to a part of a cycle. None of these is noise: they are constant over a stroke, so that many samples contain no more information
about them than one. A hypothesis therefore learns from the sensor only until its force is known as well as these errors allow;
as evidence between hypotheses a sample counts by how much each of them still learned from it.

The sensor itself may be faulty. Its evidence for or against a change of the brake is limited to `_SAYS`, and if no hypothesis
that agrees with the torque explains its values, it is not used until it has followed the force again.
"""

from math import inf, log, sqrt

import numpy as np

from emb_daemon.estimator.hypotheses import (
    ALTERNATIVES,
    DRIFT,
    GATE,
    KEPT_JUMP,
    STIFFNESS_JUMP,
    drift_odds,
    exists,
    fold,
    open_all,
    place,
    stay_finite,
    to_force,
)
from emb_daemon.estimator.uneven import applied
from emb_daemon.estimator.unknown import add_stiffness_jumps
from emb_daemon.jit import Floats, Record, fields, hypot, njit, sq
from emb_daemon.models.fusion import CONTACT, FAST, GROWTH, OF_THE_MODEL, maximum_likelihood, update_errors, variance_along
from emb_daemon.models.plausibility import AGREE, STIFFNESS_WRONG
from emb_daemon.models.stiffness import characteristic_curve

#: Of a calibration: force up to which it measures (0: there is none), white noise, zero at power-on, N; walk of that, N per
#: root of a second, and N per kelvin of the caliper; gain, share. All but the first are standard deviations.
FORCE_SENSOR_PARAMETERS = np.dtype(fields("f8", "limit noise offset walk per_kelvin gain"), align=True)

#: ``offset`` N and its ``variance``, as the clearance showed it when the caliper had ``zeroed`` degC; ``clear_s``: for how
#: long the pads have not touched; ``force`` and ``sigma`` N: what the sensor says now, infinite where nothing;
#: ``value`` N that it last read, and ``value_force`` N that the brake had when it began to read that; ``contradiction``:
#: summed squares; ``asked``: whether a change has been looked for since the last release because of it; ``wrong``: whether it
#: is disbelieved.
FORCE_SENSOR = np.dtype(
    [
        ("started", "?"),
        *fields("f8", "offset variance zeroed clear_s force sigma value value_force contradiction"),
        *fields("?", "asked wrong"),
    ],
    align=True,
)

#: Share of the clearance that the motor must have gone back through, time for which, s, and force left by the lag over the
#: sensor's noise, for the pads to count as apart.
_BACK, _CLEAR_S, _LEFT = 0.3, 0.5, 0.1
#: Least share of the force that is due to the pads' deformation: after they have opened the rest is relaxation, which does not
#: depend on contact angle and stiffness.
_HELD = 0.5
#: Distance below the limit, in standard deviations of the noise, within which a value may be saturated.
_SURELY = 3.0
#: Part of a cycle by which the sensor's value and the angle may be apart in time, as of the current (`fuse._LATE`).
_LATE = 0.3
#: Duration of a stroke below the limit, s, in which the sensor's evidence between two hypotheses that have both learned counts
#: once.
_STROKE_S = 0.1
#: Log odds that the sensor may give or take. A sensor breaks about as rarely as a brake changes (`hypotheses.PRIOR_ODDS`), so
#: alone it makes a change one in twenty, which has the right force as soon as the torque speaks for it. Of what
#: `studies.force_sensor --limits 5000 --count 3` draws, 3 leaves as small errors as 4 and 7, and faults of the sensor less.
_SAYS = 3.0
#: Log odds above its least from which an alternative that explains the sensor's values counts in favour of the sensor.
_STANDING = 1.0
#: Squared normalised differences as in `models.plausibility`: the part of one that is attributed to model errors, the most
#: that one counts, and the sums that raise and end the alarm.
_TOLERATED, _COUNTED, _RAISE, _CLEAR = 20.0, 144.0, 600.0, 150.0
#: Change of the force, as a share of the limit and in the sensor's noise, from which a value that repeats to the bit is
#: frozen.
_MOVED, _NOISES = 0.1, 20.0


@njit
def _common(s, p, m, force, force_before):
    """Standard deviation (N) of the sensor's error that is common to all samples of a stroke, at a clamp force of ``force``
    N."""
    c, q = s.sensor, p.sensor
    warmed = q.per_kelvin * (m.caliper - c.zeroed) if m.has_thermocouple else 0.0
    late = _LATE * (s.force - force_before)
    return sqrt(c.variance + warmed * warmed + late * late + sq(q.gain * force))


@njit
def _count(c, square):
    c.contradiction = min(max(c.contradiction + min(square, _COUNTED) - _TOLERATED, 0.0), 1.5 * _RAISE)


@njit
def _find_zero(c, q, m, variance):
    """The pads do not touch: what the sensor reads is its zero, known so far with ``variance`` N^2."""
    off, total = m.sensor_force - c.offset, variance + q.noise * q.noise
    if off * off > GATE * GATE * total:
        # The zero has moved more than drift explains; it is found anew once the pads are certainly apart.
        _count(c, _COUNTED)
        if not c.wrong:
            return
        variance += off * off
        total += off * off
    share = variance / total
    c.offset += share * off
    c.variance, c.zeroed = (1.0 - share) * variance, m.caliper if m.has_thermocouple else c.zeroed


@njit
def _bent(s, p, x, P, speed):
    """Standard deviation (N) of what a hypothesis that stands ``x`` rad past its contact makes of the curve's bend: half the
    slope's change over an uncertain contact angle, on either side, and the lag of what its force differs by, which
    `hypotheses.place` leaves out, while the motor turns at ``speed`` rad/s."""
    sigma = sqrt(max(P[CONTACT, CONTACT], 0.0))
    _, above = characteristic_curve(x + sigma, p.curve)
    _, below = characteristic_curve(x - sigma, p.curve)
    _, there = characteristic_curve(x, p.curve)
    _, here = characteristic_curve(s.past_contact, p.curve)
    late = p.relaxation_time * speed * s.gear_slope * (there - here)
    return s.factor * s.scale * hypot(0.5 * (above - below) * sigma, late)


@njit
def _learn(x, P, gain, h, off, noise, common):
    """One hypothesis takes what the sensor says: ``off`` N over its force, with ``noise`` and ``common`` as standard
    deviations. Returns (variance of ``off``, share of what it did not know that the sensor told it)."""
    known, slow, along = variance_along(P, h, gain), 0.0, 0.0
    for i in OF_THE_MODEL:
        along += h[i] * gain[i]
        for j in OF_THE_MODEL:
            slow += h[i] * P[i, j] * h[j]
    total = known + noise * noise + common * common
    excess = slow - common * common
    if excess <= 0.0 or off * off > GATE * GATE * total:
        return total, 0.0
    # What remains is the common error, and of the rest the noise and the fast error.
    white = noise * noise + h[FAST] * h[FAST] * P[FAST, FAST]
    told = excess * excess / (excess + white)
    update_errors(x, P, gain, off, max(along * along / told, known + noise * noise))
    return total, told / slow


@njit
def _weigh(s, a, kind, first, first_variance, second, second_variance, news):
    """Odds of an alternative after it and the first hypothesis have been ``first`` and ``second`` N off the sensor; ``news``:
    share of an independent opinion that this was."""
    edge = GATE * GATE
    says = 0.5 * (min(first * first / first_variance, edge) - min(second * second / second_variance, edge))
    says = min(max(says + 0.5 * log(first_variance / second_variance), -_SAYS), _SAYS)
    # Repeated values contain no new information.
    said = a.told + news * says
    said = min(said, max(a.told, says)) if says > 0.0 else max(said, min(a.told, says))
    least, most = drift_odds(s) if kind == DRIFT else (a.least, inf)
    before = a.log_odds
    a.log_odds = min(max(before + said - a.told, least), most)
    a.told += a.log_odds - before


@njit
def _take(s, p, m, h, spread, warmth, noise, common):
    """What each hypothesis learns of one value; returns the square of what the best of those that stand leaves, normalised."""
    c = s.sensor
    value = m.sensor_force - c.offset - applied(s.uneven)
    to_force(h, s, spread, s.slope, s.force, warmth)
    first = value - s.force - spread * s.error[FAST]
    variance, news = 0.0, 0.0
    if c.wrong:
        variance = variance_along(s.covariance, h, s.gain) + noise * noise + common * common
    else:
        unsure = hypot(common, _bent(s, p, s.past_contact, s.covariance, m.speed))
        variance, news = _learn(s.error, s.covariance, s.gain, h, first, noise, unsure)
    left = first * first / variance
    for kind in range(ALTERNATIVES):
        a = s.alternatives[kind]
        if not exists(a):
            continue
        to_force(h, s, spread, a.slope, s.force + a.shift, warmth)
        second = value - s.force - a.shift - spread * a.error[FAST]
        if c.wrong:
            variance_a = variance_along(a.covariance, h, s.gain) + noise * noise + common * common
        else:
            x = s.past_contact + a.error[GROWTH] * warmth - a.error[CONTACT]
            unsure = hypot(common, _bent(s, p, x, a.covariance, m.speed))
            variance_a, news_a = _learn(a.error, a.covariance, s.gain, h, second, noise, unsure)
            _weigh(s, a, kind, first, variance, second, variance_a, max(news, news_a, m.dt / _STROKE_S))
        if kind != DRIFT and a.log_odds > a.least + _STANDING:
            left = min(left, second * second / variance_a)
    if not c.wrong:
        stay_finite(s)
        fold(s, warmth, True)
        for kind in range(ALTERNATIVES):
            if exists(s.alternatives[kind]):
                place(s, s.alternatives[kind], p, s.factor * s.scale, warmth)
    return left


@njit
def _open_wider(s, p):
    """Let the stiffness path have jumped once more in every hypothesis that it has jumped; returns whether the torque has left
    one of them standing."""
    stands = False
    for kind in (STIFFNESS_JUMP, KEPT_JUMP):
        a = s.alternatives[kind]
        if exists(a) and a.kind == STIFFNESS_JUMP:
            add_stiffness_jumps(a.covariance, p)
            stands = stands or a.log_odds > a.least + _STANDING
    return stands


@njit
def hear_sensor(s: Record, p: Record, m: Record, h: Floats, spread: float, warmth: float, force_before: float) -> None:
    """Take one sample's value into all hypotheses, or into the sensor's zero where the pads do not touch; ``h``: scratch,
    ``force_before`` N of the stiffness path at the last sample."""
    c, q = s.sensor, p.sensor
    if not c.started:
        c.started, c.variance, c.zeroed = True, q.offset * q.offset, m.caliper if m.has_thermocouple else 0.0
    c.force, c.sigma = 0.0, inf
    c.variance += q.walk * q.walk * m.dt
    if not m.has_sensor_force:
        return
    if m.sensor_force != c.value:
        c.value, c.value_force = m.sensor_force, s.force
    measures = m.sensor_force < q.limit - _SURELY * q.noise
    seen = not s.unknown and s.plausibility.verdict != STIFFNESS_WRONG
    clear = seen and s.past_contact < -_BACK * p.clearance and not s.contact.engaged and s.force < _LEFT * q.noise
    c.clear_s = c.clear_s + m.dt if clear else 0.0
    if c.clear_s > _CLEAR_S:
        common = _common(s, p, m, 0.0, s.force)
        _find_zero(c, q, m, common * common)
        c.asked = False
    elif measures and not clear:
        c.force = m.sensor_force - c.offset
        common = _common(s, p, m, c.force, force_before)
        c.sigma = inf if c.wrong else hypot(q.noise, common)
        static, _ = characteristic_curve(s.past_contact, p.curve)
        if seen and m.dt > 0.0 and s.factor * s.scale * static >= _HELD * s.force:
            left = _take(s, p, m, h, spread, warmth, q.noise, common)
            # Of three sources, the one that the other two contradict is wrong.
            if s.plausibility.verdict == AGREE:
                _count(c, left)
            if abs(s.force - c.value_force) > max(_MOVED * q.limit, _NOISES * q.noise):
                c.contradiction, c.asked = 1.5 * _RAISE, True
    wrong = c.contradiction > (_CLEAR if c.wrong else _RAISE)
    if wrong and not c.wrong:
        if c.clear_s == 0.0 and (_open_wider(s, p) or not c.asked):
            c.asked, c.contradiction, wrong = True, 0.0, False
        else:
            # What the alternatives learned from it is not due to the brake.
            open_all(s, p)
    c.wrong = wrong


@njit
def with_sensor(c: Record, force: float, sigma: float) -> tuple[float, float]:
    """A force and its standard deviation (N) that do without the angle, with what the sensor says now."""
    if c.sigma == inf:
        return force, sigma
    return maximum_likelihood(force, sigma, c.force, c.sigma)
