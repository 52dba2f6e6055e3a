"""Frames cut, late, corrupted, repeated, out of range and foreign: which flag rises after how many ticks, what sigma does, and
that the first good frames bring everything back."""

import numpy as np
import pytest
import wirekit
from test_pipeline import _run, _sliding, car  # noqa: F401
from wirekit import MS

from emb_daemon.estimator.records import SAMPLE
from emb_daemon.offline.score import rmse
from emb_daemon.pipeline import Pipeline
from emb_daemon.wire import contract as r
from emb_daemon.wire.contract import CYCLE_NS

#: Cycles before the fault, in it, and after it; the last E2E error is shown for a second.
_BEFORE, _DURING, _AFTER = 150, 100, 300
#: Cycles of silence for which there is a prediction.
_PREDICTED_CYCLES = 25


def _fault(parameters, change, cycles=_BEFORE + _DURING + _AFTER, **options):
    """Estimates of a drive whose frames of the middle part went through ``change(frame, cycle)``, which gives a list."""
    frames = []
    for cycle in range(cycles):
        for frame in _sliding(1, first=cycle, **options):
            frames += change(frame, cycle) if _BEFORE <= cycle < _BEFORE + _DURING else [frame]
    frames = np.concatenate(frames)
    return _run(parameters, frames[np.argsort(frames["time_ns"], kind="stable")])


_ARGUMENTS = {"Counter": "counter", "Status": "status"}


def _again(frame, **changes):
    """The frame with some signals changed, protected anew."""
    name, signals = wirekit.decode(frame[0])
    del signals["CRC"]
    signals = {_ARGUMENTS.get(key, key): value for key, value in (signals | changes).items()}
    return wirekit.frame(name, int(frame["time_ns"][0]), **signals)


def _drop(*can_ids):
    return lambda frame, cycle: [] if frame["can_id"][0] in can_ids else [frame]


def _at(estimates, cycle, sample=None):
    found = estimates[estimates["cycle"] == cycle]
    if sample is not None:
        found = found[found["is_sample"] == sample]
    assert len(found), f"nothing was said in cycle {cycle}"
    return found[-1]


def _predicted(gone):
    """Which of the rows without a sample are predictions: those of the first tenth of a second, the rest is Invalid."""
    predicted = gone["age_cycles"] <= _PREDICTED_CYCLES
    assert np.array_equal(gone["source"], np.where(predicted, r.PREDICTED, r.INVALID))
    return predicted


def _raised(estimates, reason):
    """Cycles in which a reason was raised."""
    return estimates["cycle"][(estimates["reasons"] & reason) != 0]


@pytest.fixture(scope="module")
def good(car):  # noqa: F811
    return _fault(car, lambda frame, cycle: [frame])[0]


def test_an_undisturbed_drive_raises_nothing(good):
    assert not good["reasons"].any() and np.all(good["mode"] == r.RUNNING)


def test_resolver_cut(car, good):  # noqa: F811
    """Predicted from the third cycle of silence, Degraded; sigma grows with every cycle; a fault after a tenth of a second;
    the first sample back is an estimate again."""
    estimates, sent = _fault(car, _drop(0x100))
    silent = np.arange(_BEFORE + 2, _BEFORE + _DURING)
    gone = np.array([_at(estimates, cycle) for cycle in silent])
    predicted = _predicted(gone)
    assert predicted.any() and not predicted.all()
    assert np.array_equal(gone["mode"], np.where(predicted, r.DEGRADED, r.FAULT))
    assert np.array_equal(_raised(estimates, r.RESOLVER_LOST)[: len(silent)], silent)
    assert np.all(np.diff(gone["sigma"]) >= 0.0) and np.all(np.diff(gone["sigma"][:10]) > 0.0)
    assert gone["sigma"][0] > 3.0 * _at(estimates, _BEFORE - 1)["sigma"] and gone["sigma"][-1] > 10_000.0
    assert np.array_equal(gone["age_cycles"], silent - (_BEFORE - 1))
    back = _at(estimates, _BEFORE + _DURING, sample=True)
    assert back["source"] == r.FUSED or back["source"] == r.STIFFNESS_ONLY
    assert not back["reasons"] & r.RESOLVER_LOST
    assert abs(back["force"] - _at(good, _BEFORE + _DURING)["force"]) < 3.0 * back["sigma"]
    settled = _at(estimates, _BEFORE + _DURING + 20)
    assert settled["source"] == r.FUSED and settled["reasons"] == 0
    for frame in sent:
        name, signals = wirekit.decode(frame)
        cycle = int(frame["time_ns"]) // CYCLE_NS
        if name == "EMB_FL_ClampForce" and cycle in silent:
            known = cycle - _BEFORE + 1 <= _PREDICTED_CYCLES
            assert (signals["Status"], signals["ForceSource"]) == ((1, 3) if known else (2, 15))
            assert signals["InputAge"] == min(4 * (cycle - _BEFORE + 1), 255)


def test_a_motor_of_which_nothing_is_heard_goes_on_for_a_while(car, good):  # noqa: F811
    """Three to eight cycles after the last sample of a stroke the force is nearer to what it would be than to what it was."""
    cycles = np.arange(_BEFORE + 2, _BEFORE + 8)
    estimates, _ = _fault(car, _drop(0x100))
    predicted, expected = (np.array([_at(rows, cycle)["force"] for cycle in cycles]) for rows in (estimates, good))
    last = _at(good, _BEFORE - 1)["force"]
    assert rmse(last - expected) > 200.0
    assert rmse(predicted - expected) < 0.4 * rmse(last - expected)


def test_everything_cut_in_the_clearance_grows_uncertain_too(car):  # noqa: F811
    """Without force the local stiffness is zero, but the motor may be clamping unseen."""
    estimates, _ = _run(car, np.concatenate(wirekit.drive(50)), end_ns=74 * CYCLE_NS)
    last = estimates[-1]
    assert last["source"] == r.PREDICTED and last["force"] == 0.0 and last["sigma"] > 5_000.0


def test_current_cut(car, good):  # noqa: F811
    """Each sample is answered 2 ms after it came, without its current: flag after 3 cycles, StiffnessOnly after 13."""
    estimates, _ = _fault(car, _drop(0x110))
    samples = estimates[estimates["is_sample"]]
    assert len(samples) == len(good), "a sample was not answered"
    raised = _raised(samples, r.CURRENT_LOST)
    assert np.array_equal(raised, np.arange(_BEFORE + 3, _BEFORE + _DURING))
    sources = samples["source"]
    assert np.all(sources[_BEFORE : _BEFORE + 11] == r.FUSED)
    assert np.all(sources[_BEFORE + 13 : _BEFORE + _DURING] == r.STIFFNESS_ONLY)
    during = slice(_BEFORE + 13, _BEFORE + _DURING)
    assert np.all(samples["sigma"][during] > good["sigma"][during])
    assert samples["source"][_BEFORE + _DURING] == r.FUSED and not samples["reasons"][_BEFORE + _DURING]


def test_current_is_waited_for_two_milliseconds(car):  # noqa: F811
    """Time, not the next frame, ends the wait."""
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    frames = np.concatenate(_sliding(3))
    _, count = pipeline.collect(frames[:-1])
    assert count == 2
    assert pipeline.overdue(8 * MS + 2 * MS) == 0
    assert pipeline.overdue(8 * MS + 2 * MS + 1) == 1
    assert not pipeline.samples[0]["has_current"]


@pytest.mark.parametrize(
    ("can_id", "reason", "cycles"),
    [
        (0x120, r.THERMOCOUPLE_LOST, 63),
        (0x180, r.WHEEL_SPEED_LOST, 63),
        (0x181, r.WHEEL_PULSE_LOST, 63),
        (0x182, r.VEHICLE_STATUS_LOST, 625),
    ],
)
def test_slow_messages_cut(car, can_id, reason, cycles):  # noqa: F811
    """Reported after 25 of their periods; gone with their first frame. The force goes on being fused."""
    frames = [f for f in _sliding(1100) if f["can_id"][0] != can_id or not 100 <= round(f["time_ns"][0] / CYCLE_NS) < 1000]
    estimates, _ = _run(car, np.concatenate(frames))
    raised = _raised(estimates, reason)
    assert abs(raised[0] - (100 + cycles)) <= 25 and raised[-1] in range(995, 1001)
    assert np.all(np.diff(raised) == 1)
    assert np.all(estimates["source"][1:] == r.FUSED)
    assert estimates["reasons"][-1] == 0
    assert np.abs(np.diff(estimates["stiffness_factor"])).max() < 1e-3, "the stiffness jumped when an input was lost"


def test_a_slow_message_that_is_lost_counts_for_two_and_a_half_seconds(car):  # noqa: F811
    pipeline, slow = Pipeline(car, ("FL",), capacity=1024), {
        0x120: "has_thermocouple", 0x180: "has_wheel_speed", 0x181: "has_wheel_pulse", 0x182: "has_status"
    }  # fmt: skip
    frames = np.concatenate(_sliding(900))
    frames = frames[~np.isin(frames["can_id"], list(slow)) | (frames["time_ns"] < 100 * CYCLE_NS)]
    pipeline.begin(0)
    _, count = pipeline.consume(frames)
    for can_id, name in slow.items():
        heard_ns = frames["time_ns"][frames["can_id"] == can_id]
        first, last = np.flatnonzero(pipeline.samples[name][:count])[[0, -1]]
        assert np.all(pipeline.samples[name][first : last + 1])
        assert 0 < heard_ns[-1] + 2_500_000_000 - pipeline.estimates["time_ns"][last] <= CYCLE_NS, name


def test_corrupted(car, good):  # noqa: F811
    """A resolver frame with a flipped bit is as good as lost, and E2E error is raised in the next answer, for a second."""

    def flip(frame, cycle):
        if frame["can_id"][0] == 0x100:
            frame["data"] ^= np.uint64(1 << (cycle % 64))
        return [frame]

    estimates, _ = _fault(car, flip)
    assert _predicted(estimates[~estimates["is_sample"]]).any()
    raised = _raised(estimates, r.E2E_ERROR)
    assert raised[0] == _BEFORE + 2
    assert raised[-1] == _BEFORE + _DURING - 1 + 249
    assert not estimates["reasons"][-1]
    assert np.array_equal(estimates["force"][:_BEFORE], good["force"][:_BEFORE])


def test_one_corrupted_frame_costs_one_sample(car, good):  # noqa: F811
    def flip(frame, cycle):
        if frame["can_id"][0] == 0x100 and cycle == _BEFORE:
            frame["data"] ^= np.uint64(1 << 40)
        return [frame]

    estimates, _ = _fault(car, flip)
    assert np.all(estimates["is_sample"]) and _BEFORE not in estimates["cycle"] and len(estimates) == len(good) - 1
    after = _at(estimates, _BEFORE + 1)
    assert after["reasons"] == r.E2E_ERROR and after["source"] == r.FUSED and after["mode"] == r.DEGRADED
    assert after["force"] == pytest.approx(_at(good, _BEFORE + 1)["force"], abs=after["sigma"])


def test_repeated(car, good):  # noqa: F811
    """Every frame twice: the second changes nothing but the flag."""
    estimates, _ = _fault(car, lambda frame, cycle: [frame, frame])
    assert np.array_equal(estimates["force"], good["force"]) and np.array_equal(estimates["sigma"], good["sigma"])
    assert _raised(estimates, r.E2E_ERROR)[0] in (_BEFORE, _BEFORE + 1)


def test_frozen_sender(car):  # noqa: F811
    """The same resolver frame again and again is silence: Predicted after three cycles, a fault after 25."""
    stuck = wirekit.frame("EMB_FL_Resolver", 0, (_BEFORE - 1) % 15, MotorAngle=19.0)

    def freeze(frame, cycle):
        if frame["can_id"][0] == 0x100:
            same = stuck.copy()
            same["time_ns"] = frame["time_ns"]
            return [same]
        return [frame]

    estimates, _ = _fault(car, freeze)
    cycles = np.arange(_BEFORE + 2, _BEFORE + _DURING)
    assert np.array_equal(_raised(estimates, r.RESOLVER_LOST)[: len(cycles)], cycles)
    assert _predicted(np.array([_at(estimates, cycle) for cycle in cycles])).any()
    assert set(cycles) <= set(_raised(estimates, r.E2E_ERROR))


@pytest.mark.parametrize("late_ms", [1, 3, 6, 20])
def test_late(car, good, late_ms):  # noqa: F811
    """All frames late by as much: answered as late, with the same forces; silence is told of meanwhile, and what follows it is
    as after lost frames."""

    def delay(frame, cycle):
        frame["time_ns"] += late_ms * MS
        return [frame]

    estimates, _ = _fault(car, delay)
    samples = estimates[estimates["is_sample"]]
    assert bool(len(_raised(estimates, r.RESOLVER_LOST))) == (late_ms > 8)
    # Those that come when the first frames in time are there already have no turn any more.
    late = slice(_BEFORE + _DURING - 5)
    assert np.array_equal(samples["counter"][late], good["counter"][late])
    off = np.abs(samples["force"] - good["force"][: len(samples)])[late]
    if late_ms < 8:
        assert not off.any()
    assert np.all(off < samples["sigma"][late]) and np.all(off[_BEFORE + 25 :] < 0.2 * samples["sigma"][late][_BEFORE + 25 :])
    last = samples[-1]
    assert last["reasons"] == 0 and last["force"] == pytest.approx(good["force"][-1], abs=2.0 * last["sigma"])
    assert last["cycle"] == good["cycle"][-1]


def test_thermocouple_out_of_range(car, good):  # noqa: F811
    """Refused whole: Out of range at the next answer, for a second; the last good temperatures stand."""

    def broken(frame, cycle):
        if frame["can_id"][0] != 0x120:
            return [frame]
        counter = int(frame["data"][0]) >> 8 & 15
        return [wirekit.frame("EMB_FL_Thermocouple", int(frame["time_ns"][0]), counter, InnerBackplateTemp=3000.0)]

    estimates, _ = _fault(car, broken)
    raised = _raised(estimates, r.OUT_OF_RANGE)
    assert raised[0] in range(_BEFORE, _BEFORE + 3) and raised[-1] in range(_BEFORE + _DURING + 240, _BEFORE + _DURING + 255)
    assert not len(_raised(estimates, r.E2E_ERROR)) and not estimates["reasons"][-1]
    assert np.abs(estimates["mean"] - good["mean"]).max() < 1.0


def test_angle_that_no_motor_reaches(car, good):  # noqa: F811
    """One sample 200 rad off: Out of range in that tick and the next, in which the zero is where it was, and known as well."""

    def jump(frame, cycle):
        if frame["can_id"][0] == 0x100 and cycle == _BEFORE + 50:
            counter = cycle % 15
            return [wirekit.frame("EMB_FL_Resolver", int(frame["time_ns"][0]), counter, MotorAngle=219.5, MotorSpeed=0.0)]
        return [frame]

    estimates, _ = _fault(car, jump)
    cycle = _BEFORE + 50
    assert list(_raised(estimates, r.OUT_OF_RANGE)) == [cycle, cycle + 1]
    assert np.all(np.abs(estimates["force"] - good["force"])[cycle:] < 2.5 * estimates["sigma"][cycle:])
    assert estimates["sigma"][cycle] > 2.5 * good["sigma"][cycle]
    assert np.all(estimates["sigma"][cycle + 1 :] < 2.0 * good["sigma"][cycle + 1 :])


def test_resolver_that_lost_its_zero(car, good):  # noqa: F811
    """Multi-turn angle counted anew from zero: the contact angle follows, the force does not jump to release."""
    frames = _sliding(150) + [
        _again(f, MotorAngle=wirekit.decode(f[0])[1]["MotorAngle"] - 19.0) if f["can_id"][0] == 0x100 else f
        for f in _sliding(150, first=150)
    ]
    estimates, _ = _run(car, np.concatenate(frames))
    assert list(_raised(estimates, r.OUT_OF_RANGE)) == [150]
    assert np.all(np.abs(estimates["force"] - good["force"][:300])[150:] < 2.0 * estimates["sigma"][150:])
    assert estimates["contact_angle"][-1] == pytest.approx(estimates["contact_angle"][149] - 19.0, abs=2.0)


def test_speed_beyond_the_motor(car, good):  # noqa: F811
    def wild(frame, cycle):
        if frame["can_id"][0] == 0x100 and cycle == _BEFORE:
            angle = wirekit.decode(frame[0])[1]["MotorAngle"]
            return [wirekit.frame("EMB_FL_Resolver", int(frame["time_ns"][0]), cycle % 15, MotorAngle=angle, MotorSpeed=600.0)]
        return [frame]

    estimates, _ = _fault(car, wild)
    assert list(_raised(estimates, r.OUTSIDE_RANGE)) == [_BEFORE]


def test_foreign_frames_change_nothing(car, good):  # noqa: F811
    """Other ids, extended, remote, error and FD frames, other corners: no bit differs. Our own ids from others: reported."""
    rng = np.random.default_rng(9)

    def among(frame, cycle):
        others = [
            wirekit.record(int(frame["time_ns"][0]), int(can_id), rng.bytes(8))
            for can_id in (0x0, 0x7FF, 0x184, 0x700, 0x101, 0x112, 0x200, 0x230)
        ]
        for flags in (1, 2, 4, 8):
            other = frame.copy()
            other["flags"] = flags
            others.append(other)
        return [*others, frame]

    estimates, _ = _fault(car, among)
    shown = estimates["reasons"] == r.SECOND_SENDER
    assert shown[_BEFORE + 1] and not shown[:_BEFORE].any()
    for name in ("reasons", "mode"):
        estimates[name] = good[name]
    assert wirekit.same(estimates, good)


def test_sender_that_says_it_is_faulty_is_not_used(car):  # noqa: F811
    def faulty(frame, cycle):
        if frame["can_id"][0] != 0x100:
            return [frame]
        return [wirekit.frame("EMB_FL_Resolver", int(frame["time_ns"][0]), cycle % 15, 2, MotorAngle=19.0)]

    estimates, _ = _fault(car, faulty)
    assert _raised(estimates, r.RESOLVER_LOST)[0] == _raised(estimates, r.E2E_ERROR)[0] == _BEFORE + 2
    assert _at(estimates, _BEFORE + _DURING - 1)["source"] == r.INVALID
    assert _at(estimates, _BEFORE + _DURING, sample=True)["source"] in (r.FUSED, r.STIFFNESS_ONLY)


def test_a_current_whose_sender_says_it_is_degraded_is_not_relied_upon(car):  # noqa: F811
    """Half of what flows, by a sender that has its doubts: the stiffness goes on alone, and says why."""

    def degraded(frame, cycle):
        if frame["can_id"][0] != 0x110:
            return [frame]
        return [_again(frame, Status=1, CurrentQ=0.5 * wirekit.decode(frame[0])[1]["CurrentQ"])]

    estimates, _ = _fault(car, degraded)
    good, _ = _fault(car, lambda frame, cycle: [frame])
    during = estimates["cycle"] - _BEFORE
    doubted = (during >= 0) & (during < _DURING)
    assert np.all(estimates["reasons"][doubted] & r.E2E_ERROR) and np.all(np.isnan(estimates["torque_force"][doubted]))
    settled = (during >= 20) & (during < _DURING)
    assert np.all(estimates["source"][settled] == r.STIFFNESS_ONLY) and np.all(estimates["mode"][settled] == r.DEGRADED)
    assert np.all(np.abs(estimates["force"] - good["force"])[doubted] < 3.0 * estimates["sigma"][doubted])
    assert estimates["reasons"][-1] == 0 and estimates["source"][-1] == r.FUSED


@pytest.mark.parametrize(
    "message", ["EMB_FL_Resolver", "EMB_FL_Thermocouple", "VEH_WheelSpeed", "VEH_WheelPulse", "VEH_Status"]
)
def test_any_other_degraded_sender_is_told(car, message):  # noqa: F811
    """There is no other source of these: used, and said."""

    def degraded(frame, cycle):
        return [_again(frame, Status=1) if wirekit.decode(frame[0])[0] == message else frame]

    estimates, _ = _fault(car, degraded)
    doubted = (estimates["cycle"] >= _BEFORE + 25) & (estimates["cycle"] < _BEFORE + _DURING)
    assert np.all(estimates["reasons"][doubted] == r.E2E_ERROR) and np.all(estimates["source"][doubted] == r.FUSED)
    assert estimates["reasons"][-1] == 0


def test_restarted_controller(car):  # noqa: F811
    """Counters that begin anew cost one sample."""
    frames = _sliding(100) + [
        _again(f, Counter=(wirekit.decode(f[0])[1]["Counter"] + 7) % 15)
        for f in _sliding(60, first=100)
        if f["can_id"][0] in (0x100, 0x110)
    ]
    estimates, _ = _run(car, np.concatenate(frames))
    samples = estimates[estimates["is_sample"]]
    assert len(samples) == 159 and 100 not in samples["cycle"] and samples["cycle"][-1] == 159
    assert _raised(estimates, r.E2E_ERROR)[0] == 101
    assert samples["source"][-1] == r.FUSED


def _heated(parameters, change, seconds=150.0):
    """Times and estimates of a brake that drags for ``seconds``; ``change(rows, time)`` spoils the samples. Backing plates
    warm by 0.2 K/s with noise of 0.2 K."""
    from emb_daemon.offline import estimate

    time = np.arange(0.0, seconds, 0.004)
    rows = np.zeros(len(time), SAMPLE)
    rows["dt"] = np.where(time > 0.0, 0.004, 0.0)
    rows["angle"] = 17.5 * np.clip(time / 0.5, 0.0, 1.0)
    rows["speed"] = np.where(time < 0.5, 35.0, 0.0)
    rows["wheel_speed"], rows["ambient"], rows["caliper"], rows["brake_torque"] = 25.0, 22.0, 22.0, np.nan
    noise = np.repeat(np.random.default_rng(2).normal(0.0, 0.2, (len(time) // 25 + 1, 2)), 25, axis=0)[: len(time)]
    for number, name in enumerate(("inner_backplate", "outer_backplate")):
        rows[name] = 22.0 + 0.2 * time + noise[:, number]
    for name in ("has_thermocouple", "has_wheel_speed", "has_status"):
        rows[name] = True
    change(rows, time)
    return time, estimate(rows, parameters[:1])


def test_thermocouples_that_follow_raise_nothing(parameters):
    _, estimates = _heated(parameters, lambda rows, time: None)
    assert not np.any(estimates["reasons"] & (r.STUCK | r.TEMPERATURE_UNCERTAIN))
    assert estimates["mean"][-1].min() > 80.0, "the pads did heat up"


def test_stuck_thermocouple(parameters):
    """Repeats to the bit while the pad heats: Signal stuck and Pad temperature uncertain once heat must have come through,
    sigma up; a reading that moves again ends the first at once."""

    def stick(rows, time):
        held = (time >= 10.0) & (time < 120.0)
        rows["inner_backplate"][held] = rows["inner_backplate"][held][0]

    time, estimates = _heated(parameters, stick)
    _, good = _heated(parameters, lambda rows, time: None)
    stuck = (estimates["reasons"] & r.STUCK) != 0
    assert 15.0 < time[stuck][0] < 90.0 and stuck[(time > time[stuck][0]) & (time < 120.0)].all()
    assert not stuck[time > 121.0].any()
    assert np.all(estimates["reasons"][stuck] & r.TEMPERATURE_UNCERTAIN)
    assert np.all(estimates["sigma"][stuck] > good["sigma"][stuck])
    assert np.array_equal(estimates["source"], good["source"])
    error = np.abs(estimates["force"] - good["force"])
    assert np.all(error[stuck] < estimates["sigma"][stuck]), "an error of 20 K"


def test_jumping_thermocouple(parameters):
    """40 K from one reading to the next: Pad temperature uncertain in that heat step, sigma covers what the stiffness lost."""

    def jump(rows, time):
        rows["outer_backplate"][time >= 60.0] += 40.0

    time, estimates = _heated(parameters, jump, 100.0)
    _, good = _heated(parameters, lambda rows, time: None, 100.0)
    raised = time[(estimates["reasons"] & r.TEMPERATURE_UNCERTAIN) != 0]
    assert 60.0 <= raised[0] < 60.1
    after = time >= 60.1
    assert np.all(np.abs(estimates["force"] - good["force"])[after] < estimates["sigma"][after])
    assert np.all(estimates["sigma"][after] > good["sigma"][after])
