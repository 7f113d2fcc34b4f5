"""Policies give and take what the environment's spaces hold: shapes, and types of numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box

import kreps
from kreps.data.spaces import Spaces
from kreps.errors import ConfigurationError, DataError

SMALL: dict[str, Any] = {
    "seed": 0,
    "initial_rollouts": 5,
    "rollouts_per_iteration": 2,
    "restart_probability": 0.1,
    "model_based.acceptance_rollouts": 2,
}


class Shaped(gym.Env[Any, Any]):
    """A point on a line, in any spaces; it keeps the actions that it gets."""

    def __init__(self, observations: Box, actions: Box) -> None:
        self.observation_space, self.action_space = observations, actions
        self.applied: list[Any] = []

    def _observe(self) -> Any:
        space = self.observation_space
        steps = 0.1 * np.arange(np.prod(space.shape)).reshape(space.shape)
        return np.asarray(self.x + steps, space.dtype)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        self.applied.append(np.array(action))
        self.x = float(np.clip(self.x + 0.1 * np.mean(action), -9, 9))
        return self._observe(), -(self.x**2), False, False, {}


LINE = Box(-10, 10, (2,))
PUSH = Box(-1, 1, (1,))


def every_policy(env: gym.Env[Any, Any], folder: Path) -> dict[str, Any]:
    """The learner of an environment, and what users make of it."""
    learner = kreps.KREPS(env, **SMALL).learn(1, progress=False)
    learner.save(folder / "checkpoint.safetensors")
    learner.policy.save(folder / "policy.safetensors")
    return {
        "learner": learner,
        "policy": learner.policy,
        "loaded": kreps.load_policy(folder / "policy.safetensors"),
        "resumed": kreps.KREPS.resume(folder / "checkpoint.safetensors", env),
        "resumed without it": kreps.KREPS.resume(folder / "checkpoint.safetensors"),
        "compressed": learner.policy.compressed(3),
    }


@pytest.mark.parametrize(
    "space",
    [
        PUSH,
        Box(-1, 1, (2,), np.float64),
        Box(np.float32(-0.1), np.float32(0.3), (2,)),
        Box(-1, 1, (2, 3)),
        Box(-1, 1, (), np.float32),
        Box(-1, 1, (1,), np.float16),
        Box(-2, 5, (2,), np.int64),
        Box(0, 255, (3,), np.uint8),
    ],
    ids=str,
)
def test_actions_are_elements_of_the_action_space(space: Box, tmp_path: Path) -> None:
    env = Shaped(LINE, space)
    observation, _ = env.reset(seed=0)
    several = np.stack([observation] * 4)
    for who, policy in every_policy(env, tmp_path).items():
        for deterministic in (True, False):
            action, _ = policy.predict(observation, deterministic=deterministic)
            assert isinstance(action, np.ndarray)
            assert space.contains(action), f"{who}: {action!r}"
            assert action.dtype == space.dtype
            actions, _ = policy.predict(several, deterministic=deterministic)
            assert actions.shape == (4, *space.shape)
            assert all(space.contains(np.asarray(each)) for each in actions)


@pytest.mark.parametrize(
    "shape", [(1,), (6,), (), (1, 3), (3, 1), (3, 2), (2, 2), (1, 1), (4, 4, 3)], ids=str
)
def test_observations_are_taken_as_the_environment_gives_them(
    shape: tuple[int, ...], tmp_path: Path
) -> None:
    env = Shaped(Box(-20, 20, shape), PUSH)
    observation, _ = env.reset(seed=0)
    flat = np.ravel(observation)
    for who, policy in every_policy(env, tmp_path).items():
        action, _ = policy.predict(observation, deterministic=True)
        assert action.shape == (1,), who
        for m in (1, 2, len(flat)):
            batch = np.stack([observation + 0.1 * i for i in range(m)])
            actions, _ = policy.predict(batch, deterministic=True)
            assert actions.shape == (m, 1), who
            np.testing.assert_allclose(actions[0], action, atol=1e-6)
        if m > 1:  # flattened, as before
            flattened, _ = policy.predict(flat, deterministic=True)
            np.testing.assert_array_equal(flattened, action)
            flattened, _ = policy.predict(np.stack([flat] * 2), deterministic=True)
            assert flattened.shape == (2, 1)


@pytest.mark.parametrize("wrong", [(2, 3), (3,), (3, 2, 1), (2, 2, 3), (7,), ()], ids=str)
def test_an_observation_of_another_shape_is_refused(wrong: tuple[int, ...]) -> None:
    learner = kreps.KREPS(Shaped(Box(-20, 20, (3, 2)), PUSH), **SMALL).learn(1, progress=False)
    with pytest.raises(DataError, match=r"\(3, 2\), or flattened \(6,\)"):
        learner.predict(np.zeros(wrong))


def test_integers_are_rounded_and_not_truncated() -> None:
    env = Shaped(LINE, Box(-2, 5, (1,), np.int64))
    learner = kreps.KREPS(env, **SMALL).learn(3, progress=False)
    window = learner.state.window.rollouts
    commanded = np.clip(window.actions[-len(window[-1]) :, 0], -2, 5)
    applied = np.array(env.applied[-len(commanded) :])[:, 0]
    np.testing.assert_array_equal(applied, np.rint(commanded))
    assert (np.trunc(commanded) != applied).any()
    # and models learn from what was applied
    whole = np.rint(np.clip(window.actions, -2, 5))
    np.testing.assert_array_equal(learner.task.clip(window.actions), whole)


def test_an_exported_model_rounds_integers_too(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    learner = kreps.KREPS(Shaped(LINE, Box(-9, 9, (1,), np.int64)), **SMALL)
    learner.learn(2, progress=False).policy.export_onnx(tmp_path / "policy.onnx")
    states = np.random.default_rng(0).normal(size=(50, 2))
    session = runtime.InferenceSession(str(tmp_path / "policy.onnx"))
    actions, _ = session.run(None, {"observation": states})
    wanted, _ = learner.predict(states, deterministic=True)
    np.testing.assert_array_equal(actions, wanted)
    assert len(np.unique(wanted)) > 1


@pytest.mark.parametrize("build", [kreps.Rollout, kreps.Rollouts.from_arrays])
def test_one_dimensional_actions_may_come_as_numbers(build: Any) -> None:
    lengths = () if build is kreps.Rollout else ([3],)
    made = build(np.zeros((4, 3, 2)), [1.0, 2.0, 3.0], np.zeros(3), *lengths)
    np.testing.assert_array_equal(made.actions, [[1.0], [2.0], [3.0]])
    points = made.observations if build is kreps.Rollout else made.points
    assert points.shape == (4, 6)
    shaped = build(np.zeros((4, 2)), np.zeros((3, 2, 3)), np.zeros(3), *lengths)
    assert shaped.actions.shape == (3, 6)


@pytest.mark.parametrize(
    "wrong",
    [
        ((2,), (2,)),
        ((6,), (1,)),
        ((-1, -6), (1,)),
        ((6,), (1,), "complex128"),
        ((6,), (1,), "numbers"),
        (6, (1,)),
        ((6.0,), (1,)),
    ],
    ids=str,
)
def test_spaces_that_do_not_fit_the_task_are_refused(wrong: Any) -> None:
    with pytest.raises(ConfigurationError, match="spaces"):
        kreps.TaskSpec(6, [-1.0, -1.0], [1.0, 1.0], spaces=Spaces(*wrong))


def test_a_task_without_spaces_has_vectors_of_float64() -> None:
    task = kreps.TaskSpec(3, [-1.0], [1.0])
    assert task.given_spaces == Spaces((3,), (1,), "float64")
    policy = kreps.load_policy(OLD)
    action, _ = policy.predict(np.zeros(policy.process.task.observation_size))
    assert action.dtype == np.float64 and action.shape == (policy.process.task.action_size,)


OLD = Path(__file__).parent / "data" / "v0.1" / "policy_cost-sensitive-gp.safetensors"
"""Written before files had spaces."""
