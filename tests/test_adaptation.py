"""What adaptation does beside the tick, without a brake: whose evaluation is taken, what of it is kept, and as whose."""

import os
import threading

import adaptkit
import msgspec
import numpy as np
import pytest

from emb_daemon.adapt import adaptation as module
from emb_daemon.adapt import records as r
from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.learned import Evaluation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.parameters import CLEARANCE, OFFSET_FRICTION, moved
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator import restart
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, new_state
from emb_daemon.wire import contract

SHIPPED = adaptkit.shipped()
LEARNED = np.ones(1, PARAMETERS)[0]
REACHED = new_state()[0]
REACHED["force"] = 5.0


@pytest.fixture
def adaptation(tmp_path):
    return Adaptation({"FL": SHIPPED}, Memory(tmp_path), int)


def test_an_evaluation_counts_for_the_training_that_asked_for_it_while_it_waits(adaptation):
    adapter = adaptation.adapters[0]
    adapter["generation"] = 3
    for phase, generation, taken in ((r.EVALUATING, 2, False), (r.IDLE, 3, False), (r.EVALUATING, 3, True)):
        adapter["phase"] = phase
        adaptation._take_evaluation(0, generation, Evaluation(r.ACCEPTED, contact_angle=7.0), LEARNED, REACHED)
        assert adapter["evaluation_ready"] == taken and (adaptation.learned[0] == LEARNED) == taken
        assert (adaptation.reached[0]["force"] == 5.0) == taken
    assert adapter["contact_angle"] == 7.0


def test_another_calibration_forgets_training_and_snapshot(adaptation):
    """Of neither anything comes back: an evaluation on its way is of an older generation."""
    adapter = adaptation.adapters[0]
    adapter["phase"], adapter["generation"] = r.EVALUATING, 3
    adaptation._resumable[0] = None, 0
    adaptation.replace("FL", SHIPPED, adaptation.read("FL", SHIPPED))
    assert adapter["phase"] == r.IDLE and adapter["generation"] == 4 and not adaptation._resumable


@pytest.mark.parametrize(
    ("outcome", "history", "in_use"),
    [(r.VEHICLE_MOVED, 0, False), (r.NOT_IN_TIME, 0, False), (r.NOT_CONVERGED, 1, False), (r.ACCEPTED, 1, True)],
)
def test_what_was_evaluated_is_kept_and_what_was_accepted_is_in_use(adaptation, tmp_path, outcome, history, in_use):
    values = adaptkit.accepted(adaptation._stores[0]).current.values
    adaptation._evaluations[0] = Evaluation(outcome, values=values)
    adaptation.adapters[0]["outcome"] = outcome
    adaptation._keep(0, adaptation.adapters[0])
    store = Memory(tmp_path).read("FL")
    assert (len(store.history) if store else 0) == history and (adaptation.current("FL") is not None) == in_use
    assert (adaptation.in_use("FL").friction.offset_Nm != SHIPPED.friction.offset_Nm) == in_use


@pytest.mark.parametrize("outcome", [r.ACCEPTED, r.NOT_CONVERGED])
@pytest.mark.parametrize("clearance, taken", [(7.0, True), (20.0, False)])
def test_an_accepted_evaluation_alone_puts_values_in_use(adaptation, monkeypatch, outcome, clearance, taken):
    """The clearance with them, where the motor started released: within the change that it may have."""
    values = {OFFSET_FRICTION: 2.0 * SHIPPED.friction.offset_Nm}
    monkeypatch.setattr(
        module, "fit_training", lambda *_: Evaluation(outcome, values=dict(values), contact_angle=1.5 + clearance)
    )
    calibration = moved(SHIPPED, {"contact.walk_rad_per_sqrt_s": 0.02})
    adaptation._evaluate(0, 5, np.zeros(1, r.TRAINING), SHIPPED, calibration, new_state()[0], 1.5, 0.0, None)
    corner, generation, evaluation, learned, _ = adaptation._done.get()
    expected = moved(SHIPPED, values | ({CLEARANCE: clearance} if taken else {})) if outcome == r.ACCEPTED else calibration
    assert (corner, generation) == (0, 5) and (CLEARANCE in evaluation.values) == taken
    assert learned == to_parameters(expected)


def test_a_snapshot_belongs_to_the_calibration_with_what_was_learned(adaptation, tmp_path):
    adaptation._stores[0] = adaptkit.accepted(adaptation._stores[0])
    state, parameters = new_state()[0], to_parameters(adaptation.in_use("FL"))
    state["started"] = True
    adaptation._keep_snapshot(0, state, parameters)
    text = adaptation._snapshots.path("FL").read_text()
    assert calibration_hash(adaptation.in_use("FL")) in text and calibration_hash(SHIPPED) not in text
    assert Adaptation({"FL": SHIPPED}, Memory(tmp_path), int)._resumable == {}, "what was learned was not written"


def test_what_is_handed_over_the_loop_no_longer_changes(adaptation):
    handed, adapter, state = [], adaptation.adapters[0], new_state()[0]
    adaptation._do = lambda job, *arguments: handed.append(arguments)
    adapter["evaluation_wanted"], state["force"] = True, 1.0
    # What effects remembered when the training began; since then they have gone on.
    adaptation._remembered[0]["second_relaxation"]["force"] = 3.0
    state["effects"]["second_relaxation"]["force"] = 4.0
    adaptation._attend(0, adapter, state, to_parameters(SHIPPED))
    state["force"] = 2.0
    [arguments] = handed
    assert arguments[5]["force"] == 1.0 and not adapter["evaluation_wanted"]
    assert arguments[5]["effects"]["second_relaxation"]["force"] == 3.0


def test_a_job_that_fails_ends_no_other(tmp_path, caplog):
    adaptation, done = Adaptation({"FL": SHIPPED}, Memory(tmp_path), int, threaded=True), threading.Event()
    adaptation._thread = threading.Thread(target=adaptation._work, daemon=True)
    adaptation._thread.start()
    adaptation._do(lambda: 1 / 0)
    adaptation._do(done.set)
    assert done.wait(20.0) and "ZeroDivisionError" in caplog.text
    adaptation._do(lambda: None)
    adaptation.close(new_state(4), np.zeros(4, PARAMETERS))
    assert not adaptation._thread.is_alive()


def test_the_end_keeps_a_snapshot_of_what_was_heard(adaptation):
    states = new_state(4)
    states["started"][0] = True
    parameters = np.zeros(4, PARAMETERS)
    adaptation.restore(parameters)
    adaptation.close(states, parameters)
    snapshot, _, warning = adaptation._snapshots.load("FL", SHIPPED)
    assert snapshot.dtype == restart.SNAPSHOT and warning is None
    # A daemon that hears nothing before it ends knows nothing better.
    kept = adaptation._snapshots.path("FL").read_bytes()
    adaptation.close(new_state(4), parameters)
    assert adaptation._snapshots.path("FL").read_bytes() == kept


def test_where_learning_is_switched_off_nothing_learned_is_used(tmp_path):
    store = adaptkit.accepted(Adaptation({"FL": SHIPPED}, Memory(tmp_path), int)._stores[0])
    off = adaptkit.shipped(adaptation=msgspec.structs.replace(SHIPPED.adaptation, enabled=False))
    adaptation = Adaptation({"FL": off}, Memory(tmp_path), int)
    adaptation._stores[0] = store
    assert adaptation.in_use("FL") == off and not adaptation.limits["enabled"][0]


def test_how_the_last_training_ended_is_said_once_one_has(adaptation):
    adaptation.adapters[0]["outcome"] = r.RESIDUAL
    assert adaptation.last_outcome("FL") == ""
    adaptation.adapters[0]["result"] = contract.RESULT_REJECTED
    assert adaptation.last_outcome("FL") == "residual too large"


def test_an_outcome_is_dated_by_the_real_time_of_its_sample(adaptation, tmp_path):
    adaptation._evaluations[0] = Evaluation(r.NOT_CONVERGED)
    adaptation.adapters[0]["outcome"], adaptation.adapters[0]["time_ns"] = r.NOT_CONVERGED, 1_700_000_000_400_000_000
    adaptation._keep(0, adaptation.adapters[0])
    assert Memory(tmp_path).read("FL").history[0].date == "2023-11-14T22:13:20+00:00"


@pytest.mark.parametrize(("kept_ns", "elapsed_s"), [(3 * 10**9, 4.0), (7 * 10**9, 0.0), (7 * 10**9 + 1, None)])
def test_a_snapshot_is_as_old_as_the_corners_first_sample_is_later(adaptation, monkeypatch, caplog, kept_ns, elapsed_s):
    """A prediction is no sample, nor is another corner's; one that is later than its reader is not used."""
    resumed = []
    monkeypatch.setattr(restart, "resume", lambda *arguments: resumed.append(arguments))
    adaptation._resumable[0] = "snapshot", kept_ns
    samples, states = np.zeros(4, SAMPLE), new_state(4)
    samples["corner"], samples["is_prediction"] = [1, 0, 0, 0], [False, True, False, False]
    samples["time_ns"] = [5 * 10**9, 6 * 10**9, 7 * 10**9, 8 * 10**9]
    parameters = np.zeros(4, PARAMETERS)
    adaptation._resume(samples[:2], states, parameters)
    assert not resumed and list(adaptation._resumable) == [0]
    adaptation._resume(samples, states, parameters)
    assert not adaptation._resumable and [(arguments[2], arguments[3]) for arguments in resumed] == (
        [("snapshot", elapsed_s)] if elapsed_s is not None else []
    )
    assert ("in the future" in caplog.text) == (elapsed_s is None)


def test_what_a_sample_asked_for_is_done_before_the_next(adaptation, monkeypatch):
    """Of a tick's samples, the second of which ends a training, and while an evaluation comes back."""
    begun, attended, taken = [], [], []

    def rows(_samples, first, count, *_):
        begun.append(first)
        adaptation.adapters[0]["ended"] = first == 0
        return 2 if first == 0 else count

    def attend(corner, adapter, *_):
        attended.append((corner, bool(adapter["ended"]), len(begun)))
        adapter["ended"] = False
        adaptation._done.put("evaluation")

    monkeypatch.setattr(module, "answer_adapting", rows)
    monkeypatch.setattr(adaptation, "_attend", attend)
    monkeypatch.setattr(adaptation, "_take_evaluation", lambda *arguments: taken.append((arguments, len(begun))))
    adaptation.answer(np.zeros(5, SAMPLE), 5, new_state(4), np.zeros(4, PARAMETERS), np.zeros(5, ESTIMATE))
    assert begun == [0, 2] and attended == [(0, True, 1)] and taken == [(tuple("evaluation"), 1)]


def test_a_helper_thread_is_started_where_one_is_wanted_and_is_no_real_time_thread(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "compile_fit", lambda *_: None)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *arguments: asked.append(arguments))
    monkeypatch.setattr(os, "setpriority", lambda *arguments: asked.append(arguments))
    parameters = np.zeros(4, PARAMETERS)
    for threaded in (False, True):
        adaptation = Adaptation({"FL": SHIPPED}, Memory(tmp_path), int, threaded=threaded)
        adaptation.warm_up(new_state(1)[0], to_parameters(SHIPPED))
        assert (adaptation._thread is not None) == threaded
    native = adaptation._thread.native_id
    adaptation.close(new_state(4), parameters)
    (process, policy, parameter), (which, thread, niceness) = asked
    assert (process, policy, parameter.sched_priority) == (0, os.SCHED_OTHER, 0)
    assert (which, thread) == (os.PRIO_PROCESS, native) and niceness >= 10
