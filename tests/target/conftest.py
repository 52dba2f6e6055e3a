"""Tests on a real CAN interface, and under a real systemd.

`.ci/target` brings both, on any Debian machine, and says so in EMB_TARGET. Without it, tests here are skipped, except
those that need only CAN on a machine where vcan0 is up.
"""

from __future__ import annotations

import gzip
import itertools
import os
import shutil
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from bus_tools import CHANNEL, RIG, Recording
from machine import Watch, tried_again

# What .ci/target promises. A test that finds a promise broken fails; it is never skipped for that.
PROMISED = {"native": {"can"}, "uml": {"can"}, "systemd": {"can", "systemd"}, "package": {"can", "package"}}

WATCH = pytest.StashKey[Watch | None]()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "target(need): needs a CAN interface ('can'), the service ('systemd') or the package ('package')"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    available = PROMISED.get(os.environ.get("EMB_TARGET", ""))
    if available is None:
        available = {"can"} if Path("/sys/class/net", CHANNEL).exists() else set()
    for item in items:
        need = marker.args[0] if (marker := item.get_closest_marker("target")) else None
        if need is not None and need not in available:
            item.add_marker(pytest.mark.skip(reason=f"needs {need}: run it with .ci/target"))


@pytest.fixture(scope="session")
def machine() -> Generator[Watch | None]:
    watch = Watch() if os.environ.get("EMB_TARGET") else None
    yield watch
    if watch is not None:
        watch.close()


@pytest.fixture(autouse=True)
def watched(request: pytest.FixtureRequest, machine: Watch | None) -> None:
    """`pytest_runtest_call` has no other way to a fixture."""
    request.node.stash[WATCH] = machine


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """A test that fails while the machine keeps its CPU from the guest has judged the machine: it is tried again, and .ci/run
    says so."""
    return (yield from tried_again(item, item.stash.get(WATCH, None)))


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Recording]:
    """record(",200:7FC") is a Recording of what passes those candump filters."""
    number = itertools.count()
    return lambda filters="": Recording(tmp_path / f"recording_{next(number)}.log", filters)


@pytest.fixture(scope="session")
def rig_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 30 s of a rig log with every message the daemon listens to, unpacked for canplayer."""
    path = tmp_path_factory.mktemp("rig") / "random.log"
    with gzip.open(RIG / "static" / "random_6p5mm.log.gz", "rt") as packed:
        first = packed.readline()
        end = float(first[1 : first.index(")")]) + 30
        with path.open("w") as plain:
            plain.write(first)
            plain.writelines(itertools.takewhile(lambda line: float(line[1 : line.index(")")]) < end, packed))
    return path


@pytest.fixture(scope="session", autouse=True)
def can_utils() -> None:
    if os.environ.get("EMB_TARGET"):
        assert shutil.which("canplayer") and shutil.which("candump"), "can-utils are not installed"
