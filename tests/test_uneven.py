"""A disc that is uneven in a way the calibration does not know: found by its period, followed, covered, told; an even one is
left alone."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator import fuse, step, uneven
from emb_daemon.estimator.phases import OPEN_PHASES, follow_phases, undecided, weigh_phases
from emb_daemon.estimator.records import ESTIMATE, new_state
from emb_daemon.estimator.status import DISC_UNEVEN
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import PATHS_DISAGREE, PULSE_MODULO, PULSES_PER_TURN

#: Of the disc, rad/s: some turns in a stop, and no whole number of them between two.
_TURNING = 27.3
_STOPS, _STOP = 12, 750


@pytest.fixture
def p(parameters):
    p = brake.ideal(parameters)
    # Heat is not the question: the true force has none.
    p["thermal"]["softening"] = p["thermal"]["softening_history"] = 0.0
    return p


def _stops(p, cosine_um, sine_um, seed=1, turns=0.0):
    """Samples and true force of stops on a turning disc whose thickness varies. Its motor goes as on an even one. ``turns``
    since the wheel's counter began."""
    path = brake.stops(p, _STOPS, seed)
    turned = 2.0 * np.pi * turns + _TURNING * 0.004 * np.arange(len(path))
    thicker = 1e-6 * (cosine_um * np.cos(turned) + sine_um * np.sin(turned)) / p["gear_gain"]
    rows, even = brake.samples(p, path)
    force = brake.samples(p, path + thicker)[1]
    load, more = (0.5 * (x + np.concatenate([x[:1], x[:-1]])) for x in (even, force - even))
    # Friction is the motor's, which goes as on an even disc.
    torque = p["torque_constant"] * rows["current_q"] - p["inertia"] * np.diff(rows["speed"], prepend=0.0) / 0.004
    friction = (torque - p["gear_gain"] * load) / (p["load_friction"] * load + p["offset_friction"])
    rows["current_q"] += (p["gear_gain"] + friction * p["load_friction"]) * more / p["torque_constant"]
    rows["wheel_speed"] = _TURNING
    rows["wheel_pulse"] = np.floor(turned * PULSES_PER_TURN / (2.0 * np.pi)) % PULSE_MODULO
    return brake.noisy(rows, p, seed), force, even


@pytest.mark.parametrize(("cosine_um", "sine_um"), [(12.0, 0.0), (0.0, -9.0), (-6.0, 10.0)])
def test_an_uneven_disc_is_followed_after_some_stops(p, cosine_um, sine_um):
    """The force is wrong by a third of what an even disc's would be, and by what sigma says."""
    rows, force, even = _stops(p, cosine_um, sine_um)
    estimates = estimate(rows, p.reshape(1))
    late = slice(_STOPS // 2 * _STOP, None)
    clamped = force[late] > 1000.0
    error = (estimates["force"] - force)[late][clamped]
    missed = (even - force)[late][clamped]
    assert np.sqrt(np.mean(error**2)) < 0.35 * np.sqrt(np.mean(missed**2))
    assert np.mean(np.abs(error) > 3.0 * np.hypot(estimates["sigma"][late][clamped], 25.0)) < 0.01


def _knows(p, cosine_um, sine_um):
    """Parameters of a brake whose calibration knows the disc."""
    p = p.copy()
    p["effects"]["disc_thickness_variation"]["order_1_cosine_um"] = cosine_um
    p["effects"]["disc_thickness_variation"]["order_1_sine_um"] = sine_um
    return p.reshape(1)


@pytest.mark.parametrize("turns", [0.5, 17.0, 42.5, 60.0, 100.0, 128.5])
def test_a_counter_that_has_run_before_leaves_three_phases_open_and_torque_decides(p, turns):
    """The counter goes over its range every 42.67 turns, which who starts later has not seen. Once decided, force and sigma
    are as of a daemon that has heard it all."""
    rows, force, even = _stops(p, 14.0, -9.0, turns=turns)
    estimates = estimate(rows, _knows(p, 14.0, -9.0))
    heard = estimate(_stops(p, 14.0, -9.0)[0], _knows(p, 14.0, -9.0))
    error, clamped = np.abs(estimates["force"] - force), force > 1000.0
    assert np.mean((error > 3.0 * np.hypot(estimates["sigma"], 25.0))[clamped]) < 0.01
    late = clamped & (np.arange(len(rows)) >= _STOPS // 2 * _STOP)
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.1 * np.sqrt(np.mean((even - force)[late] ** 2))
    assert np.median(estimates["sigma"][late]) < 1.1 * np.median(heard["sigma"][late])


def test_without_a_torque_open_phases_stay_open_and_sigma_covers_the_disc(p):
    rows, force, even = _stops(p, 14.0, -9.0, turns=60.0)
    # The first stop shows the contact, but nothing of a disc that seems to stand.
    rows["has_current"][_STOP:], rows["wheel_speed"][:_STOP] = False, 0.0
    estimates, plain = estimate(rows, _knows(p, 14.0, -9.0)), estimate(rows, p.reshape(1))
    late = (force > 1000.0) & (np.arange(len(rows)) >= 2 * _STOP)
    missed = np.sqrt(np.mean((even - force)[late] ** 2))
    assert np.sqrt(np.mean((estimates["force"] - force)[late] ** 2)) < 1.2 * missed
    # Both are as unsure of the contact.
    added = np.sqrt(np.mean((estimates["sigma"] ** 2 - plain["sigma"] ** 2)[late]))
    assert added == pytest.approx(missed, rel=0.3)


def test_a_counter_that_begins_with_the_daemon_tells_the_phase(p):
    """Nothing is doubted, and the first stop is right."""
    rows, force, even = _stops(p, 14.0, -9.0)
    estimates = estimate(rows, _knows(p, 14.0, -9.0))
    first = (force > 1000.0) & (np.arange(len(rows)) < _STOP)
    assert np.sqrt(np.mean((estimates["force"] - force)[first] ** 2)) < 0.2 * np.sqrt(np.mean((even - force)[first] ** 2))


def test_a_phase_lost_while_the_counter_was_silent_is_found_again(p):
    """Counter and speed are silent for ten seconds in which the disc turns forty times; for half a second it is not lost."""
    rows, force, even = _stops(p, 14.0, -9.0)
    heard = estimate(rows, _knows(p, 14.0, -9.0))
    short, silent = slice(_STOP, _STOP + 125), slice(3 * _STOP, 3 * _STOP + 2500)
    for silence in (short, silent):
        rows["has_wheel_pulse"][silence] = rows["has_wheel_speed"][silence] = False
    estimates = estimate(rows, _knows(p, 14.0, -9.0))
    between = slice(short.stop + 250, silent.start)
    np.testing.assert_allclose(estimates["sigma"][between], heard["sigma"][between], rtol=0.05)
    error, clamped = np.abs(estimates["force"] - force), force > 1000.0
    assert np.mean((error > 3.0 * np.hypot(estimates["sigma"], 25.0))[clamped]) < 0.01
    late = clamped & (np.arange(len(rows)) >= (_STOPS - 2) * _STOP)
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.1 * np.sqrt(np.mean((even - force)[late] ** 2))


@pytest.mark.parametrize("seed", range(1, 5))
def test_an_even_disc_stays_even(p, seed):
    """Noise is no period: looking for one costs the force nothing, and no more is told."""
    rows, force, _ = _stops(p, 0.0, 0.0, seed)
    clamped, estimates = force > 1000.0, []
    for turning in (True, False):
        rows["wheel_speed"] *= turning
        estimates.append(estimate(rows, p.reshape(1)))
    turning, standing = (np.sqrt(np.mean((e["force"] - force)[clamped] ** 2)) for e in estimates)
    assert turning < 1.05 * standing
    told = [np.sum(e["reasons"][_STOP:] & PATHS_DISAGREE != 0) for e in estimates]
    assert told[0] <= 1.1 * told[1]


# The filter alone.

_VARIANCE, _SLOPE, _LEVERAGE = 0.02**2, 2000.0, 4e-5
#: Between which the log odds of an uneven disc stay.
_LOG_ODDS_LIMITS = (-6.0, 20.0)


def _feed(u, p, amplitude_m, seconds, seed=1, begin=0.0, strokes=True):
    """A disc under a constant slope of the force; the pads leave it every second if ``strokes``. Returns the
    highest log odds that it had."""
    highest, rows, rng = -np.inf, brake.samples(p, np.zeros(round(seconds / 0.004) + 1))[0], np.random.default_rng(seed)
    shapes = np.zeros(uneven.STATES)
    for i in range(1, len(rows)):
        turned = begin + _TURNING * 0.004 * i
        rows[i]["wheel_speed"], rows[i]["wheel_pulse"] = _TURNING, turned * PULSES_PER_TURN / (2 * np.pi) // 1 % PULSE_MODULO
        rows[i]["has_wheel_pulse"] = True
        touching = not strokes or i % 250 > 50
        uneven.turn(u, rows[i], _SLOPE if touching else 0.0, p["gear_gain"], 1e-6)
        shapes[:] = [f(k * turned) for k in (1, 2) for f in (np.cos, np.sin)]
        more = _SLOPE / p["gear_gain"] * (shapes @ amplitude_m) * touching
        uneven.learn(u, _LEVERAGE, _LEVERAGE * more + np.sqrt(_VARIANCE) * rng.standard_normal(), _VARIANCE, 0.004)
        highest = max(highest, float(u["log_odds"]))
    return highest


@pytest.fixture
def u():
    return np.zeros(1, uneven.UNEVEN)[0]


def test_amplitudes_are_found_with_their_uncertainty(u, p):
    true = 1e-6 * np.array([8.0, -3.0, 1.5, 0.0])
    _feed(u, p, true, 6.0)
    assert u["share"] > 0.99
    spread = np.sqrt(np.diag(u["covariance"]))
    assert np.all(np.abs(u["amplitude"] - true) < 4.0 * spread) and np.all(spread < 1e-6)
    assert uneven.force_sigma(u) ** 2 >= 0.99 * u["force"] @ u["covariance"] @ u["force"] > 0.0


def test_before_anything_was_seen_the_second_order_is_a_quarter_of_the_first(u, p):
    _feed(u, p, np.zeros(uneven.STATES), 0.004)
    spread = np.sqrt(np.diag(u["covariance"]))
    assert spread[:2] == pytest.approx(7e-6, rel=0.01) and spread[2:] == pytest.approx(spread[:2] / 4.0, rel=0.01)


def test_wear_makes_another_disc_of_it(u, p):
    """After an hour in which the pads never touched, as much is open as at first; within a minute hardly anything."""
    _feed(u, p, 1e-6 * np.array([8.0, -3.0, 1.5, 0.0]), 6.0)
    spread = np.sqrt(np.diag(u["covariance"]))
    row = brake.samples(p, np.zeros(2))[0][0]
    row["dt"], row["wheel_speed"] = 1.0, _TURNING
    for second in range(3600):
        row["wheel_pulse"] = _TURNING * second * PULSES_PER_TURN / (2.0 * np.pi) // 1 % PULSE_MODULO
        uneven.turn(u, row, 0.0, p["gear_gain"], 1e-6)
        if second == 60:
            assert np.sqrt(u["covariance"][0, 0]) < 1.5e-6
    later = np.sqrt(np.diag(u["covariance"]) - spread**2)
    assert later[:2] == pytest.approx(7e-6, rel=0.01) and later[2:] == pytest.approx(7e-6 / 4.0, rel=0.01)


def test_the_force_follows_the_disc_with_the_pads_lag(u, p):
    row = brake.samples(p, np.zeros(2))[0][1]
    row["wheel_speed"] = _TURNING
    uneven.turn(u, row, 0.0, p["gear_gain"], 0.04)
    uneven.turn(u, row, _SLOPE, p["gear_gain"], 0.04)
    assert np.all(np.abs(u["force"]) < 0.1 * np.abs(u["drive"])) and np.all(u["drive"] != 0.0)


@pytest.mark.parametrize("seed", range(1, 6))
def test_noise_gives_nothing(u, p, seed):
    _feed(u, p, np.zeros(uneven.STATES), 6.0, seed)
    assert u["share"] < 0.02


def test_until_something_speaks_for_it_the_force_is_that_of_an_even_disc(u, p):
    """To the last bit."""
    _feed(u, p, 1e-6 * np.array([15.0, 0.0, 0.0, 0.0]), 0.7, strokes=False)
    assert abs(u["shift"]) > 10.0 and uneven.applied(u) == 0.0 and uneven.force_sigma(u) == 0.0


def test_a_torque_that_no_disc_explains_teaches_nothing(u, p):
    _feed(u, p, 1e-6 * np.array([8.0, -3.0, 1.5, 0.0]), 6.0)
    before = u.copy()
    uneven.learn(u, _LEVERAGE, 100.0 * np.sqrt(_VARIANCE), _VARIANCE, 0.004)
    assert np.all(u["amplitude"] == before["amplitude"]) and u["log_odds"] == before["log_odds"]


def test_one_torque_beyond_its_noise_is_no_evidence_for_a_disc(u, p):
    """Where much is possible much is learned of one sample, but not that earlier ones foretold it."""
    _feed(u, p, 1e-6 * np.array([8.0, 0.0, 0.0, 0.0]), 3.0)
    u["log_odds"], leverage = -6.0, 1.0
    foretold = leverage * u["force"] @ u["earlier"]
    u["covariance"] = 1e4 * np.eye(uneven.STATES)
    uneven.learn(u, leverage, foretold, (foretold / 100.0) ** 2, 0.004)
    assert -6.0 < u["log_odds"] <= -6.0 + 0.5 * 25.0 + 1e-9


@pytest.mark.parametrize(("before_um", "after_um"), [(0.0, 12.0), (12.0, 0.0)])
def test_no_past_is_so_long_that_another_disc_is_not_found(u, p, before_um, after_um):
    """A disc that was even, or uneven, for as long as one likes is another after work in a workshop."""
    before, after = (1e-6 * np.array([um, 0.0, 0.0, 0.0]) for um in (before_um, after_um))
    u["log_odds"] = _LOG_ODDS_LIMITS[before_um > 0.0]
    _feed(u, p, before, 6.0)
    # What earlier strokes foretold is as wrong, or as right, as can be.
    u["earlier"], u["stroke_s"] = before if before_um else after, 0.0
    _feed(u, p, before, 0.9, 2, begin=6.0 * _TURNING, strokes=False)
    assert u["log_odds"] == pytest.approx(_LOG_ODDS_LIMITS[before_um > 0.0], abs=0.2)
    u["covariance"] += np.diag([(12e-6) ** 2] * 2 + [0.0] * 2)
    _feed(u, p, after, 3.0, 3, begin=6.9 * _TURNING)
    assert u["share"] > 0.99 if after_um else u["share"] < 0.02


def test_noise_is_believed_as_rarely_as_the_odds_say(p):
    """At odds of one in 55 before anything was seen, one even disc in 55 is ever thought as likely uneven as not."""
    filters, highest = np.zeros(60, uneven.UNEVEN), []
    for seed, u in enumerate(filters):
        highest.append(_feed(u, p, np.zeros(uneven.STATES), 3.0, seed))
    assert np.mean(np.array(highest) > 0.0) <= 1.0 / 55.0


def test_one_stroke_proves_nothing(u, p):
    """Any shape is a part of a period: until pads have touched again it is not believed, however well it fits."""
    _feed(u, p, 1e-6 * np.array([15.0, 0.0, 0.0, 0.0]), 0.9, strokes=False)
    assert np.hypot(*u["amplitude"][:2]) > 10e-6 and u["share"] < 0.02
    _feed(u, p, 1e-6 * np.array([15.0, 0.0, 0.0, 0.0]), 2.0, strokes=False, begin=0.9 * _TURNING)
    assert u["share"] > 0.99


def test_a_stroke_ends_when_the_pads_leave_the_disc(u, p):
    _feed(u, p, 1e-6 * np.array([15.0, 0.0, 0.0, 0.0]), 0.996)
    assert u["amplitude"][0] > 10e-6 and np.all(u["earlier"] == 0.0)
    row = brake.samples(p, np.zeros(2))[0][1]
    uneven.turn(u, row, 0.0, p["gear_gain"], 1e-6)
    assert np.all(u["earlier"] == u["amplitude"])


def test_a_lost_phase_begins_anew(u, p):
    """The counter was silent for more turns than it counts: the disc is as uneven as before, and nobody knows where."""
    _feed(u, p, 1e-6 * np.array([12.0, 0.0, 0.0, 0.0]), 6.0)
    rows = brake.samples(p, np.zeros(3))[0]
    rows["wheel_speed"], rows["dt"], rows["has_wheel_pulse"] = _TURNING, 1.5, [False, False, True]
    for row in rows:
        uneven.turn(u, row, _SLOPE, p["gear_gain"], 1e-6)
    assert u["amplitude"][0] > 10e-6, "three seconds are carried on by the wheel speed"
    rows["dt"] = 20.0
    for row in rows:
        uneven.turn(u, row, _SLOPE, p["gear_gain"], 1e-6)
    assert np.all(u["amplitude"] == 0.0) and np.all(u["earlier"] == 0.0) and u["share"] > 0.99
    assert np.sqrt(u["covariance"][0, 0]) > 10e-6


def test_while_the_counter_is_silent_the_speed_carries_the_phase_on(u, p):
    row = brake.samples(p, np.zeros(2))[0][1]
    row["wheel_speed"], row["wheel_pulse"] = _TURNING, 100.0
    for _ in range(3):
        uneven.turn(u, row, _SLOPE, p["gear_gain"], 1e-6)
    begun = np.arctan2(u["drive"][1], u["drive"][0])
    row["has_wheel_pulse"] = False
    for number in range(1, 26):
        uneven.turn(u, row, _SLOPE, p["gear_gain"], 1e-6)
        angle = begun + number * 0.004 * _TURNING
        expected = _SLOPE / p["gear_gain"] * np.array([np.cos(angle), np.sin(angle), np.cos(2.0 * angle), np.sin(2.0 * angle)])
        assert u["drive"] == pytest.approx(expected, abs=1e-6 * _SLOPE / p["gear_gain"])


def test_without_counter_and_speed_the_phase_is_lost_at_once(u, p):
    _feed(u, p, 1e-6 * np.array([12.0, 0.0, 0.0, 0.0]), 6.0)
    rows = brake.samples(p, np.zeros(3))[0][1:]
    rows["has_wheel_pulse"], rows["has_wheel_speed"] = [False, True], False
    for row in rows:
        uneven.turn(u, row, _SLOPE, p["gear_gain"], 1e-6)
    assert np.all(u["amplitude"] == 0.0) and u["share"] > 0.99


def test_a_disc_that_has_not_turned_is_its_contact_angle(u, p):
    rows = brake.samples(p, np.zeros(50))[0]
    for row in rows:
        uneven.turn(u, row, _SLOPE, p["gear_gain"], 0.03)
    u["share"] = 1.0
    assert uneven.force_sigma(u) == 0.0 and uneven.applied(u) == 0.0


def test_what_is_half_believed_is_covered_and_told(p):
    """Between belief and disbelief the difference counts in sigma, and the fact is told."""
    u = np.zeros(1, uneven.UNEVEN)[0]
    _feed(u, p, 1e-6 * np.array([12.0, 0.0, 0.0, 0.0]), 2.5, strokes=False)
    sure = uneven.force_sigma(u)
    crest = _SLOPE / p["gear_gain"] * np.hypot(*u["amplitude"][:2])
    assert uneven.unproven(u) < 0.01 * crest
    u["share"] = 0.5
    assert uneven.applied(u) == 0.5 * u["shift"]
    assert uneven.unproven(u) == pytest.approx(0.5 * crest, rel=0.1)
    assert uneven.force_sigma(u) > max(sure, 0.45 * abs(u["shift"]))


@pytest.mark.parametrize(("share", "told"), [(0.0, False), (0.5, True), (1.0, False)])
def test_a_disc_is_told_while_it_is_not_sure(p, share, told):
    s = new_state()[0]
    s["uneven"]["amplitude"][0], s["uneven"]["force"][0], s["uneven"]["share"] = 10e-6, 2e7, share
    assert bool(fuse._facts_of_torque(s, p) & DISC_UNEVEN) == told


def _touching(p):
    """State of a brake whose pads are about to touch a disc that adds 100 N, and a sample of a motor that moves on it."""
    state, row = new_state(), brake.samples(p, np.array([0.0, 0.1]))[0][1]
    s = state[0]
    step._start(s, p, row)
    row["angle"], row["wheel_speed"] = 0.2, _TURNING
    u = s["uneven"]
    u["amplitude"][0], u["force"][0], u["shift"], u["share"], u["log_odds"] = 1e-5, 1e7, 100.0, 1.0, 20.0
    u["covariance"] = np.diag([1e-12] * uneven.STATES)
    return s, row


def _take(s, p, m, torque, trusted=True):
    """One torque (N m) at 1 kN; returns what of it nothing explains, N."""
    out = np.zeros(1, ESTIMATE)[0]
    fuse._take_torque(s, p, m, torque, p["gear_gain"], 1000.0, 0.0, 10.0, 0.0, trusted, False, out)
    return float(out["innovation"])


def test_what_an_uneven_disc_explains_is_asked_of_nothing_else(p):
    s, m = _touching(p)
    before = s["error"].copy(), s["uneven"]["amplitude"].copy()
    assert _take(s, p, m, 1100.0 * p["gear_gain"]) == pytest.approx(0.0, abs=1e-6)
    assert s["error"] == pytest.approx(before[0], abs=1e-9) and s["uneven"]["amplitude"] == pytest.approx(before[1], rel=1e-9)


@pytest.mark.parametrize("what", ["nothing", "motor stands", "wheel stands", "fault", "jump suspected"])
def test_only_a_motor_that_moves_on_a_turning_disc_teaches(p, what):
    """And a sound one: what a sensor's fault or a brake that has jumped does to the torque is no disc's."""
    s, m = _touching(p)
    if what == "motor stands":
        m["angle"] = s["angle"]
    elif what == "wheel stands":
        m["wheel_speed"] = 0.0
    elif what == "jump suspected":
        s["alternatives"]["log_odds"][0] = 50.0
    before = s["uneven"]["amplitude"].copy()
    _take(s, p, m, 1200.0 * p["gear_gain"], trusted=what != "fault")
    assert np.any(s["uneven"]["amplitude"] != before) == (what == "nothing")


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_way_of_the_force_over_a_turn_is_what_such_a_disc_makes(share):
    u, angle = new_state()[0]["uneven"], np.linspace(0.0, 2.0 * np.pi, 10_001)
    u["share"], u["force"] = share, (2e7, 0.0, 0.0, 2e7)
    for order, cosine, sine in ((1, 8e-6, 0.0), (1, 3e-6, -4e-6), (2, -5e-6, 2e-6)):
        u["amplitude"] = 0.0
        u["amplitude"][2 * order - 2], u["amplitude"][2 * order - 1] = cosine, sine
        shift = 2e7 * (cosine * np.cos(order * angle) + sine * np.sin(order * angle))
        assert 2.0 * np.pi * uneven.way_per_rad(u) == pytest.approx(share * np.abs(np.diff(shift)).sum(), rel=1e-3)


@pytest.mark.parametrize("foretold", [0.5, -0.3])
def test_the_odds_of_a_disc_are_how_much_better_it_foretold_a_torque(u, foretold):
    """Ratio of normal likelihoods; five sigma count at most."""
    u["force"][:2], u["earlier"][:2], variance = (1000.0, 500.0), (foretold * 8e-4, foretold * 4e-4), 1e-4
    for without in (0.004, -0.02):
        u["log_odds"], expected = 0.3, _LEVERAGE * foretold
        uneven._weigh(u, _LEVERAGE, without, variance)
        better = 0.5 * (without**2 - (without - expected) ** 2) / variance
        assert u["log_odds"] == pytest.approx(0.3 + better)
    u["log_odds"], u["earlier"] = 0.0, 0.0
    uneven._weigh(u, _LEVERAGE, 10.0, variance)
    assert u["log_odds"] == 0.0


@pytest.mark.parametrize("order", [1, 2])
def test_each_order_is_told_by_how_far_it_moves_the_force_over_a_turn(u, order):
    """Ten micrometres on 2 kN/rad, wherever in its turn the disc is."""
    u["share"], u["amplitude"][2 * order - 2 : 2 * order] = 0.3, (6e-6, -8e-6)
    for angle in (0.0, 1.0, 2.5):
        u["force"] = [_SLOPE / 4e-5 * part(k * angle) for k in (1, 2) for part in (np.cos, np.sin)]
        assert uneven.unproven(u) == pytest.approx(0.3 * _SLOPE * 10e-6 / 4e-5)
        assert uneven.way_per_rad(u) == pytest.approx(0.3 * 2.0 / np.pi * order * _SLOPE * 10e-6 / 4e-5)


# The phases of a disc that the calibration knows.


@pytest.fixture
def phases():
    """States of the effects with three open phases, and what each does to the force."""
    s, o = new_state()[0]["effects"], np.zeros(1, OPEN_PHASES)[0]
    s["disc_thickness_variation"]["likely"] = 0.5, 0.3, 0.2
    s["disc_thickness_variation"]["beside"] = 1e-5, -4e-6, -1.9e-5
    return o, s


def test_an_open_phase_moves_the_force_by_its_thickness_with_the_pads_lag(phases, p):
    o, s = phases
    row = brake.samples(p, np.zeros(2))[0][1]
    expected = _SLOPE / p["gear_gain"] * s["disc_thickness_variation"]["beside"]
    follow_phases(o, s, row, _SLOPE, p["gear_gain"], 0.04)
    assert o["drive"] == pytest.approx(expected)
    assert np.all(np.abs(o["force"]) < 0.1 * np.abs(expected)) and np.all(o["force"] * expected > 0.0)
    for _ in range(100):
        follow_phases(o, s, row, _SLOPE, p["gear_gain"], 0.04)
    assert o["force"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("right", range(3))
def test_open_phases_are_as_likely_as_bayes_rule_says(phases, right):
    """The torque is that of one of them, and a sigma and a half of noise; what all are far from speaks for none."""
    o, s = phases
    o["force"], variance = (700.0, -200.0, -500.0), (400.0 * _LEVERAGE) ** 2
    priors, without = np.array([0.5, 0.3, 0.2]), _LEVERAGE * (o["force"][right] + 600.0)
    weigh_phases(o, s, _LEVERAGE, without, variance)
    odds = priors * np.exp(-0.5 * (without - _LEVERAGE * o["force"]) ** 2 / variance)
    assert s["disc_thickness_variation"]["likely"] == pytest.approx(odds / odds.sum())
    weigh_phases(o, s, _LEVERAGE, _LEVERAGE * 1e5, variance)
    assert s["disc_thickness_variation"]["likely"] == pytest.approx(odds / odds.sum())


def test_a_phase_that_was_believed_by_mistake_is_left_again(phases):
    """However long it was believed, some torques are enough."""
    o, s = phases
    o["force"], variance = (700.0, -200.0, -500.0), (400.0 * _LEVERAGE) ** 2
    for _ in range(1000):
        weigh_phases(o, s, _LEVERAGE, _LEVERAGE * 700.0, variance)
    assert not undecided(s) and s["disc_thickness_variation"]["likely"][0] > 0.9999
    for _ in range(20):
        weigh_phases(o, s, _LEVERAGE, _LEVERAGE * -500.0, variance)
    assert s["disc_thickness_variation"]["likely"][2] > 0.99
