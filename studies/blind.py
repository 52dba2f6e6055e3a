"""Blind test of diagnose on simulated brakes whose effects a seed has drawn.

    python -m studies.blind --null 200 --single 5 --pairs 40 --foreign 10 --output blind.jsonl

Trials are appended to the file one by one. Started again with the same file, the command continues, and prints the table of
all trials.

Each trial draws a unit that scatters about the calibration as units do, gives it no effect, one, two, three, one that the
calibration has with another size, or one that the catalogue does not know, drives a campaign with it, and gives log and
calibration to `diagnose` without telling it. Sizes are drawn as the RMS error (N) that the effect makes on its own path, so
that power can be stated per size. The plant shares no code with the estimator (see emb_daemon/plant).
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import Calibration
from emb_daemon.diagnose import search
from emb_daemon.diagnose.diagnosis import Diagnosis, diagnose
from emb_daemon.diagnose.model import LASTING, Model, rms_known
from emb_daemon.diagnose.residuals import FORCE_CHANNELS, Bench
from emb_daemon.diagnose.screening import Candidate
from emb_daemon.effects import REGISTRY
from emb_daemon.offline.log import log_of
from emb_daemon.offline.score import rmse
from emb_daemon.plant.brake import ONSET, POWER, SATURATION, SIGNALS, drawn_amount
from emb_daemon.plant.car import COUNTER_RAD
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.records import PLANT, PLANT_STATE
from emb_daemon.plant.scenarios import Schedule, random_angle, rest, simulate_log
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_S
from studies.drives import rig_drag, rig_stop, training
from studies.unlisted import WHOLE

#: Effects with ranges from which they can be drawn.
DRAWN = {effect.name: effect for effect in REGISTRY if all(parameter.drawn for parameter in effect.parameters)}
#: Effects outside the catalogue, with a relevant size, and the equivalent terms: port and signal.
_FOREIGN = {
    "clamp_creep": {"share": 0.06, "time_constant_s": 30.0},
    "brake_torque_coupling": {"per_Nm": 6e-5},
    "spindle_lead_error": {"amplitude_um": 15.0, "order_per_turn": 0.4, "phase_rad": 1.0},
    "drawn_pad_friction": {"size": -0.35, "signal": 9.0, "shape": SATURATION, "other": -1.0},
}
#: A later one, whose state no signal has: its seeds follow a range of their own.
_REMEMBERING = "fastest_closing"
_SAME = {
    "clamp_creep": {"term:force:clamp_force", "third_relaxation"},
    "brake_torque_coupling": {"term:stiffness:brake_torque"},
    "spindle_lead_error": {"term:motor_angle:motor_angle"},
    "drawn_pad_friction": {"term:pad_friction:friction_power"},
    _REMEMBERING: {"term:stiffness:motor_speed"},
}
#: Signals of the family from which a seed draws effects, by port; the exponent is between these, every third has a second
#: signal that multiplies, every third a lag (s) between these.
_FAMILY = {
    "stiffness": ("brake_torque", "surface_temperature", "disc_temperature", "disc_speed", "friction_power"),
    "thickness": ("brake_torque", "surface_temperature", "pad_temperature", "disc_speed"),
    "torque_constant": ("current",),
    "gear_friction": ("motor_speed", "clamp_force", "brake_torque", "disc_speed"),
    "gear_gain": ("clamp_force", "brake_torque", "disc_temperature"),
}
_EXPONENTS, _LAGS_S = (0.4, 2.6), (1.0, 20.0)
#: The same of the heat balance, whose lags are its own, and sizes (K RMS of the temperatures).
_HEAT_FAMILY = {
    "disc_cooling": ("disc_speed", "disc_temperature"),
    "contact_conductance": ("clamp_force", "surface_temperature", "disc_speed"),
    "gap_conductance": ("disc_speed", "disc_temperature"),
    "pad_conductivity": ("clamp_force", "pad_temperature"),
    "heat_share": ("disc_speed", "surface_temperature", "friction_power", "clamp_force"),
    "disc_heat": ("disc_speed",),
}
SIZES_K = (8.0, 16.0)
#: ... but at the signals' usual sizes at most so much: twice a factor, half as much again of a material's, and what pads that
#: drag make (W).
_MOST = {"drawn_pad_conductivity": 0.5, "drawn_disc_heat": 600.0}
#: Share of a path's whole force (`WHOLE`) that a drawn effect may change at any time of a drive. Beyond half of it pads are of
#: twice the stiffness or none, a gear jams or runs back by itself, a motor has lost its magnets: no such brake leaves a works.
_BEARABLE = 0.5
#: What drawn effects follow, as the plant's truth and its state name it.
_FOLLOWED = "brake_torque", "disc", "surface", "force", "speed", "current", "wheel_speed"
#: Draws until one is physical, and factor within which it must then make the size asked.
_DRAWS, _NEARLY = 100, 1.5
#: Stops of a campaign for what no catalogue holds: as many as a rig's six minutes have; others have ten.
_STOPS = {"foreign": 25, "drawn": 25}
#: Sizes (N RMS on the effect's own path) of the power curve.
SIZES_N = (75.0, 150.0, 300.0, 600.0)
#: Size of the brake's effects over that in the calibration, in trials with changed effects.
_CHANGES = (1.0 / 3.0, 3.0)


#: Residual that lasts over that of the same unit with nothing hidden: from here something is clearly left (half as much again,
#: as `diagnose` has it), up to here nothing; between them either answer is right.
_LEFT, _NOTHING = 1.5, 1.2


@dataclass(frozen=True)
class Rest:
    """What is left of one path on the validation log, as RMS (N) of means over `LASTING` samples."""

    after: float  #: with the calibration that `diagnose` wrote
    #: ``plain`` and ``fitted``: of the same unit and schedule with nothing hidden, by the calibration as it was, and fitted to
    #: that very log: what it achieves on such units, and what it could.
    plain: float
    fitted: float
    said: bool  #: whether the report says that something is unexplained there

    @property
    def anything(self) -> bool | None:
        """Whether something is left; None where that is undecidable."""
        if self.after <= _NOTHING * self.fitted:
            return False
        return True if self.after >= _LEFT * max(self.plain, self.fitted) else None


@dataclass(frozen=True)
class Trial:
    """What was hidden and what was found.

    Attributes:
        hidden: effects of the plant with their parameters, in addition to those of the calibration.
        size: RMS that each makes on its own path, N.
        found: effects accepted, with their parameters.
        changed: effects of the calibration that are not as calibrated.
        before, after: RMSE of the fused force on the validation log, N.
        unexplained: signal on which an unexplained residual depends, or None. contribution_error: of what the found effects do
        on their paths against what the hidden ones do, RMS over RMS; None where not exactly those were found. seconds: of CPU,
        for diagnose alone. left: by path; none in files of earlier versions. kelvin: RMS of the temperatures' residual on the
        validation log, before and after. alike: by finding, what the report names as equally likely or confounded with it, by
        name.
    """

    seed: int
    kind: str
    hidden: dict[str, dict[str, float]]
    size: float
    found: dict[str, dict[str, float]]
    before: float
    after: float
    unexplained: str | None
    contribution_error: float | None = None
    seconds: float = 0.0
    left: dict[str, Rest] = field(default_factory=dict)
    changed: tuple[str, ...] = ()
    kelvin: tuple[float, float] | None = None
    alike: dict[str, list[str]] = field(default_factory=dict)

    @property
    def false_findings(self) -> set[str]:
        true = set(self.hidden).union(*(_SAME.get(name, ()) for name in self.hidden))
        return {name for name in self.found if _without_number(name) not in true and not self._is_drawn(name)}

    def _is_drawn(self, found: str) -> bool:
        """Whether a term says what a drawn effect is: its port over one of its signals, or both."""
        if self.kind not in ("drawn", "heat") or not found.startswith("term:"):
            return False
        [(name, values)] = self.hidden.items()
        _, port, *signals = _without_number(found).split(":")
        true = {SIGNALS[int(values[key])] for key in ("signal", "other") if values[key] >= 0.0}
        return name == f"drawn_{port}" and set(signals) <= true

    @property
    def named(self) -> bool:
        """Whether exactly what was hidden was found; for a foreign effect, a term of the right signal at the right port."""
        return self._is_named(lambda found: [found])

    @property
    def named_among_equals(self) -> bool:
        """The same where a finding also counts by what the report names as equally likely, or as confounded with it."""
        return self._is_named(lambda found: [found, *self.alike.get(found, ())])

    def _is_named(self, told: Callable[[str], list[str]]) -> bool:
        if self.kind == "changed":
            return not self.found and set(self.changed) == set(self.hidden)
        if self.kind in ("drawn", "heat"):
            return bool(self.found) and all(any(map(self._is_drawn, told(name))) for name in self.found)
        if self.kind == "foreign":
            return len(self.found) == 1 and not _SAME[next(iter(self.hidden))].isdisjoint(told(next(iter(self.found))))
        return any(sorted(names) == sorted(self.hidden) for names in product(*map(told, self.found)))


def _without_number(term: str) -> str:
    """A term's name without the number that distinguishes several of the same kind."""
    name, _, number = term.rpartition(":")
    return name if number.isdigit() else term


def campaign(plant: np.void, rng: np.random.Generator, stops: int) -> Schedule:
    """Training, random angle, stops, a drag, random angle again: two minutes with ten stops, longer with more."""
    longer = max(stops / 10.0, 1.0)
    schedule = training(plant, 21.0 * longer) + random_angle(plant, 10.0 * longer, rng)
    for _ in range(stops):
        force = float(np.exp(rng.uniform(np.log(2000.0), np.log(22000.0))))
        schedule += rig_stop(force, rng.uniform(20.0, 60.0), rng.uniform(2.5, 4.0), rng.uniform(6.0, 8.0))
    schedule += rig_drag(rng.uniform(2500.0, 5000.0), rng.uniform(20.0, 40.0), 20.0 * longer)
    return schedule + random_angle(plant, 10.0 * longer, rng) + rest(0.5)


def heat_campaign(plant: np.void, rng: np.random.Generator, drags: int = 4) -> Schedule:
    """Training, then drags, each with stops and a turning disc that cools: six minutes with four drags."""
    schedule = training(plant, 21.0)
    for _ in range(drags):
        schedule += rig_drag(rng.uniform(1500.0, 5000.0), rng.uniform(15.0, 45.0), 30.0)
        schedule += rest(rng.uniform(20.0, 50.0), wheel_speed=rng.uniform(0.0, 50.0))
        for _ in range(3):
            schedule += rig_stop(rng.uniform(3000.0, 15000.0), rng.uniform(20.0, 60.0), 3.0, 7.0)
    return schedule + rest(10.0)


def draw(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of an effect at its physically expected size."""
    effect, values = DRAWN[name], {}
    for parameter in effect.parameters:
        low, high = parameter.drawn
        if parameter.starts:
            value = float(np.exp(rng.uniform(np.log(low), np.log(high))))
            values[parameter.name] = float(round(value)) if effect.harmonic and effect.harmonic.whole else value
        elif low == high:
            values[parameter.name] = low
        else:
            sign = 1.0 if low >= 0.0 else rng.choice([-1.0, 1.0])
            values[parameter.name] = float(parameter.prior * sign * rng.uniform(0.5, 1.5))
    return values


def scaled(name: str, values: dict[str, float], factor: float) -> dict[str, float]:
    """The same effect, ``factor`` times as strong, inside its ranges."""
    amplitudes = {p.name: float(np.clip(values[p.name] * factor, *p.drawn)) for p in DRAWN[name].amplitudes}
    return values | amplitudes


def draw_foreign(rng: np.random.Generator, family: Mapping[str, tuple[str, ...]] = _FAMILY) -> dict[str, dict[str, float]]:
    """An effect of a drawn port, signal or two, shape, exponent and lag, of size one."""
    port = list(family)[rng.integers(len(family))]
    signal = rng.choice(family[port])
    other = rng.choice(family[port]) if rng.uniform() < 1.0 / 3.0 else None
    lag = float(np.exp(rng.uniform(*np.log(_LAGS_S)))) if rng.uniform() < 1.0 / 3.0 and family is _FAMILY else 0.0
    values = {"size": 1.0, "signal": float(SIGNALS.index(signal)), "exponent": float(rng.uniform(*_EXPONENTS))}
    values |= {"shape": float(rng.choice([POWER, POWER, SATURATION, ONSET]))}
    values |= {"other": float(SIGNALS.index(other)) if other else -1.0, "lag_s": lag}
    return {f"drawn_{port}": values}


def draw_remembering(rng: np.random.Generator) -> dict[str, float]:
    """How pads become stiffer, or softer, by the fastest closing, of some hundred newtons."""
    share = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.04))
    recovery_s = float(np.exp(rng.uniform(*np.log((5.0, 300.0)))))
    return {"share": share, "exponent": float(rng.uniform(0.6, 2.0)), "recovery_s": recovery_s}


def draw_sized(
    base: np.void,
    schedule: Schedule,
    start: Calibration,
    rng: np.random.Generator,
    size: float,
    seed: int,
    family: Mapping[str, tuple[str, ...]] = _FAMILY,
) -> dict[str, dict[str, float]]:
    """The first drawn effect that makes ``size`` (N or K RMS) and is still physical."""
    for _ in range(_DRAWS):
        effect = sized(base, schedule, start, draw_foreign(rng, family), size, seed)
        if effect:
            return effect
    raise RuntimeError(f"no effect of {size:g} N or K RMS in {_DRAWS} draws is physical")


def _sizing_bench(frames: np.ndarray, start: Calibration) -> Bench:
    """Logs on which sizes are measured: by all samples, so that a seed draws the same brake whichever samples the diagnosis
    judges."""
    bench = Bench([log_of(frames)], start)
    for trial in bench.trials:
        trial.yields[:] = False
    return bench


def sized(base: np.void, schedule: Schedule, start: Calibration, hidden: dict, size: float, seed: int) -> dict | None:
    """A drawn effect scaled until it adds ``size`` (N or K RMS), in quadrature, to its path's residual; none where that takes
    more than its port may bear, or no scale leads there."""
    [(name, values)] = hidden.items()
    channel = "stiffness" if name in ("drawn_stiffness", "drawn_thickness") else "torque"
    if name.removeprefix("drawn_") in _HEAT_FAMILY:
        channel = "temperature"

    def simulated(tried: float) -> tuple[float, np.ndarray]:
        plant = base.copy()
        _put(plant, {name: values | {"size": tried}})
        # With the wheel's counter anywhere in its range, as when seeds were first drawn.
        frames, truth = simulate_log(plant, schedule, seed=seed, wheels_rad=COUNTER_RAD)
        return rmse(_sizing_bench(frames, start).residuals({})[channel]), truth[:, 0]

    floor, _ = simulated(0.0)
    tried = {"drawn_thickness": 10.0, "drawn_disc_heat": 100.0}.get(name, 0.05)
    for _ in range(3):
        added = np.sqrt(max(simulated(tried)[0] ** 2 - floor**2, 1e-3 * size**2))
        tried *= float(np.clip(size / added, 0.1, 10.0))
        if channel == "temperature":
            tried = min(tried, _MOST.get(name, 1.0))
    effect = {name: values | {"size": tried}}
    if channel == "temperature":
        return effect
    reached, truth = simulated(tried)
    made = np.sqrt(max(reached**2 - floor**2, 0.0)) / size
    most = float(np.abs(amounts(effect, truth)).max())
    physical = most <= _BEARABLE * WHOLE[name.removeprefix("drawn_")]
    return effect if physical and 1.0 / _NEARLY <= made <= _NEARLY else None


def amounts(effect: Mapping[str, Mapping[str, float]], truth: np.ndarray) -> np.ndarray:
    """What a drawn effect adds at its port along a drive of one corner, TRUTH (N,), in the port's unit."""
    [name] = effect
    plant = np.zeros(1, PLANT)[0]
    _put(plant, effect)
    state, result = np.zeros(1, PLANT_STATE)[0], np.empty(len(truth))
    lagged = state["drawn"][name.removeprefix("drawn_")]
    for index, row in enumerate(truth):
        for key in _FOLLOWED:
            state[key] = row[key]
        state["pad_mean"] = row["mean"].mean()
        result[index] = drawn_amount(plant["effects"][name], state, lagged, CYCLE_S)
    return result


def contribution(bench: Bench, name: str, values: dict[str, float]) -> np.ndarray:
    """What an effect does on its own path, N, by the estimator's own term."""
    channel = bench.channel_of(DRAWN[name].channel)
    with_it = moved(bench.calibration, {f"effects.{name}.{key}": value for key, value in values.items()})
    return bench.under(with_it).residuals({})[channel] - bench.residuals({})[channel]


def _put(plant: np.void, effects: Mapping[str, Mapping[str, float]]) -> None:
    """Give a PLANT record effects with their parameters."""
    for name, values in effects.items():
        for key, value in values.items():
            plant["effects"][name][key] = value


def _draw_hidden(
    base: np.void,
    schedule: Schedule,
    start: Calibration,
    rng: np.random.Generator,
    seed: int,
    kind: str,
    names: tuple[str, ...],
    size: float,
) -> dict[str, dict[str, float]]:
    """What a trial hides (`run_trial`), of ``size`` each."""
    if kind in ("drawn", "heat"):
        family = _FAMILY if kind == "drawn" else _HEAT_FAMILY
        return draw_sized(base, schedule, start, np.random.default_rng(seed), size, seed, family)
    if names == (_REMEMBERING,):
        return {_REMEMBERING: draw_remembering(np.random.default_rng(seed))}
    if kind == "foreign":
        return {names[0]: dict(_FOREIGN[names[0]])}
    hidden: dict[str, dict[str, float]] = {}
    if names:
        # With the wheel's counter anywhere in its range, as when seeds were first drawn.
        frames, _ = simulate_log(base, schedule, seed=seed, wheels_rad=COUNTER_RAD)
        bench = _sizing_bench(frames, start)
        for name in names:
            values = draw(name, rng)
            # Twice, because the effect is not quite linear in its size.
            for _ in range(2):
                values = scaled(name, values, size / max(rmse(contribution(bench, name, values)), 1e-9))
            hidden[name] = values
    return hidden


def run_trial(calibration: Calibration, seed: int, kind: str, names: tuple[str, ...] = (), size: float = 0.0, stops: int = 10):
    """One blind trial; ``kind`` is null, single, pair, triple, changed, foreign, drawn or heat, ``names`` the effects to hide
    at ``size`` N (K of heat) each; of a changed effect the size by which the calibration is wrong."""
    rng = np.random.default_rng(seed)
    removed = [name for name in names if name in calibration.effects]
    kept = {name: values for name, values in calibration.effects.items() if name not in removed}
    start = msgspec.structs.replace(calibration, effects=kept) if removed else calibration
    base = plant_from_calibration(calibration, seed=seed)
    for name in removed:
        base["effects"][name] = 0.0
    draw_campaign = heat_campaign if kind == "heat" else partial(campaign, stops=stops)
    schedule = draw_campaign(base, rng)
    hidden = _draw_hidden(base, schedule, start, rng, seed, kind, names, size)
    if kind == "changed":
        [(name, off)] = hidden.items()
        factor = rng.choice(_CHANGES)
        was = scaled(name, off, 1.0 / abs(factor - 1.0))
        hidden[name] = scaled(name, was, factor)
        start = moved(start, {f"effects.{name}.{key}": value for key, value in was.items()})
        _put(base, {name: was})
    plant = base.copy()
    _put(plant, hidden)
    fit_log = log_of(simulate_log(plant, schedule, seed=seed + 1)[0])
    judging = draw_campaign(plant, rng)
    val_log = log_of(simulate_log(plant, judging, seed=seed + 2)[0])
    begin = time.process_time()
    result = diagnose([fit_log], start, [val_log])
    seconds = time.process_time() - begin
    new = [f for f in result.accepted if not f.in_calibration]
    found = {f.effect.name: {key: float(value) for key, value in f.values.items()} for f in new}
    return Trial(
        seed,
        kind,
        hidden,
        size,
        found,
        result.before.rmse("fused"),
        result.after.rmse("fused"),
        result.unexplained.strongest.signal if result.unexplained and result.unexplained.strongest else None,
        _contribution_error(Bench([val_log], start), kind, hidden, found),
        seconds,
        what_is_left(result, base, judging, seed + 2),
        tuple(f.effect.name for f in result.accepted if f.in_calibration),
        result.judged_residual.get("temperature"),
        {f.effect.name: equals for f in new if (equals := _equals(f))},
    )


def _equals(finding: Candidate) -> list[str]:
    """What the report says may be there instead of a finding, by name."""
    if finding.made:
        return [":".join(["term", port, *signals]) for port, signals in finding.alike]
    return [finding.confounded_with] if finding.confounded_with else []


def _contribution_error(bench: Bench, kind: str, hidden: dict, found: dict) -> float | None:
    """`Trial.contribution_error`, on the log of ``bench``."""
    if kind not in ("single", "pair", "triple") or set(found) != set(hidden):
        return None
    true = {name: contribution(bench, name, values) for name, values in hidden.items()}
    return max(rmse(contribution(bench, name, found[name]) - true[name]) / rmse(true[name]) for name in hidden)


def what_is_left(result: Diagnosis, plant: np.void, schedule: Schedule, seed: int) -> dict[str, Rest]:
    """Remaining error by path, compared with the log that the unit leaves with nothing hidden, its ``plant``."""
    plain = Model.of(Bench([log_of(simulate_log(plant, schedule, seed=seed)[0])], result.bench.calibration))
    fitted = plain.refined(FORCE_CHANNELS)
    judges = result.judges.under(result.calibration)
    all_three = (judges, judges.residuals({})), (plain.bench, plain.residual), (fitted.bench, fitted.residual)
    return {
        path: Rest(*(_lasting(bench, residual, path) for bench, residual in all_three), result.left[path].present)
        for path in ("stiffness", "torque")
    }


def _lasting(bench: Bench, residual: Mapping[str, np.ndarray], path: str) -> float:
    return rms_known(residual[path], bench.means(path, LASTING[path]))


def parameter_error(trial: Trial) -> float:
    """Largest relative error of the amplitudes that were hidden, against the effect's largest amplitude; NaN if not found.

    A ripple's cosine and sine count as one amplitude: over a motor angle that starts anywhere, phase means nothing."""
    worst = np.nan
    for name, values in trial.hidden.items():
        if name not in trial.found:
            return float("nan")
        keys = [p.name for p in DRAWN[name].amplitudes]
        true, found = (_amplitudes({key: v.get(key, 0.0) for key in keys}) for v in (values, trial.found[name]))
        error = max(abs(found[key] - true[key]) for key in true) / max(abs(value) for value in true.values())
        worst = float(np.nanmax([worst, error]))
    return worst


def _amplitudes(values: dict[str, float]) -> dict[str, float]:
    """Values with cosine and sine of one order as one amplitude."""
    pairs = {key: key.replace("cosine", "sine") for key in values if "cosine" in key}
    result = {key: value for key, value in values.items() if "cosine" not in key and key not in pairs.values()}
    return result | {key: float(np.hypot(values[key], values[sine])) for key, sine in pairs.items()}


def plan(
    null: int, single: int, pairs: int, foreign: int, drawn: int = 0, triples: int = 0, changed: int = 0, heat: int = 0
) -> list[tuple[int, str, tuple[str, ...], float]]:
    """Trials (seed, kind, effects, size); ``single`` counts per effect and size. Larger counts begin with the same trials."""
    rng = np.random.default_rng(2009)
    names = list(DRAWN)
    trials: list[tuple[int, str, tuple[str, ...], float]] = [(1000 + k, "null", (), 0.0) for k in range(null)]
    cells = [((name,), size) for name in names for size in SIZES_N]
    trials += [(20000 + 10 * k, "single", *cell) for k, cell in enumerate(cells * single)]
    for k in range(pairs):
        first, second = rng.choice(len(names), 2, replace=False)
        trials.append((40000 + 10 * k, "pair", (names[first], names[second]), float(rng.uniform(150.0, 500.0))))
    rng = np.random.default_rng(2010)
    for k in range(triples):
        three = tuple(names[which] for which in rng.choice(len(names), 3, replace=False))
        trials.append((45000 + 10 * k, "triple", three, float(rng.uniform(150.0, 500.0))))
    order = np.random.default_rng(2011).permutation(len(names))
    for k in range(changed):
        trials.append((70000 + 10 * k, "changed", (names[order[k % len(names)]],), SIZES_N[1 + k % 3]))
    trials += [(60000 + 10 * k, "drawn", (), SIZES_N[1 + k % 3]) for k in range(drawn)]
    trials += [(80000 + 10 * k, "heat", (), SIZES_K[k % 2]) for k in range(heat)]
    strangers = [name for _ in range(foreign) for name in _FOREIGN]
    trials += [(50000 + 10 * k, "foreign", (name,), 0.0) for k, name in enumerate(strangers)]
    return trials + [(55000 + 10 * k, "foreign", (_REMEMBERING,), 0.0) for k in range(foreign)]


def summary(trials: list[Trial]) -> str:
    """The score as Markdown: one line for each kind, and the power curve."""
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(f"foreign: {_names(trial)}" if trial.kind == "foreign" else _KINDS[trial.kind], []).append(trial)
    lines = [
        "| plants | trials | named correctly | or among equals | with a false finding | fused error before → after, N RMS | "
        "worse after | paths where something is left, said | where nothing is, not said |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for label, group in groups.items():
        before, after = (rmse(np.array([getattr(trial, when) for trial in group])) for when in ("before", "after"))
        worse = sum(trial.after > _WORSE * trial.before for trial in group)
        false = sum(bool(trial.false_findings) for trial in group)
        equals = sum(trial.named_among_equals for trial in group)
        lines.append(
            f"| {label} | {len(group)} | {_share(group)} | {equals}/{len(group)} | {false} | {before:.0f} → {after:.0f} | "
            f"{worse} | {_said(group, True)} | {_said(group, False)} |"
        )
    both = [rest for trial in trials for rest in trial.left.values() if rest.anything is not None]
    if both:
        undecided = sum(len(trial.left) for trial in trials) - len(both)
        right = sum(rest.said is rest.anything for rest in both)
        lines += ["", f"`unexplained.present`: right on {right} of {len(both)} paths; on {undecided} more either is."]
    singles = [trial for trial in trials if trial.kind == "single"]
    if singles:
        sizes = sorted({trial.size for trial in singles})
        heads = [f"{size:.0f} N" for size in sizes]
        lines += ["", "| effect, named at | " + " | ".join(heads) + " | error of its amplitude, median | of what it does |"]
        lines.append("|---" * (len(sizes) + 3) + "|")
        for name in dict.fromkeys(_names(trial) for trial in singles):
            own = [trial for trial in singles if _names(trial) == name]
            power = [_share([trial for trial in own if trial.size == size]) for size in sizes]
            amplitude = _percent([parameter_error(trial) for trial in own])
            effect = _percent([trial.contribution_error for trial in own if trial.contribution_error is not None])
            lines.append(f"| {name} | {' | '.join(power)} | {amplitude} | {effect} |")
    return "\n".join(lines)


_KINDS = {
    "null": "no effect", "single": "one effect", "pair": "two effects", "triple": "three effects",
    "changed": "calibrated with another size", "drawn": "drawn by a seed", "heat": "heat, drawn by a seed",
}  # fmt: skip
#: From here a validation error counts as worse; below it is the noise of the reference.
_WORSE = 1.05


def _names(trial: Trial) -> str:
    return " + ".join(trial.hidden).replace("_", " ")


def _share(group: list[Trial]) -> str:
    return f"{sum(trial.named for trial in group)}/{len(group)}"


def _said(group: list[Trial], anything: bool) -> str:
    """Number of paths on which the report is right that something is left (``anything``) or that nothing is, of all such
    paths."""
    said = [rest.said is anything for trial in group for rest in trial.left.values() if rest.anything is anything]
    return f"{sum(said)}/{len(said)}" if said else "–"


def _percent(errors: list[float]) -> str:
    known = [error for error in errors if np.isfinite(error)]
    return f"{100 * np.median(known):.1f} %" if known else "–"


def recorded(path: Path | None) -> list[Trial]:
    """Trials of an earlier run from a file; the last line may be incomplete."""
    trials = []
    for line in path.read_bytes().splitlines() if path and path.exists() else []:
        try:
            trials.append(msgspec.json.decode(line, type=Trial))
        except msgspec.DecodeError:
            break
    return trials


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--null", type=int, default=200, help="plants without an effect")
    parser.add_argument("--single", type=int, default=5, help="plants per effect and size")
    parser.add_argument("--pairs", type=int, default=40, help="plants with two effects")
    parser.add_argument("--triples", type=int, default=20, help="plants with three effects")
    parser.add_argument("--changed", type=int, default=13, help="plants with an effect calibrated with another size")
    parser.add_argument("--foreign", type=int, default=10, help="plants per effect outside the catalogue")
    parser.add_argument("--drawn", type=int, default=16, help="plants with an effect that a seed draws from a wider family")
    parser.add_argument("--heat", type=int, default=16, help="the same in the heat balance")
    parser.add_argument("--seeds", type=int, nargs="+", help="only these of the planned trials")
    parser.add_argument("--bare", action="store_true", help="make no terms: does the report say that something is left?")
    parser.add_argument("--output", type=Path, help="trials, one JSON object per line; those already there are not run again")
    parser.add_argument("--calibration", type=Path, help="default: the shipped one")
    arguments = parser.parse_args(argv)
    if arguments.bare:
        search.make_terms = lambda selection, progress: selection
    calibration = load_calibration(arguments.calibration or resource("config/calibration.yaml"))
    counts = arguments.null, arguments.single, arguments.pairs, arguments.foreign
    planned = plan(*counts, arguments.drawn, arguments.triples, arguments.changed, arguments.heat)
    planned = [trial for trial in planned if not arguments.seeds or trial[0] in arguments.seeds]
    done = {_key(t.seed, t.kind, t.hidden, t.size): t for t in recorded(arguments.output)}
    trials = []
    for seed, kind, names, size in planned:
        trial = done.get(_key(seed, kind, names, size))
        if trial is None:
            trial = run_trial(calibration, seed, kind, names, size, _STOPS.get(kind, 10))
            state = "ok" if trial.named else "ok among equals" if trial.named_among_equals else "WRONG"
            found = ", ".join(trial.found) or "-"
            hidden, change = "+".join(trial.hidden), f"{trial.before:.1f} -> {trial.after:.1f} N"
            if trial.kelvin and kind == "heat":
                change = f"{trial.kelvin[0]:.2f} -> {trial.kelvin[1]:.2f} K, {change}"
            text = f"{seed} {kind} {hidden} {size:.0f}: {state}, {found}, {change}"
            print(text, trial.unexplained or "", file=sys.stderr, flush=True)
            if arguments.output:
                with arguments.output.open("ab") as file:
                    file.write(msgspec.json.encode(trial) + b"\n")
        trials.append(trial)
    print(summary(trials))
    return 0


def _key(seed: int, kind: str, names: Iterable[str], size: float) -> tuple:
    return seed, kind, () if kind in ("drawn", "heat") else tuple(names), size


if __name__ == "__main__":
    sys.exit(main())
