"""An ideal brake: it obeys the thesis's models exactly, with the parameters that the estimator is given."""

import naive
import numpy as np

from emb_daemon.estimator.records import SAMPLE


def samples(p, angle, dt: float = 0.004, friction=None, temperature: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """SAMPLE rows of a motor that follows ``angle`` (rad past the released position), and the clamp force (N).

    The current is what the torque balance asks for, with friction that turns over within the presliding angle, or with the
    share ``friction`` of full friction at each sample.
    """
    angle = np.asarray(angle, float)
    speed = np.gradient(angle, dt)
    static = np.array([naive.characteristic_curve(x, p["curve"])[0] for x in angle - p["clearance"]])
    force = np.zeros_like(angle)
    for i in range(1, len(angle)):
        force[i] = naive.first_order_lag(force[i - 1], static[i - 1], static[i], dt, p["relaxation_time"])
    mean = 0.5 * (force + np.concatenate([force[:1], force[:-1]]))
    s = np.zeros_like(angle) if friction is None else np.broadcast_to(friction, angle.shape)
    state = 0.0
    for i in range(1, len(angle) if friction is None else 0):
        ratio = (angle[i] - angle[i - 1]) / p["presliding_angle"]
        after = np.sign(ratio) + (state - np.sign(ratio)) * np.exp(-abs(ratio))
        s[i] = np.sign(ratio) + (state - after) / abs(ratio) if ratio else state
        state = after
    acceleration = np.diff(speed, prepend=speed[0]) / dt
    torque = p["gear_gain"] * mean + p["inertia"] * acceleration + s * (p["load_friction"] * mean + p["offset_friction"])
    rows = np.zeros(len(angle), SAMPLE)
    rows["dt"], rows["dt"][0] = dt, 0.0
    rows["angle"], rows["speed"], rows["current_q"] = angle, speed, torque / p["torque_constant"]
    for name in ("inner_backplate", "outer_backplate", "caliper", "ambient"):
        rows[name] = temperature
    rows["brake_torque"] = np.nan
    for name in ("has_current", "has_thermocouple", "has_wheel_speed", "has_wheel_pulse", "has_status"):
        rows[name] = True
    return rows, force


def clamp(p, to_rad: float, seconds: float, dt: float = 0.004) -> np.ndarray:
    """Angles of a steady approach from the released position to ``to_rad`` past contact."""
    return np.linspace(0.0, p["clearance"] + to_rad, round(seconds / dt) + 1)
