"""Live view of the demonstration: the monitor's, with what the car does, and the simulated truth as the reference."""

import time
from collections.abc import Sequence

import numpy as np
from rich.console import Group
from rich.text import Text

from emb_daemon.demo.recorder import Recorder
from emb_daemon.monitor.view import corner_lines, number
from emb_daemon.plant.live import LiveCar
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.wire.contract import PARK_RELEASED


def phase(truth: np.void) -> str:
    """What the car is doing."""
    if truth["training"]:
        return "training motion"
    if truth["park_brake"] != PARK_RELEASED:
        return "parked"
    if truth["brake_request"]:
        return "braking" if truth["vehicle_speed"] > 0.0 else "held"
    return "driving" if truth["vehicle_speed"] > 0.1 else "standing"


def health(recorder: Recorder, daemon: Daemon, live: LiveCar) -> str:
    """Loop health in one line: time from sample to estimate on the bus, missed ticks, late and lost cycles of the car."""
    responses = recorder.recent_responses()
    if not len(responses):
        return "no estimate yet"
    median, tail = 1e3 * np.percentile(responses, (50, 99))
    return (
        f"answered in {median:.2f} ms (99 %: {tail:.2f}) · {daemon.missed} of {daemon.ticks} ticks missed"
        f" · car {live.late} late, {live.lost} lost"
    )


def _drive(recorder: Recorder) -> str:
    truth = recorder.truth[recorder.cycles - 1, 0]
    time_s = 1e-9 * (truth["time_ns"] - recorder.truth[0, 0]["time_ns"])
    return f"{time_s:5.1f} s  {phase(truth):8s}  {truth['vehicle_speed']:4.1f} m/s"


def line(recorder: Recorder, daemon: Daemon, live: LiveCar) -> str:
    """The view as one line, for output that is no terminal."""
    now = time.monotonic_ns()
    states = {corner.name: corner.state(now) for corner in recorder.present(now)}
    forces = "  ".join(
        f"{name} {number(state['clamp_force_kN'], 2):>6} ± {number(state['clamp_force_sigma_kN'], 2)} kN "
        f"(true {number(state['clamp_force_ref_kN'], 2):>5})"
        for name, state in states.items()
    )
    return f"{_drive(recorder)}  {forces}  {health(recorder, daemon, live)}"


def render(recorder: Recorder, daemon: Daemon, live: LiveCar, messages: Sequence[str], width: int, height: int) -> Group:
    """The view for a terminal of ``width`` x ``height`` characters; the daemon's last log ``messages`` where there is room."""
    now = time.monotonic_ns()
    lines = [Text(f"emb-daemon demo, simulated car and real daemon  {_drive(recorder)}", style="bold")]
    for corner in recorder.present(now):
        lines += corner_lines(corner, now, width)
    lines.append(Text("reference: the simulated truth, which the daemon never sees", style="dim"))
    lines.append(Text(health(recorder, daemon, live), style="dim"))
    room = max(height - len(lines) - 1, 0)
    lines += [Text(message, style="dim italic") for message in messages[len(messages) - room :]]
    for each in lines:
        each.truncate(width)
    return Group(*lines)
