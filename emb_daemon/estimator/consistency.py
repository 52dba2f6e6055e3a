"""Consistency with memory: whether what the filter leaves unexplained is noise.

A bias of 1 kN under noise of 0.6 kN a sample is nothing in one sample and certain after a second. The innovation is smoothed
over several horizons; the mean square of what is left, over many such horizons, is compared with what white noise of the
filter's own variance would leave (the test ratios of PX4's EKF2, with memory). An excess is model error, of either path, so
that the force may be wrong by as much.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.jit import Record, njit, sq

#: Horizons over which the innovation is smoothed, s, and time over which its square is averaged, s.
HORIZONS_S = (0.05, 0.2, 1.0)
HORIZONS = len(HORIZONS_S)
_AVERAGED_S = (30.0, 60.0, 60.0)
#: Mean square over the expected one above which it is no noise: the mean of n squares has standard deviation sqrt(2 / n), with
#: overlapping horizons half as much again, and the bound is six of those.
_RATIO = tuple(
    1.0 + 6.0 * 1.5 * (2.0 * horizon / averaged) ** 0.5 for horizon, averaged in zip(HORIZONS_S, _AVERAGED_S, strict=True)
)
#: Largest mean square over the expected one that counts: the hypotheses find a jump, and it must not be remembered for minutes
#: afterwards.
_COUNTED = 16.0

#: Results of a test.
UNKNOWN, CONSISTENT, INCONSISTENT = range(3)

CONSISTENCY = np.dtype(
    [
        ("mean", "f8", (HORIZONS,)),
        ("variance", "f8", (HORIZONS,)),
        ("square", "f8", (HORIZONS,)),
        ("expected", "f8", (HORIZONS,)),
        ("seen_s", "f8"),
    ],
    align=True,
)


@njit
def remember(c: Record, innovation: float, sigma: float, dt: float) -> None:
    """Take one innovation and its standard deviation."""
    c.seen_s += dt
    for i in range(HORIZONS):
        share = 1.0 - exp(-dt / HORIZONS_S[i])
        c.mean[i] += share * (innovation - c.mean[i])
        c.variance[i] = sq(1.0 - share) * c.variance[i] + share * share * sigma * sigma
        slow = 1.0 - exp(-dt / min(_AVERAGED_S[i], max(c.seen_s, dt)))
        c.square[i] += slow * (min(c.mean[i] * c.mean[i], _COUNTED * c.variance[i]) - c.square[i])
        c.expected[i] += slow * (c.variance[i] - c.expected[i])


@njit
def forget(c: Record) -> None:
    """Begin anew, because a change has explained what was left."""
    c.seen_s = 0.0
    for i in range(HORIZONS):
        c.mean[i] = c.variance[i] = c.square[i] = c.expected[i] = 0.0


@njit
def judge(c: Record, horizon: int) -> int:
    """UNKNOWN before enough evidence, CONSISTENT or INCONSISTENT."""
    if c.seen_s < 0.5 * _AVERAGED_S[horizon]:
        return UNKNOWN
    return INCONSISTENT if c.square[horizon] > _RATIO[horizon] * c.expected[horizon] else CONSISTENT


@njit
def model_error(c: Record) -> float:
    """Standard deviation (the innovation's unit) of what noise does not explain; 0 if noise explains all."""
    worst = 0.0
    for i in range(HORIZONS):
        if judge(c, i) == INCONSISTENT:
            worst = max(worst, c.square[i] - c.expected[i])
    return sqrt(worst)
