"""Gear friction that differs between clamping and releasing."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit


@njit
def term(p: Record, friction_mean: float) -> float:
    """Friction over that without direction, minus one; ``friction_mean`` in [-1, 1], positive while clamping."""
    return p.asymmetry * friction_mean


EFFECT = Effect(
    name="friction_asymmetry",
    hook="gear_friction",
    term=term,
    parameters=(
        Parameter(
            "asymmetry", "1", -0.6, 0.6, 0.1, "half the difference of both directions over their mean", drawn=(-0.6, 0.6)
        ),
    ),
    equation="T_f → T_f (1 + a s)",
    source="forward and backward efficiency of screws: Olaru et al., Mech. Mach. Theory 2005",
    signal="motor_speed",
    manoeuvre=(
        "slow strokes both ways over the whole force range, with a torque constant that is known otherwise (back-EMF): an "
        "asymmetry grows with the force, an offset of the current does not"
    ),
)
