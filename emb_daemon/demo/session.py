"""Simulated car and daemon, each in a thread of its own, on the two ends of a bus inside this process."""

import contextlib
import logging
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.calibration.configuration import Setup
from emb_daemon.demo.recorder import Recorder
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.resources import shipped_configuration
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.runtime.journal import log
from emb_daemon.runtime.rawcan import socket_pair
from emb_daemon.runtime.realtime import settle_memory, use_fifo
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import CORNERS

if TYPE_CHECKING:
    from rich.console import Console

#: Period of the view and of lines, s.
_VIEW_S, _LINE_S = 0.25, 3.0
_COMPILING = "Loading compiled code (the first time it is compiled, which takes a minute)"
_DAEMON_PRIORITY = 60
#: Seed of the brakes' tolerances and of all noise.
_SEED = 1


class _LastMessages(logging.Handler):
    """The daemon's last log lines, for the view."""

    def __init__(self):
        super().__init__()
        self.lines: deque[str] = deque(maxlen=4)

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname.lower()}: {record.getMessage()}")


class Session:
    """One demonstration, a drive of ``seconds`` with 1 to 4 corners, FL first. ``recorder``: truth and broadcasts; ``daemon``,
    ``live``: the daemon and the car, for their counts."""

    def __init__(self, corners: int, seconds: float):
        self.seconds = seconds
        names = CORNERS[:corners]
        self._folder = tempfile.TemporaryDirectory(prefix="emb-daemon-demo-")
        setup = Setup(shipped_configuration(Path(self._folder.name), names))
        plants = np.array([plant_from_calibration(setup.calibrations[name], _SEED + row) for row, name in enumerate(names)])
        ours, theirs = socket_pair()
        self._buses = (ours, theirs)
        self.daemon: Daemon = Daemon(setup, theirs)
        self.live: LiveCar = LiveCar(Car(plants, names, _SEED), ours, city_drive())
        self.recorder: Recorder = Recorder(names, seconds)
        self._stop = threading.Event()
        self._failures: list[BaseException] = []

    def warm_up(self) -> None:
        self.daemon.warm_up()
        self.live.warm_up()
        self.recorder.compare(0)
        for sender, receiver in (self._buses, self._buses[::-1]):
            sender.send(np.zeros(1, FRAME))
            receiver.drain()
        settle_memory()

    def run(self, show: Callable[[], None], period_s: float) -> None:
        """Drive, calling ``show()`` in this thread every ``period_s``; ends early and cleanly on KeyboardInterrupt."""
        drive = (self._stop.is_set, self.seconds, self.recorder.note_sent, self.recorder.note_received)
        daemon = threading.Thread(target=self._guard, args=(_DAEMON_PRIORITY, self.daemon.run), name="daemon")
        # The car has priority, because a real car does not wait for the daemon.
        car = threading.Thread(target=self._guard, args=(_DAEMON_PRIORITY + 1, self.live.run, *drive), name="car")
        daemon.start()
        car.start()
        try:
            with contextlib.suppress(KeyboardInterrupt):
                while car.is_alive() and not self._failures:
                    car.join(period_s)
                    if self.recorder.count:
                        show()
        finally:
            self._stop.set()
            car.join()
            self.daemon.stop()
            daemon.join()
            for bus in self._buses:
                bus.close()
            self._folder.cleanup()
        if self._failures:
            raise self._failures[0]

    def _guard(self, priority: int, target, *arguments) -> None:
        try:
            log.info("%s: %s", threading.current_thread().name, use_fifo(priority))
            target(*arguments)
        except BaseException as error:
            self._failures.append(error)


def _summary(session: Session) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    recorder = session.recorder
    table = Table(title="Estimate from the bus against the simulated truth", title_justify="left", box=SIMPLE_HEAD)
    for heading in ("corner", "RMSE", "bias", "95 %", "largest", "within 2 σ", "answered", "response 50/99 %"):
        table.add_column(heading, justify="right")
    for row, corner in enumerate(recorder.corners):
        comparison = recorder.compare(row)
        figures = comparison.figures()
        median, tail = (
            (1e3 * np.percentile(comparison.response_s, (50, 99))) if len(comparison.response_s) else (np.nan, np.nan)
        )
        table.add_row(
            corner,
            *(f"{figures[name]:.0f} N" for name in ("rmse", "bias", "p95", "max")),
            f"{100.0 * figures['within_2_sigma']:.1f} %",
            f"{len(comparison.time_s)}/{comparison.samples}",
            f"{median:.2f}/{tail:.2f} ms",
        )
    console = Console() if sys.stdout.isatty() else Console(width=110)
    console.print(table)
    daemon, live = session.daemon, session.live
    console.print(
        f"Daemon: {daemon.ticks} ticks, {daemon.missed} missed. Car: {live.ticks} cycles, {live.late} late, {live.lost} lost"
        " (the machine's scheduling; both share one process)."
    )


def _run_with_view(session: Session, console: "Console", messages: deque[str]) -> None:
    from rich.live import Live

    from emb_daemon.demo.view import render

    with console.status(_COMPILING):
        session.warm_up()
    with Live(console=console, screen=True, auto_refresh=False) as view:

        def show() -> None:
            width, height = console.size
            shown = render(session.recorder, session.daemon, session.live, list(messages), width, height)
            view.update(shown, refresh=True)

        session.run(show, _VIEW_S)


def _run_with_lines(session: Session) -> None:
    """For output that is no terminal: a line every few seconds."""
    from emb_daemon.demo.view import line

    print(_COMPILING, flush=True)
    session.warm_up()
    session.run(lambda: print(line(session.recorder, session.daemon, session.live), flush=True), _LINE_S)


def run_demo(corners: int, seconds: float, picture: Path) -> int:
    """Live view, summary, picture; returns the exit status."""
    from rich.console import Console

    from emb_daemon.demo.picture import save_picture

    handler = _LastMessages()
    log.handlers[:] = [handler]
    log.propagate = False
    log.setLevel(logging.INFO)
    console, session = Console(), Session(corners, seconds)
    if console.is_terminal:
        _run_with_view(session, console, handler.lines)
    else:
        _run_with_lines(session)
    if session.recorder.cycles < 2 or not session.recorder.count:
        print("ended before the first estimate", file=sys.stderr)
        return 0
    _summary(session)
    save_picture(session.recorder, picture)
    print(f"Picture: {picture}")
    return 0
