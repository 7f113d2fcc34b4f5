"""The cost-sensitive Gaussian process policy (CrKR, Sec. 2) with all samples as support points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.linalg import Cholesky, cholesky, inverse_lower
from kreps.policies.base import LearntPolicy
from kreps.policies.sparse_gp import MIN_RESIDUAL, PolicySums, SparseGP

MAX_SUPPORT = 6_000
"""Largest number of support points of an exact policy.  Memory grows with its square (288 MB for
one matrix), time with its cube."""

MAX_RESIDUAL_RATIO = 1e-4
"""Largest part of a support point's prior variance that the centres may leave out, as a share of
its noise.  On learnt policies the mean then changes by less than a hundredth of the noise's
standard deviation (root mean square), and the standard deviation by a thousandth."""


@dataclass(frozen=True)
class CostSensitiveGP:
    """Gaussian process policy in which a sample of weight w counts as w samples.

    With ``C = sf2 K + l diag(1/w)``, in units of the action scale around the centre,
    ``mu(s) = k(s)' C^-1 U`` and ``sigma^2(s) = sf2 - k(s)' C^-1 k(s) + l``.

    Attributes:
        task: gives centre, scale and limits of the actions.
        kernel: over states.
        states: (m, ds) support points.
        targets: (m, da) their actions U, in units of the action scale around the centre.
        weights: (m,) their weights w > 0.
        signal: signal variance sf2.
        noise: noise variance l.

    Raises:
        ConfigurationError: more than `MAX_SUPPORT` support points.
        NumericalError: C is needed, and cannot be factorised.
    """

    task: TaskSpec
    kernel: Kernel
    states: FloatArray
    targets: FloatArray
    weights: FloatArray
    signal: float
    noise: float

    def __post_init__(self) -> None:
        if len(self.weights) > MAX_SUPPORT:
            raise ConfigurationError(
                f"the policy would have {len(self.weights)} support points, but at most "
                f"{MAX_SUPPORT} are possible; set a smaller window, or low_rank=kreps.LowRank()"
            )
        _ = self.predictor  # here, so that the first control cycle is as fast as the others

    @cached_property
    def factor(self) -> Cholesky:
        """Cholesky factor of C."""
        c = self.signal * self.kernel.gram(self.states)
        c.flat[:: len(c) + 1] += self.noise / self.weights
        return cholesky(c)

    @cached_property
    def alpha(self) -> FloatArray:
        """``C^-1 U``, (m, da)."""
        return self.factor.solve(self.targets)

    @cached_property
    def predictor(self) -> SparseGP:
        """The process as the control loop evaluates it, projected on few centres where possible.

        Pivots r << m of a Cholesky factorisation are added until the kernel residual of every
        support point is below `MAX_RESIDUAL_RATIO` of the smallest noise ``l / (sf2 max w)``, and
        of one.  A control cycle then costs r^2 instead of m^2, and the fit m r^2 instead of m^3.
        If more than m / 2 pivots would be needed, all support points are centres.
        """
        with np.errstate(all="ignore"):  # extreme numbers are clipped in the next line but one
            smallest_noise = np.float64(self.noise) / self.signal / self.weights.max()
        tolerance = np.clip(MAX_RESIDUAL_RATIO * smallest_noise, MIN_RESIDUAL, MAX_RESIDUAL_RATIO)
        basis, features = RKHSBasis.fit(
            self.kernel, self.states, tolerance=float(tolerance), max_rank=len(self.states) // 2
        )
        if basis.residual <= tolerance:
            return self._projected(basis, features)
        return SparseGP(
            self.task,
            self.kernel,
            self.states,
            self.signal * self.alpha,
            self.signal * inverse_lower(self.factor.lower),
            self.signal,
            self.noise,
        )

    def _projected(self, basis: RKHSBasis, features: FloatArray) -> SparseGP:
        """The process projected on a basis, given the features (m, r) of the support points."""
        sums = PolicySums.from_samples(features, self.weights, self.targets)
        return SparseGP.fit(self.task, basis, sums, self.signal, self.noise)

    @property
    def jitter(self) -> float:
        """Jitter of the factorisation of C; zero if the predictor does not need it."""
        return self.factor.jitter if len(self.predictor.states) == len(self.states) else 0.0

    def mean(self, states: FloatArray) -> FloatArray:
        """Mean action (m, da) at states (m, ds), in the task's units, not clipped."""
        return self.predictor.greedy(states)

    def greedy(self, states: FloatArray) -> FloatArray:
        return self.predictor.greedy(states)

    def standard_deviation(self, states: FloatArray) -> FloatArray:
        """Standard deviation (m, da) of the commanded action, in the task's units."""
        return self.predictor.standard_deviation(states)

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.predictor.act(states, noise)

    def compressed(self, centres: int) -> SparseGP:
        """This policy on at most ``centres`` support points, for computers with little memory.

        All samples still enter: it is the posterior of the projected process, whose variance far
        from the centres is that of the prior.

        Raises:
            ConfigurationError: fewer than one centre.
        """
        if centres < 1:
            raise ConfigurationError(f"centres = {centres}, but a policy needs at least one")
        basis, features = RKHSBasis.fit(
            self.kernel, self.states, tolerance=MIN_RESIDUAL, max_rank=centres
        )
        return self._projected(basis, features)


def on_its_centres(policy: LearntPolicy) -> SparseGP:
    """A policy on the centres that it is evaluated with.

    Its arrays are as they are read from a file, so that it rounds alike.
    """
    assert isinstance(policy, CostSensitiveGP | SparseGP)
    policy = policy.predictor if isinstance(policy, CostSensitiveGP) else policy
    return replace(
        policy,
        states=np.ascontiguousarray(policy.states),
        mean_weights=np.ascontiguousarray(policy.mean_weights),
        explained=np.ascontiguousarray(policy.explained),
    )
