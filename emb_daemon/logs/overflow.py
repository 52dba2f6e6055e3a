"""A current that was larger than the number it was recorded in: its highest value is followed by its lowest, and on from there.

That alone may be a motor that is turned round at once; load and acceleration tell the two apart, because they go on.
"""

import numpy as np

from emb_daemon.logs.currents import JUDGED, LEAST, OTHERWISE
from emb_daemon.logs.series import Series

#: Least step, as a share of the range, from one end of a number to the other: what passes within a sample is less than the
#: rest. Least range of what is left, as the same share: a motor that is only ever turned round stays at one end.
_END_TO_END, _PASSES = 0.8, 0.5
#: Share of a current's variance beside friction that load and acceleration explain from which they tell what it must be.
_EXPLAINED = 0.5
#: How often the stretches are told again from the last fit.
_FITS = 10


def overflown(current: Series, speed: Series, force: Series | float) -> np.ndarray:
    """Samples of a current that were recorded as another, because their number was full, shape (n,).

    Stretches between two steps from one end of the range to the other are held against what load, friction and acceleration
    need by a fit to all others: they are overflown if nearer to it from beyond the end. Beside one the values at the ends
    themselves are taken for more, too.

    Args:
        current: the recorded one.
        speed: the motor's.
        force: its load, or a constant one.
    """
    values, steps = current.values, np.diff(current.values)
    nothing = np.zeros(len(values), bool)
    whole = float(np.ptp(values)) if len(values) >= LEAST else 0.0
    jumps = np.flatnonzero(np.abs(steps) > _END_TO_END * whole)
    if not len(jumps):
        return nothing
    at, load = speed.sampled(current.time_ns), force.sampled(current.time_ns) if isinstance(force, Series) else 0.0
    rest = np.column_stack([np.ones(len(at)), np.sign(at), at])
    columns = np.column_stack([rest, np.broadcast_to(load, at.shape), np.gradient(at, 1e-9 * current.time_ns)])
    known = np.isfinite(columns).all(axis=1)
    # By stretch, from which side it would have come: a fall from the highest value is passed upwards.
    side = np.sign(steps[jumps])
    before, after = np.append(0.0, -side), np.append(side, 0.0)
    beyond = np.where(before * after < 0.0, 0.0, np.sign(before + after))
    stretch = np.searchsorted(jumps, np.arange(len(values)), side="left")
    count = np.maximum(np.bincount(stretch, known, len(beyond)), 1.0)
    at_end = (values == values.max()) | (values == values.min())
    jump, taken = float(np.median(np.abs(steps[jumps]))), np.zeros(len(beyond), bool)
    for _ in range(_FITS):
        rows = np.flatnonzero(known & ~taken[stretch] & ~at_end)
        rows = rows[:: len(rows) // JUDGED + 1]
        if len(rows) < LEAST:
            return nothing
        needed = np.where(known, columns @ np.linalg.lstsq(columns[rows], values[rows])[0], values)
        was, taken = taken, beyond * np.bincount(stretch, needed - values, len(beyond)) / count > 0.5 * jump
        if np.array_equal(was, taken):
            break
    full = taken[stretch]
    if not full.any() or np.ptp(values[rows]) < _PASSES * whole:
        return nothing

    def left_A(columns: np.ndarray, values: np.ndarray) -> float:
        return float(np.std(values - columns @ np.linalg.lstsq(columns, values)[0]))

    explained = 1.0 - (left_A(columns[rows], values[rows]) / left_A(rest[rows], values[rows])) ** 2
    undone = values + jump * np.where(full, beyond[stretch], 0.0)
    better = left_A(columns[known], values[known]) > OTHERWISE * left_A(columns[known], undone[known])
    return full | at_end if explained > _EXPLAINED and better else nothing
