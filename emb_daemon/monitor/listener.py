"""Broadcasts received from the bus: last values, gaps in the E2E counters, and the forces of the last minute."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from emb_daemon.resources import resource
from emb_daemon.wire import contract
from emb_daemon.wire.e2e import COUNTER_MODULO, counter_of, crc, status_of
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, REMOTE
from emb_daemon.wire.layout import (
    ADAPT_REQUEST,
    CLAMP_FORCE,
    CORNERS,
    ESTIMATOR_STATUS,
    PAD_TEMP,
    default_layout,
    load_database,
    signal_columns,
)

HISTORY_S = 60
#: Share of a cycle by which a sender that keeps its schedule may be early or late: 1 ms for the force.
_JITTER_CYCLES = 0.25
SECOND_NS = 1_000_000_000


@dataclass
class Stream:
    """One of a corner's four messages."""

    cycle_ns: int
    #: Signals of the last good frame in the DBC's order and units; empty before the first.
    values: list[float] = field(default_factory=list)
    status: int = contract.STATUS_NOT_AVAILABLE
    counter: int = -1
    time_ns: int = 0
    received: int = 0  #: good frames
    missing: int = 0  #: by the counter; complete turns of it show in the elapsed time
    damaged: int = 0  #: frames with a wrong CRC or a repeated counter

    @property
    def usable(self) -> bool:
        """Whether the values may be used, by the sender's Status."""
        return self.status <= contract.STATUS_DEGRADED

    def value(self, column: int) -> float | None:
        """A signal of the last good frame; None before the first, or if the Status forbids its use."""
        return self.values[column] if self.values and self.usable else None

    def take(self, values: list[float], status: int, counter: int, time_ns: int) -> bool:
        """Count a frame with a good CRC; returns whether its values are new."""
        if self.counter >= 0:
            step, elapsed = (counter - self.counter) % COUNTER_MODULO, (time_ns - self.time_ns) / self.cycle_ns
            if step == 0 and elapsed < COUNTER_MODULO / 2:
                self.damaged += 1
                return False
            # Complete turns of the counter show only in the elapsed time, and only if the sender kept its schedule: a sender
            # that paused has not sent more frames than its counter shows.
            turns = max(0, round((elapsed - step) / COUNTER_MODULO))
            if abs(elapsed - step - COUNTER_MODULO * turns) <= _JITTER_CYCLES:
                step += COUNTER_MODULO * turns
            self.missing += max(step - 1, 0)
        self.values, self.status, self.counter, self.time_ns = values, status, counter, time_ns
        self.received += 1
        return True


class Corner:
    """One corner's broadcasts."""

    def __init__(self, name: str, cycles_ns: list[int]):
        self.name = name
        self.streams: list[Stream] = [Stream(cycle) for cycle in cycles_ns]
        #: [second, largest usable force in kN, number of forces], the newest last.
        self._seconds: deque[list] = deque(maxlen=HISTORY_S + 1)
        self._reference_kN, self._reference_ns = math.nan, 0
        #: What the estimator finds, in words, which is not on the bus; None: not known.
        self.facts: list[str] | None = None

    def remember(self, force_kN: float, time_ns: int) -> None:
        second = time_ns // SECOND_NS
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append([second, math.nan, 0])
        entry = self._seconds[-1]
        entry[2] += 1
        if not math.isnan(force_kN):
            entry[1] = force_kN if math.isnan(entry[1]) else max(entry[1], force_kN)

    def set_reference(self, force_N: float, time_ns: int) -> None:
        """Store ``force_N``, measured by a rig's force sensor."""
        self._reference_kN, self._reference_ns = 1e-3 * force_N, time_ns

    def reference_kN(self, now_ns: int) -> float | None:
        """Force that a rig's sensor measured within the last half second, if there is one."""
        recent = now_ns - self._reference_ns <= SECOND_NS // 2 and math.isfinite(self._reference_kN)
        return round(self._reference_kN, 3) if recent else None

    def forces_kN(self, now_ns: int) -> list[float]:
        """Largest usable force of each of the last HISTORY_S whole seconds, oldest first; NaN where there was none."""
        now, largest = now_ns // SECOND_NS, {second: force for second, force, _ in self._seconds}
        return [largest.get(second, math.nan) for second in range(now - HISTORY_S, now)]

    def rate_Hz(self, now_ns: int) -> float:
        """Clamp forces received in the last whole second."""
        last = now_ns // SECOND_NS - 1
        return float(sum(count for second, _, count in self._seconds if second == last))

    @property
    def received(self) -> bool:
        return any(stream.received for stream in self.streams)

    @property
    def missing(self) -> int:
        return sum(stream.missing for stream in self.streams)

    @property
    def damaged(self) -> int:
        return sum(stream.damaged for stream in self.streams)

    def silent_s(self, now_ns: int) -> float:
        """Time since the last good frame, s."""
        return max(0.0, 1e-9 * (now_ns - max(stream.time_ns for stream in self.streams)))

    def reasons(self) -> tuple[str, ...]:
        """Why the estimate is degraded, in words."""
        status = self.streams[ESTIMATOR_STATUS]
        return contract.reason_words(status.values[3]) if status.values else ()

    def state(self, now_ns: int) -> dict[str, Any]:
        """Everything known, for scripts. None: not received yet, or not to be used by the sender's Status."""
        force, heat, status, request = (
            self.streams[kind] for kind in (CLAMP_FORCE, PAD_TEMP, ESTIMATOR_STATUS, ADAPT_REQUEST)
        )

        def value(stream: Stream, column: int, digits: int) -> float | None:
            known = stream.value(column)
            return None if known is None else round(known, digits)

        return {
            "status": contract.STATUSES.get(force.status, "?"),
            "clamp_force_kN": value(force, 0, 3),
            "clamp_force_sigma_kN": value(force, 1, 3),
            "clamp_force_ref_kN": self.reference_kN(now_ns),
            "source": _word(contract.SOURCES, force, 3),
            "input_age_ms": int(force.values[4]) if force.values else None,
            "mode": _word(contract.MODES, status, 0),
            "reasons": list(self.reasons()),
            "facts": self.facts,
            "stiffness_factor": value(status, 1, 4),
            "contact_angle_rad": value(status, 2, 1),
            "inner_surface_C": value(heat, 0, 2),
            "inner_mean_C": value(heat, 1, 2),
            "outer_surface_C": value(heat, 2, 2),
            "outer_mean_C": value(heat, 3, 2),
            "adaptation": {
                "request": _word(contract.REQUESTS, request, 0),
                "progress_percent": int(request.values[1]) if request.values else None,
                "result": _word(contract.RESULTS, request, 2),
            },
            "forces_per_s": self.rate_Hz(now_ns),
            "received": sum(stream.received for stream in self.streams),
            "missing": self.missing,
            "damaged": self.damaged,
            "silent_s": round(self.silent_s(now_ns), 3),
        }


def _word(words: Sequence[str] | Mapping[int, str], stream: Stream, column: int) -> str | None:
    """A code in words: None before it was received, ``?`` if the contract has no such code."""
    if not stream.values:
        return None
    known = words if isinstance(words, Mapping) else dict(enumerate(words))
    return known.get(int(stream.values[column]), "?")


def broadcast_ids() -> list[int]:
    """CAN ids of a daemon's broadcasts, of all corners."""
    return default_layout()["sent_id"].ravel().tolist()


class Listener:
    """All corners' broadcasts, and RIG_c_Force of `logs.live.ReferenceBus`. `receive` takes FRAME arrays as a bus returns
    them, with times on the monotonic clock."""

    def __init__(self):
        layout = default_layout()[0]
        self._cycles = layout["sent_cycle_ns"].tolist()
        self._place = {int(layout["sent_id"][kind, row]): (kind, row) for kind in range(4) for row in range(len(CORNERS))}
        rig = load_database(resource("dbc/rig.dbc"))
        [self._force] = signal_columns(rig, "RIG_FL_Force", ("ClampForceRef",)).tolist()
        self._rigs = {rig.get_message_by_name(f"RIG_{name}_Force").frame_id: row for row, name in enumerate(CORNERS)}
        self._signals = [layout["sent"][kind, : layout["sent_count"][kind]].tolist() for kind in range(4)]
        # Compiled code is loaded now: loading takes long enough for a socket's buffer to overflow.
        for compiled in (counter_of, status_of, partial(crc, 0)):
            compiled(np.uint64(0))
        self.reset()

    @property
    def active(self) -> list[Corner]:
        """The corners from which broadcasts were received."""
        return [corner for corner in self.corners if corner.received]

    def states(self, now_ns: int) -> dict[str, dict[str, Any]]:
        """`Corner.state` of each corner from which broadcasts were received, by name."""
        return {corner.name: corner.state(now_ns) for corner in self.active}

    def reset(self) -> None:
        self.corners: list[Corner] = [Corner(name, self._cycles) for name in CORNERS]

    def receive(self, frames: np.ndarray) -> None:
        for time_ns, data, can_id, length, flags in frames.tolist():
            place, rig = self._place.get(can_id), self._rigs.get(can_id)
            if flags & (EXTENDED | REMOTE | ERROR | FD):
                continue
            if rig is not None and (force_N := _physical(data, self._force)) >= self._force[5]:
                self.corners[rig].set_reference(force_N, time_ns)
            if place is None:
                continue
            kind, row = place
            stream = self.corners[row].streams[kind]
            payload = np.uint64(data)
            counter = int(counter_of(payload))
            if length != 8 or counter >= COUNTER_MODULO or crc(can_id, payload) != data & 0xFF:
                stream.damaged += 1
                continue
            values = [_physical(data, signal) for signal in self._signals[kind]]
            fresh = stream.take(values, int(status_of(payload)), counter, time_ns)
            if fresh and kind == CLAMP_FORCE:
                self.corners[row].remember(values[0] if stream.usable else math.nan, time_ns)


def _physical(data: int, signal: tuple) -> float:
    """`wire.layout.unpack` without a call into compiled code, which would cost more than it computes."""
    start, length, signed, factor, offset, *_ = signal
    raw = data >> start & (1 << length) - 1
    if signed and raw >> length - 1:
        raw -= 1 << length
    return raw * factor + offset
