"""Consistency with memory: what noise never raises, a bias soon does, and its size is told."""

import numpy as np
import pytest

from emb_daemon.estimator.consistency import (
    CONSISTENCY,
    CONSISTENT,
    HORIZONS,
    HORIZONS_S,
    INCONSISTENT,
    UNKNOWN,
    forget,
    judge,
    model_error,
    remember,
)
from emb_daemon.jit import njit

_DT, _SIGMA = 0.004, 600.0


@njit
def _pass_by(c, innovations, sigma, dt, verdicts, errors):
    for i in range(len(innovations)):
        remember(c, innovations[i], sigma, dt)
        errors[i] = model_error(c)
        for horizon in range(verdicts.shape[1]):
            verdicts[i, horizon] = judge(c, horizon)


class Judged:
    def __init__(self, seed):
        self.c, self._noise = np.zeros(1, CONSISTENCY), np.random.default_rng(seed)

    def pass_by(self, seconds, bias=0.0):
        """White noise of the stated standard deviation over ``bias`` of them. Returns verdicts (n, horizons) and model
        errors."""
        count = round(seconds / _DT)
        verdicts, errors = np.zeros((count, HORIZONS), np.int64), np.zeros(count)
        _pass_by(self.c[0], _SIGMA * (self._noise.standard_normal(count) + bias), _SIGMA, _DT, verdicts, errors)
        return verdicts, errors


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_is_consistent_for_hours(seed):
    verdicts, errors = Judged(seed).pass_by(2.0 * 3600.0)
    assert not np.any(verdicts == INCONSISTENT) and not np.any(errors)
    assert np.all(verdicts[-1] == CONSISTENT)


def test_nothing_is_said_before_there_is_evidence():
    """Half of the time over which each horizon averages, whatever the innovations are."""
    verdicts, errors = Judged(1).pass_by(40.0, bias=5.0)
    for horizon, first_s in enumerate((15.0, 30.0, 30.0)):
        judged = np.flatnonzero(verdicts[:, horizon] != UNKNOWN)
        assert judged[0] * _DT == pytest.approx(first_s, abs=0.01)
        assert np.all(verdicts[judged, horizon] == INCONSISTENT)
    assert not np.any(errors[: round(14.9 / _DT)])


@pytest.mark.parametrize("horizon", range(HORIZONS))
def test_half_a_sigma_is_inconsistent_within_its_horizon(horizon):
    """1/8 of each sample's square, and soon certain: within a quarter of the time averaged, at each horizon."""
    watched = Judged(2)
    watched.pass_by(300.0)
    verdicts, errors = watched.pass_by(120.0, bias=0.5)
    first = np.flatnonzero(verdicts[:, horizon] == INCONSISTENT)[0]
    assert first * _DT < 7.5
    assert np.all(verdicts[first + 2500 :, horizon] == INCONSISTENT)
    assert errors[-1] == pytest.approx(0.5 * _SIGMA, rel=0.25), "the error it stands for"


def test_a_bias_that_one_sample_hides_is_certain_at_the_longest_horizon():
    """A tenth of a sigma: nothing in the innovation's own square, and still said by a second's mean."""
    watched = Judged(3)
    watched.pass_by(300.0)
    verdicts, _ = watched.pass_by(300.0, bias=0.1)
    assert np.any(verdicts[:, -1] == INCONSISTENT) and not np.any(verdicts[:, 0] == INCONSISTENT)


def test_what_has_passed_is_forgotten():
    watched = Judged(4)
    watched.pass_by(120.0, bias=0.5)
    verdicts, errors = watched.pass_by(600.0)
    assert np.all(verdicts[-1] == CONSISTENT) and errors[-1] == 0.0


def test_what_has_been_explained_is_not_remembered():
    """A torque that was off until its cause was found: its mean over the last second is no evidence against what follows."""
    watched = Judged(5)
    watched.pass_by(20.0, bias=10.0)
    forget(watched.c[0])
    verdicts, errors = watched.pass_by(120.0)
    assert not np.any(verdicts == INCONSISTENT) and not np.any(errors)


def test_what_is_left_is_held_against_what_noise_of_its_sigma_would_leave():
    """A first-order mean of white noise has the share s / (2 - s) of its variance; of a bias its square counts, up to sixteen
    times that."""
    c, dt, bias = np.zeros(1, CONSISTENCY), 0.02, 0.4
    for _ in range(3000):
        remember(c[0], bias * _SIGMA, _SIGMA, dt)
    share = 1.0 - np.exp(-dt / np.array(HORIZONS_S))
    noise = share / (2.0 - share)
    assert c["expected"][0] == pytest.approx(_SIGMA**2 * noise, rel=0.05)
    assert c["square"][0] == pytest.approx(_SIGMA**2 * np.minimum(bias**2, 16.0 * noise), rel=0.1)
