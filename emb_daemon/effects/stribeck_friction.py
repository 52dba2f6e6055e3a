"""Stribeck friction: at low speed, before a film of lubricant forms, gear friction is higher."""

from math import exp

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit


@njit
def term(p: Record, mean_speed: float) -> float:
    """Friction over Coulomb friction, minus one."""
    if p.rise == 0.0:
        return 0.0
    return p.rise * exp(-abs(mean_speed) / p.speed_rad_per_s)


EFFECT = Effect(
    name="stribeck_friction",
    hook="gear_friction",
    term=term,
    parameters=(
        Parameter("rise", "1", 0.0, 3.0, 0.5, "breakaway over Coulomb friction, minus one", drawn=(0.0, 3.0)),
        Parameter(
            "speed_rad_per_s",
            "rad/s",
            0.2,
            60.0,
            5.0,
            "speed at which the rise has fallen to 1/e",
            (2.0, 6.0, 20.0),
            drawn=(2.0, 20.0),
        ),
    ),
    equation="T_f → T_f [1 + r exp(−|ω|/ω_s)]",
    source="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994: T_s/T_c 1.3 to 2",
    signal="motor_speed",
    manoeuvre="very slow strokes and fast ones",
)
