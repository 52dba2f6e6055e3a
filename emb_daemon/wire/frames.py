"""The frame record that every source and sink of CAN traffic shares."""

import numpy as np

#: ``time_ns`` nanoseconds on the source's clock; ``can_id`` without flag bits; ``flags`` as below; ``data`` the eight
#: payload bytes as a little-endian integer, zero beyond ``length``.
FRAME = np.dtype([("time_ns", "i8"), ("data", "u8"), ("can_id", "u4"), ("length", "u1"), ("flags", "u1")], align=True)

EXTENDED, REMOTE, ERROR, FD = 1, 2, 4, 8
#: Set by `wire.secoc` alone: authentication was asked for, and this frame has none.
UNAUTHENTIC = 16
