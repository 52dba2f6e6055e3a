"""Judges estimates of one drive, phase by phase, against the reference force: is the estimator ever silently wrong?

A phase is a named span of the drive. Samples are *silent* while the mode is running or adapting, so that a reader trusts them.
They are *usable* where the source is not invalid and the mode not init.
"""

from dataclasses import asdict, dataclass

import numpy as np

from emb_daemon.offline.score import rmse
from emb_daemon.offline.stretches import stretches_of
from emb_daemon.wire.contract import ADAPTING, FUSED, INIT, INVALID, RESULT_ACCEPTED, RUNNING
from studies.faults import Fault

#: Noise of the reference force sensor, N, which sigma need not cover.
REFERENCE_SIGMA_N = 25.0
#: What is promised of every phase. Shares are of the phase's silent or usable samples; forces in N, times in s.
SILENT_BEYOND, USABLE_BEYOND = 0.01, 0.02
LARGE_N, LONGEST_LARGE_S, SILENT_LARGE = 1000.0, 0.1, 1 / 2000
#: What keeps the estimator useful: share of samples with mode running and sigma up to this, with nothing wrong and after a
#: change was learned; RMSE after it was learned, and with nothing wrong over what it was before.
USEFUL_SIGMA_N, NOMINAL_USEFUL, LEARNED_USEFUL, LEARNED_RMSE_N, NOMINAL_WORSE = 300.0, 0.99, 0.90, 100.0, 1.10
_RUNNING_MODES = (RUNNING, ADAPTING)
#: Flags within this time, s, are due to power-on: slow inputs have not been received yet.
POWER_ON_S = 0.5


@dataclass(frozen=True)
class Phase:
    """Figures of one phase. ``failed`` names the criteria that it misses; NaN where there is nothing to judge."""

    name: str
    samples: int
    silent: float
    #: ``silent_beyond`` and ``usable_beyond``: shares beyond three sigma.
    silent_beyond: float
    usable_beyond: float
    #: ``silent_large`` and ``longest_large_s``: share, and longest stretch, of silent errors beyond 1 kN.
    silent_large: float
    longest_large_s: float
    worst_silent_N: float  #: largest error of a silent sample
    useful: float  #: share with mode running and sigma up to 300 N
    #: ``rmse_N`` and ``sigma_N``: of usable samples; sigma is their median.
    rmse_N: float
    sigma_N: float
    better_path_N: float  #: RMSE of the better of both paths on these samples, which the fused force should keep to
    failed: tuple[str, ...]

    def as_dict(self) -> dict:
        return asdict(self)


def verdict(
    family: str, number: int, fault: Fault, time_s: np.ndarray, estimates: np.ndarray, onset_s: float, phases: list[Phase]
) -> dict:
    """What is told of a drive with a fault; its flags count from ``onset_s`` on."""
    accepted = (estimates["adapt_result"] == RESULT_ACCEPTED).astype(int)
    return {
        "family": family,
        "number": number,
        "size": fault.size,
        "onset_s": fault.onset_s,
        "trained": int((np.diff(accepted) > 0).sum()),
        "first_flag_s": first_flag_s(time_s, estimates, onset_s),
        "phases": [phase.as_dict() for phase in phases],
    }


def _share(mask: np.ndarray, of: np.ndarray) -> float:
    count = int(of.sum())
    return float((mask & of).sum() / count) if count else 0.0


def _longest(mask: np.ndarray, time_s: np.ndarray) -> float:
    """Longest time that ``mask`` lasts, in s; 0 for a single sample."""
    first, after = stretches_of(mask).T
    return float(np.max(time_s[after - 1] - time_s[first], initial=0.0))


def judge(
    name: str,
    time_s: np.ndarray,
    estimates: np.ndarray,
    reference_N: np.ndarray,
    useful: float | None = None,
    rmse_N: float | None = None,
) -> Phase:
    """Figures and verdict of one phase: ESTIMATE rows, their times and the reference force (NaN where none is known).

    ``useful`` and ``rmse_N`` are promised where given: the smallest share of useful samples, the largest RMSE."""
    known = np.isfinite(reference_N)
    time_s, estimates, reference_N = time_s[known], estimates[known], reference_N[known]
    silent = np.isin(estimates["mode"], _RUNNING_MODES)
    usable = (estimates["source"] != INVALID) & (estimates["mode"] != INIT)
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(estimates["force"] - reference_N)
        # NaN counts as beyond any bound.
        beyond = ~(error <= 3.0 * np.hypot(estimates["sigma"], REFERENCE_SIGMA_N))
        large = ~(error <= LARGE_N) & silent
        errors = [(estimates[path] - reference_N)[usable] for path in ("force", "stiffness_force", "torque_force")]
        fused_N, *paths_N = (rmse(path) if np.isfinite(path).all() else np.nan for path in errors)
    figures = {
        "silent": float(silent.mean()) if len(silent) else 0.0,
        "silent_beyond": _share(beyond, silent),
        "usable_beyond": _share(beyond, usable),
        "silent_large": _share(large, silent),
        "longest_large_s": _longest(large, time_s),
        "worst_silent_N": float(error[silent].max()) if silent.any() else 0.0,
        "useful": _share((estimates["mode"] == RUNNING) & (estimates["sigma"] <= USEFUL_SIGMA_N), np.ones_like(silent)),
        "rmse_N": fused_N,
        "sigma_N": float(np.median(estimates["sigma"][usable])) if usable.any() else np.nan,
        "better_path_N": float(np.fmin(*paths_N)),
    }
    criteria = {
        "silent beyond 3 sigma": figures["silent_beyond"] <= SILENT_BEYOND,
        "silent beyond 1 kN": figures["longest_large_s"] <= LONGEST_LARGE_S and figures["silent_large"] <= SILENT_LARGE,
        "usable beyond 3 sigma": figures["usable_beyond"] <= USABLE_BEYOND,
        "useful": useful is None or figures["useful"] >= useful,
        "rmse": rmse_N is None or figures["rmse_N"] <= rmse_N,
    }
    return Phase(name, len(error), **figures, failed=tuple(key for key, met in criteria.items() if not met))


def flags(estimates: np.ndarray) -> np.ndarray:
    """Mask of the rows that are flagged: a reason, a mode other than running or adapting, or a lower source."""
    return (estimates["reasons"] != 0) | ~np.isin(estimates["mode"], _RUNNING_MODES) | (estimates["source"] != FUSED)


def first_flag_s(time_s: np.ndarray, estimates: np.ndarray, onset_s: float) -> float:
    """Time from ``onset_s`` to the first flag after it, NaN without one."""
    told = np.flatnonzero(flags(estimates) & (time_s >= onset_s))
    return float(time_s[told[0]] - onset_s) if len(told) else np.nan


_COLUMNS = ("silent", ">3s silent", ">3s usable", ">1 kN", "longest", "worst", "useful", "RMSE", "better path", "sigma")
HEADINGS = f"{'phase':<10}" + "".join(f"{column:>13}" for column in _COLUMNS)


def line(phase: Phase) -> str:
    """One line under `HEADINGS`."""
    shares = (phase.silent, phase.silent_beyond, phase.usable_beyond, phase.silent_large)
    cells = [f"{100 * share:.2f} %" for share in shares] + [f"{phase.longest_large_s:.2f} s", f"{phase.worst_silent_N:.3g} N"]
    cells += [f"{100 * phase.useful:.1f} %", f"{phase.rmse_N:.3g} N", f"{phase.better_path_N:.3g} N", f"{phase.sigma_N:.3g} N"]
    verdict = "FAILS: " + ", ".join(phase.failed) if phase.failed else "ok"
    return f"{phase.name:<10}" + "".join(f"{cell:>13}" for cell in cells) + "  " + verdict
