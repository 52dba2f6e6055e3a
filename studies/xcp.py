"""Whether a measurement tool gets every estimate: the real daemon and a simulated car on a bus, the XCP server beside them,
and a small master that measures four corners at 250 Hz.

``python -m studies.xcp SECONDS``. Counted are rows that the daemon has written, data packets that came, gaps of the packet
counter and overloads that the server reported; and what the writing costs the loop. Exit status 1 if one packet is missing.
"""

import contextlib
import os
import socket
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE
from emb_daemon.interface.signals import INPUTS, OUTPUTS
from emb_daemon.resources import shipped_configuration
from emb_daemon.runtime.shared import SHARED, SharedEstimates
from emb_daemon.wire.layout import CORNERS
from emb_daemon.workshop.image import address_of

MEASURED = ("angle_rad", "clamp_force_N", "clamp_force_sigma_N", "torque_force_N", "mode", "reasons")
_NAMES = [signal.name for signal in INPUTS + OUTPUTS]


class Master:
    """A measurement tool on UDP, as far as acquisition needs one.

    Attributes:
        packets: number of data packets by ODT number.
        stamps: their time stamps by ODT number, µs, modulo 2^32.
        gaps, overloads: packets that are missing by the packet counter; overload events of the server.
    """

    def __init__(self, port: int):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(2.0)
        self._sent, self._expected = 0, None
        self.packets: dict[int, int] = {}
        self.stamps: dict[int, list[int]] = {}
        self.gaps = self.overloads = 0

    def ask(self, layout: str, *values: int) -> bytes:
        """The response to a command; data packets that come meanwhile are counted."""
        packet = struct.pack("<" + layout, *values)
        self._socket.send(struct.pack("<HH", len(packet), self._sent & 0xFFFF) + packet)
        self._sent += 1
        while True:
            if response := self.receive():
                if response[0] != 0xFF:
                    raise RuntimeError(f"{packet.hex()} was answered by {response.hex()}")
                return response

    def receive(self) -> bytes:
        """Take a datagram; returns the response in it, empty if there is none."""
        datagram, response = self._socket.recv(65536), b""
        while datagram:
            length, counter = struct.unpack_from("<HH", datagram)
            packet, datagram = datagram[4 : 4 + length], datagram[4 + length :]
            if self._expected is not None:
                self.gaps += (counter - self._expected) & 0xFFFF
            self._expected = (counter + 1) & 0xFFFF
            if packet[0] >= 0xFE:
                response = packet
            elif packet[0] == 0xFD:
                self.overloads += 1
            elif packet[0] < 0xFC:
                self.packets[packet[0]] = self.packets.get(packet[0], 0) + 1
                self.stamps.setdefault(packet[0], []).append(struct.unpack_from("<I", packet, 1)[0])
        return response

    def measure(self, names: tuple[str, ...]) -> None:
        """Begin to acquire signals of all corners, a list for each."""
        self.ask("BB", 0xFF, 0)
        self.ask("B", 0xD6)
        self.ask("BxH", 0xD5, len(CORNERS))
        for corner in range(len(CORNERS)):
            self.ask("BxHB", 0xD4, corner, 1)
        for corner in range(len(CORNERS)):
            self.ask("BxHBB", 0xD3, corner, 0, len(names))
        for corner in range(len(CORNERS)):
            self.ask("BxHBB", 0xE2, corner, 0, 0)
            for name in names:
                self.ask("BBBBI", 0xE1, 0xFF, 4, 0, address_of(corner, _NAMES.index(name)))
            self.ask("BBHHBB", 0xE0, 0x10, corner, corner, 1, 0)
            self.ask("BBH", 0xDE, 2, corner)
        self.ask("BB", 0xDD, 1)

    def close(self) -> None:
        self._socket.close()


def cost_us() -> tuple[float, float]:
    """Median and 99 % quantile of the time to write four rows, over a hundred thousand repetitions."""
    pipeline = SimpleNamespace(
        samples=np.zeros(4096, SAMPLE), estimates=np.zeros(4096, ESTIMATE), parameters=np.zeros(4, PARAMETERS)
    )
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        shared, spent = SharedEstimates(Path(folder) / "estimates", pipeline), np.zeros(100_000)
        for index in range(len(spent)):
            begin = time.perf_counter_ns()
            shared.write(4)
            spent[index] = time.perf_counter_ns() - begin
        shared.close()
    return float(np.median(spent)) / 1e3, float(np.quantile(spent, 0.99)) / 1e3


def main() -> int:
    seconds = float(sys.argv[1])
    group, command = f"239.74.165.{os.getpid() % 250 + 3}", [sys.executable, "-m", "emb_daemon.cli.main"]
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        folder = Path(name)
        shipped_configuration(folder, CORNERS, "log_level: error")
        bus, config, share = ["-i", "udp_multicast", "-c", group], ["--config", folder / "emb.yaml"], folder / "estimates"
        children = [
            subprocess.Popen([*command, "run", *config, "--share", share, *bus]),
            subprocess.Popen([*command, "simulate", *bus], stdout=subprocess.DEVNULL),
            subprocess.Popen(
                [*command, "xcp", *config, "--share", share, "--udp", "127.0.0.1:0"],
                stdout=subprocess.PIPE, text=True, env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
            ),
        ]  # fmt: skip
        # A car's controllers do not wait for others that want the processor.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(children[1].pid, os.SCHED_FIFO, os.sched_param(70))
        try:
            said = children[2].stdout.readline()
            port = int(said.split()[3].rstrip(":").rpartition(":")[2])
            return _judge(port, share, seconds)
        finally:
            for child in children:
                child.terminate()
            for child in children:
                child.wait()


def _judge(port: int, share: Path, seconds: float) -> int:
    written = np.zeros(1, np.int64)
    while written[0] < 1000:
        time.sleep(0.1)
        if share.exists():
            # Each time anew: a daemon that had to compile starts a second time.
            written = np.memmap(share, np.int64, "r", SHARED.fields["written"][1], (1,))
    master = Master(port)
    master.measure(MEASURED)
    begin, first = time.monotonic(), int(written[0])
    while time.monotonic() - begin < seconds:
        master.receive()
    rows = int(written[0]) - first
    master.ask("BB", 0xDD, 0)
    master.ask("B", 0xFE)
    master.close()
    came = sum(master.packets.values())
    steps = np.concatenate([np.diff(np.array(stamps, np.uint32)).astype(np.int32) for stamps in master.stamps.values()])
    print(f"{seconds:g} s: {rows} rows written, {came} packets came, {came / seconds / len(CORNERS):.2f} a second and corner")
    print(f"lost: {master.gaps} by the packet counter, {master.overloads} overloads")
    print(f"steps of the time stamps, ms: median {np.median(steps) / 1e3:.3f}, longest {steps.max() / 1e3:.1f}")
    print("writing four rows costs the loop {:.2f} µs (median), {:.2f} µs (99 %)".format(*cost_us()))
    # Packets that were on their way at begin and end.
    complete = abs(came - rows) <= 64
    return int(bool(master.gaps or master.overloads or not complete))


if __name__ == "__main__":
    sys.exit(main())
