"""Backlash: after a reversal the motor turns through the gear's lost motion before the spindle follows."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit

STATE = np.dtype([("known", "?"), ("follower", "f8")], align=True)


@njit
def term(p: Record, s: Record, m: Record) -> float:
    """Angle in rad by which the spindle lags the motor."""
    if p.play_rad == 0.0:
        return 0.0
    half = 0.5 * abs(p.play_rad)
    if not s.known:
        s.known = True
        s.follower = m.angle - half
    s.follower = min(max(s.follower, m.angle - half), m.angle + half)
    return (s.follower - m.angle + half) * (1.0 if p.play_rad > 0.0 else -1.0)


EFFECT = Effect(
    name="backlash",
    hook="motor_angle",
    term=term,
    parameters=(Parameter("play_rad", "rad", 0.0, 2.0, 0.1, "lost motion at the motor shaft", drawn=(0.0, 2.0)),),
    equation="θ → play(θ, b)",
    source="Nordin, Gutman, Controlling mechanical systems with backlash, Automatica 38, 2002",
    state=STATE,
    signal="motor_speed",
    manoeuvre="reversals at low and at high force: lost motion is an angle, hysteresis is a share of the force",
)
