"""Plain twins of the kernels: other algorithms or other people's code for the same answer."""

import numpy as np
from scipy.integrate import quad
from scipy.interpolate import RegularGridInterpolator
from scipy.linalg import expm


def characteristic_curve(x, coefficients):
    curve = np.polynomial.Polynomial([0.0, *coefficients])
    return (curve(x), curve.deriv()(x)) if x > 0.0 else (0.0, 0.0)


def first_order_lag(state, before, now, dt, time_constant):
    """Matrix exponential of the lag together with the ramp that drives it."""
    slope = (now - before) / dt
    a = np.array([[-1.0 / time_constant, 1.0 / time_constant, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    return (expm(a * dt) @ [state, before, slope])[0]


def friction_state(state, travel, presliding_angle):
    """State after the travel and its mean over it, by quadrature of the relaxation over the path."""
    direction = np.sign(travel)

    def along(distance):
        return direction + (state - direction) * np.exp(-distance / presliding_angle)

    mean = quad(along, 0.0, abs(travel), epsabs=1e-13)[0] / abs(travel)
    return along(abs(travel)), mean


def predict_errors(x, P, decay, noise_decay, noise_variance, walked):
    """Order of the states as in `models.fusion`: FAST first, NOISE fourth."""
    transition = np.eye(len(x))
    transition[0, 0], transition[3, 3] = decay, noise_decay
    noise = np.diag(walked)
    noise[0, 0] += 1.0 - decay**2
    noise[3, 3] += (1.0 - noise_decay**2) * noise_variance
    return transition @ x, transition @ P @ transition.T + noise


def update_errors(x, P, innovation, h, variance):
    """Joseph's form: the same for an optimal gain, by another way."""
    s = h @ P @ h + variance
    gain = P @ h / s
    rest = np.eye(len(x)) - np.outer(gain, h)
    return x + gain * innovation, rest @ P @ rest.T + variance * np.outer(gain, gain), s


def heat_matrices(p, pads, disc, ambient, braking, wheel_speed):
    """Heat capacities (J/K), conductances between nodes (W/K, symmetric), to the surroundings, and to backing plates.

    Nodes 0..n-1 are the inner pad from its friction surface, n..2n-1 the outer one, 2n the disc."""
    positions, area = p["node_position"], p["area"]
    nodes = len(positions)
    edges = np.concatenate([[0.0], 0.5 * (positions[1:] + positions[:-1]), [positions[-1]]])
    capacity, between = np.zeros(2 * nodes + 1), np.zeros((2 * nodes + 1, 2 * nodes + 1))
    for side in range(2):
        temperatures, first = pads[side], side * nodes
        specific_heat = p["specific_heat"] * (1.0 + p["specific_heat_rise"] * (temperatures - 20.0))
        capacity[first : first + nodes] = p["density"] * specific_heat * area * np.diff(edges)
        for node in range(nodes - 1):
            k = p["conductivity"] * (1.0 + p["conductivity_rise"] * (np.mean(temperatures[node : node + 2]) - 20.0))
            between[first + node, first + node + 1] = k * area / (positions[node + 1] - positions[node])
        between[first, 2 * nodes] = area * p["contact_conductance" if braking else "gap_conductance"]
    capacity[2 * nodes] = p["disc_heat_capacity"]
    plates, outside = np.zeros(2 * nodes + 1), np.zeros(2 * nodes + 1)
    plates[[nodes - 1, 2 * nodes - 1]] = p["backplate_conductance"] * area
    if not braking:
        outside[[0, nodes]] = p["surface_cooling_per_speed"] * wheel_speed * area
    hot, cold = disc + 273.15, ambient + 273.15
    radiation = (
        5.670374419e-8 * p["disc_radiating_area"] * (hot**4 - cold**4) / (hot - cold)
        if hot != cold
        else (4.0 * 5.670374419e-8 * p["disc_radiating_area"] * hot**3)
    )
    outside[2 * nodes] = p["disc_cooling"] + p["disc_cooling_per_speed"] * wheel_speed + radiation
    return capacity, between + between.T, outside, plates


def heat_step(p, pads, disc, inner_backplate, outer_backplate, ambient, power, braking, wheel_speed, dt):
    """One implicit Euler step as a dense system; returns (pads, disc)."""
    nodes = len(p["node_position"])
    capacity, between, outside, plates = heat_matrices(p, pads, disc, ambient, braking, wheel_speed)
    before = np.concatenate([pads[0], pads[1], [disc]])
    source = np.zeros(2 * nodes + 1)
    source[0], source[nodes] = p["heat_share"] * power
    source[2 * nodes] = (1.0 - p["heat_share"].sum()) * power
    source[:nodes] += plates[:nodes] * inner_backplate
    source[nodes:] += plates[nodes:] * outer_backplate
    source += outside * ambient
    matrix = np.diag(capacity / dt + between.sum(axis=1) + outside + plates) - between
    after = np.linalg.solve(matrix, capacity / dt * before + source)
    return np.array([after[:nodes], after[nodes : 2 * nodes]]), after[2 * nodes]


def friction_power(p, force, wheel_speed, surface):
    if force <= 0.0 or wheel_speed <= 0.0:
        return 0.0
    grids = [p["friction_force"], p["friction_speed"], p["friction_temperature"]]
    point = [np.clip(value, grid[0], grid[-1]) for value, grid in zip((force, wheel_speed, surface), grids, strict=True)]
    friction = RegularGridInterpolator(grids, p["friction_coefficient"])(point)[0]
    return 2.0 * friction * p["effective_radius"] * force * wheel_speed
