"""A reload gives what a restart gives, whatever changed; signals in any number and at any moment do no harm."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import adaptkit
import numpy as np
import pytest
from adaptkit import parked

from emb_daemon.adapt import records as r
from emb_daemon.adapt.memory import Memory
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import calibration_hash, load_calibration, save_calibration
from emb_daemon.calibration.parameters import keys, moved, parameter
from emb_daemon.calibration.types import to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import ESTIMATE
from emb_daemon.offline import estimate
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, commands_of
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.runtime.pages import Page
from emb_daemon.runtime.rawcan import socket_pair
from emb_daemon.runtime.reading import Reader, read_calibrations
from emb_daemon.runtime.realtime import use_fifo

CONFIG = Path(__file__).parent.parent / "config"
SHIPPED = load_calibration(CONFIG / "calibration.yaml")
#: One value of the friction coefficient's table stands for its 288.
KEYS = [key for key in keys(SHIPPED) if "friction.coefficient" not in key or key.endswith("[1][2][3]")]


@pytest.fixture
def folder(tmp_path):
    for name in ("emb.yaml", "calibration.yaml"):
        shutil.copy(CONFIG / name, tmp_path)
    lines = (tmp_path / "emb.yaml").read_text().splitlines(keepends=True)
    (tmp_path / "emb.yaml").write_text("".join(line for line in lines if line.strip()[:3] not in ("FR:", "RL:", "RR:")))
    return tmp_path


@pytest.fixture
def daemon(folder):
    bus, theirs = socket_pair()
    made = Daemon(Setup(folder / "emb.yaml"), theirs, state=folder / "state")
    made._adaptation._threaded = False
    yield made
    bus.close()


@pytest.fixture(scope="module")
def drive():
    """Frames of half a second before and after a reload, simulated."""
    schedule = city_drive().first(6.0)
    car = Car(np.atleast_1d(plant_from_calibration(SHIPPED)), ("FL",), start_ns=1_000_000_000)
    frames, _ = car.run(commands_of(schedule, ("FL",)), schedule.drives)
    first = np.flatnonzero(frames["can_id"] == 0x100)
    return frames[first[500] : first[600]], frames[first[600] : first[1000]]


def reload_now(daemon):
    """Read the files again and go over to them, as the loop does from tick to tick."""
    daemon.reload()
    end_reload(daemon)


def end_reload(daemon):
    end = time.monotonic() + 20.0
    daemon._follow_reload()
    while daemon._reader is not None or daemon._waiting:
        assert time.monotonic() < end, "not read in time"
        time.sleep(0.001)
        daemon._follow_reload()


def another(key):
    """The shipped calibration with one number changed, or None where no other value is allowed alone."""
    now = parameter(SHIPPED, key)
    for value in (now.value + 20.0 * now.step, now.value - 20.0 * now.step, now.value + now.step, now.value - now.step):
        try:
            return moved(SHIPPED, {key: value}, checked=True)
        except InputError:
            continue
    return None


def test_reload_and_restart_give_the_same_estimates_for_every_key(daemon, drive):
    before, after = drive
    pipeline, names = daemon.pipeline, [name for name in ESTIMATE.names if name not in ("cycle", "elapsed_cycles")]
    pipeline.begin(int(before["time_ns"][0]))
    refused, length = [], int(after["time_ns"][-1] - before["time_ns"][0]) + 4_000_000
    for key in KEYS:
        calibration = another(key)
        if calibration is None:
            refused.append(key)
            continue
        before["time_ns"] += length
        after["time_ns"] += length
        pipeline.begin_anew(0, to_parameters(SHIPPED))
        daemon._adaptation.replace("FL", SHIPPED, daemon._adaptation.read("FL", SHIPPED))
        pipeline.consume(before)
        daemon._begin_anew("FL", calibration, daemon._adaptation.read("FL", calibration))
        _, count = pipeline.consume(after)
        reloaded, samples = pipeline.estimates[:count].copy(), pipeline.samples[:count].copy()
        restarted = estimate(samples, to_parameters(calibration))
        different = [name for name in names if reloaded[name].tobytes() != restarted[name].tobytes()]
        assert count > 300 and not different, key
    assert not refused, "no value but its own"


def learned_store(daemon, folder):
    """Let FL's adaptation accept a training, as the tick does."""
    adaptation = daemon._adaptation
    adaptation._stores[0] = adaptkit.accepted(adaptation._stores[0])
    adaptation._do(adaptation._write, "FL", r.ACCEPTED, "", adaptation._stores[0])
    adaptation.restore(daemon.pipeline.parameters)


def test_what_is_learned_while_a_reload_reads_is_kept(daemon, folder):
    """The calibration did not change: the corner goes on with what it has learned meanwhile, and so does the file, though the
    reader found nothing there yet."""
    has_read, go_on, read = threading.Event(), threading.Event(), daemon._read_calibrations
    daemon._read_calibrations = lambda: (read(), has_read.set(), go_on.wait(20.0))
    daemon.reload()
    daemon._follow_reload()
    assert has_read.wait(20.0)
    learned_store(daemon, folder)
    in_use = daemon.pipeline.parameters.copy()
    go_on.set()
    end_reload(daemon)
    assert in_use[0] != to_parameters(SHIPPED)
    assert daemon.pipeline.parameters.tobytes() == in_use.tobytes()
    learned_store(daemon, folder)
    assert len(Memory(folder / "state").read("FL").history) == 2


def test_a_corner_whose_calibration_did_not_change_goes_on(daemon, drive):
    daemon.pipeline.begin(int(drive[0]["time_ns"][0]))
    daemon.pipeline.consume(drive[0])
    state = daemon.pipeline.states[0].copy()
    reload_now(daemon)
    for name in ("started", "contact_angle", "covariance", "pads", "history"):
        assert np.array_equal(daemon.pipeline.states[0][name], state[name]), name


def test_of_a_training_that_a_reload_interrupts_nothing_is_used_or_written(tmp_path):
    """Its evaluation comes back after the calibration was replaced."""
    loop = adaptkit.ClosedLoop(tmp_path, pads_mm=6.0)
    jobs = []
    loop.adaptation._do = lambda job, *arguments: jobs.append((job, arguments))
    adapter = loop.adaptation.adapters[0]
    loop.run(parked(60.0), until=lambda e: adapter["phase"] == r.EVALUATING)
    other = moved(loop.calibration, {"contact.clearance_rad": 7.0})
    loop.adaptation.replace("FL", other, loop.adaptation.read("FL", other))
    loop.pipeline.begin_anew(0, to_parameters(other))
    # A training under the new calibration waits for its own evaluation when the old one arrives.
    adapter["phase"], adapter["generation"] = r.EVALUATING, adapter["generation"] + 1
    loop.adaptation._do = lambda job, *arguments: job(*arguments)
    for job, arguments in jobs:
        job(*arguments)
    pipeline = loop.pipeline
    loop.adaptation.answer(pipeline.samples, 0, pipeline.states, pipeline.parameters, pipeline.estimates)
    assert not adapter["evaluation_ready"]
    loop.run(parked(4.0))
    assert loop.parameters[0] == to_parameters(other)
    assert Memory(tmp_path).read("FL") is None


def test_a_bad_calibration_is_named_and_the_old_one_stays(daemon, folder, caplog):
    before = daemon.pipeline.parameters.copy()
    file = folder / "calibration.yaml"
    file.write_text(file.read_text().replace("format: 1", "format: 7"))
    reload_now(daemon)
    assert "the old one stays" in caplog.text and daemon.pipeline.parameters.tobytes() == before.tobytes()


def test_corners_are_not_changed_by_a_reload(daemon, folder, caplog):
    file = folder / "emb.yaml"
    file.write_text(file.read_text().replace("  FL:", "  FR: {calibration: calibration.yaml}\n  FL:"))
    save_calibration(moved(SHIPPED, {"contact.clearance_rad": 7.0}), folder / "calibration.yaml")
    before = daemon.pipeline.parameters.copy()
    reload_now(daemon)
    assert "corners: a reload cannot change them" in caplog.text
    assert daemon.pipeline.parameters.tobytes() == before.tobytes()


def test_the_last_of_quick_reloads_counts(daemon, folder):
    """Two requests while the first file is still being read: the second file is read after it, never beside it."""
    reading, go_on, read = [], threading.Event(), daemon._read_calibrations

    def slow():
        reading.append(len([thread for thread in threading.enumerate() if thread.name == "reload"]))
        go_on.wait(20.0)
        read()

    daemon._read_calibrations = slow
    for clearance in (7.0, 8.0):
        save_calibration(moved(SHIPPED, {"contact.clearance_rad": clearance}), folder / "calibration.yaml")
        daemon.reload()
        daemon._follow_reload()
    go_on.set()
    reload_now(daemon)
    assert daemon.pipeline.parameters[0]["clearance"] == 8.0 and reading[:2] == [1, 1]


def test_the_service_manager_gets_begin_and_end_of_a_reload(daemon, folder):
    """Of two quick ones the end is the end of both; a refused file ends one too."""
    said, real = [], daemon._read_calibrations
    daemon._manager.notify = lambda *assignments: said.append(assignments)
    go_on = threading.Event()
    daemon._read_calibrations = lambda: (go_on.wait(20.0), real())
    before_us = time.monotonic_ns() // 1000
    for _ in range(2):
        daemon.reload()
        daemon._follow_reload()
    go_on.set()
    reload_now(daemon)
    assert [words[0] for words in said[-2:]] == ["RELOADING=1", "READY=1"] and said.count(("READY=1",)) == 1
    assert before_us <= int(said[0][1].removeprefix("MONOTONIC_USEC=")) <= time.monotonic_ns() // 1000
    (folder / "calibration.yaml").write_text("[")
    reload_now(daemon)
    assert said[-1] == ("READY=1",) and said[-2][0] == "RELOADING=1"


def test_only_the_loop_changes_to_what_was_read(daemon, folder):
    """The reader ends between two looks of the loop at what waits: nothing changes under its hands."""
    save_calibration(moved(SHIPPED, {"contact.clearance_rad": 7.0}), folder / "calibration.yaml")
    waiting = daemon._waiting
    daemon._read_calibrations()
    assert daemon._waiting is waiting and not waiting


def test_a_storm_of_signals_stops_nothing(daemon):
    """A handler that waited for a lock would wait for the loop that it interrupts."""
    before = signal.signal(signal.SIGHUP, lambda *_: daemon.reload())
    stormy = True

    def storm():
        while stormy:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGHUP)

    thread = threading.Thread(target=storm, daemon=True)
    thread.start()
    try:
        for _ in range(2000):
            daemon._follow_reload()
    finally:
        stormy = False
        thread.join()
        signal.signal(signal.SIGHUP, before)
    reload_now(daemon)
    assert daemon.pipeline.parameters[0] == to_parameters(SHIPPED)


def test_what_waits_for_a_release_waits_for_what_is_being_read_too(daemon, folder):
    """The file is changed, and changed back while the brake is clamped: the change in between is not taken."""
    go_on, read, state = threading.Event(), daemon._files.read, daemon.pipeline.states[0]
    state["started"] = state["contact"]["engaged"] = True
    save_calibration(moved(SHIPPED, {"contact.clearance_rad": 7.0}), folder / "calibration.yaml")
    daemon.reload()
    daemon._follow_reload()
    daemon._reader.join()
    daemon._follow_reload()
    assert daemon._waiting
    daemon._files.read = lambda *arguments: (read(*arguments), go_on.wait(20.0))[0]
    save_calibration(SHIPPED, folder / "calibration.yaml")
    daemon.reload()
    daemon._follow_reload()
    state["contact"]["engaged"] = False
    daemon._follow_reload()
    go_on.set()
    end_reload(daemon)
    assert daemon.pipeline.parameters[0] == to_parameters(SHIPPED)


@pytest.fixture
def reader():
    made = Reader()
    made.begin()
    yield made
    made.close()


def test_what_a_child_reads_is_what_is_read_here(reader, folder):
    """Calibrations that differ from those in use, to the bit, and the same faults."""
    path, in_use = folder / "emb.yaml", {"FL": calibration_hash(SHIPPED)}
    assert reader.read(path, in_use) == read_calibrations(path, in_use, None) == {}
    key = "contact.clearance_rad"
    page = Page({"FL": {key: 7.1}}, in_use)
    assert reader.read(path, in_use, page) == read_calibrations(path, in_use, page) == {"FL": moved(SHIPPED, {key: 7.1})}
    save_calibration(moved(SHIPPED, {key: 7.0}), folder / "calibration.yaml")
    assert reader.read(path, in_use) == {"FL": moved(SHIPPED, {key: 7.0})}
    (folder / "calibration.yaml").write_text("format: [\n")
    said = []
    for read in (reader.read, read_calibrations):
        with pytest.raises(InputError) as refused:
            read(path, in_use, None)
        said.append(str(refused.value))
    assert said[0] == said[1] and "calibration.yaml" in said[0]


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
def test_a_signal_to_all_processes_of_that_name_does_not_end_the_one_that_reads(folder, monkeypatch, number):
    """At any time, the first moment of its life included."""
    fork, reader = os.fork, Reader()

    def fork_and_signal():
        if child := fork():
            return child
        os.kill(os.getpid(), number)
        return 0

    monkeypatch.setattr(os, "fork", fork_and_signal)
    reader.begin()
    os.kill(reader._child, number)
    assert reader.read(folder / "emb.yaml", {"FL": calibration_hash(SHIPPED)}) == {}
    assert number not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    reader.close()


def test_while_a_child_reads_the_loop_has_the_interpreter(reader, folder):
    """On a busy CPU a thread that reads would hold it for as long as others run, which is any time."""
    path, in_use = folder / "emb.yaml", {"FL": calibration_hash(SHIPPED)}

    def cpu_s(read):
        begun = time.process_time()
        assert read(path, in_use, None) == {}
        return time.process_time() - begun

    beside, here = ([cpu_s(read) for _ in range(5)] for read in (reader.read, read_calibrations))
    assert np.median(beside) < 0.1 * np.median(here)


def test_a_reader_that_is_gone_refuses_and_the_calibration_stays(reader, daemon, caplog):
    """It may have ended of the file, which this process does not read then."""
    daemon._files = reader
    os.kill(reader._child, signal.SIGKILL)
    reload_now(daemon)
    assert "the old one stays in use" in caplog.text and "restart the daemon" in caplog.text


def test_the_reader_ends_with_its_daemon():
    """However that ends: what is left would keep its files and the service's memory."""
    made = "import time; from emb_daemon.runtime.reading import Reader; made = Reader(); made.begin()"
    script = f"{made}; print(made._child, flush=True); time.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    end = time.monotonic() + 10.0
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        while Path("/proc", str(child), "stat").read_text().rpartition(")")[2].split()[0] != "Z":
            assert time.monotonic() < end, "the reader goes on"
            time.sleep(0.01)


def test_the_reader_thread_has_ordinary_scheduling():
    """A thread has the scheduler of the one that starts it: a long file would be read at the loop's own priority."""
    policies = []

    def loop():
        refused = use_fifo(1).startswith("ordinary")
        reader = threading.Thread(target=lambda: policies.append(None if refused else os.sched_getscheduler(0)))
        reader.start()
        reader.join()

    thread = threading.Thread(target=loop)
    thread.start()
    thread.join()
    if policies == [None]:
        pytest.skip("NOT RUN: SCHED_FIFO is not allowed here")
    assert policies == [os.SCHED_OTHER]
