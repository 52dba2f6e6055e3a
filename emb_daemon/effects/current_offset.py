"""Offset of the current measurement."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit


@njit
def term(p: Record) -> float:
    """Current in A that flows but is not measured."""
    return p.offset_A


EFFECT = Effect(
    name="current_offset",
    hook="current",
    term=term,
    parameters=(Parameter("offset_A", "A", -20.0, 20.0, 0.3, "current that flows but is not measured", drawn=(-20.0, 20.0)),),
    equation="I → I + I₀",
    source="Hall sensors: offset 0.5 to 1 % of range",
    signal="current",
    manoeuvre=(
        "the current that is measured while the inverter is off is the offset; slow strokes both ways without load: it keeps "
        "its sign, friction changes it"
    ),
)
