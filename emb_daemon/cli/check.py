"""emb-daemon check."""

import argparse
from collections.abc import Callable
from pathlib import Path

from emb_daemon.cli.options import add_mapping_argument, add_path, open_mapping
from emb_daemon.errors import InputError, InputErrors

EXAMPLE = "emb-daemon check --config config/emb.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "--config", "configuration, such as config/emb.yaml")
    add_mapping_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.calibration.files import calibration_hash

    if not arguments.config and not arguments.mapping:
        raise InputError("check: expected --config FILE, --mapping FILE or both")
    faults: list[str] = []

    def check(load: Callable, path: Path | None):
        try:
            return load(path) if path else None
        except InputError as error:
            faults.extend(error.faults)

    mapping, setup = check(open_mapping, arguments.mapping), check(Setup, arguments.config)
    if mapping and setup:
        faults += mapping.taken(setup.layout)
    if faults:
        raise InputErrors(faults)
    if arguments.mapping:
        print(f"{arguments.mapping}: no fault, every signal can be converted")
    if not arguments.config:
        return 0
    for name, calibration in setup.calibrations.items():
        effects = ", ".join(calibration.effects) or "none"
        print(
            f"{name}: actuator {calibration.actuator}, calibration {calibration_hash(calibration)}, "
            f"pads {calibration.pad_thickness_mm:g} mm, effects: {effects}"
        )
    for link in (*setup.links[0], *setup.links[1]):
        if link.name not in setup.keys:
            sender = link.corner or "vehicle"
            print(f"{sender}: no key {link.name}: its messages are neither accepted nor sent with authentication")
    return 0
