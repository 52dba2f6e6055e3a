"""The table of facts: each fact gives its reasons and source, and every reason of the DBC has something that raises it."""

import functools
import operator
import re
from pathlib import Path

import brake
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.estimator import status
from emb_daemon.estimator.records import ESTIMATE, SAMPLE, new_state
from emb_daemon.estimator.status import TABLE, names, tell_status
from emb_daemon.estimator.step import _look, predict
from emb_daemon.models.fusion import COULOMB, FADE, GAIN, INERTIA, LOAD, SCALE, SLOW, VISCOUS
from emb_daemon.wire import contract as r

#: Reasons that frames, bus and clock give, outside the estimator. test_faults.py, test_faults_loop.py, test_hostile.py raise
#: each of them.
_OUTSIDE = (
    r.RESOLVER_LOST | r.CURRENT_LOST | r.THERMOCOUPLE_LOST | r.WHEEL_SPEED_LOST | r.WHEEL_PULSE_LOST | r.VEHICLE_STATUS_LOST
    | r.E2E_ERROR | r.BUS_DISTURBED | r.DEADLINE_MISSED | r.SECOND_SENDER
)  # fmt: skip

_BITS = {name: 1 << bit for bit, name in enumerate(TABLE)}


def _told(facts):
    out = np.zeros(1, ESTIMATE)
    out["reasons"], out["source"], out["facts"] = -1, -1, -1
    tell_status(facts, out[0])
    assert out["facts"] == facts
    return int(out["reasons"][0]), int(out["source"][0])


def test_without_facts_both_paths_hold():
    assert _told(0) == (0, r.FUSED)


@pytest.mark.parametrize("name", TABLE)
def test_each_fact_gives_its_reasons_and_source(name):
    assert _told(_BITS[name]) == (TABLE[name].reasons, TABLE[name].source)
    assert names(_BITS[name]) == (name,)


def test_a_prediction_finds_nothing(parameters):
    out = np.full(1, np.array(-1).astype(ESTIMATE))
    predict(new_state()[0], brake.ideal(parameters), 0.004, out[0])
    assert out["facts"] == 0


@given(st.sets(st.sampled_from(list(TABLE))))
def test_what_leaves_less_decides(chosen):
    """Nothing leaves nothing, whatever else is true; without stiffness the torque goes on, whatever was said of the torque
    while
    the paths were compared; else stiffness; else both."""
    reasons, source = _told(sum(_BITS[name] for name in chosen))
    left = {TABLE[name].source for name in chosen}
    assert source == next((s for s in (r.INVALID, r.TORQUE_ONLY, r.STIFFNESS_ONLY) if s in left), r.FUSED)
    assert reasons == functools.reduce(operator.or_, (TABLE[name].reasons for name in chosen), 0)


def test_the_bits_are_named_after_their_facts():
    """A constant that stands in another order than the table would tell something else than was found."""
    shorter = {"temperature_uncertain": "TEMPERATURE_VAGUE"}
    for name, bit in _BITS.items():
        assert getattr(status, shorter.get(name, name.upper())) == bit


def test_every_reason_of_the_dbc_can_be_raised():
    of_the_table = functools.reduce(operator.or_, (fact.reasons for fact in TABLE.values()))
    assert of_the_table | _OUTSIDE == (1 << len(r.REASONS)) - 1
    dbc = (Path(__file__).parent.parent / "dbc" / "emb.dbc").read_text(encoding="utf-8")
    assert set(re.findall(r"SG_ DegradedReasons : \d+\|(\d+)@", dbc)) == {str(len(r.REASONS))}


class _Seen:
    """A state, a sample and an estimate in which nothing is wrong."""

    def __init__(self, p):
        self.p, self.state, self.sample, self.out = p, new_state(), np.zeros(1, SAMPLE), np.zeros(1, ESTIMATE)
        self.state["temperature_known"], self.state["scale"] = True, 1.0
        self.state["monitor"]["high"] = p["maximum_force"]
        self.sample["dt"], self.sample["caliper"] = 0.004, 20.0
        self.out["force"], self.out["sigma"] = 5000.0, 40.0

    def facts(self, samples=1, before=0):
        for _ in range(samples):
            found = _look(self.state[0], self.p, self.sample[0], before, self.out[0])
            if found & _BITS["bounds_contradict"]:
                break
        return set(names(found))


@pytest.fixture
def seen(parameters):
    return _Seen(brake.ideal(parameters))


def test_nothing_wrong_is_no_fact(seen):
    assert seen.facts() == set()


def test_temperature(seen):
    seen.state["temperature_sigma"] = 9.9
    assert not seen.facts()
    seen.state["temperature_sigma"] = 10.1
    assert seen.facts() == {"temperature_uncertain"}
    seen.state["temperature_known"] = False
    assert seen.facts() == {"temperature_unknown"}


@pytest.mark.parametrize("rate", [0.002, -0.002])
def test_a_zero_that_wanders_is_told_of_a_brake_whose_clearance_is_not_certain(seen, rate):
    seen.state["straying"]["rate"] = rate
    assert seen.facts() == {"zero_wanders"}
    seen.p["clearance_sigma"] = 0.0
    assert seen.facts() == set()


def test_stuck_thermocouple_and_contradicted_wheel(seen):
    seen.state["plate_stuck"] = True
    seen.state["wheel"]["contradicted"] = True
    assert seen.facts() == {"thermocouple_stuck", "wheel_contradicted"}


@pytest.mark.parametrize(("name", "value"), [("scale", 0.3), ("scale", 3.0), ("creep", (0.5, 0.0)), ("creep", (0.0, -0.5))])
def test_a_learned_value_at_its_bound(seen, name, value):
    seen.state[name] = value
    assert seen.facts() == {"bound_reached"}


@pytest.mark.parametrize("scale", [0.35, 2.6])
def test_a_stiffness_that_may_be_beyond_its_bound_by_chance_is_at_it(seen, scale):
    """Pads of which a piece has broken off looked 0.309 +- 0.018 as stiff, 1 kN wrong, and were not told to be at a bound."""
    seen.state["scale"], seen.state["covariance"][0, SCALE, SCALE] = scale, 0.04**2
    assert seen.facts() == set()
    seen.state["covariance"][0, SCALE, SCALE] = 0.06**2
    assert seen.facts() == {"bound_reached"}


#: How far motor and friction can be from the calibration, one standard deviation.
_REACHES = {
    GAIN: lambda p: 0.05,
    INERTIA: lambda p: 0.1,
    SLOW: lambda p: 0.5,
    LOAD: lambda p: np.hypot(p["load_friction"], p["torque_relative_sigma"] * p["gear_gain"]),
    COULOMB: lambda p: 2.0 * p["offset_friction"],
    VISCOUS: lambda p: 2.0 * p["offset_friction"] / p["maximum_speed"],
}


@pytest.mark.parametrize("state", _REACHES)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_motor_and_friction_that_no_such_brake_has_are_told_and_count(seen, state, sign):
    """Up to three times what a brake can be off by nothing happens; beyond, sigma grows by what chance does not explain."""
    reach = sign * _REACHES[state](seen.p)
    seen.state["error"][0, state] = 2.95 * reach
    assert seen.facts() == set() and seen.out["sigma"][0] == 40.0
    seen.state["error"][0, state] = 5.0 * reach
    assert seen.facts() == {"bound_reached"} and seen.out["sigma"][0] == pytest.approx(40.0 * np.sqrt(1.0 + 25.0 - 9.0))


def test_grease_of_a_cold_caliper_may_be_as_thick_as_it_gets(seen):
    seen.state["error"][0, VISCOUS] = 12.0 * _REACHES[VISCOUS](seen.p)
    assert "bound_reached" in seen.facts()
    seen.out["sigma"], seen.sample["caliper"] = 40.0, -20.0
    assert seen.facts() == set()


def test_a_motor_may_be_as_much_weaker_as_its_heat_explains(seen):
    seen.state["error"][0, GAIN] = -0.3
    assert seen.facts() == {"bound_reached"}
    seen.out["sigma"], seen.state["error"][0, FADE], seen.state["winding"] = 40.0, -0.2, 0.5
    assert seen.facts() == set()


@pytest.mark.parametrize("largest_N, limit_N", [(30e3, 300.0), (45e3, 300.0), (16e3, 300.0), (10e3, 200.0)])
def test_a_force_that_is_uncertain(seen, largest_N, limit_N):
    seen.p["maximum_force"] = largest_N
    seen.out["sigma"] = 1.01 * limit_N
    assert seen.facts() == {"force_uncertain"}
    seen.out["sigma"] = 0.99 * limit_N
    assert seen.facts() == set()
    seen.state["covariance"][..., 1, 1] = 0.51**2
    assert seen.facts() == {"force_uncertain"}


def test_beyond_what_was_calibrated(seen):
    seen.out["force"] = 1.01 * seen.p["maximum_force"]
    assert "beyond_range" in seen.facts()
    seen.out["force"] = 5000.0
    for share, expected in ((1.19, set()), (-1.21, {"beyond_range"})):
        seen.sample["speed"] = share * seen.p["maximum_speed"]
        assert seen.facts() == expected


@pytest.mark.parametrize("field", ["force", "sigma"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e28])
def test_what_no_brake_can_do_is_neither_told_nor_used(seen, field, value):
    """Force and sigma stay within the brake's, whatever came of the arithmetic."""
    seen.out[field] = value
    facts, most = seen.facts(), seen.p["maximum_force"]
    assert 0.0 <= seen.out["force"][0] <= 1.3 * most and 0.0 < seen.out["sigma"][0] <= most
    if field == "force" or not np.isfinite(value):
        assert "not_a_number" in facts and seen.out["force"][0] == 0.0 and seen.out["sigma"][0] == most
    else:
        assert "force_uncertain" in facts


def test_a_force_that_the_monitor_rules_out_is_replaced_by_its_bounds(seen):
    """Not at once: a stroke may leave the smoothed torque behind. Then: the middle of the interval, with a sigma that
    reaches its
    ends and the force that was ruled out."""
    seen.facts(200)
    seen.state["monitor"]["low"], seen.state["monitor"]["high"] = 1000.0, 3000.0
    assert "bounds_contradict" not in seen.facts(98), "within the time that is tolerated"
    assert seen.out["force"][0] == 5000.0
    assert "bounds_contradict" in seen.facts(4)
    assert (seen.out["force"][0], seen.out["sigma"][0]) == (2000.0, 3000.0)
    wide = seen.state["monitor"]
    wide["low"], wide["outside_s"] = 0.0, 1.0
    seen.out["force"], seen.out["sigma"] = 3200.0, 10.0
    assert "bounds_contradict" in seen.facts()
    assert (seen.out["force"][0], seen.out["sigma"][0]) == (1500.0, 1700.0)
    seen.out["force"], seen.out["sigma"] = 1600.0, 10.0
    assert "bounds_contradict" in seen.facts()
    assert (seen.out["force"][0], seen.out["sigma"][0]) == (1500.0, 1500.0)


def test_a_frozen_current_rules_nothing_out(seen):
    seen.facts(200)
    seen.state["monitor"]["low"], seen.state["monitor"]["high"] = 0.0, 1000.0
    assert seen.facts(200, before=_BITS["current_implausible"]) == {"current_implausible"}
    assert seen.out["force"][0] == 5000.0
