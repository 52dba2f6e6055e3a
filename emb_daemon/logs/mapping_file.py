"""What stands in a mapping file, and what one of its lines makes of the rig's values."""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta, field

from emb_daemon.calibration.fields import NonNegative, Positive, Struct
from emb_daemon.logs.series import Series
from emb_daemon.logs.stamps import held_rows
from emb_daemon.wire.units import UNITS, conversion, known_as


class Mapped(Struct, kw_only=True):
    """Where one of our signals comes from: a signal of the rig, or a constant."""

    #: Message.Signal of the rig's DBC; without a DBC, the name of a column or channel.
    signal: str | None = None
    #: Which of `buses` carries it, if there are any.
    bus: str | None = None
    #: Its unit, where the rig's DBC states none or a wrong one; always for columns and channels.
    unit: str | None = None
    #: ours = scale * (theirs, in our unit) + offset; -1 turns a direction round.
    scale: float = 1.0
    #: In our unit.
    offset: float = 0.0
    #: What the value jumps by where it starts anew, in the rig's unit: 360 of an angle in degrees within one turn, 65536 of a
    #: number of 16 bits that was written without its sign. Between two samples an angle must move by less than half of it.
    period: Positive | None = None
    #: Time over which the value is a mean that ends with its stamp, ms, and twice the delay of a filter; 0 is a value of the
    #: moment. Left out it is 0, and a sampling period for CurrentQ: a mean since the last frame, as on our bus.
    mean_ms: NonNegative | None = None
    #: A constant in our unit, for what the rig does not measure.
    value: float | None = None

    def __post_init__(self) -> None:
        if (self.signal is None) == (self.value is None):
            raise ValueError("expected either signal (of the rig) or value (a constant)")
        others = (self.unit, self.bus, self.period, self.mean_ms, self.scale, self.offset)
        if self.value is not None and others != (None, None, None, None, 1.0, 0.0):
            raise ValueError("value: stands alone, in our unit")
        if self.scale == 0.0:
            raise ValueError("scale: 0 leaves nothing of the signal")


class Time(Struct, kw_only=True):
    """The column of times of a table, or how often a row was written."""

    #: Name of the column.
    signal: str | None = None
    #: s, ms, us, ns, min, h or d: a spreadsheet counts days.
    unit: str = "s"
    #: Of a table without such a column: rows per second. Of one that counts instead of telling a time: counts per second.
    rate_Hz: Positive | None = None
    #: Of a table that has one value in a row: the column that names what was measured; `signals` then has such names.
    name: str | None = None
    #: Of such a table: the column of values.
    value: str | None = None

    def __post_init__(self) -> None:
        if (self.name is None) != (self.value is None) or (self.name is not None and self.signal is None):
            raise ValueError("expected name, value and signal together: the columns of a table with one value in a row")
        if self.signal is None and self.rate_Hz is None:
            raise ValueError("expected signal (a column), rate_Hz (rows per second), or both (a column's counts per second)")
        if self.rate_Hz is not None and self.unit != "s":
            raise ValueError("unit: counts have none; expected unit or rate_Hz")
        if UNITS.get(self.unit, ("",))[0] != "s":
            raise ValueError(f"unit: expected s, ms, us, ns, min, h or d, found {self.unit!r}")


class Bus(Struct, kw_only=True):
    """One of several CAN buses."""

    #: Its DBC, ARXML or KCD, relative to this file.
    dbc: str
    #: Its channel as the log names it: can1 of candump, 1 of Vector's CAN 1; live, the one to open. Left out, it may be any.
    channel: str | int | None = None


class MappingFile(Struct, kw_only=True):
    """mapping.yaml."""

    #: Version of this file format.
    format: Annotated[int, Meta(ge=1, le=1)]
    #: The rig's DBC, ARXML or KCD, relative to this file; left out for tables and measurements.
    dbc: str | None = None
    #: Instead of `dbc`, of a rig with several buses: by a name of yours.
    buses: dict[str, Bus] = field(default_factory=dict)
    #: Of a table or of arrays; channels of an MDF measurement have times of their own.
    time: Time | None = None
    #: Our Message.Signal (dbc/emb.dbc, and dbc/rig.dbc for references): where it comes from.
    signals: dict[str, Mapped]

    def __post_init__(self) -> None:
        if self.dbc is not None and self.buses:
            raise ValueError("buses: each has a dbc of its own; expected dbc or buses")
        if (self.dbc is not None or self.buses) and self.time is not None:
            raise ValueError("time: the frames of a CAN log have theirs; expected one of dbc, buses and time")


class Source:
    """One foreign signal of a bus (None: the only one), its ``name`` in a DBC ``message`` and ``signal``, and how it becomes
    ours: ``scale`` and ``offset`` from the rig's ``unit`` to our ``target``, ``span_ns`` None is a sampling period. Raises
    InputError: the unit cannot become ours."""

    def __init__(self, mapped: Mapped, unit: str, target: str, span_ns: float | None):
        self.name: str = mapped.signal
        self.unit = unit
        self.target = target
        self.bus: str | None = mapped.bus
        self.period: float | None = mapped.period
        message, _, signal = mapped.signal.rpartition(".")
        self.message: str = message
        self.signal: str = signal
        factor, shift = conversion(unit, target)
        self.scale: float = mapped.scale * factor
        self.offset: float = mapped.scale * shift + mapped.offset
        self._shifted = mapped.offset != 0.0
        self.span_ns = span_ns

    def questioned(self, stated: str) -> str:
        """A question if the unit that the rig states makes other values of the signal; a scale of that same unit is meant."""
        own = known_as(stated)
        if own and (UNITS[own][0], self.target) == ("Nm", "N") and UNITS[own][1] != 1.0:
            return f"{self.name} says {own}, and an N·m is {1.0 / UNITS[own][1]:.4g} of it: is that in `scale`?"
        if not own or UNITS[own][0] != UNITS[self.target][0]:
            return ""
        factor, zero = conversion(own, self.target)
        as_stated = conversion(self.unit, self.target) == (factor, zero)
        as_scaled = math.isclose(abs(self.scale), factor, rel_tol=1e-3) and (self._shifted or self.offset == zero)
        return "" if as_stated or as_scaled else f"{self.name} says {own} and is taken in {self.unit}: which is right?"

    @property
    def goes_on(self) -> bool:
        """Whether it goes on beyond its ``period``, as an angle does; a number without its sign does not."""
        return self.target == "rad"

    def converted(self, time_ns: np.ndarray, values: np.ndarray) -> Series:
        series = Series.of(time_ns, values)
        if (sampled := held_rows(series.values)) is not None:
            series = Series(series.time_ns[sampled], series.values[sampled])
        values = series.values
        if self.period is not None and len(values):
            whole = np.rint((values[:1] if self.goes_on else values) / self.period) * self.period
            values = (np.unwrap(values, period=self.period) if self.goes_on else values) - whole
        return Series(series.time_ns, self.scale * values + self.offset).averaged(self.span_ns)
