"""Backlash: after a reversal the motor turns through the gear's lost motion before the spindle follows."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import njit

STATE = np.dtype([("known", "?"), ("follower", "f8")], align=True)


@njit
def term(p, s, angle):
    """Angle in rad by which the spindle lags the motor."""
    if p.play_rad == 0.0:
        return 0.0
    half = 0.5 * abs(p.play_rad)
    if not s.known:
        s.known = True
        s.follower = angle - half
    s.follower = min(max(s.follower, angle - half), angle + half)
    return (s.follower - angle + half) * (1.0 if p.play_rad > 0.0 else -1.0)


EFFECT = Effect(
    name="backlash",
    path="stiffness",
    parameters=(Parameter("play_rad", "rad", 0.0, 2.0, 0.1, "lost motion at the motor shaft"),),
    equation="θ → play(θ, b)",
    source="Nordin, Gutman, Controlling mechanical systems with backlash, Automatica 38, 2002",
    state=STATE,
    signal="motor_speed",
    manoeuvre="reversals at low and at high force: lost motion is an angle, hysteresis is a share of the force",
)
