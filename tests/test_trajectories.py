"""The greedy policy over time, and what the model predicts of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

import kreps
from kreps import plotting
from kreps.app.environments import Labels
from kreps.app.evaluation import _stored
from kreps.app.plots.plane import angle_ticks, half_turns
from kreps.app.plots.trajectories import trajectories
from kreps.app.prediction import newest_transitions, predicted_states
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.learning.evaluate import Greedy, evaluation_rollouts


class Proportional:
    """A linear policy."""

    def __init__(self, task: TaskSpec) -> None:
        self.task = task

    def greedy(self, states: Any) -> Any:
        return 3.0 * states[:, : self.task.action_size]

    def act(self, states: Any, noise: Any) -> Any:
        return self.greedy(states)


def labels(task: TaskSpec) -> Labels:
    return Labels(
        [f"state {i} [m]" for i in range(task.observation_size)],
        [f"force {i} [N]" for i in range(task.action_size)],
    )


def rollouts_of(task: TaskSpec, lengths: list[int]) -> Rollouts:
    rng, policy = np.random.default_rng(0), Proportional(task)
    made = []
    for length in lengths:
        states = np.cumsum(rng.normal(size=(length + 1, task.observation_size)), axis=0)
        made.append(Rollout(states, policy.greedy(states[:-1]), rng.normal(size=length)))
    return Rollouts.from_list(made)


def figure_of(task: TaskSpec, lengths: list[int], predicted: Any = None, steps: int = 9) -> Figure:
    rollouts = rollouts_of(task, lengths)
    return trajectories(rollouts, predicted, steps, Proportional(task), labels(task), "title")


def panels(figure: Figure) -> dict[str, Any]:
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def lines(axes: Any, label: str) -> list[Any]:
    return [np.asarray(line.get_ydata()) for line in axes.lines if line.get_label() == label]


TASK = TaskSpec(3, [-2.0, 0.0], [2.0, 1.0], (1,))

# ---- panels -----------------------------------------------------------------------------------


def test_each_coordinate_action_and_reward_of_each_rollout_is_drawn_over_time() -> None:
    rollouts, shown = rollouts_of(TASK, [9, 5, 9]), panels(figure_of(TASK, [9, 5, 9]))
    (first,) = lines(shown["state 0 [m]"], "first rollout")
    np.testing.assert_array_equal(first, rollouts[0].observations[:, 0])
    others = lines(shown["state 2 [m]"], "other rollouts")
    np.testing.assert_array_equal(others[0], rollouts[1].observations[:, 2])
    assert len(others) == 2
    (command,) = lines(shown["command: force 1 [N]"], "first rollout")
    np.testing.assert_array_equal(command, rollouts[0].actions[:, 1])
    limits = lines(shown["command: force 1 [N]"], "limits of the action")
    assert [float(limit[0]) for limit in limits] == [0.0, 1.0]
    (reward,) = lines(shown["reward per step"], "first rollout")
    np.testing.assert_array_equal(reward, rollouts[0].rewards)
    assert shown["reward per step"].get_xlim() == (0.0, 9.0)


def test_an_angle_counts_whole_turns_and_has_ticks_at_parts_of_them() -> None:
    rollouts, shown = rollouts_of(TASK, [9]), panels(figure_of(TASK, [9]))
    (angle,) = lines(shown["state 1 [m]"], "first rollout")
    assert np.abs(np.diff(angle)).max() <= np.pi
    np.testing.assert_allclose(np.cos(angle), np.cos(rollouts[0].observations[:, 1]), atol=1e-12)
    names = ["-3π/2", "-π", "-π/2", "0", "π/2", "π", "3π/2", "2π", "5π/2"]
    assert [half_turns(count * np.pi / 2) for count in range(-3, 6)] == names
    axes = Figure().add_subplot()
    for length, step in ((7.0, np.pi / 2), (70.0, 5.5 * np.pi)):
        axes.set_ylim(0.0, length)
        angle_ticks(axes.yaxis, 4)
        np.testing.assert_allclose(np.diff(axes.get_yticks()), step)


def test_the_return_of_each_rollout_is_drawn_with_its_spread() -> None:
    rollouts = rollouts_of(TASK, [9, 5, 9])
    (axes,) = [a for t, a in panels(figure_of(TASK, [9, 5, 9])).items() if t.startswith("return")]
    returns = sorted(float(r.rewards.sum()) for r in rollouts)
    (short,) = [y for y in lines(axes, "other rollouts") if y[5] == y[9]]
    np.testing.assert_allclose(short[1:6], np.cumsum(rollouts[1].rewards))  # level after its end
    (median,) = lines(axes, "median return")
    assert median[0] == 0.0 and median[-1] == pytest.approx(returns[1])
    low, high = 0.5 * (returns[0] + returns[1]), 0.5 * (returns[1] + returns[2])
    title = axes.get_title(loc="left")
    assert title == f"return so far: {returns[1]:.4g} ({low:.4g} to {high:.4g})"
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() <= low and band[:, 1].max() >= high


def test_predictions_are_drawn_beside_the_first_rollout_as_far_as_they_go() -> None:
    rng = np.random.default_rng(1)
    predicted = rng.normal(size=(10, 40, 3))
    predicted[7:] = np.nan  # all episodes have ended
    predicted[5:, :30] = np.nan  # most have
    shown = panels(figure_of(TASK, [9, 9], predicted))
    (middle,) = lines(shown["state 0 [m]"], "model's prediction of it (median)")
    assert len(middle) == 7
    np.testing.assert_allclose(middle[:5], np.median(predicted[:5, :, 0], axis=1))
    np.testing.assert_allclose(middle[5:], np.median(predicted[5:7, 30:, 0], axis=1))
    band = shown["state 0 [m]"].collections[0].get_paths()[0].vertices
    inside = predicted[2, :, 0]
    edges = sorted(band[band[:, 0] == 2.0, 1])
    assert edges[0] == pytest.approx(np.quantile(inside, 0.05))
    assert edges[-1] == pytest.approx(np.quantile(inside, 0.95))
    (command,) = lines(shown["command: force 0 [N]"], "model's prediction of it (median)")
    np.testing.assert_allclose(command, 3.0 * middle)


def test_predictions_that_diverge_do_not_flatten_what_happened() -> None:
    predicted = np.cumsum(np.full((10, 5, 3), 1e6), axis=0)
    axes = panels(figure_of(TASK, [9, 9], predicted))["state 0 [m]"]
    happened = np.concatenate([r.observations[:, 0] for r in rollouts_of(TASK, [9, 9])])
    assert np.ptp(axes.get_ylim()) < 3.0 * np.ptp(happened)


@pytest.mark.parametrize(
    ("task", "count"),
    [
        (TaskSpec(17, [-1.0] * 6, [1.0] * 6), 8 + 4 + 2),
        (TaskSpec(2, [-1.0], [1.0]), 2 + 1 + 2),
        (TaskSpec(16, [-1.0], [1.0], groups=(tuple(range(16)),), image_shape=(4, 4)), 1 + 2),
    ],
)
def test_any_task_has_a_figure_with_readable_text(
    task: TaskSpec, count: int, tmp_path: Path
) -> None:
    for lengths in ([1], [9, 1, 3]):
        figure = figure_of(task, lengths, steps=max(lengths))
        assert len([axes for axes in figure.axes if axes.axison]) == count
        title = figure.get_suptitle()
        assert ("8 of 17 coordinates, 4 of 6 actions" in title) == (task.observation_size == 17)
        with Image.open(plotting.save(figure, tmp_path / "a.png")) as picture:
            assert picture.size[0] == 1260
        sizes = [t.get_fontsize() for t in figure.findobj(Text) if t.get_text()]
        assert min(sizes) / 72.0 * 830.0 / 8.4 > 9.5  # pixels in the README
        legends = [*figure.legends, *(a.get_legend() for a in figure.axes if a.get_legend())]
        names = [t.get_text() for legend in legends for t in legend.get_texts()]
        assert len(names) == len(set(names)) and "first rollout" in names


# ---- predictions ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learnt() -> kreps.KREPS:
    env = gym.make("kreps/SwingUp-v0")
    light = {"model_based.improvement_steps": 1, "model_based.acceptance_rollouts": 5}
    return kreps.KREPS(env, initial_rollouts=10, **light).learn(2, progress=False)


def test_the_model_predicts_what_the_greedy_policy_does(learnt: kreps.KREPS) -> None:
    assert learnt.env is not None
    policy = Greedy(learnt.policy.process)
    actual = evaluation_rollouts(learnt.env, learnt.task, policy, episodes=5, steps=15, seed=0)
    predicted = predicted_states(learnt, np.array([np.pi, 0.0]), 15)
    assert predicted is not None and predicted.shape == (16, 50, 2)
    np.testing.assert_array_equal(predicted[0], [[np.pi, 0.0]] * 50)
    happened = np.mean([np.unwrap(r.observations[:, 0]) for r in actual], axis=0)
    middle = np.median(predicted[..., 0], axis=1)
    assert np.abs(middle[:8] - happened[:8]).max() < 0.3  # rad, of which it moves some
    assert np.ptp(happened[:8]) > 0.5
    again = predicted_states(learnt, np.array([np.pi, 0.0]), 15)
    np.testing.assert_array_equal(again, predicted)


def test_a_prediction_ends_with_its_episode() -> None:
    rng = np.random.default_rng(0)
    rollouts = []
    for _ in range(12):  # a position that ends beyond one
        states = np.cumsum(np.r_[0.0, np.full(9, 0.12) + 0.01 * rng.normal(size=9)])[:, None]
        actions = rng.normal(size=(9, 1))
        rollouts.append(Rollout(states, actions, -states[1:, 0], terminated=True))
    learner = kreps.KREPS(TaskSpec(1, [-1.0], [1.0]))
    learner.update(rollouts)
    predicted = predicted_states(learner, np.zeros(1), 20)
    assert predicted is not None
    known = np.isfinite(predicted[..., 0])
    assert known[:5].all() and known[-1].mean() < 0.3
    assert (np.diff(known.astype(int), axis=0) <= 0).all()  # never going again


@pytest.mark.parametrize("model", ["embedding", "change", "sample"])
def test_models_of_features_predict_no_states(model: str, learnt: kreps.KREPS) -> None:
    learner = kreps.KREPS(learnt.task, preset="single_step", model=model)
    learner.state = learnt.state
    assert predicted_states(learner, np.array([np.pi, 0.0]), 15) is None


def test_the_model_is_fitted_to_the_newest_rollouts_of_a_long_window() -> None:
    task = TaskSpec(1, [-1.0], [1.0])

    def transitions(lengths: list[int]) -> Any:
        made = [
            Rollout(np.full((n + 1, 1), float(i)), np.zeros((n, 1)), np.zeros(n))
            for i, n in enumerate(lengths)
        ]
        return newest_transitions(ReplayWindow(task, None).append(made))

    assert len(transitions([400] * 5)) == 1200
    assert set(transitions([400] * 5).states[:, 0]) == {2.0, 3.0, 4.0}
    assert len(transitions([500] * 3)) == 1500
    assert len(transitions([5, 1600])) == 1600  # at least one rollout
    assert len(transitions([5])) == 5


def test_few_rollouts_of_wide_observations_are_stored() -> None:
    narrow, wide, huge = (
        Rollouts.from_list(
            [Rollout(np.zeros((11, n)), np.zeros((10, 1)), np.zeros(10)) for _ in range(12)]
        )
        for n in (3, 10_000, 300_000)
    )
    assert [len(_stored(rollouts)) for rollouts in (narrow, wide, huge)] == [10, 4, 1]
