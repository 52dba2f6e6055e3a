"""Schedules of driver, rig operator and brake controller, with one row per 4 ms cycle, and their building blocks."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.plant.brake import motor_angle, static_angle
from emb_daemon.plant.car import Car
from emb_daemon.plant.records import ANGLE, COMMAND, DRIVE, FORCE, RELEASE
from emb_daemon.wire.contract import CYCLE_S, PARK_APPLIED, PARK_IN_TRANSITION, PARK_RELEASED

#: BrakeRequest is sent while the demanded force is above this, N.
_REQUEST_N = 200.0


@dataclass(frozen=True)
class Schedule:
    """Commands (COMMAND, one row per cycle, every corner alike) and drives (DRIVE, one row per cycle)."""

    commands: np.ndarray
    drives: np.ndarray

    def __len__(self) -> int:
        return len(self.drives)

    def __add__(self, other: "Schedule") -> "Schedule":
        return Schedule(np.concatenate([self.commands, other.commands]), np.concatenate([self.drives, other.drives]))

    @property
    def seconds(self) -> float:
        return len(self) * CYCLE_S

    def first(self, seconds: float) -> "Schedule":
        """The schedule from its start, repeated as often as ``seconds`` needs."""
        rows = np.arange(round(seconds / CYCLE_S)) % len(self)
        return Schedule(self.commands[rows], self.drives[rows])


def rest(seconds: float, wheel_speed: float = np.nan, target_speed: float = 0.0, ambient: float = 22.0) -> Schedule:
    """Released; ``wheel_speed`` rad/s turns the disc as a rig does, NaN leaves it to the car at ``target_speed`` m/s."""
    count = round(seconds / CYCLE_S)
    commands, drives = np.zeros(count, COMMAND), np.zeros(count, DRIVE)
    commands["mode"] = RELEASE
    drives["wheel_speed"], drives["target_speed"], drives["ambient"] = wheel_speed, target_speed, ambient
    return Schedule(commands, drives)


def move(schedule: Schedule, angle: np.ndarray) -> Schedule:
    """Command angles past the released position (rad), smoothly."""
    schedule.commands["mode"] = ANGLE
    schedule.commands["target"] = angle
    schedule.commands["rate"][:-1] = np.diff(angle) / CYCLE_S
    return schedule


def clamp(schedule: Schedule, force: np.ndarray) -> Schedule:
    """Command clamp forces (N); a brake is requested above `_REQUEST_N`."""
    schedule.commands["mode"] = np.where(force > 0.0, FORCE, RELEASE)
    schedule.commands["target"] = force
    schedule.drives["brake_request"] = force > _REQUEST_N
    return schedule


def angle_at(plant: np.void, force_N: float) -> float:
    """Motor angle past the released position (rad) at which the cold static force is ``force_N``."""
    return float(motor_angle(plant, plant["contact_angle"] + static_angle(plant, force_N)))


def curve(plant: np.void, force_N: float = 25000.0, seconds: float = 40.0) -> Schedule:
    """Slow clamp and release over the whole characteristic curve (thesis 2.1)."""
    schedule = rest(seconds)
    time = CYCLE_S * np.arange(len(schedule))
    shape = 0.5 * (1.0 - np.cos(2.0 * np.pi * time / seconds))
    return move(schedule, angle_at(plant, force_N) * shape)


def random_angle(plant: np.void, seconds: float, rng: np.random.Generator, high_N: float = 15000.0) -> Schedule:
    """A uniform random motor angle every 100 ms (thesis 3.3.2)."""
    schedule = rest(seconds)
    cycles = round(0.1 / CYCLE_S)
    targets = rng.uniform(angle_at(plant, 0.0), angle_at(plant, high_N), len(schedule) // cycles + 1)
    schedule.commands["mode"] = ANGLE
    schedule.commands["target"] = np.repeat(targets, cycles)[: len(schedule)]
    schedule.drives["brake_request"] = 1
    return schedule + rest(0.5)


def accelerate(speed: float, seconds: float) -> Schedule:
    """The car reaches and holds ``speed`` m/s."""
    return rest(seconds, target_speed=speed)


def stop(force_N: float, seconds: float, rise: float = 0.25) -> Schedule:
    """The car is braked with ``force_N`` at each corner, comes to a stand if the time is enough, and is released."""
    schedule = rest(seconds, target_speed=np.nan)
    time = CYCLE_S * np.arange(len(schedule))
    return clamp(schedule, force_N * np.clip(np.minimum(time / rise, (seconds - 0.3 - time) / 0.15), 0.0, 1.0))


def drag(force_N: float, speed: float, seconds: float) -> Schedule:
    """The car rolls downhill at ``speed`` m/s against its brakes."""
    schedule = stop(force_N, seconds)
    schedule.drives["target_speed"] = speed
    return schedule


def park(force_N: float, seconds: float) -> Schedule:
    """The standing car is parked and, half a second before the end, released."""
    schedule = rest(seconds, target_speed=0.0)
    time = CYCLE_S * np.arange(len(schedule))
    ramp = np.clip(np.minimum(time / 1.0, (seconds - 0.5 - time) / 0.3), 0.0, 1.0)
    clamp(schedule, force_N * ramp)
    schedule.drives["brake_request"] = 0
    parked = np.where(ramp >= 1.0, PARK_APPLIED, PARK_IN_TRANSITION)
    schedule.drives["park_brake"] = np.where(ramp > 0.0, parked, PARK_RELEASED)
    return schedule


def city_drive() -> Schedule:
    """Thirty seconds: two stops with a cruise between them, a hard stop, parking."""
    return (
        rest(1.0)
        + accelerate(12.0, 4.0)
        + stop(7000.0, 4.0)
        + accelerate(16.0, 4.5)
        + drag(1500.0, 16.0, 3.0)
        + accelerate(18.0, 1.5)
        + stop(16000.0, 3.5)
        + park(14000.0, 7.5)
        + rest(1.0)
    )


def parking() -> Schedule:
    """Parked for two minutes: training motion when the daemon requests it."""
    return rest(1.0) + park(12000.0, 120.0) + rest(2.0)


SCENARIOS = {"drive": city_drive, "park": parking}


#: Share of the demanded force at a rear brake.
_REAR_SHARE = 0.6


def commands_of(schedule: Schedule, corners: tuple[str, ...]) -> np.ndarray:
    """COMMAND array (cycles, corners): every corner as scheduled, rear brakes with less force."""
    commands = np.repeat(schedule.commands[:, None], len(corners), axis=1)
    for row, corner in enumerate(corners):
        if corner.startswith("R"):
            commands["target"][:, row] *= np.where(commands["mode"][:, row] == FORCE, _REAR_SHARE, 1.0)
    return commands


def simulate_log(
    plants: np.ndarray | np.void,
    schedule: Schedule,
    seconds: float | None = None,
    seed: int = 0,
    corners: tuple[str, ...] = ("FL",),
    reference: bool = True,
    **car_options: float,
) -> tuple[np.ndarray, np.ndarray]:
    """A whole log at once, reproducible from its seed: FRAME array in order of time, with the rig instruments' frames if there
    is a ``reference``, and TRUTH array, shape (cycles, corners). The schedule is cut or repeated to so many seconds."""
    car = Car(np.atleast_1d(plants), corners, seed, reference, **car_options)
    if seconds is not None:
        schedule = schedule.first(seconds)
    return car.run(commands_of(schedule, corners), schedule.drives)
