"""Sensors that lie: which path is named, how soon, what sigma says meanwhile, and that good brakes raise no alarm.

The brake is the simulated one, not the estimator's own model.
"""

import city
import msgspec
import numpy as np
import pytest
from city import BEFORE_RELEASE, CLAMPING, HOLDING, RELEASED, drive, estimated

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.status import TORQUE_OLD
from emb_daemon.offline import estimate, log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import accelerate, rest, simulate_log, stop
from emb_daemon.wire import contract as r

_LASTING = 500


def _with(begin, change):
    """Estimates and true force of the drive whose samples from ``begin`` for two seconds went through ``change``."""
    return city.changed(lambda samples: change(samples[begin : begin + _LASTING]))


def _freeze(*names):
    def change(rows):
        for name in names:
            rows[name] = rows[name][0]

    return change


def _current(offset_A):
    def change(rows):
        rows["current_q"] += offset_A

    return change


def _no_current(rows):
    rows["current_q"] = 0.0


def _alarm(estimates):
    return np.flatnonzero(estimates["reasons"] & r.PATHS_DISAGREE)


def _honest(estimates, force, rows, sigmas=4.0):
    error = np.abs(estimates["force"] - force)[rows]
    return np.all(error < sigmas * estimates["sigma"][rows])


def _recovered(estimates, force):
    """Everything fused again, nothing raised, the force right in the end."""
    last = slice(-100, None)
    return (
        np.all(estimates["source"][last] == r.FUSED)
        and not estimates["reasons"][last].any()
        and _honest(estimates, force, last)
    )


@pytest.mark.parametrize("seed", range(4))
def test_no_alarm_on_a_good_brake(seed):
    """Units that scatter about their calibration."""
    samples, _ = drive(seed)
    estimates = estimated(samples)
    assert not len(_alarm(estimates)) and not np.any(estimates["reasons"] & r.STUCK)


@pytest.mark.parametrize(("rise", "seed"), [(0.9, 0), (1.5, 1), (1.2, 2)])
def test_breakaway_friction_that_the_calibration_knows_holds_a_motor_that_stands(rise, seed):
    """Twice the sliding one and more: without it the torque of a held brake is beyond what friction at rest can carry."""
    calibration = shipped_calibration()
    known = {"stribeck_friction": {"rise": rise, "speed_rad_per_s": 6.0}} | calibration.effects
    friction = msgspec.structs.replace(calibration.friction, load_m_per_rad=1.3 * calibration.friction.load_m_per_rad)
    calibration = msgspec.structs.replace(calibration, friction=friction, effects=known)
    stops = accelerate(12.0, 4.0) + stop(7000.0, 4.0) + accelerate(18.0, 5.0) + stop(16000.0, 5.0)
    frames, _ = simulate_log(plant_from_calibration(calibration, seed), rest(1.0) + stops, seed=seed)
    log = log_of(frames)
    estimates = estimate(log.samples, to_parameters(calibration))
    assert not len(_alarm(estimates)) and _honest(estimates, log.force_N, slice(25, None))
    assert np.all(estimates["source"][25:] == r.FUSED) and np.median(estimates["sigma"][log.force_N > 2000.0]) < 200.0


@pytest.mark.parametrize("begin", [CLAMPING, HOLDING, BEFORE_RELEASE])
def test_dead_current_is_named_and_stiffness_goes_on(begin):
    """A current that repeats while the motor is clamped: Stuck within a twentieth of a second, StiffnessOnly, and the force
    is as
    good as ever."""
    estimates, force = _with(begin, _no_current)
    alarm, stuck = _alarm(estimates), np.flatnonzero(estimates["reasons"] & r.STUCK)
    assert begin < alarm[0] and alarm[0] <= stuck[0] < begin + 13
    assert np.array_equal(stuck, np.arange(stuck[0], begin + _LASTING))
    assert np.all(estimates["source"][stuck] == r.STIFFNESS_ONLY) and np.all(estimates["mode"][alarm] == r.DEGRADED)
    assert _honest(estimates, force, slice(begin, None)) and _recovered(estimates, force)
    assert np.sqrt(np.mean((estimates["force"] - force)[stuck] ** 2)) < 100.0


def _limited(share):
    def change(rows):
        limit = share * np.abs(rows["current_q"]).max()
        rows["current_q"] = np.clip(rows["current_q"], -limit, limit)

    return change


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_current_sensor_that_goes_no_further_is_not_believed_there(share):
    """What it then shows is the least that flows. Once a stroke has shown it for 20 ms, no sample of it is used, and the
    force stays right."""
    estimates, force = city.changed(_limited(share), seconds=40.0)
    samples, _ = drive(0, 40.0)
    clipped = np.flatnonzero(np.abs(samples["current_q"]) > share * np.abs(samples["current_q"]).max())
    found = np.flatnonzero(estimates["reasons"] & r.STUCK)[0]
    later = clipped[clipped >= found]
    assert len(later) > 20 and np.all(estimates["source"][later] == r.STIFFNESS_ONLY)
    assert np.all(estimates["reasons"][later] & r.STUCK) and np.all(estimates["reasons"][later] & r.PATHS_DISAGREE)
    assert _honest(estimates, force, slice(25, None))
    assert np.sqrt(np.mean((estimates["force"] - force)[25:] ** 2)) < 100.0


def test_a_healthy_current_has_no_limit():
    """However often a motor is held where its current is the largest."""
    samples, _ = drive(0, 40.0)
    assert not np.any(estimated(samples)["reasons"] & r.STUCK)


def test_a_coarse_current_that_repeats_costs_no_accuracy():
    """Counts of 1 A, of two standard deviations of its noise, seem to show a limit again and again; were the stroke forgotten
    each time, 41 N and up to 0.7 kN were left."""

    def coarse(rows):
        rows["current_q"] = np.round(rows["current_q"])

    estimates, force = city.changed(coarse, seed=3, seconds=60.0)
    error = (estimates["force"] - force)[25:]
    assert np.sqrt(np.mean(error**2)) < 35.0 and np.max(np.abs(error)) < 300.0


@pytest.mark.parametrize("offset_A", [-4.0, 4.0])
def test_current_with_an_offset_is_detected(offset_A):
    """4 A too much or too little under load, 5 kN of the torque path, for two seconds: said within a tenth of a second,
    covered
    by sigma as long as nothing tells which path is wrong, and over once the clearance has told."""
    begin = HOLDING
    estimates, force = _with(begin, _current(offset_A))
    alarm = _alarm(estimates)
    assert begin < alarm[0] < begin + 25 and len(alarm) > 400 and not np.any(estimates["reasons"] & r.STUCK)
    assert np.all(estimates["mode"][alarm] == r.DEGRADED)
    assert _honest(estimates, force, slice(begin, None)) and _recovered(estimates, force)
    after = slice(begin + _LASTING, None)
    assert np.sqrt(np.mean((estimates["force"] - force)[2250:] ** 2)) < 100.0, "the torque path takes the blame"
    assert _honest(estimates, force, after, 3.5)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("begin", [0, HOLDING, 2300])
@pytest.mark.parametrize("offset_A", [-6.0, -4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0, 6.0])
def test_a_lasting_offset_of_the_current_is_covered_or_said(offset_A, begin, seed):
    """From power-on, under load, or from the second clearance on: at every tick the force is within three sigma, a model's
    rare outlier aside, or the status says that it is degraded."""
    samples, force = drive(seed)
    samples = samples.copy()
    samples["current_q"][begin:] += offset_A
    estimates = estimated(samples)
    beyond = np.abs(estimates["force"] - force) / estimates["sigma"] * (estimates["reasons"] == 0)
    assert np.all(beyond < 4.0) and np.mean(beyond > 3.0) < 0.002


@pytest.mark.parametrize("offset_A", [-1.0, 1.0])
def test_an_offset_from_power_on_is_learned_in_the_clearance(offset_A):
    """Of an ordinary current sensor: the first stroke shows it before the pads touch, and the force is as good as without."""
    samples, force = drive()
    good = estimated(samples)
    samples = samples.copy()
    samples["current_q"] += offset_A
    estimates = estimated(samples)
    clamped = force > 2000.0
    assert np.abs(estimates["force"] - good["force"])[clamped].max() < 0.5 * good["sigma"][clamped].min()
    assert np.all(np.abs(estimates["sigma"] / good["sigma"] - 1.0)[clamped] < 0.1)
    assert not np.any(estimates["reasons"][clamped])


@pytest.mark.parametrize("offset_A", [-6.0, -2.0, 2.0, 6.0])
def test_a_large_offset_at_power_on_may_be_a_clamped_brake(offset_A):
    """A released motor needs none of it: the contact is unknown until the brake has stood released for a second. Then it is an
    offset, said as long as it lasts if no healthy sensor has it."""
    samples, force = drive()
    samples = samples.copy()
    samples["current_q"] += offset_A
    estimates = estimated(samples)
    unknown = slice(30, 240)
    assert np.all(estimates["reasons"][unknown] & r.CONTACT_UNCERTAIN) and np.all(
        estimates["source"][unknown] == r.TORQUE_ONLY
    )
    assert _honest(estimates, force, slice(30, None), 4.0)
    clamped = force > 2000.0
    if abs(offset_A) < 3.0:
        assert np.all(estimates["source"][clamped] == r.FUSED)
        assert np.sqrt(np.mean((estimates["force"] - force)[clamped] ** 2)) < 100.0
    else:
        assert np.all(estimates["reasons"][clamped] & r.PATHS_DISAGREE)


@pytest.mark.parametrize("names", [("angle", "speed"), ("angle",)])
@pytest.mark.parametrize("begin", [CLAMPING, BEFORE_RELEASE])
def test_stuck_resolver_is_named_and_torque_goes_on(begin, names):
    """Frozen while the motor turns: TorqueOnly within 60 ms of motion, with the sigma of torque that knows no direction."""
    samples, force = drive()
    estimates, _ = _with(begin, _freeze(*names))
    turned = np.abs(samples["angle"] - samples["angle"][begin]) > 0.6
    moved = begin + np.argmax(turned[begin:])
    named = begin + np.argmax(estimates["source"][begin:] == r.TORQUE_ONLY)
    assert begin < named < moved + 15
    during = slice(named, begin + _LASTING)
    assert np.all(estimates["source"][during] == r.TORQUE_ONLY) and np.all(estimates["reasons"][during] & r.STUCK)
    assert not np.any(estimates["facts"][during] & TORQUE_OLD)
    assert _honest(estimates, force, during) and np.median(estimates["sigma"][during]) > 500.0
    assert _recovered(estimates, force)


@pytest.mark.parametrize("flicker", [0.0, 1e-3])
def test_resolver_that_has_slipped_on_its_shaft_is_covered_as_soon_as_the_motor_must_turn(flicker):
    """Angle and speed of a rotor that stands, with their noise: the torque that releases a held brake accelerates its motor,
    and no more than 80 ms of force are beyond four sigma before that is said."""

    def slip(rows):
        rng = np.random.default_rng(3)
        rows["angle"] = rows["angle"][0] + flicker * rng.standard_normal(len(rows))
        rows["speed"] = 0.35 * rng.standard_normal(len(rows))

    estimates, force = _with(BEFORE_RELEASE, slip)
    during = slice(BEFORE_RELEASE, BEFORE_RELEASE + _LASTING)
    beyond = np.abs(estimates["force"] - force)[during] > 4.0 * estimates["sigma"][during]
    assert np.abs(estimates["stiffness_force"] - force)[during].max() > 3000.0
    assert beyond.sum() <= 20
    assert np.any(estimates["reasons"][during] & r.PATHS_DISAGREE) and _recovered(estimates, force)


@pytest.mark.parametrize(("times", "wheel_turns", "stuck"), [(2.9, False, False), (3.25, True, False), (3.25, False, True)])
def test_a_torque_that_friction_or_an_uneven_disc_may_hold_swings_beside_a_standing_angle(times, wheel_turns, stuck):
    """Once a second, by so many ``times`` the dry friction to either side. Breakaway takes 1.3 of it, what friction may be
    beyond its calibration up to 2.9; a disc that turns may be uneven and carry some more."""
    calibration = shipped_calibration()
    dry_A = calibration.friction.offset_Nm / calibration.motor.torque_constant_Nm_per_A

    def swing(samples):
        held = samples[HOLDING:BEFORE_RELEASE]
        held["angle"] = held["angle"][0]
        held["current_q"] += times * dry_A * np.sin(2.0 * np.pi * 0.004 * np.arange(len(held)))
        if not wheel_turns:
            samples["wheel_speed"] = 0.0

    estimates, _ = city.changed(swing)
    assert np.any(estimates["reasons"][HOLDING:BEFORE_RELEASE] & r.STUCK) == stuck


def _repeated_with_noise(count, speed):
    """Estimates of one sample again and again, with a speed, and noise of the current alone."""
    rows = np.repeat(drive()[0][RELEASED : RELEASED + 1], count)
    rows["dt"], rows["speed"] = 0.004, speed
    rows["current_q"] = np.random.default_rng(1).normal(0.0, 0.3, count)
    return estimated(rows)


def test_resolver_that_stands_still_with_noise_is_no_fault():
    """A motor at rest may read the same angle for ever, as long as its speed reads zero."""
    estimates = _repeated_with_noise(600, 0.0)
    assert not np.any(estimates["reasons"] & (r.STUCK | r.PATHS_DISAGREE))


def test_resolver_that_flickered_and_repeats_is_stuck():
    """Speed noise of a motor at rest does not repeat: twelve samples, also while no torque tells."""
    estimates, force = _with(RELEASED, _freeze("angle", "speed"))
    stuck = np.flatnonzero(estimates["reasons"] & r.STUCK)
    assert RELEASED + 10 < stuck[0] < RELEASED + 15 and np.all(estimates["source"][stuck] == r.TORQUE_ONLY)
    assert _honest(estimates, force, slice(RELEASED, None)) and _recovered(estimates, force)


def test_resolver_that_never_flickered_and_repeats_a_speed_is_stuck():
    """From power-on: nothing is known of its noise, so it takes fifty samples of a speed that is not zero."""
    estimates = _repeated_with_noise(200, 0.7)
    stuck = np.flatnonzero(estimates["reasons"] & r.STUCK)
    assert 45 < stuck[0] < 55 and np.all(estimates["source"][stuck] == r.TORQUE_ONLY)


def test_stuck_resolver_and_no_current_leaves_nothing():
    def both(rows):
        _freeze("angle", "speed")(rows)
        rows["has_current"] = False

    estimates, force = _with(CLAMPING, both)
    dead = slice(CLAMPING + 60, CLAMPING + _LASTING)
    assert np.all(estimates["source"][dead] == r.INVALID) and np.all(estimates["mode"][dead] == r.FAULT)
    assert np.all(estimates["reasons"][dead] & r.STUCK) and np.all(estimates["reasons"][dead] & r.PATHS_DISAGREE)
    assert _recovered(estimates, force)


def test_a_current_that_is_lost_where_only_the_torque_was_left_leaves_nothing():
    """After a power-on with a large offset, before the brake was seen released; a sender that doubts its current counts as
    lost."""
    samples, _ = drive()
    samples = samples.copy()
    samples["current_q"] += 6.0
    samples["has_current"][100:150] = False
    estimates = estimated(samples)
    assert np.all(estimates["source"][90:100] == r.TORQUE_ONLY) and np.all(estimates["source"][113:150] == r.INVALID)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_speed_that_becomes_noisy_counts_as_such(seed):
    """Eight times as noisy: a motor that stands shows it, and what inertia would then make of the torque is no news."""
    noise = 8.0 * shipped_calibration().noise.speed_rad_per_s

    def change(rows):
        rows["speed"][RELEASED:] += noise * np.random.default_rng(seed).standard_normal(len(rows) - RELEASED)

    estimates, force = city.changed(change, seed, 40.0)
    error = np.abs(estimates["force"] - force)[25:]
    assert np.mean(error > 3.0 * np.hypot(estimates["sigma"][25:], 25.0)) < 0.01
    assert np.sqrt(np.mean(error**2)) < 150.0
