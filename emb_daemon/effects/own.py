"""An effect from outside of the package, for programs that try one out."""

import inspect
import sys
from pathlib import Path

from emb_daemon import effects
from emb_daemon.effects.base import Effect, plain
from emb_daemon.jit import depend_on


def extend(effect: Effect) -> None:
    """Add ``effect`` to the registry, for the estimator, calibration files and diagnose of this process.

    Must be called before the estimator is imported, because its records and hooks are made from the registry then.

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
