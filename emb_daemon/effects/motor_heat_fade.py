"""Torque constant falling as the motor heats itself: the winding warms with the square of its current, and warms the magnets.

No sensor is near the magnets. The heat of the current in winding and housing is modelled by one lag, whose time constant is
fitted; heat from the surroundings of the motor is in `torque_constant_fade`.
"""

from math import exp

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit

STATE = np.dtype([("heat", "f8")], align=True)


@njit
def term(p: Record, s: Record, m: Record, dt: float) -> float:
    """Relative change of the torque constant; ``s.heat`` is the lagged square of the current, A^2."""
    if p.fade_per_A2 == 0.0:
        return 0.0
    square = m.current_q * m.current_q if m.has_current else s.heat
    s.heat += (1.0 - exp(-dt / p.time_constant_s)) * (square - s.heat)
    return -p.fade_per_A2 * s.heat


EFFECT = Effect(
    name="motor_heat_fade",
    hook="torque_constant",
    term=term,
    parameters=(
        Parameter("fade_per_A2", "1/A²", 0.0, 1e-3, 2e-5, "relative loss of torque constant per squared current, settled"),
        Parameter("time_constant_s", "s", 2.0, 2000.0, 60.0, "of the heat's way to the magnets", (10.0, 60.0, 300.0)),
    ),
    equation="K_m → K_m (1 − κ h),  τ dh/dt + h = I²",
    source="lumped motor heat: Mellor, Roberts, Turner, IEE Proc. B 138(5), 1991; magnets as torque_constant_fade",
    state=STATE,
    signal="current",
    manoeuvre="hold a high force for a minute, then the same strokes again",
)
