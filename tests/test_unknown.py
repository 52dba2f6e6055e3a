"""What is not known of a brake, by hand: how fast it grows, and how far it can be at all."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator import unknown
from emb_daemon.estimator.unknown import add_rest, excess, set_priors, set_walks, softening_sigma, stay_possible, thickening
from emb_daemon.models.fusion import (
    CONTACT,
    COULOMB,
    CREEPS,
    FADE,
    GAIN,
    GROWTH,
    HOUSING,
    INERTIA,
    LATE,
    LOAD,
    OFFSET,
    SCALE,
    SLOW,
    STATES,
    VISCOUS,
)


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _covariance(seed, sigma=0.01):
    root = sigma * np.random.default_rng(seed).standard_normal((STATES, STATES)) / np.sqrt(STATES)
    return root @ root.T


def test_grease_thickens_e_fold_in_15_kelvin_of_cold_and_not_without_end():
    assert thickening(15.0) == thickening(90.0) == 1.0
    assert thickening(0.0) == pytest.approx(np.e) and thickening(-15.0) == pytest.approx(np.e**2)
    assert thickening(-200.0) == thickening(-65.0) == pytest.approx(np.exp(80.0 / 15.0))


def test_pads_that_are_unsurely_warm_are_unsurely_soft(p):
    p["thermal"]["softening"], p["thermal"]["softening_history"] = 4e-4, 1e-3
    assert softening_sigma(p, 200.0, 10.0, 30.0) == pytest.approx(0.004 + 0.03)
    p["thermal"]["softening_sigma"] = 5e-4
    assert softening_sigma(p, 200.0, 10.0, 30.0) == pytest.approx(np.hypot(0.004 + 0.03, 0.1))


def _walked(p, dt, power=0.0, softening=0.0, x=None, winding=0.0):
    walked = np.full(STATES, 7.0)
    set_walks(
        walked, p, np.zeros(STATES) if x is None else x, np.zeros((STATES, STATES)), winding, 0.0, softening, power, 1e-9, dt
    )
    return walked


def test_variances_grow_with_time_and_the_contacts_with_the_energy_of_friction(p):
    """However the time is cut; pads wear by a nanometre per root of a joule."""
    x = np.full(STATES, 0.1)
    whole = _walked(p, 2.0, 5000.0, 0.02, x, 0.5)
    for parts in (2, 500):
        assert parts * _walked(p, 2.0 / parts, 5000.0, 0.02, x, 0.5) == pytest.approx(whole)
    grown = _walked(p, 2.0, 5000.0) - _walked(p, 2.0)
    assert np.sqrt(grown[CONTACT]) * p["gear_gain"] == pytest.approx(1e-9 * np.sqrt(2.0 * 5000.0))
    assert np.flatnonzero(grown).tolist() == [CONTACT]
    p["contact_walk"] = 0.0
    assert _walked(p, 2.0)[CONTACT] == 0.0


def test_what_was_not_watched_for_less_than_an_hour_may_have_changed_as_in_one(p):
    grown = []
    for elapsed_s in (10.0, 3600.0, 7200.0):
        P = np.zeros((STATES, STATES))
        add_rest(P, p, elapsed_s)
        grown.append(np.diag(P))
    assert np.array_equal(grown[0], grown[1])
    assert grown[2][[GAIN, OFFSET, LOAD, COULOMB]] == pytest.approx(2.0 * grown[1][[GAIN, OFFSET, LOAD, COULOMB]])
    assert np.sqrt(grown[2][CONTACT]) * p["gear_gain"] == pytest.approx(5e-6), "pads settle once"
    assert [np.sqrt(each[LATE]) for each in grown] == pytest.approx([0.3, 0.3, 0.3]), "senders sample at any moment of a cycle"


def test_the_time_between_current_and_angle_is_no_less_known_than_at_power_on(p):
    """However long nothing shows it; two clocks have drifted by as much after some minutes."""
    P, walked = np.zeros((STATES, STATES)), np.zeros(STATES)
    for _ in range(int(300.0 / 0.1)):
        set_walks(walked, p, np.zeros(STATES), P, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1)
        P[LATE, LATE] += walked[LATE]
    assert 0.28 < np.sqrt(P[LATE, LATE]) < 0.3
    set_priors(P, p)
    assert np.sqrt(P[LATE, LATE]) == pytest.approx(0.3)


def test_that_a_brake_is_near_its_calibration_counts_as_an_observation_of_each_error(p):
    """Bayes' rule with what is known beforehand, one after the other."""
    rng = np.random.default_rng(3)
    x, P, creep = 0.01 * rng.standard_normal(STATES), _covariance(4), np.array([0.01, -0.02])
    contact, scale, growth, winding, housing = 0.4, 1.1, 2e-4, 0.5, 0.2
    expected_x, expected_P = x.copy(), P.copy()
    gain_reach = 0.05
    observed = [
        (CONTACT, contact, 100e-6 / p["gear_gain"]),
        (SCALE, None, 0.3),
        (GROWTH, growth, 2.0 * 0.26e-6 / p["gear_gain"]),
        *((state, creep[i], 0.1) for i, state in enumerate(CREEPS)),
        (GAIN, 0.0, None),
        (OFFSET, 0.0, unknown.torque_offset(p)),
        (LOAD, 0.0, p["load_friction"]),
        (COULOMB, 0.0, 2.0 * p["offset_friction"]),
    ]
    for state, beside, reach in observed:
        if reach is None:
            reach = gain_reach + abs(expected_x[FADE]) * winding + abs(expected_x[HOUSING]) * housing
        away = scale * (1.0 + expected_x[SCALE]) - 1.0 if beside is None else beside + expected_x[state]
        gain = expected_P[:, state] / (expected_P[state, state] + reach**2)
        expected_x = expected_x - gain * away
        expected_P = expected_P - np.outer(gain, expected_P[state])
    stay_possible(x, P, np.zeros(STATES), p, contact, scale, growth, creep, winding, housing)
    np.testing.assert_allclose(x, expected_x, rtol=1e-9)
    np.testing.assert_allclose(P, expected_P, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(
    ("state", "reach"),
    [
        (GAIN, lambda p: 0.05 + 0.1 * 0.5),
        (INERTIA, lambda p: 0.1),
        (SLOW, lambda p: 0.5),
        (LOAD, lambda p: np.hypot(p["torque_relative_sigma"] * p["gear_gain"], p["load_friction"])),
        (COULOMB, lambda p: 2.0 * p["offset_friction"]),
        (VISCOUS, lambda p: 2.0 * p["offset_friction"] / p["maximum_speed"]),
    ],
)
def test_what_motor_and_friction_cannot_be_widens_sigma_by_how_much_they_are_beyond_it(p, state, reach):
    """Up to three times what such brakes differ by nothing does; friction of a cold gear may be off by more."""
    x, most = np.zeros(STATES), float(reach(p))
    x[FADE] = 0.1
    for times, factor in ((2.9, 1.0), (-2.9, 1.0), (4.0, np.sqrt(8.0)), (-6.0, np.sqrt(28.0))):
        x[state] = times * most
        assert excess(x, p, 20.0, 0.5, 0.0) == pytest.approx(factor)
    cold = state in (LOAD, COULOMB, VISCOUS)
    assert (excess(x, p, -20.0, 0.5, 0.0) == 1.0) == cold
