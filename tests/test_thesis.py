"""The thesis's forms, with which the study compares: exact on data of their own kind."""

import numpy as np
import pytest
from synthetic_rig import datasheet, draw, pads

from emb_daemon.calibration.parameters import INERTIA, LOAD_FRICTION, OFFSET_FRICTION, TORQUE_CONSTANT
from emb_daemon.calibration.types import to_parameters
from emb_daemon.identify.calibration import nominal
from studies.frequency import fit_first_order, phasor, steady_rows
from studies.thesis import best_fit_line, moving_window, regress_damping, regress_torque
from studies.thesis_pad import thesis_nodes, thesis_profiles


def _lagged(log, truth, time_constant):
    """Thesis 3.4's own difference equation for F_s(x), independent of the estimator's kernels."""
    x = np.maximum(log.samples["angle"] - truth.clearance, 0.0)
    static = sum(c * x ** (n + 1) for n, c in enumerate(truth.curves[4.0]))
    ratio, force = time_constant / 0.004, np.zeros(len(x))
    for row in range(1, len(x)):
        force[row] = (static[row] + ratio * force[row - 1]) / (1.0 + ratio)
    return force


def test_damping_and_line_of_best_fit_are_exact_on_data_of_that_form():
    rng = np.random.default_rng(11)
    truth = draw(rng)
    slow, random = pads(truth, rng)[0].logs
    random.force_N[:] = _lagged(random, truth, 0.03)
    assert regress_damping(random, truth.clearance, truth.curves[4.0]) == pytest.approx(0.03, rel=1e-6)
    slow.force_N[:] = _lagged(slow, truth, 0.0)
    clearance, line, left = best_fit_line(slow)
    assert clearance == pytest.approx(truth.clearance, abs=0.1) and np.std(left) < 30.0
    grid = np.linspace(max(clearance, truth.clearance) + 1.0, 12.0, 5)
    lines = (
        sum(c * (grid - shift) ** (n + 1) for n, c in enumerate(k))
        for k, shift in ((line, clearance), (truth.curves[4.0], truth.clearance))
    )
    assert next(lines) == pytest.approx(next(lines), rel=0.05, abs=60.0)


def test_friction_by_sign_is_found_where_friction_jumps():
    rng = np.random.default_rng(12)
    truth = draw(rng)
    log = pads(truth, rng)[0].logs[1]
    angle, force, t = log.samples["angle"], log.force_N, truth.torque
    constant, gear_gain = t[TORQUE_CONSTANT], datasheet(1.0, 1.0).actuator.gear_gain_m_per_rad
    step = np.diff(angle, prepend=angle[0])
    moved = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(angle)), 0))
    sign, mean = np.sign(step[moved]), np.r_[0.0, 0.5 * (force[1:] + force[:-1])]
    second = np.r_[0.0, 0.0, angle[2:] - 2.0 * angle[1:-1] + angle[:-2]] / 0.004**2
    torque = gear_gain * mean + t[INERTIA] * second + (t[OFFSET_FRICTION] + t[LOAD_FRICTION] * mean) * sign
    log.samples["current_q"] = torque / constant
    found = regress_torque([log], datasheet(constant, t[INERTIA])).values
    expected = {key: t[key] for key in (TORQUE_CONSTANT, INERTIA, OFFSET_FRICTION, LOAD_FRICTION)}
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=1e-6)


def test_a_moving_window_forgets_after_its_width():
    rise = np.where(np.arange(100) < 10, 2.0, 0.0)
    window = moving_window(rise, 0.5, 20.0)
    assert window[9] == pytest.approx(10.0) and window[39] == pytest.approx(10.0)
    assert window[44] == pytest.approx(5.0) and window[50] == 0.0


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


def _thesis_parameters():
    p = np.atleast_1d(to_parameters(nominal(datasheet(0.05, 1e-4), "rig", 10.0, [10.0]))["thermal"])
    p["conductivity_rise"] = 0.0
    return p


def test_thesis_pad_conducts():
    """Surface flux, fixed backing plate: in the end a straight line of slope q/k."""
    rows = 6000
    flux = np.full(rows, 5e3)
    plate = np.full(rows, 30.0)
    profile = thesis_profiles(_thesis_parameters(), plate, plate, flux, np.ones(rows, bool), np.zeros(rows), 0.2)[-1]
    assert len(profile) == thesis_nodes(0.010) == 6
    assert profile == pytest.approx(30.0 + 5e3 / 1.2 * (0.010 - np.linspace(0.0, 0.010, 6)), abs=0.05)


def test_thesis_pad_holds_its_surface_while_braking_and_follows_the_disc_after():
    rows = 1500
    braking = np.arange(rows) < 1000
    flux = np.where(np.arange(rows) < 500, 3e4, 0.0)
    plate = np.full(rows, 22.0)
    rate = np.full(rows, 0.004)
    surface = thesis_profiles(_thesis_parameters(), plate, plate, flux, braking, rate, 0.2)[:, 0]
    assert np.all(surface[501:1001] == surface[501])
    elapsed = 0.2 * np.arange(rows - 1001)
    assert surface[1001:] - 22.0 == pytest.approx((surface[1001] - 22.0) * np.exp(-0.004 * elapsed), rel=1e-6)
