"""What in a mapped log contradicts any brake: a wrong sign, an angle that wraps around, a constant column.

A wrong unit or sign of a mapping is not visible in the numbers themselves, but in contradictions between them, which are
reported.
"""

import numpy as np

from emb_daemon.logs.columns import shipped_database
from emb_daemon.logs.resample import Series, Signals, is_unresolved, turns_free

#: Least number of samples; number of parts of the travel over which means are taken, and least number of samples in each.
_LEAST, _PARTS, _LEAST_IN_PART = 200, 10, 10
#: Least mean of the current at one end of the travel, as a share of the largest, and as a multiple of that at the other end.
_HOLDS, _MORE = 0.2, 2.0
#: Travel below which a motor stands, rad, and everything that correlates with its angle is noise.
_TRAVEL_RAD = 1.0
#: Correlation of angle and acceleration up to which their parts of the current can be separated.
_TOLD_APART = 0.5
#: Least change of the force over the travel, as a share of the largest.
_FOLLOWS = 0.2
#: Correlation of force and current without acceleration below minus which the sign of one is wrong. Friction that holds the
#: force while the current falls leaves 0.7 to 0.9 of it in hard motion and in slow clamps.
_AGAINST = 0.5
#: Share of the highest speed from which the motor moves.
_MOVING = 0.05
#: Largest force of a log, N, below which it is not a clamp force in N: production brakes reach 10 to 40 kN.
_LEAST_CLAMP_N = 100.0
#: Fastest change of an angle that our message of the motor's speed carries, rad/s: 6 000 rpm; share of the time in which it
#: may be faster, and number of steps over which it is computed.
_FASTEST, _SELDOM, _STEPS = 655.0, 0.01, 5
#: Other units of an angle, in rad.
_DEGREE, _TURN = np.pi / 180.0, 2.0 * np.pi
#: Fewest counts that an encoder has in a turn, if a power of two.
_LEAST_COUNTS = 256
#: Largest relative deviation of a jump from a whole turn.
_ABOUT = 0.1
#: Least step where a value wraps around, as a share of its range, and least number of such steps.
_ANEW, _LEAST_JUMPS = 0.5, 3
#: Steps of our message that a value covers at least, or what it says is lost in rounding; those of an angle that turns.
_LEAST_COVERED, _TURNS = 10.0, 50.0


def contradictions(corner: str, messages: dict[str, Signals]) -> list[str]:
    """A line for each contradiction in a corner's messages, before missing signals are filled in."""

    def series(message: str, signal: str) -> Series | None:
        found = messages.get(message.format(corner), {}).get(signal)
        return found if isinstance(found, Series) and len(found.time_ns) >= _LEAST else None

    angle, current = series("EMB_{}_Resolver", "MotorAngle"), series("EMB_{}_Current", "CurrentQ")
    force = series("RIG_{}_Force", "ClampForceRef")
    lines = []
    for name, found in (("MotorAngle", angle), ("CurrentQ", current), ("ClampForceRef", force)):
        if found is not None and not np.ptp(found.values):
            lines.append(f"{name} is {found.values[0]:g} throughout: leave it out if it was not measured")
    if angle is not None:
        if np.ptp(angle.values) >= 1.0 - _ABOUT and (jump := starts_anew(angle)):
            text = f"MotorAngle jumps by about {jump:.5g} rad and back to and fro; does it start anew? Then state its `period`"
            return [*lines, text + _turn_as(jump)]
        lines += _find_too_fast(angle)
        lines += _find_rounded(corner, angle, current)
    speed = series("EMB_{}_Resolver", "MotorSpeed") if angle is None else angle.derivative()
    # A motor with constant load clamps nothing.
    is_free = turns_free(corner, messages)
    moves = not (speed is None or current is None or is_unresolved(angle or speed.integral(), is_free))
    if moves and (force is not None or is_free):
        lines += _find_driving_friction(speed, current, force)
    if angle is None or angle.is_sparse or np.ptp(angle.values) < _TRAVEL_RAD:
        # Travel alone does not show directions; current and force do.
        return lines + _find_opposed(speed, current, force) if moves and force is not None else lines
    if is_free or (force is not None and _is_of_either_sign(force)):
        return lines
    if current is not None and np.ptp(current.values):
        lines += _find_turned_current(angle, current)
    if force is not None and np.ptp(force.values):
        lines += _find_turned_force(angle, force)
    return lines


def _find_too_fast(angle: Series) -> list[str]:
    """A line on an angle that turns faster than any motor, and the unit that it may have."""
    # Over several samples, because jitter of the stamps makes single steps fast.
    way, took = (column[_STEPS:] - column[:-_STEPS] for column in (angle.values, 1e-9 * angle.time_ns))
    fastest = float(np.quantile(np.abs(way / took), 1.0 - _SELDOM))
    if fastest <= _FASTEST:
        return []
    if _are_whole(angle.values):
        what = "its values are whole numbers: counts of an encoder? Then `unit: rev`, and one over those of a turn as `scale`"
    elif fastest * _DEGREE <= _FASTEST:
        what = f"if its values are degrees, `unit: deg` makes {fastest * _DEGREE:.3g} rad/s of it"
    else:
        what = "are its values counts of an encoder, or is the unit of time wrong?"
    return [f"MotorAngle changes by {fastest:.4g} rad/s ({fastest * 30.0 / np.pi:.3g} rpm), which no motor does: {what}"]


def _find_rounded(corner: str, angle: Series, current: Series | None) -> list[str]:
    """A line on a motion, or the current for it, that is too small for the steps of our messages."""

    def covered(message: str, signal: str, values: np.ndarray) -> float:
        step = shipped_database("dbc/emb.dbc").get_message_by_name(message.format(corner)).get_signal_by_name(signal).scale
        return float(np.ptp(np.quantile(values, (0.01, 0.99))) / step)

    if covered("EMB_{}_Resolver", "MotorAngle", angle.values) < _TURNS:
        return []
    lines, lost = [], "steps of our message, and rounding hides what it says"
    speed = covered("EMB_{}_Resolver", "MotorSpeed", angle.derivative().values)
    if speed < _LEAST_COVERED:
        how = "of what turns behind a gear state the motor's, angle and speed alike by the gear's ratio as `scale`"
        lines.append(f"MotorSpeed covers {speed:.2g} {lost}: {how}")
    if current is not None and 0.0 < (steps := covered("EMB_{}_Current", "CurrentQ", current.values)) < _LEAST_COVERED:
        lines.append(f"CurrentQ covers {steps:.2g} {lost}: `scale` it up, and the torque constant down")
    return lines


def _are_whole(values: np.ndarray) -> bool:
    """Whether values are whole numbers, as mapped or of the unit that they were mapped from."""
    return any(bool(np.all(np.abs(values / unit - np.rint(values / unit)) < 1e-6)) for unit in (1.0, _DEGREE, _TURN))


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


def _find_opposed(speed: Series, current: Series, force: Series) -> list[str]:
    """A line if the force falls whenever the current without acceleration rises."""
    times = current.time_ns
    at, acceleration = force.sampled(times), np.gradient(speed.sampled(times), 1e-9 * times)
    known = np.isfinite(at) & np.isfinite(acceleration)
    if np.sum(known) < _LEAST or not np.ptp(at[known]):
        return []
    left = _without_inertia(current.values[known], at[known], acceleration[known])
    correlation = float(np.corrcoef(left, at[known])[0, 1]) if left is not None and np.ptp(left) else 0.0
    if correlation > -_AGAINST:
        return []
    return [
        f"ClampForceRef falls while CurrentQ rises (correlation {correlation:.2f}), and positive current clamps: "
        "`scale: -1` of one of the two?"
    ]


def _find_driving_friction(speed: Series, current: Series, force: Series | None) -> list[str]:
    """A line if the current that neither load nor inertia explains opposes the motion, which friction's does not."""
    times = current.time_ns
    at, load = speed.sampled(times), np.zeros(len(times)) if force is None else force.sampled(times)
    moving = np.isfinite(load) & (np.abs(at) > _MOVING * np.nanquantile(np.abs(at), 0.99))
    direction = np.sign(at[moving])
    if min(np.sum(direction > 0.0), np.sum(direction < 0.0)) < _LEAST:
        return []
    known = np.stack([np.ones(len(times)), load, np.gradient(at, 1e-9 * times)], axis=1)[moving]
    columns = np.column_stack([current.values[moving], direction])
    left = columns - known @ np.linalg.lstsq(known, columns)[0]
    correlation = float(np.corrcoef(left.T)[0, 1]) if np.all(np.ptp(left, axis=0) > 0.0) else 0.0
    if correlation > -_AGAINST:
        return []
    return [
        f"CurrentQ is less in the direction of motion than against it (correlation {correlation:.2f}), as if friction drove "
        "the motor: `scale: -1` of MotorAngle and MotorSpeed?"
    ]


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
    return jump if alike or not angle.is_sparse else 0.0


def _by_travel(angle: Series, other: Series) -> tuple[float, float]:
    """Means of another signal over the lowest and the highest part of the travel with enough samples."""
    at = other.sampled(angle.time_ns)
    known = np.isfinite(at)
    part = np.minimum(_PARTS * (angle.values - angle.values.min()) / np.ptp(angle.values), _PARTS - 1).astype(int)
    means = [np.mean(at[known & (part == n)]) for n in range(_PARTS) if np.sum(known & (part == n)) >= _LEAST_IN_PART]
    return (float(means[0]), float(means[-1])) if len(means) > 1 else (0.0, 0.0)


def _without_inertia(current: np.ndarray, load: np.ndarray, acceleration: np.ndarray) -> np.ndarray | None:
    """The current that does not accelerate the motor; None if load and acceleration cannot be separated, as in a sine."""
    if not np.ptp(acceleration):
        return current
    if abs(np.corrcoef(load, acceleration)[0, 1]) > _TOLD_APART:
        return None
    columns = np.stack([np.ones(len(load)), load, acceleration], axis=1)
    return current - np.linalg.lstsq(columns, current)[0][2] * acceleration


def _is_of_either_sign(force: Series) -> bool:
    """Whether a load pulls as it pushes: no clamp force does, whichever way its sensor counts."""
    low, high = np.quantile(force.values, (0.01, 0.99))
    return bool(min(-low, high) > _FOLLOWS * max(-low, high))


def _find_turned_current(angle: Series, current: Series) -> list[str]:
    acceleration = np.gradient(angle.derivative().values, 1e-9 * angle.time_ns)
    at = current.sampled(angle.time_ns)
    known = np.isfinite(at) & np.isfinite(acceleration)
    if np.sum(known) < _LEAST:
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


def _find_turned_force(angle: Series, force: Series) -> list[str]:
    low, high = _by_travel(angle, force)
    largest = float(np.quantile(np.abs(force.values), 0.99))
    if abs(high - low) < _FOLLOWS * largest:
        return []
    if (reached := np.max(np.abs(force.values))) < _LEAST_CLAMP_N:
        return [f"ClampForceRef reaches {reached:.3g} N, which clamps nothing; is its unit right?"]
    if high < low:
        what = "ClampForceRef" if abs(high) > abs(low) else "MotorAngle and MotorSpeed"
        return [f"ClampForceRef falls from {low:.4g} N to {high:.4g} N while MotorAngle rises: `scale: -1` of {what}?"]
    return []
