"""What no motion shows: a share by which pads, motor and rotor are all off counts in sigma, and nothing where all is as
calibrated."""

import itertools

import brake
import numpy as np
import pytest

from emb_daemon.estimator import common, restart
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.unknown import DRIFT_SCALE, GAIN_SIGMA, INERTIA_SIGMA, SCALE_JUMP
from emb_daemon.models.fusion import GAIN, INERTIA
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import RUNNING

_SIGMA = 0.003


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _share(*believed, pads=common.PADS_ODDS, rotor=common.OTHERS_ODDS, unit=common.OTHERS_ODDS):
    return np.sqrt(common.common_variance(*believed, _SIGMA**2, 0.0, pads, rotor, unit)[0])


def _by_integration(stiffness, gain, inertia, stiffness_variance, inertia_variance, pads_odds, rotor_odds, unit_odds):
    """Mean square of the common share, and odds of other pads, rotor and unit, by sums over a fine grid of shares."""
    share = np.linspace(-0.6, 0.6, 1_200_001)
    step, sums, square = share[1] - share[0], [], 0.0
    kinds_of_pads = ((0.0, 1.0), (DRIFT_SCALE, pads_odds), (SCALE_JUMP, np.exp(-1.5) * pads_odds))
    alone = [
        (pads, motor, rotor, 0.1, weight * np.exp(-3.5) ** motor * rotor_odds**rotor)
        for (pads, weight), motor, rotor in itertools.product(kinds_of_pads, (0, 1), (0, 1))
    ]
    for pads, motor, rotor, motor_sigma, odds in [*alone, (SCALE_JUMP, 1, 1, 0.03, unit_odds)]:
        density = odds * step
        for value, variance in (
            (stiffness, stiffness_variance + pads**2),
            (gain, (motor_sigma if motor else GAIN_SIGMA) ** 2),
            (inertia, inertia_variance + (0.1 if rotor else INERTIA_SIGMA) ** 2),
        ):
            density = density * np.exp(-0.5 * (value + share) ** 2 / variance) / np.sqrt(variance)
        sums.append(np.sum(density))
        square += np.sum(share * share * density)
    total = sum(sums)
    of_pads = sum(each for each, (pads, *_) in zip(sums, alone, strict=False) if pads)
    of_rotor = sum(each for each, (_, _, rotor, *_) in zip(sums, alone, strict=False) if rotor)
    return square / total, *(part / (total - part) for part in (of_pads, of_rotor, sums[-1]))


@pytest.mark.parametrize(
    "known", [(_SIGMA**2, 0.0, common.PADS_ODDS, common.OTHERS_ODDS, common.OTHERS_ODDS), (1e-4, 1e-4, 0.003, 0.2, 0.01)]
)
@pytest.mark.parametrize(
    "believed", [(0.0, 0.0, 0.0), (0.0, -0.033, 0.085), (-0.077, 0.02, -0.06), (0.25, 0.0, 0.01), (0.0, 0.1, 0.0)]
)
def test_it_is_the_mixtures(believed, known):
    assert common.common_variance(*believed, *known) == pytest.approx(_by_integration(*believed, *known), rel=1e-4)


@pytest.mark.parametrize("gain", [-0.01, 0.0, 0.01])
@pytest.mark.parametrize("inertia", [-0.02, 0.0, 0.02])
def test_what_is_as_calibrated_adds_nothing(p, gain, inertia):
    """Beyond what the stiffness path itself states."""
    state = new_state()[0]
    state["scale"], p["stiffness_relative_sigma"] = 1.0, _SIGMA
    common.forget_common(state)
    state["error"][GAIN], state["error"][INERTIA] = gain, inertia
    common.weigh_common(state, p)
    assert common.common_sigma(state, p) < 0.004


def test_other_pads_that_motor_and_rotor_agree_with_are_known():
    """A torque constant within 1 and an inertia within 2 % limit the share to about as much."""
    for pads in (-0.25, -0.1, 0.15):
        assert _share(pads, 0.0, 0.0) < 1.5 * GAIN_SIGMA


def test_a_current_sensor_that_passed_for_other_pads_is_covered():
    """A sensor that reads a tenth too little, taken for pads 8 % softer, a rotor 6 % lighter and a motor 2 % stronger."""
    assert _share(-0.077, 0.02, -0.06) > 0.08 / 2.0


@pytest.mark.parametrize("gain", [-0.03, 0.03])
def test_worn_pads_may_pass_for_a_motor_within_its_tolerance(gain):
    """They differ by a few per cent: nearer than other pads, and likelier."""
    assert _share(0.0, gain, 0.0) > abs(gain) / 2.5
    assert _share(0.0, 0.0, 0.0) < 0.004


def test_a_unit_that_was_the_calibrations_is_no_other_later():
    """Only its motor can have changed by so much."""
    fresh = _share(0.0, -0.1, 0.0)
    assert fresh > 0.02
    assert _share(0.0, -0.1, 0.0, pads=0.003, rotor=0.006, unit=3e-4) < 0.4 * fresh


def test_what_a_stop_has_shown_of_pads_and_rotor_is_remembered(p):
    state = new_state()[0]
    state["scale"], p["stiffness_relative_sigma"] = 1.0, _SIGMA
    common.forget_common(state)
    common.weigh_common(state, p)
    shown = [float(state[name]) for name in ("pads_odds", "rotor_odds", "unit_odds")]
    assert shown[0] < 0.25 * common.PADS_ODDS and shown[1] < 0.5 * common.OTHERS_ODDS and shown[2] < 0.1 * common.OTHERS_ODDS
    state["error"][GAIN], state["error"][INERTIA] = -0.04, 0.1
    common.weigh_common(state, p)
    assert [state[name] for name in ("pads_odds", "rotor_odds", "unit_odds")] == shown


def _of_another_unit(p):
    """Pads 3.5 % stiffer, a motor 1.2 % weaker and a rotor 11 % heavier."""
    true = p.copy()
    true["curve"] *= 1.035
    true["torque_constant"] *= 0.988
    true["inertia"] *= 1.11
    return true


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_another_unit_with_the_calibration_of_this_is_covered(p, seed):
    """The torque constant explains most of its pads."""
    path = brake.stops(p, 12, seed)
    own, force = brake.samples(p, path)
    as_calibrated = estimate(brake.noisy(own, p, seed), p)
    rows, other_force = brake.samples(_of_another_unit(p), path)
    estimates = estimate(brake.noisy(rows, p, seed), p)
    clamped = (other_force > 5000.0) & (np.arange(len(rows)) > len(rows) // 2)
    assert np.mean(np.abs(estimates["force"] - other_force)[clamped] > 3.0 * estimates["sigma"][clamped]) < 0.005
    # Without making every brake uncertain.
    assert np.median(as_calibrated["sigma"][clamped]) < 0.012 * np.median(force[clamped])
    assert np.all(as_calibrated["mode"][clamped] == RUNNING)


def test_after_a_restart_it_counts_from_the_first_sample(p):
    rows, _ = brake.samples(_of_another_unit(p), brake.stops(p, 12, 1))
    rows, state, restarted, snapshot = brake.noisy(rows, p), new_state(), new_state(), np.zeros(1, restart.SNAPSHOT)[0]
    estimate(rows, p, state)
    assert restart.take_snapshot(state[0], p, snapshot)
    restart.resume(restarted[0], p, snapshot, 0.1)
    estimate(rows[:1], p, restarted)
    assert common.common_sigma(restarted[0], p) > 0.8 * common.common_sigma(state[0], p) > 0.01
