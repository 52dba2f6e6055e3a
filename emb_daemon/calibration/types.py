"""What a calibration file holds. Keys carry their unit; every field's comment is its documentation.

The estimator never sees these objects: `to_parameters` turns them into its record once.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from emb_daemon.calibration.curves import Curve, curve_at, rising_force, thickness_range
from emb_daemon.calibration.fields import NonNegative, Positive, Share, Struct, usual
from emb_daemon.calibration.terms import Term, faults_of, fill_terms
from emb_daemon.effects import REGISTRY
from emb_daemon.errors import InputError, InvalidValue
from emb_daemon.estimator.records import FORCE_GRID, PARAMETERS, SPEED_GRID, TEMPERATURE_GRID
from emb_daemon.models.gear import GEAR, fill_gear
from emb_daemon.models.stiffness import travel_at
from emb_daemon.models.thermal import mesh

#: Training reaches the forces that hold a parked car: 18 kN, 60 % of what the brake of the shipped calibration can do, and on
#: weaker brakes the same share.
_TRAINING_FORCE_N, _TRAINING_SHARE = 18_000.0, 0.6


class Travel(Struct, kw_only=True):
    """Travel table of a gear that is not constant (ball or roller ramp, cam).

    Clamp travel over motor angle, both counted from the released position, from the datasheet's geometry. A monotone cubic
    interpolates between the points. With this table every angle of the pads in this file (clearance, curves, slip angles) is
    not the motor's own: it is the travel divided by ``gear_gain_m_per_rad``."""

    #: Motor angles of the points: the first is zero, ascending.
    angle_rad: tuple[Annotated[NonNegative, usual(1.0)], ...] = ()
    #: Clamp travel at these angles: the first is zero, ascending. It must reach the largest force with the pads of the softest
    #: curve.
    travel_mm: tuple[Annotated[NonNegative, usual(0.1)], ...] = ()

    def __post_init__(self) -> None:
        if len(self.angle_rad) != len(self.travel_mm):
            raise InvalidValue(
                f"{len(self.angle_rad)} angle_rad and {len(self.travel_mm)} travel_mm: expected the same number"
            )
        if 0 < len(self.angle_rad) < 3:
            raise InvalidValue("expected at least three points")
        for name in ("angle_rad", "travel_mm"):
            values = getattr(self, name)
            if values and values[0] != 0.0:
                raise InvalidValue(f"{name}: expected the released position, zero, as first point")
            for row, (before, after) in enumerate(pairwise(values), 1):
                if after <= before:
                    raise InvalidValue(f"{name}[{row}]: {after:g} after {before:g}; expected ascending values")

    def check_mean(self, gear_gain: float) -> None:
        """Raise `InvalidValue` if a gear gain (m/rad) cannot be the mean slope of this travel."""
        if not self.angle_rad:
            return
        slopes = 1e-3 * np.diff(self.travel_mm) / np.diff(self.angle_rad)
        # Tolerance of a hundredth, because both are rounded.
        if not 0.99 * slopes.min() <= gear_gain <= 1.01 * slopes.max():
            raise InvalidValue(
                f"gear_gain_m_per_rad: {gear_gain:g} is not a mean slope of travel, whose slope is {slopes.min():.3g} to "
                f"{slopes.max():.3g} m/rad"
            )


#: A single object: a default that the file leaves out is recognised by identity.
CONSTANT_GEAR = Travel()


class Motor(Struct, kw_only=True):
    """Motor and gear (thesis 2.3, 2.4)."""

    #: Motor torque per torque-producing current (CurrentQ), at 25 degC.
    torque_constant_Nm_per_A: Positive
    #: Inertia of motor and gear together, at the motor shaft.
    inertia_kg_m2: Positive
    #: Clamp travel per motor angle, which equals motor torque per clamp force without friction. Known from the geometry. With
    #: `travel`: the mean slope of that table.
    gear_gain_m_per_rad: Positive
    #: Largest speed of the motor.
    maximum_speed_rad_per_s: Positive
    #: Only for a gear that is not constant.
    travel: Travel = CONSTANT_GEAR
    #: Rate of a spring that helps release: force on the gear's output per travel from the released position, where the spring
    #: is relaxed.
    release_spring_N_per_m: Annotated[NonNegative, usual(1e5)] = 0.0

    def __post_init__(self) -> None:
        self.travel.check_mean(self.gear_gain_m_per_rad)

    def gear(self) -> np.void:
        """GEAR record (`models.gear`) of `travel`."""
        gear = np.zeros(1, GEAR)[0]
        fill_gear(gear, np.array(self.travel.angle_rad), 1e-3 * np.array(self.travel.travel_mm) / self.gear_gain_m_per_rad)
        return gear


class Friction(Struct, kw_only=True):
    """Friction of the reduction gear at the motor shaft (thesis 4.1)."""

    #: Friction torque that grows with the clamp force, per newton (mu_g).
    load_m_per_rad: Annotated[NonNegative, usual(1e-5)]
    #: Friction torque that does not depend on the clamp force (eta_g).
    offset_Nm: Annotated[NonNegative, usual(0.03)]
    #: Motor angle over which friction changes its direction after a reversal. Near zero, friction is the sign function of the
    #: thesis.
    presliding_angle_rad: Annotated[float, Meta(ge=1e-6), usual(0.03)]


class Stiffness(Struct, kw_only=True):
    """Stiffness path (thesis 2.1, 3.3, 3.4)."""

    #: One curve for each pad thickness that was measured, thinnest first.
    curves: Annotated[tuple[Curve, ...], Meta(min_length=1)]
    #: Time constant of the first-order dynamics.
    relaxation_time_s: Annotated[NonNegative, usual(0.03)]
    #: Largest force that the curves were identified for.
    maximum_force_N: Positive

    def __post_init__(self) -> None:
        thicknesses = [curve.pad_thickness_mm for curve in self.curves]
        if thicknesses != sorted(set(thicknesses)):
            raise InvalidValue("curves: expected ascending, distinct pad thicknesses")
        between = np.linspace(*thickness_range(self.curves), 8 * len(thicknesses)) if len(thicknesses) > 1 else ()
        for thickness in sorted({*thicknesses, *between}):
            reached = rising_force(curve_at(self.curves, thickness))
            if reached < self.maximum_force_N:
                raise InvalidValue(
                    f"curves: with pads of {thickness:g} mm the force stops rising at {reached:.0f} N, "
                    f"below maximum_force_N ({self.maximum_force_N:g})"
                )


#: Clearance from which a calibration states that there is nothing to clamp, as of an actuator on a dynamometer. The clearance
#: of a brake is some ten rad; a screw for this one would be longer than a caliper.
_NOTHING_TO_CLAMP_RAD = 1e3


class Contact(Struct, kw_only=True):
    """Motor angle at which the pads touch the disc."""

    #: Motor angle from the released position to contact.
    clearance_rad: Annotated[NonNegative, usual(10.0)]
    #: Standard deviation of the clearance at power-on.
    clearance_sigma_rad: Positive
    #: Random walk of the contact angle, caused by wear and heat.
    walk_rad_per_sqrt_s: Annotated[NonNegative, usual(1e-4)]

    @property
    def is_in_reach(self) -> bool:
        """Whether the motor can reach pads. If not, the load on the spindle is not a function of the motor angle."""
        return self.clearance_rad < _NOTHING_TO_CLAMP_RAD


class Noise(Struct, kw_only=True):
    """Errors of both paths, as the filter needs them; identified from data that were not used to fit the models."""

    #: Error of the stiffness path that does not depend on the force, standard deviation.
    stiffness_N: Positive
    #: Error of the stiffness path that is proportional to the force, standard deviation as a share of the force.
    stiffness_relative: Annotated[NonNegative, usual(0.01)]
    #: Correlation time of the stiffness path's error.
    stiffness_correlation_s: Positive
    #: Standard deviation of the current's noise.
    current_A: Positive
    #: Correlation time of the current's noise.
    current_correlation_s: Positive
    #: Standard deviation of the motor speed's noise, which is white.
    speed_rad_per_s: Positive
    #: Error of the friction state in the middle of a reversal, as a share of full friction.
    presliding: Annotated[NonNegative, usual(0.1)]
    #: Relative error of the torque path that stays the same over the whole drive, standard deviation.
    torque_relative: Annotated[NonNegative, usual(0.05)]
    #: Relative error of the torque path that no model explains, and that stays the same over some stops but not over all of
    #: them, standard deviation.
    torque_lasting: Annotated[NonNegative, usual(0.05)] = 0.0


class ForceSensor(Struct, kw_only=True):
    """A clamp force sensor of low range on the bus (`EMB_c_ForceSensor`); without one this section is left out."""

    #: Force up to which it measures; what it says there and beyond is no measurement.
    limit_N: Positive
    #: White noise of one value.
    noise_N: Positive
    #: Its zero at power-on.
    offset_N: Annotated[NonNegative, usual(50.0)]
    #: Random walk of its zero.
    offset_walk_N_per_sqrt_s: Annotated[NonNegative, usual(1.0)]
    #: Drift of its zero per kelvin of the caliper.
    offset_N_per_K: Annotated[NonNegative, usual(1.0)]
    #: Its gain, as a share of what it says.
    gain_relative: Annotated[Share, usual(0.01)]


class Pad(Struct, kw_only=True):
    """Both brake pads (thesis 7.4 to 8.1). Conductivity is k0 (1 + rise (T - 20 degC)), specific heat C0 likewise."""

    #: Friction surface of one pad.
    area_m2: Positive
    #: Density of the friction material.
    density_kg_per_m3: Positive
    #: Heat conductivity k0 at 20 degC.
    conductivity_W_per_mK: Positive
    #: Relative rise of the conductivity per kelvin.
    conductivity_rise_per_K: Annotated[float, usual(1e-3)] = 0.0
    #: Specific heat C0 at 20 degC.
    specific_heat_J_per_kgK: Positive
    #: Relative rise of the specific heat per kelvin.
    specific_heat_rise_per_K: Annotated[float, usual(1e-3)] = 0.0
    #: Share of the friction power that enters the inner pad directly (thesis p).
    inner_heat_share: Annotated[Share, usual(0.04)]
    #: Share of the friction power that enters the outer pad directly.
    outer_heat_share: Annotated[Share, usual(0.04)]
    #: Heat conductance between pad surface and disc while they touch.
    contact_conductance_W_per_m2K: Annotated[NonNegative, usual(1000.0)]
    #: Heat conductance between pad surface and disc while the brake is released.
    gap_conductance_W_per_m2K: Annotated[NonNegative, usual(300.0)]
    #: Heat conductance from the surface of a released pad to the air that the turning wheel moves, per wheel speed.
    surface_cooling_per_speed_J_per_rad_m2K: Annotated[NonNegative, usual(0.1)] = 0.0
    #: Heat conductance between a pad and the thermocouple on its backing plate.
    backplate_conductance_W_per_m2K: Positive

    def __post_init__(self) -> None:
        if self.inner_heat_share + self.outer_heat_share > 1.0:
            raise InvalidValue("inner_heat_share and outer_heat_share: their sum exceeds 1")


class Disc(Struct, kw_only=True):
    """The disc as one lump (thesis 8.2). To the air it loses cooling + cooling_per_speed * wheel speed, and it radiates."""

    #: Heat capacity of the whole disc.
    heat_capacity_J_per_K: Positive
    #: Radius at which the pads' friction acts.
    effective_radius_m: Positive
    #: Heat loss to the air at standstill.
    cooling_W_per_K: Annotated[NonNegative, usual(2.0)]
    #: Additional heat loss to the air per wheel speed.
    cooling_per_speed_J_per_rad_K: Annotated[NonNegative, usual(0.4)]
    #: Radiating area times emissivity; radiation follows the fourth power of temperature.
    radiating_area_m2: Annotated[NonNegative, usual(0.1)] = 0.0


class FrictionTable(Struct, kw_only=True):
    """Friction coefficient of pad on disc, for a brake without a brake torque sensor (thesis 8.5)."""

    #: Clamp forces of the table's grid, ascending.
    force_N: Annotated[tuple[Annotated[float, usual(1000.0)], ...], Meta(min_length=FORCE_GRID, max_length=FORCE_GRID)]
    #: Disc speeds of the grid, ascending.
    disc_speed_rad_per_s: Annotated[
        tuple[Annotated[float, usual(10.0)], ...], Meta(min_length=SPEED_GRID, max_length=SPEED_GRID)
    ]
    #: Pad surface temperatures of the grid, ascending.
    surface_temperature_C: Annotated[
        tuple[Annotated[float, usual(100.0)], ...], Meta(min_length=TEMPERATURE_GRID, max_length=TEMPERATURE_GRID)
    ]
    #: coefficient[force][speed][temperature]
    coefficient: tuple[tuple[tuple[Annotated[Share, usual(0.4)], ...], ...], ...]

    def __post_init__(self) -> None:
        for name in ("force_N", "disc_speed_rad_per_s", "surface_temperature_C"):
            grid = getattr(self, name)
            if any(after <= before for before, after in pairwise(grid)):
                raise InvalidValue(f"{name}: expected ascending values")
        shape = (FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID)
        if np.array(self.coefficient, dtype=object).shape != shape:
            raise InvalidValue(f"coefficient: expected {shape[0]} x {shape[1]} x {shape[2]} numbers")


class Softening(Struct, kw_only=True):
    """Loss of stiffness of hot pads (thesis 8.4).

    alpha = 1 - per_K * rise - history_per_K * (rise through a first-order lag), where rise is the mean pad temperature minus
    `reference_C`."""

    #: Mean pad temperature at which the curves were identified.
    reference_C: Annotated[float, usual(100.0)] = 20.0
    #: Loss of stiffness per kelvin of the present rise.
    per_K: Annotated[float, usual(5e-4)] = 0.0
    #: Loss of stiffness per kelvin of the lagged rise.
    history_per_K: Annotated[float, usual(1e-3)] = 0.0
    #: Time constant of that lag.
    history_time_s: Positive = 1000.0
    #: Standard deviation of `per_K`: what no log has shown.
    sigma_per_K: Annotated[NonNegative, usual(5e-4)] = 0.0


class Thermal(Struct, kw_only=True):
    """Heat model, and its effect on the stiffness."""

    pad: Pad
    disc: Disc
    friction: FrictionTable
    softening: Softening
    #: Standard deviation of the modelled pad temperatures. `identify` states what its fitted logs leave, or what the logs that
    #: validate show as in a car, if that is more.
    sigma_K: Positive = 5.0


class AdaptationLimits(Struct, kw_only=True):
    """Limits of park brake adaptation (thesis 3.4): when training may run, which motion it requests, what it may learn."""

    #: Whether the daemon requests training and learns from it.
    enabled: bool = True
    #: Lowest ambient temperature at which training is allowed.
    minimum_ambient_C: Annotated[float, usual(100.0)] = -10.0
    #: Highest ambient temperature at which training is allowed.
    maximum_ambient_C: Annotated[float, usual(100.0)] = 45.0
    #: Clamp force that every other corner of the process must hold while one is trained: enough for three wheels to hold a car
    #: on a slope of 20 %.
    parking_force_N: Positive = 3000.0
    #: Lowest clamp force of the requested motion. Zero means released; only then does training observe contact and clearance.
    low_force_N: Annotated[NonNegative, usual(1000.0)] = 0.0
    #: Highest clamp force of the requested motion. If left out: 18 kN or 60 % of the largest force, whichever is less.
    high_force_N: Positive | None = None
    #: Share of high_force_N that the motion must reach.
    coverage: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.7
    #: Amplitude of the small fast sinusoid that is added to the slow motion.
    dither_amplitude_rad: Annotated[NonNegative, usual(1.0)] = 0.9
    #: Frequency of that sinusoid. The torque of the inertia shows the torque constant; it grows with the square of the
    #: frequency.
    dither_frequency_Hz: Positive = 8.0
    #: Time for which the car must stand with the park brake applied before the daemon requests training.
    settling_time_s: Annotated[NonNegative, usual(5.0)] = 5.0
    #: Time for which the daemon waits for the requested motion to begin.
    answer_time_s: Positive = 10.0
    #: Longest duration of a training.
    longest_training_s: Annotated[float, Meta(gt=0.0, le=60.0)] = 45.0
    #: Least number of samples in each force range and direction.
    samples_per_range: Annotated[int, Meta(ge=1)] = 50
    #: Largest residual torque, as a multiple of the noise that the calibration states.
    residual_ratio: Positive = 1.5
    #: Relative amount by which the travel to high_force_N may be below that of the stiffest curve or above that of the
    #: softest.
    curve_change: Positive = 0.35
    #: Largest relative change of the friction at high_force_N. The presliding angle may grow by a quarter more.
    friction_change: Positive = 0.6
    #: Largest change of the clearance.
    clearance_change_rad: Positive = 5.0
    #: Largest ratio of friction torque to clamp torque that a gear can have.
    maximum_friction_share: Annotated[Share, usual(0.5)] = 0.6
    #: Largest standard deviation of the learned force.
    maximum_sigma_N: Positive = 200.0
    #: Largest RMS difference between the pairs of passes (clamping and releasing) and the learned curve, as a share of the
    #: largest force.
    pairs_difference: Positive = 0.04
    #: Relative standard deviation of the force's scale that training cannot observe: errors of the gear gain, of the inertia,
    #: and of the pads' dynamics where these look like inertia.
    torque_constant_relative: Annotated[NonNegative, usual(0.01)] = 0.01

    def __post_init__(self) -> None:
        if self.minimum_ambient_C >= self.maximum_ambient_C:
            raise InvalidValue("maximum_ambient_C: expected more than minimum_ambient_C")


class Source(Struct, kw_only=True):
    """One log from which the calibration was identified."""

    #: File name.
    log: str
    #: SHA-256 of the log's content.
    sha256: str


class Provenance(Struct, kw_only=True):
    """Where the numbers of this file come from."""

    #: Date of the identification.
    date: str
    #: Program and version that wrote the file.
    tool: str
    #: Name of the campaign file.
    campaign: str = ""
    #: Logs that were fitted.
    logs: tuple[Source, ...] = ()
    #: Error figures on logs that were not used for fitting, by name.
    figures: dict[str, float] = msgspec.field(default_factory=dict)
    #: Worst RMSE on such logs: stiffness_N and torque_N of the paths, temperature_K. `diagnose` need not get below it.
    achieved: dict[str, float] = msgspec.field(default_factory=dict)
    #: Standard deviations of identified values, by key.
    sigmas: dict[str, float] = msgspec.field(default_factory=dict)


class Calibration(Struct, kw_only=True):
    """Everything that was identified of one actuator with its pads and disc."""

    #: Version of this file format.
    format: Annotated[int, Meta(ge=1, le=1)]
    #: Name of the actuator, with a serial number if the file belongs to one unit. Learned values are restored only to an
    #: actuator of the same name.
    actuator: Annotated[str, Meta(min_length=1)]
    #: Thickness of the pads that are mounted now, friction material alone.
    pad_thickness_mm: Positive
    motor: Motor
    friction: Friction
    stiffness: Stiffness
    contact: Contact
    noise: Noise
    thermal: Thermal
    #: Standard deviations are from the datasheet of the sensor.
    force_sensor: ForceSensor | None = None
    #: Effects of the catalogue that are switched on, by name, with their parameters.
    effects: dict[str, dict[str, float]] = msgspec.field(default_factory=dict)
    #: Terms that are not in the catalogue of effects; `emb-daemon diagnose` makes them.
    terms: tuple[Term, ...] = ()
    #: Limits of park brake adaptation.
    adaptation: AdaptationLimits = AdaptationLimits()
    provenance: Provenance | None = None

    def __post_init__(self) -> None:
        known, faults = {effect.name: effect for effect in REGISTRY}, []
        for name, values in self.effects.items():
            if name not in known:
                faults.append(f"effects.{name}: unknown effect; known are {', '.join(known)}")
                continue
            bounds = {parameter.name: parameter for parameter in known[name].parameters}
            for key, value in values.items():
                if key not in bounds:
                    faults.append(f"effects.{name}.{key}: unknown parameter; expected {', '.join(bounds)}")
                    continue
                low, high = bounds[key].bounds(self.contact.is_in_reach)
                if not low <= value <= high:
                    faults.append(f"effects.{name}.{key}: {value} outside [{low}, {high}] {bounds[key].unit}")
            if missing := bounds.keys() - values.keys():
                faults.append(f"effects.{name}: missing {', '.join(sorted(missing))}")
        faults += faults_of(self.terms)
        try:
            curve_at(self.stiffness.curves, self.pad_thickness_mm)
        except InputError as error:
            faults.append(str(error))
        if self.motor.travel.angle_rad:
            faults += self._out_of_travel()
        if self.training_force_N > self.stiffness.maximum_force_N:
            faults.append(
                f"adaptation.high_force_N: {self.training_force_N:g} exceeds stiffness.maximum_force_N "
                f"({self.stiffness.maximum_force_N:g})"
            )
        if faults:
            raise InvalidValue("\n".join(faults))

    def _out_of_travel(self) -> list[str]:
        """Faults for pads whose travel to the largest force exceeds the gear's table."""
        faults, reached = [], self.motor.gear()["turned"][-1]
        for curve in self.stiffness.curves:
            needed = self.contact.clearance_rad + travel_at(self.stiffness.maximum_force_N, np.array(curve.coefficients))
            if needed > reached:
                faults.append(
                    f"motor.travel: ends at {self.motor.travel.travel_mm[-1]:g} mm; clearance and the largest force with pads "
                    f"of {curve.pad_thickness_mm:g} mm need {1e3 * needed * self.motor.gear_gain_m_per_rad:.3g} mm"
                )
        return faults

    def __reduce__(self) -> tuple[Callable[[bytes], "Calibration"], tuple[bytes]]:
        # Defaults are recognised by identity. A copy made field by field in another process would state them, and therefore
        # have another hash.
        return _decode, (msgspec.json.encode(self),)

    @property
    def training_force_N(self) -> float:
        """Highest clamp force of the requested training motion."""
        share_of_maximum = _TRAINING_SHARE * self.stiffness.maximum_force_N
        return self.adaptation.high_force_N or min(_TRAINING_FORCE_N, share_of_maximum)


def _decode(content: bytes) -> Calibration:
    return msgspec.json.decode(content, type=Calibration)


def _fill_thermal(t: np.void, thermal: Thermal, pad_thickness_m: float) -> None:
    """Write the thermal part into a THERMAL record."""
    pad, disc = thermal.pad, thermal.disc
    t["conductivity"] = pad.conductivity_W_per_mK
    t["conductivity_rise"] = pad.conductivity_rise_per_K
    t["density"] = pad.density_kg_per_m3
    t["specific_heat"] = pad.specific_heat_J_per_kgK
    t["specific_heat_rise"] = pad.specific_heat_rise_per_K
    t["area"] = pad.area_m2
    t["thickness"] = pad_thickness_m
    t["node_position"] = mesh(pad_thickness_m)
    t["heat_share"] = pad.inner_heat_share, pad.outer_heat_share
    t["contact_conductance"] = pad.contact_conductance_W_per_m2K
    t["gap_conductance"] = pad.gap_conductance_W_per_m2K
    t["surface_cooling_per_speed"] = pad.surface_cooling_per_speed_J_per_rad_m2K
    t["backplate_conductance"] = pad.backplate_conductance_W_per_m2K
    t["disc_heat_capacity"] = disc.heat_capacity_J_per_K
    t["disc_cooling"] = disc.cooling_W_per_K
    t["disc_cooling_per_speed"] = disc.cooling_per_speed_J_per_rad_K
    t["disc_radiating_area"] = disc.radiating_area_m2
    t["effective_radius"] = disc.effective_radius_m
    t["friction_force"] = thermal.friction.force_N
    t["friction_speed"] = thermal.friction.disc_speed_rad_per_s
    t["friction_temperature"] = thermal.friction.surface_temperature_C
    t["friction_coefficient"] = thermal.friction.coefficient
    t["softening"] = thermal.softening.per_K
    t["softening_history"] = thermal.softening.history_per_K
    t["history_time"] = thermal.softening.history_time_s
    t["softening_sigma"] = thermal.softening.sigma_per_K
    t["reference"] = thermal.softening.reference_C
    t["sigma"] = thermal.sigma_K


def to_parameters(calibration: Calibration) -> np.void:
    """The estimator's PARAMETERS record of a calibration."""
    c = calibration
    p = np.zeros(1, PARAMETERS)[0]
    p["gear_gain"] = c.motor.gear_gain_m_per_rad
    p["torque_constant"] = c.motor.torque_constant_Nm_per_A
    p["inertia"] = c.motor.inertia_kg_m2
    p["maximum_speed"] = c.motor.maximum_speed_rad_per_s
    p["gear"] = c.motor.gear()
    p["spring"] = c.motor.release_spring_N_per_m
    p["load_friction"] = c.friction.load_m_per_rad
    p["offset_friction"] = c.friction.offset_Nm
    p["presliding_angle"] = c.friction.presliding_angle_rad
    p["curve"] = curve_at(c.stiffness.curves, c.pad_thickness_mm)
    p["relaxation_time"] = c.stiffness.relaxation_time_s
    p["maximum_force"] = c.stiffness.maximum_force_N
    p["clearance"] = c.contact.clearance_rad
    p["clearance_sigma"] = c.contact.clearance_sigma_rad
    p["contact_walk"] = c.contact.walk_rad_per_sqrt_s
    p["stiffness_sigma"] = c.noise.stiffness_N
    p["stiffness_relative_sigma"] = c.noise.stiffness_relative
    p["stiffness_correlation_time"] = c.noise.stiffness_correlation_s
    p["current_sigma"] = c.noise.current_A
    p["current_correlation_time"] = c.noise.current_correlation_s
    p["speed_sigma"] = c.noise.speed_rad_per_s
    p["presliding_sigma"] = c.noise.presliding
    p["torque_relative_sigma"] = c.noise.torque_relative
    p["torque_lasting_sigma"] = c.noise.torque_lasting
    if (sensor := c.force_sensor) is not None:
        p["sensor"]["limit"], p["sensor"]["noise"], p["sensor"]["offset"] = sensor.limit_N, sensor.noise_N, sensor.offset_N
        p["sensor"]["walk"], p["sensor"]["per_kelvin"] = sensor.offset_walk_N_per_sqrt_s, sensor.offset_N_per_K
        p["sensor"]["gain"] = sensor.gain_relative
    _fill_thermal(p["thermal"], c.thermal, 1e-3 * c.pad_thickness_mm)
    for name, values in c.effects.items():
        for key, value in values.items():
            p["effects"][name][key] = value
    fill_terms(p["effects"]["terms"], c.terms)
    return p
