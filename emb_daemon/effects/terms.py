"""Terms that are not in the catalogue: data in a calibration, evaluated by one bounded kernel in the estimator's step.

A term is coefficient × shape(memory(signal)) × gate × other signal at one port of the physics. `emb_daemon.diagnose.grammar`
makes them; `Calibration.terms` contains them, checked when the file is loaded. A file never contains code. Without terms the
kernel is not called.
"""

from math import cos, exp, sin, sqrt

import numpy as np

from emb_daemon.jit import Floats, Record, fields, hypot, njit, sq
from emb_daemon.models.wheel import TURNING_RAD_PER_S

#: Largest number of terms in a calibration. One costs at most 30 ns in a step, and a brake of other physics than the
#: calibration's takes four before anything is diagnosed, which must leave room for more.
MOST = 12

#: Ports: hooks of `effects.base.HOOKS` to which a term may add, in its unit.
PORTS = (
    "thickness", "motor_angle", "stiffness", "force", "torque_constant", "torque", "gear_gain", "gear_friction",
    "pad_friction", "current", "relaxation_time", "heat_share", "contact_conductance", "gap_conductance", "pad_conductivity",
    "disc_cooling", "pad_heat", "disc_heat",
)  # fmt: skip
#: Signals and their units. Forces are those of the stiffness path, temperatures and brake torque the models' own; heat of the
#: motor is that of the estimator's winding and housing, as a share of the steady value at the largest force's current.
SIGNALS = {
    "motor_angle": "rad",
    "travel": "rad",
    "motor_speed": "rad/s",
    "clamp_force": "N",
    "force_rate": "N/s",
    "current": "A",
    "pad_temperature": "°C",
    "disc_temperature": "°C",
    "caliper_temperature": "°C",
    "disc_speed": "rad/s",
    "brake_torque": "N·m",
    "energy": "J",
    "time_clamped": "s",
    "time_since_last_clamp": "s",
    "winding_heat": "1",
    "housing_heat": "1",
    "surface_temperature": "°C",
    "friction_power": "W",
}
#: Memory of a term's signal x: none; lag: z of τ dz/dt + z = x; deficit: z − x; slip: a Maxwell slip element of stretch
#: ``memory_scale``, z in [-1, 1]; response: the same lag, of the output of the shape; peak: the lag, but a rise at once.
MEMORIES = ("none", "lag", "deficit", "slip", "response", "peak")
#: Functions of u = (z − centre)/scale: 1; sign(u)|u|^n; |u|^n; u/(1 + |u|); exp(−|u|); max(u, 0); c cos u + d sin u; exp(−u²).
SHAPES = ("constant", "odd_power", "even_power", "saturation", "decay", "onset", "harmonic", "bump")
#: When a term acts; ``load`` multiplies it by the clamp force over the largest.
GATES = ("always", "load", "closing", "opening", "turning", "standing")

(_ANGLE, _TRAVEL, _SPEED, _FORCE, _RATE, _CURRENT, _PADS, _DISC, _CALIPER, _WHEEL, _BRAKE, _ENERGY, _CLAMPED, _RELEASED,
 _WINDING, _HOUSING, _SURFACE, _POWER) = range(len(SIGNALS))  # fmt: skip
_NONE, _LAG, _DEFICIT, _SLIP, _RESPONSE, _PEAK = range(len(MEMORIES))
_CONSTANT, _ODD, _EVEN, _SATURATION, _DECAY, _ONSET, _HARMONIC, _BUMP = range(len(SHAPES))
_ALWAYS, _LOAD, _CLOSING, _OPENING, _TURNING, _STANDING = range(len(GATES))
(_THICKNESS, _MOTOR_ANGLE, _STIFFNESS, _STATIC_FORCE, _TORQUE_CONSTANT, _TORQUE, _GEAR_GAIN, _GEAR_FRICTION, _PAD_FRICTION,
 _AMPERE, _RELAXATION, _SHARE, _CONTACT, _GAP, _THROUGH, _COOLING, _PAD_HEAT, _DISC_HEAT) = range(len(PORTS))  # fmt: skip

#: Widths of its range by which a term goes on beyond it as it is shaped, before it is held: of terms of drawn brakes whose
#: second drive was hotter or harder, a constant left two to four times as much as was left within the range.
BEYOND = 0.25

#: Widths of the range of what a term remembered beyond which it is no memory of this brake: ten campaigns' worth.
_POSSIBLE = 10.0

#: Clamp force from which the brake counts as clamped, N.
CLAMPED_N = 150.0

TERM = np.dtype(
    [
        *fields("i8", "port signal memory shape gate other"),
        *fields("f8", "coefficient sine sigma scale centre exponent memory_scale low high memory_low memory_high"),
        *fields("f8", "limit growth most other_from other_high"),
    ],
    align=True,
)
#: ``other``: the signal that multiplies; negative for none. ``most``: what the term adds or subtracts at most in its range.
PARAMETERS = np.dtype([("count", "i8"), ("term", TERM, (MOST,))], align=True)
#: ``added`` and its standard deviation ``outside`` of the terms' range, or where signals are not known, by port in its unit;
#: ``sigma`` and ``torque_sigma``: what the latter makes of the static force (N) and of the torque (N m). ``cut``: what the
#: limits of its port take away from each term. ``rested_s``: how long ago a restart's memories are of.
STATE = np.dtype(
    [
        ("signal", "f8", (len(SIGNALS),)),
        ("added", "f8", (len(PORTS),)),
        ("outside", "f8", (len(PORTS),)),
        *fields("f8", "sigma torque_sigma rested_s"),
        ("begun", "i8", (MOST,)),
        ("memory", "f8", (MOST,)),
        ("before", "f8", (MOST,)),
        ("cut", "f8", (MOST,)),
    ],
    align=True,
)


@njit
def _follow(signal, s, m):
    """Signals at this sample. Its force is not known yet: the last one is moved along the curve's slope."""
    signal[_ANGLE], signal[_SPEED] = m.angle + s.ahead - s.zero_moved, m.speed
    signal[_TRAVEL] = max(s.past_contact + s.travel, 0.0)
    force = max(s.force + s.slope * s.travel, 0.0)
    signal[_FORCE], signal[_RATE] = force, s.slope * m.speed
    signal[_CURRENT] = m.current_q if m.has_current else np.nan
    signal[_PADS] = 0.5 * (s.mean[0] + s.mean[1]) if s.temperature_known else np.nan
    signal[_DISC] = s.disc if s.temperature_known else np.nan
    signal[_CALIPER] = m.caliper if m.has_thermocouple else np.nan
    wheel = m.wheel_speed if m.has_wheel_speed and not s.wheel.contradicted else s.wheel.instead
    signal[_WHEEL] = wheel
    if wheel > TURNING_RAD_PER_S:
        signal[_BRAKE] = s.power / wheel
    elif not wheel > 0.0:
        # Until the disc stands the pads go on braking it, though too slowly for a power.
        signal[_BRAKE] = 0.0 if wheel <= 0.0 else np.nan
    signal[_ENERGY] += s.power * m.dt
    clamped = force > CLAMPED_N
    signal[_CLAMPED] = signal[_CLAMPED] + m.dt if clamped else 0.0
    signal[_RELEASED] = 0.0 if clamped else signal[_RELEASED] + m.dt
    signal[_WINDING], signal[_HOUSING] = s.winding, s.housing
    signal[_SURFACE] = 0.5 * (s.pads[0, 0] + s.pads[1, 0]) if s.temperature_known else np.nan
    signal[_POWER] = s.power if np.isfinite(wheel) else np.nan


@njit
def _forgotten(q, dt):
    """What a term's memory forgets in ``dt`` s, as a share."""
    return 1.0 - exp(-dt / q.memory_scale) if q.memory != _NONE and q.memory != _SLIP else 1.0


@njit
def _remember(q, t, k, x, forgotten):
    """Signal ``x`` of term ``k`` after its memory."""
    if q.memory == _NONE:
        return x
    if t.begun[k] == 0:
        t.begun[k] = 1
        t.memory[k], t.before[k] = (0.0 if q.memory == _SLIP else x), x
    if q.memory == _PEAK and x > t.memory[k]:
        t.memory[k] = x
    elif q.memory == _SLIP:
        t.memory[k] = min(max(t.memory[k] + (x - t.before[k]) / q.memory_scale, -1.0), 1.0)
    else:
        t.memory[k] += forgotten * (x - t.memory[k])
    t.before[k] = x
    return t.memory[k] - x if q.memory == _DEFICIT else t.memory[k]


@njit
def _recalled(q, t, k):
    """What term ``k`` remembers, as `_remember` returned it last."""
    return t.memory[k] - t.before[k] if q.memory == _DEFICIT else t.memory[k]


@njit
def _power(u, exponent):
    # A search evaluates these three by the million, and pow() takes most of the time.
    if exponent == 1.0:
        return u
    if exponent == 2.0:
        return u * u
    return sqrt(u) if exponent == 0.5 else u**exponent


@njit
def _shape(q, z):
    """The term over its coefficient; a harmonic with its coefficients."""
    u = (z - q.centre) / q.scale
    if q.shape == _ODD:
        return _power(abs(u), q.exponent) * (1.0 if u >= 0.0 else -1.0)
    if q.shape == _EVEN:
        return _power(abs(u), q.exponent)
    if q.shape == _SATURATION:
        return u / (1.0 + abs(u))
    if q.shape == _DECAY:
        return exp(-abs(u))
    if q.shape == _ONSET:
        return max(u, 0.0)
    if q.shape == _HARMONIC:
        return q.coefficient * cos(u) + q.sine * sin(u)
    if q.shape == _BUMP:
        return exp(-u * u)
    return 1.0


@njit
def _gate(q, signal, maximum_force):
    if q.gate == _LOAD:
        return signal[_FORCE] / maximum_force
    if q.gate == _CLOSING:
        return 1.0 if signal[_SPEED] > 0.0 else 0.0
    if q.gate == _OPENING:
        return 1.0 if signal[_SPEED] < 0.0 else 0.0
    if q.gate == _TURNING:
        return 1.0 if signal[_WHEEL] > TURNING_RAD_PER_S else 0.0
    if q.gate == _STANDING:
        return 1.0 if signal[_WHEEL] <= TURNING_RAD_PER_S else 0.0
    return 1.0


@njit
def _of_other(q, signal):
    """The signal that multiplies, over the largest at which the term was found: its size, or a temperature's rise above
    ``other_from``."""
    y = signal[q.other]
    return (y - q.other_from if q.other_from > 0.0 else abs(y)) / (q.other_high - q.other_from)


@njit
def _share(q, signal):
    """What of the term the other signal lets act; one without such a signal."""
    return _of_other(q, signal) if q.other >= 0 else 1.0


@njit
def _held(x, low, high):
    further = BEYOND * (high - low)
    return min(max(x, low - further), high + further)


@njit
def _held_share(share):
    return min(max(share, 0.0), 1.0 + BEYOND)


@njit
def _unlimited(q, signal, shaped, maximum_force):
    """Amount that a term would add at its port of what it has ``shaped``, in the port's unit."""
    shaped *= _gate(q, signal, maximum_force)
    return shaped if q.shape == _HARMONIC else q.coefficient * shaped


@njit
def _limited(q, signal, shaped, maximum_force):
    """The same within the term's limits."""
    return min(max(_unlimited(q, signal, shaped, maximum_force), -q.limit), q.growth)


@njit
def _value(q, t, k, forgotten, maximum_force):
    """Amount that term ``k`` adds at its port, in the port's unit; outside its range as shaped for `BEYOND` of its width, then
    held, and never beyond its limits. A response goes on, as heat does."""
    x, share = t.signal[q.signal], _share(q, t.signal)
    t.cut[k] = 0.0
    if not (np.isfinite(x) and np.isfinite(share)):
        return 0.0
    x, share = _held(x, q.low, q.high), _held_share(share)
    if q.memory == _RESPONSE:
        shaped = _remember(q, t, k, share * _shape(q, x), forgotten)
    else:
        shaped = share * _shape(q, _held(_remember(q, t, k, x, forgotten), q.memory_low, q.memory_high))
    wanted = _unlimited(q, t.signal, shaped, maximum_force)
    added = min(max(wanted, -q.limit), q.growth)
    t.cut[k] = wanted - added
    return added


@njit
def _distance(x, low, high):
    """Distance from a range, in its widths."""
    return max(low - x, x - high, 0.0) / (high - low)


@njit
def _outside(q, x, share):
    """Distance of a term's signals from their range, in widths of the range."""
    distance = _distance(x, q.low, q.high)
    return distance + max(share - 1.0, 0.0) if q.other >= 0 else distance


@njit
def _sigma_outside(q, t, k, added, speed_error, heat_error, maximum_force):
    """Standard deviation in the port's unit where term ``k`` leaves its range: that of the coefficient and its own size, times
    the distance of its signals, and of what it remembers, from their ranges, in widths of the range; all that the term
    can be if a signal is not known. At the edge of the range the term is as certain as within. Where its port's limits hold
    it, either they or the term are wrong by what they take away. ``speed_error``: standard deviation of the disc's speed, as
    a share of it; ``heat_error``: of the temperatures of pads and disc, K."""
    signal = t.signal
    x, share = signal[q.signal], _share(q, signal)
    gate_known = not (q.gate == _TURNING or q.gate == _STANDING) or np.isfinite(signal[_WHEEL])
    if not (gate_known and np.isfinite(x) and np.isfinite(share)):
        return q.most
    outside = _outside(q, x, share) + _distance(_recalled(q, t, k), q.memory_low, q.memory_high)
    if speed_error > 0.0 and (q.signal == _WHEEL or q.other == _WHEEL):
        outside += speed_error * (q.exponent if q.signal == _WHEEL and q.shape in (_ODD, _EVEN) else 1.0)
    sigma = hypot(outside * hypot(q.sigma, added), t.cut[k])
    if heat_error > 0.0 and (_is_heat(q.signal) or _is_heat(q.other)):
        sigma = max(sigma, _sigma_unsure(q, signal, added, heat_error, maximum_force))
    return sigma


@njit
def _is_heat(signal):
    """Whether a signal is a temperature that is estimated, with an error that all of them share."""
    return signal in (_PADS, _DISC, _SURFACE)


@njit
def _sigma_unsure(q, signal, added, heat_error, maximum_force):
    """The same if temperatures are off by their standard deviation: what that alters, and how far outside it would be. What
    only remembers changes of a temperature is not altered."""
    x, share = signal[q.signal], _share(q, signal)
    by = heat_error if _is_heat(q.signal) else 0.0
    of_share = heat_error / (q.other_high - q.other_from) if _is_heat(q.other) else 0.0
    follows, told, most = q.memory != _DEFICIT and q.memory != _SLIP, added, 0.0
    if follows:
        told = _limited(q, signal, _held_share(share) * _shape(q, _held(x, q.low, q.high)), maximum_force)
    for sign in (-1.0, 1.0):
        there, beside, value = x + sign * by, share + sign * of_share, added
        if follows:
            value = _limited(q, signal, _held_share(beside) * _shape(q, _held(there, q.low, q.high)), maximum_force)
        most = max(most, abs(value - told) + _outside(q, there, beside) * hypot(q.sigma, value))
    return most


@njit
def _of_force(port, s):
    """Static force (N) per unit that is added at a port."""
    if port == _STIFFNESS:
        return s.force
    return 1.0 if port == _STATIC_FORCE else s.slope


@njit
def _of_torque(port, s, p, m):
    """Torque (N m) per unit that is added at a port."""
    if port == _TORQUE:
        return 1.0
    if port == _GEAR_GAIN:
        return p.gear_gain * s.force
    if port == _GEAR_FRICTION:
        return p.offset_friction + p.load_friction * s.force
    if port == _TORQUE_CONSTANT:
        return p.torque_constant * abs(m.current_q) if m.has_current else 0.0
    return p.torque_constant if port == _AMPERE else 0.0


@njit
def look(e: Record, s: Record, p: Record, m: Record) -> None:
    """All terms at this sample. ``e`` PARAMETERS, ``s`` the estimator's state, ``p`` its parameters, ``m`` the sample."""
    t = s.effects.terms
    _follow(t.signal, s, m)
    for port in range(len(t.added)):
        t.added[port] = t.outside[port] = 0.0
    of_force = of_torque = 0.0
    speed_error = s.wheel.instead_unsure if s.wheel.contradicted or not m.has_wheel_speed else 0.0
    heat_error = s.temperature_sigma if s.temperature_known else 0.0
    for k in range(e.count):
        q = e.term[k]
        value = _value(q, t, k, _forgotten(q, m.dt + t.rested_s), p.maximum_force)
        t.added[q.port] += value
        # A term of the heat balance is itself a reason of the temperatures' error, which would feed on itself.
        of_heat = q.port >= _SHARE or q.port == _PAD_FRICTION
        sigma = _sigma_outside(q, t, k, value, speed_error, 0.0 if of_heat else heat_error, p.maximum_force)
        if sigma > 0.0:
            t.outside[q.port] = hypot(t.outside[q.port], sigma)
            if q.port <= _STATIC_FORCE:
                of_force += sq(sigma * _of_force(q.port, s))
            else:
                of_torque += sq(sigma * _of_torque(q.port, s, p, m))
    t.sigma, t.torque_sigma, t.rested_s = sqrt(of_force), sqrt(of_torque), 0.0


@njit
def store(e: Record, t: Record, memory: Floats) -> None:
    """Fill ``memory``, shape (MOST,), with what terms remember; NaN where they do not. What slips is not stored: it may have
    moved before it is resumed."""
    for k in range(MOST):
        memory[k] = t.memory[k] if k < e.count and t.begun[k] != 0 and e.term[k].memory != _SLIP else np.nan


@njit
def resume(t: Record, memory: Floats, elapsed_s: float) -> None:
    """Go on from what terms remembered ``elapsed_s`` s ago, as stored."""
    for k in range(MOST):
        if np.isfinite(memory[k]):
            t.begun[k], t.memory[k] = 1, memory[k]
    t.rested_s = elapsed_s


@njit
def is_possible(e: Record, memory: Floats) -> bool:
    """Whether terms may remember what is stored: far beyond what they ever did where they were found, they do not."""
    possible = True
    for k in range(e.count):
        q = e.term[k]
        far = q.memory != _DEFICIT and _distance(memory[k], q.memory_low, q.memory_high) > _POSSIBLE
        possible = possible and not far
    return possible


@njit
def unsure_heat(
    t: Record, p: Record, pads: float, disc: float, plates: float, around: float, power: float, wheel_speed: float,
    braking: bool,
) -> tuple[float, float]:  # fmt: skip
    """Standard deviations of the heat (W) into both pads and into the disc, from terms outside of their range.

    ``pads``, ``disc``, ``plates`` and ``around``: temperatures (degC) of friction surfaces, disc, backing plates and ambient.
    """
    o, both = t.outside, 2.0 * p.area
    conductance, unsure = (p.contact_conductance, o[_CONTACT]) if braking else (p.gap_conductance, o[_GAP])
    exchanged = unsure * conductance * both * (disc - pads)
    exchanged = hypot(exchanged, o[_SHARE] * (p.heat_share[0] + p.heat_share[1]) * power)
    kept = o[_THROUGH] * p.conductivity / p.thickness * both * (pads - plates)
    cooled = o[_COOLING] * (p.disc_cooling + p.disc_cooling_per_speed * wheel_speed) * (disc - around)
    return hypot(hypot(exchanged, kept), o[_PAD_HEAT]), hypot(hypot(exchanged, cooled), o[_DISC_HEAT])


@njit
def _follow_all(e, t, signals, dt, maximum_force, values, recalled):
    forgotten, of_dt = 0.0, np.nan
    for row in range(len(signals)):
        if dt[row] != of_dt:
            of_dt = dt[row]
            forgotten = _forgotten(e, of_dt)
        # The term's own signals, and those of the gates.
        for which in (e.signal, max(e.other, 0), _FORCE, _SPEED, _WHEEL):
            t.signal[which] = signals[row, which]
        values[row] = _value(e, t, 0, forgotten, maximum_force)
        recalled[row] = _recalled(e, t, 0)


def evaluate(term: np.void, signals: np.ndarray, dt: np.ndarray, maximum_force_N: float) -> np.ndarray:
    """Amount that a term (TERM) adds at its port for signals of shape (n, signals), ``dt`` s apart, in the port's unit."""
    return _followed(term, signals, dt, maximum_force_N)[0]


def recall(term: np.void, signals: np.ndarray, dt: np.ndarray, maximum_force_N: float) -> np.ndarray:
    """What a term (TERM) remembers at the same samples: z of a lag, a peak or a deficit, the output of a response."""
    return _followed(term, signals, dt, maximum_force_N)[1]


def _followed(term, signals, dt, maximum_force_N):
    values, recalled = np.zeros((2, len(signals)))
    _follow_all(term, np.zeros(1, STATE)[0], signals, np.ascontiguousarray(dt), maximum_force_N, values, recalled)
    return values, recalled
