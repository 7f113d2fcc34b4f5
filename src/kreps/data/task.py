"""The specification of a task: sizes and limits of observations and actions."""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from math import ceil
from numbers import Integral, Real
from typing import Any

import numpy as np

from kreps.checks import MAX_ACTION_REPEAT, MAX_LAGS, MAX_WHOLE_NUMBER
from kreps.data.spaces import Spaces
from kreps.errors import ConfigurationError, DataError, NumericalError, shown
from kreps.intake import as_array, is_sane
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Factor, Periodic, SquaredExponential, factors_of

MAX_LENGTHSCALES = 3000
"""Largest number of lengthscales: a fit holds the distances of 200 samples for each, which are 0.9
GiB."""

MAX_IMAGE_SIDE = 1024
"""Pixels per side of an image: smoothing costs their square in memory and their cube in time."""

PERIODS = 1e-6, 1e6
"""Shortest and longest control period, in s."""


def is_period(value: Any) -> bool:
    """Whether a value can be a control period in s."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    return number and PERIODS[0] <= float(value) <= PERIODS[1]


def _of_changes(factor: Any, first: int) -> Factor:
    """The factor of the changes of some columns of the observation, the first one at ``first``."""
    dims = tuple(first + i for i in factor.dims)
    if isinstance(factor, Periodic):  # a change of an angle is no angle
        return SquaredExponential(dims)
    shifted: Factor = replace(factor, dims=dims)
    return shifted


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """What is given of a task; dynamics and rewards are learnt from samples.

    Attributes:
        observation_size: number of coordinates ds of an observation.
        action_low, action_high: (da,) finite limits of the actions, in the task's units.
        periodic: the observation coordinates that are angles in rad (period 2 pi).
        groups: observation coordinates that share a lengthscale, such as the pixels of an image.
            A coordinate in no group has its own lengthscale.
        image_shape: (height, width) if the groups are images, each row by row from the top; then
            every coordinate must belong to an image.
        spaces: how the environment gives observations and takes actions; None: observations (ds,)
            and actions (da,) of float64.
        dt: control period in s; None if it is not known.
        time_limit: steps after which an episode is truncated; None if there is no limit, or none
            that is known.
        action_repeat: steps of the environment for which an action is held.  What a learner calls a
            step is then so many of them, with the sum of their rewards.  ``dt`` and ``time_limit``
            are about single ones.
        delay: steps by which an action takes effect later, or by which an observation arrives
            later, or the sum of both.  The state of the learner then has the last ``delay``
            applied actions beside the observation.
        history: steps of which the state has observation and applied action, beside the newest
            observation (`kreps.data.history`).  Both are in steps of the learner.

    Raises:
        ConfigurationError: sizes, limits or coordinates that are impossible or contradict each
            other.
    """

    observation_size: int
    action_low: FloatArray
    action_high: FloatArray
    periodic: tuple[int, ...] = ()
    groups: tuple[tuple[int, ...], ...] = ()
    image_shape: tuple[int, int] | None = None
    spaces: Spaces | None = None
    dt: float | None = None
    time_limit: int | None = None
    action_repeat: int = 1
    delay: int = 0
    history: int = 0

    def __post_init__(self) -> None:
        try:
            for name in ("action_low", "action_high"):
                limits = as_array(name, getattr(self, name))
                object.__setattr__(self, name, np.array(limits, np.float64, ndmin=1))
        except DataError as error:
            raise ConfigurationError(str(error)) from error
        try:
            periodic = tuple(sorted({operator.index(i) for i in self.periodic}))
            object.__setattr__(self, "periodic", periodic)
            object.__setattr__(self, "observation_size", operator.index(self.observation_size))
            groups = tuple(tuple(sorted({operator.index(i) for i in g})) for g in self.groups)
            object.__setattr__(self, "groups", tuple(g for g in groups if g))
        except TypeError as error:
            raise ConfigurationError(
                f"observation_size = {self.observation_size!r} and periodic = {self.periodic!r}, "
                "but a whole number and a list of whole numbers are needed, as 3 and (0, 2)"
            ) from error
        self._check_sizes()
        self._check_time()
        if self.spaces is not None and self.spaces.sizes != self.sizes:
            raise ConfigurationError(
                f"its spaces have {self.spaces.sizes} coordinates of observations and actions, the "
                f"task {self.sizes}; leave spaces out, or give those of the environment"
            )
        self._check_groups()
        if self.image_shape is not None:
            self._check_images(self.image_shape)
        if self.factor_count > MAX_LENGTHSCALES:
            raise ConfigurationError(
                f"the {self.state_size} coordinates of a state have "
                f"{self.factor_count} lengthscales, but at most {MAX_LENGTHSCALES} can be fitted; "
                "give the pixels of an image one, by groups and image_shape of a TaskSpec, or by "
                'the metadata "observation_groups" and "observation_image_shape" of an '
                "environment; or observe fewer coordinates, or fewer earlier ones (history)"
            )

    def _check_sizes(self) -> None:
        if self.observation_size < 1:
            raise ConfigurationError(
                f"observation_size = {self.observation_size}, but at least one coordinate is needed"
            )
        low, high = self.action_low, self.action_high
        if low.ndim != 1 or low.shape != high.shape or low.size == 0:
            raise ConfigurationError(
                f"action limits have shapes {low.shape} and {high.shape}; "
                "give two vectors of the same positive length"
            )
        if not (is_sane(low).all() and is_sane(high).all() and (low < high).all()):
            raise ConfigurationError(
                f"action limits {low} to {high} must be finite and low < high, as their range is "
                "the scale of the actions; give a bounded range"
            )

    def _check_time(self) -> None:
        if self.dt is not None:
            if not is_period(self.dt):
                raise ConfigurationError(
                    f"dt = {shown(self.dt)}, but it must be a control period in s, from "
                    f"{PERIODS[0]:g} to {PERIODS[1]:g}, or None if it is not known"
                )
            object.__setattr__(self, "dt", float(self.dt))
        if self.time_limit is not None:
            self._check_steps("time_limit", MAX_WHOLE_NUMBER, ", or None if there is no limit")
        self._check_steps("action_repeat", MAX_ACTION_REPEAT)
        self._check_steps("delay", MAX_LAGS, least=0)
        self._check_steps("history", MAX_LAGS, least=0)

    def _check_steps(self, name: str, most: int, otherwise: str = "", least: int = 1) -> None:
        steps = getattr(self, name)
        whole = isinstance(steps, Integral) and not isinstance(steps, bool)
        if not (whole and least <= steps <= most):
            raise ConfigurationError(
                f"{name} = {shown(steps)}, but it must be a whole number of steps from {least} to "
                f"{most}{otherwise}"
            )
        object.__setattr__(self, name, int(steps))

    def _check_groups(self) -> None:
        grouped = [i for group in self.groups for i in group]
        outside = [i for i in (*self.periodic, *grouped) if not 0 <= i < self.observation_size]
        if outside:
            raise ConfigurationError(
                f"periodic or grouped coordinates {outside!s:.60} do not exist; observations have "
                f"{self.observation_size} coordinates, numbered from 0"
            )
        if len(set(grouped)) < len(grouped):
            raise ConfigurationError(
                "a coordinate is in two groups, but can have only one lengthscale; leave it out of "
                "one of them"
            )
        angles = set(self.periodic)
        mixed = [g for g in self.groups if 0 < len(angles.intersection(g)) < len(g)]
        if mixed:
            raise ConfigurationError(
                f"the group {mixed[0]!s:.60} mixes angles and other coordinates, which cannot "
                "share a lengthscale; make a group of each"
            )

    def _check_images(self, shape: tuple[int, int]) -> None:
        try:
            height, width = (operator.index(size) for size in shape)
        except (TypeError, ValueError):
            height, width = 0, 0
        if not (1 <= height <= MAX_IMAGE_SIDE and 1 <= width <= MAX_IMAGE_SIDE):
            raise ConfigurationError(
                f"image_shape = {shape!r:.60}, but (height, width) is needed, two whole numbers "
                f"from 1 to {MAX_IMAGE_SIDE}"
            )
        object.__setattr__(self, "image_shape", (height, width))
        sizes = [len(group) for group in self.groups]
        if set(sizes) != {height * width} or sum(sizes) != self.observation_size:
            raise ConfigurationError(
                f"image_shape = {self.image_shape}, but the groups have {sizes!s:.60} of "
                f"{self.observation_size} coordinates; each group must be an image of {height} x "
                f"{width}, and each coordinate must be in a group"
            )

    @property
    def action_lags(self) -> int:
        """Number of earlier actions in a state."""
        return max(self.delay, self.history)

    @property
    def observed_size(self) -> int:
        """Number of coordinates of observation and earlier changes in a state, the first ones."""
        return self.observation_size * (1 + self.history)

    @property
    def state_size(self) -> int:
        """Number of coordinates ds of a state: observation, earlier changes, earlier actions."""
        return self.observed_size + self.action_size * self.action_lags

    @property
    def observation_factors(self) -> tuple[Factor, ...]:
        """The factors of a kernel over observations, each with one lengthscale."""
        return factors_of(self.observation_size, self.periodic, self.groups, self.image_shape)

    @property
    def state_factors(self) -> tuple[Factor, ...]:
        """The factors of a kernel over states, each with one lengthscale."""
        newest = self.observation_factors
        if self.state_size == self.observation_size:
            return newest
        starts = range(self.observation_size, self.observed_size, self.observation_size)
        earlier = (_of_changes(factor, start) for start in starts for factor in newest)
        actions = (SquaredExponential((i,)) for i in range(self.observed_size, self.state_size))
        return (*newest, *earlier, *actions)

    @property
    def factor_count(self) -> int:
        """Number of `state_factors`, without making them: in a damaged file it may be huge."""
        of_one = self.observation_size - sum(len(group) - 1 for group in self.groups)
        return of_one * (1 + self.history) + self.action_size * self.action_lags

    @property
    def observed_factors(self) -> int:
        """Number of `state_factors` that are not of earlier actions, the first ones."""
        return self.factor_count - self.action_size * self.action_lags

    @property
    def action_size(self) -> int:
        """Number of coordinates da of an action."""
        return len(self.action_low)

    @property
    def sizes(self) -> tuple[int, int]:
        """``(ds, da)``."""
        return self.observation_size, self.action_size

    @property
    def given_spaces(self) -> Spaces:
        """``spaces``, or those of vectors."""
        return self.spaces or Spaces((self.observation_size,), (self.action_size,))

    @property
    def decisions(self) -> int | None:
        """Largest number of decisions in an episode; None without a known time limit."""
        return None if self.time_limit is None else ceil(self.time_limit / self.action_repeat)

    def robot_seconds(self, steps: int) -> float | None:
        """Seconds that so many steps of the environment take, without the time of resets.

        The steps are single ones, as they are reported, however long an action is held.  None if
        ``dt`` is not known.
        """
        return None if self.dt is None else steps * self.dt

    @property
    def action_centre(self) -> FloatArray:
        """Middle of the range (da,)."""
        return 0.5 * (self.action_low + self.action_high)

    @property
    def action_scale(self) -> FloatArray:
        """Half the range (da,): actions in these units lie in [-1, 1] around the centre."""
        return 0.5 * (self.action_high - self.action_low)

    def scaled(self, actions: FloatArray) -> FloatArray:
        """Actions (m, da) relative to the centre, in units of the action scale."""
        return (actions - self.action_centre) / self.action_scale

    def unscaled(self, actions: FloatArray) -> FloatArray:
        """Scaled actions (m, da) converted to the task's units."""
        return self.action_centre + self.action_scale * actions

    def clip(self, actions: FloatArray) -> FloatArray:
        """The *applied* actions: the commanded ones, clipped to their limits.

        If the environment takes whole numbers, they are rounded to the nearest.

        Raises:
            NumericalError: one is NaN or infinite, so that no action can be applied.
        """
        if not np.isfinite(actions).all():
            raise NumericalError(
                "an action is NaN or infinite, so it is not applied: the numbers of the policy are "
                "out of range; load another copy of its file, or learn it again with observations "
                "and rewards in other units"
            )
        applied = np.clip(actions, self.action_low, self.action_high)
        return np.rint(applied) if self.spaces and self.spaces.whole_actions else applied

    def scaled_applied(self, actions: FloatArray) -> FloatArray:
        """The applied actions of the commanded ones (m, da), in units of the action scale."""
        return self.scaled(self.clip(actions))
