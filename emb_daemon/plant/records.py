"""Records of the plant. SI units, temperatures in degC; parameters state their unit and meaning."""

import numpy as np

from emb_daemon.effects import REGISTRY
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.jit import fields
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.layout import SLOTS

#: Integration steps in one 4 ms cycle.
SUBSTEPS = 16
SUBSTEP_S = 1e-9 * CYCLE_NS / SUBSTEPS
#: Cells through one pad at most.
CELLS = 30
#: Number of past sub-steps of motor angle and current that are stored, for sensors with a delay.
HISTORY = 64
CURVE_TERMS = 5
#: Points of the travel of a gear that is not constant, linear between them.
TRAVEL_POINTS = 257


#: Places where drawn effects enter.
DRAWN = (
    "stiffness", "thickness", "torque_constant", "gear_friction", "gear_gain", "pad_friction", "contact_conductance",
    "gap_conductance", "disc_cooling", "heat_share", "disc_heat", "pad_conductivity",
)  # fmt: skip

#: Effects that a plant can have, all off at zero, with the names of their parameters. The catalogue's have its names and
#: units; their physics is the plant's own. The others are not in the catalogue, so that a diagnosis can be tested on unknown
#: effects:
#:
#:     clamp_creep            share of the force that creeps in, with a time constant of tens of seconds
#:     brake_torque_coupling  relative gain of clamp force with brake torque, 1/(N m)
#:     caliper_softening      relative loss of stiffness as the caliper warms over 22 degC, 1/K
#:     spindle_lead_error     travel error, um, over the spindle's turn, whose order is periods per motor turn
#:     fastest_closing        relative gain of stiffness with the fastest closing of late, per (100 rad/s)^exponent; it is
#:                            forgotten with a time constant
#:     cold_grease            relative rise of gear friction as the caliper cools below 22 degC, 1/K, and viscous friction at
#:                            12 degC, N m s/rad, which doubles every further 10 K down
#:     current_delay          s by which the mean of the measured current ends early, up to 12 ms
#:     drawn_PLACE            drawn by a seed: size × shape(signal) × other signal, through a lag; signals by their index in
#:                            `brake.SIGNALS`, ``other`` negative for none, shapes as in `brake`. ``size`` is what is added
#:                            where the signals are at their usual sizes: um of disc and pads (thickness), W (disc_heat), or
#:                            the change of a factor
EFFECTS: dict[str, tuple[str, ...]] = {
    **{effect.name: tuple(parameter.name for parameter in effect.parameters) for effect in REGISTRY},
    "clamp_creep": ("share", "time_constant_s"),
    "brake_torque_coupling": ("per_Nm",),
    "caliper_softening": ("per_K",),
    "spindle_lead_error": ("amplitude_um", "order_per_turn", "phase_rad"),
    "fastest_closing": ("share", "exponent", "recovery_s"),
    "cold_grease": ("per_K", "viscous_Nms_per_rad"),
    "current_delay": ("delay_s",),
    **dict.fromkeys((f"drawn_{place}" for place in DRAWN), ("size", "signal", "shape", "exponent", "other", "lag_s")),
}  # fmt: skip

EFFECT_VALUES = np.dtype([(name, fields("f8", " ".join(names))) for name, names in EFFECTS.items()], align=True)

#: Parameters of one corner's brake: name, unit, meaning and, of an array, its shape.
PLANT_FIELDS = (
    ("torque_constant", "N m/A", "motor torque per torque-producing current at 25 degC"),
    ("inertia", "kg m2", "motor and gear, at the motor shaft"),
    ("gear_gain", "m/rad", "clamp travel per motor angle; torque per clamp force"),
    ("travel_angle", "rad", "motor angles past the released position of a gear that is not constant", (TRAVEL_POINTS,)),
    ("travel", "m", "clamp travel there, rising straight on beyond; all zero for a constant gear", (TRAVEL_POINTS,)),
    ("release_spring", "N/m", "force on the gear's output per travel from the released position"),
    ("maximum_speed", "rad/s", "motor speed at which the supply's voltage is used up"),
    ("maximum_current", "A", "inverter limit"),
    ("current_time", "s", "time constant of the current controller"),
    ("magnet_heating", "K/A2", "steady rise of the magnets over the caliper per squared current"),
    ("magnet_time", "s", "its time constant"),
    ("winding_time", "s", "time constant of the winding, which heats housing and magnets; 0: at once"),
    ("copper_per_K", "1/K", "rise of the winding's resistance with that of its temperature"),
    ("load_friction", "m/rad", "gear friction torque per clamp force (thesis mu_g)"),
    ("offset_friction", "N m", "gear friction torque without load (thesis eta_g)"),
    ("presliding_angle", "rad", "Dahl's transition angle"),
    ("presliding_damping", "N m s/rad", "damping of the friction spring, none while sliding"),
    ("curve", "N/rad^n", "characteristic curve, n = 1 to 5, cold", (CURVE_TERMS,)),
    ("relaxation_time", "s", "first relaxation of the clamp force"),
    ("contact_angle", "rad", "clearance: motor angle from the released position to contact, cold and unworn"),
    ("released_angle", "rad", "what the resolver reads in the released position: its zero is arbitrary"),
    ("curve_temperature", "degC", "pad temperature at which the curve holds"),
    ("softening", "1/K", "loss of stiffness per rise of the mean pad temperature"),
    ("softening_history", "1/K", "loss of stiffness per rise as remembered"),
    ("history_time", "s", "time constant of that memory"),
    ("pad_thickness", "m", "one pad's friction material"),
    ("pad_area", "m2", "one pad's friction surface"),
    ("density", "kg/m3", "of the friction material"),
    ("specific_heat", "J/(kg K)", "at 20 degC"),
    ("specific_heat_rise", "1/K", "relative"),
    ("conductivity", "W/(m K)", "at 20 degC"),
    ("conductivity_rise", "1/K", "relative"),
    ("heat_share", "1", "of the friction power into inner and outer pad directly", (2,)),
    ("contact_conductance", "W/(m2 K)", "pad surface to disc under full contact"),
    ("gap_conductance", "W/(m2 K)", "pad surface to disc when released"),
    ("touching_force", "N", "clamp force at which contact conducts half as well as it can"),
    ("plate_conductance", "W/(m2 K)", "pad to backing plate"),
    ("plate_heat_capacity", "J/(m2 K)", "backing plate per friction area"),
    ("plate_loss", "W/(m2 K)", "backing plate to caliper, inner and outer", (2,)),
    ("caliper_heat_capacity", "J/K", "caliper"),
    ("caliper_loss", "W/K", "caliper to surroundings"),
    ("disc_heat_capacity", "J/K", "disc"),
    ("disc_cooling", "W/K", "disc to surroundings at rest"),
    ("disc_cooling_per_speed", "J/(rad K)", "gain of that with wheel speed"),
    ("disc_radiating_area", "m2", "times emissivity"),
    ("effective_radius", "m", "where the pads act"),
    ("friction_coefficient", "1", "pad on disc at 20 degC, no speed, no force"),
    ("friction_per_K", "1/K", "its slope over pad surface temperature"),
    ("friction_per_speed", "s/rad", "its slope over wheel speed"),
    ("friction_per_force", "1/N", "its slope over clamp force"),
    ("current_noise", "A", "standard deviation of the cycle's mean current, coloured"),
    ("current_noise_time", "s", "correlation time of that noise"),
    ("speed_noise", "rad/s", "standard deviation of the measured motor speed, white"),
    ("angle_noise", "rad", "of the resolver before quantisation"),
    ("angle_count", "rad", "resolver's least count"),
    ("angle_hysteresis", "rad", "beyond half a count, that the angle moves before the converter's reading follows"),
    ("temperature_noise", "K", "thermocouples"),
    ("force_noise", "N", "reference force sensor of the rig"),
    ("force_lead", "s", "time by which the reference force is younger than the resolver's sample"),
    ("brake_torque_noise", "N m", "reference torque sensor of the rig"),
    ("sensor_limit", "N", "force at which the car's own force sensor ends; 0: it has none"),
    ("sensor_gain", "1", "relative error of what it says"),
    ("sensor_offset", "N", "its zero at the start, at the curve's temperature"),
    ("sensor_walk", "N/sqrt(s)", "random walk of that"),
    ("sensor_per_K", "N/K", "its drift with the caliper's temperature"),
    ("sensor_noise", "N", "white noise of one value"),
)

PLANT = np.dtype([(name, "f8", *shape) for name, _, _, *shape in PLANT_FIELDS] + [("effects", EFFECT_VALUES)], align=True)

#: State of one corner. Angles are past the released position; temperatures degC; works and heats in J since the start.
PLANT_STATE = np.dtype(
    [
        *fields("f8", "angle speed current friction"),
        # Clamp: backlash output, travel past contact, slip elements, drives of the relaxations and their states.
        *fields("f8", "driven_angle past_contact slip further_slip drive slow settled slower yielding yielding_slowly creep"),
        *fields("f8", "motor_heat fastest"),
        # Amounts that drawn effects with a lag add.
        ("drawn", [(place, fields("f8", "amount")) for place in DRAWN]),
        *fields("f8", "excitation force force_rate static_force stiffness_factor"),
        # Controller.
        ("latched", "?"),
        *fields("f8", "position_target target_rate speed_integral force_correction"),
        # Wheel (its zero is where its pulses count from) and heat.
        ("wheel_angle", "f8"),
        ("uneven_disc", "?"),
        ("brake_torque", "f8"),
        ("pads", "f8", (2, CELLS)),
        ("surface", "f8", (2,)),
        ("plate", "f8", (2,)),
        ("plate_reading", "f8", (2,)),
        # For drawn effects: wheel speed, rad/s, and the mean temperature of both pads.
        *fields("f8", "wheel_speed pad_mean"),
        *fields("f8", "caliper disc winding_rise magnet_rise softening_memory wear"),
        # Sensors.
        *fields("f8", "current_error mean_current mean_current_error"),
        ("angle_history", "f8", (HISTORY,)),
        ("current_history", "f8", (HISTORY,)),
        ("history_at", "i8"),
        ("angle_reading", "f8"),
        # What the force sensor's zero has walked, N.
        ("sensor_zero", "f8"),
        # Energy balance.
        *fields("f8", "motor_work friction_loss clamp_work friction_heat heat_lost"),
    ],
    align=True,
)

#: Command to the brake controller of a corner for one cycle: RELEASE, ANGLE (``target`` rad past the released position,
#: moving at ``rate`` rad/s), FORCE (``target`` N) or LATCH (a pawl holds the motor where it is, without current).
RELEASE, ANGLE, FORCE, LATCH = range(4)
COMMAND = np.dtype([("mode", "i8"), ("target", "f8"), ("rate", "f8")], align=True)

#: Action of the driver (or the rig) in one cycle. ``wheel_speed`` rad/s prescribes the discs' speed like a rig's drive,
#: NaN leaves it to the car; ``target_speed`` m/s is what the car's engine holds or reaches, NaN lets it coast.
DRIVE = np.dtype([*fields("f8", "wheel_speed target_speed ambient"), *fields("i8", "park_brake brake_request")], align=True)

#: Training motion of a corner (thesis Fig. 3-9): slow clamp and release between two angles (rad past the released position)
#: with a small fast sinusoid. ``start``: position at its beginning; ``tick``: cycles run; ``silent``: cycles since the last
#: request.
TRAINING = np.dtype(
    [*fields("?", "requested running"), *fields("f8", "low high amplitude frequency start"), *fields("i8", "tick silent")],
    align=True,
)

#: State of the car's longitudinal motion and of its messages.
CAR = np.dtype(
    [
        *fields("i8", "time_ns tick"),
        *fields("f8", "speed wheel_speed"),
        # kg carried by the simulated corners, m, N/(m/s)^2, N, m/s^2
        *fields("f8", "mass wheel_radius drag rolling acceleration supply_voltage"),
        ("counter", "i8", (SLOTS,)),
        ("reference", "?"),
    ],
    align=True,
)

#: Truth at each resolver sample. Angles are the resolver's, contact and zero included; index 0 is the inner pad.
TRUTH = np.dtype(
    [
        *fields("i8", "time_ns corner counter"),
        *fields("f8", "force static_force angle speed current contact_angle stiffness_factor brake_torque"),
        ("surface", "f8", (2,)),
        ("mean", "f8", (2,)),
        ("depth", "f8", (2, len(DEPTHS_M))),
        ("plate", "f8", (2,)),
        *fields("f8", "caliper disc wheel_speed wheel_angle vehicle_speed wear"),
        *fields("i8", "park_brake brake_request"),
        ("training", "?"),
    ],
    align=True,
)
