"""What a fit may move: directions in the calibration's parameter space, with what is known of each beforehand.

A coordinate of the base calibration is a nuisance: a curve or a friction that is a little off must not be called an effect,
nor hide one, so every candidate is tested with all of its channel's base coordinates free.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from emb_daemon.calibration.parameters import (
    CLEARANCE,
    INERTIA,
    LOAD_FRICTION,
    OFFSET_FRICTION,
    PRESLIDING_ANGLE,
    TORQUE_CONSTANT,
    parameter,
    value_of,
)
from emb_daemon.calibration.types import Calibration
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import Effect


@dataclass(frozen=True)
class Move:
    """How a key of the calibration follows a coordinate: ``weight`` times its value, inside the key's bounds."""

    key: str
    weight: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Coordinate:
    """One number that a fit moves."""

    name: str  #: key of the calibration that it stands for
    channel: str  #: residual that it is read from
    start: float  #: its value as calibrated; zero for an effect that is off
    step: float  #: of the numerical derivative
    prior: float  #: standard deviation of what is known beforehand, about the start; infinite for a new effect's amplitude
    moves: tuple[Move, ...]  #: keys that follow it. Several coordinates of one key add up.
    low: float = -np.inf
    high: float = np.inf
    unit: str = "1"
    #: ``effect`` and ``parameter``: what it belongs to; empty for a base parameter.
    effect: str = ""
    parameter: str = ""
    log: int | None = None  #: index of the only log that it acts on, or None for all
    #: Whether what is known beforehand was only stated, and may be of another unit or place (`known_to`).
    unmeasured: bool = False

    def known_to(self, value: float, centre: float | None = None) -> float:
        """Standard deviation of what is known beforehand, as it weighs on a fit at ``value``; ``centre``: where not the start.

        What nobody has measured is right within ``prior`` or anything: far from it each power of ten is as likely as another
        (Jeffreys), so that its pull falls with the distance, and a fit does not end half way to what the data say."""
        away = value - (self.start if centre is None else centre)
        return float(np.hypot(self.prior, away)) if self.unmeasured else self.prior

    def sigma_of(self, value: float, sigma: float) -> float:
        """Standard deviation of a fitted value: one at a bound of what is searched is known no better than it has moved."""
        return max(sigma, abs(value - self.start)) if self.is_held(value) else sigma

    def is_held(self, value: float) -> bool:
        """Whether a bound holds a fitted value, which a search that stays inside comes no nearer to than a step."""
        return not self.low + self.step < value < self.high - self.step


Values = Mapping[Coordinate, float]
NOTHING: Mapping[str, float] = MappingProxyType({})

#: Base parameters, the channel that shows them, and how well they are known: standard deviation over their size.
_BASE = (
    ("stiffness.relaxation_time_s", "stiffness", 0.5),
    (TORQUE_CONSTANT, "torque", 0.03),
    (INERTIA, "torque", 0.5),
    (LOAD_FRICTION, "torque", 0.5),
    (OFFSET_FRICTION, "torque", 1.0),
    (PRESLIDING_ANGLE, "torque", 1.0),
    ("thermal.pad.conductivity_W_per_mK", "temperature", 0.15),
    ("thermal.pad.contact_conductance_W_per_m2K", "temperature", 0.5),
    ("thermal.pad.gap_conductance_W_per_m2K", "temperature", 0.5),
    ("thermal.pad.backplate_conductance_W_per_m2K", "temperature", 0.5),
    ("thermal.pad.inner_heat_share", "temperature", 0.5),
    ("thermal.pad.outer_heat_share", "temperature", 0.5),
    ("thermal.disc.heat_capacity_J_per_K", "temperature", 0.1),
    ("thermal.disc.cooling_W_per_K", "temperature", 0.5),
    ("thermal.disc.cooling_per_speed_J_per_rad_K", "temperature", 0.5),
)
#: The pads' friction as a whole, as a factor.
PAD_FRICTION = "thermal.friction.coefficient"
#: Standard deviations from zero from which a parameter was identified.
_CLEAR_OF_ZERO = 2.0
#: Factor by which units, wear and temperature change a parameter at most that was identified; beyond it something else looks
#: like it. Torque constant: suppliers grant a tenth, and 80 K more take as much from magnets (0.12 %/K). Inertia: masses stay
#: what they are, datasheets grant 15 %. Friction: greased screws have a coefficient of 0.05 to 0.2, about 0.1, and grease in
#: the frost drags several times as much. Pads: 0.2 faded, 0.5 new, about 0.35; another compound softens half or
#: twice as much. Disc: it may lose a tenth of its mass, and iron takes up a tenth more per 100 K.
TOLERATED: dict[str, float] = {
    TORQUE_CONSTANT: 1.1,
    INERTIA: 1.15,
    LOAD_FRICTION: 2.0,
    OFFSET_FRICTION: 4.0,
    PAD_FRICTION: 2.0,
    "thermal.softening.per_K": 2.0,
    "thermal.softening.history_per_K": 2.0,
    "thermal.disc.heat_capacity_J_per_K": 1.25,
}
#: The same of a torque constant that nobody has measured: a gear's loss takes up to a fifth of it, and suppliers count
#: amperes by their peak, RMS or d/q amplitude, which differ by up to a root of two.
_STATED = 0.3
#: The same over the usual size of a parameter that is zero or below this share of it: of its size nothing else is known.
_OF_USUAL, _NEXT_TO_NOTHING = 3.0, 0.3
#: A parameter that cannot be zero does not fall below this share of itself.
_LEAST = 0.1
#: The same where nothing is clamped: there inertia and presliding angle are any machine's, and the calibration to begin with
#: is a brake's or a guess; and how well these and friction are known then, over their size.
_LEAST_OF_ANY, _GUESSED = {INERTIA: 1e-3, PRESLIDING_ANGLE: 1e-4, OFFSET_FRICTION: 0.0}, 3.0
#: Curve coefficients and the pads' friction, as above; slopes of the latter over force and disc speed turn about these.
_CURVE, _FRICTION, _SLOPE = 0.1, 0.3, 0.1
_FRICTION_FORCE_N, _FRICTION_SPEED = 5000.0, 20.0
#: Each power-on finds its own contact: standard deviation of the clearance, rad.
_CLEARANCE_RAD = 0.5
#: A parameter of the stiffness path whose work is done with the heat.
HISTORY_TIME = "thermal.softening.history_time_s"
#: Pads soften with heat, never stiffen: what was calibrated holds within a third or this, and never beyond the most, 1/K.
_SOFTENING, _MOST_SOFTENING = 1e-4, 2e-3
#: Step and standard deviation of a harmonic's order, per turn. Both are small, because over many turns a small change of the
#: order turns the phase by much.
_ORDER_STEP, _ORDER = 1e-4, 0.1
#: Standard deviation of an effect's shape, at least; over its size where that is larger.
_SHAPE = 0.5


def base_coordinates(calibration: Calibration, clearances_rad: Sequence[float], stated: bool = False) -> list[Coordinate]:
    """Coordinates of the base calibration; the contact angle has one for each log, about its clearance. ``stated``: the torque
    constant is a supplier's, and a measured load tells it."""
    clearance = parameter(calibration, CLEARANCE)
    moves = (Move(clearance.key, 1.0, 0.0, np.inf),)
    result = [
        Coordinate(clearance.key, "stiffness", start, clearance.step, _CLEARANCE_RAD, moves, unit="rad", log=log)
        for log, start in enumerate(clearances_rad)
    ]
    curves = calibration.stiffness.curves
    mounted = int(np.argmin([abs(curve.pad_thickness_mm - calibration.pad_thickness_mm) for curve in curves]))
    for index in range(max(len(curve.coefficients) for curve in curves)):
        keys = [f"stiffness.curves[{n}].coefficients[{index}]" for n, c in enumerate(curves) if index < len(c.coefficients)]
        # The mounted pads' curve stands for all: pads of other thickness are off by the same share.
        keys.sort(key=lambda key: not key.startswith(f"stiffness.curves[{mounted}]"))
        if any(value_of(calibration, key) for key in keys):
            result.append(scaled_coordinate(calibration, keys, "stiffness", _CURVE))
    for name in ("per_K", "history_per_K"):
        known = parameter(calibration, f"thermal.softening.{name}")
        # A softening of zero was never identified: its prior is the usual size.
        prior = max(abs(known.value) / 3.0, _SOFTENING) if known.value else _usual(known.step)
        move = (Move(known.key, 1.0, 0.0, _MOST_SOFTENING),)
        low, high = min(0.0, known.value), max(_MOST_SOFTENING, known.value)
        result.append(Coordinate(known.key, "stiffness", known.value, known.step, prior, move, low, high, known.unit))
    if not calibration.thermal.softening.history_per_K:
        # No log has shown the history's time constant yet.
        result.append(scaled_coordinate(calibration, [HISTORY_TIME], "stiffness", 1.0))
    for key, channel, prior in _BASE:
        coordinate = scaled_coordinate(calibration, [key], channel, prior)
        if stated and key == TORQUE_CONSTANT:
            coordinate = replace(scaled_coordinate(calibration, [key], channel, _STATED), unmeasured=True)
        if key in _LEAST_OF_ANY and not calibration.contact.is_in_reach:
            known = max(_GUESSED * coordinate.start, coordinate.prior)
            coordinate = replace(coordinate, prior=known, low=_LEAST_OF_ANY[key] * coordinate.start, unmeasured=True)
        result.append(coordinate)
    return result + _friction(calibration)


def scaled_coordinate(calibration: Calibration, keys: list[str], channel: str, prior: float) -> Coordinate:
    """Keys in proportion, as multiples of their size, known to a share ``prior`` of it; the first gives the name."""
    known = [parameter(calibration, key) for key in keys]
    first = known[0]
    # A step is a thousandth of the size: of the value, or of the usual size where the value is next to nothing.
    sizes = [abs(p.value) if p.relative else _usual(p.step) for p in known]
    moves = tuple(Move(p.key, size, p.low, p.high) for p, size in zip(known, sizes, strict=True))
    start = first.value / sizes[0]
    least = _LEAST * start if first.low > 0.0 else first.low / sizes[0]
    known_to = prior * abs(start) if abs(start) > _NEXT_TO_NOTHING else prior * _OF_USUAL
    return Coordinate(first.key, channel, start, first.step / sizes[0], known_to, moves, least, first.high / sizes[0])


def _usual(step: float) -> float:
    return 1e3 * step


def _is_identified(calibration: Calibration, key: str) -> bool:
    """Whether a base parameter is clear of zero, by the standard deviation that its calibration states: a fit leaves about
    nothing of what its logs do not show."""
    sigmas = calibration.provenance.sigmas if calibration.provenance else {}
    return is_clear_of_zero(value_of(calibration, key), sigmas.get(key, 0.0))


def is_clear_of_zero(value: float, sigma: float) -> bool:
    """Whether a base parameter of this standard deviation was identified."""
    return value != 0.0 and abs(value) >= _CLEAR_OF_ZERO * sigma


def tolerated(calibration: Calibration, name: str) -> float:
    """The factor by which a base parameter changes at most; infinite for what a supplier or nobody has stated, or no log has
    shown, which may be off by anything."""
    if name not in TOLERATED or not calibration.provenance:
        return np.inf
    # The pads' friction is a factor of its table, which has a size.
    return TOLERATED[name] if name == PAD_FRICTION or _is_identified(calibration, name) else np.inf


def _friction(calibration: Calibration) -> list[Coordinate]:
    """The pads' friction table as a whole, and its slopes over force and disc speed."""
    table = calibration.thermal.friction
    coefficient = np.array(table.coefficient)
    over_force = np.array(table.force_N)[:, None, None] / _FRICTION_FORCE_N - 1.0
    over_speed = np.array(table.disc_speed_rad_per_s)[None, :, None] / _FRICTION_SPEED - 1.0
    result = []
    for name, weight, start, prior in (
        ("", np.ones_like(coefficient), 1.0, _FRICTION),
        (".over_force", over_force + np.zeros_like(coefficient), 0.0, _SLOPE),
        (".over_speed", over_speed + np.zeros_like(coefficient), 0.0, _SLOPE),
    ):
        moves = tuple(
            Move(f"thermal.friction.coefficient[{i}][{j}][{k}]", float(coefficient[i, j, k] * weight[i, j, k]), 0.0, 1.0)
            for i, j, k in np.ndindex(coefficient.shape)
        )
        low = _LEAST if start else -np.inf
        result.append(Coordinate(f"{PAD_FRICTION}{name}", "brake_torque", start, 1e-3, prior, moves, low))
    return result


def effect_coordinates(
    calibration: Calibration, effect: Effect, channel: str, reach: Mapping[str, float] = NOTHING
) -> dict[str, Coordinate]:
    """By parameter; an effect that is off starts at zero, its shapes too, until one is chosen. ``reach``: the largest that a
    machine which is no brake can have (`Bench.reach`), by unit."""
    on = calibration.effects.get(effect.name, {})
    result = {}
    for p in effect.parameters:
        known = parameter(calibration, f"effects.{effect.name}.{p.name}")
        start, step, prior = on.get(p.name, 0.0), known.step, np.inf
        if effect.harmonic and p.name == effect.harmonic.order:
            step, prior = _ORDER_STEP, _ORDER
        elif p.starts:
            prior = max(abs(start) or p.prior, _SHAPE)
        elif start:
            prior = abs(start)
        wider = reach.get(p.unit, p.high) / p.high
        low, high = p.low * wider, p.high * wider
        moves = (Move(known.key, 1.0, low, high),)
        result[p.name] = Coordinate(known.key, channel, start, step, prior, moves, low, high, p.unit, effect.name, p.name)
    return result


@lru_cache(256)
def _moves(coordinates: tuple[Coordinate, ...], log: int | None) -> tuple[dict[str, int], np.ndarray, np.ndarray]:
    """How keys follow coordinates on a log, or on all. Returns (position of each key; positions of key and coordinate, and
    weight, of each move, shape (3, moves); number of coordinates of single logs, lowest and highest of each key, shape (3,
    keys))."""
    places: dict[str, int] = {}
    moves, limits = [], {}
    for column, coordinate in enumerate(coordinates):
        if log is None or coordinate.log in (None, log):
            for move in coordinate.moves:
                place = places.setdefault(move.key, len(places))
                moves.append((place, column, move.weight))
                of_logs = limits.get(place, (0,))[0] + (coordinate.log is not None)
                limits[place] = of_logs, move.low, move.high
    return places, np.array(moves).T.reshape(3, -1), np.array([*limits.values()]).T.reshape(3, -1)


def by_key(values: Values, middle: float, log: int | None = None) -> dict[str, float]:
    """What coordinates say of the calibration's numbers. ``middle``: motor angle in rad about which harmonics are fitted, see
    `about_middle`. With a ``log`` only what acts on that; without, what acts on single logs counts with its mean."""
    places, (key, column, weight), (of_logs, lowest, highest) = _moves(tuple(values), log)
    moved_by = weight * np.fromiter(values.values(), float, len(values))[column.astype(int)]
    sums = np.bincount(key.astype(int), moved_by, len(places)) / np.maximum(of_logs, 1.0)
    found = dict(zip(places, np.minimum(np.maximum(sums, lowest), highest).tolist(), strict=True))
    for order, *parts, bounds in _HARMONICS:
        if order in places:
            least, most = (lowest[places[parts[0]]], highest[places[parts[0]]]) if parts[0] in places else bounds
            turned = _turn(*(sums[places[part]] if part in places else 0.0 for part in parts), sums[places[order]] * middle)
            found |= {part: min(max(value, least), most) for part, value in zip(parts, turned, strict=True)}
    return found


def about_middle(values: Values, middle: float) -> dict[Coordinate, float]:
    """Values as the calibration states them, with its harmonics as they are fitted.

    The motor angle counts from anywhere, so a small change of an order would turn the phase by much. Fits therefore move
    cosine and sine over the angle from the ``middle`` of those that occur."""
    result, named = dict(values), {c.name: c for c in values}
    for order, cosine, sine, _ in _HARMONICS:
        if order in named:
            keys = named[cosine], named[sine]
            found = _turn(values[keys[0]], values[keys[1]], -values[named[order]] * middle)
            result |= dict(zip(keys, found, strict=True))
    return result


def _turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    size = complex(cosine, sine) * np.exp(1j * angle)
    return float(size.real), float(size.imag)


#: Keys of order, cosine and sine of every harmonic, and the amplitudes' bounds.
_HARMONICS = [
    (
        *(f"effects.{effect.name}.{name}" for name in (effect.harmonic.order, effect.harmonic.cosine, effect.harmonic.sine)),
        (effect.parameter(effect.harmonic.cosine).low, effect.parameter(effect.harmonic.cosine).high),
    )
    for effect in REGISTRY
    if effect.harmonic
]
