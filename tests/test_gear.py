"""A gear that is not constant: travel over angle from a table, seen by pads, torque, plant and identification."""

from itertools import product

import msgspec
import numpy as np
import pytest
import yaml
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from emb_daemon.adapt.fit import fit_training
from emb_daemon.adapt.records import ACCEPTED, TRAINING
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.parameters import TORQUE_CONSTANT, moved
from emb_daemon.calibration.types import Calibration, Travel, to_parameters
from emb_daemon.errors import InvalidValue
from emb_daemon.estimator.monitor import LEAST_GAIN, MONITOR, MOST_GAIN, bound
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.estimator.status import CONTACT_LOST, CONTACT_UNKNOWN
from emb_daemon.identify.calibration import nominal
from emb_daemon.identify.campaign_file import Datasheet
from emb_daemon.identify.dynamics import Pads, fit_dynamics, starting_point
from emb_daemon.identify.example import FILES
from emb_daemon.identify.steps.torque import fit_torque
from emb_daemon.logs.write import write_frames
from emb_daemon.models.gear import (
    GEAR,
    INTERVALS,
    all_through_gear,
    back_through_gear,
    fill_gear,
    most_of_spring,
    rising_slopes,
    steepest,
    through_gear,
)
from emb_daemon.models.stiffness import characteristic_curve, travel_at
from emb_daemon.offline import estimate, load_log
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.brake import equivalent_angle, motor_angle
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.wire.contract import CYCLE_S
from studies.drives import training

replace = msgspec.structs.replace


def ramp(calibration: Calibration, points: int = 13) -> Calibration:
    """A ball ramp: twice as steep in the clearance as under full force."""
    angle = np.linspace(0.0, 45.0, points)
    travel = 1e3 * calibration.motor.gear_gain_m_per_rad * (0.75 * angle + 0.75 * 12.0 * (1.0 - np.exp(-angle / 12.0)))
    table = Travel(angle_rad=tuple(angle.tolist()), travel_mm=tuple(travel.tolist()))
    return replace(calibration, motor=replace(calibration.motor, travel=table))


@pytest.fixture(scope="module")
def shipped() -> Calibration:
    return shipped_calibration()


def record(calibration: Calibration, path):
    """A log of a brake, random angles and a part of a park, and its truth."""
    plant = plant_from_calibration(calibration, seed=4)
    parked = sc.park(9000.0, 4.0).first(2.5) + sc.rest(1.0)
    schedule = sc.rest(1.0) + sc.random_angle(plant, 12.0, np.random.default_rng(1)) + parked
    frames, truth = sc.simulate_log(plant, schedule, seed=2)
    write_frames(path, frames)
    return load_log(path), truth


@pytest.fixture(scope="module")
def drive(shipped, tmp_path_factory):
    """`record` of the ramp's brake."""
    return record(ramp(shipped, 121), tmp_path_factory.mktemp("gear") / "drive.log")


def torque_over_force(log, calibration: Calibration) -> float:
    """What the torque path makes of the force, in contact, over what it is."""
    found = estimate(log.samples, to_parameters(calibration))["torque_force"]
    loaded = np.isfinite(found) & (log.force_N > 5000.0)
    return float(np.sum(found[loaded] * log.force_N[loaded]) / np.sum(log.force_N[loaded] ** 2))


def test_the_table_is_met_at_its_points_and_rises_between(shipped):
    motor = ramp(shipped).motor
    gear, angle = motor.gear(), np.array(motor.travel.angle_rad)
    turned_rad, _ = all_through_gear(gear, angle)
    assert turned_rad == pytest.approx(1e-3 * np.array(motor.travel.travel_mm) / motor.gear_gain_m_per_rad, abs=2e-3)
    fine = np.linspace(-5.0, 55.0, 2000)
    turned_rad, slopes = all_through_gear(gear, fine)
    assert np.all(slopes > 0.0) and np.gradient(turned_rad, fine)[1:-1] == pytest.approx(slopes[1:-1], rel=2e-3)
    # The slope of the ramp itself, from a dozen points.
    inside = (fine >= 0.0) & (fine <= 45.0)
    assert slopes[inside] == pytest.approx(0.75 * (1.0 + np.exp(-fine[inside] / 12.0)), rel=0.02)
    assert [back_through_gear(gear, x) for x in turned_rad] == pytest.approx(fine, abs=1e-6)
    assert steepest(gear) == pytest.approx((slopes.min(), slopes.max()), rel=1e-3)
    few = ramp(shipped, 4).motor.gear()
    assert np.gradient(few["turned"], few["step"])[1:-1] == pytest.approx(few["slope"][1:-1], rel=3e-3)


def test_a_constant_gear_is_told_to_the_bit_by_its_angle(shipped):
    gear = shipped.motor.gear()
    assert through_gear(gear, 0.1 + 0.2) == (0.1 + 0.2, 1.0) and back_through_gear(gear, 0.7) == 0.7 and gear["step"] == 0.0


def test_a_straight_table_is_a_constant_gear(shipped, drive):
    angle = (0.0, 10.0, 30.0, 60.0)
    mm = tuple(1e3 * shipped.motor.gear_gain_m_per_rad * a for a in angle)
    straight = replace(shipped, motor=replace(shipped.motor, travel=Travel(angle_rad=angle, travel_mm=mm)))
    log, _ = drive
    constant, table = (estimate(log.samples, to_parameters(c)) for c in (shipped, straight))
    for name in ("force", "sigma", "torque_force", "contact_angle", "contact_sigma"):
        assert table[name] == pytest.approx(constant[name], rel=1e-6, abs=1e-4, nan_ok=True), name


def test_the_estimate_follows_a_ramp_by_its_datasheet(shipped, drive):
    log, truth = drive
    found = estimate(log.samples, to_parameters(ramp(shipped)))
    error = found["force"] - log.force_N
    assert np.sqrt(np.mean(error**2)) < 0.003 * shipped.stiffness.maximum_force_N
    assert np.mean(np.abs(error) < 2.0 * np.hypot(found["sigma"], 25.0)) > 0.93
    assert torque_over_force(log, ramp(shipped)) == pytest.approx(1.0, abs=0.03)
    assert torque_over_force(log, shipped) < 0.92
    assert found["contact_angle"][-1] == pytest.approx(truth["contact_angle"][-1, 0], abs=0.1)


def test_curve_and_torque_path_are_identified_through_the_gear(shipped, drive):
    log, _ = drive
    sheet = msgspec.convert(yaml.safe_load((FILES / "datasheet.yaml").read_text()), Datasheet)
    start = ramp(nominal(sheet, "ramp", 10.0, [10.0]))
    torque = fit_torque([log], start, sheet)
    motor, noise = shipped.motor, shipped.noise
    from_speed = np.sqrt(2.0) * motor.inertia_kg_m2 * noise.speed_rad_per_s / CYCLE_S / motor.torque_constant_Nm_per_A
    assert torque.rms_A < 1.05 * np.hypot(noise.current_A, from_speed)
    assert torque.values[TORQUE_CONSTANT] == pytest.approx(motor.torque_constant_Nm_per_A, rel=0.02)
    # A constant gear takes the ramp's slope for another motor, and leaves more current over.
    screw = fit_torque([log], nominal(sheet, "screw", 10.0, [10.0]), sheet)
    assert screw.rms_A > 1.1 * torque.rms_A
    assert screw.values[TORQUE_CONSTANT] > 1.05 * motor.torque_constant_Nm_per_A
    curve = fit_dynamics([Pads(10.0, (log,))], starting_point([Pads(10.0, (log,))], start)).curves[0]
    x = np.array([4.0, 8.0, 12.0])
    expected = [characteristic_curve(at, to_parameters(shipped)["curve"])[0] for at in x]
    assert curve.force(x) == pytest.approx(expected, rel=0.02)
    assert curve.clearances_rad == pytest.approx([shipped.contact.clearance_rad], abs=0.1)


def test_a_release_spring_takes_torque_and_is_no_clamp_force(shipped, tmp_path):
    sprung = replace(shipped, motor=replace(shipped.motor, release_spring_N_per_m=3e6))
    log, _ = record(sprung, tmp_path / "sprung.log")
    assert torque_over_force(log, sprung) == pytest.approx(1.0, abs=0.03)
    assert torque_over_force(log, shipped) > 1.15
    found = estimate(log.samples, to_parameters(sprung))
    assert np.mean(np.abs(found["force"] - log.force_N) < 2.0 * np.hypot(found["sigma"], 25.0)) > 0.93


def test_a_released_brake_is_known_at_once_however_strong_its_release_spring(shipped, tmp_path):
    """There it is relaxed: half of what it may take is no torque of a motor that stands."""
    motor = replace(shipped.motor, release_spring_N_per_m=6e6)
    sprung = replace(shipped, motor=motor, friction=replace(shipped.friction, offset_Nm=0.02))
    half_Nm = 0.5 * motor.gear_gain_m_per_rad * most_of_spring(to_parameters(sprung))
    assert half_Nm > 0.02 + 0.05 * motor.gear_gain_m_per_rad * sprung.stiffness.maximum_force_N
    plant = plant_from_calibration(sprung, seed=3)
    write_frames(tmp_path / "a.log", sc.simulate_log(plant, sc.rest(2.0) + sc.park(15e3, 4.0), seed=4)[0])
    log = load_log(tmp_path / "a.log")
    found = estimate(log.samples, to_parameters(sprung))
    # Until the controller's status comes the contact is unknown, and with it the spring.
    first = int(np.argmax(log.samples["has_status"]))
    unknown = found["facts"] & (CONTACT_UNKNOWN | CONTACT_LOST) != 0
    assert unknown[:first].any() and not unknown[first + 50 :].any()
    clamped = log.force_N > 500.0
    assert np.mean(np.abs(found["force"] - log.force_N)[clamped] < 2.0 * np.hypot(found["sigma"], 25.0)[clamped]) > 0.9


def test_the_most_that_a_release_spring_takes_is_at_full_clamp(parameters):
    """30 N/mm over the way from the released position."""
    p = parameters[0]
    assert most_of_spring(p) == 0.0
    p["spring"], way_rad = 30e3, p["clearance"] + travel_at(p["maximum_force"], p["curve"])
    assert most_of_spring(p) == pytest.approx(30e3 * p["gear_gain"] * way_rad)


@pytest.mark.parametrize("spring", [0.0, 5e6])
def test_a_start_in_contact_leaves_the_gears_slope_open(shipped, tmp_path, spring):
    """At full force the ramp is a third flatter than where the table begins."""
    brake = replace(shipped, motor=replace(shipped.motor, release_spring_N_per_m=spring))
    plant = plant_from_calibration(ramp(brake, 121), seed=4)
    write_frames(tmp_path / "a.log", sc.simulate_log(plant, sc.rest(1.0) + sc.park(27e3, 6.0), seed=2)[0])
    log = load_log(tmp_path / "a.log")
    rows = slice(int(np.argmax(log.force_N > 26e3)), None)
    samples, force_N = log.samples[rows][:200].copy(), log.force_N[rows][:200]
    samples["park_brake"], samples["brake_request"], samples["has_status"] = 0.0, 1.0, True
    found = estimate(samples, to_parameters(ramp(brake)))
    assert np.mean(np.abs(found["force"] - force_N) < 2.0 * found["sigma"]) > 0.95


def test_the_monitors_bounds_hold_the_force_wherever_the_gear_may_be(shipped):
    motor = replace(ramp(shipped).motor, release_spring_N_per_m=5e6)
    p = to_parameters(replace(shipped, motor=motor))
    m = np.zeros(1, SAMPLE)
    m["dt"], m["has_current"], m["has_status"] = 0.004, True, True
    # While the motor opens, friction takes no torque, and while it closes, it holds no force.
    for slope, spring, gain, speed in product(
        steepest(p["gear"]), (0.0, most_of_spring(p)), (LEAST_GAIN, MOST_GAIN), (-10.0, 10.0)
    ):
        w = np.zeros(1, MONITOR)
        m["current_q"] = p["gear_gain"] * slope * (10e3 + spring) / (gain * p["torque_constant"])
        m["speed"] = speed
        for _ in range(300):
            bound(w[0], p, m[0], 1.0)
        assert w["low"][0] < 10e3 < w["high"][0], (slope, spring, gain, speed)


def test_a_training_is_learned_from_through_the_gear(shipped, tmp_path):
    sprung = replace(shipped, motor=replace(shipped.motor, release_spring_N_per_m=1e6))
    plant = plant_from_calibration(ramp(sprung, 121), pad_thickness_mm=8.0)
    path = tmp_path / "training.log"
    write_frames(path, sc.simulate_log(plant, sc.rest(1.0) + training(plant, 42.0, 19e3), seed=3)[0])
    log, calibration, state = load_log(path), ramp(sprung), new_state()
    before = estimate(log.samples, to_parameters(calibration), state)["stiffness_force"]
    rows = np.zeros(len(log.samples), TRAINING)
    for name in set(TRAINING.names) & set(log.samples.dtype.names):
        rows[name] = log.samples[name]
    rows["factor"] = 1.0
    found = fit_training(rows, calibration, calibration, state[0])
    assert found.outcome == ACCEPTED and found.evidence["pairs_difference"] < 0.015
    after = estimate(log.samples, to_parameters(moved(calibration, found.values)))["stiffness_force"]
    assert np.std(after - log.force_N) < 0.3 * np.std(before - log.force_N)


def test_the_brakes_motor_finds_its_way_back_through_the_gear(shipped):
    plant = plant_from_calibration(ramp(shipped))
    for x in (0.5, 7.0, 20.0, 33.0):
        assert equivalent_angle(plant, motor_angle(plant, x)) == pytest.approx(x, rel=1e-9)
    assert sc.angle_at(plant, 10e3) != pytest.approx(sc.angle_at(plant_from_calibration(shipped), 10e3), rel=0.03)


@pytest.mark.parametrize(
    ("angle", "mm", "says"),
    [
        ((0.0, 10.0, 10.0, 60.0), (0.0, 0.4, 0.8, 2.4), r"angle_rad\[2\]: 10 after 10"),
        ((0.0, 10.0, 20.0, 60.0), (0.0, 0.4, 0.3, 2.4), r"travel_mm\[2\]: 0.3 after 0.4"),
        ((1.0, 10.0, 20.0), (0.0, 0.4, 0.8), "angle_rad: expected the released position"),
        ((0.0, 10.0), (0.0, 0.4), "three points"),
        ((0.0, 10.0, 20.0), (0.0, 0.4), "3 angle_rad and 2 travel_mm"),
        ((0.0, 10.0, 60.0), (0.0, 4.0, 24.0), "gear_gain_m_per_rad: 3.98e-05 is not a mean slope of travel"),
        ((0.0, 10.0, 20.0), (0.0, 0.398, 0.796), "motor.travel: ends at 0.796 mm; clearance and the largest force"),
    ],
)
def test_a_table_that_is_none_is_refused_in_words(shipped, angle, mm, says):
    with pytest.raises(InvalidValue, match=says):
        travel = Travel(angle_rad=angle, travel_mm=mm)
        data = msgspec.to_builtins(replace(shipped, motor=replace(shipped.motor, travel=travel)))
        try:
            msgspec.convert(data, Calibration)
        except msgspec.ValidationError as error:
            raise InvalidValue(str(error)) from None


def test_a_travel_table_is_the_monotone_cubic_through_its_points():
    """Of scipy, which has the same slopes but where the curve bends so much at an end that it would fall there."""
    x, y = np.array([0.0, 3.0, 10.0, 12.0, 30.0, 41.0]), np.array([0.0, 3.5, 9.0, 10.0, 24.0, 35.0])
    assert rising_slopes(x, y) == pytest.approx(PchipInterpolator(x, y).derivative()(x), rel=1e-12)
    bent = np.array([0.0, 0.03, 9.0, 10.0, 24.0, 24.1])
    slopes = rising_slopes(x, bent)
    assert slopes[1:-1] == pytest.approx(PchipInterpolator(x, bent).derivative()(x)[1:-1], rel=1e-12)
    assert slopes[[0, -1]] == pytest.approx([0.1 * 0.01, 0.1 * 0.1 / 11.0])
    gear = np.zeros(1, GEAR)[0]
    fill_gear(gear, x, y)
    nodes, table = np.linspace(0.0, 41.0, INTERVALS + 1), CubicHermiteSpline(x, y, rising_slopes(x, y))
    assert gear["turned"] == pytest.approx(table(nodes), rel=1e-12)
    assert gear["slope"] == pytest.approx(table.derivative()(nodes), rel=1e-12)


def test_between_its_nodes_a_gear_is_cubic_and_beyond_them_straight_and_there_is_one_way_back(shipped):
    gear = ramp(shipped).motor.gear()
    nodes = gear["step"] * np.arange(INTERVALS + 1)
    cubic, angles = CubicHermiteSpline(nodes, gear["turned"], gear["slope"]), np.linspace(0.0, nodes[-1], 700)
    turned_rad, slopes = all_through_gear(gear, angles)
    assert turned_rad == pytest.approx(cubic(angles), rel=1e-12) and slopes == pytest.approx(
        cubic.derivative()(angles), rel=1e-9
    )
    for way, end in ((-3.0, 0), (5.0, -1)):
        beyond = nodes[end] + way
        expected = gear["turned"][end] + way * gear["slope"][end]
        assert through_gear(gear, beyond) == pytest.approx((expected, gear["slope"][end]))
        assert back_through_gear(gear, expected) == pytest.approx(beyond)
