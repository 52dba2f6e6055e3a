"""Common parts of the converters of drives that clamp nothing: their command line, and the calibration to start from, which is
the thesis's torque balance without other effects."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.files import save_calibration, shipped_calibration
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.candump import format_candump

#: Clearance that no motion closes, rad.
NEVER = 1e4


def parser_of(text: str) -> argparse.ArgumentParser:
    """Parser of a converter that ``text`` describes, with --output."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    return parser


def convert(
    arguments: argparse.Namespace, logs_and_start: Callable[[argparse.Namespace], tuple[dict[str, np.ndarray], Calibration]]
) -> int:
    """Write the logs (FRAME arrays, by name) and the calibration that a converter makes of its ``arguments`` into --output;
    returns the exit status."""
    try:
        arguments.output.mkdir(parents=True, exist_ok=True)
        logs, start = logs_and_start(arguments)
        for name, frames in logs.items():
            write_atomically(arguments.output / f"{name}.log", format_candump(frames).encode())
        save_calibration(start, arguments.output / "calibration.yaml")
    except (OSError, InputError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def starting_calibration(
    actuator: str,
    *,
    torque_constant_Nm_per_A: float,
    inertia_kg_m2: float,
    coulomb_Nm: float,
    presliding_angle_rad: float,
    gear_gain_m_per_rad: float,
    maximum_speed_rad_per_s: float,
) -> Calibration:
    """Inertia and Coulomb friction as a datasheet would say, everything else as shipped."""
    base, replace = shipped_calibration(), msgspec.structs.replace
    motor = {
        "torque_constant_Nm_per_A": torque_constant_Nm_per_A,
        "inertia_kg_m2": inertia_kg_m2,
        "gear_gain_m_per_rad": gear_gain_m_per_rad,
        "maximum_speed_rad_per_s": maximum_speed_rad_per_s,
    }
    friction = {"load_m_per_rad": 0.0, "offset_Nm": coulomb_Nm, "presliding_angle_rad": presliding_angle_rad}
    return replace(
        base,
        actuator=actuator,
        motor=replace(base.motor, **motor),
        friction=replace(base.friction, **friction),
        contact=replace(base.contact, clearance_rad=NEVER),
        effects={},
        provenance=None,
    )
