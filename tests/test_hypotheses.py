"""What has jumped: each change of an ideal brake is attributed to its path, ends in a small error with a sigma that covers it, and
nothing is proven where nothing has changed."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator import hypotheses
from emb_daemon.estimator.hypotheses import (
    ALTERNATIVES,
    DISC_GROWTH,
    PRIOR_ODDS,
    STIFFNESS_JUMP,
    TORQUE_JUMP,
    mix,
    open_all,
    open_again,
    settle,
    share,
    suspected,
    to_force,
    weigh,
)
from emb_daemon.estimator.records import new_state
from emb_daemon.estimator.unknown import set_priors
from emb_daemon.models.fusion import COULOMB, GAIN, LOAD, OFFSET, SCALE, STATES, force_variance
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import PATHS_DISAGREE

#: Samples of one stop of `brake.stops`, of its standstill at the beginning, and stops before the change.
_STOP, _STILL, _BEFORE = 750, 350, 4


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


def _drive(p, change=None, stops=12, seed=1, current=None, angle_m=0.0):
    """Samples and true force of stops on a brake that becomes ``change(p)`` after `_BEFORE` of them; ``angle_m``: metres by which
    its contact angle then moves; ``current`` changes the later rows' current."""
    path = brake.stops(p, stops, seed)
    rows, force = brake.samples(p, path)
    if change is not None or angle_m:
        true = p.copy()
        if change is not None:
            change(true)
        true["clearance"] += angle_m / p["gear_gain"]
        later, later_force = brake.samples(true, path)
        begin = _BEFORE * _STOP
        rows[begin:], force[begin:] = later[begin:], later_force[begin:]
    if current is not None:
        current(rows[_BEFORE * _STOP :])
    return brake.noisy(rows, p, seed), force


def _end(p, rows, force, stops=4):
    """RMSE, largest error in sigma, share beyond three sigma and median sigma while clamped in the last ``stops``, and the state."""
    state = new_state()
    estimates = estimate(rows, p, state)
    last = np.arange(len(rows)) >= len(rows) - stops * _STOP
    clamped = last & (force > 2000.0)
    error = (estimates["force"] - force)[clamped]
    off = np.abs(error) / estimates["sigma"][clamped]
    return np.sqrt(np.mean(error**2)), off.max(), np.mean(off > 3.0), np.median(estimates["sigma"][clamped]), state[0], estimates
