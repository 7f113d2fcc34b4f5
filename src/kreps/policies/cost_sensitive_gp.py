"""Stochastic policies: the cost-sensitive Gaussian process (CrKR, Sec. 2) and first explorers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel
from kreps.kernels.linalg import Cholesky, cholesky, inverse_lower
from kreps.policies.sparse_gp import PolicySums, SparseGP

MAX_SUPPORT = 6_000
"""Most support points of an exact policy: it costs their square in memory, their cube in time."""

PIVOT_TOLERANCE = 1e-12
"""Squared residual of a support point's kernel function that in no case needs another centre."""

NEGLIGIBLE = 1e-4
"""Part of its noise by which a policy may miss the prior variance of a support point.  On learnt
policies its mean is then off by less than a hundredth of the noise's deviation, root mean square,
and its own deviation by a thousandth."""


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
        signal: sf2.
        noise: l.

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
                f"the policy would have {len(self.weights)} support points, the limit is "
                f"{MAX_SUPPORT}; keep fewer roll-outs by a smaller window"
            )
        _ = self.predictor  # now, not in the first control cycle

    @cached_property
    def factor(self) -> Cholesky:
        """Of C."""
        c = self.signal * self.kernel.gram(self.states)
        c.flat[:: len(c) + 1] += self.noise / self.weights
        return cholesky(c)

    @cached_property
    def alpha(self) -> FloatArray:
        """``C^-1 U``, (m, da)."""
        return self.factor.solve(self.targets)

    @cached_property
    def predictor(self) -> SparseGP:
        """The same process as the control loop evaluates it, with few centres where these suffice.

        Kernels of smooth policies are nearly linear functions of each other.  The pivots r << m of
        a Cholesky factorisation are chosen until what they leave of any support point's kernel is
        below `NEGLIGIBLE` of its least noise and of itself.  A control cycle then costs r^2 instead
        of m^2, and to fit it m r^2 instead of m^3.  Where half of the support points do not
        suffice, all are centres.
        """
        with np.errstate(all="ignore"):  # of extreme numbers, which the other bounds then serve
            least_noise = np.float64(self.noise) / self.signal / self.weights.max()
        tolerance = float(np.clip(NEGLIGIBLE * least_noise, PIVOT_TOLERANCE, NEGLIGIBLE))
        basis, features = RKHSBasis.fit(
            self.kernel, self.states, tolerance=tolerance, max_rank=len(self.states) // 2
        )
        if basis.residual <= tolerance:
            sums = PolicySums.of(features, self.weights, self.targets)
            return SparseGP.fit(self.task, basis, sums, self.signal, self.noise)
        return SparseGP(
            self.task,
            self.kernel,
            self.states,
            self.signal * self.alpha,
            self.signal * inverse_lower(self.factor.lower),
            self.signal,
            self.noise,
        )

    @property
    def jitter(self) -> float:
        """What the factorisation of C needed, if it was needed itself."""
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
        """This policy on at most ``centres`` support points, for small computers.

        All samples still count: it is the posterior of the projected process, whose variance far
        from the centres is that of the prior.

        Raises:
            ConfigurationError: fewer than one centre.
        """
        if centres < 1:
            raise ConfigurationError(f"centres = {centres}, but a policy needs at least one")
        basis, features = RKHSBasis.fit(
            self.kernel, self.states, tolerance=PIVOT_TOLERANCE, max_rank=centres
        )
        return SparseGP.fit(
            self.task,
            basis,
            PolicySums.of(features, self.weights, self.targets),
            self.signal,
            self.noise,
        )
