"""Pad-on-disc friction coefficient over clamp force, disc speed and surface temperature, for service (thesis 8.5)."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.calibration.types import FrictionTable
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID
from emb_daemon.identify.heat import Recording, simulate

#: Rows with less force or speed say more of the sensors' noise than of friction.
_LEAST_FORCE_N = 500.0
_LEAST_SPEED_RAD_PER_S = 1.0
#: Rows before and after that must brake as well, so that none averages over an edge.
_MARGIN = 2
#: Time over which rows are averaged: noise of the force would pass for a friction that falls with force.
_AVERAGE_S = 1.0
_LEAST_ROWS = 30
#: What a second's coefficient is worth, errors lasting for longer than that, and what is expected of its dependence on force
#: (1/N), speed (s/rad) and temperature (1/K): a log that varies one of them little says nothing of it.
_ROW_SIGMA = 0.01
_EXPECTED_SLOPES = (1e-5, 3e-3, 1e-3)
#: Bend with temperature that is expected, 1/K^2.
_EXPECTED_BEND = 5e-6
#: Pieces of the data that are left out in turn.
_PIECES = 8
#: By how much an added term must lower the error on pieces left out.
_WORTH_IT = 0.98
#: The table goes on this far beyond the largest force, speed and temperature that were measured.
_BEYOND = 1.25


@dataclass(frozen=True)
class FrictionFit:
    """Friction coefficient.

    Attributes:
        table: for the calibration. Its grid runs evenly from standstill, zero force and the coldest surface to a quarter
            beyond the largest values measured; what lies outside of the data follows the smooth model, held between a third
            of its value at the mean of the data and 1.
        equation: the smooth model, for the report.
        sigma: standard deviation of the coefficient at a typical grid point inside the data, pieces of data left out in turn.
        force_N, speed_rad_per_s, temperature_C, measured, model: of each row that was fitted.
        rms: of measured minus model, weighted by force.
    """

    table: FrictionTable
    equation: str
    sigma: float
    force_N: np.ndarray
    speed_rad_per_s: np.ndarray
    temperature_C: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    rms: float


def _rows(r: Recording, parameters: np.ndarray) -> np.ndarray:
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

    radius = float(parameters["effective_radius"][0])
    force, speed = averaged(r.force), averaged(r.speed)
    return np.array([force, speed, averaged(surface), averaged(r.power) / (2.0 * radius * averaged(r.force * r.speed))])


def _solve(design, coefficient, weight, expected):
    """Weighted least squares; each term but the first pulled to zero by what is expected of it."""
    pull = np.diag(1.0 / expected)
    left = np.concatenate([design * (weight / _ROW_SIGMA)[:, None], pull])
    right = np.concatenate([coefficient * weight / _ROW_SIGMA, np.zeros(len(expected))])
    return np.linalg.lstsq(left, right, rcond=None)[0]


def fit_friction(recordings: list[Recording], parameters: np.ndarray) -> FrictionFit:
    """Friction coefficient from brake torque, clamp force and the modelled surface temperature (mean of both pads).

    The friction power of a recording stands for torque times speed.

    A smooth model tabulated, because a table filled from data has empty corners: linear in force, speed and temperature, and
    bent in temperature where pieces of data left out in turn say so. Rows are weighted by force, the torque sensor's noise
    being constant.

    Args:
        recordings: those with `Recording.dense`.
        parameters: THERMAL, shape (1,), pads and disc already identified.

    Raises:
        InputError: too little steady braking.
    """
    force, speed, temperature, coefficient = np.concatenate([_rows(r, parameters) for r in recordings], axis=1)
    if len(force) < _LEAST_ROWS:
        names = ", ".join(r.name for r in recordings)
        raise InputError(f"{names}: {len(force)} moments of steady braking; at least {_LEAST_ROWS} are needed for friction")
    centre = np.array([force.mean(), speed.mean(), temperature.mean()])
    width = np.maximum([force.std(), speed.std(), temperature.std()], [1.0, 1e-3, 1e-3])

    def design(f, w, t, bent):
        u = [(f - centre[0]) / width[0], (w - centre[1]) / width[1], (t - centre[2]) / width[2]]
        return np.stack([np.ones_like(u[0]), *u] + ([u[2] ** 2 - 1.0] if bent else []), axis=-1)

    weight = force / force.max()

    def expected(bent):
        bend = [_EXPECTED_BEND * width[2] ** 2] if bent else []
        return np.array([1e3, *(_EXPECTED_SLOPES * width), *bend])

    piece = np.arange(len(force)) * _PIECES // len(force)
    errors, leave_out = {}, {}
    for bent in (False, True):
        columns = design(force, speed, temperature, bent)
        left = [
            _solve(columns[piece != k], coefficient[piece != k], weight[piece != k], expected(bent)) for k in range(_PIECES)
        ]
        predicted = np.array([columns[row] @ left[k] for row, k in enumerate(piece)])
        errors[bent], leave_out[bent] = np.average((predicted - coefficient) ** 2, weights=force**2), left
    bent = errors[True] < _WORTH_IT**2 * errors[False]
    columns = design(force, speed, temperature, bent)
    terms = _solve(columns, coefficient, weight, expected(bent))
    deviation = columns @ (np.array(leave_out[bent]) - terms).T
    sigma = np.sqrt((_PIECES - 1) / _PIECES * np.mean(np.sum(deviation**2, axis=1)))

    grid_force = np.linspace(0.0, _BEYOND * force.max(), FORCE_GRID)
    grid_speed = np.linspace(0.0, _BEYOND * speed.max(), SPEED_GRID)
    coldest = float(temperature.min())
    grid_temperature = np.linspace(coldest, coldest + _BEYOND * np.ptp(temperature) + 1.0, TEMPERATURE_GRID)
    mesh = np.meshgrid(grid_force, grid_speed, grid_temperature, indexing="ij")
    values = np.clip(design(*mesh, bent) @ terms, terms[0] / 3.0, 1.0)

    slopes = terms[1:4] / width
    equation = (
        f"μ = {terms[0]:.4f} {1e3 * slopes[0]:+.2e} (F − {1e-3 * centre[0]:.2f} kN)/kN"
        f" {slopes[1]:+.2e} (ω − {centre[1]:.1f} rad/s) s {slopes[2]:+.2e} (T − {centre[2]:.0f} °C)/K"
    )
    if bent:
        equation += f" {terms[4] / width[2] ** 2:+.1e} ((T − {centre[2]:.0f})² − {width[2] ** 2:.0f})/K²"
    model = columns @ terms
    return FrictionFit(
        table=FrictionTable(
            force_N=tuple(_short(grid_force)),
            disc_speed_rad_per_s=tuple(_short(grid_speed)),
            surface_temperature_C=tuple(_short(grid_temperature)),
            coefficient=tuple(tuple(tuple(_short(line)) for line in plane) for plane in values),
        ),
        equation=equation,
        sigma=float(sigma),
        force_N=force,
        speed_rad_per_s=speed,
        temperature_C=temperature,
        measured=coefficient,
        model=model,
        rms=float(np.sqrt(np.average((model - coefficient) ** 2, weights=force**2))),
    )


def _short(values) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


def constant_friction(coefficient: float) -> FrictionTable:
    """A table that holds one coefficient, for when no log tells more."""
    return FrictionTable(
        force_N=tuple(_short(np.linspace(0.0, 3e4, FORCE_GRID))),
        disc_speed_rad_per_s=tuple(_short(np.linspace(0.0, 50.0, SPEED_GRID))),
        surface_temperature_C=tuple(_short(np.linspace(0.0, 400.0, TEMPERATURE_GRID))),
        coefficient=(((coefficient,) * TEMPERATURE_GRID,) * SPEED_GRID,) * FORCE_GRID,
    )
