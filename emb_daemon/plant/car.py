"""The car: one to four brakes, longitudinal motion, training motion on request, and all its messages on the bus."""

from functools import cache
from math import cos, pi
from typing import NamedTuple

import numpy as np

from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.jit import njit
from emb_daemon.logs.columns import DEPTHS_MM
from emb_daemon.plant.brake import clamp, delayed_angle, delayed_mean_current, growth, motor_angle, move_motor, static_angle
from emb_daemon.plant.controller import current_demand, set_target
from emb_daemon.plant.heat import heat_cycle, pad_at, pad_mean
from emb_daemon.plant.records import ANGLE, CAR, CYCLE_NS, HISTORY, PLANT, PLANT_STATE, SUBSTEP_S, SUBSTEPS, TRAINING, TRUTH
from emb_daemon.resources import resource
from emb_daemon.wire import layout as wire
from emb_daemon.wire.contract import CYCLE_S, PARK_APPLIED, PULSE_MODULO, PULSES_PER_TURN
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import SIGNAL, pack, unpack

#: Period of the slow clamp and release of training motion, and time in which a corner moves from its position into it.
TRAINING_PERIOD_S = 20.0
_JOINING_S = 1.0
#: Number of cycles without a request after which training ends, because the daemon has stopped.
_SILENCE_CYCLES = 25
#: A low force of zero in a request means: into the clearance, this far before contact.
_BEFORE_CONTACT_RAD = 2.0
_SLOW_NS, _STATUS_NS, _REFERENCE_SLOW_NS = 10_000_000, 100_000_000, 100_000_000
#: Delay of the slow messages after their sample, and of the rig's instruments after the resolver's frame.
_AFTER_NS, _REFERENCE_AFTER_NS = 900_000, 400_000
#: Frames leave up to this late after their sample, s.
_JITTER_S = 150e-6
#: What a wheel turns by in the range of its counter, and while that counts one, rad.
COUNTER_RAD, COUNT_RAD = PULSE_MODULO / PULSES_PER_TURN * 2.0 * pi, 2.0 * pi / PULSES_PER_TURN
#: Frames that one cycle can hold with four corners and reference instruments.
FRAMES_PER_TICK = 32

#: Layouts of the rig's own messages: force, inner pad, outer pad; ``id[kind, corner]``.
REFERENCE_WIRES = np.dtype([("signal", SIGNAL, (3, 4)), ("id", "i8", (3, 4))], align=True)


class World(NamedTuple):
    """The car and its messages: CAR, shape (1,), records by corner, numbers of the corners, LAYOUT and REFERENCE_WIRES, shape
    (1,), CAN ids by slot. The random generator is not in the tuple, because numba would then take ms to recognise its type."""

    car: np.ndarray
    plants: np.ndarray
    states: np.ndarray
    trainings: np.ndarray
    corners: np.ndarray
    wires: np.ndarray
    reference: np.ndarray
    ids: np.ndarray


@cache
def _reference_wires() -> np.ndarray:
    """REFERENCE_WIRES of the shipped rig; read only."""
    database = wire.load_database(resource("dbc/rig.dbc"))
    wires = np.zeros(1, REFERENCE_WIRES)
    kinds = (
        ("Force", ("ClampForceRef", "BrakeTorqueRef", "DiscTempRef")),
        ("InnerPad", tuple(f"InnerPadTemp{depth}mm" for depth in DEPTHS_MM)),
        ("OuterPad", tuple(f"OuterPadTemp{depth}mm" for depth in DEPTHS_MM)),
    )
    for kind, (name, signals) in enumerate(kinds):
        for corner, label in enumerate(wire.CORNERS):
            message = f"RIG_{label}_{name}"
            wires[0]["signal"][kind, : len(signals)] = wire.signal_columns(database, message, signals)
            wires[0]["id"][kind, corner] = database.get_message_by_name(message).frame_id
    return wires


@njit
def _train(s, training, command, drive, standing):
    """The command with which training motion replaces ``command``; changes ``training``."""
    allowed = drive.park_brake == PARK_APPLIED and drive.brake_request == 0 and standing
    training.silent += 1
    if training.silent > _SILENCE_CYCLES:
        training.requested = False
    if not (training.requested and allowed):
        training.running = False
        return command.mode, command.target, command.rate
    if not training.running:
        training.running, training.tick, training.start = True, 0, s.angle
    time = training.tick * CYCLE_S
    training.tick += 1
    after = _training_angle(training, time + CYCLE_S)
    now = _training_angle(training, time)
    return ANGLE, now, (after - now) / CYCLE_S


@njit
def _training_angle(training, time):
    slow = training.low + (training.high - training.low) * 0.5 * (1.0 - cos(2.0 * pi * time / TRAINING_PERIOD_S))
    if time < _JOINING_S:
        share = 0.5 * (1.0 + cos(pi * time / _JOINING_S))
        slow += share * (training.start - slow)
    return slow + training.amplitude * np.sin(2.0 * pi * training.frequency * time)


@njit
def _corner_cycle(p, s, mode, target, rate, wheel_speed, wheel_gain, ambient, rng):
    """One 4 ms cycle of one corner; the wheel runs from ``wheel_speed`` and gains ``wheel_gain`` rad/s in it."""
    set_target(p, s, mode, target, rate)
    current = 0.0
    for step in range(SUBSTEPS):
        s.wheel_angle += SUBSTEP_S * (wheel_speed + wheel_gain * (step + 0.5) / SUBSTEPS)
        move_motor(p, s, current_demand(p, s))
        clamp(p, s)
        current += s.current
        s.history_at = (s.history_at + 1) % HISTORY
        s.angle_history[s.history_at] = s.angle
        s.current_history[s.history_at] = s.current
    s.mean_current = current / SUBSTEPS
    # Ornstein-Uhlenbeck noise of the current sensor at four points of the cycle, averaged as the sensor does.
    decay = np.exp(-0.25 * CYCLE_S / p.current_noise_time)
    # Variance of the mean of four such values, a quarter of a cycle apart, as a share of the variance of one.
    averaged = (4.0 + 6.0 * decay + 4.0 * decay**2 + 2.0 * decay**3) / 16.0
    spread = p.current_noise * np.sqrt((1.0 - decay * decay) / averaged)
    error = 0.0
    for _ in range(4):
        s.current_error = decay * s.current_error + spread * rng.standard_normal()
        error += 0.25 * s.current_error
    s.mean_current_error = error
    heat_cycle(p, s, wheel_speed + wheel_gain, ambient)


@njit
def _put(frames, count, time_ns, can_id, data):
    """Insert a frame in order of time; returns the new count."""
    place = count
    while place > 0 and frames[place - 1].time_ns > time_ns:
        frames[place] = frames[place - 1]
        place -= 1
    frame = frames[place]
    frame.time_ns, frame.can_id, frame.data, frame.length, frame.flags = time_ns, can_id, data, 8, 0
    return count + 1


@njit
def _send(w, slot, payload, frames, count, time_ns):
    """A protected message of the car that leaves at ``time_ns``; returns the new count."""
    counters, can_id = w.car[0].counter, w.ids[slot]
    counter = counters[slot]
    counters[slot] = (counter + 1) % COUNTER_MODULO
    return _put(frames, count, time_ns, can_id, protect(can_id, payload, counter, 0))


@njit
def _send_late(w, rng, slot, payload, frames, count, due_ns, least_late):
    """A protected message of the car that leaves by ``least_late`` to ``least_late`` + 1 times the jitter after ``due_ns``."""
    return _send(w, slot, payload, frames, count, due_ns + np.int64(1e9 * _JITTER_S * (least_late + rng.random())))


@njit
def _fast_frames(w, rng, row, frames, count):
    """Resolver and current of one sample share their counter."""
    car, p, s, received = w.car[0], w.plants[row], w.states[row], w.wires[0].received
    base = wire.CORNER_MESSAGES * w.corners[row]
    noisy = p.released_angle + delayed_angle(p, s) + p.angle_noise * rng.standard_normal()
    # Resolver-to-digital converters have hysteresis, so that a standing motor gives a constant angle.
    if abs(noisy - s.angle_reading) > 0.5 * p.angle_count + p.angle_hysteresis:
        s.angle_reading = p.angle_count * np.floor(noisy / p.angle_count + 0.5)
    speed = s.speed + p.speed_noise * rng.standard_normal()
    payload = pack(s.angle_reading, received[base, 0]) | pack(speed, received[base, 1])
    count = _send_late(w, rng, base + wire.RESOLVER, payload, frames, count, car.time_ns, 0.0)
    slot = base + wire.CURRENT
    mean = s.mean_current if p.effects.current_delay.delay_s == 0.0 else delayed_mean_current(p, s)
    current = mean + s.mean_current_error - p.effects.current_offset.offset_A
    payload = pack(current, received[slot, 0]) | pack(0.15 * rng.standard_normal(), received[slot, 1])
    payload |= pack(car.supply_voltage, received[slot, 2])
    return _send_late(w, rng, slot, payload, frames, count, car.time_ns, 0.5)


@njit
def _sensor_frame(w, rng, row, frames, count):
    """The force sensor's, first of its sample and with the counter of the others."""
    car, p, s, received = w.car[0], w.plants[row], w.states[row], w.wires[0].received
    slot = wire.CORNER_MESSAGES * w.corners[row] + wire.FORCE_SENSOR
    s.sensor_zero += p.sensor_walk * np.sqrt(CYCLE_S) * rng.standard_normal()
    zero = p.sensor_offset + s.sensor_zero + p.sensor_per_K * (s.caliper - p.curve_temperature)
    value = (1.0 + p.sensor_gain) * s.force + zero + p.sensor_noise * rng.standard_normal()
    payload = pack(min(max(value, -p.sensor_limit), p.sensor_limit), received[slot, wire.SENSOR_FORCE])
    return _send(w, slot, payload, frames, count, car.time_ns)


@njit
def _slow_frames(w, rng, drive, frames, count, due_ns):
    """Thermocouples, wheels and, ten times a second, the vehicle's status; sampled at ``due_ns``, within this cycle."""
    car, received = w.car[0], w.wires[0].received
    leaves_ns = due_ns + _AFTER_NS
    for row in range(len(w.corners)):
        p, s = w.plants[row], w.states[row]
        slot = wire.CORNER_MESSAGES * w.corners[row] + wire.THERMOCOUPLE
        payload = pack(s.plate_reading[0] + p.temperature_noise * rng.standard_normal(), received[slot, 0])
        payload |= pack(s.plate_reading[1] + p.temperature_noise * rng.standard_normal(), received[slot, 1])
        payload |= pack(s.caliper + p.temperature_noise * rng.standard_normal(), received[slot, 2])
        count = _send_late(w, rng, slot, payload, frames, count, leaves_ns, 0.0)
    speeds, pulses = np.uint64(0), np.uint64(0)
    elapsed = 1e-9 * (due_ns - car.time_ns)
    for corner in range(4):
        speeds |= pack(car.wheel_speed, received[wire.WHEEL_SPEED, corner])
        angle = w.states[0].wheel_angle
        for row in range(len(w.corners)):
            if w.corners[row] == corner:
                angle = w.states[row].wheel_angle
        angle += elapsed * car.wheel_speed
        pulse = np.int64(np.floor(angle / (2.0 * pi) * PULSES_PER_TURN)) % PULSE_MODULO
        pulses |= pack(float(pulse), received[wire.WHEEL_PULSE, corner])
    count = _send_late(w, rng, wire.WHEEL_SPEED, speeds, frames, count, leaves_ns, 0.0)
    count = _send_late(w, rng, wire.WHEEL_PULSE, pulses, frames, count, leaves_ns, 0.0)
    if due_ns % _STATUS_NS == 0:
        signals = received[wire.VEHICLE_STATUS]
        payload = pack(float(drive.park_brake), signals[0]) | pack(float(drive.brake_request), signals[1])
        payload |= pack(drive.ambient, signals[2]) | pack(car.speed, signals[3])
        count = _send_late(w, rng, wire.VEHICLE_STATUS, payload, frames, count, leaves_ns, 0.5)
    return count


@njit
def _reference_frames(w, rng, row, frames, count, slow):
    """Frames of a rig's instruments, without counter and CRC."""
    car, p, s = w.car[0], w.plants[row], w.states[row]
    signal, can_id = w.reference[0].signal, w.reference[0].id[:, w.corners[row]]
    force = s.force + p.force_lead * s.force_rate + p.force_noise * rng.standard_normal()
    torque = s.brake_torque + p.brake_torque_noise * rng.standard_normal()
    payload = pack(force, signal[0, 0]) | pack(torque, signal[0, 1])
    payload |= pack(s.disc + p.temperature_noise * rng.standard_normal(), signal[0, 2])
    sent = car.time_ns + _REFERENCE_AFTER_NS + np.int64(1e9 * _JITTER_S * rng.random())
    count = _put(frames, count, sent, can_id[0], payload)
    if slow:
        for side in range(2):
            payload = np.uint64(0)
            for index in range(len(DEPTHS_M)):
                reading = pad_at(p, s, side, DEPTHS_M[index]) + p.temperature_noise * rng.standard_normal()
                payload |= pack(reading, signal[1 + side, index])
            count = _put(frames, count, sent, can_id[1 + side], payload)
    return count


@njit
def _record(car, p, s, corner, counter, drive, training, truth):
    truth.time_ns, truth.corner, truth.counter = car.time_ns, corner, counter
    truth.force, truth.static_force = s.force, s.static_force
    truth.angle, truth.speed, truth.current = p.released_angle + s.angle, s.speed, s.mean_current
    truth.contact_angle = p.released_angle + motor_angle(p, p.contact_angle - growth(p, s))
    truth.stiffness_factor, truth.brake_torque = s.stiffness_factor, s.brake_torque
    for side in range(2):
        truth.surface[side], truth.mean[side], truth.plate[side] = s.surface[side], pad_mean(p, s, side), s.plate[side]
        for index in range(len(DEPTHS_M)):
            inside = DEPTHS_M[index] <= p.pad_thickness
            truth.depth[side, index] = pad_at(p, s, side, DEPTHS_M[index]) if inside else np.nan
    truth.caliper, truth.disc = s.caliper, s.disc
    truth.wheel_speed, truth.wheel_angle, truth.vehicle_speed = car.wheel_speed, s.wheel_angle, car.speed
    truth.wear, truth.training = s.wear, training.running
    truth.park_brake, truth.brake_request = drive.park_brake, drive.brake_request


@njit
def _drive(car, states, drive):
    """Longitudinal motion over one cycle; returns the wheel speed at its start."""
    before = car.wheel_speed
    if not np.isnan(drive.wheel_speed):
        car.wheel_speed = drive.wheel_speed
        car.speed = car.wheel_speed * car.wheel_radius
        return before
    force = -car.drag * car.speed * car.speed
    if car.speed > 0.0:
        force -= car.rolling
    for row in range(len(states)):
        force -= states[row].brake_torque / car.wheel_radius
    acceleration = force / car.mass
    if not np.isnan(drive.target_speed):
        wanted = 2.0 * (drive.target_speed - car.speed)
        acceleration += min(max(wanted - acceleration, 0.0), car.acceleration)
    # Brakes and drag stop a car, but never push it backwards.
    car.speed = max(car.speed + CYCLE_S * acceleration, 0.0)
    car.wheel_speed = car.speed / car.wheel_radius
    return before


@njit
def _tick(w, rng, commands, drive, frames, truth):
    """Advance everything by one cycle and write its frames in order of time; returns their number."""
    car = w.car[0]
    wheel_speed = _drive(car, w.states, drive)
    car.time_ns += CYCLE_NS
    car.tick += 1
    slow_reference = car.time_ns // _REFERENCE_SLOW_NS != (car.time_ns - CYCLE_NS) // _REFERENCE_SLOW_NS
    # An integer of numpy: for Python's zero numba would compile the functions that take the count a second time.
    count = np.int64(0)
    for row in range(len(w.corners)):
        p, s, training, corner = w.plants[row], w.states[row], w.trainings[row], w.corners[row]
        mode, target, rate = _train(s, training, commands[row], drive, car.speed == 0.0)
        _corner_cycle(p, s, mode, target, rate, wheel_speed, car.wheel_speed - wheel_speed, drive.ambient, rng)
        _record(car, p, s, corner, car.counter[wire.CORNER_MESSAGES * corner], drive, training, truth[row])
        if p.sensor_limit > 0.0:
            count = _sensor_frame(w, rng, row, frames, count)
        count = _fast_frames(w, rng, row, frames, count)
        if car.reference:
            count = _reference_frames(w, rng, row, frames, count, slow_reference)
    due = (car.time_ns + _SLOW_NS - 1) // _SLOW_NS * _SLOW_NS
    if due < car.time_ns + CYCLE_NS:
        count = _slow_frames(w, rng, drive, frames, count, due)
    return count


@njit
def _run(w, rng, commands, drives, frames, truth):
    total = 0
    for tick in range(len(drives)):
        total += _tick(w, rng, commands[tick], drives[tick], frames[total:], truth[tick])
    return total


@njit
def _receive(w, frames):
    """Read adaptation requests from the frames on the bus."""
    wires = w.wires[0]
    signals = wires.sent[wire.ADAPT_REQUEST]
    for index in range(len(frames)):
        frame = frames[index]
        for row in range(len(w.corners)):
            if np.int64(frame.can_id) != wires.sent_id[wire.ADAPT_REQUEST, w.corners[row]]:
                continue
            training, p = w.trainings[row], w.plants[row]
            training.silent = 0
            training.requested = unpack(frame.data, signals[0]) == 1.0
            low = 1e3 * unpack(frame.data, signals[3])
            before = 0.0 if low > 0.0 else _BEFORE_CONTACT_RAD
            training.low = motor_angle(p, p.contact_angle + static_angle(p, low)) - before
            training.high = motor_angle(p, p.contact_angle + static_angle(p, 1e3 * unpack(frame.data, signals[4])))
            training.amplitude = unpack(frame.data, signals[5])
            training.frequency = unpack(frame.data, signals[6])


def _released_states(plants: np.ndarray, ambient: float) -> np.ndarray:
    """PLANT_STATE of brakes that stand released, everything at ``ambient`` degC."""
    states = np.zeros(len(plants), PLANT_STATE)
    for field in ("pads", "surface", "plate", "plate_reading", "caliper", "disc"):
        states[field] = ambient
    states["stiffness_factor"] = 1.0
    states["uneven_disc"] = [any(row) for row in plants["effects"]["disc_thickness_variation"].tolist()]
    states["angle_reading"] = plants["released_angle"]
    states["past_contact"] = -plants["contact_angle"]
    states["softening_memory"] = ambient - plants["curve_temperature"]
    return states


class Car:
    """A car with brakes on ``corners``, standing, cold and released.

    Args:
        plants: PLANT array, one record per corner, in the order of ``corners``.
        reference: send the rig instruments' RIG_* frames too.
        start_ns: time of the first sample, less one cycle.
        ambient: degC; everything starts at this temperature.
        wheels_rad: that the wheels have turned by at most since their counters began, which they do at power-on.
    """

    def __init__(
        self,
        plants: np.ndarray,
        corners: tuple[str, ...] = ("FL",),
        seed: int = 0,
        reference: bool = False,
        start_ns: int = 0,
        ambient: float = 22.0,
        wheels_rad: float = COUNT_RAD,
    ):
        if len(plants) != len(corners):
            raise ValueError(f"{len(plants)} plants for {len(corners)} corners")
        self.plants: np.ndarray = np.ascontiguousarray(plants, PLANT)
        self.corners: tuple[str, ...] = tuple(corners)
        #: ``states``, ``trainings`` and ``motion``: PLANT_STATE and TRAINING arrays by corner, CAR array of shape (1,).
        self.states: np.ndarray = _released_states(self.plants, ambient)
        self.trainings: np.ndarray = np.zeros(len(plants), TRAINING)
        self.truth: np.ndarray = np.zeros(len(plants), TRUTH)  #: TRUTH array, one row per corner, of the last tick
        self._rng = rng = np.random.default_rng(seed)
        self.motion: np.ndarray = np.zeros(1, CAR)
        motion = self.motion[0]
        # A medium-sized car; each simulated brake stops a quarter of it.
        motion["mass"], motion["wheel_radius"] = 400.0 * len(corners), 0.31
        motion["drag"], motion["rolling"] = 0.1 * len(corners), 50.0 * len(corners)
        motion["acceleration"], motion["supply_voltage"] = 4.0, 13.5
        motion["time_ns"], motion["reference"] = start_ns, reference
        self.states["wheel_angle"] = rng.uniform(0.0, wheels_rad, len(plants))
        fast = wire.CORNER_MESSAGES * np.arange(4)
        drawn = np.setdiff1d(np.arange(wire.SLOTS), fast + wire.FORCE_SENSOR)
        motion["counter"][drawn] = rng.integers(0, COUNTER_MODULO, len(drawn))
        # The frames of a sample share their counter.
        for kind in (wire.CURRENT, wire.FORCE_SENSOR):
            motion["counter"][fast + kind] = motion["counter"][fast + wire.RESOLVER]
        layout = wire.default_layout()
        slots = layout["slot"][0]
        ids = np.zeros(wire.SLOTS, np.int64)
        for can_id in np.flatnonzero(slots >= 0):
            ids[slots[can_id]] = can_id
        places = np.array([wire.CORNERS.index(corner) for corner in corners])
        self._world = World(self.motion, self.plants, self.states, self.trainings, places, layout, _reference_wires(), ids)
        self._frames = np.zeros(FRAMES_PER_TICK, FRAME)

    def tick(self, commands: np.ndarray, drive: np.void) -> np.ndarray:
        """One 4 ms cycle under COMMAND rows (one per corner) and a DRIVE record.

        Returns the cycle's frames in order of time, as a FRAME array valid until the next call."""
        # As a run of one cycle: a kernel of its own would be compiled with all of the plant in it again.
        count = _run(self._world, self._rng, commands[None], drive.reshape(1), self._frames, self.truth[None])
        return self._frames[:count]

    def run(self, commands: np.ndarray, drives: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Many cycles at once: COMMAND array (cycles, corners) and DRIVE array (cycles,).

        Returns (FRAME array, TRUTH array of shape (cycles, corners))."""
        frames = np.zeros(len(drives) * FRAMES_PER_TICK, FRAME)
        truth = np.zeros((len(drives), len(self.corners)), TRUTH)
        count = _run(self._world, self._rng, commands, drives, frames, truth)
        return frames[:count].copy(), truth

    def receive(self, frames: np.ndarray) -> None:
        """Receive the daemon's frames: EMB_c_AdaptRequest starts and ends training motion."""
        _receive(self._world, frames)
