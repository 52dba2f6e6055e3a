"""Cooling rate of the disc over its speed (thesis 8.2), a check on the fit of pads and disc."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.identify.campaign_file import DiscNominal
from emb_daemon.offline.recording import Recording
from emb_daemon.report.figures import MARKS, MODEL, Panel, Style, Trace, xy_figure
from emb_daemon.report.page import Section

#: Density of grey cast iron (EN-GJL-250), kg/m^3, for the disc's volume.
_CAST_IRON = 7200.0
#: Disc temperatures above ambient from which a cooling rate is computed, K.
_LEAST_OVER_AMBIENT_K = 15.0
#: Biot number up to which a body may be taken as lumped (Incropera, Fundamentals of Heat and Mass Transfer, ch. 5).
_LUMPED = 0.1
_POINTS = Style("#1d2430", mode="markers")


@dataclass(frozen=True)
class CoolingLaw:
    """b_d = ``rest`` + ``per_speed`` omega in 1/s, and the logs' rates from which it is fitted, shape (n,). ``biot``: Biot
    number of the disc at each rate."""

    rest: float
    per_speed: float
    speed_rad_per_s: np.ndarray
    rate_per_s: np.ndarray
    sigma_per_s: np.ndarray
    biot: np.ndarray

    def __call__(self, speed: np.ndarray) -> np.ndarray:
        return self.rest + self.per_speed * speed

    def note(self) -> str:
        lumped = self.biot.max() <= _LUMPED
        verdict = "the disc may be taken as lumped" if lumped else f"above {_LUMPED}: a lumped disc is doubtful"
        return f"Biot number of the disc {self.biot.min():.4f} to {self.biot.max():.4f}: {verdict}"


def cooling_law(recordings: list[Recording], disc: DiscNominal) -> CoolingLaw | None:
    """From the released parts of logs; None without two that differ in speed."""
    found = [rate for r in recordings if (rate := _rate(r)) is not None]
    if len(found) < 2 or np.ptp([speed for speed, _, _ in found]) <= 1.0:
        return None
    speed, rate, sigma = np.array(found).T
    per_speed, rest = np.polyfit(speed, rate, 1)
    film = rate * disc.mass_kg * disc.specific_heat_J_per_kgK / disc.cooling_area_m2
    length = disc.mass_kg / (_CAST_IRON * disc.cooling_area_m2)
    return CoolingLaw(float(rest), float(per_speed), speed, rate, sigma, film * length / disc.conductivity_W_per_mK)


def _rate(r: Recording) -> tuple[float, float, float] | None:
    """(speed in rad/s, rate in 1/s, half the difference of the rates of both halves) once the brake is released."""
    braked = np.flatnonzero(r.touching)
    over = r.measured[8] - r.ambient
    rows = np.arange(braked[-1] + 1 + int(3.0 / r.step_s), len(over)) if len(braked) else np.zeros(0, int)
    rows = rows[over[rows] > _LEAST_OVER_AMBIENT_K]
    if len(rows) < 30:
        return None
    whole, first, second = (-np.polyfit(r.time_s[part], np.log(over[part]), 1)[0] for part in (rows, *np.array_split(rows, 2)))
    return float(r.speed[rows].mean()), whole, 0.5 * abs(second - first)


def figure(section: Section, law: CoolingLaw) -> None:
    order = np.argsort(law.speed_rad_per_s)
    speed = law.speed_rad_per_s[order]
    rates = [
        Trace("each log", speed, law.rate_per_s[order], _POINTS, law.sigma_per_s[order]),
        Trace("line", speed, law(speed), MODEL),
    ]
    biot = [Trace("Biot number", speed, law.biot[order], MARKS)]
    panels = [Panel("Cooling rate b_d (thesis 8.2)", "1/s", rates, 240), Panel("Biot number", "1", biot, 150)]
    section.heading("Disc cooling")
    section.figure(xy_figure(panels, "disc speed / rad/s"))
