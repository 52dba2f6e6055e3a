"""sd_notify without a dependency: one datagram to the socket that systemd names in the environment."""

import contextlib
import os
import socket
from collections.abc import Mapping


class ServiceManager:
    """Speaks to systemd if it started us, and is silent otherwise."""

    def __init__(self, environment: Mapping[str, str] = os.environ):
        address = environment.get("NOTIFY_SOCKET", "")
        self._socket = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.connect("\0" + address[1:] if address[0] == "@" else address)
            self._socket.setblocking(False)
        ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        #: Watchdog's timeout in s, or None.
        self.watchdog_s: float | None = (
            int(environment["WATCHDOG_USEC"]) / 1e6 if ours and "WATCHDOG_USEC" in environment else None
        )

    def notify(self, *assignments: str) -> None:
        """Send assignments such as ``READY=1`` or ``STATUS=…``; a full socket must not hold up the loop."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send("\n".join(assignments).encode())
