"""The daemon's configuration file: bus, corners, folders, real-time settings."""

import difflib
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import Calibration, Struct, to_parameters
from emb_daemon.errors import InputError, InputErrors, InvalidValue
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.wire.layout import CORNERS, load_layout


class Bus(Struct, kw_only=True):
    """The CAN bus, in python-can's words; the command line and CAN_* variables come before it."""

    #: python-can's name of the interface, such as socketcan.
    interface: str | None = None
    #: Such as can0.
    channel: str | None = None
    #: In bit/s, for interfaces that set it.
    bitrate: Annotated[int, Meta(gt=0)] | None = None

    def __post_init__(self):
        from can.interfaces import VALID_INTERFACES

        if self.interface is not None and self.interface not in VALID_INTERFACES:
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
    realtime: Realtime = Realtime()
    #: What the journal gets: debug, info, warning or error.
    log_level: Annotated[str, Meta(pattern="^(debug|info|warning|error)$")] = "info"


class Setup:
    """A configuration with everything that it names, loaded and checked.

    Attributes:
        calibrations: by corner name.
        parameters: PARAMETERS array, shape (4,).
        layout: LAYOUT array, shape (1,).
    """

    def __init__(self, path: Path):
        """Raises InputErrors with every fault of configuration, calibrations and DBC."""
        self.path = Path(path)
        self.configuration = load_yaml(self.path, Configuration)
        faults: list[str] = []
        folder = self.path.parent
        try:
            dbc = self.configuration.dbc
            self.layout = load_layout(folder / dbc if dbc else None, tuple(self.configuration.corners))
        except InputErrors as error:
            faults += error.faults
        except InputError as error:
            faults.append(str(error))
        self.calibrations: dict[str, Calibration] = {}
        self.parameters = np.zeros(4, PARAMETERS)
        loaded: dict[Path, Calibration | None] = {}
        for name, corner in self.configuration.corners.items():
            file = folder / corner.calibration
            if file not in loaded:
                loaded[file] = None
                try:
                    loaded[file] = load_calibration(file)
                except InputErrors as error:
                    faults += error.faults
            if loaded[file] is not None:
                self.calibrations[name] = loaded[file]
                self.parameters[CORNERS.index(name)] = to_parameters(loaded[file])
        if faults:
            raise InputErrors(faults)
