"""Pads and disc from logs with thermocouples: least squares over the parameters of the estimator's heat chain.

Thesis 8.1 tunes conductivity and heat shares by hand on one log, 8.2 takes the disc's cooling from others; here one fit
determines both from all logs, because pads and disc exchange heat.
"""

from dataclasses import dataclass

import numpy as np

from emb_daemon.calibration.parameters import moved, value_of
from emb_daemon.calibration.types import Calibration, Disc, Pad, Softening, Thermal, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.identify.campaign_file import Datasheet
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps.friction import constant_friction
from emb_daemon.identify.text import rounded
from emb_daemon.offline.fit import Block, Free, fit
from emb_daemon.offline.recording import Recording, simulate

#: Time between residuals. The model's errors, of the size of a thermocouple's noise (0.3 K), last for about a minute: each
#: residual is worth a twelfth of an independent one, which this standard deviation makes it.
_RESIDUAL_EVERY_S = 5.0
_RESIDUAL_SIGMA_K = 1.0
#: Least rise of the temperature, K, from which pads and disc are identified.
_LEAST_RISE_K = 30.0
#: With fewer logs than this, each is cut into so many episodes.
_FEW_LOGS, _PIECES = 4, 6
#: Factor from its start within which a positive value is searched; largest share of the heat that one pad takes.
_REACH = float(np.exp(4.0))
_MOST_HEAT_SHARE = 0.49
#: A value with more than this share of its information from the prior counts as not shown by the logs.
_UNEXCITED = 0.25
#: Standard deviation of pad temperatures that no thermocouple has confirmed, K.
_UNCONFIRMED_K = 50.0


@dataclass(frozen=True)
class _Unknown:
    """Prior and bounds of a parameter; ``spread`` is a relative standard deviation, or one of value / scale."""

    spread: float
    scale: float | None = None
    low: float = 0.0
    high: float = np.inf


#: What is fitted, by key. Datasheet values have tolerances of 15 %, taken as two standard deviations; the others are hardly
#: known before.
UNKNOWNS = {
    "thermal.pad.conductivity_W_per_mK": _Unknown(0.075),
    "thermal.pad.conductivity_rise_per_K": _Unknown(1.0, scale=1e-3, low=-1e-3, high=4e-3),
    "thermal.pad.specific_heat_J_per_kgK": _Unknown(0.075),
    "thermal.pad.inner_heat_share": _Unknown(1.0, high=_MOST_HEAT_SHARE),
    "thermal.pad.outer_heat_share": _Unknown(1.0, high=_MOST_HEAT_SHARE),
    "thermal.pad.contact_conductance_W_per_m2K": _Unknown(1.0),
    "thermal.pad.gap_conductance_W_per_m2K": _Unknown(1.0),
    "thermal.pad.surface_cooling_per_speed_J_per_rad_m2K": _Unknown(3.0, scale=0.1),
    "thermal.pad.backplate_conductance_W_per_m2K": _Unknown(1.0),
    "thermal.disc.heat_capacity_J_per_K": _Unknown(0.075),
    "thermal.disc.cooling_W_per_K": _Unknown(1.0),
    "thermal.disc.cooling_per_speed_J_per_rad_K": _Unknown(1.0),
    "thermal.disc.radiating_area_m2": _Unknown(1.0, scale=0.1),
}
#: Those that the disc's temperature alone identifies: what the disc stores, and what it loses to air and pads.
_OF_DISC = [key for key in UNKNOWNS if ".disc." in key or "contact_conductance" in key or "gap_conductance" in key]


def nominal_thermal(sheet: Datasheet) -> Thermal:
    """The datasheet's values, and usual values of what no datasheet states: starting values of fits, and final values without
    logs.

    Conductances of pads on a disc: Limpert, Brake Design and Safety, 3rd ed., ch. 3; a released pad sits some 0.1 mm of
    air away (k / gap = 260 W/(m^2 K)). Free convection of a disc is 5 to 15 W/(m^2 K). Organic pads take some five per cent
    of the heat each."""
    pad, disc = sheet.pad, sheet.disc
    return Thermal(
        pad=Pad(
            area_m2=pad.frontal_area_m2,
            density_kg_per_m3=pad.density_kg_per_m3,
            conductivity_W_per_mK=pad.conductivity_W_per_mK,
            conductivity_rise_per_K=5e-4,
            specific_heat_J_per_kgK=pad.specific_heat_J_per_kgK,
            inner_heat_share=0.05,
            outer_heat_share=0.05,
            contact_conductance_W_per_m2K=1500.0,
            gap_conductance_W_per_m2K=300.0,
            surface_cooling_per_speed_J_per_rad_m2K=0.1,
            backplate_conductance_W_per_m2K=5000.0,
        ),
        disc=Disc(
            heat_capacity_J_per_K=disc.mass_kg * disc.specific_heat_J_per_kgK,
            effective_radius_m=disc.effective_radius_m,
            cooling_W_per_K=10.0 * disc.cooling_area_m2,
            cooling_per_speed_J_per_rad_K=1.5 * disc.cooling_area_m2,
            radiating_area_m2=0.5 * disc.cooling_area_m2,
        ),
        friction=constant_friction(sheet.friction_coefficient),
        softening=Softening(),
        sigma_K=_UNCONFIRMED_K,
    )


def check_excitation(r: Recording) -> None:
    """Raises InputError unless friction heats the pads enough, or a disc that was measured alone, to show how heat flows."""
    what, measured = ("pads rise", r.measured[:8]) if r.has_pads else ("the disc rises", r.measured[8:])
    rise = np.nanmax(measured) - np.nanmin(measured[:, 0] if r.has_pads else measured)
    if rise < _LEAST_RISE_K or r.power.max(initial=0.0) <= 0.0:
        raise InputError(f"{r.name}: {what} by {rise:.0f} K; at least {_LEAST_RISE_K:.0f} K by braking are needed")


def fit_heat(recordings: list[Recording], start: Calibration) -> Step:
    """Pads and disc from recordings that heat and cool them; notes name what the logs do not show.

    Residuals are strongly correlated and the equations approximate, so that a whole log counts as one episode, or, with fewer
    than four logs, one sixth of each. Logs of the disc alone fit nothing inside the pads: the pads' parameters would make up
    for errors of the disc's model, and be wrong elsewhere."""
    told = [key for key in UNKNOWNS if key in _OF_DISC or any(r.has_pads for r in recordings)]
    pieces = 1 if len(recordings) >= _FEW_LOGS else _PIECES
    blocks = [_block(r, start, pieces, told) for r in recordings]
    found = fit(blocks, {key: _free(UNKNOWNS[key], value_of(start, key)) for key in told}, tolerance=1e-4)
    unexcited = [key for key in UNKNOWNS if found.from_prior.get(key, 1.0) > _UNEXCITED]
    kept = "these logs hardly tell it; the usual value, or the datasheet's, was mostly kept"
    values = {key: rounded(value, 6) for key, value in found.values.items()}
    return Step(values=values, sigmas=found.sigmas, notes=tuple(f"{key}: {kept}" for key in unexcited))


def _free(unknown: _Unknown, start: float) -> Free:
    if unknown.scale is None:
        high = min(start * _REACH, unknown.high)
        return Free(start, 1e-3, start / _REACH, high, (start, unknown.spread), logarithmic=True)
    return Free(start, 1e-3 * unknown.scale, unknown.low, unknown.high, (start, unknown.spread * unknown.scale))


def _block(r: Recording, start: Calibration, pieces: int, told: list[str]) -> Block:
    every = max(round(_RESIDUAL_EVERY_S / r.step_s), 1)
    measured = r.measured[:, ::every].T
    known = np.isfinite(measured)
    known[:, :8] &= np.tile(np.array(DEPTHS_M) <= 1e-3 * start.pad_thickness_mm, 2)

    def residual(values):
        return (simulate(to_parameters(moved(start, values)), r, every=every)[:, :9] - measured)[known] / _RESIDUAL_SIGMA_K

    count = int(known.sum())
    return Block(residual, tuple(told), np.arange(count) * pieces // max(count, 1))
