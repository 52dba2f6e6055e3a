"""Parts of the estimator by hand: what a torque is made of, how far it and the stiffness path may be off, and what becomes of
a zero that moves or strays."""

import brake
import numpy as np
import pytest

from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator import fuse, resolver, straying
from emb_daemon.estimator.hypotheses import TORQUE_JUMP
from emb_daemon.estimator.paths import FLICKER_RAD, stiffness_path, torque_path
from emb_daemon.estimator.records import ESTIMATE, SAMPLE, new_state
from emb_daemon.estimator.step import _gained_since, predict, step
from emb_daemon.estimator.unknown import torque_offset
from emb_daemon.models.fusion import OF_THE_MODEL
from emb_daemon.models.lateness import remember
from emb_daemon.models.plausibility import STIFFNESS_WRONG
from emb_daemon.models.stiffness import characteristic_curve
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import CYCLE_S, TORQUE_ONLY


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
    s["speed_sigma"], s["current_sigma"], s["had_current"] = 0.5, p["current_sigma"], False
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
    """Half of the acceleration times the age squared, by the slope; nothing at a constant speed."""
    prompt = fuse._spread(s, p, m)
    s["late"] = 0.006
    assert fuse._spread(s, p, m) == prompt
    m["speed"] = 60.0
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


@pytest.mark.parametrize(("efficiency", "known"), [(0.5, True), (0.1, False)])
def test_friction_of_a_motion_that_is_known_counts_unless_the_gear_locks_itself(p, s, m, efficiency, known):
    """Where friction carries nearly all of the load on the way back, how much of it there is decides, and is not known."""
    s["plausibility"]["steady"], s["spring_force"], s["friction_mean"], s["covariance"] = 0.5, 0.0, -1.0, 0.0
    s["gear_gain"], p["load_friction"] = 1.0, (1.0 - efficiency) * p["gear_gain"] / s["gear_friction"]
    sure, unsure = (fuse._torque_beside_motion(s, p, m, variance) for variance in (0.0, 1.0))
    assert (sure[1] < 0.1 * unsure[1]) == known and (sure == unsure) != known


def test_a_torque_beside_a_known_motion_is_as_unsure_as_what_it_is_made_of(p, s, m):
    """Offset, torque constant, both frictions and the viscous one, each alone; 0.5 N m at 40 rad/s."""
    s["plausibility"]["steady"], s["spring_force"] = 0.5, 0.0
    s["gear_gain"] = 1.0
    gain, force = 1.3 * p["gear_gain"], fuse._torque_beside_motion(s, p, m, 0.0)[0]
    shares = {fuse.OFFSET: 1.0, fuse.GAIN: 0.5, fuse.COULOMB: 1.0, fuse.LOAD: force, fuse.VISCOUS: 40.0}
    s["covariance"] = 0.0
    alone = fuse._torque_beside_motion(s, p, m, 0.0)[1]
    for state, share in shares.items():
        s["covariance"] = 0.0
        s["covariance"][state, state] = 1e-4 / share**2
        sigma = fuse._torque_beside_motion(s, p, m, 0.0)[1]
        assert np.sqrt(sigma**2 - alone**2) == pytest.approx(0.01 / gain)


@pytest.mark.parametrize("found", [False, True], ids=["believed", "implausible"])
def test_what_was_learned_beside_an_implausible_resolver_may_all_be_wrong(p, s, m, found):
    """Of an offset that no current sensor has, no more is taken out than one may have; sigma covers what motor and friction
    have learned. With a resolver that is believed they are what they were learned to be."""
    gain, healthy = float(p["gear_gain"]), 2.0 * float(torque_offset(p))
    force = 0.1 * float(p["maximum_force"])
    s["motor_torque"], s["spring_force"], s["covariance"] = force * gain, 0.0, 0.0
    s["gear_slope"] = s["gear_gain"] = 1.0
    if found:
        s["plausibility"]["verdict"] = STIFFNESS_WRONG

    def told(**learned):
        s["error"] = 0.0
        for name, value in learned.items():
            s["error"][getattr(fuse, name)] = value
        s["plausibility"]["averaged"], s["plausibility"]["torque_variance"] = False, 0.0
        return fuse._torque_alone(s, p, m)[:2]

    plain, sigma = told()
    assert plain == pytest.approx(force)
    off, off_sigma = told(OFFSET=-10.0 * healthy)
    _, slippery_sigma = told(COULOMB=-0.9 * p["offset_friction"], LOAD=-0.9 * p["load_friction"])
    if found:
        assert off == pytest.approx(plain + healthy / gain)
        assert off_sigma > 10.0 * healthy / gain
        assert slippery_sigma > 0.9 * sigma
    else:
        assert off == pytest.approx(plain + 10.0 * healthy / gain)
        assert slippery_sigma < 0.2 * sigma


def test_pads_that_stand_keep_the_force_that_their_way_there_has_left_them(parameters, s, m):
    """Of pads with hysteresis alone: one that has been released by a radian has less force than one that closes, for good."""
    p = brake.ideal(parameters)
    p["effects"]["stiffness_hysteresis"] = parameters[0]["effects"]["stiffness_hysteresis"]
    s["contact_angle"], s["force"], s["past_contact"], forces = 5.0, 0.0, -5.0, []
    for way, count in (([0.0, 17.0], 150), ([17.0, 18.0], 10), ([18.0, 17.0], 10), ([17.0, 17.0], 300)):
        for m["angle"] in np.linspace(*way, count):
            stiffness_path(s, p, m, 1.0)
            s["angle"] = m["angle"]
        forces.append(float(s["drive"]))
    closing, _, released, stands = forces
    assert released < 0.99 * closing and stands == pytest.approx(released, rel=1e-6)


def test_friction_of_a_standing_motor_is_halfway_between_what_a_coarse_count_hides(p, s, m):
    """And as unsure as half of what lies between."""
    p["presliding_angle"], s["friction_state"] = 0.5, 1.0
    s["steps"]["least"], s["steps"]["most"], s["steps"]["number"] = 0.02, 0.02, 100
    torque_path(s, p, m)
    hidden = 1.0 - np.exp(-0.02 / 0.5)
    assert s["friction_mean"] == pytest.approx(1.0 - hidden)
    assert s["friction_variance"] == pytest.approx(hidden**2)


def test_a_force_that_comes_a_cycle_late_is_as_sure_as_the_motor_was_slow(p, s):
    """A motor that stands has kept its force; after two cycles it may have gone at its limit meanwhile."""
    assert _gained_since(s, p, CYCLE_S) == pytest.approx(900.0 * 1.3 * 40.0 * CYCLE_S)
    s["speed"], s["factor"], s["scale"], s["past_contact"] = 0.0, 1.0, 1.0, 10.0
    assert _gained_since(s, p, CYCLE_S) == 0.0
    assert _gained_since(s, p, 2.0 * CYCLE_S) > 900.0 * 40.0 * 2.0 * CYCLE_S


@pytest.mark.parametrize(
    ("change", "held"),
    [({}, False), ({"speed": 2.0}, True), ({"unknown": True}, True), ({"verdict": STIFFNESS_WRONG}, True)],
    ids=["turns", "stands", "contact unknown", "resolver implausible"],
)
def test_a_prediction_goes_on_with_a_motor_whose_angle_tells_the_force(p, s, change, held):
    """For 32 ms: what it does then is as likely the opposite. Sigma is the same, as of any motion."""
    out = np.zeros(1, ESTIMATE)[0]
    s["factor"], s["scale"], s["past_contact"], s["started"], s["fused"], s["drive"] = 1.0, 1.0, 10.0, True, 8000.0, 8000.0
    for name, value in change.items():
        (s["plausibility"] if name == "verdict" else s)[name] = value
    forces = []
    for age in (0.012, 0.032, 0.08):
        predict(s, p, age, out)
        forces.append(float(out["force"]))
        assert out["sigma"] > 40.0 * 900.0 * age
    if held:
        assert forces == [8000.0] * 3
    else:
        there, _ = characteristic_curve(10.0 + 1.3 * 40.0 * 0.032, p["curve"])
        here, _ = characteristic_curve(10.0, p["curve"])
        settled = 8000.0 + there - here
        assert 8000.0 < forces[0] < forces[1] < forces[2] < settled
        assert settled - forces[2] == pytest.approx((there - here) * p["relaxation_time"] / 0.08, rel=0.2)


@pytest.mark.parametrize("late_s", [0.0, 0.008])
def test_what_is_kept_of_friction_follows_the_angle_alone_however_late_that_is(p, s, m, late_s):
    for _ in range(5):
        remember(s["lately"], 40.0, CYCLE_S)
    s["late"], s["past_contact"], m["angle"] = late_s, -5.0, 0.16
    torque_path(s, p, m)
    assert s["slid_angle"] == pytest.approx(0.16, abs=FLICKER_RAD)
    assert s["friction_state"] == pytest.approx(1.0 - np.exp(-s["slid_angle"] / p["presliding_angle"]))


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


def test_the_share_of_what_strays_that_is_the_angles_is_learned_as_a_mean():
    """By what moved of what strayed, each known with a variance, from nothing or all of it: a half as a standard deviation."""
    a, rng = new_state()[0]["straying"], np.random.default_rng(4)
    strayed, variance = rng.uniform(-0.5, 0.5, 6), rng.uniform(0.001, 0.01, 6)
    moved, begun = 0.6 * strayed, float(a["share"])
    for each in zip(strayed, moved, variance, strict=True):
        straying._learn_share(a, *each)
    told = np.sum(strayed**2 / variance)
    assert a["share"] == pytest.approx((4.0 * begun + np.sum(strayed * moved / variance)) / (4.0 + told))
    assert a["told"] == pytest.approx(told)
    straying._learn_share(a, 0.1, 5.0, 1e-6)
    assert a["share"] == 1.0
    straying._learn_share(a, 0.1, -5.0, 1e-6)
    assert a["share"] == 0.0


@pytest.mark.parametrize(
    ("rate", "drift", "moved"), [(0.0, 0.05, 0.5 * (0.05 * CYCLE_S + 0.01)), (0.3, 0.05, 0.3 * CYCLE_S + 0.5 * 0.01)]
)
def test_the_zero_follows_a_drift_that_is_certain_and_its_share_of_the_rest(p, s, rate, drift, moved):
    """Counts that are lost, a hundredth of a rad here, have no rate."""
    a, w = s["straying"], s["wander"]
    a["rate"], a["share"], w["drift"], w["loss"] = rate, 0.5, drift, 0.01
    before = float(s["contact_angle"])
    straying.follow_straying(s, p, -1.0, -1.0, -250.0, False, CYCLE_S)
    assert s["contact_angle"] - before == pytest.approx(moved)


@pytest.mark.parametrize(
    ("moved", "back", "returns"), [(0.5, -0.49, True), (0.5, -0.2, False), (0.1, -0.1, False), (0.5, 0.5, False)]
)
def test_a_zero_that_comes_back_has_never_moved(p, s, moved, back, returns):
    """Within its standard deviations, three times; the contact is known as well as before then."""
    s["away"]["seconds"], s["covariance"] = 1e9, 0.0
    s["covariance"][fuse.CONTACT, fuse.CONTACT], s["gear_slope"] = 1e-4, 1.0
    resolver._move_zero(s, p, moved, 0.05, False)
    assert s["contact_angle"] == moved and s["covariance"][fuse.CONTACT, fuse.CONTACT] == pytest.approx(1e-4 + 0.05**2)
    s["away"]["seconds"] = CYCLE_S
    resolver._move_zero(s, p, back, 0.05, False)
    if returns:
        assert s["contact_angle"] == pytest.approx(0.0) and s["covariance"][fuse.CONTACT, fuse.CONTACT] == pytest.approx(1e-4)
    else:
        assert s["contact_angle"] == pytest.approx(moved + back)
        assert s["covariance"][fuse.CONTACT, fuse.CONTACT] == pytest.approx(1e-4 + 2.0 * 0.05**2)


def test_a_motor_whose_friction_is_unknown_says_as_little_of_the_force_as_that_friction_takes(p):
    """It may have come from either side."""
    rows, _ = brake.samples(p, np.concatenate([brake.clamp(p, 12.0, 0.2), np.full(3, p["clearance"] + 12.0)]))
    state, out = new_state(), np.zeros(1, ESTIMATE)[0]
    estimate(rows, p, state)
    state["friction_variance"] = 1.0
    step(state[0], p, rows[-1], out)
    friction = p["offset_friction"] + p["load_friction"] * out["stiffness_force"]
    open_N = friction / (p["gear_gain"] + p["load_friction"] * state["friction_mean"][0])
    assert out["stiffness_force"] > 4000.0 and open_N < out["torque_sigma"] < 1.2 * open_N


def test_friction_is_known_once_the_motor_has_slid_and_not_where_its_angle_creeps_without_speed(p, s, m):
    """In the clearance, where nothing but the motor turns the gear."""
    for creeps in (False, True):
        s["straying"]["creeps"], s["past_contact"], s["friction_variance"], s["friction_state"] = creeps, -5.0, 1.0, -1.0
        for _ in range(6):
            m["angle"] += p["presliding_angle"]
            torque_path(s, p, m)
        assert (s["friction_variance"] < 1e-3) != creeps


@pytest.fixture(scope="module")
def closed(shipped_setup):
    """PARAMETERS, STATE at the end of a quick clamp to 12 rad past contact, and the next SAMPLE."""
    p = brake.ideal(shipped_setup.parameters)
    rows, _ = brake.samples(p, brake.clamp(p, 12.0, 0.2))
    state = new_state()
    estimate(rows[:-1], p, state)
    return p, state, rows[-1]


def test_what_is_left_unexplained_is_what_the_best_change_leaves(closed):
    """A current that is 2 A too high is no news to a torque path whose offset has jumped by as much."""
    p, out, left = closed[0], np.zeros(1, ESTIMATE)[0], []
    for learned_A in (0.0, 2.0):
        state, m = closed[1].copy(), closed[2].copy()
        m["current_q"] += 2.0
        state["alternatives"]["error"][0, TORQUE_JUMP, fuse.OFFSET] += learned_A * p["torque_constant"]
        step(state[0], p, m, out)
        left.append(abs(out["innovation"]) / out["innovation_sigma"])
    assert left[1] < 0.3 * left[0]


def test_counts_that_a_stroke_may_lose_leave_open_as_much_force_as_the_gear_makes_of_them(shipped_setup):
    """A hundredth of what a stroke of 0.25 s turns the motor by, times the slopes of gear and pads; on a ramp, too."""
    from test_gear import ramp

    calibration = shipped_setup.calibrations["FL"]
    for p in (to_parameters(calibration), to_parameters(ramp(calibration))):
        rows, _ = brake.samples(p, np.linspace(0.0, p["clearance"] + 12.0, 45))
        state, out, sigma = new_state(), np.zeros(1, ESTIMATE)[0], []
        estimate(rows[:-1], p, state)
        for loss in (0.0, 0.01):
            after = state.copy()
            after["wander"]["loss"] = loss
            step(after[0], p, rows[-1], out)
            sigma.append(float(out["sigma"]))
        s = after[0]
        opened = 0.01 * fuse._STROKE_S * p["maximum_speed"] * s["slope"] * s["gear_slope"]
        assert sigma[1] ** 2 - sigma[0] ** 2 == pytest.approx(opened**2, rel=0.02)
    assert abs(s["gear_slope"] - 1.0) > 0.05


def test_friction_beside_the_motion_that_a_current_is_held_against_is_without_inertia(p):
    """Of a motor that gains speed in the clearance."""
    path = 0.5 * 900.0 * (CYCLE_S * np.arange(25)) ** 2
    state = new_state()
    estimate(brake.samples(p, np.concatenate([np.zeros(5), path]))[0], p, state)
    assert state["alignment"]["friction"][0, 2] == pytest.approx(p["offset_friction"], rel=0.1)
    # Smoothed over 40 ms for the watch on a standing angle: there is none of the inertia's in it, either.
    assert 0.7 * p["offset_friction"] < state["plausibility"]["steady"][0] < 1.1 * p["offset_friction"]
    assert state["alignment"]["by_motion"][0, 2] == pytest.approx(p["offset_friction"] + 900.0 * p["inertia"], rel=0.1)


def test_a_brake_that_is_held_as_known_stays_so(p):
    """As a diagnosis holds it: nothing of its pads, contact and growth walks."""
    p["clearance_sigma"] = 0.0
    state = new_state()
    estimate(brake.samples(p, brake.clamp(p, 3.0, 0.05))[0], p, state)
    assert not np.diag(state["covariance"][0])[[*OF_THE_MODEL]].any()


def test_a_curve_that_may_be_off_by_all_of_the_force_leaves_it_to_the_torque(p):
    """A slow stroke of a brake whose force is twice what its curve says: from a standard deviation of 1.41 times the force
    on the torque path alone is believed, and nothing is learned of motor and friction."""
    stroke = np.concatenate([np.zeros(250), brake.clamp(p, 12.0, 5.0), brake.clamp(p, 12.0, 5.0)[::-1]])
    rows, force = brake.samples(p, stroke)
    moving = (force > 1000.0) & (np.abs(rows["speed"]) > 1.0)
    p["curve"] *= 0.5
    shares, errors = [], []
    for relative in (1.4, 1.42):
        p["stiffness_relative_sigma"] = relative
        estimates = estimate(rows, p)
        shares.append(np.mean(estimates["source"][moving] == TORQUE_ONLY))
        errors.append([np.sqrt(np.mean((estimates[name] - force)[moving] ** 2)) for name in ("force", "stiffness_force")])
    assert shares[0] < 0.9 and shares[1] == 1.0
    assert errors[1][0] < 0.3 * errors[1][1]
