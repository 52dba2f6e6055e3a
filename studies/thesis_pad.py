"""One pad as the thesis computes it, for comparison: explicit steps, a surface temperature that does not fall while braking
and follows the disc once released (7.6, 8.1, 8.2)."""

from math import ceil, exp

import numpy as np

from emb_daemon.jit import njit
from emb_daemon.models.thermal import REFERENCE_C

#: Space step of the thesis, m.
SPACE_STEP_M = 2e-3
#: Fourier number that no explicit step may pass; the thesis allows 1/2.
_FOURIER = 0.4


def thesis_nodes(thickness: float) -> int:
    """Nodes at a space step as near to the thesis's as an even division of ``thickness`` m allows; at least 3."""
    return max(round(thickness / SPACE_STEP_M), 2) + 1


@njit
def thesis_pad_step(p, pad, backplate, ambient, flux, braking, disc_rate, dt):
    """Advance one pad by ``dt`` seconds, in explicit steps as short as stability asks.

    Equations 7-3a (interior) and 7-3b (surface) with k taken at the node; not conservative for a k that varies.

    Args:
        p: THERMAL record: conductivity and its rise, density, specific heat, thickness.
        pad: temperatures (degC) at evenly spaced nodes, friction surface first; changed in place.
        backplate: measured, degC: the last node has it.
        flux: into the friction surface while braking, W/m^2: share of the friction power over the area.
        braking: else the surface follows the cooling disc.
        disc_rate: b_d of the disc, 1/s (equation 8-7).
    """
    nodes = len(pad)
    space = p.thickness / (nodes - 1)
    diffusivity = 1.0 / (p.density * p.specific_heat)
    fastest = 0.0
    for node in range(nodes):
        fastest = max(fastest, p.conductivity * (1.0 + p.conductivity_rise * (pad[node] - REFERENCE_C)))
    parts = max(ceil(fastest * diffusivity * dt / (space * space * _FOURIER)), 1)
    part = dt / parts
    for _ in range(parts):
        before = pad[0]
        conductivity = p.conductivity * (1.0 + p.conductivity_rise * (before - REFERENCE_C))
        fourier = conductivity * diffusivity * part / (space * space)
        surface = 2.0 * fourier * (pad[1] + space * flux / conductivity) + (1.0 - 2.0 * fourier) * before
        if braking:
            # The disc keeps the surface from cooling (equation 8-1).
            surface = max(surface, before)
        else:
            surface = (before - ambient) * exp(-disc_rate * part) + ambient
        pad[0] = surface
        pad[nodes - 1] = backplate
        left = before
        for node in range(1, nodes - 1):
            here = pad[node]
            fourier = (
                p.conductivity * (1.0 + p.conductivity_rise * (here - REFERENCE_C)) * diffusivity * part / (space * space)
            )
            pad[node] = fourier * (left + pad[node + 1]) + (1.0 - 2.0 * fourier) * here
            left = here


@njit
def thesis_pad_run(p, pad, backplate, ambient, flux, braking, disc_rate, dt, profiles):
    """`thesis_pad_step` over arrays of shape (n,); ``profiles`` (n, nodes) holds the temperatures at each time."""
    for row in range(len(flux)):
        if row > 0:
            thesis_pad_step(p[0], pad, backplate[row], ambient[row], flux[row - 1], braking[row - 1], disc_rate[row - 1], dt)
        profiles[row] = pad


def thesis_profiles(
    p: np.ndarray,
    backplate: np.ndarray,
    ambient: np.ndarray,
    flux: np.ndarray,
    braking: np.ndarray,
    disc_rate: np.ndarray,
    dt: float,
) -> np.ndarray:
    """Pad temperatures (n, nodes) of the thesis's model, started at the backing plate's temperature. ``p``: THERMAL, shape
    (1,); ``backplate``, ``ambient``: degC, shape (n,); ``flux``, ``braking``, ``disc_rate``: W/m^2, bool and 1/s over the step
    that starts at each row."""
    nodes = thesis_nodes(float(p["thickness"][0]))
    profiles = np.empty((len(flux), nodes))
    thesis_pad_run(p, np.full(nodes, backplate[0]), backplate, ambient, flux, braking, disc_rate, dt, profiles)
    return profiles
