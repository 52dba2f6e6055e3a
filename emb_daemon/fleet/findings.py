"""Findings from the scores of a fleet: batches, units, drift and season, each with its size in newtons and its p-value."""

import csv
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.effects import REGISTRY
from emb_daemon.errors import InputError
from emb_daemon.fleet.dataset import day_of
from emb_daemon.fleet.population import (
    LEAST_UNITS,
    Difference,
    Directions,
    Readings,
    estimate_random_effects,
    find_centres,
    find_outliers,
    find_shared_causes,
    find_slope_directions,
    fit_unit,
)
from emb_daemon.fleet.scores import Cause, Score

#: Drift is stated per this number of days, season per this number of kelvins.
PER_DAYS, PER_K = 30.0, 10.0
#: Drift is tested if the drives span this number of days, season if the ambient temperature spans this number of kelvins.
_LEAST_DAYS, _LEAST_K = 5, 5.0
#: Least force that is reported, N. For a group: two thousandths of a usual stop of 5 kN, as in `diagnose` for a log. For a
#: single unit: the same share of the 18 kN that training reaches, because a workshop could not confirm less.
_LEAST_SHARED_N, _LEAST_UNIT_N = 10.0, 36.0
#: Number of points of a trend.
_WINDOWS = 8
#: Least number of drives of a unit from which its scatter is known, and from which slopes over two covariates are too.
_LEAST_DRIVES, _SLOPE_DRIVES = 3, 6
ALL = "all units"

Fleet = Mapping[tuple[str, str], Sequence[Score]]


class Finding(msgspec.Struct, kw_only=True):
    """Something that differs from the calibration, or from the other units."""

    where: str  #: a level of a factor (``batch A``), ``all units``, or a unit and corner
    units: int  #: how many share it
    #: ``cause``, ``key``, ``shape``, ``amount``, ``sigma`` and ``unit``: see `scores.Cause`; ``amount`` is the difference from
    #: the others, or the change per 30 days or 10 K.
    cause: str
    key: str
    shape: float | None
    amount: float
    sigma: float
    unit: str
    size_N: float  #: RMS of its force in contact, with the amount's sign; ``sigma_N`` its standard deviation
    sigma_N: float
    chance: float  #: of a false alarm, corrected for all tests: for groups that any is false, for units the q-value
    rivals: tuple[str, ...]  #: causes that explain nearly as much
    action: str  #: what to do next


class Placed(msgspec.Struct, kw_only=True):
    """One unit on the fleet's map: its difference from its group in its worst cause, in standard deviations and N."""

    unit: str
    corner: str
    levels: dict[str, str]
    drives: int
    cause: str
    deviation: float
    size_N: float
    outlying: bool


class Spread(msgspec.Struct, kw_only=True):
    """A cause over the population: mean and standard deviation between units, in the cause's unit and in N, and the median
    unit's noise in N."""

    cause: str
    key: str
    unit: str
    mean: float
    spread: float
    mean_N: float
    spread_N: float
    noise_N: float


class Trend(msgspec.Struct, kw_only=True):
    """A cause over time in one group: days since the first drive, N, and standard deviations."""

    where: str
    cause: str
    days: list[float]
    size_N: list[float]
    sigma_N: list[float]


class Findings(msgspec.Struct, kw_only=True):
    """All findings. ``silent``: why drives cannot be used, by digest; ``left_out``: units that cannot be placed, and why."""

    calibration: str
    first_day: str
    last_day: str
    drives: int
    silent: dict[str, str]
    left_out: dict[str, str]
    directions: int
    causes: int
    groups: list[Finding]
    drifts: list[Finding]
    seasons: list[Finding]
    outliers: list[Finding]
    ageing: list[Finding]
    units: list[Placed]
    population: list[Spread]
    trends: list[Trend]


def save(findings: Findings, root: Path) -> None:
    write_atomically(Path(root, "findings.json"), msgspec.json.format(msgspec.json.encode(findings), indent=1))


def load(root: Path) -> Findings:
    """Raises InputError: no such file, or not a file of findings."""
    path = Path(root, "findings.json")
    try:
        return msgspec.json.decode(path.read_bytes(), type=Findings)
    except OSError:
        raise InputError(f"{path}: no such file; run emb-daemon fleet diagnose first") from None
    except msgspec.DecodeError as error:
        raise InputError(f"{path}: {error}") from None


def read_units(path: Path) -> dict[str, dict[str, str]]:
    """Factors by unit: a CSV file with a column ``unit``, and one for each factor (batch, supplier, plant, ...). Raises
    InputError: not such a file, or a unit occurs twice."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: {error}") from None
    if not rows or "unit" not in rows[0] or len(rows[0]) < 2:
        raise InputError(f"{path}: expected a header 'unit,FACTOR,...' and rows under it")
    result: dict[str, dict[str, str]] = {}
    for line, row in enumerate(rows, start=2):
        unit = row.pop("unit")
        if unit in result:
            raise InputError(f"{path}:{line}: unit {unit} occurs twice")
        if None in row or None in row.values():
            raise InputError(f"{path}:{line}: expected {len(rows[0]) + 1} columns")
        result[unit] = {name: value for name, value in row.items() if value}
    return result


def find(
    fleet: Fleet,
    causes: Sequence[Cause],
    calibration: str,
    factors: Mapping[str, Mapping[str, str]],
    silent: Mapping[str, str],
) -> Findings:
    """All findings from a fleet's scores. ``causes``: in the order of the scores' columns; ``factors``: by unit and name,
    properties that units share: batch, supplier. Raises InputError: too few units to distinguish one from the others."""
    slopes = np.median([len(scores) for scores in fleet.values()] or [0]) >= _SLOPE_DRIVES
    least = _SLOPE_DRIVES if slopes else _LEAST_DRIVES
    placed = {key: scores for key, scores in fleet.items() if len(scores) >= least}
    left_out = {
        f"{unit} {corner}": f"{len(scores)} drives can be used, expected {least}"
        for (unit, corner), scores in fleet.items()
        if (unit, corner) not in placed
    }
    if len(placed) < 2 * LEAST_UNITS:
        raise InputError(f"{len(placed)} units with {least} drives or more, expected at least {2 * LEAST_UNITS}")
    return _Study(placed, causes, factors, bool(slopes)).findings(calibration, dict(silent), left_out)


class _Study:
    """The vectors of the population, and the findings from them."""

    def __init__(self, fleet: Fleet, causes: Sequence[Cause], factors: Mapping[str, Mapping[str, str]], slopes: bool):
        self.keys, self.scores, self.causes = list(fleet), list(fleet.values()), causes
        self.every = [score for scores in self.scores for score in scores]
        self.directions = Directions.of(self.every)
        self.start = min(score.drive.begin_ns for score in self.every)
        self.days = [np.array([1e-9 * (s.drive.begin_ns - self.start) / 86400.0 for s in scores]) for scores in self.scores]
        self.span = max(float(days.max()) for days in self.days)
        warmth = np.array([score.ambient_C for score in self.every])
        self.warmth_C = float(np.nanmean(warmth)) if np.isfinite(warmth).any() else 0.0
        self.covariates = ["level"]
        if slopes and self.span >= _LEAST_DAYS - 1:
            self.covariates.append("day")
        if slopes and np.isfinite(warmth).all() and np.ptp(warmth) >= _LEAST_K:
            self.covariates.append("warmth")
        columns = [self._columns(scores, days) for scores, days in zip(self.scores, self.days, strict=True)]
        #: The directions in which units may differ, by covariate.
        self.free = [np.eye(self.directions.basis.shape[1])]
        for covariate in zip(*(c.T[1:] for c in columns), strict=True):
            self.free.append(find_slope_directions(self.scores, self.directions, covariate))
        self.units = [fit_unit(s, self.directions, c, self.free) for s, c in zip(self.scores, columns, strict=True)]
        named = sorted({name for levels in factors.values() for name in levels})
        # Corners differ by design: front and rear brakes are different.
        self.levels = {"corner": np.array([corner for _, corner in self.keys])}
        self.levels |= {name: np.array([factors.get(unit, {}).get(name, "") for unit, _ in self.keys]) for name in named}
        self.levels = {name: levels for name, levels in self.levels.items() if len(set(levels.tolist())) > 1}
        # Groups of all factors except the corner, whose difference is by design.
        self.groups = {
            f"{name} {level}": levels == level
            for name, levels in self.levels.items() if name != "corner"
            for level in np.unique(levels).tolist() if level
        }  # fmt: skip
        self.masks = {ALL: np.ones(len(self.keys), bool), **self.groups}

    def _columns(self, scores: Sequence[Score], days: np.ndarray) -> np.ndarray:
        """Covariates of a unit's drives, shape (drives, m)."""
        columns = {
            "level": np.ones(len(scores)),
            "day": (days - 0.5 * self.span) / PER_DAYS,
            "warmth": (np.array([s.ambient_C for s in scores]) - self.warmth_C) / PER_K,
        }
        return np.column_stack([columns[name] for name in self.covariates])

    def read(self, covariate: str) -> tuple[np.ndarray, np.ndarray, Readings]:
        """The units' vectors, the same about their groups' centres, and readings of them."""
        row = self.covariates.index(covariate)
        free = self.free[row]
        vectors = np.array([unit.values[row] for unit in self.units]) @ free
        centre = find_centres(vectors, self.levels)
        noise = free.T @ np.array([unit.noise[row] for unit in self.units]) @ free
        freedom = np.array([unit.freedom for unit in self.units])
        return vectors, vectors - centre, Readings(vectors, centre, self.directions.signatures_in(free), noise, freedom)

    def findings(self, calibration: str, silent: dict[str, str], left_out: dict[str, str]) -> Findings:
        level, centred, readings = self.read("level")
        groups = find_shared_causes(level, self.groups, readings, against_others=True)
        over: dict[str, list[Finding]] = {"day": [], "warmth": []}
        ageing: list[Finding] = []
        for name in self.covariates[1:]:
            slopes, centred_slopes, slope_readings = self.read(name)
            # The season of a cause that acts by a temperature would be the curvature of its law, and a misfit of the heat
            # model looks like it. It is the same in all units: more of them only make it more significant; no batch shows it.
            thermal = [row for row, cause in enumerate(self.causes) if cause.thermal and name == "warmth"]
            shared = find_shared_causes(slopes, {ALL: self.masks[ALL]}, slope_readings, against_others=False, misfits=thermal)
            shared += find_shared_causes(slopes, self.groups, slope_readings, against_others=True)
            over[name] = self._list_shared(shared, _ACTIONS[name])
            if name == "day":
                ageing = self._outliers(centred_slopes, slope_readings, _ACTIONS["ageing"])
        outlying = self._outliers(centred, readings, _ACTIONS["unit"])
        return Findings(
            calibration=calibration,
            first_day=day_of(self.start),
            last_day=day_of(max(score.drive.begin_ns for score in self.every)),
            drives=len(self.every),
            silent=silent,
            left_out=left_out,
            directions=len(self.free[0]),
            causes=len(self.causes),
            groups=self._list_shared(groups, _ACTIONS["level"]),
            drifts=over["day"],
            seasons=over["warmth"],
            outliers=outlying,
            ageing=ageing,
            units=self._place_units(centred, readings, {finding.where for finding in (*outlying, *ageing)}),
            population=self._population(level, readings),
            trends=self._trends([*groups][:3], over["day"], readings),
        )

    def _finding(self, where: str, units: int, one: Difference, action: Callable[[Cause], str]) -> Finding:
        cause, size = self.causes[one.cause], float(self.directions.size_N[one.cause])
        return Finding(
            where=where, units=units, cause=cause.name, key=cause.key, shape=cause.shape, amount=one.amount, sigma=one.sigma,
            unit=cause.unit, size_N=one.amount * size, sigma_N=one.sigma * size, chance=one.chance, action=action(cause),
            rivals=tuple(dict.fromkeys(self.causes[r].name for r in one.rivals if self.causes[r].name != cause.name)),
        )  # fmt: skip

    def _list_shared(self, shared: Sequence[Difference], action: Callable[[Cause], str]) -> list[Finding]:
        found = [self._finding(one.where, int(self.masks[one.where].sum()), one, action) for one in shared]
        return [one for one in found if abs(one.size_N) >= _LEAST_SHARED_N]

    def _outliers(self, deviations: np.ndarray, readings: Readings, action: Callable[[Cause], str]) -> list[Finding]:
        found = [self._finding(" ".join(self.keys[one.where]), 1, one, action) for one in find_outliers(deviations, readings)]
        return [one for one in found if abs(one.size_N) >= _LEAST_UNIT_N]

    def _place_units(self, deviations: np.ndarray, readings: Readings, named: set[str]) -> list[Placed]:
        amounts, rows = readings.amounts(deviations), readings.ordinary
        spread = np.sqrt((amounts[rows] ** 2).mean(axis=0))
        worst = np.argmax(np.abs(amounts) / spread, axis=1)
        result = []
        for row, (unit, corner) in enumerate(self.keys):
            cause = int(worst[row])
            amount, size = amounts[row, cause], self.directions.size_N[cause]
            result.append(
                Placed(
                    unit=unit, corner=corner, levels={name: str(levels[row]) for name, levels in self.levels.items()},
                    drives=len(self.scores[row]), cause=str(self.causes[cause]), deviation=float(amount / spread[cause]),
                    size_N=float(amount * size), outlying=f"{unit} {corner}" in named,
                )
            )  # fmt: skip
        return result

    def _population(self, level: np.ndarray, readings: Readings) -> list[Spread]:
        amounts, noise = readings.amounts(level), readings.noise()
        result = []
        for row, cause in enumerate(self.causes):
            size = self.directions.size_N[row]
            effects = estimate_random_effects(amounts[readings.ordinary, row], noise[readings.ordinary, row])
            result.append(
                Spread(
                    cause=str(cause), key=cause.key, unit=cause.unit, mean=effects.mean, spread=effects.spread,
                    mean_N=float(effects.mean * size), spread_N=float(effects.spread * size),
                    noise_N=float(np.median(noise[:, row]) * size),
                )
            )  # fmt: skip
        return result

    def _trends(self, shared: Sequence[Difference], drifts: Sequence[Finding], readings: Readings) -> list[Trend]:
        """Trends of the causes that batches share and of drifts, by windows of time, over all drives of a group together."""
        names = [str(cause) for cause in self.causes]
        wanted = [(s.where, s.cause) for s in shared]
        wanted += [
            (f.where, next(row for row, c in enumerate(self.causes) if (c.key, c.shape) == (f.key, f.shape))) for f in drifts
        ]
        edges = np.linspace(0.0, self.span + 1e-9, min(_WINDOWS, int(self.span) + 1) + 1)
        result = []
        for group, cause in dict.fromkeys(wanted):
            days, sizes, sigmas = [], [], []
            reading, size = readings.filters[:, cause].mean(axis=0), self.directions.size_N[cause]
            members = np.flatnonzero(self.masks[group] & readings.ordinary)
            for low, high in pairwise(edges.tolist()):
                window = [
                    s for row in members for s, day in zip(self.scores[row], self.days[row], strict=True) if low <= day < high
                ]
                if len(window) < _LEAST_DRIVES:
                    continue
                pooled = fit_unit(window, self.directions, np.ones((len(window), 1)), self.free[:1])
                days.append(float(0.5 * (low + high)))
                sizes.append(float(reading @ pooled.values[0] * size))
                sigmas.append(float(np.sqrt(reading @ pooled.noise[0] @ reading) * size))
            result.append(Trend(where=group, cause=names[cause], days=days, size_N=sizes, sigma_N=sigmas))
        return result


def _manoeuvre(cause: Cause) -> str:
    """Words for the manoeuvre that makes a cause visible."""
    manoeuvre = next((effect.manoeuvre for effect in REGISTRY if effect.name == cause.name), "")
    return f"to see it: {manoeuvre or 'slow and fast strokes over all forces'}"


_ACTIONS: dict[str, Callable[[Cause], str]] = {
    "level": lambda cause: (
        f"Take two units to a rig with a force sensor, record logs, and run emb-daemon diagnose; {_manoeuvre(cause)}."
    ),
    "day": lambda _: "Let the daemons train more often, or update the calibration.",
    "warmth": lambda _: "The calibration lacks an effect of temperature: run emb-daemon diagnose on cold and warm drives.",
    "unit": lambda cause: f"Train it, then run emb-daemon diagnose on its drives; {_manoeuvre(cause)}.",
    "ageing": lambda cause: (
        f"It ages differently from the others: train it, and check it again in a month; {_manoeuvre(cause)}."
    ),
}
