"""Main loop of the servers that run as processes of their own next to the daemon."""

import signal
import sys
from typing import Protocol


class Server(Protocol):
    """``step`` answers pending requests and waits a moment; ``trouble``: what prevents that, or empty."""

    trouble: str

    def step(self) -> None: ...


def stop_signals() -> list[bool]:
    """A list that is empty until SIGTERM or SIGINT."""
    stopped: list[bool] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(True))
    return stopped


def serve(server: Server, greeting: str) -> None:
    """Print ``greeting`` and step the server until SIGTERM or SIGINT; print its trouble to standard error when it changes."""
    stopped, printed = stop_signals(), ""
    print(greeting, flush=True)
    while not stopped:
        server.step()
        if server.trouble != printed:
            printed = server.trouble
            if printed:
                print(printed, file=sys.stderr, flush=True)
