"""Terms of a calibration that no catalogue holds: data, checked here, evaluated by `effects.terms`."""

from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.fields import Positive, Struct
from emb_daemon.effects.base import HOOKS
from emb_daemon.effects.terms import GATES, MEMORIES, MOST, PORTS, SHAPES, SIGNALS
from emb_daemon.errors import InvalidValue

#: Most that a term may add or subtract at a port that is no factor, in the port's unit. A millimetre of thickness or half
#: a motor turn clamps or opens the brake by itself. Torque: about what the largest force of the shipped brake needs. Current:
#: beyond the offset of any sensor. Heat: what pads that drag with 10 N m make at 100 rad/s. Forces are not limited here.
_MOST_AT = {
    "thickness": 1e-3, "motor_angle": 3.0, "torque": 1.0, "force": np.inf, "current": 5.0, "pad_heat": 1e3, "disc_heat": 1e3,
}  # fmt: skip
#: Most that it may take from a factor, and add to one that is not in `_GROWS`: a stiffness, a gear gain or a motor constant
#: twice as large is another machine's.
_FACTOR = 0.9
#: Most that it may add to these factors. Friction may grow by as much as the catalogue grants it where a motor breaks away: at
#: full speed grease resists as much. Times change severalfold with load and temperature, but beyond three times the nominal
#: value the term would be the larger part. A contact conducts heat nearly in proportion to its pressure, and air at speed
#: takes ten times as much heat as still air.
_GROWS = {
    "gear_friction": 3.0, "relaxation_time": 2.0, "heat_share": 9.0, "contact_conductance": 9.0, "gap_conductance": 9.0,
    "disc_cooling": 9.0,
}  # fmt: skip
#: Temperature (degC) from which one that multiplies counts.
_COLD_C = 20.0
#: Memories that may hold, in another drive, what they never did where the term was found.
REMEMBERING = ("lag", "deficit", "response", "peak")


if TYPE_CHECKING:
    _Port: TypeAlias = str
    _Signal: TypeAlias = str
    _Memory: TypeAlias = str
    _Shape: TypeAlias = str
    _Gate: TypeAlias = str
else:
    # Words that a file may use, from the tables of `effects.terms`; type checkers accept no computed Literal.
    _Port, _Signal, _Memory, _Shape, _Gate = (Literal[tuple(w)] for w in (PORTS, SIGNALS, MEMORIES, SHAPES, GATES))


class Term(Struct, kw_only=True):
    """A term that `emb-daemon diagnose` made for a residual that no effect of the catalogue explains.

    It adds coefficient × shape(u) × gate × share of the other signal at one port of the physics. Here u = (z − centre)/scale,
    and z is the signal after its memory."""

    #: Name; begins with ``term:``.
    name: Annotated[str, Meta(pattern="^term:.+")]
    #: Quantity to which the term adds. The coefficient has the unit of this port (`effects.base.HOOKS`).
    port: _Port
    #: Signal of which the term is a function.
    signal: _Signal
    #: none: z is the signal; lag: z is the signal through a first-order lag of time constant memory_scale, s; deficit: z is
    #: that lag's output minus the signal; slip: z is the state, -1 to 1, of a Maxwell slip element of stretch memory_scale, in
    #: the signal's unit; response: z is the signal, and the lag acts on the output of the shape, as heat follows the power
    #: that makes it; peak: z is the lag's output, but follows a rise at once, as what a material remembers of its largest
    #: strain.
    memory: _Memory = "none"
    #: constant: 1; odd_power: sign(u)|u|^exponent; even_power: |u|^exponent; saturation: u/(1 + |u|); decay: exp(−|u|); onset:
    #: max(u, 0); harmonic: coefficient cos u + sine sin u; bump: exp(−u²).
    shape: _Shape
    #: When the term acts: always, while closing, opening, turning or standing; load: always, multiplied by the clamp force
    #: over the largest force.
    gate: _Gate = "always"
    #: Size of the term, in the port's unit.
    coefficient: float
    #: Coefficient of sin u of a harmonic.
    sine: float = 0.0
    #: Standard deviation of the coefficient.
    sigma: Annotated[float, Meta(ge=0.0)] = 0.0
    #: Scale of u, in the signal's unit.
    scale: Positive = 1.0
    #: Signal at which u is zero, in the signal's unit.
    centre: float = 0.0
    #: Exponent of odd_power and even_power.
    exponent: Annotated[float, Meta(gt=0.0, le=4.0)] = 1.0
    #: Time constant, s; of a slip element its stretch, in the signal's unit.
    memory_scale: Positive = 1.0
    #: Low end of the range of the signal in which the term was found. Outside the range the term goes on as it is shaped for a
    #: quarter of the range's width and is held from there on, and the force's standard deviation grows.
    low: float
    #: High end of that range.
    high: float
    #: Low end of the range of what it remembered where it was found: z of a lag, a deficit or a peak, which is held as the
    #: signal is; the output of a response, which goes on. Outside of it sigma grows. None: the range is not known.
    memory_low: float | None = None
    #: High end of that range.
    memory_high: float | None = None
    #: A second signal, to which the term is proportional: to its size, for a temperature to the distance above 20 °C. The
    #: hidden state of a response follows the product.
    other: _Signal | None = None
    #: The largest value of that signal at which the term was found, in its unit: there the term acts in full. It goes on to
    #: rise for another quarter, and sigma grows.
    other_high: float = 0.0
    #: Date and logs from which the term was found.
    provenance: str = ""

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InvalidValue("high: expected more than low")
        if (self.memory_low, self.memory_high) != (None, None):
            if self.memory not in REMEMBERING:
                raise InvalidValue(f"memory_low: only a memory of {', '.join(REMEMBERING)} has a range")
            if self.memory_low is None or self.memory_high is None or not self.memory_low < self.memory_high:
                raise InvalidValue("memory_high: expected more than memory_low")
        if self.sine and self.shape != "harmonic":
            raise InvalidValue("sine: only a harmonic has one")
        if self.other and not self.other_high > self.other_from:
            raise InvalidValue(f"other_high: expected more than {self.other_from:g}")
        if not self.is_bounded:
            least, most = self.reach
            beyond, kind = (most, f"{self.growth:g} at most") if most > self.growth else (least, f"{-self.limit:g} at least")
            raise InvalidValue(f"coefficient: the term reaches {beyond:.3g} {self.unit}, expected {kind}")

    @property
    def unit(self) -> str:
        """Unit of the coefficient."""
        return HOOKS[self.port].unit

    @property
    def other_from(self) -> float:
        """Size at which the other signal is nothing, in its unit."""
        return _COLD_C if self.other and SIGNALS[self.other] == "°C" else 0.0

    @property
    def limit(self) -> float:
        """Most that it may subtract, in the port's unit."""
        return _MOST_AT.get(self.port, _FACTOR)

    @property
    def growth(self) -> float:
        """Most that it may add, in the port's unit."""
        return _GROWS.get(self.port, self.limit)

    @property
    def is_held(self) -> bool:
        """Whether the kernel limits it within its range: what a response reaches depends on how long its signal lasts, and two
        signals are hardly at their largest at once, so that `reach` would be too wide a bound."""
        return self.memory == "response" or self.other is not None

    @property
    def is_bounded(self) -> bool:
        """Whether it stays within its limits."""
        least, most = self.reach
        return self.is_held or (least >= -self.limit and most <= self.growth)

    @property
    def reach(self) -> tuple[float, float]:
        """Least and most that it can add inside its range, in the port's unit; zero lies between them."""
        ends = (self.low, self.high)
        if self.memory == "slip":
            ends = (-1.0, 1.0)
        elif self.memory == "deficit":
            ends = (self.low - self.high, self.high - self.low)
        first, last = ((end - self.centre) / self.scale for end in ends)
        if self.shape == "harmonic":
            size = float(np.hypot(self.coefficient, self.sine))
            return -size, size
        shaped = {
            "odd_power": tuple(float(np.copysign(abs(u) ** self.exponent, u)) for u in (first, last)),
            "even_power": (0.0, max(abs(first), abs(last)) ** self.exponent),
            "onset": (0.0, max(last, 0.0)),
            "saturation": (-1.0 if first < 0.0 else 0.0, 1.0 if last > 0.0 else 0.0),
        }.get(self.shape, (0.0, 1.0))
        added = [0.0, *(self.coefficient * value for value in shaped)]
        return min(added), max(added)


def fill_terms(record: np.void, terms: tuple[Term, ...]) -> None:
    """Write terms into an `effects.terms.PARAMETERS` record."""
    record["count"] = len(terms)
    for row, term in zip(record["term"][: len(terms)], terms, strict=True):
        row["port"], row["signal"] = PORTS.index(term.port), list(SIGNALS).index(term.signal)
        row["memory"], row["shape"] = MEMORIES.index(term.memory), SHAPES.index(term.shape)
        row["gate"] = GATES.index(term.gate)
        row["other"] = list(SIGNALS).index(term.other) if term.other else -1
        row["other_from"], row["other_high"] = term.other_from, term.other_high
        for name in ("coefficient", "sine", "sigma", "scale", "centre", "exponent", "memory_scale", "low", "high"):
            row[name] = getattr(term, name)
        known = term.memory_low is not None
        row["memory_low"], row["memory_high"] = (term.memory_low, term.memory_high) if known else (-np.inf, np.inf)
        least, most = term.reach
        # Within its range it is what it is, as long as a fit asks whether its port may bear that; beyond, no more than that.
        inside = (0.0, 0.0) if term.is_held else (-least, most)
        row["limit"], row["growth"] = max(term.limit, inside[0]), max(term.growth, inside[1])
        row["most"] = max(min(-least, row["limit"]), min(most, row["growth"]))


def faults_of(terms: tuple[Term, ...]) -> list[str]:
    """Faults of all terms together."""
    names = [term.name for term in terms]
    faults = [f"terms: {name} occurs twice" for name in sorted(set(names)) if names.count(name) > 1]
    if len(terms) > MOST:
        faults.append(f"terms: {len(terms)}, expected {MOST} at most")
    return faults
