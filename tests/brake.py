"""An ideal brake: it obeys the thesis's models exactly, with the parameters that the estimator is given."""

import naive
import numpy as np
from scipy.signal import lfilter

from emb_daemon.estimator.records import SAMPLE


def samples(p, angle, dt: float = 0.004, friction=None, creep=(0.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """SAMPLE rows of a motor that follows ``angle`` (rad past the released position), and the clamp force (N).

    The current is what the torque balance asks for, with friction that turns over within the presliding angle, or with the
    share ``friction`` of full friction at each sample. ``creep``: share of the force that lags, and its time constant, s."""
    angle = np.asarray(angle, float)
    speed = np.gradient(angle, dt)
    travel = np.maximum(angle - p["clearance"], 0.0)
    static = np.polynomial.Polynomial([0.0, *p["curve"]])(travel)
    share, seconds = creep
    force = _lagged(np.maximum(static + share * (_lagged(static, dt, seconds) - static), 0.0), dt, p["relaxation_time"])
    mean = 0.5 * (force + np.concatenate([force[:1], force[:-1]]))
    s = _friction_means(np.diff(angle, prepend=angle[:1]) / p["presliding_angle"]) if friction is None else friction
    acceleration = np.diff(speed, prepend=speed[0]) / dt
    torque = p["gear_gain"] * mean + p["inertia"] * acceleration + s * (p["load_friction"] * mean + p["offset_friction"])
    rows = np.zeros(len(angle), SAMPLE)
    rows["dt"], rows["dt"][0] = dt, 0.0
    rows["angle"], rows["speed"], rows["current_q"] = angle, speed, torque / p["torque_constant"]
    for name in ("inner_backplate", "outer_backplate", "caliper", "ambient"):
        rows[name] = 20.0
    rows["brake_torque"] = np.nan
    for name in ("has_current", "has_thermocouple", "has_wheel_speed", "has_wheel_pulse", "has_status"):
        rows[name] = True
    return rows, force


def _lagged(values, dt, time_constant):
    # The lag is linear and the step constant: its answers to single ones are its coefficients.
    kept, before, now = (naive.first_order_lag(*ones, dt, time_constant) for ones in np.eye(3))
    return lfilter([now, before], [1.0, -kept], values)


def _friction_means(ratio: np.ndarray) -> np.ndarray:
    """Mean of the friction state over each of the ways ``ratio``, in presliding angles, from 0 on."""
    state, means = 0.0, np.empty(len(ratio))
    ways = zip(ratio.tolist(), np.sign(ratio).tolist(), np.exp(-np.abs(ratio)).tolist(), strict=True)
    for row, (way, direction, kept) in enumerate(ways):
        after = direction + (state - direction) * kept
        means[row] = direction + (state - after) / abs(way) if way else state
        state = after
    return means


def clamp(p, to_rad: float, seconds: float, dt: float = 0.004) -> np.ndarray:
    """Angles of a steady approach from the released position to ``to_rad`` past contact."""
    return np.linspace(0.0, p["clearance"] + to_rad, round(seconds / dt) + 1)


def ideal(parameters) -> np.ndarray:
    """Parameters of a brake of the thesis's models alone, with a clearance known to 0.02 rad."""
    p = parameters[0].copy()
    p["effects"] = np.zeros((), p["effects"].dtype)
    return p


def noisy(rows: np.ndarray, p, seed: int = 1) -> np.ndarray:
    """SAMPLE rows with the noise of current and speed that the parameters name."""
    rng = np.random.default_rng(seed)
    rho = np.exp(-0.004 / p["current_correlation_time"])
    noise = lfilter([np.sqrt(1.0 - rho * rho)], [1.0, -rho], rng.normal(size=len(rows)))
    rows = rows.copy()
    rows["current_q"] += p["current_sigma"] * noise
    rows["speed"] += p["speed_sigma"] * rng.normal(size=len(rows))
    return rows


def stops(p, count: int, seed: int = 1, dt: float = 0.004, held_s: float = 1.0) -> np.ndarray:
    """Angles of ``count`` stops of ordinary driving: 1.4 s of standstill in the clearance, an application of 0.3 s to 10 to
    20 rad past contact, ``held_s`` seconds of holding with two reversals, the release."""
    rng = np.random.default_rng(seed)
    parts, time, held_time = [], np.arange(round(0.3 / dt)) * dt / 0.3, np.arange(round(held_s / dt)) * dt / held_s
    rise = 0.5 * (1.0 - np.cos(np.pi * time))
    for _ in range(count):
        top = p["clearance"] + rng.uniform(10.0, 20.0)
        held = top - rng.uniform(0.5, 2.0) * (1.0 - np.cos(4.0 * np.pi * held_time))
        parts += [np.zeros(round(1.4 / dt)), top * rise, held, top * (1.0 - rise)]
    return np.concatenate(parts)


def filtered(values: np.ndarray, cycles: float) -> np.ndarray:
    """Values through a first-order filter of so many samples."""
    shown, state = np.empty_like(values), values[0]
    for row, value in enumerate(values):
        state += (value - state) / (1.0 + cycles)
        shown[row] = state
    return shown


def lose_counts(rows: np.ndarray, share: float) -> None:
    """SAMPLE rows in which a ``share`` of the way is not counted while the motor closes, in place."""
    rows["angle"] -= share * np.cumsum(np.maximum(np.diff(rows["angle"], prepend=rows["angle"][0]), 0.0))
