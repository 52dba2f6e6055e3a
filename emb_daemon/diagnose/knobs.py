"""What a fit may move: parameters of the estimator, with the step of their derivative and what is known beforehand.

A knob of the base calibration is a nuisance: a curve or a friction that is a little off must not be called an effect, nor
hide one, so every candidate is tested with all of its path's base knobs free.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from emb_daemon.calibration.types import Calibration
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import Effect, Parameter


@dataclass(frozen=True)
class Knob:
    """One number that a fit moves away from the calibration.

    Attributes:
        name: key of the calibration, or ``effect.parameter``.
        channel: residual that it is read from.
        step: of the numerical derivative.
        prior: standard deviation of what is known beforehand; infinite for an effect's amplitude.
        apply: changes a PARAMETERS record in place by a value of this knob, in ``unit``.
        log: index of the only log that it acts on, or None for all.
    """

    name: str
    channel: str
    step: float
    prior: float
    unit: str
    apply: Callable[[np.void, float], None] = field(compare=False)
    log: int | None = None
    low: float = -np.inf
    high: float = np.inf


def _scale(*path: str) -> Callable[[np.void, float], None]:
    def apply(p: np.void, value: float) -> None:
        for name in path[:-1]:
            p = p[name]
        p[path[-1]] = p[path[-1]] * (1.0 + value)

    return apply


def _shift(*path: str) -> Callable[[np.void, float], None]:
    def apply(p: np.void, value: float) -> None:
        for name in path[:-1]:
            p = p[name]
        p[path[-1]] = p[path[-1]] + value

    return apply


def _coefficient(index: int) -> Callable[[np.void, float], None]:
    def apply(p: np.void, value: float) -> None:
        p["curve"][index] *= 1.0 + value

    return apply


def _heat_share(side: int) -> Callable[[np.void, float], None]:
    def apply(p: np.void, value: float) -> None:
        p["thermal"]["heat_share"][side] *= 1.0 + value

    return apply


#: Presliding angle (rad at the motor) that gears have.
_PRESLIDING_RAD = 0.03
#: Least that a calibration may state.
_LEAST_RAD = 1e-6
#: Where the slopes of the pads' friction over force and disc speed turn about, N and rad/s.
_FRICTION_FORCE_N, _FRICTION_SPEED = 5000.0, 20.0


def _friction(kind: str) -> Callable[[np.void, float], None]:
    def apply(p: np.void, value: float) -> None:
        t = p["thermal"]
        if kind == "force":
            weight = (t["friction_force"] / _FRICTION_FORCE_N - 1.0)[:, None, None]
        elif kind == "speed":
            weight = (t["friction_speed"] / _FRICTION_SPEED - 1.0)[None, :, None]
        else:
            weight = 1.0
        t["friction_coefficient"] = np.clip(t["friction_coefficient"] * (1.0 + value * weight), 0.0, 1.0)

    return apply


def _softening(key: str, column: str, value: float) -> Knob:
    """Pads soften with heat, never stiffen; what was calibrated holds within a third."""
    prior = max(0.3 * abs(value), 1e-4)
    change = _shift("thermal", column)
    return Knob(f"thermal.softening.{key}", "stiffness", 1e-5, prior, "1/K", change, low=-max(value, 0.0), high=2e-3)


def _presliding(value: float) -> Knob:
    """In radians: a calibration with friction by sign has next to none, and no factor leads away from that."""
    size = max(value, _PRESLIDING_RAD)
    change = _shift("presliding_angle")
    return Knob(
        "friction.presliding_angle_rad", "torque", 0.02 * size, size, "rad", change, low=max(-0.9 * value, _LEAST_RAD - value)
    )


def base_knobs(parameters: np.void, logs: int) -> list[Knob]:
    """Knobs of the base calibration; the contact angle has one for each log, because each power-on finds its own."""
    knobs = [
        Knob("contact.clearance_rad", "stiffness", 0.01, 0.5, "rad", _shift("clearance"), log if logs > 1 else None)
        for log in range(logs)
    ]
    for index, value in enumerate(parameters["curve"]):
        if value != 0.0:
            name = f"stiffness.curves.coefficients[{index}]"
            # Force rises from contact: the first coefficient keeps its sign.
            low = -np.inf if index else -0.95
            knobs.append(Knob(name, "stiffness", 0.01, 0.1, "1", _coefficient(index), low=low))
    thermal = parameters["thermal"]
    knobs += [
        Knob("stiffness.relaxation_time_s", "stiffness", 0.02, 0.5, "1", _scale("relaxation_time"), low=-0.99),
        _softening("per_K", "softening", float(thermal["softening"])),
        _softening("history_per_K", "softening_history", float(thermal["softening_history"])),
        Knob("motor.torque_constant_Nm_per_A", "torque", 1e-3, 0.03, "1", _scale("torque_constant"), low=-0.5),
        Knob("motor.inertia_kg_m2", "torque", 0.01, 0.5, "1", _scale("inertia"), low=-0.9),
        Knob("friction.load_m_per_rad", "torque", 0.01, 0.5, "1", _scale("load_friction"), low=-0.99),
        Knob("friction.offset_Nm", "torque", 0.01, 1.0, "1", _scale("offset_friction"), low=-0.99),
        _presliding(float(parameters["presliding_angle"])),
    ]
    for key, column, prior in (
        ("pad.conductivity_W_per_mK", "conductivity", 0.15),
        ("pad.contact_conductance_W_per_m2K", "contact_conductance", 0.5),
        ("pad.gap_conductance_W_per_m2K", "gap_conductance", 0.5),
        ("pad.backplate_conductance_W_per_m2K", "backplate_conductance", 0.5),
        ("disc.heat_capacity_J_per_K", "disc_heat_capacity", 0.1),
        ("disc.cooling_W_per_K", "disc_cooling", 0.5),
        ("disc.cooling_per_speed_J_per_rad_K", "disc_cooling_per_speed", 0.5),
    ):
        if thermal[column] != 0.0:
            knobs.append(Knob(f"thermal.{key}", "temperature", 0.02, prior, "1", _scale("thermal", column), low=-0.9))
    for side, name in enumerate(("inner", "outer")):
        key = f"thermal.pad.{name}_heat_share"
        knobs.append(Knob(key, "temperature", 0.02, 0.5, "1", _heat_share(side), low=-0.9))
    for kind, prior in (("scale", 0.3), ("force", 0.1), ("speed", 0.1)):
        knobs.append(Knob(f"thermal.friction.{kind}", "brake_torque", 0.01, prior, "1", _friction(kind), low=-0.9))
    return knobs


def effect_knob(effect: Effect, parameter_name: str, channel: str, initial: float = 0.0) -> Knob:
    """Knob of one parameter of an effect; its value is the deviation from ``initial``."""
    parameter = next(p for p in effect.parameters if p.name == parameter_name)
    scale = abs(initial) if initial else parameter.prior
    if "order" in parameter_name and parameter.starts:
        # Phase runs away with the angle: an order is only ever touched up.
        step, prior = 1e-4, 0.1
    elif parameter.starts:
        step, prior = 0.02 * (scale or 1.0), max(scale, 0.5)
    else:
        step, prior = 0.05 * scale, scale if initial else np.inf
    return Knob(
        f"{effect.name}.{parameter_name}",
        channel,
        step,
        prior,
        parameter.unit,
        _shift("effects", effect.name, parameter_name),
        low=parameter.low - initial,
        high=parameter.high - initial,
    )


def calibrated(calibration: Calibration, values: dict[Knob, float]) -> Calibration:
    """The calibration with knobs moved; those of single logs count with their mean."""
    data = msgspec.to_builtins(calibration)
    clearance = [value for knob, value in values.items() if knob.name == "contact.clearance_rad"]
    if clearance:
        data["contact"]["clearance_rad"] = max(0.0, data["contact"]["clearance_rad"] + float(np.mean(clearance)))
    table = data["thermal"]["friction"]
    effects = {effect.name: effect for effect in REGISTRY}
    for knob, value in values.items():
        value = float(value)
        group, _, rest = knob.name.partition(".")
        if group in effects:
            parameter = next(p for p in effects[group].parameters if p.name == rest)
            entry = data.setdefault("effects", {}).setdefault(group, {p.name: _neutral(p) for p in effects[group].parameters})
            initial = calibration.effects.get(group, {}).get(rest, 0.0)
            entry[rest] = float(np.clip(initial + value, parameter.low, parameter.high))
        if knob.name.startswith("contact.") or group not in ("stiffness", "thermal", "motor", "friction"):
            continue
        if knob.name.startswith("stiffness.curves"):
            index = int(knob.name.split("[")[1].rstrip("]"))
            for curve in data["stiffness"]["curves"]:
                coefficients = list(curve["coefficients"])
                if index < len(coefficients):
                    coefficients[index] *= 1.0 + value
                curve["coefficients"] = coefficients
        elif knob.name.startswith("thermal.friction."):
            table["coefficient"] = _moved_table(table, rest.partition(".")[2], value)
        else:
            target = data[group]
            *path, key = rest.split(".")
            for name in path:
                target = target[name]
            old = target.get(key, 0.0)
            target[key] = float(old * (1.0 + value) if knob.unit == "1" else old + value)
    return msgspec.convert(data, Calibration)


def _neutral(parameter: Parameter) -> float:
    return float(np.clip(0.0, parameter.low, parameter.high))


def _moved_table(table: dict, kind: str, value: float) -> list:
    coefficient = np.array(table["coefficient"])
    weight = 1.0
    if kind == "force":
        weight = (np.array(table["force_N"]) / _FRICTION_FORCE_N - 1.0)[:, None, None]
    elif kind == "speed":
        weight = (np.array(table["disc_speed_rad_per_s"]) / _FRICTION_SPEED - 1.0)[None, :, None]
    return np.clip(coefficient * (1.0 + value * weight), 0.0, 1.0).tolist()
