"""Undiscounted returns over whole episodes, as the field reports them.

An episode is whole if the task ended it: by a termination, or by the time limit.  In a task without
either the process goes on for ever, and its rollouts have no return that would mean anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.data.rollouts import Rollouts
from kreps.kernels.arrays import default_errstate

LONGEST_EPISODE = 2000
"""Largest time limit to which an evaluation follows episodes by itself."""


@dataclass(frozen=True)
class EpisodicReturn:
    """The sum of the rewards of an episode.

    Attributes:
        mean: over all episodes.
        standard_error: of the mean; 0 if there is only one.
        length: mean number of steps.
        terminated: share of the episodes that ended by a termination.
        whole: share that the task ended; the others were cut, and lack what would have followed.
    """

    mean: float
    standard_error: float
    length: float
    terminated: float
    whole: float


def evaluated_steps(least: int, limit: int) -> int:
    """Steps of an evaluation: ``least``, or a longer time limit up to `LONGEST_EPISODE`.

    Args:
        least: that the average reward needs.
        limit: steps after which the environment truncates; ``sys.maxsize`` without a limit.
    """
    return limit if least < limit <= LONGEST_EPISODE else least


@default_errstate()
def episodic_return(
    rollouts: Rollouts, steps: int, limit: int, action_repeat: int = 1
) -> EpisodicReturn | None:
    """The return of rollouts without restarts; None if the task ended none of them.

    Args:
        rollouts: at least one.
        steps: of the environment after which a rollout was cut.
        limit: after which the environment truncates; ``sys.maxsize`` without a limit.
        action_repeat: steps of the environment for each action of the rollouts.  The one in which
            an episode terminates counts as a whole.
    """
    lengths = np.minimum(action_repeat * rollouts.lengths, limit)
    whole = rollouts.terminated | (lengths < steps) | (lengths >= limit)
    if not whole.any():
        return None
    returns = np.array([rollout.rewards.sum() for rollout in rollouts])
    count = len(returns)
    return EpisodicReturn(
        mean=float(returns.mean()),
        standard_error=float(returns.std(ddof=1) / np.sqrt(count)) if count > 1 else 0.0,
        length=float(lengths.mean()),
        terminated=float(rollouts.terminated.mean()),
        whole=float(whole.mean()),
    )
