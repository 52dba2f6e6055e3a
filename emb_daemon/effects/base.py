"""Structure of an effect, and the hooks in the physics at which effects add."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emb_daemon.effects.terms import PORTS


@dataclass(frozen=True)
class Hook:
    """A quantity of the estimator's physics to which terms of effects add.

    Attributes:
        unit: of the quantity, and therefore of a term's return value.
        start: the quantity without any effect; None if the caller passes it (see ``value``).
        arguments: names of arguments that a term may have, in addition to its parameters ``p``, its state ``s`` and
            ``value``: the quantity with the terms of all effects before it in the registry. ``m`` is the SAMPLE; the others
            are in SI units.
        path: ``stiffness``, ``torque`` or ``thermal``.
        channel: residual in which a change of the quantity shows.
        like: base parameter (key of the calibration) that changes the same quantity, or None. The regressor of a function of
            a signal at this hook is that of the parameter, times the function.
    """

    unit: str
    start: float | None
    arguments: tuple[str, ...]
    path: str
    channel: str
    like: str | None = None


_GEAR = ("angle", "travel", "mean_speed", "friction_mean", "past_contact", "force", "dt")

#: Hooks by name, in the order in which a sample passes through them.
HOOKS = {
    # Growth of disc and pads since power-on, along the pads' travel.
    "thickness": Hook(
        "m", 0.0, ("m", "disc", "disc_known", "power", "dt"), "stiffness", "stiffness", "contact.clearance_rad"
    ),
    # Angle by which the spindle is ahead of the measured motor angle; ``lately`` the last speeds (`models.lateness.LATELY`).
    "motor_angle": Hook("rad", 0.0, ("m", "lately", "dt"), "stiffness", "stiffness", "contact.clearance_rad"),
    # Factor on the static clamp force, after ``travel`` rad in contact.
    "stiffness": Hook("1", 1.0, ("travel", "dt"), "stiffness", "stiffness"),
    # Static clamp force.
    "force": Hook("N", None, ("travel", "dt"), "stiffness", "stiffness"),
    # Factor on the relaxation time of the clamp force.
    "relaxation_time": Hook("1", 1.0, ("travel", "dt"), "stiffness", "stiffness"),
    # Factor on the torque constant. Its terms are also called with dt 0, and must then not change their state.
    "torque_constant": Hook(
        "1", 1.0, ("m", "disc", "disc_known", "dt"), "torque", "torque", "motor.torque_constant_Nm_per_A"
    ),
    # Current of the motor.
    "current": Hook("A", None, ("m", "dt"), "torque", "torque"),
    # Motor torque that reaches the gear; ``angle`` of the motor at the end of the cycle, rad, in which it went ``travel`` rad.
    "torque": Hook("N·m", None, ("angle", "travel", "mean_speed", "dt"), "torque", "torque"),
    # Factors on the gear gain and on gear friction; ``friction_mean`` in [-1, 1] is the friction state, positive while
    # clamping, ``past_contact`` the motor angle past contact, rad.
    "gear_gain": Hook("1", 1.0, _GEAR, "torque", "torque"),
    "gear_friction": Hook("1", 1.0, _GEAR, "torque", "torque"),
    # Temperature of a backing plate, degC; ``side`` 0 is the inner one.
    "backplate": Hook("K", None, ("side", "dt"), "thermal", "temperature"),
    # Factor on the pads' coefficient of friction at their ``surface`` temperature, degC.
    "pad_friction": Hook("1", 1.0, ("surface",), "thermal", "brake_torque"),
    # Change of the disc temperature over ``dt`` that the disc model lacks.
    "disc": Hook("K", 0.0, ("heat_capacity", "disc", "ambient", "dt"), "thermal", "temperature"),
    # Factors on the pads' share of the friction power, on the conductances from pads to disc (pressed on it, and across the
    # gap) and through the pads, and on the disc's convection.
    "heat_share": Hook("1", 1.0, ("dt",), "thermal", "temperature"),
    "contact_conductance": Hook("1", 1.0, ("dt",), "thermal", "temperature"),
    "gap_conductance": Hook("1", 1.0, ("dt",), "thermal", "temperature"),
    "pad_conductivity": Hook("1", 1.0, ("dt",), "thermal", "temperature"),
    "disc_cooling": Hook("1", 1.0, ("dt",), "thermal", "temperature"),
    # Heat beside the friction power of a brake that is applied: into both friction surfaces together, and into the disc.
    "pad_heat": Hook("W", 0.0, ("dt",), "thermal", "temperature"),
    "disc_heat": Hook("W", 0.0, ("dt",), "thermal", "temperature"),
}  # fmt: skip


#: Names that the functions composed of terms (`effects.paths`) use themselves.
_TAKEN = {"e", "s", "value", "terms"}.union(*(hook.arguments for hook in HOOKS.values()))
#: Units in which the catalogue's bounds are those of a brake's motor. Other machines are of any size.
OF_THE_MOTOR = ("A", "N·m", "N·m·s/rad", "1/A²")


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect. ``low`` and ``high`` bound it in a brake; ``prior`` is the size expected from physics.

    The term is linear, or nearly so, in its amplitudes and vanishes with them. A parameter with ``starts`` shapes the
    term instead (a time constant, an order) and has no effect while the amplitudes are zero; the starts cover its range.

    Attributes:
        drawn: range from which blind trials draw it; None: not drawn. Effects are drawn if all their parameters are.
        group: amplitudes of one group are accepted or rejected together (cosine and sine of one order).
    """

    name: str
    unit: str
    low: float
    high: float
    prior: float
    meaning: str
    starts: tuple[float, ...] = ()
    drawn: tuple[float, float] | None = None
    group: str = ""

    def bounds(self, clamps: bool) -> tuple[float, float]:
        """Least and largest value in a calibration: of an actuator that ``clamps``, or of any other machine."""
        if clamps or self.unit not in OF_THE_MOTOR:
            return self.low, self.high
        return (-np.inf if self.low < 0.0 else self.low), np.inf


@dataclass(frozen=True)
class Placebo:
    """A disturbance that must destroy the finding: with it, the effect must explain less than half of what it explains.

    Attributes:
        text: what is disturbed, in the report's words.
        samples: (SAMPLE rows, episode of each row, random generator) → disturbed rows, over which the term then runs.
        signal: (the effect's ``signal`` at each sample, episode, random generator) → disturbed signal, which the term then
            follows; for effects that enter where a base parameter does (`Hook.like`) in proportion to their signal.
        order: order of a harmonic → orders that it cannot be.
    """

    text: str
    samples: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray] | None = None
    signal: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray] | None = None
    order: Callable[[float], tuple[float, ...]] | None = None

    def __post_init__(self) -> None:
        if sum(way is not None for way in (self.samples, self.signal, self.order)) != 1:
            raise ValueError(f"placebo {self.text}: expected one of samples, signal and order")


@dataclass(frozen=True)
class Harmonic:
    """A shape that is searched over its whole range: the order of a cosine and sine over the motor angle.

    Attributes:
        order, cosine, sine: names of the parameters.
        whole: the order is a whole number, chosen and not fitted.
        grows_with: signal to which the harmonic's amplitude is proportional, or None.
    """

    order: str
    cosine: str
    sine: str
    whole: bool = False
    grows_with: str | None = None


@dataclass(frozen=True)
class Effect:
    """Description of an effect for the estimator, the calibration and diagnose.

    Attributes:
        hook: where it enters, one of `HOOKS`.
        term: function that gives the amount to add, compiled (`emb_daemon.jit.njit`), exactly zero at zero amplitudes. The
            names of its arguments select what it gets: ``p`` its parameters, ``s`` its state, ``value``, the arguments of the
            hook and, at hooks that are ports of terms, their ``signals`` (`effects.terms.SIGNALS`).
        equation: the term as an engineer writes it.
        source: paper, standard or textbook.
        state: numpy dtype of the term's state, or None.
        signal: signal of which the effect is a function; evidence is plotted over it.
        manoeuvre: what to do on the rig to make the effect visible and to distinguish it from others.
        placebos: disturbances that must destroy the finding.
        harmonic: how its shape is searched, if it is a harmonic of the motor angle.
        beside: effect of which it is an additional element, and without which it is not tried.
        opposes: effect that does the opposite, so that a first fit, which knows of neither, tries one of the two: together
            they make up for each other.
        bare: whether it is tried only on an actuator that clamps nothing.
        measure: (SAMPLE rows of a log) → the amplitude and its standard deviation as signals alone tell them, without a model
            of the brake. A search begins from there: from nothing no line leads to what is many samples away.
    """

    name: str
    hook: str
    term: Callable
    parameters: tuple[Parameter, ...]
    equation: str
    source: str
    state: np.dtype | None = None
    signal: str = "clamp_force"
    manoeuvre: str = ""
    placebos: tuple[Placebo, ...] = ()
    harmonic: Harmonic | None = None
    beside: str = ""
    opposes: str = ""
    bare: bool = False
    measure: Callable[[np.ndarray], tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        if self.hook not in HOOKS:
            raise ValueError(f"effect {self.name}: there is no hook {self.hook}; there are {', '.join(HOOKS)}")
        if self.name in _TAKEN:
            raise ValueError(f"effect {self.name}: expected another name, which no argument of a hook has")
        offered = {"p", "value", *HOOKS[self.hook].arguments} | ({"s"} if self.state is not None else set())
        offered |= {"signals"} if self.hook in PORTS else set()
        if unknown := set(self.arguments) - offered:
            raise ValueError(f"effect {self.name}: {self.hook} does not offer {', '.join(sorted(unknown))}")

    @property
    def arguments(self) -> tuple[str, ...]:
        """Names of the term's arguments."""
        return tuple(inspect.signature(plain(self.term)).parameters)

    @property
    def path(self) -> str:
        return HOOKS[self.hook].path

    @property
    def channel(self) -> str:
        return HOOKS[self.hook].channel

    @property
    def parameter_record(self) -> np.dtype:
        return np.dtype([(parameter.name, "f8") for parameter in self.parameters], align=True)

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """Parameters that switch the term on."""
        return tuple(parameter for parameter in self.parameters if not parameter.starts)

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        """Parameters that only shape it."""
        return tuple(parameter for parameter in self.parameters if parameter.starts)

    @property
    def by_turns(self) -> bool:
        """Whether each turn of the disc shows it anew, so that chance counts those and not episodes."""
        return self.signal == "disc_angle"

    def parameter(self, name: str) -> Parameter:
        return next(parameter for parameter in self.parameters if parameter.name == name)


def plain(function: Callable) -> Callable:
    """The Python function under a compiled one."""
    return inspect.unwrap(getattr(function, "py_func", function))


def of_another_episode(signal: np.ndarray, episode: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Each episode gets the mean of another one. Temperatures mostly rise in a log, so a shift in time would change little."""
    count = np.maximum(np.bincount(episode), 1)
    return random.permutation(np.bincount(episode, signal) / count)[episode]


def at_another_time(*fields: str) -> Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]:
    """Shifts some fields of the samples by a quarter to three quarters of the log, cyclically."""

    def disturb(samples: np.ndarray, _episode: np.ndarray, random: np.random.Generator) -> np.ndarray:
        shift = int(len(samples) * random.uniform(0.25, 0.75))
        disturbed = samples.copy()
        for field in fields:
            disturbed[field] = np.roll(samples[field], shift)
        return disturbed

    return disturb
