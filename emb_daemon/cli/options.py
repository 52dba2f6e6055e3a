"""Arguments that several commands have: paths, logs and the bus; and checks of them before the work."""

import argparse
import json
import os
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_daemon.errors import InputError, tell

if TYPE_CHECKING:
    from emb_daemon.calibration.configuration import Bus
    from emb_daemon.calibration.types import Calibration
    from emb_daemon.logs.mapping import Mapping

#: Help text of --config where it is the daemon's, and of --calibration where it may be left out.
CONFIG_HELP = "the daemon's configuration"
CALIBRATION_HELP = "default: the shipped one, of the simulated rig A"


def add_path(parser: argparse._ActionsContainer, name: str, help: str, metavar: str = "FILE", **options: Any) -> None:
    """Add an argument that is a path; ``options`` as for `argparse`."""
    parser.add_argument(name, type=Path, metavar=metavar, help=help, **options)


def add_share_argument(parser: argparse.ArgumentParser) -> None:
    """--share of a process that reads what the daemon shares."""
    default = "/run/emb_daemon/estimates"
    text = f"the file given to emb-daemon run as --share (default: {default}, the service's)"
    add_path(parser, "--share", text, default=Path(default))


def load_chosen(calibration: Path | None) -> "Calibration":
    """The calibration that --calibration names, or the shipped one. Raises InputErrors: it is faulty."""
    from emb_daemon.calibration.files import load_calibration, shipped_calibration

    return load_calibration(calibration) if calibration else shipped_calibration()


def check_output(path: Path, inputs: Iterable[Path | None], endings: tuple[str, ...] = ()) -> None:
    """Refuse a path that cannot be written, that is not a regular file, or that is an input."""
    from emb_daemon.logs.write import ending_of

    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: no such folder: {path.absolute().parent}")
    if not os.access(path.absolute().parent, os.W_OK):
        raise InputError(f"{path}: the folder cannot be written: {path.absolute().parent}")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is not a regular file, and writing would replace it")
    if path.resolve() in [given.resolve() for given in inputs if given]:
        raise InputError(f"{path}: is one of the inputs, and writing would overwrite it")
    if endings and ending_of(path) not in endings:
        raise InputError(f"{path}: unknown ending, expected one of {', '.join(endings)}")


#: Help text of LOG.
LOG_HELP = (
    ".log, .log.gz, .asc, .blf, .trc or .mf4; with --mapping also tables (.csv, .xlsx, .parquet, .mat, .h5, .tdms, .json, …) "
    "and measurements (.mf4)"
)


def add_mapping_argument(parser: argparse.ArgumentParser, required: bool = False) -> None:
    add_path(parser, "--mapping", "YAML file that maps another rig's signals to the daemon's", required=required)


def open_mapping(path: Path) -> "Mapping":
    """A `logs.mapping.Mapping`; prints to stderr which signals its rig does not measure."""
    from emb_daemon.logs.mapping import Mapping

    mapping = Mapping(path)
    for note in mapping.notes:
        tell(note)
    return mapping


def log_reader(mapping: Path | None) -> Callable:
    """Function that reads a log's FRAME array from its path."""
    from emb_daemon.logs.read import read_frames

    return open_mapping(mapping).read if mapping else read_frames


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
    environment, options = {}, {}
    if any(name.startswith("CAN_") for name in os.environ):
        from can.util import load_environment_config

        environment = load_environment_config()
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
