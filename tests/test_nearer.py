"""A contact that is much nearer than believed: told from an offset of the current, in a brake whose pads still open and in one
whose pads drag."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator.hypotheses import TORQUE_JUMP, nearer_proven, open_all, settle
from emb_daemon.estimator.nearer import (
    NEARER_ODDS,
    WAYS,
    best_nearer,
    follow_nearer,
    forget_nearer,
    nearer_force,
    nearer_odds,
    offset_odds,
    place_nearer,
    rest_nearer,
    set_ways,
    way,
)
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.unknown import contact_jump, set_priors, torque_offset
from emb_daemon.models.fusion import CONTACT, OFFSET, STATES, update_errors, variance_along
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import ADAPTING, RUNNING

#: Samples of one stop of `brake.stops`, and stops before the change.
_STOP, _BEFORE = 750, 4


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


@pytest.fixture
def opened(p):
    state = new_state()
    s = state[0]
    set_priors(s["covariance"], p)
    s["clearance"] = p["clearance"]
    s["scale"] = 1.0
    open_all(s, p)
    return s


def _silent_s(estimates, force, beyond_N):
    """Longest time, s, for which the force was off by more without a word."""
    silent = np.isin(estimates["mode"], (RUNNING, ADAPTING)) & (np.abs(estimates["force"] - force) > beyond_N)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], silent, [0]])))
    return 0.004 * max(edges[1::2] - edges[::2], default=0)


def _driven(p, share, seed, pressed_A=0.0):
    """Estimates, true force, what is believed at the end, and where contact then is, of stops before which all of a sudden
    ``share`` of the clearance is gone; from then on an open motor is pressed against a stop with ``pressed_A`` more."""
    path = brake.stops(p, 12, seed)
    rows, force = brake.samples(p, path)
    true, begin = p.copy(), _BEFORE * _STOP
    true["clearance"] *= 1.0 - share
    later, later_force = brake.samples(true, path)
    rows[begin:], force[begin:] = later[begin:], later_force[begin:]
    within = np.arange(len(rows)) % _STOP
    rows["current_q"][(np.arange(len(rows)) >= begin) & (within >= 50) & (within < 340)] += pressed_A
    state = new_state()
    return estimate(brake.noisy(rows, p, seed), p, state), force, state[0], true["clearance"]


@pytest.mark.parametrize("seed", (1, 2))
@pytest.mark.parametrize("share", (0.4, 0.7, 0.95))
def test_a_contact_that_is_much_nearer_is_no_offset_of_the_current(p, share, seed):
    estimates, force, s, contact = _driven(p, share, seed)
    assert _silent_s(estimates, force, 1000.0) <= 0.1
    assert abs(s["error"][OFFSET]) < 0.3 * torque_offset(p)
    assert s["contact_angle"] == pytest.approx(contact, abs=0.4)


@pytest.mark.parametrize("seed", (1, 2))
def test_pads_that_drag_are_no_offset_either(p, seed):
    """An open brake then keeps some force, of which a current's offset is told apart the less the longer it does."""
    estimates, force, _, _ = _driven(p, 1.15, seed)
    assert _silent_s(estimates, force, 1000.0) <= 0.1
    last = slice(-4 * _STOP, None)
    error = np.abs(estimates["force"] - force)[last]
    assert np.mean(error > 3.0 * np.hypot(estimates["sigma"][last], 25.0)) < 0.02


@pytest.mark.parametrize("share", (1.1, 1.2))
def test_a_motor_that_is_pressed_against_its_stop_tells_nothing_of_the_current(p, share):
    """The stop takes what pads and current press with: taken for an offset, that is missing in the next stop."""
    estimates, force, _, _ = _driven(p, share, 1, pressed_A=-4.0)
    later = slice((_BEFORE + 1) * _STOP, None)
    error, told = np.abs(estimates["force"] - force)[later], np.isin(estimates["mode"], (RUNNING, ADAPTING))[later]
    assert np.mean(told & (error > 3.0 * np.hypot(estimates["sigma"][later], 25.0))) < 0.01
    assert _silent_s(estimates[later], force[later], 1000.0) <= 0.1


def _filtered(p, signal, seed=3, samples=60):
    """Innovations, their variances, sensitivities and gains P h' of a filter over the errors of a brake whose torque has the
    ``signal`` beside its noise, N m."""
    rng = np.random.default_rng(seed)
    x, P, gain, h = np.zeros(STATES), np.zeros((STATES, STATES)), np.zeros(STATES), np.zeros(STATES)
    set_priors(P, p)
    P[OFFSET, OFFSET] = 0.01
    rows = []
    for k in range(samples):
        h[:] = rng.normal(size=STATES) * 1e-3
        h[OFFSET] = 1.0
        s = 0.02**2 + variance_along(P, h, gain)
        innovation = 0.02 * rng.normal() + signal(k) - h @ x
        rows.append((innovation, s, h.copy(), gain.copy()))
        update_errors(x, P, gain, innovation, s)
    return rows


def _weighed(n, rows, signal, doubted=0.0):
    """A NEARER record whose ways would all show ``signal``."""
    for k, (innovation, s, h, gain) in enumerate(rows):
        n["force"] = signal(k)
        follow_nearer(n, h, gain, 1.0, innovation, s, 1.0, 1.0, doubted)


def test_the_likelihood_is_that_of_a_filter_that_knows_what_the_torque_shows(p):
    signal = lambda k: 3e-4 * k  # noqa: E731
    n = new_state()[0]["nearer"]
    mistaken, knows = _filtered(p, signal), _filtered(p, lambda _: 0.0)
    _weighed(n, mistaken, signal)
    told = [0.5 * (one[0] ** 2 - other[0] ** 2) / one[1] for one, other in zip(mistaken, knows, strict=True)]
    assert max(told) < 2.0 and sum(told) > 4.0
    assert n["odds"] == pytest.approx(sum(told), rel=1e-6)


def test_an_offset_is_weighed_over_all_that_a_sensor_may_jump_by(p):
    """Beside the same filter, which knows the offset, the mean of the likelihood over its prior."""
    n = new_state()[0]["nearer"]
    rows = _filtered(p, lambda _: 0.05)
    _weighed(n, rows, lambda _: 0.0)
    sigma = torque_offset(p)
    sizes = np.linspace(-6.0, 6.0, 4001) * sigma
    likelihood = sum(
        -0.5 * (row[0] - sizes * (row[0] - none[0]) / 0.05) ** 2 / row[1]
        for row, none in zip(rows, _filtered(p, lambda _: 0.0), strict=True)
    )
    likelihood += sum(0.5 * row[0] ** 2 / row[1] for row in rows) - 0.5 * (sizes / sigma) ** 2
    mean = np.sum(np.exp(likelihood)) * (sizes[1] - sizes[0]) / (sigma * np.sqrt(2.0 * np.pi))
    assert offset_odds(n, p) == pytest.approx(NEARER_ODDS + np.log(mean), abs=0.01)


def test_few_samples_prove_nothing(p):
    n = new_state()[0]["nearer"]
    n["force"] = 1.0
    follow_nearer(n, np.zeros(STATES), np.zeros(STATES), 1.0, 1.0, 0.01, 1.0, 1.0, 0.0)
    assert n["odds"] == pytest.approx(2.0)
    forget_nearer(n)
    n["force"] = 1.0
    follow_nearer(n, np.zeros(STATES), np.zeros(STATES), 1.0, 1.0, 0.01, 1.0, 1.0, 1.0)
    assert n["odds"] == pytest.approx(0.5 / 1.01), "a torque that changes fast tells less"


def test_what_overshoots_stays_a_number(p):
    n = new_state()[0]["nearer"]
    set_ways(n, p, float(p["clearance"]))
    h, gain = np.zeros(STATES), np.zeros(STATES)
    h[CONTACT], gain[CONTACT] = -0.01, -1.0
    for _ in range(1000):
        place_nearer(n, 0.5, p["curve"], 1.0)
        follow_nearer(n, h, gain, 1e-4, 0.0, 0.01, 1.0, 1.0, 0.0)
    assert np.isfinite(nearer_odds(n)) and all(abs(n["mistaken"][j, CONTACT]) <= way(n, j) for j in range(WAYS))


def test_a_rest_forgets_what_nothing_speaks_for(opened):
    n = opened["nearer"]
    n["odds"], n["told"] = -20.0, 3.0
    n["odds"][4] = 3.9
    rest_nearer(n)
    assert best_nearer(n) == n["told"] == 0.0
    n["odds"][4] = 4.1
    rest_nearer(n)
    assert best_nearer(n) == 4.1


def test_ways_reach_from_where_a_jump_ends_to_pads_that_drag(p):
    n = new_state()[0]["nearer"]
    set_ways(n, p, float(p["clearance"]))
    assert way(n, 0) == pytest.approx(2.0 * contact_jump(p)) and way(n, WAYS - 1) > 1.2 * p["clearance"]


def test_a_nearer_contact_counts_in_the_force_by_its_share(p, opened):
    n = opened["nearer"]
    n["share"], n["force"] = 0.0, 5000.0
    assert nearer_force(n) == (0.0, 0.0)
    n["share"][[2, 5]], n["force"][[2, 5]] = 0.1, (1000.0, 3000.0)
    assert nearer_force(n) == pytest.approx((2000.0, 1000.0))


@pytest.mark.parametrize(("nearer", "offset", "torque", "proven"), [
    (14.0, 0.0, -6.0, True),
    (10.9, 0.0, -6.0, False),
    (14.0, 12.0, -6.0, False),
    (14.0, 0.0, 10.0, True),
    (14.0, 0.0, 12.0, False),
])  # fmt: skip
def test_a_nearer_contact_is_proven_by_where_the_torque_begins(p, opened, nearer, offset, torque, proven):
    """A current that jumps in that very moment is as rare as one that jumps at all."""
    opened["nearer"]["odds"], opened["nearer"]["told"] = nearer, 1e9
    opened["nearer"]["sum"] = np.sqrt(2.0 * 1e9 * (offset + 0.5 * np.log(1.0 + 1e9 * torque_offset(p) ** 2)))
    assert offset_odds(opened["nearer"], p) == pytest.approx(NEARER_ODDS + offset, abs=0.01)
    opened["alternatives"]["log_odds"][TORQUE_JUMP] = torque
    assert nearer_proven(opened, p) == proven


@pytest.mark.parametrize(("nearer", "accepted"), [(0.0, True), (18.0, False)])
def test_torque_that_begins_where_a_nearer_contact_would_be_is_not_taken_for_the_currents(p, opened, nearer, accepted):
    opened["alternatives"]["log_odds"][TORQUE_JUMP] = 20.0
    opened["nearer"]["odds"] = nearer
    assert settle(opened, p, True, 0.004) == accepted
