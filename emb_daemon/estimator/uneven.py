"""A disc whose thickness varies over its turn in a way that the calibration does not know.

A separate Kalman filter estimates cosine and sine of the first orders of the wheel angle from the torque that the first
hypothesis (`estimator.hypotheses`) leaves unexplained. How much better they predict each stroke from earlier ones than an even
disc does gives the probability of such a disc; the fused force follows it by that probability, and the remaining uncertainty
is part of its standard deviation.

It learns only while the motor turns: a standing motor is held by friction, whatever the disc does to the force.
"""

from math import cos, exp, pi, sin, sqrt

import numpy as np

from emb_daemon.jit import Record, hypot, njit, sq
from emb_daemon.models.stiffness import first_order_lag
from emb_daemon.models.wheel import TURNING_RAD_PER_S, WHEEL, track

#: Orders that discs commonly have, and cosine and sine of each.
ORDERS = 2
STATES = 2 * ORDERS
#: Standard deviation of cosine and sine of order 1, m: 10 to 20 um from crest to trough before drivers complain (Jacobsson,
#: Aspects of disc brake judder, Proc. IMechE D 217, 2003); amplitudes of a smooth disc fall with the square of the order.
_AMPLITUDE_M = 7e-6
#: That of the difference between the thicknesses at two moments, m: crest and trough of cosine and sine.
SWING_M = 2.0 * _AMPLITUDE_M
#: Time of braking in which wear changes the disc's shape, s.
_WORN_S = 3600.0
#: Log odds of a disc that its calibration does not know: one in 55. Of an even disc they rise by k with a probability of at
#: most exp(-k) (Ville's inequality for likelihood ratios), so that the same share of even discs is ever thought uneven
#: (`test_uneven.py::test_noise_is_believed_as_rarely_as_the_odds_say`).
_PRIOR_ODDS = -4.0
#: Those below which they do not fall, as of a jump (`hypotheses.PRIOR_ODDS`): so that a disc that warps later is found as
#: fast. Log odds from which the force follows it: evidence of a factor e, at which its probability is a twentieth.
_LEAST_ODDS, _SPEAKING_ODDS = -6.0, -3.0
#: Longest motion that counts as one stroke, s: any unexplained shape of a single stroke is part of some period. In a second
#: the wheel of a car at walking pace has turned once, and a longer stroke is predicted from its beginning.
_STROKE_S = 1.0
#: Largest log odds, practically certain; a disc that is even again is then noticed within some samples.
_CERTAIN_ODDS = 20.0
#: Standard deviations of the innovation beyond which a sample teaches nothing, as in `hypotheses`: sensors jump.
_GATE = 5.0
#: Way, rad, over which a wheel speed that is off by a hundredth, uncorrected by the counter, loses the phase by a radian: less
#: than half of what the counter counts before it begins anew.
_LOST_RAD = 100.0

#: Whether it has ``turned`` since the start: until then its thickness is one with the contact angle. ``wheel`` angle and the
#: way (rad) ``unseen`` since the counter was last heard; ``amplitude`` (m) of cosines and sines, their ``covariance``, and
#: what they were by the strokes ``earlier`` than this one, of which ``stroke_s`` s were looked at; ``drive`` and ``force``
#: N/m: static force and force (with its lag) per amplitude; ``gain``: scratch; ``log_odds`` of such a disc and its ``share``;
#: ``shift`` N: what it adds to the force.
UNEVEN = np.dtype(
    [
        ("known", "?"),
        ("turned", "?"),
        ("wheel", WHEEL),
        ("unseen", "f8"),
        ("amplitude", "f8", (STATES,)),
        ("covariance", "f8", (STATES, STATES)),
        ("drive", "f8", (STATES,)),
        ("force", "f8", (STATES,)),
        ("gain", "f8", (STATES,)),
        ("earlier", "f8", (STATES,)),
        ("stroke_s", "f8"),
        ("log_odds", "f8"),
        ("share", "f8"),
        ("shift", "f8"),
    ],
    align=True,
)


@njit
def _variance(i):
    order = i // 2 + 1
    sigma = _AMPLITUDE_M / (order * order)
    return sigma * sigma


@njit
def _begin(u):
    """Forget the disc's phase, as after a lost wheel angle; the odds that it is uneven stay."""
    u.known = True
    u.unseen = 0.0
    for i in range(STATES):
        # At the new phase amplitudes as large as those found are possible.
        size = sq(u.amplitude[i - i % 2]) + sq(u.amplitude[i - i % 2 + 1])
        u.gain[i] = _variance(i) + 0.5 * size
    for i in range(STATES):
        u.amplitude[i] = u.earlier[i] = 0.0
        for j in range(STATES):
            u.covariance[i, j] = 0.0
        u.covariance[i, i] = u.gain[i]


@njit
def _wheel_angle(u, m):
    """Angle of the wheel (rad); begins anew where its phase was lost."""
    speed = m.wheel_speed if m.has_wheel_speed else 0.0
    if m.has_wheel_pulse:
        if u.unseen > _LOST_RAD:
            _begin(u)
        u.unseen = 0.0
        return track(u.wheel, m.wheel_pulse, speed, m.dt)
    u.wheel.turned += speed * m.dt
    u.unseen += speed * m.dt if m.has_wheel_speed else 2.0 * _LOST_RAD
    return u.wheel.turned


@njit
def turn(u: Record, m: Record, slope: float, gear_gain: float, relaxation_time: float) -> None:
    """Advance the effect of each amplitude on the force by one sample. ``slope`` N/rad of the static force."""
    if not u.known:
        u.log_odds = _PRIOR_ODDS
        _begin(u)
    angle = _wheel_angle(u, m)
    u.turned = u.turned or (m.has_wheel_speed and m.wheel_speed > TURNING_RAD_PER_S)
    if not u.turned:
        return
    if slope == 0.0 and u.stroke_s > 0.0:
        _end_stroke(u)
    u.shift = 0.0
    for k in range(ORDERS):
        for part in range(2):
            i = 2 * k + part
            shape = cos((k + 1) * angle) if part == 0 else sin((k + 1) * angle)
            drive = slope / gear_gain * shape
            u.force[i] = first_order_lag(u.force[i], u.drive[i], drive, m.dt, relaxation_time)
            u.drive[i] = drive
            u.shift += u.force[i] * u.amplitude[i]
            u.covariance[i, i] += _variance(i) * m.dt / _WORN_S


@njit
def applied(u: Record) -> float:
    """Its part of the fused force, N."""
    return u.share * u.shift


@njit
def _end_stroke(u):
    """End a stroke: what it taught predicts the next one."""
    u.stroke_s = 0.0
    for i in range(STATES):
        u.earlier[i] = u.amplitude[i]


@njit
def _weigh(u, leverage, without, variance):
    """Odds after a torque: its prediction from earlier strokes against an even disc's. Under noise a wrong prediction
    loses."""
    foretold = 0.0
    for i in range(STATES):
        foretold += leverage * u.force[i] * u.earlier[i]
    edge = _GATE * _GATE * variance
    better = min(without * without, edge) - min(sq(without - foretold), edge)
    u.log_odds = min(max(u.log_odds + 0.5 * better / variance, _LEAST_ODDS), _CERTAIN_ODDS)
    # An even disc until there is evidence: no wheel frame, not even a forged one, then changes the force.
    u.share = 1.0 / (1.0 + exp(-u.log_odds)) if u.log_odds > _SPEAKING_ODDS else 0.0


@njit
def learn(u: Record, leverage: float, without: float, variance: float, dt: float) -> None:
    """Take a torque (N m) that the first hypothesis leaves unexplained ``without`` such a disc, and its variance, after ``dt``
    s of motion."""
    u.stroke_s += dt
    if u.stroke_s > _STROKE_S:
        _end_stroke(u)
    added = 0.0
    for i in range(STATES):
        total = 0.0
        for j in range(STATES):
            total += u.covariance[i, j] * u.force[j]
        u.gain[i] = leverage * total
        added += leverage * u.force[i] * u.gain[i]
    innovation, s = without - leverage * u.shift, variance + added
    if innovation * innovation > _GATE * _GATE * s:
        return
    _weigh(u, leverage, without, variance)
    for i in range(STATES):
        u.amplitude[i] += u.gain[i] / s * innovation
        for j in range(STATES):
            u.covariance[i, j] -= u.gain[i] * u.gain[j] / s


@njit
def force_sigma(u: Record) -> float:
    """Standard deviation (N) that it leaves in the fused force."""
    variance = (1.0 - u.share) * u.shift * u.shift
    for i in range(STATES):
        for j in range(STATES):
            variance += u.force[i] * u.covariance[i, j] * u.force[j]
    return sqrt(max(u.share * variance, 0.0))


@njit
def _crest(u, order):
    """What an order adds to the force at most, N."""
    k = 2 * order - 2
    return hypot(u.force[k], u.force[k + 1]) * hypot(u.amplitude[k], u.amplitude[k + 1])


@njit
def way_per_rad(u: Record) -> float:
    """How far it lets the force go to and fro over a rad of the wheel, N/rad."""
    total = 0.0
    for order in range(1, ORDERS + 1):
        total += order * _crest(u, order)
    return u.share * 2.0 / pi * total


@njit
def unproven(u: Record) -> float:
    """How far apart the force with and without such a disc are over a turn, N, times the probability of the less likely."""
    crest = 0.0
    for order in range(1, ORDERS + 1):
        crest += _crest(u, order)
    return min(u.share, 1.0 - u.share) * crest
