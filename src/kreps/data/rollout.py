"""One rollout as users build it."""

from __future__ import annotations

from dataclasses import dataclass, fields

from kreps.errors import DataError
from kreps.intake import as_numbers, as_rows, as_times, ended_by
from kreps.kernels.arrays import FloatArray

DROP = "drop the rollout, or cut it before that step"
"""What to do about numbers that are not finite, in messages."""


def read_only(values: FloatArray) -> FloatArray:
    """The same array, which can no longer be changed."""
    values.flags.writeable = False
    return values


@dataclass(frozen=True, eq=False)
class Rollout:
    """One rollout of ``T >= 1`` steps.

    Arrays are checked and copied when it is made, so that a reused buffer cannot change it.

    Attributes:
        observations: (T + 1, ds); row t + 1 is the successor of row t.  The last row is the
            successor of the last step, observed before any restart.  Observations of more axes are
            flattened.
        actions: (T, da) as the policy commanded them, before clipping.  Those of more axes are
            flattened, and those of one coordinate may be given as (T,).
        rewards: (T,).
        terminated: whether the task ended with the last step.  False if the rollout was only cut
            off, by a restart or a time limit.  It may be given as a flag for each step, (T,).
        times: (T + 1,) time stamp of each observation in s, increasing; None where control periods
            are constant or not known.  They are kept with the rollout; no update uses them.

    Raises:
        DataError: wrong shapes, no step at all, NaN or infinities, masked values, numbers or flags
            that are none, times that do not increase.
    """

    observations: FloatArray
    actions: FloatArray
    rewards: FloatArray
    terminated: bool = False
    times: FloatArray | None = None

    def __post_init__(self) -> None:
        for name in ("observations", "actions", "rewards"):
            values = as_rows(name, as_numbers(name, getattr(self, name), DROP))
            object.__setattr__(self, name, read_only(values))
        steps = len(self.rewards)
        if steps == 0:
            raise DataError("the rollout has no step; leave empty rollouts out")
        if len(self.actions) != steps or len(self.observations) != steps + 1:
            raise DataError(
                f"{len(self.observations)} observations, {len(self.actions)} actions and {steps} "
                "rewards do not fit together: T rewards need T actions and T + 1 observations "
                "(the last one is the successor of the last step)"
            )
        object.__setattr__(self, "terminated", ended_by(self.terminated, steps))
        if self.times is not None:
            object.__setattr__(self, "times", read_only(as_times(self.times, steps)))

    @classmethod
    def view(cls, *values: FloatArray | bool | None) -> Rollout:
        """A rollout of its fields in order, which are neither copied nor checked again."""
        made = object.__new__(cls)
        for field, value in zip(fields(cls), values, strict=True):
            object.__setattr__(made, field.name, value)
        return made

    def __len__(self) -> int:
        """Number of steps T."""
        return len(self.rewards)

    @property
    def widths(self) -> tuple[int, int]:
        """``(ds, da)``."""
        return self.observations.shape[1], self.actions.shape[1]
