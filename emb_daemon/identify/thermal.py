"""Heat: pads, disc, friction and softening out of a rig's thermal logs (thesis chapter 8)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from emb_daemon.calibration.types import Thermal
from emb_daemon.offline import Log


@dataclass(frozen=True)
class Nominal:
    """What the datasheet states; where the fits start, and what stays where a log is missing. SI units."""

    pad_thickness_m: float
    pad_area_m2: float
    pad_density_kg_per_m3: float
    pad_specific_heat_J_per_kgK: float
    pad_conductivity_W_per_mK: float
    disc_mass_kg: float
    disc_specific_heat_J_per_kgK: float
    disc_effective_radius_m: float
    disc_cooling_area_m2: float
    disc_conductivity_W_per_mK: float
    friction_coefficient: float


@dataclass(frozen=True)
class ThermalLogs:
    """Logs of one corner by the part they play. ``validate`` and second elements of ``integrated`` fit nothing.

    Any may be missing; ``tune`` alone is enough for a pad model.
    """

    tune: Log | None = None
    validate: Log | None = None
    heat_flux_map: Log | None = None
    pad_cooling: Log | None = None
    disc_cooling: tuple[Log, ...] = ()
    #: (fit, judge) pairs.
    integrated: tuple[tuple[Log | None, Log | None], ...] = ()


@dataclass(frozen=True)
class Row:
    """One line of the report's table: what is judged, RMSE of the thesis's form and of ours, what to reach; NaN: none."""

    name: str
    unit: str
    thesis: float
    ours: float
    target: float


@dataclass(frozen=True)
class ThermalResult:
    """What the thermal logs say.

    Attributes:
        thermal: that part of a calibration. What no log could tell holds the datasheet's value and is named in ``notes``.
        sigmas: standard deviations by calibration key, ``thermal.pad.conductivity_W_per_mK`` and so on.
        figures: RMSE on each log, judged and fitted, by name with unit.
        table: lines for the report's table.
        plots: arrays for the report by name, each a dict of equally long arrays along the last axis:
            ``validate``, ``tune``, ``integrated 1`` ...: ``time_s`` (n,), ``measured``, ``known``, ``unknown`` (9, n) degC: inner
            pad at 2, 4, 6, 8 mm, outer pad at the same, disc; ``known`` with the brake torque measured, ``unknown`` without it;
            ``thesis`` (8, n) where the thesis's form was run;
            ``disc_cooling``: ``speed_rad_per_s``, ``rate_per_s``, ``rate_sigma_per_s``, ``line_per_s``, ``biot``;
            ``friction``: ``force_N``, ``speed_rad_per_s``, ``temperature_C``, ``measured``, ``model`` coefficients;
            ``softening``: per burst ``time_s``, ``rise_K``, ``factor``, ``factor_sigma``, ``exponential``, ``window``, ``fitted``
            (1 where the burst fitted, 0 where it judged), ``rmse_N``;
            ``window``: ``width_s``, ``residual``.
        notes: sentences for the report, such as values kept from the datasheet.
        faults: one line per log that is missing or says too little: which, and what was needed.
    """

    thermal: Thermal
    sigmas: dict[str, float]
    figures: dict[str, float]
    table: tuple[Row, ...]
    plots: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


def identify_thermal(
    logs: ThermalLogs,
    nominal: Nominal,
    stiffness: np.void | None = None,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> ThermalResult:
    """Thermal calibration from logs.

    Args:
        stiffness: PARAMETERS record with the cold stiffness path (curve of this pad thickness, relaxation, effects,
            clearance); softening is identified only with it.
        progress: called with the share done, 0 to 1, and what comes next.

    Raises:
        InputError: not one log that heats the pads with their thermocouples recorded.
    """
    raise NotImplementedError
