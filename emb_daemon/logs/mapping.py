"""Logs of other people's rigs: their DBC's signals as our frames, by a mapping file.

A foreign log has neither our ids nor E2E protection. Its signals are decoded by its own DBC, converted to our units and put
on the wire as our messages with counters that count resolver cycles, so that the pipeline stays the only
way into the estimator.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import Struct
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.logs.columns import absent_raw
from emb_daemon.logs.read import read_frames
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import ERROR, EXTENDED, FRAME, REMOTE
from emb_daemon.wire.layout import CORNERS, load_database, signal_columns
from emb_daemon.wire.units import UNITS

#: Deviation of a foreign rig's sampling period from ours up to which its samples are taken as they are.
_SAME_PERIOD = 0.05
#: Longest silence, in nominal cycles of our message or in periods of theirs, over which a value is carried on.
_CARRIED_CYCLES, _CARRIED_PERIODS = 5, 3
#: Signals that the estimator does not use; they may stay unmapped and are sent as zero.
_UNUSED = ("CurrentD", "DcBusVoltage")


class Mapped(Struct, kw_only=True):
    """Where one of our signals comes from: a signal of the rig's DBC, or a constant."""

    #: Message.Signal of the rig's DBC.
    signal: str | None = None
    #: Its unit, where the rig's DBC states none or a wrong one.
    unit: str | None = None
    #: ours = scale * (theirs, in our unit) + offset; offset in our unit.
    scale: float = 1.0
    offset: float = 0.0
    #: A constant in our unit, for what the rig does not measure.
    value: float | None = None

    def __post_init__(self):
        if (self.signal is None) == (self.value is None):
            raise ValueError("expected either signal (Message.Signal of the rig's DBC) or value (a constant)")
        if self.value is not None and (self.unit is not None or self.scale != 1.0 or self.offset != 0.0):
            raise ValueError("value: stands alone, in our unit")
        if self.scale == 0.0:
            raise ValueError("scale: 0 leaves nothing of the signal")


class MappingFile(Struct, kw_only=True):
    """mapping.yaml."""

    format: Annotated[int, Meta(ge=1, le=1)]
    #: The rig's DBC, relative to this file.
    dbc: str
    #: Our Message.Signal (dbc/emb.dbc, and dbc/rig.dbc for references): where it comes from.
    signals: dict[str, Mapped]


class _Source:
    """One foreign signal, converted to our unit."""

    def __init__(self, message, name: str, scale: float, offset: float):
        self.message, self.name, self.scale, self.offset = message, name, scale, offset
        self.time_ns = np.zeros(0, np.int64)
        self.values = np.zeros(0)

    def decode(self, frames: np.ndarray) -> None:
        """Take the signal's values from a log; one in a frame too short for it is left out."""
        flags = frames["flags"] & (EXTENDED | REMOTE | ERROR)
        mine = (frames["can_id"] == self.message.frame_id) & (flags == EXTENDED * self.message.is_extended_frame)
        times, values = [], []
        for frame in frames[mine].tolist():
            data = frame[1].to_bytes(8, "little")[: min(frame[3], 8)]
            value = self.message.decode(data, decode_choices=False, allow_truncated=True).get(self.name)
            if value is not None:
                times.append(frame[0])
                values.append(float(value))
        order = np.argsort(times, kind="stable")
        self.time_ns = np.array(times, np.int64)[order]
        self.values = self.scale * np.array(values)[order] + self.offset

    @property
    def period_ns(self) -> float:
        return float(np.median(np.diff(self.time_ns))) if len(self.time_ns) > 2 else float(CYCLE_NS)

    def held(self, at_ns: np.ndarray, cycle_ns: int) -> np.ndarray:
        """The value last heard, NaN where that is too long ago."""
        if not len(self.time_ns):
            return np.full(len(at_ns), np.nan)
        row = np.searchsorted(self.time_ns, at_ns, side="right") - 1
        age = at_ns - self.time_ns[np.maximum(row, 0)]
        fresh = (row >= 0) & (age <= max(_CARRIED_CYCLES * cycle_ns, _CARRIED_PERIODS * self.period_ns))
        return np.where(fresh, self.values[np.maximum(row, 0)], np.nan)

    def sampled(self, at_ns: np.ndarray) -> np.ndarray:
        """The value at each time, straight between samples, NaN in gaps."""
        if not len(self.time_ns):
            return np.full(len(at_ns), np.nan)
        origin = self.time_ns[0]
        values = np.interp((at_ns - origin).astype(float), (self.time_ns - origin).astype(float), self.values)
        after = np.clip(np.searchsorted(self.time_ns, at_ns), 0, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        apart = np.minimum(np.abs(self.time_ns[after] - at_ns), np.abs(at_ns - self.time_ns[before]))
        return np.where(apart <= max(CYCLE_NS, _CARRIED_PERIODS * self.period_ns), values, np.nan)

    def averaged(self, at_ns: np.ndarray) -> np.ndarray:
        """Mean over the cycle that ends at each time where the rig samples faster than we do, otherwise as `sampled`."""
        if self.period_ns > 0.75 * CYCLE_NS:
            return self.sampled(at_ns)
        total = np.concatenate([[0.0], np.cumsum(self.values)])
        stop = np.searchsorted(self.time_ns, at_ns, side="right")
        start = np.searchsorted(self.time_ns, at_ns - CYCLE_NS, side="right")
        return np.where(stop > start, (total[stop] - total[start]) / np.maximum(stop - start, 1), np.nan)


class Mapping:
    """A mapping file, checked against both DBCs.

    Raises:
        InputErrors: every fault of the file: unknown signals of either DBC, units that do not fit, signals left out.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        file = load_yaml(self.path, MappingFile)
        theirs = load_database(self.path.parent / file.dbc)
        self._ours = {
            message.name: (message, database)
            for database in (load_database(resource("dbc/emb.dbc")), load_database(resource("dbc/rig.dbc")))
            for message in database.messages
        }
        self._faults: list[str] = []
        #: Signals by message: where they come from, a constant, or None for an instrument that the rig has not.
        self._messages: dict[str, dict[str, _Source | float | None]] = {}
        for name, mapped in file.signals.items():
            self._add(name, mapped, theirs)
        self._complete()
        if self._faults:
            raise InputErrors(self._faults)

    def _fault(self, key: str, text: str) -> None:
        self._faults.append(f"{self.path}: signals.{key}: {text}")

    def _add(self, name: str, mapped: Mapped, theirs) -> None:
        message_name, _, signal_name = name.partition(".")
        if message_name not in self._ours or (message_name.startswith("EMB_") and not _is_received(message_name)):
            return self._fault(name, "expected Message.Signal of what the daemon receives, such as EMB_FL_Resolver.MotorAngle")
        ours = {signal.name: signal for signal in self._ours[message_name][0].signals}.get(signal_name)
        if ours is None or signal_name in ("CRC", "Counter", "Status"):
            return self._fault(name, f"{message_name} has no such signal to map")
        signals = self._messages.setdefault(message_name, {})
        if mapped.value is not None:
            signals[signal_name] = mapped.value
            return None
        their_message, _, their_signal = mapped.signal.rpartition(".")
        try:
            message = theirs.get_message_by_name(their_message)
            found = message.get_signal_by_name(their_signal)
        except KeyError:
            return self._fault(name, f"{mapped.signal}: the rig's DBC has no such message and signal")
        unit = (found.unit or "" if mapped.unit is None else mapped.unit).strip()
        if unit not in UNITS:
            return self._fault(name, f"unit {unit!r} of {mapped.signal} is unknown; state one of {', '.join(UNITS)[:-2]}")
        target, factor, shift = UNITS[unit]
        if target != (ours.unit or ""):
            hint = "" if unit else "; state `unit:`"
            return self._fault(
                name, f"{mapped.signal} is in {unit or 'no unit'}, which cannot become {ours.unit or 'a number'}{hint}"
            )
        signals[signal_name] = _Source(message, their_signal, mapped.scale * factor, mapped.scale * shift + mapped.offset)
        return None

    def _complete(self) -> None:
        """A message is sent whole: what is left out would be a zero that somebody believes."""
        corners = [corner for corner in CORNERS if f"EMB_{corner}_Resolver" in self._messages]
        if not corners and not self._faults:
            self._faults.append(
                f"{self.path}: signals: expected EMB_c_Resolver.MotorAngle and MotorSpeed of at least one corner"
            )
        self._clocks = {}
        for name, signals in self._messages.items():
            for signal in self._ours[name][0].signals:
                optional = signal.name in (*_UNUSED, "CRC", "Counter", "Status") or name.startswith("RIG_")
                other = name in ("VEH_WheelSpeed", "VEH_WheelPulse") and signal.name[-2:] not in corners
                if signal.name not in signals:
                    if optional or other:
                        signals[signal.name] = None if name.startswith("RIG_") else 0.0
                    else:
                        self._fault(f"{name}.{signal.name}", "missing: map it too, or give it a constant `value`")
            if name.endswith("_Resolver") and not any(isinstance(source, _Source) for source in signals.values()):
                self._fault(name, "only constants: expected at least one signal of the rig")
        for corner in corners:
            clock = self._messages[f"EMB_{corner}_Resolver"].get("MotorAngle")
            if isinstance(clock, _Source):
                self._clocks[corner] = clock

    def read(self, path: str | Path) -> np.ndarray:
        """A foreign log as FRAME array of our messages, in time order; instead of `logs.read.read_frames`.

        Raises:
            InputError: unreadable, or nothing of the mapped signals in it.
        """
        return self.translate(read_frames(path), Path(path))

    def translate(self, frames: np.ndarray, path: Path = Path("frames")) -> np.ndarray:
        """Our frames of a foreign log's frames; ``path`` is what messages call it."""
        for signals in self._messages.values():
            for source in signals.values():
                if isinstance(source, _Source):
                    source.decode(frames)
        ticks = {corner: _clock(source) for corner, source in self._clocks.items()}
        if not any(len(times) for times, _ in ticks.values()):
            wanted = ", ".join(
                sorted({f"{source.message.name} ({source.message.frame_id:#x})" for source in self._clocks.values()})
            )
            raise InputError(f"{path}: no frame of {wanted} in it, which {self.path} maps to motor angle")
        first = min(int(times[0]) for times, _ in ticks.values() if len(times))
        last = max(int(times[-1]) for times, _ in ticks.values() if len(times))
        parts = [self._frames_of(name, signals, ticks, first, last) for name, signals in self._messages.items()]
        result = np.concatenate(parts)
        # Stable: at one instant slow messages come first and the resolver last, as the pipeline pairs it with its current.
        return result[np.argsort(result["time_ns"], kind="stable")]

    def _frames_of(self, name: str, signals: dict, ticks: dict, first: int, last: int) -> np.ndarray:
        message, database = self._ours[name]
        corner = name.split("_")[1]
        if corner in ticks and name.endswith(("_Resolver", "_Current", "_Force")):
            times, cycles = ticks[corner]
            take = {"_Current": _Source.averaged}.get(name[name.rindex("_") :], _Source.sampled)
            values = {key: take(source, times) if isinstance(source, _Source) else source for key, source in signals.items()}
        else:
            cycle_ns = (message.cycle_time or 40) * 1_000_000
            times = np.arange(first, last + 1, cycle_ns)
            cycles = np.arange(len(times))
            values = {
                key: source.held(times, cycle_ns) if isinstance(source, _Source) else source for key, source in signals.items()
            }
        names = tuple(key for key in signals if key not in ("CRC", "Counter", "Status"))
        payload, usable = np.zeros(len(times), np.uint64), np.ones(len(times), bool)
        for signal, key in zip(signal_columns(database, name, names), names, strict=True):
            start, length = np.uint64(signal["start"]), int(signal["length"])
            if values[key] is None:
                payload |= np.uint64(absent_raw(length) & ((1 << length) - 1)) << start
                continue
            column = np.broadcast_to(np.asarray(values[key], float), times.shape)
            usable &= np.isfinite(column) & (column >= signal["low"]) & (column <= signal["high"])
            raw = np.rint((np.where(np.isfinite(column), column, 0.0) - signal["offset"]) / signal["factor"]).astype(np.int64)
            payload |= (raw.astype(np.uint64) & np.uint64((1 << length) - 1)) << start
        frames = np.zeros(int(usable.sum()), FRAME)
        frames["time_ns"], frames["can_id"], frames["length"] = times[usable], message.frame_id, 8
        frames["data"] = payload[usable]
        if not name.startswith("RIG_"):
            counters = cycles[usable] % COUNTER_MODULO
            for frame, counter in zip(frames, counters.tolist(), strict=True):
                frame["data"] = protect(message.frame_id, frame["data"], counter, 0)
        return frames


def _is_received(message: str) -> bool:
    return message.endswith(("_Resolver", "_Current", "_Thermocouple"))


def _clock(angle: _Source) -> tuple[np.ndarray, np.ndarray]:
    """Times of the resolver samples and the cycle that each belongs to: the rig's own samples if its period is ours, a grid of
    our period otherwise."""
    times = angle.time_ns
    if len(times) < 3:
        return times, np.arange(len(times))
    if abs(angle.period_ns / CYCLE_NS - 1.0) <= _SAME_PERIOD:
        steps = np.maximum(np.rint(np.diff(times) / CYCLE_NS).astype(np.int64), 1)
        return times, np.concatenate([[0], np.cumsum(steps)])
    grid = np.arange(int(times[0]), int(times[-1]) + 1, CYCLE_NS)
    return grid, np.arange(len(grid))
