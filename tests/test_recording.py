"""Films of environments that draw badly: a picture is copied when it comes, and checked."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.app.environments import labels_of
from kreps.app.recording import frame_rate, picture_of, record
from kreps.data.task import TaskSpec
from kreps.errors import EnvironmentFailure

RED = np.zeros((4, 5, 3), np.uint8)
RED[..., 0] = 255


class Drawn(gym.Env[Any, Any]):
    """A point on a line that draws into one buffer and observes by one buffer."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    returned: Any = None

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-9.0, 9.0, (1,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.picture, self.state, self.steps = np.zeros((8, 40, 3), np.uint8), np.zeros(1), 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.state[:] = self.steps = 0
        return self.state, {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        self.state += 0.1
        return self.state, -float(self.state[0] ** 2), False, False, {}

    def render(self) -> Any:
        self.picture[:] = 0
        self.picture[:, self.steps % 40] = 255
        return self.picture if self.returned is None else self.returned


@pytest.fixture(scope="module")
def policy() -> kreps.Policy:
    settings: dict[str, Any] = {"initial_rollouts": 6, "restart_probability": 0.1}
    return kreps.KREPS(Drawn(), **settings).learn(1, progress=False).policy


@pytest.mark.parametrize(
    "drawn",
    [
        RED,
        [RED * 0, RED],  # of an environment that returns all pictures since the last call
        np.dstack([RED, RED[..., 1]]),  # with transparency
        RED / 255.0,
        RED.astype(np.int64) * 3,
        RED.astype(np.float64),
    ],
)
def test_every_usual_form_of_a_picture_is_read(drawn: Any) -> None:
    np.testing.assert_array_equal(picture_of(drawn), RED)


def test_grey_values_are_the_same_in_all_three_colours() -> None:
    grey = np.arange(20, dtype=np.uint8).reshape(4, 5)
    for drawn in (grey, grey[..., None]):
        np.testing.assert_array_equal(picture_of(drawn), np.dstack([grey] * 3))
    np.testing.assert_array_equal(picture_of(np.eye(3, dtype=bool))[..., 2], np.eye(3) * 255)
    np.testing.assert_array_equal(picture_of(np.full((2, 2), np.nan)), np.zeros((2, 2, 3)))


def test_a_large_picture_is_thinned_out() -> None:
    assert picture_of(np.zeros((1080, 1920, 3), np.uint8)).shape == (360, 640, 3)


@pytest.mark.parametrize(
    ("drawn", "says"),
    [
        (None, "None instead of a picture"),
        ([], "a list"),
        ("##  ##", "a str"),
        (3.0, "a float"),
        (np.zeros((2, 3, 4, 5)), r"shape \(2, 3, 4, 5\)"),
        (np.zeros((0, 3, 3)), r"shape \(0, 3, 3\)"),
        (np.zeros((4, 4, 7)), r"shape \(4, 4, 7\)"),
        (np.full((4, 4), "a"), "<U1 pixels"),
        (np.full((4, 4), None), "object pixels"),
    ],
)
def test_what_is_no_picture_is_named(drawn: Any, says: str) -> None:
    with pytest.raises(EnvironmentFailure, match=says):
        picture_of(drawn)


@pytest.mark.parametrize(
    ("metadata", "fps"),
    [
        ({"render_fps": 30}, 30.0),
        ({"render_fps": "25"}, 25.0),
        ({"render_fps": None}, 20.0),
        ({"render_fps": 0}, 20.0),
        ({"render_fps": -3}, 20.0),
        ({"render_fps": float("nan")}, 20.0),
        ({"render_fps": float("inf")}, 1000.0),
        ({"render_fps": "fast"}, 20.0),
        ({"render_fps": 1e-9}, 0.1),
        ({"render.modes": ["human"]}, 20.0),
        ({}, 20.0),
    ],
)
def test_a_frame_rate_that_is_no_positive_number_is_twenty(
    metadata: dict[str, Any], fps: float
) -> None:
    assert frame_rate(metadata) == fps


def test_pictures_and_observations_in_reused_buffers_are_copied(policy: kreps.Policy) -> None:
    seen = record(Drawn(), policy, 6, seed=0, deterministic=True)
    assert [int(frame[0, :, 0].argmax()) for frame in seen.frames] == list(range(6))
    np.testing.assert_allclose(seen.observations[:, 0], 0.1 * np.arange(6))
    assert seen.actions.shape == (6, 1) and seen.fps == 20.0


def test_an_environment_that_draws_nothing_makes_no_step(policy: kreps.Policy) -> None:
    env = Drawn()
    env.returned = [[]]
    with pytest.raises(EnvironmentFailure, match="render"):
        record(env, policy, 6, seed=0, deterministic=True)
    assert env.steps == 0


@pytest.mark.parametrize(
    ("metadata", "labels"),
    [
        (None, (["observation 0"], ["action 0"])),
        (["old"], (["observation 0"], ["action 0"])),
        ({"action_labels": []}, (["observation 0"], ["action 0"])),
        ({"observation_labels": "x", "action_labels": 3}, (["observation 0"], ["action 0"])),
        ({"observation_labels": ["$x"], "action_labels": ("u [N]",)}, ([r"\$x"], ["u [N]"])),
    ],
)
def test_labels_that_are_not_usable_are_numbered(metadata: Any, labels: Any) -> None:
    env = Drawn()
    env.metadata = metadata
    assert labels_of(env, TaskSpec(1, [-1.0], [1.0])) == labels
