"""Two effects that are the same torque where friction slides: an offset of the current and an asymmetry of friction."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosekit import drives

from emb_daemon.diagnose import selection as search
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.screening import SLIDING, Screening
from emb_daemon.diagnose.selection import Selection, one_round, weigh_confounded
from emb_daemon.diagnose.text import _told
from emb_daemon.effects import REGISTRY
from emb_daemon.offline import log_of

BOTH = tuple(effect for effect in REGISTRY if effect.name in ("current_offset", "friction_asymmetry"))
NAMES = {effect.name for effect in BOTH}


def _searched(calibration, hidden):
    """What a search finds of a brake with an effect, of these two and on the torque path alone, before both are weighed."""
    bench = Bench([log_of(next(drives(calibration, 57, hidden)))], calibration)
    model = Model.of(bench).refined({"torque"})
    return one_round(Selection(model, Screening(bench, model)))


@pytest.fixture(autouse=True)
def two(monkeypatch):
    monkeypatch.setattr(search, "REGISTRY", BOTH)


@pytest.mark.parametrize(
    ("hidden", "sure"),
    [
        ({"friction_asymmetry": {"asymmetry": 0.1}}, False),
        pytest.param({"friction_asymmetry": {"asymmetry": -0.2}}, False, marks=pytest.mark.trial),
        pytest.param({"current_offset": {"offset_A": 0.07}}, False, marks=pytest.mark.trial),
        ({"current_offset": {"offset_A": -0.07}}, False),
        ({"current_offset": {"offset_A": -0.47}}, True),
    ],
)
def test_what_the_calibration_knows_decides_and_the_other_is_said_unless_it_is_sure(calibration, hidden, sure):
    """How friction turns over, modelled roughly, would name a small positive offset an asymmetry, and a small positive
    asymmetry an offset."""
    found = weigh_confounded(_searched(calibration, hidden))
    [name] = hidden
    [other] = NAMES - {name}
    assert found.accepted == [name]
    told = _told(SimpleNamespace(findings=tuple(found.candidates.values())), found.candidates[name])
    assert (f"or instead {other.replace('_', ' ')}" in told) is not sure
    assert (found.candidates[name].confounded_with == other) is not sure
    assert found.candidates[other].reason.startswith("confounded with") is not sure


@pytest.mark.parametrize("name", sorted(NAMES))
def test_odds_of_99_to_1_name_one_of_two_alone(calibration, monkeypatch, name):
    """Whichever of the two the search had accepted: the other is neither in the model nor reported as found."""
    found = _searched(calibration, {"current_offset": {"offset_A": 0.07}})
    [other] = NAMES - {name}
    monkeypatch.setattr(Model, "log_posterior", lambda self, *_: 0.0 if self.of_effect(name) else -4.7)
    weighed = weigh_confounded(found)
    assert weighed.accepted == [name] and weighed.candidates[name].confounded_with is None
    assert weighed.candidates[other].reason.startswith(f"explained by {name}") and not weighed.model.of_effect(other)


def test_two_that_were_proven_beside_each_other_are_not_confounded(calibration):
    found = _searched(calibration, {"current_offset": {"offset_A": 0.07}})
    [name] = found.accepted
    other = found.candidates[found.candidates[name].confounded_with]
    both = weigh_confounded(found.noted([replace(other, accepted=True)]))
    assert both.candidates[name].confounded_with is None and not both.candidates[name].manoeuvre


def test_how_probable_a_fit_is_counts_residual_and_priors(calibration):
    model = _searched(calibration, {"current_offset": {"offset_A": 0.07}}).model
    scale = model.inflation("torque") * model.noise("torque")
    own = model.movable("torque")
    means = model.bench.means("torque", SLIDING)
    start = model.residual_at("torque", {c: c.start for c in own})
    table = means.of(np.column_stack([*(model.columns[c] for c in own), start])) / np.sqrt(scale)
    priors = np.diag([1.0 / c.prior for c in own])
    rows, target = np.vstack([table[:, :-1], priors]), np.append(table[:, -1], np.zeros(len(own)))
    size = np.linalg.norm(rows, axis=0)
    left = target - rows @ (np.linalg.lstsq(rows / size, target, rcond=None)[0] / size)
    assert model.log_posterior("torque", SLIDING, scale) == pytest.approx(-0.5 * float(left @ left), rel=1e-6)
