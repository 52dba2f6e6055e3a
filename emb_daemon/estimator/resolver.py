"""The motor's angle and speed of one corner: a resolver whose zero jumps or drifts, whose angle stays behind, or of which some
messages are wrong."""

from math import exp, sqrt

import numpy as np

from emb_daemon.estimator.hypotheses import open_again
from emb_daemon.estimator.paths import CYCLE_S, ONE_CYCLE_S, shift_zero
from emb_daemon.jit import Record, fields, hypot, njit, sq
from emb_daemon.models.fusion import CONTACT, STATES
from emb_daemon.models.lateness import LARGEST_OFFSET
from emb_daemon.models.plausibility import AGREE, believe_resolver
from emb_daemon.models.wander import OFFSET_RAD_PER_S, STANDING_RAD_PER_S

#: ``way`` rad by which the zero has moved since ``seconds`` s, and its ``variance``, rad². What was believed before, and is so
#: again if it comes back: ``known`` variance of the contact angle, rad²; ``angle``, and that to which the gear ``slid``, rad,
#: and ``speed``, rad/s; ``friction`` state and its variance; ways ``strayed`` and ``turned``, rad; for how long the motor had
#: ``stood``, s; whether the contact was ``confirmed``, and the resolver ``believed``.
AWAY = np.dtype(
    [
        *fields("f8", "way variance seconds known angle speed slid friction friction_variance strayed turned stood"),
        *fields("?", "confirmed believed"),
    ],
    align=True,
)

#: A speed beyond the motor's maximum by this factor (overspeed of IEC 60034-1), and an angle by this many rad more (half of
#: what a contact angle jumps by at once), is no motion.
SPEED_MARGIN = 1.2
ANGLE_MARGIN = 0.5
#: Shares of the largest speed: what no motor gains within a cycle, as it would be at full speed within 8 ms, and no log that
#: is interpolated from 100 Hz; how far the angle may move beside the last speed and still go on as before, as one that had
#: gained the first would not: by half of that; and what nothing turns at, whatever voltage and field.
_GAINED, _AS_BEFORE, _NO_SPEED = 0.5, 0.2, 2.0
#: Ways in a sample, rad, by which angle and speed differ, beyond a delay of this many seconds between both. The zero has
#: jumped where they differ by so many times what they have differed by of late while the motor turned, or stood: at most by
#: the last, which holds before anything is known, and at least by the other, which is what seven counts of a resolver of 12
#: bit are (`test_resolver.py::test_resolvers_that_are_well_differ_from_their_speed_by_counts`). What was seen counts less as
#: the motor gains and loses speed, which shows a delay, rad/s: over some strokes.
_SLIP_DELAY_S, _BEYOND_SLIPS, _LEAST_SLIP_RAD, MOST_SLIP_RAD, _SLIPS_KEPT_RAD_PER_S = 0.01, 5.0, 0.01, 0.06, 1000.0
#: Standard deviation of a way of which the noise is not known, rad.
_ZERO_RAD = 0.1
#: Standard deviations of the speed's noise that are certain; and time after which a zero that drifted counts as healed, s: a
#: car that stands once in a minute shows it.
_CERTAIN, _DRIFTING_S = 6.0, 60.0
#: Time within which a zero that comes back had never moved, s: some messages; time of one that has not moved; and standard
#: deviations that tell both.
_AWAY_S, LONG_AGO_S, _SURELY = 0.05, 1e9, 3.0
#: From one standstill to the next angle and integrated speed must agree, whatever their delay. A standstill must last for
#: twice the longest delay that a calibration may state, s.
_AT_REST_S = 0.1
#: Longest part of a standstill that counts towards the next motion, s: in it the speed's offset adds a fifth of `_ZERO_RAD`.
_STOOD_S = 1.0
#: Relative error of the integrated speed: a step of the acceleration a within a cycle T puts the trapezoid off by up to a
#: T²/8, and four of them on a travel a t², sped up for t and slowed down for as long, by T²/(2 t²) of it, t being 40 ms. On
#: the simulated rig's logs no travel is off by more than 0.35 of the limit.
_SPEED_SCALE = 0.005
#: Gain error of a resolver's speed, share, as `models.lateness` allows for, which also covers what the trapezoid misses.
_SPEED_GAIN = 0.02
#: Samples in a row in which angle and speed repeat to the bit, from which both are stale: by chance, at one repetition in five
#: of a motor that stands, one in a hundred.
_REPEATED = 3
#: Time after which an angle that repeats beside a speed of no more than `LARGEST_OFFSET` stands, s. Until then it may be a
#: loose contact, and is behind by no more than six tenths of a radian.
_BEHIND_S = 0.1


@njit
def believe_speed(s: Record, p: Record, m: Record) -> None:
    """Replace a speed that is neither the last one nor what the angle has gone, if these agree or if one of them is far beyond
    the motor's largest. The last speed goes on; if that was wrong, too, the angle tells the speed."""
    was_wrong, s.speed_wrong = s.speed_wrong, False
    stuck = s.plausibility.still > 1
    if stuck or not 0.0 < m.dt <= ONE_CYCLE_S:
        return
    by_angle = (m.angle - s.angle) / m.dt
    gained, apart = abs(m.speed - s.speed), abs(by_angle - s.speed)
    if may_come_back(s):
        # The last messages may have been wrong in both.
        gained = min(gained, abs(m.speed - s.away.speed))
    if min(gained, abs(m.speed - by_angle)) <= _GAINED * p.maximum_speed:
        return
    if apart <= _AS_BEFORE * p.maximum_speed or max(abs(m.speed), abs(by_angle)) > _NO_SPEED * p.maximum_speed:
        s.speed_wrong = True
        m.speed = by_angle if was_wrong and apart <= _GAINED * p.maximum_speed else s.speed


@njit
def follow_zero(s: Record, p: Record, m: Record, turned: float) -> bool:
    """Whether the resolver's zero has moved, because its angle changed without a motion by the speed, which has ``turned`` rad
    since the last sample; the contact angle is moved with it.

    The shift follows from the speed. If the resolver had been frozen the motor may have turned meanwhile, and an impossible
    motion may have any cause; then the contact angle becomes uncertain by as much. A resolver that loses counts loses a few in
    each sample, which shows when the motor stands again; it will lose more, and is not used. An angle that repeats while the
    speed goes on has lost nothing unless it goes on from there.
    """
    jump = m.angle - s.angle
    frozen_s = s.plausibility.frozen_s if s.drifting_s == 0.0 else 0.0
    stuck = s.plausibility.still > 1 or frozen_s > 0.0
    reach = p.maximum_speed * (m.dt + max(frozen_s, CYCLE_S * s.plausibility.still))
    moved, sigma, back, drifts = 0.0, 0.0, False, False
    seen = 0.0 < m.dt <= ONE_CYCLE_S and not stuck
    slip = jump - turned
    # A speed that was late is as far off as one that went through the filter that is undone in its place.
    by_delay = (_SLIP_DELAY_S + s.lateness.filtered) * abs(m.speed - s.speed)
    unsure = by_delay + _BEYOND_SLIPS * MOST_SLIP_RAD
    if s.stood_s > _AT_REST_S:
        # A motor that starts gets no further within a cycle, and whatever is late came from rest as well.
        by_delay = min(by_delay, 0.5 * _GAINED * p.maximum_speed * m.dt)
    # Before it has stood for so long, an angle that is late may still be turning.
    stands = int(s.stood_s > _AT_REST_S and abs(m.speed) < STANDING_RAD_PER_S)
    limit = _BEYOND_SLIPS * min(max(s.largest_slip[stands], _LEAST_SLIP_RAD), MOST_SLIP_RAD)
    # An angle that repeats for long beside a low speed stands, and the speed has an offset.
    behind = s.behind if s.behind_s < _BEHIND_S or abs(s.behind) > LARGEST_OFFSET * s.behind_s else 0.0
    _stay_behind(s, m, jump, turned)
    # A loose contact repeats an angle, which is right again when it has made up for the way; one that is late by a cycle
    # repeats whenever a motion begins. What it lacks then counts as what it makes up for: it has strayed by neither.
    repeats = s.behind != 0.0 or (behind != 0.0 and abs(slip - behind) < unsure + _SPEED_GAIN * abs(behind))
    if abs(behind) > unsure and s.plausibility.still == 0 and not repeats:
        moved, sigma = slip - behind, hypot(_ZERO_RAD, _SPEED_GAIN * behind)
    elif abs(jump) > SPEED_MARGIN * reach + ANGLE_MARGIN and not repeats:
        # The speed of a sample that is wrong may be wrong as well.
        moved, sigma = (slip, hypot(_ZERO_RAD, 0.5 * m.dt * (m.speed - s.speed))) if seen else (jump, reach)
    elif seen and min(abs(slip), abs(s.plausibility.apart + slip)) > by_delay + limit and not repeats:
        moved, sigma = slip, limit / _SURELY
    elif seen and may_come_back(s) and abs(s.away.way + slip) < min(limit, 0.5 * abs(s.away.way)):
        # What has just moved it by little more than counts comes back by little less.
        moved, sigma, back = slip, limit / _SURELY, True
    elif seen:
        _know_slips(s, m, stands, abs(slip) - by_delay)
        moved = _drift(s, m, slip, turned)
        sigma, drifts = abs(moved), moved != 0.0
        if not drifts and stands and abs(slip) > _LEAST_SLIP_RAD and p.clearance_sigma > 0.0:
            # Nothing has turned that was at rest and does not show a speed: this slides no gear. Where the brake is held as
            # exactly known, paths are compared with those of `diagnose.held_heat`, whose friction follows the angle.
            s.slid_angle += slip
    s.drifting_s = max(s.drifting_s - m.dt, 0.0)
    if not seen:
        # A motion that was not observed completely cannot be checked at its end.
        s.strayed = np.nan
    s.away.seconds += m.dt
    if moved != 0.0:
        _move_zero(s, p, moved, sigma, back)
    if drifts:
        s.drifting_s = _DRIFTING_S
    return moved != 0.0


@njit
def _know_slips(s, m, stands, slip):
    """Take a ``slip`` (rad) by which angle and speed differ in a sample although the zero has not moved; ``stands``: 1 of a
    motor that stands, else 0."""
    kept = exp(-max(abs(m.speed - s.speed) - STANDING_RAD_PER_S, 0.0) / _SLIPS_KEPT_RAD_PER_S)
    for i in range(len(s.largest_slip)):
        s.largest_slip[i] *= kept
    s.largest_slip[stands] = max(s.largest_slip[stands], slip)


@njit
def nobody_brakes(m: Record) -> bool:
    """Whether the brake controller says so, and the park brake is off."""
    return m.has_status and m.park_brake == 0.0 and m.brake_request == 0.0


@njit
def at_rest(s: Record, m: Record) -> bool:
    """Whether nothing asks the motor to turn, so that one whose angle stays does stand: pads apart, and nobody brakes. While
    it clamps, the motor may turn slowly beside an angle that is frozen."""
    return nobody_brakes(m) and s.past_contact < 0.0


@njit
def _stay_behind(s, m, jump, turned):
    """Keep the way (rad) by which an angle that repeats is behind; ``jump`` and ``turned`` rad are what this sample adds to
    the angle and by the speed."""
    if jump != 0.0 or s.plausibility.still >= _REPEATED or m.dt > ONE_CYCLE_S:
        s.behind = s.behind_s = 0.0
    elif abs(turned) > STANDING_RAD_PER_S * m.dt:
        s.behind += turned
        s.behind_s += m.dt


@njit
def _drift(s, m, slip, turned):
    """How far (rad) the zero has drifted by what shows at standstill or at the end of a way, else 0; ``slip`` and ``turned``
    rad are what this sample adds to the angle beside the speed, and by it."""
    s.strayed += slip
    s.turned += turned
    s.turned_s += m.dt
    if max(abs(m.speed), abs(s.speed)) > STANDING_RAD_PER_S:
        s.drifted = s.stood_s = 0.0
    else:
        s.drifted += slip
        s.stood_s += m.dt
    if abs(s.drifted) > _unaccounted(s, s.stood_s):
        stays = s.plausibility.held * CYCLE_S >= s.stood_s - ONE_CYCLE_S
        if not (stays and (s.unknown or at_rest(s, m))):
            return s.drifted
        # An angle that stays where it is does not drift: the speed has an offset. Of an unknown contact nothing is lost.
        s.drifted = s.stood_s = 0.0
        s.strayed = np.nan
    moved = 0.0
    if s.stood_s > _AT_REST_S:
        # Only at the end of a motion: at the beginning of the next one a late speed lags the angle.
        ended = s.stood_s - m.dt <= _AT_REST_S
        if ended and abs(s.strayed) > _unaccounted(s, s.turned_s) + _SPEED_SCALE * abs(s.turned):
            moved = s.strayed
        if ended or s.turned_s > _STOOD_S:
            s.strayed = s.turned = s.turned_s = 0.0
    return moved


@njit
def _move_zero(s, p, moved, sigma, back):
    """Refer all stored angles to a zero that has moved by ``moved`` rad, known with standard deviation ``sigma`` rad;
    ``back``: to where it was."""
    a = s.away
    if not may_come_back(s):
        _remember(s)
    went = a.way
    a.way += moved
    a.variance += sq(sigma)
    if back or abs(a.way) < _SURELY * sqrt(a.variance) < abs(went):
        _restore(s, went)
        return
    s.drifted = s.stood_s = 0.0
    s.strayed = np.nan
    shift_zero(s, moved)
    s.covariance[CONTACT, CONTACT] += sq(s.gear_slope * sigma)
    open_again(s, p)
    s.contact.confirmed = False


@njit
def may_come_back(s: Record) -> bool:
    """Whether the zero has just moved, and some messages may have been wrong."""
    return s.away.seconds < _AWAY_S


@njit
def came_back(s: Record) -> bool:
    """Whether it did so in this sample."""
    return s.away.seconds == LONG_AGO_S


@njit
def remember_motion(s: Record) -> None:
    """Keep where motor and friction are before the zero moves."""
    a = s.away
    a.angle, a.speed, a.slid = s.angle, s.speed, s.slid_angle
    a.friction, a.friction_variance = s.friction_state, s.friction_variance


@njit
def restore_motion(s: Record) -> None:
    """Motor and friction are where they were: some messages were wrong, and nothing has moved as they said."""
    a = s.away
    s.angle, s.speed, s.slid_angle = a.angle, a.speed, a.slid
    s.friction_state, s.friction_variance = a.friction, a.friction_variance


@njit
def _remember(s):
    """Keep what is believed before the zero moves."""
    a = s.away
    a.way = a.variance = a.seconds = 0.0
    a.known, a.confirmed = s.covariance[CONTACT, CONTACT], s.contact.confirmed
    a.believed = s.drifting_s == 0.0 and s.plausibility.verdict == AGREE
    a.strayed, a.turned, a.stood = s.strayed, s.turned, s.stood_s
    remember_motion(s)


@njit
def _restore(s, went):
    """The zero, which wrong messages have moved by ``went`` rad, is where it was, and so is what is believed."""
    a, before = s.away, s.covariance[CONTACT, CONTACT]
    shift_zero(s, -went)
    known = sqrt(a.known / before) if before > a.known else 1.0
    for i in range(STATES):
        s.covariance[CONTACT, i] *= known
        s.covariance[i, CONTACT] *= known
    restore_motion(s)
    s.strayed, s.turned, s.stood_s = a.strayed, a.turned, a.stood
    s.contact.confirmed = a.confirmed
    if a.believed:
        s.drifting_s = 0.0
        believe_resolver(s.plausibility)
    a.seconds = LONG_AGO_S


@njit
def _unaccounted(s, seconds):
    """Least travel (rad) beyond the integrated speed over ``seconds`` that neither its noise nor its offset explain."""
    return _ZERO_RAD + OFFSET_RAD_PER_S * seconds + _CERTAIN * s.speed_sigma * sqrt(CYCLE_S * seconds)
