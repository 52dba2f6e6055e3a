"""Signals of a log as columns: reference instruments for judging, and any message for plots."""

import numpy as np

from emb_daemon.jit import njit
from emb_daemon.resources import resource
from emb_daemon.wire.e2e import crc
from emb_daemon.wire.frames import ERROR, EXTENDED, REMOTE
from emb_daemon.wire.layout import load_database, signal_columns, unpack


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
def crc_is_right(frames):
    """Of each FRAME row, as an E2E protected message, shape (n,)."""
    right = np.empty(len(frames), np.bool_)
    for row in range(len(frames)):
        right[row] = crc(frames[row].can_id, frames[row].data) == frames[row].data & np.uint64(0xFF)
    return right


class Decoder:
    """Whole columns out of FRAME arrays, by message and signal name of a DBC."""

    def __init__(self, dbc: str = "dbc/emb.dbc"):
        self._database = load_database(resource(dbc))

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


def absent_raw(length: int) -> int:
    """Raw value of a signed reference signal that says that the rig has no such instrument: the least there is."""
    return -(1 << (length - 1))


class References:
    """What a rig's instruments measured at one corner; empty arrays where it has none, NaN where one of a message's
    instruments is missing. Identifies and judges only."""

    def __init__(self, frames: np.ndarray, corner: str):
        decoder = Decoder("dbc/rig.dbc")
        force = decoder.columns(frames, f"RIG_{corner}_Force")
        self.time_ns = force["time_ns"]
        self.clamp_force_N = force["ClampForceRef"]
        self.brake_torque_Nm = force["BrakeTorqueRef"]
        self.disc_C = force["DiscTempRef"]
        self.pads = {}
        for side in ("Inner", "Outer"):
            pad = decoder.columns(frames, f"RIG_{corner}_{side}Pad")
            depths = np.array([pad[f"{side}PadTemp{depth}mm"] for depth in (2, 4, 6, 8)])
            self.pads[side.lower()] = (pad["time_ns"], depths)

    def at(self, time_ns: np.ndarray, values: np.ndarray, tolerance_ns: int = 2_000_000) -> np.ndarray:
        """Force-rate reference ``values`` at sample times: those whose frame is the nearest, NaN where none is near."""
        if not len(self.time_ns):
            return np.full(len(time_ns), np.nan)
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, max(len(self.time_ns) - 1, 1))
        after = np.minimum(after, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.where(np.abs(self.time_ns[after] - time_ns) < np.abs(self.time_ns[before] - time_ns), after, before)
        near = np.abs(self.time_ns[nearer] - time_ns) <= tolerance_ns
        return np.where(near, values[nearer], np.nan)

    def latest(self, time_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Force-rate reference ``values`` last heard at each time, NaN before the first."""
        row = np.searchsorted(self.time_ns, time_ns, side="right") - 1
        return np.where(row >= 0, values[np.maximum(row, 0)], np.nan) if len(values) else np.full(len(time_ns), np.nan)
