"""A resolver whose angle is not the motor's: its zero jumps, drifts or stays behind; and what must not be taken for that."""

import functools

import numpy as np
import pytest

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.offline import estimate, log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, simulate_log
from emb_daemon.resources import resource
from emb_daemon.wire import contract as r

#: Rows of the simulated city drive: standing released, holding 7 kN until it is released at 2150.
_RELEASED, _HOLDING = 400, 1500


@functools.cache
def _drive(seed=0):
    """Samples of fifteen seconds of a simulated unit, and the true clamp force."""
    calibration = load_calibration(resource("config/calibration.yaml"))
    frames, _ = simulate_log(plant_from_calibration(calibration, seed), city_drive(), 15.0, seed=seed)
    log = log_of(frames)
    return log.samples, log.force_N


def _estimates(change, seed=0):
    samples, force = _drive(seed)
    samples = samples.copy()
    change(samples)
    return estimate(samples, to_parameters(load_calibration(resource("config/calibration.yaml")))), force


def _rmse(estimates, force, rows):
    return np.sqrt(np.mean((estimates["force"] - force)[rows] ** 2))


@pytest.mark.parametrize("jump_rad", [-1.5, -1.0, 1.0, 1.5])
@pytest.mark.parametrize("begin", [_RELEASED, _HOLDING])
def test_an_angle_that_jumps_without_speed_moves_the_zero_and_not_the_force(begin, jump_rad):
    def change(samples):
        samples["angle"][begin:] += jump_rad

    estimates, force = _estimates(change)
    good, _ = _estimates(lambda _samples: None)
    assert estimates["reasons"][begin] & r.OUT_OF_RANGE
    moved = estimates["contact_angle"][-1] - good["contact_angle"][-1]
    assert moved == pytest.approx(jump_rad, abs=0.15)
    assert _rmse(estimates, force, slice(begin, None)) < _rmse(good, force, slice(begin, None)) + 100.0
    assert not np.any((np.abs(estimates["force"] - force) > 4.0 * estimates["sigma"]) & (estimates["reasons"] == 0))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("delay", [0, 2])
def test_no_motion_is_taken_for_a_jump(seed, delay):
    """Not even if the speed comes late by two samples."""

    def change(samples):
        if delay:
            samples["speed"][delay:] = samples["speed"][:-delay].copy()

    estimates, _ = _estimates(change, seed)
    assert not np.any(estimates["reasons"] & r.OUT_OF_RANGE)


@pytest.mark.parametrize("rad_per_s", [-0.3, 0.3])
def test_a_zero_that_drifts_while_the_motor_stands_is_found_and_the_torque_goes_on(rad_per_s):
    def change(samples):
        samples["angle"] += rad_per_s * 0.004 * np.maximum(np.arange(len(samples)) - 200, 0)

    estimates, force = _estimates(change)
    told = np.flatnonzero(estimates["reasons"] & r.OUT_OF_RANGE)
    assert len(told) and told[0] < 200 + 750, "within three seconds"
    assert np.all(estimates["source"][told[0] + 1 :] == r.TORQUE_ONLY)
    error = np.abs(estimates["force"] - force)
    assert np.all(error < 4.0 * np.hypot(estimates["sigma"], 25.0))


def test_an_angle_that_stays_while_the_brake_opens_is_found_though_its_speed_flickers():
    """Slipped on its shaft from a hold of 7 kN: the noise of its speed goes on."""
    noise = np.random.default_rng(0).normal(0.0, 0.3, 4000)

    def change(samples):
        samples["angle"][_HOLDING:] = samples["angle"][_HOLDING]
        samples["speed"][_HOLDING:] = np.round(noise[: len(samples) - _HOLDING], 2)

    estimates, force = _estimates(change)
    opened = 2150
    silent = (estimates["reasons"] == 0) & (np.abs(estimates["force"] - force) > 1000.0)
    assert np.count_nonzero(silent) <= 25, "said within a tenth of a second"
    lasting = slice(opened + 250, None)
    assert np.all(estimates["source"][lasting] == r.TORQUE_ONLY)
    assert np.all(np.abs(estimates["force"] - force)[lasting] < 4.0 * estimates["sigma"][lasting])


@pytest.mark.parametrize("offset_A", [-1.5, 1.5])
def test_an_offset_of_the_current_between_two_strokes_leaves_the_contact_angle(offset_A):
    """The pads do not touch: a torque that is there from the first movement on is no force."""

    def change(samples):
        samples["current_q"][2600:] += offset_A

    estimates, force = _estimates(change)
    good, _ = _estimates(lambda _samples: None)
    assert abs(estimates["contact_angle"][-1] - good["contact_angle"][-1]) < 0.15
    silent = (estimates["reasons"] == 0) & (np.abs(estimates["force"] - force) > 4.0 * estimates["sigma"])
    assert np.count_nonzero(silent) <= 25, "said within a tenth of a second"
