"""Actions that are held for several steps: how many, and what is counted, kept and predicted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.app.diagnosis.columns import average_rewards
from kreps.app.diagnosis.episodes import longer_rollouts
from kreps.app.progress_file import progress_row
from kreps.app.recording import record
from kreps.data.rollouts import Rollouts
from kreps.envs.held_actions import HeldActions, held
from kreps.errors import ConfigurationError, DataError
from kreps.learning.collect import collect
from kreps.learning.environment import batch_model_of, environment_for, task_of, time_limit
from kreps.learning.episodes import episodic_return
from kreps.learning.evaluate import discounted_average, evaluate, evaluation_rollouts
from kreps.learning.policy import Policy
from kreps.learning.timescale import action_repeat
from kreps.policies.exploration import BangBang
from kreps.presets import settings_of

SMALL: dict[str, Any] = {
    "initial_rollouts": 5,
    "rollouts_per_iteration": 3,
    "growth": 0.0,
    "model_based.improvement_steps": 1,
    "model_based.acceptance_rollouts": 5,
}


class Counter(gym.Env[Any, Any]):
    """Each step pays one; the state counts steps, and the episode ends at the ``last`` of them."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, last: int = 10**9, dt: float | None = 0.01) -> None:
        self.last, self.dt = last, dt
        self.taken: list[float] = []
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = self.np_random.normal(), 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken.append(float(action[0]))
        self.t, self.steps = self.t + 1, self.steps + 1
        self.x += 0.1 * float(action[0])
        return self._observation(), 1.0 - 0.1 * self.x**2, self.t == self.last, False, {}

    def render(self) -> Any:
        return np.zeros((2, 2, 3), np.uint8)

    def _observation(self) -> Any:
        return np.array([self.x, 0.1 * self.t])


def limited(steps: int, **options: Any) -> Any:
    return gym.wrappers.TimeLimit(Counter(**options), steps)


def runs(values: list[float]) -> list[int]:
    """Lengths of the runs of equal values."""
    ends = [i for i in range(1, len(values)) if values[i] != values[i - 1]]
    return np.diff([0, *ends, len(values)]).tolist()


# ---- what is chosen ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dt", "repeat"),
    [(None, 1), (1.0, 1), (0.05, 1), (0.04, 1), (0.03, 1), (0.02, 2), (0.01, 4), (0.008, 5)],
)
def test_a_policy_decides_about_25_times_per_second(dt: float | None, repeat: int) -> None:
    task = kreps.TaskSpec(1, [-1.0], [1.0], dt=dt)
    assert action_repeat(settings_of(), task) == repeat
    assert action_repeat(settings_of(action_repeat=3), task) == 3
    assert action_repeat(settings_of("paper"), task) == 1
    assert action_repeat(settings_of("single_step"), task) == 1


def test_a_learner_chooses_for_an_environment_but_not_for_data_that_are_given() -> None:
    learner = kreps.KREPS(limited(1000))
    assert (learner.settings.action_repeat, learner.task.action_repeat) == (None, 4)
    assert kreps.KREPS(task_of(limited(1000))).task.action_repeat == 1
    given = kreps.TaskSpec(1, [-1.0], [1.0], dt=0.01, action_repeat=2)
    assert kreps.KREPS(given).task.action_repeat == 2
    assert kreps.KREPS(given, action_repeat=5).task.action_repeat == 5
    assert kreps.NPALP(limited(1000)).task.action_repeat == 1


@pytest.mark.parametrize("wrong", [0, -1, 1.5, "2", True, 10_001])
def test_impossible_repeats_are_refused(wrong: Any) -> None:
    with pytest.raises(ConfigurationError, match="action_repeat"):
        kreps.TaskSpec(1, [-1.0], [1.0], action_repeat=wrong)


def test_the_tasks_of_the_library_keep_their_batch_models() -> None:
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"))
    assert learner.task.action_repeat == 1 and batch_model_of(learner.env) is not None
    learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), action_repeat=2)
    assert batch_model_of(learner.env) is None


# ---- holding ----------------------------------------------------------------------------------


def test_rewards_are_summed_and_the_last_observation_is_returned() -> None:
    env = HeldActions(Counter(), 3)
    first, _ = env.reset(seed=0)
    observation, reward, terminated, truncated, _ = env.step(np.array([0.5]))
    x = first[0] + 0.05 * np.arange(1, 4)
    assert observation == pytest.approx([x[-1], 0.3])
    assert reward == pytest.approx(np.sum(1.0 - 0.1 * x**2))
    assert (terminated, truncated, env.steps_taken) == (False, False, 3)


@pytest.mark.parametrize("truncated", [True, False])
def test_an_end_of_the_episode_ends_the_hold(truncated: bool) -> None:
    env = HeldActions(limited(5) if truncated else Counter(last=5), 3)
    env.reset(seed=0)
    env.step(np.zeros(1))
    *_, terminated, cut, _ = env.step(np.zeros(1))
    assert (terminated, cut) == (not truncated, truncated)
    assert env.steps_taken == env.unwrapped.steps == 5


def test_an_environment_is_held_once() -> None:
    env = Counter()
    assert held(env, 1) is env
    assert held(held(env, 3), 3).env is env


def test_a_reward_that_is_no_number_is_an_error() -> None:
    class Broken(Counter):
        def step(self, action: Any) -> Any:
            return (self._observation(), float("nan"), False, False, {})

    learner = kreps.KREPS(Broken(), **SMALL)
    with pytest.raises(DataError, match="rollout 0 of the environment: rewards hold NaN"):
        learner.learn(1, progress=False)


# ---- collecting and counting ------------------------------------------------------------------


def collected(env: Any, repeat: int, count: int = 6) -> Rollouts:
    task = task_of(env)
    task = kreps.TaskSpec(2, task.action_low, task.action_high, action_repeat=repeat)
    return collect(env, task, BangBang(task), count, seed=3, iteration=0, restart_probability=0.02)


def test_rollouts_have_decisions_and_actions_are_held() -> None:
    env = Counter()
    rollouts = collected(env, 4)
    assert env.steps == 4 * rollouts.steps
    np.testing.assert_array_equal(env.taken, np.repeat(rollouts.actions[:, 0], 4))
    assert rollouts.lengths.tolist() == collected(Counter(), 1).lengths.tolist()


def test_a_time_limit_that_is_no_multiple_is_met_exactly() -> None:
    env = limited(10)
    rollouts = collected(env, 4)
    long = rollouts.lengths == 3
    assert rollouts.lengths.max() == 3 and long.any() and not rollouts.terminated.any()
    assert env.unwrapped.steps == 10 * long.sum() + 4 * rollouts.lengths[~long].sum()


def test_steps_are_those_of_the_environment_to_the_last_one() -> None:
    env = Counter(last=10)
    seen = []
    learner = kreps.KREPS(env, seed=0, **SMALL)
    learner.learn(2, callback=lambda _, report: seen.append(report), progress=False)
    assert learner.task.action_repeat == 4
    assert learner.state.steps == seen[-1].steps == env.steps
    assert env.steps < 4 * learner.state.window.steps  # some holds were cut
    assert learner.state.rollouts == 8 and learner.state.terminated
    # rewards per step are about one, that of a step of the environment
    assert 0.5 < seen[0].average_reward <= 1.0
    assert seen[0].reward_quartiles[1] <= 1.0


def test_given_rollouts_count_as_held_throughout() -> None:
    learner = kreps.KREPS(kreps.TaskSpec(2, [-1.0], [1.0], action_repeat=4), preset="single_step")
    learner = kreps.KREPS(
        kreps.TaskSpec(2, [-1.0], [1.0]), seed=0, preset="single_step", action_repeat=4
    )
    rollouts = collected(Counter(), 4)
    learner.update(rollouts)
    assert learner.state.steps == 4 * rollouts.steps


# ---- evaluating -------------------------------------------------------------------------------


def test_evaluations_hold_actions_and_report_steps_of_the_environment() -> None:
    learner = kreps.KREPS(limited(30), seed=0, **SMALL).learn(1, progress=False)
    env = limited(30)
    policy = learner.state.policy
    rollouts = evaluation_rollouts(env, learner.task, policy, episodes=4, steps=50, seed=0)
    assert rollouts.lengths.tolist() == [8] * 4 and env.unwrapped.steps == 4 * 30
    found = episodic_return(rollouts, 50, time_limit(env), 4)
    assert (found.length, found.whole) == (30.0, 1.0)
    assert found.mean == pytest.approx(rollouts.rewards.sum() / 4)
    per_decision = discounted_average(rollouts, 0.02)
    per_step = evaluate(
        env, learner.task, policy, restart_probability=0.02, episodes=4, steps=50, seed=0
    )
    assert per_step.mean == pytest.approx(per_decision.mean / 4)
    assert per_step.standard_error == pytest.approx(per_decision.standard_error / 4)
    assert found.mean / found.length == pytest.approx(per_step.mean, rel=0.2)


def test_an_evaluation_of_fewer_steps_than_an_episode_is_cut() -> None:
    learner = kreps.KREPS(limited(300), seed=0, **SMALL).learn(1, progress=False)
    rollouts = evaluation_rollouts(
        limited(300), learner.task, learner.state.policy, episodes=2, steps=50, seed=0
    )
    assert rollouts.lengths.tolist() == [13, 13]  # 52 steps
    assert episodic_return(rollouts, 50, 300, 4) is None


def test_the_diagnosis_reads_both_units() -> None:
    row = {
        "average_reward": 1.0,
        "terminated": 1.0,
        "restart_probability": 0.02,
        "steps": 400.0,
        "rollouts": 10.0,
        "time_limit": 1000.0,
    }
    # 40 steps are ten decisions, after which fifty more are waited until the restart
    assert average_rewards([{**row, "action_repeat": 4.0}]) == pytest.approx([1 / 6])
    assert average_rewards([{**row, "action_repeat": 1.0}]) == pytest.approx([40 / 90])
    assert average_rewards([{**row, "action_repeat": "nan"}]) == pytest.approx([40 / 90])
    assert "restart_probability=0.008)" in longer_rollouts([{**row, "action_repeat": 4.0}])
    assert "restart_probability=0.002)" in longer_rollouts([{**row, "action_repeat": "nan"}])


def test_progress_has_the_repeat() -> None:
    rows = []
    learner = kreps.KREPS(limited(300), seed=0, **SMALL)
    learner.learn(1, callback=lambda *given: rows.append(progress_row(*given)), progress=False)
    assert (rows[0]["action_repeat"], rows[0]["restart_probability"]) == (4, 0.02)
    assert rows[0]["time_limit"] == 300
    assert rows[0]["robot_seconds"] == pytest.approx(0.01 * learner.env.unwrapped.steps)


# ---- predicting -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learnt() -> kreps.KREPS:
    return kreps.KREPS(limited(300), seed=0, **SMALL).learn(1, progress=False)


def test_predict_holds_an_action_if_its_state_is_passed_back(learnt: kreps.KREPS) -> None:
    policy, state = Policy(learnt.state.policy), None
    actions = []
    for t in range(10):
        action, state = policy.predict(np.array([0.02 * t, 0.0]), state, deterministic=True)
        actions.append(float(action[0]))
    assert runs(actions) == [4, 4, 2]


def test_predict_without_a_state_decides_anew(learnt: kreps.KREPS) -> None:
    policy = Policy(learnt.state.policy)
    observations = 0.1 * np.arange(5)[:, None] * np.ones(2)
    actions = [float(policy.predict(o, deterministic=True)[0][0]) for o in observations]
    assert len(set(actions)) == 5


def test_held_predictions_are_those_of_the_decisions(learnt: kreps.KREPS) -> None:
    one, two, state = Policy(learnt.state.policy), Policy(learnt.state.policy), None
    for t in range(8):
        observation = np.array([0.3, 0.1 * t])
        action, state = one.predict(observation, state)
        if t % 4 == 0:
            wanted, _ = two.predict(observation)
        np.testing.assert_array_equal(action, wanted)


def test_a_new_episode_holds_nothing(learnt: kreps.KREPS) -> None:
    policy = Policy(learnt.state.policy)
    observations = np.array([[0.3, 0.0], [-0.3, 0.0], [0.1, 0.0]])
    first, state = policy.predict(observations)
    second, state = policy.predict(observations, state, np.array([False, True, False]))
    assert (first == second)[:, 0].tolist() == [True, False, True]
    assert state.left.tolist() == [2, 3, 2]
    third, _ = policy.predict(observations, state, True)
    assert not (second == third).all()  # some may be at their limit


@pytest.mark.parametrize("wrong", [1, "x", (np.zeros((1, 1)), np.zeros(1))])
def test_a_state_of_something_else_is_refused(wrong: Any, learnt: kreps.KREPS) -> None:
    policy = Policy(learnt.state.policy)
    with pytest.raises(DataError, match="state = "):
        policy.predict(np.zeros(2), wrong)
    _, state = policy.predict(np.zeros((3, 2)))
    with pytest.raises(DataError, match="state = "):
        policy.predict(np.zeros(2), state)
    with pytest.raises(DataError, match="episode_start"):
        policy.predict(np.zeros((3, 2)), state, [True, False])


def test_a_policy_without_a_repeat_returns_the_state_unchanged() -> None:
    learner = kreps.KREPS(limited(300), action_repeat=1, seed=0, **SMALL).learn(1, progress=False)
    assert learner.policy.action_repeat == 1
    assert learner.predict(np.zeros(2), "mine")[1] == "mine"


def test_films_hold_actions(learnt: kreps.KREPS) -> None:
    env = environment_for(limited(300), learnt.task, None)
    recording = record(env, Policy(learnt.state.policy), 10, 0, deterministic=False)
    assert runs(recording.actions[:, 0].tolist()) == [4, 4, 2] and len(recording.frames) == 10


# ---- files ------------------------------------------------------------------------------------


def test_a_policy_file_has_the_repeat(learnt: kreps.KREPS, tmp_path: Path) -> None:
    learnt.policy.save(tmp_path / "policy.safetensors")
    assert kreps.load_policy(tmp_path / "policy.safetensors").action_repeat == 4
    assert learnt.policy.compressed(5).action_repeat == 4


def test_an_onnx_model_has_the_repeat(learnt: kreps.KREPS, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    learnt.policy.export_onnx(tmp_path / "policy.onnx")
    (note,) = [
        p.value for p in onnx.load(tmp_path / "policy.onnx").metadata_props if "{" in p.value
    ]
    assert (json.loads(note)["action_repeat"], json.loads(note)["dt"]) == (4, 0.01)


def test_a_resumed_learner_continues_with_the_same_bytes(tmp_path: Path) -> None:
    whole = kreps.KREPS(Counter(last=200), seed=1, **SMALL).learn(3, progress=False)
    part = kreps.KREPS(Counter(last=200), seed=1, **SMALL).learn(1, progress=False)
    part.save(tmp_path / "checkpoint")
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint", Counter(last=200, dt=None))
    assert resumed.settings.action_repeat is None and resumed.task.action_repeat == 4
    resumed.learn(2, progress=False)
    assert resumed.state.steps == whole.state.steps
    states = np.linspace(-2.0, 2.0, 5)[:, None] * np.ones(whole.task.state_size)
    np.testing.assert_array_equal(
        resumed.state.policy.greedy(states), whole.state.policy.greedy(states)
    )
    np.testing.assert_array_equal(resumed.state.value.alpha, whole.state.value.alpha)
