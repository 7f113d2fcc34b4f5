"""The swing-up observed as images, as the authors' scripts have it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.envs.authors.swing_up import MAX_COMMAND, AuthorsSwingUp, AuthorsSwingUpBatch
from kreps.envs.base import BatchEnvironment
from kreps.envs.image_swing_up import EXTENT, ImageSwingUp
from kreps.envs.swing_up import TIME_STEP
from kreps.kernels.arrays import BoolArray, FloatArray

RENDERED = 101  # pixels along each side, before the image is blurred and reduced
PIXELS = 20  # along each side of what is observed
HALF_WIDTH = 6.0  # rendered pixels, of the rod
BLUR = 0.2  # of the side, standard deviation
ROD = 1.0  # m, as it is drawn

_CENTRE = 0.5 * (RENDERED - 1)
_ROD_PIXELS = ROD / EXTENT * _CENTRE
_COLUMN, _ROW = (a.ravel() - _CENTRE for a in np.meshgrid(np.arange(RENDERED), np.arange(RENDERED)))


def _reduction() -> FloatArray:
    """(20, 101): blurred pixels of a row, outside of which the image goes on black, at 20 places.

    The places are the centres of 20 equal parts of the row.
    """
    places = (np.arange(PIXELS) + 0.5) * RENDERED / PIXELS - 0.5
    offsets = (places[:, None] - np.arange(RENDERED)) / (BLUR * RENDERED)
    return np.exp(-0.5 * offsets**2) / (BLUR * RENDERED * np.sqrt(2.0 * np.pi))


_REDUCTION = _reduction()


def image(theta: FloatArray) -> FloatArray:
    """Grey images (m, 400) of the rod at angles (m,), row by row from the top left."""
    along_x, along_y = -np.sin(theta)[:, None], -np.cos(theta)[:, None]  # rows count downwards
    share = np.clip(_COLUMN * along_x + _ROW * along_y, 0.0, _ROD_PIXELS)
    squares = (_COLUMN - share * along_x) ** 2 + (_ROW - share * along_y) ** 2
    rendered = (squares < HALF_WIDTH**2 + 1e-6).astype(np.float64).reshape(-1, RENDERED, RENDERED)
    return (_REDUCTION @ rendered @ _REDUCTION.T).reshape(len(theta), PIXELS**2)


@dataclass(frozen=True)
class AuthorsImageSwingUpBatch:
    """The task for m rollouts at once; states (m, 2) and dynamics are those of the swing-up."""

    dynamics: AuthorsSwingUpBatch = AuthorsSwingUpBatch()  # noqa: RUF009 (it is immutable)

    def initial(self, rngs: Sequence[np.random.Generator]) -> FloatArray:
        return self.dynamics.initial(rngs)

    def observe(self, states: FloatArray) -> FloatArray:
        now, before = image(states[:, 0]), image(states[:, 0] - TIME_STEP * states[:, 1])
        return np.concatenate([now, now - before], axis=1)

    def step(
        self, states: FloatArray, actions: FloatArray, rngs: Sequence[np.random.Generator]
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        return self.dynamics.step(states, actions, rngs)


class AuthorsImageSwingUp(BatchEnvironment):
    """
    ## Description

    The task of `kreps/AuthorsSwingUp-v0`, observed by a camera of 20 x 20 pixels as the authors'
    scripts have it: the current image, and its difference to the image of the angle
    `theta - 0.05 theta'`, which stands for the previous one.

    The rod is rendered white on black in 101 x 101 pixels of [-1.2, 1.2]^2 m, 1 m long and with a
    half-width of 6 pixels; the image is smoothed by a Gaussian with a standard deviation of 20 % of
    its side and reduced to 20 x 20 pixels.  The images are blurred, so that no further smoothing is
    needed: a kernel compares them pixel by pixel, with one lengthscale per image.

    ## Action Space

    As in `kreps/AuthorsSwingUp-v0`: the commanded torque, from -50 to 50 N m.

    ## Observation Space

    The observation is a `ndarray` with shape `(800,)` and data type float64.
    `metadata["observation_groups"]` has the coordinates of each image.

    | Num     | Observation                               | Min | Max |
    |---------|-------------------------------------------|-----|-----|
    | 0-399   | Image, row by row from the top left       | 0   | 1   |
    | 400-799 | Image less that of `theta - 0.05 theta'`  | -1  | 1   |

    ## Rewards, Starting State, Episode End

    As in `kreps/AuthorsSwingUp-v0`.

    ## Arguments

    `render_mode`: `None` or `"rgb_array"`.

    ```python
    >>> import gymnasium as gym
    >>> import kreps
    >>> env = gym.make("kreps/AuthorsImageSwingUp-v0", render_mode="rgb_array")

    ```

    ## Version History

    * v0: Initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (declared so by gymnasium.Env)
        "render_modes": ["rgb_array"],
        "render_fps": AuthorsSwingUp.metadata["render_fps"],
        "dt": AuthorsSwingUp.metadata["dt"],
        "observation_groups": ImageSwingUp.metadata["observation_groups"],
        "action_labels": AuthorsSwingUp.metadata["action_labels"],
    }
    batch_model = AuthorsImageSwingUpBatch()

    def __init__(self, render_mode: str | None = None) -> None:
        low = np.repeat([0.0, -1.0], PIXELS**2)
        super().__init__(
            render_mode,
            gym.spaces.Box(low, np.ones(2 * PIXELS**2), dtype=np.float64),
            gym.spaces.Box(-MAX_COMMAND, MAX_COMMAND, (1,), dtype=np.float64),
        )

    def picture(self, state: FloatArray) -> NDArray[np.uint8]:
        grey = image(state[:1]).reshape(PIXELS, PIXELS)
        bright = grey / grey.max()
        pixels = np.round(255.0 * np.kron(bright, np.ones((12, 12)))).astype(np.uint8)
        return np.repeat(pixels[..., None], 3, axis=2)
