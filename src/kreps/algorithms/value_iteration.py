"""Value iteration with RKHS embeddings (Gruenewaelder et al. 2012), the greedy rival of Sec. 4.2.

``Q(s, a) = sum_i beta_i(s, a) (r_i + gamma V(s'_i))`` with the embedding strengths beta of Eq. 4
and V the maximum of Q over candidate actions, or a soft maximum on-policy, iterated to a
fixed point.  The process restarts with probability p, hence ``gamma = 1 - p``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.algorithms.dual import standardise
from kreps.algorithms.state import LearnerState, Stopwatch, exact_transitions
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray, grid_points
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.regression import KernelEmbedding
from kreps.models.transition import fit_embedding, state_kernel, successor_features
from kreps.policies.value_based import SoftmaxPolicy, soft_maximum
from kreps.settings import RKHS, GridValueIterationSettings, ValueIterationSettings

MAX_SWEEPS = 300
"""0.98^300 is 0.2 %: what is then left moves no action."""

TOLERANCE = 1e-3
"""Of V between sweeps, up to a constant, in standard deviations of the reward."""

BASIS = RKHS()
"""Its basis is that of the features that the embedding is fitted to predict: as in REPS."""


@dataclass(frozen=True)
class ValueIterationInfo:
    """What is only reported of an update.

    Attributes:
        samples: n.
        sweeps: of value iteration.
        change: of V in the last sweep, up to a constant, in standard deviations of the reward.
        embedding_parameters: fitted lengthscales and lambda.
        seconds: CPU seconds by stage.
    """

    samples: int
    sweeps: int
    change: float
    embedding_parameters: FloatArray
    seconds: dict[str, float]

    @property
    def converged(self) -> bool:
        return self.change <= TOLERANCE

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        return {"sweeps": self.sweeps, "change": self.change}

    def shown(self) -> dict[str, str]:
        """What a progress display shows, by column."""
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
) -> tuple[LearnerState, ValueIterationInfo]:
    """A policy from the window's transitions; nothing is modified.

    Raises:
        DataError: no roll-outs at all, or some of another width than the task's.
    """
    window = state.append(rollouts)
    data = exact_transitions(window)
    clock = Stopwatch()
    kernel = state_kernel(data, task, rng)
    _, features = RKHSBasis.fit(
        kernel, data.points, tolerance=BASIS.tolerance, max_rank=BASIS.max_rank
    )
    clock.lap("basis")
    model, start = fit_embedding(
        data, successor_features(data, features), kernel, task, state.embedding_start, rng
    )
    clock.lap("embedding")
    rewards, unit = standardise(data.rewards)
    candidates = candidate_actions(task, settings.actions)
    table, offset, sweeps, change = iterate_values(
        model, data, rewards, candidates, settings.temperature, 1.0 - settings.restart_probability
    )
    clock.lap("sweeps")
    policy = SoftmaxPolicy(
        task,
        model.kernel.part(slice(-task.action_size)),
        data.states,
        unit * table,
        unit * offset + float(data.rewards.max()) / settings.restart_probability,
        candidates,
        unit * settings.temperature,
    )
    new_state = state.after(
        len(rollouts), sum(map(len, rollouts)), window, policy=policy, embedding_start=start
    )
    info = ValueIterationInfo(len(data), sweeps, change, np.exp(start), clock.seconds)
    return new_state, info


def candidate_actions(task: TaskSpec, count: int) -> FloatArray:
    """At most ``count`` evenly spaced scaled actions (k, da), limits included.

    Raises:
        ConfigurationError: not even the limits of every action coordinate fit.
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
    candidates: FloatArray,
    temperature: float,
    gamma: float,
) -> tuple[FloatArray, float, int, float]:
    """The fixed point of ``Q(s, a) = sum_i beta_i(s, a) (r_i + gamma V(s'_i))``.

    The strengths beta need not add up to one, so that far from the data a sum over them fades to
    zero: they are applied to the targets less their mean, to which Q then fades.

    Args:
        model: on states and scaled actions, as it was fitted to ``data``.
        data: n transitions.
        rewards: (n,), standardised.
        candidates: (k, da) scaled actions.
        temperature: of the soft maximum; zero for the maximum.
        gamma: discount.

    Returns:
        Table (n, k) and offset with ``Q(s, a_k) = offset + sum_i k_s(s_i, s) table_ik``, sweeps
        made, and the change of V (up to a constant) in the last one.
    """
    ds, da = data.points.shape[1], candidates.shape[1]
    # the kernel's last factors are those of the actions, one for each coordinate
    states = model.kernel.part(slice(-da)).gram(data.states, data.points).T  # (points, n)
    in_their_columns = np.pad(candidates, ((0, 0), (ds, 0)))
    actions = model.kernel.part(slice(-da, None)).gram(model.inputs, in_their_columns)  # (n, k)
    least, most = rewards.min() / (1.0 - gamma), rewards.max() / (1.0 - gamma)
    values = np.zeros(len(data.points))
    sweeps = 0
    while True:
        sweeps += 1
        targets = rewards + gamma * successor_features(data, values)
        offset = float(targets.mean())
        table = model.factor.solve(targets - offset)[:, None] * actions
        # what rewards in this range can add up to bounds an expectation that is none
        fresh = np.clip(soft_maximum(offset + states @ table, temperature), least, most)
        difference = fresh - values
        change = float(difference.max() - difference.min())
        values = fresh
        if change <= TOLERANCE or sweeps == MAX_SWEEPS:
            # differences of V have settled; its level goes on by a geometric series
            offset += float(difference.mean()) * gamma / (1.0 - gamma)
            return table, offset, sweeps, change
