"""What rollouts of a policy say of it, beside what the model says.

Where a policy keeps episodes going, samples of ends become rare, and the model can take it for one
that ends them.  Then others that do so in truth seem better in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kreps.algorithms.reps import Batch
from kreps.algorithms.state import LearnerState
from kreps.data.rollouts import Transitions
from kreps.kernels.arrays import BoolArray, FloatArray, as_float
from kreps.models.model_env import ModelEnv, step_shares
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import on_its_centres

STANDARD_ERRORS = 5.0
"""By how many the mean squared deviation of the actions of a rollout from a policy, in its standard
deviations, may exceed one if the policy is to have made it."""

MAX_SHARE_OF_ENDS = 0.5
"""Share of the rollouts that end, from which on the return of a policy in truth is not used: then
few rollouts say little, and such a policy is to be replaced soon."""


def real_return(batch: Batch[Any, Any], state: LearnerState, model_env: ModelEnv) -> float | None:
    """Average reward per step of the acting policy in its rollouts, as the model computes it.

    They are those of the window; or the new ones alone, if they have the steps of a mean rollout
    and none of them ended: what has just been seen of a policy is not given up for a prediction
    that is only better than what was seen of it before.

    Args:
        batch: the samples, new rollouts last.
        state: before the update, with the policies that acted.
        model_env: tells steps and weights of the average, and the reward after an end.

    Returns:
        Standardised.  None if there is no such rollout, if half of them or more ended, or if not
        all steps of the window are in memory.
    """
    data, window = batch.data, batch.window.rollouts
    if state.policy is None or (len(data.start), len(data)) != (len(window), window.steps):
        return None
    ended, lengths = window.terminated, window.lengths
    acting = made_by(state.policy, state.explorer, data)
    new = acting & (np.arange(len(window)) >= len(window) - batch.seen[0])
    enough = lengths[new].sum() * batch.settings.p >= 1.0
    chosen = new if enough and not ended[new].any() else acting
    if not chosen.any() or ended[chosen].mean() >= MAX_SHARE_OF_ENDS:
        return None
    steps = model_env.evaluation_steps
    expected = expected_rewards(data, batch.rewards, chosen, steps, model_env.end_reward)
    return float(step_shares(steps, model_env.restart_probability) @ expected)


def expected_rewards(
    data: Transitions, rewards: FloatArray, chosen: BoolArray, steps: int, end_reward: float
) -> FloatArray:
    """Expected reward (steps,) by the number of the step, from some of R rollouts.

    Rollouts that were stopped do not tell what would have followed.  So the probability that an
    episode still goes on is the product over the steps of the shares that did not end in them, of
    the rollouts that got there (E. Kaplan and P. Meier, 1958).  After the longest rollout all is as
    in its last step.

    Args:
        data: whole rollouts.
        rewards: (n,) of its steps.
        chosen: (R,) which rollouts; one at least.
        steps: largest number.
        end_reward: reward after an end.
    """
    number = np.arange(len(data)) - np.searchsorted(data.rollout, data.rollout)
    rows = chosen[data.rollout] & (number < steps)

    def sums(values: FloatArray) -> FloatArray:
        return as_float(np.bincount(number[rows], values[rows], minlength=steps))

    going = sums(np.ones(len(data)))
    known = int(np.count_nonzero(going))
    last = np.minimum(np.arange(steps), known - 1)
    mean = (sums(rewards)[:known] / going[:known])[last]
    ends = np.zeros(steps)
    ends[:known] = sums(data.terminated.astype(float))[:known] / going[:known]
    goes_on = np.cumprod(np.append(1.0, 1.0 - ends[:-1]))
    return goes_on * mean + (1.0 - goes_on) * end_reward


def made_by(policy: LearntPolicy, other: LearntPolicy | None, data: Transitions) -> BoolArray:
    """Which of R rollouts a policy can have made, and more likely than another one (R,)."""
    count = np.bincount(data.rollout, minlength=len(data.start)) * data.actions.shape[1]
    squares, log_densities = of_rollouts(policy, data)
    found: BoolArray = squares <= count + STANDARD_ERRORS * np.sqrt(2.0 * count)
    return found if other is None else found & (log_densities >= of_rollouts(other, data)[1])


def of_rollouts(policy: LearntPolicy, data: Transitions) -> tuple[FloatArray, FloatArray]:
    """Of each rollout the squared deviations of its commanded actions from a policy, in standard
    deviations, and their log density up to a constant (R,)."""
    task = policy.task
    mean, deviation = on_its_centres(policy).scaled_mean_and_deviation(data.states)
    z = (data.actions - task.unscaled(mean)) / (task.action_scale * deviation)
    squares = np.sum(z**2, axis=1)
    logs = -0.5 * squares - z.shape[1] * np.log(deviation[:, 0])
    sums = [np.bincount(data.rollout, each, minlength=len(data.start)) for each in (squares, logs)]
    return as_float(sums[0]), as_float(sums[1])
