"""What ends a training, each reason alone, and that a rejected one changes nothing: the rules, without a brake."""

import adaptkit
import numpy as np
import pytest

from emb_daemon.adapt import records as r
from emb_daemon.adapt import training
from emb_daemon.adapt.fit import Driven
from emb_daemon.adapt.learned import LOAD_FRICTION, OFFSET_FRICTION, Evaluation, learned_keys, why_out_of_bounds
from emb_daemon.adapt.memory import entry_of
from emb_daemon.calibration.parameters import CLEARANCE, PRESLIDING_ANGLE, value_of
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.hypotheses import DRIFT, KEPT_JUMP, PRIOR_ODDS, STIFFNESS_JUMP, TORQUE_JUMP
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, new_state
from emb_daemon.estimator.unknown import contact_jump
from emb_daemon.models.fusion import (
    CONTACT,
    COULOMB,
    FADE,
    FAST,
    GAIN,
    HOUSING,
    INERTIA,
    LOAD,
    NOISE,
    OFFSET,
    SCALE,
    SLOW,
    VISCOUS,
)
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
    state["factor"] = state["factor"] or 1.0
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
    state["factor"] = 0.8
    parts = []
    for now, history in ((1e-3, 0.0), (0.0, 2e-3), (1e-3, 2e-3)):
        parameters["thermal"]["softening"], parameters["thermal"]["softening_history"] = now, history
        follow(a, estimate, limits, state, parameters)
        parts.append(float(a["factor_sigma"]))
    np.testing.assert_allclose(0.8 * np.array(parts), [5e-3, 2e-3 * np.hypot(12.0, 4.0), 5e-3 + 2e-3 * np.hypot(12.0, 4.0)])


def observe(parked, others_hold=True, rewinds=0):
    a, m, estimate, limits = parked
    rows, remembered, parameters = np.zeros(4, r.TRAINING), np.zeros(1, r.REMEMBERED), np.zeros(1, PARAMETERS)
    state = new_state()[0]
    state["factor"], state["rewinds"] = 1.0, rewinds
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


@pytest.mark.parametrize(("still_time", "phase"), [(0.0, r.WATCHING), (9.0, r.ASKING)])
def test_a_training_begins_with_nothing_of_the_one_before(parked, still_time, phase):
    a, m, estimate, limits = parked
    for name, value in (("phase", r.IDLE), ("asked", phase == r.WATCHING), ("started", True), ("still_angle", 0.5)):
        a[name] = value
    a["phase_time"], a["tail_time"], a["was_low"], a["was_high"], a["rows"] = 7.0, 0.5, True, True, 5
    a["still_time"], a["parked_time"], estimate["torque_force"], limits["high_force"] = still_time, 60.0, np.nan, 1.0
    # Turned by more than counts as motion, or not at all.
    m["dt"], m["angle"], limits["enabled"] = 0.004, 0.5 if still_time else 1.0, True
    observe(parked)
    assert (a["phase"], a["asked"]) == (phase, phase == r.ASKING)
    assert [a[name] for name in ("phase_time", "tail_time", "was_low", "was_high", "rows")] == [0.0, 0.0, False, False, 0]


def test_samples_of_a_tick_are_answered_until_a_training_ends_or_waits():
    """Then its outcome is kept, or its evaluation begins, before the next sample."""
    samples, estimates = np.zeros(3, SAMPLE), np.zeros(3, ESTIMATE)
    samples["corner"], samples["has_status"], samples["park_brake"] = 1, True, c.PARK_APPLIED
    for name in ("inner_backplate", "outer_backplate", "caliper", "ambient"):
        samples[name] = 20.0
    samples["has_thermocouple"] = samples["has_current"] = samples["has_wheel_speed"] = True
    samples["vehicle_speed"][1], samples["dt"][1:] = 1.0, 0.004
    adapters, limits = np.zeros(4, r.ADAPTER), np.zeros(4, r.LIMITS)
    adapters["phase"][1], adapters["asked"][1] = r.ASKING, True
    limits["enabled"], limits["estimated"] = True, [False, True, False, False]
    limits["maximum_ambient"], limits["high_force"], limits["answer_time"] = 40.0, 1.0, 9.0
    parameters = np.repeat(np.atleast_1d(to_parameters(adaptkit.shipped())), 4)
    states, rows = new_state(4), np.zeros((4, 5), r.TRAINING)
    arguments = (
        states,
        parameters,
        parameters.copy(),
        new_state(4),
        np.zeros(4, r.REMEMBERED),
        estimates,
        adapters,
        limits,
        rows,
    )
    assert training.answer_adapting(samples, 0, 3, *arguments) == 2
    assert adapters["ended"].tolist() == [False, True, False, False] and adapters["outcome"][1] == r.VEHICLE_MOVED
    adapters["ended"] = False
    assert training.answer_adapting(samples, 2, 3, *arguments) == 3
    assert states["started"].tolist() == [False, True, False, False] and estimates["corner"].tolist() == [1, 1, 1]


def test_a_released_park_brake_allows_another_training(parked):
    """And whatever ends one begins the waiting anew."""
    a, m, estimate, limits = parked
    a["tried"], a["parked_time"], limits["enabled"], estimate["torque_force"] = True, 3.0, True, np.nan
    m["vehicle_speed"], m["dt"] = 1.0, 0.004
    observe(parked)
    assert (a["phase"], a["tried"], a["ended"], a["parked_time"]) == (r.IDLE, True, True, 0.0)
    m["park_brake"], a["ended"] = c.PARK_IN_TRANSITION, False
    observe(parked)
    assert not a["tried"] and not a["ended"], "there was none to end"


def test_who_brakes_while_parked_waits_anew(parked):
    a, m, estimate, limits = parked
    limits["enabled"], limits["settling_time"], estimate["torque_force"] = True, 9.0, np.nan
    a["phase"], a["asked"], a["started"], a["still_time"], m["dt"] = r.IDLE, False, True, 9.0, 0.5
    for request, parked_s in ((0.0, 0.5), (0.0, 1.0), (1.0, 0.0), (0.0, 0.5)):
        m["brake_request"] = request
        observe(parked)
        assert a["parked_time"] == parked_s and a["phase"] == r.IDLE


@pytest.mark.parametrize(
    ("phase", "result", "mode", "told"),
    [
        (r.IDLE, c.NO_RESULT, c.RUNNING, (0, 0, c.NO_RESULT, c.RUNNING)),
        (r.IDLE, c.RESULT_ACCEPTED, c.RUNNING, (0, 100, c.RESULT_ACCEPTED, c.RUNNING)),
        (r.IDLE, c.RESULT_REJECTED, c.RUNNING, (0, 0, c.RESULT_REJECTED, c.RUNNING)),
        (r.ASKING, c.RESULT_ACCEPTED, c.RUNNING, (1, 50, c.NO_RESULT, c.ADAPTING)),
        (r.WATCHING, c.NO_RESULT, c.DEGRADED, (0, 50, c.NO_RESULT, c.DEGRADED)),
        (r.EVALUATING, c.NO_RESULT, c.RUNNING, (0, 95, c.NO_RESULT, c.ADAPTING)),
    ],
)
def test_what_is_told_of_a_training(parked, phase, result, mode, told):
    a, _, estimate, limits = parked
    limits["enabled"], limits["high_force"], limits["settling_time"] = True, 1e4, 9.0
    limits["longest_training"] = limits["answer_time"] = 1e9
    a["phase"], a["result"], estimate["mode"], a["still_time"], a["force"], a["was_high"] = phase, result, mode, 1.0, 2e4, True
    a["asked"], a["started"], estimate["torque_force"] = phase == r.ASKING, True, np.nan
    observe(parked)
    names = ("adapt_request", "adapt_progress", "adapt_result", "mode")
    assert tuple(estimate[name] for name in names) == told


def test_an_accepted_evaluation_takes_effect_with_what_came_since(parked):
    """Parameters at once, the path models over the samples after the training, and a snapshot that belongs to both."""
    p = to_parameters(adaptkit.shipped())
    state, reached, parameters, learned = new_state()[0], new_state()[0], np.atleast_1d(p).copy(), p.copy()
    learned["curve"][1] *= 1.1
    a, rows = parked[0], np.zeros(6, r.TRAINING)
    rows["dt"], rows["factor"], rows["angle"] = 0.004, 1.0, [99.0, 99.0, 8.0, 8.5, 9.0, 99.0]
    reached["started"], reached["angle"], reached["contact_angle"], reached["past_contact"] = True, 7.5, 7.0, 0.5
    a["phase"], a["evaluation"], a["evaluation_ready"], a["time_ns"] = r.EVALUATING, r.ACCEPTED, True, 12
    a["training_rows"], a["rows"], a["contact_angle"], a["contact_sigma"] = 2, 5, 7.0, 0.01
    training._conclude(a, state, parameters, learned, reached, rows)
    assert parameters.tobytes() == learned.tobytes() and state["past_contact"] == pytest.approx(2.0)
    assert (a["result"], a["outcome"], a["tried"], a["snapshot_wanted"]) == (c.RESULT_ACCEPTED, r.ACCEPTED, True, True)
    assert a["snapshot_ns"] == 12


def strokes(parked, *forces):
    """Whether a full stroke has been seen after each of these forces, a quarter of a second apart."""
    a, _, _, limits = parked
    limits["high_force"], limits["low_force"], limits["coverage"] = 10_000.0, 100.0, 0.8
    seen = []
    for force in forces:
        a["force"] = force
        seen.append(bool(training._stroke(a, limits, 0.25)))
    return seen


def test_a_stroke_is_released_clamped_and_released_for_a_second(parked):
    """Beyond four hundredths of the high force and the low one it is not released; clamped is the share to be covered."""
    assert not any(strokes(parked, *[8100.0] * 9)), "it was not released before"
    assert strokes(parked, 499.0, 8001.0, 499.0, *[0.0] * 4) == [False] * 6 + [True]


@pytest.mark.parametrize("forces", [(501.0, 8001.0, *[0.0] * 9), (0.0, 7999.0, *[0.0] * 9), (0.0, 8001.0, *[501.0] * 9)])
def test_less_is_no_stroke(parked, forces):
    assert not any(strokes(parked, *forces))


def test_who_clamps_again_after_a_stroke_has_made_it(parked):
    assert strokes(parked, 0.0, 9000.0, 0.0, *[9000.0] * 4)[-2:] == [False, True]


@pytest.mark.parametrize(
    ("phase", "low", "high", "force", "percent"),
    [
        (r.EVALUATING, True, True, 0.0, 95),
        (r.ASKING, False, False, 5000.0, 0),
        (r.ASKING, True, False, -1.0, 5),
        (r.ASKING, True, False, 5000.0, 27),
        (r.WATCHING, True, False, 20_000.0, 50),
        (r.ASKING, True, True, 20_000.0, 50),
        (r.ASKING, True, True, 5000.0, 70),
        (r.ASKING, True, True, 0.0, 90),
    ],
)
def test_progress_never_goes_back_in_a_stroke(parked, phase, low, high, force, percent):
    a, _, _, limits = parked
    limits["high_force"] = 10_000.0
    a["phase"], a["was_low"], a["was_high"], a["force"] = phase, low, high, force
    assert training._progress(a, limits) == percent


def test_two_pulses_either_way_are_a_wheel_that_rolls(parked):
    """And begin anew from there; one may be an edge that stands at the sensor."""
    a, m, _, _ = parked
    m["has_wheel_pulse"], a["pulse"] = True, 1.0
    for pulse, rolled in ((2.0, False), (0.0, False), (3.0, True), (4.0, False), (1.0, True), (c.PULSE_MODULO - 1.0, True)):
        m["wheel_pulse"] = pulse
        assert training._has_rolled(a, m) == rolled, pulse
    m["has_wheel_pulse"], m["wheel_pulse"] = False, 9.0
    assert not training._has_rolled(a, m)


@pytest.mark.parametrize(("speed", "moved"), [(0.09, False), (0.11, True)])
def test_a_wheel_that_turns_is_a_car_that_moves(parked, speed, moved):
    parked[1]["wheel_speed"] = speed
    assert training._obstacle(*parked, True) == r.ACCEPTED
    parked[1]["has_wheel_speed"] = True
    assert training._obstacle(*parked, True) == (r.VEHICLE_MOVED if moved else r.ACCEPTED)


def advance(parked, rows=None, dt=0.25, remembered=None, force=0.0, aligned=(0.0, 0.0, 0.0)):
    a, m, _, limits = parked
    m["dt"] = dt
    state, parameters = new_state()[0], np.zeros(1, PARAMETERS)
    state["angle"], state["speed"], state["current_before"] = aligned
    state["factor"], state["effects"]["second_relaxation"]["force"] = 1.0, force
    rows = np.zeros(10, r.TRAINING) if rows is None else rows
    remembered = np.zeros(1, r.REMEMBERED) if remembered is None else remembered
    training._advance(a, state, parameters, parameters[0], new_state()[0], remembered, limits, rows, m)
    return rows


def test_who_does_not_answer_in_time_is_not_asked_again(parked):
    a, _, _, limits = parked
    limits["answer_time"], a["still_time"] = 1.0, 0.5
    for _ in range(4):
        advance(parked)
        assert (a["phase"], a["tried"], a["rows"]) == (r.ASKING, False, 0)
    advance(parked)
    assert (a["phase"], a["tried"], a["result"], a["outcome"]) == (r.IDLE, True, c.RESULT_ABORTED, r.NO_ANSWER)
    assert a["ended"]


@pytest.mark.parametrize("limit", ["time", "rows"])
def test_a_training_that_takes_too_long_is_given_up(parked, limit):
    """The answer's time and its own, or as many samples as there is room for."""
    a, _, _, limits = parked
    limits["answer_time"], limits["longest_training"], limits["high_force"] = 1.0, 2.0, 1.0
    a["still_time"], rows = 0.0, np.zeros(r.CAPACITY, r.TRAINING)
    if limit == "rows":
        a["rows"], limits["longest_training"] = r.TRAINING_SAMPLES - 12, 1e9
    for _ in range(11 if limit == "rows" else 12):
        advance(parked, rows)
        assert a["phase"] == r.ASKING
    advance(parked, rows)
    assert (a["phase"], a["tried"], a["outcome"], a["result"]) == (r.IDLE, True, r.TOO_LONG, c.RESULT_ABORTED)


def test_motion_without_request_that_ends_before_a_stroke_is_nothing(parked):
    a, _, _, limits = parked
    a["phase"], a["asked"], a["still_time"] = r.WATCHING, False, 3.0
    limits["high_force"] = limits["longest_training"] = 1e9
    advance(parked)
    assert (a["phase"], a["rows"]) == (r.WATCHING, 1)
    a["still_time"] = 3.1
    advance(parked)
    assert (a["phase"], a["result"], a["ended"], a["tried"]) == (r.IDLE, c.NO_RESULT, False, False)


def test_what_a_training_collects_is_what_the_path_models_read(parked):
    """The current of a gap, which is of its last cycle alone, excepted; with what pads remembered when it began. Of signals
    that came late it is what the estimator makes of them."""
    a, m, _, limits = parked
    a["still_time"], limits["high_force"], limits["longest_training"] = 0.0, 1e9, 1e9
    aligned = {"angle": 11.0, "speed": 12.0, "current_q": 13.0}
    shared = [name for name in r.TRAINING.names if name not in ("factor", "faded", *aligned)]
    for number, name in enumerate(shared):
        m[name] = True if name.startswith("has_") else 2.0 + number
    remembered = np.zeros(1, r.REMEMBERED)
    rows = advance(parked, None, 0.004, remembered, 3.0, tuple(aligned.values()))
    assert all(rows[0][name] == m[name] for name in shared) and rows[0]["factor"] == 1.0
    assert all(rows[0][name] == value for name, value in aligned.items())
    advance(parked, rows, 0.1, remembered, 4.0)
    assert remembered["second_relaxation"]["force"] == 3.0
    assert not rows[1]["has_current"] and rows[1]["caliper"] == m["caliper"] and a["rows"] == 2


def test_a_training_ends_where_what_it_collected_is_found_to_be_wrong(parked):
    """As by a current that comes late, which shows in fast strokes only. It may be asked for again."""
    a, m, estimate, limits = parked
    limits["enabled"] = True
    limits["high_force"], limits["longest_training"], limits["answer_time"] = 1e9, 1e9, 1e9
    a["rewinds"], a["rows"], estimate["torque_force"], m["dt"] = 3, 2, np.nan, 0.004
    observe(parked, rewinds=3)
    assert a["phase"] == r.ASKING
    observe(parked, rewinds=4)
    assert (a["phase"], a["outcome"], a["tried"], a["rewinds"]) == (r.IDLE, r.BAD_INPUT, False, 4)


@pytest.mark.parametrize("stops", [0.0, 1.0])
def test_a_training_knows_how_the_motor_fades_by_what_was_known_before_it(parked, stops):
    """By what stops have shown, not by what it makes the filter believe itself; at the heat of each sample."""
    a, m, _, _ = parked
    a["rows"], s, rows = 0, new_state()[0], np.zeros(2, r.TRAINING)
    s["stops"] = stops
    for fade, housing_fade, winding in ((-0.5, -0.2, 0.1), (0.3, 0.1, 0.3)):
        s["error"][[FADE, HOUSING]], s["winding"], s["housing"] = (fade, housing_fade), winding, 0.2
        training._collect(a, s, np.zeros(1, r.REMEMBERED), rows, m)
    np.testing.assert_allclose(rows["faded"], stops * np.array([-0.5 * 0.1 - 0.2 * 0.2, -0.5 * 0.3 - 0.2 * 0.2]))


@pytest.mark.parametrize("stops", [0.0, 1.0])
def test_a_training_knows_motor_and_rotor_by_what_stops_had_shown_before_it(parked, stops):
    """Changes by their shares; what pads, motor and rotor have in common no stop shows."""
    a, m, _, _ = parked
    a["rows"], s, rows = 0, new_state()[0], np.zeros(2, r.TRAINING)
    s["stops"], s["common"], both = stops, 0.02**2, np.ix_([GAIN, INERTIA], [GAIN, INERTIA])
    s["error"][[GAIN, INERTIA]] = 0.01, -0.02
    s["covariance"][both] = [[1e-4, 3e-5], [3e-5, 4e-4]]
    torque = s["alternatives"][TORQUE_JUMP]
    torque["share"], torque["error"][[GAIN, INERTIA]] = 0.25, (0.05, 0.02)
    torque["covariance"][both] = [[4e-4, -1e-5], [-1e-5, 1e-4]]
    training._collect(a, s, np.zeros(1, r.REMEMBERED), rows, m)
    s["error"][GAIN] = 0.3
    training._collect(a, s, np.zeros(1, r.REMEMBERED), rows, m)
    driven = Driven.of(a)
    assert (driven is None) == (stops == 0.0)
    if driven:
        mean, within = (0.02, -0.01), [0.75 * 1e-4 + 0.25 * 4e-4, 0.75 * 4e-4 + 0.25 * 1e-4, 0.75 * 3e-5 - 0.25 * 1e-5]
        apart = 0.25 * 0.75 * 0.04 * 0.04
        assert driven == pytest.approx((*mean, *(variance + apart + 0.02**2 for variance in within)))


def test_a_stroke_is_evaluated_for_a_fixed_time(parked):
    """However long the evaluation itself takes, so that a replay does the same."""
    a, _, _, limits = parked
    a["still_time"], rows = 0.0, np.zeros(r.CAPACITY, r.TRAINING)
    limits["high_force"], limits["coverage"], limits["longest_training"] = 10_000.0, 0.8, 1e9
    for force in (0.0, 9000.0, *[0.0] * 5):
        a["force"] = force
        advance(parked, rows)
    assert (a["phase"], a["rows"], a["training_rows"], a["evaluation_wanted"], a["generation"]) == (
        r.EVALUATING,
        7,
        7,
        True,
        1,
    )
    for _ in range(r.EVALUATION_SAMPLES - 1):
        advance(parked, rows, 0.004)
    assert a["phase"] == r.EVALUATING
    a["evaluation"], a["evaluation_ready"] = r.NOT_CONVERGED, True
    advance(parked, rows, 0.004)
    assert (a["phase"], a["outcome"], a["tried"]) == (r.IDLE, r.NOT_CONVERGED, True)


@pytest.mark.parametrize(("asked", "result", "told"), [(True, 2, True), (False, 2, False), (False, 1, True)])
def test_an_unasked_training_that_was_aborted_is_no_news(parked, asked, result, told):
    a = parked[0]
    a["asked"], a["rows"], a["evaluation_wanted"], a["parked_time"] = asked, 5, True, 9.0
    training.end_training(a, r.VEHICLE_MOVED, c.RESULT_ABORTED if result == 2 else c.RESULT_ACCEPTED)
    assert a["ended"] == told and (a["outcome"] == r.VEHICLE_MOVED) == told
    assert (a["phase"], a["rows"], a["evaluation_wanted"], a["parked_time"], a["asked"]) == (r.IDLE, 0, False, 0.0, False)


def test_the_motor_stands_when_it_has_not_turned_by_a_third_of_a_radian(parked):
    """At power-on it has for long."""
    a, m, estimate, limits = parked
    estimate["torque_force"], m["dt"], m["angle"], m["wheel_pulse"] = np.nan, 0.5, 4.0, 7.0
    follow(a, estimate, limits, sample=m)
    assert (a["power_on_angle"], a["still_angle"], a["pulse"], a["still_time"]) == (4.0, 4.0, 7.0, 3.5)
    for angle, still_time in ((4.29, 4.0), (3.71, 4.5), (4.31, 0.0), (4.31, 0.5), (4.02, 1.0), (4.0, 0.0)):
        m["angle"] = angle
        follow(a, estimate, limits, sample=m)
        assert a["still_time"] == still_time
    assert a["power_on_angle"] == 4.0


def test_the_force_that_makes_a_stroke_is_smoothed_and_free_of_the_torques_offset(parked):
    a, m, estimate, limits = parked
    state, parameters = new_state()[0], np.zeros(1, PARAMETERS)[0]
    m["dt"], parameters["gear_gain"], state["error"][4] = 0.1, 0.5, 50.0
    estimate["torque_force"] = 1100.0
    follow(a, estimate, limits, state, parameters, m)
    assert a["force"] == pytest.approx(0.4 * 1000.0)
    m["dt"] = 0.5
    follow(a, estimate, limits, state, parameters, m)
    assert a["force"] == pytest.approx(1000.0)
    estimate["torque_force"] = np.nan
    follow(a, estimate, limits, state, parameters, m)
    assert a["force"] == pytest.approx(1000.0)


def test_a_snapshot_is_wanted_every_ten_seconds_and_when_the_car_is_parked(parked):
    a, m, estimate, limits = parked
    estimate["torque_force"], m["park_brake"] = np.nan, 0.0
    wanted = []
    for seconds, park in ((9.9, False), (10.0, False), (12.0, True), (13.0, True), (22.0, True)):
        estimate["time_ns"], m["park_brake"] = round(1e9 * seconds), c.PARK_APPLIED if park else 0.0
        a["snapshot_wanted"] = False
        follow(a, estimate, limits, sample=m)
        wanted.append(bool(a["snapshot_wanted"]))
    assert wanted == [False, True, True, False, True] and a["snapshot_ns"] == 22 * 10**9


def test_ambient_and_rise_are_those_of_what_is_known(parked):
    a, m, estimate, limits = parked
    state, estimate["torque_force"] = new_state()[0], np.nan
    state["mean"], m["ambient"] = (40.0, 60.0), 12.0
    for known, status, ambient, rise in ((True, True, 12.0, 38.0), (False, True, 12.0, np.nan), (True, False, np.nan, np.nan)):
        state["temperature_known"], m["has_status"] = known, status
        follow(a, estimate, limits, state, sample=m)
        np.testing.assert_array_equal((a["ambient"], a["rise"]), (ambient, rise))


def applied(kept, moved=0.02, sigma=0.03):
    """STATE before and after an accepted training, and its ADAPTER and PARAMETERS; ``kept``: the curve is the old one."""
    rng, state, reached = np.random.default_rng(3), new_state()[0], new_state()[0]
    p, learned, a = (np.zeros(1, kind)[0] for kind in (PARAMETERS, PARAMETERS, r.ADAPTER))
    for q in (p, learned):
        q["curve"][:2], q["gear_gain"], q["clearance_sigma"] = (10.0, 100.0), 4e-5, 0.02
        q["load_friction"], q["offset_friction"], q["maximum_speed"], q["maximum_force"] = 1e-6, 0.01, 300.0, 3e4
    learned["stiffness_relative_sigma"] = 0.015
    if not kept:
        learned["curve"][1] = 101.0
    root = rng.standard_normal((len(state["error"]),) * 2)
    state["error"], state["covariance"] = rng.uniform(0.01, 0.02, len(state["error"])), 1e-4 * root @ root.T
    state["alternatives"]["error"], state["alternatives"]["covariance"] = state["error"], 2.0 * state["covariance"]
    state["contact_angle"], state["past_contact"], state["scale"], state["winding"], state["housing"] = 8.0, 2.0, 1.1, 0.3, 0.2
    state["contact_anchor"], state["contact"]["lost"], state["resumed"] = 7.9, True, True
    state["rotor_odds"] = state["unit_odds"] = 1e-9
    reached["contact_angle"], reached["past_contact"], reached["force"] = 8.0 + moved, 2.0 - moved, 900.0
    a["contact_angle"], a["contact_sigma"], a["torque_error"], a["torque_error_sigma"] = 8.0 + moved, sigma, 0.04, 0.01
    a["inertia_error"], a["inertia_sigma"] = 0.05, 0.02
    a["fade"], a["housing_fade"] = -0.3, 0.1
    before = state.copy()
    training.apply_learned(state, p, reached, np.zeros(0, r.TRAINING), learned, a)
    return before, state, a, learned


@pytest.mark.parametrize("kept", [True, False])
def test_what_was_shown_of_the_unit_holds_for_the_curve_that_showed_it(kept):
    """What motor, rotor and the new values leave open of the force is weighed at once."""
    _, state, *_ = applied(kept)
    assert state["common"] > 0.0 and (state["rotor_odds"] == 1e-9) == (state["unit_odds"] == 1e-9) == kept


OF_THE_MOTOR = [GAIN, OFFSET, FADE, HOUSING, INERTIA]


@pytest.mark.parametrize("kept", [True, False])
def test_an_accepted_training_restarts_what_it_has_fitted(kept):
    """Friction and the stiffness path, with all correlations; what is known of motor and sensor stays."""
    before, state, *_ = applied(kept)
    x, P = state["error"], state["covariance"]
    fitted = [i for i in range(len(x)) if i not in OF_THE_MOTOR]
    off_diagonal = P - np.diag(np.diag(P))
    assert not off_diagonal[fitted].any() and not off_diagonal[:, fitted].any()
    same = OF_THE_MOTOR if kept else [OFFSET, FADE, HOUSING]
    np.testing.assert_array_equal(P[np.ix_(same, same)], before["covariance"][np.ix_(same, same)])
    np.testing.assert_array_equal(x[same], before["error"][same])
    assert not x[[FAST, NOISE, LOAD, COULOMB, VISCOUS, SLOW]].any()
    assert P[FAST, FAST] == 1.0 and P[LOAD, LOAD] == before["covariance"][LOAD, LOAD]
    assert state["contact"]["confirmed"] and not state["contact"]["lost"] and state["force"] == 900.0


def test_a_curve_that_did_not_change_leaves_what_driving_knew():
    """The stroke's contact angle is one more opinion, by its variance, of the filter and of a brake that drifts."""
    before, state, a, _ = applied(kept=True)
    known = before["covariance"][CONTACT, CONTACT]
    assert state["contact_angle"] == pytest.approx(8.0 + 0.02 * known / (known + a["contact_sigma"] ** 2))
    assert state["past_contact"] + state["contact_angle"] == pytest.approx(10.0)
    assert state["covariance"][CONTACT, CONTACT] == pytest.approx(1.0 / (1.0 / known + 1.0 / a["contact_sigma"] ** 2))
    assert state["scale"] == 1.1 and state["contact_anchor"] == 7.9
    drift, known = state["alternatives"][DRIFT], 2.0 * known
    own = before["contact_angle"] + before["error"][CONTACT]
    expected = own + known / (known + a["contact_sigma"] ** 2) * (a["contact_angle"] - own)
    assert state["contact_angle"] + drift["error"][CONTACT] == pytest.approx(expected)
    assert drift["covariance"][CONTACT, CONTACT] == pytest.approx(1.0 / (1.0 / known + 1.0 / a["contact_sigma"] ** 2))
    assert drift["covariance"][FAST, FAST] == 1.0 and not drift["error"][LOAD]


def _known_to(sigma, drift_sigma, jump_odds, drift_odds):
    """STATE and PARAMETERS of a filter that knows its contact angle to ``sigma`` rad, and with these odds to be wrong."""
    state, p = new_state()[0], np.zeros(1, PARAMETERS)[0]
    p["gear_gain"] = 4e-5
    state["covariance"][CONTACT, CONTACT] = sigma**2
    state["alternatives"]["log_odds"] = PRIOR_ODDS
    state["alternatives"]["log_odds"][STIFFNESS_JUMP] = jump_odds
    state["alternatives"]["log_odds"][DRIFT] = drift_odds
    state["alternatives"]["covariance"][DRIFT, CONTACT, CONTACT] = drift_sigma**2
    return state, p


@pytest.mark.parametrize(("jump_odds", "drift_odds"), [(PRIOR_ODDS, -2.0), (-3.0, -0.7), (2.0, -2.0)])
def test_a_stroke_that_contradicts_driving_is_believed_by_what_may_have_happened(jump_odds, drift_odds):
    """Of brakes of which as many have jumped, or drift, as the odds say, those whose stroke contradicts the filter have the
    errors that are stated of them, which are smaller than those of either alone."""
    rng, count, known, seen = np.random.default_rng(8), 200_000, 0.02, 0.1
    state, p = _known_to(known, 0.3, jump_odds, drift_odds)
    odds = np.exp([0.0, jump_odds, drift_odds])
    sigma = np.array([known, np.hypot(known, contact_jump(p)), 0.3])[rng.choice(3, count, p=odds / odds.sum())]
    truth = sigma * rng.standard_normal(count)
    moved = truth + seen * rng.standard_normal(count)
    apart = np.flatnonzero(np.abs(moved) > 2.0 * np.hypot(known, seen))[:20_000]
    combined = np.array([training._combine(state, p, moved[i], seen**2) for i in apart])
    error = combined[:, 0] - truth[apart]
    assert np.mean(error**2) == pytest.approx(np.mean(combined[:, 1]), rel=0.05)
    weighed = known**2 / (known**2 + seen**2) * moved[apart] - truth[apart]
    assert np.mean(error**2) < min(np.mean(weighed**2), np.mean((moved - truth)[apart] ** 2))


@pytest.mark.parametrize("moved", [-0.9, 0.25, 0.6])
def test_a_stroke_that_contradicts_driving_leaves_the_mean_and_the_variance_of_all_brakes_that_may_have_made_it(moved):
    """By Bayes' rule over every contact angle: that of a brake that is the filter's, that has jumped, or that drifts."""
    known, seen, odds, contact = 0.02, 0.1, np.exp([0.0, -3.0, -0.7]), np.linspace(-4.0, 4.0, 80_001)
    state, p = _known_to(known, 0.3, -3.0, -0.7)
    state["alternatives"]["error"][DRIFT, CONTACT] = 0.2
    mean, sigma = np.array([0.0, 0.0, 0.2]), np.array([known, np.hypot(known, contact_jump(p)), 0.3])
    prior = (odds / sigma * np.exp(-0.5 * ((contact[:, None] - mean) / sigma) ** 2)).sum(axis=1)
    weight = prior * np.exp(-0.5 * ((moved - contact) / seen) ** 2)
    weight /= weight.sum()
    shift = weight @ contact
    expected = (shift, weight @ (contact - shift) ** 2)
    assert training._combine(state, p, moved, seen**2) == pytest.approx(expected, rel=1e-4)


def test_what_spoke_for_a_jump_before_the_last_release_still_speaks_for_it():
    state, p = _known_to(0.02, 0.02, PRIOR_ODDS, -6.0)
    doubted, _ = training._combine(state, p, 0.3, 0.01)
    state["alternatives"]["log_odds"][KEPT_JUMP] = 8.0
    believed, left = training._combine(state, p, 0.3, 0.01)
    assert doubted < 0.1 and believed == pytest.approx(0.3, rel=0.02) and left == pytest.approx(0.01, rel=0.05)
    state["alternatives"]["kind"][KEPT_JUMP] = TORQUE_JUMP
    assert training._combine(state, p, 0.3, 0.01)[0] == doubted, "a jump of the torque moves no contact"


def test_a_stroke_that_agrees_with_driving_costs_it_nothing():
    state, p = _known_to(0.02, 0.3, PRIOR_ODDS, -2.0)
    shift, left = training._combine(state, p, 0.2, 0.01)
    assert (shift, left) == pytest.approx((0.2 * 4e-4 / 0.0104, 4e-4 * 0.01 / 0.0104))


def test_a_new_curve_is_known_as_the_stroke_knows_it():
    """Torque constant and inertia with it, beside what was known of the motor's heat; a brake that drifts begins anew."""
    before, state, _, learned = applied(kept=False)
    x, P = state["error"], state["covariance"]
    assert state["contact_angle"] == state["contact_anchor"] == 8.02 and P[CONTACT, CONTACT] == pytest.approx(9e-4)
    faded = x[GAIN] + x[FADE] * 0.3 + x[HOUSING] * 0.2
    assert (faded, x[INERTIA]) == pytest.approx((-0.04 - 0.3 * 0.3 + 0.1 * 0.2, 0.05))
    assert x[FADE] == before["error"][FADE] and x[HOUSING] == before["error"][HOUSING]
    assert (P[GAIN, GAIN], P[INERTIA, INERTIA]) == pytest.approx((1e-4, 4e-4))
    assert not np.delete(P[GAIN], GAIN).any() and not np.delete(P[:, INERTIA], INERTIA).any()
    assert P[SCALE, SCALE] == learned["stiffness_relative_sigma"] ** 2 and state["scale"] == 1.0
    assert state["alternatives"]["error"][DRIFT, LOAD] == 0.0


def test_pads_that_moved_by_more_than_they_settle_are_others_though_their_curve_is_the_same():
    _, state, a, _ = applied(kept=True, moved=5.0)
    assert state["contact_angle"] == a["contact_angle"] and state["scale"] == 1.0


@pytest.mark.parametrize(
    ("change", "fits"),
    [(0.42, True), (0.38, False), (1.58, True), (1.62, False)],
    ids=["less", "too little", "more", "too much"],
)
def test_friction_at_full_force_changes_by_no_more_than_its_limit(change, fits):
    """0.6 of what was calibrated, to either side; presliding as much, and a quarter more if the gear is softer; the clearance
    by as many radians to either side as its own limit says."""
    calibration = adaptkit.shipped()
    values = {key: value_of(calibration, key) for key in learned_keys(calibration)}
    friction = {key: change * values[key] for key in (LOAD_FRICTION, OFFSET_FRICTION)}
    why = why_out_of_bounds(calibration, values | friction)
    assert (why == "") == fits and (fits or why.startswith("friction at full force"))
    for change, fits in ((0.39, False), (0.41, True), (1.99, True), (2.01, False)):
        why = why_out_of_bounds(calibration, values | {PRESLIDING_ANGLE: change * values[PRESLIDING_ANGLE]})
        assert (why == "") == fits and (fits or why.startswith("presliding angle")), why
    for way in (-1.0, 1.0):
        for share in (0.99, 1.01):
            moved_rad = way * share * calibration.adaptation.clearance_change_rad
            why = why_out_of_bounds(calibration, values | {CLEARANCE: values[CLEARANCE] + moved_rad})
            assert (why == "") == (share < 1.0), why
