"""A motor angle that gains, over stops, what its speed does not say: drifts and lost counts too slow for one standstill."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator.contact import place_contact
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.straying import attribute_straying, follow_straying, straying_sigma
from emb_daemon.models import wander
from emb_daemon.models.fusion import CONTACT, COULOMB, OFFSET
from emb_daemon.models.wander import WANDER, leave_stretch, watch_wander
from emb_daemon.offline import estimate
from emb_daemon.wire import contract as r

_DT = 0.004
_COUNT = 2.0 * np.pi / 4096
#: Stops of three seconds each.
_STOPS = 40


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _watched(p, drift=0.0, loss=0.0, gain=1.0, late=0, offset=0.0, seed=1, gap=False):
    """WANDER record after the stops, with a ``drift`` (rad/s) from their middle on; ``late`` samples, ``offset`` rad/s of the
    speed."""
    angle = brake.stops(p, _STOPS, seed)
    speed = np.gradient(angle, _DT) + offset + 0.3 * np.random.default_rng(seed).standard_normal(len(angle))
    time = _DT * np.arange(len(angle))
    read = gain * np.concatenate((np.zeros(late), angle[: len(angle) - late])) + drift * np.maximum(time - 0.5 * time[-1], 0.0)
    read -= loss * np.cumsum(np.maximum(np.diff(angle, prepend=0.0), 0.0))
    read = np.round(read / _COUNT) * _COUNT
    a = np.zeros(1, WANDER)[0]
    for i in range(1, len(read)):
        if gap and i % 700 == 0:
            leave_stretch(a)
            continue
        watch_wander(
            a, read[i] - read[i - 1], 0.5 * (speed[i] + speed[i - 1]) * _DT, speed[i], speed[i] - speed[i - 1], 0.3, _DT
        )
    return a


@pytest.mark.parametrize("drift", [-0.05, 0.05])
@pytest.mark.parametrize("gap", [False, True])
def test_a_drift_is_found_at_its_size(p, drift, gap):
    a = _watched(p, drift=drift, gap=gap)
    assert a["found"] and a["rate"] == pytest.approx(drift, abs=0.02)


def test_a_drift_is_found_beside_the_offset_that_its_speed_always_had(p):
    """Also one that makes both signals agree."""
    a = _watched(p, drift=0.05, offset=0.05)
    assert a["found"] and a["rate"] == pytest.approx(0.05, abs=0.025)


def test_counts_lost_in_one_direction_are_found_at_their_size(p):
    """They are half a share of the whole way, and a gain error that returns with the motor."""
    a = _watched(p, loss=0.006)
    assert a["found"] and a["loss"] == pytest.approx(-0.003, rel=0.2)


@pytest.mark.parametrize(
    "healthy", [{}, {"gain": 0.98}, {"gain": 1.02}, {"late": 2}, {"offset": 0.05}, {"offset": -0.05, "gain": 1.01, "late": 1}]
)
@pytest.mark.parametrize("seed", range(3))
def test_what_returns_with_the_motor_or_was_always_there_is_no_drift(p, healthy, seed):
    a = _watched(p, seed=seed, **healthy)
    assert not a["found"] and a["rate"] == 0.0 and a["loss"] == 0.0


def _estimated(p, change, seed):
    rows, force = brake.samples(p, brake.stops(p, _STOPS, seed))
    rows = brake.noisy(rows, p, seed)
    change(rows)
    return estimate(rows, p), force


def _drift(rad_per_s, begin=0):
    """Change of SAMPLE rows whose angle drifts from row ``begin`` on."""

    def change(rows):
        rows["angle"] += rad_per_s * _DT * np.maximum(np.arange(len(rows)) - begin, 0)

    return change


def _beyond(estimates, force):
    return np.abs(estimates["force"] - force) > 3.0 * np.hypot(estimates["sigma"], 25.0)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("change", "begin", "within_s"),
    [
        (_drift(-0.1, 7500), 7500, 30.0),
        (_drift(0.1, 7500), 7500, 30.0),
        (lambda rows: brake.lose_counts(rows, 0.005), 0, 60.0),
    ],
    ids=["drift", "drift ahead", "half a percent of lost counts"],
)
def test_a_slow_drift_is_told_within_half_a_minute_and_covered(p, change, begin, within_s, seed):
    """Lost counts within a minute."""
    estimates, force = _estimated(p, change, seed)
    told = np.flatnonzero(estimates["reasons"] & r.OUT_OF_RANGE)
    assert len(told) and begin < told[0] < begin + within_s / _DT
    assert np.mean(estimates["source"] == r.FUSED) > 0.99
    assert np.mean(_beyond(estimates, force)[told[0] :]) < 0.02


@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_lost_before_it_is_certain_is_covered(p, seed):
    """The contact angle walks as far as counts that are probably lost would take it."""
    estimates, force = _estimated(p, lambda rows: brake.lose_counts(rows, 0.004), seed)
    assert np.mean(_beyond(estimates, force)) < 0.01


def test_without_drift_nothing_is_told(p):
    estimates, force = _estimated(p, lambda rows: None, 1)
    assert not np.any(estimates["reasons"] & r.OUT_OF_RANGE)
    assert np.mean(_beyond(estimates, force)) < 0.01


def _rmse(estimates, force):
    return np.sqrt(np.mean((estimates["force"] - force) ** 2))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("rad_per_s", [-0.1, 0.1])
def test_after_some_stops_the_contact_angle_drifts_with_the_angle(p, rad_per_s, seed):
    """Without that the filter follows with 380 to 530 N."""
    estimates, force = _estimated(p, _drift(rad_per_s), seed)
    learned = slice(len(force) // 2, None)
    assert _rmse(estimates[learned], force[learned]) < 300.0
    assert np.mean(_beyond(estimates, force)[learned]) < 0.01


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("rad_per_s", [-0.1, 0.1])
def test_an_offset_of_the_speed_leaves_the_contact_angle_where_it_is(p, rad_per_s, seed):
    """Its drift would be 400 um in the whole."""

    def offset(rows):
        rows["speed"] += rad_per_s

    estimates, force = _estimated(p, offset, seed)
    assert _rmse(estimates, force) < 150.0
    assert np.mean(_beyond(estimates, force)) < 0.01


@pytest.mark.parametrize("seed", [1, 2])
def test_an_angle_that_creeps_in_a_hold_does_not_slide_the_gear(p, seed):
    """Its torque lies within friction's band, which the torque's sigma covers: it is not that of a closing motor."""
    angle = np.concatenate((brake.stops(p, _STOPS // 2, seed), np.linspace(0.0, 14.0, 250), np.full(7500, 14.0)))
    rows, force = brake.samples(p, angle)
    rows = brake.noisy(rows, p, seed)
    rows["angle"] += 0.06 * _DT * np.arange(len(rows))
    rows["current_q"][-7250:] *= 0.6
    estimates = estimate(rows, p)
    held = slice(-5000, None)
    missed = np.abs(estimates["torque_force"] - force)[held] / estimates["torque_sigma"][held]
    assert np.nanmedian(missed) < 1.3


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("rad_per_s", [-0.05, 0.05])
def test_an_angle_that_begins_to_creep_while_the_motor_stands_is_no_other_gear(p, rad_per_s, seed):
    """Before the drift can be known at all: the gear would slide by it in half a second, against a current that says nothing
    of that, and friction and current offset would have jumped. A motor that turns back does not stand."""
    angle = np.concatenate((brake.stops(p, 3, seed), np.zeros(1000), brake.stops(p, 2, seed)))
    begin = 3 * len(brake.stops(p, 1, seed)) + 100
    rows, _ = brake.samples(p, angle)
    rows = brake.noisy(rows, p, seed)
    rows["angle"] += rad_per_s * _DT * np.clip(np.arange(len(rows)) - begin, 0, 850)
    state = new_state()
    estimate(rows[: begin + 850], p, state)
    learned = state["error"][0, [COULOMB, OFFSET]] / p["offset_friction"]
    assert np.all(np.abs(learned) < 0.25), learned


@pytest.mark.parametrize("placed", [False, True])
def test_a_contact_angle_that_was_placed_anew_tells_nothing_of_the_zero(p, placed):
    """It moved because another one was believed, not because the zero strayed."""
    s = new_state()[0]
    s["gear_slope"], s["straying"]["known"], s["straying"]["strayed"] = 1.0, 0.01, 0.5
    s["covariance"][CONTACT, CONTACT], s["clearance"] = 0.01, p["clearance"]
    if placed:
        place_contact(s, p, 5.0)
        s["covariance"][CONTACT, CONTACT] = 0.01
    s["contact_angle"] += 0.5
    attribute_straying(s)
    assert s["straying"]["share"] == (0.0 if placed else pytest.approx(0.86, abs=0.01))
    assert s["straying"]["strayed"] == 0.0 and s["straying"]["known"] == 0.01


@pytest.mark.parametrize("zero_rad", [-4.0, 0.0, 150.0])
def test_what_a_stop_tells_of_the_zero_is_the_same_wherever_the_zero_is(p, zero_rad):
    """It moved by all that has strayed, whatever the resolver reads there; and the zero of another power-on is no straying."""
    s, a = (state := new_state()[0]), state["straying"]
    s["gear_slope"], s["covariance"][CONTACT, CONTACT], s["clearance"] = 1.0, 0.01, p["clearance"]
    s["contact_angle"] = s["contact_anchor"] = p["clearance"]
    attribute_straying(s)
    s["contact_angle"] += zero_rad
    s["contact_anchor"] += zero_rad
    a["strayed"], s["contact_angle"] = 0.5, s["contact_angle"] + 0.5
    attribute_straying(s)
    assert a["share"] == pytest.approx(0.86, abs=0.01)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("rad_per_s", [-0.1, -0.067, 0.1])
def test_an_angle_that_creeps_while_brakes_are_open_drifts_whatever_the_offset_of_the_speed(p, rad_per_s, seed):
    """It began before that offset could be known. Nothing turns the motor of an open brake, so that some moments of rest tell;
    by the speed alone it is never told, and followed with up to 280 N and 3 % beyond three sigma."""
    begin = 1250
    estimates, force = _estimated(p, _drift(rad_per_s, begin), seed)
    told = np.flatnonzero(estimates["reasons"] & r.OUT_OF_RANGE)
    assert len(told) and begin < told[0] < begin + 12 / _DT
    assert _rmse(estimates[begin:], force[begin:]) < 240.0
    assert np.mean(_beyond(estimates, force)[begin:]) < 0.015


@pytest.mark.parametrize("offset", [0.0, 0.05, 0.3])
def test_a_count_that_flickers_beside_an_offset_of_the_speed_is_no_drift(p, offset):
    def flicker(rows):
        count = np.random.default_rng(1).random(len(rows)) < 0.5
        rows["angle"] = (np.round(rows["angle"] / _COUNT) + count) * _COUNT
        rows["speed"] += offset

    estimates, force = _estimated(p, flicker, 1)
    assert np.mean(estimates["reasons"] & r.OUT_OF_RANGE != 0) < 0.001
    assert np.mean(_beyond(estimates, force)) < 0.01


def test_what_the_motor_did_while_no_frames_came_is_no_drift(p):
    """The brake stood open before and after, a little further on."""
    rows, _ = brake.samples(p, brake.stops(p, 8, 1))
    rows = brake.noisy(rows, p)
    still = np.repeat(rows[1:2], 600)
    still["speed"] = 0.3 * np.random.default_rng(1).standard_normal(600)
    later = still.copy()
    later["angle"] += 0.4
    later["dt"][0] = 30.0
    still["speed"][-1] = later["speed"][0] = 0.0
    estimates = estimate(np.concatenate((rows, still, later)), p)
    assert not np.any(estimates["reasons"][-500:] & r.OUT_OF_RANGE)


@pytest.mark.parametrize("rad_per_sample", [0.13, 0.007])
def test_a_rotor_that_slips_while_brakes_are_open_does_not_drift(p, rad_per_sample):
    """At once, or within a tenth of a second as something settles. Taken for a drift it was followed with 3.7 kN."""
    before = brake.stops(p, 3, 1)
    rows, _ = brake.samples(p, np.concatenate((before, np.zeros(1250), brake.stops(p, 2, 2))))
    rows = brake.noisy(rows, p)
    slipped = rad_per_sample * np.maximum(np.arange(len(rows)) - len(before) - 400, 0.0)
    rows["angle"] += np.minimum(slipped, 0.13)
    state = new_state()
    for first in range(0, len(rows), 250):
        estimate(rows[first : first + 250], p, state)
        assert state["straying"]["rate"][0] == 0.0


@pytest.fixture
def resting(p):
    """STATE of a motor that stands beside open brakes, its speed's noise 0.35 rad/s."""
    s = new_state()[0]
    s["gear_slope"], s["speed_sigma"] = 1.0, 0.35
    return s


def _rest(s, p, rad_per_s, read_rad_per_s=0.0, seconds=2.5):
    """Let its angle and its speed be read as changing so fast; returns the summed variance of the contact angle, rad²."""
    walked = 0.0
    for _ in range(round(seconds / _DT)):
        follow_straying(s, p, rad_per_s * _DT, read_rad_per_s * _DT, read_rad_per_s, True, _DT)
        walked += s["straying"]["walked"]
    return float(walked)


def test_a_drift_that_open_brakes_show_is_followed_from_where_it_began(p, resting):
    """0.5 rad had strayed, of which nobody knows when: the contact and the teeth go with it, and three tenths are unsure."""
    resting["wander"]["strayed"] = 0.5
    _rest(resting, p, 0.1)
    assert resting["straying"]["rate"] == pytest.approx(0.1, rel=1e-6)
    for name in ("contact_angle", "gear_zero", "zero_moved"):
        assert resting[name] == pytest.approx(0.5 + 0.1 * 0.48, abs=0.02), name
    assert resting["covariance"][CONTACT, CONTACT] == pytest.approx(0.15**2)


def test_the_rate_of_a_drift_may_change_by_a_tenth_until_the_motor_stands_again(p, resting):
    _rest(resting, p, 0.1)
    resting["straying"]["drifted"] = 0.0
    assert _rest(resting, p, 0.1, seconds=1.0) == pytest.approx(0.01**2, rel=1e-2)


def test_counts_go_on_to_be_lost_beside_a_drift(p, resting):
    a = resting["straying"]
    a["share"], a["rate"], resting["wander"]["loss"] = 0.5, 0.1, 0.01
    follow_straying(resting, p, 2.0, 2.0, 500.0, False, _DT)
    assert resting["contact_angle"] == pytest.approx(0.1 * _DT + 0.5 * 0.01 * 2.0)


@pytest.mark.parametrize(("rad_per_s", "known"), [(0.0, True), (0.3, True), (0.05, False)])
def test_what_the_speed_of_a_standing_motor_shows_is_its_offset(p, resting, rad_per_s, known):
    """Unless the angle shows the same: then the motor may creep after all."""
    _rest(resting, p, rad_per_s, 0.05)
    wander = resting["wander"]
    assert (wander["offset_weight"] > 0.0) == known
    assert not known or wander["offset_sum"] / wander["offset_weight"] == pytest.approx(-0.05)


def test_a_motion_that_a_late_speed_does_not_show_yet_is_no_drift(p, resting):
    for _ in range(8):
        _rest(resting, p, 0.0, seconds=0.4)
        for _ in range(2):
            follow_straying(resting, p, 0.008, 0.0, 0.0, True, _DT)
        follow_straying(resting, p, 0.2, 0.2, 50.0, False, _DT)
        resting["straying"]["speed"], resting["straying"]["creeps"] = 0.0, True
    assert resting["straying"]["told"] == 0.0 and resting["straying"]["rest_travel"] == 0.0


def test_what_strays_counts_by_what_is_not_known_of_its_share(resting):
    resting["wander"]["rate"] = -0.1
    assert straying_sigma(resting, 10.0) == pytest.approx(0.5)
    resting["straying"]["told"] = 96.0
    assert straying_sigma(resting, 10.0) == pytest.approx(0.1)


def test_drift_and_loss_are_the_least_squares_of_all_stretches_by_what_is_possible():
    """Stretches count less the longer ago they are; what looks like before is the speed's offset, and known as well."""
    a, rng, noise = np.zeros(1, WANDER)[0], np.random.default_rng(7), 0.3
    causes, normal, right = ("seconds", "way", "net", "gained"), np.zeros((4, 4)), np.zeros(4)
    order = [wander._RATE, wander._LOSS, wander._GAIN, wander._AGE]
    for _ in range(12):
        a["seconds"], a["way"], a["net"], a["gained"] = rng.uniform([2.0, 20.0, -30.0, -60.0], [8.0, 80.0, 30.0, 60.0])
        a["slip"] = 0.06 * a["seconds"] - 0.004 * a["way"] + 0.01 * rng.standard_normal()
        cause = np.zeros(4)
        cause[order] = [a[name] for name in causes]
        variance = noise**2 * _DT * a["seconds"] + wander.COUNTS_RAD**2 + (wander._MISSED * a["way"]) ** 2
        keep, known = np.exp(-a["seconds"] / wander._KEPT_S), float(a["offset_weight"])
        known *= np.exp(-a["seconds"] / wander._OFFSET_CHANGES_S)
        normal, right = keep * normal + np.outer(cause, cause) / variance, keep * right + cause * a["slip"] / variance
        whole = np.linalg.inv(normal + np.diag(wander._POSSIBLE))
        found = whole @ right
        wander._take_stretch(a, noise)
        for name, state in (("drift", wander._RATE), ("loss", wander._LOSS)):
            told = abs(found[state]) > wander._LIKELY * np.sqrt(whole[state, state])
            assert a[name] == pytest.approx(found[state] if told else 0.0)
        if a["offset_weight"] > known * (1.0 + 1e-9):
            more = a["seconds"] / (wander._KEPT_S * whole[wander._RATE, wander._RATE])
            assert a["offset_weight"] - known == pytest.approx(more)
    assert a["loss"] != 0.0 and a["drift"] != 0.0 and a["offset_weight"] > 0.0
