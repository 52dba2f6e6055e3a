"""The shape that every effect has."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect. ``low`` and ``high`` bound it; ``prior`` is the size physics leads one to expect."""

    name: str
    unit: str
    low: float
    high: float
    prior: float
    meaning: str


@dataclass(frozen=True)
class Effect:
    """What the estimator, the calibration and diagnose need to know of an effect.

    Attributes:
        path: ``stiffness``, ``torque`` or ``thermal``.
        equation: the term as an engineer writes it.
        source: paper, standard or textbook.
        state: numpy dtype of what the running term remembers, or None.
    """

    name: str
    path: str
    parameters: tuple[Parameter, ...]
    equation: str
    source: str
    state: np.dtype | None = None

    @property
    def parameter_record(self) -> np.dtype:
        return np.dtype([(parameter.name, "f8") for parameter in self.parameters], align=True)
