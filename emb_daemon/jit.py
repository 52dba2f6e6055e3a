"""The one numba entry point of the package.

numba's disk cache is keyed on the file of the compiled function alone, so a change in a kernel that it calls, or in a
record layout, would go unnoticed. The cache folder is therefore named after all sources that compiled code can depend on.

With NUMBA_DISABLE_JIT=1 the same functions run as plain Python over the same records, which is how tests compare them.
"""

import functools
import hashlib
import os
import stat
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from numba.core import config, event

#: A source that mentions one of these takes part in compiled code.
_MARKS = (b"emb_daemon.jit", b"np.dtype(")


def _source_digest(package: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(content)
    return digest.hexdigest()[:16]


def _cache_root() -> Path:
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base.split(":")[0]) / "emb_daemon"


def _cache_folder() -> Path:
    """A writable folder for compiled code: the chosen one or, where that cannot be written or anybody could write to it, one
    for this process alone."""
    folder = _cache_root() / _source_digest(Path(__file__).parent)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            trouble = _foreign(folder)
    except OSError as error:
        trouble = error.strerror
    if not trouble:
        return folder
    global _private
    _private = tempfile.TemporaryDirectory(prefix="emb_daemon-")
    print(
        f"emb_daemon: cannot keep compiled code in {folder} ({trouble}), compiling anew at every start; "
        "set NUMBA_CACHE_DIR to a writable folder of your own",
        file=sys.stderr,
    )
    return Path(_private.name)


def _foreign(folder: Path) -> str:
    """Who else could have put something into the folder, or its parent: what is found there is executed. Root may use what it
    likes, nobody else what is not his own."""
    for path in (folder, folder.parent):
        status = path.stat()
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"{path} is writable by anybody"
        if os.geteuid() not in (0, status.st_uid) and path == folder:
            return f"{path} belongs to somebody else"
    return ""


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


def _plain(function):
    @functools.wraps(function)
    def call(*arguments, **options):
        return function(*map(_with_attributes, arguments), **options)

    return call


class _Compilations(event.Listener):
    """Counts what is compiled in this process, not what comes from the cache."""

    count = 0

    def on_start(self, _event):
        self.count += 1

    def on_end(self, _event):
        pass


def compiled_for_the_next_start() -> bool:
    """Whether this process has compiled what another start would find in the cache."""
    return _compilations.count > 0 and _private is None


def compile_beside(function, work: Callable[[], object]) -> Callable[[], object]:
    """Let another process do ``work``, which compiles ``function`` and more, while this one compiles something else.

    Only where ``function`` is not in the cache, a second CPU is there, and no other thread that may hold a lock. Returns
    what waits for the end of it.
    """
    possible = threading.active_count() == 1 and len(os.sched_getaffinity(0)) > 1
    if config.DISABLE_JIT or _private is not None or not possible:
        return lambda: None
    if any(Path(config.CACHE_DIR).rglob(f"*.{function.__name__}-*.nbi")):
        return lambda: None
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    return lambda: os.waitpid(child, 0)


_compilations = _Compilations()
event.register("numba:compile", _compilations)
_private: tempfile.TemporaryDirectory | None = None

#: Compile with numba, cached on disk. fastmath stays off: without fused multiply-add a replay is equal on every machine.
if config.DISABLE_JIT:
    njit = _plain
else:
    config.CACHE_DIR = str(_cache_folder())
    njit = numba.njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)


def depend_on(source: Path) -> None:
    """Keep what is compiled from here on apart from what was compiled without this file, or with another version of it."""
    if config.DISABLE_JIT:
        return
    folder = Path(config.CACHE_DIR) / hashlib.sha256(source.read_bytes()).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    config.CACHE_DIR = str(folder)


def fields(kind: str, names: str) -> list[tuple[str, str]]:
    """Fields of a record that compiled code reads: several of one ``kind`` (``f8``, ``i8``, ``?``), names apart by a blank."""
    return [(name, kind) for name in names.split()]
