"""The view on a terminal: five lines for each corner, four corners in 80 x 24."""

import math
import textwrap

from rich.console import Group
from rich.text import Text

from emb_daemon.monitor.listener import Corner, Listener
from emb_daemon.wire.contract import MODES
from emb_daemon.wire.layout import CORNERS, PAD_TEMP

#: Time without a frame after which a corner is shown as silent.
_SILENT_S = 0.5
_LINES_PER_CORNER = 5
_BLOCKS = "▁▂▃▄▅▆▇█"
_MODE_COLOURS = dict(zip(MODES, ("dim", "green", "cyan", "yellow", "bold red"), strict=True))
_STATUS_COLOURS = {"ok": "green", "degraded": "yellow", "fault": "bold red", "not available": "dim"}
_MISSING = "–"


def sparkline(values: list[float], width: int, full: float) -> str:
    """Bars of the largest value in each of ``width`` equal parts of ``values``, from 0 to ``full``; a blank where none is."""
    text = ""
    for cell in range(width):
        part = values[cell * len(values) // width : max((cell + 1) * len(values) // width, cell * len(values) // width + 1)]
        known = [value for value in part if not math.isnan(value)]
        if not known:
            text += " "
        else:
            text += _BLOCKS[min(int(max(known) / full * len(_BLOCKS)), len(_BLOCKS) - 1)] if full > 0.0 else _BLOCKS[0]
    return text


def number(value: float | None, digits: int) -> str:
    return _MISSING if value is None else f"{value:.{digits}f}"


def _adaptation(request: str | None, progress_percent: int | None, result: str | None) -> Text:
    if request == "run":
        done = round(progress_percent / 20)
        return Text(f"adapting {'█' * done}{'·' * (5 - done)} {progress_percent} %", style="cyan")
    if result in (None, "none"):
        return Text("")
    return Text(f"adaptation {result}", style="green" if result == "accepted" else "yellow")


def corner_lines(corner: Corner, now_ns: int, width: int) -> list[Text]:
    """A corner's five lines."""
    state = corner.state(now_ns)
    silent = corner.silent_s(now_ns)

    first = Text(f"{corner.name} ", style="bold")
    first.append(f"{number(state['clamp_force_kN'], 2):>6} kN", style="bold")
    first.append(f" ± {number(state['clamp_force_sigma_kN'], 2):<5}")
    first.append(f"{state['source'] or '':<10}")
    mode = state["mode"] or ""
    first.append(f"{mode:<9}", style=_MODE_COLOURS.get(mode, ""))
    history = corner.forces_kN(now_ns)
    known = [value for value in history if not math.isnan(value)]
    full = max(1.0, max(known, default=0.0))
    cells = max(10, min(60, width - len(first) - 10))
    first.append(" ▕")
    first.append(sparkline(history, cells, full), style="cyan")
    first.append(f"▏{full:.0f} kN", style="dim")

    second = Text("   ")
    for name, surface, mean in (("inner", "inner_surface_C", "inner_mean_C"), ("outer", "outer_surface_C", "outer_mean_C")):
        second.append(f"{name} pad {number(state[surface], 0):>3}/{number(state[mean], 0):>3} °C  ")
    factor, contact = number(state["stiffness_factor"], 3), number(state["contact_angle_rad"], 1)
    second.append(f"stiffness {factor}  contact {contact} rad", style="" if corner.streams[PAD_TEMP].usable else "dim")

    third = Text("   ")
    if silent > _SILENT_S:
        third.append(f"SILENT for {silent:.0f} s; last values shown", style="bold red")
    else:
        third.append(state["status"], style=_STATUS_COLOURS.get(state["status"], "red"))
        if state["input_age_ms"]:
            third.append(f"  {state['input_age_ms']} ms old", style="yellow")
    if state["clamp_force_ref_kN"] is not None:
        third.append(f"  reference {number(state['clamp_force_ref_kN'], 2)} kN")
    third.append(f"  {state['forces_per_s']:.0f}/s  ")
    third.append(f"{corner.missing} missing", style="yellow" if corner.missing else "dim")
    third.append("  ")
    third.append(f"{corner.damaged} damaged", style="red" if corner.damaged else "dim")
    third.append("  ")
    third.append_text(_adaptation(**state["adaptation"]))

    reasons = textwrap.wrap(", ".join(state["reasons"]), width - 4, max_lines=2, placeholder=" …")
    return [first, second, third, *(Text(f"   {line}", style="yellow") for line in [*reasons, "", ""][:2])]


def render(listener: Listener, now_ns: int, title: str, width: int, height: int, paused: bool = False) -> Group:
    """The whole screen, ``width`` x ``height`` characters."""
    head = Text(f"emb-daemon monitor  {title}", style="bold", no_wrap=True, overflow="ellipsis")
    lines = [head]
    corners = listener.active
    if not corners:
        lines += [
            Text(""),
            Text("nothing received yet: no EMB_c_ClampForce, PadTemp, EstimatorStatus or AdaptRequest", style="yellow"),
        ]
    room = max(1, (height - 2) // _LINES_PER_CORNER)
    for corner in corners[:room]:
        lines += corner_lines(corner, now_ns, width)
    if len(corners) > room:
        lines[0].append(f"  (a taller window shows {', '.join(corner.name for corner in corners[room:])})", style="yellow")
    lines = lines[: height - 1] + [Text("")] * (height - 1 - len(lines))
    foot = Text("q quit  space pause  r reset counts and history", style="reverse")
    if len(corners) and len(corners) < len(CORNERS):
        foot.append(f"  only {', '.join(corner.name for corner in corners)} received")
    if paused:
        foot.append("  PAUSED", style="bold yellow")
    for line in lines:
        line.truncate(width)
    foot.truncate(width)
    return Group(*lines, foot)


def summary(listener: Listener, now_ns: int) -> list[str]:
    """One line for each corner, for output that is not a terminal."""
    lines = []
    for name, state in listener.states(now_ns).items():
        force, sigma = number(state["clamp_force_kN"], 3), number(state["clamp_force_sigma_kN"], 3)
        pads = f"pads {number(state['inner_surface_C'], 0)} and {number(state['outer_surface_C'], 0)} °C"
        counts = f"{state['forces_per_s']:.0f}/s, {state['missing']} missing, {state['damaged']} damaged"
        reasons = f"; {', '.join(state['reasons'])}" if state["reasons"] else ""
        reference = state["clamp_force_ref_kN"]
        sensor = "" if reference is None else f" (reference {number(reference, 3)} kN)"
        lines.append(f"{name} {force} ± {sigma} kN{sensor} {state['source']}, {state['mode']}, {pads}, {counts}{reasons}")
    return lines
