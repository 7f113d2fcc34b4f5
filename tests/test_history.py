"""States with earlier observations and actions: how they are made, learnt from, chosen and kept."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms.state import LearnerState
from kreps.app.diagnosis.delay import delay_or_hidden_state
from kreps.data.dataset import Dataset
from kreps.data.history import first_lags, next_lags, stacked, state_changes_of, states_of
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError, DataError
from kreps.models.dynamics import fit_dynamics
from kreps.models.history_choice import candidates, choose_history
from kreps.models.transition import state_actions, state_kernel

TASK = TaskSpec(2, [-1.0], [3.0], periodic=(0,), delay=3, history=2, dt=0.05)


class DelayedActions(gym.Wrapper[Any, Any, Any, Any]):
    """Actions act ``delay`` steps later; before, the middle of their range acts."""

    def __init__(self, env: Any, delay: int) -> None:
        super().__init__(env)
        self.delay = delay

    def reset(self, **arguments: Any) -> Any:
        self.waiting = deque([np.zeros(1)] * self.delay)
        return self.env.reset(**arguments)

    def step(self, action: Any) -> Any:
        self.waiting.append(np.array(action))
        return self.env.step(self.waiting.popleft())


def oscillator(
    count: int, delay: int = 0, hidden: bool = False, steps: int = 24, seed: int = 0
) -> Rollouts:
    """Rollouts of random pushes on a mass at a spring, its velocity observed unless hidden."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        state, pushes = rng.normal(size=2), rng.uniform(-1.0, 1.0, steps)
        states = [state]
        for t in range(steps):
            push = pushes[t - delay] if t >= delay else 0.0
            x, v = states[-1]
            states.append(np.array([x + 0.2 * v, v + 0.2 * (push - x)]))
        points = np.array(states)
        rewards = -(points[:-1, 0] ** 2)
        found.append(Rollout(points[:, :1] if hidden else points, pushes[:, None], rewards))
    return Rollouts.from_list(found)


def of_oscillator(hidden: bool = False, **lags: Any) -> TaskSpec:
    return TaskSpec(1 if hidden else 2, [-1.0], [1.0], **lags)


def test_states_are_as_written_row_by_row() -> None:
    rng = np.random.default_rng(0)
    points = [rng.uniform(-np.pi, np.pi, (length + 1, 2)) for length in (1, 6)]
    commanded = [rng.normal(1.0, 3.0, (length, 1)) for length in (1, 6)]
    rollouts = Rollouts.from_list(
        Rollout(o, a, np.zeros(len(a))) for o, a in zip(points, commanded, strict=True)
    )
    found = stacked(rollouts, TASK)
    assert found.points.shape == (9, 2 + 2 * 2 + 3) and TASK.state_size == 9
    assert np.array_equal(found.actions, rollouts.actions)
    for rollout, o, a in zip(found, points, commanded, strict=True):
        for t, state in enumerate(rollout.observations):
            expected = list(o[t])
            for lag in (0, 1):
                change = o[max(t - lag, 0)] - o[max(t - lag - 1, 0)]
                angle = np.angle(np.exp(1j * change[0]))  # wrapped
                expected += [angle, change[1]]
            for lag in (1, 2, 3):  # applied, and relative to the middle of [-1, 3]
                expected.append(
                    (np.clip(a[t - lag, 0], -1.0, 3.0) - 1.0) / 2.0 if t >= lag else 0.0
                )
            assert np.allclose(state, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("delay, history", [(0, 1), (2, 0), (3, 2), (1, 3)])
def test_lags_step_by_step_give_the_same_states_and_the_model_the_same_successors(
    delay: int, history: int
) -> None:
    task = replace(TASK, delay=delay, history=history)
    rng = np.random.default_rng(1)
    points, commanded = rng.normal(size=(6, 2)), rng.normal(size=(5, 1))
    states = stacked(Rollouts.from_list([Rollout(points, commanded, np.zeros(5))]), task).points
    lags = first_lags(points[:1], task)
    for t in range(5):
        assert np.array_equal(states_of(points[t : t + 1], lags, task), states[t : t + 1])
        lags = next_lags(points[t : t + 1], lags, task.scaled_applied(commanded[t : t + 1]), task)
    inputs = np.concatenate([states[:-1], task.scaled_applied(commanded)], axis=1)
    changes = state_changes_of(inputs, np.diff(points, axis=0), task)
    assert np.allclose(states[:-1] + changes, states[1:], rtol=0.0, atol=1e-14)


def test_only_the_observation_is_predicted_with_an_error() -> None:
    task = of_oscillator(delay=2, history=2)
    data = stacked(oscillator(8, delay=2, hidden=False), task).transitions
    rng = np.random.default_rng(0)
    dynamics, _, _ = fit_dynamics(data, state_kernel(data, task, rng), task, None, rng)
    residuals, newest, change = dynamics.residuals, slice(0, 2), slice(2, 4)
    assert residuals[:, newest].any() and not residuals[:, 4:].any()
    assert np.array_equal(residuals[:, newest], residuals[:, change])
    successors, _ = dynamics.predict(state_actions(data, task))
    assert np.allclose(successors[:, 4:], data.points[data.successor, 4:], rtol=0.0, atol=1e-14)
    assert np.allclose(successors[:, change], successors[:, newest] - data.states[:, newest])


def test_the_smallest_states_that_predict_well_are_chosen() -> None:
    for hidden, delay, expected in (
        (False, 0, (0, 0)),
        (False, 3, (3, 0)),
        (True, 0, (0, 1)),
    ):
        rollouts, task = oscillator(6, delay, hidden), of_oscillator(hidden)
        choice = choose_history(rollouts, task, 0, np.random.default_rng(0))
        assert choice is not None
        assert (choice.chosen.delay, choice.chosen.history) == expected
    one = oscillator(1)
    assert choose_history(one, of_oscillator(), 0, np.random.default_rng(0)) is None


def test_a_delay_is_kept_while_constant_actions_do_not_show_it() -> None:
    rollouts = oscillator(8, delay=2)
    still = Rollouts.from_list(
        Rollout(r.observations, 0.0 * r.actions, r.rewards) for r in rollouts
    )
    kept = choose_history(still, of_oscillator(delay=2), 0, np.random.default_rng(0))
    assert kept is not None and (kept.chosen.delay, kept.chosen.history) == (2, 0)


def test_diagnosis_names_the_delay_in_steps_and_seconds_and_the_hidden_state() -> None:
    def found(task: TaskSpec, rollouts: Rollouts) -> Any:
        return delay_or_hidden_state(ReplayWindow(task, None).append(rollouts))

    late = oscillator(9, delay=2)
    finding = found(of_oscillator(dt=0.05, action_repeat=2), late)
    assert finding.severity == "limit" and "4 steps (0.2 s) late" in finding.sentence
    assert finding.value < 0.5 and "history=auto" in finding.remedy
    assert found(of_oscillator(delay=2), late).severity == "fine"
    assert found(of_oscillator(), oscillator(9)).severity == "fine"
    unseen = found(of_oscillator(hidden=True), oscillator(9, hidden=True))
    assert unseen.severity == "limit" and "not observed" in unseen.sentence
    assert found(of_oscillator(), oscillator(2)) is None  # 48 steps


@pytest.fixture(scope="module")
def learner() -> kreps.KREPS:
    env = DelayedActions(gym.make("kreps/SwingUp-v0"), 2)
    found = kreps.KREPS(env, periodic=[0], delay=2, history=1, model_based=None, initial_rollouts=4)
    return found.learn(2, progress=False)


def test_predict_acts_as_the_policy_acts_in_collection(learner: kreps.KREPS) -> None:
    policy, env = learner.policy, DelayedActions(gym.make("kreps/SwingUp-v0"), 2)
    task = policy.process.task
    assert (task.delay, task.history, task.state_size) == (2, 1, 6)
    first, _ = env.reset(seed=3)
    observations, actions, state = [first], [], None
    for _ in range(5):
        action, state = policy.predict(observations[-1], state, deterministic=True)
        actions.append(action)
        observations.append(env.step(action)[0])
    rollout = Rollout(np.array(observations), np.array(actions), np.zeros(5))
    states = stacked(Rollouts.from_list([rollout]), task).points[:-1]
    expected = task.clip(policy.process.greedy(states))
    assert np.allclose(np.array(actions), expected, rtol=0.0, atol=1e-9)
    assert not np.allclose(expected, task.clip(policy.process.greedy(states[:1])))
    # two at once, of which one begins anew
    both = np.array([first, first])
    _, state = policy.predict(both, None, deterministic=True)
    new, _ = policy.predict(both, state, [True, False], deterministic=True)
    assert np.allclose(new[0], actions[0], atol=1e-9) and not np.allclose(new[1], actions[0])
    with pytest.raises(DataError, match="what predict returned"):
        policy.predict(first, state)


def test_files_and_onnx_carry_the_lags(learner: kreps.KREPS, tmp_path: Path) -> None:
    learner.policy.save(tmp_path / "policy.safetensors")
    loaded = kreps.load_policy(tmp_path / "policy.safetensors")
    assert (loaded.process.task.delay, loaded.process.task.history) == (2, 1)
    learner.save(tmp_path / "checkpoint.safetensors")
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint.safetensors")
    assert resumed.task.state_size == 6 and resumed.settings == learner.settings
    onnxruntime = pytest.importorskip("onnxruntime")
    small = loaded.compressed(20)
    small.export_onnx(tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    rng = np.random.default_rng(0)
    observations = rng.uniform(-3.0, 3.0, (4, 3, 2)) * [1.0, 2.0]
    lags, state = first_lags(observations[0], learner.task), None
    for each in observations:
        feed = {"observation": each, "lags": lags}
        action, _, lags = session.run(None, feed)
        expected, state = small.predict(each, state, deterministic=True)
        assert np.allclose(action, expected, rtol=0.0, atol=1e-8)
        assert np.allclose(lags, state.lags, rtol=0.0, atol=1e-8)


def test_auto_learns_on_other_states_when_the_choice_changes_and_resumes(tmp_path: Path) -> None:
    task = of_oscillator()
    options: Any = {"history": "auto", "model_based": None, "window": 6, "window_steps": 0}
    learner = kreps.KREPS(task, **options)
    learner.update(oscillator(6))
    assert learner.task.state_size == 2
    learner.update(oscillator(6, delay=2))
    assert (learner.task.delay, learner.task.history) == (2, 0)
    assert learner.policy.process.task.state_size == 4 and learner.state.iteration == 2
    learner.save(tmp_path / "checkpoint.safetensors")
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint.safetensors")
    assert resumed.task.delay == 2
    for each in (learner, resumed):
        each.update(oscillator(4, delay=2, seed=3))
    states = np.random.default_rng(0).normal(size=(5, 4))
    assert np.array_equal(
        learner.policy.process.greedy(states), resumed.policy.process.greedy(states)
    )


def test_streamed_samples_have_the_same_states_as_those_in_memory() -> None:
    rollouts, task = oscillator(8, delay=2), of_oscillator(delay=2)
    options: Any = {"model_based": None, "ridge": 0.1}
    exact, streamed = kreps.KREPS(task, **options), kreps.KREPS(task, **options)
    exact.update(rollouts)
    streamed.update(Dataset.from_rollouts(rollouts, chunk_size=60))
    states = stacked(rollouts, task).points[:50]
    a, b = (learner.policy.process.greedy(states) for learner in (exact, streamed))
    assert np.sqrt(np.mean((a - b) ** 2)) < 0.1 * np.std(a)


def test_a_change_of_states_keeps_the_window_alone() -> None:
    window = ReplayWindow(of_oscillator(), None).append(oscillator(2))
    state = LearnerState(window, 3, 2, 50, policy_start=np.zeros(4))
    assert state.with_history(0, 0) is state
    other = state.with_history(1, 0)
    assert other.policy_start is None and (other.iteration, other.steps) == (3, 50)
    assert other.window.task.delay == 1 and other.window.rollouts is window.rollouts


@pytest.mark.parametrize("settings", [{"history": -1}, {"history": "all"}, {"delay": 1.5}])
def test_settings_are_checked(settings: Any) -> None:
    with pytest.raises(ConfigurationError, match="whole number from 0 to 100"):
        kreps.KREPS(of_oscillator(), **settings)


def test_the_choice_from_a_data_set_of_small_chunks_is_that_of_its_rollouts() -> None:
    rollouts = oscillator(8, delay=2)
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]), history="auto", model_based=None)
    one_each = Dataset.from_rollouts(list(rollouts), chunk_size=1)
    assert len(one_each.chunks) == 8
    report = learner.update(one_each)
    assert report.history_choice is not None
    assert report.history_choice.chosen.delay == 2


def test_histories_of_wide_observations_are_no_candidates() -> None:
    wide = TaskSpec(1_600, [-1.0], [1.0])
    assert {each.history for each in candidates(wide, 100.0)} == {0}
