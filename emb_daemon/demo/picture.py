"""The picture that a demonstration leaves behind."""

import io
from pathlib import Path

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.demo.recorder import Recorder

_ESTIMATE, _TRUTH, _SPEED = "#0b6fb8", "#1a1a1a", "#9aa0a6"
_CORNERS = ("#0b6fb8", "#d1495b", "#2e933c", "#b07d12")
_HOT = ("#d1495b", "#e0912f")


def save_picture(recorder: Recorder, path: Path) -> None:
    """Force with its two-sigma band, error and temperatures over the drive, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    truth = recorder.truth[: recorder.cycles]
    time = 1e-9 * (truth["time_ns"][:, 0] - truth["time_ns"][0, 0])
    comparisons = [recorder.compare(row) for row in range(len(recorder.corners))]
    first = comparisons[0]
    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                         "grid.color": "#e6e6e6", "axes.axisbelow": True, "legend.frameon": False}):  # fmt: skip
        figure, (force, error, heat) = plt.subplots(
            3, 1, figsize=(11, 9.5), sharex=True, height_ratios=(3, 1.6, 2.2), layout="constrained"
        )
        name = recorder.corners[0]
        force.fill_between(
            first.time_s,
            1e-3 * (first.force_N - 2.0 * first.sigma_N),
            1e-3 * (first.force_N + 2.0 * first.sigma_N),
            color=_ESTIMATE,
            alpha=0.3,
            linewidth=0,
            label="± 2 σ",
        )
        force.plot(time, 1e-3 * truth["force"][:, 0], color=_TRUTH, linewidth=2.4, label="simulated truth")
        force.plot(first.time_s, 1e-3 * first.force_N, color=_ESTIMATE, linewidth=1.1, label="estimate, from the bus")
        force.set_ylabel(f"clamp force {name}, kN")
        # Room for the legend above the highest force.
        force.set_ylim(-0.4, max(1.18e-3 * float(np.max(truth["force"][:, 0])), 1.0))
        speed = force.twinx()
        speed.grid(False)
        speed.spines["right"].set_visible(True)
        speed.plot(time, truth["vehicle_speed"][:, 0], color=_SPEED, linewidth=1.0, linestyle="--", label="vehicle speed")
        speed.set_ylabel("vehicle speed, m/s", color=_SPEED)
        speed.tick_params(axis="y", colors=_SPEED)
        speed.set_ylim(-0.4, max(1.25 * float(np.max(truth["vehicle_speed"])), 1.0))
        handles = [*force.get_legend_handles_labels()[0], *speed.get_legend_handles_labels()[0]]
        labels = [*force.get_legend_handles_labels()[1], *speed.get_legend_handles_labels()[1]]
        force.legend(handles, labels, loc="upper left", ncols=4)
        _shade(force, time, truth["park_brake"][:, 0] > 0, "parked")

        error.fill_between(
            first.time_s,
            -2.0 * first.sigma_N,
            2.0 * first.sigma_N,
            color=_ESTIMATE,
            alpha=0.15,
            linewidth=0,
            label=f"± 2 σ {name}",
        )
        for row, comparison in enumerate(comparisons):
            usable = comparison.usable
            difference = np.where(usable, comparison.force_N - comparison.true_N, np.nan)
            rmse = comparison.figures()["rmse"]
            error.plot(
                comparison.time_s,
                difference,
                color=_CORNERS[row],
                linewidth=0.9,
                label=f"{recorder.corners[row]}: {rmse:.0f} N RMS",
            )
        largest = max((np.percentile(2.2 * c.sigma_N, 99) for c in comparisons if len(c.sigma_N)), default=100.0)
        error.set_ylim(-1.25 * largest, 1.6 * largest)
        error.set_ylabel("estimate − truth, N")
        error.legend(loc="upper left", ncols=5, fontsize=9)

        estimated, columns = recorder.temperatures(0)
        for colour, signal, field, label in (
            (_HOT[0], "InnerSurfaceTemp", "surface", "pad surface"),
            (_HOT[1], "InnerMeanTemp", "mean", "pad mean"),
        ):
            heat.plot(time, truth[field][:, 0, 0], color=colour, linewidth=2.6, alpha=0.35, label=f"{label}, simulated truth")
            heat.plot(estimated, columns[signal], color=colour, linewidth=1.1, label=f"{label}, estimate from the bus")
        heat.plot(time, truth["disc"][:, 0], color=_SPEED, linewidth=1.2, label="disc, simulated truth")
        heat.set_ylabel(f"inner pad {name}, °C")
        heat.set_xlabel("time, s")
        heat.legend(loc="upper left", ncols=2, fontsize=9)
        heat.set_xlim(0.0, time[-1])
        heat.set_ylim(top=1.15 * heat.get_ylim()[1])
        figure.suptitle("emb-daemon demo: clamp force without a force sensor (simulated car, real daemon)", fontsize=12)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
        plt.close(figure)
    write_atomically(path, buffer.getvalue())


def _shade(axes, time: np.ndarray, where: np.ndarray, label: str) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        left, right = time[start], time[min(end, len(time) - 1)]
        axes.axvspan(left, right, color="#f0ead6", zorder=0)
        axes.text(
            0.5 * (left + right), 0.93, label, transform=axes.get_xaxis_transform(), ha="center", color="#8a7f5c", fontsize=9
        )
