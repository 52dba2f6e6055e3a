"""What is left: whether it is said, over which signal, and held against what."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from diagnosekit import drives

from emb_daemon.calibration.parameters import moved
from emb_daemon.diagnose import diagnosis
from emb_daemon.diagnose.coordinates import Coordinate
from emb_daemon.diagnose.diagnosis import diagnose
from emb_daemon.diagnose.evidence import Averaging
from emb_daemon.diagnose.model import LASTING, Model, noise_left, rms_known
from emb_daemon.diagnose.page import _left
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.screening import Candidate, Screening
from emb_daemon.diagnose.selection import Selection
from emb_daemon.diagnose.signals import MANOEUVRES, smooth_basis
from emb_daemon.diagnose.text import _unexplained, least_left, verdict
from emb_daemon.diagnose.unexplained import Dependence, Left, achieved, noise_of_means
from emb_daemon.effects.stribeck_friction import EFFECT
from emb_daemon.effects.terms import SIGNALS
from emb_daemon.offline import log_of
from emb_daemon.offline.score import rmse
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import rest, simulate_log
from emb_daemon.report.page import Page
from emb_daemon.wire.contract import CYCLE_S
from studies.drives import rig_stop
from studies.strangers import draw_brake


def _of(*left, bench):
    """A diagnosis of which so much is left, most of the first."""
    by_channel = {one.channel: one for one in left}
    return SimpleNamespace(unexplained=left[0], left=by_channel, bench=bench, findings=(), withdrawn=())


def test_what_is_left_of_each_path_is_said_and_not_only_what_depends_on_a_signal():
    bench = SimpleNamespace(own_data=False, calibration=SimpleNamespace(provenance=object()))
    torque = Left("torque", 140.0, 120.0, 0.4, (Dependence("torque", "motor_speed", 0.11, 46.5, 4.0, True),))
    stiffness = Left("stiffness", 67.7, 50.0, 0.5, (Dependence("stiffness", "energy", 0.2, 30.0, 4.0, True),))
    nothing = Left("temperature", 2.0, 3.0, 1.0, ())
    first, second = _unexplained(_of(torque, nothing, stiffness, bench=bench))
    assert "140 N RMS of the torque path, where 120 N are what" in first and "on motor speed (by 46.5 N). What would" in first
    assert second.startswith("Nor explained") and "67.7 N RMS of the stiffness path" in second and "energy (by 30 N)" in second


def test_there_is_a_manoeuvre_for_every_signal():
    assert set(MANOEUVRES) >= {*SIGNALS, "motor_acceleration", "disc_angle"}


@pytest.mark.parametrize(("channel", "signal"), [("temperature", "disc_temperature"), ("torque", "winding_heat")])
def test_the_page_tells_what_is_left_where_it_has_nothing_to_draw_it_over(channel, signal):
    """Temperatures have times of their own, and the motor's heat only the estimator has."""
    left = Left(channel, 3.0, 1.0, 0.5, (Dependence(channel, signal, 0.3, 2.0, 4.0, True),))
    samples, columns = np.ones(900), {"disc_temperature": np.ones(500)}
    selection = SimpleNamespace(
        screening=SimpleNamespace(initial={channel: samples}, signals=columns), at_first={},
        model=SimpleNamespace(residual={channel: samples}),
    )  # fmt: skip
    bench = SimpleNamespace(own_data=False, calibration=SimpleNamespace(provenance=None))
    told = SimpleNamespace(left={channel: left}, selection=selection, unexplained=left, bench=bench)
    written = Page("", "")
    _left(written, told)
    assert signal.replace("_", " ") in written.render()


def test_whether_something_matters_can_be_written_as_json():
    """Where the residual and not the force sets the limit, too: a change of a calibrated effect ended in a traceback."""
    model = SimpleNamespace(noise=lambda channel: 1e6, lasting=lambda channel, samples: 1e6)
    limit = Screening.floor(SimpleNamespace(_size={"torque": 1e3}), model, "torque")
    assert limit == pytest.approx(60.0) and json.dumps(limit <= 70.0) == "true"


def test_what_matters_of_a_torque_its_noise_from_sample_to_sample_does_not_raise():
    """An effect that has a name need do no more than a term must: of friction that rises at rest (75 N) 31 N are left beside
    what is refitted, where a current's noise of 570 N asked for 34 N and no brake with nothing hidden shows 15 N."""

    def limit(noise_N):
        model = SimpleNamespace(noise=lambda channel: 120.0**2 + noise_N**2, lasting=lambda channel, samples: 120.0**2)
        return Screening.floor(SimpleNamespace(_size={"torque": 5e3}), model, "torque")

    assert limit(100.0) < limit(560.0) == limit(900.0) < 31.0


def _unsearched(bench, progress):
    start = Model.of(bench)
    return Selection(start.refined(bench.channels), Screening(bench, start))


def _some_stops_off(log, calibration, name="frames"):
    """The same log with a torque that is off by 15 % in some stops."""
    clamped = log.force_N > 500.0
    stop = np.cumsum(np.diff(clamped, prepend=False) & clamped)
    signs = np.random.default_rng(5).choice([0.0, 0.15], stop.max() + 1)
    samples = log.samples.copy()
    factor = calibration.motor.gear_gain_m_per_rad / calibration.motor.torque_constant_Nm_per_A
    samples["current_q"] += np.where(clamped, signs[stop] * factor * log.force_N, 0.0)
    return dataclasses.replace(log, samples=samples, path=Path(name))


@pytest.mark.trial
def test_torque_that_nothing_explains_is_said_and_stated_to_the_filter(calibration, monkeypatch):
    """A torque that is off by 15 % in some stops and right in others: the filter would take it for other pads. What this
    unit's gear has of its own is less than the 4.7 % that the calibration grants. It is said although it drowns in the
    current's noise sample by sample."""

    monkeypatch.setattr(diagnosis, "select", _unsearched)
    log, another = map(log_of, drives(calibration, 54, {}, stops=8))
    result = diagnose([log], calibration)
    assert result.calibration.noise.torque_lasting == 0.0 and "Some stops" not in verdict(result)
    assert not result.left["torque"].beyond
    result = diagnose([_some_stops_off(log, calibration)], calibration)
    # Half of it, as a mean is no change, and more where friction helps the brake to open.
    assert 0.05 < result.calibration.noise.torque_lasting < 0.12
    assert "Some stops leave the torque off" in verdict(result)
    achieved = calibration.provenance.achieved["torque_N"]
    assert result.left["torque"].beyond and rmse(result.selection.model.residual["torque"]) < 1.5 * achieved
    stated = moved(calibration, {"noise.torque_lasting": 0.3})
    assert diagnose([log], stated).calibration.noise.torque_lasting == 0.3
    # Of one log among others it is said, too.
    result = diagnose([log], calibration, [another] * 12 + [_some_stops_off(another, calibration, "off.log")])
    left = result.left["torque"]
    assert left.beyond and left.log == "off.log" and "torque path on off.log" in verdict(result)
    residual, means = result.judges.residuals({})["torque"], result.judges.means("torque", LASTING["torque"])
    number = np.concatenate([np.full(len(trial.episode), trial.index) for trial in result.judges.trials])
    each = [rms_known(np.where(number == own, residual, 0.0), means) for own in range(number[-1] + 1)]
    assert rmse(np.array(each)) < 1.5 * left.achieved < each[-1]


@pytest.mark.parametrize(("off_N", "seconds", "said"), [(95.0, 8.0, True), (85.0, 8.0, False), (95.0, 0.02, False)])
def test_what_is_left_in_one_stop_of_forty_is_said_where_it_is_beyond_chance_and_matters(off_N, seconds, said):
    """A term that holds on the stops that were fitted, and not on the one that is hotter."""
    count, length = 40, 2000
    episode, time_s = np.repeat(np.arange(count), length), CYCLE_S * np.arange(count * length)
    noise = np.random.default_rng(3).normal(0.0, 20.0, count * length)
    stop = (episode == 17) & (np.arange(len(episode)) % length < seconds / CYCLE_S)
    after = np.where((episode == 17) & ~stop, 0.0, noise + off_N * stop)
    trials = [
        SimpleNamespace(episode=part, force_N=np.full(len(part), 5e3), log=SimpleNamespace(time_s=time))
        for part, time in zip(np.split(episode, 2), (time_s[: len(time_s) // 2],) * 2, strict=True)
    ]
    bench = SimpleNamespace(
        has_reference=True, own_data=False, episode={"stiffness": episode}, episodes=count, trials=trials,
        sources=["one.log", "other.log"], means=lambda channel, samples: Averaging(episode, samples),
    )  # fmt: skip
    screening = SimpleNamespace(floor=lambda *_: 10.0, achieved=lambda *_: 40.0)
    found = diagnosis._in_one_episode(SimpleNamespace(screening=screening, model=None), bench, 2.0 * after, after)
    assert (found is not None) is said
    assert rms_known(after, bench.means("stiffness", LASTING["stiffness"])) < 40.0
    if found:
        first, last, known, log, at_s = found
        assert (
            (known, log) == (40.0, "one.log") and first == pytest.approx(2.0 * last) and last == pytest.approx(off_N, rel=0.02)
        )
        assert at_s == pytest.approx(17.5 * length * CYCLE_S, rel=1e-3)
        left = Left("stiffness", last, known, 0.25, (Dependence("stiffness", "energy", 0.1, 4.0, 1.0, False),), log, at_s)
        bench = SimpleNamespace(own_data=False, calibration=SimpleNamespace(provenance=object()))
        [told] = _unexplained(_of(left, bench=bench))
        assert left.beyond and "on one.log at 140 s" in told and "energy" not in told


@pytest.mark.parametrize(
    ("made", "left_N", "said"), [(True, 26.0, True), (True, 21.0, False), (True, 26.0 / 3.0, False), (False, 26.0, False)]
)
def test_a_term_that_leaves_clearly_more_of_other_logs_than_of_the_fitted_ones_is_said(made, left_N, said):
    """Its shape is a guess beyond them. Logs in which nothing was found differ as the calibration's own do."""
    episode = np.repeat(np.arange(4), 100)
    own_N = left_N / 26.0 * 15.0 if left_N < 15.0 else 15.0
    bench = SimpleNamespace(
        has_reference=True, trials=[SimpleNamespace(force_N=np.full(400, 5e3))],
        means=lambda channel, samples: Averaging(episode, samples),
    )  # fmt: skip
    selection = SimpleNamespace(
        accepted=("any",), candidates={"any": SimpleNamespace(made=made)}, channel_of=lambda name: "stiffness",
        model=SimpleNamespace(bench=bench, residual={"stiffness": np.full(400, own_N)}),
        screening=SimpleNamespace(floor=lambda *_: 10.0, achieved=lambda *_: 40.0),
    )  # fmt: skip
    fitted = diagnosis._left_of_fitted(selection, "stiffness", left_N, 44.0)
    left = Left("stiffness", left_N, 44.0, 0.25, (Dependence("stiffness", "energy", 0.1, 4.0, 1.0, False),), fitted=fitted)
    assert left.present is said
    if said:
        bench = SimpleNamespace(own_data=False, calibration=SimpleNamespace(provenance=object()))
        [told] = _unexplained(_of(left, bench=bench))
        assert "26 N RMS" in told and "16.5 N are left of the logs in which" in told and "energy" not in told


def test_what_lasts_of_a_torque_is_that_of_sliding_friction(calibration):
    """How friction turns over is within the calibration's noise; errors while it slides count in full."""
    bench = Bench([log_of(next(drives(calibration, 54, {}, stops=3)))], calibration)
    [trial], means = bench.trials, bench.means("torque", LASTING["torque"])
    assert 0.01 < np.mean(~trial.slides) < 0.2
    assert rms_known(np.where(trial.slides, 0.0, 900.0), means) == 0.0
    assert rms_known(np.where(trial.slides, 100.0, 900.0), means) == pytest.approx(100.0)


def test_an_uneven_disc_is_no_error_of_the_torque():
    """It turns the friction of a gear that holds back and forth by less than a resolver tells: half a kilonewton that the gear
    of a brake with much friction seems to have where force is held long, and no cause of its own."""
    uneven = {"disc_thickness_variation": {"order_1_cosine_um": 12.0, "order_2_sine_um": 16.0}}
    hidden = uneven | {"stribeck_friction": {"rise": 0.75, "speed_rad_per_s": 12.0}}
    brake = draw_brake(np.random.default_rng(92))
    high, schedule = brake.stiffness.maximum_force_N, rest(1.0)
    for share in (0.3, 0.5, 0.2):
        schedule += rig_stop(share * high, 50.0, 3.0, 6.5)
    frames, _ = simulate_log(plant_from_calibration(brake, seed=92, effects=hidden), schedule, seed=92)
    known = moved(brake, {f"effects.{e}.{k}": v for e, values in hidden.items() for k, v in values.items()})
    bench = Bench([log_of(frames)], known)
    means, [trial] = bench.means("torque", LASTING["torque"]), bench.trials
    judged = bench.residuals({})["torque"]
    trial.yields[:] = False
    everything = bench.residuals({})["torque"]
    apart = np.where(judged == everything, 0.0, everything)
    assert rms_known(apart, means) > 400.0 > 2.0 * rms_known(judged, means)


def test_a_second_cause_is_no_shadow_of_the_largest():
    """An effect that only imitates another explains nothing beside a smooth function of that one's signal; a second cause
    keeps its gain."""
    rng, count, length = np.random.default_rng(4), 40, 60
    heat, speed = rng.uniform(0.0, 1.0, count * length), rng.uniform(-1.0, 1.0, count * length)
    shadow = (heat > 0.9).astype(float)
    left = 800.0 * heat**2 + 400.0 * speed + rng.normal(0.0, 50.0, count * length)
    episode = np.repeat(np.arange(count), length)
    bench = SimpleNamespace(
        episode={"torque": episode}, episodes=count, shows_turning=lambda channel: False,
        means=lambda channel, samples: Averaging(episode, samples),
    )  # fmt: skip
    model = Model(bench, {}, {"torque": left}, [])
    screening = Screening.__new__(Screening)
    screening.signals = {"caliper_temperature": heat, "clamp_force": np.full(count * length, 1.0)}
    screening._size = {"torque": 1e3}
    reasons = []
    for column in (speed, shadow):
        evidence = model.evidence("torque", [column])
        own = Coordinate("effects.any", "torque", 0.0, 1.0, np.inf, ())
        found = Candidate(EFFECT, "torque", (own,), (), (column,), evidence, gain=model.rms(evidence.gain, "torque"))
        reasons.append(screening.plausible(model, found, {}).reason)
    assert not reasons[0] and "shadow of something else" in reasons[1]


def test_a_residual_s_own_shadow_is_no_rival(monkeypatch):
    """The torque path's residual is computed from the current, so that a function of the current explains it whatever its
    cause."""
    gains = {"current": 900.0, "motor_acceleration": 800.0, "motor_speed": 700.0}
    shadows = {name: (np.array([1000.0]), np.array([1000.0 - gain])) for name, gain in gains.items()}
    monkeypatch.setattr(Screening, "dependence", lambda self, model, channel, samples: shadows)
    screening = Screening.__new__(Screening)
    assert screening.rival(None, "torque", {}) == (700.0, "motor_speed")
    assert screening.rival(None, "innovation", {}) == (800.0, "motor_acceleration")
    assert screening.rival(None, "stiffness", {}) == (900.0, "current")


def test_a_signal_that_stands_explains_nothing():
    """The angle of a disc that never turned is constant, and its cosine an offset, which has other causes."""
    force = np.linspace(0.0, 5000.0, 100)
    for name in ("disc_angle", "pad_temperature"):
        assert smooth_basis(name, np.full(100, 0.3), force).shape == (100, 0)
        assert smooth_basis(name, np.linspace(0.0, 0.3, 100), force).shape[1]


@pytest.mark.parametrize(("share", "named"), [(1e-17, None), (0.2, "disc_angle")])
def test_what_is_left_names_a_signal_only_for_a_share_worth_a_word(share, named):
    left = Left("torque", 315.0, 145.0, 0.6, (Dependence("torque", "disc_angle", share, 100.0, 0.3, matters=False),))
    assert left.present
    assert (left.strongest.signal if left.strongest else None) == named


@pytest.mark.parametrize(("rms", "present"), [(50.0, False), (70.0, True)])
def test_what_is_left_is_held_against_what_the_calibration_achieved(rms, present):
    assert Left("stiffness", rms, 41.0, 0.3, ()).present is present


@pytest.mark.parametrize(("own_data", "measured"), [(True, True), (False, True), (False, False)])
def test_nothing_was_achieved_by_a_calibration_that_nobody_measured(calibration, own_data, measured):
    """The page on rigs of one's own takes out the provenance of the calibration that is shipped."""
    known = calibration if measured else msgspec.structs.replace(calibration, provenance=None)
    told = least_left(SimpleNamespace(bench=SimpleNamespace(own_data=own_data, calibration=known)))
    assert ("achieved on its own data" in told) == (measured and not own_data) and ("noise" in told) != ("achieved" in told)


def test_what_the_calibration_achieved_is_its_figure_unless_its_noise_is_more(calibration):
    force, none = np.full(100, 5000.0), np.zeros(0)
    noise = achieved(msgspec.structs.replace(calibration, provenance=None), "stiffness", force, none)
    for figure, expected in ((2.0 * noise, 2.0 * noise), (0.5 * noise, noise)):
        provenance = msgspec.structs.replace(calibration.provenance, achieved={"stiffness_N": figure, "torque_N": 9e3})
        found = achieved(msgspec.structs.replace(calibration, provenance=provenance), "stiffness", force, none)
        assert found == pytest.approx(expected)


def test_of_what_the_calibration_achieved_means_keep_what_lasts(calibration):
    """Noise of single samples by the root of their number, what lasts for a manoeuvre whole."""
    force, none = np.full(100, 5000.0), np.zeros(0)
    white = moved(calibration, {"noise.current_correlation_s": 0.5 * CYCLE_S})
    one, many = (achieved(white, "torque", force, none, samples) for samples in (1, 32))
    assert many == pytest.approx(one / np.sqrt(32.0), rel=0.01)
    slow = moved(calibration, {"noise.current_correlation_s": 100.0})
    assert achieved(slow, "torque", force, none, 32) == pytest.approx(one, rel=0.01)
    lasting = moved(white, {"noise.torque_lasting": 0.1})
    assert achieved(lasting, "torque", force, none, 32) == pytest.approx(np.hypot(many, 500.0), rel=0.1)


@pytest.mark.parametrize("alike", [0.0, 0.4])
def test_noise_of_means_is_what_a_sensor_s_filter_leaves_of_them_and_nothing_slower(alike):
    """White noise, and such in which neighbouring samples are alike, beside a residual that lasts for seconds."""
    rng = np.random.default_rng(5)
    white = rng.standard_normal(60000)
    noise = np.zeros_like(white)
    for index in range(1, len(white)):
        noise[index] = alike * noise[index - 1] + white[index]
    means = noise.reshape(-1, 32).mean(axis=1)
    slow = np.sin(2.0 * np.pi * np.arange(len(white)) / 500.0)
    for residual in (noise, noise + slow):
        assert noise_of_means(residual, 32) == pytest.approx(32.0 * means.var(), rel=0.1)


def test_each_mean_has_its_noise_in_its_own_episode_however_few_samples_it_is_of():
    rng = np.random.default_rng(6)
    episode = np.repeat([0, 1, 2], [32000, 16000, 3200])
    means = Averaging(episode, 32, rng.uniform(size=len(episode)) < 0.5)
    residual = rng.standard_normal(len(episode))
    model = SimpleNamespace(bench=SimpleNamespace(episodes=3, means=lambda *_: means), residual={"torque": residual})
    # Samples that do not count say nothing of noise, so neighbours that both count do.
    left = noise_left(model, "torque", 32)
    squared = np.square(means.of(residual[:, None])[:, 0])
    assert left == pytest.approx(np.bincount(means.episode, squared), rel=0.2)


def test_less_is_asked_of_a_term_of_a_brake_than_of_an_effect():
    """A term has to be above chance over the whole grammar as well."""
    for clamps in (True, False):
        model = SimpleNamespace(
            bench=SimpleNamespace(clamps=clamps), lasting=lambda *_: 100.0**2, noise=lambda _: 600.0**2
        )  # fmt: skip
        screening = Screening.__new__(Screening)
        screening._size = {"torque": 3000.0}
        effect, term = (screening.floor(model, "torque", made=made) for made in (False, True))
        assert effect == pytest.approx(20.0) and term == pytest.approx(15.0 if clamps else 20.0)
