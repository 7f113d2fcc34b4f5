"""Value iteration with RKHS embeddings (Gruenewaelder et al. 2012), a baseline of Sec. 4.2.

``Q(s, a) = sum_i beta_i(s, a) (r_i + gamma V(s'_i))`` with the embedding strengths beta of Eq. 4.
V is the maximum of Q over candidate actions or, on-policy, a soft maximum.  Both are iterated to a
fixed point.  The process restarts with probability p, so the discount is ``gamma = 1 - p``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.algorithms.dual import standardise
from kreps.algorithms.hard_value_iteration import (
    RELATIVE_TOLERANCE,
    QFunction,
    RewardFunction,
    iterate_to_one_percent,
    known_rewards,
    relative_policy,
)
from kreps.algorithms.state import LearnerState, Stopwatch, exact_transitions
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray, grid_points
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.regression import KernelEmbedding
from kreps.models.rollout_folds import fit_embedding_by_folds, fitted_state_kernel
from kreps.models.transition import fit_embedding, state_kernel, successor_features
from kreps.policies.value_based import SoftmaxPolicy, soft_maximum
from kreps.settings import RKHS, GridValueIterationSettings, ValueIterationSettings

MAX_SWEEPS = 300
"""Largest number of sweeps.  With a discount of 0.98 they reduce the distance from the fixed point
to 0.2 %."""

CHANGE_TOLERANCE = 1e-3
"""Largest change of V in the last sweep, up to a constant, in standard deviations of the reward."""

BASIS = RKHS()
"""The features that the embedding predicts for its fit: those of V in KREPS by default."""


@dataclass(frozen=True)
class ValueIterationInfo:
    """Diagnostics of an update.

    Attributes:
        samples: n.
        sweeps: number of sweeps.
        change: of V in the last sweep: its range, in standard deviations of the reward; or, of the
            authors' value iteration, its norm as a share of that of V.
        tolerance: largest change that ends the sweeps.
        embedding_parameters: (g + da + 1,) fitted lengthscales and lambda.
        seconds: CPU seconds by stage.
    """

    samples: int
    sweeps: int
    change: float
    tolerance: float
    embedding_parameters: FloatArray
    seconds: dict[str, float]

    @property
    def converged(self) -> bool:
        """Whether V has settled to the tolerance."""
        return self.change <= self.tolerance

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        return {"sweeps": self.sweeps, "change": self.change}

    def shown(self) -> dict[str, str]:
        """The columns of a progress display."""
        return {
            "sweeps": f"{self.sweeps}",
            "change": f"{self.change:.0e}",
            "note": "" if self.converged else "NOT CONVERGED",
        }


def update(
    state: LearnerState,
    rollouts: Sequence[Rollout],
    task: TaskSpec,
    settings: ValueIterationSettings | GridValueIterationSettings,
    rng: np.random.Generator,
    known_reward: RewardFunction | None = None,
) -> tuple[LearnerState, ValueIterationInfo]:
    """A policy from all transitions of the replay window, new rollouts included.

    Args:
        state: of the learner before the update; it is not modified.
        rollouts: the new ones.
        task: limits and scale of the actions, and which coordinates are angles.
        settings: of the method.
        rng: draws the samples of the fits.
        known_reward: the reward function, if it is not learnt.

    Raises:
        DataError: no rollout at all, or one of another width than the task's.
        ConfigurationError: more samples than an exact update can take, too few candidate actions,
            or a known reward in which state and action are not separate.
    """
    window = state.append(rollouts)
    data = exact_transitions(window)
    clock = Stopwatch()
    rewards, unit = standardise(data.rewards)
    model, start = _embedding(data, rewards, task, settings, state, clock, rng)
    candidates = candidate_actions(task, settings.actions)
    gamma = 1.0 - settings.p
    policy: SoftmaxPolicy
    if settings.temperature_unit == "q":
        known = None
        if known_reward is not None:
            known = known_rewards(known_reward, data.points, task.unscaled(candidates))
        q = iterate_to_one_percent(model, data, known, candidates, gamma)
        policy = relative_policy(model, data, task, q, known, candidates, settings.temperature)
        tolerance = RELATIVE_TOLERANCE
    else:
        no_reward = -float(data.rewards.max()) / unit  # reward zero, standardised
        q = iterate_values(model, data, rewards, no_reward, candidates, settings.temperature, gamma)
        policy = SoftmaxPolicy(
            task,
            model.kernel.part(slice(-task.action_size)),
            data.states,
            unit * q.table,
            unit * q.offset + float(data.rewards.max()) / settings.p,
            candidates,
            unit * settings.temperature,
        )
        tolerance = CHANGE_TOLERANCE
    clock.lap("sweeps")
    new_state = state.after(
        len(rollouts), sum(map(len, rollouts)), window, policy=policy, embedding_start=start
    )
    info = ValueIterationInfo(
        len(data), q.sweeps, q.change, tolerance, np.exp(start), clock.seconds
    )
    return new_state, info


def _embedding(
    data: Transitions,
    rewards: FloatArray,
    task: TaskSpec,
    settings: ValueIterationSettings | GridValueIterationSettings,
    state: LearnerState,
    clock: Stopwatch,
    rng: np.random.Generator,
) -> tuple[KernelEmbedding, FloatArray]:
    """The embedding and its log hyper-parameters (g + da + 1,)."""
    folds = settings.cross_validation == "rollouts"
    kernel = state_kernel(data, task, rng)
    if folds:
        kernel = fitted_state_kernel(data, rewards, kernel, settings.p)
    _, features = RKHSBasis.fit(
        kernel, data.points, tolerance=BASIS.tolerance, max_rank=BASIS.max_rank
    )
    clock.lap("basis")
    targets = successor_features(data, features)
    if folds:
        found = fit_embedding_by_folds(data, targets, kernel, task)
    else:
        found = fit_embedding(data, targets, kernel, task, state.embedding_start, rng)
    clock.lap("embedding")
    return found


def candidate_actions(task: TaskSpec, count: int) -> FloatArray:
    """At most ``count`` evenly spaced scaled actions (k, da), limits included.

    Raises:
        ConfigurationError: ``count`` is smaller than the number of corners of the action space.
    """
    levels = int(count ** (1.0 / task.action_size) + 1e-9)
    if levels < 2:
        raise ConfigurationError(
            f"actions = {count}, but the limits of {task.action_size} action coordinates alone "
            f"make 2^{task.action_size} candidates; raise actions, or use kreps.KREPS, which has "
            "no grid"
        )
    return grid_points([np.linspace(-1.0, 1.0, levels)] * task.action_size)


def iterate_values(
    model: KernelEmbedding,
    data: Transitions,
    rewards: FloatArray,
    no_reward: float,
    candidates: FloatArray,
    temperature: float,
    gamma: float,
) -> QFunction:
    """The fixed point of ``Q(s, a) = sum_i beta_i(s, a) (r_i + gamma V(s'_i))``.

    After a termination there is no reward, so V(s') is then that of reward zero in each step.

    Far from the data the strengths beta vanish, and a sum over them would predict zero.  So they
    are applied to the targets less their mean, which Q approaches there.

    Args:
        model: embedding on states and scaled actions, fitted to ``data``.
        data: n transitions.
        rewards: (n,), standardised.
        no_reward: reward zero, standardised, of each step after a termination.
        candidates: (k, da) scaled actions.
        temperature: of the soft maximum; zero for the maximum.
        gamma: discount.
    """
    ds, da = data.points.shape[1], candidates.shape[1]
    # the kernel's last factors are those of the actions, one per coordinate
    states = model.kernel.part(slice(-da)).gram(data.states, data.points).T  # (points, n)
    padded = np.pad(candidates, ((0, 0), (ds, 0)))  # the factors select columns after the states
    actions = model.kernel.part(slice(-da, None)).gram(model.inputs, padded)  # (n, k)
    # Strengths may sum to more than one.  Returns beyond those of the extreme rewards are clipped,
    # or V could diverge.
    after_end, has_ends = no_reward / (1.0 - gamma), bool(data.terminated.any())
    range_of = np.append(rewards, no_reward) if has_ends else rewards
    min_return, max_return = range_of.min() / (1.0 - gamma), range_of.max() / (1.0 - gamma)
    values = np.zeros(len(data.points))
    sweeps = 0
    while True:
        sweeps += 1
        following = np.where(data.terminated, after_end, values[data.successor])
        targets = rewards + gamma * following
        offset = float(targets.mean())
        table = model.factor.solve(targets - offset)[:, None] * actions
        maxima = soft_maximum(offset + states @ table, temperature)
        new_values = np.clip(maxima, min_return, max_return)
        difference = new_values - values
        change = float(difference.max() - difference.min())
        values = new_values
        if change <= CHANGE_TOLERANCE or sweeps == MAX_SWEEPS:
            # the shape of V has converged; further sweeps would add a geometric series to its level
            mean_change = float(difference.mean())
            level = mean_change * gamma / (1.0 - gamma)
            if not has_ends:
                return QFunction(table, offset + level, sweeps, change)
            # the value after a termination does not move with the level, so it is compared again
            if abs(mean_change) <= CHANGE_TOLERANCE or sweeps == MAX_SWEEPS:
                return QFunction(table, offset, sweeps, change)
            values = np.clip(values + level, min_return, max_return)
