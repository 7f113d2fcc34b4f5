"""Task specifications, rollouts, their flat container and transitions, and the replay window."""

from __future__ import annotations

import pickle
import time
from typing import Any

import numpy as np
import pytest

from kreps.data.rollouts import Rollout, Rollouts, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray


def rollout(
    steps: int, seed: int = 0, *, ds: int = 3, da: int = 2, terminated: bool = False
) -> Rollout:
    rng = np.random.default_rng(seed)
    return Rollout(
        rng.normal(size=(steps + 1, ds)),
        rng.normal(size=(steps, da)),
        rng.normal(size=steps),
        terminated,
    )


def task(**changes: Any) -> TaskSpec:
    arguments: dict[str, Any] = {
        "observation_size": 3,
        "action_low": [-1.0, 0.0],
        "action_high": [1.0, 6.0],
    }
    return TaskSpec(**(arguments | changes))


def test_centre_scale_and_limits_of_actions() -> None:
    spec = task(periodic=(2, 0))
    assert spec.action_size == 2
    np.testing.assert_array_equal(spec.action_centre, [0.0, 3.0])
    np.testing.assert_array_equal(spec.action_scale, [1.0, 3.0])
    np.testing.assert_array_equal(
        spec.clip(np.array([[-2.0, 9.0], [0.5, 1.0]])), [[-1, 6], [0.5, 1]]
    )
    np.testing.assert_array_equal(
        spec.scaled_applied(np.array([[-2.0, 9.0], [0.5, 1.5]])), [[-1.0, 1.0], [0.5, -0.5]]
    )
    np.testing.assert_array_equal(spec.unscaled(np.array([[0.5, -0.5]])), [[0.5, 1.5]])
    assert spec.periodic == (0, 2)


def test_scalar_limits_make_one_action() -> None:
    spec = TaskSpec(1, np.float64(-2.0), np.float64(4.0))  # type: ignore[arg-type]
    assert spec.action_size == 1
    np.testing.assert_array_equal(spec.action_scale, [3.0])


@pytest.mark.parametrize(
    "changes",
    [
        {"observation_size": 0},
        {"action_low": [-1.0]},
        {"action_low": [], "action_high": []},
        {"action_low": [[-1.0, 0.0]], "action_high": [[1.0, 6.0]]},
        {"action_low": [-1.0, 6.0]},
        {"action_low": [-1.0, 7.0]},
        {"action_low": [-np.inf, 0.0]},
        {"action_high": [np.inf, 6.0]},
        {"action_high": [np.nan, 6.0]},
        {"periodic": (3,)},
        {"periodic": (-1,)},
    ],
    ids=str,
)
def test_an_invalid_task_raises(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        task(**changes)


@pytest.mark.parametrize("name", ["observations", "actions", "rewards"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_raises_and_its_row_is_named(name: str, bad: float) -> None:
    good = rollout(5)
    arrays: dict[str, Any] = {
        key: np.array(getattr(good, key)) for key in ("observations", "actions", "rewards")
    }
    arrays[name][3] = bad
    with pytest.raises(DataError, match=rf"{name}.*row 3"):
        Rollout(**arrays)


@pytest.mark.parametrize(
    ("observations", "actions", "rewards"),
    [
        ((6,), (5, 2), (5,)),
        ((6, 3), (4,), (5,)),
        ((6, 3), (), (5,)),
        ((6, 3), (5, 2), (5, 1)),
        ((6, 3), (5, 2), ()),
        ((5, 3), (5, 2), (5,)),
        ((7, 3), (5, 2), (5,)),
        ((6, 3), (6, 2), (5,)),
        ((6, 3), (5, 2), (6,)),
        ((1, 3), (0, 2), (0,)),
        ((0, 3), (0, 2), (0,)),
    ],
)
def test_shapes_that_do_not_fit_together_raise(
    observations: tuple[int, ...], actions: tuple[int, ...], rewards: tuple[int, ...]
) -> None:
    with pytest.raises(DataError):
        Rollout(np.zeros(observations), np.zeros(actions), np.zeros(rewards))


@pytest.mark.parametrize("bad", ["no numbers", [[1.0, 2.0], [3.0]], None])
def test_something_that_is_no_array_of_numbers_raises(bad: Any) -> None:
    with pytest.raises(DataError):
        Rollout(bad, np.zeros((1, 1)), np.zeros(1))


def test_a_rollout_is_a_copy_of_the_callers_arrays_and_read_only() -> None:
    observations, actions, rewards = np.ones((4, 2)), np.ones((3, 1)), np.ones(3)
    kept = Rollout(observations, actions, rewards)
    for buffer in (observations, actions, rewards):
        buffer[:] = -7.0
    for values in (kept.observations, kept.actions, kept.rewards):
        np.testing.assert_array_equal(values, 1.0)
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0.0


def test_rows_collected_as_views_of_one_buffer_keep_their_own_values() -> None:
    # a simulator that reuses one array returns the same view at every step
    state = np.zeros(2)
    copies = []
    for t in range(4):
        state[:] = t
        copies.append(Rollout(np.stack([state, state + 1.0]), np.zeros((1, 1)), np.zeros(1)))
    data = Transitions.from_rollouts(copies)
    np.testing.assert_array_equal(data.states[:, 0], [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(data.points[data.successor][:, 0], [1.0, 2.0, 3.0, 4.0])


def test_lists_and_whole_numbers_become_arrays_of_floats() -> None:
    kept = Rollout([[0], [1]], [[2]], [3], np.bool_(True))  # type: ignore[arg-type]
    assert kept.observations.dtype == kept.actions.dtype == kept.rewards.dtype == np.float64
    assert kept.terminated is True
    assert len(kept) == 1


# ---- the flat container -----------------------------------------------------------------------

LENGTHS = [3, 1, 5, 2]


def several() -> list[Rollout]:
    return [rollout(n, seed=i, terminated=i in (1, 3)) for i, n in enumerate(LENGTHS)]


def assert_same_rollout(found: Rollout, wanted: Rollout) -> None:
    np.testing.assert_array_equal(found.observations, wanted.observations)
    np.testing.assert_array_equal(found.actions, wanted.actions)
    np.testing.assert_array_equal(found.rewards, wanted.rewards)
    assert found.terminated is wanted.terminated


def test_rollouts_are_laid_end_to_end() -> None:
    flat = Rollouts.from_list(several())
    assert (len(flat), flat.steps) == (4, 11)
    np.testing.assert_array_equal(flat.offsets, [0, 3, 4, 9, 11])
    np.testing.assert_array_equal(flat.lengths, LENGTHS)
    np.testing.assert_array_equal(flat.terminated, [False, True, False, True])
    np.testing.assert_array_equal(flat.points, np.concatenate([r.observations for r in several()]))
    np.testing.assert_array_equal(flat.actions, np.concatenate([r.actions for r in several()]))
    np.testing.assert_array_equal(flat.rewards, np.concatenate([r.rewards for r in several()]))
    assert repr(flat) == "<Rollouts: 4 of 11 steps in all>"


def test_items_are_views_of_the_flat_arrays() -> None:
    flat = Rollouts.from_list(several())
    for found, wanted in zip(flat, several(), strict=True):
        assert isinstance(found, Rollout)
        assert_same_rollout(found, wanted)
        assert np.shares_memory(found.observations, flat.points)
        assert np.shares_memory(found.actions, flat.actions)
        assert np.shares_memory(found.rewards, flat.rewards)
        with pytest.raises(ValueError, match="read-only"):
            found.observations[0] = 0.0
    assert_same_rollout(flat[-1], several()[3])
    assert_same_rollout(flat[np.int64(2)], several()[2])  # type: ignore[call-overload]
    for outside in (4, -5):
        with pytest.raises(IndexError):
            _ = flat[outside]


@pytest.mark.parametrize(
    "part",
    [slice(0, 2), slice(1, 3), slice(-2, None), slice(None), slice(2, 2), slice(3, 1), slice(9)],
    ids=str,
)
def test_a_slice_is_a_container_of_views(part: slice) -> None:
    flat = Rollouts.from_list(several())
    found = flat[part]
    assert isinstance(found, Rollouts)
    assert len(found) == len(several()[part])
    assert found.steps == sum(LENGTHS[part])
    for mine, theirs in zip(found, several()[part], strict=True):
        assert_same_rollout(mine, theirs)
        assert np.shares_memory(mine.actions, flat.actions)
    for mine, theirs in zip(found[1:], several()[part][1:], strict=True):
        assert_same_rollout(mine, theirs)  # a slice of a slice


def test_a_slice_may_have_a_step() -> None:
    found = Rollouts.from_list(several())[::-2]
    for mine, theirs in zip(found, several()[::-2], strict=True):
        assert_same_rollout(mine, theirs)


def test_quartiles_of_the_reward_count_each_rollout_by_its_steps() -> None:
    rewards = [[-9.0], [-4.0, -2.0, -3.0], [-1.0, 1.0, 0.0, 0.0]]
    rollouts = [Rollout(np.zeros((len(r) + 1, 2)), np.zeros((len(r), 1)), r) for r in rewards]
    # means -9, -3 and 0, of which there are one, three and four
    assert Rollouts.from_list(rollouts).reward_quartiles() == (-3.0, 0.0)
    assert Rollouts.from_list(rollouts[:1]).reward_quartiles() == (-9.0, -9.0)


def test_a_container_is_not_copied() -> None:
    flat = Rollouts.from_list(several())
    assert Rollouts.from_list(flat) is flat
    assert flat.load() is flat
    assert flat.transitions is flat.transitions
    assert flat.transitions.points is flat.points


def test_a_container_comes_back_from_another_process_without_what_is_derived() -> None:
    flat = Rollouts.from_list(several())
    size = len(pickle.dumps(flat))
    _ = flat.transitions
    content = pickle.dumps(flat)
    assert len(content) == size
    for mine, theirs in zip(pickle.loads(content), several(), strict=True):
        assert_same_rollout(mine, theirs)


def test_a_container_of_nothing_is_empty() -> None:
    empty = Rollouts.from_list([])
    assert (len(empty), empty.steps, list(empty)) == (0, 0, [])
    empty.check(task())
    assert len(empty.transitions) == 0


def test_items_of_a_container_must_be_rollouts_of_one_task() -> None:
    with pytest.raises(DataError, match=r"item 1 is a str, not a kreps\.Rollout"):
        Rollouts.from_list([rollout(3), "rollout"])  # type: ignore[list-item]
    with pytest.raises(DataError, match=r"write \[rollout\]"):
        Rollouts.from_list(rollout(3))  # type: ignore[arg-type]
    for stranger in (rollout(3, ds=2), rollout(3, da=1)):
        with pytest.raises(DataError, match="rollout 2 has"):
            Rollouts.from_list([rollout(3), rollout(2), stranger])


def test_arrays_are_checked_and_copied() -> None:
    flat = Rollouts.from_list(several())
    points, actions = flat.points.astype(np.float32), np.round(flat.actions).astype(np.int8)
    rewards = flat.rewards.copy()
    found = Rollouts.from_arrays(points, actions, rewards, LENGTHS, [False, True, False, True])
    assert found.points.dtype == found.actions.dtype == found.rewards.dtype == np.float64
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_array_equal(found.actions, actions)
    np.testing.assert_array_equal(found.offsets, flat.offsets)
    np.testing.assert_array_equal(found.terminated, flat.terminated)
    rewards[:] = 0.0
    np.testing.assert_array_equal(found.rewards, flat.rewards)
    assert not Rollouts.from_arrays(points, actions, rewards, LENGTHS).terminated.any()


@pytest.mark.parametrize(
    ("name", "row", "where"),
    [
        ("points", 0, "row 0 of rollout 0"),
        ("points", 3, "row 3 of rollout 0"),
        ("points", 4, "row 0 of rollout 1"),
        ("points", 7, "row 1 of rollout 2"),
        ("points", 14, "row 2 of rollout 3"),
        ("actions", 3, "row 0 of rollout 1"),
        ("rewards", 8, "row 4 of rollout 2"),
        ("rewards", 10, "row 1 of rollout 3"),
    ],
)
def test_a_number_that_is_no_data_is_named_by_rollout_and_row(
    name: str, row: int, where: str
) -> None:
    flat = Rollouts.from_list(several())
    arrays = {key: getattr(flat, key).copy() for key in ("points", "actions", "rewards")}
    arrays[name][row:] = 1e101
    label = "observations" if name == "points" else name
    unread = Rollouts.from_arrays(*arrays.values(), LENGTHS, read=False)
    with pytest.raises(DataError, match=rf"{label} hold .* beyond 1e\+100, first in {where};"):
        unread.read()
    with pytest.raises(DataError, match=where):
        Rollouts.from_arrays(*arrays.values(), LENGTHS)


@pytest.mark.parametrize(("ds", "da"), [(2, 2), (4, 2), (3, 1), (3, 3)])
def test_rollouts_of_other_widths_than_the_task_raise(ds: int, da: int) -> None:
    with pytest.raises(DataError, match=f"{ds} observation and {da} action coordinates"):
        Rollouts.from_list([rollout(4, ds=ds, da=da)]).check(task())
    Rollouts.from_list([rollout(4)]).check(task())


# ---- transitions ------------------------------------------------------------------------------


def successor_pairs(rollouts: list[Rollout]) -> tuple[FloatArray, FloatArray]:
    """States and successors, taken from the rollouts one by one."""
    return (
        np.concatenate([r.observations[:-1] for r in rollouts]),
        np.concatenate([r.observations[1:] for r in rollouts]),
    )


@pytest.mark.parametrize("lengths", [[1], [1, 1, 1], [4], [3, 1, 5], [1, 6]])
def test_each_transition_has_its_state_and_successor(lengths: list[int]) -> None:
    rollouts = [rollout(steps, seed) for seed, steps in enumerate(lengths)]
    data = Transitions.from_rollouts(rollouts)
    states, successors = successor_pairs(rollouts)
    assert len(data) == sum(lengths)
    assert data.points.shape == (sum(lengths) + len(lengths), 3)
    np.testing.assert_array_equal(data.states, states)
    np.testing.assert_array_equal(data.points[data.successor], successors)
    np.testing.assert_array_equal(
        data.points[data.start], np.stack([r.observations[0] for r in rollouts])
    )
    np.testing.assert_array_equal(data.rollout, np.repeat(np.arange(len(lengths)), lengths))
    np.testing.assert_array_equal(data.actions, np.concatenate([r.actions for r in rollouts]))
    np.testing.assert_array_equal(data.rewards, np.concatenate([r.rewards for r in rollouts]))


def test_within_a_rollout_the_successor_is_the_next_state() -> None:
    data = Transitions.from_rollouts([rollout(5, 0), rollout(4, 1)])
    following = np.flatnonzero(data.successor[:-1] == data.state[1:])
    np.testing.assert_array_equal(following, [0, 1, 2, 3, 5, 6, 7])  # not across the border


def test_only_the_last_step_of_a_terminated_rollout_is_an_end() -> None:
    data = Transitions.from_rollouts(
        [rollout(3, 0, terminated=True), rollout(2, 1), rollout(1, 2, terminated=True)]
    )
    np.testing.assert_array_equal(data.terminated, [False, False, True, False, False, True])


# ---- the replay window ------------------------------------------------------------------------


def test_the_window_forgets_the_oldest_rollouts() -> None:
    rollouts = [rollout(1 + i, i) for i in range(7)]
    empty = ReplayWindow(task(), 4)
    first = empty.append(rollouts[:3])
    second = first.append(rollouts[3:5])
    third = second.append(rollouts[5:])
    assert len(empty.rollouts) == 0
    assert [len(r) for r in first.rollouts] == [1, 2, 3]
    assert [len(r) for r in second.rollouts] == [2, 3, 4, 5]
    assert [len(r) for r in third.rollouts] == [4, 5, 6, 7]
    assert third.capacity == 4
    assert [window.steps for window in (empty, first, second, third)] == [0, 6, 14, 22]
    np.testing.assert_array_equal(
        third.transitions.states, Transitions.from_rollouts(rollouts[3:]).states
    )


def test_a_window_with_too_few_steps_keeps_more_rollouts() -> None:
    # two rollouts of 2 steps are fewer than the 5 steps wanted, and three are more
    rollouts = [rollout(2, seed) for seed in range(6)]
    window = ReplayWindow(task(), 2, 5)
    for given in rollouts:
        window = window.append([given])
    assert [len(r) for r in window.rollouts] == [2, 2, 2]
    np.testing.assert_array_equal(window.rollouts.points[-3:], rollouts[-1].observations)
    # with longer ones the number of rollouts is the limit again
    window = window.append([rollout(9, seed) for seed in range(2)])
    assert [len(r) for r in window.rollouts] == [9, 9]
    assert len(ReplayWindow(task(), 2).append(rollouts).rollouts) == 2
    assert len(ReplayWindow(task(), None, 5).append(rollouts).rollouts) == 6


def test_of_more_rollouts_than_the_window_holds_the_newest_are_kept() -> None:
    rollouts = [rollout(1 + i, i) for i in range(5)]
    assert [len(r) for r in ReplayWindow(task(), 2).append(iter(rollouts)).rollouts] == [4, 5]


def test_many_groups_of_angles_are_checked_quickly() -> None:
    many = 20_000
    pairs = [[i, i + 1] for i in range(0, many, 2)]
    started = time.process_time()
    with pytest.raises(ConfigurationError, match="lengthscales"):  # which is checked last
        TaskSpec(many, np.zeros(1), np.ones(1), range(many), pairs)
    assert (
        time.process_time() - started < 2.0
    )  # comparing all pairs of groups takes tens of seconds


def test_more_lengthscales_than_can_be_fitted_are_refused_with_the_remedy() -> None:
    with pytest.raises(ConfigurationError, match=r"3001 lengthscales.*observation_groups"):
        TaskSpec(3001, np.zeros(1), np.ones(1))
    for spec in (
        TaskSpec(3000, np.zeros(1), np.ones(1)),
        TaskSpec(30_000, np.zeros(1), np.ones(1), groups=[range(27_001)]),
    ):
        assert spec.factor_count == 3000


@pytest.mark.parametrize("limit", [1e101, 1.7e308, np.inf])
def test_absurdly_large_action_limits_raise(limit: float) -> None:
    with pytest.raises(ConfigurationError, match="finite"):
        TaskSpec(2, np.array([-limit]), np.array([limit]))
