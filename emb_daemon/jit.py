"""How kernels run: from a library that was compiled ahead, through numba, or as plain Python.

Everything that compiled code consists of is declared here: `njit` for what kernels call, `entry` for what Python calls in a
tick. With NUMBA_DISABLE_JIT=1 the same functions run as plain Python over the same records, which is how tests compare them.
With a library (`emb_daemon.ahead.library.load`, before anything here is imported) the entry points are its functions, numba is
not imported, and all other functions run as plain Python. If numba is not installed everything runs as plain Python, which is
fast enough to read and check files.
"""

import functools
import importlib.util
import os
from collections.abc import Callable
from math import sqrt
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from emb_daemon.ahead import library
from emb_daemon.ahead.signature import Array, Entry, Function, Kind, name_in_c

__all__ = [
    "ENTRIES", "Array", "Booleans", "Bytes", "Floats", "Integer", "Record", "Records", "compile_beside",
    "compile_within", "compiled_for_the_next_start", "depend_on", "entry", "fields", "hypot", "njit", "sq",
]  # fmt: skip

# What annotations of kernels name. The fields of a `Record` are those of the numpy dtype that the argument's name or the
# docstring says; kernels read and write them as attributes.
Record: TypeAlias = np.void
Records: TypeAlias = NDArray[np.void]
Floats: TypeAlias = NDArray[np.float64]
Booleans: TypeAlias = NDArray[np.bool_]
Bytes: TypeAlias = NDArray[np.uint8]
#: Python's or numpy's, as payloads of frames are.
Integer: TypeAlias = int | np.integer

#: Entry points by name in C, for `emb_daemon.ahead.build`.
ENTRIES: dict[str, Entry] = {}


class _Record(np.void):
    """A record whose fields are attributes, as in compiled code."""

    def __getattribute__(self, name):
        get = super().__getattribute__
        return _with_attributes(self[name]) if name in get("dtype").names else get(name)

    def __setattr__(self, name, value):
        self[name] = value


def _with_attributes(value):
    """A view of records, or of a named tuple of them, whose fields are attributes; anything else as it is."""
    if isinstance(value, np.void | np.ndarray) and value.dtype.names and value.dtype.type is not _Record:
        return value.view(np.dtype((_Record, value.dtype)))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(_with_attributes, value))
    return value


if library.in_use() or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0" or importlib.util.find_spec("numba") is None:

    def njit(function: Function) -> Function:
        """The function itself, over records whose fields are attributes."""

        @functools.wraps(function)
        def call(*arguments, **options):
            return function(*map(_with_attributes, arguments), **options)

        return call

    def compiled_for_the_next_start() -> bool:
        return False

    def compile_beside(
        function: Callable[..., object], work: Callable[[], object], parts: Callable[[], object]
    ) -> Callable[[], object]:
        return lambda: None

    def compile_within(function: Callable[..., object], *arguments: object) -> None:
        pass

    def depend_on(source: Path) -> None:
        if library.in_use():
            raise RuntimeError(f"{source}: is not in the kernels compiled ahead; set {library.VARIABLE}= (empty) to use numba")

else:
    from emb_daemon.numba_cache import compile_beside, compile_within, compiled_for_the_next_start, depend_on, njit


def entry(*takes: Kind, returns: int = 0) -> Callable[[Function], Function]:
    """A function that Python calls in a tick. ``takes`` describes its arguments (see `emb_daemon.ahead.signature`),
    ``returns`` is the number of integers that it returns. Unlike functions of `njit` it is callable in a library compiled
    ahead."""

    def declare(function):
        name = name_in_c(function)
        if library.in_use():
            return functools.wraps(function)(library.bind(name, takes, returns))
        compiled = njit(function)
        ENTRIES[name] = Entry(name, compiled, takes, returns)
        return compiled

    return declare


def fields(kind: str, names: str) -> list[tuple[str, str]]:
    """Fields of a record for compiled code: all of one ``kind`` (``f8``, ``i8``, ``?``), names separated by blanks."""
    return [(name, kind) for name in names.split()]


@njit
def sq(value: float) -> float:
    """Product with itself: where Python raises to a power, the last bit is another now and then."""
    return value * value


@njit
def hypot(a: float, b: float) -> float:
    """Square root of the sum of squares, to the same bit as plain Python: that of `math` is not the C library's."""
    return sqrt(sq(a) + sq(b))
