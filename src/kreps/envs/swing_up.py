"""The underpowered swing-up with torque noise (Sec. 4.4): dynamics, batch model, environment."""

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
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import BoolArray, FloatArray

MASS = 10.0  # kg
LENGTH = 0.5  # m
GRAVITY = 9.81  # m s^-2
FRICTION = 0.25  # N m s
MAX_TORQUE = 30.0  # N m
TIME_STEP = 0.05  # s
SUB_STEPS = 10
INERTIA = MASS * LENGTH**2 / 3.0  # kg m^2
WEIGHT_TORQUE = MASS * GRAVITY * LENGTH  # N m: more than MAX_TORQUE, so the task is underpowered
NOISE = TIME_STEP**-0.5  # N m, standard deviation


def wrap_angle(theta: FloatArray) -> FloatArray:
    """``theta`` wrapped to [-pi/2, 3 pi/2): 0 is upright, pi is hanging."""
    return (theta + 0.5 * np.pi) % (2.0 * np.pi) - 0.5 * np.pi


def acceleration(
    theta: FloatArray, velocity: FloatArray, torque: FloatArray, friction: float = FRICTION
) -> FloatArray:
    """``theta''`` from ``I theta'' = G sin theta + u - k theta'``, in rad s^-2."""
    return (WEIGHT_TORQUE * np.sin(theta) + torque - friction * velocity) / INERTIA


def integrate(
    theta: FloatArray,
    velocity: FloatArray,
    torque: FloatArray,
    friction: float = FRICTION,
    sub_steps: int = SUB_STEPS,
    period: float | FloatArray = TIME_STEP,
) -> tuple[FloatArray, FloatArray]:
    """Angle and velocity (m,) after one control period of constant torque (m,)."""

    def derivative(state: FloatArray) -> FloatArray:
        return np.stack([state[1], acceleration(state[0], state[1], torque, friction)])

    theta, velocity = runge_kutta(derivative, np.stack([theta, velocity]), period, sub_steps)
    return theta, velocity


def integrate_with_dry_friction(
    theta: FloatArray,
    velocity: FloatArray,
    torque: FloatArray,
    dry_friction: float,
    period: float | FloatArray = TIME_STEP,
) -> tuple[FloatArray, FloatArray]:
    """The same with Coulomb friction of ``dry_friction`` in N m, beside the viscous one.

    At rest it balances all other torques up to its size, so that the pendulum sticks.  In motion it
    has this size and opposes the motion, which it can end but not reverse.
    """
    for _ in range(SUB_STEPS):
        driving = WEIGHT_TORQUE * np.sin(theta) + torque
        direction = np.where(velocity == 0.0, np.sign(driving), np.sign(velocity))
        sticks = (velocity == 0.0) & (np.abs(driving) <= dry_friction)
        moved, speed = integrate(
            theta,
            velocity,
            torque - dry_friction * direction,
            sub_steps=1,
            period=period / SUB_STEPS,
        )
        theta = np.where(sticks, theta, moved)
        velocity = np.where(sticks | (speed * direction < 0.0), 0.0, speed)
    return theta, velocity


def reward(theta: FloatArray, velocity: FloatArray, torque: FloatArray) -> FloatArray:
    """``-10 theta^2 - 0.1 theta'^2 - 0.001 a^2`` for a wrapped angle and the applied torque."""
    return -10.0 * theta**2 - 0.1 * velocity**2 - 1e-3 * torque**2


@dataclass(frozen=True)
class SwingUpBatch:
    """The swing-up for m rollouts at once; see `kreps.envs.batch.BatchModel`.

    States (m, 2) are angle and velocity, and with jitter the time since the start, (m, 3).

    Attributes:
        dry_friction, jitter: arguments of `SwingUp`.
    """

    dry_friction: float = 0.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        checked_jitter(self.jitter)
        if not 0.0 <= self.dry_friction < np.inf:
            raise ConfigurationError(
                f"dry_friction = {self.dry_friction!r:.60}, but a finite torque of at least 0 N m "
                "is needed"
            )

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        return np.tile([np.pi, 0.0, 0.0] if self.jitter else [np.pi, 0.0], (len(rngs), 1))

    def observe(self, states: FloatArray) -> FloatArray:
        return states[:, :2]

    def time_stamps(self, states: FloatArray) -> FloatArray | None:
        return states[:, 2] if self.jitter else None

    def states_at(self, observations: FloatArray) -> FloatArray:
        columns = [wrap_angle(observations[:, 0]), observations[:, 1]]
        return np.stack([*columns, 0.0 * columns[1]] if self.jitter else columns, axis=1)

    def rewards(self, observations: FloatArray, actions: FloatArray) -> FloatArray:
        torque = np.clip(actions[:, 0], -MAX_TORQUE, MAX_TORQUE)
        return reward(observations[:, 0], observations[:, 1], torque)

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        theta, velocity = states.T[:2]
        torque = np.clip(actions[:, 0], -MAX_TORQUE, MAX_TORQUE)
        noise = NOISE * np.array([rng.standard_normal() for rng in rngs])
        rewards = self.rewards(states, actions)
        period: float | FloatArray = TIME_STEP
        if self.jitter:
            period = control_periods(TIME_STEP, self.jitter, rngs)
        if self.dry_friction:
            theta, velocity = integrate_with_dry_friction(
                theta, velocity, torque + noise, self.dry_friction, period
            )
        else:
            theta, velocity = integrate(theta, velocity, torque + noise, period=period)
        columns = [wrap_angle(theta), velocity]
        if self.jitter:
            columns.append(states[:, 2] + period)
        return np.stack(columns, axis=1), rewards, np.zeros(len(rngs), dtype=bool)


class SwingUp(BatchEnvironment):
    """
    ## Description

    A pendulum hangs from an actuated joint and is to be swung up and held upright.  The largest
    torque cannot lift it directly, so it must be swung back and forth to gain energy.  The torque
    at the joint is the commanded one, clipped to its limits, plus noise.  It is the
    low-dimensional swing-up for which REPS with RKHS embeddings was introduced.

    The pendulum follows `I theta'' = G sin(theta) + u - k theta'` with inertia
    `I = m l^2 / 3` and weight `G = m g l`, for `m = 10 kg`, `l = 0.5 m`, `g = 9.81 m s^-2` and
    friction `k = 0.25 N m s`.  It is controlled at 20 Hz; each period is integrated by 10
    Runge-Kutta steps of order four.  The noise on the torque has variance `1 / dt`, that is a
    standard deviation of 4.47 N m, and is held over the period.

    ## Action Space

    The action is a `ndarray` with shape `(1,)`; commands beyond the limits are clipped.

    | Num | Action                   | Min   | Max  | Unit |
    |-----|--------------------------|-------|------|------|
    | 0   | Torque, counterclockwise | -30.0 | 30.0 | N m  |

    ## Observation Space

    The observation is a `ndarray` with shape `(2,)` and data type float64.  The angle is given
    as one number, not as cosine and sine; `metadata["periodic_coordinates"]` marks it as an angle.

    | Num | Observation                 | Min   | Max    | Unit  |
    |-----|-----------------------------|-------|--------|-------|
    | 0   | Angle from upright, theta   | -pi/2 | 3 pi/2 | rad   |
    | 1   | Angular velocity, theta'    | -Inf  | Inf    | rad/s |

    ## Rewards

    `r = -10 theta^2 - 0.1 theta'^2 - 0.001 a^2`, with the angle in [-pi/2, 3 pi/2) and the
    applied torque `a`: 0 at rest upright, -98.7 at rest hanging.

    ## Starting State

    Hanging at rest: `theta = pi`, `theta' = 0`.

    ## Episode End

    The task never terminates and is never truncated.  The paper's protocol restarts it with
    probability 0.02 per step: see `kreps.envs.RandomRestart`.

    ## Arguments

    `render_mode`: `None` or `"rgb_array"`.

    `dry_friction`: Coulomb friction at the joint in N m, 0 by default.  At rest it balances all
    other torques up to its size; in motion it opposes the motion with its size.

    `jitter`: in [0, 1), 0 by default.  Each control period is drawn uniformly from
    `(1 - jitter) dt` to `(1 + jitter) dt` with `dt = 0.05 s`; `info["time"]` has the time since
    the start in s.  Neither the noise on the torque nor the reward of a step depend on it.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> env = gym.make("kreps/SwingUp-v0", render_mode="rgb_array")

    ```

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (declared so by gymnasium.Env)
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / TIME_STEP),
        "dt": TIME_STEP,
        "periodic_coordinates": (0,),
        "observation_labels": ("angle from upright [rad]", "angular velocity [rad/s]"),
        "action_labels": ("torque [N m]",),
    }
    batch_model = SwingUpBatch()

    def __init__(
        self, render_mode: str | None = None, dry_friction: float = 0.0, jitter: float = 0.0
    ) -> None:
        if dry_friction or jitter:
            self.batch_model = SwingUpBatch(dry_friction, jitter)
        low, high = np.array([-0.5 * np.pi, -np.inf]), np.array([1.5 * np.pi, np.inf])
        super().__init__(
            render_mode,
            gym.spaces.Box(low, high, dtype=np.float64),
            gym.spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), dtype=np.float64),
        )

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        tip = np.array([-np.sin(state[0]), np.cos(state[0])])
        canvas = Canvas(extent=1.25)
        canvas.disc((0.0, 0.0), 1.0, (0.95, 0.95, 0.96))
        canvas.rod((0.0, 0.0), tip, 0.09, (0.16, 0.38, 0.64))
        canvas.disc((0.0, 0.0), 0.045, (0.12, 0.12, 0.14))
        return canvas.pixels()
