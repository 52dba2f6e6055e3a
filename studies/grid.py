"""Drives of the simulated car, each with a fault or two of `studies.faults`, judged phase by phase.

The brake is our own, of which the daemon has the calibration that the plant is made from, or a stranger of
`studies.strangers`, of which it has what `identify` made of the campaign. Forces, the mass of the car and sizes of faults are
those of a brake of 30 kN; other brakes have their share.
"""

import tempfile
import zlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.files import load_calibration, shipped_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.wire.contract import CYCLE_S
from studies import faults, senders, unlisted
from studies.drives import draw_braking, draw_interlude, park_on_latch
from studies.faults import LEARNED, NOMINAL, Fault, Size, size_of
from studies.phases import LEARNED_RMSE_N, LEARNED_USEFUL, NOMINAL_USEFUL, POWER_ON_S, judge, verdict
from studies.strangers import draw_stranger

#: Faults that drives may have.
FAMILIES = faults.FAMILIES | unlisted.FAMILIES | senders.FAMILIES
#: The park brake is applied this long, s: settling, a stroke of the car's 20 s and the daemon's evaluation fit into it.
_PARK_S = 34.0
#: Cycles of a stretch: training ends if the car receives no request of the daemon for 25.
_STRETCH = 20
#: Radius of our own car's wheels, m, and of a stranger's: they turn no faster than its campaign's, up to 60 rad/s, beyond
#: which a drawn effect that grows with speed or friction power has never been seen.
_WHEEL_M, _STRANGERS_WHEEL_M = 0.31, 0.42
#: Phases shorter than this, s, are not judged.
_SHORTEST_S = 1.0
#: Time that learning has before the drive's second half, s, for its promises to be asked for.
_LEARNING_S = 10.0
#: Ways in which a drive begins: of two of them at once there is no common drive.
_STARTS = {"start_clamped", "start_latched", "power_cycle", "daemon_restart", "wheel_phase_restart"}


def _reversals(seconds: float, low_N: float, high_N: float) -> sc.Schedule:
    """Standing, the force goes up and down, 1.6 times a second."""
    schedule = sc.stop(0.5 * (low_N + high_N), seconds)
    target = schedule.commands["target"]
    swing = 0.5 * (high_N - low_N) * np.sin(2.0 * np.pi * 1.6 * CYCLE_S * np.arange(len(schedule)))
    target += np.where(target > low_N, swing, 0.0)
    return schedule


def draw_drive(
    plant: np.void, rng: np.random.Generator, latched_N: float = 0.0, share: float = 1.0, drawn: bool = False
) -> tuple[sc.Schedule, dict[str, float]]:
    """A drive of two minutes or so and when its parts begin, s: stops, holds, reversals, long drags, park brake with
    time for a training stroke, driving again, random angle. ``share``: of the forces of a brake of 30 kN. ``drawn``: how the
    brakes are used is drawn, too, and what comes between."""

    def between(low, high):
        return float(rng.uniform(low, high))

    def force(low, high):
        return share * between(low, high)

    def stop(force_N, seconds):
        return draw_braking(rng, force_N, seconds * between(0.5, 2.0)) if drawn else sc.stop(force_N, seconds)

    def drag(force_N, speed, seconds):
        return draw_braking(rng, force_N, seconds * between(0.5, 3.0), speed) if drawn else sc.drag(force_N, speed, seconds)

    def interlude(name):
        return ((name, draw_interlude(rng, share)),) if drawn else ()

    # Half of the drives begin on a car that stood parked overnight: training on cold pads comes first.
    cold = (("park_0", sc.park(force(1e4, 1.5e4), _PARK_S)),) if rng.random() < 0.5 else ()
    parts = (
        ("stand", park_on_latch(latched_N) if latched_N else sc.rest(2.0)),
        *cold,
        ("hold_1", sc.stop(force(6e3, 11e3), 3.0)),
        ("go_1", sc.accelerate(between(12.0, 16.0), 4.0)),
        ("stop_1", stop(force(4e3, 8e3), 4.0)),
        *interlude("between_1"),
        ("go_2", sc.accelerate(between(16.0, 20.0), 5.0)),
        ("drag_1", drag(force(2e3, 4e3), 18.0, 8.0)),
        ("stop_2", stop(force(8e3, 14e3), 3.5)),
        ("reversals", _reversals(4.0, share * 5e3, share * 8e3)),
        *interlude("between_2"),
        ("go_3", sc.accelerate(between(20.0, 25.0), 6.0)),
        ("stop_3", stop(force(14e3, 22e3), 3.5)),
        ("stand_2", sc.rest(1.5)),
        ("go_4", sc.accelerate(10.0, 3.0)),
        ("stop_4", stop(force(2e3, 5e3), 4.0)),
        *interlude("between_3"),
        ("go_5", sc.accelerate(between(10.0, 18.0), 4.5)),
        ("stop_5", stop(force(5e3, 12e3), 4.0)),
        ("stand_3", sc.rest(1.0)),
        ("park", sc.park(force(1e4, 1.5e4), _PARK_S)),
        ("go_6", sc.accelerate(14.0, 4.0)),
        ("stop_6", stop(force(5e3, 9e3), 4.0)),
        *interlude("between_4"),
        ("go_7", sc.accelerate(18.0, 4.5)),
        ("drag_2", drag(force(2e3, 4e3), 16.0, 6.0)),
        ("stop_7", stop(force(1e4, 2e4), 3.5)),
        ("hold_2", stop(force(6e3, 11e3), 3.0)),
        ("go_8", sc.accelerate(between(10.0, 18.0), 4.5)),
        ("stop_8", stop(force(3e3, 8e3), 4.0)),
        ("random", sc.random_angle(plant, 4.0, rng, high_N=share * 12e3)),
        ("end", sc.rest(1.0)),
    )
    ends = np.cumsum([part.seconds for _, part in parts])
    moments = dict(zip((name for name, _ in parts), (float(end) for end in (0.0, *ends)), strict=False))
    schedule = sc.Schedule(*(np.concatenate([getattr(part, rows) for _, part in parts]) for rows in ("commands", "drives")))
    return schedule, moments | {"after": moments["go_6"], "over": schedule.seconds}


def _join(faults: list[Fault]) -> Fault:
    """Several faults as one."""
    if len(faults) == 1:
        return faults[0]

    def each(name: str) -> Callable:
        def call(*arguments):
            for fault in faults:
                getattr(fault, name)(*arguments)

        return call

    def bus(frames, time_s):
        for fault in faults:
            frames = fault.bus(frames, time_s)
        return frames

    return Fault(
        size=" + ".join(fault.size for fault in faults),
        onset_s=min(fault.onset_s for fault in faults),
        brake=each("brake"),
        pads_mm=next((fault.pads_mm for fault in faults if fault.pads_mm), None),
        car=each("car"),
        bus=bus,
        effects={name: values for fault in faults for name, values in fault.effects.items()},
        ambient_C=min(fault.ambient_C for fault in faults),
        warm_C=next((fault.warm_C for fault in faults if fault.warm_C), None),
        power_on_s=max(fault.power_on_s for fault in faults),
        restarts=tuple(restart for fault in faults for restart in fault.restarts),
        latched_N=max(fault.latched_N for fault in faults),
    )


class _Daemon:
    """The daemon's own pipeline with adaptation, started anew at each restart of the drive; what it learned stays in its
    folder."""

    def __init__(self, calibration, folder: Path):
        self._calibration, self._folder = calibration, folder
        self.start()

    def start(self) -> None:
        parameters = np.zeros(4, PARAMETERS)
        parameters[0] = to_parameters(self._calibration)
        adaptation = Adaptation({"FL": self._calibration}, Memory(self._folder), int)
        self._pipeline, self._begun = Pipeline(parameters, ("FL",), adaptation=adaptation), False

    def answer(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """ESTIMATE rows and sent frames, valid until the next call."""
        if not self._begun and len(frames):
            self._pipeline.begin(int(frames["time_ns"][0]))
            self._begun = True
        _, count = self._pipeline.consume(frames)
        return self._pipeline.estimates[:count], self._pipeline.broadcast(count)


class Brake(NamedTuple):
    """A brake that is driven: the daemon's calibration, the brake's own, effects and unit (None: another for each drive),
    size, and radius of the wheels, m."""

    calibration: Calibration
    own: Calibration
    effects: dict[str, dict[str, float]]
    unit: int | None
    size: Size
    wheel_m: float


@cache
def brake_of(stranger: Path | None) -> Brake:
    """Our own, or the stranger whose seed is the name of a folder that `studies.strangers` kept. Raises InputError: the folder
    holds no calibration, or its name is no seed."""
    own = shipped_calibration()
    if stranger is None:
        return Brake(own, own, {}, None, Size(), _WHEEL_M)
    identified = load_calibration(stranger / "c.yaml")
    if not stranger.name.isdecimal():
        raise InputError(f"{stranger}: expected a folder named after the stranger's seed")
    drawn = draw_stranger(int(stranger.name))
    size = size_of(drawn.calibration, own)
    return Brake(identified, drawn.calibration, drawn.effects, int(stranger.name), size, _STRANGERS_WHEEL_M)


def _with_effects(calibration: Calibration, effects: dict) -> Calibration:
    changed = msgspec.to_builtins(calibration) | {"effects": dict(calibration.effects) | effects}
    return msgspec.convert(changed, Calibration)


def prepare(names: tuple[str, ...], number: int, seed: int, brake: Brake, families: dict = FAMILIES, drawn: bool = False):
    """Drive number ``number`` of a brake with faults of these ``families``: (fault, moments, the daemon's calibration with the
    effects that brake and calibration share, car, schedule)."""
    rng = np.random.default_rng([seed, number, *(zlib.crc32(name.encode()) for name in names)])
    calibration, own, effects, unit, size, wheel_m = brake
    # The moments are needed to draw the fault, and the fault's brake to draw the drive: two draws of the same numbers.
    drive_seed = int(rng.integers(1 << 32))
    plain = plant_from_calibration(own)
    latched_N = size.force * 1e4 if "start_latched" in names else 0.0
    moments = draw_drive(plain, np.random.default_rng(drive_seed), latched_N, size.force, drawn)[1]
    fault = _join([families[name](rng, moments, size) for name in names])
    if fault.effects:
        calibration, own = _with_effects(calibration, fault.effects), _with_effects(own, fault.effects)
        effects = {name: values for name, values in effects.items() if name not in fault.effects}
    another = int(rng.integers(1 << 32))
    plant = plant_from_calibration(own, another if unit is None else unit, effects, fault.pads_mm)
    for name in ("current_noise", "speed_noise", "angle_noise", "temperature_noise"):
        plant[name] *= rng.uniform(0.8, 1.2)
    fault.brake(plant)
    schedule, moments = draw_drive(plant, np.random.default_rng(drive_seed), fault.latched_N, size.force, drawn)
    schedule.drives["ambient"] = fault.ambient_C
    car = Car(np.atleast_1d(plant), seed=int(rng.integers(1 << 32)), ambient=fault.ambient_C)
    for name in ("mass", "drag", "rolling"):
        car.motion[name] *= size.force * _WHEEL_M / wheel_m
    car.motion["wheel_radius"] = wheel_m
    if fault.warm_C:
        disc, plate, remembered = fault.warm_C
        car.states["softening_memory"] = remembered * (0.5 * (disc + plate) - plant["curve_temperature"])
        car.states["disc"] = disc
        car.states["pads"][:] = np.linspace(disc, plate, car.states["pads"].shape[-1])
        for name in ("plate", "plate_reading", "caliper"):
            car.states[name] = plate
    return fault, moments, calibration, car, schedule


def drive(
    names: tuple[str, ...], number: int, seed: int, stranger: Path | None = None, drawn: bool = False
) -> tuple[Fault, dict, np.ndarray, np.ndarray]:
    """Such a drive of `brake_of` ``stranger``: (fault, moments, ESTIMATE rows, true force at each, N)."""
    fault, moments, calibration, car, schedule = prepare(names, number, seed, brake_of(stranger), drawn=drawn)
    commands = sc.commands_of(schedule, ("FL",))
    silences = [(0.0, fault.power_on_s)] + [(at, at + off) for at, off in fault.restarts]
    restarts = sorted(at + off for at, off in fault.restarts)
    # Predictions can make more rows than there are cycles.
    force_N, estimates, count = np.zeros(len(schedule)), np.zeros(2 * len(schedule), ESTIMATE), 0
    with tempfile.TemporaryDirectory() as folder:
        daemon = _Daemon(calibration, Path(folder))
        for first in range(0, len(schedule), _STRETCH):
            time_s = first * CYCLE_S
            fault.car(car, time_s)
            frames, truth = car.run(commands[first : first + _STRETCH], schedule.drives[first : first + _STRETCH])
            force_N[first : first + len(truth)] = truth["force"][:, 0]
            if restarts and time_s >= restarts[0]:
                restarts.pop(0)
                daemon.start()
            if any(begin <= time_s < end for begin, end in silences):
                continue
            answers, sent = daemon.answer(fault.bus(frames, time_s))
            car.receive(sent)
            estimates[count : count + len(answers)] = answers
            count += len(answers)
    estimates = estimates[:count]
    row = np.clip(np.rint(estimates["time_ns"] / (1e9 * CYCLE_S)).astype(int) - 1, 0, len(force_N) - 1)
    return fault, moments, estimates, force_N[row]


def judge_drive(names: tuple[str, ...], number: int, seed: int, stranger: Path | None = None, drawn: bool = False) -> dict:
    """Verdict of one drive."""
    fault, moments, estimates, force_N = drive(names, number, seed, stranger, drawn)
    time_s = 1e-9 * estimates["time_ns"]
    onset = max(fault.onset_s, *(at + off + POWER_ON_S for at, off in ((0.0, fault.power_on_s), *fault.restarts)))
    park, after = moments["park"], moments["after"]
    parked = [(moments[name], moments[name] + _PARK_S) for name in ("park_0", "park") if name in moments]
    begun = time_s >= min(fault.onset_s, park)
    training = np.any([(time_s >= since) & (time_s < until) for since, until in parked], axis=0)
    spans = {
        "before": ~begun,
        "during": begun & ~training & (time_s < park),
        "training": begun & training,
        "after": time_s >= after,
    }
    phases = []
    for phase, rows in spans.items():
        if rows.sum() * CYCLE_S < _SHORTEST_S:
            continue
        useful = rmse_N = None
        if NOMINAL.issuperset(names) and phase != "training":
            useful = NOMINAL_USEFUL
        elif LEARNED.issuperset(names) and phase == "after" and fault.onset_s < park - _LEARNING_S:
            useful, rmse_N = LEARNED_USEFUL, LEARNED_RMSE_N
        phases.append(judge(phase, time_s[rows], estimates[rows], force_N[rows], useful, rmse_N))
    return verdict(" + ".join(names), number, fault, time_s, estimates, onset, phases)


def pairs_of(count: int, seed: int, names: list[str]) -> list[tuple[str, str]]:
    """Pairs of families, drawn."""
    rng = np.random.default_rng([seed, 2])
    candidates = [name for name in names if name not in NOMINAL]
    pairs: list[tuple[str, str]] = []
    while len(pairs) < count:
        one, other = rng.choice(candidates, 2, replace=False)
        if not {one, other} <= _STARTS:
            pairs.append((str(one), str(other)))
    return pairs


def run_grid(tasks: list[tuple[tuple[str, ...], int]], seed: int, stranger: Path | None, processes: int, drawn: bool = False):
    """Verdicts of (families, number) in turn, as they come."""
    if processes == 1:
        yield from (judge_drive(names, number, seed, stranger, drawn) for names, number in tasks)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        rest = [seed] * len(tasks), [stranger] * len(tasks), [drawn] * len(tasks)
        yield from pool.map(judge_drive, *zip(*tasks, strict=True), *rest, chunksize=4)
