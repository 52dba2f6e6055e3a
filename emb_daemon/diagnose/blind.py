"""Blind test of diagnose on simulated brakes whose effects a seed has drawn.

    python -m emb_daemon.diagnose.blind --null 200 --single 10 --pairs 20 --foreign 10 --output blind.json

Each trial draws a unit that scatters about the calibration as units do, gives it no effect, one, two, or one that the
catalogue does not know, drives a campaign with it, and hands log and calibration to `diagnose`, which is not told. Sizes are
drawn as the RMS error (N) that the effect makes on its own path, so that power can be stated per size. The plant shares no
code with the estimator (see emb_daemon/plant).
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.diagnose.channels import Bench
from emb_daemon.diagnose.diagnosis import diagnose
from emb_daemon.effects import REGISTRY
from emb_daemon.offline import log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import Schedule, random_angle, rest, rig_drag, rig_stop, simulate_log, training
from emb_daemon.resources import resource

#: Effects with a force on a path, drawn in blind trials, and how: amplitudes in proportions that one factor scales, and
#: shape parameters from a range.
_SHAPES: dict[str, dict[str, tuple[float, float]]] = {
    "disc_thickness_variation": {},
    "disc_thermal_expansion": {},
    "torque_constant_fade": {"disc_share": (0.3, 1.0)},
    "current_offset": {},
    "viscous_friction": {},
    "stribeck_friction": {"speed_rad_per_s": (2.0, 20.0)},
    "friction_asymmetry": {},
    "gear_mesh_ripple": {"order_per_turn": (1.3, 12.0)},
    "cogging_torque": {"order_per_turn": (4.0, 24.0)},
    "signal_delay": {},
    "backlash": {},
    "stiffness_hysteresis": {"slip_angle_rad": (0.4, 2.0)},
    "second_relaxation": {"time_constant_s": (0.2, 5.0)},
}
#: Effects outside the catalogue, with a size at which they matter.
_FOREIGN = {
    "clamp_creep": {"share": 0.06, "time_constant_s": 30.0},
    "brake_torque_coupling": {"per_Nm": 6e-5},
    "spindle_lead_error": {"amplitude_um": 15.0, "order_per_turn": 0.4, "phase_rad": 1.0},
}
#: Largest delay drawn, s: a delay is undone to first order, which a longer one than a cycle and a half outgrows.
_LONGEST_DELAY_S = 0.006
#: Sizes (N RMS on the effect's own path) of the power curve.
SIZES_N = (75.0, 150.0, 300.0, 600.0)


@dataclass(frozen=True)
class Trial:
    """What was hidden and what was found.

    Attributes:
        hidden: effects of the plant with their parameters, beside those of the calibration.
        size: RMS that each makes on its own path, N.
        found: effects accepted, with their parameters.
        before, after: RMSE of the fused force on the validation log, N.
        unexplained: signal that a rest depends on, or None.
    """

    seed: int
    kind: str
    hidden: dict[str, dict[str, float]]
    size: float
    found: dict[str, dict[str, float]]
    before: float
    after: float
    unexplained: str | None

    @property
    def false_findings(self) -> set[str]:
        return set(self.found) - set(self.hidden)

    @property
    def named(self) -> bool:
        """Whether exactly what was hidden was found; for a foreign effect, that nothing was, and that it was said so."""
        if self.kind == "foreign":
            return not self.found and self.unexplained is not None
        return set(self.found) == set(self.hidden)


def campaign(plant: np.void, rng: np.random.Generator, stops: int) -> Schedule:
    """A short campaign: training, random angle, stops, a drag, random angle again."""
    schedule = training(plant, seconds=21.0) + random_angle(plant, 10.0, rng)
    for _ in range(stops):
        force = float(np.exp(rng.uniform(np.log(2000.0), np.log(22000.0))))
        schedule += rig_stop(force, rng.uniform(20.0, 60.0), rng.uniform(2.5, 4.0), rng.uniform(6.0, 8.0))
    schedule += rig_drag(rng.uniform(2500.0, 5000.0), rng.uniform(20.0, 40.0), 20.0)
    return schedule + random_angle(plant, 10.0, rng) + rest(0.5)


def draw(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of an effect at the size that physics leads one to expect."""
    effect = next(e for e in REGISTRY if e.name == name)
    values = {}
    for parameter in effect.parameters:
        if parameter.starts:
            low, high = _SHAPES[name][parameter.name]
            value = float(np.exp(rng.uniform(np.log(low), np.log(high))))
            values[parameter.name] = float(round(value)) if name == "cogging_torque" else value
        elif "order_3" in parameter.name or "order_4" in parameter.name:
            values[parameter.name] = 0.0
        else:
            # Only the future would make a delay negative.
            sign = 1.0 if parameter.low >= 0.0 or name == "signal_delay" else rng.choice([-1.0, 1.0])
            values[parameter.name] = float(parameter.prior * sign * rng.uniform(0.5, 1.5))
    return values


def scaled(name: str, values: dict[str, float], factor: float) -> dict[str, float]:
    """The same effect, ``factor`` times as strong, inside its bounds."""
    effect = next(e for e in REGISTRY if e.name == name)
    result = dict(values)
    for parameter in effect.amplitudes:
        high = _LONGEST_DELAY_S if name == "signal_delay" else parameter.high
        result[parameter.name] = float(np.clip(values[parameter.name] * factor, max(parameter.low, -high), high))
    return result


def force_of(bench: Bench, name: str, values: dict[str, float]) -> float:
    """RMS (N) of what an effect does on its own path, by the estimator's own term."""
    effect = next(e for e in REGISTRY if e.name == name)
    channel = bench.channel_of(effect.path, name)
    other = Bench.__new__(Bench)
    other.__dict__.update(bench.__dict__)
    other.parameters = bench.parameters.copy()
    for key, value in values.items():
        other.parameters["effects"][name][key] = value
    change = other.residuals({})[channel] - bench.residuals({})[channel]
    return float(np.sqrt(np.mean(change**2)))


def run_trial(calibration: Calibration, seed: int, kind: str, names: tuple[str, ...] = (), size: float = 0.0, stops: int = 10):
    """One blind trial; ``kind`` is null, single, pair or foreign, ``names`` the effects to hide at ``size`` N each."""
    rng = np.random.default_rng(seed)
    start = calibration
    removed = [name for name in names if name in calibration.effects]
    if removed:
        import msgspec

        start = msgspec.structs.replace(
            calibration, effects={k: v for k, v in calibration.effects.items() if k not in removed}
        )
    base = plant_from_calibration(calibration, seed=seed)
    for name in removed:
        base["effects"][name] = 0.0
    schedule = campaign(base, rng, stops)
    hidden: dict[str, dict[str, float]] = {}
    if kind == "foreign":
        hidden[names[0]] = dict(_FOREIGN[names[0]])
    elif names:
        frames, _ = simulate_log(base, schedule, seed=seed)
        bench = Bench([log_of(frames)], to_parameters(start))
        for name in names:
            values = draw(name, rng)
            # Twice, because large sizes are not quite linear.
            for _ in range(2):
                values = scaled(name, values, size / max(force_of(bench, name, values), 1e-9))
            hidden[name] = values
    plant = base.copy()
    for name, values in hidden.items():
        for key, value in values.items():
            plant["effects"][name][key] = value
    fit_frames, _ = simulate_log(plant, schedule, seed=seed + 1)
    val_frames, _ = simulate_log(plant, campaign(plant, rng, stops), seed=seed + 2)
    result = diagnose([log_of(fit_frames)], start, [log_of(val_frames)])
    rest_ = result.unexplained
    return Trial(
        seed,
        kind,
        hidden,
        size,
        {f.effect.name: dict(f.values) for f in result.accepted},
        result.before.rmse("fused"),
        result.after.rmse("fused"),
        rest_.signal if rest_ else None,
    )


def parameter_error(trial: Trial) -> float:
    """Largest relative error of the amplitudes that were hidden, against the effect's largest amplitude; NaN if not found."""
    worst = np.nan
    for name, values in trial.hidden.items():
        if name not in trial.found:
            return float("nan")
        effect = next(e for e in REGISTRY if e.name == name)
        keys = [p.name for p in effect.amplitudes]
        scale = max(abs(values[key]) for key in keys)
        error = max(abs(trial.found[name].get(key, 0.0) - values[key]) for key in keys) / scale
        worst = float(np.nanmax([worst, error]))
    return worst


def plan(null: int, single: int, pairs: int, foreign: int) -> list[tuple[int, str, tuple[str, ...], float]]:
    """Trials (seed, kind, effects, size); ``single`` counts per effect and size."""
    rng = np.random.default_rng(2009)
    names = list(_SHAPES)
    trials: list[tuple[int, str, tuple[str, ...], float]] = [(1000 + k, "null", (), 0.0) for k in range(null)]
    seed = 20000
    for name in names:
        for size in SIZES_N:
            for _ in range(single):
                trials.append((seed, "single", (name,), size))
                seed += 10
    for _ in range(pairs):
        first, second = rng.choice(len(names), 2, replace=False)
        trials.append((seed, "pair", (names[first], names[second]), float(rng.uniform(150.0, 500.0))))
        seed += 10
    for name in _FOREIGN:
        for _ in range(foreign):
            trials.append((seed, "foreign", (name,), 0.0))
            seed += 10
    return trials


def summary(trials: list[Trial]) -> str:
    """Markdown table of the score."""
    lines = [
        "| trials | n | named | false findings | error before → after / N | parameter error, median |",
        "|---|---|---|---|---|---|",
    ]
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        label = trial.kind if trial.kind in ("null", "pair") else f"{trial.kind} {next(iter(trial.hidden))}"
        if trial.kind == "single":
            label += f" {trial.size:.0f} N"
        groups.setdefault(label, []).append(trial)
    for label, group in groups.items():
        named = sum(trial.named for trial in group)
        false = sum(bool(trial.false_findings) for trial in group)
        before = np.sqrt(np.mean([trial.before**2 for trial in group]))
        after = np.sqrt(np.mean([trial.after**2 for trial in group]))
        errors = [parameter_error(trial) for trial in group if trial.kind in ("single", "pair")]
        errors = [error for error in errors if np.isfinite(error)]
        error = f"{100 * np.median(errors):.1f} %" if errors else "–"
        lines.append(f"| {label} | {len(group)} | {named} | {false} | {before:.0f} → {after:.0f} | {error} |")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--null", type=int, default=200, help="plants without an effect")
    parser.add_argument("--single", type=int, default=5, help="plants per effect and size")
    parser.add_argument("--pairs", type=int, default=40, help="plants with two effects")
    parser.add_argument("--foreign", type=int, default=10, help="plants per effect outside the catalogue")
    parser.add_argument("--output", type=Path, help="trials as JSON")
    parser.add_argument("--calibration", type=Path, help="default: the shipped one")
    arguments = parser.parse_args(argv)
    calibration = load_calibration(arguments.calibration or resource("config/calibration.yaml"))
    trials = []
    for seed, kind, names, size in plan(arguments.null, arguments.single, arguments.pairs, arguments.foreign):
        trial = run_trial(calibration, seed, kind, names, size)
        trials.append(trial)
        state = "ok" if trial.named else "WRONG"
        found = ", ".join(trial.found) or "-"
        text = f"{kind} {'+'.join(names)} {size:.0f} N: {state}, found {found}, {trial.before:.0f} -> {trial.after:.0f} N"
        print(text, trial.unexplained or "", file=sys.stderr, flush=True)
        if arguments.output:
            arguments.output.write_text(json.dumps([asdict(t) for t in trials], indent=1))
    print(summary(trials))
    return 0


if __name__ == "__main__":
    sys.exit(main())
