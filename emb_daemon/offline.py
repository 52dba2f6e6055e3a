"""Logs through the estimator without a bus: what replay, identify and diagnose stand on.

`load_log` turns a log into samples once, by the daemon's own pipeline; `estimate` runs the daemon's own estimator over
them, with any parameters, as often as one likes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.estimator.answer import answer
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, new_state
from emb_daemon.logs.columns import References
from emb_daemon.logs.read import read_frames
from emb_daemon.pipeline import Pipeline
from emb_daemon.wire.layout import CORNERS


@dataclass(frozen=True)
class Log:
    """One corner's samples of a log, and what its reference instruments measured.

    Attributes:
        samples: SAMPLE array, one row per resolver sample; ``brake_torque`` is NaN, as in a car.
        time_ns: of each sample, on the log's clock.
        reference: rig instruments; empty in a car.
        force_N: reference clamp force at each sample, NaN where none was recorded.
    """

    path: Path
    corner: str
    samples: np.ndarray
    time_ns: np.ndarray
    reference: References
    force_N: np.ndarray

    @property
    def time_s(self) -> np.ndarray:
        """Seconds since the first sample."""
        return 1e-9 * (self.time_ns - self.time_ns[0])


def load_log(path: str | Path, corner: str = "FL", read=read_frames) -> Log:
    """Read a log into samples. ``read`` gives a FRAME array by path; `logs.mapping.Mapping.read` for logs of other rigs.

    Raises:
        InputError: unreadable, or no resolver sample of that corner in it.
    """
    return log_of(read(path), corner, Path(path))


def log_of(frames: np.ndarray, corner: str = "FL", path: Path = Path("frames")) -> Log:
    """A FRAME array as samples; ``path`` is what messages call it.

    Raises:
        InputError: no resolver sample of that corner in it.
    """
    pipeline = Pipeline(np.zeros(4, PARAMETERS), (corner,), capacity=1 << 14)
    pipeline.begin(int(frames["time_ns"][0]))
    parts, start = [], 0
    while start < len(frames):
        start, count = pipeline.collect(frames, start, predictions=False)
        parts.append(pipeline.samples[:count].copy())
    samples = np.concatenate(parts)
    if not len(samples):
        raise InputError(f"{path}: no resolver sample of corner {corner} that passes its CRC and counter check")
    reference = References(frames, corner)
    times = samples["time_ns"]
    return Log(path, corner, samples, times, reference, reference.at(times, reference.clamp_force_N))


def estimate(samples: np.ndarray, parameters: np.ndarray | np.void, state: np.ndarray | None = None) -> np.ndarray:
    """Run the estimator over SAMPLE rows; returns ESTIMATE rows. ``state`` (one STATE) is carried on if given.

    ``parameters`` is one PARAMETERS record or an array of shape (1,)."""
    estimates = np.zeros(len(samples), ESTIMATE)
    answer(samples, len(samples), new_state() if state is None else state, np.atleast_1d(parameters), estimates)
    return estimates


def corner_index(corner: str) -> int:
    """0 to 3.

    Raises:
        InputError: not a corner.
    """
    if corner not in CORNERS:
        raise InputError(f"corner {corner}: expected one of {', '.join(CORNERS)}")
    return CORNERS.index(corner)
