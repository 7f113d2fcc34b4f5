"""The model's judgement of a new policy, before it acts.

An update goes wrong where an error of V meets one of the model: one step ahead an action looks
better than any other, and nothing asks what comes of a hundred of them.  Roll-outs in the model do,
and they know nothing of V.  So a new policy is followed there beside the one before, from the same
starts and with the same noise, and if it earns less the one before acts once more.

Of states that no sample is like, the model would say that rewards are as they are on average, which
late in learning is good.  A policy that goes there on purpose was never seen to: the judge takes
what is not known for the worst that was.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np

from kreps.algorithms.imagined_step import Outlook
from kreps.policies import StochasticPolicy


def judged_worse(
    new: StochasticPolicy,
    before: StochasticPolicy | None,
    outlook: Outlook,
    count: int,
    rng: np.random.Generator,
) -> bool:
    """Whether a new policy earns less than the one before, by more than the standard error.

    Args:
        new, before: with their noise; None before the first update.
        outlook: what the model says; without a simulator it says nothing of policies.
        count: simulated roll-outs of each, 2 at least; 0 asks nothing.
        rng: of the roll-outs; it is copied, so that both policies meet the same chance.
    """
    if before is None or outlook.simulator is None or not count:
        return False
    process = replace(outlook.simulator, exploring_starts=0.0)
    earned, before_earned = (
        process.average_rewards(
            policy, outlook.rewards_of, outlook.rewards.min(), count, deepcopy(rng)
        )
        for policy in (new, before)
    )
    gain = earned - before_earned
    return bool(gain.mean() < -gain.std(ddof=1) / np.sqrt(count))
