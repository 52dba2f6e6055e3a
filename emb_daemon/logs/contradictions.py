"""What in a mapped log contradicts any brake: a wrong sign, an angle that wraps around, a constant column.

A wrong unit or sign of a mapping is not visible in the numbers themselves, but in contradictions between them, which are
reported.
"""

import numpy as np

from emb_daemon.logs.columns import shipped_database
from emb_daemon.logs.currents import (
    AGAINST,
    JUDGED,
    LEAST,
    find_command,
    find_driving_friction,
    find_late_current,
    find_other_current,
    least_lag,
)
from emb_daemon.logs.resample import Signals, is_bare, is_unresolved, turns_free
from emb_daemon.logs.series import Series

#: Number of parts of the travel over which means are taken, and least number of samples in each.
_PARTS, _LEAST_IN_PART = 10, 10
#: Least mean of the current at one end of the travel, as a share of the largest, and as a multiple of that at the other end.
_HOLDS, _MORE = 0.2, 2.0
#: Travel below which a motor stands, rad, and everything that correlates with its angle is noise.
_TRAVEL_RAD = 1.0
#: Correlation of angle and acceleration up to which their parts of the current can be separated.
_TOLD_APART = 0.5
#: Least change of the force over the travel, and most of it where a clamp is open, or next to it, as shares of the largest.
_FOLLOWS, _OPEN = 0.2, 0.2
#: Shares of the travel up to which a motor stands and from which on a clamp has begun, least number of samples between them,
#: and how alike an open brake's force is meanwhile, as a share of its range: a clamp that begins in contact has a slope there.
#: Least share of the range that is no zero error of a tared load cell's.
_STOOD, _BEGUN, _LEAST_IN_CLEARANCE, _FLAT, _TARED = 0.05, 0.15, 3, 0.02, 0.03
#: Largest force of a log, N, below which it is not a clamp force in N: production brakes reach 10 to 40 kN.
_LEAST_CLAMP_N = 100.0
#: Fastest change of an angle that our message of the motor's speed carries, rad/s: 6 000 rpm; share of the time in which it
#: may be faster, and number of steps over which it is computed.
_FASTEST, _SELDOM, _STEPS = 655.0, 0.01, 5
#: Other units of an angle, in rad.
_DEGREE, _TURN = np.pi / 180.0, 2.0 * np.pi
#: Fewest counts that an encoder has in a turn, if a power of two.
_LEAST_COUNTS = 256
#: Fewest different angles, after the first, of which being whole numbers is no accident.
_LEAST_STEPS = 20
#: Largest relative deviation of a jump from a whole turn.
_ABOUT = 0.1
#: Least step where a value wraps around, as a share of its range, least number of such steps, and share of those of few
#: samples before which the value goes the other way.
_ANEW, _LEAST_JUMPS, _ON = 0.5, 3, 0.8
#: How late a force follows the motor's angle where pads relax, s, and how late it may by no pads in motion that tells it; a
#: force before its angle is another clock's. Largest delay that is looked for, and step of the search, s.
_RELAXES_S, _LATE_S, _EARLY_S, _LONGEST_LAG_S, _LAG_STEP_S = 0.03, 0.08, 0.02, 0.5, 0.01
#: How often the travel must be passed, of how many samples that is added up, so that noise adds nothing, and time before and
#: after, s, between which an angle's way is told, for the same reason.
_PASSES, _PLACES, _WAY_S = 1.5, 400, 0.1
#: How many times less of a force a curve over the angle must then leave, late (slow clamps' hysteresis gains up to 1.8) and
#: early (it gains nothing), and number of parts of the curve.
_LATE_BETTER, _EARLY_BETTER, _CURVE_PARTS = 2.0, 1.2, 60
#: Radii of tyres, m: what vehicle speed over wheel speed is, of a scooter's to a truck's.
_TYRE_M = (0.15, 0.8)
#: Speeds of a wheel that turns, rad/s, at which the two are compared, and share of them that may be far from their median.
_TURNS_RAD_PER_S, _ASTRAY = 3.0, 0.2
#: Temperatures of surroundings, K, between which values in °C are likelier kelvins, and one that no backing plate lasts, °C.
_KELVINS, _NO_PLATE_C = (233.15, 333.15), 900.0
#: Time between two temperatures in which a brake cools, s. Fastest change of a backing plate's, K/s: through 10 mm of pad no
#: 3 K/s reach it. Change that is told from noise, K, over how many parts of a log.
_RARE_S, _FASTEST_K_PER_S, _CHANGES_K, _PLACES_OF_A_LOG = 600.0, 10.0, 20.0, 20
#: Steps of our message that a value covers at least, or what it says is lost in rounding; those of an angle that turns.
_LEAST_COVERED, _TURNS = 10.0, 50.0
#: Least time for which a value stays while the motor turns, s, and in ordinary times between two of its changes; least share
#: of the travel that it turns meanwhile.
_STAYS_S, _STAYS, _PASSED = 0.1, 20.0, 0.05
#: Change from sample to sample, over the whole of it, below which a small motion is no noise, whose is 1.4.
_SMOOTH = 0.3


def contradictions(corner: str, messages: dict[str, Signals]) -> list[str]:
    """A line for each contradiction in a corner's messages, before missing signals are filled in."""

    def series(message: str, signal: str) -> Series | None:
        found = messages.get(message.format(corner), {}).get(signal)
        return found if isinstance(found, Series) and len(found.time_ns) >= LEAST else None

    angle, current = series("EMB_{}_Resolver", "MotorAngle"), series("EMB_{}_Current", "CurrentQ")
    force = series("RIG_{}_Force", "ClampForceRef")
    lines = [*_find_other_wheel(corner, messages), *_find_impossible_temperatures(corner, messages)]
    is_free, bare = turns_free(corner, messages), is_bare(corner, messages)
    own = {name: s for name, s in (("MotorAngle", angle), ("CurrentQ", current), ("ClampForceRef", force)) if s is not None}
    for name, found in own.items():
        if not np.ptp(found.values):
            lines.append(f"{name} is {found.values[0]:g} throughout: leave it out if it was not measured")
    speed = series("EMB_{}_Resolver", "MotorSpeed") if angle is None else angle.derivative()
    lines += _find_gaps(own if angle is not None or speed is None else {"MotorSpeed": speed} | own)
    lines += find_command(current) if current is not None else []
    lines += _find_not_released(angle, force, messages.get("VEH_Status", {})) if force is not None and not bare else []
    lines += _find_staying(angle, force) if angle is not None and force is not None and not bare else []
    if angle is not None:
        if np.ptp(angle.values) >= 1.0 - _ABOUT and (jump := starts_anew(angle)):
            text = f"MotorAngle jumps by about {jump:.5g} rad and back to and fro; does it start anew? Then state its `period`"
            return [*lines, text + _turn_as(jump)]
        lines += _find_angle_unit(angle)
    lines += _find_rounded(corner, angle, speed, current, force, bare)
    moves = not (speed is None or current is None or is_unresolved(corner, messages))
    load = force
    if is_free:
        # One number, however many times a column has it.
        stated, force = messages[f"RIG_{corner}_Force"]["ClampForceRef"], None
        load = float(stated.values[0]) if isinstance(stated, Series) else stated
    driven: list[str] = []
    if speed is not None and current is not None and load is not None and (moves or (bare and speed.is_resolved)):
        driven = find_driving_friction(speed, current, load)
        lines += driven
    if moves and load is not None:
        lines += find_other_current(speed, current, load)
        # What relaxes in pads looks like a delay.
        lines += find_late_current(speed, current, force) if bare else []
    if angle is None or angle.is_sparse or np.ptp(angle.values) < _TRAVEL_RAD:
        # A travel that is small, or unknown between two samples, does not show directions; current and force do.
        turned = [] if angle is None or bare or force is None or not np.ptp(force.values) else _find_turned_force(angle, force)
        return lines + (turned or _find_opposed(speed, current, force) if moves and force is not None else turned)
    if bare:
        # A current that is turned round itself lets friction drive the motor, which has been said.
        return lines if driven or not moves or force is None else lines + _find_opposed(speed, current, force, bare)
    turned = []
    if current is not None and np.ptp(current.values) and (force is None or _may_clamp(angle, force)):
        turned += _find_turned_current(angle, current)
    if force is not None and np.ptp(force.values):
        turned_force = _find_turned_force(angle, force)
        turned += turned_force
        lines += [] if turned_force else [*_find_untared(angle, force), *_find_late_force(angle, force)]
    if moves and force is not None and not turned:
        turned = _find_opposed(speed, current, force)
    lines += turned
    return lines


def has_dead_current(corner: str, messages: dict[str, Signals]) -> bool:
    """Whether a corner's current is nothing but zero while its motor turns: friction alone would need some."""
    angle, current = (messages.get(f"EMB_{corner}_{name}", {}) for name in ("Resolver", "Current"))
    angle, current = angle.get("MotorAngle"), current.get("CurrentQ")
    if not isinstance(angle, Series) or current is None or len(angle.values) < LEAST or np.ptp(angle.values) < _TRAVEL_RAD:
        return False
    return not np.any(current.values if isinstance(current, Series) else current)


def _find_gaps(signals: dict[str, Series]) -> list[str]:
    """A line on how often and how long nothing was recorded, for all signals of which that is the same."""
    names: dict[str, list[str]] = {}
    for name, found in signals.items():
        steps, gaps = 1e-9 * np.diff(found.time_ns), found.gaps
        if len(gaps):
            longest = gaps[np.argmax(steps[gaps])]
            at = 1e-9 * (found.time_ns[longest] - found.time_ns[0])
            many = f"{len(gaps)} gaps, together {np.sum(steps[gaps]):.3g} s, the longest of" if len(gaps) > 1 else "a gap of"
            names.setdefault(f"{many} {steps[longest]:.3g} s, {at:.4g} s after the first value", []).append(name)
    return [f"{', '.join(own)}: {text}; nothing is known of it meanwhile" for text, own in names.items()]


def _find_staying(angle: Series, force: Series) -> list[str]:
    """A line on the longest time for which a force stays to the bit while the motor turns, if it is another than that of a
    clearance: elsewhere it changes over the angles that are passed, or is less."""
    changes = np.concatenate([[0], np.flatnonzero(np.diff(force.values)) + 1, [len(force.values)]])
    if len(changes) < LEAST:
        return []
    longest = int(np.argmax(np.diff(changes)))
    first, last = changes[longest], changes[longest + 1] - 1
    at, lasts_s = angle.sampled(force.time_ns), 1e-9 * (force.time_ns[last] - force.time_ns[first])
    passed, stays = at[first : last + 1], np.zeros(len(at), bool)
    stays[first : last + 1] = True
    if lasts_s < max(_STAYS_S, _STAYS * np.median(np.diff(changes)) * 1e-9 * force.period_ns):
        return []
    if not np.ptp(passed) > _PASSED * np.ptp(angle.values):
        return []
    elsewhere = force.values[(at >= np.min(passed)) & (at <= np.max(passed)) & ~stays]
    least = _FOLLOWS * np.ptp(force.values)
    if (np.ptp(elsewhere) if len(elsewhere) >= _LEAST_IN_PART else force.values[first] - np.min(force.values)) < least:
        return []
    return [
        f"ClampForceRef stays at {force.values[first]:.4g} N for {lasts_s:.3g} s, "
        f"{1e-9 * (force.time_ns[first] - force.time_ns[0]):.4g} s after the first value, while the motor turns by "
        f"{np.ptp(passed):.3g} rad: did the sensor, or its recorder, end there?"
    ]


def _find_not_released(angle: Series | None, force: Series, status: Signals) -> list[str]:
    """A line on a log that begins with a force, which it loses later or never, where the vehicle says that the brake is
    released."""
    at_start = [s.values[0] if isinstance(s, Series) else s for s in map(status.get, ("ParkBrake", "BrakeRequest"))]
    begins_N = float(np.median(force.values[:_LEAST_IN_PART]))
    lowest_N, largest_N = np.quantile(force.values, (0.05, 0.99))
    if at_start != [0.0, 0.0] or begins_N < _OPEN * largest_N:
        return []
    said = "while ParkBrake and BrakeRequest say that the brake is released"
    if lowest_N <= 0.5 * begins_N:
        return [
            f"ClampForceRef begins at {begins_N:.4g} N and falls to {lowest_N:.4g} N, {said}: cut off what comes before it "
            "is, or leave VEH_Status out"
        ]
    # What rises from nothing has begun to clamp.
    first_N = float(np.min(force.values[:_LEAST_IN_PART]))
    if largest_N < _LEAST_CLAMP_N or first_N < _OPEN * largest_N or not np.ptp(force.values):
        return []
    if angle is not None and np.ptp(angle.values) and _find_untared(angle, force):
        return []
    return [
        f"ClampForceRef is {begins_N:.4g} N at the start and seldom below {lowest_N:.4g} N, {said}: was the sensor tared? If "
        "it was, the log begins clamped: leave VEH_Status out"
    ]


def _find_other_wheel(corner: str, messages: dict[str, Signals]) -> list[str]:
    """A line if no tyre rolls as fast as the vehicle at the speed of its wheel."""
    wheel = messages.get("VEH_WheelSpeed", {}).get(f"WheelSpeed{corner}")
    vehicle = messages.get("VEH_Status", {}).get("VehicleSpeed")
    if not isinstance(wheel, Series) or not isinstance(vehicle, Series):
        return []
    at = vehicle.sampled(wheel.time_ns)
    turns = np.isfinite(at) & (wheel.values > _TURNS_RAD_PER_S)
    if np.sum(turns) < LEAST:
        return []
    radii_m = at[turns] / wheel.values[turns]
    radius_m = float(np.median(radii_m))
    # A bench turns its disc without a vehicle, and a wheel that slips is no question of units.
    alike = np.mean(np.abs(radii_m - radius_m) > _ASTRAY * radius_m) <= _ASTRAY
    if not alike or _TYRE_M[0] <= radius_m <= _TYRE_M[1]:
        return []
    return [
        f"VehicleSpeed is {radius_m:.3g} m/s for each rad/s of WheelSpeed{corner}, the radius of no tyre in m: is the unit of "
        "one of the two wrong?"
    ]


def _find_impossible_temperatures(corner: str, messages: dict[str, Signals]) -> list[str]:
    """A line for each thermocouple whose values are kelvins, an instrument's that measures nothing, or of another time."""
    lines = []
    for name, values in messages.get(f"EMB_{corner}_Thermocouple", {}).items():
        if not isinstance(values, Series) or not len(values.values):
            continue
        low, middle = float(np.min(values.values)), float(np.median(values.values))
        if middle > _NO_PLATE_C:
            lines.append(f"{name} is {middle:.4g} °C, which no backing plate lasts: an open thermocouple, or a wrong unit?")
        elif _KELVINS[0] < low < _KELVINS[1]:
            lines.append(f"{name} is never below {low:.4g} °C: are these kelvins? Then `unit: K`")
        if len(values.values) >= LEAST:
            lines += _find_other_time(name, values)
    return lines


def _find_other_time(name: str, temperature: Series) -> list[str]:
    """A line on a temperature that comes so rarely, or changes so fast, that its times are in another unit."""
    period_s = 1e-9 * temperature.period_ns
    if period_s > _RARE_S:
        return [f"{name} comes once in {period_s:.4g} s, in which a brake has cooled: is the unit of time right?"]
    # Noise is no change over so many samples.
    apart = len(temperature.values) // _PLACES_OF_A_LOG
    change = np.abs(temperature.values[apart:] - temperature.values[:-apart])
    rates = change / (1e-9 * (temperature.time_ns[apart:] - temperature.time_ns[:-apart]))
    fastest = float(np.max(rates[change > _CHANGES_K], initial=0.0))
    if fastest < _FASTEST_K_PER_S:
        return []
    return [
        f"{name} changes by {fastest:.3g} K/s, as no backing plate does: is the unit of time right, or does its thermocouple "
        "open?"
    ]


def _find_late_force(angle: Series, force: Series) -> list[str]:
    """A line on a force that follows the angle later than pads do, or comes before it."""
    times, values = force.time_ns[:JUDGED], force.values[:JUDGED]
    way = angle.sampled(times)
    way = way[np.isfinite(way)][:: max(len(times) // _PLACES, 1)]
    # A curve over an angle that goes one way is one over the time.
    if np.sum(np.abs(np.diff(way))) < _PASSES * np.ptp(way):
        return []

    def left_N(lag_s: float, each_way: bool = False) -> float:
        at = angle.sampled(times - round(1e9 * lag_s))
        known = np.isfinite(at)
        if np.sum(known) < LEAST or not np.ptp(at[known]) or at[known] @ (values[known] - np.mean(values[known])) < 0.0:
            return np.inf
        part = np.minimum(_CURVE_PARTS * (at[known] - at[known].min()) / np.ptp(at[known]), _CURVE_PARTS - 1).astype(int)
        if each_way:
            span = round(1e9 * _WAY_S)
            part += _CURVE_PARTS * (angle.sampled(times + span) < angle.sampled(times - span))[known]
        means = np.bincount(part, values[known]) / np.maximum(np.bincount(part), 1)
        return float(np.std(values[known] - means[part]))

    lags = np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S, _LAG_STEP_S)
    left = np.array([left_N(lag) for lag in lags])
    if not np.isfinite(left).any():
        return []
    lag_s = float(least_lag(lags, left))
    gain = left_N(0.0) / max(np.min(left), 1.0)
    if lag_s > _LATE_S and gain > _LATE_BETTER:
        return [
            f"ClampForceRef comes {1e3 * lag_s:.0f} ms after the motor's angle that it belongs to, and pads explain some "
            f"{1e3 * _RELAXES_S:.0f} ms: `mean_ms: {2e3 * (lag_s - _RELAXES_S):.0f}` of it, twice a delay, takes the rest back"
        ]
    # What rubs or has play makes a loop: more force on the way to it than back, as if it came first.
    if lag_s < -_EARLY_S and gain > _EARLY_BETTER and np.min(left) < left_N(0.0, each_way=True):
        return [
            f"ClampForceRef comes {-1e3 * lag_s:.0f} ms before the motor's angle that it belongs to, as of no brake: were the "
            "two stamped by two clocks?"
        ]
    return []


def _find_angle_unit(angle: Series) -> list[str]:
    """A line on an angle that turns faster than any motor, or is whole radians or turns, and the unit that it may have."""
    # Over several samples, because jitter of the stamps makes single steps fast.
    way, took = (column[_STEPS:] - column[:-_STEPS] for column in (angle.values, 1e-9 * angle.time_ns))
    fastest = float(np.quantile(np.abs(way / took), 1.0 - _SELDOM))
    counts = "its values are whole numbers: counts of an encoder? Then `unit: rev`, and one over those of a turn as `scale`"
    if fastest <= _FASTEST:
        # No angle is measured in steps of a radian or a turn; a joint's encoder counts slowly.
        steps = len(np.unique(angle.values)) - 1
        return [f"MotorAngle: {counts}"] if steps >= _LEAST_STEPS and _are_whole(angle.values, (1.0, _TURN)) else []
    if _are_whole(angle.values, (1.0, _DEGREE, _TURN)):
        what = counts
    elif fastest * _DEGREE <= _FASTEST:
        what = f"if its values are degrees, `unit: deg` makes {fastest * _DEGREE:.3g} rad/s of it"
    else:
        what = "are its values counts of an encoder, or is the unit of time wrong?"
    return [f"MotorAngle changes by {fastest:.4g} rad/s ({fastest * 30.0 / np.pi:.3g} rpm), which no motor does: {what}"]


def _find_rounded(
    corner: str, angle: Series | None, speed: Series | None, current: Series | None, force: Series | None, bare: bool
) -> list[str]:
    """A line on a motion, or the current for it, that is too small for the steps of our messages; ``speed`` measured, or the
    change of the angle; ``bare`` of what clamps nothing, whose motor does not stand for long but against a load."""

    def covered(message: str, signal: str, found: Series) -> float:
        step = shipped_database("dbc/emb.dbc").get_message_by_name(message.format(corner)).get_signal_by_name(signal).scale
        return float(np.ptp(np.quantile(found.values, (0.01, 0.99))) / step)

    def goes(found: Series | None) -> bool:
        # What stands has noise.
        return found is not None and np.std(np.diff(found.values)) < _SMOOTH * np.std(found.values)

    lines, lost = [], "steps of our message, and rounding hides what it says"
    how = "of what turns behind a gear state the motor's, angle and speed alike by the gear's ratio as `scale`"
    way = covered("EMB_{}_Resolver", "MotorAngle", angle) if angle is not None else _TURNS * goes(speed)
    # The speed of samples that are too rare for it is not known.
    known = angle is None or not (angle.course_is_unknown if bare else angle.way_is_unknown)
    if way < _TURNS and bare and goes(angle):
        lines.append(f"MotorAngle covers {way:.2g} {lost}: {how}, of a deflection any that makes radians of it")
    elif way >= _TURNS and known and (steps := covered("EMB_{}_Resolver", "MotorSpeed", speed)) < _LEAST_COVERED:
        lines.append(f"MotorSpeed covers {steps:.2g} {lost}: {how}")
    loaded = way >= _TURNS or (bare and goes(force))
    if loaded and current is not None and 0.0 < (steps := covered("EMB_{}_Current", "CurrentQ", current)) < _LEAST_COVERED:
        lines.append(f"CurrentQ covers {steps:.2g} {lost}: `scale` it up, and the torque constant down")
    return lines


def _are_whole(values: np.ndarray, units: tuple[float, ...]) -> bool:
    """Whether values are whole numbers of one of the units that they may have been mapped from."""
    return any(bool(np.all(np.abs(values / unit - np.rint(values / unit)) < 1e-6)) for unit in units)


def _turn_as(jump: float) -> str:
    """In which unit a jump would be a whole turn, in words; nothing if it is one in rad."""
    if abs(jump / _TURN - 1.0) < _ABOUT:
        return f": {_TURN:.6g} rad in the rig's unit"
    for size, unit in ((360.0, "deg"), (1.0, "rev")):
        if abs(jump / size - 1.0) < _ABOUT:
            return f": {size:g}, with `unit: {unit}`, of which that is a turn"
    counts = 2.0 ** np.rint(np.log2(jump)) if jump > 0.0 else 0.0
    if counts >= _LEAST_COUNTS and abs(jump / counts - 1.0) < _ABOUT:
        return f": {counts:g} counts in a turn? `unit: rev`, `scale: {1.0 / counts:.9g}`, `period: {counts:g}`"
    return ""


def _find_opposed(speed: Series, current: Series, force: Series, bare: bool = False) -> list[str]:
    """A line if the force falls whenever the current without acceleration rises; ``bare`` of what clamps nothing, whose
    current and motion agree."""
    times = current.time_ns
    at, acceleration = force.sampled(times), np.gradient(speed.sampled(times), 1e-9 * times)
    known = np.isfinite(at) & np.isfinite(acceleration)
    if np.sum(known) < LEAST or not np.ptp(at[known]):
        return []
    left = _without_inertia(current.values[known], at[known], acceleration[known])
    correlation = float(np.corrcoef(left, at[known])[0, 1]) if left is not None and np.ptp(left) else 0.0
    if correlation > -AGAINST:
        return []
    why = "and the motor's current bears its load" if bare else "and positive current clamps"
    which = "ClampForceRef" if bare else "one of the two"
    return [f"ClampForceRef falls while CurrentQ rises (correlation {correlation:.2f}), {why}: `scale: -1` of {which}?"]


def starts_anew(angle: Series) -> float:
    """What an angle that wraps around jumps by; 0 if it does not. The step before a jump stands for the motion in it."""
    steps = np.diff(angle.values)
    is_jump = np.abs(steps) > _ANEW * np.ptp(angle.values)
    before = np.append(0.0, np.where(is_jump, 0.0, steps)[:-1])
    jumps = np.abs(steps - before)[is_jump]
    if len(jumps) < _LEAST_JUMPS:
        return 0.0
    jump = float(np.median(jumps))
    # Between samples that are far apart a motor may move as far; but not always by the same.
    alike = bool(np.all(np.abs(jumps - jump) < _ABOUT * jump)) and bool(np.all(np.abs(steps[~is_jump]) < _ANEW * jump))
    # What turns on goes against its jump before it; before one stroke like the other the motor stands.
    goes_on = bool(np.mean((before * steps)[is_jump] < 0.0) > _ON)
    return jump if not angle.is_sparse or (alike and goes_on) else 0.0


def _by_travel(angle: Series, other: Series) -> tuple[float, float]:
    """Means of another signal over the lowest and the highest part of the travel with enough samples."""
    at = other.sampled(angle.time_ns)
    known = np.isfinite(at)
    part = np.minimum(_PARTS * (angle.values - angle.values.min()) / (np.ptp(angle.values) or 1.0), _PARTS - 1).astype(int)
    means = [np.mean(at[known & (part == n)]) for n in range(_PARTS) if np.sum(known & (part == n)) >= _LEAST_IN_PART]
    return (float(means[0]), float(means[-1])) if len(means) > 1 else (0.0, 0.0)


def _find_untared(angle: Series, force: Series) -> list[str]:
    """A line on a force that is not zero before the first clamp and stays while the motor begins it, as of an open brake."""
    at = force.sampled(angle.time_ns)
    way = (angle.values - angle.values.min()) / np.ptp(angle.values)
    # Later on pads that were let go press on for a while.
    first = np.isfinite(at) & (np.arange(len(at)) < np.argmax(way > _BEGUN))
    stood, moved = at[first & (way <= _STOOD)], at[first & (way > _STOOD)]
    if len(stood) < _LEAST_IN_PART or len(moved) < _LEAST_IN_CLEARANCE:
        return []
    zero_N, change_N = float(np.mean(stood)), float(np.mean(moved) - np.mean(stood))
    largest_N = float(np.ptp(np.quantile(at[np.isfinite(at)], (0.01, 0.99))))
    if abs(change_N) > _FLAT * largest_N or abs(zero_N) < _TARED * largest_N:
        return []
    return [
        f"ClampForceRef is {zero_N:.4g} N before the first clamp and stays while that begins, as of a brake that is open: was "
        f"the sensor tared? `offset: {-zero_N:.4g}`"
    ]


def _without_inertia(current: np.ndarray, load: np.ndarray, acceleration: np.ndarray) -> np.ndarray | None:
    """The current that does not accelerate the motor; None if load and acceleration cannot be separated, as in a sine."""
    if not np.ptp(acceleration):
        return current
    if abs(np.corrcoef(load, acceleration)[0, 1]) > _TOLD_APART:
        return None
    columns = np.stack([np.ones(len(load)), load, acceleration], axis=1)
    return current - np.linalg.lstsq(columns, current)[0][2] * acceleration


def _find_turned_current(angle: Series, current: Series) -> list[str]:
    acceleration = np.gradient(angle.derivative().values, 1e-9 * angle.time_ns)
    at = current.sampled(angle.time_ns)
    known = np.isfinite(at) & np.isfinite(acceleration)
    if np.sum(known) < LEAST:
        return []
    left = _without_inertia(at[known], angle.values[known], acceleration[known])
    if left is None:
        return []
    low, high = _by_travel(angle, Series(angle.time_ns[known], left))
    enough = _HOLDS * np.quantile(np.abs(left), 0.99)
    if max(abs(low), abs(high)) < enough:
        return []
    if high < -max(enough, _MORE * abs(low)):
        return [
            f"CurrentQ is {high:.3g} A where MotorAngle is largest; positive current clamps: `scale: -1` of one of the two?"
        ]
    if abs(low) > _MORE * abs(high):
        return [
            f"CurrentQ is {low:.3g} A where MotorAngle is least and {high:.3g} A where it is largest; a brake clamps at large "
            f"angles with positive current: `scale: -1` of MotorAngle and MotorSpeed{' and CurrentQ' if low < 0.0 else ''}?"
        ]
    return []


def _may_clamp(angle: Series, force: Series) -> bool:
    """Whether a force is another at one end of the travel than at the other, and next to nothing at one of them, as a clamp's
    is whichever way it is counted."""
    low, high = _by_travel(angle, force)
    largest = float(np.quantile(np.abs(force.values), 0.99))
    return abs(high - low) >= _FOLLOWS * largest and min(abs(low), abs(high)) <= _OPEN * largest


def _find_turned_force(angle: Series, force: Series) -> list[str]:
    if not _may_clamp(angle, force):
        return []
    low, high = _by_travel(angle, force)
    if (reached := np.max(np.abs(force.values))) < _LEAST_CLAMP_N:
        return [f"ClampForceRef reaches {reached:.3g} N, which clamps nothing; is its unit right?"]
    if high < low:
        what = "ClampForceRef" if abs(high) > abs(low) else "MotorAngle and MotorSpeed"
        return [f"ClampForceRef falls from {low:.4g} N to {high:.4g} N while MotorAngle rises: `scale: -1` of {what}?"]
    if abs(low) > _MORE * abs(high):
        return [
            f"ClampForceRef is {low:.4g} N where MotorAngle is least and {high:.4g} N where it is largest; a clamp force is "
            "positive at large angles: `scale: -1` of ClampForceRef, MotorAngle, MotorSpeed and CurrentQ?"
        ]
    return []
