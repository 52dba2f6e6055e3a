"""Records a drive on a bus: the car's truth, and the daemon's broadcasts as received."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.logs.columns import Decoder
from emb_daemon.monitor.listener import Corner, Listener
from emb_daemon.offline.score import figures, share_inside
from emb_daemon.plant.records import CYCLE_NS, TRUTH
from emb_daemon.wire.contract import INVALID, PREDICTED, STATUS_DEGRADED
from emb_daemon.wire.e2e import COUNTER_MODULO, status_of
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import CLAMP_FORCE, CORNERS, PAD_TEMP, default_layout

#: Age from which an estimate belongs to a later sample with the same counter.
_LATEST_CYCLES = COUNTER_MODULO - 1
#: Frames of a corner in one cycle at most: a force, and the slower messages.
_FRAMES_PER_CYCLE = 6


@dataclass(frozen=True)
class Comparison:
    """One corner's estimates, with the truth of the samples that they refer to."""

    time_s: np.ndarray  #: of the samples, from the start; shape (n,), as all below
    #: ``force_N``, ``sigma_N`` and ``true_N``: estimate, its standard deviation, simulated truth.
    force_N: np.ndarray
    sigma_N: np.ndarray
    true_N: np.ndarray
    response_s: np.ndarray  #: from a sample's frames on the bus to its estimate on the bus
    usable: np.ndarray  #: the estimate's Status was not NotAvailable or Fault
    samples: int  #: number of resolver samples that reached the bus

    def figures(self) -> dict[str, float]:
        """Error figures in N over the usable estimates, and the share of them within two sigma."""
        error = (self.force_N - self.true_N)[self.usable]
        none = dict.fromkeys(("rmse", "bias", "p95", "max"), np.nan)
        return none | figures(error) | {"within_2_sigma": share_inside(error, self.sigma_N[self.usable])}


class Recorder:
    """Fills preallocated arrays from the car's thread; read it at any time, compare at the end."""

    def __init__(self, corners: tuple[str, ...], seconds: float):
        cycles = round(seconds * 1e9 / CYCLE_NS) + 1
        self.corners = corners
        self.truth: np.ndarray = np.zeros((cycles, len(corners)), TRUTH)
        self.sent_ns: np.ndarray = np.zeros(cycles, np.int64)
        self.cycles: int = 0
        self.frames: np.ndarray = np.zeros(cycles * len(corners) * _FRAMES_PER_CYCLE, FRAME)
        #: Number of cycles that the car had sent when a frame arrived.
        self.frame_cycle: np.ndarray = np.zeros(len(self.frames), np.int64)
        self.count: int = 0
        self._ids = default_layout()[0]["sent_id"]
        #: Listener of the live view, and number of frames that it has received.
        self._listener, self._listened = Listener(), 0

    def note_sent(self, time_ns: int, truth: np.ndarray) -> None:
        """Note a cycle of the car that left at ``time_ns``, or was lost (0)."""
        self.truth[self.cycles] = truth
        self.sent_ns[self.cycles] = time_ns
        self.cycles += 1

    def note_received(self, frames: np.ndarray) -> None:
        """Note frames that were received from the bus."""
        room = min(len(frames), len(self.frames) - self.count)
        self.frames[self.count : self.count + room] = frames[:room]
        self.frame_cycle[self.count : self.count + room] = self.cycles
        self.count += room

    def present(self, now_ns: int) -> list[Corner]:
        """The corners as the monitor has them from the broadcasts so far, with the true force as reference."""
        # The car drives on while the frames are read: the reference is that of the last of them.
        count, forces = self.count, self.truth["force"][self.cycles - 1]
        self._listener.receive(self.frames[self._listened : count])
        self._listened = count
        corners = [self._listener.corners[CORNERS.index(name)] for name in self.corners]
        for corner, force_N in zip(corners, forces, strict=True):
            corner.set_reference(force_N, now_ns)
        return corners

    def recent_responses(self) -> np.ndarray:
        """Response times (s) of the first corner's estimates of the last two seconds or so."""
        start = max(self.count - 1000 * len(self.corners), 0)
        return self._match(0, start, self.count)[3]

    def _match(self, row: int, start: int, stop: int):
        """(frames of the clamp force, their row in the truth, status, response time in s)."""
        corner = CORNERS.index(self.corners[row])
        frames, cycle = self.frames[start:stop], self.frame_cycle[start:stop]
        mine = (frames["can_id"] == self._ids[CLAMP_FORCE, corner]) & (cycle > 0)
        frames, newest = frames[mine], cycle[mine] - 1
        answered = Decoder().columns(frames, f"EMB_{self.corners[row]}_ClampForce")["InputCounter"].astype(np.int64)
        age = (self.truth["counter"][newest, row] - answered) % COUNTER_MODULO
        known = (answered < COUNTER_MODULO) & (age <= np.minimum(newest, _LATEST_CYCLES))
        known &= self.sent_ns[np.where(known, newest - age, 0)] > 0
        frames, at = frames[known], (newest - age)[known]
        status = status_of(frames["data"]).astype(np.int64)
        return frames, at, status, 1e-9 * (frames["time_ns"] - self.sent_ns[at])

    def compare(self, row: int) -> Comparison:
        """One corner over the complete drive; estimates of samples only, without predictions."""
        frames, at, status, response = self._match(row, 0, self.count)
        corner = self.corners[row]
        columns = Decoder().columns(frames, f"EMB_{corner}_ClampForce")
        # A sample that the machine held up on its way has an age, but its estimate is no prediction.
        answers = (columns["InputAge"] == 0.0) | (columns["ForceSource"] < PREDICTED)
        time = 1e-9 * (self.truth["time_ns"][at, row] - self.truth["time_ns"][0, row])
        return Comparison(
            time_s=time[answers],
            force_N=1e3 * columns["ClampForce"][answers],
            sigma_N=1e3 * columns["ClampForceSigma"][answers],
            true_N=self.truth["force"][at, row][answers],
            response_s=response[answers],
            usable=(status <= STATUS_DEGRADED)[answers] & (columns["ForceSource"] != INVALID)[answers],
            samples=int(np.count_nonzero(self.sent_ns)),
        )

    def temperatures(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Pad temperatures that the first corner's daemon broadcast: (time in s, columns in degC), where they were usable."""
        frames, cycle = self.frames[: self.count], self.frame_cycle[: self.count]
        columns = Decoder().columns(frames, f"EMB_{self.corners[0]}_PadTemp")
        cycle = cycle[np.isin(frames["can_id"], self._ids[PAD_TEMP, CORNERS.index(self.corners[0])])]
        usable = (columns["Status"] <= STATUS_DEGRADED) & (cycle > 0)
        at = cycle[usable] - 1
        time = 1e-9 * (self.truth["time_ns"][at, 0] - self.truth["time_ns"][0, 0])
        return time, {name: values[usable] for name, values in columns.items()}
