"""Learning with delays and hidden state: writes ``results/delay-learning.json`` and ``.md``.

    python benchmarks/delay_learning.py --seeds 1300 1301 --workers 2

The swing-up with each perturbation is learnt by `KREPS(env)` in three ways: with
``history="auto"``, from the last observation alone, and, as a reference, with the full hidden state
in the observation (the waiting actions, the velocity, the state of the actuator).  The score is the
average reward per step of the greedy policy at p = 0.02, as in all results.  Runs of the same
code that the file already has are not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import kreps
from kreps import plotting
from kreps.envs.perturb import Backlash, DeadZone, Delay, Hidden, Lag, Perturbed
from kreps.envs.swing_up import TIME_STEP
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.tables import markdown
from kreps.learning.evaluate import Greedy, evaluate

RESULTS = Path(__file__).parents[1] / "results"
STEPS = 4_000
"""The policy of the update nearest to so many environment steps is evaluated."""

EPISODES = 50
"""Rollouts of each evaluation, of 400 steps."""

DELAYS = {f"action delay of {k}": {"actions": (Delay(k),)} for k in (1, 2, 3)}
PERTURBATIONS: dict[str, dict[str, Any]] = {
    "none": {},
    **DELAYS,
    "action delay of 1 to 3, random": {"actions": (Delay(3, least=1),)},
    "angle alone": {"observations": (Hidden(1),)},
    "backlash of 0.1 rad": {"observations": (Backlash((0.1, 0.0)),)},
    "dead zone of 5 N m": {"actions": (DeadZone(5.0),)},
    "actuator lag of 50 ms": {"actions": (Lag(0.05 / TIME_STEP),)},
}
AUTO, LAST, FULL = 'history="auto"', "last observation", "full state"
WAYS: dict[str, tuple[bool, dict[str, Any]]] = {
    AUTO: (False, {"history": "auto"}),
    LAST: (False, {}),
    FULL: (True, {}),
}
"""Whether the full state is observed, and the settings."""


def run(perturbation: str, way: str, seed: int) -> dict[str, Any]:
    """Learn the swing-up with a perturbation in one way, and evaluate the greedy policy."""
    warnings.simplefilter("ignore")
    reveal, settings = WAYS[way]

    def make() -> gym.Env[Any, Any]:
        env = gym.make("kreps/SwingUp-v0")
        return Perturbed(env, reveal=reveal, **PERTURBATIONS[perturbation])

    learner = kreps.KREPS(make(), seed=seed, **settings)
    cpu, before = time.process_time(), 0
    while learner.state.steps + (learner.state.steps - before) / 2 < STEPS:
        before = learner.state.steps
        learner.learn(1, progress=False)
    cpu = time.process_time() - cpu
    assert learner.state.policy is not None
    found = evaluate(
        make(),
        learner.task,
        Greedy(learner.state.policy),
        restart_probability=0.02,
        episodes=EPISODES,
        seed=10_000 + seed,
    )
    return {
        "perturbation": perturbation,
        "way": way,
        "seed": seed,
        "steps": learner.state.steps,
        "delay": learner.task.delay,
        "history": learner.task.history,
        "greedy": round(found.mean, 3),
        "updates": learner.state.iteration,
        "cpu_seconds": round(cpu, 1),
    }


def grouped(runs: list[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """The runs of each perturbation and way."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for each in runs:
        found[each["perturbation"], each["way"]].append(each)
    return found


def table(runs: list[dict[str, Any]]) -> str:
    """Mean and worst seed of each way, and what ``"auto"`` chose."""
    by_way, rows = grouped(runs), []
    for perturbation in PERTURBATIONS:
        row = [perturbation]
        for way in WAYS:
            found = [each["greedy"] for each in by_way[perturbation, way]]
            row.append(f"{np.mean(found):.1f} ({min(found):.1f})" if found else "–")
        auto = by_way[perturbation, AUTO]
        row.append(", ".join(f"({each['delay']}, {each['history']})" for each in auto))
        seconds = [
            sum(each["cpu_seconds"] for each in some) / max(sum(e["updates"] for e in some), 1)
            for some in (auto, by_way[perturbation, LAST])
        ]
        row.append(" / ".join(f"{each:.1f}" for each in seconds))
        rows.append(row)
    chosen = "chosen (delay, history)"
    heads = ["swing-up with", *(f"{way}: mean (worst)" for way in WAYS)]
    return markdown([*heads, chosen, "CPU s / update: auto / last"], rows) + "\n"


def draw(runs: list[dict[str, Any]]) -> Figure:
    """Reward against the delay in s: every seed, and the mean of each way."""
    by_way = grouped(runs)
    names = ["none", *DELAYS]
    with rc_context(plotting.STYLE):
        figure = Figure(figsize=(5.5, 3.2))
        axes = figure.subplots()
        for way in WAYS:
            found = [[each["greedy"] for each in by_way[name, way]] for name in names]
            delays = TIME_STEP * np.arange(len(names))
            (line,) = axes.plot(delays, [np.mean(each) for each in found], label=way)
            for delay, values in zip(delays, found, strict=True):
                axes.plot([delay] * len(values), values, ".", color=line.get_color())
        axes.set(
            xlabel="action delay in s",
            ylabel="average reward per step",
            xticks=delays,
            title=f"Swing-up after {STEPS:,} steps",
        )
        axes.legend()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1300, 1301])
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    path, code = RESULTS / "delay-learning.json", script_fingerprint(Path(__file__))
    stored = json.loads(path.read_text()) if path.exists() else {}
    runs = stored["runs"] if stored.get("code") == code else []
    done = {(each["perturbation"], each["way"], each["seed"]) for each in runs}
    missing = [
        key
        for seed in arguments.seeds
        for perturbation in PERTURBATIONS
        for way in WAYS
        if (key := (perturbation, way, seed)) not in done
    ]
    seeds = " ".join(map(str, arguments.seeds))
    with ProcessPoolExecutor(arguments.workers) as pool:
        for each in pool.map(run, *zip(*missing, strict=True)) if missing else ():
            print(each, flush=True)
            runs.append(each)
            content = {
                "command": f"python benchmarks/delay_learning.py --seeds {seeds}",
                "commit": commit(),
                "code": code,
                "steps": STEPS,
                "runs": runs,
            }
            path.write_text(json.dumps(content, indent=1) + "\n")
    path.with_suffix(".md").write_text(table(runs))
    plotting.save(draw(runs), path.with_suffix(".png"))


if __name__ == "__main__":
    main()
