"""Signal layouts taken from the DBC, as arrays that compiled code can read.

Only the DBC states ids, bit positions, scales and ranges. The code adds the meaning: which slot a message fills and which
signal is in which column.
"""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emb_daemon.ahead import library
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.jit import Integer, Record, njit
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.units import conversion

if TYPE_CHECKING:
    from cantools.database.can import Database

CORNERS = ("FL", "FR", "RL", "RR")

RESOLVER, CURRENT, THERMOCOUPLE, FORCE_SENSOR = 0, 1, 2, 3
CORNER_MESSAGES = 4
WHEEL_SPEED, WHEEL_PULSE, VEHICLE_STATUS = 16, 17, 18
SLOTS = 19
SIGNALS = 4

FOREIGN = -1
OURS = -2

MOTOR_ANGLE, MOTOR_SPEED = 0, 1
CURRENT_Q = 0
INNER_BACKPLATE, OUTER_BACKPLATE, CALIPER = 0, 1, 2
SENSOR_FORCE = 0
PARK_BRAKE, BRAKE_REQUEST, AMBIENT, VEHICLE_SPEED = 0, 1, 2, 3

_RECEIVED = {
    "EMB_{}_Resolver": (RESOLVER, ("MotorAngle", "MotorSpeed")),
    "EMB_{}_Current": (CURRENT, ("CurrentQ", "CurrentD", "DcBusVoltage")),
    "EMB_{}_Thermocouple": (THERMOCOUPLE, ("InnerBackplateTemp", "OuterBackplateTemp", "CaliperTemp")),
    "EMB_{}_ForceSensor": (FORCE_SENSOR, ("SensorForce",)),
}
#: Messages that a DBC may lack, by the last word of their names.
OPTIONAL = ("ForceSensor",)
_VEHICLE = {
    "VEH_WheelSpeed": (WHEEL_SPEED, tuple(f"WheelSpeed{c}" for c in CORNERS)),
    "VEH_WheelPulse": (WHEEL_PULSE, tuple(f"WheelPulse{c}" for c in CORNERS)),
    "VEH_Status": (VEHICLE_STATUS, ("ParkBrake", "BrakeRequest", "AmbientTemp", "VehicleSpeed")),
}
CLAMP_FORCE, PAD_TEMP, ESTIMATOR_STATUS, ADAPT_REQUEST = 0, 1, 2, 3
_SENT = (
    ("EMB_{}_ClampForce", ("ClampForce", "ClampForceSigma", "InputCounter", "ForceSource", "InputAge")),
    ("EMB_{}_PadTemp", ("InnerSurfaceTemp", "InnerMeanTemp", "OuterSurfaceTemp", "OuterMeanTemp")),
    ("EMB_{}_EstimatorStatus", ("Mode", "StiffnessFactor", "ContactAngle", "DegradedReasons")),
    ("EMB_{}_AdaptRequest", ("Request", "Progress", "Result", "LowForce", "HighForce", "DitherAmplitude", "DitherFrequency")),
)
SENT_SIGNALS = 7

#: Where AUTOSAR E2E profile 1A has its fields: first bit and length.
_HEADER = {"CRC": (0, 8), "Counter": (8, 4), "Status": (12, 4)}
#: Messages by whose Counter the estimator counts cycles.
_EVERY_CYCLE = ("_Resolver", "_Current", "_ForceSensor", "_ClampForce")

SIGNAL = np.dtype(
    [("start", "i8"), ("length", "i8"), ("signed", "i8"), ("factor", "f8"), ("offset", "f8"), ("low", "f8"), ("high", "f8")],
    align=True,
)

#: Everything compiled code needs to know of the wire. ``slot`` maps an 11-bit id to its slot, FOREIGN or OURS;
#: ``cycle_ns`` is the nominal period of a slot; ``received[slot, column]`` and ``sent[kind, column]`` are signals, of
#: which the first ``received_count`` and ``sent_count`` count; ``sent_id[kind, corner]`` are CAN ids.
LAYOUT = np.dtype(
    [
        ("slot", "i2", (2048,)),
        ("cycle_ns", "i8", (SLOTS,)),
        ("received", SIGNAL, (SLOTS, SIGNALS)),
        ("received_count", "i8", (SLOTS,)),
        ("sent", SIGNAL, (4, SENT_SIGNALS)),
        ("sent_count", "i8", (4,)),
        ("sent_id", "i8", (4, 4)),
        ("sent_cycle_ns", "i8", (4,)),
    ],
    align=True,
)


@njit
def unpack(data: Integer, signal: Record) -> float:
    """Physical value of one signal (a SIGNAL record) in a little-endian payload."""
    raw = np.int64((np.uint64(data) >> np.uint64(signal.start)) & ((np.uint64(1) << np.uint64(signal.length)) - np.uint64(1)))
    if signal.signed and raw >> (signal.length - 1):
        raw -= np.int64(1) << signal.length
    return raw * signal.factor + signal.offset


@njit
def pack(value: float, signal: Record) -> Integer:
    """The bits of one signal, at their place in the payload; a value beyond the signal's range saturates, NaN is ``low``."""
    if not value > signal.low:
        value = signal.low
    elif value > signal.high:
        value = signal.high
    raw = np.int64(np.rint((value - signal.offset) / signal.factor))
    mask = (np.uint64(1) << np.uint64(signal.length)) - np.uint64(1)
    return (np.uint64(raw) & mask) << np.uint64(signal.start)


def signal_columns(database: "Database", message: str, names: tuple[str, ...]) -> np.ndarray:
    """SIGNAL records of the named signals of a cantools message. Raises InputErrors: a message or signal is missing, or is not
    little-endian."""
    columns, faults = np.zeros(len(names), SIGNAL), []
    try:
        known = {signal.name: signal for signal in database.get_message_by_name(message).signals}
    except KeyError:
        raise InputErrors([f"message {message} is missing"]) from None
    for column, name in enumerate(names):
        signal = known.get(name)
        if signal is None:
            faults.append(f"{message}: signal {name} is missing")
        elif signal.byte_order != "little_endian" or signal.length > 48:
            faults.append(f"{message}.{name}: expected a little-endian signal of at most 48 bits")
        else:
            full = (1 << signal.length) - 1 if not signal.is_signed else (1 << (signal.length - 1)) - 1
            least = 0 if not signal.is_signed else -full - 1
            low = least * signal.scale + signal.offset if signal.minimum is None else signal.minimum
            high = full * signal.scale + signal.offset if signal.maximum is None else signal.maximum
            columns[column] = (signal.start, signal.length, signal.is_signed, signal.scale, signal.offset, low, high)
    if faults:
        raise InputErrors(faults)
    return columns


#: Endings of descriptions of a bus that are no DBC.
NO_DBC = (".arxml", ".kcd", ".sym")


def load_database(path: Path, strict: bool = True) -> "Database":
    """A cantools database: ARXML, KCD or SYM by ending, or a DBC, in UTF-8 or as Vector's tools write it (cp1252). ``strict``:
    whether signals of a message may neither overlap nor reach beyond it, as those of other people's files do. Raises
    InputError: the file cannot be read or is no DBC."""
    import cantools

    try:
        if (ending := path.suffix.lower()) in NO_DBC:
            return cantools.database.load_file(path, database_format=ending[1:], strict=strict)
        return cantools.database.load_string(read_dbc(path), "dbc", strict=strict)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected a DBC") from None
    except Exception as error:
        raise not_readable(path, error) from None


def not_readable(path: Path, error: Exception) -> InputError:
    """The error for a file that cantools does not read."""
    return InputError(f"{path}: not a readable DBC: {str(error).splitlines()[0]}")


def read_dbc(path: Path) -> str:
    """The text of a DBC, in UTF-8 or as Vector's tools write it. Raises InputError: it cannot be read."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, expected a DBC") from None
    except OSError as error:
        raise not_readable(path, error) from None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def _convert(columns: np.ndarray, names: tuple[str, ...], message, expected) -> list[str]:
    """Make the SIGNAL records of a message take and give ``expected``'s units instead of those of its own DBC; returns faults:
    units that are missing, unknown or of another quantity."""
    faults = []
    for column, name in zip(columns, names, strict=True):
        unit, target = ((found.get_signal_by_name(name).unit or "").strip() for found in (message, expected))
        try:
            factor, offset = conversion(unit, target)
        except InputError as error:
            faults.append(f"{message.name}.{name}: {error}")
            continue
        column["factor"] *= factor
        for field in ("offset", "low", "high"):
            column[field] = factor * column[field] + offset
    return faults


def _frame_faults(message) -> list[str]:
    """Deviations from what every DBC must have: classic frames with an E2E header, each at its cycle."""
    faults = []
    if message.frame_id > 0x7FF or message.is_extended_frame or message.length != 8:
        faults.append(f"{message.name}: expected an 11-bit id and 8 bytes")
    if not message.cycle_time:
        faults.append(f"{message.name}: GenMsgCycleTime is missing")
    elif message.name.endswith(_EVERY_CYCLE) and message.cycle_time * 1_000_000 != CYCLE_NS:
        faults.append(f"{message.name}: GenMsgCycleTime is {message.cycle_time} ms; expected {CYCLE_NS // 1_000_000} ms")
    for signal in message.signals:
        place = (signal.start, signal.length)
        if signal.name in _HEADER and place != _HEADER[signal.name]:
            start, length = _HEADER[signal.name]
            faults.append(f"{message.name}.{signal.name}: expected {length} bits from bit {start} (AUTOSAR E2E profile 1)")
    return faults


def _read_message(database: "Database", shipped: "Database", name: str, names: tuple[str, ...]) -> tuple[Any, np.ndarray]:
    """A cantools message and SIGNAL records of its named signals, in the units of the shipped DBC. Raises InputErrors: every
    fault of the message."""
    message = next((known for known in database.messages if known.name == name), None)
    faults, columns = _frame_faults(message) if message else [], np.zeros(0, SIGNAL)
    try:
        columns = signal_columns(database, name, names)
        faults += _convert(columns, names, message, shipped.get_message_by_name(name))
    except InputErrors as error:
        faults += error.faults
    if faults:
        raise InputErrors(faults)
    return message, columns


def load_layout(path: Path | None = None, corners: tuple[str, ...] = CORNERS) -> np.ndarray:
    """The LAYOUT (shape (1,)) of the messages that concern ``corners``, all others being foreign.

    Signals of another DBC are converted from its units into those of the shipped one. Raises InputErrors: the DBC lacks
    messages, signals, units or cycle times, or contradicts the contract; every fault is listed."""
    # cantools, and python-can with it, take a third of the daemon's start.
    if path is None and (known := library.layout_of(resource("dbc/emb.dbc"))):
        return _restrict(np.frombuffer(known, LAYOUT).copy(), corners)
    shipped = load_database(resource("dbc/emb.dbc"))
    database = load_database(path) if path else shipped
    layout, faults = np.zeros(1, LAYOUT), []
    record = layout[0]
    record["slot"] = FOREIGN

    def fill(field: str, place: int, name: str, names: tuple[str, ...]) -> Any:
        """Write a message's signals; returns the message, or None if it is faulty."""
        try:
            message, columns = _read_message(database, shipped, name, names)
        except InputErrors as error:
            faults.extend(f"{path or resource('dbc/emb.dbc')}: {fault}" for fault in error.faults)
            return None
        record[field][place, : len(names)], record[f"{field}_count"][place] = columns, len(names)
        return message

    own = [(corner, index) for index, corner in enumerate(CORNERS) if corner in corners]
    received = {template.format(corner): (CORNER_MESSAGES * index + kind, names)
                for corner, index in own for template, (kind, names) in _RECEIVED.items()} | _VEHICLE  # fmt: skip
    known = {message.name for message in database.messages}
    for name, (slot, names) in received.items():
        optional = name.endswith(OPTIONAL) and name not in known
        if not optional and (message := fill("received", slot, name, names)):
            record["slot"][message.frame_id], record["cycle_ns"][slot] = slot, message.cycle_time * 1_000_000
    for kind, (template, names) in enumerate(_SENT):
        for corner, index in own:
            if message := fill("sent", kind, template.format(corner), names):
                record["slot"][message.frame_id], record["sent_id"][kind, index] = OURS, message.frame_id
                record["sent_cycle_ns"][kind] = message.cycle_time * 1_000_000
    if faults:
        raise InputErrors(faults)
    return layout


def _restrict(layout: np.ndarray, corners: tuple[str, ...]) -> np.ndarray:
    """Make the messages of all other corners than ``corners`` foreign in a LAYOUT, in place; returns it."""
    record = layout[0]
    for index in (index for index, name in enumerate(CORNERS) if name not in corners):
        slots = slice(CORNER_MESSAGES * index, CORNER_MESSAGES * (index + 1))
        record["slot"][np.isin(record["slot"], range(slots.start, slots.stop))] = FOREIGN
        record["slot"][record["sent_id"][:, index]] = FOREIGN
        for field in ("received", "received_count", "cycle_ns"):
            record[field][slots] = np.zeros((), LAYOUT)[field][slots]
        record["sent_id"][:, index] = 0
    return layout


@cache
def default_layout() -> np.ndarray:
    """The layout of the shipped DBC with all four corners; treat it as read-only."""
    return load_layout()
