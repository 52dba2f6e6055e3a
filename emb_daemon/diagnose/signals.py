"""Signals that a residual may depend on, and smooth functions of them: what is left is judged without a model."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from emb_daemon.calibration.terms import Term, fill_terms
from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose.held_heat import follow_signals, run_with_heat
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT, Bench
from emb_daemon.effects.base import HOOKS
from emb_daemon.effects.terms import CLAMPED_N, PARAMETERS, recall
from emb_daemon.models.wheel import wheel_angle
from emb_daemon.offline.run import estimate, held
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S

#: Knots of a smooth function of one signal.
_KNOTS = 7
#: Share of the samples outside of a term's range that is said, and least distance from it, in widths of the range: noise about
#: its end is none, and so far away a twentieth of the term is unsure (`effects.terms`).
_OFTEN, _FAR = 0.05, 0.05

#: What tells whether something follows a signal: a manoeuvre in which that moves and what resembles it does not, in words for
#: any machine where one without a brake has the signal.
MANOEUVRES = {
    "motor_angle": "slow strokes through the same angles at other forces (of a brake: on pads of another thickness)",
    "travel": "slow strokes to several forces, on pads of another thickness too",
    "motor_speed": "strokes at several constant speeds",
    "motor_acceleration": "strokes without load at several accelerations",
    "clamp_force": "holds at several forces, each reached from below and from above",
    "force_rate": "strokes to one force at several speeds",
    "current": "holds at several forces with a cold motor, each reached from below and from above",
    "winding_heat": "a minute's hold at a large force at standstill, then small strokes",
    "housing_heat": "ten minutes of holds at a large force at standstill, then small strokes",
    "surface_temperature": "short hard stops with long pauses: only the surface is hot",
    "pad_temperature": "clamps at intervals at standstill while warm pads cool",
    "disc_temperature": "a long drag, then clamps at intervals while the disc cools",
    "caliper_temperature": "clamps after an hour in a warm and in a cold place",
    "disc_speed": "short stops of one force from several disc speeds, cold",
    "disc_angle": "drags at several constant disc speeds",
    "brake_torque": "the same forces on a turning and on a standing disc, cold",
    "friction_power": "stops of one brake torque from several disc speeds, cold",
    "energy": "the same strokes before and after many stops, cold both times",
    "time_clamped": "holds of several lengths at one force, at standstill",
    "time_since_last_clamp": "equal clamps after pauses of several lengths, at standstill",
}
#: What only a brake has.
OF_A_BRAKE = (
    "travel", "surface_temperature", "pad_temperature", "disc_temperature", "disc_speed", "disc_angle", "brake_torque",
    "friction_power", "energy", "time_clamped", "time_since_last_clamp",
)  # fmt: skip


def signals(bench: Bench) -> dict[str, np.ndarray]:
    """Measured and estimated signals at every sample of all logs, under the names of the report; those of a brake are nothing
    where nothing is clamped."""
    columns: dict[str, list[np.ndarray]] = {}
    for trial in bench.trials:
        samples = trial.log.samples
        estimates = estimate(samples, held(to_parameters(bench.on(trial))))
        # The estimate, not the reference: the reference's noise is part of the residual.
        force = estimates["stiffness_force"]
        wheel = np.where(samples["has_wheel_speed"], np.nan_to_num(samples["wheel_speed"]), 0.0)
        torque = np.nan_to_num(trial.brake_torque_Nm)
        time = trial.log.time_s
        applied = force > CLAMPED_N
        power = np.maximum(torque, 0.0) * wheel
        dt = samples["dt"]
        here = {
            "brake_torque": torque,
            "disc_speed": wheel,
            "disc_angle": np.mod(wheel_angle(samples), 2.0 * np.pi),
            # As terms take it: logs that begin elsewhere pass the same teeth.
            "motor_angle": samples["angle"],
            "motor_speed": samples["speed"],
            "motor_acceleration": _around(samples["speed"], np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])) / (6.0 * CYCLE_S),
            "current": _around(np.nan_to_num(samples["current_q"]), np.full(6, 0.5)),
            "clamp_force": force,
            "pad_temperature": np.nan_to_num(estimates["mean"].mean(axis=1), nan=20.0),
            "surface_temperature": np.nan_to_num(estimates["surface"].mean(axis=1), nan=20.0),
            "friction_power": power,
            "disc_temperature": np.nan_to_num(estimates["disc"], nan=20.0),
            "caliper_temperature": np.where(samples["has_thermocouple"], np.nan_to_num(samples["caliper"]), 20.0),
            "time_clamped": _time_since(time, applied),
            "time_since_last_clamp": _time_since(time, ~applied),
            "energy": np.cumsum(power * dt),
        }
        for name, column in here.items():
            there = bench.clamps or name not in OF_A_BRAKE
            columns.setdefault(name, []).append(column if there else np.zeros(len(time)))
    return {name: np.concatenate(parts) for name, parts in columns.items()}


def remembered(bench: Bench, term: Term) -> np.ndarray:
    """What a term remembers at every sample of all logs: z of a lag, a peak or a deficit, the output of a response."""
    parameters = np.zeros(1, PARAMETERS)[0]
    fill_terms(parameters, (term,))
    largest, parts = bench.calibration.stiffness.maximum_force_N, []
    for trial in bench.trials:
        samples, on = trial.log.samples, held(to_parameters(bench.on(trial)))[0]
        signals = follow_signals(samples, on, run_with_heat(samples, on)[1])
        parts.append(recall(parameters["term"][0], signals, trial.dt, largest))
    return np.concatenate(parts)


class Outside(NamedTuple):
    """A signal that leaves the range in which a term was ``found`` (None: no low end), and what it reaches, in its unit. The
    same of what the term remembers of it: ``memory``, in the signal's unit, of a response in shares of the term's size."""

    term: str
    signal: str
    share: float
    found: tuple[float | None, float]
    reached: tuple[float, float]
    memory: str = "none"


def outside_range(bench: Bench, terms: Iterable[Term]) -> list[Outside]:
    """Where the logs of the bench leave the terms' ranges by more than noise, in many samples in which these matter."""
    terms = tuple(terms)
    there, result = signals(bench) if terms else {}, []
    for term in terms:
        always = HOOKS[term.port].channel == CHANNEL_OF_HEAT or not bench.clamps
        ranges = [(term.signal, term.low, term.high, "none", there.get(term.signal, np.zeros(0)))]
        if term.other:
            low = -np.inf if term.other_from else -term.other_high
            ranges.append((term.other, low, term.other_high, "none", there.get(term.other, np.zeros(0))))
        if term.memory_low is not None and term.memory_high is not None:
            ranges.append((term.signal, term.memory_low, term.memory_high, term.memory, remembered(bench, term)))
        for name, low, high, memory, signal in ranges:
            signal = signal if always or not len(signal) else signal[there["clamp_force"] > CLAMPED_N]
            far = _FAR * (high - (low if np.isfinite(low) else term.other_from))
            share = float(np.mean((signal < low - far) | (signal > high + far))) if len(signal) else 0.0
            if share > _OFTEN:
                found = low if np.isfinite(low) else None, high
                result.append(Outside(term.name, name, share, found, (float(signal.min()), float(signal.max())), memory))
    return result


def _around(signal: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted thirds of the neighbours two to four samples away, three on each side: without the sample's own noise."""
    padded = np.pad(signal, 4, mode="edge")
    count = len(signal)
    offsets = (-4, -3, -2, 2, 3, 4)
    return sum(w * padded[4 + o : 4 + o + count] for w, o in zip(weights, offsets, strict=True)) / 3.0


def _time_since(time: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Seconds for which ``active`` has held, 0 where it does not."""
    begins = np.flatnonzero(active & ~np.concatenate([[False], active[:-1]]))
    if not len(begins):
        return np.zeros(len(time))
    last = begins[np.maximum(np.searchsorted(begins, np.arange(len(time)), side="right") - 1, 0)]
    return np.where(active, time - time[last], 0.0)


def smooth_basis(name: str, signal: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Columns that span smooth functions of a signal, alone and in proportion to the force; none for a constant one."""
    if np.ptp(signal) <= 1e-9 * max(np.abs(signal).max(), 1.0):
        return np.zeros((len(signal), 0))
    if name == "disc_angle":
        shape = np.column_stack([part(order * signal) for order in (1, 2, 3) for part in (np.cos, np.sin)])
    else:
        knots = np.unique(np.quantile(signal, np.linspace(0.0, 1.0, _KNOTS)))
        wide = np.linspace(signal.min(), signal.max(), 4)
        knots = np.unique(np.concatenate([knots, wide]))
        # Knots that nearly coincide would leave a column to a handful of samples.
        apart = np.concatenate([[True], np.diff(knots) > 0.02 * (knots[-1] - knots[0])])
        knots = knots[apart]
        shape = np.column_stack([np.interp(signal, knots, row) for row in np.eye(len(knots))[1:]])
    scale = rmse(force)
    return np.column_stack([shape, shape * (force / scale)[:, None]]) if scale > 0.0 else shape
