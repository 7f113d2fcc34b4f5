"""Callbacks for checkpoints, evaluation and stopping, and what loggers write, read back."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.errors import ConfigurationError, StorageError
from kreps.learning import callbacks
from kreps.learning.evaluate import Evaluation, Greedy, evaluate
from kreps.learning.iteration import IterationReport
from kreps.learning.loggers import scalars

NAME = "kreps/SwingUp-v0"
FEW = {
    "preset": "single_step",
    "initial_rollouts": 4,
    "rollouts_per_iteration": 3,
    "restart_probability": 0.1,
}


def learner(**settings: Any) -> kreps.KREPS:
    return kreps.KREPS(gym.make(NAME), seed=1, **FEW, **settings)


class Reports:
    """A callback that keeps all reports."""

    def __init__(self) -> None:
        self.all: list[IterationReport] = []

    def __call__(self, learner: kreps.KREPS, report: IterationReport) -> None:
        self.all.append(report)


def learnt(callback: Any, iterations: int = 3, **settings: Any) -> tuple[kreps.KREPS, Reports]:
    reports = Reports()
    made = learner(**settings)
    made.learn(iterations, callback=[*callback, reports], progress=False)
    return made, reports


# ---- checkpoints, evaluation, stopping --------------------------------------------------------


def test_learning_resumed_from_a_checkpoint_gives_the_same_policy(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    whole, _ = learnt([kreps.Checkpoint(folder, every=2)], 5)
    assert sorted(path.name for path in folder.iterdir()) == [
        "000002.safetensors",
        "000004.safetensors",
    ]
    resumed = kreps.KREPS.resume(folder / "000004.safetensors", gym.make(NAME))
    resumed.learn(1, progress=False).policy.save(tmp_path / "resumed")
    whole.policy.save(tmp_path / "whole")
    assert (tmp_path / "resumed").read_bytes() == (tmp_path / "whole").read_bytes()
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot make the folder"):
        learnt([kreps.Checkpoint(tmp_path / "file" / "below")], 1)


@pytest.mark.parametrize("deterministic", [True, False])
def test_an_evaluation_is_that_of_the_policy_and_changes_nothing(
    deterministic: bool, tmp_path: Path
) -> None:
    evaluation = kreps.EvalCallback(
        every=2, episodes=3, steps=50, seed=7, deterministic=deterministic, best=tmp_path / "best"
    )
    evaluated, reports = learnt([evaluation], 4, exploration="pink", action_repeat=2)
    plain, _ = learnt([], 4, exploration="pink", action_repeat=2)
    for each, name in ((evaluated, "a"), (plain, "b")):
        each.save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert [steps for steps, _ in evaluation.evaluations] == [r.steps for r in reports.all[1::2]]
    process = plain.policy.process
    again = evaluate(
        gym.make(NAME),
        plain.task,
        Greedy(process) if deterministic else process,
        restart_probability=plain.restart_probability,
        episodes=3,
        steps=50,
        seed=7,
    )
    assert evaluation.evaluations[-1][1] == again
    means = [found.mean for _, found in evaluation.evaluations]
    assert evaluation.best_mean_reward == max(means)
    if means[1] > means[0]:
        plain.policy.save(tmp_path / "latest")
        assert (tmp_path / "best").read_bytes() == (tmp_path / "latest").read_bytes()


def test_only_a_better_policy_replaces_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = iter(Evaluation(mean, 0.1, 1, 5) for mean in (-3.0, -1.0, -2.0))
    monkeypatch.setattr(callbacks, "evaluate", lambda *given, **more: next(results))
    evaluation = kreps.EvalCallback(episodes=1, steps=5, best=tmp_path / "best")
    policies: list[bytes] = []

    def keep(learner: kreps.KREPS, report: IterationReport) -> None:
        learner.policy.save(tmp_path / "now")
        policies.append((tmp_path / "now").read_bytes())

    learnt([evaluation, keep])
    assert evaluation.best_mean_reward == -1.0
    assert (tmp_path / "best").read_bytes() == policies[1]
    assert len(set(policies)) == 3


def test_learning_ends_at_a_reward_of_training_or_of_an_evaluation() -> None:
    _, reports = learnt([], 4)
    rewards = [report.average_reward for report in reports.all]
    threshold = max(rewards[:2])
    _, until = learnt([kreps.StopOnReward(threshold)], 4)
    assert [report.average_reward for report in until.all] == rewards[
        : rewards.index(threshold) + 1
    ]

    evaluation = kreps.EvalCallback(every=2, episodes=2, steps=30)
    never = kreps.StopOnReward(float("inf"), evaluation)
    assert len(learnt([evaluation, never], 3)[1].all) == 3
    evaluation = kreps.EvalCallback(every=2, episodes=2, steps=30)
    always = kreps.StopOnReward(-1e9, evaluation)
    assert len(learnt([evaluation, always], 3)[1].all) == 2


@pytest.mark.parametrize(
    "make",
    [
        lambda: kreps.Checkpoint("x", every=0),
        lambda: kreps.EvalCallback(every=0),
        lambda: kreps.EvalCallback(episodes=0),
        lambda: kreps.EvalCallback(steps=0),
    ],
)
def test_periods_below_one_are_rejected(make: Any) -> None:
    with pytest.raises(ConfigurationError, match="= 0, but it must be at least 1"):
        make()


# ---- loggers ----------------------------------------------------------------------------------


def logged(make: Any) -> list[tuple[int, dict[str, float]]]:
    """Steps and numbers of each iteration that a logger was given."""
    evaluation = kreps.EvalCallback(every=2, episodes=2, steps=30)
    _, reports = learnt([evaluation, make(evaluation)])
    wanted = [(report.steps, scalars(report, evaluation)) for report in reports.all]
    assert ["eval/mean_reward" in numbers for _, numbers in wanted] == [False, True, False]
    return wanted


def test_the_numbers_are_those_of_the_report() -> None:
    _, reports = learnt([], 1)
    (report,) = reports.all
    found = scalars(report)
    assert found["rollout/average_reward"] == report.average_reward
    assert found["update/kl"] == report.update.dual.kl
    assert found["update/model_error"] == report.update.model_error
    assert found["cpu_seconds/dual"] == report.update.seconds["dual"]
    assert all(type(value) is float and math.isfinite(value) for value in found.values())
    grid = kreps.GridValueIteration(
        gym.make(NAME), ranges=((-3, 3), (-8, 8)), grid_states=3, grid_actions=2
    )
    kept = Reports()
    grid.learn(1, callback=kept, progress=False)
    assert "update/samples" in scalars(kept.all[0])


def test_tensorboard_reads_what_is_logged(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.util import tensor_util

    wanted = logged(lambda evaluation: kreps.TensorBoard(tmp_path, evaluation))
    events = EventAccumulator(str(tmp_path)).Reload()
    assert set(events.Tags()["tensors"]) == {name for _, numbers in wanted for name in numbers}
    for name in events.Tags()["tensors"]:
        found = [(e.step, tensor_util.make_ndarray(e.tensor_proto)) for e in events.Tensors(name)]
        given = [(steps, numbers[name]) for steps, numbers in wanted if name in numbers]
        np.testing.assert_allclose(found, given, rtol=1e-6)  # they are stored in single precision


def test_without_tensorboard_the_remedy_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard.summary", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'kreps\[tensorboard\]'"):
        kreps.TensorBoard(tmp_path)


def test_a_run_of_weights_and_biases_gets_numbers_and_settings(tmp_path: Path) -> None:
    wandb = pytest.importorskip("wandb")
    with wandb.init(project="kreps", mode="offline", dir=tmp_path) as run:
        wanted = logged(lambda evaluation: kreps.WandB(run, evaluation))
        assert run.config["seed"] == 1 and run.config["value.max_rank"] == 400
        _, numbers = wanted[1]  # those of a step are in the summary once the next one is there
        assert {name: run.summary[name] for name in numbers} == numbers
        assert run.step == wanted[2][0]
    (file,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    written = [repr(numbers["update/kl"]).encode() for _, numbers in wanted]
    end = time.monotonic() + 20.0  # the file is written by another process
    while not all(each in file.read_bytes() for each in written):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_run_of_mlflow_gets_numbers_and_settings(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    mlflow.set_tracking_uri(f"sqlite:///{tmp_path}/mlflow.db")
    with mlflow.start_run() as run:
        wanted = logged(lambda evaluation: kreps.MLflow(run, evaluation))
    client, identifier = mlflow.MlflowClient(), run.info.run_id
    assert client.get_run(identifier).data.params["kl_bound"] == "1.0"
    for name in {name for _, numbers in wanted for name in numbers}:
        found = [(m.step, m.value) for m in client.get_metric_history(identifier, name)]
        assert found == [(steps, numbers[name]) for steps, numbers in wanted if name in numbers]
