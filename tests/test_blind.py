"""The blind test on drawn brakes (`studies.blind`): its short form, its draws and its score."""

from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter

from emb_daemon.plant.brake import ONSET, POWER
from emb_daemon.plant.brake import SIGNALS as PLANT_SIGNALS
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import simulate_log
from emb_daemon.wire.contract import CYCLE_S
from studies import blind
from studies.blind import run_trial
from studies.drives import rig_drag
from studies.strangers import draw_stranger


@pytest.mark.trial
def test_blind(calibration):
    """The short version of the blind test; `python -m studies.blind` is the whole."""
    trial = run_trial(calibration, 21140, "pair", ("friction_asymmetry", "cogging_torque"), 319.5, stops=5)
    assert trial.named, trial
    assert trial.after < 45.0
    assert trial.after < 1.05 * trial.before
    assert trial.contribution_error < 0.15


@pytest.mark.trial
def test_a_term_of_the_heat_balance_is_named_and_carries_over(calibration, monkeypatch):
    """A disc that cools faster the hotter it is: conductances alone leave 2.0 K of the temperatures on another log."""
    monkeypatch.setattr(blind, "what_is_left", lambda *_: {})
    monkeypatch.setattr(blind, "heat_campaign", partial(blind.heat_campaign, drags=2))
    trial = run_trial(calibration, 80000, "heat", (), 8.0)
    assert trial.named and list(trial.found) == ["term:disc_cooling:disc_temperature"], trial
    assert trial.kelvin[0] > 6.0 and trial.kelvin[1] < 0.8


@pytest.mark.trial
def test_a_ripple_of_a_sixth_of_the_current_s_noise_is_named_once_its_order_is_fitted(calibration, monkeypatch):
    """As its order was scanned a dozen effective episodes leave it unsure; it is most of what lasts of the torque residual."""
    monkeypatch.setattr(blind, "what_is_left", lambda *_: {})
    trial = run_trial(calibration, 20280, "single", ("gear_mesh_ripple",), 75.0)
    assert trial.named, trial
    assert trial.found["gear_mesh_ripple"]["order_per_turn"] == pytest.approx(
        trial.hidden["gear_mesh_ripple"]["order_per_turn"], rel=0.01
    )


@pytest.mark.parametrize(
    ("found", "changed", "named"),
    [({}, ("backlash",), True), ({}, (), False), ({"backlash": {}}, (), False), ({}, ("backlash", "cogging_torque"), False)],
)
def test_a_change_is_named_as_a_change_of_that_effect_and_no_other(found, changed, named):
    trial = blind.Trial(1, "changed", {"backlash": {}}, 150.0, found, 90.0, 27.0, None, changed=changed)
    assert trial.named is named


@pytest.mark.parametrize(
    ("hidden", "named", "among_equals"),
    [("current_offset", True, True), ("friction_asymmetry", False, True), ("viscous_friction", False, False)],
)
def test_an_effect_counts_among_equals_where_the_report_says_that_it_may_be_there_instead(hidden, named, among_equals):
    found, alike = {"current_offset": {}, "backlash": {}}, {"current_offset": ["friction_asymmetry"]}
    trial = blind.Trial(1, "pair", {hidden: {}, "backlash": {}}, 150.0, found, 90.0, 27.0, None, alike=alike)
    assert trial.named is named and trial.named_among_equals is among_equals


@pytest.mark.parametrize(
    ("alike", "among_equals"),
    [([], False), (["term:gear_gain:disc_temperature"], True), (["term:gear_friction:disc_temperature"], False)],
)
def test_truth_counts_among_equals_only_where_the_report_names_it(alike, among_equals):
    values = {"size": 0.1, "signal": float(PLANT_SIGNALS.index("disc_temperature")), "other": -1.0}
    found = {"term:gear_gain:pad_temperature": {}}
    trial = blind.Trial(
        1, "drawn", {"drawn_gear_gain": values}, 150.0, found, 90.0, 27.0, None, alike={next(iter(found)): alike}
    )
    assert not trial.named and trial.named_among_equals is among_equals


def test_the_blind_test_goes_on_where_it_was_stopped(monkeypatch, tmp_path, capsys):
    ran = []

    def pretend(calibration, seed, kind, names, size, stops):
        ran.append(seed)
        return blind.Trial(seed, kind, {name: {} for name in names}, size, {}, 30.0, 27.0, None)

    monkeypatch.setattr(blind, "run_trial", pretend)
    output = tmp_path / "blind.jsonl"
    none = [part for kind in ("single", "triples", "changed", "foreign", "drawn", "heat") for part in (f"--{kind}", "0")]
    few = [*none, "--pairs", "1", "--output", str(output)]
    assert blind.main(["--null", "2", *few]) == 0
    output.write_bytes(output.read_bytes()[:-20])
    assert blind.main(["--null", "3", *few]) == 0
    # The line that was cut is run again, and the new plant; nothing else.
    assert ran[:3] == [1000, 1001, 40000] and sorted(ran[3:]) == [1002, 40000]
    assert blind.main(["--null", "5", *none, "--pairs", "0", "--seeds", "1004"]) == 0 and ran[5:] == [1004]
    table = capsys.readouterr().out
    assert "| no effect | 3 | 3/3 | 3/3 | 0 |" in table and "| two effects | 1 | 0/1 | 0/1 | 0 |" in table


def test_the_blind_test_counts_how_often_the_report_is_right_that_something_is_left():
    rest = {
        "something": blind.Rest(60.0, 30.0, 30.0, True),
        "unsaid": blind.Rest(60.0, 30.0, 30.0, False),
        "nothing": blind.Rest(31.0, 30.0, 30.0, False),
        "between": blind.Rest(40.0, 30.0, 30.0, True),
    }
    trial = blind.Trial(1, "null", {}, 0.0, {}, 90.0, 27.0, None, left=rest)
    assert "`unexplained.present`: right on 2 of 3 paths; on 1 more either is." in blind.summary([trial])


def _hidden(port, signal, size=1.0, shape=POWER, other=None, exponent=1.0, lag_s=0.0):
    which = {key: float(PLANT_SIGNALS.index(name)) if name else -1.0 for key, name in (("signal", signal), ("other", other))}
    return {f"drawn_{port}": {"size": size, "shape": shape, "exponent": exponent, "lag_s": lag_s} | which}


def test_a_drawn_effect_that_no_brake_can_have_is_drawn_again(calibration, monkeypatch):
    """A drag at 4 kN: what begins at 10 kN does nothing there at any size, and what a steep power of the disc's speed adds
    while the disc runs up is more than pads can be stiffer, if it is to be felt where it turns slowly."""
    plant = plant_from_calibration(calibration, seed=5)
    schedule = rig_drag(4000.0, 20.0, 8.0) + rig_drag(200.0, 60.0, 2.0)
    nothing = _hidden("gear_gain", "clamp_force", shape=ONSET)
    beyond = _hidden("stiffness", "disc_speed", exponent=2.6, other="disc_speed")
    usual = _hidden("stiffness", "brake_torque", exponent=0.7)
    draws, asked, sized = iter([nothing, beyond, usual]), [], blind.sized
    monkeypatch.setattr(blind, "draw_foreign", lambda rng, family: next(draws))
    monkeypatch.setattr(blind, "sized", lambda *arguments: asked.append(sized(*arguments)) or asked[-1])
    drawn = blind.draw_sized(plant, schedule, calibration, np.random.default_rng(0), 150.0, seed=5)
    assert asked == [None, None, drawn] and 0.0 < drawn["drawn_stiffness"]["size"] < 0.5


def test_a_seed_stays_the_same_brake():
    """Campaigns and calibrations that were kept are of it, whatever of its samples the diagnosis judges since."""
    assert draw_stranger(94).effects["drawn_torque_constant"]["size"] == pytest.approx(0.64697, abs=1e-5)


def test_what_a_drawn_effect_adds_is_what_the_plant_says(calibration):
    effect = _hidden("gear_gain", "brake_torque", size=0.1, exponent=2.0, other="clamp_force", lag_s=0.5)
    plant = plant_from_calibration(calibration, seed=5)
    truth = simulate_log(plant, rig_drag(4000.0, 20.0, 2.0), seed=5)[1][:, 0]
    at_once = 0.1 * (truth["brake_torque"] / 1000.0) ** 2 * truth["force"] / 10000.0
    share = CYCLE_S / 0.5
    np.testing.assert_allclose(blind.amounts(effect, truth), lfilter([share], [1.0, share - 1.0], at_once), rtol=1e-6)
