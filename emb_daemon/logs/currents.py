"""Whether a current is the motor's own and of its time: what load, friction and acceleration explain of it."""

import numpy as np

from emb_daemon.calibration.types import Motor
from emb_daemon.jit import Records
from emb_daemon.logs.series import Series

#: Least number of samples, and number of those that are judged.
LEAST, JUDGED = 200, 50_000
#: Correlation of force and current without acceleration below minus which the sign of one is wrong. Friction that holds the
#: force while the current falls leaves 0.7 to 0.9 of it in hard motion and in slow clamps.
AGAINST = 0.5
#: How many times more of a current the load must leave than its power or its size, or it is the motor's: of 120 drawn
#: machines, and of 47 recordings, the motor's leaves up to 1.02 times as much, a supply's or one without its sign mostly 1.3
#: and more. How often the signs of what a current needs are told again from the last fit, and how far, as a share of its
#: range, a current without a sign goes to the other side: on a dynamometer that drives one way the motor's own goes by 0.04.
_OTHERWISE, _SIGNS, _OF_ONE_SIGN = 1.25, 10, 0.02
#: Share of the highest speed from which the motor moves.
_MOVING = 0.05
#: What is as good as the best.
_AS_GOOD = 1.3
#: Least delay of a current that is said, half a cycle of ours, and longest that is looked for beside an acceleration, which a
#: longer part of a motion that repeats itself resembles, and beside a load, whose sensor may have a slow filter, ms; how many
#: times less of the current they must then leave: machines whose current is of its time gain up to 1.46, one at 67 Hz whose
#: current is not 5.7; number of samples that are compared.
_LEAST_CURRENT_MS, _BESIDE_MOTION_MS, _BESIDE_LOAD_MS, _CURRENT_BETTER, _COMPARED = 2, 30, 150, 1.5, 10_000
#: Partial correlation of current and acceleration from which the inertia is told (0.75 and more in motion, 0.3 in slow clamps,
#: 0.5 at a false 11 times where 10 Hz miss the motion), and how many times another than the stated one it then is: a unit
#: beyond its tolerances is within 1.5, a gear or another unit of an angle is not.
_TOLD_INERTIA, _OTHER_INERTIA = 0.8, 3.0
#: By how much what load and acceleration need of a current may differ to be the same share, and how far from one that is
#: another scale: eleven logs of changed brakes are within 4 % and, where magnets have faded, 1.16; an effective value is 0.71.
_SAME_SHARE, _OTHER_CURRENT = 0.1, 1.25
#: Correlation, and share of the inertia, below which the current does not accelerate the motor, and least share of the current
#: that acceleration would then need.
_NO_INERTIA, _MUCH = 0.5, 0.5
#: Share of a current's samples, where it does not rest, that stay or go on exactly straight from which nobody measured it: of
#: 23 commands of two drives 0.96 and more do, of the currents that the same drives measured at most 0.2, of a column of which
#: each value stands twice a half. By how much straight is exact, and how far a step goes at least, as shares of the range, so
#: that it is not the count of a coarse sensor; least number of steps, or of samples that climb.
_NOT_MEASURED, _EXACT, _STEP, _STEPS, _CLIMBS = 0.9, 1e-6, 0.05, 3, 20


def left_of(values: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """What least squares over ``columns``, (n, k), leave of values, (n,) or (n, m)."""
    return values - columns @ np.linalg.lstsq(columns, values)[0]


def _in_motion(samples: Records, beside: np.ndarray) -> np.ndarray:
    """Speed, current, acceleration and another signal, (n,), of SAMPLE rows in which the motor moves and all is known; none if
    they are few, or so rare that it is accelerated and braked again between them."""
    speed, current = (samples[name].astype(float) for name in ("speed", "current_q"))
    acceleration = np.gradient(speed, 1e-9 * samples["time_ns"]) if len(samples) > 1 else np.zeros(len(samples))
    every = np.stack([speed, current, acceleration, beside])
    known = samples["has_current"] & np.isfinite(every[1:]).all(axis=0)
    if not known.any() or Series(samples["time_ns"], speed).is_sparse:
        return every[:, :0]
    rows = np.flatnonzero(known & (np.abs(speed) > _MOVING * np.quantile(np.abs(speed[known]), 0.99)))[:JUDGED]
    return every[:, rows if len(rows) >= LEAST else rows[:0]]


def other_motor(samples: Records, torque_constant_Nm_per_A: float, inertia_kg_m2: float) -> list[str]:
    """A line if the current accelerates the motor of SAMPLE rows as if its inertia were far from the one stated: then angle or
    current is in another unit, of another place, or of another motor."""
    speed, current, acceleration, angle = _in_motion(samples, samples["angle"].astype(float))
    if not len(angle) or not np.ptp(angle):
        return []
    way = (angle - angle[0]) / np.ptp(angle)
    known = np.column_stack([np.ones(len(way)), np.sign(speed), speed, way, way**2, way**3])
    left = left_of(np.column_stack([current, acceleration]), known)
    if not np.all(np.ptp(left, axis=0) > 0.0):
        return []
    correlation = float(np.corrcoef(left.T)[0, 1])
    told_A, needed_A = np.std(left, axis=0) * (1.0, inertia_kg_m2 / torque_constant_Nm_per_A)
    if needed_A > _MUCH * told_A and max(abs(correlation), abs(correlation) * told_A / needed_A) < _NO_INERTIA:
        return [
            f"the current does not accelerate the motor (correlation {correlation:.2f}): is it a phase's, a duty cycle, "
            "without its sign, or of another time?"
        ]
    ratio = float(left[:, 0] @ left[:, 1] / (left[:, 1] @ left[:, 1])) * torque_constant_Nm_per_A / inertia_kg_m2
    if abs(correlation) < _TOLD_INERTIA or 1.0 / _OTHER_INERTIA < ratio < _OTHER_INERTIA:
        return []
    if ratio < 0.0:
        return [f"the current accelerates the motor backwards (correlation {correlation:.2f}): `scale: -1` of one of the two?"]
    return [
        f"the current accelerates the motor as if its inertia were {ratio:.3g} times what is stated: is the angle that of "
        f"a gear's output, or in another unit (`scale: {ratio:.3g}` of angle and speed would agree), the current in another "
        "unit, or is this another motor?"
    ]


def other_current(samples: Records, force_N: np.ndarray, motor: Motor) -> list[str]:
    """A line if the current of SAMPLE rows is the same share of what the load and of what the acceleration need, and not one.

    Other pads or friction change what a load needs, another inertia what acceleration needs; the scale of the current, as an
    effective value's, changes both, and a torque constant within its tolerances neither by as much. ``force_N``: clamp force,
    (n,); NaN where it is not known."""
    speed, current, acceleration, force = _in_motion(samples, force_N)
    if not len(force):
        return []
    rest = np.column_stack([np.ones(len(force)), np.sign(speed), speed, np.sign(speed) * force])
    torques = {"load": motor.gear_gain_m_per_rad * force, "acceleration": motor.inertia_kg_m2 * acceleration}
    explained = motor.torque_constant_Nm_per_A * current
    shares = []
    for name, torque in torques.items():
        others = np.column_stack([rest, *(column for other, column in torques.items() if other != name)])
        left = left_of(np.column_stack([torque, explained]), others)
        if not np.all(np.ptp(left, axis=0) > 0.0) or np.corrcoef(left.T)[0, 1] < _TOLD_INERTIA:
            return []
        shares.append(float(left[:, 0] @ left[:, 1] / (left[:, 0] @ left[:, 0])))
    share = float(np.sqrt(np.prod(shares)))
    if abs(shares[0] / shares[1] - 1.0) > _SAME_SHARE or 1.0 / _OTHER_CURRENT < share < _OTHER_CURRENT:
        return []
    return [
        f"the current is {share:.3g} times what load and acceleration need with the stated torque constant: is it an "
        f"effective value, in another unit, or of another motor? `scale: {1.0 / share:.3g}` of CurrentQ would agree"
    ]


def least_lag(lags: np.ndarray, left: np.ndarray) -> float:
    """The least of the lags with which as little is ``left`` as with any: a motion that repeats itself has several."""
    around = np.pad(left, 1, constant_values=np.inf)
    near = lags[(left <= _AS_GOOD * np.min(left)) & (left <= around[:-2]) & (left <= around[2:])]
    return near[np.argmin(np.abs(near))]


def current_late_ms(current: Series, times: np.ndarray, columns: np.ndarray, longest_ms: int) -> int:
    """Time by which a current comes after what explains it, ``columns`` (n, k) at some ``times`` (ns), negative if before; 0
    if neither is sure, or it is ``longest_ms`` or more."""
    lags_ms = np.arange(-longest_ms, longest_ms + 1)
    every = len(times) // _COMPARED + 1
    times, columns = times[::every], columns[::every]
    values = np.stack([current.sampled(times + 1_000_000 * lag_ms) for lag_ms in lags_ms.tolist()], axis=1)
    known = np.isfinite(columns).all(axis=1) & np.isfinite(values).all(axis=1)
    if np.sum(known) < LEAST:
        return 0
    explained, values = np.linalg.qr(columns[known])[0], values[known]
    left_A = np.std(values - explained @ (explained.T @ values), axis=0)
    late_ms, now_A = int(least_lag(lags_ms, left_A)), left_A[longest_ms]
    # At the end of the search it is no delay but a slow motion, in which all is alike.
    sure = _LEAST_CURRENT_MS <= abs(late_ms) < longest_ms and now_A > _CURRENT_BETTER * np.min(left_A)
    return late_ms if sure else 0


def find_late_current(speed: Series, current: Series, force: Series | None) -> list[str]:
    """A line on a current of another time than the load and the acceleration that it explains."""
    times = current.time_ns[:JUDGED]
    at, load = speed.sampled(times), np.zeros(len(times)) if force is None else force.sampled(times)
    columns = np.stack([np.ones(len(times)), load, at, np.sign(at), np.gradient(at, 1e-9 * times)], axis=1)
    late_ms = current_late_ms(current, times, columns, _BESIDE_MOTION_MS if force is None else _BESIDE_LOAD_MS)
    if not late_ms:
        return []
    what, other = ("the acceleration", "are angle and speed") if force is None else ("the load", "is ClampForceRef")
    if late_ms > 0.0:
        return [f"CurrentQ comes {late_ms} ms after {what} that it belongs to: a `mean_ms` longer by {2 * late_ms}?"]
    # A value of the moment that is taken for a mean since the last one comes half a period too early.
    moment = "is it a value of the moment? Then `mean_ms: 0`; or " if -late_ms * 1e6 < current.period_ns else ""
    told = f"CurrentQ comes {-late_ms} ms before {what} that it belongs to: {moment}{other} late?"
    return [f"{told} Then `mean_ms: {-2 * late_ms}` there"]


def find_command(current: Series) -> list[str]:
    """A line if the current's values stay to the bit and then jump, or climb exactly straight: a generator's, without the
    ripple and the noise of a measured one."""
    values, whole = current.values, np.ptp(current.values)
    if len(values) < LEAST or not whole:
        return []
    # A drive that rests is without noise, too, at 0 or at the count beside it.
    levels, counts = np.unique(values, return_counts=True)
    on = values[1:-1] != levels[np.argmax(counts)]
    steps = np.diff(values)
    straight = np.abs(np.diff(steps)) <= _EXACT * whole
    jumps = np.abs(steps[:-1][on & ~straight & (steps[:-1] != 0.0)])
    climbs = np.sum(on & straight & (np.abs(steps[:-1]) > _EXACT * whole))
    if np.sum(on) < LEAST or np.mean(straight[on]) < _NOT_MEASURED:
        return []
    if climbs < _CLIMBS and not (len(jumps) >= _STEPS and np.median(jumps) >= _STEP * whole):
        return []
    return [
        f"{100 * np.mean(straight[on]):.0f} % of CurrentQ's values stay as they are or go on exactly straight, as a command's "
        "do: the motor's own current, measured, has ripple, and is another where the drive does not follow"
    ]


def find_driving_friction(speed: Series, current: Series, force: Series | float) -> list[str]:
    """A line if the current that neither load nor inertia explains opposes the motion, which friction's does not."""
    times = current.time_ns
    at, load = speed.sampled(times), force.sampled(times) if isinstance(force, Series) else np.full(len(times), force)
    moving = np.isfinite(load) & (np.abs(at) > _MOVING * np.nanquantile(np.abs(at), 0.99))
    direction = np.sign(at[moving])
    if min(np.sum(direction > 0.0), np.sum(direction < 0.0)) < LEAST:
        return []
    known = np.stack([np.ones(len(times)), load, np.gradient(at, 1e-9 * times)], axis=1)[moving]
    columns = np.column_stack([current.values[moving], direction])
    left = left_of(columns, known)
    correlation = float(np.corrcoef(left.T)[0, 1]) if np.all(np.ptp(left, axis=0) > 0.0) else 0.0
    if correlation > -AGAINST:
        return []
    # A current that is turned round opposes its load, too; a motion that is turned round does not turn what the load needs.
    explaining = np.column_stack([known[:, 1:], direction, *([known[:, 0]] if isinstance(force, Series) else [])])
    of_load_A_per_N = np.linalg.lstsq(explaining, columns[:, 0])[0][0]
    return [
        f"CurrentQ is less in the direction of motion than against it (correlation {correlation:.2f}), as if friction drove "
        f"the motor: `scale: -1` of {'CurrentQ' if of_load_A_per_N < 0.0 else 'MotorAngle and MotorSpeed'}?"
    ]


def find_other_current(speed: Series, current: Series, force: Series | float) -> list[str]:
    """A line if the current goes with the power of load and acceleration instead of with themselves, as a supply's does, or
    with the size of what they and friction need, as an effective value does."""
    times = current.time_ns[:JUDGED]
    at, load = speed.sampled(times), force.sampled(times) if isinstance(force, Series) else np.full(len(times), force)
    torques = np.stack([load, np.gradient(at, 1e-9 * times)], axis=1)
    # The load of a propeller or a pump is one of the speed, and tells nothing then.
    rest = np.stack([np.ones(len(times)), np.sign(at), at, at * np.abs(at)], axis=1)
    known = np.isfinite(torques).all(axis=1) & np.isfinite(at)
    if np.sum(known) < LEAST:
        return []
    values = current.values[: len(times)][known]
    explaining = (torques, torques * at[:, None])
    by_load_A, by_power_A = (float(np.std(left_of(values, np.hstack([rest, more])[known]))) for more in explaining)
    by_size_A = _left_by_size(values, np.hstack([rest[:, :3], torques])[known])
    if by_load_A > _OTHERWISE * by_size_A and by_size_A < by_power_A:
        return [
            f"CurrentQ goes with the size of what load, friction and acceleration need, of which it leaves {by_size_A:.2g} A, "
            f"and not with that itself, which leaves {by_load_A:.2g} A: a phase's, an effective value? The motor's has a sign"
        ]
    if not isinstance(force, Series) or not by_load_A > _OTHERWISE * by_power_A:
        return []
    return [
        f"CurrentQ goes with the load times the speed, of which it leaves {by_power_A:.2g} A, and not with the load, which "
        f"leaves {by_load_A:.2g} A: a drive takes such a current from its supply, and the motor's own is another"
    ]


def _left_by_size(values: np.ndarray, columns: np.ndarray) -> float:
    """What is left of a current without its sign by the size of a sum of columns, (n, k), found from the signs of each of them
    in turn; infinity if it has one."""
    low, high = np.quantile(values, (0.01, 0.99))
    if min(-low, high) > _OF_ONE_SIGN * max(-low, high):
        return np.inf
    values, columns = values[:: len(values) // _COMPARED + 1], columns[:: len(values) // _COMPARED + 1]
    left = []
    for first in columns.T:
        needed = first
        for _ in range(_SIGNS):
            signed = np.where(needed < 0.0, -1.0, 1.0)[:, None] * columns
            needed = columns @ np.linalg.lstsq(signed, values)[0]
        left.append(float(np.std(values - np.abs(needed))))
    return min(left)
