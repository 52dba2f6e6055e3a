"""Logs through the daemon's pipeline, one after the other as one drive."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.logs.columns import References
from emb_daemon.logs.read import read_frames
from emb_daemon.offline import corner_index, estimate, log_of
from emb_daemon.offline.log import CAPACITY
from emb_daemon.offline.score import force_figures, temperature_figures
from emb_daemon.pipeline import Pipeline

#: Pause between two logs of which the second's clock does not go on from the first's.
_PAUSE_NS = 1_000_000_000


def _log_date(time_ns: int) -> str:
    """The date by a log's clock, so that a replay writes the same file whenever it runs."""
    return datetime.fromtimestamp(1e-9 * time_ns, UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class Result:
    """One replayed log: ESTIMATE and SAMPLE rows, one per resolver sample, and times on the log's own clock."""

    path: Path
    time_ns: np.ndarray
    estimates: np.ndarray
    samples: np.ndarray
    reference: References
    force_N: np.ndarray

    def figures(self) -> dict:
        """Error figures against the log's reference instruments, as far as it has any."""
        return {
            "log": str(self.path),
            "samples": len(self.estimates),
            "seconds": 1e-9 * float(self.time_ns[-1] - self.time_ns[0]),
            "force_N": force_figures(self.samples, self.estimates, self.force_N),
            "temperature_K": temperature_figures(self.time_ns, self.estimates, self.reference),
        }


class Replay:
    """A drive made of logs.

    Args:
        calibration: of the corner's actuator.
        corner: FL, FR, RL or RR.
        measured_torque: heat the pads with the rig's brake torque sensor instead of the estimated force.
        state: folder from which learned values are restored and in which adaptation keeps them; without one, nothing is
            learned.
        read: a log's FRAME array by its path; `logs.mapping.Mapping.read` for logs of other rigs.
    """

    def __init__(
        self,
        calibration: Calibration,
        corner: str = "FL",
        measured_torque: bool = False,
        state: Path | None = None,
        read=read_frames,
    ):
        self._read = read
        self._corner = corner
        self._index = corner_index(corner)
        self._parameters = np.zeros(4, PARAMETERS)
        self._parameters[self._index] = to_parameters(calibration)
        self._measured_torque = measured_torque
        self.adaptation = Adaptation({corner: calibration}, Memory(state), _log_date) if state else None
        self._pipeline = Pipeline(self._parameters, (corner,), capacity=CAPACITY, adaptation=self.adaptation)
        self._end_ns: int | None = None

    def _on_the_drive(self, frames: np.ndarray) -> int:
        """Put a log's times on the drive's clock, in place; returns what was added."""
        first = int(frames["time_ns"][0])
        if self._end_ns is None:
            self._pipeline.begin(first)
            shift = 0
        else:
            shift = max(0, self._end_ns + _PAUSE_NS - first)
        frames["time_ns"] += shift
        self._end_ns = int(frames["time_ns"][-1])
        return shift

    def frames(self, path: Path):
        """The frames that the daemon would have sent, as FRAME arrays on the drive's clock."""
        frames = self._read(path)
        self._on_the_drive(frames)
        start = 0
        while start < len(frames):
            start, count = self._pipeline.consume(frames, start)
            yield self._pipeline.broadcast(count).copy()

    def run(self, path: Path) -> Result:
        """Replay one log.

        Raises:
            InputError: unreadable, or without a usable resolver sample of the corner.
        """
        frames = self._read(path)
        shift = self._on_the_drive(frames)
        pipeline = self._pipeline
        log = log_of(frames, self._corner, Path(path), pipeline)
        if self._measured_torque:
            log.samples["brake_torque"] = log.reference.latest(log.time_ns, log.reference.brake_torque_Nm)
        estimates = estimate(log.samples, pipeline.parameters, pipeline.states, self.adaptation)
        return Result(log.path, log.time_ns - shift, estimates, log.samples, log.reference, log.force_N)
