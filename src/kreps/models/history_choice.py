"""How many earlier observations and actions a state needs, from the held-out error of predictions.

For each candidate the change of the observation and the reward are regressed on its states and the
actions.  The error is that of cross-validation over rollouts.  Of the candidates that are about as
good as the best one, the one whose states have the fewest coordinates is chosen: each coordinate
that is not needed makes all samples less alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kreps.data.history import stacked
from kreps.data.rollouts import Rollouts, Transitions
from kreps.data.task import MAX_LENGTHSCALES, TaskSpec
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.regression import KernelEmbedding
from kreps.kernels.sampling import uniform_subsample
from kreps.models.dynamics import CONSTANT_RTOL, linear_least_squares, state_changes
from kreps.models.reward_model import regressed_steps
from kreps.models.transition import embedding_hyperparameters, state_actions, state_kernel

MAX_STEPS = 500
"""Steps of which predictions are computed.  More do not change the choice; the cost is cubic."""

FOLDS = 5
"""Parts of the rollouts, each of which is predicted from the others."""

MAX_LAG, STEPS_PER_LAG = 6, 8
"""Largest delay that is looked for, in steps, and number of steps of a mean rollout for each."""

MAX_HISTORY = 3
"""Largest number of earlier observations.  Two determine position and velocity; more only average
noise."""

MIN_GAIN = 0.5
"""Part by which the squared error has to fall for states of more coordinates.  Where these are
needed it soon falls to a fifth or less.  Fits of the same quality differ by up to a third."""

MIN_EXCESS = 0.002
"""Smallest fall of the squared error, as a share of the variance that is predicted: a model whose
errors are a twentieth of a standard deviation is good enough."""


@dataclass(frozen=True)
class HeldOut:
    """The held-out error of one candidate.

    Attributes:
        delay, history: of the candidate (`TaskSpec`).
        errors: (n,) squared errors of the predictions of n steps, the mean over the coordinates of
            the observation and the reward, each relative to its mean square; one is no better than
            the average.
        rollout: (n,) that each step belongs to.
    """

    delay: int
    history: int
    errors: FloatArray
    rollout: IntArray

    @property
    def relative(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(self.errors.mean()))

    @property
    def mean(self) -> float:
        """Mean square error."""
        return float(self.errors.mean())

    def standard_error(self, other: HeldOut) -> float:
        """Of the difference of two mean square errors, from those of the rollouts.

        Errors within a rollout are correlated.
        """
        difference = self.errors - other.errors
        scatter = np.bincount(self.rollout, difference - difference.mean())
        count = len(np.unique(self.rollout))
        return float(np.sqrt(scatter @ scatter * count / max(count - 1, 1))) / len(difference)

    def is_worse(self, best: HeldOut) -> bool:
        """Whether the error is clearly larger than the smallest one."""
        excess = self.mean - best.mean
        least = max(MIN_GAIN * self.mean, MIN_EXCESS, self.standard_error(best))
        return excess > least


@dataclass(frozen=True)
class HistoryChoice:
    """The choice, and the errors on which it is based.

    Attributes:
        chosen: the candidate.
        none: the one of the smallest states: observations alone, with the actions of a delay that
            is given.
        all: of all candidates, those of small states first.
    """

    chosen: HeldOut
    none: HeldOut
    all: tuple[HeldOut, ...]

    def __str__(self) -> str:
        """What was chosen and why, in one line."""
        if self.chosen is self.none:
            best = min(self.all, key=lambda each: each.mean)
            return (
                f"{described(self.none)}: with earlier steps the held-out error of predictions "
                f"would be {best.relative:.2g}, and is {self.none.relative:.2g}"
            )
        return (
            f"{described(self.chosen)}: the held-out error of predictions falls from "
            f"{self.none.relative:.2g} to {self.chosen.relative:.2g}"
        )


def described(candidate: HeldOut) -> str:
    """What the states of a candidate have."""
    actions = max(candidate.delay, candidate.history)
    if not actions:
        return "states are observations"
    plural = "" if actions == 1 else "s"
    if not candidate.history:
        return f"states have the last {actions} action{plural}"
    if candidate.history == actions:
        return f"states have observation and action of the last {actions} step{plural}"
    return f"states have the last {candidate.history} observations and {actions} actions"


def choose_history(
    rollouts: Rollouts, task: TaskSpec, least_delay: int, rng: np.random.Generator
) -> HistoryChoice | None:
    """The smallest delay and history with which predictions are about as good as with any other.

    A present one stays as long as no other is clearly better, and none of smaller states is as
    good: a choice that changes with chance would begin learning anew.

    Args:
        rollouts: that are predicted.
        task: with the present delay and history.
        least_delay: smallest delay that is considered.
        rng: chooses the steps that are predicted.

    Returns:
        None with fewer than two rollouts, of which none could be held out.
    """
    if len(rollouts) < 2:
        return None
    seed = int(rng.integers(2**63))  # the same steps for each
    length = rollouts.steps / len(rollouts)
    found = [
        held_out(rollouts, each, np.random.default_rng(seed))
        for each in candidates(replace(task, delay=least_delay, history=0), length)
    ]
    best = min(found, key=lambda each: each.mean)
    good = [each for each in found if not each.is_worse(best)]
    present = [each for each in good if (each.delay, each.history) == (task.delay, task.history)]
    if present:
        good = [each for each in good if each is present[0] or replaces(each, present[0], found)]
    return HistoryChoice(good[0], found[0], tuple(found))


def replaces(each: HeldOut, present: HeldOut, found: list[HeldOut]) -> bool:
    """Whether a candidate of smaller states takes the place of the present one.

    Its error is not larger; and the difference is clear, or the steps show that earlier ones are
    needed.  Where actions hardly vary, no step shows how late they take effect.
    """
    best = min(found, key=lambda each: each.mean)
    gain = present.mean - each.mean
    return gain >= 0.0 and (found[0].is_worse(best) or gain > present.standard_error(each))


def held_out(rollouts: Rollouts, task: TaskSpec, rng: np.random.Generator) -> HeldOut:
    """Errors of predictions of steps, by a model that has not seen their rollouts.

    Args:
        rollouts: at least two.
        task: with delay and history of the candidate.
        rng: chooses the steps.
    """
    whole = stacked(rollouts, task).transitions
    data = whole.rows(regressed_steps(whole))
    data = data.rows(uniform_subsample(len(data), rng, MAX_STEPS))
    inputs, targets = state_actions(data, task), _targets(data, task)
    left = targets - linear_least_squares(inputs, targets, task)(inputs)
    kernel, regulariser, _ = embedding_hyperparameters(
        inputs, left, state_kernel(data, task, rng), task, None, rng
    )
    fold, predicted = data.rollout % FOLDS, np.empty_like(targets)
    for part in np.unique(fold):
        test, train = fold == part, fold != part
        linear = linear_least_squares(inputs[train], targets[train], task)
        model = KernelEmbedding.fit(kernel, inputs[train], regulariser)
        predict = model.predictor(targets[train] - linear(inputs[train]))
        predicted[test] = linear(inputs[test]) + predict(inputs[test])
    errors = np.mean((targets - predicted) ** 2, axis=1)
    return HeldOut(task.delay, task.history, errors, data.rollout)


def _targets(data: Transitions, task: TaskSpec) -> FloatArray:
    """Changes of the observation and rewards of n transitions, (n, do + 1), of variance one.

    Those that are constant are zero.
    """
    changes = state_changes(data, task)[:, : task.observation_size]
    targets = np.column_stack([changes, data.rewards])
    targets = targets - targets.mean(axis=0)
    spread = targets.std(axis=0)
    size = np.abs(np.column_stack([data.states[:, : task.observation_size], data.rewards]))
    varies = spread > CONSTANT_RTOL * size.max(axis=0)
    return np.where(varies, targets / np.where(varies, spread, 1.0), 0.0)


def candidates(task: TaskSpec, length: float) -> list[TaskSpec]:
    """The task with each delay and history that is considered, those of small states first.

    Args:
        task: ``delay`` is the smallest one considered.
        length: mean length of a rollout.
    """
    lag = min(MAX_LAG, int(length / STEPS_PER_LAG))
    given = task.delay
    pairs = {(given + delay, 0) for delay in range(lag + 1)}
    pairs |= {(given, history) for history in range(min(lag, MAX_HISTORY) + 1)}
    factors, actions = task.factor_count - task.action_size * task.action_lags, task.action_size
    tasks = [
        replace(task, delay=delay, history=history)
        for delay, history in pairs
        if factors * (1 + history) + actions * max(delay, history) <= MAX_LENGTHSCALES
    ]
    return sorted(tasks, key=lambda each: (each.state_size, each.history))
