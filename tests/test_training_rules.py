"""What ends a training, each reason alone, and that a rejected one changes nothing: the rules, without a brake."""

import numpy as np
import pytest

from emb_daemon.adapt import records as r
from emb_daemon.adapt import training
from emb_daemon.adapt.learned import Evaluation
from emb_daemon.adapt.memory import entry_of
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, new_state
from emb_daemon.wire import contract as c

FORBIDDING = (
    c.RESOLVER_LOST, c.CURRENT_LOST, c.THERMOCOUPLE_LOST, c.VEHICLE_STATUS_LOST, c.E2E_ERROR, c.OUT_OF_RANGE, c.STUCK,
    c.TEMPERATURE_UNCERTAIN,
)  # fmt: skip
#: A force that is not well known is what training is for; the wheel stands.
HARMLESS = (c.PATHS_DISAGREE, c.CONTACT_UNCERTAIN, c.OUTSIDE_RANGE, c.WHEEL_SPEED_LOST, c.BUS_DISTURBED, c.DEADLINE_MISSED)


@pytest.fixture
def parked():
    """ADAPTER, SAMPLE, ESTIMATE and LIMITS of a training that may go on."""
    a, m, estimate, limits = (np.zeros(1, kind)[0] for kind in (r.ADAPTER, SAMPLE, ESTIMATE, r.LIMITS))
    a["phase"], a["asked"], a["ambient"] = r.ASKING, True, 20.0
    m["has_status"], m["park_brake"] = True, c.PARK_APPLIED
    estimate["is_sample"] = True
    limits["minimum_ambient"], limits["maximum_ambient"] = -20.0, 40.0
    m["ambient"] = 20.0
    return a, m, estimate, limits


def test_a_parked_car_may_be_trained(parked):
    assert training._obstacle(*parked, True) == r.ACCEPTED


@pytest.mark.parametrize("reason", FORBIDDING, ids=lambda bit: c.reason_words(bit)[0])
def test_each_doubt_of_an_input_ends_it(parked, reason):
    parked[2]["reasons"] = reason
    assert training._obstacle(*parked, True) == r.BAD_INPUT


@pytest.mark.parametrize("reason", HARMLESS, ids=lambda bit: c.reason_words(bit)[0])
def test_other_reasons_do_not(parked, reason):
    parked[2]["reasons"] = reason
    assert training._obstacle(*parked, True) == r.ACCEPTED


@pytest.mark.parametrize(
    ("record", "field", "value", "outcome"),
    [
        (1, "has_status", False, r.BAD_INPUT),
        (1, "park_brake", c.PARK_IN_TRANSITION, r.PARK_BRAKE_LEFT),
        (1, "park_brake", c.PARK_FAULT, r.PARK_BRAKE_LEFT),
        (1, "vehicle_speed", 0.01, r.VEHICLE_MOVED),
        (1, "brake_request", 1.0, r.BRAKE_REQUESTED),
        (0, "ambient", -20.1, r.AMBIENT),
        (0, "ambient", 40.1, r.AMBIENT),
    ],
)
def test_each_change_outside_ends_it(parked, record, field, value, outcome):
    parked[record][field] = value
    assert training._obstacle(*parked, True) == outcome


def test_nobody_else_lets_go(parked):
    assert training._obstacle(*parked, False) == r.OTHERS_NOT_HOLDING


@pytest.mark.parametrize("outcome", range(r.NOT_CONVERGED, len(r.OUTCOMES)))
def test_a_rejected_evaluation_changes_no_parameter_and_no_state(parked, outcome):
    a, state = parked[0], new_state()[0]
    a["phase"], a["evaluation"], a["evaluation_ready"] = r.EVALUATING, outcome, True
    parameters, learned = np.zeros(1, PARAMETERS), np.ones(1, PARAMETERS)[0]
    before = parameters.tobytes(), state.tobytes()
    training._conclude(a, state, parameters, learned, new_state()[0], np.zeros(4, r.TRAINING))
    assert (parameters.tobytes(), state.tobytes()) == before
    assert (a["phase"], a["result"], a["outcome"], a["tried"]) == (r.IDLE, c.RESULT_REJECTED, outcome, True)


def test_an_evaluation_that_is_not_ready_changes_nothing(parked):
    a, state = parked[0], new_state()[0]
    a["phase"], a["evaluation"] = r.EVALUATING, r.ACCEPTED
    parameters = np.zeros(1, PARAMETERS)
    training._conclude(a, state, parameters, np.ones(1, PARAMETERS)[0], new_state()[0], np.zeros(4, r.TRAINING))
    assert not np.frombuffer(parameters.tobytes(), np.uint8).any() and a["result"] == c.RESULT_ABORTED


@pytest.fixture
def four():
    """ADAPTER and LIMITS of four corners at ten seconds, all of which hold."""
    adapters, limits = np.zeros(4, r.ADAPTER), np.zeros(4, r.LIMITS)
    adapters["holding"], adapters["time_ns"], limits["estimated"] = True, 10**10, True
    return adapters, limits


@pytest.mark.parametrize(
    ("field", "value"), [("holding", False), ("phase", r.ASKING), ("time_ns", 9 * 10**9)], ids=["force", "opened", "silent"]
)
def test_a_corner_is_opened_only_while_each_other_is_heard_to_hold(four, field, value):
    adapters, limits = four
    assert training.others_hold(adapters, limits, 1, 10**10)
    for other in range(4):
        before, adapters[field][other] = adapters[field][other], value
        assert training.others_hold(adapters, limits, 1, 10**10) == (other == 1), "its own is what is opened"
        limits["estimated"][other] = False
        assert training.others_hold(adapters, limits, 1, 10**10), "the process knows nothing of it"
        adapters[field][other], limits["estimated"][other] = before, True


def follow(a, estimate, limits, state=None, parameters=None, sample=None):
    state = new_state()[0] if state is None else state
    parameters = np.zeros(1, PARAMETERS)[0] if parameters is None else parameters
    sample = np.zeros(1, SAMPLE)[0] if sample is None else sample
    state["factor"] = 1.0
    training._follow(a, state, parameters, limits, sample, estimate)


def test_a_corner_holds_when_its_force_is_surely_enough(parked):
    a, _, estimate, limits = parked
    limits["parking_force"], estimate["force"], estimate["torque_force"], estimate["source"] = 3000.0, 3100.0, np.nan, 1
    for sigma, source, holds in ((49.0, 1, True), (51.0, 1, False), (49.0, c.INVALID, False)):
        estimate["sigma"], estimate["source"] = sigma, source
        follow(a, estimate, limits)
        assert a["holding"] == holds


def test_what_the_temperature_may_be_wrong_by_now_and_before_is_in_the_factors_sigma(parked):
    a, _, estimate, limits = parked
    parameters, state = np.zeros(1, PARAMETERS)[0], new_state()[0]
    estimate["torque_force"] = np.nan
    state["temperature_sigma"], state["history_sigma"], parameters["thermal"]["sigma"] = 3.0, 12.0, 4.0
    parts = []
    for now, history in ((1e-3, 0.0), (0.0, 2e-3), (1e-3, 2e-3)):
        parameters["thermal"]["softening"], parameters["thermal"]["softening_history"] = now, history
        follow(a, estimate, limits, state, parameters)
        parts.append(float(a["factor_sigma"]))
    np.testing.assert_allclose(parts, [5e-3, 2e-3 * np.hypot(12.0, 4.0), 5e-3 + 2e-3 * np.hypot(12.0, 4.0)])


def observe(parked, others_hold=True):
    a, m, estimate, limits = parked
    rows, remembered, parameters = np.zeros(4, r.TRAINING), np.zeros(1, r.REMEMBERED), np.zeros(1, PARAMETERS)
    state = new_state()[0]
    state["factor"] = 1.0
    reached = new_state()[0]
    training.observe(a, state, parameters, parameters[0], reached, remembered, limits, others_hold, rows, m, estimate)


def test_who_parks_anew_waits_anew(parked):
    a, m, estimate, limits = parked
    limits["enabled"] = True
    a["phase"], a["asked"], a["started"], a["still_time"], estimate["torque_force"] = r.IDLE, False, True, 9.0, np.nan
    a["parked_time"], limits["settling_time"], m["dt"] = 4.9, 5.0, 0.004
    m["vehicle_speed"] = 0.5
    observe(parked)
    assert a["parked_time"] == 0.0
    m["vehicle_speed"] = 0.0
    observe(parked)
    assert a["phase"] == r.IDLE and a["parked_time"] == 0.004


def test_where_learning_is_switched_off_nothing_is_asked_for(parked):
    a, m, estimate, limits = parked
    a["phase"], a["started"], a["still_time"], a["parked_time"], estimate["torque_force"] = r.IDLE, True, 9.0, 60.0, np.nan
    m["dt"], limits["high_force"] = 0.004, 1.0
    observe(parked)
    assert a["phase"] == r.IDLE and estimate["adapt_request"] == c.REQUEST_NONE
    limits["enabled"] = True
    observe(parked)
    assert a["phase"] == r.ASKING and estimate["adapt_request"] == c.REQUEST_RUN


def test_a_gap_is_bridged_while_the_estimate_is(parked):
    parked[2]["is_sample"] = False
    assert training._obstacle(*parked, True) == r.ACCEPTED
    parked[2]["source"] = c.INVALID
    assert training._obstacle(*parked, True) == r.BAD_INPUT


@pytest.mark.parametrize("outcome", range(len(r.OUTCOMES)))
def test_values_of_an_accepted_training_alone_are_kept(outcome):
    evaluation = Evaluation(outcome, values={"a": 1.0}, sigmas={"a": 0.1}, evidence={"b": np.nan})
    entry = entry_of(outcome, evaluation, "2026-11-22", 20.0, np.nan)
    accepted = outcome == r.ACCEPTED
    assert (entry.values, entry.sigmas) == (({"a": 1.0}, {"a": 0.1}) if accepted else ({}, {}))
    assert entry.evidence == {"b": None} and entry.pad_rise_K is None
