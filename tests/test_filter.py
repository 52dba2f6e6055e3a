"""The filter: steady state, shape of its covariance, and whether its sigma means what it says."""

import brake
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from emb_daemon.models.fusion import STATES, predict_errors, update_errors, variance_along
from emb_daemon.offline import estimate


def test_steady_state_solves_the_riccati_equation():
    """Two error states that the same measurement sees, and the noise of the current (the contact angle held known)."""
    decay, walk, noise_decay, noise_variance, variance = 0.99, 1e-4, 0.6, 0.04, 0.02
    h = np.array([0.5, 0.0, 0.3, 1.0, 0.0])
    x, P, gain = np.zeros(STATES), np.diag([1.0, 0.0, 1.0, noise_variance, 0.0]), np.zeros(STATES)
    for _ in range(20_000):
        predict_errors(x, P, decay, 0.0, walk, noise_decay, noise_variance, 0.0)
        predicted = P.copy()
        update_errors(x, P, gain, 0.0, h, variance)
    seen = np.ix_([0, 2, 3], [0, 2, 3])
    transition = np.diag([decay, 1.0, noise_decay])
    noise = np.diag([1.0 - decay**2, walk, (1.0 - noise_decay**2) * noise_variance])
    expected = solve_discrete_are(transition.T, h[[0, 2, 3], None], noise, np.array([[variance]]))
    np.testing.assert_allclose(predicted[seen], expected, rtol=1e-6)


def test_covariance_stays_symmetric_and_positive_over_long_random_input():
    rng = np.random.default_rng(7)
    x, P, gain = np.zeros(STATES), np.diag([1.0, 4e-4, 1e-4, 3e-4, 1e-2]), np.zeros(STATES)
    for number in range(20_000):
        predict_errors(x, P, rng.uniform(0.9, 1.0), rng.uniform(0.0, 1e-7), 4e-12, rng.uniform(0.3, 1.0), 3e-4, 1e-8)
        h = np.array([4e-5 * rng.uniform(15, 100), -4e-5 * rng.uniform(0, 2000), 4e-5 * rng.uniform(0, 3e4), 1.0, 1.0])
        s = update_errors(x, P, gain, rng.normal(0.0, 0.1), h, 10.0 ** rng.uniform(-8, -2))
        assert s > 0.0
        if number % 100 == 0:
            assert np.array_equal(P, P.T)
            scale = np.sqrt(np.diag(P))
            assert scale.min() > 0.0
            assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-9


def test_filter_is_consistent_on_data_of_its_own_model():
    """Normalised innovations have variance one and are white; 95 % of the true forces lie within two sigma."""
    rng = np.random.default_rng(8)
    decay, noise_decay, noise, variance = 0.995, 0.6, 3e-4, 1e-4
    nis, signed, inside, checks = [], [], 0, 0
    for _ in range(40):
        P = np.diag([1.0, 4e-4, 1e-4, noise, 4e-3])
        truth = rng.normal(size=STATES) * np.sqrt(np.diag(P))
        x, gain = np.zeros(STATES), np.zeros(STATES)
        for step in range(250):
            force = 8000.0 * (1.0 + np.sin(0.05 * step))
            slope = 250.0 + 0.1 * force
            walks = [1.0 - decay**2, 1e-6 * 0.004, 4e-12, (1.0 - noise_decay**2) * noise, 1e-8]
            drive = rng.normal(size=STATES) * np.sqrt(walks)
            truth = truth * [decay, 1.0, 1.0, noise_decay, 1.0] + drive
            predict_errors(x, P, decay, 1e-6 * 0.004, 4e-12, noise_decay, noise, 1e-8)
            to_force = np.array([40.0, -slope, 0.0, 0.0, 0.0])
            h = 4e-5 * to_force
            h[2], h[3], h[4] = 4e-5 * force, 1.0, 1.0
            innovation = h @ truth + rng.normal() * np.sqrt(variance) - h @ x
            s = update_errors(x, P, gain, innovation, h, variance)
            nis.append(innovation**2 / s)
            signed.append(innovation / np.sqrt(s))
            if step % 50 == 49:
                checks += 1
                inside += abs(to_force @ (truth - x)) < 2.0 * np.sqrt(variance_along(P, to_force))
    assert np.mean(nis) == pytest.approx(1.0, abs=0.06)
    signed = np.reshape(signed, (40, 250))
    assert np.mean(signed[:, 1:] * signed[:, :-1]) == pytest.approx(0.0, abs=0.04)
    assert 0.90 <= inside / checks <= 0.99


def test_sigma_grows_while_the_torque_path_is_missing(parameters):
    p = parameters[0]
    moving = np.concatenate([brake.clamp(p, 15.0, 1.0), p["clearance"] + 15.0 + 2.0 * np.sin(np.arange(1000) * 0.05)])
    rows, _ = brake.samples(p, moving)
    rows["has_current"][500:] = False
    sigma = estimate(rows, p)["sigma"]
    full = rows.copy()
    full["has_current"] = True
    with_torque = estimate(full, p)["sigma"]
    turning = slice(520, None)
    assert np.array_equal(sigma[:500], with_torque[:500])
    assert np.all(sigma[turning] > with_torque[turning])
    same_place = sigma[500::126]
    assert np.all(np.diff(same_place[:4]) > 0.0)


def test_force_of_an_ideal_brake_is_found_within_its_sigma(parameters):
    """Slow clamp, hold, release: with the model's own parameters the error is far below sigma's claim."""
    p = parameters[0]
    p["effects"] = np.zeros((), p["effects"].dtype)
    up = brake.clamp(p, 20.0, 4.0)
    rows, force = brake.samples(p, np.concatenate([up, np.full(250, up[-1]), up[::-1]]))
    estimates = estimate(rows, p)
    clamped = force > 500.0
    assert force.max() > 12_000.0
    assert np.all(np.abs(estimates["force"] - force)[clamped] < 2.0 * estimates["sigma"][clamped])
    np.testing.assert_allclose(estimates["stiffness_force"][clamped], force[clamped], rtol=0.01, atol=20.0)


def test_contact_angle_is_learned_from_the_torque(parameters):
    """A brake whose contact lies 0.1 rad from where it is expected: sliding under load pulls the estimate towards it."""
    p = parameters[0]
    p["effects"] = np.zeros((), p["effects"].dtype)
    p["clearance_sigma"] = 0.1
    true = p.copy()
    true["clearance"] = p["clearance"] + 0.1
    up = brake.clamp(true, 25.0, 3.0)
    rows, force = brake.samples(true, np.concatenate([up, up[::-1], up]))
    estimates = estimate(rows, p)
    before, after = estimates["contact_angle"][0], estimates["contact_angle"][-1]
    assert before == pytest.approx(true["clearance"] - 0.1)
    assert abs(after - true["clearance"]) < 0.04
    # Friction may be off by its own share, which torque tells as contact angle: less is left than there was, but not little.
    assert 0.05 < estimates["contact_sigma"][-1] < 0.1
    assert abs(estimates["force"][-1] - force[-1]) < 2.0 * estimates["sigma"][-1]
