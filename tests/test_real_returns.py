"""What rollouts of a policy say of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.real_returns import expected_rewards, made_by, real_return
from kreps.data.rollouts import Rollout, Rollouts, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.models.model_env import average_reward
from kreps.policies.sparse_gp import SparseGP

TASK = TaskSpec(1, np.array([0.0]), np.array([4.0]))


def policy(mean: float) -> SparseGP:
    """The scaled action is ``mean`` at 0 and decreases away from it; its deviation is 0.1."""
    kernel = Kernel((SquaredExponential((0,)),), np.ones(1))
    weights = np.array([[mean]])
    return SparseGP(TASK, kernel, np.zeros((1, 1)), weights, np.zeros((1, 1)), 1e-12, 0.01)


def rollout(by: SparseGP, steps: int, terminated: bool, seed: int) -> Rollout:
    """A costly start of five steps, then a reward of one per step."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(steps + 1, 1))
    actions = by.act(states[:-1], rng.standard_normal((steps, 1)))
    return Rollout(states, actions, np.where(np.arange(steps) < 5, -1.0, 1.0), terminated)


def found_in(rollouts: list[Rollout], new: int, p: float = 0.1) -> float | None:
    """The return of ``policy(0.5)``, over 20 steps."""
    data = Transitions.from_rollouts(rollouts)
    window = SimpleNamespace(rollouts=Rollouts.from_list(rollouts))
    settings = SimpleNamespace(p=p)
    batch: Any = SimpleNamespace(
        data=data, rewards=data.rewards, settings=settings, seen=(new, 0), window=window
    )
    state: Any = SimpleNamespace(policy=policy(0.5), explorer=policy(-0.5))
    env: Any = SimpleNamespace(evaluation_steps=20, restart_probability=p, end_reward=-2.0)
    return real_return(batch, state, env)


def test_rollouts_are_told_apart_by_their_actions() -> None:
    makers = [policy(0.5), policy(0.3), policy(0.5), policy(-0.5)]
    data = Transitions.from_rollouts(
        rollout(maker, 3 + 40 * i, False, i) for i, maker in enumerate(makers)
    )
    for other in (None, policy(-0.5)):
        found = made_by(policy(0.5), other, data)
        np.testing.assert_array_equal(found, [True, False, True, False])
    close = made_by(policy(0.5), policy(0.51), data)
    assert close[2] and not close[1]  # the likelier one of two that can have made it


def test_whole_rollouts_have_the_return_that_the_model_would_give_them() -> None:
    acting = policy(0.5)
    rollouts = [rollout(acting, 30, False, i) for i in range(3)]
    rewards = np.where(np.arange(20) < 5, -1.0, 1.0)[:, None]
    assert found_in(rollouts, 3) == pytest.approx(float(average_reward(rewards, 0.1)[0]))
    # one of three ends after its eighth step; then each step earns -2
    rollouts[1] = rollout(acting, 8, True, 1)
    each = np.repeat(rewards, 3, axis=1)
    each[8:, 1] = -2.0
    assert found_in(rollouts, 3) == pytest.approx(float(average_reward(each, 0.1).mean()))


def test_stopped_rollouts_do_not_count_as_ends() -> None:
    """Of four two are stopped after two steps, and one of the others ends in its fourth."""
    acting = policy(0.5)
    parts = [(6, False), (2, False), (2, False), (4, True)]
    data = Transitions.from_rollouts(rollout(acting, n, end, n) for n, end in parts)
    rewards = np.ones(len(data))
    chosen = np.ones(4, dtype=bool)
    found = expected_rewards(data, rewards, chosen, 8, 0.0)
    np.testing.assert_allclose(found, [1.0] * 4 + [0.5] * 4)


def test_which_rollouts_count() -> None:
    acting, other = policy(0.5), policy(-0.5)
    goes_on, ends = rollout(acting, 30, False, 0), rollout(acting, 8, True, 1)
    whole = found_in([goes_on], 1)
    assert whole is not None
    # those of the explorer do not
    assert found_in([rollout(other, 8, True, 2), goes_on], 2) == whole
    # new ones alone if they went on for a mean rollout at least
    assert found_in([ends, goes_on, goes_on], 1) == whole
    together = found_in([ends, goes_on, goes_on], 3)
    assert together is not None and together < whole
    assert found_in([ends, goes_on, goes_on], 1, p=0.02) != found_in([goes_on], 1, p=0.02)
    # nothing is said of policies half of whose rollouts end, or that made none
    assert found_in([ends, goes_on], 2) is None
    assert found_in([rollout(other, 30, False, 3)], 1) is None
