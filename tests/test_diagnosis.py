"""What limits a run: each cause is found where it is, and nowhere else, and the page shows it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import kreps
from kreps import plotting
from kreps.algorithms.dual import Outcome
from kreps.app import cli, diagnosis_page, report
from kreps.app.cli.settings import parse_setting
from kreps.app.diagnosis import Finding, diagnose, thresholds
from kreps.app.diagnosis.columns import average_rewards, effective_share
from kreps.app.diagnosis.trend import Trend, trend
from kreps.app.progress_file import ADDED_COLUMNS, COLUMNS, max_rank, progress_row
from kreps.app.run_folder import RunConfig, RunFolder
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.envs.references import REFERENCE_REWARDS
from kreps.errors import StorageError
from kreps.learning.environment import task_of
from kreps.models.model_errors import ModelErrors
from kreps.presets import settings_of
from kreps.settings import Grid, Settings

NAME = "kreps/SwingUp-v0"
REFERENCES = REFERENCE_REWARDS[NAME]
CAUSES = {
    "dual solver",
    "local optimum",
    "progress",
    "KL bound",
    "effective sample size",
    "acceptance test",
    "transition model",
    "dynamics",
    "terminations",
    "reward model",
    "rollout length",
    "basis of V",
    "exploration noise",
    "clipped actions",
}
OF_SAMPLES = {"idle columns", "action cost", "delay or hidden state"}
OF_EPISODES = {"episodes"}
RISING = list(np.linspace(-90.0, -30.0, 12))
LEVEL = [-90.0, -70.0, -50.0, -42.0, -40.0, -40.0, -40.5, -39.5, -40.0, -40.2, -39.8, -40.0]
FALLING = [-90.0, -60.0, -30.0, -30.0, -30.0, -30.0, -33.0, -36.0, -39.0, -42.0, -45.0, -48.0]
NOISY = [-90.0, -60.0, -30.0, -50.0, -20.0, -60.0, -30.0, -50.0, -20.0, -60.0, -30.0, -40.0]
HEALTHY: dict[str, Any] = {
    "average_reward": RISING,
    "kl": 0.6,
    "kl_bound": 1.0,
    "eta": 0.3,
    "effective_samples": 500.0,
    "samples": 1000,
    "weighted": 1600,
    "rank": 180,
    "support": 250,
    "newton_iterations": 9,
    "rank_residual": 9e-7,
    "gap": 1e-8,
    "outcome": "BOUND_ACTIVE",
    "jitter": 0.0,
    "model_error": 0.2,
    "clipped": 0.3,
    "eta_floor": 0.1,
    "policy_noise": 0.4,
    "max_rank": 400,
    "ridge": 0.02,
    "exploring": 0.0,
    "rejected": 0.0,
    "reward_lower_quartile": -70.0,
    "reward_upper_quartile": -50.0,
    "dynamics_error": 0.1,
    "worst_dynamics_error": 0.2,
    "worst_coordinate": 1,
    "termination_error": 0.5,
    "reward_error": 0.3,
    "mean_return": -3000.0,
    "terminated": 0.0,
    "time_limit": 200,
    "restart_probability": 0.02,
    "action_repeat": 1,
}


def rows(count: int = 12, **changes: Any) -> list[dict[str, str]]:
    """Rows of ``progress.csv``; a list is taken from its start, anything else for every row."""
    found = []
    for i in range(count):
        row: dict[str, Any] = dict.fromkeys(COLUMNS, 0.0)
        row |= {"iteration": i + 1, "rollouts": 30 + 10 * i, "steps": 1500 + 500 * i}
        for name, value in {**HEALTHY, **changes}.items():
            row[name] = value[i] if isinstance(value, list) else value
        found.append({name: str(value) for name, value in row.items()})
    return found


def finding(name: str, evaluation: Any = None, references: Any = None, **changes: Any) -> Finding:
    found = diagnose(rows(**changes), evaluation, references)
    (one,) = [f for f in found if f.name == name]
    return one


def evaluation(stochastic: float, greedy: float) -> dict[str, Any]:
    return {"iteration": 12, "stochastic": {"mean": stochastic}, "greedy": {"mean": greedy}}


# ---- trends -----------------------------------------------------------------------------------


def test_a_trend_is_the_rise_over_the_last_half() -> None:
    found = trend(np.array([9.0, 9.0, 9.0, 9.0, 1.0, 2.0, 3.0, 4.0]))
    assert found is not None
    assert found.iterations == 4 and found.rise == pytest.approx(3.0)
    assert found.low == pytest.approx(3.0) and found.high == pytest.approx(3.0)
    assert found.rises() and not found.falls() and not found.rises(3.1) and found.below(3.1)


def test_the_error_of_a_trend_has_the_confidence_it_claims() -> None:
    rng = np.random.default_rng(0)
    found = [t for _ in range(2000) if (t := trend(rng.normal(size=20))) is not None]
    for share in (np.mean([t.rises() for t in found]), np.mean([t.falls() for t in found])):
        assert 0.02 < share < 0.05  # one-sided; ranks are discrete, so a little less than 5 %


def test_what_never_changes_neither_rises_nor_falls() -> None:
    assert trend(np.full(20, 0.1)) == Trend(10, 0.0, 0.0, 0.0)


def test_one_bad_batch_turns_no_trend() -> None:
    for bad in range(20):
        values = np.arange(20.0)
        values[bad] = -1e6
        found = trend(values)
        assert found is not None and found.rises() and found.rise == pytest.approx(9.0)


@pytest.mark.parametrize("values", [np.arange(7.0), np.array([*range(11), np.nan]), np.zeros(0)])
def test_too_little_data_has_no_trend(values: Any) -> None:
    assert trend(values) is None


# ---- causes -----------------------------------------------------------------------------------


def test_all_findings_about_a_healthy_run_are_fine() -> None:
    found = diagnose(rows())
    assert {f.name for f in found} == CAUSES - {"local optimum"}
    assert {f.severity for f in found} == {"fine"}
    assert all(f.remedy == "" for f in found)


FIRST_FAILED = {"outcome": ["NOT_CONVERGED"] + ["AT_FLOOR"] * 11}
LATE_FAILED = {"outcome": ["AT_FLOOR"] * 9 + ["NOT_CONVERGED"] + ["AT_FLOOR"] * 2}
SELDOM_AT_FLOOR = {"kl": [0.1] * 12, "outcome": ["AT_FLOOR"] * 7 + ["BOUND_ACTIVE"] * 5}
AT_FLOOR: dict[str, Any] = {"kl": 0.1, "eta": 0.1, "outcome": "AT_FLOOR"}
DOUBLE_PENDULUM: dict[str, Any] = {"reward_error": 0.954, "average_reward": LEVEL}  # R^2 = 0.09
FULL: dict[str, Any] = {"rank": 400, "max_rank": 400}
ON_A_GRID: dict[str, Any] = {"max_rank": "nan", "rank_residual": 0.0}

CASES: list[tuple[str, str, str, dict[str, Any]]] = [
    # finding, severity, what its text shows: a number, a setting or the branch, and the run
    ("dual solver", "limit", "iteration 10", LATE_FAILED),
    ("dual solver", "note", "1 update of 12", FIRST_FAILED),
    ("dual solver", "note", "1e-06", {"jitter": 1e-6}),
    ("dual solver", "note", "value.tolerance=1e-5", {"jitter": 1e-6}),
    ("dual solver", "fine", "certificate", {"jitter": 1e-14}),
    ("dual solver", "fine", "certificate", {"outcome": "FALLBACK"}),
    ("progress", "fine", "rises", {}),
    ("progress", "limit", "falls", {"average_reward": FALLING}),
    ("progress", "note", "varies", {"average_reward": NOISY}),
    ("progress", "limit", "100% of the KL bound", {"average_reward": LEVEL, "kl": 1.0}),
    ("progress", "fine", "10% of the KL bound", {"average_reward": LEVEL, "kl": 0.1}),
    ("progress", "note", "7 iterations; 8", {"count": 7}),
    ("progress", "note", "1 iteration;", {"count": 1}),
    ("KL bound", "limit", "100%", {"kl": 1.0}),
    ("KL bound", "limit", "--iterations 24", {"kl": 1.0}),
    ("KL bound", "fine", "100%", {"kl": 1.0, "average_reward": LEVEL}),
    ("KL bound", "fine", "100%", {"kl": 1.0, "count": 3}),
    ("KL bound", "note", "floor (0.1)", AT_FLOOR | {"average_reward": LEVEL}),
    ("KL bound", "fine", "floor (0.1)", AT_FLOOR),
    ("KL bound", "fine", "floor (0.1)", AT_FLOOR | {"count": 3}),
    ("KL bound", "fine", "60%", AT_FLOOR | {"kl": 0.6}),
    ("KL bound", "fine", "10%", SELDOM_AT_FLOOR),
    ("effective sample size", "limit", "is 29,", {"effective_samples": 29.0 * 1.6}),
    ("effective sample size", "limit", "is 9,", {"effective_samples": [500.0] * 7 + [14.4] * 5}),
    ("effective sample size", "note", "4.0%", {"effective_samples": 64.0}),
    ("effective sample size", "fine", "is 51,", {"effective_samples": 81.0}),
    ("effective sample size", "note", "is 36,", {"effective_samples": 36.0, "weighted": 900}),
    ("acceptance test", "fine", "40%", {"rejected": [0.0] * 8 + [1.0, 0.0, 1.0, 0.0]}),
    ("acceptance test", "note", "100%", {"rejected": 1.0}),
    ("transition model", "limit", "not fall", {"model_error": 0.8}),
    ("transition model", "limit", "it falls", {"model_error": list(np.linspace(2.0, 0.9, 12))}),
    ("transition model", "note", "not fall", {"model_error": 0.5}),
    ("transition model", "note", "0.50", {"model_error": 0.5, "count": 2}),
    ("transition model", "fine", "0.39", {"model_error": 0.39}),
    ("dynamics", "limit", "0.85 of their size", {"dynamics_error": 0.85}),
    ("dynamics", "note", "0.50 of their size", {"dynamics_error": 0.5}),
    (
        "dynamics",
        "note",
        "0.71 in the worst column of observations (1)",
        {"worst_dynamics_error": 0.71},
    ),
    ("dynamics", "fine", "0.10 of their size", {}),
    ("reward model", "limit", "explains 9% of the variance", DOUBLE_PENDULUM),
    ("reward model", "note", "explains 9% of the variance", {"reward_error": 0.954}),
    ("reward model", "note", "explains 64% of the variance", {"reward_error": 0.6}),
    ("reward model", "limit", "explains 0%", DOUBLE_PENDULUM | {"reward_error": 3.0}),
    ("reward model", "fine", "explains 91% of the variance", {}),
    ("terminations", "note", "0.90", {"termination_error": 0.9, "terminated": 0.6}),
    ("terminations", "fine", "hardly any", {"termination_error": 1.1, "terminated": 0.01}),
    ("terminations", "fine", "0.50", {"terminated": 0.6}),
    (
        "rollout length",
        "note",
        "50 steps on average, and an episode up to 1000",
        {"time_limit": 1000},
    ),
    ("rollout length", "note", "restart_probability=0.002", {"time_limit": 1000}),
    ("rollout length", "fine", "up to 1000", {"time_limit": 1000, "terminated": 0.6}),
    ("rollout length", "fine", "up to 200", {}),
    ("basis of V", "limit", "cap of 400 features, which costs", FULL | {"rank_residual": 0.6}),
    ("basis of V", "limit", "400", FULL | {"rank_residual": 0.6}),
    ("basis of V", "note", "value.max_rank=800", FULL | {"rank_residual": 0.2}),
    ("basis of V", "fine", "0.01", FULL | {"rank_residual": 0.01}),
    ("basis of V", "note", "180", ON_A_GRID),
    ("basis of V", "note", "value=rkhs", ON_A_GRID),
    ("basis of V", "fine", "399", {"rank": 399, "rank_residual": 0.9}),
    ("exploration noise", "limit", "0.01", {"policy_noise": 0.01, "average_reward": LEVEL}),
    ("exploration noise", "note", "0.01", {"policy_noise": 0.01}),
    ("exploration noise", "note", "1.2", {"policy_noise": 1.2}),
    ("exploration noise", "fine", "0.4", {"evaluation": evaluation(-31.0, -30.0)}),
    ("exploration noise", "note", "costs 10", {"evaluation": evaluation(-40.0, -30.0)}),
    ("clipped actions", "note", "97%", {"clipped": 0.97}),
    ("clipped actions", "fine", "89%", {"clipped": 0.89}),
]


@pytest.mark.parametrize(("name", "severity", "says", "changes"), CASES)
def test_each_finding_has_its_severity_and_its_text(
    name: str, severity: str, says: str, changes: dict[str, Any]
) -> None:
    found = finding(name, **changes)
    assert found.severity == severity
    assert says in f"{found.sentence} {found.remedy}"
    assert found.sentence.endswith(".") and found.sentence[0] == found.sentence[0].upper()
    assert bool(found.remedy) == (severity != "fine")


def test_a_run_at_the_best_reference_is_not_limited_by_a_reward_that_hardly_varies() -> None:
    best = next(iter(REFERENCES.values()))
    level = {"average_reward": best, "reward_error": 0.954}
    assert finding("reward model", evaluation(best, best), REFERENCES, **level).severity == "note"
    assert (
        finding("reward model", evaluation(-80.0, -80.0), REFERENCES, **level).severity == "limit"
    )


@pytest.mark.parametrize("without", ["dynamics_error", "termination_error", "reward_error"])
def test_models_that_do_not_exist_have_no_finding(without: str) -> None:
    named = {
        "dynamics_error": "dynamics",
        "termination_error": "terminations",
        "reward_error": "reward model",
    }
    assert named[without] not in {f.name for f in diagnose(rows(**{without: "nan"}))}


def test_rollouts_have_no_length_to_compare_without_a_time_limit() -> None:
    assert "rollout length" not in {f.name for f in diagnose(rows(time_limit="nan"))}


# ---- terminations and returns -----------------------------------------------------------------


def episodic(mean: float, length: float, terminated: float, average: float) -> dict[str, Any]:
    policy = {
        "mean": average,
        "standard_error": 0.0,
        "episodic": {
            "mean": mean,
            "standard_error": 0.0,
            "length": length,
            "terminated": terminated,
            "whole": 1.0,
        },
    }
    return {"iteration": 12, "stochastic": policy, "greedy": policy}


STANDING = {"average_reward": 1.0, "time_limit": 1000}
"""A reward of being alive, which is the same in every step."""


def test_the_reward_of_rollouts_that_end_early_counts_the_steps_that_are_missing() -> None:
    falls_later = {"terminated": [0.9] * 4 + list(np.linspace(0.9, 0.0, 8))}
    assert "The reward rises" in finding("progress", **STANDING, **falls_later).sentence
    assert "The reward rises" not in finding("progress", **STANDING).sentence
    found = average_rewards(rows(average_reward=1.0, terminated=0.5))
    np.testing.assert_allclose(found, 50.0 / (50.0 + 0.5 * 50.0))  # p = 0.02: 50 steps to a restart
    for unknown in ({"terminated": "nan"}, {"restart_probability": 0.0, "terminated": 0.5}):
        np.testing.assert_array_equal(average_rewards(rows(average_reward=1.0, **unknown)), 1.0)


def test_episodes_that_fall_early_are_the_limit_where_steps_pay() -> None:
    fallen = finding("episodes", episodic(21.0, 21.0, 1.0, 0.4), **STANDING)
    assert fallen.severity == "limit" and "21 steps of at most 1000" in fallen.sentence
    stands = finding("episodes", episodic(1000.0, 1000.0, 0.0, 1.0), **STANDING)
    assert stands.severity == "fine" and "returns 1000 in 1000 steps" in stands.sentence
    goal = finding("episodes", episodic(-60.0, 60.0, 1.0, -0.4), average_reward=-1.0)
    assert goal.severity == "fine"  # an early end is better where steps cost


def test_episodes_that_earn_less_later_are_noted() -> None:
    later = finding("episodes", episodic(-60_000.0, 1000.0, 0.0, -30.0))
    assert later.severity == "note" and "the later ones earn less" in later.sentence
    assert "-30" in later.sentence and "-60 per step" in later.sentence
    assert finding("episodes", episodic(-30_000.0, 1000.0, 0.0, -30.0)).severity == "fine"


def test_what_never_ends_has_no_finding_about_episodes() -> None:
    for each in (None, evaluation(-31.0, -30.0)):
        assert "episodes" not in {f.name for f in diagnose(rows(), each)}


def test_a_solved_task_of_staying_alive_is_no_goal_that_was_not_reached() -> None:
    learnt = {"exploring": [0.0] * 11 + [1.0], "terminated": [0.9] * 6 + [0.0] * 6}
    solved = finding("goal", episodic(1000.0, 1000.0, 0.0, 1.0), **STANDING, **learnt)
    assert solved.severity == "note" and "last 1000 steps" in solved.sentence
    assert "not reached" not in solved.sentence and "as it is" in solved.remedy
    falls = finding("goal", episodic(300.0, 300.0, 1.0, 0.9), **STANDING, **learnt)
    assert falls.severity == "note" and "longer rollouts" in falls.remedy


def greedy(*each: Any) -> Rollouts:
    return Rollouts.from_list(
        [Rollout(np.zeros((len(r) + 1, 1)), np.zeros((len(r), 1)), np.asarray(r)) for r in each]
    )


def length_finding(rewards: Rollouts, **changes: Any) -> Finding | None:
    found = diagnose(rows(**changes), None, None, None, rewards)
    return next((f for f in found if f.name == "rollout length"), None)


def test_rollouts_are_too_short_where_the_reward_rises_after_them() -> None:
    late = [np.repeat([-90.0, -10.0], 50)] * 2  # the goal is reached after 50 steps
    found = length_finding(greedy(*late))
    assert found is not None and found.severity == "limit" and "higher by 80" in found.sentence
    assert "restart_probability=0.01)" in found.remedy
    early = [np.repeat([-90.0, -10.0, -10.0], [20, 30, 50])] * 2
    assert "higher" not in str(length_finding(greedy(*early)))
    fine = length_finding(greedy(*early), time_limit="nan")
    assert fine is not None and fine.severity == "fine"
    noise = np.random.default_rng(0).normal(-50.0, 100.0, (3, 100))
    noisy = length_finding(greedy(*noise))
    assert noisy is not None and noisy.severity == "fine"
    assert length_finding(greedy(np.zeros(60), np.zeros(60)), time_limit="nan") is None


# ---- samples ----------------------------------------------------------------------------------


def window(*extra: Any, cost: float = 0.1, seed: int = 0, task: TaskSpec | None = None) -> Any:
    """A point that a policy pushes to zero; ``extra`` columns are functions of x (T,) and rng."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(20):
        x, v, states, pushes = rng.normal(), 0.0, [], []
        for _ in range(40):
            states.append([x, v])
            push = np.clip(-x - v + 0.3 * rng.normal(), -1.0, 1.0)
            pushes.append(push)
            x, v = x + 0.1 * v, v + 0.1 * push
        points = np.array([*states, [x, v]])
        more = [make(points[:, 0], rng) for make in extra]
        points, actions = np.column_stack([points, *more]), np.array(pushes)[:, None]
        rewards = -(points[:-1, 0] ** 2) - cost * actions[:, 0] ** 2
        found.append(Rollout(points, actions, rewards))
    task = task or TaskSpec(2 + len(extra), [-1.0], [1.0])
    return ReplayWindow(task, None).append(found)


def about_samples(samples: Any, name: str) -> Finding:
    (one,) = [f for f in diagnose(rows(), None, None, samples) if f.name == name]
    return one


def noise(x: Any, rng: np.random.Generator) -> Any:
    return 1e3 * rng.normal(size=len(x))


def test_idle_columns_are_found_and_named() -> None:
    def constant(x: Any, rng: Any) -> Any:
        return np.full(len(x), 7.0)

    def copy(x: Any, rng: Any) -> Any:
        return 1e-6 * x + 3.0

    found = about_samples(window(noise, constant, copy), "idle columns")
    assert found.severity == "note" and found.value == 2
    assert "3 never changes; 4 is a copy of 0; 2 is noise" in found.sentence
    still = about_samples(window(constant), "idle columns")  # it changes no distance
    assert still.severity == "fine" and "2 never changes" in still.sentence


def test_columns_that_tell_something_are_not_idle() -> None:
    def jumping_goal(x: Any, rng: Any) -> Any:
        return np.full(len(x), rng.normal())

    def phase(x: Any, rng: Any) -> Any:
        return np.sin(3.0 * np.arange(len(x)))

    found = about_samples(window(jumping_goal, phase), "idle columns")
    assert found.severity == "fine" and "None of the 4" in found.sentence


@pytest.mark.parametrize("power", [1, 2])
def test_noise_that_the_reward_or_a_successor_depends_on_is_no_idle_column(power: int) -> None:
    samples = window(lambda x, rng: rng.normal(size=len(x)))
    wanted = [
        Rollout(r.observations, r.actions, r.rewards + r.observations[:-1, 2] ** power)
        for r in samples.rollouts
    ]
    found = about_samples(ReplayWindow(samples.task, None).append(wanted), "idle columns")
    assert found.severity == "fine"


def test_images_have_no_idle_columns() -> None:
    task = TaskSpec(4, [-1.0], [1.0], groups=((0, 1, 2, 3),), image_shape=(2, 2))
    found = diagnose(rows(), None, None, window(noise, noise, task=task))
    assert "idle columns" not in {f.name for f in found}


def test_a_price_of_actions_that_dominates_the_reward_is_noted() -> None:
    dear = about_samples(window(cost=30.0), "action cost")
    assert dear.severity == "note" and dear.value > 0.8
    # the policy acts by the state, so that actions alone explain most of the reward
    cheap = about_samples(window(cost=0.01), "action cost")
    assert cheap.severity == "fine" and cheap.value < 0.05


def test_a_reward_of_large_actions_is_no_price() -> None:
    assert about_samples(window(cost=-30.0), "action cost").value == 0.0


def test_equal_rewards_and_few_samples_have_no_price() -> None:
    samples = window()
    few = ReplayWindow(samples.task, None).append(samples.rollouts[:1])
    assert "action cost" not in {f.name for f in diagnose(rows(), None, None, few)}
    equal = [Rollout(r.observations, r.actions, np.ones(len(r))) for r in samples.rollouts]
    alike = ReplayWindow(samples.task, None).append(equal)
    assert "action cost" not in {f.name for f in diagnose(rows(), None, None, alike)}


def test_every_value_stands_to_its_limit_as_the_severity_says() -> None:
    above = {"transition model": {"model_error": 0.9}, "clipped actions": {"clipped": 0.95}}
    for name, changes in above.items():
        assert finding(name, **changes).value >= finding(name, **changes).limit
        assert finding(name).value < finding(name).limit
    few = finding("effective sample size", effective_samples=9.0)
    assert few.value == pytest.approx(9.0 / 1.6)
    assert few.value < few.limit == 30.0


def test_one_bad_iteration_is_not_a_cause() -> None:
    assert finding("transition model", model_error=[0.2] * 11 + [0.9]).severity == "fine"
    assert (
        finding("effective sample size", effective_samples=[500.0] * 11 + [9.0]).severity == "fine"
    )


STRAIGHT = list(np.linspace(-60.0, -30.0, 20))


@pytest.mark.parametrize("bad", [0, 1, 9, 10, 15, 19])
@pytest.mark.parametrize("reward", [-1e5, 1e5])
def test_one_bad_batch_does_not_change_what_is_found(bad: int, reward: float) -> None:
    # a first batch of -1e5 made 2 % of the range more than the rise: "does not rise"
    rewards = [*STRAIGHT[:bad], reward, *STRAIGHT[bad + 1 :]]
    noisy = evaluation(-40.0, -34.0)
    for changes in ({"kl": 1.0}, AT_FLOOR, {"evaluation": noisy}):
        for name in ("progress", "KL bound", "exploration noise"):
            expected = finding(name, count=20, average_reward=STRAIGHT, **changes)
            found = finding(name, count=20, average_reward=rewards, **changes)
            assert found.severity == expected.severity
    assert "rises: +14.2" in finding("progress", count=20, average_reward=rewards).sentence


@pytest.mark.parametrize("count", [8, 9, 12, 20, 50])
def test_a_first_batch_far_worse_than_the_rest_hides_no_rise(count: int) -> None:
    rewards = [-1e5, *np.linspace(-60.0, -30.0, count - 1)]
    assert "The reward rises" in finding("progress", count=count, average_reward=rewards).sentence


def test_batches_of_exploration_policies_set_no_range() -> None:
    rewards = [-1e5, -1e5, -1e5, *np.linspace(-60.0, -30.0, 17)]
    explored = [1.0, 1.0, 0.0, *[0.0] * 17]  # after the first two updates no goal was reached yet
    found = finding("progress", count=20, average_reward=rewards, exploring=explored)
    assert "The reward rises" in found.sentence


def test_a_significant_rise_is_never_called_none() -> None:
    rewards = [-90.0, -90.0, -70.0, -50.0, *np.linspace(-30.0, -29.9, 8)]
    for changes in ({"kl": 1.0}, AT_FLOOR):
        for f in diagnose(rows(average_reward=rewards, **changes)):
            assert "does not rise" not in f.sentence
    assert "hardly rises, +0.0714" in finding("progress", average_reward=rewards).sentence


@pytest.mark.parametrize("count", range(1, 8))
def test_nothing_is_stuck_before_there_is_a_trend(count: int) -> None:
    found = diagnose(
        rows(count, average_reward=-62.0, model_error=0.5), evaluation(-62.0, -62.0), REFERENCES
    )
    assert "local optimum" not in {f.name for f in found}
    for f in found:
        assert "does not" not in f.sentence and "converged" not in f.sentence.replace(
            "All updates converged", ""
        )


@pytest.mark.parametrize("rewards", [RISING, FALLING, NOISY, LEVEL])
@pytest.mark.parametrize("kl", [0.1, 0.6, 1.0])
@pytest.mark.parametrize("outcome", ["AT_FLOOR", "BOUND_ACTIVE"])
def test_findings_agree_about_the_reward(rewards: list[float], kl: float, outcome: str) -> None:
    found = diagnose(rows(average_reward=rewards, kl=kl, outcome=outcome), None, {})
    (main,) = [f for f in found if f.name == "progress"]
    for f in found:
        if "does not rise" in f.sentence:
            assert "does not rise" in main.sentence
        if "the run has converged" in f.sentence:
            assert main.severity == "fine"
        if "still rises" in f.sentence:
            assert "The reward rises" in main.sentence


def test_settings_that_remedies_name_exist() -> None:
    named = [
        parse_setting(word.strip("().,;"))
        for name, _, _, changes in CASES
        for before, word in pairwise(finding(name, **changes).remedy.split())
        if before.strip("(") == "--set"
    ]
    assert len(named) > 20
    for setting, value in named:
        settings_of(**{setting: value})


@pytest.mark.parametrize(
    ("floor", "higher"), [(0.1, "0.2"), (0.4, "0.8"), (0.02, "0.04"), (1e-6, "0.2"), ("nan", "0.2")]
)
def test_a_higher_floor_is_higher_than_it_was(floor: Any, higher: str) -> None:
    found = finding("progress", average_reward=LEVEL, kl=1.0, eta_floor=floor)
    assert f"--set eta_floor={higher})" in found.remedy


@pytest.mark.parametrize(
    ("ridge", "larger"),
    [(0.02, "1"), ("nan", "1"), (0.1, "1"), (0.234, "2.3"), (12.34, "120"), (5e6, "5e+07")],
)
def test_a_larger_ridge_is_larger_than_it_was(ridge: Any, larger: str) -> None:
    found = finding("dual solver", outcome="NOT_CONVERGED", ridge=ridge)
    assert f"--set ridge={larger})" in found.remedy


def test_generated_actions_of_one_state_count_as_one_policy_target() -> None:
    few = {"effective_samples": 100.0, "samples": 500}
    assert finding("effective sample size", **few, weighted=500).severity == "fine"
    generated = finding("effective sample size", **few, weighted=2000)
    assert generated.severity == "limit" and generated.value == pytest.approx(25.0)
    # fewer weights than samples, where not all samples get a generated action
    assert finding("effective sample size", **few, weighted=250).value == pytest.approx(100.0)


def test_a_known_local_optimum_is_named_by_the_evaluation() -> None:
    stuck = evaluation(-62.5, -62.0)
    found = finding("local optimum", stuck, REFERENCES, average_reward=LEVEL)
    assert found.severity == "limit" and found.limit == -61.9 and found.value == -62.0
    assert "local optimum (constant torque)" in found.sentence and "--seed" in found.remedy


def test_a_known_local_optimum_is_named_by_the_rollouts_too() -> None:
    stuck = [r - 22.0 for r in LEVEL]
    assert diagnose(rows(average_reward=stuck), None, REFERENCES)[0].name == "local optimum"


@pytest.mark.parametrize(
    ("reward", "references", "changes"),
    [
        (-62.0, REFERENCES, {}),  # the reward rises: it passes by
        (-62.0, {}, {"average_reward": LEVEL}),
        (-50.0, REFERENCES, {"average_reward": LEVEL}),
        (-21.5, REFERENCES, {"average_reward": LEVEL}),  # the optimum is no local one
        (-101.0, REFERENCES, {"average_reward": [-100.0 - i % 2 for i in range(12)]}),
    ],
)
def test_no_local_optimum_is_made_up(
    reward: float, references: Any, changes: dict[str, Any]
) -> None:
    found = diagnose(rows(**changes), evaluation(reward, reward), references)
    near = [f.sentence for f in found if f.name == "local optimum"]
    assert all("constant torque" not in sentence for sentence in near)


def test_near_the_best_known_reward_nothing_is_stuck() -> None:
    best = evaluation(-23.0, -22.0)
    found = finding("progress", best, REFERENCES, average_reward=LEVEL, kl=1.0)
    assert found.severity == "fine" and "-21.2" in found.sentence


def test_the_most_severe_findings_come_first() -> None:
    found = diagnose(
        rows(model_error=0.5, clipped=0.95, effective_samples=9.0, average_reward=LEVEL)
    )
    severities = [f.severity for f in found]
    assert severities == sorted(severities, key=["limit", "note", "fine"].index)
    assert severities[0] == "limit" and severities[-1] == "fine" and "note" in severities


def test_a_reward_that_never_changes_is_no_division_by_zero() -> None:
    found = finding("progress", evaluation(-5.0, -5.0), average_reward=-5.0, kl=0.0)
    assert found.severity == "fine"


def test_causes_without_numbers_are_left_out() -> None:
    unknown: dict[str, Any] = dict.fromkeys(ADDED_COLUMNS, "nan")
    missing = {
        "acceptance test",
        "transition model",
        "dynamics",
        "terminations",
        "reward model",
        "rollout length",
        "basis of V",
        "exploration noise",
        "clipped actions",
    }
    assert {f.name for f in diagnose(rows(**unknown))} == CAUSES - missing - {"local optimum"}
    found = finding("KL bound", **unknown | {"kl": 0.1, "outcome": "AT_FLOOR"})
    assert "nan" not in found.sentence
    without_model = diagnose(rows(model_error="nan"))
    assert "transition model" not in {f.name for f in without_model}


LEVEL_AT_FLOOR: dict[str, Any] = AT_FLOOR | {"average_reward": LEVEL}


def test_the_floor_is_the_one_that_holds() -> None:
    lowered = [0.05] * 10 + [0.01] * 2
    assert (
        "at its floor (0.01)" in finding("KL bound", **LEVEL_AT_FLOOR, eta_floor=lowered).sentence
    )
    found = finding("progress", average_reward=LEVEL, kl=1.0, eta_floor=lowered)
    assert "eta_floor=0.02)" in found.remedy


@pytest.mark.parametrize(("floor", "suggested"), [(0.05, True), (0.011, True), (0.01, False)])
def test_a_floor_lower_than_was_found_to_pay_is_not_suggested(
    floor: float, suggested: bool
) -> None:
    found = finding("KL bound", **LEVEL_AT_FLOOR, eta_floor=floor)
    assert found.severity == "note" and "window=60)" in found.remedy
    assert ("lower eta_floor" in found.remedy) == suggested


def test_rejected_policies_are_counted() -> None:
    rejected = [1.0] * 7 + [0.0, 1.0, 0.0, 0.0, 1.0]
    assert finding("acceptance test", rejected=rejected).value == pytest.approx(0.4)
    assert finding("acceptance test", rejected=rejected).severity == "fine"
    found = finding("acceptance test", rejected=1.0)
    assert found.severity == "note" and "100%" in found.sentence and found.remedy


def test_the_share_is_of_the_samples_that_were_given_weights() -> None:
    shares = effective_share(rows(2, weighted=["nan", 2000.0], samples=1000.0))
    np.testing.assert_allclose(shares, [0.5, 0.25])


def test_iterations_that_have_the_numbers_are_used() -> None:
    assert finding("transition model", model_error=["nan"] * 10 + [0.5, 0.7]).value == 0.6


# ---- run folders ------------------------------------------------------------------------------


def write_run(path: Path, content: list[dict[str, str]], without: tuple[str, ...] = ()) -> Path:
    RunFolder(path).create(RunConfig(NAME, 12, 0, "model_based", {}, None))
    names = [name for name in COLUMNS if name not in without]
    with (path / "progress.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(content)
    return path


def test_files_of_earlier_versions_are_read(tmp_path: Path) -> None:
    found = RunFolder(write_run(tmp_path, rows(), without=ADDED_COLUMNS)).rows()
    assert len(found) == 12
    assert all(set(row) == set(COLUMNS) for row in found)
    assert {row[name] for row in found for name in ADDED_COLUMNS} == {"nan"}


@pytest.mark.parametrize(
    ("name", "value", "good"),
    [
        ("model_error", "nan", True),
        ("model_error", "inf", False),
        ("model_error", "word", False),
        ("kl", "nan", False),
    ],
)
def test_only_what_may_be_unknown_may_be_nan(
    name: str, value: str, good: bool, tmp_path: Path
) -> None:
    folder = RunFolder(write_run(tmp_path, rows(**{name: value})))
    if good:
        assert folder.rows()[0][name] == value
    else:
        with pytest.raises(StorageError, match="damaged"):
            folder.rows()


def test_new_columns_come_after_those_of_all_versions_before() -> None:
    # of the last version before policies had an acceptance test
    before = [
        "weighted",
        "model_error",
        "clipped",
        "eta_floor",
        "policy_noise",
        "max_rank",
        "ridge",
        "exploring",
    ]
    assert ADDED_COLUMNS[: 1 + len(before)] == ("cpu_seconds_generated_samples", *before)


def test_files_with_some_of_the_newer_columns_are_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="columns"):
        RunFolder(write_run(tmp_path, rows(), without=ADDED_COLUMNS[:2])).rows()


@pytest.mark.parametrize("count", range(1, len(ADDED_COLUMNS)))
def test_files_with_the_first_of_the_newer_columns_are_those_of_a_version(
    count: int, tmp_path: Path
) -> None:
    found = RunFolder(write_run(tmp_path, rows(), without=ADDED_COLUMNS[count:])).rows()
    assert {row[name] for row in found for name in ADDED_COLUMNS[count:]} == {"nan"}
    assert "nan" not in {row[name] for row in found for name in ADDED_COLUMNS[:count]}


def test_a_row_has_what_the_diagnosis_needs() -> None:
    dual = SimpleNamespace(
        kl=0.9,
        eta=0.2,
        dual=0.0,
        primal=0.0,
        gap=0.0,
        decrement=0.0,
        stationarity=0.0,
        iterations=5,
        weights=np.full(4000, 1.0 / 4000),
        outcome=Outcome.BOUND_ACTIVE,
    )
    info = SimpleNamespace(
        dual=dual,
        samples=1000,
        effective_samples=300.0,
        rank=50,
        rank_residual=0.0,
        support=900,
        jitter=0.0,
        noise=0.09,
        model_error=float("nan"),
        held_out=ModelErrors(0.1, 0.7, 2, float("nan"), 0.4),
        clipped=0.25,
        eta_floor=0.1,
        ridge=0.03,
        policy_kl=0.7,
        rejected=True,
        seconds={},
    )
    settings = settings_of(**{"value.max_rank": 70})
    env = gym.wrappers.TimeLimit(gym.make("kreps/SwingUp-v0"), 80)
    task = task_of(env)
    learner: Any = SimpleNamespace(settings=settings, exploring=True, env=env, task=task)
    iteration: Any = SimpleNamespace(
        iteration=1,
        rollouts=30,
        steps=1000,
        average_reward=-1.0,
        mean_return=-20.0,
        terminated=0.1,
        reward_quartiles=(-2.0, -0.5),
        update=info,
        rollout_seconds=0.1,
        restart_probability=0.02,
        explorer_share=0.4,
    )
    row = progress_row(learner, iteration)
    assert set(row) == set(COLUMNS) and row["weighted"] == 4000
    assert row["policy_noise"] == pytest.approx(0.3) and row["max_rank"] == 70
    assert row["clipped"] == 0.25 and row["eta_floor"] == 0.1 and np.isnan(row["model_error"])
    assert row["ridge"] == 0.03 and row["exploring"] == 1.0 and row["rejected"] == 1.0
    assert (row["reward_lower_quartile"], row["reward_upper_quartile"]) == (-2.0, -0.5)
    assert (row["dynamics_error"], row["worst_dynamics_error"]) == (0.1, 0.7)
    assert row["worst_coordinate"] == 2 and row["reward_error"] == 0.4
    assert np.isnan(row["termination_error"])
    assert (row["mean_return"], row["terminated"]) == (-20.0, 0.1)
    assert row["explorer_share"] == 0.4 and row["policy_kl"] == 0.7
    assert row["time_limit"] == 80 and row["restart_probability"] == 0.02
    assert row["robot_seconds"] == 50.0  # 1000 steps at 20 Hz
    learner.env = gym.make("kreps/SwingUp-v0")
    assert np.isnan(progress_row(learner, iteration)["time_limit"])
    learner.task = replace(task, dt=None)
    assert np.isnan(progress_row(learner, iteration)["robot_seconds"])


def test_a_goal_that_was_not_reached_is_the_limit() -> None:
    found = {f.name: f for f in diagnose(rows(exploring=1.0))}["goal"]
    assert found.severity == "limit" and found.value == 12
    assert "exploring" in found.sentence and "update(rollouts)" in found.remedy
    for fine in ([1.0] * 5 + [0.0] * 7, float("nan")):
        assert "goal" not in {f.name for f in diagnose(rows(exploring=fine))}


def test_features_of_a_grid_have_no_largest_number() -> None:
    assert np.isnan(max_rank(Settings(value=Grid(5))))
    assert max_rank(settings_of(**{"value.max_rank": 30})) == 30


# ---- the page ---------------------------------------------------------------------------------


def page(changes: dict[str, Any], references: Any = None) -> tuple[Figure, list[Finding]]:
    content = rows(**changes)
    found = diagnose(content, None, references)
    return diagnosis_page.page(content, found, references or {}, "a run"), found


def panels(figure: Figure) -> dict[str, Any]:
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def words(figure: Figure) -> list[Any]:
    return list(figure.subfigs[1].texts)


BAD: dict[str, Any] = {
    "average_reward": LEVEL,
    "kl": 1.0,
    "model_error": 0.9,
    "clipped": 0.95,
    "effective_samples": 9.0,
    "rank": 400,
    "rank_residual": 0.6,
    "policy_noise": 0.01,
    "jitter": 1e-5,
}


def test_the_panels_show_the_numbers_and_their_thresholds() -> None:
    figure, _ = page({})
    shown = panels(figure)
    assert list(shown) == list(diagnosis_page.PANELS)
    wanted: dict[str, tuple[float, list[float]]] = {
        "KL": (0.6, [1.0, 0.5]),
        "Temp": (0.3, [0.1]),
        "Eff": (500.0 / 1600.0, [0.05]),
        "Model": (0.2, [0.4, 0.8]),
        "Basis": (180.0, [400.0]),
        "Policy": (0.4, [0.02, 1.0]),
        "Actions": (0.3, [0.9]),
    }
    for start, (value, lines) in wanted.items():
        (axes,) = [axes for title, axes in shown.items() if title.startswith(start)]
        curve, *others = axes.lines
        np.testing.assert_allclose(curve.get_ydata(), value)
        np.testing.assert_array_equal(curve.get_xdata(), np.arange(1, 13))
        dashed = [line for line in others if line.get_linestyle() == "--"]
        levels = [float(np.asarray(line.get_ydata())[0]) for line in dashed]
        assert levels == lines
        low, high = axes.get_ylim()
        assert all(low < level < high for level in [value, *lines])


def test_the_reward_is_drawn_with_its_references_and_its_trend() -> None:
    figure, _ = page({}, REFERENCES)
    axes = figure.axes[0]
    curve, *others = axes.lines
    np.testing.assert_allclose(curve.get_ydata(), RISING)
    levels = {float(np.asarray(line.get_ydata())[0]) for line in others}
    assert set(list(REFERENCES.values())[:-1]) <= levels
    ends = np.asarray(others[-1].get_ydata())
    np.testing.assert_allclose(ends, RISING[6:])


def test_one_bad_batch_flattens_no_panel() -> None:
    rewards, errors = [-123456.0, *RISING[1:]], [*[0.2] * 6, 40.0, *[0.2] * 5]
    figure, _ = page({"average_reward": rewards, "model_error": errors}, REFERENCES)
    shown = panels(figure)
    for start, low, high, value in (
        ("Average", -150.0, 0.0, "-1.235e+05"),
        ("Model", 0.0, 1.5, "40"),
    ):
        (axes,) = [axes for title, axes in shown.items() if title.startswith(start)]
        limits = axes.get_ylim()
        assert low <= limits[0] and limits[1] <= high
        assert value in [t.get_text() for t in axes.texts]


@pytest.mark.parametrize("changes", [{}, BAD], ids=["healthy", "bad"])
def test_every_panel_is_marked_with_its_gravest_finding(changes: dict[str, Any]) -> None:
    figure, found = page(changes)
    for title, axes in panels(figure).items():
        mine = [f.severity for f in found if f.name in diagnosis_page.PANELS[title]]
        gravest = min(mine, key=["limit", "note", "fine"].index)
        assert axes.get_title(loc="right") == f"● {gravest}"
    shown = {name for names in diagnosis_page.PANELS.values() for name in names}
    assert shown == CAUSES | OF_SAMPLES | OF_EPISODES | {"goal"}


@pytest.mark.parametrize("changes", [{}, BAD], ids=["healthy", "bad"])
def test_the_page_holds_every_word_and_none_runs_out_of_it(changes: dict[str, Any]) -> None:
    figure, found = page(changes, REFERENCES)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    texts = words(figure)
    said = " ".join(" ".join(t.get_text() for t in texts).split())
    for f in found:
        for part in (f.sentence, f.remedy):
            assert " ".join(part.split()) in said
    boxes = [t.get_window_extent(canvas.get_renderer()) for t in texts]
    drawn = figure.subfigs[1].bbox
    for box, below in zip(boxes, [*boxes[1:], None], strict=True):
        assert drawn.x0 <= box.x0 and box.x1 <= drawn.x1
        assert figure.bbox.y0 < box.y0 and box.y1 < figure.bbox.y1
        assert below is None or below.y1 < box.y1
    assert min(t.get_fontsize() for t in texts) >= 7.5


@pytest.mark.parametrize(
    "changes",
    [
        {"count": 1},
        {"count": 2},
        dict.fromkeys(ADDED_COLUMNS, "nan"),
        {"eta": 1e-6, "eta_floor": 1e-6, "kl": 0.0},
        {"average_reward": 0.0},
        {"clipped": 0.0, "policy_noise": 1e-5},
        {"max_rank": "nan", "rank_residual": 0.0},
    ],
)
def test_any_run_has_a_page(changes: dict[str, Any], tmp_path: Path) -> None:
    before = dict(rcParams)
    figure, _ = page(changes, REFERENCES)
    with Image.open(plotting.save(figure, tmp_path / "page.png")) as picture:
        picture.load()
        assert picture.size == (2100, 1320)
    assert dict(rcParams) == before


def test_panels_without_numbers_say_so() -> None:
    figure, _ = page(dict.fromkeys(ADDED_COLUMNS, "nan"))
    silent = [
        title
        for title, axes in panels(figure).items()
        if any("not recorded" in t.get_text() for t in axes.texts)
    ]
    assert [title.split()[0] for title in silent] == ["Model:", "Policy", "Actions"]


# ---- the command ------------------------------------------------------------------------------


@pytest.fixture
def call(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    def _call(*arguments: str | Path) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["kreps", *map(str, arguments)])
        monkeypatch.setenv("COLUMNS", "400")
        with pytest.raises(SystemExit) as stop:
            cli.main()
        printed = capsys.readouterr()
        return int(stop.value.code or 0), " ".join((printed.out + printed.err).split())

    return _call


Call = Callable[..., tuple[int, str]]


def test_diagnose_says_everything_and_draws_it(call: Call, tmp_path: Path) -> None:
    bad = BAD | {"kl": 0.9, "average_reward": NOISY}
    run = write_run(tmp_path / "run[a]", rows(**bad))
    (run / "evaluation.json").write_text(json.dumps(evaluation(-62.0, -62.0)))
    code, text = call("diagnose", run)
    assert code == 0
    for f in report.diagnosis_of(RunFolder(run)):
        assert f"{f.severity.capitalize()}: {f.name}. {f.sentence}" in text
    assert "Limit: local optimum" in text  # the references and the evaluation are used
    assert f"kreps resume {run} --iterations 24" in text and "RUN" not in text
    assert f"drew {run / 'diagnosis.png'}" in text
    assert (run / "diagnosis.png").stat().st_size > 20_000


def test_runs_of_earlier_versions_are_diagnosed_as_far_as_they_go(
    call: Call, tmp_path: Path
) -> None:
    code, text = call("diagnose", write_run(tmp_path / "old", rows(), without=ADDED_COLUMNS))
    assert code == 0 and "Fine: progress" in text and "Not recorded" in text
    code, text = call("diagnose", write_run(tmp_path / "new", rows(model_error="nan")))
    assert code == 0 and "Not recorded" not in text


def test_a_damaged_checkpoint_leaves_out_what_is_about_samples(call: Call, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", rows())
    (run / "checkpoint.safetensors").write_bytes(b"nothing")
    code, text = call("diagnose", run)
    assert code == 0 and "no findings about samples" in text and "Fine: progress" in text
    assert "idle columns" not in text


def test_samples_are_read_from_the_checkpoint(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", rows())
    learner = kreps.KREPS(gym.make(NAME), initial_rollouts=6, model_based=None)
    learner.learn(1, progress=False)
    learner.save(run / "checkpoint.safetensors")
    found = {f.name: f for f in report.diagnosis_of(RunFolder(run))}
    assert "None of the 2 observation columns" in found["idle columns"].sentence
    assert found["action cost"].severity == "fine"


def test_references_of_another_process_are_not_used(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", rows(average_reward=[r - 22.0 for r in LEVEL]))
    folder = RunFolder(run)
    assert "local optimum" in {f.name for f in report.diagnosis_of(folder)}
    folder.write_config(RunConfig(NAME, 12, 0, "model_based", {"restart_probability": 0.1}, None))
    assert "local optimum" not in {f.name for f in report.diagnosis_of(folder)}


@pytest.mark.parametrize(
    ("preset", "settings"),
    [("images", {}), ("model_based", {"model": "sample"}), ("model_based", {"a": 1})],
)
def test_settings_of_earlier_versions_do_not_keep_references_away(
    preset: str, settings: dict[str, Any], tmp_path: Path
) -> None:
    run = write_run(tmp_path / "run", rows(average_reward=[r - 22.0 for r in LEVEL]))
    folder = RunFolder(run)
    folder.write_config(RunConfig(NAME, 12, 0, preset, settings, None))
    assert "local optimum" in {f.name for f in report.diagnosis_of(folder)}


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_the_page_goes_where_it_is_asked_for(suffix: str, call: Call, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", rows())
    out = tmp_path / f"page{suffix}"
    assert call("diagnose", run, "--out", out)[0] == 0
    assert out.stat().st_size > 10_000
    assert not (run / "diagnosis.png").exists()


@pytest.mark.parametrize("out", ["page.gif", "page", "missing/page.png"])
def test_pages_that_cannot_be_written_are_refused(out: str, call: Call, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", rows())
    code, text = call("diagnose", run, "--out", tmp_path / out)
    assert code == 2 and "error:" in text and Path(out).name in text
    assert ("Fine:" in text) == (out == "missing/page.png")  # a name is looked at first


def test_folders_that_hold_nothing_to_diagnose_are_refused(call: Call, tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "missing"):
        code, text = call("diagnose", place)
        assert code == 2 and "not a run folder" in text and "kreps train" in text
    run = write_run(tmp_path / "run", [])
    code, text = call("diagnose", run)
    assert code == 2 and "no iteration yet" in text and f"kreps resume {run}" in text
    (run / "progress.csv").unlink()
    assert call("diagnose", run)[0] == 2
    (run / "progress.csv").write_text("iteration,foo\n1,2\n")
    code, text = call("diagnose", run)
    assert code == 2 and "damaged" in text


def test_the_help_teaches(call: Call) -> None:
    code, text = call("diagnose", "--help")
    assert code == 0
    assert "kreps diagnose runs/swing-up" in text
    assert all(word in text for word in ("limit", "note", "fine", "effective sample size"))


def test_the_end_of_a_run_tells_the_three_gravest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run", rows(**BAD))
    report.say_main_findings(RunFolder(run))
    text = capsys.readouterr().out
    assert text.count("Try:") == 3 and "Fine:" not in text
    assert f"kreps diagnose {run}" in " ".join(text.split())
    good = write_run(tmp_path / "good", rows())
    report.say_main_findings(RunFolder(good))
    text = " ".join(capsys.readouterr().out.split())
    assert "No finding limits" in text and f"kreps diagnose {good}" in text


# ---- the documentation ------------------------------------------------------------------------

PAGE = (Path(__file__).resolve().parents[1] / "docs/diagnosis.md").read_text()


def test_the_page_of_the_documentation_explains_every_finding() -> None:
    headings = [line.removeprefix("## ") for line in PAGE.splitlines() if line.startswith("## ")]
    assert set(headings[:-1]) == CAUSES | OF_SAMPLES | OF_EPISODES | {"goal"}
    for section in PAGE.split("\n## ")[1:-1]:
        assert "*Why.*" in section and "*Try*" in section


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("RECENT", "last {:g} iterations"),
        ("MIN_ITERATIONS", "below {:g} iterations"),
        ("CONFIDENCE", "confidence of {:.0%}"),
        ("JITTER_NOTE", "jitter above {:g}"),
        ("MIN_REWARD_RISE", "from {:.0%} of the range"),
        ("HIGH_KL_SHARE", "use {:.0%} or more"),
        ("MIN_EFFECTIVE_SAMPLES", "below {:g} effective samples"),
        ("MIN_EFFECTIVE_SHARE", "below {:.0%} of all"),
        ("MODEL_ERROR_NOTE", "**note** from {:g}, **limit** from"),
        ("MODEL_ERROR_LIMIT", "**limit** from {:g}. Left"),
        ("RESIDUAL_NOTE", "residual of {:g}"),
        ("RESIDUAL_LIMIT", "**limit** from {:g}"),
        ("MIN_POLICY_STD", "below {:g} (**note**"),
        ("MAX_POLICY_STD", "**note** above {:g}"),
        ("CLIPPED_NOTE", "if {:.0%} or more of the commanded"),
    ],
)
def test_the_thresholds_of_the_documentation_are_those_of_the_code(name: str, text: str) -> None:
    expected = text.format(getattr(thresholds, name)).replace("%", " %").replace("1e-08", "1e-8")
    assert expected in " ".join(PAGE.split())


def test_the_thresholds_are_as_documented_where_words_say_them() -> None:
    assert thresholds.LOW_KL_SHARE == thresholds.REJECTED_NOTE == 0.5  # half
    assert thresholds.MAX_LEVEL_RISE == 0.25  # a quarter
    assert thresholds.REFERENCE_TOLERANCE == 0.05  # a twentieth
    assert thresholds.NOISE_COST_NOTE == 0.1  # a tenth
