"""From frames to samples to estimates to frames: the path that the daemon and replay share.

The input is frames and times as data. The daemon passes the frames that it has drained and the time of its tick; replay passes
a log. The same frames in the same order give the same payloads, because the sample time is counted in cycles of the resolver
message, by its Counter, so that jitter of arrival does not reach the estimator.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.records import LIMITS
from emb_daemon.estimator.answer import answer
from emb_daemon.estimator.records import ESTIMATE, SAMPLE, new_state
from emb_daemon.jit import Array, entry, fields, njit
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.wire import contract
from emb_daemon.wire import layout as wire
from emb_daemon.wire.contract import CYCLE_NS, CYCLE_S
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME, put
from emb_daemon.wire.layout import LAYOUT, pack
from emb_daemon.wire.receive import ACCEPTED, RECEPTION, SECOND_SENDER, lateness, new_reception, receive

#: Time for which a resolver sample waits for its current before the estimate is made without it. Senders put both on the bus
#: together; half a cycle leaves as much time for the estimate.
_PAIRING_NS = CYCLE_NS // 2
#: Without a resolver sample for this number of cycles the daemon predicts, once a cycle. Two lost frames in a row need no
#: prediction, because the next sample covers them.
LATE_CYCLES = 3
#: Largest difference between arrival and the counter's clock at which the counter is used: two cycles, the longest delay of a
#: bus that keeps its schedule.
_JITTER_NS = 2 * CYCLE_NS
#: Number of samples on which counter and clock must have agreed before the counter takes precedence over the clock.
_AGREED = 3
#: Longest delay for which the counter is used although the clock says otherwise: that of a bus or a machine that was held up.
#: Afterwards there is no estimate either (`estimator.step.SILENCE_S`), and a counter that does not fit may have begun anew.
_HELD_UP_NS = 100_000_000
#: Number of cycles of its message after which an input is reported as lost, and the age up to which the models use its last
#: value: the same number of cycles of the slowest message, the vehicle's status at 100 ms. Pads take minutes to warm.
_REPORTED_CYCLES, _USABLE_NS = 25, 2_500_000_000
#: Time for which a refused frame, a second sender of the daemon's messages or a disturbance of bus or loop is reported, ns:
#: ten EMB_c_EstimatorStatus.
SHOWN_NS = 1_000_000_000

#: State of a corner between two samples: the resolver sample that waits for its current, and the last one estimated.
#: ``cycle``: cycles since the first sample; ``announced``: cycles up to the last row; ``predicted``: rows since then;
#: ``clock_ns``: the last sample's time by the sender's counter; ``late_ns``: its delay, if later samples are to make up for
#: it; ``agreed``: number of samples in a row on which counter and clock agreed; ``second_sender_ns``: when another node last
#: sent one of the daemon's messages; ``unproven``: authentication is required and a key is missing; ``was_silent``: whether
#: nothing came of its motor's controller for a tenth of a second before this sample, of which something ``heard_ns`` last.
CORNER = np.dtype(
    [
        *fields("?", "active started"),
        *fields("i8", "pending pending_ns"),
        *fields("f8", "pending_angle pending_speed"),
        *fields("i8", "sample_ns counter cycle announced predicted clock_ns late_ns agreed second_sender_ns"),
        *fields("i8", "pending_late_ns sample_late_ns"),
        *fields("?", "unproven was_silent"),
        ("heard_ns", "i8"),
    ],
    align=True,
)

#: E2E counters of sent messages, by message and corner; ``values`` of the message that is being encoded.
TRANSMISSION = np.dtype([("counter", "i8", (4, 4)), ("values", "f8", (wire.SENT_SIGNALS,))], align=True)

#: Predictions that `_overdue` makes.
_NONE, _ALL, _NEWEST = range(3)

#: Largest number of rows from one frame, without predictions: each corner's overdue sample, and the sample that it completes.
_ROWS_A_FRAME = 8


class Buffers(NamedTuple):
    """All buffers for turning frames into samples, allocated once; see `Pipeline` for their content."""

    layout: np.ndarray
    receptions: np.ndarray
    corners: np.ndarray
    disturbed: np.ndarray
    samples: np.ndarray


_BUFFERS = Buffers(Array(LAYOUT), Array(RECEPTION), Array(CORNER), Array(np.int64), Array(SAMPLE))


class Pipeline:
    """The state of one process and its buffers.

    Args:
        parameters: PARAMETERS array, shape (4,), one record for each corner FL, FR, RL, RR.
        corners: names of the corners to estimate.
        layout: LAYOUT array, shape (1,).
        capacity: rows that one call of `consume` can hold.
        adaptation: `adapt.adaptation.Adaptation` that learns into ``parameters``; without it nothing is requested or learned.

    Attributes:
        states: STATE array, shape (4,): the estimators.
        samples, estimates: SAMPLE and ESTIMATE rows of the last call, row by row.
    """

    def __init__(
        self, parameters: np.ndarray, corners: Sequence[str] = wire.CORNERS, layout: np.ndarray | None = None,
        capacity: int = 4096, adaptation: Adaptation | None = None,
    ):  # fmt: skip
        self.parameters = parameters
        self.states: np.ndarray = new_state(4)
        self.corners: np.ndarray = np.zeros(4, CORNER)
        self.corners["active"] = [name in corners for name in wire.CORNERS]
        self.corners["pending"] = -1
        self.corners["second_sender_ns"] = -2 * SHOWN_NS
        self.samples: np.ndarray = np.zeros(capacity, SAMPLE)
        self.estimates: np.ndarray = np.zeros(capacity, ESTIMATE)
        self.frames: np.ndarray = np.zeros(4 * capacity, FRAME)
        #: Reason bits that the loop adds to estimates, because frames do not show them: bus and deadlines.
        self.disturbed: np.ndarray = np.zeros(4, np.int64)
        self.layout: np.ndarray = wire.default_layout() if layout is None else layout
        self.receptions: np.ndarray = new_reception()
        self.transmission: np.ndarray = np.zeros(1, TRANSMISSION)
        self.adaptation = adaptation
        self._limits = adaptation.limits if adaptation else np.zeros(4, LIMITS)
        if adaptation:
            adaptation.restore(parameters)
        self._buffers = Buffers(self.layout, self.receptions, self.corners, self.disturbed, self.samples)

    def begin(self, time_ns: int) -> None:
        """Set the time at which reception began, so that missing inputs are reported from the start."""
        self.corners["sample_ns"] = time_ns

    def begin_anew(self, corner: int, parameters: np.void) -> None:
        """Estimate a corner with a PARAMETERS record from its next sample on, as after a restart."""
        self.parameters[corner] = parameters
        self.states[corner] = new_state()[0]
        for name in ("started", "cycle", "announced", "predicted", "late_ns", "agreed"):
            self.corners[name][corner] = 0

    def why_not_at_rest(self) -> str:
        """Why the car is not known to stand with its brakes released, in words; empty if it is."""
        status, wheels = self.receptions[wire.VEHICLE_STATUS], self.receptions[wire.WHEEL_SPEED]
        for index in np.flatnonzero(self.corners["active"]):
            corner, name = self.corners[index], wire.CORNERS[index]
            now = corner["sample_ns"]
            if not corner["started"] or corner["predicted"]:
                return f"corner {name} sends no samples"
            if self.states[index]["contact"]["engaged"]:
                return f"corner {name} is not released"
            if now - status["time_ns"] >= _USABLE_NS:
                return "no vehicle status is received"
            if now - wheels["time_ns"] < _USABLE_NS and wheels["values"][index] > TURNING_RAD_PER_S:
                return f"wheel {name} turns"
        if status["values"][wire.VEHICLE_SPEED] > 0.0:
            return "the vehicle moves"
        if status["values"][wire.BRAKE_REQUEST] != 0.0:
            return "braking is requested"
        return ""

    def distrust(self, corners: Iterable[str]) -> None:
        """Mark the estimates of these corners as Fault, because they or their inputs cannot be authenticated."""
        for name in corners:
            self.corners["unproven"][wire.CORNERS.index(name)] = True

    def collect(self, frames: np.ndarray, start: int = 0, predictions: bool = True) -> tuple[int, int]:
        """Take ``frames[start:]`` (FRAME array in arrival order) until all are taken or the buffer of samples is nearly full.

        Returns (index of the next frame, number of rows in ``self.samples``)."""
        return _collect(self._buffers, frames, start, _ALL if predictions else _NONE, 0)

    def overdue(self, time_ns: int, count: int = 0) -> int:
        """Add rows for samples and predictions that are overdue at ``time_ns``, after the first ``count``; returns the new
        count.

        If several predictions of a corner are due, only the newest is made, because the others are out of date."""
        return _overdue(self._buffers, time_ns, _NEWEST, count)

    def answer(self, count: int) -> None:
        """Estimate the first ``count`` rows of ``self.samples`` into ``self.estimates``."""
        if self.adaptation:
            self.adaptation.answer(self.samples, count, self.states, self.parameters, self.estimates)
        else:
            answer(self.samples, count, self.states, self.parameters, self.estimates)

    def consume(self, frames: np.ndarray, start: int = 0) -> tuple[int, int]:
        """`collect` and `answer`."""
        start, count = self.collect(frames, start)
        self.answer(count)
        return start, count

    def broadcast(self, count: int) -> np.ndarray:
        """The frames that announce the first ``count`` estimates, in sending order."""
        return self.frames[: _broadcast(self.estimates, count, self.transmission, self.layout, self._limits, self.frames)]


@entry(_BUFFERS, Array(FRAME), int, int, int, returns=2)
def _collect(b, frames, start, predictions, count):
    while start < len(frames) and count + _ROWS_A_FRAME < len(b.samples):
        frame = frames[start]
        count = _overdue(b, frame.time_ns, predictions, count)
        if count + _ROWS_A_FRAME >= len(b.samples):
            break
        start += 1
        slot, verdict = receive(frame, b.receptions, b.layout[0])
        _hear(b, slot, frame.time_ns)
        if verdict == SECOND_SENDER:
            _record_second_sender(b, frame)
        if verdict != ACCEPTED or slot >= wire.WHEEL_SPEED or slot % wire.CORNER_MESSAGES > wire.CURRENT:
            continue
        index = slot // wire.CORNER_MESSAGES
        corner = b.corners[index]
        if not corner.active:
            continue
        resolver = b.receptions[wire.CORNER_MESSAGES * index + wire.RESOLVER]
        if slot % wire.CORNER_MESSAGES == wire.RESOLVER:
            if corner.pending >= 0:
                count = _complete(b, index, count)
            corner.pending = resolver.counter
            corner.pending_ns = resolver.time_ns
            # In whole cycles: the same of stamps that a log has rounded.
            corner.pending_late_ns = CYCLE_NS * ((lateness(resolver, CYCLE_NS) + CYCLE_NS // 2) // CYCLE_NS)
            corner.pending_angle = resolver.values[wire.MOTOR_ANGLE]
            corner.pending_speed = resolver.values[wire.MOTOR_SPEED]
        if corner.pending >= 0 and _paired(b, index, wire.CURRENT):
            count = _complete(b, index, count)
    return start, count


@njit
def _hear(b, slot, time_ns):
    """Note whether a corner's motor controller was silent for so long that it may have been without power: nothing came of
    it, not even a frame that is refused."""
    if 0 <= slot < wire.WHEEL_SPEED and slot % wire.CORNER_MESSAGES in (wire.RESOLVER, wire.CURRENT):
        corner = b.corners[slot // wire.CORNER_MESSAGES]
        corner.was_silent = corner.was_silent or time_ns - corner.heard_ns > _HELD_UP_NS
        corner.heard_ns = time_ns


@njit
def _paired(b, index, kind):
    """Whether the message that belongs to the pending resolver sample has come: its current, or its force sensor's."""
    corner, reception = b.corners[index], b.receptions[wire.CORNER_MESSAGES * index + kind]
    return reception.counter == corner.pending and abs(reception.time_ns - corner.pending_ns) < CYCLE_NS


@njit
def _record_second_sender(b, frame):
    for kind in range(len(b.layout[0].sent_cycle_ns)):
        for index in range(4):
            if b.layout[0].sent_id[kind, index] == frame.can_id:
                b.corners[index].second_sender_ns = frame.time_ns


@entry(_BUFFERS, int, int, int, returns=1)
def _overdue(b, time_ns, predictions, count):
    for index in range(4):
        corner = b.corners[index]
        if not corner.active:
            continue
        if corner.pending >= 0 and time_ns - corner.pending_ns > _PAIRING_NS:
            count = _complete(b, index, count)
        if predictions == _NEWEST:
            corner.predicted = max(corner.predicted, (time_ns - corner.sample_ns) // CYCLE_NS - LATE_CYCLES)
        while (
            predictions != _NONE
            and time_ns - corner.sample_ns >= (LATE_CYCLES + corner.predicted) * CYCLE_NS
            and count + _ROWS_A_FRAME < len(b.samples)
        ):
            row = b.samples[count]
            count += 1
            row.is_prediction = True
            _head(b, row, index, LATE_CYCLES + corner.predicted)
            corner.predicted += 1
    return count


@njit
def _cycles(corner, counter, time_ns):
    """Cycles from the corner's last sample to this one, at least 1; moves the corner's clock.

    The Counter gives the number of cycles modulo 15, whatever the delay of the frame. It is used as long as delays of frames
    are made up for by later ones. In a log at a reduced rate the Counter counts frames instead of cycles, and a sender can
    pause, or begin anew with any counter: then the delay is too long, stays or grows, and the time of arrival is used until
    both agree again."""
    step = (counter - corner.counter) % COUNTER_MODULO
    if step == 0:
        step = COUNTER_MODULO
    late = time_ns - corner.clock_ns - step * CYCLE_NS
    wraps = COUNTER_MODULO * max(0, round(late / (COUNTER_MODULO * CYCLE_NS)))
    if abs(late - wraps * CYCLE_NS) <= _JITTER_NS:
        late -= wraps * CYCLE_NS
        step += wraps
    counted = abs(late) <= _JITTER_NS
    if counted:
        corner.agreed = min(corner.agreed + 1, _AGREED)
        corner.late_ns = 0
        # The senders' clocks differ from this machine's; follow them slowly.
        corner.clock_ns += step * CYCLE_NS + late // 16
        return step
    recovering = corner.late_ns == 0 or late < corner.late_ns - CYCLE_NS // 2
    if corner.agreed == _AGREED and 0 < late <= _HELD_UP_NS and recovering:
        corner.late_ns = late
        corner.clock_ns += step * CYCLE_NS
        return step
    passed = max(1, round((time_ns - corner.clock_ns) / CYCLE_NS))
    corner.agreed = 0
    corner.late_ns = 0
    corner.clock_ns = time_ns
    return passed


@njit
def _complete(b, index, count):
    """Turn the pending resolver sample into a row; returns the new count."""
    corner = b.corners[index]
    row = b.samples[count]
    base = wire.CORNER_MESSAGES * index
    now = corner.pending_ns
    cycles = _cycles(corner, corner.pending, now) if corner.started else 0
    row.is_prediction = False
    row.dt = cycles * CYCLE_S
    row.was_silent, corner.was_silent = corner.was_silent, False
    row.angle = corner.pending_angle
    row.speed = corner.pending_speed
    # The error of a value that its sender reports as degraded is unknown. Instead of the current the force can use the
    # stiffness path. If the resolver is degraded as well, or for any other signal, there is no alternative.
    degraded_alone = b.receptions[base + wire.CURRENT].degraded and not b.receptions[base + wire.RESOLVER].degraded
    row.has_current = _paired(b, index, wire.CURRENT) and not degraded_alone
    row.current_q = b.receptions[base + wire.CURRENT].values[wire.CURRENT_Q]
    sensor = b.receptions[base + wire.FORCE_SENSOR]
    row.has_sensor_force = _paired(b, index, wire.FORCE_SENSOR) and not sensor.degraded
    row.sensor_force = sensor.values[wire.SENSOR_FORCE]
    thermocouple = b.receptions[base + wire.THERMOCOUPLE]
    row.has_thermocouple = now - thermocouple.time_ns < _USABLE_NS
    row.inner_backplate = thermocouple.values[wire.INNER_BACKPLATE]
    row.outer_backplate = thermocouple.values[wire.OUTER_BACKPLATE]
    row.caliper = thermocouple.values[wire.CALIPER]
    speed = b.receptions[wire.WHEEL_SPEED]
    row.has_wheel_speed = now - speed.time_ns < _USABLE_NS
    row.wheel_speed = speed.values[index]
    pulse = b.receptions[wire.WHEEL_PULSE]
    row.has_wheel_pulse = now - pulse.time_ns < _USABLE_NS
    row.wheel_pulse = pulse.values[index]
    status = b.receptions[wire.VEHICLE_STATUS]
    row.has_status = now - status.time_ns < _USABLE_NS
    row.park_brake = status.values[wire.PARK_BRAKE]
    row.brake_request = status.values[wire.BRAKE_REQUEST]
    row.ambient = status.values[wire.AMBIENT]
    row.vehicle_speed = status.values[wire.VEHICLE_SPEED]
    row.brake_torque = np.nan

    corner.cycle += cycles
    # A sender that does not keep its schedule (`_cycles`) is never late.
    corner.sample_late_ns = corner.pending_late_ns if corner.agreed > 0 else 0
    if not corner.started:
        corner.clock_ns = now
    corner.started = True
    corner.counter = corner.pending
    corner.sample_ns = now
    corner.predicted = 0
    corner.pending = -1
    _head(b, row, index, 0)
    return count + 1


@njit
def _head(b, row, index, age):
    """Fill time, counter and corner of a row, ``age`` cycles after the corner's last sample, and reasons from outside."""
    corner = b.corners[index]
    now = corner.sample_ns + age * CYCLE_NS
    row.corner = index
    row.time_ns = now
    row.counter = corner.counter if corner.started else 15
    row.age_cycles = age
    row.late_ns = corner.sample_late_ns
    row.cycle = corner.cycle + age
    # A sample after predictions may be older than the last of them, whose cycle has already been announced.
    row.elapsed_cycles = max(row.cycle - corner.announced, 0)
    corner.announced = max(row.cycle, corner.announced)

    reasons = b.disturbed[index]
    if row.late_ns > _JITTER_NS:
        reasons |= contract.BUS_DISTURBED
    base = wire.CORNER_MESSAGES * index
    if age >= LATE_CYCLES:
        reasons |= contract.RESOLVER_LOST
    if now - b.receptions[base + wire.CURRENT].time_ns >= LATE_CYCLES * CYCLE_NS:
        reasons |= contract.CURRENT_LOST
    for slot, reason in (
        (base + wire.THERMOCOUPLE, contract.THERMOCOUPLE_LOST),
        (wire.WHEEL_SPEED, contract.WHEEL_SPEED_LOST),
        (wire.WHEEL_PULSE, contract.WHEEL_PULSE_LOST),
        (wire.VEHICLE_STATUS, contract.VEHICLE_STATUS_LOST),
    ):
        if now - b.receptions[slot].time_ns > _REPORTED_CYCLES * b.layout[0].cycle_ns[slot]:
            reasons |= reason
    for slot in (base, base + 1, base + 2, base + 3, wire.WHEEL_SPEED, wire.WHEEL_PULSE, wire.VEHICLE_STATUS):
        degraded = b.receptions[slot].degraded and now - b.receptions[slot].time_ns < SHOWN_NS
        if degraded or now - b.receptions[slot].refused_ns < SHOWN_NS:
            reasons |= contract.E2E_ERROR
        if now - b.receptions[slot].range_ns < SHOWN_NS:
            reasons |= contract.OUT_OF_RANGE
        if now - b.receptions[slot].contested_ns < SHOWN_NS:
            reasons |= contract.CONTESTED
    if corner.unproven:
        reasons |= contract.E2E_ERROR | contract.CONTESTED
    if now - corner.second_sender_ns < SHOWN_NS:
        reasons |= contract.SECOND_SENDER
    row.reasons = reasons


@njit
def _status_of(e, kind):
    """Status of one of an estimate's messages."""
    if e.mode == contract.INIT or (kind == wire.PAD_TEMP and np.isnan(e.surface[0])):
        return contract.STATUS_NOT_AVAILABLE
    if e.mode == contract.FAULT:
        return contract.STATUS_FAULT
    return contract.STATUS_DEGRADED if e.reasons else contract.STATUS_OK


@njit
def _set_values(e, kind, asked, values):
    """Signals of one of an estimate's messages, in the DBC's order and units; ``asked``: LIMITS of its corner."""
    if kind == wire.CLAMP_FORCE:
        values[0] = 1e-3 * e.force
        values[1] = np.inf if e.mode == contract.INIT or e.mode == contract.FAULT else 1e-3 * e.sigma
        values[2] = e.counter
        values[3] = e.source
        values[4] = e.age_cycles * (CYCLE_NS // 1_000_000) + e.late_ns // 1_000_000
    elif kind == wire.PAD_TEMP:
        values[0], values[1] = e.surface[0], e.mean[0]
        values[2], values[3] = e.surface[1], e.mean[1]
    elif kind == wire.ESTIMATOR_STATUS:
        values[0] = e.mode
        values[1] = e.stiffness_factor
        values[2] = e.contact_angle
        values[3] = e.reasons & 0xFFFF
    else:
        values[0], values[1], values[2] = e.adapt_request, e.adapt_progress, e.adapt_result
        values[3], values[4] = 1e-3 * asked.low_force, 1e-3 * asked.high_force
        values[5], values[6] = asked.dither_amplitude, asked.dither_frequency


@entry(Array(ESTIMATE), int, Array(TRANSMISSION), Array(LAYOUT), Array(LIMITS), Array(FRAME), returns=1)
def _broadcast(estimates, count, transmission, layout, limits, frames):
    """Encode estimates; a message is due when its period has passed. Returns the number of frames."""
    wires, counters, values = layout[0], transmission[0].counter, transmission[0].values
    sent = 0
    for number in range(count):
        e = estimates[number]
        for kind in range(4):
            period = wires.sent_cycle_ns[kind] // CYCLE_NS
            if kind != wire.CLAMP_FORCE and e.cycle // period == (e.cycle - e.elapsed_cycles) // period:
                continue
            _set_values(e, kind, limits[e.corner], values)
            payload = np.uint64(0)
            for column in range(wires.sent_count[kind]):
                payload |= pack(values[column], wires.sent[kind, column])
            can_id = wires.sent_id[kind, e.corner]
            counter = counters[kind, e.corner]
            counters[kind, e.corner] = (counter + 1) % COUNTER_MODULO
            data = protect(can_id, payload, counter, _status_of(e, kind))
            sent = put(frames, sent, e.time_ns, can_id, data, 0)
    return sent
