"""emb-daemon effect."""

import argparse

from emb_daemon.atomic import write_atomically
from emb_daemon.cli.options import add_path, check_output
from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon effect export calibration.yaml term:gear_friction:motor_angle --output screw_friction.py"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    does = "write a term that diagnose found as an effect file"
    export = commands.add_parser("export", help=does, description=does.capitalize() + ".")
    add_path(export, "calibration", "calibration that contains the term", "CALIBRATION")
    export.add_argument("term", metavar="TERM", help="name of the term in the calibration")
    add_path(export, "--output", "effect file to write", required=True)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.files import load_calibration
    from emb_daemon.diagnose.export import effect_name, source, values
    from emb_daemon.diagnose.forms import equation

    check_output(arguments.output, [arguments.calibration])
    calibration = load_calibration(arguments.calibration)
    named = {term.name: term for term in calibration.terms}
    if arguments.term not in named:
        known = ", ".join(named) or "no term at all"
        raise InputError(f"{arguments.calibration}: terms: no {arguments.term}; there is {known}")
    term = named[arguments.term]
    text = source(term, calibration.stiffness.maximum_force_N, equation(term))
    write_atomically(arguments.output, text.encode())
    own = "\n".join(f"    {name}: {value!r}" for name, value in values(term).items())
    print(f"{arguments.output} is written. In the calibration, replace the term by:\neffects:\n  {effect_name(term)}:\n{own}")
    return 0
