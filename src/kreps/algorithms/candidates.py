"""Candidates beside the policy of the bounded steps, compared with it by the return in the model.

Each function takes a policy with its returns (rollouts,), and gives back those of the best one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.algorithms.acceptance import ModelComparison, is_worse
from kreps.algorithms.policy_gradient import improve
from kreps.algorithms.policy_targets import PolicyFit
from kreps.algorithms.random_policies import best_random_policy
from kreps.algorithms.regulated_policies import best_regulator, best_switching_policy
from kreps.algorithms.regulators import regulators
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.policies.cost_sensitive_gp import on_its_centres
from kreps.policies.sparse_gp import SparseGP

Compared = tuple[PolicyFit, FloatArray]
"""A policy and its returns (rollouts,) in the model."""


def with_random_policies(
    fit: PolicyFit,
    returns: FloatArray,
    comparison: ModelComparison,
    count: int,
    rng: np.random.Generator,
) -> Compared:
    """The best of so many random policies, if it is better."""
    if not count:
        return fit, returns
    drawn = best_random_policy(comparison, on_its_centres(fit.policy), count, rng)
    return better_of(fit, returns, drawn, comparison)


def with_regulators(
    fit: PolicyFit, returns: FloatArray, comparison: ModelComparison, kernel: Kernel, count: int
) -> Compared:
    """A policy in which a regulator acts near its equilibrium, if it is better.

    Where episodes end, a regulator alone, unless it is worse by a standard error: if both keep an
    episode going for a whole rollout, the regulator is more likely to do so for longer, and a fit
    to another policy less.  Where no episode ends, a regulator alone exploits errors of the model
    far from the equilibrium.

    Args:
        fit, returns, comparison: policy, its returns, and how they are compared.
        kernel: over states, at median lengthscales.
        count: number of equilibria.
    """
    found = regulators(comparison.world, comparison.from_starts, count)
    if not found:
        return fit, returns
    if comparison.has_ends:
        alone = best_regulator(comparison, on_its_centres(fit.policy), found, kernel)
        new_returns = comparison.returns(alone)
        if not is_worse(new_returns - returns):
            return with_policy(fit, alone), new_returns
    switching = best_switching_policy(comparison, on_its_centres(fit.policy), found)
    return better_of(fit, returns, switching, comparison)


def with_gradient_steps(
    fit: PolicyFit, returns: FloatArray, comparison: ModelComparison, steps: int
) -> Compared:
    """The policy after so many steps of gradient ascent, if it is better.

    They are compared on other starts and noise than those of the ascent.
    """
    if not steps:
        return fit, returns
    improved = improve(comparison, on_its_centres(fit.policy), steps)
    return better_of(fit, returns, improved, comparison)


def better_of(
    fit: PolicyFit, returns: FloatArray, policy: SparseGP, comparison: ModelComparison
) -> Compared:
    """A policy with its returns (rollouts,), or another policy if this has a larger mean."""
    new_returns = comparison.returns(policy)
    if new_returns.mean() <= returns.mean():
        return fit, returns
    return with_policy(fit, policy), new_returns


def with_policy(fit: PolicyFit, policy: SparseGP) -> PolicyFit:
    """A fit with another policy; its hyper-parameters, from which the next fit starts, stay."""
    return replace(fit, policy=policy, support=len(policy.states), noise=policy.noise)
