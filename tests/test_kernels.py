"""Every kernel beside its plain twin. test_unjitted.py runs this file once more without compilation."""

import naive
import numpy as np
import pytest
from scipy.special import erfc

from emb_daemon.models import contact
from emb_daemon.models.fusion import (
    OF_THE_FORCE,
    STATES,
    force_variance,
    maximum_likelihood,
    predict_errors,
    update_errors,
    variance_along,
)
from emb_daemon.models.stiffness import characteristic_curve, first_order_lag
from emb_daemon.models.thermal import (
    CHAIN,
    LONGEST_S,
    NODES,
    UNALTERED,
    at_depth,
    friction_power,
    heat_step,
    mean_temperature,
    mesh,
    stiffness_factor,
)
from emb_daemon.models.torque import friction_state, torque_balance, unexplained_torque


@pytest.mark.parametrize("x", [-3.0, 0.0, 1e-9, 0.4, 17.0, 40.0])
@pytest.mark.parametrize("coefficients", [[300.0], [240.0, 28.0, 0.47], [224.0, 25.6, 0.4, -1e-3, 2e-5]])
def test_characteristic_curve(x, coefficients):
    assert characteristic_curve(x, np.array(coefficients)) == pytest.approx(
        naive.characteristic_curve(x, coefficients), rel=1e-13
    )


@pytest.mark.parametrize("time_constant", [1e-3, 0.0284, 5.0, 1e4])
@pytest.mark.parametrize("dt", [1e-6, 0.004, 0.02, 1.0])
def test_first_order_lag(dt, time_constant):
    arguments = (310.0, 250.0, 900.0, dt, time_constant)
    assert first_order_lag(*arguments) == pytest.approx(naive.first_order_lag(*arguments), rel=1e-10)


@pytest.mark.parametrize("state", [-1.0, -0.3, 0.0, 0.9, 1.0])
@pytest.mark.parametrize("travel", [1e-10, -2e-4, 0.028, -1.0])
def test_friction_state(state, travel):
    after, mean, _ = friction_state(state, 0.2, travel, 0.028, 0.05, 0.004)
    assert (after, mean) == pytest.approx(naive.friction_state(state, travel, 0.028), abs=1e-9)


def test_torque_path():
    """A motor that accelerates, slides and clamps: the balance gives back the force that made its torque."""
    gain, load, offset, inertia, force = 3.98e-5, 8.3e-6, 0.0336, 1.1e-4, 12_000.0
    for friction in (-1.0, 0.4, 1.0):
        torque = gain * force + inertia * 3.0 / 0.004 + friction * (load * force + offset)
        left = unexplained_torque(torque, inertia, 3.0, 0.004, offset, friction)
        assert torque_balance(left, gain + load * friction) == pytest.approx(force)


def _random_filter(rng):
    root = rng.normal(size=(STATES, STATES))
    return rng.normal(size=STATES), root @ root.T, rng.normal(size=STATES)


def test_filter_time_update():
    rng = np.random.default_rng(1)
    for _ in range(20):
        x, P, _ = _random_filter(rng)
        arguments = *rng.uniform(0.1, 1.0, 3), rng.uniform(0.0, 1.0, STATES)
        expected = naive.predict_errors(x, P, *arguments)
        predict_errors(x, P, *arguments)
        np.testing.assert_allclose(x, expected[0], rtol=1e-12)
        np.testing.assert_allclose(P, expected[1], rtol=1e-12)


def test_force_variance_is_that_of_the_states_the_force_rests_on():
    _, P, h = _random_filter(np.random.default_rng(3))
    of_the_torque = [i for i in range(STATES) if i not in OF_THE_FORCE]
    h[of_the_torque] = 0.0
    assert force_variance(P, h) == pytest.approx(h @ P @ h)
    h[of_the_torque] = 7.0
    assert force_variance(P, h) == pytest.approx(
        h[list(OF_THE_FORCE)] @ P[np.ix_(OF_THE_FORCE, OF_THE_FORCE)] @ h[list(OF_THE_FORCE)]
    )


def test_filter_measurement_update():
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, P, h = _random_filter(rng)
        innovation, variance = rng.normal(), rng.uniform(0.1, 2.0)
        expected = naive.update_errors(x, P, innovation, h, variance)
        gain = np.empty(STATES)
        along = variance_along(P, h, gain)
        assert along == pytest.approx(h @ P @ h)
        update_errors(x, P, gain, innovation, variance + along)
        np.testing.assert_allclose(x, expected[0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(P, expected[1], rtol=1e-8, atol=1e-10)
        assert variance + along == pytest.approx(expected[2])


def test_maximum_likelihood_weighs_by_inverse_variance():
    weights = 1.0 / np.array([300.0, 600.0]) ** 2
    force, sigma = maximum_likelihood(5000.0, 300.0, 6000.0, 600.0)
    assert force == pytest.approx(np.average([5000.0, 6000.0], weights=weights))
    assert sigma == pytest.approx(weights.sum() ** -0.5)


@pytest.mark.parametrize("dt", [0.004, 0.048, 0.25])
@pytest.mark.parametrize("braking", [False, True])
def test_heat_chain(thermal, braking, dt):
    rng = np.random.default_rng(3)
    pads, disc = rng.uniform(20.0, 400.0, (2, NODES)), 300.0
    arguments = (40.0, 60.0, 15.0, 8000.0 * braking, braking, 20.0, dt)
    expected_pads, expected_disc = naive.heat_step(thermal, pads, disc, *arguments)
    disc = heat_step(thermal, pads, disc, *arguments, np.empty((4, CHAIN)), LONGEST_S, UNALTERED)
    np.testing.assert_allclose(pads, expected_pads, rtol=1e-11)
    assert disc == pytest.approx(expected_disc, rel=1e-11)


def test_friction_power(thermal):
    rng = np.random.default_rng(4)
    thermal["friction_coefficient"] = rng.uniform(0.2, 0.6, thermal["friction_coefficient"].shape)
    for force, speed, surface in rng.uniform([-500.0, -5.0, -40.0], [20_000.0, 60.0, 700.0], (200, 3)):
        expected = naive.friction_power(thermal, force, speed, surface)
        assert friction_power(thermal, force, speed, surface) == pytest.approx(expected, rel=1e-12)


def test_profile_of_a_pad(thermal):
    """Means and depths of a linear profile are those of the line."""
    positions, thickness = thermal["node_position"], thermal["thickness"]
    profile = 500.0 - 400.0 * positions / thickness
    assert mean_temperature(profile, positions) == pytest.approx(300.0)
    for share in (0.0, 0.2, 0.77, 1.0):
        assert at_depth(profile, positions, share * thickness) == pytest.approx(500.0 - 400.0 * share)
    assert np.isnan(at_depth(profile, positions, 1.01 * thickness))
    steep = 400.0 * np.exp(-8.0 * positions / thickness)
    for share in (0.05, 0.31, 0.64, 0.98):
        assert at_depth(steep, positions, share * thickness) == pytest.approx(400.0 * np.exp(-8.0 * share), abs=2.0)


def test_stiffness_factor(thermal):
    thermal["softening"], thermal["softening_history"] = 4.5e-4, 1.3e-3
    assert stiffness_factor(thermal, 0.0, 0.0) == 1.0
    assert stiffness_factor(thermal, 100.0, 50.0) == pytest.approx(1.0 - 0.045 - 0.065)
    assert stiffness_factor(thermal, 1e6, 0.0) > 0.0


def test_two_torques_where_none_is_believed_say_that_the_contact_comes_earlier_and_begins_anew():
    """And two that are missing, that it comes later. A single one may be wrong."""
    c = np.zeros(1, contact.CONTACT)
    for torque, predicted, x, samples, expected in (
        (0.0, 0.0, -5.0, 100, contact.NOTHING),
        (1.0, 0.0, -1.0, 2, contact.TOO_LATE),
        (0.0, 1.0, 1.0, 2, contact.TOO_EARLY),
    ):
        found = [
            contact.watch_closing(c[0], torque, predicted, 1.0, 0.01, 8.0, x, 0.1, 0.0, 0.01, True) for _ in range(samples)
        ]
        assert found == [contact.NOTHING] * (samples - 1) + [expected]
        assert c["engaged"][0] == (expected == contact.TOO_LATE)
        assert (c["rise"][0], c["shortfall"][0], c["agreed"][0]) == (0.0, 0.0, 0)


def test_the_mesh_goes_from_the_friction_surface_to_the_backing_plate():
    """Each interval a tenth wider than the one before."""
    nodes = mesh(0.012)
    assert nodes[0] == 0.0 and nodes[-1] == pytest.approx(0.012) and len(nodes) == NODES
    assert np.diff(nodes)[1:] == pytest.approx(1.1 * np.diff(nodes)[:-1])


def test_noise_raises_an_alarm_of_the_contact_once_in_as_many_samples_as_promised():
    """Mean run length of the one-sided sum of white noise (Brook and Evans, Biometrika 59, 1972): e^17 samples, and not ten
    times as many."""
    limit, states = contact.threshold(0.0, 0.02, 0.004), 400
    width = limit / (states - 0.5)
    edges = width * (np.arange(states + 1) - 0.5)
    to = np.array(
        [[0.5 * erfc(-(edge - start + 0.45) / np.sqrt(2.0)) for edge in edges] for start in width * np.arange(states)]
    )
    to[:, 0] = 0.0
    run_length = np.linalg.solve(np.eye(states) - np.diff(to, axis=1), np.ones(states))[0]
    assert 17.0 < np.log(run_length) < 17.0 + np.log(10.0)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_sum_of_correlated_noise_wanders_as_much_further_as_the_threshold_is_higher(share):
    """Its variance is that of white noise times the sum of the correlations over all lags."""
    lags = np.abs(np.arange(-1000, 1001))
    further = share * np.exp(-lags * 0.004 / 0.02).sum() + 1.0 - share
    assert contact.threshold(share, 0.02, 0.004) == pytest.approx(further * contact.threshold(0.0, 0.02, 0.004))


def _closing(c, torque, predicted, samples, x=2.0, offset=0.0):
    """What `watch_closing` finds in the last of some samples; noise of 0.01 N m, contact known to 0.02 rad, threshold 8."""
    for _ in range(samples):
        found = contact.watch_closing(c[0], torque, predicted, 1.0, 0.01, 8.0, x, 0.02, offset, 0.001, True)
    return found


def test_a_contact_angle_is_confirmed_by_a_hundred_samples_of_the_torque_that_it_needs():
    """Not by a torque that noise would hide, and not where the sum is on its way to an alarm."""
    c = np.zeros(1, contact.CONTACT)
    _closing(c, 1.0, 1.0, 99)
    assert not c["confirmed"][0]
    _closing(c, 1.0, 1.0, 1)
    assert c["confirmed"][0]
    hidden = np.zeros(1, contact.CONTACT)
    _closing(hidden, 0.02, 0.02, 500)
    assert not hidden["confirmed"][0]
    doubted = np.zeros(1, contact.CONTACT)
    _closing(doubted, 1.0 - 0.07 - 0.001 - 0.0045 - 0.025, 1.0, 2)
    assert _closing(doubted, 1.0 - 0.07 - 0.001 - 0.0045, 1.0, 500) == contact.NOTHING
    assert doubted["shortfall"][0] == pytest.approx(5.0) and not doubted["confirmed"][0]


@pytest.mark.parametrize("level", [0.0, 0.5, -0.5])
@pytest.mark.parametrize(("first", "found"), [(0.0, contact.TOO_LATE), (0.004, contact.TOO_LATE), (0.04, contact.NOTHING)])
def test_torque_over_the_clearances_is_an_offset_if_it_was_there_from_a_strokes_first_sample_and_else_a_force(
    first, found, level
):
    """A force that grows after thirty samples without any, or with a little, is one; what was there at once is an offset. What
    the clearance had before is neither."""
    c = np.zeros(1, contact.CONTACT)
    _closing(c, level, 0.0, 200, x=-5.0, offset=level)
    contact.watch_closing(c[0], level, 0.0, -1.0, 0.01, 8.0, -5.0, 0.02, 0.0, 0.001, True)
    said = [_closing(c, level + first, 0.0, 1, x=-5.0) for _ in range(8)]
    grown = np.maximum(0.01 * np.arange(60) - 0.3, 0.0) * (first < 0.04)
    said += [_closing(c, level + first + more, 0.0, 1, x=-5.0) for more in grown]
    assert (contact.TOO_LATE in said) == (found == contact.TOO_LATE)
    assert said.index(contact.TOO_LATE) > 30 if found == contact.TOO_LATE else c["samples"][0] < 100.0


def test_another_contact_angle_is_watched_anew():
    c, fresh = np.zeros((2, 1), contact.CONTACT)
    _closing(c, 1.0, 0.9, 30)
    contact.start_anew(c[0])
    for name in ("rise", "shortfall", "excess", "watched", "agreed", "confirmed"):
        assert c[name][0] == fresh[name][0], name
    assert c["lost"][0]


def test_what_is_clearly_above_noise_is_five_sigma_of_the_mean():
    """Nothing is before the first sample."""
    c = np.zeros(1, contact.CONTACT)
    assert contact.clearly_above(c[0], 0.01) == np.inf
    for samples in (1, 9, 15, 40):
        c = np.zeros(1, contact.CONTACT)
        _closing(c, 0.0, 0.0, samples)
        assert contact.clearly_above(c[0], 0.01) == pytest.approx(0.05 / np.sqrt(min(samples, 15)))
