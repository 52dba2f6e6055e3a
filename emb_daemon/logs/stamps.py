"""Faults of recorders' time stamps: coarse, in bunches, repeated, going back; and values that are only held."""

from collections.abc import Sequence

import numpy as np

from emb_daemon.errors import InputError, tell

#: Largest time that int64 nanoseconds can express, s: the year 2262.
LATEST_S = 9.2e9
#: Step back in time from which a file holds two recordings; frames of two buses stand less out of order, ns.
_BACK_NS = 1_000_000_000
#: Least share of the values between two steps back that makes them the recording; other values were stamped before a clock was
#: set.
_ONE_RECORDING = 0.99
#: Share of a recording's whole time by which a counter goes back each time it overflows, and frames out of order, jitter and a
#: clock that is set do not, or once.
_ANEW = 0.5
#: Largest share of its range that a column of times between rows goes on by from its first to its last quarter, where a clock
#: does by three quarters; and least share of its steps that go back, where in noise a half do and in a clock almost none.
_NO_CLOCK = 0.25
#: Share of the mean period up to which two stamps count as one: jitter leaves more, a gateway or a burst from a queue less.
_ONE = 0.2
#: Least shares of steps in motion that are that short, and that are zero, for stamps to count as bunched; a sender at random
#: times has 0.18 and 0.
_BUNCHED, _SAME_STAMP = 0.3, 0.05
#: Share of the steps that are certainly no pauses, and multiple of the longest of them from which a step is a pause.
_ORDINARY, _PAUSE = 0.95, 10.0
#: Number of bunches over which a mean time is taken: the error of a stamp is then a twentieth of the time between two.
_BUNCHES = 20
#: Least number of changes of a value that is held, and least share of them at whole multiples of the time for which it is
#: held; least share of the changes of any value at which two change together, if all of them were held at once, and largest
#: share of rows with one: of two that change in half of all rows by themselves, a third would be together.
_LEAST_CHANGES, _IN_STEP, _AT_ONCE, _SOME_ROWS = 50, 0.98, 0.9, 0.5
#: Share of the others' range that a stray is away, and of ordinary steps (normal noise's are 2.3 standard deviations); largest
#: share of strays, and least number of values to tell them in.
_FAR, _STEPS, _FEW, _FEWEST = 0.5, 5.0, 0.02, 100
#: Numbers that stand for none: nines, and ends of 8, 16 and 32 bits, besides what is larger than any measurement; share of the
#: others' range that they are away, which the end of a sensor's range is not.
_NONE = {*(10.0**k - 1.0 for k in range(3, 8)), *(2.0**k - n for k in (7, 8, 15, 16, 31, 32) for n in (0, 1))}
_NO_MEASUREMENT, _AWAY = 1e20, 0.3
#: Least number of times that a value is 0 between others, how many times further they are from it than from each other, and
#: least share of all others that are smaller: rows are filled wherever the value is (a half, give or take 0.07 of 50 times),
#: while a dead band, or a force that is cut off when it is small, begins and ends at the smallest.
_LEAST_FILLED, _JUMPS, _ANYWHERE = 50, 3.0, 0.25
#: Least number of bits that lose a sign, part in the middle of their range in which nothing is then, and share of values that
#: may be there.
_LEAST_BITS, _BETWEEN, _ASTRAY = 12, 0.25, 0.01
#: Samples that a value is held for, up to which the number has to be whole: by chance all changes are in step with one or two.
_WHOLE = 4


def since_the_row_before(stamps: np.ndarray) -> bool:
    """Whether a column of times, shape (n,), in any unit, holds the time since the row before: a clock goes on, while these
    end where they began, and go back as often as not or are all but constant."""
    quarter = len(stamps) // 4
    if quarter < _FEWEST // 4 or np.min(stamps) < 0.0 or np.ptp(stamps) == 0.0:
        return False
    went = abs(float(np.median(stamps[-quarter:]) - np.median(stamps[:quarter])))
    spread = float(np.ptp(np.quantile(stamps, (0.05, 0.95))))
    return went <= _NO_CLOCK * spread and (spread == 0.0 or bool(np.mean(np.diff(stamps) < 0.0) > _NO_CLOCK))


def in_time(source: str, time_ns: np.ndarray, columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Times of a recording, int64 ns and rising, and the rows that they belong to.

    Repeated samples are left out. Stamps in bunches, from a coarse clock or from bursts of a queue, are spread evenly. Both
    are reported on stderr. ``source``: what messages call it; ``columns``: of values, shape (n,) each, by which repetitions
    are recognised. Raises InputError: time goes back by more than a second, begins anew again and again, or does not pass."""
    rows = np.arange(len(time_ns))
    if len(back := np.flatnonzero(np.diff(time_ns) < -_BACK_NS)):
        by = 1e-9 * float(time_ns[back[0]] - time_ns[back[0] + 1])
        rows = max(np.split(rows, back + 1), key=len)
        if len(rows) < _ONE_RECORDING * len(time_ns):
            raise InputError(
                f"{source}: time goes back by {by:.6g} s after value {back[0] + 1}; expected one recording in a file"
            )
        tell(
            f"{source}: time goes back by {by:.6g} s after value {back[0] + 1}: {len(time_ns) - len(rows)} of {len(time_ns)} "
            "values of another time left out"
        )
    whole = np.ptp(time_ns[rows]) if len(rows) else 0
    if (anew := int(np.sum(np.diff(time_ns[rows]) < -_ANEW * whole))) > 1:
        raise InputError(
            f"{source}: time begins anew {anew} times and never passes {1e-9 * float(whole):.3g} s, as a counter does that "
            "overflows; expected a clock; of rows that are evenly apart state `rate_Hz` without a column of times"
        )
    rows = rows[np.argsort(time_ns[rows], kind="stable")]
    times = time_ns[rows]
    steps = np.diff(times)
    if len(steps) < 2:
        return times, rows
    if times[-1] == times[0]:
        raise InputError(f"{source}: {len(times)} values, all of them of one time; of rows so far apart state `rate_Hz`")
    # A clock that counts whole seconds gives most rows the stamp of the row before them.
    going_on = steps <= _PAUSE * np.quantile(steps[steps > 0], _ORDINARY)
    mean = float(np.mean(steps[going_on]))
    near = steps <= _ONE * mean
    if not near.any():
        return times, rows
    same = ~np.any([_changes(column[rows]) for column in columns], axis=0)
    moving = np.sum(~same)
    if np.sum(near & ~same) > _BUNCHED * moving or np.sum((steps == 0) & ~same) > _SAME_STAMP * moving:
        between = float(np.mean(steps[going_on & ~near]))
        times = _spread(times, np.flatnonzero(~going_on) + 1, round(_BUNCHES * between / mean))
        kept = np.concatenate([[True], np.diff(times) > 0])
        tell(f"{source}: stamps come in bunches, one every {1e-6 * between:.3g} ms: spread evenly")
    else:
        kept = np.concatenate([[True], ~(near & same) & (steps > 0)])
        if not kept.all():
            tell(f"{source}: {np.sum(~kept)} of {len(kept)} values were recorded twice: left out")
    return times[kept], rows[kept]


def _spread(times: np.ndarray, pauses: np.ndarray, samples: int) -> np.ndarray:
    """Rising times, each replaced by where the straight line through ``samples`` of them about it lies; none reaches over a
    pause, of which the first row after it is given."""
    from scipy.signal import savgol_filter

    parts = []
    for part in np.split(times, pauses):
        width = min(samples, len(part) - 1) | 1
        offset = (part - part[0]).astype(float)
        straight = savgol_filter(offset, width, 1) if 3 <= width <= len(part) else offset
        parts.append(part[0] + np.rint(straight).astype(np.int64))
    return np.maximum.accumulate(np.concatenate(parts))


def strays(values: np.ndarray) -> np.ndarray:
    """Which values of a column, shape (n,), are away from both beside them by over half of what the others range over and by
    more than noise, while these are near each other: bits lost on the way, or a number that stands for none. None if they are
    not few."""
    stray = np.zeros(len(values), bool)
    if len(values) > _FEWEST:
        step = np.quantile(np.abs(np.diff(values)), 0.9)
        far = max(_FAR * np.ptp(np.quantile(values, (0.01, 0.99))), _STEPS * step)
        before, after = values[1:-1] - values[:-2], values[1:-1] - values[2:]
        stray[1:-1] = (np.minimum(np.abs(before), np.abs(after)) > far) & (np.abs(before - after) < 0.5 * far) & (far > 0.0)
    return stray if np.sum(stray) <= _FEW * len(values) else np.zeros_like(stray)


def no_values(values: np.ndarray) -> np.ndarray:
    """Which values of a column, shape (n,), as it was recorded, stand for none: a number such as -9999 or 65535 far from all
    others, and zeros with which rows were filled in which nothing was sampled."""
    none = np.zeros(len(values), bool)
    for end in (np.max, np.min):
        if none.all():
            break
        value = float(end(values[~none]))
        others = values[~none & (values != value)]
        special = abs(value) in _NONE or abs(value) > _NO_MEASUREMENT
        if special and len(others) and abs(value - end(others)) > _AWAY * np.ptp(others):
            none |= values == value
    zero = values == 0.0
    starts, ends = np.flatnonzero(~zero[:-1] & zero[1:]), np.flatnonzero(zero[:-1] & ~zero[1:]) + 1
    if len(starts) > _LEAST_FILLED:
        ends = ends[ends > starts[0]]
        before, after = values[starts[: len(ends)]], values[ends]
        # What passes through zero, or has steps about it, is near it before or after.
        step = np.maximum(np.abs(after - before), np.min(np.diff(np.unique(values))))
        nearer = np.minimum(np.abs(before), np.abs(after))
        filled = nearer > _JUMPS * step
        others = np.sort(np.abs(values[~zero]))
        anywhere = np.median(np.searchsorted(others, nearer)) > _ANYWHERE * len(others)
        if anywhere and np.sum(filled) > max(_LEAST_FILLED, 0.5 * len(filled)):
            none |= zero
    return none


def without_sign(values: np.ndarray) -> float:
    """What a column, shape (n,), as it was recorded, jumps by if its numbers lost their sign or count on within some bits: the
    end of these bits; otherwise 0."""
    steps = np.diff(np.unique(values))
    if not len(steps) or np.min(values) < 0.0:
        return 0.0
    step = 1.0 if np.all(values == np.rint(values)) else np.min(steps)
    # As float32 the last numbers before the end of 32 bits are a little beyond it.
    bits = np.ceil(np.log2((1.0 - 1e-6) * np.max(values) / step))
    whole = float(step * 2.0**bits)
    between = np.mean(np.abs(values - 0.5 * whole) < 0.5 * _BETWEEN * whole)
    jumps = np.max(np.abs(np.diff(values))) > (1.0 - _BETWEEN) * whole
    return whole if bits >= _LEAST_BITS and jumps and between < _ASTRAY else 0.0


def held_rows(values: np.ndarray) -> np.ndarray | None:
    """Rows of a column at which it was sampled, where each sample is repeated until the next, as in a table of a finer raster
    than the signal's; None where it is not."""
    changes = np.flatnonzero(np.diff(values) != 0.0) + 1
    runs = np.diff(changes)
    if len(runs) < _LEAST_CHANGES or (least := int(runs.min())) < 2:
        return None
    held = float(np.mean(runs[runs <= least + (least > _WHOLE)]))
    off = np.abs(runs - held * np.rint(runs / held))
    # A value that stays may do so for long, over which the length in samples is not known well enough.
    judged = runs < 0.5 * held * held if least > _WHOLE else np.ones(len(runs), bool)
    if np.mean(off[judged] <= (1.0 if least > _WHOLE else 0.0)) < _IN_STEP:
        return None
    return _sampled(changes, len(values), held)


def _sampled(changes: np.ndarray, count: int, held: float) -> np.ndarray:
    """Of ``count`` rows those of ``changes`` and the first, and of longer runs one every ``held`` rows."""
    starts, ends = np.concatenate([[0], changes]), np.concatenate([changes, [count]])
    return np.concatenate(
        [
            start + np.rint(np.arange(0.0, end - start - 0.5 * held, held)).astype(int)
            for start, end in zip(starts, ends, strict=True)
        ]
    )


def _changes(values: np.ndarray) -> np.ndarray:
    """After which rows of a column another value follows, mask (rows - 1,)."""
    before, after = values[:-1], values[1:]
    return ~((before == after) | (np.isnan(before) & np.isnan(after)))


def renewed_rows(columns: Sequence[np.ndarray]) -> np.ndarray | None:
    """Rows at which a recorder had new values, where its table is of a finer raster and repeats all of them until the next
    have come, at whatever times; None where it does not: what was measured by itself changes by itself."""
    changes = [change for column in columns if (change := _changes(column)).any()]
    if len(changes) < 2:
        return None
    new = np.any(changes, axis=0)
    together = sum(np.sum(change) >= _AT_ONCE * np.sum(new) for change in changes)
    if together < 2 or np.sum(new) < _LEAST_CHANGES or np.mean(new) > _SOME_ROWS:
        return None
    rows = np.flatnonzero(new) + 1
    return _sampled(rows, len(new) + 1, float(np.median(np.diff(rows))))
