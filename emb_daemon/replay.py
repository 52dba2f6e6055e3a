"""Logs through the daemon's pipeline, one after the other as one drive."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.estimator.status import TABLE
from emb_daemon.logs.columns import Decoder, References, beyond_range
from emb_daemon.logs.read import read_frames
from emb_daemon.offline import corner_index, estimate
from emb_daemon.offline.log import CAPACITY, collect, make_log
from emb_daemon.offline.score import force_figures, temperature_figures
from emb_daemon.pipeline import Pipeline
from emb_daemon.wire.contract import INVALID, REASONS
from emb_daemon.wire.layout import CORNERS
from emb_daemon.wire.receive import BAD_RANGE

#: Stands for every corner in a log.
ALL = "all"

#: Pause between two logs, if the second's clock does not continue the first's.
_PAUSE_NS = 1_000_000_000


@dataclass(frozen=True)
class Result:
    """One corner of a replayed log: ESTIMATE and SAMPLE rows, one per resolver sample, and times on the log's own clock.

    Times in ``estimates``, ``samples`` and ``reference`` are on the drive's clock, which continues from log to log."""

    path: Path
    time_ns: np.ndarray
    estimates: np.ndarray
    samples: np.ndarray
    reference: References
    force_N: np.ndarray

    def since(self, time_ns: int) -> "Result":
        """The part from ``time_ns`` on the log's clock on. Raises InputError: there is none."""
        rows = self.time_ns >= time_ns
        if not rows.any():
            raise InputError(f"{self.path}: ends before --from")
        names = ("time_ns", "estimates", "samples", "force_N")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Shares of the samples with each reason and fact (`estimator.status.TABLE`), and error figures against the log's
        reference instruments, if it has any."""
        return {
            "log": str(self.path),
            "corner": CORNERS[self.samples["corner"][0]],
            "samples": len(self.estimates),
            "seconds": 1e-9 * float(self.time_ns[-1] - self.time_ns[0]),
            "reasons": _shares(self.estimates["reasons"], REASONS),
            "facts": _shares(self.estimates["facts"], TABLE),
            "invalid": float(np.mean(self.estimates["source"] == INVALID)),
            "force_N": force_figures(self.samples, self.estimates, self.force_N),
            "temperature_K": temperature_figures(self.estimates["time_ns"], self.estimates, self.reference),
        }


def _shares(bits: np.ndarray, words: Iterable[str]) -> dict[str, float]:
    """Share of the samples with each bit that occurs, by its word, the most frequent first."""
    shares = [(word, float(np.mean(bits >> bit & 1))) for bit, word in enumerate(words)]
    return dict(sorted((share for share in shares if share[1]), key=lambda share: -share[1]))


class Replay:
    """A drive made of logs.

    Args:
        corner: FL, FR, RL, RR, or ``all`` for every corner in the first log.
        measured_torque: use the rig's brake torque sensor for the heat model instead of the estimated force.
        state: folder from which learned values are restored and in which adaptation stores them; without one, nothing is
            learned.
        read: a log's FRAME array by its path; `logs.mapping.Mapping.read` for logs of other rigs.
        start_s, end_s: seconds of each log, from its first frame, between which results are given. Estimation always
            begins with the log, because otherwise the contact angle would be unknown.
    """

    def __init__(
        self,
        calibration: Calibration,
        corner: str = "FL",
        measured_torque: bool = False,
        state: Path | None = None,
        read: Callable[[Path], np.ndarray] = read_frames,
        start_s: float = 0.0,
        end_s: float = float("inf"),
    ):
        self._calibration, self._measured_torque, self._read_whole = calibration, measured_torque, read
        self._start_s, self._end_s = start_s, end_s
        self._memory = Memory(state) if state else None
        self._end_ns: int | None = None
        self._pipeline: Pipeline | None = None
        self.adaptation: Adaptation | None = None  #: the adaptation, if there is a state folder
        self.corners: tuple[str, ...] = ()  #: those that are estimated; for ``all`` known from the first log on
        self.notes: list[str] = []  #: a line for each signal of a log with values that the daemon does not use
        if corner != ALL:
            self._build((CORNERS[corner_index(corner)],))

    def _build(self, corners: tuple[str, ...]) -> None:
        self.corners = corners
        parameters = np.full(4, to_parameters(self._calibration), PARAMETERS)
        calibrations = dict.fromkeys(corners, self._calibration)
        self.adaptation = Adaptation(calibrations, self._memory, int) if self._memory else None
        self._pipeline = Pipeline(parameters, corners, capacity=CAPACITY, adaptation=self.adaptation)

    def _read(self, path: Path) -> np.ndarray:
        frames = self._read_whole(path)
        seconds = 1e-9 * (frames["time_ns"] - frames["time_ns"][0])
        # Some loggers write a bus's frames a little out of order.
        return frames[seconds <= self._end_s] if self._end_s < seconds.max() else frames

    def _start_ns(self, frames: np.ndarray) -> int:
        return int(frames["time_ns"][0]) + round(1e9 * self._start_s)

    def _on_the_drive(self, frames: np.ndarray, path: Path) -> int:
        """Convert a log's times to the drive's clock, in place; returns the difference."""
        if self._pipeline is None:
            self._build(corners_in(frames, path))
        first = int(frames["time_ns"][0])
        if self._end_ns is None:
            self._pipeline.begin(first)
            shift = 0
        else:
            shift = max(0, self._end_ns + _PAUSE_NS - first)
        frames["time_ns"] += shift
        self._end_ns = int(frames["time_ns"][-1])
        return shift

    def frames(self, path: Path) -> Iterator[np.ndarray]:
        """The frames that the daemon would have sent, as FRAME arrays on the drive's clock."""
        frames = self._read(path)
        self._on_the_drive(frames, path)
        start, since = 0, self._start_ns(frames)
        while start < len(frames):
            start, count = self._pipeline.consume(frames, start)
            sent = self._pipeline.broadcast(count)
            yield sent[sent["time_ns"] >= since]

    def run(self, path: Path) -> Result:
        """Replay one log; returns the result of the first corner. Raises InputError: unreadable, or without a usable resolver
        sample of a corner."""
        return self.run_corners(path)[0]

    def run_corners(self, path: Path) -> list[Result]:
        """Replay one log; returns a result for each corner. Errors as in `run`."""
        frames = self._read(path)
        shift = self._on_the_drive(frames, path)
        pipeline = self._pipeline
        samples = collect(frames, pipeline)
        if pipeline.receptions["count"][:, BAD_RANGE].any():
            self.notes += [f"{path}: {line}" for line in beyond_range(frames)]
        if len(self.corners) == 1:
            # Views, because a row of a long log is half a kilobyte.
            mine: dict = {self.corners[0]: slice(None)}
        else:
            mine = {corner: samples["corner"] == corner_index(corner) for corner in self.corners}
        logs = {corner: make_log(samples[rows], frames, corner, Path(path)) for corner, rows in mine.items()}
        if self._measured_torque:
            for corner, log in logs.items():
                if log.full_torque:
                    raise InputError(f"{path}: {log.full_torque}; expected a torque within it, or without --measured-torque")
                samples["brake_torque"][mine[corner]] = log.reference.latest(log.time_ns, log.reference.brake_torque_Nm)
        estimates = estimate(samples, pipeline.parameters, pipeline.states, self.adaptation)
        results = [
            Result(log.path, log.time_ns - shift, estimates[mine[corner]], samples[mine[corner]], log.reference, log.force_N)
            for corner, log in logs.items()
        ]
        return [result.since(self._start_ns(frames) - shift) for result in results] if self._start_s > 0.0 else results


def corners_in(frames: np.ndarray, path: Path) -> tuple[str, ...]:
    decoder = Decoder()
    heard = set(np.unique(frames["can_id"]).tolist())
    found = tuple(corner for corner in CORNERS if decoder.can_id(f"EMB_{corner}_Resolver") in heard)
    if not found:
        raise InputError(f"{path}: no resolver frame of any corner")
    return found
