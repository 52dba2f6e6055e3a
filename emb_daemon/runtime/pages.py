"""Online calibration: requests of the XCP server to the daemon, over a socket in the folder of the shared estimates.

A `Page` contains the numbers in which each corner's calibration is to differ from its file. Only the daemon's user and root
can use the socket. A page is never stored: it ends with the server that requested it, with a reload, and with the daemon.
"""

import contextlib
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.parameters import keys, moved
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.runtime.journal import log

#: The largest request: every number of four corners.
_MOST_BYTES = 200_000
#: A page that could not be checked within this time is dropped; the server waits for the answer a little longer.
PATIENCE_S = 3.0
_ANSWERED_S = PATIENCE_S + 1.0


def tunable(calibration: Calibration) -> list[str]:
    """Keys of the numbers that a page may set: all except adaptation's limits, because nothing is learned while a page is in
    use."""
    return [key for key in keys(calibration) if not key.startswith("adaptation.")]


class Page(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers by corner and key, and for each of these corners the hash of the calibration of its file."""

    values: dict[str, dict[str, float]]
    files: dict[str, str]

    def apply(self, calibrations: Mapping[str, Calibration]) -> dict[str, Calibration]:
        """The calibrations of the files with the page's numbers, checked like a file. Raises InputError: every fault found."""
        faults: list[str] = []
        result = dict(calibrations)
        for name, values in self.values.items():
            if name not in calibrations:
                faults.append(f"corner {name}: not estimated")
                continue
            calibration = calibrations[name]
            if self.files.get(name) != calibration_hash(calibration):
                faults.append(
                    f"corner {name}: the calibration file has changed since the page was made: restart emb-daemon xcp"
                )
                continue
            known = set(tunable(calibration))
            faults += [f"corner {name}: {key}: not a number that a page may set" for key in values if key not in known]
            if known.issuperset(values):
                try:
                    result[name] = moved(calibration, values, checked=True)
                except InputError as error:
                    faults += [f"corner {name}: {fault}" for fault in error.faults]
        if faults:
            raise InputError("; ".join(faults))
        return result


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Why a page was refused, empty if it was taken; ``later``: it may be taken under other circumstances."""

    refused: str = ""
    later: bool = False


class Request:
    """A page requested at ``asked_ns``, the calibrations ``read`` for it by ``read_ns``, and the answer to wait for."""

    def __init__(self, page: Page):
        self.page = page
        self.asked_ns: int = time.monotonic_ns()
        self.read: dict[str, Calibration] = {}
        self.read_ns: int | None = None
        #: Why the page is refused; the check sets it to nothing if the page is good.
        self.fault = "could not be checked"
        self._answer: queue.SimpleQueue = queue.SimpleQueue()

    def answer(self, answer: Answer) -> None:
        """Give the answer; never waits."""
        self._answer.put(answer)

    def wait(self) -> Answer:
        return self._answer.get()


def socket_path(estimates: Path) -> Path:
    """Path of the socket, next to the file of the estimates."""
    return estimates.with_name(estimates.name + ".pages")


class PageListener:
    """The daemon's side, in a thread, which hands a request to the daemon by ``ask``, and calls ``end`` when a server that had
    requested something has gone."""

    def __init__(self, path: Path, ask: Callable[[Request], None], end: Callable[[], None]):
        """Raises Unavailable if the socket cannot be made."""
        self._path, self._ask, self._end = path, ask, end
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
        try:
            with contextlib.suppress(FileNotFoundError):
                path.unlink()
            # Set before the socket is created, so that no other user can connect in between.
            os.fchmod(self._listener.fileno(), 0o600)
            self._listener.bind(str(path))
            self._listener.listen(1)
        except OSError as error:
            raise Unavailable(f"{path}: {error.strerror or error}") from None
        threading.Thread(target=self._run, name="pages", daemon=True).start()

    def _run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                while content := connection.recv(_MOST_BYTES):
                    connection.send(msgspec.json.encode(self._answer(content)))
            self._end()

    def _answer(self, content: bytes) -> Answer:
        try:
            request = Request(msgspec.json.decode(content, type=Page))
        except (msgspec.DecodeError, RecursionError) as error:
            log.error("page refused: not understood: %s", error)
            return Answer(f"not understood: {error}")
        self._ask(request)
        return request.wait()

    def close(self) -> None:
        """Remove the socket, and end the thread unless a server is connected."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._path.unlink(missing_ok=True)


class PageClient:
    """The server's side: its connection is what keeps a page in use."""

    def __init__(self, path: Path):
        self._path = path
        self._connection: socket.socket | None = None

    def ask(self, page: Page) -> Answer:
        """The daemon's answer, or one made here if no daemon answers."""
        for _ in range(2):
            # Whether the daemon has closed a connection shows only when it is used.
            known = self._connection is not None
            try:
                answered = self._exchange(msgspec.json.encode(page))
                if answered:
                    return msgspec.json.decode(answered, type=Answer)
            except TimeoutError:
                self.close()
                return Answer("the daemon did not answer in time", later=True)
            except (OSError, msgspec.DecodeError) as error:
                failed = f"{self._path}: {error}"
            else:
                failed = f"{self._path}: the daemon has ended"
            self.close()
            if not known:
                break
        return Answer(failed, later=True)

    def _exchange(self, content: bytes) -> bytes:
        if self._connection is None:
            self._connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
            self._connection.settimeout(_ANSWERED_S)
            self._connection.connect(str(self._path))
        self._connection.send(content)
        return self._connection.recv(_MOST_BYTES)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
