"""Thermal identification finds what a plant, integrated independently and finer, was built with."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs
from synthetic_rig import datasheet

from emb_daemon.calibration.parameters import moved, value_of
from emb_daemon.calibration.terms import Term
from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose import grammar
from emb_daemon.diagnose.grammar import search_heat
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.selection import Selection
from emb_daemon.diagnose.warmth import HeatBench, HeatScreening, HeatSearch
from emb_daemon.effects.terms import MOST
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.identify.calibration import nominal
from emb_daemon.identify.steps import Step, thermal
from emb_daemon.identify.steps.cooling import cooling_law
from emb_daemon.identify.steps.friction import fit_friction
from emb_daemon.identify.steps.heat import UNKNOWNS, check_excitation, fit_heat
from emb_daemon.identify.steps.softening import fit_softening
from emb_daemon.identify.steps.thermal import ThermalStep, find_terms
from emb_daemon.jit import njit
from emb_daemon.logs.mapping import Mapping
from emb_daemon.models.thermal import friction_power
from emb_daemon.offline import Log, estimate, load_log
from emb_daemon.offline.recording import Recording, recording, simulate
from emb_daemon.offline.run import stiffness_force
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S

SHEET = datasheet(0.05, 1e-4)
RADIUS_M = SHEET.disc.effective_radius_m
START = nominal(SHEET, "rig", 10.0, [10.0])
STEP_S = 0.2
AMBIENT_C = 22.0
CELLS = 60


@njit
def _plant(p, dt, every, power, touching, speed, out):
    """Explicit heat balance of 2 x 60 cells with their own backing plates: another mesh, another time scheme.

    ``out`` (rows, 13): pads at 2, 4, 6, 8 mm (inner, outer), disc, backing plates, pad means."""
    cell = p.thickness / CELLS
    store = p.density * p.specific_heat * cell
    pads = np.full((2, CELLS), 22.0)
    plates = np.full(2, 22.0)
    flux = np.empty(CELLS + 1)
    disc = 22.0
    for row in range(len(power)):
        for side in range(2):
            for depth in range(4):
                # 2 mm is the face between two cells.
                face = 12 * (depth + 1)
                out[row, 4 * side + depth] = 0.5 * (pads[side, face - 1] + pads[side, face])
            out[row, 9 + side] = plates[side]
            out[row, 11 + side] = pads[side].mean()
        out[row, 8] = disc
        contact = p.contact_conductance if touching[row] else p.gap_conductance
        air = 0.0 if touching[row] else p.surface_cooling_per_speed * speed[row]
        for _ in range(every):
            gain = (1.0 - p.heat_share[0] - p.heat_share[1]) * power[row]
            gain -= (p.disc_cooling + p.disc_cooling_per_speed * speed[row]) * (disc - 22.0)
            gain -= p.disc_radiating_area * 5.670374419e-8 * ((disc + 273.15) ** 4 - 295.15**4)
            for side in range(2):
                t = pads[side]
                k0 = p.conductivity * (1.0 + p.conductivity_rise * (t[0] - 20.0))
                # The half cell between its middle and the friction surface carries friction, disc and air.
                half = 2.0 * k0 / cell
                heat = p.heat_share[side] * power[row] / p.area
                surface = (half * t[0] + contact * disc + air * 22.0 + heat) / (half + contact + air)
                flux[0] = half * (surface - t[0])
                gain -= p.area * contact * (disc - surface)
                for face in range(1, CELLS):
                    k = p.conductivity * (1.0 + p.conductivity_rise * (0.5 * (t[face - 1] + t[face]) - 20.0))
                    flux[face] = k * (t[face - 1] - t[face]) / cell
                kn = p.conductivity * (1.0 + p.conductivity_rise * (t[CELLS - 1] - 20.0))
                series = 1.0 / (0.5 * cell / kn + 1.0 / p.backplate_conductance)
                flux[CELLS] = series * (t[CELLS - 1] - plates[side])
                for index in range(CELLS):
                    t[index] += dt / store * (flux[index] - flux[index + 1])
                plates[side] += dt / 17500.0 * (flux[CELLS] - 80.0 * (plates[side] - 22.0))
            disc += dt * gain / p.disc_heat_capacity


def run_plant(parameters, power, touching, speed, noise=0.0, rng=None, name="plant"):
    """(Recording with what its thermocouples say, mean temperature of both pads)."""
    out = np.empty((len(power), 13))
    _plant(np.atleast_1d(parameters["thermal"])[0], STEP_S / 50, 50, power, touching, speed, out)
    measured = out[:, :9].T.copy()
    if noise:
        measured += noise * rng.standard_normal(measured.shape)
    force = np.where(touching, 3000.0, 0.0)
    ambient = np.full(len(power), AMBIENT_C)
    inputs = (out[:, 9].copy(), out[:, 10].copy(), ambient, power, touching, speed, force)
    return Recording(name, STEP_S, *inputs, measured, dense=True), out[:, 11:13].mean(axis=1)


def _drag(seconds):
    t = STEP_S * np.arange(round(seconds / STEP_S))
    speed = 19.0 * (1.0 - np.cos(2.0 * np.pi * t / 60.0))
    return 280.0 * speed, np.ones(len(t), bool), speed


def _cooling(speed, braked_s=120.0, released_s=400.0):
    braked, released = round(braked_s / STEP_S), round(released_s / STEP_S)
    speeds = np.concatenate([np.full(braked, 20.0), np.full(released, speed)])
    touching = np.concatenate([np.ones(braked, bool), np.zeros(released, bool)])
    return np.where(touching, 280.0 * speeds, 0.0), touching, speeds


def _campaign(truth, rng):
    scenarios = [_drag(420.0), *(_cooling(speed) for speed in (0.0, 6.0, 18.0, 36.0))]
    return [run_plant(truth, *scenario, 0.25, rng)[0] for scenario in scenarios]


def _draw(rng, **fixed):
    """A brake unlike its datasheet: every value within what its prior holds possible."""
    values = {}
    for key, unknown in UNKNOWNS.items():
        spread = 0.07 if unknown.spread < 0.1 else 0.35
        values[key] = value_of(START, key) * np.exp(rng.uniform(-spread, spread))
    return moved(START, values | fixed)


@pytest.mark.parametrize("seed", [1, 2])
def test_pads_and_disc_are_found_within_three_sigma(seed):
    rng = np.random.default_rng(seed)
    brake = _draw(rng)
    truth = to_parameters(brake)
    fit = fit_heat(_campaign(truth, rng), START)
    off = {key: (fit.values[key] - value_of(brake, key)) / fit.sigmas[key] for key in UNKNOWNS}
    assert max(map(abs, off.values())) < 3.0, off
    # Sigma is small for what the logs show: the disc's heat capacity is found to a per cent.
    assert fit.sigmas["thermal.disc.heat_capacity_J_per_K"] < 0.02 * brake.thermal.disc.heat_capacity_J_per_K
    # On a log that was not fitted.
    r, _ = run_plant(truth, *_cooling(12.0, 200.0, 200.0))
    assert rmse(simulate(to_parameters(moved(START, fit.values)), r)[:, :8] - r.measured[:8].T) < 0.3


def _unexcited(fit):
    """Keys that a fit says its logs hardly tell."""
    return {note.partition(":")[0] for note in fit.notes}


def _disc_log(truth, scenario, folder, name):
    """A log of a table of speed, brake torque and the disc's temperature that begins when it is warm."""
    r, _ = run_plant(truth, *scenario, 0.25, np.random.default_rng(3), name)
    begins = len(r.power) // 4
    columns = (r.time_s, r.speed, np.divide(r.power, r.speed, where=r.speed > 0.0, out=np.zeros(len(r.power))))
    table = np.column_stack([*columns, r.force, r.touching, r.measured[8]])[begins:]
    np.savetxt(folder / f"{name}.csv", table, "%.6g", ",", header="t,w,torque,force,braked,disc", comments="")
    (folder / "mapping.yaml").write_text(
        "format: 1\ntime: {signal: t, unit: s}\nsignals:\n  EMB_FL_Resolver.MotorAngle: {value: 0}\n"
        "  VEH_WheelSpeed.WheelSpeedFL: {signal: w, unit: rad/s}\n  VEH_Status.ParkBrake: {value: 0}\n"
        "  VEH_Status.BrakeRequest: {signal: braked, unit: '1'}\n  VEH_Status.VehicleSpeed: {value: 0}\n"
        f"  VEH_Status.AmbientTemp: {{value: {AMBIENT_C}}}\n  RIG_FL_Force.DiscTempRef: {{signal: disc, unit: degC}}\n"
        "  RIG_FL_Force.ClampForceRef: {signal: force, unit: N}\n  RIG_FL_Force.BrakeTorqueRef: {signal: torque, unit: N·m}\n"
    )
    return load_log(folder / f"{name}.csv", read=Mapping(folder / "mapping.yaml").read)


def _disc_alone(*of_what):
    return recording(_disc_log(*of_what))


def test_no_heat_is_identified_of_a_brake_torque_whose_number_was_full(tmp_path):
    """16 bits, in steps of 0.1 N·m."""
    log = _disc_log(to_parameters(START), _drag(420.0), tmp_path, "drag")
    share = np.abs(np.sin(1e-9 * (log.reference.time_ns - log.time_ns[0])))
    for within in (3270.0 * share, 2500.0 * np.sign(share - 0.5)):
        log.reference.brake_torque_Nm = within
        recording(log)
    log.reference.brake_torque_Nm = (3600.0 * share + 3276.8) % 6553.6 - 3276.8
    with pytest.raises(InputError, match=r"drag\.csv: the reference brake torque goes from .* at once: its number"):
        recording(log)


def _validated(figures, fitted_K):
    """What is said, and what the calibration states, of a step with these figures on unseen logs."""
    campaign, said = SimpleNamespace(), []
    campaign.fault = said.append
    calibration = moved(START, {"thermal.sigma_K": fitted_K})
    step = ThermalStep(values={"thermal.sigma_K": fitted_K}, fitted={}, unseen={"validate": None}, heat=Step())
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(thermal, "_validate", lambda *_: ({}, {f"validate: {key}, K": k for key, k in figures.items()}, {}))
        step = thermal.validate(campaign, step, calibration)
    return said, moved(calibration, thermal.stated(step, calibration, {})).thermal.sigma_K


@pytest.mark.parametrize(("per_K", "sigma", "unshown"), [(0.0, 0.0, True), (2.8e-7, 5e-4, True), (4.4e-4, 1e-5, False)])
def test_a_softening_that_no_log_has_shown_is_stated_as_unsure(per_K, sigma, unshown):
    """A fit of logs without heat leaves it at about nothing, which is no softening of none."""
    calibration = moved(START, {"thermal.softening.per_K": per_K})
    step = ThermalStep(fitted={}, heat=Step())
    said = thermal.stated(step, calibration, {"thermal.softening.per_K": sigma})
    assert said == ({"thermal.softening.sigma_per_K": 5e-4} if unshown else {})


def test_sigma_of_temperatures_is_what_validation_shows_as_in_a_car():
    """Both by campaigns: of the first the heat is another on the log that validates, of the second the force is."""
    known, unknown, in_car = "pads, torque known", "pads, no torque", "pads, no torque, estimated force"
    said, sigma_K = _validated({known: 40.9, "disc, no torque": 26.8, unknown: 43.7, in_car: 47.3}, 3.14)
    assert sigma_K == 47.3 and len(said) == 1 and "off by 43.7 K" in said[0] and "47.3 K as in a car" in said[0]
    assert _validated({known: 0.42, "disc, no torque": 2.4, unknown: 0.49, in_car: 1.964}, 0.504) == ([], 1.964)
    assert _validated({known: 0.42, unknown: 0.49, in_car: 0.45}, 0.504) == ([], 0.504)
    assert _validated({"disc, no torque": 9.0}, 0.504) == ([], 0.504)


def test_a_disc_that_was_measured_alone_gives_the_disc_alone(tmp_path):
    """Its cooling law is found, also from a warm start; pad values keep the datasheet's."""
    truth = to_parameters(_draw(np.random.default_rng(9)))
    scenarios = {"drag": _drag(420.0), "slow": _cooling(6.0), "fast": _cooling(36.0), "unseen": _cooling(18.0, 200.0)}
    *fitted, unseen = (_disc_alone(truth, scenario, tmp_path, name) for name, scenario in scenarios.items())
    assert not unseen.has_pads and unseen.disc_C > AMBIENT_C + 40.0
    fit = fit_heat(fitted, START)
    inside = {key for key in UNKNOWNS if ".pad." in key and "contact" not in key and "gap" not in key}
    assert set(UNKNOWNS) - set(fit.values) == inside <= _unexcited(fit)
    nominal_K, found_K = (
        rmse(simulate(to_parameters(c), unseen)[:, 8] - unseen.measured[8]) for c in (START, moved(START, fit.values))
    )
    assert found_K < 3.0 and found_K < 0.25 * nominal_K
    cold = replace(unseen, measured=np.where(np.isfinite(unseen.measured), AMBIENT_C, np.nan))
    with pytest.raises(InputError, match=r"the disc rises by 0 K; at least 30 K by braking"):
        check_excitation(cold)


def test_no_radiation_is_found_where_there_is_none():
    rng = np.random.default_rng(3)
    key = "thermal.disc.radiating_area_m2"
    fit = fit_heat(_campaign(to_parameters(_draw(rng, **{key: 0.0})), rng), START)
    area = fit.values[key]
    assert 0.0 <= area < 3.0 * fit.sigmas[key] + 1e-9
    assert area < 0.1 * SHEET.disc.cooling_area_m2


def test_the_disc_cools_faster_the_faster_it_turns():
    """Rate over speed of a disc that only loses heat to the air: loss over heat capacity, pads lending a little."""
    rng = np.random.default_rng(12)
    brake = _draw(rng, **{"thermal.disc.radiating_area_m2": 0.0})
    truth = to_parameters(brake)
    law = cooling_law([run_plant(truth, *_cooling(speed))[0] for speed in (6.0, 18.0, 36.0)], SHEET.disc)
    disc = brake.thermal.disc
    expected = disc.cooling_per_speed_J_per_rad_K / disc.heat_capacity_J_per_K
    assert law.per_speed == pytest.approx(expected, rel=0.15)
    assert np.all(law.biot < 0.1) and "lumped" in law.note()
    assert cooling_law([run_plant(truth, *_cooling(6.0))[0]], SHEET.disc) is None


def test_logs_without_a_release_say_so():
    """Values that only a release shows keep their starting value and are named."""
    rng = np.random.default_rng(4)
    fit = fit_heat([run_plant(to_parameters(_draw(rng)), *_drag(300.0), 0.25, rng)[0]], START)
    assert "thermal.pad.gap_conductance_W_per_m2K" in _unexcited(fit)
    assert "thermal.disc.heat_capacity_J_per_K" not in _unexcited(fit)


def test_a_cold_log_is_named_with_what_was_needed():
    rows = 500
    still = np.zeros(rows)
    r, _ = run_plant(to_parameters(START), still, still > 0, still, name="cold.log")
    with pytest.raises(InputError, match=r"cold\.log: pads rise by 0 K; at least 30 K by braking"):
        check_excitation(r)


def _friction_recording(law, truth):
    """Braking at changing force and speed whose torque follows ``law`` (force N, speed rad/s, surface degC)."""
    t = STEP_S * np.arange(round(600.0 / STEP_S))
    force = 2500.0 + 1500.0 * np.sign(np.sin(2.0 * np.pi * t / 37.0))
    speed = 18.0 + 14.0 * np.sign(np.sin(2.0 * np.pi * t / 101.0))
    touching = np.ones(len(t), bool)
    radius = RADIUS_M
    power = 2.0 * 0.35 * radius * force * speed * 0.5
    for _ in range(6):
        plain, _ = run_plant(truth, power, touching, speed)
        surface = simulate(truth, plain)[:, 9:11].mean(axis=1)
        power = 2.0 * law(force, speed, surface) * radius * force * speed
    r, _ = run_plant(truth, power, touching, speed)
    return Recording(r.name, STEP_S, r.inner, r.outer, r.ambient, power, touching, speed, force, r.measured, dense=True)


@pytest.mark.parametrize("bend", [0.0, 4e-7])
def test_friction_table_reproduces_the_law_it_was_made_with(bend):
    def law(force, speed, surface):
        return 0.42 - 4e-6 * force - 7e-4 * speed - 2e-4 * (surface - 150.0) - bend * (surface - 150.0) ** 2

    truth = to_parameters(START)
    r = _friction_recording(law, truth)
    fit = fit_friction([r], truth)
    found, braking = to_parameters(moved(START, fit.values))["thermal"], r.force > 500.0
    for quantile in (0.1, 0.5, 0.9):
        force, speed = np.quantile(r.force[braking], quantile), np.quantile(r.speed[braking], 1.0 - quantile)
        surface = np.quantile(fit.temperature_C, quantile)
        expected = 2.0 * law(force, speed, surface) * RADIUS_M * force * speed
        assert friction_power(found, force, speed, surface) == pytest.approx(expected, rel=0.01)


def test_noise_of_the_force_is_not_taken_for_friction():
    """At one force its noise appears on both sides of torque over force; the slope over force must stay physical."""
    truth = to_parameters(START)
    rng = np.random.default_rng(5)
    power, touching, speed = _drag(420.0)
    speed = np.maximum(speed, 0.1)
    force = np.full(len(power), 3000.0)
    power = 2.0 * 0.4 * RADIUS_M * force * speed
    r, _ = run_plant(truth, power, touching, speed)
    noisy = force + 40.0 * rng.standard_normal(len(force))
    r = Recording(r.name, STEP_S, r.inner, r.outer, r.ambient, power, touching, speed, noisy, r.measured, dense=True)
    found = moved(START, fit_friction([r], truth).values)
    assert np.ptp(np.array(found.thermal.friction.coefficient)[:, 2, 4]) < 0.08


def _softening_log(bursts_s, mean_C, law, calibration, rng, duration_s):
    """(log, factors) of 5 s bursts of clamps on pads whose mean temperature is ``mean_C`` every STEP_S."""
    reference = mean_C[0]
    per_K, history_per_K, time_constant = law
    history, lag = np.empty(len(mean_C)), 0.0
    for row, temperature in enumerate(mean_C):
        # Independent of the estimator's exact lag: twenty Euler steps per row.
        for _ in range(20):
            lag += STEP_S / 20 / time_constant * (temperature - reference - lag)
        history[row] = lag
    factor = 1.0 - per_K * (mean_C - reference) - history_per_K * history
    grid = STEP_S * np.arange(len(mean_C))
    burst = np.arange(0.0, 10.0, 0.004)
    times = np.concatenate([[0.0], *(start + burst for start in bursts_s), [duration_s]])
    samples = np.zeros(len(times), SAMPLE)
    samples["dt"] = np.diff(times, prepend=times[0])
    for start in bursts_s:
        rows = (times >= start) & (times < start + 10.0)
        samples["angle"][rows] = 9.0 - 9.0 * np.cos(2.0 * np.pi * 0.2 * (times[rows] - start))
    samples["wheel_speed"] = 0.0
    forces = stiffness_force(samples, to_parameters(calibration), np.interp(times, grid, factor))
    forces += 25.0 * rng.standard_normal(len(forces))
    return Log(Path("bursts.log"), "FL", samples, np.round(1e9 * times).astype(np.int64), None, forces)


def _stiff():
    """Pads of which `_softening_log` takes the stiffness."""
    curve = {f"stiffness.curves[0].coefficients[{n}]": value for n, value in enumerate((230.0, 27.0, 0.45))}
    return moved(START, curve | {"stiffness.relaxation_time_s": 0.028, "contact.clearance_rad": 5.0})


@pytest.fixture(scope="module")
def cooled():
    """Braked for three minutes, then parked for two hours: (recording, mean temperature)."""
    truth = to_parameters(START)
    power, touching, speed = _cooling(0.0, 180.0, 7000.0)
    start = round(30.0 / STEP_S)
    rest = np.zeros(start)
    power, speed = np.concatenate([rest, power]), np.concatenate([rest, speed])
    touching = np.concatenate([rest > 0, touching])
    return run_plant(truth, power, touching, speed)


@pytest.mark.parametrize(("law", "seed"), [((5e-4, 1.2e-3, 1500.0), 6), ((3e-4, 8e-4, 3000.0), 7)])
def test_softening_and_its_history_are_found(cooled, law, seed):
    r, mean_C = cooled
    p = _stiff()
    bursts = [5.0, *np.arange(240.0, 7000.0, 400.0)]
    log = _softening_log(bursts, mean_C, law, p, np.random.default_rng(seed), r.time_s[-1])
    fit = fit_softening(log, r, p)
    for (key, sigma), expected in zip(fit.sigmas.items(), law, strict=True):
        assert abs(fit.values[key] - expected) < 3.0 * sigma, key
    # 25 N is the sensor.
    assert fit.ours_N < 27.0 < 0.2 * fit.uncorrected_N


def test_softening_without_history_gets_none(cooled):
    r, mean_C = cooled
    p = _stiff()
    bursts = [5.0, *np.arange(240.0, 7000.0, 400.0)]
    log = _softening_log(bursts, mean_C, (6e-4, 0.0, 1000.0), p, np.random.default_rng(8), r.time_s[-1])
    fit = fit_softening(log, r, p)
    assert fit.values["thermal.softening.per_K"] == pytest.approx(6e-4, rel=0.02)
    assert abs(fit.values["thermal.softening.history_per_K"]) * np.ptp(fit.rise_K) < 2e-3


def test_too_few_bursts_are_named():
    r, mean_C = run_plant(to_parameters(START), *_cooling(0.0, 100.0, 100.0))
    log = _softening_log([5.0, 120.0], mean_C, (5e-4, 0.0, 1000.0), _stiff(), np.random.default_rng(9), 199.0)
    with pytest.raises(InputError, match=r"bursts\.log: 2 bursts of clamps; at least"):
        fit_softening(log, r, _stiff())


def test_datasheet_start_is_the_datasheet():
    p = to_parameters(START)["thermal"]
    assert float(p["disc_heat_capacity"]) == pytest.approx(5.6 * 480.0)
    assert float(p["specific_heat"]) == 1200.0
    assert p["node_position"][-1] == pytest.approx(0.010)


# -- terms of the heat balance ----------------------------------------------------------------------------------------


def _with(*terms):
    return structs.replace(START, terms=terms)


def _term(port, coefficient, **more):
    shape = {"signal": "disc_speed", "shape": "constant", "low": -1.0, "high": 100.0} | more
    return Term(name=f"term:{port}", port=port, coefficient=coefficient, **shape)


@pytest.mark.parametrize(
    ("port", "keys"),
    [
        ("heat_share", ["thermal.pad.inner_heat_share", "thermal.pad.outer_heat_share"]),
        ("contact_conductance", ["thermal.pad.contact_conductance_W_per_m2K"]),
        ("gap_conductance", ["thermal.pad.gap_conductance_W_per_m2K"]),
        ("pad_conductivity", ["thermal.pad.conductivity_W_per_mK"]),
        ("disc_cooling", ["thermal.disc.cooling_W_per_K", "thermal.disc.cooling_per_speed_J_per_rad_K"]),
    ],
)
def test_a_constant_at_a_heat_port_is_what_its_base_parameters_do(port, keys):
    r, _ = run_plant(to_parameters(START), *_cooling(12.0, 60.0, 60.0))
    expected = simulate(to_parameters(moved(START, {key: 1.3 * value_of(START, key) for key in keys})), r)
    plain, found = (simulate(to_parameters(c), r) for c in (START, _with(_term(port, 0.3))))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert np.abs(found - plain).max() > 0.1


@pytest.mark.parametrize("port", ["disc_heat", "pad_heat"])
def test_heat_beside_friction_is_stored_or_lost(port):
    """Without braking and losses all of the heat is stored in disc and pads."""
    insulated = dict.fromkeys([key for key in UNKNOWNS if "cooling" in key or "backplate" in key or "radiating" in key], 1e-12)
    calibration = moved(_with(_term(port, 200.0)), insulated | {"thermal.pad.conductivity_rise_per_K": 0.0})
    still = np.zeros(round(300.0 / STEP_S))
    r, _ = run_plant(to_parameters(START), still, still > 0, still)
    end = simulate(to_parameters(calibration), r)[-1]
    pad, disc = calibration.thermal.pad, calibration.thermal.disc
    stored = pad.area_m2 * 1e-3 * calibration.pad_thickness_mm * pad.density_kg_per_m3 * pad.specific_heat_J_per_kgK
    held = disc.heat_capacity_J_per_K * (end[8] - AMBIENT_C) + stored * (end[11:13] - AMBIENT_C).sum()
    assert held == pytest.approx(200.0 * (300.0 - STEP_S), rel=0.02)


def _hidden(law, rng):
    """Recordings of a disc whose cooling follows another ``law`` of the speed than a line."""
    found = []
    for scenario in (_drag(240.0), *(_cooling(speed, 90.0, 250.0) for speed in (0.0, 6.0, 18.0, 36.0))):
        power, touching, speed = scenario
        r, _ = run_plant(to_parameters(START), power, touching, law(speed), 0.25, rng)
        found.append(replace(r, speed=speed))
    return found


def _bent(share):
    """A cooling over the speed that is no line by a share of it."""
    return lambda speed: (1.0 - share) * speed + share * speed**2 / 18.0


@pytest.mark.parametrize(("share", "wanted"), [(0.1, True), (0.0, False)])
def test_a_term_is_wanted_for_half_a_kelvin_that_lasts_and_not_for_what_thermocouples_scatter(share, wanted):
    """0.44 K and 0.26 K are left, where two thousandths of the rise are 0.17 K and readings scatter by 0.25 K."""
    bench = HeatBench(_hidden(_bent(share), np.random.default_rng(5)), START)
    model = bench.model()
    screening = HeatScreening(bench, model)
    assert 0.15 < screening.floor(model, "temperature", made=True) < np.sqrt(model.noise("temperature"))
    assert grammar._wanted(Selection(model, screening), "temperature") is wanted


@pytest.mark.parametrize("standing", [MOST, MOST - 1])
def test_a_heat_balance_is_searched_where_there_is_room_for_a_term(standing):
    """A term of no size stands in for one that a search took out again."""
    of = {"port": "torque", "signal": "motor_speed", "shape": "constant", "low": -1.0, "high": 1.0}
    terms = tuple(Term(name=f"term:{n}", coefficient=1e-9 * (n < standing), **of) for n in range(MOST))
    bench = HeatBench(_hidden(_bent(1.0), np.random.default_rng(5)), structs.replace(START, terms=terms))
    search = HeatSearch(Model(bench, {}, *bench.run({})))
    if standing == MOST:
        assert search.prospects() == [] and search.dependence() == {} and search.of_means("pad_heat", ("disc_speed",)) == []
    else:
        alone = HeatSearch(Model(bare := bench.under(START), {}, *bare.run({})))
        form = next(form for form in search.forms if form.means == ("disc_cooling", "disc_speed"))
        assert np.any(search.answer(form)) and np.array_equal(search.answer(form), alone.answer(form))


def test_the_residual_of_a_heat_fit_that_has_not_converged_is_no_term():
    """From a start that is far off the first fit leaves 1.4 K."""
    off = {
        "disc.cooling_per_speed_J_per_rad_K": 1.6,
        "pad.contact_conductance_W_per_m2K": 0.6,
        "disc.heat_capacity_J_per_K": 1.3,
    }
    start = moved(START, {f"thermal.{key}": factor * value_of(START, f"thermal.{key}") for key, factor in off.items()})
    model = HeatBench(_hidden(_bent(0.0), np.random.default_rng(5)), start).model()
    assert np.sqrt(model.noise("temperature")) < 0.27


@pytest.mark.trial
@pytest.mark.parametrize("share", [1.0, 0.1])
def test_a_term_is_made_for_a_cooling_that_is_no_line_over_the_speed_and_none_for_one_that_is(monkeypatch, share):
    """In the campaign's own step, with its standard deviation and where it was found."""
    searches, rng = [], np.random.default_rng(5)
    monkeypatch.setattr(thermal, "search_heat", lambda bench: searches.append(search_heat(bench)) or searches[-1])
    [term], _, follows = find_terms(_hidden(_bent(share), rng), START)
    assert (term.name, term.port, term.signal) == ("term:disc_cooling:disc_speed", "disc_cooling", "disc_speed")
    assert term.sigma > 0.0 and "plant" in term.provenance and not follows
    assert np.sqrt(searches[0].model.noise("temperature")) < 0.4
    assert not find_terms(_hidden(_bent(0.0), rng), START)[0]


def test_the_remaining_temperature_error_is_reported_where_no_term_is_made(monkeypatch):
    monkeypatch.setattr(grammar, "_one_more", lambda selection, _: selection)
    terms, left_K, follows = find_terms(_hidden(_bent(1.0), np.random.default_rng(5)), START)
    assert not terms and left_K > 2.0 and follows == "disc_speed"


def test_temperature_sigma_grows_where_a_heat_term_is_outside_of_its_range():
    count = round(20.0 / CYCLE_S)
    samples = np.zeros(count, SAMPLE)
    samples["dt"], samples["brake_torque"], samples["current_q"] = CYCLE_S, np.nan, np.nan
    # Long after power-on: shortly after it, plates that are warmer than ambient make sigma larger by themselves.
    samples["cycle"] = 1000 + np.arange(count)
    for name in ("inner_backplate", "outer_backplate", "caliper"):
        samples[name] = 80.0
    samples["wheel_speed"], samples["ambient"] = 60.0, 20.0
    samples["has_thermocouple"] = samples["has_wheel_speed"] = samples["has_status"] = True

    def sigma(*terms):
        state = new_state()
        estimate(samples, to_parameters(_with(*terms)), state)
        return float(state[0]["temperature_sigma"])

    for port, size in (("disc_cooling", 0.5), ("disc_heat", 300.0), ("pad_heat", 300.0)):
        inside, outside = (sigma(_term(port, size, low=0.0, high=high)) for high in (100.0, 30.0))
        assert inside == pytest.approx(sigma(), abs=1e-6)
        assert outside > inside + 0.1
