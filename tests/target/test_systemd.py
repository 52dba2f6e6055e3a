"""The service as systemd runs it: the real unit file, a real vcan0, the installed wheel.

Every bound on time is for User-Mode Linux on a shared machine, where a system call costs 10 to 30 µs and another guest
may hold the CPU: it says "soon", it measures nothing. Measured times are printed (pytest -rP, or the XML report).
"""

from __future__ import annotations

import contextlib
import gzip
import itertools
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bus_tools import CHANNEL, CLAMP_FORCE, RESOLVER, RIG, Recording, answers, assert_same, playing, replayed, wait_for, waits
from machine import BEFORE_ANOTHER
from service_tools import (
    FORCES,
    PERIOD_S,
    UNIT,
    active,
    exposure,
    journal,
    journal_cursor,
    journal_since,
    main_pid,
    prop,
    systemctl,
    wait_for_forces,
)

pytestmark = pytest.mark.target("systemd")

CONFIG = Path("/etc/emb_daemon/emb.yaml")
CACHE, STATE = Path("/var/cache/emb_daemon"), Path("/var/lib/emb_daemon")
LOG = RIG / "static" / "random_6p5mm.log.gz"
CURRENT = 0x110
STATUS = 0x220  # EMB_c_EstimatorStatus of the first corner
DEADLINE_MISSED = 0x2000
# Of broadcasts. The loop counts from wake to wake, and one that is held up between the two says so at the next.
CLEARLY_MISSED_S = 4 * PERIOD_S
STATUS_WITHIN_S = 0.3  # it comes every 0.1 s
PAIRING_S = 0.002
WATCHDOG_S = 2.0  # of the shipped unit
PLAYED_S = 14.998  # whole cycles

COLD_START_S = 780  # all kernels compiled: 290 to 410 s seen, by what other guests left of the CPU
WARM_START_S = 120  # 12 to 17 s seen, and 20 to 51 where other programs took the CPU
MAXIMAL_EXPOSURE = 1.1


def wait_for_another(pid: int) -> float:
    """Until systemd has started another process and that has said that it is ready; how long it took."""

    def ready() -> bool:
        # One call, seldom: each costs the machine's only CPU 50 ms that the starting service could use.
        state = dict(p.split("=", 1) for p in systemctl("show", UNIT, "--property=MainPID,ActiveState").splitlines())
        return state["ActiveState"] == "active" and int(state["MainPID"]) not in (0, pid)

    return wait_for("another process is ready", ready, WARM_START_S, poll_s=0.5)


@pytest.fixture(scope="module", autouse=True)
def started() -> None:
    """The unit is enabled: it started with the machine. At the first start not all kernels are in its cache, or none."""
    took = wait_for(f"{UNIT} is active", active, COLD_START_S, poll_s=0.25)
    print(f"active {took:.1f} s after the tests began")


@pytest.fixture
def service(request: pytest.FixtureRequest) -> None:
    """Each test finds the service running, however the one before left it."""

    def start() -> None:
        if not active():
            systemctl("reset-failed", UNIT, check=False)
            systemctl("start", UNIT)

    start()
    request.node.stash[BEFORE_ANOTHER] = start


@pytest.fixture
def inputs(service: None, rig_log: Path) -> Iterator[None]:
    """A vehicle on the bus, for as long as the test lasts."""
    with playing(rig_log, "-l", "i"):
        yield


@pytest.fixture
def patient() -> Iterator[None]:
    """A watchdog that a machine held up for some seconds does not wake: what was answered before it is lost."""
    drop_in = Path(f"/run/systemd/system/{UNIT}.d/patient.conf")
    drop_in.parent.mkdir(parents=True, exist_ok=True)
    drop_in.write_text("[Service]\nWatchdogSec=30\n")
    systemctl("daemon-reload")
    yield
    drop_in.unlink()
    systemctl("daemon-reload")
    systemctl("restart", UNIT)


# --- it starts, and as whom ------------------------------------------------------------------------------------------


def test_it_started_with_the_machine_and_at_once() -> None:
    assert prop("UnitFileState") == "enabled"
    assert prop("NRestarts") == "0", "it took more than one attempt"
    assert prop("Type") == "notify"


def test_it_is_unprivileged(service: None) -> None:
    lines = Path("/proc", str(main_pid()), "status").read_text().splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert "0" not in status["Uid"].split() + status["Gid"].split()
    for capabilities in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"):
        assert int(status[capabilities], 16) == 0, capabilities
    assert status["NoNewPrivs"] == "1"
    assert status["Seccomp"] == "2"


def test_its_loop_and_nothing_else_is_real_time(service: None) -> None:
    threads = [int(p.name) for p in Path("/proc", str(main_pid()), "task").iterdir()]
    real_time = [thread for thread in threads if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO]
    assert len(real_time) == 1
    locked = re.search(r"VmLck:\s+(\d+)", Path("/proc", str(main_pid()), "status").read_text())
    assert locked is not None and int(locked[1]) > 0, "its memory is not locked"


def test_exposure_is_low() -> None:
    assert exposure() <= MAXIMAL_EXPOSURE


def test_unit_has_no_fault_that_systemd_knows() -> None:
    command = ["systemd-analyze", "verify", "--man=no", UNIT]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_compiled_kernels_are_kept(service: None) -> None:
    """This one at least: `.ci/target` brings none of it."""
    assert list(CACHE.rglob("daemon._scan-*.nbc")), f"nothing compiled under {CACHE}"
    assert CACHE.stat().st_uid == Path("/proc", str(main_pid())).stat().st_uid


# --- it works --------------------------------------------------------------------------------------------------------


def test_forces_come_250_times_a_second(inputs: None, record: Callable[..., Recording]) -> None:
    wait_for_forces(record, timeout_s=WARM_START_S)
    with record(f"{FORCES},{STATUS:X}:7FC,{RESOLVER:X}:7FF") as recording:
        time.sleep(10)
    end_s = recording.frames[-1].time_s
    heard = sum(frame.can_id == RESOLVER for frame in recording.frames)
    answered = len(answers(recording.frames))
    print(f"{answered} answers to {heard} resolver samples in {end_s - recording.frames[0].time_s:.2f} s")
    assert heard > 0.9 * 10 / PERIOD_S
    assert abs(answered - heard) <= 2, "of the samples at the edges of the recording, one half may be outside"
    # A corner without input says so once a tick. How many ticks come late is the machine's affair; that fewer are met than
    # missed is not well by the daemon's own judgement, and every clear delay is to be said.
    said = [f.time_s for f in recording.frames if f.can_id == STATUS + 1 and f.data[6] + (f.data[7] << 8) & DEADLINE_MISSED]
    for corner in range(1, 4):
        times = [f.time_s for f in recording.frames if f.can_id == CLAMP_FORCE + corner]
        mean = (times[-1] - times[0]) / (len(times) - 1)
        late = sum(b - a > 1.5 * PERIOD_S for a, b in itertools.pairwise(times)) / len(times)
        print(f"corner {corner}: mean period {mean * 1e3:.4f} ms, {late:.2%} of the gaps above {1.5 * PERIOD_S * 1e3:.0f} ms")
        assert PERIOD_S * 0.98 < mean < 2.0 * PERIOD_S
        for before, after in itertools.pairwise(times):
            if after - before > CLEARLY_MISSED_S and after + STATUS_WITHIN_S < end_s:
                assert any(after <= time_s <= after + STATUS_WITHIN_S for time_s in said), (
                    f"nothing at {before}, and no word of it"
                )


def test_a_reload_changes_nothing_else(patient: None, service: None, record: Callable[..., Recording], rig_log: Path) -> None:
    """Files are read by another process, so that the loop answers every sample meanwhile."""
    systemctl("restart", UNIT)
    before, cursor = (main_pid(), prop("NRestarts")), journal_cursor()
    # Once: where a log begins again the senders' counters jump, and for a second no sample is accepted.
    with playing(rig_log):
        wait_for_forces(record, timeout_s=WARM_START_S)
        with record(f",{CLAMP_FORCE:X}:7FF,{RESOLVER:X}:7FF") as recording:
            time.sleep(1)
            systemctl("reload", UNIT)
            took = wait_for("the files are read", lambda: "unchanged" in journal_since(cursor), WARM_START_S, poll_s=0.5)
            time.sleep(1)
            # A daemon that the machine holds up just then has answers still to give.
            wait_for("answers to what was heard", lambda: recording.is_answered(but=2), timeout_s=60, poll_s=0.5)
    assert (main_pid(), prop("NRestarts")) == before
    wait_for("the reload has ended", active, timeout_s=WARM_START_S)
    heard, answered = sum(frame.can_id == RESOLVER for frame in recording.frames), len(answers(recording.frames))
    print(f"read within {took:.1f} s; {answered} answers to {heard} resolver samples")
    assert heard > 0.9 * 2 / PERIOD_S
    assert abs(answered - heard) <= 2, "of the samples at the edges of the recording, one half may be outside"
    # What the shipped watchdog would not have borne. Of a machine that stands still, only a sample that is under way waits.
    assert sum(wait_s > WATCHDOG_S for wait_s in waits(recording.frames)) <= 2


# --- it comes back ---------------------------------------------------------------------------------------------------


def test_killed_it_is_back_and_broadcasting(inputs: None, record: Callable[..., Recording]) -> None:
    wait_for_forces(record, timeout_s=WARM_START_S)
    pid = main_pid()
    os.kill(pid, signal.SIGKILL)
    took = wait_for_another(pid)
    wait_for_forces(record, timeout_s=WARM_START_S)
    print(f"ready again {took:.1f} s after SIGKILL")


def test_stopped_from_ticking_the_watchdog_restarts_it(inputs: None, record: Callable[..., Recording]) -> None:
    wait_for_forces(record, timeout_s=WARM_START_S)
    pid, cursor = main_pid(), journal_cursor()
    os.kill(pid, signal.SIGSTOP)
    try:
        took = wait_for_another(pid)
    finally:
        # If nobody ended it, the tests that follow are to find it running.
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    wait_for_forces(record, timeout_s=WARM_START_S)
    assert "Watchdog timeout" in journal_since(cursor)
    print(f"ready again {took:.1f} s after SIGSTOP")


def test_interface_down_and_up(inputs: None, record: Callable[..., Recording], rig_log: Path) -> None:
    wait_for_forces(record, timeout_s=WARM_START_S)
    subprocess.run(["ip", "link", "set", CHANNEL, "down"], check=True)
    time.sleep(1)
    subprocess.run(["ip", "link", "set", CHANNEL, "up"], check=True)
    with playing(rig_log, "-l", "i"):  # the first player does not survive that
        took = wait_for_forces(record, timeout_s=WARM_START_S)
    print(f"broadcasting {took:.1f} s after the interface was up again")


# --- it ends ---------------------------------------------------------------------------------------------------------


def test_stop_is_clean(inputs: None, record: Callable[..., Recording]) -> None:
    wait_for_forces(record, timeout_s=WARM_START_S)
    start = time.monotonic()
    systemctl("stop", UNIT)
    print(f"stopped in {time.monotonic() - start:.2f} s")
    # By itself: after its TimeoutStopSec it would have been killed, and the result would say so.
    assert (prop("Result"), prop("ExecMainCode"), prop("ExecMainStatus")) == ("success", "1", "0")
    with record(FORCES) as recording:
        time.sleep(0.5)
    assert not recording.frames


def test_unusable_configuration_is_not_retried() -> None:
    good = CONFIG.read_text()
    CONFIG.write_text("no_such_key: [\n")
    try:
        systemctl("restart", UNIT, check=False)
        wait_for("the unit gives up", lambda: prop("ActiveState") == "failed", WARM_START_S)
        assert prop("ExecMainStatus") == "2"
        time.sleep(1)
        assert prop("ActiveState") == "failed"
    finally:
        CONFIG.write_text(good)
        systemctl("reset-failed", UNIT)


# --- it says what replay says ----------------------------------------------------------------------------------------


def test_live_payloads_equal_replayed_ones(record: Callable[..., Recording], tmp_path: Path, patient: None) -> None:
    """Every resolver sample on the bus is answered by the payload that replay gives it: replay of the log that was played
    and, with whatever delays the machine added, of the bus as it was recorded."""
    played = tmp_path / "random_6p5mm.log"
    lines = gzip.decompress(LOG.read_bytes()).decode().splitlines(keepends=True)
    begin, *_ = stamps = [float(line[1 : line.index(")")]) for line in lines]
    played.write_text("".join(itertools.compress(lines, (stamp < begin + PLAYED_S for stamp in stamps))))
    # Replay starts from the calibration, and so is the daemon to.
    systemctl("stop", UNIT)
    for snapshot in STATE.glob("restart-*.json"):
        snapshot.unlink()
    systemctl("start", UNIT)
    pid = main_pid()
    with record(",200:7FF,100:700") as recording:
        time.sleep(1)
        with playing(played) as player:
            wait_for("the log is played", lambda: player.poll() is not None, timeout_s=90, poll_s=0.5)
        wait_for("answers to all", recording.is_answered, timeout_s=60, poll_s=0.5)
    assert main_pid() == pid, "the service was ended meanwhile"
    heard = tmp_path / "heard.log"
    inputs = [line for line in recording.path.read_text().splitlines() if line.split()[2].startswith("1")]
    heard.write_text("\n".join([*inputs, ""]))
    # With the daemon's own compiled code: compiling anew beside it takes minutes in a guest with one CPU.
    code = {"NUMBA_CACHE_DIR": str(CACHE / "numba")}
    live, as_heard, as_played = answers(recording.frames), replayed(heard, code), replayed(played, code)
    samples = [frame.time_s for frame in recording.frames if frame.can_id == RESOLVER]
    currents = [frame.time_s for frame in recording.frames if frame.can_id == CURRENT]
    held_up = sum(current - sample > PAIRING_S for sample, current in zip(samples, currents, strict=True))
    equal = [sum(a == b for a, b in zip(live, other, strict=False)) for other in (as_heard, as_played)]
    late_s = [sample - PERIOD_S * number for number, sample in enumerate(samples)]
    aged = sum(late - min(late_s) > PERIOD_S / 2 for late in late_s)
    print(f"{len(samples)} resolver samples on the bus, {len(live)} answered, {aged} of them late")
    print(f"{held_up} currents too late for their sample")
    print(f"{equal[0]} payloads equal replay's of the bus as recorded, {equal[1]} replay's of the log")
    assert len(live) == len(samples) == len(as_heard) == len(as_played) > 3700
    assert_same(live, as_heard)
    # A sample that was held up is older, and one whose current was is answered without it.
    assert live == as_played or aged or held_up


# --- the interface before it -----------------------------------------------------------------------------------------


def test_networkd_and_udev_take_the_files_for_can0(service: None) -> None:
    """With a vcan named can0: bit rates cannot be set on it, but all else of the two files can be seen to work."""
    cursor = journal_cursor()
    subprocess.run(["ip", "link", "add", "can0", "type", "vcan"], check=True)
    try:
        wait_for("networkd brings can0 up", lambda: "UP" in flags("can0"), timeout_s=WARM_START_S)
        assert "80-can0.network" in journal_since(cursor)
        faults = [line for line in journal().splitlines() if re.search(r"80-can0\.\w+:\d+", line)]
        assert not faults, "a key or a value was not understood"
        assert int(Path("/sys/class/net/can0/tx_queue_len").read_text()) == 64
    finally:
        subprocess.run(["ip", "link", "delete", "can0"], check=True)


def flags(link: str) -> str:
    command = ["ip", "-brief", "link", "show", link]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
