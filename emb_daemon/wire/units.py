"""Units as DBC files spell them, and how one becomes another of the same quantity."""

import math
import re

from emb_daemon.errors import InputError

_DEGREE = math.pi / 180.0
#: Standard gravity, m/s2; weight of a pound, N; inch, m.
_GRAVITY, _POUND, _INCH = 9.80665, 4.4482216152605, 0.0254
#: Unit: (unit of the same quantity that others are converted over, factor, offset); that = factor * this + offset.
UNITS = {
    "rad": ("rad", 1.0, 0.0), "deg": ("rad", _DEGREE, 0.0), "°": ("rad", _DEGREE, 0.0), "mrad": ("rad", 1e-3, 0.0),
    "rev": ("rad", 2.0 * math.pi, 0.0), "turn": ("rad", 2.0 * math.pi, 0.0),
    "rad/s": ("rad/s", 1.0, 0.0), "deg/s": ("rad/s", _DEGREE, 0.0), "°/s": ("rad/s", _DEGREE, 0.0),
    "rpm": ("rad/s", math.pi / 30.0, 0.0), "RPM": ("rad/s", math.pi / 30.0, 0.0), "1/min": ("rad/s", math.pi / 30.0, 0.0),
    "r/min": ("rad/s", math.pi / 30.0, 0.0), "rev/s": ("rad/s", 2.0 * math.pi, 0.0),
    "A": ("A", 1.0, 0.0), "mA": ("A", 1e-3, 0.0), "V": ("V", 1.0, 0.0), "mV": ("V", 1e-3, 0.0),
    "degC": ("degC", 1.0, 0.0), "°C": ("degC", 1.0, 0.0), "C": ("degC", 1.0, 0.0), "deg C": ("degC", 1.0, 0.0),
    "K": ("degC", 1.0, -273.15), "degF": ("degC", 5.0 / 9.0, -160.0 / 9.0), "°F": ("degC", 5.0 / 9.0, -160.0 / 9.0),
    "m/s": ("m/s", 1.0, 0.0), "km/h": ("m/s", 1.0 / 3.6, 0.0), "kph": ("m/s", 1.0 / 3.6, 0.0), "mph": ("m/s", 0.44704, 0.0),
    "N": ("N", 1.0, 0.0), "kN": ("N", 1e3, 0.0), "daN": ("N", 10.0, 0.0), "lbf": ("N", _POUND, 0.0), "lb": ("N", _POUND, 0.0),
    # Load cells state a force as the mass of that weight.
    "kgf": ("N", _GRAVITY, 0.0), "kg": ("N", _GRAVITY, 0.0), "g": ("N", 1e-3 * _GRAVITY, 0.0),
    "Nm": ("Nm", 1.0, 0.0), "kNm": ("Nm", 1e3, 0.0), "mNm": ("Nm", 1e-3, 0.0), "Nmm": ("Nm", 1e-3, 0.0),
    "Ncm": ("Nm", 1e-2, 0.0), "kgf cm": ("Nm", 1e-2 * _GRAVITY, 0.0), "lbf ft": ("Nm", 12.0 * _INCH * _POUND, 0.0),
    "lbf in": ("Nm", _INCH * _POUND, 0.0), "ozf in": ("Nm", _INCH * _POUND / 16.0, 0.0),
    "Hz": ("Hz", 1.0, 0.0),
    "s": ("s", 1.0, 0.0), "ms": ("s", 1e-3, 0.0), "us": ("s", 1e-6, 0.0), "µs": ("s", 1e-6, 0.0), "ns": ("s", 1e-9, 0.0),
    "min": ("s", 60.0, 0.0), "h": ("s", 3600.0, 0.0), "d": ("s", 86400.0, 0.0),
    "%": ("%", 1.0, 0.0),
    "1": ("", 1.0, 0.0), "-": ("", 1.0, 0.0), "": ("", 1.0, 0.0),
}  # fmt: skip

#: Other spellings of them in DBC files and headers, in small letters.
_SPELLINGS = {
    "degree": "deg", "degrees": "deg", "degree/s": "deg/s", "degrees/s": "deg/s", "deg/sec": "deg/s", "dps": "deg/s",
    "radian": "rad", "radians": "rad", "rad/sec": "rad/s", "rad.s-1": "rad/s", "u/min": "rpm", "upm": "rpm", "min-1": "rpm",
    "revolutions": "rev", "turns": "rev", "u": "rev", "rev/min": "rpm", "amp": "A", "amps": "A", "ampere": "A",
    "volt": "V", "volts": "V", "celsius": "degC", "deg c": "degC", "degc": "degC", "ºc": "degC", "° c": "degC", "kelvin": "K",
    "deg f": "degF", "km/hr": "km/h", "kmh": "km/h", "kmph": "km/h", "km/h": "km/h", "kph": "km/h", "newton": "N",
    "newtons": "N", "newton meter": "Nm", "percent": "%", "f": "degF", "ºf": "degF", "° f": "degF", "fahrenheit": "degF",
    "ft lbf": "lbf ft", "lb ft": "lbf ft", "ft lb": "lbf ft", "in lbf": "lbf in", "lb in": "lbf in", "in lb": "lbf in",
    "oz in": "ozf in", "in oz": "ozf in", "kg cm": "kgf cm", "n m": "Nm", "nm": "Nm", "kn m": "kNm",
    "mn m": "mNm", "n mm": "Nmm", "n cm": "Ncm",
}  # fmt: skip
#: A unit at the end of a column's name.
_IN_NAME = re.compile(r"\[\s*([^][]+?)\s*\]\s*$|\(\s*([^()]+?)\s*\)\s*$")
#: For an axis whose travel is measured instead of its motor's angle.
TRAVELS = ("m", "cm", "mm", "um", "µm", "in", "m/s", "cm/s", "mm/s", "mm/min", "m/min", "in/s")


def stated_in(name: str) -> str:
    """The unit that a column's name ends with, in brackets or parentheses, as `UNITS` spells it; empty if it states none."""
    found = _IN_NAME.search(name)
    return known_as(found[1] or found[2] if found else "")


def known_as(unit: str) -> str:
    """A unit as `UNITS` spells it, also from brackets or parentheses; empty if it is none of them."""
    unit = unit.strip(" []()")
    return known if (known := _spelt(unit)) in UNITS else ""


def _spelt(unit: str) -> str:
    """A unit as `UNITS` spells it, with any separator between the factors of a torque; an unknown unit unchanged."""
    small = unit.lower()
    apart = re.sub(r"[ *·⋅.-]+", " ", small)
    return unit if unit in UNITS else _SPELLINGS.get(small) or _SPELLINGS.get(apart) or (apart if apart in UNITS else unit)


def conversion(unit: str, target: str) -> tuple[float, float]:
    """(factor, offset) by which a value in ``unit`` becomes one in ``target``. Raises InputError: the unit is unknown,
    missing, or of another quantity."""
    unit = _spelt(unit)
    if unit == target:
        return 1.0, 0.0
    target_base, target_factor, target_offset = UNITS[target]
    base, factor, offset = UNITS.get(unit, (None, 1.0, 0.0))
    if base != target_base:
        others = (known for known, (of, *_) in UNITS.items() if of == target_base and known not in ("", target))
        raise InputError(f"is in {repr(unit) if unit else 'no unit'}; expected {', '.join([target or 'none', *others])}")
    return factor / target_factor, (offset - target_offset) / target_factor
