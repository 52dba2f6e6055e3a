"""Further faults in frames, by family, in the manner of `studies.faults`: what senders, gateways and raw counts do to signals
that a sensor measured rightly."""

from collections.abc import Callable

import numpy as np

from emb_daemon.wire import layout as wire
from emb_daemon.wire.contract import CYCLE_S
from studies.faults import (
    Fault,
    alter,
    chain,
    current_fault,
    draw_signed,
    draw_size,
    during,
    ids_of,
    pick_clamped,
    pick_driving,
    pick_sometime,
)

FAMILIES: dict[str, Callable] = {}

_RESOLVER = (wire.MOTOR_ANGLE, wire.MOTOR_SPEED)
#: Message, signal and a usual step of what loses bits: rad, rad/s, and a share of the currents of `studies.faults.Size`.
_SENSED = {
    "angle": (wire.RESOLVER, wire.MOTOR_ANGLE, 0.003),
    "speed": (wire.RESOLVER, wire.MOTOR_SPEED, 0.5),
    "current": (wire.CURRENT, wire.CURRENT_Q, 0.2),
}


def _family(function: Callable) -> Callable:
    FAMILIES[function.__name__] = function
    return function


def _resolver(change: Callable, columns=_RESOLVER) -> Callable:
    """``change(column)`` makes the change of one signal."""
    return chain(*(alter(wire.RESOLVER, column, change(column)) for column in columns))


def _repeat(cycles: int) -> Callable:
    """Every value is sent ``cycles`` times, as by a task that is slower than its message."""
    kept, count = [np.nan], [0]

    def change(values, _):
        shown = np.empty(len(values))
        for index, value in enumerate(values):
            if count[0] % cycles == 0:
                kept[0] = value
            count[0] += 1
            shown[index] = kept[0]
        return shown

    return change


@_family
def resolver_repeats(rng, moments, size):
    """The sender's task is slower than its message: each angle and speed, or one of them, is sent several times."""
    cycles, at = int(rng.integers(2, 9)), pick_sometime(rng, moments)
    which = int(rng.integers(3))
    columns = (_RESOLVER, _RESOLVER[:1], _RESOLVER[1:])[which]
    told = ("both", "angle", "speed")[which]
    return Fault(f"{told}, {cycles} times", at, bus=during(_resolver(lambda _: _repeat(cycles), columns), at))


@_family
def current_repeats(rng, moments, size):
    cycles, at = int(rng.integers(2, 26)), pick_sometime(rng, moments)
    return current_fault(f"{cycles} times", at, _repeat(cycles))


@_family
def coarse(rng, moments, size):
    """A signal has lost its last bits."""
    name = str(rng.choice(list(_SENSED)))
    slot, column, step = _SENSED[name]
    step *= draw_size(rng, 1.0, 60.0) * (size.current if name == "current" else 1.0)
    at = pick_sometime(rng, moments)
    change = alter(slot, column, lambda values, _: step * np.floor(values / step))
    return Fault(f"{name}, {step:.3g}", at, bus=during(change, at))


@_family
def angle_coarse(rng, moments, size):
    """The angle comes in counts of a tenth of a degree to those of Hall sensors."""
    step, at = draw_size(rng, 0.003, 0.2), 0.0 if rng.random() < 0.5 else pick_sometime(rng, moments)
    change = _resolver(lambda _: lambda values, _: step * np.floor(values / step), _RESOLVER[:1])
    return Fault(f"{1e3 * step:.1f} mrad", at, bus=during(change, at))


@_family
def angle_wraps(rng, moments, size):
    """The angle is not counted over turns any more: it lies within one or some turns."""
    turns, at = int(rng.integers(1, 6)), pick_sometime(rng, moments)
    span = 2.0 * np.pi * turns
    return Fault(f"{turns} turns", at, bus=during(_resolver(lambda _: lambda values, _: values % span, _RESOLVER[:1]), at))


@_family
def turn_lost(rng, moments, size):
    """For moments the angle is whole turns, or a pole pair, off; then it is right again."""
    step = 2.0 * np.pi / float(rng.choice([1.0, 1.0, 2.0, 4.0, 7.0])) * float(rng.choice([-1.0, 1.0]))
    at, lasts = moments["go_1"], draw_size(rng, 0.02, 5.0)
    until, pause = [0.0], draw_size(rng, 3.0, 30.0)

    def change(values, time_s):
        if time_s > until[0] and rng.random() < 0.08 / pause:
            until[0] = time_s + lasts
        return values + step if time_s < until[0] else values

    told = f"{step:+.2f} rad for {lasts:.2f} s"
    return Fault(told, at, bus=during(_resolver(lambda _: change, _RESOLVER[:1]), at))


@_family
def sign_turned(rng, moments, size):
    """After work on the motor a signal has the other sign."""
    name = str(rng.choice(["current", "angle and speed", "angle", "speed"]))
    turn = lambda values, _: -values  # noqa: E731
    at = 0.0 if rng.random() < 0.5 else pick_driving(rng, moments)
    if name == "current":
        bus = alter(wire.CURRENT, wire.CURRENT_Q, turn)
    else:
        columns = {"angle and speed": _RESOLVER, "angle": _RESOLVER[:1], "speed": _RESOLVER[1:]}[name]
        bus = _resolver(lambda _: turn, columns)
    return Fault(name, at, bus=during(bus, at))


@_family
def rotor_play(rng, moments, size):
    """The resolver's rotor has play on the shaft: the angle stands until it is taken along."""
    play, at, state = draw_size(rng, 0.02, 1.0), pick_sometime(rng, moments), [np.nan]

    def change(values, _):
        shown = np.empty(len(values))
        for index, value in enumerate(values):
            state[0] = value if np.isnan(state[0]) else min(max(state[0], value - 0.5 * play), value + 0.5 * play)
            shown[index] = state[0]
        return shown

    return Fault(f"{1e3 * play:.0f} mrad", at, bus=during(_resolver(lambda _: change, _RESOLVER[:1]), at))


@_family
def speed_sticks(rng, moments, size):
    """The speed stands at its last value, or at zero; the angle is right."""
    at, zero, kept = pick_sometime(rng, moments), rng.random() < 0.5, []

    def change(values, _):
        if not kept and len(values):
            kept.append(0.0 if zero else values[0])
        return np.full(len(values), kept[0]) if kept else values

    return Fault("zero" if zero else "last", at, bus=during(_resolver(lambda _: change, _RESOLVER[1:]), at))


@_family
def all_stale(rng, moments, size):
    """A gateway goes on sending its last angle, speed and current, with right counters, for moments."""
    at, lasts, pause, until = moments["go_1"], draw_size(rng, 0.02, 1.0), draw_size(rng, 2.0, 20.0), [0.0]
    when = []

    def held():
        kept = [np.nan]

        def change(values, time_s):
            if not when or when[-1] != time_s:
                when.append(time_s)
                if time_s > until[0] and rng.random() < 0.08 / pause:
                    until[0] = time_s + lasts
            if not len(values):
                return values
            if time_s < until[0] and not np.isnan(kept[0]):
                return np.full(len(values), kept[0])
            kept[0] = values[-1]
            return values

        return change

    bus = chain(_resolver(lambda _: held()), alter(wire.CURRENT, wire.CURRENT_Q, held()))
    return Fault(f"{lasts:.2f} s, about every {pause:.0f} s", at, bus=during(bus, at))


@_family
def messages_lost(rng, moments, size):
    """A share of one message is lost, at random."""
    slot, share = int(rng.choice([wire.RESOLVER, wire.CURRENT])), float(rng.uniform(0.1, 0.7))
    at = pick_sometime(rng, moments)

    def bus(frames, _):
        return frames[~(np.isin(frames["can_id"], ids_of(slot)) & (rng.random(len(frames)) < share))]

    return Fault(f"{100 * share:.0f} % of {'resolver' if slot == wire.RESOLVER else 'current'}", at, bus=during(bus, at))


def _delay(change: Callable) -> Callable:
    """A bus whose frames come at the later times that ``change(frames)`` gives them."""
    kept = []

    def bus(frames, _):
        if not len(frames):
            return frames
        until = frames["time_ns"].max()
        frames = np.concatenate([*kept, change(frames)])
        frames = frames[np.argsort(frames["time_ns"], kind="stable")]
        come = frames["time_ns"] <= until
        kept[:] = [frames[~come]]
        return frames[come]

    return bus


@_family
def late_in_groups(rng, moments, size):
    """A gateway collects the resolver's or the current's messages, or both, and sends them every so many milliseconds."""
    every, at = draw_size(rng, 0.008, 0.06), pick_sometime(rng, moments)
    which = int(rng.integers(3))
    ids = (ids_of(wire.RESOLVER), ids_of(wire.CURRENT), ids_of(wire.RESOLVER, wire.CURRENT))[which]

    def change(frames):
        rows = np.isin(frames["can_id"], ids)
        step = int(1e9 * every)
        frames["time_ns"][rows] = (frames["time_ns"][rows] // step + 1) * step
        return frames

    return Fault(f"{('resolver', 'current', 'both')[which]}, every {1e3 * every:.0f} ms", at, bus=during(_delay(change), at))


@_family
def stamps_jitter(rng, moments, size):
    """Messages wait for others: each is up to so much later."""
    by, at = draw_size(rng, 0.0005, 0.02), pick_sometime(rng, moments)

    def change(frames):
        rows = np.isin(frames["can_id"], ids_of(wire.RESOLVER, wire.CURRENT))
        frames["time_ns"] += (rows * 1e9 * rng.uniform(0.0, by, len(frames))).astype(np.int64)
        return frames

    return Fault(f"up to {1e3 * by:.1f} ms", at, bus=during(_delay(change), at))


@_family
def twice(rng, moments, size):
    """A loop of gateways: every message comes again, up to some milliseconds later."""
    by, at = draw_size(rng, 0.0002, 0.03), pick_sometime(rng, moments)

    def change(frames):
        again = frames[np.isin(frames["can_id"], ids_of(*range(wire.SLOTS)))]
        again["time_ns"] += int(1e9 * by)
        return np.concatenate((frames, again))

    return Fault(f"{1e3 * by:.1f} ms later", at, bus=during(_delay(change), at))


@_family
def current_hum(rng, moments, size):
    """Ripple of the supply or of the inverter in the measured current, aliased."""
    amplitude, frequency, at = size.current * draw_size(rng, 0.3, 6.0), draw_size(rng, 1.0, 120.0), pick_sometime(rng, moments)
    omega = 2.0 * np.pi * frequency

    def change(values, time_s):
        return values + amplitude * np.sin(omega * (time_s + CYCLE_S * np.arange(len(values))))

    return current_fault(f"{amplitude:.1f} A, {frequency:.0f} Hz", at, change)


@_family
def current_dead_band(rng, moments, size):
    """Small currents are read as zero."""
    band, at = size.current * draw_size(rng, 0.3, 4.0), pick_sometime(rng, moments)
    return current_fault(f"below {band:.1f} A", at, lambda values, _: np.where(np.abs(values) < band, 0.0, values))


@_family
def current_absolute(rng, moments, size):
    """The sender gives the current's amount without its sign."""
    at = 0.0 if rng.random() < 0.5 else pick_driving(rng, moments)
    return current_fault("", at, lambda values, _: np.abs(values))


@_family
def thermocouple_cold(rng, moments, size):
    """A thermocouple has come off and reads the air near the caliper."""
    column, share, at = int(rng.integers(3)), float(rng.uniform(0.0, 0.8)), pick_sometime(rng, moments)
    change = alter(wire.THERMOCOUPLE, column, lambda values, _: 25.0 + share * (values - 25.0))
    return Fault(f"{column}, {100 * share:.0f} % of the rise", at, bus=during(change, at))


@_family
def wheel_speed_noisy(rng, moments, size):
    """The wheel speed has gaps: it reads zero or twice as much, now and then."""
    share, at = draw_size(rng, 0.01, 0.4), moments["go_1"]

    def change(values, _):
        return values * np.where(rng.random(len(values)) < share, rng.choice([0.0, 2.0], len(values)), 1.0)

    return Fault(f"{100 * share:.0f} %", at, bus=during(alter(wire.WHEEL_SPEED, 0, change), at))


@_family
def motion_leaks(rng, moments, size):
    """The angle carries a share of the current, as a cable beside another does."""
    share, at, kept = draw_signed(rng, 0.0005, 0.02), pick_sometime(rng, moments), [0.0]

    def read(values, _):
        if len(values):
            kept[0] = float(values[-1]) / max(size.current, 1e-9)
        return values

    def add(values, _):
        return values + share * kept[0]

    bus = chain(alter(wire.CURRENT, wire.CURRENT_Q, read), _resolver(lambda _: add, _RESOLVER[:1]))
    return Fault(f"{1e3 * share:+.1f} mrad", at, bus=during(bus, at))


@_family
def hold_slips(rng, moments, size):
    """In one hold the resolver's rotor creeps on its shaft, under vibration, and stays where it is."""
    by, at, lasts = draw_signed(rng, 0.2, 6.0), pick_clamped(rng, moments), draw_size(rng, 0.05, 20.0)

    def change(values, time_s):
        times = time_s + CYCLE_S * np.arange(len(values))
        return values + by * np.clip((times - at) / lasts, 0.0, 1.0)

    return Fault(f"{by:+.2f} rad in {lasts:.1f} s", at, bus=during(_resolver(lambda _: change, _RESOLVER[:1]), at))
