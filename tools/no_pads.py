"""Where to start from with a drive that clamps nothing: the thesis's torque balance, and no other effect."""

import msgspec

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import Calibration

#: Clearance that no motion closes, rad.
NEVER = 1e4


def starting_calibration(
    actuator: str,
    *,
    torque_constant_Nm_per_A: float,
    inertia_kg_m2: float,
    coulomb_Nm: float,
    presliding_angle_rad: float,
    gear_gain_m_per_rad: float,
    maximum_speed_rad_per_s: float,
) -> Calibration:
    """Inertia and Coulomb friction as a datasheet would say, everything else as shipped."""
    base, replace = shipped_calibration(), msgspec.structs.replace
    motor = {
        "torque_constant_Nm_per_A": torque_constant_Nm_per_A,
        "inertia_kg_m2": inertia_kg_m2,
        "gear_gain_m_per_rad": gear_gain_m_per_rad,
        "maximum_speed_rad_per_s": maximum_speed_rad_per_s,
    }
    friction = {"load_m_per_rad": 0.0, "offset_Nm": coulomb_Nm, "presliding_angle_rad": presliding_angle_rad}
    return replace(
        base,
        actuator=actuator,
        motor=replace(base.motor, **motor),
        friction=replace(base.friction, **friction),
        contact=replace(base.contact, clearance_rad=NEVER),
        effects={},
        provenance=None,
    )
