"""The fleet's promises: the daemon's own estimates, each file once, faults listed, work that survives, honest statistics."""

import gzip
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from emb_daemon.calibration.files import load_calibration
from emb_daemon.cli.main import main
from emb_daemon.errors import InputError
from emb_daemon.fleet import dataset, population
from emb_daemon.fleet.cluster import cluster, run
from emb_daemon.fleet.ingest import Job, ingest, jobs, log_files
from emb_daemon.fleet.replaying import replay_drive
from emb_daemon.logs.candump import format_candump
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import simulate_log
from emb_daemon.resources import resource

pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def calibration():
    return load_calibration(resource("config/calibration.yaml"))


@pytest.fixture(scope="module")
def logs(tmp_path_factory, calibration) -> Path:
    """Two units with a stop on each of two days, 1 and 3 October 2026."""
    folder = tmp_path_factory.mktemp("logs")
    for unit in range(2):
        (folder / f"car{unit}").mkdir()
        for day in range(2):
            start = 1_790_841_600_000_000_000 + 2 * day * 86_400_000_000_000
            schedule = sc.rest(0.5) + sc.stop(7000.0, 2.0) + sc.rest(0.5)
            frames, _ = simulate_log(
                plant_from_calibration(calibration, unit), schedule, seed=day, reference=False, start_ns=start
            )
            path = folder / f"car{unit}" / f"drive.{day}.log.gz"
            path.write_bytes(gzip.compress(format_candump(frames).encode()))
    return folder


def _ingested(root: Path, logs: Path) -> list[dict]:
    return [ingest(root, job) for job in jobs(root, log_files([logs]))]


def _content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_estimates_of_a_fleet_are_those_of_replay_to_the_last_byte(tmp_path, logs, calibration):
    _ingested(tmp_path / "fleet", logs)
    drives = dataset.drives(tmp_path / "fleet")
    assert [(drive.unit, drive.corner, drive.day) for drive in drives] == [
        (unit, "FL", day) for unit in ("car0", "car1") for day in ("2026-10-01", "2026-10-03")
    ]
    figures = replay_drive(tmp_path / "fleet", drives[1], calibration)
    assert main(["replay", str(logs / "car0/drive.1.log.gz"), "--output", str(tmp_path / "single.parquet")]) == 0
    [written] = (tmp_path / "fleet/estimates").rglob(f"{drives[1].digest}.parquet")
    assert written.read_bytes() == (tmp_path / "single.parquet").read_bytes()
    assert figures["samples"] == 750 and figures["refused"] == {}


def test_each_file_once_a_changed_one_instead_of_what_it_was(tmp_path, logs):
    source = tmp_path / "logs/car"
    source.mkdir(parents=True)
    log, text = source / "a.log", gzip.decompress((logs / "car0/drive.0.log.gz").read_bytes())
    # Half written: the last line is cut off.
    log.write_bytes(text[: text.rindex(b"\n", 0, len(text) // 2) + 10])
    [known] = _ingested(tmp_path / "fleet", source)
    assert not known["fault"] and "cut off" in known["notes"]
    assert jobs(tmp_path / "fleet", [log]) == []
    log.write_bytes(text)
    _ingested(tmp_path / "fleet", source)
    [drive] = dataset.drives(tmp_path / "fleet")
    samples = dataset.read_drive(tmp_path / "fleet", drive)[0].samples
    assert len(samples) == 750
    assert len(list((tmp_path / "fleet/drives").rglob("*.parquet"))) == 1


@pytest.mark.parametrize("content", [b"", b"\x1f\x8b\x08\x00rubbish", b"no candump\n", b"(1.0) can0 7FF#00\n"])
def test_a_damaged_file_is_listed_with_its_reason_and_ends_nothing(tmp_path, logs, content):
    broken = tmp_path / "car0" / "broken.log.gz"
    broken.parent.mkdir()
    broken.write_bytes(content)
    told = [ingest(tmp_path / "fleet", job) for job in jobs(tmp_path / "fleet", [broken, *log_files([logs / "car0"])])]
    assert [bool(known["fault"]) for known in told] == [True, False, False]
    assert str(broken) in told[0]["fault"]
    assert len(dataset.drives(tmp_path / "fleet")) == 2
    assert not jobs(tmp_path / "fleet", [broken])


def test_a_damaged_drive_of_the_data_set_is_an_error_with_its_name(tmp_path, logs):
    _ingested(tmp_path, logs / "car0")
    drive = dataset.drives(tmp_path)[0]
    [path] = (tmp_path / "drives").rglob(f"{drive.digest}.parquet")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=str(path)):
        dataset.read_drive(tmp_path, drive)


@pytest.mark.parametrize("pattern", ["(", "(?P<car>.)", "(?P<unit>nowhere)"])
def test_a_pattern_that_finds_no_unit_is_refused(tmp_path, logs, pattern):
    with pytest.raises(InputError, match="--unit"):
        jobs(tmp_path, log_files([logs]), pattern)


def test_names_of_units_may_hold_anything(tmp_path, logs, calibration):
    [path, _] = log_files([logs / "car0"])
    ingest(tmp_path, Job(path, "VIN 1/2 = ä", "2026-01-01"))
    [drive] = dataset.drives(tmp_path)
    assert drive.unit == "VIN 1/2 = ä"
    assert dataset.read_drive(tmp_path, drive)[1].source == str(path)


def _dies_once(folder: Path, number: int) -> int:
    """A task whose worker is killed the first time it runs number 3, and always at number 5."""
    mark = folder / f"{number}"
    if number == 5 or (number == 3 and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), 9)
    return number * number


def test_workers_may_die(tmp_path):
    with cluster(workers=2) as client:
        done = run(client, partial(_dies_once, tmp_path), list(range(8)), failed=lambda item, reason: f"{item}: {reason}")
    assert done[:5] + done[6:] == [0, 1, 4, 9, 16, 36, 49]
    assert done[5].startswith("5: ")


def test_what_a_killed_client_left_is_gone_on_with_to_the_same_bytes(tmp_path, logs, calibration):
    for name in ("at_once", "resumed"):
        _ingested(tmp_path / name, logs)
    drives = dataset.drives(tmp_path / "at_once")
    for drive in drives:
        replay_drive(tmp_path / "at_once", drive, calibration)
    replay_drive(tmp_path / "resumed", drives[0], calibration)
    # Killed between the estimates and the figures of the second drive.
    replay_drive(tmp_path / "resumed", drives[1], calibration)
    [figures] = (tmp_path / "resumed/figures").rglob(f"{drives[1].digest}.json")
    figures.unlink()
    assert main(["fleet", "replay", str(tmp_path / "resumed"), "--resume", "--workers", "1"]) == 0
    assert _content(tmp_path / "resumed") == _content(tmp_path / "at_once")


# -- statistics -------------------------------------------------------------------------------------------------------


def _fleet(rng, units=60, size=6, causes=12):
    """Units of three batches with scatter that is large in some directions, and prints of causes."""
    spread = np.diag(10.0 ** rng.uniform(-1.0, 0.5, size))
    turn = np.linalg.qr(rng.standard_normal((size, size)))[0]
    values = rng.standard_normal((units, size)) @ spread @ turn
    prints = rng.standard_normal((causes, size))
    batch = np.arange(units) % 3
    return values, prints, {f"batch {n}": batch == n for n in range(3)}, {"batch": batch}


def _read(values, prints, factors):
    centre = population.centres(values, factors)
    return centre, population.Readings(values, centre, prints)


def test_what_a_batch_shares_is_found_with_its_cause_and_size():
    for seed in range(5):
        values, prints, groups, factors = _fleet(np.random.default_rng(seed))
        values[groups["batch 1"]] += 3.0 * prints[4]
        values[groups["batch 2"]] -= 2.0 * prints[7]
        found = population.shared_causes(values, groups, prints, _read(values, prints, factors)[1], beside=True)
        assert {(one.group, one.cause) for one in found} == {("batch 1", 4), ("batch 2", 7)}
        for one in found:
            truth = 3.0 if one.cause == 4 else -2.0
            assert abs(one.amount - truth) < 5.0 * one.sigma


def test_where_nothing_is_shared_nobody_is_accused():
    """60 fleets of healthy units: of all accusations one in a hundred fleets may be false, and of units one in a hundred."""
    batches = units = 0
    for seed in range(60):
        values, prints, groups, factors = _fleet(np.random.default_rng(1000 + seed))
        centre, readings = _read(values, prints, factors)
        batches += bool(population.shared_causes(values, groups, prints, readings, beside=True))
        units += bool(population.outliers(values - centre, readings, np.zeros((len(values), len(prints)))))
    # Binomial, 0.1 %.
    assert batches <= 5 and units <= 5


def test_a_unit_unlike_the_others_is_named_and_does_not_hide_a_second_one():
    values, prints, _, factors = _fleet(np.random.default_rng(3))
    values[10] += 12.0 * prints[2]
    values[20] -= 12.0 * prints[5]
    centre, readings = _read(values, prints, factors)
    found = population.outliers(values - centre, readings, np.zeros((len(values), len(prints))))
    assert {(one.row, one.cause) for one in found} == {(10, 2), (20, 5)}
    # Were its own drives as far apart, it would be none.
    quiet = np.full((len(values), len(prints)), 12.0)
    assert population.outliers(values - centre, readings, quiet) == []


def test_random_effects_take_each_units_own_noise_out():
    rng = np.random.default_rng(0)
    sigmas = rng.uniform(0.5, 3.0, 4000)
    truth = rng.normal(10.0, 1.5, len(sigmas))
    found = population.random_effects(truth + sigmas * rng.standard_normal(len(sigmas)), sigmas)
    assert found.mean == pytest.approx(10.0, abs=5.0 * found.sigma)
    assert found.spread == pytest.approx(1.5, rel=0.1)
    values = truth + sigmas * rng.standard_normal(len(sigmas))
    shrunk = population.random_effects(values, sigmas).shrunk
    assert np.mean((shrunk - truth) ** 2) < 0.6 * np.mean((values - truth) ** 2)


def test_units_that_differ_by_their_noise_alone_have_no_spread():
    found = population.random_effects(np.array([1.0, 1.1, 0.9]), np.full(3, 1.0))
    assert found.spread == 0.0 and np.allclose(found.shrunk, 1.0)
