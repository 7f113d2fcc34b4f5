"""Roll-outs, the window kept of them, and their transitions."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from kreps.data.rollouts import Rollout, Transitions
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


def test_a_task_knows_centre_scale_and_limits_of_its_actions() -> None:
    spec = task(periodic=(2, 0))
    assert spec.action_size == 2
    np.testing.assert_array_equal(spec.action_centre, [0.0, 3.0])
    np.testing.assert_array_equal(spec.action_scale, [1.0, 3.0])
    np.testing.assert_array_equal(
        spec.clip(np.array([[-2.0, 9.0], [0.5, 1.0]])), [[-1, 6], [0.5, 1]]
    )
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
def test_an_impossible_task_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        task(**changes)


@pytest.mark.parametrize("name", ["observations", "actions", "rewards"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_refused_and_its_row_named(name: str, bad: float) -> None:
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
        ((6, 3), (5,), (5,)),
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
def test_shapes_that_do_not_fit_together_are_refused(
    observations: tuple[int, ...], actions: tuple[int, ...], rewards: tuple[int, ...]
) -> None:
    with pytest.raises(DataError):
        Rollout(np.zeros(observations), np.zeros(actions), np.zeros(rewards))


@pytest.mark.parametrize("bad", ["no numbers", [[1.0, 2.0], [3.0]], None])
def test_what_is_no_array_of_numbers_is_refused(bad: Any) -> None:
    with pytest.raises(DataError):
        Rollout(bad, np.zeros((1, 1)), np.zeros(1))


def test_a_rollout_keeps_what_it_was_given_when_the_callers_buffers_change() -> None:
    observations, actions, rewards = np.ones((4, 2)), np.ones((3, 1)), np.ones(3)
    kept = Rollout(observations, actions, rewards)
    for buffer in (observations, actions, rewards):
        buffer[:] = -7.0
    for values in (kept.observations, kept.actions, kept.rewards):
        np.testing.assert_array_equal(values, 1.0)
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0.0


def test_rows_collected_as_views_of_one_buffer_keep_their_own_values() -> None:
    # The trap: a simulator that reuses one array hands out the same view at every step.
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


@pytest.mark.parametrize(("ds", "da"), [(2, 2), (4, 2), (3, 1), (3, 3)])
def test_a_rollout_of_another_width_than_the_task_is_refused(ds: int, da: int) -> None:
    with pytest.raises(DataError):
        rollout(4, ds=ds, da=da).check(task())
    rollout(4).check(task())


def successor_pairs(rollouts: list[Rollout]) -> tuple[FloatArray, FloatArray]:
    """States and successors straight from the roll-outs."""
    return (
        np.concatenate([r.observations[:-1] for r in rollouts]),
        np.concatenate([r.observations[1:] for r in rollouts]),
    )


@pytest.mark.parametrize("lengths", [[1], [1, 1, 1], [4], [3, 1, 5], [1, 6]])
def test_transitions_name_each_state_and_its_true_successor(lengths: list[int]) -> None:
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


def test_the_window_forgets_the_oldest_rollouts() -> None:
    rollouts = [rollout(1 + i, i) for i in range(7)]
    empty = ReplayWindow(4)
    first = empty.extend(rollouts[:3])
    second = first.extend(rollouts[3:5])
    third = second.extend(rollouts[5:])
    assert empty.rollouts == ()
    assert [len(r) for r in first.rollouts] == [1, 2, 3]
    assert [len(r) for r in second.rollouts] == [2, 3, 4, 5]
    assert [len(r) for r in third.rollouts] == [4, 5, 6, 7]
    assert third.capacity == 4
    np.testing.assert_array_equal(
        third.transitions.states, Transitions.from_rollouts(rollouts[3:]).states
    )


def test_more_rollouts_than_the_window_holds_leave_the_latest() -> None:
    rollouts = [rollout(1 + i, i) for i in range(5)]
    assert [len(r) for r in ReplayWindow(2).extend(iter(rollouts)).rollouts] == [4, 5]


def test_many_groups_of_angles_are_checked_in_no_time() -> None:
    many = 20_000
    started = time.process_time()
    task = TaskSpec(many, np.zeros(1), np.ones(1), range(many), [[i] for i in range(many)])
    assert task.factor_count == len(task.state_factors) == many
    assert time.process_time() - started < 2.0  # each against all took tens of seconds


@pytest.mark.parametrize("limit", [1e101, 1.7e308, np.inf])
def test_absurd_limits_of_actions_are_refused(limit: float) -> None:
    with pytest.raises(ConfigurationError, match="finite"):
        TaskSpec(2, np.array([-limit]), np.array([limit]))
