"""Weighted targets of the policy fit, and its hyper-parameters (Sec. 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from kreps.algorithms.dual import effective_sample_size
from kreps.algorithms.generated import GeneratedSamples
from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.hyperparameters import PolicyLoss, Prior, factor_distances, minimise
from kreps.kernels.kernel import Kernel
from kreps.kernels.sampling import uniform_subsample
from kreps.policies.base import LearntPolicy

MIN_RELATIVE_WEIGHT = 0.05
"""Samples with ``n p_i`` below this are left out of the policy fit.  In total they have less than
this share of the weight, and the cost of the policy grows with the number of samples."""

MIN_ACTION_VARIANCE = 1e-4
"""Smallest variance of exploration noise, in units of the action scale squared, so that learning
does not stop."""

MIN_TARGET_VARIANCE = 1e-4
"""Smallest variance of the targets, in units of the action scale squared, at which priors are
centred: that of equal targets is zero and has no logarithm."""

LOG_LENGTHSCALE_CENTRE, LOG_LENGTHSCALE_STD = -0.5, 0.7
"""Prior of a log lengthscale relative to that of the median distance: policies vary faster than the
states are spread."""
LOG_SIGNAL_CENTRE, LOG_NOISE_CENTRE, LOG_VARIANCE_STD = -0.3, -1.0, 1.0
"""Prior of log sf2 and log l relative to the log variance of the targets: more of it is due to the
state than to noise.  The centres of signal and noise sum to 1.1 of the variance."""
LOG_LENGTHSCALE_RANGE = (-4.0, 3.0)
VARIANCE_RANGE = (1e-4, 1e2)
"""Limits of the search with priors, which keep the Gram matrix well-conditioned.  Lengthscales are
relative to the median distance, variances in units of the action scale squared."""
BOUNDED_LENGTHSCALES = (0.3, 1.0)
BOUNDED_SIGNAL, BOUNDED_NOISE = (0.01, 3.0), (1e-4, 4.0)
"""Hard ranges of ``policy_fit="bounded"``, in the same units; there is no prior."""


@dataclass(frozen=True)
class PolicyTargets:
    """The weighted samples that the policy is fitted to.

    Attributes:
        states: (m, ds).
        targets: (m, da) commanded actions around their centre, in units of the action scale.
        weights: (m,) ``p_i / sum p^2``: over all samples they sum to the effective sample size.
        total_weight: sum of the weights of all samples, also of those left out by
            `top_by_weight` or subsampling.
        target_variance: (m,) variance of the actions that each target is the mean of, summed over
            action coordinates; zero where it is one action.
        action_variance: mean variance of an action coordinate within a state; infinite where there
            is one action per state.
    """

    states: FloatArray
    targets: FloatArray
    weights: FloatArray
    total_weight: float
    target_variance: FloatArray
    action_variance: float = inf

    @classmethod
    def from_samples(cls, data: Transitions, p: FloatArray, task: TaskSpec) -> PolicyTargets:
        """The sampled actions of transitions (n) with weights p (n,), which sum to one."""
        kept = len(p) * p >= MIN_RELATIVE_WEIGHT
        targets = task.scaled(data.actions[kept])
        weights = p[kept] * effective_sample_size(p)
        total = float(weights.sum())
        return cls(data.states[kept], targets, weights, total, np.zeros(len(weights)))

    @classmethod
    def from_generated(
        cls, samples: GeneratedSamples, p: FloatArray, task: TaskSpec
    ) -> PolicyTargets:
        """One target per state: the weighted mean of the actions that were generated there.

        The Gaussian process then has as many support points as there are states, and a mean of
        several actions has their summed weight.

        Args:
            samples: m generated actions.
            p: (m,) their weights, which sum to one.
            task: centre and scale of the actions.
        """
        kept = len(p) * p >= MIN_RELATIVE_WEIGHT
        each = p[kept] * effective_sample_size(p)
        actions = task.scaled(samples.actions[kept])
        rows, group = np.unique(samples.state_of[kept], return_inverse=True)
        weights = np.zeros(len(rows))
        targets = np.zeros((len(rows), task.action_size))
        target_variance = np.zeros(len(rows))
        np.add.at(weights, group, each)
        np.add.at(targets, group, (each / weights[group])[:, None] * actions)
        squares = np.sum((actions - targets[group]) ** 2, axis=1)
        share = each / weights[group]
        np.add.at(target_variance, group, share * squares)
        # Bessel's correction for weighted means of few actions
        freedom = float(weights.sum() - each @ share) * task.action_size
        summed = float(weights @ target_variance)
        variance = summed / freedom if freedom > 1e-9 * weights.sum() else inf
        total = float(weights.sum())
        return cls(samples.states[rows], targets, weights, total, target_variance, variance)

    def concat(self, earlier: PolicyTargets) -> PolicyTargets:
        """These and those of an earlier step."""
        sums = np.array([self.weights.sum(), earlier.weights.sum()])
        return PolicyTargets(
            np.concatenate([self.states, earlier.states]),
            np.concatenate([self.targets, earlier.targets]),
            np.concatenate([self.weights, earlier.weights]),
            self.total_weight + earlier.total_weight,
            np.concatenate([self.target_variance, earlier.target_variance]),
            float(sums @ [self.action_variance, earlier.action_variance] / sums.sum()),
        )

    def top_by_weight(self, count: int) -> PolicyTargets:
        """The ``count`` heaviest of them, in their order."""
        if len(self.weights) <= count:
            return self
        kept = np.sort(np.argsort(-self.weights, kind="stable")[:count])
        return replace(
            self,
            states=self.states[kept],
            targets=self.targets[kept],
            weights=self.weights[kept],
            target_variance=self.target_variance[kept],
        )


@dataclass(frozen=True)
class PolicyFit:
    """A fitted policy.

    Attributes:
        policy: with its exploration noise.
        x: (g + 2,) log hyper-parameters of the fit (`policy_hyperparameters`).
        support: number of support points.
        noise: variance of the exploration noise, in units of the action scale squared.
    """

    policy: LearntPolicy
    x: FloatArray
    support: int
    noise: float


def policy_hyperparameters(
    targets: PolicyTargets,
    state_kernel: Kernel,
    policy_fit: str,
    start: FloatArray | None,
    rng: np.random.Generator,
) -> FloatArray:
    """Log lengthscales (g,), log sf2 and log l of the policy, by weighted leave-one-out density.

    Args:
        targets: those that the policy is fitted to, or a subsample of them.
        state_kernel: its factors are those of the policy's kernel; its lengthscales are the median
            distances.
        policy_fit: ``"map"``, with Gaussian priors around the median distances; ``"bounded"``,
            within hard ranges; or ``"free"``, with neither.
        start: log hyper-parameters (g + 2,) from which the fit starts; None for the prior's centre.
        rng: draws the samples of the fit.
    """
    prior = policy_prior(targets, state_kernel, policy_fit)
    rows = uniform_subsample(len(targets.weights), rng)
    loss = PolicyLoss(
        factor_distances(state_kernel.factors, targets.states[rows]),
        targets.targets[rows],
        targets.weights[rows],
        targets.target_variance[rows],
    )
    return minimise(loss, prior, prior.centre if start is None else start)


def policy_prior(targets: PolicyTargets, state_kernel: Kernel, policy_fit: str) -> Prior:
    """Prior and ranges of the log hyper-parameters (g + 2,); arguments as before.

    A priori, lengthscales are somewhat shorter than median distances, and more of the variance of
    the weighted actions is due to the state than to noise.
    """
    median, g = np.log(state_kernel.lengthscales), len(state_kernel.lengthscales)
    share = targets.weights / targets.weights.sum()
    centred = targets.targets - share @ targets.targets
    variance = float(np.mean(share @ centred**2))
    variance += float(share @ targets.target_variance) / centred.shape[1]
    log_variance = np.log(max(variance, MIN_TARGET_VARIANCE))
    variances = [log_variance + LOG_SIGNAL_CENTRE, log_variance + LOG_NOISE_CENTRE]
    centre = np.concatenate([median + LOG_LENGTHSCALE_CENTRE, variances])
    if policy_fit in ("map", "free"):
        shortest, longest = LOG_LENGTHSCALE_RANGE
        smallest, largest = np.log([[bound] * 2 for bound in VARIANCE_RANGE])
        return Prior(
            centre=centre,
            std=np.concatenate([np.full(g, LOG_LENGTHSCALE_STD), [LOG_VARIANCE_STD] * 2]),
            low=np.concatenate([median + shortest, smallest]),
            high=np.concatenate([median + longest, largest]),
            # the loss is per unit of weight
            strength=1.0 / targets.total_weight if policy_fit == "map" else 0.0,
        )
    low, high = np.log([BOUNDED_SIGNAL, BOUNDED_NOISE]).T
    shortest, longest = np.log(BOUNDED_LENGTHSCALES)
    return Prior(
        centre=centre,
        std=np.ones(g + 2),
        low=np.concatenate([median + shortest, low]),
        high=np.concatenate([median + longest, high]),
        strength=0.0,
    )


def exploration_noise(targets: PolicyTargets, fitted: float) -> tuple[FloatArray, float]:
    """Weights (m,) and noise l of the policy, from the fitted noise.

    The fitted noise also contains the residuals of the mean, which are large where the targets
    jump.  The policy explores with at most the variance of the weighted actions within a state.
    Weights are divided by the same factor as the noise, so that ``l / w_i``, and with it the mean,
    stays as fitted.
    """
    noise = min(fitted, max(targets.action_variance, MIN_ACTION_VARIANCE))
    return targets.weights * (noise / fitted), noise
