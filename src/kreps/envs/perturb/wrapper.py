"""Perturbed environments, step by step and in lock step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from kreps.envs.batch import BatchModel, batch_model_of, time_stamps_of, unchecked
from kreps.envs.perturb.perturbation import Chain, Perturbation
from kreps.envs.perturb.signal import Signal
from kreps.errors import DataError, SpaceError
from kreps.intake import as_numbers
from kreps.kernels.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class PerturbedBatch:
    """m copies of a perturbed environment in lock step; see `kreps.envs.batch.BatchModel`.

    States are those of ``model``, the hidden states of the actuators, those of the sensors, and the
    perturbed observation, side by side.

    Attributes:
        model: without perturbations.
        actuators: perturbations of the actions.
        sensors: perturbations of the observations.
        reveal: whether the full state is observed (`Perturbed`).
    """

    model: BatchModel
    actuators: Chain
    sensors: Chain
    reveal: bool

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        inner = self.model.initial(rngs)
        at_rest = np.tile(self.actuators.source.neutral, (len(rngs), 1))
        actuators, _ = self.actuators.start(at_rest, rngs)
        return np.concatenate(
            [inner, actuators, *self.sensors.start(self.model.observe(inner), rngs)], axis=1
        )

    def observe(self, states: FloatArray) -> FloatArray:
        inner, actuators, _, sensed = self._parts(states)
        if not self.reveal:
            return sensed
        return np.concatenate([self.model.observe(inner), actuators], axis=1)

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        inner, actuators, sensors, _ = self._parts(states)
        actuators, applied = self.actuators.step(
            actuators, self.actuators.source.clip(actions), rngs
        )
        inner, rewards, ends = self.model.step(inner, self.actuators.source.clip(applied), rngs)
        seen = self.sensors.step(sensors, self.model.observe(inner), rngs)
        return np.concatenate([inner, actuators, *seen], axis=1), rewards, ends

    def time_stamps(self, states: FloatArray) -> FloatArray | None:
        """Time stamps (m,) in s; see `kreps.envs.batch.time_stamps_of`."""
        return time_stamps_of(self.model, self._parts(states)[0])

    def _parts(self, states: FloatArray) -> list[FloatArray]:
        """States of the model, of the actuators and of the sensors, and perturbed observations."""
        widths = len(self.actuators.hidden), len(self.sensors.hidden), len(self.sensors.output)
        first = states.shape[1] - sum(widths)
        return np.split(states, np.cumsum([first, *widths[:2]]), axis=1)


class Perturbed(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose actions and observations are perturbed.

    Commands are clipped to the limits of the actions, perturbed, and clipped again.  Rewards and
    ends are those of what happens; they are neither perturbed nor delayed.  Random numbers come
    from the generator of the environment, as those of Gymnasium's own wrappers do, so
    ``reset(seed=...)`` seeds both.  Where ``env`` has a ``batch_model``, so has the wrapper, and a
    learner collects in lock step.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> from kreps.envs.perturb import Delay, Hidden, Noise, Perturbed
    >>> env = gym.make("kreps/SwingUp-v0")
    >>> env = Perturbed(env, actions=[Delay(3)], observations=[Hidden(1), Noise(0.1)])
    >>> env.observation_space.shape
    (1,)

    ```

    Args:
        env: with observations and actions in a Box of one axis.
        actions: perturbations of the actions, applied in this order.
        observations: perturbations of the observations, applied in this order.
        reveal: whether the full state is observed, as a reference: the observation without its
            perturbations, followed by the hidden states of the perturbations of the actions.  From
            the same seed and actions the environment moves as without it.

    Raises:
        ConfigurationError: something that is no perturbation.
        SpaceError: other spaces, or parameters that do not fit their coordinates.
    """

    batch_model: BatchModel | None = None

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        actions: Sequence[Perturbation] = (),
        observations: Sequence[Perturbation] = (),
        reveal: bool = False,
    ) -> None:
        super().__init__(env)
        known = _known_metadata(env)
        self.actuators = Chain(
            Signal.from_space(
                _box("action", env.action_space), (), (known or {}).get("action_labels", ())
            ),
            tuple(actions),
        )
        if len(self.actuators.output) != len(self.actuators.source):
            raise SpaceError(
                f"actions = {list(actions)} change the number of action coordinates from "
                f"{len(self.actuators.source)} to {len(self.actuators.output)}, but the "
                "environment needs all of them; perturb observations by it"
            )
        source = Signal.from_space(
            _box("observation", env.observation_space),
            (known or {}).get("periodic_coordinates", ()),
            (known or {}).get("observation_labels", ()),
        )
        self.sensors = Chain(source, tuple(observations))
        self.reveal = reveal
        observed = self.sensors.output
        if reveal:
            observed = Signal.concat([source, self.actuators.hidden])
        given = env.observation_space.dtype
        self._dtype = given if given is not None and given.kind == "f" else np.dtype(np.float64)
        self.observation_space = gym.spaces.Box(
            observed.low.astype(self._dtype), observed.high.astype(self._dtype), dtype=self._dtype
        )
        if known is not None:
            self.metadata = _metadata(known, source, observed)
        model = batch_model_of(env)
        if model is not None:
            self.batch_model = PerturbedBatch(model, self.actuators, self.sensors, reveal)
        self._states = np.empty((1, 0)), np.empty((1, 0))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        seen = _row("observations", observation, self.sensors.source)
        rngs = [self.np_random]
        actuators, _ = self.actuators.start(self.actuators.source.neutral[None], rngs)
        sensors, sensed = self.sensors.start(seen, rngs)
        self._states = actuators, sensors
        return self._observed(seen, sensed), info

    def step(self, action: Any) -> tuple[FloatArray, Any, bool, bool, dict[str, Any]]:
        """One control period.

        Raises:
            DataError: an action or observation of another size, or with NaN or infinities.
        """
        rngs = [self.np_random]
        actuators, sensors = self._states
        limits = self.actuators.source
        command = limits.clip(_row("actions", action, limits))
        actuators, applied = self.actuators.step(actuators, command, rngs)
        dtype = np.dtype(self.env.action_space.dtype)
        applied = limits.clip(np.rint(applied) if dtype.kind in "iu" else applied)
        observation, reward, terminated, truncated, info = self.env.step(applied[0].astype(dtype))
        seen = _row("observations", observation, self.sensors.source)
        sensors, sensed = self.sensors.step(sensors, seen, rngs)
        self._states = actuators, sensors
        return self._observed(seen, sensed), reward, terminated, truncated, info

    def _observed(self, seen: FloatArray, sensed: FloatArray) -> FloatArray:
        row = np.concatenate([seen, self._states[0]], axis=1)[0] if self.reveal else sensed[0]
        return np.array(row, dtype=self._dtype)


def _row(name: str, values: Any, signal: Signal) -> FloatArray:
    """One vector (1, d) of a signal."""
    row = as_numbers(name, values, "check where they come from").reshape(1, -1)
    if row.shape[1] != len(signal):
        raise DataError(f"{name}: {row.shape[1]} numbers, but {len(signal)} are needed")
    return row


def _box(kind: str, space: gym.Space[Any]) -> gym.spaces.Box:
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise SpaceError(
            f"the {kind} space is {space}, but perturbations need a Box of one axis; for "
            "observations wrap the environment in gymnasium.wrappers.FlattenObservation"
        )
    return space


def _known_metadata(env: gym.Env[Any, Any]) -> dict[str, Any] | None:
    """Metadata that are certainly about what ``env`` observes; None if a wrapper may change it."""
    while isinstance(env, gym.wrappers.TimeLimit):
        env = env.env
    inside = unchecked(env)
    if isinstance(inside, Perturbed):
        return vars(inside).get("_metadata")
    return None if isinstance(inside, gym.Wrapper) else inside.metadata


def _metadata(known: dict[str, Any], source: Signal, observed: Signal) -> dict[str, Any]:
    """Metadata about the perturbed observations."""
    same = len(source) == len(observed)
    images = {} if same else {"observation_groups": (), "observation_image_shape": None}
    angles = tuple(np.flatnonzero(observed.angle).tolist())
    return {
        **known,
        **images,
        "periodic_coordinates": angles,
        "observation_labels": observed.labels,
    }
