"""Pictures show what they say they show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

import kreps
from kreps import plotting
from kreps.app.environments import Labels
from kreps.app.plots.film import Gauge, PolicyPanel, Recording
from kreps.app.plots.film import film as draw_film
from kreps.app.plots.learning_curve import learning_curve
from kreps.app.plots.plane import opacity, path_of, state_grid
from kreps.app.plots.policy_maps import policy_maps
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.envs.references import REFERENCE_REWARDS
from kreps.errors import ConfigurationError
from kreps.experiments import plots as experiment_plots

REFERENCES = REFERENCE_REWARDS["kreps/SwingUp-v0"]
LABELS = Labels(["angle", "velocity"], ["torque"])
EVALUATION = {
    "stochastic": {"mean": -30.0, "standard_error": 1.5},
    "greedy": {"mean": -25.0, "standard_error": 0.5},
}


def rows(count: int) -> list[dict[str, str]]:
    return [
        {
            "iteration": str(i + 1),
            "steps": str(100 * (i + 1)),
            "average_reward": str(-90.0 + 10 * i),
            "reward_lower_quartile": str(-94.0 + 10 * i),
            "reward_upper_quartile": str(-88.0 + 10 * i),
            "kl": str(0.9 - 0.1 * i),
            "kl_bound": "1.0",
            "effective_samples": str(20.0 + i),
            "samples": "100",
            "weighted": "100",
            "rollouts": str(4 * (i + 1)),
            "mean_return": str(25 * (-90.0 + 10 * i)),
            "terminated": "0.0",
            "time_limit": "nan",
            "robot_seconds": "nan",
            "policy_kl": "nan",
        }
        for i in range(count)
    ]


@pytest.fixture(scope="module")
def learnt() -> kreps.KREPS:
    env = gym.make("kreps/SwingUp-v0")
    learner = kreps.KREPS(env, initial_rollouts=6, rollouts_per_iteration=3, window=6)
    return learner.learn(1, progress=False)


def texts(figure: Figure) -> str:
    return " | ".join(t.get_text() for axes in figure.axes for t in axes.texts).replace("\n", " ")


def maps(learner: kreps.KREPS) -> Figure:
    return policy_maps(learner.state, learner.task, LABELS)


def film(learner: kreps.KREPS, path: Path, steps: int = 5, labels: Labels = LABELS) -> Path:
    rng = np.random.default_rng(0)
    recording = Recording(
        frames=[rng.integers(0, 255, (24, 24, 3), dtype=np.uint8) for _ in range(steps)],
        observations=rng.normal(size=(steps, learner.task.observation_size)),
        actions=rng.normal(size=(steps, learner.task.action_size)),
        fps=20.0,
    )
    return draw_film(recording, learner.state, learner.task, labels, path)


# ---- learning curve ---------------------------------------------------------------------------


def test_the_curve_shows_each_batch_at_the_data_its_policy_was_learnt_from() -> None:
    figure = learning_curve(rows(3), {}, None, "title")
    top, middle, bottom = figure.axes
    np.testing.assert_array_equal(top.lines[0].get_xdata(), [0.0, 100.0, 200.0])
    np.testing.assert_array_equal(top.lines[0].get_ydata(), [-90.0, -80.0, -70.0])
    np.testing.assert_allclose(middle.lines[0].get_ydata(), [0.9, 0.8, 0.7])
    np.testing.assert_allclose(middle.lines[1].get_ydata(), [1.0, 1.0, 1.0])
    np.testing.assert_allclose(bottom.lines[0].get_ydata(), [0.20, 0.21, 0.22])
    assert figure.get_suptitle() == "title"
    spread = top.collections[0].get_paths()[0].vertices
    assert {(100.0, -84.0), (100.0, -78.0)} <= set(map(tuple, spread))


def test_the_curve_names_every_reference_value_and_the_evaluation() -> None:
    figure = learning_curve(rows(3), REFERENCES, EVALUATION, "title")
    top = figure.axes[0]
    said = texts(figure)
    levels = [float(np.asarray(line.get_ydata())[0]) for line in top.lines]
    for name, value in REFERENCES.items():
        assert name in said and f"{value:g}" in said
        assert value in levels
    at_the_end = {
        float(np.asarray(line.get_ydata())[0])
        for line in top.lines
        if list(np.asarray(line.get_xdata())) == [300.0] and line.get_marker() in "Ds"
    }
    assert at_the_end == {-30.0, -25.0}
    labels = [t.get_text() for t in top.get_legend().get_texts()]
    assert any("-25" in label and "greedy" in label for label in labels)


def test_the_curve_has_the_robot_time_below_the_steps_where_it_is_recorded() -> None:
    unknown = learning_curve(rows(3), {}, None, "title")
    assert [axes.child_axes for axes in unknown.axes] == [[], [], []]
    known = [row | {"robot_seconds": str(0.05 * int(row["steps"]))} for row in rows(3)]
    figure = learning_curve(known, {}, None, "title")
    (below,) = figure.axes[-1].child_axes
    assert below.get_xlabel() == "robot time [s]"
    FigureCanvasAgg(figure).draw()
    steps, seconds = figure.axes[-1].get_xlim(), below.get_xlim()
    np.testing.assert_allclose(seconds, 0.05 * np.asarray(steps))
    assert figure.bbox.y0 < below.xaxis.label.get_window_extent().y0
    first = figure.axes[-1].xaxis.label.get_window_extent()
    assert below.xaxis.get_tightbbox().y1 < first.y0  # type: ignore[union-attr]


def drawn(figure: Figure, artist: Any) -> Any:
    """The box of an artist in pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return artist.get_window_extent(canvas.get_renderer())


def test_the_two_evaluations_stand_beside_each_other_with_error_bars() -> None:
    same = {name: {"mean": -25.0, "standard_error": 1.5} for name in EVALUATION}
    figure = learning_curve(rows(3), {}, same, "title")
    top = figure.axes[0]
    bars = {str(bar.get_label()).split()[0]: bar for bar in top.containers}
    assert set(bars) == {"stochastic", "greedy"}
    markers = [bar.lines[0] for bar in bars.values()]
    assert not drawn(figure, markers[0]).overlaps(drawn(figure, markers[1]))
    assert markers[0].get_marker() != markers[1].get_marker()
    assert markers[0].get_color() != markers[1].get_color()
    for bar in bars.values():
        (segment,) = bar.lines[2][0].get_segments()
        np.testing.assert_allclose(sorted(segment[:, 1]), [-28.0, -22.0])  # two standard errors
    labels = [t.get_text() for t in top.get_legend().get_texts()]
    assert any("-25 ± 3 (2 s.e.)" in label for label in labels)


@pytest.mark.parametrize("references", [{}, REFERENCES])
@pytest.mark.parametrize("count", [4, 12])
@pytest.mark.parametrize("bad", [0, 2])
def test_one_bad_batch_does_not_flatten_the_curve(
    count: int, bad: int, references: dict[str, float]
) -> None:
    content = rows(count)
    names = ("average_reward", "reward_lower_quartile", "reward_upper_quartile")
    content[bad] |= dict.fromkeys(names, "-123456")
    figure = learning_curve(content, references, EVALUATION, "title")
    top = figure.axes[0]
    low, high = top.get_ylim()
    assert low > -140.0 and high < 60.0
    others = [float(row["average_reward"]) for i, row in enumerate(content) if i != bad]
    assert low < min(others) and max(others) < high
    assert "-1.235e+05" in [t.get_text() for t in top.texts]  # its value is at the edge
    (arrow,) = [line for line in top.lines if line.get_marker() == "v"]
    assert list(np.asarray(arrow.get_xdata())) == [100.0 * bad]


def test_a_curve_without_outliers_is_shown_whole() -> None:
    figure = learning_curve(rows(12), {}, None, "title")
    low, high = figure.axes[0].get_ylim()
    assert low < -94.0 and high > 22.0
    assert list(figure.axes[0].texts) == []


def test_runs_of_earlier_versions_have_a_curve_without_spread() -> None:
    unknown = {"reward_lower_quartile": "nan", "reward_upper_quartile": "nan"}
    figure = learning_curve([row | unknown for row in rows(3)], {}, None, "title")
    assert len(figure.axes[0].collections) == 0
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), [-90.0, -80.0, -70.0])


@pytest.mark.parametrize("count", [1, 2])
def test_short_runs_have_a_curve_too(count: int, tmp_path: Path) -> None:
    figure = learning_curve(rows(count), REFERENCES, EVALUATION, "short")
    path = plotting.save(figure, tmp_path / "curve.png")
    with Image.open(path) as picture:
        picture.load()
        assert min(picture.size) > 400


def test_the_names_of_reference_lines_do_not_overlap() -> None:
    figure = learning_curve(rows(3), REFERENCES, EVALUATION, "title")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [t.get_window_extent(canvas.get_renderer()) for t in figure.axes[0].texts]
    assert len(boxes) == len(REFERENCES)
    for i, box in enumerate(boxes):
        for other in boxes[i + 1 :]:
            assert not box.overlaps(other)
        assert figure.bbox.fully_containsx(box.x0) and figure.bbox.fully_containsx(box.x1)


def test_drawing_leaves_the_settings_of_others_alone(learnt: kreps.KREPS, tmp_path: Path) -> None:
    from matplotlib import rcParams

    before = dict(rcParams)
    plotting.save(learning_curve(rows(2), {}, None, ""), tmp_path / "a.png")
    plotting.save(maps(learnt), tmp_path / "b.png")
    film(learnt, tmp_path / "c.gif", 2)
    assert dict(rcParams) == before


# ---- maps -------------------------------------------------------------------------------------


def test_the_maps_show_policy_and_value_over_the_plane(learnt: kreps.KREPS, tmp_path: Path) -> None:
    figure = maps(learnt)
    panels = [axes for axes in figure.axes if axes.images]
    titles = [axes.get_title(loc="left") + axes.get_title() for axes in panels]
    assert [t.split()[-1] for t in titles] == ["mean", "deviation", "V"]
    policy, value = learnt.policy.process, learnt.value_function
    shown: list[Callable[[Any], Any]] = [
        lambda s: np.clip(policy.greedy(s)[:, 0], -30.0, 30.0),
        lambda s: policy.standard_deviation(s)[:, 0],
        value,
    ]
    for axes, function in zip(panels, shown, strict=True):
        picture = axes.images[0]
        values = np.asarray(picture.get_array())
        left, right, bottom, top = picture.get_extent()
        assert right - left == pytest.approx(2 * np.pi)  # a whole turn of the angle
        n, m = values.shape
        for i, j in ((0, 0), (n // 2, m // 3), (n - 1, m - 1)):
            x, y = np.linspace(left, right, m)[j], np.linspace(bottom, top, n)[i]
            assert values[i, j] == pytest.approx(function(np.array([[x, y]]))[0], abs=1e-6)
        assert picture.origin == "lower"
        latest = learnt.state.window.rollouts[-1].observations[0]
        assert any(
            np.asarray(line.get_xydata())[0].tolist() == latest.tolist() for line in axes.lines
        )
    assert plotting.save(figure, tmp_path / "maps.png").stat().st_size > 10_000


def marked(axes: Any, label: str) -> Any:
    """The points (m, 2) of the line with a label."""
    (line,) = [line for line in axes.lines if line.get_label() == label]
    return np.asarray(line.get_xydata())


def test_the_maps_mark_starts_and_the_highest_reward(learnt: kreps.KREPS) -> None:
    window = learnt.state.window
    best = int(np.argmax(window.rollouts.rewards))
    figure = maps(learnt)
    for axes in figure.axes[:3]:
        np.testing.assert_array_equal(marked(axes, "start"), [[np.pi, 0.0]] * len(window.rollouts))
        goal = window.transitions.points[window.transitions.successor[best]]
        np.testing.assert_array_equal(marked(axes, "highest reward observed"), [goal])
    names = [t.get_text() for t in figure.legends[0].get_texts()]
    assert names == ["latest rollouts", "start", "highest reward observed", "faded: no data"]


def test_no_goal_is_marked_while_no_reward_depends_on_the_state() -> None:
    rng = np.random.default_rng(0)
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]))
    actions = rng.normal(size=(29, 1))
    learner.update(
        [Rollout(rng.normal(size=(30, 2)), actions, -(np.clip(actions[:, 0], -1, 1) ** 2))]
    )
    labels = {str(line.get_label()) for axes in maps(learner).axes[:3] for line in axes.lines}
    assert "start" in labels and "highest reward observed" not in labels


def test_the_maps_fade_where_there_are_no_data() -> None:
    rng = np.random.default_rng(0)
    task = TaskSpec(2, [-1.0], [1.0], (0,))
    observations = np.stack([rng.uniform(-3.1, -2.0, 60), np.linspace(-1.0, 1.0, 60)], axis=1)
    learner = kreps.KREPS(task)
    learner.update([Rollout(observations, rng.normal(size=(59, 1)), rng.normal(size=59))])
    x, y, states = state_grid(learner.state, task)
    visible = opacity(x, y, states, learner.state, task).ravel()
    assert visible.max() == 1.0 and visible.min() == pytest.approx(0.15)
    length = np.array([2.0 * np.pi, y[-1] - y[0]])
    offsets = np.abs(states[:, None] - observations)
    offsets[..., 0] = np.minimum(offsets[..., 0], 2.0 * np.pi - offsets[..., 0])
    distance = np.sqrt(np.sum((offsets / length) ** 2, axis=2)).min(axis=1)
    assert (visible[distance < 0.039] == 1.0).all()
    np.testing.assert_allclose(visible[distance > 0.121], 0.15)
    figure = maps(learner)
    for axes in figure.axes[:3]:
        np.testing.assert_allclose(np.ravel(axes.images[0].get_alpha()), visible)


def test_the_colours_of_v_are_those_of_the_data(learnt: kreps.KREPS) -> None:
    axes = maps(learnt).axes[2]
    low, high = axes.images[0].get_clim()
    values = learnt.value_function(learnt.state.window.transitions.points)
    assert low <= values.min() + 1e-6 * abs(low) + 0.05 * np.ptp(values)
    assert high >= values.max() - 0.05 * np.ptp(values)
    shown = np.asarray(axes.images[0].get_array())[np.asarray(axes.images[0].get_alpha()) == 1.0]
    assert (low, high) == (shown.min(), shown.max())


@pytest.mark.parametrize("make", ["curve", "maps"])
def test_text_is_readable_at_the_width_of_a_page(make: str, learnt: kreps.KREPS) -> None:
    figure = maps(learnt) if make == "maps" else learning_curve(rows(3), REFERENCES, EVALUATION, "")
    pixels_per_inch = 830.0 / figure.get_size_inches()[0]  # the README is 830 pixels wide
    sizes = [t.get_fontsize() for t in figure.findobj(Text) if t.get_text() and t.get_visible()]
    assert min(sizes) / 72.0 * pixels_per_inch > 9.5


def test_the_maps_draw_the_latest_rollouts_without_lines_across_the_cut() -> None:
    task = TaskSpec(2, [-1.0], [1.0], (0,))
    observations = np.array([[4.4, 1.0], [4.6, 1.0], [-1.5, 1.0], [-1.3, 1.0]])
    x, y = path_of(observations, task)
    assert len(x) == 5 and np.isnan(x[2]) and np.isnan(y[2])
    np.testing.assert_array_equal(x[[0, 1, 3, 4]], observations[:, 0])
    plain = path_of(observations, TaskSpec(2, [-1.0], [1.0]))
    np.testing.assert_array_equal(plain, observations.T)  # a jump of a length is a jump


def test_the_maps_need_a_plane() -> None:
    rng = np.random.default_rng(0)
    learner = kreps.KREPS(TaskSpec(3, [-1.0], [1.0]))
    learner.update([Rollout(rng.normal(size=(6, 3)), rng.normal(size=(5, 1)), rng.normal(size=5))])
    with pytest.raises(ConfigurationError, match=r"two-dimensional.*3"):
        maps(learner)


@pytest.mark.filterwarnings("ignore:Attempting to set identical")
def test_maps_of_a_coordinate_that_never_changed_can_be_drawn(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]))
    observations = np.stack([rng.normal(size=30), np.full(30, 2.0)], axis=1)
    learner.update([Rollout(observations, rng.normal(size=(29, 1)), rng.normal(size=29))])
    plotting.save(maps(learner), tmp_path / "maps.png")


# ---- film -------------------------------------------------------------------------------------


def test_a_film_has_a_picture_per_step_at_the_speed_of_the_task(
    learnt: kreps.KREPS, tmp_path: Path
) -> None:
    path = film(learnt, tmp_path / "a.gif", 5)
    with Image.open(path) as pictures:
        assert pictures.n_frames == 5
        assert pictures.info["duration"] == 50
        assert pictures.info["loop"] == 0
        first = np.asarray(pictures.convert("RGB")).astype(int)
        pictures.seek(4)
        last = np.asarray(pictures.convert("RGB")).astype(int)
    assert (np.abs(first - last).sum(axis=2) > 30).mean() > 0.02  # something moved


def test_a_film_shows_each_action_as_an_arrow_between_its_limits() -> None:
    task = TaskSpec(2, [-30.0, 1.0], [30.0, 3.0])
    figure = Figure()
    labels = Labels(["a", "b"], ["torque [N m]", "speed"])
    torque, speed = (Gauge.draw(figure, (0.1, 0.1, 0.8), task, labels, i) for i in range(2))
    for action, start, end, text in ((15.0, 0.0, 15.0, "15"), (-44.0, 0.0, -30.0, "-30")):
        torque.show(action)
        assert torque.arrow._posA_posB == [(start, 0.0), (end, 0.0)]
        assert torque.arrow.get_visible() and torque.text.get_text() == text
    torque.show(0.01)
    assert not torque.arrow.get_visible()
    speed.show(2.0)  # zero is no action here
    assert speed.arrow._posA_posB == [(1.0, 0.0), (2.0, 0.0)]
    assert [t.get_text() for t in figure.texts if not t.get_animated()] == labels.actions


def test_a_film_has_a_colour_bar_with_start_goal_and_the_path_above_them(
    learnt: kreps.KREPS,
) -> None:
    figure, rng = Figure(), np.random.default_rng(0)
    recording = Recording([], rng.normal(size=(5, 2)), rng.normal(size=(5, 1)), 20.0)
    panel = PolicyPanel.draw(figure, recording, learnt.state, learnt.task, LABELS)
    axes, bar = figure.axes
    assert list(bar.get_yticks()) == [-30.0, 0.0, 30.0]
    np.testing.assert_array_equal(marked(axes, "start"), recording.observations[:1])
    assert len(marked(axes, "highest reward observed")) == 1
    panel.show(recording.observations[:3], learnt.task)
    np.testing.assert_array_equal(panel.dot.get_xydata(), recording.observations[2:3])
    assert panel.parts[0] is panel.trail and panel.parts[-1] is panel.dot


def test_a_film_is_as_wide_as_a_page_and_keeps_rare_colours(
    learnt: kreps.KREPS, tmp_path: Path
) -> None:
    frame = np.full((60, 60, 3), 255, dtype=np.uint8)
    frame[28:32, 28:32] = (250, 120, 20)  # a target of few pixels
    recording = Recording([frame] * 2, np.zeros((2, 2)), np.full((2, 1), 20.0), 20.0)
    path = draw_film(recording, learnt.state, learnt.task, LABELS, tmp_path / "a.gif")
    with Image.open(path) as pictures:
        assert pictures.size == (800, 400)
        colours = np.asarray(pictures.convert("RGB")).astype(int)
    assert (np.abs(colours[:, :400] - (250, 120, 20)).max(axis=2) < 12).sum() > 100
    assert (np.abs(colours[:, :400] - (209, 96, 61)).max(axis=2) < 12).sum() > 100  # the arrow


def test_a_film_of_other_states_shows_the_camera_only(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    learner = kreps.KREPS(TaskSpec(3, [-1.0], [1.0]))
    learner.update([Rollout(rng.normal(size=(6, 3)), rng.normal(size=(5, 1)), rng.normal(size=5))])
    path = film(learner, tmp_path / "a.gif", 2, labels=Labels(["a", "b", "c"], ["d"]))
    with Image.open(path) as pictures:
        assert pictures.n_frames == 2


def test_a_film_needs_a_name_that_ends_in_gif(learnt: kreps.KREPS, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"\.gif"):
        film(learnt, tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


# ---- every seed of a comparison ---------------------------------------------------------------


def test_a_comparison_shows_every_seed_and_their_mean(tmp_path: Path) -> None:
    data = [
        {
            "method": method,
            "seed": seed,
            "iteration": iteration,
            "steps": 100 * iteration,
            "stochastic": -50.0 + 10 * iteration + seed,
            "greedy": -45.0 + 10 * iteration + seed,
        }
        for method in ("default", "paper")
        for seed in (0, 1, 2)
        for iteration in (1, 2)
    ]
    figure = experiment_plots.comparison(
        data, {"default": REFERENCES, "paper": REFERENCES}, "title", "source"
    )
    assert len(figure.axes) == 4
    stochastic = figure.axes[0]
    curves = [line for line in stochastic.lines if len(np.asarray(line.get_xdata())) == 2]
    drawn = {tuple(np.asarray(line.get_ydata(), dtype=float)) for line in curves}
    assert {(-40.0 + s, -30.0 + s) for s in (0, 1, 2)} <= drawn
    assert (-39.0, -29.0) in drawn  # the mean, which is seed 1 here
    for name in ("default", "paper"):
        assert any(name in a.get_title(loc="left") + a.get_title() for a in figure.axes)
    plotting.save(figure, tmp_path / "comparison.png")
    one = [row for row in data if row["seed"] == 0]
    plotting.save(
        experiment_plots.comparison(
            one, {"default": {}, "paper": {"x": -60.0, "y": -80.0}}, "one seed", ""
        ),
        tmp_path / "one.png",
    )


def test_learning_curves_show_means_and_level_lines(tmp_path: Path) -> None:
    data = [
        {
            "method": "A",
            "seed": seed,
            "iteration": iteration,
            "steps": 100 * iteration + seed,
            "training_reward": -60.0 + seed,
            "stochastic": -50.0 + 10 * iteration + seed,
            "greedy": -45.0 + 10 * iteration,
        }
        for seed in (0, 2)
        for iteration in (1, 2)
    ]
    data += [{**row, "method": "once"} for row in data if row["iteration"] == 1]
    curves = {name: [row for row in data if row["method"] == name] for name in ("A", "once")}
    column = experiment_plots.Column("left", "a task", curves, REFERENCES)
    right = replace(column, title="right", period=0.05)
    other = replace(column, title="other", task="another task", references={})
    figure = experiment_plots.learning_curves([column, right, other], "title", "source")
    upper, lower = figure.axes[:3], figure.axes[3:6]
    of = {line.get_label(): line for line in upper[0].lines}
    np.testing.assert_allclose(np.asarray(of["A"].get_xdata(), dtype=float), [101.0, 201.0])
    np.testing.assert_allclose(np.asarray(of["A"].get_ydata(), dtype=float), [-39.0, -29.0])
    level = np.asarray(of["once, one iteration"].get_ydata(), dtype=float)
    np.testing.assert_allclose(level, -39.0)
    greedy = {line.get_label(): line for line in lower[0].lines}
    np.testing.assert_allclose(np.asarray(greedy["A"].get_ydata(), dtype=float), [-35.0, -25.0])
    assert lower[0].get_xlabel() == "environment steps"
    assert [len(axes.child_axes) for axes in lower] == [0, 1, 0]  # robot time
    # columns of the same task have the same axes
    assert upper[0].get_ylim() == upper[1].get_ylim() == lower[0].get_ylim() != upper[2].get_ylim()
    assert [axes.get_title(loc="left") for axes in upper] == [
        f"{title}\nwith exploration" for title in ("left", "right", "other")
    ]
    legends = [axes.get_legend() for axes in figure.axes[6:9]]
    assert all(len(legend.get_texts()) == 2 for legend in legends)
    plotting.save(figure, tmp_path / "curves.png")
