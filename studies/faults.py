"""Faults and changes that a drive of the simulated car can have, by family, with sizes and onsets drawn at random.

A family is a function of a random generator, of the drive's moments (s, by name) and of the brake's `Size`; it returns a
`Fault`, which acts on the brake before the drive, on the running car every 80 ms, or on the frames on their way to the daemon.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from emb_daemon.calibration.types import Calibration
from emb_daemon.jit import njit
from emb_daemon.plant.records import EFFECTS
from emb_daemon.wire import layout as wire
from emb_daemon.wire.e2e import protect
from emb_daemon.wire.layout import default_layout, pack, unpack


def _nothing(*_):
    return None


@dataclass
class Fault:
    """One fault or change."""

    size: str  #: what was drawn, in words
    onset_s: float = 0.0  #: when it begins; 0 where it is there from the start
    brake: Callable = _nothing  #: changes the PLANT record before the drive; ``pads_mm`` mounts other pads first
    pads_mm: float | None = None
    car: Callable = _nothing  #: called as (car, time_s) before every stretch of the drive
    bus: Callable = lambda frames, _: frames  #: called as (frames, time_s), returns the frames that reach the daemon
    effects: dict = field(default_factory=dict)  #: effects that both brake and calibration have, so that they are no change
    ambient_C: float = 22.0  #: of the surroundings, and at the start of everything except for ``warm_C``
    #: Of the disc, of plates and caliper, and the share of the pads' rise that their softening remembers.
    warm_C: tuple[float, float, float] | None = None
    power_on_s: float = 0.0  #: when the daemon first hears anything
    restarts: tuple[tuple[float, float], ...] = ()  #: (time, silence before it, in s) of further starts of the daemon
    latched_N: float = 0.0  #: the drive begins parked on the latch with this force

    @property
    def is_in_frames(self) -> bool:
        """Whether it acts on the frames alone, so that a log can have it."""
        return self.brake is self.car is _nothing and not (self.effects or self.pads_mm or self.warm_C or self.restarts)


class Size(NamedTuple):
    """Ratios of a brake to the shipped one, by which faults in newtons, amperes or N m s/rad are scaled."""

    force: float = 1.0
    current: float = 1.0
    damping: float = 1.0


def size_of(brake: Calibration, other: Calibration) -> Size:
    """Largest forces, currents that hold them, and their torques over the motors' largest speeds."""

    def of(c):
        force, torque = c.stiffness.maximum_force_N, c.motor.gear_gain_m_per_rad * c.stiffness.maximum_force_N
        return np.array([force, torque / c.motor.torque_constant_Nm_per_A, torque / c.motor.maximum_speed_rad_per_s])

    return Size(*(of(brake) / of(other)).tolist())


FAMILIES: dict[str, Callable] = {}
#: Families after which a few stops and a training must lead to a small error and a small sigma.
LEARNED = {
    "pads_thickness", "pads_compound", "contact_jump", "contact_slow", "knock_back", "current_offset", "current_offset_later",
    "gear_wear", "disc_growth",
}  # fmt: skip
#: Families without a fault.
NOMINAL = {"nominal"}


def _family(function: Callable) -> Callable:
    FAMILIES[function.__name__] = function
    return function


# Frames.

_LAYOUT = default_layout()[0]
_IDS = {int(_LAYOUT["slot"][can_id]): can_id for can_id in np.flatnonzero(_LAYOUT["slot"] >= 0)}


@njit
def _read(frames, can_id, signal, rows, values):
    count = 0
    for row in range(len(frames)):
        if frames[row].can_id == can_id:
            rows[count], values[count] = row, unpack(frames[row].data, signal)
            count += 1
    return count


@njit
def _write(frames, rows, signal, values, degraded):
    mask = ((np.uint64(1) << np.uint64(signal.length)) - np.uint64(1)) << np.uint64(signal.start)
    for index in range(len(rows)):
        frame = frames[rows[index]]
        data = np.uint64(frame.data)
        counter = (data >> np.uint64(8)) & np.uint64(15)
        status = np.uint64(1) if degraded else (data >> np.uint64(12)) & np.uint64(15)
        payload = (data & ~mask & ~np.uint64(0xFFFF)) | pack(values[index], signal)
        frame.data = protect(frame.can_id, payload, counter, status)


def alter(slot: int, column: int, change: Callable, degraded: bool = False) -> Callable:
    """A bus on which ``change(values, time_s)`` replaces one signal of corner FL or of the car; counters and CRC are right.

    ``degraded``: the sender says so in its status."""
    can_id, signal = _IDS[slot], _LAYOUT["received"][slot, column]

    def bus(frames, time_s):
        rows, values = np.zeros(len(frames), np.int64), np.zeros(len(frames))
        count = _read(frames, can_id, signal, rows, values)
        _write(frames, rows[:count], signal, np.broadcast_to(change(values[:count], time_s), count).astype(float), degraded)
        return frames

    return bus


def chain(*buses: Callable) -> Callable:
    def bus(frames, time_s):
        for one in buses:
            frames = one(frames, time_s)
        return frames

    return bus


def during(bus: Callable, begin_s: float, end_s: float = np.inf) -> Callable:
    return lambda frames, time_s: bus(frames, time_s) if begin_s <= time_s < end_s else frames


def current_fault(told: str, at: float, change: Callable, **options: bool) -> Fault:
    """The torque-producing current changed (`alter`) from a time on."""
    return Fault(told, at, bus=during(alter(wire.CURRENT, wire.CURRENT_Q, change, **options), at))


def ids_of(*slots: int) -> list[int]:
    """CAN ids of the messages of some slots, of corner FL or of the car."""
    return [_IDS[slot] for slot in slots]


def lose(*slots: int) -> Callable:
    """A bus that loses the messages of some slots."""
    ids = ids_of(*slots)
    return lambda frames, _: frames[~np.isin(frames["can_id"], ids)]


def _hold(slot: int, column: int) -> Callable:
    """A bus on which one signal keeps the first value that it sees."""
    kept = []

    def change(values, _):
        if not kept and len(values):
            kept.append(values[0])
        return kept[0] if kept else values

    return alter(slot, column, change)


def _toggle(rng, slot: int, column: int) -> Callable:
    """As `_hold`, moving by a least count of a temperature, 0.1 K, up and down."""
    kept = []

    def change(values, _):
        if not kept and len(values):
            kept.append(values[0])
        return kept[0] + 0.1 * rng.integers(-1, 2, len(values)) if kept else values

    return alter(slot, column, change)


# Draws.


def draw_size(rng, low: float, high: float) -> float:
    """Log-uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_signed(rng, low: float, high: float) -> float:
    return draw_size(rng, low, high) * float(rng.choice((-1.0, 1.0)))


def pick_driving(rng, moments) -> float:
    """A moment with the brake released, before parking."""
    return float(moments[rng.choice(("go_1", "go_2", "go_3"))] + rng.uniform(0.5, 2.5))


def pick_clamped(rng, moments) -> float:
    """A moment with the brake applied, before parking."""
    return float(moments[rng.choice(("hold_1", "stop_1", "drag_1", "stop_2", "reversals"))] + rng.uniform(0.8, 2.0))


def pick_sometime(rng, moments) -> float:
    """The start, or a moment of driving or braking, or just before the training."""
    choice = rng.integers(4)
    return (0.0, pick_driving(rng, moments), pick_clamped(rng, moments), moments["park"] - 0.5)[choice]


def once(at_s: float, action: Callable) -> Callable:
    """Does ``action(plants)`` once, at ``at_s``."""
    done = []

    def car(car, time_s):
        if time_s >= at_s and not done:
            done.append(True)
            action(car.plants)

    return car


def _move(name: str, by: float) -> Callable:
    def action(plants):
        plants[name] += by

    return action


def scale(by: float, *names: str) -> Callable:
    def action(plants):
        for name in names:
            plants[name] *= by

    return action


def effect(name: str, **values) -> Callable:
    def action(plants):
        for key, value in values.items():
            plants["effects"][name][key] = value

    return action


def move_contact(plants, um: float) -> None:
    plants["contact_angle"] += 1e-6 * um / plants["gear_gain"]


# Nothing wrong, and units within the datasheet's tolerances.


@_family
def nominal(rng, moments, size):
    return Fault("a well calibrated unit")


@_family
def tolerance(rng, moments, size):
    """A unit with the calibration of another: torque constant within 3 %, other datasheet values within 15 %."""
    drawn = {"torque_constant": 0.03} | dict.fromkeys(
        ("inertia", "load_friction", "offset_friction", "presliding_angle", "curve", "conductivity", "specific_heat"), 0.15
    )

    def brake(plant):
        for name, bound in drawn.items():
            plant[name] *= 1.0 + rng.uniform(-bound, bound)

    return Fault("torque constant 3 %, others 15 %", brake=brake)


# Contact and stiffness.


@_family
def contact_jump(rng, moments, size):
    um, at = draw_signed(rng, 10.0, 150.0), pick_driving(rng, moments)
    return Fault(f"{um:+.0f} um", at, car=once(at, lambda plants: move_contact(plants, um)))


@_family
def contact_slow(rng, moments, size):
    um, at, seconds = draw_signed(rng, 10.0, 150.0), moments[rng.choice(("go_1", "park"))], 25.0
    state = [0.0]

    def car(car, time_s):
        share = min(max((time_s - at) / seconds, 0.0), 1.0)
        move_contact(car.plants, um * (share - state[0]))
        state[0] = share

    return Fault(f"{um:+.0f} um over 25 s", at, car=car)


@_family
def knock_back(rng, moments, size):
    """Between stops the contact moves, as cornering and run-out push pads back."""
    um, times = draw_size(rng, 10.0, 100.0), sorted(moments[name] + 1.0 for name in moments if name.startswith("go"))
    state = [0, 0.0]

    def car(car, time_s):
        if state[0] < len(times) and time_s >= times[state[0]]:
            shift = um * rng.standard_normal()
            move_contact(car.plants, shift - state[1])
            state[:] = state[0] + 1, shift

    return Fault(f"{um:.0f} um standard deviation", times[0], car=car)


@_family
def disc_growth(rng, moments, size):
    growth = draw_size(rng, 0.1, 0.5)
    return Fault(f"{growth:.2f} um/K", brake=effect("disc_thermal_expansion", growth_um_per_K=growth))


@_family
def pads_thickness(rng, moments, size):
    thickness = float(rng.uniform(3.0, 11.5))
    return Fault(f"{thickness:.1f} mm", pads_mm=thickness)


@_family
def pads_compound(rng, moments, size):
    factor = float(rng.uniform(0.7, 1.3))
    return Fault(f"curve x {factor:.2f}", brake=scale(factor, "curve"))


@_family
def wear(rng, moments, size):
    wear = draw_size(rng, 10.0, 200.0)
    return Fault(f"{wear:.0f} um/MJ", brake=effect("pad_wear", wear_um_per_MJ=wear))


@_family
def thickness_variation(rng, moments, size):
    um = draw_size(rng, 5.0, 20.0)
    return Fault(f"{um:.0f} um", brake=effect("disc_thickness_variation", order_1_cosine_um=um, order_2_sine_um=0.3 * um))


# Torque.


@_family
def torque_constant(rng, moments, size):
    factor, at = 1.0 + draw_signed(rng, 0.02, 0.15), pick_sometime(rng, moments)
    return Fault(f"x {factor:.3f}", at, car=once(at, scale(factor, "torque_constant")))


@_family
def torque_constant_fade(rng, moments, size):
    """Magnets lose 0.12 %/K as the motor's own current heats winding and housing, in minutes compressed to the drive's."""
    heating = draw_size(rng, 0.5, 3.0) / size.current**2

    def brake(plant):
        plant["magnet_heating"], plant["copper_per_K"] = heating, 0.0039
        plant["winding_time"], plant["magnet_time"] = 5.0, 20.0
        plant["effects"]["torque_constant_fade"]["fade_per_K"] = 0.0012

    return Fault(f"{heating:.2f} K/A2", brake=brake)


@_family
def current_gain(rng, moments, size):
    gain, at = 1.0 + draw_signed(rng, 0.02, 0.15), pick_sometime(rng, moments)
    return current_fault(f"x {gain:.3f}", at, lambda values, _: gain * values)


@_family
def current_offset(rng, moments, size):
    offset = size.current * draw_signed(rng, 0.2, 3.0)
    return Fault(f"{offset:+.2f} A", bus=alter(wire.CURRENT, wire.CURRENT_Q, lambda values, _: values + offset))


@_family
def current_offset_later(rng, moments, size):
    offset = size.current * draw_signed(rng, 0.2, 3.0)
    at = pick_driving(rng, moments) if rng.random() < 0.5 else pick_clamped(rng, moments)
    return current_fault(f"{offset:+.2f} A", at, lambda values, _: values + offset)


@_family
def current_offset_drift(rng, moments, size):
    rate, at = size.current * draw_signed(rng, 0.005, 0.1), moments["go_1"]
    return current_fault(f"{rate:+.3f} A/s", at, lambda values, time_s: values + rate * (time_s - at))


@_family
def current_late(rng, moments, size):
    return Fault("a third of a cycle", brake=effect("current_delay", delay_s=0.004 / 3.0))


@_family
def angle_late(rng, moments, size):
    delay = float(rng.uniform(0.001, 0.009))
    return Fault(f"{1e3 * delay:.1f} ms", brake=effect("signal_delay", delay_s=delay))


# Friction.


@_family
def friction_scale(rng, moments, size):
    factor, at = draw_size(rng, 0.5, 2.0), pick_sometime(rng, moments)
    return Fault(f"x {factor:.2f}", at, car=once(at, scale(factor, "load_friction", "offset_friction")))


@_family
def cold_grease(rng, moments, size):
    ambient, grease = float(rng.uniform(-30.0, -10.0)), draw_size(rng, 0.005, 0.03)
    viscous = size.damping * draw_size(rng, 1e-5, 1e-4)
    action = effect("cold_grease", per_K=grease, viscous_Nms_per_rad=viscous)
    return Fault(f"{ambient:.0f} degC, {100 * grease:.1f} %/K, {1e6 * viscous:.0f} uNms/rad", brake=action, ambient_C=ambient)


@_family
def stribeck(rng, moments, size):
    rise, speed = float(rng.uniform(0.3, 1.0)), draw_size(rng, 2.0, 15.0)
    action = effect("stribeck_friction", rise=rise, speed_rad_per_s=speed)
    return Fault(f"+{100 * rise:.0f} % below {speed:.0f} rad/s", brake=action)


@_family
def viscous(rng, moments, size):
    value = size.damping * draw_size(rng, 1e-4, 1e-3)
    return Fault(f"{1e6 * value:.0f} uNms/rad", brake=effect("viscous_friction", viscous_Nms_per_rad=value))


@_family
def gear_wear(rng, moments, size):
    """A gear that has run in or worn: friction, its presliding and play of another size."""
    friction, play = float(rng.uniform(0.7, 1.4)), draw_size(rng, 0.01, 0.15)

    def brake(plant):
        scale(friction, "load_friction", "offset_friction", "presliding_angle")(plant)
        plant["effects"]["backlash"]["play_rad"] = play

    return Fault(f"friction x {friction:.2f}, play {play:.2f} rad", brake=brake)


@_family
def friction_asymmetry(rng, moments, size):
    share = draw_signed(rng, 0.05, 0.4)
    return Fault(f"{100 * share:+.0f} %", brake=effect("friction_asymmetry", asymmetry=share))


# Resolver.


def _freeze(rng, moments, speed: Callable) -> Fault:
    at = pick_driving(rng, moments) if rng.random() < 0.3 else pick_clamped(rng, moments)
    end = at + rng.uniform(2.0, 10.0) if rng.random() < 0.5 else np.inf
    change = chain(_hold(wire.RESOLVER, wire.MOTOR_ANGLE), speed)
    lasts = f"{end - at:.0f} s" if np.isfinite(end) else "for good"
    return Fault(f"{lasts}", at, bus=during(change, at, end))


@_family
def resolver_frozen_speed_zero(rng, moments, size):
    return _freeze(rng, moments, alter(wire.RESOLVER, wire.MOTOR_SPEED, lambda values, _: 0.0 * values))


@_family
def resolver_frozen_speed_noise(rng, moments, size):
    """The resolver's rotor is loose on its shaft; its angle may flicker."""
    flicker = 1e-3 if rng.random() < 0.5 else 0.0

    def speed(values, _):
        return 0.35 * rng.standard_normal(len(values))

    def angle(values, _):
        return values + flicker * rng.standard_normal(len(values))

    noise = chain(alter(wire.RESOLVER, wire.MOTOR_SPEED, speed), alter(wire.RESOLVER, wire.MOTOR_ANGLE, angle))
    return _freeze(rng, moments, noise)


@_family
def resolver_frozen_last(rng, moments, size):
    return _freeze(rng, moments, _hold(wire.RESOLVER, wire.MOTOR_SPEED))


def _angle_fault(size: str, at: float, change: Callable) -> Fault:
    return Fault(size, at, bus=during(alter(wire.RESOLVER, wire.MOTOR_ANGLE, change), at))


@_family
def resolver_jump(rng, moments, size):
    jump, at = draw_signed(rng, 0.2, 20.0), pick_driving(rng, moments) if rng.random() < 0.5 else pick_clamped(rng, moments)
    return _angle_fault(f"{jump:+.2f} rad", at, lambda values, _: values + jump)


@_family
def resolver_drift(rng, moments, size):
    rate, at = draw_signed(rng, 0.01, 0.5), moments["go_1"]
    return _angle_fault(f"{rate:+.3f} rad/s", at, lambda values, time_s: values + rate * (time_s - at))


@_family
def resolver_gain(rng, moments, size):
    gain, first = 1.0 + draw_signed(rng, 0.005, 0.1), []

    def change(values, _):
        if not first and len(values):
            first.append(values[0])
        return first[0] + gain * (values - first[0]) if first else values

    return _angle_fault(f"x {gain:.3f}", 0.0, change)


@_family
def resolver_loses_counts(rng, moments, size):
    """A share of the travel in one direction is not counted."""
    share, at = draw_size(rng, 0.001, 0.05), moments["go_1"]
    state = [np.nan, 0.0]

    def change(values, _):
        if not len(values):
            return values
        steps = np.diff(values, prepend=state[0] if np.isfinite(state[0]) else values[0])
        missing = state[1] + np.cumsum(share * np.maximum(steps, 0.0))
        state[:] = values[-1], missing[-1]
        return values - missing

    return _angle_fault(f"{100 * share:.1f} %", at, change)


@_family
def resolver_slips(rng, moments, size):
    """The rotor slips a little whenever the motor starts fast."""
    slip, at, state = draw_size(rng, 0.02, 1.0), moments["go_1"], [np.nan, 0.0, False]

    def change(values, _):
        if not len(values):
            return values
        speed = (values[-1] - state[0]) / 0.08 if np.isfinite(state[0]) else 0.0
        fast = abs(speed) > 50.0
        if fast and not state[2]:
            state[1] -= slip * np.sign(speed)
        state[0], state[2] = values[-1], fast
        return values + state[1]

    return _angle_fault(f"{slip:.2f} rad", at, change)


# Current sensor.


@_family
def current_frozen(rng, moments, size):
    at = pick_clamped(rng, moments)
    return Fault("", at, bus=during(_hold(wire.CURRENT, wire.CURRENT_Q), at))


@_family
def current_zero(rng, moments, size):
    at = pick_clamped(rng, moments) if rng.random() < 0.5 else pick_driving(rng, moments)
    return current_fault("", at, lambda values, _: 0.0 * values)


@_family
def current_lost(rng, moments, size):
    at = pick_clamped(rng, moments) if rng.random() < 0.5 else pick_driving(rng, moments)
    return Fault("", at, bus=during(lose(wire.CURRENT), at))


@_family
def current_degraded(rng, moments, size):
    """The current sensor reads wrong and its sender's status says Degraded."""
    gain, at = float(rng.uniform(0.3, 0.8)), pick_driving(rng, moments)
    return current_fault(f"x {gain:.2f}", at, lambda values, _: gain * values, degraded=True)


# Wheel and heat.


@_family
def wheel_speed_lost(rng, moments, size):
    at = moments["drag_1"] + 1.0
    return Fault("", at, bus=during(lose(wire.WHEEL_SPEED), at))


@_family
def wheel_speed_zero(rng, moments, size):
    at = moments["drag_1"] + 1.0
    return Fault("", at, bus=during(alter(wire.WHEEL_SPEED, 0, lambda values, _: 0.0 * values), at))


#: What brake and calibration both have of disc thickness variation where the wheel's phase is the question, um.
_VARIATION = dict.fromkeys(EFFECTS["disc_thickness_variation"], 0.0)
_VARIATION |= {"order_1_cosine_um": 12.0, "order_1_sine_um": 5.0, "order_2_cosine_um": 4.0}
_KNOWN_VARIATION = {"disc_thickness_variation": _VARIATION}


@_family
def wheel_pulses_pause(rng, moments, size):
    at, seconds = moments["go_2"] + 1.0, float(rng.uniform(0.5, 8.0))
    return Fault(f"{seconds:.1f} s", at, bus=during(lose(wire.WHEEL_PULSE), at, at + seconds), effects=_KNOWN_VARIATION)


@_family
def wheel_phase_restart(rng, moments, size):
    """The daemon restarts on a disc whose thickness variation it knows."""
    at = pick_driving(rng, moments)
    return Fault("", at, restarts=((at, 0.5),), effects=_KNOWN_VARIATION)


@_family
def thermocouple_drifts(rng, moments, size):
    rate, at, side = draw_signed(rng, 0.2, 3.0), moments["go_1"], int(rng.integers(2))
    change = alter(wire.THERMOCOUPLE, side, lambda values, time_s: values + rate * (time_s - at))
    return Fault(f"{rate:+.1f} K/s", at, bus=during(change, at))


@_family
def thermocouple_stuck(rng, moments, size):
    at = moments["go_1"]
    return Fault("both", at, bus=during(chain(_hold(wire.THERMOCOUPLE, 0), _hold(wire.THERMOCOUPLE, 1)), at))


@_family
def thermocouple_stuck_noise(rng, moments, size):
    at = moments["go_1"]
    change = chain(_toggle(rng, wire.THERMOCOUPLE, 0), _toggle(rng, wire.THERMOCOUPLE, 1))
    return Fault("both, one least count", at, bus=during(change, at))


@_family
def thermocouple_lost(rng, moments, size):
    at = moments["go_1"]
    return Fault("", at, bus=during(lose(wire.THERMOCOUPLE), at))


@_family
def power_on_hot(rng, moments, size):
    """Power comes on a brake that has just stopped from a long descent: hot disc, pads between it and their plates."""
    disc, plate = float(rng.uniform(200.0, 500.0)), float(rng.uniform(60.0, 140.0))
    # The descent takes minutes, the softening's memory half an hour and more.
    return Fault(f"disc {disc:.0f}, plates {plate:.0f} degC", warm_C=(disc, plate, float(rng.uniform(0.2, 0.6))))


@_family
def ambient_cold(rng, moments, size):
    return Fault("-30 degC", ambient_C=-30.0)


# Power, restart, bus.


@_family
def start_clamped(rng, moments, size):
    at = pick_clamped(rng, moments)
    return Fault(f"at {at:.0f} s", at, power_on_s=at)


@_family
def start_latched(rng, moments, size):
    force = size.force * float(rng.uniform(3000.0, 25000.0))
    return Fault(f"{force:.0f} N", 0.0, power_on_s=6.0, latched_N=force)


@_family
def power_cycle(rng, moments, size):
    """Everything loses power for a second, and the resolver counts from another zero."""
    at = pick_driving(rng, moments) if rng.random() < 0.5 else pick_clamped(rng, moments)
    shift = float(rng.uniform(-100.0, 100.0))
    car = once(at - 0.5, _move("released_angle", shift))
    return Fault(f"zero {shift:+.0f} rad", at, car=car, restarts=((at, 1.0),))


@_family
def current_noise(rng, moments, size):
    """White, or the hum of a supply, beyond what the calibration knows."""
    amplitude, at, hums = size.current * draw_size(rng, 1.0, 8.0), pick_sometime(rng, moments), rng.random() < 0.5

    def noisy(values, time_s):
        if not hums:
            return values + amplitude * rng.standard_normal(len(values))
        # The samples that a batch of this corner has, a cycle apart.
        return values + amplitude * np.sin(2.0 * np.pi * 49.3 * (time_s + 0.004 * np.arange(len(values))))

    return current_fault(f"{amplitude:.2g} A {'hum' if hums else 'white'}", at, noisy)


@_family
def controller_restart(rng, moments, size):
    """The motor's controller alone loses power, and counts from another zero."""
    at, off_s, shift = pick_sometime(rng, moments), draw_size(rng, 0.15, 5.0), float(rng.uniform(-100.0, 100.0))
    silent = during(lose(wire.RESOLVER, wire.CURRENT), at, at + off_s)
    shifted = during(alter(wire.RESOLVER, wire.MOTOR_ANGLE, lambda values, _: values + shift), at + off_s)
    return Fault(f"{off_s:.2g} s, zero {shift:+.0f} rad", at, bus=chain(silent, shifted))


@_family
def bus_lost(rng, moments, size):
    """All messages for a while."""
    at, off_s = pick_sometime(rng, moments), draw_size(rng, 0.15, 5.0)
    return Fault(f"{off_s:.2g} s", at, bus=during(lose(*_IDS), at, at + off_s))


@_family
def daemon_restart(rng, moments, size):
    at = pick_driving(rng, moments) if rng.random() < 0.5 else pick_clamped(rng, moments)
    return Fault("", at, restarts=((at, 0.5),))


@_family
def bursts_lost(rng, moments, size):
    """Bursts of up to 100 ms, of one message or all, about two a second."""
    slots = [(wire.RESOLVER,), (wire.CURRENT,), tuple(_IDS)][rng.integers(3)]
    share, at, drop = float(rng.uniform(0.05, 0.3)), moments["go_1"], lose(*slots)
    return Fault(
        f"{100 * share:.0f} % of {len(slots)} messages", at,
        bus=during(lambda frames, time_s: drop(frames, time_s) if rng.random() < share else frames, at),
    )  # fmt: skip


# A force sensor of low range, where the brake has one.

#: Its faults, by family.
SENSOR_FAULTS: dict[str, Callable] = {}


def _sensor_family(function: Callable) -> Callable:
    SENSOR_FAULTS[function.__name__] = function
    return function


def _sensor_fault(size: str, at: float, change: Callable) -> Fault:
    return Fault(size, at, bus=during(alter(wire.FORCE_SENSOR, wire.SENSOR_FORCE, change), at))


@_sensor_family
def sensor_stuck(rng, moments, size):
    at = pick_driving(rng, moments) if rng.random() < 0.5 else pick_clamped(rng, moments)
    return Fault("", at, bus=during(_hold(wire.FORCE_SENSOR, wire.SENSOR_FORCE), at))


@_sensor_family
def sensor_gain(rng, moments, size):
    return _sensor_fault("x 0.80", pick_driving(rng, moments), lambda values, _: 0.8 * values)


@_sensor_family
def sensor_offset(rng, moments, size):
    offset, at = size.force * draw_signed(rng, 100.0, 1500.0), pick_sometime(rng, moments)
    return _sensor_fault(f"{offset:+.0f} N", at, lambda values, _: values + offset)


@_sensor_family
def sensor_drift(rng, moments, size):
    rate, at = size.force * draw_signed(rng, 2.0, 50.0), moments["go_1"]
    return _sensor_fault(f"{rate:+.1f} N/s", at, lambda values, time_s: values + rate * (time_s - at))
