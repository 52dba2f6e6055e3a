"""Terms that no catalogue holds: what they do at their ports, and what of them a calibration may say."""

import contextlib
import io
import os
import runpy
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.calibration.files import dump_calibration, shipped_calibration
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.terms import Term, fill_terms
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.cli.main import main
from emb_daemon.diagnose import export
from emb_daemon.effects import REGISTRY, terms
from emb_daemon.errors import InputErrors, InvalidValue
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.offline import estimate
from emb_daemon.offline.run import held, run_step

DT = 0.004


@pytest.fixture(scope="module")
def calibration():
    """The shipped one without effects, whose terms would add up with those here."""
    return msgspec.structs.replace(shipped_calibration(), effects={})


def constant(port, coefficient, **more):
    """Acts always and everywhere."""
    return Term(
        name="term:x", port=port, signal="motor_speed", shape="constant", coefficient=coefficient, low=-1e4, high=1e4, **more
    )


def drive(seconds=8.0):
    """A clamp to about 10 kN with a slow stroke on top, its current fair."""
    time = DT * np.arange(round(seconds / DT))
    samples = np.zeros(len(time), SAMPLE)
    samples["dt"] = np.where(time == 0.0, 0.0, DT)
    samples["angle"] = 20.0 * np.clip(time / 2.0, 0.0, 1.0) + 1.5 * np.sin(2.0 * (time - 2.0)) * (time > 2.0)
    samples["speed"] = np.gradient(samples["angle"], DT)
    samples["current_q"], samples["has_current"] = 10.0, True
    samples["brake_torque"] = np.nan
    return samples


def traced(calibration, *more):
    return run_step(drive(), held(to_parameters(msgspec.structs.replace(calibration, terms=more))))


@pytest.mark.parametrize(
    ("port", "size", "change"),
    [
        ("stiffness", 0.02, lambda p: p["curve"].__imul__(1.02)),
        ("thickness", 2e-6, lambda p: p.__setitem__("clearance", p["clearance"] - 2e-6 / p["gear_gain"])),
        ("motor_angle", 0.1, lambda p: p.__setitem__("clearance", p["clearance"] - 0.1)),
        ("torque_constant", 0.05, lambda p: p.__setitem__("torque_constant", 1.05 * p["torque_constant"])),
        ("relaxation_time", 0.5, lambda p: p.__setitem__("relaxation_time", 1.5 * p["relaxation_time"])),
        ("gear_gain", 0.05, None),
        ("gear_friction", 0.1, lambda p: (p.__setitem__("load_friction", 1.1 * p["load_friction"]),
                                          p.__setitem__("offset_friction", 1.1 * p["offset_friction"]))),
    ],
)  # fmt: skip
def test_a_constant_at_a_port_is_what_its_base_parameter_does(calibration, port, size, change):
    """Ports are where they say, in their units: a constant there is another value of the parameter beside it."""
    found = traced(calibration, constant(port, size))
    p = held(to_parameters(calibration))
    if change is None:
        assert np.allclose(found["leverage"] - traced(calibration)["leverage"], size * p["gear_gain"][0])
        return
    change(p[0])
    expected = run_step(drive(), p)
    for name in ("force", "torque", "leverage"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, atol=1e-9)


def test_torque_and_force_add_in_their_units(calibration):
    plain = traced(calibration)
    more = traced(calibration, constant("torque", 0.01))
    np.testing.assert_allclose((more["torque"] - plain["torque"])[1:], 0.01, atol=1e-12)
    ampere = traced(calibration, constant("current", 0.5))
    constant_Nm_per_A = calibration.motor.torque_constant_Nm_per_A
    np.testing.assert_allclose((ampere["torque"] - plain["torque"])[1:], 0.5 * constant_Nm_per_A, rtol=1e-9)
    late = slice(1500, None)
    np.testing.assert_allclose((traced(calibration, constant("force", 50.0))["force"] - plain["force"])[late], 50.0, atol=1e-3)


def test_without_terms_no_bit_changes_and_a_term_of_size_zero_is_none(calibration):
    assert traced(calibration).tobytes() == traced(calibration, constant("stiffness", 0.0)).tobytes()


# -- the kernel -------------------------------------------------------------------------------------------------------


def record(term):
    parameters = np.zeros(1, terms.PARAMETERS)[0]
    fill_terms(parameters, (term,))
    return parameters["term"][0]


def over(term, x, **others):
    """The term over a signal."""
    signals = np.zeros((len(x), len(terms.SIGNALS)))
    for name, column in {term.signal: x, **others}.items():
        signals[:, list(terms.SIGNALS).index(name)] = column
    return terms.evaluate(record(term), signals, np.full(len(x), DT), 20000.0)


_SHAPES = {
    "constant": lambda u, n: np.ones_like(u),
    "odd_power": lambda u, n: np.sign(u) * np.abs(u) ** n,
    "even_power": lambda u, n: np.abs(u) ** n,
    "saturation": lambda u, n: u / (1.0 + np.abs(u)),
    "decay": lambda u, n: np.exp(-np.abs(u)),
    "onset": lambda u, n: np.maximum(u, 0.0),
    "bump": lambda u, n: np.exp(-(u**2)),
}
_size = st.floats(0.1, 10.0)


@given(st.sampled_from(sorted(_SHAPES)), _size, st.floats(-20.0, 20.0), st.floats(0.3, 3.0))
def test_shapes_are_what_they_are_called(shape, scale, centre, exponent):
    x = np.linspace(-60.0, 60.0, 41)
    term = Term(
        name="term:x", port="force", signal="motor_speed", shape=shape, coefficient=7.0, scale=scale, centre=centre,
        exponent=exponent, low=-10.0, high=30.0,
    )  # fmt: skip
    # Outside of its range a term goes on for a quarter of its width, and then stays.
    u = (np.clip(x, -20.0, 40.0) - centre) / scale
    np.testing.assert_allclose(over(term, x), 7.0 * _SHAPES[shape](u, exponent), rtol=1e-12, atol=1e-12)


def test_a_harmonic_has_two_coefficients_and_turns_about_its_centre():
    term = Term(
        name="term:x", port="motor_angle", signal="motor_angle", shape="harmonic", coefficient=0.1, sine=-0.2, scale=0.5,
        centre=3.0, low=-10.0, high=10.0,
    )  # fmt: skip
    x = np.linspace(-9.0, 9.0, 50)
    u = (x - 3.0) / 0.5
    np.testing.assert_allclose(over(term, x), 0.1 * np.cos(u) - 0.2 * np.sin(u), rtol=1e-12)


def test_memories_lag_slip_and_respond():
    base = {"name": "term:x", "port": "stiffness", "signal": "brake_torque", "shape": "odd_power", "coefficient": 0.5}
    x = np.where(np.arange(2000) < 10, 0.0, 1.0)
    passed = DT * np.arange(2000 - 10)
    lag = over(Term(**base, memory="lag", memory_scale=2.0, low=0.0, high=1.0), x)[10:]
    np.testing.assert_allclose(lag, 0.5 * (1.0 - np.exp(-(passed + DT) / 2.0)), rtol=1e-9)
    deficit = over(Term(**base, memory="deficit", memory_scale=2.0, low=0.0, high=1.0), x)[10:]
    np.testing.assert_allclose(deficit, lag - 0.5, rtol=1e-9)
    # A rise at once, as long as it is one; what is past is forgotten like any lag.
    there_and_back = np.where(np.arange(2000) < 1000, x, 0.0)
    peak = over(Term(**base, memory="peak", memory_scale=2.0, low=0.0, high=1.0), there_and_back)
    np.testing.assert_array_equal(peak[:1000], 0.5 * x[:1000])
    np.testing.assert_allclose(peak[1000:], 0.5 * np.exp(-DT * np.arange(1, 1001) / 2.0), rtol=1e-9)
    # Heat follows the square of what makes it, whichever way that turns.
    there_and_back = np.where(np.arange(2000) % 2, 1.0, -1.0)
    shape = base | {"shape": "even_power", "exponent": 2.0, "scale": 2.0, "low": -1.0, "high": 1.0, "memory_scale": 2.0}
    np.testing.assert_allclose(over(Term(**shape, memory="response"), there_and_back), 0.5 * 0.25, rtol=1e-9)
    response = over(Term(**shape, memory="response"), x)[10:]
    np.testing.assert_allclose(response, 0.25 * lag, rtol=1e-9)
    # Signals that stay at their edge for ever would make more of it than a friction may lose or gain.
    hot = Term(**base | {"port": "gear_friction", "coefficient": 12.0}, memory="response", memory_scale=2.0, low=0.0, high=1.0)
    np.testing.assert_allclose(over(hot, x)[10:], np.minimum(24.0 * lag, 3.0), rtol=1e-9)
    np.testing.assert_allclose(
        over(msgspec.structs.replace(hot, coefficient=-12.0), x)[10:], np.maximum(-24.0 * lag, -0.9), rtol=1e-9
    )
    there_and_back = np.concatenate([np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.0, 101)])
    slip = over(Term(**base, memory="slip", memory_scale=0.2, low=0.0, high=1.0), there_and_back)
    assert slip[100] == pytest.approx(0.5) and slip[-1] == pytest.approx(-0.5) and slip[121] == pytest.approx(0.0, abs=1e-9)


def test_pads_brake_a_disc_until_it_stands():
    """Below half a radian per second there is no power to divide by a speed, but the torque is there as before."""
    state, sample, seen = new_state(), np.zeros(1, SAMPLE), []
    sample["has_wheel_speed"], sample["dt"] = True, DT
    for power, speed in ((0.0, 0.3), (900.0, 1.0), (0.0, 0.3), (0.0, 0.1), (0.0, 0.0), (0.0, 0.3)):
        state[0]["power"], sample["wheel_speed"] = power, speed
        signal = state[0]["effects"]["terms"]["signal"]
        terms._follow(signal, state[0], sample[0])
        seen.append(float(signal[list(terms.SIGNALS).index("brake_torque")]))
    assert seen == [0.0, 900.0, 900.0, 900.0, 0.0, 0.0]


def test_gates():
    base = {
        "name": "term:x",
        "port": "torque",
        "signal": "motor_angle",
        "shape": "constant",
        "coefficient": 0.5,
        "low": -1.0,
        "high": 1.0,
    }
    speed, wheel, force = np.array([1.0, -1.0, 0.0]), np.array([0.0, 3.0, 3.0]), np.array([0.0, 10000.0, 20000.0])
    signals = {"motor_speed": speed, "disc_speed": wheel, "clamp_force": force}
    expected = {
        "always": [1, 1, 1], "closing": [1, 0, 0], "opening": [0, 1, 0], "turning": [0, 1, 1], "standing": [1, 0, 0],
        "load": [0, 0.5, 1],
    }  # fmt: skip
    assert set(expected) == set(terms.GATES)
    for gate, acts in expected.items():
        np.testing.assert_allclose(over(Term(**base, gate=gate), np.zeros(3), **signals), 0.5 * np.array(acts))


@pytest.mark.parametrize(("other", "full", "half"), [("motor_speed", 40.0, -20.0), ("disc_temperature", 220.0, 120.0)])
def test_a_second_signal_multiplies_by_its_size(other, full, half):
    """Whichever way it points, a temperature from 20 degC on, and a quarter more beyond where it was found."""
    base = {"name": "term:x", "port": "torque", "signal": "brake_torque", "shape": "odd_power", "coefficient": 0.5}
    term = Term(**base, low=0.0, high=1.0, other=other, other_high=full)
    sizes = np.array([half, full, 1.5 * full, term.other_from, np.nan])
    np.testing.assert_allclose(over(term, np.ones(5), **{other: sizes}), [0.25, 0.5, 0.625, 0.0, 0.0])
    # What follows slowly follows the product: after the brake is hot it needs no heat to go on.
    slow = Term(
        **base | {"shape": "even_power"}, memory="response", memory_scale=2.0, low=0.0, high=1.0, other=other, other_high=full
    )
    there = np.where(np.arange(1000) < 500, full, term.other_from)
    found = over(slow, np.ones(1000), **{other: there})
    lag = lambda x: 1.0 - np.exp(-x / 2.0)  # noqa: E731
    assert found[0] == 0.5 and found[999] == pytest.approx(0.5 * (1.0 - lag(500 * DT)), rel=1e-6)


def test_beyond_its_range_a_term_is_no_more_than_its_port_may_bear():
    term = Term(name="term:x", port="stiffness", signal="brake_torque", shape="odd_power", coefficient=-0.8, low=0.0, high=1.0)
    np.testing.assert_allclose(over(term, np.array([1.0, 1.1, 1.25, 9.0])), [-0.8, -0.88, -0.9, -0.9])
    other = {"other": "disc_speed", "other_high": 10.0, "port": "gear_gain", "coefficient": 0.1}
    found = over(msgspec.structs.replace(term, **other), np.full(3, 0.5), disc_speed=np.array([5.0, 11.0, 99.0]))
    np.testing.assert_allclose(found, 0.05 * np.array([0.5, 1.1, 1.25]))


def test_a_signal_that_is_not_known_adds_nothing():
    term = Term(name="term:x", port="force", signal="pad_temperature", shape="constant", coefficient=7.0, low=0.0, high=1.0)
    assert over(term, np.array([np.nan])) == 0.0


def test_sigma_grows_outside_of_the_range(calibration):
    """What nobody has measured is doubted by its size for each width of the range beyond."""
    term = Term(
        name="term:x",
        port="stiffness",
        signal="clamp_force",
        shape="odd_power",
        coefficient=0.05,
        scale=2000.0,
        low=0.0,
        high=2000.0,
    )
    inside = msgspec.structs.replace(term, high=20000.0, scale=20000.0)

    def sigma_of(*terms):
        found = estimate(drive(), to_parameters(msgspec.structs.replace(calibration, terms=terms)))
        return found["stiffness_sigma"].max(), found["stiffness_force"].max()

    (none, _), (within, force), (beyond, _) = sigma_of(), sigma_of(inside), sigma_of(term)
    assert within < 1.1 * none and beyond > 3.0 * none
    # A temperature that is a tenth of a kelvin below all that was recorded tells as much as that, however unsure its
    # coefficient, whose error the curve beside it takes back.
    edge = msgspec.structs.replace(inside, high=0.999 * force, sigma=0.1)
    assert sigma_of(edge)[0] < 1.1 * none


@pytest.mark.parametrize(("lasts_s", "is_doubted"), [(0.5, False), (10.0, True)])
def test_sigma_grows_where_a_term_remembers_more_than_where_it_was_found(calibration, lasts_s, is_doubted):
    """A disc that turns fast for long, as on a motorway, after a campaign of stops from the same speed: no signal leaves its
    range, but what warms by it does."""
    term = Term(
        name="term:x", port="stiffness", memory="response", coefficient=0.3, memory_scale=10.0, memory_high=0.1,
        memory_low=0.0, **_OVER_SPEED,
    )  # fmt: skip
    samples = drive()
    samples["has_wheel_speed"] = True
    samples["wheel_speed"] = np.where(np.cumsum(samples["dt"]) < 0.1, 0.0, 40.0)
    samples["wheel_speed"][np.cumsum(samples["dt"]) > lasts_s] = 0.0
    sigmas, forces = {}, {}
    for name, own in {"known": term, "unknown": msgspec.structs.replace(term, memory_low=None, memory_high=None)}.items():
        found = estimate(samples, held(to_parameters(msgspec.structs.replace(calibration, terms=(own,)))))
        sigmas[name], forces[name] = found["stiffness_sigma"], found["stiffness_force"]
    # A response goes on, as heat does.
    np.testing.assert_array_equal(forces["known"], forces["unknown"])
    assert (sigmas["known"].max() > 2.0 * sigmas["unknown"].max()) == is_doubted


def test_what_a_term_remembers_is_held_beyond_the_range_in_which_it_was_found():
    """A quarter of its width further on; unlike a response, it is what the shape was seen at."""
    term = Term(
        name="term:x", port="stiffness", signal="disc_speed", memory="lag", memory_scale=1.0, shape="odd_power", scale=40.0,
        coefficient=0.4, low=0.0, high=40.0, memory_low=0.0, memory_high=8.0,
    )  # fmt: skip
    speed = np.where(np.arange(2500) < 5, 0.0, 40.0)
    found = over(term, speed)
    np.testing.assert_allclose(
        found, 0.4 * np.minimum(over(msgspec.structs.replace(term, **_UNKNOWN), speed) / 0.4, 10.0 / 40.0)
    )
    assert found[-1] == pytest.approx(0.1) and found[20] < 0.04


def test_a_term_at_the_limits_of_its_port_is_doubted_by_what_they_take(calibration):
    """Either they are wrong or the term is."""
    samples = drive()
    samples["has_wheel_speed"], samples["wheel_speed"] = True, 40.0
    product = Term(name="term:x", port="gear_gain", coefficient=0.9, other="disc_speed", other_high=40.0, **_OVER_SPEED)
    found = {}
    for size in (0.9, 1.2):
        own = msgspec.structs.replace(product, coefficient=size)
        found[size] = estimate(samples, held(to_parameters(msgspec.structs.replace(calibration, terms=(own,)))))
    force = found[0.9]["stiffness_force"]
    told = np.isfinite(found[0.9]["torque_sigma"]) & (force > 3e3)
    np.testing.assert_array_equal(found[0.9]["torque_force"][told], found[1.2]["torque_force"][told])
    taken = np.hypot(found[0.9]["torque_sigma"], 0.3 / 1.9 * force)[told]
    np.testing.assert_allclose(found[1.2]["torque_sigma"][told], taken, rtol=0.15)


_UNKNOWN = {"memory_low": None, "memory_high": None}
_OVER_SPEED = {"signal": "disc_speed", "shape": "odd_power", "scale": 40.0, "low": 0.0, "high": 40.0}
_WHILE_TURNING = {"signal": "clamp_force", "shape": "constant", "gate": "turning", "low": 0.0, "high": 2e4}


@pytest.mark.parametrize("form", [_OVER_SPEED, _WHILE_TURNING])
@pytest.mark.parametrize(
    ("heard", "wheel_speed"), [("pulses", None), ("pulses", 0.0), ("vehicle", None), ("vehicle", 0.0), (None, None)]
)
def test_a_term_over_a_disc_speed_that_is_lost_or_contradicted_is_told_by_others_or_doubted(
    calibration, heard, wheel_speed, form
):
    """Pulses or the vehicle's speed tell the disc's to some hundredths; without any the term may be all that it can be."""
    term = Term(name="term:x", port="stiffness", coefficient=0.3, **form)
    p = held(to_parameters(msgspec.structs.replace(calibration, terms=(term,))))
    samples = drive()
    samples["has_wheel_speed"], samples["wheel_speed"] = True, 30.0
    healthy = estimate(samples, p)
    samples["has_wheel_speed"], samples["wheel_speed"] = wheel_speed is not None, wheel_speed or 0.0
    if heard == "pulses":
        samples["has_wheel_pulse"] = True
        samples["wheel_pulse"] = np.floor(np.cumsum(samples["dt"]) * 30.0 * 96 / (2.0 * np.pi)) % 4096
    elif heard == "vehicle":
        samples["has_status"], samples["vehicle_speed"] = True, 30.0 * 0.34  # of larger wheels
    found = estimate(samples, p)
    clamped = (np.cumsum(samples["dt"]) > 2.0) & (healthy["force"] > 3000.0)
    off = (found["stiffness_force"] - healthy["stiffness_force"])[clamped]
    assert np.all(np.abs(off) < 2.0 * found["stiffness_sigma"][clamped])
    if heard:
        assert np.all(np.abs(off) < 0.03 * healthy["force"][clamped])
        assert np.all(found["stiffness_sigma"][clamped] < 0.05 * healthy["force"][clamped])


@pytest.mark.parametrize(
    ("port", "coefficient"),
    [("torque", 0.05), ("gear_gain", 0.2), ("gear_friction", 0.8), ("torque_constant", 0.2), ("current", 2.0)],
)
def test_torque_is_doubted_where_a_term_of_it_is_outside_of_its_range(calibration, port, coefficient):
    """And teaches the stiffness path as much less."""
    term = Term(name="term:x", port=port, signal="clamp_force", shape="constant", coefficient=coefficient, low=0.0, high=2e4)
    runs = [
        estimate(drive(), to_parameters(msgspec.structs.replace(calibration, terms=own)))
        for own in ((), (term,), (msgspec.structs.replace(term, high=1000.0),))
    ]
    none, inside, outside = (np.nanmedian(run["torque_sigma"][run["stiffness_force"] > 3000.0]) for run in runs)
    assert inside < 1.2 * none and outside > 1.5 * inside
    assert runs[2]["innovation_sigma"][-1] > runs[1]["innovation_sigma"][-1]


@pytest.mark.parametrize("memory", ["none", "lag", "deficit"])
@pytest.mark.parametrize(("port", "path"), [("gear_gain", "torque_sigma"), ("stiffness", "stiffness_sigma")])
def test_a_term_over_a_temperature_is_as_unsure_as_that_is(calibration, port, path, memory):
    """Plates 40 K warmer than the caliper when the power comes are those of a disc that may be hotter than them by four times
    as much, and than any that was recorded. What only remembers changes of temperature does not care."""
    range_K, apart_K, remembers = 100.0, 40.0, memory == "deficit"
    term = Term(
        name="term:x", port=port, signal="disc_temperature", shape="odd_power", coefficient=0.2, scale=range_K, memory=memory,
        centre=0.0 if remembers else 20.0, memory_scale=5.0, low=20.0, high=20.0 + range_K,
    )  # fmt: skip

    def relative(plates_C, *terms):
        samples = drive()
        samples["has_wheel_speed"], samples["has_thermocouple"], samples["caliper"] = True, True, 20.0
        samples["inner_backplate"] = samples["outer_backplate"] = plates_C
        found = estimate(samples, to_parameters(msgspec.structs.replace(calibration, terms=terms)))
        clamped = found["force"] > 3000.0
        return float(np.nanmedian(found[path][clamped] / found["force"][clamped]))

    cold, warm = ((relative(plates), relative(plates, term)) for plates in (20.0, 20.0 + apart_K))
    assert cold[1] < 1.1 * cold[0]
    added = np.sqrt(max(warm[1] ** 2 - warm[0] ** 2, 0.0))
    # Of a disc that is hotter by a standard deviation, less what thermocouples may differ by, the term is larger by so much.
    # The other path tells a part of it.
    larger = 0.2 * 4.0 * (apart_K - 3.0) / range_K
    assert added < 0.01 if remembers else 0.5 * larger < added < larger


# -- what a calibration may say ---------------------------------------------------------------------------------------

_GOOD = {
    "name": "term:x", "port": "stiffness", "signal": "brake_torque", "shape": "odd_power", "coefficient": 0.1, "low": 0.0,
    "high": 9.0, "scale": 9.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"port": "gearbox"}, "Invalid enum value 'gearbox'"),
        ({"signal": "clamp_force_ref"}, "Invalid enum value 'clamp_force_ref'"),
        ({"name": "x"}, "matching regex"),
        ({"low": 9.0}, "expected more than low"),
        ({"coefficient": 1.5}, "0.9 at most"),
        ({"coefficient": 0.5, "scale": 1.0}, "reaches 4.5"),
        ({"sine": 0.1}, "only a harmonic"),
        ({"scale": 0.0}, "> 0.0"),
        ({"shape": "exec"}, "Invalid enum value"),
        ({"other": "disc_temperature", "other_high": 20.0}, "other_high: expected more than 20"),
        ({"memory_low": 0.0, "memory_high": 1.0}, "memory_low: only a memory of lag, deficit, response, peak"),
        ({"memory": "lag", "memory_low": 1.0, "memory_high": 1.0}, "memory_high: expected more than memory_low"),
        ({"memory": "lag", "memory_low": 0.0}, "memory_high: expected more than memory_low"),
        ({"memory": "lag", "memory_high": 1.0}, "memory_high: expected more than memory_low"),
    ],
)
def test_a_calibration_with_a_bad_term_is_refused(calibration, tmp_path, changed, said):
    text = dump_calibration(calibration)
    good = msgspec.structs.replace(calibration, terms=(Term(**_GOOD),))
    path = tmp_path / "c.yaml"
    path.write_text(dump_calibration(good))
    assert load_yaml(path, Calibration) == good
    broken = "".join(f"\n  {key}: {value}" for key, value in ({**_GOOD, **changed}).items()).replace("\n  ", "\n- ", 1)
    path.write_text(f"{text}\nterms:{broken}\n")
    with pytest.raises(InputErrors, match="terms") as raised:
        load_yaml(path, Calibration)
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("port", "coefficient", "said"),
    [
        ("gear_friction", 2.9, None),
        ("gear_friction", 3.1, "reaches 3.1 1, expected 3 at most"),
        ("gear_friction", -0.95, "reaches -0.95 1, expected -0.9 at least"),
        ("gear_gain", 1.9, "expected 0.9 at most"),
    ],
)
def test_friction_may_grow_by_more_than_it_may_fall(port, coefficient, said):
    """No friction is negative, but of four times as much a machine does not become another one."""
    with pytest.raises(InvalidValue, match=said) if said else contextlib.nullcontext():
        constant(port, coefficient)


def test_a_term_may_be_as_large_as_the_catalogue_s_effects_at_its_port():
    """Or a cause that is just as physical would only be found at another port."""
    for effect in REGISTRY:
        for amplitude in effect.amplitudes if effect.hook == "gear_friction" else ():
            constant(effect.hook, amplitude.high)


@pytest.mark.parametrize(("port", "least", "most"), [("gear_friction", -0.9, 3.0), ("gear_gain", -0.9, 0.9)])
def test_a_product_is_held_at_what_its_port_may_bear(port, least, most):
    """Two signals are hardly at their largest at once: where they would be, it may be more than a machine has."""
    of = {"port": port, "signal": "clamp_force", "other": "motor_speed", "other_high": 100.0, "low": 0.0, "high": 1e4}
    signals = np.zeros((2, len(terms.SIGNALS)))
    signals[:, list(terms.SIGNALS).index("clamp_force")] = 1e4
    signals[:, list(terms.SIGNALS).index("motor_speed")] = 10.0, 100.0
    for coefficient, most_added in ((3.4, most), (-3.4, least)):
        term = Term(name="term:x", shape="odd_power", scale=1e4, coefficient=coefficient, **of)
        record = np.zeros(1, terms.PARAMETERS)[0]
        fill_terms(record, (term,))
        added = terms.evaluate(record["term"][0], signals, np.full(2, DT), 3e4)
        np.testing.assert_allclose(added, [0.1 * coefficient, most_added])


@given(
    shape=st.sampled_from(terms.SHAPES),
    coefficient=st.floats(-1e3, 1e3),
    centre=st.floats(-3.0, 3.0),
    scale=st.floats(0.1, 10.0),
    exponent=st.floats(0.1, 4.0),
)
def test_a_term_adds_no_more_than_its_reach_within_its_range(shape, coefficient, centre, scale, exponent):
    """What is held against the limits of its port is what the kernel does, at most, and reached for a power."""
    sine = 0.5 * coefficient if shape == "harmonic" else 0.0
    term = Term(
        name="term:x", port="force", signal="motor_speed", shape=shape, coefficient=coefficient, sine=sine, centre=centre,
        scale=scale, exponent=exponent, low=-2.0, high=5.0,
    )  # fmt: skip
    record = np.zeros(1, terms.PARAMETERS)[0]
    fill_terms(record, (term,))
    signals = np.zeros((101, len(terms.SIGNALS)))
    signals[:, list(terms.SIGNALS).index("motor_speed")] = np.linspace(-2.0, 5.0, 101)
    added = terms.evaluate(record["term"][0], signals, np.full(101, DT), 3e4)
    least, most = term.reach
    slack = 1e-9 * abs(coefficient)
    assert least - slack <= added.min() and added.max() <= most + slack
    if shape in ("odd_power", "onset"):
        assert min(added.min(), 0.0) == pytest.approx(least, abs=slack) and max(added.max(), 0.0) == pytest.approx(
            most, abs=slack
        )


def test_terms_are_few_and_have_names_of_their_own(calibration):
    term = Term(**_GOOD)
    many = tuple(msgspec.structs.replace(term, name=f"term:{n}") for n in range(terms.MOST + 1))
    for own, said in (((term, term), "occurs twice"), (many, f"expected {terms.MOST} at most")):
        fields = {name: getattr(calibration, name) for name in calibration.__struct_fields__} | {"terms": own}
        with pytest.raises(InvalidValue, match=said):
            Calibration(**fields)


_REPLAYED = """
import runpy, sys
import numpy as np
from emb_daemon.effects.own import extend
samples, *files = sys.argv[1:]
for found in files[::2]:
    extend(runpy.run_path(found)["EFFECT"])
from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.offline.run import held, run_step
for own in files[1::2]:
    trace = run_step(np.load(samples), held(to_parameters(load_calibration(own))))
    np.save(own + ".npy", np.stack([trace[name] for name in ("force", "torque", "leverage")]))
"""

_EXPORTED = (
    Term(name="term:x1", port="gear_friction", signal="motor_angle", shape="harmonic", gate="load", coefficient=0.1,
         sine=0.05, scale=3.0, centre=1.0, low=-5.0, high=30.0),
    Term(name="term:x2", port="stiffness", signal="clamp_force", memory="slip", shape="odd_power", coefficient=0.03,
         memory_scale=900.0, low=0.0, high=2e4),
    Term(name="term:x3", port="force", signal="clamp_force", memory="deficit", shape="odd_power", coefficient=500.0,
         scale=1e4, memory_scale=0.4, low=0.0, high=2e4, memory_low=-500.0, memory_high=800.0),
    Term(name="term:x4", port="gear_friction", signal="motor_speed", memory="response", shape="even_power",
         coefficient=0.1, scale=50.0, exponent=1.5, memory_scale=0.4, low=-200.0, high=200.0,
         other="clamp_force", other_high=8e3),
    Term(name="term:x6", port="stiffness", signal="clamp_force", memory="peak", shape="odd_power", coefficient=0.05,
         scale=2e4, exponent=1.5, memory_scale=0.4, low=0.0, high=2e4),
    Term(name="term:x5", port="gear_friction", signal="clamp_force", shape="odd_power", coefficient=0.1, scale=2e4, low=0.0,
         high=2e4, other="motor_speed", other_high=5.0),
)  # fmt: skip


@pytest.mark.trial
def test_an_exported_effect_is_the_term(calibration, tmp_path):
    """By the command, in the form of a file of one's own: the estimator with it gives what it gives with the term."""
    plain, files, termed = msgspec.structs.replace(calibration, provenance=None), [], []
    for term in _EXPORTED:
        shipped, found, own = (tmp_path / f"{term.name[5:]}{ending}" for ending in (".yaml", ".py", "_own.yaml"))
        termed.append(msgspec.structs.replace(plain, terms=(term,)))
        shipped.write_text(dump_calibration(termed[-1]))
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            assert main(["effect", "export", str(shipped), term.name, "--output", str(found)]) == 0
        own.write_text(dump_calibration(plain).replace("effects: {}\n", "") + out.getvalue().partition("\n")[2])
        files += [found, own]
    np.save(tmp_path / "samples.npy", _fast_drive())
    # As plain Python: compiling the estimator anew for a few effects more would take longer than everything else here.
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", _REPLAYED, tmp_path / "samples.npy", *files]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    without, *expected = (_trace(one) for one in (plain, *termed))
    for term, own, rows in zip(_EXPORTED, files[1::2], expected, strict=True):
        found = np.load(f"{own}.npy")
        assert any(np.nanmax(np.abs(apart)) > 1e-9 for apart in found - without), term
        np.testing.assert_allclose(found, rows, rtol=1e-9, atol=1e-9, err_msg=term.name)


def _fast_drive():
    """Half as long and twice as fast, because plain Python takes milliseconds for each sample."""
    samples = drive(0.75)
    samples["angle"] *= 2.0
    samples["speed"] *= 2.0
    return samples


def _trace(calibration):
    trace = run_step(_fast_drive(), held(to_parameters(calibration)))
    return np.stack([trace[name] for name in ("force", "torque", "leverage")])


def test_what_a_calibration_says_of_a_term_is_text_in_its_effect_file(calibration, tmp_path):
    """A calibration is data, whoever wrote it: what it says of a term's origin must not become code."""
    said = 'in a"b.log\\", signal=print("executed"),\n#'
    term = msgspec.structs.replace(constant("torque", 0.01), name='term:x", hook="no', provenance=said)
    text = export.source(term, calibration.stiffness.maximum_force_N, "")
    (tmp_path / "found.py").write_text(text)
    effect = runpy.run_path(str(tmp_path / "found.py"))["EFFECT"]
    assert effect.source == f"found by diagnose, {said}" and effect.name == 'x", hook="no'
    assert effect.hook == "torque"


def test_a_term_that_is_not_there_is_told_by_those_that_are(calibration, tmp_path, capsys):
    file = tmp_path / "term.yaml"
    file.write_text(dump_calibration(msgspec.structs.replace(calibration, terms=(constant("torque", 0.01),))))
    assert main(["effect", "export", str(file), "term:y", "--output", str(tmp_path / "found.py")]) == 2
    assert "term:x" in capsys.readouterr().err and not (tmp_path / "found.py").exists()
