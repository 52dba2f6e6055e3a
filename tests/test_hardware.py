"""Machines that nobody here built: an actuator without pads, sensors without noise, and the converters of measured sets."""

import dataclasses
import re
from types import SimpleNamespace

import brake
import foreignkit
import msgspec
import numpy as np
import pytest

import emb_daemon
from emb_daemon.calibration.files import load_calibration, save_calibration
from emb_daemon.calibration.parameters import TORQUE_CONSTANT, moved
from emb_daemon.calibration.types import Provenance, to_parameters
from emb_daemon.cli.main import main
from emb_daemon.diagnose import diagnosis, residuals
from emb_daemon.diagnose.comparison import errors, whole
from emb_daemon.diagnose.diagnosis import diagnose
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.plain import plain_left, plain_rms
from emb_daemon.diagnose.report import report
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.screening import Screening
from emb_daemon.diagnose.speeds import denoised
from emb_daemon.diagnose.text import verdict
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.logs import resample
from emb_daemon.offline import load_log
from emb_daemon.wire.contract import reason_words
from studies import hardware as study


@pytest.fixture(scope="module")
def stops():
    """Creeping about the released position, then stops: the speed of an angle in counts comes and goes while that stands."""
    clock = np.arange(0.0, 5.0, foreignkit.FINE_S)
    creep = np.where(clock < 0.5, 0.0, 0.2 * (1.0 - np.cos(2.0 * np.pi * (clock - 0.5) / 1.5)))
    return foreignkit.sampled(foreignkit.truth(np.concatenate([creep, foreignkit.truth().angle])), 250.0)


def _log(columns: dict, **more):
    return emb_daemon.log_of_arrays(
        columns["time_s"],
        columns["angle_rad"],
        current_A=columns["current_A"],
        inner_backplate_C=22.0,
        wheel_speed_rad_per_s=0.0,
        force_N=columns["force_N"],
        **more,
    )


def _drawn(time_s, angle, speed, current, force=0.0):
    """A log of what a machine draws at these moments."""
    columns = {"time_s": time_s, "angle_rad": angle, "current_A": current, "force_N": force + 0.0 * time_s}
    return _log(columns, speed_rad_per_s=speed, current_mean_s=0.0)


def _without_pads(**friction: float):
    """A calibration to begin with, of an actuator whose clearance never closes."""
    base = foreignkit.calibration()
    contact = msgspec.structs.replace(base.contact, clearance_rad=1e4)
    stated = msgspec.structs.replace(base, contact=contact, provenance=None, effects={})
    return moved(stated, {f"friction.{name}": value for name, value in friction.items()})


def _of_a_joint(inertia: float = 0.01, **friction: float):
    """The same of a joint at its own shaft."""
    motor = {"motor.torque_constant_Nm_per_A": 1.0, "motor.inertia_kg_m2": inertia}
    return moved(_without_pads(load_m_per_rad=0.0, **friction), motor)


def test_an_encoder_that_repeats_itself_at_rest_is_no_frozen_sensor(stops, monkeypatch):
    """Angles that stand to the bit, and no speed but their change: nothing else is known of most rigs."""

    def judged():
        log = _log(stops)
        estimates = emb_daemon.run(log, foreignkit.calibration())
        stuck = np.mean(["signal stuck" in reason_words(bits) for bits in estimates["reasons"]])
        return np.sqrt(np.nanmean((estimates["force"] - log.force_N)[100:] ** 2)), stuck

    rmse_N, stuck = judged()
    assert rmse_N < 60.0 and stuck == 0.0
    monkeypatch.setattr(resample, "unrepeated", lambda speed, row: speed)
    assert judged()[1] > 0.1, "what the rig's silence at rest would be taken for"


def test_a_calibration_without_friction_gives_numbers(stops):
    still = moved(foreignkit.calibration(), {"friction.offset_Nm": 0.0, "friction.load_m_per_rad": 0.0})
    estimates = emb_daemon.run(_log(stops), still)
    assert np.isfinite(estimates["force"]).all() and np.median(estimates["sigma"]) < 1000.0


def test_a_load_of_either_sign_is_judged_by_the_torque_path_alone():
    """An actuator on a dynamometer: no pads, no curve, and a load that may pull."""
    without_load = _without_pads(load_m_per_rad=0.0)
    motor, friction = without_load.motor, without_load.friction
    time_s = 0.004 * np.arange(3000)
    angle, speed = 20.0 * np.sin(2.0 * time_s), 40.0 * np.cos(2.0 * time_s)
    force = 5000.0 * np.sin(0.7 * time_s)
    torque = motor.gear_gain_m_per_rad * force - 80.0 * motor.inertia_kg_m2 * np.sin(2.0 * time_s)
    torque += friction.offset_Nm * np.sign(speed)
    bench = Bench([_drawn(time_s, angle, speed, torque / motor.torque_constant_Nm_per_A, force)], without_load)
    assert bench.channels == ["torque"] and whole(bench) == "torque"
    assert errors(bench, without_load).rmse("torque") < 250.0
    # What matters, and what rivals of a term differ by, are shares of the load.
    assert Screening(bench, Model.of(bench)).force_N == pytest.approx(5000.0 / np.sqrt(2.0), rel=0.05)
    assert errors(bench, moved(without_load, {"motor.torque_constant_Nm_per_A": 0.06})).rmse("torque") > 500.0


@pytest.mark.parametrize(("lacking", "told"), [("force_N", "no load reference .*value: 0"), ("current_A", "no motor current")])
def test_a_motor_with_nothing_to_judge_by_is_told_what_lacks(lacking, told):
    """A motor that turns free has no load sensor, and knows its load: none."""
    time_s = 0.004 * np.arange(3000)
    known = {"current_A": np.sin(time_s), "force_N": np.zeros(3000)}
    del known[lacking]
    log = emb_daemon.log_of_arrays(time_s, 20.0 * np.sin(2.0 * time_s), wheel_speed_rad_per_s=0.0, **known)
    with pytest.raises(InputError, match=told):
        Bench([log], _without_pads())


def _on_a_dynamometer(scatter: float, load: float):
    """A motor of 0.85 of its stated constant that turns to and fro against a load: calibration, the true constant, and logs
    to fit and to judge. ``load``: share of its current that it gets from the load and does not draw from its own speed;
    ``scatter`` of friction, in A."""
    stated = _without_pads(load_m_per_rad=0.0)
    motor, constant = stated.motor, 0.85 * stated.motor.torque_constant_Nm_per_A

    def log(seed: int, size_A: float):
        random = np.random.default_rng(seed)
        time_s = 0.004 * np.arange(5000)
        speed = 30.0 * np.sin(2.0 * np.pi * time_s / 1.7)
        held = [np.repeat(random.normal(size=5000 // n), n) for n in (100, 40)]
        torque = constant * size_A * held[0]
        lost = stated.friction.offset_Nm * np.sign(speed) + scatter * constant * held[1]
        lost += motor.inertia_kg_m2 * np.gradient(speed, time_s)
        force = (load * torque - (lost if load == 1.0 else 0.0)) / motor.gear_gain_m_per_rad
        current = (torque if load == 1.0 else load * torque + lost) / constant
        return _drawn(time_s, np.cumsum(speed) * 0.004, speed, current, force)

    return stated, constant, log(1, 3.0), log(2, 9.0)


def test_a_constant_is_not_taken_for_larger_because_friction_scatters_the_load():
    """Of a motor whose current is commanded: on larger loads the constant that was fitted to small ones must hold."""
    stated, constant, fit, judge = _on_a_dynamometer(scatter=1.8, load=1.0)
    result = diagnose([fit], stated, [judge])
    assert result.calibration.motor.torque_constant_Nm_per_A == pytest.approx(constant, rel=0.05)
    before, after = (errors.rmse("torque") for errors in (result.before, result.after))
    table = np.column_stack([fit.samples["current_q"], np.sign(fit.samples["speed"])])
    plain = np.linalg.lstsq(table, fit.force_N, rcond=None)[0]
    left = judge.force_N - np.column_stack([judge.samples["current_q"], np.sign(judge.samples["speed"])]) @ plain
    assert after < 0.9 * before and after < 1.03 * np.sqrt(np.mean(left**2))


def test_a_machine_whose_angles_have_jittered_stamps_of_their_own_shows_its_effect():
    """Strokes against a torque sensor, with a motor that creeps between them: there its angle differs from its speed by more
    than that of a standing motor may. Where the runs of a fit take this for another motion of the friction than the step, they
    differ from it by more than viscous friction does, and nothing is found."""
    stated, *_ = _on_a_dynamometer(scatter=0.0, load=1.0)

    def log(seed: int):
        random, time_s = np.random.default_rng(seed), 0.004 * np.arange(6000)
        strokes = np.repeat(random.uniform(10.0, 25.0, 6), 1000) * np.sin(np.pi * time_s) ** 3
        speed = np.where(time_s % 4.0 < 2.0, strokes, 2.5 * np.sin(np.pi * time_s))
        rows, _ = brake.samples(to_parameters(stated), np.cumsum(speed) * 0.004)
        force = np.repeat(random.normal(0.0, 4000.0, 30), 200)
        torque = stated.motor.gear_gain_m_per_rad * force + 1e-3 * rows["speed"]
        angle = np.interp(time_s + random.uniform(-0.003, 0.003, 6000), time_s, rows["angle"])
        current = rows["current_q"] + torque / stated.motor.torque_constant_Nm_per_A + random.normal(0.0, 0.05, 6000)
        return _drawn(time_s, angle, rows["speed"], current, force)

    result = diagnose([log(1)], stated, [log(2)])
    [found] = result.accepted
    assert found.effect.name == "viscous_friction"
    assert found.values["viscous_Nms_per_rad"] == pytest.approx(1e-3, rel=0.15)
    assert result.after.rmse("torque") < 0.5 * result.before.rmse("torque")


def test_an_offset_shows_where_a_motor_turns_one_way_and_friction_cannot_be_less_than_none():
    """There the two are one line: a friction that drives must not stand in for an offset, in a test that no fit can follow. Of
    a propeller, whose load goes with its speed, and which is run up and slowed down time and again, four phases to a run."""
    stated, constant, *_ = _on_a_dynamometer(scatter=0.0, load=1.0)

    def log(seed: int):
        random, time_s = np.random.default_rng(seed), 0.004 * np.arange(12_000)
        speed = 85.0 + 55.0 * np.interp(time_s % 8.0, [0.0, 2.0, 4.0, 6.0, 8.0], [0.0, 1.0, 1.0, 0.0, 0.0])
        current = 4.0 * (speed / 100.0) ** 2 + 0.3 * np.repeat(random.normal(size=300), 40)
        force = constant * (current + 2.0) / stated.motor.gear_gain_m_per_rad + 20.0 * random.normal(size=len(time_s))
        return _drawn(time_s, np.cumsum(speed) * 0.004, speed, current, force)

    found = diagnose([log(1)], stated, [log(2)])
    assert [c.effect.name for c in found.accepted] == ["current_offset"]
    assert found.after.rmse("torque") < 1.3 * 20.0 < 0.1 * found.before.rmse("torque")


def _explained(speed, current, load):
    """How much of a load the current is there for."""
    told = np.ones(len(speed), bool)
    samples = {"speed": speed, "current_q": current, "has_current": told, "dt": np.full(len(speed), 0.004)}
    return residuals._partial_correlation([SimpleNamespace(log=SimpleNamespace(samples=samples), force_N=load)])


@pytest.mark.parametrize("own", ["direction", "speed", "acceleration"])
def test_what_the_machine_takes_for_its_own_motion_is_no_current_for_the_load(own):
    """Though the load may follow the same: that of a mass does the acceleration."""
    random = np.random.default_rng(1)
    speed = np.convolve(random.normal(size=3000), np.ones(20), "same")
    moved_by = {"direction": np.sign(speed), "speed": speed, "acceleration": np.diff(speed, prepend=speed[:1])}[own]
    moved_by = moved_by / moved_by.std()
    current, load = (moved_by + 0.1 * random.normal(size=len(speed)) for _ in range(2))
    assert _explained(speed, current, load) < 0.01
    assert _explained(speed, current, moved_by + 3.0 * current) > 0.99
    assert _explained(speed, np.full(len(speed), 1.3), load) == 0.0


def test_what_a_load_changes_by_at_once_is_no_work_of_a_current_that_does_not():
    """A motor that is held by its current against another that jerks: by all of the load's scatter the current would seem not
    to be there for it, and a constant fitted to the current would be half as large again. What scatters slowly does count."""
    random = np.random.default_rng(2)
    speed, current = np.sin(0.01 * np.arange(6000)), np.repeat(random.normal(size=60), 100)
    assert _explained(speed, current, current + 1.3 * random.normal(size=len(speed))) > 0.9
    assert _explained(speed, current, current + 1.3 * np.repeat(random.normal(size=60), 100)) < 0.5


def test_of_a_load_that_swings_back_meanwhile_nothing_is_left_out():
    """Ten times a second, and the current with it."""
    random, time_s = np.random.default_rng(2), 0.004 * np.arange(6000)
    swing, slow = np.sin(20.0 * np.pi * time_s), np.repeat(random.normal(size=60), 100)
    current, load = 0.5 * swing + slow, 2.0 * swing + 0.5 * slow
    expected = np.corrcoef(current, load)[0, 1] ** 2
    assert _explained(np.sin(0.01 * np.arange(6000)), current, load) == pytest.approx(expected, abs=0.05) and expected > 0.3


def test_a_constant_is_free_as_far_as_a_supplier_leaves_it_unless_it_was_measured():
    """And where a measured load tells it."""
    priors = []
    for load, provenance in ((1.0, None), (1.0, Provenance(date="", tool="")), (0.1, None)):
        stated, _, fit, _ = _on_a_dynamometer(scatter=0.9, load=load)
        bench = Bench([fit], msgspec.structs.replace(stated, provenance=provenance))
        priors += [c.prior for c in Model.of(bench).values if c.name == TORQUE_CONSTANT]
    free, measured, untold = priors
    assert free == pytest.approx(10.0 * measured) and untold == measured


@pytest.mark.parametrize("stated_as", [0.2, 1.0, 4.0])
def test_a_constant_that_is_stated_far_off_does_not_hold_the_fit_half_way(stated_as):
    """That of the motor without its gear, for example: the friction that it lets begin with is off by as much."""
    stated, constant, fit, _ = _on_a_dynamometer(scatter=0.9, load=1.0)
    guess = moved(stated, {TORQUE_CONSTANT: stated_as * constant, "friction.offset_Nm": 0.1 * stated.friction.offset_Nm})
    bench = Bench([fit], guess)
    found = bench.calibrated(Model.of(bench).refined(["torque"]).values)
    assert found.motor.torque_constant_Nm_per_A == pytest.approx(constant, rel=0.05)
    assert found.friction.offset_Nm == pytest.approx(stated.friction.offset_Nm, rel=0.3)


def test_logs_that_judge_are_judged_by_what_is_fitted():
    """Though by themselves they would be judged otherwise: errors of another quantity refute nothing."""
    stated, _, fit, _ = _on_a_dynamometer(scatter=0.9, load=1.0)
    _, _, judge, _ = _on_a_dynamometer(scatter=0.9, load=0.1)
    assert Bench([fit], stated).load_follows and not Bench([judge], stated).load_follows
    assert diagnose([fit], stated, [judge]).judges.load_follows


@pytest.mark.parametrize(
    ("load", "validated"),
    [pytest.param(1.0, True, marks=pytest.mark.trial), pytest.param(1.0, False, marks=pytest.mark.trial), (0.1, True)],
)
def test_what_a_plain_fit_leaves_is_stated_beside_what_was_found(load, validated):
    """Where friction scatters and nothing else is there to be found, both leave the same."""
    stated, _, fit, judge = _on_a_dynamometer(scatter=0.9, load=load)
    found = diagnose([fit], stated, [judge] if validated else [])
    plain_N, ours_N = found.plain
    assert plain_N == pytest.approx(ours_N, rel=0.1) and not found.plainly_better
    if load == 1.0:
        assert ours_N == pytest.approx(found.after.rmse("torque"), rel=0.02)
    assert report(found)["plain"] == {"rms_plain_N": plain_N, "rms_after_N": ours_N}
    better = dataclasses.replace(found, plain=(0.9 * ours_N, ours_N))
    assert "Plain least squares" in verdict(better) and "Plain least squares" not in verdict(found)
    assert "Plain least squares" not in verdict(dataclasses.replace(found, plain=None))


def test_of_each_quarter_of_the_episodes_the_others_are_fitted_plainly(monkeypatch):
    stated, _, fit, _ = _on_a_dynamometer(scatter=0.9, load=1.0)
    bench, parts = Bench([fit], stated), []

    def left(fitted, kept, judged, asked):
        parts.append((kept, asked))
        return 1.0 * asked

    monkeypatch.setattr(diagnosis, "plain_left", left)
    monkeypatch.setattr(diagnosis, "left_out_residuals", lambda selection: {"torque": np.ones(len(fit.samples))})
    selection = SimpleNamespace(model=SimpleNamespace(bench=bench))
    assert diagnosis._plain(selection, None, {}) == (1.0, 1.0)
    told = bench.residuals({})["torque"] != 0.0
    assert len(parts) == 4 and np.array_equal(sum(asked.astype(int) for _, asked in parts), told)
    assert all(np.array_equal(kept, told & ~asked) for kept, asked in parts)


def test_a_plain_fit_knows_nothing_of_what_it_is_judged_by():
    stated, _, fit, judge = _on_a_dynamometer(scatter=0.9, load=1.0)
    fitted, judges = Bench([fit], stated), Bench([judge], stated)
    every = [np.ones(len(log.samples), bool) for log in (fit, judge)]
    first = plain_left(fitted, every[0], judges, every[1])
    few = every[0] & (np.arange(len(fit.samples)) < 500)
    assert np.std(plain_left(fitted, few, judges, every[1]) - first) > 0.01 * np.std(first)
    asked = np.arange(len(judge.samples)) % 2 == 0
    assert np.array_equal(plain_left(fitted, every[0], judges, asked), np.where(asked, first, 0.0))
    assert plain_rms(np.array([3.0, 0.0, -3.0])) == 3.0


@pytest.mark.parametrize("validated", [False, True])
def test_what_a_free_motor_draws_is_not_explained_by_itself(validated):
    """Friction that changes by itself is nothing that the torque constant, falling with the current, would explain; and a
    motor on a bench has no disc over whose temperature it would."""
    stated, _, fit, judge = _on_a_dynamometer(scatter=0.9, load=0.0)
    found = diagnose([fit], stated, [judge] if validated else [])
    assert not found.selection.accepted
    assert found.calibration.friction.offset_Nm > 0.5 * stated.friction.offset_Nm
    assert "a load that is measured" in found.selection.candidates["torque_saturation"].reason


@pytest.mark.trial
def test_the_friction_of_a_joint_is_found_though_no_brake_has_as_much(tmp_path):
    """At its own shaft a robot's joint has a thousand times the viscous friction of a brake's motor: its own current and speed
    say how much may be. What is found is a calibration like any other, but not of a brake."""
    stated = _of_a_joint(inertia=1e-3, offset_Nm=0.2)
    random, time_s = np.random.default_rng(5), 0.004 * np.arange(12000)
    speed = np.repeat(random.uniform(3.0, 20.0, 12), 1000) * np.sin(2.0 * np.pi * time_s / 1.0)
    torque = 0.2 * np.sign(speed) + 0.15 * speed + 1e-3 * np.gradient(speed, time_s) + 0.02 * random.normal(size=len(time_s))
    found = diagnose([_drawn(time_s, np.cumsum(speed) * 0.004, speed, torque)], stated).calibration
    assert found.effects["viscous_friction"]["viscous_Nms_per_rad"] == pytest.approx(0.15, rel=0.1)
    save_calibration(found, tmp_path / "found.yaml")
    assert load_calibration(tmp_path / "found.yaml").effects == found.effects
    with pytest.raises(InputErrors, match=r"viscous_Nms_per_rad: 0\.1\d* outside"):
        moved(found, {"contact.clearance_rad": 2.0}, checked=True)


def _joint(presliding_rad: float, inertia: float, turned: float = 2e-4):
    """A calibration to begin with, and half a minute of what a joint of 0.13 N m and ``turned`` kg m² draws that turns free,
    whose friction turns over within 2e-3 rad."""
    stated = _of_a_joint(inertia, offset_Nm=0.2, presliding_angle_rad=presliding_rad)
    random, time_s = np.random.default_rng(3), 0.004 * np.arange(8000)
    angle = np.repeat(random.uniform(1.0, 5.0, 8), 1000) * (1.0 - np.cos(2.0 * np.pi * time_s / 1.0))
    speed, friction = np.gradient(angle, time_s), np.zeros(len(time_s))
    for row, way in enumerate(np.diff(angle), 1):
        friction[row] = np.clip(friction[row - 1] + way / 2e-3, -1.0, 1.0)
    torque = 0.13 * friction + turned * np.gradient(speed, time_s) + 0.02 * random.normal(size=len(time_s))
    return stated, _drawn(time_s, angle, speed, torque)


@pytest.mark.parametrize("inertia", [4e-3, 2e-4])
def test_friction_that_turns_over_at_once_and_a_light_rotor_are_found_from_a_brakes_numbers(inertia):
    """Far from where the search begins: a hundred times the presliding angle, twenty times the inertia. What refitting gains
    is asked about where it ended: the line that touches the start shows two thirds of it, in other machines nothing."""
    stated, log = _joint(presliding_rad=0.3, inertia=inertia)
    found = diagnose([log], stated)
    assert found.selection.recalibrated and not found.accepted
    assert found.calibration.friction.presliding_angle_rad < 1e-2
    assert found.calibration.friction.offset_Nm == pytest.approx(0.13, rel=0.1)
    assert found.calibration.motor.inertia_kg_m2 < 4e-4
    scale = stated.motor.torque_constant_Nm_per_A / stated.motor.gear_gain_m_per_rad
    before, after = found.before.rmse("torque"), found.after.rmse("torque")
    assert after < 1.3 * 0.02 * scale < before
    assert found.selection.recalibrated["torque"] == pytest.approx(np.sqrt(before**2 - after**2), rel=0.05)


@pytest.mark.parametrize("turned", [0.0, 1e-5, 2e-4])
def test_a_torque_that_accelerates_no_motor_is_told(turned):
    """A controller computes it without inertia, or a sensor behind the gear sees no rotor."""
    stated, log = _joint(0.02, 2e-4, turned)
    assert ("No inertia is left" in verdict(diagnose([log], stated))) == (turned == 0.0)


def _breakaways(seed: int):
    """A joint of 0.5 N m that turns free, broken away time and again by a current that rises while it stands, for a second
    and a half of every two."""
    random, time_s = np.random.default_rng(seed), 0.004 * np.arange(12_000)
    phase, turn = time_s % 2.0, np.floor(time_s / 2.0).astype(int)
    way = random.choice([-1.0, 1.0], 24)[turn]
    speed = way * random.uniform(1.0, 4.0, 24)[turn] * np.where(phase > 1.5, np.sin(2.0 * np.pi * (phase - 1.5)), 0.0)
    torque = np.where(phase <= 1.5, 0.5 * way * phase / 1.5, 0.5 * np.sign(speed)) + 0.02 * random.normal(size=len(time_s))
    return _drawn(time_s, np.cumsum(speed) * 0.004, speed, torque)


@pytest.mark.trial
def test_a_current_that_does_not_turn_a_free_motor_tells_nothing_of_its_friction(monkeypatch):
    """Friction holds it, whatever the current below that is: friction is not fitted to it, nor the model judged by it."""
    stated = _of_a_joint(offset_Nm=0.2, presliding_angle_rad=0.001)
    found = diagnose([_breakaways(1)], stated, [_breakaways(2)])
    scale = stated.motor.torque_constant_Nm_per_A / stated.motor.gear_gain_m_per_rad
    assert found.calibration.friction.offset_Nm == pytest.approx(0.5, rel=0.05) and not found.accepted
    assert found.after.rmse("torque") < 1.3 * 0.02 * scale
    monkeypatch.setattr(residuals, "standing", lambda time_s, angle: np.zeros(len(time_s), np.bool_))
    with_rest = diagnose([_breakaways(1)], stated, [_breakaways(2)])
    assert with_rest.after.rmse("torque") > 5.0 * found.after.rmse("torque")


def test_a_torque_that_is_explained_to_the_bit_is_judged():
    """A motor that a wheel drives on at a steady speed draws nothing; without friction nothing is left, and that is known."""
    time_s = 0.004 * np.arange(4000)
    speed = np.where(time_s < 8.0, 3.0 * np.sin(np.pi * np.minimum(time_s, 8.5)), 3.0)
    log = _drawn(time_s, np.cumsum(speed) * 0.004, speed, np.where(time_s < 8.5, 0.3, 0.0))
    bench = Bench([log], _of_a_joint(offset_Nm=0.2))
    judged = [errors(bench, _of_a_joint(offset_Nm=friction)).samples("torque") for friction in (0.2, 0.0)]
    assert judged[0] == judged[1] > 3000


def test_a_free_motor_that_never_turns_is_no_diagnosis():
    time_s = 0.004 * np.arange(2000)
    logs = [_drawn(time_s, 0.0 * time_s, 0.0 * time_s, 0.01 * n * np.sin(time_s)) for n in range(1, 8)]
    with pytest.raises(InputError, match="the motor stands throughout without a load, and friction holds it"):
        diagnose(logs, _of_a_joint(offset_Nm=0.2))


@pytest.mark.trial
@pytest.mark.parametrize("step", [0.02, 0.2])
def test_the_inertia_of_a_slow_joint_is_not_diluted_by_the_steps_of_its_speed(monkeypatch, step):
    """Of our message, or coarser ones of the joint's own encoder: five times what the calibration begins with, and friction
    a third of it."""
    time_s, random = 0.004 * np.arange(12_000), np.random.default_rng(4)
    angle = np.repeat(random.uniform(0.2, 0.8, 12), 1000) * np.sin(2.0 * np.pi * time_s / 2.0)
    speed = np.gradient(angle, time_s)
    torque = 0.05 * np.gradient(speed, time_s) + 0.06 * np.tanh(speed / 0.01) + 0.02 * random.normal(size=len(time_s))
    log = _drawn(time_s, angle, step * np.rint(speed / step), torque)
    stated = _of_a_joint(offset_Nm=0.2)

    def inertia(found):
        return found.calibration.motor.inertia_kg_m2

    found = diagnose([log], stated)
    assert inertia(found) == pytest.approx(0.05, rel=0.1)
    monkeypatch.setattr(residuals, "denoised", lambda samples, turns_free: samples)
    assert inertia(diagnose([log], stated)) < 0.04


@pytest.mark.parametrize("ripple_Hz", [0.0, 57.0, 80.0, 110.0])
def test_a_speed_without_noise_stays_as_it_is(ripple_Hz):
    """Nor is the ripple of a motor that cogs noise: its inertia answers it."""
    time_s = 0.004 * np.arange(3000)
    speed = 30.0 * np.sin(2.0 * np.pi * time_s / 0.5) if not ripple_Hz else 5.0 + np.sin(2.0 * np.pi * ripple_Hz * time_s)
    samples = _drawn(time_s, np.cumsum(speed) * 0.004, speed, 0.0 * time_s + 1.0).samples
    assert denoised(samples, turns_free=False) is samples


@pytest.mark.parametrize("noise_rad_per_s", [0.0, 0.1])
def test_a_free_motor_s_speed_is_smoothed_as_far_as_its_current_needs(noise_rad_per_s):
    """Thrown to and fro it changes by much more than the noise, which is still most of what is left of the current; and
    where nothing but the current's own noise is left, no smoothing is worth its loss."""
    random, time_s = np.random.default_rng(3), 0.004 * np.arange(6000)
    speed = 30.0 * np.sin(2.0 * np.pi * time_s / 0.8)
    current = 1e-3 * np.gradient(speed, time_s) + 0.2 * np.sign(speed) + 0.01 * random.normal(size=len(time_s))
    noisy = speed + noise_rad_per_s * random.normal(size=len(time_s))
    samples = _drawn(time_s, np.cumsum(speed) * 0.004, noisy, current).samples
    assert denoised(samples, turns_free=False) is samples
    smooth = denoised(samples, turns_free=True)
    if noise_rad_per_s:
        left_A, was_A = (1e-3 * np.std(np.diff(rows["speed"] - speed)) / 0.004 for rows in (smooth, samples))
        assert left_A < 0.01 < 0.3 * was_A
    else:
        assert smooth is samples
    samples["has_current"] = False
    assert denoised(samples, turns_free=True) is samples


def test_saturation_takes_half_of_the_constant_at_most_at_the_largest_current_of_the_logs():
    """Where a motor hardly pulls at all, friction over the load looked like iron that saturates at an ampere."""
    stated, *_, fit, _ = _on_a_dynamometer(scatter=0.9, load=1.0)
    bench = Bench([fit], stated)
    largest = np.abs(fit.samples["current_q"]).max()
    assert bench.reach["1/A²"] * largest**2 == pytest.approx(0.5)


@pytest.mark.trial
def test_a_constant_is_not_diluted_where_the_current_turns_the_machine_itself():
    stated, constant, fit, _ = _on_a_dynamometer(scatter=0.9, load=0.1)
    found = diagnose([fit], stated).calibration.motor.torque_constant_Nm_per_A
    assert 0.95 * constant < found < 1.05 * stated.motor.torque_constant_Nm_per_A


def _turned_on_and_on(seed: int, lost=lambda current, speed, made: 0.0):
    """A calibration to begin with, and half a minute of a motor that turns one way; ``lost``: torque (N m) that the load
    lacks by current, speed and what the current makes."""
    stated, constant, *_ = _on_a_dynamometer(scatter=0.0, load=1.0)
    random, time_s = np.random.default_rng(seed), 0.004 * np.arange(8000)
    speed = 150.0 + 40.0 * np.sin(2.0 * np.pi * time_s / 3.0)
    current = 4.0 + 3.0 * np.repeat(random.normal(size=80), 100)
    torque = constant * current - stated.friction.offset_Nm - stated.motor.inertia_kg_m2 * np.gradient(speed, time_s)
    torque -= lost(current, speed, constant * current)
    force = torque / stated.motor.gear_gain_m_per_rad + 100.0 * random.normal(size=8000)
    columns = {"time_s": time_s, "angle_rad": np.cumsum(speed) * 0.004, "current_A": current, "force_N": force}
    return stated, columns, _log(columns, speed_rad_per_s=speed, current_mean_s=0.0)


def test_a_motor_that_turns_on_and_on_is_followed(capsys):
    """Further than our message's angle reaches, in one direction, so that load, friction and constant resemble each other."""
    stated, columns, log = _turned_on_and_on(1)
    assert "MotorAngle covers 4828 rad, more than our message carries" in capsys.readouterr().err
    turns = (log.samples["angle"] - columns["angle_rad"]) / (2.0 * np.pi)
    assert np.abs(turns - np.rint(turns)).max() < 0.001 and set(np.rint(turns)) == {0.0, -534.0}
    found = diagnose([log], stated)
    assert not found.accepted and found.after.rmse("torque") < 0.25 * found.before.rmse("torque")


@pytest.mark.parametrize(
    ("lost", "term", "equation"),
    [
        # In proportion to the current and not to its square, as no effect of the catalogue has it.
        (lambda current, speed, made: 0.15 * made * np.abs(current) / 13.0, "torque_constant:current", r"K_m × \(1 − 0\.1"),
        # Air that a rotor drags along. A torque and a friction over the speed are one where a motor turns one way.
        pytest.param(
            lambda current, speed, made: 0.08 * (speed / 190.0) ** 2,
            "torque:motor_speed",
            r"T_m − 0\.0[78]\d* N·m",
            marks=pytest.mark.trial,
        ),
    ],
)
def test_a_term_is_made_for_a_motor_that_turns_on_and_on(lost, term, equation):
    """Its angle starts anew on the way, and friction would have to drive it, were its drag viscous."""
    stated, _, log = _turned_on_and_on(1, lost)
    found = diagnose([log], stated, [_turned_on_and_on(2, lost)[2]])
    [finding] = found.accepted
    assert finding.effect.name == f"term:{term}" and re.match(equation, finding.effect.equation)
    assert found.after.rmse("torque") < 110.0 < 0.1 * found.before.rmse("torque")


def test_replay_of_a_machine_without_pads_says_what_a_clamp_force_is_not(tmp_path, capsys, stops):
    save_calibration(_on_a_dynamometer(scatter=0.0, load=1.0)[0], tmp_path / "c.yaml")
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    table = foreignkit.write_table(tmp_path / "a.parquet", stops)
    mapping, calibration = str(tmp_path / "mapping.yaml"), str(tmp_path / "c.yaml")
    assert (
        main(["replay", str(table), "--mapping", mapping, "--calibration", calibration, "--report", str(tmp_path / "r.html")])
        == 0
    )
    printed = capsys.readouterr()
    assert f"{calibration}: contact.clearance_rad is 10000 rad, so there is nothing to clamp" in printed.err
    # The load is beside a motor angle that means nothing: an RMSE of the paths would be of no clamp.
    assert "RMSE" not in printed.out and "no reference force to judge by" in (tmp_path / "r.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("turns_on", [True, False])
def test_a_dynamometer_that_writes_forty_rows_a_second_is_judged(turns_on):
    """No force of it belongs to an angle: what counts is that its samples follow its speed. A clamp that moves as fast does
    not follow its angle."""
    stated, constant, *_ = _on_a_dynamometer(scatter=0.0, load=1.0)
    time_s = 0.024 * np.arange(1500)
    stroke = 30.0 * np.sin(2.0 * np.pi * time_s / 2.0)
    speed = 100.0 * (1.0 - np.cos(np.pi * time_s)) if turns_on else np.gradient(stroke, time_s)
    force = 5000.0 * np.sin(0.7 * time_s) + (5000.0 if turns_on else 0.0)
    torque = stated.motor.gear_gain_m_per_rad * force + stated.friction.offset_Nm * np.sign(speed)
    current = (torque + stated.motor.inertia_kg_m2 * np.gradient(speed, time_s)) / constant
    columns = {"time_s": time_s, "angle_rad": np.cumsum(speed) * 0.024, "current_A": current, "force_N": force}
    found = diagnose([_log(columns, speed_rad_per_s=speed, current_mean_s=0.0)], stated)
    assert found.after.rmse("torque") < 0.25 * found.before.rmse("torque")
    with pytest.raises(InputError, match="no sample of it can be judged"):
        diagnose([_log(columns | {"angle_rad": stroke, "force_N": np.abs(force)})], stated)


def test_a_log_too_slow_to_be_judged_is_no_diagnosis_of_nothing():
    stated, *_ = _on_a_dynamometer(scatter=0.0, load=1.0)
    time_s = 0.1 * np.arange(2000)
    angle, force = 20.0 * np.sin(12.0 * time_s), 2000.0 * np.sin(0.7 * time_s)
    log = _log({"time_s": time_s, "angle_rad": angle, "current_A": force / 1000.0, "force_N": force}, current_mean_s=0.0)
    with pytest.raises(InputError, match=r"no sample of it can be judged.* its samples are 100 ms apart"):
        diagnose([log], stated)


def test_the_load_of_a_screw_and_what_breaks_it_come_out_of_its_passes_whatever_its_friction(tmp_path):
    tool, rows = study.tool("cranfield_to_log"), []
    clock = np.arange(0.0, 16.0, 0.04)
    position = np.clip(np.where(clock < 8.0, 20.0 + 24.0 * clock, 140.0 - 24.0 * (clock - 8.0)), 20.0, 140.0)
    direction = np.sign(np.gradient(position))
    # A broken track is passed once a turn; along a stroke the friction changes by much more, but slowly.
    slow = 0.3 * np.sin(0.02 * position)
    ripple = {20: slow + 0.01 * np.cos(2.0 * np.pi * position / 5.0), 40: slow}
    for load in (20, 40):
        # Amperes of supply per kgf of load, and of friction.
        current = tool.STANDSTILL_A + np.where(direction == 0.0, 0.0, 0.6 - direction * 0.005 * load + ripple[load])
        rows += [f"{p},0.0,{i},trap,{load},1,0,1,{t}" for p, i, t in zip(position, current, clock, strict=True)]
    header = "set_point,position_error,current,profile,load,run,fault_type,group,time"
    (tmp_path / "normal.csv").write_text("\n".join([header, *rows]))
    passes = {load: study.passes(part, load) for (load, _), part in tool.read(tmp_path / "normal.csv").items()}
    force = {load: np.average(pairs[:, study.FORCE], weights=pairs[:, study.WEIGHT]) for load, (pairs, *_) in passes.items()}
    constant = tool.NOMINAL_CONSTANT / tool.GEAR_GAIN_M_PER_RAD
    assert force == pytest.approx({load: 0.005 * load * constant for load in (20, 40)}, rel=0.02)
    # Straight lines between values of the table take a tenth of the ripple.
    assert passes[20][2] ** 0.5 == pytest.approx(0.89 * 0.01, rel=0.2) and abs(passes[40][2]) < 0.002**2


@pytest.mark.parametrize(
    ("name", "columns", "sign", "constant"),
    [
        ("embir", "time [s],a1 velocity [rad/s],a1 q-axis [A],trd605-18 torque [Nm],a1 position [rad]", 1.0, 0.0575),
        ("tmotor", "loop_time,motor_measured_speed,motor_measured_current,adc_measured_torque", -1.0, 0.945),
    ],
)
def test_a_run_of_a_test_stand_is_written_whole_and_in_halves(tmp_path, capsys, name, columns, sign, constant):
    tool, out = study.tool(f"{name}_to_log"), tmp_path / "out"
    time_s = 0.01 * np.arange(400)
    speed, current = 20.0 * np.sin(3.0 * time_s), 2.0 * np.cos(time_s)
    table = np.column_stack([time_s, speed, current, 0.9 * current, 20.0 / 3.0 * (1.0 - np.cos(3.0 * time_s))])
    rows = [",".join(map(str, row[: columns.count(",") + 1])) for row in table]
    (tmp_path / "run.csv").write_text("\n".join(["# kt_1 = 0.0575", columns, *rows]))
    assert tool.main([str(tmp_path / "run.csv"), "--output", str(out)]) == 0
    run, first, second = (load_log(out / f"{part}.log") for part in ("run", "first_half", "second_half"))
    assert len(first.samples) == pytest.approx(len(run.samples) / 2, abs=3) == pytest.approx(len(second.samples), abs=3)
    assert first.time_ns[-1] < second.time_ns[0]
    load = sign * 0.9 * 2.0 * np.cos(run.time_s) / tool.GEAR_GAIN_M_PER_RAD
    assert np.nanmax(np.abs(run.force_N - load)[5:]) < 30.0
    assert np.abs(run.samples["speed"] - 20.0 * np.sin(3.0 * run.time_s))[5:-5].max() < 0.5
    started = load_calibration(out / "calibration.yaml")
    assert started.motor.torque_constant_Nm_per_A == constant and started.provenance is None
    assert not started.contact.is_in_reach and started.friction.load_m_per_rad == 0.0
    (tmp_path / "other.csv").write_text("x,y\n0,0\n")
    assert tool.main([str(tmp_path / "other.csv"), "--output", str(out)]) == 2
    assert f"{tmp_path / 'other.csv'}: " in capsys.readouterr().err
