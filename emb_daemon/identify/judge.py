"""A calibration judged on a log that fitted nothing, by the estimator as it runs."""

from dataclasses import dataclass, field

import numpy as np

from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.offline import Log, estimate
from emb_daemon.offline.score import PATHS


@dataclass(frozen=True)
class Figures:
    """Errors against the reference force in N, over every sample that has one.

    Attributes:
        rmse, bias: by force path: stiffness, torque, maximum_likelihood, fused.
        inside_two_sigma: share of fused errors within two of the stated standard deviations.
        innovation_ratio: mean squared normalised innovation; one where the filter's noise levels fit.
        estimates: what plots need: force and sigma by path, ``sigma`` of the fused one.
    """

    rmse: dict[str, float]
    bias: dict[str, float]
    inside_two_sigma: float
    innovation_ratio: float
    estimates: dict[str, np.ndarray] = field(repr=False)

    @property
    def fused_over_better_input(self) -> float:
        """RMSE of the filter over that of the better of its two inputs."""
        return self.rmse["fused"] / min(self.rmse["stiffness"], self.rmse["torque"])


def judge(log: Log, calibration: Calibration) -> Figures:
    """Run the estimator over a log, as the daemon would, and compare."""
    estimates = estimate(log.samples, to_parameters(calibration))
    known = np.isfinite(log.force_N)
    errors = {path: (estimates[column] - log.force_N)[known] for path, column in PATHS.items()}
    inside = np.abs(errors["fused"]) <= 2.0 * estimates["sigma"][known]
    ratio = (estimates["innovation"] / estimates["innovation_sigma"]) ** 2
    return Figures(
        rmse={path: float(np.sqrt(np.nanmean(error**2))) for path, error in errors.items()},
        bias={path: float(np.nanmean(error)) for path, error in errors.items()},
        inside_two_sigma=float(np.mean(inside)),
        innovation_ratio=float(np.nanmean(ratio)) if np.isfinite(ratio).any() else np.nan,
        estimates={path: estimates[column].copy() for path, column in PATHS.items()} | {"sigma": estimates["sigma"].copy()},
    )
