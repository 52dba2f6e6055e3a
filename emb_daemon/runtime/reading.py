"""Reads calibrations for a reload in a process of its own.

A thread of the loop's process would hold the interpreter while it reads, and where other processes keep it from its CPU it
holds it for as long as they run: no priority of the loop helps against that. What the loop's process is left with is to make
objects of what has changed.
"""

import contextlib
import os
import signal
import traceback
from collections.abc import Mapping
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec

from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.runtime.pages import Page


class _Asked(msgspec.Struct):
    path: str
    in_use: dict[str, str]
    page: Page | None


class _Answered(msgspec.Struct):
    changed: dict[str, Calibration] = {}
    fault: str = ""


def differing(calibrations: Mapping[str, Calibration], in_use: Mapping[str, str]) -> dict[str, Calibration]:
    """Those of the calibrations by corner whose hash is not the one ``in_use``."""
    return {name: found for name, found in calibrations.items() if calibration_hash(found) != in_use[name]}


def read_calibrations(path: Path, in_use: Mapping[str, str], page: Page | None) -> dict[str, Calibration]:
    """Calibrations by corner that differ from those in use, by hash, with the numbers of a page if one is asked for. Raises
    InputError: every fault of the configuration, of its files and of the page, and other corners than those in use."""
    setup = Setup(path)
    if setup.calibrations.keys() != in_use.keys():
        raise InputError(f"{path}: corners: a reload cannot change them; restart the daemon")
    return differing(page.apply(setup.calibrations) if page else setup.calibrations, in_use)


class Reader:
    """`read_calibrations`, after `begin` in a child process."""

    def __init__(self) -> None:
        self._pipe: Connection | None = None
        self._child = 0

    def begin(self) -> None:
        """Make the child, a copy of this process: before this one has other threads, sockets, locked files and locked memory.
        The child ends with it."""
        ours, theirs = Pipe()
        # What interrupts or reloads every process of that name is meant for the other, with which this one ends. Held back
        # from before it is there, because the copied handlers, or none, would be those until it ignores them.
        of_the_other = {signal.SIGINT, signal.SIGHUP}
        before = signal.pthread_sigmask(signal.SIG_BLOCK, of_the_other)
        self._child = os.fork()
        if self._child == 0:
            ours.close()
            for number in of_the_other:
                signal.signal(number, signal.SIG_IGN)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            try:
                _serve(theirs)
            except (EOFError, OSError):
                pass
            except BaseException:
                traceback.print_exc()
            # Not back through the copied stack, whatever happened.
            os._exit(0)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self._pipe = ours

    def read(self, path: Path, in_use: Mapping[str, str], page: Page | None = None) -> dict[str, Calibration]:
        """As `read_calibrations`. Raises InputError also if the child is gone: what it did not survive is not read here."""
        if self._pipe is None:
            return read_calibrations(path, in_use, page)
        try:
            self._pipe.send_bytes(msgspec.msgpack.encode(_Asked(str(path), dict(in_use), page)))
            answered = msgspec.msgpack.decode(self._pipe.recv_bytes(), type=_Answered)
        except (EOFError, OSError):
            raise InputError(f"{path}: the process that reads calibrations has ended: restart the daemon") from None
        if answered.fault:
            raise InputError(answered.fault)
        return answered.changed

    def close(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self._child, 0)


def _serve(pipe: Connection) -> None:
    """Answer requests until there is nobody who asks."""
    while True:
        asked = msgspec.msgpack.decode(pipe.recv_bytes(), type=_Asked)
        try:
            answered = _Answered(read_calibrations(Path(asked.path), asked.in_use, asked.page))
        except InputError as error:
            answered = _Answered(fault=str(error))
        pipe.send_bytes(msgspec.msgpack.encode(answered))
