"""What ends a training, each reason alone, and that a rejected one changes nothing: the rules, without a brake."""

import numpy as np
import pytest

from emb_daemon.adapt import records as r
from emb_daemon.adapt import training
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
    training._conclude(a, state, parameters, learned, new_state(), np.zeros(4, r.TRAINING))
    assert (parameters.tobytes(), state.tobytes()) == before
    assert (a["phase"], a["result"], a["outcome"], a["tried"]) == (r.IDLE, c.RESULT_REJECTED, outcome, True)


def test_an_evaluation_that_is_not_ready_changes_nothing(parked):
    a, state = parked[0], new_state()[0]
    a["phase"], a["evaluation"] = r.EVALUATING, r.ACCEPTED
    parameters = np.zeros(1, PARAMETERS)
    training._conclude(a, state, parameters, np.ones(1, PARAMETERS)[0], new_state(), np.zeros(4, r.TRAINING))
    assert not np.frombuffer(parameters.tobytes(), np.uint8).any() and a["result"] == c.RESULT_ABORTED
