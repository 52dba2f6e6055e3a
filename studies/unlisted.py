"""Further faults and changes of the simulated car, by family, in the manner of `studies.faults`.

Of the brake: effects that no catalogue lists, drawn by a seed, and what water, stiction, stops and broken pads do. Of sensors:
the forms of faults that the other families leave out.
"""

from collections.abc import Callable

import numpy as np

from emb_daemon.plant.brake import ONSET, POWER, SATURATION, SIGNALS
from emb_daemon.wire import layout as wire
from studies.faults import (
    Fault,
    alter,
    chain,
    current_fault,
    draw_signed,
    draw_size,
    during,
    effect,
    lose,
    move_contact,
    once,
    pick_clamped,
    pick_driving,
    pick_sometime,
    scale,
)

FAMILIES: dict[str, Callable] = {}
#: Amounts that drawn effects add where they change the force of a path by its own size.
WHOLE = {"stiffness": 1.0, "thickness": 175.0, "torque_constant": 1.0, "gear_friction": 6.0, "gear_gain": 1.0}
#: Shares of the force that effects from no catalogue add where their signals are at their usual sizes: 75 N to 2 kN at 8 kN.
_SHARES = (0.01, 0.25)
#: What signals reach in a drive over the sizes that drawn effects take for usual, where it is not about the same.
_REACHED = {"disc_temperature": 3.0, "surface_temperature": 3.5, "pad_temperature": 1.6, "current": 0.5}
#: Changes of the running car come every so many s.
_STRETCH_S = 0.08


def _family(function: Callable) -> Callable:
    FAMILIES[function.__name__] = function
    return function


# Effects that no catalogue lists.


def _foreign(rng) -> tuple[str, dict]:
    """A drawn effect of any signals at any port: its name and parameters."""
    port = str(rng.choice(list(WHOLE)))
    signal, other = (int(rng.integers(len(SIGNALS))) for _ in range(2))
    exponent, shape, both = (
        float(rng.uniform(0.4, 2.6)),
        int(rng.choice([POWER, POWER, SATURATION, ONSET])),
        rng.random() < 0.3,
    )
    reached = [_REACHED.get(SIGNALS[which], 1.0) for which in (signal, other)]
    most = (reached[0] ** exponent if shape == POWER else 1.0) * (reached[1] if both else 1.0)
    values = {
        "size": WHOLE[port] * draw_signed(rng, *_SHARES) / most,
        "signal": signal,
        "exponent": exponent,
        "shape": shape,
        "other": other if both else -1.0,
        "lag_s": draw_size(rng, 0.1, 30.0) if rng.random() < 0.5 else 0.0,
    }
    return f"drawn_{port}", values


def _told(name: str, values: dict) -> str:
    signals = [SIGNALS[int(values[key])] for key in ("signal", "other") if values[key] >= 0.0]
    return f"{name} {values['size']:+.3g} over {' x '.join(signals)}"


@_family
def foreign(rng, moments, size):
    """An effect that no catalogue lists, there from the start of the drive; the calibration was made without it."""
    name, values = _foreign(rng)
    return Fault(_told(name, values), brake=effect(name, **values))


@_family
def foreign_sudden(rng, moments, size):
    name, values = _foreign(rng)
    at = pick_driving(rng, moments) if rng.random() < 0.5 else pick_clamped(rng, moments)
    return Fault(_told(name, values), at, car=once(at, effect(name, **values)))


@_family
def foreign_grows(rng, moments, size):
    """An effect that no catalogue lists, growing over a minute."""
    (name, values), at = _foreign(rng), moments["go_1"]

    def car(car, time_s):
        effect(name, **values | {"size": values["size"] * min(max(time_s - at, 0.0) / 60.0, 1.0)})(car.plants)

    return Fault(_told(name, values), at, car=car)


@_family
def foreign_current(rng, moments, size):
    """What is measured lacks a current that follows another signal, as stray fields and heat make it."""
    amount, signal, shape = size.current * draw_signed(rng, 0.2, 4.0), str(rng.choice(list(_SENSED))), rng.uniform(0.4, 2.6)
    at = pick_sometime(rng, moments)

    def car(car, time_s):
        if time_s >= at:
            offset = amount * abs(_SENSED[signal](car.truth[0], size)) ** shape
            car.plants["effects"]["current_offset"]["offset_A"] = offset

    return Fault(f"{amount:+.2f} A over {signal}^{shape:.1f}", at, car=car)


#: Signals that a sensor's error may follow, over their usual sizes.
_SENSED = {
    "clamp_force": lambda truth, size: truth["force"] / (1e4 * size.force),
    "motor_speed": lambda truth, _: truth["speed"] / 100.0,
    "disc_temperature": lambda truth, _: (truth["disc"] - 22.0) / 150.0,
    "wheel_speed": lambda truth, _: truth["wheel_speed"] / 40.0,
}


# Brake.


@_family
def hysteresis(rng, moments, size):
    """Load spreads otherwise when the brake applies than when it releases."""
    share, angle, at = draw_size(rng, 0.01, 0.12), draw_size(rng, 0.5, 6.0), pick_sometime(rng, moments)
    action = effect("second_hysteresis", share=share, slip_angle_rad=angle)
    return Fault(f"{100 * share:.0f} %, {angle:.1f} rad", at, car=once(at, action))


@_family
def creep(rng, moments, size):
    share, seconds = draw_signed(rng, 0.01, 0.12), draw_size(rng, 0.3, 20.0)
    name = "clamp_creep" if rng.random() < 0.5 else "third_relaxation"
    return Fault(f"{100 * share:+.0f} %, {seconds:.1f} s", brake=effect(name, share=share, time_constant_s=seconds))


@_family
def lead_error(rng, moments, size):
    um, order = draw_size(rng, 2.0, 20.0), draw_size(rng, 0.1, 3.0)
    action = effect("spindle_lead_error", amplitude_um=um, order_per_turn=order, phase_rad=float(rng.uniform(0.0, 6.3)))
    return Fault(f"{um:.0f} um, {order:.2f} per rad", brake=action)


@_family
def pad_breaks(rng, moments, size):
    """A piece of the lining is gone: the way is longer and the rest softer."""
    um, factor, at = -draw_size(rng, 150.0, 1500.0), float(rng.uniform(0.4, 0.9)), pick_clamped(rng, moments)

    def action(plants):
        move_contact(plants, -um)
        scale(factor, "curve")(plants)

    return Fault(f"{um:+.0f} um, curve x {factor:.2f}", at, car=once(at, action))


@_family
def retraction(rng, moments, size):
    """Pads stay where hot strokes pushed them: with every stop the clearance is less, until cornering opens it again."""
    um, times = draw_size(rng, 3.0, 25.0), sorted(moments[name] + 0.5 for name in moments if name.startswith("go"))
    moved = [0, 0.0]

    def car(car, time_s):
        if moved[0] < len(times) and time_s >= times[moved[0]]:
            by = -moved[1] if moved[0] % 3 == 2 else -um
            move_contact(car.plants, by)
            moved[:] = moved[0] + 1, moved[1] + by

    return Fault(f"{um:.0f} um a stop", times[0], car=car)


@_family
def contact_nearer(rng, moments, size):
    """Pads that were knocked far in, or a motor that opens less far: a third to all of the clearance is gone at once."""
    share, at = float(rng.uniform(0.3, 1.0)), pick_driving(rng, moments)
    return Fault(f"{100 * share:.0f} % of the clearance", at, car=once(at, scale(1.0 - share, "contact_angle")))


@_family
def pads_drag(rng, moments, size):
    """Pads that release no more: at once, or within a minute, the clearance is gone and up to a third of it again, so that an
    open brake keeps some force."""
    share, at = float(rng.uniform(1.0, 1.33)), pick_driving(rng, moments)
    seconds = draw_size(rng, 5.0, 60.0) if rng.random() < 0.5 else 0.0
    clearance, gone = [], [0.0]

    def car(car, time_s):
        if not clearance:
            clearance.append(car.plants["contact_angle"].copy())
        if time_s >= at:
            now = share * (min((time_s - at) / seconds, 1.0) if seconds else 1.0)
            car.plants["contact_angle"] -= (now - gone[0]) * clearance[0]
            gone[0] = now

    return Fault(f"{100 * share:.0f} % of the clearance in {seconds:.0f} s", at, car=car)


@_family
def jam(rng, moments, size):
    """The gear jams for a while: friction several times as large."""
    factor, at, seconds = draw_size(rng, 3.0, 20.0), pick_clamped(rng, moments), float(rng.uniform(1.0, 10.0))
    names = "load_friction", "offset_friction"
    jams, frees = once(at, scale(factor, *names)), once(at + seconds, scale(1.0 / factor, *names))
    return Fault(f"friction x {factor:.1f} for {seconds:.0f} s", at, car=lambda car, t: (jams(car, t), frees(car, t)))


@_family
def stiction(rng, moments, size):
    """Friction has rare spikes, as from a chip in the screw."""
    factor, share, at, state = draw_size(rng, 1.5, 6.0), draw_size(rng, 0.02, 0.2), moments["go_1"], [1.0]

    def car(car, time_s):
        now = factor if time_s >= at and rng.random() < share else 1.0
        scale(now / state[0], "load_friction", "offset_friction")(car.plants)
        state[0] = now

    return Fault(f"x {factor:.1f} in {100 * share:.0f} % of the time", at, car=car)


@_family
def cogging(rng, moments, size):
    """Cogging torque of a magnet that has moved or cracked: some hundredths of the torque that the largest force needs."""
    torque, phase = size.current * draw_size(rng, 0.005, 0.05), float(rng.uniform(0.0, 6.3))
    order, at = float(rng.choice([1.0, 2.0, 6.0, 7.0, 12.0, 24.0, 36.0])), pick_sometime(rng, moments)
    parts = {"cosine_Nm": torque * np.cos(phase), "sine_Nm": torque * np.sin(phase), "order_per_turn": order}
    return Fault(f"{1e3 * torque:.0f} mN m, order {order:.0f}", at, car=once(at, effect("cogging_torque", **parts)))


@_family
def water(rng, moments, size):
    """A wet disc: half the friction, five times the cooling."""
    friction, cooling, at = float(rng.uniform(0.3, 0.7)), draw_size(rng, 2.0, 8.0), moments["go_1"]

    def action(plants):
        scale(friction, "friction_coefficient")(plants)
        scale(cooling, "disc_cooling", "disc_cooling_per_speed")(plants)

    return Fault(f"friction x {friction:.2f}, cooling x {cooling:.1f}", at, car=once(at, action))


@_family
def disc_light(rng, moments, size):
    """A worn or cracked disc takes less heat, glazed pads let less of it in."""
    heat, contact = float(rng.uniform(0.5, 0.9)), draw_size(rng, 0.3, 1.0)

    def brake(plant):
        scale(heat, "disc_heat_capacity")(plant)
        scale(contact, "contact_conductance")(plant)

    return Fault(f"disc x {heat:.2f}, contact x {contact:.2f}", brake=brake)


@_family
def supply_sags(rng, moments, size):
    factor, at = float(rng.uniform(0.4, 0.8)), pick_driving(rng, moments)
    return Fault(f"x {factor:.2f}", at, car=once(at, scale(factor, "maximum_speed", "maximum_current")))


# Sensors.


@_family
def noise_grows(rng, moments, size):
    """One sensor becomes noisier, as after its cable's screen has come off."""
    name = str(rng.choice(["current_noise", "speed_noise", "angle_noise"]))
    factor, at = draw_size(rng, 3.0, 30.0), pick_sometime(rng, moments)
    return Fault(f"{name} x {factor:.0f}", at, car=once(at, scale(factor, name)))


@_family
def resolver_noisy(rng, moments, size):
    """A converter of fewer bits, or a noisy one: the angle of a motor that stands flickers."""
    rad = draw_size(rng, 1e-4, 3e-3)

    def brake(plant):
        plant["angle_noise"] = rad

    return Fault(f"{1e3 * rad:.2f} mrad", brake=brake)


#: Message and signals of a sensor whose contact is loose.
_LOOSE = {
    "current": (wire.CURRENT, (wire.CURRENT_Q,)),
    "resolver": (wire.RESOLVER, (wire.MOTOR_ANGLE, wire.MOTOR_SPEED)),
    "angle": (wire.RESOLVER, (wire.MOTOR_ANGLE,)),
}


@_family
def dropouts(rng, moments, size):
    """A loose contact: for 20 to 200 ms a message repeats its last value, about once a second."""
    told, (slot, columns) = _draw_loose(rng)
    at, begun, until = moments["go_1"], [np.nan], [0.0]

    def held(column):
        kept = [np.nan, np.nan]

        def change(values, time_s):
            if begun[0] != time_s:
                begun[0] = time_s
                if time_s > until[0] and rng.random() < _STRETCH_S:
                    until[0] = time_s + rng.uniform(0.02, 0.2)
            count = int(np.clip((until[0] - time_s) / 0.004, 0, len(values)))
            if count and kept[0] != until[0]:
                kept[:] = until[0], values[0]
            return np.concatenate((np.full(count, kept[1]), values[count:]))

        return alter(slot, column, change)

    return Fault(told, at, bus=during(chain(*map(held, columns)), at))


@_family
def spikes(rng, moments, size):
    """Single values are anything, now and then or in bursts."""
    told, (slot, columns) = _draw_loose(rng)
    share, at = draw_size(rng, 0.002, 0.1), moments["go_1"]
    reach = {"current": 40.0 * size.current, "resolver": 50.0, "angle": 50.0}[told] * draw_size(rng, 0.05, 1.0)
    column = int(rng.choice(columns))

    def change(values, _):
        hit = rng.random(len(values)) < share
        return values + hit * reach * rng.uniform(-1.0, 1.0, len(values))

    return Fault(f"{told}, {100 * share:.1f} %, {reach:.1f}", at, bus=during(alter(slot, column, change), at))


@_family
def garbled(rng, moments, size):
    """Whole messages of a sensor say anything, a few in a row, now and then."""
    told, (slot, columns) = _draw_loose(rng)
    share, length, at = draw_size(rng, 0.0005, 0.02), int(rng.integers(1, 4)), moments["go_1"]
    reach, seed = (100.0 if told == "current" else 1000.0) * draw_size(rng, 0.01, 1.0), int(rng.integers(2**32))

    def garble(column):
        # The same messages for each of their signals, with another value.
        when, what = np.random.default_rng(seed), np.random.default_rng((seed, column))

        def change(values, _):
            hit = np.convolve(when.random(len(values)) < share / length, np.ones(length))[: len(values)] > 0.0
            return values + hit * reach * what.uniform(-1.0, 1.0)

        return alter(slot, column, change)

    fault = during(chain(*map(garble, columns)), at)
    return Fault(f"{told}, {100 * share:.2f} % in runs of {length}, {reach:.1f}", at, bus=fault)


def _draw_loose(rng) -> tuple[str, tuple]:
    told = str(rng.choice(list(_LOOSE)))
    return told, _LOOSE[told]


@_family
def current_saturates(rng, moments, size):
    limit, at = size.current * draw_size(rng, 4.0, 20.0), pick_sometime(rng, moments)
    return current_fault(f"at {limit:.1f} A", at, lambda values, _: np.clip(values, -limit, limit))


@_family
def current_gain_of_one_sign(rng, moments, size):
    gain, sign, at = 1.0 + draw_signed(rng, 0.03, 0.3), float(rng.choice([-1.0, 1.0])), pick_sometime(rng, moments)
    told = f"x {gain:.2f} where {'positive' if sign > 0.0 else 'negative'}"
    return current_fault(told, at, lambda values, _: np.where(sign * values > 0.0, gain * values, values))


@_family
def current_remanence(rng, moments, size):
    """The sensor's core stays magnetised by a share of the largest current until one of the other sign flows."""
    share, at, state = draw_size(rng, 0.005, 0.05), moments["hold_1"], [0.0]

    def change(values, _):
        shown = np.empty_like(values)
        for row, value in enumerate(values):
            most = share * abs(value)
            state[0] = max(state[0], most) if value > 0.0 else min(state[0], -most)
            shown[row] = value + state[0]
        return shown

    return current_fault(f"{100 * share:.1f} %", at, change)


@_family
def current_magnetised(rng, moments, size):
    """The sensor's core keeps an offset with the sign of the last current that was larger than a hundredth of its range."""
    amount, least, at = (
        size.current * draw_size(rng, 0.1, 1.0),
        size.current * draw_size(rng, 1.0, 5.0),
        pick_sometime(rng, moments),
    )
    state = [0.0]

    def change(values, _):
        shown = np.empty_like(values)
        for row, value in enumerate(values):
            if abs(value) > least:
                state[0] = amount * np.sign(value)
            shown[row] = value + state[0]
        return shown

    return current_fault(f"{amount:.2f} A from {least:.1f} A on", at, change)


@_family
def current_zero_under_load(rng, moments, size):
    """An amplifier whose zero moves while the inverter switches; none of it is seen where the motor rests."""
    amount, at, last = size.current * draw_signed(rng, 0.1, 2.0), pick_sometime(rng, moments), [-1.0]

    def car(car, time_s):
        truth = car.truth[0]
        if abs(truth["speed"]) > 2.0 or truth["force"] > 200.0 * size.force:
            last[0] = time_s
        on = time_s >= at and last[0] >= 0.0 and time_s - last[0] < 0.2
        car.plants["effects"]["current_offset"]["offset_A"] = amount if on else 0.0

    return Fault(f"{amount:+.2f} A", at, car=car)


def _low_pass(time_constant_s: float) -> Callable:
    state, keep = [np.nan], float(np.exp(-0.004 / time_constant_s))

    def change(values, _):
        shown = np.empty_like(values)
        for row, value in enumerate(values):
            state[0] = value if np.isnan(state[0]) else keep * state[0] + (1.0 - keep) * value
            shown[row] = state[0]
        return shown

    return change


@_family
def current_filtered(rng, moments, size):
    seconds, at = draw_size(rng, 0.003, 0.05), pick_sometime(rng, moments)
    return current_fault(f"{1e3 * seconds:.0f} ms", at, _low_pass(seconds))


@_family
def current_delayed(rng, moments, size):
    """The current comes up to 12 ms late, by another frame or gateway than at calibration."""
    delay = float(rng.uniform(0.001, 0.012))
    return Fault(f"{1e3 * delay:.1f} ms", brake=effect("current_delay", delay_s=delay))


@_family
def resolver_delayed(rng, moments, size):
    """Angle and speed come one or two frames late."""
    cycles, at = int(rng.integers(1, 3)), pick_sometime(rng, moments)

    def delayed():
        kept = []

        def change(values, _):
            kept.extend(values if kept else [*values[:1]] * cycles + [*values])
            shown = np.array(kept[: len(values)])
            del kept[: len(values)]
            return shown

        return change

    late = chain(*(alter(wire.RESOLVER, column, delayed()) for column in (wire.MOTOR_ANGLE, wire.MOTOR_SPEED)))
    return Fault(f"{cycles} cycles", at, bus=during(late, at))


@_family
def angle_filtered(rng, moments, size):
    seconds, at = draw_size(rng, 0.003, 0.03), pick_sometime(rng, moments)
    change = alter(wire.RESOLVER, wire.MOTOR_ANGLE, _low_pass(seconds))
    if rng.random() < 0.5:
        change = chain(change, alter(wire.RESOLVER, wire.MOTOR_SPEED, _low_pass(seconds)))
    return Fault(f"{1e3 * seconds:.0f} ms", at, bus=during(change, at))


@_family
def speed_filtered(rng, moments, size):
    """The speed goes through a filter of a tracking loop or of firmware; the angle does not."""
    seconds, at = draw_size(rng, 0.003, 0.03), pick_sometime(rng, moments)
    return Fault(f"{1e3 * seconds:.0f} ms", at, bus=during(alter(wire.RESOLVER, wire.MOTOR_SPEED, _low_pass(seconds)), at))


@_family
def resolver_cyclic(rng, moments, size):
    """Amplitudes or phases of the resolver's windings have become unequal: an angle error of one or more periods a turn."""
    error, order, phase = draw_size(rng, 0.005, 0.06), float(rng.integers(1, 5)), float(rng.uniform(0.0, 6.3))
    at = pick_sometime(rng, moments)
    change = alter(wire.RESOLVER, wire.MOTOR_ANGLE, lambda values, _: values + error * np.sin(order * values + phase))
    return Fault(f"{1e3 * error:.0f} mrad, order {order:.0f}", at, bus=during(change, at))


@_family
def vibration(rng, moments, size):
    """A rough road: angle, speed and current shake together while the car moves or stands with its engine on."""
    frequency, at = draw_size(rng, 5.0, 60.0), moments["go_1"]
    angle, current = draw_size(rng, 0.003, 0.05), size.current * draw_size(rng, 0.1, 2.0)
    omega = 2.0 * np.pi * frequency

    def swing(amplitude, phase):
        def change(values, time_s):
            return values + amplitude * np.sin(omega * (time_s + 0.004 * np.arange(len(values))) + phase)

        return change

    shaken = chain(
        alter(wire.RESOLVER, wire.MOTOR_ANGLE, swing(angle, 0.0)),
        alter(wire.RESOLVER, wire.MOTOR_SPEED, swing(omega * angle, 0.5 * np.pi)),
        alter(wire.CURRENT, wire.CURRENT_Q, swing(current, float(rng.uniform(0.0, 6.3)))),
    )
    return Fault(f"{frequency:.0f} Hz, {1e3 * angle:.0f} mrad, {current:.1f} A", at, bus=during(shaken, at))


@_family
def speed_wrong(rng, moments, size):
    """The motor speed alone has another gain or an offset."""
    gain, offset, at = 1.0, 0.0, pick_sometime(rng, moments)
    if rng.random() < 0.5:
        gain += draw_signed(rng, 0.01, 0.2)
    else:
        offset += draw_signed(rng, 0.1, 5.0)
    change = alter(wire.RESOLVER, wire.MOTOR_SPEED, lambda values, _: gain * values + offset)
    return Fault(f"x {gain:.2f}, {offset:+.1f} rad/s", at, bus=during(change, at))


@_family
def wheel_speed_scaled(rng, moments, size):
    """Other tyres or another pole wheel than was coded."""
    factor = float(rng.choice([0.5, 0.8, 1.25, 2.0]))
    return Fault(f"x {factor:.2f}", bus=alter(wire.WHEEL_SPEED, 0, lambda values, _: factor * values))


@_family
def thermocouples_exchanged(rng, moments, size):
    """The thermocouple of one backing plate is exchanged with the caliper's."""
    kept: dict[int, float] = {}

    def keep(column):
        def change(values, _):
            if len(values):
                kept[column] = values[-1]
            return values

        return change

    one, other = (0, 2) if rng.random() < 0.5 else (1, 2)
    take = lambda column: lambda values, _: np.full(len(values), kept.get(column, 22.0))  # noqa: E731
    slot = wire.THERMOCOUPLE
    read = chain(alter(slot, one, keep(one)), alter(slot, other, keep(other)))
    return Fault(f"{one} and {other}", bus=chain(read, alter(slot, one, take(other)), alter(slot, other, take(one))))


@_family
def status_lost(rng, moments, size):
    """The vehicle's status message, which has park brake and brake request, is lost."""
    at = pick_driving(rng, moments)
    return Fault("", at, bus=during(lose(wire.VEHICLE_STATUS), at))
