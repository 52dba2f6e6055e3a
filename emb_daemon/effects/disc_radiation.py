"""Radiation of the disc beyond that in the calibration: it dominates while a hot disc stands still."""

from emb_daemon.effects.base import Effect, Parameter, Placebo, at_another_time
from emb_daemon.jit import Record, njit
from emb_daemon.models.thermal import KELVIN, STEFAN_BOLTZMANN


@njit
def term(p: Record, heat_capacity: float, disc: float, ambient: float, dt: float) -> float:
    """Change of the disc temperature in K over ``dt`` seconds."""
    if p.area_m2 == 0.0:
        return 0.0
    hot, cold = disc + KELVIN, ambient + KELVIN
    return -p.area_m2 * STEFAN_BOLTZMANN * (hot * hot * hot * hot - cold * cold * cold * cold) * dt / heat_capacity


EFFECT = Effect(
    name="disc_radiation",
    hook="disc",
    term=term,
    parameters=(Parameter("area_m2", "m²", -0.3, 1.0, 0.1, "emissivity times radiating area"),),
    equation="C dT_disc/dt → … − ε A σ (T⁴ − T_ambient⁴)",
    source="thesis 8.2 lumps it into convection; Limpert, Brake Design and Safety, 3rd ed., ch. 3",
    signal="disc_temperature",
    manoeuvre="let a disc of more than 300 °C cool while it stands",
    placebos=(Placebo("wheel turning at another time", samples=at_another_time("wheel_speed", "has_wheel_speed")),),
)
