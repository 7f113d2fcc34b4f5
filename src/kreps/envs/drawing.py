"""Anti-aliased discs and rods for ``rgb_array`` rendering.

The coverage of a pixel is computed from the distance of its centre to a line segment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.kernels.arrays import FloatArray, as_float


class Canvas:
    """A square picture of ``[-extent, extent]^2`` metres, white at first, with y upwards.

    Args:
        extent: half the side, in metres.
        size: pixels per side.
    """

    def __init__(self, extent: float, size: int = 240) -> None:
        self._pixel = 2.0 * extent / size
        axis = (np.arange(size) + 0.5) * self._pixel - extent
        self._x, self._y = np.meshgrid(axis, -axis)
        self._colours = np.ones((size, size, 3))

    def disc(self, centre: Sequence[float], radius: float, colour: Sequence[float]) -> None:
        """Draw a disc; arguments as for `rod`."""
        self.rod(centre, centre, radius, colour)

    def rod(self, start: Any, end: Any, radius: float, colour: Sequence[float]) -> None:
        """Draw a line segment with round ends.

        Args:
            start, end: (2,) in metres.
            radius: half its width, in metres.
            colour: (3,) red, green and blue, 0 to 1.
        """
        start, along = as_float(start), as_float(end) - as_float(start)
        x, y = self._x - start[0], self._y - start[1]
        length = max(float(along @ along), 1e-12)
        share = np.clip((x * along[0] + y * along[1]) / length, 0.0, 1.0)
        distance = np.hypot(x - share * along[0], y - share * along[1])
        self._blend(np.clip((radius - distance) / self._pixel + 0.5, 0.0, 1.0), colour)

    def _blend(self, cover: FloatArray, colour: Sequence[float]) -> None:
        self._colours += cover[..., None] * (as_float(colour) - self._colours)

    def pixels(self) -> NDArray[np.uint8]:
        """The picture (size, size, 3), values 0 to 255."""
        return np.round(255.0 * self._colours).astype(np.uint8)
