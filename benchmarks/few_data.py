"""What `KREPS(env)` has learnt from few data: writes ``results/few-data.json`` and ``.md``.

    pip install -r benchmarks/suite_requirements.txt
    python benchmarks/few_data.py --workers 2

After each update the greedy policy is evaluated.  A policy counts at a number of decisions if it
was learnt from at most so many; nothing is interpolated.  The score is the average reward per step
at p = 0.02, as in all results, and on the cart-pole of dm_control the undiscounted return of whole
episodes.  Runs of the same code that the file already has are not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "disabled")

import gymnasium as gym
import numpy as np

import kreps
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.tables import markdown
from kreps.learning.evaluate import Greedy, evaluate

RESULTS = Path(__file__).parents[1] / "results"
SEEDS = tuple(range(1240, 1250))
AVERAGED, EPISODES = 50, 5
"""Rollouts of 400 steps of each evaluation, and whole episodes."""


class HeldActions(gym.Wrapper[Any, Any, Any, Any]):
    """Each action is held for five steps, whose rewards are summed: 20 Hz on the cart-pole."""

    metadata = {"dt": 0.05}  # noqa: RUF012

    def step(self, action: Any) -> Any:
        total = 0.0
        for _ in range(5):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


@dataclass(frozen=True)
class FewDataTask:
    """One task.

    Attributes:
        name: in Gymnasium.
        period: of control, in s.
        marks: numbers of decisions at which the policy counts.
        targets: what is aimed at there, mean and worst seed.
        whole: whether the score is the return of whole episodes.
    """

    name: str
    period: float
    marks: tuple[int, ...]
    targets: tuple[str, ...]
    whole: bool = False

    def make(self) -> gym.Env[Any, Any]:
        if not self.name.startswith("dm_control/"):
            return gym.make(self.name)
        import shimmy  # noqa: F401 (registers these tasks)

        return HeldActions(gym.wrappers.FlattenObservation(gym.make(self.name)))


TASKS = {
    "swing-up": FewDataTask(
        "kreps/SwingUp-v0",
        0.05,
        (300, 500, 750, 1_000),
        ("-40", "-25 (-40)", "-22.8 (-25)", "-22.5 (-23.5)"),
    ),
    "reaching": FewDataTask(
        "kreps/Reaching-v0", 0.05, (500, 1_000), ("-0.10 (-0.10)", "-0.065 (-0.065)")
    ),
    "Pendulum-v1": FewDataTask("Pendulum-v1", 0.05, (600, 1_000), ("-2.8", "-3.2 (-3.2)")),
    "mountain car": FewDataTask("MountainCarContinuous-v0", 1 / 30, (1_500,), ("0.5 (0.3)",)),
    "dm_control cart-pole swing-up, 20 Hz": FewDataTask(
        "dm_control/cartpole-swingup-v0", 0.05, (1_000,), ("600 (400)",), whole=True
    ),
}


def returns_of(task: FewDataTask, learner: kreps.KREPS) -> float:
    """Mean undiscounted return of the greedy policy over whole episodes."""
    env, returns = task.make(), []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=100_000 + episode)
        total, state, over = 0.0, None, False
        while not over:
            action, state = learner.policy.predict(observation, state, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return float(np.mean(returns))


def score(task: FewDataTask, learner: kreps.KREPS, seed: int) -> float | None:
    """Of the acting policy without its noise; None before there is one."""
    if learner.state.policy is None:
        return None
    if task.whole:
        return returns_of(task, learner)
    return evaluate(
        task.make(),
        learner.task,
        Greedy(learner.state.policy),
        restart_probability=0.02,
        episodes=AVERAGED,
        seed=10_000 + seed,
    ).mean


def run(name: str, seed: int) -> dict[str, Any]:
    """Learn one task from one seed up to its last mark."""
    warnings.simplefilter("ignore")
    task, cpu = TASKS[name], 0.0
    updates: list[dict[str, Any]] = []
    learner = kreps.KREPS(task.make(), seed=seed)
    while True:
        start = time.process_time()
        learner.learn(1, progress=False)
        cpu += time.process_time() - start
        if learner.state.steps > task.marks[-1]:
            return {"task": name, "seed": seed, "updates": updates}
        found = score(task, learner, seed)
        updates.append(
            {
                "steps": learner.state.steps,
                "score": None if found is None else round(found, 4),
                "cpu_seconds": round(cpu, 1),
            }
        )


def at_mark(found: dict[str, Any], mark: int) -> dict[str, Any] | None:
    """The last update from at most so many decisions; None if there is none with a policy."""
    some = [u for u in found["updates"] if u["steps"] <= mark and u["score"] is not None]
    return some[-1] if some else None


def table(runs: list[dict[str, Any]]) -> str:
    """A row per task and mark."""
    rows = []
    for name, task in TASKS.items():
        mine = [found for found in runs if found["task"] == name]
        for mark, target in zip(task.marks, task.targets, strict=True):
            found = [at for each in mine if (at := at_mark(each, mark)) is not None]
            if not found:
                continue
            values = sorted((each["score"] for each in found), reverse=True)
            places = 3 if abs(values[0]) < 1 else 1
            rows.append(
                [
                    name,
                    f"{mark:,}",
                    f"{mark * task.period:.0f} s",
                    f"{np.mean(values):.{places}f} ({values[-1]:.{places}f})",
                    f"{np.median(values):.{places}f}",
                    f"{len(found)} of {len(mine)}",
                    target,
                    f"{np.mean([each['cpu_seconds'] for each in found]):.0f}",
                ]
            )
    head = ["task", "decisions", "robot time", "mean (worst)", "median"]
    return markdown([*head, "seeds with a policy", "aim: mean (worst)", "CPU s"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    file, code = RESULTS / "few-data.json", script_fingerprint(Path(__file__))
    before = json.loads(file.read_text()) if file.exists() else {}
    runs = before["results"] if before.get("code") == code else []
    done = {(each["task"], each["seed"]) for each in runs}
    jobs = [(task, seed) for task in args.tasks for seed in args.seeds if (task, seed) not in done]
    with ProcessPoolExecutor(args.workers) as pool:
        for found in pool.map(run, *zip(*jobs, strict=True)) if jobs else ():
            runs.append(found)
            runs.sort(key=lambda each: (list(TASKS).index(each["task"]), each["seed"]))
            command = " ".join(["python benchmarks/few_data.py", *sys.argv[1:]])
            content = {"command": command, "commit": commit(), "code": code, "results": runs}
            file.write_text(json.dumps(content, indent=1) + "\n")
            file.with_suffix(".md").write_text(table(runs) + "\n")
            print(found["task"], found["seed"], found["updates"][-1:], flush=True)


if __name__ == "__main__":
    main()
