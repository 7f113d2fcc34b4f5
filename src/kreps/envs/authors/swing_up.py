"""The swing-up as the authors' scripts have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.envs.base import BatchEnvironment
from kreps.envs.swing_up import MAX_TORQUE, NOISE, SwingUp, integrate, reward, wrap_angle
from kreps.kernels.arrays import BoolArray, FloatArray

MAX_COMMAND = 50.0  # N m
START_STD = 0.4 * np.pi  # rad


@dataclass(frozen=True)
class AuthorsSwingUpBatch:
    """The task for m rollouts at once; see `kreps.envs.batch.BatchModel`.

    States (m, 2) are angle and velocity.
    """

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        angles = np.pi + START_STD * np.array([rng.standard_normal() for rng in rngs])
        return np.column_stack([wrap_angle(angles), np.zeros(len(rngs))])

    def observe(self, states: FloatArray) -> FloatArray:
        return states

    def states_at(self, observations: FloatArray) -> FloatArray:
        return np.column_stack([wrap_angle(observations[:, 0]), observations[:, 1]])

    def rewards(self, observations: FloatArray, actions: FloatArray) -> FloatArray:
        command = np.clip(actions[:, 0], -MAX_COMMAND, MAX_COMMAND)
        return reward(observations[:, 0], observations[:, 1], command)

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        noise = NOISE * np.array([rng.standard_normal() for rng in rngs])
        command = np.clip(actions[:, 0], -MAX_COMMAND, MAX_COMMAND)
        torque = np.clip(command + noise, -MAX_TORQUE, MAX_TORQUE)
        theta, velocity = integrate(states[:, 0], states[:, 1], torque)
        successors = np.column_stack([wrap_angle(theta), velocity])
        return successors, self.rewards(states, actions), np.zeros(len(rngs), dtype=bool)


class AuthorsSwingUp(BatchEnvironment):
    """
    ## Description

    The swing-up of `kreps/SwingUp-v0` as the authors' scripts have it.  Mass, length, friction,
    control period and the size of the noise are the same (their friction of 0.3 per second is that
    of 0.25 N m s here).  Three things differ: noise is added to the command *before* the torque is
    clipped to 30 N m, commands may be as large as 50 N m, and rollouts start at random angles.

    ## Action Space

    The action is a `ndarray` with shape `(1,)`; commands beyond the limits are clipped.

    | Num | Action                             | Min   | Max  | Unit |
    |-----|------------------------------------|-------|------|------|
    | 0   | Commanded torque, counterclockwise | -50.0 | 50.0 | N m  |

    ## Observation Space

    As in `kreps/SwingUp-v0`: angle from upright in [-pi/2, 3 pi/2) and angular velocity.

    ## Rewards

    `r = -10 theta^2 - 0.1 theta'^2 - 0.001 a^2` with the clipped command `a`.

    ## Starting State

    At rest, at an angle from the normal distribution with mean pi (hanging) and standard deviation
    0.4 pi.

    ## Episode End

    The task never terminates and is never truncated; the scripts restart it with probability 0.02
    per step, as `kreps.envs.RandomRestart` does.

    ## Arguments

    `render_mode`: `None` or `"rgb_array"`.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> env = gym.make("kreps/AuthorsSwingUp-v0", render_mode="rgb_array")

    ```

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = SwingUp.metadata
    batch_model = AuthorsSwingUpBatch()

    def __init__(self, render_mode: str | None = None) -> None:
        low, high = np.array([-0.5 * np.pi, -np.inf]), np.array([1.5 * np.pi, np.inf])
        super().__init__(
            render_mode,
            gym.spaces.Box(low, high, dtype=np.float64),
            gym.spaces.Box(-MAX_COMMAND, MAX_COMMAND, (1,), dtype=np.float64),
        )

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        return SwingUp.picture(self, state)  # type: ignore[arg-type]
