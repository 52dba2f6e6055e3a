"""Park brake adaptation end to end on a real CAN interface: the simulated car answers the daemon's request."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from bus_tools import CHANNEL

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from adaptation_on_bus import request_is_accepted

pytestmark = pytest.mark.target("can")


def test_a_request_on_the_bus_is_accepted() -> None:
    seen = request_is_accepted("socketcan", CHANNEL)
    assert seen["asked"] == seen["accepted"] == seen["remembered"] == {"FL"}
    assert seen["invalid"] == 0
