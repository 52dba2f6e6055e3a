"""Ripple of the gear's transmission ratio over the motor angle: its torque grows with the load."""

from math import cos, sin

from emb_daemon.effects.base import Effect, Harmonic, Parameter, Placebo
from emb_daemon.jit import Record, njit


@njit
def cycle_mean(cosine: float, sine: float, order: float, angle: float, travel: float) -> float:
    """Mean of cosine cos(n x) + sine sin(n x) over a cycle in which x went ``travel`` rad and ended at ``angle``."""
    phase = order * (angle - 0.5 * travel)
    half = 0.5 * order * travel
    mean = sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    return mean * (cosine * cos(phase) + sine * sin(phase))


@njit
def term(p: Record, angle: float, travel: float) -> float:
    """Gear gain over its mean, minus one, mean over the cycle."""
    if p.cosine == 0.0 and p.sine == 0.0:
        return 0.0
    return cycle_mean(p.cosine, p.sine, p.order_per_turn, angle, travel)


def _off(order: float) -> tuple[float, ...]:
    """Placebo: orders without a simple ratio to the one found; anything that is not a ripple shows there as well."""
    return 0.73 * order, 1.37 * order


EFFECT = Effect(
    name="gear_mesh_ripple",
    hook="gear_gain",
    term=term,
    parameters=(
        Parameter("cosine", "1", -0.5, 0.5, 0.05, "cosine of the relative ripple over motor angle", drawn=(-0.5, 0.5)),
        Parameter("sine", "1", -0.5, 0.5, 0.05, "its sine", drawn=(-0.5, 0.5)),
        Parameter("order_per_turn", "1", 0.05, 100.0, 10.0, "ripples per motor turn", (0.05, 100.0), drawn=(1.3, 12.0)),
    ),
    equation="γ → γ [1 + c cos nθ + d sin nθ]",
    source="transmission error: Smith, Gear Noise and Vibration, 2nd ed., ch. 1",
    signal="motor_angle",
    manoeuvre="slow strokes under load: ripple grows with force, cogging does not",
    placebos=(Placebo("another order", order=_off),),
    harmonic=Harmonic("order_per_turn", "cosine", "sine", grows_with="clamp_force"),
)
