"""Generated samples: their states and actions, and what the model predicts for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.generated import GeneratedSamples, StateSource, generate, split_budget
from kreps.algorithms.model_based import world_model
from kreps.algorithms.reps import Step, reps_step
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray
from kreps.models.novelty import NoveltyBonus
from kreps.models.reward_model import RewardModel
from kreps.models.transition import feature_differences, state_actions
from kreps.models.world_model import WorldModel
from kreps.presets import settings_of
from kreps.settings import ModelBased, Settings

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]))


def pushes(rollouts: int = 8, steps: int = 15, seed: int = 0) -> list[Rollout]:
    """A mass with friction on a line, pushed at random, often beyond the limits.

    Every second rollout terminates.
    """
    rng = np.random.default_rng(seed)
    found = []
    for number in range(rollouts):
        states = [np.array([rng.normal(), 0.0])]
        actions = rng.normal(0.0, 2.0, size=(steps, 1))
        for force in TASK.clip(actions)[:, 0]:
            velocity = 0.9 * states[-1][1] + 0.3 * force + 0.05 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * velocity, velocity]))
        observations = np.array(states)
        rewards = -(observations[:-1, 0] ** 2) - 0.1 * observations[:-1, 1] ** 2
        rewards -= 0.01 * TASK.clip(actions)[:, 0] ** 2
        found.append(Rollout(observations, actions, rewards, number % 2 == 0))
    return found


@dataclass
class GivenActions:
    """A policy with given actions, which records the states and the noise."""

    actions: FloatArray
    states: FloatArray | None = None
    noise: FloatArray | None = None

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        assert noise.shape == self.actions.shape
        self.states, self.noise = states, noise
        return self.actions


@dataclass(frozen=True)
class Case:
    """The learnt model of 120 samples, after Algorithm 1."""

    batch: ExactBatch
    step: Step
    world: WorldModel

    @classmethod
    def learnt(cls, **changes: Any) -> Case:
        settings = settings_of(**changes)
        rollouts, rng = pushes(), np.random.default_rng(5)
        state = LearnerState(ReplayWindow(TASK, 30))
        batch = ExactBatch(state.append(rollouts), rollouts, settings, Stopwatch())
        step = reps_step(batch, state, 0.05, rng)
        return cls(batch, step, world_model(batch, step, state, rng)[0])

    def generate(
        self,
        policy: Any,
        weights: FloatArray | None = None,
        source: StateSource = StateSource.REPLAY,
        tested: bool = False,
        regression: Callable[[FloatArray], FloatArray] | None = None,
        **changes: Any,
    ) -> GeneratedSamples:
        """With uniform weights, if none are given, a ridge of 0.3, and without a bonus.

        Args:
            regression: of the reward, in place of the learnt one and without terminations.
        """
        n = len(self.world.states)
        world = replace(self.world, bonus=None)
        if regression is not None:
            without = replace(world.reward_model, regression=regression, at_termination=0.0)
            world = replace(world, reward_model=without)
        return generate(
            world,
            np.full(n, 1.0 / n) if weights is None else weights,
            policy,
            source,
            settings_of(self.batch.settings, **changes),
            0.3,
            tested,
            np.random.default_rng(6),
        )


def replayed(actions_per_state: int, **changes: Any) -> dict[str, Any]:
    """Settings with all actions in replayed states."""
    fraction = {"model_based.model_rollout_fraction": 0.0}
    return {"model_based.actions_per_state": actions_per_state, **fraction, **changes}


# ---- predictions ------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["change", "embedding"])
def test_sampled_actions_have_the_differences_and_rewards_of_the_first_step(model: Any) -> None:
    case = Case.learnt(model=model)
    data, world = case.batch.data, case.world
    found = case.generate(GivenActions(data.actions), **replayed(1))
    np.testing.assert_array_equal(found.states[found.state_of], data.states)
    np.testing.assert_array_equal(found.actions, data.actions)
    p = case.batch.settings.p
    wanted = feature_differences(world.features, case.step.model.expected, world.restart, p)
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(found.problem.differences, wanted, atol=1e-8)
    assert world.terminations is not None
    ends = world.terminations(state_actions(data, TASK))
    np.testing.assert_allclose(found.terminations, ends, atol=1e-8)
    predicted = world.reward_model(state_actions(data, TASK), ends)
    np.testing.assert_allclose(found.problem.rewards, predicted, atol=1e-8)
    np.testing.assert_array_equal(found.rewards, found.problem.rewards)  # there is no bonus
    assert np.corrcoef(predicted, case.batch.rewards)[0, 1] > 0.9


def test_bounds_and_ridge_are_those_of_the_settings() -> None:
    case = Case.learnt(kl_bound=0.4, eta_floor=0.07)
    n = len(case.world.states)
    policy = GivenActions(np.zeros((3 * n, 1)))
    problem = case.generate(policy, **replayed(3)).problem
    assert (problem.kl_bound, problem.eta_floor) == (0.4, 0.07)
    assert problem.ridge == pytest.approx(0.3 / (3 * n), rel=1e-12)
    assert case.generate(policy, **replayed(3, eta_floor=0.0)).problem.eta_floor == 1e-6
    for tested, floor in [(True, 0.01), (False, 0.05)]:
        found = case.generate(policy, tested=tested, **replayed(3, eta_floor=None))
        assert found.problem.eta_floor == floor


def test_the_model_predicts_for_the_applied_actions_and_the_samples_are_commanded_ones() -> None:
    case = Case.learnt(model="change")
    n = len(case.world.states)
    commanded = np.linspace(-5.0, 5.0, n)[:, None]
    recorded: list[FloatArray] = []

    def regression(inputs: FloatArray) -> FloatArray:
        recorded.append(inputs)
        return np.zeros((len(inputs), 1))

    found = case.generate(GivenActions(commanded), regression=regression, **replayed(1))
    np.testing.assert_array_equal(found.actions, commanded)
    (inputs,) = recorded
    np.testing.assert_array_equal(inputs[:, :2], case.world.states)
    np.testing.assert_allclose(inputs[:, 2], np.clip(commanded[:, 0], -2.0, 2.0) / 2.0)


def test_expected_rewards_are_clipped_to_the_observed_range() -> None:
    case = Case.learnt(model="change")
    n, rewards = len(case.world.states), case.batch.rewards
    overshooting = np.linspace(-100.0, 100.0, n)
    found = case.generate(
        GivenActions(np.zeros((n, 1))),
        regression=lambda inputs: overshooting[:, None],
        **replayed(1),
    ).problem.rewards
    assert (found.min(), found.max()) == (rewards.min(), rewards.max())
    wanted = np.clip(rewards.mean() + overshooting, rewards.min(), rewards.max())
    np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.parametrize("scale", [0.5, 3.0, 50.0])
def test_rewards_of_any_actions_are_within_the_observed_range(scale: float) -> None:
    case = Case.learnt(model="change")
    actions = scale * np.random.default_rng(7).normal(size=(5 * len(case.world.states), 1))
    rewards = case.generate(GivenActions(actions), **replayed(5)).problem.rewards
    assert rewards.max() <= case.batch.rewards.max()
    assert rewards.min() >= case.batch.rewards.min()


# ---- states and actions -----------------------------------------------------------------------


def test_replayed_states_are_resampled_by_their_weights() -> None:
    case = Case.learnt(model="change")
    n = len(case.world.states)
    weights = np.zeros(n)
    weights[[3, 11]] = 0.25, 0.75
    policy = GivenActions(np.zeros((2 * n, 1)))
    found = case.generate(policy, weights, **replayed(2))
    np.testing.assert_array_equal(found.states, case.world.states[[3, 11]])
    np.testing.assert_array_equal(np.bincount(found.state_of), [n // 2, 3 * n // 2])
    np.testing.assert_array_equal(policy.states, found.states[found.state_of])


@pytest.mark.parametrize("tested", [True, False])
def test_the_standard_deviation_is_inflated_only_with_an_acceptance_test(tested: bool) -> None:
    case = Case.learnt(model="change")
    n = len(case.world.states)
    policy = GivenActions(np.zeros((20 * n, 1)))
    settings = replayed(20, **{"model_based.proposal_std_scale": 1.7})
    case.generate(policy, tested=tested, **settings)
    assert policy.noise is not None
    assert np.std(policy.noise) == pytest.approx(1.7 if tested else 1.0, rel=0.05)


class VisitedStates:
    """A model whose rollouts visit three states, next to the samples 4, 0 and 2."""

    states = np.array([[0.3, 0.1], [0.7, -0.4], [-0.2, 0.9]])
    nearest = np.array([4, 0, 2])

    def visited_states(self, policy: Any, count: int, rng: Any) -> tuple[FloatArray, Any]:
        return self.states, self.nearest


@pytest.mark.parametrize("source", list(StateSource))
def test_states_have_their_own_features_and_the_noise_of_the_nearest_sample(
    source: StateSource,
) -> None:
    case = Case.learnt()
    world, n = case.world, len(case.world.states)
    recorded: list[tuple[Any, FloatArray]] = []

    def expected_features(rows: Any, inputs: FloatArray) -> FloatArray:
        recorded.append((rows, inputs))
        return world.expected_features(rows, inputs)

    model_env: Any = VisitedStates()
    changes = {"model_based.actions_per_state": 2, "model_based.model_rollout_fraction": 0.25}
    settings = settings_of(**changes)
    visited = round(0.25 * 2 * n)
    count = visited if source is StateSource.MODEL_ROLLOUT else 2 * n - visited
    found = generate(
        replace(world, model_env=model_env, bonus=None, expected_features=expected_features),
        np.full(n, 1.0 / n),
        GivenActions(np.ones((count, 1))),
        source,
        settings,
        0.3,
        True,
        np.random.default_rng(0),
    )
    [(rows, inputs)] = recorded
    assert len(rows) == len(found.actions) == count
    if source is StateSource.MODEL_ROLLOUT:
        np.testing.assert_array_equal(found.states, VisitedStates.states)
        np.testing.assert_array_equal(np.bincount(found.state_of), np.full(3, visited / 3))
        np.testing.assert_array_equal(rows, np.repeat(VisitedStates.nearest, visited // 3))
    else:
        np.testing.assert_array_equal(world.states[rows], found.states[found.state_of])
    np.testing.assert_array_equal(inputs[:, :2], found.states[found.state_of])
    wanted = feature_differences(
        world.phi(found.states[found.state_of]),
        world.expected_features(rows, inputs),
        world.restart,
        settings.p,
    )
    np.testing.assert_allclose(found.problem.differences, wanted, atol=1e-7)
    # the noise of another sample would give other features
    other = world.expected_features(np.zeros_like(rows), inputs)
    assert np.abs(other - world.expected_features(rows, inputs)).max() > 5e-5


# ---- numbers of actions -----------------------------------------------------------------------


def still_world(model_env: Any, n: int = 120, bonus: NoveltyBonus | None = None) -> WorldModel:
    """A model of two features in which nothing moves and no reward is earned."""
    return WorldModel(
        task=TASK,
        states=np.zeros((n, 2)),
        features=np.zeros((n, 2)),
        phi=lambda states: states,
        restart=np.array([3.0, -1.0]),
        expected_features=lambda rows, inputs: inputs[:, :2],
        dynamics=None if model_env is None else getattr(model_env, "dynamics", None),
        terminations=None,
        reward_model=RewardModel(
            lambda inputs: np.full((len(inputs), 1), 1.5), -1.5, 0.0, -3.0, 0.0
        ),
        model_env=model_env,
        bonus=bonus,
    )


@pytest.mark.parametrize(
    ("fraction", "replay", "visited"),
    [
        (0.0, 480, 0),
        (1e-3, 480, 0),
        (0.25, 360, 120),
        (0.5, 240, 240),
        (0.999, 0, 480),
        (1.0, 0, 480),
    ],
)
def test_the_budget_is_split_between_the_sources(
    fraction: float, replay: int, visited: int
) -> None:
    model_based = ModelBased(model_rollout_fraction=fraction)
    with_rollouts = split_budget(still_world(VisitedStates()), model_based)
    wanted = {StateSource.REPLAY: replay, StateSource.MODEL_ROLLOUT: visited}
    assert with_rollouts == {source: count for source, count in wanted.items() if count}
    assert list(with_rollouts) == [source for source, count in wanted.items() if count]
    assert split_budget(still_world(None), model_based) == {StateSource.REPLAY: 480}


@pytest.mark.parametrize(("max_samples", "total"), [(37, 37), (480, 480), (10**6, 480)])
def test_the_number_of_generated_actions_is_limited(max_samples: int, total: int) -> None:
    model_based = ModelBased(max_samples=max_samples)
    split = split_budget(still_world(VisitedStates()), model_based)
    assert sum(split.values()) == total
    assert split_budget(still_world(None), model_based) == {StateSource.REPLAY: total}


def test_a_limited_number_of_actions_is_generated() -> None:
    case = Case.learnt(model="change")
    changes = replayed(4, **{"model_based.max_samples": 37})
    found = case.generate(GivenActions(np.zeros((37, 1))), **changes)
    assert len(found.state_of) == len(found.actions) == len(found.problem.rewards) == 37
    assert found.problem.differences.shape == (37, case.world.features.shape[1])
    assert found.problem.ridge == pytest.approx(0.3 / 37)


# ---- the exploration bonus --------------------------------------------------------------------


def test_an_unexplored_successor_adds_the_bonus_and_is_followed_by_a_restart() -> None:
    model_env: Any = SimpleNamespace(
        dynamics=SimpleNamespace(
            predict=lambda inputs: (inputs[:, :2], np.zeros(4)), terminations=None
        ),
        # every second generated action leads to an unexplored state
        nearest=lambda states: (None, np.array([1.0, 0.0, 1.0, 0.0])),
    )
    settings = Settings(model_based=ModelBased(actions_per_state=2, model_rollout_fraction=0.0))
    bonus = NoveltyBonus(optimistic_reward=1.0, average_reward=-1.0, known_radius=0.5)
    without, found = (
        generate(
            still_world(model_env, n=2, bonus=each),
            np.array([0.5, 0.5]),
            GivenActions(np.zeros((4, 1))),
            StateSource.REPLAY,
            settings,
            0.1,
            False,
            np.random.default_rng(0),
        ).problem
        for each in (None, bonus)
    )
    p = 0.02
    np.testing.assert_allclose(found.rewards, [0.0, 2.0 * (1.0 - p) / p] * 2)
    assert not without.rewards.any()
    np.testing.assert_array_equal(found.differences[::2], without.differences[::2])
    # the features of the state are zero, so these are the features after a restart
    np.testing.assert_allclose(found.differences[1::2], [[3.0, -1.0]] * 2)
