"""The Debian package's life on a box: installed, configured, run, upgraded, removed, purged, with the commands that
docs/integration.md names, under systemd and on a real vcan0."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from bus_tools import CHANNEL, Recording, playing, wait_for
from machine import BEFORE_ANOTHER
from service_tools import (
    UNIT,
    active,
    exposure,
    journal_cursor,
    journal_since,
    main_pid,
    prop,
    systemctl,
    wait_for_forces,
)

from emb_daemon.adapt import files
from emb_daemon.adapt.learned import learned_keys
from emb_daemon.adapt.memory import FORMAT, Entry, Memory, Store
from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.parameters import CLEARANCE, value_of

pytestmark = pytest.mark.target("package")

CONFIG, CALIBRATION = Path("/etc/emb_daemon/emb.yaml"), Path("/etc/emb_daemon/calibration.yaml")
HOME, STATE = Path("/opt/emb_daemon"), Path("/var/lib/emb_daemon")
# What dpkg, systemd and the journal keep of anything that was ever there.
KEPT_BY_OTHERS = ("/var/lib/dpkg", "/var/log", "/var/cache/apt", "/var/lib/apt", "/var/lib/systemd", "/var/tmp")
_UDS = "emb-daemon-uds.service"
UDS_READY_S = 180  # behind all others on the guest's only CPU
READY_S = 60  # 4 to 6 s seen
MAXIMAL_EXPOSURE = 1.0
#: Of the daemon with four corners, and of what is installed.
MAXIMAL_MIB, MAXIMAL_MB = 80, 120


def files_there() -> set[str]:
    """Everything below the folders of which a package may put something, but what others keep."""
    return {
        path
        for top in ("/etc", "/opt", "/usr", "/var")
        for folder, folders, names in os.walk(top)
        for path in (os.path.join(folder, name) for name in [*folders, *names])
        if not path.startswith(KEPT_BY_OTHERS)
    }


def apt_get(*arguments: str | Path) -> float:
    """Run it as a script would; returns how long it took, s."""
    start = time.monotonic()
    command = ["apt-get", "--yes", "--quiet", "--option=Dpkg::Options::=--force-confold", *arguments]
    done = subprocess.run(command, env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return time.monotonic() - start


def command(*arguments: str | Path) -> str:
    done = subprocess.run(["/usr/bin/emb-daemon", *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def learned(corner: str) -> Store:
    """A file as an accepted training leaves it: a clearance that is not the calibration's."""
    calibration = load_calibration(CALIBRATION)
    values = {key: value_of(calibration, key) for key in learned_keys(calibration)}
    values[CLEARANCE] *= 1.05
    entry = Entry(
        date="2026-01-02T03:04:05+00:00", outcome="accepted", note="", ambient_C=20.0, pad_rise_K=0.0, values=values,
        sigmas={}, evidence={},
    )  # fmt: skip
    return Store(**files.owner(FORMAT, corner, calibration), current=entry, history=(entry,))


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The package that was built, and a later one, in which a file of the administrator's is another."""
    [first] = Path("/packages").glob("*.deb")
    root = tmp_path_factory.mktemp("later") / "root"
    subprocess.run(["dpkg-deb", "--raw-extract", first, root], check=True)
    control, later = root / "DEBIAN" / "control", root.parent / "later.deb"
    lines = control.read_text().splitlines(keepends=True)
    control.write_text("".join("Version: 99\n" if line.startswith("Version:") else line for line in lines))
    with (root / CONFIG.relative_to("/")).open("a") as file:
        file.write("# of a later version\n")
    subprocess.run(["dpkg-deb", "-Znone", "--build", root, later], check=True, stdout=subprocess.DEVNULL)
    return first, later


@pytest.fixture
def nothing_of_it(request: pytest.FixtureRequest) -> None:
    """The test finds a box without the package, when it is tried again as well."""

    def purge() -> None:
        # Not apt-get, for which a package that is gone already is an error.
        subprocess.run(["dpkg", "--purge", "emb-daemon"], check=True)

    request.node.stash[BEFORE_ANOTHER] = purge


def test_install_configure_run_upgrade_remove_purge(
    nothing_of_it: None, packages: tuple[Path, Path], record: Callable[..., Recording], rig_log: Path
) -> None:
    before = files_there()

    print(f"installed in {apt_get('install', packages[0]):.1f} s")
    assert (prop("ActiveState"), prop("UnitFileState")) == ("inactive", "disabled"), "it is to be configured first"

    CONFIG.write_text(CONFIG.read_text().replace("can0", CHANNEL))
    command("check", "--config", CONFIG)
    start, cursor = time.monotonic(), journal_cursor()
    systemctl("enable", "--now", UNIT)
    print(f"ready after {time.monotonic() - start:.1f} s")
    assert "compiled ahead" in journal_since(cursor)
    assert prop("MemoryDenyWriteExecute") == "yes" and exposure() <= MAXIMAL_EXPOSURE
    resident = next(
        int(line.split()[1]) for line in Path(f"/proc/{main_pid()}/status").read_text().splitlines() if "VmRSS" in line
    )
    print(f"{resident / 1024:.1f} MiB resident")
    assert resident <= 1024 * MAXIMAL_MIB
    installed = sum(path.lstat().st_size for path in HOME.rglob("*")) / 1e6
    print(f"{installed:.0f} MB installed")
    assert installed <= MAXIMAL_MB

    # As another process of the same user it may read what the daemon shares.
    systemctl("start", _UDS)
    took = wait_for("the UDS server is at work", lambda: "trouble codes in" in journal_since(cursor), UDS_READY_S, poll_s=2)
    print(f"UDS server ready after {took:.0f} s")
    process = Path("/proc", systemctl("show", _UDS, "--property=MainPID", "--value"))
    assert (process / "root/run/emb_daemon/estimates").stat().st_uid == process.stat().st_uid
    systemctl("stop", _UDS)

    with playing(rig_log, "-l", "i"):
        wait_for_forces(record, timeout_s=READY_S)
        # What was accepted before, and what driving told the filter.
        Memory(STATE).save(learned("FR"))
        accepted = (STATE / "adaptation-FR.json").read_bytes()
        pid, cursor = main_pid(), journal_cursor()
    # Without inputs the daemon leaves more of the guest's only CPU.
    took = apt_get("install", packages[1])
    wait_for("the later version is ready", active, READY_S)
    print(f"upgraded in {took:.1f} s")
    assert main_pid() != pid
    with playing(rig_log, "-l", "i"):
        wait_for_forces(record, timeout_s=READY_S)
    said = journal_since(cursor)
    assert "corner FR: learned values of 2026-01-02T03:04:05+00:00 in use" in said and "not used" not in said
    assert (STATE / "adaptation-FR.json").read_bytes() == accepted and CLEARANCE in command("adaptation", "show")
    assert (STATE / "restart-FL.json").exists(), "what the filter knew at the stop"
    assert CHANNEL in CONFIG.read_text() and "later version" not in CONFIG.read_text()

    apt_get("remove", "emb-daemon")
    assert prop("ActiveState") == "inactive" and not HOME.exists()
    assert (STATE / "adaptation-FR.json").read_bytes() == accepted and CHANNEL in CONFIG.read_text()

    apt_get("purge", "emb-daemon")
    assert files_there() == before
    assert prop("LoadState") == "not-found"
