"""An effect from outside the package, for a program that tries one out before it moves in.

The estimator keeps the parameters of all effects in one record and calls their terms through `paths`; both are fixed when it
is imported, because they are compiled together. So `extend` comes before everything else of the package.
"""

import inspect
import sys
from pathlib import Path

import numpy as np

from emb_daemon import effects
from emb_daemon.effects import paths
from emb_daemon.effects.base import Effect
from emb_daemon.jit import depend_on


def extend(effect: Effect, **points) -> None:
    """Add ``effect`` to the registry: estimator, calibration files and diagnose of this process know it from now on.

    Args:
        points: functions of `paths` that the effect replaces by its own, which call the package's and add their term.

    Raises:
        RuntimeError: the estimator is imported already.
        ValueError: the name is taken, or there is no such point.
    """
    if "emb_daemon.estimator.records" in sys.modules:
        raise RuntimeError("extend: the estimator is imported already; call this before importing anything that uses it")
    if effect.name in (known.name for known in effects.REGISTRY):
        raise ValueError(f"extend: there is an effect {effect.name}")
    for point, function in points.items():
        if not hasattr(paths, point):
            raise ValueError(f"extend: emb_daemon.effects.paths has no {point}")
        setattr(paths, point, function)
        depend_on(Path(inspect.getfile(inspect.unwrap(getattr(function, "py_func", function)))))
    effects.REGISTRY = (*effects.REGISTRY, effect)
    effects.EFFECT_PARAMETERS = _with(effects.EFFECT_PARAMETERS, effect.name, effect.parameter_record)
    if effect.state is not None:
        effects.EFFECT_STATES = _with(effects.EFFECT_STATES, effect.name, effect.state)


def _with(record: np.dtype, name: str, field: np.dtype) -> np.dtype:
    return np.dtype([*((known, record[known]) for known in record.names), (name, field)], align=True)
