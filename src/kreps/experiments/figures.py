"""Result files of a figure: every row, a summary, a table and the picture."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from kreps.envs.image_swing_up import PIXELS
from kreps.envs.references import REFERENCE_REWARDS
from kreps.envs.swing_up import TIME_STEP
from kreps.experiments.specs import METHODS, TASKS
from kreps.experiments.tables import markdown
from kreps.experiments.trials import commits_of
from kreps.learning.collect import simulate
from kreps.learning.environment import task_of
from kreps.learning.storage import write_atomically
from kreps.policies.exploration import BangBang
from kreps.seeding import Purpose, generator, integer_seed
from kreps.versions import versions


def rows_of(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per method, seed and iteration."""
    return [row for result in results for row in result["rows"]]


def named_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows with their curve's name as ``method``: it names the task where there are several."""
    if len({row["task"] for row in rows}) == 1:
        return [{**row} for row in rows]
    return [{**row, "method": f"{row['method']}, {row['task']}"} for row in rows]


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Per curve, at its last iteration: mean, twice the standard error and worst seed."""
    rows = named_rows(rows)
    summary = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        last = [row for row in mine if row["iteration"] == max(r["iteration"] for r in mine)]
        entry: dict[str, Any] = {
            "trials": len(last),
            "iteration": last[0]["iteration"],
            "mean_steps": float(np.mean([row["steps"] for row in last])),
            "mean_update_cpu_seconds": float(np.mean([row["update_cpu_seconds"] for row in mine])),
        }
        for name in ("stochastic", "greedy"):
            values = np.array([row[name] for row in last])
            error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
            entry[name] = {
                "mean": float(values.mean()),
                "two_standard_errors": float(2 * error),
                "worst": float(values.min()),
                "by_seed": [round(float(value), 4) for value in values],
            }
        summary[method] = entry
    return summary


def write_results(
    folder: Path, name: str, command: str, results: Sequence[Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """``NAME.csv`` with every row, ``NAME.json`` with summary, command and commit, ``NAME.md``."""
    rows = rows_of(results)
    columns = list(dict.fromkeys(column for row in rows for column in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(
        {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows
    )
    write_atomically(folder / f"{name}.csv", text.getvalue().encode())
    summary = summarise(rows)
    cells = [result["cell"] for result in results]
    content = {
        "command": command,
        "commit": commits_of(results),
        "options": {f"{cell['task']}: {cell['method']}": cell["options"] for cell in cells},
        "versions": versions(),
        "summary": summary,
    }
    write_atomically(folder / f"{name}.json", (json.dumps(content, indent=2) + "\n").encode())
    write_atomically(folder / f"{name}.md", (markdown_table(summary) + "\n").encode())
    return summary


TABLE_HEADINGS = ("method", "stochastic policy", "worst seed", "greedy policy", "worst seed")


def table_rows(summary: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """The summary in words: a row per method under `TABLE_HEADINGS`."""
    rows = []
    for method, entry in summary.items():
        places = 2 if abs(entry["greedy"]["mean"]) >= 1.0 else 3
        row = [method]
        for name in ("stochastic", "greedy"):
            mean, error = entry[name]["mean"], entry[name]["two_standard_errors"]
            row.append(f"{mean:.{places}f} ± {error:.{places}f}")
            row.append(f"{entry[name]['worst']:.{places}f}")
        rows.append(row)
    return rows


def markdown_table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """The summary as the documentation shows it, with the CPU seconds of an update."""
    rows = [
        [*row, f"{entry['iteration']}", f"{entry['mean_update_cpu_seconds']:.2f}"]
        for row, entry in zip(table_rows(summary), summary.values(), strict=True)
    ]
    return markdown([*TABLE_HEADINGS, "iterations", "CPU s / update"], rows)


MARKS = (3000, 5000, 6000, 8000, 20_000)
"""Environment steps at which learning curves are read off."""


def at_most(curve: Sequence[Mapping[str, Any]], steps: float) -> Mapping[str, Any]:
    """The row of the last policy that was learnt from at most so many steps."""
    return max(
        (row for row in curve if float(row["steps"]) <= steps), key=lambda row: float(row["steps"])
    )


def read_off(curves: Sequence[Sequence[Mapping[str, Any]]], name: str, mark: float) -> str:
    """Mean and, in brackets, worst seed at a mark; a dash where the curves end before it."""
    steps = [[float(row["steps"]) for row in curve] for curve in curves]
    if max(map(min, steps)) > mark or np.mean([max(s) for s in steps]) < 0.95 * mark:
        return "–"
    values = [float(at_most(curve, mark)[name]) for curve in curves]
    places = 1 if min(values) < -10.0 else 2 if min(values) < -1.0 else 3
    return f"{np.mean(values):.{places}f} ({min(values):.{places}f})"


def steps_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Mean and worst seed of the policies learnt from at most some numbers of steps."""
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        seeds = sorted({int(row["seed"]) for row in mine})
        curves = [[row for row in mine if int(row["seed"]) == seed] for seed in seeds]
        for name in ("stochastic", "greedy"):
            read = (read_off(curves, name, mark) for mark in MARKS)
            lines.append([f"{method}, {name}", *read])
    return markdown(["mean (worst seed)", *(f"{mark} steps" for mark in MARKS)], lines)


TITLES = {
    "figure-1a": "Reaching: learning progress of the methods (Fig. 1a)",
    "figure-1b": "Swing-up: learning progress of the methods (Fig. 1b)",
    "figure-2b": "Swing-up from images and from joint values (Fig. 2b)",
    "swing-up": "kreps/SwingUp-v0: every seed",
    "untuned": "KREPS(env) and nothing else: every seed",
    "ablation": "Each part of the default taken back alone: every seed",
    "low-rank": "Exact and of low rank: every seed",
    "forgetting": "Swing-up with and without a window of 30 roll-outs",
}
SEED_BY_SEED = ("swing-up", "untuned", "ablation", "low-rank")
STEP_BY_STEP = ("swing-up", "untuned", "ablation")


def write_figure(
    folder: Path, name: str, command: str, results: Sequence[Mapping[str, Any]]
) -> list[Path]:
    """The result files of a figure, and its picture."""
    from kreps import plotting
    from kreps.experiments import plots

    write_results(folder, name, command, results)
    rows = named_rows(rows_of(results))
    if name in STEP_BY_STEP:  # of the numbers as the file has them, rounded: they can be read again
        with open(folder / f"{name}.csv", newline="") as file:
            table = steps_table(named_rows(list(csv.DictReader(file))))
        write_atomically(folder / f"{name}-steps.md", (table + "\n").encode())
    references = {
        row["method"]: REFERENCE_REWARDS.get(TASKS[row["task"]].environment, {}) for row in rows
    }
    source = f"{command}   (commit {commits_of(results)})"
    if name in SEED_BY_SEED:
        figure = plots.comparison(rows, references, TITLES[name], source)
    else:
        some = next(iter(references.values()))
        known = list(METHODS) if rows[0]["method"] in METHODS else []
        figure = plots.learning_curves(rows, some, TITLES[name], source, known)
    picture = plotting.save(figure, folder / f"{name}.png")
    return [folder / f"{name}.{ending}" for ending in ("csv", "json", "md")] + [picture]


def draw_features(path: Path) -> Path:
    """Fig. 2a: what the learner sees of a roll-out of its first policy."""
    from kreps import plotting
    from kreps.experiments import plots

    env = gym.make("kreps/ImageSwingUp-v0")
    task = task_of(env)
    seeds = [integer_seed(0, Purpose.ENVIRONMENT, 0, 0)]
    noise = [generator(0, Purpose.POLICY, 0, 0).standard_normal((41, task.action_size))]
    (rollout,) = simulate(env, task, BangBang(task), seeds, noise)
    shown = np.arange(1, 41, 5)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = plots.image_features(
        rollout.observations[shown], [float(t * TIME_STEP) for t in shown], PIXELS
    )
    return plotting.save(figure, path)
