"""The policy of value iteration as the authors' scripts have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import FloatArray
from kreps.policies.value_based import SoftmaxPolicy


@dataclass(frozen=True)
class RelativeSoftmaxPolicy(SoftmaxPolicy):
    """Draws candidates by the softmax of Q over its standard deviation in each state.

    So the policy explores as much where actions hardly differ as where they differ by much.
    ``temperature`` is in units of that standard deviation; the scripts have the inverse.

    Attributes:
        action_rewards: (k,) the part of a known reward that depends on the action, in units of the
            reward; zeros if the reward is learnt.  The part that depends on the state is missing in
            Q, as it is the same for all actions.
    """

    action_rewards: FloatArray

    def q_values(self, states: FloatArray) -> FloatArray:
        return super().q_values(states) + self.action_rewards

    def value(self, states: FloatArray) -> FloatArray:
        """The maximum (m,) of Q at states (m, ds), without the known reward of the state."""
        return self.q_values(states).max(axis=1)

    def logits(self, states: FloatArray) -> FloatArray:
        q = self.q_values(states)
        deviation = q.std(axis=1, keepdims=True)
        centred = q - q.mean(axis=1, keepdims=True)
        return centred / (self.temperature * np.where(deviation > 0.0, deviation, 1.0))
