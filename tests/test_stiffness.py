"""Dynamic stiffness: exact for the time that passed, causal, and the curve when things rest."""

import brake
import naive
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.models.stiffness import characteristic_curve, first_order_lag, mean_slope, travel_at
from emb_daemon.offline import estimate

_force = st.floats(-3e4, 3e4)
_dt = st.floats(1e-6, 2.0)


@given(_force, _force, _force, _dt, st.floats(1e-3, 100.0))
def test_two_steps_are_one_of_twice_the_time(state, before, after, dt, time_constant):
    middle = 0.5 * (before + after)
    twice = first_order_lag(first_order_lag(state, before, middle, dt, time_constant), middle, after, dt, time_constant)
    assert twice == pytest.approx(first_order_lag(state, before, after, 2.0 * dt, time_constant), abs=1e-6, rel=1e-9)


@given(_force, _dt, st.floats(0.0, 100.0))
def test_a_settled_lag_stays(force, dt, time_constant):
    assert first_order_lag(force, force, force, dt, time_constant) == pytest.approx(force, rel=1e-12, abs=1e-9)


def test_no_time_changes_nothing_and_no_time_constant_delays_nothing():
    assert first_order_lag(5.0, 1.0, 2.0, 0.0, 0.03) == 5.0
    assert first_order_lag(5.0, 1.0, 2.0, 0.004, 0.0) == 2.0


def _stiffness_force(p, angle, dt=0.004):
    rows, _ = brake.samples(p, angle, dt)
    return estimate(rows, p)["stiffness_force"]


@pytest.fixture
def plain(parameters):
    """Parameters of FL without effects, softening and torque: the stiffness path alone."""
    p = parameters[0]
    p["thermal"]["softening"] = p["thermal"]["softening_history"] = 0.0
    p["effects"] = np.zeros((), p["effects"].dtype)
    p["torque_relative_sigma"] = p["clearance_sigma"] = p["contact_walk"] = 1e-12
    return p


def test_steady_state_is_the_characteristic_curve(plain):
    for x in (1.0, 7.0, 20.0):
        angle = np.concatenate([brake.clamp(plain, x, 0.4), np.full(400, plain["clearance"] + x)])
        expected, _ = naive.characteristic_curve(x, plain["curve"])
        assert _stiffness_force(plain, angle)[-1] == pytest.approx(expected, rel=1e-6)


def test_force_does_not_depend_on_the_sample_time(plain):
    seconds = 1.2
    ends = [_stiffness_force(plain, brake.clamp(plain, 15.0, seconds, dt), dt)[-1] for dt in (0.001, 0.004, 0.02)]
    assert ends[0] > 8000.0
    assert ends[1] == pytest.approx(ends[0], rel=2e-4)
    assert ends[2] == pytest.approx(ends[0], rel=2e-3)


def test_no_force_in_the_clearance(plain):
    rows, _ = brake.samples(plain, np.linspace(0.0, 0.99 * plain["clearance"], 200))
    estimates = estimate(rows, plain)
    assert np.all(estimates["stiffness_force"] == 0.0)


@pytest.mark.parametrize(("x", "slope"), [(3.0, 800.0), (0.0, 112.5), (-0.25, 0.0)])
def test_the_slope_about_an_uncertain_contact_is_that_of_the_force_over_it(x, slope):
    """200 N/rad and 200 N/rad² over a quarter of a radian to each side; before contact there is none."""
    assert mean_slope(x, 0.25, np.array([200.0, 100.0, 0.0])) == pytest.approx(slope, rel=1e-12)


def test_estimates_never_see_the_future(parameters):
    p = parameters[0]
    angle = np.concatenate([brake.clamp(p, 15.0, 1.0), brake.clamp(p, 15.0, 1.0)[::-1]])
    rows, _ = brake.samples(p, angle)
    other = rows.copy()
    other["angle"][300:] += 1.0
    other["current_q"][300:] = -20.0
    other["inner_backplate"][300:] = 300.0
    a, b = estimate(rows, p), estimate(other, p)
    assert a[:300].tobytes() == b[:300].tobytes()
    assert not np.array_equal(a["force"][300:], b["force"][300:])


def test_travel_is_found_on_either_side_of_a_curves_turn():
    """Which doubled travels pass over: the curve turns over at 33.9 rad and is below zero at 64."""
    turning = np.array([207.0, 38.0, -0.75])
    travel = travel_at(20e3, turning)
    assert characteristic_curve(travel, turning)[0] == pytest.approx(20e3)
    top = travel_at(1e6, turning)
    assert characteristic_curve(top, turning)[1] == pytest.approx(0.0, abs=1e-6) and top > travel
    assert travel_at(1e6, np.array([1.0])) == np.inf
