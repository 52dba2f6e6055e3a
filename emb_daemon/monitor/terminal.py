"""The monitor's loop: bus in, screen out, keys."""

import contextlib
import select
import sys
import termios
import time
import tty

from emb_daemon.errors import Unavailable
from emb_daemon.monitor.listener import SECOND_NS, Listener
from emb_daemon.runtime.bus import Bus

_DRAIN_S, _DRAW_NS = 0.05, 250_000_000
#: Time to wait for the first frame: a running daemon sends every 4 ms, but its bus may not be up yet.
_WAIT_S = 3.0


@contextlib.contextmanager
def _keys():
    """Keys as they are pressed, without Enter or echo: yields ``read(timeout_s)``, the key or an empty string."""
    if not sys.stdin.isatty():

        def sleep(timeout_s: float) -> str:
            time.sleep(timeout_s)
            return ""

        yield sleep
        return
    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)

    def read(timeout_s: float) -> str:
        return sys.stdin.read(1) if select.select([handle], [], [], timeout_s)[0] else ""

    tty.setcbreak(handle)
    try:
        yield read
    finally:
        termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _listener(bus: Bus) -> Listener:
    """A listener that begins now: the socket's buffer holds only part of the frames that came while the program loaded."""
    listener = Listener()
    bus.drain()
    return listener


def watch(bus: Bus, title: str) -> None:
    """Show broadcasts on the terminal until the user quits."""
    from rich.console import Console
    from rich.live import Live

    from emb_daemon.monitor.view import render

    listener, console = _listener(bus), Console()
    drawn_ns, paused = 0, False
    with _keys() as read, Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            key = read(_DRAIN_S)
            if key in ("q", "Q", "\x04"):
                return
            if key in ("r", "R"):
                listener.reset()
            listener.receive(bus.drain())
            now = time.monotonic_ns()
            pressed = key == " "
            paused ^= pressed
            if pressed or (not paused and now - drawn_ns >= _DRAW_NS):
                drawn_ns = now
                width, height = console.size
                live.update(render(listener, now, title, width, height, paused), refresh=True)


def listen(bus: Bus) -> tuple[Listener, int]:
    """Listen until one complete second of the clock was received; returns listener and time. Raises Unavailable: nothing is
    received for some seconds."""
    listener, start = _listener(bus), time.monotonic_ns()
    received_ns = 0
    while True:
        bus.wait(_DRAIN_S)
        listener.receive(bus.drain())
        now = time.monotonic_ns()
        if not received_ns and listener.active:
            received_ns = now
        if received_ns and now // SECOND_NS > received_ns // SECOND_NS + 1:
            return listener, now
        if not received_ns and now - start > _WAIT_S * SECOND_NS:
            raise Unavailable(
                f"bus: no broadcast of a daemon (0x200 to 0x233) within {_WAIT_S:g} s; is a daemon running on this bus?"
            )
