"""A motor angle that is older than the speed beside it, or a speed that went through a filter: found, undone, covered; nothing
else is taken for it."""

import brake
import city
import numpy as np
import pytest

from emb_daemon.estimator import fuse, restart, rewind, step
from emb_daemon.estimator.hypotheses import open_all
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.estimator.resolver import follow_zero
from emb_daemon.estimator.status import ANGLE_LATE
from emb_daemon.models.lateness import (
    LATELY,
    LATENESS,
    SLOWEST_S,
    find_filter,
    follow,
    friction_since,
    interrupt,
    remember,
    speed_then,
    stand,
    turned_within,
    unfilter,
    way_beside,
)
from emb_daemon.models.plausibility import AGREE, STIFFNESS_WRONG, UNDECIDED
from emb_daemon.models.torque import friction_state
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import OUT_OF_RANGE, PATHS_DISAGREE

_DT = 0.004
_COUNT = 2.0 * np.pi / 4096


def _strokes():
    """Angle (rad) and speed (rad/s) at any time (s): strokes of a tenth of a second and more."""
    return (lambda t: 10.0 * (1.0 - np.cos(9.0 * t)) * (t > 0.0)), (lambda t: 90.0 * np.sin(9.0 * t) * (t > 0.0))


def _signals(late_s=0.0, gain=1.0, speed_late_s=0.0, seconds=3.0, seed=1, size=1.0):
    """Angles (rad) and speeds (rad/s) as they are sampled, of strokes ``size`` times as long."""
    angle, speed = _strokes()
    time, rng = np.arange(0.0, seconds, _DT), np.random.default_rng(seed)
    angles = np.round(size * gain * angle(time - late_s) / _COUNT) * _COUNT
    return angles, size * speed(time - speed_late_s) + 0.3 * rng.standard_normal(len(time))


def _follow(a, angles, speeds):
    for i in range(1, len(angles)):
        turned = 0.5 * (speeds[i] + speeds[i - 1]) * _DT
        follow(a, angles[i] - angles[i - 1], turned, speeds[i] - speeds[i - 1], 0.3, _DT)
    return float(a["age"])


def _age(**signals):
    return _follow(np.zeros(1, LATENESS)[0], *_signals(**signals))


@pytest.mark.parametrize("late_s", [0.001, 0.004, 0.009])
@pytest.mark.parametrize("gain", [1.0, 0.95, 1.05])
def test_the_age_is_found_whatever_the_gain(late_s, gain):
    assert _age(late_s=late_s, gain=gain) == pytest.approx(late_s, abs=0.1 * late_s + 2e-4)


@pytest.mark.parametrize("gain", [0.93, 1.0, 1.07])
def test_an_angle_in_time_is_not_old(gain):
    assert _age(gain=gain) < 2e-4


@pytest.mark.parametrize("age", [-0.05, -0.006, 0.001, 0.004, 0.006, 0.05])
@pytest.mark.parametrize("apart", [_DT, 0.01])
def test_what_the_motor_has_turned_since_is_the_way_of_its_speeds(age, apart):
    angle, speed = _strokes()
    w = np.zeros(1, LATELY)[0]
    for number in range(100):
        now = 0.1 + apart * number
        remember(w, speed(now), apart if number else 0.0)
        if now > 0.1 + abs(age):
            way = angle(now) - angle(now - abs(age))
            # Between two samples the speed is off its chord by an eighth of the curvature at most.
            assert turned_within(w, age) == pytest.approx(np.sign(age) * way, abs=(apart * 9.0) ** 2 * 90.0 / 8.0 * abs(age))


def _most_apart(angle_age, speed_age, known):
    """Largest difference (rad) of the angle's way in a sample from the one that it is held against, ages in s."""
    (angle, speed), w, most = _strokes(), np.zeros(1, LATELY)[0], 0.0
    for now in np.arange(0.0, 2.0, _DT):
        travel = angle(now - angle_age) - angle(now - angle_age - _DT)
        way = way_beside(w, travel, speed(now - speed_age), speed(now - speed_age - _DT), known, _DT)
        most = max(most, abs(travel - way)) if now > 0.2 else 0.0
        remember(w, speed(now - speed_age), _DT)
    return most


@pytest.mark.parametrize("age", [0.001, 0.006, 0.013, 0.03, 0.05])
def test_an_angle_known_to_be_late_is_held_against_the_speeds_of_its_own_moment(age):
    assert _most_apart(age, 0.0, known=age) < 2e-4
    assert _most_apart(age, 0.0, known=0.0) > 0.9 * 810.0 * age * _DT * np.sinc(9.0 * age / 2.0 / np.pi)
    # What made the angle late may have made the speed so, too, and one that is early has none of its own moment yet.
    assert _most_apart(age, age, known=age) < 2e-4
    assert _most_apart(0.0, 0.0, known=-age) < 2e-4


def test_no_age_is_no_way_and_before_the_first_speeds_the_motor_turned_at_those():
    w = np.zeros(1, LATELY)[0]
    assert turned_within(w, 0.01) == 0.0
    for speed in np.linspace(10.0, 40.0, 31):
        remember(w, speed, 0.001)
        assert turned_within(w, 0.0) == 0.0
    # Thirteen ways, from 27 to 40 rad/s, and 27 rad/s before.
    assert turned_within(w, 0.05) == pytest.approx(0.013 * 33.5 + 0.037 * 27.0)
    remember(w, 7.0, 0.0)
    assert turned_within(w, -0.002) == pytest.approx(-0.014)


def test_an_older_speed_says_nothing_of_the_angle():
    assert _age(speed_late_s=0.003) == 0.0


def _unfilter(a, angles, speeds):
    """Follow signals as the estimator does; the speeds that it takes them for."""
    m, taken, before = np.zeros(1, SAMPLE)[0], [speeds[0]], angles[0]
    m["dt"], a["reported"] = _DT, speeds[0]
    for angle, speed in zip(angles[1:], speeds[1:], strict=True):
        m["speed"] = speed
        unfilter(a, m)
        follow(a, angle - before, 0.5 * (m["speed"] + taken[-1]) * _DT, m["speed"] - taken[-1], 0.3, _DT)
        find_filter(a)
        before, taken = angle, [*taken, float(m["speed"])]
    return np.array(taken)


@pytest.mark.parametrize("filter_s", [0.004, 0.01, 0.03])
def test_a_filter_of_the_speed_is_undone(filter_s):
    a, (angles, speeds) = np.zeros(1, LATENESS)[0], _signals()
    taken = _unfilter(a, angles, brake.filtered(speeds, filter_s / _DT))
    assert a["filtered"] == pytest.approx(filter_s, rel=0.1, abs=_DT / 2)
    left = np.std((taken - speeds)[250:])
    assert left < 0.25 * np.std((brake.filtered(speeds, filter_s / _DT) - speeds)[250:])


def test_a_filter_that_comes_while_driving_is_found_in_a_stroke_and_one_that_goes_is_forgotten():
    a, (angles, speeds) = np.zeros(1, LATENESS)[0], _signals(seconds=60.0)
    _unfilter(a, angles, speeds)
    assert a["filtered"] == 0.0
    angles, speeds = _signals(seconds=1.0)
    _unfilter(a, angles, brake.filtered(speeds, 0.015 / _DT))
    assert a["filtered"] == pytest.approx(0.015, rel=0.2)
    _unfilter(a, *_signals(seconds=2.0))
    assert a["filtered"] < _DT / 2


@pytest.mark.parametrize("signals", [{"gain": 0.93}, {"gain": 1.07}, {"late_s": 0.009}, {"speed_late_s": 0.0015}])
def test_what_is_no_filter_of_the_speed_is_not_undone(signals):
    """A gain of the resolver, an old angle, a speed that is the mean of its cycle as it was at calibration."""
    a = np.zeros(1, LATENESS)[0]
    _unfilter(a, *_signals(seconds=20.0, **signals))
    assert a["filtered"] == 0.0


def test_neither_slip_nor_noise_is_a_filter():
    a, (angles, speeds) = np.zeros(1, LATENESS)[0], _signals(seconds=30.0)
    strokes = np.floor(9.0 * _DT * np.arange(len(angles)) / (2.0 * np.pi))
    _unfilter(a, angles - 4.0 * strokes, speeds + 0.3)
    assert a["filtered"] == 0.0
    _unfilter(a, np.zeros(5000), 10.0 * np.random.default_rng(1).standard_normal(5000))
    assert a["filtered"] == 0.0


def test_a_filter_is_undone_up_to_twelve_cycles():
    a, (angles, speeds) = np.zeros(1, LATENESS)[0], _signals(seconds=20.0)
    _unfilter(a, angles, brake.filtered(speeds, 0.055 / _DT))
    assert a["filtered"] == SLOWEST_S


def _gain(**signals):
    a = np.zeros(1, LATENESS)[0]
    _follow(a, *_signals(**signals))
    return float(a["gain"])


@pytest.mark.parametrize("late_s", [0.0, 0.006])
@pytest.mark.parametrize("gain", [0.992, 1.01])
def test_a_gain_of_under_a_hundredth_is_found_within_some_strokes(gain, late_s):
    assert _gain(gain=gain, late_s=late_s) == pytest.approx(abs(gain - 1.0), abs=0.002)


def test_a_gain_that_the_integration_of_the_speed_may_make_is_none():
    assert _gain(gain=1.003) == _gain(gain=0.997) == _gain(late_s=0.006) == 0.0


def test_no_angle_is_older_than_the_oldest():
    assert _age(late_s=0.016) == 0.015


def test_a_speed_is_as_old_as_asked_or_the_oldest_that_is_kept():
    w = np.zeros(1, LATELY)[0]
    for speed in range(40):
        remember(w, float(speed), _DT)
    oldest = 40 - len(w["speed"])
    assert [speed_then(w, age * _DT) for age in (0, 2, 39 - oldest, 99)] == [39, 37, oldest, oldest]


@pytest.mark.parametrize("size", [1.0, 0.25])
def test_one_stroke_tells(size):
    """Also a gentle one, of 5 rad at up to 22 rad/s."""
    assert _age(late_s=0.004, seconds=0.8, size=size) == pytest.approx(0.004, rel=0.2)


@pytest.mark.parametrize("noise", [0.3, 0.02])
def test_nothing_is_learned_of_a_motor_that_stands(noise):
    """Neither of its noise, nor of signals without any."""
    a, rng = np.zeros(1, LATENESS)[0], np.random.default_rng(1)
    assert _follow(a, np.zeros(10), np.zeros(10)) == 0.0
    assert _follow(a, _COUNT * rng.integers(0, 2, 750), noise * rng.standard_normal(750)) < 2e-4


def test_an_age_is_kept_while_the_motor_stands_and_forgotten_when_it_has_gone():
    a = np.zeros(1, LATENESS)[0]
    assert _follow(a, *_signals(late_s=0.004, seconds=60.0)) == pytest.approx(0.004, rel=0.1)
    assert _follow(a, np.zeros(2500), np.zeros(2500)) == pytest.approx(0.004, rel=0.1)
    assert _follow(a, *_signals(seconds=120.0)) < 6e-4


def test_neither_a_slip_nor_an_offset_of_the_speed_is_an_age():
    """A resolver that slips on its shaft as each stroke begins is off at once; a speed that is off by a little, ever more."""
    angles, speeds = _signals(seconds=30.0)
    strokes = np.floor(9.0 * _DT * np.arange(len(angles)) / (2.0 * np.pi))
    assert _follow(np.zeros(1, LATENESS)[0], angles - 4.0 * strokes, speeds) < 2e-4
    assert _follow(np.zeros(1, LATENESS)[0], angles, speeds + 0.3) < 2e-4


def test_after_an_interruption_what_is_apart_is_counted_anew():
    """Samples of a fault that was found late say nothing of those after it; what was known before stays known."""
    a = np.zeros(1, LATENESS)[0]
    age = _follow(a, *_signals(late_s=0.004))
    follow(a, 0.0, 0.05, 4.0, 0.3, _DT)
    interrupt(a)
    assert a["apart"] == a["gained"] == a["gone"] == 0.0
    follow(a, 0.0, 0.0, 0.0, 0.3, _DT)
    assert a["age"] == pytest.approx(age, rel=0.02)


@pytest.mark.parametrize("late_s", [0.002, 0.006, 0.0095])
def test_a_late_angle_is_undone(parameters, late_s):
    """The force is right where the stiffness path would lag by the way of the motor, and sigma covers the rest. An angle that
    is over two cycles old is told."""
    p = brake.ideal(parameters)
    path = brake.stops(p, 5)
    rows, force = brake.samples(p, path)
    time = _DT * np.arange(len(path))
    rows["angle"] = np.interp(time - late_s, time, path)
    rows = brake.noisy(rows, p)
    estimates = estimate(rows, p.reshape(1))
    second = slice(750, None)
    error = np.abs(estimates["force"] - force)[second]
    stroke = (np.abs(rows["speed"]) > 20.0)[second] & (force[second] > 1000.0)
    lag = late_s * (np.gradient(force) / _DT)[second][stroke]
    assert np.sqrt(np.mean(error[stroke] ** 2)) < 0.3 * np.sqrt(np.mean(lag**2))
    assert np.mean(error > 3.0 * np.hypot(estimates["sigma"][second], 25.0)) < 0.01
    assert np.all(estimates["reasons"][second] & PATHS_DISAGREE) == (late_s > 2.0 * _DT)


def test_a_delay_that_the_calibration_knows_is_undone_once(parameters):
    p = brake.ideal(parameters)
    path = brake.stops(p, 5)
    rows, force = brake.samples(p, path)
    time = _DT * np.arange(len(path))
    rows["angle"] = np.interp(time - 0.004, time, path)
    rows = brake.noisy(rows, p)
    p["effects"]["signal_delay"]["delay_s"] = 0.004
    error = (estimate(rows, p.reshape(1))["force"] - force)[750:]
    assert np.sqrt(np.mean(error**2)) < 60.0


def _stand(a, speeds, noise=0.3):
    """What an estimator takes for the speeds of a motor that stands."""
    taken = []
    for speed in speeds:
        taken.append(speed - a["offset"])
        stand(a, taken[-1], noise)
    return np.array(taken)


@pytest.mark.parametrize("offset", [-4.0, -0.2, 0.5])
def test_an_offset_of_the_speed_is_found_while_the_motor_stands_and_refined(offset):
    a, noise = np.zeros(1, LATENESS)[0], 0.3 * np.random.default_rng(1).standard_normal(6000)
    _stand(a, offset + noise[:150])
    assert a["offset"] == pytest.approx(offset, abs=0.1)
    taken = _stand(a, offset + noise[150:])
    assert a["offset"] == pytest.approx(offset, abs=0.015)
    assert abs(np.mean(taken[-2000:])) < 0.02


def test_an_offset_that_changes_is_found_anew():
    a, noise = np.zeros(1, LATENESS)[0], 0.3 * np.random.default_rng(2).standard_normal(6000)
    _stand(a, 0.5 + noise)
    _stand(a, -1.0 + noise[:600])
    assert a["offset"] == pytest.approx(-1.0, abs=0.05)


def test_noise_and_what_no_motor_shows_that_stands_are_no_offset():
    a, rng = np.zeros(1, LATENESS)[0], np.random.default_rng(3)
    _stand(a, 0.3 * rng.standard_normal(100_000))
    _stand(a, 9.0 * rng.standard_normal(100_000), noise=9.0)
    _stand(a, np.full(1000, 40.0))
    assert a["offset"] == 0.0


def test_a_speed_that_an_old_angle_does_not_show_yet_is_no_offset():
    a, rng = np.zeros(1, LATENESS)[0], np.random.default_rng(5)
    for _ in range(100):
        _stand(a, np.concatenate((0.3 * rng.standard_normal(100), [4.0, 10.0, 18.0])))
    assert a["offset"] == 0.0


def test_noise_of_the_speed_is_no_filter():
    """Both what is apart and what the speed gains contain it."""
    a, (angles, speeds) = np.zeros(1, LATENESS)[0], _signals(seconds=30.0)
    noisy = speeds + 6.0 * np.random.default_rng(4).standard_normal(len(speeds))
    for i in range(1, len(angles)):
        follow(a, angles[i] - angles[i - 1], 0.5 * (noisy[i] + noisy[i - 1]) * _DT, noisy[i] - noisy[i - 1], 6.0, _DT)
        find_filter(a)
        assert a["filtered"] == 0.0


# In the estimator.


@pytest.fixture
def s():
    return new_state()[0]


#: Way (rad) by the speed in the sample of `_turning`.
_TURNED = 0.5 * 100.0 * _DT


def _turning(p):
    """A sample of a motor that gains speed, whose angle is 5 ms late."""
    m = brake.samples(p, np.zeros(2))[0][1]
    m["angle"], m["speed"] = -0.3, 100.0
    return m


@pytest.mark.parametrize(("filtered_s", "moved"), [(0.0, True), (0.03, False)])
def test_what_a_late_speed_leaves_where_a_filter_is_undone_moves_no_zero(parameters, s, filtered_s, moved):
    """An angle that is 0.8 rad ahead of a speed that gains 40 rad/s in a sample."""
    m = _turning(parameters[0])
    s["speed"], s["lateness"]["filtered"] = 60.0, filtered_s
    m["angle"] = 0.5 * (100.0 + 60.0) * _DT + 0.8
    assert follow_zero(s, parameters[0], m, 0.5 * (100.0 + 60.0) * _DT) == moved


@pytest.mark.parametrize("what", ["nothing", "zero moved", "no time", "a sample missing", "drifting", "frozen"])
def test_a_sample_that_is_no_motion_is_not_followed(parameters, s, what):
    m = _turning(parameters[0])
    step._follow_age(s, parameters[0], m, _TURNED, False)
    before = s["lateness"].copy()
    assert before["apart"] != 0.0 and before["gained"] == 100.0
    if what == "no time":
        m["dt"] = 0.0
    elif what == "a sample missing":
        m["dt"] = 0.008
    elif what == "drifting":
        s["drifting_s"] = 0.1
    elif what == "frozen":
        # The angle stands while the speed goes on.
        s["plausibility"]["still"] = 5
    step._follow_age(s, parameters[0], m, _TURNED, what == "zero moved")
    followed = what == "nothing"
    assert (s["lateness"]["gained"] != 0.0) == (s["lateness"]["apart"] != 0.0) == followed
    assert (s["lateness"]["sums"][0] != before["sums"][0]) == followed


@pytest.mark.parametrize(("verdict", "followed"), [(AGREE, True), (UNDECIDED, True), (STIFFNESS_WRONG, False)])
def test_a_resolver_that_is_not_believed_tells_of_no_drift(parameters, s, verdict, followed):
    s["plausibility"]["verdict"] = verdict
    step._follow_age(s, parameters[0], _turning(parameters[0]), _TURNED, False)
    assert (s["wander"]["seconds"] == _DT) == (s["wander"]["slip"] != 0.0) == followed


@pytest.mark.parametrize(("known_s", "left_s"), [(0.0, 0.007), (0.004, 0.003), (0.007, 0.0), (0.009, 0.0)])
def test_what_the_calibration_knows_or_holds_for_exact_is_not_undone(parameters, s, known_s, left_s):
    p, m = parameters[0], _turning(parameters[0])
    p["effects"]["signal_delay"]["delay_s"] = known_s
    for m["angle"], m["speed"] in zip(*_signals(late_s=0.007, seconds=10.0), strict=True):
        turned = way_beside(s["lately"], m["angle"] - s["angle"], m["speed"], s["speed"], known_s, _DT)
        step._follow_age(s, p, m, turned, False)
        remember(s["lately"], m["speed"], _DT)
        s["angle"], s["speed"] = m["angle"], m["speed"]
    assert s["late"] == pytest.approx(left_s, abs=4e-4)
    p["clearance_sigma"] = 0.0
    step._follow_age(s, p, m, 0.0, False)
    assert s["late"] == 0.0


@pytest.mark.parametrize(
    ("late_s", "filtered_s", "told"), [(0.0079, 0.0, False), (0.0081, 0.0, True), (0.0, 0.047, False), (0.0, SLOWEST_S, True)]
)
def test_an_angle_over_two_cycles_old_is_told_and_a_speed_that_may_be_older_than_is_undone(
    parameters, s, late_s, filtered_s, told
):
    s["late"], s["lateness"]["filtered"] = late_s, filtered_s
    assert bool(fuse._facts_of_torque(s, parameters[0]) & ANGLE_LATE) == told


@pytest.mark.parametrize("filter_s", [0.004, 0.012, 0.018])
@pytest.mark.parametrize("seed", [0, 1])
def test_what_a_filtered_speed_hides_is_not_taken_for_another_brake(parameters, filter_s, seed):
    """Without this inertia comes kilonewtons too late. It is kept over a restart."""

    def change(rows):
        rows["speed"] = brake.filtered(rows["speed"], filter_s / _DT)

    samples, force = city.drive(seed, 40.0)
    samples, state = samples.copy(), new_state()
    change(samples)
    estimates = estimate(samples, parameters, state)
    city.assert_undone(estimates, force, seed)
    p, resumed, snapshot = parameters[0], new_state()[0], np.zeros(1, restart.SNAPSHOT)[0]
    assert restart.take_snapshot(state[0], p, snapshot) and not restart.why_implausible(snapshot, p)
    restart.resume(resumed, p, snapshot, 60.0)
    assert resumed["lateness"]["filtered"] == snapshot["filtered"] == pytest.approx(filter_s, rel=0.15, abs=_DT / 2)
    snapshot["filtered"] = 0.05
    assert restart.why_implausible(snapshot, p) == "filtered"


@pytest.mark.parametrize("passed_for", ["drifting", "wandering"])
def test_a_resolver_that_passed_for_drifting_beside_an_offset_is_believed_again_where_the_motor_stands(
    parameters, s, passed_for
):
    """Half a second of rest shows the offset; that the angle follows the speed again would take a stroke. What was learned
    meanwhile, which way friction holds the motor and what torque the clearance needs are forgotten: pads that creep by 0.4
    were 2.5 kN, friction of the other side 0.3."""
    p, m = parameters[0], _turning(parameters[0])
    m["angle"], m["speed"], m["has_status"], m["park_brake"], m["brake_request"] = 0.0, 2.0, True, 0.0, 0.0
    s["past_contact"], s["contact_angle"], s["clearance"] = -1.0, 9.0, 7.0
    rewind.keep_all(s)
    if passed_for == "drifting":
        s["drifting_s"], s["plausibility"]["verdict"] = 30.0, STIFFNESS_WRONG
    else:
        s["wander"]["found"] = True
    s["plausibility"]["held"], s["creep"][0], s["friction_variance"] = 100, 0.4, 0.0
    s["contact"]["level"], s["contact"]["samples"] = -0.1, 300.0
    for _ in range(125):
        step._follow_noise(s, p, m)
    assert s["drifting_s"] == 0.0 and s["plausibility"]["verdict"] == AGREE and not s["wander"]["found"]
    assert s["creep"][0] == 0.0 and s["friction_variance"] == 1.0 and s["contact"]["samples"] == 0.0
    assert s["contact_angle"] == 7.0


def test_what_was_seen_beside_another_speed_is_forgotten_with_it(parameters):
    """In the sample in which the speed becomes another: an acceleration between both is none, and what they said of the brake
    and of the angle is void."""
    samples, _ = city.drive(0, 20.0)
    samples, state = samples.copy(), new_state()
    samples["speed"] = brake.filtered(samples["speed"], 0.012 / _DT)
    out = None
    for row in range(len(samples)):
        before, out = out, estimate(samples[row : row + 1], parameters, state)[0]
        if state["lateness"]["filtered"][0] > 0.0:
            break
    opened = state.copy()
    open_all(opened[0], parameters[0])
    assert 0 < row < len(samples) - 1 and np.isfinite(before["innovation"]) and np.isnan(out["innovation"])
    assert state["plausibility"]["apart"][0] == 0.0 and np.isnan(state["strayed"][0])
    assert state["alternatives"]["log_odds"].tolist() == opened["alternatives"]["log_odds"].tolist()


@pytest.mark.parametrize("offset", [-2.0, 0.2])
@pytest.mark.parametrize("seed", [0, 1])
def test_an_offset_of_the_speed_is_no_zero_that_wanders(offset, seed):
    """Added up over a minute it would be kilonewtons; with sigma it would be a brake that is never used."""

    def change(rows):
        rows["speed"] += offset

    estimates, force = city.changed(change, seed, 40.0)
    unmoved, _ = city.changed(seed=seed, seconds=40.0)
    error, as_it_is = (estimates["force"] - force)[500:], (unmoved["force"] - force)[500:]
    assert np.sqrt(np.mean(error**2)) < np.sqrt(np.mean(as_it_is**2)) + 15.0
    assert np.median(estimates["sigma"][500:]) < 1.2 * np.median(unmoved["sigma"][500:])
    assert not np.any(estimates["reasons"][500:] & OUT_OF_RANGE)


@pytest.mark.parametrize("offset", [-2.0, 1.0, 3.4, -5.0])
def test_an_offset_that_begins_in_a_brake_that_clamps_is_taken_off_once_it_is_released(offset):
    """Until then it may be an angle that drifts, which is told. One that repeats beside 3.4 rad/s is not behind: that were
    6.8 rad."""

    def change(rows):
        rows["speed"][1400:] += offset

    estimates, force = city.changed(change, 0, 40.0)
    assert np.any(estimates["reasons"][1400:2150] != 0)
    second = slice(city.SECOND_CLEARANCE, None)
    assert not np.any(estimates["reasons"][second] & OUT_OF_RANGE)
    assert np.mean(np.abs(estimates["force"] - force)[second] > 3.0 * np.hypot(estimates["sigma"][second], 25.0)) < 0.01
    good, _ = city.changed(seconds=40.0)
    rmse, as_it_is = (np.sqrt(np.mean((e["force"] - force)[second] ** 2)) for e in (estimates, good))
    assert rmse < as_it_is + 10.0


def test_a_motor_that_starts_before_an_old_angle_shows_it_has_neither_a_noisy_speed_nor_one_with_an_offset(parameters):
    """For 48 ms the angle still stands; tens of rad/s of noise, or a hundredth as an offset, move the zero by radians."""
    p, state, worst, offset = parameters.copy(), new_state(), 0.0, 0.0
    rows = city.drive(0, 40.0)[0].copy()
    rows["angle"] = np.concatenate([np.full(12, rows["angle"][0]), rows["angle"][:-12]])
    p["effects"]["signal_delay"]["delay_s"] = 12 * _DT
    for row in range(0, len(rows), 5):
        estimate(rows[row : row + 5], p, state)
        worst = max(worst, state["speed_sigma"][0])
        offset = max(offset, abs(state["lateness"]["offset"][0]))
    assert worst < 2.0 * p["speed_sigma"][0] and offset < 0.2


@pytest.mark.parametrize("speed", [0.3, 1.0, 2.0])
def test_an_angle_that_is_frozen_while_the_motor_closes_slowly_is_no_offset_of_the_speed(parameters, speed):
    """Else kilonewtons would come of which nothing is said."""
    p = brake.ideal(parameters)
    touching = brake.stops(p, 2)
    clamped = float(p["clearance"]) + 6.0
    closing = np.concatenate((touching, np.zeros(250), np.linspace(0.0, clamped, 500), np.full(250, clamped)))
    frozen = len(closing)
    rows, force = brake.samples(p, np.concatenate((closing, clamped + speed * _DT * np.arange(int(4.0 / speed / _DT)))))
    rows = brake.noisy(rows, p)
    rows["angle"][frozen:] = rows["angle"][frozen]
    estimates = estimate(rows, p.reshape(1))[frozen:]
    error = np.abs(estimates["force"] - force[frozen:])
    told = estimates["reasons"] != 0
    assert np.flatnonzero(told)[0] * _DT < 2.0 and np.max(error[~told]) < 600.0 and error[-1] > 2.0 * np.max(error[~told])


def test_an_offset_of_the_speed_is_the_mean_of_all_that_a_standing_motor_has_shown():
    """From a fifth of a second on: fifty samples."""
    a, speeds = np.zeros(1, LATENESS)[0], 0.5 + 0.1 * np.random.default_rng(6).standard_normal(400)
    for number, speed in enumerate(speeds, 1):
        stand(a, speed - float(a["offset"]), 0.1)
        assert a["offset"] == pytest.approx(speeds[:number].mean() if number >= 50 else 0.0)


@pytest.mark.parametrize("age", [0.004, 0.0065, 0.013])
def test_friction_where_the_angle_is_late_is_that_of_the_motors_own_motion(age):
    """But in a cycle in which it turns back: the state by the late angle, slid on by the speeds since."""
    (angle, speed), w, presliding = _strokes(), np.zeros(1, LATELY)[0], 0.2
    state = own = 0.0
    for now in np.arange(0.05, 1.5, _DT):
        remember(w, speed(now), _DT)
        state, mean, _ = friction_state(state, 0.0, angle(now - age) - angle(now - age - _DT), presliding, 0.0, _DT)
        own, expected, _ = friction_state(own, 0.0, angle(now) - angle(now - _DT), presliding, 0.0, _DT)
        if now > 0.2 and np.abs(speed(now - np.arange(0.0, age + 2.0 * _DT, 0.001))).min() > 3.0:
            assert friction_since(w, state, mean, age, 0.0, presliding) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(("speed", "turns_over"), [(0.25, True), (0.02, False)])
def test_speeds_within_their_noise_turn_friction_over_once_their_sum_is_more_than_noise_makes(speed, turns_over):
    """A speed's noise of 0.3 rad/s adds up to 0.004 rad in 50 ms."""
    w = np.zeros(1, LATELY)[0]
    for _ in range(20):
        remember(w, -speed, _DT)
    assert (friction_since(w, 1.0, 1.0, 0.048, 0.3, 0.002) < 0.0) == turns_over
