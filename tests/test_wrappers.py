"""What a learner reads from an environment through wrappers, and what it checks and warns about."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.errors import ConfigurationError, SpaceError
from kreps.learning.environment import environment_for, task_of
from kreps.learning.wrappers import keeps_actions, metadata_of

SWING_UP, IMAGES = "kreps/SwingUp-v0", "kreps/ImageSwingUp-v0"
TINY: dict[str, Any] = {"initial_rollouts": 4, "preset": "single_step", "restart_probability": 0.1}

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


class Reversed(gym.ObservationWrapper[Any, Any, Any]):
    """Velocity first."""

    def observation(self, observation: Any) -> Any:
        return observation[::-1]


class Delayed(gym.Wrapper[Any, Any, Any, Any]):
    """A step of its own, of which nothing is known."""

    def step(self, action: Any) -> Any:
        return self.env.step(action)


class Seeded(gym.Wrapper[Any, Any, Any, Any]):
    """A reset of its own, of which nothing is known."""

    def reset(self, **options: Any) -> Any:
        return self.env.reset(**options)


class Pictures(gym.Wrapper[Any, Any, Any, Any]):
    """Changes only what is drawn, and has metadata about that."""

    metadata: ClassVar[dict[str, Any]] = {"render_fps": 5}

    def render(self) -> Any:
        return self.env.render()


class ReversedAndSaysSo(Reversed):
    metadata: ClassVar[dict[str, Any]] = {"periodic_coordinates": (1,)}


class Weaker(gym.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return 0.5 * action


class Cheaper(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return 0.5 * reward


class SlowAction(Weaker):
    """An action wrapper with a step of its own."""

    def step(self, action: Any) -> Any:
        return super().step(action)


def stacked(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return gym.wrappers.FrameStackObservation(env, 2)


def scaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return gym.wrappers.TransformObservation(env, lambda o: o / np.pi, env.observation_space)


def limited(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(env, 50)


# ---- metadata ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: env,
        limited,
        Weaker,
        Cheaper,
        Pictures,
        kreps.RandomRestart,
        gym.wrappers.RecordEpisodeStatistics,
        gym.wrappers.FlattenObservation,
        lambda env: gym.wrappers.ReshapeObservation(env, (2, 1)),
        lambda env: gym.wrappers.RescaleAction(env, -1.0, 1.0),
        lambda env: Weaker(limited(Cheaper(env))),
    ],
)
def test_angles_are_known_through_wrappers_that_keep_observations(wrap: Wrap) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert task_of(wrap(gym.make(SWING_UP))).periodic == (0,)


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (Reversed, "Reversed"),
        (lambda env: limited(Reversed(limited(env))), "Reversed"),
        (scaled, "TransformObservation"),
        (stacked, "FrameStackObservation"),
        (lambda env: gym.wrappers.TimeAwareObservation(limited(env)), "TimeAwareObservation"),
        (Delayed, "Delayed"),
        (Seeded, "Seeded"),
        (SlowAction, "SlowAction"),
        (lambda env: scaled(Delayed(env)), "TransformObservation and Delayed"),
    ],
)
def test_angles_below_a_wrapper_that_may_change_observations_are_not_used(
    wrap: Wrap, name: str
) -> None:
    env = wrap(gym.make(SWING_UP))
    with pytest.warns(UserWarning, match=rf"^{name} may change .*periodic=\[\.\.\.\]") as told:
        assert kreps.KREPS(env).task.periodic == ()
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kreps.KREPS(env, periodic=[1]).task.periodic == (1,)
        assert kreps.KREPS(env, periodic=[]).task.periodic == ()


def test_a_wrapper_can_say_itself_which_of_its_coordinates_are_angles() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert task_of(ReversedAndSaysSo(gym.make(SWING_UP))).periodic == (1,)
        env = Reversed(gym.make(SWING_UP))
        env.metadata = {"periodic_coordinates": (1,)}
        assert task_of(limited(env)).periodic == (1,)
    with pytest.warns(UserWarning, match="^Reversed may change"):
        assert task_of(Reversed(env)).periodic == ()


def test_a_copy_of_metadata_says_nothing_about_the_wrapper_that_has_it() -> None:
    env = Reversed(gym.make(SWING_UP, render_mode="rgb_array"))
    with pytest.warns(UserWarning, match="^Reversed may change"):
        assert task_of(gym.wrappers.RenderCollection(env)).periodic == ()


def test_an_environment_without_metadata_gets_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert task_of(Reversed(gym.make("Pendulum-v1"))).periodic == ()


def test_images_below_a_wrapper_that_may_change_them_are_not_used() -> None:
    assert task_of(limited(gym.make(IMAGES))).image_shape == (20, 20)
    env = Reversed(gym.make(IMAGES))
    with pytest.warns(UserWarning, match=r"observation_image_shape.*set the metadata of Reversed"):
        task = task_of(env)
    assert task.image_shape is None and task.groups == ()
    env.metadata = {
        "observation_groups": (tuple(range(400, 800)), tuple(range(400))),
        "observation_image_shape": (20, 20),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert task_of(env).image_shape == (20, 20)


def test_units_of_actions_are_known_unless_a_wrapper_may_change_them() -> None:
    def labels(env: gym.Env[Any, Any]) -> Any:
        return metadata_of(env, keeps_actions)[0].get("action_labels")

    env = gym.make(SWING_UP)
    assert labels(Reversed(limited(env))) == ("torque [N m]",)
    assert labels(gym.wrappers.RescaleAction(env, -1.0, 1.0)) is None
    assert labels(Weaker(env)) is None


# ---- restarts ---------------------------------------------------------------------------------


def restarting(probability: float, name: str = SWING_UP) -> gym.Env[Any, Any]:
    return kreps.RandomRestart(gym.make(name), probability)


class Fragile(gym.Wrapper[Any, Any, Any, Any]):
    restart_probability = 0.4  # of its own, and nothing to do with the wrapper of kreps


def test_one_process_has_one_restart_probability() -> None:
    twice = kreps.RandomRestart(restarting(0.1), 0.2)
    with pytest.raises(ConfigurationError, match=r"2 RandomRestart wrappers.*\[0\.2, 0\.1\]"):
        kreps.KREPS(twice)
    hidden = kreps.RandomRestart(limited(restarting(0.1)), 0.2)
    with pytest.raises(ConfigurationError, match="2 RandomRestart"):
        kreps.KREPS(hidden)
    assert kreps.KREPS(Fragile(gym.make(SWING_UP)), periodic=[0]).settings == kreps.Settings()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "c.safetensors"
    kreps.KREPS(gym.make(SWING_UP), **TINY).learn(1, progress=False).save(path)
    return path


def resume(path: Path, env: Any) -> kreps.KREPS:
    return kreps.KREPS.resume(path, env)


def create(path: Path, env: Any) -> kreps.KREPS:
    return kreps.KREPS(env, **TINY)


@pytest.mark.parametrize("make", [create, resume])
def test_a_new_and_a_resumed_learner_check_the_environment_alike(
    make: Callable[[Path, Any], kreps.KREPS], checkpoint: Path
) -> None:
    says = r"restart_probability = 0\.1, but the environment's RandomRestart has 0\.5"
    with pytest.raises(ConfigurationError, match=says):
        make(checkpoint, restarting(0.5))
    with pytest.raises(ConfigurationError, match="2 RandomRestart"):
        make(checkpoint, kreps.RandomRestart(restarting(0.1), 0.1))
    with pytest.raises(ConfigurationError, match="outermost"):
        make(checkpoint, limited(restarting(0.1)))
    with pytest.raises(ConfigurationError, match=r"str, but a single gymnasium\.Env"):
        make(checkpoint, SWING_UP)
    with pytest.raises(SpaceError, match="action space"):
        make(checkpoint, gym.make("CartPole-v1"))
    learner = make(checkpoint, restarting(0.1))
    assert not isinstance(learner.env, kreps.RandomRestart)
    assert learner.learn(1, progress=False).settings.restart_probability == 0.1


def test_resuming_checks_sizes_and_takes_no_task_for_an_environment(checkpoint: Path) -> None:
    task = kreps.KREPS.resume(checkpoint).task
    with pytest.raises(ConfigurationError, match=r"TaskSpec, but a single gymnasium\.Env"):
        resume(checkpoint, task)
    with pytest.raises(ConfigurationError, match="3 observation coordinates"):
        resume(checkpoint, gym.make("Pendulum-v1"))
    stronger = replace(task, action_high=np.array([31.0]))
    with pytest.raises(ConfigurationError, match="environment of the checkpoint"):
        environment_for(gym.make(SWING_UP), stronger, 0.1)


# ---- state ------------------------------------------------------------------------------------


def test_running_statistics_are_warned_of_when_a_learner_is_made_or_resumed(tmp_path: Path) -> None:
    env = gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1"))
    says = "NormalizeObservation scales by running statistics.*update_running_mean = False"
    with pytest.warns(UserWarning, match=says):
        learner = kreps.KREPS(env, **TINY)
    learner.learn(1, progress=False).save(tmp_path / "c")
    with pytest.warns(UserWarning, match=says):
        resume(tmp_path / "c", gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1")))
    with pytest.warns(UserWarning, match="NormalizeReward scales by running statistics"):
        kreps.KREPS(limited(gym.wrappers.NormalizeReward(gym.make("Pendulum-v1"))))


def test_fixed_statistics_are_no_state() -> None:
    env = gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1"))
    env.update_running_mean = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kreps.KREPS(env)
        kreps.KREPS(limited(gym.make("Pendulum-v1")))
