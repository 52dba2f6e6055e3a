"""The simulated brake and car: physics that must hold whatever the parameters, and promises to those who test with it."""

import numpy as np
import pytest

from emb_daemon.calibration.types import to_parameters
from emb_daemon.cli.main import main
from emb_daemon.effects import REGISTRY
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.logs.columns import Decoder
from emb_daemon.offline import estimate, log_of
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant import scenarios
from emb_daemon.plant.brake import move_motor, static_curve
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.heat import cell_count, heat_cycle
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.records import EFFECTS, FORCE, LATCH, PLANT_STATE, SUBSTEP_S
from emb_daemon.runtime.rawcan import socket_pair
from emb_daemon.wire.contract import CYCLE_S, PARK_APPLIED, PARK_RELEASED
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import ADAPT_REQUEST, CORNERS, default_layout, pack
from emb_daemon.wire.receive import ACCEPTED
from studies import drives

#: Parameters at which each effect must show.
VISIBLE = {
    "disc_thickness_variation": {"order_1_cosine_um": 15.0},
    "disc_thermal_expansion": {"growth_um_per_K": 0.3},
    "pad_wear": {"wear_um_per_MJ": 50.0},
    "torque_constant_fade": {"fade_per_K": 0.0012, "disc_share": 0.3},
    "torque_saturation": {"loss_per_A2": 1e-4},
    "motor_heat_fade": {"fade_per_A2": 4e-5, "time_constant_s": 20.0},
    "current_offset": {"offset_A": 0.5},
    "viscous_friction": {"viscous_Nms_per_rad": 3e-4},
    "stribeck_friction": {"rise": 0.5, "speed_rad_per_s": 5.0},
    "friction_asymmetry": {"asymmetry": 0.2},
    "gear_mesh_ripple": {"cosine": 0.05, "order_per_turn": 3.0},
    "cogging_torque": {"sine_Nm": 0.01, "order_per_turn": 6.0},
    "stiffness_hysteresis": {"share": 0.06, "slip_angle_rad": 1.0},
    "second_hysteresis": {"share": 0.05, "slip_angle_rad": 0.3},
    "second_relaxation": {"share": 0.2, "time_constant_s": 1.0},
    "third_relaxation": {"share": 0.1, "time_constant_s": 6.0},
    "stress_relaxation": {"share": 0.05, "time_constant_s": 0.3},
    "slow_stress_relaxation": {"share": 0.05, "time_constant_s": 6.0},
    "signal_delay": {"delay_s": 0.003},
    "backlash": {"play_rad": 0.2},
    "friction_coefficient_fade": {"fade_per_K": 0.003, "onset_C": 30.0},
    "disc_radiation": {"area_m2": 0.3},
    "thermocouple_lag": {"lag_s": 10.0},
    "clamp_creep": {"share": 0.05, "time_constant_s": 30.0},
    "brake_torque_coupling": {"per_Nm": 5e-5},
    "caliper_softening": {"per_K": 0.01},
    "spindle_lead_error": {"amplitude_um": 10.0, "order_per_turn": 0.3},
    "cold_grease": {"per_K": 0.05},
    "fastest_closing": {"share": 0.03, "exponent": 1.0, "recovery_s": 20.0},
    "current_delay": {"delay_s": 0.004 / 3.0},
    "drawn_stiffness": {"size": 0.05, "signal": 0, "exponent": 0.7, "other": -1, "lag_s": 2.0},
    "drawn_thickness": {"size": 10.0, "signal": 1, "exponent": 1.5, "other": -1},
    "drawn_torque_constant": {"size": -0.05, "signal": 5, "exponent": 2.0, "other": -1},
    "drawn_gear_friction": {"size": 0.3, "signal": 4, "exponent": 0.5, "other": 3},
    "drawn_gear_gain": {"size": 0.05, "signal": 3, "shape": 2, "other": -1},
    "drawn_pad_friction": {"size": -0.3, "signal": 9, "shape": 1, "other": -1},
    "drawn_contact_conductance": {"size": 1.0, "signal": 3, "exponent": 1.0, "other": -1},
    "drawn_gap_conductance": {"size": 5.0, "signal": 1, "exponent": 1.0, "other": -1},
    "drawn_disc_cooling": {"size": 2.0, "signal": 7, "exponent": 1.0, "other": -1},
    "drawn_heat_share": {"size": 1.0, "signal": 9, "exponent": 1.0, "other": -1},
    "drawn_disc_heat": {"size": 500.0, "signal": 7, "exponent": 1.0, "other": -1},
    "drawn_pad_conductivity": {"size": 0.5, "signal": 3, "exponent": 1.0, "other": -1},
}


@pytest.fixture(scope="module")
def bare(calibration):
    """A plant that is the calibration's own unit, without any effect."""
    return plant_from_calibration(calibration, effects={name: {} for name in calibration.effects})


@pytest.fixture(scope="module")
def driven(calibration):
    """A city drive of one corner: plant, frames, truth."""
    plant = plant_from_calibration(calibration, seed=5)
    return plant, *scenarios.simulate_log(plant, scenarios.city_drive(), seed=7)


def same(a, b):
    """Equal in every field; the padding between fields means nothing."""
    return len(a) == len(b) and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a.dtype.names)


def settled(car, mode, target, seconds):
    standing = scenarios.rest(CYCLE_S)
    standing.commands["mode"], standing.commands["target"] = mode, target
    for _ in range(round(seconds / CYCLE_S)):
        car.tick(standing.commands, standing.drives[0])
    return car


def test_equal_seeds_give_equal_logs(calibration, driven):
    plant, frames, truth = driven
    again, truth_again = scenarios.simulate_log(plant, scenarios.city_drive(), seed=7)
    assert same(again, frames)
    assert same(truth_again, truth)
    other, _ = scenarios.simulate_log(plant, scenarios.city_drive(), seed=8)
    assert not same(other, frames)
    assert plant_from_calibration(calibration, seed=5).tobytes() == plant.tobytes()
    assert plant_from_calibration(calibration, seed=6).tobytes() != plant.tobytes()


@pytest.mark.parametrize("force", [500.0, 4000.0, 20000.0])
def test_held_angle_settles_on_the_characteristic_curve(bare, force):
    car = Car(np.atleast_1d(bare))
    settled(car, 1, scenarios.angle_at(bare, force), 3.0)
    state = car.states[0]
    x = state["angle"] - bare["contact_angle"]
    static = np.polyval([*bare["curve"][::-1], 0.0], x)
    assert state["force"] == pytest.approx(static, rel=1e-3)
    assert static == pytest.approx(force, rel=0.02)


@pytest.mark.parametrize("force", [300.0, 3000.0, 25000.0])
def test_force_controller_brings_the_true_force(bare, force):
    car = settled(Car(np.atleast_1d(bare)), FORCE, force, 3.0)
    # The controller leaves 20 N and half a percent alone, lest it hunt.
    assert abs(car.states[0]["force"] - force) < 22.0 + 0.006 * force
    assert abs(car.states[0]["speed"]) < 0.05


def test_pads_that_lose_contact_do_not_pull(calibration):
    """The force that pads lose to relaxation while they are held is missing when they are released."""
    effects = {name: {} for name in calibration.effects} | {"clamp_creep": {"share": -0.1, "time_constant_s": 5.0}}
    plant = plant_from_calibration(calibration, effects=effects)
    schedule = drives.rig_stop(8000.0, 0.0, 5.0, 6.0)
    _, truth = scenarios.simulate_log(plant, schedule, seed=1)
    assert truth["force"].max() > 7000.0 and truth["force"].min() >= 0.0


def test_motor_work_becomes_motion_friction_and_clamping(bare):
    car = Car(np.atleast_1d(bare))
    schedule = scenarios.random_angle(bare, 5.0, np.random.default_rng(0))
    car.run(schedule.commands[:, None], schedule.drives)
    state = car.states[0]
    kinetic = 0.5 * bare["inertia"] * state["speed"] ** 2
    spent = kinetic + state["friction_loss"] + state["clamp_work"]
    assert state["motor_work"] > 1.0
    assert spent == pytest.approx(state["motor_work"], rel=1e-6)
    assert state["friction_loss"] > 0.1 * state["motor_work"]


def test_hysteresis_takes_energy_in_a_slow_stroke(calibration):
    """Per stroke 2 h times the work of clamping once; slowly, because the thesis's lag gives energy back when fast."""
    share = 0.05
    off = {name: {} for name in calibration.effects}
    plant = plant_from_calibration(
        calibration, effects=off | {"stiffness_hysteresis": {"share": share, "slip_angle_rad": 0.05}}
    )
    car = Car(np.atleast_1d(plant))
    schedule = scenarios.curve(plant, 15000.0, 60.0) + scenarios.rest(1.0)
    _, truth = car.run(schedule.commands[:, None], schedule.drives)
    closing = slice(0, len(truth) // 2)
    once = np.trapezoid(truth["static_force"][closing, 0], truth["angle"][closing, 0]) * plant["gear_gain"]
    assert car.states[0]["clamp_work"] == pytest.approx(2.0 * share * once, rel=0.15)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
@pytest.mark.parametrize("share, slides", [(0.85, False), (1.15, True)])
def test_standing_friction_holds_up_to_its_level_and_no_further(bare, direction, share, slides):
    state = np.zeros(1, PLANT_STATE)[0]
    state["force"], state["caliper"] = 8000.0, 22.0
    level = bare["offset_friction"] + bare["load_friction"] * state["force"]
    balance = bare["gear_gain"] * state["force"] / bare["torque_constant"]
    margin = direction * share * level / bare["torque_constant"]
    state["current"] = balance
    steps = round(1.0 / SUBSTEP_S)
    for step in range(steps):
        move_motor(bare, state, balance + margin * min(1.0, 2.0 * step / steps))
    moved = direction * state["angle"]
    if slides:
        assert moved > 20.0 * bare["presliding_angle"]
    else:
        assert 0.0 < moved < 5.0 * bare["presliding_angle"]


def stored_heat(p, s):
    """Enthalpy over 0 degC of everything that stores heat, J."""
    cells = cell_count(p)
    pads = s["pads"][:, :cells]
    enthalpy = p["specific_heat"] * (pads + 0.5 * p["specific_heat_rise"] * (pads - 20.0) ** 2)
    total = p["density"] * p["pad_area"] * p["pad_thickness"] / cells * enthalpy.sum()
    total += p["pad_area"] * p["plate_heat_capacity"] * s["plate"].sum()
    return total + p["caliper_heat_capacity"] * s["caliper"] + p["disc_heat_capacity"] * s["disc"]


@pytest.mark.parametrize("thickness", [0.5, 10.0])
def test_friction_heat_is_stored_or_lost(calibration, thickness):
    plant = plant_from_calibration(calibration, pad_thickness_mm=thickness)
    car = Car(np.atleast_1d(plant))
    before = stored_heat(plant, car.states[0])
    schedule = drives.rig_drag(5000.0, 40.0, 60.0) + scenarios.rest(60.0, 20.0)
    car.run(schedule.commands[:, None], schedule.drives)
    state = car.states[0]
    gained = stored_heat(plant, state) - before
    assert state["disc"] > 150.0
    assert gained + state["heat_lost"] == pytest.approx(state["friction_heat"], rel=2e-3)


def test_braking_turns_motion_into_heat(calibration):
    plants = np.array([plant_from_calibration(calibration, seed) for seed in range(4)])
    car = Car(plants, CORNERS)
    motion = car.motion[0]
    motion["speed"] = 25.0
    motion["wheel_speed"] = 25.0 / motion["wheel_radius"]
    motion["drag"] = motion["rolling"] = 0.0
    kinetic = 0.5 * motion["mass"] * 25.0**2
    schedule = scenarios.stop(9000.0, 8.0)
    car.run(scenarios.commands_of(schedule, CORNERS), schedule.drives)
    assert motion["speed"] == 0.0
    assert car.states["friction_heat"].sum() == pytest.approx(kinetic, rel=0.01)


def test_the_wire_contract_is_kept(calibration):
    """Every frame passes the daemon's receiver; each message comes at its cycle; both frames of a sample share a counter."""
    plants = np.array([plant_from_calibration(calibration, seed) for seed in range(4)])
    seconds = 20.0
    frames, truth = scenarios.simulate_log(plants, scenarios.city_drive(), seconds, 3, CORNERS, reference=True)
    assert np.all(np.diff(frames["time_ns"]) >= 0)
    parameters = np.zeros(4, PARAMETERS)
    parameters[:] = to_parameters(calibration)
    pipeline = Pipeline(parameters, capacity=1 << 12)
    pipeline.begin(int(frames["time_ns"][0]))
    start = answered = 0
    while start < len(frames):
        start, count = pipeline.consume(frames, start)
        answered += int(np.count_nonzero(pipeline.estimates[:count]["age_cycles"] == 0))
    counts = pipeline.receptions["count"]
    assert counts[:, ACCEPTED].sum() == counts.sum()
    # The last sample may still wait for company.
    assert answered >= truth.size - len(CORNERS)
    cycles = {0x100: 4, 0x110: 4, 0x120: 10, 0x700: 4, 0x710: 100, 0x720: 100}
    for corner in range(4):
        for base, cycle in cycles.items():
            expected = 1000.0 * seconds / cycle
            assert np.count_nonzero(frames["can_id"] == base + corner) == pytest.approx(expected, abs=1)
    for can_id, cycle in ((0x180, 10), (0x181, 10), (0x182, 100)):
        assert np.count_nonzero(frames["can_id"] == can_id) == pytest.approx(1000.0 * seconds / cycle, abs=1)
    resolver = frames[frames["can_id"] == 0x102]["data"] >> np.uint64(8) & np.uint64(0xF)
    current = frames[frames["can_id"] == 0x112]["data"] >> np.uint64(8) & np.uint64(0xF)
    assert np.array_equal(resolver, current)
    assert np.array_equal(resolver, truth["counter"][:, 2])


def test_sensors_measure_the_true_state(driven):
    plant, frames, truth = driven
    truth = truth[:, 0]
    resolver = Decoder().columns(frames, "EMB_FL_Resolver")
    assert np.max(np.abs(resolver["MotorAngle"] - truth["angle"])) < 2.0 * plant["angle_count"]
    noise = resolver["MotorSpeed"] - truth["speed"]
    assert np.std(noise) == pytest.approx(plant["speed_noise"], rel=0.05)
    error = Decoder().columns(frames, "EMB_FL_Current")["CurrentQ"] - truth["current"]
    assert np.std(error) == pytest.approx(plant["current_noise"], rel=0.15)
    neighbours = np.corrcoef(error[1:], error[:-1])[0, 1]
    # Averaging over the cycle correlates neighbours a little more than the exponential alone.
    assert np.exp(-CYCLE_S / plant["current_noise_time"]) - 0.03 < neighbours < 0.8
    reference = Decoder("dbc/rig.dbc").columns(frames, "RIG_FL_Force")["ClampForceRef"] - truth["force"]
    assert np.std(reference) == pytest.approx(plant["force_noise"], rel=0.05)
    turned = np.ptp(truth["wheel_angle"])
    pulses = np.unwrap(Decoder().columns(frames, "VEH_WheelPulse")["WheelPulseFL"], period=4096)
    assert np.ptp(pulses) == pytest.approx(turned / (2.0 * np.pi) * 96, abs=3)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_daemons_estimator_follows_a_unit_it_was_not_calibrated_on(calibration, seed):
    plant = plant_from_calibration(calibration, seed)
    frames, truth = scenarios.simulate_log(plant, scenarios.city_drive(), seed=seed)
    estimates, truth = estimate(log_of(frames).samples, to_parameters(calibration)), truth[:, 0]
    error = estimates["force"] - truth["force"]
    assert np.sqrt(np.mean(error**2)) < 80.0
    assert np.mean(np.abs(error) <= 2.0 * estimates["sigma"]) > 0.9
    # Started a clearance before contact, it ends where the pads really touch, to 10 um.
    assert np.max(np.abs(estimates["contact_angle"] - truth["contact_angle"])) < 0.25
    assert np.max(np.abs(estimates["mean"] - truth["mean"])[10:]) < 5.0


def test_a_flickering_resolver_does_not_wear_friction_away(calibration):
    """With a converter without hysteresis, which flickers between two counts, held forces must not drift."""
    plant = plant_from_calibration(calibration, seed=1)
    plant["angle_hysteresis"], plant["angle_noise"] = 0.0, 0.2 * plant["angle_count"]
    frames, truth = scenarios.simulate_log(plant, scenarios.city_drive(), seed=1)
    error = estimate(log_of(frames).samples, to_parameters(calibration))["force"] - truth["force"][:, 0]
    assert np.sqrt(np.mean(error**2)) < 40.0


def test_the_latch_holds_the_brake_without_current(bare):
    car = Car(np.atleast_1d(bare))
    schedule = scenarios.park(9000.0, 5.0).first(3.0) + scenarios.rest(4.0)
    commands = scenarios.commands_of(schedule, ("FL",))
    commands["mode"][750:] = LATCH
    _, truth = car.run(commands, schedule.drives)
    held = truth[800:, 0]
    assert np.abs(held["current"]).max() < 1e-9
    assert np.ptp(held["angle"]) == 0.0
    assert held["force"][-1] == pytest.approx(truth["force"][749, 0], rel=1e-3)
    free = scenarios.rest(2.0)
    _, released = car.run(scenarios.commands_of(free, ("FL",)), free.drives)
    assert released["force"][-1, 0] < 1.0


def test_winding_and_magnets_settle_where_the_current_heats_them_to(bare):
    plant, current = bare.copy(), 10.0
    plant["copper_per_K"], plant["winding_time"], plant["magnet_time"] = 0.0039, 5.0, 20.0
    state = np.zeros(1, PLANT_STATE)[0]
    for field in ("pads", "surface", "plate", "caliper", "disc"):
        state[field] = 22.0
    state["current"] = current
    magnets = []
    for _ in range(50_000):
        heat_cycle(plant, state, 0.0, 22.0)
        magnets.append(float(state["magnet_rise"]))
    # Copper loss grows with the winding's own rise: rise = heating I^2 (1 + copper rise).
    cold = float(plant["magnet_heating"]) * current**2
    assert magnets[-1] == pytest.approx(cold / (1.0 - 0.0039 * cold), rel=1e-3)
    # Two masses in a row begin with the square of time.
    assert magnets[24] == pytest.approx(cold * 0.1**2 / (2.0 * 5.0 * 20.0), rel=0.06)


def test_cold_grease_doubles_its_viscosity_every_ten_kelvin(bare):
    schedule = scenarios.random_angle(bare, 6.0, np.random.default_rng(4), high_N=5000.0)
    commands = scenarios.commands_of(schedule, ("FL",))

    def loss(ambient, viscous):
        plant = bare.copy()
        plant["effects"]["cold_grease"]["viscous_Nms_per_rad"] = viscous
        car = Car(np.atleast_1d(plant), ambient=ambient)
        schedule.drives["ambient"] = ambient
        car.run(commands, schedule.drives)
        return float(car.states["friction_loss"][0])

    def added(ambient):
        return loss(ambient, 2e-5) - loss(ambient, 0.0)

    assert added(22.0) == 0.0
    # 2^4 - 1 over 2^3 - 1; viscous drag slows the motion a little.
    assert added(-18.0) / added(-8.0) == pytest.approx(15.0 / 7.0, rel=0.05)


def test_a_current_a_whole_cycle_late_is_the_one_before(bare):
    plant = bare.copy()
    plant["current_noise"] = 0.0
    schedule = scenarios.random_angle(plant, 2.0, np.random.default_rng(6))

    def currents(delay):
        plant["effects"]["current_delay"]["delay_s"] = delay
        frames, _ = scenarios.simulate_log(plant, schedule, seed=8)
        return Decoder().columns(frames, "EMB_FL_Current")["CurrentQ"]

    # The least count is 0.01 A.
    assert np.allclose(currents(CYCLE_S)[1:], currents(0.0)[:-1], atol=0.011)
    assert np.allclose(currents(1.5 * CYCLE_S)[1:], currents(0.5 * CYCLE_S)[:-1], atol=0.011)


@pytest.fixture(scope="module")
def short_drive(calibration):
    """Frames of a short drive with some effects, as a function of these; and those without any."""
    schedule = (
        scenarios.random_angle(plant_from_calibration(calibration), 1.0, np.random.default_rng(0))
        + drives.rig_stop(8000.0, 50.0, 3.0, 6.0)
        + drives.rig_drag(6000.0, 50.0, 8.0)
    )
    off = {known: {} for known in calibration.effects}

    def frames(effects):
        plant = plant_from_calibration(calibration, effects=off | effects)
        # Warm enough for what depends on a warm caliper, which a short drive does not heat.
        return scenarios.simulate_log(plant, schedule, seed=1, ambient=30.0)[0]

    return frames, frames({})


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_an_effect_shows(short_drive, name):
    assert set(VISIBLE) == set(EFFECTS)
    frames, without = short_drive
    assert not same(frames({name: VISIBLE[name]}), without)


def test_effects_without_amplitude_are_neutral_whatever_their_shapes(short_drive):
    frames, without = short_drive
    amplitudes = {effect.name: [parameter.name for parameter in effect.amplitudes] for effect in REGISTRY}
    # Those outside the catalogue have one, and state it first, or two.
    own = {name: EFFECTS[name] if name == "cold_grease" else EFFECTS[name][:1] for name in EFFECTS.keys() - amplitudes}
    nothing = {name: VISIBLE[name] | dict.fromkeys(zero, 0.0) for name, zero in (amplitudes | own).items()}
    assert same(frames(nothing), without)


@pytest.fixture(scope="module")
def campaign(calibration):
    """Training, random angle, stops on a rotating disc, a long drag, random angle again."""
    plant, rng = plant_from_calibration(calibration), np.random.default_rng(0)
    schedule = drives.training(plant) + scenarios.random_angle(plant, 22.0, rng)
    for _ in range(6):
        force = float(np.exp(rng.uniform(np.log(2000.0), np.log(25000.0))))
        schedule += drives.rig_stop(force, rng.uniform(20.0, 60.0), rng.uniform(2.5, 4.5), rng.uniform(7.0, 11.0))
    return schedule + drives.rig_drag(3500.0, 31.4, 20.0) + scenarios.random_angle(plant, 20.0, rng)


@pytest.mark.parametrize("effect", REGISTRY, ids=lambda effect: effect.name)
def test_an_estimator_that_knows_the_effect_is_as_good_as_without_it(calibration, campaign, effect):
    """Plant and catalogue are separate code: where they agree, an effect means the same in both."""
    values = VISIBLE[effect.name]
    plant = plant_from_calibration(calibration, effects={effect.name: values})
    frames, truth = scenarios.simulate_log(plant, campaign, seed=3)
    parameters = to_parameters(calibration)
    for name, value in values.items():
        parameters["effects"][effect.name][name] = value
    estimates, truth = estimate(log_of(frames).samples, parameters), truth[:, 0]
    # The park brake is on at power-on: until the first stroke passed the clearance nothing is known, and said so.
    seen = np.argmax(estimates["reasons"] == 0)
    assert seen < 1000 and np.sqrt(np.mean((estimates["force"] - truth["force"])[seen:] ** 2)) < 25.0
    # Before the first thermocouple frame nothing is known of temperatures.
    assert np.sqrt(np.mean((estimates["mean"] - truth["mean"])[10:] ** 2)) < 2.0


def test_thickness_variation_shows_at_the_wheels_orders_and_only_when_it_turns(bare, calibration):
    off = {name: {} for name in calibration.effects}
    plant = plant_from_calibration(calibration, effects=off | {"disc_thickness_variation": {"order_2_sine_um": 12.0}})
    car = Car(np.atleast_1d(plant))
    hold = scenarios.rest(12.0, wheel_speed=20.0)
    hold.commands["mode"], hold.commands["target"] = 1, scenarios.angle_at(plant, 6000.0)
    _, truth = car.run(hold.commands[:, None], hold.drives)
    held = truth[1000:, 0]
    force = held["force"] - np.mean(held["force"])
    second = [np.mean(force * np.exp(-1j * order * held["wheel_angle"])) for order in (1, 2, 3)]
    slope = (static_curve(plant, 11.5) - static_curve(plant, 10.5)) / plant["gear_gain"]
    # Amplitude: local stiffness times thickness, less what the relaxation lets through; phase: a sine, a little late.
    assert 2.0 * abs(second[1]) == pytest.approx(12e-6 * slope, rel=0.4)
    assert abs(second[1]) > 5.0 * max(abs(second[0]), abs(second[2]))
    hold.drives["wheel_speed"] = 0.0
    _, truth = car.run(hold.commands[:, None], hold.drives)
    assert np.ptp(truth["force"][1500:, 0]) < 20.0


def test_a_late_resolver_reads_an_earlier_angle(calibration):
    plant = plant_from_calibration(calibration, effects={"signal_delay": {"delay_s": 0.003}})
    frames, truth = scenarios.simulate_log(plant, drives.training(plant, 6.0))
    behind = truth["angle"][:, 0] - Decoder().columns(frames, "EMB_FL_Resolver")["MotorAngle"]
    speed = truth["speed"][:, 0]
    assert np.dot(behind, speed) / np.dot(speed, speed) == pytest.approx(0.003, rel=0.1)


class Parked:
    """A parked car, and a daemon that asks it for training motion."""

    def __init__(self, plant):
        self.car = Car(np.atleast_1d(plant))
        standing = scenarios.rest(CYCLE_S)
        self.commands, self.drive = standing.commands, standing.drives[0]
        self.commands["mode"], self.commands["target"] = FORCE, 9000.0
        self.drive["park_brake"] = PARK_APPLIED
        self.counter = 0
        self.asks = None

    def run(self, cycles):
        """Truth of the coming cycles; a request, while there is one, is repeated every 20 ms."""
        rows = []
        for _ in range(cycles):
            if self.asks is not None and self.car.motion[0]["tick"] % 5 == 0:
                self.say(self.asks)
            self.car.tick(self.commands, self.drive)
            rows.append(self.car.truth[0].copy())
        return np.array(rows)

    def say(self, request, low=0.0, high=12.0, amplitude=0.8, frequency=6.0):
        layout, frames = default_layout()[0], np.zeros(1, FRAME)
        can_id = layout["sent_id"][ADAPT_REQUEST, 0]
        payload = np.uint64(0)
        for column, value in enumerate((request, 0.0, 0.0, low, high, amplitude, frequency)):
            payload |= pack(float(value), layout["sent"][ADAPT_REQUEST, column])
        frames[0] = (0, protect(can_id, payload, self.counter, 0), can_id, 8, 0)
        self.counter = (self.counter + 1) % COUNTER_MODULO
        self.car.receive(frames)


@pytest.fixture
def parked(bare):
    parked = Parked(bare)
    assert not np.any(parked.run(500)["training"])
    return parked


def test_training_motion_comes_on_request(parked):
    parked.asks = 1
    truth = parked.run(6000)
    assert np.all(truth["training"][1:])
    stroke = truth[1000:]
    assert stroke["force"].min() < 50.0
    assert stroke["force"].max() == pytest.approx(12000.0, rel=0.15)
    angle = stroke["angle"] - np.convolve(stroke["angle"], np.ones(250) / 250, "same")
    inner = angle[500:-500] * np.hanning(len(angle) - 1000)
    frequencies = np.fft.rfftfreq(len(inner), CYCLE_S)
    dither = np.abs(np.fft.rfft(inner)) * (frequencies > 1.5)
    assert frequencies[np.argmax(dither)] == pytest.approx(6.0, abs=0.1)


@pytest.mark.parametrize("how", ["abort", "none", "brake request", "park brake released"])
def test_training_ends_within_one_cycle(parked, how):
    parked.asks = 1
    assert parked.run(2000)["training"][-1]
    parked.asks = None
    if how == "abort":
        parked.say(2)
    elif how == "none":
        parked.say(0)
    elif how == "brake request":
        parked.drive["brake_request"] = 1
    else:
        parked.drive["park_brake"] = PARK_RELEASED
    after = parked.run(1000)
    assert not np.any(after["training"])
    assert after["force"][-1] == pytest.approx(9000.0, rel=0.01)


def test_training_ends_when_the_daemon_falls_silent(parked):
    parked.asks = 1
    assert parked.run(500)["training"][-1]
    parked.asks = None
    assert not parked.run(30)["training"][-1]


def test_a_moving_car_does_not_train(parked):
    parked.asks = 1
    parked.drive["wheel_speed"] = 5.0
    assert not np.any(parked.run(100)["training"])


def test_live_car_puts_the_same_frames_on_a_bus(calibration):
    plants = np.array([plant_from_calibration(calibration, 1), plant_from_calibration(calibration, 2)])
    near, far = socket_pair()
    corners = ("FL", "FR")
    live = LiveCar(Car(plants, corners, seed=4), near, scenarios.city_drive())
    live.warm_up()
    live.run(lambda: False, seconds=0.2)
    received = far.drain()
    near.close()
    far.close()
    frames, _ = scenarios.simulate_log(plants, scenarios.city_drive(), 0.2, 4, corners, reference=False)
    assert live.ticks == 50
    # A held-up machine loses cycles, but it invents none.
    sent = frames["data"].tolist()
    assert len(received) > 0
    assert set(received["data"].tolist()) <= set(sent)
    if live.lost == 0:
        assert received["data"].tolist() == sent


def test_demo_compares_broadcasts_with_the_truth_and_leaves_a_picture(tmp_path, capsys):
    picture = tmp_path / "demo.png"
    assert main(["demo", "--corners", "1", "--seconds", "2", "--picture", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "simulated truth" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["demo", "--seconds", "0"], "--seconds"),
        (["demo", "--picture", "/nonexistent/x.png"], "no such folder"),
        (["simulate", "-i", "virtual", "--scenario", "moon"], "expected drive"),
        (["simulate", "-i", "nosuch", "-c", "x", "--seconds", "1"], "bus"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_status_2(arguments, expected, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
