"""The optimum of the reaching task by direct optimal control: what learners are measured against.

    python benchmarks/reaching_optimum.py --steps 30 --starts 24

The task is deterministic, so its optimum is one sequence of torques over the first ``--steps``
periods (none are needed once the arm rests at the target).  It has many local optima: the
cross-entropy method looks for the right valley from many random starts, and L-BFGS-B with
central differences for the bottom of the three best.  Writes ``results/reaching-optimum.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from kreps.arrays import FloatArray
from kreps.envs.reaching import MAX_TORQUE, ReachingBatch
from kreps.experiments.runner import commit
from kreps.runs import versions

RESTART = 0.02
HORIZON = 250  # periods; beyond it lie 0.6 % of the weight
DIFFERENCE = 1e-5  # N m


def average_rewards(torques: FloatArray) -> FloatArray:
    """Average reward (m,) of the restarting chain for torque sequences (m, steps, 2)."""
    model, rngs = ReachingBatch(), [np.random.default_rng(0)] * len(torques)
    states = model.initial(rngs)
    total = np.zeros(len(torques))
    weight, weights = 1.0, 0.0
    for t in range(HORIZON):
        a = torques[:, t] if t < torques.shape[1] else np.zeros((len(torques), 2))
        states, rewards, _ = model.step(states, a, rngs)
        total += weight * rewards
        weights += weight
        weight *= 1.0 - RESTART
    return total / weights


def loss_and_gradient(x: FloatArray, steps: int) -> tuple[float, FloatArray]:
    shifts = DIFFERENCE * np.eye(len(x))
    trials = np.concatenate([x[None], x + shifts, x - shifts]).reshape(-1, steps, 2)
    values = -average_rewards(trials)
    ahead, behind = values[1 : len(x) + 1], values[len(x) + 1 :]
    return float(values[0]), (ahead - behind) / (2 * DIFFERENCE)


def cross_entropy(rng: np.random.Generator, steps: int) -> FloatArray:
    """The best torque sequence (steps * 2,) that 80 rounds of 400 random ones led to."""
    mean, spread = np.zeros((steps, 2)), np.full((steps, 2), 6.0)
    for _ in range(80):
        trials = np.clip(rng.normal(mean, spread, (400, steps, 2)), -MAX_TORQUE, MAX_TORQUE)
        elite = trials[np.argsort(average_rewards(trials))[-40:]]
        mean, spread = elite.mean(axis=0), np.maximum(elite.std(axis=0), 0.1)
    return mean.ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("results"))
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    found: list[Any] = []
    valleys = [cross_entropy(rng, options.steps) for _ in range(options.starts)]
    depths = average_rewards(np.reshape(valleys, (-1, options.steps, 2)))
    print("valleys:", np.round(np.sort(depths)[::-1], 4), flush=True)
    for start in np.argsort(-depths)[:3]:
        result = minimize(
            loss_and_gradient,
            valleys[start],
            args=(options.steps,),
            jac=True,
            method="L-BFGS-B",
            bounds=[(-MAX_TORQUE, MAX_TORQUE)] * (2 * options.steps),
            options={"maxiter": 400},
        )
        found.append(result)
        print(f"start {start}: {-result.fun:.5f} after {result.nit} iterations", flush=True)
    best = min(found, key=lambda result: result.fun)
    content = {
        "command": f"python benchmarks/reaching_optimum.py --steps {options.steps} "
        f"--starts {options.starts}",
        "commit": commit(),
        "versions": versions(),
        "average_reward": -float(best.fun),
        "by_start": [-float(result.fun) for result in found],
        "largest_torque": float(np.abs(best.x).max()),
        "zero_torque": float(average_rewards(np.zeros((1, 1, 2)))[0]),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "reaching-optimum.json"
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(content, indent=2))


if __name__ == "__main__":
    main()
