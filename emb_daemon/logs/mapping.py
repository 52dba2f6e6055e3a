"""Logs of other people's rigs as our frames, by a mapping file: CAN logs by the rig's own DBC, tables and measurements by
column.

A foreign log has neither our ids nor E2E protection nor our sampling rate; `logs.resample` converts it to our messages.
"""

import math
import re
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta, field

from emb_daemon.calibration.fields import NonNegative, Positive, Struct
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.errors import InputError, InputErrors, tell
from emb_daemon.logs import j1939
from emb_daemon.logs.contradictions import contradictions, has_dead_current, starts_anew
from emb_daemon.logs.dbc import load_foreign
from emb_daemon.logs.read import Recorded, ids_in, read_log
from emb_daemon.logs.resample import (
    HEADER,
    SUBSTITUTES,
    Series,
    filled,
    frames_of,
    is_bare,
    is_received,
    is_unresolved,
    our_messages,
    standing,
    way_of,
)
from emb_daemon.logs.stamps import held_rows, in_time, no_values, strays, without_sign
from emb_daemon.logs.tables import read_table
from emb_daemon.wire.frames import ERROR, EXTENDED, REMOTE
from emb_daemon.wire.layout import CORNERS, OURS, signal_columns
from emb_daemon.wire.units import TRAVELS, UNITS, conversion, known_as, stated_in

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

#: Signals that the estimator does not use; they may stay unmapped and are sent as zero.
_UNUSED = ("CurrentD", "DcBusVoltage")
_PLATES = ("InnerBackplateTemp", "OuterBackplateTemp")
#: Sampling periods of a motor angle that a log can have: a test bench's own, and one that would miss whole stops.
_SHORTEST_S, _LONGEST_S = 1e-5, 1.0
#: How far rounding of a number as large as an epoch's takes it from a whole second.
_WHOLE_S = 1e-5
#: Shortest period that another unit of time is suggested for, s; a day is what spreadsheets count in.
_USUAL_S, _OF_TIME = 5e-4, ("s", "ms", "us", "ns", "d")
#: Share of the payloads that may be missing in a gateway's copy, or at the beginning of a log.
_LOST_COPIES = 0.1
#: What DBCs call a raw value that is none, once words are apart; and a flag that says that all is well.
_APART = re.compile(r"[\W_]+|(?<=[a-z])(?=[A-Z])")
_NO_VALUE = re.compile(
    r"(?i)\b(sna|n a|unavailable|(not|nicht) (available|valid|defined|used|verf.*)|invalid|undefined|unknown|reser\w*|init\w*|"
    r"error\w*|fault\w*|fail\w*|(\w* )?fehler\w*|ung.ltig|no (data|signal|value))\b"
)
_FREE_OF = re.compile(r"(?i)(no|not|kein|ohne) (error|fault|fail|fehler)")


class Mapped(Struct, kw_only=True):
    """Where one of our signals comes from: a signal of the rig, or a constant."""

    #: Message.Signal of the rig's DBC; without a DBC, the name of a column or channel.
    signal: str | None = None
    #: Which of `buses` carries it, if there are any.
    bus: str | None = None
    #: Its unit, where the rig's DBC states none or a wrong one; always for columns and channels.
    unit: str | None = None
    #: ours = scale * (theirs, in our unit) + offset; -1 turns a direction round.
    scale: float = 1.0
    #: In our unit.
    offset: float = 0.0
    #: What the value jumps by where it starts anew, in the rig's unit: 360 of an angle in degrees within one turn, 65536 of a
    #: number of 16 bits that was written without its sign. Between two samples an angle must move by less than half of it.
    period: Positive | None = None
    #: Time over which the value is a mean that ends with its stamp, ms, and twice the delay of a filter; 0 is a value of the
    #: moment. Left out it is 0, and a sampling period for CurrentQ: a mean since the last frame, as on our bus.
    mean_ms: NonNegative | None = None
    #: A constant in our unit, for what the rig does not measure.
    value: float | None = None

    def __post_init__(self) -> None:
        if (self.signal is None) == (self.value is None):
            raise ValueError("expected either signal (of the rig) or value (a constant)")
        alone = (self.unit, self.bus, self.period, self.mean_ms) == (None, None, None, None) and (self.scale, self.offset) == (
            1.0,
            0.0,
        )
        if self.value is not None and not alone:
            raise ValueError("value: stands alone, in our unit")
        if self.scale == 0.0:
            raise ValueError("scale: 0 leaves nothing of the signal")


class Time(Struct, kw_only=True):
    """The column of times of a table, or how often a row was written."""

    #: Name of the column.
    signal: str | None = None
    #: s, ms, us, ns, min, h or d: a spreadsheet counts days.
    unit: str = "s"
    #: Of a table without such a column: rows per second. Of one that counts instead of telling a time: counts per second.
    rate_Hz: Positive | None = None
    #: Of a table that has one value in a row: the column that names what was measured; `signals` then has such names.
    name: str | None = None
    #: Of such a table: the column of values.
    value: str | None = None

    def __post_init__(self) -> None:
        if (self.name is None) != (self.value is None) or (self.name is not None and self.signal is None):
            raise ValueError("expected name, value and signal together: the columns of a table with one value in a row")
        if self.signal is None and self.rate_Hz is None:
            raise ValueError("expected signal (a column), rate_Hz (rows per second), or both (a column's counts per second)")
        if self.rate_Hz is not None and self.unit != "s":
            raise ValueError("unit: counts have none; expected unit or rate_Hz")
        if UNITS.get(self.unit, ("",))[0] != "s":
            raise ValueError(f"unit: expected s, ms, us, ns, min, h or d, found {self.unit!r}")


class Bus(Struct, kw_only=True):
    """One of several CAN buses."""

    #: Its DBC, ARXML or KCD, relative to this file.
    dbc: str
    #: Its channel as the log names it: can1 of candump, 1 of Vector's CAN 1; live, the one to open. Left out, it may be any.
    channel: str | int | None = None


class MappingFile(Struct, kw_only=True):
    """mapping.yaml."""

    #: Version of this file format.
    format: Annotated[int, Meta(ge=1, le=1)]
    #: The rig's DBC, ARXML or KCD, relative to this file; left out for tables and measurements.
    dbc: str | None = None
    #: Instead of `dbc`, of a rig with several buses: by a name of yours.
    buses: dict[str, Bus] = field(default_factory=dict)
    #: Of a table or of arrays; channels of an MDF measurement have times of their own.
    time: Time | None = None
    #: Our Message.Signal (dbc/emb.dbc, and dbc/rig.dbc for references): where it comes from.
    signals: dict[str, Mapped]

    def __post_init__(self) -> None:
        if self.dbc is not None and self.buses:
            raise ValueError("buses: each has a dbc of its own; expected dbc or buses")
        if (self.dbc is not None or self.buses) and self.time is not None:
            raise ValueError("time: the frames of a CAN log have theirs; expected one of dbc, buses and time")


class Source:
    """One foreign signal of a bus (None: the only one), its ``name`` in a DBC ``message`` and ``signal``, and how it becomes
    ours: ``scale`` and ``offset`` from the rig's ``unit`` to our ``target``, ``span_ns`` None is a sampling period.

    Raises:
        InputError: the unit cannot become ours.
    """

    def __init__(self, mapped: Mapped, unit: str, target: str, span_ns: float | None):
        self.name: str = mapped.signal
        self.unit = unit
        self.target = target
        self.bus: str | None = mapped.bus
        self.period: float | None = mapped.period
        message, _, signal = mapped.signal.rpartition(".")
        self.message: str = message
        self.signal: str = signal
        factor, shift = conversion(unit, target)
        self.scale: float = mapped.scale * factor
        self.offset: float = mapped.scale * shift + mapped.offset
        self._shifted = mapped.offset != 0.0
        self.span_ns = span_ns

    def questioned(self, stated: str) -> str:
        """A question if the unit that the rig states makes other values of the signal; a scale of that same unit is meant."""
        own = known_as(stated)
        if own and (UNITS[own][0], self.target) == ("Nm", "N") and UNITS[own][1] != 1.0:
            return f"{self.name} says {own}, and an N·m is {1.0 / UNITS[own][1]:.4g} of it: is that in `scale`?"
        if not own or UNITS[own][0] != UNITS[self.target][0]:
            return ""
        factor, zero = conversion(own, self.target)
        as_stated = conversion(self.unit, self.target) == (factor, zero)
        as_scaled = math.isclose(abs(self.scale), factor, rel_tol=1e-3) and (self._shifted or self.offset == zero)
        return "" if as_stated or as_scaled else f"{self.name} says {own} and is taken in {self.unit}: which is right?"

    @property
    def goes_on(self) -> bool:
        """Whether it goes on beyond its ``period``, as an angle does; a number without its sign does not."""
        return self.target == "rad"

    def converted(self, time_ns: np.ndarray, values: np.ndarray) -> Series:
        series = Series.of(time_ns, values)
        if (sampled := held_rows(series.values)) is not None:
            series = Series(series.time_ns[sampled], series.values[sampled])
        values = series.values
        if self.period is not None and len(values):
            whole = np.rint((values[:1] if self.goes_on else values) / self.period) * self.period
            values = (np.unwrap(values, period=self.period) if self.goes_on else values) - whole
        return Series(series.time_ns, self.scale * values + self.offset).averaged(self.span_ns)


class Mapping:
    """A mapping file, checked against both descriptions.

    Attributes:
        databases: the rig's (cantools) by bus, None the name of the only one; empty of tables and measurements.
        channels: by bus, as the log names it; None is any.
        messages: sources by message and signal of ours, a number where it is a constant; a signal that another stands in for
            is not among them.
        notes: a line for each signal that the rig does not measure and that others stand in for.

    Raises:
        InputErrors: every fault of the file: unknown signals of either DBC, units that do not fit, signals left out.
    """

    def __init__(self, path: str | Path):
        self.path: Path = Path(path)
        self._file = load_yaml(self.path, MappingFile)
        buses = {None: Bus(dbc=self._file.dbc)} if self._file.dbc else self._file.buses
        self.databases: dict[str | None, Database] = {
            name: load_foreign(self.path.parent / bus.dbc) for name, bus in buses.items()
        }
        self.channels: dict[str | None, str | None] = {
            name: None if bus.channel is None else str(bus.channel) for name, bus in buses.items()
        }
        self._ours = our_messages()
        self._faults: list[str] = []
        self.notes: list[str] = []
        self.messages: dict[str, dict[str, Source | float]] = {}
        for name, mapped in self._file.signals.items():
            self._add(name, mapped)
        self._check_complete()
        if self._faults:
            raise InputErrors(self._faults)

    def _fault(self, key: str, text: str) -> None:
        self._faults.append(f"{self.path}: signals.{key}: {text}")

    def _add(self, name: str, mapped: Mapped) -> None:
        message_name, _, signal_name = name.partition(".")
        if message_name not in self._ours or (message_name.startswith("EMB_") and not is_received(message_name)):
            return self._fault(name, "expected Message.Signal of what the daemon receives, such as EMB_FL_Resolver.MotorAngle")
        ours = {signal.name: signal for signal in self._ours[message_name][0].signals}.get(signal_name)
        if ours is None or signal_name in HEADER:
            return self._fault(name, f"{message_name} has no such signal to map; it has {self._signals_of(message_name)}")
        signals = self.messages.setdefault(message_name, {})
        if mapped.value is not None:
            signals[signal_name] = mapped.value
            [layout] = signal_columns(self._ours[message_name][1], message_name, (signal_name,))
            if not layout["low"] <= mapped.value <= layout["high"]:
                # No frame could carry it, and the message would never be sent.
                self._fault(
                    name, f"value: {mapped.value:g}; expected {layout['low']:g} to {layout['high']:g} {ours.unit or ''}"
                )
            return None
        if mapped.bus not in (self.databases or {None: None}):
            known = ", ".join(self._file.buses)
            return self._fault(name, f"bus: expected one of {known}" if known else "bus: there are no `buses` in this file")
        try:
            stated = self._their_unit(mapped.bus, mapped.signal)
        except KeyError:
            text = f"{mapped.signal}: the rig's DBC has no such message and signal"
            return self._fault(name, text + self._like(mapped.bus, mapped.signal))
        if self.databases and (fault := self._misfit(mapped.bus, mapped.signal)):
            return self._fault(name, f"{mapped.signal}: the rig's DBC contradicts itself: {fault}")
        unit = (stated if mapped.unit is None else mapped.unit).strip()
        if (unit in TRAVELS or UNITS.get(unit, ("",))[0] == "m/s") and ours.unit in ("rad", "rad/s"):
            if message_name == "VEH_WheelSpeed":
                what = "the speed of a tyre", "the wheel", "turning", f"{_per_radius(unit)} over the tyre's radius in m"
            else:
                what = "a travel", "the motor", "angle", "6.283 over the travel in a turn (a screw's lead)"
            return self._fault(
                name,
                f"{mapped.signal} is {what[0]} in {unit}, not {what[1]}'s {what[2]}; state `unit: {ours.unit}`, and as "
                f"`scale` the radians that {what[1]} turns for one of them: {what[3]}",
            )
        span_ms = 0.0 if mapped.mean_ms is None and signal_name != "CurrentQ" else mapped.mean_ms
        span_ns = None if span_ms is None else 1e6 * span_ms
        try:
            source = Source(mapped, unit, ours.unit or "", span_ns)
        except InputError as error:
            hint = "; state `unit:`" if not unit else "" if ours.unit else '; of a number without one state `unit: "1"`'
            return self._fault(name, f"{mapped.signal} {error}{hint}")
        if not self.databases and (question := source.questioned(stated_in(mapped.signal))):
            self.notes.append(f"{self.path}: {name}: {question}")
        signals[signal_name] = source
        return None

    def _signals_of(self, message: str) -> str:
        return ", ".join(signal.name for signal in self._ours[message][0].signals if signal.name not in HEADER)

    def _like(self, bus: str | None, signal: str) -> str:
        """The most similar names in the rig's DBC, in words; empty if there are none."""
        known = [f"{message.name}.{theirs.name}" for message in self.databases[bus].messages for theirs in message.signals]
        # The same signal in another message comes first: a name of the same message is longer alike.
        own = signal.rpartition(".")[2]
        same = [name for name in known if name.rpartition(".")[2].lower() == own.lower()]
        like = (same or get_close_matches(signal, known, 3))[:3]
        return f"; did you mean {' or '.join(like)}?" if like else ""

    def _their_unit(self, bus: str | None, signal: str) -> str:
        """Of a signal as the rig describes it, empty if it does not. Raises KeyError: the rig's DBC has no such signal."""
        if not self.databases:
            return ""
        return self._message(bus, signal).get_signal_by_name(signal.rpartition(".")[2]).unit or ""

    def _misfit(self, bus: str | None, signal: str) -> str:
        """Why a signal of the rig's cannot be read, empty if it can."""
        from cantools.database import Error

        try:
            alone(self._message(bus, signal), signal.rpartition(".")[2])
        except Error as error:
            return str(error)
        return ""

    def _message(self, bus: str | None, signal: str):
        return self.databases[bus].get_message_by_name(signal.rpartition(".")[0])

    def _check_complete(self) -> None:
        """Find missing signals: a message is sent whole, and a signal without source or substitute would be sent as a valid
        zero."""
        corners = [corner for corner in CORNERS if f"EMB_{corner}_Resolver" in self.messages]
        if not corners and not self._faults:
            self._faults.append(
                f"{self.path}: signals: expected EMB_c_Resolver.MotorAngle, MotorSpeed or both of at least one corner; of a "
                "bench without a motor, or whose motor stands, say so by `EMB_FL_Resolver.MotorAngle: {value: 0}`"
            )
        # What a message with a fault lacks is not known yet.
        whole = [name for name in self.messages if not any(f"signals.{name}." in fault for fault in self._faults)]
        for name in whole:
            signals = self.messages[name]
            substitutes = SUBSTITUTES.get(name.rpartition("_")[2], {})
            for signal in self._ours[name][0].signals:
                optional = signal.name in (*_UNUSED, *HEADER) or name.startswith("RIG_")
                other = name in ("VEH_WheelSpeed", "VEH_WheelPulse") and signal.name[-2:] not in corners
                if signal.name in signals or optional or other:
                    continue
                if name.endswith("_Resolver") and not self._sources(name):
                    continue
                if signal.name in substitutes:
                    self.notes.append(f"{self.path}: {name}.{signal.name} is not measured: {substitutes[signal.name]}")
                else:
                    self._fault(f"{name}.{signal.name}", "missing: map it too, or give it a constant `value`")
            if name.endswith("_Thermocouple") and not any(plate in signals for plate in _PLATES):
                self._fault(name, f"expected {' or '.join(_PLATES)}")
            if name.endswith("_Resolver") and not self._sources(name):
                if "MotorAngle" not in signals:
                    self._fault(f"{name}.MotorAngle", "missing: of a motor that stands give it a constant `value`, too")
                elif not self._faults and not any(map(self._sources, self.messages)):
                    self._fault(name, "only constants: expected at least one signal of the rig")
                else:
                    self.notes.append(f"{self.path}: {name} is constant: the motor stands throughout")
        for corner in corners:
            for message, text in _LOST.items():
                if (name := message.format(corner)) not in self.messages:
                    blind = name == "VEH_Status" and f"EMB_{corner}_Current" not in self.messages
                    self.notes.append(f"{self.path}: {name} is not mapped: {_BLIND if blind else text}")

    def require_frames(self) -> None:
        """Raises InputError of a mapping of tables, which has no frames."""
        if not self.databases:
            raise InputError(f"{self.path}: maps columns; expected one with `dbc` for a live bus")

    @property
    def has_fd(self) -> bool:
        """Whether any of the rig's mapped messages is CAN FD."""
        return any(self.message_of(source).is_fd for name in self.messages for source in self._sources(name).values())

    def message_of(self, source: Source) -> "Message":
        """The rig's message (cantools) that has a signal."""
        return self._message(source.bus, source.name)

    def taken(self, layout: np.ndarray) -> list[str]:
        """A fault for each message of the rig's DBC with an id that the daemon of a LAYOUT sends with."""
        ours = set(np.flatnonzero(layout["slot"][0] == OURS).tolist())
        return [
            f"{self.path}: {message.name} of the rig has id {message.frame_id:#x}, with which the daemon sends; expected "
            "other ids of ours (`dbc` of the configuration)"
            for database in self.databases.values()
            for message in database.messages
            if message.frame_id in ours and not message.is_extended_frame
        ]

    def _sources(self, message: str) -> dict[str, Source]:
        return {key: source for key, source in self.messages.get(message, {}).items() if isinstance(source, Source)}

    def read(self, path: str | Path) -> np.ndarray:
        """A foreign log as FRAME array of our messages, in time order; instead of `logs.read.read_frames`. Raises InputError:
        unreadable, or nothing of the mapped signals in it."""
        return self.read_with_digest(path)[0]

    def read_with_digest(self, path: str | Path) -> tuple[np.ndarray, str]:
        """`read`, and the SHA-256 of the file as it was read."""
        path = Path(path)
        wanted = {(source.bus, source.name) for name in self.messages for source in self._sources(name).values()}
        if not self.databases:
            table, units, digest = read_table(path, sorted(name for _, name in wanted), self._file.time)
            raw = {(None, name): series for name, series in table.items()}
            self._question(path, units)
        else:
            recorded = read_log(path)
            raw, digest = self._decode(path, recorded, wanted), recorded.digest
        for (_, name), (stamps, values) in raw.items():
            if len(values) and np.any(none := no_values(values)):
                these = ", ".join(f"{value:g}" for value in np.unique(values[none]))
                tell(f"{path}: {name}: {np.sum(none)} values are {these}, which stand for none: left out")
                raw[_, name] = stamps[~none], values[~none]
        self._question_signs(path, raw)
        messages = {
            name: {
                key: source.converted(*raw[source.bus, source.name]) if isinstance(source, Source) else source
                for key, source in signals.items()
            }
            for name, signals in self.messages.items()
        }
        for name, signals in messages.items():
            angle = signals.get("MotorAngle")
            if isinstance(angle, Series) and not angle.is_sparse and np.any(stray := strays(angle.values)):
                tell(f"{path}: {name}: {np.sum(stray)} values of MotorAngle are far from both beside them: left out")
                signals["MotorAngle"] = Series(angle.time_ns[~stray], angle.values[~stray])
        # Of times that cannot be, everything else that would be said is a consequence.
        self._check_rate(path, messages)
        for corner in CORNERS:
            if has_dead_current(corner, messages):
                del messages[f"EMB_{corner}_Current"]
                tell(
                    f"{path}: {corner}: CurrentQ is 0 throughout, while the motor turns: it is taken as not measured, and the "
                    "force rests on the motor angle alone"
                )
            for line in (*contradictions(corner, messages), *_too_slow(corner, messages)):
                tell(f"{path}: {corner}: {line}")
        for name in messages:
            if name.endswith("_Resolver") and not self._sources(name):
                messages[name] = standing(messages, messages[name]["MotorAngle"])
        frames = frames_of(filled(messages))
        if not len(frames):
            found = f"; found {ids_in(recorded.frames)}" if self.databases else ""
            raise InputError(f"{path}: no value of {self._clocks()} in it, which {self.path} names{found}")
        # Recorders may have times before zero, before their trigger; our logs may not.
        frames["time_ns"] -= min(frames["time_ns"][0], 0)
        return frames, digest

    def _question_signs(self, path: Path, raw: dict[tuple, tuple]) -> None:
        """Say which signals have lost their sign, unless the mapping knows."""
        for bus, name in {(s.bus, s.name): None for m in self.messages for s in self._sources(m).values() if s.period is None}:
            if whole := without_sign(raw[bus, name][1]):
                tell(
                    f"{path}: {name} jumps between 0 and {whole:.10g}, the end of its bits: a number with a sign that is read "
                    f"without one, or an angle that starts anew? Then `period: {whole:.10g}`"
                )

    def _question(self, path: Path, units: dict[str, str]) -> None:
        """Say which units a file states that the mapping contradicts, of columns whose names state none."""
        for name in self.messages:
            for key, source in self._sources(name).items():
                stated = "" if stated_in(source.name) else units.get(source.name, "")
                if question := source.questioned(stated):
                    tell(f"{path}: {name}.{key}: {question}")

    def _check_rate(self, path: Path, messages: dict) -> None:
        for corner in CORNERS:
            for name, source in self._sources(f"EMB_{corner}_Resolver").items():
                series = messages[f"EMB_{corner}_Resolver"][name]
                if len(series.time_ns) > 2 and not _SHORTEST_S <= 1e-9 * series.period_ns <= _LONGEST_S:
                    seconds = 1e-9 * series.period_ns
                    counts = seconds / UNITS[self._file.time.unit if self._file.time else "s"][1]
                    likely = (
                        f" With `unit: {u}` it is {counts * UNITS[u][1]:.3g} s"
                        for u in _OF_TIME
                        if _USUAL_S <= counts * UNITS[u][1] <= _LONGEST_S
                    )
                    raise InputError(
                        f"{path}: {source.name}: one value every {seconds:.3g} s; expected {_SHORTEST_S:g} to "
                        f"{_LONGEST_S:g} s; is the unit of time right?{next(likely, '')}"
                    )

    def _clocks(self) -> str:
        clocks = [next(iter(self._sources(f"EMB_{corner}_Resolver").values()), None) for corner in CORNERS]
        # Of a motor that stands all that was measured tells the time.
        clocks = [*filter(None, clocks)] or [source for name in self.messages for source in self._sources(name).values()]
        names = {}
        for source in clocks:
            place, channel = [], self.channels.get(source.bus)
            if self.databases:
                place.append(f"{self.message_of(source).frame_id:#x}")
            if channel is not None:
                place.append(f"channel {channel}")
            names[f"{source.name} ({', '.join(place)})" if place else source.name] = None
        return ", ".join(names)

    def _decode(self, path: Path, recorded: Recorded, wanted: Iterable[tuple[str | None, str]]) -> dict[tuple, tuple]:
        """Times and values of the rig's signals by bus and name, without those in frames that are too short."""
        found = {}
        by_message: dict[tuple[str | None, str], list[str]] = {}
        for bus, signal in sorted(wanted, key=str):
            by_message.setdefault((bus, signal.rpartition(".")[0]), []).append(signal)
        for (bus, name), signals in by_message.items():
            message = self.databases[bus].get_message_by_name(name)
            rows = self._rows(path, recorded, message, self.channels[bus])
            in_group = j1939.is_group(message) and not np.any(recorded.frames["can_id"][rows] == message.frame_id)
            payloads = recorded.payloads(rows)
            readers = {signal: alone(message, signal.rpartition(".")[2]) for signal in signals}
            columns = {signal: np.array([read(payload) for payload in payloads]) for signal, read in readers.items()}
            if in_group or message.protocol == "j1939":
                parameters = {signal: message.get_signal_by_name(signal.rpartition(".")[2]) for signal in columns}
                columns = {signal: j1939.known(parameters[signal], values) for signal, values in columns.items()}
            # Each multiplexed part counts as a message of its own.
            for part in [[signal] for signal in columns] if message.is_multiplexed() else [list(columns)]:
                heard = np.any([np.isfinite(columns[signal]) for signal in part], axis=0)
                values = [columns[signal][heard] for signal in part]
                stamps, kept = in_time(f"{path}: {', '.join(part)}", recorded.frames["time_ns"][rows[heard]], values)
                found |= {(bus, signal): (stamps, column[kept]) for signal, column in zip(part, values, strict=True)}
        return found

    def _rows(self, path: Path, recorded: Recorded, message, channel: str | None) -> np.ndarray:
        """Of a message's frames. Raises InputError: the log has nothing of the channel, or the message comes from two channels
        or senders and the mapping names none."""
        frames = recorded.frames
        flags = frames["flags"] & (EXTENDED | REMOTE | ERROR)
        of_kind = flags == EXTENDED * message.is_extended_frame
        mine = of_kind & (frames["can_id"] == message.frame_id)
        if not mine.any() and j1939.is_group(message):
            mine = of_kind & (j1939.group_of(frames["can_id"]) == j1939.group_of(message.frame_id))
            if len(senders := np.unique(frames["can_id"][mine])) > 1:
                raise InputError(
                    f"{path}: {message.name} comes from several senders, as {', '.join(map(hex, senders.tolist()))}; give "
                    "it the right one's id in the DBC"
                )
        channels = recorded.channels
        if channel is not None:
            if channel not in (known := np.unique(channels).tolist()):
                raise InputError(f"{path}: nothing of channel {channel}, which {self.path} names; found {', '.join(known)}")
            mine &= channels == channel
        elif len(known := np.unique(channels[mine]).tolist()) > 1 and not _is_copied(recorded, mine, channels):
            raise InputError(
                f"{path}: {message.name} ({message.frame_id:#x}) comes from channels {', '.join(known)}, and not the same; "
                f"name the right one in {self.path} (`buses:`, `channel`)"
            )
        return np.flatnonzero(mine)


def _per_radius(unit: str) -> str:
    """Radians a second of a wheel of one metre of radius, of a speed of its tyre of one, as a number in words."""
    try:
        return f"{conversion(unit, 'm/s')[0]:.4g}"
    except InputError:
        return "its m/s"


def alone(message: "Message", name: str) -> Callable[[bytes], float]:
    """Function that reads one signal of a message (cantools) from a payload, even if others overlap with it in the DBC; NaN if
    the payload is too short or belongs to other multiplexed signals, or if the DBC calls the value one that is not available.

    Raises:
        cantools.database.Error: the message has no room for it.
    """
    from cantools.database import DecodeError
    from cantools.database.can import Message

    signal = message.get_signal_by_name(name)
    if not message.is_multiplexed():
        message = Message(
            message.frame_id, message.name, message.length, [signal], is_extended_frame=message.is_extended_frame
        )
    nothing = {
        float(signal.raw_to_scaled(raw, decode_choices=False))
        for raw, choice in (signal.choices or {}).items()
        if _NO_VALUE.search(text := _APART.sub(" ", str(choice))) and not _FREE_OF.match(text)
    }

    def read(payload: bytes) -> float:
        try:
            value = float(message.decode(payload, decode_choices=False, allow_truncated=True).get(name, np.nan))
        except DecodeError:
            return np.nan
        return np.nan if value in nothing else value

    return read


def _is_copied(recorded: Recorded, mine: np.ndarray, channels: np.ndarray) -> bool:
    """Whether two channels carry the same frames of a message: a gateway's copy, or two loggers of one bus."""
    rows = np.flatnonzero(mine)
    payloads = np.array([payload.hex() for payload in recorded.payloads(rows)])
    by_channel = [set(payloads[channels[rows] == channel].tolist()) for channel in np.unique(channels[rows])]
    fewest = min(by_channel, key=len)
    return all(len(fewest - other) <= _LOST_COPIES * len(fewest) for other in by_channel)


def _too_slow(corner: str, messages: dict) -> list[str]:
    """A line on a motor that moves too fast for its samples."""
    angle = way_of(corner, messages)
    if angle is None or len(angle.time_ns) < 3 or starts_anew(angle) or not is_unresolved(corner, messages):
        return []
    unknown = "what lies between two samples is unknown"
    why = (
        f"{unknown}, and is not filled in"
        if is_bare(corner, messages)
        else f"a clamp takes 200 ms, and {unknown}; the torque path says nothing, and identify needs 10 ms (100 Hz) or a "
        "slower motion"
    )
    line = f"one sample of the motor every {1e-6 * angle.period_ns:.3g} ms, too rare for this motion: {why}"
    seconds = 1e-9 * (angle.time_ns - angle.time_ns[0])
    if np.all(np.abs(seconds - np.rint(seconds)) < _WHOLE_S):
        line += "; its times are whole seconds: another unit of time, or a counter's? Then `rate_Hz`, its counts a second"
    return [line]


_BENCH = "of a bench say so by `value: 0` of ParkBrake, BrakeRequest and VehicleSpeed, beside AmbientTemp"
#: What a corner loses with a message that is not mapped.
_LOST = {
    "EMB_{}_Current": "the force rests on the motor angle alone",
    "EMB_{}_Thermocouple": "the pads' temperature is unknown, and sigma holds what it may do",
    "VEH_WheelSpeed": "the disc may be turning and heating, and sigma grows; of one that stands say so by `value: 0`",
    "VEH_Status": "that the brake was released has to be shown by motor and current; " + _BENCH,
}
#: The same where there is no current either.
_BLIND = "without a current nothing shows either where the brake is released, and the force stays unknown; " + _BENCH
