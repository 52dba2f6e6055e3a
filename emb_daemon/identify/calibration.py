"""The calibration made of what the steps found, and where its numbers come from."""

from collections.abc import Sequence

from emb_daemon import __version__
from emb_daemon.calibration.curves import Curve
from emb_daemon.calibration.files import date_of_today
from emb_daemon.calibration.parameters import keys, moved, value_of
from emb_daemon.calibration.types import Calibration, Contact, Friction, Motor, Noise, Provenance, Source, Stiffness
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.campaign_file import Datasheet
from emb_daemon.identify.dynamics import TERMS
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps.heat import nominal_thermal
from emb_daemon.identify.steps.thermal import ThermalStep
from emb_daemon.identify.text import rounded
from emb_daemon.identify.validation import Validation
from emb_daemon.models.gear import through_gear
from emb_daemon.offline.score import PATHS


def nominal(sheet: Datasheet, name: str, pad_thickness_mm: float, measured_mm: Sequence[float]) -> Calibration:
    """The datasheet's values as a calibration, with a curve for each thickness that was measured. What no datasheet states is
    a placeholder that a step replaces.

    Only the thermal section may stay as it is, if no log heats the pads."""
    actuator = sheet.actuator
    # Full force within a radian: whatever the gear's travel, such a curve lies within it.
    steep = (actuator.rated_clamp_force_N, *[0.0] * (TERMS - 1))
    curves = tuple(Curve(pad_thickness_mm=mm, coefficients=steep) for mm in measured_mm)
    motor = Motor(
        torque_constant_Nm_per_A=actuator.motor_torque_constant_Nm_per_A,
        inertia_kg_m2=actuator.lumped_inertia_kg_m2,
        gear_gain_m_per_rad=actuator.gear_gain_m_per_rad,
        maximum_speed_rad_per_s=actuator.max_motor_speed_rad_per_s,
        travel=actuator.travel,
        release_spring_N_per_m=actuator.release_spring_N_per_m,
    )
    clearance, _ = through_gear(motor.gear(), actuator.pad_clearance_rad)
    return Calibration(
        format=1,
        actuator=name,
        pad_thickness_mm=pad_thickness_mm,
        motor=motor,
        friction=Friction(load_m_per_rad=0.0, offset_Nm=0.0, presliding_angle_rad=1e-2),
        stiffness=Stiffness(curves=curves, relaxation_time_s=0.0, maximum_force_N=actuator.rated_clamp_force_N),
        contact=Contact(clearance_rad=clearance, clearance_sigma_rad=1.0, walk_rad_per_sqrt_s=0.0),
        noise=Noise(
            stiffness_N=1.0,
            stiffness_relative=0.0,
            stiffness_correlation_s=1.0,
            current_A=1.0,
            current_correlation_s=1.0,
            speed_rad_per_s=1.0,
            presliding=0.0,
            torque_relative=0.0,
        ),
        thermal=nominal_thermal(sheet),
    )


def tidy(calibration: Calibration) -> Calibration:
    """Seven digits: far more than is known, and a file that people can read. Raises InputErrors: what was found is not what a
    calibration file may hold."""
    values = {key: value_of(calibration, key) for key in keys(calibration)}
    # A value that needs no rounding stays the same object: fields that are still the default are left out of the file.
    return moved(calibration, {key: rounded(v, 7) for key, v in values.items() if rounded(v, 7) != v}, checked=True)


def provenance(campaign: Campaign, steps: tuple[Step, ...], validations: list[Validation], heat: ThermalStep) -> Provenance:
    """Date, logs, error figures and standard deviations."""
    figures = {}
    for one in validations:
        for path in PATHS:
            figures[f"{one.name}: {path} rmse_N"] = one.rmse_N(path)
        figures[f"{one.name}: inside_two_sigma"] = one.figures["inside_two_sigma"]
    figures |= heat.figures
    achieved = {f"{path}_N": max(one.rmse_N(path) for one in validations) for path in ("stiffness", "torque") if validations}
    if heat.achieved_K is not None:
        achieved["temperature_K"] = heat.achieved_K
    sigmas = {key: sigma for step in steps for key, sigma in step.sigmas.items()}
    return Provenance(
        date=date_of_today(),
        tool=f"emb-daemon {__version__}",
        campaign=campaign.path.name,
        logs=tuple(Source(log=name, sha256=digest) for name, digest in sorted(campaign.sources.items())),
        figures=_finite(figures),
        achieved=_finite(achieved),
        sigmas=_finite(sigmas),
    )


def _finite(numbers: dict[str, float]) -> dict[str, float]:
    return {name: rounded(value) for name, value in numbers.items() if abs(value) < float("inf")}
