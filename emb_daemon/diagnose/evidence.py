"""Statistics over episodes: least squares, the jackknife's covariance, and what episodes left out say.

A t-test over samples, BIC or AIC count 250 opinions a second and find effects in noise. Here an episode has one voice: the
covariance comes from leaving episodes out one by one (the jackknife, CR3 of Bell and McCaffrey, Survey Methodology 28,
2002, which is on the safe side with few clusters), the degrees of freedom from the number of episodes that really carry
the regressor (Carter, Schnepel, Steigerwald, Rev. Economics and Statistics 99, 2017), and the gain from episodes that took
no part in the fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from emb_daemon.jit import njit


class Averaging:
    """Means over runs of neighbouring samples, none across episodes, weighted so that a sum of squares stays one of samples.
    ``episode``: of each mean; ``told``: one for each sample that counts, else zero, shape (N,); ``per_mean``: what makes a
    weighted mean of a sum, and a plain mean of a weighted one, shape (means,)."""

    def __init__(self, episode: np.ndarray, samples: int, told: np.ndarray | None = None):
        """``episode`` (N,) ascending; ``samples`` in a run, of which those that are ``told`` (N,) count, or all."""
        index = np.arange(len(episode))
        begins = np.flatnonzero(np.diff(episode, prepend=-1))
        within = index - begins[np.searchsorted(begins, index, side="right") - 1]
        self._starts = np.flatnonzero(within % samples == 0)
        self.told: np.ndarray = np.ones(len(episode)) if told is None else told.astype(float)
        counts = np.add.reduceat(self.told, self._starts)
        self.per_mean: np.ndarray = np.divide(1.0, np.sqrt(counts), out=np.zeros_like(counts), where=counts > 0.0)
        self.episode: np.ndarray = episode[self._starts]

    def of(self, columns: np.ndarray) -> np.ndarray:
        """Weighted means of columns (N, k)."""
        return np.add.reduceat(columns * self.told[:, None], self._starts, axis=0) * self.per_mean[:, None]

    def of_products(self, columns: Sequence[np.ndarray], factor: np.ndarray) -> np.ndarray:
        """The same of each of the columns (N,) times a ``factor`` (N,), without a table of all of them."""
        sums, told = np.empty((len(self._starts), len(columns))), factor * self.told
        for index, column in enumerate(columns):
            _sum_products(column, told, self._starts, sums, index)
        return sums * self.per_mean[:, None]


@njit
def _sum_products(column, factor, starts, sums, index):
    for run in range(len(starts)):
        end = starts[run + 1] if run + 1 < len(starts) else len(column)
        total = 0.0
        for row in range(starts[run], end):
            total += column[row] * factor[row]
        sums[run, index] = total


@dataclass(frozen=True)
class Moments:
    """Second moments of regressors and residual, one matrix for each episode: all that the statistics below need."""

    products: np.ndarray  #: shape (episodes, columns + 1, columns + 1); the residual is the last column
    counts: np.ndarray  #: samples in each episode

    @classmethod
    def of(cls, regressors: np.ndarray, residual: np.ndarray, episode: np.ndarray, episodes: int) -> "Moments":
        """``regressors`` (N, columns), ``residual`` (N,), ``episode`` (N,) ascending."""
        table = np.vstack([regressors.T, residual]).T
        bounds = np.searchsorted(episode, np.arange(episodes + 1))
        products = np.zeros((episodes, table.shape[1], table.shape[1]))
        for index in range(episodes):
            part = table[bounds[index] : bounds[index + 1]]
            products[index] = part.T @ part
        return cls(products, np.diff(bounds))

    def select(self, columns: list[int]) -> "Moments":
        """The same for some of the columns."""
        keep = np.array([*columns, self.products.shape[1] - 1])
        return Moments(self.products[:, keep[:, None], keep[None, :]], self.counts)

    def squared_error(self, values: np.ndarray) -> float:
        """That ``values`` of the regressors, shape (columns,), leave of the residual over all episodes."""
        weights = np.append(values, -1.0)
        return float(weights @ self.products.sum(axis=0) @ weights)


@dataclass(frozen=True)
class LeftOut:
    """Least squares with everything that leaving episodes out says of it."""

    values: np.ndarray  #: estimates, shape (columns,)
    covariance: np.ndarray  #: by the jackknife over episodes
    left_out: np.ndarray  #: squared error of each episode, predicted from all others, shape (episodes,)
    without: np.ndarray  #: estimates without each episode, shape (episodes, columns)


def leave_out(moments: Moments, penalty: np.ndarray) -> LeftOut:
    """Penalised least squares; ``penalty`` is added to the diagonal of the normal equations, shape (columns,)."""
    products = moments.products
    columns = products.shape[1] - 1
    total = products.sum(axis=0)
    # Of a column of zeros only the prior is known.
    size = np.diag(total)[:columns]
    scale = np.sqrt(np.where(size > 0.0, size, 1.0))
    ridge = np.diag(penalty / scale**2 + 1e-10)
    outer = np.outer(scale, scale)

    def solve(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.linalg.solve(normal / outer + ridge, (right / scale)[..., None])[..., 0] / scale

    if not columns:
        return LeftOut(np.zeros(0), np.zeros((0, 0)), products[:, -1, -1].copy(), np.zeros((len(products), 0)))
    values = solve(total[:-1, :-1], total[:-1, -1])
    rest = total - products
    without = solve(rest[:, :-1, :-1], rest[:, :-1, -1])
    left_out = (
        products[:, -1, -1]
        - 2.0 * np.einsum("gi,gi->g", without, products[:, :-1, -1])
        + np.einsum("gi,gij,gj->g", without, products[:, :-1, :-1], without)
    )
    informative = products[:, -1, -1] > 0.0
    count = max(int(informative.sum()), 2)
    deviation = without[informative] - values
    covariance = (count - 1) / count * deviation.T @ deviation
    return LeftOut(values, covariance, left_out, without)


def solve_within(moments: Moments, penalty: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Penalised least squares with values kept within bounds, shape (columns,), as in a fit; the free values make up for one
    that stands at its bound."""
    from scipy.optimize import lsq_linear

    total = moments.products.sum(axis=0)
    ridge = np.diag(penalty + 1e-10 * np.diag(total)[:-1] + 1e-12)
    root = np.linalg.cholesky(total[:-1, :-1] + ridge).T
    return lsq_linear(root, np.linalg.solve(root.T, total[:-1, -1]), (low, high), "bvls").x


def leave_out_within(moments: Moments, penalty: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """`LeftOut.left_out` with values kept within bounds, shape (episodes,)."""
    values = solve_within(moments, penalty, low, high)
    free = (low < values) & (values < high)
    turn = np.eye(len(values) + 1)
    turn[:-1, -1] = np.where(free, 0.0, -values)
    there = Moments(turn.T @ moments.products @ turn, moments.counts).select(np.flatnonzero(free).tolist())
    return leave_out(there, penalty[free]).left_out


@dataclass(frozen=True)
class Evidence:
    """What the episodes say of a candidate."""

    p_value: float  #: of "all its parameters are zero"
    gain: float  #: fall of the squared error summed over left-out episodes
    clusters: float  #: effective number of episodes that carry it
    values: np.ndarray  #: of its parameters, as ``sigmas``
    sigmas: np.ndarray
    agreement: float = 0.0  #: ``gain`` as a share of what the error falls by where nothing is left out


#: Least agreement of episodes, so that turns of the disc count: what has another phase in each of 3 to 6 holds reaches it in 4
#: of 100, what follows the disc has 0.98 and more.
_AGREE = 0.7
NOT_EXCITED = Evidence(1.0, 0.0, 0.0, np.zeros(0), np.zeros(0))


def judge(
    moments: Moments, nuisances: list[int], candidate: list[int], penalty: np.ndarray, plain: np.ndarray | None = None
) -> Evidence:
    """Test ``candidate`` columns with ``nuisances`` columns free; ``penalty`` as in `leave_out`, for all columns. ``plain``:
    squared error of each left-out episode without the candidate, by the nuisances alone if none is given."""
    from scipy.stats import f

    base = moments.select(nuisances)
    both = moments.select(nuisances + candidate)
    total = both.products.sum(axis=0)
    first, count = len(nuisances), len(candidate)
    own = np.diag(total)[first : first + count]
    if np.any(own <= 0.0) or not np.isfinite(total).all():
        return NOT_EXCITED
    fitted = leave_out(both, penalty[nuisances + candidate])
    without = leave_out(base, penalty[nuisances])
    plain = without.left_out if plain is None else plain
    gain = float((plain - fitted.left_out).sum())
    fall = base.squared_error(without.values) - both.squared_error(fitted.values)
    agreement = gain / fall if fall > 0.0 else 0.0
    # Project the nuisances out, to see how much of the candidate is its own and which episodes carry it.
    normal = total[:first, :first] + np.diag(penalty[nuisances])
    shadow = np.linalg.lstsq(normal, total[:first, first:-1], rcond=1e-12)[0] if first else np.zeros((0, count))
    cross = shadow.T @ both.products[:, :first, first:-1]
    carried = both.products[:, first:-1, first:-1] - cross - cross.transpose(0, 2, 1)
    carried += shadow.T @ both.products[:, :first, :first] @ shadow
    rest = carried.sum(axis=0)
    size = np.sqrt(own)
    kept = np.linalg.eigvalsh(rest / np.outer(size, size))
    if kept[-1] <= 1e-8:
        return NOT_EXCITED
    inverse = np.linalg.pinv(rest, rcond=1e-10)
    leverage = np.maximum(np.einsum("gij,ji->g", carried, inverse), 0.0)
    clusters = float(leverage.sum() ** 2 / np.maximum((leverage**2).sum(), 1e-300))
    values, covariance = fitted.values[first:], fitted.covariance[first:, first:]
    freedom = clusters - count
    p_value = 1.0
    if freedom >= 2.0:
        statistic = float(values @ np.linalg.pinv(covariance, rcond=1e-12) @ values)
        p_value = float(f.sf(statistic * freedom / (count * max(clusters - 1.0, 1.0)), count, freedom))
    return Evidence(p_value, gain, clusters, values, np.sqrt(np.diag(covariance)), agreement)


def judge_by_turns(judged: Callable[[bool], Evidence]) -> Evidence:
    """Evidence of what follows the disc's angle; ``judged``: (whether by turns) → evidence, over episodes otherwise. Where
    episodes agree each turn of the disc is an observation of its own; the gain is that of left-out episodes all the same."""
    evidence = judged(False)
    if evidence.agreement < _AGREE:
        return evidence
    often = judged(True)
    return replace(evidence, p_value=often.p_value, clusters=often.clusters)
