"""Bus options: python-can's own, so that users know them already."""

import argparse
import json

from emb_daemon.errors import InputError


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """-i, -c, -b, --fd and --bus-kwargs, as python-can's own tools have them."""
    group = parser.add_argument_group("bus", "python-can's options; can.conf and CAN_* variables count too")
    group.add_argument("-i", "--interface", help="socketcan, virtual, udp_multicast or another of python-can's")
    group.add_argument("-c", "--channel", help="such as can0")
    group.add_argument("-b", "--bitrate", type=int, help="bit/s, for interfaces that set it")
    group.add_argument("--fd", action="store_true", help="open a CAN FD bus; only classic frames are used")
    group.add_argument("--bus-kwargs", nargs="+", metavar="KEY=VALUE", default=[], help="further arguments of the interface")


def bus_options(arguments: argparse.Namespace, defaults=None) -> dict:
    """Keyword arguments for `runtime.bus.open_bus`: the command line, else CAN_* variables, else ``defaults``, a
    configuration's Bus."""
    from can.util import load_environment_config

    environment, options = load_environment_config(), {}
    for name in ("interface", "channel", "bitrate"):
        options[name] = getattr(arguments, name) or environment.get(name) or getattr(defaults, name, None)
    if arguments.fd:
        options["fd"] = True
    for item in arguments.bus_kwargs:
        key, separator, value = item.partition("=")
        if not separator:
            raise InputError(f"--bus-kwargs {item}: expected KEY=VALUE")
        try:
            options[key] = json.loads(value)
        except json.JSONDecodeError:
            options[key] = value
    return options
