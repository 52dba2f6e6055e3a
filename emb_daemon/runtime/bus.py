"""Any bus behind the same four calls: wait, drain, send, close."""

import os
import select
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from emb_daemon.errors import InputError, Unavailable
from emb_daemon.runtime.rawcan import open_socketcan
from emb_daemon.wire.frames import FRAME, message_of, row_of

if TYPE_CHECKING:
    from can import Message

#: Number of sent frames whose echo may still be outstanding; four corners send 16 in their busiest tick.
_ECHOES = 256
# Linux UAPI values that the socket module does not export.
_IP_MULTICAST_ALL, _IPV6_MULTICAST_ALL = 49, 29


class Bus(Protocol):
    """A bus as the loop, the monitor and the workshop's servers use it; details are in `RawCanSocket` and `PythonCanBus`."""

    #: ``dropped`` and ``unsent``: frames that the receiver had no room for, and that the bus did not accept.
    dropped: int
    unsent: int
    #: ``down`` and ``full``: the bus cannot be used now; the last drain may have left frames waiting.
    down: bool
    full: bool

    def wait(self, timeout_s: float) -> bool: ...

    def drain(self) -> np.ndarray: ...

    def send(self, frames: np.ndarray) -> None: ...

    def close(self) -> None: ...


class PythonCan(Protocol):
    """The methods of a python-can bus that are used."""

    def fileno(self) -> int: ...

    def recv(self, timeout_s: float, /) -> "Message | None": ...

    def send(self, message: "Message", /) -> None: ...

    def shutdown(self) -> None: ...


class PythonCanBus:
    """A bus that python-can drives, frame by frame.

    Args:
        ids: of the frames to receive, all of them 11 bits long; error frames are received too.
        echoes: the bus returns a sender its own frames; `drain` then leaves them out. A frame of another sender that is equal
            to one just sent is taken for its echo.
    """

    def __init__(self, bus: PythonCan, ids: list[int], echoes: bool = False):
        self._bus = bus
        # python-can's own filters are not used: where it applies them in software, recv(0) returns None for a frame that
        # they leave out, as for an empty queue.
        self._ids = frozenset(ids)
        self._early = deque()
        self._echoes = deque(maxlen=_ECHOES) if echoes else None
        self._frames = np.zeros(4096, FRAME)
        self.dropped: int = 0
        self.unsent: int = 0
        self.down: bool = False
        self.full: bool = False
        try:
            self._fd = bus.fileno()
        except NotImplementedError:
            self._fd = -1

    def wait(self, timeout_s: float) -> bool:
        if timeout_s <= 0:
            return False
        if self._fd >= 0:
            return bool(select.select([self._fd], [], [], timeout_s)[0])
        message = self._bus.recv(timeout_s)
        if message is not None:
            self._early.append(message)
        return message is not None

    def _receive(self) -> Iterator[tuple]:
        """python-can messages that have arrived, with their time on the monotonic clock in ns."""
        import can

        offset = time.time_ns() - time.monotonic_ns()
        while True:
            try:
                message = self._early.popleft() if self._early else self._bus.recv(0)
                self.down = False
            except can.CanError:
                self.down = True
                return
            if message is None:
                return
            # Frames whose stamp is not of this machine's clock (0, or the device's own clock) get the time of arrival.
            now, stamp = time.monotonic_ns(), round(message.timestamp * 1e9) - offset
            yield message, stamp if 0 <= now - stamp < 1_000_000_000 else now

    def drain(self) -> np.ndarray:
        count, arrived = 0, self._receive()
        while count < len(self._frames) and (found := next(arrived, None)):
            message, time_ns = found
            if not self._concerns_us(message) or self._is_echo(message):
                continue
            self._frames[count] = row_of(message, time_ns)
            count += 1
        self.full = count == len(self._frames)
        return self._frames[:count]

    def _concerns_us(self, message) -> bool:
        return message.is_error_frame or (message.arbitration_id in self._ids and not message.is_extended_id)

    def _is_echo(self, message) -> bool:
        # Echoes come in the order of sending, so the first is nearly always the right one.
        if not self._echoes or (key := (message.arbitration_id, bytes(message.data))) not in self._echoes:
            return False
        self._echoes.remove(key)
        return True

    def send(self, frames: np.ndarray) -> None:
        for frame in frames:
            message = message_of(frame)
            if self._hand_over(message) and self._echoes is not None:
                self._echoes.append((message.arbitration_id, bytes(message.data)))

    def _hand_over(self, message: "Message") -> bool:
        """Whether the bus has accepted a message; counted if not."""
        import can

        try:
            self._bus.send(message)
        except can.CanError:
            self.unsent += 1
            return False
        return True

    def close(self) -> None:
        self._bus.shutdown()


def open_bus(interface: str | None, channel: str | None, ids: list[int], **options: object) -> Bus:
    """Open the bus that the arguments, can.conf and the CAN_* variables name, receiving ``ids`` only.

    SocketCAN goes through `RawCanSocket`, everything else through python-can. Raises InputError: no interface is named, or an
    unknown one. Raises Unavailable: it cannot be opened now."""
    chosen: dict[str, Any] = {"interface": interface, "channel": channel, **options}
    # python-can, which is slow to import, fills in what is not given.
    if interface != "socketcan" or not channel:
        chosen = _choose_options(chosen)
    if chosen["interface"] == "socketcan":
        return open_socketcan(str(chosen["channel"]), ids)
    # Its multicast loops back, so that programs on one machine can receive each other's frames.
    return PythonCanBus(_open(chosen), ids, echoes=chosen["interface"] == "udp_multicast")


def open_python_can(options: dict[str, Any]) -> PythonCan:
    """python-can's own bus, unfiltered, by the options of `open_bus`; errors as there."""
    return _open(_choose_options(options))


def _choose_options(given: dict) -> dict:
    import can

    try:
        # An option of None would override can.conf and the CAN_* variables.
        return can.util.load_config(config={key: value for key, value in given.items() if value is not None})
    except (can.CanInterfaceNotImplementedError, ValueError) as error:
        raise InputError(f"bus: {error}; name one with --interface and --channel") from None


def _open(chosen: dict[str, Any]) -> PythonCan:
    import can

    try:
        bus = can.Bus(**chosen)
        if chosen["interface"] == "udp_multicast":
            _hear_own_group(bus.fileno())
    except Exception as error:
        raise Unavailable(f"bus: {chosen['interface']} {chosen.get('channel')}: {error}") from None
    return bus


def _hear_own_group(descriptor: int) -> None:
    """Keep a socket from receiving the groups that other programs on this machine have joined: all use the same port."""
    with socket.socket(fileno=os.dup(descriptor)) as handle:
        if handle.family == socket.AF_INET6:
            handle.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
        else:
            handle.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
