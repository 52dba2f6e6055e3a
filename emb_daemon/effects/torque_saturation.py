"""Torque constant falling with the present current: saturated iron carries less of the flux that makes torque.

Flux linkage is odd in the current, so that its first departure from proportion is cubic and the torque constant's is
quadratic. On a brake the current follows the clamp force, and a slightly nonlinear friction or curve looks the same: this
effect was found on simulated brakes without it. It is therefore tried only on bare actuators; on brakes `diagnose` can make a
term of it, which is tested against the whole grammar.
"""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit

#: Loss beyond which the quadratic is no longer valid; motors stay far below it.
_MOST = 0.5


@njit
def term(p: Record, m: Record) -> float:
    """Relative change of the torque constant."""
    if p.loss_per_A2 == 0.0 or not m.has_current:
        return 0.0
    return -min(p.loss_per_A2 * m.current_q * m.current_q, _MOST)


EFFECT = Effect(
    name="torque_saturation",
    hook="torque_constant",
    term=term,
    parameters=(Parameter("loss_per_A2", "1/A²", 0.0, 0.02, 1e-4, "relative loss of torque constant per squared current"),),
    equation="K_m → K_m (1 − σ I²)",
    source="saturation of the quadrature axis: Gieras, Permanent Magnet Motor Technology, 3rd ed., ch. 5",
    signal="current",
    manoeuvre="strokes at low and at the largest force at the same speed, both ways",
    bare=True,
)
