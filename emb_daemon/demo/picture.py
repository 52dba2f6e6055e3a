"""The picture that a demonstration leaves behind."""

import io
from pathlib import Path

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.demo.recorder import Comparison, Recorder
from emb_daemon.offline.stretches import stretches_of

_ESTIMATE, _TRUTH, _SPEED = "#0b6fb8", "#1a1a1a", "#9aa0a6"
_CORNERS = ("#0b6fb8", "#d1495b", "#2e933c", "#b07d12")
_HOT = ("#d1495b", "#e0912f")


_STYLE = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": "#e6e6e6",
          "axes.axisbelow": True, "legend.frameon": False}  # fmt: skip


def save_picture(recorder: Recorder, path: Path) -> None:
    """Force with its two-sigma band, error and temperatures over the drive, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    truth = recorder.truth[: recorder.cycles]
    time = 1e-9 * (truth["time_ns"][:, 0] - truth["time_ns"][0, 0])
    comparisons = [recorder.compare(row) for row in range(len(recorder.corners))]
    with plt.rc_context(_STYLE):
        figure, (force, error, heat) = plt.subplots(
            3, 1, figsize=(11, 9.5), sharex=True, height_ratios=(3, 1.6, 2.2), layout="constrained"
        )
        _draw_force(force, time, truth, comparisons[0], recorder.corners[0])
        _draw_errors(error, comparisons, recorder.corners)
        _draw_heat(heat, time, truth, *recorder.temperatures(), recorder.corners[0])
        figure.suptitle("emb-daemon demo: clamp force without a force sensor (simulated car, real daemon)", fontsize=12)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
        plt.close(figure)
    write_atomically(path, buffer.getvalue())


def _draw_force(axes, time: np.ndarray, truth: np.ndarray, estimate: Comparison, corner: str) -> None:
    low, high = (1e-3 * (estimate.force_N + sign * 2.0 * estimate.sigma_N) for sign in (-1.0, 1.0))
    axes.fill_between(estimate.time_s, low, high, color=_ESTIMATE, alpha=0.3, linewidth=0, label="± 2 σ")
    axes.plot(time, 1e-3 * truth["force"][:, 0], color=_TRUTH, linewidth=2.4, label="simulated truth")
    axes.plot(estimate.time_s, 1e-3 * estimate.force_N, color=_ESTIMATE, linewidth=1.1, label="estimate, from the bus")
    axes.set_ylabel(f"clamp force {corner}, kN")
    # Room for the legend above the highest force.
    axes.set_ylim(-0.4, max(1.18e-3 * float(np.max(truth["force"][:, 0])), 1.0))
    speed = axes.twinx()
    speed.grid(False)
    speed.spines["right"].set_visible(True)
    speed.plot(time, truth["vehicle_speed"][:, 0], color=_SPEED, linewidth=1.0, linestyle="--", label="vehicle speed")
    speed.set_ylabel("vehicle speed, m/s", color=_SPEED)
    speed.tick_params(axis="y", colors=_SPEED)
    speed.set_ylim(-0.4, max(1.25 * float(np.max(truth["vehicle_speed"])), 1.0))
    legends = axes.get_legend_handles_labels(), speed.get_legend_handles_labels()
    axes.legend(*(one + other for one, other in zip(*legends, strict=True)), loc="upper left", ncols=4)
    _mark_parked(axes, time, truth["park_brake"][:, 0] > 0)


def _draw_errors(axes, comparisons: list[Comparison], corners: tuple[str, ...]) -> None:
    first, label = comparisons[0], f"± 2 σ {corners[0]}"
    band = 2.0 * first.sigma_N
    axes.fill_between(first.time_s, -band, band, color=_ESTIMATE, alpha=0.15, linewidth=0, label=label)
    for one, corner, colour in zip(comparisons, corners, _CORNERS, strict=False):
        difference = np.where(one.usable, one.force_N - one.true_N, np.nan)
        label = f"{corner}: {one.figures()['rmse']:.0f} N RMS"
        axes.plot(one.time_s, difference, color=colour, linewidth=0.9, label=label)
    largest = max((np.percentile(2.2 * one.sigma_N, 99) for one in comparisons if len(one.sigma_N)), default=100.0)
    axes.set_ylim(-1.25 * largest, 1.6 * largest)
    axes.set_ylabel("estimate − truth, N")
    axes.legend(loc="upper left", ncols=5, fontsize=9)


def _draw_heat(axes, time: np.ndarray, truth: np.ndarray, estimated_s: np.ndarray, columns: dict, corner: str) -> None:
    for colour, signal, field, label in (
        (_HOT[0], "InnerSurfaceTemp", "surface", "pad surface"),
        (_HOT[1], "InnerMeanTemp", "mean", "pad mean"),
    ):
        axes.plot(time, truth[field][:, 0, 0], color=colour, linewidth=2.6, alpha=0.35, label=f"{label}, simulated truth")
        axes.plot(estimated_s, columns[signal], color=colour, linewidth=1.1, label=f"{label}, estimate from the bus")
    axes.plot(time, truth["disc"][:, 0], color=_SPEED, linewidth=1.2, label="disc, simulated truth")
    axes.set_ylabel(f"inner pad {corner}, °C")
    axes.set_xlabel("time, s")
    axes.legend(loc="upper left", ncols=2, fontsize=9)
    axes.set_xlim(0.0, time[-1])
    axes.set_ylim(top=1.15 * axes.get_ylim()[1])


def _mark_parked(axes, time: np.ndarray, where: np.ndarray) -> None:
    for start, end in stretches_of(where):
        left, right = time[start], time[min(end, len(time) - 1)]
        axes.axvspan(left, right, color="#f0ead6", zorder=0)
        middle, across = 0.5 * (left + right), axes.get_xaxis_transform()
        axes.text(middle, 0.93, "parked", transform=across, ha="center", color="#8a7f5c", fontsize=9)
