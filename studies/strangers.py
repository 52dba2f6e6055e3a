"""Brakes with other physics, identified from campaign and datasheet alone, and judged on a drive that was not fitted.

    python -m studies.strangers --seeds 0 1 2 3 [--without random ...] [--kept DIR]

Each seed draws a simulated brake: force from 10 to 45 kN, another screw, motor and friction, three effects of the catalogue at
their usual sizes and one that no catalogue lists. A campaign is recorded as a rig does it (curves and random angles at three
pad thicknesses, a training, heat, drives with stops) and given to `emb-daemon identify`. The resulting calibration estimates
another drive, or the campaign's own judge if the brake jams in that. Printed are its errors, what the calibration states of
itself, and what was named. With parts of the campaign, or single logs, left out it shows the effect of a smaller campaign.
"""

import argparse
import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import yaml

from emb_daemon.calibration.files import load_calibration, shipped_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.cli.main import main as emb_daemon
from emb_daemon.identify.example import FILES
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import estimate, load_log
from emb_daemon.offline.score import first_known, rmse, share_inside, temperature_figures
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.derive import plant_from_calibration
from studies.blind import DRAWN, draw, draw_sized
from studies.drives import rig_drag, rig_stop, training

_THICKNESSES_MM = (3.5, 6.5, 9.5)
#: RMS of the effect that no catalogue lists, as a share of the brake's force: 300 N at 30 kN.
_FOREIGN_SHARE = 0.01
#: Uncertainty of a reference force sensor, N (as in `studies.silent`).
_REFERENCE_N = 25.0


@dataclass
class Stranger:
    """A brake, what is special about it, and its campaign's schedules by file name with the pad thickness (mm) of each.
    ``sheet`` is what its datasheet says of the actuator beside the usual, ``limit`` the drive's current over the usual."""

    calibration: Calibration
    effects: dict[str, dict[str, float]]
    sheet: dict = field(default_factory=dict)
    limit: float = 1.0
    logs: dict[str, tuple[sc.Schedule, float]] = field(default_factory=dict)


def draw_brake(rng: np.random.Generator) -> Calibration:
    """The shipped calibration's brake with another force, screw, motor and friction."""
    base = shipped_calibration()
    force = float(np.exp(rng.uniform(np.log(10e3), np.log(45e3)))) / base.stiffness.maximum_force_N
    angle = float(np.exp(rng.uniform(np.log(0.6), np.log(1.8))))
    torque = force / angle
    other = lambda spread: float(np.exp(rng.uniform(-np.log(spread), np.log(spread))))  # noqa: E731
    replace = msgspec.structs.replace
    gain = base.motor.gear_gain_m_per_rad / angle
    constant = base.motor.torque_constant_Nm_per_A * torque * other(1.5)
    current = torque * base.motor.torque_constant_Nm_per_A / constant
    curves = tuple(
        replace(curve, coefficients=tuple(force * a / angle ** (n + 1) for n, a in enumerate(curve.coefficients)))
        for curve in base.stiffness.curves
    )
    return replace(
        base,
        actuator="stranger",
        motor=replace(
            base.motor,
            torque_constant_Nm_per_A=constant,
            inertia_kg_m2=base.motor.inertia_kg_m2 * torque / angle * other(1.3),
            gear_gain_m_per_rad=gain,
            maximum_speed_rad_per_s=base.motor.maximum_speed_rad_per_s * angle,
        ),
        friction=replace(
            base.friction,
            load_m_per_rad=base.friction.load_m_per_rad / angle * other(1.4),
            offset_Nm=base.friction.offset_Nm * torque * other(1.4),
        ),
        stiffness=replace(
            base.stiffness,
            curves=curves,
            maximum_force_N=base.stiffness.maximum_force_N * force,
            relaxation_time_s=base.stiffness.relaxation_time_s * other(1.5),
        ),
        contact=replace(base.contact, clearance_rad=base.contact.clearance_rad * angle * other(1.3)),
        noise=replace(base.noise, current_A=base.noise.current_A * current),
        effects={},
    )


def draw_stranger(seed: int) -> Stranger:
    """The brake of a seed."""
    rng = np.random.default_rng(seed)
    calibration = draw_brake(rng)
    names = rng.choice([name for name in DRAWN if name != "signal_delay"], 3, replace=False)
    effects = {str(name): draw(str(name), rng) for name in names}
    base = plant_from_calibration(calibration, seed=seed, effects=effects)
    size = _FOREIGN_SHARE * calibration.stiffness.maximum_force_N
    schedule = sc.random_angle(base, 20.0, np.random.default_rng(seed), 0.5 * calibration.stiffness.maximum_force_N)
    drive = _drive(calibration, np.random.default_rng(seed), 4)
    foreign = draw_sized(base, schedule + drive, calibration, rng, size, seed)
    stranger = Stranger(calibration, effects | foreign)
    plan(stranger, seed, rng)
    return stranger


def plan(stranger: Stranger, seed: int, rng: np.random.Generator) -> None:
    """Give the stranger the schedules that a rig records, by log, with the thickness of the mounted pads, mm."""
    calibration = stranger.calibration
    high = calibration.stiffness.maximum_force_N
    for thickness in _THICKNESSES_MM:
        plant = _plant(stranger, seed, thickness)
        stranger.logs[f"curve_{thickness:g}"] = sc.curve(plant, 0.85 * high) + sc.rest(0.5), thickness
        stranger.logs[f"random_{thickness:g}"] = _random(plant, rng, high), thickness
    plant = _plant(stranger, seed, 5.0)
    stranger.logs["training_5"] = training(plant, 42.0, 0.5 * high), 5.0
    stranger.logs["random_5"] = _random(plant, rng, high), 5.0
    for name in ("tune", "validate"):
        stranger.logs[name] = _heat(calibration, rng), 10.0
    for name in ("fit", "judge", "val"):
        stranger.logs[name] = _drive(calibration, rng, 25), 10.0


def _plant(stranger: Stranger, seed: int, thickness: float) -> np.void:
    plant = plant_from_calibration(stranger.calibration, seed=seed, effects=stranger.effects, pad_thickness_mm=thickness)
    plant["maximum_current"] *= stranger.limit
    return plant


def _random(plant: np.void, rng: np.random.Generator, high: float) -> sc.Schedule:
    return sc.rest(1.0) + sc.random_angle(plant, 20.0, rng, 0.5 * high)


def _drive(calibration: Calibration, rng: np.random.Generator, stops: int) -> sc.Schedule:
    high, schedule = calibration.stiffness.maximum_force_N, sc.rest(2.0)
    for _ in range(stops):
        force = high * float(np.exp(rng.uniform(np.log(0.06), np.log(0.7))))
        schedule += rig_stop(force, rng.uniform(20.0, 60.0), rng.uniform(2.5, 4.0), rng.uniform(6.0, 8.0))
    drag = rig_drag(0.15 * high, rng.uniform(20.0, 40.0), 40.0)
    plant = plant_from_calibration(calibration)
    return schedule + drag + sc.random_angle(plant, 15.0, rng, 0.5 * high) + sc.rest(0.5)


def _heat(calibration: Calibration, rng: np.random.Generator) -> sc.Schedule:
    high, schedule = calibration.stiffness.maximum_force_N, sc.rest(2.0)
    for _ in range(2):
        schedule += rig_drag(high * rng.uniform(0.08, 0.2), rng.uniform(15.0, 50.0), 40.0) + sc.rest(30.0)
        for _ in range(4):
            schedule += rig_stop(high * rng.uniform(0.2, 0.6), rng.uniform(30.0, 60.0))
    return schedule + sc.rest(60.0)


def record(stranger: Stranger, seed: int, folder: Path, without: Sequence[str] = ()) -> Path:
    """Logs, datasheet and campaign in ``folder``, which lacks what it goes ``without``; the campaign's path."""
    rng, c = np.random.default_rng((seed, 1)), stranger.calibration
    for row, (name, (schedule, thickness)) in enumerate(stranger.logs.items()):
        write_frames(folder / f"{name}.log", sc.simulate_log(_plant(stranger, seed, thickness), schedule, seed=seed + row)[0])
    off = lambda tolerance: 1.0 + rng.uniform(-tolerance, tolerance)  # noqa: E731
    sheet = yaml.safe_load((FILES / "datasheet.yaml").read_text())
    sheet["actuator"] |= {
        "gear_gain_m_per_rad": c.motor.gear_gain_m_per_rad,
        "motor_torque_constant_Nm_per_A": float(c.motor.torque_constant_Nm_per_A * off(0.03)),
        "lumped_inertia_kg_m2": float(c.motor.inertia_kg_m2 * off(0.1)),
        "max_motor_speed_rad_per_s": c.motor.maximum_speed_rad_per_s,
        "rated_clamp_force_N": c.stiffness.maximum_force_N,
        "pad_clearance_rad": float(c.contact.clearance_rad * off(0.05)),
    } | stranger.sheet
    (folder / "datasheet.yaml").write_text(yaml.safe_dump(sheet))
    of = {t: {"pad_thickness_mm": t} for t in (*_THICKNESSES_MM, 5.0)}
    campaign = {
        "rig": "stranger",
        "datasheet": "datasheet.yaml",
        "pad_thickness_mm": 10.0,
        "curves": [{"log": f"curve_{t:g}.log"} | of[t] for t in _THICKNESSES_MM],
        "random": [{"log": f"random_{t:g}.log"} | of[t] for t in _THICKNESSES_MM],
        "adaptation": [{"training": "training_5.log", "judge": "random_5.log"} | of[5.0]],
        "thermal": {"tune": "tune.log", "validate": "validate.log"},
        "integrated": [{"fit": "fit.log", "judge": "judge.log"}],
    }
    (folder / "campaign.yaml").write_text(yaml.safe_dump(_thin(campaign, without), sort_keys=False))
    return folder / "campaign.yaml"


def _thin(campaign: dict, without: Sequence[str]) -> dict:
    """A campaign without some of its parts, and without entries of some of its logs, by the log's name. Raises ValueError: it
    has none of a name."""

    def kept(entry):
        return not any(f"{name}.log" in entry.values() for name in without)

    entries = [entry for value in campaign.values() if isinstance(value, list) for entry in value]
    known = [
        *campaign,
        *(value.removesuffix(".log") for entry in entries for value in entry.values() if isinstance(value, str)),
    ]
    if unknown := [name for name in without if name not in known]:
        raise ValueError(f"--without: {', '.join(unknown)}: expected of {', '.join(known)}")

    parts = {part: value for part, value in campaign.items() if part not in without}
    return {
        part: [entry for entry in value if kept(entry)] if isinstance(value, list) else value for part, value in parts.items()
    }


def judge(calibration: Calibration, path: Path) -> dict[str, float]:
    """Errors on a drive that was not fitted: of the force in N and relative to it, of the pads in K."""
    log = load_log(path)
    estimates = estimate(log.samples, to_parameters(calibration))
    known = slice(first_known(estimates), None)
    error, sigma = (estimates["force"] - log.force_N)[known], estimates["sigma"][known]
    heat = temperature_figures(log.samples["time_ns"], estimates, log.reference)
    return {
        "fused_N": rmse(error),
        "stiffness_N": rmse((estimates["stiffness_force"] - log.force_N)[known]),
        "torque_N": rmse((estimates["torque_force"] - log.force_N)[known]),
        "sigma_N": float(np.median(sigma)),
        "inside_two": share_inside(error, sigma),
        "beyond_three": float(np.mean(np.abs(error) > 3.0 * np.hypot(sigma, _REFERENCE_N))),
        "running": float(np.mean(estimates["reasons"][known] == 0)),
        "pads_K": heat["pads"]["rmse"] if heat else np.nan,
    }


def _opens(path: Path) -> bool:
    """Whether the brake is released at the end of a drive: a drawn loss of the gear may grow until it is self-locking."""
    force = load_log(path).force_N
    return float(np.nanmedian(force[-50:])) < 0.1 * float(np.nanmax(force))


def run(stranger: Stranger, seed: int, folder: Path, without: Sequence[str] = ()) -> str:
    """One line: the brake, what it hides, what was named, and the errors."""
    hidden = {name: {key: round(value, 6) for key, value in values.items()} for name, values in stranger.effects.items()}
    head = f"seed {seed}: {stranger.calibration.stiffness.maximum_force_N:.0f} N, hides {hidden}"
    print(f"{head}\n  recording", file=sys.stderr, flush=True)
    campaign = record(stranger, seed, folder, without)
    print("  identifying", file=sys.stderr, flush=True)
    begin, said = time.monotonic(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = emb_daemon(["identify", str(campaign), "--output", str(folder / "c.yaml"), "--report", str(folder / "r")])
    seconds = time.monotonic() - begin
    (folder / "said.txt").write_text(said.getvalue())
    print(f"  judging, identified in {seconds:.0f} s, status {status}", file=sys.stderr, flush=True)
    if status not in (0, 3):
        return f"{head}\n  identify ended with {status}: {said.getvalue().strip().splitlines()[-1]}"
    calibration = load_calibration(folder / "c.yaml")
    found = ", ".join([*calibration.effects, *(f"{term.port} over {term.signal}" for term in calibration.terms)])
    drive = next((name for name in ("val", "judge") if _opens(folder / f"{name}.log")), None)
    if drive is None:
        return f"{head}\n  named: {found}\n  jams in every drive that judges"
    errors = "  ".join(f"{name} {value:.3g}" for name, value in judge(calibration, folder / f"{drive}.log").items())
    says = f"says {calibration.provenance.achieved}  {seconds:.0f} s, status {status}"
    return f"{head}\n  named: {found}\n  on {drive}: {errors}  {says}"


def main(draw=draw_stranger, text=__doc__) -> None:
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument(
        "--without", nargs="+", default=(), metavar="NAME", help="part of the campaign (random, thermal), or log (curve_3.5)"
    )
    parser.add_argument("--kept", type=Path, metavar="DIR", help="logs, calibrations and reports stay there")
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            if arguments.kept:
                folder = arguments.kept / str(seed)
                folder.mkdir(parents=True, exist_ok=True)
            print(run(draw(seed), seed, folder, arguments.without), flush=True)


if __name__ == "__main__":
    main()
