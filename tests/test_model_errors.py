"""Leave-one-out errors of dynamics, terminations and reward, each apart."""

from __future__ import annotations

import numpy as np
import pytest

from kreps import KREPS, Rollout, TaskSpec
from kreps.data.rollouts import Rollouts, Transitions
from kreps.kernels.kernel import Kernel, SquaredExponential
from kreps.kernels.regression import KernelEmbedding, LeaveOneOut, PivotedEmbedding
from kreps.models.dynamics import DeltaStateTargets, Dynamics, LinearMean
from kreps.models.model_errors import ModelErrors, model_errors
from kreps.models.reward_model import RewardModel, held_out_steps
from kreps.models.terminations import Terminations

TASK = TaskSpec(3, [-1.0], [1.0])


def data(*columns: list[float], terminated: bool = False) -> Transitions:
    """A single rollout with the given columns of states."""
    points = np.array(columns).T
    steps = len(points) - 1
    rollout = Rollout(points, np.zeros((steps, 1)), np.zeros(steps), terminated=terminated)
    return Rollouts.from_list([rollout]).transitions


def dynamics(residuals: list[list[float]], terminations: Terminations | None = None) -> Dynamics:
    """With these leave-one-out residuals (n, 3), in units of the state."""
    none = LinearMean(np.empty(0, np.intp), np.empty((0, 3)), np.zeros(3))
    targets = DeltaStateTargets(np.ones(3), none, TASK)
    return Dynamics(targets, lambda inputs: inputs, np.array(residuals), terminations)


def test_errors_of_the_dynamics_are_relative_to_the_changes_of_each_coordinate() -> None:
    moving = data([0.0, 3.0, 7.0], [0.0, -300.0, 100.0], [5.0, 5.0, 5.0])  # changes 3, 4 and so on
    found = model_errors(moving, TASK, dynamics([[0.5, 100.0, 9.0], [0.0, 300.0, 9.0]]), None)
    first = np.sqrt(0.25 / 25.0)
    second = np.sqrt((100.0**2 + 300.0**2) / (300.0**2 + 400.0**2))
    assert found.worst == pytest.approx(second) and found.worst_coordinate == 1
    # the third coordinate never changes, so there is nothing to predict
    assert found.dynamics == pytest.approx(np.sqrt((first**2 + second**2) / 2.0))


def test_coordinates_that_share_a_lengthscale_count_as_one() -> None:
    moving = data([0.0, 3.0, 7.0], [0.0, 1.0, 2.0], [0.0, 2.0, 4.0])
    task = TaskSpec(3, [-1.0], [1.0], groups=((1, 2),))
    found = model_errors(moving, task, dynamics([[0.0, 1.0, 1.0], [0.0, 1.0, 1.0]]), None)
    assert found.worst_coordinate == 1 and found.worst == pytest.approx(np.sqrt(4.0 / 10.0))
    assert found.dynamics == pytest.approx(np.sqrt(0.5 * 4.0 / 10.0))


def test_there_are_no_errors_of_models_that_do_not_exist() -> None:
    moving = data([0.0, 3.0], [0.0, 1.0], [0.0, 2.0])
    nothing = model_errors(moving, TASK, None, None)
    assert np.isnan([nothing.dynamics, nothing.worst, nothing.terminations, nothing.reward]).all()
    assert nothing.worst_coordinate is None
    still = data([1.0, 1.0], [2.0, 2.0], [3.0, 3.0])
    found = model_errors(still, TASK, dynamics([[0.0, 0.0, 0.0]]), None)
    assert np.isnan(found.dynamics) and found.worst_coordinate is None


def test_errors_of_terminations_and_reward_are_relative_to_the_spread() -> None:
    ended = data([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], [0.0, 1.0, 2.0], terminated=True)
    ends = Terminations(lambda successors: successors, np.array([0.1, -0.3]), 0.0)
    loo = LeaveOneOut(np.array([[10.0], [14.0]]), np.array([[1.0], [1.0]]))
    reward = RewardModel(lambda inputs: inputs, 0.0, 0.0, 0.0, 1.0, loo)
    found = model_errors(ended, TASK, dynamics([[0.0] * 3] * 2, ends), reward)
    assert found.terminations == pytest.approx(np.sqrt(0.1 / 0.5))  # the indicators are 0 and 1
    assert found.reward == pytest.approx(np.sqrt(2.0 / 8.0))


def test_equal_targets_have_no_relative_error() -> None:
    assert np.isnan(LeaveOneOut(np.ones((4, 1)), np.zeros((4, 1))).relative_to_spread)


@pytest.mark.parametrize("pivoted", [False, True])
def test_errors_of_some_samples_are_theirs_among_all(pivoted: bool) -> None:
    rng = np.random.default_rng(0)
    inputs, rows = rng.normal(size=(60, 1)), np.array([3, 4, 59])
    targets = np.sin(3.0 * inputs) + 0.1 * rng.normal(size=(60, 2))
    kernel = Kernel((SquaredExponential((0,)),), np.array([0.5]))
    model: KernelEmbedding | PivotedEmbedding | None = (
        PivotedEmbedding.fit(kernel, inputs, 0.1)
        if pivoted
        else KernelEmbedding.fit(kernel, inputs, 0.1)
    )
    assert model is not None
    found, all_of_them = model.leave_out_each(targets, rows), model.leave_one_out(targets)
    np.testing.assert_allclose(found.errors, all_of_them.errors[rows], rtol=1e-9)
    np.testing.assert_array_equal(found.targets, targets[rows])


@pytest.mark.parametrize(
    ("count", "held_out"), [(1, 1), (300, 300), (301, 151), (1500, 300), (1501, 251)]
)
def test_at_most_so_many_steps_are_held_out(count: int, held_out: int) -> None:
    rows = held_out_steps(count)
    assert len(rows) == held_out and rows[0] == 0 and rows[-1] < count
    assert len(set(np.diff(rows))) <= 1


def rollouts(count: int, reward_noise: float, sensor_noise: float, seed: int = 0) -> list[Rollout]:
    """A point that is pushed, its velocity and a sensor that shows noise."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        x, v, states, actions = rng.normal(), 0.0, [], rng.uniform(-1.0, 1.0, (20, 1))
        for (push,) in actions:
            states.append([x, v, sensor_noise * rng.normal()])
            x, v = x + 0.1 * v, v + 0.1 * push
        states.append([x, v, sensor_noise * rng.normal()])
        points = np.array(states)
        rewards = -(points[:-1, 0] ** 2) + reward_noise * rng.normal(size=20)
        found.append(Rollout(points, actions, rewards))
    return found


def errors(low_rank: bool = False, **noise: float) -> ModelErrors:
    more = {"low_rank.above": 0} if low_rank else {}
    more["model_based.acceptance_rollouts"] = 0
    return KREPS(TASK, **more).update(rollouts(20, **noise)).held_out


@pytest.mark.parametrize("low_rank", [False, True])
def test_an_update_reports_which_part_of_the_model_predicts(low_rank: bool) -> None:
    good = errors(low_rank, reward_noise=0.0, sensor_noise=0.0)
    assert good.dynamics < 0.05 and good.reward < 0.1 and np.isnan(good.terminations)
    random_reward = errors(low_rank, reward_noise=100.0, sensor_noise=0.0)
    assert random_reward.dynamics < 0.05 and 0.9 < random_reward.reward < 1.2
    noisy = errors(low_rank, reward_noise=0.0, sensor_noise=1.0)
    assert noisy.worst_coordinate == 2
    assert noisy.worst == pytest.approx(np.sqrt(0.5), abs=0.15)  # s' less s has twice the variance


def test_without_a_model_there_is_no_error() -> None:
    alone = KREPS(TASK, model_based=None).update(rollouts(20, 0.0, 0.0)).held_out
    assert np.isnan(alone.reward) and alone.dynamics < 0.05
    features_only = KREPS(TASK, preset="single_step").update(rollouts(20, 0.0, 0.0)).held_out
    assert np.isnan(features_only.dynamics) and features_only.worst_coordinate is None
