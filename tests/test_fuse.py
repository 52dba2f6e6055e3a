"""Parts of the fusion by hand: what a torque is made of, and how far it and the stiffness path may be off."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator import fuse, resolver
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.wire.contract import CYCLE_S


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


@pytest.fixture
def s():
    """STATE of a brake that closes at 8 kN through a gear that is steeper there."""
    state = new_state()[0]
    state["force"], state["slope"], state["gear_slope"], state["gear_friction"] = 8000.0, 900.0, 1.3, 1.0
    state["friction_mean"], state["speed"], state["dt_before"], state["spring_force"] = 1.0, 40.0, CYCLE_S, 500.0
    return state


@pytest.fixture
def m():
    sample = np.zeros(1, SAMPLE)[0]
    sample["dt"], sample["speed"], sample["has_current"] = CYCLE_S, 40.0, True
    return sample


def test_a_motor_that_turns_steadily_needs_what_force_and_friction_take(p, s, m):
    """All friction belongs to the rise at low speed as the motor comes to rest, and e-fold less every 5 rad/s."""
    leverage = 1.3 * (p["gear_gain"] + p["load_friction"])
    friction = p["offset_friction"] + p["load_friction"] * 8500.0 * 1.3
    for speed in (0.0, 10.0, -10.0):
        m["speed"] = s["speed"] = speed
        slow, accelerating, needed = fuse.needed_torque(s, p, m, 8000.0, leverage)
        assert slow == pytest.approx(friction * np.exp(-abs(speed) / 5.0)) and accelerating == 0.0
        assert needed == pytest.approx(leverage * 8500.0 + p["offset_friction"])


def test_a_motor_that_gains_speed_needs_as_much_more_as_its_inertia_takes(p, s, m):
    """Where the angles show it clearly, and not where a count may have made it."""
    for acceleration, shown in ((2000.0, True), (-2000.0, True), (20.0, False)):
        s["angle_before"], s["angle"], m["angle"] = 0.0, 1.0, 2.0 + acceleration * CYCLE_S**2
        _, accelerating, needed = fuse.needed_torque(s, p, m, 0.0, 4e-5)
        assert accelerating == pytest.approx(p["inertia"] * acceleration * shown)
        assert needed - accelerating == pytest.approx(4e-5 * 500.0 + p["offset_friction"])


def test_the_noise_of_a_torque_is_that_of_both_speeds_and_of_what_is_apart_in_time(p, s, m):
    """Current and angle by a third of a cycle, and by the age of the angle; the inverse of a filter adds (1 + n)² + n² - 1 of
    the current's variance."""
    s["speed_sigma"], s["had_current"] = 0.5, False
    of_speed = 2.0 * (p["inertia"] * 0.5 / CYCLE_S) ** 2
    assert fuse._moving_variance(s, p, m) == pytest.approx(of_speed)
    s["had_current"], s["current_before"], m["current_q"], s["late"] = True, 4.0, 9.0, 0.006
    late = ((0.3 + 1.5) * p["torque_constant"] * 5.0) ** 2
    assert fuse._moving_variance(s, p, m) == pytest.approx(of_speed + late)
    s["alignment"]["lag"] = 3.0
    added = (4.0**2 + 3.0**2 - 1.0) * (p["torque_constant"] * p["current_sigma"]) ** 2
    assert fuse._moving_variance(s, p, m) == pytest.approx(of_speed + late + added)
    m["dt"] = 0.1
    assert fuse._moving_variance(s, p, m) > 1e3 * of_speed, "a mean over a gap says nothing of its end"


def test_an_angle_that_is_late_leaves_open_what_the_motor_gained_meanwhile(p, s, m):
    """Half of the acceleration times the age squared, by the slope."""
    prompt = fuse._spread(s, p, m)
    s["late"], m["speed"] = 0.006, 60.0
    open_N = 0.5 * 0.006**2 * (20.0 / CYCLE_S) * 900.0 * 1.3
    assert fuse._spread(s, p, m) ** 2 - prompt**2 == pytest.approx(open_N**2)
    p["stiffness_relative_sigma"] = p["thermal"]["softening"] = s["late"] = 0.0
    assert fuse._spread(s, p, m) == pytest.approx(p["stiffness_sigma"])


def test_what_holds_a_standing_motor_is_as_unsure_as_its_friction(p, s, m):
    """And an uneven disc changes its load only while the wheel turns, or may."""
    load = 8500.0 * 1.3
    assert fuse._standing_sigmas(s, p, m)[0] == 0.0
    for state, variance, share in ((fuse.COULOMB, 1e-6, 1.0), (fuse.LOAD, 1e-12, load)):
        s["covariance"] = 0.0
        s["covariance"][state, state] = variance
        assert fuse._standing_sigmas(s, p, m)[0] == pytest.approx(np.sqrt(variance) * share)
    for has_speed, speed, swings in ((False, 0.0, True), (True, 0.0, False), (True, 2.0 * TURNING_RAD_PER_S, True)):
        m["has_wheel_speed"], m["wheel_speed"] = has_speed, speed
        assert (fuse._standing_sigmas(s, p, m)[1] > 0.0) == swings


@pytest.mark.parametrize(
    ("name", "value", "rest"),
    [("park_brake", 0.0, True), ("park_brake", 1.0, False), ("brake_request", 1.0, False), ("has_status", False, False)],
)
def test_a_motor_is_at_rest_where_nobody_brakes_and_the_pads_are_apart(s, m, name, value, rest):
    m["has_status"] = True
    m[name] = value
    for past_contact in (-1.0, 0.5):
        s["past_contact"] = past_contact
        assert resolver.at_rest(s, m) == (rest and past_contact < 0.0)
