"""Journal lines for corners whose mode or reasons change.

A machine that is too slow makes hundreds of changes a second, and writing them would make it slower. Of a corner that changes
too often only the first changes are written, and the last one when their time is over.
"""

import logging

import numpy as np

from emb_daemon.estimator.status import sentences
from emb_daemon.runtime.journal import log
from emb_daemon.wire import contract
from emb_daemon.wire.layout import CORNERS

#: Changes of a corner that are written within this time, ns.
_WRITTEN, _SPAN_NS = 10, 10_000_000_000


class ChangeLog:
    """The journal's lines of each corner."""

    def __init__(self):
        #: Mode << 16 | reasons by corner, shape (4,), as they are now; -1 before the first estimate.
        self.states: np.ndarray = np.full(len(CORNERS), -1, np.int64)
        #: What the estimator found (`estimator.status`) by corner, shape (4,), as it is now.
        self.facts: np.ndarray = np.zeros(len(CORNERS), np.int64)
        self._from_ns = [-_SPAN_NS] * len(CORNERS)
        self._changes = [0] * len(CORNERS)

    def write(self, changed: int, now_ns: int) -> None:
        """Write the states of ``changed`` corners (bit mask) that are due at ``now_ns``."""
        if not changed and max(self._changes) <= _WRITTEN:
            return
        for corner in range(len(CORNERS)):
            unwritten = max(self._changes[corner] - _WRITTEN, 0)
            if now_ns - self._from_ns[corner] >= _SPAN_NS and (unwritten or changed >> corner & 1):
                self._from_ns[corner], self._changes[corner] = now_ns, 0
                if unwritten:
                    self._write_one(corner, f", after {unwritten} changes that were not logged")
                    continue
            if changed >> corner & 1:
                self._changes[corner] += 1
                if self._changes[corner] <= _WRITTEN:
                    self._write_one(corner)

    def _write_one(self, corner: int, after: str = "") -> None:
        mode, reasons = int(self.states[corner]) >> 16, int(self.states[corner]) & 0xFFFF
        amiss = mode in (contract.DEGRADED, contract.FAULT)
        # Disturbances of bus and loop are logged once for all corners; here they are only mentioned.
        words = ", ".join(contract.reason_words(reasons)) or ("bus or loop" if amiss else "none")
        fields = {"corner": CORNERS[corner], "mode": contract.MODES[mode], "reasons": words}
        level = logging.WARNING if amiss else logging.INFO
        if found := sentences(self.facts[corner]):
            fields["found"] = found
            after += ": %(found)s"
        log.log(level, f"corner %(corner)s: %(mode)s (%(reasons)s){after}", fields, extra={"fields": fields})
