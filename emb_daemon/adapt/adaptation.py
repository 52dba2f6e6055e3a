"""The part of adaptation that is not done in a tick: evaluation, memory, words for the log.

In the daemon a helper thread does this; it has no real-time priority, and releases the interpreter's lock while it computes.
In a replay it is done at once. In both the result takes effect at the same sample. Only the loop accesses the values in use:
the helper thread gets copies and returns its results.
"""

import contextlib
import logging
import os
import queue
import threading
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.fit import Driven, compile_fit, fit_training, reach
from emb_daemon.adapt.learned import Evaluation, with_learned
from emb_daemon.adapt.memory import Entry, Memory, Store, entry_of, with_entry
from emb_daemon.adapt.snapshots import Snapshots
from emb_daemon.adapt.training import answer_adapting
from emb_daemon.calibration.parameters import CLEARANCE
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.estimator import restart
from emb_daemon.estimator.records import PARAMETERS, STATE, new_state
from emb_daemon.wire.contract import NO_RESULT
from emb_daemon.wire.layout import CORNERS

#: Time for which `close` waits for the helper thread, s.
_CLOSING_S = 2.0

log: logging.Logger = logging.getLogger(__name__)


class Adaptation:
    """Adaptation of all corners of one process, whose learned values are kept in ``memory``.

    ``clock``: the real time (CLOCK_REALTIME) that belongs to a sample's time, both in ns; ``threaded``: evaluate and write in
    a helper thread."""

    def __init__(
        self, calibrations: dict[str, Calibration], memory: Memory, clock: Callable[[int], int], threaded: bool = False
    ):
        #: ``adapters`` and ``limits``: ADAPTER and LIMITS arrays, shape (4,).
        self.adapters: np.ndarray = np.zeros(4, r.ADAPTER)
        self.limits: np.ndarray = np.zeros(4, r.LIMITS)
        self.rows: np.ndarray = np.zeros((4, r.CAPACITY), r.TRAINING)  #: TRAINING array, shape (4, CAPACITY)
        #: PARAMETERS array, shape (4,): result of each corner's last accepted evaluation.
        self.learned: np.ndarray = np.zeros(4, PARAMETERS)
        #: STATE array, shape (4,): of the path models with these at the end of the training.
        self.reached: np.ndarray = np.zeros(4, STATE)
        self._remembered = np.zeros(4, r.REMEMBERED)
        self._memory, self._clock, self._threaded = memory, clock, threaded
        self._calibrations: dict[int, Calibration] = {}
        self._stores: dict[int, Store] = {}
        self._evaluations: dict[int, Evaluation] = {}
        self._snapshots = Snapshots(memory.folder, restart.SNAPSHOT)
        self._resumable: dict[int, tuple[np.void, int]] = {}
        self._on_page: set[int] = set()
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        for name, calibration in calibrations.items():
            self.replace(name, calibration, self.read(name, calibration))
            in_use = self.in_use(name)
            snapshot, time_ns, warning = self._snapshots.load(name, in_use)
            if snapshot is not None and (wrong := restart.why_implausible(snapshot, to_parameters(in_use))):
                warning = f"{self._snapshots.path(name)}: {wrong}: impossible for this brake; not used"
            if warning:
                log.warning("corner %s: %s", name, warning)
            elif snapshot is not None:
                self._resumable[CORNERS.index(name)] = snapshot, time_ns

    def read(self, corner: str, calibration: Calibration) -> Store:
        """A corner's store for this calibration (`Memory.load`). May take long; changes nothing in use."""
        store, warning = self._memory.load(corner, calibration)
        if warning:
            log.warning("corner %s: %s", corner, warning)
        return store

    def replace(self, corner: str, calibration: Calibration, store: Store, on_page: bool = False) -> None:
        """Change between two ticks to another calibration and to what `read` found for it; a running training is dropped.

        With a calibration that is not that of a file (``on_page``) nothing is learned, and stored values stay as they are."""
        index = CORNERS.index(corner)
        self._calibrations[index], self._stores[index] = calibration, store
        self.limits[index] = r.to_limits(calibration)
        self._on_page.discard(index)
        if on_page:
            self._on_page.add(index)
            self.limits[index]["enabled"] = False
        self._resumable.pop(index, None)
        generation = self.adapters[index]["generation"] + 1
        self.adapters[index] = np.zeros((), r.ADAPTER)
        # The result of an evaluation that is still running must not be taken for that of a later training.
        self.adapters[index]["generation"] = generation
        if store.current is not None and calibration.adaptation.enabled:
            log.info("corner %s: learned values of %s in use", corner, store.current.date)

    def in_use(self, corner: str) -> Calibration:
        """A corner's calibration with its learned values."""
        index = CORNERS.index(corner)
        current = self._stores[index].current
        return with_learned(self._calibrations[index], current.values if current else None)

    def current(self, corner: str) -> Entry | None:
        """The training whose values are in use, or None."""
        return self._stores[CORNERS.index(corner)].current

    def last_outcome(self, corner: str) -> str:
        """How the last training of a corner ended, in words; empty if there was none."""
        adapter = self.adapters[CORNERS.index(corner)]
        return r.OUTCOMES[adapter["outcome"]] if adapter["result"] != NO_RESULT else ""

    def restore(self, parameters: np.ndarray) -> None:
        """Put each corner's calibration in use into PARAMETERS, shape (4,)."""
        for corner in self._stores:
            parameters[corner] = to_parameters(self.in_use(CORNERS[corner]))

    def warm_up(self, state: np.void, parameters: np.void) -> None:
        """Compile, or load from the cache, what evaluations call, with a corner's STATE and PARAMETERS records; touch the
        memory that training will need; start the helper thread."""
        for corner in self._stores:
            self.rows[corner] = np.zeros((), r.TRAINING)
        compile_fit(next(iter(self._calibrations.values())), state)
        scratch, snapshot = new_state()[0], np.zeros(1, restart.SNAPSHOT)[0]
        restart.take_snapshot(scratch, parameters, snapshot)
        restart.resume(scratch, parameters, snapshot, 0.0)
        if self._threaded and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="adaptation", daemon=True)
            self._thread.start()

    def answer(
        self, samples: np.ndarray, count: int, states: np.ndarray, parameters: np.ndarray, estimates: np.ndarray
    ) -> None:
        """`pipeline.answer` that learns on the way."""
        if self._resumable:
            self._resume(samples[:count], states, parameters)
        first = 0
        while True:
            while not self._done.empty():
                self._take_evaluation(*self._done.get())
            first = answer_adapting(
                samples, first, count, states, parameters, self.learned, self.reached, self._remembered, estimates,
                self.adapters, self.limits, self.rows,
            )  # fmt: skip
            if any(self.adapters[name].any() for name in ("evaluation_wanted", "ended", "snapshot_wanted")):
                for corner in self._stores:
                    self._attend(corner, self.adapters[corner], states[corner], parameters[corner])
            if first >= count:
                return

    def _resume(self, samples: np.ndarray, states: np.ndarray, parameters: np.ndarray) -> None:
        """Restore the snapshots of corners whose first sample has arrived."""
        for corner in list(self._resumable):
            rows = np.flatnonzero((samples["corner"] == corner) & ~samples["is_prediction"])
            if len(rows):
                snapshot, time_ns = self._resumable.pop(corner)
                sample = samples[rows[0]]
                elapsed_s = 1e-9 * (self._clock(int(sample["time_ns"])) - time_ns)
                if elapsed_s < 0.0:
                    log.warning("corner %s: snapshot is %.0f s in the future; not used", CORNERS[corner], -elapsed_s)
                else:
                    restart.resume(states[corner], parameters[corner], snapshot, elapsed_s)

    def _attend(self, corner: int, adapter: np.void, state: np.void, parameters: np.void) -> None:
        """Start what the tick has requested: evaluations, snapshots, log lines."""
        if adapter["ended"]:
            adapter["ended"] = False
            self._keep(corner, adapter)
        # After the learned values, to which the snapshot belongs.
        if adapter["snapshot_wanted"]:
            adapter["snapshot_wanted"] = False
            self._keep_snapshot(corner, state, parameters)
        if adapter["evaluation_wanted"]:
            adapter["evaluation_wanted"] = False
            rows = self.rows[corner, : int(adapter["training_rows"])]
            # Records are views to which the loop keeps writing, so the helper thread gets copies.
            state = state.copy()
            state["effects"] = self._remembered[corner]
            self._do(self._evaluate, corner, int(adapter["generation"]), rows, self._calibrations[corner],
                     self.in_use(CORNERS[corner]), state, float(adapter["power_on_angle"]),
                     float(adapter["factor_sigma"]), Driven.of(adapter))  # fmt: skip

    def _keep_snapshot(self, corner: int, state: np.void, parameters: np.void) -> None:
        if corner not in self._on_page:
            snapshot = np.zeros(1, restart.SNAPSHOT)[0]
            if not restart.take_snapshot(state, parameters, snapshot):
                return
            time_ns = self._clock(int(self.adapters[corner]["time_ns"]))
            self._do(self._write_snapshot, CORNERS[corner], self.in_use(CORNERS[corner]), snapshot, time_ns)

    def _write_snapshot(self, corner: str, calibration: Calibration, snapshot: np.void, time_ns: int) -> None:
        try:
            self._snapshots.save(corner, calibration, snapshot, time_ns)
        except OSError as error:
            log.error("corner %s: snapshot could not be written: %s", corner, error)

    def _keep(self, corner: int, adapter: np.void) -> None:
        """Keep the outcome of an evaluated training; start logging and writing it."""
        outcome, evaluation = int(adapter["outcome"]), self._evaluations.pop(corner, None)
        store = None
        if outcome == r.ACCEPTED or outcome >= r.NOT_CONVERGED:
            real_s = 1e-9 * self._clock(int(adapter["time_ns"]))
            date = datetime.fromtimestamp(real_s, UTC).isoformat(timespec="seconds")
            entry = entry_of(outcome, evaluation, date, float(adapter["ambient"]), float(adapter["rise"]))
            store = self._stores[corner] = with_entry(self._stores[corner], entry)
        self._do(self._write, CORNERS[corner], outcome, evaluation.note if store else "", store)

    def _take_evaluation(
        self, corner: int, generation: int, evaluation: Evaluation, learned: np.void, reached: np.void
    ) -> None:
        adapter = self.adapters[corner]
        if adapter["phase"] != r.EVALUATING or adapter["generation"] != generation:
            return
        self._evaluations[corner], self.learned[corner], self.reached[corner] = evaluation, learned, reached
        adapter["evaluation"], adapter["evaluation_ready"] = evaluation.outcome, True
        for name in r.FOUND:
            adapter[name] = getattr(evaluation, name)

    def close(self, states: np.ndarray, parameters: np.ndarray) -> None:
        """Store snapshots of STATE and PARAMETERS, shape (4,), and wait for the helper thread to finish writing."""
        for corner in self._stores:
            self._keep_snapshot(corner, states[corner], parameters[corner])
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(_CLOSING_S)

    def _do(self, job: Callable, *arguments) -> None:
        if self._threaded:
            self._jobs.put((job, arguments))
        else:
            job(*arguments)

    def _work(self) -> None:
        # The service manager may have given the process real-time priority; this thread must not delay the loop.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while (task := self._jobs.get()) is not None:
            job, arguments = task
            try:
                job(*arguments)
            except Exception:
                log.exception("adaptation")

    def _evaluate(
        self, corner: int, generation: int, rows: np.ndarray, base: Calibration, calibration: Calibration, state: np.void,
        power_on_angle: float, factor_sigma: float, driven: Driven | None,
    ) -> None:  # fmt: skip
        evaluation = fit_training(rows, calibration, base, state, factor_sigma, driven)
        # After a restart the clearance gives the contact angle. If the motor did not start released, the clearance is not
        # changed.
        clearance = evaluation.contact_angle - power_on_angle
        if abs(clearance - calibration.contact.clearance_rad) <= base.adaptation.clearance_change_rad:
            evaluation.values[CLEARANCE] = clearance
        accepted = evaluation.outcome == r.ACCEPTED
        learned = to_parameters(with_learned(base, evaluation.values) if accepted else calibration)
        reached = reach(rows, state, evaluation.contact_angle, learned) if accepted else state
        self._done.put((corner, generation, evaluation, learned, reached))

    def _write(self, corner: str, outcome: int, note: str, store: Store | None) -> None:
        words = {"corner": corner, "outcome": r.OUTCOMES[outcome] + (f" ({note})" if note else "")}
        log.info("corner %(corner)s: adaptation: %(outcome)s", words, extra={"fields": words})
        if store is not None:
            try:
                self._memory.save(store)
            except OSError as error:
                log.error("corner %s: learned values could not be written: %s", corner, error)
