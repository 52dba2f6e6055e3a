"""Pad-on-disc friction coefficient over clamp force, disc speed and surface temperature, for service (thesis 8.5)."""

import numpy as np

from emb_daemon.calibration.types import FrictionTable
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID
from emb_daemon.identify.text import rounded
from emb_daemon.offline.fit import left_out_covariance
from emb_daemon.offline.recording import Recording, simulate
from emb_daemon.offline.score import rmse
from emb_daemon.report.figures import Panel, Style, Trace, xy_figure
from emb_daemon.report.page import Section

#: Rows with less force or speed are dominated by the sensors' noise.
_LEAST_FORCE_N = 500.0
_LEAST_SPEED_RAD_PER_S = 1.0
#: Number of rows before and after that must brake as well, so that no row averages over an edge.
_MARGIN = 2
#: Time over which rows are averaged: noise of the force looks like a friction coefficient that falls with force.
_AVERAGE_S = 1.0
_LEAST_ROWS = 30
#: Standard deviation of one second's coefficient, whose errors last longer than that, and prior standard deviations of its
#: dependence on force (1/N), speed (s/rad) and temperature (1/K), for logs in which one of them hardly varies.
_ROW_SIGMA = 0.01
_EXPECTED_SLOPES = (1e-5, 3e-3, 1e-3)
#: Prior standard deviation of the curvature with temperature, 1/K².
_EXPECTED_BEND = 5e-6
#: Pieces of the data that are left out in turn.
_PIECES = 8
#: Relative amount by which a further term must lower the error on pieces left out.
_WORTH_IT = 0.98
#: The table extends beyond the largest force, speed and temperature that were measured by this factor.
_BEYOND = 1.25
_CLOUD = Style("#aab4c0", mode="markers", size=3.0)
_DOTS = Style("rgba(11,92,173,0.35)", mode="markers", size=3.5)


def _rows(r: Recording, parameters: np.void) -> np.ndarray:
    surface = simulate(parameters, r)[:, 9:11].mean(axis=1)
    braking = r.touching & (r.force > _LEAST_FORCE_N) & (r.speed > _LEAST_SPEED_RAD_PER_S)
    steady = braking.copy()
    for shift in range(1, _MARGIN + 1):
        steady[shift:] &= braking[:-shift]
        steady[:-shift] &= braking[shift:]
    together = max(round(_AVERAGE_S / r.step_s), 1)
    whole = len(steady) // together * together
    steady = steady[:whole].reshape(-1, together).all(axis=1)

    def averaged(values):
        return values[:whole].reshape(-1, together).mean(axis=1)[steady]

    radius = float(parameters["thermal"]["effective_radius"])
    force, speed = averaged(r.force), averaged(r.speed)
    return np.array([force, speed, averaged(surface), averaged(r.power) / (2.0 * radius * averaged(r.force * r.speed))])


class FrictionFit:
    """Friction coefficient as a polynomial of force, speed and temperature, each normalised by its mean and spread: linear,
    and quadratic in temperature if that lowers the error on pieces of data left out in turn. ``rows``: of steady braking,
    (force N, speed rad/s, temperature degC, coefficient), shape (4, n). They are weighted by force, because the torque
    sensor's noise is constant."""

    def __init__(self, rows: np.ndarray):
        self._columns = rows[:3]
        force = rows[0]
        #: ``temperature_C``, ``measured`` and ``model``: of each row.
        self.temperature_C: np.ndarray = rows[2]
        self.measured: np.ndarray = rows[3]
        self._centre = self._columns.mean(axis=1)
        self._width = np.maximum(self._columns.std(axis=1), [1.0, 1e-3, 1e-3])
        self._weight = force / force.max()
        self._piece = np.arange(len(force)) * _PIECES // len(force)
        left_out = {bent: np.array([self._solve(self._piece != k, bent) for k in range(_PIECES)]) for bent in (False, True)}
        error = {bent: self._left_out_error(terms, bent) for bent, terms in left_out.items()}
        self._bent = error[True] < _WORTH_IT * error[False]
        self._terms = self._solve(np.ones(len(force), bool), self._bent)
        design = self._design(self._columns, self._bent)
        self.model: np.ndarray = design @ self._terms
        covariance = left_out_covariance(left_out[self._bent])
        #: Standard deviation of the coefficient at a typical row, pieces of data left out in turn.
        self.sigma: float = float(np.sqrt(np.mean(np.einsum("ti,ij,tj->t", design, covariance, design))))
        self.rms: float = rmse(self.model - self.measured, force**2)  #: of measured minus model, weighted by force

    def _design(self, columns, bent):
        u = [(column - c) / w for column, c, w in zip(columns, self._centre, self._width, strict=True)]
        return np.stack([np.ones_like(u[0]), *u] + ([u[2] ** 2 - 1.0] if bent else []), axis=-1)

    def _solve(self, use, bent):
        """Weighted least squares, with a prior of mean zero for each term but the first."""
        bend = [_EXPECTED_BEND * self._width[2] ** 2] if bent else []
        expected = np.array([1e3, *(_EXPECTED_SLOPES * self._width), *bend])
        weight = self._weight[use] / _ROW_SIGMA
        left = np.concatenate([self._design(self._columns[:, use], bent) * weight[:, None], np.diag(1.0 / expected)])
        return np.linalg.lstsq(left, np.concatenate([self.measured[use] * weight, 0.0 * expected]), rcond=None)[0]

    def _left_out_error(self, terms, bent):
        predicted = np.sum(self._design(self._columns, bent) * terms[self._piece], axis=1)
        return rmse(predicted - self.measured, self._weight**2)

    @property
    def values(self) -> dict[str, float]:
        """The table by the calibration's keys. Its grid runs evenly from standstill, zero force and the coldest surface to a
        quarter beyond the largest values measured; outside of the data it follows the smooth model, limited to values between
        a third of its value at the mean of the data and 1."""
        most, coldest = _BEYOND * self._columns.max(axis=1), float(self._columns[2].min())
        force, speed = np.linspace(0.0, most[0], FORCE_GRID), np.linspace(0.0, most[1], SPEED_GRID)
        hottest = coldest + _BEYOND * np.ptp(self._columns[2]) + 1.0
        temperature = np.linspace(coldest, hottest, TEMPERATURE_GRID)
        mesh = np.meshgrid(force, speed, temperature, indexing="ij")
        table = {
            "force_N": force,
            "disc_speed_rad_per_s": speed,
            "surface_temperature_C": temperature,
            "coefficient": np.clip(self._design(mesh, self._bent) @ self._terms, self._terms[0] / 3.0, 1.0),
        }
        return {
            f"thermal.friction.{name}" + "".join(f"[{index}]" for index in at): rounded(value, 5)
            for name, values in table.items()
            for at, value in np.ndenumerate(values)
        }

    @property
    def equation(self) -> str:
        """The smooth model, for the report."""
        slopes, centre = self._terms[1:4] / self._width, self._centre
        text = (
            f"μ = {self._terms[0]:.4f} {1e3 * slopes[0]:+.2e} (F − {1e-3 * centre[0]:.2f} kN)/kN"
            f" {slopes[1]:+.2e} (ω − {centre[1]:.1f} rad/s) s {slopes[2]:+.2e} (T − {centre[2]:.0f} °C)/K"
        )
        if self._bent:
            square = self._width[2] ** 2
            text += f" {self._terms[4] / square:+.1e} ((T − {centre[2]:.0f})² − {square:.0f})/K²"
        return text


def fit_friction(recordings: list[Recording], parameters: np.void) -> FrictionFit:
    """Friction coefficient from brake torque, clamp force and the modelled surface temperature (mean of both pads).

    A smooth model is tabulated, because a table filled from data would have empty corners. ``recordings``: those with
    `Recording.dense`; ``parameters``: PARAMETERS, pads and disc already identified. Raises InputError: too little steady
    braking."""
    rows = np.concatenate([_rows(r, parameters) for r in recordings], axis=1)
    if rows.shape[1] < _LEAST_ROWS:
        names = ", ".join(r.name for r in recordings)
        raise InputError(f"{names}: {rows.shape[1]} moments of steady braking; at least {_LEAST_ROWS} are needed for friction")
    return FrictionFit(rows)


def constant_friction(coefficient: float) -> FrictionTable:
    """A table of one constant coefficient, if no log shows more."""
    return FrictionTable(
        force_N=tuple(np.linspace(0.0, 3e4, FORCE_GRID).tolist()),
        disc_speed_rad_per_s=tuple(np.linspace(0.0, 50.0, SPEED_GRID).tolist()),
        surface_temperature_C=tuple(np.linspace(0.0, 400.0, TEMPERATURE_GRID).tolist()),
        coefficient=(((coefficient,) * TEMPERATURE_GRID,) * SPEED_GRID,) * FORCE_GRID,
    )


def figure(section: Section, found: FrictionFit) -> None:
    """Friction in the report, drawn over the last of its three variables."""
    section.heading("Friction of pad on disc, for service without a brake torque sensor")
    thin = slice(None, None, max(len(found.measured) // 1500, 1))
    temperature, measured, model = found.temperature_C[thin], found.measured[thin], found.model[thin]
    coefficient = [Trace("measured", temperature, measured, _CLOUD), Trace("map", temperature, model, _DOTS)]
    residual = [Trace("map", temperature, model - measured, _DOTS)]
    panels = [Panel("Friction coefficient", "1", coefficient, 260), Panel("Residual", "1", residual, 160)]
    section.figure(xy_figure(panels, "surface temperature / °C"), "Over clamp force, disc speed and surface temperature.")
