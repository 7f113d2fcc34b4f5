"""Tasks that nobody tuned on: writes ``results/suite.json`` and ``results/suite.md``.

    pip install -r benchmarks/suite_requirements.txt
    python benchmarks/suite.py --seeds 20 21 22 --workers 2

`KREPS(env)` alone, without any setting.  The score is what users of these tasks quote: the
undiscounted return of the greedy policy over whole episodes.  Runs of the same code that the file
already has are not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from collections import defaultdict
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

RESULTS = Path(__file__).parents[1] / "results"
EPISODES = 10
"""Evaluated episodes, from fixed start states."""


class IdleColumns(gym.ObservationWrapper[Any, Any, Any]):
    """Five columns of white noise beside the observation."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.size = int(np.prod(env.observation_space.shape or ())) + 5
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.size,), np.float64)

    def observation(self, observation: Any) -> Any:
        return np.append(observation, self.np_random.standard_normal(5))


class ContinuousCartPole(gym.Env[Any, Any]):
    """CartPole-v1 with a force of up to 10 N in place of its sign: reward 1 in every step."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    metadata = {"dt": 0.02}  # noqa: RUF012

    def __init__(self) -> None:
        self.discrete = gym.make("CartPole-v1").unwrapped

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.discrete.reset(seed=seed)
        return observation.astype(np.float64), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        force = float(np.clip(action, -1.0, 1.0)[0])
        self.discrete.force_mag = 10.0 * abs(force)
        observation, _, terminated, _, info = self.discrete.step(int(force > 0.0))
        return observation.astype(np.float64), 1.0, terminated, False, info


@dataclass(frozen=True)
class SuiteTask:
    """One task.

    Attributes:
        name: in Gymnasium, or of `ContinuousCartPole`.
        steps: of the environment, after which the policy is evaluated.
        solved: return of a good policy.
        idle: whether the observation has idle columns.
    """

    name: str
    steps: int
    solved: float
    idle: bool = False

    def make(self) -> gym.Env[Any, Any]:
        if self.name == "ContinuousCartPole":
            return gym.wrappers.TimeLimit(ContinuousCartPole(), 500)
        if self.name.startswith("dm_control/"):
            import shimmy  # noqa: F401 (registers these tasks)
        env = gym.make(self.name)
        if isinstance(env.observation_space, gym.spaces.Dict):
            env = gym.wrappers.FlattenObservation(env)
        return IdleColumns(env) if self.idle else env


TASKS = {
    "continuous cart-pole": SuiteTask("ContinuousCartPole", 1_500, 500),
    "InvertedPendulum-v5": SuiteTask("InvertedPendulum-v5", 1_500, 1_000),
    "InvertedPendulum-v5, five noise columns": SuiteTask("InvertedPendulum-v5", 3_000, 1_000, True),
    "Reacher-v5": SuiteTask("Reacher-v5", 5_000, -4),
    "InvertedDoublePendulum-v5": SuiteTask("InvertedDoublePendulum-v5", 10_000, 9_300),
    "dm_control cart-pole swing-up": SuiteTask("dm_control/cartpole-swingup-v0", 10_000, 850),
    "dm_control pendulum swing-up": SuiteTask("dm_control/pendulum-swingup-v0", 5_000, 850),
    "Hopper-v5": SuiteTask("Hopper-v5", 15_000, 3_000),
    "Swimmer-v5": SuiteTask("Swimmer-v5", 8_000, 45),
}


def run(name: str, seed: int) -> dict[str, Any]:
    """Learn one task from one seed, and evaluate the greedy policy."""
    warnings.simplefilter("ignore")
    task = TASKS[name]
    learner = kreps.KREPS(task.make(), seed=seed)
    cpu, before = time.process_time(), 0
    while learner.state.steps + (learner.state.steps - before) / 2 < task.steps:
        before = learner.state.steps
        learner.learn(1, progress=False)
    cpu = time.process_time() - cpu
    env, returns = task.make(), []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=100_000 + episode)
        total, state, over = 0.0, None, False
        while not over:
            action, state = learner.policy.predict(observation, state, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return {
        "task": name,
        "seed": seed,
        "steps": learner.state.steps,
        "mean": round(float(np.mean(returns)), 3),
        "worst_episode": round(float(np.min(returns)), 3),
        "cpu_seconds": round(cpu, 1),
    }


def table(results: list[dict[str, Any]]) -> str:
    """The table of all runs, a row per task."""
    by_task = defaultdict(list)
    for run in results:
        by_task[run["task"]].append(run)
    rows = []
    for name, runs in by_task.items():
        means = [run["mean"] for run in runs]
        rows.append(
            [
                name,
                f"{TASKS[name].solved:g}",
                f"{np.mean([run['steps'] for run in runs]):.0f}",
                f"{np.mean(means):.1f} ({min(means):.1f})",
                ", ".join(f"{mean:.1f}" for mean in means),
                f"{np.mean([run['cpu_seconds'] for run in runs]):.0f}",
            ]
        )
    head = ["task", "solved", "steps", "return: mean (worst seed)", "by seed", "CPU s"]
    return markdown(head, rows)


def write(results: list[dict[str, Any]]) -> None:
    order = list(TASKS)
    results.sort(key=lambda run: (order.index(run["task"]), run["seed"]))
    command = " ".join(["python benchmarks/suite.py", *sys.argv[1:]])
    code = script_fingerprint(Path(__file__))
    content = {"command": command, "commit": commit(), "code": code, "results": results}
    (RESULTS / "suite.json").write_text(json.dumps(content, indent=2) + "\n")
    (RESULTS / "suite.md").write_text(table(results) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[20, 21, 22])
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    results, file = [], RESULTS / "suite.json"
    if file.exists():
        before = json.loads(file.read_text())
        results = (
            before["results"] if before.get("code") == script_fingerprint(Path(__file__)) else []
        )
    done = {(run["task"], run["seed"]) for run in results}
    jobs = [(task, seed) for seed in args.seeds for task in args.tasks if (task, seed) not in done]
    with ProcessPoolExecutor(args.workers) as pool:
        for found in pool.map(run, *zip(*jobs, strict=True)) if jobs else ():
            results.append(found)
            write(results)
            print(found, flush=True)


if __name__ == "__main__":
    main()
