"""Plants from calibrations: another unit of the same kind of brake."""

from collections.abc import Mapping

import numpy as np

from emb_daemon.calibration.curves import curve_at
from emb_daemon.calibration.types import Calibration, FrictionTable, Noise, Thermal
from emb_daemon.models.gear import all_through_gear, steepest
from emb_daemon.plant.records import EFFECTS, PLANT, TRAVEL_POINTS

#: Values that no calibration contains, the same for every plant, in the units of `records.PLANT_FIELDS`.
_UNSTATED = {
    "current_time": 0.001,
    "magnet_heating": 0.02,
    "magnet_time": 60.0,
    "presliding_damping": 0.004,
    "curve_temperature": 22.0,
    "touching_force": 50.0,
    "plate_heat_capacity": 17500.0,
    "plate_loss": (93.0, 69.0),
    "caliper_heat_capacity": 3600.0,
    "caliper_loss": 4.0,
    "temperature_noise": 0.25,
    "force_noise": 25.0,
    "brake_torque_noise": 0.6,
}
#: Standard deviations between a calibration and a unit that was calibrated well, some time later; relative unless stated
#: otherwise.
_SCATTER = {
    "torque_constant": 0.002,
    "inertia": 0.01,
    "load_friction": 0.03,
    "offset_friction": 0.05,
    "presliding_angle": 0.1,
    "relaxation_time": 0.01,
    "softening": 0.05,
    "softening_history": 0.05,
    "history_time": 0.05,
    "specific_heat": 0.02,
    "conductivity": 0.03,
    "heat_share": 0.05,
    "contact_conductance": 0.05,
    "gap_conductance": 0.05,
    "plate_conductance": 0.05,
    "disc_heat_capacity": 0.01,
    "disc_cooling": 0.03,
    "disc_cooling_per_speed": 0.03,
    "friction_coefficient": 0.02,
}
#: The same for the complete curve, for the contact angle, rad, and for each parameter of an effect.
_CURVE_SCATTER, _CONTACT_SCATTER_RAD, _EFFECT_SCATTER = 0.003, 0.01, 0.03
#: Range of the resolver's reading in the released position, which is arbitrary.
_RELEASED_RANGE_RAD = (-200.0, 200.0)


def _friction_plane(table: FrictionTable) -> np.ndarray:
    """Least squares of a friction table: value at 20 degC, slopes over temperature, speed and force."""
    force, speed, temperature = np.meshgrid(
        table.force_N, table.disc_speed_rad_per_s, table.surface_temperature_C, indexing="ij"
    )
    coefficient = np.array(table.coefficient)
    terms = np.stack([np.ones(coefficient.size), temperature.ravel() - 20.0, speed.ravel(), force.ravel()], axis=1)
    return np.linalg.lstsq(terms, coefficient.ravel(), rcond=None)[0]


def plant_from_calibration(
    calibration: Calibration,
    seed: int | None = None,
    effects: dict[str, dict[str, float]] | None = None,
    pad_thickness_mm: float | None = None,
) -> np.void:
    """A PLANT record of the kind of brake that a calibration describes, with unit-to-unit scatter of a ``seed``, or of the
    calibration's own numbers. Raises InputError: the thickness is too far from the measured ones; KeyError: no such effect or
    parameter.

    ``effects`` are switched on, with their parameters (`records.EFFECTS`), of which one left out is zero; they are added to
    those of the calibration, and replace effects of the same name. ``pad_thickness_mm``: of the pads mounted, if not the
    calibration's."""
    p = np.zeros(1, PLANT)[0]
    for name, value in _UNSTATED.items():
        p[name] = value
    thickness = calibration.pad_thickness_mm if pad_thickness_mm is None else pad_thickness_mm
    _set_motor(p, calibration)
    _set_stiffness(p, calibration, thickness)
    _set_pads(p, calibration.thermal, thickness)
    _set_disc(p, calibration.thermal)
    _set_sensors(p, calibration.noise)
    if (sensor := calibration.force_sensor) is not None:
        p["sensor_limit"], p["sensor_noise"] = sensor.limit_N, sensor.noise_N
        p["sensor_walk"] = sensor.offset_walk_N_per_sqrt_s
    own = {name: values for name, values in calibration.effects.items() if name in EFFECTS}
    _set_effects(p, own | (effects or {}))
    if seed is not None:
        rng = np.random.default_rng(seed)
        _scatter(p, rng, set(calibration.effects) - set(effects or {}))
        if (sensor := calibration.force_sensor) is not None:
            spread = {"offset": sensor.offset_N, "per_K": sensor.offset_N_per_K, "gain": sensor.gain_relative}
            for name, sigma in spread.items():
                p[f"sensor_{name}"] = sigma * rng.standard_normal()
    return p


def _set_motor(p: np.void, calibration: Calibration) -> None:
    motor, friction, gear = calibration.motor, calibration.friction, calibration.motor.gear()
    p["torque_constant"] = motor.torque_constant_Nm_per_A
    p["inertia"] = motor.inertia_kg_m2
    p["gear_gain"] = motor.gear_gain_m_per_rad
    if motor.travel.angle_rad:
        p["travel_angle"] = np.linspace(0.0, motor.travel.angle_rad[-1], TRAVEL_POINTS)
        p["travel"] = p["gear_gain"] * all_through_gear(gear, p["travel_angle"])[0]
    p["release_spring"] = motor.release_spring_N_per_m
    p["maximum_speed"] = motor.maximum_speed_rad_per_s
    # Enough to hold the largest force against friction, and to accelerate.
    steep = steepest(gear)[1] * motor.gear_gain_m_per_rad
    p["maximum_current"] = 1.5 * steep * calibration.stiffness.maximum_force_N / motor.torque_constant_Nm_per_A
    p["load_friction"] = friction.load_m_per_rad
    p["offset_friction"] = friction.offset_Nm
    p["presliding_angle"] = friction.presliding_angle_rad


def _set_stiffness(p: np.void, calibration: Calibration, thickness_mm: float) -> None:
    soft = calibration.thermal.softening
    p["curve"] = curve_at(calibration.stiffness.curves, thickness_mm)
    p["relaxation_time"] = calibration.stiffness.relaxation_time_s
    p["contact_angle"] = calibration.contact.clearance_rad
    p["softening"], p["softening_history"], p["history_time"] = soft.per_K, soft.history_per_K, soft.history_time_s


def _set_pads(p: np.void, thermal: Thermal, thickness_mm: float) -> None:
    pad = thermal.pad
    p["pad_thickness"] = 1e-3 * thickness_mm
    p["pad_area"] = pad.area_m2
    p["density"] = pad.density_kg_per_m3
    p["specific_heat"], p["specific_heat_rise"] = pad.specific_heat_J_per_kgK, pad.specific_heat_rise_per_K
    p["conductivity"], p["conductivity_rise"] = pad.conductivity_W_per_mK, pad.conductivity_rise_per_K
    p["heat_share"] = pad.inner_heat_share, pad.outer_heat_share
    p["contact_conductance"] = pad.contact_conductance_W_per_m2K
    p["gap_conductance"] = pad.gap_conductance_W_per_m2K
    p["plate_conductance"] = pad.backplate_conductance_W_per_m2K


def _set_disc(p: np.void, thermal: Thermal) -> None:
    disc = thermal.disc
    p["disc_heat_capacity"] = disc.heat_capacity_J_per_K
    p["disc_cooling"] = disc.cooling_W_per_K
    p["disc_cooling_per_speed"] = disc.cooling_per_speed_J_per_rad_K
    p["disc_radiating_area"] = disc.radiating_area_m2
    p["effective_radius"] = disc.effective_radius_m
    names = ("friction_coefficient", "friction_per_K", "friction_per_speed", "friction_per_force")
    for name, value in zip(names, _friction_plane(thermal.friction), strict=True):
        p[name] = value


def _set_sensors(p: np.void, noise: Noise) -> None:
    p["current_noise"], p["current_noise_time"] = noise.current_A, noise.current_correlation_s
    p["speed_noise"] = noise.speed_rad_per_s
    count = 2.0 * np.pi / 4096
    p["angle_noise"], p["angle_count"], p["angle_hysteresis"] = 0.1 * count, count, 0.5 * count


def _set_effects(p: np.void, effects: Mapping[str, Mapping[str, float]]) -> None:
    for name, values in effects.items():
        for key, value in values.items():
            if key not in EFFECTS[name]:
                raise KeyError(f"effect {name} has no parameter {key}; expected {', '.join(EFFECTS[name])}")
            p["effects"][name][key] = value


def _scatter(p: np.void, rng: np.random.Generator, scattered_effects: set[str]) -> None:
    for name, sigma in _SCATTER.items():
        p[name] = p[name] * (1.0 + sigma * rng.standard_normal(p[name].shape))
    p["curve"] *= 1.0 + _CURVE_SCATTER * rng.standard_normal()
    p["contact_angle"] += _CONTACT_SCATTER_RAD * rng.standard_normal()
    p["released_angle"] = rng.uniform(*_RELEASED_RANGE_RAD)
    for name in sorted(scattered_effects & set(EFFECTS)):
        for key in EFFECTS[name]:
            p["effects"][name][key] *= 1.0 + _EFFECT_SCATTER * rng.standard_normal()
