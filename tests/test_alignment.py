"""A current that is late or early beside the motion: found, undone, told; nothing else is taken for it."""

import brake
import city
import numpy as np
import pytest

from emb_daemon.estimator import fuse, restart
from emb_daemon.estimator.records import ESTIMATE, SAMPLE, new_state
from emb_daemon.estimator.status import CURRENT_APART
from emb_daemon.estimator.step import _lead
from emb_daemon.models import alignment
from emb_daemon.models.alignment import ALIGNMENT, align, aligned, compare, in_step, interrupt
from emb_daemon.offline import estimate
from emb_daemon.wire.contract import OUTSIDE_RANGE

_DT, _NOISE = 0.004, 0.02


def _torque(seconds=4.0, seed=1):
    """Torque that a motor needs, N m: steps up and down of some tenths of a second, with ramps between them."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, _DT)
    at = np.cumsum(rng.uniform(0.05, 0.4, int(4 * seconds)))
    steps = rng.uniform(-0.6, 0.6, len(at))
    return np.sum(steps[:, None] * (time > at[:, None]) * np.exp(-np.maximum(time - at[:, None], 0.0) / 0.2), axis=0)


def _late(values, cycles):
    return np.interp(np.arange(len(values)) - cycles, np.arange(len(values)), values)


def _apart(torque, cycles):
    """Torque by a current through a filter, and by a motion with its noise; or that through one, if ``cycles`` is negative."""
    needed = torque + _NOISE * np.random.default_rng(3).standard_normal(len(torque))
    return (brake.filtered(torque, cycles), needed) if cycles >= 0.0 else (torque, brake.filtered(needed, -cycles))


def _compare(shown, needed, a=None, noise=_NOISE):
    a = np.zeros(1, ALIGNMENT)[0] if a is None else a
    noise = noise * np.random.default_rng(2).standard_normal(len(shown))
    # The motor is turning.
    a["angle"][0] = 1.0
    for one, other in zip(shown + noise, needed, strict=True):
        compare(a, one, other, 0.0, _NOISE)
    assert 0.0 in (a["delay_left"], a["lag_left"])
    return float(a["delay_left"] + a["lag_left"])


@pytest.mark.parametrize("cycles", [-2.0, -1.0, 1.0, 2.0, 2.2, 3.0])
def test_a_shift_is_found(cycles):
    needed = _torque()
    pair = (_late(needed, cycles), needed) if cycles > 0.0 else (needed, _late(needed, -cycles))
    assert _compare(*pair) == pytest.approx(cycles, abs=0.15)


@pytest.mark.parametrize("cycles", [-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_filter_is_found(cycles, seed):
    a, (shown, needed) = np.zeros(1, ALIGNMENT)[0], _apart(_torque(seed=seed), cycles)
    assert _compare(shown, needed, a, 0.0) == pytest.approx(cycles, rel=0.25)
    assert a["delay_left"] == 0.0


@pytest.mark.parametrize("cycles", [-0.4, 0.4])
def test_a_filter_within_what_the_estimate_allows_for_is_left(cycles):
    """However clear it is: a current that is late by a third of a cycle looks like it."""
    a, torque = np.zeros(1, ALIGNMENT)[0], _torque()
    a["angle"][0] = 1.0
    pair = (brake.filtered(torque, cycles), torque) if cycles > 0.0 else (torque, brake.filtered(torque, -cycles))
    for shown, needed in zip(*pair, strict=True):
        compare(a, shown, needed, 0.0, 0.1 * _NOISE)
    assert a["informative"] > 15.0 and a["lag_left"] == 0.0


def test_a_noisy_current_beside_a_smooth_motion_is_no_filter_of_the_motion():
    """A filter takes the noise away and leaves what changes slowly as it was."""
    smooth = 0.3 * np.sin(8.0 * np.pi * _DT * np.arange(150))
    for seed in range(20):
        a, noise = np.zeros(1, ALIGNMENT)[0], 0.5 * _NOISE * np.random.default_rng(seed).standard_normal(len(smooth))
        a["angle"][0] = 1.0
        for shown, needed in zip(smooth + noise, smooth, strict=True):
            compare(a, shown, needed, 0.0, _NOISE)
            assert a["lag_left"] == 0.0, seed


def test_a_filter_that_comes_while_driving_is_found_within_some_strokes():
    torque, a = _torque(20.0), np.zeros(1, ALIGNMENT)[0]
    before, after = torque[:3500], torque[3500:4700]
    assert _compare(*_apart(before, 0.0), a, 0.0) == 0.0
    _compare(*_apart(after, 2.0), a, 0.0)
    assert a["lag_left"] == pytest.approx(2.0, rel=0.25)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda t: t,
        lambda t: 0.5 * t,
        lambda t: 2.0 * t,
        lambda t: 1.1 * t,
        lambda t: t + 0.1,
        lambda t: 0.0 * t,
        lambda t: t + 0.1 * np.sign(t),
    ],
    ids=["nothing", "half", "twice", "gain", "offset", "dead", "friction"],
)
@pytest.mark.parametrize("seed", range(5))
def test_what_neither_shift_nor_filter_explains_is_none(wrong, seed):
    needed = _torque(seed=seed)
    assert _compare(wrong(needed), needed) == 0.0


def test_a_motor_that_stands_tells_nothing_and_one_stroke_tells_enough():
    a = np.zeros(1, ALIGNMENT)[0]
    _compare(np.zeros(500), np.zeros(500), a)
    assert a["informative"] == 0.0
    a["angle"] = 0.0
    for torque in _torque():
        compare(a, 0.0, torque, 0.0, _NOISE)
    assert a["informative"] == 0.0
    stroke = np.concatenate((np.zeros(20), np.full(10, 0.6), np.full(10, -0.3), np.full(20, 0.3)))
    assert _compare(_late(stroke, 2.0), stroke, a) == pytest.approx(2.0, abs=0.1)


def test_after_one_filter_was_undone_the_next_is_found_as_soon_as_a_first_one():
    a, fresh = np.zeros(2, ALIGNMENT)
    assert _compare(*_apart(_torque(), -2.0), a, 0.0) < 0.0
    a["angle"] = 0.0
    align(a, np.zeros(1, SAMPLE)[0])
    assert a["lag"] < 0.0
    a["angle"][0] = fresh["angle"][0] = 1.0
    found = 0
    for shown, needed in zip(*_apart(_torque(seed=4), -4.0), strict=True):
        for one in (a, fresh):
            compare(one, shown, needed, 0.0, _NOISE)
        assert (a["delay_left"], a["lag_left"]) == (fresh["delay_left"], fresh["lag_left"])
        found += fresh["lag_left"] < 0.0
    assert found > 100


def test_until_changes_were_seen_to_belong_together_a_torque_that_changed_waits():
    """For a contact angle that is not known yet: a late current would pass for a clamp force."""
    a = np.zeros(1, ALIGNMENT)[0]
    assert aligned(a)
    _compare(np.repeat([0.0, 0.5], [10, 3]), np.repeat([0.0, 0.5], [10, 3]), a)
    assert a["unsettled"] > 0.0 and not aligned(a)
    a["informative"], a["unsettled"] = 5.0, 1.0
    assert not aligned(a)
    a["informative"] = 6.0
    assert aligned(a)
    a["delay_left"] = 1.0
    assert not aligned(a)


@pytest.mark.parametrize(("pair", "expected"), [(lambda t: (_late(t, 1 / 3), t), True), (lambda t: (t, _late(t, 1 / 3)), True),
    (lambda t: (brake.filtered(t, 5.0), t), False), (lambda t: (_late(t, 2.0), t), False)])  # fmt: skip
def test_part_of_a_cycle_is_in_step_once_enough_was_compared(pair, expected):
    """Of a filter and of whole cycles is nothing learned that a delay of part of a cycle explains as well."""
    a, torque = np.zeros(1, ALIGNMENT)[0], _torque()
    assert not in_step(a)
    _compare(*pair(torque), a)
    assert a["informative"] > 15.0 and in_step(a) == expected


def test_samples_of_before_a_gap_are_not_compared():
    a, needed = np.zeros(1, ALIGNMENT)[0], _torque()
    _compare(_late(needed, 2.0), needed, a)
    interrupt(a)
    told, squares = float(a["informative"]), a["shift_square"].copy()
    _compare(np.ones(8), np.zeros(8), a)
    assert a["informative"] == told
    np.testing.assert_array_equal(a["shift_square"], squares)


def _moved(names, cycles, by=_late):
    """What makes signals of a drive come some cycles late, or through a filter."""

    def change(rows):
        for name in names:
            rows[name] = by(rows[name], cycles)

    return change


_CURRENT, _MOTION = ("current_q",), ("angle", "speed")


@pytest.mark.parametrize("names", [_CURRENT, _MOTION])
@pytest.mark.parametrize(("by", "cycles"), [(_late, 1.0), (_late, 2.0), (brake.filtered, 1.5), (brake.filtered, 2.0)])
@pytest.mark.parametrize("seed", [0, 1])
def test_it_is_undone_within_a_stop(names, by, cycles, seed):
    """The force is that of the sample, not of the time to which the earlier of both was moved back."""
    estimates, force = city.changed(_moved(names, cycles, by), seed, 40.0)
    city.assert_undone(estimates, force, seed)


@pytest.mark.parametrize("seed", [0, 1])
def test_friction_does_not_go_through_a_filter_of_the_motion(parameters, seed):
    """It turns over with the motion that is left. Counted with the rest it hides a filter of 16 ms, and 3 to 4 kN remain."""
    samples, force = city.drive(seed, 40.0)
    samples, state = samples.copy(), new_state()
    _moved(_MOTION, 4.0, brake.filtered)(samples)
    error = (estimate(samples, parameters, state)["force"] - force)[-2500:]
    assert -5.5 < state[0]["alignment"]["lag"] < -3.5 and np.sqrt(np.mean(error**2)) < 100.0


@pytest.mark.parametrize("seed", range(5))
def test_a_unit_within_tolerances_is_in_step(parameters, seed):
    a = _after(city.drive(seed, 40.0)[0], parameters)["alignment"]
    # Of what the sums keep, three quarters: 27 samples told.
    assert (a["delay"], a["delay_left"], a["lag"], a["lag_left"]) == (0.0, 0.0, 0.0, 0.0) and a["informative"] > 15.0


@pytest.mark.parametrize("cycles", [2.0, 3.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_a_late_current_makes_of_the_first_stroke_is_not_learned(cycles, seed):
    """Of a unit within tolerances. Neither a clamp force of kilonewtons at the start, nor other pads."""
    estimates, force = city.changed(_moved(_CURRENT, cycles), seed, 25.0)
    error = np.abs(estimates["force"] - force)[25:]
    assert np.mean(error > 3.0 * np.hypot(estimates["sigma"][25:], 25.0)) < 0.005
    assert np.sqrt(np.mean(error**2)) < 120.0


def _after(samples, p):
    state = new_state()
    estimate(samples, p, state)
    return state[0]


@pytest.fixture
def late():
    """Samples of a drive whose current is two cycles late."""
    samples = city.drive(1, 25.0)[0].copy()
    _moved(_CURRENT, 2.0)(samples)
    return samples


def test_a_brake_that_is_held_as_exactly_known_is_not_moved(parameters, late):
    """As in diagnose, which names a delay instead."""
    assert _after(late, parameters)["alignment"]["delay"] == pytest.approx(2.0, abs=0.2)
    parameters["clearance_sigma"] = 0.0
    assert _after(late, parameters)["alignment"]["delay"] == 0.0


def test_what_is_in_step_is_used_as_it_came(parameters, late):
    """And samples are the caller's: they stay as they were."""
    before = str(late.tolist())
    _after(late, parameters)
    assert str(late.tolist()) == before
    a = np.zeros(1, ALIGNMENT)[0]
    for row in late[:200]:
        align(a, row)
    assert str(late.tolist()) == before


def test_it_is_moved_only_while_the_motor_stands(parameters):
    p = brake.ideal(parameters)
    rows = brake.samples(p, brake.stops(p, 2))[0]
    a, turning = np.zeros(1, ALIGNMENT)[0], int(np.argmax(rows["speed"]))
    for row in rows[: turning + 1]:
        align(a, row)
    a["delay_left"] = 1.0
    align(a, rows[turning + 1])
    assert a["delay"] == 0.0
    for row in rows[turning + 2 :]:
        align(a, row)
    assert (a["delay"], a["delay_left"]) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "found", "limit"),
    [
        ("delay", 9.0, alignment.LATEST),
        ("delay", -9.0, -alignment.EARLIEST),
        ("lag", -20.0, -alignment.SLOWEST),
        ("lag", 20.0, alignment.SLOWEST),
    ],
)
def test_no_shift_is_beyond_what_frames_and_gateways_make_and_no_filter_slower_than_can_be_undone(kind, found, limit):
    a, m = np.zeros(1, ALIGNMENT)[0], np.zeros(1, SAMPLE)[0]
    m["dt"] = _DT
    for _ in range(8):
        align(a, m)
    a[f"{kind}_left"] = found
    align(a, m)
    assert a[kind] == limit and (kind == "delay" or a["lag_left"] == 0.0)


@pytest.mark.parametrize("cycles", [-4.0, 2.0, 6.0])
def test_a_filter_and_its_inverse(cycles):
    """Over gaps too, where a current has changed steadily."""
    true = _torque()
    a, m, undone = np.zeros(1, ALIGNMENT)[0], np.zeros(1, SAMPLE)[0], []
    a["lag"] = cycles
    for value in brake.filtered(true, cycles) if cycles > 0.0 else true:
        m["dt"], m["current_q"] = _DT, value
        align(a, m)
        undone.append(float(m["current_q"]))
    np.testing.assert_allclose(undone[2:], (true if cycles > 0.0 else brake.filtered(true, -cycles))[2:], atol=1e-9)
    m["dt"], m["current_q"] = 20.0 * abs(cycles) * _DT, 1.0
    align(a, m)
    assert m["current_q"] == pytest.approx(1.0, abs=0.06)


def test_the_inverse_of_a_filter_adds_noise_to_a_torque(parameters):
    p, state = brake.ideal(parameters), new_state()
    rows = brake.samples(p, brake.stops(p, 2))[0]
    estimate(rows, p, state)
    plain = fuse._moving_variance(state[0], p, rows[-1])
    state[0]["alignment"]["lag"] = 3.0
    # Four times this current less three times the one before, of independent noise, instead of this current alone.
    expected = (4.0**2 + 3.0**2 - 1.0) * (p["torque_constant"] * p["current_sigma"]) ** 2
    assert fuse._moving_variance(state[0], p, rows[-1]) - plain == pytest.approx(expected)
    state[0]["alignment"]["lag"] = -3.0
    assert fuse._moving_variance(state[0], p, rows[-1]) == plain


def test_a_force_beyond_the_range_is_told_at_its_own_sample(parameters, late):
    parameters["maximum_force"] = 5000.0
    state = new_state()
    estimates = estimate(late, parameters, state)[city.SECOND_CLEARANCE :]
    beyond = estimates["force"] > 5000.0
    assert state[0]["alignment"]["delay"] > 1.8 and beyond.any()
    assert np.all(estimates["reasons"][beyond] & OUTSIDE_RANGE) and np.all(estimates["sigma"] <= 5000.0)


@pytest.mark.parametrize(
    ("by", "cycles", "field", "beyond"),
    [(_late, 2.0, "delay", 5.0), (brake.filtered, 3.0, "lag", 12.5), (brake.filtered, 3.0, "lag", -12.5)],
)
def test_it_survives_a_restart(parameters, by, cycles, field, beyond):
    p, resumed, snapshot = parameters[0], new_state()[0], np.zeros(1, restart.SNAPSHOT)[0]
    samples = city.drive(1, 25.0)[0].copy()
    _moved(_CURRENT, cycles, by)(samples)
    assert restart.take_snapshot(_after(samples, parameters), p, snapshot) and not restart.why_implausible(snapshot, p)
    assert snapshot[field] == pytest.approx(cycles, rel=0.15)
    restart.resume(resumed, p, snapshot, 60.0)
    assert resumed["alignment"][field] == snapshot[field]
    snapshot[field] = beyond
    assert restart.why_implausible(snapshot, p) == field


def test_pads_are_led_on_by_the_delay_and_the_filter_together(parameters):
    """A motor that turns steadily is as far on after two cycles and a filter of two as after four of either."""
    p = brake.ideal(parameters)
    rows, force = brake.samples(p, brake.clamp(p, 20.0, 1.0))
    state, forces = new_state(), []
    estimate(rows[:-4], p, state)
    rows = rows[:-4]
    s, last, out = state[0], rows[-1].copy(), np.zeros(1, ESTIMATE)[0]
    angle, speed = float(last["angle"]), float(last["speed"])
    for delay, lag in ((2.0, -2.0), (4.0, 0.0), (-2.0, -2.0), (0.0, -4.0)):
        s["alignment"]["delay"], s["alignment"]["lag"] = delay, lag
        last["angle"], out["force"] = angle - max(delay, 0.0) * _DT * speed, 1e4
        _lead(s, p, last, angle, speed, out)
        forces.append(float(out["force"]))
    assert forces == pytest.approx(4 * [forces[-1]])
    assert forces[-1] - 1e4 == pytest.approx(force[-1] - force[-5], rel=0.1)


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("delay_left", 1.0, True),
        ("delay", 3.9, False),
        ("delay", 4.0, True),
        ("delay", -3.0, True),
        ("lag_left", 1.0, True),
        ("lag_left", -1.0, True),
        ("lag", 11.0, False),
        ("lag", 12.0, True),
        ("lag", -12.0, True),
    ],
)
def test_the_fact(parameters, field, value, told):
    s = new_state()[0]
    s["alignment"][field] = value
    assert bool(fuse._facts_of_torque(s, parameters[0]) & CURRENT_APART) == told


@pytest.mark.parametrize("cycles", [0.5, 1.3, 2.0])
def test_motion_or_current_is_taken_from_as_long_ago_as_the_other_is_late(cycles):
    """Between two samples too, and over samples that come at other times."""
    for sign in (1.0, -1.0):
        a, m, now = np.zeros(1, ALIGNMENT)[0], np.zeros(1, SAMPLE)[0], 0.0
        a["delay"] = sign * cycles
        for step, dt in enumerate([0.0, *np.tile([_DT, 0.5 * _DT, 1.5 * _DT], 10)]):
            now += dt
            m["dt"], m["angle"], m["speed"], m["current_q"] = dt, 100.0 * now, 5.0 * now, 7.0 * now
            align(a, m)
            then = now - cycles * _DT
            expected = (100.0 * then, 5.0 * then, 7.0 * now) if sign > 0.0 else (100.0 * now, 5.0 * now, 7.0 * then)
            if step > 10:
                assert (m["angle"], m["speed"], m["current_q"]) == pytest.approx(expected)


def test_the_least_of_some_squares_lies_between_them():
    """Where the parabola through them has its vertex, and as low; of the first or last one, there."""
    place = np.arange(7.0)
    assert alignment._least((place - 2.3) ** 2 + 0.7) == pytest.approx((2.3, 0.7))
    assert alignment._least(place + 1.0) == (0.0, 1.0)


def test_where_the_motion_waits_for_its_current_the_force_is_that_of_now(parameters):
    """Two cycles of a fast stroke would be hundreds of newtons."""
    p = brake.ideal(parameters)
    rows, force = brake.samples(p, brake.clamp(p, 14.0, 0.25))
    rows["current_q"][2:] = rows["current_q"][:-2].copy()
    state = new_state()
    state["alignment"]["delay"] = 2.0
    error = estimate(rows, p, state)["force"][-10:] - force[-10:]
    assert np.abs(error).max() < 0.3 * (force[-1] - force[-3]) and force[-1] - force[-3] > 300.0
