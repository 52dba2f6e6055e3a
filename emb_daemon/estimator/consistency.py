"""Consistency with memory: whether what the filter leaves unexplained is noise, from a tenth of a second to minutes.

A bias of 1 kN under noise of 0.6 kN a sample is nothing in one sample and certain after a second. The innovation is smoothed
over several horizons and compared with what white noise would leave of it (the test ratios of PX4's EKF2, with memory).
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.jit import njit

#: Horizons, s, and their number.
HORIZONS_S = (0.1, 1.0, 10.0, 60.0)
HORIZONS = len(HORIZONS_S)
#: Standard deviations of a mean beyond which it is no noise: at four horizons and 250 Hz once in 1e4 hours.
_INCONSISTENT = 6.0
#: Share of the horizon that must have been seen.
_EVIDENCE = 0.3
#: What a test says.
UNKNOWN, CONSISTENT, INCONSISTENT = range(3)


@njit
def remember(drift, drift_variance, innovation, variance, dt):
    """Take one innovation and its variance."""
    for i in range(HORIZONS):
        share = 1.0 - exp(-dt / HORIZONS_S[i])
        drift[i] += share * (innovation - drift[i])
        drift_variance[i] += share * share * variance - (1.0 - (1.0 - share) ** 2) * drift_variance[i]


@njit
def unexplained(drift, drift_variance):
    """Bias that no noise explains, in the innovation's unit: the largest smoothed innovation beyond its noise, else 0."""
    worst = 0.0
    for i in range(HORIZONS):
        sigma = sqrt(drift_variance[i])
        if abs(drift[i]) > _INCONSISTENT * sigma and abs(drift[i]) > abs(worst):
            worst = drift[i]
    return worst
