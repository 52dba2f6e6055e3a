"""The hooks at their places in the physics, as `estimator.step` calls them.

A hook's function is written from the registry when this module is imported: one line for each effect that enters there, in the
order of the registry, which compiled code then calls directly. numba keeps it on disk under the digest of all sources
(`emb_daemon.jit`), so the same registry finds the same compiled code again.
"""

from collections.abc import Callable
from typing import TypeAlias

from emb_daemon import effects
from emb_daemon.effects import disc_thickness_variation, terms
from emb_daemon.effects.base import HOOKS, Hook
from emb_daemon.jit import Record, njit
from emb_daemon.models.thermal import Altered

#: Number of phases that may be open.
PHASES = disc_thickness_variation.PHASES
#: Called with the quantity where the hook has no start, parameters and states of all effects, and the hook's arguments.
_Hook: TypeAlias = Callable[..., float]
#: Least factor on a conductance or a share of heat that is left: heat never flows uphill.
_LEAST = 0.1


def _source(name: str, hook: Hook) -> str:
    """The hook as Python: the quantity it starts from, plus the term of each effect, plus what `terms.look` found."""
    value = "value, " if hook.start is None else ""
    lines = [f"def {name}({value}e, s, {', '.join(hook.arguments)}):"]
    if hook.start is not None:
        lines.append(f"    value = {hook.start!r}")
    for effect in effects.REGISTRY:
        if effect.hook == name:
            own = {"p": f"e.{effect.name}", "s": f"s.{effect.name}", "signals": "s.terms.signal"}
            lines.append(f"    value += {effect.name}({', '.join(own.get(a, a) for a in effect.arguments)})")
    if name in terms.PORTS:
        lines.append(f"    value += s.terms.added[{terms.PORTS.index(name)}]")
    return "\n".join([*lines, "    return value"])


def _compose(name: str) -> _Hook:
    scope = {effect.name: effect.term for effect in effects.REGISTRY} | {"__name__": __name__}
    # numba's cache on disk needs an existing file; the content of this one and of the registry decide.
    exec(compile(_source(name, HOOKS[name]), __file__, "exec"), scope)
    function: _Hook = scope[name]
    return njit(function)


#: Whether an effect uses the signals of terms, which must then be computed even without a term.
_WATCHED = any("signals" in effect.arguments for effect in effects.REGISTRY)


@njit
def look(e: Record, s: Record, p: Record, m: Record) -> None:
    """Signals and amounts of terms at this sample."""
    if _WATCHED or e.count > 0:
        terms.look(e, s, p, m)


thickness: _Hook = _compose("thickness")
motor_angle: _Hook = _compose("motor_angle")
stiffness: _Hook = _compose("stiffness")
force: _Hook = _compose("force")
relaxation_time: _Hook = _compose("relaxation_time")
torque_constant: _Hook = _compose("torque_constant")
current: _Hook = _compose("current")
torque: _Hook = _compose("torque")
gear_gain: _Hook = _compose("gear_gain")
gear_friction: _Hook = _compose("gear_friction")
backplate: _Hook = _compose("backplate")
pad_friction: _Hook = _compose("pad_friction")
disc_change: _Hook = _compose("disc")
_heat_share: _Hook = _compose("heat_share")
_contact_conductance: _Hook = _compose("contact_conductance")
_gap_conductance: _Hook = _compose("gap_conductance")
_pad_conductivity: _Hook = _compose("pad_conductivity")
_disc_cooling: _Hook = _compose("disc_cooling")
_pad_heat: _Hook = _compose("pad_heat")
_disc_heat: _Hook = _compose("disc_heat")


@njit
def static_force(e: Record, s: Record, static: float, travel: float, dt: float) -> float:
    """Static clamp force (N) with what effects add to it after ``travel`` rad in contact."""
    return force(static * stiffness(e, s, travel, dt), e, s, travel, dt)


@njit
def motor_torque(
    e: Record, s: Record, m: Record, nominal: float, angle: float, travel: float, mean_speed: float, disc: float,
    disc_known: bool,
) -> float:  # fmt: skip
    """Motor torque (N m) that reaches the gear; ``nominal`` is the torque constant at 25 degC."""
    constant = nominal * torque_constant(e, s, m, disc, disc_known, m.dt)
    return torque(constant * current(m.current_q, e, s, m, m.dt), e, s, angle, travel, mean_speed, m.dt)


@njit
def backplates(e: Record, s: Record, inner: float, outer: float, dt: float) -> tuple[float, float]:
    """Temperatures (degC) of the backing plates from what their thermocouples show."""
    return backplate(inner, e, s, 0, dt), backplate(outer, e, s, 1, dt)


@njit
def heat_balance(e: Record, s: Record, dt: float) -> Altered:
    """How effects alter the heat balance over ``dt`` seconds."""
    return Altered(
        max(_heat_share(e, s, dt), _LEAST),
        max(_contact_conductance(e, s, dt), _LEAST),
        max(_gap_conductance(e, s, dt), _LEAST),
        max(_pad_conductivity(e, s, dt), _LEAST),
        max(_disc_cooling(e, s, dt), _LEAST),
        _pad_heat(e, s, dt),
        _disc_heat(e, s, dt),
    )


@njit
def doubt_phase(e: Record, s: Record, m: Record) -> None:
    """Before the first samples of a daemon that may have been started at any time: whether the disc's phase is known."""
    disc_thickness_variation.doubt_phase(e.disc_thickness_variation, s.disc_thickness_variation, m)


@njit
def open_phases(s: Record) -> bool:
    """Whether the disc may have one of several phases."""
    return disc_thickness_variation.is_open(s.disc_thickness_variation)


@njit
def beside(s: Record, phase: int) -> float:
    """By how much (m) the disc is thicker, if it has one of the open phases, than it is taken for."""
    return s.disc_thickness_variation.beside[phase]


@njit
def likely(s: Record, phase: int) -> float:
    """Probability of one of the open phases."""
    return s.disc_thickness_variation.likely[phase]


@njit
def believe(s: Record, phase: int, probability: float) -> None:
    """That one of the open phases is the disc's, with a probability from now on."""
    s.disc_thickness_variation.likely[phase] = probability


@njit
def thickness_sigma(s: Record) -> float:
    """Standard deviation (m) of the disc's thickness where its phase is not known."""
    return s.disc_thickness_variation.sigma


@njit
def known_delay(e: Record) -> float:
    """Age of the motor angle (s) that the calibration knows."""
    return e.signal_delay.delay_s
