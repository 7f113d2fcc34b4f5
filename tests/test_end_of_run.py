"""What happens after the last update never loses or hides what was learnt."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from kreps.app import cli
from kreps.app.evaluation import say_evaluation
from kreps.learning.evaluate import Evaluation
from kreps.learning.storage import load_policy

SMALL = ["--set", "initial_rollouts=6", "--set", "restart_probability=0.1"]
SMALL += ["--set", "model_based.acceptance_rollouts=2", "--set", "model_based.improvement_steps=1"]


class Point(gym.Env[Any, Any]):
    """A point on a line; what `render` does, and when a reset fails, are set by a test."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    drawn: Any = None
    resets_left = 10**9

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(-9.0, 9.0, (1,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        Point.resets_left -= 1
        if Point.resets_left < 0:
            raise RuntimeError("the motor is too hot")
        self.state = self.np_random.uniform(-1.0, 1.0, size=1)
        return self.state, {}

    def step(self, action: Any) -> Any:
        self.state = np.clip(self.state + 0.3 * action, -5.0, 5.0)
        return self.state, -float(self.state[0] ** 2), False, False, {}

    def render(self) -> Any:
        return self.drawn() if callable(self.drawn) else self.drawn


@pytest.fixture(autouse=True)
def _point(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(Point, "resets_left", 10**9)
    gym.register("kreps-tests/Point-v0", entry_point=Point)
    yield
    del gym.registry["kreps-tests/Point-v0"]


def train(run: Path, monkeypatch: pytest.MonkeyPatch, *more: str) -> Any:
    """The exit status of training for one update."""
    command = ["kreps", "train", "kreps-tests/Point-v0", "--iterations", "1", "--out", str(run)]
    monkeypatch.setattr(sys, "argv", [*command, *SMALL, *more])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return stop.value.code


def ends_the_program() -> Any:
    sys.exit("no display")


def raises() -> Any:
    raise ImportError("no OpenGL")


@pytest.mark.parametrize(
    ("drawn", "says"),
    [
        (None, "render() returned None"),
        (ends_the_program, "SystemExit: no display"),
        (raises, "ImportError: no OpenGL"),
        (lambda: "ascii art", "render() returned a str"),
        (lambda: [np.zeros((9, 9, 3), np.uint8)] * 2, None),
    ],
)
def test_the_result_is_printed_before_a_film_that_may_fail(
    drawn: Any,
    says: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(Point, "drawn", staticmethod(drawn) if callable(drawn) else drawn)
    assert train(tmp_path / "run", monkeypatch) == 0
    out = capsys.readouterr().out
    result = out.index("The learnt policy earns")
    assert result < out.index("Continue:") < out.index("learning_curve.png")
    if says is None:
        assert "no film" not in out and (tmp_path / "run" / "video.gif").exists()
    else:
        assert out.index("no film") > result
        assert says in " ".join(out.split())


def test_an_evaluation_that_fails_leaves_a_run_that_has_learnt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Point, "resets_left", 8)  # six for learning
    assert train(tmp_path / "run", monkeypatch) == 0
    out = capsys.readouterr().out
    assert "no evaluation" in out and "the motor is too hot" in out
    assert "The last training rollouts earned -" in out and "Continue:" in out
    assert not (tmp_path / "run" / "evaluation.json").exists()
    load_policy(tmp_path / "run" / "policy.safetensors")


def test_files_that_cannot_be_written_do_not_hide_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("evaluation.json", "learning_curve.png"):
        (tmp_path / name / "in the way").mkdir(parents=True)
    assert train(tmp_path, monkeypatch) == 0
    out = capsys.readouterr().out
    assert "no evaluation.json" in out and "no pictures" in out
    assert "The learnt policy earns -" in out


@pytest.mark.parametrize(
    ("mean", "error", "numbers"),
    [
        (-1.6855e-7, 1.4e-8, ["-1.6855e-07", "2.8e-08"]),
        (-1.6855e60, 1.4e59, ["-1.6855e+60", "2.8e+59"]),
        (-61.8862, 0.0662, ["-61.886", "0.13"]),
        (0.0, 0.0, ["0", "0"]),
    ],
)
def test_rewards_of_any_scale_are_printed(
    mean: float, error: float, numbers: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    say_evaluation({"greedy": Evaluation(mean, error, 10, 20)})
    (row,) = (line for line in capsys.readouterr().out.splitlines() if "greedy" in line)
    assert row.replace("│", " ").split() == ["greedy", *numbers]


# ---- as a process -------------------------------------------------------------------------------

KREPS = [sys.executable, "-m", "kreps"]
TRAIN = [*KREPS, "train", "kreps/SwingUp-v0", "--iterations", "2", *SMALL, "--out"]
FILES = {"config.json", "progress.csv", "checkpoint.safetensors", "policy.safetensors"}
AT_END = {"evaluation.json", "learning_curve.png", "policy_maps.png", "video.gif"}


def names(run: Path) -> set[str]:
    return {path.name for path in run.iterdir()}


def test_a_run_whose_reader_leaves_is_learnt_to_its_end(tmp_path: Path) -> None:
    with subprocess.Popen(
        [*TRAIN, tmp_path / "run"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().startswith("iter 1")
        process.stdout.close()  # as `| head -1` does
        errors = process.stderr.read()
    assert process.returncode == 0 and errors == ""
    assert names(tmp_path / "run") >= FILES | AT_END


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is full")
def test_a_run_whose_log_is_full_is_learnt_to_its_end(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*TRAIN, tmp_path / "run"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "error: standard output was lost: No space left on device; "
        "all files of the command are written"
    ]
    assert names(tmp_path / "run") >= FILES | AT_END


def test_an_ascii_log_holds_the_whole_report(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "MPLBACKEND": "nonsense"}
    done = subprocess.run(
        [*TRAIN, tmp_path / "run"], capture_output=True, env=environment, check=True
    )
    text = done.stdout.decode("ascii")
    greedy = json.loads((tmp_path / "run" / "evaluation.json").read_text())["greedy"]
    number = f"{greedy['mean']:.4g} +/- {2 * greedy['standard_error']:.2g} per step"
    assert number in text and "Continue:" in text
    assert names(tmp_path / "run") >= FILES | AT_END  # a wrong MPLBACKEND does not matter


def test_a_full_disk_while_learning_is_an_error_that_says_how_to_continue(tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, resource.RLIM_INFINITY))

    run = tmp_path / "run"
    done = subprocess.run([*TRAIN, run], capture_output=True, text=True, preexec_fn=limit)
    assert done.returncode == 2
    assert "cannot write" in done.stderr and "Traceback" not in done.stderr
    assert f"kreps resume {run}" in done.stdout
    subprocess.run([*KREPS, "resume", run, "--no-report"], check=True, capture_output=True)
    assert names(run) == FILES
