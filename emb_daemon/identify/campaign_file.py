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


class Trial(Struct, kw_only=True):
    """One log with pads of one thickness."""

    #: Relative to the campaign.
    log: str
    #: The campaign's if it is left out.
    pad_thickness_mm: Positive | None = None


class Sine(Trial, kw_only=True):
    """Motor angle a sinusoid."""

    #: Of the sinusoid.
    frequency_Hz: Positive


class Training(Struct, kw_only=True):
    """Park brake training, and a log to judge on what is known then."""

    #: Slow clamp and release with a small fast sinusoid on top, relative to the campaign.
    training: str
    #: Random motor angle, to judge by.
    judge: str | None = None
    #: The campaign's if it is left out.
    pad_thickness_mm: Positive | None = None


class DiscCooling(Struct, kw_only=True):
    """Heated, then released at constant disc speed, against which the log is checked."""

    #: Relative to the campaign.
    log: str
    #: Speed of the disc in the log's second half.
    disc_turns_per_s: Annotated[float, Meta(ge=0.0)]


class ThermalLogs(Struct, kw_only=True):
    """Second test rig: the disc turns, thermocouples stand in the pads."""

    #: About 3 kN, the disc's speed a slow sinusoid: heat paths of pads and disc.
    tune: str | None = None
    #: Stops and pauses, to judge by.
    validate: str | None = None
    #: A grid of clamp force and disc speed at rising temperature: the friction coefficient.
    heat_flux_map: str | None = None
    #: Cold clamps, heating, then a burst of clamps every few minutes for hours: softening and its history.
    pad_cooling: str | None = None
    #: One for each disc speed.
    disc_cooling: tuple[DiscCooling, ...] = ()


class Integrated(Struct, kw_only=True):
    """Everything together on hot pads."""

    #: Training, braking heat and random angle: softening where no burst log is.
    fit: str | None = None
    #: The same again, to judge by.
    judge: str | None = None


class CampaignFile(Struct, kw_only=True):
    """CAMPAIGN.yaml. Paths are relative to the file."""

    #: A name, for the calibration's.
    rig: str
    #: FL, FR, RL or RR: of the log's messages.
    corner: str = "FL"
    #: The rig's own description of its bus; it must agree with the layout that the daemon reads.
    dbc: str | None = None
    #: What the supplier states, a file with the keys of the second part of this page.
    datasheet: str
    #: Of every log that states none, and of the pads that the calibration is for; the datasheet's if it is left out.
    pad_thickness_mm: Positive | None = None
    #: Slow clamp and release from the released position to the largest force, some ten seconds each way.
    curves: tuple[Trial, ...] = ()
    #: A new random motor angle every 100 ms between released and clamped, beginning released: relaxation, inertia, friction.
    random: tuple[Trial, ...] = ()
    #: Of other pads, without the reference force: for the study of adaptation; identification judges alone.
    adaptation: tuple[Training, ...] = ()
    #: Sinusoids, for figures over frequency.
    frequency_response: tuple[Sine, ...] = ()
    #: One for each state of wear.
    gear_wear: tuple[Training, ...] = ()
    #: Logs with thermocouples in the pads; without any the force does not follow temperature.
    thermal: ThermalLogs | None = None
    #: Hot pads, everything together.
    integrated: tuple[Integrated, ...] = ()


class Actuator(Struct, kw_only=True):
    """Motor, gear and screw."""

    #: Clamp travel per radian of the motor, which is also torque per clamp force; geometry, taken as exact. With `travel`, a
    #: mean of it.
    gear_gain_m_per_rad: Positive
    #: Of a gear that is not constant; likewise taken as exact.
    travel: Travel = CONSTANT_GEAR
    #: Of a spring that helps release: force on the gear's output per travel from the released position, none there; exact.
    release_spring_N_per_m: NonNegative = 0.0
    #: This and the inertia are priors, and a unit beyond their tolerances is reported.
    motor_torque_constant_Nm_per_A: Positive
    #: Share, two standard deviations.
    motor_torque_constant_tolerance: Positive = _TOLERANCE
    #: Of everything that turns, seen from the motor.
    lumped_inertia_kg_m2: Positive
    #: Share, two standard deviations.
    lumped_inertia_tolerance: Positive = _TOLERANCE
    #: The fastest that the motor turns.
    max_motor_speed_rad_per_s: Positive
    #: Largest force of the brake.
    rated_clamp_force_N: Positive
    #: Motor angle between the released position and contact; half of it must surely be free of contact.
    pad_clearance_rad: Positive

    def __post_init__(self):
        self.travel.check_mean(self.gear_gain_m_per_rad)


class Resolver(Struct, kw_only=True):
    """Motor angle sensor."""

    #: Of one turn of the motor.
    counts_per_revolution: Positive
    #: In words, for people.
    angle_is: str = ""

    @property
    def count_rad(self) -> float:
        """Smallest step of the motor angle."""
        return 2.0 * np.pi / self.counts_per_revolution


class PadNominal(Struct, kw_only=True):
    """One pad."""

    #: Friction material alone.
    thickness_mm: Positive
    #: That touches the disc.
    frontal_area_m2: Positive
    #: Of the friction material.
    density_kg_per_m3: Positive
    #: Of the friction material.
    specific_heat_J_per_kgK: Positive
    #: Of the friction material, at 20 degC.
    conductivity_W_per_mK: Positive


class DiscNominal(Struct, kw_only=True):
    """Brake disc."""

    #: Of the friction ring.
    mass_kg: Positive
    #: Of its material.
    specific_heat_J_per_kgK: Positive
    #: At which the pads rub.
    effective_radius_m: Positive
    #: That meets the air, both sides.
    cooling_area_m2: Positive
    #: Of its material.
    conductivity_W_per_mK: Positive


class Wheel(Struct, kw_only=True):
    """Wheel speed sensor."""

    #: Must be the daemon's own count.
    pulses_per_revolution: Positive

    def __post_init__(self):
        if self.pulses_per_revolution != PULSES_PER_TURN:
            raise ValueError(f"pulses_per_revolution: expected {PULSES_PER_TURN}, by which the daemon turns pulses into angle")


class Datasheet(Struct, kw_only=True):
    """Nominal values of actuator, pads and disc, as the supplier states them."""

    actuator: Actuator
    resolver: Resolver
    pad: PadNominal
    disc: DiscNominal
    wheel: Wheel | None = None
    #: Of pad on disc.
    friction_coefficient: Positive

    def stated(self, key: str) -> tuple[float, float]:
        """Value that the supplier states for a key of the calibration, and its relative tolerance."""
        actuator = self.actuator
        return {
            TORQUE_CONSTANT: (actuator.motor_torque_constant_Nm_per_A, actuator.motor_torque_constant_tolerance),
            INERTIA: (actuator.lumped_inertia_kg_m2, actuator.lumped_inertia_tolerance),
        }[key]
