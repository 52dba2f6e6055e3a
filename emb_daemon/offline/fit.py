"""Least squares through the estimator: few parameters, many samples, most parameters belonging to one log.

`scipy.optimize.least_squares` searches over a problem that is reduced to one row more than there are parameters (an orthogonal
reduction, block by block, which changes neither cost nor gradient nor Gauss-Newton matrix), so that the Jacobian of half a
million samples, most of it zeros, is never stored.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from emb_daemon.offline.score import rmse

Values = dict[Hashable, float]


@dataclass(frozen=True)
class Free:
    """A parameter to be fitted."""

    start: float  #: where the search begins
    step: float  #: of the derivative's difference quotient: small, but large enough to change the residual
    low: float = -np.inf
    high: float = np.inf
    #: (mean, standard deviation) of what is known beforehand; residuals then have to be in units of their own standard
    #: deviation, or the two are not weighted correctly.
    prior: tuple[float, float] | None = None
    #: Searched as a logarithm, for positive parameters of unknown size. ``step`` and the prior's deviation are then relative,
    #: and the prior's mean is still a value.
    logarithmic: bool = False


@dataclass(frozen=True)
class Block:
    """Residuals of one log."""

    #: From values by key (those in ``keys`` at least) to residuals, shape (n,), all finite. Those of several blocks are asked
    #: at once.
    residual: Callable[[Values], np.ndarray]
    keys: tuple[Hashable, ...]  #: parameters that these residuals depend on; only they are moved for the derivative
    #: Number of the episode of each residual, ascending, shape (n,). Residuals are autocorrelated within an episode and nearly
    #: independent between episodes, so that the covariance is computed over episodes.
    episode: np.ndarray
    #: From values to the derivatives of the residuals, shape (n, keys), if they are known better than by difference quotients.
    derivative: Callable[[Values], np.ndarray] | None = None


@dataclass(frozen=True)
class Fit:
    """Result of a fit."""

    keys: tuple[Hashable, ...]
    values: Values  #: by key
    sigmas: Values  #: standard deviations by key, infinite where neither residuals nor prior determine it
    #: Of the values, in the order of ``keys``: jackknife over episodes (one Gauss-Newton step for each left out; Wu, Annals of
    #: Statistics 14, 1986), which is not too small with few episodes, and the priors' part.
    covariance: np.ndarray
    residuals: list[np.ndarray] = field(repr=False)  #: one array per block
    from_prior: Values  #: share of each parameter's information that is its prior's, 0 to 1

    @property
    def rms(self) -> float:
        """Root mean square over all residuals."""
        return rmse(np.concatenate(self.residuals))

    def block(self, keys: Sequence[Hashable]) -> np.ndarray:
        """Covariance of some parameters."""
        rows = [self.keys.index(key) for key in keys]
        return self.covariance[np.ix_(rows, rows)]


def fit(blocks: Sequence[Block], free: Mapping[Hashable, Free], *, tolerance: float = 1e-8, evaluations: int = 100) -> Fit:
    """Least-squares estimate. ``tolerance``: relative fall of the cost that ends the search; ``evaluations``: limit of the
    residual's evaluations, not counting derivatives."""
    problem = _Problem(blocks, free)
    low, high = problem.bounds()
    found = least_squares(
        problem.reduced,
        np.clip(problem.start, low, high),
        problem.reduced_jacobian,
        bounds=(low, high),
        x_scale="jac",
        ftol=tolerance,
        xtol=1e-12,
        gtol=None,
        max_nfev=evaluations,
    )
    residuals = problem.residuals(tuple(found.x))
    covariance, from_prior = problem.covariance(found.x)
    unit = np.where(problem.logarithmic, np.exp(np.where(problem.logarithmic, found.x, 0.0)), 1.0)
    covariance = covariance * np.outer(unit, unit)
    keys = problem.keys
    return Fit(
        keys=keys,
        values=problem.values(found.x),
        sigmas=dict(zip(keys, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        covariance=covariance,
        residuals=residuals,
        from_prior=dict(zip(keys, from_prior.tolist(), strict=True)),
    )


def _triangle(tall: np.ndarray) -> np.ndarray:
    """R of a QR decomposition, in pieces so small that no BLAS distributes them over threads, which is slow on a busy
    machine."""
    count = tall.shape[1]
    rows = max(256, 4 * count)
    pieces = np.zeros((-(-len(tall) // rows), rows, count))
    pieces.reshape(-1, count)[: len(tall)] = tall
    while len(pieces) > 1:
        triangles = np.linalg.qr(pieces, mode="r")
        triangles = np.concatenate([triangles, np.zeros((-len(triangles) % 4, count, count))])
        pieces = triangles.reshape(-1, 4 * count, count)
    return np.linalg.qr(pieces[0], mode="r")


class _Problem:
    """Blocks and priors as functions of the vector that is searched."""

    def __init__(self, blocks, free):
        self.blocks, self.free = blocks, free
        # Kernels let other threads run.
        self.map = ThreadPoolExecutor(2).map if len(blocks) > 1 else map
        self.keys = tuple(free)
        row = {key: index for index, key in enumerate(self.keys)}
        self.columns = [np.array([row[key] for key in block.keys], int) for block in blocks]
        self.logarithmic = np.array([f.logarithmic for f in free.values()])
        self.steps = np.array([f.step for f in free.values()])
        self.start = self._to_vector([f.start for f in free.values()])
        self.mean = self._to_vector([f.prior[0] if f.prior else f.start for f in free.values()])
        self.weight = np.array([1.0 / f.prior[1] if f.prior else 0.0 for f in free.values()])
        # Derivatives are asked for where residuals were asked for last, and the covariance where derivatives were.
        self.residuals, self.derivatives = lru_cache(1)(self.residuals), lru_cache(1)(self.derivatives)

    def _to_vector(self, values):
        values = np.array(values, float)
        with np.errstate(divide="ignore"):
            return np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)

    def bounds(self):
        limits = ([getattr(f, name) for f in self.free.values()] for name in ("low", "high"))
        low, high = (np.array(side, float) for side in limits)
        return self._to_vector(np.where(self.logarithmic, np.maximum(low, 0.0), low)), self._to_vector(high)

    def values(self, x):
        values = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), x)
        return dict(zip(self.keys, values.tolist(), strict=True))

    def residuals(self, x):
        """Residuals of each block; ``x`` is the searched vector as a tuple, here and in `derivatives`."""
        values = self.values(x)
        return list(self.map(lambda block: block.residual(values), self.blocks))

    def derivatives(self, x):
        """Residuals and their derivatives by the searched vector, for each block."""
        return list(self.map(partial(self._derivative, np.array(x)), self.blocks, self.columns, self.residuals(x)))

    def _derivative(self, x, block, columns, residual):
        values = self.values(x)
        if block.derivative:
            slopes = np.where(self.logarithmic[columns], [values[key] for key in block.keys], 1.0)
            return residual, block.derivative(values) * slopes
        _, high = self.bounds()
        derivative = np.empty((len(residual), len(columns)))
        for index, column in enumerate(columns):
            moved = x.copy()
            moved[column] += self.steps[column] if x[column] + self.steps[column] <= high[column] else -self.steps[column]
            derivative[:, index] = (block.residual(self.values(moved)) - residual) / (moved[column] - x[column])
        return residual, derivative

    def reduced(self, x):
        cost = sum(float(residual @ residual) for residual in self.residuals(tuple(x)))
        vector = np.zeros(len(x) + 1)
        vector[0] = np.sqrt(cost + np.sum((self.weight * (x - self.mean)) ** 2))
        return vector

    def reduced_jacobian(self, x):
        """Jacobian of `reduced`: that of all residuals, turned so that they point along the first row."""
        count = len(x)
        parts = [np.column_stack([np.diag(self.weight), self.weight * (x - self.mean)])]
        for columns, (residual, derivative) in zip(self.columns, self.derivatives(tuple(x)), strict=True):
            triangle = _triangle(np.column_stack([derivative, residual]))
            part = np.zeros((len(triangle), count + 1))
            part[:, columns], part[:, -1] = triangle[:, :-1], triangle[:, -1]
            parts.append(part)
        stacked = np.concatenate([*parts, np.zeros((count + 1, count + 1))])
        triangle = _triangle(stacked)
        jacobian, residual = triangle[:, :-1], triangle[:, -1]
        mirror = residual - np.linalg.norm(residual) * np.eye(count + 1)[0]
        length = mirror @ mirror
        return jacobian - (2.0 / length) * np.outer(mirror, mirror @ jacobian) if length > 0.0 else jacobian

    def covariance(self, x):
        """Covariance of the searched vector, and the prior's share of each parameter's information."""
        count = len(x)
        prior = np.diag(self.weight**2)
        normals, scores = [], []
        for block, columns, (residual, derivative) in zip(self.blocks, self.columns, self.derivatives(tuple(x)), strict=True):
            starts = np.flatnonzero(np.diff(block.episode, prepend=block.episode[:1] - 1))
            for rows in map(slice, starts, [*starts[1:], len(residual)]):
                normal, score = np.zeros((count, count)), np.zeros(count)
                own = derivative[rows]
                normal[np.ix_(columns, columns)] = own.T @ own
                score[columns] = own.T @ residual[rows]
                normals.append(normal)
                scores.append(score)
        information = sum(normals) + prior
        known = np.maximum(np.diag(information), 1e-300)
        return jackknife(np.array(normals), np.array(scores), prior), np.diag(prior) / known


def jackknife(normals: np.ndarray, scores: np.ndarray, prior: np.ndarray | None = None) -> np.ndarray:
    """Covariance, shape (n, n), of the solution of estimating equations that episodes add up to: each is left out in turn, and
    one Gauss-Newton step taken from the solution of all. The variance is infinite where neither episodes nor prior say
    anything.

    ``normals``: minus the derivative of each episode's score, shape (episodes, n, n), for least squares J'J; ``scores`` at the
    solution, shape (episodes, n), for least squares J'r; ``prior``: inverse covariance of what is known beside the
    episodes."""
    total = normals.sum(axis=0) if prior is None else normals.sum(axis=0) + prior
    information = np.abs(np.diag(total))
    known = information > 0.0
    # Scaled to unit diagonal: the parameters' units differ by orders of magnitude.
    unit = 1.0 / np.sqrt(np.where(known, information, 1.0))
    scale = np.outer(unit, unit)
    moves = np.array(
        [
            np.linalg.lstsq((total - normal) * scale, unit * score, rcond=1e-12)[0]
            for normal, score in zip(normals, scores, strict=True)
        ]
    )
    covariance = left_out_covariance(moves)
    if prior is not None:
        inverse = np.linalg.pinv(total * scale, rcond=1e-12)
        covariance += inverse @ (prior * scale) @ inverse.T
    covariance *= scale
    covariance[~known, ~known] = np.inf
    return covariance


def valley(cost: Callable[[float], float], grid: np.ndarray, **options: float) -> float:
    """Where a cost is least: over a grid, which finds the valley, then between the neighbours of the best.

    ``options``: of `scipy.optimize.minimize_scalar`."""
    best = int(np.argmin([cost(value) for value in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    return float(minimize_scalar(cost, bounds=bounds, method="bounded", options=options).x)


def left_out_covariance(estimates: np.ndarray) -> np.ndarray:
    """Covariance (n, n) of estimates, from those with each episode left out in turn, shape (episodes, n): the jackknife."""
    moves = estimates - estimates.mean(axis=0)
    return (len(moves) - 1) / len(moves) * moves.T @ moves
