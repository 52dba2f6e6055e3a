"""Evidence over episodes: what counts as one observation, and what it takes to prove something."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import f as f_distribution

from emb_daemon.diagnose.confirmation import _fits_without
from emb_daemon.diagnose.episodes import by_turns, episodes, yielding
from emb_daemon.diagnose.evidence import Averaging, Moments, judge, judge_by_turns, leave_out, leave_out_within, solve_within


def _autocorrelated(rng, episodes_, samples):
    noise = rng.standard_normal((episodes_, samples))
    noise[:, 1:] *= np.sqrt(1.0 - 0.98**2)
    return lfilter([1.0], [1.0, -0.98], noise).ravel()


def test_autocorrelated_noise_is_no_effect():
    """The figure of the engineering notes: rho 0.98, nothing there. Plain t-tests find something in most runs."""
    rng = np.random.default_rng(1)
    count, length, runs = 30, 60, 400
    episode = np.repeat(np.arange(count), length)
    clustered = naive = 0
    for _ in range(runs):
        residual, regressor = _autocorrelated(rng, count, length), _autocorrelated(rng, count, length)
        moments = Moments.of(np.column_stack([np.ones(count * length), regressor]), residual, episode, count)
        verdict_ = judge(moments, [0], [1], np.zeros(2))
        clustered += verdict_.p_value < 0.01
        slope = np.polyfit(regressor, residual, 1)[0]
        naive += abs(slope) / (residual.std() / regressor.std() / np.sqrt(count * length)) > 2.576
    assert naive > 0.3 * runs
    # One per cent of 400 is 4; nine happen by chance less than once in fifty.
    assert clustered <= 9


def test_a_true_effect_is_seen_with_its_size_and_sigma():
    rng = np.random.default_rng(2)
    count, length = 30, 60
    episode = np.repeat(np.arange(count), length)
    values, sigmas, seen = [], [], 0
    for _ in range(60):
        regressor = _autocorrelated(rng, count, length)
        moments = Moments.of(regressor[:, None], regressor + _autocorrelated(rng, count, length), episode, count)
        verdict_ = judge(moments, [], [0], np.zeros(1))
        seen += verdict_.p_value < 0.01 and verdict_.gain > 0.0
        values.append(verdict_.values[0])
        sigmas.append(verdict_.sigmas[0])
    assert seen >= 55
    assert np.mean(values) == pytest.approx(1.0, abs=0.06)
    assert np.mean(sigmas) == pytest.approx(np.std(values), rel=0.35)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.integers(1, 16))
def test_means_lose_nothing_that_lasts_and_cross_no_episode(lengths, samples):
    episode = np.repeat(np.arange(len(lengths)), lengths)
    means = Averaging(episode, samples)
    level = np.arange(1.0, len(lengths) + 1.0)
    averaged = means.of(level[episode][:, None])[:, 0]
    # A level that lasts an episode keeps its sum of squares there, and its plain mean.
    np.testing.assert_allclose(np.bincount(means.episode, averaged**2), lengths * level**2)
    np.testing.assert_allclose(averaged * means.per_mean, level[means.episode])


def test_one_episode_proves_nothing():
    rng = np.random.default_rng(3)
    episode = np.repeat(np.arange(20), 50)
    regressor = np.where(episode == 7, 1.0, 0.0)
    moments = Moments.of(regressor[:, None], 10.0 * regressor + rng.standard_normal(1000), episode, 20)
    assert judge(moments, [], [0], np.zeros(1)).p_value == 1.0


def test_a_regressor_that_nuisances_span_is_not_credited():
    rng = np.random.default_rng(4)
    episode = np.repeat(np.arange(20), 50)
    nuisance = rng.standard_normal(1000)
    moments = Moments.of(np.column_stack([nuisance, 2.0 * nuisance]), 3.0 * nuisance, episode, 20)
    assert judge(moments, [0], [1], np.zeros(2)).p_value == 1.0


def test_left_out_error_is_that_of_fits_without_the_episode():
    rng = np.random.default_rng(5)
    episode = np.repeat(np.arange(6), 20)
    table, target = rng.standard_normal((120, 3)), rng.standard_normal(120)
    result = leave_out(Moments.of(table, target, episode, 6), np.zeros(3))
    for number in range(6):
        kept = episode != number
        values = np.linalg.lstsq(table[kept], target[kept], rcond=None)[0]
        assert result.left_out[number] == pytest.approx(np.sum((target - table @ values)[~kept] ** 2), rel=1e-6)


def _least_squares(table, target, penalty):
    """Minimum of the squared error plus ``penalty`` times each parameter's square."""
    rows, zeros = np.vstack([table, np.diag(np.sqrt(penalty))]), np.zeros(len(penalty))
    return np.linalg.lstsq(rows, np.concatenate([target, zeros]), rcond=None)[0]


def test_evidence_is_what_its_definition_gives():
    """Sample by sample instead of by moments: jackknife, left-out error, effective clusters and the test they make."""
    rng = np.random.default_rng(9)
    episode = np.repeat(np.arange(9), rng.integers(15, 30, 9))
    count, table = len(episode), rng.standard_normal((len(episode), 4))
    table[:, 2] += 0.5 * table[:, 0]
    # Some episodes carry the candidate more than others; of one nothing is known.
    table[:, 2:] *= rng.uniform(0.2, 3.0, 9)[episode, None]
    target = table @ [1.0, -2.0, 0.08, 0.05] + rng.standard_normal(count)
    table[episode == 4], target[episode == 4] = 0.0, 0.0
    penalty, nuisances, candidate = np.array([3.0, 40.0, 20.0, 0.0]), [1, 0], [3, 2]
    columns = nuisances + candidate
    found = judge(Moments.of(table, target, episode, 9), nuisances, candidate, penalty)

    def left_out(of):
        values = [_least_squares(table[episode != g][:, of], target[episode != g], penalty[of]) for g in range(9)]
        errors = [np.sum((target - table[:, of] @ v)[episode == g] ** 2) for g, v in enumerate(values)]
        return np.array(values), np.array(errors)

    without, errors = left_out(columns)
    deviation = np.delete(without - _least_squares(table[:, columns], target, penalty[columns]), 4, axis=0)
    covariance = 7.0 / 8.0 * deviation.T @ deviation
    fit = leave_out(Moments.of(table, target, episode, 9).select(columns), penalty[columns])
    np.testing.assert_allclose(fit.without, without, rtol=1e-6)
    np.testing.assert_allclose(fit.left_out, errors, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-5)
    in_thousands = leave_out(Moments.of(table, 1e-3 * target, episode, 9).select(columns), penalty[columns])
    np.testing.assert_allclose(in_thousands.covariance, 1e-6 * covariance, rtol=1e-5)
    own = (
        table[:, candidate]
        - table[:, nuisances]
        @ np.array([_least_squares(table[:, nuisances], column, penalty[nuisances]) for column in table[:, candidate].T]).T
    )
    carried = np.array([own[episode == g].T @ own[episode == g] for g in range(9)])
    leverage = np.trace(carried @ np.linalg.inv(carried.sum(axis=0)), axis1=1, axis2=2)
    clusters = leverage.sum() ** 2 / np.sum(leverage**2)
    values, freedom = fit.values[2:], clusters - 2.0
    statistic = values @ np.linalg.inv(covariance[2:, 2:]) @ values
    assert found.gain == pytest.approx(np.sum(left_out(nuisances)[1] - errors), rel=1e-6)
    assert (found.clusters, found.p_value) == pytest.approx(
        (clusters, f_distribution.sf(statistic * freedom / (2.0 * (clusters - 1.0)), 2, freedom)), rel=1e-5
    )
    np.testing.assert_allclose((found.values, found.sigmas), (values, np.sqrt(np.diag(covariance)[2:])), rtol=1e-5)
    assert 1e-4 < found.p_value < 0.9 and 2.0 < freedom < 6.0


@pytest.mark.parametrize(("carriers", "judged"), [(2, False), (4, True)])
def test_two_episodes_alone_prove_nothing_however_much_they_say(carriers, judged):
    """One parameter and its spread need a third to be tested by; what they say is told all the same."""
    rng = np.random.default_rng(3)
    episode = np.repeat(np.arange(20), 50)
    regressor = np.where(episode < carriers, 1.0, 0.0)
    found = judge(
        Moments.of(regressor[:, None], 10.0 * regressor + rng.standard_normal(1000), episode, 20), [], [0], np.zeros(1)
    )
    assert (found.p_value < 1.0) == judged and found.clusters == pytest.approx(carriers)
    assert found.values == pytest.approx([10.0], abs=0.5) and found.gain > 0.0 and found.sigmas[0] < 1.0


def test_what_is_nothing_or_no_number_is_not_judged():
    episode, rng = np.repeat(np.arange(20), 50), np.random.default_rng(3)
    target = rng.standard_normal(1000)
    for column in (np.zeros(1000), np.where(episode == 3, np.nan, 1.0)):
        found = judge(Moments.of(column[:, None], target, episode, 20), [], [0], np.zeros(1))
        assert (found.p_value, found.gain, found.clusters, len(found.values)) == (1.0, 0.0, 0.0, 0)
    small = judge(Moments.of(1e-3 * target[:, None], target, episode, 20), [], [0], np.zeros(1))
    assert small.p_value < 1e-9 and small.values == pytest.approx([1000.0])


def test_a_column_that_is_nothing_leaves_the_others_alone():
    rng = np.random.default_rng(5)
    episode, table = np.repeat(np.arange(6), 20), rng.standard_normal((120, 3))
    table[:, 1] = 0.0
    target = table @ [1.0, 0.0, 2.0]
    result = leave_out(Moments.of(table, target, episode, 6), np.array([0.0, 1.0, 0.0]))
    assert result.values == pytest.approx([1.0, 0.0, 2.0])
    nothing = leave_out(Moments.of(table[:, :0], target, episode, 6), np.zeros(0))
    assert nothing.values.shape == (0,) and nothing.covariance.shape == (0, 0) and nothing.without.shape == (6, 0)
    np.testing.assert_allclose(nothing.left_out, [np.sum(target[episode == g] ** 2) for g in range(6)])


def test_means_are_of_as_many_samples_as_asked_for():
    means = Averaging(np.repeat([0, 1], [7, 4]), 3)
    np.testing.assert_allclose(means.per_mean**-2, [3, 3, 1, 3, 1])
    column = np.arange(11.0)
    np.testing.assert_allclose((means.of(column[:, None])[:, 0] * means.per_mean), [1.0, 4.0, 6.0, 8.0, 10.0])
    # Samples that do not tell have no share in them, and where none does there is nothing.
    told = np.isin(column, (0.0, 3.0, 4.0, 6.0, 7.0, 8.0))
    some = Averaging(np.repeat([0, 1], [7, 4]), 3, told)
    np.testing.assert_allclose(some.per_mean[:4] ** -2, [1, 2, 1, 2])
    np.testing.assert_allclose((some.of(column[:, None])[:, 0] * some.per_mean), [0.0, 3.5, 6.0, 7.5, 0.0])


def test_means_of_products_are_those_of_a_table_of_them():
    rng, episode = np.random.default_rng(5), np.repeat([0, 1, 4], [7, 1, 12])
    means = Averaging(episode, 3, rng.uniform(size=20) < 0.7)
    columns, factor = list(rng.normal(size=(2, 20))), rng.normal(size=20)
    np.testing.assert_allclose(means.of_products(columns, factor), means.of(np.column_stack(columns) * factor[:, None]))


def test_episodes_end_when_the_brake_is_released_and_long_ones_are_cut():
    time = np.arange(0.0, 100.0, 0.004)
    force = np.where((time % 10.0 > 4.0) & (time < 50.0), 5000.0, 0.0)
    force[time >= 60.0] = 4000.0
    number = episodes(time, force, np.cumsum(np.ones(len(time))))
    assert np.all(np.diff(number) >= 0) and np.all(np.diff(number) <= 1)
    ends = time[np.flatnonzero(np.diff(number))]
    for release in (10.0, 20.0, 30.0, 40.0, 50.0):
        assert np.abs(ends - release).min() < 0.01
    assert max(np.bincount(number)) * 0.004 < 12.0


def test_episodes_are_the_same_whenever_a_log_begins():
    time = np.arange(0.0, 60.0, 0.01)
    force = np.where(time % 10.0 > 4.0, 5000.0, 0.0)
    angle = np.cumsum(np.ones(len(time)))
    number = episodes(time, force, angle)
    assert np.array_equal(episodes(time + 5000.0, force, angle), number)
    assert not len(episodes(time[:0], force[:0], angle[:0]))


def test_a_short_log_is_cut_into_forty_pieces_and_no_shorter_than_half_a_second():
    """And an application that is shorter than a piece into none."""
    for seconds, pieces in ((24.0, 40), (10.0, 20), (400.0, 50)):
        time = np.arange(0.0, seconds, 0.01)
        number = episodes(time, np.full(len(time), 3000.0), np.cumsum(np.ones(len(time))))
        assert number[-1] + 1 == pytest.approx(pieces, abs=1)
        assert np.bincount(number)[:-1] == pytest.approx(100.0 * seconds / pieces, abs=2)
    time = np.arange(0.0, 400.0, 0.01)
    number = episodes(time, np.where(time % 5.0 > 2.0, 5000.0, 0.0), np.cumsum(np.ones(len(time))))
    assert number[-1] + 1 == 80 and np.all(np.bincount(number) == 500)


def test_a_pause_of_less_than_a_third_of_a_second_ends_no_application():
    time = np.arange(0.0, 400.0, 0.01)
    numbers = []
    for pause_s in (0.28, 0.32):
        force = np.where(np.abs(time - 200.0) < 3.0, 5000.0, 0.0)
        force[np.abs(time - 200.0) <= 0.5 * pause_s] = 0.0
        numbers.append(episodes(time, force, np.where(np.abs(time - 200.0) < 4.0, time, 0.0)))
    short, long = (time[np.flatnonzero(np.diff(number)) + 1] for number in numbers)
    assert np.setdiff1d(long, short) == pytest.approx([199.84], abs=0.011) and not len(np.setdiff1d(short, long))


def test_of_short_applications_that_ends_an_episode_which_is_half_a_second_after_the_last_end():
    """Each of 0.2 s, with pauses of 0.35 s: the first has no episode of its own."""
    time = np.arange(0.0, 6.0, 0.01)
    number = episodes(time, np.where((time + 0.345) % 0.55 > 0.35, 5000.0, 0.0), np.zeros(len(time)))
    assert time[np.flatnonzero(np.diff(number)) + 1] == pytest.approx(np.arange(0.76, 5.8, 0.55), abs=0.011)


def test_a_hold_is_one_episode_however_long():
    """Two halves of a hold would vouch for each other: what is aliased in one is aliased in the other."""
    time = np.arange(0.0, 100.0, 0.004)
    angle = np.where(time < 60.0, 5.0, 5.0 + 3.0 * np.sin(time))
    number = episodes(time, np.full(len(time), 3000.0), angle)
    assert len(set(number[time < 59.9])) == 1
    assert len(set(number[time > 60.1])) >= 4


def test_what_follows_the_disc_is_seen_anew_after_whole_turns_of_it():
    """A hold of a minute, half of it with the disc at a stand, then a short one."""
    time = np.arange(0.0, 66.0, 0.004)
    wheel = 7.0 + 20.0 * np.minimum(time, 30.0) + 20.0 * np.maximum(time - 60.0, 0.0)
    number = np.where(time < 60.0, 0, 1)
    parts = by_turns(number, time, wheel)
    cuts = np.flatnonzero(np.diff(parts)) + 1
    assert np.isin(np.flatnonzero(np.diff(number)) + 1, cuts).all(), "no part crosses episodes"
    inside = cuts[time[cuts] < 59.9]
    assert len(inside) >= 3 and np.diff(time[np.append(0, inside)]).min() >= 8.0
    turns = (wheel[inside] - wheel[0]) / (2.0 * np.pi)
    assert turns == pytest.approx(np.round(turns), abs=20.0 * 0.004 / 6.0)
    assert (time[inside] < 30.1).all(), "a disc that stands shows the same all the time"
    assert len(set(parts[time > 60.1])) == 1


@pytest.mark.parametrize(
    ("amplitude", "one_phase", "low", "high"), [(0.0, True, 0, 6), (1.0, True, 100, 100), (1.0, False, 0, 8)]
)
def test_turns_of_the_disc_count_only_where_holds_agree(amplitude, one_phase, low, high):
    """3 to 6 drags of 20 to 120 s at one speed each, a friction that is another in each drag and noise that lasts a second,
    with or without what follows the disc. One per cent of 100 is 1; six by chance less than once in a thousand. What has
    another phase in each drag reaches the agreement that is asked in 4 of 100."""
    rng, runs, seen, tau, step = np.random.default_rng(6), 100, 0, 1.0, 0.04
    rho = np.exp(-step / tau)
    for _ in range(runs):
        count = rng.integers(3, 7)
        drag = np.repeat(np.arange(count), rng.integers(500, 3000, count))
        wheel = np.cumsum(rng.uniform(3.0, 60.0, count)[drag]) * step
        phase = np.zeros(count) if one_phase else rng.uniform(0.0, 2.0 * np.pi, count)
        noise = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], rng.standard_normal(len(drag)))
        residual = noise + rng.normal(size=count)[drag] + amplitude * np.cos(wheel + phase[drag])
        columns = np.column_stack([np.ones(len(drag)), np.cos(wheel), np.sin(wheel)])
        parts = drag, by_turns(drag, step * np.arange(len(drag)), wheel)

        def judged(turns, columns=columns, residual=residual, parts=parts):
            number = parts[turns]
            return judge(Moments.of(columns, residual, number, number[-1] + 1), [0], [1, 2], np.zeros(3))

        found = judge_by_turns(judged)
        seen += found.p_value < 0.01 and found.gain > 0.0
    assert low <= seen <= high


def test_a_hold_begins_when_the_motor_has_stopped():
    """Forty pieces of a log are wanted, a second each: one of them would end a tenth of a second into the hold."""
    time = np.arange(0.0, 40.0, 0.01)
    number = episodes(time, np.full(len(time), 3000.0), np.where(time < 7.9, 5.0 + 7.9 - time, 5.0))
    assert len(set(number[time > 7.91])) == 1 and number[time < 7.5][-1] > 5


def test_holds_whose_way_was_not_recorded_are_several_episodes():
    """A bench that keeps the settled part of each load step alone: between two parts the gear was wound up."""
    hold = np.arange(0.0, 8.0, 0.004)
    time = np.concatenate([hold + 80.0 * part for part in range(8)])
    wound = np.repeat(2.0 + 0.1 * np.arange(8), len(hold))
    force = np.full(len(time), 3000.0)
    assert len(set(episodes(time, force, wound))) == 8
    assert len(set(episodes(time, force, np.full(len(time), 2.0)))) == 1


def test_a_column_of_nothing_overflows_nothing():
    """An effect whose signal stays at nothing, whatever is known of it beforehand."""
    table = np.column_stack([np.zeros(60), np.linspace(0.0, 1.0, 60)])
    moments = Moments.of(table, 2.0 * table[:, 1], np.repeat(np.arange(6), 10), 6)
    with np.errstate(all="raise"):
        found = leave_out(moments, np.array([1e12, 0.0]))
    np.testing.assert_allclose(found.values, [0.0, 2.0], atol=1e-6)


def test_what_a_bound_holds_the_others_do_otherwise():
    """Of two columns that nearly are one, the first may not be negative: the second alone does what both would."""
    random = np.random.default_rng(1)
    one = random.normal(size=600)
    table = np.column_stack([one, one + 0.01 * random.normal(size=600)])
    target = table @ [-3.0, 5.0] + 0.1 * random.normal(size=600)
    moments = Moments.of(table, target, np.arange(600) // 100, 6)
    free = solve_within(moments, np.zeros(2), np.full(2, -np.inf), np.full(2, np.inf))
    assert free == pytest.approx(np.linalg.lstsq(table, target)[0], rel=1e-4) and free[0] < 0.0
    held = solve_within(moments, np.zeros(2), np.array([0.0, -np.inf]), np.full(2, np.inf))
    assert held[0] == 0.0 and held[1] == pytest.approx(table[:, 1] @ target / (table[:, 1] @ table[:, 1]), rel=1e-6)


def test_what_would_have_to_pass_a_bound_without_a_candidate_is_no_reason_against_it():
    """A drag over the square of a speed is nearly a steeper one in proportion less a friction, which may not be negative."""
    random = np.random.default_rng(2)
    speed = np.repeat(random.uniform(0.5, 1.0, 60), 20)
    table = np.column_stack([np.ones(1200), speed, speed**2])
    moments = Moments.of(table, 1.0 * speed**2 + 0.01 * random.normal(size=1200), np.arange(1200) // 100, 12)
    plain, penalty = moments.select([0, 1]), np.zeros(3)
    low, high = np.array([0.0, -np.inf]), np.full(2, np.inf)
    within = leave_out_within(plain, penalty[:2], low, high)
    assert within.sum() == pytest.approx(leave_out(plain.select([1]), penalty[:1]).left_out.sum(), rel=1e-6)
    assert judge(moments, [0, 1], [2], penalty, within).gain > 5.0 * judge(moments, [0, 1], [2], penalty).gain > 0.0
    far = leave_out_within(plain, penalty[:2], np.array([-5.0, -np.inf]), high)
    np.testing.assert_allclose(far, leave_out(plain, penalty[:2]).left_out, rtol=1e-9)


@pytest.mark.parametrize("phases", [2, 3, 4, 5, 8])
def test_no_phase_of_a_manoeuvre_that_is_repeated_is_left_out_whole(phases):
    """Run up, held, slowed down, at rest: what is fitted without one of them cannot tell it."""
    model = SimpleNamespace(bench=SimpleNamespace(episodes=10 * phases, channels=[]))
    parts = [own for own, _ in _fits_without(SimpleNamespace(model=model, applied=lambda without: {}), "")]
    assert np.sum(parts, axis=0).tolist() == 10 * phases * [1]
    assert all(part.reshape(-1, phases).mean(axis=0).max() < 0.8 for part in parts)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_load_that_grows_against_a_motor_that_holds_turns_its_friction_back(way):
    """Motor that closes (``way`` 1) or opens for a second, then holds for three, its load swinging as over an uneven disc."""
    time = 0.004 * np.arange(1000)
    moves, noise = time < 1.0, np.random.default_rng(0).normal(0.0, 25.0, len(time))
    angle, friction = way * np.minimum(time, 1.0) * 20.0, np.full(len(time), way)

    def of(force):
        return yielding(angle, force + noise, friction, np.full(len(time), 400.0))

    held = 8000.0 + 6000.0 * way * np.minimum(time - 1.0, 0.0)
    swings = of(held - 300.0 * way * np.sin(2.0 * np.pi * np.maximum(time - 1.0, 0.0)))
    assert not swings[time < 1.25].any() and swings[time > 1.75].all()
    # Settling pads take load off a motor that closes: friction stays what it was, and so it does while the motor turns.
    assert not of(held - 900.0 * way * np.maximum(time - 1.0, 0.0)).any()
    assert not of(held - 300.0 * way * np.sin(2.0 * np.pi * time) * moves).any()
    assert not of(held - 100.0 * way * np.sin(2.0 * np.pi * np.maximum(time - 1.0, 0.0))).any()


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_load_turns_friction_back_however_short_the_stop(way):
    """Motor that closes (``way`` 1) or opens, stands for a tenth of a second as it comes near its place, and goes on: by less
    than a resolver tells, friction has turned back there, and turns over again as soon as the motor slides on."""
    time = 0.004 * np.arange(500)
    stands = (time >= 1.0) & (time < 1.1)
    angle = way * 20.0 * np.where(time < 1.0, time, np.maximum(time - 0.1, 1.0))
    swing = 900.0 * way * np.clip((time - 1.0) / 0.1, 0.0, 1.0)
    found = yielding(angle, 8000.0 + swing, np.full(len(time), 0.6 * way), np.full(len(time), 300.0))
    assert found[stands & (time > 1.06)].all() and not found[time < 1.02].any() and not found[time > 1.102].any()
    assert not yielding(angle, 8000.0 - swing, np.full(len(time), 0.6 * way), np.full(len(time), 300.0)).any()


def test_moments_are_those_of_each_episodes_samples():
    """One without samples has none."""
    rng, lengths = np.random.default_rng(5), [3, 0, 5, 1]
    regressors, residual, episode = rng.standard_normal((9, 2)), rng.standard_normal(9), np.repeat(np.arange(4), lengths)
    moments = Moments.of(regressors, residual, episode, 4)
    table = np.column_stack([regressors, residual])
    assert moments.counts.tolist() == lengths and moments.products.shape == (4, 3, 3)
    for number, products in enumerate(moments.products):
        np.testing.assert_allclose(products, table[episode == number].T @ table[episode == number])
