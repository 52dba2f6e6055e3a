"""emb-daemon adaptation."""

import argparse
from pathlib import Path

EXAMPLE = "emb-daemon adaptation show --state /var/lib/emb_daemon"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("show", "reset", "history"), help="values in use, forget them, or all trainings")
    parser.add_argument(
        "--state", type=Path, metavar="DIR", help="state directory (default: $STATE_DIRECTORY or /var/lib/emb_daemon)"
    )
    parser.add_argument("--corner", help="FL, FR, RL or RR (default: all)")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.adapt.memory import Memory, state_directory
    from emb_daemon.errors import InputError
    from emb_daemon.offline import corner_index
    from emb_daemon.wire.layout import CORNERS

    folder = arguments.state or state_directory("emb_daemon", Path("/var/lib"))
    if not folder.is_dir():
        raise InputError(f"{folder}: no such state directory; give it with --state")
    corners = CORNERS if arguments.corner is None else (CORNERS[corner_index(arguments.corner)],)
    memory, found = Memory(folder), False
    for corner in corners:
        if arguments.action == "reset":
            if memory.reset(corner):
                print(f"{corner}: forgotten; a running daemon keeps its values until it is restarted")
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
                _line(entry)
    if not found:
        print(f"{folder}: nothing learned")
    return 0


def _show(entry) -> None:
    if entry is None:
        print("  no training was accepted; the calibration's values are in use")
        return
    curve = " ".join(f"{value:.5g}" for value in entry.curve if value)
    clearance = "not learned" if entry.clearance_rad is None else f"{entry.clearance_rad:.2f} rad"
    print(f"  learned         {entry.date}, at {entry.ambient_C:.0f} °C, pads {entry.pad_rise_K:+.1f} K")
    print(f"  curve           {curve}  N/rad, N/rad², …")
    print(
        f"  friction        {1e3 * entry.offset_friction_Nm:.2f} mN m + {1e6 * entry.load_friction_m_per_rad:.3f} µm/rad · F"
    )
    print(f"  presliding      {1e3 * entry.presliding_angle_rad:.1f} mrad")
    print(f"  clearance       {clearance}, contact angle ±{entry.contact_sigma_rad:.2f} rad")
    print(f"  force           ±{entry.force_sigma_N:.0f} N at most, reached {1e-3 * entry.top_force_N:.1f} kN")
    residual = f"residual {entry.residual_A:.3f} A ({entry.residual_ratio:.2f} of noise)"
    print(f"  evidence        {entry.samples} samples, {residual}, pairs differ {100 * entry.pairs_difference:.1f} %")


def _line(entry) -> None:
    change = "" if entry.curve_change is None else f", travel to full force changed by {100 * entry.curve_change:.1f} %"
    ratio = "" if entry.residual_ratio is None else f", residual {entry.residual_ratio:.2f} of noise"
    print(f"  {entry.date}  {entry.verdict}: {entry.samples} samples{ratio}{change}")
