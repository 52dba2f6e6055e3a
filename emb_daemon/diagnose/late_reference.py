"""Lateness of the reference force beside the motion, as a load cell's filter makes it.

Beside the angle alone a force that is late and an angle that is early are the same, and a relaxation makes up for most of
either. The current tells them apart: it bears the force of its own time, whatever the angle says.
"""

from collections.abc import Sequence

import numpy as np

from emb_daemon.diagnose.evidence import Evidence
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.wire.contract import CYCLE_S

#: Standard deviations from nothing at which a force is late beside the angle, and from that at which the current contradicts,
#: or this share of a cycle: what a friction unlike the calibration's seems to make late, no angle confirms. Ripples and
#: relaxations that nothing has explained yet set the two apart by four standard deviations.
_SURELY, _WITHIN = 5.0, 0.6
#: Samples in the means that are compared, of which those in which friction turns over are no part.
_SLIDING = 2
#: Number of linear steps at most, and share of a cycle from which no further one is made: a single step finds five sixths of
#: twelve milliseconds.
_TURNS, _LITTLE = 5, 0.1


def reference_late_s(bench: Bench) -> float:
    """Time (s) by which the reference force of a bench's logs comes after angle and current; 0 unless both say so."""
    logs, late_s = [trial.log for trial in bench.trials], 0.0
    if not _is_told(bench):
        return late_s
    for _ in range(_TURNS):
        later_s, sigma_s, alike = _compare(bench)
        if not alike or later_s <= _SURELY * sigma_s:
            break
        late_s += later_s
        if later_s < _LITTLE * CYCLE_S:
            break
        bench = Bench([log.with_reference_earlier(late_s) for log in logs], bench.calibration)
    return late_s


def may_be_late(bench: Bench) -> bool:
    """Whether the current does not contradict the time of the reference force that the angle shows."""
    return _is_told(bench) and _compare(bench)[2]


def _is_told(bench: Bench) -> bool:
    return all(map(bench.channel_of, ("stiffness", "torque"))) and bench.has_reference


def _compare(bench: Bench) -> tuple[float, float, bool]:
    """Time (s) by which the force is late beside the angle, by one linear step, its standard deviation (s), and whether the
    current says the same."""
    model = Model.of(bench).refined({"stiffness", "torque"})
    rate = np.concatenate([np.gradient(np.nan_to_num(trial.force_N), trial.log.time_s) for trial in bench.trials])
    speed = np.concatenate([trial.log.samples["speed"] for trial in bench.trials])

    def told(channel: str, late: np.ndarray, given: Sequence[np.ndarray] = ()) -> Evidence:
        judged = model.residual[channel] != 0.0
        return model.evidence(channel, [late * judged], [column * judged for column in given], _SLIDING)

    # Where a motor clamps the force's rate follows its speed, and so does a viscous friction that nobody has calibrated.
    by_angle, by_current = told("stiffness", -rate), told("torque", rate, [speed])
    if not len(by_angle.values) or not len(by_current.values):
        return 0.0, np.inf, False
    [late_s], [sigma_s], [other_s], [its_sigma_s] = by_angle.values, by_angle.sigmas, by_current.values, by_current.sigmas
    alike = abs(late_s - other_s) < min(_SURELY * np.hypot(sigma_s, its_sigma_s), _WITHIN * CYCLE_S)
    return float(late_s), float(sigma_s), bool(alike)
