"""What the coordinates of a fit say of the calibration's keys: sums inside bounds, single logs' values on their own logs."""

import pytest

from emb_daemon.diagnose.coordinates import Coordinate, Move, by_key


def _coordinate(name: str, *moves: Move, log: int | None = None) -> Coordinate:
    return Coordinate(name, "stiffness", 0.0, 1e-3, 1.0, moves, log=log)


def test_a_key_follows_the_sum_of_its_coordinates_inside_its_bounds():
    shared = Move("contact.clearance_rad", 2.0, 0.0, 10.0)
    both = _coordinate("both", shared, Move("friction.offset_Nm", -1.0, -0.5, 0.5))
    one = _coordinate("one", shared)
    assert by_key({both: 0.25, one: 1.0}, 0.0) == {"contact.clearance_rad": 2.5, "friction.offset_Nm": -0.25}
    assert by_key({both: 3.0, one: 3.0}, 0.0) == {"contact.clearance_rad": 10.0, "friction.offset_Nm": -0.5}
    assert by_key({one: -1.0}, 0.0) == {"contact.clearance_rad": 0.0}


def test_a_coordinate_of_one_log_acts_on_that_log_and_counts_with_the_mean_for_all():
    clearance = Move("contact.clearance_rad", 1.0, 0.0, 100.0)
    values = {_coordinate(f"log {log}", clearance, log=log): value for log, value in enumerate((5.0, 6.0, 10.0))}
    values[_coordinate("every log", Move("friction.offset_Nm", 1.0, 0.0, 1.0))] = 0.25
    assert by_key(values, 0.0, log=1) == {"contact.clearance_rad": 6.0, "friction.offset_Nm": 0.25}
    assert by_key(values, 0.0) == {"contact.clearance_rad": pytest.approx(7.0), "friction.offset_Nm": 0.25}
