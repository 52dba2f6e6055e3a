"""The judge of the study of silent errors: a correct estimate keeps every promise, and each is broken by one kind of error."""

import msgspec
import numpy as np
import pytest

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.estimator.records import ESTIMATE
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.records import FORCE
from emb_daemon.plant.scenarios import rest, simulate_log
from emb_daemon.resources import resource
from emb_daemon.wire import layout as wire
from emb_daemon.wire.contract import ADAPTING, DEGRADED, FAULT, FUSED, INVALID, RESULT_ACCEPTED, RUNNING, STIFFNESS_ONLY
from emb_daemon.wire.e2e import crc
from emb_daemon.wire.layout import default_layout, unpack
from studies import senders, unlisted
from studies.faults import Fault, Size, alter, lose, size_of
from studies.grid import FAMILIES, brake_of, draw_drive, drive, prepare
from studies.phases import first_flag_s, judge, verdict
from studies.silent import main

TIME_S = 0.004 * np.arange(5000)
FORCE_N = 5000.0 + 4000.0 * np.sin(TIME_S)


@pytest.fixture
def honest():
    """Running, fused, 30 N of sigma, and errors of that size."""
    rows = np.zeros(len(TIME_S), ESTIMATE)
    rows["mode"], rows["source"], rows["sigma"] = RUNNING, FUSED, 30.0
    rows["force"] = FORCE_N + 30.0 * np.random.default_rng(0).standard_normal(len(rows))
    return rows


@pytest.fixture(scope="module")
def plant():
    return plant_from_calibration(shipped_calibration(), seed=3)


@pytest.fixture(scope="module")
def moments(plant):
    """When the parts of a drive begin, s."""
    return draw_drive(plant, np.random.default_rng(1))[1]


@pytest.fixture
def frames(plant):
    return simulate_log(plant, rest(0.1))[0]


def failed(rows, **promised):
    return judge("all", TIME_S, rows, FORCE_N, **promised).failed


def test_a_correct_estimate_keeps_every_promise(honest):
    assert failed(honest, useful=0.99, rmse_N=35.0) == ()


def test_errors_beyond_three_sigma_in_over_a_hundredth_of_silent_samples(honest):
    honest["force"][:60] += 300.0
    assert failed(honest) == ("silent beyond 3 sigma",)
    honest["mode"][:60] = ADAPTING
    assert failed(honest) == ("silent beyond 3 sigma",)
    honest["mode"][:60] = DEGRADED
    assert failed(honest) == ()


def test_flagged_errors_may_be_two_hundredths_of_usable_samples(honest):
    honest["force"][:110], honest["mode"][:110] = 0.0, DEGRADED
    assert failed(honest) == ("usable beyond 3 sigma",)
    honest["source"][:110] = INVALID
    assert failed(honest) == ()


@pytest.mark.parametrize("rows", [slice(0, 60_000, 1800), slice(100, 128)], ids=["often", "long"])
def test_a_kilonewton_of_silent_error_often_or_for_long(honest, rows):
    """34 single samples of 60 000, or 0.108 s on end."""
    force_N, time_s, honest = np.tile(FORCE_N, 12), 0.004 * np.arange(60_000), np.tile(honest, 12)
    honest["force"][rows] += 1500.0
    honest["sigma"][rows] = 600.0
    assert judge("all", time_s, honest, force_N).failed == ("silent beyond 1 kN",)
    honest["force"][rows] -= 600.0
    assert judge("all", time_s, honest, force_N).failed == ()


def test_two_large_errors_in_five_thousand_are_pardoned(honest):
    honest["force"][[100, 3000]] += 1500.0
    assert failed(honest) == ()


def test_what_is_no_number_is_beyond_every_limit(honest):
    honest["force"][:101] = np.nan
    assert failed(honest) == ("silent beyond 3 sigma", "silent beyond 1 kN", "usable beyond 3 sigma")


def test_a_large_sigma_or_a_flag_is_not_useful(honest):
    honest["sigma"][:60] = 301.0
    assert failed(honest, useful=0.99) == ("useful",)
    honest["sigma"], honest["mode"][:60] = 30.0, DEGRADED
    assert failed(honest, useful=0.99) == ("useful",)
    assert failed(honest, useful=0.90) == ()


def test_an_error_that_stays_after_learning(honest):
    honest["force"] += 100.0
    honest["sigma"] = 100.0
    assert failed(honest, rmse_N=100.0) == ("rmse",)


def test_the_better_path_is_the_one_that_is_known_and_nearer(honest):
    honest["stiffness_force"], honest["torque_force"] = FORCE_N + 200.0, FORCE_N - 90.0
    assert judge("all", TIME_S, honest, FORCE_N).better_path_N == pytest.approx(90.0)
    honest["torque_force"][:9] = np.nan
    assert judge("all", TIME_S, honest, FORCE_N).better_path_N == pytest.approx(200.0)


def test_samples_without_reference_are_not_judged(honest):
    reference = np.where(TIME_S < 10.0, FORCE_N, np.nan)
    honest["force"][TIME_S >= 10.0] = 0.0
    assert judge("all", TIME_S, honest, reference).failed == ()


@pytest.mark.parametrize("told", [("mode", FAULT), ("source", STIFFNESS_ONLY), ("reasons", 1)], ids=lambda told: told[0])
def test_the_first_flag_is_the_first_after_the_onset(honest, told):
    field, value = told
    honest[field][100], honest[field][2000] = value, value
    assert first_flag_s(TIME_S, honest, 2.0) == pytest.approx(8.0 - 2.0)
    assert np.isnan(first_flag_s(TIME_S, honest, 9.0))


def test_a_verdict_counts_trainings_and_has_the_first_flag_from_its_onset(honest):
    honest["adapt_result"][[*range(500, 600), *range(900, 1000)]] = RESULT_ACCEPTED
    honest["mode"][[100, 2000]] = FAULT
    told = verdict("any", 7, Fault("one of two", 1.0), TIME_S, honest, 2.0, [judge("all", TIME_S, honest, FORCE_N)])
    assert (told["trained"], told["first_flag_s"], told["onset_s"]) == (2, pytest.approx(6.0), 1.0)
    assert told["phases"][0]["name"] == "all" and (told["family"], told["number"], told["size"]) == ("any", 7, "one of two")


def test_a_changed_signal_leaves_the_frame_whole(frames):
    """Counter, CRC and the frame's other signals stay right: the daemon cannot tell the change from a sensor's."""
    before = frames.copy()
    bus = alter(wire.RESOLVER, wire.MOTOR_ANGLE, lambda values, _: values + 3.0)
    after = bus(frames, 0.0)
    rows, signals = before["can_id"] == 0x100, default_layout()[0]["received"][wire.RESOLVER]
    assert rows.any()
    assert np.array_equal(before[~rows], after[~rows])
    for old, new in zip(before[rows], after[rows], strict=True):
        assert unpack(new["data"], signals[wire.MOTOR_ANGLE]) - unpack(
            old["data"], signals[wire.MOTOR_ANGLE]
        ) == pytest.approx(3.0)
        assert unpack(new["data"], signals[wire.MOTOR_SPEED]) == unpack(old["data"], signals[wire.MOTOR_SPEED])
        assert crc(0x100, new["data"]) == int(new["data"]) & 0xFF
        assert (int(new["data"]) ^ int(old["data"])) & 0xFF00 == 0


def test_a_lost_message_is_lost_alone(frames):
    left = lose(wire.CURRENT)(frames, 0.0)
    assert set(np.unique(frames["can_id"])) - set(np.unique(left["can_id"])) == {0x110}


@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_every_family_draws_a_fault_within_the_drive(moments, name):
    for seed in range(5):
        fault = FAMILIES[name](np.random.default_rng(seed), moments, Size())
        assert 0.0 <= fault.onset_s <= moments["park"]


@pytest.mark.parametrize("name", sorted(unlisted.FAMILIES | senders.FAMILIES))
def test_what_nobody_listed_is_wrong_in_what_frames_say_and_not_in_the_frames(moments, frames, name):
    """Otherwise E2E protection would refuse the frames before they reach the estimator."""
    frames = frames[default_layout()[0]["slot"][frames["can_id"]] >= 0]
    for seed in range(5):
        fault, time_s = FAMILIES[name](np.random.default_rng(seed), moments, Size()), moments["park"]
        for _ in range(20):
            time_s += 0.08
            for frame in fault.bus(frames.copy(), time_s):
                assert crc(int(frame["can_id"]), frame["data"]) == int(frame["data"]) & 0xFF


def test_a_brake_with_a_disc_of_its_own_has_the_one_that_its_calibration_is_given():
    """In studies of the wheel's phase nothing may be wrong before the fault."""
    uneven = {"disc_thickness_variation": {"order_1_sine_um": -15.0}}
    _, _, calibration, car, _ = prepare(("wheel_pulses_pause",), 0, 1, brake_of(None)._replace(effects=uneven, unit=1))
    for name, value in calibration.effects["disc_thickness_variation"].items():
        assert car.plants["effects"]["disc_thickness_variation"][name] == pytest.approx(value, rel=0.2)


def test_effects_from_no_catalogue_enter_at_every_port(plant, moments):
    ports = set()
    for seed in range(50):
        changed = plant.copy()
        unlisted.FAMILIES["foreign"](np.random.default_rng(seed), moments, Size()).brake(changed)
        [port] = [port for port in unlisted.WHOLE if changed["effects"][f"drawn_{port}"]["size"] != 0.0]
        ports.add(port)
    assert ports == set(unlisted.WHOLE)


def test_a_drive_comes_back_from_its_seed():
    one, other = drive(("contact_jump",), 0, 7), drive(("contact_jump",), 0, 7)
    assert one[0].size == other[0].size
    assert np.array_equal(one[2]["force"], other[2]["force"])
    assert np.array_equal(one[3], other[3])


def test_pads_that_have_moved_are_where_the_training_stroke_found_them():
    """They moved by 143 um between two drives: the filter, which had known them to half a micrometre, would keep an error of
    4.2 kN."""
    _, _, estimates, force_N = drive(("contact_jump",), 3, 1)
    accepted = np.flatnonzero(np.diff((estimates["adapt_result"] == RESULT_ACCEPTED).astype(int)) > 0)[-1]
    after = slice(accepted + 1, accepted + 500)
    assert force_N[after].max() > 12e3
    assert np.abs(estimates["force"] - force_N)[after].max() < 1500.0


def test_sigma_follows_a_contact_that_moves_while_the_motor_holds():
    """By 127 um in 25 s: angle and torque can each be at fault, and the force is 4 kN off."""
    _, moments, estimates, force_N = drive(("contact_slow",), 1, 61)
    time_s = 1e-9 * estimates["time_ns"] - moments["park"]
    held = (time_s > 5.0) & (time_s < 30.0)
    off = np.abs(estimates["force"] - force_N)[held]
    assert off.max() > 4000.0 and np.max(off / estimates["sigma"][held]) < 3.5


@pytest.mark.trial
def test_a_current_a_third_of_a_cycle_late_is_no_other_contact():
    """A foot that trembles on the pedal for half a minute: the torque is off by what it changes by in that third."""
    _, moments, estimates, force_N = drive(("current_late",), 1, 401, drawn=True)
    rows = 1e-9 * estimates["time_ns"] < moments["park"]
    off = estimates["force"][rows] - force_N[rows]
    beyond = np.abs(off) > 3.0 * np.hypot(estimates["sigma"][rows], 25.0)
    print(f"{np.sqrt(np.mean(off**2)):.0f} N RMS, {np.abs(off).max():.0f} N at most, {beyond.mean():.2%} beyond three sigma")
    assert np.sqrt(np.mean(off**2)) < 100.0 and beyond.mean() < 0.001


def test_another_brake_has_its_share_of_forces_and_of_sizes(plant):
    own, half = (draw_drive(plant, np.random.default_rng(1), share=share) for share in (1.0, 0.5))
    forces = own[0].commands["mode"] == FORCE
    assert np.array_equal(half[0].commands["target"][forces], 0.5 * own[0].commands["target"][forces])
    assert half[1] == own[1]
    sizes = [FAMILIES["current_offset"](np.random.default_rng(2), own[1], size).size for size in (Size(), Size(current=0.5))]
    assert float(sizes[1].split()[0]) == pytest.approx(0.5 * float(sizes[0].split()[0]), abs=0.01)
    calibration = shipped_calibration()
    constant = 2.0 * calibration.motor.torque_constant_Nm_per_A
    motor = msgspec.structs.replace(calibration.motor, torque_constant_Nm_per_A=constant)
    assert size_of(msgspec.structs.replace(calibration, motor=motor), calibration) == Size(1.0, 0.5, 1.0)


def test_a_stranger_that_is_not_there_is_one_line(tmp_path, capsys):
    assert main(["grid", "--stranger", str(tmp_path / "7")]) == 2
    (tmp_path / "c.yaml").write_text(resource("config/calibration.yaml").read_text())
    assert main(["grid", "--stranger", str(tmp_path)]) == 2
    assert all(len(line) > 20 for line in capsys.readouterr().err.splitlines())
