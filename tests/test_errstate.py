"""Under np.seterr(all="raise"), which finds errors of one's own, an underflow in here is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.errors import EnvironmentFailure
from kreps.learning.evaluate import evaluate

SMALL: dict[str, Any] = {
    "seed": 0,
    "initial_rollouts": 6,
    "rollouts_per_iteration": 3,
    "restart_probability": 0.1,
}


class Watched(gym.Wrapper[Any, Any, Any, Any]):
    """Notes how floating-point errors are handled where the environment steps."""

    handling: Any = None

    def step(self, action: Any) -> Any:
        self.handling = np.geterr()
        return self.env.step(action)


@pytest.mark.parametrize("method", [kreps.KREPS, kreps.ValueIteration, kreps.NPALP])
@pytest.mark.parametrize("name", ["kreps/SwingUp-v0", "Pendulum-v1"])
def test_learning_and_acting_are_the_same_where_floating_point_errors_raise(
    method: Any, name: str, tmp_path: Path
) -> None:
    env = gym.make(name)
    far = np.full(env.observation_space.shape or (), 1e4)

    def everything() -> list[Any]:
        learner = method(env, **SMALL).learn(2, progress=False)
        learner.policy.save(tmp_path / "policy")
        learner.save(tmp_path / "checkpoint")
        policies = [learner, kreps.load_policy(tmp_path / "policy")]
        policies.append(method.resume(tmp_path / "checkpoint"))
        if method is kreps.KREPS:
            policies.append(learner.policy.compressed(5))
        found = [p.predict(far, deterministic=d)[0] for p in policies for d in (True, False)]
        found.append(learner.exploring)
        if method is kreps.KREPS:
            found.append(learner.value_function(far[None]))
        judged = evaluate(
            env, learner.task, learner.state.policy, restart_probability=0.9, episodes=2, steps=500
        )
        return [*found, judged.mean]

    wanted = everything()
    with np.errstate(all="raise"):
        found = everything()
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_the_environment_keeps_the_handling_of_the_caller() -> None:
    env = Watched(gym.make("Pendulum-v1"))
    with np.errstate(all="raise"):
        kreps.KREPS(env, **SMALL).learn(1, progress=False)
    assert set(env.handling.values()) == {"raise"}
    env.env.step = lambda action: np.zeros(1) / np.zeros(1)  # type: ignore[method-assign]
    with np.errstate(all="raise"), pytest.raises(EnvironmentFailure, match="FloatingPointError"):
        kreps.KREPS(env, **SMALL).learn(1, progress=False)
