"""One signal over time, and its values at other times."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from emb_daemon.logs.columns import nearest
from emb_daemon.wire.contract import CYCLE_NS

#: Relative deviation of a rig's sampling period from ours up to which its samples are used unchanged.
SAME_PERIOD = 0.05
#: Sampling period, in cycles, from which a fast motion between two samples is unknown: such samples are used unchanged too,
#: and the estimator bridges the gaps. A brake clamps in some fifty cycles.
SPARSE_CYCLES = 5
#: Sampling period up to which slow motion is filled in between its samples: a stop that comes and goes takes longer, ns. Share
#: of the samples in motion by which slow motion is told, and angle by which the straight line between two may miss the way:
#: some 20 N at a kilonewton per radian, the noise of a reference sensor, rad.
_LONGEST_FILLED_NS, _RESOLVED_SHARE, _UNKNOWN_WAY_RAD = 101_000_000, 0.99, 0.01
#: Share of the way between two samples that the straight line may miss of a machine that clamps nothing: its current tells of
#: load, speed and acceleration, and no force of its angle.
_UNKNOWN_SHARE = 0.1
#: Least number of samples from which a rate or a way is told.
LEAST_SAMPLES = 50
#: Longest gap, in nominal cycles of our message or in periods of theirs, over which a value is held.
CARRIED_CYCLES, CARRIED_PERIODS = 5, 3
#: Least time without a value that is a gap, ns: half a clamp; and in periods of the signal, since recorders of few values
#: wait for the next.
_GAP_NS, _GAP_PERIODS = 100_000_000, 10.0
#: Correlation of a speed with its next sample from which the mean of the two is the speed between them: of a sine it is the
#: cosine of the phase that passes, and at 0.95 (20 samples a period) the mean is 3 % small.
RESOLVED = 0.95
#: Relative variation of a constant value by rounding.
_STEADY = 1e-6


def longest_step_ns(period_ns: float) -> float:
    """Between two values of a signal of that period; where there is more nothing was measured for long."""
    return max(_GAP_NS, _GAP_PERIODS * period_ns)


@dataclass(frozen=True)
class Series:
    """One signal, in our unit: int64 nanoseconds, ascending, and float values, shape (n,).

    Each value is that of its time, or a mean about it."""

    time_ns: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, time_ns: np.ndarray, values: np.ndarray) -> "Series":
        """Instantaneous values in any order; NaN values are left out."""
        known = np.isfinite(values)
        order = np.argsort(time_ns[known], kind="stable")
        return cls(time_ns[known][order], values[known][order])

    def averaged(self, span_ns: float | None = None) -> "Series":
        """The same values as means over ``span_ns`` that end at their stamps; None is the sampling period."""
        span_ns = self.period_ns if span_ns is None else span_ns
        return Series(self.time_ns - round(0.5 * span_ns), self.values)

    @cached_property
    def period_ns(self) -> float:
        return float(np.median(np.diff(self.time_ns))) if len(self.time_ns) > 2 else float(CYCLE_NS)

    @property
    def is_ours(self) -> bool:
        """Whether it is sampled at our rate."""
        return abs(self.period_ns / CYCLE_NS - 1.0) <= SAME_PERIOD

    def held(self, at_ns: np.ndarray, cycle_ns: int) -> np.ndarray:
        """The last value at each time, NaN if it is too old."""
        if not len(self.time_ns):
            return np.full(len(at_ns), np.nan)
        row = np.searchsorted(self.time_ns, at_ns, side="right") - 1
        age = at_ns - self.time_ns[np.maximum(row, 0)]
        fresh = (row >= 0) & (age <= max(CARRIED_CYCLES * cycle_ns, CARRIED_PERIODS * self.period_ns))
        return np.where(fresh, self.values[np.maximum(row, 0)], np.nan)

    def sampled(self, at_ns: np.ndarray) -> np.ndarray:
        """The value at each time, straight between samples, NaN in gaps."""
        return np.where(self._near(at_ns), self._between(at_ns), np.nan)

    @property
    def is_sparse(self) -> bool:
        """Whether a fast motion's way between two samples is unknown."""
        return self.period_ns >= (1.0 - SAME_PERIOD) * SPARSE_CYCLES * CYCLE_NS

    @property
    def way_is_unknown(self) -> bool:
        """Whether an angle's way between two samples is unknown: sparse samples of a motion that they do not resolve."""
        return self._misses > max(_UNKNOWN_WAY_RAD, self._step)

    @property
    def course_is_unknown(self) -> bool:
        """The same of a machine that clamps nothing."""
        return self._misses > max(_UNKNOWN_WAY_RAD, self._step, _UNKNOWN_SHARE * self._goes)

    @cached_property
    def _step(self) -> float:
        """Least difference of two values: a coarse encoder's count, of which the angle is not sure either."""
        return float(np.min(np.diff(found))) if len(found := np.unique(self.values)) > 1 else 0.0

    @cached_property
    def _goes(self) -> float:
        """How far it goes between two samples where it goes furthest."""
        return float(np.quantile(np.abs(np.diff(self.values)), _RESOLVED_SHARE)) if len(self.values) > 1 else 0.0

    @cached_property
    def _misses(self) -> float:
        """How far the straight line between sparse samples misses the way; infinite if they are too few to tell.

        Left out, a sample of a smooth motion would be missed by the straight line between its neighbours four times as far as
        the straight line between samples misses the way."""
        if not self.is_sparse:
            return 0.0
        if self.period_ns > _LONGEST_FILLED_NS or len(self.values) < LEAST_SAMPLES:
            return np.inf
        # Samples of a busy computer are not evenly apart.
        share = (self.time_ns[1:-1] - self.time_ns[:-2]) / np.maximum(self.time_ns[2:] - self.time_ns[:-2], 1)
        missed = 0.25 * np.abs(self.values[1:-1] - self.values[:-2] - share * (self.values[2:] - self.values[:-2]))
        # Long standstill does not show how stops are sampled.
        moving = np.maximum(missed, np.abs(self.values[2:] - self.values[:-2])) > _UNKNOWN_WAY_RAD
        return float(np.quantile(missed[moving], _RESOLVED_SHARE)) if moving.any() else 0.0

    @cached_property
    def is_resolved(self) -> bool:
        """Whether it changes little from one value to the next, so that the mean of the two is what was between them."""
        return len(self.values) > 2 and correlation_of(self.values[1:], self.values[:-1]) > RESOLVED

    @property
    def is_slow(self) -> bool:
        """Whether it is sampled more slowly than we do."""
        return self.period_ns > (1.0 + SAME_PERIOD) * CYCLE_NS

    def smoothed(self, at_ns: np.ndarray) -> np.ndarray:
        """Of a slow signal: mean over a period about each time, NaN in gaps.

        Its change over a cycle is then that of means over periods, interpolated between their middles, as in `mean` for the
        current, so that speed and current of a slow rig give the same inertia."""
        half = round(0.5 * self.period_ns)
        if not len(self.time_ns):
            return np.full(len(at_ns), np.nan)
        # Linear on either side of the only corner in the period.
        corner = np.clip(self.time_ns[nearest(self.time_ns, at_ns)], at_ns - half, at_ns + half)
        share = (corner - at_ns + half) / (2.0 * half)
        before, at, after = self._between(at_ns - half), self._between(corner), self._between(at_ns + half)
        mean = 0.5 * (share * (before + at) + (1.0 - share) * (at + after))
        return np.where(self._near(at_ns), mean, np.nan)

    def mean(self, at_ns: np.ndarray) -> np.ndarray:
        """Mean over the cycle that ends at each time, NaN in gaps.

        A value that is sampled at our rate represents the period about its time, so that means over periods add up to means
        over cycles; slower values are interpolated linearly."""
        if not len(self.time_ns):
            return np.full(len(at_ns), np.nan)
        middle = at_ns - CYCLE_NS // 2
        if self.is_slow:
            # Simpson's rule: at most one corner of the straight lines lies in a cycle.
            mean = (self._between(at_ns - CYCLE_NS) + 4.0 * self._between(middle) + self._between(at_ns)) / 6.0
        else:
            times = (self.time_ns - self.time_ns[0]).astype(float)
            half = 0.5 * self.period_ns
            edges = np.concatenate([[times[0] - half], 0.5 * (times[1:] + times[:-1]), [times[-1] + half]])
            area = np.concatenate([[0.0], np.cumsum(self.values * np.diff(edges))])
            end = (at_ns - self.time_ns[0]).astype(float)
            start = np.clip(end - CYCLE_NS, *edges[[0, -1]])
            end = np.clip(end, *edges[[0, -1]])
            mean = (np.interp(end, edges, area) - np.interp(start, edges, area)) / np.maximum(end - start, 1.0)
        if self.is_ours:
            # A mean over our own cycle is used unchanged, whatever the jitter of its stamp.
            row = nearest(self.time_ns, middle)
            mean = np.where(np.abs(self.time_ns[row] - middle) < CYCLE_NS // 4, self.values[row], mean)
        return np.where(self._near(middle), mean, np.nan)

    def derivative(self) -> "Series":
        """Change per second, central over a cycle or over two periods, whichever is longer."""
        half = max(CYCLE_NS // 2, round(self.period_ns))
        first, last = (int(self.time_ns[0]), int(self.time_ns[-1])) if len(self.time_ns) else (0, 0)
        after, before = np.minimum(self.time_ns + half, last), np.maximum(self.time_ns - half, first)
        change = self._between(after) - self._between(before)
        return Series(self.time_ns, change / np.maximum(1e-9 * (after - before), 1e-9))

    @property
    def gaps(self) -> np.ndarray:
        """Rows after which nothing was measured for long."""
        return np.flatnonzero(np.diff(self.time_ns) > longest_step_ns(self.period_ns))

    def integral(self) -> "Series":
        """Area under the signal since its first value. A gap adds none, unknown as it is: recorders pause at rest."""
        steps = 0.5 * (self.values[1:] + self.values[:-1]) * (1e-9 * np.diff(self.time_ns))
        steps[self.gaps] = 0.0
        return Series(self.time_ns, np.concatenate([np.zeros(min(len(self.values), 1)), np.cumsum(steps)]))

    def _between(self, at_ns: np.ndarray) -> np.ndarray:
        if not len(self.time_ns):
            return np.full(len(at_ns), np.nan)
        origin = self.time_ns[0]
        return np.interp((at_ns - origin).astype(float), (self.time_ns - origin).astype(float), self.values)

    def _near(self, at_ns: np.ndarray) -> np.ndarray:
        if not len(self.time_ns):
            return np.zeros(len(at_ns), bool)
        apart = np.abs(self.time_ns[nearest(self.time_ns, at_ns)] - at_ns)
        return apart <= max(CYCLE_NS, CARRIED_PERIODS * self.period_ns)


def correlation_of(one: np.ndarray, other: np.ndarray) -> float:
    """Of two columns that are not zero throughout; about zero where one of them does not vary, as of a steady speed."""
    if all(np.ptp(column) > _STEADY * np.max(np.abs(column)) for column in (one, other)):
        one, other = one - np.mean(one), other - np.mean(other)
    return float(one @ other / np.sqrt((one @ one) * (other @ other)))
