"""Undiscounted returns over whole episodes, in the evaluation, its file and what is printed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from kreps import KREPS, Rollout
from kreps.app.evaluation import evaluate_run, say_evaluation, write_evaluation
from kreps.app.plots.learning_curve import learning_curve
from kreps.app.run_folder import RunFolder
from kreps.data.rollouts import Rollouts
from kreps.errors import StorageError
from kreps.learning.episodes import episodic_return, evaluated_steps
from kreps.learning.evaluate import Evaluation

NO_LIMIT = sys.maxsize
SMALL: dict[str, Any] = {"initial_rollouts": 6, "restart_probability": 0.1}


def rollout(*rewards: float, terminated: bool = False) -> Rollout:
    count = len(rewards)
    points, actions = np.zeros((count + 1, 1)), np.zeros((count, 1))
    return Rollout(points, actions, np.array(rewards), terminated=terminated)


def rollouts(*each: Rollout) -> Rollouts:
    return Rollouts.from_list(each)


def test_a_return_is_the_sum_of_the_rewards_of_an_episode() -> None:
    ended = rollouts(rollout(1.0, 2.0, terminated=True), rollout(5.0, 5.0, 1.0, terminated=True))
    found = episodic_return(ended, steps=10, limit=NO_LIMIT)
    assert found is not None
    assert (found.mean, found.length, found.terminated, found.whole) == (7.0, 2.5, 1.0, 1.0)
    assert found.standard_error == pytest.approx(np.std([3.0, 11.0], ddof=1) / np.sqrt(2.0))
    alone = episodic_return(ended[:1], steps=10, limit=NO_LIMIT)
    assert alone is not None and alone.standard_error == 0.0


def test_a_time_limit_ends_an_episode_and_a_cut_does_not() -> None:
    three = rollouts(rollout(1.0, 1.0, 1.0), rollout(2.0, 2.0, 2.0))
    limited = episodic_return(three, steps=3, limit=3)
    assert limited is not None and (limited.whole, limited.terminated) == (1.0, 0.0)
    assert episodic_return(three, steps=3, limit=NO_LIMIT) is None
    assert episodic_return(three, steps=3, limit=4) is None
    own_end = episodic_return(three, steps=5, limit=NO_LIMIT)  # the environment truncated
    assert own_end is not None and own_end.whole == 1.0
    fallen = rollouts(rollout(1.0, terminated=True), rollout(1.0, 1.0, 1.0))
    partly = episodic_return(fallen, steps=3, limit=NO_LIMIT)
    assert partly is not None and (partly.whole, partly.terminated) == (0.5, 0.5)


@pytest.mark.parametrize(
    ("least", "limit", "steps"),
    [(400, NO_LIMIT, 400), (400, 50, 400), (400, 1000, 1000), (200, 2001, 200), (200, 2000, 2000)],
)
def test_an_evaluation_follows_whole_episodes(least: int, limit: int, steps: int) -> None:
    assert evaluated_steps(least, limit) == steps


@pytest.fixture(scope="module")
def learner() -> KREPS:
    env = gym.wrappers.TimeLimit(gym.make("kreps/SwingUp-v0"), 30)
    return KREPS(env, **SMALL).learn(1, progress=False)


def test_both_policies_have_a_return_in_a_task_with_a_time_limit(learner: KREPS) -> None:
    found, greedy = evaluate_run(learner, episodes=3, steps=50, seed=0)
    assert set(found) == {"stochastic", "greedy"}
    for result in found.values():
        assert result.episodic is not None
        assert (result.episodic.length, result.episodic.whole) == (30.0, 1.0)
    returns = [each.rewards.sum() for each in greedy]
    assert found["greedy"].episodic is not None
    assert found["greedy"].episodic.mean == pytest.approx(np.mean(returns))
    endless = KREPS(gym.make("kreps/SwingUp-v0"), **SMALL).learn(1, progress=False)
    found, _ = evaluate_run(endless, episodes=2, steps=5, seed=0)
    assert [result.episodic for result in found.values()] == [None, None]


def test_returns_are_stored_and_read_with_and_without_them(learner: KREPS, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    found, greedy = evaluate_run(learner, episodes=2, steps=50, seed=0)
    write_evaluation(folder, learner, found, greedy, seed=0)
    stored = folder.evaluation(learner.state.iteration)
    assert stored is not None and found["greedy"].episodic is not None
    assert stored["greedy"]["episodic"]["mean"] == found["greedy"].episodic.mean
    assert stored["stochastic"]["episodic"]["length"] == 30.0

    content = json.loads(folder.evaluation_file.read_text())
    for older in ({"episodic": None}, {}):
        for name in ("stochastic", "greedy"):
            del content[name]["episodic"]
            content[name] |= older
        folder.evaluation_file.write_text(json.dumps(content))
        stored = folder.evaluation(learner.state.iteration)
        assert stored is not None and "episodic" not in stored["greedy"]
        content["greedy"]["episodic"] = content["stochastic"]["episodic"] = None


@pytest.mark.parametrize("episodic", [{"mean": 1.0}, 3, [], {"mean": "much"}])
def test_damaged_returns_are_an_error(episodic: Any, learner: KREPS, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    found, greedy = evaluate_run(learner, episodes=2, steps=50, seed=0)
    write_evaluation(folder, learner, found, greedy, seed=0)
    content = json.loads(folder.evaluation_file.read_text())
    content["greedy"]["episodic"] = episodic
    folder.evaluation_file.write_text(json.dumps(content))
    with pytest.raises(StorageError, match="damaged"):
        folder.evaluation(learner.state.iteration)


def test_the_table_has_the_returns_within_eighty_letters(
    learner: KREPS, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    found, _ = evaluate_run(learner, episodes=2, steps=50, seed=0)
    say_evaluation(found)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and any("return per episode" in line for line in lines)
    (greedy,) = (line for line in lines if "greedy" in line)
    assert found["greedy"].episodic is not None
    assert f"{found['greedy'].episodic.mean:.5g}" in greedy and "30" in greedy
    say_evaluation({"greedy": Evaluation(1.0, 0.1, 10, 20)})
    assert "return" not in capsys.readouterr().out


def test_an_evaluation_says_that_episodes_were_cut(
    capsys: pytest.CaptureFixture[str],
) -> None:
    part = episodic_return(
        rollouts(rollout(1.0, terminated=True), rollout(1.0, 1.0)), steps=2, limit=NO_LIMIT
    )
    say_evaluation({"greedy": Evaluation(1.0, 0.1, 2, 2, part)})
    assert "50% of the episodes were cut at 2 steps" in " ".join(capsys.readouterr().out.split())


def curve(length: float, **limit: str) -> Any:
    """The panels of a run with rollouts of 25 steps, and evaluated episodes of some length."""
    rows = [
        {
            "iteration": str(i + 1),
            "steps": str(100 * (i + 1)),
            "rollouts": str(4 * (i + 1)),
            "average_reward": str(-90.0 + 10 * i),
            "reward_lower_quartile": "nan",
            "reward_upper_quartile": "nan",
            "mean_return": str(10.0 * i),
            "terminated": "0.0",
            "time_limit": "nan",
            "robot_seconds": "nan",
            "policy_kl": "nan",
            "kl": "0.5",
            "kl_bound": "1.0",
            "effective_samples": "20",
            "samples": "100",
            "weighted": "100",
        }
        | limit
        for i in range(3)
    ]
    episodic = {"mean": 300.0, "standard_error": 5.0, "length": length}
    evaluation = {
        name: {"mean": -25.0, "standard_error": 0.5, "episodic": episodic}
        for name in ("stochastic", "greedy")
    }
    return learning_curve(rows, {}, evaluation, "title").axes


def test_the_curve_shows_returns_where_the_task_ends_episodes() -> None:
    assert len(curve(25.0)) == 3
    for ends in ({"time_limit": "30"}, {"terminated": "0.5"}):
        returns = curve(25.0, **ends)[1]
        assert "return" in returns.get_ylabel()
        np.testing.assert_array_equal(returns.lines[0].get_ydata(), [0.0, 10.0, 20.0])
        labels = " ".join(t.get_text() for t in returns.get_legend().get_texts())
        assert "(25 steps)" in labels and "greedy: 300 ± 10" in labels


@pytest.mark.parametrize(("length", "top"), [(25.0, 300.0), (1000.0, 20.0)])
def test_returns_of_much_longer_episodes_do_not_flatten_the_curve(
    length: float, top: float
) -> None:
    _, high = curve(length, time_limit="1000")[1].get_ylim()
    assert top <= high < 1.2 * top
