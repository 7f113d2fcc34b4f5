"""Value iteration and NPALP as the authors' scripts have them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms.hard_value_iteration import iterate_to_one_percent, known_rewards
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.envs.authors.swing_up import AuthorsSwingUp
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.kernels.regression import KernelEmbedding
from kreps.models.transition import state_actions
from kreps.policies.relative_softmax import RelativeSoftmaxPolicy
from kreps.policies.value_based import LipschitzPolicy

TASK = TaskSpec(1, [-2.0], [2.0])
CANDIDATES = np.array([[-1.0], [0.0], [1.0]])
TINY = {"initial_rollouts": 5, "rollouts_per_iteration": 3, "window": 6}


def transitions(seed: int = 0, terminated: bool = False) -> Transitions:
    rng = np.random.default_rng(seed)
    return Transitions.from_rollouts(
        Rollout(rng.normal(size=(7, 1)), rng.normal(size=(6, 1)), rng.normal(size=6), terminated)
        for _ in range(3)
    )


def embedding(data: Transitions, regulariser: float = 0.1) -> KernelEmbedding:
    kernel = Kernel((SquaredExponential((0,)), SquaredExponential((1,))), np.array([0.8, 0.6]))
    return KernelEmbedding.fit(kernel, state_actions(data, TASK), regulariser)


def reward(states: FloatArray, actions: FloatArray) -> FloatArray:
    return -(states[:, 0] ** 2) - 0.1 * np.abs(actions[:, 0])


# ---- the sweeps -------------------------------------------------------------------------------


@pytest.mark.parametrize("terminated", [False, True])
@pytest.mark.parametrize("is_known", [False, True])
def test_the_sweeps_are_those_of_the_scripts(is_known: bool, terminated: bool) -> None:
    data, gamma = transitions(terminated=terminated), 0.9
    model = embedding(data)
    known = known_rewards(reward, data.points, 2.0 * CANDIDATES)
    found = iterate_to_one_percent(model, data, known if is_known else None, CANDIDATES, gamma)
    # by hand, with explicit strengths of each pair of a point and a candidate
    points = [np.column_stack([data.points, np.full((len(data.points), 1), a)]) for a in (-1, 0, 1)]
    strengths = np.stack([model.strengths(pairs) for pairs in points], axis=2)  # (n, points, k)
    earned = known if is_known else data.rewards
    low, high = (f(np.append(earned, [0.0] * terminated)) / 0.1 for f in (np.min, np.max))
    v, sweeps, change = (known.max(axis=1) if is_known else np.zeros(len(data.points))), 0, 1.0
    while change > 0.01 and sweeps < 100:
        following = gamma * np.where(data.terminated, 0.0, v[data.successor])
        targets = following + (0.0 if is_known else data.rewards)
        q = np.einsum("ipk,i->pk", strengths, targets) + (known if is_known else 0.0)
        new = np.clip(q.max(axis=1), low, high)
        change, v, sweeps = np.linalg.norm(new - v) / np.linalg.norm(new), new, sweeps + 1
    assert 1 < sweeps == found.sweeps
    assert found.change == pytest.approx(change)
    gram = model.kernel.part(slice(0, 1)).gram(data.states, data.points)
    added = known if is_known else 0.0
    np.testing.assert_allclose(gram.T @ found.table + added, q, atol=1e-9)


def test_a_known_reward_must_be_separable() -> None:
    points, actions = np.array([[0.0], [1.0], [2.0]]), np.array([[-1.0], [1.0]])
    found = known_rewards(reward, points, actions)
    np.testing.assert_allclose(found, [[-0.1, -0.1], [-1.1, -1.1], [-4.1, -4.1]])
    with pytest.raises(ConfigurationError, match="known_reward=False"):
        known_rewards(lambda s, a: s[:, 0] * a[:, 0], points, actions)


# ---- the policy -------------------------------------------------------------------------------


def policy(scale: float = 1.0, temperature: float = 0.5) -> RelativeSoftmaxPolicy:
    rng = np.random.default_rng(4)
    kernel = Kernel((SquaredExponential((0,)),), np.array([0.7]))
    table, added = rng.normal(size=(9, 3)), rng.normal(size=3)
    return RelativeSoftmaxPolicy(
        TASK,
        kernel,
        rng.normal(size=(9, 1)),
        scale * table,
        -3.0,
        CANDIDATES,
        temperature,
        scale * added,
    )


def test_actions_are_drawn_by_the_softmax_of_q_over_its_deviation() -> None:
    acting, state = policy(), np.array([[0.3]])
    q = acting.q_values(state)[0]
    k = acting.kernel.gram(acting.states, state)[:, 0]
    np.testing.assert_allclose(q, k @ acting.table - 3.0 + acting.action_rewards)
    wanted = np.exp(q / (0.5 * q.std()))
    wanted /= wanted.sum()
    noise = np.random.default_rng(0).standard_normal((20_000, 1))
    drawn = acting.act(np.tile(state, (20_000, 1)), noise)[:, 0]
    shares = [np.mean(drawn == action) for action in (-2.0, 0.0, 2.0)]
    np.testing.assert_allclose(shares, wanted, atol=0.02)
    assert acting.greedy(state)[0, 0] == 2.0 * CANDIDATES[q.argmax(), 0]
    assert acting.value(state)[0] == q.max()
    # the unit of the reward does not matter
    np.testing.assert_allclose(policy(scale=1000.0).logits(state), acting.logits(state))


def test_where_q_is_flat_all_candidates_are_equally_likely() -> None:
    flat = policy(scale=0.0)
    np.testing.assert_array_equal(flat.logits(np.array([[0.3]])), np.zeros((1, 3)))


# ---- learners ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [kreps.ValueIteration, kreps.GridValueIteration])
def test_the_preset_learns_and_survives_a_checkpoint(kind: Any, tmp_path: Path) -> None:
    env = gym.make("kreps/AuthorsSwingUp-v0")
    small: dict[str, Any] = {"grid_states": (4, 3), "grid_actions": 3}
    if kind is kreps.GridValueIteration:
        small["ranges"] = ((-2.0, 5.0), (-20.0, 20.0))
    learner = kind(env, preset="authors", **(TINY if kind is kreps.ValueIteration else small))
    learner.learn(1, progress=False)
    process = learner.policy.process
    assert isinstance(process, RelativeSoftmaxPolicy)
    # the known cost of a command, around its mean
    commands = 50.0 * process.candidates[:, 0]
    cost = -1e-3 * commands**2
    np.testing.assert_allclose(process.action_rewards, cost - cost.mean())
    if kind is kreps.GridValueIteration:
        assert learner.state.rollouts == 36
    learner.save(tmp_path / "checkpoint")
    again = kind.resume(tmp_path / "checkpoint", env)
    assert again.settings == learner.settings
    states = np.array([[0.1, 2.0], [3.0, -1.0]])
    np.testing.assert_array_equal(again.policy.process.greedy(states), process.greedy(states))
    np.testing.assert_array_equal(again.policy.process.logits(states), process.logits(states))


def test_without_a_known_reward_there_is_an_error_with_a_remedy() -> None:
    class Unknown(AuthorsSwingUp):
        def step(self, action: Any) -> Any:
            return super().step(action)

    for env in (Unknown(), gym.make("kreps/AuthorsImageSwingUp-v0")):
        learner = kreps.ValueIteration(env, preset="authors", **TINY)
        with pytest.raises(ConfigurationError, match="known_reward=False"):
            learner.learn(1, progress=False)


def test_a_grid_of_another_number_of_coordinates_is_refused() -> None:
    env = gym.make("kreps/AuthorsReaching-v0")
    learner = kreps.GridValueIteration(env, preset="authors", ranges=((-4.0, 4.0),) * 4)
    with pytest.raises(ConfigurationError, match=r"grid_states = \(19, 11\), but .* 4 observation"):
        learner.learn(1, progress=False)


def test_the_slope_of_npalp_may_be_in_raw_units() -> None:
    rng = np.random.default_rng(0)
    rollouts = [
        Rollout(rng.normal(0.0, 9.0, (6, 1)), rng.normal(size=(5, 1)), rng.normal(0.0, 7.0, 5))
        for _ in range(4)
    ]
    learner = kreps.NPALP(TASK, preset="authors")
    learner.update(rollouts)
    process = learner.policy.process
    assert isinstance(process, LipschitzPolicy)
    assert process.slope == pytest.approx(1.0)
    np.testing.assert_array_equal(process.kernel.lengthscales, [1.0])
    assert (process.noise_fraction, process.noise_scale) == (0.1, 0.6)
    # each sample bounds V: r + gamma V(s') at least, with slope one between states
    data = Transitions.from_rollouts(rollouts)
    following = process.value(data.points[data.successor])
    np.testing.assert_allclose(process.bounds, data.rewards + 0.98 * following)
    apart = np.abs(data.states - data.points[data.successor].T)
    np.testing.assert_allclose(following, (process.bounds[:, None] - apart).max(axis=0))
