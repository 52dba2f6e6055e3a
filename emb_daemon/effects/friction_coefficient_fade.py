"""Pad fade: hot pads have less friction, so braking produces less heat than the friction table says."""

from emb_daemon.effects.base import Effect, Parameter, Placebo, at_another_time
from emb_daemon.jit import Record, njit

#: Most of the coefficient of friction that can be lost.
_MOST = 0.8


@njit
def term(p: Record, surface: float) -> float:
    """Coefficient of friction at the pads' ``surface`` temperature (degC) over that without fade, minus one."""
    if p.fade_per_K == 0.0:
        return 0.0
    return -min(p.fade_per_K * max(surface - p.onset_C, 0.0), _MOST)


EFFECT = Effect(
    name="friction_coefficient_fade",
    hook="pad_friction",
    term=term,
    parameters=(
        Parameter("fade_per_K", "1/K", -0.003, 0.008, 0.0015, "relative loss of friction above the onset"),
        Parameter("onset_C", "°C", 0.0, 500.0, 150.0, "surface temperature from which friction falls", (20.0, 100.0, 200.0)),
    ),
    equation="μ_b → μ_b [1 − φ (T_surface − T_onset)₊]",
    source="Limpert, Brake Design and Safety, 3rd ed., ch. 2: 0.4 at 150 °C to 0.2 at 350 °C",
    signal="pad_temperature",
    manoeuvre="equal drags from a cold and from a hot start",
    placebos=(Placebo("wheel turning at another time", samples=at_another_time("wheel_speed", "has_wheel_speed")),),
)
