"""The plain fits beside which attribution is judged find what is theirs, and leave the noise."""

import numpy as np
import pytest

import emb_daemon
from studies.plain import plain_fits

_CALIBRATION = emb_daemon.shipped_calibration()
_TIME_S = 0.004 * np.arange(5000)


def _log(speed, *, current=None, force=None, seed=0):
    angle = 0.004 * np.cumsum(speed)
    current = None if current is None else current + np.random.default_rng(seed).normal(0.0, 0.1, len(speed))
    return emb_daemon.log_of_arrays(_TIME_S, angle, speed, current_A=current, force_N=0.0 * angle if force is None else force)


def _swings(phase):
    return 80.0 * np.sin(5.0 * _TIME_S + phase)


def test_a_free_motor_needs_current_for_inertia_friction_and_speed():
    def log(phase, seed):
        speed = _swings(phase)
        current = 0.01 * np.gradient(speed, _TIME_S) + 0.5 * np.sign(speed) + 0.02 * speed + 0.3
        return _log(speed, current=current, seed=seed)

    errors = plain_fits([log(0.0, 1)], [log(1.0, 2)], _CALIBRATION)
    noise = 0.1 * _CALIBRATION.motor.torque_constant_Nm_per_A
    assert errors["falling friction"] == pytest.approx(noise, rel=0.1) == errors["offset"]
    assert errors["speed"] > 2.0 * noise and errors["inertia and friction"] > 5.0 * noise


def test_a_load_is_told_by_the_current():
    def log(phase, seed):
        speed, current = _swings(phase), 20.0 * np.sin(0.7 * _TIME_S + phase)
        return _log(speed, current=current, force=100.0 * current + 300.0 * np.sign(speed) + 50.0, seed=seed)

    gain = _CALIBRATION.motor.gear_gain_m_per_rad
    whole = plain_fits([log(0.0, 1)], [log(1.0, 2)], _CALIBRATION)
    assert whole["friction"] < 60.0 * gain and whole["constant and offset"] > 250.0 * gain
    # While no current was measured the last one stays, which is none of the moment.
    fitted = log(0.0, 1)
    fitted.samples["has_current"][:2000] = False
    fitted.samples["current_q"][:2000] = 20.0
    assert plain_fits([fitted], [log(1.0, 2)], _CALIBRATION)["friction"] < 60.0 * gain


@pytest.mark.parametrize("loop", [0.0, 200.0])
def test_without_a_current_a_force_is_a_cubic_of_each_way(loop):
    def log(phase):
        speed = _swings(phase)
        angle = 0.004 * np.cumsum(speed)
        return _log(speed, force=100.0 * angle + angle**3 + loop * np.sign(speed))

    errors = plain_fits([log(0.0)], [log(0.4)], _CALIBRATION)
    # The force changes by the loop between two samples of each reversal.
    assert errors["cubic of each way"] < 1.0 + 0.15 * loop
    assert errors["cubic"] == pytest.approx(loop, abs=20.0)
