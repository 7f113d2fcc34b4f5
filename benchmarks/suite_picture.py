"""The default and what it was before, beside SAC and CrossQ: draws ``results/suite.png``.

    python benchmarks/suite_picture.py

From ``results/suite.json``, ``results/suite-peers.json`` and ``suite_before.json``, which holds
former contents of ``suite.json``: runs at earlier commits, named in it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from suite import TASKS

RESULTS = Path(__file__).parents[1] / "results"
COLOURS = {"kreps": "tab:blue", "kreps before": "0.65", "SAC": "tab:orange", "CrossQ": "tab:green"}


def groups() -> list[tuple[str, list[dict[str, Any]]]]:
    """Labels and runs, in the order in which they are drawn."""
    peers = json.loads((RESULTS / "suite-peers.json").read_text())["runs"]
    found = [(name, [r for r in peers if r["learner"] == name]) for name in ("SAC", "CrossQ")]
    for before in json.loads(Path(__file__).with_name("suite_before.json").read_text()):
        found.append((f"kreps before ({before['commit'][:7]})", before["results"]))
    now = json.loads((RESULTS / "suite.json").read_text())
    found.append((f"kreps ({now['commit'][:7]})", now["results"]))
    return [(label, runs) for label, runs in found if runs]


def main() -> None:
    drawn = groups()
    figure, axes = plt.subplots(3, 3, figsize=(11, 8), layout="constrained")
    for axis, (name, task) in zip(axes.flat, TASKS.items(), strict=True):
        axis.axvline(task.solved, color="0.3", linestyle="--", linewidth=1)
        for row, (label, runs) in enumerate(drawn):
            returns = [run["mean"] for run in runs if run["task"] == name]
            colour = COLOURS[label.partition(" (")[0]]
            axis.plot(returns, [row] * len(returns), "o", color=colour, alpha=0.8)
        axis.set_title(f"{name}\n{task.steps:,} steps", fontsize=9)
        axis.set_ylim(-0.6, len(drawn) - 0.4)
        axis.set_yticks(range(len(drawn)), [label for label, _ in drawn], fontsize=7)
        axis.tick_params(axis="x", labelsize=8)
        if axis not in axes[:, 0]:
            axis.set_yticklabels([])
    figure.supxlabel("undiscounted return of the greedy policy, a dot per seed; dashed: solved")
    figure.savefig(RESULTS / "suite.png", dpi=110)


if __name__ == "__main__":
    main()
