"""Where compiled code is kept: apart for each state of the sources, and never a reason not to start."""

import shutil
from pathlib import Path

import processkit
import pytest
from numba import typeof, types

import emb_daemon
from emb_daemon import numba_cache
from emb_daemon.ahead.library import installed_digest, source_digest
from emb_daemon.estimator.fuse import fuse, take_sides
from emb_daemon.estimator.records import new_state
from emb_daemon.jit import njit
from emb_daemon.pipeline import Pipeline
from emb_daemon.runtime.daemon import _compile_fusion
from emb_daemon.wire.layout import CORNERS

_PACKAGE = Path(emb_daemon.__file__).parent
_CALL = """
import sys
from emb_daemon.models.torque import torque_balance
assert torque_balance(2.0, 4.0) == 0.5
from numba.core import config
print(config.CACHE_DIR)
"""


def test_digest_follows_kernels_and_records_and_nothing_else(tmp_path):
    package = tmp_path / "emb_daemon"
    shutil.copytree(_PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "_resources"))
    before = source_digest(package)
    assert before == installed_digest()
    (package / "cli" / "main.py").write_text("# nothing compiled here\n")
    assert source_digest(package) == before
    for name in (
        "models/stiffness.py",
        "estimator/records.py",
        "wire/frames.py",
        "wire/contract.py",
        "effects/signal_delay.py",
    ):
        file = package / name
        text = file.read_text()
        file.write_text(text.replace("0", "1", 1) if "0" in text else text + "\n# more\n")
        changed = source_digest(package)
        assert changed != before, name
        before = changed


@njit
def _twice_if(asked, value):
    return value + value if asked else value


def test_constants_share_one_compiled_version():
    """A second of compiling for each of them would be wasted."""
    called = _twice_if._numba_type_.dispatcher
    for constant in (True, False):
        called.get_call_template([types.literal(constant), types.float64], {})
    assert called.signatures == [(types.boolean, types.float64)]


@njit
def _half(value):
    return value / 2.0


@njit
def _quarter(value):
    return _half(_half(value))


def test_functions_that_only_kernels_call_have_no_python_wrapper():
    """A fifth of a cold start would be spent on it."""
    assert _quarter(4.0) == 1.0
    assert _quarter.signatures == [(types.float64,)] and not _half.signatures
    assert _half(4.0) == 2.0


def test_functions_that_only_kernels_call_are_translated_with_them():
    """And not before, with all that it calls in turn, as numba would: a fifth of a cold start."""
    assert _quarter(4.0) == 1.0
    # A kernel that an earlier run has kept does not even need its parts.
    [kernel], parts = (list(function.overloads.values()) for function in (_quarter, _half._numba_type_.dispatcher))
    is_translated = kernel.codegen._engine.is_symbol_defined
    assert is_translated(kernel.fndesc.llvm_func_name)
    assert not any(is_translated(part.fndesc.llvm_func_name) for part in parts)


def test_a_record_is_described_by_its_name():
    """Which is made once; numba asks for it in every pass of every function."""
    state = typeof(new_state()[0])
    assert repr(state) is state.name


def test_code_is_for_a_kind_of_processors_and_not_for_the_newest_instructions_of_this_one(monkeypatch):
    """For AVX-512 LLVM takes minutes for what it else does in seconds."""

    def chosen(features, by_the_user=None):
        monkeypatch.setattr(numba_cache, "get_host_cpu_features", lambda: dict.fromkeys(features, True) | {"sse4a": False})
        monkeypatch.setattr(numba_cache.config, "CPU_NAME", by_the_user)
        monkeypatch.setattr(numba_cache.config, "CPU_FEATURES", None)
        numba_cache._choose_processor()
        return numba_cache.config.CPU_NAME, numba_cache.config.CPU_FEATURES

    old = ["cx16", "popcnt", "sahf", "sse4.1", "sse4.2", "ssse3"]
    new = [*old, "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"]
    assert chosen([*new, "avx512f"]) == chosen(new) == ("x86-64-v3", "")
    for one in new:
        kind = (None, None) if one in old else ("x86-64-v2", "")
        assert chosen([other for other in new if other != one]) == kind, "a virtual machine may hide any of them"
    assert chosen(["neon"]) == (None, None), "numba then compiles for this processor"
    assert chosen(new, "skylake") == ("skylake", None)


def test_what_the_daemon_compiles_beside_the_estimator_is_what_the_estimator_calls(shipped_setup):
    """With other types it would be compiled for nothing, and the estimator's own version after it."""
    scratch = Pipeline(shipped_setup.parameters.copy(), CORNERS)
    scratch.answer(0)
    _compile_fusion(scratch)
    for function in (fuse, take_sides):
        assert len(function._numba_type_.dispatcher._cache._cache_file._load_index()) == 1


_FAR = """
from emb_daemon.jit import hypot, njit
from emb_daemon.numba_cache import _compilations

@njit
def far(a, b):
    return {} * hypot(a, b)

print(far(3.0, 4.0), _compilations.count)
"""


@pytest.mark.trial
def test_another_kernel_loads_its_callees_from_the_cache(tmp_path):
    """The kernel with `hypot` and `sq`; then, changed, the kernel alone; then nothing."""
    for factor, said in ((1.0, "5.0 3"), (2.0, "10.0 1"), (None, "10.0 0")):
        if factor:
            (tmp_path / "far.py").write_text(_FAR.format(factor))
        done = processkit.python(str(tmp_path / "far.py"), NUMBA_CACHE_DIR=str(tmp_path / "cache"))
        assert done.stdout == said + "\n", done.stderr


@pytest.mark.trial
def test_code_for_kernels_is_not_loaded_for_a_call_from_python(tmp_path):
    """`hypot` calls `sq`, which is kept as kernels call it; then both are kept as Python calls them."""
    code = "from emb_daemon.jit import compiled_for_the_next_start, hypot, sq; print({}, compiled_for_the_next_start())"
    for call, result in (
        ("hypot(3.0, 4.0)", "5.0 True"),
        ("sq(3.0)", "9.0 True"),
        ("sq(3.0)", "9.0 False"),
        ("hypot(3.0, 4.0)", "5.0 False"),
    ):
        done = processkit.python("-c", code.format(call), NUMBA_CACHE_DIR=str(tmp_path / "cache"))
        assert done.stdout == result + "\n", done.stderr


_HYPOTENUSE = """
from emb_daemon.jit import hypot
from emb_daemon.numba_cache import _compilations

print(hypot(3.0, 4.0), _compilations.count)
"""


def test_the_same_sources_in_another_place_are_not_compiled_again(tmp_path):
    """As in a new environment, or a package that was put elsewhere."""
    for place, said in (("here", "5.0 2"), ("there", "5.0 0")):
        folder = tmp_path / place
        shutil.copytree(_PACKAGE, folder / "emb_daemon", ignore=shutil.ignore_patterns("__pycache__", "_resources"))
        (folder / "call.py").write_text(_HYPOTENUSE)
        done = processkit.python(str(folder / "call.py"), PYTHONPATH="", NUMBA_CACHE_DIR=str(tmp_path / "cache"))
        assert done.stdout == said + "\n", done.stderr


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    """A folder that holds what a process compiled."""
    folder = tmp_path_factory.mktemp("kept") / "cache"
    done = processkit.python("-c", _CALL, NUMBA_CACHE_DIR=str(folder))
    assert done.returncode == 0 and not done.stderr
    assert Path(done.stdout.strip()).parent == folder
    return folder


def test_compiled_code_goes_into_the_chosen_folder(kept):
    assert list(kept.rglob("*.nbi")), "nothing was kept"


@pytest.mark.parametrize("below", [True, False])
def test_a_folder_that_anybody_can_write_to_is_not_loaded_from(tmp_path, kept, below):
    """What is found there is executed."""
    [folder] = shutil.copytree(kept, tmp_path / "cache").iterdir()
    (folder if below else folder.parent).chmod(0o777)
    for file in folder.rglob("*.nb?"):
        file.write_bytes(b"not what was compiled")
    done = processkit.python("-c", _CALL, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0 and "is writable by anybody" in done.stderr
    assert Path(done.stdout.strip()) != folder


def test_an_unwritable_folder_is_reported_once_and_not_used(tmp_path):
    (tmp_path / "file").write_text("a file where the folder should be")
    done = processkit.python("-c", _CALL, NUMBA_CACHE_DIR=str(tmp_path / "file"))
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert str(tmp_path / "file") in done.stderr and "NUMBA_CACHE_DIR" in done.stderr
    assert not Path(done.stdout.strip()).exists(), "the private folder was left behind"
