"""Every environment that the program makes is closed: at the end, after an error, after Ctrl-C."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

from kreps.errors import ConfigurationError, EnvironmentFailure
from kreps.experiments.trials import Trial, run_trial
from kreps.learning.environment import opened

NAME = "kreps-tests/Robot-v0"


class Robot(gym.Env[Any, Any]):
    """Counts what is made and closed, and raises in a step or in close() if told to."""

    made: ClassVar[list[Robot]] = []
    fails: ClassVar[BaseException | None] = None
    stuck: ClassVar[Exception | None] = None

    def __init__(self, render_mode: str | None = None, port: str = "none") -> None:
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
        self.render_mode, self.port, self.closed = render_mode, port, 0
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (3,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        Robot.made.append(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(size=3), {}

    def step(self, action: Any) -> Any:
        if Robot.fails is not None:
            raise Robot.fails
        return self.np_random.normal(size=3), -float(action[0] ** 2), False, False, {}

    def render(self) -> Any:
        return np.zeros((4, 4, 3), np.uint8)

    def close(self) -> None:
        self.closed += 1
        if Robot.stuck is not None:
            raise Robot.stuck


@pytest.fixture(autouse=True)
def _robot(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(Robot, "made", [])
    gym.register(NAME, entry_point=Robot, max_episode_steps=6)
    yield
    del gym.registry[NAME]


def closed() -> list[int]:
    """How often each environment that was made was closed."""
    return [robot.closed for robot in Robot.made]


def test_an_environment_is_closed_at_the_end() -> None:
    with opened(NAME, {"port": "/dev/ttyUSB0"}) as env:
        assert env.unwrapped.port == "/dev/ttyUSB0"  # type: ignore[attr-defined]
        assert closed() == [0]
    assert closed() == [1]


@pytest.mark.parametrize("error", [RuntimeError("motor"), KeyboardInterrupt(), SystemExit(143)])
def test_an_environment_is_closed_after_an_error(error: BaseException) -> None:
    with pytest.raises(type(error)), opened(NAME):
        raise error
    assert closed() == [1]


def test_an_environment_that_cannot_be_closed_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Robot, "stuck", OSError("no answer"))
    unanswered = pytest.raises(
        EnvironmentFailure, match="no answer; check whether it is still powered"
    )
    with unanswered, opened(NAME):
        pass
    with (
        pytest.warns(UserWarning, match="still powered"),
        pytest.raises(KeyboardInterrupt),
        opened(NAME),
    ):
        raise KeyboardInterrupt
    assert closed() == [1, 1]


def test_an_environment_that_cannot_be_made_is_an_error() -> None:
    for name, arguments in (("missing-v0", {}), (NAME, {"id": 3}), (NAME, {"colour": "red"})):
        unmade = pytest.raises(ConfigurationError, match=f"cannot make the environment '{name}'")
        with unmade, opened(name, arguments):
            pass


@pytest.mark.parametrize("error", [None, RuntimeError("motor"), KeyboardInterrupt()])
def test_a_trial_closes_its_environment(
    error: BaseException | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"initial_rollouts": 4, "preset": "single_step", "restart_probability": 0.3}
    trial = Trial("robot", "reps", NAME, "reps", options, 1, 0, (2, 2))
    if error is None:
        assert len(run_trial(trial)["rows"]) == 1
    else:
        monkeypatch.setattr(Robot, "fails", error)
        with pytest.raises((EnvironmentFailure, KeyboardInterrupt)):
            run_trial(trial)
    assert closed() == [1]
