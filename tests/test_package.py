"""The wheel and the sdist hold what an installation needs, under the one version."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from emb_daemon import __version__

_ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Paths of the wheel and the sdist, built in this process: no network, nothing installed."""
    pytest.importorskip("hatchling", reason="NOT RUN: hatchling is not installed")
    from hatchling.build import build_sdist, build_wheel

    folder = tmp_path_factory.mktemp("dist")
    before = Path.cwd()
    os.chdir(_ROOT)
    try:
        return folder / build_wheel(str(folder)), folder / build_sdist(str(folder))
    finally:
        os.chdir(before)


def test_the_wheel_is_complete(built):
    with zipfile.ZipFile(built[0]) as wheel:
        names = set(wheel.namelist())
        for name in ("dbc/emb.dbc", "dbc/rig.dbc", "config/emb.yaml", "config/calibration.yaml", "systemd/emb-daemon.service",
                     "systemd/emb-daemon.service.d/ahead.conf", "systemd/emb-daemon.service.d/secoc.conf",
                     "completion/emb-daemon.bash"):  # fmt: skip
            assert wheel.read(f"emb_daemon/_resources/{name}") == (_ROOT / name).read_bytes()
        ours = [path for path in (_ROOT / "emb_daemon").rglob("*") if path.is_file() and path.suffix != ".pyc"]
        assert {str(path.relative_to(_ROOT)) for path in ours} <= names
        assert not any(name.startswith(("tests", "docs", "examples", "studies")) for name in names)
        metadata = wheel.read(f"emb_daemon-{__version__}.dist-info/METADATA").decode()
        assert f"\nVersion: {__version__}\n" in metadata
        assert (
            "emb-daemon = emb_daemon.cli.main:main"
            in wheel.read(f"emb_daemon-{__version__}.dist-info/entry_points.txt").decode()
        )


def test_the_wheel_is_the_same_whenever_it_is_built(built, tmp_path, monkeypatch):
    from hatchling.build import build_wheel

    monkeypatch.chdir(_ROOT)
    assert (tmp_path / build_wheel(str(tmp_path))).read_bytes() == built[0].read_bytes()


def test_the_box_has_a_lock_of_its_own():
    """Otherwise: python tools/lock_box.py."""
    command = [sys.executable, str(_ROOT / "tools" / "lock_box.py"), "--check"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    lock, ahead = ((_ROOT / f"requirements-{name}.lock").read_text() for name in ("box", "ahead"))
    assert "numba==" in lock and "scipy==" not in lock and lock.count("==") <= lock.count("--hash=sha256:")
    assert "numpy==" in ahead and "numba==" not in ahead and "llvmlite==" not in ahead


def test_the_sdist_can_be_tested_and_documented(built):
    with tarfile.open(built[1]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    for name in ("pyproject.toml", "tests/conftest.py", "docs/index.md", "mkdocs.yml", "examples/control_loop.py",
                 "CHANGELOG.md", "LICENSE", "Makefile", "systemd/emb-daemon.service", "dbc/emb.dbc"):  # fmt: skip
        assert name in names


def test_the_wheel_runs_far_from_its_sources(built, tmp_path):
    """`make wheel-demo` installs it in an empty environment and compiles; here its commands find what ships with it."""
    with zipfile.ZipFile(built[0]) as wheel:
        wheel.extractall(tmp_path / "site")
    config = tmp_path / "site" / "emb_daemon" / "_resources" / "config" / "emb.yaml"
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "emb_daemon.cli.main", "check", "--config", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.count("actuator") == 4
    where = "import emb_daemon.resources as r; print(r.resource('dbc/emb.dbc'))"
    done = subprocess.run([sys.executable, "-c", where], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.stdout.startswith(str(tmp_path)), done.stderr
