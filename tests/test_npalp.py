"""NPALP: its fixed point against the linear program, and its policy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.distance import cdist

from kreps.algorithms import npalp
from kreps.algorithms.npalp import NPALPInfo, sample_bounds
from kreps.algorithms.state import LearnerState
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.kernel import Kernel
from kreps.policies.value_based import LipschitzPolicy
from kreps.settings import NPALPSettings

TASK = TaskSpec(2, [-2.0, 0.0], [2.0, 10.0], periodic=(0,))


def rollouts_of(
    seed: int, count: int = 4, steps: int = 4, terminated: bool = False
) -> list[Rollout]:
    """Random points, actions and rewards; the actions are often beyond the limits."""
    rng = np.random.default_rng(seed)
    return [
        Rollout(
            rng.normal(size=(steps + 1, 2)),
            rng.normal(0.0, 8.0, size=(steps, 2)),
            rng.normal(-5.0, 3.0, size=steps),
            terminated,
        )
        for _ in range(count)
    ]


def learn_policy(rollouts: list[Rollout], **changes: float) -> LipschitzPolicy:
    chosen = NPALPSettings(**changes)  # type: ignore[arg-type]
    state = LearnerState(ReplayWindow(TASK, 30))
    new, _ = npalp.update(state, rollouts, TASK, chosen, np.random.default_rng(0))
    assert isinstance(new.policy, LipschitzPolicy)
    return new.policy


def random_policy(fraction: float = 0.3, scale: float = 0.2, count: int = 40) -> LipschitzPolicy:
    """A policy on random samples."""
    rng = np.random.default_rng(5)
    return LipschitzPolicy(
        task=TASK,
        kernel=Kernel(TASK.state_factors, np.array([0.7, 1.3])),
        states=np.column_stack([rng.uniform(-np.pi, np.pi, count), rng.normal(size=count)]),
        actions=TASK.unscaled(rng.uniform(-1.0, 1.0, (count, 2))),
        bounds=rng.normal(-20.0, 2.0, count),
        slope=3.0,
        noise_fraction=fraction,
        noise_scale=scale,
    )


def linear_program(
    distances: FloatArray,
    state: IntArray,
    successor: list[int | None],
    rewards: FloatArray,
    gamma: float,
    slope: float,
) -> FloatArray:
    """V at all points: the program as printed, with a constraint per pair of points."""
    count = len(distances)
    left, right = [], []
    for s, after, reward in zip(state, successor, rewards, strict=True):
        row = np.zeros(count)
        row[s] -= 1.0
        if after is not None:  # V after a termination is that of reward zero
            row[after] += gamma
        left.append(row)
        right.append(-reward)
    for a in range(count):
        for b in range(count):
            if a != b:
                row = np.zeros(count)
                row[a], row[b] = 1.0, -1.0
                left.append(row)
                right.append(slope * distances[a, b])
    found = linprog(np.ones(count), np.array(left), right, bounds=(None, None), method="highs")
    assert found.status == 0, found.message
    return np.asarray(found.x)


# ---- the fixed point --------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0.2, 2.0, 20.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_bounds_solve_the_linear_program(seed: int, slope: float) -> None:
    data = Transitions.from_rollouts(rollouts_of(seed))
    distances = cdist(data.points, data.points)
    q, _, _ = sample_bounds(
        data.rewards,
        np.full(len(data), 0.9),
        slope * distances[np.ix_(data.successor, data.state)],
    )
    values = (q - slope * distances[:, data.state]).max(axis=1)
    successor: list[int | None] = data.successor.tolist()
    wanted = linear_program(distances, data.state, successor, data.rewards, 0.9, slope)
    np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_an_update_solves_the_linear_program_of_its_window(seed: int) -> None:
    rollouts = rollouts_of(seed, 2) + rollouts_of(seed + 100, 2, terminated=True)
    policy = learn_policy(rollouts, restart_probability=0.1, lipschitz=1.5)
    data = Transitions.from_rollouts(rollouts)
    successor: list[int | None] = data.successor.tolist()
    successor[11] = successor[15] = None
    points = policy.kernel.embed(data.points)
    wanted = linear_program(
        cdist(points, points),
        data.state,
        successor,
        data.rewards,
        0.9,
        1.5 * data.rewards.std(),
    )
    assert policy.slope == pytest.approx(1.5 * data.rewards.std())
    np.testing.assert_allclose(policy.value(data.points), wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("slope", [0.0, 0.5, 10.0, 1e4])
@pytest.mark.parametrize("gamma", [0.5, 0.98])
def test_the_bounds_are_the_limit_of_fixed_point_iteration(gamma: float, slope: float) -> None:
    data = Transitions.from_rollouts(rollouts_of(7, 8, 10))
    costs = slope * cdist(data.points[data.successor], data.states)
    q, improvements, residual = sample_bounds(data.rewards, np.full(len(data), gamma), costs)
    wanted = np.zeros(len(q))
    for _ in range(2500):
        wanted = data.rewards + gamma * (wanted - costs).max(axis=1)
    np.testing.assert_allclose(q, wanted, rtol=1e-9, atol=1e-8)
    assert residual <= 1e-9 * max(1.0, slope)
    assert 1 <= improvements < 50


def test_after_a_termination_nothing_more_is_earned() -> None:
    """With a slope so steep that no sample bounds V at another state."""
    gamma = 0.9
    long = Rollout([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], np.zeros((2, 2)), [1.0, 2.0], True)
    short = Rollout([[0.0, 9.0], [1.0, 9.0]], np.zeros((1, 2)), [-1.0], True)
    wanted = {"long": [1.0 + gamma * 2.0, 2.0], "short": [-1.0]}
    for order in (("long", "short"), ("short", "long")):
        rollouts = [{"long": long, "short": short}[name] for name in order]
        policy = learn_policy(rollouts, lipschitz=1e6, restart_probability=0.1)
        expected = np.concatenate([wanted[name] for name in order])
        np.testing.assert_allclose(policy.bounds, expected, rtol=1e-9)
    cut_off = learn_policy([long, replace(short, terminated=False)], lipschitz=1e6)
    assert cut_off.bounds[2] < -1000.0  # its successor is far from every sample


def test_bounds_scale_and_shift_with_the_reward() -> None:
    rollouts = rollouts_of(3)
    plain = learn_policy(rollouts, restart_probability=0.1)
    moved = learn_policy(
        [replace(r, rewards=7.0 * r.rewards + 3.0) for r in rollouts], restart_probability=0.1
    )
    np.testing.assert_allclose(moved.bounds, 7.0 * plain.bounds + 3.0 / 0.1, rtol=1e-9)
    assert moved.slope == pytest.approx(7.0 * plain.slope)
    states = np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_array_equal(moved.greedy(states), plain.greedy(states))


@pytest.mark.parametrize(
    ("residual", "note"), [(0.0, ""), (1e-9, ""), (1.1e-9, "NOT CONVERGED"), (1.0, "NOT CONVERGED")]
)
def test_a_residual_above_rounding_is_shown_as_not_converged(residual: float, note: str) -> None:
    info = NPALPInfo(samples=20, improvements=1000, residual=residual, seconds={})
    assert info.shown()["note"] == note
    assert info.converged == (note == "")
    assert info.numbers() == {"improvements": 1000, "residual": residual}


def test_too_few_improvements_leave_a_residual() -> None:
    data = Transitions.from_rollouts(rollouts_of(7, 8, 10))
    costs = 0.5 * cdist(data.points[data.successor], data.states)
    gamma = np.full(len(data), 0.98)
    _, improvements, residual = sample_bounds(data.rewards, gamma, costs, max_improvements=2)
    assert improvements == 2
    assert residual > 1e-3


# ---- the value function -----------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_the_value_function_is_lipschitz_along_random_segments(
    seed: int, log_length: float
) -> None:
    policy, rng = random_policy(), np.random.default_rng(seed)
    start, direction = rng.normal(size=(2, 2))
    path = start + np.linspace(0.0, 10.0**log_length, 200)[:, None] * direction
    values, embedded = policy.value(path), policy.kernel.embed(path)
    steps = np.linalg.norm(np.diff(embedded, axis=0), axis=1)
    assert (np.abs(np.diff(values)) <= policy.slope * steps + 1e-9).all()
    across = np.linalg.norm(embedded[-1] - embedded[0])
    assert abs(values[-1] - values[0]) <= policy.slope * across + 1e-9


def test_the_lipschitz_constant_is_attained() -> None:
    policy = random_policy()
    path = np.linspace([0.0, 3.0], [0.0, 6.0], 50)  # away from all samples
    steps = np.linalg.norm(np.diff(policy.kernel.embed(path), axis=0), axis=1)
    assert np.abs(np.diff(policy.value(path))).max() > 0.9 * policy.slope * steps.max()
    np.testing.assert_allclose(
        policy.value(path), policy.value(path + np.array([2.0 * np.pi, 0.0]))
    )


def test_the_value_is_the_maximum_of_the_bounds() -> None:
    for policy in (random_policy(), learn_policy(rollouts_of(1, 6, 10), lipschitz=2.0)):
        above = policy.value(policy.states) - policy.bounds
        assert (above >= -1e-9).all()
        assert np.abs(above).min() < 1e-9  # the smallest such function
        assert above.max() > 0.1  # not every bound is attained


def test_many_states_at_once_are_the_same_as_one_by_one() -> None:
    policy = random_policy()
    states = np.random.default_rng(1).normal(size=(5000, 2))
    values, actions = policy.value(states), policy.greedy(states)
    assert values.shape == (5000,) and actions.shape == (5000, 2)
    for i in [0, 1, 2047, 2048, 4999]:
        assert policy.value(states[i : i + 1])[0] == pytest.approx(values[i], rel=1e-12)
        np.testing.assert_array_equal(policy.greedy(states[i : i + 1])[0], actions[i])


# ---- the actions ------------------------------------------------------------------------------


def test_the_greedy_action_is_that_of_the_maximising_sample() -> None:
    policy = random_policy()
    chosen = set()
    for state in np.random.default_rng(2).uniform(-3.0, 3.0, (100, 2)):
        e = policy.kernel.embed(state[None])[0]
        bounds = [
            q - policy.slope * float(np.linalg.norm(e - policy.kernel.embed(s[None])[0]))
            for q, s in zip(policy.bounds, policy.states, strict=True)
        ]
        best = int(np.argmax(bounds))
        np.testing.assert_array_equal(policy.greedy(state[None])[0], policy.actions[best])
        chosen.add(best)
    assert len(chosen) > 5


def test_the_actions_of_the_policy_are_the_applied_ones_of_the_samples() -> None:
    rollouts = rollouts_of(4)
    policy = learn_policy(rollouts)
    commanded = np.concatenate([r.actions for r in rollouts])
    np.testing.assert_array_equal(policy.actions, np.clip(commanded, [-2.0, 0.0], [2.0, 10.0]))
    assert not np.array_equal(policy.actions, commanded)


@pytest.mark.parametrize("fraction", [0.1, 0.3, 0.8, 1.0])
def test_a_fraction_of_the_actions_has_gaussian_noise(fraction: float) -> None:
    policy, count = random_policy(fraction, scale=0.2), 20_000
    states = np.tile([0.3, -0.2], (count, 1))
    noise = np.random.default_rng(11).standard_normal((count, 2))
    added = policy.act(states, noise) - policy.greedy(states)
    noisy = (added != 0.0).any(axis=1)
    assert scipy.stats.binomtest(int(noisy.sum()), count, fraction).pvalue > 1e-3
    for column, scale in enumerate(0.2 * np.array([2.0, 5.0])):
        drawn = added[noisy, column]
        assert scipy.stats.kstest(drawn / scale, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(added[noisy].T)[0, 1]) < 4.0 / np.sqrt(noisy.sum())


def test_without_noise_all_actions_are_greedy() -> None:
    policy = random_policy(0.0)
    states, noise = np.random.default_rng(12).normal(size=(2, 500, 2))
    with np.errstate(all="raise"):
        actions = policy.act(states, noise)
    np.testing.assert_array_equal(actions, policy.greedy(states))
    assert np.isfinite(actions).all()


def test_noise_on_every_action_includes_the_far_tails() -> None:
    policy = random_policy(1.0)
    states, noise = np.random.default_rng(13).normal(size=(2, 500, 2))
    noise[:4, 0] = [8.0, -8.0, 0.0, -30.0]  # far tails
    with np.errstate(all="raise"):
        added = policy.act(states, noise) - policy.greedy(states)
    np.testing.assert_allclose(added[4:], 0.2 * np.array([2.0, 5.0]) * noise[4:], atol=1e-9)
    assert np.isfinite(added).all()
    assert added[3, 0] == pytest.approx(0.2 * 2.0 * -30.0)


def test_the_policy_has_the_noise_of_the_settings() -> None:
    policy = learn_policy(rollouts_of(0), noise_fraction=0.0, noise_scale=0.7)
    assert (policy.noise_fraction, policy.noise_scale) == (0.0, 0.7)
