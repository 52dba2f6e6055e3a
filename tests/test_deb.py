"""The Debian package: installed, upgraded and purged by dpkg below a folder, with an environment that lacks dependencies."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from emb_daemon.cli.main import main

_ROOT = Path(__file__).parent.parent

pytestmark = pytest.mark.skipif(
    not shutil.which("dpkg-deb") or os.geteuid() != 0 or not Path("/usr/bin/python3").exists(),
    reason="NOT RUN: needs dpkg, Debian's python3, and root",
)


@pytest.fixture(scope="module")
def make_deb():
    sys.path.insert(0, str(_ROOT / "packaging"))
    import make_deb

    return make_deb


@pytest.fixture(scope="module")
def packages(make_deb, tmp_path_factory):
    """Versions 0.1.0 and 0.2.0, the second with another configuration."""
    pytest.importorskip("hatchling", reason="NOT RUN: hatchling is not installed")
    from hatchling.build import build_wheel

    folder, before = tmp_path_factory.mktemp("deb"), Path.cwd()
    os.chdir(_ROOT)
    wheel = folder / build_wheel(str(folder))
    os.chdir(before)
    kernels, python, found = folder / "kernels.so", make_deb.system_python(), []
    kernels.write_bytes(b"a library")
    for version in ("0.1.0", "0.2.0"):
        root = folder / version
        make_deb.lay_out(root, wheel, kernels, python)
        if version == "0.2.0":
            with open(root / "etc/emb_daemon/emb.yaml", "a") as file:
                file.write("# of another version\n")
        found.append(make_deb.pack(root, version, "amd64", python, folder))
    return found


@pytest.fixture
def box(tmp_path):
    """A folder that dpkg takes for a machine, and what runs dpkg on it."""
    root = tmp_path / "box"
    for name in ("var/lib/dpkg/info", "var/lib/dpkg/updates", "var/log", "var/cache", "etc/other", "opt/other"):
        (root / name).mkdir(parents=True)
    for name in ("status", "available"):
        (root / "var/lib/dpkg" / name).touch()

    def dpkg(*arguments):
        options = ["--force-script-chrootless", "--force-depends", "--force-architecture", "--force-confold", "--no-triggers"]
        done = subprocess.run(["dpkg", f"--root={root}", *options, *arguments], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    return root, dpkg


def _files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if not path.is_relative_to(root / "var/lib/dpkg")}


def test_install_configure_upgrade_remove_purge(box, packages):
    root, dpkg = box
    before = _files(root)
    dpkg("--install", str(packages[0]))
    assert (root / "usr/bin/emb-daemon").is_symlink() and (root / "opt/emb_daemon/lib/emb_daemon/kernels.so").exists()
    configuration, learned = root / "etc/emb_daemon/emb.yaml", root / "var/lib/private/emb_daemon/adaptation-FL.json"
    configuration.write_text(configuration.read_text().replace("can0", "can7"))
    learned.parent.mkdir(parents=True)
    learned.write_text("what was learned")
    (root / "var/lib/emb_daemon").symlink_to("private/emb_daemon")
    (root / "var/cache/emb_daemon").mkdir()

    dpkg("--install", str(packages[1]))
    assert "can7" in configuration.read_text() and learned.read_text() == "what was learned"
    dpkg("--remove", "emb-daemon")
    assert "can7" in configuration.read_text() and learned.read_text() == "what was learned"
    assert not (root / "opt/emb_daemon").exists() and not (root / "usr/bin/emb-daemon").exists()
    dpkg("--purge", "emb-daemon")
    shutil.rmtree(root / "var/lib/private")
    assert _files(root) == before


def test_what_is_executed_is_roots_alone(packages):
    """Whatever the umask of who made it, or the daemon does not load its kernels."""
    listed = subprocess.run(["dpkg-deb", "--contents", packages[0]], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 5) for line in listed.splitlines()]
    assert all(row[1] == "root/root" for row in rows)
    assert all(row[0] in ("drwxr-xr-x", "-rw-r--r--", "-rwxr-xr-x", "lrwxrwxrwx") for row in rows)
    assert [row[5] for row in rows if row[0] == "-rwxr-xr-x"] == ["./opt/emb_daemon/bin/emb-daemon"]


def test_the_unit_starts_what_is_installed(packages, tmp_path):
    subprocess.run(["dpkg-deb", "--extract", packages[0], tmp_path], check=True)
    unit = (tmp_path / "usr/lib/systemd/system/emb-daemon.service").read_text()
    [command] = [line.partition("=")[2].split() for line in unit.splitlines() if line.startswith("ExecStart=")]
    assert (tmp_path / command[0].lstrip("/")).exists() and (tmp_path / command[-1].lstrip("/")).exists()
    assert (tmp_path / command[0].lstrip("/")).read_text().startswith("#!/opt/emb_daemon/bin/python -s\n")


def test_shipped_files_are_listed_and_printed(capsys):
    assert main(["files"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert {"dbc/emb.dbc", "config/calibration.yaml", "systemd/emb-daemon.service"} <= {name for name, _ in rows}
    assert all(Path(path).is_file() for _, path in rows)
    assert main(["files", "dbc/emb.dbc"]) == 0
    assert capsys.readouterr().out == (_ROOT / "dbc/emb.dbc").read_text()
    assert main(["files", "emb.dbc"]) == 2
    assert "expected one of dbc/emb.dbc" in capsys.readouterr().err
