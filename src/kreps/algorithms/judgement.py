"""The model's judgement of a new policy, before it acts.

An update goes wrong where an error of V meets one of the model: one step ahead an action looks
better than any other, and nothing asks what comes of a hundred of them.  Roll-outs in the model do,
and they know nothing of V.  So a new policy is followed there beside the one before, from the same
starts and with the same noise, and if it earns less the one before acts once more.

Of states that no sample is like, the model would say that rewards are as they are on average, which
late in learning is good.  A policy that goes there on purpose was never seen to: the judge takes
what is not known for the worst that was.  How like the samples a state has to be is told by those
of the policy before, most of which are known: in many coordinates no two states are much alike.
Only while there is optimism (`kreps.algorithms.optimism`) the judge shares it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kreps.algorithms.imagined_rollouts import Followed, average_reward
from kreps.algorithms.imagined_step import Outlook
from kreps.arrays import FloatArray
from kreps.policies import StochasticPolicy
from kreps.settings import Settings


def refuses(
    new: StochasticPolicy,
    before: StochasticPolicy | None,
    outlook: Outlook,
    settings: Settings,
    rng: np.random.Generator,
) -> bool | None:
    """Whether a new policy earns less than the one before, by more than the standard error.

    That error is of starts and noise; of its own errors the model knows nothing.

    Args:
        new, before: with their noise; None before the first update.
        outlook: what the model says.
        settings: ``judging_rollouts`` of each policy.
        rng: of the roll-outs.

    Returns:
        None where nothing can be judged, or is to be.
    """
    count = settings.judging_rollouts
    if before is None or outlook.simulator is None or not count:
        return None
    process = replace(outlook.simulator, exploring_starts=0.0)
    followed, followed_before = process.follow((new, before), outlook.rewards_of, count, rng)
    typical = max(float(np.median(followed_before.likeness)), np.finfo(np.float64).tiny)

    def earned(each: Followed) -> FloatArray:
        hope = outlook.optimism
        if hope is None:
            rewards = each.feared_rewards(outlook.rewards.min(), typical)
        else:
            rewards = hope.hoped_rewards(each)
        return average_reward(rewards, process.restart_probability)

    gain = earned(followed) - earned(followed_before)
    return bool(gain.mean() < -gain.std(ddof=1) / np.sqrt(count))
