"""What is read of an environment's time, and the restart probability."""

from __future__ import annotations

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.errors import ConfigurationError
from kreps.learning.environment import task_of, time_limit
from kreps.learning.timescale import choices, restart_probability, with_batches
from kreps.presets import settings_of
from kreps.settings import Settings

LIGHT: dict[str, Any] = {"model_based.improvement_steps": 1, "model_based.acceptance_rollouts": 5}
SMALL: dict[str, Any] = {"initial_rollouts": 4, "rollouts_per_iteration": 2, **LIGHT}


class Line(gym.Env[Any, Any]):
    """A point on a line, pushed to and fro; it falls off where it is beyond ``edge``."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    metadata: dict[str, Any] = {}  # noqa: RUF012 (declared so by gymnasium.Env)

    def __init__(self, edge: float = np.inf, **metadata: Any) -> None:
        self.edge, self.metadata = edge, metadata

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=1)
        return self.x.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x = self.x + 0.1 * np.asarray(action)
        ended = bool(abs(self.x[0]) > self.edge)
        return self.x.copy(), -float(self.x[0] ** 2), ended, False, {}


class Twice(gym.Wrapper[Any, Any, Any, Any]):
    """Takes two steps in one, which nothing but its code tells."""

    def step(self, action: Any) -> Any:
        self.env.step(action)
        return self.env.step(action)


class ToldTwice(Twice):
    metadata = {"dt": 0.2}  # noqa: RUF012


class Shifted(gym.ObservationWrapper[Any, Any, Any]):
    def observation(self, observation: Any) -> Any:
        return observation + 1.0


def with_attribute(name: str, value: Any, **metadata: Any) -> Line:
    env = Line(**metadata)
    setattr(env, name, value)
    return env


def dm_control(period: Any, step_limit: float = np.inf, **metadata: Any) -> Line:
    """As shimmy wraps an environment of dm_control."""
    inside = SimpleNamespace(control_timestep=lambda: period, _step_limit=step_limit)
    return with_attribute("_env", inside, **metadata)


# ---- what is read -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "dt"),
    [
        (Line(), None),
        (Line(dt=0.1), 0.1),
        (Line(dt=np.float32(0.5)), 0.5),
        (Line(render_fps=25), 0.04),
        (Line(dt=0.1, render_fps=25), 0.1),
        (with_attribute("dt", 0.008, render_fps=125), 0.008),
        (with_attribute("dt", 0.008, dt=0.1), 0.1),
        (dm_control(0.01, render_fps=10.0), 0.01),
        (dm_control(None, render_fps=10.0), 0.1),
        (Line(dt="fast", render_fps=0), None),
        (Line(dt=-1.0), None),
        (Line(dt=float("nan")), None),
        (Line(dt=True), None),
        (with_attribute("dt", lambda: 0.1), None),
        (Shifted(Line(dt=0.1)), 0.1),
        (kreps.RandomRestart(Line(dt=0.1)), 0.1),
        (gym.wrappers.TimeLimit(Line(dt=0.1), 7), 0.1),
        (Twice(Line(dt=0.1)), None),
        (Twice(with_attribute("dt", 0.1, render_fps=10)), None),
        (ToldTwice(Line(dt=0.1)), 0.2),
        (gym.wrappers.RepeatAction(Line(dt=0.1), 2), None),
    ],
)
def test_the_control_period_is_the_first_that_is_certain(env: Any, dt: float | None) -> None:
    assert task_of(env).dt == (None if dt is None else pytest.approx(dt, rel=1e-7))


@pytest.mark.parametrize("name", ["SwingUp", "Reaching", "ImageSwingUp"])
def test_the_tasks_of_the_library_have_20_hertz_and_no_limit(name: str) -> None:
    task = task_of(gym.make(f"kreps/{name}-v0"))
    assert (task.dt, task.time_limit) == (0.05, None)


def test_tasks_of_gymnasium_tell_their_time() -> None:
    task = task_of(gym.make("Pendulum-v1"))
    assert (task.dt, task.time_limit) == (0.05, 200)


def test_the_limit_of_dm_control_is_found() -> None:
    assert task_of(dm_control(0.01, 1000.0)).time_limit == 1000
    assert task_of(dm_control(0.01)).time_limit is None
    assert time_limit(gym.wrappers.TimeLimit(dm_control(0.01, 1000.0), 30)) == 30
    assert task_of(with_attribute("_env", None)).time_limit is None


@pytest.mark.parametrize(
    "wrong",
    [
        *({"dt": value} for value in (0.0, -1.0, float("inf"), float("nan"), "1", True)),
        *({"time_limit": value} for value in (0, -3, 2.5, "9", True)),
    ],
    ids=str,
)
def test_impossible_times_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(wrong))):
        kreps.TaskSpec(1, [-1.0], [1.0], **wrong)


# ---- what follows -----------------------------------------------------------------------------


def test_rollouts_are_those_of_the_paper_until_an_episode_terminates() -> None:
    assert restart_probability(settings_of(), terminated=False) == 0.02
    assert restart_probability(settings_of(), terminated=True) == 0.005


def test_a_number_of_the_user_or_of_a_preset_wins() -> None:
    assert restart_probability(settings_of(restart_probability=0.3), terminated=True) == 0.3
    for preset in ("paper", "single_step"):
        assert restart_probability(settings_of(preset), terminated=True) == 0.02


@pytest.mark.parametrize("limit", [20, 1_000])
def test_a_time_limit_changes_no_horizon(limit: int) -> None:
    """A longer horizon needs more data: Pendulum-v1, limited to 200 steps, needs twice as many."""
    assert kreps.KREPS(gym.wrappers.TimeLimit(Line(), limit)).restart_probability == 0.02


def test_settings_without_a_learner_have_the_usual_probability() -> None:
    assert Settings().p == 0.02
    assert Settings(restart_probability=0.1).p == 0.1


def test_other_learners_can_choose_too() -> None:
    learner = kreps.NPALP(Line(edge=0.5), seed=0, restart_probability=None)
    assert learner.restart_probability == 0.02
    learner.learn(1, progress=False)
    assert learner.restart_probability == 0.005
    assert kreps.NPALP(Line()).settings.restart_probability == 0.02


def test_a_random_restart_wins() -> None:
    env = kreps.RandomRestart(gym.wrappers.TimeLimit(Line(), 80), 0.3)
    for options in ({}, {"restart_probability": None}):
        learner = kreps.KREPS(env, **options)
        assert learner.settings.restart_probability == learner.restart_probability == 0.3
    learner = kreps.KREPS(env.env)
    assert (learner.settings.restart_probability, learner.restart_probability) == (None, 0.02)


def test_rollouts_update_and_report_have_the_chosen_probability() -> None:
    seen: list[float] = []
    learner = kreps.KREPS(Line(edge=1.5), seed=1, **SMALL)
    learner.learn(
        2, callback=lambda _, report: seen.append(report.restart_probability), progress=False
    )
    assert seen == [0.02, 0.005]  # the first rollouts showed that episodes terminate
    number = kreps.KREPS(Line(edge=1.5), seed=1, restart_probability=0.005, **SMALL)
    assert learner.update_settings == number.update_settings


def test_a_termination_is_remembered_when_its_rollout_is_forgotten() -> None:
    learner = kreps.KREPS(
        kreps.TaskSpec(1, [-1.0], [1.0]), seed=0, window=2, window_steps=0, **LIGHT
    )
    rng = np.random.default_rng(0)

    def rollouts(terminated: bool) -> list[kreps.Rollout]:
        draws = [rng.standard_normal((31, 1)) for _ in range(6)]
        return [kreps.Rollout(x, rng.normal(size=30), -(x[1:, 0] ** 2), terminated) for x in draws]

    found = []
    for terminated in (False, True, False):
        learner.update(rollouts(terminated))
        found.append(learner.restart_probability)
    assert found == [0.02, 0.005, 0.005]
    assert not learner.state.window.rollouts.terminated.all()


# ---- what is said -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "terminated", "line"),
    [
        ({}, False, ""),
        ({}, True, "rollouts of 200 steps on average (an episode has terminated)"),
        (
            {"dt": 0.01, "action_repeat": 4, "time_limit": 1000},
            True,
            "actions held 4 steps (control period 0.01 s), rollouts of 200 decisions on average "
            "(an episode has terminated)",
        ),
        ({"dt": 0.01, "action_repeat": 4}, False, "actions held 4 steps (control period 0.01 s)"),
        ({"action_repeat": 4}, False, "actions held 4 steps"),
    ],
)
def test_a_line_says_what_was_chosen_and_why(
    task: dict[str, Any], terminated: bool, line: str
) -> None:
    assert choices(settings_of(), kreps.TaskSpec(1, [-1.0], [1.0], **task), terminated) == line


def test_nothing_is_said_of_what_was_given() -> None:
    task = kreps.TaskSpec(1, [-1.0], [1.0], dt=0.01, action_repeat=4, time_limit=1000)
    assert choices(settings_of(restart_probability=0.1, action_repeat=4), task, True) == ""
    assert choices(settings_of("paper"), task, True) == ""
    assert choices(kreps.NPALP(task).settings, task, True) == ""


def test_the_progress_begins_with_that_line(capsys: pytest.CaptureFixture[str]) -> None:
    kreps.KREPS(gym.wrappers.TimeLimit(Line(dt=0.02), 120), **SMALL).learn(1)
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "actions held 2 steps (control period 0.02 s)"
    assert second.startswith("iter 1 ")
    kreps.KREPS(Line(), **SMALL).learn(1)
    assert capsys.readouterr().out.startswith("iter 1 ")


# ---- files ------------------------------------------------------------------------------------


def assert_same(learner: kreps.KREPS, other: kreps.KREPS) -> None:
    a, b = learner.state, other.state
    assert (a.steps, a.terminated) == (b.steps, b.terminated)
    for one, two in (
        (a.policy.states, b.policy.states),
        (a.policy.greedy(a.policy.states), b.policy.greedy(a.policy.states)),
        (a.value.alpha, b.value.alpha),
    ):
        assert np.array_equal(one, two)


@pytest.mark.parametrize("limited", [True, False])
def test_a_resumed_learner_makes_the_same_choice(limited: bool, tmp_path: Path) -> None:
    def env() -> Any:
        line = Line(edge=1.5, dt=0.05)
        return gym.wrappers.TimeLimit(line, 60) if limited else line

    whole = kreps.KREPS(env(), seed=1, **SMALL).learn(3, progress=False)
    part = kreps.KREPS(env(), seed=1, **SMALL).learn(1, progress=False)
    part.save(tmp_path / "checkpoint.safetensors")
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint.safetensors", env())
    assert resumed.settings.restart_probability is None
    assert resumed.restart_probability == part.restart_probability
    assert (resumed.task.dt, resumed.task.time_limit) == (0.05, 60 if limited else None)
    assert_same(whole, resumed.learn(2, progress=False))
    assert whole.restart_probability == 0.005


@pytest.mark.parametrize(
    ("name", "given", "first", "growth"),
    [
        ("kreps/SwingUp-v0", {}, 3, 0.25),
        ("kreps/SwingUp-v0", {"growth": 0}, 30, 0),
        ("kreps/SwingUp-v0", {"initial_rollouts": 5}, 5, 0.25),
        ("kreps/ImageSwingUp-v0", {}, 30, 0),
        ("kreps/ImageSwingUp-v0", {"growth": 0.5}, 3, 0.5),
        ("kreps/ImageSwingUp-v0", {"initial_rollouts": 5, "growth": 0.5}, 5, 0.5),
    ],
)
def test_batches_grow_but_in_images(
    name: str, given: dict[str, Any], first: int, growth: float
) -> None:
    env = gym.make(name)
    learner = kreps.KREPS(env, **given)
    settings = learner.update_settings
    assert (settings.initial_rollouts, settings.growth) == (first, growth)
    assert settings == with_batches(settings, learner.task)
    kept = {"initial_rollouts": None, "growth": None, **given}
    assert {each: getattr(learner.settings, each) for each in kept} == kept
    env.close()


def test_the_first_batch_of_images_is_the_large_one() -> None:
    env = gym.make("kreps/ImageSwingUp-v0")
    learner = kreps.KREPS(env, restart_probability=0.5, model_based=None)
    learner.learn(2, progress=False)
    assert learner.state.rollouts == 30 + 10
    env.close()


def test_a_policy_file_has_the_times_of_the_task(tmp_path: Path) -> None:
    env = gym.wrappers.TimeLimit(Line(dt=0.05), 60)
    learner = kreps.KREPS(env, seed=0, preset="single_step").learn(1, progress=False)
    learner.policy.save(tmp_path / "policy.safetensors")
    task = kreps.load_policy(tmp_path / "policy.safetensors").process.task
    assert (task.dt, task.time_limit) == (0.05, 60)


def test_older_files_know_no_times_and_keep_their_number() -> None:
    folder = Path(__file__).parent / "data" / "v0.1"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they have no checksum
        task = kreps.load_policy(folder / "policy_cost-sensitive-gp.safetensors").process.task
        learner = kreps.KREPS.resume(folder / "checkpoint_default.safetensors")
    assert (task.dt, task.time_limit) == (None, None)
    assert learner.restart_probability == 0.12
    assert not learner.state.terminated
