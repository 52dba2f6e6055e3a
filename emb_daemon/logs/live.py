"""Another rig's live bus as ours: its frames become our messages as they arrive, by the mapping file that reads its logs.

The motor angle's frames are the clock, as in logs. Faster ones than ours are thinned out to our cycle, the current in between
averaged; slower ones stay as they are, since nothing can be put between samples of which the second has not come yet.
"""

import math
import time
from dataclasses import dataclass, field

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.logs.mapping import Mapping, Source
from emb_daemon.logs.resample import CARRIED_CYCLES, HEADER, cycle_ns, our_messages, unrepeated
from emb_daemon.runtime.bus import PythonCanBus, open_python_can
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import CORNERS, pack, signal_columns

#: A sample is due when this share of our cycle has passed since the last; a bus delays single frames by as much.
_DUE = 0.9
#: Between two looks at several buses, s: a fraction of our cycle.
_POLL_S = 0.0005


@dataclass
class _Value:
    """The last value of one of the rig's signals, in our unit, and the sum of those since the last sample."""

    source: Source
    heard_ns: int = 0
    last: float = math.nan
    total: float = 0.0
    count: int = 0
    _turned: float = math.nan

    def take(self, raw: float, time_ns: int) -> None:
        period = self.source.period
        if period is not None and math.isfinite(self._turned):
            raw = self._turned + math.remainder(raw - self._turned, period)
        self._turned = raw
        self.last, self.heard_ns = self.source.scale * raw + self.source.offset, time_ns
        self.total += self.last
        self.count += 1

    def mean(self) -> float:
        """Of what came since the last call; the last value where nothing did."""
        mean = self.total / self.count if self.count else self.last
        self.total, self.count = 0.0, 0
        return mean


@dataclass
class _Message:
    """One of our messages: where its signals come from, and how it is packed."""

    can_id: int
    cycle_ns: int
    signals: dict[str, _Value | float]
    layout: dict[str, np.void]
    sent_ns: int = 0
    counter: int = -1
    before: dict[str, float] = field(default_factory=dict)

    def fresh(self, now_ns: int) -> bool:
        """Whether every signal that the rig sends has been heard, not too long ago."""
        most = CARRIED_CYCLES * max(self.cycle_ns, CYCLE_NS)
        values = [value for value in self.signals.values() if isinstance(value, _Value)]
        return all(value.heard_ns and now_ns - value.heard_ns <= most for value in values)

    def frame(self, values: dict[str, float], time_ns: int) -> tuple | None:
        """A FRAME row; None where a value is none that the message can carry."""
        payload = 0
        for name, value in values.items():
            layout = self.layout[name]
            if not layout["low"] <= value <= layout["high"]:
                return None
            payload |= int(pack(value, layout))
        self.sent_ns = time_ns
        return time_ns, int(protect(self.can_id, payload, self.counter % COUNTER_MODULO, 0)), self.can_id, 8, 0


class SeveralBuses:
    """python-can buses by channel as one of them: frames of all, each with its channel; what is sent goes to the first."""

    def __init__(self, buses: dict):
        self._buses = buses

    def fileno(self) -> int:
        raise NotImplementedError

    def recv(self, timeout_s: float):
        """The next frame of any, None if none comes in time."""
        until = time.monotonic() + timeout_s
        while True:
            for channel, bus in self._buses.items():
                if (message := bus.recv(0)) is not None:
                    message.channel = channel
                    return message
            if (left := until - time.monotonic()) <= 0.0:
                return None
            time.sleep(min(_POLL_S, left))

    def send(self, message) -> None:
        next(iter(self._buses.values())).send(message)

    def shutdown(self) -> None:
        for bus in self._buses.values():
            bus.shutdown()


class MappedBus(PythonCanBus):
    """A python-can bus of another rig, with the calls of `runtime.bus.PythonCanBus`; what is sent goes out as it is.

    Args:
        bus: python-can's, without filters; for CAN FD opened with it.
        mapping: by the rig's DBC; its references stay outside.

    Raises:
        InputError: a mapping of tables has no frames.
    """

    def __init__(self, bus, mapping: Mapping):
        super().__init__(bus, [])
        if not mapping.databases:
            raise InputError(f"{mapping.path}: maps columns; expected one with `dbc` for a live bus")
        self._values: list[_Value] = []
        self._messages = {name: self._message(name, mapping) for name in mapping.messages if not name.startswith("RIG_")}
        self._theirs: dict[tuple[int, bool], list[tuple]] = {}
        for value in self._values:
            source = value.source
            message, _, signal = source.name.rpartition(".")
            theirs = mapping.databases[source.bus].get_message_by_name(message)
            readers = self._theirs.setdefault((theirs.frame_id, theirs.is_extended_frame), [])
            readers.append((mapping.channels[source.bus], theirs, signal, value))
        self._clocks = {}
        for corner in CORNERS:
            if resolver := self._messages.get(f"EMB_{corner}_Resolver"):
                clock = next(value for value in resolver.signals.values() if isinstance(value, _Value))
                self._clocks[corner] = clock

    def _message(self, name: str, mapping: Mapping) -> _Message:
        message, database = our_messages()[name]
        names = tuple(signal.name for signal in message.signals if signal.name not in HEADER)
        # Each of ours has its own, for two may come from one of the rig's, by different scales.
        signals = {
            signal: _Value(source) if isinstance(source, Source) else source
            for signal, source in mapping.messages[name].items()
        }
        self._values += [value for value in signals.values() if isinstance(value, _Value)]
        layout = dict(zip(names, signal_columns(database, name, names), strict=True))
        return _Message(message.frame_id, cycle_ns(message), signals, layout)

    def drain(self) -> np.ndarray:
        rows = []
        for message, time_ns in self._arrived():
            if not (message.is_error_frame or message.is_remote_frame):
                rows += self.heard(message, time_ns)
        return np.array(rows, FRAME)

    def heard(self, message, time_ns: int) -> list[tuple]:
        """FRAME rows that a frame of the rig (python-can Message) makes of ours."""
        decoded: dict[int, dict] = {}
        for channel, theirs, name, value in self._theirs.get((message.arbitration_id, message.is_extended_id), ()):
            if channel is not None and channel != str(message.channel):
                continue
            if id(theirs) not in decoded:
                decoded[id(theirs)] = theirs.decode(bytes(message.data), decode_choices=False, allow_truncated=True)
            if math.isfinite(raw := float(decoded[id(theirs)].get(name, math.nan))):
                value.take(raw, time_ns)
        if not decoded:
            return []
        rows = []
        for corner, clock in self._clocks.items():
            resolver = self._messages[f"EMB_{corner}_Resolver"]
            if clock.heard_ns == time_ns and time_ns - resolver.sent_ns >= _DUE * CYCLE_NS:
                rows += self._sample(corner, resolver, time_ns)
        return [row for row in rows if row is not None]

    def _sample(self, corner: str, resolver: _Message, time_ns: int) -> list[tuple | None]:
        """A sample of a corner, and the slow messages that are due."""
        rows = [
            slow.frame(_completed(slow), time_ns)
            for name, slow in self._messages.items()
            if not name.endswith(("_Resolver", "_Current")) and self._is_due(slow, time_ns)
        ]
        cycles = max(1, round((time_ns - resolver.sent_ns) / CYCLE_NS)) if resolver.sent_ns else 1
        motion = _motion(resolver, time_ns)
        resolver.counter += cycles
        current = self._messages.get(f"EMB_{corner}_Current")
        if current is not None and current.fresh(time_ns):
            current.counter = resolver.counter
            values = {name: v.mean() if isinstance(v, _Value) else v for name, v in current.signals.items()}
            rows.append(current.frame(values, time_ns))
        rows.append(resolver.frame(motion, time_ns))
        return rows

    def _is_due(self, slow: _Message, time_ns: int) -> bool:
        if time_ns - slow.sent_ns < _DUE * slow.cycle_ns or not slow.fresh(time_ns):
            return False
        slow.counter += 1
        return True


def _motion(resolver: _Message, time_ns: int) -> dict[str, float]:
    """Angle and speed at a sample; one that the rig does not measure from the other, since the sample before."""
    known = {name: v.last if isinstance(v, _Value) else v for name, v in resolver.signals.items()}
    elapsed_s = 1e-9 * (time_ns - resolver.sent_ns) if resolver.sent_ns else math.inf
    before = resolver.before
    if "MotorAngle" not in known:
        known["MotorAngle"] = before.get("MotorAngle", 0.0)
        if before:
            known["MotorAngle"] += 0.5 * (known["MotorSpeed"] + before["MotorSpeed"]) * elapsed_s
    if "MotorSpeed" not in known:
        known["MotorSpeed"] = (known["MotorAngle"] - before["MotorAngle"]) / elapsed_s if before else 0.0
    resolver.before = known
    return known | {"MotorSpeed": float(unrepeated(known["MotorSpeed"], resolver.counter))}


def _completed(slow: _Message) -> dict[str, float]:
    """A slow message's values, with those that others stand in for (`resample.SUBSTITUTES`)."""
    known = {name: v.last if isinstance(v, _Value) else v for name, v in slow.signals.items()}
    plates = [known[name] for name in ("InnerBackplateTemp", "OuterBackplateTemp") if name in known]
    if plates:
        mean = 0.5 * (plates[0] + plates[-1])
        known = {"InnerBackplateTemp": plates[0], "OuterBackplateTemp": plates[-1], "CaliperTemp": mean} | known
    return known


def open_mapped(options: dict, mapping: Mapping) -> MappedBus:
    """A bus by python-can's options (`cli.busoptions`), read through a mapping.

    Raises:
        InputError: no interface is named, or an unknown one, or the mapping has no DBC.
        Unavailable: it cannot be opened now.
    """
    channels = sorted({channel for channel in mapping.channels.values() if channel is not None})
    if not channels:
        return MappedBus(open_python_can(options), mapping)
    # The daemon's own channel first: what it sends goes there.
    ours = str(options.get("channel") or channels[0])
    buses = {name: open_python_can(options | {"channel": name}) for name in dict.fromkeys([ours, *channels])}
    return MappedBus(SeveralBuses(buses), mapping)
