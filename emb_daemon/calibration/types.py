"""What a calibration file holds. Keys carry their unit; every field's comment is its documentation.

The estimator never sees these objects: `to_parameters` turns them into its record once.
"""

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
    """Clamp travel over motor angle past the released position, of a gear that is not constant (ball or roller ramp, cam),
    from the datasheet's geometry. Between the points runs a rising cubic. Then every angle of pads in this file (clearance,
    curves, slip angles) is travel over ``gear_gain_m_per_rad``."""

    #: From zero, ascending.
    angle_rad: tuple[Annotated[NonNegative, usual(1.0)], ...] = ()
    #: Likewise; to the largest force with the pads of the softest curve.
    travel_mm: tuple[Annotated[NonNegative, usual(0.1)], ...] = ()

    def __post_init__(self):
        if len(self.angle_rad) != len(self.travel_mm):
            raise InvalidValue(f"{len(self.angle_rad)} angle_rad and {len(self.travel_mm)} travel_mm: expected as many")
        if 0 < len(self.angle_rad) < 3:
            raise InvalidValue("expected three points or more")
        for name in ("angle_rad", "travel_mm"):
            values = getattr(self, name)
            if values and values[0] != 0.0:
                raise InvalidValue(f"{name}: expected the released position, zero, as first point")
            for row, (before, after) in enumerate(pairwise(values), 1):
                if after <= before:
                    raise InvalidValue(f"{name}[{row}]: {after:g} after {before:g}; expected more")

    def check_mean(self, gear_gain: float) -> None:
        """Raise `InvalidValue` if a gear gain (m/rad) is none of this travel's."""
        if not self.angle_rad:
            return
        slopes = 1e-3 * np.diff(self.travel_mm) / np.diff(self.angle_rad)
        # A hundredth: both are rounded.
        if not 0.99 * slopes.min() <= gear_gain <= 1.01 * slopes.max():
            raise InvalidValue(
                f"gear_gain_m_per_rad: {gear_gain:g} is no mean of travel, which rises by {slopes.min():.3g} to "
                f"{slopes.max():.3g} m/rad"
            )


#: One object: what is left out of a file is told by identity.
CONSTANT_GEAR = Travel()


class Motor(Struct, kw_only=True):
    """Motor and gear (thesis 2.3, 2.4)."""

    #: Motor torque per torque-producing current, at 25 degC.
    torque_constant_Nm_per_A: Positive
    #: Lumped inertia of motor and gear at the motor shaft.
    inertia_kg_m2: Positive
    #: Clamp travel per motor angle; equally motor torque per clamp force. Geometry. With `travel`, a mean of it.
    gear_gain_m_per_rad: Positive
    #: Fastest that the motor turns.
    maximum_speed_rad_per_s: Positive
    #: Of a gear that is not constant.
    travel: Travel = CONSTANT_GEAR
    #: Of a spring that helps release: force on the gear's output per travel from the released position, none there.
    release_spring_N_per_m: Annotated[NonNegative, usual(1e5)] = 0.0

    def __post_init__(self):
        self.travel.check_mean(self.gear_gain_m_per_rad)

    def gear(self) -> np.void:
        """GEAR record (`models.gear`) of `travel`."""
        gear = np.zeros(1, GEAR)[0]
        fill_gear(gear, np.array(self.travel.angle_rad), 1e-3 * np.array(self.travel.travel_mm) / self.gear_gain_m_per_rad)
        return gear


class Friction(Struct, kw_only=True):
    """Friction of the reduction gear at the motor shaft (thesis 4.1)."""

    #: Friction torque per clamp force (mu_g).
    load_m_per_rad: Annotated[NonNegative, usual(1e-5)]
    #: Friction torque without clamp force (eta_g).
    offset_Nm: Annotated[NonNegative, usual(0.03)]
    #: Motor angle over which friction turns over after a reversal; near zero it is the thesis's sign function.
    presliding_angle_rad: Annotated[float, Meta(ge=1e-6), usual(0.03)]


class Stiffness(Struct, kw_only=True):
    """Stiffness path (thesis 2.1, 3.3, 3.4)."""

    #: One curve for each pad thickness that was measured, thinnest first.
    curves: Annotated[tuple[Curve, ...], Meta(min_length=1)]
    #: Time constant of the first-order dynamics.
    relaxation_time_s: Annotated[NonNegative, usual(0.03)]
    #: Largest force that the curves were identified for.
    maximum_force_N: Positive

    def __post_init__(self):
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


#: Clearance from which a calibration says that there is nothing to clamp: an actuator on a dynamometer. A brake's is some ten,
#: and a screw of this many turns longer than a caliper.
_NOTHING_TO_CLAMP_RAD = 1e3


class Contact(Struct, kw_only=True):
    """Where the pads touch."""

    #: Motor angle from the released position to contact.
    clearance_rad: Annotated[NonNegative, usual(10.0)]
    #: Its standard deviation at power-on.
    clearance_sigma_rad: Positive
    #: Random walk of the contact angle, by wear and heat.
    walk_rad_per_sqrt_s: Annotated[NonNegative, usual(1e-4)]

    @property
    def is_in_reach(self) -> bool:
        """Whether the motor can reach pads at all; else the load on the spindle is no function of its angle."""
        return self.clearance_rad < _NOTHING_TO_CLAMP_RAD


class Noise(Struct, kw_only=True):
    """Errors of both paths, as the filter needs them; identified from data that did not fit the models."""

    #: Error of the stiffness path that does not grow with force.
    stiffness_N: Positive
    #: Error of the stiffness path that grows with force, as a share of it.
    stiffness_relative: Annotated[NonNegative, usual(0.01)]
    #: Time over which the stiffness path's error stays the same.
    stiffness_correlation_s: Positive
    #: Noise of the current.
    current_A: Positive
    #: Time over which the noise of the current stays correlated.
    current_correlation_s: Positive
    #: White noise of the motor speed.
    speed_rad_per_s: Positive
    #: Error of the friction state in the middle of a reversal, as a share of full friction.
    presliding: Annotated[NonNegative, usual(0.1)]
    #: Relative error of the torque path that stays.
    torque_relative: Annotated[NonNegative, usual(0.05)]
    #: Relative error of the torque path that stays for some stops and is another in others: what no model of it explains.
    torque_lasting: Annotated[NonNegative, usual(0.05)] = 0.0


class Pad(Struct, kw_only=True):
    """Both brake pads (thesis 7.4 to 8.1). Conductivity is k0 (1 + rise (T - 20 degC)), specific heat likewise."""

    #: Friction surface of one pad.
    area_m2: Positive
    #: Density of the friction material.
    density_kg_per_m3: Positive
    #: Heat conductivity k0 at 20 degC.
    conductivity_W_per_mK: Positive
    #: Its relative rise with temperature.
    conductivity_rise_per_K: Annotated[float, usual(1e-3)] = 0.0
    #: Specific heat C0 at 20 degC.
    specific_heat_J_per_kgK: Positive
    #: Its relative rise with temperature.
    specific_heat_rise_per_K: Annotated[float, usual(1e-3)] = 0.0
    #: Share of the friction power that enters the inner pad directly (thesis p).
    inner_heat_share: Annotated[Share, usual(0.04)]
    #: Share of the friction power that enters the outer pad directly.
    outer_heat_share: Annotated[Share, usual(0.04)]
    #: Between pad surface and disc while they touch.
    contact_conductance_W_per_m2K: Annotated[NonNegative, usual(1000.0)]
    #: Between pad surface and disc when the brake is released.
    gap_conductance_W_per_m2K: Annotated[NonNegative, usual(300.0)]
    #: From the released pad surface to the air that the wheel stirs, per wheel speed.
    surface_cooling_per_speed_J_per_rad_m2K: Annotated[NonNegative, usual(0.1)] = 0.0
    #: Between pad and the thermocouple on its backing plate.
    backplate_conductance_W_per_m2K: Positive

    def __post_init__(self):
        if self.inner_heat_share + self.outer_heat_share > 1.0:
            raise InvalidValue("inner_heat_share and outer_heat_share: their sum exceeds 1")


class Disc(Struct, kw_only=True):
    """The lumped disc (thesis 8.2). Loses cooling + cooling_per_speed * wheel speed, and radiates."""

    #: Of the whole disc.
    heat_capacity_J_per_K: Positive
    #: At which the pads' friction acts.
    effective_radius_m: Positive
    #: Loss to the air at standstill.
    cooling_W_per_K: Annotated[NonNegative, usual(2.0)]
    #: Loss to the air per wheel speed.
    cooling_per_speed_J_per_rad_K: Annotated[NonNegative, usual(0.4)]
    #: Area times emissivity; radiation follows the fourth power of temperature.
    radiating_area_m2: Annotated[NonNegative, usual(0.1)] = 0.0


class FrictionTable(Struct, kw_only=True):
    """Pad-on-disc friction coefficient for service without a brake torque sensor (thesis 8.5)."""

    #: Clamp forces of the table's grid.
    force_N: Annotated[tuple[Annotated[float, usual(1000.0)], ...], Meta(min_length=FORCE_GRID, max_length=FORCE_GRID)]
    #: Disc speeds of the grid.
    disc_speed_rad_per_s: Annotated[
        tuple[Annotated[float, usual(10.0)], ...], Meta(min_length=SPEED_GRID, max_length=SPEED_GRID)
    ]
    #: Pad surface temperatures of the grid.
    surface_temperature_C: Annotated[
        tuple[Annotated[float, usual(100.0)], ...], Meta(min_length=TEMPERATURE_GRID, max_length=TEMPERATURE_GRID)
    ]
    #: coefficient[force][speed][temperature]
    coefficient: tuple[tuple[tuple[Annotated[Share, usual(0.4)], ...], ...], ...]

    def __post_init__(self):
        for name in ("force_N", "disc_speed_rad_per_s", "surface_temperature_C"):
            grid = getattr(self, name)
            if any(after <= before for before, after in pairwise(grid)):
                raise InvalidValue(f"{name}: expected ascending values")
        shape = (FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID)
        if np.array(self.coefficient, dtype=object).shape != shape:
            raise InvalidValue(f"coefficient: expected {shape[0]} x {shape[1]} x {shape[2]} numbers")


class Softening(Struct, kw_only=True):
    """alpha = 1 - per_K * rise - history_per_K * (rise through a first-order lag); rise of the mean pad temperature over
    that at which the curves were identified (thesis 8.4)."""

    #: Mean pad temperature at which the curves were identified.
    reference_C: Annotated[float, usual(100.0)] = 20.0
    #: Loss of stiffness per kelvin now.
    per_K: Annotated[float, usual(5e-4)] = 0.0
    #: Loss of stiffness per kelvin of the rise's history.
    history_per_K: Annotated[float, usual(1e-3)] = 0.0
    #: Time constant of that history.
    history_time_s: Positive = 1000.0


class Thermal(Struct, kw_only=True):
    """Heat and what it does to the stiffness."""

    pad: Pad
    disc: Disc
    friction: FrictionTable
    softening: Softening
    #: Standard deviation of the modelled pad temperatures.
    sigma_K: Positive = 5.0


class Adaptation(Struct, kw_only=True):
    """Limits of park brake adaptation (thesis 3.4): when it may run, what it asks for, and what it may accept."""

    #: Whether training is asked for and learned from at all.
    enabled: bool = True
    #: Lowest ambient temperature at which training teaches something.
    minimum_ambient_C: Annotated[float, usual(100.0)] = -10.0
    #: Highest such ambient temperature.
    maximum_ambient_C: Annotated[float, usual(100.0)] = 45.0
    #: Clamp force that every other corner of the process must hold while one is trained: what keeps a car on a slope of a
    #: fifth with three wheels.
    parking_force_N: Positive = 3000.0
    #: Clamp force down to which training motion is asked for; zero is released, which alone shows contact and clearance.
    low_force_N: Annotated[NonNegative, usual(1000.0)] = 0.0
    #: Clamp force up to which training motion is asked for; left out, 18 kN or 60 % of the largest force, what is less.
    high_force_N: Positive | None = None
    #: Share of that force that must be reached.
    coverage: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.7
    #: Amplitude of the small fast sinusoid on top.
    dither_amplitude_rad: Annotated[NonNegative, usual(1.0)] = 0.9
    #: Its frequency. The inertia's torque, which shows the torque constant, grows with its square.
    dither_frequency_Hz: Positive = 8.0
    #: Standing quietly with the park brake applied before training is asked for.
    settling_time_s: Annotated[NonNegative, usual(5.0)] = 5.0
    #: Waiting for the motion that was asked for.
    answer_time_s: Positive = 10.0
    #: Longest training.
    longest_training_s: Annotated[float, Meta(gt=0.0, le=60.0)] = 45.0
    #: Samples needed in each force range and direction.
    samples_per_range: Annotated[int, Meta(ge=1)] = 50
    #: Residual current over the noise that the calibration knows.
    residual_ratio: Positive = 1.5
    #: Share by which the travel to high_force_N may be under that of the stiffest curve or over that of the softest.
    curve_change: Positive = 0.35
    #: Largest relative change of the friction there.
    friction_change: Positive = 0.6
    #: Largest change of the clearance.
    clearance_change_rad: Positive = 5.0
    #: Friction torque over clamp torque that a gear can have.
    maximum_friction_share: Annotated[Share, usual(0.5)] = 0.6
    #: Largest standard deviation of the learned force.
    maximum_sigma_N: Positive = 200.0
    #: Largest RMS difference of the pairs of passes from the learned curve, as a share of the largest force.
    pairs_difference: Positive = 0.04
    #: Relative standard deviation of the force's scale that training cannot see: gear gain, inertia, and what the pads'
    #: dynamics are wrong by where they look like inertia.
    torque_constant_relative: Annotated[NonNegative, usual(0.01)] = 0.01

    def __post_init__(self):
        if self.minimum_ambient_C >= self.maximum_ambient_C:
            raise InvalidValue("maximum_ambient_C: expected more than minimum_ambient_C")


class Source(Struct, kw_only=True):
    """One log that a calibration rests on."""

    #: File name.
    log: str
    #: Of its content.
    sha256: str


class Provenance(Struct, kw_only=True):
    """Where the numbers come from."""

    #: Of the identification.
    date: str
    #: What wrote the file.
    tool: str
    #: Campaign file.
    campaign: str = ""
    #: Logs that were fitted.
    logs: tuple[Source, ...] = ()
    #: Error figures on logs that fitted nothing, by name.
    figures: dict[str, float] = msgspec.field(default_factory=dict)
    #: Worst RMSE on such logs, what `diagnose` need not go below: stiffness_N and torque_N of the paths, temperature_K.
    achieved: dict[str, float] = msgspec.field(default_factory=dict)
    #: Standard deviations of identified values, by key.
    sigmas: dict[str, float] = msgspec.field(default_factory=dict)


class Calibration(Struct, kw_only=True):
    """Everything identified of one actuator with its pads and disc."""

    #: Version of this file format.
    format: Annotated[int, Meta(ge=1, le=1)]
    #: Which actuator it belongs to; learned values are restored only to the same one.
    actuator: Annotated[str, Meta(min_length=1)]
    #: Thickness of the pads now mounted.
    pad_thickness_mm: Positive
    motor: Motor
    friction: Friction
    stiffness: Stiffness
    contact: Contact
    noise: Noise
    thermal: Thermal
    #: Effects switched on, by name, with their parameters.
    effects: dict[str, dict[str, float]] = msgspec.field(default_factory=dict)
    #: Terms that no catalogue holds, as `emb-daemon diagnose` makes them.
    terms: tuple[Term, ...] = ()
    #: Limits of park brake adaptation.
    adaptation: Adaptation = Adaptation()
    provenance: Provenance | None = None

    def __post_init__(self):
        known, faults = {effect.name: effect for effect in REGISTRY}, []
        for name, values in self.effects.items():
            if name not in known:
                faults.append(f"effects.{name}: unknown effect; known are {', '.join(known)}")
                continue
            bounds = {parameter.name: parameter for parameter in known[name].parameters}
            for key, value in values.items():
                if key not in bounds:
                    faults.append(f"effects.{name}.{key}: unknown parameter; expected {', '.join(bounds)}")
                elif not bounds[key].low <= value <= bounds[key].high:
                    faults.append(
                        f"effects.{name}.{key}: {value} outside [{bounds[key].low}, {bounds[key].high}] {bounds[key].unit}"
                    )
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
        """What of the pads' way to the largest force the gear's table does not cover."""
        faults, reached = [], self.motor.gear()["turned"][-1]
        for curve in self.stiffness.curves:
            needed = self.contact.clearance_rad + travel_at(self.stiffness.maximum_force_N, np.array(curve.coefficients))
            if needed > reached:
                faults.append(
                    f"motor.travel: ends at {self.motor.travel.travel_mm[-1]:g} mm; clearance and the largest force with pads "
                    f"of {curve.pad_thickness_mm:g} mm need {1e3 * needed * self.motor.gear_gain_m_per_rad:.3g} mm"
                )
        return faults

    def __reduce__(self):
        # A default that is left out is told by identity: field by field, a copy in another process would state it and have
        # another hash.
        return _decode, (msgspec.json.encode(self),)

    @property
    def training_force_N(self) -> float:
        """Clamp force up to which training motion is asked for."""
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
    _fill_thermal(p["thermal"], c.thermal, 1e-3 * c.pad_thickness_mm)
    for name, values in c.effects.items():
        for key, value in values.items():
            p["effects"][name][key] = value
    fill_terms(p["effects"]["terms"], c.terms)
    return p
