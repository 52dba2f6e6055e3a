"""Cogging: the motor's magnets pull towards the stator's teeth, whatever the load."""

from emb_daemon.effects.base import Effect, Harmonic, Parameter, Placebo
from emb_daemon.effects.gear_mesh_ripple import cycle_mean
from emb_daemon.jit import Record, njit


@njit
def term(p: Record, angle: float, travel: float) -> float:
    """Torque in N m that it adds, mean over the cycle."""
    if p.cosine_Nm == 0.0 and p.sine_Nm == 0.0:
        return 0.0
    return -cycle_mean(p.cosine_Nm, p.sine_Nm, p.order_per_turn, angle, travel)


def _between_teeth(order: float) -> tuple[float, ...]:
    """Orders that no stator has."""
    return order - 0.5, order + 0.5


EFFECT = Effect(
    name="cogging_torque",
    hook="torque",
    term=term,
    parameters=(
        Parameter("cosine_Nm", "N·m", -1.0, 1.0, 0.01, "cosine of the torque over motor angle", drawn=(-1.0, 1.0)),
        Parameter("sine_Nm", "N·m", -1.0, 1.0, 0.01, "its sine", drawn=(-1.0, 1.0)),
        Parameter(
            "order_per_turn", "1", 0.9, 100.0, 6.0, "teeth per motor turn: a whole number", (1.0, 72.0), drawn=(4.0, 24.0)
        ),
    ),
    equation="T_m → T_m − c cos nθ − d sin nθ",
    source="Islam, Mir, Sebastian, IEEE Trans. Industry Applications 40(3), 2004",
    signal="motor_angle",
    manoeuvre="slow strokes without load: cogging stays, gear ripple vanishes without load",
    placebos=(Placebo("order between two whole numbers", order=_between_teeth),),
    harmonic=Harmonic("order_per_turn", "cosine_Nm", "sine_Nm", whole=True),
)
