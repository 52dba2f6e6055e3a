"""What no motion shows: a share by which pads, motor and rotor are all off counts in sigma, and nothing where all is as
calibrated."""

import itertools

import brake
import numpy as np
import pytest

from emb_daemon.estimator import common
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.unknown import GAIN_REACH, GAIN_SIGMA, INERTIA_SIGMA, SCALE_JUMP
from emb_daemon.models.fusion import GAIN, INERTIA
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import RUNNING

_SIGMA = 0.003


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _by_integration(stiffness, gain, inertia):
    """Mean square of the common share by summing the mixture over a fine grid of shares."""
    share = np.linspace(-0.6, 0.6, 1_200_001)
    density = np.zeros_like(share)
    for pads, motor, rotor in itertools.product((False, True), repeat=3):
        odds = np.exp(-2.0) ** pads * np.exp(-3.5) ** motor * np.exp(-3.5) ** rotor
        if pads and motor and rotor:
            odds = np.exp(-3.5)
        for value, sigma in (
            (stiffness, SCALE_JUMP if pads else _SIGMA),
            (gain, GAIN_REACH if motor else GAIN_SIGMA),
            (inertia, 0.1 if rotor else INERTIA_SIGMA),
        ):
            odds = odds * np.exp(-0.5 * ((value + share) / sigma) ** 2) / sigma
        density += odds
    return np.sum(share * share * density) / np.sum(density)


@pytest.mark.parametrize(
    "believed", [(0.0, 0.0, 0.0), (0.0, -0.033, 0.085), (-0.077, 0.02, -0.06), (0.25, 0.0, 0.01), (0.0, 0.1, 0.0)]
)
def test_it_is_the_mixtures_mean_square(believed):
    assert common.common_variance(*believed, _SIGMA) == pytest.approx(_by_integration(*believed), rel=1e-4)


@pytest.mark.parametrize("gain", [-0.01, 0.0, 0.01])
@pytest.mark.parametrize("inertia", [-0.02, 0.0, 0.02])
def test_what_is_as_calibrated_adds_nothing(p, gain, inertia):
    """Beyond what the stiffness path itself states."""
    state = new_state()[0]
    state["scale"], p["stiffness_relative_sigma"] = 1.0, _SIGMA
    state["error"][GAIN], state["error"][INERTIA] = gain, inertia
    common.weigh_common(state, p)
    assert common.common_sigma(state, p) < 0.004


def test_other_pads_that_motor_and_rotor_agree_with_are_known():
    """A torque constant within 1 and an inertia within 2 % limit the share to about as much."""
    for pads in (-0.25, -0.1, 0.15):
        assert common.common_variance(pads, 0.0, 0.0, _SIGMA) < (1.5 * GAIN_SIGMA) ** 2


def test_a_current_sensor_that_passed_for_other_pads_is_covered():
    """A sensor that reads a tenth too little, taken for pads 8 % softer, a rotor 6 % lighter and a motor 2 % stronger."""
    assert common.common_variance(-0.077, 0.02, -0.06, _SIGMA) > (0.08 / 2.0) ** 2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_another_unit_with_the_calibration_of_this_is_covered(p, seed):
    """Pads 3.5 % stiffer, a motor 1.2 % weaker and a rotor 11 % heavier: the torque constant explains the most of it."""
    path = brake.stops(p, 12, seed)
    own, force = brake.samples(p, path)
    as_calibrated = estimate(brake.noisy(own, p, seed), p)
    true = p.copy()
    true["curve"] *= 1.035
    true["torque_constant"] *= 0.988
    true["inertia"] *= 1.11
    rows, other_force = brake.samples(true, path)
    estimates = estimate(brake.noisy(rows, p, seed), p)
    clamped = (other_force > 5000.0) & (np.arange(len(rows)) > len(rows) // 2)
    assert np.mean(np.abs(estimates["force"] - other_force)[clamped] > 3.0 * estimates["sigma"][clamped]) < 0.005
    # Without making every brake uncertain.
    assert np.median(as_calibrated["sigma"][clamped]) < 0.012 * np.median(force[clamped])
    assert np.all(as_calibrated["mode"][clamped] == RUNNING)
