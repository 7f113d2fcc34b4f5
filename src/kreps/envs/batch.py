"""The vectorised form of an environment, which simulates many rollouts at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from kreps.kernels.arrays import BoolArray, FloatArray


class BatchModel(Protocol):
    """m independent copies of an environment, each with its own random generator.

    An environment with an attribute ``batch_model`` is simulated by it.  For each copy it must draw
    the same random numbers as the environment, so that both give the same rollouts from the same
    seeds.  States are internal to the simulator; only observations are learnt from.

    A model whose control periods vary has a further method ``time_stamps`` (see `time_stamps_of`).
    """

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        """Start states (m, k)."""
        ...

    def observe(self, states: FloatArray) -> FloatArray:
        """Observations (m, ds) of states (m, k)."""
        ...

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Successors (m, k), rewards (m,) and whether the task ended (m,), for actions (m, da)."""
        ...


class SettableModel(BatchModel, Protocol):
    """A batch model that can be set to any state."""

    def states_at(self, observations: FloatArray) -> FloatArray:
        """The states (m, k) with these observations (m, ds)."""
        ...


class KnownReward(BatchModel, Protocol):
    """A batch model whose reward is a known function of observation and action."""

    def rewards(self, observations: FloatArray, actions: FloatArray) -> FloatArray:
        """Rewards (m,) of actions (m, da) taken at observations (m, ds)."""
        ...


def time_stamps_of(model: BatchModel, states: FloatArray) -> FloatArray | None:
    """Time stamps (m,) in s since the start of states (m, k), by ``model.time_stamps(states)``.

    None if the model has no such method, or if it returns None: its control periods are constant.
    """
    method = getattr(model, "time_stamps", None)
    return None if method is None else method(states)


def unchecked(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """The environment inside wrappers that only check how it is used."""
    while isinstance(env, gym.wrappers.PassiveEnvChecker | gym.wrappers.OrderEnforcing):
        env = env.env
    return env


def batch_model_of(env: gym.Env[Any, Any]) -> BatchModel | None:
    """The vectorised form of an environment; None if it has none that computes the same.

    A wrapper may change what a step does, so only wrappers that are known not to are looked
    through.  A subclass with its own step or reset differs from the class that has the model.
    """
    env = unchecked(env)
    kind = type(env)
    owner = next((each for each in kind.__mro__ if "batch_model" in vars(each)), kind)
    if any(getattr(kind, name) is not getattr(owner, name) for name in ("step", "reset")):
        return None
    has_one = owner is not kind or "batch_model" in {**vars(kind), **vars(env)}
    return env.batch_model if has_one else None  # type: ignore[attr-defined]
