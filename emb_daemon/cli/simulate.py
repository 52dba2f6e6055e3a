"""emb-daemon simulate."""

import argparse

from emb_daemon.cli.options import add_bus_arguments, add_mapping_argument, add_path, bus_options, load_chosen
from emb_daemon.cli.serving import stop_signals
from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon simulate -i socketcan -c vcan0 --corners 4 --scenario drive"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--corners", type=int, choices=range(1, 5), default=4, metavar="N", help="1 to 4 brakes, FL first (4)")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after S seconds (default: on Ctrl-C or SIGTERM)")
    parser.add_argument("--scenario", default="drive", help="drive (in town) or park (drive)")
    add_path(parser, "--calibration", "calibration of the simulated brake (default: the shipped one)")
    parser.add_argument("--reference", action="store_true", help="send the rig's reference instruments (RIG_*) too")
    add_mapping_argument(parser)
    add_path(parser, "--keys", "authenticate sent frames, accept only authentic ones (SecOC)")
    add_path(parser, "--state", "with --keys: folder for the trip counter", "DIR")
    parser.add_argument("--seed", type=int, default=0, help="random seed of tolerances and noise (0)")
    add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    import numpy as np

    from emb_daemon.plant.car import Car
    from emb_daemon.plant.derive import plant_from_calibration
    from emb_daemon.plant.live import LiveCar
    from emb_daemon.plant.scenarios import SCENARIOS
    from emb_daemon.wire.layout import CORNERS

    _check(arguments)
    if arguments.scenario not in SCENARIOS:
        raise InputError(f"--scenario {arguments.scenario}: expected {' or '.join(SCENARIOS)}")
    schedule = SCENARIOS[arguments.scenario]()
    calibration = load_chosen(arguments.calibration)
    corners = CORNERS[: arguments.corners]
    plants = np.array([plant_from_calibration(calibration, arguments.seed + row) for row in range(len(corners))])
    bus = _open_bus(arguments, corners)
    live = LiveCar(Car(plants, corners, arguments.seed, arguments.reference), bus, schedule)
    stopped = stop_signals()
    live.warm_up()
    print(f"{', '.join(corners)}: {arguments.scenario}, {schedule.seconds:.0f} s, repeated; Ctrl-C ends it", flush=True)
    try:
        live.run(lambda: bool(stopped), arguments.seconds)
    finally:
        bus.close()
    print(f"{live.ticks} cycles, {live.late} late, {live.lost} lost, {bus.unsent} frames not sent")
    return 0


def _check(arguments: argparse.Namespace) -> None:
    if arguments.seconds is not None and not 0.0 < arguments.seconds < float("inf"):
        raise InputError(f"--seconds {arguments.seconds:g}: expected more than 0; leave it out to run until Ctrl-C")
    if arguments.seed < 0:
        raise InputError(f"--seed {arguments.seed}: expected 0 or more")
    if (arguments.keys is None) != (arguments.state is None):
        raise InputError("--keys and --state: expected both or neither")
    if arguments.keys and arguments.mapping:
        raise InputError("--keys: cannot be used with --mapping, whose messages have no authentication")


def _open_bus(arguments: argparse.Namespace, corners: tuple[str, ...]):
    from emb_daemon.monitor.listener import broadcast_ids
    from emb_daemon.runtime.bus import open_bus
    from emb_daemon.wire.keys import load_keys
    from emb_daemon.wire.secoc import load_links

    # The daemon's broadcasts, although the car itself reacts to EMB_c_AdaptRequest only.
    ids = broadcast_ids()
    sent, heard = load_links(corners=corners) if arguments.keys else ([], [])
    ids += [can_id for link in heard for can_id in (link.authentication_id, link.freshness_id)]
    if arguments.mapping:
        from emb_daemon.logs.live import open_buses
        from emb_daemon.logs.mapping import Mapping
        from emb_daemon.logs.simulated import SimulatedRig

        mapping = Mapping(arguments.mapping)
        return SimulatedRig(open_buses(bus_options(arguments), mapping), mapping, ids)
    bus = open_bus(**bus_options(arguments), ids=ids)
    if not arguments.keys:
        return bus
    from emb_daemon.runtime.secured import Authentication, FreshnessFile, SecuredBus

    keys, file = load_keys(arguments.keys), FreshnessFile(arguments.state)
    return SecuredBus(bus, Authentication(heard, sent, keys, file.begin_trip(), file))
