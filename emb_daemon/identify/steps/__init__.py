"""Steps of an identification, one module each: `identify` gives a `Step`, and ``section`` its part of the report."""

from dataclasses import dataclass, field

from emb_daemon.calibration.types import Struct


@dataclass(frozen=True, kw_only=True)
class Step:
    """What a step found.

    Attributes:
        values: sections of the calibration by name (``motor``, ``friction``, ...), as `Calibration` takes them.
        sigmas: standard deviations by the calibration's keys.
        notes: sentences for the report.
    """

    values: dict[str, Struct | dict] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
