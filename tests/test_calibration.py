"""Calibration and configuration files: every fault found at once, with its line; what is saved is what is loaded."""

import os
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_daemon.adapt.records import to_limits
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import (
    calibration_hash,
    dump_calibration,
    load_calibration,
    save_calibration,
    shipped_calibration,
)
from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import (
    Calibration,
    Curve,
    Provenance,
    Source,
    Stiffness,
    Struct,
    curve_at,
    rising_force,
    thickness_range,
    to_parameters,
)
from emb_daemon.errors import InputError, InputErrors, InvalidValue
from emb_daemon.resources import resource

_TEXT = resource("config/calibration.yaml").read_text()
_CALIBRATION = shipped_calibration()


def _line(text: str, key: str) -> int:
    return next(number for number, line in enumerate(text.splitlines(), 1) if re.match(rf"[ -]*{key}:", line))


def _replaced(key: str, value: str) -> str:
    """The shipped calibration with the first ``key: ...`` line's value replaced."""
    return re.sub(rf"(?m)^([ -]*{key}:).*$", rf"\g<1> {value}", _TEXT, count=1)


def _faults(tmp_path, text: str) -> list[str]:
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(InputErrors) as caught:
        load_calibration(path)
    for fault in caught.value.faults:
        assert fault.startswith(str(path)) and "\n" not in fault
    return [fault.removeprefix(str(path)) for fault in caught.value.faults]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("hello", "Expected `float`, got `str`"),
        ("'0.05'", "Expected `float`, got `str`"),
        ("[1.0]", "Expected `float`, got `array`"),
        ("true", "Expected `float`, got `bool`"),
        ("on", "got `str`"),
        ("null", "got `null`"),
        ("", "got `null`"),
        (".nan", "not a finite number"),
        ("nan", "not a finite number"),
        (".inf", "not a finite number"),
        ("-.inf", "not a finite number"),
        ("1e999", "finite"),
        ("010", "leading zeros"),
        ("-1.0", "> 0"),
        ("0.0", "> 0"),
        ("0x10", "got `str`"),
        ("1_000", "got `str`"),
        ("1:30", "got `str`"),
    ],
)
def test_a_wrong_number_is_named_with_its_line(tmp_path, value, expected):
    text = _replaced("torque_constant_Nm_per_A", value)
    (fault,) = _faults(tmp_path, text)
    assert fault.startswith(f":{_line(text, 'torque_constant_Nm_per_A')}: motor.torque_constant_Nm_per_A: ")
    assert expected in fault


@pytest.mark.parametrize("value", ["5e-2", "5.0e-2", ".05", "+0.05", "1", "5E-2"])
def test_numbers_of_all_spellings(tmp_path, value):
    path = tmp_path / "calibration.yaml"
    path.write_text(_replaced("torque_constant_Nm_per_A", value))
    assert load_calibration(path).motor.torque_constant_Nm_per_A == float(value)


def test_unknown_key_with_a_suggestion(tmp_path):
    text = _TEXT.replace("  inertia_kg_m2:", "  inertia_kgm2:")
    unknown, missing = _faults(tmp_path, text)
    assert unknown == f":{_line(text, 'inertia_kgm2')}: motor.inertia_kgm2: unknown key; did you mean inertia_kg_m2?"
    assert missing.endswith("motor.inertia_kg_m2: missing")


def test_duplicate_key(tmp_path):
    text = _TEXT.replace("friction:\n  load", "friction:\n  load_m_per_rad: 1.0e-06\n  load", 1)
    (fault,) = _faults(tmp_path, text)
    assert fault == f":{_line(text, 'friction') + 2}: friction.load_m_per_rad: occurs twice"


@pytest.mark.parametrize("section", ["motor", "noise", "thermal", "contact"])
def test_missing_section(tmp_path, section):
    _, fault = _faults(tmp_path, re.sub(rf"(?m)^{section}:", "something_else:", _TEXT))
    assert fault.endswith(f"{section}: missing")


_HYSTERESIS = "effects.stiffness_hysteresis"


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        ("{warp_drive: {share: 1.0}}", "effects.warp_drive: unknown effect; known are"),
        ("{stiffness_hysteresis: {share: 0.9, slip_angle_rad: 1.0}}", f"{_HYSTERESIS}.share: 0.9 outside [0.0, 0.5]"),
        ("{stiffness_hysteresis: {share: 0.1, slip: 1.0, slip_angle_rad: 1.0}}", f"{_HYSTERESIS}.slip: unknown parameter"),
        ("{stiffness_hysteresis: {share: 0.1}}", f"{_HYSTERESIS}: missing slip_angle_rad"),
        ("{stiffness_hysteresis: {share: wide, slip_angle_rad: 1.0}}", f"{_HYSTERESIS}.share: Expected `float`, got `str`"),
        ("{stiffness_hysteresis: 3.0}", "expected keys and values"),
        ("[1.0]", "expected keys and values"),
    ],
)
def test_effects(tmp_path, effects, expected):
    head = _TEXT[: _TEXT.index("\neffects:")] if "\neffects:" in _TEXT else _TEXT[: _TEXT.find("\nprovenance:")]
    text = f"{head}\neffects: {effects}\n"
    (fault,) = _faults(tmp_path, text)
    assert expected in fault and fault.startswith(f":{len(text.splitlines())}:")


def test_every_fault_at_once(tmp_path):
    text = _replaced("inertia_kg_m2", "-1").replace("offset_Nm:", "ofset_Nm:", 1)
    text = re.sub(r"(?m)^(  clearance_rad:).*", r"\1 wide", text)
    text = re.sub(r"(?m)^(  density|    density_kg_per_m3:).*", r"    density_kg_per_m3: .inf", text, count=1)
    faults = _faults(tmp_path, text)
    for key in (
        "motor.inertia_kg_m2",
        "friction.ofset_Nm",
        "friction.offset_Nm: missing",
        "contact.clearance_rad",
        "density_kg_per_m3",
    ):
        assert sum(key in fault for fault in faults) == 1, (key, faults)
    assert len(faults) == 5
    lines = [int(fault.split(":")[1]) for fault in faults if "missing" not in fault]
    assert lines == sorted(lines)


def test_several_faults_of_effects_each_with_its_line(tmp_path):
    head = _TEXT[: _TEXT.index("\neffects:")] if "\neffects:" in _TEXT else _TEXT[: _TEXT.find("\nprovenance:")]
    text = f"{head}\neffects:\n  warp: {{a: 1.0}}\n  signal_delay:\n    delay_s: 9.0\n"
    first, second = _faults(tmp_path, text)
    last = len(text.splitlines())
    assert first.startswith(f":{last - 2}: effects.warp") and second.startswith(
        f":{last}: effects.signal_delay.delay_s: 9.0 outside"
    )


@pytest.mark.parametrize(
    ("pattern", "value", "expected"),
    [
        (r"(?m)^    force_N:.*$", "    force_N: [0.0, 1.0]", "length >= 6"),
        (r"(?m)^    force_N:.*$", "    force_N: [0.0, 1.0, 2.0, 3.0, 3.0, 5.0]", "force_N: expected ascending values"),
        (
            r"(?ms)^    coefficient:\n.*?^  softening",
            "    coefficient: [[[0.4]]]\n  softening",
            "coefficient: expected 6 x 6 x 8",
        ),
        (r"(?m)^    coefficients:.*$", "    coefficients: [-300.0]", "must be positive"),
        (r"(?m)^  - pad_thickness_mm:.*$", "  - pad_thickness_mm: 99.0", "ascending"),
        (r"(?m)^format:.*$", "format: 2", "<= 1"),
        (r"(?m)^actuator:.*$", "actuator: ''", "length >= 1"),
        (r"(?m)^actuator:.*$", "actuator: 5", "Expected `str`"),
        (r"(?m)^    inner_heat_share:.*$", "    inner_heat_share: 0.99", "sum exceeds 1"),
        (r"(?m)^  maximum_force_N:.*$", "  maximum_force_N: 8000.0\nadaptation:\n  high_force_N: 18000.0",
         "adaptation.high_force_N: 18000 exceeds stiffness.maximum_force_N (8000)"),
        (r"(?m)^actuator:.*$", "actuator: a\nadaptation: {minimum_ambient_C: 50.0}", "maximum_ambient_C: expected more than"),
        (r"(?m)^pad_thickness_mm:.*$", "pad_thickness_mm: 77.0", "pad_thickness_mm: 77.0 is too far"),
    ],
)  # fmt: skip
def test_shapes_and_relations(tmp_path, pattern, value, expected):
    text, count = re.subn(pattern, value, _TEXT, count=1)
    assert count == 1
    (fault,) = _faults(tmp_path, text)
    assert expected in fault and re.match(r":\d+: ", fault)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "empty"),
        (b"- a\n- b\n", "expected keys"),
        (b"format: [1\nmotor: {", "not YAML"),
        (b"a: 1\n---\nb: 2\n", "not YAML"),
        (b"\xff\xfe\x00", "not a readable text file"),
        (b"a: &x [*x]\n", ":1: anchors and aliases"),
        (b"format: &a 1\nname: *a\n", ":1: anchors and aliases"),
        (b"\t- a", "not YAML"),
        (b"[" * 100_000, ":1: nested more than 50 levels"),
        (b"format: " + b"9" * 5000, ":1: format: a number of 5000 characters"),
        (b"format: 1." + b"9" * 5000, ":1: format: a number of 5002 characters"),
        (b"#" * 4_000_001, "larger than 4000000 bytes"),
    ],
)
def test_files_that_are_not_calibrations_are_refused_with_the_fault(tmp_path, content, expected):
    path = tmp_path / "calibration.yaml"
    path.write_bytes(content)
    with pytest.raises(InputErrors) as caught:
        load_calibration(path)
    assert any(expected in fault for fault in caught.value.faults)


def test_what_is_no_file_is_refused_at_once(tmp_path):
    """A pipe without a writer; a device that never ends."""
    os.mkfifo(tmp_path / "calibration.yaml")
    for path in (tmp_path / "calibration.yaml", Path("/dev/zero")):
        with pytest.raises(InputErrors, match="not a regular file"):
            load_calibration(path)
        with pytest.raises(InputErrors, match="not a regular file"):
            Setup(path)


@given(st.text(max_size=200))
def test_no_text_crashes_the_reader(tmp_path_factory, text):
    with pytest.raises(InputErrors):
        load_yaml(_file(tmp_path_factory, text), Calibration)


def _file(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "example.yaml"
    path.write_bytes(text.encode())
    return path


class _Everything(Struct, kw_only=True):
    text: str
    number: float
    whole: int
    flag: bool
    numbers: tuple[float, ...]
    table: dict[str, dict[str, float]]
    nothing: str | None = None


_words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12)
_number = st.floats(allow_nan=False, allow_infinity=False)


@given(st.builds(_Everything, text=_words, number=_number, whole=st.integers(), flag=st.booleans(),
                 numbers=st.lists(_number, max_size=4).map(tuple),
                 table=st.dictionaries(_words, st.dictionaries(_words, _number, max_size=2), max_size=2)))  # fmt: skip
def test_any_dumped_value_is_read_back_equal(tmp_path_factory, value):
    """Through the calibration's own dumper: any text, also one that looks like a number, any finite number."""
    assert load_yaml(_file(tmp_path_factory, dump_calibration(value)), _Everything) == value


@settings(max_examples=20)
@given(st.floats(1e-6, 10.0), st.floats(1e-9, 1e-3), st.dictionaries(_words, _number, max_size=3))
def test_calibration_round_trip(tmp_path_factory, constant, gain, figures):
    provenance = Provenance(date="2026-01-01", tool="0.1", figures=figures, logs=(Source(log="010", sha256="1e5"),))
    motor = msgspec.structs.replace(_CALIBRATION.motor, torque_constant_Nm_per_A=constant, gear_gain_m_per_rad=gain)
    changed = msgspec.structs.replace(_CALIBRATION, motor=motor, actuator="0815", provenance=provenance)
    path = tmp_path_factory.mktemp("c") / "calibration.yaml"
    save_calibration(changed, path)
    assert load_calibration(path) == changed
    assert yaml.safe_load(path.read_text())["motor"]["torque_constant_Nm_per_A"] == constant, "other readers read it otherwise"


def test_hash_is_of_the_values_not_of_the_file(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text("# another formatting\n" + yaml.safe_dump(yaml.safe_load(_TEXT), default_flow_style=True, width=70))
    same = load_calibration(path)
    assert calibration_hash(same) == calibration_hash(_CALIBRATION)
    assert calibration_hash(msgspec.structs.replace(same, provenance=None)) == calibration_hash(same)
    assert calibration_hash(msgspec.structs.replace(same, pad_thickness_mm=9.0)) != calibration_hash(same)
    assert re.fullmatch(r"[0-9a-f]{12}", calibration_hash(same))


def test_parameters_are_the_calibration(parameters):
    p = to_parameters(_CALIBRATION)
    assert p["torque_constant"] == _CALIBRATION.motor.torque_constant_Nm_per_A
    assert p["thermal"]["thickness"] == pytest.approx(1e-3 * _CALIBRATION.pad_thickness_mm)
    assert p["thermal"]["node_position"][-1] == pytest.approx(p["thermal"]["thickness"])
    for name, values in _CALIBRATION.effects.items():
        assert all(p["effects"][name][key] == value for key, value in values.items())
    assert all(parameters[k].tobytes() == p.tobytes() for k in range(4))


def test_curves_between_measured_thicknesses():
    """Compliance adds up: at a measured thickness the measured curve, between two the mean of their reciprocals."""
    curves = _CALIBRATION.stiffness.curves
    for curve in curves:
        np.testing.assert_allclose(curve_at(curves, curve.pad_thickness_mm)[: len(curve.coefficients)], curve.coefficients)
    low, high = curves[1], curves[2]
    middle = curve_at(curves, 0.5 * (low.pad_thickness_mm + high.pad_thickness_mm))
    expected = 2.0 / (1.0 / low.coefficients[0] + 1.0 / high.coefficients[0])
    assert middle[0] == pytest.approx(expected)
    stiffness = [
        curve_at(curves, thickness)[0]
        for thickness in np.linspace(curves[0].pad_thickness_mm, curves[-1].pad_thickness_mm, 40)
    ]
    assert np.all(np.diff(stiffness) < 0.0), "thicker pads are softer"
    with pytest.raises(InputError, match=r"pad_thickness_mm: 40\.0 is too far from the measured thicknesses"):
        curve_at(curves, 40.0)


def _stiffness(*coefficients: list[float], **changes) -> Stiffness:
    """Curves of pads 4 and 8 mm (and 12 mm) thick."""
    curves = tuple(Curve(pad_thickness_mm=4.0 * k, coefficients=tuple(c)) for k, c in enumerate(coefficients, 1))
    return Stiffness(**{"curves": curves, "relaxation_time_s": 0.03, "maximum_force_N": 30000.0} | changes)


@pytest.mark.parametrize("softer", [[300.0, 12.0], [100.0, 4.0], [60.0, 2.0], [10.0, 0.1]])
def test_an_extrapolated_compliance_never_reaches_zero(softer):
    """Straight on, these reciprocals cross zero: the coefficients would pass through infinity to the other sign."""
    curves = _stiffness([360.0, 15.0], softer).curves
    low, high = thickness_range(curves)
    for thickness in np.linspace(low, high, 201):
        curve = curve_at(curves, thickness)[:2]
        assert np.all(curve > 0.0) and np.all(curve <= 2.0 * np.array([360.0, 15.0]) * (1.0 + 1e-12))


@pytest.mark.parametrize(
    ("coefficients", "force"),
    [
        ([100.0], np.inf),
        ([100.0, 10.0, 1.0], np.inf),
        ([100.0, -1.0], 2500.0),
        ([300.0, 40.0, -128.0], None),
        ([100.0, -20.0, 2.0], np.inf),
        ([-1.0, 20.0], 0.0),
    ],
)
def test_force_up_to_which_a_curve_rises(coefficients, force):
    """Against the same polynomial on a fine grid."""
    coefficients = np.array(coefficients)
    found = rising_force(coefficients)
    if force is not None:
        assert found == pytest.approx(force)
    x = np.linspace(0.0, 100.0, 200_001)
    values = np.polyval([*coefficients[::-1], 0.0], x)
    falls = np.flatnonzero(np.diff(values) < 0.0)
    assert found == np.inf if not len(falls) else found == pytest.approx(values[falls[0]], rel=1e-3, abs=1e-3)


@pytest.mark.parametrize(
    ("coefficients", "expected"),
    [
        (([346.0, 48.0, 0.98], [300.0, -128.0, 0.7]), r"curves: with pads of \S+ mm the force stops rising at \d+ N, below"),
        (([100.0, -1.0],), "with pads of 4 mm the force stops rising at 2500 N"),
        # Both rise for ever; half an interval beyond the thicker, the straight line of the second coefficient is at -18.
        (([300.0, 30.0], [200.0, 0.0]), "with pads of 8"),
    ],
)
def test_a_curve_that_falls_before_the_largest_force_is_refused(coefficients, expected):
    with pytest.raises(InvalidValue, match=expected):
        _stiffness(*coefficients)


@pytest.mark.parametrize(("maximum_N", "training_N"), [(8000.0, 4800.0), (30000.0, 18000.0), (42000.0, 18000.0)])
def test_training_force_is_at_most_the_largest_force(maximum_N, training_N):
    calibration = moved(_CALIBRATION, {"stiffness.maximum_force_N": maximum_N}, checked=True)
    assert to_limits(calibration)["high_force"] == pytest.approx(training_N)


def test_shipped_configuration_is_valid():
    setup = Setup(resource("config/emb.yaml"))
    assert set(setup.calibrations) == {"FL", "FR", "RL", "RR"} and np.all(setup.parameters["gear_gain"] > 0.0)


def test_setup_lists_the_faults_of_all_files(tmp_path):
    (tmp_path / "emb.yaml").write_text(
        "format: 1\ndbc: missing.dbc\ncorners:\n"
        "  FL: {calibration: a.yaml}\n  FR: {calibration: b.yaml}\n  RL: {calibration: c.yaml}\n"
    )
    (tmp_path / "a.yaml").write_text(_replaced("inertia_kg_m2", "x"))
    (tmp_path / "c.yaml").write_text(_replaced("pad_thickness_mm", "77.0"))
    with pytest.raises(InputErrors) as caught:
        Setup(tmp_path / "emb.yaml")
    faults = "\n".join(caught.value.faults)
    for expected in (
        "missing.dbc: no such file",
        "a.yaml:",
        "b.yaml: no such file",
        "c.yaml:3: pad_thickness_mm: 77.0 is too far",
    ):
        assert expected in faults
    assert len(caught.value.faults) == 4
    # A fault of the configuration itself hides none of theirs.
    text = (tmp_path / "emb.yaml").read_text()
    (tmp_path / "emb.yaml").write_text(text + "  RR: c.yaml\nlog_level: loud\n")
    with pytest.raises(InputErrors) as again:
        Setup(tmp_path / "emb.yaml")
    assert set(again.value.faults) > set(caught.value.faults) and len(again.value.faults) == 6


def test_configuration_faults(tmp_path):
    """All at once, unknown corner and interface included, each with its line."""
    path = tmp_path / "emb.yaml"
    path.write_text(
        "format: 1\ncorners: {XX: {calibration: c}, FL: {calibraton: c}}\n"
        "realtime: {fifo_priority: 100, cpu: on}\nlog_level: loud\nbus: {interface: sockcan}\n"
    )
    with pytest.raises(InputErrors) as caught:
        Setup(path)
    expected = (
        ":2: corners.XX: Expected `str` matching regex '^(FL|FR|RL|RR)$'",
        ":2: corners.FL.calibraton: unknown key",
        ":2: corners.FL.calibration: missing",
        ":3: realtime.fifo_priority",
        ":3: realtime.cpu",
        ":4: log_level",
        ":5: bus.interface: unknown to python-can: sockcan; similar are ",
    )
    for text in expected:
        assert sum(text in fault for fault in caught.value.faults) == 1, text
    assert len(caught.value.faults) == len(expected) and "socketcan" in caught.value.faults[-1]


@pytest.mark.parametrize("corners", ["{}", "[FL]", "FL"])
def test_a_configuration_without_corners(tmp_path, corners):
    path = tmp_path / "emb.yaml"
    path.write_text(f"format: 1\ncorners: {corners}\n")
    with pytest.raises(InputErrors, match=r":2: corners: expected at least 1 key"):
        Setup(path)
