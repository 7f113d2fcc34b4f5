"""How far a policy goes beyond recordings of another controller.

The recorded controller is estimated by a Gaussian process that is fitted to its states and actions,
all of the same weight.  The learnt policy is compared with it in the recorded states.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kreps.algorithms.dual import effective_sample_size
from kreps.algorithms.policy_targets import PolicyTargets, policy_hyperparameters
from kreps.data.history import stacked
from kreps.data.rollouts import Rollout, Rollouts, Transitions
from kreps.data.task import TaskSpec
from kreps.errors import DataError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.sampling import uniform_subsample
from kreps.models.transition import state_kernel
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

MAX_STEPS = 1_000
"""Steps that are looked at.  More do not change the shares; the cost is cubic."""

OUTSIDE = 2.0
"""Distance of an action from the mean of the recorded controller, in standard deviations of its
actions in that state, from which on it is outside the data."""


@dataclass(frozen=True)
class Extrapolation:
    """A policy beside the controller that made a recording, in the recorded states.

    Attributes:
        steps: number of recorded steps n.
        effective_samples: effective sample size of the steps under the policy, from 1 to n: by the
            ratios of the policy's probability density of each recorded action and the density
            under the recorded controller.  So many steps show what the policy does.
        outside: share of the states in which the policy's action without noise is outside the
            data, more than `OUTSIDE` standard deviations from what the recorded controller does
            there.  What follows such an action is predicted and was not observed.
    """

    steps: int
    effective_samples: float
    outside: float

    def __str__(self) -> str:
        return (
            f"the policy takes actions outside the data in {self.outside:.0%} of the recorded "
            f"states; {self.effective_samples:.0f} of {self.steps} recorded steps are effective "
            "samples of what it does"
        )


def extrapolation_of(
    policy: CostSensitiveGP | SparseGP, rollouts: Iterable[Rollout], rng: np.random.Generator
) -> Extrapolation:
    """The extrapolation of a policy from some rollouts.

    Args:
        policy: the learnt one.
        rollouts: at least one step, of the recorded controller.
        rng: draws the steps that are looked at, of more than `MAX_STEPS`.

    Raises:
        DataError: no rollout, or widths that are not the task's.
    """
    task, flat = policy.task, Rollouts.from_list(rollouts)
    if not flat:
        raise DataError("there is no rollout to compare the policy with; give at least one")
    flat.check(task)
    data = stacked(flat, task).transitions
    seen = data.rows(uniform_subsample(len(data), rng, MAX_STEPS))
    recorded = recorded_controller(seen, task, rng)
    states, scale = seen.states, task.action_scale
    mean, std = recorded.greedy(states), recorded.standard_deviation(states)
    distance = np.abs(task.clip(policy.greedy(states)) - mean) / np.maximum(std, 1e-9 * scale)
    ratios = _log_density(policy, seen) - _log_density(recorded, seen)
    weights = np.exp(ratios - ratios.max())
    share = effective_sample_size(weights / weights.sum()) / len(seen)
    outside = float((distance > OUTSIDE).any(axis=1).mean())
    return Extrapolation(len(data), share * len(data), outside)


def recorded_controller(
    data: Transitions, task: TaskSpec, rng: np.random.Generator
) -> CostSensitiveGP:
    """The Gaussian process policy that is fitted to n recorded actions of equal weight."""
    kernel = state_kernel(data, task, rng)
    targets = PolicyTargets.from_samples(data, np.full(len(data), 1.0 / len(data)), task)
    x = policy_hyperparameters(targets, kernel, "map", None, rng)
    signal, noise = np.exp(x[-2:])
    return CostSensitiveGP(
        task,
        kernel.with_lengthscales(np.exp(x[:-2])),
        targets.states,
        targets.targets,
        targets.weights,
        float(signal),
        float(noise),
    )


def _log_density(policy: CostSensitiveGP | SparseGP, data: Transitions) -> FloatArray:
    """Log densities (n,) of the recorded actions under a policy, up to a constant."""
    std = policy.standard_deviation(data.states)
    z = (data.actions - policy.greedy(data.states)) / std
    found: FloatArray = np.sum(-0.5 * z**2 - np.log(std), axis=1)
    return found
