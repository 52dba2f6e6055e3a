"""The C step equals the compiled one to the last bit, so that their times can be compared."""

import numpy as np
import pytest

from emb_daemon.effects import REGISTRY
from emb_daemon.estimator.records import new_state
from emb_daemon.offline import estimate, load_log
from emb_daemon.wire.contract import PATHS_DISAGREE, reason_words
from studies.c_twin.twin import Twin, compiler


@pytest.fixture(scope="module")
def twin():
    if compiler() is None:
        pytest.skip("NOT RUN: no C compiler (cc, gcc or clang) to compile studies/c_twin/step.c with")
    return Twin()


def _assert_equal(one, other, where=""):
    """Records equal to the last bit, NaN for NaN."""
    for name in one.dtype.names:
        if one.dtype[name].names:
            _assert_equal(one[name], other[name], f"{where}{name}.")
        else:
            np.testing.assert_array_equal(one[name], other[name], err_msg=where + name)


def _both(twin, samples, parameters):
    """Estimates of both steps, and whether they and the states they leave behind are equal."""
    states = new_state(), new_state()
    compiled = estimate(samples, parameters[:1], states[0])
    _assert_equal(compiled, twin.estimate(samples, parameters[:1], states[1]))
    _assert_equal(*states)
    return compiled


@pytest.mark.parametrize("log", ["static/random_9p5mm", "integrated/val", "thermal/validate", "undeclared/case3/val"])
def test_c_equals_the_compiled_step_on_rig_logs(twin, rig, parameters, log):
    path = rig / f"{log}.log.gz"
    samples = load_log(path).samples
    estimates = _both(twin, samples, parameters)
    assert len(estimates) > 1000 and np.nanmax(estimates["force"]) > 1000.0


def test_c_equals_the_compiled_step_with_every_effect_on(twin, rig, parameters):
    for effect in REGISTRY:
        for parameter in effect.parameters:
            value = parameter.starts[0] if parameter.starts else 0.3 * parameter.prior or parameter.high
            parameters[0]["effects"][effect.name][parameter.name] = value
    samples = load_log(rig / "integrated" / "val.log.gz").samples
    plain = estimate(samples, parameters[1:2])
    effective = _both(twin, samples, parameters)
    assert np.nanmax(np.abs(effective["force"] - plain["force"])) > 100.0


def _faulty(samples):
    """Faults one after another, each for one twentieth of the rows: the branches that a sound log never takes."""
    samples = samples.copy()
    part = np.array_split(samples, 20)
    part[1]["angle"], part[1]["speed"] = part[1]["angle"][0], part[1]["speed"][0]
    part[3]["current_q"] = part[3]["current_q"][0]
    part[5]["has_current"] = False
    part[7]["has_thermocouple"] = part[7]["has_status"] = part[7]["has_wheel_speed"] = False
    part[9]["current_q"] += 8.0
    part[11]["angle"] += 40.0
    part[13]["dt"] *= 20.0
    part[15]["brake_torque"] = 500.0
    part[17]["is_prediction"], part[17]["age_cycles"] = True, np.arange(len(part[17])) % 50
    part[19]["angle"] = np.nan
    return np.concatenate(part)


def test_c_equals_the_compiled_step_through_faults(twin, rig, parameters):
    samples = _faulty(load_log(rig / "integrated" / "val.log.gz").samples[:40_000])
    estimates = _both(twin, samples, parameters)
    seen = int(np.bitwise_or.reduce(estimates["reasons"]))
    assert seen & PATHS_DISAGREE and bin(seen).count("1") >= 5, reason_words(seen)
    assert {0, 1, 2, 3, 15} <= set(estimates["source"].tolist())


def test_c_sees_a_difference(twin, rig, parameters):
    """The comparison can fail: one parameter by its last bit."""
    samples = load_log(rig / "static" / "random_9p5mm.log.gz").samples
    compiled = estimate(samples, parameters[:1])
    parameters[0]["inertia"] = np.nextafter(parameters[0]["inertia"], 1.0)
    with pytest.raises(AssertionError):
        _assert_equal(compiled, twin.estimate(samples, parameters[:1]))
