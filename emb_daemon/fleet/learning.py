"""Runs adaptation over all drives of each unit, and makes a calibration for the next unit from what they learned."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.parameters import CLEARANCE, LOAD_FRICTION, OFFSET_FRICTION, moved, value_of
from emb_daemon.calibration.types import Calibration, Provenance, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import PARAMETERS, new_state
from emb_daemon.fleet.dataset import Drive, made_by, partition, read_drive, write_json
from emb_daemon.fleet.population import LEAST_UNITS, RandomEffects, estimate_random_effects
from emb_daemon.offline import estimate

#: Width of adaptation's bounds, in standard deviations between units: one unit in 16 000 of a normal population is outside.
_WIDTH = 4.0


def learned_path(root: Path, unit: str, corner: str) -> Path:
    return Path(root, "learned", partition(unit, corner)).with_suffix(".json")


def learn_unit(root: Path, drives: Sequence[Drive], calibration: Calibration, resume: bool = True) -> dict[str, Any]:
    """Adaptation over one unit's drives in order; each begins with a power-on and the values learned before. Returns every
    training and its outcome.

    ``resume``: keep an existing result of the same drives, made by the same (`made_by`). Raises InputError: a drive's file is
    missing or damaged."""
    corner, path = drives[0].corner, learned_path(root, drives[0].unit, drives[0].corner)
    result = {"made_by": made_by(calibration), "drives": [drive.digest for drive in drives]}
    if resume and path.exists():
        known = json.loads(path.read_bytes())
        if result.items() <= known.items():
            return known
    trainings = []
    with tempfile.TemporaryDirectory() as state:
        memory = Memory(Path(state))
        for drive in drives:
            log, _ = read_drive(root, drive)
            adaptation = Adaptation({corner: calibration}, memory, int)
            parameters = np.full(4, to_parameters(calibration), PARAMETERS)
            adaptation.restore(parameters)
            before = memory.read(corner)
            estimate(log.samples, parameters, new_state(4), adaptation)
            after = memory.read(corner)
            if after and after != before:
                # A full history drops its oldest entry for a new one.
                new = after.history[len(before.history) if before else 0 :] or after.history[-1:]
                trainings += [{"day": drive.day, **msgspec.to_builtins(entry)} for entry in new]
    result |= {"unit": drives[0].unit, "corner": corner, "entries": trainings}
    result["trainings"] = sum(bool(entry["values"]) for entry in trainings)
    write_json(path, result)
    return result


def population(root: Path, calibration: Calibration) -> dict[str, RandomEffects]:
    """Random effects of the last accepted trainings of all units, by key of the calibration."""
    values: dict[str, list[tuple[float, float]]] = {}
    for path in sorted(Path(root, "learned").glob("unit=*/corner=*.json")):
        stored = json.loads(path.read_bytes())
        accepted = [entry for entry in stored["entries"] if entry["values"]]
        if stored.get("made_by") != made_by(calibration) or not accepted:
            continue
        for key, value in accepted[-1]["values"].items():
            # A value without a standard deviation is set together with others, such as the curves next to the mounted pads'
            # thickness.
            values.setdefault(key, []).append((value, accepted[-1]["sigmas"].get(key, 0.0)))
    return {key: estimate_random_effects(*map(np.array, zip(*pairs, strict=True))) for key, pairs in values.items()}


def prior(root: Path, calibration: Calibration) -> tuple[Calibration, dict[str, RandomEffects]]:
    """Calibration for the next unit of this kind: the population's means, with the standard deviation between units as sigma
    of each key and of the clearance, and bounds of adaptation from their spread. Returns (calibration, the population's random
    effects by key). Raises InputError: too few units have an accepted training."""
    least, learned = 2 * LEAST_UNITS, population(root, calibration)
    learned = {key: found for key, found in learned.items() if found.units >= least and not key.startswith("noise.")}
    if not learned:
        raise InputError(
            f"{root}: fewer than {least} units with an accepted training; run emb-daemon fleet learn on drives with one"
        )
    result = moved(calibration, {key: found.mean for key, found in learned.items()}, checked=True)
    widths = {key: float(np.hypot(found.spread, found.sigma)) for key, found in learned.items()}
    limits, contact = result.adaptation, result.contact
    high = result.training_force_N
    friction = value_of(result, OFFSET_FRICTION) + value_of(result, LOAD_FRICTION) * high
    share = float(np.hypot(widths[OFFSET_FRICTION], widths[LOAD_FRICTION] * high)) / friction
    limits = msgspec.structs.replace(limits, friction_change=_WIDTH * share)
    if CLEARANCE in widths:
        limits = msgspec.structs.replace(limits, clearance_change_rad=_WIDTH * widths[CLEARANCE])
        contact = msgspec.structs.replace(contact, clearance_sigma_rad=widths[CLEARANCE])
    old = result.provenance or Provenance(date="", tool="")
    provenance = msgspec.structs.replace(old, tool="emb-daemon fleet prior", sigmas=dict(old.sigmas) | widths)
    result = msgspec.structs.replace(result, adaptation=limits, contact=contact, provenance=provenance)
    return result, learned
