"""One glitch in the data is told, with its place and how to leave it out."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.outliers import find_outliers
from kreps.data.rollouts import Rollout, Rollouts

TASK = kreps.TaskSpec(2, [-1.0], [1.0])
SMALL: dict[str, Any] = {"model_based": None}


@pytest.fixture(autouse=True)
def _told_each_time() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("always", kreps.DataWarning)
        yield


def pushes(rollouts: int = 10, steps: int = 50, seed: int = 0) -> list[Rollout]:
    rng, made = np.random.default_rng(seed), []
    for _ in range(rollouts):
        points, actions = [rng.normal(size=2)], rng.choice([-1.0, 1.0], (steps, 1))
        for (action,) in actions:
            x, v = points[-1]
            points.append(np.array([x + 0.1 * v, 0.95 * v + 0.3 * action + 0.05 * rng.normal()]))
        o = np.array(points)
        made.append(Rollout(o, actions, -10.0 * o[:-1, 0] ** 2 - 0.1 * o[:-1, 1] ** 2))
    return made


def spoilt(
    rollouts: list[Rollout], which: int, row: int, *, end: bool = False, **values: float
) -> list[Rollout]:
    """The rollouts with one velocity or reward replaced."""
    r = rollouts[which]
    observations, rewards = r.observations.copy(), r.rewards.copy()
    if "velocity" in values:
        observations[row, 1] = values["velocity"]
    if "reward" in values:
        rewards[row] = values["reward"]
    changed = Rollout(observations, r.actions, rewards, end)
    return [*rollouts[:which], changed, *rollouts[which + 1 :]]


def told(update: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        update()
    return [str(each.message) for each in caught if each.category is kreps.DataWarning]


LEARNERS = [(kreps.KREPS, SMALL), (kreps.ValueIteration, {}), (kreps.NPALP, {})]


@pytest.mark.parametrize(("learner", "settings"), LEARNERS)
@pytest.mark.parametrize(
    ("glitch", "says"),
    [
        ({"velocity": 1e6}, "rollout 3, row 17: observation coordinate 1 is 1e+06, "),
        ({"velocity": -3e4}, "rollout 3, row 17: observation coordinate 1 is -3e+04, "),
        ({"reward": -1e6}, "rollout 3, row 17: the reward is -1e+06, "),
        ({"reward": 1e9}, "rollout 3, row 17: the reward is 1e+09, "),
    ],
)
def test_one_glitch_is_told_with_its_place_and_the_remedy(
    learner: Any, settings: dict[str, Any], glitch: dict[str, float], says: str
) -> None:
    made = learner(TASK, seed=0, **settings)
    (message,) = told(lambda: made.update(spoilt(pushes(), 3, 17, **glitch)))
    assert message.startswith(says)
    for part in ("times as far from the median", "leave the rollout out", "kreps.DataWarning"):
        assert part in message
    assert made.state.iteration == 1


def test_without_the_rollout_nothing_is_told() -> None:
    data = spoilt(pushes(), 3, 17, velocity=1e6)
    learner = kreps.KREPS(TASK, seed=0, **SMALL)
    assert told(lambda: learner.update(data[:3] + data[4:])) == []
    cut = Rollout(data[3].observations[:17], data[3].actions[:16], data[3].rewards[:16])
    assert told(lambda: learner.update([cut])) == []


def test_as_an_error_it_stops_before_anything_is_learnt() -> None:
    learner = kreps.KREPS(TASK, seed=0, **SMALL)
    learner.update(pushes())
    before = learner.state
    with warnings.catch_warnings():
        warnings.simplefilter("error", kreps.DataWarning)
        with pytest.raises(kreps.DataWarning, match="rollout 1, row 5"):
            learner.update(spoilt(pushes(2, seed=1), 1, 5, velocity=1e6))
    assert learner.state is before


def test_few_new_rollouts_are_judged_by_those_of_the_window() -> None:
    learner = kreps.KREPS(TASK, seed=0, **SMALL)
    learner.update(pushes())
    (message,) = told(lambda: learner.update(spoilt(pushes(1, 3, seed=1), 0, 2, reward=-1e6)))
    assert message.startswith("rollout 0, row 2: the reward")
    assert told(lambda: learner.update(pushes(1, seed=2))) == []  # it was told before


class Glitch(gym.Wrapper[Any, Any, Any, Any]):
    """One wrong velocity, in step 40 of all."""

    steps = 0

    def step(self, action: Any) -> Any:
        observation, *others = self.env.step(action)
        self.steps += 1
        if self.steps == 40:
            observation = np.array([observation[0], 1e6])
        return (observation, *others)


def test_it_is_told_while_learning_in_an_environment() -> None:
    env = Glitch(gym.make("kreps/SwingUp-v0").unwrapped)
    learner = kreps.KREPS(env, seed=0, periodic=[0], initial_rollouts=10, **SMALL)
    (message,) = told(lambda: learner.learn(2, progress=False))
    assert "observation coordinate 1 is 1e+06" in message
    assert "TransformObservation" in message


def test_rollouts_of_a_data_set_have_one_number() -> None:
    data = kreps.Dataset.from_rollouts(spoilt(pushes(), 7, 11, reward=-1e6), chunk_size=200)
    assert len(data.chunks) == 3
    learner = kreps.KREPS(TASK, seed=0, low_rank=kreps.LowRank(rank=40), **SMALL)
    (message,) = told(lambda: learner.update(data))
    assert message.startswith("rollout 7, row 11: the reward is -1e+06")


def test_three_of_many_are_shown() -> None:
    data = pushes()
    for which, row in ((1, 4), (2, 3), (5, 0), (6, 9)):
        data = spoilt(data, which, row, velocity=1e6)
    (message,) = told(lambda: kreps.KREPS(TASK, seed=0, **SMALL).update(data))
    assert message.count("observation coordinate") == 3
    assert "rollout 5, row 0" in message and "; and 1 more." in message


# ---- what belongs to the task -----------------------------------------------------------------


def outliers(values: Any) -> int:
    """Number of outliers among rewards (n,)."""
    n = len(values)
    data = Rollouts.from_list([Rollout(np.zeros((n + 1, 1)), np.zeros((n, 1)), values)])
    return len(find_outliers(data))


N = 500
RNG = np.random.default_rng(0)
NORMAL = RNG.normal(size=N)
ONE = (np.arange(N) == 17).astype(float)


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(N),
        ONE,  # the first time that a goal is reached
        -0.05 * NORMAL**2 + 100.0 * ONE,  # the same with a cost of actions
        NORMAL + 1e16,
        RNG.standard_t(2, N),
        np.exp(2.0 * NORMAL),
        np.where(RNG.random(N) < 0.02, -1e6, NORMAL),  # too many for a glitch
        np.where(np.arange(N) < 15, NORMAL, 0.0) - 1e6 * ONE,  # too few to compare with
        1.0 + 1e-12 * NORMAL + 0.01 * ONE,  # rounding
        np.arange(N) ** 3.0,
    ],
)
def test_what_may_belong_to_the_task_is_not_told(values: Any) -> None:
    assert outliers(values) == 0


@pytest.mark.parametrize(
    "values",
    [NORMAL - 1e4 * ONE, NORMAL + 1e5 * ONE, NORMAL + 1e3 - 1e6 * ONE, 1e-9 * NORMAL - ONE],
)
def test_what_is_far_from_all_others_is_told(values: Any) -> None:
    assert outliers(values) == 1


def test_the_reward_of_an_end_may_be_large() -> None:
    data = spoilt(pushes(), 3, 49, reward=-1e6)
    assert len(find_outliers(Rollouts.from_list(data))) == 1
    assert not find_outliers(Rollouts.from_list(spoilt(pushes(), 3, 49, reward=-1e6, end=True)))


@pytest.mark.parametrize(
    "name", ["kreps/SwingUp-v0", "kreps/Reaching-v0", "Pendulum-v1", "MountainCarContinuous-v0"]
)
def test_nothing_is_told_on_known_tasks(name: str) -> None:
    learner = kreps.KREPS(gym.make(name), seed=0, initial_rollouts=20, **SMALL)
    assert told(lambda: learner.learn(3, progress=False)) == []
