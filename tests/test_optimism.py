"""What is not known is thought to be good, and what is known is not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms.generated import imagine
from kreps.data.rollout import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.models.model_env import Followed
from kreps.models.novelty import HIGHEST, KEPT, LEAST, Optimism, known_distance, optimism_of
from kreps.models.world_model import Outlook

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]))
KERNEL = Kernel(TASK.state_factors, np.array([0.5, 2.0]))


def rollouts(count: int, seed: int = 0) -> list[Rollout]:
    rng = np.random.default_rng(seed)
    return [
        Rollout(rng.standard_normal((n + 1, 2)), np.zeros((n, 1)), rng.standard_normal(n))
        for n in rng.integers(3, 9, count)
    ]


def simulator(data: Transitions) -> Any:
    return SimpleNamespace(data=data, kernel=KERNEL)


def half_squared_distance(a: np.ndarray, b: np.ndarray) -> float:
    return 0.5 * float(np.sum(((a - b) / KERNEL.lengthscales) ** 2))


def test_nearly_all_samples_have_one_of_another_rollout_within_the_known_distance() -> None:
    made = rollouts(6)
    nearest = [
        min(half_squared_distance(s, t) for o in made if o is not r for t in o.observations[:-1])
        for r in made
        for s in r.observations[:-1]
    ]
    likeness = np.exp(-np.array(nearest))
    found = known_distance(simulator(Transitions.of(made)))
    assert found == pytest.approx(-np.log(np.quantile(likeness, 0.1)), rel=1e-9)
    assert np.mean(np.array(nearest) <= found) == pytest.approx(0.9, abs=0.03)


def test_samples_that_are_drawn_keep_their_rollouts() -> None:
    made = rollouts(40)
    whole = Transitions.of(made)
    chosen = np.arange(0, len(whole), 3)
    drawn = whole.rows(chosen)
    likeness = KERNEL.gram(drawn.states, drawn.states)
    likeness[whole.rollout[chosen, None] == whole.rollout[chosen]] = 0.0
    wanted = -np.log(np.quantile(likeness.max(axis=1), 0.1))
    assert known_distance(simulator(drawn)) == pytest.approx(wanted, rel=1e-12)
    # the same roll-outs, drawn from chunk by chunk
    first = Transitions.of(made[:20])
    chunks = first, Transitions.of(made[20:])
    parts = [
        chunk.rows(chosen[(chosen >= i) & (chosen < i + len(chunk))] - i)
        for chunk, i in zip(chunks, (0, len(first)), strict=True)
    ]
    assert all(len(part) for part in parts)
    assert known_distance(simulator(Transitions.joined(parts))) == pytest.approx(wanted, rel=1e-12)
    assert known_distance(simulator(Transitions.joined(chunks))) == known_distance(simulator(whole))


def test_in_panels_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    data = simulator(Transitions.of(rollouts(9)))
    whole = known_distance(data)
    monkeypatch.setattr("kreps.algorithms.optimism.AT_ONCE", 7)
    assert known_distance(data) == pytest.approx(whole, rel=1e-9)


def outlook_of(optimism: Optimism | None, simulator: Any) -> Outlook:
    """Of two features, where the model says that nothing moves and nothing is earned."""
    return Outlook(
        states=np.zeros((2, 2)),
        features=np.zeros((2, 2)),
        features_at=lambda states: states,
        restart=np.array([3.0, -1.0]),
        rewards=np.array([-3.0, 0.0]),
        expect=lambda rows, inputs: inputs[:, :2],
        reward=lambda given: np.zeros((len(given), 1)),
        simulator=simulator,
        optimism=optimism,
    )


def test_where_an_action_leads_is_unknown_but_not_beyond_a_real_end() -> None:
    alike, ends = np.array([1.0, 0.0, 0.0, 0.0]), np.array([[0.0], [0.0], [1.0], [0.25]])
    inputs = np.ones((4, 3))
    process = SimpleNamespace(
        dynamics=SimpleNamespace(predicted=lambda given: (given[:, :2] + 1.0, ends)),
        nearest=lambda states: (None, np.where((states == 2.0).all(axis=1), alike, np.nan)),
    )
    outlook = outlook_of(Optimism(hoped=0.0, gain=-2.0, edge=0.5), process)
    np.testing.assert_allclose(outlook.unknown_of(inputs), [0.0, 1.0, 0.0, 0.75])
    for blind in (replace(outlook, simulator=None), replace(outlook, optimism=None)):
        np.testing.assert_array_equal(blind.unknown_of(inputs), np.zeros(4))


def test_to_the_update_the_unknown_is_earned_at_once_and_followed_by_a_restart() -> None:
    class Halfway:
        """A simulator of which every second imagined action leads to the unknown."""

        dynamics = SimpleNamespace(predicted=lambda inputs: (inputs[:, :2], np.zeros((4, 1))))

        def nearest(self, states: FloatArray) -> tuple[None, FloatArray]:
            return None, np.array([1.0, 0.0, 1.0, 0.0])

    class Still:
        def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
            return np.zeros((len(states), 1))

    settings = kreps.Settings(imagined=2, imagined_rollouts=0.0)
    weights = np.array([0.5, 0.5])
    sober, hopeful = (
        imagine(
            outlook_of(hope, Halfway()),
            weights,
            Still(),
            TASK,
            settings,
            0.1,
            np.random.default_rng(0),
        ).problem
        for hope in (None, Optimism(hoped=1.0, gain=-1.0, edge=0.5))
    )
    p = settings.restart_probability
    gained = hopeful.rewards - hopeful.rewards.min()
    np.testing.assert_allclose(gained, [0.0, 2.0 * (1.0 - p) / p] * 2)
    assert hopeful.rewards.max() == 0.0 and not sober.rewards.any()
    np.testing.assert_array_equal(hopeful.differences[::2], sober.differences[::2])
    # own features are zero, so that this is a restart for certain
    np.testing.assert_allclose(hopeful.differences[1::2], [[3.0, -1.0]] * 2)


def test_one_rollout_says_nothing_of_what_is_known() -> None:
    alone = simulator(Transitions.of(rollouts(1)))
    assert known_distance(alone) is None
    assert optimism_of(alone, np.arange(3.0), np.ones(3) / 3, 0, kreps.Settings()) is None


def test_equal_states_leave_an_edge_above_zero() -> None:
    same = [Rollout(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3))] * 3
    found = known_distance(simulator(Transitions.of(same)))
    assert found is not None and found > 0.0
    unknown = Optimism(1.0, 0.0, found).unknown(np.array([1.0, 0.99, 0.0]))
    np.testing.assert_array_equal(unknown, [0.0, 1.0, 1.0])


def test_what_is_far_from_any_sample_is_unknown_and_what_is_near_is_not() -> None:
    far = np.array([[0.0, 0.5, 0.6, 1.0], [2.0, 50.0, 1e4, 0.4]])
    found = Optimism(hoped=1.0, gain=0.0, edge=0.5).unknown(np.exp(-far))
    wanted = 1.0 - np.exp(-np.maximum(far - 0.5, 0.0) / 0.5)
    np.testing.assert_allclose(found, wanted, atol=1e-14)
    assert found[0, :2].tolist() == [0.0, 0.0] and found[1, 2] == 1.0


def test_the_surplus_is_that_of_all_steps_until_the_restart() -> None:
    hope = Optimism(hoped=-0.5, gain=-2.0, edge=0.5)
    steps = 0.9 ** np.arange(1, 2000)  # beginning with the one after the action
    assert hope.surplus(0.1) == pytest.approx(1.5 * steps.sum(), rel=1e-12)


def test_who_has_found_the_unknown_stays_there() -> None:
    hope = Optimism(hoped=7.0, gain=0.0, edge=0.5)
    known, unknown, half = 1.0, 0.0, np.exp(-0.5 * (1.0 + np.log(2.0)))
    likeness = np.array([[known, known], [known, half], [unknown, known], [known, known]])
    rewards = np.arange(8.0).reshape(4, 2)
    never = np.zeros((4, 2), dtype=bool)
    found = hope.hoped_rewards(Followed(rewards, likeness, never))
    still = (7.0 + 7.0) / 2
    wanted = [[0.0, 1.0], [2.0, (3.0 + 7.0) / 2], [7.0, (5.0 + 7.0) / 2], [7.0, still]]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    # after a real end it begins anew
    ended = never.copy()
    ended[2] = True
    found = hope.hoped_rewards(Followed(rewards, likeness, ended))
    np.testing.assert_allclose(found, [*wanted[:3], [6.0, 7.0]], rtol=1e-12)


def test_optimism_falls_at_each_update_and_ends() -> None:
    data = simulator(Transitions.of(rollouts(5)))
    settings = kreps.Settings(optimism=0.5)
    rewards, weights = np.arange(9.0), np.eye(9)[2]
    hoped = []
    while (hope := optimism_of(data, rewards, weights, len(hoped), settings)) is not None:
        assert hope.gain == 2.0
        hoped.append(hope.hoped)
    best = rewards.max()
    strengths = (np.array(hoped) - 2.0) / (best - 2.0)
    np.testing.assert_allclose(strengths, 0.5 * KEPT ** np.arange(len(hoped)))
    assert strengths[-1] >= LEAST > KEPT * strengths[-1]
    assert optimism_of(None, rewards, weights, 0, settings) is None
    assert optimism_of(data, rewards, weights, 0, replace(settings, optimism=0.0)) is None


def test_who_earns_the_best_hopes_for_no_less() -> None:
    data = simulator(Transitions.of(rollouts(5)))
    rewards, weights = np.array([0.0] * 99 + [100.0]), np.eye(100)[-1]
    hope = optimism_of(data, rewards, weights, 0, kreps.Settings())
    assert hope is not None and hope.hoped == hope.gain == 100.0


def test_a_seldom_goal_is_not_hoped_for_everywhere() -> None:
    data = simulator(Transitions.of(rollouts(5)))
    often, seldom = np.array([0.0, 1.0] * 50), np.array([0.0] * 99 + [100.0])
    settings, weights = kreps.Settings(optimism=1.0), np.full(100, 0.01)
    hopes = [optimism_of(data, rewards, weights, 0, settings) for rewards in (often, seldom)]
    assert [hope.hoped for hope in hopes if hope is not None] == [
        1.0,
        pytest.approx(seldom.mean() + HIGHEST * seldom.std()),
    ]


def visited_height(optimism: float) -> float:
    """The angle from the top that an eighth of the second batch's states are within."""
    learner = kreps.KREPS(
        gym.make("kreps/SwingUp-v0"), seed=248, exploration="gaussian", optimism=optimism
    )
    learner.learn(2, progress=False)
    newest = learner.state.window.rollouts[-10:]
    angles = np.abs(np.concatenate([rollout.observations[:, 0] for rollout in newest]))
    return float(np.quantile(angles, 0.125))


def test_an_optimist_goes_where_it_has_not_been() -> None:
    # white noise showed nothing of the height, and what was learnt of that holds the lean
    assert visited_height(0.0) > 1.6
    assert visited_height(kreps.Settings().optimism) < 1.4
