"""Heat in the pads and the disc, one dimension, implicit and conservative.

Thesis 7.4 to 7.6 and 8.1 to 8.2. The thesis marches each pad explicitly with a measured or assumed friction surface; here
the backing plates, both pads and the disc form one chain

    backing plate (measured) | inner pad | disc | outer pad | backing plate (measured)

solved in one tridiagonal sweep, stable for any time step. Nodes stand on the friction surface (0) and the backing plate
(last); each owns the material up to half way to its neighbours and heat crosses between two nodes once, so that what one
loses the other gains, for any k(T) and C(T).
"""

from typing import NamedTuple

import numpy as np

from emb_daemon.jit import Floats, Record, njit

STEFAN_BOLTZMANN = 5.670374419e-8
KELVIN = 273.15
REFERENCE_C = 20.0

#: Nodes through one pad. `mesh` puts them densest at the friction surface.
NODES = 13
CHAIN = 2 * NODES + 1
_GROWTH = 1.1
#: Longest step that `heat_step` takes at once: for accuracy, any is stable.
LONGEST_S = 0.25


class Altered(NamedTuple):
    """How effects alter the heat balance: factors, and additional heat (W).

    Attributes:
        heat_share: on the share of the friction power that goes into the pads; the disc gets the rest.
        contact, gap: on the conductance between pads and disc while they press on it, and across the gap.
        conductivity: on that of the pads.
        cooling: on the disc's convection.
        pad_W, disc_W: into the friction surfaces of both pads together, and into the disc.
    """

    heat_share: float
    contact: float
    gap: float
    conductivity: float
    cooling: float
    pad_W: float
    disc_W: float


UNALTERED = Altered(1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0)


def mesh(thickness: float) -> np.ndarray:
    """Node positions (m, shape (NODES,)) from the friction surface to the backing plate, spacing growing by a tenth.

    A larger growth would resolve the surface better, and the region of thermocouples near the backing plate worse.
    """
    steps = _GROWTH ** np.arange(NODES - 1)
    return np.concatenate([[0.0], np.cumsum(steps / steps.sum())]) * thickness


@njit
def at_depth(temperatures: Floats, positions: Floats, depth: float) -> float:
    """Temperature at ``depth`` m from the friction surface; NaN beyond the pad.

    A cubic through the four nodes around it: linear interpolation would have a larger error than the mesh itself.
    """
    if depth > positions[-1] + 1e-9:
        return np.nan
    node = 0
    while node < len(positions) - 2 and positions[node + 1] < depth:
        node += 1
    first = min(max(node - 1, 0), len(positions) - 4)
    total = 0.0
    for i in range(first, first + 4):
        weight = 1.0
        for j in range(first, first + 4):
            if j != i:
                weight *= (depth - positions[j]) / (positions[i] - positions[j])
        total += weight * temperatures[i]
    return total


@njit
def mean_temperature(temperatures: Floats, positions: Floats) -> float:
    """Mean over the thickness."""
    total = 0.0
    for node in range(len(positions) - 1):
        total += 0.5 * (temperatures[node] + temperatures[node + 1]) * (positions[node + 1] - positions[node])
    return total / positions[-1]


@njit
def conductance(p: Record, below: float, above: float, distance: float) -> float:
    """W/(m^2 K) between two nodes at temperatures ``below`` and ``above``, for k = k0 (1 + k1 (T - 20 degC))."""
    return p.conductivity * (1.0 + p.conductivity_rise * (0.5 * (below + above) - REFERENCE_C)) / distance


@njit
def disc_loss(p: Record, disc: float, ambient: float, wheel_speed: float, convection: float) -> float:
    """W/K from disc to surroundings: convection rising with wheel speed (rad/s; thesis 8.2), times a factor, and radiation."""
    hot, cold = disc + KELVIN, ambient + KELVIN
    radiation = p.disc_radiating_area * STEFAN_BOLTZMANN * (hot + cold) * (hot * hot + cold * cold)
    return convection * (p.disc_cooling + p.disc_cooling_per_speed * wheel_speed) + radiation


@njit
def _pad_rows(p, pad, side, backplate, to_disc, to_air, heating, ambient, altered, dt, work):
    """Heat balance of each node of one pad, over a unit of area: three diagonals, W/(m^2 K), and right-hand side, W/m^2.

    ``to_disc`` and ``to_air`` W/(m^2 K) leave the friction surface, into which ``heating`` W/m^2 goes."""
    lower, diagonal, upper, right = work[0], work[1], work[2], work[3]
    positions = p.node_position
    for node in range(NODES):
        below = positions[node] - positions[node - 1] if node > 0 else 0.0
        above = positions[node + 1] - positions[node] if node < NODES - 1 else 0.0
        per_volume = p.density * p.specific_heat * (1.0 + p.specific_heat_rise * (pad[node] - REFERENCE_C))
        capacity = per_volume * 0.5 * (below + above) / dt
        balance, source = capacity, capacity * pad[node]
        if node > 0:
            inwards = altered.conductivity * conductance(p, pad[node - 1], pad[node], below)
        else:
            inwards = to_disc
            balance += to_air
            source += heating + to_air * ambient
        balance += inwards
        outwards = 0.0
        if node < NODES - 1:
            outwards = altered.conductivity * conductance(p, pad[node], pad[node + 1], above)
            balance += outwards
        else:
            balance += p.backplate_conductance
            source += p.backplate_conductance * backplate
        # The chain runs from the inner backing plate over the disc (row NODES) to the outer one.
        row = NODES - 1 - node if side == 0 else NODES + 1 + node
        diagonal[row] = balance
        right[row] = source
        lower[row] = -outwards if side == 0 else -inwards
        upper[row] = -inwards if side == 0 else -outwards


@njit
def _solve(lower, diagonal, upper, right):
    """Solve a tridiagonal system by elimination (Thomas); the solution replaces ``right``."""
    for row in range(1, CHAIN):
        factor = lower[row] / diagonal[row - 1]
        diagonal[row] -= factor * upper[row - 1]
        right[row] -= factor * right[row - 1]
    right[CHAIN - 1] /= diagonal[CHAIN - 1]
    for row in range(CHAIN - 2, -1, -1):
        right[row] = (right[row] - upper[row] * right[row + 1]) / diagonal[row]


@njit
def _chain_step(p, pads, disc, inner_backplate, outer_backplate, ambient, power, braking, wheel_speed, dt, work, altered):
    """One implicit step of ``dt`` seconds; changes ``pads`` (2, NODES) and returns the new disc temperature."""
    lower, diagonal, upper, right = work[0], work[1], work[2], work[3]
    contact = altered.contact * p.contact_conductance if braking else altered.gap * p.gap_conductance
    to_air = 0.0 if braking else p.surface_cooling_per_speed * wheel_speed
    # No more than all of the friction power goes into the pads.
    more = min(altered.heat_share, 1.0 / max(p.heat_share[0] + p.heat_share[1], 1e-9))
    for side in range(2):
        backplate = inner_backplate if side == 0 else outer_backplate
        heating = (more * p.heat_share[side] * power + 0.5 * altered.pad_W) / p.area
        _pad_rows(p, pads[side], side, backplate, contact, to_air, heating, ambient, altered, dt, work)
    loss = disc_loss(p, disc, ambient, wheel_speed, altered.cooling) / p.area
    storage = p.disc_heat_capacity / (p.area * dt)
    diagonal[NODES] = storage + 2.0 * contact + loss
    heating = (1.0 - more * p.heat_share[0] - more * p.heat_share[1]) * power + altered.disc_W
    right[NODES] = storage * disc + loss * ambient + heating / p.area
    lower[NODES] = upper[NODES] = -contact
    _solve(lower, diagonal, upper, right)
    for node in range(NODES):
        pads[0, node] = right[NODES - 1 - node]
        pads[1, node] = right[NODES + 1 + node]
    return right[NODES]


@njit
def heat_step(
    p: Record, pads: Floats, disc: float, inner_backplate: float, outer_backplate: float, ambient: float, power: float,
    braking: bool, wheel_speed: float, dt: float, work: Floats, longest: float, altered: Altered,
) -> float:  # fmt: skip
    """Advance pads and disc by ``dt`` seconds.

    Args:
        p: THERMAL parameters record.
        pads: temperatures (degC), shape (2, NODES): inner and outer pad, friction surface first; changed in place.
        disc: disc temperature, degC.
        inner_backplate, outer_backplate: measured, degC.
        power: friction power of both pads, W, mean over the step.
        braking: pads press on the disc and exchange heat by contact; else across a gap, which the wheel ventilates.
        longest: length of a single step at most, s.
        work: scratch, shape (4, CHAIN).
        altered: what effects make of the balance, held over the step.

    Returns:
        The new disc temperature.
    """
    parts = int(np.ceil(dt / longest - 1e-9))
    for _ in range(parts):
        disc = _chain_step(
            p, pads, disc, inner_backplate, outer_backplate, ambient, power, braking, wheel_speed, dt / parts, work, altered
        )
    return disc


@njit
def friction_power(p: Record, force: float, wheel_speed: float, surface: float) -> float:
    """Friction power of both pads in W without a brake torque sensor (thesis 8.5).

    2 mu r F w, the friction coefficient interpolated from a table over clamp force (N), disc speed (rad/s) and surface
    temperature (degC), constant beyond its edges.
    """
    if force <= 0.0 or wheel_speed <= 0.0:
        return 0.0
    i, u = _cell(p.friction_force, force)
    j, v = _cell(p.friction_speed, wheel_speed)
    k, w = _cell(p.friction_temperature, surface)
    friction = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                share = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
                friction += share * p.friction_coefficient[i + a, j + b, k + c]
    return 2.0 * friction * p.effective_radius * force * wheel_speed


@njit
def _cell(grid, value):
    """Lower index and share of the upper one, for a value held inside an ascending grid."""
    last = len(grid) - 1
    if value <= grid[0]:
        return 0, 0.0
    if value >= grid[last]:
        return last - 1, 1.0
    index = 0
    while grid[index + 1] < value:
        index += 1
    return index, (value - grid[index]) / (grid[index + 1] - grid[index])


@njit
def stiffness_factor(p: Record, rise: float, history: float) -> float:
    """alpha: stiffness over that of the cold pads (thesis 8.4), from the mean pad temperature and its history.

    ``rise`` K is the present mean over the temperature at which the curve was identified (thesis T_p,c, equation 8-10; not
    the present ambient temperature, which is not that of the identification and can be lost); ``history`` K the same through a
    first-order lag, which forgets as the thesis's moving window does but needs one number instead of thousands.
    """
    return max(1.0 - p.softening * rise - p.softening_history * history, 0.1)
