"""Error figures of estimates against reference instruments: the one module in which an RMSE is computed."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from emb_daemon.logs.columns import DEPTHS_MM, References, latest
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.wire.contract import CONTACT_UNCERTAIN, FUSED

#: Motor speed (rad/s) above which the brake clamps or releases; below, it holds.
_MOVING = 5.0
#: Reference force (N) below which the pads do not touch.
_CLEARANCE_N = 100.0
#: Surface temperature (degC) above which the pads are hot.
_HOT_C = 100.0

#: Force path: its column of ESTIMATE.
PATHS = {"stiffness": "stiffness_force", "torque": "torque_force", "maximum_likelihood": "ml_force", "fused": "force"}


def rmse(error: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Root of the (weighted) mean square of the finite entries; NaN without any."""
    error = np.asarray(error)
    known = np.isfinite(error)
    if not known.any():
        return float("nan")
    return float(np.sqrt(np.average(error[known] ** 2, weights=None if weight is None else weight[known])))


def share_inside(error: np.ndarray, sigma: np.ndarray) -> float:
    """Share of the finite errors that are no larger than two of their stated standard deviations."""
    known = np.isfinite(error)
    return float(np.mean(np.abs(error[known]) <= 2.0 * sigma[known])) if known.any() else float("nan")


def figures(error: np.ndarray) -> dict[str, float]:
    """RMSE, bias, 95th percentile and maximum of ``|error|``; NaN entries do not count. Empty input gives no figures."""
    error = error[np.isfinite(error)]
    if not len(error):
        return {"samples": 0}
    size = np.abs(error)
    return {
        "samples": len(error),
        "rmse": rmse(error),
        "bias": float(np.mean(error)),
        "p95": float(np.percentile(size, 95)),
        "max": float(size.max()),
    }


def conditions(samples: np.ndarray, estimates: np.ndarray, reference_N: np.ndarray) -> dict[str, np.ndarray]:
    """Masks over the rows of one log: what the brake was doing. SAMPLE and ESTIMATE rows and reference force."""
    turning = is_turning(samples)
    in_contact = reference_N > _CLEARANCE_N
    speed = samples["speed"]
    return {
        "clearance": ~in_contact,
        "clamping": in_contact & (speed > _MOVING),
        "releasing": in_contact & (speed < -_MOVING),
        "holding": in_contact & (np.abs(speed) <= _MOVING),
        "standing": ~turning,
        "rotating": turning,
        "hot": estimates["surface"].max(axis=1) > _HOT_C,
    }


def is_turning(samples: np.ndarray) -> np.ndarray:
    """Mask of the rows in which the disc turns."""
    return samples["has_wheel_speed"] & (samples["wheel_speed"] > TURNING_RAD_PER_S)


def first_known(estimates: np.ndarray) -> int:
    """First ESTIMATE row with a known contact angle; before it the fused force is flagged as unknown. 0 if there is none, so
    that all rows are judged."""
    return int(np.argmax((estimates["source"] == FUSED) & (estimates["reasons"] & CONTACT_UNCERTAIN == 0)))


def force_figures(samples: np.ndarray, estimates: np.ndarray, reference_N: np.ndarray) -> dict[str, Any]:
    """Figures in N for each force path, and the share of fused errors inside two sigma; empty without a reference.

    The fused force is judged from `first_known` on; ``unknown_samples`` counts what comes before, or all if the contact angle
    is never known."""
    if not np.isfinite(reference_N).any():
        return {}
    masks, first = conditions(samples, estimates, reference_N), first_known(estimates)
    result: dict = {}
    for path, column in PATHS.items():
        error = estimates[column] - reference_N
        if path == "fused":
            error[:first] = np.nan
        result[path] = figures(error) | {
            "conditions": {name: figures(error[mask]) for name, mask in masks.items() if mask.any()}
        }
    result["inside_two_sigma"] = share_inside(estimates["force"] - reference_N, estimates["sigma"])
    never = bool(np.all(estimates["reasons"] & CONTACT_UNCERTAIN))
    result["unknown_samples"] = len(estimates) if never else first
    return result


def temperature_figures(time_ns: np.ndarray, estimates: np.ndarray, reference: References) -> dict[str, dict[str, float]]:
    """Figures in K for each pad and depth and for the disc, at the reference's own times; empty without a reference."""
    result: dict = {}
    errors = []
    for side, name in enumerate(("inner", "outer")):
        at, values = reference.pads[name]
        for index, depth in enumerate(DEPTHS_MM):
            error = latest(time_ns, estimates["depth"][:, side, index], at) - values[index]
            errors.append(error)
            if np.isfinite(error).any():
                result[f"{name}_{depth}mm"] = figures(error)
    if result:
        result["pads"] = figures(np.concatenate(errors))
        result["disc"] = figures(latest(time_ns, estimates["disc"], reference.time_ns) - reference.disc_C)
    return result


@dataclass(frozen=True)
class EpisodeErrors:
    """Squared errors by path, condition and episode, from which the RMSE over any choice of episodes follows."""

    paths: tuple[str, ...]
    conditions: tuple[str, ...]
    sums: np.ndarray  #: of squared errors, shape (paths, conditions, episodes); the last condition is "total"
    counts: np.ndarray  #: samples, same shape

    @classmethod
    def of(cls, errors: dict[str, np.ndarray], masks: dict[str, np.ndarray], episode: np.ndarray) -> "EpisodeErrors":
        """Sums of one log, from errors by path and masks by condition over its rows; ``episode`` counts from 0, shape (n,)."""
        masks = masks | {"total": np.ones(len(episode), bool)}
        shape = (len(errors), len(masks), int(episode[-1]) + 1)
        sums, counts = np.zeros(shape), np.zeros(shape)
        for p, error in enumerate(errors.values()):
            for c, mask in enumerate(masks.values()):
                valid = mask & np.isfinite(error)
                sums[p, c] = np.bincount(episode[valid], error[valid] ** 2, minlength=shape[2])
                counts[p, c] = np.bincount(episode[valid], minlength=shape[2])
        return cls(tuple(errors), tuple(masks), sums, counts)

    @classmethod
    def joined(cls, parts: list["EpisodeErrors"]) -> "EpisodeErrors":
        """The episodes of several logs with the same paths and conditions, one after the other."""
        sums, counts = (np.concatenate([getattr(part, name) for part in parts], axis=2) for name in ("sums", "counts"))
        return cls(parts[0].paths, parts[0].conditions, sums, counts)

    def rmse(self, path: str, condition: str = "total", weights: np.ndarray | None = None) -> float:
        """RMSE in the errors' unit; ``weights`` says how often each episode counts. NaN without samples."""
        return float(self.rmses(path, condition, np.ones(self.sums.shape[2]) if weights is None else weights))

    def rmses(self, path: str, condition: str, weights: np.ndarray) -> np.ndarray:
        """RMSE for each row of ``weights``, shape (..., episodes)."""
        p, c = self.paths.index(path), self.conditions.index(condition)
        with np.errstate(invalid="ignore"):
            return np.sqrt(weights @ self.sums[p, c] / (weights @ self.counts[p, c]))

    def samples(self, path: str) -> int:
        """Samples with a finite error of ``path``."""
        return int(self.counts[self.paths.index(path), -1].sum())
