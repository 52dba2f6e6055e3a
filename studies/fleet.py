"""A simulated fleet whose secrets are drawn: does `emb-daemon fleet` find them, and nothing else?

Units scatter as well calibrated ones do. Three of five batches share one effect each, of 40 to 80 N RMS in contact, below what
one car's diagnosis calls significant; ten single units have a fault of 120 to 250 N, or of six times what healthy units differ
by; the grease of all units ages. A day is a drive of a quarter of a minute, three stops and a slow clamp, because 6 000 drives
have to fit into minutes: a real day would say more. Nothing but the drives' samples and a table of unit and batch reaches the
fleet's commands.
"""

import argparse
import datetime
import shutil
import sys
import time
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

import numpy as np

from emb_daemon.calibration.files import calibration_hash, shipped_calibration
from emb_daemon.cli.main import main as emb_daemon
from emb_daemon.fleet import dataset
from emb_daemon.fleet.cluster import cluster, run
from emb_daemon.fleet.dataset import Drive
from emb_daemon.fleet.findings import ALL, Findings, load
from emb_daemon.fleet.ingest import ingest_frames
from emb_daemon.fleet.scores import Scorer
from emb_daemon.offline import log_of
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.derive import plant_from_calibration

_FIRST_DAY = datetime.datetime(2026, 10, 1, 7, tzinfo=datetime.UTC)
_BATCHES, _HIDDEN = "ABCDE", 3
#: RMS in contact (N) of what a batch shares, of a single unit's fault, and of what a month does to everybody's grease.
_BATCH_N, _FAULT_N, _AGEING_N = (40.0, 80.0), (120.0, 250.0), 40.0
_FAULTY = 10
#: Parameters in which healthy units differ by 45 N, and the size (N) of a fault in them: six times as much and more.
_SCATTERING, _SCATTERING_FAULT_N = {"friction.load_m_per_rad", "friction.offset_Nm"}, (270.0, 400.0)


@dataclass(frozen=True)
class Secret:
    """Something that is not as calibrated: ``cause`` as a calibration's key or an effect's name, and its ``size_N``."""

    cause: str
    size_N: float
    parameters: dict[str, float]


#: Kinds of secrets, by cause: its parameter in the simulated brake, whether its sign is drawn, and shapes with their ranges.
_KINDS: dict[str, tuple[str, bool, dict[str, tuple[float, float]]]] = {
    "friction.load_m_per_rad": ("load_friction", True, {}),
    "friction.offset_Nm": ("offset_friction", False, {}),
    "viscous_friction": ("viscous_Nms_per_rad", False, {}),
    "stribeck_friction": ("rise", False, {"speed_rad_per_s": (2.0, 15.0)}),
    "friction_asymmetry": ("asymmetry", True, {}),
    "current_offset": ("offset_A", True, {}),
    "stiffness_hysteresis": ("share", False, {}),
    "second_relaxation": ("share", False, {}),
    "third_relaxation": ("share", False, {"time_constant_s": (1.5, 8.0)}),
    "signal_delay": ("delay_s", False, {}),
    "backlash": ("play_rad", False, {}),
}


@cache
def _calibration():
    return shipped_calibration()


def day_drive(rng: np.random.Generator) -> sc.Schedule:
    """A quarter of a minute: stops from town speeds as hard and as quick as it comes, and a slow clamp at standstill."""

    def stop(low_N, high_N, rise_s, seconds):
        return sc.stop(rng.uniform(low_N, high_N), seconds, rise_s)

    drive = sc.rest(0.5)
    for _ in range(3):
        drive += sc.accelerate(rng.uniform(6.0, 14.0), rng.uniform(1.2, 2.0)) + stop(
            3e3, 14e3, rng.uniform(0.15, 0.6), rng.uniform(2.0, 2.8)
        )
    return drive + stop(6e3, 14e3, 1.5, 3.0) + sc.rest(0.5)


@cache
def _sizes() -> dict[str, float]:
    """RMS (N) in contact that one unit of each cause makes on a typical drive."""
    frames, _ = sc.simulate_log(plant_from_calibration(_calibration()), day_drive(np.random.default_rng(0)), reference=False)
    scorer = Scorer(_calibration())
    score = scorer.score(log_of(frames), Drive("", "FL", "", 0, ""))
    size = np.sqrt(np.diag(score.products)[:-1] / score.loaded)
    found: dict[str, float] = {}
    for cause, value in zip(scorer.causes, size.tolist(), strict=True):
        found.setdefault(cause.name, value)
    return found


def draw_secret(rng: np.random.Generator, range_N: tuple[float, float], but: set[str] = frozenset()) -> Secret:
    cause = str(rng.choice([name for name in _KINDS if name not in but]))
    amplitude, signed, shapes = _KINDS[cause]
    range_N = _SCATTERING_FAULT_N if cause in _SCATTERING and range_N is _FAULT_N else range_N
    size = float(rng.uniform(*range_N)) * (float(rng.choice((-1.0, 1.0))) if signed else 1.0)
    parameters = {amplitude: size / _sizes()[cause]} | {name: float(rng.uniform(*limits)) for name, limits in shapes.items()}
    return Secret(cause, size, parameters)


def apply(plant: np.void, secret: Secret, share: float = 1.0) -> None:
    """Give a simulated brake a share of a secret."""
    amplitude = _KINDS[secret.cause][0]
    for name, value in secret.parameters.items():
        if secret.cause not in plant["effects"].dtype.names:
            plant[name] *= 1.0 + share * value
        elif name == amplitude:
            plant["effects"][secret.cause][name] += share * value
        else:
            plant["effects"][secret.cause][name] = value


@dataclass(frozen=True)
class Fleet:
    """Batch of each unit, secrets of batches and of single units, and what a month does to all."""

    seed: int
    days: int
    batch: dict[str, str]
    batches: dict[str, Secret]
    faults: dict[str, Secret]
    ageing: Secret

    @classmethod
    def draw(cls, seed: int, units: int = 200, days: int = 30, faulty: int = _FAULTY) -> "Fleet":
        rng = np.random.default_rng([seed, units, days])
        names = [f"unit-{number:03d}" for number in range(units)]
        batch = dict(zip(names, np.array(list(_BATCHES))[rng.permutation(units) % len(_BATCHES)].tolist(), strict=True))
        ageing = Secret("viscous_friction", _AGEING_N, {"viscous_Nms_per_rad": _AGEING_N / _sizes()["viscous_friction"]})
        batches: dict[str, Secret] = {}
        for name in rng.choice(list(_BATCHES), _HIDDEN, replace=False).tolist():
            batches[name] = draw_secret(rng, _BATCH_N, {secret.cause for secret in batches.values()})
        chosen = rng.choice(names, faulty, replace=False).tolist()
        # A unit's fault of the same cause as its batch's effect could not be told from it.
        faults = {
            name: draw_secret(rng, _FAULT_N, {batches[batch[name]].cause} if batch[name] in batches else set())
            for name in chosen
        }
        return cls(seed, days, batch, batches, faults, ageing)


def drive_unit(root: Path, fleet: Fleet, unit: str) -> int:
    """All drives of one unit into the data set; returns how many seconds they last."""
    number = list(fleet.batch).index(unit)
    rng = np.random.default_rng([fleet.seed, number])
    plant = plant_from_calibration(_calibration(), int(rng.integers(1 << 32)))
    for secret in (fleet.batches.get(fleet.batch[unit]), fleet.faults.get(unit)):
        if secret:
            apply(plant, secret)
    grease, seconds = max(0.0, 1.0 + 0.3 * rng.standard_normal()), 0.0
    for day in range(fleet.days):
        today = plant.copy()
        apply(today, fleet.ageing, grease * day / max(fleet.days - 1, 1))
        # Every power-on has a zero and a contact of its own.
        today["released_angle"] = rng.uniform(-200.0, 200.0)
        today["contact_angle"] += 0.02 * rng.standard_normal()
        ambient = 14.0 + 6.0 * np.sin(2.0 * np.pi * day / 30.0) + rng.normal(0.0, 3.0)
        begin = _FIRST_DAY + datetime.timedelta(days=day, seconds=int(rng.integers(36_000)))
        schedule = day_drive(rng)
        schedule.drives["ambient"] = ambient
        frames, _ = sc.simulate_log(
            today, schedule, seed=int(rng.integers(1 << 32)), reference=False,
            start_ns=int(begin.timestamp()) * 1_000_000_000, ambient=ambient,
        )  # fmt: skip
        digest = f"{fleet.seed:04x}{number:06x}{day:06x}"
        found = ingest_frames(root, frames, unit, digest, f"simulated {unit} day {day}")
        known = {"source": f"simulated {unit} day {day}", "size": 0, "mtime_ns": 0, "sha256": digest, "notes": "", "fault": ""}
        dataset.note(root, known | {"drives": [asdict(drive) for drive in found]})
        seconds += schedule.seconds
    return seconds


# -- judging ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """Findings judged by the secrets: batches with the right cause, groups accused wrongly, drifts and seasons that nobody
    hid, faulty units, units accused wrongly, and how many of the faulty ones have the right cause; whether the ageing was."""

    batches: int
    false_batches: tuple[str, ...]
    false_trends: tuple[str, ...]
    units: int
    named: int
    false_units: tuple[str, ...]
    missed: tuple[str, ...]
    ageing: bool

    def passed(self, fleet: Fleet) -> bool:
        """All batches with the right effect, nine of ten units, and at most one false accusation of all."""
        false = len(self.false_batches) + len(self.false_trends) + len(self.false_units)
        return self.batches == len(fleet.batches) and self.units >= 0.9 * len(fleet.faults) and false <= 1


def judge(fleet: Fleet, found: Findings) -> Verdict:
    secrets = {f"batch {name}": secret.cause for name, secret in fleet.batches.items()}
    right = {one.where for one in found.groups if secrets.get(one.where) == one.cause}
    aged = [one for one in found.drifts if one.where == ALL and one.cause == fleet.ageing.cause]
    accused = {one.where.split()[0]: one.cause for one in (*found.ageing, *found.outliers)}
    return Verdict(
        batches=len(right),
        false_batches=tuple(f"{one.where}: {one.cause}" for one in found.groups if secrets.get(one.where) != one.cause),
        false_trends=tuple(f"{one.where}: {one.cause}" for one in (*found.drifts, *found.seasons) if one not in aged),
        units=len(accused.keys() & fleet.faults.keys()),
        named=sum(accused.get(unit) == secret.cause for unit, secret in fleet.faults.items()),
        false_units=tuple(sorted(accused.keys() - fleet.faults.keys())),
        missed=tuple(sorted(fleet.faults.keys() - accused.keys())),
        ageing=bool(aged),
    )


def simulate(root: Path, fleet: Fleet, progress=lambda done, total: None) -> None:
    """All drives of a fleet into a data set, and its table of units beside them."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "units.csv").write_text("unit,batch\n" + "".join(f"{unit},{batch}\n" for unit, batch in fleet.batch.items()))
    with cluster() as client:
        run(client, partial(drive_unit, root, fleet), list(fleet.batch), progress)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--units", type=int, default=200)
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--output", type=Path, default=Path("build/fleet"), metavar="DIR", help="data set and report.html")
    arguments = parser.parse_args(argv)
    root = arguments.output.absolute()
    shutil.rmtree(root, ignore_errors=True)
    fleet, begin = Fleet.draw(arguments.seed, arguments.units, arguments.days), time.monotonic()
    print(
        f"seed {fleet.seed}: {arguments.units} simulated units, {arguments.days} days, "
        f"calibration {calibration_hash(_calibration())}"
    )
    for where, secret in (*fleet.batches.items(), *fleet.faults.items()):
        print(f"  secret of {where}: {secret.cause} {secret.size_N:+.0f} N")
    print(f"  all units: {fleet.ageing.cause} {fleet.ageing.size_N:+.0f} N over the {arguments.days} days")
    simulate(root, fleet)
    simulated = time.monotonic()
    command = ["fleet", "diagnose", str(root), "--units", str(root / "units.csv")]
    if status := emb_daemon(command) or emb_daemon(["fleet", "report", str(root), "--output", str(root / "report.html")]):
        return status
    verdict, end = judge(fleet, load(root)), time.monotonic()
    processor = sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))
    print(f"batches with the right effect {verdict.batches} of {len(fleet.batches)}, wrong {list(verdict.false_batches)}")
    print(
        f"faulty units {verdict.units} of {len(fleet.faults)} ({verdict.named} with the right cause), "
        f"missed {list(verdict.missed)}, accused wrongly {list(verdict.false_units)}"
    )
    print(f"ageing {'found' if verdict.ageing else 'not found'}, other drifts and seasons {list(verdict.false_trends)}")
    print(f"simulated in {simulated - begin:.0f} s, diagnosed in {end - simulated:.0f} s, {processor:.0f} s of processor time")
    print(f"{root / 'report.html'}; {'passed' if verdict.passed(fleet) else 'FAILED'}")
    return 0 if verdict.passed(fleet) else 1


if __name__ == "__main__":
    sys.exit(main())
