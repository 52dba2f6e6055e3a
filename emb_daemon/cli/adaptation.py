"""emb-daemon adaptation."""

import argparse
import sys
from pathlib import Path

from emb_daemon.cli.options import add_path
from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon adaptation show --state /var/lib/emb_daemon"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action", choices=("show", "reset", "history"), help="print the values in use, delete them, or print all trainings"
    )
    add_path(parser, "--state", "state directory (default: $STATE_DIRECTORY or /var/lib/emb_daemon)", "DIR")
    parser.add_argument("--corner", help="FL, FR, RL or RR (default: all)")
    parser.add_argument("--yes", action="store_true", help="reset without asking, for scripts")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.adapt.memory import Memory, state_directory
    from emb_daemon.offline import corner_index
    from emb_daemon.wire.layout import CORNERS

    folder = arguments.state or state_directory("emb_daemon", Path("/var/lib"))
    if not folder.is_dir():
        raise InputError(f"{folder}: no such state directory; give it with --state")
    corners = CORNERS if arguments.corner is None else (CORNERS[corner_index(arguments.corner)],)
    memory, found = Memory(folder), False
    if arguments.action == "reset" and not arguments.yes:
        _ask([corner for corner in corners if memory.path(corner).exists()])
    for corner in corners:
        if arguments.action == "reset":
            if memory.reset(corner):
                kept = memory.path_of_forgotten(corner)
                print(f"{corner}: deleted, a copy is in {kept}; a running daemon uses its values until it is restarted")
                found = True
            continue
        try:
            store = memory.read(corner)
        except (ValueError, OSError) as error:
            raise InputError(f"{memory.path(corner)}: {error}") from None
        if store is None:
            continue
        found = True
        print(f"{corner}: actuator {store.actuator}, calibration {store.calibration}, {len(store.history)} trainings")
        if arguments.action == "show":
            _show(store.current)
        else:
            for entry in store.history:
                note = f" ({entry.note})" if entry.note else ""
                print(f"  {entry.date}  {entry.outcome}{note}: {_figures(entry)}")
    if not found:
        print(f"{folder}: nothing learned")
    return 0


def _ask(corners: list[str]) -> None:
    """Ask before deleting: the values may have taken years to learn. Raises InputError: the input is no terminal, or the
    answer is no."""
    if not corners:
        return
    if not sys.stdin.isatty():
        raise InputError("adaptation reset: asks before it deletes, but the input is not a terminal; in scripts use --yes")
    answer = input(f"Delete what {', '.join(corners)} learned? [y/N] ")
    if answer.strip().lower() not in ("y", "yes"):
        raise InputError("adaptation reset: nothing was deleted")


def _show(entry) -> None:
    if entry is None:
        print("  no training was accepted; the calibration's values are in use")
        return
    print(f"  learned {entry.date}, at {_number(entry.ambient_C)} °C, pads {_number(entry.pad_rise_K)} K above it")
    for key, value in entry.values.items():
        sigma = f" ± {entry.sigmas[key]:.2g}" if key in entry.sigmas else ""
        print(f"  {key:40} {value:.6g}{sigma}")
    print(f"  evidence: {_figures(entry)}")


def _figures(entry) -> str:
    return ", ".join(f"{name} {_number(value)}" for name, value in entry.evidence.items())


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"
