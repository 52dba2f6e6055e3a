"""emb-daemon check."""

import argparse
from pathlib import Path

EXAMPLE = "emb-daemon check --config config/emb.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", required=True, type=Path, metavar="FILE", help="configuration, such as config/emb.yaml")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.calibration.files import calibration_hash

    setup = Setup(arguments.config)
    for name, calibration in setup.calibrations.items():
        effects = ", ".join(calibration.effects) or "none"
        print(
            f"{name}: actuator {calibration.actuator}, calibration {calibration_hash(calibration)}, "
            f"pads {calibration.pad_thickness_mm:g} mm, effects: {effects}"
        )
    for link in (*setup.links[0], *setup.links[1]):
        if link.name not in setup.keys:
            print(f"no key {link.name}: nothing under it is believed or authenticated, {link.corner or 'the vehicle'}")
    return 0
