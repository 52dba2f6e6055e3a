"""Time by which the resolver's angle is older than the force it is compared with."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit
from emb_daemon.models.lateness import turned_within


@njit
def term(p: Record, lately: Record) -> float:
    """Angle in rad by which the motor has gone on."""
    return turned_within(lately, p.delay_s)


EFFECT = Effect(
    name="signal_delay",
    hook="motor_angle",
    term=term,
    parameters=(Parameter("delay_s", "s", -0.05, 0.05, 0.001, "age of the angle", drawn=(0.0, 0.006)),),
    equation="θ → θ + ∫ ω over the last d",
    source="dead reckoning of a delayed sample by its speed",
    signal="motor_speed",
    manoeuvre="fast and slow strokes over the same forces: a delay grows with motor speed, a relaxation does not",
)
