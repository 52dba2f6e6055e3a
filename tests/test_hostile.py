"""Frames that somebody else sends: no sample is lost, nothing foreign is believed, the forces stay the same to the bit."""

import itertools

import numpy as np
import pytest
import wirekit
from fuzz import promises
from test_pipeline import _log, _run, car  # noqa: F401
from wirekit import MS

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator import restart
from emb_daemon.estimator.records import new_state
from emb_daemon.logs.read import read_frames
from emb_daemon.wire import contract as r
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import default_layout
from emb_daemon.wire.receive import ACCEPTED, new_reception, receive
from studies import attacks

_CYCLES = 400


@pytest.fixture(scope="module")
def undisturbed(car):  # noqa: F811
    return _run(car, _log(_CYCLES))[0]


def _undisturbed_by(car, foreign, undisturbed, detected=r.E2E_ERROR):  # noqa: F811
    """Run with ``foreign`` among the frames; every sample's numbers must be the same to the bit. Returns the estimates."""
    estimates, _ = _run(car, wirekit.merged(_log(_CYCLES), *foreign))
    assert np.all(estimates["is_sample"]) and len(estimates) == len(undisturbed)
    for name in ("cycle", "counter", "force", "sigma", "stiffness_force", "torque_force", "contact_angle", "disc", "mean"):
        assert estimates[name].tobytes() == undisturbed[name].tobytes(), name
    assert bool(np.any(estimates["reasons"] & detected)) == bool(detected), "noticed"
    return estimates


def _spoof(cycle, delay_ns, counter, **signals):
    """A resolver frame with the right protection and a lie in it."""
    return wirekit.frame("EMB_FL_Resolver", cycle * CYCLE_NS + delay_ns, counter % 15, MotorAngle=99.0, **signals)


#: The schedule of a sender is known after half a second of its frames.
_KNOWN = range(135, 380)


@pytest.mark.parametrize("delay_ms", [0.3, 1.0, 1.9])
@pytest.mark.parametrize("ahead", [1, 2])
def test_spoofed_frames_with_the_next_counter_come_too_early(car, undisturbed, ahead, delay_ms):  # noqa: F811
    """Valid CRC, the counter that is expected next: refused, and the genuine frame after it is taken."""
    foreign = [_spoof(cycle, round(delay_ms * MS), cycle + ahead) for cycle in _KNOWN]
    _undisturbed_by(car, foreign, undisturbed)


@pytest.mark.parametrize("message", ["EMB_FL_Resolver", "EMB_FL_Current"])
@pytest.mark.parametrize("ahead_ms", [0.05, 1.0, 1.9])
def test_who_contradicts_a_sender_at_the_right_time_makes_the_force_a_fault(car, message, ahead_ms):  # noqa: F811
    """The forged frame comes first and is taken, the genuine one is refused: which is which nobody can tell, and that is
    said, until a second after the last."""
    signals = {"MotorAngle": 99.0} if "Resolver" in message else {"CurrentQ": 30.0}
    forged = [wirekit.frame(message, c * CYCLE_NS - round(ahead_ms * MS), c % 15, **signals) for c in range(150, 170)]
    estimates, sent = _run(car, wirekit.merged(_log(500), *forged))
    contested = (estimates["cycle"] > 151) & (estimates["cycle"] < 170 + 240)
    assert np.all(estimates["mode"][contested] == r.FAULT) and np.all(estimates["reasons"][contested] & r.E2E_ERROR)
    assert np.all(estimates["mode"][estimates["cycle"] > 170 + 255] != r.FAULT)
    forces = [wirekit.decode(frame)[1] for frame in sent if frame["can_id"] == 0x200]
    status = [frame["Status"] for frame, estimate in zip(forces, estimates, strict=True) if estimate["mode"] == r.FAULT]
    assert set(status) == {r.STATUS_FAULT} and np.all(estimates["mode"][:150] != r.FAULT)
    told = [wirekit.decode(frame)[1] for frame in sent if frame["can_id"] == 0x220]
    assert max(frame["DegradedReasons"] for frame in told) < 1 << 16 and {frame["Mode"] for frame in told} >= {r.FAULT}


@pytest.mark.parametrize("can_id", [0x120, 0x180, 0x181, 0x182])
def test_who_contradicts_any_other_input_makes_it_a_fault_too(car, can_id):  # noqa: F811
    """A forged vehicle status says that a clamped brake is released, of which a filter that starts anew would begin."""
    frames = _log(700)
    own = (frames["can_id"] == can_id) & (frames["time_ns"] > 150 * CYCLE_NS) & (frames["time_ns"] < 230 * CYCLE_NS)
    forged = frames[own].copy()
    forged["data"] ^= np.uint64(1 << 16)
    forged["time_ns"] -= MS
    attacks._protect_anew(forged)
    estimates, _ = _run(car, wirekit.merged(frames, forged))
    first, last = forged["time_ns"][[0, -1]]
    contested = (estimates["time_ns"] > first + 2 * CYCLE_NS) & (estimates["time_ns"] < last + 995 * MS)
    assert len(forged) >= 3 and np.all(estimates["mode"][contested] == r.FAULT)
    assert np.all(estimates["source"][contested] == r.INVALID)
    assert np.all(estimates["reasons"][contested] & r.E2E_ERROR)
    assert np.all(estimates["mode"][estimates["time_ns"] > last + 1015 * MS] != r.FAULT)


@pytest.mark.parametrize("learns", [False, True])
def test_what_was_learned_from_two_senders_is_forgotten(learns, tmp_path):
    """Samples of 3 s ago instead of the genuine ones teach the filter a contact that is not there. When they end, the brake
    is estimated as after a start."""

    def estimated(frames, folder):
        calibrations = {"FL": shipped_calibration()}
        return attacks.estimated(frames, Adaptation(calibrations, Memory(folder), int) if learns else None)

    for name in ("good", "bad"):
        (tmp_path / name).mkdir()
    frames = attacks.drive(48.0, 1)
    forged = attacks.played_back(frames, 3.0)
    good, bad = estimated(frames, tmp_path / "good"), estimated(wirekit.merged(frames, forged), tmp_path / "bad")
    after = bad[(bad["mode"] != r.FAULT) & (bad["time_ns"] > forged["time_ns"][-1])]
    off = np.abs(after["force"] - np.interp(after["time_ns"], good["time_ns"], good["force"]))
    assert len(after) > 1500 and np.all(off < 3.0 * after["sigma"])
    assert np.all(after["sigma"] < 300.0), "it is of use again at once"


def test_no_snapshot_is_taken_of_a_brake_with_two_senders():
    calibration = shipped_calibration()
    state, snapshot = new_state()[0], np.zeros(1, restart.SNAPSHOT)[0]
    state["started"] = True
    assert restart.take_snapshot(state, to_parameters(calibration), snapshot)
    state["contested"] = True
    assert not restart.take_snapshot(state, to_parameters(calibration), snapshot)


def test_a_frame_that_comes_twice_contradicts_nobody(car, undisturbed):  # noqa: F811
    """A gateway repeats what it hears: refused, and no doubt about the first."""
    again = _log(_CYCLES)
    again = again[np.isin(again["can_id"], [0x100, 0x110]) & (again["time_ns"] > _KNOWN.start * CYCLE_NS)].copy()
    again["time_ns"] += MS // 2
    estimates = _undisturbed_by(car, [again], undisturbed)
    assert np.all(estimates["mode"] != r.FAULT)


@pytest.mark.parametrize("jump", range(3, 15))
def test_counter_jumps(car, undisturbed, jump):  # noqa: F811
    _undisturbed_by(car, [_spoof(cycle, 3 * MS, cycle + jump) for cycle in _KNOWN], undisturbed)


@pytest.mark.parametrize("delay_ms", [0.2, 2.0, 3.7])
def test_second_sender_of_an_input(car, undisturbed, delay_ms):  # noqa: F811
    """Somebody who sends the same message in the same cycle with a counter of his own is never believed while the first is
    there, and is reported."""
    estimates = _undisturbed_by(car, [_spoof(c, round(delay_ms * MS), c + 7) for c in range(20, 380)], undisturbed)
    assert estimates["reasons"][30] & r.E2E_ERROR


def test_replayed_stretch(car, undisturbed):  # noqa: F811
    """Half a second of all fast messages, recorded and sent again a second later between the genuine ones."""
    frames = _log(_CYCLES)
    fast = frames[np.isin(frames["can_id"], [0x100, 0x110])]
    old = fast[(fast["time_ns"] >= 100 * CYCLE_NS) & (fast["time_ns"] < 220 * CYCLE_NS)].copy()
    for shift in (7, 11):
        again = old.copy()
        again["time_ns"] += (120 + shift) * CYCLE_NS + MS // 2
        _undisturbed_by(car, [again], undisturbed)


def test_flood_of_ten_thousand_frames_a_second(car, undisturbed):  # noqa: F811
    """Random payloads on our ids, right protection with every counter, and highest-priority nonsense."""
    rng = np.random.default_rng(3)
    times = np.arange(_KNOWN.start * CYCLE_NS, 380 * CYCLE_NS, 100_000)
    noise = np.zeros(len(times), FRAME)
    noise["time_ns"], noise["length"] = times + 50_000, 8
    noise["can_id"] = rng.choice([0x0, 0x100, 0x110, 0x120, 0x180, 0x181, 0x182, 0x7FF], len(times))
    noise["data"] = rng.integers(0, 2**64, len(times), dtype=np.uint64)
    _undisturbed_by(car, [noise], undisturbed)


def test_flood_with_valid_protection(car, undisturbed):  # noqa: F811
    """Every counter in turn, four within each cycle's first half: none comes when it may."""
    counters = itertools.count()
    foreign = [_spoof(c, delay, next(counters)) for c in _KNOWN for delay in (300_000, 700_000, 1_100_000, 1_500_000)]
    _undisturbed_by(car, foreign, undisturbed)


@pytest.mark.parametrize("promise", [promises.noise, promises.hostile])
@pytest.mark.parametrize("seed", [0, 1])
def test_promises_among_thousands_of_random_frames(promise, seed):
    """A short form of tests/fuzz/promises.py."""
    assert promise(np.random.default_rng(seed), 20.0, 5000) > 15_000


def test_second_sender_of_our_own_messages(car, undisturbed):  # noqa: F811
    foreign = [wirekit.frame("EMB_FL_ClampForce", cycle * CYCLE_NS + MS, cycle % 15) for cycle in _KNOWN]
    _undisturbed_by(car, foreign, undisturbed, r.SECOND_SENDER)


@pytest.mark.parametrize("first", [0, 200])
def test_a_sender_that_was_held_up_may_catch_up(first):
    """A bus that was busy for 60 ms delivers in a burst what waited: late is not early, all are taken."""
    receptions, frames = new_reception(), _log(_CYCLES)
    frames = frames[frames["can_id"] == 0x100]
    held = (frames["time_ns"] >= first * CYCLE_NS) & (frames["time_ns"] < (first + 15) * CYCLE_NS)
    frames["time_ns"][held] = (first + 15) * CYCLE_NS - MS
    verdicts = [receive(frame, receptions, default_layout()[0])[1] for frame in frames]
    assert np.all(np.array(verdicts) == ACCEPTED)


@pytest.mark.parametrize(("start", "late_ms", "frames"), [(30, 3.9, 120), (3000, 2.5, 900), (3000, 9.0, 900)])
def test_a_sender_that_was_late_for_long_may_be_on_time_again(start, late_ms, frames):
    """However the machine that plays or sends was held up: who comes back to his schedule is not early."""
    rng = np.random.default_rng(1)
    cycles = np.arange(5000)
    held_up = (cycles >= start) & (cycles < start + frames)
    delay_ms = rng.uniform(0.0, 0.3, 5000) + held_up * late_ms * rng.uniform(1.0, 1.5, 5000)
    times = np.maximum.accumulate(cycles * CYCLE_NS + (delay_ms * MS).astype(int))
    receptions, layout = new_reception(), default_layout()[0]
    sent = (wirekit.frame("EMB_FL_Resolver", int(time), cycle % 15) for cycle, time in enumerate(times))
    assert all(receive(frame[0], receptions, layout)[1] == ACCEPTED for frame in sent)


def test_a_sender_whose_clock_runs_slower_is_followed():
    """By 60 ppm for eighty seconds, more than a cycle: who comes half a cycle before it is early all the same."""
    receptions, layout = new_reception(), default_layout()[0]
    cycles = 20_000
    times = np.arange(cycles + 1) * (CYCLE_NS + 250)
    sent = (wirekit.frame("EMB_FL_Resolver", int(time), cycle % 15) for cycle, time in enumerate(times[:-1]))
    assert all(receive(frame[0], receptions, layout)[1] == ACCEPTED for frame in sent)
    early, genuine = (
        wirekit.frame("EMB_FL_Resolver", int(times[-1]) - ahead_ns, cycles % 15) for ahead_ns in (26 * MS // 10, 0)
    )
    assert [receive(frame[0], receptions, layout)[1] == ACCEPTED for frame in (early, genuine)] == [False, True]


def test_in_the_traffic_of_a_real_car(car, undisturbed, shared):  # noqa: F811
    """A minute's excerpt of a road car's bus, some of whose ids are ours, at its full rate around our frames: those on ids
    that we send are a second sender; none on ids that we receive passes the check."""
    road = read_frames(shared / "measured" / "road_can" / "rav4" / "rav4_60s.log.gz")
    road = road[(road["flags"] == 0)].copy()
    road["time_ns"] += -road["time_ns"][0] + 10 * MS
    span = road[road["time_ns"] < (_CYCLES - 5) * CYCLE_NS]
    assert len(span) > 2000
    _undisturbed_by(car, [span], undisturbed, r.SECOND_SENDER)


def test_road_traffic_moved_onto_our_ids(car, undisturbed, shared):  # noqa: F811
    """Real payloads under the ids of our inputs."""
    road = read_frames(shared / "measured" / "road_can" / "rav4" / "rav4_60s.log.gz")
    road = road[(road["flags"] == 0) & (road["length"] == 8)].copy()
    road["time_ns"] += -road["time_ns"][0] + 10 * MS
    span = road[road["time_ns"] < (_CYCLES - 5) * CYCLE_NS].copy()
    span["can_id"] = np.array([0x100, 0x110, 0x120, 0x180, 0x181, 0x182])[np.arange(len(span)) % 6]
    _undisturbed_by(car, [span], undisturbed)
