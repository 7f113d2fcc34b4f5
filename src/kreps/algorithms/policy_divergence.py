"""How far an update has moved the policy: the expected KL divergence over sampled states.

The KL bound is on the weights of samples.  The policy that is fitted to them also moves where few
samples are, and by the shape of its kernel, so its divergence may be smaller or larger.
"""

from __future__ import annotations

import numpy as np

from kreps.data.rollouts import Transitions
from kreps.kernels.arrays import FloatArray
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

MAX_STATES = 500
"""States over which the mean is taken, evenly spaced among those of the samples."""


def expected_policy_kl(
    new: LearntPolicy, previous: LearntPolicy | None, data: Transitions
) -> float:
    """Mean of ``KL(new(. | s) || previous(. | s))`` in nats over sampled states.

    NaN without a previous policy, or if the number is not finite.

    Args:
        new, previous: Gaussian-process policies.
        data: the samples.
    """
    gaussian = CostSensitiveGP | SparseGP
    if not (isinstance(new, gaussian) and isinstance(previous, gaussian)):
        return float("nan")
    rows = np.unique(np.linspace(0, len(data) - 1, min(len(data), MAX_STATES)).astype(np.intp))
    states = data.points[data.state[rows]]
    with np.errstate(all="ignore"):  # a result that is not finite is NaN
        divergence = gaussian_kl(
            new.greedy(states),
            new.standard_deviation(states),
            previous.greedy(states),
            previous.standard_deviation(states),
        )
        mean = float(np.mean(divergence))
    return max(mean, 0.0) if np.isfinite(mean) else float("nan")


def gaussian_kl(
    mean: FloatArray, std: FloatArray, previous_mean: FloatArray, previous_std: FloatArray
) -> FloatArray:
    """``KL(N(mean, std^2) || N(previous_mean, previous_std^2))`` (m,) of independent coordinates.

    All arguments are (m, da).
    """
    ratio = (std / previous_std) ** 2
    moved = ((mean - previous_mean) / previous_std) ** 2
    return 0.5 * np.sum(ratio + moved - 1.0 - np.log(ratio), axis=1)
