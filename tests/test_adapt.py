"""Park brake adaptation: what is learned, when it is not, and what is remembered."""

import itertools
import time

import adaptkit
import brake
import msgspec
import numpy as np
import pytest
from adaptkit import ClosedLoop, parked

from emb_daemon.adapt import records as r
from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.evidence import kills, specimen, wear
from emb_daemon.adapt.fit import fit_training
from emb_daemon.adapt.limits import to_limits
from emb_daemon.adapt.memory import Memory, apply_entry, decode, encode, state_directory, with_entry
from emb_daemon.adapt.pairs import FORCE, pairs_of_passes
from emb_daemon.calibration.types import to_parameters
from emb_daemon.cli.main import main
from emb_daemon.estimator.records import ADAPTING, INVALID, PARAMETERS, new_state
from emb_daemon.logs.read import read_frames
from emb_daemon.models.stiffness import characteristic_curve
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.scenarios import random_angle, rest, training
from emb_daemon.replay import Replay
from emb_daemon.wire.layout import load_database

RIG_CONTACT = 7.497
LEARNED_FIELDS = ("curve", "load_friction", "offset_friction", "presliding_angle", "stiffness_sigma",
                  "stiffness_relative_sigma", "clearance")  # fmt: skip


def same_parameters(one, other) -> bool:
    return one.tobytes() == other.tobytes()


# --- The simulated rig -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drives(rig, tmp_path_factory):
    """Training and then random motion of each pair of rig logs, with adaptation: Replay, training and random Result."""
    found = {}
    for name, thickness in (("5mm", 9.5), ("gear_new", 10.0), ("gear_worn_in", 10.0)):
        first, then = ("training_5mm", "random_5mm") if name == "5mm" else (f"{name}_training", f"{name}_random")
        replay = Replay(adaptkit.shipped(pad_thickness_mm=thickness), state=tmp_path_factory.mktemp(name))
        found[name] = replay, *(replay.run(rig / "static" / f"{log}.log.gz") for log in (first, then))
    return found


def rmse(result, column):
    return float(np.sqrt(np.nanmean((result.estimates[column] - result.force_N) ** 2)))


def test_pads_of_another_thickness_are_learned(drives):
    """Simulated rig: 5 mm pads, started from the calibration of 9.5 mm ones. The thesis reached 0.35 kN."""
    _, _, judged = drives["5mm"]
    assert rmse(judged, "stiffness_force") < 200.0
    assert rmse(judged, "force") < 180.0
    error = np.abs(judged.estimates["force"] - judged.force_N)
    inside = np.mean(error < 2.0 * np.hypot(judged.estimates["sigma"], 25.0))
    assert inside > 0.9


@pytest.mark.parametrize("gear", ["gear_new", "gear_worn_in"])
def test_friction_of_the_gear_is_learned(rig, drives, gear):
    """Simulated rig; the calibration is the new gear's, so that wear-in is what there is to learn."""
    _, _, after = drives[gear]
    before = Replay(adaptkit.shipped(pad_thickness_mm=10.0)).run(rig / "static" / f"{gear}_random.log.gz")
    print(f"{gear}: torque balance before {rmse(before, 'torque_force'):.0f} N, adapted {rmse(after, 'torque_force'):.0f} N")
    assert rmse(after, "torque_force") < 550.0
    assert rmse(after, "force") < 100.0
    if gear == "gear_worn_in":
        assert rmse(after, "torque_force") < 0.85 * rmse(before, "torque_force")


@pytest.mark.parametrize("name", ["5mm", "gear_new", "gear_worn_in"])
def test_contact_angle_is_learned(drives, name):
    _, trained, _ = drives[name]
    rows, estimates = trained.samples, trained.estimates
    error = estimates["contact_angle"][-1] - rows["angle"][0] - RIG_CONTACT
    assert abs(error) < 0.6
    entry = drives[name][0].adaptation.current("FL")
    assert abs(error) < 3.0 * entry.contact_sigma_rad
    assert entry.clearance_rad == pytest.approx(RIG_CONTACT, abs=0.6)


def test_the_estimate_goes_on_during_training(drives):
    _, trained, _ = drives["5mm"]
    estimates = trained.estimates
    assert np.any(estimates["mode"] == ADAPTING)
    assert not np.any(estimates["source"] == INVALID)
    assert np.all(np.isfinite(estimates["force"])) and np.all(np.isfinite(estimates["sigma"]))
    assert np.any(estimates["adapt_result"] == r.RESULT_ACCEPTED)
    # Motion came unasked: nothing was asked for.
    assert not estimates["adapt_request"].any()


def test_replay_gives_the_same_bytes_again(rig, tmp_path):
    log = rig / "static" / "gear_new_training.log.gz"
    sent, files = [], []
    for name in ("one", "two"):
        replay = Replay(adaptkit.shipped(pad_thickness_mm=9.5), state=tmp_path / name)
        sent.append(np.concatenate(list(replay.frames(log))))
        files.append((tmp_path / name / "adaptation-FL.json").read_bytes())
    assert np.array_equal(sent[0], sent[1])
    assert files[0] == files[1]


def test_the_helper_thread_changes_no_byte(rig, tmp_path):
    """The daemon's way, evaluation in another thread, in batches of another size, against replay's."""
    frames = read_frames(rig / "static" / "gear_new_training.log.gz")
    calibration = adaptkit.shipped(pad_thickness_mm=9.5)
    expected = np.concatenate(
        list(Replay(calibration, state=tmp_path / "replay").frames(rig / "static" / "gear_new_training.log.gz"))
    )
    parameters = np.zeros(4, PARAMETERS)
    parameters[0] = to_parameters(calibration)
    learner = Adaptation({"FL": calibration}, Memory(tmp_path / "thread"), str, threaded=True)
    pipeline = Pipeline(parameters, ("FL",), capacity=64, adaptation=learner)
    pipeline.begin(int(frames["time_ns"][0]))
    learner.warm_up(Pipeline(parameters.copy(), ("FL",), capacity=64))
    sent, start = [], 0
    while start < len(frames):
        start, count = pipeline.consume(frames, start)
        sent.append(pipeline.broadcast(count).copy())
        adapter = learner.adapters[0]
        if adapter["phase"] == r.EVALUATING and adapter["rows"] > adapter["training_rows"] + 500:
            # In the car two seconds have passed by now.
            patience = time.monotonic() + 60.0
            while not adapter["ready"] and learner._done.empty() and time.monotonic() < patience:
                time.sleep(0.01)
    learner.close()
    assert np.array_equal(np.concatenate(sent), expected)
    assert learner.current("FL") is not None
    assert Memory(tmp_path / "thread").read("FL").current is not None


# --- The simulated car answers the request -----------------------------------------------------------------------------


@pytest.mark.parametrize("held_N", [0.0, 12_000.0])
def test_a_request_is_answered_and_accepted(tmp_path, held_N):
    """Worn pads; parked released, and parked while the motor holds the brake clamped."""
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    before = loop.parameters[0].copy()
    estimates, truth = loop.run(parked(60.0, held_N), until=lambda e: e["adapt_result"] != r.NO_RESULT)
    assert estimates["adapt_result"][-1] == r.RESULT_ACCEPTED
    asked = np.flatnonzero(estimates["adapt_request"] == 1)
    assert 5.0 < 0.004 * asked[0] < 12.0
    assert truth["training"].any() and not truth["training"][-1]
    assert np.all(np.diff(estimates["adapt_progress"][asked]) >= -40)
    assert np.all(np.isfinite(estimates["force"])) and not np.any(estimates["source"] == INVALID)
    assert np.all(estimates["mode"][asked] == ADAPTING)
    assert not same_parameters(before, loop.parameters[0])
    estimates, truth = loop.run(random_angle(loop.car.plants[0], 6.0, np.random.default_rng(1)))
    error = estimates["force"] - truth["force"]
    assert np.sqrt(np.mean(error**2)) < 100.0
    assert np.mean(np.abs(error) < 2.0 * estimates["sigma"]) > 0.9


def test_the_request_says_what_it_wants(tmp_path):
    loop = ClosedLoop(tmp_path)
    loop.run(parked(8.0), until=lambda e: e["adapt_request"] == 1 and e["cycle"] % 5 == 0)
    frames = loop.pipeline.broadcast(1)
    database = load_database(adaptkit.ROOT / "dbc" / "emb.dbc")
    message = database.get_message_by_name("EMB_FL_AdaptRequest")
    payloads = [int(frame["data"]).to_bytes(8, "little") for frame in frames if frame["can_id"] == message.frame_id]
    values = message.decode(payloads[0], decode_choices=False)
    limits = loop.calibration.adaptation
    assert values["Request"] == 1 and values["Result"] == 0
    assert values["HighForce"] == pytest.approx(1e-3 * loop.calibration.training_force_N, abs=0.25)
    assert values["DitherAmplitude"] == pytest.approx(limits.dither_amplitude_rad, abs=0.02)
    assert values["DitherFrequency"] == pytest.approx(limits.dither_frequency_Hz, abs=0.1)


def test_a_continued_force_has_no_step_when_learned_values_take_effect(tmp_path):
    loop = ClosedLoop(tmp_path)
    estimates, _ = loop.run(parked(60.0, 12_000.0), until=lambda e: e["adapt_result"] != r.NO_RESULT)
    more, truth = loop.run(parked(1.0, 12_000.0))
    steps = np.abs(np.diff(np.concatenate([estimates["force"][-5:], more["force"][:5]])))
    assert steps.max() < 400.0
    assert np.abs(more["force"][:200] - truth["force"][:200]).max() < 300.0


ABORTS = {
    "brake request": (lambda drives: drives.__setitem__("brake_request", 1), r.BRAKE_REQUESTED),
    "park brake release": (lambda drives: drives.__setitem__("park_brake", 0), r.PARK_BRAKE_LEFT),
    "vehicle motion": (lambda drives: drives.__setitem__("wheel_speed", 3.0), r.VEHICLE_MOVED),
}


@pytest.mark.parametrize("phase", [r.ASKING, r.EVALUATING])
@pytest.mark.parametrize("name", ABORTS)
def test_training_ends_at_once_and_changes_nothing(tmp_path, name, phase):
    change, verdict = ABORTS[name]
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    adapter = loop.adaptation.adapters[0]
    before = loop.parameters[0].copy()
    loop.run(parked(60.0), until=lambda e: adapter["phase"] == phase and adapter["rows"] > 1000)
    disturbed = parked(3.0)
    disturbed.drives["park_brake"] = 1
    change(disturbed.drives)
    estimates, _ = loop.run(disturbed)
    first = np.flatnonzero(estimates["adapt_result"] == r.RESULT_ABORTED)[0]
    # The vehicle's status comes ten times a second, wheel speeds a hundred times.
    assert 0.004 * first < 0.11
    assert not estimates["adapt_request"][first:].any()
    assert adapter["verdict"] == verdict
    assert same_parameters(before, loop.parameters[0])
    assert Memory(tmp_path).read("FL") is None
    assert np.all(np.isfinite(estimates["force"])) and not np.any(estimates["source"] == INVALID)


def test_short_gaps_do_not_end_training(tmp_path):
    """A machine that is held up for up to 80 ms twice a second costs samples, not the training."""
    loop = ClosedLoop(tmp_path)
    cycle = itertools.count()

    def held_up(frames):
        phase = next(cycle)
        return frames[:0] if phase % 125 < phase // 125 % 20 else frames

    loop.run(parked(60.0), until=lambda e: e["adapt_result"] != r.NO_RESULT, spoil=held_up)
    assert loop.adaptation.adapters[0]["verdict"] == r.ACCEPTED
    estimates, truth = loop.run(random_angle(loop.car.plants[0], 6.0, np.random.default_rng(1)))
    assert np.sqrt(np.mean((estimates["force"] - truth["force"]) ** 2)) < 100.0


def test_bad_input_ends_training(tmp_path):
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    adapter = loop.adaptation.adapters[0]
    before = loop.parameters[0].copy()
    loop.run(parked(60.0), until=lambda e: adapter["phase"] == r.ASKING and adapter["rows"] > 1000)

    def broken(frames):
        frames = frames.copy()
        frames["data"][frames["can_id"] == 0x110] ^= np.uint64(1 << 20)
        return frames

    estimates, _ = loop.run(parked(0.1), spoil=broken)
    assert adapter["verdict"] == r.BAD_INPUT
    assert estimates["adapt_result"][-1] == r.RESULT_ABORTED
    assert same_parameters(before, loop.parameters[0])


def test_silence_ends_training(tmp_path):
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    adapter = loop.adaptation.adapters[0]
    loop.run(parked(60.0), until=lambda e: adapter["phase"] == r.ASKING and adapter["rows"] > 1000)
    count = loop.pipeline.overdue(int(adapter["time_ns"]) + 120_000_000)
    loop.pipeline.answer(count)
    assert count > 0 and adapter["verdict"] == r.BAD_INPUT and adapter["phase"] == r.IDLE


def test_a_controller_that_does_not_answer_is_not_pestered(tmp_path):
    loop = ClosedLoop(tmp_path)
    loop.car.hear = lambda frames: None
    estimates, _ = loop.run(parked(40.0))
    asked = estimates["adapt_request"] == 1
    assert 0.004 * asked.sum() == pytest.approx(loop.calibration.adaptation.answer_time_s, abs=0.1)
    assert np.flatnonzero(asked)[-1] - np.flatnonzero(asked)[0] + 1 == asked.sum()
    assert loop.adaptation.adapters[0]["verdict"] == r.NO_ANSWER
    # At the next application of the park brake it may ask again.
    estimates, _ = loop.run(rest(1.0) + parked(8.0))
    assert estimates["adapt_request"].any()


def test_training_that_never_ends_is_ended(tmp_path):
    """The motion dithers at half force for ever."""
    loop = ClosedLoop(tmp_path)
    schedule = parked(90.0)
    time_s = 0.004 * np.arange(len(schedule))
    schedule.commands["mode"] = 1
    schedule.commands["target"] = np.where(time_s > 8.0, 12.0 + np.sin(6.0 * time_s), 0.0)
    loop.car.hear = lambda frames: None
    before = loop.parameters[0].copy()
    loop.run(schedule, until=lambda e: e["adapt_result"] != r.NO_RESULT)
    assert loop.adaptation.adapters[0]["verdict"] == r.TOO_LONG
    assert same_parameters(before, loop.parameters[0])


def test_an_evaluation_that_is_late_is_dropped(tmp_path):
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    loop.adaptation._do = lambda job, *arguments: None
    before = loop.parameters[0].copy()
    loop.run(parked(60.0), until=lambda e: e["adapt_result"] != r.NO_RESULT)
    assert loop.adaptation.adapters[0]["verdict"] == r.NOT_IN_TIME
    assert same_parameters(before, loop.parameters[0])


def test_nothing_is_asked_for_with_hot_pads_or_in_great_cold(tmp_path):
    for ambient in (22.0, -20.0):
        loop = ClosedLoop(tmp_path)
        if ambient > 0.0:
            for field in ("pads", "surface", "plate", "plate_reading", "disc", "caliper"):
                loop.car.states[field] = 120.0
        schedule = parked(12.0)
        schedule.drives["ambient"] = ambient
        estimates, _ = loop.run(schedule)
        assert not estimates["adapt_request"].any()


def test_wear_over_a_thousand_park_cycles():
    """Simulated car; `python -m emb_daemon.adapt.evidence wear` does it with more trainings, and the picture."""
    result = wear(adaptkit.shipped(pad_thickness_mm=10.0), trainings=3)
    last = result["rows"][-1]
    assert last["without"]["rmse_N"] > 1000.0
    for row in result["rows"]:
        assert row["verdict"] == "accepted"
        assert row["with"]["rmse_N"] < 100.0
        assert row["with"]["inside_two_sigma"] > 0.9


# --- The fit -----------------------------------------------------------------------------------------------------------


def trained_rows(p, seed=1, high_rad=20.0, factor=1.0, noise=True, seconds=20.0):
    """TRAINING rows of an ideal brake with PARAMETERS ``p``: slow clamp and release with a sinusoid on top."""
    t = 0.004 * np.arange(round(seconds / 0.004))
    middle, swing = p["clearance"] - 2.0, high_rad + 2.0
    angle = middle + swing * 0.5 * (1.0 - np.cos(2.0 * np.pi * t / seconds)) + 0.9 * np.sin(10.0 * np.pi * t)
    softer = p.copy()
    softer["curve"] = factor * p["curve"]
    samples, _ = brake.samples(softer, angle)
    rng = np.random.default_rng(seed)
    rows = np.zeros(len(samples), r.TRAINING)
    for name in r.TRAINING.names:
        if name in samples.dtype.names:
            rows[name] = samples[name]
    rows["factor"] = factor
    if noise:
        rho, coloured = np.exp(-0.004 / p["current_correlation_time"]), np.zeros(len(rows))
        white = rng.normal(size=len(rows))
        for i in range(1, len(rows)):
            coloured[i] = rho * coloured[i - 1] + np.sqrt(1.0 - rho * rho) * white[i]
        rows["current_q"] += p["current_sigma"] * coloured
        rows["speed"] += p["speed_sigma"] * rng.normal(size=len(rows))
    return rows


def fit(rows, p, calibration=None):
    return fit_training(rows, p, new_state(1)[0], to_limits(calibration or adaptkit.shipped()))


@pytest.fixture
def ideal(parameters):
    p = parameters[0].copy()
    p["effects"] = np.zeros((), p["effects"].dtype)
    return p


def believed(p):
    """What the daemon thinks of a brake ``p``: softer pads, more friction."""
    other = p.copy()
    other["curve"] = 0.8 * p["curve"]
    other["load_friction"], other["offset_friction"] = 1.2 * p["load_friction"], 1.2 * p["offset_friction"]
    return other


def force_error(learned, p, travel):
    """Learned minus true force at angles ``travel`` past the true contact, N."""
    shift = p["clearance"] - learned["contact_angle"]
    return np.array(
        [characteristic_curve(x + shift, learned["curve"])[0] - characteristic_curve(x, p["curve"])[0] for x in travel]
    )


def test_without_noise_the_fit_finds_the_brake(ideal):
    learned = fit(trained_rows(ideal, noise=False), believed(ideal))
    assert learned["contact_angle"] == pytest.approx(ideal["clearance"], abs=0.02)
    assert learned["load_friction"] == pytest.approx(ideal["load_friction"], rel=0.01)
    assert learned["offset_friction"] == pytest.approx(ideal["offset_friction"], rel=0.01)
    assert np.abs(force_error(learned, ideal, np.linspace(1.0, 20.0, 20))).max() < 20.0


def test_sigma_of_the_learned_force_is_honest(ideal):
    errors, contacts = [], []
    for seed in range(5):
        learned = fit(trained_rows(ideal, seed), believed(ideal))
        assert learned["verdict"] == r.ACCEPTED
        travel = np.linspace(1.0, 20.0, 8)
        force = np.array([characteristic_curve(x, ideal["curve"])[0] for x in travel])
        sigma = np.hypot(learned["stiffness_sigma"], learned["stiffness_relative_sigma"] * force)
        errors.append(force_error(learned, ideal, travel) / sigma)
        contacts.append((learned["contact_angle"] - ideal["clearance"]) / learned["contact_sigma"])
    assert np.mean(np.abs(errors) < 2.0) > 0.9
    assert 0.4 < np.std(contacts) < 1.7


def test_softened_pads_are_reduced_to_the_cold_curve(ideal):
    learned = fit(trained_rows(ideal, factor=0.95), believed(ideal))
    assert np.abs(force_error(learned, ideal, np.linspace(1.0, 20.0, 20))).max() < 4.0 * learned["force_sigma"]


def test_outliers_do_not_move_the_fit(ideal):
    rows = trained_rows(ideal)
    clean = fit(rows.copy(), believed(ideal))
    rng = np.random.default_rng(5)
    rows["current_q"][rng.choice(len(rows), 25)] += 30.0
    spoilt = fit(rows, believed(ideal))
    assert spoilt["verdict"] == r.ACCEPTED
    travel = np.linspace(1.0, 20.0, 20)
    assert np.abs(force_error(spoilt, ideal, travel) - force_error(clean, ideal, travel)).max() < 60.0


def test_pairs_of_passes_need_no_friction_model(ideal):
    """Thesis 2-7: the force is there although friction in the parameters is wrong by half."""
    rows = trained_rows(ideal, noise=False)
    wrong = ideal.copy()
    wrong["load_friction"], wrong["offset_friction"] = 0.5 * ideal["load_friction"], 0.5 * ideal["offset_friction"]
    pairs = pairs_of_passes(rows, wrong)
    true = np.array([characteristic_curve(angle - ideal["clearance"], ideal["curve"])[0] for angle in pairs[:, 0]])
    assert len(pairs) > 50
    assert np.sqrt(np.mean((pairs[:, FORCE] - true) ** 2)) < 0.05 * true.max()


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({"high_rad": 9.0}, r.NOT_COVERED),
        ({"seconds": 3.0}, r.TOO_FEW),
    ],
)
def test_poor_training_is_rejected(ideal, change, verdict):
    assert fit(trained_rows(ideal, **change), believed(ideal))["verdict"] == verdict


def test_implausible_outcomes_are_rejected(ideal):
    rows = trained_rows(ideal)
    limits = adaptkit.shipped().adaptation
    tight = adaptkit.shipped(adaptation=msgspec.structs.replace(limits, curve_change=0.02))
    assert fit(rows, believed(ideal), tight)["verdict"] == r.CHANGED_TOO_MUCH
    certain = adaptkit.shipped(adaptation=msgspec.structs.replace(limits, maximum_sigma_N=1.0))
    assert fit(rows, believed(ideal), certain)["verdict"] == r.TOO_UNCERTAIN
    slippery = adaptkit.shipped(adaptation=msgspec.structs.replace(limits, maximum_friction_share=0.1))
    assert fit(rows, believed(ideal), slippery)["verdict"] == r.NOT_PHYSICAL
    noisy = rows.copy()
    noisy["current_q"] += np.random.default_rng(2).normal(size=len(rows)) * 2.0
    assert fit(noisy, believed(ideal))["verdict"] == r.RESIDUAL
    one_way = rows[: len(rows) // 2]
    one_way = one_way[one_way["angle"] >= np.maximum.accumulate(one_way["angle"])].copy()
    assert fit(np.repeat(one_way, 4), believed(ideal))["verdict"] == r.NOT_EXCITED
    bent = rows.copy()
    bent["current_q"] = rows["current_q"][::-1]
    assert fit(bent, believed(ideal))["verdict"] != r.ACCEPTED


# --- Memory ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def learned(tmp_path):
    """A closed loop that has learned, and its folder."""
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    loop.run(parked(60.0), until=lambda e: e["adapt_result"] != r.NO_RESULT)
    return loop, tmp_path


def test_learned_values_come_back_after_a_restart(learned):
    loop, folder = learned
    again = ClosedLoop(folder, pads_mm=6.0)
    for name in LEARNED_FIELDS:
        np.testing.assert_array_equal(again.parameters[0][name], loop.parameters[0][name], err_msg=name)
    estimates, truth = again.run(rest(0.5) + random_angle(again.car.plants[0], 5.0, np.random.default_rng(2)))
    assert np.sqrt(np.mean((estimates["force"] - truth["force"]) ** 2)) < 100.0


def test_values_of_another_actuator_or_calibration_are_not_used(learned, caplog):
    _, folder = learned
    for calibration in (adaptkit.shipped(actuator="another"), adaptkit.shipped(pad_thickness_mm=11.0)):
        other = ClosedLoop(folder, calibration)
        assert same_parameters(other.parameters[0], to_parameters(calibration))
        assert "not used" in caplog.text
        caplog.clear()


@pytest.mark.parametrize("damage", ["cut", "bit", "words", "empty"])
def test_a_damaged_file_is_set_aside_and_survived(learned, damage, caplog):
    _, folder = learned
    path = folder / "adaptation-FL.json"
    content = path.read_bytes()
    half, changed = content[: len(content) // 2], content.replace(b"accepted", b"accepteD", 1)
    path.write_bytes({"cut": half, "bit": changed, "words": b"hello", "empty": b""}[damage])
    loop = ClosedLoop(folder)
    assert same_parameters(loop.parameters[0], to_parameters(loop.calibration))
    assert "set aside" in caplog.text
    assert not path.exists() and len(list(folder.glob("*.damaged-*"))) == 1


def test_history_is_bounded_and_a_rejection_changes_nothing_in_use():
    store = specimen(1)
    rejected = msgspec.structs.replace(specimen(2).current, verdict="residual too large", curve=None)
    for _ in range(80):
        store = with_entry(store, rejected)
    assert store.current == specimen(1).current
    assert len(store.history) == 50
    assert decode(encode(store)) == store


def test_a_kill_leaves_a_whole_set():
    """`python -m emb_daemon.adapt.evidence kills` kills 500 times."""
    result = kills(40)
    assert result["whole"] == result["kills"] == 40
    assert result["newer_set_found"] > 5


def test_where_the_state_is_kept(tmp_path):
    assert state_directory("learned", tmp_path, {}) == tmp_path / "learned"
    assert state_directory("learned", tmp_path, {"STATE_DIRECTORY": "/var/lib/emb_daemon:/other"}).name == "emb_daemon"
    assert state_directory(None, tmp_path, {}) is None


def test_people_can_look_and_reset(learned, capsys):
    _, folder = learned
    assert main(["adaptation", "show", "--state", str(folder)]) == 0
    shown = capsys.readouterr().out
    assert "FL: actuator rig-A" in shown and "residual" in shown
    assert main(["adaptation", "history", "--state", str(folder)]) == 0
    assert "accepted" in capsys.readouterr().out
    assert main(["adaptation", "reset", "--corner", "FR", "--state", str(folder)]) == 0
    assert (folder / "adaptation-FL.json").exists()
    assert main(["adaptation", "reset", "--state", str(folder)]) == 0
    assert not (folder / "adaptation-FL.json").exists()
    assert main(["adaptation", "show", "--state", str(folder)]) == 0
    assert "nothing learned" in capsys.readouterr().out
    assert main(["adaptation", "show", "--state", str(folder / "nowhere")]) == 2


def test_an_entry_holds_all_that_take_over_changes(learned):
    """The file restores every parameter that learning changed."""
    loop, folder = learned
    fresh = to_parameters(loop.calibration)
    apply_entry(Memory(folder).read("FL").current, fresh)
    assert same_parameters(fresh, loop.parameters[0])


def test_unasked_training_is_used_though_the_brake_is_requested_with_it(tmp_path):
    """As in the rig's logs, where BrakeRequest follows the clamp force."""
    loop = ClosedLoop(tmp_path, pads_mm=6.0)
    schedule = rest(1.0) + training(loop.car.plants[0], 30.0, high_N=17_000.0)
    schedule.drives["brake_request"][1500:] = 1
    schedule.drives["park_brake"][-125:] = 1
    estimates, _ = loop.run(schedule)
    assert not estimates["adapt_request"].any()
    assert loop.adaptation.adapters[0]["result"] == r.RESULT_ACCEPTED
