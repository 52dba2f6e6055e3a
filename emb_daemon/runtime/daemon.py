"""The loop: wake when a sample is due, drain, step, send.

Deadlines are absolute and follow the senders. Each corner's next sample is expected one period after its last, and the loop
sleeps until just after that, so that one system call drains a complete sample and the estimate leaves at once. Samples of
several corners that arrive together are estimated together. If a sample is late the loop waits for it on the bus; if nothing
arrives it keeps ticking by itself, so that a missing sender is reported too.
"""

import math
import threading
import time
from pathlib import Path

import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory, Store
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.fuse import fuse, take_sides
from emb_daemon.estimator.nearer import nearer_odds
from emb_daemon.estimator.records import ESTIMATE, STATE
from emb_daemon.estimator.step import step
from emb_daemon.jit import Array, compile_beside, compile_within, entry, njit
from emb_daemon.pipeline import LATE_CYCLES, SHOWN_NS, Pipeline
from emb_daemon.runtime.bus import Bus
from emb_daemon.runtime.changes import ChangeLog
from emb_daemon.runtime.journal import log, note
from emb_daemon.runtime.pages import PATIENCE_S, Answer, PageListener, Request, socket_path
from emb_daemon.runtime.reading import Reader, differing
from emb_daemon.runtime.shared import SharedEstimates
from emb_daemon.runtime.systemd import ServiceManager
from emb_daemon.wire import contract
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import ERROR, FRAME
from emb_daemon.wire.layout import CORNER_MESSAGES, CORNERS, CURRENT, RESOLVER
from emb_daemon.wire.receive import RECEPTION

#: Time from the expected sample to the wake-up: more than the senders' jitter, so that the sample is complete when the loop
#: wakes.
_MARGIN_NS = 200_000
#: Time that a frame may take from its stamp into the queue before the loop treats it as missing. The loop waits for so long,
#: so that a replay of the recorded bus, which has only the stamps, makes the same decision.
QUEUED_NS = 1_000_000
#: Samples expected within this time of each other are estimated in one tick.
_TOGETHER_NS = 400_000
_STATUS_NS = 10_000_000_000
#: Periods, 30 s, of which most may be missed before a restart is wanted. Late answers say that they are late; a start may take
#: as long, without any, and what driving told about temperatures and wear is then less certain for minutes.
_PATIENCE = 7_500
#: Time for which a page that was read waits until the car is seen at rest: reading may have delayed the loop's reception.
_SETTLING_NS = 500_000_000
_OF_THE_LOOP = contract.BUS_DISTURBED | contract.DEADLINE_MISSED


class Pacer:
    """Decides when to wake next, from the arrival times of the samples."""

    def __init__(self, now_ns: int):
        self._arrived_ns: dict[int, int] = {}
        self.last_tick_ns = now_ns

    def note_arrival(self, corner: int, time_ns: int) -> None:
        """A sample of ``corner`` was complete at ``time_ns``."""
        self._arrived_ns[corner] = time_ns

    def next_wake(self, now_ns: int) -> int:
        """Time of the next tick; not later than a period after the last one. In the past if a sample is overdue."""
        wakes = []
        for corner, arrived in list(self._arrived_ns.items()):
            if now_ns - arrived > (LATE_CYCLES + 1) * CYCLE_NS:
                # Until its next sample the corner gets predictions, at the loop's own pace.
                del self._arrived_ns[corner]
            else:
                # A sample that is a whole period late is lost: expect the next.
                periods = max(1, -(-(now_ns - arrived) // CYCLE_NS) - 1)
                wakes.append(arrived + periods * CYCLE_NS + _MARGIN_NS)
        free = self.last_tick_ns + CYCLE_NS
        if not wakes:
            return free
        first = min(wakes)
        together = max(wake for wake in wakes if wake <= first + _TOGETHER_NS)
        return min(together, free + _MARGIN_NS)


@entry(Array(ESTIMATE), int, Array(STATE), Array(RECEPTION), Array(np.int64), Array(np.int64), Array(np.int64), returns=3)
def _scan(estimates, count, states, receptions, arrivals, reported, facts):
    """Scan new estimates for the loop. Sets ``arrivals`` to the time at which each corner's sample was complete
    (0: none), ``reported`` to mode and reasons, and ``facts`` to what the estimator found. Returns bit masks of corners:
    estimated; with a state that is not a number; with changed mode or reasons."""
    estimated, lost, changed = 0, 0, 0
    arrivals[:] = 0
    for row in range(count):
        estimate = estimates[row]
        corner = estimate.corner
        estimated |= 1 << corner
        facts[corner] = estimate.facts
        if estimate.is_sample:
            base = CORNER_MESSAGES * corner
            arrivals[corner] = max(receptions[base + RESOLVER].time_ns, receptions[base + CURRENT].time_ns)
        if estimate.source == contract.INVALID and not _is_number(states[corner]):
            lost |= 1 << corner
        # Disturbances of bus and loop are logged once, not for each corner.
        state = estimate.mode << 16 | estimate.reasons & 0xFFFF & ~_OF_THE_LOOP
        if state != reported[corner]:
            reported[corner] = state
            changed |= 1 << corner
    return estimated, lost, changed


@njit
def _is_number(state):
    """Whether a corner's state consists of numbers. If it does not, only a restart helps. An estimate that is invalid because
    of its inputs is different: a restart would not help, and would interrupt the other corners."""
    total = state.force + state.contact_angle + state.factor * state.scale + nearer_odds(state.nearer)
    for i in range(len(state.error)):
        total += state.error[i] + state.covariance[i, i]
        for k in range(len(state.alternatives)):
            total += state.alternatives[k].error[i] + state.alternatives[k].covariance[i, i]
    return np.isfinite(total)


def _compile_fusion(scratch: Pipeline) -> None:
    """Compile what `step` calls to fuse both paths, as it calls it."""
    state, parameters, sample, estimate = (
        records[0] for records in (scratch.states, scratch.parameters, scratch.samples, scratch.estimates)
    )
    compile_within(take_sides, state, parameters, sample, 0.0, 0.0, 1.0, estimate)
    compile_within(fuse, state, parameters, sample, 0.0, 0.0, 0.0, 0.0, estimate)


class Daemon:
    """Estimates of one process on one bus. ``state``: folder for learned values; without one nothing is learned; ``reader``
    reads calibrations again at a reload."""

    def __init__(
        self, setup: Setup, bus: Bus, manager: ServiceManager | None = None, state: Path | None = None,
        reader: Reader | None = None,
    ):  # fmt: skip
        self._setup = setup
        self._bus = bus
        self._manager = manager or ServiceManager(environment={})
        self._adaptation = None
        if state:
            self._adaptation = Adaptation(setup.calibrations, Memory(state), lambda _: time.time_ns(), threaded=True)
        corners = tuple(setup.configuration.corners)
        self.pipeline: Pipeline = Pipeline(setup.parameters, corners, setup.layout, adaptation=self._adaptation)
        self._shared: SharedEstimates | None = None
        #: ``ticks`` and ``missed``: periods run, and periods in which the loop did not wake.
        self.ticks: int = 0
        self.missed: int = 0
        self._active = sum(1 << CORNERS.index(name) for name in corners)
        #: Ticks run and missed until the last decision about the watchdog; since then: corners estimated, and corners whose
        #: state is not a number. Periods since most were met.
        self._before = (0, 0)
        self._estimated = self._lost = self._slow = 0
        # Plain flags: an Event takes a lock, for which a signal handler could wait forever in the thread that it interrupts.
        self._stopping = self._reload_wanted = False
        #: What reads the files, and the thread that waits for it.
        self._files: Reader = reader or Reader()
        self._reader: threading.Thread | None = None
        #: Calibrations by corner: in use; read by the reader thread; waiting for the brake's release. The reader writes only
        #: the second, and the loop takes it over when the reader has ended.
        self._calibrations = dict(setup.calibrations)
        self._read: dict[str, tuple[Calibration, Store | None]] | None = None
        self._waiting: dict[str, tuple[Calibration, Store | None]] = {}
        #: Pages: the listener that receives requests, the request that waits, the request whose page is being checked or
        #: taken, and the corners that are estimated with a page.
        self._listener: PageListener | None = None
        self._asked: Request | None = None
        self._page: Request | None = None
        self._on_page: set[str] = set()
        #: Calibrations by corner as last read from the files: those in use while there is no page.
        self._of_files = dict(setup.calibrations)
        self._disturbed_ns = dict.fromkeys((contract.BUS_DISTURBED, contract.DEADLINE_MISSED), -SHOWN_NS)
        self._losses = (0, 0)
        self._changes = ChangeLog()
        self._arrivals = np.zeros(len(CORNERS), np.int64)

    def stop(self) -> None:
        """Ask the loop to end; safe in a signal handler."""
        self._stopping = True

    def reload(self) -> None:
        """Ask for the calibrations to be read again; safe in a signal handler."""
        self._reload_wanted = True

    def share(self, path: Path) -> None:
        """Let other processes read the estimates of every tick in a file. If it cannot be written, the daemon runs without it,
        because the estimates on the bus matter more."""
        try:
            self._shared = SharedEstimates(path, self.pipeline)
        except OSError as error:
            log.error("estimates are not shared: %s: %s", path, error.strerror)

    def take_pages(self, path: Path) -> None:
        """Accept requests for other calibrations from the reader of the estimates in ``path``. Raises Unavailable if the
        socket cannot be made."""
        self._listener = PageListener(socket_path(path), self.ask_page, self._leave_page)

    def ask_page(self, request: Request) -> None:
        """Let the loop check a page and take or refuse it; one page at a time."""
        self._asked = request

    def _leave_page(self) -> None:
        if self._on_page:
            log.warning("the XCP server has ended: returning to the calibrations of the files")
            self._reload_wanted = True

    def warm_up(self) -> None:
        """Compile, or load from the cache, everything that a tick calls, and touch its memory."""
        scratch = Pipeline(self._setup.parameters.copy(), CORNERS, self._setup.layout)
        # The estimator is three quarters of the compiler's work, and what fuses its paths a third of that: with it here, both
        # processes take about the same time.
        wait = compile_beside(step, lambda: self._warm_up_answers(scratch), lambda: _compile_fusion(scratch))
        scratch.begin(0)
        _, count = scratch.collect(np.zeros(1, FRAME))
        count = scratch.overdue(LATE_CYCLES * CYCLE_NS, count)
        scratch.broadcast(count)
        noted = self._arrivals.copy(), self._changes.states.copy(), self._changes.facts.copy()
        _scan(scratch.estimates, count, scratch.states, scratch.receptions, *noted)
        if self._adaptation:
            self._adaptation.warm_up(scratch.states[0], scratch.parameters[0])
        wait()
        self._warm_up_answers(scratch)
        self._bus.drain()

    def _warm_up_answers(self, scratch: Pipeline) -> None:
        if self._adaptation:
            self._adaptation.answer(scratch.samples, 0, scratch.states, scratch.parameters, scratch.estimates)
        else:
            scratch.answer(0)

    def run(self) -> None:
        """Tick until `stop`."""
        for name, calibration in self._setup.calibrations.items():
            text = "corner %(corner)s: actuator %(actuator)s, calibration %(calibration)s"
            note(text, corner=name, actuator=calibration.actuator, calibration=calibration_hash(calibration))
        now = time.monotonic_ns()
        self.pipeline.begin(now)
        pacer = Pacer(now)
        watchdog_ns = int(0.4e9 * self._manager.watchdog_s) if self._manager.watchdog_s else None
        next_ping, next_status = now, now + _STATUS_NS
        self._manager.notify("READY=1", "STATUS=waiting for inputs")
        while not self._stopping:
            wake = pacer.next_wake(time.monotonic_ns())
            remaining = wake - time.monotonic_ns()
            if remaining > 0:
                time.sleep(1e-9 * remaining)
            else:
                self._bus.wait(1e-9 * QUEUED_NS)
            now = time.monotonic_ns()
            self._count(now, pacer)
            self.tick(now, pacer)
            if self._reload_wanted or self._reader is not None or self._waiting or self._asked or self._page:
                self._follow_reload()
            if watchdog_ns and now >= next_ping:
                # If the ping is withheld, decide again soon: the loop may only have stalled.
                next_ping = now + (watchdog_ns if self._ping() else watchdog_ns // 4)
            if now >= next_status:
                next_status = now + _STATUS_NS
                self._manager.notify(f"STATUS={self.ticks} ticks, {self.missed} missed, {self._bus.dropped} frames dropped")
        self._manager.notify("STOPPING=1")
        if self._adaptation:
            self._adaptation.close(self.pipeline.states, self.pipeline.parameters)
        if self._listener:
            self._listener.close()
        if self._shared:
            self._shared.close()
        log.info("stopped after %d ticks, %d missed", self.ticks, self.missed)

    def tick(self, now_ns: int, pacer: Pacer) -> None:
        """Take everything that has arrived, estimate, and send."""
        pipeline, frames, start = self.pipeline, self._bus.drain(), 0
        heard_ns = int(frames["time_ns"][-1]) if self._bus.full else now_ns - QUEUED_NS
        while True:
            start, count = pipeline.collect(frames, start, predictions=False)
            if start >= len(frames):
                count = pipeline.overdue(heard_ns, count)
            pipeline.answer(count)
            self._bus.send(pipeline.broadcast(count))
            if self._shared:
                self._shared.write(count)
            self._follow(count, pacer)
            if start >= len(frames):
                break
        self._watch_bus(frames, now_ns)

    def _follow(self, count: int, pacer: Pacer) -> None:
        """Note when the next samples are due; log changes of mode and reasons."""
        pipeline = self.pipeline
        estimated, lost, changed = _scan(
            pipeline.estimates,
            count,
            pipeline.states,
            pipeline.receptions,
            self._arrivals,
            self._changes.states,
            self._changes.facts,
        )
        self._estimated |= estimated
        self._lost |= lost
        for corner in range(len(CORNERS)):
            if self._arrivals[corner]:
                pacer.note_arrival(corner, int(self._arrivals[corner]))
        self._changes.write(changed, pacer.last_tick_ns)

    def _count(self, now_ns: int, pacer: Pacer) -> None:
        late = (now_ns - pacer.last_tick_ns) / CYCLE_NS - 1.0
        pacer.last_tick_ns = now_ns
        self.ticks += 1
        if late >= 1.0:
            self.missed += math.floor(late)
            self._disturb(contract.DEADLINE_MISSED, now_ns)

    def _disturb(self, reason: int, now_ns: int) -> None:
        if now_ns - self._disturbed_ns[reason] >= SHOWN_NS:
            log.warning("%s", contract.reason_words(reason)[0], extra={"fields": {"reason": reason}})
        self._disturbed_ns[reason] = now_ns

    def _watch_bus(self, frames: np.ndarray, now_ns: int) -> None:
        losses = (self._bus.dropped, self._bus.unsent)
        if losses != self._losses or self._bus.down or (len(frames) and np.any(frames["flags"] & ERROR)):
            self._losses = losses
            self._disturb(contract.BUS_DISTURBED, now_ns)
        bits = 0
        for reason, at in self._disturbed_ns.items():
            if now_ns - at < SHOWN_NS:
                bits |= reason
        self.pipeline.disturbed[:] = bits

    def _follow_reload(self) -> None:
        """Start a reading of the calibrations, one at a time, and let corners change to those that differ."""
        if self._reader is not None and not self._reader.is_alive():
            self._reader = None
            if self._page is None:
                if self._read is not None:
                    self._waiting, self._read = self._read, None
                if not self._reload_wanted:
                    self._manager.notify("READY=1")
        if self._page is not None and self._reader is None and (answer := self._answer_to(self._page)):
            self._page.answer(answer)
            self._page = None
        if self._reader is None and self._page is None:
            if self._reload_wanted:
                self._reload_wanted = False
                self._manager.notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
                self._read_beside(self._read_calibrations)
            elif self._asked is not None:
                self._page, self._asked = self._asked, None
                self._read_beside(self._read_calibrations, self._page)
        if self._reader is None:
            # What is being read is compared with what is in use, which must be the same until it has been read.
            for name in [name for name in self._waiting if self._is_released(name)]:
                self._begin_anew(name, *self._waiting.pop(name))

    def _read_beside(self, read, *arguments) -> None:
        self._reader = threading.Thread(target=read, args=arguments, name="reload", daemon=True)
        self._reader.start()

    def _answer_to(self, request: Request) -> Answer | None:
        """Change to a page that was read, all of its corners in one tick, or refuse it; None while the decision is open."""
        now_ns, answer = time.monotonic_ns(), Answer()
        request.read_ns = request.read_ns or now_ns
        if request.fault:
            answer = Answer(request.fault)
        elif request.read_ns - request.asked_ns > 1e9 * PATIENCE_S:
            answer = Answer("checking it took too long", later=True)
        elif self._waiting:
            answer = Answer("a reload is waiting for the brakes to be released", later=True)
        elif request.read and (why_not := self.pipeline.why_not_at_rest()):
            if now_ns - request.read_ns < _SETTLING_NS:
                return None
            answer = Answer(why_not, later=True)
        if answer.refused:
            log.error("page refused: %s", answer.refused)
            return answer
        for name, (calibration, learned) in request.read.items():
            count = len(request.page.values.get(name, ()))
            self._begin_anew(name, calibration, learned, on_page=count > 0)
            if count:
                log.warning("corner %s: %d numbers differ from the file; adaptation is off", name, count)
        return answer

    def _is_released(self, name: str) -> bool:
        state = self.pipeline.states[CORNERS.index(name)]
        return not (state["started"] and state["contact"]["engaged"])

    def _read_calibrations(self, request: Request | None = None) -> None:
        """Read the files, and set the numbers of a page if one is asked for."""
        in_use = {name: calibration_hash(calibration) for name, calibration in self._calibrations.items()}
        try:
            changed = self._files.read(self._setup.path, in_use, request.page if request else None)
        except InputError as error:
            if request:
                request.fault = str(error)
            else:
                log.error("calibration not reloaded, the old one stays in use: %s", error)
            if request or not self._on_page:
                return
            # A faulty file must not keep a page in use.
            changed = differing(self._of_files, in_use)
        waiting = {}
        for name, hashed in in_use.items():
            if name not in changed:
                note("corner %(corner)s: calibration %(calibration)s unchanged", corner=name, calibration=hashed)
                continue
            read = calibration_hash(changed[name])
            note("corner %(corner)s: calibration %(calibration)s read", corner=name, calibration=read)
            waiting[name] = changed[name], self._adaptation.read(name, changed[name]) if self._adaptation else None
        if request:
            request.read, request.fault = waiting, ""
        else:
            self._read = waiting

    def _begin_anew(self, name: str, calibration: Calibration, learned: Store | None, on_page: bool = False) -> None:
        """Start a corner anew with another calibration, as after a restart, because everything that the filter learned belongs
        to the old one."""
        self._calibrations[name] = calibration
        if not on_page:
            self._of_files[name] = calibration
        self._on_page = self._on_page | {name} if on_page else self._on_page - {name}
        if self._shared:
            self._shared.tell_page(bool(self._on_page))
        if self._adaptation:
            self._adaptation.replace(name, calibration, learned, on_page)
            calibration = self._adaptation.in_use(name)
        self.pipeline.begin_anew(CORNERS.index(name), to_parameters(calibration))
        now = calibration_hash(self._calibrations[name])
        note("corner %(corner)s: starts anew with calibration %(calibration)s", corner=name, calibration=now)

    def _ping(self) -> bool:
        """Ping the watchdog if a restart would not help; otherwise log the reason and return False.

        A restart would help if a corner gets no estimates, or if its state is not a number. If most ticks are missed, it helps
        where the loop itself has become slow, and costs more than it brings where others take the processor for some seconds:
        so only if that lasts. It would not help against an interface that is down or gone."""
        met, missed = self.ticks - self._before[0], self.missed - self._before[1]
        silent = self._active & ~self._estimated
        amiss = [
            f"corner {name}: the estimator's state is not a number"
            for index, name in enumerate(CORNERS)
            if self._lost >> index & 1
        ]
        amiss += [f"corner {name}: no estimate" for index, name in enumerate(CORNERS) if silent >> index & 1]
        self._slow = self._slow + met + missed if missed > met else 0
        if self._slow > _PATIENCE:
            amiss.append(f"most of {self._slow} periods missed")
        self._before, self._estimated, self._lost = (self.ticks, self.missed), 0, 0
        if amiss:
            log.error("not pinging the watchdog: %s", "; ".join(amiss))
        else:
            self._manager.notify("WATCHDOG=1")
        return not amiss
