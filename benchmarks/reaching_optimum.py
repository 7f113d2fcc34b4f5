"""Best known reward of the reaching task, by direct optimal control: a reference for learners.

    python benchmarks/reaching_optimum.py --steps 40 --starts 3

The task is deterministic, so its optimum is one sequence of torques over the first ``--steps``
periods; the arm then rests at the target without torque.  There are many local optima, and searches
from random sequences end in poor ones.  The search therefore starts from the torques of greedy
policies of kernel REPS, one learner per start, and continues by L-BFGS-B with central differences.
The result is the best known value and not a proven optimum.  Writes
``results/reaching-optimum.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.optimize import minimize

from kreps import KREPS
from kreps.envs.reaching import MAX_TORQUE, ReachingBatch
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.kernels.arrays import FloatArray
from kreps.learning.evaluate import Greedy, evaluation_rollouts
from kreps.versions import versions

RESTART = 0.02
HORIZON = 400  # periods of the reported value; later ones have a weight of 3e-4
SEARCHED = 100  # periods of the search; the arm rests in later ones
DIFFERENCE = 1e-5  # N m
FIRST_SEED = 300  # seeds that no other result uses


def average_rewards(torques: FloatArray, horizon: int = HORIZON) -> FloatArray:
    """Average reward (m,) of the restarting chain for torque sequences (m, steps, 2)."""
    model, rngs = ReachingBatch(), [np.random.default_rng(0)] * len(torques)
    states = model.initial(rngs)
    total = np.zeros(len(torques))
    weight, weights = 1.0, 0.0
    for t in range(horizon):
        a = torques[:, t] if t < torques.shape[1] else np.zeros((len(torques), 2))
        states, rewards, _ = model.step(states, a, rngs)
        total += weight * rewards
        weights += weight
        weight *= 1.0 - RESTART
    return total / weights


def loss_and_gradient(x: FloatArray, steps: int) -> tuple[float, FloatArray]:
    shifts = DIFFERENCE * np.eye(len(x))
    trials = np.concatenate([x[None], x + shifts, x - shifts]).reshape(-1, steps, 2)
    values = -average_rewards(trials, SEARCHED)
    ahead, behind = values[1 : len(x) + 1], values[len(x) + 1 :]
    return float(values[0]), (ahead - behind) / (2 * DIFFERENCE)


def learnt_torques(seed: int, steps: int) -> FloatArray:
    """The torques (steps * 2,) of the best of all greedy policies of one learner."""
    env = gym.make("kreps/Reaching-v0")
    found: list[tuple[float, FloatArray]] = []

    def keep(learner: Any, report: Any) -> None:
        (rollout,) = evaluation_rollouts(
            env, learner.task, Greedy(learner.state.policy), episodes=1, steps=SEARCHED, seed=seed
        )
        torques = np.clip(rollout.actions, -MAX_TORQUE, MAX_TORQUE)
        found.append((float(average_rewards(torques[None], SEARCHED)[0]), torques[:steps].ravel()))

    KREPS(env, seed=seed).learn(12, callback=keep, progress=False)
    return max(found, key=lambda pair: pair[0])[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results"))
    options = parser.parse_args()
    found: list[FloatArray] = []
    for start in range(options.starts):
        x = learnt_torques(FIRST_SEED + start, options.steps)
        before = float(average_rewards(x.reshape(1, -1, 2))[0])
        result = minimize(
            loss_and_gradient,
            x,
            args=(options.steps,),
            jac=True,
            method="L-BFGS-B",
            bounds=[(-MAX_TORQUE, MAX_TORQUE)] * (2 * options.steps),
            options={"maxiter": 300},
        )
        found.append(result.x.reshape(1, -1, 2))
        after = float(average_rewards(found[-1])[0])
        print(f"start {start}: {before:.5f} to {after:.5f}, {result.nit} iterations", flush=True)
    values = [float(average_rewards(torques)[0]) for torques in found]
    content = {
        "command": f"python benchmarks/reaching_optimum.py --steps {options.steps} "
        f"--starts {options.starts}",
        "commit": commit(),
        "code": script_fingerprint(Path(__file__)),
        "versions": versions(),
        "average_reward": max(values),
        "by_start": values,
        "largest_torque": float(np.abs(found[int(np.argmax(values))]).max()),
        "zero_torque": float(average_rewards(np.zeros((1, 1, 2)))[0]),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "reaching-optimum.json"
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(content, indent=2))


if __name__ == "__main__":
    main()
