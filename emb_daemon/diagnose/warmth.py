"""Terms of the heat balance: the grammar held against thermocouples.

What a heat flow or a conductance does shows later and elsewhere, so that a form cannot be screened by what its port does at
the same moment. But the heat chain alone costs a fiftieth of the whole step: each form runs through it, on the recordings that
`identify` fits pads and disc to. The brake torque is measured there, so that friction and force cannot hide behind a term.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from emb_daemon.calibration.terms import Term
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.diagnose.coordinates import Coordinate, Values, base_coordinates, scaled_coordinate
from emb_daemon.diagnose.forms import FORMED, Form
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.prospects import CHANCES, SHIFTS, Scores, Screen, Search, covered_by, free_place, record_of
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT, SIDE_BY_SIDE, Bench, count_over
from emb_daemon.diagnose.screening import Rivals, Screening, risen_K
from emb_daemon.effects.base import HOOKS
from emb_daemon.effects.terms import PORTS, SIGNALS
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.offline.log import Log
from emb_daemon.offline.recording import Recording, recording, simulate

#: Time between residuals, and length of an episode, s: the model's errors last for about a minute.
_EVERY_S, _EPISODE_S = 5.0, 30.0
_PLACES = SIDE_BY_SIDE[CHANNEL_OF_HEAT]
#: Largest difference between pads or disc and their backing plates at the beginning, K. In a log that begins warmer the
#: temperatures follow from braking before it.
_SETTLED_K = 10.0
#: Least number of episodes.
_LEAST_EPISODES = 8
#: What the heat chain fits besides `base_coordinates`, and how well it is known, as there.
_FURTHER = (
    ("thermal.pad.conductivity_rise_per_K", 1.0),
    ("thermal.pad.specific_heat_J_per_kgK", 0.15),
    ("thermal.pad.surface_cooling_per_speed_J_per_rad_m2K", 1.0),
    ("thermal.disc.radiating_area_m2", 1.0),
)


class HeatBench(Bench):
    """Recordings on which a calibration's heat balance is tried: what `Bench` is for logs, of one channel."""

    def __init__(self, recordings: Sequence[Recording], calibration: Calibration):
        self.calibration = calibration
        self.recordings = recordings
        self.own_data: bool = True
        self.middle: float = 0.0
        self.straight: bool = False
        self.map: Callable[..., Iterator[Any]] = ThreadPoolExecutor(2).map
        self.channels: list[str] = [CHANNEL_OF_HEAT]
        inside = np.append(np.tile(np.array(DEPTHS_M) <= 1e-3 * calibration.pad_thickness_mm, 2), True)
        self._every = [max(round(_EVERY_S / r.step_s), 1) for r in recordings]
        pairs = list(zip(recordings, self._every, strict=True))
        self.measured: list[np.ndarray] = [np.where(inside, r.measured[:, ::every].T, np.nan) for r, every in pairs]
        cut = [(r.time_s[::every] // _EPISODE_S).astype(int) for r, every in pairs]
        self.sample_episode: np.ndarray = np.repeat(count_over(cut), _PLACES)
        self.episode: dict[str, np.ndarray] = {CHANNEL_OF_HEAT: self.sample_episode}

    @property
    def sources(self) -> list[str]:
        return [Path(r.name).name for r in self.recordings]

    def residual_of(self, parameters: np.void) -> np.ndarray:
        """Measured minus modelled temperatures (K) under PARAMETERS, zero where there are none."""
        parts = [
            measured - simulate(parameters, r, every=every)[:, :_PLACES]
            for r, every, measured in zip(self.recordings, self._every, self.measured, strict=True)
        ]
        return np.nan_to_num(np.concatenate(parts)).ravel()

    def run(self, values: Values) -> tuple[dict[str, np.ndarray], list[None]]:
        return {CHANNEL_OF_HEAT: self.residual_of(to_parameters(self.calibrated(values)))}, [None] * len(self.recordings)

    def residual_held(self, values: Values, channel: str, heat: Sequence[np.ndarray | None]) -> np.ndarray:
        return self.run(values)[0][channel]

    def signals(self, values: Values) -> list[np.ndarray]:
        """What terms see at every row, by recording."""
        parameters, result = to_parameters(self.calibrated(values)), []
        for r in self.recordings:
            seen = np.full((len(r.power), len(SIGNALS)), np.nan)
            simulate(parameters, r, signals=seen)
            result.append(seen)
        return result

    def model(self) -> Model:
        """The calibration's heat balance, fitted until nothing is gained: a residual of an unfinished fit must not become a
        term."""
        base = [c for c in base_coordinates(self.calibration, []) if c.channel == CHANNEL_OF_HEAT]
        further = [scaled_coordinate(self.calibration, [key], CHANNEL_OF_HEAT, prior) for key, prior in _FURTHER]
        start: dict[Coordinate, float] = {c: c.start for c in (*base, *further)}
        return Model(self, start, *self.run(start), centre=start).arrived(CHANNEL_OF_HEAT)


class HeatScreening(Screening):
    """Of a heat bench: limits only. No smooth function of a signal is a rival, because temperatures remember."""

    def __init__(self, bench: HeatBench, model: Model):
        self.bench = bench
        self.initial: dict[str, np.ndarray] = model.residual
        self.coordinates: dict[str, dict[str, Coordinate]] = {}
        self.signals: dict[str, np.ndarray] = {"clamp_force": np.zeros(0)}
        self._size = {CHANNEL_OF_HEAT: risen_K(bench.measured)}

    def rival(self, model: Model, channel: str, rivals: Rivals, samples: int = 1) -> tuple[float, str]:
        return 0.0, ""


class HeatSearch(Search):
    """All forms at the ports of the heat balance."""

    def __init__(self, model: Model):
        self.model = model
        self.channel: str = CHANNEL_OF_HEAT
        self.signals: list[np.ndarray] = model.bench.signals(model.values)
        self.random: np.random.Generator = np.random.default_rng(0)
        self.covered: dict[str, tuple[float, float]] = covered_by(np.concatenate(self.signals))
        self._place: int | None = free_place(model)
        ports = PORTS if self._place is not None else ()
        self.ports: tuple[str, ...] = tuple(p for p in ports if p in FORMED and HOOKS[p].channel == CHANNEL_OF_HEAT)
        self.screen: Screen = Screen(model, CHANNEL_OF_HEAT, 1)
        self._parameters = to_parameters(model.bench.calibrated(model.values))
        self._answers: dict[Form, np.ndarray] = {}

    def answer(self, form: Form) -> np.ndarray:
        own = self._parameters.copy()
        terms = own["effects"]["terms"]
        terms["term"][self._place] = record_of(form)
        terms["term"]["coefficient"][self._place] = form.step
        terms["count"] = max(terms["count"], self._place + 1)
        return (self.model.residual[CHANNEL_OF_HEAT] - self.model.bench.residual_of(own)) / form.step

    def _answers_of(self, forms: Sequence[Form]) -> np.ndarray:
        """Of each form, shape (N, forms)."""
        new = [form for form in forms if form not in self._answers]
        self._answers |= dict(zip(new, self.model.bench.map(self.answer, new), strict=True))
        return np.column_stack([self._answers[form] for form in forms])

    def _find_gains(self, forms: Sequence[Form]) -> np.ndarray:
        return self.screen.scores(self._answers_of(forms)).gain if forms else np.zeros(0)

    def _move_in_time(self, columns: np.ndarray, low: float, high: float) -> np.ndarray:
        """Columns at another time, as if the recordings were a circle: a share between two of them later."""
        rows = len(columns) // _PLACES
        return np.roll(columns, _PLACES * int(rows * self.random.uniform(low, high)), axis=0)

    def chance_of(self, forms: Sequence[Form], gains: np.ndarray) -> float:
        columns, most = self._answers_of(forms), gains.max()
        for number in range(CHANCES):
            if float(self.screen.scores(self._move_in_time(columns, 0.1, 0.9)).gain.max()) >= most:
                return 2.0 / (2.0 + number)
        return 1.0 / (1.0 + CHANCES)

    def gains_moved(self, form: Form) -> np.ndarray:
        column = self.answer(form)[:, None]
        return np.array([self.screen.scores(self._move_in_time(column, 0.25, 0.75)).gain[0] for _ in range(SHIFTS)])

    def is_within(self, term: Term) -> bool:
        return True

    def dependence(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Squared error of each left-out episode, without and with the best form of each signal."""
        if not self.forms:
            return {}
        plain = self.model.left_out(CHANNEL_OF_HEAT)
        scores, gains = self.screen.scores(self._answers_of(self.forms)), self.gains
        found = {}
        for signal in {form.signal for form in self.forms}:
            best = max((index for index, form in enumerate(self.forms) if form.signal == signal), key=gains.__getitem__)
            found[signal] = plain, plain - Scores(scores.u[best : best + 1], scores.a[best : best + 1]).fall[0]
        return found


def heat_bench(logs: Iterable[Log], calibration: Calibration) -> HeatBench | None:
    """Of those logs that hold thermocouples and brake torque and begin at rest; None where they tell nothing."""
    found = []
    for log in logs:
        try:
            r = recording(log)
        except InputError:
            continue
        apart = r.measured[:, 0] - 0.5 * (r.inner[0] + r.outer[0])
        if r.has_pads and not np.any(np.abs(apart) > _SETTLED_K):
            found.append(r)
    bench = HeatBench(found, calibration) if found else None
    return bench if bench and bench.episodes >= _LEAST_EPISODES else None
