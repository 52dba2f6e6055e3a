"""Buses that python-can drives: what others send is heard, what we send ourselves is not."""

import os

import numpy as np
import pytest
import wirekit

from emb_daemon.errors import Unavailable
from emb_daemon.runtime.bus import open_bus

#: Of its own for each run, so that two test runs on one machine do not hear each other.
_GROUP = f"239.74.163.{os.getpid() % 250 + 3}"
_OURS = [0x200, 0x100]


@pytest.fixture
def ends():
    """Two programs on a bus that gives a sender its own frames back."""
    try:
        buses = [open_bus("udp_multicast", _GROUP, _OURS) for _ in range(2)]
    except Unavailable as error:
        pytest.skip(f"NOT RUN: no multicast here: {error}")
    yield buses
    for bus in buses:
        bus.close()


def _heard(bus, count: int) -> list[tuple[int, int]]:
    """The next frames, at least ``count`` of them, and all that come within a moment after."""
    heard = []
    while bus.wait(1.0 if len(heard) < count else 0.05):
        heard += [(frame["can_id"], frame["data"]) for frame in bus.drain()]
    return [(int(can_id), int(data)) for can_id, data in heard]


def test_own_frames_are_not_heard_and_those_of_others_are(ends):
    ours, theirs = ends
    mine = np.concatenate([wirekit.frame("EMB_FL_ClampForce", counter=c, ClampForce=0.1 * c) for c in range(15)])
    foreign = np.concatenate([wirekit.frame("EMB_FL_ClampForce", counter=c, ClampForce=3.0) for c in range(3)])
    ours.send(mine)
    theirs.send(foreign)
    assert _heard(theirs, 15) == list(zip(mine["can_id"].tolist(), mine["data"].tolist(), strict=True))
    # A second sender of our message is one: this is how the daemon notices.
    assert _heard(ours, 3) == list(zip(foreign["can_id"].tolist(), foreign["data"].tolist(), strict=True))


def test_a_frame_of_ours_that_comes_once_more_is_somebody_elses(ends):
    ours, theirs = ends
    mine = wirekit.frame("EMB_FL_ClampForce", ClampForce=5.0)
    ours.send(mine)
    assert len(_heard(theirs, 1)) == 1 and _heard(ours, 0) == []
    theirs.send(mine)
    assert len(_heard(ours, 1)) == 1
