"""Faults of sensors and bus (`studies.faults`) put into the frames of a measured log, judged before and after their onset.

So a brake whose physics nobody here chose is judged under faults as well. What happens to the brake itself needs a plant, and
`studies.grid` has one.
"""

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.read import read_frames
from emb_daemon.offline import load_log
from emb_daemon.offline.stretches import stretches_of
from studies.faults import size_of
from studies.phases import POWER_ON_S, judge, verdict

#: Frames that a fault sees at once, s.
_STRETCH_S = 0.08
#: The pads touch above this share of the log's largest force; a stop lasts, and pads are open, at least this long, s.
_TOUCHING, _STOP_S, _OPEN_S = 0.05, 1.5, 2.0


def _spells(mask: np.ndarray, time_s: np.ndarray, least_s: float) -> list[float]:
    """Where stretches of ``mask`` begin that last ``least_s``, s."""
    first, after = stretches_of(mask).T
    begin, end = time_s[first], time_s[after - 1]
    return begin[end - begin >= least_s].tolist()


def _draw_moments(time_s: np.ndarray, force_N: np.ndarray, rng: np.random.Generator) -> dict[str, float]:
    """Moments of a log by the names that a drive of `studies.grid` has. Raises InputError: the brake never opens, or never
    closes."""
    touching = force_N > _TOUCHING * np.nanmax(force_N)
    stops, opens = _spells(touching, time_s, _STOP_S), _spells(~touching, time_s, _OPEN_S)
    if not stops or not opens:
        raise InputError(f"expected a log with stops of {_STOP_S:g} s and {_OPEN_S:g} s between them")
    early = [at for at in opens if at < 0.5 * time_s[-1]] or opens[:1]
    clamped = stops[: max(len(stops) // 2, 1)]
    moments = {name: float(at) for name, at in zip(("go_1", "go_2", "go_3"), sorted(rng.choice(early, 3)), strict=True)}
    moments |= {name: float(rng.choice(clamped)) for name in ("hold_1", "stop_1", "drag_1", "stop_2", "reversals")}
    return moments | {"park": opens[len(opens) // 2]}


def judge_injected(
    path: Path, calibration: Calibration, family: Callable, name: str, number: int, seed: int, run: Callable
) -> dict | None:
    """Verdict of a log with a fault of ``family``, as `studies.grid.judge_drive` gives it; None if that fault is not in
    frames alone.

    ``run(frames)`` returns times since the log's first frame (s), ESTIMATE rows and reference force (N)."""
    log = load_log(path)
    rng = np.random.default_rng([seed, number, zlib.crc32(name.encode())])
    size = size_of(calibration, shipped_calibration())
    frames = read_frames(path)
    moments = _draw_moments(1e-9 * (log.time_ns - frames["time_ns"][0]), log.force_N, rng)
    fault = family(rng, moments, size)
    if not fault.is_in_frames:
        return None
    at_s = 1e-9 * (frames["time_ns"] - frames["time_ns"][0])
    cuts = np.searchsorted(at_s, np.arange(fault.power_on_s, at_s[-1], _STRETCH_S))
    stretches = [(at_s[cut], part) for cut, part in zip(cuts, np.split(frames, cuts)[1:], strict=True) if len(part)]
    time_s, estimates, force_N = run(np.concatenate([fault.bus(part.copy(), begin_s) for begin_s, part in stretches]))
    begun = time_s >= fault.onset_s
    spans = {"before": ~begun, "after": begun}
    phases = [judge(phase, time_s[rows], estimates[rows], force_N[rows]) for phase, rows in spans.items() if rows.any()]
    onset = max(fault.onset_s, fault.power_on_s + POWER_ON_S)
    return verdict(name, number, fault, time_s, estimates, onset, phases)
