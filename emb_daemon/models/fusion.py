"""Fusion of the two force paths.

Thesis 5.2 and 6.1 (maximum likelihood), 5.3 and 6.2 (Kalman filter). The thesis filters the force itself with squared RMSE
for noise, which takes slow model error for white noise. Here the filter estimates the errors that make the paths differ:

    x0  error of the stiffness path in units of its own standard deviation, first-order Gauss-Markov
    x1  error of the contact angle (rad), random walk: acts through the local stiffness G
    x2  relative error of the torque path (torque constant, friction), nearly constant
    x3  coloured noise of the current as motor torque (N m), first-order Gauss-Markov
    x4  offset of the motor torque (N m), random walk: a current sensor's zero, seen alone wherever the pads do not touch

    F = F_stiffness + sigma_stiffness x0 - G x1
    torque not explained by F_stiffness = D (F - F_stiffness) + D F x2 + x3 + x4 + white noise,  D = gamma + mu s

so that what is slow stays correlated and the standard deviation means what it says.
"""

from math import sqrt

from emb_daemon.jit import njit

STATES = 5
#: Index of the torque path's relative error, and of the torque's offset.
GAIN, OFFSET = 2, 4


@njit
def maximum_likelihood(stiffness, stiffness_sigma, torque, torque_sigma):
    """Fused force and its standard deviation."""
    vs, vt = stiffness_sigma * stiffness_sigma, torque_sigma * torque_sigma
    return stiffness + vs / (vs + vt) * (torque - stiffness), sqrt(vs * vt / (vs + vt))


@njit
def predict_errors(x, P, decay, contact_variance, gain_variance, noise_decay, noise_variance, offset_variance):
    """Time update of the error state and its covariance.

    ``decay`` and ``noise_decay`` of x0 and x3 over the step, ``noise_variance`` the stationary variance of x3; the random
    walks of x1, x2 and x4 gain the other variances.
    """
    for i, factor in ((0, decay), (3, noise_decay)):
        x[i] *= factor
        for j in range(STATES):
            P[i, j] *= factor
            P[j, i] *= factor
    P[0, 0] += 1.0 - decay * decay
    P[1, 1] += contact_variance
    P[2, 2] += gain_variance
    P[3, 3] += (1.0 - noise_decay * noise_decay) * noise_variance
    P[4, 4] += offset_variance


@njit
def update_errors(x, P, gain, innovation, h, variance):
    """Measurement update for z = h x + white noise; ``gain`` is scratch. Returns the innovation's variance before it."""
    s = variance
    for i in range(STATES):
        gain[i] = 0.0
        for j in range(STATES):
            gain[i] += P[i, j] * h[j]
        s += h[i] * gain[i]
    for i in range(STATES):
        x[i] += gain[i] / s * innovation
    for i in range(STATES):
        for j in range(i + 1):
            P[i, j] -= gain[i] * gain[j] / s
            P[j, i] = P[i, j]
    return s


@njit
def variance_along(P, h):
    """h P h'."""
    total = 0.0
    for i in range(STATES):
        for j in range(STATES):
            total += h[i] * P[i, j] * h[j]
    return total
