"""Logs of other people's rigs as our frames, by a mapping file: CAN logs by the rig's own DBC, tables and measurements by
column.

A foreign log has neither our ids nor E2E protection nor our sampling rate; `logs.resample` converts it to our messages.
"""

from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.errors import InputError, InputErrors, tell
from emb_daemon.logs.contradictions import contradictions, has_dead_current, starts_anew
from emb_daemon.logs.dbc import load_foreign
from emb_daemon.logs.foreign_frames import alone, decoded
from emb_daemon.logs.mapping_file import Bus, Mapped, MappingFile, Source
from emb_daemon.logs.overflow import overflown
from emb_daemon.logs.read import ids_in, read_log
from emb_daemon.logs.resample import (
    HEADER,
    SUBSTITUTES,
    filled,
    frames_of,
    is_bare,
    is_received,
    is_unresolved,
    our_messages,
    standing,
    turns_free,
    way_of,
)
from emb_daemon.logs.series import Series
from emb_daemon.logs.stamps import no_values, strays, without_sign
from emb_daemon.logs.tables import read_table
from emb_daemon.wire.layout import CORNERS, OURS, signal_columns
from emb_daemon.wire.units import TRAVELS, UNITS, conversion, stated_in

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


class Mapping:
    """A mapping file, checked against both descriptions. Raises InputErrors: every fault of the file: unknown signals of
    either DBC, units that do not fit, signals left out."""

    def __init__(self, path: str | Path):
        self.path: Path = Path(path)
        self._file = load_yaml(self.path, MappingFile)
        buses = {None: Bus(dbc=self._file.dbc)} if self._file.dbc else self._file.buses
        #: The rig's (cantools) by bus, None the name of the only one; empty of tables and measurements.
        self.databases: dict[str | None, Database] = {
            name: load_foreign(self.path.parent / bus.dbc) for name, bus in buses.items()
        }
        #: By bus, as the log names it; None is any.
        self.channels: dict[str | None, str | None] = {
            name: None if bus.channel is None else str(bus.channel) for name, bus in buses.items()
        }
        self._ours = our_messages()
        self._faults: list[str] = []
        self.notes: list[str] = []  #: a line for each signal that the rig does not measure and that others stand in for
        #: Sources by message and signal of ours, a number where it is a constant; a signal that another stands in for is not
        #: among them.
        self.messages: dict[str, dict[str, Source | float]] = {}
        for name, mapped in self._file.signals.items():
            self._add(name, mapped)
        self._check_complete()
        if self._faults:
            raise InputErrors(self._faults)

    def _fault(self, key: str, text: str) -> None:
        self._faults.append(f"{self.path}: signals.{key}: {text}")

    def _add(self, name: str, mapped: Mapped) -> None:
        from cantools.database import Error

        message_name, _, signal_name = name.partition(".")
        if message_name not in self._ours or (message_name.startswith("EMB_") and not is_received(message_name)):
            return self._fault(name, "expected Message.Signal of what the daemon receives, such as EMB_FL_Resolver.MotorAngle")
        every = {signal.name: signal for signal in self._ours[message_name][0].signals if signal.name not in HEADER}
        if (ours := every.get(signal_name)) is None:
            return self._fault(name, f"{message_name} has no such signal to map; it has {', '.join(every)}")
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
        except Error as error:
            return self._fault(name, f"{mapped.signal}: the rig's DBC contradicts itself: {error}")
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

    def _like(self, bus: str | None, signal: str) -> str:
        """The most similar names in the rig's DBC, in words; empty if there are none."""
        known = [f"{message.name}.{theirs.name}" for message in self.databases[bus].messages for theirs in message.signals]
        # The same signal in another message comes first: a name of the same message is longer alike.
        own = signal.rpartition(".")[2]
        same = [name for name in known if name.rpartition(".")[2].lower() == own.lower()]
        like = (same or get_close_matches(signal, known, 3))[:3]
        return f"; did you mean {' or '.join(like)}?" if like else ""

    def _their_unit(self, bus: str | None, signal: str) -> str:
        """Of a signal as the rig describes it, empty if it does not. Raises KeyError: the rig's DBC has no such signal, or
        cantools' Error: it cannot be read."""
        if not self.databases:
            return ""
        message, own = self._message(bus, signal), signal.rpartition(".")[2]
        unit = message.get_signal_by_name(own).unit or ""
        alone(message, own)
        return unit

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
            # What clamps nothing has neither pads nor a disc, and is never released.
            asked = [_CURRENT] if turns_free(corner, self.messages) else _LOST
            for message in asked:
                if (name := message.format(corner)) not in self.messages:
                    blind = name == "VEH_Status" and f"EMB_{corner}_Current" not in self.messages
                    self.notes.append(f"{self.path}: {name} is not mapped: {_BLIND if blind else _LOST[message]}")

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
            raw, digest = decoded(self, path, recorded, wanted), recorded.digest
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
            lines = _without_overflow(corner, messages)
            for line in (*lines, *contradictions(corner, messages), *_too_slow(corner, messages)):
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


def _per_radius(unit: str) -> str:
    """Radians a second of a wheel of one metre of radius, of a speed of its tyre of one, as a number in words."""
    try:
        return f"{conversion(unit, 'm/s')[0]:.4g}"
    except InputError:
        return "its m/s"


def _without_overflow(corner: str, messages: dict) -> list[str]:
    """A line on the samples of a corner's current that were recorded as another, which are taken out of ``messages``."""
    angle, own = way_of(corner, messages), messages.get(f"EMB_{corner}_Current", {})
    current, force = own.get("CurrentQ"), messages.get(f"RIG_{corner}_Force", {}).get("ClampForceRef", 0.0)
    if angle is None or not isinstance(current, Series) or not np.any(full := overflown(current, angle.derivative(), force)):
        return []
    low, high = float(np.min(current.values)), float(np.max(current.values))
    own["CurrentQ"] = Series(current.time_ns[~full], current.values[~full])
    return [
        f"CurrentQ goes from {high:.4g} A to the other end of its range, {low:.4g} A, or back, where load and acceleration go "
        f"on: its number was full; {np.sum(full)} of {len(full)} values are left out. A range that it does not leave, or a "
        "smaller current, would tell more"
    ]


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
_CURRENT = "EMB_{}_Current"
_LOST = {
    _CURRENT: "the force rests on the motor angle alone",
    "EMB_{}_Thermocouple": "the pads' temperature is unknown, and sigma holds what it may do",
    "VEH_WheelSpeed": "the disc may be turning and heating, and sigma grows; of one that stands say so by `value: 0`",
    "VEH_Status": "that the brake was released has to be shown by motor and current; " + _BENCH,
}
#: The same where there is no current either.
_BLIND = "without a current nothing shows either where the brake is released, and the force stays unknown; " + _BENCH
