"""Identification finds what simulated rigs were given, and says how well it knows it."""

import numpy as np
import pytest
from synthetic_rig import COUNT_RAD, GEAR_GAIN, draw, pads

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.identify import noise
from emb_daemon.identify.fitting import Block, least_squares
from emb_daemon.identify.frequency import fit_first_order, phasor, steady_rows
from emb_daemon.identify.run import predict_curve, thickness_laws
from emb_daemon.identify.stiffness import (
    CurveFit,
    fit_dynamics,
    regress_damping,
    regress_free,
    simulate,
    thesis_curve,
    with_dynamics,
)
from emb_daemon.identify.torque import fit_torque
from emb_daemon.offline import estimate
from emb_daemon.resources import resource


def _deviations(seed):
    """Every identified parameter's error in units of its own sigma."""
    rng = np.random.default_rng(seed)
    truth = draw(rng)
    groups = pads(truth, rng)
    fit = fit_dynamics(groups)
    torque = fit_torque([log for group in groups for log in group.logs], GEAR_GAIN, COUNT_RAD)
    found = [(fit.dynamics.values[name] - value) / fit.dynamics.sigmas[name] for name, value in truth.dynamics.items()]
    found += [(torque.values()[name] - value) / torque.sigmas()[name] for name, value in truth.torque.items()]
    for curve in fit.curves:
        x = np.linspace(0.3, 0.95, 3) * curve.travel_rad
        static = sum(c * x ** (n + 1) for n, c in enumerate(truth.curves[curve.thickness_mm]))
        found += list((curve.force(x) - static) / curve.force_sigma(x))
        found += list((curve.clearances_rad - truth.clearance) / curve.clearance_sigmas_rad)
    return found


def test_parameters_of_other_actuators_are_recovered_within_three_sigma():
    deviations = np.abs(np.concatenate([_deviations(1000 + seed) for seed in range(8)]))
    assert np.mean(deviations < 3.0) >= 0.95
    # Sigmas that are far too wide would pass the line above.
    assert np.sqrt(np.mean(np.minimum(deviations, 5.0) ** 2)) > 0.6


def test_fit_reaches_the_noise_of_the_reference():
    rng = np.random.default_rng(3)
    truth = draw(rng)
    fit = fit_dynamics(pads(truth, rng))
    assert fit.rms == pytest.approx(truth.reference_noise_N, rel=0.03)


@pytest.mark.parametrize("effect", ["second_relaxation", "stiffness_hysteresis"])
def test_an_effect_that_is_not_there_is_not_clear_of_zero(effect):
    rng = np.random.default_rng(5)
    truth = draw(rng)
    truth.dynamics[f"{effect}.share"] = 0.0
    fit = fit_dynamics(pads(truth, rng))
    share = f"{effect}.share"
    assert fit.dynamics.values[share] < 3.0 * fit.dynamics.sigmas[share] or fit.dynamics.values[share] < 1e-3


def test_what_is_fitted_is_what_runs():
    """The simulation behind the fit and the estimator's stiffness path agree to the last bit."""
    rng = np.random.default_rng(7)
    log = pads(draw(rng), rng)[0].logs[1]
    shipped = load_calibration(resource("config/calibration.yaml"))
    assert shipped.effects
    samples = log.samples.copy()
    # Without current and thermocouples nothing but the stiffness path moves the force.
    samples["has_current"] = False
    parameters = np.array([to_parameters(shipped)])
    contact = samples["angle"][0] + shipped.contact.clearance_rad
    assert np.array_equal(simulate(samples, contact, parameters), estimate(samples, parameters)["stiffness_force"])


def _lag(x, curve, time_constant):
    """Thesis 3.4's own difference equation for F_s(x), independent of the estimator's kernels."""
    static = sum(c * np.maximum(x, 0.0) ** (n + 1) for n, c in enumerate(curve))
    ratio, force = time_constant / 0.004, np.zeros(len(x))
    for row in range(1, len(x)):
        force[row] = (static[row] + ratio * force[row - 1]) / (1.0 + ratio)
    return force


def test_both_thesis_forms_are_exact_on_data_of_that_form():
    rng = np.random.default_rng(11)
    truth = draw(rng)
    slow, random = pads(truth, rng)[0].logs
    curve = truth.curves[4.0]
    x = random.samples["angle"] - truth.clearance
    random.force_N[:] = _lag(x, curve, 0.03)
    contact = random.samples["angle"][0] + truth.clearance
    time_constant, _ = regress_damping(random, contact, curve)
    assert time_constant == pytest.approx(0.03, rel=1e-6)
    coefficients, free_time_constant, residual = regress_free(random, contact)
    # alpha_0 = tau / (tau + dt), read as exp(-dt / tau).
    assert free_time_constant == pytest.approx(-0.004 / np.log(0.03 / 0.034), rel=1e-6)
    assert coefficients == pytest.approx(curve, rel=1e-4)
    assert residual < 1e-3
    slow.force_N[:] = _lag(slow.samples["angle"] - truth.clearance, curve, 0.0)
    found, line, left = thesis_curve(slow)
    assert found == pytest.approx(truth.clearance, abs=0.1)
    assert np.std(left) < 30.0
    grid = np.linspace(4.0, 12.0, 5)
    lines = [
        sum(c * (grid - shift) ** (n + 1) for n, c in enumerate(k)) for k, shift in ((line, found), (curve, truth.clearance))
    ]
    shifted = grid - max(found, truth.clearance) > 1.0
    assert lines[0][shifted] == pytest.approx(lines[1][shifted], rel=0.05, abs=60.0)


def test_covariance_counts_seconds_not_samples():
    """A mean of strongly correlated samples is known far less well than its sample count suggests."""
    rng = np.random.default_rng(13)
    values, sigmas = [], []
    for _ in range(60):
        data = np.zeros(10_000)
        for row in range(1, len(data)):
            data[row] = 0.97 * data[row - 1] + rng.normal()
        block = Block(lambda x, data=data: x[0] - data, np.array([0]))
        found = least_squares([block], np.zeros(1), np.ones(1), np.array([-1e9]), np.array([1e9]))
        values.append(found.x[0])
        sigmas.append(np.sqrt(found.covariance[0, 0]))
    assert np.mean(sigmas) == pytest.approx(np.std(values), rel=0.3)


def test_bounds_hold_and_a_parameter_at_its_bound_has_no_sigma():
    block = Block(lambda x: np.array([x[0] - 3.0, x[1] - 1.0, 0.5 * (x[1] - 1.1)]), np.array([0, 1]))
    found = least_squares([block], np.zeros(2), np.ones(2), np.array([-1.0, -5.0]), np.array([2.0, 5.0]))
    assert found.x == pytest.approx([2.0, 1.02])
    assert found.covariance[0, 0] == 0.0


def test_frequency_response_finds_gain_and_time_constant():
    frequencies = np.array([0.1, 0.5, 1.0, 2.0, 5.0])
    gain, gain_sigma, time, time_sigma = fit_first_order(
        frequencies, 0.9 / np.sqrt(1.0 + (2.0 * np.pi * 0.03 * frequencies) ** 2)
    )
    assert (gain, time) == pytest.approx((0.9, 0.03))
    assert gain_sigma < 1e-9 and time_sigma < 1e-9


def test_phasor_separates_the_fundamental_from_mean_and_harmonics():
    time = np.arange(2500) * 0.004
    angle = 2.0 * np.pi * 0.7 * time
    signal = 5.0 + 2.0 * np.cos(angle - 0.4) + 0.7 * np.cos(2.0 * angle + 1.0) + 0.3 * np.sin(3.0 * angle)
    found = phasor(signal, time, 0.7)
    assert abs(found) == pytest.approx(2.0) and np.angle(found) == pytest.approx(-0.4)


def test_steady_rows_leave_out_the_approach_and_refuse_another_frequency():
    rng = np.random.default_rng(17)
    log = pads(draw(rng), rng)[0].logs[0]
    time = log.time_s
    log.samples["angle"] = np.where(time < 5.0, 3.0 * time, 15.0 + 4.0 * np.sin(2.0 * np.pi * (time - 5.0)))
    rows = steady_rows(log, 1.0)
    assert time[rows[0]] >= 5.0 - 0.3 and len(rows) % 250 == 0
    assert steady_rows(log, 1.7) is None


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


def test_current_noise_tells_coloured_from_white():
    rng = np.random.default_rng(19)
    series = [_coloured(rng, 40_000, 0.3, 0.02) + rng.normal(0.0, 0.2, 40_000)]
    sigma, time = noise.current_noise(series, 0.2)
    assert (sigma, time) == pytest.approx((0.3, 0.02), rel=0.1)


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
    errors = next(iter(thickness_laws(curves).values()))
    assert errors.shape == (2,) and np.all(errors < 1e-9)
    assert predict_curve(curves, 8.0) == pytest.approx(base / (1.0 + np.array([0.04, 0.06, 0.1]) * 8.0))


def test_dynamics_without_effects_are_the_thesis_lag():
    parameters = with_dynamics({"relaxation_time_s": 0.03})
    assert parameters["effects"]["second_relaxation"]["share"][0] == 0.0
    assert parameters["effects"]["stiffness_hysteresis"]["share"][0] == 0.0
