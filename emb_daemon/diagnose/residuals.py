"""Residuals: what the running estimator's paths leave unexplained, and how they answer to its parameters.

Everything comes from the production `estimator.step`, run over the log with parameters moved by a little, so that what a
candidate is credited with is what the daemon will do with it. Only the learning of the contact angle is held here: it
would spread an error of one path over both, and hide slow effects in an angle that wanders.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from emb_daemon.calibration.parameters import CLEARANCE, CLEARANCE_SIGMA, moved
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.diagnose.coordinates import HISTORY_TIME, Coordinate, Values, by_key
from emb_daemon.diagnose.episodes import by_turns, episodes, standing, yielding
from emb_daemon.diagnose.evidence import Averaging
from emb_daemon.diagnose.held_heat import run_held, run_with_heat
from emb_daemon.diagnose.speeds import denoised
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import OF_THE_MOTOR
from emb_daemon.effects.terms import PORTS, SIGNALS
from emb_daemon.errors import InputError
from emb_daemon.estimator.paths import ONE_CYCLE_S
from emb_daemon.logs.currents import current_late_ms
from emb_daemon.logs.series import Series
from emb_daemon.models.wheel import wheel_angle
from emb_daemon.offline.log import Log
from emb_daemon.offline.run import held, run_paths, run_step
from emb_daemon.wire.contract import CYCLE_S

#: Residuals by channel and their unit. `innovation` stands for the paths' reference where a log has none.
UNITS = {"stiffness": "N", "torque": "N", "innovation": "N", "temperature": "K", "brake_torque": "N·m"}
FORCE_CHANNELS = ("stiffness", "torque", "innovation")
CHANNEL_OF_HEAT = "temperature"
HEAT_CHANNELS = (CHANNEL_OF_HEAT, "brake_torque")
#: Residuals of one time that follow each other, where that is more than one: of four thermocouples in each pad and the disc's.
SIDE_BY_SIDE = {CHANNEL_OF_HEAT: 9}
#: Brake torque is compared where pads slide: above this disc speed (rad/s; below, the sensor shows static friction) and this
#: reference force (N).
_SLIDING, _TOUCHING_N = 1.0, 300.0
#: Brake torque (N m) below which a sensor shows nothing but its noise.
_BRAKING_NM = 20.0
#: Squared partial correlation of current and load from which, where nothing is clamped, the current is there for the load.
#: Below it most of the current turns the machine itself, and a constant fitted to the load would be less than half of the
#: motor's (regression dilution).
_FOR_THE_LOAD = 0.5
#: Time over which what a load changes by more than the current is none of its work, s: strokes and holds last longer. On
#: thirty recordings of docs/hardware.md any time from 20 to 200 ms decides the same.
_AT_ONCE_S = 0.05
#: Share of the sliding friction from which it has turned over after a reversal.
_TURNED_OVER = 0.9
#: Effect and amplitude of what changes the torque constant by the current of its own sample.
_BY_CURRENT = [
    (e.name, p.name) for e in REGISTRY if (e.hook, e.signal) == ("torque_constant", "current") for p in e.amplitudes
]
#: Step of the current by which the torque of one ampere more is found, A.
_MORE_A = 0.1
#: Samples from which a search begins where signals alone say: a speed that is the mean of its cycle, or a frame that waits for
#: the next, is off by up to one, and from so near the fit of the catalogue's effect arrives by itself. Standard deviations
#: that are certain.
_FAR, _SURELY = 2.0, 5.0
#: Current and motion are compared over so many ms, more than the longest age that a calibration may state. Share of a cycle
#: by which they may be apart, as the estimate allows for (`models.alignment`): a whole one made 550 N of viscous friction
#: that is not there. Share of a large acceleration from which the motor accelerates; holds tell nothing of the time.
_LONGEST_MS, _WITHIN, _ACCELERATES = 60, 0.6, 0.1
#: A current that is exactly nothing at least so often, and else never below so many of its own steps, has a dead band; and
#: standard deviations of its noise above that from which noise no longer decides whether it is there.
_LEAST_DEAD, _DEAD_STEPS, _CLEAR = 50, 10.0, 3.0
#: Share of the samples that must have a value before a log counts as having the signal.
_RECORDED = 0.1


@dataclass
class Trial:
    """One log, cut into episodes, with its references on the samples' clock."""

    log: Log
    index: int
    #: Reference force at the samples, moved by the instrument's own time stamps (not only to the nearest frame).
    force_N: np.ndarray
    episode: np.ndarray
    temperature_rows: np.ndarray
    temperature_C: np.ndarray
    brake_torque_Nm: np.ndarray
    #: Where the motor stands, where the friction of the gear has turned over, and where the load has turned it back, unseen.
    stands: np.ndarray
    slides: np.ndarray
    yields: np.ndarray
    #: What the calibration says otherwise of this log alone, by key: pads of another thickness, and their clearance.
    mounted: Mapping[str, float]

    @property
    def has_force(self) -> bool:
        return bool(np.isfinite(self.force_N).mean() > _RECORDED)

    @cached_property
    def dt(self) -> np.ndarray:
        """Time steps of the samples, s, side by side in memory."""
        return np.ascontiguousarray(self.log.samples["dt"])


def make_trial(log: Log, index: int, parameters: np.void, mounted: Mapping[str, float]) -> Trial:
    """Prepare a log. ``parameters``: PARAMETERS, whose clamp force cuts the episodes where no reference is."""
    force, torque = _synchronous(log)
    rows, measured = _temperatures(log)
    known = np.isfinite(force).mean() > _RECORDED
    clamping = force if known else run_step(log.samples, parameters)["force"]
    cut = episodes(log.time_s, np.nan_to_num(clamping), log.samples["angle"])
    stands = standing(log.time_s, log.samples["angle"])
    friction = run_paths(log.samples, parameters)["friction_mean"]
    level_N = _friction_N(parameters, np.nan_to_num(clamping))
    yields = yielding(log.samples["angle"], np.nan_to_num(clamping), friction, (1.0 - _TURNED_OVER) * level_N)
    return Trial(log, index, force, cut, rows, measured, torque, stands, np.abs(friction) > _TURNED_OVER, yields, mounted)


def _friction_N(parameters: np.void, force_N: np.ndarray) -> np.ndarray:
    """Clamp force whose load is as large as the gear's friction at each force, N, by PARAMETERS."""
    return (parameters["offset_friction"] + parameters["load_friction"] * np.maximum(force_N, 0.0)) / parameters["gear_gain"]


def count_over(episodes: Sequence[np.ndarray]) -> np.ndarray:
    """Numbers of episodes of several logs, each counted from 0, counted over all."""
    before = np.cumsum([0] + [int(own[-1]) + 1 for own in episodes])
    return np.concatenate([own + first for own, first in zip(episodes, before, strict=False)])


def _synchronous(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Reference force (N) and brake torque (N m) at the samples; NaN where there is none.

    The instrument's frames are stamped a constant while after the resolver's: the force moves by it, not by the jitter."""
    reference, time, force = log.reference, log.time_ns, log.force_N
    if not len(reference.time_ns) or not np.isfinite(force).any():
        return force, np.full(len(time), np.nan)
    share = float(np.clip(log.stamped_later_ns / np.median(np.diff(reference.time_ns)), -0.5, 0.5))
    shifted = force.copy()
    if share > 0.0:
        shifted[1:] = (1.0 - share) * force[1:] + share * force[:-1]
    elif share < 0.0:
        shifted[:-1] = (1.0 + share) * force[:-1] - share * force[1:]
    # A torque whose number was full is another one, nobody knows in how many of its samples.
    return shifted, np.full(len(time), np.nan) if log.full_torque else reference.at(time, reference.brake_torque_Nm)


def _temperatures(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Thermocouples inside the pads and the disc's, degC, shape (n, 9), and the sample row that each belongs to."""
    reference, time = log.reference, log.time_ns
    at, inner = reference.pads["inner"]
    keep = (at >= time[0]) & (at <= time[-1])
    at = at[keep]
    rows = np.searchsorted(time, at, side="right") - 1
    measured = np.full((len(rows), 9), np.nan)
    if not len(rows):
        return rows, measured
    measured[:, :4] = inner[:, keep].T
    outer_time, outer = reference.pads["outer"]
    if len(outer_time):
        measured[:, 4:8] = outer[:, np.clip(np.searchsorted(outer_time, at), 0, len(outer_time) - 1)].T
    if len(reference.time_ns):
        measured[:, 8] = reference.disc_C[np.clip(np.searchsorted(reference.time_ns, at), 0, len(reference.time_ns) - 1)]
    # An instrument that is not there reports a constant.
    measured[:, np.fmax.reduce(measured) == np.fmin.reduce(measured)] = np.nan
    return rows, measured


def _partial_correlation(trials: Sequence[Trial]) -> float:
    """Squared partial correlation of current and reference load, beside the motor's direction, speed and acceleration.

    Sudden changes of the load that the current does not share are left out, because the current cannot have made them: where
    another, jerking motor loads one that its current holds, a constant fitted to the current would be too large by that
    share."""
    tables, changes = [], []
    for trial in trials:
        samples = trial.log.samples
        speed, current = samples["speed"], samples["current_q"]
        known = samples["has_current"] & np.isfinite(trial.force_N)
        own = np.column_stack(
            [np.ones(len(speed)), np.sign(speed), speed, np.diff(speed, prepend=speed[:1]), current, trial.force_N]
        )
        tables.append(own[known])
        apart = max(round(_AT_ONCE_S / max(float(np.median(samples["dt"])), CYCLE_S)), 1)
        changes.append(own[known][apart:, 4:] - own[known][:-apart, 4:])
    table, change = np.concatenate(tables), np.concatenate(changes)
    if len(table) < table.shape[1] or not len(change) or not np.ptp(table[:, 4]) or not np.ptp(table[:, 5]):
        return 0.0
    rest = table[:, 4:] - table[:, :4] @ np.linalg.lstsq(table[:, :4], table[:, 4:], rcond=None)[0]
    products = rest.T @ rest
    size = products[0, 0] * products[1, 1]
    # Half of the mean square of a change is the variance of what changes at once: of the load its own and the current's share.
    # It is more than all of what swings back within that time, of which this tells nothing.
    current_share, load_share = 0.5 * np.mean(change**2, axis=0) / np.var(table[:, 4:], axis=0)
    kept = min((1.0 - load_share) / (1.0 - current_share), 1.0) if max(current_share, load_share) < 1.0 else 1.0
    return min(float(products[0, 1] ** 2 / (size * kept)), 1.0) if size > 0.0 else 0.0


def _current_late_s(trial: Trial) -> float:
    """Time by which the current of a brake comes after the motion and the force that it causes, s, negative if before; 0 if
    they are of one time, as far as samples tell."""
    samples = trial.log.samples
    rows = np.flatnonzero(samples["has_current"])
    speed, time, force = samples["speed"][rows], trial.log.time_ns[rows], trial.force_N[rows]
    if len(rows) < 2:
        return 0.0
    gained = np.diff(speed, prepend=speed[:1]) / np.maximum(samples["dt"][rows], CYCLE_S)
    columns = np.column_stack([np.ones(len(rows)), np.sign(speed), speed, gained, force, force * np.sign(speed)])
    current, told = Series(time, samples["current_q"][rows]), np.abs(gained) > _ACCELERATES * np.quantile(np.abs(gained), 0.99)
    late_s = 1e-3 * current_late_ms(current, time[told], columns[told], _LONGEST_MS)
    return late_s if abs(late_s) > _WITHIN * max(CYCLE_S, float(np.median(samples["dt"]))) else 0.0


def _dead_band_A(logs: Sequence[Log]) -> float:
    """Current below which its sensor tells nothing, A; 0 where it tells any."""
    current = np.abs(np.concatenate([log.samples["current_q"][log.samples["has_current"]] for log in logs]))
    sizes = np.unique(current)[: _LEAST_DEAD + 1]
    if len(sizes) <= 2 or sizes[0] > 0.0 or np.count_nonzero(current == 0.0) < _LEAST_DEAD:
        return 0.0
    return float(sizes[1]) if sizes[1] > _DEAD_STEPS * np.median(np.diff(sizes[1:])) else 0.0


def _told_by_signals(logs: Sequence[Log], calibration: Calibration) -> dict[str, float]:
    """Amplitudes that signals alone tell (`Effect.measure`) and that are surely some samples from the calibration's."""
    result = {}
    for effect in REGISTRY:
        if effect.measure is None:
            continue
        [amplitude] = effect.amplitudes
        found = np.array([effect.measure(log.samples) for log in logs])
        weight = 1.0 / np.maximum(found[:, 1], 1e-12) ** 2
        if not weight.any():
            continue
        value, sigma = float(found[:, 0] @ weight / weight.sum()), float(weight.sum() ** -0.5)
        apart = abs(value - max(calibration.effects.get(effect.name, {}).get(amplitude.name, 0.0), 0.0))
        sample_s = max(float(np.median(log.samples["dt"])) for log in logs)
        if apart > max(_FAR * sample_s, _SURELY * sigma) and value < amplitude.high:
            result[f"effects.{effect.name}.{amplitude.name}"] = value
    return result


def _variance(values: Sequence[float]) -> float:
    return float(np.var(values, ddof=1)) if len(values) > 1 else 0.0


def _follows_current(effects: np.void) -> bool:
    """Whether the torque constant follows the current of its own sample, by the effects of PARAMETERS."""
    terms, current = effects["terms"], list(SIGNALS).index("current")
    there = [t for t in terms["term"][: terms["count"]] if t["port"] == PORTS.index("torque_constant")]
    direct = [t for t in there if not t["memory"] and current in (t["signal"], t["other"])]
    return bool(direct) or any(effects[effect][amplitude] for effect, amplitude in _BY_CURRENT)


class Bench:
    """Logs on which a calibration's parameters are tried: runs the estimator and returns residuals, channel by channel."""

    def __init__(
        self,
        logs: Sequence[Log],
        calibration: Calibration,
        mounted: Sequence[Mapping[str, float]] = (),
        own_data: bool = False,
        workers: int = 2,
        load_follows: bool | None = None,
    ):
        """``mounted``: for each log what the calibration says otherwise of it alone (`Trial.mounted`). ``own_data``:
        the calibration was fitted to these logs. Heat is settled then: it must not make up for a force that is off yet.
        ``load_follows``: as the logs say with which these are compared; as they say themselves, if it is not given."""
        self.calibration = calibration
        self.own_data = own_data
        #: Whether heat answers so nearly in proportion that one derivative serves all iterations of a fit.
        self.straight: bool = True
        # Waiting for another thread costs more than most of these tasks.
        self.map: Callable[..., Iterator[Any]] = ThreadPoolExecutor(workers).map if workers > 1 else map
        mounted = mounted or [{}] * len(logs)
        #: By key of the calibration: amplitudes of effects that follow from the signals alone, where far from the
        #: calibration's.
        self.told: dict[str, float] = _told_by_signals(logs, calibration)

        self.trials: list[Trial] = list(self.map(self._trial, range(len(logs)), logs, mounted))
        #: By log, the clearances in rad whose scatter the calibration's sigma holds, and the variance that it holds besides.
        self.clearances: dict[int, float] = {t.index: c for t in self.trials if (c := t.mounted.get(CLEARANCE, 0.0)) > 0.0}
        unsure = calibration.contact.clearance_sigma_rad**2 - _variance([*self.clearances.values()])
        self.clearance_variance: float = max(unsure, 0.0)
        self.has_reference: bool = all(trial.has_force for trial in self.trials)
        self.clamps: bool = calibration.contact.is_in_reach
        self.has_current: bool = any(trial.log.samples["has_current"].any() for trial in self.trials)
        late = [_current_late_s(trial) for trial in self.trials] if self.clamps and self.has_reference else [0.0]
        #: Time by which the current comes after the motion that it causes, s; negative if the motion comes after it, and after
        #: the force. A path whose signals are of two times is not searched: whatever is found there imitates the difference in
        #: time.
        self.current_late_s: float = max(late, key=abs)
        #: Current below which its sensor tells nothing, A: friction that seems to need none there is no cause.
        self.current_dead_A: float = _dead_band_A(logs)
        #: Those that these logs can judge.
        self.channels: list[str] = [channel for channel in self._channels() if channel in FORCE_CHANNELS or not own_data]
        #: Of the motor angles that occur, rad; harmonics are fitted about it.
        self.middle: float = float(np.mean(np.concatenate([trial.log.samples["angle"] for trial in self.trials])))
        #: Whether the load follows the current, and not the current the load: then its error at a given current is judged.
        self.load_follows: bool = self._load_follows() if load_follows is None else load_follows
        #: Whether the load is known to be nothing: then the current itself is all that is explained.
        self.turns_free: bool = self.has_reference and not self.clamps and not np.any(self.load_N)
        if not self.clamps and not self.load_follows:
            for trial in self.trials:
                trial.log = replace(trial.log, samples=denoised(trial.log.samples, self.turns_free))
        #: Converts unexplained current to force: what it would be on the spindle.
        self.newton_per_ampere: float = calibration.motor.torque_constant_Nm_per_A / calibration.motor.gear_gain_m_per_rad

    def _load_follows(self) -> bool:
        return self.has_reference and not self.clamps and _partial_correlation(self.trials) > _FOR_THE_LOAD

    def _trial(self, index: int, log: Log, mounted: Mapping[str, float]) -> Trial:
        return make_trial(log, index, held(to_parameters(moved(self.calibration, {**mounted, **self.told})))[0], mounted)

    @cached_property
    def sample_episode(self) -> np.ndarray:
        """Episode of every sample, counted over all logs."""
        return count_over([trial.episode for trial in self.trials])

    @cached_property
    def episodes(self) -> int:
        """Their number."""
        return int(self.sample_episode[-1]) + 1

    @cached_property
    def turns(self) -> np.ndarray:
        """The same for what follows the angle of the disc (`by_turns`)."""
        return count_over([by_turns(trial.episode, trial.log.time_s, wheel_angle(trial.log.samples)) for trial in self.trials])

    @cached_property
    def episode(self) -> dict[str, np.ndarray]:
        """By channel, the episode number of every residual, shape (N,), counted over all logs."""
        by_sample = self.by_log(self.sample_episode)
        by_temperature = [np.repeat(e[trial.temperature_rows], 9) for trial, e in zip(self.trials, by_sample, strict=True)]
        return {c: np.concatenate(by_temperature) if c == CHANNEL_OF_HEAT else self.sample_episode for c in self.channels}

    @cached_property
    def reach(self) -> dict[str, float]:
        """Of a machine that clamps nothing the most that its effects may be, by unit: a current as large as the largest of
        these logs, all the torque that makes, at any speed or at the largest, and half of the torque constant lost at it: what
        is quadratic in the current holds no further."""
        if self.clamps or not self.has_current:
            return {}
        samples = np.concatenate([trial.log.samples for trial in self.trials])
        current = float(np.abs(samples["current_q"][samples["has_current"]]).max())
        torque = current * self.calibration.motor.torque_constant_Nm_per_A
        speed = float(np.abs(samples["speed"]).max())
        found = {"A": current, "N·m": torque, "N·m·s/rad": torque / max(speed, 1e-9), "1/A²": 0.5 / max(current, 1e-9) ** 2}
        return {unit: found[unit] for unit in OF_THE_MOTOR}

    def means(self, channel: str, samples: int) -> Averaging:
        """Means over so many samples of a channel; of a brake's torque without those in which friction turns over.

        How friction turns over is modelled roughly, and with the motor held just behind a reversal the error lasts as long as
        the hold: on two simulated brakes with nothing hidden it alone explained 23 and 24 N of what lasts, where 8 and 11 N
        are left without these samples. Of what clamps nothing the presliding angle is a guess itself."""
        told = np.concatenate([trial.slides for trial in self.trials]) if self.shows_turning(channel) else None
        return Averaging(self.episode[channel], samples, told)

    def shows_turning(self, channel: str) -> bool:
        """Whether a channel's residual shows how friction turns over, which every model of a brake guesses."""
        return channel in ("torque", "innovation") and self.clamps

    @property
    def sources(self) -> list[str]:
        return [trial.log.path.name for trial in self.trials]

    @property
    def load_N(self) -> np.ndarray:
        """The reference force where it is known, N, shape (n,)."""
        force = np.concatenate([trial.force_N for trial in self.trials])
        return force[np.isfinite(force)]

    def by_log(self, column: np.ndarray) -> list[np.ndarray]:
        """A column over the samples of all logs, cut where each log ends."""
        return [column[rows] for rows in self.rows]

    @cached_property
    def rows(self) -> list[slice]:
        """Of each log among the samples of all."""
        ends = np.cumsum([0] + [len(trial.log.samples) for trial in self.trials])
        return [slice(*pair) for pair in pairwise(ends)]

    def _channels(self) -> list[str]:
        if self.has_reference and (self.clamps or self.has_current):
            channels = ["stiffness"] * self.clamps + ["torque"] * self.has_current
        elif self.has_current and self.clamps:
            channels = ["innovation"]
        else:
            lacking = "neither a clamp force reference nor motor current"
            if not self.clamps:
                lacking = "no motor current" if self.has_reference else "no load reference"
            free = "" if self.clamps or self.has_reference else "; of a motor that turns free, map ClampForceRef to `value: 0`"
            raise InputError(f"{self.trials[0].log.path}: {lacking} to judge by{free}")
        if any(np.isfinite(trial.temperature_C).any() for trial in self.trials):
            channels.append("temperature")
        if any(np.nanmax(np.append(trial.brake_torque_Nm, 0.0)) > _BRAKING_NM for trial in self.trials):
            channels.append("brake_torque")
        return channels

    def channel_of(self, channel: str) -> str | None:
        """Channel in which a change shows that shows in ``channel`` where all is measured; None where these logs have none."""
        if channel in ("stiffness", "torque") and not self.has_reference:
            channel = "innovation"
        sample_s = max(float(np.median(trial.log.samples["dt"])) for trial in self.trials)
        late = {"torque": self.current_late_s != 0.0, "stiffness": self.current_late_s < -_FAR * sample_s}
        return channel if channel in self.channels and not late.get(channel, False) else None

    def disturbed(self, disturb: Callable, random: np.random.Generator) -> "Bench":
        """The same logs with samples disturbed: (SAMPLE rows, episode of each, generator) → rows."""
        result = copy.copy(self)
        result.trials = [
            replace(trial, log=replace(trial.log, samples=disturb(trial.log.samples, trial.episode, random)))
            for trial in self.trials
        ]
        return result

    def under(self, calibration: Calibration) -> "Bench":
        result = copy.copy(self)
        result.calibration = calibration
        return result

    def calibrated(self, values: Values, log: int | None = None) -> Calibration:
        """The calibration with coordinates at ``values``; with ``log`` as they apply to that one, its own pads mounted."""
        base = self.calibration if log is None else self.on(self.trials[log])
        return moved(base, by_key(values, self.middle, log) | self._contact_found(values, log))

    def _contact_found(self, values: Values, log: int | None) -> dict[str, float]:
        """Where the next power-on finds its contact, and how unsure it is of that, where curves were fitted to these logs: by
        the contact of single logs, which scatters less if something else explains that (an uneven disc, which no curve knows),
        and more for drives, whose heat has moved it."""
        found = {c.log: value for c, value in values.items() if c.name == CLEARANCE}
        if not found or not self.own_data:
            return {}
        of_curves = [found.pop(number, known) for number, known in self.clearances.items()]
        middle = float(np.mean(of_curves)) if of_curves else self.calibration.contact.clearance_rad
        of_drives = np.mean((np.array([*found.values()]) - middle) ** 2) if found else 0.0
        variance = self.clearance_variance + _variance(of_curves) + of_drives
        return {CLEARANCE_SIGMA: float(np.sqrt(variance))} | ({CLEARANCE: middle} if log is None else {})

    def on(self, trial: Trial, calibration: Calibration | None = None) -> Calibration:
        """A calibration, the bench's own if none is given, for the pads that a log has."""
        return moved(calibration or self.calibration, trial.mounted)

    def residuals(self, values: Values) -> dict[str, np.ndarray]:
        """Residual by channel over all logs."""
        return self.run(values)[0]

    def run(self, values: Values) -> tuple[dict[str, np.ndarray], list[np.ndarray | None]]:
        """Residual by channel over all logs, and the heat of each log (`held_heat.run_with_heat`)."""

        def one(trial: Trial) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
            parameters = self.parameters_of(trial, values)
            trace, heat = run_with_heat(trial.log.samples, parameters)
            per_ampere = self._per_ampere(trial, parameters, heat)
            return {channel: self.residual_of(trial, trace, channel, per_ampere) for channel in self.channels}, heat

        parts, heat = zip(*self.map(one, self.trials), strict=True)
        return {c: np.concatenate([part[c] for part in parts]) for c in self.channels}, list(heat)

    def parameters_of(self, trial: Trial, values: Values) -> np.void:
        """PARAMETERS of a log with coordinates at ``values``, `held`."""
        return held(to_parameters(self.calibrated(values, trial.index)))[0]

    def _per_ampere(
        self, trial: Trial, parameters: np.void, heat: np.ndarray | None, now: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Torque (N m) of one ampere more at each sample of a run, where the constant itself follows the current: the noise of
        that counts so much there, which least squares would reduce by a wrong exponent. ``now``: the run with the heat held,
        if there was one."""
        if heat is None or not _follows_current(parameters["effects"]):
            return None
        # Numpy would copy the records field by field, which takes ten times as long.
        samples = np.frombuffer(bytearray(trial.log.samples), trial.log.samples.dtype)
        now = run_held(samples, parameters, heat) if now is None else now
        samples["current_q"] += _MORE_A
        more = (run_held(samples, parameters, heat)["torque"] - now["torque"]) / _MORE_A
        return np.clip(more, 0.5 * now["torque_constant"], 2.0 * now["torque_constant"])

    def residual_of(self, trial: Trial, trace: np.ndarray, channel: str, per_ampere: np.ndarray | None = None) -> np.ndarray:
        """One channel's residual of a run (TRACE rows); ``per_ampere``: N m, the torque constant if none is given."""
        if channel == "stiffness":
            return np.nan_to_num(trial.force_N - trace["force"])
        if channel == "temperature":
            temperature = np.where(trace["temperature_known"][:, None], trace["temperature"], np.nan)[trial.temperature_rows]
            return np.nan_to_num(trial.temperature_C - temperature).ravel()
        if channel == "brake_torque":
            return self._brake_torque_left(trial, trace)
        return np.nan_to_num(self.torque_left(trial, trace, per_ampere))

    def torque_left(self, trial: Trial, trace: np.ndarray, per_ampere: np.ndarray | None = None) -> np.ndarray:
        """Motor torque that the clamp force does not explain, as force; without a reference, the force of the other path. NaN
        where nothing can be said."""
        judged = trial.force_N if self.has_reference else trace["force"]
        mean = judged.copy()
        mean[1:] = 0.5 * (judged[1:] + judged[:-1])
        if not self.has_reference:
            mean[0] *= 0.5
        left = trace["torque"] - trace["leverage"] * mean
        if self.load_follows:
            load = left / trace["leverage"]
        else:
            # Per ampere that is really there, so that the noise of the current is no regressor of its own constant.
            load = left / (trace["torque_constant"] if per_ampere is None else per_ampere) * self.newton_per_ampere
        # The current is a mean over the cycle before its sample: over a longer gap it belongs to the end alone.
        told = trial.log.samples["dt"] <= ONE_CYCLE_S
        if self.current_dead_A:
            least_A = self.current_dead_A + _CLEAR * self.calibration.noise.current_A
            told &= np.abs(trial.log.samples["current_q"]) > least_A
        if self.clamps:
            # There the load may have turned friction back by less than the angle shows.
            told &= ~trial.yields
        if self.turns_free:
            # Without a load friction holds a motor that stands, whatever its current below that of friction.
            told &= ~trial.stands
        return np.where(told, load, np.nan)

    def _brake_torque_left(self, trial: Trial, trace: np.ndarray) -> np.ndarray:
        samples = trial.log.samples
        wheel = np.where(samples["has_wheel_speed"], samples["wheel_speed"], 0.0)
        sliding = (wheel > _SLIDING) & (trace["power"] > 0.0) & (trial.brake_torque_Nm > 0.0)
        sliding &= np.nan_to_num(trial.force_N, nan=0.0) > _TOUCHING_N if self.has_reference else True
        left = trial.brake_torque_Nm - trace["power"] / np.maximum(wheel, _SLIDING)
        return np.where(sliding, left, 0.0)

    def regressors(
        self, values: Values, probes: Sequence["Probe"], at: Mapping[str, np.ndarray], heat: Sequence[np.ndarray | None]
    ) -> list[np.ndarray]:
        """How the probed coordinates' own channels answer: minus the derivative of the residual, which is ``at`` by channel.

        Pads and disc stay as warm as they are at ``values`` (``heat``, of each log) while a coordinate of a force path moves:
        what a hundredth of the force does to its own heat is a hundredth of a hundredth of it."""

        def answer(probe: Probe) -> np.ndarray:
            coordinate, tried = probe.coordinate, {**values, **dict(probe.shape)}
            now = tried.get(coordinate, coordinate.start)
            step = coordinate.step if now + coordinate.step <= coordinate.high else -coordinate.step
            tried[coordinate] = now + step
            follows = coordinate.channel not in FORCE_CHANNELS or coordinate.name == HISTORY_TIME
            known = [None] * len(heat) if follows else heat
            if coordinate.log is None:
                return (at[coordinate.channel] - self.residual_held(tried, coordinate.channel, known)) / step
            column, own = np.zeros_like(at[coordinate.channel]), coordinate.log
            rows = self.rows[own]
            here = self._residual_held_of(self.trials[own], tried, coordinate.channel, known[own])
            column[rows] = (at[coordinate.channel][rows] - here) / step
            return column

        return list(self.map(answer, probes))

    def residual_held(self, values: Values, channel: str, heat: Sequence[np.ndarray | None]) -> np.ndarray:
        """One channel's residual, with the heat of a log held where it is given (`held_heat.run_held`)."""
        pairs = zip(self.trials, heat, strict=True)
        return np.concatenate([self._residual_held_of(trial, values, channel, known) for trial, known in pairs])

    def _residual_held_of(self, trial: Trial, values: Values, channel: str, known: np.ndarray | None) -> np.ndarray:
        samples, parameters = trial.log.samples, self.parameters_of(trial, values)
        trace = run_step(samples, parameters) if known is None else run_held(samples, parameters, known)
        per_ampere = self._per_ampere(trial, parameters, known, trace)
        return self.residual_of(trial, trace, channel, per_ampere)


@dataclass(frozen=True)
class Probe:
    """A coordinate to be moved a little, with the shape that its effect has meanwhile."""

    coordinate: Coordinate
    shape: tuple[tuple[Coordinate, float], ...] = ()
