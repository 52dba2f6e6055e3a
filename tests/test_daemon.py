"""The loop on a bus inside this process: what goes in comes out, whatever the machine does to it."""

import itertools
import os
import shutil
import socket
import threading
import time
from pathlib import Path

import numpy as np
import processkit
import pytest

from emb_daemon.adapt import files
from emb_daemon.adapt.snapshots import Snapshot
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import load_calibration, save_calibration
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, commands_of
from emb_daemon.runtime.daemon import Daemon, Pacer, _scan
from emb_daemon.runtime.rawcan import socket_pair
from emb_daemon.runtime.systemd import ServiceManager
from emb_daemon.wire import contract
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import ERROR, EXTENDED, FRAME
from emb_daemon.wire.layout import CORNER_MESSAGES, CORNERS, CURRENT, RESOLVER

CONFIG = Path(__file__).parent.parent / "config"
CLAMP_FORCE_FL = 0x200
FAULT, NOT_AVAILABLE = 2, 15


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    for name in ("emb.yaml", "calibration.yaml"):
        shutil.copy(CONFIG / name, tmp_path)
    return Setup(tmp_path / "emb.yaml")


@pytest.fixture(scope="module")
def drive() -> list[np.ndarray]:
    """Two seconds of the simulated car, one corner: the frames of each cycle."""
    plant = np.array([plant_from_calibration(load_calibration(CONFIG / "calibration.yaml"), 0)])
    schedule, start_ns = city_drive().first(2.0), 1_000_000_000
    frames, _ = Car(plant, ("FL",), start_ns=start_ns).run(commands_of(schedule, ("FL",)), schedule.drives)
    cycle = (frames["time_ns"] - start_ns) // CYCLE_NS
    return np.split(frames, np.flatnonzero(np.diff(cycle)) + 1)


class Running:
    """A daemon in a thread, and the other end of its bus."""

    def __init__(self, setup: Setup, manager: ServiceManager | None = None, state: Path | None = None):
        self.bus, theirs = socket_pair()
        self.daemon = Daemon(setup, theirs, manager, state)
        self.daemon.warm_up()
        self.heard: list[np.ndarray] = []
        self._thread = threading.Thread(target=self.daemon.run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.daemon.stop()
        self._thread.join(10)
        assert not self._thread.is_alive(), "the loop did not end"
        self.listen()
        self.bus.close()

    def send(self, frames: np.ndarray) -> np.ndarray:
        """Put frames on the bus; returns them as a log of the bus has them."""
        self.bus.send(frames)
        logged = frames.copy()
        logged["time_ns"] = self.bus._sent.raw["time_ns"][: len(frames)]
        return logged

    def listen(self) -> np.ndarray:
        self.heard.append(self.bus.drain().copy())
        return np.concatenate(self.heard)

    def wait_for(self, condition, seconds: float = 20.0) -> np.ndarray:
        """Until ``condition(all frames heard)``; generous, because the machine is shared."""
        end = time.monotonic() + seconds
        while not condition(frames := self.listen()):
            assert time.monotonic() < end, "not heard in time"
            time.sleep(0.002)
        return frames


def answers(frames: np.ndarray) -> np.ndarray:
    """Payloads of FL's clamp force frames that answer a resolver sample."""
    mine = frames[frames["can_id"] == CLAMP_FORCE_FL]
    source = (mine["data"] >> np.uint64(52)) & np.uint64(15)
    return mine["data"][source < contract.PREDICTED] >> np.uint64(16)


def status_of(frames: np.ndarray) -> set[int]:
    """Status values of FL's clamp force frames."""
    mine = frames["data"][frames["can_id"] == CLAMP_FORCE_FL]
    return set(((mine >> np.uint64(12)) & np.uint64(15)).tolist())


def test_every_sample_is_answered_as_replay_answers_the_log_of_the_bus(setup: Setup, drive, monkeypatch):
    """Whatever holds up senders and loop meanwhile, all payloads from the first sample on."""
    with Running(setup) as running:
        answer, calls, log = running.daemon.pipeline.answer, itertools.count(), []

        def held_up(count):
            time.sleep(0.03 if next(calls) % 100 == 99 else 0.0)
            answer(count)

        monkeypatch.setattr(running.daemon.pipeline, "answer", held_up)
        for cycle, frames in enumerate(drive):
            log.append(running.send(frames))
            running.listen()
            time.sleep(0.025 if cycle % 70 == 69 else 0.004)
        heard = running.wait_for(lambda frames: len(answers(frames)) >= len(drive))
    pipeline, log = Pipeline(setup.parameters.copy(), ("FL",)), np.concatenate(log)
    pipeline.begin(int(log["time_ns"][0]))
    _, count = pipeline.consume(log)
    np.testing.assert_array_equal(answers(heard), answers(pipeline.broadcast(count)))


def test_missing_inputs_are_reported_from_the_first_tick(setup: Setup):
    with Running(setup) as running:
        frames = running.wait_for(lambda frames: np.sum(frames["can_id"] == CLAMP_FORCE_FL) > 3)
    data = frames["data"][frames["can_id"] == CLAMP_FORCE_FL]
    assert status_of(frames) == {NOT_AVAILABLE}, "a force that nobody knows"
    assert set((data >> np.uint64(52)) & np.uint64(15)) == {contract.INVALID}


def test_a_good_calibration_is_taken_and_a_bad_one_is_not(setup: Setup, tmp_path: Path):
    file = tmp_path / "calibration.yaml"
    text = file.read_text()
    with Running(setup) as running:
        before = running.daemon.pipeline.parameters.copy()
        file.write_text(text.replace("format: 1", "format: 7"))
        running.daemon.reload()
        time.sleep(0.5)
        assert running.daemon.pipeline.parameters.tobytes() == before.tobytes()
        ticks = running.daemon.ticks
        file.write_text(text)
        calibration = load_calibration(file)
        thinner = type(calibration)(
            **{name: getattr(calibration, name) for name in calibration.__struct_fields__} | {"pad_thickness_mm": 9.0}
        )
        save_calibration(thinner, file)
        running.daemon.reload()
        end = time.monotonic() + 20
        while running.daemon.pipeline.parameters["curve"][0, 0] == before["curve"][0, 0]:
            assert time.monotonic() < end, "the new calibration was not taken"
            time.sleep(0.01)
        assert running.daemon.ticks > ticks, "the loop stood still meanwhile"


def test_the_service_manager_gets_ready_watchdog_and_stopping(setup: Setup, tmp_path: Path):
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        manager.settimeout(20)
        environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "200000", "WATCHDOG_PID": str(os.getpid())}
        with Running(setup, ServiceManager(environment)):
            assert manager.recv(4096).startswith(b"READY=1")
            assert manager.recv(4096) == b"WATCHDOG=1"
            assert manager.recv(4096) == b"WATCHDOG=1"
        manager.setblocking(False)
        messages = []
        while True:
            try:
                messages.append(manager.recv(4096))
            except BlockingIOError:
                break
        assert messages[-1] == b"STOPPING=1"


def test_after_a_withheld_ping_the_next_decision_comes_early(setup: Setup, monkeypatch):
    """A loop that only stalled is not ended for it: a quarter of the time to the next ping."""
    asked, manager = [], ServiceManager(environment={})
    manager.watchdog_s = 5.0
    monkeypatch.setattr(Daemon, "_ping", lambda _: asked.append(time.monotonic()) or len(asked) > 1)
    with Running(setup, manager) as running:
        running.wait_for(lambda _: len(asked) == 3)
    again, then = np.diff(asked)
    assert 0.4 < again < then


def test_the_service_manager_gets_the_state_repeatedly(setup: Setup, monkeypatch):
    monkeypatch.setattr("emb_daemon.runtime.daemon._STATUS_NS", 20_000_000)
    manager, told = ServiceManager(environment={}), []
    manager.notify = lambda *assignments: told.extend(assignments)
    with Running(setup, manager) as running:
        running.wait_for(lambda _: sum(" ticks, " in words for words in told) >= 3)
    assert told[1] == "STATUS=waiting for inputs" and told[2].startswith("STATUS=") and told[2].endswith("frames dropped")


def test_a_stop_stores_the_state_of_that_moment(setup: Setup, drive, tmp_path: Path):
    with Running(setup, state=tmp_path) as running:
        for frames in drive[:200]:
            running.send(frames)
            time.sleep(0.004)
        answered = running.wait_for(lambda frames: len(answers(frames)) >= 200)
        stopped_ns = time.time_ns()
    ended_ns = time.time_ns()
    kept = files.decode((tmp_path / "restart-FL.json").read_bytes(), Snapshot, 1)
    assert len(answered) and stopped_ns <= kept.time_ns <= ended_ns
    pipeline = running.daemon.pipeline
    assert kept.state["covariance"] == pipeline.states[0]["covariance"].tolist(), "of the last sample"


def test_an_estimate_that_is_no_number_is_a_fault_and_not_pinged(setup: Setup, drive):
    setup.parameters["relaxation_time"] = np.nan
    with Running(setup) as running:
        running.send(np.concatenate(drive[:50]))
        running.wait_for(lambda frames: FAULT in status_of(frames))
        assert not running.daemon._ping()


def test_frames_beyond_one_batch_are_all_sent_or_counted():
    near, far = socket_pair()
    frames = np.zeros(3000, FRAME)
    frames["can_id"], frames["length"] = 0x123, 8
    frames["data"] = np.arange(3000)
    near.send(frames)
    heard = np.concatenate([far.drain().copy() for _ in range(4)])
    assert len(heard) + near.unsent == 3000
    np.testing.assert_array_equal(heard["data"], frames["data"][: len(heard)])
    assert np.all(np.diff(heard["time_ns"]) >= 0)
    near.close()
    far.close()


class TestPacer:
    def test_without_inputs_it_ticks_freely(self):
        pacer = Pacer(0)
        assert pacer.next_wake(1) == CYCLE_NS

    def test_it_wakes_just_after_a_sample_is_due(self):
        pacer = Pacer(1_000_000)
        pacer.note_arrival(0, 1_000_000)
        assert 1_000_000 + CYCLE_NS < pacer.next_wake(1_000_001) < 1_000_000 + CYCLE_NS + 500_000

    @pytest.mark.parametrize(("second_ns", "together"), [(1_100_000, True), (3_000_000, False)])
    def test_samples_that_arrive_together_are_answered_together_and_no_others(self, second_ns, together):
        pacer = Pacer(1_000_000)
        pacer.note_arrival(0, 1_000_000)
        pacer.note_arrival(1, second_ns)
        wake = pacer.next_wake(second_ns + 1)
        assert wake >= second_ns + CYCLE_NS if together else wake < 2_000_000 + CYCLE_NS

    def test_a_lost_sample_does_not_stop_the_ticks(self):
        pacer = Pacer(0)
        pacer.note_arrival(0, 0)
        pacer.last_tick_ns = 9 * CYCLE_NS
        assert pacer.next_wake(9 * CYCLE_NS + 1) <= 10 * CYCLE_NS + 500_000

    def test_a_corner_four_cycles_late_is_not_waited_for(self):
        pacer = Pacer(0)
        pacer.note_arrival(0, 0)
        pacer.last_tick_ns = now = 4 * CYCLE_NS
        assert pacer.next_wake(now) < now and pacer.next_wake(now + 1) == 5 * CYCLE_NS


#: Arguments: configuration, frames, state folder. A second start goes on from what the first one left.
_COMPILES_NOTHING = """
import sys
from pathlib import Path

import numpy as np
from numba.core.dispatcher import Dispatcher

from emb_daemon.calibration.configuration import Setup
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.runtime.rawcan import socket_pair


def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("emb_daemon")]
    kernels = [kernel for module in modules for kernel in vars(module).values() if isinstance(kernel, Dispatcher)]
    return {(kernel.__module__, kernel.__name__, len(kernel.signatures)) for kernel in kernels}


frames = np.load(sys.argv[2])
for _ in range(2):
    daemon = Daemon(Setup(sys.argv[1]), socket_pair()[1], state=Path(sys.argv[3]))
    daemon.warm_up()
    before = compiled()
    daemon.pipeline.begin(int(frames["time_ns"][0]))
    start = 0
    while start < len(frames):
        start, count = daemon.pipeline.collect(frames, start)
        daemon.pipeline.answer(count)
        daemon.pipeline.broadcast(count)
    daemon._adaptation.close(daemon.pipeline.states, daemon.pipeline.parameters)
    assert Path(sys.argv[3], "restart-FL.json").exists(), "nothing was kept"
    assert compiled() == before, compiled() - before
"""


def test_nothing_is_compiled_once_the_loop_runs(setup: Setup, drive, tmp_path: Path):
    """A compiler in the real-time loop holds up everything for seconds, and on one CPU everybody else too."""
    np.save(tmp_path / "frames.npy", np.concatenate(drive))
    arguments = [setup.path, tmp_path / "frames.npy", tmp_path / "state"]
    (tmp_path / "state").mkdir()
    done = processkit.python("-c", _COMPILES_NOTHING, *arguments)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("late", "missed"), [(0.9, 0), (1.0, 1), (1.9, 1), (2.5, 2)])
def test_each_whole_period_that_a_tick_is_late_is_a_missed_one(setup: Setup, late, missed):
    daemon, pacer = Daemon(setup, socket_pair()[0]), Pacer(0)
    daemon._count(pacer.last_tick_ns + round((1.0 + late) * CYCLE_NS), pacer)
    assert (daemon.ticks, daemon.missed) == (1, missed)


def test_the_watchdog_of_another_process_is_ignored():
    for pid, timeout in ((None, 3.0), (os.getpid(), 3.0), (1, None)):
        environment = {"WATCHDOG_USEC": "3000000"} | ({} if pid is None else {"WATCHDOG_PID": str(pid)})
        assert ServiceManager(environment).watchdog_s == timeout
    assert ServiceManager({}).watchdog_s is None


def test_a_scan_returns_estimated_lost_and_changed_corners():
    """Of RL's and FR's sample and RR's prediction; a sample is complete with its later message."""
    pipeline = Pipeline(Setup(CONFIG / "emb.yaml").parameters, CORNERS)
    rows, states, times = pipeline.estimates[:3], pipeline.states, pipeline.receptions
    rows["corner"], rows["is_sample"], rows["mode"] = (2, 1, 3), (True, True, False), contract.RUNNING
    rows["reasons"], rows["facts"] = (0, contract.BUS_DISTURBED, contract.STUCK), (1, 2, 4)
    times["time_ns"] = np.arange(len(times)) * 1000
    times["time_ns"][CORNER_MESSAGES * 2 + CURRENT] = 900_000
    arrivals, reported, facts = np.full(4, 7), np.full(4, contract.RUNNING << 16), np.zeros(4, np.int64)
    assert _scan(rows, 3, states, times, arrivals, reported, facts) == (0b1110, 0, 0b1000)
    assert arrivals.tolist() == [0, 1000 * (CORNER_MESSAGES + max(RESOLVER, CURRENT)), 900_000, 0]
    assert facts.tolist() == [0, 2, 1, 4] and reported[3] == contract.RUNNING << 16 | contract.STUCK
    rows["source"] = contract.INVALID
    states[1]["alternatives"]["covariance"][2, 3, 3], states[2]["error"][4] = np.nan, np.inf
    assert _scan(rows, 3, states, times, arrivals, reported, facts) == (0b1110, 0b0110, 0)
    states[3]["nearer"]["odds"][5] = np.nan
    assert _scan(rows, 3, states, times, arrivals, reported, facts) == (0b1110, 0b1110, 0)


def test_a_bus_is_disturbed_for_a_second_by_lost_frames_and_error_frames_and_by_nothing_else(setup: Setup):
    daemon, frames, second = Daemon(setup, socket_pair()[0]), np.zeros(3, FRAME), 1_000_000_000
    frames["length"] = 8

    def disturbed(now_ns):
        daemon._watch_bus(frames, now_ns)
        return daemon.pipeline.disturbed.any()

    assert not disturbed(second)
    daemon._bus.dropped += 1
    assert disturbed(2 * second) and disturbed(3 * second - 1) and not disturbed(3 * second)
    frames["flags"][1] = ERROR
    assert disturbed(5 * second)
    frames["flags"][1] = EXTENDED
    assert not disturbed(7 * second)
    daemon._bus.unsent += 1
    assert disturbed(8 * second), "the bus took no frame of ours"


def test_the_watchdog_is_pinged_while_every_corner_is_estimated_and_most_ticks_are_met(setup: Setup, caplog):
    daemon = Daemon(setup, socket_pair()[0])

    def pinged(met, missed, estimated=0b1111):
        daemon.ticks, daemon.missed = daemon.ticks + met, daemon.missed + missed
        daemon._estimated |= estimated
        return daemon._ping()

    assert pinged(1, 1) and pinged(50, 50) and pinged(50, 49)
    # Half a minute of it: a restart would cost more than what ends by itself before.
    assert pinged(1000, 6000) and pinged(50, 450) and not pinged(20, 80) and "most of 7600 periods missed" in caplog.text
    assert pinged(60, 40) and pinged(1000, 6000), "it counts from the last time that most were met"
    assert pinged(100, 0)
    for corner, name in enumerate(CORNERS):
        assert not pinged(100, 0, 0b1111 ^ 1 << corner) and f"corner {name}: no estimate" in caplog.text
        daemon._lost = 1 << corner
        assert not pinged(100, 0) and f"corner {name}: the estimator's state is not a number" in caplog.text
        assert pinged(100, 0)


def test_the_notify_socket_may_be_abstract():
    """That begins with @ in the environment, and with a zero byte for the kernel (unix(7))."""
    name = f"emb-daemon-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{name}")
        ServiceManager({"NOTIFY_SOCKET": f"@{name}"}).notify("READY=1", "STATUS=here")
        assert manager.recv(4096) == b"READY=1\nSTATUS=here"


def test_a_service_manager_that_reads_nothing_holds_nothing_up():
    name = f"emb-daemon-test-deaf-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{name}")
        speaking = ServiceManager({"NOTIFY_SOCKET": f"@{name}"})
        # More than any queue of datagrams holds.
        thread = threading.Thread(target=lambda: [speaking.notify("WATCHDOG=1") for _ in range(5000)], daemon=True)
        thread.start()
        thread.join(20.0)
        assert not thread.is_alive()
