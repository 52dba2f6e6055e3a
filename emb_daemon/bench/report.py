"""Evaluates the figures of a bench: every budget with its margin, and all figures as text."""

import math
from typing import Any


def verdict(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Each budget: ``measured``, ``limit``, ``unit``, and ``met``, whether the machine holds it.

    ``sense`` says which side of the limit is good, ``margin`` the distance to it, as a share of the limit. A figure that could
    not be measured is NaN and not met."""
    return [
        {
            "budget": name,
            "measured": value,
            "sense": sense,
            "limit": limit,
            "unit": unit,
            "margin": ((limit - value) if sense == "<=" else (value - limit)) / limit if limit else None,
            "met": bool(value <= limit if sense == "<=" else value >= limit),
        }
        for name, value, sense, limit, unit in _budgets(result)
    ]


def _budgets(result: dict) -> list[tuple[str, float, str, float, str]]:
    """(budget, measured, sense, limit, unit). Those of the loop apply to the run with four corners, or to the last run if
    there was none."""
    loop = next((loop for loop in result["loops"] if loop["corners"] == 4), result["loops"][-1])
    answers, empty, corners = loop["answers"], loop["empty_loop"], loop["corners"]
    wake = loop["cyclictest"] or empty
    whose = "cyclictest's" if loop["cyclictest"] else "an empty loop's"
    first, last = (value / 1024.0 for value in loop["resident_KiB"])
    response = answers["p99_us"] - wake["p99_us"]
    in_time = 100.0 * answers["in_time"] / max(answers["samples"], 1)
    return [
        (f"tick of {corners} corners, p99", loop["tick"]["p99_us"], "<=", 500.0, "us"),
        (f"last frame of a sample to answer, p99, minus {whose} wake-up", response, "<=", 600.0, "us"),
        (f"share of one core, {corners} corners", 100.0 * loop["core_share"], "<=", 12.0, "%"),
        ("samples answered within their cycle", in_time, ">=", 99.9, "%"),
        ("ticks missed, except those held up by the machine", loop["missed"] - loop["held_up"], "<=", 0, "ticks"),
        ("start to ready, kernels compiled before", loop["ready"]["wall_s"], "<=", 3.0, "s"),
        ("start to ready, nothing compiled", result["cold_start"]["wall_s"], "<=", 20.0, "s"),
        (f"resident memory of the daemon, {corners} corners", last, "<=", 250.0, "MiB"),
        ("its growth after the first second", last - first, "<=", 4.0, "MiB"),
    ]


def text(result: dict[str, Any]) -> str:
    """The figures as tables of text and the verdict."""
    lines = [result["machine"]]
    for loop in result["loops"]:
        lines += ["", *_loop(loop)]
    lines += ["", f"start with nothing compiled: ready after {_start(result['cold_start'])}"]
    lines += ["", *_verdict(result["verdict"])]
    return "\n".join(lines)


def _loop(loop: dict) -> list[str]:
    answers, beside = loop["answers"], loop["empty_loop"]
    first, last = (value / 1024.0 for value in loop["resident_KiB"])
    lines = [
        f"{loop['corners']} corner{'s' if loop['corners'] > 1 else ''}, {loop['seconds']:g} s; {'; '.join(loop['measures'])}",
        f"  {loop['missed']} of {loop['ticks']} ticks missed, {loop['held_up']} of them held up by the machine; "
        f"{beside['missed']} of {beside['ticks']} by an empty loop",
        f"  {answers['in_time']} of {answers['samples']} samples answered within their cycle",
        f"  {100 * loop['core_share']:.1f} % of one core; ready after {_start(loop['ready'])}",
        f"  {last:.0f} MiB resident, {last - first:+.1f} after the first second",
        f"  {'us':<36}{'p50':>8}{'p99':>8}",
    ]
    rows = [("tick", loop["tick"]), *((f"  {name}", figures) for name, figures in loop["parts"].items())]
    rows += [("last frame of a sample to its answer", answers), ("wake-up of the daemon", loop["wake_up"])]
    rows += [("wake-up of an empty loop beside it", beside)]
    if loop["cyclictest"]:
        rows.append(("wake-up by cyclictest", loop["cyclictest"]))
    lines += [f"  {name:<36}{figures['p50_us']:8.1f}{figures['p99_us']:8.1f}" for name, figures in rows]
    if not loop["cyclictest"]:
        lines.append("  cyclictest is not installed (package rt-tests), or real-time priority was refused")
    return lines


def _start(ready: dict) -> str:
    return f"{ready['wall_s']:.1f} s, {ready['cpu_s']:.1f} s of them on a CPU"


def _verdict(budgets: list[dict]) -> list[str]:
    lines = [f"  {'budget':<66}{'measured':>12}{'target':>12}{'margin':>28}"]
    for budget in budgets:
        figure = "not measured" if math.isnan(budget["measured"]) else f"{budget['measured']:.3g}"
        sign = "≤" if budget["sense"] == "<=" else "≥"
        margin = "" if budget["margin"] is None or math.isnan(budget["margin"]) else f"{100 * budget['margin']:+.0f} %"
        mark = "met" if budget["met"] else "NOT MET"
        lines.append(
            f"  {budget['budget']:<66}{figure:>12}{sign:>4}{budget['limit']:>8g} {budget['unit']:<16}{margin:>11}  {mark}"
        )
    return lines
