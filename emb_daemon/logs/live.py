"""Another rig's live bus as ours: its frames are converted to our messages as they arrive, by the same mapping file as its
logs.

The motor angle's frames are the clock, as in logs. Faster ones than ours are thinned out to our cycle, the current in between
averaged; slower ones stay as they are, because interpolation would have to wait for the next sample.
"""

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from emb_daemon.errors import InputError, InputErrors
from emb_daemon.logs import j1939
from emb_daemon.logs.columns import absent_raw
from emb_daemon.logs.foreign_frames import alone
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.mapping_file import Source
from emb_daemon.logs.resample import HEADER, cycle_ns, fill_missing, our_messages, unrepeated
from emb_daemon.logs.series import CARRIED_CYCLES, longest_step_ns
from emb_daemon.runtime.bus import PythonCan, PythonCanBus, open_python_can
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME, row_of
from emb_daemon.wire.layout import CORNERS, pack, signal_columns

if TYPE_CHECKING:
    from can import Message

#: A sample is due after this share of our cycle since the last one; a bus may delay single frames by the rest.
_DUE = 0.9
#: Period of polling several buses, s: a fraction of our cycle.
_POLL_S = 0.0005


@dataclass
class _Value:
    """The last value of one of the rig's signals, in our unit, and the sum of those since the last sample."""

    source: Source
    heard_ns: int = 0
    last: float = math.nan
    total: float = 0.0
    count: int = 0
    _turned: float = 0.0

    def take(self, raw: float, time_ns: int) -> None:
        period = self.source.period
        if period is not None:
            raw = self._turned + math.remainder(raw - self._turned, period)
        if self.source.goes_on:
            self._turned = raw
        self.last, self.heard_ns = self.source.scale * raw + self.source.offset, time_ns
        self.total += self.last
        self.count += 1

    def mean(self) -> float:
        """Mean of the values since the last call; the last value if there were none."""
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
    period_ns: float = math.inf
    counter: int = -1
    before: dict[str, float] = field(default_factory=dict)

    def fresh(self, now_ns: int) -> bool:
        """Whether every signal that the rig sends has been heard, not too long ago."""
        most = CARRIED_CYCLES * max(self.cycle_ns, CYCLE_NS)
        values = [value for value in self.signals.values() if isinstance(value, _Value)]
        return all(value.heard_ns and now_ns - value.heard_ns <= most for value in values)

    def last(self) -> dict[str, float]:
        """By signal what was heard last, or is constant."""
        return {name: value.last if isinstance(value, _Value) else value for name, value in self.signals.items()}

    def frame(self, values: dict[str, float], time_ns: int) -> tuple | None:
        """A FRAME row; None if the message cannot carry a value."""
        payload = 0
        for name, value in values.items():
            layout = self.layout[name]
            if not layout["low"] <= value <= layout["high"]:
                return None
            payload |= int(pack(value, layout))
        self.sent_ns = time_ns
        return time_ns, int(protect(self.can_id, payload, self.counter % COUNTER_MODULO, 0)), self.can_id, 8, 0

    def reference(self, time_ns: int) -> tuple:
        """A FRAME row of a reference instrument's message, with what is mapped in it."""
        payload, values = 0, self.last()
        for name, layout in self.layout.items():
            value = values.get(name, math.nan)
            if layout["low"] <= value <= layout["high"]:
                payload |= int(pack(value, layout))
            else:
                payload |= absent_raw(int(layout["length"])) % (1 << int(layout["length"])) << int(layout["start"])
        return time_ns, payload, self.can_id, 8, 0


class SeveralBuses:
    """python-can buses by channel as one: frames of all, each with its channel; what is sent goes to its channel's, or to the
    first."""

    def __init__(self, buses: dict[str, PythonCan]):
        self._buses = buses

    def fileno(self) -> int:
        raise NotImplementedError

    def recv(self, timeout_s: float) -> "Message | None":
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

    def send(self, message: "Message") -> None:
        self._buses.get(str(message.channel), next(iter(self._buses.values()))).send(message)

    def shutdown(self) -> None:
        for bus in self._buses.values():
            bus.shutdown()


class _Signals:
    """The values of our messages of a mapping, as the rig's frames bring them."""

    def __init__(self, mapping: Mapping, names: Iterable[str]):
        mapping.require_frames()
        self.messages = {name: _message(name, mapping) for name in names}
        self._readers: dict[tuple[int, bool], list[tuple]] = {}
        #: The same of J1939's groups, and the first sender of each: other senders' frames of a group are ignored.
        self._groups: dict[int, list[tuple]] = {}
        self._senders: dict[int, int] = {}
        for our in self.messages.values():
            for value in our.signals.values():
                if isinstance(value, _Value):
                    source, theirs = value.source, mapping.message_of(value.source)
                    signal = theirs.get_signal_by_name(source.signal)
                    reader = (mapping.channels[source.bus], alone(theirs, source.signal), theirs, signal, value)
                    self._readers.setdefault((theirs.frame_id, theirs.is_extended_frame), []).append(reader)
                    if j1939.is_group(theirs):
                        self._groups.setdefault(j1939.group_of(theirs.frame_id), []).append(reader)

    def take(self, message, time_ns: int) -> bool:
        """Whether a frame of the rig (python-can Message) holds any of the signals; then they have its values."""
        if message.is_error_frame or message.is_remote_frame:
            return False
        can_id = message.arbitration_id
        readers = self._readers.get((can_id, message.is_extended_id), ())
        if in_group := not readers and bool(self._groups) and message.is_extended_id:
            group, sender = j1939.group_of(can_id), can_id & j1939.SENDER
            readers = self._groups.get(group, ())
            if readers and self._senders.setdefault(group, sender) != sender:
                return False
        of_channel = [reader for reader in readers if reader[0] in (None, str(message.channel))]
        for _, read, theirs, signal, value in of_channel:
            raw = read(bytes(message.data))
            if in_group or theirs.protocol == "j1939":
                raw = float(j1939.known(signal, raw))
            if math.isfinite(raw):
                value.take(raw, time_ns)
        return bool(of_channel)


def _message(name: str, mapping: Mapping) -> _Message:
    message, database = our_messages()[name]
    names = tuple(signal.name for signal in message.signals if signal.name not in HEADER)
    # Each of our signals has its own value, because two may come from one of the rig's with different scales.
    signals = {
        signal: _Value(source) if isinstance(source, Source) else source for signal, source in mapping.messages[name].items()
    }
    layout = dict(zip(names, signal_columns(database, name, names), strict=True))
    return _Message(message.frame_id, cycle_ns(message), signals, layout)


class MappedBus(PythonCanBus):
    """A python-can bus of another rig, with the calls of `runtime.bus.PythonCanBus`; what is sent goes out as it is. ``bus``
    has no filters, and is opened for CAN FD if the mapping, by the rig's DBC, has any (`open_buses`); references are not
    converted."""

    def __init__(self, bus: PythonCan, mapping: Mapping):
        super().__init__(bus, [])
        self._signals = _Signals(mapping, [name for name in mapping.messages if not name.startswith("RIG_")])
        self._messages = self._signals.messages
        self._clocks = {}
        for corner in CORNERS:
            if resolver := self._messages.get(f"EMB_{corner}_Resolver"):
                clock = next((value for value in resolver.signals.values() if isinstance(value, _Value)), None)
                if clock is None:
                    raise InputError(f"{mapping.path}: EMB_{corner}_Resolver is constant; expected a motor on a live bus")
                self._clocks[corner] = clock

    def drain(self) -> np.ndarray:
        rows = []
        for message, time_ns in self._receive():
            rows += self.heard(message, time_ns)
        return np.array(rows, FRAME)

    def heard(self, message: "Message", time_ns: int) -> list[tuple[int, ...]]:
        """FRAME rows of our messages that follow from a frame of the rig (python-can Message)."""
        if not self._signals.take(message, time_ns):
            return []
        rows = []
        for corner, clock in self._clocks.items():
            resolver = self._messages[f"EMB_{corner}_Resolver"]
            if clock.heard_ns == time_ns and time_ns - resolver.sent_ns >= _DUE * CYCLE_NS:
                rows += self._sample(corner, resolver, time_ns)
        return [row for row in rows if row is not None]

    def _sample(self, corner: str, resolver: _Message, time_ns: int) -> list[tuple | None]:
        """A sample of a corner, and the slow messages that are due."""
        rows = []
        for name, slow in self._messages.items():
            is_due = time_ns - slow.sent_ns >= _DUE * slow.cycle_ns and slow.fresh(time_ns)
            if is_due and not name.endswith(("_Resolver", "_Current", "_ForceSensor")):
                slow.counter += 1
                rows.append(slow.frame(fill_missing(name, slow.last()), time_ns))
        cycles = max(1, round((time_ns - resolver.sent_ns) / CYCLE_NS)) if resolver.sent_ns else 1
        motion = _motion(resolver, time_ns)
        resolver.counter += cycles
        for kind in ("ForceSensor", "Current"):
            fast = self._messages.get(f"EMB_{corner}_{kind}")
            if fast is not None and fast.fresh(time_ns):
                fast.counter = resolver.counter
                means = {name: v.mean() if isinstance(v, _Value) else v for name, v in fast.signals.items()}
                rows.append(fast.frame(means if kind == "Current" else fast.last(), time_ns))
        rows.append(resolver.frame(motion, time_ns))
        return rows


def _motion(resolver: _Message, time_ns: int) -> dict[str, float]:
    """Angle and speed at a sample; if the rig measures one of them, the other from its change since the sample before. A
    speed adds no way while the bus was silent (`Series.integral`)."""
    known = resolver.last()
    elapsed_ns = time_ns - resolver.sent_ns if resolver.sent_ns else math.inf
    elapsed_s = 1e-9 * elapsed_ns
    before = resolver.before
    resolver.period_ns = min(resolver.period_ns, elapsed_ns)
    if "MotorAngle" not in known:
        known["MotorAngle"] = before.get("MotorAngle", 0.0)
        if before and elapsed_ns <= longest_step_ns(resolver.period_ns):
            known["MotorAngle"] += 0.5 * (known["MotorSpeed"] + before["MotorSpeed"]) * elapsed_s
    if "MotorSpeed" not in known:
        known["MotorSpeed"] = (known["MotorAngle"] - before["MotorAngle"]) / elapsed_s if before else 0.0
    resolver.before = known
    return known | {"MotorSpeed": float(unrepeated(known["MotorSpeed"], resolver.counter))}


class ReferenceBus(PythonCanBus):
    """A bus on which frames of ``ids`` are ours and the rig's force sensors are heard beside them, as RIG_c_Force."""

    def __init__(self, bus: PythonCan, mapping: Mapping, ids: list[int]):
        super().__init__(bus, ids)
        names = [name for name in mapping.messages if name.startswith("RIG_") and name.endswith("_Force")]
        if not names:
            raise InputError(f"{mapping.path}: expected RIG_c_Force.ClampForceRef of a corner, for what else would be shown?")
        self._signals = _Signals(mapping, names)

    def drain(self) -> np.ndarray:
        rows = []
        for message, time_ns in self._receive():
            if self._concerns_us(message) and not message.is_error_frame:
                rows.append(row_of(message, time_ns))
            elif self._signals.take(message, time_ns):
                rows += [our.reference(time_ns) for our in self._signals.messages.values() if our.fresh(time_ns)]
        return np.array(rows, FRAME)


def open_buses(options: dict[str, Any], mapping: Mapping) -> PythonCan:
    """python-can's bus by its options (`cli.options.bus_options`), or as many as the mapping names channels; for CAN FD if the
    rig's messages are. Raises InputError: no interface is named, or an unknown one, or the mapping has no DBC. Raises
    Unavailable: it cannot be opened now."""
    mapping.require_frames()
    if mapping.has_fd:
        options = {"fd": True} | options
    channels = sorted({channel for channel in mapping.channels.values() if channel is not None})
    if not channels:
        return open_python_can(options)
    # The daemon's own channel first, because that is where it sends.
    ours = str(options.get("channel") or channels[0])
    return SeveralBuses({name: open_python_can(options | {"channel": name}) for name in dict.fromkeys([ours, *channels])})


def open_mapped(options: dict[str, Any], mapping: Mapping, layout: np.ndarray) -> MappedBus:
    """A bus read through a mapping, for a daemon of a LAYOUT. Raises InputErrors: messages of the rig have ids with which the
    daemon sends. Raises InputError, Unavailable: as `open_buses`."""
    if faults := mapping.taken(layout):
        raise InputErrors(faults)
    return MappedBus(open_buses(options, mapping), mapping)
