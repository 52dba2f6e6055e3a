"""A motor angle that repeats while its speed goes on, as a loose contact or a busy sender makes it."""

import brake
import numpy as np
import pytest

from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.estimator.resolver import follow_zero
from emb_daemon.models.plausibility import watch
from emb_daemon.offline import estimate

_STOPS = 12


@pytest.fixture
def p(parameters):
    return brake.ideal(parameters)


@pytest.fixture
def driven(p):
    rows, force = brake.samples(p, brake.stops(p, _STOPS))
    rows = brake.noisy(rows, p)
    return rows, force, np.flatnonzero(np.abs(rows["speed"]) > 50.0)


def _repeat(rows, names, samples, moments):
    """Let the signals repeat for so many ``samples`` from each of the ``moments`` on."""
    for at in moments:
        for name in names:
            rows[name][at : at + samples] = rows[name][at]


def _beyond(estimates, force):
    return np.abs(estimates["force"] - force) > 3.0 * np.hypot(estimates["sigma"], 25.0)


@pytest.mark.parametrize("names", [("angle",), ("angle", "speed")])
@pytest.mark.parametrize("samples", [2, 3, 5, 12, 30])
def test_an_angle_that_catches_up_has_lost_nothing(p, driven, names, samples):
    rows, force, turning = driven
    healthy = estimate(rows.copy(), p)
    moments = turning[:: len(turning) // 15]
    _repeat(rows, names, samples, moments)
    estimates = estimate(rows, p)
    assert abs(estimates["contact_angle"][-1] - healthy["contact_angle"][-1]) < 0.1
    again = np.ones(len(rows), bool)
    for at in moments:
        again[at : at + samples + 25] = False
    assert np.mean(_beyond(estimates, force)[again]) < 0.001


@pytest.mark.parametrize("samples", [5, 12, 30])
def test_an_angle_that_goes_on_from_where_it_stopped_takes_the_contact_angle_with_it(p, driven, samples):
    rows, force, turning = driven
    healthy = estimate(rows.copy(), p)
    at = turning[len(turning) // 2]
    lost = rows["angle"][at + samples] - rows["angle"][at]
    rows["angle"][at : at + samples] = rows["angle"][at]
    rows["angle"][at + samples :] -= lost
    estimates = estimate(rows, p)
    assert abs(estimates["contact_angle"][-1] - healthy["contact_angle"][-1] + lost) < 0.5
    assert np.mean(_beyond(estimates, force)[at + samples + 25 :]) < 0.01


def _zeros_moved(p, angles, speeds):
    s, m = new_state()[0], np.zeros(1, SAMPLE)[0]
    moved = []
    for angle, speed in zip(angles, speeds, strict=True):
        m["angle"], m["speed"], m["dt"] = angle, speed, 0.004
        turned = 0.5 * (m["speed"] + s["speed"]) * m["dt"]
        moved.append(bool(follow_zero(s, p, m, turned)))
        watch(s["plausibility"], m, s["angle"], s["speed"], turned, 0.0, 1.0, True)
        s["angle"], s["speed"] = angle, speed
    return moved


def test_a_speed_that_repeats_with_the_angle_tells_of_no_way(p):
    """The motor had stopped, and a frame of its motion was sent again and again."""
    angles, speeds = np.zeros(30), 0.1 * (-1.0) ** np.arange(30)
    speeds[1:12] = 100.0
    angles[-5:] = 0.0015
    assert not any(_zeros_moved(p, angles, speeds))
    # As it came, sample by sample, the same way is missing.
    speeds[1:12] += np.arange(11)
    assert any(_zeros_moved(p, angles, speeds))


def test_an_angle_that_repeats_as_each_motion_begins_is_late_and_has_lost_nothing(p):
    """Older than its speed by a cycle, to and fro without a longer rest: what it lacks as a stroke begins at once comes at its
    end, and the way back begins slowly."""
    there = np.concatenate([np.linspace(0.0, 150.0, 7), np.linspace(150.0, 0.0, 7), np.zeros(10)])
    back = np.concatenate([[0.0, 4.0], np.linspace(10.0, 150.0, 7), np.linspace(150.0, 0.0, 7), np.zeros(8)])
    speeds = np.concatenate([*[there, -back] * 20, np.zeros(60)])
    angles = np.cumsum(0.5 * (speeds + np.roll(speeds, 1))) * 0.004
    angles[1:] = angles[:-1].copy()
    assert not any(_zeros_moved(p, angles, speeds + 0.1 * (-1.0) ** np.arange(len(speeds))))
