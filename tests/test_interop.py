"""Other libraries' own functions on policies, learners, environments and results of kreps."""

from __future__ import annotations

import csv
import json
import shlex
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.app import cli
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError, DataError
from kreps.experiments.scores import score_arrays

FEW = {"preset": "single_step", "initial_rollouts": 4, "rollouts_per_iteration": 3}
LIMIT, COUNT = 30, 3


def pendulum() -> gym.Env[Any, Any]:
    """Episodes of 30 steps."""
    return gym.make("Pendulum-v1", max_episode_steps=LIMIT)


@pytest.fixture(scope="module")
def policy() -> kreps.Policy:
    """A policy that holds actions and knows earlier steps, so that it depends on its state."""
    options: dict[str, Any] = {"action_repeat": 4, "history": 1, "delay": 2, **FEW}
    return kreps.KREPS(pendulum(), seed=0, **options).learn(1, progress=False).policy


def returns(policy: kreps.Policy, seed: int) -> list[float]:
    """Returns of two episodes of one environment, each with a new state of the policy."""
    env, found = pendulum(), []
    for start in (seed, None):
        observation, _ = env.reset(seed=start)
        state, total, ended = None, 0.0, False
        while not ended:
            action, state = policy.predict(observation, state, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, ended = total + float(reward), terminated or truncated
        found.append(total)
    return found


# ---- Stable-Baselines3 ------------------------------------------------------------------------


def test_evaluate_policy_in_a_vec_env_gives_the_returns_of_single_environments(
    policy: kreps.Policy,
) -> None:
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    vectors = pytest.importorskip("stable_baselines3.common.vec_env")
    env = vectors.VecMonitor(vectors.DummyVecEnv([pendulum] * COUNT))
    env.seed(7)  # environment i gets the seed 7 + i
    found, lengths = evaluation.evaluate_policy(
        policy, env, n_eval_episodes=2 * COUNT, return_episode_rewards=True
    )
    alone = [each for i in range(COUNT) for each in returns(policy, 7 + i)]
    np.testing.assert_allclose(sorted(found), sorted(alone), rtol=1e-5)  # rewards in float32
    assert lengths == [LIMIT] * 2 * COUNT


def test_a_learner_is_evaluated_and_learns_in_a_monitor(tmp_path: Path) -> None:
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    monitor = pytest.importorskip("stable_baselines3.common.monitor")
    plain = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=0, **FEW)
    env = monitor.Monitor(
        gym.make("kreps/SwingUp-v0", max_episode_steps=LIMIT), str(tmp_path / "m")
    )
    learner = kreps.KREPS(env, seed=0, **FEW)
    assert learner.task.periodic == plain.task.periodic == (0,)
    learner.learn(1, progress=False)
    assert env.get_total_steps() == learner.state.steps
    mean, _ = evaluation.evaluate_policy(learner, env, n_eval_episodes=2)
    np.testing.assert_allclose(np.mean(env.get_episode_rewards()[-2:]), mean)
    env.close()
    with open(tmp_path / "m.monitor.csv") as file:
        file.readline()  # a comment
        rows = list(csv.DictReader(file))
    assert [float(row["r"]) for row in rows] == pytest.approx(env.get_episode_rewards(), abs=1e-5)


def test_a_vector_of_environments_is_no_environment_to_learn_in() -> None:
    with pytest.raises(ConfigurationError, match=r"SyncVectorEnv.*single gymnasium\.Env"):
        kreps.KREPS(gym.make_vec("Pendulum-v1", 2, vectorization_mode="sync"))  # type: ignore[arg-type]
    vectors = pytest.importorskip("stable_baselines3.common.vec_env")
    with pytest.raises(ConfigurationError, match=r"DummyVecEnv.*single gymnasium\.Env"):
        kreps.KREPS(vectors.DummyVecEnv([pendulum]))


# ---- Gymnasium --------------------------------------------------------------------------------


def test_a_gymnasium_vector_environment_takes_the_actions_of_a_policy(policy: kreps.Policy) -> None:
    vectors = gym.vector.SyncVectorEnv(
        [pendulum] * COUNT, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP
    )
    env = gym.wrappers.vector.RecordEpisodeStatistics(vectors)
    observations, _ = env.reset(seed=[7, 8, 9])
    state, start, found = None, np.ones(COUNT, bool), []
    for _ in range(2 * LIMIT):
        actions, state = policy.predict(observations, state, start, deterministic=True)
        assert env.action_space.contains(actions)
        observations, _, terminated, truncated, info = env.step(actions)
        start = terminated | truncated
        if start.any():
            found += info["episode"]["r"].tolist()
    alone = [each for i in range(COUNT) for each in returns(policy, 7 + i)]
    np.testing.assert_allclose(sorted(found), sorted(alone), rtol=1e-5)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: gym.wrappers.RescaleAction(env, -1.0, 1.0),
        lambda env: gym.wrappers.TransformReward(env, lambda reward: 0.1 * reward),
        lambda env: gym.wrappers.RecordEpisodeStatistics(gym.wrappers.ClipAction(env)),
        lambda env: gym.wrappers.DtypeObservation(env, np.float32),
    ],
    ids=["RescaleAction", "TransformReward", "RecordEpisodeStatistics", "DtypeObservation"],
)
@pytest.mark.filterwarnings("ignore:.* may change the observations:UserWarning")
def test_a_learner_learns_in_wrapped_environments(wrap: Any) -> None:
    env = wrap(pendulum())
    if not env.action_space.is_bounded():  # that of ClipAction is the whole line
        env = gym.wrappers.TransformAction(env, lambda a: a, gym.spaces.Box(-2.0, 2.0, (1,)))
    learner = kreps.KREPS(env, seed=0, **FEW).learn(1, progress=False)
    action, _ = learner.predict(env.observation_space.sample())
    assert env.action_space.contains(action)


# ---- rliable ----------------------------------------------------------------------------------


def rows_of(scores: dict[str, dict[str, list[float]]]) -> list[dict[str, Any]]:
    """A worse score after the first update and the given one after the second, seeds descending."""
    return [
        {"task": task, "method": method, "seed": str(seed), "iteration": str(i), "greedy": str(s)}
        for method, tasks in scores.items()
        for task, values in tasks.items()
        for seed, value in reversed([*enumerate(values, 10)])
        for i, s in ((2, value), (1, value - 50.0))
    ]


SCORES = {
    "a": {"x": [1.0, 2.0, 3.0, 4.0], "y": [5.0, 6.0, 7.0, 80.0]},
    "b": {"y": [0.5, 0.25, 0.75, 1.0], "x": [-1.0, 2.0, 3.0, 4.0]},
}


def test_scores_have_the_form_and_the_order_of_rliable() -> None:
    found = score_arrays(rows_of(SCORES), "greedy")
    assert list(found) == ["a", "b"]
    np.testing.assert_array_equal(found["a"], np.transpose([SCORES["a"]["x"], SCORES["a"]["y"]]))
    np.testing.assert_array_equal(found["b"], np.transpose([SCORES["b"]["x"], SCORES["b"]["y"]]))
    metrics = pytest.importorskip("rliable.metrics")
    assert metrics.aggregate_iqm(found["a"]) == np.mean([3.0, 4.0, 5.0, 6.0])


def test_scores_of_unequal_numbers_of_seeds_are_rejected() -> None:
    rows = rows_of(SCORES)
    with pytest.raises(DataError, match=r"'b' has \{'x': 3, 'y': 4\} seeds"):
        score_arrays(
            [r for r in rows if (r["method"], r["task"], r["seed"]) != ("b", "x", "10")], "greedy"
        )
    with pytest.raises(DataError, match="no row"):
        score_arrays([])


def test_the_published_tables_have_scores() -> None:
    results = Path(__file__).parents[1] / "results"
    with open(results / "swing-up.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    found = score_arrays(rows)
    seeds = {row["seed"] for row in rows}
    assert {scores.shape for scores in found.values()} == {(len(seeds), 1)}
    summary = json.loads((results / "swing-up.json").read_text())["summary"]
    for method, scores in found.items():
        wanted = summary[method]["stochastic"]["mean"]
        assert scores.mean() == pytest.approx(wanted, rel=1e-4)


# ---- Hugging Face Hub -------------------------------------------------------------------------


def call(*arguments: str | Path) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["kreps", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    return int(stop.value.code or 0)


def test_a_model_card_is_one_of_the_hub_and_its_command_learns_the_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    train = (
        "kreps train Pendulum-v1 --preset single_step --iterations 1 --seed 3 --out first "
        "--set initial_rollouts=3 --set low_rank=none --env-arg g=9.5 --periodic 2 --no-report"
    )
    assert call(*shlex.split(train)[1:]) == 0
    assert call("card", "first", "--out", "card") == 2
    assert "kreps evaluate first" in capsys.readouterr().err
    config = RunFolder("first").config()
    RunFolder("recorded").create(replace(config, environment="", data=["x.csv"]))
    shutil.copy("first/progress.csv", "recorded")
    assert call("card", "recorded", "--out", "card") == 2
    assert "a run from recorded data" in capsys.readouterr().err
    assert call("evaluate", "first", "--episodes", "2", "--steps", "200") == 0
    assert call("card", "first", "--out", "card") == 0
    names = {path.name for path in (tmp_path / "card").iterdir()}
    assert names == {"README.md", "policy.safetensors", "config.json", "progress.csv"}
    text = (tmp_path / "card/README.md").read_text()
    command = text.split("```\n")[-2]
    assert call(*shlex.split(command)[1:], "--no-report") == 0
    learnt = (tmp_path / "run/policy.safetensors").read_bytes()
    assert learnt == (tmp_path / "card/policy.safetensors").read_bytes()

    hub = pytest.importorskip("huggingface_hub")
    data = hub.ModelCard.load(tmp_path / "card/README.md").data
    assert data.library_name == "kreps" and "reinforcement-learning" in data.tags
    measured = {result.metric_type: result.metric_value for result in data.eval_results}
    assert set(measured) == {"average_reward", "mean_reward"}
    assert f"{measured['mean_reward']:.5g}" in text
