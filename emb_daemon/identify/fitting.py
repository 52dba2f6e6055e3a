"""Least squares as the steps of identification need it: few parameters, many samples, most parameters belonging to one log."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: Samples whose residuals are taken for one observation when the covariance is formed: a second at full rate.
CLUSTER = 250


@dataclass(frozen=True)
class Solution:
    """Result of a fit.

    Attributes:
        x: parameters, shape (n,).
        covariance: of ``x``, shape (n, n), robust against residuals that are correlated within a second.
        residuals: one array per block, at ``x``.
    """

    x: np.ndarray
    covariance: np.ndarray
    residuals: list[np.ndarray]

    @property
    def rms(self) -> float:
        """Over all residuals."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals) ** 2)))


@dataclass(frozen=True)
class Block:
    """Residuals of one log.

    Attributes:
        residual: parameters (all of them) to residuals.
        columns: indices of the parameters that these residuals depend on.
    """

    residual: Callable[[np.ndarray], np.ndarray]
    columns: np.ndarray


def _jacobian(block: Block, x: np.ndarray, at_x: np.ndarray, step: np.ndarray) -> np.ndarray:
    jacobian = np.empty((len(at_x), len(block.columns)))
    for index, column in enumerate(block.columns):
        moved = x.copy()
        moved[column] += step[column]
        jacobian[:, index] = (block.residual(moved) - at_x) / step[column]
    return jacobian


def least_squares(
    blocks: list[Block],
    x: np.ndarray,
    scale: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    iterations: int = 40,
    tolerance: float = 1e-5,
) -> Solution:
    """Levenberg-Marquardt on the normal equations, numeric Jacobian, parameters held to [low, high].

    Args:
        scale: change of each parameter that is small but visible; a thousandth of it is the step of the Jacobian.
        tolerance: relative fall of the cost that ends the search.

    Returns:
        The solution with the sandwich covariance, clustered by second (Liang and Zeger, Biometrika 73, 1986).
    """
    x = np.clip(np.array(x, dtype=float), low, high)
    count = len(x)
    step = 1e-3 * scale
    damping = 1e-3
    residuals = [block.residual(x) for block in blocks]
    cost = sum(float(r @ r) for r in residuals)
    for _ in range(iterations):
        normal, gradient = np.zeros((count, count)), np.zeros(count)
        for block, r in zip(blocks, residuals, strict=True):
            jacobian = _jacobian(block, x, r, step)
            normal[np.ix_(block.columns, block.columns)] += jacobian.T @ jacobian
            gradient[block.columns] += jacobian.T @ r
        held = ((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0))
        free = np.flatnonzero(~held)
        before = cost
        while damping < 1e12:
            system = normal[np.ix_(free, free)]
            diagonal = np.diag(system) + 1e-12 * np.max(np.diag(system), initial=1e-300)
            move = np.zeros(count)
            move[free] = np.linalg.solve(system + damping * np.diag(diagonal), -gradient[free])
            trial = np.clip(x + move, low, high)
            found = [block.residual(trial) for block in blocks]
            trial_cost = sum(float(r @ r) for r in found)
            if trial_cost < cost:
                x, residuals, cost = trial, found, trial_cost
                damping = max(damping / 10.0, 1e-12)
                break
            damping *= 10.0
        else:
            break
        if before - cost < tolerance * before:
            break
    return Solution(x, _sandwich(blocks, x, residuals, step, (x <= low) | (x >= high)), residuals)


def _sandwich(blocks, x, residuals, step, held):
    count = len(x)
    normal, scores = np.zeros((count, count)), []
    for block, r in zip(blocks, residuals, strict=True):
        jacobian = _jacobian(block, x, r, step)
        normal[np.ix_(block.columns, block.columns)] += jacobian.T @ jacobian
        weighted = jacobian * r[:, None]
        starts = np.arange(0, len(r), CLUSTER)
        sums = np.zeros((len(starts), count))
        sums[:, block.columns] = np.add.reduceat(weighted, starts, axis=0)
        scores.append(sums)
    return clustered_covariance(normal, np.concatenate(scores), ~held)


def clustered_covariance(normal: np.ndarray, scores: np.ndarray, free: np.ndarray | None = None) -> np.ndarray:
    """Covariance from the normal matrix (n, n) and the score of each cluster (clusters, n); zero where not ``free``."""
    count = len(normal)
    free = np.arange(count) if free is None else np.flatnonzero(free)
    system = normal[np.ix_(free, free)]
    # Scaled to unit diagonal: the parameters' units differ by orders of magnitude.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(system), 1e-300))
    inverse = np.linalg.pinv(system * np.outer(unit, unit), rcond=1e-12) * np.outer(unit, unit)
    scores = scores[:, free]
    correction = len(scores) / max(len(scores) - len(free), 1)
    covariance = np.zeros((count, count))
    covariance[np.ix_(free, free)] = correction * inverse @ (scores.T @ scores) @ inverse
    return covariance
