"""Measured data: the EMPS benchmark (Janot, Gautier, Brunot 2019), a motor and ball screw that clamp nothing."""

import pytest

from emb_daemon.calibration.files import load_calibration
from emb_daemon.diagnose.diagnosis import diagnose
from emb_daemon.offline import load_log
from studies import hardware


def test_torque_balance_of_the_thesis_is_completed_to_the_published_model(shared, tmp_path):
    folder = shared / "measured" / "emps"
    if not folder.is_dir():
        pytest.skip(f"NOT RUN: {folder} with the EMPS data set is not here")
    tool = hardware.tool("emps_to_log")
    assert tool.main([str(folder / "DATA_EMPS.mat"), str(folder / "DATA_EMPS_PULSES.mat"), "--output", str(tmp_path)]) == 0
    first, second, pulses = (load_log(tmp_path / f"{name}.log") for name in ("first_half", "second_half", "pulses"))
    result = diagnose([first], load_calibration(tmp_path / "calibration.yaml"), [second, pulses])
    assert {finding.effect.name for finding in result.accepted} == {"viscous_friction", "current_offset"}
    found = tool.in_units_of_the_carriage(result.calibration)
    assert found["mass_kg"] == pytest.approx(95.1, rel=0.03)
    assert found["viscous_Ns_per_m"] == pytest.approx(203.5, rel=0.03)
    assert found["coulomb_N"] == pytest.approx(20.4, rel=0.03)
    assert found["offset_N"] == pytest.approx(-3.2, rel=0.10)
    before, after = result.judged_residual["torque"]
    assert after < 0.25 * before
