"""What the programs beside the daemon do until they are stopped."""

import signal
import sys
from typing import Protocol


class Server(Protocol):
    """``step`` answers what was asked meanwhile and waits a moment; ``trouble`` says what keeps it from that, or nothing."""

    trouble: str

    def step(self) -> None: ...


def stop_signals() -> list[bool]:
    """Empty until SIGTERM or SIGINT."""
    stopped: list[bool] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(True))
    return stopped


def serve(server: Server, greeting: str) -> None:
    """Print that it is there, and step it until SIGTERM or SIGINT; a trouble is printed to standard error when it changes."""
    stopped, told = stop_signals(), ""
    print(greeting, flush=True)
    while not stopped:
        server.step()
        if server.trouble != told:
            told = server.trouble
            print(told, file=sys.stderr, flush=True)
