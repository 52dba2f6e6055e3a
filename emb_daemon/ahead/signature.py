"""Signatures of entry points, by which they are compiled before they are called, and called without a compiler.

A signature has one element for each argument: `Array`, a numpy dtype for one record of it, a named tuple of these, or ``int``,
``float``, ``bool``. In C a function takes a pointer to words of eight bytes: first what it returns, then for an array its
address and dimensions, for a record its address, for a number itself.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np

#: A function, whose signature a decorator leaves unchanged.
Function = TypeVar("Function", bound=Callable[..., object])


class Array(NamedTuple):
    """A C-contiguous array of ``dtype``."""

    dtype: np.dtype | type
    dimensions: int = 1


#: One element of a signature.
Kind: TypeAlias = "Array | np.dtype | type[int] | type[float] | type[bool] | tuple[object, ...]"


class Entry(NamedTuple):
    """A function that Python calls: its name in C, the ``function`` itself, what it takes, and how many int64 it returns."""

    name: str
    function: Callable[..., object]
    takes: tuple[Kind, ...]
    returns: int


def is_group(kind: Kind) -> bool:
    """Whether an element of a signature is a named tuple of elements."""
    return isinstance(kind, tuple) and not isinstance(kind, Array)


def name_in_c(function: Callable[..., object]) -> str:
    """``emb_pipeline_collect`` for ``emb_daemon.pipeline._collect``."""
    module = function.__module__.removeprefix("emb_daemon.").replace(".", "_")
    return f"emb_{module}_{function.__name__.strip('_')}"
