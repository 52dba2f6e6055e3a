"""Error before and after, on logs (or episodes) that chose neither effect nor value, with intervals over episodes."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.diagnose.channels import Bench, Trial
from emb_daemon.offline import estimate
from emb_daemon.offline.score import PATHS, conditions

_RESAMPLES = 1000


@dataclass
class Errors:
    """Squared errors of all paths, by episode and condition.

    Attributes:
        sums: squared error in N², shape (paths, conditions + 1, episodes); the last condition is "total".
        counts: samples, same shape.
    """

    names: tuple[str, ...]
    conditions: tuple[str, ...]
    sums: np.ndarray
    counts: np.ndarray

    def rmse(self, path: str, condition: str = "total", weights: np.ndarray | None = None) -> float:
        """RMSE in N; ``weights`` says how often each episode counts."""
        p, c = self.names.index(path), self.conditions.index(condition)
        weights = np.ones(self.sums.shape[2]) if weights is None else weights
        count = float(self.counts[p, c] @ weights)
        return float(np.sqrt(self.sums[p, c] @ weights / count)) if count else float("nan")


def errors_of(trial: Trial, estimates: np.ndarray) -> Errors:
    """Errors of one log's estimates against its reference force, as `replay` counts them."""
    log = trial.log
    masks = conditions(log.samples, estimates, log.force_N)
    masks["total"] = np.ones(len(log.samples), bool)
    count = int(trial.episode[-1]) + 1
    shape = (len(PATHS), len(masks), count)
    sums, counts = np.zeros(shape), np.zeros(shape)
    for p, column in enumerate(PATHS.values()):
        error = estimates[column] - log.force_N
        for c, mask in enumerate(masks.values()):
            valid = mask & np.isfinite(error)
            sums[p, c] = np.bincount(trial.episode[valid], error[valid] ** 2, minlength=count)
            counts[p, c] = np.bincount(trial.episode[valid], minlength=count)
    return Errors(tuple(PATHS), tuple(masks), sums, counts)


def joined(parts: list[Errors]) -> Errors:
    return Errors(
        parts[0].names,
        parts[0].conditions,
        np.concatenate([part.sums for part in parts], axis=2),
        np.concatenate([part.counts for part in parts], axis=2),
    )


def innovation_errors(trial: Trial, estimates: np.ndarray) -> Errors:
    """The same without a reference: difference of both paths, under the name of each."""
    log = trial.log
    masks = {"total": np.ones(len(log.samples), bool)}
    turning = log.samples["has_wheel_speed"] & (log.samples["wheel_speed"] > 0.5)
    masks |= {"rotating": turning, "standing": ~turning}
    count = int(trial.episode[-1]) + 1
    error = estimates["torque_force"] - estimates["stiffness_force"]
    sums, counts = np.zeros((1, len(masks), count)), np.zeros((1, len(masks), count))
    for c, mask in enumerate(masks.values()):
        valid = mask & np.isfinite(error)
        sums[0, c] = np.bincount(trial.episode[valid], error[valid] ** 2, minlength=count)
        counts[0, c] = np.bincount(trial.episode[valid], minlength=count)
    return Errors(("innovation",), tuple(masks), sums, counts)


def judged(bench: Bench, parameters: np.void) -> Errors:
    """Errors of the running estimator with some parameters over all logs of a bench, each from a fresh start."""
    of = errors_of if bench.has_reference else innovation_errors
    return joined([of(trial, estimate(trial.log.samples, parameters)) for trial in bench.trials])


def comparison(before: Errors, after: Errors) -> dict:
    """RMSE before and after by path and condition, each with a 95 % interval, and one of the ratio, over episodes."""
    random = np.random.default_rng(0)
    count = before.sums.shape[2]
    weights = random.multinomial(count, np.full(count, 1.0 / count), _RESAMPLES)
    result: dict = {}
    for path in before.names:
        result[path] = {}
        for condition in before.conditions:
            first, second = before.rmse(path, condition), after.rmse(path, condition)
            if not np.isfinite(first):
                continue
            sampled = np.array([[before.rmse(path, condition, w), after.rmse(path, condition, w)] for w in weights])
            sampled = sampled[np.isfinite(sampled).all(axis=1)]
            low, high = np.percentile(sampled, (2.5, 97.5), axis=0)
            ratio = np.percentile(sampled[:, 1] / np.maximum(sampled[:, 0], 1e-12), (2.5, 97.5))
            result[path][condition] = {
                "rmse_before_N": first,
                "rmse_after_N": second,
                "interval_before_N": [float(low[0]), float(high[0])],
                "interval_after_N": [float(low[1]), float(high[1])],
                "ratio_interval": [float(ratio[0]), float(ratio[1])],
            }
    return result
