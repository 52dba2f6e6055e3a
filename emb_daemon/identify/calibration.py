"""The calibration made of what the steps found, and where its numbers come from."""

import datetime
import os

import msgspec

from emb_daemon import __version__
from emb_daemon.calibration.types import Calibration, Provenance, Source
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.judge import Judged
from emb_daemon.identify.steps import Step
from emb_daemon.identify.text import rounded


def assemble(campaign: Campaign, *steps: Step, pad_thickness_mm: float | None = None) -> Calibration:
    """Sections of all steps together; the pads are the campaign's if not said otherwise."""
    return Calibration(
        format=1,
        actuator=f"rig-{campaign.file.rig}",
        pad_thickness_mm=pad_thickness_mm or campaign.pad_thickness_mm,
        **{name: value for step in steps for name, value in step.values.items()},
    )


def tidy(calibration: Calibration) -> Calibration:
    """Seven digits: far more than is known, and a file that people can read."""

    def shortened(value):
        if isinstance(value, dict):
            return {key: shortened(entry) for key, entry in value.items()}
        if isinstance(value, list | tuple):
            return [shortened(entry) for entry in value]
        return rounded(value, 7) if isinstance(value, float) else value

    return msgspec.convert(shortened(msgspec.to_builtins(calibration)), Calibration)


def provenance(
    campaign: Campaign, steps: tuple[Step, ...], judged: list[Judged], temperatures: dict[str, float]
) -> Provenance:
    """Date (``SOURCE_DATE_EPOCH`` if it is set), logs, error figures and standard deviations."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.datetime.fromtimestamp(int(epoch), datetime.UTC) if epoch else datetime.datetime.now(datetime.UTC)
    figures = {}
    for one in judged:
        for path in ("stiffness", "torque", "maximum_likelihood", "fused"):
            figures[f"{one.name}: {path} rmse_N"] = one.rmse_N(path)
        figures[f"{one.name}: inside_two_sigma"] = one.figures["inside_two_sigma"]
    sigmas = {key: sigma for step in steps for key, sigma in step.sigmas.items()}
    return Provenance(
        date=now.strftime("%Y-%m-%d"),
        tool=f"emb-daemon {__version__}",
        campaign=campaign.path.name,
        logs=tuple(Source(log=name, sha256=digest) for name, digest in sorted(campaign.sources.items())),
        figures={name: rounded(value) for name, value in (figures | temperatures).items() if abs(value) < float("inf")},
        sigmas={name: rounded(value) for name, value in sigmas.items() if abs(value) < float("inf")},
    )
