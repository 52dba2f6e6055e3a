"""Statistics of units as a population: each unit with its uncertainty, what is common, what a batch shares, and outliers.

The drives of a unit add up to normal equations of all causes together (`scores`). Most causes are nearly collinear, so a unit
is described in the few directions that its drives can distinguish (`Directions`). A cause is a known vector in this space. The
amount of a cause in a unit is measured along the direction that the scatter between units disturbs least: a friction that
scatters by a tenth between healthy units is weak evidence, a quantity that scatters less is stronger evidence. The scatter is
estimated from the fleet without outliers, and for each unit from other units only.

The sample size is the number of units, not of drives or samples: p-values come from the differences between units of one
batch.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from emb_daemon.fleet.scores import Score

#: Directions whose information is below this share of the strongest one's are dominated by rounding and nonlinearity.
_DISTINGUISHABLE = 1e-5
#: Least share of a slope's information that is left where levels are free too: the error of the slope then at most doubles.
_SLOPE = 0.25
#: Information of the prior that every direction is zero, as a share of an average drive's.
_RIDGE = 0.01
#: Share of units in the first estimate of the population's scatter, and number of passes after which it no longer changes.
_CORE, _PASSES = 0.75, 20
#: A unit whose distance is above this quantile of its chi-square is left out of the population's mean and scatter.
_OUTLYING = 0.999
#: Number of parts of the population; each part is measured with the scatter of the others.
_FOLDS = 10


@dataclass(frozen=True)
class Directions:
    """Directions that the drives can distinguish."""

    basis: np.ndarray  #: shape (causes, directions): scores times this are the coordinates of scores
    signatures: np.ndarray  #: shape (causes, directions): vector of one unit of each cause
    size_N: np.ndarray  #: RMS (N) of one unit of each cause over samples in contact, without the contact angle

    @classmethod
    def of(cls, scores: Sequence[Score]) -> "Directions":
        total = np.sum([score.products[:-1, :-1] for score in scores], axis=0) / len(scores)
        samples = np.mean([score.loaded for score in scores])
        scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
        strength, vectors = np.linalg.eigh(total / np.outer(scale, scale))
        kept = strength > _DISTINGUISHABLE * strength[-1]
        strength, vectors = strength[kept], vectors[:, kept]
        return cls(
            basis=vectors / np.sqrt(strength) / scale[:, None],
            signatures=vectors * np.sqrt(strength) * scale[:, None],
            size_N=scale / np.sqrt(samples),
        )

    def signatures_in(self, free: np.ndarray) -> np.ndarray:
        """Signatures by their coordinates in the span of ``free``, orthonormal columns of shape (q, r); zero for a cause that
        is mostly outside of it."""
        inside = self.signatures @ free
        mostly_inside = (inside**2).sum(axis=1) >= _SLOPE * (self.signatures**2).sum(axis=1)
        return inside * mostly_inside[:, None]


@dataclass(frozen=True)
class Unit:
    """Result of all drives of one unit."""

    values: np.ndarray  #: coordinates as linear functions of the covariates, shape (m, q)
    noise: np.ndarray  #: covariance of each row from drive to drive, shape (m, q, q)
    freedom: int  #: number of drives, beyond those that the values take, from which the noise is known


def find_slope_directions(
    units: Sequence[Sequence[Score]], directions: Directions, covariates: Sequence[np.ndarray]
) -> np.ndarray:
    """Directions, orthonormal columns of shape (q, r), in which a slope over a covariate can be distinguished from levels.

    For example, a torque constant that changes with the ambient temperature has the same force as a constant fade of the
    torque constant with temperature. If both were free, they would cancel each other with hundreds of newtons each, and
    explain the misfit of a model. ``covariates``: of each unit's drives."""
    basis, remaining, square = directions.basis, 0.0, 0.0
    for scores, covariate in zip(units, covariates, strict=True):
        information = np.array([basis.T @ score.products[:-1, :-1] @ basis for score in scores])
        centred = covariate - covariate.mean()
        level = information.sum(axis=0) + _RIDGE * len(scores) * np.eye(basis.shape[1])
        crossed = np.einsum("d,dab->ab", centred, information)
        remaining = remaining + np.einsum("d,dab->ab", centred**2, information) - crossed @ np.linalg.solve(level, crossed)
        square += float(centred @ centred)
    # The basis is scaled: an average drive's information is one in each direction.
    share, vectors = np.linalg.eigh(remaining / square)
    return vectors[:, share >= _SLOPE]


def fit_unit(scores: Sequence[Score], directions: Directions, covariates: np.ndarray, free: Sequence[np.ndarray]) -> Unit:
    """One unit by least squares; ``covariates`` have shape (drives, m), the first of them 1.

    Of each covariate only the directions in ``free`` are not zero, see `find_slope_directions`. A ridge of `_RIDGE` draws
    directions to zero about which the drives contain little information. The covariance is that of drives, not of samples: the
    sandwich estimator (White, Econometrica 48, 1980) over each drive's contribution to the equations at the solution."""
    from scipy.linalg import block_diag

    basis, (drives, count) = directions.basis, covariates.shape
    size = basis.shape[1]
    projected = np.array([basis.T @ score.products[:-1] for score in scores])
    information, right = projected[:, :, :-1] @ basis, projected[:, :, -1]
    normal = np.einsum("di,dj,dab->iajb", covariates, covariates, information).reshape(count * size, count * size)
    ridge = _RIDGE * np.maximum(np.diag(covariates.T @ covariates), 1e-12)
    span = block_diag(*free)
    inverse = span @ np.linalg.inv(span.T @ (normal + np.kron(np.diag(ridge), np.eye(size))) @ span) @ span.T
    values = (inverse @ (covariates.T @ right).ravel()).reshape(count, size)
    residual = right - np.einsum("dab,db->da", information, covariates @ values)
    influence = (np.einsum("di,da->dia", covariates, residual).reshape(drives, -1) @ inverse.T).reshape(drives, count, size)
    freedom = max(drives - count, 1)
    return Unit(values, np.einsum("dia,dib->iab", influence, influence) * drives / freedom, freedom)


def estimate_scatter(units: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scatter of ordinary units: robust mean (q,) and covariance (q, q) of most rows, (N, q), independent of the others.

    Concentration steps of the minimum covariance determinant (Rousseeuw, Van Driessen, Technometrics 41, 1999) from medians,
    then once more with all rows that are not outliers. The covariance is drawn towards ``noise``, that of one row by its own
    drives, with the weight of as many rows as it has columns, because few units do not determine all directions."""
    count = len(units)
    mean = np.median(units, axis=0)
    spread = 1.4826 * np.median(np.abs(units - mean), axis=0)
    covariance = np.diag(np.maximum(spread, 1e-9 * max(float(spread.max()), 1e-300)) ** 2)
    core = np.zeros(count, bool)
    for _ in range(_PASSES):
        distance = _squared_distances(units - mean, covariance)
        chosen = np.zeros(count, bool)
        chosen[np.argsort(distance, kind="stable")[: max(int(np.ceil(_CORE * count)), min(count, 3))]] = True
        if np.array_equal(chosen, core):
            break
        core = chosen
        mean, covariance = _moments(units[core], noise)
    ordinary = _is_ordinary(_squared_distances(units - mean, covariance), units) | core
    return _moments(units[ordinary], noise)


def _moments(rows: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    (count, size), mean = rows.shape, rows.mean(axis=0)
    return mean, ((rows - mean).T @ (rows - mean) + size * noise) / (max(count - 1, 1) + size)


def _is_ordinary(distance: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Which squared distances belong to a normal population with their median, its covariance known from as many units."""
    from scipy.stats import f

    count, size = units.shape
    return distance / max(float(np.median(distance)), 1e-300) <= f.ppf(_OUTLYING, size, count) / f.median(size, count)


def _squared_distances(deviations: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", deviations @ np.linalg.inv(covariance), deviations)


class Readings:
    """Amount of each cause in each unit, measured along the direction that the other units' scatter disturbs least.

    ``units`` and the ``centre`` of each one's groups, about which scatter is, have shape (N, q), the causes' ``signatures``
    (K, q); a cause whose signature is zero is never found. ``noise``: covariance of each unit by its own drives, shape (N, q,
    q), with its ``freedom``, shape (N,)."""

    def __init__(self, units: np.ndarray, centre: np.ndarray, signatures: np.ndarray, noise: np.ndarray, freedom: np.ndarray):
        # With few drives even the noise is not known in all directions: half of it is taken as independent.
        typical = noise.mean(axis=0)
        typical = 0.5 * (typical + np.diag(np.diag(typical)))
        fold = np.arange(len(units)) % min(_FOLDS, len(units))
        centred = units - centre
        others = [estimate_scatter(centred[fold != part], typical) for part in range(fold.max() + 1)]
        self._inverse = np.array([np.linalg.inv(covariance) for _, covariance in others])
        means = np.array([mean for mean, _ in others])
        #: Units that are not outliers, shape (N,).
        self.ordinary: np.ndarray = _is_ordinary(
            np.einsum("ua,uab,ub->u", centred - means[fold], self._inverse[fold], centred - means[fold]), centred
        )
        along = np.einsum("fab,kb->fka", self._inverse, signatures)
        #: By unit and cause, weights that measure its vector, shape (N, K, q).
        self.filters: np.ndarray = (along / np.maximum(np.einsum("fka,ka->fk", along, signatures), 1e-300)[:, :, None])[fold]
        self.signatures: np.ndarray = signatures
        self._noise = noise
        self.freedom: np.ndarray = freedom
        #: Of the scatter's covariance, mean over the parts, shape (q, q).
        self.inverse: np.ndarray = self._inverse.mean(axis=0)

    def amounts(self, units: np.ndarray) -> np.ndarray:
        """Amount of each cause, shape (N, K)."""
        return np.einsum("uka,ua->uk", self.filters, units)

    def noise(self) -> np.ndarray:
        """Standard deviation of the amounts from drive to drive, shape (N, K)."""
        return np.sqrt(np.einsum("uka,uab,ukb->uk", self.filters, self._noise, self.filters))

    def gain(self, total: np.ndarray) -> np.ndarray:
        """Fall of the squared distance that each cause explains of a vector, shape (K,)."""
        size = np.einsum("ka,ab,kb->k", self.signatures, self.inverse, self.signatures)
        return (self.signatures @ self.inverse @ total) ** 2 / np.maximum(size, 1e-300)

    def rivals(self, total: np.ndarray, cause: int) -> tuple[int, ...]:
        """Causes that explain nearly as much of a vector as ``cause``, the best one, and that explain little of what ``cause``
        leaves: a cause that explains another part of the vector is no rival."""
        gains = self.gain(total)
        best = self.signatures[cause]
        amount = best @ self.inverse @ total / max(best @ self.inverse @ best, 1e-300)
        gains_left = self.gain(total - amount * best)
        close = (gains >= _RIVAL * gains[cause]) & (gains_left <= (1.0 - _RIVAL) * gains)
        return tuple(int(row) for row in np.flatnonzero(close) if row != cause)


@dataclass(frozen=True)
class Difference:
    """A cause that a group of units shares, or in which one unit differs from its group."""

    #: ``where`` and ``cause``: name of the group or row of the unit, and row of the signatures.
    where: str | int
    cause: int
    #: ``amount`` and ``sigma``: of the cause; of a unit ``sigma`` is the scatter between units.
    amount: float
    sigma: float
    #: Of a group, that of no difference, corrected for all tested groups and causes (Holm, Scandinavian J. of Statistics 6,
    #: 1979): a batch is recalled because of a single finding, so that none may be false. Of a unit the q-value over all
    #: (Benjamini and Hochberg): it is only inspected in a workshop, so a known share may be false.
    chance: float
    rivals: tuple[int, ...]  #: see `Readings.rivals`


#: Largest chance of any false group, largest share of false units among those reported, and share of the best cause's gain
#: from which another cause counts as not distinguishable.
SURE, FALSE_UNITS, _RIVAL = 0.01, 0.01, 0.8
#: Least gain of a group's next cause, as a share of the first one's: a shape that is wrong by a fifth leaves a twenty-fifth.
_SECOND = 0.1
#: Groups of fewer units are neither reported nor used for a centre of their own.
LEAST_UNITS = 3


def find_shared_causes(
    units: np.ndarray,
    groups: Mapping[str, np.ndarray],
    readings: Readings,
    against_others: bool,
    misfits: Collection[int] = (),
) -> list[Difference]:
    """Causes that groups of units (masks, shape (N,)) share, one after the other, the strongest first, until none is
    significant. Groups are compared with all other units if ``against_others``, otherwise with zero.

    ``misfits``: causes that are subtracted from the units like others, but are no finding; nor is one that has a misfit among
    its rivals."""
    rows, signatures = readings.ordinary, readings.signatures
    chosen: list[tuple[str, int]] = []
    found: list[Difference | None] = []
    first: dict[str, float] = {}
    amounts = np.zeros(0)
    while len(chosen) < len(groups) * len(signatures):
        remaining = units - sum(
            (np.outer(groups[g], signatures[c]) * a for (g, c), a in zip(chosen, amounts, strict=True)), np.zeros_like(units)
        )
        best: tuple[float, str, int] | None = None
        contrasts: dict[str, np.ndarray] = {}
        for group, members in groups.items():
            inside, outside = remaining[members & rows], remaining[~members & rows]
            if len(inside) < LEAST_UNITS or (against_others and len(outside) < LEAST_UNITS):
                continue
            contrast = inside.mean(axis=0) - (outside.mean(axis=0) if against_others else 0.0)
            weight = 1.0 / (1.0 / len(inside) + (1.0 / len(outside) if against_others else 0.0))
            gains, contrasts[group] = weight * readings.gain(contrast), contrast
            if best is None or gains.max() > best[0]:
                best = float(gains.max()), group, int(gains.argmax())
        if best is None:
            break
        gain, group, cause = best
        amount = readings.amounts(remaining)[:, cause]
        inside, outside = amount[groups[group] & rows], amount[~groups[group] & rows]
        p_value, value, sigma = _compare(inside, outside if against_others else None)
        chance = min(1.0, p_value * (len(contrasts) * len(signatures) - len(chosen)))
        if chance > SURE:
            break
        rivals = readings.rivals(contrasts[group], cause)
        chosen.append((group, cause))
        mismatch = gain < _SECOND * first.setdefault(group, gain)
        misfit = not {cause, *rivals}.isdisjoint(misfits)
        found.append(None if mismatch or misfit else Difference(group, cause, value, sigma, chance, rivals))
        amounts = _fit_together(units[rows], [(groups[g][rows], signatures[c]) for g, c in chosen], readings, against_others)
    return [replace(one, amount=float(amount)) for one, amount in zip(found, amounts, strict=True) if one]


def _compare(inside: np.ndarray, outside: np.ndarray | None) -> tuple[float, float, float]:
    """(p-value, difference, its standard deviation) of two sets of units by Welch's test, or of one set against zero."""
    from scipy.stats import ttest_1samp, ttest_ind

    test = ttest_1samp(inside, 0.0) if outside is None else ttest_ind(inside, outside, equal_var=False)
    sets = [inside] if outside is None else [inside, outside]
    value = inside.mean() - (0.0 if outside is None else outside.mean())
    return float(test.pvalue), float(value), float(np.sqrt(sum(one.var(ddof=1) / len(one) for one in sets)))


def _fit_together(
    units: np.ndarray, chosen: Sequence[tuple[np.ndarray, np.ndarray]], readings: Readings, against_others: bool
) -> np.ndarray:
    """Amounts of all chosen causes by generalised least squares, the population's mean free if groups are compared."""
    masks = np.array([members for members, _ in chosen], float)
    signatures = np.array([signature for _, signature in chosen])
    if against_others:
        masks, units = masks - masks.mean(axis=1, keepdims=True), units - units.mean(axis=0)
    inverse = readings.inverse
    normal = (masks @ masks.T) * (signatures @ inverse @ signatures.T)
    right = np.einsum("gu,ga,ab,ub->g", masks, signatures, inverse, units)
    return np.linalg.lstsq(normal, right, rcond=1e-10)[0]


def find_outliers(deviations: np.ndarray, readings: Readings) -> list[Difference]:
    """Units that differ from their group, shape (N, q) about its centre, largest difference first. The difference must exceed
    both the scatter between units and that between the unit's own drives, each with its degrees of freedom: ten drives
    determine a scatter to a quarter, and among many units there is one whose drives happen to agree."""
    from scipy.stats import false_discovery_control
    from scipy.stats import t as student

    amounts, rows = readings.amounts(deviations), readings.ordinary
    freedom = max(int(rows.sum()) - 1, 1)
    spread, noise = np.sqrt((amounts[rows] ** 2).sum(axis=0) / freedom), readings.noise()
    between = student.sf(np.abs(amounts) / np.maximum(spread, 1e-300), freedom)
    within = student.sf(np.abs(amounts) / np.maximum(noise, 1e-300), readings.freedom[:, None])
    # Corrected for the number of causes that were tested for each unit.
    chances = np.minimum(1.0, 2.0 * np.maximum(between, within).min(axis=1) * amounts.shape[1])
    q_values = false_discovery_control(chances)
    found = []
    for row in np.flatnonzero(q_values <= FALSE_UNITS):
        cause = int(readings.gain(deviations[row]).argmax())
        rivals = readings.rivals(deviations[row], cause)
        amount = float(amounts[row, cause])
        sigma = float(max(spread[cause], noise[row, cause]))
        found.append(Difference(int(row), cause, amount, sigma, float(q_values[row]), rivals))
    return sorted(found, key=lambda one: (one.chance, -abs(one.amount / one.sigma)))


def find_centres(units: np.ndarray, factors: Mapping[str, np.ndarray]) -> np.ndarray:
    """Centre of each unit's groups, shape (N, q): medians by level, one factor after the other."""
    remaining = units - np.median(units, axis=0)
    for levels in factors.values():
        for level in np.unique(levels):
            mine = levels == level
            if mine.sum() >= LEAST_UNITS:
                remaining[mine] -= np.median(remaining[mine], axis=0)
    return units - remaining


@dataclass(frozen=True)
class RandomEffects:
    """A quantity over units: the population's mean, that mean's standard deviation, and the standard deviation between units
    without noise."""

    mean: float
    sigma: float
    spread: float
    units: int


def estimate_random_effects(values: np.ndarray, sigmas: np.ndarray) -> RandomEffects:
    """Mean and spread of units whose values, shape (N,), have standard deviations of their own, by Paule and Mandel (J.
    Research NBS 87, 1982)."""
    from scipy.optimize import brentq

    def excess(share: float) -> float:
        weight = variance / np.maximum(sigmas**2 + share * variance, 1e-300)
        return float(weight @ (values - weight @ values / weight.sum()) ** 2) / variance - (len(values) - 1)

    # Relative to the values' own variance, because the root finder's tolerance has no unit.
    variance = max(float(np.var(values, ddof=1)) if len(values) > 1 else 0.0, 1e-300)
    spread_2 = brentq(excess, 1e-9, 10.0) * variance if len(values) > 1 and excess(1e-9) > 0.0 > excess(10.0) else 0.0
    weight = 1.0 / np.maximum(sigmas**2 + spread_2, 1e-300)
    mean = float(weight @ values / weight.sum())
    return RandomEffects(mean, float(weight.sum() ** -0.5), float(np.sqrt(spread_2)), len(values))
