"""What rollouts of a policy say of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.real_returns import made_by, real_return
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.policies.sparse_gp import SparseGP

TASK = TaskSpec(1, np.array([0.0]), np.array([4.0]))


def policy(mean: float) -> SparseGP:
    """The scaled action is ``mean`` at 0 and decreases away from it; its deviation is 0.1."""
    kernel = Kernel((SquaredExponential((0,)),), np.ones(1))
    weights = np.array([[mean]])
    return SparseGP(TASK, kernel, np.zeros((1, 1)), weights, np.zeros((1, 1)), 1e-12, 0.01)


def rollout(by: SparseGP, steps: int, terminated: bool, seed: int) -> Rollout:
    """A reward of one per step."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(steps + 1, 1))
    actions = by.act(states[:-1], rng.standard_normal((steps, 1)))
    return Rollout(states, actions, np.ones(steps), terminated)


def test_rollouts_are_told_apart_by_their_actions() -> None:
    makers = [policy(0.5), policy(0.3), policy(0.5), policy(-0.5)]
    data = Transitions.from_rollouts(
        rollout(maker, 3 + 40 * i, False, i) for i, maker in enumerate(makers)
    )
    np.testing.assert_array_equal(made_by(policy(0.5), data), [True, False, True, False])


@pytest.mark.parametrize(
    ("ends", "new", "wanted"),
    [
        ([False, False, False], 0, 1.0),
        ([True, False, False], 3, (30.0 + 50.0 * -2.0) / 80.0),  # 1 / p steps of the end's reward
        ([True, False, False], 1, 1.0),  # of the new one
        ([True, True, False], 2, None),
    ],
)
def test_a_return_counts_ends_unless_most_rollouts_have_one(
    ends: list[bool], new: int, wanted: float | None
) -> None:
    acting, other = policy(0.5), policy(-0.5)
    rollouts = [rollout(acting, 10, end, i) for i, end in enumerate(ends)]
    data = Transitions.from_rollouts([rollout(other, 10, True, 9), *rollouts])
    rewards: FloatArray = np.where(data.rollout == 0, -7.0, data.rewards)
    settings = SimpleNamespace(p=0.02)
    batch: Any = SimpleNamespace(data=data, rewards=rewards, settings=settings, seen=(new, 0))
    found = real_return(batch, acting, end_reward=-2.0)
    assert found == (None if wanted is None else pytest.approx(wanted))


def test_a_policy_without_rollouts_has_no_return() -> None:
    data = Transitions.from_rollouts([rollout(policy(-0.5), 10, False, 0)])
    settings = SimpleNamespace(p=0.02)
    batch: Any = SimpleNamespace(data=data, rewards=data.rewards, settings=settings, seen=(1, 10))
    assert real_return(batch, policy(0.5), -2.0) is None
