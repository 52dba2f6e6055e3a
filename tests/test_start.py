"""Power-on: where the contact is unknown until the brake was seen released, and what ends that."""

import brake
import numpy as np
import pytest

from emb_daemon.calibration.terms import Term, fill_terms
from emb_daemon.estimator import restart
from emb_daemon.estimator.contact import _start_clamped, seek_release
from emb_daemon.estimator.records import ESTIMATE, new_state
from emb_daemon.estimator.status import TORQUE_OLD
from emb_daemon.estimator.step import step
from emb_daemon.models.fusion import CONTACT, FAST, NOISE, OFFSET, SCALE
from emb_daemon.models.stiffness import characteristic_curve, travel_at
from emb_daemon.models.thermal import stiffness_factor
from emb_daemon.offline import estimate
from emb_daemon.wire import contract as r


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _clamped(p, past_contact, seconds=2.0, current=True):
    """Rows of a brake that stands ``past_contact`` rad past contact from the first sample on, and its force."""
    up = brake.clamp(p, past_contact, 1.0)
    rows, force = brake.samples(p, np.concatenate([up, np.full(round(seconds / 0.004), up[-1])]))
    rows, force = rows[len(up) + 100 :].copy(), force[len(up) + 100 :]
    if not current:
        rows["current_q"] = 0.0
    rows["dt"][0] = 0.0
    return rows, force


def _standing(p):
    return brake.samples(p, np.zeros(250))


def _unknown(estimates):
    return (estimates["reasons"] & r.CONTACT_UNCERTAIN) != 0


def _rms(values):
    return np.sqrt(np.mean(values**2))


def _covered(estimates, force):
    return np.all(np.abs(estimates["force"] - force) < 3.0 * estimates["sigma"])


def test_a_released_brake_is_known_from_the_first_sample_on(p):
    """Nobody brakes, the park brake is off: the clearance counts from where the motor stands, and the first stroke is
    answered by both paths."""
    rows, force = brake.samples(p, np.concatenate([np.zeros(50), brake.clamp(p, 15.0, 0.3)]))
    estimates = estimate(rows, p)
    assert not np.any(_unknown(estimates)) and not np.any(estimates["source"][1:] == r.TORQUE_ONLY)
    assert _covered(estimates, force)


@pytest.mark.parametrize("past_contact", [4.0, 12.0, 22.0])
@pytest.mark.parametrize(("name", "value"), [("park_brake", 1.0), ("brake_request", 4000.0), ("has_status", False)])
def test_a_brake_that_may_be_clamped_says_so(p, name, value, past_contact):
    """Park brake applied, brake requested or nothing heard of either: the torque alone, Degraded, for as long as that
    lasts."""
    rows, force = _clamped(p, past_contact)
    rows[name] = value
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)) and np.all(estimates["source"] == r.TORQUE_ONLY)
    assert _covered(estimates, force)


@pytest.mark.parametrize("lost", [[1], [2], [3], [25], [26], [27], [1, 3], [2, 4, 6], range(1, 13), range(1, 40)])
def test_samples_that_are_lost_after_power_on_open_no_brake(p, lost):
    """Silently 7 kN wrong in a drive: after the gap it passed for a log at a reduced rate, which begins with an open brake."""
    rows, force = _clamped(p, 12.0)
    rows["brake_request"] = 4000.0
    time_s = np.delete(np.cumsum(rows["dt"]), lost)
    rows, force = np.delete(rows, lost), np.delete(force, lost)
    rows["dt"][1:] = np.diff(time_s)
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)) and np.all(estimates["source"] == r.TORQUE_ONLY)
    assert _covered(estimates, force)


@pytest.mark.parametrize(("name", "value"), [("park_brake", 1.0), ("has_status", False)])
@pytest.mark.parametrize("past_contact", [6.0, 14.0, 22.0])
def test_a_latched_brake_needs_no_current_and_sigma_covers_that(p, name, value, past_contact):
    """3 to 20 kN without any current: not zero with a small sigma."""
    rows, force = _clamped(p, past_contact, current=False)
    rows[name] = value
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)) and _covered(estimates, force)


def test_a_clamped_brake_that_says_it_is_released_gives_itself_away(p):
    """Status says released, yet the motor holds 8 kN: noticed within a tenth of a second, by the torque that it takes, for the
    second that a motor may need to open."""
    rows, force = _clamped(p, 15.0, seconds=1.3)
    assert 0.8 < 0.004 * len(rows) < 1.0
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)[26:])
    assert np.all(estimates["source"][26:] == r.TORQUE_ONLY) and _covered(estimates[26:], force[26:])


def _latched_then(p):
    """Latched at 22 rad past contact for a second, opened within a second, standing for a second, clamped again."""
    top = p["clearance"] + 22.0
    up, down = brake.clamp(p, 22.0, 1.0), np.linspace(top, 0.0, 250)
    path = np.concatenate([up, np.full(350, top), down, np.zeros(250), brake.clamp(p, 15.0, 0.5)])
    rows, force = brake.samples(p, path)
    first = len(up) + 100
    rows, force = rows[first:].copy(), force[first:]
    rows["dt"][0] = 0.0
    rows["current_q"][:200] = 0.0
    rows["park_brake"][:240] = 1.0
    return rows, force, 250 + len(down)


def test_what_was_latched_is_known_once_it_was_seen_released(p):
    """Park brake off, nobody brakes, no torque, and the motor stands: from there the clearance counts, within a quarter
    second."""
    rows, force, stands = _latched_then(p)
    estimates = estimate(rows, p)
    unknown = np.flatnonzero(_unknown(estimates))
    assert np.array_equal(unknown, np.arange(unknown[-1] + 1)) and stands < unknown[-1] < stands + 60
    assert _covered(estimates, force)
    known = estimates[unknown[-1] + 60 :]
    assert np.all(known["source"] == r.FUSED) and known["sigma"][-1] < 300.0
    assert np.abs(known["force"] - force[unknown[-1] + 60 :]).max() < 100.0


@pytest.mark.parametrize(("name", "value"), [("park_brake", 1.0), ("brake_request", 2000.0), ("has_status", False)])
def test_while_somebody_may_brake_standing_still_is_no_release(p, name, value):
    rows, _, _ = _latched_then(p)
    rows[name] = value
    assert np.all(_unknown(estimate(rows, p)))


def test_a_way_back_to_where_it_started_clamped_is_no_clearance(p):
    """Started lightly clamped, opened for a moment between two stops and closed again: that nothing opposes it up to where it
    started says nothing of the way from there. Silently 9 kN wrong on a drawn drive otherwise."""
    up = brake.clamp(p, 3.0, 1.0)
    open_rad, top = p["clearance"] - 5.0, p["clearance"] + 15.0
    ways = [(up[-1], 350), (open_rad, 100), (up[-1], 200), (top, 40), (top, 100)]
    path = [up]
    for target, count in ways:
        path.append(np.linspace(path[-1][-1], target, count + 1)[1:])
    rows, force = brake.samples(p, np.concatenate(path))
    first = len(up) + 100
    rows, force = rows[first:].copy(), force[first:]
    rows["dt"][0] = 0.0
    rows["brake_request"] = 2000.0
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)) and _covered(estimates, force)


def test_a_motor_that_moves_or_holds_is_not_released(p):
    """Slow opening without a stop, and a hold under torque with everything released in the status."""
    rows, _, _ = _latched_then(p)
    moving = rows[: 100 + 240].copy()
    assert np.all(_unknown(estimate(moving, p)))
    holding, _ = _clamped(p, 15.0, seconds=2.5)
    holding["park_brake"][: len(holding) - 240] = 1.0
    assert np.all(_unknown(estimate(holding, p))), "the second counts from the status on"


@pytest.mark.parametrize("flicker", [0.0, 5e-4])
def test_a_current_that_flows_in_no_motor_is_an_offset(p, flicker):
    """A brake that stands released for a second holds nothing, whatever its current reads, and by how many counts its angle
    flickers: known again, and the first stroke is right."""
    rows, force = brake.samples(
        p, np.concatenate([np.zeros(400), brake.clamp(p, 15.0, 0.5), np.full(100, p["clearance"] + 15.0)])
    )
    rows["current_q"] += 3.0
    rows["angle"] += flicker * np.random.default_rng(1).standard_normal(len(rows))
    estimates = estimate(brake.noisy(rows, p), p)
    unknown = np.flatnonzero(_unknown(estimates[:400]))
    assert 240 < unknown[-1] < 300
    assert _covered(estimates, force) and np.abs(estimates["force"] - force)[300:].max() < 300.0


def test_status_that_comes_late_ends_it(p):
    rows, _ = _standing(p)
    rows["has_status"][:100] = False
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)[:100]) and not np.any(_unknown(estimates)[128:])


def test_unknown_and_no_current_leaves_nothing(p):
    rows, _ = _standing(p)
    rows["park_brake"], rows["has_current"] = 1.0, False
    estimates = estimate(rows, p)
    assert np.all(estimates["source"] == r.INVALID) and np.all(estimates["mode"] == r.FAULT)


def test_nothing_is_learned_while_the_contact_is_unknown(p):
    rows, _, _ = _latched_then(p)
    rows["park_brake"] = 1.0
    estimates = estimate(rows, p)
    assert np.all(estimates["stiffness_factor"] == estimates["stiffness_factor"][0])


def test_a_brake_that_friction_holds_at_a_request_may_be_clamped(p):
    """A drag of 1.6 kN with hardly any current: less torque than friction alone, from a motor that stands."""
    rows, force = _clamped(p, 4.0, current=False)
    rows["brake_request"] = 1.0
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates)) and np.all(estimates["source"] == r.TORQUE_ONLY)
    assert _covered(estimates, force)


@pytest.mark.parametrize("seen", [0.3, 0.6, 0.9])
def test_a_motor_that_closes_at_power_on_comes_from_where_nobody_knows(p, seen):
    """Power comes in the middle of a stroke through the clearance: the contact is nearer than from a released position."""
    up = brake.clamp(p, 15.0, 0.6)
    first = int(np.flatnonzero(up >= seen * p["clearance"])[0])
    down = up[::-1]
    rows, force = brake.samples(p, np.concatenate([up, np.full(250, up[-1]), down, np.zeros(500), up]))
    rows, force = rows[first:].copy(), force[first:]
    rows["dt"][0] = 0.0
    rows["brake_request"] = 1.0
    released = slice(len(up) + 250 + len(down) - first, len(up) + 750 + len(down) - first)
    rows["brake_request"][released] = 0.0
    estimates = estimate(rows, p)
    assert _covered(estimates, force)
    assert np.all(_unknown(estimates)[: released.start]) and not np.any(_unknown(estimates)[released.start + 100 :])


def test_a_log_at_a_reduced_rate_that_begins_on_the_way_has_its_released_position_later(p):
    """Ten samples a second, the first of a motor that has closed by 0.3 rad already: the first release shows from where."""
    up = brake.clamp(p, 12.0, 1.0, dt=0.1)
    path = np.concatenate([up + 0.3 * (up < up[-1]), np.full(20, up[-1]), up[::-1], np.zeros(20)])
    rows, force = brake.samples(p, np.concatenate([path, up]), dt=0.1)
    rows["brake_request"] = force > 50.0
    estimates = estimate(rows, p)
    assert estimates["contact_angle"][len(up)] - p["clearance"] == pytest.approx(0.3, abs=0.2)
    assert estimates["contact_angle"][len(path)] - p["clearance"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("begins", ["released", "clamped"])
def test_what_pads_may_remember_of_a_stop_before_the_start_is_covered_until_they_have_forgotten_it(p, begins):
    """They relax over three seconds, and the power comes as a stop of a quarter of the largest force ends, or within it."""
    p["effects"]["second_relaxation"]["share"], p["effects"]["second_relaxation"]["time_constant_s"] = 0.1, 3.0
    top = p["clearance"] + travel_at(0.25 * p["maximum_force"], p["curve"])
    up, held, released = top * np.linspace(0.0, 1.0, 100), np.full(2000, top), np.zeros(10_000)
    rows, force = brake.samples(p, np.concatenate([up, held, up[::-1], released]), creep=(0.1, 3.0))
    rows["brake_request"][: len(rows) - len(released)] = 4000.0
    first = len(rows) - len(released) + (25 if begins == "released" else -400)
    rows, force = brake.noisy(rows, p)[first:], force[first:]
    rows["dt"][0] = 0.0
    estimates = estimate(rows, p)
    open_s = 0.004 * (np.arange(len(rows)) - (len(rows) - len(released)))
    early, late = (open_s > 0.2) & (open_s < 2.0), open_s > 25.0
    error = np.abs(estimates["force"] - force)
    assert error[early].min() > 5.0 * p["stiffness_sigma"]
    assert _covered(estimates, force)
    assert np.all(estimates["sigma"][late] < 1.1 * p["stiffness_sigma"]) and error[late].max() < p["stiffness_sigma"]


def test_what_pads_that_yielded_before_the_start_press_less_in_the_next_stop_is_covered(p):
    """They yield over twenty seconds, and nobody has seen the first stop; a second later they are pressed as far again."""
    p["effects"]["stress_relaxation"]["share"], p["effects"]["stress_relaxation"]["time_constant_s"] = 0.1, 20.0
    top = p["clearance"] + travel_at(0.25 * p["maximum_force"], p["curve"])
    up, held, released = top * np.linspace(0.0, 1.0, 100), np.full(3000, top), np.zeros(400)
    stop = np.concatenate([up, held, up[::-1], released])
    rows, force = brake.samples(p, np.concatenate([stop, stop]), creep=(-0.1, 20.0))
    second = len(stop) - 300
    rows, force = brake.noisy(rows, p)[second:], force[second:]
    rows["dt"][0] = 0.0
    estimates = estimate(rows, p)
    high = force > 0.2 * p["maximum_force"]
    assert np.max(np.abs(estimates["force"] - force)[high]) > 3.0 * p["stiffness_sigma"]
    assert _covered(estimates, force)


def test_what_pads_remember_of_a_stop_that_a_frozen_resolver_has_not_shown_is_covered(p):
    """They relax over three seconds. The angle freezes, with noise in the speed, before a stop, and goes on at its end."""
    p["effects"]["second_relaxation"]["share"], p["effects"]["second_relaxation"]["time_constant_s"] = 0.1, 3.0
    path = brake.stops(p, 4, held_s=4.0)
    rows, force = brake.samples(p, path, creep=(0.1, 3.0))
    rows = brake.noisy(rows, p)
    stop = len(path) // 4
    frozen = slice(2 * stop, 2 * stop + int(np.flatnonzero(force[2 * stop : 3 * stop] > 1000.0)[-1]) - 100)
    rows["angle"][frozen] = rows["angle"][2 * stop - 1]
    rows["speed"][frozen] = np.random.default_rng(1).normal(0.0, p["speed_sigma"], frozen.stop - frozen.start)
    estimates = estimate(rows, p)
    back = np.arange(len(rows)) > frozen.stop
    error = np.abs(estimates["force"] - force)
    usable = estimates["source"] != r.INVALID
    assert np.mean((error > 3.0 * np.hypot(estimates["sigma"], 25.0))[back & usable]) < 0.01
    believed = back & (estimates["source"] == r.FUSED)
    assert np.mean(believed[frozen.stop :]) > 0.5


def test_after_a_restart_the_time_since_the_snapshot_tells_what_pads_may_remember(p):
    """A daemon that ran ten seconds ago may have stopped just after a stop; one that ran a quarter of an hour ago has not."""
    p["effects"]["second_relaxation"]["share"], p["effects"]["second_relaxation"]["time_constant_s"] = 0.1, 3.0
    rows, _ = brake.samples(p, brake.stops(p, 2), creep=(0.1, 3.0))
    state, snapshot = new_state(), np.zeros(1, restart.SNAPSHOT)[0]
    estimate(rows, p, state)
    assert restart.take_snapshot(state[0], p, snapshot)
    rested, sigmas = _standing(p)[0], {}
    for elapsed_s in (10.0, 11.0, 900.0):
        restarted = new_state()
        restart.resume(restarted[0], p, snapshot, elapsed_s)
        sigmas[elapsed_s] = estimate(rested, p, restarted)["sigma"][1]
    assert sigmas[10.0] > 1.3 * estimate(rested, p)["sigma"][1] and sigmas[900.0] < 1.1 * p["stiffness_sigma"]
    assert sigmas[11.0] < 0.9 * sigmas[10.0], "a second later they have forgotten a third of it"


_WARMS = Term(
    name="term:x", port="gear_friction", signal="disc_speed", memory="response", shape="odd_power", scale=40.0,
    coefficient=0.5, memory_scale=20.0, low=0.0, high=40.0, memory_low=0.0, memory_high=0.5,
)  # fmt: skip


@pytest.mark.parametrize(("elapsed_s", "left"), [(1.0, 0.95), (20.0, 0.37), (3600.0, 0.0)])
def test_what_terms_remember_outlasts_a_restart_by_its_own_time(p, elapsed_s, left):
    """Grease that a fast disc has warmed is warm when a daemon is back after a second, and not after an hour."""
    fill_terms(p["effects"]["terms"], (_WARMS,))
    rows, state, snapshot = _standing(p)[0], new_state(), np.zeros(1, restart.SNAPSHOT)[0]
    rows["has_wheel_speed"], rows["wheel_speed"] = True, 40.0
    estimate(rows, p, state)
    warm = state[0]["effects"]["terms"]["memory"][0]
    assert warm > 0.1 and restart.take_snapshot(state[0], p, snapshot) and not restart.why_implausible(snapshot, p)
    restarted = new_state()
    restart.resume(restarted[0], p, snapshot, elapsed_s)
    rows["wheel_speed"] = 0.0
    estimate(rows[:1], p, restarted)
    assert restarted[0]["effects"]["terms"]["memory"][0] == pytest.approx(left * warm, abs=0.01 * warm)
    snapshot["terms_memory"][0] = 0.5 + 11.0 * 0.5
    assert restart.why_implausible(snapshot, p) == "terms_memory"


@pytest.mark.parametrize(("elapsed_s", "disc", "pads"), [(0.1, 200.0, 197.3), (300.0, 141.0, 69.4)])
def test_after_a_restart_pads_and_disc_have_cooled_for_as_long_as_they_rested(p, elapsed_s, disc, pads):
    """Out of 200 degC, under plates of 20; softening goes on by its own time constant to what the pads were."""
    s, snapshot, out, first = new_state()[0], np.zeros(1, restart.SNAPSHOT)[0], np.zeros(1, ESTIMATE)[0], _standing(p)[0][0]
    step(s, p, first, out)
    s["disc"], s["pads"], s["history"], p["thermal"]["history_time"] = 200.0, 200.0, 50.0, 100.0
    s["contact_angle"] += 0.1
    assert restart.take_snapshot(s, p, snapshot) and snapshot["clearance"] == pytest.approx(p["clearance"] + 0.1)
    resumed = new_state()[0]
    restart.resume(resumed, p, snapshot, elapsed_s)
    assert resumed["error"][FAST] == resumed["error"][NOISE] == 0.0, "of the moment alone"
    assert (resumed["temperature_sigma"] - s["temperature_sigma"] > 10.0) == (elapsed_s > 100.0)
    step(resumed, p, first, out)
    assert resumed["disc"] == pytest.approx(disc, abs=0.5) and resumed["mean"] == pytest.approx([pads, pads], abs=0.5)
    rise = 200.0 - p["thermal"]["reference"]
    assert resumed["history"] == pytest.approx(rise + (50.0 - rise) * np.exp(-elapsed_s / 100.0), abs=0.1)
    softened = stiffness_factor(p["thermal"], pads - p["thermal"]["reference"], resumed["history"])
    assert resumed["factor"] == pytest.approx(softened, abs=5e-4)


def test_an_error_of_ten_sigma_is_no_brakes(p):
    s, snapshot, widest = new_state()[0], np.zeros(1, restart.SNAPSHOT)[0], new_state()[0]
    estimate(_standing(p)[0], p, s.reshape(1))
    assert restart.take_snapshot(s, p, snapshot)
    restart._widen(widest, p)
    sigma = np.sqrt(np.diag(widest["covariance"]) + np.diag(snapshot["covariance"]))
    for sigmas, told in ((9.9, ""), (-10.1, "error")):
        snapshot["error"] = sigmas * sigma
        assert restart.why_implausible(snapshot, p) == told


def _snapshot(p):
    """SNAPSHOT of a brake that has just been switched on."""
    s, snapshot = new_state()[0], np.zeros(1, restart.SNAPSHOT)[0]
    step(s, p, _standing(p)[0][0], np.zeros(1, ESTIMATE)[0])
    assert restart.take_snapshot(s, p, snapshot)
    return snapshot


@pytest.mark.parametrize(
    ("name", "possible", "impossible"),
    [
        ("clearance_sigma", (0.0, 20.0), (-1e-6, 30.0)),
        ("scale", (0.6, 1.6), (0.0, 9.0)),
        ("growth", (0.06, -0.06), (0.07, -0.07)),
        ("winding", (0.0, 4.0), (-0.01, 4.01)),
        ("housing", (0.0, 4.0), (-0.01, 4.01)),
        ("filtered", (0.0, 0.048), (-0.001, 0.05)),
        ("pads", (-60.0, 1200.0), (-61.0, 1201.0)),
        ("disc", (-60.0, 1200.0), (-61.0, 1201.0)),
        ("growth_start", (-60.0, 1200.0), (-61.0, 1201.0)),
        ("history", (-1200.0, 1200.0), (-1201.0, 1201.0)),
        ("temperature_sigma", (0.0, 1200.0), (-0.1, 1201.0)),
        ("history_sigma", (0.0, 1200.0), (-0.1, 1201.0)),
    ],
)
def test_what_no_brake_can_be_is_named(p, name, possible, impossible):
    """Contact within a millimetre of the calibration's, growth up to ten times that of an iron disc, temperatures that a pad
    survives, heat and filters as large as they get."""
    p["gear_gain"] = 4e-5
    for values, told in ((possible, ""), (impossible, name)):
        for value in values:
            snapshot = _snapshot(p)
            snapshot[name] = value
            assert restart.why_implausible(snapshot, p) == told, value


@pytest.mark.parametrize(
    ("correlation", "told"), [(0.99, ""), (-1.0, ""), (1.1, "covariance"), (-1.5, "covariance"), (np.nan, "covariance")]
)
def test_errors_that_are_correlated_by_more_than_all_are_no_brakes(p, correlation, told):
    snapshot = _snapshot(p)
    sigma = np.sqrt(np.diag(snapshot["covariance"]))
    snapshot["covariance"] = np.diag(sigma**2)
    snapshot["covariance"][CONTACT, SCALE] = snapshot["covariance"][SCALE, CONTACT] = (
        correlation * sigma[CONTACT] * sigma[SCALE]
    )
    assert restart.why_implausible(snapshot, p) == told


def test_temperatures_of_pads_that_were_never_known_may_be_anything(p):
    snapshot = _snapshot(p)
    snapshot["temperature_known"], snapshot["disc"] = False, 9e9
    assert restart.why_implausible(snapshot, p) == ""
    s = new_state()[0]
    restart.resume(s, p, snapshot, 100.0)
    assert s["temperature_sigma"] == 0.0, "of what was not known nothing is less certain"


# The search alone.


@pytest.fixture
def unknown(p):
    """STATE of a brake that started clamped, and a SAMPLE of its motor, which stands; nobody brakes."""
    s, m = new_state()[0], _standing(p)[0][1]
    step(s, p, m, np.zeros(1, ESTIMATE)[0])
    s["seen"], s["unknown"], s["since_start_s"] = True, True, 1.0
    return s, m


def _known_after(s, p, m, seconds):
    """Time (s) after which the contact is known, infinite if it is not within ``seconds``."""
    for number in range(round(seconds / 0.004)):
        seek_release(s, p, m)
        if not s["unknown"]:
            return 0.004 * (number + 1)
    return np.inf


@pytest.mark.parametrize(("share", "after_s"), [(0.0, 0.1), (0.025, 0.1), (-0.025, 0.1), (0.035, 1.0), (-0.2, 1.0)])
def test_a_motor_that_stands_released_is_known_in_a_tenth_of_a_second_without_torque_and_in_one_with(
    p, unknown, share, after_s
):
    """Beyond friction, 3 % of what the largest force needs are an ordinary sensor's offset; what is more is one, too, if it
    lasts, and is known to be one from then on."""
    s, m = unknown
    torque = share * p["gear_gain"] * p["maximum_force"] + np.sign(share) * p["offset_friction"]
    s["plausibility"]["torque_mean"], m["angle"] = torque, s["angle"]
    offset = float(s["error"][OFFSET])
    assert _known_after(s, p, m, 2.0) == pytest.approx(after_s, abs=0.005)
    assert s["contact_angle"] == pytest.approx(m["angle"] + p["clearance"])
    assert s["error"][OFFSET] - offset == pytest.approx(torque if after_s == 1.0 else 0.0)


@pytest.mark.parametrize(
    ("name", "value"), [("park_brake", 1.0), ("brake_request", 1.0), ("has_status", False), ("angle", None)]
)
def test_where_somebody_may_brake_or_the_motor_moves_nothing_is_known(p, unknown, name, value):
    s, m = unknown
    m[name] = s["angle"] + 0.01 if value is None else value
    assert _known_after(s, p, m, 3.0) == np.inf


@pytest.mark.parametrize(("share", "after_s"), [(0.2, 0.1), (0.4, 10.0)])
def test_a_motor_that_has_closed_since_it_was_open_further_may_press_lightly(p, unknown, share, after_s):
    s, m = unknown
    m["angle"] = s["angle"]
    s["lowest"] = s["angle"] - share * p["clearance"]
    assert _known_after(s, p, m, 11.0) == pytest.approx(after_s, abs=0.01)


@pytest.mark.parametrize(("share", "known"), [(0.2, True), (0.4, False)])
@pytest.mark.parametrize("stood", [True, False])
def test_who_closes_from_where_it_paused_half_open_tells_nothing(p, unknown, share, known, stood):
    """Neither if it pauses there, nor if it has been open further since."""
    s, m = unknown
    m["brake_request"], m["angle"], s["friction_mean"], s["stood_s"] = 1.0, s["angle"], 1.0, 2.0
    s["start_angle"], s["lowest"] = np.inf if stood else s["angle"], s["angle"] - share * p["clearance"]
    for angle in s["angle"] + np.linspace(0.0, 0.5 * p["clearance"], 100):
        m["angle"] = angle
        seek_release(s, p, m)
    assert s["unknown"] != known


def test_a_light_brake_that_nobody_requests_is_not_where_the_brake_is_open(p):
    """Opened for too short a time to be seen, then held at 300 N without a request: 0 N at a sigma of 26 N for the next drags,
    as a drive began whose daemon was restarted in a jam."""
    rest, light = 0.0, p["clearance"] + 1.5
    up = brake.clamp(p, 12.0, 0.5)
    opened = [np.full(200, up[-1]), np.linspace(up[-1], rest, 100), np.full(15, rest)]
    pressed = [np.linspace(rest, light, 40), np.full(1000, light), np.linspace(light, rest, 40), np.full(100, rest)]
    rows, force = brake.samples(p, np.concatenate([up, *opened, *pressed]))
    first = len(up) + 100
    rows, force = rows[first:].copy(), force[first:]
    rows["dt"][0], rows["brake_request"][:220] = 0.0, 4000.0
    estimates = estimate(rows, p)
    assert _covered(estimates, force)
    assert np.all(_unknown(estimates)[:-80]) and not _unknown(estimates)[-1]


@pytest.mark.parametrize(("share", "torque_share", "known"), [(0.5, 0.0, True), (0.25, 0.0, False), (0.5, 0.03, False)])
def test_who_closes_through_a_third_of_the_clearance_without_any_force_was_released(p, unknown, share, torque_share, known):
    s, m = unknown
    m["brake_request"], s["start_angle"], s["friction_mean"] = 1.0, s["angle"], 1.0
    s["balance"] = torque_share * p["gear_gain"] * p["maximum_force"]
    begun = float(s["start_angle"])
    for angle in begun + np.linspace(0.0, share * p["clearance"], 100):
        m["angle"] = angle
        seek_release(s, p, m)
    assert s["unknown"] != known
    if known:
        assert s["contact_angle"] == pytest.approx(begun + p["clearance"])


@pytest.mark.parametrize("status", [False, True])
def test_while_only_the_contact_is_unknown_friction_follows_the_motion(p, status):
    """A brake that starts on its way and never stands released: the torque less the friction of its motion, not all of it."""
    way = np.concatenate([brake.clamp(p, 12.0, 4.0), brake.clamp(p, 12.0, 4.0)[::-1]])
    rows, force = brake.samples(p, way)
    rows, force = rows[300:].copy(), force[300:]
    rows["dt"][0], rows["has_status"], rows["brake_request"] = 0.0, status, 1000.0
    estimates = estimate(rows, p)
    moving = _unknown(estimates) & (np.abs(rows["speed"]) > 1.0) & (np.arange(len(rows)) > 100)
    friction = (p["offset_friction"] + p["load_friction"] * force) / p["gear_gain"]
    assert moving.sum() > 1000 and _rms((estimates["force"] - force)[moving]) < 0.3 * _rms(friction[moving])
    assert _covered(estimates, force)
    # What answers is not said to be silent.
    assert not np.any(estimates["facts"][_unknown(estimates)] & TORQUE_OLD)


def test_a_torque_at_power_on_may_be_a_clamped_brake_or_an_offset_of_as_much(p, unknown):
    """The force is what the torque says; contact and offset are wrong together, or neither is."""
    s, m = unknown
    leverage, torque = p["gear_gain"] + p["load_friction"], 0.3
    before = float(s["covariance"][OFFSET, OFFSET])
    _start_clamped(s, p, m, torque, 0.01, leverage)
    P, (force, slope) = s["covariance"], characteristic_curve(s["past_contact"], p["curve"])
    assert s["force"] == pytest.approx(torque / leverage, rel=1e-3) == pytest.approx(s["factor"] * force, rel=1e-3)
    assert s["contact_angle"] + s["past_contact"] == pytest.approx(s["angle"])
    assert P[OFFSET, OFFSET] == pytest.approx(before + torque**2)
    assert (
        P[CONTACT, OFFSET]
        == P[OFFSET, CONTACT]
        == pytest.approx(P[OFFSET, OFFSET] / (leverage * s["factor"] * slope), rel=1e-3)
    )
    assert P[CONTACT, CONTACT] * P[OFFSET, OFFSET] >= P[CONTACT, OFFSET] ** 2


def _silent(p, silent_s, zero=0.0, held=False):
    """Rows of five stops, the motor's controller silent for ``silent_s`` s in the third, while it closes or while it holds,
    and counting from ``zero`` rad afterwards; the force, the row after the silence, and that of the next release."""
    path = brake.stops(p, 5, held_s=2.0)
    rows, force = brake.samples(p, path)
    rows = brake.noisy(rows, p)
    stop = len(path) // 5
    begin = 2 * stop + int(np.flatnonzero(force[2 * stop : 3 * stop] > 100.0)[0]) + (125 if held else 0)
    end = begin + round(silent_s / 0.004)
    rows["brake_request"] = np.where(force > 1.0, 4000.0, 0.0)
    rows["angle"][end:] += zero
    rows["dt"][end], rows["was_silent"][end] = (end - begin + 1) * 0.004, True
    gone = np.arange(begin, end)
    release = end + int(np.flatnonzero(path[end:] < 0.5 * p["clearance"])[0])
    return np.delete(rows, gone), np.delete(force, gone), begin, release - len(gone)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("zero", [-37.0, 8.0, 60.0])
@pytest.mark.parametrize("silent_s", [0.12, 1.0])
def test_a_motor_controller_that_was_silent_and_counts_from_another_zero_opens_no_brake(p, silent_s, zero, held):
    """Silently up to 12 kN for as long as it clamped: until it has opened, the torque alone and contact unknown; then both."""
    rows, force, first, release = _silent(p, silent_s, zero, held)
    estimates = estimate(rows, p)
    clamped, later = slice(first, release), slice(release + 250, None)
    assert np.all(_unknown(estimates[clamped])) and np.all(estimates["source"][clamped] == r.TORQUE_ONLY)
    assert _covered(estimates[first:], force[first:])
    assert np.mean(estimates["source"][later] == r.FUSED) > 0.9
    assert _rms((estimates["force"] - force)[later]) < 100.0


def test_what_a_silence_may_have_heated_is_less_certain(p):
    """By hard braking from a motorway, 5 K/s."""
    rows, _, first, _ = _silent(p, 2.0, zero=8.0)
    sigmas = []
    for end in (first, first + 1):
        state = new_state()
        estimate(rows[:end], p, state)
        sigmas.append(state[0]["temperature_sigma"])
    assert sigmas[1] - sigmas[0] == pytest.approx(5.0 * 2.004, rel=0.01)


def test_a_motor_that_stands_where_it_stood_before_a_silence_counts_from_the_same_zero(p):
    rows, _, first, _ = _silent(p, 1.0, held=True)
    estimates = estimate(rows, p)
    assert not np.any(_unknown(estimates[first:])) and np.all(estimates["source"][first:] != r.TORQUE_ONLY)


@pytest.mark.parametrize(("silent_s", "name"), [(0.08, "dt"), (1.0, "was_silent")])
def test_frames_that_a_bus_loses_move_no_zero(p, silent_s, name):
    """Fewer than for a tenth of a second, or while something else is heard of the controller, or just the resolver's."""
    rows, _, first, _ = _silent(p, silent_s)
    rows["was_silent"] &= name == "dt"
    estimates = estimate(rows, p)
    assert np.all(estimates["source"][first:] != r.TORQUE_ONLY)


def test_a_log_at_a_few_samples_a_second_is_no_silence(p):
    """Nothing comes of the controller for longer than a tenth of a second each time, and the motor moves on."""
    path = np.concatenate([np.linspace(0.0, p["clearance"] + 12.0, 20), np.linspace(p["clearance"] + 12.0, 0.0, 20)])
    rows, _ = brake.samples(p, path, dt=0.125)
    heard = estimate(rows, p)
    rows["was_silent"] = True
    assert estimate(rows, p).tobytes() == heard.tobytes()


def test_what_was_asked_before_a_silence_says_nothing_of_what_moved_in_it(p):
    """The vehicle's last status said that nobody brakes; the motor closes, and has not been seen to stand."""
    rows, force, first, release = _silent(p, 1.0, zero=8.0)
    rows["brake_request"][:release] = 0.0
    estimates = estimate(rows, p)
    assert np.all(_unknown(estimates[first : first + 60])) and _covered(estimates[first:], force[first:])


@pytest.mark.parametrize("closed", [3.0, 7.0])
def test_a_motor_that_opens_further_than_where_it_stood_at_power_on_was_not_released_there(p, closed):
    """It stood half open for a second, nobody asking anything; its clearance counts from where it stands open."""
    away = np.concatenate([np.full(250, closed), np.linspace(closed, 0.0, 100), np.zeros(100)])
    path = np.concatenate([away, *[np.concatenate([brake.clamp(p, 12.0, 0.3), brake.clamp(p, 12.0, 0.3)[::-1]])] * 2])
    rows, force = brake.samples(p, path)
    rows["brake_request"] = np.where(force > 1.0, 4000.0, 0.0)
    estimates = estimate(brake.noisy(rows, p), p)
    assert _covered(estimates[350:], force[350:])
    assert estimates["contact_angle"][449] == pytest.approx(p["clearance"], abs=0.3)


@pytest.mark.parametrize("elapsed_s", [0.0, 45.0, 600.0])
def test_a_motor_cools_while_nobody_watches_it(parameters, elapsed_s):
    """Its winding within half a minute, its housing within five minutes (e-fold)."""
    s = new_state()[0]
    s["winding"], s["housing"] = 0.8, 0.5
    restart.rest_unwatched(s, parameters[0], elapsed_s)
    assert s["winding"] == pytest.approx(0.8 * np.exp(-elapsed_s / 30.0))
    assert s["housing"] == pytest.approx(0.5 * np.exp(-elapsed_s / 300.0))
