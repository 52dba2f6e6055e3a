"""From frames to frames: the same answer however the frames come in batches, and what is said when they do not come."""

import functools

import brake
import numpy as np
import pytest
import wirekit
from hypothesis import example, given
from hypothesis import strategies as st
from wirekit import MS

from emb_daemon.calibration.configuration import Setup
from emb_daemon.estimator.records import ESTIMATE
from emb_daemon.pipeline import Pipeline
from emb_daemon.resources import resource
from emb_daemon.wire import contract as r
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import FRAME


def _sliding(cycles, first=0, **options):
    """A clamp to 12 rad past contact, then to and fro, on a turning disc: the motor never rests."""
    rows = _motion()
    return wirekit.drive(
        cycles, first=first, angle=rows["angle"], speed=rows["speed"], current=rows["current_q"], wheel_speed=20.0, **options
    )


@functools.cache
def _motion():
    p = _parameters()[0]
    to = p["clearance"] + 12.0
    angle = np.concatenate([np.linspace(0.0, to, 100), to + 3.0 * np.sin(0.05 * np.arange(1, 10_000))])
    return brake.samples(p, angle)[0]


def _parameters():
    """PARAMETERS (4,) of the shipped configuration, without what an ideal brake does not have."""
    parameters = Setup(resource("config/emb.yaml")).parameters
    parameters["effects"] = np.zeros((), parameters["effects"].dtype)
    parameters["thermal"]["softening"] = parameters["thermal"]["softening_history"] = 0.0
    return parameters


@functools.cache
def _log(cycles=260):
    return wirekit.merged(*_sliding(cycles))


def _run(parameters, frames, corners=("FL",), begin_ns=0, end_ns=None, cuts=(), capacity=4096):
    """Estimates and broadcast frames of ``frames`` taken in batches that end at ``cuts``."""
    pipeline = Pipeline(parameters, corners, capacity=capacity)
    pipeline.begin(begin_ns)
    estimates, sent = [np.zeros(0, ESTIMATE)], [np.zeros(0, FRAME)]
    for batch in np.split(frames, sorted(cuts)):
        start = 0
        while start < len(batch):
            start, count = pipeline.consume(batch, start)
            estimates.append(pipeline.estimates[:count].copy())
            sent.append(pipeline.broadcast(count).copy())
    last_ns = int(frames["time_ns"][-1]) if len(frames) else begin_ns
    for now in range(last_ns + CYCLE_NS, (end_ns or 0) + 1, CYCLE_NS):
        count = pipeline.overdue(now)
        pipeline.answer(count)
        estimates.append(pipeline.estimates[:count].copy())
        sent.append(pipeline.broadcast(count).copy())
    return np.concatenate(estimates), np.concatenate(sent)


@pytest.fixture(scope="module")
def car():
    """Parameters of all corners; no test changes them."""
    return _parameters()


@pytest.fixture(scope="module")
def undisturbed(car):
    return _run(car, _log())


def test_every_sample_is_answered_once(undisturbed):
    estimates, _ = undisturbed
    assert len(estimates) == 260 and np.all(estimates["is_sample"])
    assert np.array_equal(estimates["cycle"], np.arange(260))
    assert np.array_equal(estimates["counter"], np.arange(260) % 15)
    assert np.all(estimates["time_ns"] == np.arange(260) * CYCLE_NS)


@example([0, 1, 2, 3, 4, 5], 32)
@given(st.lists(st.integers(0, 800), max_size=40), st.sampled_from([32, 100, 4096]))
def test_batches_do_not_matter(car, undisturbed, cuts, capacity):
    """Frames one by one or all at once, into small buffers or large: byte-equal estimates and broadcasts."""
    estimates, sent = _run(car, _log(), cuts=cuts, capacity=capacity)
    assert wirekit.same(estimates, undisturbed[0])
    assert wirekit.same(sent, undisturbed[1])


@given(st.integers(0, 2**32 - 1))
def test_jitter_of_arrival_does_not_reach_the_payloads(car, undisturbed, seed):
    """A sample up to 1 ms early or late, its current up to another after it: the same payloads in the same order."""
    frames = _log().copy()
    fast = np.isin(frames["can_id"], [0x100, 0x110])
    rng = np.random.default_rng(seed)
    frames["time_ns"][fast] += np.repeat(rng.integers(-MS, MS, fast.sum() // 2), 2)
    frames["time_ns"][frames["can_id"] == 0x110] += rng.integers(-MS // 2, MS, fast.sum() // 2)
    frames["time_ns"][~fast] -= 2 * MS
    _, sent = _run(car, wirekit.merged(frames), begin_ns=-5 * MS)
    assert np.array_equal(sent["can_id"], undisturbed[1]["can_id"])
    assert np.array_equal(sent["data"], undisturbed[1]["data"])


def test_broadcast_is_what_the_contract_says(undisturbed):
    """Ids, periods, counters and protection of an undisturbed run, decoded by other people's code."""
    estimates, sent = undisturbed
    by_name = {}
    for frame in sent:
        name, signals = wirekit.decode(frame)
        by_name.setdefault(name, []).append((int(frame["time_ns"]), signals))
    periods = {"EMB_FL_ClampForce": 1, "EMB_FL_PadTemp": 5, "EMB_FL_EstimatorStatus": 25, "EMB_FL_AdaptRequest": 5}
    assert by_name.keys() == periods.keys()
    for name, cycles in periods.items():
        times = [time for time, _ in by_name[name]]
        assert np.all(np.diff(times) == cycles * CYCLE_NS), name
        assert len(times) >= 260 // cycles - 1
        counters = [signals["Counter"] for _, signals in by_name[name]]
        assert np.all(np.diff(counters) % 15 == 1)
    last = by_name["EMB_FL_ClampForce"][-1][1]
    assert last["ClampForce"] == pytest.approx(1e-3 * estimates["force"][-1], abs=6e-4)
    assert last["ClampForceSigma"] == pytest.approx(1e-3 * estimates["sigma"][-1], abs=6e-4)
    assert (last["InputCounter"], last["ForceSource"], last["InputAge"], last["Status"]) == (259 % 15, 0, 0, 0)
    assert 5.0 < last["ClampForce"] < 15.0
    status = by_name["EMB_FL_EstimatorStatus"][-1][1]
    assert (status["Mode"], status["DegradedReasons"], status["Status"]) == (1, 0, 0)
    pads = by_name["EMB_FL_PadTemp"][-1][1]
    assert pads["Status"] == 0 and 20.0 < pads["OuterMeanTemp"] < 60.0


def test_four_corners_are_independent(car, undisturbed):
    """The same brake at all corners gives each the estimates of one alone; one that is silent disturbs none."""
    frames = wirekit.merged(*(frame for corner in ("FL", "FR", "RR") for frame in _sliding(150, corner=corner)
                              if corner == "FL" or frame["can_id"][0] not in (0x180, 0x181, 0x182)))  # fmt: skip
    frames = frames[frames["can_id"] != 0x180]
    estimates, sent = _run(car, frames, corners=("FL", "FR", "RL", "RR"))
    samples = estimates[estimates["is_sample"]]
    alone = samples[samples["corner"] == 0]
    for corner in (1, 3):
        assert np.array_equal(samples[samples["corner"] == corner]["force"], alone["force"])
    silent = estimates[estimates["corner"] == 2]
    assert len(silent) and np.all(silent["source"] == r.INVALID) and np.all(silent["mode"] == r.INIT)
    assert {int(i) for i in sent["can_id"]} == {i + k for i in (0x200, 0x210, 0x220, 0x230) for k in range(4)}


def test_before_the_first_sample_nothing_may_be_used(car):
    """Init, NotAvailable and invalid from the third cycle of silence on, then every cycle."""
    estimates, sent = _run(car, np.zeros(0, FRAME), end_ns=100 * CYCLE_NS)
    assert len(estimates) == 98 and np.all(estimates["mode"] == r.INIT) and np.all(estimates["source"] == r.INVALID)
    for frame in sent:
        name, signals = wirekit.decode(frame)
        assert signals["Status"] == 15, name
        if name == "EMB_FL_ClampForce":
            assert signals["ForceSource"] == 15 and signals["ClampForceSigma"] == pytest.approx(65.535)


def test_after_a_stall_of_the_loop_the_newest_prediction_goes_out_and_no_flood(car):
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    assert pipeline.overdue(2500 * CYCLE_NS) == 1
    assert pipeline.samples["age_cycles"][0] == 2500
    assert pipeline.overdue(2501 * CYCLE_NS) == 1


def test_after_a_tenth_of_a_second_of_silence_the_force_is_a_fault_until_the_next_sample(car):
    log = _log()
    end = int(log["time_ns"][-1]) + 60 * CYCLE_NS
    estimates, sent = _run(car, log, end_ns=end)
    silent = estimates[~estimates["is_sample"]]
    predicted = silent["age_cycles"] * 0.004 <= 0.1
    assert predicted.any() and not predicted.all()
    assert np.all(silent["source"] == np.where(predicted, r.PREDICTED, r.INVALID))
    assert np.all(silent["mode"] == np.where(predicted, r.DEGRADED, r.FAULT))
    assert np.all(silent["reasons"] & r.RESOLVER_LOST)
    _, signals = wirekit.decode(sent[sent["can_id"] == 0x200][-1])
    assert signals["Status"] == 2
    again = _sliding(5, first=int(estimates["cycle"][-1]) + 5)
    resumed, _ = _run(car, np.concatenate([log, *again]))
    assert resumed[-1]["source"] != r.INVALID and not resumed[-1]["reasons"] & r.RESOLVER_LOST


def test_sample_route_equals_frame_route(car, rig):
    """offline.load_log and estimate against the daemon's pipeline over the same log, bit for bit."""
    from emb_daemon.logs.read import read_frames
    from emb_daemon.offline import estimate, load_log

    path = rig / "static" / "sine_1p7Hz.log.gz"
    log = load_log(path)
    frames = read_frames(path)
    by_frames, _ = _run(car, frames, begin_ns=int(frames["time_ns"][0]), cuts=range(50, len(frames), 501))
    by_samples = estimate(log.samples, car[0])
    by_frames = by_frames[by_frames["is_sample"]]
    # Predictions count as announcements, which a log read without them does not have.
    by_samples["elapsed_cycles"] = by_frames["elapsed_cycles"]
    assert wirekit.same(by_frames, by_samples)


@pytest.mark.parametrize("gap", [1, 3, 14, 15, 16, 100, 250])
def test_after_a_gap_time_is_what_passed(car, gap):
    """Whatever the counter makes of the gap: the first sample after it is taken and its dt is the gap's."""
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    frames = np.concatenate(_sliding(30) + _sliding(5, first=30 + gap))
    _, count = pipeline.collect(frames, predictions=False)
    rows = pipeline.samples[:count]
    assert count == 35
    assert rows["dt"][30] == pytest.approx(0.004 * (gap + 1))
    assert np.allclose(rows["dt"][1:30], 0.004) and np.allclose(rows["dt"][31:], 0.004)
    assert rows["cycle"][-1] == 34 + gap


@pytest.mark.parametrize("skipped", range(15))
def test_after_a_silence_no_counter_says_that_less_has_passed(car, skipped):
    """Of a sender that begins anew it may be any. One that passed for a bus that was held up moved a contact by 30 rad."""
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    after = np.concatenate(_sliding(10, first=30 + skipped))
    after["time_ns"] += (60 - skipped) * CYCLE_NS
    frames = np.concatenate([*_sliding(30), after])
    _, count = pipeline.collect(frames, predictions=False)
    rows = pipeline.samples[:count]
    assert count == 40 and rows["dt"][30] == pytest.approx(0.004 * 61, abs=0.009)
    assert rows["dt"][30:].sum() == pytest.approx(0.004 * 70, abs=0.009)


@pytest.mark.parametrize(
    ("lost", "gap", "silent"), [((0x100, 0x110), 30, True), ((0x100, 0x110), 20, False), ((0x100,), 30, False)]
)
def test_a_controller_is_silent_if_nothing_comes_of_it_and_once(car, lost, gap, silent):
    """For over a tenth of a second, neither resolver nor current; the next samples are none after a silence."""
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    gone = range(30, 30 + gap)
    frames = [f for f in _sliding(80) if f["can_id"][0] not in lost or round(f["time_ns"][0] / CYCLE_NS) not in gone]
    _, count = pipeline.collect(np.concatenate(frames), predictions=False)
    was_silent = pipeline.samples["was_silent"][1:count]
    assert count == 80 - gap and was_silent[29] == silent and np.count_nonzero(was_silent) == silent


@pytest.mark.parametrize("held_ms", [20, 35, 45])
def test_delayed_frames_change_no_estimate(car, held_ms):
    """A burst after a hold-up: the counter says what passed, the clock does not, though it may be closer to another turn."""
    frames = _log()
    late = frames.copy()
    at = int(late["time_ns"][len(late) // 2])
    held = (late["time_ns"] > at) & (late["time_ns"] < at + held_ms * MS)
    late["time_ns"][held] = at + held_ms * MS + np.arange(held.sum()) * 1000
    plain, _ = _run(car, frames)
    held_up, _ = _run(car, late)
    answered = held_up[held_up["is_sample"]]
    assert np.array_equal(plain["counter"], answered["counter"])
    assert np.array_equal(plain["cycle"], answered["cycle"]) and np.array_equal(plain["force"], answered["force"])


def test_what_a_gateway_collects_and_sends_together_is_old(car):
    """Every 16 ms four samples come at once. Of each but the newest, force, InputAge and a reason say that it is late."""
    frames = wirekit.merged(*_sliding(800))
    together, later = frames.copy(), (frames["time_ns"] > 1200 * MS) & np.isin(frames["can_id"], [0x100, 0x110])
    together["time_ns"][later] = -(-together["time_ns"][later] // (16 * MS)) * 16 * MS
    together = wirekit.merged(together)
    plain, _ = _run(car, frames)
    estimates, sent = _run(car, together)
    estimates = estimates[estimates["is_sample"]]
    # Wheel and plates are heard in time, so that a late sample has newer ones.
    assert np.allclose(plain["force"], estimates["force"], atol=1.0) and not plain["late_ns"].any()
    settled = slice(400, None)
    late = estimates["late_ns"][settled]
    assert set(np.unique(late // MS)) == {0, 4, 8, 12}
    assert np.array_equal(estimates["reasons"][settled] & r.BUS_DISTURBED != 0, late > 8 * MS)
    # Two hundred newtons in a cycle: a force that is three of them old is known accordingly.
    moved = np.abs(plain["force"][settled][3:] - plain["force"][settled][:-3])
    oldest = late[:-3] == 12 * MS
    assert np.all(estimates["sigma"][settled][:-3][oldest] > 0.3 * moved[oldest])
    assert np.all(estimates["sigma"][settled][late > 4 * MS] > 2.0 * plain["sigma"][settled][late > 4 * MS])
    assert np.all(estimates["sigma"][settled][late == 0] < 1.2 * plain["sigma"][settled][late == 0])
    ages = [int(frame["data"]) >> 56 for frame in sent[sent["can_id"] == 0x200]][-100:]
    assert set(ages) == {0, 4, 8, 12, 16}, "and predictions between them"


def test_a_sample_within_half_a_cycle_is_punctual(car):
    """Frames jitter on any bus."""
    frames = wirekit.merged(*_sliding(600))
    odd = np.isin(frames["can_id"], [0x100, 0x110]) & (frames["time_ns"] // (4 * MS) % 2 == 1)
    frames["time_ns"][odd] += 1_900_000
    plain, shaken = _run(car, wirekit.merged(*_sliding(600)))[0], _run(car, wirekit.merged(frames))[0]
    assert not shaken["late_ns"].any() and np.array_equal(plain["sigma"], shaken["sigma"])


def test_the_pause_of_a_sender_is_made_up_for(car):
    """20 ms without a frame and a counter that goes on as if nothing were: the time is made up for one sample later."""
    frames = np.concatenate(_sliding(60))
    paused = frames["time_ns"] >= frames["time_ns"][len(frames) // 2]
    frames["time_ns"][paused] += 20_000_000
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    _, count = pipeline.collect(frames, predictions=False)
    assert pipeline.samples["cycle"][count - 1] == 59 + 5


@pytest.mark.parametrize("every", [5, 25, 250])
def test_logs_at_a_reduced_rate(car, every):
    """Frames every 20 ms, 100 ms and 1 s: all taken, each with the time since the last."""
    frames = np.concatenate([f for cycle in range(0, 40 * every, every) for f in _sliding(1, first=cycle)])
    pipeline = Pipeline(car, ("FL",))
    pipeline.begin(0)
    _, count = pipeline.collect(frames, predictions=False)
    pipeline.answer(count)
    assert count == 40
    assert np.allclose(pipeline.samples["dt"][1:40], 0.004 * every)
    assert np.all(np.isfinite(pipeline.estimates["force"][:40])) and np.all(pipeline.estimates["sigma"][:40] > 0.0)
