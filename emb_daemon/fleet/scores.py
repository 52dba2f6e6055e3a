"""Scores of one drive without force sensor: how the disagreement of its force paths depends on every possible cause.

The causes are the calibration's own parameters and every effect of the registry in each of its starting shapes, that is,
everything that `diagnose` would free or try on one log. Nothing is fitted in a single drive. Of each drive the second moments
of regressors and residual are stored; any later test (of a unit, a batch, a month) adds them up. The contact angle differs
from drive to drive and is eliminated at once.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.parameters import CLEARANCE
from emb_daemon.calibration.types import Calibration
from emb_daemon.diagnose.coordinates import Coordinate, Values, base_coordinates, by_key, effect_coordinates
from emb_daemon.diagnose.residuals import Bench, Probe, Trial
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import Effect
from emb_daemon.errors import InputError
from emb_daemon.fleet.dataset import Drive, folder_of, made_by, partition, read_drive
from emb_daemon.offline import Log

#: Force (N) above which the pads touch; the size of a cause is its RMS over such samples.
LOADED_N = 300.0
#: Motor travel (rad) in contact that a drive needs: a brake application of 3 kN.
_LEAST_TRAVEL_RAD = 10.0
#: The contact angle is found first, by Newton steps: until a step is smaller than the angle (rad) over which the curve's slope
#: changes by a fiftieth, and at most this number. For a drive that begins clamped they do not converge.
_SETTLED_RAD, _STEPS = 0.1, 6
#: Residual of a log without reference.
_CHANNEL = "innovation"
_FORCE_CHANNELS = ("stiffness", "torque")


@dataclass(frozen=True)
class Cause:
    """A quantity in which units may differ."""

    key: str  #: of the calibration
    name: str  #: the effect's, or the key of a base parameter
    shape: float | None  #: value of the effect's shape parameter with which it is tried, or None
    unit: str  #: unit of the amount; base parameters are in multiples of their size
    thermal: bool  #: whether it acts by a temperature

    def __str__(self) -> str:
        return self.name if self.shape is None else f"{self.name} ({self.shape:g})"


@dataclass(frozen=True)
class Score:
    """Scores of one drive."""

    drive: Drive
    #: Second moments of the causes' regressors and, last, of the residual, without the contact angle, shape (causes + 1,
    #: causes + 1), in the causes' units and N.
    products: np.ndarray
    loaded: int  #: number of samples with the pads in contact
    ambient_C: float  #: ambient temperature, NaN if unknown


def is_periodic(effect: Effect) -> bool:
    """Whether an effect has a phase. The phase counts from the position at power-on, so it differs from drive to drive."""
    return effect.harmonic is not None or any(p.group for p in effect.parameters)


class _Bench(Bench):
    """One drive. Its parameters differ from those of other drives in the contact angle only, so that they are made once."""

    def __init__(self, log: Log, calibration: Calibration, contact: Coordinate, made: dict[tuple, np.void]):
        super().__init__([log], calibration, workers=1)
        self._contact, self._made = contact, made

    def _trial(self, index: int, log: Log, mounted: Mapping[str, float]) -> Trial:
        """Not cut into episodes, for which the whole step would be run once more: a drive counts as one episode."""
        nothing, never = np.zeros(0), np.zeros(len(log.samples), np.bool_)
        return Trial(log, index, log.force_N, nothing, nothing, nothing, nothing, nothing, nothing, never, mounted)

    def parameters_of(self, trial: Trial, values: Values) -> np.void:
        others = tuple((c.name, value) for c, value in values.items() if c is not self._contact)
        if others not in self._made:
            self._made[others] = super().parameters_of(trial, values)
        found = self._made[others]
        found["clearance"] = by_key({self._contact: values[self._contact]}, self.middle)[CLEARANCE]
        return found


class Scorer:
    """The causes under one calibration, and the computation of scores for them. ``causes``: in the order of a score's
    columns."""

    def __init__(self, calibration: Calibration):
        self.calibration = calibration
        base = [
            replace(c, channel=_CHANNEL)
            for c in base_coordinates(calibration, [calibration.contact.clearance_rad])
            if c.channel in _FORCE_CHANNELS
        ]
        self._contact = next(c for c in base if c.name == CLEARANCE)
        probes: list[Probe] = [Probe(c) for c in base if c is not self._contact]
        # A score has a sign, by which the opposite of a cause is that cause.
        opposites = {effect.name for effect in REGISTRY if effect.opposes}
        for effect in REGISTRY:
            if effect.channel not in _FORCE_CHANNELS or is_periodic(effect):
                continue
            own = effect_coordinates(calibration, effect, _CHANNEL)
            if effect.name in calibration.effects:
                probes += [Probe(c) for c in own.values()]
                continue
            if effect.name in opposites or effect.beside in opposites:
                continue
            shapes = [((own[s.name], start),) for s in effect.shapes[:1] for start in s.starts] or [()]
            probes += [Probe(own[p.name], shape) for shape in shapes for p in effect.amplitudes]
        self._probes = probes
        self._made: dict[tuple, np.void] = {}
        thermal = {effect.name for effect in REGISTRY if effect.signal.endswith("temperature")}
        self.causes: tuple[Cause, ...] = tuple(
            Cause(
                p.coordinate.name,
                p.coordinate.effect or p.coordinate.name,
                p.shape[0][1] if p.shape else None,
                p.coordinate.unit,
                p.coordinate.effect in thermal or p.coordinate.name.startswith("thermal."),
            )
            for p in probes
        )

    def score(self, log: Log, drive: Drive) -> Score:
        """Scores of one drive. Raises InputError: the drive cannot be used; says why."""
        # All units must be treated alike, with or without a force sensor.
        unknown = replace(log, force_N=np.full(len(log.samples), np.nan))
        bench = _Bench(unknown, self.calibration, self._contact, self._made)
        values = {self._contact: self._contact.start}
        for _ in range(_STEPS):
            residual, heat = bench.run(values)
            (column,) = bench.regressors(values, [Probe(self._contact)], residual, heat)
            if not (size := float(column @ column)):
                raise InputError("the pads never touch")
            move = float(column @ residual[_CHANNEL]) / size
            if abs(move) < _SETTLED_RAD:
                break
            values[self._contact] += move
        else:
            raise InputError("the contact angle is not found; does the drive begin with the brake applied?")
        table = np.column_stack([*bench.regressors(values, self._probes, residual, heat), residual[_CHANNEL]])
        # The curve's coefficients together, each by its own size, are the scale of the force.
        curve = [row for row, cause in enumerate(self.causes) if cause.key.startswith("stiffness.curves")]
        loaded = np.abs(table[:, curve].sum(axis=1)) > LOADED_N
        samples = log.samples
        if np.abs(samples["speed"] * samples["dt"])[loaded].sum() < _LEAST_TRAVEL_RAD:
            raise InputError("no brake application")
        table -= np.outer(column, column @ table / size)
        heard = samples["ambient"][samples["has_status"]]
        return Score(drive, table.T @ table, int(loaded.sum()), float(np.median(heard)) if len(heard) else np.nan)


def score_unit(root: Path, drives: Sequence[Drive], calibration: Calibration, resume: bool = True) -> dict[str, str]:
    """Compute and store the scores of every drive of one unit's corner; returns why some cannot be used, by digest.

    ``resume``: keep existing scores made by the same (`made_by`)."""
    scorer, path = Scorer(calibration), scores_path(root, drives[0].unit, drives[0].corner)
    known, silent = read_scores(path, calibration) if resume and path.exists() else ([], {})
    scores = {score.drive: score for score in known if score.drive in drives}
    silent = {drive.digest: silent[drive.digest] for drive in drives if drive.digest in silent}
    for drive in drives:
        if drive in scores or drive.digest in silent:
            continue
        try:
            scores[drive] = scorer.score(read_drive(root, drive)[0], drive)
        except InputError as error:
            silent[drive.digest] = str(error)
    folder_of(path.parent)
    _write(path, calibration, scorer.causes, [scores[drive] for drive in sorted(scores)], silent)
    return silent


def scores_path(root: Path, unit: str, corner: str) -> Path:
    return Path(root, "evidence", partition(unit, corner)).with_suffix(".npz")


def _write(path: Path, calibration: Calibration, causes: Sequence[Cause], scores: list[Score], silent: dict[str, str]) -> None:
    said = {
        "made_by": made_by(calibration), "causes": [asdict(cause) for cause in causes],
        "drives": [asdict(score.drive) for score in scores], "silent": silent,
    }  # fmt: skip
    upper = np.triu_indices(len(causes) + 1)
    sink = BytesIO()
    np.savez(
        sink,
        said=np.frombuffer(json.dumps(said, sort_keys=True).encode(), np.uint8),
        products=np.array([score.products[upper] for score in scores]).reshape(len(scores), -1),
        loaded=np.array([score.loaded for score in scores], np.int64),
        ambient_C=np.array([score.ambient_C for score in scores], float),
    )
    write_atomically(path, sink.getvalue())


def read_scores(path: Path, calibration: Calibration) -> tuple[list[Score], dict[str, str]]:
    """Stored scores of one unit's corner; none if they were made by others (`made_by`)."""
    with np.load(path) as file:
        said = json.loads(file["said"].tobytes())
        if said.get("made_by") != made_by(calibration):
            return [], {}
        products, loaded, ambient = file["products"], file["loaded"], file["ambient_C"]
    count = len(said["causes"]) + 1
    upper = np.triu_indices(count)
    scores = []
    for row, entry in enumerate(said["drives"]):
        square = np.zeros((count, count))
        square[upper] = products[row]
        square.T[upper] = products[row]
        scores.append(Score(Drive(**entry), square, int(loaded[row]), float(ambient[row])))
    return scores, said["silent"]


def read_fleet(root: Path, calibration: Calibration) -> dict[tuple[str, str], list[Score]]:
    """Stored scores of every unit and corner with this calibration, without units that have no usable drive."""
    result = {}
    for path in sorted(Path(root, "evidence").glob("unit=*/corner=*.npz")):
        scores, _ = read_scores(path, calibration)
        if scores:
            result[scores[0].drive.unit, scores[0].drive.corner] = scores
    return result
