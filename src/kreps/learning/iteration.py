"""The report of one iteration of a learner, and the callbacks that get it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from kreps.errors import ConfigurationError


@dataclass(frozen=True)
class IterationReport:
    """Results of one iteration, as passed to callbacks.

    Attributes:
        iteration: number of updates, this one included.
        rollouts, steps: number of rollouts and environment steps so far.
        explorer_share: share of the new steps by the explorer.  The following numbers are of the
            new rollouts of the acting policy alone.
        average_reward: mean reward per environment step of the new rollouts.
        mean_return: mean sum of the rewards of a new rollout, which a restart may have cut.
        terminated: share of the new rollouts that ended by a termination.
        reward_quartiles: lower and upper quartile of the new rollouts' mean rewards per step, in
            which each rollout counts by its steps, as in the average.
        update: the method's own report of the update, with CPU seconds by stage.
        rollout_seconds: CPU seconds that collecting the new rollouts took.
        restart_probability: p of the new rollouts and of the update.
    """

    iteration: int
    rollouts: int
    steps: int
    explorer_share: float
    average_reward: float
    mean_return: float
    terminated: float
    reward_quartiles: tuple[float, float]
    update: Any
    rollout_seconds: float
    restart_probability: float


Callback = Callable[[Any, IterationReport], bool | np.bool | None]
"""Called with learner and report after each iteration; returning False stops learning early."""


def callbacks_of(given: Any) -> list[Callback]:
    """The callbacks of an argument of `Learner.learn`."""
    if given is None:
        return []
    try:
        callbacks = [given] if callable(given) else list(given)
    except TypeError:
        callbacks = [given]
    for each in callbacks:
        if not callable(each) or isinstance(each, type):
            raise ConfigurationError(
                f"callback = {each!r:.60}, but it must be a function of learner and report, a list "
                "of them, or None"
                + ("; this is a class, so give an object of it" if isinstance(each, type) else "")
            )
        try:
            inspect.signature(each).bind(None, None)
        except ValueError:  # a function of C without a signature
            continue
        except TypeError as error:
            raise ConfigurationError(
                f"callback = {each!r:.60} cannot be called with learner and report ({error}); give "
                "it these two arguments"
            ) from error
    return callbacks


def is_false(answer: Any) -> bool:
    """Whether a callback returned False: Python's, NumPy's, or that of another array library."""
    if getattr(answer, "ndim", None) == 0:
        answer = answer.item()
    return answer is False
