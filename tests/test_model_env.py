"""Rollouts in the learnt dynamics: their starts, lengths, noise, ends and rewards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.models.dynamics import DeltaStateTargets, Dynamics, LinearMean, fit_dynamics
from kreps.models.model_env import (
    MAX_EVALUATION_STEPS,
    ModelEnv,
    ModelRollouts,
    average_reward,
    supports_model_rollouts,
)
from kreps.models.terminations import Terminations
from kreps.models.transition import state_kernel

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,))
"""An angle and a speed."""

STARTS = np.array([[3.0, 0.0], [-3.0, 0.5]])


def turns(rollouts: int = 6, steps: int = 20, seed: int = 0) -> list[Rollout]:
    """A wheel that is pushed at random from one of two states."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(rollouts):
        states = [STARTS[number % 2]]
        actions = rng.normal(0.0, 1.5, size=(steps, 1))
        for push in TASK.clip(actions)[:, 0]:
            speed = 0.9 * states[-1][1] + 0.2 * push + 0.02 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * speed, speed]))
        observations = np.array(states)
        found.append(Rollout(observations, actions, np.cos(observations[:-1, 0])))
    return found


class Push:
    """A constant action, whatever the noise; it records the states of every step."""

    def __init__(self, force: float = 1.0) -> None:
        self.force = force
        self.steps: list[FloatArray] = []

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        assert noise.shape == (len(states), 1)
        self.steps.append(states)
        return np.full((len(states), 1), self.force)


def always(termination: float, count: int) -> Terminations:
    """The same probability of a termination everywhere."""
    return Terminations(lambda s: np.full((len(s), 1), termination), np.zeros(count), 0.0)


def model_env(
    step: FloatArray | None = None,
    termination: float | None = None,
    loo_residuals: float = 0.0,
    **changes: Any,
) -> ModelEnv:
    """A process in which the scaled action times ``step`` is added to the state.

    It terminates with a given probability.  The residual of sample i is ``i + 1`` times
    ``loo_residuals``.
    """
    data = Transitions.from_rollouts(turns())
    slopes = np.atleast_2d([0.1, 0.02] if step is None else step)
    mean = LinearMean(np.array([2]), slopes, np.zeros(2))  # of the action alone
    rows = np.arange(len(data))[:, None]
    dynamics = Dynamics(
        DeltaStateTargets(np.ones(2), mean, TASK),
        lambda inputs: np.zeros((len(inputs), 2)),
        loo_residuals * (rows + 1.0) + np.zeros(2),
        None if termination is None else always(termination, len(data)),
    )
    kernel = Kernel(TASK.state_factors, np.array([0.5, 0.5]))
    return replace(ModelEnv(dynamics, data, kernel, TASK, 0.1, 0.0, 20, 0.0), **changes)


def as_set(states: FloatArray) -> set[tuple[float, ...]]:
    return {tuple(state) for state in states.tolist()}


# ---- visited states ---------------------------------------------------------------------------


def test_each_state_follows_from_one_before_and_the_first_are_starts() -> None:
    policy = Push(1.0)  # half the largest force: (0.05, 0.01) per step
    states, nearest = model_env().visited_states(policy, 100, np.random.default_rng(0))
    assert states.shape == (100, 2) and nearest.shape == (100,)
    np.testing.assert_array_equal(np.concatenate(policy.steps), states)
    first, *later = policy.steps
    assert as_set(first) == as_set(STARTS)
    for before, after in zip(policy.steps, later, strict=False):
        reachable = as_set(np.round(before + np.array([0.05, 0.01]), 9))
        assert as_set(np.round(after, 9)) <= reachable
        assert len(after) <= len(before)


def test_actions_are_clipped_to_their_limits() -> None:
    policy = Push(50.0)
    model_env().visited_states(policy, 40, np.random.default_rng(1))
    moved = np.unique(np.round(policy.steps[1] - STARTS[0], 9), axis=0)
    np.testing.assert_allclose(moved[-1], [0.1, 0.02])


@pytest.mark.parametrize("count", [1, 2, 17, 1000])
@pytest.mark.parametrize("p", [0.02, 0.5, 0.999])
def test_the_number_of_visited_states_is_as_given(count: int, p: float) -> None:
    env = model_env(restart_probability=p)
    states, nearest = env.visited_states(Push(), count, np.random.default_rng(count))
    assert len(states) == len(nearest) == count


def test_lengths_are_geometric_with_the_restart_probability() -> None:
    policy = Push()
    env = model_env(restart_probability=0.2, max_steps=1000)
    env.visited_states(policy, 40_000, np.random.default_rng(2))
    at_step = np.array([len(states) for states in policy.steps[:10]])
    np.testing.assert_allclose(at_step[1:] / at_step[:-1], 0.8, atol=0.03)


def test_no_rollout_is_longer_than_the_limit() -> None:
    policy = Push()
    env = model_env(restart_probability=0.001, max_steps=7)
    states, _ = env.visited_states(policy, 70, np.random.default_rng(3))
    assert len(policy.steps) == 7 and len(states) == 70
    assert {len(each) for each in policy.steps} == {10}


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_rollouts_begins_in_any_sampled_state(share: float) -> None:
    policy = Push()
    env = model_env(exploring_starts=share, restart_probability=0.5)
    env.visited_states(policy, 4000, np.random.default_rng(4))
    first = policy.steps[0]
    assert as_set(first) <= as_set(env.data.states)
    starts = as_set(STARTS)
    elsewhere = np.mean([tuple(s) not in starts for s in first])
    sampled = np.mean([tuple(s) not in starts for s in env.data.states])
    assert elsewhere == pytest.approx(share * sampled, abs=0.05)


def test_a_termination_ends_a_rollout() -> None:
    certain = model_env(termination=1.0, restart_probability=0.01)
    states, _ = certain.visited_states(Push(), 100, np.random.default_rng(5))
    assert as_set(states) == as_set(STARTS)
    assert len(states) < 30  # one of up to twenty steps of each rollout is left
    policy = Push()
    env = model_env(termination=0.5, restart_probability=1e-3, max_steps=1000)
    env.visited_states(policy, 10**6, np.random.default_rng(6))
    assert len(policy.steps[1]) / len(policy.steps[0]) == pytest.approx(0.5, abs=0.05)


def test_the_noise_is_the_residual_of_the_nearest_sample_with_either_sign() -> None:
    env, policy = model_env(loo_residuals=1e-3), Push()
    _, nearest = env.visited_states(policy, 200, np.random.default_rng(7))
    first, second = policy.steps[:2]
    rows = nearest[: len(first)]
    similarity = env.kernel.gram(first, env.data.states)
    np.testing.assert_array_equal(similarity[np.arange(len(first)), rows], similarity.max(axis=1))
    signs = set()
    for state in second:
        noise = state - first - [0.05, 0.01]
        mismatch = np.abs(np.abs(noise) - 1e-3 * (rows[:, None] + 1.0)).max(axis=1)
        assert mismatch.min() < 1e-9
        signs.add(np.sign(noise[mismatch.argmin(), 0]))
    assert signs == {-1.0, 1.0}


def test_states_are_clipped_to_the_range_of_the_data_except_for_angles() -> None:
    env = model_env(step=np.array([2.0, 1.0]))
    states, _ = env.visited_states(Push(2.0), 200, np.random.default_rng(8))
    speeds = env.data.points[:, 1]
    assert states[:, 1].max() == speeds.max()
    assert states[:, 0].max() > env.data.points[:, 0].max() + np.pi
    states, _ = env.visited_states(Push(-2.0), 200, np.random.default_rng(8))
    assert states[:, 1].min() == speeds.min()
    assert states[:, 0].min() < env.data.points[:, 0].min() - np.pi


def test_a_learnt_model_visits_the_states_to_which_the_policy_pushes() -> None:
    data = Transitions.from_rollouts(turns(20))
    rng = np.random.default_rng(9)
    kernel = state_kernel(data, TASK, rng)
    dynamics, *_ = fit_dynamics(data, kernel, TASK, None, rng)
    env = ModelEnv(dynamics, data, kernel, TASK, 0.02, 0.0, 20, 0.0)
    right, _ = env.visited_states(Push(2.0), 400, rng)
    left, _ = env.visited_states(Push(-2.0), 400, rng)
    assert right[:, 1].mean() > 0.5 and left[:, 1].mean() < -0.2
    # the speed would approach 4; the model does not extrapolate beyond the largest one observed
    assert right[:, 1].max() == pytest.approx(data.points[:, 1].max(), rel=0.3)


# ---- tasks with model rollouts ----------------------------------------------------------------


@pytest.mark.parametrize(("steps", "supported"), [(19, False), (20, True)])
def test_model_rollouts_need_ten_samples_per_coefficient(steps: int, supported: bool) -> None:
    data = Transitions.from_rollouts(turns(2, steps))
    # a constant, two coordinates of the state and one of the action: 40 samples
    assert supports_model_rollouts(data, TASK) == supported


def test_there_are_no_model_rollouts_in_images() -> None:
    image = TaskSpec(
        4, np.array([-1.0]), np.array([1.0]), groups=((0, 1, 2, 3),), image_shape=(2, 2)
    )
    data = Transitions.from_rollouts(
        [Rollout(np.zeros((5000, 4)), np.zeros((4999, 1)), np.zeros(4999))]
    )
    assert not supports_model_rollouts(data, image)
    assert supports_model_rollouts(data, replace(image, groups=(), image_shape=None))


# ---- evaluation -------------------------------------------------------------------------------


def angle(inputs: FloatArray, terminations: FloatArray) -> FloatArray:
    return inputs[:, 0]


def average_rewards(env: ModelEnv, policy: Any, reward: Any, count: int) -> FloatArray:
    rollouts = env.evaluate(policy, reward, count, np.random.default_rng(0))
    return average_reward(rollouts.rewards, env.restart_probability)


def test_a_step_counts_by_the_probability_that_no_restart_came_before_it() -> None:
    p, steps = 0.1, 20  # two mean lengths
    env = model_env(restart_probability=p)
    found = average_rewards(env, Push(1.0), angle, 40)
    share = p * (1 - p) ** np.arange(steps) / (1 - (1 - p) ** steps)
    wanted = STARTS[:, 0] + 0.05 * share @ np.arange(steps)  # each push turns the wheel by 0.05
    assert found.shape == (40,)
    np.testing.assert_allclose(np.unique(np.round(found, 9)), np.sort(np.round(wanted, 9)))


@pytest.mark.parametrize(("max_steps", "p", "steps"), [(7, 1e-6, 7), (20, 0.5, 4), (20, 0.3, 7)])
def test_an_evaluation_has_two_mean_lengths_up_to_the_longest_rollout(
    max_steps: int, p: float, steps: int
) -> None:
    policy = Push()
    env = model_env(restart_probability=p, max_steps=max_steps)
    rollouts = env.evaluate(policy, angle, 4, np.random.default_rng(0))
    assert len(policy.steps) == steps
    assert rollouts.rewards.shape == rollouts.similarity.shape == (steps, 4)


@pytest.mark.parametrize(("p", "steps"), [(0.0125, 160), (0.01, 200), (1e-3, 200)])
def test_an_evaluation_has_at_most_two_hundred_steps(p: float, steps: int) -> None:
    policy = Push()
    env = model_env(restart_probability=p, max_steps=5000)
    rollouts = env.evaluate(policy, angle, 2, np.random.default_rng(0))
    assert MAX_EVALUATION_STEPS == 200
    assert len(policy.steps) == len(rollouts.rewards) == steps


def test_rewards_are_those_of_the_applied_actions() -> None:
    env = model_env()
    found = average_rewards(env, Push(50.0), lambda inputs, _: inputs[:, 2], 3)
    np.testing.assert_allclose(found, 1.0)


def test_after_a_termination_nothing_more_is_earned() -> None:
    # each step earns 1, and a termination 5 more; zero is -2 in standardised units
    def reward(inputs: FloatArray, terminations: FloatArray) -> FloatArray:
        return 1.0 + 5.0 * terminations

    env = model_env(termination=1.0, end_reward=-2.0)
    found = env.evaluate(Push(), reward, 30, np.random.default_rng(0))
    np.testing.assert_array_equal(found.rewards[0], np.full(30, 6.0))
    np.testing.assert_array_equal(found.rewards[1:], np.full((19, 30), -2.0))
    assert not found.ended[0].any() and found.ended[1:].all()

    env = model_env(termination=0.25, end_reward=-2.0, max_steps=20)
    found = env.evaluate(Push(), reward, 4000, np.random.default_rng(0))
    shares = 1.0 - found.ended.mean(axis=1)
    np.testing.assert_allclose(shares, 0.75 ** np.arange(20), atol=0.03)
    np.testing.assert_array_equal(found.rewards, np.where(found.ended, -2.0, 2.25))


@pytest.mark.parametrize("seed", range(8))
def test_the_return_of_one_rollout_is_that_of_a_loop_over_its_steps(seed: int) -> None:
    """In plain arithmetic: policy, model, nearest sample, noise, limits, end and average."""
    p, termination, end_reward, unit = 0.1, 0.08, -2.0, 2e-3
    env = model_env(
        loo_residuals=unit, termination=termination, end_reward=end_reward, exploring_starts=0.5
    )

    class Feedback:
        """Against the speed, with noise."""

        def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
            return -3.0 * states[:, 1:] + np.sin(states[:, :1]) + 0.5 * noise

    def reward(inputs: FloatArray, terminations: FloatArray) -> FloatArray:
        return np.cos(inputs[:, 0]) - 0.1 * inputs[:, 2] ** 2 + 5.0 * terminations

    found = env.evaluate(Feedback(), reward, 1, np.random.default_rng(seed))

    rollouts, rng = turns(), np.random.default_rng(seed)
    samples = np.concatenate([r.observations[:-1] for r in rollouts])
    speeds = np.concatenate([r.observations[:, 1] for r in rollouts])
    start = rollouts[rng.choice(6, 1)[0]].observations[0]
    anywhere = samples[rng.choice(len(samples), 1)[0]]
    turn, speed = anywhere if rng.uniform() < 0.5 else start
    total = weights = 0.0
    going, lasted = True, 0
    for t in range(20):
        earned = end_reward
        if going:
            noise, coin, lot = rng.standard_normal(), rng.integers(2), rng.uniform()
            push = min(max(-3.0 * speed + np.sin(turn) + 0.5 * noise, -2.0), 2.0) / 2.0
            earned = np.cos(turn) - 0.1 * push**2 + 5.0 * termination
            chords = 2.0 * np.sin(0.5 * (samples[:, 0] - turn))
            nearest = int(np.argmin(chords**2 + (samples[:, 1] - speed) ** 2))
            residual = (1 - 2 * coin) * unit * (nearest + 1)
            turn += 0.1 * push + residual
            speed = min(max(speed + 0.02 * push + residual, speeds.min()), speeds.max())
            going, lasted = lot >= termination, t + 1
        total += (1.0 - p) ** t * earned
        weights += (1.0 - p) ** t
    assert np.count_nonzero(~found.ended) == lasted
    np.testing.assert_allclose(average_reward(found.rewards, p), [total / weights], rtol=1e-9)


def test_without_a_termination_no_rollout_ends() -> None:
    found = model_env(end_reward=-2.0).evaluate(Push(), angle, 30, np.random.default_rng(0))
    assert not found.ended.any()


def test_rollouts_from_one_seed_have_common_random_numbers() -> None:
    env = model_env(loo_residuals=1e-2, termination=0.3, exploring_starts=0.5)

    def found(force: float, seed: int = 0) -> tuple[ModelRollouts, FloatArray]:
        policy = Push(force)
        rollouts = env.evaluate(policy, angle, 20, np.random.default_rng(seed))
        return rollouts, policy.steps[0]

    (one, starts), (again, _), (other, other_starts) = found(-1.0), found(-1.0), found(1.0)
    np.testing.assert_array_equal(again.rewards, one.rewards)
    np.testing.assert_array_equal(again.similarity, one.similarity)
    np.testing.assert_array_equal(again.ended, one.ended)
    # another policy has the same starts, and ends where ends do not depend on it
    np.testing.assert_array_equal(other_starts, starts)
    np.testing.assert_array_equal(other.ended, one.ended)
    assert 0 < one.ended.sum() < one.ended.size
    assert not np.allclose(other.rewards, one.rewards)
    with_other_numbers, _ = found(-1.0, seed=1)
    assert not np.allclose(with_other_numbers.rewards, one.rewards)
