"""Cogging: the motor's magnets pull towards the stator's teeth, whatever the load."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.effects.gear_mesh_ripple import cycle_mean
from emb_daemon.jit import njit


@njit
def term(p, angle, travel):
    """Torque in N m that it takes, mean over the cycle."""
    if p.cosine_Nm == 0.0 and p.sine_Nm == 0.0:
        return 0.0
    return cycle_mean(p.cosine_Nm, p.sine_Nm, p.order_per_turn, angle, travel)


EFFECT = Effect(
    name="cogging_torque",
    path="torque",
    parameters=(
        Parameter("cosine_Nm", "N·m", -1.0, 1.0, 0.01, "cosine of the torque over motor angle"),
        Parameter("sine_Nm", "N·m", -1.0, 1.0, 0.01, "its sine"),
        Parameter("order_per_turn", "1", 0.9, 100.0, 6.0, "teeth per motor turn: a whole number", (1.0, 72.0)),
    ),
    equation="T_m → T_m − c cos nθ − d sin nθ",
    source="Islam, Mir, Sebastian, IEEE Trans. Industry Applications 40(3), 2004",
    signal="motor_angle",
    manoeuvre="slow strokes in the clearance: cogging stays, gear ripple vanishes without load",
    placebo="order",
)
