"""Torque constant falling with the temperature of the motor's magnets.

The magnets' temperature is not measured. It lies between that of the caliper, which is measured, and that of the disc, which
heats the motor from the other side; a share says where.
"""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter, Placebo, of_another_episode
from emb_daemon.jit import Record, njit

#: Temperature at which torque constants are stated.
RATED_C = 25.0


#: Last temperature of the caliper, degC, if one is ``known``: it stays about that for minutes after its sensor is lost.
_STATE = np.dtype([("known", "?"), ("caliper", "f8")], align=True)


@njit
def term(p: Record, s: Record, m: Record, disc: float, disc_known: bool) -> float:
    """Relative change of the torque constant."""
    if m.has_thermocouple:
        s.known, s.caliper = True, m.caliper
    if p.fade_per_K == 0.0 or not s.known:
        return 0.0
    temperature = s.caliper + (p.disc_share * (disc - s.caliper) if disc_known else 0.0)
    return -p.fade_per_K * (temperature - RATED_C)


EFFECT = Effect(
    name="torque_constant_fade",
    hook="torque_constant",
    term=term,
    parameters=(
        Parameter("fade_per_K", "1/K", -0.005, 0.02, 0.001, "relative loss of torque constant", drawn=(-0.005, 0.02)),
        Parameter(
            "disc_share",
            "1",
            0.0,
            1.0,
            0.0,
            "where the magnets' temperature lies between caliper and disc",
            (0.0, 1.0),
            drawn=(0.3, 1.0),
        ),
    ),
    equation="K_m → K_m [1 − κ (T_caliper + w (T_disc − T_caliper) − 25 °C)]",
    source="NdFeB −0.09 to −0.12 %/K: Gieras, Permanent Magnet Motor Technology, 3rd ed., ch. 2",
    state=_STATE,
    signal="caliper_temperature",
    manoeuvre="the same strokes with a cold and with a hot caliper",
    placebos=(Placebo("temperature of another episode", signal=of_another_episode),),
)
