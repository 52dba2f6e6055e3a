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
from emb_daemon.wire.secoc import load_links


class Bus(Struct, kw_only=True):
    """The CAN bus, in python-can's words; the command line and CAN_* variables come before it."""

    #: python-can's name of the interface, such as socketcan.
    interface: str | None = None
    #: Such as can0.
    channel: str | None = None
    #: In bit/s, for interfaces that set it.
    bitrate: Annotated[int, Meta(gt=0)] | None = None

    def __post_init__(self):
        # python-can is imported only for what it alone knows: it brings much along.
        if self.interface in (None, "socketcan"):
            return
        from can.interfaces import VALID_INTERFACES

        if self.interface not in VALID_INTERFACES:
            near = difflib.get_close_matches(self.interface, VALID_INTERFACES, 3, 0.4) or sorted(VALID_INTERFACES)
            raise InvalidValue(f"interface: python-can knows no {self.interface}; near are {', '.join(near)}")


class Corner(Struct, kw_only=True):
    """One wheel's brake."""

    #: Calibration file, relative to this configuration.
    calibration: str


class Realtime(Struct, kw_only=True):
    """What makes the loop punctual where the system allows it."""

    #: SCHED_FIFO priority, or null for ordinary scheduling.
    fifo_priority: Annotated[int, Meta(ge=1, le=99)] | None = 60
    #: CPU to run the loop on, or null for any.
    cpu: Annotated[int, Meta(ge=0)] | None = None
    #: Keep all memory in RAM (mlockall).
    lock_memory: bool = True


class Secoc(Struct, kw_only=True):
    """Authenticated communication, both ways (AUTOSAR SecOC); needs a state directory and the extra secoc."""

    #: File of keys, relative to this configuration; a systemd credential of that name comes before it. Its owner alone may
    #: read it; a line is the name of an authentication message, such as EMB_FL_Auth, and 32 hexadecimal digits.
    keys: str


class Xcp(Struct, kw_only=True):
    """What a measurement tool may do besides measuring."""

    #: Whether it may try other numbers of the calibration, with the car standing and the brakes released, until its server
    #: ends. Files stay as they are.
    calibrate: bool = False


class Configuration(Struct, kw_only=True):
    """config/emb.yaml."""

    #: Version of this file format.
    format: Annotated[int, Meta(ge=1, le=1)]
    bus: Bus = Bus()
    #: FL, FR, RL, RR: those that this process estimates.
    corners: Annotated[dict[Annotated[str, Meta(pattern="^(FL|FR|RL|RR)$")], Corner], Meta(min_length=1)]
    #: DBC to use instead of the shipped one, relative to this configuration; names of messages and signals are the same,
    #: units are converted.
    dbc: str | None = None
    #: Folder for what adaptation learns; systemd's STATE_DIRECTORY comes before it.
    state_directory: str | None = None
    #: Without it nothing is authenticated.
    secoc: Secoc | None = None
    xcp: Xcp = Xcp()
    realtime: Realtime = Realtime()
    #: What the journal gets: debug, info, warning or error.
    log_level: Annotated[str, Meta(pattern="^(debug|info|warning|error)$")] = "info"


class Setup:
    """A configuration with everything that it names, loaded and checked.

    Attributes:
        calibrations: by corner name.
        parameters: PARAMETERS array, shape (4,).
        layout: LAYOUT array, shape (1,).
        keys: of authenticated communication, by name; None where it is not configured.
        links: that the daemon receives, and that it sends, authenticated.
    """

    def __init__(self, path: Path):
        """Raises InputErrors with every fault of configuration, calibrations and DBC."""
        self.path = Path(path)
        faults: list[str] = []
        folder = self.path.parent
        try:
            self.configuration = load_yaml(self.path, Configuration)
            dbc, files = self.configuration.dbc, {name: c.calibration for name, c in self.configuration.corners.items()}
        except InputError as error:
            faults += error.faults
            dbc, files = _read_named(self.path)
        try:
            self.layout = load_layout(folder / dbc if dbc else None, tuple(files))
        except InputError as error:
            faults += error.faults
        self.keys, self.links = None, ([], [])
        if not faults and (secoc := self.configuration.secoc):
            try:
                self.links = load_links(folder / dbc if dbc else None, tuple(files))
                self.keys = load_keys(key_file(secoc.keys, folder))
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
        self.calibrations = {name: loaded[file] for name, file in files.items()}
        self.parameters = np.zeros(4, PARAMETERS)
        for name, calibration in self.calibrations.items():
            self.parameters[CORNERS.index(name)] = to_parameters(calibration)


def _read_named(path: Path) -> tuple[str | None, dict[str, str]]:
    """(DBC, calibration by corner) that a faulty configuration names all the same: their faults are told with its own."""
    try:
        content = load_yaml(path, Any)
    except InputError:
        content = None
    stated = content if isinstance(content, dict) else {}
    dbc, corners = stated.get("dbc"), stated.get("corners")
    entries = corners.items() if isinstance(corners, dict) else ()
    files = {name: entry.get("calibration") for name, entry in entries if name in CORNERS and isinstance(entry, dict)}
    return dbc if isinstance(dbc, str) else None, {name: file for name, file in files.items() if isinstance(file, str)}
