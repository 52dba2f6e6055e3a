"""Error before and after, on logs (or episodes) that were not used for search and fit, with intervals over episodes."""

from typing import Any

import numpy as np

from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.diagnose.residuals import Bench, Trial
from emb_daemon.offline.run import estimate, held, run_step
from emb_daemon.offline.score import PATHS, EpisodeErrors, conditions, first_known, is_turning

_RESAMPLES = 1000


def errors_of(bench: Bench, trial: Trial, calibration: Calibration) -> EpisodeErrors:
    """Errors in N of the running estimator over one log: against its reference force, as `replay` counts them, or without one
    the difference of both paths. Where nothing is clamped the load has either sign, and is the torque path's alone."""
    log, parameters = trial.log, to_parameters(calibration)
    turning = is_turning(log.samples)
    if not bench.clamps:
        errors = {"torque": bench.torque_left(trial, run_step(log.samples, held(parameters)))}
        return EpisodeErrors.of(errors, {"rotating": turning, "standing": ~turning}, trial.episode)
    estimates = estimate(log.samples, parameters)
    if bench.has_reference:
        errors = {path: estimates[column] - log.force_N for path, column in PATHS.items()}
        errors["fused"][: first_known(estimates)] = np.nan
        return EpisodeErrors.of(errors, conditions(log.samples, estimates, log.force_N), trial.episode)
    errors = {"innovation": estimates["torque_force"] - estimates["stiffness_force"]}
    return EpisodeErrors.of(errors, {"rotating": turning, "standing": ~turning}, trial.episode)


def errors(bench: Bench, calibration: Calibration) -> EpisodeErrors:
    """Errors of the running estimator over all logs of a bench, each from a fresh start."""
    return EpisodeErrors.joined([errors_of(bench, trial, bench.on(trial, calibration)) for trial in bench.trials])


def by_log(bench: Bench, judged: EpisodeErrors, path: str) -> np.ndarray:
    """RMSE of a path, N, on each log of the bench whose episodes were ``judged``, shape (logs,); NaN where it has none."""
    return judged.rmses(path, "total", episodes_by_log(bench))


def episodes_by_log(bench: Bench) -> np.ndarray:
    """Mask (1 or 0), shape (logs, episodes): which episodes belong to which log."""
    lengths = [int(trial.episode[-1]) + 1 for trial in bench.trials]
    return (np.repeat(np.arange(len(lengths)), lengths) == np.arange(len(lengths))[:, None]).astype(float)


def whole(bench: Bench) -> str:
    """The path by which a diagnosis is judged: the fused force, or the only path there is."""
    if not bench.has_reference:
        return "innovation"
    if not bench.clamps:
        return "torque"
    return "fused" if bench.has_current else "stiffness"


def comparison(before: EpisodeErrors, after: EpisodeErrors) -> dict[str, dict[str, dict[str, Any]]]:
    """RMSE before and after by path and condition, each with a 95 % interval, and one of the ratio, over episodes.

    A path without finite errors on these logs is left out."""
    random = np.random.default_rng(0)
    count = before.sums.shape[2]
    weights = random.multinomial(count, np.full(count, 1.0 / count), _RESAMPLES)
    result: dict = {}
    for path in before.paths:
        known = [c for c in before.conditions if np.isfinite(before.rmse(path, c) + after.rmse(path, c))]
        if "total" in known:
            result[path] = {condition: _compare(before, after, path, condition, weights) for condition in known}
    return result


def _compare(before: EpisodeErrors, after: EpisodeErrors, path: str, condition: str, weights: np.ndarray) -> dict:
    sampled = np.column_stack([which.rmses(path, condition, weights) for which in (before, after)])
    sampled = sampled[np.isfinite(sampled).all(axis=1)]
    low, high = np.percentile(sampled, (2.5, 97.5), axis=0)
    ratio = np.percentile(sampled[:, 1] / np.maximum(sampled[:, 0], 1e-12), (2.5, 97.5))
    return {
        "rmse_before_N": before.rmse(path, condition),
        "rmse_after_N": after.rmse(path, condition),
        "interval_before_N": [float(low[0]), float(high[0])],
        "interval_after_N": [float(low[1]), float(high[1])],
        "ratio_interval": [float(ratio[0]), float(ratio[1])],
    }
