"""What has jumped: each change of an ideal brake is attributed to its path, ends in a small error with a sigma that covers
it, and nothing is proven where nothing has changed."""

import itertools

import brake
import naive
import numpy as np
import pytest

from emb_daemon.estimator import restart
from emb_daemon.estimator.contact import place_contact
from emb_daemon.estimator.hypotheses import (
    ALTERNATIVES,
    CERTAIN_ODDS,
    DRIFT,
    KEPT_JUMP,
    PRIOR_ODDS,
    SLOW_CHANGE,
    STIFFNESS_JUMP,
    TORQUE_JUMP,
    contact_sigma,
    drift_odds,
    exists,
    fold,
    learn,
    learned_torque,
    likely_shift,
    mix,
    open_again,
    open_all,
    open_others,
    place,
    settle,
    stay_finite,
    suspected,
    to_force,
    to_torque,
    unproven,
    watch_steps,
    weigh,
)
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.status import BOUND_REACHED
from emb_daemon.estimator.unknown import add_drift_walks, set_priors, torque_offset
from emb_daemon.models.fusion import (
    CONTACT,
    COULOMB,
    CREEPS,
    FADE,
    FAST,
    GAIN,
    GROWTH,
    HOUSING,
    INERTIA,
    LATE,
    LOAD,
    NOISE,
    OF_THE_MODEL,
    OFFSET,
    SCALE,
    SLOW,
    STATES,
    VISCOUS,
    force_variance,
)
from emb_daemon.offline import estimate
from emb_daemon.offline.stretches import stretches_of
from emb_daemon.wire.contract import CONTACT_UNCERTAIN, PATHS_DISAGREE

#: Samples of one stop of `brake.stops`, of its standstill at the beginning, and stops before the change.
_STOP, _STILL, _BEFORE = 750, 350, 4


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _drive(p, change=None, stops=12, seed=1, current=None, angle_m=0.0):
    """Samples and true force of stops on a brake that becomes ``change(p)`` after `_BEFORE` of them; ``angle_m``: metres by
    which its contact angle then moves; ``current`` changes the later rows' current."""
    path = brake.stops(p, stops, seed)
    rows, force = brake.samples(p, path)
    if change is not None or angle_m:
        true = p.copy()
        if change is not None:
            change(true)
        true["clearance"] += angle_m / p["gear_gain"]
        later, later_force = brake.samples(true, path)
        begin = _BEFORE * _STOP
        rows[begin:], force[begin:] = later[begin:], later_force[begin:]
    if current is not None:
        current(rows[_BEFORE * _STOP :])
    return brake.noisy(rows, p, seed), force


def _end(p, rows, force, stops=4):
    """RMSE, largest error in sigma, share beyond three sigma and median sigma while clamped in the last ``stops``, and the
    state."""
    state = new_state()
    estimates = estimate(rows, p, state)
    last = np.arange(len(rows)) >= len(rows) - stops * _STOP
    clamped = last & (force > 2000.0)
    error = (estimates["force"] - force)[clamped]
    off = np.abs(error) / estimates["sigma"][clamped]
    return (
        np.sqrt(np.mean(error**2)),
        off.max(),
        np.mean(off > 3.0),
        np.median(estimates["sigma"][clamped]),
        state[0],
        estimates,
    )


def _scaled(names, factor):
    def change(true):
        for name in names:
            true[name] = true[name] * factor

    return change


def _shifted(amperes):
    def change(rows):
        rows["current_q"] += amperes

    return change


def _learned(p, state):
    """What the first hypothesis holds for changed: contact in micrometres, the rest as shares, the offset in amperes."""
    x = state["error"]
    return {
        "contact": (state["contact_angle"] - p["clearance"]) * p["gear_gain"] * 1e6,
        "scale": state["scale"] - 1.0,
        "offset": x[OFFSET] / p["torque_constant"],
        "load": x[LOAD] / p["load_friction"],
        "coulomb": x[COULOMB] / p["offset_friction"],
    }


#: What may be found where nothing has changed, in the units of `_learned`.
_NOTHING = {"contact": 5.0, "scale": 0.02, "offset": 0.1, "load": 0.05, "coulomb": 0.1}
_FRICTION = ("load_friction", "offset_friction")
_CHANGES = {
    "knock-back": ({"angle_m": 40e-6}, {"contact": 40.0}),
    "growth": ({"angle_m": -40e-6}, {"contact": -40.0}),
    "stiffer pads": ({"change": _scaled(["curve"], 1.25)}, {"scale": 0.25}),
    "softer pads": ({"change": _scaled(["curve"], 0.75)}, {"scale": -0.25}),
    "offset of the current": ({"current": _shifted(-1.0)}, {"offset": -1.0}),
    "worn gear": ({"change": _scaled(_FRICTION, 1.5)}, {"load": 0.5, "coulomb": 0.5}),
}


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", _CHANGES)
def test_a_change_is_attributed_and_ends_in_a_small_error(p, name, seed):
    """After the fourth stop the brake is another. Two stops later the force is right, its sigma small and honest, the
    change is
    held for what it is and nothing else took a part of it; until then no error beyond three sigma lasts 0.12 s
    without being said."""
    change, expected = _CHANGES[name]
    rows, force = _drive(p, seed=seed, **change)
    rmse, worst, beyond, sigma, state, estimates = _end(p, rows, force, stops=6)
    assert rmse < 100.0 and sigma < 150.0 and worst < 4.0 and beyond < 0.01
    learned = _learned(p, state)
    for what, nothing in _NOTHING.items():
        assert learned[what] == pytest.approx(
            expected.get(what, 0.0), abs=max(nothing, 0.15 * abs(expected.get(what, 0.0)))
        ), what
    silent = (np.abs(estimates["force"] - force) > 3.0 * estimates["sigma"]) & (estimates["reasons"] == 0)
    assert np.max(np.ptp(stretches_of(silent), axis=1), initial=0) <= 25
    told = estimates["reasons"][-6 * _STOP :]
    assert not np.any(told & ~CONTACT_UNCERTAIN)
    # What jumped once may again: a sample or two at the beginning of a stop are open by more than a hundredth.
    assert np.mean(told != 0) < 0.002


@pytest.mark.parametrize("stops", [8, 40])
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_pads_that_a_poor_torque_cannot_tell_from_the_calibrations_stay_possible(p, factor, stops):
    """A torque that is known to a fifteenth of the force refutes no other pads within a stop: they are not forgotten with the
    first release, nor after some stops. In up to a third of the drives noise speaks as clearly against them as a good torque
    would; of those without this promise none is covered."""
    p["torque_lasting_sigma"] = 1.0 / 15.0
    true = p.copy()
    true["curve"] = factor * true["curve"]
    shares = []
    for seed in range(1, 13):
        rows, force = brake.samples(true, brake.stops(p, stops, seed))
        estimates = estimate(brake.noisy(rows, p, seed), p)
        clamped = force > 1000.0
        shares.append(np.mean(np.abs(estimates["force"] - force)[clamped] > 3.0 * estimates["sigma"][clamped]))
    assert np.sum(np.array(shares) < 0.01) >= 8, shares


@pytest.mark.parametrize("seed", [1, 2])
def test_an_offset_that_closes_is_the_currents_too(p, seed):
    rows, force = _drive(p, seed=seed, stops=14, current=_shifted(1.0))
    rmse, worst, _, _, state, _ = _end(p, rows, force)
    assert worst < 4.0 and _learned(p, state)["offset"] == pytest.approx(1.0, abs=0.1)
    assert rmse < 100.0


@pytest.mark.parametrize(("ampere_per_s", "seed"), [(0.09, 1), (0.09, 2), (-0.09, 2)])
def test_a_current_sensor_that_drifts_takes_no_force_with_it(p, ampere_per_s, seed):
    """What each clearance shows of its offset it may have drifted by again at the next."""
    rows, force = brake.samples(p, brake.stops(p, 8, seed))
    rows = brake.noisy(rows, p)
    rows["current_q"] += ampere_per_s * np.maximum(np.cumsum(rows["dt"]) - 5.0, 0.0)
    estimates = estimate(rows, p)
    error, clamped = estimates["force"] - force, force > 500.0
    assert np.sqrt(np.mean(error[clamped] ** 2)) < 60.0
    assert np.mean(np.abs(error) < 2.0 * estimates["sigma"]) > 0.95


@pytest.mark.parametrize("ampere_per_s", [-0.12, 0.12])
def test_a_current_sensor_that_has_drifted_by_twice_a_healthy_ones_offset_is_told(p, ampere_per_s):
    rows, _ = brake.samples(p, brake.stops(p, 18))
    rows = brake.noisy(rows, p)
    drifted = ampere_per_s * np.maximum(np.cumsum(rows["dt"]) - 5.0, 0.0)
    rows["current_q"] += drifted
    told = estimate(rows, p)["reasons"] & PATHS_DISAGREE > 0
    healthy = np.abs(drifted) * p["torque_constant"] / torque_offset(p)
    assert np.all(told[healthy > 2.1]) and np.mean(told[healthy < 1.9]) < 0.05


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("at", [0.3, 0.6])
@pytest.mark.parametrize("ampere", [-1.5, 1.5, 3.0])
def test_a_current_that_steps_in_a_slow_stroke_is_no_other_pad(p, ampere, at, seed):
    """Pads that have told little of their stiffness so far could explain it: kilonewtons, without a word."""
    slow = np.concatenate((np.linspace(-p["clearance"], 0.0, 100), np.linspace(0.0, 12.0, 750), np.full(250, 12.0)))
    stops = brake.stops(p, 2, seed)
    rows, force = brake.samples(p, np.concatenate((stops, p["clearance"] + slow)))
    begin = len(stops) + 100 + round(750 * at)
    rows["current_q"][begin:] += ampere
    estimates = estimate(brake.noisy(rows, p, seed), p)
    error, sigma = np.abs(estimates["force"] - force)[begin:], estimates["sigma"][begin:]
    assert np.mean(error > 3.0 * np.hypot(sigma, 25.0)) < 0.01
    # Whatever is the likeliest: the motor may press against something that has given way.
    told = estimates["reasons"][begin:] & PATHS_DISAGREE != 0
    assert np.any(told[:25]) and np.mean(told[25:]) > 0.95
    assert not np.any((error > 1000.0) & (estimates["reasons"][begin:] == 0))


@pytest.mark.parametrize(
    ("changed", "speed", "gap_s", "opens"),
    [
        ({}, 4.0, 0.0, True),
        ({}, -4.0, 0.0, False),  # friction turns over
        ({}, 0.2, 0.0, False),
        ({}, 4.0, 0.02, False),
        ({"braked_s": 0.1}, 4.0, 0.0, False),  # a contact that has moved
        ({"before": 2.0}, 4.0, 0.0, False),  # it did not fit before either
        ({"since_s": 0.01}, 4.0, 0.0, False),
        ({"odds": -4.0}, 4.0, 0.0, False),  # something has been seen already
    ],
)
def test_a_torque_steps_where_a_sliding_motor_was_explained_until_then(p, changed, speed, gap_s, opens):
    states = new_state()
    set_priors(states["covariance"][0], p)
    open_all(states[0], p)
    state, known = states[0], {"braked_s": 1.0, "since_s": 1.0, "odds": PRIOR_ODDS} | changed
    state["contact"]["engaged"], state["friction_mean"], state["scale"] = True, 1.0, 1.0
    state["alternatives"][TORQUE_JUMP]["prior"] = PRIOR_ODDS
    state["alternatives"][TORQUE_JUMP]["log_odds"] = known["odds"]
    for name, value in known.items():
        state["stepping"][name] = value
    for innovation in (0.0, 4.0, 4.0, 4.0):
        watch_steps(state, p, innovation, speed, 0.004 + gap_s * (innovation == 0.0))
    assert state["stepping"]["opened"] == opens


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("angle_um", [-60.0, 60.0, 100.0])
def test_a_torque_with_an_error_that_lasts_tells_within_a_stroke_what_that_does_not_explain(p, angle_um, seed):
    """One that is other in other stops, by a fiftieth of the force, contradicts a force that is a fifth off as soon as contact
    is made."""
    p["torque_lasting_sigma"] = 0.02
    rows, force = _drive(p, stops=_BEFORE + 2, seed=seed, angle_m=1e-6 * angle_um)
    estimates = estimate(rows, p)
    error, large = np.abs(estimates["force"] - force), np.arange(len(rows)) >= _BEFORE * _STOP
    silent = large & (error > 1000.0) & (estimates["reasons"] == 0)
    assert np.count_nonzero(large & (error > 1000.0)) > 50, "nothing to judge"
    assert np.count_nonzero(silent) < 50
    assert np.mean(error[large] > 3.0 * np.hypot(estimates["sigma"][large], 25.0)) < 0.1


@pytest.mark.parametrize("times", [4.0, 6.0])
@pytest.mark.parametrize("seed", [2, 3])
def test_a_lubricant_of_another_grade_is_not_taken_for_other_pads(p, times, seed):
    """Whose torque at full speed is several times the Coulomb friction: sigma covers from the first stop on."""
    rows, force = brake.samples(p, brake.stops(p, 2, seed))
    viscous = times * p["offset_friction"] / p["maximum_speed"]
    rows["current_q"] += viscous * 0.5 * (rows["speed"] + np.roll(rows["speed"], 1)) / p["torque_constant"]
    estimates = estimate(brake.noisy(rows, p), p)
    assert np.mean(np.abs(estimates["force"] - force) < 2.0 * estimates["sigma"]) > 0.95


def test_an_offset_that_moved_by_more_than_its_sigma_may_again(p, opened):
    """By as much in as long; one that did not is no reason."""
    s = opened[0]
    s["contact"]["engaged"], s["covariance"][OFFSET, OFFSET] = True, 1e-6
    for seconds, offset, walk in ((0.0, 0.5, 0.0), (10.0, 0.502, 0.0), (10.0, 0.402, 0.5 * (0.01 - 9e-6) / 10.0)):
        if s["offset_age_s"] > 0.0:
            s["offset_age_s"] = seconds
        s["braked"], s["error"][OFFSET] = False, offset
        settle(s, p, False, 0.004)
        assert s["offset_walk"] == pytest.approx(walk) and s["offset_before"] == offset and s["braked"]
        settle(s, p, False, 0.004)
        assert s["offset_walk"] == pytest.approx(walk), "one stroke tells once"


@pytest.mark.parametrize("seed", [1, 2])
def test_a_motor_that_fades_with_heat_takes_no_stiffness_with_it(p, seed):
    """The torque constant loses a fifth over four minutes of stops: the torque path's gain follows."""
    rows, force = _drive(p, seed=seed, stops=80)
    rows["current_q"] /= 1.0 - 0.2 * np.linspace(0.0, 1.0, len(rows))
    rmse, _, beyond, sigma, state, estimates = _end(p, rows, force, stops=10)
    assert rmse < 100.0 and sigma < 150.0 and beyond < 0.01
    assert state["scale"] == pytest.approx(1.0, abs=0.02)
    silent = (np.abs(estimates["force"] - force) > 3.0 * estimates["sigma"]) & (estimates["reasons"] == 0)
    assert np.max(np.ptp(stretches_of(silent), axis=1), initial=0) <= 25


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_proven_where_nothing_has_changed(p, seed):
    """A minute of stops each: no hypothesis becomes the first, next to nothing is said, and the force is as good as if nothing
    could have changed."""
    rows, force = _drive(p, seed=seed, stops=20)
    rmse, worst, _, _, state, estimates = _end(p, rows, force, stops=18)
    assert np.mean(estimates["reasons"] != 0) < 0.01
    assert np.abs(np.diff(estimates["contact_angle"])).max() < 1e-6 / p["gear_gain"]
    assert np.abs(np.diff(estimates["stiffness_factor"])).max() < 1e-3
    assert state["scale"] == pytest.approx(1.0, abs=0.005) and worst < 4.0
    known = p.copy()
    known["clearance_sigma"] = 0.0
    assert rmse < 1.1 * _end(known, rows, force, stops=18)[0] + 5.0


@pytest.fixture(scope="module")
def holding(shipped_setup):
    p = brake.ideal(shipped_setup.parameters)
    rows, force = _drive(p, stops=2)
    now = _STOP + _STILL + 150
    state = new_state()
    estimates = estimate(rows[:now], p, state)
    assert force[now] > 3500.0 and not estimates["reasons"][1:].any()
    return state, rows[now : now + 1], float(estimates["sigma"][-1])


@pytest.fixture
def clamped(holding):
    """State of a brake that holds under load, the next row, and the force's sigma."""
    state, row, sigma = holding
    return state.copy(), row.copy(), sigma


def test_mixture_is_the_law_of_total_variance(p, clamped):
    """Mean and variance of the first hypothesis and all changes by their probabilities, forces and own variances; and of a
    drift's distance from that by its odds."""
    state, _, _ = clamped
    s, rng = state[0], np.random.default_rng(3)
    h, spread = np.zeros(STATES), 40.0
    forces, variances, odds = [s["force"] + spread * s["error"][0]], [], [1.0]
    to_force(h, s, spread, s["slope"], s["force"], 0.0)
    variances.append(force_variance(s["covariance"], h))
    for kind in range(ALTERNATIVES):
        a = s["alternatives"][kind]
        a["log_odds"], a["shift"] = rng.uniform(-2.0, 2.0), rng.normal(0.0, 500.0)
        to_force(h, s, spread, a["slope"], s["force"] + a["shift"], 0.0)
        forces.append(s["force"] + a["shift"] + spread * a["error"][0])
        variances.append(force_variance(a["covariance"], h))
        odds.append(np.exp(a["log_odds"]))
    odds[-1] = min(odds[-1], np.exp(-0.7) * max(odds[:-1]))
    weights, drift = np.array(odds[:-1]) / np.sum(odds[:-1]), odds[-1] / np.sum(odds)
    mean = weights @ forces[:-1]
    variance = weights @ variances[:-1] + weights @ (np.array(forces[:-1]) - mean) ** 2
    variance += drift * (forces[-1] - mean) ** 2
    assert mix(s, h, spread, 0.0) == pytest.approx((mean, np.sqrt(variance)))
    assert s["alternatives"]["share"] == pytest.approx([*weights[1:], drift])


def _grown(s, h):
    """What 60 K of the disc add to the standard deviation of the force, N."""
    return np.sqrt(mix(s, h, 40.0, 60.0)[1] ** 2 - mix(s, h, 40.0, 0.0)[1] ** 2)


def test_a_disc_that_grows_unseen_counts_as_long_as_nothing_has_shown_its_growth(p, clamped):
    """A long drag heats the disc and moves the motor too little to see the contact angle by: grey iron of 26 mm, 60 K."""
    state, _, _ = clamped
    s, h = state[0], np.zeros(STATES)
    open_all(s, p)
    mix(s, h, 40.0, 0.0)
    drift = s["alternatives"][DRIFT]
    grown_N = drift["slope"] * 0.26e-6 * 60.0 / p["gear_gain"]
    assert _grown(s, h) == pytest.approx(np.sqrt(drift["share"]) * grown_N, rel=0.1)
    # Strokes that showed the contact angle together with the growth leave less.
    P = drift["covariance"]
    P[GROWTH, CONTACT] = P[CONTACT, GROWTH] = -0.8 * np.sqrt(P[GROWTH, GROWTH] * P[CONTACT, CONTACT])
    assert _grown(s, h) == pytest.approx(0.6 * np.sqrt(drift["share"]) * grown_N, rel=0.1)


def test_a_brake_that_is_held_as_exactly_known_is_no_other(p, clamped):
    state, _, _ = clamped
    s, h = state[0], np.zeros(STATES)
    p["clearance_sigma"] = 0.0
    open_all(s, p)
    assert not any(exists(a) for a in s["alternatives"])
    force, sigma = mix(s, h, 40.0, 0.0)
    to_force(h, s, 40.0, s["slope"], s["force"], 0.0)
    assert (force, sigma) == pytest.approx((s["force"] + 40.0 * s["error"][0], np.sqrt(force_variance(s["covariance"], h))))


def test_an_unproven_jump_counts_in_sigma_and_is_said(p, clamped):
    """Even odds on a fifth more: sigma of half of that, nearly, and the reason."""
    state, row, before = clamped
    a = state["alternatives"][0, STIFFNESS_JUMP]
    a["log_odds"] = 0.0
    a["error"][SCALE] += 0.2
    out = estimate(row, p, state)[0]
    assert out["sigma"] > 0.4 * 0.2 * 3500.0 > before and out["reasons"] & PATHS_DISAGREE


@pytest.mark.parametrize("share", [0.005, 0.03])
def test_model_error_counts_in_sigma_and_is_said_where_it_matters(p, clamped, share):
    """What consistency cannot explain as noise, at every horizon: shares of the largest force."""
    state, row, before = clamped
    c, left = state["consistency"], share * p["maximum_force"]
    c["seen_s"], c["square"], c["expected"] = 1000.0, left**2, 1.0
    out = estimate(row, p, state)[0]
    assert out["sigma"] == pytest.approx(np.hypot(before, left), rel=0.1)
    assert (out["reasons"] & PATHS_DISAGREE != 0) == (share > 0.01)


@pytest.mark.parametrize("name", ["temperature_sigma", "history_sigma", "sigma"])
def test_unknown_temperature_counts_in_sigma(p, clamped, name):
    """40 K move the force by what the calibration's softening says: a start with hot pads, the pads' history, and what the
    thermal model itself may be off by."""
    state, row, _ = clamped
    warm = p.copy()
    if name == "sigma":
        warm["thermal"]["sigma"] = 40.0
    else:
        state[name] = 40.0
    cold = state.copy()
    for key in ("temperature_sigma", "history_sigma"):
        cold[key] = 0.0
    coefficient = p["thermal"]["softening_history" if name == "history_sigma" else "softening"]
    sigma, without = estimate(row, warm, state)[0]["sigma"], estimate(row, p, cold)[0]["sigma"]
    assert coefficient > 0.0 and sigma > without + 0.3 * coefficient * 40.0 * 3500.0 * 0.5


def test_contradicting_paths_count_in_sigma(p, clamped):
    """While nothing tells which path is wrong, sigma reaches from one to the other."""
    state, row, before = clamped
    state["plausibility"]["contradiction"] = 2000.0
    state["plausibility"]["verdict"] = 4
    row["current_q"] += 4.0
    out = estimate(row, p, state)[0]
    assert out["sigma"] > 0.9 * abs(out["innovation"]) > 10.0 * before


def _weighed(log_odds, first, second, times=1):
    a = new_state()["alternatives"][0, 0]
    a["log_odds"] = log_odds
    for _ in range(times):
        weigh(a, PRIOR_ODDS, 100.0, first, 1.0, second, 1.0)
    return float(a["log_odds"])


def test_odds_are_likelihood_ratios_of_the_same_torque():
    assert _weighed(0.0, 2.0, 1.0) == pytest.approx(1.5)
    a = new_state()["alternatives"][0, 0]
    weigh(a, PRIOR_ODDS, 100.0, 1.0, 4.0, 1.0, 1.0)
    assert a["log_odds"] == pytest.approx(0.125 - 0.5 + 0.5 * np.log(4.0))
    a["log_odds"] = 0.0
    weigh(a, PRIOR_ODDS, 100.0, 1.0, 1.0, 1.0, 4.0)
    assert a["log_odds"] == pytest.approx(0.5 - 0.125 - 0.5 * np.log(4.0))


def test_a_sample_far_off_counts_as_the_gates_edge():
    assert _weighed(0.0, 100.0, 0.0) == pytest.approx(12.5)
    assert _weighed(0.0, 100.0, 90.0) == pytest.approx(0.0)


def test_odds_never_fall_below_their_start():
    """Or a later jump would have to make up for a long past without any."""
    assert _weighed(0.0, 0.0, 1.0, times=1000) == PRIOR_ODDS
    assert _weighed(0.0, 5.0, 0.0, times=1000) == 100.0


def test_what_tells_two_changes_apart_outlasts_certainty(p):
    """However much both explain what nothing does, the one that explained more stays ahead by as much."""
    s = new_state()[0]
    s["alternatives"]["log_odds"] = 150.0, 120.0, -7.0, -np.inf, 149.0
    s["alternatives"]["least"] = -8.0
    stay_finite(s)
    assert s["alternatives"]["log_odds"].tolist() == [CERTAIN_ODDS, CERTAIN_ODDS - 30.0, -8.0, -np.inf, CERTAIN_ODDS - 1.0]


@pytest.fixture
def opened(p):
    state = new_state()
    set_priors(state["covariance"][0], p)
    state["scale"] = 1.0
    # Seen before: none that comes from a workshop.
    state["resumed"] = True
    open_all(state[0], p)
    return state


def test_alternatives_allow_what_may_have_jumped_and_no_more(p, opened):
    """The stiffness path's only stiffness and contact, the torque path's only motor and friction."""
    s = opened[0]
    wider = [np.diag(a["covariance"]) > 1.01 * np.diag(s["covariance"]) for a in s["alternatives"]]
    assert not np.any(wider[STIFFNESS_JUMP] & wider[TORQUE_JUMP]) and not np.any(wider[SLOW_CHANGE] & wider[STIFFNESS_JUMP])
    assert (
        wider[STIFFNESS_JUMP][SCALE] and wider[TORQUE_JUMP][GAIN] and wider[TORQUE_JUMP][LOAD] and wider[TORQUE_JUMP][COULOMB]
    )


def test_heat_that_explains_a_share_of_the_torque_lets_the_torque_constant_be_as_far_off(p, opened):
    """Both lags, whichever way they go: what a brake can be at all is that much wider."""
    s, prior = opened[0], opened[0]["covariance"][GAIN, GAIN]
    s["error"][[FADE, HOUSING]], s["winding"], s["housing"] = (0.2, -0.3), 0.5, 0.4
    open_all(s, p)
    allowed = 0.05 + 0.2 * 0.5 + 0.3 * 0.4
    assert s["alternatives"]["covariance"][SLOW_CHANGE, GAIN, GAIN] == pytest.approx(1.0 / (1.0 / prior + 1.0 / allowed**2))


def test_nothing_is_proven_before_the_clearance_was_passed_back(p, opened):
    s = opened[0]
    s["alternatives"]["log_odds"][TORQUE_JUMP] = 50.0
    assert not settle(s, p, False, 0.004)
    assert settle(s, p, True, 0.004)
    assert np.array_equal(s["covariance"], s["alternatives"][TORQUE_JUMP]["covariance"])


def test_a_brake_that_drifts_is_never_proven(p, opened):
    """What it explains, a torque constant or a friction within their priors explains as well."""
    s = opened[0]
    s["alternatives"]["log_odds"][DRIFT] = drift_odds(s)[1]
    assert not suspected(s) and unproven(s) == 0.0
    assert not settle(s, p, True, 30.0) and s["alternatives"]["log_odds"][DRIFT] == drift_odds(s)[1]


def test_a_drift_stays_possible_beside_a_change_that_is_all_but_certain(p, opened):
    """A torque that has jumped explains what a stiffness that drifts would: until it is proven, one in eight is left."""
    s = opened[0]
    s["alternatives"]["log_odds"][TORQUE_JUMP] = 50.0
    assert 0.1 < np.exp(drift_odds(s)[0] - 50.0) < 0.2


def test_what_spoke_for_a_drift_is_remembered_and_never_makes_it_the_likelier(p, clamped):
    """Pads that wear: the first hypothesis bends torque constant and friction to them stroke by stroke, and explains the next
    as well as a drift does."""
    state, _, _ = clamped
    s, h = state[0], np.zeros(STATES)
    open_all(s, p)
    s["alternatives"]["log_odds"][DRIFT] = drift_odds(s)[1]
    for against, a_third in ((0.0, True), (4.0, True), (2.0, False)):
        s["alternatives"]["log_odds"][DRIFT] -= against
        mix(s, h, 40.0, 0.0)
        share = s["alternatives"]["share"][DRIFT]
        assert (0.3 < share < 0.34) == a_third and share < 0.34


def test_two_that_are_alike_wait_for_more_strokes(p, opened):
    """The stronger is taken after twenty seconds, even if the other explains almost as much."""
    s = opened[0]
    s["alternatives"]["log_odds"][:2] = 12.0, 11.5
    assert not settle(s, p, True, 0.004)
    s["alternatives"]["age_s"] = 20.1
    assert settle(s, p, True, 0.004)


def test_a_jump_that_is_expected_needs_as_much_evidence_as_another(p, opened):
    """Odds of e^5 against the first hypothesis, from those of a jump that nobody expects."""
    s = opened[0]
    s["alternatives"]["prior"][STIFFNESS_JUMP] = -1.0
    s["alternatives"]["log_odds"][STIFFNESS_JUMP] = -1.0 + 10.9
    assert not settle(s, p, True, 0.004)
    s["alternatives"]["log_odds"][STIFFNESS_JUMP] = -1.0 + 11.1
    assert settle(s, p, True, 0.004)


def _stop(s, p, jumps):
    """One stop and the release after it, with a change of contact proven there or not."""
    s["contact"]["engaged"] = True
    settle(s, p, False, 4.0)
    s["contact"]["engaged"] = False
    if jumps:
        s["alternatives"]["log_odds"][STIFFNESS_JUMP] = 20.0
    if settle(s, p, True, 0.004):
        open_all(s, p)


def _share(odds):
    return 1.0 / (1.0 + np.exp(-odds))


def test_pads_that_are_knocked_back_are_expected_to_be_again(p, opened):
    """One stop in four hundred of a brake that was never seen to; every third of one that did ten times in turn; and after
    hundreds of stops without it hardly one in fifty."""
    s = opened[0]
    odds = s["alternatives"]["log_odds"]
    _stop(s, p, jumps=False)
    assert odds[STIFFNESS_JUMP] == odds[TORQUE_JUMP] == PRIOR_ODDS
    for _ in range(10):
        _stop(s, p, jumps=True)
    assert 0.3 < _share(odds[STIFFNESS_JUMP]) <= 0.5 and odds[TORQUE_JUMP] == PRIOR_ODDS
    assert not suspected(s), "that it may happen is no sign that it has"
    for _ in range(500):
        _stop(s, p, jumps=False)
    assert odds[STIFFNESS_JUMP] > PRIOR_ODDS and _share(odds[STIFFNESS_JUMP]) < 0.02


def test_what_is_expected_before_the_first_jump_is_what_is_expected_of_any_brake(p, opened):
    """The rare event that was not seen yet counts like sixteen stops without it."""
    s = opened[0]
    for jumps, stops, odds in ((1e-12, 0.0, PRIOR_ODDS), (1.0, 0.0, np.log(1.04 / 14.96)), (20.0, 1.0, 0.0)):
        s["jumps"], s["stops"] = jumps, stops
        open_all(s, p)
        assert s["alternatives"]["least"][STIFFNESS_JUMP] == pytest.approx(odds, abs=0.02)


def test_a_change_that_is_certain_is_not_doubted_until_the_release(p, opened):
    """It is in the force already; what is told is how far apart the force would be with and without what may be."""
    s = opened[0]
    s["alternatives"]["shift"][STIFFNESS_JUMP] = 1000.0
    told = {}
    for odds in (-6.0, 0.0, 12.0):
        s["alternatives"]["log_odds"][STIFFNESS_JUMP] = odds
        mix(s, np.zeros(STATES), 30.0, 0.0)
        told[odds] = unproven(s)
    assert told[-6.0] < 5.0 and told[12.0] < 5.0
    assert told[0.0] == pytest.approx(500.0, rel=0.02)


def test_what_is_not_suspected_is_looked_for_anew(p, opened):
    """After a second, and at each release; what is suspected is not forgotten by then."""
    s = opened[0]
    s["alternatives"]["log_odds"][STIFFNESS_JUMP] = -3.0
    assert not settle(s, p, False, 0.5) and s["alternatives"]["log_odds"][STIFFNESS_JUMP] == -3.0
    settle(s, p, False, 0.6)
    assert s["alternatives"]["log_odds"][STIFFNESS_JUMP] == PRIOR_ODDS and s["alternatives"]["age_s"][STIFFNESS_JUMP] == 0.0
    s["alternatives"]["log_odds"][STIFFNESS_JUMP] = 1.0
    settle(s, p, False, 2.0)
    assert suspected(s) and s["alternatives"]["log_odds"][STIFFNESS_JUMP] == 1.0
    open_again(s, p)
    assert not suspected(s)


@pytest.mark.parametrize("since", [None, "resumed", "braked"])
def test_a_brake_that_was_never_seen_may_come_from_a_workshop(p, since):
    """With other pads or another gear: more likely than that they changed between two stops, until it was seen to brake."""
    s = new_state()[0]
    set_priors(s["covariance"], p)
    s["scale"] = 1.0
    if since:
        s[since] = True
    open_all(s, p)
    for jump in (STIFFNESS_JUMP, TORQUE_JUMP):
        odds = s["alternatives"]["log_odds"][jump]
        assert odds == PRIOR_ODDS if since else odds > PRIOR_ODDS
        assert s["alternatives"]["least"][jump] == PRIOR_ODDS
    assert not suspected(s)


def test_first_strokes_with_other_pads_are_covered(p):
    """While the motor closes for the first time, its friction explains them as well."""
    beyond = []
    for pads, seed in itertools.product((0.88, 0.92, 0.95, 1.05, 1.1), (1, 2, 3)):
        other = p.copy()
        other["curve"] *= pads
        rows, force = brake.samples(other, brake.stops(p, 1, seed))
        estimates = estimate(brake.noisy(rows, p, seed), p)
        beyond.append(np.abs(estimates["force"] - force) > 3.0 * np.hypot(estimates["sigma"], 25.0))
    assert np.mean(np.concatenate(beyond)) < 0.03


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_first_stroke_as_calibrated_is_no_sign_of_other_pads(p, seed):
    rows, force = brake.samples(p, brake.stops(p, 1, seed))
    estimates = estimate(brake.noisy(rows, p, seed), p)
    pressed = force > 2000.0
    assert not np.any(estimates["reasons"] & PATHS_DISAGREE)
    assert np.sqrt(np.mean((estimates["force"] - force)[pressed] ** 2)) < 50.0
    assert np.median(estimates["sigma"][pressed] / force[pressed]) < 0.02


def test_what_is_only_suspected_is_given_up_after_some_stops(p, opened):
    s = opened[0]
    s["alternatives"]["log_odds"][STIFFNESS_JUMP], s["alternatives"]["age_s"] = 1.0, 20.1
    settle(s, p, False, 0.004)
    assert suspected(s)
    settle(s, p, True, 0.004)
    assert not suspected(s)


def _renewed(s, p, kind, odds, released=True):
    """Looked for anew with ``odds`` for a jump of ``kind`` that was looked for until now, after a release or in a stop."""
    s["alternatives"]["log_odds"][kind], s["alternatives"]["age_s"][:2] = odds, 0.9
    s["alternatives"]["error"][kind, SCALE] = odds
    settle(s, p, released, 0.2)
    return s["alternatives"][KEPT_JUMP]


def test_the_likeliest_jump_is_kept_beside_its_successor(p, opened):
    """With what it learned and its age, until a clearly likelier one comes, or what was seen counts no more."""
    s = opened[0]
    assert not exists(_renewed(s, p, STIFFNESS_JUMP, PRIOR_ODDS + 0.5)), "no more than noise"
    kept = _renewed(s, p, STIFFNESS_JUMP, -3.5)
    assert kept["log_odds"] == kept["error"][SCALE] == -3.5 and kept["kind"] == STIFFNESS_JUMP and kept["age_s"] == 0.9
    assert s["alternatives"]["log_odds"][STIFFNESS_JUMP] == PRIOR_ODDS
    assert _renewed(s, p, TORQUE_JUMP, -3.0)["kind"] == STIFFNESS_JUMP
    assert _renewed(s, p, TORQUE_JUMP, -2.4)["kind"] == TORQUE_JUMP
    open_again(s, p)
    assert not exists(kept)
    assert exists(_renewed(s, p, TORQUE_JUMP, -2.5))
    kept["age_s"] = 20.1
    settle(s, p, True, 0.004)
    assert not exists(kept), "some stops did not prove it"


def test_what_nothing_spoke_for_on_the_way_to_a_force_is_kept_for_the_way_back(p, opened):
    """And no longer, if nothing spoke for it there either."""
    s = opened[0]
    kept = _renewed(s, p, STIFFNESS_JUMP, PRIOR_ODDS, released=False)
    assert exists(kept) and kept["kind"] == STIFFNESS_JUMP and kept["error"][SCALE] == PRIOR_ODDS
    assert _renewed(s, p, TORQUE_JUMP, PRIOR_ODDS + 0.5, released=False)["kind"] == STIFFNESS_JUMP
    settle(s, p, False, 2.0)
    assert exists(kept)
    settle(s, p, True, 0.004)
    assert not exists(kept)


def test_a_kept_jump_gives_way_to_none_that_is_less_likely_or_that_nothing_speaks_for(p, opened):
    """Neither to one of its own kind, nor to one of the torque that was only expected."""
    s = opened[0]
    kept = _renewed(s, p, STIFFNESS_JUMP, PRIOR_ODDS + 0.4, released=False)
    _renewed(s, p, STIFFNESS_JUMP, PRIOR_ODDS + 0.2, released=False)
    assert kept["log_odds"] == kept["error"][SCALE] == PRIOR_ODDS + 0.4
    s["alternatives"]["prior"][TORQUE_JUMP] = PRIOR_ODDS + 4.0
    assert _renewed(s, p, TORQUE_JUMP, PRIOR_ODDS + 3.0, released=False)["kind"] == STIFFNESS_JUMP
    s["alternatives"]["prior"][TORQUE_JUMP] = PRIOR_ODDS
    assert _renewed(s, p, TORQUE_JUMP, PRIOR_ODDS + 3.0, released=False)["kind"] == TORQUE_JUMP


def test_a_stop_ends_once_when_the_pads_have_left_the_disc(p, opened):
    s, stops = opened[0], []
    for engaged, released in ((False, True), (True, False), (True, False), (False, False), (False, True), (False, True)):
        s["contact"]["engaged"] = engaged
        settle(s, p, released, 0.004)
        stops.append(float(s["stops"]))
    assert stops == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0]


def test_a_kept_jump_is_proven_as_any_and_no_rival_of_its_successor(p, opened):
    s = opened[0]
    kept = _renewed(s, p, STIFFNESS_JUMP, -3.0)
    s["alternatives"]["log_odds"][STIFFNESS_JUMP], kept["log_odds"] = 9.0, 10.0
    kept["shift"] = 500.0
    before = float(s["force"])
    assert settle(s, p, True, 0.004)
    assert s["jumps"] == 1.0 and s["force"] == before + 500.0


@pytest.mark.parametrize(("behind", "goes_on"), [(0.5, True), (-3.0, True), (2.1, False)])
def test_a_drift_that_may_have_been_what_was_accepted_goes_on_to_count(p, opened, behind, goes_on):
    """A contact that moved in seconds looks like a jump of contact and stiffness that is wrong in the next stop."""
    s = opened[0]
    a = s["alternatives"]
    a["log_odds"][[STIFFNESS_JUMP, DRIFT]], a["shift"][[STIFFNESS_JUMP, DRIFT]] = (20.0, 20.0 - behind), (100.0, 1100.0)
    assert settle(s, p, True, 0.004)
    open_others(s, p)
    drift = a[DRIFT]
    assert (drift["log_odds"], drift["shift"]) == ((-behind, 1000.0) if goes_on else (-2.0, 0.0))
    assert (mix(s, np.zeros(STATES), 30.0, 0.0)[1] > 400.0) == goes_on
    drift["shift"] = 1000.0
    settle(s, p, False, 0.004)
    assert drift["shift"] == 1000.0
    drift["log_odds"] = -2.0
    settle(s, p, False, 0.004)
    assert drift["shift"] == (0.0 if goes_on else 1000.0), "once it is refuted, one begins anew"
    drift["shift"] = 1000.0
    settle(s, p, False, 0.004)
    assert drift["shift"] == 1000.0


@pytest.mark.parametrize(("before", "stiffness", "kept"), [(-np.inf, 10.0, 10.0), (-np.inf, 7.0, None), (12.0, 10.0, 12.0)])
def test_the_likeliest_of_the_other_kind_is_kept_beside_a_proven_jump(p, opened, before, stiffness, kept):
    """As far behind as it is, unless that is beyond what it may fall to; what comes next may speak for it."""
    s = opened[0]
    a = s["alternatives"]
    a["log_odds"][[STIFFNESS_JUMP, TORQUE_JUMP, KEPT_JUMP]] = stiffness, 14.0, before
    a["age_s"], a["kind"][KEPT_JUMP], a["least"][KEPT_JUMP] = 21.0, STIFFNESS_JUMP, PRIOR_ODDS
    a["error"][[STIFFNESS_JUMP, KEPT_JUMP], SCALE] = stiffness, before
    a["shift"][[STIFFNESS_JUMP, KEPT_JUMP, TORQUE_JUMP]] = 100.0, 120.0, 30.0
    assert settle(s, p, True, 0.004)
    k = a[KEPT_JUMP]
    if kept is None:
        assert k["log_odds"] == -np.inf
    else:
        shift = 100.0 if kept == stiffness else 120.0
        assert (k["kind"], k["error"][SCALE], k["log_odds"]) == (STIFFNESS_JUMP, kept, kept - 14.0)
        assert (s["force"], k["shift"]) == (30.0, shift - 30.0)
    open_others(s, p)
    assert a["log_odds"][TORQUE_JUMP] == PRIOR_ODDS and (k["log_odds"] > -np.inf) == (kept is not None)


def _covariance(rng, scale=1.0):
    root = rng.standard_normal((STATES, STATES))
    return scale * root @ root.T


def test_torque_tells_of_each_error_what_the_balance_says():
    """The equations at the head of `models.fusion`, of errors of every kind at once."""
    rng, h = np.random.default_rng(4), np.zeros(STATES)
    x = rng.standard_normal(STATES)
    spread, slope, force, warmth, leverage, gear, mean, speed, slow, turning, motor, changed, u, v = rng.uniform(0.5, 2.0, 14)
    s = new_state()[0]
    s["held"], s["drive"] = rng.uniform(0.5, 2.0, 2), 0.7
    to_force(h, s, spread, slope, force, warmth)
    off = spread * x[FAST] - slope * x[CONTACT] + force * x[SCALE] + slope * warmth * x[GROWTH]
    off += (s["held"] - 0.7) @ x[[*CREEPS]]
    assert h @ x == pytest.approx(off)
    to_torque(h, leverage, gear, mean, force, speed, slow, turning, motor, changed, u, v)
    friction = mean * force * gear * x[LOAD] + mean * x[COULOMB] + speed * x[VISCOUS] + slow * x[SLOW]
    lost = motor * (x[GAIN] + u * x[FADE] + v * x[HOUSING]) + changed * x[LATE]
    assert h @ x == pytest.approx(leverage * off + friction - lost + turning * x[INERTIA] + x[NOISE] + x[OFFSET])


def test_what_motor_and_friction_explain_has_the_standard_deviation_of_that():
    rng = np.random.default_rng(5)
    x, h, P = rng.standard_normal(STATES), rng.standard_normal(STATES), _covariance(rng)
    of = [GAIN, LOAD, COULOMB, VISCOUS, FADE, HOUSING, INERTIA, SLOW, LATE]
    assert learned_torque(x, P, h) == pytest.approx((h[of] @ x[of], np.sqrt(h[of] @ P[np.ix_(of, of)] @ h[of])))


@pytest.mark.parametrize(("sigmas", "trusted", "learns"), [(4.9, True, True), (5.1, True, False), (1.0, False, False)])
def test_a_torque_far_off_or_not_trusted_teaches_nothing(sigmas, trusted, learns):
    """One that is learned from counts by its variance; contact, stiffness and growth are in what is unexplained already."""
    rng = np.random.default_rng(6)
    x, h, P, gain = rng.standard_normal(STATES), rng.standard_normal(STATES), _covariance(rng), np.zeros(STATES)
    others = [i for i in range(STATES) if i not in OF_THE_MODEL]
    variance = 0.7
    total = h @ P @ h + variance
    innovation = sigmas * np.sqrt(total)
    expected = naive.update_errors(x, P, innovation, h, variance)[:2] if learns else (x.copy(), P.copy())
    found = learn(x, P, gain, h, innovation + h[others] @ x[others], variance, trusted)
    assert found == pytest.approx((innovation, total))
    np.testing.assert_allclose(x, expected[0])
    np.testing.assert_allclose(P, expected[1], atol=1e-9)


def _placed(p, x, contact, scale, growth, warmth, sigma=0.0, force=5000.0):
    s = new_state()[0]
    s["past_contact"], s["force"] = x, force
    a = s["alternatives"][STIFFNESS_JUMP]
    a["error"][[CONTACT, SCALE, GROWTH]], a["covariance"][CONTACT, CONTACT] = (contact, scale, growth), sigma**2
    place(s, a, p, 0.9, warmth)
    return a


def test_another_contact_or_stiffness_moves_the_force_along_the_curve(p):
    moved = -0.5 + 0.02 * 30.0
    before, there = naive.characteristic_curve(10.0, p["curve"]), naive.characteristic_curve(10.0 + moved, p["curve"])
    a = _placed(p, 10.0, 0.5, 0.2, 0.02, 30.0)
    assert a["shift"] == pytest.approx(1.2 * (5000.0 + 0.9 * (there[0] - before[0])) - 5000.0)
    assert a["slope"] == pytest.approx(0.9 * 1.2 * there[1])
    assert _placed(p, 10.0, 40.0, 0.0, 0.0, 0.0, force=3000.0)["shift"] == -3000.0, "no less than none"


def test_the_slope_of_a_contact_that_is_not_known_is_that_of_all_that_may_be(p):
    """At the kink of the curve, where a local slope would say that the contact angle cannot be seen; of three radians at
    most."""
    expected = []
    for sigma in (2.0, 3.0, 9.0):
        way = np.linspace(-min(sigma, 3.0), min(sigma, 3.0), 20_001)
        expected.append(0.9 * np.mean([naive.characteristic_curve(x - 0.2, p["curve"])[1] for x in way]))
        assert 0.5 * expected[-1] < _placed(p, 0.0, 0.2, 0.0, 0.0, 0.0, sigma)["slope"] < 2.0 * expected[-1]
    assert _placed(p, 0.0, 0.2, 0.0, 0.0, 0.0)["slope"] == 0.0
    assert _placed(p, 0.0, 0.2, 0.0, 0.0, 0.0, 3.0)["slope"] == _placed(p, 0.0, 0.2, 0.0, 0.0, 0.0, 9.0)["slope"]


@pytest.mark.parametrize("linear", [True, False])
def test_what_the_model_takes_over_changes_no_hypothesis(p, opened, linear):
    """Contact angle, stiffness, growth and force of every one are as before; what was an error is now the model's."""
    s, warmth, rng = opened[0], 40.0, np.random.default_rng(7)
    s["contact_angle"], s["past_contact"], s["growth"], s["scale"] = 9.0, 6.0, 1e-3, 1.1
    s["force"], s["slope"], s["drive"], s["held"], s["creep"] = 4000.0, 900.0, 4000.0, (3000.0, 5000.0), (0.02, -0.03)
    errors = [s["error"], *s["alternatives"]["error"]]
    for error in errors:
        error[[*OF_THE_MODEL, GAIN]] = rng.uniform(0.01, 0.1, 6)
    s["alternatives"]["shift"] = rng.uniform(-100.0, 100.0, ALTERNATIVES)

    def states():
        return [
            (
                s["contact_angle"] + x[CONTACT],
                s["scale"] * (1.0 + x[SCALE]),
                s["growth"] + x[GROWTH],
                x[GAIN],
                *(s["creep"] + x[[*CREEPS]]),
            )
            for x in errors
        ]

    before, x = states(), s["error"].copy()
    total = s["force"] + s["alternatives"]["shift"]
    place_ = s["past_contact"] + s["contact_angle"] - s["growth"] * warmth
    fold(s, warmth, linear)
    np.testing.assert_allclose(states(), before)
    assert not s["error"][[*OF_THE_MODEL]].any()
    np.testing.assert_allclose(s["force"] + s["alternatives"]["shift"], total)
    assert s["past_contact"] + s["contact_angle"] - s["growth"] * warmth == pytest.approx(place_)
    moved = 900.0 * (x[GROWTH] * warmth - x[CONTACT]) + 4000.0 * x[SCALE] + x[[*CREEPS]] @ (-1000.0, 1000.0)
    assert s["force"] == pytest.approx(4000.0 + (moved if linear else 0.0))


@pytest.mark.parametrize(("scale", "error", "expected"), [(2.9, 0.5, 3.0), (0.31, -0.5, 0.3)])
def test_no_stiffness_is_beyond_what_pads_can_have(opened, scale, error, expected):
    s = opened[0]
    s["scale"], s["error"][SCALE] = scale, error
    fold(s, 0.0, False)
    assert s["scale"] == expected


@pytest.mark.parametrize("error", [0.3, -0.3])
def test_no_creep_is_beyond_what_pads_can_have(opened, error):
    s = opened[0]
    s["creep"], s["error"][[*CREEPS]] = np.copysign(0.4, error), error
    fold(s, 0.0, False)
    assert s["creep"].tolist() == [np.copysign(0.5, error)] * 2


@pytest.mark.parametrize("share", [0.06, -0.06])
@pytest.mark.parametrize("seconds", [0.7, 2.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_pads_that_creep_otherwise_are_known_after_some_stops(p, share, seconds, seed):
    """The force that they gain or lose while they are held is not seen, only what they differ by when they are released; after
    eight stops it is known, and sigma has covered it from the first on."""
    path = brake.stops(p, 12, seed, held_s=3.0)
    rows, force = brake.samples(p, path, creep=(share, seconds))
    state = new_state()
    estimates = estimate(brake.noisy(rows, p, seed), p, state)
    error, sigma = estimates["force"] - force, estimates["sigma"]
    assert np.mean(np.abs(error) > 3.0 * np.hypot(sigma, 25.0)) < 0.01
    last = (np.arange(len(path)) > len(path) * 2 // 3) & (force > 500.0)
    assert np.sqrt(np.mean(error[last] ** 2)) < 100.0 and np.median(sigma[last]) < 100.0
    assert state[0]["creep"].sum() == pytest.approx(share, abs=0.03)


def test_a_change_that_is_likelier_than_none_shifts_the_force_by_itself(opened):
    a = opened[0]["alternatives"]
    a["shift"] = 10.0, 20.0, 30.0, 40.0, 50.0
    unlikely, likely, slightly = (-1.0, -0.1, -2.0, -np.inf, 9.0), (-1.0, 2.0, 1.0, 3.0, 9.0), (-1.0, 0.5, 0.1, -2.0, 9.0)
    for odds, shift in ((unlikely, 0.0), (likely, 40.0), (slightly, 20.0)):
        a["log_odds"] = odds
        assert likely_shift(opened[0]) == shift


def test_the_contact_angle_is_as_uncertain_as_all_changes_make_it(opened):
    s, rng = opened[0], np.random.default_rng(8)
    shares = np.array([0.1, 0.2, 0.05, 0.15])
    a = s["alternatives"]
    a["share"][:DRIFT], a["error"][:, CONTACT] = shares, rng.uniform(-1.0, 1.0, ALTERNATIVES)
    a["covariance"][:, CONTACT, CONTACT], s["covariance"][CONTACT, CONTACT] = rng.uniform(0.01, 0.1, ALTERNATIVES), 0.02
    square = a["error"][:DRIFT, CONTACT] ** 2 + a["covariance"][:DRIFT, CONTACT, CONTACT]
    assert contact_sigma(s) == pytest.approx(np.sqrt(shares @ square + 0.5 * 0.02))


@pytest.mark.parametrize("stiffness", [0.9, 0.94, 1.1])
@pytest.mark.parametrize("seed", [1, 2])
def test_other_pads_are_known_after_their_first_stop(p, stiffness, seed):
    """The way up, on which friction explains them as well, is weighed together with the way back."""
    other = p.copy()
    other["curve"] *= stiffness
    rows, force = brake.samples(other, brake.stops(p, 3, seed))
    estimates = estimate(brake.noisy(rows, p), p)
    error = (estimates["force"] - force)[_STOP:]
    assert np.mean(np.abs(error) < 2.0 * estimates["sigma"][_STOP:]) > 0.95
    assert np.sqrt(np.mean(error**2)) < 70.0


@pytest.mark.parametrize("noise_rad", [0.002, 0.008])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_noisy_angle_is_no_change(p, noise_rad, seed):
    """One to five counts of a resolver: what goes back and forth turns no friction over, so that the torque of a motor that
    stands speaks for no jump."""
    rows, force = brake.samples(p, brake.stops(p, 4, seed))
    rows = brake.noisy(rows, p)
    rows["angle"] += np.random.default_rng(seed).normal(0.0, noise_rad, len(rows))
    estimates = estimate(rows, p)
    error = estimates["force"] - force
    assert np.mean(np.abs(error) < 2.0 * estimates["sigma"]) > 0.97
    assert np.sqrt(np.mean(error**2)) < 40.0


def test_a_contact_angle_that_moved_is_expected_to_move_again(p, opened):
    """As far in the same time; and no more after some stops in which it stayed."""
    s = opened[0]

    def touch(moved):
        s["contact_angle"] += moved
        s["contact"]["engaged"], s["braked"] = True, False
        settle(s, p, False, 0.0)
        s["contact_age_s"] += 10.0

    for _ in range(10):
        touch(0.0)
    assert s["contact_walk"] == 0.0
    for stop in range(10):
        touch(1.0 if stop % 2 else -1.0)
    assert s["contact_walk"] == pytest.approx(1.0 / 10.0, rel=0.01)
    for _ in range(10):
        touch(0.0)
    assert s["contact_walk"] < 0.001
    # One that is counted from another released position has not moved.
    place_contact(s, p, 5.0)
    touch(0.0)
    assert s["contact_walk"] < 0.001


def _with_moving_contact(p, seed):
    """Share of samples beyond three sigma of twenty stops, the first five apart, each with knock-back by another amount: 20 um
    is their standard deviation."""
    rng = np.random.default_rng(seed)
    parts = []
    for stop in range(20):
        moved = p.copy()
        moved["clearance"] += 20e-6 / p["gear_gain"] * rng.standard_normal()
        parts.append(brake.samples(moved, brake.stops(p, 1, 100 * seed + stop)))
    rows, force = (np.concatenate(column) for column in zip(*parts, strict=True))
    rows["dt"] = 0.004
    rows["dt"][0] = 0.0
    estimates = estimate(brake.noisy(rows, p, seed), p)
    beyond = np.abs(estimates["force"] - force) > 3.0 * np.hypot(estimates["sigma"], 25.0)
    return np.mean(beyond[len(rows) // 4 :])


def test_a_contact_that_moves_from_stop_to_stop_is_covered_after_a_few(p):
    """It is neither held to be constant, nor taken for pads that creep."""
    assert np.mean([_with_moving_contact(p, seed) for seed in range(8)]) < 0.05


def test_whether_pads_that_are_apart_still_push_is_not_known(p):
    """What they would push with, because they creep, counts as a standard deviation."""
    rows, _ = brake.samples(p, brake.stops(p, 1))
    state = new_state()
    released = estimate(rows, p, state)[-1]
    state["creep"], state["held"] = (0.03, 0.02), (4000.0, 8000.0)
    creeps = estimate(rows[-1:], p, state)[0]
    assert released["sigma"] < 100.0 and creeps["sigma"] == pytest.approx(280.0, rel=0.1)


def test_what_creep_makes_of_a_longer_stop_than_any_before_is_not_known(p):
    """Pads that creep look in short stops like others that are stiffer. Each stop that ends shows half of what it held beyond
    those before; a brake that is not believed to creep has no such doubt."""
    rows, _ = brake.samples(p, brake.clamp(p, 3.0, 1.0))
    state = new_state()
    plain = estimate(rows, p, state)[-1]
    assert state["past_contact"] > 0.0
    sigmas = []
    for creep, shown in ((0.0, 0.0), (-0.1, 0.0), (-0.1, 5000.0), (-0.1, 10000.0)):
        changed = state.copy()
        changed["creep"], changed["held"], changed["held_shown"] = (0.0, creep), 10000.0, shown
        sigmas.append(estimate(rows[-1:], p, changed)[0]["sigma"])
    beside = np.sqrt(np.maximum(np.square(sigmas[1:]) - sigmas[3] ** 2, 0.0))
    assert sigmas[0] == pytest.approx(plain["sigma"], rel=0.2) and beside == pytest.approx([1000.0, 500.0, 0.0], rel=0.05)


def test_a_stop_that_ends_shows_half_of_what_it_held_the_pads_with_beyond_others(p):
    shown = []
    for count in (1, 2, 3):
        state = new_state()
        rows, _ = brake.samples(p, np.tile(brake.stops(p, 1, held_s=3.0), count))
        estimate(rows, p, state)
        assert state["stops"] == count and (state["held_now"] == 0.0).all()
        shown.append(state["held_shown"][0, 0])
    assert shown[0] > 500.0 and shown[1:] == pytest.approx([1.5 * shown[0], 1.75 * shown[0]], rel=0.05)


def test_what_pads_creep_is_known_after_a_restart(p):
    rows, _ = brake.samples(p, brake.stops(p, 4, 1, held_s=3.0), creep=(0.06, 0.7))
    rows, state, restarted, snapshot = brake.noisy(rows, p), new_state(), new_state(), np.zeros(1, restart.SNAPSHOT)[0]
    estimate(rows, p, state)
    assert restart.take_snapshot(state[0], p, snapshot)
    restart.resume(restarted[0], p, snapshot, 60.0)
    estimate(rows[:1], p, restarted)
    assert restarted[0]["creep"].sum() == state[0]["creep"].sum() == pytest.approx(0.06, abs=0.03)


@pytest.mark.parametrize("turning", [True, False])
def test_a_contact_may_drift_as_fast_as_a_disc_grows_once_something_has_certainly_changed(p, turning):
    walks = np.zeros((2, STATES))
    for changed in (False, True):
        add_drift_walks(walks[int(changed)], p, turning, changed, 60.0)
    assert np.sqrt(walks[1, CONTACT] / walks[0, CONTACT]) == pytest.approx(10.0 / 3.0)
    assert walks[1, SCALE] == walks[0, SCALE]
    if turning:
        assert np.sqrt(walks[1, CONTACT]) * p["gear_gain"] == pytest.approx(80e-6, rel=0.05)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("factor", "share"), [(0.9, 0.2), (1.0, 0.0), (1.12, 0.2)])
def test_a_first_stop_that_lasts_does_not_tell_a_torque_constant_from_pads(p, factor, seed, share):
    """Pads that are a tenth softer are likelier than a motor that is a tenth stronger, and what moves slowly shows nothing of
    the rotor, which could tell. Otherwise nine tenths of such a training lie beyond three sigma."""
    true = p.copy()
    true["torque_constant"] *= factor
    begin, held = np.linspace(0.0, p["clearance"] + 12.0, 1500), p["clearance"] + 9.0
    angle = np.concatenate((np.zeros(500), begin, held + 3.0 * np.cos(np.pi / 1000.0 * np.arange(6000))))
    rows, force = brake.samples(true, angle)
    estimates = estimate(brake.noisy(rows, p, seed), p)
    clamped = force > 2000.0
    off, sigma = np.abs(estimates["force"] - force)[clamped], estimates["sigma"][clamped]
    assert np.mean(off > 3.0 * sigma) <= share
    assert factor != 1.0 or np.mean(sigma) < 60.0


def test_friction_that_gives_energy_is_told(p):
    """A torque that helps at speed is no friction, whatever else explains the same force."""
    path = brake.stops(p, 12, 3)
    rows, _ = brake.samples(p, path)
    plain = estimate(brake.noisy(rows, p), p)
    rows["current_q"] -= 10.0 * p["offset_friction"] / p["maximum_speed"] / p["torque_constant"] * rows["speed"]
    helped = estimate(brake.noisy(rows, p), p)
    assert not np.any(plain["facts"] & BOUND_REACHED)
    assert np.mean(helped["facts"][len(path) // 4 :] & BOUND_REACHED != 0) > 0.95
