"""Frames as other people's code makes them: cantools for the payload, autosar-e2e for its protection."""

from functools import cache

import cantools
import numpy as np
from e2e.p01 import e2e_p01_check, e2e_p01_protect

from emb_daemon.resources import resource
from emb_daemon.wire.frames import FRAME

MS = 1_000_000


@cache
def database():
    return cantools.database.load_file(resource("dbc/emb.dbc"))


def payload(message: str, counter: int = 0, status: int = 0, **signals) -> bytes:
    found = database().get_message_by_name(message)
    values = {signal.name: max(0.0, signal.offset) for signal in found.signals} | {"Counter": counter, "Status": status}
    data = bytearray(found.encode(values | {"CRC": 0} | signals, strict=False, scaling=True))
    e2e_p01_protect(data, found.frame_id, increment_counter=False)
    return bytes(data)


def record(time_ns: int, can_id: int, data: bytes, flags: int = 0) -> np.ndarray:
    """FRAME array of one frame."""
    return np.array([(time_ns, int.from_bytes(data[:8], "little"), can_id, len(data), flags)], FRAME)


def frame(message: str, time_ns: int = 0, counter: int = 0, status: int = 0, **signals) -> np.ndarray:
    return record(time_ns, database().get_message_by_name(message).frame_id, payload(message, counter, status, **signals))


def decode(frame_record) -> tuple[str, dict]:
    """Message name and signals of a frame, its protection checked."""
    data = int(frame_record["data"]).to_bytes(8, "little")
    can_id = int(frame_record["can_id"])
    assert frame_record["length"] == 8 and e2e_p01_check(bytearray(data), can_id)
    found = database().get_message_by_frame_id(can_id)
    return found.name, found.decode(data, decode_choices=False)


def merged(*parts: np.ndarray) -> np.ndarray:
    """Frames of all parts in order of time; of equal times, in the order of the parts."""
    frames = np.concatenate(parts)
    return frames[np.argsort(frames["time_ns"], kind="stable")]


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays of records hold the same bits, but for those between fields."""
    return all(a[name].tobytes() == b[name].tobytes() for name in a.dtype.names)


def drive(
    cycles: int,
    corner: str = "FL",
    start_ns: int = 0,
    angle=(0.0,),
    speed=(0.0,),
    current=(0.0,),
    wheel_speed: float = 0.0,
    backplate: float = 20.0,
    first: int = 0,
) -> list[np.ndarray]:
    """Frames of one corner and its car for ``cycles`` resolver cycles from cycle ``first`` on.

    ``angle`` (rad), ``speed`` (rad/s) and ``current`` (A) by cycle, over and over."""
    frames = []
    for cycle in range(first, first + cycles):
        now, counter = start_ns + cycle * 4 * MS, cycle % 15
        at = [signal[cycle % len(signal)] for signal in (angle, speed, current)]
        if cycle % 25 == 0:
            frames.append(frame("VEH_Status", now - 3000, cycle // 25 % 15, AmbientTemp=20.0))
        if cycle % 5 in (0, 2):
            slow = (2 * (cycle // 5) + (cycle % 5 > 0)) % 15
            frames.append(
                frame(
                    f"EMB_{corner}_Thermocouple",
                    now - 2000,
                    slow,
                    InnerBackplateTemp=backplate,
                    OuterBackplateTemp=backplate,
                    CaliperTemp=backplate,
                )
            )
            frames.append(frame("VEH_WheelSpeed", now - 1000, slow, **{f"WheelSpeed{corner}": wheel_speed}))
            frames.append(frame("VEH_WheelPulse", now - 500, slow))
        frames.append(frame(f"EMB_{corner}_Resolver", now, counter, MotorAngle=at[0], MotorSpeed=at[1]))
        frames.append(frame(f"EMB_{corner}_Current", now + 100_000, counter, CurrentQ=at[2]))
    return frames
