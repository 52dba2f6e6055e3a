"""Records that the estimator reads and writes: parameters, state, sample, estimate. SI units; temperatures in degC."""

import numpy as np

from emb_daemon.effects import REGISTRY, parameter_record, state_record
from emb_daemon.estimator.consistency import CONSISTENCY
from emb_daemon.estimator.hypotheses import ALTERNATIVE, ALTERNATIVES
from emb_daemon.estimator.monitor import MONITOR
from emb_daemon.estimator.wheel import WHEEL
from emb_daemon.models.contact import CONTACT
from emb_daemon.models.fusion import STATES
from emb_daemon.models.plausibility import PLAUSIBILITY
from emb_daemon.models.thermal import CHAIN, NODES

CURVE_TERMS = 5
FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID = 6, 6, 8

#: Depths from the friction surface at which pad temperatures are told, m.
DEPTHS_M = (0.002, 0.004, 0.006, 0.008)

#: Parameters of pad and disc heat (models/thermal.py). Conductances in W/(m^2 K), areas in m^2.
THERMAL = np.dtype(
    [
        ("conductivity", "f8"),
        ("conductivity_rise", "f8"),
        ("density", "f8"),
        ("specific_heat", "f8"),
        ("specific_heat_rise", "f8"),
        ("area", "f8"),
        ("thickness", "f8"),
        ("node_position", "f8", (NODES,)),
        ("heat_share", "f8", (2,)),
        ("contact_conductance", "f8"),
        ("gap_conductance", "f8"),
        ("surface_cooling_per_speed", "f8"),
        ("backplate_conductance", "f8"),
        ("disc_heat_capacity", "f8"),
        ("disc_cooling", "f8"),
        ("disc_cooling_per_speed", "f8"),
        ("disc_radiating_area", "f8"),
        ("effective_radius", "f8"),
        ("friction_force", "f8", (FORCE_GRID,)),
        ("friction_speed", "f8", (SPEED_GRID,)),
        ("friction_temperature", "f8", (TEMPERATURE_GRID,)),
        ("friction_coefficient", "f8", (FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID)),
        ("softening", "f8"),
        ("softening_history", "f8"),
        ("history_time", "f8"),
        ("reference", "f8"),
        ("sigma", "f8"),
    ],
    align=True,
)

#: Parameters of one corner. ``*_sigma`` are standard deviations; ``gear_gain`` and ``load_friction`` in m/rad.
PARAMETERS = np.dtype(
    [
        ("gear_gain", "f8"),
        ("torque_constant", "f8"),
        ("inertia", "f8"),
        ("load_friction", "f8"),
        ("offset_friction", "f8"),
        ("presliding_angle", "f8"),
        ("curve", "f8", (CURVE_TERMS,)),
        ("relaxation_time", "f8"),
        ("clearance", "f8"),
        ("clearance_sigma", "f8"),
        ("maximum_force", "f8"),
        ("maximum_speed", "f8"),
        ("stiffness_sigma", "f8"),
        ("stiffness_relative_sigma", "f8"),
        ("stiffness_correlation_time", "f8"),
        ("current_sigma", "f8"),
        ("current_correlation_time", "f8"),
        ("speed_sigma", "f8"),
        ("presliding_sigma", "f8"),
        ("torque_relative_sigma", "f8"),
        ("contact_walk", "f8"),
        ("thermal", THERMAL),
        ("effects", parameter_record(REGISTRY)),
    ],
    align=True,
)

#: One row for the estimator. It is a resolver sample, or asks for a prediction ``age_cycles`` after the last
#: one. ``dt`` s since the last sample; ``cycle`` its number since the first, ``elapsed_cycles`` since the last row;
#: ``reasons`` what is amiss outside the estimator. ``brake_torque`` N m is a rig's, NaN in a car.
SAMPLE = np.dtype(
    [
        ("time_ns", "i8"),
        ("cycle", "i8"),
        ("elapsed_cycles", "i8"),
        ("age_cycles", "i8"),
        ("corner", "i8"),
        ("counter", "i8"),
        ("reasons", "i8"),
        ("is_prediction", "?"),
        ("dt", "f8"),
        ("angle", "f8"),
        ("speed", "f8"),
        ("current_q", "f8"),
        ("inner_backplate", "f8"),
        ("outer_backplate", "f8"),
        ("caliper", "f8"),
        ("ambient", "f8"),
        ("wheel_speed", "f8"),
        ("wheel_pulse", "f8"),
        ("vehicle_speed", "f8"),
        ("park_brake", "f8"),
        ("brake_request", "f8"),
        ("brake_torque", "f8"),
        ("has_current", "?"),
        ("has_thermocouple", "?"),
        ("has_wheel_speed", "?"),
        ("has_wheel_pulse", "?"),
        ("has_status", "?"),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("started", "?"),
        # Whether the contact angle is unknown since the start, and what the release that ends it is known by.
        ("unknown", "?"),
        ("seen", "?"),
        # Whether it goes on from a snapshot, whose heat is ``rested_s`` s old; clearance that counts from the released
        # position.
        ("resumed", "?"),
        ("rested_s", "f8"),
        ("clearance", "f8"),
        ("clearance_sigma", "f8"),
        ("since_start_s", "f8"),
        ("still_s", "f8"),
        ("start_angle", "f8"),
        ("passed", "f8"),
        ("opposing", "f8"),
        ("angle", "f8"),
        ("speed", "f8"),
        ("angle_before", "f8"),
        ("dt_before", "f8"),
        ("contact_angle", "f8"),
        # Stiffness path: static force (inputs of the lag) at the last sample, and the lag's output.
        ("past_contact", "f8"),
        ("drive", "f8"),
        ("drive_slope", "f8"),
        ("force", "f8"),
        ("slope", "f8"),
        # Torque path.
        ("friction_state", "f8"),
        ("slid_angle", "f8"),
        ("friction_mean", "f8"),
        ("friction_variance", "f8"),
        ("torque_age", "f8"),
        ("balance", "f8"),
        ("leverage", "f8"),
        ("contact", CONTACT),
        ("plausibility", PLAUSIBILITY),
        # Fusion.
        ("error", "f8", (STATES,)),
        ("covariance", "f8", (STATES, STATES)),
        ("alternatives", ALTERNATIVE, (ALTERNATIVES,)),
        ("open_s", "f8"),
        ("sensitivity", "f8", (2, STATES)),
        # Stiffness over the calibration's, and contact angle that each kelvin of disc temperature over ``growth_start`` (degC)
        # takes away, rad/K: learned.
        ("gain", "f8", (STATES,)),
        ("current_before", "f8"),
        ("had_current", "?"),
        ("no_current_s", "f8"),
        ("trusted", "?"),
        ("contact_anchor", "f8"),
        ("scale", "f8"),
        ("growth", "f8"),
        ("growth_start", "f8"),
        # Heat of winding and housing: share of what the largest force's current would leave for ever.
        ("winding", "f8"),
        ("housing", "f8"),
        ("consistency", CONSISTENCY),
        # Heat. What flowed since the last heat step; profiles, and what the estimate tells of them.
        ("monitor", MONITOR),
        ("wheel", WHEEL),
        ("heat_time", "f8"),
        ("heat_energy", "f8"),
        ("heat_travel", "f8"),
        ("touching", "?"),
        ("pads", "f8", (2, NODES)),
        ("disc", "f8"),
        ("mean", "f8", (2,)),
        ("depth", "f8", (2, len(DEPTHS_M))),
        # Friction power of both pads over the last cycle, W.
        ("power", "f8"),
        ("history", "f8"),
        ("ambient", "f8"),
        ("factor", "f8"),
        # Standard deviations, K, left from a start with hot pads.
        ("temperature_sigma", "f8"),
        ("history_sigma", "f8"),
        ("temperature_known", "?"),
        # Backing plates: last readings, degC, the pads' mean temperatures when they last moved, what these have gained
        # since over time, K s, and whether a reading is stuck.
        ("plate", "f8", (2,)),
        ("plate_mean", "f8", (2,)),
        ("unanswered", "f8", (2,)),
        ("plate_stuck", "?"),
        ("work", "f8", (4, CHAIN)),
        ("effects", state_record(REGISTRY)),
        # Last answer, which predictions start from.
        ("fused", "f8"),
        ("fused_sigma", "f8"),
        ("rate", "f8"),
    ],
    align=True,
)

ESTIMATE = np.dtype(
    [
        ("time_ns", "i8"),
        ("cycle", "i8"),
        ("elapsed_cycles", "i8"),
        ("age_cycles", "i8"),
        ("corner", "i8"),
        ("counter", "i8"),
        ("mode", "i8"),
        ("source", "i8"),
        ("reasons", "i8"),
        ("is_sample", "?"),
        ("engaged", "?"),
        ("adapt_request", "i8"),
        ("adapt_progress", "i8"),
        ("adapt_result", "i8"),
        ("force", "f8"),
        ("sigma", "f8"),
        ("stiffness_force", "f8"),
        ("stiffness_sigma", "f8"),
        ("torque_force", "f8"),
        ("torque_sigma", "f8"),
        ("ml_force", "f8"),
        ("contact_angle", "f8"),
        ("contact_sigma", "f8"),
        ("stiffness_factor", "f8"),
        ("innovation", "f8"),
        ("innovation_sigma", "f8"),
        ("surface", "f8", (2,)),
        ("mean", "f8", (2,)),
        ("depth", "f8", (2, len(DEPTHS_M))),
        ("disc", "f8"),
    ],
    align=True,
)


def new_state(count: int = 1) -> np.ndarray:
    """States of estimators that have seen nothing."""
    return np.zeros(count, STATE)
