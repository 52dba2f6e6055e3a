"""Heat conduction against analytic solutions, its energy balance, its mesh error and its stability."""

import naive
import numpy as np
import pytest

from emb_daemon.estimator.heat import _watch_plates, heat
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.models.thermal import CHAIN, LONGEST_S, NODES, UNALTERED, at_depth, friction_power, heat_step, mean_temperature
from emb_daemon.offline import estimate


@pytest.fixture
def slab(thermal):
    """Pads of constant properties that touch nothing but their backing plates."""
    thermal["conductivity_rise"] = thermal["specific_heat_rise"] = 0.0
    thermal["contact_conductance"] = thermal["gap_conductance"] = 0.0
    thermal["heat_share"] = 1.0, 0.0
    return thermal


def _diffusivity(p):
    return p["conductivity"] / (p["density"] * p["specific_heat"])


def _march(p, pads, seconds, dt, power=0.0, backplate=20.0, braking=False, wheel_speed=0.0):
    work, disc = np.empty((4, CHAIN)), 20.0
    for _ in range(round(seconds / dt)):
        disc = heat_step(
            p, pads, disc, backplate, backplate, 20.0, power, braking, wheel_speed, dt, work, LONGEST_S, UNALTERED
        )
    return disc


def test_semi_infinite_solid_under_constant_flux(slab):
    """T(0, t) - T0 = 2 q/k sqrt(a t/pi) (Carslaw and Jaeger, Conduction of Heat in Solids, 2.9) while the heat is shallow."""
    flux = 2e5
    pads = np.full((2, NODES), 20.0)
    for seconds, passed in ((1.0, 1.0), (2.0, 3.0), (3.0, 6.0)):
        _march(slab, pads, seconds, 0.004, flux * slab["area"])
        rise = 2.0 * flux / slab["conductivity"] * np.sqrt(_diffusivity(slab) * passed / np.pi)
        assert pads[0, 0] - 20.0 == pytest.approx(rise, rel=0.042 / np.sqrt(passed))
    assert np.all(pads[1] == pytest.approx(20.0))


def test_slab_in_steady_state(slab):
    """Fixed backing plate: the profile is a straight line of slope q/k, above the drop at the contact."""
    flux = 5e4
    pads = np.full((2, NODES), 20.0)
    _march(slab, pads, 3000.0, 1.0, flux * slab["area"], backplate=80.0)
    depth = slab["thickness"] - slab["node_position"]
    expected = 80.0 + flux / slab["backplate_conductance"] + flux * depth / slab["conductivity"]
    np.testing.assert_allclose(pads[0], expected, rtol=1e-9)


def test_first_eigenmode_decays_at_its_rate(slab):
    """Insulated surface, fixed backing plate: cos(pi x/2L) decays with a (pi/2L)^2."""
    slab["backplate_conductance"] = 1e9
    mode = np.cos(0.5 * np.pi * slab["node_position"] / slab["thickness"])
    pads = np.array([20.0 + 100.0 * mode, np.full(NODES, 20.0)])
    _march(slab, pads, 60.0, 0.02)
    rate = -np.log((pads[0, 0] - 20.0) / 100.0) / 60.0
    assert rate == pytest.approx(_diffusivity(slab) * (0.5 * np.pi / slab["thickness"]) ** 2, rel=0.01)


@pytest.mark.parametrize("dt", [0.004, 0.048, 0.25])
def test_energy_is_conserved(thermal, dt):
    """What friction brings in is stored or leaves through backing plates and disc, to round-off, with k(T) too."""
    thermal["specific_heat_rise"] = 0.0
    thermal["conductivity_rise"] = 1e-3
    pads, disc, work = np.full((2, NODES), 20.0), 20.0, np.empty((4, CHAIN))
    worst = 0.0
    for step in range(200):
        braking = step < 120
        power = 9000.0 * braking
        capacity, _, outside, plates = naive.heat_matrices(thermal, pads, disc, 15.0, braking, 30.0)
        before = np.concatenate([pads[0], pads[1], [disc]])
        disc = heat_step(thermal, pads, disc, 40.0, 35.0, 15.0, power, braking, 30.0, dt, work, LONGEST_S, UNALTERED)
        after = np.concatenate([pads[0], pads[1], [disc]])
        stored = capacity @ (after - before)
        to_plates = plates[:NODES] @ (pads[0] - 40.0) + plates[NODES:-1] @ (pads[1] - 35.0)
        left = dt * (to_plates + outside @ (after - 15.0))
        worst = max(worst, abs(power * dt - stored - left))
    assert worst < 1e-9 * thermal["disc_heat_capacity"] * 400.0 * dt
    assert disc > 20.0 + 5.0 * dt


def _profile(pad, positions, disc):
    depths = [at_depth(pad, positions, depth) for depth in (0.002, 0.004, 0.006, 0.008)]
    return np.array([pad[0], mean_temperature(pad, positions), *depths, disc])


def test_mesh_error_over_a_braking_cycle(thermal):
    """The mesh that runs in the daemon against one eight times finer: 60 s of braking into 30 s of release.

    The worst of the surface is the moment at which braking ends; where thermocouples sit and in the mean it is small."""
    fine = {name: thermal[name] for name in thermal.dtype.names}
    coarse_nodes = thermal["node_position"]
    parts = (coarse_nodes[:-1, None] + np.diff(coarse_nodes)[:, None] * np.arange(8) / 8.0).ravel()
    fine["node_position"] = np.append(parts, coarse_nodes[-1])
    pads, disc, work = np.full((2, NODES), 20.0), 20.0, np.empty((4, CHAIN))
    fine_pads, fine_disc = np.full((2, len(fine["node_position"])), 20.0), 20.0
    names = ("surface", "mean", "2 mm", "4 mm", "6 mm", "8 mm", "disc")
    worst, hottest, dt = np.zeros(len(names)), 0.0, 0.25
    for step in range(round(90.0 / dt)):
        time = step * dt
        braking, speed = time < 60.0, 37.7 * min(time / 60.0, 1.0)
        power = 2.0 * 0.4 * thermal["effective_radius"] * 4000.0 * speed * braking
        arguments = (20.0 + 0.5 * time, 20.0 + 0.5 * time, 20.0, power, braking, speed, dt)
        disc = heat_step(thermal, pads, disc, *arguments, work, LONGEST_S, UNALTERED)
        fine_pads, fine_disc = naive.heat_step(fine, fine_pads, fine_disc, *arguments)
        errors = _profile(pads[0], coarse_nodes, disc) - _profile(fine_pads[0], fine["node_position"], fine_disc)
        worst = np.maximum(worst, np.abs(errors))
        hottest = max(hottest, fine_pads.max())
    errors = dict(zip(names, worst, strict=True))
    print(f"{NODES} nodes, hottest {hottest:.0f} degC:", *(f"{name} {error:.2f} K" for name, error in errors.items()))
    assert hottest > 180.0
    assert max(error for name, error in errors.items() if name != "surface") < 0.3
    assert errors["surface"] < 3.5


def test_every_sample_time_is_stable_and_agrees(thermal):
    """From the cycle to the slowest reduced log: the same temperatures after a stop, no oscillation."""
    ends = {}
    for dt in (0.004, 0.02, 0.1, 1.0):
        pads = np.full((2, NODES), 20.0)
        disc = _march(thermal, pads, 20.0, dt, 8000.0, braking=True, wheel_speed=30.0)
        assert np.all(np.diff(pads[0]) <= 1e-9), "hotter towards the backing plate than at the surface"
        ends[dt] = np.array([disc, *pads[0]])
    for dt, end in ends.items():
        np.testing.assert_allclose(end - 20.0, ends[0.004] - 20.0, rtol=0.03, atol=0.3, err_msg=f"{dt} s")


@pytest.mark.parametrize("dt", [0.004, 0.25, 1.0])
def test_without_heating_nothing_leaves_the_range_of_its_surroundings(thermal, dt):
    pads = np.random.default_rng(5).uniform(20.0, 600.0, (2, NODES))
    disc, work = 600.0, np.empty((4, CHAIN))
    for step in range(50):
        low, high = min(pads.min(), disc, 20.0), max(pads.max(), disc)
        disc = heat_step(thermal, pads, disc, 20.0, 20.0, 20.0, 0.0, step % 2 == 0, 10.0, dt, work, LONGEST_S, UNALTERED)
        assert low - 1e-9 <= min(pads.min(), disc) and max(pads.max(), disc) <= high + 1e-9


@pytest.mark.parametrize(("torque_Nm", "power_W"), [(500.0, 25_000.0), (0.2, 10.0), (-3.0, 0.0), (np.nan, None)])
def test_the_torque_that_is_measured_heats_and_its_noise_below_zero_does_not(parameters, torque_Nm, power_W):
    """Without a measurement the friction does that pads of their mean surface temperature have."""
    s, m = new_state()[0], np.zeros(1, SAMPLE)[0]
    s["temperature_known"], s["fused"] = True, 5000.0
    m["dt"], m["brake_torque"], m["wheel_speed"], m["has_wheel_speed"] = 0.004, torque_Nm, 50.0, True
    s["pads"][0], s["pads"][1], thermal = 100.0, 500.0, parameters[0]["thermal"]
    heat(s, parameters[0], m)
    power_W = friction_power(thermal, 5000.0, 50.0, 300.0) if power_W is None else power_W
    assert s["power"] == pytest.approx(power_W)


def test_a_speed_that_nothing_tells_heats_nothing_and_may_have_heated(parameters):
    """As at 110 km/h, by the friction of pads of their mean surface temperature."""
    s, m, thermal = new_state()[0], np.zeros(1, SAMPLE)[0], parameters[0]["thermal"]
    s["temperature_known"], s["fused"], s["pads"][0], s["pads"][1] = True, 5000.0, 100.0, 500.0
    m["dt"], m["brake_torque"] = 0.004, np.nan
    heat(s, parameters[0], m)
    may_have = friction_power(thermal, 5000.0, 100.0, 300.0) * 0.004 / thermal["disc_heat_capacity"]
    assert s["power"] == 0.0 and s["temperature_sigma"] == pytest.approx(may_have)


def test_a_plate_that_repeats_is_stuck_once_heat_has_had_the_time_to_come_through_the_pad(parameters):
    """That is L²/(4 a), of a mean that has moved by 20 K."""
    s, m, thermal = new_state()[0], np.zeros(1, SAMPLE)[0], parameters[0]["thermal"]
    thermal["conductivity"] = 3.0
    takes_s = thermal["thickness"] ** 2 / (4.0 * _diffusivity(thermal))
    s["plate"], s["plate_mean"], s["mean"] = 20.0, 20.0, 40.0
    m["inner_backplate"], m["outer_backplate"], m["has_thermocouple"] = 20.0, 20.0, True
    for share, stuck in ((0.95, False), (0.1, True)):
        _watch_plates(s, thermal, m, share * takes_s)
        assert s["plate_stuck"] == stuck


def test_pads_take_no_more_than_all_the_heat(thermal):
    """However much of it effects send there."""
    pads, work, all_of_it = np.full((2, NODES), 20.0), np.empty((4, CHAIN)), UNALTERED._replace(heat_share=99.0)
    disc = heat_step(thermal, pads, 20.0, 20.0, 20.0, 20.0, 9000.0, False, 0.0, 0.004, work, LONGEST_S, all_of_it)
    assert min(pads.min(), disc) > 20.0 - 1e-9 and pads[0, 0] > 25.0


def test_pads_forget_their_temperature_over_the_time_of_the_calibration(parameters):
    rows, state = np.zeros(10_000, SAMPLE), new_state()
    rows["dt"][1:], rows["angle"], rows["brake_torque"] = 0.004, 17.5, np.nan
    for name in ("inner_backplate", "outer_backplate", "caliper", "ambient"):
        rows[name] = 120.0
    rows["has_thermocouple"] = rows["has_status"] = True
    thermal = parameters[0]["thermal"]
    thermal["history_time"] = 20.0
    estimate(rows[:5000], parameters[:1], state)
    remembered = state[0]["history"] = 20.0
    warm = estimate(rows[5000:], parameters[:1], state)["mean"].mean(axis=1) - thermal["reference"]
    assert remembered < 0.5 * warm[0] and np.ptp(warm) < 1.0
    assert warm[-1] - state[0]["history"] == pytest.approx((warm[0] - remembered) * np.exp(-1.0), rel=0.05)


def _warm(pads, disc, ambient=20.0):
    """STATE of pads and disc whose temperatures are known, and a SAMPLE of the car at rest."""
    s, m = new_state()[0], np.zeros(1, SAMPLE)[0]
    s["temperature_known"], s["ambient_heard"], s["pads"], s["mean"], s["disc"] = True, True, pads, pads, disc
    m["dt"], m["brake_torque"], m["has_status"], m["has_wheel_speed"], m["ambient"] = 0.004, np.nan, True, True, ambient
    return s, m


def test_heat_flows_every_twelve_samples(parameters):
    s, m = _warm(200.0, 200.0)
    flowed = []
    for _ in range(24):
        before = s["disc"].copy()
        heat(s, parameters[0], m)
        flowed.append(bool(s["disc"] != before))
    assert np.flatnonzero(flowed).tolist() == [11, 23]


def test_without_thermocouples_no_heat_passes_to_the_plates(parameters):
    """Pads as warm as the disc and the air stay so, whatever the last message said of the plates."""
    s, m = _warm(200.0, 200.0, ambient=200.0)
    m["has_thermocouple"], m["inner_backplate"], m["outer_backplate"] = False, 20.0, -40.0
    for _ in range(250):
        heat(s, parameters[0], m)
    assert s["pads"] == pytest.approx(np.full((2, NODES), 200.0)) and s["disc"] == pytest.approx(200.0)


def test_softening_is_that_of_what_the_pads_are_and_have_been(parameters):
    """Their rise over the temperature of the calibration, and its mean over the time that they remember."""
    thermal = parameters[0]["thermal"]
    thermal["softening"], thermal["softening_history"], thermal["history_time"] = 4e-4, 1e-3, 2.0
    s, m = _warm(220.0, 220.0, ambient=220.0)
    m["inner_backplate"] = m["outer_backplate"] = 220.0
    m["has_thermocouple"], s["plate"], s["plate_mean"], s["history"] = True, 220.0, 220.0, 50.0
    rise = 220.0 - thermal["reference"]
    for _ in range(252):
        heat(s, parameters[0], m)
    remembered = rise + (50.0 - rise) * np.exp(-252 * 0.004 / 2.0)
    assert s["history"] == pytest.approx(remembered) and s["factor"] == pytest.approx(1.0 - 4e-4 * rise - 1e-3 * remembered)


@pytest.mark.parametrize(("cycle", "resumed", "wider"), [(0, False, True), (60, False, False), (0, True, False)])
def test_air_that_is_colder_than_the_disc_tells_of_heat_on_its_way_only_at_the_start(parameters, cycle, resumed, wider):
    """A vehicle status that comes later than it must may be of another weather; after a restart the heat was known."""
    s, m = _warm(60.0, 60.0)
    s["ambient_heard"], s["resumed"], s["temperature_sigma"], m["cycle"] = False, resumed, 1.0, cycle
    heat(s, parameters[0], m)
    assert (s["temperature_sigma"] > 100.0) == wider and (s["history_sigma"] > 100.0) == wider


@pytest.mark.parametrize(("plates", "wheel_speed", "vehicle_speed", "sigma"), [
    (24.0, 30.0, 0.0, 100.0), (24.0, 0.0, 9.0, 100.0), (24.0, 0.0, 0.0, 4.0), (60.0, 30.0, 9.0, 148.0), (22.5, 30.0, 9.0, 0.0),
])  # fmt: skip
def test_what_pads_of_a_car_under_way_hold_more_than_their_plates_show_is_unknown(
    parameters, plates, wheel_speed, vehicle_speed, sigma
):
    """Where plates are warmer than the caliper by more than thermocouples differ: heat is on its way, of a stop perhaps."""
    s, m = _warm(20.0, 20.0)
    s["temperature_known"], s["rested_s"], s["temperature_sigma"] = False, 0.0, 0.0
    m["has_thermocouple"], m["inner_backplate"], m["outer_backplate"], m["caliper"] = True, plates, plates, 20.0
    m["has_wheel_speed"], m["wheel_speed"], m["has_status"], m["vehicle_speed"] = True, wheel_speed, True, vehicle_speed
    heat(s, parameters[0], m)
    assert s["temperature_sigma"] == pytest.approx(sigma) and s["history_sigma"] == pytest.approx(sigma)


def test_pads_of_different_warmth_are_as_soft_after_a_restart_as_their_mean(parameters):
    thermal = parameters[0]["thermal"]
    thermal["softening"], thermal["softening_history"] = 4e-4, 0.0
    s, m = _warm(100.0, 200.0)
    s["temperature_known"], s["rested_s"], s["pads"][1] = False, 0.004, 300.0
    m["has_thermocouple"], m["inner_backplate"], m["outer_backplate"] = True, 100.0, 300.0
    heat(s, parameters[0], m)
    assert s["mean"] == pytest.approx([100.0, 300.0], abs=3.0)
    assert s["factor"] == pytest.approx(1.0 - 4e-4 * (s["mean"].mean() - thermal["reference"]))
