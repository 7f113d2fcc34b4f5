"""Collection of rollouts, in batches and step by step; faulty environments; evaluation."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms.state import LearnerState
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.envs.restart import stratified_lengths
from kreps.envs.swing_up import SwingUp
from kreps.errors import ConfigurationError, DataError, EnvironmentFailure, SpaceError
from kreps.kernels.arrays import FloatArray
from kreps.learning.collect import collect, simulate
from kreps.learning.environment import batch_model_of, task_of
from kreps.learning.evaluate import discounted_average
from kreps.learning.planning import longest_rollout
from kreps.learning.wrappers import without_restarts
from kreps.policies.base import StochasticPolicy
from kreps.policies.exploration import RED, BangBang
from kreps.seeding import Purpose, generator, integer_seed

LIGHT: dict[str, Any] = {"model_based.improvement_steps": 1, "model_based.acceptance_rollouts": 5}
TINY: dict[str, Any] = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "window": 6, **LIGHT}


class PointMass(gym.Env[Any, Any]):
    """An environment without batch model: position, velocity, force within [-1, 1] with noise.

    ``fault(step, observation, reward)`` may raise or return something else.
    """

    def __init__(self, **metadata: Any) -> None:
        self.metadata = {"render_modes": [], **metadata}
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.applied: list[Any] = []
        self.fault: Any = lambda step, observation, reward: (observation, reward)
        self.steps = 0  # of all episodes

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=2)
        return self.fault(self.steps, self.state.copy(), 0.0)[0], {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.applied.append(action)
        self.steps += 1
        force = float(action[0]) + 0.1 * self.np_random.normal()
        reward = -float(self.state @ self.state)
        velocity = 0.9 * self.state[1] + 0.2 * force
        self.state = np.array([self.state[0] + 0.2 * velocity, velocity])
        observation, reward = self.fault(self.steps, self.state.copy(), reward)
        return observation, reward, False, False, {}


class EndsBeyond(gym.Wrapper[Any, Any, Any, Any]):
    """Terminates where the position leaves ``[-limit, limit]``."""

    def __init__(self, env: gym.Env[Any, Any], limit: float) -> None:
        super().__init__(env)
        self.limit = limit

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, _, truncated, info = self.env.step(action)
        return observation, reward, bool(abs(observation[0]) > self.limit), truncated, info


class ThreeSteps:
    """A batch model that counts steps and terminates after three, with an optional fault."""

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def observe(self, states: FloatArray) -> FloatArray:
        return states

    def initial(self, rngs: Any) -> FloatArray:
        return np.zeros((len(rngs), 3 if self.fault == "shape" else 2))

    def step(self, x: FloatArray, u: FloatArray, rngs: Any) -> Any:
        if self.fault == "raise":
            raise RuntimeError("the simulator lost its licence")
        successors = x + 1.0
        if self.fault == "nan":
            successors[0, 1] = np.nan
        return successors, u[:, 0], successors[:, 0] >= 3.0


class InBatches(PointMass):
    def __init__(self, fault: str = "") -> None:
        super().__init__()
        self.batch_model = ThreeSteps(fault)


class Endless(PointMass):
    """A batch model whose task never ends."""

    def __init__(self) -> None:
        super().__init__()
        self.batch_model = Staying()


class Staying(ThreeSteps):
    def step(self, x: FloatArray, u: FloatArray, rngs: Any) -> Any:
        return x, u[:, 0], np.zeros(len(x), bool)


@dataclass(frozen=True)
class Linear:
    """A state-dependent policy whose commands are often beyond the limits."""

    scale: float

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.scale * (np.sin(states[:, :1]) - 0.3 * states[:, 1:] + noise)


def collected(
    env: gym.Env[Any, Any],
    policy: StochasticPolicy,
    count: int = 6,
    seed: int = 0,
    iteration: int = 0,
    probability: float = 0.05,
    stratified: bool = False,
) -> Rollouts:
    return collect(
        env,
        task_of(env),
        policy,
        count,
        seed=seed,
        iteration=iteration,
        restart_probability=probability,
        stratified=stratified,
    )


def unchanged(learner: kreps.KREPS, before: LearnerState) -> bool:
    return learner.state is before and len(before.window.rollouts) == before.window.capacity


# ---- both collectors --------------------------------------------------------------------------


def test_collecting_in_batches_and_step_by_step_gives_the_same_data() -> None:
    env = gym.make("kreps/SwingUp-v0")
    wrapped: gym.Env[Any, Any] = gym.Wrapper(env)
    assert batch_model_of(env) is not None
    assert batch_model_of(wrapped) is None
    batch, single = collected(env, Linear(40.0)), collected(wrapped, Linear(40.0))
    assert len(batch) == len(single) == 6
    for a, b in zip(batch, single, strict=True):
        assert len(a) == len(b)
        np.testing.assert_allclose(a.observations, b.observations, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.actions, b.actions, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.rewards, b.rewards, rtol=0, atol=1e-9)


def test_lengths_are_stratified_by_the_settings() -> None:
    def steps(**settings: Any) -> list[int]:
        settings = {"initial_rollouts": 30, "growth": 0.0, **settings}
        learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=3, **settings)
        assert learner.env is not None
        return [len(rollout) for rollout in learner._collect(learner.env, None).rollouts]

    lengths = steps()
    assert lengths == stratified_lengths(generator(3, Purpose.RESTART, 0), 0.02, 30)
    assert sum(lengths) == pytest.approx(1470, rel=0.1)
    assert steps(rollout_lengths="independent") == steps(preset="paper") != lengths
    for other in (kreps.ValueIteration, kreps.NPALP):
        assert other(gym.make("kreps/SwingUp-v0")).settings.rollout_lengths == "independent"


def test_stratified_lengths_differ_between_iterations_and_end_with_a_time_limit() -> None:
    swing_up = gym.make("kreps/SwingUp-v0")
    batch, single, limited = (
        [collected(env, Linear(40.0), iteration=i, stratified=True) for i in (0, 1)]
        for env in (swing_up, gym.Wrapper(swing_up), gym.wrappers.TimeLimit(PointMass(), 4))
    )
    for iteration in (0, 1):
        drawn = stratified_lengths(generator(0, Purpose.RESTART, iteration), 0.05, 6)
        assert [len(r) for r in batch[iteration]] == drawn
        assert [len(r) for r in limited[iteration]] == [min(length, 4) for length in drawn]
        for a, b in zip(batch[iteration], single[iteration], strict=True):
            np.testing.assert_allclose(a.observations, b.observations, rtol=0, atol=1e-9)
    assert [len(r) for r in batch[0]] != [len(r) for r in batch[1]]


@pytest.mark.parametrize("make", [lambda: gym.make("kreps/SwingUp-v0"), PointMass])
def test_data_match_an_independent_simulation(make: Any) -> None:
    env = make()
    policy, task = Linear(3.0), task_of(env)
    rollouts = collected(env, policy, seed=3, iteration=2)
    for j, rollout in enumerate(rollouts):
        fresh = make()
        noise = generator(3, Purpose.POLICY, 2, j)
        observation, _ = fresh.reset(seed=integer_seed(3, Purpose.ENVIRONMENT, 2, j))
        for t in range(len(rollout)):
            np.testing.assert_allclose(rollout.observations[t], observation, rtol=0, atol=1e-9)
            action = policy.act(np.array([observation]), noise.standard_normal((1, 1)))[0]
            np.testing.assert_allclose(rollout.actions[t], action, rtol=0, atol=1e-9)
            applied = task.clip(action).astype(env.action_space.dtype)
            observation, reward, *_ = fresh.step(applied)
            assert rollout.rewards[t] == pytest.approx(reward, abs=1e-9)
        np.testing.assert_allclose(rollout.observations[-1], observation, rtol=0, atol=1e-9)


def test_independent_lengths_are_those_of_the_restart_wrapper_with_the_same_seeds() -> None:
    rollouts = collected(PointMass(), Linear(1.0), seed=7, probability=0.1)
    env = kreps.RandomRestart(PointMass(), 0.1)
    for j, rollout in enumerate(rollouts):
        env.reset(seed=integer_seed(7, Purpose.ENVIRONMENT, 0, j))
        truncated, steps = False, 0
        while not truncated:
            *_, truncated, _ = env.step(np.zeros(1, np.float32))
            steps += 1
        assert len(rollout) == steps


def test_data_differ_by_seed_iteration_and_rollout() -> None:
    first = collected(PointMass(), Linear(1.0))
    same = collected(PointMass(), Linear(1.0))
    other_seed = collected(PointMass(), Linear(1.0), seed=1)
    other_iteration = collected(PointMass(), Linear(1.0), iteration=1)
    for a, b in zip(first, same, strict=True):
        np.testing.assert_array_equal(a.observations, b.observations)
    for others in (other_seed, other_iteration):
        for a, b in zip(first, others, strict=True):
            assert not np.array_equal(a.observations[0], b.observations[0])
            assert not np.array_equal(a.actions[0], b.actions[0])
    starts = {tuple(r.observations[0]) for r in first}
    assert len(starts) == len(first)


def test_the_first_rollouts_of_independent_lengths_do_not_depend_on_how_many_follow() -> None:
    few, many = collected(PointMass(), Linear(1.0), 2), collected(PointMass(), Linear(1.0), 5)
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.observations, b.observations)
        np.testing.assert_array_equal(a.actions, b.actions)


def test_actions_are_stored_as_commanded_and_clipped_for_the_environment() -> None:
    env = PointMass()
    rollouts = collected(env, Linear(5.0))
    commanded = np.concatenate([r.actions for r in rollouts])
    applied = np.array(env.applied)
    assert np.abs(commanded).max() > 5.0  # beyond the limits
    assert all(a.shape == (1,) and a.dtype == np.float32 for a in env.applied)
    np.testing.assert_array_equal(applied, np.clip(commanded, -1.0, 1.0).astype(np.float32))


def test_actions_of_a_batch_are_stored_as_commanded_too() -> None:
    rollouts = collected(gym.make("kreps/SwingUp-v0"), Linear(200.0))
    commanded = np.concatenate([r.actions for r in rollouts])
    assert np.abs(commanded).max() > 100.0
    for rollout in rollouts:
        torque = np.clip(rollout.actions[:, 0], -30.0, 30.0)
        states = rollout.observations[:-1]
        cost = 10 * states[:, 0] ** 2 + 0.1 * states[:, 1] ** 2 + 0.001 * torque**2
        np.testing.assert_allclose(rollout.rewards, -cost, rtol=1e-12)


# ---- ends -------------------------------------------------------------------------------------


def test_termination_is_recorded_and_truncation_is_not() -> None:
    rollouts = collected(EndsBeyond(PointMass(), 1.2), Linear(2.0), count=20)
    ended = [r for r in rollouts if r.terminated]
    truncated = [r for r in rollouts if not r.terminated]
    assert ended and truncated  # of both kinds
    for rollout in ended:
        assert abs(rollout.observations[-1, 0]) > 1.2
    for rollout in truncated:
        assert (np.abs(rollout.observations[1:, 0]) <= 1.2).all()


def test_truncation_by_a_time_limit_is_no_termination() -> None:
    env = gym.wrappers.TimeLimit(PointMass(), 4)
    rollouts = collected(env, Linear(1.0), probability=0.01)
    assert max(len(r) for r in rollouts) == 4
    assert not any(r.terminated for r in rollouts)


def test_noise_is_drawn_for_as_many_steps_as_the_time_limit_allows() -> None:
    env = gym.make("Pendulum-v1")  # truncated after 200 steps
    task = task_of(env)
    options: dict[str, Any] = {"seed": 0, "iteration": 0, "restart_probability": 1e-9}
    (rollout,) = collect(env, task, BangBang(task), 1, **options, exponent=RED)
    assert len(rollout) == 200
    held = np.mean(rollout.actions[1:] == rollout.actions[:-1])
    # the lowest frequency of its noise is that of 200 steps, not of the 1e9 of the restarts
    assert held < 0.999


@pytest.mark.parametrize("exploration", ["bang-bang", "pink"])
@pytest.mark.parametrize("env", [EndsBeyond(PointMass(), 2.0), InBatches()], ids=["one", "batch"])
def test_rollouts_that_only_the_environment_ends_need_no_memory_for_more(
    env: gym.Env[Any, Any], exploration: str
) -> None:
    few = {"exploration": exploration, "initial_rollouts": 6, **LIGHT}
    learner = kreps.KREPS(env, seed=0, restart_probability=1e-9, **few)
    tracemalloc.start()
    learner.learn(1, progress=False)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100 * 2**20
    assert learner.state.window.rollouts.terminated.all()


@pytest.mark.parametrize("env", [PointMass(), Endless()], ids=["one", "batch"])
@pytest.mark.parametrize("probability", [1e-6, 1e-9])
def test_rollouts_that_nothing_ends_are_an_error_with_the_remedy(
    env: gym.Env[Any, Any], probability: float
) -> None:
    settings: dict[str, Any] = {"restart_probability": probability, "growth": 0.0}
    learner = kreps.KREPS(env, seed=0, initial_rollouts=3, **settings)
    with pytest.raises(ConfigurationError, match=r"more than 10000 steps.*TimeLimit"):
        learner.learn(1, progress=False)
    limited = gym.wrappers.TimeLimit(env, 20)
    again = kreps.KREPS(limited, seed=0, initial_rollouts=3, **settings)
    assert again.learn(1, progress=False).state.steps == 60


@pytest.mark.parametrize(
    ("lengths", "longest"),
    [
        ([3, 50, 2], 50),
        ([400] * 5_000, 400),
        ([1_000_000] * 2, 1_000_000),  # 0.8 GiB
        ([1_000_000] * 3, 10_000),
        ([10**18], 10_000),
        ([400] * 10_000, 248),
    ],
)
def test_a_rollout_may_be_as_long_as_memory_allows(lengths: list[int], longest: int) -> None:
    assert longest_rollout(lengths, TaskSpec(2, [-1.0], [1.0])) == longest


def test_termination_in_a_batch_ends_that_rollout_only() -> None:
    env = InBatches()
    lengths = [1, 7, 3, 2]
    rollouts = simulate(
        env,
        task_of(env),
        Linear(1.0),
        [0, 1, 2, 3],
        [np.zeros((length, 1)) for length in lengths],
    )
    assert [len(r) for r in rollouts] == [1, 3, 3, 2]
    assert [r.terminated for r in rollouts] == [False, True, True, False]
    np.testing.assert_array_equal(rollouts.offsets, [0, 1, 4, 7, 9])
    for rollout, length in zip(rollouts, [1, 3, 3, 2], strict=True):
        np.testing.assert_array_equal(rollout.observations[:, 0], np.arange(length + 1.0))
        assert rollout.actions.shape == (length, 1) and rollout.rewards.shape == (length,)


def test_the_number_of_complete_rollouts_is_reported() -> None:
    env, reported = PointMass(), list[int]()
    collect(
        env,
        task_of(env),
        BangBang(task_of(env)),
        3,
        seed=0,
        iteration=0,
        restart_probability=0.2,
        on_rollout=reported.append,
    )
    assert reported == [1, 2, 3]


# ---- spaces -----------------------------------------------------------------------------------

BOX = gym.spaces.Box(-1.0, 1.0, (1,))


class Spaces(PointMass):
    def __init__(self, observations: Any, actions: Any) -> None:
        super().__init__()
        self.observation_space, self.action_space = observations, actions


@pytest.mark.parametrize(
    ("observations", "actions", "which", "remedy"),
    [
        (BOX, gym.spaces.Discrete(3), "action space is Discrete(3)", "TransformAction"),
        (BOX, gym.spaces.MultiBinary(2), "action space is MultiBinary(2)", "continuous form"),
        (gym.spaces.Dict({"a": BOX}), BOX, "observation space is Dict(", "FlattenObservation"),
        (gym.spaces.Discrete(5), BOX, "observation space is Discrete(5)", "FlattenObservation"),
        (BOX, gym.spaces.Box(-np.inf, np.inf, (2,)), "unbounded", "bounded Box"),
        (BOX, gym.spaces.Box(0.0, np.inf, (1,)), "unbounded", "bounded Box"),
    ],
)
def test_unsupported_spaces_raise_with_reason_and_remedy(
    observations: Any, actions: Any, which: str, remedy: str
) -> None:
    with pytest.raises(SpaceError) as caught:
        kreps.KREPS(Spaces(observations, actions))
    message = str(caught.value)
    assert which in message
    assert remedy in message
    assert ", as kernels" in message or ", as policies" in message or "explores" in message
    assert isinstance(caught.value, ConfigurationError)


def test_flattened_dictionaries_are_supported() -> None:
    space = gym.spaces.Dict({"a": BOX, "b": gym.spaces.Box(-1.0, 1.0, (2,))})
    env = gym.wrappers.FlattenObservation(Spaces(space, BOX))
    assert kreps.KREPS(env).task.observation_size == 3


def test_observations_and_actions_of_many_dimensions_are_flattened() -> None:
    class Picture(Spaces):
        def __init__(self) -> None:
            super().__init__(
                gym.spaces.Box(0, 255, (2, 3), np.uint8), gym.spaces.Box(-1.0, 2.0, (2, 2))
            )

        def reset(self, **kwargs: Any) -> Any:
            return np.arange(6, dtype=np.uint8).reshape(2, 3), {}

        def step(self, action: Any) -> Any:
            assert action.shape == (2, 2) and action.dtype == np.float32
            return np.full((2, 3), 7, np.uint8), float(action[0, 1]), False, False, {}

    env = Picture()
    task = task_of(env)
    assert task.observation_size == 6 and task.action_size == 4
    rollout = collected(env, BangBang(task), count=1)[0]
    assert rollout.observations.shape[1] == 6 and rollout.actions.shape[1] == 4
    np.testing.assert_array_equal(rollout.observations[0], np.arange(6.0))
    np.testing.assert_array_equal(rollout.rewards, rollout.actions[:, 1])


def test_periodic_coordinates_come_from_metadata_or_by_keyword() -> None:
    assert task_of(PointMass()).periodic == ()
    assert task_of(PointMass(periodic_coordinates=(1,))).periodic == (1,)
    assert task_of(PointMass(periodic_coordinates=(1,)), [0]).periodic == (0,)
    assert task_of(PointMass(periodic_coordinates=(1,)), []).periodic == ()
    assert kreps.KREPS(PointMass(), periodic=[0, 1]).task.periodic == (0, 1)
    with pytest.raises(ConfigurationError, match=r"coordinates \[2\]"):
        kreps.KREPS(PointMass(), periodic=[2])


def test_periodic_coordinates_reach_policy_and_value_function() -> None:
    class Spinning(PointMass):
        metadata: ClassVar[dict[str, Any]] = {"periodic_coordinates": (0,)}

    learner = kreps.KREPS(Spinning(), periodic=[0], **TINY).learn(1, progress=False)
    turn = np.array([2 * np.pi, 0.0])
    states = np.random.default_rng(0).normal(size=(5, 2))
    policy = learner.policy
    np.testing.assert_allclose(
        policy.predict(states, deterministic=True)[0],
        policy.predict(states + turn, deterministic=True)[0],
        atol=1e-6,
    )
    np.testing.assert_allclose(
        learner.value_function(states), learner.value_function(states + turn), atol=1e-6
    )


# ---- restarts ---------------------------------------------------------------------------------


def test_an_outermost_restart_wrapper_gives_the_learner_its_probability() -> None:
    env = PointMass()
    inside, probability = without_restarts(kreps.RandomRestart(env, 0.07))
    assert inside is env and probability == 0.07
    assert without_restarts(env) == (env, None)
    learner = kreps.KREPS(kreps.RandomRestart(env, 0.07), seed=0)
    assert learner.settings.restart_probability == 0.07
    assert learner.env is env  # without the wrapper, as the learner restarts by itself


def test_a_restart_wrapper_below_another_one_raises_with_a_remedy() -> None:
    env = gym.wrappers.TimeLimit(kreps.RandomRestart(PointMass()), 100)
    with pytest.raises(ConfigurationError, match="outermost"):
        kreps.KREPS(env)


# ---- faulty environments -----------------------------------------------------------------------


def raise_at(step: int) -> Any:
    def fault(now: int, observation: Any, reward: Any) -> Any:
        if now == step:
            raise RuntimeError("motor 3 is on fire")
        return observation, reward

    return fault


def replace_at(step: int, observation: Any = None, reward: Any = None) -> Any:
    def fault(now: int, true_observation: Any, true_reward: Any) -> Any:
        if now < step:
            return true_observation, true_reward
        return (
            true_observation if observation is None else np.array(observation),
            true_reward if reward is None else reward,
        )

    return fault


def sound(now: int, observation: Any, reward: Any) -> Any:
    return observation, reward


def test_after_an_exception_of_the_environment_learning_continues_unchanged() -> None:
    env = PointMass()
    learner = kreps.KREPS(env, seed=1, **TINY).learn(1, progress=False)
    before = learner.state
    env.fault = raise_at(env.steps + 10)
    with pytest.raises(EnvironmentFailure, match=r"RuntimeError.*rollout.*motor 3") as caught:
        learner.learn(1, progress=False)
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert unchanged(learner, before)
    env.fault = sound
    learner.learn(1, progress=False)
    undisturbed = kreps.KREPS(PointMass(), seed=1, **TINY).learn(2, progress=False)
    states = np.random.default_rng(0).normal(size=(4, 2))
    np.testing.assert_array_equal(
        learner.policy.predict(states, deterministic=True)[0],
        undisturbed.policy.predict(states, deterministic=True)[0],
    )


def test_an_exception_in_reset_is_a_failure_of_the_environment() -> None:
    env = PointMass()
    env.fault = raise_at(0)
    with pytest.raises(EnvironmentFailure, match="after 0 steps: motor 3"):
        kreps.KREPS(env, **TINY).learn(1, progress=False)


def test_a_keyboard_interrupt_in_the_environment_is_not_converted() -> None:
    def interrupt(now: int, observation: Any, reward: Any) -> Any:
        raise KeyboardInterrupt

    env = PointMass()
    env.fault = interrupt
    with pytest.raises(KeyboardInterrupt):
        kreps.KREPS(env, **TINY).learn(1, progress=False)


@pytest.mark.parametrize(
    ("faultt", "says"),
    [
        ({"observation": [np.nan, 0.0]}, "NaN"),
        ({"observation": [0.0, np.inf]}, "NaN, an infinity"),
        ({"reward": np.nan}, "rewards hold NaN"),
        ({"reward": -np.inf}, "rewards hold NaN, an infinity"),
        ({"observation": [0.0, 0.0, 0.0]}, "3"),
        ({"observation": [0.0]}, "1"),
    ],
)
def test_invalid_data_of_an_environment_raise_and_leave_the_learner_unchanged(
    faultt: dict[str, Any], says: str
) -> None:
    env = PointMass()
    learner = kreps.KREPS(env, seed=1, **TINY).learn(1, progress=False)
    before = learner.state
    env.fault = replace_at(env.steps + 10, **faultt)
    with pytest.raises(DataError, match=r"rollout \d+") as caught:
        learner.learn(1, progress=False)
    assert says in str(caught.value)
    assert unchanged(learner, before)
    env.fault = sound
    learner.learn(1, progress=False)
    assert learner.state.iteration == 2


@pytest.mark.parametrize(
    ("observation", "says"), [([np.nan, 0.0], "NaN"), ([0.0, 0.0, 0.0], "3"), ([], "0")]
)
def test_an_invalid_first_observation_raises(observation: list[float], says: str) -> None:
    env = PointMass()
    env.fault = replace_at(0, observation=observation)
    with pytest.raises(DataError, match="observation") as caught:
        kreps.KREPS(env, **TINY).learn(1, progress=False)
    assert says in str(caught.value)


def test_an_exception_of_a_batch_model_is_a_failure_of_the_environment() -> None:
    with pytest.raises(EnvironmentFailure, match="lost its licence"):
        kreps.KREPS(InBatches("raise"), **TINY).learn(1, progress=False)


@pytest.mark.parametrize("fault", ["nan", "shape"])
def test_invalid_data_of_a_batch_model_raise(fault: str) -> None:
    learner = kreps.KREPS(InBatches(fault), **TINY)
    before = learner.state
    with pytest.raises(DataError):
        learner.learn(1, progress=False)
    assert learner.state is before


def test_limits_of_the_task_are_float64_for_any_data_type_of_the_box() -> None:
    task = task_of(PointMass())
    assert isinstance(task, TaskSpec)
    assert task.action_low.dtype == np.float64
    np.testing.assert_array_equal(task.action_scale, [1.0])


class OtherReward(SwingUp):
    """Has its own step, so that the inherited batch model does not apply."""

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = super().step(action)
        return observation, -12345.0, terminated, truncated, info


def test_a_subclass_with_its_own_step_is_not_simulated_by_the_batch_model() -> None:
    learner = kreps.KREPS(OtherReward(), **TINY).learn(1, progress=False)
    np.testing.assert_array_equal(learner.state.window.rollouts.rewards, -12345.0)
    assert batch_model_of(SwingUp()) is SwingUp.batch_model


# ---- evaluation -------------------------------------------------------------------------------


def rewarded(*rewards: float, terminated: bool = False) -> Rollout:
    steps = len(rewards)
    return Rollout(np.zeros((steps + 1, 1)), np.zeros((steps, 1)), np.array(rewards), terminated)


def test_a_terminated_rollout_counts_by_its_weight() -> None:
    # one step of reward 1, then none until the restart; a hundred steps of reward 0
    found = discounted_average([rewarded(1.0, terminated=True), rewarded(*[0.0] * 100)], 0.02)
    assert found.mean == pytest.approx(1.0 / (1.0 / 0.02 + (1.0 - 0.98**100) / 0.02))
    assert (found.episodes, found.steps) == (2, 100)


def test_the_average_and_its_standard_error_by_hand() -> None:
    # p = 1/2: weights 1 and 1/2, so that weights of rollouts are 1.5, 1 and 1.5, 4 in all;
    # weighted rewards are 4 + 0, 1 and 2 + 1, 8 in all
    found = discounted_average([rewarded(4.0, 0.0), rewarded(1.0), rewarded(2.0, 2.0)], 0.5)
    assert found.mean == pytest.approx(2.0, rel=1e-12)
    # weighted rewards less mean times weight are 1, -1 and 0: their variance is 1 (with 2 degrees
    # of freedom); it is divided by the mean weight, 4/3, and the root of the count
    assert found.standard_error == pytest.approx(1.0 / (4.0 / 3.0) / 3.0**0.5, rel=1e-12)
    assert found.standard_error == pytest.approx(0.4330127, rel=1e-6)
    assert (found.episodes, found.steps) == (3, 2)


def test_the_standard_error_does_not_depend_on_an_offset_of_rewards() -> None:
    rewards = [(4.0, 0.0), (1.0,), (2.0, 2.0)]
    found = discounted_average([rewarded(*(r + 100.0 for r in each)) for each in rewards], 0.5)
    assert found.mean == pytest.approx(102.0, rel=1e-12)
    assert found.standard_error == pytest.approx(0.4330127, rel=1e-6)


def test_the_standard_error_falls_with_the_root_of_the_count() -> None:
    pair = [rewarded(0.0), rewarded(2.0)]  # deviations -1 and 1 from the mean
    assert discounted_average(pair, 0.02).standard_error == pytest.approx(1.0, rel=1e-12)
    eight = discounted_average(pair * 4, 0.02)  # sqrt(8 / 7) / sqrt(8)
    assert eight.standard_error == pytest.approx(0.3779645, rel=1e-6)
    assert eight.mean == pytest.approx(1.0, rel=1e-12)


def test_equal_rollouts_and_a_single_one_have_no_standard_error() -> None:
    alike = discounted_average([rewarded(1.0, 2.0)] * 3, 0.02)
    assert alike.standard_error == pytest.approx(0.0, abs=1e-15)
    alone = discounted_average([rewarded(4.0, 1.0)], 0.5)
    assert (alone.mean, alone.standard_error) == (3.0, 0.0)
    assert (alone.episodes, alone.steps) == (1, 2)
