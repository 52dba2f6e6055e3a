"""Records that the estimator reads and writes: parameters, state, sample, estimate. SI units; temperatures in degC."""

import numpy as np

from emb_daemon.effects import REGISTRY, parameter_record, state_record
from emb_daemon.estimator.consistency import CONSISTENCY
from emb_daemon.estimator.force_sensor import FORCE_SENSOR, FORCE_SENSOR_PARAMETERS
from emb_daemon.estimator.hypotheses import ALTERNATIVE, ALTERNATIVES, STEPPING
from emb_daemon.estimator.monitor import MONITOR
from emb_daemon.estimator.nearer import NEARER
from emb_daemon.estimator.phases import OPEN_PHASES
from emb_daemon.estimator.resolver import AWAY
from emb_daemon.estimator.rewind import LEARNED, STOPS
from emb_daemon.estimator.straying import STRAYING
from emb_daemon.estimator.uneven import UNEVEN
from emb_daemon.estimator.wheel import WHEEL
from emb_daemon.jit import fields
from emb_daemon.models.alignment import ALIGNMENT
from emb_daemon.models.contact import CONTACT
from emb_daemon.models.fusion import CREEPS, STATES
from emb_daemon.models.gear import GEAR
from emb_daemon.models.lateness import LATELY, LATENESS
from emb_daemon.models.plausibility import PLAUSIBILITY
from emb_daemon.models.thermal import CHAIN, NODES
from emb_daemon.models.torque import STEPS
from emb_daemon.models.wander import WANDER

CURVE_TERMS = 5
FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID = 6, 6, 8

#: Depths from the friction surface at which pad temperatures are told, m.
DEPTHS_M = (0.002, 0.004, 0.006, 0.008)

#: Parameters of pad and disc heat (models/thermal.py). Conductances in W/(m^2 K), areas in m^2.
THERMAL = np.dtype(
    [
        *fields("f8", "conductivity conductivity_rise density specific_heat specific_heat_rise area thickness"),
        ("node_position", "f8", (NODES,)),
        ("heat_share", "f8", (2,)),
        *fields(
            "f8",
            "contact_conductance gap_conductance surface_cooling_per_speed backplate_conductance disc_heat_capacity "
            "disc_cooling disc_cooling_per_speed disc_radiating_area effective_radius",
        ),
        ("friction_force", "f8", (FORCE_GRID,)),
        ("friction_speed", "f8", (SPEED_GRID,)),
        ("friction_temperature", "f8", (TEMPERATURE_GRID,)),
        ("friction_coefficient", "f8", (FORCE_GRID, SPEED_GRID, TEMPERATURE_GRID)),
        *fields("f8", "softening softening_history history_time softening_sigma reference sigma"),
    ],
    align=True,
)

#: Parameters of one corner. ``*_sigma`` are standard deviations; ``gear_gain`` and ``load_friction`` in m/rad.
PARAMETERS = np.dtype(
    [
        *fields("f8", "gear_gain torque_constant inertia load_friction offset_friction presliding_angle"),
        # Of the release spring, N per m of clamp travel.
        ("spring", "f8"),
        ("curve", "f8", (CURVE_TERMS,)),
        *fields(
            "f8",
            "relaxation_time clearance clearance_sigma maximum_force maximum_speed stiffness_sigma stiffness_relative_sigma "
            "stiffness_correlation_time current_sigma current_correlation_time speed_sigma presliding_sigma "
            "torque_relative_sigma torque_lasting_sigma contact_walk",
        ),
        ("gear", GEAR),
        ("sensor", FORCE_SENSOR_PARAMETERS),
        ("thermal", THERMAL),
        ("effects", parameter_record(REGISTRY)),
    ],
    align=True,
)

#: One row for the estimator. It is a resolver sample, or asks for a prediction ``age_cycles`` after the last
#: one. ``dt`` s since the last sample; ``late_ns`` whole cycles by which it came later than the promptest; ``cycle`` its
#: number since the first, ``elapsed_cycles`` since the last row; ``reasons`` what is amiss outside the estimator.
#: ``brake_torque`` N m is a rig's, NaN in a car. ``was_silent``: whether the motor's controller sent nothing before it for so
#: long that it may have been without power.
SAMPLE = np.dtype(
    [
        *fields("i8", "time_ns late_ns cycle elapsed_cycles age_cycles corner counter reasons"),
        ("is_prediction", "?"),
        *fields(
            "f8",
            "dt angle speed current_q sensor_force inner_backplate outer_backplate caliper ambient wheel_speed wheel_pulse "
            "vehicle_speed park_brake brake_request brake_torque",
        ),
        *fields("?", "has_current has_sensor_force has_thermocouple has_wheel_speed has_wheel_pulse has_status was_silent"),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("started", "?"),
        # Whether some of the last samples may be forged.
        ("contested", "?"),
        # Whether the contact angle is unknown since the start, and what the release that ends it is known by; whether some
        # samples came a cycle apart; the lowest angle since then.
        *fields("?", "unknown seen full_rate"),
        ("lowest", "f8"),
        # Whether it goes on from a snapshot, whose heat is ``rested_s`` s old; clearance that counts from the released
        # position.
        ("resumed", "?"),
        *fields("f8", "rested_s clearance clearance_sigma since_start_s still_s start_angle"),
        # Angle (rad) gone without speed since the motor stands, and for how long; time for which that still counts.
        *fields("f8", "drifted stood_s drifting_s"),
        # Angle (rad) gone beyond the integrated speed since the motor last stood, that integral, and the time for which it
        # turned, s; the first is no number where part of the way was not seen. Way by which an angle that repeats is behind,
        # and for how long, s.
        *fields("f8", "strayed turned turned_s behind behind_s"),
        # A zero that has moved, and what was believed before.
        ("away", AWAY),
        # Largest way (rad) in a sample by which angle and speed of late differed although the zero had not moved: while the
        # motor turned, and while it stood.
        ("largest_slip", "f8", (2,)),
        # Whether the speed of the last sample was not the motor's; ``speed`` is what was believed instead.
        ("speed_wrong", "?"),
        *fields("f8", "passed opposing angle speed angle_before dt_before contact_angle"),
        # Of a gear that is not constant: resolver's angle at its released position, rad, and its slope (`models.gear`). The
        # contact angle and what is past it are equivalent angles.
        *fields("f8", "gear_zero gear_slope"),
        # Force of the release spring, N: mean over the last cycle.
        ("spring_force", "f8"),
        # Stiffness path: static force (inputs of the lag) at the last sample, and the lag's output.
        *fields("f8", "past_contact drive drive_slope force slope"),
        # Force that the pads were held with over the time constants of creep, N; share that creeps beyond the calibration:
        # learned.
        ("held", "f8", (len(CREEPS),)),
        ("creep", "f8", (len(CREEPS),)),
        # Largest such force in the present stop, and that up to which earlier ones have shown what creeps, N.
        *((name, "f8", (len(CREEPS),)) for name in ("held_now", "held_shown")),
        # Torque path. ``direction`` rad: the last way that was not nothing; ``turned_back``: share of samples of late. What
        # effects have ``gained`` of thickness, m, and by how much that ``swelled`` or shrank in this sample.
        *fields("f8", "friction_state slid_angle friction_mean friction_variance direction turned_back gained swelled"),
        # Steps of the angle, by which coarse counts are told.
        ("steps", STEPS),
        # Way (rad) that the gear has slid since it last turned back, with its sign, and the way before that.
        *fields("f8", "swing swing_before"),
        *fields("f8", "torque_age balance leverage"),
        # Motor torque (N m), gear gain and gear friction over the calibration's, as its effects have them at this sample.
        *fields("f8", "motor_torque gear_gain gear_friction"),
        ("contact", CONTACT),
        ("plausibility", PLAUSIBILITY),
        # Age of the angle beside the speed, and beyond what the calibration knows, s.
        ("lateness", LATENESS),
        ("late", "f8"),
        # The motor's speeds of late; way (rad) that it has gone on since its angle was taken, and since the last sample; by
        # how much (rad) the resolver's zero has moved since the start.
        ("lately", LATELY),
        *fields("f8", "ahead travel zero_moved"),
        ("alignment", ALIGNMENT),
        ("wander", WANDER),
        # Fusion: the first hypothesis, and the others.
        ("error", "f8", (STATES,)),
        ("covariance", "f8", (STATES, STATES)),
        ("alternatives", ALTERNATIVE, (ALTERNATIVES,)),
        ("stepping", STEPPING),
        ("nearer", NEARER),
        # What the torque says beyond the first hypothesis, N, not a number where it says nothing, and its variance but for
        # noise that a mean has not, N2; beyond the fused force, of late, and the variance of that.
        *fields("f8", "beyond beyond_variance mean_beyond beyond_square"),
        # What was known after each of the last stops, the oldest first.
        ("learned", LEARNED, (STOPS,)),
        # How often the estimator has gone back to them.
        ("rewinds", "i8"),
        # Whether the pads have touched since the last release; stops so far, and proven jumps of the stiffness path.
        ("braked", "?"),
        *fields("f8", "stops jumps"),
        # Mean square of the share that stiffness, motor and inertia may have in common, the same after the last stop, and when
        # it was weighed within one; least odds so far that pads, rotor and unit are not the calibration's.
        *fields("f8", "common common_before common_age_s pads_odds rotor_odds unit_odds"),
        # Offset of the torque when the pads last touched (N m), for how long ago (s; 0: never), and what it walks, N2 m2/s.
        *fields("f8", "offset_before offset_age_s offset_walk"),
        # The same of the contact angle beside its anchor, as long as that stays, rad and rad2/s, and its variance then, rad2.
        *fields("f8", "contact_before contact_known contact_age_s contact_walk"),
        # Scratch of the filter.
        ("sensitivity", "f8", (2, STATES)),
        ("gain", "f8", (STATES,)),
        *fields("f8", "current_before current_change wanted"),
        ("had_current", "?"),
        # Noise of the speed, rad/s, and of the current, A: mean square of a motor that stands, and what is believed: of the
        # speed the larger of that and the calibration's, of the current the latter unless the first is clearly larger. Of the
        # current also by how its changes differ.
        *fields("f8", "speed_square speed_sigma current_square current_sigma turned_square"),
        ("no_current_s", "f8"),
        ("trusted", "?"),
        # Contact angle as clearance or torque placed it, rad. Learned: stiffness over the calibration's, and contact angle
        # that each kelvin of disc temperature over ``growth_start`` (degC) takes away, rad/K.
        *fields("f8", "contact_anchor scale growth growth_start"),
        # Heat of winding and housing: share of what the largest force's current would leave for ever.
        ("winding", "f8"),
        ("housing", "f8"),
        ("consistency", CONSISTENCY),
        ("straying", STRAYING),
        ("uneven", UNEVEN),
        ("phases", OPEN_PHASES),
        ("sensor", FORCE_SENSOR),
        ("monitor", MONITOR),
        ("wheel", WHEEL),
        # Heat. What flowed since the last heat step; profiles, and what the estimate tells of them.
        *fields("f8", "heat_time heat_energy heat_travel"),
        ("touching", "?"),
        ("pads", "f8", (2, NODES)),
        ("disc", "f8"),
        ("mean", "f8", (2,)),
        ("depth", "f8", (2, len(DEPTHS_M))),
        # Friction power of both pads over the last cycle, W.
        ("power", "f8"),
        *fields("f8", "history ambient factor"),
        # Standard deviations, K, left from a start with hot pads.
        ("temperature_sigma", "f8"),
        ("history_sigma", "f8"),
        # What of the stiffness they left open at the last sample, share.
        ("softening", "f8"),
        ("temperature_known", "?"),
        ("ambient_heard", "?"),
        # Backing plates: last readings, degC, the pads' mean temperatures when they last moved, what these have gained
        # since over time, K s, and whether a reading is stuck.
        ("plate", "f8", (2,)),
        ("plate_mean", "f8", (2,)),
        ("unanswered", "f8", (2,)),
        ("plate_stuck", "?"),
        ("work", "f8", (4, CHAIN)),
        ("effects", state_record(REGISTRY)),
        # The same of pads that were held until the start, and standard deviation, N, of the force by what pads remember of the
        # time before.
        ("held_effects", state_record(REGISTRY)),
        ("memory_sigma", "f8"),
        # Last answer, which predictions start from.
        *fields("f8", "fused fused_sigma"),
    ],
    align=True,
)

ESTIMATE = np.dtype(
    [
        *fields("i8", "time_ns late_ns cycle elapsed_cycles age_cycles corner counter mode source reasons facts"),
        ("is_sample", "?"),
        ("engaged", "?"),
        *fields("i8", "adapt_request adapt_progress adapt_result"),
        *fields(
            "f8",
            "force sigma stiffness_force stiffness_sigma torque_force torque_sigma ml_force contact_angle contact_sigma "
            "stiffness_factor innovation innovation_sigma",
        ),
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
