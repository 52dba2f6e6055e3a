"""Friction proportional to motor speed: lubricant, bearings, eddy currents."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit


@njit
def term(p: Record, mean_speed: float) -> float:
    """Torque in N m that it adds."""
    return -p.viscous_Nms_per_rad * mean_speed


EFFECT = Effect(
    name="viscous_friction",
    hook="torque",
    term=term,
    parameters=(
        Parameter("viscous_Nms_per_rad", "N·m·s/rad", -0.01, 0.05, 1e-4, "torque per motor speed", drawn=(-0.01, 0.05)),
    ),
    equation="T_f → T_f + b ω",
    source="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994",
    signal="motor_speed",
    manoeuvre="strokes at several constant speeds",
)
