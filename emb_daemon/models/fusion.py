"""Fusion of the two force paths.

Thesis 5.2 and 6.1 (maximum likelihood), 5.3 and 6.2 (Kalman filter). The thesis filters the force itself with squared RMSE
for noise, which takes slow model error for white noise. Here the filter estimates the errors that make the paths differ:

    FAST      error of the stiffness path in units of its own standard deviation, first-order Gauss-Markov
    CONTACT   error of the contact angle, rad: acts through the local stiffness G
    GAIN      relative error of the motor torque: torque constant, current gain
    NOISE     coloured noise of the current as motor torque, N m, first-order Gauss-Markov
    OFFSET    offset of the motor torque, N m: a current sensor's zero, seen alone wherever the pads do not touch
    SCALE     relative error of the stiffness: other pads, another compound, ageing
    GROWTH    contact angle that a warmer disc takes away, rad/K
    LOAD      error of the gear friction per clamp force, m/rad
    COULOMB   error of the gear friction without clamp force, N m
    VISCOUS   error of the friction torque per motor speed, N m s/rad
    SLOW      relative rise of the gear friction at low speed (Stribeck)
    CREEPS    shares of the force that a stroke lacks and that pads gain while they are held, within a second or some seconds
    FADE      relative loss of motor torque per heat that the motor's own current left in the winding
    HOUSING   the same for the heat left in the motor's housing
    INERTIA   relative error of the inertia
    LATE      cycles by which the current is late

    F = F_stiffness + sigma_stiffness FAST - G CONTACT + F SCALE + G dT GROWTH + (H_i - F) CREEP_i
    torque not explained by F_stiffness = D (F - F_stiffness) + s F LOAD + s COULOMB + w VISCOUS + T_f SLOW
                                          - T_m (GAIN + u FADE + v HOUSING) + J dw/dt INERTIA - T_m' LATE
                                          + NOISE + OFFSET + white noise,  D = gamma + mu s

H_i is the static force of the pads through a first-order lag, and T_m' the change of the motor torque in a cycle. Slow errors
stay correlated in time, and the standard deviation is that of the force.
"""

from math import sqrt

from emb_daemon.jit import Floats, njit

#: Number of states, and their places; creep's are two. Loops over a covariance run to the length of an array: to this number
#: the compiler would unroll them, not vectorise them, and an update would take three times as long.
STATES = 17
(FAST, CONTACT, GAIN, NOISE, OFFSET, SCALE, GROWTH, LOAD, COULOMB, VISCOUS, FADE, HOUSING, INERTIA, SLOW, LATE) = range(15)
CREEPS = (15, 16)
#: States that the model of the force takes in as soon as they are learned; all that the clamp force itself rests on.
OF_THE_MODEL = (CONTACT, SCALE, GROWTH, *CREEPS)
OF_THE_FORCE = (FAST, *OF_THE_MODEL)


@njit
def maximum_likelihood(stiffness: float, stiffness_sigma: float, torque: float, torque_sigma: float) -> tuple[float, float]:
    """Fused force and its standard deviation."""
    vs, vt = stiffness_sigma * stiffness_sigma, torque_sigma * torque_sigma
    return stiffness + vs / (vs + vt) * (torque - stiffness), sqrt(vs * vt / (vs + vt))


@njit
def copy_errors(x: Floats, P: Floats, from_x: Floats, from_P: Floats) -> None:
    """Copy into ``x`` and ``P``, by loops: assigning a whole array takes a tenth of a second to compile."""
    for i in range(len(x)):
        x[i] = from_x[i]
        for j in range(len(x)):
            P[i, j] = from_P[i, j]


@njit
def predict_errors(x: Floats, P: Floats, decay: float, noise_decay: float, noise_variance: float, walked: Floats) -> None:
    """Time update of the error state and its covariance.

    ``decay`` and ``noise_decay`` of FAST and NOISE over the step, ``noise_variance`` the stationary variance of NOISE;
    ``walked``, shape (STATES,): variance that each of the others gains.
    """
    for i, factor in ((FAST, decay), (NOISE, noise_decay)):
        x[i] *= factor
        for j in range(STATES):
            P[i, j] *= factor
            P[j, i] *= factor
    P[FAST, FAST] += 1.0 - decay * decay
    P[NOISE, NOISE] += (1.0 - noise_decay * noise_decay) * noise_variance
    for i in range(STATES):
        P[i, i] += walked[i]


@njit
def variance_along(P: Floats, h: Floats, gain: Floats) -> float:
    """h P h'; ``gain``, shape (STATES,), becomes P h'."""
    # The loop over columns is outside, because then the sums of all rows are independent, and are vectorised.
    for i in range(len(h)):
        gain[i] = P[0, i] * h[0]
    for j in range(1, len(h)):
        for i in range(len(h)):
            gain[i] += P[j, i] * h[j]
    total = 0.0
    for i in range(len(h)):
        total += h[i] * gain[i]
    return total


@njit
def update_errors(x: Floats, P: Floats, gain: Floats, innovation: float, s: float) -> None:
    """Measurement update with an innovation of variance ``s``; ``gain`` is P h' (`variance_along`)."""
    scale = 1.0 / s
    for i in range(len(x)):
        x[i] += gain[i] * scale * innovation
        # The product first: it is the same for (i, j) and (j, i), and P stays symmetric to the last bit.
        for j in range(len(x)):
            P[i, j] -= gain[i] * gain[j] * scale


@njit
def force_variance(P: Floats, h: Floats) -> float:
    """h P h' over the states that the force rests on."""
    total = 0.0
    for i in OF_THE_FORCE:
        for j in OF_THE_FORCE:
            total += h[i] * P[i, j] * h[j]
    return total
