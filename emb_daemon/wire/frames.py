"""The frame record that every source and sink of CAN traffic shares."""

from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.jit import Integer, Records, njit

if TYPE_CHECKING:
    from can import Message

#: ``time_ns`` nanoseconds on the source's clock; ``can_id`` without flag bits; ``flags`` as below; ``data`` the eight
#: payload bytes as a little-endian integer, zero beyond ``length``.
FRAME = np.dtype([("time_ns", "i8"), ("data", "u8"), ("can_id", "u4"), ("length", "u1"), ("flags", "u1")], align=True)

EXTENDED, REMOTE, ERROR, FD = 1, 2, 4, 8
#: Set by `wire.secoc` only: authentication is required, and this frame has none.
UNAUTHENTIC = 16


@njit
def put(frames: Records, count: int, time_ns: Integer, can_id: Integer, data: Integer, flags: int) -> int:
    """Write a frame of eight bytes as the last of ``count`` + 1; returns their number."""
    frame = frames[count]
    frame.time_ns, frame.can_id, frame.data, frame.length, frame.flags = time_ns, can_id, data, 8, flags
    return count + 1


def payloads_to(can_id: int, frames: np.ndarray) -> list[bytes]:
    """Payloads of the classic data frames of an 11-bit id."""
    mine = frames[(frames["can_id"] == can_id) & (frames["flags"] & (EXTENDED | REMOTE | FD) == 0)]
    return [int(frame["data"]).to_bytes(8, "little")[: frame["length"]] for frame in mine]


def message_of(frame: np.void) -> "Message":
    """A FRAME row of an 11-bit id as a python-can Message."""
    import can

    data = int(frame["data"]).to_bytes(8, "little")[: frame["length"]]
    time_s, can_id = 1e-9 * int(frame["time_ns"]), int(frame["can_id"])
    return can.Message(timestamp=time_s, arbitration_id=can_id, data=data, is_extended_id=False)


def row_of(message: "Message", time_ns: int) -> tuple[int, int, int, int, int]:
    """A python-can Message as a FRAME row; of CAN FD's payload the first eight bytes."""
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    flags |= ERROR * message.is_error_frame | FD * message.is_fd
    return time_ns, int.from_bytes(message.data[:8], "little"), message.arbitration_id, len(message.data), flags
