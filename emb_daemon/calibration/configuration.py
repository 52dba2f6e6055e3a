"""The daemon's configuration file: bus, corners, folders, real-time settings."""

import difflib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.fields import Struct
from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError, InputErrors, InvalidValue
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.wire.keys import key_file, load_keys
from emb_daemon.wire.layout import CORNERS, load_layout
from emb_daemon.wire.secoc import Link, load_links


class Bus(Struct, kw_only=True):
    """The CAN bus, with the options of python-can. The command line and CAN_* variables override it."""

    #: Name of the interface in python-can, such as socketcan.
    interface: str | None = None
    #: Channel of the interface, such as can0.
    channel: str | None = None
    #: Bit rate in bit/s, for interfaces that set it.
    bitrate: Annotated[int, Meta(gt=0)] | None = None

    def __post_init__(self) -> None:
        # python-can is imported only if needed, because it imports many other modules.
        if self.interface in (None, "socketcan"):
            return
        from can.interfaces import VALID_INTERFACES

        if self.interface not in VALID_INTERFACES:
            near = difflib.get_close_matches(self.interface, VALID_INTERFACES, 3, 0.4) or sorted(VALID_INTERFACES)
            raise InvalidValue(f"interface: unknown to python-can: {self.interface}; similar are {', '.join(near)}")


class Corner(Struct, kw_only=True):
    """The brake of one wheel."""

    #: Calibration file, relative to this configuration.
    calibration: str


class Realtime(Struct, kw_only=True):
    """Settings that keep the loop punctual. The daemon runs without those that the system does not permit."""

    #: SCHED_FIFO priority; null: ordinary scheduling.
    fifo_priority: Annotated[int, Meta(ge=1, le=99)] | None = 60
    #: CPU on which the loop runs; null: any.
    cpu: Annotated[int, Meta(ge=0)] | None = None
    #: Whether to keep all memory of the process in RAM (mlockall).
    lock_memory: bool = True


class Secoc(Struct, kw_only=True):
    """Authentication of received and sent messages (AUTOSAR SecOC). It needs a state directory."""

    #: File of keys, relative to this configuration; a systemd credential of that name overrides it. Only its owner may have
    #: permission to read it. A line is the name of an authentication message, such as EMB_FL_Auth, and 32 hexadecimal digits.
    keys: str


class Xcp(Struct, kw_only=True):
    """What a measurement tool (XCP) may do besides measuring."""

    #: Whether the tool may change numbers of the calibration in use, while the car stands and the brakes are released. The
    #: changes last until the XCP server ends; files are never changed.
    calibrate: bool = False


class Configuration(Struct, kw_only=True):
    """For example config/emb.yaml."""

    #: Version of this file format.
    format: Annotated[int, Meta(ge=1, le=1)]
    bus: Bus = Bus()
    #: Corners that this process estimates, by name: FL, FR, RL, RR.
    corners: Annotated[dict[Annotated[str, Meta(pattern="^(FL|FR|RL|RR)$")], Corner], Meta(min_length=1)]
    #: DBC to use instead of the shipped one, relative to this configuration. Its messages and signals must have the same names
    #: as there; units are converted.
    dbc: str | None = None
    #: Folder for learned values and snapshots; systemd's STATE_DIRECTORY overrides it.
    state_directory: str | None = None
    #: Authentication (AUTOSAR SecOC), both ways; if left out, nothing is authenticated.
    secoc: Secoc | None = None
    xcp: Xcp = Xcp()
    realtime: Realtime = Realtime()
    #: Least level of the messages that go into the journal.
    log_level: Annotated[str, Meta(pattern="^(debug|info|warning|error)$")] = "info"


class Setup:
    """A configuration, with all files that it names loaded and checked.

    Attributes:
        calibrations: by corner name.
        parameters: PARAMETERS array, shape (4,).
        layout: LAYOUT array, shape (1,).
        keys: of authenticated communication, by name; None if it is not configured.
        links: authenticated links that the daemon receives, and those that it sends.
    """

    def __init__(self, path: Path):
        """Raises InputErrors with every fault of configuration, calibrations and DBC."""
        self.path: Path = Path(path)
        faults: list[str] = []
        folder = self.path.parent
        try:
            self.configuration: Configuration = load_yaml(self.path, Configuration)
            dbc, files = self.configuration.dbc, {name: c.calibration for name, c in self.configuration.corners.items()}
        except InputError as error:
            faults += error.faults
            dbc, files = _read_named(self.path)
        try:
            self.layout: np.ndarray = load_layout(folder / dbc if dbc else None, tuple(files))
        except InputError as error:
            faults += error.faults
        self.keys, self.links = None, ([], [])
        if not faults and (secoc := self.configuration.secoc):
            try:
                self.links: tuple[list[Link], list[Link]] = load_links(folder / dbc if dbc else None, tuple(files))
                self.keys: dict[str, bytes] = load_keys(key_file(secoc.keys, folder))
            except InputError as error:
                faults += error.faults
        loaded: dict[str, Calibration] = {}
        for file in dict.fromkeys(files.values()):
            try:
                loaded[file] = load_calibration(folder / file)
            except InputError as error:
                faults += error.faults
        if faults:
            raise InputErrors(faults)
        self.calibrations: dict[str, Calibration] = {name: loaded[file] for name, file in files.items()}
        self.parameters: np.ndarray = np.zeros(4, PARAMETERS)
        for name, calibration in self.calibrations.items():
            self.parameters[CORNERS.index(name)] = to_parameters(calibration)


def _read_named(path: Path) -> tuple[str | None, dict[str, str]]:
    """(DBC, calibration by corner) that a faulty configuration names, so that their faults are listed with its own."""
    try:
        content = load_yaml(path, Any)
    except InputError:
        content = None
    stated = content if isinstance(content, dict) else {}
    dbc, corners = stated.get("dbc"), stated.get("corners")
    entries = corners.items() if isinstance(corners, dict) else ()
    files = {name: entry.get("calibration") for name, entry in entries if name in CORNERS and isinstance(entry, dict)}
    return dbc if isinstance(dbc, str) else None, {name: file for name, file in files.items() if isinstance(file, str)}
