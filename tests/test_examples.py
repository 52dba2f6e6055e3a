"""The Python interface gives the daemon's numbers, and the examples run as they are printed in the documentation."""

import re
from pathlib import Path

import numpy as np
import processkit
import pyarrow.parquet
import pytest
import wirekit

import emb_daemon
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.own import extend
from emb_daemon.logs.write import write_frames
from emb_daemon.replay import Replay
from emb_daemon.resources import resource

_EXAMPLES = Path(__file__).parent.parent / "examples"


def _run(name: str, *arguments, **environment: str) -> str:
    result = processkit.python(_EXAMPLES / name, *map(str, arguments), MPLBACKEND="agg", **environment)
    assert result.returncode == 0, result.stderr
    assert "Warning" not in result.stderr
    return result.stdout


def test_run_equals_replay(rig):
    path = rig / "static" / "sine_5Hz.log.gz"
    log = emb_daemon.load_log(path)
    estimates = emb_daemon.run(log)
    replayed = Replay(emb_daemon.shipped_calibration()).run(path)
    for name in ("force", "sigma", "contact_angle", "mode", "source", "reasons"):
        assert np.array_equal(estimates[name], replayed.estimates[name], equal_nan=True)
    assert np.array_equal(log.force_N, replayed.force_N, equal_nan=True)


def test_step_equals_run(rig):
    """The object for control loops, given a log's samples one by one, answers as the whole log does."""
    log = emb_daemon.load_log(rig / "static" / "sine_5Hz.log.gz")
    # The object takes its brake for released from the first call on; the log's first sample has heard no status yet.
    log.samples[["has_status", "ambient", "park_brake", "brake_request"]][0] = (True, 20.0, 0.0, 0.0)
    whole, estimator = emb_daemon.run(log), emb_daemon.Estimator()
    for row, expected in zip(log.samples[:1500], whole, strict=False):
        answer = estimator.step(
            row["angle"],
            row["speed"],
            row["current_q"] if row["has_current"] else None,
            dt_s=row["dt"] or 0.004,
            backplates_C=(row["inner_backplate"], row["outer_backplate"]) if row["has_thermocouple"] else None,
            caliper_C=row["caliper"],
            ambient_C=row["ambient"] if row["has_status"] else 20.0,
            wheel_speed_rad_per_s=row["wheel_speed"] if row["has_wheel_speed"] else None,
            wheel_pulse=row["wheel_pulse"] if row["has_wheel_pulse"] else None,
        )
        assert answer.force_N == pytest.approx(expected["force"], abs=1e-6)
        assert answer.sigma_N == pytest.approx(expected["sigma"], rel=1e-9)


def test_a_missing_input_is_named():
    answer = emb_daemon.Estimator().step(0.0, 0.0)
    assert set(answer.reasons) >= {"current lost", "thermocouple lost"} and answer.sigma_N > 0.0


_REST = {"backplates_C": (20.0, 20.0), "wheel_speed_rad_per_s": 0.0, "wheel_pulse": 0.0}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["angle_rad", "speed_rad_per_s", "dt_s", "ambient_C", "vehicle_speed_m_per_s"])
def test_a_value_that_is_not_finite_is_refused_by_name_and_changes_nothing(name, value):
    refused, other = emb_daemon.Estimator(), emb_daemon.Estimator()
    good = {"angle_rad": 1.0, "speed_rad_per_s": 5.0, "current_A": 0.3, **_REST}
    for estimator in (refused, other):
        estimator.step(**good)
    with pytest.raises(ValueError, match=name):
        refused.step(**(good | {"angle_rad": 1.02} | {name: value}))
    good["angle_rad"] = 1.02
    assert refused.step(**good) == other.step(**good)


@pytest.mark.parametrize("dt_s", [0.0, -0.004])
def test_a_time_step_must_be_above_zero(dt_s):
    estimator = emb_daemon.Estimator()
    estimator.step(0.0, 0.0, 0.0, **_REST)
    with pytest.raises(ValueError, match="dt_s"):
        estimator.step(0.0, 0.0, 0.0, dt_s=dt_s, **_REST)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize(
    ("name", "reason"),
    [("current_A", "current lost"), ("wheel_speed_rad_per_s", "wheel speed lost"), ("wheel_pulse", "wheel pulse lost")],
)
def test_an_optional_input_that_is_not_finite_counts_as_missing(name, reason, value):
    """It has no influence on later estimates."""
    estimator = emb_daemon.Estimator()
    estimator.step(0.0, 0.0, 0.0, **_REST)
    arguments = {"angle_rad": 0.0, "speed_rad_per_s": 0.0, "current_A": 0.0, **_REST}
    assert reason in estimator.step(**(arguments | {name: value})).reasons
    again = estimator.step(**arguments)
    assert again.reasons == () and again.sigma_N < 500.0


def test_backing_plates_that_are_not_finite_count_as_missing():
    answer = emb_daemon.Estimator().step(0.0, 0.0, 0.0, **(_REST | {"backplates_C": (20.0, float("nan"))}))
    assert "thermocouple lost" in answer.reasons


def test_reset_forgets_everything():
    estimator, fresh = emb_daemon.Estimator(), emb_daemon.Estimator()
    for step in range(20):
        estimator.step(0.3 * step, 75.0, 2.0, **_REST)
    estimator.reset()
    for step in range(20):
        arguments = {"angle_rad": 50.0 + 0.1 * step, "speed_rad_per_s": 25.0, "current_A": 1.0, **_REST}
        assert repr(estimator.step(**arguments)) == repr(fresh.step(**arguments))


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, emb_daemon; print('numba' in sys.modules, 'numpy' in sys.modules, emb_daemon.__version__)"
    result = processkit.python("-c", code)
    assert result.stdout.split()[:2] == ["False", "False"]


def test_what_the_package_offers_is_documented():
    for name in emb_daemon.__all__:
        assert getattr(emb_daemon, name).__doc__
    with pytest.raises(AttributeError):
        _ = emb_daemon.no_such_thing


def test_example_replay_and_plot(rig, tmp_path):
    picture = tmp_path / "picture.png"
    assert "2500 estimates" in _run("replay_and_plot.py", rig / "static" / "sine_5Hz.log.gz", picture)
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_example_control_loop_holds_the_force():
    said = _run("control_loop.py")
    estimated, true = (float(value) for value in re.search(r"estimated (\d+) N, the toy's own force (\d+) N", said).groups())
    assert estimated == pytest.approx(8000.0, abs=20.0) and true == pytest.approx(8000.0, abs=100.0)


@pytest.mark.trial
def test_example_own_effect(tmp_path):
    """The commands know the effect; at zero it changes nothing, and a wider caliper leaves less force at the same angle."""
    angle, speed = 26.0 * np.clip(np.arange(200) / 80.0, 0.0, 1.0), 81.25 * (np.arange(200) < 80)
    cold = wirekit.drive(120, start_ns=10**9, angle=angle, speed=speed, current=0.2 * angle, backplate=25.0)
    warm = wirekit.drive(80, start_ns=10**9, angle=angle, speed=speed, current=0.2 * angle, backplate=35.0, first=120)
    write_frames(tmp_path / "warming.log", np.concatenate([*cold, *warm]))
    shipped = resource("config/calibration.yaml").read_text()
    columns = {}
    for widening in (0.0, 2.0):
        calibration, table = tmp_path / f"{widening}.yaml", tmp_path / f"{widening}.parquet"
        effect = f"effects:\n  caliper_widening: {{widening_um_per_K: {widening}}}\n"
        calibration.write_text(shipped.replace("effects:\n", effect))
        files = ("--calibration", calibration, "--output", table)
        # As plain Python: compiling the estimator anew for the one effect more would take longer than everything else here.
        _run("own_effect.py", "replay", tmp_path / "warming.log", *files, NUMBA_DISABLE_JIT="1")
        columns[widening] = pyarrow.parquet.read_table(table)["stiffness_force_N"].to_numpy()
    plain = Replay(emb_daemon.shipped_calibration()).run(tmp_path / "warming.log").estimates["stiffness_force"]
    assert np.array_equal(columns[0.0], plain)
    change = columns[2.0] - columns[0.0]
    assert np.array_equal(change[:120], np.zeros(120)) and plain[-1] > 2000.0 and change[-1] < -20.0


def test_an_effect_registered_too_late_is_refused():
    """The estimator is compiled without it by then, and it would have no effect."""
    with pytest.raises(RuntimeError, match="already"):
        extend(REGISTRY[0])
