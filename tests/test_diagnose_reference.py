"""A reference force that comes late is no property of the brake."""

import dataclasses
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from diagnosekit import drives

from emb_daemon.calibration.parameters import moved
from emb_daemon.diagnose import diagnosis
from emb_daemon.diagnose.diagnosis import diagnose
from emb_daemon.diagnose.late_reference import may_be_late, reference_late_s
from emb_daemon.diagnose.report import report
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.text import verdict
from emb_daemon.offline import log_of

#: Of the simulated rig, whatever else is late, s.
_ITS_OWN_S = 0.0004


@pytest.fixture(scope="module", params=[{}, {"viscous_friction": {"viscous_Nms_per_rad": 3e-4}}], ids=["brake", "viscous"])
def brake_log(request, calibration):
    return log_of(next(drives(calibration, 57, request.param)))


def _with_late_reference(log, samples):
    force = np.concatenate([np.full(samples, log.force_N[0]), log.force_N[: len(log.force_N) - samples]])
    return dataclasses.replace(log, force_N=force)


@pytest.mark.parametrize("samples", [pytest.param(0, marks=pytest.mark.trial), pytest.param(1, marks=pytest.mark.trial), 3])
def test_a_late_reference_is_told_whatever_the_friction(calibration, brake_log, samples):
    """A viscous friction alone makes the force 10 ms late beside the current, and not beside the angle."""
    late_s = reference_late_s(Bench([_with_late_reference(brake_log, samples)], calibration))
    assert late_s == pytest.approx(0.004 * samples + _ITS_OWN_S, abs=4e-4)


@pytest.mark.parametrize("late_s", [0.004, *(pytest.param(late, marks=pytest.mark.trial) for late in (0.001, -0.004))])
def test_an_angle_of_another_time_is_no_such_reference(calibration, brake_log, late_s):
    """It is late or early beside the current as well."""
    rows, time = brake_log.samples.copy(), brake_log.time_s
    rows["angle"] = np.interp(time - late_s, time, rows["angle"])
    bench = Bench([dataclasses.replace(brake_log, samples=rows)], calibration)
    assert reference_late_s(bench) == 0.0
    assert may_be_late(bench) is (abs(late_s) < 0.002)


def test_a_reference_goes_back_to_its_own_time(brake_log):
    back = _with_late_reference(brake_log, 3).with_reference_earlier(0.012)
    moving = slice(100, -100)
    assert np.abs(back.force_N - brake_log.force_N)[moving].max() < 0.05 * brake_log.force_N.max()
    assert np.std((back.force_N - brake_log.force_N)[moving]) < 50.0


@pytest.mark.parametrize(
    ("before_s", "after_s", "alike", "again_s"),
    [
        (0.0, -4e-4, True, 4e-4),
        (0.0, -4e-4, False, 0.0),
        (0.002, -4e-4, True, 4e-4),
        (0.0, 0.002, True, 0.0),
        (-4e-4, -4e-4, True, 0.0),
    ],
)
def test_an_angle_of_a_time_to_come_is_the_reference_s(calibration, monkeypatch, before_s, after_s, alike, again_s):
    """In six minutes of stops it was found as an age of -0.4 ms, which no resolver has. What the calibration knows stays."""
    before, after = (moved(calibration, {"effects.signal_delay.delay_s": delay_s}) for delay_s in (before_s, after_s))
    monkeypatch.setattr(diagnosis, "reference_late_s", lambda bench: 2e-4)
    monkeypatch.setattr(diagnosis, "may_be_late", lambda bench: alike)
    bench = SimpleNamespace(calibration=before, under=lambda c: c)
    found = SimpleNamespace(calibration=after, unexplained=None, bench=bench)
    assert diagnosis._later_s(found) == pytest.approx(again_s)


@pytest.mark.trial
def test_a_late_reference_makes_no_effect_and_no_other_brake(calibration):
    """A sample late, it made other relaxations, a torque path that was given up, and 96 N for 26."""
    fit_log, val_log = (_with_late_reference(log_of(frames), 1) for frames in drives(calibration, 57, {}))
    result = diagnose([fit_log], calibration, [val_log])
    assert not result.accepted and result.unexplained is None
    assert result.after.rmse("fused") < 35.0
    assert report(result)["reference_late_s"] == pytest.approx(0.0044, abs=4e-4)
    assert "The reference force comes 4.4 ms after angle and current" in verdict(result)


@pytest.mark.trial
def test_a_late_reference_that_a_cause_hid_is_told_beside_it(calibration):
    """A relaxation that nobody has calibrated takes a third of it at first."""
    effects = {name: values for name, values in calibration.effects.items() if name != "second_relaxation"}
    known = msgspec.structs.replace(calibration, effects=effects)
    fit_log, val_log = (_with_late_reference(log_of(frames), 1) for frames in drives(calibration, 57, {}))
    result = diagnose([fit_log], known, [val_log])
    assert [finding.effect.name for finding in result.accepted] == ["second_relaxation"] and result.unexplained is None
    assert result.reference_late_s == pytest.approx(0.0044, abs=5e-4) and result.after.rmse("fused") < 35.0
