"""The catalogue of effects: complete, exactly neutral at zero, and each with the sign and the conditions of its physics."""

import ast
import dataclasses
import hashlib
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numba.core import config

import emb_daemon
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.effects import REGISTRY, signal_delay
from emb_daemon.effects.gear_mesh_ripple import cycle_mean
from emb_daemon.estimator.records import SAMPLE
from emb_daemon.models.wheel import wheel_angle
from emb_daemon.offline import estimate, log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import simulate_log
from studies.blind import campaign

DT = 0.004


_CALIBRATION = shipped_calibration()


def bare():
    """The shipped calibration without any effect."""
    return to_parameters(msgspec.structs.replace(_CALIBRATION, effects={}))


def with_effect(name, **values):
    p = bare()
    for effect in REGISTRY:
        if effect.name == name:
            for parameter in effect.shapes:
                p["effects"][name][parameter.name] = parameter.starts[0]
    for key, value in values.items():
        p["effects"][name][key] = value
    return p


def drive(seconds=12.0, wheel_speed=20.0):
    """A clamp from released to about 10 kN, held with a slow stroke on top, on a disc of constant speed; a fair current."""
    count = round(seconds / DT)
    samples = np.zeros(count, SAMPLE)
    time = DT * np.arange(count)
    angle = 20.0 * np.clip(time / 2.0, 0.0, 1.0) + 1.5 * np.sin(2.0 * (time - 2.0)) * (time > 2.0)
    samples["dt"] = np.where(np.arange(count) == 0, 0.0, DT)
    samples["angle"], samples["speed"] = angle, np.gradient(angle, DT)
    samples["wheel_speed"] = wheel_speed
    samples["wheel_pulse"] = np.floor(100.0 + 96.0 * wheel_speed * time / (2.0 * np.pi)) % 4096
    samples["inner_backplate"] = samples["outer_backplate"] = 22.0 + time
    samples["caliper"], samples["ambient"], samples["brake_torque"] = 40.0, 22.0, np.nan
    for name in ("has_thermocouple", "has_wheel_speed", "has_wheel_pulse", "has_status"):
        samples[name] = True
    # The current that this motion takes: one that contradicts it would put the contact angle in doubt.
    p = bare()
    force, turning = estimate(samples, p)["stiffness_force"], np.sign(samples["speed"])
    torque = p["gear_gain"] * force + turning * (p["offset_friction"] + p["load_friction"] * force)
    samples["current_q"], samples["has_current"] = torque / p["torque_constant"], True
    return samples


def test_the_catalogue_is_complete():
    """The names that scripts and people rely on."""
    promised = """
        disc_thickness_variation disc_thermal_expansion pad_wear torque_constant_fade current_offset viscous_friction
        stribeck_friction friction_asymmetry gear_mesh_ripple cogging_torque stiffness_hysteresis second_relaxation
        signal_delay backlash friction_coefficient_fade disc_radiation thermocouple_lag
    """
    assert set(promised.split()) <= {effect.name for effect in REGISTRY}


@pytest.mark.parametrize("effect", REGISTRY, ids=lambda effect: effect.name)
def test_an_effect_is_described(effect):
    assert effect.path in ("stiffness", "torque", "thermal")
    assert effect.equation and effect.source
    assert effect.amplitudes, "nothing switches it off"
    for parameter in effect.parameters:
        assert parameter.low < parameter.high and parameter.low <= parameter.prior <= parameter.high
        assert parameter.unit and parameter.meaning


#: `plant` is a brake of its own, with effects of its own.
_MAY_NAME = ("effects", "plant")


def test_nothing_else_knows_an_effect_by_name():
    package = Path(emb_daemon.__file__).parent
    files = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in _MAY_NAME]
    assert len(files) > 80
    for path in files:
        text = path.read_text()
        assert not [effect.name for effect in REGISTRY if effect.name in text], path


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"hook": "gearbox"}, "no hook gearbox"),
        ({"hook": "current"}, "current does not offer mean_speed"),
        # Composed with the others it would hide what they are given.
        *(({"name": name}, f"effect {name}: expected another") for name in ("travel", "mean_speed", "m", "value", "s")),
    ],
)
def test_an_effect_that_cannot_be_hooked_in_is_refused(changed, said):
    viscous = next(effect for effect in REGISTRY if effect.name == "viscous_friction")
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(viscous, **changed)


#: The log of a brake whose caliper widens as it warms up, so that the motor angle for a clamp force grows, for a package with
#: one file more and one line more in its list.
_ONE_MORE = """
import pickle, sys
from pathlib import Path
import numpy as np
from emb_daemon import offline
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose.diagnosis import diagnose
from emb_daemon.offline.run import held

calibration, log = shipped_calibration(), pickle.loads(Path(sys.argv[1]).read_bytes())
for widening in (0.0, 0.8):
    own = moved(calibration, {"effects.own_effect.widening_um_per_K": widening}, checked=True)
    error = offline.estimate(log.samples, held(to_parameters(own)))["stiffness_force"] - log.force_N
    print(np.sqrt(np.nanmean(error**2)))
result = diagnose([log], calibration)
print([(f.effect.name, f.values["widening_um_per_K"]) for f in result.accepted])
"""


def _of_a_widening_caliper():
    plant, rng = plant_from_calibration(_CALIBRATION, seed=5), np.random.default_rng(5)
    log = log_of(simulate_log(plant, campaign(plant, rng, 7), seed=1)[0])
    samples = log.samples.copy()
    knots = np.arange(0.0, log.time_s[-1] + 8.0, 8.0)
    warmth = np.interp(log.time_s, knots, [0.0, *rng.uniform(0.0, 60.0, len(knots) - 1)])
    wider = 1e-6 * 0.8 * warmth / _CALIBRATION.motor.gear_gain_m_per_rad
    samples["caliper"] += warmth
    samples["angle"] += wider
    samples["speed"] += np.gradient(wider, log.time_s)
    # The current is that of a motor that did not turn so.
    samples["has_current"] = False
    return dataclasses.replace(log, samples=samples)


@pytest.fixture
def one_more() -> Path:
    """A folder with a package that has one effect more, written anew each time. It is beside numba's for this state of the
    kernels, and what was compiled of it stays there."""
    root = Path(emb_daemon.__file__).parent.parent
    text = (root / "examples" / "own_effect.py").read_text().replace("caliper_widening", "own_effect")
    new = Path(config.CACHE_DIR) / f"one_more_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    for folder in ("emb_daemon", "config", "dbc"):
        shutil.copytree(root / folder, new / folder, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    effects = new / "emb_daemon" / "effects"
    (effects / "own_effect.py").write_text(text.partition('if __name__ == "__main__":')[0])
    registration = effects / "__init__.py"
    registration.write_text(
        registration.read_text().replace('    "thermocouple_lag",\n', '    "thermocouple_lag",\n    "own_effect",\n')
    )
    return new


@pytest.mark.trial
def test_one_file_and_one_line_more_and_step_and_diagnose_know_the_effect(one_more, tmp_path):
    (tmp_path / "log").write_bytes(pickle.dumps(_of_a_widening_caliper()))
    environment = os.environ | {"PYTHONPATH": str(one_more), "NUMBA_CACHE_DIR": str(one_more / "cache")}
    command = [sys.executable, "-c", _ONE_MORE, str(tmp_path / "log")]
    done = subprocess.run(command, env=environment, cwd=one_more, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    without, with_, found = done.stdout.splitlines()
    assert float(without) > 4.0 * float(with_)
    [(name, value)] = ast.literal_eval(found)
    assert name == "own_effect" and value == pytest.approx(0.8, rel=0.1)


@pytest.mark.parametrize("effect", REGISTRY, ids=lambda effect: effect.name)
def test_exactly_neutral_at_zero_whatever_its_shape(effect):
    samples, plain = drive(4.0), bare()
    shaped = bare()
    for parameter in effect.shapes:
        shaped["effects"][effect.name][parameter.name] = parameter.starts[-1]
    assert estimate(samples, plain).tobytes() == estimate(samples, shaped).tobytes()


@pytest.mark.parametrize("effect", REGISTRY, ids=lambda effect: effect.name)
def test_acts_on_its_own_path(effect):
    samples = drive()
    p = with_effect(effect.name, **{parameter.name: parameter.prior for parameter in effect.amplitudes})
    p["clearance_sigma"] = p["contact_walk"] = 0.0
    q = bare()
    q["clearance_sigma"] = q["contact_walk"] = 0.0
    changed, plain = estimate(samples, p), estimate(samples, q)
    stiffness = np.abs(changed["stiffness_force"] - plain["stiffness_force"]).max()
    torque = np.nanmax(np.abs(changed["torque_force"] - plain["torque_force"]))
    if effect.path == "stiffness":
        # Friction turns over with the motor, of which a late angle tells too late.
        assert stiffness > 5.0 and (torque > 0.0) == (effect.name == "signal_delay")
    elif effect.path == "torque":
        assert torque > 5.0
        # What the torque path says reaches the stiffness path only through the heat of the fused force.
        assert stiffness < 0.05 * torque
    else:
        assert np.nanmax(np.abs(changed["disc"] - plain["disc"])) > 1e-3
        assert torque == 0.0


def force(p, samples):
    p["clearance_sigma"] = p["contact_walk"] = 0.0
    return estimate(samples, p)["stiffness_force"]


def _turned(late_s, speed_late_s=0.0):
    """SAMPLE rows of a motor that turns to and fro, its angle and speed late, with noise and an offset of the speed."""
    rng, time = np.random.default_rng(3), 0.004 * np.arange(2500)
    rows = np.zeros(len(time), SAMPLE)
    rows["dt"][1:] = 0.004
    way = lambda t: 12.0 * np.sin(3.0 * t) ** 3  # noqa: E731
    rows["angle"] = way(time - late_s)
    rows["speed"] = np.gradient(way(time - speed_late_s), 0.004) + 0.3 * rng.standard_normal(len(time)) + 0.1
    return rows


@pytest.mark.parametrize("late_s", [0.0, 0.003, 0.01, 0.0317, 0.048])
def test_the_speed_tells_how_old_the_angle_is(late_s):
    age, sigma = signal_delay.measure(_turned(late_s))
    assert abs(age - late_s) < 5.0 * sigma + 1e-4 and sigma < 2e-4


def test_what_is_late_with_its_speed_or_before_it_is_not_old():
    for late_s, speed_late_s in ((0.03, 0.03), (0.0, 0.03)):
        assert signal_delay.measure(_turned(late_s, speed_late_s))[0] < 2e-4
    still = _turned(0.0)
    still["angle"] = still["speed"] = 0.0
    assert signal_delay.measure(still)[1] == signal_delay.measure(still[:30])[1] == np.inf


def test_thickness_variation_stands_still_with_the_wheel():
    standing = drive(wheel_speed=0.0)
    held = slice(600, None)
    p = with_effect("disc_thickness_variation", order_1_cosine_um=15.0)
    lever = with_effect("disc_thickness_variation")
    lever["clearance"] += 1e-3
    per_rad = (force(bare(), standing) - force(lever, standing))[held] / 1e-3
    shift = (force(p, standing) - force(bare(), standing))[held] / per_rad
    # One place on the disc: one shift of contact, whatever the force, and no more than 15 um of travel.
    assert np.ptp(shift) < 0.03 * 15e-6 / bare()["gear_gain"]
    assert np.abs(shift).max() < 1.1 * 15e-6 / bare()["gear_gain"]


def test_thickness_variation_comes_once_per_turn():
    samples = drive(20.0, wheel_speed=20.0)
    change = force(with_effect("disc_thickness_variation", order_1_sine_um=10.0), samples) - force(bare(), samples)
    held = change[2000:]
    spectrum = np.abs(np.fft.rfft(held - held.mean()))
    frequency = np.fft.rfftfreq(len(held), DT)
    assert frequency[np.argmax(spectrum)] == pytest.approx(20.0 / (2.0 * np.pi), abs=0.1)


def test_wheel_angle_goes_on_between_pulses_and_over_the_counter_s_end():
    count, speed = 15000, 30.0
    time = DT * np.arange(count)
    true = 0.3 + speed * time
    samples = np.zeros(count, SAMPLE)
    samples["dt"] = np.where(np.arange(count) == 0, 0.0, DT)
    # Messages come every 10 ms, pulses are counted modulo 4096, the speed is a little off.
    sent = np.floor(time / 0.010) * 0.010
    samples["wheel_pulse"] = np.floor((0.3 + speed * sent) * 96.0 / (2.0 * np.pi)) % 4096
    samples["wheel_speed"] = 1.002 * speed
    samples["has_wheel_pulse"] = samples["has_wheel_speed"] = True
    error = wheel_angle(samples) - true
    pulse = 2.0 * np.pi / 96.0
    # The message is up to 10 ms old; nothing drifts, nothing jumps at the counter's end.
    assert np.abs(error[100:]).max() < speed * 0.010 + 2.0 * pulse
    assert np.ptp(error[1000:]) < speed * 0.010 + pulse


def test_the_angle_of_a_fast_wheel_is_not_behind_that_of_a_slow_one():
    """Counts come between samples: taken for those of the sample, they are half a cycle old."""
    time, behind = DT * np.arange(15000), []
    for speed in (10.0, 50.0):
        samples = np.zeros(len(time), SAMPLE)
        samples["dt"] = np.diff(time, prepend=0.0)
        # Messages and samples have no common clock.
        sent = np.floor(time / 0.0103) * 0.0103
        samples["wheel_pulse"] = np.floor(speed * sent * 96.0 / (2.0 * np.pi)) % 4096
        samples["wheel_speed"] = speed
        samples["has_wheel_pulse"] = samples["has_wheel_speed"] = True
        behind.append(np.mean((speed * time - wheel_angle(samples))[1000:]))
    assert abs(behind[1] - behind[0]) < 40.0 * 0.0005


def test_hot_disc_brings_contact_earlier_and_wear_brings_it_later():
    samples = drive(wheel_speed=50.0)
    plain = force(bare(), samples)
    assert (force(with_effect("disc_thermal_expansion", growth_um_per_K=0.5), samples) - plain)[-1] > 5.0
    assert (force(with_effect("pad_wear", wear_um_per_MJ=50.0), samples) - plain)[-1] < -5.0


def test_pads_that_yield_press_less_the_longer_they_are_held():
    """Exponentially, from an excess that is the element's share of the static force. Over a stroke to and fro they take work:
    a Maxwell element is passive."""
    rows = np.zeros(4000, SAMPLE)
    p, q = with_effect("stress_relaxation", share=0.1, time_constant_s=0.5), bare()
    for record in (p, q):
        record["relaxation_time"] = 0.0
    rows["dt"][1:], rows["has_current"] = DT, False
    reached = p["clearance"] + 10.0
    rows["angle"] = np.concatenate([np.zeros(500), np.full(2500, reached), np.linspace(reached, 0.0, 1000)])
    excess = force(p, rows) - force(q, rows)
    static = force(q, rows)[2999]
    held_s = DT * np.arange(1, 2000)
    assert excess[501:2500] == pytest.approx(0.1 * static * np.exp(-held_s / 0.5), abs=0.01 * static)
    stroke = rows[:2000].copy()
    stroke["angle"] = 0.5 * reached * (1.0 - np.cos(2.0 * np.pi * np.arange(2000) / 2000))
    stroke["speed"] = np.gradient(stroke["angle"], DT)
    work, elastic = (np.trapezoid(force(record, stroke), stroke["angle"]) for record in (p, q))
    assert work > 10.0 * abs(elastic) and work > 0.01 * static


def test_backlash_is_lost_only_after_a_reversal():
    samples = drive()
    change = force(with_effect("backlash", play_rad=0.2), samples) - force(bare(), samples)
    assert np.all(change[:480] == 0.0)
    releasing = samples["speed"] < -1.0
    assert change[releasing].mean() > 20.0


def test_friction_terms_take_torque_with_the_sign_of_motion():
    samples = drive()
    plain = estimate(samples, bare())["torque_force"]
    moving = (np.abs(samples["speed"]) > 1.0) & np.isfinite(plain) & (plain > 200.0)
    up = samples["speed"] > 0.0
    for name, values in (
        ("viscous_friction", {"viscous_Nms_per_rad": 1e-3}),
        ("stribeck_friction", {"rise": 0.5, "speed_rad_per_s": 20.0}),
    ):
        change = estimate(samples, with_effect(name, **values))["torque_force"] - plain
        assert np.median(change[moving & up]) < 0.0 < np.median(change[moving & ~up]), name
    asymmetric = estimate(samples, with_effect("friction_asymmetry", asymmetry=0.2))["torque_force"] - plain
    assert np.median(asymmetric[moving & up]) < 0.0 and np.median(asymmetric[moving & ~up]) < 0.0


def test_ripple_is_averaged_over_the_cycle():
    fine = np.linspace(2.0, 3.0, 20001)
    mean = np.trapezoid(0.3 * np.cos(7.0 * fine) - 0.2 * np.sin(7.0 * fine), fine)
    assert cycle_mean(0.3, -0.2, 7.0, 3.0, 1.0) == pytest.approx(mean, abs=1e-8)
    assert cycle_mean(0.3, -0.2, 7.0, 3.0, 1e-9) == pytest.approx(0.3 * np.cos(21.0) - 0.2 * np.sin(21.0))


def _variation(samples):
    """What a known thickness variation adds to the clamp force, N."""
    p = with_effect("disc_thickness_variation", order_1_cosine_um=15.0)
    return force(p, samples) - force(bare(), samples)


def test_a_pause_of_the_pulses_is_bridged_by_the_wheel_speed():
    """Even one over which the counter begins anew: 15 s at 80 rad/s are 190 turns, 43 to a round of the counter."""
    whole = drive(20.0, wheel_speed=80.0)
    samples = whole.copy()
    samples["has_wheel_pulse"][1000:4750] = False
    np.testing.assert_allclose(_variation(samples)[4800:], _variation(whole)[4800:], atol=10.0)


def test_a_phase_that_nothing_tells_is_no_thickness_but_a_doubt():
    samples = drive()
    samples["has_wheel_pulse"][1500:2000] = samples["has_wheel_speed"][1500:2000] = False
    change = _variation(samples)
    assert np.abs(change[:1500]).max() > 20.0
    assert np.abs(change[1700:]).max() < 1.0
    sigmas = [estimate(samples, with_effect("disc_thickness_variation", order_1_cosine_um=um))["sigma"] for um in (15.0, 0.0)]
    held = np.arange(len(samples)) > 2100
    # Both have doubts of this rough drive in common.
    assert np.all(np.sqrt(np.maximum(sigmas[0] ** 2 - sigmas[1] ** 2, 0.0))[held] > 200.0)


def test_a_caliper_keeps_its_temperature_when_its_thermocouple_is_lost():
    """The motor beside it has not cooled to the datasheet's temperature either: its torque is what it was."""
    p = with_effect("torque_constant_fade", fade_per_K=0.005, disc_share=0.0)
    samples = drive()
    samples["caliper"] = 90.0
    whole = estimate(samples, p)["torque_force"]
    samples["has_thermocouple"][1500:] = False
    np.testing.assert_allclose(estimate(samples, p)["torque_force"][1500:], whole[1500:], rtol=0.02)
