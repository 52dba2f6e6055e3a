"""Estimate a log's clamp forces and plot them with their standard deviation.

python examples/replay_and_plot.py LOG [PICTURE]
"""

import sys

import matplotlib.pyplot as plt

import emb_daemon


def main(path: str, picture: str = "replay.png") -> None:
    log = emb_daemon.load_log(path, corner="FL")
    estimates = emb_daemon.run(log)
    force, sigma = 1e-3 * estimates["force"], 1e-3 * estimates["sigma"]

    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(10, 6), constrained_layout=True)
    axes[0].fill_between(log.time_s, force - 2 * sigma, force + 2 * sigma, alpha=0.3, label="± 2 sigma")
    axes[0].plot(log.time_s, 1e-3 * log.force_N, "k", linewidth=0.8, label="reference")
    axes[0].plot(log.time_s, force, linewidth=0.8, label="estimate")
    axes[0].set_ylabel("clamp force / kN")
    axes[0].legend()
    axes[1].plot(log.time_s, estimates["surface"], linewidth=0.8, label=["inner surface", "outer surface"])
    axes[1].plot(log.time_s, estimates["disc"], linewidth=0.8, label="disc")
    axes[1].set(xlabel="time / s", ylabel="temperature / °C")
    axes[1].legend()
    figure.savefig(picture, dpi=110)
    print(f"{picture}: {len(estimates)} estimates, up to {force.max():.1f} kN")


if __name__ == "__main__":
    main(*sys.argv[1:])
