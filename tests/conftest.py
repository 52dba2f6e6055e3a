"""Fixtures shared by all tests."""

import collections
import contextlib
import fcntl
import os
from pathlib import Path

import processkit
import pytest
from hypothesis import settings

# Compiling is not the code's own time; a failure must come back on the next run.
settings.register_profile("project", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("project")

_ROOT = Path(__file__).parent.parent

#: Files that begin, in this order, the longest first, so that all workers end together. Of two workers on an empty cache one
#: compiles the estimator, the other the library (a trial), in which nothing of the cache helps, or the simulated car; later
#: one compiles trainings, long before the other needs them: neither does it twice.
_FIRST = (
    "test_ahead", "test_hypotheses", "test_plant", "test_effects", "test_diagnose_terms", "test_blind", "test_diagnose",
    "test_adapt", "test_formats", "test_diagnose_confirmation", "test_identify_fit", "test_rig",
    "test_foreign_rig_identify", "test_foreign_rig", "test_fleet", "test_diagnose_model", "test_identify_command",
    "test_examples", "test_daemon", "test_interface", "test_identify_thermal",
)  # fmt: skip

#: Fixtures that take so long that whoever asks for one is a trial.
_LONG = {"compiled", "coupled", "identified", "viscous"}

#: Trials that this process, or its workers, leave out.
_LEFT_OUT = pytest.StashKey[int]()

#: What ``emb-daemon compile`` does, and then, of what is lowered already, the object for another machine.
_COMPILE = """
import sys
from emb_daemon.cli.main import main
assert main(["compile", "--output", sys.argv[1]]) == 0
from pathlib import Path
from emb_daemon.ahead.build import build
from emb_daemon.ahead.library import TARGETS, installed_digest
from emb_daemon.jit import ENTRIES
build(list(ENTRIES.values()), installed_digest(), TARGETS["aarch64"], Path(sys.argv[2]), {})
"""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if _LONG.intersection(item.fixturenames):
            item.add_marker("trial")
    place = {name: row for row, name in enumerate(_FIRST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_deselected(items):
    """Notes how many trials are left out; of several processes each collects all tests."""
    config = items[0].config
    config.stash[_LEFT_OUT] = config.stash.get(_LEFT_OUT, 0) + sum("trial" in item.keywords for item in items)
    if hasattr(config, "workeroutput"):
        config.workeroutput["left_out"] = config.stash[_LEFT_OUT]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    node.config.stash[_LEFT_OUT] = getattr(node, "workeroutput", {}).get("left_out", 0)


def pytest_terminal_summary(terminalreporter, config):
    if left_out := config.stash.get(_LEFT_OUT, 0):
        terminalreporter.write_line(f"{left_out} long trials were left out; make trials runs them")


@pytest.fixture(scope="session")
def compiled() -> Path:
    """A folder with the library for this machine, kernels.so, and the object for aarch64: a minute, once for each state of the
    sources, which numba's folder is named after, and by one process of the tests for all."""
    from numba.core import config

    folder = Path(config.CACHE_DIR) / "ahead"
    folder.mkdir(exist_ok=True)
    library, other = folder / "kernels.so", folder / "aarch64.o"
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not other.exists():
            done = processkit.python("-c", _COMPILE, library, other)
            assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="session")
def shared() -> Path:
    """Logs beside the project; a test that needs them says loudly when it cannot run."""
    folder = Path(os.environ.get("EMB_SHARED", _ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"NOT RUN: {folder} with the rig's logs is not here")
    return folder


@pytest.fixture(scope="session")
def rig(shared: Path) -> Path:
    """Logs of the simulated rig."""
    return shared / "rig"


@pytest.fixture(scope="session")
def counted_reads():
    """A context that counts how often each log file is read, by name."""

    @contextlib.contextmanager
    def count():
        from emb_daemon.logs import read

        reads, plain = collections.Counter(), read.read_file

        def counted(path):
            reads[path.name] += 1
            return plain(path)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(read, "read_file", counted)
            yield reads

    return count


@pytest.fixture(scope="session")
def shipped_setup():
    """The shipped configuration, as it is read."""
    from emb_daemon.calibration.configuration import Setup

    return Setup(_ROOT / "config" / "emb.yaml")


@pytest.fixture(scope="session")
def calibration():
    """The shipped one, of one brake."""
    from emb_daemon.calibration.files import shipped_calibration

    return shipped_calibration()


@pytest.fixture
def parameters(shipped_setup):
    """PARAMETERS array (4,) of the shipped calibration, for tests to change."""
    return shipped_setup.parameters.copy()


@pytest.fixture
def thermal(parameters):
    """THERMAL record of the shipped calibration, for tests to change."""
    return parameters[0]["thermal"]
