"""Reaching with a planar arm of two links (Sec. 4.3): dynamics, batch model, environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.envs.base import BatchEnvironment
from kreps.envs.drawing import Canvas
from kreps.envs.integration import checked_jitter, control_periods, runge_kutta
from kreps.kernels.arrays import BoolArray, FloatArray

LINK = 0.5  # m, each
MASS = 1.0  # kg, each link a uniform rod
MAX_TORQUE = 10.0  # N m
TIME_STEP = 0.05  # s
SUB_STEPS = 10
TARGET = (0.5, 0.0)  # m
START = (0.5 * np.pi, 0.0, 0.0, 0.0)

# Parts of the inertia matrix of two uniform rods
_ELBOW = MASS * LINK**2 / 3.0  # forearm about the elbow
_COUPLING = 0.5 * MASS * LINK**2
_SHOULDER = MASS * LINK**2 / 3.0 + MASS * LINK**2  # both links about the shoulder, elbow at 90 deg


def accelerations(state: FloatArray, torques: FloatArray) -> FloatArray:
    """Joint accelerations (m, 2) in rad s^-2 of states (m, 4) under torques (m, 2), no gravity."""
    elbow, shoulder_rate, elbow_rate = state[:, 1], state[:, 2], state[:, 3]
    cosine, sine = np.cos(elbow), np.sin(elbow)
    m11 = _SHOULDER + _ELBOW + 2.0 * _COUPLING * cosine
    m12 = _ELBOW + _COUPLING * cosine
    m22 = _ELBOW
    h = _COUPLING * sine
    f1 = torques[:, 0] + h * (2.0 * shoulder_rate * elbow_rate + elbow_rate**2)
    f2 = torques[:, 1] - h * shoulder_rate**2
    determinant = m11 * m22 - m12**2
    return np.stack([m22 * f1 - m12 * f2, m11 * f2 - m12 * f1], axis=1) / determinant[:, None]


def end_effector(state: FloatArray) -> FloatArray:
    """Position (m, 2) in m of the tip of the forearm."""
    upper, fore = state[:, 0], state[:, 0] + state[:, 1]
    return LINK * np.stack([np.cos(upper) + np.cos(fore), np.sin(upper) + np.sin(fore)], axis=1)


def reward(state: FloatArray, torques: FloatArray) -> FloatArray:
    """``-1e-4 |a|^2 - |x - target|^2`` for states (m, 4) and applied torques (m, 2)."""
    distance = end_effector(state) - np.array(TARGET)
    return -1e-4 * np.sum(torques**2, axis=1) - np.sum(distance**2, axis=1)


def wrap_angles(states: FloatArray) -> FloatArray:
    """Wrap both angles of states (m, 4) to [-pi, pi), in place, and return the states."""
    states[:, :2] = (states[:, :2] + np.pi) % (2.0 * np.pi) - np.pi
    return states


@dataclass(frozen=True)
class ReachingBatch:
    """The reaching task for m rollouts at once; see `kreps.envs.batch.BatchModel`.

    States (m, 4) are angles and velocities, and with jitter the time since the start, (m, 5).

    Attributes:
        jitter: argument of `Reaching`.
    """

    jitter: float = 0.0

    def __post_init__(self) -> None:
        checked_jitter(self.jitter)

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        return np.tile([*START, 0.0] if self.jitter else START, (len(rngs), 1))

    def observe(self, states: FloatArray) -> FloatArray:
        return states[:, :4]

    def time_stamps(self, states: FloatArray) -> FloatArray | None:
        return states[:, 4] if self.jitter else None

    def states_at(self, observations: FloatArray) -> FloatArray:
        start = np.zeros((len(observations), 1 if self.jitter else 0))
        return wrap_angles(np.concatenate([observations, start], axis=1))

    def rewards(self, observations: FloatArray, actions: FloatArray) -> FloatArray:
        return reward(observations, np.clip(actions, -MAX_TORQUE, MAX_TORQUE))

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        torques = np.clip(actions, -MAX_TORQUE, MAX_TORQUE)

        def derivative(s: FloatArray) -> FloatArray:
            return np.concatenate([s[:, 2:], accelerations(s, torques)], axis=1)

        moving = states[:, :4]
        rewards, ends = self.rewards(moving, actions), np.zeros(len(rngs), dtype=bool)
        if not self.jitter:
            return wrap_angles(runge_kutta(derivative, moving, TIME_STEP, SUB_STEPS)), rewards, ends
        periods = control_periods(TIME_STEP, self.jitter, rngs)[:, None]
        successors = runge_kutta(derivative, moving, periods, SUB_STEPS)
        times = states[:, 4:] + periods
        return np.concatenate([wrap_angles(successors), times], axis=1), rewards, ends


class Reaching(BatchEnvironment):
    """
    ## Description

    A planar arm of two links, actuated at shoulder and elbow, is to move its tip to a target and
    keep it there with small torques.  There is neither gravity nor friction nor noise, so the task
    is deterministic.

    Both links are uniform rods of 0.5 m and 1 kg.  The arm is controlled at 20 Hz; each period
    is integrated by 10 Runge-Kutta steps of order four under the held torques.

    ## Action Space

    The action is a `ndarray` with shape `(2,)`; commands beyond the limits are clipped.

    | Num | Action                            | Min   | Max  | Unit |
    |-----|-----------------------------------|-------|------|------|
    | 0   | Shoulder torque, counterclockwise | -10.0 | 10.0 | N m  |
    | 1   | Elbow torque, counterclockwise    | -10.0 | 10.0 | N m  |

    ## Observation Space

    The observation is a `ndarray` with shape `(4,)` and data type float64.
    `metadata["periodic_coordinates"]` lists the coordinates that are angles.

    | Num | Observation                              | Min  | Max | Unit  |
    |-----|------------------------------------------|------|-----|-------|
    | 0   | Angle of the upper arm from the x-axis   | -pi  | pi  | rad   |
    | 1   | Angle of the forearm from the upper arm  | -pi  | pi  | rad   |
    | 2   | Angular velocity of the shoulder         | -Inf | Inf | rad/s |
    | 3   | Angular velocity of the elbow            | -Inf | Inf | rad/s |

    ## Rewards

    `r = -1e-4 |a|^2 - |x - target|^2` with the applied torques `a`, the tip's position `x` in m and
    the target (0.5, 0).

    ## Starting State

    Stretched along the y-axis at rest: angles (pi/2, 0), velocities 0.

    ## Episode End

    The task never terminates and is never truncated.  The paper's protocol restarts it with
    probability 0.02 per step: see `kreps.envs.RandomRestart`.

    ## Arguments

    `render_mode`: `None` or `"rgb_array"`.

    `jitter`: in [0, 1), 0 by default.  Each control period is drawn uniformly from
    `(1 - jitter) dt` to `(1 + jitter) dt` with `dt = 0.05 s`; `info["time"]` has the time since
    the start in s.  The reward of a step does not depend on it.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> env = gym.make("kreps/Reaching-v0", render_mode="rgb_array")

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
            "shoulder [rad/s]",
            "elbow [rad/s]",
        ),
        "action_labels": ("shoulder torque [N m]", "elbow torque [N m]"),
    }
    batch_model = ReachingBatch()

    def __init__(self, render_mode: str | None = None, jitter: float = 0.0) -> None:
        if jitter:
            self.batch_model = ReachingBatch(jitter)
        high = np.array([np.pi, np.pi, np.inf, np.inf])
        super().__init__(
            render_mode,
            gym.spaces.Box(-high, high, dtype=np.float64),
            gym.spaces.Box(-MAX_TORQUE, MAX_TORQUE, (2,), dtype=np.float64),
        )

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        upper, fore = state[0], state[0] + state[1]
        elbow = LINK * np.array([np.cos(upper), np.sin(upper)])
        tip = elbow + LINK * np.array([np.cos(fore), np.sin(fore)])
        canvas = Canvas(extent=1.25)
        canvas.disc((0.0, 0.0), 2.0 * LINK, (0.95, 0.95, 0.96))
        canvas.disc(TARGET, 0.06, (0.82, 0.38, 0.24))
        canvas.rod((0.0, 0.0), elbow, 0.06, (0.16, 0.38, 0.64))
        canvas.rod(elbow, tip, 0.05, (0.35, 0.55, 0.78))
        canvas.disc((0.0, 0.0), 0.035, (0.12, 0.12, 0.14))
        return canvas.pixels()
