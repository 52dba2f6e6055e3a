"""Time by which the resolver's angle is older than the force it is compared with."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit
from emb_daemon.models.lateness import turned_within

#: Longest age, s; and time over which angle and speed are compared, s: of a stroke, in which an offset of the speed adds up to
#: little and whose begin and end show the age.
_LONGEST_S, _COMPARED_S = 0.05, 0.1
#: Steps to the age from the best on the grid of samples.
_STEPS = 4


@njit
def term(p: Record, lately: Record) -> float:
    """Angle in rad by which the motor has gone on."""
    return turned_within(lately, p.delay_s)


def measure(samples: np.ndarray) -> tuple[float, float]:
    """Age (s) of the angle beside the speed that comes with it and its standard deviation, infinite where nothing turns.

    The age at which the angle's changes over a tenth of a second are most nearly those of the integrated speed. The standard
    deviation is that of stretches as long, each one observation: neighbouring samples have the same error.

    Args:
        samples: SAMPLE rows of a log, shape (n,)."""
    time, dt = np.cumsum(samples["dt"]), samples["dt"]
    count = int(_COMPARED_S / np.median(dt)) if len(dt) else 0
    if count < 2 or len(dt) < 10 * count:
        return 0.0, np.inf
    speed, angle = samples["speed"], samples["angle"]
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt[1:])])
    at, before, stretch = time[count:], time[:-count], np.arange(len(dt) - count) // count

    def apart(age: float) -> np.ndarray:
        return angle[count:] - angle[:-count] - np.interp(at - age, time, way) + np.interp(before - age, time, way)

    grid = np.arange(0.0, _LONGEST_S, float(np.median(dt)))
    age = float(min(grid, key=lambda tried: np.square(apart(tried)).sum()))
    for _ in range(_STEPS):
        gained = np.interp(at - age, time, speed) - np.interp(before - age, time, speed)
        products, squares = (np.bincount(stretch, gained * other) for other in (apart(age), gained))
        total = max(float(squares.sum()), 1e-300)
        off = -float(products.sum()) / total
        # A speed that is late, through a filter, tells nothing of the angle.
        age = min(max(age + off, 0.0), _LONGEST_S)
    return age, float(np.sqrt(np.square(products + off * squares).sum())) / total if squares.any() else np.inf


EFFECT = Effect(
    name="signal_delay",
    hook="motor_angle",
    term=term,
    parameters=(Parameter("delay_s", "s", -0.05, 0.05, 0.001, "age of the angle", drawn=(0.0, 0.006)),),
    equation="θ → θ + ∫ ω over the last d",
    source="dead reckoning of a delayed sample by its speed",
    signal="motor_speed",
    measure=measure,
    manoeuvre="fast and slow strokes over the same forces: a delay grows with motor speed, a relaxation does not",
)
