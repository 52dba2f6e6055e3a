"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

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
