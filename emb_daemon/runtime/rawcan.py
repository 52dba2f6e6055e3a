"""Batches of CAN frames over a socket, one system call in and one out per tick.

Python's socket module has neither recvmmsg nor sendmmsg; a frame at a time costs four to ten system calls more in each
tick, too many for a small ECU. The socket is SocketCAN's AF_CAN or, in one process, a pair of Unix sockets
that carries the same struct can_frame, followed by the sender's time stamp, which on CAN the kernel attaches.
"""

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Callable

import numpy as np

from emb_daemon.errors import Unavailable
from emb_daemon.jit import Array, entry
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import ERROR, EXTENDED, FRAME, REMOTE

# Linux UAPI values that the socket module does not export.
_SO_TIMESTAMPNS, _SO_RXQ_OVFL, _SO_RCVBUFFORCE = 35, 40, 33
_MSG_DONTWAIT = 0x40
_EFF, _RTR, _ERR = 0x8000_0000, 0x4000_0000, 0x2000_0000
_CAN_RAW_ERR_FILTER, _ERROR_CLASSES = 2, 0x1FFF_FFFF
#: If the clock was set while frames waited, a stamp is accepted only if it is no older than this before the last look into the
#: queue: its error is at most this long, which the pipeline tolerates as jitter. So it does a clock that was set by less.
#: Otherwise stamps of any age are the frames' own: the kernel may be held up between stamping a frame and queueing it.
_TOLERATED_NS = 2 * CYCLE_NS
#: A change of the clocks' difference up to this is not followed. Both are slewed alike, so that it changes only when one is
#: set; the time between reading one and the other must not move stamps against each other, as nothing does in a log.
_APART_NS = 100_000

_CAN_FRAME = np.dtype([("can_id", "u4"), ("length", "u1"), ("pad", "u1", (3,)), ("data", "u8"), ("time_ns", "i8")])
_CAN_FRAME_BYTES = 16
_IOVEC = np.dtype([("base", "u8"), ("length", "u8")])
# struct mmsghdr of the 64-bit Linux ABIs, where struct msghdr is padded to eight bytes before msg_len.
_MMSGHDR = np.dtype(
    {
        "names": ["name", "name_length", "iov", "iov_length", "control", "control_length", "flags", "length"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "i4", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
#: Room for control messages, in words of eight bytes, which is how they are aligned: length, level with type, content.
_CONTROL_WORDS = 8
#: Largest number of frames that one call takes or sends.
_CAPACITY = 1024
#: Errors of a socket whose interface was deleted, and errors after which the next call may succeed.
_INTERFACE_GONE = (errno.ENODEV, errno.ENXIO)
_PASSING = (errno.EAGAIN, errno.EINTR, errno.ECONNREFUSED, errno.ECONNRESET, errno.EPIPE, errno.ENOBUFS)
#: Time between attempts to open another socket while the interface is gone.
_REOPEN_NS = 100_000_000

_libc = ctypes.CDLL(None, use_errno=True)


def _clock_offset_ns() -> int:
    """CLOCK_REALTIME minus CLOCK_MONOTONIC, of the readings between which the least time passed: no stamp is then in the
    future."""
    readings = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(10)]
    return min((after - before, real - before) for before, real, after in readings)[1]


class _Batch:
    """Preallocated message headers that point at frame and control buffers."""

    def __init__(self, frame_bytes: int, control: bool):
        self.raw = np.zeros(_CAPACITY, _CAN_FRAME)
        self.control = np.zeros((_CAPACITY, _CONTROL_WORDS), np.int64)
        self._iov = np.zeros(_CAPACITY, _IOVEC)
        self.headers = np.zeros(_CAPACITY, _MMSGHDR)
        rows = np.arange(_CAPACITY, dtype=np.uint64)
        self._iov["base"] = self.raw.ctypes.data + rows * _CAN_FRAME.itemsize
        self._iov["length"] = frame_bytes
        self.headers["iov"] = self._iov.ctypes.data + rows * _IOVEC.itemsize
        self.headers["iov_length"] = 1
        if control:
            self.headers["control"] = self.control.ctypes.data + 8 * _CONTROL_WORDS * rows
            self.headers["control_length"] = 8 * _CONTROL_WORDS
        self.address = ctypes.c_void_p(self.headers.ctypes.data)


@entry(Array(_CAN_FRAME), Array(_MMSGHDR), Array(np.int64, 2), int, bool, int, int, int, Array(FRAME), returns=2)
def _from_kernel(raw, headers, control, count, stamped, offset_ns, earliest_ns, now_ns, frames):
    """Frames with times on the monotonic clock; returns how many there are, and the socket's drop counter or -1.

    When the peer of a socket pair has closed its end, endless empty messages follow, which are not frames.

    The kernel's stamps are of CLOCK_REALTIME, which can step. ``offset_ns`` converts them to the monotonic clock, and the
    result is limited to between ``earliest_ns`` and now. It is rounded to whole microseconds, as candump logs them, so that a
    log of the bus gives the same times."""
    drops = np.int64(-1)
    for index in range(count):
        if headers[index].length == 0:
            return index, drops
        frame, source = frames[index], raw[index]
        can_id = np.int64(source.can_id)
        frame.flags = (EXTENDED if can_id & _EFF else 0) | (REMOTE if can_id & _RTR else 0) | (ERROR if can_id & _ERR else 0)
        frame.can_id = can_id & 0x1FFF_FFFF
        frame.length = source.length
        frame.data = source.data
        stamp = source.time_ns if stamped else now_ns
        at, words = 0, control[index]
        while 8 * (at + 2) <= np.int64(headers[index].control_length):
            size, kind = words[at], words[at + 1] >> 32
            if size < 16 or 8 * at + size > headers[index].control_length:
                break
            if kind == _SO_TIMESTAMPNS and size >= 32:
                stamp = words[at + 2] * 1_000_000_000 + words[at + 3] // 1000 * 1000 - offset_ns
            elif kind == _SO_RXQ_OVFL and size >= 20:
                drops = words[at + 2] & 0xFFFF_FFFF
            at += (size + 7) // 8
        frame.time_ns = min(max(stamp, earliest_ns), now_ns)
        earliest_ns = frame.time_ns
        headers[index].control_length = 8 * _CONTROL_WORDS
    return count, drops


@entry(Array(FRAME), int, Array(_CAN_FRAME))
def _to_kernel(frames, now_ns, raw):
    for index in range(len(frames)):
        raw[index].can_id = frames[index].can_id
        raw[index].length = frames[index].length
        raw[index].data = frames[index].data
        raw[index].time_ns = now_ns


class RawCanSocket:
    """Frames in batches over an already connected or bound socket; takes ownership of it. ``stamped``: frames carry the
    sender's time stamp (`socket_pair`) instead of the kernel's; ``reopen``: returns another such socket when the interface of
    this one is gone, or raises Unavailable."""

    def __init__(self, sock: socket.socket, stamped: bool = False, reopen: Callable[[], socket.socket] | None = None):
        self._socket, self._reopen = sock, reopen
        frame_bytes = _CAN_FRAME.itemsize if stamped else _CAN_FRAME_BYTES
        self._received = _Batch(frame_bytes, control=True)
        self._sent = _Batch(frame_bytes, control=False)
        self._stamped = stamped
        self._frames = np.zeros(_CAPACITY, FRAME)
        #: Time of the last look into the queue, time of the last frame, and time of the next attempt to open another socket.
        self._looked_ns = self._latest_ns = time.monotonic_ns()
        self._reopen_ns: int | None = None
        self._offset_ns = _clock_offset_ns()
        self.dropped: int = 0  #: frames for which this socket's receive buffer had no room
        self.unsent: int = 0  #: frames that the kernel did not accept
        self.down: bool = False  #: the interface is down or gone, as the last attempt to use it found
        self.full: bool = False  #: the last drain took as much as it can; more may be waiting
        # Compile now, not when the first frame is waiting.
        self._take(0, self._looked_ns)
        _to_kernel(self._frames[:0], 0, self._sent.raw)

    def wait(self, timeout_s: float) -> bool:
        """Sleep until a frame is there or the time is over."""
        # poll() is not used, because its timeout is in whole milliseconds.
        return bool(select.select([self._socket], [], [], timeout_s)[0]) if timeout_s > 0 else False

    def drain(self) -> np.ndarray:
        """All frames that have arrived, at most `_CAPACITY`, as a FRAME array valid until the next call."""
        looked = time.monotonic_ns()
        if self._reopen_ns is not None and looked >= self._reopen_ns:
            self._rebind(looked)
        count = _libc.recvmmsg(self._socket.fileno(), self._received.address, _CAPACITY, _MSG_DONTWAIT, None)
        self.full = count == _CAPACITY
        if count < 0:
            self._failed(ctypes.get_errno())
            return self._frames[:0]
        self.down = False
        count, drops = self._take(count, time.monotonic_ns())
        # Taken before the call: a frame that arrives while it returns is found by the next call.
        self._looked_ns = looked
        if count:
            self._latest_ns = int(self._frames["time_ns"][count - 1])
        if drops >= 0:
            self.dropped = drops
        return self._frames[:count]

    def _take(self, count: int, now: int) -> tuple[int, int]:
        batch = self._received
        # The thread may be held up between two readings of clocks, so they give only an interval for the offset.
        real, after = time.time_ns(), time.monotonic_ns()
        moved = min(max(self._offset_ns, real - after), real - now) - self._offset_ns
        if abs(moved) > _APART_NS:
            self._offset_ns += moved
        earliest = self._latest_ns
        # A sender's own stamp is of the monotonic clock, which is never set.
        if not self._stamped and abs(moved) > _TOLERATED_NS:
            earliest = max(earliest, self._looked_ns - _TOLERATED_NS)
        return _from_kernel(
            batch.raw, batch.headers, batch.control, count, self._stamped, self._offset_ns, earliest, now, self._frames
        )

    def send(self, frames: np.ndarray) -> None:
        """Hand FRAME records to the kernel without waiting. Frames that it does not accept are counted and not retried,
        because the next estimate is better than one that has waited in a queue."""
        for first in range(0, len(frames), _CAPACITY):
            batch = frames[first : first + _CAPACITY]
            _to_kernel(batch, time.monotonic_ns(), self._sent.raw)
            taken = _libc.sendmmsg(self._socket.fileno(), self._sent.address, len(batch), _MSG_DONTWAIT)
            if taken < 0:
                self._failed(ctypes.get_errno())
            else:
                self.down = False
            self.unsent += len(batch) - max(taken, 0)

    def _failed(self, code: int) -> None:
        """Note what an error means for the interface. Raises OSError if the error is not one that passes by itself."""
        if code in _INTERFACE_GONE:
            self.down = True
            if self._reopen_ns is None:
                self._reopen_ns = time.monotonic_ns()
        elif code == errno.ENETDOWN:
            # The socket stays bound, and works again when the interface is up.
            self.down = True
        elif code not in _PASSING:
            raise OSError(code, os.strerror(code))

    def _rebind(self, now_ns: int) -> None:
        """Open another socket: the old one stays bound to the deleted interface, even if one of the same name is added."""
        self._reopen_ns = None
        if self._reopen is not None:
            try:
                fresh = self._reopen()
            except Unavailable:
                self._reopen_ns = now_ns + _REOPEN_NS
            else:
                self._socket.close()
                self._socket = fresh

    def close(self) -> None:
        self._socket.close()


def open_socketcan(channel: str, ids: list[int], receive_buffer: int = 1 << 20) -> RawCanSocket:
    """A SocketCAN interface with kernel time stamps, drop counter, error frames and filters for ``ids``. Raises Unavailable:
    no such interface, or the kernel has no CAN."""

    def reopen() -> socket.socket:
        return _bound_socket(channel, ids, receive_buffer)

    return RawCanSocket(reopen(), reopen=reopen)


def _bound_socket(channel: str, ids: list[int], receive_buffer: int) -> socket.socket:
    if not hasattr(socket, "AF_CAN"):
        raise Unavailable("socketcan: this Python has no AF_CAN")
    try:
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise Unavailable(f"socketcan: the kernel offers no CAN sockets ({error.strerror}); try modprobe can_raw") from None
    try:
        exact = 0x7FF | _EFF | _RTR
        filters = b"".join(struct.pack("=II", can_id, exact) for can_id in ids)
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ERROR_CLASSES)
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, receive_buffer)
        except PermissionError:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.bind((channel,))
    except OSError as error:
        sock.close()
        raise Unavailable(f"socketcan: interface {channel}: {error.strerror}") from None
    return sock


def connected_sockets() -> tuple[socket.socket, socket.socket]:
    """Two connected sockets that carry the frames of a bus with two ends on one machine."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    return ends


def socket_pair() -> tuple[RawCanSocket, RawCanSocket]:
    """A CAN bus with two ends inside one process."""
    ours, theirs = connected_sockets()
    return RawCanSocket(ours, stamped=True), RawCanSocket(theirs, stamped=True)
