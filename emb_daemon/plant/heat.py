"""Heat of pads, disc, backing plates and caliper: explicit finite volumes, cells of equal width, centred temperatures.

The estimator solves the same physics implicitly on graded nodes, with measured backing plates. Here the plates and the caliper
are states.
"""

from math import ceil

from emb_daemon.jit import Record, njit
from emb_daemon.plant.brake import COLD_C, drawn_amount
from emb_daemon.plant.records import CELLS
from emb_daemon.wire.contract import CYCLE_S

#: W/(m2 K4) (CODATA 2018), and 0 degC in K.
_STEFAN_BOLTZMANN, _KELVIN = 5.670374419e-8, 273.15
#: Temperature (degC) at which the properties and the friction of pads are stated, and width of a cell, m.
_REFERENCE_C, _CELL_M = 20.0, 0.0004


@njit
def cell_count(p: Record) -> int:
    """Cells in use through one pad: near 0.4 mm each."""
    return min(max(ceil(p.pad_thickness / _CELL_M), 5), CELLS)


@njit
def pad_mean(p: Record, s: Record, side: int) -> float:
    """Mean temperature of one pad."""
    cells = cell_count(p)
    total = 0.0
    for cell in range(cells):
        total += s.pads[side, cell]
    return total / cells


@njit
def pad_at(p: Record, s: Record, side: int, depth: float) -> float:
    """Temperature ``depth`` m below a pad's friction surface, linear between surface, cell centres and the plate's face;
    the pad's own plate face beyond its thickness."""
    cells = cell_count(p)
    width = p.pad_thickness / cells
    position = depth / width - 0.5
    if position <= 0.0:
        return s.surface[side] + (s.pads[side, 0] - s.surface[side]) * (position + 0.5) / 0.5
    lower = min(int(position), cells - 1)
    if lower == cells - 1:
        return s.pads[side, cells - 1]
    return s.pads[side, lower] + (position - lower) * (s.pads[side, lower + 1] - s.pads[side, lower])


@njit
def friction_of_pads(p: Record, s: Record, wheel_speed: float) -> float:
    """Friction coefficient between pads and disc."""
    surface = 0.5 * (s.surface[0] + s.surface[1])
    value = p.friction_coefficient + p.friction_per_K * (surface - _REFERENCE_C)
    value += p.friction_per_speed * wheel_speed + p.friction_per_force * s.force
    fade = p.effects.friction_coefficient_fade
    if fade.fade_per_K != 0.0:
        value *= max(1.0 - fade.fade_per_K * max(surface - fade.onset_C, 0.0), 0.2)
    value *= 1.0 + drawn_amount(p.effects.drawn_pad_friction, s, s.drawn.pad_friction, CYCLE_S)
    return max(value, 0.2 * p.friction_coefficient)


@njit
def _conduct(p, s, side, conductivity, flux):
    """Heat through one pad into its backing plate, from a ``flux`` (W/m2) into the surface; returns that into the caliper."""
    pad, cells = s.pads[side], cell_count(p)
    width = p.pad_thickness / cells
    for cell in range(cells):
        if cell < cells - 1:
            between = 0.5 * (pad[cell] + pad[cell + 1])
            onward = conductivity * (1.0 + p.conductivity_rise * (between - _REFERENCE_C)) / width
            onward *= pad[cell] - pad[cell + 1]
        else:
            half = 2.0 * conductivity * (1.0 + p.conductivity_rise * (pad[cell] - _REFERENCE_C)) / width
            onward = (pad[cell] - s.plate[side]) * half * p.plate_conductance / (half + p.plate_conductance)
        heat = p.density * p.specific_heat * (1.0 + p.specific_heat_rise * (pad[cell] - _REFERENCE_C)) * width
        pad[cell] += CYCLE_S * (flux - onward) / heat
        flux = onward
    lost = p.plate_loss[side] * (s.plate[side] - s.caliper)
    s.plate[side] += CYCLE_S * (flux - lost) / p.plate_heat_capacity
    lag = p.effects.thermocouple_lag.lag_s
    s.plate_reading[side] += (s.plate[side] - s.plate_reading[side]) * CYCLE_S / (lag + CYCLE_S)
    return p.pad_area * lost


@njit
def _heat_pads(p, s, power):
    """Friction ``power`` (W) into both pads, and what they exchange with the disc; returns heat (W) into disc and caliper."""
    e, d, dt = p.effects, s.drawn, CYCLE_S
    contact = p.contact_conductance * max(1.0 + drawn_amount(e.drawn_contact_conductance, s, d.contact_conductance, dt), 0.1)
    gap = p.gap_conductance * max(1.0 + drawn_amount(e.drawn_gap_conductance, s, d.gap_conductance, dt), 0.1)
    conductivity = p.conductivity * max(1.0 + drawn_amount(e.drawn_pad_conductivity, s, d.pad_conductivity, dt), 0.1)
    share = max(1.0 + drawn_amount(e.drawn_heat_share, s, d.heat_share, dt), 0.1)
    share = min(share, 1.0 / max(p.heat_share[0] + p.heat_share[1], 1e-9))
    conductance = gap + (contact - gap) * s.force / (s.force + p.touching_force)
    into_disc = (1.0 - share * p.heat_share[0] - share * p.heat_share[1]) * power
    into_disc += drawn_amount(e.drawn_disc_heat, s, d.disc_heat, dt)
    into_caliper = 0.0
    width = p.pad_thickness / cell_count(p)
    for side in range(2):
        outermost = s.pads[side, 0]
        direct = share * p.heat_share[side] * power / p.pad_area
        half = 2.0 * conductivity * (1.0 + p.conductivity_rise * (outermost - _REFERENCE_C)) / width
        # The surface stores no heat: inflow equals outflow.
        surface = (direct + conductance * s.disc + half * outermost) / (conductance + half)
        s.surface[side] = surface
        from_disc = conductance * (s.disc - surface)
        into_disc -= p.pad_area * from_disc
        into_caliper += _conduct(p, s, side, conductivity, direct + from_disc)
    return into_disc, into_caliper


@njit
def _heat_disc_and_caliper(p, s, into_disc, into_caliper, cooling, wheel_speed, ambient):
    """Both take up heat (W) and lose it to the surroundings, the disc ``cooling`` times as fast as usual by convection."""
    hot, cold = s.disc + _KELVIN, ambient + _KELVIN
    area = p.disc_radiating_area + p.effects.disc_radiation.area_m2
    loss = cooling * (p.disc_cooling + p.disc_cooling_per_speed * wheel_speed) * (s.disc - ambient)
    loss += area * _STEFAN_BOLTZMANN * (hot**4 - cold**4)
    s.disc += CYCLE_S * (into_disc - loss) / p.disc_heat_capacity
    caliper_loss = p.caliper_loss * (s.caliper - ambient)
    s.caliper += CYCLE_S * (into_caliper - caliper_loss) / p.caliper_heat_capacity
    s.heat_lost += CYCLE_S * (loss + caliper_loss)


@njit
def _heat_motor(p, s):
    """Two masses in a row, winding and housing with the magnets (Mellor, Roberts and Turner 1991), both over the caliper."""
    copper = p.magnet_heating * s.current * s.current * (1.0 + p.copper_per_K * s.winding_rise)
    s.winding_rise += CYCLE_S / (p.winding_time + CYCLE_S) * (copper - s.winding_rise)
    s.magnet_rise += CYCLE_S / p.magnet_time * (s.winding_rise - s.magnet_rise)


@njit
def _soften(p, s):
    """Stiffness over that of cold pads."""
    rise = s.pad_mean - p.curve_temperature
    s.softening_memory += CYCLE_S / p.history_time * (rise - s.softening_memory)
    factor = 1.0 - p.softening * rise - p.softening_history * s.softening_memory
    factor *= 1.0 - p.effects.caliper_softening.per_K * (s.caliper - COLD_C)
    s.stiffness_factor = max(factor, 0.1)


@njit
def heat_cycle(p: Record, s: Record, wheel_speed: float, ambient: float) -> None:
    """One 4 ms cycle of all temperatures, and of what depends on them: friction torque, wear, softening."""
    # Friction that depends on brake torque uses the torque of the previous cycle.
    s.brake_torque = 2.0 * friction_of_pads(p, s, wheel_speed) * p.effective_radius * s.force if wheel_speed > 0.0 else 0.0
    power = s.brake_torque * wheel_speed
    s.friction_heat += power * CYCLE_S
    s.wear += 1e-12 * p.effects.pad_wear.wear_um_per_MJ * power * CYCLE_S
    # Drawn effects follow the temperatures at the cycle's start.
    cooling = max(1.0 + drawn_amount(p.effects.drawn_disc_cooling, s, s.drawn.disc_cooling, CYCLE_S), 0.1)
    into_disc, into_caliper = _heat_pads(p, s, power)
    _heat_disc_and_caliper(p, s, into_disc, into_caliper, cooling, wheel_speed, ambient)
    _heat_motor(p, s)
    s.wheel_speed, s.pad_mean = wheel_speed, 0.5 * (pad_mean(p, s, 0) + pad_mean(p, s, 1))
    _soften(p, s)
