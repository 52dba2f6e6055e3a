"""Live view of the demonstration."""

from collections.abc import Iterable
from itertools import compress

import numpy as np
from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from emb_daemon.demo.recorder import Recorder
from emb_daemon.monitor.view import STATUS_COLOURS, number
from emb_daemon.plant.live import LiveCar
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.wire.contract import PARK_RELEASED

_BAR_FULL_KN, _BAR_WIDTH = 20.0, 20
#: Columns of a corner: heading, alignment, and whether they fit a terminal of 80 characters; width of all.
_COLUMNS = (
    ("", "left", True), ("clamp force", "right", True), ("", "left", False), ("± 2σ", "right", True), ("true*", "right", True),
    ("source", "left", True), ("status", "left", True), ("mode", "left", False), ("surface", "right", False),
    ("mean", "right", True), ("true*", "right", False), ("remark", "left", True),
)  # fmt: skip
_WIDE = 120


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
    """Loop health in one line: time from sample to estimate on the bus, missed periods, late cycles of the car."""
    responses = recorder.recent_responses(0)
    if not len(responses):
        return "no estimate yet"
    median, tail = 1e3 * np.percentile(responses, (50, 99))
    return (
        f"sample to estimate {median:.2f} ms (99 %: {tail:.2f} ms) · daemon {daemon.ticks} ticks, {daemon.missed} missed"
        f" · car {live.late} cycles late, {live.lost} lost"
    )


def line(recorder: Recorder, daemon: Daemon, live: LiveCar) -> str:
    """The view as one line, for output that is no terminal."""
    truth = recorder.truth[recorder.cycles - 1]
    corners = "  ".join(
        f"{corner} {number(state['clamp_force_kN'], 2):>6} ± {_two_sigma(state):>4} kN (true {1e-3 * true['force']:6.2f})"
        for corner, state, true in zip(recorder.corners, recorder.states(), truth, strict=True)
    )
    time = 1e-9 * (truth[0]["time_ns"] - recorder.truth[0, 0]["time_ns"])
    return (
        f"{time:5.1f} s {phase(truth[0]):8s} {truth[0]['vehicle_speed']:4.1f} m/s  {corners}  {health(recorder, daemon, live)}"
    )


def _two_sigma(state: dict) -> str:
    sigma_kN = state["clamp_force_sigma_kN"]
    return number(None if sigma_kN is None else 2.0 * sigma_kN, 2)


def _bar(force_kN: float | None) -> Text:
    filled = round(min(max(force_kN or 0.0, 0.0) / _BAR_FULL_KN, 1.0) * _BAR_WIDTH)
    return Text("█" * filled, style="cyan") + Text("·" * (_BAR_WIDTH - filled), style="dim")


def _remark(state: dict) -> str:
    if state["adaptation"]["request"] == "run":
        return f"adapting, {state['adaptation']['progress_percent']} %"
    return ", ".join(state["reasons"])


def render(recorder: Recorder, daemon: Daemon, live: LiveCar, seconds: float, messages: Iterable[str], width: int) -> Panel:
    """The view for a terminal of ``width`` characters."""
    if not recorder.cycles:
        return Panel("starting", title="emb-daemon demo")
    truth = recorder.truth[recorder.cycles - 1]
    table = Table(box=None, header_style="bold", padding=(0, 1))
    shown = [width >= _WIDE or narrow for _, _, narrow in _COLUMNS]
    for heading, justify, _ in compress(_COLUMNS, shown):
        table.add_column(heading, justify=justify, no_wrap=heading != "remark")
    for corner, state, true in zip(recorder.corners, recorder.states(), truth, strict=True):
        cells = (
            Text(corner, style="bold"),
            f"{number(state['clamp_force_kN'], 2)} kN",
            _bar(state["clamp_force_kN"]),
            _two_sigma(state),
            Text(f"{1e-3 * true['force']:.2f}", style="dim"),
            state["source"] or "",
            Text(state["status"], style=STATUS_COLOURS.get(state["status"], "red")),
            state["mode"] or "",
            f"{number(state['inner_surface_C'], 0)} °C",
            f"{number(state['inner_mean_C'], 0)} °C",
            Text(f"{true['mean'][0]:.0f}", style="dim"),
            _remark(state),
        )
        table.add_row(*compress(cells, shown))
    time = 1e-9 * (truth[0]["time_ns"] - recorder.truth[0, 0]["time_ns"])
    head = Text(f"{time:5.1f} of {seconds:.0f} s   {phase(truth[0])}   {truth[0]['vehicle_speed']:.1f} m/s", style="bold")
    foot = Text(health(recorder, daemon, live), style="dim")
    notes = Text("\n".join(messages), style="dim italic")
    return Panel(
        Group(head, Text(""), table, Text(""), foot, notes),
        title="emb-daemon demo: simulated car, real daemon",
        subtitle="* simulated truth, which the daemon never sees",
    )
