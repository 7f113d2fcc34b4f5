"""Optimum of the swing-up by dynamic programming: a reference for learners.

    python benchmarks/swing_up_optimum.py --angles 241 --velocities 241

Value iteration on a grid over angle and velocity, with the true dynamics, bilinear interpolation
and Gauss-Hermite quadrature over the torque noise.  The greedy policy of the value function is then
evaluated in the same way as learnt policies.  Writes ``results/swing-up-optimum.json``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
from scipy import sparse

import kreps
from kreps.envs import swing_up
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.kernels.arrays import FloatArray
from kreps.learning.environment import task_of
from kreps.learning.evaluate import evaluate
from kreps.versions import versions

RESTART = 0.02
MAX_VELOCITY = 25.0  # rad/s; larger velocities get the value at the edge of the grid
TORQUES = np.linspace(-swing_up.MAX_TORQUE, swing_up.MAX_TORQUE, 31)
NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
NODE_WEIGHTS = NODE_WEIGHTS / NODE_WEIGHTS.sum()


@dataclass(frozen=True)
class Grid:
    """Grid of angles over a whole turn (periodic) and velocities."""

    angles: int
    velocities: int

    def states(self) -> FloatArray:
        theta = swing_up.wrap_angle(np.arange(self.angles) * 2 * np.pi / self.angles)
        velocity = np.linspace(-MAX_VELOCITY, MAX_VELOCITY, self.velocities)
        return np.stack([a.ravel() for a in np.meshgrid(theta, velocity, indexing="ij")], axis=1)

    def interpolation(self, theta: FloatArray, velocity: FloatArray) -> sparse.csr_matrix:
        """Bilinear weights (m, grid points) of the grid points for m states."""
        x = theta / (2 * np.pi) * self.angles
        y = (np.clip(velocity / MAX_VELOCITY, -1, 1) + 1) / 2 * (self.velocities - 1)
        i, j = np.floor(x), np.minimum(np.floor(y), self.velocities - 2)
        row = np.arange(len(x))
        total = sparse.csr_matrix((len(x), self.angles * self.velocities))
        for di, wi in ((0, 1 - (x - i)), (1, x - i)):
            for dj, wj in ((0, 1 - (y - j)), (1, y - j)):
                column = ((i + di) % self.angles) * self.velocities + j + dj
                total = total + sparse.csr_matrix((wi * wj, (row, column.astype(int))), total.shape)
        return total

    def expectation(self, states: FloatArray, torque: FloatArray | float) -> sparse.csr_matrix:
        """Weights (m, grid points) of the successor's value, expected over the torque noise."""
        total = None
        for node, weight in zip(NODES, NODE_WEIGHTS, strict=True):
            successor = swing_up.integrate(*states.T, torque + swing_up.NOISE * node)
            part = weight * self.interpolation(*successor)
            total = part if total is None else total + part
        return total


@dataclass(frozen=True)
class GreedyOnGrid:
    """Greedy one-step look-ahead with the value function on the grid."""

    grid: Grid
    value: FloatArray

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        scores = [
            swing_up.reward(*states.T, np.full(len(states), torque))
            + (1 - RESTART) * (self.grid.expectation(states, torque) @ self.value)
            for torque in TORQUES
        ]
        return TORQUES[np.argmax(scores, axis=0)][:, None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--angles", type=int, default=241)
    parser.add_argument("--velocities", type=int, default=241)
    parser.add_argument("--out", type=Path, default=Path("results"))
    options = parser.parse_args()
    grid = Grid(options.angles, options.velocities)
    states = grid.states()
    rewards = [swing_up.reward(*states.T, np.full(len(states), u)) for u in TORQUES]
    transitions = [grid.expectation(states, u) for u in TORQUES]
    start = grid.interpolation(np.array([np.pi]), np.array([0.0]))
    value = np.zeros(len(states))
    sweeps = 0
    change = np.inf
    while change > 1e-4:
        q = [r + (1 - RESTART) * (p @ value) for r, p in zip(rewards, transitions, strict=True)]
        new = np.max(q, axis=0)
        change = float(np.abs(new - value).max())
        value = new
        sweeps += 1
    # discounted value from the start, times 1 - gamma: the average of the restarting chain
    bound = float((start @ value)[0]) * RESTART
    env = gym.make("kreps/SwingUp-v0")
    found = evaluate(env, task_of(env), GreedyOnGrid(grid, value), restart_probability=RESTART)
    content = {
        "command": "python benchmarks/swing_up_optimum.py "
        f"--angles {options.angles} --velocities {options.velocities}",
        "commit": commit(),
        "code": script_fingerprint(Path(__file__)),
        "versions": versions(),
        "sweeps": sweeps,
        "value_of_the_start_on_the_grid": bound,
        "greedy_policy_evaluated": vars(found),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "swing-up-optimum.json"
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(f"kreps {kreps.__version__}: {json.dumps(content, indent=2)}")


if __name__ == "__main__":
    main()
