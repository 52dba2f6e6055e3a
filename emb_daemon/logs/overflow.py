"""A current that was larger than the number it was recorded in: from its highest value it goes on at its lowest.

That alone may be a motor that is turned round at once; load and acceleration tell the two apart, because they go on.
"""

import numpy as np

from emb_daemon.logs.currents import JUDGED, LEAST, left_of
from emb_daemon.logs.series import Series

#: Least step from one end of a number to the other, as a share of its range: less than the rest passes within a sample. Least
#: range of what is left, as the same share: a motor that is only ever turned round stays at one end.
_END_TO_END, _PASSES = 0.8, 0.5
#: Share of a current's variance beside friction that load and acceleration explain from which they tell what it must be.
_EXPLAINED = 0.5
#: Share of a step within which a stretch is clearly overflown, and share of the samples of which that must be so.
_CLEAR, _MOST_CLEAR = 0.25, 0.9
#: Number of fits to the better half, after which it hardly changes.
_FITS = 10


def overflown(current: Series, speed: Series, force: Series | float) -> np.ndarray:
    """Samples of a current that were recorded as another, because their number was full, shape (n,); ``force``: the motor's
    load.

    Stretches between two steps from one end of the range to the other are held against what load, friction and acceleration
    need: they are overflown if nearer to it from beyond the end, and most of those clearly. Beside one the values at the ends
    themselves are taken for more, too."""
    values, steps = current.values, np.diff(current.values)
    nothing = np.zeros(len(values), bool)
    whole = float(np.ptp(values)) if len(values) >= LEAST else 0.0
    jumps = np.flatnonzero(np.abs(steps) > _END_TO_END * whole)
    if not len(jumps):
        return nothing
    at, load = speed.sampled(current.time_ns), force.sampled(current.time_ns) if isinstance(force, Series) else 0.0
    rest = np.column_stack([np.ones(len(at)), np.sign(at), at])
    columns = np.column_stack([rest, np.broadcast_to(load, at.shape), np.gradient(at, 1e-9 * current.time_ns)])
    known = np.flatnonzero(np.isfinite(columns).all(axis=1))
    if len(known) < LEAST:
        return nothing

    # By least trimmed squares (Rousseeuw 1984), because what is overflown is far off.
    fitted = known[:: len(known) // JUDGED + 1]
    away_A = np.zeros(len(fitted))
    for _ in range(_FITS):
        best = fitted[away_A <= np.median(away_A)]
        needed = columns @ np.linalg.lstsq(columns[best], values[best])[0]
        away_A = np.abs(values - needed)[fitted]

    # By stretch, from which side it would have come: a fall from the highest value is passed upwards.
    side = np.sign(steps[jumps])
    before, after = np.append(0.0, -side), np.append(side, 0.0)
    beyond = np.where(before * after < 0.0, 0.0, np.sign(before + after))
    stretch, jump = np.searchsorted(jumps, np.arange(len(values)), side="left"), float(np.median(np.abs(steps[jumps])))
    count = np.bincount(stretch[known], minlength=len(beyond))

    def missing(needed: np.ndarray) -> np.ndarray:
        """By stretch, what the mean of its values is short of, towards its side, in steps from one end to the other."""
        return beyond * np.bincount(stretch[known], (needed - values)[known], len(beyond)) / np.maximum(count, 1) / jump

    taken = missing(needed) > 0.5
    full, at_end = taken[stretch], (values == values.max()) | (values == values.min())
    right = known[~(full | at_end)[known]]
    if not full.any() or len(right) < LEAST or np.ptp(values[right]) < _PASSES * whole:
        return nothing
    undone = values + jump * np.where(full, beyond[stretch], 0.0)
    needed = columns @ np.linalg.lstsq(columns[known], undone[known])[0]
    clear = np.abs(missing(needed) - taken) < _CLEAR
    left_A, of_rest_A = (float(np.std(left_of(values[right], by[right]))) for by in (columns, rest))
    explained = 1.0 - (left_A / of_rest_A) ** 2
    sure = np.sum(count[clear & taken]) > _MOST_CLEAR * np.sum(count[taken])
    return full | at_end if explained > _EXPLAINED and sure else nothing
