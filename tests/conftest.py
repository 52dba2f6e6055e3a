"""Fixtures shared by all tests."""

import collections
import contextlib
import os
from pathlib import Path

import pytest
from hypothesis import settings

# Compiling is not the code's own time; a failure must come back on the next run.
settings.register_profile("project", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("project")

_ROOT = Path(__file__).parent.parent


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


@pytest.fixture
def parameters():
    """PARAMETERS array (4,) of the shipped calibration, for tests to change."""
    from emb_daemon.calibration.configuration import Setup

    return Setup(_ROOT / "config" / "emb.yaml").parameters.copy()


@pytest.fixture
def thermal(parameters):
    """THERMAL record of the shipped calibration, for tests to change."""
    return parameters[0]["thermal"]
