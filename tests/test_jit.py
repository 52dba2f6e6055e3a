"""Where compiled code is kept: apart for each state of the sources, and never a reason not to start."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba import types

import emb_daemon
from emb_daemon.ahead.library import installed_digest, source_digest
from emb_daemon.jit import njit

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
    for constant in (True, False):
        _twice_if.get_call_template([types.literal(constant), types.float64], {})
    assert _twice_if.signatures == [(types.boolean, types.float64)]


def _call(**variables) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(_PACKAGE.parent)} | variables
    return subprocess.run([sys.executable, "-c", _CALL], env=environment, capture_output=True, text=True)


def test_compiled_code_goes_where_it_is_told(tmp_path):
    done = _call(NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0 and not done.stderr
    assert Path(done.stdout.strip()).parent == tmp_path / "cache"
    assert list((tmp_path / "cache").rglob("*.nbi")), "nothing was kept"


@pytest.mark.parametrize("below", [True, False])
def test_a_folder_that_anybody_can_write_to_is_not_loaded_from(tmp_path, below):
    """What is found there is executed."""
    done = _call(NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    folder = Path(done.stdout.strip())
    (folder if below else folder.parent).chmod(0o777)
    for file in folder.rglob("*.nb?"):
        file.write_bytes(b"not what was compiled")
    done = _call(NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0 and "is writable by anybody" in done.stderr
    assert Path(done.stdout.strip()) != folder


def test_an_unwritable_folder_is_told_of_once_and_does_without(tmp_path):
    (tmp_path / "file").write_text("a file where the folder should be")
    done = _call(NUMBA_CACHE_DIR=str(tmp_path / "file"))
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert str(tmp_path / "file") in done.stderr and "NUMBA_CACHE_DIR" in done.stderr
    assert not Path(done.stdout.strip()).exists(), "the private folder was left behind"
