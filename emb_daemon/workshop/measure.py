"""The XCP server: reads estimates from the daemon's shared memory, answers commands and sends data, over UDP or CAN.

It shares with the daemon only memory that it reads, on CAN the bus, and for calibration the socket of `runtime.pages`; it may
be killed at any moment.
"""

import select
import socket
import struct
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import Unavailable
from emb_daemon.runtime.bus import Bus
from emb_daemon.runtime.pages import Answer, Page, PageClient, socket_path
from emb_daemon.runtime.shared import EstimatesReader
from emb_daemon.wire.frames import FRAME, payloads_to
from emb_daemon.workshop.image import Image
from emb_daemon.workshop.pages import Segment
from emb_daemon.workshop.xcp import CONNECT, ON_CAN, ON_UDP, Slave

#: Period of fetching estimates, and period of looking for the daemon's file.
_FETCH_S, _LOOK_S = 0.004, 0.25
#: Commands answered in one step; a master waits for each answer before it sends the next.
_COMMANDS = 32
#: Size of datagrams, below that of an Ethernet frame.
_DATAGRAM = 1440
_IP_RECVERR = 11
_HEADER = struct.Struct("<HH")


class Udp:
    """XCP on UDP (ASAM MCD-1 XCP, transport layer Ethernet): packets with length and counter, several to a datagram.

    The sender of the last CONNECT is the master; packets of others are ignored. ``gone``: the master's machine reported that
    its port is closed."""

    layer = ON_UDP

    def __init__(self, host: str, port: int):
        """Raises Unavailable for an address that cannot be used."""
        try:
            [(family, kind, *_, address), *_] = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            self._socket = socket.socket(family, kind)
            self._socket.bind(address)
        except OSError as error:
            raise Unavailable(f"--udp {host}:{port}: {error.strerror}") from None
        if family == socket.AF_INET:
            # Without this option an unconnected socket gets no error when the master has ended.
            self._socket.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._master = None
        self._counter = 0
        self.gone: bool = False

    def wait(self, timeout_s: float) -> None:
        select.select([self._socket], [], [], timeout_s)

    def receive(self) -> list[bytes]:
        packets: list[bytes] = []
        for _ in range(_COMMANDS):
            try:
                datagram, sender = self._socket.recvfrom(65536)
            except ConnectionRefusedError:
                self.gone = True
                continue
            except OSError:
                break
            while len(datagram) >= _HEADER.size:
                length, _ = _HEADER.unpack_from(datagram)
                packet, datagram = datagram[_HEADER.size : _HEADER.size + length], datagram[_HEADER.size + length :]
                if packet[:1] == bytes([CONNECT]):
                    self._master, self.gone = sender, False
                if len(packet) == length and sender == self._master:
                    packets.append(packet)
        return packets

    def send(self, packets: Iterable[bytes]) -> int:
        """Returns how many packets could not be sent."""
        datagram, held, unsent = bytearray(), 0, 0
        for packet in packets:
            if len(datagram) + _HEADER.size + len(packet) > _DATAGRAM:
                unsent += held * (not self._send_datagram(datagram))
                datagram, held = bytearray(), 0
            datagram += _HEADER.pack(len(packet), self._counter) + packet
            self._counter = (self._counter + 1) & 0xFFFF
            held += 1
        return unsent + held * (not self._send_datagram(datagram))

    def _send_datagram(self, datagram: bytearray) -> bool:
        if datagram and self._master is not None:
            try:
                self._socket.sendto(datagram, self._master)
            except ConnectionRefusedError:
                self.gone = True
            except OSError:
                return False
        return True

    def close(self) -> None:
        self._socket.close()


class Can:
    """XCP on CAN: a packet is a frame of eight bytes. ``bus`` receives ``request_id``; ids have 11 bits."""

    layer = ON_CAN
    #: On a bus the end of a master cannot be detected.
    gone = False

    def __init__(self, bus: Bus, request_id: int, response_id: int):
        self._bus, self._request_id, self._response_id = bus, request_id, response_id

    def wait(self, timeout_s: float) -> None:
        self._bus.wait(timeout_s)

    def receive(self) -> list[bytes]:
        return payloads_to(self._request_id, self._bus.drain())

    def send(self, packets: Iterable[bytes]) -> int:
        """Returns how many packets could not be sent."""
        contents = [int.from_bytes(packet.ljust(8, b"\0"), "little") for packet in packets]
        if not contents:
            return 0
        frames = np.zeros(len(contents), FRAME)
        frames["can_id"], frames["length"], frames["data"] = self._response_id, 8, contents
        before = self._bus.unsent
        self._bus.send(frames)
        return self._bus.unsent - before

    def close(self) -> None:
        self._bus.close()


class Measurement:
    """A slave on a transport, fed by a daemon, whose file of ``estimates`` (`runtime.shared`) need not exist yet.

    ``version``: the text that identifies the memory to which the A2L file belongs; ``name``, ``file``: of that, without
    ending, and its content; ``calibrations``: of the files, by corner, if they may be written."""

    def __init__(
        self, estimates: Path, transport: Udp | Can, version: bytes, name: bytes, file: bytes,
        calibrations: Mapping[str, Calibration] | None = None,
    ):  # fmt: skip
        self.reader: EstimatesReader = EstimatesReader(estimates)
        self.transport = transport
        self._image = Image(version)
        self._pages = PageClient(socket_path(estimates))
        segment = Segment(calibrations, self._ask, lambda: self.reader.on_page) if calibrations is not None else None
        self._slave = Slave(self._image, transport.layer, time.monotonic_ns, name, file, segment)
        self._looked = -_LOOK_S
        self._overloaded = False

    @property
    def trouble(self) -> str:
        """Why there are no estimates; empty if there are, or if no daemon runs."""
        return self.reader.trouble

    def _ask(self, page: Page) -> Answer:
        # The daemon may have started since the last look.
        self.reader.look()
        answer = self._pages.ask(page)
        if answer.refused:
            print(f"page refused: {answer.refused}", file=sys.stderr, flush=True)
        return answer

    def step(self) -> None:
        """Answer commands, and send the estimates that have come since the last step."""
        self.transport.wait(_FETCH_S)
        now = time.monotonic()
        if now - self._looked >= _LOOK_S:
            self._looked = now
            self.reader.look()
            self._image.parameters = self.reader.parameters
        self.transport.send(filter(None, map(self._slave.answer, self.transport.receive())))
        samples, estimates, lost = self.reader.take()
        data: list[bytes] = []
        for page, corner, time_ns in zip(
            self._image.pages_of(samples, estimates), estimates["corner"].tolist(), estimates["time_ns"].tolist(), strict=True
        ):
            self._image.show(corner, page)
            data += self._slave.data(corner, time_ns)
        if self._slave.acquiring:
            lost += self.transport.send([self._slave.overload()] * self._overloaded + data)
            self._overloaded = lost > 0
        if self.transport.gone:
            self._slave.end()
