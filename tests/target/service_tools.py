"""The service as its tests see it: systemctl, the journal, and forces on the bus."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable

from bus_tools import Recording, wait_for

UNIT = "emb-daemon.service"
FORCES = ",200:7FC"  # EMB_c_ClampForce of all corners
PERIOD_S = 0.004


def systemctl(*arguments: str, check: bool = True) -> str:
    done = subprocess.run(["systemctl", *arguments], check=False, capture_output=True, text=True)
    assert done.returncode == 0 or not check, f"systemctl {' '.join(arguments)}: {done.stderr}"
    return done.stdout.strip()


def prop(name: str) -> str:
    return systemctl("show", UNIT, f"--property={name}", "--value")


def main_pid() -> int:
    return int(prop("MainPID"))


def active() -> bool:
    return prop("ActiveState") == "active"


def journal(*arguments: str) -> str:
    command = ["journalctl", "--boot", "--no-pager", "--output=cat", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def journal_since(cursor: str) -> str:
    return journal(f"--after-cursor={cursor}")


def journal_cursor() -> str:
    return journal("--lines=0", "--show-cursor").rpartition("-- cursor: ")[2].strip()


def exposure() -> float:
    """What `systemd-analyze security` says of the unit."""
    command = ["systemd-analyze", "security", "--no-pager", UNIT]
    report = subprocess.run(command, check=False, capture_output=True, text=True).stdout
    level = re.search(r"Overall exposure level.*: (\d+\.\d+)", report)
    assert level is not None, report
    print(level[0])
    return float(level[1])


def wait_for_forces(record: Callable[..., Recording], timeout_s: float) -> float:
    """Until clamp forces are on the bus, at their rate and not just one; how long that took."""

    def broadcasting() -> bool:
        with record(FORCES) as recording:
            time.sleep(0.5)
        return len(recording.frames) > 0.5 / PERIOD_S / 2

    return wait_for("clamp forces are broadcast", broadcasting, timeout_s)
