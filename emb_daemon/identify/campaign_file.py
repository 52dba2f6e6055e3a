"""Files of a rig campaign: which log plays which part, and what the supplier's datasheet says."""

from typing import Annotated

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.fields import NonNegative, Positive, Struct
from emb_daemon.calibration.parameters import INERTIA, TORQUE_CONSTANT
from emb_daemon.calibration.types import CONSTANT_GEAR, Travel
from emb_daemon.wire.contract import PULSES_PER_TURN

#: Relative tolerance of a datasheet's values where it states none: two standard deviations.
_TOLERANCE = 0.15


class Recording(Struct, kw_only=True):
    """One log, recorded with pads of one thickness."""

    #: Log file, relative to the campaign.
    log: str
    #: Thickness of the pads; if left out, the campaign's.
    pad_thickness_mm: Positive | None = None


class Sine(Recording, kw_only=True):
    """A log in which the motor angle is a sinusoid."""

    #: Frequency of the sinusoid.
    frequency_Hz: Positive


class Training(Struct, kw_only=True):
    """A log of park brake training, and a log on which the learned values are judged."""

    #: Log of a slow clamp and release with a small fast sinusoid added, relative to the campaign.
    training: str
    #: Log with random motor angle, on which the learned values are judged.
    judge: str | None = None
    #: Thickness of the pads; if left out, the campaign's.
    pad_thickness_mm: Positive | None = None


class DiscCooling(Struct, kw_only=True):
    """A log in which the disc is heated, then released at constant speed."""

    #: Log file, relative to the campaign.
    log: str
    #: Speed of the disc in the second half of the log; a log with another speed is left out.
    disc_turns_per_s: Annotated[float, Meta(ge=0.0)]


class ThermalLogs(Struct, kw_only=True):
    """Logs of a rig whose disc turns and whose pads contain thermocouples."""

    #: About 3 kN, with the disc's speed as a slow sinusoid: for the heat paths of pads and disc.
    tune: str | None = None
    #: Stops and pauses, on which the heat model is judged; the calibration's `sigma_K` is at least what it shows.
    validate: str | None = None
    #: A grid of clamp forces and disc speeds at rising temperature: for the friction coefficient.
    heat_flux_map: str | None = None
    #: Cold clamps, heating, then a burst of clamps every few minutes for hours: for softening and its history.
    pad_cooling: str | None = None
    #: One log for each disc speed: for the cooling of the disc.
    disc_cooling: tuple[DiscCooling, ...] = ()


class Integrated(Struct, kw_only=True):
    """Logs with everything together on hot pads."""

    #: Training, braking heat and random angle: for softening, if there is no log `pad_cooling`.
    fit: str | None = None
    #: The same again, on which the calibration is judged.
    judge: str | None = None


class CampaignFile(Struct, kw_only=True):
    """CAMPAIGN.yaml. Paths are relative to this file."""

    #: Name of the rig; the calibration's `actuator` is made from it.
    rig: str
    #: Corner whose messages are in the logs: FL, FR, RL or RR.
    corner: str = "FL"
    #: DBC of the rig; its layout must agree with the one that the daemon reads.
    dbc: str | None = None
    #: Datasheet file, with the keys of the second part of this page.
    datasheet: str
    #: Pad thickness of every log that states none, and of the pads for which the calibration is made; if left out, the
    #: datasheet's.
    pad_thickness_mm: Positive | None = None
    #: Slow clamp and release between the released position and the largest force, some ten seconds each way: for curve and
    #: friction.
    curves: tuple[Recording, ...] = ()
    #: A new random motor angle every 100 ms between released and clamped, beginning released: for relaxation, inertia and
    #: friction.
    random: tuple[Recording, ...] = ()
    #: Trainings with other pads, without reference force, for the study of adaptation. Identification uses only their `judge`.
    adaptation: tuple[Training, ...] = ()
    #: Logs with sinusoids, for figures over frequency.
    frequency_response: tuple[Sine, ...] = ()
    #: Trainings with a worn gear, one for each state of wear.
    gear_wear: tuple[Training, ...] = ()
    #: Logs with thermocouples in the pads. Without them the estimated force does not depend on temperature.
    thermal: ThermalLogs | None = None
    #: Logs with everything together on hot pads.
    integrated: tuple[Integrated, ...] = ()


class Actuator(Struct, kw_only=True):
    """Motor, gear and screw."""

    #: Clamp travel per radian of the motor, which equals motor torque per clamp force without friction. Known from the
    #: geometry and taken as exact. With `travel`: the mean slope of that table.
    gear_gain_m_per_rad: Positive
    #: Only for a gear that is not constant; taken as exact.
    travel: Travel = CONSTANT_GEAR
    #: Rate of a spring that helps release: force on the gear's output per travel from the released position, where the spring
    #: is relaxed; taken as exact.
    release_spring_N_per_m: NonNegative = 0.0
    #: Torque constant of the motor. A prior: identification reports a unit whose value is beyond the tolerance.
    motor_torque_constant_Nm_per_A: Positive
    #: Relative tolerance of the torque constant: two standard deviations.
    motor_torque_constant_tolerance: Positive = _TOLERANCE
    #: Inertia of everything that turns, at the motor shaft. A prior, like the torque constant.
    lumped_inertia_kg_m2: Positive
    #: Relative tolerance of the inertia: two standard deviations.
    lumped_inertia_tolerance: Positive = _TOLERANCE
    #: Largest speed of the motor.
    max_motor_speed_rad_per_s: Positive
    #: Largest force of the brake.
    rated_clamp_force_N: Positive
    #: Motor angle between the released position and contact. Within half of it the pads must certainly not touch.
    pad_clearance_rad: Positive

    def __post_init__(self) -> None:
        self.travel.check_mean(self.gear_gain_m_per_rad)


class Resolver(Struct, kw_only=True):
    """Motor angle sensor."""

    #: Counts per turn of the motor.
    counts_per_revolution: Positive
    #: What the angle is, in words; not evaluated.
    angle_is: str = ""

    @property
    def count_rad(self) -> float:
        """Smallest step of the motor angle."""
        return 2.0 * np.pi / self.counts_per_revolution


class PadNominal(Struct, kw_only=True):
    """One pad."""

    #: Thickness of the friction material alone.
    thickness_mm: Positive
    #: Area that touches the disc.
    frontal_area_m2: Positive
    #: Density of the friction material.
    density_kg_per_m3: Positive
    #: Specific heat of the friction material.
    specific_heat_J_per_kgK: Positive
    #: Heat conductivity of the friction material at 20 degC.
    conductivity_W_per_mK: Positive


class DiscNominal(Struct, kw_only=True):
    """Brake disc."""

    #: Mass of the friction ring.
    mass_kg: Positive
    #: Specific heat of the disc's material.
    specific_heat_J_per_kgK: Positive
    #: Radius at which the pads' friction acts.
    effective_radius_m: Positive
    #: Area that is exposed to the air, both sides together.
    cooling_area_m2: Positive
    #: Heat conductivity of the disc's material.
    conductivity_W_per_mK: Positive


class Wheel(Struct, kw_only=True):
    """Wheel speed sensor."""

    #: Pulses per turn of the wheel; must be the number that the daemon uses.
    pulses_per_revolution: Positive

    def __post_init__(self) -> None:
        if self.pulses_per_revolution != PULSES_PER_TURN:
            raise ValueError(f"pulses_per_revolution: expected {PULSES_PER_TURN}, by which the daemon turns pulses into angle")


class Datasheet(Struct, kw_only=True):
    """Nominal values of actuator, pads and disc, as the supplier states them."""

    actuator: Actuator
    resolver: Resolver
    pad: PadNominal
    disc: DiscNominal
    wheel: Wheel | None = None
    #: Nominal friction coefficient of pad on disc.
    friction_coefficient: Positive

    def stated(self, key: str) -> tuple[float, float]:
        """Value that the supplier states for a key of the calibration, and its relative tolerance."""
        actuator = self.actuator
        return {
            TORQUE_CONSTANT: (actuator.motor_torque_constant_Nm_per_A, actuator.motor_torque_constant_tolerance),
            INERTIA: (actuator.lumped_inertia_kg_m2, actuator.lumped_inertia_tolerance),
        }[key]
