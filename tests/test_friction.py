"""Friction and the torque balance: what they say while the motor slides, and that they do not while it stands."""

import brake
import city
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.calibration.terms import Term, fill_terms
from emb_daemon.estimator import paths
from emb_daemon.estimator.records import new_state
from emb_daemon.models.lateness import LATELY, beyond_speeds, remember
from emb_daemon.models.torque import NOISE_TURNS_BACK, STEPS, friction_state, resolution, turned_back, within_count
from emb_daemon.offline import estimate
from emb_daemon.offline.run import run_paths
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import PULSE_MODULO, PULSES_PER_TURN

_PRESLIDING = 0.028


@given(st.floats(-1.0, 1.0), st.floats(-5.0, 5.0))
def test_friction_never_exceeds_coulombs(state, travel):
    after, mean, _ = friction_state(state, 1.0, travel, _PRESLIDING, 0.05, 0.004)
    assert -1.0 <= after <= 1.0
    low, high = sorted((state, after))
    assert low - 1e-12 <= mean <= high + 1e-12


@given(st.floats(-1.0, 1.0), st.floats(-0.05, 0.05), st.integers(2, 20))
def test_friction_depends_on_the_path_not_on_how_it_is_sampled(state, travel, parts):
    once, _, _ = friction_state(state, 0.5, travel, _PRESLIDING, 0.0, 0.004)
    stepwise = state
    for _ in range(parts):
        stepwise, _, _ = friction_state(stepwise, 0.5, travel / parts, _PRESLIDING, 0.0, 0.004)
    assert stepwise == pytest.approx(once, abs=1e-9)


def test_a_reversal_passes_continuously():
    """No jump of friction where the motion turns: over a small travel it changes by a small share."""
    angle = 0.3 * np.sin(np.linspace(0.0, 4.0 * np.pi, 20_000))
    state, states = 0.0, []
    for travel in np.diff(angle):
        state, _, _ = friction_state(state, 0.0, travel, _PRESLIDING, 0.0, 0.004)
        states.append(state)
    states = np.array(states)
    assert states.max() > 0.99 and states.min() < -0.99
    assert np.abs(np.diff(states)).max() <= 2.0 * np.abs(np.diff(angle)).max() / _PRESLIDING


def test_standstill_forgets_and_sliding_knows():
    _, _, variance = friction_state(0.0, 1.0, 10.0 * _PRESLIDING, _PRESLIDING, 0.05, 0.004)
    assert variance < 1e-6
    standing = []
    state = 1.0
    for _ in range(1500):
        state, mean, variance = friction_state(state, variance, 0.0, _PRESLIDING, 0.05, 0.004)
        standing.append(variance)
        assert mean == state == 1.0
    assert np.all(np.diff(standing) > 0.0)
    assert standing[-1] == pytest.approx(0.3, rel=0.01)
    assert friction_state(1.0, 0.9, 0.0, _PRESLIDING, 0.05, 60.0)[2] == 1.0, "more than nothing cannot be forgotten"


def _frictions(rows, p, late_s):
    """Mean friction state of each cycle, with an angle of which the estimator has found that it is ``late_s`` old."""
    s, means = new_state()[0], np.empty(len(rows))
    s["late"], s["gear_zero"], s["contact_angle"] = late_s, rows[0]["angle"], rows[0]["angle"] + p["clearance"]
    paths.settle_paths(s, p, rows[0], 1.0)
    for number, m in enumerate(rows):
        paths.stiffness_path(s, p, m, 1.0)
        paths.torque_path(s, p, m)
        means[number], s["angle"], s["speed"] = s["friction_mean"], m["angle"], m["speed"]
    return means


@pytest.mark.parametrize(("found", "late_s"), [(False, 0.004), (True, 0.004), (False, 0.048)])
def test_friction_turns_over_with_the_motor_and_not_with_an_angle_that_is_late(parameters, found, late_s):
    """To and fro within half a second, by an age that the calibration states or the estimator has found; at rest the noise of
    the speed turns nothing over, and what it had turned over before is not kept."""
    p, time = brake.ideal(parameters), 0.004 * np.arange(2000)
    stroke = np.clip(time, 0.0, 5.0) * 4.0 * np.pi
    rows, _ = brake.samples(p, 8.0 - 3.0 * np.cos(stroke))
    expected = run_paths(rows, p)["friction_mean"]
    rows["angle"] = np.interp(time - late_s, time, rows["angle"])
    rows["speed"] += np.random.default_rng(0).normal(0.0, 0.3, len(rows))
    unknown = _frictions(rows, p, 0.0) - expected
    p["effects"]["signal_delay"]["delay_s"] = 0.0 if found else late_s
    left = _frictions(rows, p, late_s if found else 0.0) - expected
    assert rmse(left) < 0.1 * rmse(unknown)
    assert np.abs(left[time > 5.0]).max() < 0.05


@pytest.mark.parametrize("delay_s", [0.006, -0.006])
def test_a_delay_is_undone_while_the_speed_changes(parameters, delay_s):
    """Five strokes a second: what the speed gains in 6 ms is a tenth of what the angle, or the force, is late by."""
    p, time = brake.ideal(parameters), 0.004 * np.arange(750)
    rows, _ = brake.samples(p, 0.5 * (p["clearance"] + 9.0) * (1.0 - np.cos(30.0 * np.maximum(time - 0.1, 0.0))))
    expected = run_paths(rows, p)["force"]
    if delay_s > 0.0:
        rows["angle"] = np.interp(time - delay_s, time, rows["angle"])
    else:
        expected = np.interp(time + delay_s, time, expected)
    unknown = rmse(run_paths(rows, p)["force"] - expected)
    p["effects"]["signal_delay"]["delay_s"] = delay_s
    assert rmse(run_paths(rows, p)["force"] - expected) < 0.02 * unknown


@pytest.mark.parametrize(("effect", "amplitude"), [("cogging_torque", "cosine_Nm"), ("gear_mesh_ripple", "cosine"), ("", "")])
def test_a_ripple_is_where_the_motor_is_and_not_where_a_late_angle_has_it(parameters, effect, amplitude):
    """At 40 rad/s an angle of 6 ms is two thirds of a turn of order 18 behind."""
    p, time = brake.ideal(parameters), 0.004 * np.arange(1500)
    p["load_friction"] = p["offset_friction"] = 0.0
    rows, _ = brake.samples(p, 12.0 - 4.0 * np.cos(10.0 * time))
    if effect:
        p["effects"][effect][amplitude], p["effects"][effect]["order_per_turn"] = 0.02, 18.0
    else:
        ripple = Term(
            name="term:x", port="torque", signal="motor_angle", shape="harmonic", coefficient=0.02, scale=1.0 / 18.0,
            low=-50.0, high=50.0,
        )  # fmt: skip
        fill_terms(p["effects"]["terms"], (ripple,))
    expected = run_paths(rows, p)["torque"] / run_paths(rows, p)["leverage"]
    rows["angle"] = np.interp(time - 0.006, time, rows["angle"])

    def apart():
        found = run_paths(rows, p)
        return rmse((found["torque"] / found["leverage"] - expected)[10:])

    unknown = apart()
    p["effects"]["signal_delay"]["delay_s"] = 0.006
    assert apart() < 0.1 * unknown


def test_the_torque_balance_claims_little_at_standstill(parameters):
    """Holding: friction may be anything inside its bounds, so the torque path's sigma grows to them and sigma with it."""
    p = parameters[0]
    up = brake.clamp(p, 18.0, 1.0)
    rows, force = brake.samples(p, np.concatenate([up, np.full(7500, up[-1])]))
    estimates = estimate(rows, p)
    sliding, held = estimates[245], estimates[-1]
    bound = (p["load_friction"] * force[-1] + p["offset_friction"]) / (p["gear_gain"] + p["load_friction"])
    assert held["torque_sigma"] > 0.9 * bound > 2.0 * sliding["torque_sigma"]
    assert held["sigma"] > sliding["sigma"]


@pytest.mark.parametrize("friction", [-1.0, 0.0, 1.0])
def test_friction_at_standstill_does_not_move_the_estimate_beyond_its_sigma(parameters, friction):
    """A hold during which vibration lets friction drift from full to anywhere inside its band."""
    p = parameters[0]
    p["effects"] = np.zeros((), p["effects"].dtype)
    up = brake.clamp(p, 18.0, 1.0)
    share = np.concatenate([np.ones(len(up)), np.linspace(1.0, friction, 10_000)])
    rows, force = brake.samples(p, np.concatenate([up, np.full(10_000, up[-1])]), friction=share)
    estimates = estimate(rows, p)
    error = np.abs(estimates["force"] - force)[len(up) :]
    assert np.all(error < 2.0 * estimates["sigma"][len(up) :])


def _creeping_hold(p, amplitude_um):
    """SAMPLE rows, force N: pads creep for half a minute beside a turning disc of that unevenness, and the motor follows. The
    disc lets it go back in each turn by less than its angle tells, which keeps friction at a fifth of what the angle says."""
    p["effects"] = np.zeros((), p["effects"].dtype)
    p["effects"]["disc_thickness_variation"]["order_1_cosine_um"] = amplitude_um
    p["thermal"]["softening"] = 0.0
    up, count = brake.clamp(p, 12.0, 1.0), 2.0 * paths.FLICKER_RAD
    angle = np.concatenate([up, up[-1] + count * np.floor(0.008 * 0.004 * np.arange(7500) / count)])
    share = np.concatenate([np.ones(len(up)), np.linspace(1.0, 0.2, 500), np.full(7000, 0.2)])
    turned = 37.0 * 0.004 * np.arange(len(angle))
    thickness = 1e-6 * amplitude_um * np.cos(turned)
    rows, force = brake.samples(p, angle + thickness / p["gear_gain"], friction=share)
    rows["angle"], rows["speed"] = angle, np.gradient(angle, 0.004)
    rows["wheel_speed"], rows["wheel_pulse"] = 37.0, np.floor(PULSES_PER_TURN * turned / (2.0 * np.pi)) % PULSE_MODULO
    return brake.noisy(rows, p), force


def test_a_motor_that_an_uneven_disc_turns_back_unseen_does_not_mislead(parameters):
    """By its angle it creeps forwards, and all of the friction opposes it; a fifth of it does."""
    rows, force = _creeping_hold(parameters[0], 15.0)
    estimates = estimate(rows, parameters[0])
    assert rmse((estimates["torque_force"] - force)[-2000:]) > 1000.0
    assert rmse((estimates["force"] - force)[-2000:]) < 100.0


def test_friction_is_as_unknown_as_an_uneven_disc_may_have_turned_it_back(parameters):
    """Beside an even disc the motor creeps forwards and nothing else; by more than a count its angle would have told, which
    leaves less than if nothing were known."""
    even, uneven = (run_paths(_creeping_hold(parameters[0], size)[0], parameters)["friction_variance"][-1] for size in (0, 15))
    assert 2.0 * even < uneven < 0.8 / 3.0


def test_a_gear_without_friction_has_none_to_turn_back(parameters):
    rows, _ = _creeping_hold(parameters[0], 0.0)
    parameters["offset_friction"] = parameters["load_friction"] = 0.0
    assert np.all(np.isfinite(run_paths(rows, parameters)["friction_variance"]))


def _shares(travels, dt=0.004):
    """`turned_back` after each of the ways, rad."""
    shares, direction = [0.0], 0.0
    for travel in travels:
        shares.append(turned_back(shares[-1], direction, travel, dt))
        direction = travel or direction
    return np.array(shares)


def test_an_angle_that_is_noise_is_told_by_its_turning_back():
    """That of a resolver, and of a noisy speed added up; not of a motor that swings ten times a second, or stands."""
    random, time = np.random.default_rng(1), 0.004 * np.arange(2000)
    counted, added_up = np.diff(random.normal(size=2000)), random.normal(size=2000)
    for noise, share in ((counted, 2.0 / 3.0), (added_up, 0.5)):
        shares = _shares(noise)[25:]
        assert np.mean(shares) == pytest.approx(share, abs=0.03) and np.mean(shares > NOISE_TURNS_BACK) > 0.99
    assert _shares(np.diff(np.sin(2.0 * np.pi * 10.0 * time))).max() < NOISE_TURNS_BACK
    assert _shares(np.zeros(100)).max() == 0.0
    one = _shares([1.0, 0.0, 0.0, -1.0, -1.0])
    assert one[3] == 0.0 and one[4] == pytest.approx(0.08) and one[5] < one[4]
    assert _shares([1.0, -1.0], dt=9.0)[2] == 1.0, "after a gap only the last sample counts"


@pytest.mark.parametrize("noisy", [True, False])
def test_friction_follows_of_a_noisy_angle_what_is_more_than_its_presliding(parameters, noisy):
    s, p = new_state()[0], parameters[0]
    s["turned_back"] = noisy
    way = 0.9 * p["presliding_angle"]
    slid = paths._slid(s, p, way, way, 0.0, 0.004)
    assert slid == pytest.approx(0.0 if noisy else way - paths.FLICKER_RAD)
    s["turned_back"] = noisy
    after = paths._slid(s, p, 3.0 * way, 2.0 * way, 0.0, 0.004)
    assert after == pytest.approx(3.0 * way - p["presliding_angle"] if noisy else 2.0 * way)
    # One that stands has not forgotten which way it came.
    paths._slid(s, p, 3.0 * way, 0.0, 0.0, 0.004)
    assert s["direction"] == 2.0 * way


def _counts(angle, speed, steps=None):
    """`resolution` after these angles, rad, and the speeds beside them, rad/s."""
    steps, lately = np.zeros((), STEPS)[()] if steps is None else steps, np.zeros((), LATELY)[()]
    for travel, now in zip(np.diff(angle, prepend=angle[0]), speed, strict=True):
        remember(lately, now, 0.004)
        count = resolution(steps, travel, beyond_speeds(lately, travel, 0.004))
    return count


@pytest.mark.parametrize("late", [0, 1, 8])
def test_counts_of_an_angle_show_in_its_small_steps_beside_the_speeds(late):
    """Not in those of a smooth motion, however late the angle is, nor of one that goes steadily; one wrong value is none."""
    way, random = 3.0 * np.sin(0.03 * np.arange(3000)), np.random.default_rng(1)
    speed = np.diff(way, prepend=0.0) / 0.004 + random.normal(0.0, 0.3, 3000)
    come = np.concatenate([np.zeros(late), way[: len(way) - late]])
    for count in (0.03, 0.1) if late < 8 else ():
        found = _counts(2e-4 * np.round(count * np.floor(come / count) / 2e-4), speed)
        assert 0.5 * count < found < 1.05 * count
    assert max(_counts(come, speed), _counts(come + random.normal(0.0, 2e-4, 3000), speed)) < paths.FLICKER_RAD
    spiked = come.copy()
    spiked[[2700, 2800]] += 1.0
    assert _counts(spiked, speed) < paths.COARSE_RAD
    assert _counts(0.02 * np.arange(3000), np.full(3000, 5.1)) < paths.FLICKER_RAD
    assert _counts(0.03 * np.floor(way[:60] / 0.03), speed[:60]) == 0.0


def test_a_motor_may_have_gone_back_within_a_count():
    assert within_count(1.0, 0.0, 0.03) == 1.0
    assert within_count(1.0, 0.03, 0.03) == pytest.approx(-1.0 + 2.0 * np.exp(-1.0))
    assert within_count(-0.5, 10.0, 0.03) == pytest.approx(1.0)


@pytest.mark.parametrize("count_rad", [0.012, 0.03, 0.06])
def test_friction_of_a_hold_is_unknown_beside_an_angle_in_coarse_counts(count_rad):
    """Else what it carries would be that of the last stroke, the torque mean another force, and stiffness be learned of it."""

    def quantize(samples):
        samples["angle"] = count_rad * np.floor(samples["angle"] / count_rad)

    coarse, force = city.changed(quantize, seconds=40.0)
    good, _ = city.changed(seconds=40.0)
    assert rmse(coarse["force"] - force) < rmse(good["force"] - force) + 0.3 * count_rad * 1800.0
    assert np.mean(np.abs(coarse["force"] - force) > 3.0 * np.hypot(coarse["sigma"], 25.0)) < 0.01


@pytest.mark.parametrize(("hz", "way_rad", "current_A"), [(15.0, 0.005, 0.1), (14.0, 0.007, 0.1), (5.0, 0.004, 0.5)])
def test_a_road_that_shakes_a_motor_which_holds_tells_nothing_of_friction(hz, way_rad, current_A):
    """Friction that turns over in such swings would forget what it carries, and the current mean another force: 426 N."""

    def shake(samples):
        held = samples[city.HOLDING :]
        turned = 2.0 * np.pi * hz * np.cumsum(held["dt"])
        held["angle"] += way_rad * np.sin(turned)
        held["speed"] += 2.0 * np.pi * hz * way_rad * np.cos(turned)
        held["current_q"] += current_A * np.sin(turned + 1.0)

    shaken, force = city.changed(shake)
    good, _ = city.changed()
    held = slice(city.HOLDING, None)
    error, usual = ((each["force"] - force)[held] for each in (shaken, good))
    assert rmse(error) < 1.5 * rmse(usual)
    assert abs(error).max() < 1.5 * abs(usual).max()
