"""SAC and CrossQ on the tasks of ``suite.py``: writes ``results/suite-peers.json`` and ``.md``.

    pip install -r benchmarks/suite_requirements.txt -r benchmarks/peers_requirements.txt
    python benchmarks/suite_peers.py --seeds 23 24 --workers 2

Stable-Baselines3's SAC and CrossQ with their own defaults, a gradient step per environment step,
for the steps that `KREPS(env)` has there, and evaluated alike.  Runs of the same scripts that the
file already has are not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "disabled")

import numpy as np
from suite import EPISODES, TASKS

from kreps.experiments.provenance import commit
from kreps.experiments.source import hash_of_file
from kreps.experiments.tables import markdown

RESULTS = Path(__file__).parents[1] / "results"
LEARNERS = ("SAC", "CrossQ")
SCRIPTS = [Path(__file__), Path(__file__).with_name("suite.py")]


def run(learner: str, name: str, seed: int) -> dict[str, Any]:
    """Learn one task from one seed, and evaluate the greedy policy over whole episodes."""
    import sb3_contrib
    import stable_baselines3
    import torch

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    task = TASKS[name]
    kind = getattr(stable_baselines3, learner, None) or getattr(sb3_contrib, learner)
    model = kind("MlpPolicy", task.make(), seed=seed, device="cpu")
    cpu = time.process_time()
    model.learn(task.steps)
    cpu = time.process_time() - cpu
    env, returns = task.make(), []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=100_000 + episode)
        total, over = 0.0, False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return {
        "learner": learner,
        "task": name,
        "seed": seed,
        "steps": task.steps,
        "mean": round(float(np.mean(returns)), 3),
        "worst_episode": round(float(np.min(returns)), 3),
        "cpu_seconds": round(cpu, 1),
    }


def table(runs: list[dict[str, Any]]) -> str:
    """A row per task: mean and worst seed of each learner, and its CPU seconds."""
    rows = []
    for name in TASKS:
        row = [name, f"{TASKS[name].steps:,}"]
        for learner in LEARNERS:
            some = [each for each in runs if (each["learner"], each["task"]) == (learner, name)]
            means = [each["mean"] for each in some]
            row.append(f"{np.mean(means):.1f} ({min(means):.1f})" if means else "–")
            seconds = [each["cpu_seconds"] for each in some]
            row.append(f"{np.mean(seconds):.0f}" if seconds else "–")
        if any(each["task"] == name for each in runs):
            rows.append(row)
    heads = [head for learner in LEARNERS for head in (f"{learner}: mean (worst seed)", "CPU s")]
    return markdown(["task", "steps", *heads], rows) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[23, 24])
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    path = RESULTS / "suite-peers.json"
    code = {str(each.relative_to(RESULTS.parent)): hash_of_file(each) for each in SCRIPTS}
    stored = json.loads(path.read_text()) if path.exists() else {}
    runs = stored["runs"] if stored.get("code") == code else []
    done = {(each["learner"], each["task"], each["seed"]) for each in runs}
    missing = [
        key
        for seed in args.seeds
        for name in args.tasks
        for learner in args.learners
        if (key := (learner, name, seed)) not in done
    ]
    with ProcessPoolExecutor(args.workers) as pool:
        for each in pool.map(run, *zip(*missing, strict=True)) if missing else ():
            print(each, flush=True)
            runs.append(each)
            content = {
                "command": " ".join(["python benchmarks/suite_peers.py", *sys.argv[1:]]),
                "commit": commit(),
                "code": code,
                "runs": runs,
            }
            path.write_text(json.dumps(content, indent=1) + "\n")
    path.with_suffix(".md").write_text(table(runs))


if __name__ == "__main__":
    main()
