"""Bus options, the same as those of python-can's tools."""

import argparse
import json
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from emb_daemon.errors import InputError

if TYPE_CHECKING:
    from emb_daemon.calibration.configuration import Bus


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """Add -i, -c, -b, --fd and --bus-kwargs, as in python-can's tools."""
    group = parser.add_argument_group("bus", "python-can's options; can.conf and CAN_* variables count too")
    group.add_argument("-i", "--interface", help="socketcan, virtual, udp_multicast or another of python-can's")
    group.add_argument("-c", "--channel", help="such as can0")
    group.add_argument("-b", "--bitrate", type=int, help="bit/s, for interfaces that set it")
    group.add_argument("--fd", action="store_true", help="open a CAN FD bus; only classic frames are used")
    group.add_argument("--bus-kwargs", nargs="+", metavar="KEY=VALUE", default=[], help="further arguments of the interface")


def add_id_arguments(parser: argparse.ArgumentParser, request_id: int, response_id: int) -> None:
    """--request-id and --response-id of a server on the bus."""
    for name, default in (("request", request_id), ("response", response_id)):
        parser.add_argument(
            f"--{name}-id", type=_can_id, default=default, metavar="ID", help=f"11-bit CAN id of {name}s ({default:#x})"
        )


def _can_id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        value = -1
    if not 0 <= value <= 0x7FF:
        raise argparse.ArgumentTypeError(f"{text}: expected an 11-bit CAN id, 0 to 0x7ff")
    return value


def host_and_port(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT; raises InputError for anything else."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 0xFFFF:
        raise InputError(f"--udp {text}: expected HOST:PORT, such as 127.0.0.1:5555")
    return host, int(port)


def check_ids(arguments: argparse.Namespace, taken: Collection[int]) -> None:
    """Raises InputError if an id of `add_id_arguments` is also used by another message."""
    for name in ("request_id", "response_id"):
        if getattr(arguments, name) in taken or arguments.request_id == arguments.response_id:
            raise InputError(
                f"--{name.replace('_', '-')} {getattr(arguments, name):#x}: expected an id that no other message uses"
            )


def bus_options(arguments: argparse.Namespace, defaults: "Bus | None" = None) -> dict[str, Any]:
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
