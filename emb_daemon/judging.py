"""Error figures of estimates against reference instruments, in total and per condition."""

import numpy as np

#: Motor speed (rad/s) above which the brake clamps or releases; below, it holds.
_MOVING = 5.0
#: Reference force (N) below which the pads hang in the clearance.
_CLEARANCE_N = 100.0
#: Wheel speed (rad/s) above which the disc turns, and surface temperature (degC) above which the pads are hot.
_TURNING = 0.5
_HOT_C = 100.0


def figures(error: np.ndarray) -> dict[str, float]:
    """RMSE, bias, 95th percentile and maximum of ``|error|``; NaN entries do not count. Empty input gives no figures."""
    error = error[np.isfinite(error)]
    if not len(error):
        return {"samples": 0}
    size = np.abs(error)
    return {
        "samples": len(error),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "bias": float(np.mean(error)),
        "p95": float(np.percentile(size, 95)),
        "max": float(size.max()),
    }


def conditions(samples: np.ndarray, estimates: np.ndarray, reference_N: np.ndarray) -> dict[str, np.ndarray]:
    """Masks over the rows of one log: what the brake was doing. SAMPLE and ESTIMATE rows and reference force."""
    turning = samples["has_wheel_speed"] & (samples["wheel_speed"] > _TURNING)
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


PATHS = {"stiffness": "stiffness_force", "torque": "torque_force", "maximum_likelihood": "ml_force", "fused": "force"}


def force_figures(samples: np.ndarray, estimates: np.ndarray, reference_N: np.ndarray) -> dict:
    """Figures in N for each force path, and the share of fused errors inside two sigma; empty without a reference."""
    if not np.isfinite(reference_N).any():
        return {}
    masks = conditions(samples, estimates, reference_N)
    result: dict = {}
    for path, column in PATHS.items():
        error = estimates[column] - reference_N
        result[path] = figures(error) | {
            "conditions": {name: figures(error[mask]) for name, mask in masks.items() if mask.any()}
        }
    known = np.isfinite(reference_N)
    inside = np.abs(estimates["force"] - reference_N)[known] <= 2.0 * estimates["sigma"][known]
    result["inside_two_sigma"] = float(np.mean(inside))
    return result


def temperature_figures(time_ns: np.ndarray, estimates: np.ndarray, reference) -> dict:
    """Figures in K for each pad and depth and for the disc, at the reference's own times; empty without a reference.

    ``reference`` is a `logs.columns.References`.
    """
    result: dict = {}
    errors = []
    for side, name in enumerate(("inner", "outer")):
        at, values = reference.pads[name]
        row = _latest(time_ns, at)
        for index, depth in enumerate((2, 4, 6, 8)):
            error = np.where(row >= 0, estimates["depth"][row, side, index], np.nan) - values[index]
            errors.append(error)
            if np.isfinite(error).any():
                result[f"{name}_{depth}mm"] = figures(error)
    if errors and np.isfinite(np.concatenate(errors)).any():
        result["pads"] = figures(np.concatenate(errors))
        row = _latest(time_ns, reference.time_ns)
        result["disc"] = figures(np.where(row >= 0, estimates["disc"][row], np.nan) - reference.disc_C)
    return result


def _latest(time_ns: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Row of the last sample at or before each time; -1 before the first."""
    return np.searchsorted(time_ns, at, side="right") - 1
