"""Terminations in the dual: the end of an episode is an absorbing state without reward.

In Gymnasium ``terminated`` means that nothing more is earned.  So a termination leads to a state e
in which the process stays, with reward zero, until the random restart of probability p.  This state
needs no samples, as all of it is known.  With the average reward g of the process,

    ``V(e) = 0 - g + p V(restart) + (1 - p) V(e)``, hence ``V(e) = V(restart) - g / p``.

Put into the Bellman error (Eq. 5), a termination with probability q is followed by the restart, and
adds ``q (1 - p) / p (0 - g)`` to the reward: on average ``(1 - p) / p`` steps without reward take
the place of as many steps with reward g.

The average reward is that of the weights p_i to be found: with the steps spent in e,
``g = sum p_i R_i / (1 + (1 - p) / p sum p_i q_i)``.  Dinkelbach's method maximises such a ratio of
linear functions: maximise the numerator less g times the denominator, compute g anew, and repeat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from kreps.algorithms.dual import DualProblem, DualSolution, standardise
from kreps.algorithms.newton import solve_dual
from kreps.kernels.arrays import BoolArray, FloatArray

if TYPE_CHECKING:  # it imports the step, which has an end
    from kreps.algorithms.streamed_dual import StreamedProblem

MAX_ROUNDS = 6
"""Solves of the dual with a new average reward; Dinkelbach's method converges superlinearly."""

VALUE_TOLERANCE = 1e-2
"""Change of the value of a termination that ends them, in standard deviations of the reward."""

AnyProblem = TypeVar("AnyProblem", DualProblem, "StreamedProblem")
Start = tuple[float, FloatArray] | None
"""Eta and theta (r,) to start from, if any."""


@dataclass(frozen=True)
class AbsorbingEnd:
    """The state that follows a termination.

    Attributes:
        reward: zero, in the standardised units of the other rewards.
        average_reward: g per step of the process, standardised, steps after terminations included.
        steps: ``(1 - p) / p``, the mean number of steps from a termination to the restart.
    """

    reward: float
    average_reward: float
    steps: float

    @property
    def value(self) -> float:
        """What a termination adds to the reward of its step, standardised."""
        return self.steps * (self.reward - self.average_reward)

    def under(
        self, weights: FloatArray, rewards: FloatArray, probabilities: FloatArray
    ) -> AbsorbingEnd:
        """The same with the average reward of a weighted sample.

        Args:
            weights: (n,) of the samples, which sum to one.
            rewards: (n,) standardised.
            probabilities: (n,) of a termination.
        """
        earned = float(weights @ (rewards - self.reward))
        ended = float(weights @ probabilities)
        return replace(self, average_reward=self.reward + earned / (1.0 + self.steps * ended))


def standardise_with_end(
    rewards: FloatArray, terminated: BoolArray, restart_probability: float
) -> tuple[FloatArray, float, AbsorbingEnd | None]:
    """Standardised rewards (n,), their unit, and the absorbing end if any episode terminated.

    The unit is the standard deviation over all steps, those after terminations included.  Without
    terminations this is `kreps.algorithms.dual.standardise`.

    Args:
        rewards: (n,).
        terminated: (n,) whether the episode ended at this step.
        restart_probability: p.
    """
    if not terminated.any():
        return (*standardise(rewards), None)
    steps = (1.0 - restart_probability) / restart_probability
    share = 1.0 / (1.0 + steps * float(np.mean(terminated)))  # of steps before a termination
    mean = share * float(rewards.mean())
    variance = share * float(np.mean((rewards - mean) ** 2)) + (1.0 - share) * mean**2
    unit = float(np.sqrt(variance))
    if unit == 0.0:  # every reward is zero
        return np.zeros_like(rewards), 1.0, None
    top = float(rewards.max())
    scaled = (rewards - top) / unit
    n = len(rewards)
    end = AbsorbingEnd(-top / unit, 0.0, steps)
    return scaled, unit, end.under(np.full(n, 1.0 / n), scaled, terminated.astype(np.float64))


def solve_from(problem: AnyProblem, start: Start) -> DualSolution:
    """`solve_dual` from a start."""
    return solve_dual(problem, start=start)


def solve_with_end(
    problem: AnyProblem,
    probabilities: FloatArray,
    end: AbsorbingEnd | None,
    rewards: FloatArray | None = None,
    solve: Callable[[AnyProblem, Start], DualSolution] | None = None,
    start: Start = None,
) -> tuple[AnyProblem, DualSolution, AbsorbingEnd | None]:
    """Solve the dual with terminations, by Dinkelbach's method.

    Args:
        problem: with plain rewards; its rows have the restart features after a termination.
        probabilities: (n,) of a termination.
        end: with the average reward to start from; None for a single plain solve.
        rewards: (n,) standardised, of which g is the average; None for those of the problem, which
            may contain an exploration bonus.
        solve: minimises the dual; None for `solve_dual`.
        start: of the solver.

    Returns:
        The problem whose rewards contain the value of terminations, its solution, and the end
        with the average reward of the solution.
    """
    if solve is None:
        solve = solve_from
    plain = problem.rewards
    if end is None:
        problem = replace(problem, rewards=plain - plain.max())
        return problem, solve(problem, start), None
    for _ in range(MAX_ROUNDS):
        with_value = plain + probabilities * end.value
        problem = replace(problem, rewards=with_value - with_value.max())
        dual = solve(problem, start)
        new = end.under(dual.weights, plain if rewards is None else rewards, probabilities)
        settled = abs(new.value - end.value) <= VALUE_TOLERANCE
        start, end = (dual.eta, dual.theta), new
        if settled:
            break
    return problem, dual, end
