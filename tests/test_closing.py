"""Every environment that the program makes is closed: at the end, after an error, after Ctrl-C."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

from kreps.app import cli
from kreps.errors import ConfigurationError, EnvironmentFailure
from kreps.experiments.trials import Trial, run_trial
from kreps.learning.environment import opened

NAME = "kreps-tests/Robot-v0"


class Robot(gym.Env[Any, Any]):
    """Counts what is made and closed, and raises in a step or in close() if told to."""

    made: ClassVar[list[Robot]] = []
    fails: ClassVar[BaseException | signal.Signals | None] = None
    stuck: ClassVar[Exception | None] = None

    def __init__(self, render_mode: str | None = None, port: str = "none") -> None:
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
        self.render_mode, self.port, self.closed = render_mode, port, 0
        assert all(robot.closed for robot in Robot.made), "the robot is in use"
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (3,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        Robot.made.append(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(size=3), {}

    def step(self, action: Any) -> Any:
        if isinstance(Robot.fails, signal.Signals):
            signal.raise_signal(Robot.fails)
        elif Robot.fails is not None:
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


def test_an_environment_that_cannot_be_closed_hides_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Robot, "stuck", OSError("no answer"))
    says = "no answer; check whether it is still powered"
    with pytest.warns(match=says), opened(NAME):
        pass
    with pytest.warns(match=says), pytest.raises(KeyboardInterrupt), opened(NAME):
        raise KeyboardInterrupt
    assert closed() == [1, 1]


def test_an_environment_that_cannot_be_made_is_an_error() -> None:
    for name, arguments in (("missing-v0", {}), (NAME, {"id": 3}), (NAME, {"colour": "red"})):
        says = f"cannot make the environment '{name}'"
        with pytest.raises(ConfigurationError, match=says), opened(name, arguments):
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
    # without an error there is a second one, from which the settings of the trial follow
    assert closed() == [1] * (2 if error is None else 1)


# ---- command line -----------------------------------------------------------------------------

TINY = [
    *("--set", "initial_rollouts=4"),
    *("--set", "rollouts_per_iteration=2"),
    *("--set", "restart_probability=0.3"),
    *("--preset", "single_step"),
]


@pytest.fixture(autouse=True)
def _signals() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def call(*arguments: str | Path) -> int:
    """The exit code of a command."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(sys, "argv", ["kreps", *map(str, arguments)])
        patch.setattr(sys, "path", [each for each in sys.path if each])  # as of the installed one
        cli.main()
    code = stop.value.code
    return code if isinstance(code, int) else 0


def train(run: Path, *more: str) -> int:
    return call("train", NAME, "--iterations", "1", "--out", run, *TINY, *more)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    assert train(tmp_path / "run", "--no-report", "--env-arg", "port=7") == 0
    Robot.made.clear()
    return tmp_path / "run"


def test_training_closes_the_environment_before_it_makes_one_for_the_film(tmp_path: Path) -> None:
    assert train(tmp_path / "run") == 0
    assert closed() == [1, 1]
    assert [robot.render_mode for robot in Robot.made] == [None, "rgb_array"]
    assert (tmp_path / "run" / "video.gif").exists()


@pytest.mark.parametrize(
    "command",
    [
        ("resume", "--iterations", "2", "--no-report"),
        ("evaluate", "--episodes", "2", "--steps", "3"),
        ("plot",),
        ("video", "--steps", "3"),
    ],
)
def test_every_command_closes_its_environment(command: tuple[str, ...], run: Path) -> None:
    assert call(command[0], run, *command[1:]) == 0
    assert closed() == [1]


STOPS = {
    "an error": RuntimeError("motor"),
    "Ctrl-C": KeyboardInterrupt(),
    "kill": signal.SIGTERM,
    "a closed terminal": signal.SIGHUP,
}


@pytest.mark.parametrize("stop", list(STOPS))
@pytest.mark.parametrize(
    "command",
    [
        ("resume", "--iterations", "2"),
        ("evaluate", "--episodes", "2", "--steps", "3"),
        ("video", "--steps", "3"),
    ],
)
def test_a_command_that_is_stopped_closes_its_environment(
    command: tuple[str, ...], stop: str, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Robot, "fails", STOPS[stop])
    assert call(command[0], run, *command[1:]) in (1, 2, 130)
    assert closed() == [1]


def test_a_learner_that_cannot_be_made_leaves_no_open_environment(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "--set", "kl_bound=-1") == 2
    assert closed() == [1]


def test_arguments_of_the_environment_are_kept_with_the_run(run: Path) -> None:
    assert json.loads((run / "config.json").read_text())["arguments"] == {"port": 7}
    assert call("evaluate", run, "--episodes", "2", "--steps", "3") == 0
    assert call("video", run, "--steps", "3") == 0
    assert [robot.port for robot in Robot.made] == [7, 7]


def test_arguments_of_the_environment_are_text_or_json(tmp_path: Path) -> None:
    for number, (text, value) in enumerate(
        {"port=/dev/a=b": "/dev/a=b", "port=[1, 2]": [1, 2], "port=none": None}.items()
    ):
        assert train(tmp_path / str(number), "--no-report", "--env-arg", text) == 0
        assert Robot.made[-1].port == value


@pytest.mark.parametrize("text", ["port", "colour=red"])
def test_wrong_arguments_of_the_environment_are_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "--env-arg", text) == 2
    assert text.split("=")[0] in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_module_in_the_current_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_arm_of_tests.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('my/Arm-v0', entry_point='kreps.envs.swing_up:SwingUp')\n"
    )
    monkeypatch.chdir(tmp_path)
    options = ["--iterations", "1", "--no-report", *TINY]
    assert call("train", "my_arm_of_tests:my/Arm-v0", "--out", "run", *options) == 0
    del sys.modules["my_arm_of_tests"]
    assert call("evaluate", "run", "--episodes", "2", "--steps", "3") == 0
    del gym.registry["my/Arm-v0"]
