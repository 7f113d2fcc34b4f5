"""CPU and wall-clock seconds of kreps and SAC for equal numbers of steps, on one machine.

    .venv-peers/bin/python benchmarks/peers_seconds.py --seeds 0

Writes ``results/peers-seconds.json`` and ``.md``.  `peers.py` compares rewards; its seconds may be
from different days and loads of the machine.  Here each task is learnt by the two learners one
after the other, each in a new process on one thread, for 8000 environment steps, without any
evaluation.  SAC has the settings and environments of `peers.py`; kreps is ``KREPS(env)``.  Of a
learner that works in batches, the batches that end within these steps are counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from peers import add_tasks, positive, seeds_of, write
from peers_trials import MARKS, TASKS, Stopwatch, Trial, model_of

import kreps
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.tables import markdown
from kreps.kernels.threads import blas_threads
from kreps.versions import versions

LEARNERS = ("kreps", "sac")


def seconds_of_kreps(task: str, seed: int, steps: int) -> tuple[float, float]:
    """CPU and wall-clock seconds of the rollouts and updates that end within so many steps."""
    learner = kreps.KREPS(gym.make(TASKS[task].environment), seed=seed)
    watch = Stopwatch()
    by_then = (0.0, 0.0)
    while True:
        learner.learn(1, progress=False)
        if learner.state.steps > steps:
            return by_then
        with watch.paused() as now:
            by_then = now


def seconds_of_sac(task: str, seed: int, steps: int) -> tuple[float, float]:
    """CPU and wall-clock seconds of SAC for so many steps."""
    import torch

    torch.set_num_threads(1)
    with blas_threads(1):
        model = model_of(Trial(task, "sac", seed, (steps,)))
        watch = Stopwatch()
        model.learn(steps)
        with watch.paused() as now:
            return now


def measured(learner: str, task: str, seed: int, steps: int) -> dict[str, Any]:
    """One row of the result; called in a new process."""
    measure = {"kreps": seconds_of_kreps, "sac": seconds_of_sac}[learner]
    cpu, wall = measure(task, seed, steps)
    return {
        "task": task,
        "learner": learner,
        "seed": seed,
        "cpu_seconds": cpu,
        "wall_seconds": wall,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Means over seeds as a Markdown table, one row per task."""
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        found = [row for row in rows if row["task"] == task]
        cpu, wall = (
            {
                learner: float(np.mean([r[name] for r in found if r["learner"] == learner]))
                for learner in LEARNERS
            }
            for name in ("cpu_seconds", "wall_seconds")
        )
        lines.append(
            [
                task,
                str(len(found) // len(LEARNERS)),
                *(f"{cpu[learner]:.1f} / {wall[learner]:.1f}" for learner in LEARNERS),
                f"{cpu['sac'] / cpu['kreps']:.1f} / {wall['sac'] / wall['kreps']:.1f}",
            ]
        )
    head = ["task", "seeds", "kreps, CPU / wall s", "SAC, CPU / wall s", "ratio, CPU / wall"]
    return markdown(head, lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_tasks(parser, default=[*TASKS])
    parser.add_argument("--seeds", type=seeds_of, default=range(1), help="such as 0 or 0-2")
    parser.add_argument("--steps", type=positive, default=MARKS[-1], help=f"default: {MARKS[-1]}")
    parser.add_argument("--out", type=Path, default=Path("results"), help="default: results")
    options = parser.parse_args()
    rows = []
    for task in options.tasks:
        for seed in options.seeds:
            for learner in LEARNERS:
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
                    rows.append(alone.submit(measured, learner, task, seed, options.steps).result())
                print(rows[-1], flush=True)
    about = {
        "command": f"python benchmarks/peers_seconds.py --seeds {options.seeds[0]}-"
        f"{options.seeds[-1]} --steps {options.steps} --tasks {' '.join(options.tasks)}",
        "commit": commit(),
        "code": script_fingerprint(Path(__file__)),
        "versions": versions(),
    }
    write(options.out / "peers-seconds.json", {**about, "rows": rows}, indent=1)
    (options.out / "peers-seconds.md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
