"""Plausibility by hand: sums, bands and verdicts of single samples. `test_plausibility.py` has whole drives."""

import numpy as np
import pytest

from emb_daemon.estimator.records import SAMPLE
from emb_daemon.models.plausibility import (
    AGREE,
    PLAUSIBILITY,
    STIFFNESS_WRONG,
    TORQUE_FROZEN,
    TORQUE_WRONG,
    UNDECIDED,
    beyond_friction,
    count_contradiction,
    due,
    force_beside_friction,
    force_of_torque_alone,
    frozen,
    hold,
    smoothed_sigma,
    stands,
    steady,
    watch,
)

_DT = 0.004


class Watched:
    """A resolver and a current that pass by, sample after sample."""

    def __init__(self, contradiction=0.0):
        self.c = np.zeros(1, PLAUSIBILITY)
        self.c["contradiction"] = contradiction
        self.m = np.zeros(1, SAMPLE)
        self.m["dt"], self.m["has_current"] = _DT, True
        self._noise = np.random.default_rng(1)

    def pass_by(self, count, speed=0.0, follows=1.0, current=None, past_contact=1.0, confirmed=True, angle_noise=0.0):
        """``count`` samples at ``speed``; the angle follows it by that share. Returns the last verdict."""
        m = self.m[0]
        for _ in range(count):
            angle, before = float(m["angle"]), float(m["speed"])
            m["angle"] += follows * speed * _DT + angle_noise * self._noise.standard_normal()
            m["speed"] = speed
            m["current_q"] = self._noise.standard_normal() if current is None else current
            verdict = watch(self.c[0], m, angle, before, 0.5 * (m["speed"] + before) * m["dt"], past_contact, 0.1, confirmed)
        return verdict


def test_a_contradiction_gives_away_twenty_a_sample_and_counts_at_most_twelve_sigma():
    c = np.zeros(1, PLAUSIBILITY)
    for ratio, expected in ((5.0, 5.0), (2.0, 0.0), (-5.0, 5.0), (100.0, 129.0), (np.nan, 129.0), (0.0, 109.0)):
        count_contradiction(c[0], ratio)
        assert c["contradiction"][0] == expected
    for _ in range(100):
        count_contradiction(c[0], 12.0)
    assert c["contradiction"][0] == 1.5 * 5.0 * 600.0


def test_torque_beyond_friction():
    """4 N m on 100 kN at 4e-5 m/rad carry nothing; friction of 0.05 N m and 1e-6 m/rad takes 0.15 N m, at rest 0.195."""
    arguments = {"force": 100_000.0, "sigma": 0.5, "gear_gain": 4e-5, "load_friction": 1e-6, "offset_friction": 0.05}
    for torque, beyond in ((4.0, 0.0), (4.19, 0.0), (4.2, 0.01), (3.81, 0.0), (3.0, 1.61), (5.0, 1.61)):
        assert beyond_friction(torque, **arguments) == pytest.approx(beyond, abs=1e-12)


def test_force_of_torque_alone_settles_on_the_torque_with_friction_for_sigma():
    c = np.zeros(1, PLAUSIBILITY)[0]
    for _ in range(200):
        force, sigma = force_of_torque_alone(c, 0.4, True, _DT, 4e-5, 8e-6, 0.03, 0.0)
    assert force == pytest.approx(10_000.0, rel=1e-6)
    assert sigma == pytest.approx((0.03 + 8e-6 * 10_000.0) / 4e-5, rel=1e-4)
    after, wider = force_of_torque_alone(c, 0.8, True, _DT, 4e-5, 8e-6, 0.03, 0.0)
    share = 1.0 - np.exp(-0.1)
    assert after == pytest.approx(10_000.0 * (1.0 + share))
    variance = (1.0 - share) * share * 0.4**2
    assert wider == pytest.approx(np.hypot(0.03 + 8e-6 * after, np.sqrt(variance)) / 4e-5)
    assert force_of_torque_alone(c, 99.0, False, _DT, 4e-5, 8e-6, 0.03, 0.0) == (after, wider), "no current, no news"
    for _ in range(200):
        force, sigma = force_of_torque_alone(c, -0.4, True, _DT, 4e-5, 8e-6, 0.03, 0.0)
    assert force == 0.0 and sigma == pytest.approx(0.03 / 4e-5, rel=1e-3)


def test_beside_a_motion_that_is_known_friction_is_taken_out_of_the_torque():
    """0.4 N m at 4e-5 m/rad less 8e-6 m/rad and 0.03 N m of friction, each way; of a state that was forgotten as without."""
    c = np.zeros(1, PLAUSIBILITY)[0]
    alone = force_of_torque_alone(c, 0.4, True, _DT, 4e-5, 8e-6, 0.03, 0.0)
    assert c["steady"] == 0.4, "the first torque counts in full"
    for state, expected in ((1.0, 0.37 / 4.8e-5), (-1.0, 0.43 / 3.2e-5)):
        force, sigma = force_beside_friction(c, state, 0.0, 4e-5, 8e-6, 0.03, 0.0)
        assert force == pytest.approx(expected) and sigma < 1e-9
        assert force_beside_friction(c, state, 1.0, 4e-5, 8e-6, 0.03, 0.0) == pytest.approx(alone)
    half = force_beside_friction(c, 1.0, 0.5, 4e-5, 8e-6, 0.03, 1000.0)
    assert half[0] == pytest.approx((0.4 - 0.015) / 4.4e-5 - 1000.0)
    assert half[1] == pytest.approx((0.03 + 8e-6 * half[0]) * np.sqrt(0.75) / 4.4e-5)


def test_a_motion_that_fits_raises_nothing():
    for speed in (0.0, 50.0, -200.0):
        assert Watched().pass_by(500, speed=speed) == AGREE


def test_contradiction_raises_at_600_and_ends_at_150():
    watched = Watched(600.0)
    assert watched.pass_by(1, speed=10.0) == AGREE
    watched.c["contradiction"] = 600.1
    assert watched.pass_by(1, speed=10.0) == UNDECIDED
    watched.c["contradiction"] = 150.1
    assert watched.pass_by(1, speed=10.0) == UNDECIDED
    watched.c["contradiction"] = 150.0
    assert watched.pass_by(1, speed=10.0) == AGREE


def test_contradiction_raises_five_times_later_before_the_contact_is_confirmed():
    assert Watched(2999.0).pass_by(1, speed=10.0, confirmed=False) == AGREE
    assert Watched(3001.0).pass_by(1, speed=10.0, confirmed=False) == UNDECIDED
    frozen_current = Watched(0.0)
    frozen_current.pass_by(9, speed=10.0, current=1.0, confirmed=False)
    frozen_current.c["contradiction"] = 601.0
    assert frozen_current.pass_by(1, speed=10.0, current=1.0, confirmed=False) == TORQUE_FROZEN


def test_force_without_contact_is_the_torques_fault_and_stays_it():
    watched = Watched(700.0)
    assert watched.pass_by(1, speed=10.0, past_contact=-0.59) == UNDECIDED
    assert watched.pass_by(1, speed=10.0, past_contact=-0.61) == TORQUE_WRONG
    assert watched.pass_by(1, speed=10.0, past_contact=5.0) == TORQUE_WRONG


def test_a_current_that_repeats_while_the_motor_turns_is_frozen():
    watched = Watched(700.0)
    assert watched.pass_by(8, speed=10.0, current=3.0) == UNDECIDED
    assert watched.pass_by(1, speed=10.0, current=3.0) == TORQUE_FROZEN
    assert frozen(watched.c[0])


def test_an_angle_that_repeats_under_torque_that_must_turn_the_motor_is_stuck():
    watched = Watched(0.0)
    watched.pass_by(1, speed=0.0)
    watched.pass_by(7, speed=0.0)
    watched.c["contradiction"] = 700.0
    assert watched.pass_by(1, speed=0.0) == STIFFNESS_WRONG


def test_angle_and_speed_that_repeat_for_fifty_samples_are_stuck_unless_the_motor_stands():
    watched = Watched()
    watched.m["speed"] = 0.5
    assert watched.pass_by(49, speed=0.5, follows=0.0) == AGREE
    assert watched.pass_by(1, speed=0.5, follows=0.0) == STIFFNESS_WRONG
    assert watched.c["frozen_s"][0] == pytest.approx(50 * _DT)
    assert Watched().pass_by(500, speed=0.0) == AGREE


@pytest.mark.parametrize(("flickers", "verdict"), [(49, AGREE), (50, STIFFNESS_WRONG)])
def test_who_flickered_at_rest_fifty_times_is_stuck_when_twelve_samples_repeat(flickers, verdict):
    watched = Watched()
    for sample in range(flickers):
        watched.pass_by(1, speed=1e-3 * (1 + sample % 2), follows=0.0)
    speed = float(watched.m["speed"][0])
    assert watched.pass_by(11, speed=speed, follows=0.0) == AGREE
    assert watched.pass_by(1, speed=speed, follows=0.0) == verdict


@pytest.mark.parametrize(("speed", "samples"), [(100.0, 25), (10.0, 26)])
def test_an_angle_that_does_not_follow_the_speed_is_stuck_until_it_does_for_25_samples(speed, samples):
    """100 rad/s over 0.6 rad and the way of a delay of 10 ms, 1 rad: five samples of 0.4 rad, of which some leak away. The
    first sample of another speed is not as that says."""
    watched = Watched()
    watched.m["speed"] = 100.0
    assert watched.pass_by(3, speed=100.0, follows=0.0) == AGREE
    assert watched.pass_by(2, speed=100.0, follows=0.0) == STIFFNESS_WRONG
    before = watched.c["frozen_s"][0]
    assert watched.pass_by(samples - 1, speed=speed) == STIFFNESS_WRONG
    assert watched.c["frozen_s"][0] == pytest.approx(before + (samples - 1) * _DT), "the motor turned on meanwhile"
    assert watched.pass_by(1, speed=speed) == AGREE
    assert watched.c["contradiction"][0] == 0.0 and watched.c["frozen_s"][0] == 0.0


def test_a_small_mismatch_of_angle_and_speed_is_forgotten():
    """One percent at 200 rad/s, the gain error of a tachometer: 0.2 rad within the time that is compared, and never more."""
    watched = Watched()
    watched.m["speed"] = 200.0
    assert watched.pass_by(2000, speed=200.0, follows=0.99) == AGREE
    assert abs(watched.c["apart"][0]) == pytest.approx(0.008 / (1.0 - np.exp(-0.04)), rel=0.01)


def test_a_resolver_that_flickers_at_rest_is_not_believed_again():
    watched = Watched()
    watched.m["speed"] = 100.0
    assert watched.pass_by(5, speed=100.0, follows=0.0) == STIFFNESS_WRONG
    assert watched.pass_by(200, speed=0.0, angle_noise=1e-3) == STIFFNESS_WRONG
    assert watched.pass_by(24, speed=10.0) == STIFFNESS_WRONG
    assert watched.pass_by(1, speed=10.0) == AGREE


def _due_after(angles, acceleration, delay=0.0):
    """Samples after which a motor at ``angles`` (rad) must have turned at ``acceleration``, rad/s²."""
    c = np.zeros(1, PLAUSIBILITY)
    for sample, angle in enumerate(angles):
        if stands(c[0], angle) and due(c[0], acceleration, delay, _DT):
            return sample
    return None


@pytest.mark.parametrize("acceleration", [20.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0, 50000.0])
def test_a_motor_that_comes_in_and_turns_back_is_not_due(acceleration):
    """However the samples fall about its turning point."""
    for phase in np.linspace(0.0, 1.0, 21):
        t = _DT * (np.arange(-60, 60) + phase)
        assert _due_after(0.5 * acceleration * t * t, acceleration) is None


def test_a_motor_that_stands_under_a_torque_that_must_turn_it_is_due():
    """At 1000 rad/s² it turns by half a fortieth of a radian in the first seven milliseconds, wherever the resolver stands."""
    flicker = 1e-3 * np.random.default_rng(1).standard_normal(500)
    assert _due_after(flicker, 1000.0) <= 4
    assert _due_after(np.ones(9), 1e6) == 2, "two samples that stand after the first are enough"
    assert _due_after(flicker, 1000.0, delay=0.02) == pytest.approx(2 * 0.02 / _DT, abs=2)
    assert _due_after(flicker, 0.0) is None and _due_after(flicker, -1000.0) is None


def test_an_angle_that_flickers_stands_on_however_far_out_the_sample_was_in_which_it_came_to_stand():
    """What has been seen of a torque that must turn the motor is forgotten only where the angle moves."""
    c = np.zeros(1, PLAUSIBILITY)
    angles = np.concatenate([[0.0, 0.0075], 0.004 + 1e-3 * np.random.default_rng(1).standard_normal(20_000)])
    assert [stands(c[0], angle) for angle in angles].count(False) == 1
    assert not stands(c[0], 0.012)


def test_a_torque_of_one_sample_may_have_just_begun():
    c = np.zeros(1, PLAUSIBILITY)
    said = [stands(c[0], 0.0) and due(c[0], acceleration, 0.0, _DT) for acceleration in [0.0] * 20 + [50_000.0, 0.0] * 20]
    assert not any(said)


def _swings(torques, angles=None, presliding_angle=0.02, force=0.0, load=0.0, friction_sigma=0.0, load_sigma=0.0):
    """What `hold` makes of smoothed torques (N m) over a force that friction of 0.1 N m and ``load`` m/rad holds."""
    c = np.zeros(1, PLAUSIBILITY)
    stands(c[0], 1.0)
    counted = 0
    for torque, angle in zip(torques, np.ones(len(torques)) if angles is None else angles, strict=True):
        c["steady"] = torque
        if stands(c[0], angle):
            counted = hold(c[0], force, 0.006, 4e-5, load, 0.1, friction_sigma, load_sigma, presliding_angle)
    return counted


def test_torque_that_swings_by_more_than_friction_carries_beside_a_standing_angle():
    """Twice the dry friction and a third more, 0.26 N m, and ten standard deviations of 0.006 N m."""
    assert _swings([0.0, 0.315, 0.0]) == 0
    assert _swings([0.0, 0.325]) == 1
    assert _swings([0.0, 0.325, 0.0, 0.325]) == 3
    assert _swings([0.0, 0.325, 0.0, 0.0], [1.0, 1.0, 1.0, 1.006]) == 2
    assert _swings([0.0, 0.325, 0.0, 0.0], [1.0, 1.006, 1.006, 1.006]) == 1, "counted from where the angle moved last"


def test_what_the_load_adds_to_friction_turns_over_with_the_angle():
    """Of 0.26 N m, 1 - exp(-0.5) within half a presliding angle: 0.102."""
    loaded = {"force": 2e4, "load": 5e-6}
    assert _swings([0.0, 0.417], **loaded) == 0 and _swings([0.0, 0.427], **loaded) == 1
    stiff = loaded | {"presliding_angle": 1e-4}
    assert _swings([0.0, 0.575], **stiff) == 0 and _swings([0.0, 0.585], **stiff) == 1


def test_a_swing_is_none_that_unknown_friction_or_an_uneven_disc_may_be():
    """Three standard deviations each, of friction in both directions."""
    assert _swings([0.0, 0.435], friction_sigma=0.02) == 0 and _swings([0.0, 0.445], friction_sigma=0.02) == 1
    assert _swings([0.0, 0.345], load_sigma=0.01) == 0 and _swings([0.0, 0.355], load_sigma=0.01) == 1


def test_the_smoothed_torque_of_first_order_noise_has_the_standard_deviation_that_is_said():
    rng, c = np.random.default_rng(1), np.zeros(1, PLAUSIBILITY)
    sigma, correlation_time = 0.05, 0.02
    stays = np.exp(-_DT / correlation_time)
    noise, seen = 0.0, []
    for _ in range(50_000):
        noise = stays * noise + sigma * np.sqrt(1.0 - stays**2) * rng.standard_normal()
        steady(c[0], 0.3 + noise, 0.0, _DT)
        seen.append(c["steady"][0])
    assert np.std(seen[100:]) == pytest.approx(smoothed_sigma(sigma, correlation_time), rel=0.1)


def test_frozen_is_one_sensor_that_repeats_while_the_other_goes_on():
    watched = Watched()
    watched.pass_by(3, speed=10.0)
    assert not frozen(watched.c[0])
    watched.pass_by(2, speed=10.0, current=1.0)
    assert watched.c["idle"][0] == 1 and frozen(watched.c[0])
    watched = Watched()
    watched.pass_by(1, speed=10.0)
    watched.pass_by(2, speed=0.0)
    assert watched.c["still"][0] == 1 and frozen(watched.c[0])
    watched.pass_by(3, speed=0.0, current=1.0)
    assert watched.c["idle"][0] == 2 and not frozen(watched.c[0]), "both repeat: nothing happens at all"


def test_a_current_that_repeats_five_times_while_the_motor_turns_is_at_its_sensors_limit():
    """And is not believed there, on either side, until it goes beyond; one that hardly flickered may just be coarse."""
    w = Watched()
    w.pass_by(60, speed=100.0)
    w.pass_by(1, speed=100.0, current=9.05)
    assert w.pass_by(5, speed=100.0, current=9.0) == AGREE
    assert w.pass_by(1, speed=100.0, current=9.0) == TORQUE_FROZEN and w.c["limit"][0] == 9.0
    assert w.pass_by(1, speed=100.0, current=3.0) == AGREE and w.c["limit"][0] == 9.0
    assert w.pass_by(1, speed=100.0, current=-9.0) == TORQUE_FROZEN
    assert w.pass_by(1, speed=100.0, current=9.1) == AGREE and w.c["limit"][0] == 0.0
    new = Watched()
    new.pass_by(40, speed=100.0)
    new.pass_by(10, speed=100.0, current=9.0)
    assert new.c["limit"][0] == 0.0


def test_at_the_largest_current_so_far_three_repetitions_are_enough():
    """A motor that is asked to turn needs much current for some cycles only."""
    w = Watched()
    w.pass_by(60, speed=100.0)
    assert w.pass_by(3, speed=100.0, current=-9.0) == AGREE and w.c["limit"][0] == 0.0
    assert w.pass_by(1, speed=100.0, current=-9.0) == TORQUE_FROZEN and w.c["limit"][0] == 9.0
    w.pass_by(1, speed=100.0, current=12.0)
    assert w.pass_by(4, speed=100.0, current=11.0) == AGREE and w.c["limit"][0] == 0.0


def test_a_current_that_went_beyond_its_limit_repeats_by_chance_and_needs_five():
    w = Watched()
    w.pass_by(60, speed=100.0)
    w.pass_by(4, speed=100.0, current=9.0)
    assert w.c["limit"][0] == 9.0 and not w.c["coarse"][0]
    w.pass_by(1, speed=100.0, current=12.0)
    assert w.c["coarse"][0]
    assert w.pass_by(4, speed=100.0, current=12.0) == AGREE and w.c["limit"][0] == 0.0
    assert w.pass_by(1, speed=100.0, current=12.0) == TORQUE_FROZEN and w.c["limit"][0] == 12.0


def test_a_current_that_repeats_while_the_motor_hardly_turns_has_no_limit():
    w = Watched()
    w.pass_by(60, speed=100.0)
    w.pass_by(10, speed=1.0, current=9.0)
    assert w.c["limit"][0] == 0.0
    w.pass_by(1, speed=100.0, current=9.05)
    for _ in range(4):
        w.pass_by(4, speed=100.0, current=9.0)
        w.pass_by(1, speed=1.0, current=9.0)
    assert w.c["limit"][0] == 0.0, "five in a row"


def test_what_friction_carries_grows_with_the_clamp_force():
    """With 1e-5 m/rad, of the 30 kN that are believed; or of what the torque would balance, if that is more."""
    for force, most in ((30_000.0, 1.1), (0.0, 0.32 / 0.35)):
        assert _swings([0.0, 0.99 * most], presliding_angle=1e-4, force=force, load=1e-5) == 0
        assert _swings([0.0, 1.01 * most], presliding_angle=1e-4, force=force, load=1e-5) == 1


@pytest.mark.parametrize("torque", [-3.0, 0.5, 3.0])
def test_a_torque_that_does_not_swing_has_turned_no_motor(torque):
    """However large it is."""
    c = np.zeros(1, PLAUSIBILITY)[0]
    for _ in range(200):
        steady(c, torque, 0.0, _DT)
    stands(c, 1.0)
    for _ in range(500):
        steady(c, torque, 0.0, _DT)
        assert stands(c, 0.0) in (True, False) and hold(c, 0.0, 0.006, 4e-5, 4e-6, 0.1, 0.01, 0.0, 0.03) == 0


def test_a_motor_without_torque_beyond_friction_is_never_due():
    c = np.zeros(1, PLAUSIBILITY)[0]
    assert not any(stands(c, 0.0) and due(c, 0.0, 0.0, _DT) for _ in range(1000))


@pytest.mark.parametrize("limit", [0.4, 12.0])
def test_a_current_at_its_sensors_limit_is_frozen_whatever_that_is(limit):
    w = Watched()
    w.c["limit"] = w.c["largest"] = limit
    assert w.pass_by(1, speed=50.0, current=-limit) == TORQUE_FROZEN
    assert w.pass_by(1, speed=50.0, current=0.9 * limit) == AGREE


@pytest.mark.parametrize(("most", "coarse"), [(1, True), (6, False)])
def test_a_current_in_coarse_steps_is_not_frozen_where_it_repeats(most, coarse):
    """Of one that repeats in nine samples of ten fifteen times as many repetitions are as rare as of a fine one; not of one
    that changes by several steps, of which the sender has no newer value."""
    w = Watched()
    rng = np.random.default_rng(2)
    steps = np.cumsum(np.where(rng.random(400) < 0.5, 1, -1) * rng.integers(1, most, 400, endpoint=True))
    verdicts = [w.pass_by(rng.geometric(0.1), speed=1.0, current=0.01 * step) for step in steps]
    assert w.c["current_flickered"][0] > 50 and (set(verdicts) == {AGREE}) == coarse and w.c["limit"][0] == 0.0
    assert (w.pass_by(120, speed=1.0, current=2.0) == AGREE) == coarse
    assert w.pass_by(120, speed=1.0, current=2.0) == TORQUE_FROZEN, "one that repeats on and on still is"
