"""numba for `emb_daemon.jit`: compiled code is stored on disk for the next start.

numba's disk cache is keyed on the file of the compiled function alone, so a change in a kernel that it calls, or in a
record layout, would go unnoticed. The cache folder is therefore named after all sources that compiled code can depend on.
"""

import hashlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from llvmlite.binding import get_host_cpu_features
from numba import typeof
from numba.core import config, event, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.compiler import compile_result
from numba.core.registry import CPUDispatcher

from emb_daemon.ahead.library import installed_digest, who_else_writes
from emb_daemon.ahead.parts import Part, PartCompiler
from emb_daemon.ahead.signature import Function


def _cache_root() -> Path:
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base.split(":")[0]) / "emb_daemon"


def _cache_folder() -> Path:
    """A writable folder for compiled code: the chosen one or, where that cannot be written or others could write to it, one
    for this process alone."""
    folder = _cache_root() / installed_digest()
    try:
        for each in (folder.parent, folder):
            # Independent of the umask: whoever can write to it can have any code executed by this process.
            each.mkdir(0o755, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            trouble = who_else_writes(folder)
    except OSError as error:
        trouble = error.strerror
    if not trouble:
        return folder
    global _private
    _private = tempfile.TemporaryDirectory(prefix="emb_daemon-")
    print(
        f"emb_daemon: cannot keep compiled code in {folder} ({trouble}), so it compiles at every start; "
        "set NUMBA_CACHE_DIR to a writable folder of your own",
        file=sys.stderr,
    )
    return Path(_private.name)


class _Compilations(event.Listener):
    """Counts what is compiled in this process, not what comes from the cache."""

    count = 0

    def on_start(self, _event):
        self.count += 1

    def on_end(self, _event):
        pass


def compiled_for_the_next_start() -> bool:
    """Whether this process has compiled code that another start would load from the cache."""
    return _compilations.count > 0 and _private is None


def compile_beside(
    function: Callable[..., object], work: Callable[[], object], parts: Callable[[], object]
) -> Callable[[], object]:
    """Let another process do ``work``, which compiles ``function`` and more, while this one compiles something else.

    Only if ``function`` is not in the cache, there is a second CPU, and no other thread that may hold a lock. Then this
    process does ``parts`` at once, with `compile_within`: kernels that the work calls late, and then finds in the cache.
    Returns a function that waits for the end of the work."""
    possible = threading.active_count() == 1 and len(os.sched_getaffinity(0)) > 1
    if _private is not None or not possible:
        return lambda: None
    if any(Path(config.CACHE_DIR).rglob(f"*.{function.__name__}-*.nbi")):
        return lambda: None
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    parts()
    return lambda: os.waitpid(child, 0)


def compile_within(function: Callable[..., object], *arguments: object) -> None:
    """Compile a function as kernels call it with ``arguments`` of these types, of which the values do not count."""
    function._within.compile(tuple(map(typeof, arguments)))


_compilations = _Compilations()
event.register("numba:compile", _compilations)
_private: tempfile.TemporaryDirectory | None = None

config.CACHE_DIR = str(_cache_folder())
_V2 = ("cx16", "popcnt", "sahf", "sse4.1", "sse4.2", "ssse3")
#: What LLVM's names for kinds of processors stand for (x86-64 psABI, micro-architecture levels), the best first. A virtual
#: machine may hide any of it.
_KINDS = {
    "x86-64-v3": (*_V2, "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"),
    "x86-64-v2": _V2,
}


def _choose_processor() -> None:
    """Compile for a kind of processors instead of this very one: for AVX-512 LLVM needs minutes instead of seconds, and the
    code is no faster. NUMBA_CPU_NAME says otherwise."""
    features = get_host_cpu_features()
    kind = next((kind for kind, needed in _KINDS.items() if all(features.get(one) for one in needed)), None)
    if kind is not None and config.CPU_NAME is None:
        config.CPU_NAME, config.CPU_FEATURES = kind, ""


_choose_processor()
# numba describes the arguments to every pass of its compiler, and would collect every field of a record for it: an eighth of
# the time to compile. The name says the same.
types.Record.__repr__ = types.Type.__repr__
# fastmath stays off: without fused multiply-add a replay is equal on every machine.
_OPTIONS = {"nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


class _Place(UserProvidedCacheLocator):
    """Names folders after where a source is in the package: the same sources installed elsewhere are not compiled again."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file):
        folder, package = Path(py_file).parent, Path(__file__).parent
        if folder.is_relative_to(package):
            return "_".join(folder.relative_to(package.parent).parts)
        return super().get_suitable_cache_subpath(py_file)


class _OnDisk(CompileResultCacheImpl):
    _locator_classes = (_Place, *CompileResultCacheImpl._locator_classes)


class _KernelCache(FunctionCache):
    _impl_class = _OnDisk


class _PartsOnDisk(_OnDisk):
    """Parts as they are kept: LLVM's bitcode."""

    def rebuild(self, target_context, payload):
        (name, _, bitcode), description, environment, signature, *_ = payload
        library = Part.of_bitcode(target_context.codegen(), name, bitcode)
        return compile_result(
            target_context=target_context,
            typing_context=target_context.typing_context,
            library=library,
            environment=environment,
            entry_point=target_context.get_executable(library, description, environment),
            fndesc=description,
            signature=signature,
            objectmode=False,
            lifted=(),
        )


class _WithinCache(FunctionCache):
    """Keeps code that kernels call apart from code that Python calls, which numba's index would confuse."""

    _impl_class = _PartsOnDisk

    def _index_key(self, sig, codegen):
        return *super()._index_key(sig, codegen), "within"


class _Within(CPUDispatcher):
    """A function as kernels call it: without a wrapper that unpacks Python's objects, and without machine code of its own."""

    def __init__(self, function: Function):
        super().__init__(function, targetoptions=_OPTIONS | {"no_cpython_wrapper": True}, pipeline_class=PartCompiler)
        self._cache = _WithinCache(function)

    def get_call_template(self, args, kws):
        # numba would compile a function anew for each constant that it is called with.
        unliteral = types.unliteral
        return super().get_call_template([unliteral(kind) for kind in args], {k: unliteral(v) for k, v in kws.items()})


class _Kernel(CPUDispatcher):
    """A function as Python calls it, compiled when Python does."""

    def __init__(self, function: Function):
        super().__init__(function, targetoptions=_OPTIONS)
        self._cache = _KernelCache(function)
        self._within = _Within(function)

    @property
    def _numba_type_(self):
        """The function that compiled code calls where it names this one."""
        return types.Dispatcher(self._within)


def njit(function: Function) -> Function:
    """Compile with numba, cached on disk; called from compiled code once for all values of an argument."""
    return _Kernel(function)


def depend_on(source: Path) -> None:
    """Cache code compiled from here on separately from code compiled without this file, or with another version of it."""
    folder = Path(config.CACHE_DIR) / hashlib.sha256(source.read_bytes()).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    config.CACHE_DIR = str(folder)
