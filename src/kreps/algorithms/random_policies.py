"""Random policies as candidates for the explorer, which the paper has not.

Bounded steps improve a policy by small changes, so they end in a local optimum of the return in the
model, also of that with the exploration bonus.  A good random policy can lie outside of its basin.
Linear policies of the state whose actions are mostly at their limits are few enough to be tried at
random, and do much of what exploration needs (H. Mania et al., NeurIPS 2018, search among linear
policies alone): on a pendulum about half of them pump energy into the swing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kreps.algorithms.acceptance import ModelComparison
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.kernels.linalg import cholesky, with_diagonal
from kreps.policies.sparse_gp import SparseGP

GAIN, OFFSET = 3.0, 0.3
"""Standard deviation of the scaled action before it is limited, for a state of a typical distance
from the mean one; and, relative to it, that of the action in the mean state."""

LIMIT = 1.2
"""Of the scaled action: a little beyond that of the task, so that a fit to it reaches that."""

ROLLOUTS = 20
"""Model rollouts of each random policy, on starts and noise of its own.  The best one is then
compared by as many as all other policies, with the same numbers as they."""

RIDGE = 1e-4
"""Of the fit of a policy to the best random one, for a kernel that is one at distance zero."""


@dataclass(frozen=True)
class RandomLinear:
    """Limited linear policies, each of which acts in an equal part of the rows of a call.

    Attributes:
        task: gives centre and scale of the actions.
        kernel: whose coordinates the policies are linear in; those of an angle are sine and cosine.
        mean, deviation: (e,) of the coordinates.
        slopes: (count, e, da).
        offsets: (count, 1, da).
    """

    task: TaskSpec
    kernel: Kernel
    mean: FloatArray
    deviation: FloatArray
    slopes: FloatArray
    offsets: FloatArray

    @classmethod
    def draw(
        cls, policy: SparseGP, states: FloatArray, count: int, rng: np.random.Generator
    ) -> RandomLinear:
        """Policies of the coordinates of a policy's kernel, standardised by states (n, ds)."""
        coordinates = policy.kernel.embed(states)
        deviation = coordinates.std(axis=0)
        deviation[deviation == 0.0] = 1.0
        size, width = policy.task.action_size, len(deviation)
        return cls(
            policy.task,
            policy.kernel,
            coordinates.mean(axis=0),
            deviation,
            GAIN / np.sqrt(width) * rng.standard_normal((count, width, size)),
            GAIN * OFFSET * rng.standard_normal((count, 1, size)),
        )

    def scaled(self, states: FloatArray) -> FloatArray:
        """Scaled actions (m, da) in states (m, ds): policy k acts in the k-th part of the rows."""
        z = (self.kernel.embed(states) - self.mean) / self.deviation
        parts = z.reshape(len(self.slopes), -1, z.shape[1])
        actions = np.clip(parts @ self.slopes + self.offsets, -LIMIT, LIMIT)
        return actions.reshape(len(states), -1)

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        """Actions (m, da) without noise."""
        return self.task.unscaled(self.scaled(states))

    def one(self, number: int) -> RandomLinear:
        """One of the policies, which acts in all rows."""
        each = slice(number, number + 1)
        return replace(self, slopes=self.slopes[each], offsets=self.offsets[each])


def best_random_policy(
    comparison: ModelComparison, policy: SparseGP, count: int, rng: np.random.Generator
) -> SparseGP:
    """The best of some random policies in the model, with centres and noise of a given policy.

    Args:
        comparison: of policies in the model.
        policy: that is given the mean of the random one.
        count: number of random policies.
        rng: draws them.
    """
    drawn = RandomLinear.draw(policy, comparison.world.states, count, rng)
    returns = replace(comparison, rollouts=ROLLOUTS * count).returns(drawn)
    best = drawn.one(int(np.argmax(returns.reshape(count, ROLLOUTS).mean(axis=1))))
    factor = cholesky(with_diagonal(policy.kernel.gram(policy.states), RIDGE))
    weights = factor.solve(best.scaled(policy.states))
    return replace(policy, mean_weights=np.ascontiguousarray(weights))
