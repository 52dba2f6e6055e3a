"""The calibration as the one parameter space: whatever fits, learns or perturbs moves numbers by their keys.

A key is the dotted path of a number in the calibration file: ``motor.torque_constant_Nm_per_A``,
``stiffness.curves[0].coefficients[1]``, ``effects.NAME.PARAMETER``. Records are only ever derived from a
calibration (`types.to_parameters`); what adaptation learns is a partial calibration, ``{key: value}``, applied by `moved`.
"""

import difflib
import math
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import msgspec

from emb_daemon.calibration.types import Calibration
from emb_daemon.effects import REGISTRY
from emb_daemon.errors import InputError, InputErrors

#: Keys that several parts of the program use.
TORQUE_CONSTANT, INERTIA = "motor.torque_constant_Nm_per_A", "motor.inertia_kg_m2"
LOAD_FRICTION, OFFSET_FRICTION = "friction.load_m_per_rad", "friction.offset_Nm"
PRESLIDING_ANGLE = "friction.presliding_angle_rad"
CLEARANCE, CLEARANCE_SIGMA = "contact.clearance_rad", "contact.clearance_sigma_rad"

#: Step of a numerical derivative, relative to the size of the parameter. With it the errors of rounding and of curvature are
#: both far below the residuals of a fit, and few samples cross a switch such as contact or a reversal.
_STEP = 1e-3

#: Exceptions of following a path that leads to no number.
_NO_NUMBER = (AttributeError, IndexError, KeyError, TypeError)

#: Units of keys, by the ending that states them.
_UNITS = {
    "Nm_per_A": "N·m/A",
    "kg_m2": "kg·m²",
    "m_per_rad": "m/rad",
    "N_per_m": "N/m",
    "N_per_K": "N/K",
    "N_per_sqrt_s": "N/√s",
    "rad_per_s": "rad/s",
    "rad_per_sqrt_s": "rad/√s",
    "kg_per_m3": "kg/m³",
    "W_per_mK": "W/(m·K)",
    "W_per_K": "W/K",
    "W_per_m2K": "W/(m²·K)",
    "J_per_K": "J/K",
    "J_per_kgK": "J/(kg·K)",
    "J_per_rad_K": "J/(rad·K)",
    "J_per_rad_m2K": "J/(rad·m²·K)",
    "um_per_MJ": "µm/MJ",
    "um_per_K": "µm/K",
    "Nms_per_rad": "N·m·s/rad",
    "per_A2": "1/A²",
    "per_K": "1/K",
    "per_turn": "1",
    "Nm": "N·m",
    "Hz": "Hz",
    "mm": "mm",
    "um": "µm",
    "m2": "m²",
    "rad": "rad",
    "A": "A",
    "C": "°C",
    "K": "K",
    "N": "N",
    "m": "m",
    "s": "s",
}
_UNIT = re.compile(r"(?:^|_)(" + "|".join(sorted(_UNITS, key=len, reverse=True)) + r")(?:\[\d+\])*$")
_PART = re.compile(r"([A-Za-z_]\w*)((?:\[\d+\])*)")

_EFFECTS = {effect.name: {parameter.name: parameter for parameter in effect.parameters} for effect in REGISTRY}


@dataclass(frozen=True)
class Parameter:
    """One number of a calibration."""

    key: str  #: its path in the file
    value: float  #: present value, in ``unit``; of an effect that is switched off, the value that switching it on would set
    step: float  #: for numerical derivatives, in ``unit``; positive at any value, zero included
    #: Whether the step is a share of the value. It is not if the value is small compared with its usual size, nor for
    #: positions and effects, for which zero is an ordinary value.
    relative: bool
    #: ``low`` and ``high``: bounds that the file accepts, in ``unit``.
    low: float
    high: float
    unit: str


def parameter(calibration: Calibration, key: str) -> Parameter:
    """The parameter that a key names. Raises InputError: no number has that key; names near ones."""
    value = value_of(calibration, key)
    parts = _parts(key)
    if parts[0] == "effects":
        entry = _EFFECTS[parts[1]][parts[2]]
        low, high = entry.bounds(calibration.contact.is_in_reach)
        return Parameter(key, value, _STEP * (abs(entry.prior) or 1.0), False, low, high, entry.unit)
    low, high, usual = _bounds(tuple(part for part in parts if isinstance(part, str)))
    if key.endswith("coefficients[0]"):
        low = math.nextafter(0.0, math.inf)  # Force rises from contact.
    relative = abs(value) >= usual
    return Parameter(key, value, _STEP * (abs(value) if relative else usual), relative, low, high, _unit(key))


def value_of(calibration: Calibration, key: str) -> float:
    """The number at a key, in the key's unit. Raises InputError: no number has that key; names near ones."""
    if (found := _number_at(calibration, key)) is None:
        raise _unknown(calibration, key)
    return found


def moved(calibration: Calibration, values: Mapping[str, float], *, checked: bool = False) -> Calibration:
    """The calibration with the numbers at ``values``' keys set, in the keys' units.

    An effect that is switched off is switched on, its amplitudes at zero and its shapes at their usual sizes where ``values``
    does not set them. Unless ``checked``, the caller checks bounds and cross-checks, because a fit calls this often. Raises
    InputError: no number has a key; names near ones. Raises InputErrors: ``checked``, and the result is not what a calibration
    file may hold; lists every fault."""
    numbers = [float(value) for value in values.values()]
    try:
        changed = _set(calibration, _tree(tuple(values)), numbers) if values else calibration
    except _NO_NUMBER:
        raise _unknown(calibration, next(key for key in values if _number_at(calibration, key) is None)) from None
    return _validate(changed, values) if checked else changed


def keys(calibration: Calibration) -> list[str]:
    """Keys of every number that the calibration states, in the file's order."""
    found: list[str] = []

    def walk(value: Any, path: str) -> None:
        if isinstance(value, msgspec.Struct):
            for name in (name for name in value.__struct_fields__ if path or name != "provenance"):
                walk(getattr(value, name), f"{path}.{name}" if path else name)
        elif isinstance(value, tuple):
            for index, item in enumerate(value):
                walk(item, f"{path}[{index}]")
        elif isinstance(value, dict):
            for name, item in value.items():
                walk(item, f"{path}.{name}")
        elif type(value) is float:
            found.append(path)

    walk(calibration, "")
    return found


@cache
def _parts(key: str) -> tuple[str | int, ...]:
    """Names and indices of a key; empty if it is not a key."""
    parts: list[str | int] = []
    for piece in key.split("."):
        match = _PART.fullmatch(piece)
        if match is None:
            return ()
        parts += [match[1], *(int(index) for index in re.findall(r"\d+", match[2]))]
    return () if parts[0] == "provenance" else tuple(parts)


def _unknown(calibration: Calibration, key: str) -> InputError:
    effects = [f"effects.{effect}.{name}" for effect, parameters in _EFFECTS.items() for name in parameters]
    near = difflib.get_close_matches(key, dict.fromkeys([*keys(calibration), *effects]), 3, 0.6)
    similar = f"; similar are {', '.join(near)}" if near else ""
    return InputError(f"{key}: not a number of the calibration{similar}")


def _neutral(effect: str) -> dict[str, float]:
    """Parameters of an effect with zero amplitudes."""
    return {
        parameter.name: float(min(max(parameter.prior if parameter.starts else 0.0, parameter.low), parameter.high))
        for parameter in _EFFECTS[effect].values()
    }


def _number_at(calibration: Calibration, key: str) -> float | None:
    """The number at a key; None if there is none."""
    found: Any = calibration
    try:
        parts = _parts(key)
        for depth, part in enumerate(parts):
            if depth == 1 and parts[0] == "effects" and part not in found:
                found = _neutral(part)
            else:
                found = getattr(found, part) if isinstance(found, msgspec.Struct) else found[part]
    except _NO_NUMBER:
        return None
    return found if type(found) is float else None


@lru_cache(256)
def _tree(keys: tuple[str, ...]) -> dict[str | int, Any]:
    """Names and indices of all keys as a tree with the keys' positions as leaves; fits move the same keys again and again."""
    tree: dict[str | int, Any] = {}
    for position, key in enumerate(keys):
        *path, last = _parts(key) or (key,)
        node = tree
        for part in path:
            node = node.setdefault(part, {})
        node[last] = position
    return tree


def _set(node: Any, tree: Any, numbers: list[float]) -> Any:
    """A copy of ``node`` with ``numbers`` where the `_tree` below it has their positions; everything else is shared."""
    if isinstance(tree, int):
        if type(node) is not float:
            raise TypeError
        return numbers[tree]
    if isinstance(node, msgspec.Struct):
        # Without __post_init__: `_validate` checks the whole.
        result = node.__copy__()
        for part, below in tree.items():
            msgspec.structs.force_setattr(result, part, _set(getattr(node, part), below, numbers))
        return result
    if isinstance(node, dict):
        return node | {
            part: _set(node[part] if part in node else _neutral(part), below, numbers) for part, below in tree.items()
        }
    items = list(node)
    for part, below in tree.items():
        items[part] = _set(items[part], below, numbers)
    return tuple(items)


def _validate(calibration: Calibration, values: Mapping[str, float]) -> Calibration:
    faults = []
    for key, value in values.items():
        limits = parameter(calibration, key)
        if not limits.low <= value <= limits.high or not math.isfinite(value):
            faults.append(f"{key}: {value} outside [{limits.low}, {limits.high}] {limits.unit}")
    if faults:
        raise InputErrors(faults)
    try:
        return msgspec.convert(msgspec.to_builtins(calibration), Calibration)
    except msgspec.ValidationError as error:
        raise InputErrors(str(error).splitlines()) from None


@cache
def _bounds(names: tuple[str, ...]) -> tuple[float, float, float]:
    """(lowest, highest, usual size) of a number by the names on its path, from the types' annotations."""
    kind: Any = Calibration
    for name in names:
        while typing.get_origin(kind) in (tuple, typing.Annotated, types.UnionType):
            kind = typing.get_args(kind)[0]
        kind = typing.get_type_hints(kind, include_extras=True)[name]
    low, high, usual = -math.inf, math.inf, 0.0
    while typing.get_origin(kind) in (tuple, typing.Annotated):
        for meta in typing.get_args(kind)[1:]:
            if isinstance(meta, msgspec.Meta):
                low = max(low, -math.inf if meta.ge is None else meta.ge)
                low = max(low, -math.inf if meta.gt is None else math.nextafter(meta.gt, math.inf))
                high = min(high, math.inf if meta.le is None else meta.le)
                usual = max(usual, (meta.extra or {}).get("usual", 0.0))
        kind = typing.get_args(kind)[0]
    return low, high, usual


def in_words(key: str) -> str:
    """A key in words, without its unit: softening for ``thermal.softening.per_K``."""
    *path, name = key.split(".")
    while not (left := _UNIT.sub("", name)) and path:
        name = path.pop()
    return left.replace("_", " ")


def _unit(key: str) -> str:
    if coefficient := re.search(r"coefficients\[(\d+)\]$", key):
        power = int(coefficient[1]) + 1
        return "N/rad" if power == 1 else f"N/rad^{power}"
    match = _UNIT.search(key.rpartition(".")[2])
    return _UNITS[match[1]] if match else "1"
