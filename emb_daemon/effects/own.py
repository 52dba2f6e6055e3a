"""An effect from outside the package, for a program that tries one out before it moves in."""

import inspect
import sys
from pathlib import Path

from emb_daemon import effects
from emb_daemon.effects.base import Effect, plain
from emb_daemon.jit import depend_on


def extend(effect: Effect) -> None:
    """Add ``effect`` to the registry: estimator, calibration files and diagnose of this process know it from now on.

    The estimator's records and hooks are made of the registry when they are imported, so this comes before.

    Raises:
        RuntimeError: the estimator is imported already.
        ValueError: the name is taken.
    """
    if "emb_daemon.effects.paths" in sys.modules or "emb_daemon.estimator.records" in sys.modules:
        raise RuntimeError("extend: the estimator is imported already; call this before importing anything that uses it")
    if effect.name in (known.name for known in effects.REGISTRY):
        raise ValueError(f"extend: there is an effect {effect.name}")
    effects.REGISTRY = (*effects.REGISTRY, effect)
    depend_on(Path(inspect.getfile(plain(effect.term))))
