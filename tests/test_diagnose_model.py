"""What a search fits: coordinates, the bench that runs the estimator, and heat and force in turn."""

import dataclasses

import msgspec
import numpy as np
import pytest
from diagnosekit import drives, with_late

from emb_daemon.calibration.parameters import CLEARANCE, CLEARANCE_SIGMA, moved, value_of
from emb_daemon.calibration.terms import Term
from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose import model as model_module
from emb_daemon.diagnose import search
from emb_daemon.diagnose import selection as selection_module
from emb_daemon.diagnose.coordinates import HISTORY_TIME, about_middle, base_coordinates, by_key, effect_coordinates
from emb_daemon.diagnose.held_heat import run_held, run_with_heat
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.residuals import Bench, make_trial
from emb_daemon.diagnose.screening import Screening
from emb_daemon.diagnose.selection import Selection
from emb_daemon.effects import REGISTRY
from emb_daemon.offline import estimate, log_of
from emb_daemon.offline.run import held, run_step
from emb_daemon.offline.score import rmse
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import rest, simulate_log
from studies.blind import campaign
from studies.drives import training


def _coordinates(calibration):
    result = base_coordinates(calibration, [calibration.contact.clearance_rad])
    for effect in REGISTRY:
        result += effect_coordinates(calibration, effect, "stiffness").values()
    return result


def test_coordinates_at_their_start_are_the_calibration(calibration):
    coordinates = _coordinates(calibration)
    start = about_middle({c: c.start for c in coordinates if c.effect in ("", *calibration.effects)}, 940.0)
    found = by_key(start, 940.0)
    assert len(found) > 300
    assert found == pytest.approx({key: value_of(calibration, key) for key in found}, rel=1e-12)


def test_a_coordinate_moves_its_keys_and_nothing_else(calibration):
    for c in _coordinates(calibration):
        value = min(max(c.start, c.low) + 0.7 * c.step, c.high)
        found = by_key({c: value}, 0.0)
        keys = {move.key for move in c.moves}
        before, after = to_parameters(moved(calibration, by_key({c: c.start}, 0.0))), to_parameters(moved(calibration, found))
        # The cosine and sine of a harmonic are stated along with its order.
        assert keys <= set(found) and all(found[key] == 0.0 for key in set(found) - keys), c.name
        assert before.tobytes() != after.tobytes(), c.name


def test_no_step_of_a_fit_leaves_what_a_calibration_may_say(calibration):
    """However far a fold's fit goes: at its bounds every base coordinate still gives a calibration that loads."""
    by_sign = msgspec.structs.replace(calibration.friction, presliding_angle_rad=1e-6, load_m_per_rad=0.0)
    for start in (calibration, msgspec.structs.replace(calibration, friction=by_sign)):
        for c in base_coordinates(start, [start.contact.clearance_rad]):
            for value in (max(c.low, c.start - 20.0 * c.prior), min(c.high, c.start + 20.0 * c.prior)):
                if "coefficients" not in c.name:
                    moved(start, by_key({c: value}, 0.0), checked=True)


def test_zero_is_a_start_like_any_other(calibration):
    friction = msgspec.structs.replace(calibration.friction, load_m_per_rad=0.0)
    started = msgspec.structs.replace(calibration, friction=friction)
    [load] = (c for c in base_coordinates(started, [7.5]) if "load" in c.name)
    true = calibration.friction.load_m_per_rad
    found = by_key({load: load.start + true / load.moves[0].weight}, 0.0)
    assert load.start == 0.0 and load.step > 0.0 and found[load.name] == pytest.approx(true)
    assert load.prior * load.moves[0].weight > true


def _off(calibration, **shares):
    """A model to be refitted where pads are ``stiffer``, rub with more ``friction`` and the disc holds more ``heat`` than the
    calibration says, by these factors."""
    curves, friction = calibration.stiffness.curves, np.array(calibration.thermal.friction.coefficient)
    capacity = "thermal.disc.heat_capacity_J_per_K"
    values = {
        f"stiffness.curves[{number}].coefficients[{power}]": value / shares.get("stiffer", 1.0)
        for number, curve in enumerate(curves)
        for power, value in enumerate(curve.coefficients)
    }
    values |= {
        f"thermal.friction.coefficient[{i}][{j}][{k}]": value / shares.get("friction", 1.0)
        for (i, j, k), value in np.ndenumerate(friction)
    }
    values[capacity] = value_of(calibration, capacity) / shares.get("heat", 1.0)
    plant = plant_from_calibration(calibration)
    log = log_of(simulate_log(plant, campaign(plant, np.random.default_rng(3), 6), seed=3)[0])
    return Model.of(Bench([log], moved(calibration, values)))


@pytest.mark.trial
def test_heat_and_force_are_fitted_in_turn_until_both_are_right(calibration, monkeypatch):
    """Stiffer pads: the force heats them, and their heat softens them. One fit of each leaves both far off."""

    class Reached(Exception):
        pass

    def reached(selection, *_):
        raise Reached(selection.model)

    start = _off(calibration, stiffer=1.25)
    once = start.refined(start.bench.channels)
    assert np.sqrt(once.noise("stiffness")) > 100.0 and np.sqrt(once.noise("temperature")) > 5.0
    monkeypatch.setattr(search, "find_recalibrated", reached)
    with pytest.raises(Reached) as found:
        search.select(start.bench, lambda text, share: None)
    model = found.value.args[0]
    assert np.sqrt(model.noise("stiffness")) < 30.0 and np.sqrt(model.noise("temperature")) < 0.75


@pytest.mark.trial
def test_heat_is_recalibrated_with_the_friction_that_makes_it(calibration):
    """Friction is 5 % off, too little for a word on its own; a heat capacity that is off must not be fitted to its heat."""
    start = _off(calibration, friction=1.0 / 0.95, heat=1.25)
    selection = Selection(start.settled(start.bench.channels), Screening(start.bench, start))
    gains = selection_module.find_recalibrated(selection, start, start.bench.channels)
    selection = dataclasses.replace(selection, recalibrated=gains)
    assert "temperature" in selection.touched and "brake_torque" not in selection.touched
    found = selection_module.recalibrate_heat(selection)
    assert {"temperature", "brake_torque"} <= found.touched
    alone = selection_module.settle_heat(selection)
    assert found.model.noise("brake_torque") < 0.8 * alone.model.noise("brake_torque")
    # Nor is it forgotten where it gained nothing as long as the force was off.
    none = dataclasses.replace(selection, recalibrated={})
    assert {"temperature", "brake_torque"} <= selection_module.recalibrate_heat(none).touched


def test_what_ends_at_the_bound_of_the_search_is_known_no_better_than_it_moved(calibration):
    inertia = next(c for c in base_coordinates(calibration, [6.0]) if c.name == "motor.inertia_kg_m2")
    assert inertia.sigma_of(0.9 * inertia.start, 0.01) == 0.01
    assert inertia.sigma_of(inertia.low, 0.01) == pytest.approx(inertia.start - inertia.low)


def test_each_log_has_its_own_pads(calibration):
    """Residuals of a log with other pads are those of a calibration for these pads, beside logs that have none."""
    plant = plant_from_calibration(calibration)
    log = log_of(simulate_log(plant, training(plant, 6.0), seed=3)[0])
    other = {"pad_thickness_mm": 0.8 * calibration.pad_thickness_mm, "contact.clearance_rad": 6.0}
    together = Bench([log, log], calibration, [{}, other]).residuals({})["stiffness"]
    alone = [Bench([log], moved(calibration, values)).residuals({})["stiffness"] for values in ({}, other)]
    assert np.array_equal(together, np.concatenate(alone)) and not np.array_equal(*alone)


def test_a_contact_is_as_unsure_as_what_was_found_leaves_it(calibration):
    """Curves found theirs 1.4 rad apart, which something else explains; a drive's, which fitted none, is 0.3 rad from them."""
    start = calibration.contact.clearance_rad
    calibration = moved(calibration, {CLEARANCE_SIGMA: float(np.hypot(1.4, 0.1))})
    log = log_of(simulate_log(plant_from_calibration(calibration), rest(2.0), seed=3)[0])
    apart = start + 1.4 * np.sqrt(0.5) * np.array([1.0, -1.0])
    mounted = [*({CLEARANCE: float(c)} for c in apart), {}]
    of_logs = base_coordinates(calibration, [*apart, start])[:3]
    found = dict(zip(of_logs, (start, start, start + 0.3), strict=True))
    bench = Bench([log] * 3, calibration, mounted, own_data=True)
    assert bench.calibrated(found).contact.clearance_sigma_rad == pytest.approx(np.hypot(0.1, 0.3))
    assert bench.calibrated(found).contact.clearance_rad == pytest.approx(start), "heat has moved the drive's"
    assert bench.calibrated(found, 2).contact.clearance_rad == pytest.approx(start + 0.3)
    # Of logs with curves that nothing has moved, the scatter is what it was; what was found is no other calibration's.
    of_drive = {of_logs[2]: start + 0.3}
    assert bench.calibrated(of_drive).contact.clearance_sigma_rad == pytest.approx(np.linalg.norm((1.4, 0.1, 0.3)))
    further = bench.under(bench.calibrated(found))
    assert further.calibrated(found).contact.clearance_sigma_rad == pytest.approx(np.hypot(0.1, 0.3))
    assert (
        bench.calibrated({})
        == calibration
        == moved(Bench([log] * 3, calibration, mounted).calibrated(found), {CLEARANCE: start})
    )


@pytest.mark.parametrize("known", [False, True])
def test_noise_of_the_current_counts_alike_where_its_constant_follows_it(calibration, known):
    """A twelfth of an ampere more is as much unexplained current at every sample. As the constant at the sample alone would
    have it, it would be up to half as much again, which least squares would reduce by a wrong exponent."""
    of = {"port": "torque_constant", "signal": "current", "shape": "even_power", "exponent": 2.0, "low": -20.0, "high": 20.0}
    term = Term(name="term:x", coefficient=0.3, scale=20.0, **of)
    follows = msgspec.structs.replace(calibration, terms=(term,))
    if known:
        follows = moved(calibration, {"effects.torque_saturation.loss_per_A2": 4e-4})
    log = log_of(next(drives(calibration, 54, {}, stops=2)))
    samples = log.samples.copy()
    samples["current_q"] += 1.0 / 12.0
    bench, more = Bench([log], follows), Bench([dataclasses.replace(log, samples=samples)], follows)
    left = bench.residuals({})["torque"]
    # Where the model is right: this brake's constant follows nothing.
    there = (left != 0.0) & (np.abs(left) < 300.0)
    assert np.abs(log.samples["current_q"][there]).max() > 8.0
    noise = (more.residuals({})["torque"] - left)[there]
    np.testing.assert_allclose(noise, bench.newton_per_ampere / 12.0, rtol=0.03)


def test_a_search_begins_with_what_signals_alone_tell_and_only_far_from_the_calibration(calibration):
    log, key = log_of(next(drives(calibration, 61, {}, stops=1))), "effects.signal_delay.delay_s"
    late = with_late(log, 5, "angle")
    bench = Bench([late], calibration)
    [(coordinate, age)] = search._told(Model.of(bench)).items()
    assert (coordinate.name, bench.told) == (key, {key: age}) and age == pytest.approx(0.02, abs=3e-4)
    assert not Bench([log], calibration).told and not Bench([late], moved(calibration, {key: 0.017})).told
    # Where friction has turned over is told by the motor, and not by the late angle.
    in_time, untold = (make_trial(which, 0, held(to_parameters(calibration))[0], {}).slides for which in (log, late))
    assert np.mean(bench.trials[0].slides != in_time) < 0.5 * np.mean(untold != in_time)


def test_a_ripple_keeps_its_phase_where_the_angles_are_when_its_order_moves(calibration):
    """The motor angle counts from anywhere: here it is 150 turns away, and a new order must not turn the ripple."""
    effect = next(e for e in REGISTRY if e.name == "gear_mesh_ripple")
    own, middle = effect_coordinates(calibration, effect, "torque"), 940.0
    values = {own["cosine"]: 0.03, own["sine"]: -0.04, own["order_per_turn"]: 4.6}
    apart = np.linspace(-5.0, 5.0, 50)

    def ripple(order):
        found = by_key(values | {own["order_per_turn"]: order}, middle)
        c, s = found["effects.gear_mesh_ripple.cosine"], found["effects.gear_mesh_ripple.sine"]
        return c * np.cos(order * (middle + apart)) + s * np.sin(order * (middle + apart))

    np.testing.assert_allclose(ripple(4.6), 0.03 * np.cos(4.6 * apart) - 0.04 * np.sin(4.6 * apart), atol=1e-12)
    np.testing.assert_allclose(ripple(4.61), ripple(4.6), atol=0.01 * 5.0 * 0.05)


def test_bench_runs_the_production_estimator(calibration):
    """With the contact angle held, the residual is reference minus what the daemon would say."""
    log = log_of(next(drives(calibration, 61, {})))
    p = to_parameters(calibration).copy()
    p["clearance_sigma"] = p["contact_walk"] = 0.0
    bench = Bench([log], calibration)
    expected = bench.trials[0].force_N - estimate(log.samples, p)["stiffness_force"]
    np.testing.assert_array_equal(bench.residuals({})["stiffness"], np.nan_to_num(expected))


@pytest.mark.parametrize(("moved_rad", "count"), [(0.0, None), (-64.0, None), (-64.0, 3)])
def test_with_heat_held_the_paths_are_those_of_the_step(calibration, moved_rad, count):
    """What a fit's derivatives run is the estimator to the last bit, and moves with a parameter as the whole step does. Where
    the resolver loses its zero the contact is learned anew with a slope that is a mean, by some hundredths of a newton. Where
    it comes back after some messages friction is what it was before."""
    samples = log_of(next(drives(calibration, 61, {}, stops=2))).samples
    # Where the motor stands after it has opened: there wrong messages of a motor that closes turn friction over.
    still = np.abs(samples["speed"]) < 2.0
    opened = np.convolve(samples["speed"] < -20.0, np.ones(100))[: len(samples)] > 0.0
    begin = int(np.flatnonzero(opened & (np.convolve(still, np.ones(60))[: len(samples)] == 60.0))[0])
    wrong = slice(begin, None if count is None else begin + count)
    samples["angle"][wrong] += moved_rad
    samples["speed"][wrong] += 20.0 * (count is not None)
    p = held(to_parameters(calibration))[0]
    stiffer = p.copy()
    stiffer["curve"] *= 1.01
    whole, heat = run_with_heat(samples, p)
    assert np.count_nonzero(heat["zero_moved"][begin]) == (moved_rad != 0.0)
    assert np.count_nonzero(heat["came_back"]) == (count is not None)
    fast = run_held(samples, p, heat)
    for name in ("force", "torque", "leverage", "torque_constant"):
        np.testing.assert_allclose(fast[name], whole[name], rtol=1e-5 if moved_rad else 0.0)
    change, expected = (
        run(stiffer) - base["force"]
        for run, base in (
            (lambda q: run_held(samples, q, heat)["force"], fast),
            (lambda q: run_step(samples, q)["force"], whole),
        )
    )
    assert rmse(change - expected) < 0.03 * rmse(expected)


def test_with_heat_held_friction_follows_an_angle_that_jitters_as_in_the_step(calibration):
    """Stamps of a busy computer do that, beside no speed: fits of a measured motor found nothing where both differed."""
    samples = log_of(next(drives(calibration, 61, {}, stops=2))).samples
    still = np.flatnonzero(np.abs(samples["speed"]) < 2.0)[::40]
    samples["angle"][still] += 0.03 * np.random.default_rng(1).choice([-1.0, 1.0], len(still))
    whole, heat = run_with_heat(samples, held(to_parameters(calibration))[0])
    assert not np.any(heat["zero_moved"])
    np.testing.assert_array_equal(run_held(samples, held(to_parameters(calibration))[0], heat)["torque"], whole["torque"])


def test_regressors_are_those_of_where_the_fit_ended(calibration, monkeypatch):
    """Of each coordinate over all logs, its own or not, also if the fit began with what an earlier one had left, and when
    something else has moved since."""
    logs = [log_of(next(drives(calibration, seed, {}, stops=2))) for seed in (61, 62)]
    first = Model.of(Bench(logs, calibration)).refined({"stiffness"})
    # A fit that goes no step ends where it began.
    monkeypatch.setattr(model_module, "_EVALUATIONS", 1)
    [conductivity] = [c for c in first.values if c.name == "thermal.pad.conductivity_W_per_mK"]
    for model in (first.refined({"stiffness"}), first.entered({conductivity: 1.2}).refined({"stiffness"})):
        for coordinate in model.own("stiffness"):
            moved = {**model.values, coordinate: model.values[coordinate] + coordinate.step}
            heat = [None, None] if coordinate.name == HISTORY_TIME else model.heat
            does = (model.residual["stiffness"] - model.bench.residual_held(moved, "stiffness", heat)) / coordinate.step
            np.testing.assert_allclose(model.columns[coordinate], does, atol=1e-9 * max(np.abs(does).max(), 1.0))


@pytest.mark.parametrize(
    ("late", "names", "found_s", "asked"),
    [
        (0, (), 0.0, {"stiffness", "torque"}),
        (12, ("angle",), 0.0, {"stiffness", "torque"}),
        (1, ("current_q",), 0.004, {"stiffness"}),
        (12, ("current_q",), 0.048, {"stiffness"}),
        (1, ("angle", "speed"), -0.004, {"stiffness"}),
        (12, ("angle", "speed"), -0.048, set()),
    ],
)
def test_paths_of_two_times_are_judged_and_not_searched(calibration, brake_log, late, names, found_s, asked):
    """The current changes when the motor accelerates, whatever the calibration says of either. A late angle alone is another
    matter, and a motion that is a sample late can be told by the catalogue's own test."""
    bench = Bench([with_late(brake_log, late, *names)], calibration)
    assert bench.current_late_s == pytest.approx(found_s, abs=1.5e-3)
    assert {"stiffness", "torque"} <= {*bench.channels}
    assert {channel for channel in ("stiffness", "torque") if bench.channel_of(channel)} == asked
    assert {c.channel for c in Model.of(bench).values} & {"stiffness", "torque"} == asked


@pytest.fixture(scope="module")
def brake_log(calibration):
    return log_of(next(drives(calibration, 57, {}, stops=1)))
