"""Terms: what is made where no effect of the catalogue explains what is left."""

import dataclasses
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from diagnosekit import drives
from scipy.signal import lfilter

from emb_daemon.calibration import terms as calibration_terms
from emb_daemon.calibration.files import load_calibration, save_calibration
from emb_daemon.calibration.terms import Term
from emb_daemon.diagnose import confirmation, diagnosis, grammar, prospects, search
from emb_daemon.diagnose import model as model_module
from emb_daemon.diagnose import selection as selection_module
from emb_daemon.diagnose.comparison import errors
from emb_daemon.diagnose.coordinates import Coordinate
from emb_daemon.diagnose.diagnosis import _with_memory, diagnose, with_terms
from emb_daemon.diagnose.evidence import Averaging, Evidence
from emb_daemon.diagnose.forms import enumerate_forms, enumerate_products, harmonic, made_effect, rippling
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.page import page
from emb_daemon.diagnose.prospects import Prospect, Search
from emb_daemon.diagnose.report import report
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.screening import Candidate, Screening
from emb_daemon.diagnose.selection import TOO_LARGE, Selection, revise
from emb_daemon.diagnose.signals import MANOEUVRES, outside_range
from emb_daemon.diagnose.text import _full, _outside, verdict
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.terms import MOST, PORTS
from emb_daemon.offline import log_of
from emb_daemon.plant.brake import SIGNALS as PLANT_SIGNALS
from emb_daemon.plant.car import COUNT_RAD, COUNTER_RAD
from emb_daemon.wire.contract import CYCLE_S
from studies.blind import campaign


@pytest.fixture(scope="module")
def rippled(calibration):
    """A search on a brake whose gear ripples thrice in a turn, before anything was made for it."""
    hidden = {"gear_mesh_ripple": {"cosine": 0.06, "order_per_turn": 3.0}}
    bench = Bench([log_of(next(drives(calibration, 61, hidden)))], calibration)
    start = Model.of(bench)
    return Selection(start.refined({"torque"}), Screening(bench, start))


def test_a_ripple_taken_at_a_side_lobe_ends_at_its_own_order(rippled, monkeypatch):
    """As it happens where something else was still missing when the order was chosen; beyond what its port may bear it is
    refused, and the search goes on."""
    selection, bench = rippled, rippled.model.bench
    ripples = Search(selection.model, "torque", grammar._signals(selection.model))
    side = harmonic("gear_gain", 2.6, bench.middle, ripples.covered)
    [lobe] = ripples._run([side])
    effect = made_effect(side, "term:gear_gain:motor_angle")
    candidate = Candidate(effect, "torque", evidence=lobe.evidence)
    with monkeypatch.context() as patched:
        # Alone in the model it would find its way by itself.
        patched.setattr(model_module, "_FITS", 0)
        wrong = grammar._enter(selection, candidate, side)
    right = grammar._with_orders_again(wrong, "torque")
    orders = []
    for found in (wrong, right):
        fitted = found.model.bench.calibrated(found.model.values)
        [term] = [term for term in fitted.terms if term.name in found.accepted]
        orders.append(1.0 / term.scale)
    assert abs(orders[0] - 3.0) > 0.1
    assert orders[1] == pytest.approx(3.0, rel=0.01)
    monkeypatch.setattr(calibration_terms, "_FACTOR", 1e-3)
    refused = grammar._enter(selection, candidate, side).candidates[effect.name]
    assert not refused.accepted and "port may bear" in refused.reason
    withdrawn = confirmation.confirm(right, None)[0].candidates[right.accepted[0]]
    assert not withdrawn.accepted and "port may bear" in withdrawn.reason


@pytest.mark.trial
def test_what_follows_slowly_on_a_motor_that_turns_either_way_is_seen_as_that(calibration):
    """Friction that rises for seconds after each stroke, whichever way: a hidden state driven by a power of the speed."""
    hidden = {"size": 1.5, "signal": PLANT_SIGNALS.index("motor_speed"), "exponent": 1.5, "other": -1.0, "lag_s": 2.5}
    frames = next(drives(calibration, 33, {"drawn_gear_friction": hidden}, stops=3))
    model = Model.of(Bench([log_of(frames)], calibration)).refined(["torque"])
    best = Search(model, "torque", grammar._signals(model)).prospects()[0]
    assert best.means == ("gear_friction", "motor_speed") and best.form.memory == "response"
    assert best.form.memory_scale == pytest.approx(2.5, rel=0.3)


@pytest.mark.trial
def test_what_follows_slowly_on_a_power_of_the_brake_torque_is_no_power_of_what_follows_it(calibration):
    """A gear whose gain follows the square of the brake torque for seconds beyond each stop."""
    hidden = {"size": 1.0, "signal": PLANT_SIGNALS.index("brake_torque"), "exponent": 2.3, "other": -1.0, "lag_s": 7.0}
    frames = next(drives(calibration, 35, {"drawn_gear_gain": hidden}, stops=6, drive=campaign))
    model = Model.of(Bench([log_of(frames)], calibration)).refined(["torque"])
    best = Search(model, "torque", grammar._signals(model)).prospects()[0]
    assert best.means == ("gear_gain", "brake_torque") and best.form.memory == "response"
    assert best.form.memory_scale == pytest.approx(7.0, rel=0.4)


def test_a_gear_that_is_worn_at_one_place_along_its_travel_is_seen_as_that(calibration):
    """Its transmission, which load takes whichever way the motor turns; as friction there it would change its sign with the
    motion. The calibration is wrong by what the gear of the log does not have."""
    worn = Term(
        name="term:worn", port="gear_gain", signal="travel", shape="bump", coefficient=0.2, scale=2.0, centre=18.0, low=0.0,
        high=40.0,
    )  # fmt: skip
    log = log_of(next(drives(calibration, 37, {}, stops=3)))
    model = Model.of(Bench([log], msgspec.structs.replace(calibration, terms=(worn,)))).refined(["torque"])
    search = Search(model, "torque", grammar._signals(model))
    best = search.forms[int(np.argmax(search.gains))]
    assert best.means == ("gear_gain", "travel") and abs(best.centre - 18.0) < best.scale + 2.0
    assert search._run([best])[0].evidence.values[0] < -0.05


def test_what_friction_does_as_it_turns_over_makes_no_term(calibration):
    """A motor that holds just behind a reversal holds with a friction that no model knows, in each stop: with nothing hidden
    what follows braking gains far less than what matters."""
    frames = next(drives(calibration, 1001, {}, stops=25, drive=campaign))
    bench = Bench([log_of(frames)], calibration)
    start = Model.of(bench)
    model = start.refined(["torque"])
    search = Search(model, "torque", grammar._signals(model))
    braking = [f for f in search.forms if f.port == "gear_friction" and f.signal in ("brake_torque", "time_clamped")]
    gains = search._find_gains(braking)
    assert model.rms(gains.max(), "torque") < 0.5 * Screening(bench, start).floor(model, "torque", made=True)


@pytest.mark.trial
def test_pads_that_remember_how_fast_they_were_closed_are_seen_as_that(calibration):
    """A hidden state that no signal has: the largest of one, forgotten in half a minute."""
    hidden = {"share": 0.03, "exponent": 1.3, "recovery_s": 30.0}
    frames = next(drives(calibration, 36, {"fastest_closing": hidden}, stops=12, drive=campaign))
    model = Model.of(Bench([log_of(frames)], calibration)).refined(["stiffness"])
    best = Search(model, "stiffness", grammar._signals(model)).prospects()[0]
    assert best.means == ("stiffness", "motor_speed") and best.form.memory == "peak"
    # What is seen is how fast the power of the state falls.
    assert best.form.exponent / best.form.memory_scale == pytest.approx(1.3 / 30.0, rel=0.4)


def test_a_motion_is_no_state_of_pads_but_the_fastest_of_late_is():
    """A stiffness that followed the speed itself would be a source of energy."""
    forms = enumerate_forms({"motor_speed": (-200.0, 200.0)}, ("stiffness", "thickness"))
    assert {form.memory for form in forms} == {"peak"} and {form.port for form in forms} == {"stiffness", "thickness"}
    assert not enumerate_products({"motor_speed": (-200.0, 200.0), "disc_speed": (0.0, 50.0)}, ("stiffness",))


@pytest.mark.trial
def test_two_signals_that_multiply_are_seen_as_both(calibration):
    """A gear whose friction rises for seconds with the force, more on a faster disc: neither explains it alone."""
    of = {"signal": PLANT_SIGNALS.index("clamp_force"), "exponent": 0.7, "other": PLANT_SIGNALS.index("disc_speed")}
    hidden = {"drawn_gear_friction": {"size": 1.0, "lag_s": 5.0} | of}
    frames = next(drives(calibration, 35, hidden, stops=12, drive=campaign))
    model = Model.of(Bench([log_of(frames)], calibration)).refined(["torque"])
    best = Search(model, "torque", grammar._signals(model)).prospects()[0]
    assert best.means == ("gear_friction", "clamp_force times disc_speed") and best.form.memory == "response"
    assert best.form.memory_scale == pytest.approx(5.0, rel=0.6)


@pytest.fixture(scope="module")
def coupled(calibration):
    """(search, fit log, validation log) of a brake that clamps harder as it brakes, which no catalogue holds."""
    logs = [log_of(part) for part in drives(calibration, 31, {"brake_torque_coupling": {"per_Nm": 8e-5}})]
    return search.select(Bench(logs[:1], calibration), lambda text, share: None), *logs


def test_what_no_effect_explains_is_said_with_what_it_depends_on(calibration, coupled, monkeypatch):
    [term] = coupled[0].accepted
    bare = coupled[0].without(term, "to see what is said where no term is made")
    monkeypatch.setattr(diagnosis, "select", lambda bench, progress: bare)
    result = diagnose(coupled[1:2], calibration)
    assert all(finding.in_calibration for finding in result.accepted)
    assert result.unexplained.strongest.signal in ("brake_torque", "disc_speed")


def test_a_term_is_made_for_what_no_catalogue_holds(calibration, coupled, tmp_path, monkeypatch):
    """It names port and signal, has numbers with sigma, carries over to another log, and is data in the calibration."""
    selection, *logs = coupled
    monkeypatch.setattr(diagnosis, "select", lambda bench, progress: selection)
    result = diagnose(logs[:1], calibration, logs[1:])
    [entry] = [e for e in report(result)["effects"] if e["accepted"]]
    assert entry["made"] and (entry["port"], entry["signals"]) == ("stiffness", ["brake_torque"])
    assert entry["name"].startswith("term:") and entry["shape"] == "odd_power" and "brake torque" in entry["equation"]
    save_calibration(result.calibration, tmp_path / "calibration.yaml")
    loaded = load_calibration(tmp_path / "calibration.yaml")
    [term] = loaded.terms
    assert 0.0 < term.sigma < 0.1 * term.coefficient and term.provenance
    # At half of the range the true effect is 8e-5 of it, whatever exponent came out.
    half = 0.5 * term.high
    assert term.coefficient * (half / term.scale) ** term.exponent == pytest.approx(8e-5 * half, rel=0.15)
    assert result.before.rmse("fused") > 80.0 and result.after.rmse("fused") < 45.0
    assert result.unexplained is None
    # That nobody knows such an effect is said where it is named, and drawn with the unit of what it follows.
    told, written = verdict(result), page(result)
    assert told.startswith("Found for what no known effect explains: a term of brake torque at the stiffness")
    assert "its cause is not known" in written and r"brake torque \u002f N" in written and "what it does" in written
    assert ">nan<" not in written
    assert errors(Bench(logs[1:], calibration), loaded).rmse("fused") == result.after.rmse("fused")


def test_terms_that_logs_cannot_tell_apart_are_named_together(calibration, coupled, monkeypatch):
    """Which of them is written out is chance: verdict and report name all, and what would tell."""
    selection, *logs = coupled
    [name] = selection.accepted
    unsure = dataclasses.replace(
        selection.candidates[name], alike=(("thickness", ("disc_speed",)),), manoeuvre=MANOEUVRES["brake_torque"]
    )
    monkeypatch.setattr(diagnosis, "select", lambda bench, progress: selection.noted([unsure]))
    result = diagnose(logs[:1], calibration, logs[1:])
    [entry] = [e for e in report(result)["effects"] if e["accepted"]]
    assert entry["alike"] == [{"port": "thickness", "signals": ["disc_speed"]}]
    assert result.outside == [] and report(result)["outside_range"] == []
    told = verdict(result)
    assert f"as likely it is of disc speed at the contact; what would tell: {MANOEUVRES['brake_torque']}" in told
    assert "brake torque at the stiffness" in told


def test_where_a_log_leaves_the_range_of_a_term_is_said(calibration):
    """What a term adds there is a guess. Noise of a brake torque about zero leaves no range."""
    bench = Bench([log_of(next(drives(calibration, 31, {})))], calibration)
    known = {"shape": "odd_power", "coefficient": 1e-4, "port": "stiffness", "signal": "brake_torque"}
    noise = bench.trials[0].brake_torque_Nm
    noise += 0.002 * np.max(noise) * np.random.default_rng(1).standard_normal(len(noise))
    most = float(np.max(noise))
    wide, narrow, product = (
        Term(name=f"term:{name}", **known, **more)
        for name, more in {
            "wide": {"low": 0.0, "high": 0.98 * most},
            "narrow": {"low": -1.0, "high": 0.5 * most},
            "product": {"low": -1.0, "high": 1.01 * most, "other": "pad_temperature", "other_high": 21.0},
        }.items()
    )
    assert outside_range(bench, [wide]) == []
    [torque] = outside_range(bench, [wide, narrow])
    assert (torque.term, torque.signal, torque.found) == ("term:narrow", "brake_torque", (-1.0, 0.5 * most))
    assert torque.share > 0.05 and torque.reached[1] == pytest.approx(most, rel=0.01)
    [warm] = outside_range(bench, [product])
    assert warm.signal == "pad_temperature" and warm.found == (None, 21.0) and warm.reached[1] > 25.0
    # Within the range of a signal a term may remember more of it than where it was found.
    lag = msgspec.structs.replace(wide, high=1.01 * most, low=-1.0, memory="lag", memory_scale=20.0)
    kept = np.exp(-CYCLE_S / 20.0)
    slow = lfilter([1.0 - kept], [1.0, -kept], np.maximum(bench.trials[0].brake_torque_Nm, 0.0))
    known = _with_memory(lag, bench, calibration)
    assert known.memory_low == pytest.approx(0.0, abs=0.01 * most)
    assert known.memory_high == pytest.approx(slow.max(), rel=0.1) and known.memory_high < 0.5 * most
    assert outside_range(bench, [known]) == []
    [torque] = outside_range(bench, [msgspec.structs.replace(known, memory_high=0.5 * known.memory_high)])
    assert (torque.signal, torque.memory) == ("brake_torque", "lag") and torque.share > 0.05
    [told] = _outside(SimpleNamespace(outside=[torque]))
    assert "what it remembers of brake torque (lag) is outside the range in which term:wide was found" in told
    [told] = _outside(SimpleNamespace(outside=[warm]))
    assert "pad temperature is outside the range in which term:product was found" in told and "the range 21 °C" in told


def test_a_motor_angle_is_the_same_wherever_a_log_begins(calibration):
    """Terms follow the resolver's angle, not what the motor has turned since the log began."""
    log = log_of(next(drives(calibration, 31, {})))
    log.samples["angle"] += 200.0
    bench = Bench([log], calibration)
    low, high = float(log.samples["angle"].min()), float(log.samples["angle"].max())
    known = {"shape": "odd_power", "coefficient": 1e-4, "port": "torque", "signal": "motor_angle"}
    assert outside_range(bench, [Term(name="term:within", low=low, high=high, **known)]) == []
    [place] = outside_range(bench, [Term(name="term:before", low=0.0, high=high - low, **known)])
    assert place.reached == pytest.approx((low, high), abs=0.1)


def test_a_validation_log_that_leaves_the_range_of_a_term_is_said(calibration, coupled, monkeypatch):
    """A harder stop than any that showed the term: what it does there was never seen."""
    selection, log, another = coupled
    [name] = selection.accepted
    monkeypatch.setattr(diagnosis, "select", lambda bench, progress: selection)
    monkeypatch.setattr(diagnosis, "with_terms", lambda *given: _narrowed(with_terms(*given), name))
    result = diagnose([log], calibration, [another])
    [place] = report(result)["outside_range"]
    assert place["term"] == name and place["signal"] == "brake_torque" and place["reached"][1] > place["found"][1]
    assert f"brake torque is outside the range in which {name} was found" in verdict(result)


def _narrowed(calibration, name):
    terms = [msgspec.structs.replace(t, high=0.5 * t.high) if t.name == name else t for t in calibration.terms]
    return msgspec.structs.replace(calibration, terms=tuple(terms))


def test_an_effect_that_needs_a_term_beside_it_gives_way_to_one_term_that_leaves_as_much(coupled, monkeypatch):
    """Growth with the disc's temperature, and a term beside it, where the term alone is all there is."""
    selection = coupled[0]
    [name] = selection.accepted
    term = selection.candidates[name]
    [growth] = selection.screening.test(selection.model, [e for e in REGISTRY if e.name == "disc_thermal_expansion"])
    with_both = selection.entered([growth])
    assert {*with_both.accepted} == {name, "disc_thermal_expansion"}
    catalogue = with_both.without(name, "what the catalogue alone had found")
    monkeypatch.setattr(grammar, "_with_terms", lambda bare, channel: selection)
    monkeypatch.setattr(grammar, "one_round", lambda terms: terms)
    assert selection.model.noise("stiffness") > with_both.model.noise("stiffness") and term.made
    assert grammar._without_shadows(with_both, catalogue, "stiffness").accepted == [name]


#: With most starts of the wheels that were tried a hysteresis is named as well, with two the disc is not
#: (docs/attribution.md).
_STARTS = [COUNTER_RAD, pytest.param(COUNT_RAD, marks=pytest.mark.xfail(strict=True, reason="the disc is not found"))]


@pytest.mark.trial
@pytest.mark.parametrize("wheels_rad", _STARTS)
def test_an_effect_that_a_larger_cause_hides_is_found_beside_the_term_for_it(calibration, wheels_rad):
    """Pads that stiffen with friction power, on an uneven disc: what follows the brake torque alone explains far more than
    the disc, which passes for its shadow until the term is there."""
    pads = {"size": 0.3, "signal": PLANT_SIGNALS.index("friction_power"), "exponent": 1.5, "other": -1.0, "lag_s": 1.3}
    disc = {"order_1_cosine_um": -6.0, "order_1_sine_um": 3.0}
    hidden = {"drawn_stiffness": pads, "disc_thickness_variation": disc}
    logs = [log_of(part) for part in drives(calibration, 5, hidden, wheels_rad=wheels_rad)]
    selection = search.select(Bench(logs, calibration), lambda text, share: None)
    assert [*selection.accepted] == ["disc_thickness_variation", "term:stiffness:friction_power"]
    found = selection.model.values
    for name, um in disc.items():
        [value] = [v for c, v in found.items() if c.parameter == name]
        assert value == pytest.approx(um, abs=0.5)


def test_an_effect_gives_way_to_no_more_terms_than_stood_beside_it(coupled, monkeypatch):
    """Two shapes of one term are one cause, as an effect is, but the effect has a name."""
    selection = coupled[0]
    [name] = selection.accepted
    first = selection.candidates[name]
    further = dataclasses.replace(first, effect=dataclasses.replace(first.effect, name=f"{name}:2"))
    [growth] = selection.screening.test(selection.model, [e for e in REGISTRY if e.name == "disc_thermal_expansion"])
    with_both, two_shapes = selection.entered([growth]), selection.noted([further])
    monkeypatch.setattr(grammar, "_with_terms", lambda bare, channel: two_shapes)
    monkeypatch.setattr(grammar, "one_round", lambda terms: terms)
    assert grammar._is_shorter(two_shapes, with_both, "stiffness")
    catalogue = with_both.without(name, "what the catalogue alone had found")
    assert grammar._without_shadows(with_both, catalogue, "stiffness") is with_both


def test_a_further_shape_of_one_place_is_a_shorter_description_than_another_place(coupled, monkeypatch):
    """Where a term acts and what it follows has to be said once."""
    selection = coupled[0]
    [name] = selection.accepted
    first = selection.candidates[name]
    further, elsewhere = (
        dataclasses.replace(first, effect=dataclasses.replace(first.effect, name=f"{name}:2", hook=hook))
        for hook in (first.effect.hook, "thickness")
    )
    with_shape, with_place = (selection.noted([other]) for other in (further, elsewhere))
    alone, same, more = grammar._descriptions([selection, with_shape, with_place], "stiffness")
    assert same == alone and np.log(20) < more - alone < np.log(60)
    # Where no single shape will do, two of one place are tried before another place is believed.
    monkeypatch.setattr(grammar, "_in_shapes", lambda start, *_: [with_shape] if start is selection else [])
    assert grammar._restated(with_place, selection, "stiffness") is with_shape


def _prospect(port, signals, numbers, gain, columns=()):
    form = SimpleNamespace(port=port, signals=signals, numbers=numbers)
    return SimpleNamespace(
        form=form, means=(port, " times ".join(signals)), evidence=SimpleNamespace(gain=gain), columns=columns
    )


@pytest.mark.parametrize(
    ("port", "signal", "shape", "physical"),
    [
        ("torque_constant", "winding_heat", "odd_power", (True, False)),
        ("torque_constant", "housing_heat", "decay", (False, True)),
        ("torque_constant", "caliper_temperature", "odd_power", (True, False)),
        ("torque_constant", "current", "even_power", (True, True)),
        ("gear_friction", "winding_heat", "odd_power", (True, True)),
    ],
)
def test_heat_strengthens_no_magnet(port, signal, shape, physical):
    """A torque constant that seems to grow with it is something else's shadow: no form of it is taken, nor fitted so."""
    forms = [form for form in enumerate_forms({signal: (0.0, 1.0)}, (port,)) if form.shape == shape]
    for form in forms:
        for sign, allowed in zip((-1.0, 1.0), physical, strict=True):
            evidence = Evidence(0.0, 1.0, 9.0, np.array([sign * form.step]), np.array([0.0]))
            assert prospects._stays_in_bounds(Prospect(form, [], evidence)) is allowed
        assert form.amplitudes == tuple(sign * np.inf if ok else 0.0 for sign, ok in zip((-1.0, 1.0), physical, strict=True))
    assert forms


def test_a_form_that_does_next_to_nothing_gains_nothing():
    """What decays over a log ends far below what a number holds."""
    least = prospects.Scores(np.array([[1e-158, 1e-160, 0.0]]), np.array([[1e-316, 1e-320, 0.0]]))
    with np.errstate(all="raise"):
        assert abs(least.gain[0]) < 1e-100


def test_resampled_episodes_choose_the_shorter_description(monkeypatch):
    """A form of five numbers that explains a thousandth more than one of three is not what episodes choose."""
    rng = np.random.default_rng(4)
    episode = np.repeat(np.arange(40), 10)
    long, other = rng.standard_normal((2, 400))
    short = long + 0.1 * other
    residual = long + 0.5 * rng.standard_normal(400)

    def scores(columns):
        u, a = (np.add.reduceat(x, np.arange(0, 400, 10)).T for x in (columns * residual[:, None], columns**2))
        return prospects.Scores(u, a)

    screen = SimpleNamespace(
        model=None,
        channel="stiffness",
        means=SimpleNamespace(episode=episode),
        residual=residual[:, None],
        scores=scores,
        noise_scatter=0.0,
    )
    monkeypatch.setattr(grammar, "noise_left", lambda *_: np.zeros(40))
    offered = [_prospect("stiffness", ("energy",), n, 1.0, [x]) for n, x in ((3, short),)]
    offered.insert(0, _prospect("stiffness", ("disc_speed",), 5, 1.001, [long]))
    assert grammar._shares(screen, offered)["stiffness", "energy"] > 0.8
    offered[0].form.numbers = 3
    assert grammar._shares(screen, offered)["stiffness", "energy"] < 0.5
    # Also where noise is estimated as more than is left.
    monkeypatch.setattr(grammar, "noise_left", lambda *_: np.full(40, 20.0))
    offered = [_prospect("stiffness", ("energy",), 3, 1.0, [long]), _prospect("stiffness", ("current",), 2, 1.0, [other])]
    assert grammar._shares(screen, offered)["stiffness", "energy"] > 0.8


@pytest.mark.parametrize(
    ("channel", "left", "numbers", "first"),
    [
        ("torque", (30.0, 10.0), (2, 3), 1),
        ("torque", (1.5, 0.5), (2, 3), 0),
        ("torque", (30.0, 30.0), (3, 2), 1),
        ("temperature", (1.5, 0.5), (2, 3), 1),
    ],
)
def test_of_two_fits_the_shorter_description_is_taken_and_what_does_not_matter_is_nothing(channel, left, numbers, first):
    """By left-out episodes: a rest of 4 (N², of each of 40) does not matter here; of heat the least is taken."""

    def fitted(each):
        return SimpleNamespace(
            left_out=lambda *_, **__: np.full(40, each), counted=lambda _: 40, residual={channel: np.ones(40)},
            bench=SimpleNamespace(episodes=40, means=lambda *_: Averaging(np.arange(40), 1)),
        )  # fmt: skip

    bare = SimpleNamespace(model=fitted(100.0), screening=SimpleNamespace(floor=lambda *_, **__: 2.0))
    pairs = [
        (_prospect("port", ("motor_speed",), count, 1.0), SimpleNamespace(model=fitted(each)))
        for each, count in zip(left, numbers, strict=True)
    ]
    assert np.argmin(grammar._lengths_fitted(bare, channel, pairs, np.ones((1, 40)))) == first


def test_where_noise_is_estimated_as_more_than_is_left_the_fit_that_leaves_less_is_still_better():
    squared = np.array([[100.0, 50.0], [70.0, 90.0]])
    beyond = grammar._beyond(squared, np.array([120.0, 20.0]), 4.0)
    assert beyond.tolist() == [[30.0, 30.0], [4.0, 70.0]]


def test_a_gate_and_a_second_signal_lengthen_every_description(coupled):
    """Those of a term that is in use as those of one that is asked for."""
    selection = coupled[0]
    bench = selection.model.bench
    [term] = bench.calibration.terms
    long = msgspec.structs.replace(term, gate="load", other="disc_speed", other_high=50.0)
    model = dataclasses.replace(selection.model, bench=bench.under(msgspec.structs.replace(bench.calibration, terms=(long,))))
    longer, as_long = grammar._descriptions([dataclasses.replace(selection, model=model), selection], "stiffness")
    numbers = (term.gate == "always") + 2 * (term.other is None)
    assert numbers >= 2
    expected = 0.5 * numbers * np.log(bench.episodes)
    assert longer - as_long == pytest.approx(expected)


def test_of_equal_gains_what_most_resampled_episodes_choose_is_named_and_what_some_choose_is_said():
    pads, disc, power = (
        _prospect("gear_gain", (name,), 2, gain)
        for name, gain in (("pad_temperature", 100.0), ("disc_temperature", 99.0), ("friction_power", 90.0))
    )
    shares = {pads.means: 0.24, disc.means: 0.3, power.means: 0.46}
    assert grammar._most_chosen([pads, disc, power], shares) == [disc, pads, power]
    shares = {pads.means: 0.93, disc.means: 0.03, power.means: 0.04}
    assert grammar._most_chosen([pads, disc, power], shares) == [pads, disc]
    shares = {pads.means: 0.92, disc.means: 0.03, power.means: 0.05}
    # Resampled episodes do not tell how far wrong all of them are alike: a gain within 5 % is as good.
    assert grammar._as_good(pads, [disc, power], shares) == [disc, power]
    shares = {pads.means: 0.93, disc.means: 0.03, power.means: 0.04}
    assert grammar._as_good(pads, [disc, power], shares) == [disc]


def test_many_shapes_of_one_signal_keep_no_other_from_being_asked(monkeypatch):
    """What nearly equals the best is asked however many shapes of the best's own signal gain more, up to a shortlist."""

    def named(name, memory):
        return SimpleNamespace(means=("stiffness", name), port="stiffness", signals=(name,), memory=memory)

    disc, pads, power = [named("disc", n) for n in range(30)], [named("pads", n) for n in range(2)], named("power", 0)
    forms, gains = [*disc, *pads, power], np.array([100.0] * 30 + [96.0, 95.5, 80.0])
    monkeypatch.setattr(prospects, "_fit_sizes", lambda _, form: (form, float(gains[forms.index(form)])))
    asked = prospects._sharpen(SimpleNamespace(model=SimpleNamespace(bench=SimpleNamespace(map=map))), forms, gains)
    assert len(asked) == prospects._SHORTLIST + 1 and asked[-1] is pads[0] and power not in asked
    every = [named(str(number), 0) for number in range(30)]
    assert len(prospects._of_other_means(every, np.ones(30), [], 0.9)) == prospects._SHORTLIST


def test_of_a_product_both_signals_are_asked_for_a_shape():
    """A power of the one that gains more must not keep a power of the other from being fitted."""
    of = lambda one, other: SimpleNamespace(port="stiffness", signals=(one, other), memory="none")  # noqa: E731
    torque, surface = ([of(*names) for _ in range(3)] for names in (("torque", "surface"), ("surface", "torque")))
    forms = [*surface, *torque]
    assert prospects._best_of(forms, np.array([9.0, 8.0, 7.0, 6.0, 5.0, 4.0]), 10) == [*surface[:2], *torque[:2]]


def test_the_heat_of_a_force_that_a_term_has_changed_is_settled_before_another_is_made(coupled, monkeypatch):
    selection, asked = coupled[0], []
    bare = selection.without(*selection.accepted, "to be made again")
    monkeypatch.setattr(Model, "settled", lambda model, channels: asked.append(channels) or model)
    monkeypatch.setattr(grammar, "_one_more", lambda before, _: before if before.accepted else selection)
    monkeypatch.setattr(grammar, "_wanted", lambda *_: True)
    assert grammar._with_terms(bare, "stiffness").accepted == selection.accepted
    assert asked == [{"temperature", "brake_torque", "stiffness"}]


@pytest.mark.parametrize(("gained_K2", "taken"), [(-0.01, False), (0.01, True)])
def test_a_term_of_heat_must_explain_more_than_recalibration_alone(coupled, monkeypatch, gained_K2, taken):
    """... in the whole estimator as it would be applied, each with the friction that makes the heat."""
    selection = coupled[0]
    [name] = selection.accepted
    monkeypatch.setattr(grammar.warmth, "heat_bench", lambda logs, calibration: True)
    monkeypatch.setattr(grammar, "search_heat", lambda bench: selection)
    start = selection.noted([dataclasses.replace(selection.candidates[name], accepted=False)])
    applied = lambda s: SimpleNamespace(model=SimpleNamespace(noise=lambda _: 4.0 if s is start else 4.0 - gained_K2))  # noqa: E731
    monkeypatch.setattr(grammar, "recalibrate_heat", applied)
    found = grammar._with_heat_terms(start)
    assert (name in found.accepted) is taken
    assert taken or "recalibrated" in found.candidates[name].reason


@dataclasses.dataclass(frozen=True)
class _OfHeat:
    """What the gate of heat terms asks of a model: what is left of the temperatures (K²), however it was made."""

    left_K2: float
    bench: SimpleNamespace
    values: dict = dataclasses.field(default_factory=dict)
    fits: dict = dataclasses.field(default_factory=lambda: {"temperature": None})

    def without(self, gone):
        return self

    def entered(self, values, chosen):
        return self

    def noise(self, channel):
        return {"temperature": self.left_K2}[channel]


@pytest.mark.parametrize(("gained_K2", "taken"), [(-0.01, False), (0.0, False), (0.01, True)])
def test_a_term_of_heat_and_none_are_both_recalibrated_before_they_are_compared(calibration, monkeypatch, gained_K2, taken):
    """As fitted, both leave the same; only recalibrated as they would be applied does the term gain, and a tie is none."""
    bench = SimpleNamespace(
        trials=[], calibration=calibration, calibrated=lambda known: calibration, under=lambda terms: bench
    )
    start = Selection(_OfHeat(4.0, bench), None)
    term = Candidate(SimpleNamespace(name="term:heat"), "temperature", accepted=True)
    monkeypatch.setattr(grammar.warmth, "heat_bench", lambda logs, calibration: bench)
    monkeypatch.setattr(grammar, "search_heat", lambda bench: start.noted([term]))
    left = lambda s: 3.0 - gained_K2 if s.accepted else 3.0  # noqa: E731
    monkeypatch.setattr(grammar, "recalibrate_heat", lambda s: dataclasses.replace(s, model=_OfHeat(left(s), bench)))
    found = grammar._with_heat_terms(start)
    assert (found.accepted == ["term:heat"]) is taken
    assert taken or "recalibrated" in found.candidates["term:heat"].reason


@pytest.mark.parametrize(("port", "taken"), [("stiffness", True), ("thickness", False)])
def test_a_term_is_taken_where_its_port_is_sure_though_its_signal_is_not(coupled, monkeypatch, port, taken):
    """Three fifths of the resampled episodes choose it: if the others choose another signal of its port, it is taken, and the
    noise holds the difference."""
    [name] = coupled[0].accepted
    bare = coupled[0].without(name, "to be made again")
    offered = ("brake_torque", "disc_speed") if taken else ("brake_torque",)
    enumerated = prospects.enumerate_forms
    some = lambda *of: [f for f in enumerated(*of) if f.signal in offered and f.port in ("stiffness", port)]  # noqa: E731
    monkeypatch.setattr(prospects, "enumerate_forms", some)
    rival = (port, offered[-1])
    shares = {("stiffness", "brake_torque"): 0.6, rival: 0.4}
    monkeypatch.setattr(grammar, "_shares", lambda _, found: dict.fromkeys((p.means for p in found), 0.0) | shares)
    monkeypatch.setattr(grammar, "_shares_fitted", lambda *_: shares)
    found = grammar._one_more(bare, "stiffness")
    [term] = [c for name, c in found.candidates.items() if name not in bare.candidates]
    assert term.accepted == taken and term.confounded_with == " over ".join(rival).replace("_", " ") and term.manoeuvre
    assert (port, (offered[-1],)) in term.alike
    undecided = diagnosis.undecided(found)
    before = found.model.bench.calibration
    after = diagnosis._with_noise(before, found).noise.stiffness_relative
    assert (undecided.get("noise.stiffness_relative", 0.0) > 0.0) == taken
    assert not taken or after >= undecided["noise.stiffness_relative"]


@pytest.mark.parametrize("why", [TOO_LARGE, grammar._NOT_HELD])
@pytest.mark.parametrize(("share", "accepted"), [(0.96, 1), (0.94, 0)])
def test_of_what_logs_cannot_tell_apart_what_does_not_hold_is_not_it(coupled, monkeypatch, share, accepted, why):
    """A form that its port may not bear, or that the fit loses, gives way to another that gains as much; not to one that gains
    less."""
    [name] = coupled[0].accepted
    bare, enter, tried = coupled[0].without(name, "to be made again"), grammar._enter, []
    enumerated = prospects.enumerate_forms
    some = lambda *of: [f for f in enumerated(*of) if f.signal in ("brake_torque", "disc_speed")]  # noqa: E731
    monkeypatch.setattr(prospects, "enumerate_forms", some)
    found = Search.prospects

    def two(search, floor):
        first, second, *_ = found(search, floor)
        gain = share * first.evidence.gain
        return [first, dataclasses.replace(second, evidence=dataclasses.replace(second.evidence, gain=gain))]

    def refuse_first(selection, candidate, form):
        tried.append(form)
        if len(tried) == 1:
            return selection.noted([dataclasses.replace(candidate, reason=why)])
        return enter(selection, candidate, form)

    monkeypatch.setattr(Search, "prospects", two)
    monkeypatch.setattr(grammar, "_enter", refuse_first)
    assert len(grammar._one_more(bare, "stiffness").accepted) == accepted
    assert len(tried) == 1 + accepted and len(set(tried)) == len(tried)


def test_the_best_of_all_forms_that_follows_a_little_of_what_is_left_is_no_term(coupled, monkeypatch):
    """However significant it is: some form always does, such as how friction turns over. Either the logs are described more
    shortly without it, or other stops would have chosen another port."""
    monkeypatch.setattr(Search, "chance", lambda *_: 0.0)
    monkeypatch.setattr(Search, "at_another_time", lambda *_: 0.0)
    monkeypatch.setattr(Screening, "rival", lambda *_: (0.0, ""))
    monkeypatch.setattr(Screening, "floor", lambda *_, **__: 1.0)
    enumerated = prospects.enumerate_forms
    some = lambda *of: [f for f in enumerated(*of) if f.signal == "motor_speed"]  # noqa: E731
    monkeypatch.setattr(prospects, "enumerate_forms", some)
    found = grammar._one_more(coupled[0], "torque")
    [tried] = [c for name, c in found.candidates.items() if name not in coupled[0].candidates]
    refused = tried.reason == grammar._NOT_SHORTER or "same port in" in tried.reason
    assert tried.gain > 1.0 and refused and not tried.accepted and found.accepted == coupled[0].accepted


@pytest.mark.parametrize("clamps", [True, False])
def test_only_of_a_brake_a_term_must_shorten_the_description(monkeypatch, clamps):
    """Where nothing is clamped, terms that lengthen it hold on other recordings."""
    bench = SimpleNamespace(clamps=clamps)
    bare, found = (SimpleNamespace(model=SimpleNamespace(bench=bench), accepted=names) for names in ([], ["term"]))
    monkeypatch.setattr(grammar, "_descriptions", lambda both, channel: [float(len(each.accepted)) for each in both])
    assert grammar._is_longer(found, bare, "torque") == clamps and not grammar._is_longer(bare, found, "torque")


def test_what_is_as_good_on_the_screen_is_told_apart_by_a_fit(coupled, monkeypatch):
    """A line may gain more, and be chosen by all resampled episodes, at a port and signal that cannot do it in full. Left-out
    episodes say so, as they do of each bootstrap: one that these never choose must not stand for all."""
    [name] = coupled[0].accepted
    bare = coupled[0].without(name, "to be made again")
    enumerated, found = prospects.enumerate_forms, Search.prospects
    offered = (("stiffness", "brake_torque"), ("stiffness", "disc_speed"), ("thickness", "disc_speed"))
    some = lambda *of: [f for f in enumerated(*of) if (f.port, f.signal) in offered]  # noqa: E731
    monkeypatch.setattr(prospects, "enumerate_forms", some)

    def equal(search, floor):
        asked = found(search, floor)
        gain = max(p.evidence.gain for p in asked)
        asked = [dataclasses.replace(p, evidence=dataclasses.replace(p.evidence, gain=gain)) for p in asked]
        return sorted(asked, key=lambda p: p.form.signal == "brake_torque")

    monkeypatch.setattr(Search, "prospects", equal)
    all_choose_the_first = lambda _, asked: dict.fromkeys((p.means for p in asked), 0.0) | {asked[0].means: 1.0}  # noqa: E731
    monkeypatch.setattr(grammar, "_shares", all_choose_the_first)
    monkeypatch.setattr(grammar, "_descriptions", lambda both, channel: [0.0] * len(both))
    again = grammar._one_more(bare, "stiffness")
    [term] = (again.candidates[name] for name in again.accepted)
    assert (term.effect.hook, term.signals) == ("stiffness", ("brake_torque",))
    assert "same port in 100 % of bootstraps" in term.reason
    assert again.model.noise("stiffness") == pytest.approx(coupled[0].model.noise("stiffness"), rel=0.05)


@pytest.mark.parametrize(("port", "share", "asked"), [("thickness", 0.09, 0), ("thickness", 0.11, 1), ("stiffness", 0.09, 1)])
def test_what_a_term_that_is_nearly_right_leaves_is_no_second_cause(coupled, monkeypatch, port, share, asked):
    """A term of another place gains a tenth of what the first does, or is not believed; a further shape of the same may."""
    selection, tried = coupled[0], []
    model = selection.model
    [term] = [t for t in model.bench.calibrated(model.values).terms if t.name in selection.accepted]
    off = model.bench.under(model.bench.calibrated(model.values))
    off = off.under(msgspec.structs.replace(off.calibration, terms=()))
    does = model.rms(float(np.square(off.residuals({})["stiffness"] - model.residual["stiffness"]).sum()), "stiffness")
    found = Search(model, "stiffness", grammar._signals(model))
    form = next(f for f in found.forms if (f.port, f.signal) == (port, term.signal))
    [prospect] = found._run([form])
    gain = (share * does) ** 2 * model.counted("stiffness")
    prospect = dataclasses.replace(prospect, evidence=dataclasses.replace(prospect.evidence, gain=gain))
    monkeypatch.setattr(Search, "prospects", lambda *_: [prospect])
    monkeypatch.setattr(Search, "chance", lambda *_: 0.0)
    monkeypatch.setattr(Search, "at_another_time", lambda *_: 0.0)
    monkeypatch.setattr(Screening, "rival", lambda *_: (0.0, ""))
    monkeypatch.setattr(Screening, "floor", lambda *_, **__: 0.0)
    monkeypatch.setattr(grammar, "_enter", lambda before, candidate, _: tried.append(candidate) or before.noted([candidate]))
    grammar._one_more(selection, "stiffness")
    assert len(tried) == asked


def test_a_term_whose_shape_is_only_nearly_right_is_stated_anew(coupled, monkeypatch):
    """What it leaves would look like another term. Other shapes are fitted from where the first has led: a fit without any
    would first make up for it with everything else."""
    [name] = coupled[0].accepted
    bare, candidate = coupled[0].without(name, "to be made again"), coupled[0].candidates[name]
    search = Search(bare.model, "stiffness", grammar._signals(bare.model))
    crooked = next(p for p in search._run(
        [f for f in search.forms if (f.port, f.signal, f.memory) == ("stiffness", "brake_torque", "lag")]
    ))  # fmt: skip
    effect = made_effect(crooked.form, grammar._name(crooked.form, bare))
    before = grammar._enter(bare, dataclasses.replace(candidate, effect=effect, evidence=crooked.evidence), crooked.form)
    assert before.accepted == [effect.name]
    monkeypatch.setattr(Selection, "without", lambda *_: pytest.fail("it was refitted without the term"))
    found = grammar._restated(before, before, "stiffness")
    [chosen] = found.accepted
    [term] = [t for t in found.model.bench.calibrated(found.model.values).terms if t.name == chosen]
    assert chosen != effect.name and (term.signal, term.memory, term.shape) == ("brake_torque", "none", "odd_power")
    assert found.model.noise("stiffness") < before.model.noise("stiffness")


@pytest.mark.parametrize("alike", [(), (("stiffness", ("brake_torque",)),)])
def test_a_term_over_a_signal_that_is_only_nearly_right_is_stated_anew_where_another_was_as_likely(coupled, alike):
    """What the wrong one of two signals leaves would look like another term."""
    [name] = coupled[0].accepted
    bare = coupled[0].without(name, "to be made again")
    wrong = max(
        grammar._search(bare.model, "stiffness").of_means("stiffness", ("friction_power",)), key=lambda p: p.evidence.gain
    )
    candidate = dataclasses.replace(
        coupled[0].candidates[name],
        effect=made_effect(wrong.form, grammar._name(wrong.form, bare)),
        evidence=wrong.evidence,
        signals=("friction_power",),
        alike=alike,
    )
    before = grammar._enter(bare, candidate, wrong.form)
    assert before.accepted == ["term:stiffness:friction_power"]
    found = grammar._restated(before, before, "stiffness")
    if not alike:
        assert all(made.startswith("term:stiffness:friction_power") for made in found.accepted)
        return
    [chosen] = [found.candidates[made] for made in found.accepted]
    assert (chosen.effect.hook, chosen.effect.signal, chosen.signals) == ("stiffness", "brake_torque", ("brake_torque",))
    assert (
        chosen.alike == (("stiffness", ("friction_power",)),)
        and "cannot tell it from stiffness over friction power" in chosen.reason
    )
    assert found.model.noise("stiffness") < before.model.noise("stiffness")


def test_other_temperatures_are_named_unless_the_odds_are_99_to_1(coupled, monkeypatch):
    """They move together, and a screen that is linear about a fit without the term does not tell them apart."""
    selection = coupled[0]
    [name] = selection.accepted
    hot = dataclasses.replace(
        selection.candidates[name], signals=("brake_torque", "disc_temperature"), alike=(), undecided_N=0.0
    )
    asked = []

    def fitted(bare, candidate, _):
        assert name not in bare.accepted and not bare.model.of_effect(name)
        asked.extend(candidate.alike)
        effects = {place: dataclasses.replace(hot.effect, name=f"term:{place}") for place in candidate.alike}
        return [bare.noted([dataclasses.replace(hot, effect=effects[place], signals=place[1])]) for place in effects]

    monkeypatch.setattr(grammar, "_at_places", fitted)
    monkeypatch.setattr(grammar, "_descriptions", lambda *_: [100.0, 95.0, 104.5, 104.7])
    equals = grammar._with_other_temperatures(selection.noted([hot]), name, "stiffness").candidates[name]
    assert asked == [("stiffness", ("brake_torque", f"{where}_temperature")) for where in ("surface", "pad", "caliper")]
    assert equals.alike == tuple(asked[:2]) and equals.accepted and equals.undecided_N > 0.0
    assert equals.confounded_with == "stiffness over brake torque times surface temperature"
    # What is named already, and a term without a temperature, are not asked.
    asked.clear()
    known = dataclasses.replace(hot, alike=equals.alike)
    monkeypatch.setattr(grammar, "_descriptions", lambda *_: [100.0, 104.7])
    assert grammar._with_other_temperatures(selection.noted([known]), name, "stiffness").candidates[name].alike == equals.alike
    assert asked == [("stiffness", ("brake_torque", "caliper_temperature"))]
    assert grammar._with_other_temperatures(selection, name, "stiffness") is selection


def test_of_two_that_stand_for_one_cause_one_stays(monkeypatch):
    """Each says nothing beside the other; what gains least goes, and then the other holds."""

    def with_(*names):
        own = {name: Coordinate(name, "torque", 0.0, 1.0, np.inf, ()) for name in names}
        gone = lambda name, reason: with_(*(n for n in names if n != name))  # noqa: E731
        return SimpleNamespace(accepted=list(names), model=SimpleNamespace(of_effect=lambda n: [own[n]]), without=gone)

    gains = {"first": 0.9, "second": 0.2}
    failing = lambda s, name: (gains[name], name, s.model.of_effect(name)) if len(s.accepted) == 2 else None  # noqa: E731
    monkeypatch.setattr(selection_module, "_failing", failing)
    assert revise(with_("first", "second")).accepted == ["first"]
    assert revise(with_("second", "first")).accepted == ["first"]


def test_a_term_that_its_limit_would_hold_is_not_taken(coupled):
    """A product is held in the kernel; one that is at its limit in more than a tenth of the samples is something else."""
    model = coupled[0].model
    search = Search(model, "stiffness", grammar._signals(model))
    of = {"port": "stiffness", "signal": "clamp_force", "shape": "odd_power", "scale": 1e4, "low": 0.0, "high": 2.5e4}
    term = Term(name="term:x", coefficient=0.3, other="brake_torque", other_high=500.0, **of)
    assert search.is_within(term)
    assert not search.is_within(msgspec.structs.replace(term, coefficient=30.0))
    assert search.is_within(msgspec.structs.replace(term, coefficient=0.3, other=None, other_high=0.0))


def _filled(selection, terms, coefficient=1e-9):
    """A selection whose calibration holds so many terms, those added next to nothing."""
    bench = selection.model.bench
    [*own] = bench.calibration.terms
    more = {"port": "torque", "signal": "motor_speed", "shape": "constant", "low": -1e9, "high": 1e9}
    own += [Term(name=f"term:{number}", coefficient=coefficient, **more) for number in range(len(own), terms)]
    under = bench.under(msgspec.structs.replace(bench.calibration, terms=tuple(own)))
    return dataclasses.replace(selection, model=dataclasses.replace(selection.model, bench=under))


@pytest.fixture(scope="module")
def full(rippled):
    """As many terms as a calibration holds, the last of them the gear's ripple."""
    start = _filled(rippled, MOST - 1)
    search = Search(start.model, "torque", grammar._signals(start.model))
    [ripple] = search._run([harmonic("gear_gain", 3.0, start.model.bench.middle, search.covered)])
    effect = made_effect(ripple.form, grammar._name(ripple.form, start))
    found = grammar._enter(start, Candidate(effect, "torque", evidence=ripple.evidence), ripple.form)
    assert len(prospects.standing_terms(found.model)) == MOST and found.accepted == [effect.name]
    return found


def test_where_a_calibration_has_no_room_for_a_term_a_search_offers_none_and_that_is_said(full, monkeypatch):
    search = Search(full.model, "torque", grammar._signals(full.model))
    assert search.prospects() == [] and search.ripples() == [] and search.of_means("torque", ("motor_speed",)) == []
    monkeypatch.setattr(grammar, "_wanted", lambda *_: True)
    asked = grammar._with_terms(full, "torque")
    assert asked.accepted == full.accepted and asked.full == {"torque"}
    form = harmonic("torque", 3.0, full.model.bench.middle, search.covered)
    candidate = Candidate(made_effect(form, "term:torque:motor_angle"), "torque")
    assert "holds" in grammar._enter(full, candidate, form).candidates["term:torque:motor_angle"].reason
    [told] = _full(SimpleNamespace(selection=asked))
    assert told.startswith(f"No further term was looked for on the torque path: a calibration holds {MOST} terms")
    assert _full(SimpleNamespace(selection=full)) == []


def test_a_term_that_was_taken_out_again_takes_no_room(full, monkeypatch):
    """A further one, and what is tried for a moment, stand in its place under another name."""
    monkeypatch.setattr(model_module, "_FITS", 0)
    [name] = full.accepted
    bare = full.without(name, "to be made again")
    assert prospects.free_place(full.model) is None and prospects.free_place(bare.model) == MOST - 1
    search = Search(bare.model, "torque", grammar._signals(bare.model))
    [ripple] = search._run([harmonic("gear_gain", 3.0, bare.model.bench.middle, search.covered)])
    named = grammar._name(ripple.form, bare)
    assert named == f"{name}:2"
    again = Candidate(made_effect(ripple.form, named), "torque", evidence=ripple.evidence)
    found = grammar._enter(bare, again, ripple.form)
    assert found.accepted == [named] and found.model.bench.calibration.terms[-1].name == named
    assert len(found.model.bench.calibration.terms) == MOST
    assert found.model.noise("torque") == pytest.approx(full.model.noise("torque"), rel=0.05)


def test_the_order_of_a_ripple_is_chosen_again_in_a_calibration_that_holds_no_further_term(full, monkeypatch):
    """The search for it tries terms beside those that stand, of which the ripple is none for a moment."""
    monkeypatch.setattr(model_module, "_FITS", 0)
    again = grammar._with_orders_again(full, "torque")
    assert len(again.accepted) == 1 and again.model.noise("torque") <= full.model.noise("torque")


def test_a_calibration_with_the_four_terms_of_another_brake_has_room_for_more(rippled, full):
    assert grammar._has_room(_filled(rippled, 4), "torque") and grammar._has_room(_filled(rippled, MOST - 3), "torque")
    assert not grammar._has_room(_filled(rippled, MOST - 2), "torque"), "two are the heat's"
    assert grammar._has_room(_filled(_filled(rippled, 4), MOST, 0.0), "torque"), "nor do those that were taken out again"
    assert grammar._has_room(_filled(rippled, MOST - 2), "temperature")
    assert not any(grammar._has_room(full, channel) for channel in ("torque", "temperature"))


@pytest.mark.parametrize("clamps", [True, False])
def test_of_a_brake_no_place_along_the_motor_angle_is_asked_for(clamps):
    """The angle begins anywhere at each power-on: in the next log the term would act at another place."""
    covered = {"motor_angle": (0.0, 40.0), "travel": (0.0, 20.0), "motor_speed": (-200.0, 200.0)}
    bench = SimpleNamespace(clamps=clamps)
    search = SimpleNamespace(covered=covered, ports=PORTS, model=SimpleNamespace(bench=bench))
    search.forms = Search.forms.func(search)
    assert any(form.signal == "motor_angle" for form in search.forms), "chance may do what no term may"
    forms = [search.forms[i] for i in Search._lasting(search, range(len(search.forms)))]
    assert any(form.signal == "motor_angle" for form in forms) is not clamps
    assert any((form.signal, form.shape) == ("travel", "bump") for form in forms)
    assert {*rippling(PORTS)} >= {"gear_gain", "torque"}, "ripples are no place"


def test_every_form_of_a_heat_balance_may_be_a_term():
    """Which has no motor angle, and whose logs are not asked what they clamp."""
    covered = {"clamp_force": (0.0, 2e4), "disc_speed": (0.0, 60.0)}
    search = SimpleNamespace(forms=list(enumerate_forms(covered, PORTS)), model=SimpleNamespace(bench=SimpleNamespace()))
    assert len(search.forms) > 10 and Search._lasting(search, range(len(search.forms))) == [*range(len(search.forms))]


def test_a_term_beside_which_everything_else_says_the_same_is_not_applied(coupled, monkeypatch):
    """What is proven over the whole grammar owes no chance of its own, but in the end it must still gain what matters."""
    assert revise(coupled[0]).accepted == coupled[0].accepted
    monkeypatch.setattr(Screening, "floor", lambda *_: 1e4)
    assert revise(coupled[0]).accepted == []


@pytest.mark.parametrize(("deviations", "stays"), [(1.9, False), (2.1, True)])
def test_a_term_on_which_episodes_do_not_agree_is_not_applied(coupled, monkeypatch, deviations, stays):
    """One hot stop may carry the best of the whole grammar, which is as good as nothing in all others."""
    evidence_against = Model.evidence_against

    def scattered(self, values, samples=1):
        found = evidence_against(self, values, samples)
        return dataclasses.replace(found, sigmas=np.abs(found.values) / deviations)

    monkeypatch.setattr(Model, "evidence_against", scattered)
    assert bool(revise(coupled[0]).accepted) is stays


def test_a_term_that_does_not_carry_over_is_not_written(calibration, coupled, monkeypatch):
    selection, fit_log, _ = coupled
    nominal = log_of(next(drives(calibration, 54, {}, stops=3)))
    monkeypatch.setattr(diagnosis, "select", lambda bench, progress: selection)
    result = diagnose([fit_log], calibration, [nominal])
    [refused] = [f for f in result.findings if f.made]
    assert not refused.accepted and "validation" in refused.reason
    assert not result.calibration.terms
    assert report(result)["unexplained"]["present"] and "Proven on these logs but not applied: a term of" in verdict(result)
