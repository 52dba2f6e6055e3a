"""The independent monitor: the true force of every brake that its datasheet allows lies within the bounds, and each clause of
them is needed."""

import brake
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.estimator.monitor import (
    LEAST_GAIN,
    MONITOR,
    MOST_FRICTION,
    MOST_GAIN,
    OFFSET_SHARE,
    SMOOTHED_S,
    TOLERATED_S,
    bound,
    contradicts,
)
from emb_daemon.estimator.records import SAMPLE
from emb_daemon.models.gear import most_of_spring

_DT = 0.004
CLOSING, OPENING, HOLDING = 10.0, -10.0, 0.0


class Watched:
    """A brake of parameters ``p`` whose current passes the monitor."""

    def __init__(self, p):
        self.p, self.w, self.m = p, np.zeros(1, MONITOR), np.zeros(1, SAMPLE)
        self.m["dt"], self.m["has_current"], self.m["has_status"] = _DT, True, True

    def hold(self, torque, speed=HOLDING, samples=200, friction=1.0):
        """Steady motor torque, N m, as the datasheet's torque constant would make of the current. Returns low and high."""
        self.m["current_q"], self.m["speed"] = torque / self.p["torque_constant"], speed
        for _ in range(samples):
            bound(self.w[0], self.p, self.m[0], friction)
        return float(self.w["low"][0]), float(self.w["high"][0])


@pytest.fixture(scope="module")
def p():
    from emb_daemon.calibration.files import shipped_calibration
    from emb_daemon.calibration.types import to_parameters

    return brake.ideal([to_parameters(shipped_calibration())])


@given(
    force=st.floats(0.0, 1.0),
    gain=st.floats(LEAST_GAIN, MOST_GAIN),
    load=st.floats(0.0, MOST_FRICTION),
    dry=st.floats(0.0, MOST_FRICTION),
    offset=st.floats(-OFFSET_SHARE, OFFSET_SHARE),
    direction=st.floats(-1.0, 1.0),
    speed=st.sampled_from([CLOSING, OPENING, HOLDING]),
)
def test_the_true_force_of_any_brake_of_the_datasheet_is_within_the_bounds(
    p, force, gain, load, dry, offset, direction, speed
):
    """Share of the largest force; torque constant, friction and offset anywhere in their ranges; friction against the
    motion, or
    either way if the motor stands."""
    true = force * p["maximum_force"]
    against = np.sign(speed) if speed else direction
    torque = p["gear_gain"] * true + against * (load * p["load_friction"] * true + dry * p["offset_friction"])
    shown = torque / gain + offset * p["gear_gain"] * p["maximum_force"]
    low, high = Watched(p).hold(shown, speed)
    assert low - 1.0 <= true <= high + 1.0


@pytest.mark.parametrize(
    ("gain", "friction", "offset"), [(1.0, 1.0, 0.0), (0.65, 0.1, 0.04), (1.09, 1.9, -0.04), (0.65, 1.9, 0.04)]
)
@pytest.mark.parametrize("seconds", [0.15, 1.0, 8.0])
def test_strokes_at_any_speed_never_contradict_the_true_force(p, gain, friction, offset, seconds):
    """From slow to as fast as the motor turns, with the noise of its sensors: the true force, known to 50 N, is never ruled
    out."""
    true = p.copy()
    for name in ("load_friction", "offset_friction"):
        true[name] *= friction
    rise = 0.5 * (1.0 - np.cos(np.pi * np.arange(round(seconds / _DT)) * _DT / seconds))
    still = np.zeros(100)
    top = p["clearance"] + 18.0
    path = top * np.concatenate([still, rise, still + 1.0, 1.0 - rise, still, rise, 1.0 - rise, still])
    rows, force = brake.samples(true, path)
    rows = brake.noisy(rows, p)
    rows["current_q"] = rows["current_q"] / gain + offset * p["gear_gain"] * p["maximum_force"] / p["torque_constant"]
    watched = Watched(p)
    for row, now in zip(rows, force, strict=True):
        bound(watched.w[0], p, row, 1.0)
        assert not contradicts(watched.w[0], now, 50.0, row["dt"])


def test_bounds_of_a_holding_motor_by_hand(p):
    """1 N m shown: at least 0.6 of it less offset and doubled friction, at most 1.1 of it and both over what the gear
    leaves."""
    low, high = Watched(p).hold(1.0)
    offset = OFFSET_SHARE * p["gear_gain"] * p["maximum_force"]
    dry, load = 2.0 * p["offset_friction"], 2.0 * p["load_friction"]
    assert low == pytest.approx((0.6 - offset - dry) / (p["gear_gain"] + load), rel=1e-6)
    assert high == pytest.approx(min((1.1 + offset + dry) / (p["gear_gain"] - load), p["maximum_force"]), rel=1e-6)


def test_a_closing_motor_pays_friction_and_an_opening_one_is_held_by_it(p):
    """Closing, friction cannot hold the force up: a lower upper bound. Opening, it cannot have taken torque: a higher lower
    one."""
    standing, closing, opening = (Watched(p).hold(0.4, speed) for speed in (HOLDING, CLOSING, OPENING))
    assert closing[0] == pytest.approx(standing[0]) and closing[1] < 0.8 * standing[1]
    assert opening[1] == pytest.approx(standing[1]) and opening[0] > 1.2 * standing[0]


def test_slow_creep_is_no_motion(p):
    assert Watched(p).hold(0.4, 1.9) == Watched(p).hold(0.4, -1.9) == pytest.approx(Watched(p).hold(0.4, HOLDING))


def test_a_torque_that_opens_is_bounded_as_well(p):
    """A magnet that is stronger than stated makes more of a negative current: the lower bound stays zero."""
    low, high = Watched(p).hold(-0.2, OPENING)
    offset, dry = OFFSET_SHARE * p["gear_gain"] * p["maximum_force"], 2.0 * p["offset_friction"]
    assert low == 0.0
    assert high == pytest.approx(max(-0.6 * 0.2 + offset + dry, 0.0) / (p["gear_gain"] - 2.0 * p["load_friction"]), rel=1e-6)


def test_without_torque_only_offset_and_friction_can_hold_a_force(p):
    low, high = Watched(p).hold(0.0)
    assert low == 0.0 and 0.0 < high < 0.35 * p["maximum_force"]


@given(
    force=st.floats(0.0, 1.0),
    gain=st.floats(LEAST_GAIN, MOST_GAIN),
    beyond=st.floats(0.01, 0.5),
    released=st.floats(-MOST_FRICTION, MOST_FRICTION),
    holding=st.floats(-MOST_FRICTION, MOST_FRICTION),
)
def test_a_sensor_that_shows_less_torque_than_an_open_brake_leaves_rules_no_force_out(
    p, force, gain, beyond, released, holding
):
    """However the friction presses in the motor that stands released, and in the one that holds a force."""
    watched, force = Watched(p), force * p["maximum_force"]
    healthy, dry = OFFSET_SHARE * p["gear_gain"] * p["maximum_force"], MOST_FRICTION * p["offset_friction"]
    offset = -(beyond + healthy + 2.0 * dry) / LEAST_GAIN
    watched.hold(released * p["offset_friction"] / gain + offset, samples=500)
    taken = holding * (p["offset_friction"] + p["load_friction"] * force)
    low, high = watched.hold((p["gear_gain"] * force + taken) / gain + offset, samples=500)
    assert low <= force <= high * (1.0 + 1e-6) + 1.0


@pytest.mark.parametrize(
    ("torque", "speed", "samples"),
    [(-0.3, HOLDING, 240), (-0.3, OPENING, 500), (-0.3, CLOSING, 500), (-0.05, HOLDING, 500), (0.3, HOLDING, 500)],
    ids=["against its stop", "opening", "closing", "friction", "clamped"],
)
def test_no_other_torque_says_that_the_sensor_is_off(p, torque, speed, samples):
    watched, fresh = Watched(p), Watched(p)
    watched.hold(torque, speed, samples)
    assert watched.hold(0.2, samples=500) == pytest.approx(fresh.hold(0.2, samples=500)) and watched.w["missing"] == 0.0


def test_friction_that_pressed_while_released_and_holds_the_force_up_leaves_just_that_force(p):
    """The worst of the datasheet's brakes: the strongest magnets and most friction, which hid a part of the sensor's offset in
    the released brake and carries a part of the force now. Its upper bound is this force to the newton."""
    watched, force = Watched(p), 0.9 * p["maximum_force"]
    healthy, dry = OFFSET_SHARE * p["gear_gain"] * p["maximum_force"], MOST_FRICTION * p["offset_friction"]
    offset = -1.01 * (healthy + dry) / LEAST_GAIN - dry / MOST_GAIN
    watched.hold(dry / MOST_GAIN + offset, samples=500)
    held = dry + MOST_FRICTION * p["load_friction"] * force
    shown = (p["gear_gain"] * force - held) / MOST_GAIN + offset
    assert shown > 0.0, "else the weakest magnets would allow more"
    assert watched.hold(shown, samples=500)[1] == pytest.approx(force, abs=1.0)


def test_what_the_sensor_was_once_off_by_it_may_still_be(p):
    watched = Watched(p)
    watched.hold(-0.3, samples=500)
    _, once = watched.hold(0.2, samples=500)
    watched.hold(-0.25, samples=500)
    assert watched.hold(0.2, samples=500)[1] == pytest.approx(once)
    watched.hold(-0.35, samples=500)
    assert watched.hold(0.2, samples=500)[1] > once


@pytest.mark.parametrize(("has_status", "park_brake"), [(True, 1.0), (False, 0.0)])
def test_a_latched_brake_needs_no_current(p, has_status, park_brake):
    watched = Watched(p)
    watched.m["has_status"], watched.m["park_brake"] = has_status, park_brake
    assert watched.hold(0.0) == (0.0, p["maximum_force"])
    assert watched.hold(1.0)[0] > 0.0, "but a torque still means a force"


def test_a_gear_that_locks_itself_gives_no_upper_bound(p):
    locking = p.copy()
    locking["load_friction"] = 0.41 * p["gear_gain"]
    assert Watched(locking).hold(0.0)[1] == p["maximum_force"]
    locking["load_friction"] = 0.39 * p["gear_gain"]
    assert Watched(locking).hold(0.0, CLOSING)[1] < p["maximum_force"]
    assert Watched(locking).hold(0.0)[1] < p["maximum_force"]


def test_without_current_nothing_is_ruled_out_and_it_starts_anew(p):
    watched = Watched(p)
    watched.hold(1.0)
    watched.m["has_current"] = False
    assert watched.hold(np.nan) == (0.0, p["maximum_force"])
    watched.m["has_current"] = True
    assert watched.hold(0.3, samples=1) == pytest.approx(Watched(p).hold(0.3)), "no memory of what was before"


def test_what_accelerates_the_motor_is_no_force(p):
    """A free motor that speeds up at 2000 rad/s^2 through the clearance: its torque means no force."""
    watched = Watched(p)
    watched.m["current_q"] = p["inertia"] * 2000.0 / p["torque_constant"]
    for sample in range(60):
        watched.m["speed"] = 2000.0 * sample * _DT
        bound(watched.w[0], p, watched.m[0], 1.0)
    assert watched.w["torque"][0] == pytest.approx(0.0, abs=0.12 * p["inertia"] * 2000.0)


def test_a_torque_is_smoothed(p):
    """One sample of ten newton metres moves it by what one sample is of the time, no more."""
    watched = Watched(p)
    watched.hold(0.0)
    watched.hold(10.0, samples=1)
    assert watched.w["torque"][0] == pytest.approx(10.0 * (1.0 - np.exp(-_DT / SMOOTHED_S)), rel=1e-6)


def _said(watched, force, samples):
    return [contradicts(watched.w[0], force, 100.0, _DT) for _ in range(samples)]


def test_a_force_outside_is_contradicted_after_the_time_that_is_tolerated(p):
    watched = Watched(p)
    low, high = watched.hold(0.6)
    for force in (high + 301.0, low - 301.0):
        _said(watched, 0.5 * (low + high), 500)
        watched.w["force"] = force
        assert _said(watched, force, 150).index(True) == pytest.approx(TOLERATED_S / _DT, abs=1.0)
        back = _said(watched, 0.5 * (low + high), 100)
        assert not any(back[25:]), "over soon after it is back"
        watched.w["force"] = force
        assert not any(_said(watched, force, 90)), "and the time counts anew"


def test_three_sigma_are_allowed(p):
    watched = Watched(p)
    low, high = watched.hold(0.6)
    for force in (high + 299.0, low - 299.0):
        watched.w["force"] = force
        assert not any(_said(watched, force, 500))


def test_what_is_no_number_is_another_facts_business(p):
    """And leaves no trace: the next force is judged."""
    watched = Watched(p)
    low, high = watched.hold(0.6)
    watched.w["force"] = 0.5 * (low + high)
    assert not any(_said(watched, np.nan, 200))
    assert not any(_said(watched, 0.5 * (low + high), 200)) and watched.w["force"][0] == pytest.approx(0.5 * (low + high))


def test_friction_that_effects_add_widens_the_bounds_and_friction_that_they_take_does_not_narrow_them(p):
    """A calibrated breakaway friction of three times the sliding one holds a force that twice the sliding one does not."""
    torque, slope = 0.5, p["gear_gain"]
    plain, more, less = (Watched(p).hold(torque, friction=friction) for friction in (1.0, 1.5, 0.5))
    assert less == plain
    assert more[0] < plain[0] and more[1] > plain[1]
    held = 1.5 * MOST_FRICTION * (p["offset_friction"] + p["load_friction"] * more[0])
    assert more[0] * slope + held + OFFSET_SHARE * slope * p["maximum_force"] == pytest.approx(LEAST_GAIN * torque, rel=1e-3)


def test_of_what_the_motor_shows_a_release_spring_may_take_its_most(p):
    sprung = p.copy()
    sprung["spring"] = 1.0
    sprung["spring"] = 0.05 * p["maximum_force"] / most_of_spring(sprung)
    low, high = Watched(p).hold(1.0, CLOSING)
    with_spring = Watched(sprung).hold(1.0, CLOSING)
    assert with_spring == (pytest.approx(low - 0.05 * p["maximum_force"]), high)


def test_each_bound_takes_the_gear_at_the_slope_that_is_worst_for_it(p):
    uneven = p.copy()
    uneven["gear"]["step"] = 1.0
    uneven["gear"]["slope"] = np.linspace(0.8, 1.25, len(p["gear"]["slope"]))
    (low, high), (least, most) = Watched(p).hold(0.4, CLOSING), Watched(uneven).hold(0.4, CLOSING)
    assert high / 0.8 < p["maximum_force"] and low > 0.0
    assert (least, most) == (pytest.approx(low / 1.25), pytest.approx(high / 0.8))
