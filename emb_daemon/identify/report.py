"""The report of an identification: its errors on logs that were not fitted, then every step with its evidence."""

from emb_daemon.calibration.files import calibration_hash
from emb_daemon.identify import validation
from emb_daemon.identify.run import Identification
from emb_daemon.identify.steps import attribution, noise, stiffness, thermal, thickness, torque
from emb_daemon.report.page import Page


def build(result: Identification) -> Page:
    """The page; nothing is written yet."""
    campaign, calibration = result.campaign, result.calibration
    provenance = calibration.provenance
    page = Page(
        f"Identification of rig {campaign.file.rig}",
        f"{campaign.path.name}, corner {campaign.file.corner}, pads {campaign.pad_thickness_mm:g} mm · {provenance.date} · "
        f"{provenance.tool} · calibration {calibration_hash(calibration)} · {result.seconds:.0f} s",
    )
    _summary(page, result)
    validation.section(page, result.validations)
    stiffness.section(page, result.stiffness)
    thickness.section(page, result.thickness, campaign.pad_thickness_mm)
    torque.section(page, result.torque)
    noise.section(page, calibration)
    thermal.section(page, result.thermal, calibration)
    attribution.section(page, result.attribution)
    _logs(page, result)
    return page


def _summary(page: Page, result: Identification) -> None:
    errors = [one.rmse_N() for one in result.validations]
    headline = "Nothing could be judged"
    if errors:
        headline = f"Fused force {min(errors):.0f} to {max(errors):.0f} N RMSE on {len(errors)} logs that fitted nothing"
    faults = result.campaign.faults
    page.verdict(None, headline, [f"{len(faults)} remarks on logs, steps or values; see Logs."] if faults else [])


def _logs(page: Page, result: Identification) -> None:
    section = page.section("Logs and provenance")
    for heading, lines in (("Left out, or against the datasheet", result.campaign.faults), ("Notes", result.notes)):
        if lines:
            section.heading(heading)
            section.items(lines)
    section.heading("Logs read")
    logs = result.calibration.provenance.logs
    section.table(["log", "sha256"], [[source.log, source.sha256[:16] + "…"] for source in logs])
    section.text("Full hashes, figures and standard deviations stand in the calibration's provenance.")
