"""The fit of a training by hand: curve and friction out of pairs of passes, its cost, its minimum, and what it leaves open."""

from types import SimpleNamespace

import brake
import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.signal import lfilter

from emb_daemon.adapt import fit
from emb_daemon.adapt.fit import unexplained_step
from emb_daemon.adapt.pairs import curve_from_pairs, friction_from_pairs, pairs_of_passes
from emb_daemon.adapt.records import TRAINING
from emb_daemon.estimator.records import new_state
from emb_daemon.models.fusion import SLOW, VISCOUS
from emb_daemon.models.stiffness import characteristic_curve

_CURVE = np.array([240.0, 28.0, 0.47])


def _pairs(count=60, contact=7.5):
    """Pairs of a brake of `_CURVE`, whose friction torque is 0.04 N m and 9e-6 m/rad of the force."""
    angle = np.linspace(4.0, 30.0, count)
    force = np.array([characteristic_curve(x - contact, _CURVE)[0] for x in angle])
    return np.column_stack([angle, force, 0.04 + 9e-6 * force, np.full(count, 8.0), force])


def test_contact_and_curve_are_those_of_the_pairs_whatever_some_of_them_say():
    """Contact to a sixtieth of where it is sought, forces to a hundredth of the largest; two pairs are off by a quarter."""
    pairs = _pairs()
    for wrong in (0.0, 5000.0):
        pairs[[20, 41], 1] += wrong
        contact, curve = curve_from_pairs(pairs, 3)
        found = np.array([characteristic_curve(x - contact, curve)[0] for x in pairs[:, 0]])
        assert contact == pytest.approx(7.5, abs=0.4)
        assert np.abs(found - pairs[:, 4]).max() < 0.01 * pairs[-1, 4]


@pytest.mark.parametrize(("count", "found"), [(7, False), (8, True)])
def test_a_curve_needs_two_pairs_for_each_coefficient_and_two_more(count, found):
    assert np.isfinite(curve_from_pairs(_pairs(count), 3)[0]) == found


def test_friction_is_the_line_through_the_pairs_by_their_weights():
    pairs = _pairs()
    assert friction_from_pairs(pairs) == pytest.approx((0.04, 9e-6))
    pairs[7, 2:4] = 3.0, 0.0
    assert friction_from_pairs(pairs) == pytest.approx((0.04, 9e-6)), "a pair without weight says nothing"
    pairs[:, 1] = 5000.0
    assert np.isnan(friction_from_pairs(pairs)).all()


def test_a_pass_to_and_fro_gives_force_and_friction_without_a_model_of_friction(parameters):
    """To two hundredths of the largest force; of a motor that has lost a twentieth."""
    p = brake.ideal(parameters)
    up = p["clearance"] + np.linspace(0.0, 14.0, 500)
    rows, force = brake.samples(p, np.concatenate([up, up[::-1]]))
    training = np.zeros(len(rows), TRAINING)
    for name in set(TRAINING.names) & set(rows.dtype.names):
        training[name] = rows[name]
    training["factor"], training["faded"] = 1.0, -0.05
    training["current_q"] /= 0.95
    state = new_state()[0]
    state["contact_angle"] = p["clearance"]
    doubted = p.copy()
    doubted["load_friction"], doubted["offset_friction"] = 0.3 * p["load_friction"], 2.0 * p["offset_friction"]
    pairs = pairs_of_passes(training, doubted, state)
    expected = np.interp(pairs[:, 0], up, force[: len(up)])
    friction = p["offset_friction"] + p["load_friction"] * expected
    assert len(pairs) > 80 and np.all(np.diff(pairs[:, 0]) > 0.0)
    assert np.abs(pairs[:, 1] - expected).max() < 0.02 * force.max()
    assert pairs[5:-5, 2] == pytest.approx(friction[5:-5], rel=0.1)


def test_the_cost_is_hubers_and_its_normal_equations_are_its_slope():
    """Squares within 2.5 standard deviations, straight beyond, and what is not known has none."""
    rng = np.random.default_rng(3)
    jacobian, x = 2.0 * rng.standard_normal((4, 40)), 0.3 * rng.standard_normal(4)
    prior = fit._Prior(
        np.array([0.0, 0.3, -0.1, 0.0]), np.array([[0, 0, 0, 0], [0, 2, 0.4, 0], [0, 0.4, 0.5, 0], [0, 0, 0, 1.0]])
    )
    nothing = fit._Prior(np.zeros(4), np.zeros((4, 4)))
    blocks = rng.standard_normal(40) * np.where(np.arange(40) % 5, 1.0, 6.0)
    blocks[7] = np.nan

    def cost(at):
        return fit._cost(blocks + at @ jacobian, at, prior)

    assert fit._cost(np.array([2.5, -1.0, np.nan]), np.zeros(4), nothing) == pytest.approx(7.25)
    assert fit._cost(np.array([4.5]), np.zeros(4), nothing) == pytest.approx(2.5 * (9.0 - 2.5))
    _, gradient = fit._normal_equations(blocks + x @ jacobian, jacobian)
    assert 2.0 * (gradient + prior.gradient(x)) == pytest.approx(approx_fprime(x, cost, 1e-7), rel=1e-4, abs=1e-3)
    normal, _ = fit._normal_equations(np.full(40, 0.5), jacobian)
    assert normal == pytest.approx(jacobian @ jacobian.T)


def test_a_fit_ends_at_the_least_cost_and_holds_what_is_not_free():
    """Of a straight problem with a prior: that is solved by one system of equations."""
    rng = np.random.default_rng(4)
    size = fit._CURVE + 1
    matrix, target = rng.standard_normal((200, size)), 0.1 * rng.standard_normal(200)
    prior = fit._Prior(0.2 * rng.standard_normal(size), np.zeros((size, size)))
    prior.information[np.ix_([1, 2], [1, 2])] = [[5.0, 3.0], [3.0, 20.0]]
    training = SimpleNamespace(simulate=lambda x: (matrix @ x - target, None, None))
    free, held, begun = np.array([0, 1, 3]), np.array([2, *range(4, size)]), 0.3 * rng.standard_normal(size)
    begun[fit._CURVE] = 0.1
    found = fit._improve(training, begun, np.full(size, 1e-5), prior, free)
    part = matrix[:, free]
    own, others = prior.information[np.ix_(free, free)], prior.information[np.ix_(free, held)]
    known = own @ prior.expected[free] - others @ (begun - prior.expected)[held]
    expected = np.linalg.solve(part.T @ part + own, part.T @ (target - matrix[:, held] @ begun[held]) + known)
    assert found.x[free] == pytest.approx(expected, abs=1e-6) and np.array_equal(found.x[held], begun[held])
    assert 0 < found.iterations < 20 and found.cost == pytest.approx(fit._cost(matrix @ found.x - target, found.x, prior))
    assert not found.covariance[held].any() and not found.covariance[:, held].any()


def test_correlated_residuals_leave_as_much_more_open_as_their_sum_wanders_further():
    """(1 + rho) / (1 - rho) of white noise's variance."""
    noise = np.random.default_rng(5).standard_normal(100_000)
    assert fit._inflation(noise) == pytest.approx(1.0, abs=0.1)
    assert fit._inflation(lfilter([1.0], [1.0, -0.5], noise)) == pytest.approx(3.0, rel=0.05)


def test_the_sigma_of_a_curve_is_that_of_its_forces_over_the_travel():
    """A constant part and a share of the force, together as large as contact and coefficients leave open on average."""
    rng, scale, top = np.random.default_rng(6), np.array([300.0, 40.0, 1.0]), 20.0
    size = fit._CURVE + len(scale)
    root = 0.01 * rng.standard_normal((size, size))
    covariance, travel = root @ root.T, top * np.arange(1, fit.TRAVELS + 1) / fit.TRAVELS

    def force(values):
        at = travel - values[fit._CONTACT]
        return (at[:, None] ** np.arange(1, 4)) @ (_CURVE + scale * values[fit._CURVE :])

    slopes = np.array([(force(1e-6 * one) - force(-1e-6 * one)) / 2e-6 for one in np.eye(size)]).T
    variance, square = np.einsum("ti,ij,tj->t", slopes, covariance, slopes), force(np.zeros(size)) ** 2
    constant, share, largest = fit._force_sigma(_CURVE, scale, covariance, top)
    assert largest == pytest.approx(np.sqrt(variance.max()), rel=1e-4)
    assert constant > 0.0 and np.mean(constant**2 + share**2 * square) >= 0.99 * variance.mean()


def test_what_driving_learned_of_friction_is_no_part_of_what_a_training_leaves_over(parameters):
    """Speed torque, and a rise of friction at low speed."""
    p, left = brake.ideal(parameters), {}
    row = np.zeros(1, TRAINING)[0]
    row["dt"], row["angle"], row["speed"], row["has_current"], row["factor"], row["current_q"] = (
        0.004,
        0.04,
        10.0,
        True,
        1.0,
        2.0,
    )
    for state, value in ((SLOW, 0.0), (SLOW, 0.2), (VISCOUS, 1e-3)):
        s = new_state()[0]
        s["speed"], s["past_contact"], s["contact_angle"], s["gear_slope"], s["friction_state"] = 10.0, -5.0, 5.0, 1.0, 1.0
        s["error"][state] = value
        left[state, value] = unexplained_step(s, p, row)
    assert left[SLOW, 0.0] - left[VISCOUS, 1e-3] == pytest.approx(1e-3 * 10.0)
    assert left[SLOW, 0.0] - left[SLOW, 0.2] == pytest.approx(0.2 * p["offset_friction"] * np.exp(-2.0), rel=1e-3)
