"""What is not known is thought to be good: the optimism of R-max (Brafman and Tennenholtz 2002).

A policy that holds the best state it has seen makes no other data, and what it has never seen is
not imagined either: a local optimum is for ever.  So in the model whoever comes to what no sample
is like earns a good reward there, step after step, until the restart; which is worth a detour as no
reward of one step would be.  V need not know of it: to the update it is an action that earns all of
that at once, and is followed by the restart.

What is like the samples is told by the samples: nearly all of them have one of another roll-out
within a certain distance, and what is farther off is unknown, the farther the more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import Followed, Simulator
from kreps.settings import Settings

KEPT = 0.35
"""What is left of the optimism after each update: later, what is not known was passed by."""

LEAST = 0.005
"""Less optimism is none."""

HIGHEST = 2.0
"""Deviations of the reward above its mean that are hoped for at most: where the best reward is a
seldom goal, not all that is unknown is another one."""

KNOWN = 0.9
"""Share of the samples that are known from other roll-outs."""

ROUNDING = 1e-12
"""Least distance that is known: states that are equal but for rounding are."""

AT_ONCE = 3_000
"""Samples that all are compared with at once, so that memory grows like their number."""

_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Optimism:
    """What is hoped for where nothing is known.

    Attributes:
        hoped: reward per step that is earned there until a restart, standardised.
        gain: reward per step that the samples earn as they are weighed, standardised.
        edge: half the squared distance, in lengthscales, up to which a state is known.
    """

    hoped: float
    gain: float
    edge: float

    def unknown(self, likeness: FloatArray) -> FloatArray:
        """How far states are from being known, 0 to 1.

        Args:
            likeness: of the states to the nearest sample, up to 1, of any shape, such as (m,).
        """
        far = -np.log(np.maximum(likeness, _TINY))
        return -np.expm1(-np.maximum(far - self.edge, 0.0) / self.edge)

    def surplus(self, restart_probability: float) -> float:
        """What an action that leads there earns more than the samples on average, in all.

        ``sum_k (1 - p)^k (hoped - gain)`` over the steps from the next one to the restart.
        """
        return (1.0 - restart_probability) / restart_probability * (self.hoped - self.gain)

    def hoped_rewards(self, followed: Followed) -> FloatArray:
        """Rewards (steps, count) of roll-outs in the model if who finds the unknown stays there.

        As unknown is a matter of degree, so is staying; a real end is followed by a start.
        """
        known_yet = np.ones(followed.rewards.shape[1])
        rewards = np.empty_like(followed.rewards)
        for t, unknown in enumerate(self.unknown(followed.likeness)):
            known_yet = known_yet * (1.0 - unknown)
            rewards[t] = self.hoped + known_yet * (followed.rewards[t] - self.hoped)
            known_yet[followed.ended[t]] = 1.0
        return rewards


def optimism_of(
    simulator: Simulator | None,
    rewards: FloatArray,
    weights: FloatArray,
    updates: int,
    settings: Settings,
) -> Optimism | None:
    """The optimism of one update; None where there is none.

    Args:
        simulator: of its samples; None if nothing can be simulated.
        rewards: (n,) of its samples, standardised.
        weights: (n,) of the first step.
        updates: that were made before.
        settings: ``optimism`` of the first update.
    """
    strength = settings.optimism * KEPT**updates
    if simulator is None or strength < LEAST:
        return None
    edge = known_distance(simulator)
    if edge is None:
        return None
    gain = float(weights @ rewards)
    best = min(float(rewards.max()), float(rewards.mean()) + HIGHEST * float(rewards.std()))
    return Optimism(gain + strength * max(best - gain, 0.0), gain, edge)


def known_distance(simulator: Simulator) -> float | None:
    """Half the squared distance, in lengthscales, that `KNOWN` of the samples have another within.

    Those of its own roll-out do not count, as they are near in any case.  None if all samples are
    of one roll-out.
    """
    states, of = simulator.data.states, simulator.data.rollout
    if of[0] == of[-1]:
        return None
    nearest = []
    for i in range(0, len(states), AT_ONCE):
        likeness = simulator.kernel.gram(states[i : i + AT_ONCE], states)
        likeness[of[i : i + AT_ONCE, None] == of] = 0.0
        nearest.append(likeness.max(axis=1))
    likeness_of_edge = np.quantile(np.concatenate(nearest), 1.0 - KNOWN)
    return max(-float(np.log(max(likeness_of_edge, _TINY))), ROUNDING)
