"""Identification finds what simulated rigs were given, and says how well it knows it."""

import dataclasses
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import foreignkit
import numpy as np
import pytest
from msgspec.structs import replace
from synthetic_rig import datasheet, draw, pads

import emb_daemon
from emb_daemon.calibration.curves import Curve, curve_at, rising_force
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.parameters import INERTIA, LOAD_FRICTION, TORQUE_CONSTANT, moved, value_of
from emb_daemon.calibration.terms import Term
from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose.diagnosis import EPISODES
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.campaign_file import CampaignFile, Datasheet
from emb_daemon.identify.dynamics import (
    DELAY,
    OPTIONAL,
    RELAXATION,
    TERMS,
    CurveFit,
    DynamicsFit,
    Pads,
    clearance_guess,
    errors_unseen,
    fit_dynamics,
    powers,
    regress_free,
    simulate,
    starting_point,
)
from emb_daemon.identify.steps import attribution, contact, noise, stiffness, torque
from emb_daemon.identify.steps.held_out import Fold
from emb_daemon.identify.steps.thickness import ThicknessStep, left_out_errors
from emb_daemon.identify.steps.torque import KEYS, TorqueFit, Unexplained, fit_torque, unexplained_current
from emb_daemon.identify.validation import why_worse
from emb_daemon.offline import log_of
from emb_daemon.offline.run import held, run_step
from emb_daemon.offline.score import rmse
from emb_daemon.plant.brake import SIGNALS as PLANT_SIGNALS
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import rest, simulate_log
from studies.drives import rig_stop


def _datasheet_of(truth, rng) -> Datasheet:
    """What a supplier would state of a rig, each value off by its tolerance's standard deviation."""
    constant, inertia = (truth.torque[key] * (1.0 + 0.15 * rng.normal()) for key in (TORQUE_CONSTANT, INERTIA))
    return datasheet(constant, inertia)


def _fit(truth, groups) -> DynamicsFit:
    return fit_dynamics(groups, starting_point(groups, truth.nominal()), search=True)


def _deviations(seed):
    """Every identified parameter's error in units of its own sigma."""
    rng = np.random.default_rng(seed)
    truth = draw(rng)
    groups = pads(truth, rng)
    fit = _fit(truth, groups)
    torque = fit_torque([log for group in groups for log in group.logs], truth.nominal(), _datasheet_of(truth, rng))
    found = [(fit.value(key) - value) / fit.sigmas[key] for key, value in (truth.dynamics | {DELAY: truth.delay_s}).items()]
    found += [(torque.values[name] - value) / torque.sigmas[name] for name, value in truth.torque.items()]
    for curve in fit.curves:
        x = np.linspace(0.3, 0.95, 3) * curve.travel_rad
        static = sum(c * x ** (n + 1) for n, c in enumerate(truth.curves[curve.thickness_mm]))
        found += list((curve.force(x) - static) / curve.force_sigma(x))
        found += list((curve.clearances_rad - truth.clearance) / curve.clearance_sigmas_rad)
    return found


@pytest.mark.parametrize("measured", [0.98, 0.7, 0.4])
def test_a_curve_is_as_unsure_beyond_its_last_travel_as_what_it_rises_by_there(measured):
    """Coefficients whose errors cancel where the logs were: what they leave of the force at the last travel is in the errors
    on other logs, and the rest of the way to the largest force is all that sigma has to grow by. Without another log it is
    nowhere else."""
    reached, rated_N = measured * 20.0, 20e3
    x = np.linspace(0.1, reached, 400)
    curve = np.array([200.0, 20.0, 1.0])
    seen = np.linalg.inv(powers(x).T @ powers(x)) * 50.0**2 * 40.0
    fit = CurveFit(8.0, curve, seen, np.zeros(1), np.ones(1), reached)
    drawn = np.random.default_rng(1).multivariate_normal(curve, seen, 4000)
    rise = drawn @ (powers(np.array([20.0])) - powers(np.array([reached])))[0]
    sigma, alone = (
        noise._extrapolation(
            SimpleNamespace(fit=SimpleNamespace(curves=[fit]), pads=[SimpleNamespace(logs=[None] * logs)]), rated_N
        )
        for logs in (2, 1)
    )
    assert sigma == pytest.approx(np.std(rise) / rated_N, rel=0.05)
    whole = float(fit.force_sigma(np.array([20.0]))[0]) / rated_N
    assert (sigma < 0.4 * whole) == (measured > 0.9) and alone == pytest.approx(whole)


def test_a_datasheet_that_is_nearly_certain_is_believed_and_a_contradiction_is_told():
    rng = np.random.default_rng(31)
    truth = draw(rng)
    logs = [log for group in pads(truth, rng) for log in group.logs]
    constant, inertia = truth.torque[TORQUE_CONSTANT], truth.torque[INERTIA]
    certain = fit_torque(logs, truth.nominal(), datasheet(1.02 * constant, inertia, tolerance=1e-6))
    assert certain.values[TORQUE_CONSTANT] == pytest.approx(1.02 * constant, rel=1e-5)
    assert certain.sigmas[TORQUE_CONSTANT] < 1e-6 * constant
    sheet = datasheet(1.2 * constant, inertia, tolerance=0.15)
    found = fit_torque(logs, truth.nominal(), sheet)
    assert found.values[TORQUE_CONSTANT] == pytest.approx(constant, rel=0.01)
    campaign = Campaign(Path("campaign.yaml"), CampaignFile(rig="X", datasheet="datasheet.yaml"), sheet)
    campaign.compare_with_datasheet(TORQUE_CONSTANT, found.values[TORQUE_CONSTANT])
    campaign.compare_with_datasheet(INERTIA, inertia)
    (fault,) = campaign.faults
    assert fault.startswith("motor.torque_constant_Nm_per_A: identified") and "within 15 %" in fault


@pytest.mark.trial
def test_parameters_of_other_actuators_are_recovered_within_three_sigma():
    deviations = np.abs(np.concatenate([_deviations(1000 + seed) for seed in range(8)]))
    assert np.mean(deviations < 3.0) >= 0.95
    # Sigmas that are far too wide would pass the line above.
    assert np.sqrt(np.mean(np.minimum(deviations, 5.0) ** 2)) > 0.6


def test_fit_reaches_the_noise_of_the_reference():
    rng = np.random.default_rng(3)
    truth = draw(rng)
    fit = _fit(truth, pads(truth, rng))
    assert fit.rms == pytest.approx(truth.reference_noise_N, rel=0.03)


@pytest.mark.parametrize("effect", OPTIONAL, ids=lambda effect: effect.name)
def test_an_effect_that_is_not_there_is_not_clear_of_zero(effect):
    """Nor is its opposite there, which is not fitted with it."""
    rng = np.random.default_rng(5)
    truth = draw(rng)
    share = f"effects.{effect.name}.share"
    truth.dynamics[share] = 0.0
    tried = [other for other in OPTIONAL if effect.name != other.opposes and other.name != effect.opposes]
    if effect.opposes:
        truth.dynamics[f"effects.{effect.opposes}.share"] = 0.0
    groups = pads(truth, rng)
    fit = fit_dynamics(groups, starting_point(groups, truth.nominal(), tuple(tried)), search=True)
    assert fit.value(share) < 3.0 * fit.sigmas[share] or fit.value(share) < 1e-3


@pytest.mark.trial
@pytest.mark.parametrize("there", [True, False])
def test_one_more_relaxation_is_taken_in_where_it_is_and_only_there(there):
    rng = np.random.default_rng(7)
    truth = draw(rng, thicknesses=(6.0,))
    own = {"effects.third_relaxation.share": 0.06, "effects.third_relaxation.time_constant_s": 5.0}
    truth.dynamics.update(own if there else {})
    found = stiffness.identify(pads(truth, rng), truth.nominal())
    assert ("third_relaxation" in [effect.name for effect in found.chosen.effects]) == there
    if there:
        assert found.fit.rms == pytest.approx(truth.reference_noise_N, rel=0.05)
        for key, value in own.items():
            assert abs(found.values[key] - value) < 4.0 * found.sigmas[key]


@pytest.mark.trial
def test_pads_that_yield_are_told_from_pads_that_lag():
    """Force that falls at a held angle, over two decades of time, instead of rising: neither a lag nor a loop describes it."""
    rng = np.random.default_rng(13)
    truth = draw(rng, thicknesses=(6.0,))
    own = {
        "effects.stress_relaxation.share": 0.04,
        "effects.stress_relaxation.time_constant_s": 0.08,
        "effects.slow_stress_relaxation.share": 0.03,
        "effects.slow_stress_relaxation.time_constant_s": 3.0,
    }
    loop = {key: value for key, value in truth.dynamics.items() if "hysteresis" in key}
    truth = dataclasses.replace(truth, dynamics={RELAXATION: 1e-4} | loop | own)
    found = stiffness.identify(pads(truth, rng), truth.nominal())
    names = {effect.name for effect in found.chosen.effects}
    assert names == {"stiffness_hysteresis", "stress_relaxation", "slow_stress_relaxation"}
    tried = [{effect.name for effect in c.effects} for c in found.candidates]
    assert not any({"stress_relaxation", "second_relaxation"} <= names for names in tried)
    taken_for_slip = [c for c in found.candidates if "stress_relaxation" not in {effect.name for effect in c.effects}]
    assert min(c.held_out_rmse for c in taken_for_slip) > 2.0 * found.chosen.held_out_rmse
    assert found.fit.rms == pytest.approx(truth.reference_noise_N, rel=0.05)
    for key, value in own.items():
        assert abs(found.values[key] - value) < 4.0 * found.sigmas[key]


def test_the_free_regression_is_exact_on_data_of_its_form():
    """Thesis 3.4's own difference equation, computed here without the estimator's kernels."""
    rng = np.random.default_rng(11)
    truth = draw(rng)
    log = pads(truth, rng)[0].logs[1]
    x = np.maximum(log.samples["angle"] - truth.clearance, 0.0)
    static = sum(c * x ** (n + 1) for n, c in enumerate(truth.curves[4.0]))
    ratio, force = 0.03 / 0.004, log.force_N
    force[0] = 0.0
    for row in range(1, len(force)):
        force[row] = (static[row] + ratio * force[row - 1]) / (1.0 + ratio)
    coefficients, time_constant = regress_free(log, log.samples["angle"] - truth.clearance)
    # alpha_0 = tau / (tau + dt), read as exp(-dt / tau).
    assert time_constant == pytest.approx(-0.004 / np.log(0.03 / 0.034), rel=1e-6)
    assert coefficients == pytest.approx(truth.curves[4.0], rel=1e-4)


def _coloured(rng, count, sigma, time_constant):
    decay = np.exp(-0.004 / time_constant)
    noise_of, drive = np.zeros(count), rng.normal(0.0, sigma * np.sqrt(1.0 - decay**2), count)
    for row in range(1, count):
        noise_of[row] = decay * noise_of[row - 1] + drive[row]
    return noise_of


def test_integral_time_of_first_order_noise_is_its_time_constant():
    series = [_coloured(np.random.default_rng(seed), 50_000, 3.0, 0.05) for seed in range(3)]
    assert noise.integral_time(series) == pytest.approx(0.05, rel=0.12)
    white = [np.random.default_rng(seed).normal(size=20_000) for seed in range(3)]
    assert noise.integral_time(white) == pytest.approx(0.002, rel=0.1)


@pytest.mark.parametrize("difference_A", [0.0, 0.28])
def test_current_noise_tells_what_is_coloured_from_a_difference_of_noisy_speeds(difference_A):
    rng = np.random.default_rng(19)
    white = rng.normal(0.0, difference_A / np.sqrt(2.0), 40_001)
    series = [_coloured(rng, 40_000, 0.3, 0.02) + np.diff(white)]
    sigma, time = noise.current_noise(series, difference_A)
    assert (sigma, time) == pytest.approx((0.3, 0.02), rel=0.1)


def test_an_error_that_lasts_for_a_manoeuvre_is_in_the_noise_of_the_current():
    """The spectral density at low frequency, 2 sigma^2 time, rises by that of the lasting part; without one nothing is
    added."""
    plain = _coloured(np.random.default_rng(3), 60_000, 0.3, 0.02)
    stays = np.repeat(np.random.default_rng(4).normal(0.0, 0.2, 240), 250)
    sigma, time = noise._with_what_lasts([plain], 0.3, 0.02)
    assert sigma**2 * time == pytest.approx(0.3**2 * 0.02, rel=0.15)
    sigma, time = noise._with_what_lasts([plain + stays], 0.3, 0.02)
    assert sigma == pytest.approx(np.hypot(0.3, 0.2), rel=0.03)
    assert sigma**2 * time == pytest.approx(0.3**2 * 0.02 + 0.2**2 * 1.0, rel=0.2)
    assert noise._with_what_lasts([plain[:100]], 0.3, 0.02) == (0.3, 0.02)


def test_current_noise_is_found_from_short_stretches_where_there_are_no_others():
    """Friction that turns over for most of a slow clamp leaves tens of samples at a time in which it is known."""
    found = TorqueFit(dict.fromkeys(KEYS, 1.0), np.eye(len(KEYS)), {})
    rows = np.concatenate([np.arange(20) + 100 * piece for piece in range(100)])
    current = np.random.default_rng(7).normal(0.0, 0.2, len(rows))
    left = Unexplained(found, rows, current, np.ones(len(rows)), np.linspace(1e3, 2e3, len(rows)))
    assert noise.torque_levels([left], 1e-5, 0.0)["current_A"] == pytest.approx(0.2, rel=0.15)


def test_errors_of_a_fit_are_on_samples_that_were_not_fitted():
    """On the second halves of random logs and on whole slow logs; the reference is two samples late here."""
    known = foreignkit.calibration()
    clearance, logs = known.contact.clearance_rad, []
    for angle in (foreignkit.slow(), foreignkit.random(seconds=8.0)):
        truth = foreignkit.truth(angle)
        time_s, angle, speed, force = (column[::8] for column in (truth.time_s, truth.angle, truth.speed, truth.force))
        late = np.roll(force, 2)
        late[: len(late) // 2] += 1000.0
        late[-200:-100] = np.nan
        logs.append(emb_daemon.log_of_arrays(time_s, angle, speed, force_N=late))
    fit = SimpleNamespace(calibration=known, curves=[SimpleNamespace(clearances_rad=np.full(2, clearance))])
    groups = [Pads(known.pad_thickness_mm, tuple(logs))]
    (slow, _), (random, force) = errors_unseen(groups, fit, 0.008)
    assert rmse(slow) == pytest.approx(1000.0 * np.sqrt(0.5), rel=0.02)
    assert len(random) == len(force) == pytest.approx(1000 - 95, abs=8) and np.isfinite(random).all()
    [(alone, _)] = errors_unseen(groups, fit, 0.008, slow=False)
    assert np.array_equal(alone, random) and rmse(random) < 0.2 * rmse(errors_unseen(groups, fit)[1][0])


def _one_curve():
    """The brake of `foreignkit` with no more than a curve of its own pads."""
    known = foreignkit.calibration()
    thickness_mm = known.pad_thickness_mm
    coefficients = tuple(curve_at(known.stiffness.curves, thickness_mm)[:TERMS].tolist())
    curve = Curve(pad_thickness_mm=thickness_mm, coefficients=coefficients)
    return replace(known, effects={}, stiffness=replace(known.stiffness, curves=(curve,)))


def _slow_log(known, *, stiffer=1.0, seed=0):
    """A slow clamp whose force is the stiffness path's, from a sensor with 20 N of noise."""
    truth = foreignkit.truth(foreignkit.slow(seconds=20.0))
    time_s, angle, speed = (column[::8] for column in (truth.time_s, truth.angle, truth.speed))
    log = emb_daemon.log_of_arrays(time_s, angle, speed, force_N=0.0 * angle)
    force = stiffer * simulate(log, known, known.pad_thickness_mm, known.contact.clearance_rad)
    return dataclasses.replace(log, force_N=force + np.random.default_rng(seed).normal(0.0, 20.0, len(force)))


@pytest.mark.parametrize("there", [True, False])
def test_a_slow_clamp_alone_shows_hysteresis_and_slow_relaxation(there):
    """A loop and a slow relaxation are found where they are. Where neither is, a first relaxation of another time than the
    usual one looks a little like a loop, and none is found."""
    own = {
        "effects.stiffness_hysteresis.share": 0.02,
        "effects.stiffness_hysteresis.slip_angle_rad": 1.0,
        "effects.second_relaxation.share": 0.1,
        "effects.second_relaxation.time_constant_s": 0.8,
    }
    known = moved(_one_curve(), own | {RELAXATION: stiffness.USUAL_RELAXATION_S} if there else {RELAXATION: 0.0284})
    groups = [Pads(known.pad_thickness_mm, (_slow_log(known),))]
    found = stiffness.identify(groups, replace(known, effects={}))
    assert sorted(effect.name for effect in found.chosen.effects) == (
        ["second_relaxation", "stiffness_hysteresis"] if there else []
    )
    assert found.sigmas[RELAXATION] == found.values[RELAXATION] == stiffness.USUAL_RELAXATION_S
    assert found.fit.rms < 25.0
    if there:
        assert found.values["effects.second_relaxation.share"] == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize("preload_N", [0.0, 2000.0])
def test_a_log_that_begins_without_a_force_begins_before_contact(preload_N):
    """A force that rises at once and then flattens is no cubic from contact on: a contact far before the log would fit it, but
    no other log."""
    known = _one_curve()
    log = _slow_log(known)
    travel = log.samples["angle"] - log.samples["angle"][0]
    log = dataclasses.replace(log, force_N=preload_N + 2e4 * np.sqrt(travel / travel.max() + 1e-4) - 200.0)
    found = fit_dynamics([Pads(known.pad_thickness_mm, (log,))], known, shared=()).curves[0].clearances_rad
    assert found < 0.0 if preload_N else found >= 0.0


@pytest.mark.parametrize(("zero_N", "drag_N", "apart"), [(0.0, 13.0, 0.5), (30.0, 30.0, 6.0)])
def test_a_constant_drag_before_contact_is_no_contact(zero_N, drag_N, apart):
    """The best cubic from the start of the drag on rises, falls and rises again, so that the calibration ended at a fortieth
    of the force. A zero or drag of a tenth of the force may still put the contact too early, but the curve rises."""
    known = _one_curve()
    time_s = 0.015 * np.arange(500)
    angle = np.clip(6.0 * (time_s - 0.5), 0.0, 34.5)
    force_N = zero_N + drag_N * np.minimum(angle, 1.0) + (600.0 / 20.25) * np.maximum(angle - 30.0, 0.0) ** 2
    log = emb_daemon.log_of_arrays(time_s, angle, force_N=0.0 * angle)
    log = dataclasses.replace(log, force_N=np.interp(log.time_s, time_s, force_N))
    found = stiffness.identify([Pads(known.pad_thickness_mm, (log,))], replace(known, effects={})).fit
    assert found.curves[0].clearances_rad == pytest.approx(30.0, abs=apart)
    assert found.curves[0].rises and rising_force(found.curves[0].coefficients) > 0.9 * force_N.max()
    assert found.rms < 0.08 * force_N.max()


def _press_log(way_s, ripple_N=0.0):
    """A slow press, ``way_s`` each way, on what rises with the square of its travel, and half as long open again."""
    time_s = 0.05 * np.arange(round(50.0 * way_s))
    angle = 50.0 * np.clip(1.0 - np.abs(time_s / way_s - 1.0), 0.0, None)
    log = emb_daemon.log_of_arrays(time_s, angle, force_N=0.0 * angle)
    force_N = 9.0 * np.maximum(log.samples["angle"] - 30.0, 0.0) ** 2
    force_N += np.sign(force_N) * ripple_N * np.sin(0.2 * np.pi * log.time_s)
    return dataclasses.replace(log, force_N=force_N + np.random.default_rng(3).normal(0.0, 1.0, len(force_N)))


@pytest.fixture(scope="module")
def pressed():
    known = _one_curve()
    return stiffness.identify([Pads(known.pad_thickness_mm, (_press_log(20.0),))], replace(known, effects={}))


def test_a_bound_on_the_first_slope_bounds_the_sigma_of_the_contact(pressed):
    """With a free slope at contact, slope and contact angle compensate each other: the fit ended 30 rad off with a standard
    deviation of 400 rad."""
    curve = pressed.fit.curves[0]
    assert curve.clearances_rad == pytest.approx(30.0, abs=0.3) and curve.clearance_sigmas_rad < 0.3
    assert pressed.fit.rms < 4.0


def test_the_search_on_a_slow_log_starts_from_a_curve_that_fits_it():
    """The regression over the last sample takes a load cell's periodic error over the screw's turn for a lag of seconds: the
    search began at a third of the force and ended at another contact."""
    log, known = _press_log(200.0, ripple_N=60.0), _one_curve()
    start = starting_point([Pads(known.pad_thickness_mm, (log,))], known, ()).stiffness.curves[0].coefficients
    past = 50.0 - clearance_guess(log, log.samples["angle"] - log.samples["angle"][0])
    assert powers(np.array([past])) @ start == pytest.approx(log.force_N.max(), rel=0.1)


def test_a_force_that_decays_after_a_release_is_no_walk_of_the_contact(pressed):
    """Half a minute with the pads apart says nothing of their contact."""
    assert contact.identify(pressed, 1e-4, 30.0).values["contact.walk_rad_per_sqrt_s"] < 0.05


def test_a_loop_of_a_rubber_is_found():
    """Half of the force lost between clamping and release over a third of the travel."""
    own = {"effects.stiffness_hysteresis.share": 0.4, "effects.stiffness_hysteresis.slip_angle_rad": 15.0}
    known = moved(_one_curve(), own | {RELAXATION: stiffness.USUAL_RELAXATION_S})
    found = stiffness.identify([Pads(known.pad_thickness_mm, (_slow_log(known),))], replace(known, effects={}))
    for key, value in own.items():
        assert found.values[key] == pytest.approx(value, rel=0.05), key


@pytest.mark.trial
def test_a_slow_log_is_predicted_from_the_others_of_its_pads():
    """Judged on logs that were fitted, error and sigma would hold only half of the difference between two clamps."""
    known = _one_curve()
    logs = _slow_log(known), _slow_log(known, stiffer=1.2, seed=1)
    found = stiffness.identify([Pads(known.pad_thickness_mm, logs)], known)
    fitted = found.fit.rms
    assert all(rmse(error) > 1.8 * fitted > 200.0 for error, _ in found.chosen.held_out)


def test_the_current_unexplained_on_hot_logs_is_in_its_noise_where_cold_ones_leave_less():
    """A gear gain that follows heat shows on no cold log: without the hot ones the filter would trust the torque too much."""
    found = TorqueFit(dict.fromkeys(KEYS, 1.0), np.eye(len(KEYS)), {})
    rng, rows = np.random.default_rng(9), np.arange(20_000)

    def left(sigma_A, stays_A):
        stays = np.repeat(rng.normal(0.0, stays_A, len(rows) // 250), 250)
        current = rng.normal(0.0, sigma_A, len(rows)) + stays
        return Unexplained(found, rows, current, np.ones(len(rows)), np.full(len(rows), 1e4))

    cold, as_cold, hot, silent = left(0.2, 0.0), left(0.15, 0.0), left(0.2, 1.0), Unexplained(found, *[np.empty(0)] * 4)
    assert noise._more_current([cold], (as_cold, silent)) == []
    assert noise._more_current([silent], (hot,)) == []
    [counted] = noise._more_current([cold], (as_cold, hot))
    assert counted is hot
    levels = noise.torque_levels([cold, counted], 1e-5, 0.0)
    # Between what both logs together and the hot one alone leave.
    assert np.hypot(0.2, np.sqrt(0.5)) < levels["current_A"] < np.hypot(0.2, 1.0)
    density = levels["current_A"] ** 2 * levels["current_correlation_s"]
    assert density == pytest.approx(0.5 * 1.0, rel=0.3)


@pytest.mark.parametrize(("share", "found"), [(0.0, 0.0), (0.008, 0.0), (0.05, 0.05), (0.2, 0.2)])
def test_a_torque_error_that_is_constant_within_each_manoeuvre_is_lasting(share, found):
    """Neither noise of 0.3 N m on 1 N m nor an open brake counts as lasting. A hot log counts where cold ones show nothing."""
    fit = TorqueFit(dict.fromkeys(KEYS, 1.0) | {LOAD_FRICTION: 0.0}, np.eye(len(KEYS)), {})
    rng, rows = np.random.default_rng(11), np.delete(np.arange(20_000), slice(9_000, 9_250))
    force = np.where(rows % 2000 < 250, 10.0, 1e4 * rng.uniform(0.7, 1.3, len(rows)))

    def left(share):
        off = np.repeat(share * rng.choice([-1.0, 1.0], 80), 250)[rows]
        current = 1e-4 * off * force + rng.normal(0.0, 0.3, len(rows)) + np.where(force < 100.0, 1.0, 0.0)
        return Unexplained(fit, rows, current, np.zeros(len(rows)), force)

    silent = Unexplained(fit, *[np.empty(0)] * 4)
    assert noise._lasting([left(0.0), silent, left(share)], 1e-4, 2e4) == pytest.approx(found, rel=0.25)


def test_current_explained_by_a_term_over_brake_torque_is_no_noise(monkeypatch):
    """The whole step has to be run: the force paths of cold pads have no brake torque, so that the term would do nothing."""
    calibration = shipped_calibration()
    hidden = {"size": 0.2, "signal": PLANT_SIGNALS.index("brake_torque"), "exponent": 1.0, "other": -1.0}

    def drive(effects):
        plant = plant_from_calibration(calibration, seed=3, effects=effects)
        return log_of(simulate_log(plant, rest(1.0) + rig_stop(15e3, 50.0), seed=3)[0])

    term = Term(
        name="term:gear_gain:brake_torque", port="gear_gain", signal="brake_torque", shape="odd_power", coefficient=0.2,
        scale=1000.0, low=0.0, high=3e3,
    )  # fmt: skip
    found = TorqueFit({key: value_of(calibration, key) for key in KEYS}, np.eye(len(KEYS)), {})
    log, known = drive({"drawn_gear_gain": hidden}), replace(calibration, terms=(term,))
    cold, hot = (rmse(unexplained_current(log, found, known, hot=hot).current_A) for hot in (False, True))
    plain = rmse(unexplained_current(drive({}), found, calibration).current_A)
    assert cold > 3.0 * plain and hot < 1.3 * plain

    def lost(samples, parameters):
        trace = run_step(samples, parameters)
        trace["torque"][::2] = np.nan
        return trace

    # As where the zero of the angle was lost.
    monkeypatch.setattr(torque, "run_step", lost)
    assert rmse(unexplained_current(log, found, known, hot=True).current_A) == pytest.approx(hot, rel=0.1)
    assert np.isfinite(unexplained_current(log, found, known, hot=True).current_A).all()


def test_the_effect_of_a_term_over_temperature_on_cold_pads_is_no_error_of_a_fold():
    """Without the temperature, the error was 27 % where term and curve had been fitted together, and a brake known to 30 N had
    a sigma of a tenth of its force."""
    term = Term(
        name="term:stiffness:surface_temperature", port="stiffness", signal="surface_temperature", shape="decay",
        coefficient=-0.2, scale=600.0, low=20.0, high=300.0,
    )  # fmt: skip
    known = replace(shipped_calibration(), terms=(term,))
    log = log_of(simulate_log(plant_from_calibration(known, seed=3), rest(1.0) + rig_stop(15e3, 1.0), seed=3)[0])
    force = run_step(log.samples, held(to_parameters(known)))["force"]
    log = dataclasses.replace(log, force_N=force)
    found = TorqueFit({key: value_of(known, key) for key in KEYS}, np.eye(len(KEYS)), {})
    fold = Fold(pads=Pads(known.pad_thickness_mm, (log,)), held_out=(log,), torque=found, errors=[], unexplained=[])
    [(error, _)] = fold.under(known).errors
    assert rmse(force) > 3000.0 and rmse(error) < 1.0


def test_an_unknown_lag_counts_for_speeds_beyond_the_fastest_recorded_clamp():
    found = SimpleNamespace(fit=SimpleNamespace(curves=[SimpleNamespace(travel_rad=20.0)]))
    campaign = SimpleNamespace(datasheet=SimpleNamespace(actuator=SimpleNamespace(max_motor_speed_rad_per_s=200.0)))
    unseen, seen, faster = (noise._unknown_lag(found, campaign, speed) for speed in (0.0, 150.0, 250.0))
    assert unseen > 0.0 and seen == pytest.approx(0.25 * unseen) and faster == 0.0


@pytest.mark.parametrize(("share", "searched"), [(0.3, False), (0.8, True)])
def test_without_random_motion_a_campaign_is_searched_where_it_clamps_fast(monkeypatch, share, searched):
    """Slow motion does not show lag and inertia, and a search would explain their errors by something else."""
    calibration = shipped_calibration()
    speed = share * calibration.motor.maximum_speed_rad_per_s * np.array([0.0, 1.0, 1.5])
    drive = SimpleNamespace(samples={"speed": speed}, force_N=np.array([0.0, 5e3, 0.0]))
    without_random = SimpleNamespace(pads=[], fit=SimpleNamespace(curves=[]))

    def search(*_):
        raise InterruptedError

    monkeypatch.setattr(attribution, "Bench", lambda *_, **__: SimpleNamespace(episodes=EPISODES))
    monkeypatch.setattr(attribution, "diagnose_bench", search)
    monkeypatch.setattr(attribution, "_unsearched", lambda hot, known: known)
    with pytest.raises(InterruptedError) if searched else nullcontext():
        assert attribution.identify(without_random, [drive], calibration, print) is calibration


def test_force_error_levels_tell_floor_from_relative_part():
    rng = np.random.default_rng(23)
    force = rng.uniform(0.0, 20e3, 60_000)
    errors = rng.normal(size=len(force)) * np.hypot(30.0, 0.01 * force)
    floor, relative = noise.force_error_levels(errors, force)
    assert (floor, relative) == pytest.approx((30.0, 0.01), rel=0.05)


def test_curves_whose_compliance_grows_straight_are_predicted_exactly():
    base = np.array([300.0, 40.0, 0.8])
    curves = [
        CurveFit(t, base / (1.0 + np.array([0.04, 0.06, 0.1]) * t), np.eye(3), np.zeros(1), np.ones(1), 18.0)
        for t in (1.0, 4.0, 6.0, 11.0)
    ]
    errors = left_out_errors(curves)
    assert errors.shape == (2,) and np.all(errors < 1e-9)


def test_a_single_curve_is_unsure_of_other_pads_by_how_compliance_may_grow():
    """Pads half as thick again are up to half as soft again, uniformly distributed from nothing on; for the measured thickness
    the error is zero."""
    curve = CurveFit(8.0, np.array([300.0, 40.0, 0.8]), np.eye(3), np.zeros(1), np.ones(1), 18.0)
    only = ThicknessStep(curves=[curve], left_out=np.array([]))
    assert only.interpolation_error(8.0) == 0.0
    parts = np.linspace(0.0, 0.5, 1001)
    assert only.interpolation_error(12.0) == pytest.approx(np.sqrt(np.mean(parts**2)), rel=1e-3)
    assert only.interpolation_error(4.0) == pytest.approx(only.interpolation_error(12.0))


@pytest.mark.parametrize(("share", "told"), [(0.898, "89.8"), (0.8999, "89.9"), (0.893, "89"), (0.7, "70"), (0.9, None)])
def test_a_share_that_is_too_small_is_told_with_digits_that_say_so(share, told):
    lines = why_worse([SimpleNamespace(name="random", figures={"inside_two_sigma": share})])
    assert [line.partition(" % of")[0] for line in lines] == ([f"random: {told}"] if told else [])
