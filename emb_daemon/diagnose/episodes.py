"""Episodes: the sample of every statistic in this package.

Residuals at 250 Hz are autocorrelated over seconds, so that neighbouring samples contain no new information, while different
stops are nearly independent. A log is therefore cut into brake applications, each with the pause before it, and long motion (a
drag, a burst, a park brake stroke) into pieces of a few seconds; a hold is one episode however long it is. Only what follows
the disc's angle comes again in it, turn by turn.
"""

from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from emb_daemon.effects.terms import CLAMPED_N

#: Shortest pause that ends an application of the brake, s.
_PAUSE_S = 0.3
#: Longest and shortest episode, s, and the number of pieces wanted even of a short log.
_LONGEST_S, _SHORTEST_S, _PIECES = 8.0, 0.5, 40
#: The motor holds where it turns less than this over this time: a tenth of the angle over which gears slide.
_HOLDING_RAD, _HOLDING_S = 0.03, 0.25
#: The motor stands where it turns less than a step of our message of its speed, 0.02 rad/s, for this time, s;
#: number of places in it.
_STILL_RAD_PER_S, _STILL_S, _STILL_PARTS = 0.02, 0.1, 5
#: Samples over which the noise of a force is taken out: no disc changes it faster than in twenty milliseconds.
_NOISE_SAMPLES = 5


def episodes(time_s: np.ndarray, force_N: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Number of the episode that each sample belongs to, ascending from 0; ``force_N``: measured or estimated."""
    if not len(time_s):
        return np.zeros(0, np.int64)
    longest = float(np.clip((time_s[-1] - time_s[0]) / _PIECES, _SHORTEST_S, _LONGEST_S))
    moving = np.flatnonzero(~_holding(time_s, angle_rad))
    cuts = []
    for start, stop in pairwise([*_applications(time_s, force_N), len(time_s)]):
        duration = time_s[stop - 1] - time_s[start]
        pieces = max(1, round(duration / longest))
        wanted = np.searchsorted(time_s, time_s[start] + duration * np.arange(1, pieces) / pieces)
        inside = moving[(moving > start) & (moving < stop)]
        if len(inside):
            # A hold is never cut, because its halves are not independent.
            cuts += np.unique(inside[np.minimum(np.searchsorted(inside, wanted), len(inside) - 1)]).tolist()
        cuts.append(stop)
    apart = [0]
    for cut in cuts[:-1]:
        if time_s[cut] - time_s[apart[-1]] >= _SHORTEST_S:
            apart.append(cut)
    return np.searchsorted(apart, np.arange(len(time_s)), side="right") - 1


def by_turns(episode: np.ndarray, time_s: np.ndarray, wheel_rad: np.ndarray) -> np.ndarray:
    """The same episodes, long ones cut after whole turns of the disc: an error that lasts throughout a hold is the same at
    every angle of the disc, so that what follows that angle has been seen anew in each part. ``wheel_rad``: unwrapped."""
    cuts = np.zeros(len(episode), np.int64)
    begins = np.flatnonzero(np.diff(episode, prepend=-1))
    for start, stop in pairwise([*begins.tolist(), len(episode)]):
        turns = np.floor(np.abs(wheel_rad[start:stop] - wheel_rad[start]) / (2.0 * np.pi))
        whole = np.flatnonzero(np.diff(turns) > 0.0) + 1 + start
        last = start
        while (later := whole[np.searchsorted(time_s[whole], time_s[last] + _LONGEST_S) :]).size:
            if time_s[stop - 1] - time_s[later[0]] < _LONGEST_S:
                break
            last = later[0]
            cuts[last] = 1
    return episode + np.cumsum(cuts)


def _applications(time_s: np.ndarray, force_N: np.ndarray) -> list[int]:
    """First samples of brake applications, each with the pause before it."""
    applied = force_N > CLAMPED_N
    ends = np.flatnonzero(applied[:-1] & ~applied[1:]) + 1
    starts = np.flatnonzero(~applied[:-1] & applied[1:]) + 1
    cuts = [0]
    for end in ends:
        after = starts[np.searchsorted(starts, end) :][:1]
        if len(after) and time_s[after[0]] - time_s[end] < _PAUSE_S:
            continue
        if time_s[end] - time_s[cuts[-1]] >= _SHORTEST_S:
            cuts.append(int(end))
    return cuts


def standing(time_s: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Mask of the samples, shape (N,), before or after which the motor does not turn as far as our messages tell."""
    stands = {-1.0: np.ones(len(time_s), np.bool_), 1.0: np.ones(len(time_s), np.bool_)}
    for part in _STILL_S * np.arange(1, _STILL_PARTS + 1) / _STILL_PARTS:
        for way, still in stands.items():
            there = np.interp(time_s + way * part, time_s, angle_rad)
            still &= np.abs(there - angle_rad) < _STILL_RAD_PER_S * _STILL_S
    return stands[-1.0] | stands[1.0]


def yielding(angle_rad: np.ndarray, force_N: np.ndarray, friction: np.ndarray, least_N: np.ndarray) -> np.ndarray:
    """Mask of the samples, shape (N,), in which the load may have turned the friction of the gear back without a motion that
    the resolver shows: the load has moved against the friction by ``least_N`` or more since the motor last slid, as an uneven
    disc makes it at each turn.

    ``friction``: its state as the angle tells it, -1 to 1; while it opposes closing, a load that grows is what turns it."""
    against = uniform_filter1d(force_N, _NOISE_SAMPLES) * np.where(friction < 0.0, -1.0, 1.0)
    clamps = force_N > CLAMPED_N
    apart = (clamps[1:] != clamps[:-1]) | (np.signbit(friction[1:]) != np.signbit(friction[:-1]))
    cuts = np.union1d(_slides_on(angle_rad), np.flatnonzero(apart) + 1)
    result = np.zeros(len(angle_rad), np.bool_)
    for start, stop in pairwise([0, *cuts.tolist(), len(angle_rad)]):
        if clamps[start]:
            part = against[start:stop]
            result[start:stop] = np.maximum.accumulate(part - np.minimum.accumulate(part) > least_N[start:stop])
    return result


def _slides_on(angle_rad: np.ndarray) -> np.ndarray:
    """Samples at which the motor has turned, since the previous one of them, far enough to turn friction over again."""
    found, last = [], angle_rad[0] if len(angle_rad) else 0.0
    for index, angle in enumerate(angle_rad.tolist()):
        if abs(angle - last) >= _HOLDING_RAD:
            found.append(index)
            last = angle
    return np.array(found, np.int64)


def _holding(time_s: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Mask of the samples in which the motor stands, shape (N,). A gap over which the angle has changed ends a hold."""
    before = np.searchsorted(time_s, time_s - _HOLDING_S)
    after = np.minimum(np.searchsorted(time_s, time_s + _HOLDING_S), len(time_s) - 1)
    back, on = np.abs(angle_rad - angle_rad[before]), np.abs(angle_rad[after] - angle_rad)
    turned_unseen = (np.diff(time_s, prepend=time_s[0]) > _HOLDING_S) & (
        np.abs(np.diff(angle_rad, prepend=angle_rad[0])) >= _HOLDING_RAD
    )
    return (np.minimum(back, on) < _HOLDING_RAD) & ~turned_unseen
