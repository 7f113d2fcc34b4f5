"""The swing-up observed as images (Sec. 4.5): 800 pixel values, neither angle nor velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.envs.base import BatchEnvironment
from kreps.envs.swing_up import MAX_TORQUE, SwingUp, SwingUpBatch
from kreps.kernels.arrays import BoolArray, FloatArray

PIXELS = 20  # along each side
EXTENT = 1.2  # m: the image is of [-EXTENT, EXTENT]^2
BLUR = 0.3  # m
ROD = 1.0  # m, as it is drawn

_AXIS = np.linspace(-EXTENT, EXTENT, PIXELS)
_X, _Y = (a.ravel() for a in np.meshgrid(_AXIS, -_AXIS))


def image(theta: FloatArray) -> FloatArray:
    """Grey images (m, 400) of the rod at angles (m,): ``exp(-d^2 / (2 blur^2))`` at distance d."""
    along_x, along_y = -np.sin(theta)[:, None], np.cos(theta)[:, None]
    share = np.clip(_X * along_x + _Y * along_y, 0.0, ROD)
    squares = (_X - share * along_x) ** 2 + (_Y - share * along_y) ** 2
    return np.exp(-0.5 * squares / BLUR**2)


@dataclass(frozen=True)
class ImageSwingUpBatch:
    """The swing-up for m rollouts at once, observed as images.

    States (m, 3) are those of the swing-up, with jitter one more, and the angle one step earlier
    for the difference image.

    Attributes:
        dynamics: of the swing-up.
    """

    dynamics: SwingUpBatch = SwingUpBatch()  # noqa: RUF009 (it is immutable)

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        states = self.dynamics.initial(rngs)
        return np.column_stack([states, states[:, 0]])

    def observe(self, states: FloatArray) -> FloatArray:
        now = image(states[:, 0])
        return np.concatenate([now, now - image(states[:, -1])], axis=1)

    def time_stamps(self, states: FloatArray) -> FloatArray | None:
        return self.dynamics.time_stamps(states)

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        successors, rewards, done = self.dynamics.step(states[:, :-1], actions, rngs)
        return np.column_stack([successors, states[:, 0]]), rewards, done


class ImageSwingUp(BatchEnvironment):
    """
    ## Description

    The task of `kreps/SwingUp-v0`, observed by a camera of 20 x 20 pixels: the observation is the
    current image and its difference to the previous one, 800 numbers.  Dynamics, noise, rewards
    and starting state are those of `kreps/SwingUp-v0`.

    The camera has a field of view of [-1.2, 1.2]^2 m with a rod of length 1 m in it.  A pixel has
    the value `exp(-d^2 / (2 * 0.3^2))`, where `d` is its distance to the rod.

    ## Action Space

    The action is a `ndarray` with shape `(1,)`; commands beyond the limits are clipped.

    | Num | Action                   | Min   | Max  | Unit |
    |-----|--------------------------|-------|------|------|
    | 0   | Torque, counterclockwise | -30.0 | 30.0 | N m  |

    ## Observation Space

    The observation is a `ndarray` with shape `(800,)` and data type float64.
    `metadata["observation_groups"]` has the coordinates of each image, and
    `metadata["observation_image_shape"]` its height and width.

    | Num     | Observation                                          | Min | Max |
    |---------|------------------------------------------------------|-----|-----|
    | 0-399   | Image, row by row from the top left                  | 0   | 1   |
    | 400-799 | Image less the previous image, zero after a restart  | -1  | 1   |

    ## Rewards

    As in `kreps/SwingUp-v0`: `r = -10 theta^2 - 0.1 theta'^2 - 0.001 a^2`.

    ## Starting State

    Hanging at rest.

    ## Episode End

    The task never terminates and is never truncated.  The paper's protocol restarts it with
    probability 0.02 per step: see `kreps.envs.RandomRestart`.

    ## Arguments

    `render_mode`, `dry_friction` and `jitter` as in `kreps/SwingUp-v0`.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> env = gym.make("kreps/ImageSwingUp-v0", render_mode="rgb_array")

    ```

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (declared so by gymnasium.Env)
        "render_modes": ["rgb_array"],
        "render_fps": SwingUp.metadata["render_fps"],
        "dt": SwingUp.metadata["dt"],
        "observation_groups": (tuple(range(PIXELS**2)), tuple(range(PIXELS**2, 2 * PIXELS**2))),
        "observation_image_shape": (PIXELS, PIXELS),
        "action_labels": SwingUp.metadata["action_labels"],
    }
    batch_model = ImageSwingUpBatch()

    def __init__(
        self, render_mode: str | None = None, dry_friction: float = 0.0, jitter: float = 0.0
    ) -> None:
        if dry_friction or jitter:
            self.batch_model = ImageSwingUpBatch(SwingUpBatch(dry_friction, jitter))
        low = np.repeat([0.0, -1.0], PIXELS**2)
        super().__init__(
            render_mode,
            gym.spaces.Box(low, np.ones(2 * PIXELS**2), dtype=np.float64),
            gym.spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), dtype=np.float64),
        )

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        grey = image(state[:1]).reshape(PIXELS, PIXELS)
        pixels = np.round(255.0 * np.kron(grey, np.ones((12, 12)))).astype(np.uint8)
        return np.repeat(pixels[..., None], 3, axis=2)
