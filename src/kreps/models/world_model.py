"""A second bounded step on actions drawn anew, with the transition model saying what they lead to.

The weights of Eq. 1 can only choose among the actions that happened to be taken, one in each state.
A transition model predicts for *any* action, so more can be asked of the same roll-outs: in the
states as the first step reweighted them actions are drawn from its policy, and the same convex
problem is solved once more for them.  The KL bound then holds from what they were drawn from, so
that old roll-outs no longer tie the new policy to the old ones that made them.  And the policy so
found is led by the model to states that no sample is in: there the same is done once again.

What is compared in the model can be wide, and what is done in the world narrow: actions are drawn
with more than the policy's deviation, and the one fitted to them acts with as much less of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import FloatArray, IntArray
from kreps.models.model_env import Simulator
from kreps.models.novelty import Optimism


@dataclass(frozen=True)
class Outlook:
    """What a model says of any action in the states of n samples.

    Attributes:
        states: (n, ds).
        features: (n, r) of V there.
        features_at: (m, r) of V at any states (m, ds).
        restart: (r,) mean features of the states that the process restarts in.
        rewards: (n,) observed, standardised.
        expect: expected features (m, r) of the successor, of the samples (m,) that states are of
            or, if simulated, nearest to, and of states and scaled, applied actions (m, ds + da).
        reward: what reward (m, 1) is to be expected of such states and actions, from its mean.
        simulator: tells where a policy leads; None if the model does not.
        optimism: about what no sample is like; None if there is none.
    """

    states: FloatArray
    features: FloatArray
    features_at: Callable[[FloatArray], FloatArray]
    restart: FloatArray
    rewards: FloatArray
    expect: Callable[[IntArray, FloatArray], FloatArray]
    reward: Callable[[FloatArray], FloatArray]
    simulator: Simulator | None
    optimism: Optimism | None

    def rewards_of(self, inputs: FloatArray) -> FloatArray:
        """Expected rewards (m,), standardised, of states and scaled, applied actions (m, ds + da).

        A regression may overshoot what was ever observed, and would be believed.
        """
        said = self.rewards.mean() + self.reward(inputs)[:, 0]
        return np.clip(said, self.rewards.min(), self.rewards.max())

    def unknown_of(self, inputs: FloatArray) -> FloatArray:
        """How far actions lead to the unknown, 0 to 1: (m,), of inputs likewise.

        What follows a real end is known: a start state.
        """
        if self.simulator is None or self.optimism is None:
            return np.zeros(len(inputs))
        successors, ends = self.simulator.dynamics.predicted(inputs)
        _, likeness = self.simulator.nearest(successors)
        return (1.0 - ends[:, 0]) * self.optimism.unknown(likeness)
