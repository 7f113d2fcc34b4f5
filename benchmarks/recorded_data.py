"""A first policy from recordings of another controller, by how much its actions varied.

    python benchmarks/recorded_data.py

The recorded controller of the swing-up gives 10 N m in the direction of the velocity, with Gaussian
noise of three sizes.  From 30 rollouts of 50 steps one update is made, without any environment.
The learnt policy is then evaluated in the environment, and compared with the recordings by
`kreps.Policy.extrapolation`.  Writes ``recorded-data.json`` and ``recorded-data.md`` to
``results/``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import kreps
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import task_of
from kreps.learning.evaluate import discounted_average, evaluation_rollouts, stochastic_and_greedy

TORQUE, NOISES = 10.0, (3.0, 10.0, 30.0)
ROLLOUTS, STEPS, SEEDS = 30, 50, 5
RESTART_PROBABILITY = 0.02


def recorded(env: gym.Env[Any, Any], noise: float, seed: int) -> list[kreps.Rollout]:
    """Rollouts of the controller with this standard deviation of its noise, in N m."""
    rng, made = np.random.default_rng(seed), []
    for number in range(ROLLOUTS):
        observations, actions, rewards = [env.reset(seed=1000 * seed + number)[0]], [], []
        for _ in range(STEPS):
            torque = TORQUE * np.sign(observations[-1][1]) + noise * rng.normal()
            actions.append(np.array([torque]))
            observation, reward, *_ = env.step(np.clip(actions[-1], -30.0, 30.0))
            observations.append(observation)
            rewards.append(float(reward))
        made.append(kreps.Rollout(np.array(observations), np.array(actions), np.array(rewards)))
    return made


def row_of(noise: float, seed: int) -> dict[str, float]:
    """The numbers of one recording and one update."""
    env = gym.make("kreps/SwingUp-v0")
    rollouts = recorded(env, noise, seed)
    learner = kreps.KREPS(task_of(env), seed=seed, window=None)
    learner.update(rollouts)
    assert learner.state.policy is not None
    greedy = stochastic_and_greedy(learner.state.policy)["greedy"]
    made = evaluation_rollouts(env, learner.task, greedy, episodes=40, steps=300, seed=0)
    far = learner.policy.extrapolation(rollouts)
    return {
        "noise": noise,
        "seed": seed,
        "recorded": float(np.mean([rollout.rewards.mean() for rollout in rollouts])),
        "learnt": discounted_average(made, RESTART_PROBABILITY, 1).mean,
        "outside": far.outside,
        "effective_samples": far.effective_samples,
    }


def table(rows: list[dict[str, float]]) -> str:
    """Medians over seeds, by noise."""
    lines = [
        "| noise of the controller | reward of the recordings | of the learnt policy (all seeds) "
        "| actions outside the data | effective samples |",
        "|---|---|---|---|---|",
    ]
    for noise in NOISES:
        own = [row for row in rows if row["noise"] == noise]
        middle = {name: float(np.median([row[name] for row in own])) for name in own[0]}
        each = ", ".join(f"{row['learnt']:.1f}" for row in own)
        lines.append(
            f"| {noise:g} N m | {middle['recorded']:.1f} | {middle['learnt']:.1f} ({each}) "
            f"| {middle['outside']:.0%} | {middle['effective_samples']:.0f} of "
            f"{ROLLOUTS * STEPS} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the results")
    out = parser.parse_args().out
    with blas_threads(1):
        rows = [row_of(noise, seed) for noise in NOISES for seed in range(SEEDS)]
    content = {
        "command": "python benchmarks/recorded_data.py",
        "commit": commit(),
        "code": script_fingerprint(Path(__file__)),
        "rows": rows,
    }
    (out / "recorded-data.json").write_text(json.dumps(content, indent=2) + "\n")
    (out / "recorded-data.md").write_text(table(rows))


if __name__ == "__main__":
    main()
