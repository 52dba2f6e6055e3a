"""Schedules of a rig's operator: training, parking on the latch, a stop, a long brake application; and of a driver, drawn: how
brakes are applied, and what comes between."""

from collections.abc import Callable

import numpy as np

from emb_daemon.plant.records import LATCH
from emb_daemon.plant.scenarios import Schedule, accelerate, angle_at, clamp, move, park, rest, stop
from emb_daemon.wire.contract import CYCLE_S, PARK_APPLIED


def _approach(angle: np.ndarray) -> np.ndarray:
    """Move from the released position into a motion within half a second, and back at its end."""
    time = CYCLE_S * np.arange(len(angle))
    share = np.clip(np.minimum(time, time[-1] - time) / 0.5, 0.0, 1.0)
    return 0.5 * (1.0 - np.cos(np.pi * share)) * angle


def training(plant: np.void, seconds: float = 42.0, high_N: float = 15000.0) -> Schedule:
    """Park brake applied; slow clamp and release in 20 s, a sinusoid of 0.8 rad and 6 Hz on top (thesis Fig. 3-9)."""
    schedule = rest(seconds)
    time = CYCLE_S * np.arange(len(schedule))
    low, high = angle_at(plant, 0.0) - 2.0, angle_at(plant, high_N) - 0.8
    angle = low + (high - low) * 0.5 * (1.0 - np.cos(2.0 * np.pi * time / 20.0))
    angle += 0.8 * np.sin(2.0 * np.pi * 6.0 * time)
    schedule.drives["park_brake"] = PARK_APPLIED
    return move(schedule, _approach(angle)) + rest(0.5)


def park_on_latch(force_N: float) -> Schedule:
    """Parked, then held by the latch without current, then released."""
    hold = rest(10.0)
    hold.commands["mode"], hold.drives["park_brake"] = LATCH, PARK_APPLIED
    return park(force_N, 6.0).first(4.8) + hold + rest(1.0)


def rig_stop(force_N: float, wheel_speed: float, clamp_seconds: float = 3.0, cycle_seconds: float = 9.0) -> Schedule:
    """On the rig: the disc is brought to ``wheel_speed`` rad/s, braked to a stand and held a moment."""
    schedule = rest(cycle_seconds)
    time = CYCLE_S * np.arange(len(schedule))
    begin = cycle_seconds - clamp_seconds - 1.5
    stop = begin + 0.85 * clamp_seconds
    schedule.drives["wheel_speed"] = wheel_speed * np.clip(
        np.minimum(time / (0.7 * begin), (stop - time) / (stop - begin)), 0, 1
    )
    force = force_N * np.clip((time - begin) / 0.2, 0.0, 1.0) * (time < begin + clamp_seconds)
    return clamp(schedule, force)


def rig_drag(force_N: float, wheel_speed: float, seconds: float) -> Schedule:
    """On the rig: a long brake application at constant disc speed."""
    force = np.full(round(seconds / CYCLE_S), force_N)
    return clamp(rest(seconds, wheel_speed), force * np.clip(CYCLE_S * np.arange(len(force)) / 0.5, 0.0, 1.0)) + rest(
        2.0, wheel_speed
    )


def _share_of_force(rng: np.random.Generator, time_s: np.ndarray) -> np.ndarray:
    """Share of the force that a driver or a controller asks for, 0 to 1, over the time of one braking, shape (N,); the brake
    has been released for a moment when the time is over."""
    over = time_s[-1] - 0.3

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def held(rise_s: float, fall_s: float) -> np.ndarray:
        return np.clip(np.minimum(time_s / rise_s, (over - time_s) / fall_s), 0.0, 1.0)

    def pressed() -> np.ndarray:
        at = over * between(0.3, 0.7)
        return np.clip(np.minimum(time_s / at, (over - time_s) / (over - at)), 0.0, 1.0)

    def stairs() -> np.ndarray:
        steps = rng.uniform(0.1, 1.0, int(rng.integers(3, 7)))
        level = steps[np.minimum((time_s / over * len(steps)).astype(int), len(steps) - 1)]
        count = round(between(0.05, 0.3) / CYCLE_S)
        return np.convolve(level, np.ones(count) / count)[: len(level)] * held(0.1, 0.15)

    def pumped() -> np.ndarray:
        period = between(0.6, 1.6)
        return np.clip(3.0 * np.sin(2.0 * np.pi * time_s / period), 0.0, 1.0) * held(0.05, 0.1)

    def anti_lock() -> np.ndarray:
        swing = 0.5 * between(0.1, 0.7) * (1.0 + np.sin(2.0 * np.pi * between(2.0, 8.0) * time_s))
        return held(0.15, 0.15) * np.where(time_s > 0.3 * over, 1.0 - swing, 1.0)

    def by_foot() -> np.ndarray:
        lag = CYCLE_S / between(0.1, 0.8)
        wander, trembling = np.zeros(len(time_s)), rng.normal(0.0, between(0.1, 0.4) * np.sqrt(2.0 / lag), len(time_s))
        for row in range(1, len(wander)):
            wander[row] = wander[row - 1] + lag * (trembling[row] - wander[row - 1])
        return np.clip(held(between(0.2, 1.0), between(0.2, 1.0)) * (0.7 + wander), 0.0, 1.0)

    def blended() -> np.ndarray:
        return held(0.2, 0.2) * np.interp(time_s, over * np.array([0.2, 0.35, 0.7, 0.85]), [1.0, between(0.05, 0.4), 0.3, 1.0])

    manners = (lambda: held(between(0.06, 0.6), between(0.06, 0.5)), pressed, stairs, pumped, anti_lock, by_foot, blended)
    return manners[int(rng.integers(len(manners)))]()


def draw_braking(rng: np.random.Generator, force_N: float, seconds: float, speed: float = np.nan) -> Schedule:
    """The car is braked with up to ``force_N`` at each corner, in a manner that is drawn; it rolls at ``speed`` m/s against
    its brakes, or slows down where that is NaN."""
    schedule = rest(seconds, target_speed=speed)
    return clamp(schedule, force_N * _share_of_force(rng, CYCLE_S * np.arange(len(schedule))))


def draw_interlude(rng: np.random.Generator, share: float) -> Schedule:
    """Ten seconds to two minutes of driving, standing or parking, drawn. ``share``: of the forces of a brake of 30 kN."""

    def between(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def motorway() -> Schedule:
        return accelerate(between(25.0, 35.0), between(30.0, 120.0))

    def jam() -> Schedule:
        moves = rest(0.5)
        for _ in range(int(rng.integers(4, 11))):
            braking = draw_braking(rng, share * between(500.0, 3e3), between(1.5, 3.0))
            moves = moves + accelerate(between(1.0, 5.0), between(1.5, 4.0)) + braking + rest(between(0.0, 5.0))
        return moves

    def descent() -> Schedule:
        speed, moves = between(10.0, 20.0), rest(0.0)
        while moves.seconds < 40.0:
            braking = draw_braking(rng, share * between(1e3, 5e3), between(3.0, 20.0), speed)
            moves = moves + braking + accelerate(speed, between(0.5, 6.0))
        return moves

    def hill() -> Schedule:
        return draw_braking(rng, share * between(3e3, 8e3), 3.0) + stop(share * between(2e3, 9e3), between(20.0, 60.0))

    def waiting() -> Schedule:
        return draw_braking(rng, share * between(3e3, 8e3), 4.0) + rest(between(20.0, 90.0))

    def wiped() -> Schedule:
        light = draw_braking(rng, share * between(150.0, 800.0), between(5.0, 20.0), between(8.0, 20.0))
        return accelerate(between(8.0, 20.0), 6.0) + light + accelerate(12.0, 15.0)

    def parked() -> Schedule:
        return draw_braking(rng, share * between(3e3, 8e3), 4.0) + park(share * between(8e3, 1.5e4), between(2.0, 6.0))

    kinds: tuple[Callable[[], Schedule], ...] = (motorway, jam, descent, hill, waiting, wiped, parked)
    return kinds[int(rng.integers(len(kinds)))]()
