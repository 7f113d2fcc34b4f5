"""The door: which arrays, numbers and flags are let in where, and within which bounds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box

import kreps
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray

SMALL: dict[str, Any] = {
    "initial_rollouts": 5,
    "rollouts_per_iteration": 2,
    "restart_probability": 0.1,
    "model_based.acceptance_rollouts": 2,
}


def masked(values: Any) -> Any:
    """The same array with its first entry missing."""
    found = np.ma.masked_array(np.array(values, float))
    found[(0,) * found.ndim] = np.ma.masked
    found.data[(0,) * found.ndim] = -9999.0
    return found


class Raises:
    """An array of another library that refuses to be read."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("can't convert a tensor that requires grad")


NO_NUMBERS: dict[str, Callable[[Any], Any]] = {
    "masked": masked,
    "a list with masked parts": lambda v: [masked(each) for each in np.atleast_1d(v)],
    "complex": lambda v: np.asarray(v) + 0j,
    "objects": lambda v: np.asarray(v, dtype=object),
    "text": lambda v: np.asarray(v).astype(str),
    "dates": lambda v: np.asarray(v).astype("datetime64[s]"),
    "another library's error": lambda v: Raises(),
}


@pytest.mark.parametrize("spoil", NO_NUMBERS.values(), ids=NO_NUMBERS)
@pytest.mark.parametrize("name", ["observations", "actions", "rewards"])
def test_what_is_no_array_of_real_numbers_is_no_rollout(
    name: str, spoil: Callable[[Any], Any]
) -> None:
    arrays = {"observations": np.ones((4, 2)), "actions": np.ones((3, 1)), "rewards": np.ones(3)}
    spoilt: dict[str, Any] = {**arrays, name: spoil(arrays[name])}
    for make in (
        lambda: kreps.Rollout(**spoilt),
        lambda: kreps.Rollouts.from_arrays(**spoilt, lengths=[3]),
        lambda: kreps.Dataset.from_arrays(**spoilt, lengths=[3]).chunks[0].load(),
    ):
        with pytest.raises(DataError, match=name):
            make()


@pytest.mark.parametrize("spoil", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_lengths_and_limits_must_be_real_numbers_too(spoil: Callable[[Any], Any]) -> None:
    points, actions, rewards = np.ones((4, 2)), np.ones((3, 1)), np.ones(3)
    with pytest.raises(DataError, match="lengths"):
        kreps.Rollouts.from_arrays(points, actions, rewards, spoil([3]))
    with pytest.raises(ConfigurationError, match="action_high"):
        kreps.TaskSpec(1, [-1.0], spoil([1.0]))


def test_a_masked_array_without_masked_entries_is_taken() -> None:
    whole = np.ma.masked_array(np.ones((4, 2)))
    kept = kreps.Rollout(whole, np.ones((3, 1)), np.ones(3))
    assert type(kept.observations) is np.ndarray
    np.testing.assert_array_equal(kept.observations, 1.0)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ([False, False, False], False),
        ((0, 0, 0), False),
        (np.zeros(3, bool), False),
        (np.array([False, False, True]), True),
        ([0.0, 0.0, 1.0], True),
        ([False], False),
        (np.array(1), True),
        (np.bool_(False), False),
    ],
    ids=str,
)
def test_flags_may_be_given_for_each_step(given: Any, wanted: bool) -> None:
    found = kreps.Rollout(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3), given)
    assert found.terminated is wanted


NO_FLAGS = ["False", "true", float("nan"), None, 2, -1, 0.5, ["False"] * 3, [None] * 3, 1j]


@pytest.mark.parametrize(
    "given", [*NO_FLAGS, [True, False, False], [True] * 3, [False] * 2, [], np.zeros((3, 1))]
)
def test_what_is_no_flag_is_no_termination(given: Any) -> None:
    with pytest.raises(DataError, match="terminated"):
        kreps.Rollout(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3), given)


@pytest.mark.parametrize("given", NO_FLAGS, ids=repr)
def test_what_is_no_flag_is_no_termination_of_several_rollouts(given: Any) -> None:
    ended: Any = given if isinstance(given, list) else [given] * 3
    with pytest.raises(DataError, match="terminated"):
        kreps.Rollouts.from_arrays(
            np.zeros((6, 2)), np.zeros((3, 1)), np.zeros(3), [1, 1, 1], ended
        )


def test_flags_are_copied() -> None:
    buffer = np.array([True])
    kept = kreps.Rollouts.from_arrays(np.zeros((2, 1)), np.zeros((1, 1)), np.zeros(1), [1], buffer)
    buffer[0] = False
    assert kept.terminated.all()


# ---- environments -----------------------------------------------------------------------------


class Mass(gym.Env[Any, Any]):
    """A mass that is pushed; what its steps return is changed by a function."""

    observation_space, action_space = Box(-9, 9, (2,)), Box(-1.0, 1.0, (1,))

    def __init__(self, **changes: Callable[[Any], Any]) -> None:
        self.changes = changes

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=2)
        return self.x.copy(), {}

    def step(self, action: Any) -> Any:
        self.x = np.clip(self.x + 0.1 * np.array([self.x[1], float(action[0])]), -9, 9)
        values = {
            "observation": self.x.copy(),
            "reward": -float(self.x @ self.x),
            "terminated": False,
            "truncated": False,
        }
        for name, change in self.changes.items():
            values[name] = change(values[name])
        return (*values.values(), {})


BAD_RETURNS: list[tuple[str, Callable[[Any], Any]]] = [
    *((name, spoil) for name in ("observation", "reward") for spoil in NO_NUMBERS.values()),
    ("reward", lambda v: [v, v]),
    ("reward", lambda v: None),
    *(
        (name, lambda v, given=given: given)
        for name in ("terminated", "truncated")
        for given in ("False", float("nan"), None, [False, False], 2)
    ),
]


@pytest.mark.parametrize(("name", "change"), BAD_RETURNS)
def test_a_step_that_returns_something_else_is_an_error_with_its_place(
    name: str, change: Callable[[Any], Any]
) -> None:
    learner = kreps.KREPS(Mass(**{name: change}), seed=0, **SMALL)
    with pytest.raises(DataError, match=rf"rollout 0 .* after [01] steps: {name}"):
        learner.learn(1, progress=False)
    assert learner.state.iteration == 0


def test_numbers_and_flags_may_come_as_arrays_of_one() -> None:
    plain = kreps.KREPS(Mass(), seed=0, **SMALL).learn(1, progress=False)
    arrays = Mass(
        reward=lambda v: np.array([v]),
        terminated=lambda v: np.array([v]),
        truncated=lambda v: np.int64(v),
    )
    same = kreps.KREPS(arrays, seed=0, **SMALL).learn(1, progress=False)
    np.testing.assert_array_equal(
        same.state.window.rollouts.rewards, plain.state.window.rollouts.rewards
    )


class MassBatch:
    """Many masses, in arrays that are used again and again."""

    def __init__(self, **changes: Callable[[Any], Any]) -> None:
        self.changes = changes
        self.start = np.zeros((0, 2))
        self.seen = np.zeros((0, 2))

    def initial(self, rngs: Any) -> FloatArray:
        if len(self.start) != len(rngs):
            self.start = np.tile([1.0, 0.0], (len(rngs), 1))
        return self.start

    def observe(self, states: FloatArray) -> FloatArray:
        if len(self.seen) != len(states):
            self.seen = np.zeros_like(states)
        self.seen[:] = states
        return self.seen

    def step(self, states: FloatArray, actions: FloatArray, rngs: Any) -> Any:
        states = states + 0.1 * np.column_stack([states[:, 1], actions[:, 0]])
        found = {"rewards": -(states[:, 0] ** 2), "ends": states[:, 0] < 0.9}
        for name, change in self.changes.items():
            found[name] = change(found[name])
        return states, found["rewards"], found["ends"]


class MassOfBatch(Mass):
    def __init__(self, model: MassBatch) -> None:
        super().__init__()
        self.batch_model = model


def test_a_batch_model_may_use_its_arrays_again() -> None:
    model = MassBatch()
    learner = kreps.KREPS(MassOfBatch(model), seed=0, **SMALL).learn(2, progress=False)
    rollouts = learner.state.window.rollouts
    assert all((rollout.observations[0] == [1.0, 0.0]).all() for rollout in rollouts)
    assert all(len(np.unique(r.observations[:, 0])) > len(r) / 2 for r in rollouts)
    np.testing.assert_array_equal(np.unique(model.start, axis=0), [[1.0, 0.0]])


def test_ends_given_as_numbers_end_the_same_rollouts() -> None:
    def lengths(**changes: Any) -> list[int]:
        env = MassOfBatch(MassBatch(**changes))
        learner = kreps.KREPS(env, seed=0, **SMALL).learn(1, progress=False)
        assert learner.state.window.rollouts.terminated.any()
        return learner.state.window.rollouts.lengths.tolist()

    assert lengths(ends=lambda v: v.astype(int)) == lengths()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("rewards", lambda v: v[0]),
        ("rewards", lambda v: v[:, None]),
        ("rewards", masked),
        ("ends", lambda v: False),
        ("ends", lambda v: v.astype(str)),
        ("ends", lambda v: v + 2),
    ],
)
def test_a_batch_model_must_return_a_number_and_a_flag_for_each_row(
    name: str, change: Callable[[Any], Any]
) -> None:
    learner = kreps.KREPS(MassOfBatch(MassBatch(**{name: change})), seed=0, **SMALL)
    with pytest.raises(DataError, match=name):
        learner.learn(1, progress=False)


@pytest.mark.parametrize("name", ["SwingUp", "Reaching", "ImageSwingUp"])
def test_our_environments_take_actions_of_their_size_only(name: str) -> None:
    env = gym.make(f"kreps/{name}-v0").unwrapped
    (size,) = env.action_space.shape or ()
    env.reset(seed=0)
    wrong = [np.ones(n) for n in {0, 1, size + 1, size + 2} - {size}]
    for action in (*wrong, np.full(size, np.nan), np.full(size, np.inf), "up", None, [1j] * size):
        with pytest.raises(DataError, match="actions"):
            env.step(action)
    env.step(np.full(size, 1e6))  # commands beyond the limits are clipped


# ---- bounds -----------------------------------------------------------------------------------


def scaled(state: float, reward: float) -> list[kreps.Rollout]:
    rng, found = np.random.default_rng(0), []
    for _ in range(8):
        a = rng.choice([-1.0, 1.0], 20)
        x = np.empty(21)
        x[0] = rng.uniform(-1, 1)
        for t in range(20):
            x[t + 1] = np.clip(x[t] + 0.3 * a[t], -5, 5)
        found.append(kreps.Rollout(state * x[:, None], a[:, None], -reward * x[1:] ** 2))
    return found


SCALES = [(1.0, 1e97), (1e55, 1.0), (1e-55, 1.0), (1.0, 1e-90), (1e90, 1e-90), (1e-90, 1e90)]


@pytest.mark.parametrize("learner", [kreps.KREPS, kreps.ValueIteration, kreps.NPALP])
@pytest.mark.parametrize(("state", "reward"), SCALES)
def test_what_is_learnt_can_be_saved_and_what_is_saved_be_loaded(
    learner: Any, state: float, reward: float, tmp_path: Path
) -> None:
    made = learner(kreps.TaskSpec(1, [-1.0], [1.0]), seed=0)
    made.update(scaled(state, reward))
    made.policy.save(tmp_path / "policy.safetensors")
    made.save(tmp_path / "checkpoint.safetensors")
    loaded = kreps.load_policy(tmp_path / "policy.safetensors")
    resumed = learner.resume(tmp_path / "checkpoint.safetensors")
    for x in (0.0, state, 1e100):
        wanted, _ = made.predict([x], deterministic=True)
        for policy in (loaded, resumed):
            np.testing.assert_array_equal(policy.predict([x], deterministic=True)[0], wanted)


def test_what_could_not_be_saved_is_not_learnt() -> None:
    learner = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]), seed=0)
    learner.update(scaled(1.0, 1.0))
    before = learner.state
    other = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]), seed=0)
    with pytest.raises(DataError, match=r"lengthscales.*scale observations and rewards"):
        other.update(scaled(1e-130, 1.0))
    assert other.state.iteration == 0
    assert learner.state is before
