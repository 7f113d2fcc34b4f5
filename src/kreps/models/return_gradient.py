"""The return of a policy in the model, and its gradient by the actions, through whole rollouts.

With the random numbers of the rollouts fixed, the return is a differentiable function of the
actions (a pathwise, or reparametrised, gradient).  The derivative ``lambda_t`` of what is earned
from step t on, by the state ``s_t``, follows backwards in time from

    ``dJ/da_t = w_t dr/da + lambda_t+1 ds'/da`` and
    ``lambda_t = w_t dr/ds + lambda_t+1 ds'/ds + dJ/da_t dpi/ds``

with the weight ``w_t`` of the step in the return, and the policy pi.  An episode that can end goes
on with the probability that it has not ended, in place of a random end.

Where the dynamics are unstable, derivatives grow exponentially backwards in time and say nothing
about changes of a finite size.  So ``lambda_t`` is limited to what it would be if a change of the
state kept its size to the end of the rollout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kreps.kernels.arrays import FloatArray
from kreps.models.model_env import ModelEnv, RolloutNoise, step_shares
from kreps.models.reward_model import RewardModel
from kreps.policies.sparse_gp import SparseGP

TINY = 1e-100
"""Smallest limit of derivatives: that of a reward which is the same everywhere would be zero."""


@dataclass(frozen=True)
class RolloutRecord:
    """Rollouts of a policy in the model, with all that their derivatives need.

    Attributes:
        states: (steps, m, ds).
        inputs: (steps, m, ds + da) states and scaled, applied actions.
        commanded: (steps, m, da) scaled actions before they were clipped.
        successors: (steps, m, ds) before they were clipped to the range of the data.
        terminations: (steps, m) probabilities of a termination.
        alive: (steps, m) probability that the episode has not terminated before.
    """

    states: FloatArray
    inputs: FloatArray
    commanded: FloatArray
    successors: FloatArray
    terminations: FloatArray
    alive: FloatArray


@dataclass(frozen=True)
class FixedNoise:
    """The random numbers of m rollouts of so many steps.

    Attributes:
        starts: (m, ds) first states.
        actions: (steps, m, da) what is added to the scaled greedy action.
        residual_signs: (steps, m, 1) one or minus one.
    """

    starts: FloatArray
    actions: FloatArray
    residual_signs: FloatArray

    @classmethod
    def of_policy(
        cls, env: ModelEnv, policy: SparseGP, count: int, rng: np.random.Generator
    ) -> FixedNoise:
        """The noise of a policy in its rollouts, which stays as it is when the policy changes.

        Args:
            env: the model.
            policy: with its exploration noise.
            count: m.
            rng: draws them in the order of `ModelEnv.evaluate`.
        """
        states, actions, signs = env.starts(count, rng), [], []
        starts = states
        for _ in range(env.evaluation_steps):
            noise = RolloutNoise.sample(count, env.task.action_size, rng)
            mean, deviation = policy.scaled_mean_and_deviation(states)
            actions.append(deviation * noise.action_noise)
            signs.append(noise.residual_signs)
            commanded = env.task.unscaled(mean + actions[-1])
            states = env.step_with(commanded, states, noise).successors
        return cls(starts, np.stack(actions), np.stack(signs))


def roll_out(env: ModelEnv, policy: SparseGP, noise: FixedNoise) -> RolloutRecord:
    """Rollouts of the mean of a policy with given noise; episodes go on after their end."""
    rows: list[tuple[FloatArray, ...]] = []
    states, alive = noise.starts, np.ones(len(noise.starts))
    for added, signs in zip(noise.actions, noise.residual_signs, strict=True):
        commanded = policy.scaled_mean(states) + added
        applied = env.task.scaled_applied(env.task.unscaled(commanded))
        inputs = np.concatenate([states, applied], axis=1)
        nearest, _ = env.nearest(states)
        successors, terminations = env.dynamics.sample(nearest, inputs, signs)
        rows.append((states, inputs, commanded, successors, terminations, alive))
        states, alive = env.within_range(successors), alive * (1.0 - terminations)
    return RolloutRecord(*(np.stack(part) for part in zip(*rows, strict=True)))


@dataclass(frozen=True)
class StepRewards:
    """Rewards of a `RolloutRecord`.

    Attributes:
        values: (steps, m) expected, standardised, as if no episode had ended.
        model: of the rewards.
    """

    values: FloatArray
    model: RewardModel

    @classmethod
    def of(cls, record: RolloutRecord, model: RewardModel) -> StepRewards:
        """The rewards that a model predicts."""
        inputs = record.inputs.reshape(-1, record.inputs.shape[2])
        values = model(inputs, record.terminations.reshape(-1)).reshape(record.alive.shape)
        return cls(values, model)

    def slopes(self, record: RolloutRecord) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the rewards.

        Returns:
            Those by states and scaled, applied actions (steps, m, ds + da), and those by the
            probability of a termination (steps, m).
        """
        inputs = record.inputs.reshape(-1, record.inputs.shape[2])
        slopes = self.model.jacobian(inputs, self.values.reshape(-1))
        by_termination = np.where(slopes.any(axis=1), self.model.at_termination, 0.0)
        return slopes.reshape(record.inputs.shape), by_termination.reshape(record.alive.shape)


def average_return(env: ModelEnv, record: RolloutRecord, rewards: FloatArray) -> FloatArray:
    """Average reward per step (m,) of the restarting process, from each start.

    Args:
        env: the model.
        record: rollouts in it.
        rewards: (steps, m) as if no episode had ended.
    """
    earned = env.end_reward + record.alive * (rewards - env.end_reward)
    return step_shares(len(earned), env.restart_probability) @ earned


def action_gradient(
    env: ModelEnv, policy: SparseGP, record: RolloutRecord, rewards: StepRewards
) -> FloatArray:
    """``dJ/da_t`` (steps, m, da): derivatives of the returns by scaled, commanded actions.

    Zero where a larger change would be clipped again.
    """
    steps, count, size = record.states.shape
    shares = step_shares(steps, env.restart_probability)
    flat = record.states.reshape(-1, size)
    of_successor = env.dynamics.jacobian(record.inputs.reshape(steps * count, -1))
    of_successor = of_successor.reshape(steps, count, size, -1)
    of_policy = policy.mean_jacobian(flat).reshape(steps, count, -1, size)
    of_termination = _termination_slopes(env, record)
    inside = env.is_within_range(record.successors)
    of_reward, reward_by_termination = rewards.slopes(record)
    values = rewards.values
    limits = _adjoint_limits(env, shares, values, of_reward, of_termination)
    scale = env.data.states.std(axis=0)
    gradient = np.zeros_like(record.commanded)
    by_state, by_alive = np.zeros((count, size)), np.zeros(count)
    for t in range(steps - 1, -1, -1):
        lengths = np.linalg.norm(by_state * scale, axis=1)
        by_state = inside[t] * limited(by_state, lengths, limits[t])
        earned = shares[t] * record.alive[t]
        by_termination = earned * reward_by_termination[t] - record.alive[t] * by_alive
        by_state += by_termination[:, None] * of_termination[t]
        lost = values[t] - env.end_reward
        by_alive = shares[t] * lost + by_alive * (1.0 - record.terminations[t])
        by_input = np.einsum("mi,mij->mj", by_state, of_successor[t])
        by_input += earned[:, None] * of_reward[t]
        by_action, commanded = by_input[:, size:], record.commanded[t]
        clipped = np.abs(commanded) >= 1.0
        gradient[t] = np.where(clipped & (by_action * commanded > 0.0), 0.0, by_action)
        through_policy = np.where(clipped, 0.0, by_action)
        by_state = by_input[:, :size] + np.einsum("ma,mas->ms", through_policy, of_policy[t])
    return gradient


def limited(vectors: FloatArray, lengths: FloatArray, limit: float) -> FloatArray:
    """Vectors (m, k) of given lengths (m,), scaled down where these are above a limit."""
    factors = np.divide(limit, lengths, out=np.ones_like(lengths), where=lengths > limit)
    return vectors * factors[:, None]


def _termination_slopes(env: ModelEnv, record: RolloutRecord) -> FloatArray:
    """Derivatives (steps, m, ds) of the probabilities of a termination by successors."""
    terminations = env.dynamics.terminations
    if terminations is None:
        return np.zeros_like(record.successors)
    size = record.successors.shape[2]
    slopes = terminations.jacobian(
        record.successors.reshape(-1, size), record.terminations.reshape(-1)
    )
    return slopes.reshape(record.successors.shape)


def _adjoint_limits(
    env: ModelEnv,
    shares: FloatArray,
    values: FloatArray,
    of_reward: FloatArray,
    of_termination: FloatArray,
) -> FloatArray:
    """Largest derivative (steps,) of what is earned after each step, by the scaled state."""
    scale = env.data.states.std(axis=0)
    typical = _root_mean_square(of_reward[:, :, : len(scale)] * scale)
    if of_termination.any():
        lost = np.abs(values - env.end_reward).mean() / (4.0 * env.restart_probability)
        typical += lost * _root_mean_square(of_termination * scale)
    limits: FloatArray = max(typical, TINY) * np.cumsum(shares[::-1])[::-1]
    return limits


def _root_mean_square(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))
