"""Going back: what strokes with a late or filtered signal have taught is not kept once that is found."""

import brake
import city
import numpy as np
import pytest
from test_training_rules import applied

from emb_daemon.estimator.contact import place_contact
from emb_daemon.estimator.hypotheses import PRIOR_ODDS, STIFFNESS_JUMP, TORQUE_JUMP
from emb_daemon.estimator.paths import shift_zero
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.rewind import STOPS, forget_stroke, go_back, keep, keep_all
from emb_daemon.models.fusion import CONTACT, CREEPS, LATE, OFFSET, SCALE, VISCOUS
from emb_daemon.offline import estimate


@pytest.fixture
def s(parameters):
    """The state of a brake after some stops."""
    p, state = brake.ideal(parameters), new_state()
    estimate(brake.noisy(brake.samples(p, brake.stops(p, 3))[0], p), p, state)
    keep_all(state[0])
    return state[0]


def _learn(s, by):
    """The brake seems to change by ``by`` steps, and not to have changed before."""
    s["contact_angle"] += 0.5 * by
    s["scale"] += 0.1 * by
    s["growth"] += 1e-4 * by
    s["creep"][:] += 0.01 * by
    s["jumps"] += by
    s["error"][VISCOUS] += 1e-3 * by
    s["covariance"][VISCOUS, VISCOUS] *= 1.0 + by


def _known(s):
    return [*(float(s[name]) for name in ("contact_angle", "scale", "growth", "jumps")), *s["creep"], s["error"][VISCOUS]]


@pytest.mark.parametrize("cycles", [2.0, 5.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_filter_that_the_current_comes_through_while_driving_leaves_nothing_behind(parameters, seed, cycles):
    """Eight milliseconds have passed for pads a quarter stiffer: 0.5 to 0.9 kN were left for good, at a stated 33 N."""
    samples, force = city.drive(seed, 80.0)
    plain, samples = estimate(samples, parameters), samples.copy()
    half = len(samples) // 2
    state = new_state()
    samples["current_q"][half:] = brake.filtered(samples["current_q"][half:], cycles)
    later = slice(len(samples) - 2500, None)
    error = (estimate(samples, parameters, state)["force"] - force)[later]
    assert state[0]["alignment"]["lag"] > 1.0 and state[0]["scale"] == pytest.approx(1.0, abs=0.005)
    assert np.sqrt(np.mean(error**2)) < np.sqrt(np.mean((plain["force"] - force)[later] ** 2)) + 25.0


@pytest.mark.parametrize("seed", [2, 3])
def test_nor_does_one_that_the_speed_comes_through(seed):
    """Eight milliseconds left 106 and 185 N."""
    half = len(city.drive(seed, 80.0)[0]) // 2

    def change(rows):
        rows["speed"][half:] = brake.filtered(rows["speed"][half:], 2.0)

    estimates, force = city.changed(change, seed, 80.0)
    assert np.sqrt(np.mean((estimates["force"] - force)[half + 1000 :] ** 2)) < 100.0


def test_what_was_known_some_stops_ago_is_known_again(parameters, s):
    known, variance = _known(s), float(s["covariance"][VISCOUS, VISCOUS])
    for by in range(1, STOPS):
        _learn(s, float(by))
        keep(s)
    s["alternatives"]["log_odds"] = 50.0
    s["error"][LATE], s["covariance"][LATE, LATE], s["covariance"][LATE, VISCOUS] = 0.4, 1e-4, 1e-9
    go_back(s, brake.ideal(parameters))
    # What was between current and angle is undone, and what is left of it unknown.
    assert s["error"][LATE] == 0.0 and s["covariance"][LATE, LATE] == pytest.approx(0.09)
    assert np.count_nonzero(s["covariance"][LATE]) == 1
    assert _known(s) == pytest.approx(known)
    assert s["error"][[CONTACT, SCALE, *CREEPS]] == pytest.approx(0.0) and s["covariance"][VISCOUS, VISCOUS] == variance
    # Nothing is suspected, and what was learned meanwhile is not gone back to.
    assert np.all(s["alternatives"]["log_odds"][[STIFFNESS_JUMP, TORQUE_JUMP]] <= PRIOR_ODDS)
    _learn(s, 1.0)
    go_back(s, brake.ideal(parameters))
    assert _known(s) == pytest.approx(known)


def test_what_each_stop_teaches_is_kept(parameters):
    """Other pads, which a few stops show: what is gone back to is the brake before them, and soon the one with them."""
    p, state = brake.ideal(parameters), new_state()
    stiffer = p.copy()
    stiffer["curve"] *= 1.15
    rows = brake.noisy(brake.samples(stiffer, brake.stops(p, 8))[0], p)
    estimate(rows[:700], p, state)
    assert state[0]["learned"]["scale"] == pytest.approx(1.0, abs=1e-3)
    estimate(rows[700:], p, state)
    assert state[0]["learned"]["scale"] == pytest.approx(1.15, abs=0.03)


def test_no_more_stops_are_gone_back_than_a_fault_takes_to_be_found(parameters, s):
    _learn(s, 1.0)
    known = _known(s)
    for by in range(STOPS):
        keep(s)
        _learn(s, 1.0 + by)
    go_back(s, brake.ideal(parameters))
    assert _known(s) == pytest.approx(known)


def test_what_the_clearance_shows_of_the_offset_is_kept(parameters, s):
    """It does not change quickly, so that neither a delay nor a filter matters."""
    s["error"][OFFSET], s["covariance"][OFFSET, OFFSET] = 0.3, 0.01**2
    go_back(s, brake.ideal(parameters))
    assert s["error"][OFFSET] == 0.3 and s["covariance"][OFFSET, OFFSET] == 0.01**2
    assert np.all(np.linalg.eigvalsh(s["covariance"]) > -1e-12)


def test_a_zero_that_moves_moves_what_is_gone_back_to(parameters, s):
    contact = float(s["contact_angle"])
    shift_zero(s, 2.0)
    _learn(s, 1.0)
    go_back(s, brake.ideal(parameters))
    assert s["contact_angle"] == pytest.approx(contact + 2.0)


def test_the_force_goes_back_with_a_disc_that_is_warm(parameters, s):
    """By the way that the contact moves back, and what the growth gone back to makes of the disc's warmth."""
    s["temperature_known"], s["disc"], s["growth_start"] = True, 150.0, 30.0
    contact, growth = float(s["contact_angle"]), float(s["growth"])
    _learn(s, 1.0)
    past_contact = float(s["past_contact"])
    go_back(s, brake.ideal(parameters))
    gained = s["past_contact"] - past_contact
    assert s["growth"] == pytest.approx(growth)
    assert gained == pytest.approx(-1e-4 * 120.0 + 0.5) and s["contact_angle"] == pytest.approx(contact)


def test_a_contact_that_was_placed_anew_is_not_gone_back_from(parameters, s):
    """The released position was seen since, whatever signals came late."""
    p = brake.ideal(parameters)
    place_contact(s, p, float(s["contact_angle"]) + 2.0)
    placed = float(s["contact_angle"])
    _learn(s, 1.0)
    go_back(s, p)
    assert s["contact_angle"] == pytest.approx(placed)


@pytest.mark.parametrize("kept", [True, False])
def test_a_training_is_not_gone_back_from(kept):
    """What was known before is of a brake with another curve, and the contact of the stroke stays."""
    _, trained, _, learned = applied(kept)
    known = _known(trained)
    _learn(trained, 1.0)
    go_back(trained, learned)
    assert _known(trained) == pytest.approx(known)


def _step_through_clearance(p):
    """Angles of a motor that jumps through most of the clearance after a second at rest, and later clamps slowly, with a
    sinusoid on top."""
    t, way, acceleration = 0.004 * np.arange(6000), 0.9 * p["clearance"], 5000.0
    speeding = np.sqrt(0.5 * way / acceleration)
    gained = np.clip(t - 1.0, 0.0, speeding)
    braking = acceleration / 3.0
    left = np.clip(t - 1.0 - speeding, 0.0, acceleration * speeding / braking)
    step = 0.5 * acceleration * gained**2 + acceleration * speeding * left - 0.5 * braking * left**2
    s = np.clip(t - 3.0, 0.0, 20.0)
    return step + 10.0 * (1.0 - np.cos(0.1 * np.pi * s)) + 0.9 * np.sin(10.0 * np.pi * s)


@pytest.mark.parametrize("limit_A", [2.0, 3.0, 5.0])
def test_a_current_sensor_that_ends_early_teaches_nothing_in_its_first_stroke(parameters, limit_A):
    """What accelerated the motor beyond the sensor's limit had passed for an offset of the current, then for a contact in the
    clearance: up to 13 kN, and a tenth of the samples running."""
    p = brake.ideal(parameters)
    samples, force = brake.samples(p, _step_through_clearance(p))
    samples = brake.noisy(samples, p)
    np.clip(samples["current_q"], -limit_A, limit_A, out=samples["current_q"])
    estimates = estimate(samples, p)
    error = (estimates["force"] - force)[25:]
    assert np.max(np.abs(error)) < 150.0
    assert np.all(np.abs(error) < 3.0 * np.hypot(estimates["sigma"][25:], 25.0))


def test_of_a_stroke_that_is_forgotten_the_stops_before_are_kept(s, parameters):
    """The offset of the current too is what it was; later faults can still go back further."""
    _learn(s, 1)
    keep(s)
    before, offset = _known(s), float(s["error"][OFFSET])
    earlier = s["learned"].copy()
    _learn(s, 2)
    s["error"][OFFSET] += 0.1
    s["alternatives"]["log_odds"] = 9.0
    forget_stroke(s, brake.ideal(parameters))
    assert _known(s) == pytest.approx(before) and s["error"][OFFSET] == offset
    assert np.all(s["alternatives"]["log_odds"] < 0.0)
    assert np.array_equal(s["learned"], earlier)


@pytest.mark.parametrize("way", [go_back, forget_stroke])
def test_who_collects_a_training_hears_of_it(s, parameters, way):
    before = int(s["rewinds"])
    way(s, brake.ideal(parameters))
    assert s["rewinds"] == before + 1
