"""Value iteration: against brute force and dynamic programming, its policy, and its grid."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import scipy.stats

import kreps
from kreps.algorithms import value_iteration
from kreps.algorithms.dual import standardise
from kreps.algorithms.state import LearnerState
from kreps.algorithms.value_iteration import (
    ValueIterationInfo,
    candidate_actions,
    iterate_values,
)
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.envs.swing_up import reward, wrap_angle
from kreps.errors import ConfigurationError, SpaceError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.kernels.regression import KernelEmbedding
from kreps.learning.collect import collect_grid
from kreps.learning.environment import task_of
from kreps.models.transition import fit_embedding, state_kernel, successor_features
from kreps.policies.value_based import SoftmaxPolicy, soft_maximum
from kreps.settings import ValueIterationSettings

TASK = TaskSpec(2, [-2.0], [6.0], periodic=(0,))


def rollouts_of(seed: int, count: int = 4, steps: int = 6, scale: float = 1.0) -> list[Rollout]:
    """Random walks with random rewards; every second one terminates."""
    rng = np.random.default_rng(seed)
    return [
        Rollout(
            np.cumsum(rng.normal(0.0, 0.5, size=(steps + 1, 2)), axis=0),
            rng.normal(2.0, 4.0, size=(steps, 1)),  # often beyond the limits
            scale * rng.normal(-5.0, 3.0, size=steps),
            bool(number % 2),
        )
        for number in range(count)
    ]


def new_state() -> LearnerState:
    return LearnerState(ReplayWindow(TASK, 30))


def embedding_of(
    data: Transitions, lengthscales: list[float], regulariser: float
) -> KernelEmbedding:
    """The embedding as an update has it, with the given hyper-parameters."""
    applied = np.clip(data.actions, -2.0, 6.0) / 4.0 - 0.5
    kernel = Kernel((*TASK.state_factors, SquaredExponential((2,))), np.array(lengthscales))
    return KernelEmbedding.fit(kernel, np.concatenate([data.states, applied], 1), regulariser)


def q_by_hand(
    model: KernelEmbedding, states: FloatArray, candidates: FloatArray, targets: FloatArray
) -> FloatArray:
    """Q (m, k) with explicit strengths for every pair of a state and a candidate."""
    mean = targets.mean()
    q = np.empty((len(states), len(candidates)))
    for i, state in enumerate(states):
        for j, action in enumerate(candidates):
            beta = model.strengths(np.concatenate([state, action])[None])[:, 0]
            q[i, j] = mean + sum(b * (t - mean) for b, t in zip(beta, targets, strict=True))
    return q


def soft_by_hand(q: FloatArray, temperature: float) -> FloatArray:
    top = q.max(axis=1)
    if temperature == 0.0:
        return top
    return top + temperature * np.log(np.exp((q - top[:, None]) / temperature).mean(axis=1))


def brute_force(
    model: KernelEmbedding,
    rollouts: list[Rollout],
    candidates: FloatArray,
    temperature: float,
    gamma: float,
    sweeps: int,
    first: float = 0.0,
    end: float = 0.0,
    unit: float = 1.0,
) -> tuple[list[FloatArray], FloatArray]:
    """V at all points after each sweep, and the targets whose Q is the outcome.

    These are of the last sweep.  After a termination no reward follows: V is ``end``, or that of
    zero in each step.  Where the shape of V has converged and its level has not, the limit of the
    level is added at once.
    """
    points = np.concatenate([r.observations for r in rollouts])
    rewards = np.concatenate([r.rewards for r in rollouts])
    earned = np.append(rewards, end * (1.0 - gamma))
    min_return, max_return = earned.min() / (1.0 - gamma), earned.max() / (1.0 - gamma)
    history, moved = [np.full(len(points), first)], 0.0
    targets = rewards
    for _ in range(sweeps):
        before = np.clip(history[-1] + moved, min_return, max_return)
        at = iter(np.split(before, np.cumsum([len(r) + 1 for r in rollouts])[:-1]))
        values = [next(at) for _ in rollouts]
        after = [
            np.append(v[1:-1], end if r.terminated else v[-1])
            for v, r in zip(values, rollouts, strict=True)
        ]
        targets = rewards + gamma * np.concatenate(after)
        q = q_by_hand(model, points, candidates, targets)
        history.append(np.clip(soft_by_hand(q, temperature), min_return, max_return))
        difference = history[-1] - before
        moved = 0.0
        if np.ptp(difference) <= 1e-3 * unit:
            moved = float(difference.mean()) * gamma / (1.0 - gamma)
    return history, targets


# ---- the fixed point --------------------------------------------------------------------------


@pytest.mark.parametrize("temperature", [0.0, 0.7])
def test_values_are_those_of_brute_force(temperature: float) -> None:
    rollouts, gamma = rollouts_of(0), 0.7
    data = Transitions.from_rollouts(rollouts)
    rewards, unit = standardise(data.rewards)
    standard = [
        Rollout(r.observations, r.actions, (r.rewards - data.rewards.max()) / unit, r.terminated)
        for r in rollouts
    ]
    model = embedding_of(data, [0.6, 0.8, 0.5], 0.05)
    candidates = candidate_actions(TASK, 4)
    zero = -float(data.rewards.max()) / unit
    q = iterate_values(model, data, rewards, zero, candidates, temperature, gamma)
    end = zero / (1.0 - gamma)
    history, targets = brute_force(
        model, standard, candidates, temperature, gamma, q.sweeps, end=end
    )

    changes = [np.ptp(b - a) for a, b in itertools.pairwise(history)]
    assert q.change == pytest.approx(changes[-1], rel=1e-6, abs=1e-12)
    assert q.change <= 1e-3 < changes[-2]  # it stops as soon as the change is small
    assert q.sweeps > 3

    queries = np.random.default_rng(1).normal(size=(7, 2))
    states = Kernel(TASK.state_factors, np.array([0.6, 0.8])).gram(data.states, queries)
    wanted = q_by_hand(model, queries, candidates, targets)
    np.testing.assert_allclose(q.offset + states.T @ q.table, wanted, rtol=1e-9, atol=1e-9)
    assert np.ptp(wanted, axis=1).min() > 0.05  # the action matters


@pytest.mark.parametrize("temperature", [0.3, 2.0])
def test_the_policy_of_an_update_has_the_q_of_brute_force_in_units_of_the_reward(
    temperature: float,
) -> None:
    rollouts = rollouts_of(2, scale=10.0)
    chosen = ValueIterationSettings(actions=5, temperature=temperature, restart_probability=0.3)
    state, info = value_iteration.update(
        new_state(), rollouts, TASK, chosen, np.random.default_rng(0)
    )
    policy = state.policy
    assert isinstance(policy, SoftmaxPolicy)
    data = Transitions.from_rollouts(rollouts)
    *lengthscales, regulariser = info.embedding_parameters
    model = embedding_of(data, lengthscales, regulariser)
    candidates = np.linspace(-1.0, 1.0, 5)[:, None]
    scaled = temperature * float(data.rewards.std())
    first = data.rewards.max() / 0.3
    unit = float(data.rewards.std())
    history, targets = brute_force(
        model, rollouts, candidates, scaled, 0.7, info.sweeps, first, unit=unit
    )
    assert info.converged and info.samples == len(data)
    assert info.change == pytest.approx(np.ptp(history[-1] - history[-2]) / data.rewards.std())

    queries = np.random.default_rng(3).normal(size=(6, 2))
    wanted = q_by_hand(model, queries, candidates, targets)
    np.testing.assert_allclose(policy.q_values(queries), wanted, rtol=1e-6)
    np.testing.assert_allclose(policy.value(queries), soft_by_hand(wanted, scaled), rtol=1e-6)
    best = np.linspace(-2.0, 6.0, 5)[wanted.argmax(axis=1)][:, None]
    np.testing.assert_allclose(policy.greedy(queries), best)


@pytest.mark.parametrize("temperature", [0.0, 0.5])
def test_a_chain_has_the_values_of_exact_dynamic_programming(temperature: float) -> None:
    """With a kernel that is zero between samples the embedding is a table."""
    length, gamma = 6, 0.9
    task = TaskSpec(1, [-1.0], [1.0])
    moves = (-1.0, 0.0, 1.0)
    rng = np.random.default_rng(4)
    gain = rng.normal(size=(length, 3))
    rollouts = []
    for position, j in itertools.product(range(length), range(3)):
        after = min(max(position + moves[j], 0.0), length - 1.0)
        rollouts.append(
            Rollout(
                [[position], [after]], [[moves[j]]], [gain[position, j]], (position, j) == (3, 2)
            )
        )
    data = Transitions.from_rollouts(rollouts)
    inputs = np.concatenate([data.states, data.actions], axis=1)
    kernel = Kernel((*task.state_factors, SquaredExponential((1,))), np.array([0.05, 0.05]))
    model = KernelEmbedding.fit(kernel, inputs, 1e-10)
    candidates = candidate_actions(task, 3)
    np.testing.assert_array_equal(candidates[:, 0], moves)
    found = iterate_values(model, data, data.rewards, -0.3, candidates, temperature, gamma)

    exact = np.zeros((length, 3))
    for _ in range(500):
        v = soft_by_hand(exact, temperature)
        for position, j in itertools.product(range(length), range(3)):
            after = v[int(min(max(position + moves[j], 0.0), length - 1.0))]
            after = -0.3 / (1.0 - gamma) if (position, j) == (3, 2) else after
            exact[position, j] = gain[position, j] + gamma * after
    positions = np.arange(length, dtype=np.float64)[:, None]
    gram = Kernel(task.state_factors, np.array([0.05])).gram(data.states, positions)
    q = found.offset + gram.T @ found.table
    np.testing.assert_allclose(q, exact, atol=2e-3 * gamma / (1.0 - gamma))
    assert np.ptp(exact) > 1.0
    np.testing.assert_array_equal(q.argmax(axis=1), exact.argmax(axis=1))


def test_strengths_that_sum_to_more_than_one_do_not_diverge() -> None:
    """Where the strengths sum to more than 1 / gamma, V without clipping diverges."""
    rollouts, gamma = rollouts_of(6, 4, 10), 0.95
    data = Transitions.from_rollouts(rollouts)
    rewards, _ = standardise(data.rewards)
    model = embedding_of(data, [2.0, 2.0, 2.0], 1e-3)
    candidates = candidate_actions(TASK, 9)
    zero = float(rewards.mean())
    found = iterate_values(model, data, rewards, zero, candidates, 0.0, gamma)
    min_return, max_return = rewards.min() / (1.0 - gamma), rewards.max() / (1.0 - gamma)

    assert candidates[4, 0] == 0.0
    weights = found.table[:, 4] / np.exp(-0.5 * (model.inputs[:, 2] / 2.0) ** 2)
    gram = model.kernel.gram(model.inputs) + 1e-3 * np.eye(len(data))
    targets = found.offset + gram @ weights  # r + gamma V(s') of the last sweep
    successors = (targets - rewards) / gamma
    assert successors.min() >= min_return - 1e-6
    assert successors.max() <= max_return + 1e-6
    assert np.ptp(successors) > 1.0

    values = np.zeros(len(data.points))  # the same without clipping
    inputs = np.concatenate(
        [
            np.column_stack([data.points, np.full(len(data.points), action)])
            for action in candidates[:, 0]
        ]
    )
    beta = model.strengths(inputs)
    for _ in range(100):
        after = values[data.successor]
        after[data.terminated] = zero / (1.0 - gamma)
        free = rewards + gamma * after
        q = free.mean() + beta.T @ (free - free.mean())
        values = q.reshape(len(candidates), -1).max(axis=0)
    assert not (min_return <= values.min() and values.max() <= max_return)


def test_a_fit_starts_where_that_of_the_last_update_ended() -> None:
    settings, rollouts = ValueIterationSettings(), rollouts_of(1)
    data, start, state = Transitions.from_rollouts(rollouts), None, new_state()
    fits = []
    for new in (rollouts, []):  # twice from the same samples
        state, info = value_iteration.update(state, new, TASK, settings, np.random.default_rng(0))
        rng = np.random.default_rng(0)
        kernel = state_kernel(data, TASK, rng)
        _, features = RKHSBasis.fit(kernel, data.points, tolerance=1e-6, max_rank=400)
        targets = successor_features(data, features)
        _, wanted = fit_embedding(data, targets, kernel, TASK, start, rng)
        assert state.embedding_start is not None
        np.testing.assert_array_equal(state.embedding_start, wanted)
        np.testing.assert_array_equal(info.embedding_parameters, np.exp(wanted))
        start = state.embedding_start
        fits.append(start)
    assert not np.array_equal(*fits)


@pytest.mark.parametrize(
    ("change", "note"), [(0.0, ""), (1e-3, ""), (1.1e-3, "NOT CONVERGED"), (1.0, "NOT CONVERGED")]
)
def test_a_change_above_the_tolerance_is_shown_as_not_converged(change: float, note: str) -> None:
    info = ValueIterationInfo(20, 300, change, 1e-3, np.ones(4), {})
    assert info.shown()["note"] == note
    assert info.converged == (note == "")


# ---- soft maximum -----------------------------------------------------------------------------

Q = np.random.default_rng(7).normal(0.0, 3.0, size=(20, 8))


def test_the_soft_maximum_lies_between_mean_and_maximum() -> None:
    np.testing.assert_array_equal(soft_maximum(Q, 0.0), Q.max(axis=1))
    np.testing.assert_allclose(soft_maximum(Q, 1e-9), Q.max(axis=1), atol=1e-7)
    np.testing.assert_allclose(soft_maximum(Q, 1e9), Q.mean(axis=1), atol=1e-5)
    ladder = np.array([soft_maximum(Q, t) for t in (0.01, 0.1, 1.0, 10.0, 100.0)])
    assert (np.diff(ladder, axis=0) < 0.0).all()  # lower at a higher temperature
    np.testing.assert_allclose(
        soft_maximum(Q, 1.5), 1.5 * np.log(np.exp(Q / 1.5).mean(axis=1)), rtol=1e-12
    )


@pytest.mark.parametrize("temperature", [0.0, 0.5, 20.0])
def test_a_constant_added_to_all_values_is_added_to_their_soft_maximum(temperature: float) -> None:
    for shift in (-1e4, 3.0, 1e6):
        np.testing.assert_allclose(
            soft_maximum(Q + shift, temperature), soft_maximum(Q, temperature) + shift, rtol=1e-9
        )


def test_the_soft_maximum_of_equal_values_is_that_value() -> None:
    for temperature in (0.0, 1.0, 50.0):
        found = soft_maximum(np.full((2, 7), -4.2), temperature)
        np.testing.assert_allclose(found, -4.2, rtol=1e-12)


# ---- the policy -------------------------------------------------------------------------------

PAIR = TaskSpec(2, [-2.0, 0.0], [2.0, 10.0])


def softmax_policy(temperature: float = 0.8) -> SoftmaxPolicy:
    rng = np.random.default_rng(8)
    return SoftmaxPolicy(
        task=PAIR,
        kernel=Kernel(PAIR.state_factors, np.array([0.7, 1.3])),
        states=rng.normal(size=(30, 2)),
        table=rng.normal(size=(30, 9)),
        offset=-40.0,
        candidates=candidate_actions(PAIR, 9),
        temperature=temperature,
    )


def q_of(policy: SoftmaxPolicy, state: FloatArray) -> FloatArray:
    """Q (k,) of one state, sample by sample."""
    scaled = (policy.states - state) / np.array([0.7, 1.3])
    weights = np.exp(-0.5 * (scaled**2).sum(axis=1))
    return policy.offset + np.sum(weights[:, None] * policy.table, axis=0)


def actions_of(policy: SoftmaxPolicy) -> FloatArray:
    return policy.candidates * np.array([2.0, 5.0]) + np.array([0.0, 5.0])


def test_actions_are_sampled_with_their_probabilities() -> None:
    policy, count = softmax_policy(), 20_000
    states = np.array([[0.2, -0.3], [-0.5, 0.9]])
    noise = np.random.default_rng(9).standard_normal((2 * count, 2))
    drawn = policy.act(np.repeat(states, count, axis=0), noise).reshape(2, count, 2)
    found = []
    for state, actions in zip(states, drawn, strict=True):
        q = q_of(policy, state)
        expected = np.exp((q - q.max()) / 0.8)
        expected *= count / expected.sum()
        observed = (np.abs(actions[:, None] - actions_of(policy)) < 1e-12).all(axis=2).sum(axis=0)
        assert observed.sum() == count  # only candidates are sampled
        assert scipy.stats.chisquare(observed, expected).pvalue > 1e-3
        found.append(expected)
    assert scipy.stats.chisquare(found[0], found[1]).pvalue < 1e-9  # they differ by state


def test_the_greedy_action_is_that_of_the_largest_q() -> None:
    policy, chosen = softmax_policy(), set()
    states = np.random.default_rng(10).normal(size=(200, 2))
    actions, q = policy.greedy(states), policy.q_values(states)
    for state, action, row in zip(states, actions, q, strict=True):
        wanted = q_of(policy, state)
        np.testing.assert_allclose(row, wanted, rtol=1e-9)
        np.testing.assert_allclose(action, actions_of(policy)[wanted.argmax()])
        chosen.add(int(wanted.argmax()))
    assert len(chosen) > 4


def test_temperature_zero_acts_greedily() -> None:
    policy = softmax_policy(0.0)
    states, noise = np.random.default_rng(11).normal(size=(2, 300, 2))
    np.testing.assert_array_equal(policy.act(states, noise), policy.greedy(states))
    np.testing.assert_array_equal(policy.value(states), policy.q_values(states).max(axis=1))
    warm = softmax_policy(0.8)
    assert (warm.act(states, noise) != warm.greedy(states)).any()
    cold = softmax_policy(1e-6)
    assert (cold.act(states, noise) == cold.greedy(states)).all(axis=1).mean() > 0.99


@pytest.mark.parametrize("noise", [-40.0, -9.0, 9.0, 40.0])
def test_extreme_noise_still_chooses_a_candidate(noise: float) -> None:
    policy = softmax_policy()
    action = policy.act(np.zeros((1, 2)), np.full((1, 2), noise))[0]
    np.testing.assert_allclose(action, actions_of(policy)[0 if noise < 0.0 else -1])


def test_q_is_its_offset_far_from_the_data() -> None:
    policy = softmax_policy()
    far = np.array([[100.0, 0.0], [0.0, -1e6], [1e12, 1e12]])
    np.testing.assert_array_equal(policy.q_values(far), np.full((3, 9), -40.0))
    np.testing.assert_allclose(policy.value(far), -40.0)
    assert np.ptp(policy.q_values(np.zeros((1, 2)))) > 0.1
    state, _ = value_iteration.update(
        new_state(),
        rollouts_of(12),
        TASK,
        ValueIterationSettings(),
        np.random.default_rng(0),
    )
    learnt_policy = state.policy
    assert isinstance(learnt_policy, SoftmaxPolicy)
    far_q = learnt_policy.q_values(np.array([[0.0, 1e6]]))
    np.testing.assert_allclose(far_q, learnt_policy.offset)


def test_many_states_at_once_are_the_same_as_one_by_one() -> None:
    policy = softmax_policy()
    states = np.random.default_rng(13).normal(size=(5000, 2))
    q = policy.q_values(states)
    for i in (0, 2047, 2048, 4999):
        np.testing.assert_allclose(policy.q_values(states[i : i + 1])[0], q[i], rtol=1e-12)


@pytest.mark.parametrize(
    ("size", "count", "levels"),
    [
        (1, 25, 25),
        (1, 2, 2),
        (2, 25, 5),
        (2, 24, 4),
        (3, 25, 2),
        (3, 27, 3),
        (3, 64, 4),
        (3, 124, 4),
        (3, 125, 5),
    ],
)
def test_candidates_are_evenly_spaced_from_limit_to_limit(
    size: int, count: int, levels: int
) -> None:
    task = TaskSpec(1, np.zeros(size), np.arange(1.0, size + 1.0))
    found = candidate_actions(task, count)
    wanted = set(itertools.product(np.linspace(-1.0, 1.0, levels).tolist(), repeat=size))
    assert found.shape == (levels**size, size)
    assert {tuple(row) for row in found.tolist()} == wanted
    limits = task.unscaled(found)
    np.testing.assert_array_equal(limits.min(axis=0), task.action_low)
    np.testing.assert_array_equal(limits.max(axis=0), task.action_high)


@pytest.mark.parametrize(("size", "count"), [(1, 1), (2, 3), (12, 25)])
def test_too_few_candidates_are_an_error(size: int, count: int) -> None:
    task = TaskSpec(1, np.zeros(size), np.ones(size))
    with pytest.raises(ConfigurationError, match=f"actions = {count}"):
        candidate_actions(task, count)


# ---- the grid ---------------------------------------------------------------------------------


class Counter(gym.Env[Any, Any]):
    """Two coordinates that the action is added to, **in place**; ends where the sum exceeds 3."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(
            np.array([-1.0, 0.0]), np.array([1.0, 4.0]), dtype=np.float64
        )
        self.action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float64)
        self.batch_model = self

    def states_at(self, observations: FloatArray) -> FloatArray:
        return observations.copy()

    def observe(self, states: FloatArray) -> FloatArray:
        return states

    def initial(self, rngs: Any) -> FloatArray:
        return np.zeros((len(rngs), 2))

    def step(self, x: FloatArray, u: FloatArray, rngs: Any) -> Any:  # type: ignore[override]
        rewards = x[:, 0] + 10.0 * u[:, 0]
        x += u
        return x, rewards, x.sum(axis=1) > 3.0


def grid_of(
    env: gym.Env[Any, Any],
    ranges: Any = None,
    states: int = 3,
    actions: int = 2,
    max_points: int = 6000,
    seed: int = 0,
    iteration: int = 0,
) -> list[Rollout]:
    return collect_grid(
        env,
        task_of(env),
        ranges,
        states,
        actions,
        max_points=max_points,
        seed=seed,
        iteration=iteration,
    )


@pytest.mark.parametrize("ranges", [None, ((-3.0, 5.0), (0.5, 0.75))])
def test_every_grid_point_and_action_is_simulated_for_one_step(ranges: Any) -> None:
    rollouts = grid_of(Counter(), ranges, 5, 3)
    (a, b), (c, d) = ranges or ((-1.0, 1.0), (0.0, 4.0))
    wanted = itertools.product(np.linspace(a, b, 5), np.linspace(c, d, 5), (-2.0, 0.0, 2.0))
    assert all(len(r) == 1 for r in rollouts)
    found = [(*r.observations[0].tolist(), float(r.actions[0, 0])) for r in rollouts]
    np.testing.assert_allclose(sorted(found), sorted(wanted))
    for x, y, u in found:
        rollout = rollouts[found.index((x, y, u))]
        np.testing.assert_allclose(rollout.observations[1], [x + u, y + u])
        assert rollout.rewards[0] == pytest.approx(x + 10.0 * u)
        assert rollout.terminated == (x + y + 2.0 * u > 3.0)
    if ranges is None:
        assert 0 < sum(r.terminated for r in rollouts) < len(rollouts)


def test_angles_of_a_grid_are_spaced_over_a_whole_turn() -> None:
    env = gym.make("kreps/SwingUp-v0")
    rollouts = grid_of(env, ((0.1, 0.2), (-3.0, 3.0)), 4, 2)
    states = np.array([r.observations[0] for r in rollouts])
    angles = np.unique(np.round(states[:, 0] % (2.0 * np.pi), 9))
    np.testing.assert_allclose(angles, [0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi], atol=1e-8)
    np.testing.assert_allclose(np.unique(states[:, 1]), [-3.0, -1.0, 1.0, 3.0])
    assert len(rollouts) == 4 * 4 * 2


def test_rewards_of_a_grid_are_those_of_the_wrapped_angle() -> None:
    """The reward function expects a wrapped angle."""
    env = gym.make("kreps/SwingUp-v0")
    rollouts = grid_of(env, ((-3.0, 3.0), (-8.0, 8.0)), 8, 2)
    before = np.array([r.observations[0] for r in rollouts])
    torque = np.array([r.actions[0, 0] for r in rollouts])
    wanted = reward(wrap_angle(before[:, 0]), before[:, 1], torque)
    np.testing.assert_allclose([r.rewards[0] for r in rollouts], wanted)
    assert all(env.observation_space.contains(o) for r in rollouts for o in r.observations)


def test_a_step_from_a_grid_point_equals_one_of_the_environment() -> None:
    env = gym.make("kreps/Reaching-v0").unwrapped
    ranges = ((0.0, 1.0), (0.0, 1.0), (-2.0, 2.0), (-5.0, 5.0))
    rollouts = grid_of(gym.make("kreps/Reaching-v0"), ranges, 3, 2)
    assert len(rollouts) == 3**4 * 2**2
    env.reset(seed=0)
    for rollout in rollouts[::7]:
        env._states = rollout.observations[:1].copy()  # type: ignore[attr-defined]
        after, gained, terminated, _, _ = env.step(rollout.actions[0])
        np.testing.assert_allclose(rollout.observations[1], after, rtol=0, atol=1e-9)
        assert rollout.rewards[0] == pytest.approx(float(gained), abs=1e-9)
        assert rollout.terminated == terminated


def test_each_point_of_a_noisy_grid_has_its_own_noise() -> None:
    env, ranges = gym.make("kreps/SwingUp-v0"), ((0.0, 1.0), (0.0, 1e-9))

    def velocities(**options: int) -> FloatArray:
        """After one step, from pairs of points that are all but the same."""
        rollouts = grid_of(env, ranges, 2, 1, **options)
        return np.array([r.observations[1, 1] for r in rollouts])

    found = velocities()
    assert abs(found[0] - found[1]) > 1e-3
    np.testing.assert_array_equal(found, velocities())
    assert (np.abs(found - velocities(seed=1)) > 1e-6).all()
    assert (np.abs(found - velocities(iteration=1)) > 1e-6).all()


@pytest.mark.parametrize("name", ["Pendulum-v1", "kreps/ImageSwingUp-v0"])
def test_an_environment_that_cannot_be_set_to_a_state_is_an_error(name: str) -> None:
    with pytest.raises(ConfigurationError, match=r"states_at.*ValueIteration"):
        grid_of(gym.make(name), None, 1, 2)


def test_an_environment_in_an_unknown_wrapper_is_an_error() -> None:
    with pytest.raises(ConfigurationError, match="states_at"):
        grid_of(gym.wrappers.ClipReward(gym.make("kreps/SwingUp-v0"), 0.0, 1.0), None, 2, 2)


def test_too_many_grid_points_are_an_error_with_their_number() -> None:
    with pytest.raises(ConfigurationError, match=r"2500 points, but at most 2499"):
        grid_of(Counter(), None, 25, 4, max_points=2499)
    assert len(grid_of(Counter(), None, 25, 4, max_points=2500)) == 2500


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        (None, r"coordinates \[1\]"),  # the velocity
        (((0.0, 1.0), (-np.inf, 2.0)), r"coordinates \[1\]"),
        (((0.0, 1.0),), "1 ranges are given"),
        (((0.0, 1.0), (0.0, 1.0), (0.0, 1.0)), "3 ranges are given"),
    ],
)
def test_coordinates_without_limits_are_an_error(ranges: Any, message: str) -> None:
    with pytest.raises(SpaceError, match=message):
        grid_of(gym.make("kreps/SwingUp-v0"), ranges)


def test_errors_of_a_grid_are_errors_of_the_library() -> None:
    assert issubclass(SpaceError, kreps.ConfigurationError)
    with pytest.raises(kreps.KrepsError):
        grid_of(gym.make("Pendulum-v1"))
