"""What an update reports of itself."""

from __future__ import annotations

from dataclasses import dataclass

from kreps.algorithms.dual import DualSolution
from kreps.kernels.arrays import FloatArray


@dataclass(frozen=True)
class UpdateInfo:
    """What is only reported of an update.

    Attributes:
        samples: n.
        kl_bound: epsilon.
        eta_floor: least temperature as taken, in standard deviations of the reward.
        ridge: rho times the number of samples.
        model_error: of the transition model by leave-one-out, relative (`LeaveOneOut.relative`);
            nan without a model.
        clipped: share of the commanded actions that lie beyond the limits: those of the new
            roll-outs, of all kept ones if there are none, or of a data set's sample.
        rank: features of V; ``rank_residual`` is the largest squared residual they leave.
        dual: the last step's solution with its certificate.
        effective_samples: effective sample size of the weights.
        support: support points of the policy.
        state_lengthscales: of V's kernel, but for cuts of angles.
        embedding_parameters, policy_parameters: fitted values (not logs): lengthscales, then
            lambda, or sf2 and l.  The former are those of the transition model, whichever it is.
            After widened imagined steps the policy has its sf2 and noise divided.
        noise: variance that actions are drawn with, in units of the action scale squared, by the
            fitted policy.
        refused: whether the model found the fitted policy worse than the one before, which then
            acts on; None where nothing was judged.
        jitter: largest jitter that a factorisation of this update needed; trial points of the
            hyper-parameter searches do not count.
        seconds: CPU seconds of this process by stage.
    """

    samples: int
    kl_bound: float
    eta_floor: float
    ridge: float
    model_error: float
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
    rejected: bool | None
    jitter: float
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
        """What a progress display shows, by column."""
        return {
            "KL / bound": f"{self.dual.kl:.3f} / {self.kl_bound:g}",
            "eta": f"{self.dual.eta:.3g}",
            "ESS": f"{self.effective_samples:.0f}",
            "gap": f"{self.dual.gap:.0e}",
            "note": f"{self.dual.outcome.note}"
            + ("  refused: the policy before acts" if self.rejected else "")
            + (f"  jitter {self.jitter:.0e}" if self.jitter else ""),
        }
