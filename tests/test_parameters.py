"""The calibration as parameter space: every number has a key, and moving a key moves that number alone."""

import math
import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.adapt.records import to_limits
from emb_daemon.calibration import parameters
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.parameters import in_words, keys, moved, parameter, value_of
from emb_daemon.calibration.types import AdaptationLimits, Calibration, ForceSensor, to_parameters
from emb_daemon.effects import REGISTRY
from emb_daemon.errors import InputError, InputErrors

#: With every optional section.
_CALIBRATION = msgspec.structs.replace(
    shipped_calibration(),
    force_sensor=ForceSensor(
        limit_N=5e3, noise_N=10.0, offset_N=50.0, offset_walk_N_per_sqrt_s=1.0, offset_N_per_K=1.0, gain_relative=0.01
    ),
)
_KEYS = keys(_CALIBRATION)
_EFFECT_KEYS = [f"effects.{effect.name}.{parameter.name}" for effect in REGISTRY for parameter in effect.parameters]
_OFF = msgspec.structs.replace(_CALIBRATION, effects={})


def _numbers(calibration: Calibration) -> dict[str, float]:
    return {key: value_of(calibration, key) for key in keys(calibration)}


def test_every_number_of_the_file_has_a_key():
    def count(value):
        if isinstance(value, dict | list | tuple):
            return sum(map(count, value.values() if isinstance(value, dict) else value))
        return type(value) is float

    plain = msgspec.to_builtins(msgspec.structs.replace(_CALIBRATION, provenance=None))
    # Defaults are left out of the file, but have keys.
    assert count(plain) <= len(_KEYS) == len(set(_KEYS))
    assert {"motor.inertia_kg_m2", "stiffness.curves[4].coefficients[2]", "thermal.softening.per_K"} <= set(_KEYS)
    assert "thermal.friction.coefficient[5][5][7]" in _KEYS


@given(st.sampled_from(_KEYS), st.floats(allow_nan=False, allow_infinity=False))
def test_moving_a_key_moves_that_number_alone(key, value):
    before = _numbers(_CALIBRATION)
    after = moved(_CALIBRATION, {key: value})
    assert _numbers(after) == {**before, key: value}
    assert _numbers(_CALIBRATION) == before
    assert moved(after, {key: before[key]}) == _CALIBRATION


@given(st.dictionaries(st.sampled_from(_KEYS + _EFFECT_KEYS), st.floats(allow_nan=False, allow_infinity=False)))
def test_keys_move_together_as_they_do_one_by_one(values):
    after = _OFF
    for key, value in values.items():
        after = moved(after, {key: value})
    assert moved(_OFF, values) == after


@given(st.sampled_from(_KEYS + _EFFECT_KEYS))
def test_a_step_has_an_effect_and_stays_in_bounds_on_one_side(key):
    found = parameter(_CALIBRATION, key)
    assert found.value == value_of(_CALIBRATION, key) and found.low <= found.value <= found.high
    assert found.step > 0.0 and math.isfinite(found.step) and found.value + found.step != found.value
    assert found.low <= found.value - found.step or found.value + found.step <= found.high


def test_zero_is_a_start_like_any_other():
    zeros = [key for key in _KEYS if parameter(_CALIBRATION, key).low <= 0.0]
    assert len(zeros) > 300
    assert not [key for key in zeros if not parameter(moved(_CALIBRATION, {key: 0.0}), key).step > 0.0]


@pytest.mark.parametrize("key", _EFFECT_KEYS)
def test_an_effect_that_was_off_is_switched_on_and_still_does_nothing(key):
    start = value_of(_OFF, key)
    _, name, _ = key.split(".")
    on = moved(_OFF, {key: start}, checked=True)
    assert list(on.effects) == [name] and value_of(on, key) == start
    amplitudes = {p.name for effect in REGISTRY if effect.name == name for p in effect.amplitudes}
    assert all(on.effects[name][amplitude] == 0.0 for amplitude in amplitudes)
    assert to_parameters(on)["curve"].tolist() == to_parameters(_OFF)["curve"].tolist()


def test_bounds_and_units():
    constant = parameter(_CALIBRATION, "motor.torque_constant_Nm_per_A")
    assert (constant.unit, constant.relative) == ("N·m/A", True) and 0.0 < constant.low < 1e-300
    assert parameter(_CALIBRATION, "thermal.pad.inner_heat_share").high == 1.0
    relaxation = parameter(_CALIBRATION, "effects.second_relaxation.time_constant_s")
    assert (relaxation.low, relaxation.high, relaxation.unit) == (0.05, 60.0, "s")
    units = {key: parameter(_CALIBRATION, key).unit for key in _KEYS}
    assert units["stiffness.curves[1].coefficients[2]"] == "N/rad^3"
    assert units["contact.walk_rad_per_sqrt_s"] == "rad/√s"
    assert units["thermal.pad.surface_cooling_per_speed_J_per_rad_m2K"] == "J/(rad·m²·K)"
    assert units["thermal.friction.force_N[3]"] == "N"
    dimensionless = {key.rpartition(".")[2].partition("[")[0] for key, unit in units.items() if unit == "1"}
    assert dimensionless == {
        "presliding", "stiffness_relative", "torque_relative", "torque_lasting", "inner_heat_share", "outer_heat_share",
        "coefficient", "share", "coverage", "residual_ratio", "curve_change", "friction_change", "maximum_friction_share",
        "pairs_difference", "torque_constant_relative", "gain_relative",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("key", "near"),
    [
        ("motor.torque_constant_Nm_per_Amp", "motor.torque_constant_Nm_per_A"),
        ("contact.clearence_rad", "contact.clearance_rad"),
        ("effects.second_relaxation.shape", "effects.second_relaxation.share"),
        ("effects.second_relax.share", "effects.second_relaxation.share"),
        ("stiffness.curves[5].coefficients[0]", "stiffness.curves[4].coefficients[0]"),
        ("stiffness.curves.coefficients[0]", "stiffness.curves[4].coefficients[0]"),
    ],
)
@pytest.mark.parametrize("use", [value_of, parameter, lambda calibration, key: moved(calibration, {key: 1.0})])
def test_an_unknown_key_names_near_ones(use, key, near):
    with pytest.raises(InputError, match="not a number of the calibration") as caught:
        use(_CALIBRATION, key)
    assert str(caught.value).startswith(f"{key}: ") and near in str(caught.value)


@given(st.text(max_size=40))
def test_no_text_crashes(key):
    if key not in _KEYS:
        with pytest.raises(InputError):
            value_of(_CALIBRATION, key)


@pytest.mark.parametrize("key", ["", "motor", "format", "actuator", "adaptation.enabled", "provenance.figures", "effects"])
@pytest.mark.parametrize(
    "use", [value_of, lambda calibration, key: moved(calibration, {"contact.clearance_rad": 7.0, key: 1.0})]
)
def test_a_key_without_a_number_is_no_parameter(use, key):
    with pytest.raises(InputError, match=f"^{re.escape(key)}: not a number"):
        use(_CALIBRATION, key)


@pytest.mark.parametrize(
    ("values", "faults"),
    [
        ({"motor.inertia_kg_m2": -1.0}, ["motor.inertia_kg_m2: -1.0 outside"]),
        ({"motor.inertia_kg_m2": math.nan, "contact.clearance_rad": -1.0}, ["motor.inertia", "contact.clearance_rad"]),
        ({"motor.inertia_kg_m2": math.inf}, ["motor.inertia_kg_m2: inf outside"]),
        ({"effects.signal_delay.delay_s": 1.0}, ["effects.signal_delay.delay_s: 1.0 outside [-0.05, 0.05] s"]),
        ({"thermal.pad.inner_heat_share": 0.99}, ["their sum exceeds 1"]),
        ({"stiffness.curves[0].coefficients[0]": -1.0}, ["coefficients[0]: -1.0 outside"]),
    ],
)
def test_checked_lists_every_fault_of_learned_values(values, faults):
    with pytest.raises(InputErrors) as caught:
        moved(_CALIBRATION, values, checked=True)
    assert len(caught.value.faults) == len(faults)
    assert all(expected in fault for expected, fault in zip(faults, caught.value.faults, strict=True))


def test_checked_gives_the_same_as_unchecked():
    values = {"contact.clearance_rad": 7.0, "effects.current_offset.offset_A": 0.5, "friction.offset_Nm": 0.0}
    assert moved(_CALIBRATION, values, checked=True) == moved(_CALIBRATION, values)


#: Limits that the evaluation of a training reads off the calibration; tests/test_adapt.py shows that each refuses.
_OF_EVALUATION = {
    f"adaptation.{name}"
    for name in ("samples_per_range", "residual_ratio", "curve_change", "friction_change", "clearance_change_rad",
                 "maximum_friction_share", "maximum_sigma_N", "pairs_difference", "torque_constant_relative")
}  # fmt: skip


def _derived(calibration: Calibration) -> tuple[bytes, bytes]:
    return to_parameters(calibration).tobytes(), to_limits(calibration).tobytes()


def _acts(key: str) -> bool:
    calibration = _CALIBRATION
    if curve := re.match(r"stiffness\.curves\[(\d)\]", key):
        # A curve acts on pads of about its thickness.
        thickness = calibration.stiffness.curves[int(curve[1])].pad_thickness_mm
        calibration = moved(calibration, {"pad_thickness_mm": thickness + 0.1})
    found = parameter(calibration, key)
    return _derived(moved(calibration, {key: found.value + found.step})) != _derived(calibration)


def test_every_key_of_the_file_acts():
    """A key that changes neither the estimator's parameters nor the limits of adaptation is read by nobody."""
    read = [key for key in (*_KEYS, *_EFFECT_KEYS) if key not in _OF_EVALUATION]
    assert len(read) > 400
    assert not [key for key in read if not _acts(key)]
    off = msgspec.structs.replace(_CALIBRATION.adaptation, enabled=False)
    assert _derived(msgspec.structs.replace(_CALIBRATION, adaptation=off)) != _derived(_CALIBRATION)


def test_fields_that_are_no_parameters_are_declared():
    """Fields that are neither parameters nor switches of adaptation: identity and documentation."""
    plain = {name.partition(".")[0].partition("[")[0] for name in _KEYS}
    assert set(Calibration.__struct_fields__) - plain == {"format", "actuator", "terms", "provenance"}
    assert {field for field in AdaptationLimits.__struct_fields__ if f"adaptation.{field}" not in _KEYS} == {
        "enabled", "samples_per_range", "high_force_N"}  # fmt: skip


def test_a_key_ends_with_its_unit_and_in_words_has_none():
    """Parameters of effects state theirs beside, too."""
    stated = {p.name: p.unit for effect in REGISTRY for p in effect.parameters}
    assert {name: parameters._unit(name) for name in stated} == stated
    keys_in_words = {
        "thermal.disc.cooling_per_speed_J_per_rad_K": "cooling per speed",
        "thermal.softening.per_K": "softening",
        "order_2_cosine_um": "order 2 cosine",
        "share": "share",
    }
    assert {key: in_words(key) for key in keys_in_words} == keys_in_words
