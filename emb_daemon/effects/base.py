"""The shape that every effect has."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect. ``low`` and ``high`` bound it; ``prior`` is the size physics leads one to expect.

    The term is linear, or nearly so, in its amplitudes and vanishes with them. A parameter with ``starts`` shapes the
    term instead (a time constant, an order) and says nothing while the amplitudes are zero; the starts cover its range.
    """

    name: str
    unit: str
    low: float
    high: float
    prior: float
    meaning: str
    starts: tuple[float, ...] = ()


@dataclass(frozen=True)
class Effect:
    """What the estimator, the calibration and diagnose need to know of an effect.

    Attributes:
        path: ``stiffness``, ``torque`` or ``thermal``.
        equation: the term as an engineer writes it.
        source: paper, standard or textbook.
        state: numpy dtype of what the running term remembers, or None.
        signal: what the effect is a function of; evidence is plotted over it.
        manoeuvre: what a driver of the rig does to make it visible and tell it from others.
        placebo: signal that, disturbed, must destroy the finding: ``wheel_pulse`` or ``disc``; None where there is none.
        forbidden: condition under which physics forbids the term to vary: ``standing`` wheel; None where there is none.
    """

    name: str
    path: str
    parameters: tuple[Parameter, ...]
    equation: str
    source: str
    state: np.dtype | None = None
    signal: str = "clamp_force"
    manoeuvre: str = ""
    placebo: str | None = None
    forbidden: str | None = None

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
