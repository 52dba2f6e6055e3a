"""The filter: steady state, shape of its covariance, and whether its sigma means what it says."""

import brake
import city
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.hypotheses import to_force, to_torque
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.unknown import add_growth, add_stiffness_jumps, add_torque_jumps, set_priors, set_walks
from emb_daemon.models.fusion import (
    CONTACT,
    COULOMB,
    FADE,
    FAST,
    GAIN,
    GROWTH,
    LATE,
    LOAD,
    NOISE,
    OFFSET,
    SCALE,
    STATES,
    VISCOUS,
    force_variance,
    predict_errors,
    update_errors,
    variance_along,
)
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import TORQUE_ONLY


def _update(x, P, gain, innovation, h, variance):
    """A measurement update; returns the innovation's variance before it."""
    s = variance + variance_along(P, h, gain)
    update_errors(x, P, gain, innovation, s)
    return s


def test_steady_state_solves_the_riccati_equation():
    """Two error states that the same measurement sees, and the noise of the current (everything else held known)."""
    decay, walk, noise_decay, noise_variance, variance = 0.99, 1e-4, 0.6, 0.04, 0.02
    seen = [FAST, GAIN, NOISE]
    h, walked = np.zeros(STATES), np.zeros(STATES)
    h[seen], walked[GAIN] = (0.5, 0.3, 1.0), walk
    x, P, gain = np.zeros(STATES), np.zeros((STATES, STATES)), np.zeros(STATES)
    P[seen, seen] = 1.0, 1.0, noise_variance
    for _ in range(20_000):
        predict_errors(x, P, decay, noise_decay, noise_variance, walked)
        predicted = P.copy()
        _update(x, P, gain, 0.0, h, variance)
    transition = np.diag([decay, 1.0, noise_decay])
    noise = np.diag([1.0 - decay**2, walk, (1.0 - noise_decay**2) * noise_variance])
    expected = solve_discrete_are(transition.T, h[seen, None], noise, np.array([[variance]]))
    np.testing.assert_allclose(predicted[np.ix_(seen, seen)], expected, rtol=1e-6)


#: Of a brake of which nothing is known yet; to read.
_NEW = new_state()[0]


def _sensitivities(p, force, slope, speed, accelerating, motor_torque, friction_mean, warmth, heats, changed=0.0):
    """Sensitivity of force and of the torque left unexplained, as `fuse` forms them."""
    to_f, to_t = np.zeros(STATES), np.zeros(STATES)
    leverage = p["gear_gain"] + p["load_friction"] * friction_mean
    to_force(to_f, _NEW, p["stiffness_sigma"] + p["stiffness_relative_sigma"] * force, slope, force, warmth)
    to_t[:] = to_f
    slow = friction_mean * np.exp(-abs(speed) / 10.0)
    to_torque(to_t, leverage, 1.0, friction_mean, force, speed, slow, accelerating, motor_torque, changed, *heats)
    return to_f, to_t


def test_covariance_stays_symmetric_and_positive_over_long_random_input(parameters):
    p, rng = brake.ideal(parameters), np.random.default_rng(7)
    x, P, gain, walked = np.zeros(STATES), np.zeros((STATES, STATES)), np.zeros(STATES), np.zeros(STATES)
    set_priors(P, p)
    add_stiffness_jumps(P, p)
    add_torque_jumps(P, p)
    for number in range(20_000):
        set_walks(walked, p, x, P, *rng.uniform(0.0, 1.0, 2), rng.uniform(0.0, 0.2), rng.uniform(0.0, 1e5), 0.0, 0.004)
        predict_errors(x, P, rng.uniform(0.9, 1.0), rng.uniform(0.3, 1.0), 3e-4, walked)
        force = rng.uniform(0.0, 3e4)
        heats = rng.uniform(0.0, 1.0, 2)
        _, h = _sensitivities(
            p,
            force,
            rng.uniform(0, 2e3),
            rng.uniform(-2e2, 2e2),
            rng.normal(),
            4e-5 * force,
            rng.uniform(-1, 1),
            0.0,
            heats,
            0.1,
        )
        s = _update(x, P, gain, rng.normal(0.0, 0.1), h, 10.0 ** rng.uniform(-6, -2))
        assert s > 0.0
        if number % 100 == 0:
            assert np.array_equal(P, P.T)
            scale = np.sqrt(np.diag(P))
            assert np.all(scale[np.arange(STATES) != GROWTH] > 0.0)
            known = np.flatnonzero(scale)
            assert np.linalg.eigvalsh(P[np.ix_(known, known)] / np.outer(scale[known], scale[known])).min() > -1e-9


def test_filter_is_consistent_on_data_of_its_own_model(parameters):
    """Drawn errors of every kind: normalised innovations have variance one and are white, the error of the state
    normalised by its covariance is as large as it has dimensions, and 95 % of the true forces lie within two sigma."""
    p, rng = brake.ideal(parameters), np.random.default_rng(8)
    decay, noise_decay, noise, variance, runs, steps = 0.995, 0.6, 3e-4, 1e-4, 60, 500
    nis, signed, nees, inside, checks = [], [], [], 0, 0
    for _ in range(runs):
        P, walked, x, gain = np.zeros((STATES, STATES)), np.zeros(STATES), np.zeros(STATES), np.zeros(STATES)
        set_priors(P, p)
        add_stiffness_jumps(P, p)
        add_growth(P, p)
        add_torque_jumps(P, p)
        P[NOISE, NOISE] = noise
        truth = rng.normal(size=STATES) * np.sqrt(np.diag(P))
        for step in range(steps):
            phase = 0.05 * step
            force, speed = 8000.0 * (1.0 + np.sin(phase)), 100.0 * np.cos(phase)
            inertia = -5.0 / 0.004 * np.sin(phase) * p["inertia"]
            arguments = (
                force,
                250.0 + 0.1 * force,
                speed,
                inertia,
                5e-5 * force + inertia,
                np.tanh(speed / 5.0),
                0.2 * step,
                (step / 1e3, step / 4e3),
                0.1 * np.cos(phase),
            )
            to_f, h = _sensitivities(p, *arguments)
            set_walks(walked, p, np.zeros(STATES), P, step / 1e3, step / 4e3, 0.0, 2e4, 0.0, 0.004)
            truth[FAST], truth[NOISE] = decay * truth[FAST], noise_decay * truth[NOISE]
            drive = walked.copy()
            drive[FAST], drive[NOISE] = 1.0 - decay**2, (1.0 - noise_decay**2) * noise
            truth += rng.normal(size=STATES) * np.sqrt(drive)
            predict_errors(x, P, decay, noise_decay, noise, walked)
            innovation = h @ truth + rng.normal() * np.sqrt(variance) - h @ x
            s = _update(x, P, gain, innovation, h, variance)
            nis.append(innovation**2 / s)
            signed.append(innovation / np.sqrt(s))
            if step % 50 == 49:
                checks += 1
                inside += abs(to_f @ (truth - x)) < 2.0 * np.sqrt(force_variance(P, to_f))
        scale = np.sqrt(np.diag(P))
        off = (truth - x) / scale
        nees.append(off @ np.linalg.solve(P / np.outer(scale, scale), off))
    assert np.mean(nis) == pytest.approx(1.0, abs=0.04)
    signed = np.reshape(signed, (runs, steps))
    assert np.mean(signed[:, 1:] * signed[:, :-1]) == pytest.approx(0.0, abs=0.03)
    # Mean of chi-square values of as many degrees of freedom as states, three standard deviations.
    assert np.mean(nees) == pytest.approx(STATES, abs=3.0 * np.sqrt(2.0 * STATES / runs))
    assert 0.92 <= inside / checks <= 0.98


#: Error of each kind, what it is in the brake (m, N, N m, rad/s...), and share of it that may be left after some strokes.
_ERRORS = {
    "contact": (CONTACT, lambda p: 20e-6 / p["gear_gain"], 0.2),
    "scale": (SCALE, lambda p: 0.1, 0.4),
    "gain": (GAIN, lambda p: 0.05, 0.6),
    "offset": (OFFSET, lambda p: 0.05 * p["gear_gain"] * p["maximum_force"], 0.2),
    "load": (LOAD, lambda p: 0.5 * p["load_friction"], 0.4),
    "coulomb": (COULOMB, lambda p: 0.5 * p["offset_friction"], 0.4),
    "late": (LATE, lambda p: 0.3, 0.2),
    "viscous": (VISCOUS, lambda p: 0.3 * p["offset_friction"] / p["maximum_speed"], 0.4),
}


@pytest.mark.parametrize("name", _ERRORS)
def test_an_error_of_each_kind_is_found_from_strokes(parameters, name):
    """One error alone, among priors that would allow every jump: strokes that clamp, hold, release and reverse give most of it
    back, and what is left is within three of the stated standard deviations."""
    p, rng = brake.ideal(parameters), np.random.default_rng(9)
    state, size, share = _ERRORS[name]
    truth = np.zeros(STATES)
    truth[state] = size(p)
    x, P, gain, walked = np.zeros(STATES), np.zeros((STATES, STATES)), np.zeros(STATES), np.zeros(STATES)
    set_priors(P, p)
    add_stiffness_jumps(P, p)
    add_torque_jumps(P, p)
    variance = (p["torque_constant"] * p["current_sigma"]) ** 2
    decay, noise_decay = np.exp(-0.004 / p["stiffness_correlation_time"]), np.exp(-0.004 / p["current_correlation_time"])
    before = 0.0
    for step in range(4000):
        phase = 0.02 * step
        force = max(12e3 * (0.7 - np.cos(phase)), 0.0)
        speed = 60.0 * np.sin(phase) + 30.0 * np.sin(3.1 * phase)
        inertia = p["inertia"] * 0.02 / 0.004 * (60.0 * np.cos(phase) + 93.0 * np.cos(3.1 * phase))
        friction = np.clip(speed / 5.0, -1.0, 1.0)
        motor = (p["gear_gain"] + p["load_friction"] * friction) * force + inertia + p["offset_friction"] * friction
        slope = (0.15 * force + 250.0) * (force > 0.0)
        _, h = _sensitivities(p, force, slope, speed, inertia, motor, friction, 0.0, (0.0, 0.0), motor - before)
        before = motor
        set_walks(walked, p, x, P, 0.0, 0.0, 0.0, 0.0, 0.0, 0.004)
        predict_errors(x, P, decay, noise_decay, variance, walked)
        innovation = h @ truth + rng.normal() * np.sqrt(variance) - h @ x
        _update(x, P, gain, innovation, h, variance)
    off = truth[state] - x[state]
    assert abs(off) < share * abs(truth[state]), x[state] / truth[state]
    assert abs(off) < 3.0 * np.sqrt(P[state, state])
    others = [i for i in range(STATES) if P[i, i] > 0.0]
    assert np.all(np.abs((truth - x)[others]) < 3.5 * np.sqrt(np.diag(P)[others])), "an innocent state took the blame"


def test_sigma_grows_while_the_torque_path_is_missing(parameters):
    p = brake.ideal(parameters)
    moving = np.concatenate([brake.clamp(p, 15.0, 1.0), p["clearance"] + 15.0 + 2.0 * np.sin(np.arange(1000) * 0.05)])
    rows, _ = brake.samples(p, moving)
    rows["has_current"][500:] = False
    without = estimate(rows, p)
    full = rows.copy()
    full["has_current"] = True
    with_torque = estimate(full, p)
    turning = slice(520, None)
    assert np.array_equal(without["sigma"][:500], with_torque["sigma"][:500])
    assert np.all(without["stiffness_sigma"][turning] > with_torque["stiffness_sigma"][turning])
    # Which share of the force the pads still have to gain falls in the first turns; nothing falls without the torque alone.
    same_place = (without["sigma"] / with_torque["sigma"])[500::126]
    assert np.all(same_place[1:] > same_place[0]) and same_place[0] > 1.0


def test_friction_energy_leaves_the_contact_angle_open(parameters):
    """A third of a MJ with nothing to see the contact angle by: wear and growth move it by micrometres per MJ, and by nothing
    where the disc stands."""
    p = brake.ideal(parameters)
    rows, _ = brake.samples(p, np.concatenate([brake.clamp(p, 12.0, 1.0), np.full(1000, p["clearance"] + 12.0)]))
    rows["has_current"][250:] = False
    grown_m, energy_J = [], []
    for speed in (0.0, 80.0):
        rows["wheel_speed"] = speed
        state = new_state()
        estimate(rows[:250], p, state)
        before = state["covariance"][0, CONTACT, CONTACT]
        estimate(rows[250:], p, state)
        grown_m.append(p["gear_gain"] * np.sqrt(state["covariance"][0, CONTACT, CONTACT] - before))
        energy_J.append(4.0 * state["power"][0])
    assert energy_J[0] == 0.0 and energy_J[1] > 2e5
    assert grown_m[0] < 0.05e-6
    assert 0.3e-6 < grown_m[1] < 3e-6


@pytest.mark.parametrize("found, open_yet", [(0.1, 1e-3), (1e-3, 0.1)])
def test_the_torque_constant_walks_with_the_fade_that_driving_found(parameters, found, open_yet):
    """What two lags miss of the motor's heat is a share of what heat does: nothing in a motor that was found not to fade
    though it is hot, per cents in one that fades or may."""
    p, walked = brake.ideal(parameters), np.zeros(STATES)

    def walk(fade, sigma, heat):
        x, P = np.zeros(STATES), np.zeros((STATES, STATES))
        x[FADE], P[FADE, FADE] = fade, sigma**2
        set_walks(walked, p, x, P, heat, 0.0, 0.0, 0.0, 0.0, 10.0)
        return np.sqrt(walked[GAIN])

    cold = walk(found, open_yet, 0.0)
    assert walk(5e-4, 5e-4, 1.0) < 1.2 * cold
    assert 0.02 < walk(found, open_yet, 1.0) < 0.04
    assert walk(found, open_yet, 0.5) == pytest.approx(0.5 * walk(found, open_yet, 1.0), rel=0.02)


def test_force_of_an_ideal_brake_is_found_within_its_sigma(parameters):
    """Slow clamp, hold, release: with the model's own parameters the error is far below sigma's claim."""
    p = brake.ideal(parameters)
    up = brake.clamp(p, 20.0, 4.0)
    rows, force = brake.samples(p, np.concatenate([up, np.full(250, up[-1]), up[::-1]]))
    estimates = estimate(rows, p)
    clamped = force > 500.0
    assert force.max() > 12_000.0
    assert np.all(np.abs(estimates["force"] - force)[clamped] < 2.0 * estimates["sigma"][clamped])
    np.testing.assert_allclose(estimates["stiffness_force"][clamped], force[clamped], rtol=0.01, atol=20.0)


def test_contact_angle_is_learned_from_the_torque(parameters):
    """A brake whose contact lies 0.1 rad from where it is expected: sliding under load pulls the estimate towards it."""
    p = brake.ideal(parameters)
    p["clearance_sigma"] = 0.1
    true = p.copy()
    true["clearance"] = p["clearance"] + 0.1
    up = brake.clamp(true, 25.0, 3.0)
    rows, force = brake.samples(true, np.concatenate([up, up[::-1], up]))
    estimates = estimate(rows, p)
    before, after = estimates["contact_angle"][0], estimates["contact_angle"][-1]
    assert before == pytest.approx(true["clearance"] - 0.1)
    assert abs(after - true["clearance"]) < 0.04
    # Friction may be off by its own share, which torque tells as contact angle: less is left than there was, but not little.
    assert 0.05 < estimates["contact_sigma"][-1] < 0.1
    assert abs(estimates["force"][-1] - force[-1]) < 2.0 * estimates["sigma"][-1]


@pytest.mark.parametrize("share", [-0.2, 0.2])
def test_what_no_model_of_the_torque_explains_moves_no_force_where_the_calibration_states_it(share):
    """A gear that gives and takes 20 % beyond 3 kN looks to the torque like other pads, as nothing of it is calibrated."""
    samples, force = city.drive(seconds=60.0)
    calibration = shipped_calibration()
    motor = calibration.motor
    lost = share * np.maximum(force - 3000.0, 0.0) * motor.gear_gain_m_per_rad / motor.torque_constant_Nm_per_A
    samples = samples.copy()
    samples["current_q"] += lost

    def errors(lasting):
        estimates = estimate(samples, to_parameters(moved(calibration, {"noise.torque_lasting": lasting})))
        error = estimates["force"] - force
        return np.sqrt(np.mean(error**2)), np.mean(np.abs(error) < 2.0 * np.hypot(estimates["sigma"], 25.0))

    unsaid, said = errors(0.0), errors(0.1)
    assert unsaid[0] > 1000.0 and unsaid[1] < 0.7
    assert said[0] < 50.0 and said[1] > 0.95


def test_a_torque_that_may_be_off_says_less_of_the_force_alone(parameters):
    """Where the resolver is not believed, its share of the force is in sigma."""
    samples, _ = city.drive()
    samples = samples.copy()
    frozen = samples[city.CLAMPING : city.CLAMPING + 500]
    frozen["angle"], frozen["speed"] = frozen["angle"][0], frozen["speed"][0]
    without = estimate(samples, parameters)
    parameters["torque_lasting_sigma"] = 0.2
    stated = estimate(samples, parameters)
    alone = (without["source"] == TORQUE_ONLY) & (stated["source"] == TORQUE_ONLY)
    assert alone.sum() > 300 and stated["force"][alone].max() > 5000.0
    assert stated["sigma"][alone] == pytest.approx(np.hypot(without["sigma"][alone], 0.2 * stated["force"][alone]), rel=0.1)


@pytest.mark.parametrize("seed", [1, 2])
def test_at_a_reduced_rate_a_motor_that_turns_back_unseen_is_no_change_of_the_brake(parameters, seed):
    """Samples ten times a second show neither its arrival nor that friction has turned over: half of the friction was taken
    for other pads, 400 to 540 N where the stiffness path alone had 14 N."""
    p = brake.ideal(parameters)
    hold, back = p["clearance"] + 6.0, 0.02
    ramp = 0.5 * (1.0 - np.cos(np.pi * np.arange(75) / 75))
    settling = hold - back * 0.5 * (1.0 - np.cos(np.pi * np.arange(10) / 10))
    cycle = [hold * ramp, settling, np.full(7500, hold - back), (hold - back) * (1.0 - ramp), np.zeros(1250)]
    samples, force = brake.samples(p, np.concatenate([np.zeros(250), *12 * cycle]))
    samples, force = brake.noisy(samples, p, seed)[::25].copy(), force[::25]
    samples["dt"][1:] = 0.1
    estimates = estimate(samples, p)
    clamped = force > 1000.0
    error = (estimates["force"] - force)[clamped]
    assert np.sqrt(np.mean(error**2)) < 120.0
    assert np.all(np.abs(error) < 2.0 * estimates["sigma"][clamped])
