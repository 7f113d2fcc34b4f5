"""The reaching task as the authors' scripts have it: two double integrators move a planar arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.envs.base import BatchEnvironment
from kreps.envs.drawing import Canvas
from kreps.envs.reaching import TARGET, wrap_angles
from kreps.kernels.arrays import BoolArray, FloatArray

LINK = 1.0  # m, each
MAX_ACTION = 50.0  # rad s^-2, as the masses are one
TIME_STEP = 0.03  # s
RESTART_PROBABILITY = 0.04


def end_effector(angles: FloatArray) -> FloatArray:
    """Position (m, 2) in m of the tip, of joint angles (m, 2); at zero it is at (0, 2)."""
    upper, fore = angles[:, 0], angles[:, 0] + angles[:, 1]
    return LINK * np.stack([np.sin(upper) + np.sin(fore), np.cos(upper) + np.cos(fore)], axis=1)


@dataclass(frozen=True)
class AuthorsReachingBatch:
    """The task for m rollouts at once; see `kreps.envs.batch.BatchModel`.

    States (m, 4) are angles and velocities.
    """

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        return np.zeros((len(rngs), 4))

    def observe(self, states: FloatArray) -> FloatArray:
        return states

    def states_at(self, observations: FloatArray) -> FloatArray:
        return wrap_angles(observations.copy())

    def rewards(self, observations: FloatArray, actions: FloatArray) -> FloatArray:
        applied = np.clip(actions, -MAX_ACTION, MAX_ACTION)
        distance = end_effector(observations[:, :2]) - np.array(TARGET)
        return -1e-4 * np.sum(applied**2, axis=1) - np.sum(distance**2, axis=1)

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        acceleration = np.clip(actions, -MAX_ACTION, MAX_ACTION)
        velocities = states[:, 2:] + TIME_STEP * acceleration
        angles = states[:, :2] + 0.5 * TIME_STEP * (states[:, 2:] + velocities)
        successors = wrap_angles(np.concatenate([angles, velocities], axis=1))
        return successors, self.rewards(states, actions), np.zeros(len(rngs), dtype=bool)


class AuthorsReaching(BatchEnvironment):
    """
    ## Description

    A planar arm of two links is to move its tip to a target and keep it there with small actions.
    It is the reaching task as the authors' scripts have it: each joint is a double integrator of
    unit mass without friction, gravity or coupling, and only the position of the tip depends on
    both.  The task is deterministic.  `kreps/Reaching-v0` has the dynamics of two rigid rods.

    Both links are 1 m long.  The arm is controlled each 0.03 s, and the motion under a held action
    is computed exactly.

    ## Action Space

    The action is a `ndarray` with shape `(2,)`; commands beyond the limits are clipped.

    | Num | Action                                     | Min   | Max  | Unit     |
    |-----|--------------------------------------------|-------|------|----------|
    | 0   | Acceleration of the upper arm, clockwise   | -50.0 | 50.0 | rad/s^2  |
    | 1   | Acceleration of the forearm, clockwise     | -50.0 | 50.0 | rad/s^2  |

    ## Observation Space

    The observation is a `ndarray` with shape `(4,)` and data type float64.
    `metadata["periodic_coordinates"]` lists the coordinates that are angles.

    | Num | Observation                                         | Min  | Max | Unit  |
    |-----|-----------------------------------------------------|------|-----|-------|
    | 0   | Angle of the upper arm from the y-axis, clockwise   | -pi  | pi  | rad   |
    | 1   | Angle of the forearm from the upper arm, clockwise  | -pi  | pi  | rad   |
    | 2   | Angular velocity of the upper arm                   | -Inf | Inf | rad/s |
    | 3   | Angular velocity of the forearm from the upper arm  | -Inf | Inf | rad/s |

    ## Rewards

    `r = -1e-4 |a|^2 - |x - target|^2` with the clipped action `a`, the tip's position `x` in m and
    the target (0.5, 0).

    ## Starting State

    Stretched along the y-axis at rest: angles and velocities 0, the tip at (0, 2).

    ## Episode End

    The task never terminates and is never truncated; the scripts restart it with probability 0.04
    per step: `kreps.envs.RandomRestart(env, 0.04)`, or `restart_probability=0.04` of a learner.

    ## Arguments

    `render_mode`: `None` or `"rgb_array"`.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> env = kreps.RandomRestart(gym.make("kreps/AuthorsReaching-v0"), 0.04)

    ```

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (declared so by gymnasium.Env)
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / TIME_STEP),
        "dt": TIME_STEP,
        "periodic_coordinates": (0, 1),
        "observation_labels": (
            "upper arm [rad]",
            "forearm [rad]",
            "upper arm [rad/s]",
            "forearm [rad/s]",
        ),
        "action_labels": ("upper arm [rad/s^2]", "forearm [rad/s^2]"),
    }
    batch_model = AuthorsReachingBatch()

    def __init__(self, render_mode: str | None = None) -> None:
        high = np.array([np.pi, np.pi, np.inf, np.inf])
        super().__init__(
            render_mode,
            gym.spaces.Box(-high, high, dtype=np.float64),
            gym.spaces.Box(-MAX_ACTION, MAX_ACTION, (2,), dtype=np.float64),
        )

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        elbow = LINK * np.array([np.sin(state[0]), np.cos(state[0])])
        tip = end_effector(state[None, :2])[0]
        canvas = Canvas(extent=2.5)
        canvas.disc((0.0, 0.0), 2.0 * LINK, (0.95, 0.95, 0.96))
        canvas.disc(TARGET, 0.12, (0.82, 0.38, 0.24))
        canvas.rod((0.0, 0.0), elbow, 0.12, (0.16, 0.38, 0.64))
        canvas.rod(elbow, tip, 0.1, (0.35, 0.55, 0.78))
        canvas.disc((0.0, 0.0), 0.07, (0.12, 0.12, 0.14))
        return canvas.pixels()
