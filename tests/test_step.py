"""One step by itself: what it begins with, what it tells of an ideal clamp, and what it predicts when no sample comes."""

import brake
import numpy as np
import pytest

from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.common import common_sigma
from emb_daemon.estimator.records import ESTIMATE, SAMPLE, new_state
from emb_daemon.estimator.status import ZERO_WANDERS
from emb_daemon.estimator.step import predict, step
from emb_daemon.estimator.unknown import add_softening, set_priors
from emb_daemon.models.fusion import CONTACT, OF_THE_MODEL, SCALE, STATES, maximum_likelihood
from emb_daemon.models.gear import steepest, through_gear
from emb_daemon.models.stiffness import characteristic_curve
from emb_daemon.models.thermal import stiffness_factor
from emb_daemon.offline import estimate
from emb_daemon.wire import contract as r


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def row(angle=3.0, dt=0.0, speed=0.0, current=0.0, temperature=20.0):
    m = np.zeros(1, SAMPLE)[0]
    m["dt"], m["angle"], m["speed"], m["current_q"] = dt, angle, speed, current
    for name in ("inner_backplate", "outer_backplate", "caliper", "ambient"):
        m[name] = temperature
    for name in ("has_current", "has_thermocouple", "has_wheel_speed", "has_wheel_pulse", "has_status"):
        m[name] = True
    return m


def test_a_brake_that_is_switched_on_is_taken_for_released(p):
    """The contact lies a clearance from where the motor stands, as uncertain as that is calibrated."""
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    step(state, p, row(), out)
    assert state["started"] and out["mode"] == r.RUNNING and not out["engaged"]
    assert out["contact_angle"] == state["contact_anchor"] == pytest.approx(3.0 + p["clearance"])
    assert state["covariance"][CONTACT, CONTACT] == pytest.approx(p["clearance_sigma"] ** 2)
    assert out["contact_sigma"] > p["clearance_sigma"], "another contact is possible"
    assert (out["force"], out["stiffness_force"], out["stiffness_factor"]) == (0.0, 0.0, pytest.approx(1.0, abs=0.01))
    assert np.isnan(out["torque_force"]) and out["ml_force"] == 0.0
    assert out["facts"] & ZERO_WANDERS == 0 and common_sigma(state, p) == 0.0


def test_a_brake_that_is_held_as_known_has_no_other_stiffness(p):
    p["clearance_sigma"] = 0.0
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    step(state, p, row(), out)
    assert not np.diag(state["covariance"])[[*OF_THE_MODEL]].any()


@pytest.mark.parametrize("temperature", [-25.0, 20.0])
def test_what_is_not_known_of_cold_pads_softening_is_in_their_stiffness(p, temperature):
    state, out, expected = new_state()[0], np.zeros(1, ESTIMATE)[0], np.zeros((STATES, STATES))
    step(state, p, row(temperature=temperature), out)
    set_priors(expected, p)
    known = expected[SCALE, SCALE]
    add_softening(expected, p, temperature - p["thermal"]["reference"], state["temperature_sigma"])
    assert state["covariance"][SCALE, SCALE] == pytest.approx(expected[SCALE, SCALE], rel=1e-3)
    assert (expected[SCALE, SCALE] > 1.2 * known) == (temperature < 0.0)


@pytest.mark.parametrize("sigma_per_K", [0.0, 5e-4])
def test_hot_pads_whose_softening_no_log_has_shown_are_covered(shipped_setup, sigma_per_K):
    """They are 130 K warmer than those of the calibration and 7 % softer. Without it sigma is that of any brake that nobody
    has seen braking, and the force is farther off than that."""
    p = brake.ideal(shipped_setup.parameters)
    p["thermal"]["softening"] = p["thermal"]["softening_history"] = 0.0
    p["thermal"]["softening_sigma"] = sigma_per_K
    soft = p.copy()
    soft["curve"] *= 0.93
    rows, force = brake.samples(soft, brake.clamp(soft, 14.0, 1.0))
    for name in ("inner_backplate", "outer_backplate", "caliper"):
        rows[name] = p["thermal"]["reference"] + 130.0
    estimates = estimate(rows, p)
    first = (force > 1000.0) & (np.arange(len(rows)) < np.argmax(force))
    apart = np.abs(estimates["force"] - force)[first] / estimates["sigma"][first]
    assert (apart.max() < 1.0) == (sigma_per_K > 0.0)


@pytest.fixture(scope="module")
def clamp(shipped_setup):
    """Rows, force and estimates of an ideal brake that clamps within a second."""
    p = brake.ideal(shipped_setup.parameters)
    rows, force = brake.samples(p, brake.clamp(p, 14.0, 1.0))
    return p, rows, force, estimate(rows, p)


def test_both_paths_of_an_ideal_clamp_give_its_force(clamp):
    p, _, force, estimates = clamp
    loaded = force > 1000.0
    assert loaded.sum() > 50
    np.testing.assert_allclose(estimates["stiffness_force"][loaded], force[loaded], rtol=0.01, atol=10.0)
    np.testing.assert_allclose(estimates["torque_force"][loaded], force[loaded], rtol=0.06)
    assert np.all(np.abs(estimates["force"] - force)[loaded] < estimates["sigma"][loaded])
    assert np.all(estimates["sigma"][loaded] < 0.01 * p["maximum_force"]) and not estimates["reasons"][loaded].any()
    assert np.nanmin(estimates["torque_force"]) == 0.0, "no brake pulls"


def test_the_maximum_likelihood_is_of_the_two_paths_alone(clamp):
    _, _, _, estimates = clamp
    for e in estimates[-50:]:
        expected, _ = maximum_likelihood(e["stiffness_force"], e["stiffness_sigma"], e["torque_force"], e["torque_sigma"])
        assert e["ml_force"] == pytest.approx(expected)


def test_contact_is_told_where_it_is_and_when_it_is_made(clamp):
    p, rows, force, estimates = clamp
    np.testing.assert_allclose(estimates["contact_angle"], p["clearance"], atol=0.02)
    np.testing.assert_allclose(estimates["stiffness_factor"], 1.0, atol=0.01)
    assert not estimates["engaged"][rows["angle"] < p["clearance"] - 0.1].any() and estimates["engaged"][force > 1000.0].all()


def test_a_sample_later_than_a_cycle_is_no_contradiction(clamp):
    """Three samples lost on the way up: the force is right at once, and the torque of that gap tells no change of contact."""
    p, rows, force, _ = clamp
    lost = slice(180, 183)
    rows, force = rows.copy(), np.delete(force, lost)
    rows["dt"][lost.stop] += rows["dt"][lost].sum()
    estimates = estimate(np.delete(rows, lost), p)
    assert (
        np.all(np.abs(estimates["force"] - force)[150:] < 2.0 * estimates["sigma"][150:])
        and not estimates["reasons"][150:].any()
    )


def test_pads_begin_as_warm_as_their_plates_and_until_those_are_heard_as_in_the_calibration(p):
    state, out, plates = new_state()[0], np.zeros(1, ESTIMATE)[0], row()
    plates["has_thermocouple"] = False
    step(state, p, plates, out)
    assert not state["temperature_known"] and out["stiffness_factor"] == 1.0
    plates["has_thermocouple"], plates["inner_backplate"], plates["outer_backplate"] = True, 90.0, 30.0
    step(state, p, plates, out)
    assert state["disc"] == 60.0 and state["history"] == pytest.approx(60.0 - p["thermal"]["reference"])
    assert state["mean"] == pytest.approx([75.0, 45.0], abs=3.0)
    state["disc"], plates["dt"] = 300.0, 0.004
    step(state, p, plates, out)
    assert state["growth_start"] == 60.0, "where its growth counts from"


@pytest.mark.parametrize("late", [0, 2])
def test_an_angle_that_comes_late_is_known_to_be(p, late):
    """By the speed beside it, within two strokes."""
    stroke = 8.0 * (1.0 - np.cos(np.linspace(0.0, 4.0 * np.pi, 300)))
    rows, _ = brake.samples(p, np.concatenate([np.zeros(20), stroke]))
    rows["angle"][late:] = rows["angle"][: len(rows) - late].copy()
    state = new_state()
    estimate(rows, p, state)
    assert state["late"][0] == pytest.approx(0.004 * late, abs=0.0015)


def standing(p, speeds, turned_rad=0.0):
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    for number, speed in enumerate(speeds):
        step(state, p, row(3.0 + turned_rad * number, 0.004 * (number > 0), speed), out)
    return float(state["speed_sigma"])


def test_a_motor_that_stands_shows_the_noise_of_its_speed(p):
    """Over half a second, and never less than the calibration's; one that turns shows nothing."""
    noise = 10.0 * p["speed_sigma"]
    speeds = noise * np.where(np.arange(350) % 2, 1.0, -1.0)
    assert standing(p, speeds) == pytest.approx(noise, rel=0.1)
    assert standing(p, speeds[:40]) < 0.4 * noise
    assert standing(p, 0.1 * p["speed_sigma"] * np.sign(speeds)) == p["speed_sigma"]
    assert standing(p, speeds, turned_rad=0.004 * noise) == p["speed_sigma"]


def test_the_stiffness_that_is_told_is_of_softening_and_of_other_pads_together(p):
    """Pads that soften by a twentieth and are a fifth stiffer than the calibration's."""
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    step(state, p, row(temperature=120.0), out)
    state["scale"] = 1.2
    step(state, p, row(dt=0.004, temperature=120.0), out)
    softened = stiffness_factor(p["thermal"], *(120.0 - p["thermal"]["reference"],) * 2)
    assert softened < 0.95 and out["stiffness_factor"] == pytest.approx(1.2 * softened, rel=0.01)


@pytest.mark.parametrize("pause_s", [0.3, 1.0])
def test_a_sample_after_a_pause_tells_noise_for_all_of_it_and_not_for_more(p, pause_s):
    state, out, noise = new_state()[0], np.zeros(1, ESTIMATE)[0], 10.0 * p["speed_sigma"]
    for number in range(200):
        step(state, p, row(3.0, 0.004 * (number > 0), noise * (-1.0) ** number), out)
    shown = float(state["speed_square"])
    step(state, p, row(3.0, pause_s, noise), out)
    assert state["speed_square"] == pytest.approx(shown + min(pause_s / 0.5, 1.0) * (noise**2 - shown))


def test_a_motor_that_has_just_stopped_shows_none_yet(p):
    """Its angle may be late, and stand while the motor still turns."""
    assert standing(p, np.full(20, 20.0 * p["speed_sigma"])) == p["speed_sigma"]


@pytest.mark.parametrize(("age", "source"), [(0.004, r.PREDICTED), (0.1, r.PREDICTED), (0.104, r.INVALID)])
def test_a_prediction_covers_what_the_motor_can_do_meanwhile(p, age, source):
    """At its highest speed, further than any softer or stiffer pads; no further than full clamp."""
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    state["started"], state["fused"], state["fused_sigma"] = True, 4000.0, 50.0
    state["past_contact"], state["factor"], state["scale"], state["contact_angle"] = 8.0, 0.9, 1.1, 9.0
    predict(state, p, age, out)
    reached, start = (characteristic_curve(x, p["curve"])[0] for x in (8.0 + p["maximum_speed"] * age, 8.0))
    assert (out["source"], out["mode"], out["reasons"], out["force"]) == (source, r.RUNNING, 0, 4000.0)
    assert out["sigma"] == pytest.approx(np.hypot(50.0, min(0.99 * (reached - start), p["maximum_force"])))
    assert out["stiffness_factor"] == pytest.approx(0.99) and out["contact_angle"] == 9.0
    assert np.isnan([out[name] for name in ("stiffness_force", "torque_force", "ml_force", "innovation")]).all()


def test_before_the_first_sample_nothing_is_predicted(p):
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    predict(state, p, 0.0, out)
    assert (out["mode"], out["source"], out["stiffness_factor"]) == (r.INIT, r.INVALID, 1.0)


def test_a_cams_contact_is_told_as_the_resolver_reads_it(shipped_setup):
    """The estimator thinks in the angle of a constant gear."""
    from test_gear import ramp

    p = to_parameters(ramp(shipped_setup.calibrations["FL"]))
    state, out = new_state()[0], np.zeros(1, ESTIMATE)[0]
    state["started"], state["gear_zero"], state["contact_angle"], state["covariance"][CONTACT, CONTACT] = True, 2.0, 9.0, 0.01
    predict(state, p, 0.004, out)
    turned, slope = through_gear(p["gear"], out["contact_angle"] - 2.0)
    assert turned == pytest.approx(7.0) and out["contact_sigma"] == pytest.approx(0.1 / slope) and abs(slope - 1.0) > 0.05
    reached, start = (
        characteristic_curve(x, p["curve"])[0] for x in (p["maximum_speed"] * steepest(p["gear"])[1] * 0.004, 0.0)
    )
    state["factor"] = state["scale"] = 1.0
    predict(state, p, 0.004, out)
    assert out["sigma"] == pytest.approx(reached - start)


@pytest.mark.parametrize(("names", "source"), [(("angle", "speed"), r.TORQUE_ONLY), (("current_q",), r.STIFFNESS_ONLY)])
def test_a_sensor_that_repeats_while_the_motor_must_turn_is_not_used(p, names, source):
    up = brake.clamp(p, 14.0, 0.6)
    rows, _ = brake.samples(p, np.concatenate([up, up[::-1]]))
    rows = brake.noisy(rows, p)
    frozen = 130
    for name in names:
        rows[name][frozen:] = rows[name][frozen]
    estimates = estimate(rows, p)
    stuck = np.flatnonzero(estimates["reasons"] & r.STUCK)
    assert frozen < stuck[0] < frozen + 60 and np.all(estimates["source"][stuck[0] : stuck[0] + 40] == source)


def test_an_angle_that_jumps_moves_the_contact_with_it(p):
    """What no motor can do in a cycle the resolver's zero has done: the force stays, and no torque is made of it."""
    rows, force = brake.samples(p, np.concatenate([brake.clamp(p, 12.0, 0.6), np.full(60, p["clearance"] + 12.0)]))
    rows["angle"][180:] += 30.0
    estimates = estimate(rows, p)
    assert estimates["reasons"][180] & r.OUT_OF_RANGE and not np.any(estimates["reasons"][190:] & r.OUT_OF_RANGE)
    assert np.isnan(estimates["torque_force"][180]) and estimates["contact_angle"][-1] == pytest.approx(
        p["clearance"] + 30, abs=0.5
    )
    assert np.all(np.abs(estimates["force"] - force)[180:] < 3.0 * estimates["sigma"][180:])


def test_a_motor_that_needs_torque_while_it_stands_may_hold_a_clamped_brake(p):
    """The contact is then unknown, and the torque alone says what the force is."""
    rows = np.array([row(3.0, 0.004 * (number > 0), 0.0, 6.0) for number in range(60)])
    estimates = estimate(rows, p)
    assert np.all(estimates["source"][30:] == r.TORQUE_ONLY) and np.all(estimates["reasons"][30:] & r.CONTACT_UNCERTAIN)
    assert np.all(estimates["sigma"][30:] > 1000.0)


@pytest.mark.parametrize("hums", [False, True])
def test_a_current_that_becomes_noisy_costs_the_force_nothing(parameters, hums):
    """Its noise is what it is while the motor stands, not what it once was: taken for torque, it moved contact and stiffness
    until the force was kilonewtons off beside a perfect angle."""
    p = brake.ideal(parameters)
    rows, force = brake.samples(p, brake.stops(p, 8))
    rows, begun = brake.noisy(rows, p), len(rows) // 4
    quiet, time_s = estimate(rows, p), 0.004 * np.arange(len(rows))
    noise = 8.0 * np.sin(2.0 * np.pi * 49.3 * time_s) if hums else 5.0 * np.random.default_rng(3).standard_normal(len(rows))
    rows["current_q"][begun:] += noise[begun:]
    loud = estimate(rows, p)
    last = slice(len(rows) // 2, None)
    before, after = (np.sqrt(np.mean((found["force"] - force)[last] ** 2)) for found in (quiet, loud))
    assert after < 1.5 * before
    assert np.mean(np.abs(loud["force"] - force)[begun:] > 3.0 * np.hypot(loud["sigma"], 25.0)[begun:]) < 0.01


def test_a_step_of_the_current_of_a_motor_that_stands_is_no_noise(parameters):
    p, state = brake.ideal(parameters), new_state()
    rows, _ = brake.samples(p, np.zeros(1000))
    rows = brake.noisy(rows, p)
    rows["current_q"][500:] += 20.0
    estimate(rows, p, state)
    assert state[0]["current_sigma"] < 1.3 * p["current_sigma"]


def _slipped(p, before, angle):
    """ESTIMATE rows and true force of a motor that goes through the ``angle`` (rad) while the rotor of its resolver stands
    where it was after the angles ``before``; what it shows is noise."""
    rows, force = brake.samples(p, np.concatenate([before, angle]))
    rows, rng, begun = brake.noisy(rows, p), np.random.default_rng(3), len(before)
    rows["angle"][begun:] = rows["angle"][begun] + 1e-3 * rng.standard_normal(len(angle))
    rows["speed"][begun:] = 0.35 * rng.standard_normal(len(angle))
    return estimate(rows, p)[begun:], force[begun:]


def test_a_slow_stroke_beside_a_frozen_angle_is_said_before_it_is_a_kilonewton(parameters):
    """Single torques are too noisy to tell of so little beyond friction."""
    p = brake.ideal(parameters)
    before = np.concatenate([brake.stops(p, 3), np.zeros(250), brake.clamp(p, 2.0, 0.3)])
    estimates, force = _slipped(p, before, before[-1] + np.linspace(0.0, 6.0, 1500))
    off = np.abs(estimates["force"] - force) > 1000.0
    assert np.mean(off) > 0.3 and not np.any(off & (estimates["mode"] == r.RUNNING))


def test_a_current_that_follows_what_is_asked_for_beside_a_frozen_angle_is_no_noise(parameters):
    """As noise it would excuse the torque that tells of the angle."""
    p, state = brake.ideal(parameters), new_state()
    rows, _ = brake.samples(p, np.zeros(2000))
    rows = brake.noisy(rows, p)
    rows["current_q"] += 8.0 * np.sin(2.0 * np.pi * 5.0 * 0.004 * np.arange(len(rows)))
    estimate(rows, p, state)
    assert state[0]["turned_square"] < 1.5 * p["current_sigma"] ** 2 < state[0]["current_square"]


def test_a_force_that_the_torque_asks_for_beside_an_angle_that_is_frozen_open_is_covered(parameters):
    """Either there is none, and the current is wrong, or the resolver has slipped while the brake was open."""
    p = brake.ideal(parameters)
    before = np.concatenate([brake.stops(p, 3), np.zeros(250)])
    clamped = np.concatenate([np.zeros(100), brake.clamp(p, 9.0, 0.5), np.full(500, p["clearance"] + 9.0)])
    estimates, force = _slipped(p, before, clamped)
    beyond = np.abs(estimates["force"] - force) > 3.0 * np.hypot(estimates["sigma"], 25.0)
    assert force.max() > 4000.0 and beyond.sum() < 40


def test_a_sigma_within_whose_threefold_a_kilonewton_lies_is_said_of_a_large_brake_too(parameters):
    p = brake.ideal(parameters)
    p["maximum_force"], p["stiffness_relative_sigma"] = 60e3, 0.05
    rows, _ = brake.samples(p, brake.clamp(p, 15.0, 0.5))
    estimates = estimate(brake.noisy(rows, p), p)
    unsure = estimates["sigma"] > 300.0
    assert np.any(unsure & (estimates["sigma"] < 0.01 * p["maximum_force"]))
    assert np.all(estimates["reasons"][unsure] & r.CONTACT_UNCERTAIN)
