"""The offline toolbox: read once, run as the estimator runs, fit what was put in, score in one place."""

import ast
import contextlib
import threading
from pathlib import Path

import numpy as np
import pytest
from synthetic_rig import draw, pads

import emb_daemon
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.records import ESTIMATE, SAMPLE
from emb_daemon.offline import estimate
from emb_daemon.offline.fit import Block, Fit, Free, fit
from emb_daemon.offline.run import held, run_paths, run_step, stiffness_force
from emb_daemon.offline.score import EpisodeErrors, figures, force_figures, rmse, share_inside
from emb_daemon.offline.stretches import stretches_of, without_gaps
from emb_daemon.wire import contract


@pytest.fixture(scope="module")
def random_motion():
    """Samples of a random motor angle, and the shipped calibration's record."""
    rng = np.random.default_rng(7)
    samples = pads(draw(rng), rng)[0].logs[1].samples
    return samples, np.array([to_parameters(shipped_calibration())])


def test_paths_alone_and_the_whole_step_start_alike_and_give_the_same_forces(random_motion):
    samples, parameters = random_motion
    # Without thermocouples the pads count as cold, and with the contact angle held nothing else moves the stiffness path.
    parameters = held(parameters)
    step, paths = run_step(samples, parameters), run_paths(samples, parameters)
    assert np.array_equal(step["force"], estimate(samples, parameters)["stiffness_force"])
    assert np.array_equal(paths["force"], step["force"])
    assert np.array_equal(stiffness_force(samples, parameters), step["force"])
    assert np.array_equal(paths["torque"], step["torque"], equal_nan=True)
    assert np.array_equal(paths["leverage"][1:], step["leverage"][1:])
    assert step["force"].max() > 5000.0 and np.isfinite(paths["torque"]).mean() > 0.9


def test_a_piece_out_of_a_log_begins_settled(random_motion):
    """Cut at the top of a slow clamp, the piece gives the whole log's forces but for what hysteresis remembers."""
    _, parameters = random_motion
    rng = np.random.default_rng(7)
    samples = pads(draw(rng), rng)[0].logs[0].samples
    whole = stiffness_force(samples, parameters)
    cut = int(np.argmax(samples["angle"]))
    piece = parameters.copy()
    piece["clearance"] += samples["angle"][0] - samples["angle"][cut]
    assert np.max(np.abs(stiffness_force(samples[cut:], piece) - whole[cut:])) < 0.04 * whole[cut]


# -- fit ------------------------------------------------------------------------------------------------------------------


def _decay(time, amplitude, rate, offset):
    return amplitude * np.exp(-rate * time) + offset


def _coloured(rng, count, correlation=0.95):
    noise, state = np.zeros(count), 0.0
    for row, drive in enumerate(rng.normal(size=count)):
        state = correlation * state + np.sqrt(1.0 - correlation**2) * drive
        noise[row] = state
    return noise


def _two_logs(rng, noise) -> Fit:
    """Two logs that share amplitude and rate, each with an offset of its own."""
    time = np.linspace(0.0, 4.0, 1000)
    blocks = []
    for name, offset in (("offset 0", 1.0), ("offset 1", -2.0)):
        data = _decay(time, 3.0, 0.8, offset) + noise(rng, len(time))

        def residual(v, data=data, name=name):
            return _decay(time, v["amplitude"], v["rate"], v[name]) - data

        blocks.append(Block(residual, ("amplitude", "rate", name), np.arange(len(time)) // 100))
    return fit(
        blocks,
        {
            "amplitude": Free(1.0, 1e-4, 0.0, 100.0, logarithmic=True),
            "rate": Free(0.3, 1e-5, low=0.0),
            "offset 0": Free(0.0, 1e-5),
            "offset 1": Free(0.0, 1e-5),
        },
    )


_TRUTH = {"amplitude": 3.0, "rate": 0.8, "offset 0": 1.0, "offset 1": -2.0}


def test_fit_recovers_what_was_put_in():
    found = _two_logs(np.random.default_rng(1), lambda rng, n: np.zeros(n))
    assert found.values == pytest.approx(_TRUTH, rel=1e-6)
    assert found.rms < 1e-6


def test_sigmas_are_the_spread_of_many_fits_with_autocorrelated_noise():
    rng = np.random.default_rng(2)
    fits = [_two_logs(rng, lambda rng, n: 0.1 * _coloured(rng, n)) for _ in range(150)]
    for key, truth in _TRUTH.items():
        values = np.array([found.values[key] for found in fits])
        spread = np.sqrt(np.mean((values - truth) ** 2))
        stated = np.sqrt(np.mean([found.sigmas[key] ** 2 for found in fits]))
        assert stated == pytest.approx(spread, rel=0.3), key
    # Between values too: amplitude and rate of one decay go together.
    correlation = np.corrcoef([[found.values[key] for key in ("amplitude", "rate")] for found in fits], rowvar=False)[0, 1]
    blocks = [found.block(("amplitude", "rate")) for found in fits]
    assert np.mean([b[0, 1] / np.sqrt(b[0, 0] * b[1, 1]) for b in blocks]) == pytest.approx(correlation, abs=0.15)


def test_bounds_hold():
    x = np.linspace(0.0, 1.0, 100)
    block = Block(lambda v: v["offset"] + v["slope"] * x - 1.0 - 3.0 * x, ("offset", "slope"), np.arange(100) // 5)
    found = fit([block], {"offset": Free(0.0, 1e-3), "slope": Free(0.0, 1e-3, -1.0, 2.0)})
    assert found.values["slope"] == pytest.approx(2.0)
    assert found.values["offset"] == pytest.approx(1.5)


def test_a_prior_weighs_as_much_as_it_says():
    """Data and prior of equal information give the mean of both; a parameter that only its prior determines keeps the prior's
    sigma."""
    block = Block(lambda v: np.repeat(v["a"] - 2.0, 100), ("a",), np.arange(100))
    found = fit([block], {"a": Free(0.0, 1e-3, prior=(0.0, 0.1)), "b": Free(5.0, 1e-3, prior=(5.0, 0.7))})
    assert found.values == pytest.approx({"a": 1.0, "b": 5.0})
    assert found.from_prior == pytest.approx({"a": 0.5, "b": 1.0})
    assert found.sigmas["b"] == pytest.approx(0.7)


def test_what_neither_data_nor_prior_determine_has_an_infinite_sigma():
    block = Block(lambda v: np.array([v["a"] - 1.0, v["a"] - 1.1]), ("a", "b"), np.arange(2))
    found = fit([block], {"a": Free(0.0, 1e-3), "b": Free(5.0, 1e-3)})
    assert found.values == pytest.approx({"a": 1.05, "b": 5.0})
    assert found.sigmas["b"] == np.inf and np.isfinite(found.sigmas["a"])


def test_a_given_derivative_does_what_difference_quotients_do():
    data = 2.0 + np.random.default_rng(5).normal(size=50)
    quotients = fit([Block(lambda v: np.exp(v["a"]) - data, ("a",), np.arange(50))], {"a": Free(0.0, 1e-6)})
    block = Block(lambda v: np.exp(v["a"]) - data, ("a",), np.arange(50), lambda v: np.full((50, 1), np.exp(v["a"])))
    given = fit([block], {"a": Free(0.0, 1e-6)})
    assert given.values["a"] == pytest.approx(quotients.values["a"], abs=1e-6)
    assert given.sigmas["a"] == pytest.approx(quotients.sigmas["a"], rel=1e-4)


# -- score ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("known", "unknown"), [((), 10), ((4, 5, 6, 7, 8, 9), 4), (range(10), 0)])
def test_samples_before_the_contact_is_known_are_counted_and_not_judged(known, unknown):
    estimates, reference = np.zeros(10, ESTIMATE), np.full(10, 1000.0)
    estimates["reasons"], estimates["source"] = contract.CONTACT_UNCERTAIN, contract.TORQUE_ONLY
    estimates["reasons"][list(known)], estimates["source"][list(known)] = 0, contract.FUSED
    found = force_figures(np.zeros(10, SAMPLE), estimates, reference)
    assert found["unknown_samples"] == unknown
    assert found["fused"]["samples"] == (10 - unknown if known else 10)


def test_figures_of_known_errors():
    error = np.array([3.0, -4.0, np.nan, 0.0, 0.0])
    assert figures(error) == pytest.approx({"samples": 4, "rmse": 2.5, "bias": -0.25, "p95": 3.85, "max": 4.0})
    assert figures(np.full(3, np.nan)) == {"samples": 0}
    assert rmse(np.array([1.0, 3.0]), np.array([3.0, 1.0])) == pytest.approx(np.sqrt(3.0))
    assert share_inside(error, np.full(5, 1.6)) == 0.75
    assert share_inside(error, np.full(5, 0.8)) == 0.5


def test_episode_errors_are_those_of_the_samples_chosen():
    rng = np.random.default_rng(4)
    error, episode = rng.normal(size=300), np.repeat(np.arange(3), 100)
    mask = rng.random(300) > 0.5
    once = EpisodeErrors.of({"fused": error}, {"holding": mask}, episode)
    assert once.rmse("fused") == pytest.approx(rmse(error))
    assert once.rmse("fused", "holding", np.array([0.0, 2.0, 0.0])) == pytest.approx(rmse(error[(episode == 1) & mask]))
    twice = EpisodeErrors.joined([once, once])
    assert twice.sums.shape == (1, 2, 6) and twice.rmse("fused") == pytest.approx(once.rmse("fused"))


def _mean_of_squares(node: ast.AST) -> bool:
    """``mean``, ``nanmean`` or ``average`` of something squared."""
    if not isinstance(node, ast.Call) or ast.unparse(node.func).rpartition(".")[2] not in ("mean", "nanmean", "average"):
        return False
    squared = (ast.unparse(part) for argument in node.args for part in ast.walk(argument) if isinstance(part, ast.BinOp))
    return any(text.endswith("** 2") for text in squared)


#: Packages of the box, which cannot know the bench: what they square and average judges no estimate (`adapt/fit.py` does so
#: with the difference between two fits of its own).
_BOX = {"wire", "models", "effects", "estimator", "calibration", "adapt", "runtime"}


def _is_root(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.sqrt", "sqrt", "math.sqrt")


def test_an_rmse_is_computed_in_one_module():
    package = Path(emb_daemon.__file__).parent
    bench = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in _BOX]
    found = set()
    for path in [*bench, *package.parent.glob("studies/*.py")]:
        roots = filter(_is_root, ast.walk(ast.parse(path.read_text())))
        if any(_mean_of_squares(argument) for root in roots for argument in root.args):
            found.add(str(path.relative_to(package.parent)))
    assert found == {"emb_daemon/offline/score.py"}


def test_a_fit_evaluates_nothing_twice():
    """Evaluating residuals is what a fit takes its time for."""
    asked, data = [], np.exp(0.7) + np.zeros(50)

    def residual(v):
        asked.append(v["a"])
        return np.exp(v["a"]) - data

    fit([Block(residual, ("a",), np.arange(50))], {"a": Free(0.0, 1e-6)})
    assert len(asked) > 6 and len(set(asked)) == len(asked)


def test_blocks_of_a_fit_run_side_by_side_to_the_same_values():
    """The residuals of each log wait for those of the other, so that the fit ends only if both run at a time."""
    both = threading.Barrier(2, timeout=30.0)

    def block(target):
        def residual(values):
            with contextlib.suppress(threading.BrokenBarrierError):
                both.wait()
            return np.array([values["a"] - target, 0.5 * values["a"]])

        return Block(residual, ("a",), np.arange(2))

    found = fit([block(1.0), block(3.0)], {"a": Free(0.0, 1e-6)})
    assert not both.broken and found.values["a"] == pytest.approx(1.6)


def test_rows_are_parted_where_they_do_not_follow_one_another():
    holds = np.array([True, True, False, False, True, False, True])
    assert stretches_of(holds).tolist() == [[0, 2], [4, 5], [6, 7]] and not len(stretches_of(np.zeros(3, bool)))
    rows = np.flatnonzero(holds)
    assert [part.tolist() for part in without_gaps(rows, 10 * rows)] == [[0, 10], [40], [60]]
