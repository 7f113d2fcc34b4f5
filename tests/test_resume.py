"""What was learnt is kept: resumed, stopped and killed runs give the bytes of an untouched one."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.app.run_folder import RunConfig, RunFolder
from kreps.learning.iteration import IterationReport

BATCHES: dict[str, Any] = {
    "initial_rollouts": 6,
    "rollouts_per_iteration": 3,
    "growth": 0.0,
    "window": 12,
    "window_steps": 0,
    "restart_probability": 0.1,
}
TINY = BATCHES | {"model_based.improvement_steps": 1, "model_based.acceptance_rollouts": 10}
"""In the first four updates a rollout is forgotten and a policy is rejected."""
NAME = "kreps/SwingUp-v0"
COMMAND = [sys.executable, "-m", "kreps"]
SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={value}")]
ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}


def train(run: Path, iterations: int) -> list[str]:
    options = ["--iterations", str(iterations), "--seed", "3", "--out", str(run), "--no-report"]
    return [*COMMAND, "train", NAME, *options, *SETTINGS]


def resume(run: Path, iterations: int) -> list[str]:
    return [*COMMAND, "resume", str(run), "--iterations", str(iterations), "--no-report"]


def call(command: list[str]) -> None:
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env=ENVIRONMENT
    )
    assert done.returncode == 0, done.stdout[-500:] + done.stderr[-1500:]


def start(command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        bufsize=1,
        env=ENVIRONMENT,
    )


def rows(run: Path) -> list[dict[str, str]]:
    """Of ``progress.csv``, without what depends on the machine."""
    with (run / "progress.csv").open(newline="") as file:
        return [
            {name: value for name, value in row.items() if not name.startswith("cpu_seconds")}
            for row in csv.DictReader(file)
        ]


def assert_same_run(run: Path, other: Path, iterations: int) -> None:
    for name in ("policy.safetensors", "checkpoint.safetensors"):
        assert (run / name).read_bytes() == (other / name).read_bytes()
    assert [int(row["iteration"]) for row in rows(run)] == list(range(1, iterations + 1))
    assert rows(run) == rows(other)
    leftovers = {p.name for p in run.iterdir()} - {p.name for p in other.iterdir()}
    assert leftovers == set()


def untouched(path: Path, iterations: int) -> Path:
    """The folder of a run that learns in this process, without a stop."""
    run = RunFolder(path / "untouched")
    run.create(RunConfig(NAME, iterations, 3, "model_based", TINY, None))
    learner = kreps.KREPS(gym.make(NAME), seed=3, **TINY)
    learner.learn(iterations, callback=run, progress=False)
    return run.path


# ---- in one process ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"preset": "single_step", "model": "sample"},
        {"value": "grid"},
        {"policy_fit": "bounded"},
    ],
)
def test_two_and_two_iterations_are_four(settings: dict[str, Any], tmp_path: Path) -> None:
    def learner() -> kreps.KREPS:
        tiny = BATCHES if "preset" in settings else TINY
        return kreps.KREPS(gym.make(NAME), seed=5, **tiny, **settings)

    learner().learn(2, progress=False).save(tmp_path / "half")
    resumed = kreps.KREPS.resume(tmp_path / "half", gym.make(NAME)).learn(2, progress=False)
    whole = learner().learn(4, progress=False)
    for name, each in (("resumed", resumed), ("whole", whole)):
        each.save(tmp_path / name)
        each.policy.save(tmp_path / f"{name} policy")
    assert (tmp_path / "resumed policy").read_bytes() == (tmp_path / "whole policy").read_bytes()
    assert (tmp_path / "resumed").read_bytes() == (tmp_path / "whole").read_bytes()
    assert (tmp_path / "half").read_bytes() != (tmp_path / "whole").read_bytes()


def test_resuming_goes_on_by_update_too(tmp_path: Path) -> None:
    env = gym.make(NAME)
    source = kreps.KREPS(env, seed=1, **TINY).learn(2, progress=False)
    first, second = source.state.window.rollouts[:3], source.state.window.rollouts[3:]
    whole = kreps.KREPS(source.task, seed=2, **TINY)
    whole.update(first)
    whole.save(tmp_path / "half")
    whole.update(second)
    resumed = kreps.KREPS.resume(tmp_path / "half")
    resumed.update(second)
    states = np.random.default_rng(0).normal(size=(9, 2))
    np.testing.assert_array_equal(
        resumed.policy.predict(states)[0], whole.policy.predict(states)[0]
    )


class Killed(BaseException):
    """As final as SIGKILL: nothing in the library may catch it."""


def test_a_run_stopped_before_any_of_its_writes_goes_on_as_if_never_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def learner(run: RunFolder) -> kreps.KREPS:
        env = gym.make(NAME)
        if run.checkpoint_file.exists():
            return kreps.KREPS.resume(run.checkpoint_file, env)
        return kreps.KREPS(env, seed=3, **TINY)

    config = RunConfig(NAME, 2, 3, "model_based", TINY, None)
    whole = RunFolder(tmp_path / "whole")
    whole.create(config)
    learner(whole).learn(2, callback=whole, progress=False)
    original = os.replace
    stopped = 0
    for survived in range(8):
        run = RunFolder(tmp_path / f"stopped before write {survived}")
        run.create(config)
        left = survived

        def replace(*paths: Any, **options: Any) -> None:
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1
            original(*paths, **options)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", replace)
            try:
                learner(run).learn(2, callback=run, progress=False)
            except Killed:
                stopped += 1
        done = learner(run)
        done.learn(2 - done.state.iteration, callback=run, progress=False)
        assert_same_run(run.path, whole.path, 2)
    assert stopped == 6  # three files an iteration, two iterations


def test_a_checkpoint_is_written_after_every_iteration(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.create(RunConfig(NAME, 3, 0, "model_based", TINY, None))
    seen: list[int] = []

    def look(learner: kreps.KREPS, report: IterationReport) -> None:
        on_disk = kreps.KREPS.resume(run.checkpoint_file)
        assert on_disk.state.iteration == report.iteration
        states = np.random.default_rng(0).normal(size=(9, 2))
        np.testing.assert_array_equal(
            kreps.load_policy(run.policy_file).predict(states, deterministic=True)[0],
            learner.policy.predict(states, deterministic=True)[0],
        )
        assert len(run.rows()) == report.iteration
        seen.append(report.iteration)

    kreps.KREPS(gym.make(NAME), **TINY).learn(3, callback=[run, look], progress=False)
    assert seen == [1, 2, 3]


# ---- in real processes ------------------------------------------------------------------------


@pytest.mark.slow
def test_five_iterations_and_five_more_in_another_process_are_ten(tmp_path: Path) -> None:
    run = tmp_path / "run"
    call(train(run, 5))
    assert len(rows(run)) == 5
    half = (run / "policy.safetensors").read_bytes()
    call(resume(run, 10))
    assert half != (run / "policy.safetensors").read_bytes()
    assert_same_run(run, untouched(tmp_path, 10), 10)


@pytest.mark.slow
def test_ctrl_c_leaves_a_run_that_can_be_resumed(tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(train(run, 1000))
    assert process.stdout is not None
    for _ in range(3):
        assert process.stdout.readline().startswith("iter")
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[0]
    assert process.returncode == 130
    assert "Traceback" not in said
    assert "continue with: kreps resume" in " ".join(said.split())
    total = len(rows(run)) + 2
    assert total >= 4  # the third may have been shown but not yet written
    call(resume(run, total))
    assert_same_run(run, untouched(tmp_path, total), total)


@pytest.mark.slow
def test_a_run_killed_at_ten_random_moments_gives_the_bytes_of_an_untouched_one(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(20)
    run, forever = tmp_path / "killed", 100_000
    began = time.perf_counter()
    call([*COMMAND, "--help"])
    start_up = time.perf_counter() - began  # on this machine, as busy as it is
    learnt = [0]
    for kill in range(10):
        resuming = (run / "config.json").exists()
        process = start(resume(run, forever) if resuming else train(run, forever))
        assert process.stdout is not None
        if kill % 3 == 0:  # anywhere from the first import to the first iterations
            time.sleep(rng.uniform(0.0, 1.3) * start_up)
        else:  # in rollouts, updates and writing, one to three iterations later
            wanted = int(rng.integers(1, 3))
            while wanted > 0:
                line = process.stdout.readline()
                assert line, "it ended by itself"
                wanted -= line.startswith("iter")
            time.sleep(rng.uniform(0.0, 0.15))
        process.kill()
        said = process.communicate(timeout=60)[0]
        assert process.returncode == -signal.SIGKILL, said
        learnt.append(len(rows(run)) if (run / "progress.csv").exists() else 0)
    progress = np.diff(learnt)
    assert (progress >= 0).all()  # nothing was lost,
    assert (progress == 0).sum() >= 1  # some were killed before they had done anything
    assert (progress > 0).sum() >= 5  # and most in the midst of it
    done = learnt[-1]
    total = done + 2
    call(resume(run, total))
    assert_same_run(run, untouched(tmp_path, total), total)
