"""The grammar: every term that is looked for where no effect of the catalogue explains the rest, enumerated and typed.

What may act where is physics, not taste: elastic ports follow states and work done, never the sign of motion alone, so that no
term is a source of energy; friction is a factor on friction, which always opposes motion, or a torque odd in motor speed;
lags are stable by construction. Sizes are shares of what the signals cover in these logs.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from emb_daemon.calibration.terms import Term
from emb_daemon.effects.base import HOOKS, Effect, Parameter
from emb_daemon.effects.terms import PORTS, SIGNALS

#: Temperature (degC) at which a term that follows one is nothing.
_COLD_C = 20.0
_MOTOR_HEAT = ("winding_heat", "housing_heat")
#: Those that a car estimates, or measures, near the pads.
TEMPERATURES = ("surface_temperature", "pad_temperature", "disc_temperature", "caliper_temperature")
_SLOW = (
    *TEMPERATURES, "disc_speed", "brake_torque", "friction_power", "energy", "time_clamped", "time_since_last_clamp"
)  # fmt: skip
#: Signals by port: states at elastic ports, speeds where something slides.
_TYPED: dict[str, tuple[str, ...]] = {
    "thickness": (*_SLOW, "clamp_force"),
    "motor_angle": ("motor_angle", "current"),
    "stiffness": (*_SLOW, "travel", "clamp_force"),
    "force": ("clamp_force",),
    "torque_constant": ("current", *_MOTOR_HEAT, *TEMPERATURES),
    "torque": ("motor_speed", "motor_angle"),
    "current": ("energy", *_MOTOR_HEAT, *TEMPERATURES),
    "relaxation_time": (*TEMPERATURES, "clamp_force", "disc_speed", "brake_torque"),
    "pad_friction": (
        "surface_temperature",
        "pad_temperature",
        "disc_temperature",
        "disc_speed",
        "clamp_force",
        "friction_power",
        "energy",
    ),
    "gear_gain": ("clamp_force", "motor_angle", "travel", "brake_torque", *TEMPERATURES),
    "gear_friction": ("motor_speed", "clamp_force", "motor_angle", "travel", *_MOTOR_HEAT, *_SLOW),
    "heat_share": ("clamp_force", "disc_speed", "surface_temperature", "disc_temperature", "friction_power", "energy"),
    "contact_conductance": ("clamp_force", "disc_speed", "surface_temperature", "disc_temperature", "energy"),
    "gap_conductance": ("disc_speed", "disc_temperature", "surface_temperature", "time_since_last_clamp"),
    "pad_conductivity": ("clamp_force", "pad_temperature", "energy"),
    "disc_cooling": ("disc_speed", "disc_temperature", "clamp_force", "energy"),
    "pad_heat": ("disc_speed", "time_since_last_clamp"),
    "disc_heat": ("disc_speed", "time_since_last_clamp"),
}
#: Signals of which a port follows the largest of late and nothing else: pads remember how fast they were pressed, but a motion
#: by itself is no elastic state.
_REMEMBERED: dict[str, tuple[str, ...]] = {"thickness": ("motor_speed",), "stiffness": ("motor_speed",)}
#: Ports at which there are forms.
FORMED = tuple(_TYPED)
_GATES: dict[str, tuple[str, ...]] = {
    "thickness": ("always", "turning"),
    "stiffness": ("always", "load", "turning"),
    "torque": ("always", "load", "closing", "opening"),
    "gear_friction": ("always", "load", "closing", "opening"),
}
#: Ports at which two signals may multiply: factors and lengths. Signals in `_ALONE` are not multiplied: those that count from
#: power-on have no physical zero, and dependence on the place along the screw is covered by bumps.
_MULTIPLIED = (
    "thickness", "stiffness", "torque_constant", "relaxation_time", "gear_gain", "gear_friction", "heat_share",
    "contact_conductance", "disc_cooling",
)  # fmt: skip
_ALONE = ("motor_angle", "travel", "energy", "time_clamped", "time_since_last_clamp")
#: Exponents of powers; scales of what saturates or decays, as shares of a signal's range; places along it; s.
_EXPONENTS, _SCALES, _PLACES, _TIMES_S = (0.5, 1.0, 2.0), (0.03, 0.1, 0.3), (0.25, 0.5), (2.0, 10.0, 50.0)
#: Times (s) in which the largest value of a signal is forgotten: within a drive, and hardly.
_FORGOTTEN_S = (10.0, 1000.0)
_CREEP_S, _SLIPS, _BUMPS = (0.5, 3.0, 15.0, 60.0), (0.03, 0.1, 0.3), 16
#: Bounds of a fitted size over the one that was tried, and its standard deviation over it.
_WIDER, _SHAPE = 8.0, 0.5
#: A small coefficient by port, in its unit; of a factor a thousandth.
_STEPS = {
    "thickness": 1e-6, "motor_angle": 1e-3, "force": 1.0, "torque": 1e-4, "current": 1e-2, "pad_heat": 0.1, "disc_heat": 0.1,
}  # fmt: skip


@dataclass(frozen=True)
class Form:
    """Structure of a term, with its sizes as tried. ``straight``: the exponent is one, and no number to be found."""

    port: str
    signal: str
    memory: str
    shape: str
    gate: str
    scale: float
    centre: float
    exponent: float
    memory_scale: float
    low: float
    high: float
    other: str | None = None
    other_high: float = 0.0
    straight: bool = False

    @property
    def signals(self) -> tuple[str, ...]:
        """What it follows."""
        return (self.signal, self.other) if self.other else (self.signal,)

    @property
    def means(self) -> tuple[str, str]:
        """What it says: port and signals."""
        return self.port, " times ".join(sorted(self.signals))

    @property
    def fitted(self) -> tuple[str, ...]:
        """Sizes that are fitted beside the coefficients."""
        own = {
            "odd_power": ("exponent",), "even_power": ("exponent",), "saturation": ("scale",), "decay": ("scale",),
            "onset": ("centre",), "harmonic": ("scale",), "bump": ("centre", "scale"),
        }.get(self.shape, ())  # fmt: skip
        own = () if self.straight else own
        if self.memory == "none":
            return own
        if self.memory == "peak" or (self.memory == "lag" and self.signal != "clamp_force"):
            return (*own, "memory_scale")
        return ("memory_scale",) if self.shape == "odd_power" else (*own, "memory_scale")

    @property
    def numbers(self) -> int:
        """How many numbers it takes to state it: coefficients, sizes, and those beside them."""
        return 1 + (self.shape == "harmonic") + len(self.fitted) + further_numbers(self)

    def is_physical(self, coefficient: float) -> bool:
        """Whether physics allows the coefficient its sign: heat strengthens no magnet."""
        strengthens = coefficient > 0.0 if self.shape != "decay" else coefficient < 0.0
        return not (strengthens and self.port == "torque_constant" and {*self.signals} <= {*_MOTOR_HEAT, *TEMPERATURES})

    @property
    def step(self) -> float:
        """A small coefficient, in the port's unit."""
        return _STEPS.get(self.port, 1e-3)

    @property
    def amplitudes(self) -> tuple[float, float]:
        """Bounds of the coefficient. A heat balance has them while it is fitted: next to nothing times very much would be as
        good a conductance as what it is times a little."""
        if HOOKS[self.port].channel != "temperature":
            return (-np.inf if self.is_physical(-1.0) else 0.0), (np.inf if self.is_physical(1.0) else 0.0)
        tried = self.term(coefficient=self.step)
        shaped = tried.reach[1] / self.step
        return -tried.limit / shaped, tried.growth / shaped

    def term(self, name: str = "term:tried", coefficient: float = 0.0, sine: float = 0.0) -> Term:
        sizes = {key: getattr(self, key) for key in ("scale", "centre", "exponent", "memory_scale", "low", "high")}
        return Term(
            name=name, port=self.port, signal=self.signal, memory=self.memory, shape=self.shape, gate=self.gate,
            coefficient=coefficient, sine=sine, other=self.other, other_high=self.other_high, **sizes,
        )  # fmt: skip

    def bounds(self, size: str) -> tuple[float, float, float]:
        """(low, high, standard deviation) of a fitted size."""
        tried = getattr(self, size)
        if size == "centre":
            return self.low, self.high, 0.25 * (self.high - self.low)
        if size == "exponent":
            return 0.25, 4.0, _SHAPE
        if self.shape == "harmonic" and size == "scale":
            return 0.8 * tried, 1.25 * tried, 0.02 * tried
        return tried / _WIDER, tried * _WIDER, _SHAPE * tried


def further_numbers(of: Form | Term) -> int:
    """How many numbers it takes to state a form or a term beside coefficients and sizes: one for a gate, two for a second
    signal, which is one of many, and where a count began: no brake's physics starts at zero with the power."""
    counted = of.signal in ("energy", "time_since_last_clamp")
    return (of.gate != "always") + 2 * (of.other is not None) + counted


def enumerate_forms(covered: Mapping[str, tuple[float, float]], ports: tuple[str, ...]) -> list[Form]:
    """All terms at some ports but harmonics, whose orders are scanned. ``covered``: range of each signal that varies."""
    found = []
    for port in ports:
        for signal in (*_TYPED.get(port, ()), *_REMEMBERED.get(port, ())):
            if signal not in covered:
                continue
            low, high = covered[signal]
            for gate in _GATES.get(port, ("always",)):
                for memory, shape, scale, centre, exponent, memory_scale in _shapes(port, signal, low, high):
                    found.append(Form(port, signal, memory, shape, gate, scale, centre, exponent, memory_scale, low, high))
    return found


def enumerate_products(covered: Mapping[str, tuple[float, float]], ports: tuple[str, ...]) -> list[Form]:
    """Terms that follow what a shape makes of one signal times another, at once or slowly."""
    found = []
    for port in (port for port in ports if port in _MULTIPLIED):
        signals = [signal for signal in _TYPED[port] if signal in covered and signal not in _ALONE]
        for signal, other in permutations(signals, 2):
            low, high = covered[signal]
            centre, nothing = (_COLD_C if name in TEMPERATURES else 0.0 for name in (signal, other))
            most = max(map(abs, covered[other])) if not nothing else covered[other][1]
            farthest = max(abs(low - centre), abs(high - centre))
            if most <= nothing:
                continue
            power = "even_power" if low < 0.0 and not centre else "odd_power"
            shapes = [("none", power, farthest, centre, exponent, 1.0) for exponent in _EXPONENTS]
            shapes.append(("none", "onset", high - low, low + _PLACES[0] * (high - low), 1.0, 1.0))
            times = _TIMES_S if HOOKS[port].channel != "temperature" else ()
            shapes += [("response", "even_power", farthest, centre, 1.0, time) for time in times]
            for memory, shape, scale, middle, exponent, time in shapes:
                form = Form(port, signal, memory, shape, "always", scale, middle, exponent, time, low, high, other, most)
                straight = shape != "onset" and exponent == 1.0
                found += [form] if memory == "response" or not straight else []
                # The product of two signals, neither shaped, is the same in both orders: once is enough.
                found += [replace(form, straight=True)] if straight and signal < other else []
    return found


def places(ports: Iterable[str]) -> int:
    """How many pairs of port and signal there are at some ports: what says where a term acts and what it follows is one of
    these."""
    return sum(len(_TYPED.get(port, ())) + len(_REMEMBERED.get(port, ())) for port in ports)


def harmonic(port: str, order: float, centre: float, covered: Mapping[str, tuple[float, float]]) -> Form:
    """A ripple over the motor angle."""
    low, high = covered["motor_angle"]
    return Form(port, "motor_angle", "none", "harmonic", "always", 1.0 / order, centre, 1.0, 1.0, low, high)


def rippling(ports: tuple[str, ...]) -> tuple[str, ...]:
    """Ports that may ripple over the motor angle."""
    return tuple(port for port in ports if "motor_angle" in _TYPED.get(port, ()))


_Shape = tuple[str, str, float, float, float, float]


def _shapes(port: str, signal: str, low: float, high: float) -> Iterator[_Shape]:
    """(memory, shape, scale, centre, exponent, memory scale) of what a signal may do at a port."""
    width, reach = high - low, max(abs(low), abs(high))
    if signal == "motor_angle" or signal == "travel":
        for place in np.linspace(low, high, _BUMPS)[1:-1]:
            for share in (0.03, 0.1):
                yield "none", "bump", share * width, float(place), 1.0, 1.0
        return
    if port == "torque_constant" and signal == "current":
        # The current itself, not lagged: saturation shows while the motor accelerates, and lagged the term would look like a
        # gear gain over the force. That the torque path's residual is a current itself does no harm, because the column of the
        # constant takes up what both share.
        for exponent in _EXPONENTS:
            yield "none", "even_power", reach, 0.0, exponent, 1.0
        yield from _responses(reach)
        for share in _SCALES:
            yield "none", "decay", share * reach, 0.0, 1.0, 1.0
        return
    centre = _COLD_C if signal in TEMPERATURES else 0.0
    farthest = max(abs(low - centre), abs(high - centre))
    if signal in _REMEMBERED.get(port, ()):
        yield from _peaks(high, centre)
        return
    if HOOKS[port].channel == "temperature":
        # Temperatures are lagged already: no further memory.
        yield from (("none", "odd_power", farthest, centre, exponent, 1.0) for exponent in _EXPONENTS)
        yield from (("none", "decay", share * reach, 0.0, 1.0, 1.0) for share in _SCALES)
        yield from (("none", "onset", width, low + place * width, 1.0, 1.0) for place in _PLACES)
        return
    if port == "force":
        for time in _CREEP_S:
            yield "deficit", "odd_power", reach, 0.0, 1.0, time
        return
    if signal == "clamp_force" and port in ("thickness", "stiffness"):
        # A function of the force alone is the calibration's curve; what is looked for is how the force was reached.
        for share in _SLIPS:
            yield "slip", "odd_power", 1.0, 0.0, 1.0, share * width
        for time in _CREEP_S:
            yield "lag", "odd_power", reach, 0.0, 1.0, time
        yield from _peaks(reach, centre)
        return
    yield from _of_others(port, signal, low, high, centre)


def _of_others(port: str, signal: str, low: float, high: float, centre: float) -> Iterator[_Shape]:
    """`_shapes` of signals that are like any other at their port."""
    width, reach, farthest = high - low, max(abs(low), abs(high)), max(abs(low - centre), abs(high - centre))
    signed = low < 0.0 and signal not in TEMPERATURES
    even = port in ("torque_constant", "gear_friction", "gear_gain") and signed
    for exponent in _EXPONENTS:
        yield "none", "even_power" if even else "odd_power", farthest, centre, exponent, 1.0
    for share in _SCALES:
        yield "none", "saturation" if signed and not even else "decay", share * reach, 0.0, 1.0, 1.0
    if even:
        yield from _responses(reach)
    if signed:
        return
    for place in _PLACES:
        yield "none", "onset", width, low + place * width, 1.0, 1.0
    if signal in (*TEMPERATURES, "disc_speed", "brake_torque", "friction_power", "clamp_force"):
        for time in _TIMES_S:
            yield "lag", "odd_power", farthest, centre, 1.0, time
        yield from _peaks(farthest, centre)
    if signal in ("disc_speed", "brake_torque", "friction_power", "clamp_force"):
        # A response to the first power of a signal is the lag above.
        yield from _responses(reach, (2.0,))
        for time in _TIMES_S:
            for place in _PLACES:
                yield "response", "onset", width, low + place * width, 1.0, time
            yield "response", "decay", _SCALES[-1] * reach, 0.0, 1.0, time


def _peaks(reach: float, centre: float) -> Iterator[_Shape]:
    """What follows the largest value of late."""
    for time in _FORGOTTEN_S:
        yield "peak", "odd_power", reach, centre, 1.0, time


def _responses(reach: float, exponents: tuple[float, ...] = _EXPONENTS) -> Iterator[_Shape]:
    """What follows slowly on a signal, whatever its sign: heat, or a film, is driven by a power of its size."""
    for exponent in exponents:
        for time in _TIMES_S:
            yield "response", "even_power", reach, 0.0, exponent, time


def made_effect(form: Form, name: str) -> Effect:
    """The term as an entry of the catalogue would be, for reports."""
    unit, parameters = HOOKS[form.port].unit, [Parameter("coefficient", HOOKS[form.port].unit, -np.inf, np.inf, form.step, "")]
    if form.shape == "harmonic":
        parameters.append(Parameter("sine", unit, -np.inf, np.inf, form.step, ""))
    own = SIGNALS[form.signal]
    units = {"scale": own, "centre": own, "exponent": "1", "memory_scale": own if form.memory == "slip" else "s"}
    for size in form.fitted:
        low, high, _ = form.bounds(size)
        parameters.append(Parameter(size, units[size], low, high, getattr(form, size), "", (getattr(form, size),)))
    return Effect(
        name=name,
        hook=form.port,
        term=lambda: 0.0,
        parameters=tuple(parameters),
        equation=equation(form.term()),
        source="found in these logs; nobody has explained it yet",
        signal=form.signal,
    )


_QUANTITY = {
    "thickness": "pads and disc, m", "motor_angle": "θ", "stiffness": "stiffness", "force": "F", "torque_constant": "K_m",
    "torque": "T_m", "gear_gain": "γ", "gear_friction": "T_f", "pad_friction": "μ",
    "current": "I", "relaxation_time": "τ", "heat_share": "pads' heat share", "contact_conductance": "h_contact",
    "gap_conductance": "h_gap", "pad_conductivity": "λ", "disc_cooling": "h_disc", "pad_heat": "Q_pads", "disc_heat": "Q_disc",
}  # fmt: skip


def equation(term: Term) -> str:
    """A term as an engineer writes it, with its numbers and units."""
    own, quantity = SIGNALS[term.signal], _QUANTITY[term.port]
    x = term.signal.replace("_", " ")
    z = {
        "none": x,
        "response": x,
        "lag": f"[{x} through a lag of {term.memory_scale:.3g} s]",
        "deficit": f"[what of {x} is still to come with {term.memory_scale:.3g} s, negative]",
        "peak": f"[largest {x}, forgotten in {term.memory_scale:.3g} s]",
        "slip": f"[slip of {x}, ±1 within {term.memory_scale:.3g} {own}]",
    }[term.memory]
    times = ""
    if term.other:
        # Its size, a temperature's from where it is nothing.
        least = f" − {term.other_from:g}" if term.other_from else ""
        y = f"{term.other.replace('_', ' ')}{least}"
        times = f" × ({y})/{term.other_high - term.other_from:.3g} {SIGNALS[term.other]}"
    place = f" − {term.centre:.4g}" if term.centre and term.shape != "harmonic" else ""
    u = f"({z}{place})/{term.scale:.3g}{'' if term.memory == 'slip' else ' ' + own}"
    shaped = {
        "constant": "1",
        "odd_power": u if abs(term.exponent - 1.0) < 0.005 else f"[{u}]^{term.exponent:.2g}",
        "even_power": f"|{u}|^{term.exponent:.2g}",
        "saturation": f"u/(1 + |u|), u = {u}",
        "decay": f"exp(−|{u}|)",
        "onset": f"max({u}, 0)",
        "harmonic": f"cos and sin of {1.0 / term.scale:.4g} × {x}",
        "bump": f"exp(−[{u}]²)",
    }[term.shape]
    if term.memory == "response":
        shaped, times = f"lag of {term.memory_scale:.3g} s of {shaped}{times}", ""
    gate = times + {"always": "", "load": " × F/F_max"}.get(term.gate, f", {term.gate}")
    coefficient = float(np.hypot(term.coefficient, term.sine)) if term.shape == "harmonic" else term.coefficient
    size = f"{abs(coefficient):.3g}" if coefficient else "c"
    sign = "−" if coefficient < 0.0 else "+"
    factor = HOOKS[term.port].unit == "1"
    unit = "" if factor else f" {term.unit}"
    return f"{quantity} × (1 {sign} {size} · {shaped}{gate})" if factor else f"{quantity} {sign} {size}{unit} · {shaped}{gate}"


assert all(port in PORTS and signal in SIGNALS for port, own in _TYPED.items() for signal in own)
