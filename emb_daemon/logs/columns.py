"""Signals of a log as columns: reference instruments for judging, and any message for plots."""

from functools import cache

import numpy as np

from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.jit import Booleans, Records, njit
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.e2e import crc
from emb_daemon.wire.frames import ERROR, EXTENDED, REMOTE
from emb_daemon.wire.layout import load_database, signal_columns, unpack

#: Depths below the friction surface at which a rig's pads have thermocouples, mm: those of the estimator's temperatures.
DEPTHS_MM = tuple(round(1e3 * depth_m) for depth_m in DEPTHS_M)
#: Largest distance in time between a sample and its reference's frame: half a cycle.
_NEAR_NS = CYCLE_NS // 2


@njit
def _select(frames, can_id, length):
    rows = np.empty(len(frames), np.int64)
    count = 0
    for index in range(len(frames)):
        frame = frames[index]
        if frame.can_id == can_id and frame.length >= length and frame.flags & (EXTENDED | REMOTE | ERROR) == 0:
            rows[count] = index
            count += 1
    return rows[:count]


@njit
def _decode(frames, rows, signals, values):
    for row in range(len(rows)):
        for column in range(len(signals)):
            values[column, row] = unpack(frames[rows[row]].data, signals[column])


@njit
def crc_is_right(frames: Records) -> Booleans:
    """Of each FRAME row, as an E2E protected message, shape (n,)."""
    right = np.empty(len(frames), np.bool_)
    for row in range(len(frames)):
        right[row] = crc(frames[row].can_id, frames[row].data) == frames[row].data & np.uint64(0xFF)
    return right


@cache
def shipped_database(dbc: str):
    """A cantools database; parsing one takes as long as replaying half a minute."""
    return load_database(resource(dbc))


class Decoder:
    """Whole columns out of FRAME arrays, by message and signal name of a DBC."""

    def __init__(self, dbc: str = "dbc/emb.dbc"):
        self._database = shipped_database(dbc)

    def can_id(self, message: str) -> int:
        return self._database.get_message_by_name(message).frame_id

    def columns(self, frames: np.ndarray, message: str) -> dict[str, np.ndarray]:
        """``time_ns`` and every signal of ``message``, one entry per frame; empty arrays where the log has none."""
        found = self._database.get_message_by_name(message)
        names = tuple(signal.name for signal in found.signals)
        rows = _select(frames, found.frame_id, found.length)
        values = np.zeros((len(names), len(rows)))
        _decode(frames, rows, signal_columns(self._database, message, names), values)
        if message.startswith("RIG_"):
            for column, signal in zip(values, found.signals, strict=True):
                column[column <= signal.scale * (absent_raw(signal.length) + 0.5) + signal.offset] = np.nan
        return {"time_ns": frames["time_ns"][rows]} | dict(zip(names, values, strict=True))


def beyond_range(frames: np.ndarray) -> list[str]:
    """A line for each signal with values beyond its range in frames whose CRC is right: the daemon uses none of these."""
    database, decoder, right = shipped_database("dbc/emb.dbc"), Decoder(), frames[crc_is_right(frames)]
    lines = []
    for message in database.messages:
        columns = decoder.columns(right, message.name)
        names = tuple(name for name in columns if name != "time_ns")
        for name, layout in zip(names, signal_columns(database, message.name, names), strict=True):
            rounding = 0.5 * layout["factor"]
            beyond = (columns[name] < layout["low"] - rounding) | (columns[name] > layout["high"] + rounding)
            if beyond.any():
                first = int(np.argmax(beyond))
                lines.append(
                    f"{message.name}.{name} is beyond {layout['low']:g} to {layout['high']:g} in {np.sum(beyond)} of "
                    f"{len(beyond)} frames, which are not used; the first, at "
                    f"{1e-9 * (columns['time_ns'][first] - frames['time_ns'][0]):.3f} s, is {columns[name][first]:g}"
                )
    return lines


def absent_raw(length: int) -> int:
    """Raw value of a signed reference signal that means that the rig has no such instrument: the least possible one."""
    return -(1 << (length - 1))


def nearest(time_ns: np.ndarray, at_ns: np.ndarray) -> np.ndarray:
    """Row of the ascending times, at least one, that is nearest to each of ``at_ns``."""
    after = np.clip(np.searchsorted(time_ns, at_ns), 0, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(time_ns[after] - at_ns) < np.abs(at_ns - time_ns[before]), after, before)


def latest(time_ns: np.ndarray, values: np.ndarray, at_ns: np.ndarray) -> np.ndarray:
    """Of values at ascending times the last one at or before each of ``at_ns``, NaN before the first."""
    if not len(values):
        return np.full(len(at_ns), np.nan)
    row = np.searchsorted(time_ns, at_ns, side="right") - 1
    return np.where(row >= 0, values[np.maximum(row, 0)], np.nan)


class References:
    """What a rig's instruments measured at one corner; empty arrays where it has none, NaN where one of a message's
    instruments is missing. Identifies and judges only."""

    def __init__(self, frames: np.ndarray, corner: str):
        decoder = Decoder("dbc/rig.dbc")
        force = decoder.columns(frames, f"RIG_{corner}_Force")
        self.time_ns: np.ndarray = force["time_ns"]
        self.clamp_force_N: np.ndarray = force["ClampForceRef"]
        self.brake_torque_Nm: np.ndarray = force["BrakeTorqueRef"]
        self.disc_C: np.ndarray = force["DiscTempRef"]
        self.pads: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for side in ("Inner", "Outer"):
            pad = decoder.columns(frames, f"RIG_{corner}_{side}Pad")
            depths = np.array([pad[f"{side}PadTemp{depth}mm"] for depth in DEPTHS_MM])
            self.pads[side.lower()] = (pad["time_ns"], depths)

    def at(self, time_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Force-rate reference ``values`` at sample times: those whose frame is the nearest, NaN where none is near."""
        if not len(self.time_ns):
            return np.full(len(time_ns), np.nan)
        row = nearest(self.time_ns, time_ns)
        return np.where(np.abs(self.time_ns[row] - time_ns) <= _NEAR_NS, values[row], np.nan)

    def latest(self, time_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Force-rate reference ``values`` last heard at each time, NaN before the first."""
        return latest(self.time_ns, values, time_ns)
