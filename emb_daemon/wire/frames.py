"""The frame record that every source and sink of CAN traffic shares."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from can import Message

#: ``time_ns`` nanoseconds on the source's clock; ``can_id`` without flag bits; ``flags`` as below; ``data`` the eight
#: payload bytes as a little-endian integer, zero beyond ``length``.
FRAME = np.dtype([("time_ns", "i8"), ("data", "u8"), ("can_id", "u4"), ("length", "u1"), ("flags", "u1")], align=True)

EXTENDED, REMOTE, ERROR, FD = 1, 2, 4, 8
#: Set by `wire.secoc` only: authentication is required, and this frame has none.
UNAUTHENTIC = 16


def row_of(message: "Message", time_ns: int) -> tuple[int, int, int, int, int]:
    """A python-can Message as a FRAME row; of CAN FD's payload the first eight bytes."""
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    flags |= ERROR * message.is_error_frame | FD * message.is_fd
    return time_ns, int.from_bytes(message.data[:8], "little"), message.arbitration_id, len(message.data), flags
