"""The fleet's promises: the daemon's own estimates, each file once, faults listed, work that survives, honest statistics."""

import gzip
import json
import os
import re
import shutil
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import processkit
import pyarrow.parquet
import pytest

from emb_daemon.calibration.files import load_calibration, save_calibration
from emb_daemon.calibration.parameters import moved
from emb_daemon.cli.main import main
from emb_daemon.diagnose import residuals
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.fleet import dataset, findings, learning, population, scores
from emb_daemon.fleet.cluster import cluster, run
from emb_daemon.fleet.ingest import Job, ingest, ingest_frames, jobs, log_files
from emb_daemon.fleet.replaying import is_replayed, replay_drive
from emb_daemon.logs.candump import format_candump
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import simulate_log
from studies import fleet as study
from studies import fleet_speed
from studies.drives import training

pytest.importorskip("distributed")


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


@pytest.fixture(scope="module")
def scheduler() -> str:
    """Address of a cluster that is there already; its worker is a thread, which has imported everything."""
    from distributed import LocalCluster

    more = {"protocol": "tcp://", "host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **more) as local:
        yield local.scheduler_address


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


def test_the_clamp_force_of_a_rig_is_beside_the_estimates(tmp_path, calibration):
    """Of the reference instruments a data set keeps this one, as replay writes it."""
    folder = tmp_path / "rig"
    folder.mkdir()
    schedule = sc.rest(0.5) + sc.stop(7000.0, 2.0) + sc.rest(0.5)
    frames, _ = simulate_log(plant_from_calibration(calibration, 1), schedule)
    (folder / "drive.log").write_text(format_candump(frames))
    _ingested(tmp_path / "fleet", folder)
    [drive] = dataset.drives(tmp_path / "fleet")
    assert replay_drive(tmp_path / "fleet", drive, calibration)["force_N"]
    assert main(["replay", str(folder / "drive.log"), "--output", str(tmp_path / "single.parquet")]) == 0
    [written] = (tmp_path / "fleet/estimates").rglob("*.parquet")
    single, fleet = (pyarrow.parquet.ParquetFile(path).read() for path in (tmp_path / "single.parquet", written))
    assert "clamp_force_ref_N" in fleet.column_names and single.select(fleet.column_names).equals(fleet)


def test_each_file_is_ingested_once_and_a_changed_one_replaces_its_drives(tmp_path, logs, scheduler, calibration):
    source = tmp_path / "logs/car"
    source.mkdir(parents=True)
    log, text = source / "a.log", gzip.decompress((logs / "car0/drive.0.log.gz").read_bytes())
    # Half written: the last line is cut off.
    log.write_bytes(text[: text.rindex(b"\n", 0, len(text) // 2) + 10])
    [known] = _ingested(tmp_path / "fleet", source)
    assert not known["fault"] and "cut off" in known["notes"]
    assert jobs(tmp_path / "fleet", [log]) == []
    [half] = dataset.drives(tmp_path / "fleet")
    replay_drive(tmp_path / "fleet", half, calibration)
    assert len([name for name in _content(tmp_path / "fleet") if half.digest in name]) == 3
    log.write_bytes(text)
    assert main(["fleet", "ingest", str(source), "--output", str(tmp_path / "fleet"), "--scheduler", scheduler]) == 0
    [drive] = dataset.drives(tmp_path / "fleet")
    samples = dataset.read_drive(tmp_path / "fleet", drive)[0].samples
    assert len(samples) == 750
    assert not [name for name in _content(tmp_path / "fleet") if half.digest in name], "the report would count both"
    # Written again, of the same size.
    assert jobs(tmp_path / "fleet", [log]) == []
    os.utime(log, ns=(0, log.stat().st_mtime_ns + 1))
    assert [job.path for job in jobs(tmp_path / "fleet", [log])] == [log]


def test_copies_of_a_log_are_one_drive_of_each_unit(tmp_path, logs):
    text = (logs / "car0/drive.0.log.gz").read_bytes()
    for name in ("car0/day.log.gz", "car0/newest.log.gz", "car1/day.log.gz"):
        path = tmp_path / "logs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)
    assert len(_ingested(tmp_path / "fleet", tmp_path / "logs")) == 3
    assert jobs(tmp_path / "fleet", log_files([tmp_path / "logs"])) == []
    assert [drive.unit for drive in dataset.drives(tmp_path / "fleet")] == ["car0", "car1"]


def test_a_log_that_was_rotated_is_kept(tmp_path, logs, scheduler):
    """Its path has another content now, and its content another path."""
    source, command = tmp_path / "car", ["fleet", "ingest", str(tmp_path / "car"), "--output", str(tmp_path / "fleet")]
    source.mkdir()
    shutil.copy(logs / "car0/drive.0.log.gz", source / "day.log.gz")
    assert main([*command, "--scheduler", scheduler]) == 0
    (source / "day.log.gz").rename(source / "day.1.log.gz")
    shutil.copy(logs / "car0/drive.1.log.gz", source / "day.log.gz")
    assert main([*command, "--scheduler", scheduler]) == 0
    drives = dataset.drives(tmp_path / "fleet")
    assert [drive.day for drive in drives] == ["2026-10-01", "2026-10-03"]
    assert all(len(dataset.read_drive(tmp_path / "fleet", drive)[0].samples) == 750 for drive in drives)


@pytest.mark.parametrize("content", [b"", b"\x1f\x8b\x08\x00rubbish", b"no candump\n", b"(1.0) can0 7FF#00\n"])
def test_a_damaged_file_is_listed_with_its_reason_and_the_work_goes_on(tmp_path, logs, content):
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


def test_a_data_set_from_before_force_sensors_is_read_as_one_without(tmp_path, logs):
    import pyarrow.parquet

    _ingested(tmp_path, logs / "car0")
    drive = dataset.drives(tmp_path)[0]
    [path] = (tmp_path / "drives").rglob(f"{drive.digest}.parquet")
    samples = dataset.read_drive(tmp_path, drive)[0].samples
    table = pyarrow.parquet.ParquetFile(path).read()
    pyarrow.parquet.write_table(table.drop_columns(["sensor_force", "has_sensor_force"]), path)
    again = dataset.read_drive(tmp_path, drive)[0].samples
    for name in set(samples.dtype.names) - {"sensor_force"}:
        np.testing.assert_array_equal(again[name], samples[name])
    assert not again["has_sensor_force"].any()
    pyarrow.parquet.write_table(table.drop_columns(["angle"]), path)
    with pytest.raises(InputError, match="angle"):
        dataset.read_drive(tmp_path, drive)


@pytest.mark.parametrize("pattern", ["(", "(?P<car>.)", "(?P<unit>nowhere)"])
def test_a_pattern_that_finds_no_unit_is_refused(tmp_path, logs, pattern):
    with pytest.raises(InputError, match="--unit"):
        jobs(tmp_path, log_files([logs]), pattern)


def test_names_of_units_may_contain_any_character(tmp_path, logs, calibration):
    [path, _] = log_files([logs / "car0"])
    ingest(tmp_path, Job(path, "VIN 1/2 = ä", "2026-01-01"))
    [drive] = dataset.drives(tmp_path)
    assert drive.unit == "VIN 1/2 = ä"
    assert dataset.read_drive(tmp_path, drive)[1].source == str(path)


@pytest.mark.trial
@pytest.mark.parametrize("lives", [0, 3])
def test_workers_may_die(tmp_path, monkeypatch, lives):
    """Dask counts a worker's death against every task that lay there: only who kills one alone is given up."""
    monkeypatch.setattr("emb_daemon.fleet.cluster._LIVES", lives)

    def square(number: int) -> int:
        """Its worker is killed the first time it squares 3, and always at 5."""
        mark = tmp_path / f"{number}"
        if number == 5 or (number == 3 and not mark.exists()):
            mark.touch()
            os.kill(os.getpid(), 9)
        return number * number

    told = []
    with cluster(workers=2) as client:
        done = run(
            client, square, list(range(8)), lambda *counts: told.append(counts), lambda item, reason: f"{item}: {reason}"
        )
    assert done[:5] + done[6:] == [0, 1, 4, 9, 16, 36, 49]
    assert done[5].startswith("5: ")
    assert told == [(number, 8) for number in range(1, 9)]


def test_many_more_items_than_are_submitted_ahead_are_all_done_in_their_order(scheduler):
    with cluster(scheduler) as client:
        assert run(client, abs, range(-50, 0)) == list(range(50, 0, -1))


def test_a_process_works_on_one_cluster_after_another():
    """Not one that has worked with Dask before."""
    twice = "from emb_daemon.fleet.cluster import cluster, run\nfor text in 'a', 'bc':\n"
    twice += "    with cluster(workers=1) as client:\n        print(run(client, len, [text]))"
    done = processkit.python("-c", twice)
    assert (done.returncode, done.stdout.split()) == (0, ["[1]", "[2]"]), done.stderr


@pytest.mark.trial
def test_a_worker_has_no_reader_of_files_that_another_process_reads():
    with cluster(workers=1) as client:
        [loaded] = client.run(lambda: {name: name in sys.modules for name in ("can", "asammdf")}).values()
    assert loaded == {"can": True, "asammdf": False}


def test_the_end_of_the_work_waits_for_a_worker_that_is_just_started_again(monkeypatch):
    """Distributed fails to close one."""
    from distributed import LocalCluster

    def end(number: int) -> None:
        os.kill(os.getpid(), 9)

    workers, close = [], LocalCluster.close

    def count_and_close(local, *arguments, **named):
        workers.append(len(local.scheduler.workers))
        return close(local, *arguments, **named)

    monkeypatch.setattr("emb_daemon.fleet.cluster._LIVES", 0)
    monkeypatch.setattr(LocalCluster, "close", count_and_close)
    with cluster(workers=2) as client:
        run(client, end, [1], failed=lambda item, reason: None)
    assert workers[0] == 2


@pytest.mark.parametrize("fault", [AssertionError, KeyError])
def test_a_worker_that_distributed_cannot_close_ends_no_work(monkeypatch, fault):
    """It dies while it is started again, or before its start was heard of. Of other faults nobody knows what they end."""
    from distributed import LocalCluster

    close = LocalCluster.close

    def closes(raised):
        def close_and_fail(local, *arguments, **named):
            close(local, *arguments, **named)
            raise raised

        monkeypatch.setattr(LocalCluster, "close", close_and_fail)
        with cluster(workers=1) as client:
            return client.submit(int, 5).result()

    assert closes(fault) == 5
    with pytest.raises(RuntimeError):
        closes(RuntimeError)


def test_without_workers_the_work_ends_with_a_message(monkeypatch):
    """All may die and none come back, on a cluster of others or on a machine that is too busy."""
    from distributed import Client, LocalCluster

    monkeypatch.setattr("emb_daemon.fleet.cluster._PATIENCE_S", 0.1)
    told = pytest.raises(Unavailable, match="no worker is left; run the same command again")
    with LocalCluster(n_workers=0, processes=False, dashboard_address=None) as local, Client(local) as client, told:
        run(client, abs, [1])


def test_without_its_scheduler_the_work_ends_with_a_message():
    from distributed import Client, LocalCluster

    local = LocalCluster(n_workers=0, processes=False, dashboard_address=None)
    closing = threading.Timer(0.5, local.close)
    with Client(local) as client, pytest.raises(Unavailable, match="the scheduler is gone; when it is back, run the same"):
        closing.start()
        run(client, abs, [1])
    closing.join()


def test_a_killed_client_is_resumed_to_the_same_bytes(tmp_path, logs, scheduler, calibration):
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
    assert main(["fleet", "replay", str(tmp_path / "resumed"), "--resume", "--scheduler", scheduler]) == 0
    assert _content(tmp_path / "resumed") == _content(tmp_path / "at_once")


def test_results_of_another_estimator_are_computed_anew(tmp_path, logs, calibration, monkeypatch):
    """Otherwise an update would look like a change of the fleet on its day."""
    _ingested(tmp_path, logs)
    unit = next(iter(dataset.by_unit(dataset.drives(tmp_path)).values()))
    replay_drive(tmp_path, unit[0], calibration)
    assert is_replayed(tmp_path, unit[0], dataset.made_by(calibration))
    other = moved(calibration, {"friction.offset_Nm": 1.1 * calibration.friction.offset_Nm})
    assert not is_replayed(tmp_path, unit[0], dataset.made_by(other))
    scores.score_unit(tmp_path, unit, calibration)
    path = scores.scores_path(tmp_path, unit[0].unit, unit[0].corner)
    assert any(scores.read_scores(path, calibration))
    monkeypatch.setattr(dataset, "_kernels", lambda: "another estimator")
    assert not is_replayed(tmp_path, unit[0], dataset.made_by(calibration))
    assert not any(scores.read_scores(path, calibration))
    before = path.read_bytes()
    scores.score_unit(tmp_path, unit, calibration)
    assert path.read_bytes() != before and any(scores.read_scores(path, calibration))


# -- statistics -------------------------------------------------------------------------------------------------------


def _fleet(rng):
    """Units of three batches with scatter that is large in some directions, and signatures of causes."""
    units, size, causes = 60, 6, 12
    spread = np.diag(10.0 ** rng.uniform(-1.0, 0.5, size))
    turn = np.linalg.qr(rng.standard_normal((size, size)))[0]
    values = rng.standard_normal((units, size)) @ spread @ turn
    signatures = rng.standard_normal((causes, size))
    batch = np.arange(units) % 3
    return values, signatures, {f"batch {n}": batch == n for n in range(3)}, {"batch": batch}


def _read(values, signatures, factors, noise=0.1, freedom=1000):
    centre = population.find_centres(values, factors)
    covariance = np.broadcast_to(noise**2 * np.eye(values.shape[1]), (len(values), *2 * values.shape[1:]))
    return centre, population.Readings(values, centre, signatures, covariance, np.full(len(values), freedom))


def test_the_shared_cause_of_a_batch_is_found_with_its_size():
    for seed in range(5):
        values, signatures, groups, factors = _fleet(np.random.default_rng(seed))
        values[groups["batch 1"]] += 3.0 * signatures[4]
        values[groups["batch 2"]] -= 2.0 * signatures[7]
        found = population.find_shared_causes(values, groups, _read(values, signatures, factors)[1], against_others=True)
        assert {(one.where, one.cause) for one in found} == {("batch 1", 4), ("batch 2", 7)}
        for one in found:
            truth = 3.0 if one.cause == 4 else -2.0
            assert abs(one.amount - truth) < 5.0 * one.sigma


def test_the_misfit_of_a_wrong_shape_is_no_second_cause():
    """An effect whose shape lies between those that are tested leaves a rest that many units prove; another cause as large is
    named."""
    for seed in range(5):
        for second, named in ((0.2, {4}), (1.0, {4, 9})):
            values, signatures, groups, factors = _fleet(np.random.default_rng(seed))
            covariance = np.linalg.inv(_read(values, signatures, factors)[1].inverse)
            # As far from each other, and from others, as causes can be.
            signatures[[4, 9]] = 30.0 * np.linalg.cholesky(covariance).T[[0, 1]]
            values[groups["batch 1"]] += signatures[4] + second * signatures[9]
            found = population.find_shared_causes(values, groups, _read(values, signatures, factors)[1], against_others=True)
            assert {one.cause for one in found} == named and {one.where for one in found} == {"batch 1"}, (seed, second)


def test_a_healthy_fleet_has_no_findings():
    """60 fleets of healthy units: of all accusations one in a hundred fleets may be false, and of units one in a hundred."""
    batches = units = 0
    for seed in range(60):
        values, signatures, groups, factors = _fleet(np.random.default_rng(1000 + seed))
        centre, readings = _read(values, signatures, factors)
        batches += bool(population.find_shared_causes(values, groups, readings, against_others=True))
        units += bool(population.find_outliers(values - centre, readings))
    # Binomial, 0.1 %.
    assert batches <= 5 and units <= 5


def test_two_outlying_units_are_both_found():
    values, signatures, _, factors = _fleet(np.random.default_rng(3))
    values[10] += 12.0 * signatures[2]
    values[20] -= 12.0 * signatures[5]
    centre, readings = _read(values, signatures, factors)
    found = population.find_outliers(values - centre, readings)
    assert {(one.where, one.cause): one.amount for one in found} == pytest.approx({(10, 2): 12.0, (20, 5): -12.0}, rel=0.2)
    # Were its own drives as far apart, it would be none.
    centre, readings = _read(values, signatures, factors, noise=20.0)
    assert population.find_outliers(values - centre, readings) == []


def test_noise_estimated_from_few_drives_makes_no_outliers():
    """Healthy units that differ by their noise alone, each of which knows it from four drives: twenty of those whose drives
    scatter most lie far out, and as many of all seem sure of it. Known from a thousand drives, the same is an accusation."""
    rng, accused = np.random.default_rng(0), {3: 0, 1000: 0}
    for _ in range(20):
        _, signatures, _, factors = _fleet(rng)
        true = np.where(np.arange(60) % 3 == 0, 4.0, 1.0)
        values = true[:, None] * rng.standard_normal((60, 6))
        told = true**2 * rng.chisquare(3, 60) / 3.0
        centre = population.find_centres(values, factors)
        noise = told[:, None, None] * np.eye(6)
        for freedom in accused:
            readings = population.Readings(values, centre, signatures, noise, np.full(60, freedom))
            accused[freedom] += bool(population.find_outliers(values - centre, readings))
    assert accused[3] <= 1 and accused[1000] > 5, accused


def test_differences_too_small_to_confirm_are_not_reported(monkeypatch):
    """However sure it is: of a unit less than 36 N, of a batch, whose mean many units tell, less than 10 N."""
    own = object.__new__(findings._Study)
    own.keys, own.masks = [("a", "FL"), ("b", "FL")], {"batch A": np.ones(2, bool)}
    own.causes, own.directions = [SimpleNamespace(name="", key="", shape="", unit="")], SimpleNamespace(size_N=np.ones(1))
    found = [population.Difference(row, 0, size_N, 1.0, 1e-9, ()) for row, size_N in enumerate((-35.0, -37.0))]
    monkeypatch.setattr(findings, "find_outliers", lambda *_: found)
    assert [one.where for one in own._outliers(np.zeros(0), None, lambda _: "")] == ["b FL"]
    shared = [population.Difference("batch A", 0, size_N, 1.0, 1e-9, ()) for size_N in (9.0, -11.0)]
    assert [one.size_N for one in own._list_shared(shared, lambda _: "")] == [-11.0]


def test_random_effects_take_each_units_own_noise_out():
    rng = np.random.default_rng(0)
    sigmas = rng.uniform(0.5, 3.0, 4000)
    truth = rng.normal(10.0, 1.5, len(sigmas))
    found = population.estimate_random_effects(truth + sigmas * rng.standard_normal(len(sigmas)), sigmas)
    assert found.mean == pytest.approx(10.0, abs=5.0 * found.sigma)
    assert found.spread == pytest.approx(1.5, rel=0.1)


def test_units_that_differ_by_their_noise_alone_have_no_spread():
    found = population.estimate_random_effects(np.array([1.0, 1.1, 0.9]), np.full(3, 1.0))
    assert found.spread == 0.0


def _scores(rng, unit, amounts, count, warmth=None):
    """Synthetic drives of one unit, a day apart: each has information of its own, and ``amounts(drive)`` of the causes with
    noise. One unit of a cause makes 50 N."""
    result = []
    for number in range(count):
        table = 50.0 * rng.standard_normal((200, 4))
        residual = table @ amounts(number) + 20.0 * rng.standard_normal(200)
        table = np.column_stack([table, residual])
        drive = dataset.Drive(unit, "FL", "", number * 86_400_000_000_000, f"{number:016x}")
        result.append(scores.Score(drive, table.T @ table, 200, 20.0 if warmth is None else warmth[number]))
    return result


def test_the_stated_noise_of_a_unit_is_its_scatter():
    """However few drives it has; and its size is not drawn to zero."""
    rng, truth = np.random.default_rng(0), np.array([1.0, -2.0, 0.0, 0.5])
    flat = population.Directions(np.eye(4) / 50.0, np.eye(4) * 50.0, np.full(4, 50.0))
    units = []
    for _ in range(400):
        from_drive_to_drive = 0.3 * rng.standard_normal((4, 4))
        drives = _scores(rng, "u", lambda number, own=from_drive_to_drive: truth + own[number], 4)
        units.append(population.fit_unit(drives, flat, np.ones((4, 1)), [np.eye(4)]))
    values, noise = np.array([unit.values[0] for unit in units]), np.array([np.diag(unit.noise[0]) for unit in units])
    np.testing.assert_allclose(values.mean(axis=0) / 50.0, truth, atol=0.03)
    np.testing.assert_allclose(noise.mean(axis=0), values.var(axis=0), rtol=0.15)


def test_p_values_are_corrected_for_the_number_of_tests():
    """The same causes listed twice tell nothing new of anybody: each is its twin's rival."""
    values, signatures, groups, factors = _fleet(np.random.default_rng(3))
    values[10] += 12.0 * signatures[2]
    values[groups["batch 1"]] += 3.0 * signatures[4]
    chances, count = [], len(signatures)
    for causes, rivals in ((signatures, ((), ())), (np.concatenate([signatures, signatures]), ((2 + count,), (4 + count,)))):
        centre, readings = _read(values, causes, factors)
        [unit] = [one for one in population.find_outliers(values - centre, readings) if one.where == 10]
        batch = population.find_shared_causes(values, groups, readings, against_others=True)[0]
        chances.append((unit.chance, batch.chance))
        assert (unit.rivals, batch.rivals) == rivals
    np.testing.assert_allclose(chances[1], 2.0 * np.array(chances[0]), rtol=1e-6)
    assert min(chances[0]) > 0.0


def test_a_unit_is_measured_by_the_scatter_of_others():
    """By its own, it would excuse itself."""
    values, signatures, _, factors = _fleet(np.random.default_rng(4))
    centre, readings = _read(values, signatures, factors)
    values[7] += 3.0 * signatures[1]
    noise = np.broadcast_to(0.01 * np.eye(values.shape[1]), (len(values), *2 * values.shape[1:]))
    again = population.Readings(values, centre, signatures, noise, np.full(len(values), 1000))
    np.testing.assert_allclose(again.filters[7], readings.filters[7], rtol=1e-9)
    assert np.abs(again.filters[8] / readings.filters[8] - 1.0).max() > 1e-3


def test_few_healthy_units_are_ordinary():
    """Of normal ones 0.1 % may be left out, although the scatter in twenty directions is known from sixty units only."""
    rng, odd = np.random.default_rng(0), 0
    for count, size in ((40, 12), (60, 20)):
        noise = np.full((count, size, size), 0.5 * np.eye(size))
        for _ in range(25):
            units = rng.standard_normal((count, size))
            readings = population.Readings(units, np.zeros(size), np.eye(size), noise, np.full(count, 10))
            odd += int((~readings.ordinary).sum())
    # Of 2 500; binomial, 0.1 %.
    assert odd <= 8, odd


def test_a_small_batch_with_more_scatter_is_no_finding():
    rng = np.random.default_rng(0)
    chances = [population._compare(3.0 * rng.standard_normal(5), rng.standard_normal(55))[0] for _ in range(600)]
    # Binomial, 0.1 %; were both thought to scatter alike, it would be a third.
    assert np.mean(np.array(chances) < 0.05) < 0.05 + 3.1 * np.sqrt(0.05 * 0.95 / 600)


@pytest.mark.parametrize(("per_30_days", "per_10_K"), [(1.5, 0.0), (0.0, 0.8), (-1.0, -1.0), (0.0, 0.0)])
def test_drift_and_season_are_distinguished_with_their_sizes(per_30_days, per_10_K):
    """Of the first cause, in each unit somewhat differently; days and warmth are not the same."""
    rng = np.random.default_rng(1)
    fleet = {}
    for number in range(14):
        unit, own = f"unit-{number}", 1.0 + 0.1 * rng.standard_normal()
        warmth = 15.0 + 6.0 * rng.standard_normal(12)
        level = 0.05 * rng.standard_normal(4)

        def amounts(drive, level=level, own=own, warmth=warmth):
            moved = own * (per_30_days * drive / 30.0 + per_10_K * (warmth[drive] - 15.0) / 10.0)
            return level + np.array([moved, 0.0, 0.0, 0.0]) + 0.03 * rng.standard_normal(4)

        fleet[unit, "FL"] = _scores(rng, unit, amounts, 12, warmth=warmth)
    causes = [scores.Cause(f"effects.{name}", name, None, "1", False) for name in "abcd"]
    found = findings.find(fleet, causes, "", {}, {})
    for told, truth in ((found.drifts, per_30_days), (found.seasons, per_10_K)):
        assert [(one.where, one.cause) for one in told] == [("all units", "a")] * (truth != 0.0)
        for one in told:
            assert one.amount == pytest.approx(truth, rel=0.15) and abs(one.amount - truth) < 4.0 * one.sigma
            assert one.size_N == pytest.approx(50.0 * one.amount, rel=0.1)
    assert not found.groups and not found.outliers


@pytest.mark.parametrize("seed", [2, 3])
def test_a_misfit_is_no_season_where_a_cause_acts_by_temperature(seed):
    """The second cause is the first one times the temperature but for a tenth, and a fifth of a usual effect, alike in all
    drives, looks like this tenth: large amounts of both would cancel each other and leave it. The third cause has a season."""
    rng, fleet = np.random.default_rng(seed), {}
    for number in range(14):
        unit, drives = f"unit-{number}", []
        level, warmth = 0.05 * rng.standard_normal(4), 15.0 + 6.0 * rng.standard_normal(12)
        for day in range(12):
            table, own = 50.0 * rng.standard_normal((200, 4)), 50.0 * rng.standard_normal(200)
            change = (warmth[day] - 15.0) / 10.0
            table[:, 1] = change * table[:, 0] + 0.1 * own
            residual = table @ level + 0.2 * change * table[:, 2] + 0.2 * own + 20.0 * rng.standard_normal(200)
            table = np.column_stack([table, residual])
            drive = dataset.Drive(unit, "FL", "", day * 86_400_000_000_000, f"{day:016x}")
            drives.append(scores.Score(drive, table.T @ table, 200, warmth[day]))
        fleet[unit, "FL"] = drives
    causes = [scores.Cause(f"effects.{name}", name, None, "1", False) for name in "abcd"]
    [season] = findings.find(fleet, causes, "", {}, {}).seasons
    assert season.cause == "c" and season.amount == pytest.approx(0.2, rel=0.15)


def test_a_thermal_cause_has_a_season_only_in_a_batch():
    """The curvature of its own law; what it explains is nobody else's season either. It drifts like any other."""
    rng, fleet, factors = np.random.default_rng(5), {}, {}
    for number in range(16):
        unit, warmth = f"unit-{number}", 15.0 + 6.0 * rng.standard_normal(12)
        factors[unit] = {"batch": "AB"[number % 2]}
        level, in_batch = 0.05 * rng.standard_normal(4), 0.8 * (number % 2)

        def amounts(drive, level=level, in_batch=in_batch, warmth=warmth):
            season = np.array([0.8, 0.0, 0.5, in_batch]) * (warmth[drive] - 15.0) / 10.0
            return level + season + np.array([1.5, 0.0, 0.0, 0.0]) * drive / 30.0 + 0.03 * rng.standard_normal(4)

        fleet[unit, "FL"] = _scores(rng, unit, amounts, 12, warmth=warmth)
    causes = [scores.Cause(f"effects.{name}", name, None, "1", name in "ad") for name in "abcd"]
    found = findings.find(fleet, causes, "", factors, {})
    assert {(one.where, one.cause) for one in found.seasons} == {("all units", "c"), ("batch A", "d")}
    assert {(one.where, one.cause) for one in found.drifts} == {("all units", "a")}
    # Without temperature in it, the same is a season of all.
    for cause in ("a", "d"):
        plain = [scores.Cause(c.key, c.name, None, "1", c.thermal and c.name != cause) for c in causes]
        assert ("all units", cause) in {(o.where, o.cause) for o in findings.find(fleet, plain, "", factors, {}).seasons}


def test_a_season_that_a_thermal_misfit_explains_as_well_is_no_finding():
    """The first cause makes nearly the second one's force, so a misfit of the model's heat may look like either."""
    rng, fleet = np.random.default_rng(8), {}
    for number in range(16):
        unit, drives = f"unit-{number}", []
        warmth = 15.0 + 6.0 * rng.standard_normal(12)
        for day in range(12):
            table = 50.0 * rng.standard_normal((200, 4))
            table[:, 1] = 0.98 * table[:, 0] + 0.2 * table[:, 1]
            amounts = np.array([0.0, 0.8, 0.5, 0.0]) * (warmth[day] - 15.0) / 10.0 + 0.05 * rng.standard_normal(4)
            table = np.column_stack([table, table @ amounts + 20.0 * rng.standard_normal(200)])
            drive = dataset.Drive(unit, "FL", "", day * 86_400_000_000_000, f"{day:016x}")
            drives.append(scores.Score(drive, table.T @ table, 200, warmth[day]))
        fleet[unit, "FL"] = drives

    def seasons(thermal: str) -> set[str]:
        causes = [scores.Cause(f"effects.{name}", name, None, "1", name in thermal) for name in "abcd"]
        return {one.cause for one in findings.find(fleet, causes, "", {}, {}).seasons}

    assert seasons(thermal="") == {"b", "c"}
    assert seasons(thermal="a") == {"c"}


def test_causes_that_act_by_temperature_are_known(calibration):
    thermal = {cause.name for cause in scores.Scorer(calibration).causes if cause.thermal}
    assert thermal == {
        "disc_thermal_expansion",
        "torque_constant_fade",
        "thermal.softening.per_K",
        "thermal.softening.history_per_K",
    }


def test_a_slope_is_of_what_changes_within_units_wherever_they_are():
    """Units in the north and in the south, whose own temperature changes alike."""
    rng = np.random.default_rng(0)
    drives = [_scores(rng, f"unit-{number}", lambda drive: np.zeros(4), 12) for number in range(6)]
    flat = population.Directions(np.eye(4) / np.sqrt(200.0) / 50.0, np.eye(4), np.ones(4))
    warmth = [place + 0.3 * rng.standard_normal(12) for place in (-2.0, -2.0, 0.0, 0.0, 2.0, 2.0)]
    assert population.find_slope_directions(drives, flat, warmth).shape == (4, 4)


def test_a_cause_that_is_mostly_a_level_of_others_has_no_slope():
    signatures = np.array([[1.0, 0.0], [1.0, 1.0], [0.1, 1.0]])
    directions = population.Directions(np.eye(2), signatures, np.ones(3))
    np.testing.assert_array_equal(directions.signatures_in(np.array([[1.0], [0.0]])), [[1.0], [1.0], [0.0]])
    np.testing.assert_array_equal(directions.signatures_in(np.eye(2)), signatures)


# -- end to end -------------------------------------------------------------------------------------------------------


@pytest.mark.trial
def test_the_study_of_speed_prints_stages_and_what_a_second_worker_gains(logs, monkeypatch, capsys):
    """On a machine with one core the second gains nothing, and nothing is promised here."""
    for name, least in (("_SCALED_SAMPLES", 1), ("_TIMES", 1), ("_ADDITIONS", 100_000)):
        monkeypatch.setattr(fleet_speed, name, least)
    monkeypatch.setattr("sys.argv", ["fleet_speed", str(logs / "car0" / "drive.0.log.gz"), "2"])
    fleet_speed.main()
    title, *rows, _, replayed, projected, gain, memory = capsys.readouterr().out.splitlines()
    stages, formats = rows[:8], rows[9:]
    assert [row.split()[0] for row in formats] == [".log", ".blf", ".mf4"]
    assert all(float(cell) > 0.0 for row in formats for cell in row.split()[1:])
    assert title.split()[0] == "stage" and [row[:24].strip() for row in stages] == [
        "unpack", "parse", "check and decode", "estimate", "read columns", "project on all causes", "replay from the file",
        "replay from columns",
    ]  # fmt: skip
    assert all(float(cell) > 0.0 for row in stages for cell in row[24:].split())
    told = re.fullmatch(r"2 workers replay (\d+\.\d\d) times as fast as one, and add (\d+\.\d\d) times as fast", gain)
    assert told and all(float(gain) > 0.0 for gain in told.groups())
    for line, row in ((replayed, stages[-1]), (projected, stages[5])):
        core_hours, hours = map(float, re.search(r"(\d+\.\d) core-hours; a core-second is (\d+\.\d\d) h", line).groups())
        times = float(row.split()[-1])
        assert core_hours == pytest.approx(10_000 / times, rel=0.01, abs=0.06)
        assert hours == pytest.approx(times / 3600.0, abs=0.006)
    assert re.fullmatch(r"a worker takes [1-9]\d+ MiB at most", memory)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory, calibration):
    """Twelve units on three days, the half of which have 130 N of viscous friction; what was found of them."""
    root = tmp_path_factory.mktemp("fleet")
    secret = study.Secret("viscous_friction", 130.0, {"viscous_Nms_per_rad": 1e-4})
    units = {f"unit-{number:02d}": "AB"[number % 2] for number in range(12)}
    drawn = study.Fleet(5, 3, units, {"A": secret}, {}, study.Secret("viscous_friction", 0.0, {"viscous_Nms_per_rad": 0.0}))
    for unit in units:
        study.drive_unit(root, drawn, unit)
    for drives in dataset.by_unit(dataset.drives(root)).values():
        assert scores.score_unit(root, drives, calibration) == {}
    factors = {unit: {"batch": batch} for unit, batch in units.items()}
    found = findings.find(scores.read_fleet(root, calibration), scores.Scorer(calibration).causes, "", factors, {})
    findings.save(found, root)
    return root, found


def test_the_shared_cause_of_a_batch_is_found_without_a_force_sensor(fleet):
    _, found = fleet
    [one] = found.groups
    # Of the two halves either may be called the one that is apart.
    assert one.cause == "viscous_friction" and one.where in ("batch A", "batch B")
    assert 65.0 < one.size_N * (1.0 if one.where == "batch A" else -1.0) < 195.0
    assert not found.outliers and not found.ageing
    assert len(found.units) == 12 and found.drives == 36


def test_front_and_rear_differ_by_design(fleet, calibration):
    """What a batch has would be reported; the same difference between corners is none."""
    known = scores.read_fleet(fleet[0], calibration)
    corners = {(unit, ("FL", "RR")[number % 2]): known[unit, corner] for number, (unit, corner) in enumerate(sorted(known))}
    found = findings.find(corners, scores.Scorer(calibration).causes, "", {}, {})
    assert fleet[1].groups and not found.groups and not found.outliers


def test_the_report_is_one_file_with_the_findings(fleet, tmp_path):
    root, found = fleet
    assert main(["fleet", "report", str(root), "--output", str(tmp_path / "fleet.html")]) == 0
    page = (tmp_path / "fleet.html").read_text()
    assert "1 batch shares a cause" in page and "viscous friction" in page and found.groups[0].action in page
    assert findings.load(root) == found


def test_stored_scores_are_kept_and_only_new_drives_are_scored(fleet, calibration, monkeypatch):
    root, _ = fleet
    drives = next(iter(dataset.by_unit(dataset.drives(root)).values()))
    path = scores.scores_path(root, drives[0].unit, drives[0].corner)
    before, asked = path.read_bytes(), []
    score = scores.Scorer.score
    monkeypatch.setattr(scores.Scorer, "score", lambda self, log, drive: asked.append(drive) or score(self, log, drive))
    scores.score_unit(root, drives, calibration)
    assert not asked
    scores.score_unit(root, drives[:2], calibration)
    scores.score_unit(root, drives, calibration)
    assert asked == drives[2:] and path.read_bytes() == before
    gone = replace(drives[0], digest="f" * 16)
    assert list(scores.score_unit(root, [*drives, gone], calibration)) == [gone.digest]
    assert not scores.score_unit(root, drives, calibration), "why a drive that is gone said nothing"


def test_an_unusable_drive_is_listed_with_its_reason(fleet, calibration):
    root, _ = fleet
    drive = dataset.drives(root)[0]
    log, _ = dataset.read_drive(root, drive)
    still = replace(log, samples=log.samples[:100], time_ns=log.time_ns[:100])
    with pytest.raises(InputError, match=r"the pads never touch|no brake application"):
        scores.Scorer(calibration).score(still, drive)


def test_a_drive_is_scored_without_cutting_it_into_episodes(fleet, calibration, monkeypatch):
    """The whole step would be run once more."""
    drive = dataset.drives(fleet[0])[0]
    monkeypatch.setattr(residuals, "make_trial", lambda *_: pytest.fail("it was cut"))
    assert scores.Scorer(calibration).score(dataset.read_drive(fleet[0], drive)[0], drive).loaded > 0


def test_a_training_is_learned_once(tmp_path, calibration, monkeypatch):
    plant = plant_from_calibration(calibration, 3)
    frames, _ = simulate_log(plant, sc.rest(1.0) + training(plant, 26.0) + sc.park(9e3, 6.0), seed=1, reference=False)
    drives = ingest_frames(tmp_path, frames, "unit", "0" * 16, "simulated")
    told = learning.learn_unit(tmp_path, drives, calibration)
    [entry] = told["entries"]
    assert told["trainings"] == 1 and entry["outcome"] == "accepted"
    assert entry["values"]["friction.load_m_per_rad"] == pytest.approx(plant["load_friction"], rel=0.1)
    assert learning.learn_unit(tmp_path, drives, calibration) == told
    assert learning.learn_unit(tmp_path, drives * 2, calibration)["drives"] == told["drives"] * 2
    assert learning.population(tmp_path, calibration)
    monkeypatch.setattr(dataset, "_kernels", lambda: "another estimator")
    assert not learning.population(tmp_path, calibration)
    assert learning.learn_unit(tmp_path, drives, calibration)["made_by"] != told["made_by"]


def test_a_prior_is_as_wide_as_units_differ(tmp_path, calibration):
    rng = np.random.default_rng(0)
    friction = calibration.friction.load_m_per_rad
    values = {"friction.offset_Nm": 0.03, "friction.presliding_angle_rad": 0.03, "contact.clearance_rad": 7.5}
    for unit in range(40):
        own = values | {
            "friction.load_m_per_rad": friction * (1.1 + 0.05 * rng.standard_normal()),
            "contact.clearance_rad": 7.5 + 0.2 * rng.standard_normal(),
        }
        # What was learned before counts no more, and what was refused never did.
        before = {key: 3.0 * value for key, value in own.items()}
        entries = [{"values": v, "sigmas": dict.fromkeys(v, 1e-9), "outcome": ""} for v in (before, own, {})]
        path = learning.learned_path(tmp_path, f"unit-{unit}", "FL")
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"made_by": dataset.made_by(calibration), "entries": entries}))
    save_calibration(calibration, tmp_path / "old.yaml")
    command = ["fleet", "prior", str(tmp_path), "--calibration", str(tmp_path / "old.yaml"), "--output"]
    assert main([*command, str(tmp_path / "new.yaml")]) == 0
    made = load_calibration(tmp_path / "new.yaml")
    assert made.friction.load_m_per_rad == pytest.approx(1.1 * friction, rel=0.03)
    assert made.provenance.sigmas["friction.load_m_per_rad"] == pytest.approx(0.05 * friction, rel=0.4)
    # Four such widths of the friction at full force, a fifth of which is the offset's.
    assert 0.1 < made.adaptation.friction_change < 0.3
    assert made.contact.clearance_rad == pytest.approx(7.5, abs=0.1)
    assert made.contact.clearance_sigma_rad == pytest.approx(0.2, rel=0.4)
    assert made.adaptation.clearance_change_rad == pytest.approx(4.0 * made.contact.clearance_sigma_rad)


def test_without_trainings_there_is_no_prior(tmp_path, calibration):
    with pytest.raises(InputError, match="fleet learn"):
        learning.prior(tmp_path, calibration)


@pytest.mark.parametrize("text", ["", "unit\na\n", "car,batch\na,b\n", "unit,batch\na,b\na,c\n", "unit,batch\na\n"])
def test_a_malformed_table_of_units_is_refused(tmp_path, text):
    (tmp_path / "units.csv").write_text(text)
    with pytest.raises(InputError, match=r"units\.csv"):
        findings.read_units(tmp_path / "units.csv")


def test_a_missing_table_of_units_is_named_once(tmp_path):
    with pytest.raises(InputError, match=r"^\S*/units\.csv: No such file or directory$"):
        findings.read_units(tmp_path / "units.csv")
