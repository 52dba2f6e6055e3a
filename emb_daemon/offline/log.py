"""A log, read once: samples by the daemon's own pipeline, slow channels, and what reference instruments measured."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.estimator.records import PARAMETERS, SAMPLE
from emb_daemon.logs.columns import Decoder, References, crc_is_right, nearest
from emb_daemon.logs.read import ids_in, read_frames
from emb_daemon.pipeline import Pipeline
from emb_daemon.wire.frames import EXTENDED, FRAME
from emb_daemon.wire.layout import CORNERS

#: Samples that a pipeline takes in one call; a log is collected in pieces.
CAPACITY = 1 << 14
#: Time within which a reference's frame is a sample's own, ns: half a cycle.
_NEAR_NS = 2_000_000
#: Step of the reference brake torque, N·m, from which its number was full: 0.8 of what its 16 bits hold. A brake that is
#: turned round at once does not reach both ends of it.
_FULL_NM = 0.8 * 6553.6


@dataclass(frozen=True)
class SlowChannels:
    """Messages with a longer period than the motor's, at their own times, with the signal names of dbc/emb.dbc.

    Each holds ``time_ns`` and the message's signals, shape (n,); frames with a wrong CRC are left out."""

    thermocouples: dict[str, np.ndarray]
    wheel_speed: dict[str, np.ndarray]
    status: dict[str, np.ndarray]


@dataclass(frozen=True)
class Log:
    """One corner's samples of a log, and what its reference instruments measured."""

    path: Path
    corner: str
    samples: np.ndarray  #: SAMPLE array, one row per resolver sample; ``brake_torque`` is NaN, as in a car
    time_ns: np.ndarray  #: of each sample, on the log's clock
    reference: References  #: rig instruments; empty in a car
    force_N: np.ndarray  #: reference clamp force at each sample, NaN where none was recorded
    #: FRAME array of the slow messages, from which `slow` is decoded when it is used.
    frames: np.ndarray = field(default_factory=lambda: np.zeros(0, FRAME), repr=False)

    @property
    def time_s(self) -> np.ndarray:
        """Seconds since the first sample."""
        return 1e-9 * (self.time_ns - self.time_ns[0])

    @cached_property
    def stamped_later_ns(self) -> float:
        """Time from a sample to the stamp of its reference force, ns, as a rule; 0 where none is near."""
        times = self.reference.time_ns
        later = times[nearest(times, self.time_ns)] - self.time_ns if len(times) else np.zeros(0)
        near = np.abs(later) < _NEAR_NS
        return float(np.median(later[near])) if near.any() else 0.0

    @property
    def full_torque(self) -> str:
        """What the reference brake torque does where its number was full, in words; nothing if it never was."""
        torque = self.reference.brake_torque_Nm[np.isfinite(self.reference.brake_torque_Nm)]
        steps = np.abs(np.diff(torque))
        if not len(steps) or np.max(steps) <= _FULL_NM:
            return ""
        where = int(np.argmax(steps))
        return (
            f"the reference brake torque goes from {torque[where]:.4g} to {torque[where + 1]:.4g} N·m at once: its number, "
            "which ends at 3277 N·m, was full"
        )

    def with_reference_earlier(self, late_s: float) -> "Log":
        """The same with the reference force, which came ``late_s`` after its samples, at its own time."""
        return replace(self, force_N=np.interp(self.time_s + late_s, self.time_s, self.force_N))

    @cached_property
    def slow(self) -> SlowChannels:
        """Thermocouples, wheel speeds and vehicle status at their own rate."""
        decoder, frames = Decoder(), self.frames[crc_is_right(self.frames)]
        return SlowChannels(*(decoder.columns(frames, message) for message in _slow_messages(self.corner)))


def _slow_messages(corner: str) -> tuple[str, str, str]:
    return f"EMB_{corner}_Thermocouple", "VEH_WheelSpeed", "VEH_Status"


def load_log(path: str | Path, corner: str = "FL", read: Callable[[Path], np.ndarray] = read_frames) -> Log:
    """Read a log into samples. ``read`` gives a FRAME array by path; `logs.mapping.Mapping.read` for logs of other rigs.
    Raises InputError: unreadable, not a corner, or no resolver sample of it."""
    return log_of(read(Path(path)), corner, Path(path))


def log_of(frames: np.ndarray, corner: str = "FL", path: Path = Path("frames")) -> Log:
    """A FRAME array as samples; ``path`` is what messages call it. Raises InputError: not a corner, or no resolver sample of
    it."""
    return make_log(samples_in(frames, (CORNERS[corner_index(corner)],))[0], frames, corner, path)


def samples_in(frames: np.ndarray, corners: tuple[str, ...]) -> tuple[np.ndarray, Pipeline]:
    """SAMPLE rows of corners in frames, and the pipeline that found them."""
    pipeline = Pipeline(np.zeros(4, PARAMETERS), corners, capacity=CAPACITY)
    pipeline.begin(int(frames["time_ns"][0]))
    return collect(frames, pipeline), pipeline


def collect(frames: np.ndarray, pipeline: Pipeline) -> np.ndarray:
    """All samples that a pipeline finds in frames, going on from where it was."""
    found, start = bytearray(), 0
    while start < len(frames):
        start, count = pipeline.collect(frames, start, predictions=False)
        # By their bytes: numpy copies records field by field, which takes ten times as long.
        found += pipeline.samples[:count].tobytes()
    return np.frombuffer(found, SAMPLE)


def make_log(samples: np.ndarray, frames: np.ndarray, corner: str, path: Path) -> Log:
    """A corner's samples and references as a `Log`; errors as in `log_of`."""
    decoder = Decoder()
    if not len(samples):
        raise InputError(f"{path}: {_why_empty(frames, corner, decoder.can_id(f'EMB_{corner}_Resolver'))}")
    reference = References(frames, corner)
    times = samples["time_ns"]
    slow = np.isin(frames["can_id"], [decoder.can_id(message) for message in _slow_messages(corner)])
    return Log(path, corner, samples, times, reference, reference.at(times, reference.clamp_force_N), frames[slow])


def _why_empty(frames: np.ndarray, corner: str, resolver_id: int) -> str:
    """Why frames contain no resolver sample of a corner, and what to do."""
    mine = frames["can_id"] == resolver_id
    if (frames["flags"][mine] & EXTENDED == 0).any():
        return f"no resolver sample of corner {corner} that passes its CRC and counter check"
    decoder = Decoder()
    if others := [name for name in CORNERS if np.any(frames["can_id"] == decoder.can_id(f"EMB_{name}_Resolver"))]:
        return f"nothing of corner {corner}; it holds {', '.join(others)} (--corner)"
    return (
        f"no frame of id {resolver_id:#x}, the resolver of corner {corner}; found {ids_in(frames)}; a rig with other ids "
        "needs a mapping file (--mapping)"
    )


def corner_index(corner: str) -> int:
    """0 to 3. Raises InputError: not a corner."""
    if corner not in CORNERS:
        raise InputError(f"corner {corner}: expected one of {', '.join(CORNERS)}")
    return CORNERS.index(corner)
