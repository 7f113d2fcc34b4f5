"""The report of an update of KREPS."""

from __future__ import annotations

from dataclasses import dataclass

from kreps.algorithms.dual import DualSolution
from kreps.kernels.arrays import FloatArray
from kreps.models.history_choice import HistoryChoice
from kreps.models.model_errors import ModelErrors


@dataclass(frozen=True)
class UpdateInfo:
    """Diagnostics of an update, which the learner does not carry on.

    Attributes:
        samples: n.
        kl_bound: epsilon, in nats.
        eta_floor: smallest temperature, in standard deviations of the reward.
        ridge: rho times the number of samples.
        model_error: leave-one-out error of the transition model in feature space, relative to the
            change of the features (`LeaveOneOut.relative`); nan without a model.
        held_out: leave-one-out errors of dynamics, terminations and reward, each apart.
        clipped: share of the commanded actions beyond the limits, among those of the new rollouts;
            of the window if there are no new ones, or of the subsample of a data set.
        rank: number of features of V.
        rank_residual: largest squared residual of a sampled state in these features.
        dual: solution of the last step, with its certificate.
        effective_samples: effective sample size of its weights.
        support: number of support points of the policy.
        state_lengthscales: (g,) of the kernel over states, without those of wrapped angles.
        embedding_parameters: (g + da + 1,) fitted lengthscales and lambda of the transition model,
            whichever it is; None without a model.
        policy_parameters: (g + 2,) fitted lengthscales, sf2 and l of the policy.  If actions are
            generated with an inflated standard deviation, the policy has sf2 and noise divided by
            the square of the factor.
        noise: variance of the exploration noise of the fitted policy, in units of the action scale
            squared.
        policy_kl: mean KL divergence, in nats, of the fitted policy from the previous one over
            sampled states; NaN without one.  The bound is on the KL of the weights, ``dual.kl``.
        rejected: whether the fitted policy failed the acceptance test, so that the previous one
            acts; None without a test.
        jitter: largest jitter of a factorisation of this update, except those at trial points of
            the hyper-parameter fits.
        history_choice: delay and history of the states and why; None where they are given.
        seconds: CPU seconds of this process by stage.
    """

    samples: int
    kl_bound: float
    eta_floor: float
    ridge: float
    model_error: float
    held_out: ModelErrors
    clipped: float
    rank: int
    rank_residual: float
    dual: DualSolution
    effective_samples: float
    support: int
    state_lengthscales: FloatArray
    embedding_parameters: FloatArray | None
    policy_parameters: FloatArray
    noise: float
    policy_kl: float
    rejected: bool | None
    jitter: float
    history_choice: HistoryChoice | None
    seconds: dict[str, float]

    def numbers(self) -> dict[str, float]:
        """The diagnostics of the method, by name."""
        return {
            "kl": self.dual.kl,
            "eta": self.dual.eta,
            "gap": self.dual.gap,
            "effective_samples": self.effective_samples,
        }

    def shown(self) -> dict[str, str]:
        """The columns of a progress display."""
        return {
            "KL / bound": f"{self.dual.kl:.3g} / {self.kl_bound:g}",
            "eta": f"{self.dual.eta:.3g}",
            "ESS": f"{self.effective_samples:.0f}",
            "gap": f"{self.dual.gap:.0e}",
            "note": f"{self.dual.outcome.note}"
            + ("  rejected: the previous policy acts" if self.rejected else "")
            + (f"  jitter {self.jitter:.0e}" if self.jitter else ""),
        }
