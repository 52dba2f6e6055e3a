"""Steps of an identification, one module each: `identify` gives a `Step`, and ``section`` its part of the report."""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Step:
    """What a step found: numbers and their standard deviations by the calibration's keys, and sentences for the report."""

    values: dict[str, float] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
