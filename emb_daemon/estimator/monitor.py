"""An independent monitor: bounds on the clamp force from motor current and direction of motion alone.

It shares no state and nothing learned with the filter, and of the calibration it takes what a datasheet states: torque
constant, gear, friction, largest force. Each is allowed to be wrong by the bounds below. What effects add to the friction,
which may follow the estimated force, only widens them. Over torque smoothed for `SMOOTHED_S`, less what accelerates the motor,

    lowest torque - offset - friction  <=  gear gain * force  <=  highest torque + offset + friction

where friction counts against the motion if the motor turns and either way if it stands. Of a gear that is not constant the
largest gain is used on the left and the least on the right, because no angle is used here; a release spring counts in full on
the left and not at all on the right. A force that stays outside for `TOLERATED_S` is contradicted. A latched brake needs no
current, so with the park brake on there is no upper bound.

Pads only push. If a standing motor shows less torque than is possible with an open brake, the offset of its current sensor is
larger than a healthy one's, by at least that difference; from then on that much is added on the right.
"""

from math import exp

import numpy as np

from emb_daemon.jit import Record, fields, njit
from emb_daemon.models.gear import most_of_spring, steepest

#: Time over which the torque is smoothed: longer than the motor needs to reach its speed; and time for which a force may lie
#: outside, s: a whole stroke of acceleration and braking.
SMOOTHED_S, TOLERATED_S = 0.1, 0.4
#: Motor torque per current over the datasheet's: magnets of a motor at its limit lose a third, tolerance adds 5 %.
LEAST_GAIN, MOST_GAIN = 0.6, 1.1
#: Friction over the calibration's: a dry or worn gear.
MOST_FRICTION = 2.0
#: Offset of the current sensor as torque, share of what the largest force needs.
OFFSET_SHARE = 0.05
#: Least gear gain minus friction with which a torque bounds the force from above; below it the gear is self-locking.
_NOT_LOCKED = 0.2
#: Time for which a standing motor must show too little torque for that, s: longer than it is pressed against its stop.
_SHOWN_S = 1.0
#: Motor speed from which the motor turns, rad/s.
_TURNING_RAD_PER_S = 2.0

#: ``missing``: torque by which the sensor may show too little beyond a healthy one's offset, N m; ``short_s``: for how long it
#: has shown less than that one could.
MONITOR = np.dtype([("started", "?"), *fields("f8", "torque speed low high force outside_s missing short_s")], align=True)


@njit
def bound(w: Record, p: Record, m: Record, friction: float) -> None:
    """Update ``w.low`` and ``w.high``, N, with one SAMPLE ``m``; PARAMETERS ``p``; gear ``friction`` over theirs as the
    calibration's effects have it, of which no less than theirs is believed."""
    if not m.has_current:
        w.started, w.low, w.high = False, 0.0, p.maximum_force
        return
    accelerating = p.inertia * (m.speed - w.speed) / m.dt if w.started and m.dt > 0.0 else 0.0
    share = 1.0 - exp(-m.dt / SMOOTHED_S) if w.started else 1.0
    w.torque += share * (p.torque_constant * m.current_q - accelerating - w.torque)
    w.speed, w.started = m.speed, True
    offset = OFFSET_SHARE * p.gear_gain * p.maximum_force
    most_friction = MOST_FRICTION * max(friction, 1.0)
    dry, load = most_friction * p.offset_friction, most_friction * p.load_friction
    least, most = (LEAST_GAIN, MOST_GAIN) if w.torque > 0.0 else (MOST_GAIN, LEAST_GAIN)
    # Friction holds the force up unless the motor closes, and takes torque unless it opens.
    closing, opening = m.speed > _TURNING_RAD_PER_S, m.speed < -_TURNING_RAD_PER_S
    taken, taken_by_load = (0.0, 0.0) if opening else (dry, load)
    held, held_by_load = (0.0, 0.0) if closing else (dry, load)
    # Friction of a standing motor may act either way; the sensor's offset is what even the larger direction leaves.
    unhealthy = LEAST_GAIN * -w.torque > offset + dry and not closing and not opening
    w.short_s = w.short_s + m.dt if unhealthy else 0.0
    if w.short_s > _SHOWN_S:
        w.missing = max(w.missing, MOST_GAIN * -w.torque + dry - offset)
    flat, steep = steepest(p.gear)
    w.low = max((least * w.torque - offset - taken) / ((p.gear_gain + taken_by_load) * steep) - most_of_spring(p), 0.0)
    leverage = p.gear_gain - held_by_load
    latched = not m.has_status or m.park_brake != 0.0
    w.high = p.maximum_force
    if not latched and leverage > _NOT_LOCKED * p.gear_gain:
        w.high = min(max((most * w.torque + offset + w.missing + held) / (leverage * flat), 0.0), p.maximum_force)
    w.low = min(w.low, w.high)


@njit
def contradicts(w: Record, force: float, sigma: float, dt: float) -> bool:
    """Whether ``force`` (N) has lain outside the bounds by more than three of its ``sigma`` for longer than tolerated.

    It is smoothed as the torque is, which lags behind in a long stroke."""
    if not np.isfinite(force):
        return False
    w.force += (1.0 - exp(-dt / SMOOTHED_S)) * (force - w.force)
    outside = w.force > w.high + 3.0 * sigma or w.force < w.low - 3.0 * sigma
    w.outside_s = w.outside_s + dt if outside else 0.0
    return w.outside_s > TOLERATED_S
