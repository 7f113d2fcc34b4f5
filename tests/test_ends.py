"""Terminations in the dual: an absorbing state without reward, in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

import kreps
from kreps.algorithms.dual import DualProblem
from kreps.algorithms.ends import AbsorbingEnd, solve_with_end, standardise_with_end
from kreps.data.rewards import reward_depends_on_state
from kreps.data.rollouts import Rollout
from kreps.kernels.arrays import FloatArray
from kreps.learning.evaluate import discounted_average

P = 0.05


def chain_problem(
    rewards: FloatArray, ends: FloatArray, *, kl_bound: float, floor: float
) -> DualProblem:
    """One state, as many actions as rewards: V is constant and has no features to be balanced."""
    return DualProblem(
        rewards=rewards,
        differences=np.zeros((len(rewards), 1)),
        kl_bound=kl_bound,
        ridge=1.0,
        eta_floor=floor,
    )


def average_reward(p: FloatArray, rewards: FloatArray, ends: FloatArray) -> float:
    """Of the restarting process, by simulating its cycle: steps, then idling until the restart."""
    idle = (1.0 - P) / P * float(p @ ends)
    return float(p @ rewards) / (1.0 + idle)


@pytest.mark.parametrize("final_reward", [1.5, 5.0, 40.0])
def test_ending_pays_only_if_its_reward_exceeds_that_of_all_steps_to_the_restart(
    final_reward: float,
) -> None:
    # one action earns 1 and goes on, the other ends the episode; restarts are 20 steps apart
    rewards, ends = np.array([1.0, final_reward]), np.array([0.0, 1.0])
    scaled, unit, end = standardise_with_end(rewards, ends.astype(bool), P)
    problem = chain_problem(scaled, ends, kl_bound=0.6, floor=1e-6)
    _, dual, end = solve_with_end(problem, ends, end)
    best = (
        0
        if average_reward(np.array([1.0, 0.0]), rewards, ends)
        > average_reward(np.array([0.0, 1.0]), rewards, ends)
        else 1
    )
    assert best == (1 if final_reward > 20.0 else 0)
    assert dual.weights.argmax() == best
    assert dual.weights[best] > 0.9
    assert end is not None
    g = end.average_reward * unit + rewards.max()
    assert g == pytest.approx(average_reward(dual.weights, rewards, ends), rel=1e-2)


def test_the_old_rule_a_free_restart_would_have_ended_the_episode_at_each_step() -> None:
    rewards, ends = np.array([1.0, 1.5]), np.array([0.0, 1.0])
    problem = chain_problem(rewards - 1.5, ends, kl_bound=0.6, floor=1e-6)
    _, dual, _ = solve_with_end(problem, ends, None)
    assert dual.weights.argmax() == 1


def test_dinkelbachs_method_finds_the_maximum_of_the_ratio_within_the_kl_bound() -> None:
    rng = np.random.default_rng(3)
    rewards, ends = rng.normal(2.0, 1.0, 12), rng.uniform(0.0, 0.3, 12)
    bound = 0.3
    scaled, _unit, end = standardise_with_end(rewards, np.arange(12) < 4, P)
    problem = chain_problem(scaled, ends, kl_bound=bound, floor=1e-6)
    _, dual, _ = solve_with_end(problem, ends, end)

    def softmax(z: FloatArray) -> FloatArray:
        p = np.exp(z - z.max())
        return p / p.sum()

    def kl(z: FloatArray) -> float:
        p = softmax(z)
        return float(p @ np.log(12.0 * p))

    direct = minimize(
        lambda z: -average_reward(softmax(z), rewards, ends),
        np.log(dual.weights + 1e-3),
        constraints=[{"type": "ineq", "fun": lambda z: bound - kl(z)}],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert average_reward(dual.weights, rewards, ends) == pytest.approx(-direct.fun, rel=2e-3)


def test_without_terminations_there_is_no_end_and_the_plain_standardisation() -> None:
    rewards = np.array([0.0, 1.0, 4.0])
    scaled, unit, end = standardise_with_end(rewards, np.zeros(3, bool), P)
    assert end is None
    assert unit == pytest.approx(np.std([0.0, 1.0, 4.0]))
    assert scaled == pytest.approx((rewards - 4.0) / unit)


def test_a_constant_reward_has_the_deviation_of_living_against_not_living() -> None:
    # 1 in each of four steps, of which the last ends: 19 steps without reward follow on average
    scaled, unit, end = standardise_with_end(np.ones(4), np.array([0, 0, 0, 1], bool), P)
    living = 4.0 / 23.0
    assert unit == pytest.approx(np.sqrt(living * (1.0 - living)))
    assert scaled == pytest.approx(np.zeros(4))
    assert end == AbsorbingEnd(
        pytest.approx(-1.0 / unit), pytest.approx((living - 1.0) / unit), pytest.approx(19.0)
    )


def test_rewards_that_are_all_zero_have_no_end_either() -> None:
    scaled, unit, end = standardise_with_end(np.zeros(4), np.array([0, 0, 0, 1], bool), P)
    assert end is None
    assert unit == 1.0
    assert scaled.tolist() == [0.0] * 4


def test_an_evaluation_counts_the_steps_after_a_termination_with_no_reward() -> None:
    # gamma = 0.5: weights 1, 0.5 of the two steps, and 0.25 / 0.5 = 0.5 after the termination
    ended = Rollout(np.zeros((3, 1)), np.zeros((2, 1)), np.array([2.0, 4.0]), True)
    cut_off = Rollout(np.zeros((3, 1)), np.zeros((2, 1)), np.array([2.0, 4.0]), False)
    assert discounted_average([ended], 0.5).mean == pytest.approx(4.0 / 2.0)
    assert discounted_average([cut_off], 0.5).mean == pytest.approx(4.0 / 1.5)


# ---- other methods ----------------------------------------------------------------------------


def ledge(reward_of_end: float) -> list[Rollout]:
    """A ledge in the state 0: staying earns 1 for ever, a step off it ends the episode."""
    stay = Rollout([[0.0], [0.0]], [[-1.0]], [1.0])
    off = Rollout([[0.0], [1.0]], [[1.0]], [reward_of_end], True)
    return [stay, off] * 5


@pytest.mark.parametrize("method", [kreps.ValueIteration, kreps.NPALP])
@pytest.mark.parametrize(("reward_of_end", "best"), [(5.0, -1.0), (19.0, -1.0), (21.0, 1.0)])
def test_value_iteration_and_npalp_step_off_only_for_more_than_all_rewards_to_the_restart(
    method: Any, reward_of_end: float, best: float
) -> None:
    # staying is worth 1 / p = 20
    task = kreps.TaskSpec(1, np.array([-1.0]), np.array([1.0]))
    options = {"temperature": 1e-6} if method is kreps.ValueIteration else {"lipschitz": 100.0}
    learner = method(task, seed=0, restart_probability=P, **options)
    learner.update(ledge(reward_of_end))
    assert learner.policy.process.greedy(np.zeros((1, 1)))[0, 0] == best
    value = float(learner.policy.process.value(np.zeros((1, 1)))[0])
    assert value == pytest.approx(max(20.0, reward_of_end), rel=0.05)


def test_a_reward_of_being_alive_depends_on_the_state_once_an_episode_terminates() -> None:
    task = kreps.TaskSpec(1, np.array([-1.0]), np.array([1.0]))

    def alive(reward: float, terminated: bool) -> Rollout:
        return Rollout(np.zeros((9, 1)), np.zeros((8, 1)), np.full(8, reward), terminated)

    assert reward_depends_on_state(alive(1.0, True), task)
    assert not reward_depends_on_state(alive(1.0, False), task)
    assert not reward_depends_on_state(alive(0.0, True), task)  # nothing is earned in any case


# ---- updates ----------------------------------------------------------------------------------


def cliff(rng: np.random.Generator, rollouts: int) -> list[Rollout]:
    """A point that is pushed by -1 to 1; beyond 1 the episode ends with a reward of 1.5.

    Elsewhere a step earns 1.  With a free restart after the end, going there earns more per step.
    """
    found = []
    for _ in range(rollouts):
        x, actions = [0.0], []
        while len(actions) < 20 and x[-1] <= 1.0:
            actions.append(rng.uniform(-1.0, 1.0))
            x.append(x[-1] + 0.6 * actions[-1])
        ended = x[-1] > 1.0
        rewards = np.ones(len(actions))
        rewards[-1] += 0.5 * ended
        found.append(Rollout(np.array(x)[:, None], np.array(actions)[:, None], rewards, ended))
    return found


@pytest.mark.parametrize("model", ["dynamics", "change"])
@pytest.mark.parametrize(
    "low_rank", [None, kreps.LowRank(above=0), kreps.LowRank(above=0, subsample=200)]
)
def test_a_policy_is_learnt_that_stays_away_from_an_end(
    low_rank: kreps.LowRank | None, model: Any
) -> None:
    task = kreps.TaskSpec(1, np.array([-1.0]), np.array([1.0]))
    learner = kreps.KREPS(
        task,
        seed=0,
        low_rank=low_rank,
        restart_probability=P,
        model=model,
        compute=kreps.Compute(chunk_size=100),
    )
    learner.update(cliff(np.random.default_rng(0), 40))
    near = np.array([[0.5], [0.7], [0.9]])
    action, _ = learner.policy.predict(near, deterministic=True)
    assert (near + 0.6 * action <= 1.0).all()
