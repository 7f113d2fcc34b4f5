"""Table of kreps, SAC and PPO at equal environment steps: writes ``results/peers.md``.

    python benchmarks/peers_table.py

It reads ``results/peers.json`` (Stable-Baselines3, by ``benchmarks/peers.py``), ``untuned.csv``
(``kreps reproduce untuned``) and ``figure-1b.csv`` (REPS on fixed features, ``kreps reproduce
figure-1b``).  Each entry is of the latest policy learnt from at most so many steps.  CPU seconds
are from different days and loads of the machine; `peers_seconds.py` measures them together.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kreps.experiments.figures import at_most, value_at
from kreps.experiments.specs import FEATURES, with_preset
from kreps.experiments.tables import markdown

RESULTS = Path(__file__).resolve().parents[1] / "results"
MARKS = (3000, 5000, 8000)
TASKS = {
    "swing-up": "swing-up, long",
    "reaching": "reaching, own start",
    "images": "images, long",
    "pendulum": "pendulum",
    "mountain-car": "mountain-car",
}
"""Names of the tasks in `peers.py` and in the experiment of kreps."""

Curve = list[dict[str, Any]]


def cpu_seconds(curve: Sequence[dict[str, Any]]) -> float:
    """CPU seconds of rollouts and updates up to the last mark, without evaluation."""
    counted = [row for row in curve if float(row["steps"]) <= MARKS[-1]]
    return sum(float(r["rollout_cpu_seconds"]) + float(r["update_cpu_seconds"]) for r in counted)


def of_kreps(file: str, task: str, method: str | None) -> list[Curve]:
    """The rows of each seed of a task, of one method or of all (None)."""
    with open(RESULTS / file, newline="") as opened:
        rows = [row for row in csv.DictReader(opened) if row["task"] == task]
    rows = [row for row in rows if method in (None, row["method"])]
    return [[r for r in rows if r["seed"] == seed] for seed in sorted({r["seed"] for r in rows})]


def of_peers(task: str, learner: str) -> list[Curve]:
    """The rows of each seed of another learner, one row per mark."""
    rows = json.loads((RESULTS / "peers.json").read_text())["rows"]
    mine = [{**r, "steps": r["mark"]} for r in rows if (r["task"], r["learner"]) == (task, learner)]
    return [[r for r in mine if r["seed"] == seed] for seed in sorted({r["seed"] for r in mine})]


def line(task: str, name: str, curves: list[Curve], seconds: Sequence[float]) -> Any:
    read = [
        f"{value_at(curves, 'stochastic', mark)} / {value_at(curves, 'greedy', mark)}"
        for mark in MARKS
    ]
    return [task, name, str(len(curves)), *read, f"{np.mean(seconds):.0f}"]


def table() -> str:
    """The table as Markdown."""
    lines = []
    for task, ours in TASKS.items():
        curves = of_kreps("untuned.csv", ours, None)
        mine = [cpu_seconds(curve) for curve in curves]
        lines.append(line(task, "kreps, untuned", curves, mine))
        if task == "swing-up":
            method = with_preset(FEATURES, "default")
            features = of_kreps("figure-1b.csv", task, method)
            seconds = [cpu_seconds(curve) for curve in features]
            lines.append(line(task, f"{method}, of figure 1b", features, seconds))
        for learner in ("sac", "ppo"):
            if curves := of_peers(task, learner):
                seconds = [at_most(curve, MARKS[-1])["cpu_seconds"] for curve in curves]
                lines.append(line(task, learner.upper(), curves, seconds))
    marks = [f"{mark} steps" for mark in MARKS]
    return markdown(["task", "learner", "seeds", *marks, "CPU s"], lines)


if __name__ == "__main__":
    made = table()
    (RESULTS / "peers.md").write_text(made + "\n")
    print(made)
