"""Confirmation: one search, of a viscous brake, judged several ways."""

import copy
import dataclasses
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from diagnosekit import drives

from emb_daemon.calibration.parameters import TORQUE_CONSTANT, moved
from emb_daemon.diagnose import confirmation, diagnosis, grammar, search
from emb_daemon.diagnose.comparison import episodes_by_log
from emb_daemon.diagnose.coordinates import PAD_FRICTION, TOLERATED, base_coordinates, tolerated
from emb_daemon.diagnose.diagnosis import Recalibrated, diagnose
from emb_daemon.diagnose.model import LASTING, Model, rms_known
from emb_daemon.diagnose.page import page
from emb_daemon.diagnose.report import report
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.screening import Candidate, Screening
from emb_daemon.diagnose.search import select
from emb_daemon.diagnose.selection import Selection, find_changes, revise
from emb_daemon.diagnose.text import _recalibration, verdict
from emb_daemon.effects import REGISTRY
from emb_daemon.errors import InputError
from emb_daemon.offline import log_of
from emb_daemon.offline.recording import recording
from emb_daemon.offline.score import EpisodeErrors, rmse


def _from_which_it_starts(calibration):
    """Torque constant 3 % too high, no friction under load, and no viscous friction, which the brake has."""
    constant = 1.03 * calibration.motor.torque_constant_Nm_per_A
    return moved(calibration, {"motor.torque_constant_Nm_per_A": constant, "friction.load_m_per_rad": 0.0})


@pytest.fixture(scope="module")
def viscous(calibration):
    """(search, fit log, validation log) of a viscous brake."""
    frames = drives(calibration, 31, {"viscous_friction": {"viscous_Nms_per_rad": 3e-4}})
    fit_log, val_log = (log_of(part) for part in frames)
    bench = Bench([fit_log], _from_which_it_starts(calibration))
    return select(bench, lambda text, share: None), fit_log, val_log


@pytest.fixture
def judged(viscous, monkeypatch):
    """Diagnosis of the viscous brake, its search done once, on the log as it came, by other validation logs."""
    selection, fit_log, _ = viscous
    monkeypatch.setattr(diagnosis, "select", lambda bench, progress: selection)
    monkeypatch.setattr(diagnosis, "reference_late_s", lambda bench: 0.0)
    return lambda *validate: diagnose([fit_log], selection.model.bench.calibration, validate)


def test_an_effect_is_not_hidden_by_a_calibration_that_is_off(calibration, viscous, judged, monkeypatch):
    monkeypatch.setitem(TOLERATED, "motor.torque_constant_Nm_per_A", 1.02)
    result = judged(viscous[2])
    [finding] = result.accepted
    assert finding.effect.name == "viscous_friction"
    assert finding.values["viscous_Nms_per_rad"] == pytest.approx(3e-4, rel=0.05)
    found = report(result)["recalibrated"]
    constant, load = found["motor.torque_constant_Nm_per_A"], found["friction.load_m_per_rad"]
    true = calibration.motor.torque_constant_Nm_per_A
    assert constant["before"] == pytest.approx(1.03 * true) and constant["unit"] == "N·m/A"
    assert constant["value"] == pytest.approx(true, rel=0.01)
    assert 0.0 < constant["sigma"] < 0.01 * constant["value"]
    # A parameter that is zero is found as well.
    assert load["before"] == 0.0 and load["gain_N"] > 100.0
    assert load["value"] == pytest.approx(calibration.friction.load_m_per_rad, rel=0.2)
    # Three per cent are more than the two granted here; of what was zero nobody knows by how much it may change.
    assert not constant["tolerance"] and load["tolerance"]
    assert "No tolerance: torque constant" in verdict(result) and "load → " not in verdict(result).partition("No tol")[2]
    assert "no tolerance: more than a factor of 1.02" in page(result)


@pytest.mark.parametrize(("value", "sigma", "identified"), [(2.8e-7, 5e-4, False), (2.8e-4, 3e-5, True), (0.0, 3e-5, False)])
def test_a_softening_that_no_log_has_shown_has_no_tolerance(calibration, value, sigma, identified):
    """It may be any: a fit of logs without heat leaves it at about nothing."""
    key = "thermal.softening.per_K"
    provenance = msgspec.structs.replace(calibration.provenance, sigmas={key: sigma})
    known = msgspec.structs.replace(moved(calibration, {key: value}), provenance=provenance)
    assert tolerated(known, key) == (2.0 if identified else np.inf) and tolerated(known, PAD_FRICTION) == 2.0


@pytest.mark.parametrize(("before", "fitted", "after"), [(5e-4, 2e-5, 2e-5), (5e-4, 9e-4, 5e-4), (0.0, 2e-5, 0.0)])
def test_a_softening_that_logs_have_shown_is_no_longer_as_unsure_as_one_that_none_has(calibration, before, fitted, after):
    keys = [f"thermal.softening.{name}" for name in ("per_K", "sigma_per_K")]
    found = next(c for c in base_coordinates(calibration, [0.0]) if c.name == keys[0])
    fit = SimpleNamespace(sigmas={found: fitted})
    selection = SimpleNamespace(applied=lambda: {found: 4e-4}, model=SimpleNamespace(fits={"stiffness": fit}))
    known = diagnosis._with_softening_shown(moved(calibration, {keys[1]: before}), selection)
    assert known.thermal.softening.sigma_per_K == after
    nothing = SimpleNamespace(applied=dict)
    assert (
        diagnosis._with_softening_shown(moved(calibration, {keys[1]: before}), nothing).thermal.softening.sigma_per_K == before
    )


@pytest.mark.parametrize(
    ("value", "sigma", "granted"), [(1.09, 0.0, True), (1.12, 0.0, False), (1.12, 0.02, True), (0.88, 0.0, False)]
)
def test_what_a_parameter_may_change_by_is_a_factor_up_or_down_beside_its_sigma(value, sigma, granted):
    assert Recalibrated(1.0, value, sigma, "1", 5.0, "torque", tolerated=1.1).is_tolerance is granted
    assert Recalibrated(-1.0, -value, sigma, "1", 5.0, "torque", tolerated=1.1).is_tolerance is granted
    assert Recalibrated(0.0, value, sigma, "1", 5.0, "torque").is_tolerance, "of which nothing is known"


@pytest.mark.parametrize(
    ("value", "tolerated", "said"),
    [(1.07, np.inf, "off by 2.14"), (0.2, np.inf, "begin again with 0.2 N·m/A"), (0.7, np.inf, ""), (1.07, 1.1, "")],
    ids=["twice", "a motor's behind a gear", "another amplitude", "identified"],
)
def test_a_stated_torque_constant_that_no_supplier_states_is_asked_about(value, tolerated, said):
    """Where no load tells it the fit ends between it and what the logs show, as certain of itself as ever."""
    found = Recalibrated(0.5, value, 0.05, "N·m/A", 900.0, "torque", tolerated)

    def text(load_follows: bool) -> str:
        bench = SimpleNamespace(load_follows=load_follows)
        return " ".join(_recalibration(SimpleNamespace(recalibrated={TORQUE_CONSTANT: found}, bench=bench)))

    assert text(False).startswith("Recalibrated: torque constant 0.5 → ")
    assert said in text(False) and ("No supplier's torque constant" in text(True)) == bool(said)
    assert "begin again" not in text(True), "a load that is measured tells the constant"


def test_what_has_a_name_is_called_by_it(viscous, monkeypatch):
    """A term that does what viscous friction does is made where that is taken away, and gives way to it again."""
    selection, _, _ = viscous
    channel = selection.candidates["viscous_friction"].channel
    made = grammar._with_terms(selection.without("viscous_friction", "to see what comes in its place"), channel)
    [term] = made.accepted
    assert term.endswith(":motor_speed")
    # The term has proven that something is there: too few episodes for the catalogue's own test do not speak against a name.
    monkeypatch.setattr("scipy.stats.false_discovery_control", np.ones_like)
    monkeypatch.setattr("emb_daemon.diagnose.selection.Q_VALUE", 0.0)
    find_known = grammar.find_known

    def misled(bare, channel):
        """A wrong effect of the catalogue first, as if a linear test ranked it so; fitted it describes no more."""
        stribeck = [effect for effect in REGISTRY if effect.name == "stribeck_friction"]
        return [*bare.screening.test(bare.model, stribeck), *find_known(bare, channel)]

    monkeypatch.setattr(grammar, "find_known", misled)
    named = revise(grammar._called_by_name(made, channel))
    assert named.accepted == ["viscous_friction"]
    assert named.candidates["viscous_friction"].q_value == made.candidates[term].q_value
    assert named.candidates[term].reason == "an effect of the catalogue says the same"


def test_what_a_fit_has_left_at_nothing_is_no_effect(viscous):
    """A linear test may promise a gain that a bound, or the other fitted parameters, do not allow."""
    selection, _, _ = viscous
    [amplitude] = selection.model.of_effect("viscous_friction")
    stuck = dataclasses.replace(selection, model=selection.model.entered({amplitude: 1e-3 * amplitude.step}))
    assert selection.model.of_effect("viscous_friction") and not revise(stuck).accepted


def test_what_ends_at_the_bound_of_physics_may_be_another_cause(viscous, monkeypatch):
    """Of 3e-4 no more than two thirds may be viscous, or all of it: a term says all, which is not asked where all may be, nor
    taken for more causes than there were; and viscous friction is no name for it."""
    selection, _, _ = viscous
    channel = selection.candidates["viscous_friction"].channel
    bare = selection.without("viscous_friction", "to ask it again")
    [viscous_friction] = [effect for effect in REGISTRY if effect.name == "viscous_friction"]
    find_known = grammar.find_known

    def known(bare, channel):
        return [c for c in find_known(bare, channel) if c.effect is viscous_friction]

    coordinates = dict(bare.screening.coordinates)
    [amplitude] = coordinates["viscous_friction"].values()
    found, left = {}, {}
    for high in (2e-4, amplitude.high):
        bare.screening.coordinates["viscous_friction"] = {amplitude.parameter: dataclasses.replace(amplitude, high=high)}
        [candidate] = bare.screening.test(bare.model, [viscous_friction])
        asked = bare.entered([candidate])
        assert asked.accepted == ["viscous_friction"]
        found[high], left[high] = grammar._without_shadows(asked, asked, channel), asked.model.noise(channel)
        if high == 2e-4:
            with monkeypatch.context() as patched:
                patched.setattr(grammar, "find_known", known)
                patched.setattr(grammar, "_is_shorter", lambda *_: False)
                assert grammar._called_by_name(found[high], channel).accepted == found[high].accepted
                patched.setattr(grammar, "_causes", lambda selection, _, one=asked: {1} if selection is one else {1, 2})
                assert grammar._without_shadows(asked, asked, channel) is asked
    bare.screening.coordinates.update(coordinates)
    [term] = found[2e-4].accepted
    assert "motor_speed" in term and found[2e-4].model.noise(channel) < left[2e-4]
    assert found[amplitude.high].accepted == ["viscous_friction"]


def test_what_friction_does_as_it_turns_over_proves_no_effect(viscous, monkeypatch):
    """How friction turns over is modelled roughly: what an effect gains counts only where the motor slides."""
    selection, _, _ = viscous
    model = selection.without("viscous_friction", "to ask it again").model
    [viscous_friction] = [effect for effect in REGISTRY if effect.name == "viscous_friction"]

    def reason():
        [candidate] = selection.screening.test(model, [viscous_friction])
        return selection.screening.plausible(model, candidate, {}).reason

    assert reason() == ""
    [trial] = model.bench.trials
    monkeypatch.setattr(trial, "slides", np.zeros_like(trial.slides))
    assert reason().startswith("explains 0 N RMS where friction slides, too little to matter")


def test_what_makes_the_running_estimator_worse_is_taken_out_again(judged, monkeypatch):
    """Whatever the residual says: an effect with which left-out episodes get worse is not written."""
    judge_left_out = confirmation.left_out_errors

    def worse_with_it(selection, without=""):
        errors = judge_left_out(selection, without)
        if "viscous_friction" in selection.accepted and without != "viscous_friction":
            errors.sums[errors.paths.index("fused")] *= 4.0
        return errors

    monkeypatch.setattr(confirmation, "left_out_errors", worse_with_it)
    result = judged()
    finding = next(f for f in result.findings if f.effect.name == "viscous_friction")
    assert not finding.accepted
    assert "fused error goes from" in finding.reason and "left-out episodes" in finding.reason
    assert "viscous_friction" not in result.calibration.effects


def test_validation_logs_speak_of_the_whole_estimator_beside_left_out_episodes(viscous, judged, monkeypatch):
    """What makes the force of the fitted log 8 % worse, by where the contact angle wanders there, and another log's better."""
    fit, judge = {"before": 100.0, "after": 108.0}, {"before": 100.0, "after": 60.0}
    judge_errors, judge_left_out = confirmation.errors, confirmation.left_out_errors

    def as_if(errors, rmse_N):
        row = errors.paths.index("fused")
        errors.sums[row] = errors.counts[row] * rmse_N**2
        return errors

    def of_logs(bench, calibration):
        of = judge if bench.trials[0].log is viscous[2] else fit
        return as_if(judge_errors(bench, calibration), of["after" if "viscous_friction" in calibration.effects else "before"])

    def of_episodes(selection, without=""):
        return as_if(judge_left_out(selection, without), fit["after" if selection.accepted and not without else "before"])

    monkeypatch.setattr(confirmation, "errors", of_logs)
    monkeypatch.setattr(confirmation, "left_out_errors", of_episodes)
    assert [finding.effect.name for finding in judged(viscous[2]).accepted] == ["viscous_friction"]
    fit["after"], judge["after"] = 120.0, 100.0
    refused = next(f for f in judged(viscous[2]).findings if f.effect.name == "viscous_friction")
    assert not refused.accepted and "left-out episodes and validation logs" in refused.reason


def test_an_effect_is_judged_on_its_own_path_with_the_contact_held(judged, monkeypatch):
    """What the contact angle learns of the other path is no word on it; what is left of its own on left-out episodes is."""
    judge_left_out, left_out = confirmation.left_out_errors, confirmation.left_out_residuals

    def worse_while_learning(selection, without=""):
        errors = judge_left_out(selection, without)
        errors.sums[errors.paths.index("torque")] *= 100.0
        return errors

    monkeypatch.setattr(confirmation, "left_out_errors", worse_while_learning)
    assert [finding.effect.name for finding in judged().accepted] == ["viscous_friction"]

    def worse(selection, without=""):
        found = left_out(selection, without)
        return found | {"torque": found["torque"] * (4.0 if selection.accepted and not without else 1.0)}

    monkeypatch.setattr(confirmation, "left_out_residuals", worse)
    refused = next(f for f in judged().findings if f.effect.name == "viscous_friction")
    assert not refused.accepted and "left of the torque path goes from" in refused.reason


@pytest.fixture(scope="module")
def nominal(calibration):
    """A log of a brake that hides nothing."""
    return log_of(next(drives(calibration, 54, {}, stops=3)))


def test_validation_has_a_veto(nominal, judged, monkeypatch):
    """The fit log is of a brake with viscous friction, the validation log of one without: nothing carries over. What the fit
    log proves is unexplained then, also where no smooth function of a signal shows it any more."""
    monkeypatch.setattr(Screening, "dependence", lambda *_, **__: {})
    result = judged(nominal)
    finding = next(f for f in result.findings if f.effect.name == "viscous_friction")
    assert not finding.accepted and "validation" in finding.reason
    assert "viscous_friction" not in result.calibration.effects
    assert result.after.rmse("torque") <= result.before.rmse("torque")
    left = result.left["torque"]
    assert left.present and not left.beyond and left.strongest.signal == "motor_speed" and left.strongest.rms > 20.0
    assert "Proven on these logs but not applied: viscous friction (withdrawn: " in verdict(result)
    assert page(result)


def test_what_is_proven_but_not_applied_is_named_with_its_numbers(nominal, judged):
    """Also where nothing of its path counts as unexplained: what acts in the brake is asked for, not only what helps."""
    result = judged(nominal)
    text = verdict(dataclasses.replace(result, left={}))
    assert "unexplained" not in text and "not applied: viscous friction (withdrawn: on the validation logs it adds" in text
    assert "N of the torque path: viscous 0.000" in text
    told = next(e for e in report(result)["effects"] if e["name"] == "viscous_friction")
    assert told["withdrawn"] and not told["accepted"] and told["share_explained"] > 0.02
    assert told["parameters"]["viscous_Nms_per_rad"]["value"] == pytest.approx(3e-4, rel=0.05)
    assert "proven, not applied" in page(result) and "viscous_friction" not in result.calibration.effects


@pytest.mark.parametrize("harm", ["of the recalibration", "of the effect"])
def test_where_a_recalibration_does_harm_the_effect_beside_it_stays(viscous, judged, monkeypatch, harm):
    """They were taken out together: the effect first, because nothing else of its path could go. Where the estimator is well
    without the effect, and the path as well explained, it goes as before."""

    def against(tried, *_):
        if "torque" in tried.held or not tried.touched:
            return None
        if "viscous_friction" in tried.accepted:
            return "viscous_friction", "the estimator's fused error goes from 10 to 20 N"
        return ("torque", "the same") if harm == "of the recalibration" else None

    monkeypatch.setattr(confirmation, "_against", against)
    result = judged()
    chosen, motor = result.selection, result.bench.calibration.motor
    stays = harm == "of the recalibration"
    assert [f.effect.name for f in result.accepted] == ["viscous_friction"] * stays
    assert (result.calibration.motor.torque_constant_Nm_per_A == motor.torque_constant_Nm_per_A) is stays
    assert ("Not recalibrated: the torque path, which would gain" in verdict(result)) is stays
    assert chosen.held == ({"torque"} if stays else set())
    if stays:
        assert "motor.torque_constant_Nm_per_A" not in report(result)["recalibrated"]
        assert report(result)["not_recalibrated"]["torque"]["gain_N"] > 100.0
        assert chosen.model.noise("torque") < rms_known(chosen.screening.initial["torque"]) ** 2


@dataclasses.dataclass(frozen=True)
class _OfTwoPaths:
    """What was chosen, of two paths: a disc that is uneven and a motor that cogs, each beside a recalibration."""

    accepted: tuple = ("disc_thickness_variation", "cogging_torque")
    recalibrated: tuple = ("stiffness", "torque")
    held: frozenset = frozenset()
    model = SimpleNamespace(bench=SimpleNamespace(calibration=None, residuals=lambda _: {}))
    instead = longer = None

    def channel_of(self, suspect):
        return {"disc_thickness_variation": "stiffness", "cogging_torque": "torque"}.get(suspect, suspect)

    @property
    def suspects(self):
        return [*self.accepted, *(c for c in self.recalibrated if c not in map(self.channel_of, self.accepted))]

    @property
    def touched(self):
        return {self.channel_of(suspect) for suspect in self.suspects}

    def without(self, gone, _):
        left = (tuple(name for name in names if name != gone) for names in (self.accepted, self.recalibrated))
        return dataclasses.replace(self, **dict(zip(("accepted", "recalibrated"), left, strict=True)))

    def with_base_held(self, channel, _):
        left = tuple(c for c in self.recalibrated if c != channel)
        return dataclasses.replace(self, recalibrated=left, held=self.held | {channel})


@pytest.mark.parametrize(
    ("harm", "stays", "held"),
    [
        (lambda s: "torque" in s.recalibrated, _OfTwoPaths.accepted, {"torque"}),
        (lambda s: "torque" in s.touched, ("disc_thickness_variation",), set()),
        (lambda s: "disc_thickness_variation" in s.accepted, ("cogging_torque",), set()),
        (lambda s: {*_OfTwoPaths.accepted} <= {*s.accepted}, ("cogging_torque",), set()),
    ],
    ids=["a recalibration", "all of a path", "the effect", "two effects together"],
)
def test_a_true_effect_does_not_go_for_the_harm_of_another_path(monkeypatch, harm, stays, held):
    """On a brake with an uneven disc and a motor that saturates a torque path that is recalibrated for the latter took the
    fused error from 84 to 177 N; least was left, by a little, without the disc, which went first."""

    def against(tried, *_):
        return (tried.suspects[0], "the fused error goes from 84 to 177 N") if harm(tried) else None

    monkeypatch.setattr(confirmation, "errors", lambda *_: None)
    monkeypatch.setattr(confirmation, "whole", lambda _: "fused")
    monkeypatch.setattr(confirmation, "left_out_errors", lambda _: None)
    monkeypatch.setattr(confirmation, "_beyond_bounds", lambda _: [])
    monkeypatch.setattr(confirmation, "_against", against)
    monkeypatch.setattr(confirmation, "revise", lambda selection: selection)
    monkeypatch.setattr(confirmation, "_left", lambda s, _: {"stiffness": 90.0 - 50.0 * (s.accepted[:1] == stays[:1])})
    found = confirmation.confirm(_OfTwoPaths(), None)[0]
    assert (found.accepted, found.held) == (stays, held)


def test_a_brake_torque_whose_number_was_full_is_said_and_judges_nothing(viscous, judged):
    """At 3277 N·m it goes on at the other end, and the brake seems to be driven: no heat is that of such a torque."""
    whole = viscous[2]
    full = dataclasses.replace(whole, reference=copy.copy(whole.reference), path=Path("full.log"))
    full.reference.brake_torque_Nm = np.where(whole.reference.brake_torque_Nm > 500.0, -3200.0, 3200.0)
    assert not whole.full_torque and "goes from 3200 to -3200 N·m at once" in full.full_torque
    with pytest.raises(InputError, match="its number, which ends at 3277 N·m, was full; a torque within it is needed"):
        recording(full)
    result = judged(full)
    assert "No brake torque was taken of full.log: the reference brake torque goes from 3200 to" in verdict(result)
    assert report(result)["brake_torque_full"] == ["full.log"]
    assert "brake_torque" in result.bench.channels and "brake_torque" not in result.judges.channels


def test_a_recalibration_that_validation_logs_refuse_is_said(calibration, judged, monkeypatch):
    """By a log of a brake that is as calibrated. The fitted log goes on being as wrong as it was, and that is told, too."""
    another = log_of(next(drives(_from_which_it_starts(calibration), 54, {}, stops=3)))

    def against_torque(tried, judges):
        suspect = next((name for name in ("viscous_friction", "torque") if name in tried.suspects), None)
        return suspect and (suspect, "withdrawn: it is worse there")

    monkeypatch.setattr(confirmation, "_veto", against_torque)
    result = judged(another)
    assert result.calibration.motor == result.bench.calibration.motor
    [(channel, refused)] = report(result)["not_recalibrated"].items()
    assert channel == "torque" and refused["gain_N"] > 100.0 and refused["reason"] == "withdrawn: it is worse there"
    assert "Not recalibrated: the torque path, which would gain" in verdict(result)
    there = rms_known(result.selection.screening.initial["torque"], result.bench.means("torque", LASTING["torque"]))
    assert result.left["torque"].present and result.left["torque"].rms == pytest.approx(there)
    of_another = rms_known(result.judges.residuals({})["torque"], result.judges.means("torque", LASTING["torque"]))
    assert of_another < 0.3 * there


def test_logs_on_which_the_force_got_worse_are_said(viscous, judged, monkeypatch):
    """Though others gain far more than one loses; and what it loses by half takes back what did it."""
    judge_errors, factors = confirmation.errors, [0.2, 0.2, 1.2]

    def scaled(bench, calibration):
        found = judge_errors(bench, calibration)
        if len(bench.trials) == 3 and "viscous_friction" in calibration.effects:
            return dataclasses.replace(found, sums=found.sums * (np.square(factors) @ episodes_by_log(bench)))
        return found

    for module in (confirmation, diagnosis):
        monkeypatch.setattr(module, "errors", scaled)
    monkeypatch.setattr(confirmation, "is_refuted", lambda *_: False)
    monkeypatch.setattr(diagnosis, "_with_noise", lambda calibration, selection: calibration)
    result = judged(*3 * [viscous[2]])
    assert [finding.effect.name for finding in result.accepted] == ["viscous_friction"]
    name = viscous[2].path.name
    [worse] = report(result)["worse"]
    assert worse["log"] == name and worse["rmse_after_N"] == pytest.approx(1.2 * worse["rmse_before_N"], rel=0.1)
    assert f"Worse on {name} (" in verdict(result)
    factors[2] = 1.8
    refused = next(f for f in judged(*3 * [viscous[2]]).findings if f.effect.name == "viscous_friction")
    assert not refused.accepted and f"fused error on {name} goes from" in refused.reason and "validation" in refused.reason


@pytest.mark.parametrize(
    ("does_N", "true", "lasting_N", "noise_N", "refuted"),
    [
        (25.0, 0.0, 10.0, 100.0, True),
        (25.0, 1.0, 10.0, 100.0, False),
        (25.0, 0.0, 100.0, 10.0, False),
        (1e-3, 0.0, 100.0, 10.0, False),
        (90.0, 0.0, 100.0, 10.0, True),
    ],
)
def test_a_log_refutes_only_what_it_would_have_shown(does_N, true, lasting_N, noise_N, refuted):
    """By how its episodes scatter, not its samples: an effect that is not there, but does less than that, adds a little by
    chance. What adds more than a twentieth to what is left is withdrawn however they scatter."""
    rng = np.random.default_rng(3)
    episode = np.repeat(np.arange(20), 50)
    does = does_N * np.sin(episode)
    rest = np.repeat(rng.normal(0.0, lasting_N, 20), 50) + rng.normal(0.0, noise_N, 1000)
    rest -= (rest @ does + 1e-3 * does @ does) / (does @ does) * does
    bare = rest + true * does
    assert (rmse(bare - does) > rmse(bare)) != bool(true)
    assert confirmation.is_refuted(bare - does, bare, episode) == refuted


def test_noise_with_which_the_validation_logs_get_worse_is_not_written(viscous, judged, monkeypatch):
    """A stiffness path that is said to be worthless leaves the force to the current."""
    worthless = {"noise.stiffness_N": 1e5}
    monkeypatch.setattr(diagnosis, "_with_noise", lambda calibration, selection: moved(calibration, worthless))
    result = judged(viscous[2])
    assert [finding.effect.name for finding in result.accepted] == ["viscous_friction"]
    assert result.calibration.noise.stiffness_N == result.bench.calibration.noise.stiffness_N
    assert result.after.rmse("fused") <= 1.05 * result.before.rmse("fused")


@pytest.mark.parametrize(("ruined", "log"), [(160.0, "warm.log"), (140.0, None), (40.0, None), (9.0, None)])
def test_what_most_logs_gain_does_not_outweigh_one_that_is_ruined(ruined, log):
    """By half as much again, by what matters, and by more than is gained: an error that was small may have grown to one that
    still is."""
    trials = [SimpleNamespace(log=SimpleNamespace(path=Path(name))) for name in ("cold.log", "warm.log")]
    rows = [slice(0, 900), slice(900, 1000)]
    model = SimpleNamespace(bench=SimpleNamespace(trials=trials, rows=rows))
    selection = SimpleNamespace(model=model, screening=SimpleNamespace(floor=lambda model, channel: 10.0))
    of = np.repeat([0, 1], [900, 100])
    before, after = np.array([100.0, 5.0 if ruined < 100.0 else 100.0])[of], np.array([20.0, ruined])[of]
    worse = confirmation._where_worse(selection, "torque", before, after)
    assert (worse and worse[0]) == (log and slice(900, 1000)) and (not log or log in worse[1])


def test_what_only_its_prior_sizes_is_not_applied_unless_it_gains_what_matters(viscous, monkeypatch):
    """The jackknife's covariance lacks the part of a standard deviation that comes from the prior."""
    selection = viscous[0]
    channel = selection.candidates["viscous_friction"].channel
    fit = selection.model.fits[channel]
    unsure = dataclasses.replace(fit, covariance=1e6 * fit.covariance)
    model = dataclasses.replace(selection.model, fits={**selection.model.fits, channel: unsure})
    unsure = dataclasses.replace(selection, model=model)
    assert revise(unsure).accepted == ["viscous_friction"]
    monkeypatch.setattr(Screening, "floor", lambda *_: 1e4)
    assert revise(selection).accepted == ["viscous_friction"]
    assert revise(unsure).accepted == []


def test_a_path_that_is_no_number_any_more_has_got_worse():
    """Samples that lose their value would otherwise drop out of the error."""
    episode = np.repeat(np.arange(4), 100)
    errors = {"fused": np.full(400, 10.0), "torque": np.full(400, 10.0)}
    before = EpisodeErrors.of(errors, {}, episode)
    lost = errors | {"torque": np.where(episode > 1, np.nan, 1.0)}
    assert "no number" in confirmation.harm(before, EpisodeErrors.of(lost, {}, episode), "fused")
    better = errors | {"torque": np.full(400, 1.0)}
    assert not confirmation.harm(before, EpisodeErrors.of(better, {}, episode), "fused")


@pytest.mark.parametrize(
    ("own_data", "own_path_N", "gains_N", "guilty"),
    [(False, 10.0, 50.0, True), (True, 10.0, 50.0, False), (True, 50.0, 50.0, True), (False, 10.0, 500.0, False)],
)
def test_what_ruins_one_log_is_taken_out_though_all_together_gain(monkeypatch, own_data, own_path_N, gains_N, guilty):
    """A log that is off by far outweighs the others: a little gained there would pay for anything lost elsewhere. Where the
    noise will be stated anew, what leaves less of its own path on that log (20 N without it) has not ruined it, and neither
    has what gains all together by a larger factor."""
    episode = np.repeat(np.arange(4), 100)
    trials = [SimpleNamespace(episode=episode, log=SimpleNamespace(path=Path(name))) for name in ("far.log", "near.log")]
    by_sample = np.repeat(np.arange(8), 100)
    bench = SimpleNamespace(
        trials=trials, calibration=None, residuals=lambda _: {}, own_data=own_data, sample_episode=by_sample,
        sources=["far.log", "near.log"],
    )  # fmt: skip

    def of(far_N, near_N):
        return EpisodeErrors.joined([EpisodeErrors.of({"fused": np.full(400, size)}, {}, episode) for size in (far_N, near_N)])

    @dataclasses.dataclass
    class Chosen:
        suspects: list[str]
        reasons: dict[str, str]
        model = SimpleNamespace(bench=bench)
        recalibrated = ()
        instead = longer = None
        touched = held = frozenset(["torque"])

        def without(self, suspect, reason):
            return Chosen([name for name in self.suspects if name != suspect], self.reasons | {suspect: reason})

        def channel_of(self, _):
            return "torque"

    def residuals(chosen, without=""):
        there = {*chosen.suspects} - {without}
        near = own_path_N if "wrong" in there else 20.0
        return {"torque": np.where(by_sample < 4, 1000.0, near - 1.0 * ("right" in there))}

    monkeypatch.setattr(confirmation, "left_out_residuals", residuals)

    def left_out(chosen, without=""):
        there = {*chosen.suspects} - {without}
        far_N = 1000.0 - 50.0 * ("right" in there) - gains_N * ("wrong" in there)
        return of(far_N, 60.0 if "wrong" in there else 32.0)

    monkeypatch.setattr(confirmation, "errors", lambda *_: of(1000.0, 30.0))
    monkeypatch.setattr(confirmation, "whole", lambda _: "fused")
    monkeypatch.setattr(confirmation, "_beyond_bounds", lambda _: [])
    monkeypatch.setattr(confirmation, "_own_harm", lambda *_: None)
    monkeypatch.setattr(confirmation, "left_out_errors", left_out)
    found, after = confirmation.confirm(Chosen(["right", "wrong"], {}), None)
    assert ("wrong" in found.suspects) != guilty and "right" in found.suspects and after.rmse("fused") < 1000.0
    if not guilty:
        return
    assert found.reasons == {"wrong": "the estimator's fused error on near.log goes from 30 to 60 N on left-out episodes"}


def test_a_recalibration_that_went_for_what_an_effect_did_comes_back(monkeypatch):
    """The torque path's, withdrawn before the effect whose harm it was taken for; not one that went last."""

    @dataclasses.dataclass(frozen=True)
    class Chosen:
        recalibrated: dict
        accepted: tuple = ("wrong",)
        model = SimpleNamespace(
            bench=SimpleNamespace(calibration=None, residuals=lambda _: {}), refined=lambda _: Chosen.model
        )
        touched = property(lambda self: {*self.recalibrated})
        instead = longer = None

        def channel_of(self, suspect):
            return suspect

        def without(self, suspect, _):
            left = {c: gain for c, gain in self.recalibrated.items() if c != suspect}
            return Chosen(left, tuple(name for name in self.accepted if name != suspect))

    def replaced(chosen, recalibrated, model):
        return Chosen(recalibrated, chosen.accepted)

    def against(tried, *_):
        if tried.accepted:
            return ("torque" if "torque" in tried.recalibrated else "wrong"), "it is worse"
        return ("stiffness", "it is worse") if "stiffness" in tried.recalibrated else None

    monkeypatch.setattr(confirmation, "errors", lambda *_: None)
    monkeypatch.setattr(confirmation, "whole", lambda _: "fused")
    monkeypatch.setattr(confirmation, "harm", lambda *_: "")
    monkeypatch.setattr(confirmation, "left_out_errors", lambda _: None)
    monkeypatch.setattr(confirmation, "_beyond_bounds", lambda _: [])
    monkeypatch.setattr(confirmation, "_against", against)
    monkeypatch.setattr(confirmation, "replace", replaced)
    found, _ = confirmation.confirm(Chosen({"torque": 50.0, "stiffness": 20.0}), None)
    assert found.accepted == () and found.recalibrated == {"torque": 50.0}


@pytest.mark.parametrize(("made_N2", "name"), [(90.0, "term:torque:motor_speed"), (110.0, "current_offset")])
def test_an_effect_that_gave_way_to_a_term_is_asked_again_where_nothing_was_fitted(monkeypatch, viscous, made_N2, name):
    """In one log a term may describe shortly what is another cause: a shorter one, of what others leave, is believed."""
    base = dataclasses.replace(viscous[0], candidates={})
    offset = next(effect for effect in REGISTRY if effect.name == "current_offset")
    term = dataclasses.replace(offset, name="term:torque:motor_speed")
    named, made = (base.noted([Candidate(effect, "torque", accepted=True)]) for effect in (offset, term))
    monkeypatch.setattr(confirmation, "_confirmed", lambda selection, judges: (selection, selection))
    monkeypatch.setattr(confirmation, "_left", lambda s, _: {"torque": 100.0 if s is named else made_N2})
    found, of = confirmation.confirm(dataclasses.replace(made, instead=named), None)
    assert found.accepted == of.accepted == [name]
    assert name == term.name or "leave less" in found.candidates[term.name].reason


@pytest.mark.parametrize(
    ("refused", "left_N2", "confirmed", "stays"),
    [(True, 90.0, True, True), (False, 90.0, True, False), (True, 110.0, True, False), (True, 90.0, False, False)],
    ids=["refit not applied", "refit applied", "leaves more", "not confirmed"],
)
def test_a_description_is_shorter_only_if_its_refit_is_applied(monkeypatch, viscous, refused, left_N2, confirmed, stays):
    """A torque constant over current of 150 N was described more shortly by a torque path that was not applied then."""
    base = dataclasses.replace(viscous[0], candidates={}, recalibrated={} if refused else {"torque": 30.0})
    base = dataclasses.replace(base, refused={"torque": (30.0, "worse")} if refused else {})
    term = dataclasses.replace(REGISTRY[0], name="term:torque_constant:current")
    longer = base.noted([Candidate(term, "torque", accepted=True)])
    monkeypatch.setattr(confirmation, "_confirmed", lambda s, _: (s if s is not longer or confirmed else base, s))
    monkeypatch.setattr(confirmation, "_left", lambda s, _: {"torque": left_N2 if s is longer else 100.0})
    found, of = confirmation.confirm(dataclasses.replace(base, longer=longer), None)
    assert (found is longer) == (of is longer) == stays


@pytest.mark.parametrize("gave_way", [True, False])
def test_what_gave_way_to_a_term_is_kept_beside_it(monkeypatch, viscous, gave_way):
    bench = viscous[0].model.bench
    term = dataclasses.replace(REGISTRY[0], name="term:torque:motor_speed")

    def make(selection, progress):
        left = selection.without("viscous_friction", "a term does as much") if gave_way else selection
        return left.noted([Candidate(term, "torque", accepted=True)])

    monkeypatch.setattr(search, "make_terms", make)
    monkeypatch.setattr(search, "_finished", lambda selection: selection)
    found = select(bench, lambda text, share: None)
    assert term.name in found.accepted and ("viscous_friction" in found.accepted) != gave_way
    assert (found.instead.accepted if gave_way else found.instead) == (["viscous_friction"] if gave_way else None)


def test_orders_of_an_uneven_disc_that_have_changed_are_said(calibration):
    """Its eight numbers together are more than what a few stops can test, each order is not."""
    name, orders = "disc_thickness_variation", ("order_1_cosine_um", "order_2_sine_um")
    known = moved(calibration, {f"effects.{name}.{order}": 8.0 for order in orders})
    log = log_of(next(drives(calibration, 43, {name: dict.fromkeys(orders, 20.0)})))
    bench = Bench([log], known)
    begin = Model.of(bench)
    model = begin.refined({"stiffness"})
    assert find_changes(Selection(model, Screening(bench, begin))).candidates[name].accepted
