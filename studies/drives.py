"""Schedules of a rig's operator: a training, parking on the latch, a stop and a long brake application."""

import numpy as np

from emb_daemon.plant.records import LATCH
from emb_daemon.plant.scenarios import Schedule, angle_at, clamp, move, park, rest
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
