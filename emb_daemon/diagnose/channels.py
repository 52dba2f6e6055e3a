"""Residuals: what the running estimator's paths leave unexplained, and how they answer to its parameters.

Everything comes from the production `estimator.step`, run over the log with parameters moved by a little, so that what a
candidate is credited with is what the daemon will do with it. Only the learning of the contact angle is held here: it
would spread an error of one path over both, and hide slow effects in an angle that wanders.
"""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from emb_daemon.diagnose.episodes import episodes
from emb_daemon.diagnose.knobs import Knob
from emb_daemon.effects import paths as effects
from emb_daemon.estimator.records import ESTIMATE, new_state
from emb_daemon.estimator.step import step
from emb_daemon.jit import njit
from emb_daemon.offline import Log

#: Residuals by channel and their unit. `innovation` stands for the paths' reference where a log has none.
UNITS = {"stiffness": "N", "torque": "N", "innovation": "N", "temperature": "K", "brake_torque": "N·m"}
FORCE_CHANNELS = ("stiffness", "torque", "innovation")
#: Disc speed (rad/s) below which the brake torque sensor shows static friction.
_SLIDING = 1.0
_TOUCHING_N = 300.0


@njit
def _run(samples, p, state, reference_mean, stiffness, torque, power, temperatures, rows, estimate):
    """Run the estimator; ``torque`` gets the current (A) that the torque balance cannot explain."""
    s = state[0]
    next_row = 0
    before = 0.0
    for row in range(len(samples)):
        step(s, p[0], samples[row], estimate[0])
        force = estimate[0].stiffness_force
        stiffness[row] = force
        power[row] = s.power
        mean = reference_mean[row] if len(reference_mean) else 0.5 * (before + force)
        # Per ampere that is really there, so that the noise of the current is no regressor of its own constant.
        m = samples[row]
        constant = p[0].torque_constant * effects.torque_constant(p[0].effects, s.effects, m, s.disc, s.temperature_known, 0.0)
        torque[row] = (s.balance - s.leverage * mean) / constant
        before = force
        while next_row < len(rows) and rows[next_row] == row:
            for side in range(2):
                for depth in range(4):
                    temperatures[next_row, 4 * side + depth] = estimate[0].depth[side, depth]
            temperatures[next_row, 8] = estimate[0].disc
            next_row += 1


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

    @property
    def has_force(self) -> bool:
        return bool(np.isfinite(self.force_N).mean() > 0.1)


def make_trial(log: Log, index: int, stiffness_N: np.ndarray) -> Trial:
    """Prepare a log. ``stiffness_N``: an estimate of the clamp force, to cut episodes where no reference is."""
    reference, time = log.reference, log.time_ns
    force = log.force_N
    torque = np.full(len(time), np.nan)
    if len(reference.time_ns) and np.isfinite(force).any():
        # The instrument's frames are stamped a constant while after the resolver's: shift by it, not by the jitter.
        nearest = np.clip(np.searchsorted(reference.time_ns, time), 1, len(reference.time_ns) - 1)
        before = reference.time_ns[nearest] - time > time - reference.time_ns[nearest - 1]
        nearest = nearest - before
        near = np.abs(reference.time_ns[nearest] - time) < 2_000_000
        offset = np.median((reference.time_ns[nearest] - time)[near]) if near.any() else 0.0
        step_ns = np.median(np.diff(reference.time_ns))
        share = float(np.clip(offset / step_ns, -0.5, 0.5))
        shifted = force.copy()
        if share > 0.0:
            shifted[1:] = (1.0 - share) * force[1:] + share * force[:-1]
        elif share < 0.0:
            shifted[:-1] = (1.0 + share) * force[:-1] - share * force[1:]
        force = shifted
        torque = reference.at(time, reference.brake_torque_Nm)
    at = reference.pads["inner"][0]
    if len(at):
        keep = (at >= time[0]) & (at <= time[-1])
        at_kept = at[keep]
        rows = np.searchsorted(time, at_kept, side="right") - 1
        outer_time, outer = reference.pads["outer"]
        same = np.clip(np.searchsorted(outer_time, at_kept), 0, max(len(outer_time) - 1, 0))
        disc = np.clip(np.searchsorted(reference.time_ns, at_kept), 0, max(len(reference.time_ns) - 1, 0))
        measured = np.full((len(rows), 9), np.nan)
        measured[:, :4] = reference.pads["inner"][1][:, keep].T
        if len(outer_time):
            measured[:, 4:8] = outer[:, same].T
        if len(reference.time_ns):
            measured[:, 8] = reference.disc_C[disc]
        # An instrument that is not there reports a constant.
        measured[:, np.nanstd(measured, axis=0) == 0.0] = np.nan
    else:
        rows, measured = np.zeros(0, np.int64), np.zeros((0, 9))
    judge = force if np.isfinite(force).mean() > 0.1 else stiffness_N
    cut = episodes(log.time_s, np.nan_to_num(judge))
    return Trial(log, index, force, cut, rows, measured, torque)


class Bench:
    """Logs on which parameters are tried: runs the estimator and returns residuals, channel by channel.

    Attributes:
        channels: those that these logs can judge.
        episode: by channel, the episode number of every residual, shape (N,), counted over all logs.
    """

    def __init__(self, logs: Sequence[Log], parameters: np.void, workers: int = 2):
        self.parameters = self._held(parameters)
        self._pool = ThreadPoolExecutor(workers)
        self.trials = []
        for index, log in enumerate(logs):
            blank = Trial(log, index, np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 9)), np.zeros(0))
            stiffness = self._outputs(blank, self.parameters)[0]
            self.trials.append(make_trial(log, index, stiffness))
        self.with_force = [trial.has_force for trial in self.trials]
        reference = all(self.with_force)
        self.has_reference = reference
        self.channels = ["stiffness", "torque"] if reference else ["innovation"]
        if any(np.isfinite(trial.temperature_C).any() for trial in self.trials):
            self.channels.append("temperature")
        if any(np.nanmax(np.abs(np.append(trial.brake_torque_Nm, 0.0)), initial=0.0) > 20.0 for trial in self.trials):
            self.channels.append("brake_torque")
        #: Converts unexplained current to force: what it would be on the spindle.
        self.newton_per_ampere = float(parameters["torque_constant"] / parameters["gear_gain"])
        offsets = np.cumsum([0] + [int(trial.episode[-1]) + 1 for trial in self.trials])
        self.episodes = int(offsets[-1])
        by_sample = [trial.episode + offset for trial, offset in zip(self.trials, offsets, strict=False)]
        by_temperature = [np.repeat(e[trial.temperature_rows], 9) for trial, e in zip(self.trials, by_sample, strict=True)]
        self.sample_episode = np.concatenate(by_sample)
        self.episode = {
            channel: np.concatenate(by_temperature) if channel == "temperature" else self.sample_episode
            for channel in self.channels
        }

    @staticmethod
    def _held(parameters: np.void) -> np.ndarray:
        held = np.atleast_1d(parameters).copy()
        held["clearance_sigma"] = 0.0
        held["contact_walk"] = 0.0
        return held

    def channel_of(self, channel: str) -> str | None:
        """Channel in which a change shows that shows in ``channel`` where all is measured; None where these logs have none."""
        if channel in ("stiffness", "torque") and not self.has_reference:
            channel = "innovation"
        return channel if channel in self.channels else None

    def _outputs(self, trial: Trial, held: np.ndarray):
        samples = trial.log.samples
        count = len(samples)
        stiffness, torque, power = np.zeros(count), np.zeros(count), np.zeros(count)
        temperatures = np.zeros((len(trial.temperature_rows), 9))
        mean = np.zeros(0)
        if len(trial.force_N) and trial.has_force:
            mean = trial.force_N.copy()
            mean[1:] = 0.5 * (trial.force_N[1:] + trial.force_N[:-1])
        rows = trial.temperature_rows
        estimate = np.zeros(1, ESTIMATE)
        _run(samples, held, new_state(), mean, stiffness, torque, power, temperatures, rows, estimate)
        return stiffness, torque, power, temperatures

    def _residual(self, trial: Trial, held: np.ndarray) -> dict[str, np.ndarray]:
        stiffness, torque, power, temperatures = self._outputs(trial, held)
        result = {}
        scale = self.newton_per_ampere
        torque = np.nan_to_num(torque * scale, nan=0.0)
        if self.has_reference:
            result["stiffness"] = np.nan_to_num(trial.force_N - stiffness)
            result["torque"] = torque
        else:
            result["innovation"] = torque
        if "temperature" in self.channels:
            result["temperature"] = np.nan_to_num(trial.temperature_C - temperatures).ravel()
        if "brake_torque" in self.channels:
            wheel = np.where(trial.log.samples["has_wheel_speed"], trial.log.samples["wheel_speed"], 0.0)
            sliding = (wheel > _SLIDING) & (power > 0.0) & (trial.brake_torque_Nm > 0.0)
            sliding &= np.nan_to_num(trial.force_N, nan=0.0) > _TOUCHING_N if self.has_reference else True
            result["brake_torque"] = np.where(sliding, trial.brake_torque_Nm - power / np.maximum(wheel, _SLIDING), 0.0)
        return result

    def disturbed(self, disturb: Callable, random: np.random.Generator) -> "Bench":
        """The same logs with samples disturbed: (SAMPLE rows, episode of each, generator) → rows."""
        result = copy.copy(self)
        result.trials = [
            replace(trial, log=replace(trial.log, samples=disturb(trial.log.samples, trial.episode, random)))
            for trial in self.trials
        ]
        return result

    def moved(self, values: dict[Knob, float], log: int) -> np.ndarray:
        """PARAMETERS, shape (1,), with knobs moved as they apply to a log."""
        held = self.parameters.copy()
        for knob, value in values.items():
            if knob.log is None or knob.log == log:
                knob.apply(held[0], value)
        return held

    def residuals(self, values: dict[Knob, float]) -> dict[str, np.ndarray]:
        """Residual by channel over all logs."""
        parts = list(self._pool.map(lambda t: self._residual(t, self.moved(values, t.index)), self.trials))
        return {channel: np.concatenate([part[channel] for part in parts]) for channel in self.channels}

    def regressors(
        self, values: dict[Knob, float], probes: Sequence["Probe"], at: dict[str, np.ndarray]
    ) -> dict["Probe", np.ndarray]:
        """How the probed knobs' own channels answer: minus the derivative of the residual.

        One run serves a stiffness and a torque knob at once where a reference separates their channels.
        """
        apart = ("stiffness", "torque")
        groups: list[list[Probe]] = [[p] for p in probes if not self.has_reference or p.knob.channel not in apart]
        if self.has_reference:
            pairs = [[p for p in probes if p.knob.channel == channel] for channel in apart]
            groups += [[p for p in pair if p is not None] for pair in zip_longest(*pairs)]

        def answer(group: list[Probe]) -> list[np.ndarray]:
            tried = dict(values)
            steps = []
            for probe in group:
                tried.update(probe.shapes)
                now = values.get(probe.knob, 0.0)
                steps.append(probe.knob.step if now + probe.knob.step <= probe.knob.high else -probe.knob.step)
                tried[probe.knob] = now + steps[-1]
            parts = [self._residual(trial, self.moved(tried, trial.index)) for trial in self.trials]
            columns = []
            for probe, step_size in zip(group, steps, strict=True):
                channel = probe.knob.channel
                moved = np.concatenate([part[channel] for part in parts])
                columns.append((at[channel] - moved) / step_size)
            return columns

        result = {}
        for group, columns in zip(groups, self._pool.map(answer, groups), strict=True):
            result.update(zip(group, columns, strict=True))
        return result


@dataclass(frozen=True)
class Probe:
    """A knob to turn a little, with the shape that its effect has meanwhile."""

    knob: Knob
    shapes: tuple[tuple[Knob, float], ...] = ()
