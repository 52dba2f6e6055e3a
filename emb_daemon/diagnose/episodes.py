"""Episodes: the sample of every statistic in this package.

Residuals at 250 Hz are autocorrelated over seconds, so neighbouring samples say nothing new; what happens in one stop says
little about the next. A log is therefore cut into brake applications, each with the pause before it, and what goes on for
long (a drag, a burst, a park brake stroke) into pieces of a few seconds.
"""

from itertools import pairwise

import numpy as np

#: Force (N) above which the brake is applied, and shortest pause (s) that ends an application.
_APPLIED_N = 150.0
_PAUSE_S = 0.3
#: Longest episode, and the number of pieces wanted even of a short log.
_LONGEST_S = 8.0
_PIECES = 40
_SHORTEST_S = 0.5


def episodes(time_s: np.ndarray, force_N: np.ndarray) -> np.ndarray:
    """Number of the episode that each sample belongs to, ascending from 0.

    Args:
        time_s: sample times, shape (N,).
        force_N: clamp force, measured or estimated, shape (N,).
    """
    if not len(time_s):
        return np.zeros(0, np.int64)
    longest = float(np.clip((time_s[-1] - time_s[0]) / _PIECES, _SHORTEST_S, _LONGEST_S))
    applied = force_N > _APPLIED_N
    ends = np.flatnonzero(applied[:-1] & ~applied[1:]) + 1
    starts = np.flatnonzero(~applied[:-1] & applied[1:]) + 1
    cuts = [0]
    for end in ends:
        after = starts[np.searchsorted(starts, end) :][:1]
        if len(after) and time_s[after[0]] - time_s[end] < _PAUSE_S:
            continue
        if time_s[end] - time_s[cuts[-1]] >= _SHORTEST_S:
            cuts.append(int(end))
    cuts.append(len(time_s))
    number = np.zeros(len(time_s), np.int64)
    count = 0
    for start, stop in pairwise(cuts):
        duration = time_s[stop - 1] - time_s[start]
        pieces = max(1, round(duration / longest))
        share = (time_s[start:stop] - time_s[start]) / max(duration, 1e-9)
        number[start:stop] = count + np.minimum((share * pieces).astype(np.int64), pieces - 1)
        count += pieces
    return number
