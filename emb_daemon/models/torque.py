"""Torque balance: clamp force from motor torque, inertia and friction.

Thesis 2.4 and 4.2: T_m = gamma F + J dw/dt + (mu F + eta) s. The thesis takes s = sgn of the angle difference; here s is a
friction state that turns over within a presliding angle (Dahl, "A solid friction model", 1968), which also gives the friction
while the motor stands still.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.jit import Record, fields, njit, sq

#: Time constant over which reversals are counted, s: a dozen samples. One reversal adds 0.08 to the share.
_OF_LATE_S = 0.05
#: Share of samples with a reversal above which an angle's motion is noise. Noise of the angle reverses in two of three
#: samples, a sum of noisy speeds in every other, a motor that swings at 10 Hz in one of twelve.
NOISE_TURNS_BACK = 0.15
#: Standard deviation of a friction that is anywhere between all and none.
_BETWEEN = 1.0 / sqrt(3.0)
#: Number of an angle's steps in which its count is looked for. A stroke begins and ends slowly, and has more of them.
_STEPS = 64
#: Share of a step that speeds must not explain: of a fast one the motor's speed between two samples may be beyond both.
_MOSTLY = 0.5

#: Steps of an angle, in the ``number`` now and in the `_STEPS` before: the ``least`` of them, and the ``most`` by which one
#: was beyond what the speeds explain, rad.
STEPS = np.dtype([("least", "f8", (2,)), ("most", "f8", (2,)), *fields("i8", "number")], align=True)


@njit
def turned_back(share: float, direction: float, travel: float, dt: float) -> float:
    """Share of recent samples with a reversal of the motor, after a sample of ``travel`` rad in ``dt`` s; the sign of
    ``direction`` is that of the last motion."""
    return share + ((travel * direction < 0.0) - share) * min(dt / _OF_LATE_S, 1.0)


@njit
def slid_angle(before: float, angle: float, flicker: float) -> float:
    """Angle that the gear has slid to: it follows ``angle`` once that leaves ``before`` by more than ``flicker`` rad.

    Otherwise an angle that flickers between two counts at standstill would turn the friction state over again and again, and
    the direction from which the motor came would be lost.
    """
    return min(max(before, angle - flicker), angle + flicker)


@njit
def resolution(c: Record, travel: float, unexplained: float) -> float:
    """Count of the angle, rad, by its steps so far: no more than the least of them, and no more than what was ever beyond the
    speeds of the motor. 0 until enough are known.

    An angle in fine counts has small steps whenever the motor starts or stops; one that has none because the motor goes fast
    or jerks agrees with the speeds.

    Args:
        c: STEPS record.
        travel: rad in this sample; ``unexplained`` rad of it by the speeds of late.
    """
    if travel != 0.0:
        if c.number % _STEPS == 0:
            c.least[1], c.most[1] = c.least[0], c.most[0]
            c.least[0], c.most[0] = np.inf, 0.0
        c.number += 1
        c.least[0] = min(c.least[0], abs(travel))
        if unexplained > _MOSTLY * abs(travel):
            c.most[0] = max(c.most[0], unexplained)
    return min(c.least[0], c.least[1], max(c.most[0], c.most[1])) if c.number > _STEPS else 0.0


@njit
def within_count(state: float, count: float, presliding_angle: float) -> float:
    """Friction state of a motor that has gone back as far as a ``count`` rad of its angle does not show; ``state`` by what
    the angle shows."""
    back = -1.0 if state > 0.0 else 1.0
    return back + (state - back) * exp(-count / presliding_angle)


@njit
def friction_state(
    state: float, variance: float, travel: float, presliding_angle: float, dissolving_rate: float, dt: float
) -> tuple[float, float, float]:
    """Friction state s in [-1, 1] after ``travel`` rad of sliding, its mean over the travel, and its variance.

    Starts unknown (variance 1) and becomes known by sliding; at standstill vibration dissolves the memory at
    ``dissolving_rate`` 1/s. ``presliding_angle`` rad is the travel over which s turns over.
    """
    distance = abs(travel)
    variance = min(1.0, variance + dissolving_rate * dt)
    if distance == 0.0:
        return state, state, variance
    direction = 1.0 if travel > 0.0 else -1.0
    ratio = distance / presliding_angle
    decay = exp(-ratio)
    weight = (1.0 - decay) / ratio if ratio > 1e-6 else 1.0 - 0.5 * ratio
    after = direction + (state - direction) * decay
    mean = direction + (state - direction) * weight
    return after, mean, variance * decay * decay


@njit
def turned_unseen(variance: float, travel: float, presliding_angle: float) -> float:
    """Variance of the friction state after the motor may have gone to and fro over ``travel`` rad in all, less at a time than
    its angle shows: friction is then anywhere between that by the angle and none."""
    sigma = sqrt(variance)
    return sq(sigma + max(_BETWEEN - sigma, 0.0) * (1.0 - exp(-travel / presliding_angle)))


@njit
def unexplained_torque(
    motor_torque: float, inertia: float, speed_change: float, dt: float, offset_friction: float, friction_mean: float
) -> float:
    """Motor torque (N m) that inertia and the friction offset leave to the clamp force, mean over the cycle.

    The current is a mean over the cycle, so the matching inertia term is J dw/dt between the samples that bound it.
    """
    return motor_torque - inertia * speed_change / dt - offset_friction * friction_mean


@njit
def torque_balance(torque: float, leverage: float) -> float:
    """Clamp force in N from ``torque`` N m left to it and its ``leverage`` gamma + mu s in m/rad. Thesis 4-3."""
    return torque / leverage
