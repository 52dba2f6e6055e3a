"""The UDS server's loop: receives broadcasts like the monitor, and answers requests over ISO-TP (ISO 15765-2).

It shares with the daemon only the bus, and files and memory that it reads; it may be killed at any moment.
"""

import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from emb_daemon import __version__
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import calibration_hash, load_calibration
from emb_daemon.errors import InputError
from emb_daemon.estimator.status import names, sentences
from emb_daemon.monitor.listener import Corner, Listener
from emb_daemon.runtime.bus import Bus
from emb_daemon.runtime.shared import PresentEstimates
from emb_daemon.wire.contract import INIT, INVALID
from emb_daemon.wire.frames import FRAME, payloads_to
from emb_daemon.wire.layout import CLAMP_FORCE, CORNERS, ESTIMATOR_STATUS, PAD_TEMP
from emb_daemon.workshop.trouble import Frame, TroubleMemory
from emb_daemon.workshop.uds import FREEZE_FRAME, Server

#: Data identifiers, to which the corner's number is added: hash of the calibration, learned values, present estimate, and the
#: estimator's facts in words.
SOFTWARE, CALIBRATION, LEARNED, ESTIMATE, FACTS = 0xF189, 0x1000, 0x1010, FREEZE_FRAME, 0x1120
#: Pause after which all frames are taken together; otherwise each frame would wake the process.
_PAUSE_S = 0.02


def frame_of(corner: Corner, shared: np.void | None, time_s: int) -> Frame:
    """Freeze frame of a corner's present broadcasts, and of its ESTIMATE if the daemon shares it."""
    force, heat, status = (corner.streams[kind] for kind in (CLAMP_FORCE, PAD_TEMP, ESTIMATOR_STATUS))
    force_N, sigma_N = (None if kN is None else 1e3 * kN for kN in (force.value(0), force.value(1)))

    def path(field: str) -> float | None:
        return float(shared[field]) if shared is not None and math.isfinite(shared[field]) else None

    return Frame(
        time_s=time_s,
        mode=int(status.values[0]) if status.values else INIT,
        source=int(force.values[3]) if force.values else INVALID,
        force_N=force_N,
        sigma_N=sigma_N,
        temperatures_C=tuple(heat.value(column) for column in range(4)),
        contact_angle_rad=status.value(2),
        stiffness_factor=status.value(1),
        stiffness_force_N=path("stiffness_force"),
        stiffness_sigma_N=path("stiffness_sigma"),
        torque_force_N=path("torque_force"),
        torque_sigma_N=path("torque_sigma"),
        facts=None if shared is None else names(int(shared["facts"])),
    )


def data_of(
    configuration: Path, state: Path, corners: list[Corner], shared: PresentEstimates
) -> dict[int, Callable[[], bytes]]:
    """Functions that read each data identifier, from files and estimates as they are at the time of the request. Raises
    InputErrors: the configuration is faulty."""
    memory, corners_of = Memory(state), Setup(configuration).configuration.corners

    def calibration(name: str) -> bytes:
        # The file as it is now. The daemon reads it only on a reload, and refuses it if it is faulty.
        try:
            return calibration_hash(load_calibration(configuration.parent / corners_of[name].calibration)).encode()
        except InputError:
            return b"faulty file"

    def learned(name: str) -> bytes:
        try:
            store = memory.read(name)
        except (ValueError, OSError):
            return b"damaged file"
        current = store.current if store else None
        return json.dumps({"date": current.date, "values": current.values} if current else {}).encode()

    def present(row: int) -> bytes:
        return frame_of(corners[row], shared.of(row), round(time.time())).encode()

    def facts(row: int) -> bytes:
        estimate = shared.of(row)
        return b"not known" if estimate is None else sentences(int(estimate["facts"])).encode()

    found: dict[int, Callable[[], bytes]] = {SOFTWARE: __version__.encode}
    for name in corners_of:
        row = CORNERS.index(name)
        found[CALIBRATION + row] = partial(calibration, name)
        found[LEARNED + row] = partial(learned, name)
        found[ESTIMATE + row] = partial(present, row)
        found[FACTS + row] = partial(facts, row)
    return found


class Diagnostics:
    """Answers a tester on a bus that receives the broadcasts and ``request_id`` (`ids`), by 11-bit ids. ``configuration`` and
    ``state`` are the daemon's; the trouble codes are stored in ``state`` too. Its file of ``estimates`` (`runtime.shared`)
    need not exist."""

    def __init__(self, bus: Bus, configuration: Path, state: Path, request_id: int, response_id: int, estimates: Path):
        """Raises InputErrors for a faulty configuration, OSError for a folder that cannot be written, ImportError without
        can-isotp."""
        import isotp

        self._bus, self._request_id = bus, request_id
        self._not_stored, self._shared = "", PresentEstimates(estimates)
        self.listener: Listener = Listener()
        self.memory: TroubleMemory = TroubleMemory(state)
        self._evaluated = [0] * len(CORNERS)
        self._server = Server(self.memory, data_of(configuration, state, self.listener.corners, self._shared))
        self._requests: list = []
        self._message = isotp.CanMessage
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, rxid=request_id, txid=response_id)
        self._transport = isotp.TransportLayerLogic(
            rxfn=lambda timeout: self._requests.pop(0) if self._requests else None,
            txfn=self._send,
            address=address,
            # All frames are padded to eight bytes, because the bus writes no others.
            params={"tx_padding": 0xCC, "blocking_send": False},
        )

    def _send(self, message) -> None:
        frame = np.zeros(1, FRAME)
        frame["can_id"], frame["length"] = message.arbitration_id, 8
        frame["data"] = int.from_bytes(bytes(message.data), "little")
        self._bus.send(frame)

    @property
    def trouble(self) -> str:
        """What freeze frames lack, and why the trouble codes could not be stored the last time; empty if there is neither."""
        lacking = f"{self._shared.trouble}; freeze frames are without forces of the paths and facts"
        return "\n".join(filter(None, [self._shared.trouble and lacking, self._not_stored]))

    def step(self) -> None:
        """Take all frames that have arrived, and send what is due."""
        time.sleep(_PAUSE_S)
        frames = self._bus.drain()
        # Only the newest frame of each message is used, which is five times less work.
        _, newest = np.unique(frames["can_id"][::-1], return_index=True)
        self.listener.receive(frames[::-1][newest])
        for data in payloads_to(self._request_id, frames):
            self._requests.append(self._message(arbitration_id=self._request_id, data=data))
        now = time.monotonic()
        self._shared.follow(time.monotonic_ns())
        for row, corner in enumerate(self.listener.corners):
            status = corner.streams[ESTIMATOR_STATUS]
            if status.received != self._evaluated[row]:
                self._evaluated[row] = status.received
                mode, reasons = int(status.values[0]), int(status.values[3])
                frame = frame_of(corner, self._shared.of(row), round(time.time()))
                try:
                    self.memory.evaluate(row, mode, reasons, frame, now)
                except OSError as error:
                    # Codes that cannot be stored can still be read; storing is tried again with the next message.
                    self._not_stored = f"{self.memory.path}: {error.strerror}"
        # Once for each frame: a request may be complete, the first frame of its answer due, and a flow control waiting.
        for _ in range(2 + len(self._requests)):
            self._transport.process()
            while self._transport.available():
                if response := self._server.answer(bytes(self._transport.recv()), now):
                    self._transport.send(response)
