"""The monitor knows a daemon by its broadcasts: what was sent is shown, what is missing is counted."""

import json
import math
import threading
import time
from types import SimpleNamespace

import can
import cantools
import numpy as np
import pytest
import wirekit
from rich.console import Console

from emb_daemon.cli.main import main
from emb_daemon.demo import view
from emb_daemon.demo.recorder import Recorder
from emb_daemon.monitor.listener import HISTORY_S, SECOND_NS, Listener, broadcast_ids
from emb_daemon.monitor.view import render, sparkline, summary
from emb_daemon.plant.records import TRUTH
from emb_daemon.resources import resource
from emb_daemon.wire.contract import FUSED, PREDICTED, REASONS

S = SECOND_NS


def _force(
    cycle: int, force_kN: float = 5.0, status: int = 0, corner: str = "FL", counter: int | None = None, source: int = 1
):  # fmt: skip
    return wirekit.frame(
        f"EMB_{corner}_ClampForce", 100 * S + cycle * 4 * wirekit.MS, cycle % 15 if counter is None else counter, status,
        ClampForce=force_kN, ClampForceSigma=0.12, InputCounter=3, ForceSource=source, InputAge=8,
    )  # fmt: skip


def _receive(*frames) -> Listener:
    listener = Listener()
    listener.receive(np.concatenate(frames))
    return listener


def _text(listener, now_ns=101 * S, width=80, height=24) -> list[str]:
    console = Console(width=width, height=height, color_system=None, force_terminal=True)
    with console.capture() as capture:
        console.print(render(listener, now_ns, "can0", width, height))
    return capture.get().splitlines()


def test_the_broadcasts_of_all_corners_are_listened_to():
    """What authenticates them is for a receiver that has the key."""
    database = cantools.database.load_file(resource("dbc/emb.dbc"))
    sent = {message.name: message.frame_id for message in database.messages if "Estimator" in message.senders}
    shown = [can_id for name, can_id in sent.items() if not name.endswith(("Auth", "Freshness"))]
    assert len(shown) == 16 and sorted(broadcast_ids()) == sorted(shown)


def test_every_signal_reaches_the_state():
    listener = _receive(
        _force(0),
        wirekit.frame("EMB_FL_PadTemp", 100 * S, InnerSurfaceTemp=301.25, InnerMeanTemp=-12.5, OuterSurfaceTemp=290.0,
                      OuterMeanTemp=150.0),
        wirekit.frame("EMB_FL_EstimatorStatus", 100 * S, Mode=3, StiffnessFactor=0.912, ContactAngle=-73.1,
                      DegradedReasons=0b11),
        wirekit.frame("EMB_FL_AdaptRequest", 100 * S, Request=1, Progress=43, Result=0),
    )  # fmt: skip
    state = listener.corners[0].state(100 * S)
    assert (state["clamp_force_kN"], state["clamp_force_sigma_kN"], state["source"]) == (5.0, 0.12, "stiffness")
    assert (state["inner_surface_C"], state["inner_mean_C"], state["outer_mean_C"]) == (301.25, -12.5, 150.0)
    assert (state["mode"], state["stiffness_factor"], state["contact_angle_rad"]) == ("degraded", 0.912, -73.1)
    assert state["reasons"] == list(REASONS[:2])
    assert state["adaptation"] == {"request": "run", "progress_percent": 43, "result": "none"}
    shown = "\n".join(_text(listener, now_ns=100 * S + S // 10))
    for text in (
        "5.00 kN",
        "± 0.12",
        "stiffness",
        "degraded",
        "301/-12 °C",
        "resolver lost, current lost",
        "43 %",
        "8 ms old",
    ):
        assert text in shown


@pytest.mark.parametrize("status", [2, 15])
def test_a_value_that_is_not_to_be_used_is_not_shown(status):
    listener = _receive(_force(0, 7.77, status))
    assert listener.corners[0].state(100 * S)["clamp_force_kN"] is None
    assert "7.77" not in "\n".join(_text(listener))
    assert all(math.isnan(value) for value in listener.corners[0].forces_kN(102 * S))


@pytest.mark.parametrize("lost", [1, 7, 14, 15, 20, 100])
def test_lost_frames_are_counted_across_turns_of_the_counter(lost):
    corner = _receive(*[_force(c) for c in range(20)], *[_force(c) for c in range(20 + lost, 40 + lost)]).corners[0]
    assert (corner.missing, corner.damaged) == (lost, 0)


@pytest.mark.parametrize("catches_up", [True, False])
@pytest.mark.parametrize("stalled", [5, 8, 10.5, 14, 20, 100])
def test_a_sender_that_stands_still_has_lost_no_frames(stalled, catches_up):
    """Its counter goes on where it was, whether it makes up for the time or leaves it out."""
    frames = [_force(c) for c in range(60)]
    for cycle, frame in enumerate(frames[20:], 20):
        back = 20 + stalled
        late = max(back - cycle, 0) if catches_up else stalled
        frame["time_ns"] += np.int64(late * 4_000_000)
    corner = _receive(*frames).corners[0]
    assert (corner.missing, corner.damaged, corner.streams[0].received) == (0, 0, 60)


def test_a_damaged_or_repeated_frame_changes_nothing():
    bad = _force(1, 9.0)
    bad["data"] ^= np.uint64(1 << 20)
    corner = _receive(_force(0), bad, _force(0, 9.0, counter=0)).corners[0]
    assert (corner.state(100 * S)["clamp_force_kN"], corner.damaged, corner.missing) == (5.0, 2, 0)


def test_the_last_minute_keeps_its_peaks():
    """4 kN all the time but for one cycle of 18 kN 30 s ago."""
    listener = Listener()
    for second in range(70):
        for cycle in range(3):
            listener.receive(
                _force(250 * second + cycle, 18.0 if (second, cycle) == (39, 1) else 4.0, counter=(3 * second + cycle) % 15)
            )
    history = listener.corners[0].forces_kN(170 * S)
    assert len(history) == HISTORY_S and max(history) == 18.0 and history.count(18.0) == 1 and min(history) == 4.0
    line = sparkline(history, 20, 18.0)
    assert len(line) == 20 and line.count("█") == 1


def test_silence_is_shown():
    shown = "\n".join(_text(_receive(_force(0)), now_ns=107 * S))
    assert "SILENT for 7 s" in shown


@pytest.mark.parametrize("size", [(80, 24), (60, 12), (200, 60)])
def test_four_corners_at_their_worst_fit_the_screen(size):
    frames = []
    for corner in ("FL", "FR", "RL", "RR"):
        frames += [_force(0, 65.535, corner=corner)]
        frames += [
            wirekit.frame(f"EMB_{corner}_EstimatorStatus", 100 * S, Mode=3, ContactAngle=-3276.8, DegradedReasons=0xFFFF)
        ]
    lines = _text(_receive(*frames), width=size[0], height=size[1])
    assert len(lines) <= size[1] and max(map(len, lines)) <= size[0]
    assert "q quit" in lines[-1] and "space pause" in lines[-1] and "r reset" in lines[-1]
    if size[1] >= 24:
        assert all(any(line.startswith(corner) for line in lines) for corner in ("FL", "FR", "RL", "RR"))


def test_a_script_gets_json_from_a_bus(capsys):
    stop = threading.Event()

    def send():
        with can.Bus(interface="virtual", channel="monitor") as bus:
            cycle = 0
            while not stop.is_set():
                data = int(_force(cycle)[0]["data"]).to_bytes(8, "little")
                bus.send(can.Message(arbitration_id=0x200, data=data, is_extended_id=False))
                cycle += 1
                time.sleep(0.004)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        assert main(["monitor", "-i", "virtual", "-c", "monitor", "--once", "--json"]) == 0
    finally:
        stop.set()
        sender.join()
    corners = json.loads(capsys.readouterr().out)["corners"]
    assert list(corners) == ["FL"] and corners["FL"]["clamp_force_kN"] == 5.0 and corners["FL"]["forces_per_s"] > 0


def test_without_broadcasts_the_status_is_1_with_a_message(capsys, monkeypatch):
    monkeypatch.setattr("emb_daemon.monitor.terminal._WAIT_S", 0.2)
    assert main(["monitor", "-i", "virtual", "-c", "nobody", "--once"]) == 1
    error = capsys.readouterr().err
    assert "no broadcast of a daemon" in error and error.count("\n") == 1


def test_a_summary_names_the_reasons():
    status = wirekit.frame("EMB_FL_EstimatorStatus", 100 * S, Mode=3, DegradedReasons=1 << 8)
    assert summary(_receive(_force(0), status), 101 * S)[0].endswith("; signal stuck")


@pytest.mark.parametrize(("width", "height"), [(80, 24), (140, 30)])
def test_the_demo_is_the_monitor_with_the_truth_beside_it(width, height):
    """Four corners are whole on the smallest terminal; the daemon's log is shown where there is room."""
    recorder = Recorder(("FL", "FR", "RL", "RR"), 1.0)
    truth = np.zeros(4, TRUTH)
    truth["force"] = 23_456.0
    recorder.note_sent(100 * S, truth)
    for corner in recorder.corners:
        frames = (
            _force(0, 23.45, corner=corner),
            wirekit.frame(f"EMB_{corner}_PadTemp", 100 * S, InnerSurfaceTemp=512.0, InnerMeanTemp=345.0),
            wirekit.frame(f"EMB_{corner}_EstimatorStatus", 100 * S, Mode=3, DegradedReasons=1 << 8),
        )
        recorder.note_received(np.concatenate(frames))
    daemon, live = SimpleNamespace(ticks=10, missed=0), SimpleNamespace(late=0, lost=0)
    console = Console(width=width, height=height, color_system=None, force_terminal=True)
    with console.capture() as capture:
        console.print(view.render(recorder, daemon, live, ["info: ready"], width, height))
    lines = capture.get().splitlines()
    assert len(lines) <= height and all(len(line) <= width for line in lines)
    for name in recorder.corners:
        [first] = (row for row, line in enumerate(lines) if line.startswith(f"{name} "))
        assert "23.45 kN ± 0.12" in lines[first] and "degraded" in lines[first] and "512/345 °C" in lines[first + 1]
        assert "reference 23.46 kN" in lines[first + 2] and "signal stuck" in lines[first + 3]
    assert any("simulated truth" in line for line in lines) and ("info: ready" in lines) == (height > 24)


def test_an_estimate_of_a_sample_that_came_late_is_an_answer_and_a_prediction_is_none():
    """The machine holds up the car's own frames; what the daemon makes of them is compared with their truth."""
    recorder, truth = Recorder(("FL",), 1.0), np.zeros(1, TRUTH)
    truth["counter"], truth["force"] = 3, 5_000.0
    recorder.note_sent(100 * S, truth)
    compared = []
    for source in (FUSED, PREDICTED):
        recorder.count = 0
        recorder.note_received(_force(1, source=source))
        compared.append(recorder.compare(0))
    assert [len(one.force_N) for one in compared] == [1, 0] and compared[0].true_N[0] == 5_000.0


def test_the_reference_is_the_true_force_at_the_time_of_the_frames(monkeypatch):
    """While frames are read the car drives on; 60 ms of a stroke would look like an error of 3 kN."""
    recorder, truth = Recorder(("FL",), 1.0), np.zeros(1, TRUTH)
    truth["force"] = 10_000.0
    recorder.note_sent(100 * S, truth)
    recorder.note_received(_force(0, 10.0))
    receive = recorder._listener.receive

    def drive_on(frames):
        receive(frames)
        truth["force"] = 13_310.0
        recorder.note_sent(100 * S + 60_000_000, truth)

    monkeypatch.setattr(recorder._listener, "receive", drive_on)
    [corner] = recorder.present(100 * S)
    assert corner.state(100 * S)["clamp_force_ref_kN"] == 10.0
