"""Time by which the resolver's angle is older than the force it is compared with."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit


@njit
def term(p: Record, m: Record) -> float:
    """Angle in rad by which the motor has gone on."""
    return p.delay_s * m.speed


EFFECT = Effect(
    name="signal_delay",
    hook="motor_angle",
    term=term,
    # First-order correction: good for fifty milliseconds of a slow stroke, and for a cycle and a half of a fast one.
    parameters=(Parameter("delay_s", "s", -0.05, 0.05, 0.001, "age of the angle", drawn=(0.0, 0.006)),),
    equation="θ → θ + d ω",
    source="first-order hold of a delayed sample",
    signal="motor_speed",
    manoeuvre="fast and slow strokes over the same forces: a delay grows with motor speed, a relaxation does not",
)
