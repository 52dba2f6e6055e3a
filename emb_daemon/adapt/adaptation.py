"""The part of adaptation that is not done in a tick: evaluation, memory, words for the log.

In the daemon a helper thread does it, off the real-time priority and without the interpreter's lock where it computes; in
replay it happens at once. Both take effect at the same sample.
"""

import contextlib
import os
import queue
import threading
from collections.abc import Callable

import numpy as np

from emb_daemon.adapt import records as r
from emb_daemon.adapt.fit import compile_fit, fit_training
from emb_daemon.adapt.limits import to_limits
from emb_daemon.adapt.memory import Entry, Memory, Store, apply_entry, entry_of, with_entry
from emb_daemon.adapt.session import answer_adapting, end
from emb_daemon.calibration.types import Calibration
from emb_daemon.estimator.records import STATE
from emb_daemon.runtime.journal import log
from emb_daemon.wire.layout import CORNERS

#: Patience with the helper thread at the end, s.
_CLOSING_S = 2.0


class Adaptation:
    """Adaptation of all corners of one process.

    Args:
        calibrations: by corner name.
        memory: where learned values are kept.
        clock: the date (ISO 8601) that belongs to a sample's time in ns.
        threaded: evaluate and write in a helper thread.

    Attributes:
        adapters, limits: ADAPTER and LIMITS arrays, shape (4,).
        rows: TRAINING array, shape (4, CAPACITY).
    """

    def __init__(
        self, calibrations: dict[str, Calibration], memory: Memory, clock: Callable[[int], str], threaded: bool = False
    ):
        self.adapters = np.zeros(4, r.ADAPTER)
        self.limits = np.zeros(4, r.LIMITS)
        self.rows = np.zeros((4, r.CAPACITY), r.TRAINING)
        self._scratch = np.zeros(1, STATE)
        self._memory, self._clock, self._threaded = memory, clock, threaded
        self._stores: dict[int, Store] = {}
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._take(self.read(calibrations))

    def read(self, calibrations: dict[str, Calibration]) -> list[tuple[np.void, Store]]:
        """Limits and what the memory holds for these calibrations; may take long and touches nothing in use."""
        found = []
        for name, calibration in calibrations.items():
            store, warning = self._memory.load(name, calibration)
            if warning:
                log.warning("corner %s: %s", name, warning)
            found.append((to_limits(calibration), store))
        return found

    def _take(self, found: list[tuple[np.void, Store]]) -> None:
        for limits, store in found:
            corner = CORNERS.index(store.corner)
            self.limits[corner] = limits
            self._stores[corner] = store

    def replace(self, found: list[tuple[np.void, Store]], parameters: np.ndarray) -> None:
        """Go over to other calibrations (what `read` returned) between two ticks; training that runs is aborted."""
        for _, store in found:
            adapter = self.adapters[CORNERS.index(store.corner)]
            if adapter["phase"] != r.IDLE:
                end(adapter, r.BAD_INPUT, r.RESULT_ABORTED)
        self._take(found)
        self.restore(parameters)

    def restore(self, parameters: np.ndarray) -> None:
        """Put what was learned before into PARAMETERS, shape (4,)."""
        for corner, store in self._stores.items():
            if store.current is not None and self.limits[corner]["enabled"]:
                apply_entry(store.current, parameters[corner])
                log.info("corner %s: adapted values of %s in use", store.corner, store.current.date)

    def current(self, corner: str) -> Entry | None:
        """The values in use that were learned, or None."""
        return self._stores[CORNERS.index(corner)].current

    def last_verdict(self, corner: str) -> str:
        """How the last training of a corner ended, in words; empty if there was none."""
        adapter = self.adapters[CORNERS.index(corner)]
        return r.VERDICTS[adapter["verdict"]] if adapter["result"] != r.NO_RESULT else ""

    def warm_up(self, pipeline) -> None:
        """Compile, or load from the cache, what evaluations call, for a pipeline like this; touch the memory that training
        will need; start the helper thread."""
        for corner in self._stores:
            self.rows[corner] = np.zeros((), r.TRAINING)
        compile_fit(pipeline.parameters[0], pipeline.states[0])
        if self._threaded and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="adaptation", daemon=True)
            self._thread.start()

    def answer(self, samples, count, states, parameters, estimates) -> None:
        """`pipeline.answer` that learns on the way."""
        first = 0
        while True:
            while not self._done.empty():
                self._bring_back(*self._done.get())
            first = self._answer(samples, first, count, states, parameters, estimates)
            if self.adapters["wanted"].any() or self.adapters["settled"].any():
                for corner in range(4):
                    self._serve(corner, self.adapters[corner], states[corner], parameters[corner])
            if first >= count:
                return

    def _answer(self, samples, first, count, states, parameters, estimates) -> int:
        return answer_adapting(
            samples, first, count, states, parameters, estimates, self.adapters, self.limits, self._scratch, self.rows
        )

    def _serve(self, corner: int, adapter: np.void, state: np.void, parameters: np.void) -> None:
        # Records are views, and the loop goes on writing to them: what is handed over is copied.
        if adapter["settled"]:
            adapter["settled"] = False
            self._do(self._settle, self._stores[corner], int(adapter["verdict"]), adapter["learned"].copy(),
                     int(adapter["time_ns"]), float(adapter["ambient"]), float(adapter["rise"]))  # fmt: skip
        if adapter["wanted"]:
            adapter["wanted"] = False
            rows = self.rows[corner, : int(adapter["training_rows"])]
            self._do(self._fit, corner, int(adapter["generation"]), rows, parameters.copy(), state.copy(),
                     float(adapter["power_on_angle"]))  # fmt: skip

    def close(self) -> None:
        """Let what is being written be written."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(_CLOSING_S)

    def _do(self, job: Callable, *arguments) -> None:
        if self._threaded:
            self._jobs.put((job, arguments))
        else:
            job(*arguments)

    def _work(self) -> None:
        # The service manager may have made the whole process real-time; this thread must never keep the loop waiting.
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

    def _fit(
        self, corner: int, generation: int, rows: np.ndarray, parameters: np.void, state: np.void, power_on_angle: float
    ) -> None:
        learned = fit_training(rows, parameters, state, self.limits[corner])
        clearance = learned["contact_angle"] - power_on_angle
        believable = abs(clearance - parameters["clearance"]) <= self.limits[corner]["clearance_change"]
        learned["clearance"] = clearance if believable else np.nan
        self._done.put((corner, generation, learned))

    def _bring_back(self, corner: int, generation: int, learned: np.void) -> None:
        adapter = self.adapters[corner]
        if adapter["phase"] == r.EVALUATING and adapter["generation"] == generation:
            adapter["learned"] = learned
            adapter["ready"] = True

    def _settle(self, store: Store, verdict: int, learned: np.void, time_ns: int, ambient: float, rise: float) -> None:
        """Log an outcome and keep it."""
        words = {"corner": store.corner, "verdict": r.VERDICTS[verdict]}
        log.info("corner %(corner)s: adaptation: %(verdict)s", words, extra={"fields": words})
        if r.BRAKE_REQUESTED <= verdict < r.NOT_CONVERGED:
            return
        corner = CORNERS.index(store.corner)
        if self._stores[corner].calibration != store.calibration:
            return
        store = with_entry(self._stores[corner], entry_of(learned, verdict, self._clock(time_ns), ambient, rise))
        self._stores[corner] = store
        try:
            self._memory.save(store)
        except OSError as error:
            log.error("corner %s: learned values could not be written: %s", store.corner, error)
