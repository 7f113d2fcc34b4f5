"""Roll-outs in the transition model: where they start, go and end, and what becomes of them.

And what policies earn in them: which of two acts on.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.algorithms import low_rank, reps
from kreps.algorithms.acceptance import (
    ETA_FLOOR_WITH_ACCEPTANCE_TEST,
    ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST,
    rejects,
)
from kreps.algorithms.generated import generate
from kreps.algorithms.reps import UpdateInfo
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.models.dynamics import SAMPLES_PER_COEFFICIENT, DeltaStateTargets, Dynamics, fit_dynamics
from kreps.models.model_env import (
    EVALUATION_LENGTHS,
    ModelEnv,
    ModelRollouts,
    average_reward,
    supports_model_rollouts,
)
from kreps.models.novelty import NoveltyBonus
from kreps.models.transition import feature_differences
from kreps.models.world_model import WorldModel
from kreps.policies import cost_sensitive_gp as policies
from kreps.settings import settings_of

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,))
"""An angle and a speed."""

STARTS = np.array([[3.0, 0.0], [-3.0, 0.5]])


def turns(rollouts: int = 6, steps: int = 20, seed: int = 0) -> list[Rollout]:
    """A wheel that is pushed at random from one of two states."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(rollouts):
        states = [STARTS[number % 2]]
        actions = rng.normal(0.0, 1.5, size=(steps, 1))
        for push in TASK.clip(actions)[:, 0]:
            speed = 0.9 * states[-1][1] + 0.2 * push + 0.02 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * speed, speed]))
        observations = np.array(states)
        found.append(Rollout(observations, actions, np.cos(observations[:-1, 0])))
    return found


class Push:
    """Half the largest force, whatever the noise; it keeps what it was asked."""

    def __init__(self, force: float = 1.0) -> None:
        self.force = force
        self.asked: list[FloatArray] = []

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        assert noise.shape == (len(states), 1)
        self.asked.append(states)
        return np.full((len(states), 1), self.force)


def model_env(
    step: FloatArray | None = None, end: float = 0.0, loo_residuals: float = 0.0, **changes: Any
) -> ModelEnv:
    """Of a process in which each action adds its size times a step to the state, and may end it."""
    data = Transitions.from_rollouts(turns())
    step = np.array([0.1, 0.02]) if step is None else step
    slopes = np.zeros((4, 3))
    slopes[3, :2] = step
    slopes[0, 2] = end
    rows = np.arange(len(data))[:, None]
    delta_targets = DeltaStateTargets(np.ones(2), slopes)
    nothing = np.zeros(3)
    dynamics = Dynamics(
        delta_targets,
        lambda inputs: np.zeros((len(inputs), 3)),
        loo_residuals * (rows + 1.0) + nothing,
    )
    kernel = Kernel(TASK.state_factors, np.array([0.5, 0.5]))
    return replace(ModelEnv(dynamics, data, kernel, TASK, 0.1, 0.0, 20), **changes)


# ---- the process ------------------------------------------------------------------------------


def test_each_state_follows_from_one_before_and_the_first_are_starts() -> None:
    policy = Push(1.0)  # half the largest force: (0.05, 0.01) a step
    states, nearest = model_env().rollouts(policy, 100, np.random.default_rng(0))
    assert states.shape == (100, 2) and nearest.shape == (100,)
    np.testing.assert_array_equal(np.concatenate(policy.asked), states)
    first, *later = policy.asked
    assert {tuple(s) for s in first} == {tuple(s) for s in STARTS}
    for before, after in zip(policy.asked, later, strict=False):
        came_from = {tuple(np.round(s + np.array([0.05, 0.01]), 9)) for s in before}
        assert {tuple(np.round(s, 9)) for s in after} <= came_from
        assert len(after) <= len(before)


def test_actions_are_applied_within_their_limits() -> None:
    policy = Push(50.0)
    model_env().rollouts(policy, 40, np.random.default_rng(1))
    np.testing.assert_allclose(
        np.unique(np.round(policy.asked[1] - STARTS[0], 9), axis=0)[-1], [0.1, 0.02]
    )


@pytest.mark.parametrize("count", [1, 2, 17, 1000])
@pytest.mark.parametrize("p", [0.02, 0.5, 0.999])
def test_there_are_as_many_states_as_were_asked_for(count: int, p: float) -> None:
    made = model_env(restart_probability=p)
    states, nearest = made.rollouts(Push(), count, np.random.default_rng(count))
    assert len(states) == len(nearest) == count


def test_lengths_are_those_of_the_restarting_process() -> None:
    policy = Push()
    made = model_env(restart_probability=0.2, longest=1000)
    made.rollouts(policy, 40_000, np.random.default_rng(2))
    at_step = np.array([len(states) for states in policy.asked[:10]])
    np.testing.assert_allclose(at_step[1:] / at_step[:-1], 0.8, atol=0.03)


def test_none_is_longer_than_the_longest_that_was_seen() -> None:
    policy = Push()
    made = model_env(restart_probability=0.001, longest=7)
    states, _ = made.rollouts(policy, 70, np.random.default_rng(3))
    assert len(policy.asked) == 7 and len(states) == 70
    assert {len(each) for each in policy.asked} == {10}


def test_a_share_begins_in_any_sampled_state() -> None:
    for share in (0.0, 0.3, 1.0):
        policy = Push()
        made = model_env(exploring_starts=share, restart_probability=0.5)
        made.rollouts(policy, 4000, np.random.default_rng(4))
        first = policy.asked[0]
        known = {tuple(s) for s in made.data.states}
        assert all(tuple(s) in known for s in first)
        starts = {tuple(s) for s in STARTS}
        elsewhere = np.mean([tuple(s) not in starts for s in first])
        sampled = np.mean([tuple(s) not in starts for s in made.data.states])
        assert elsewhere == pytest.approx(share * sampled, abs=0.05)


def test_a_real_end_ends_them() -> None:
    certain = model_env(end=1.0, restart_probability=0.01)
    states, _ = certain.rollouts(Push(), 100, np.random.default_rng(5))
    assert {tuple(s) for s in states} == {tuple(s) for s in STARTS}
    assert len(states) < 30  # of twenty steps at most the first one is left
    policy = Push()
    made = model_env(end=0.5, restart_probability=1e-3, longest=1000)
    made.rollouts(policy, 10**6, np.random.default_rng(6))
    assert len(policy.asked[1]) / len(policy.asked[0]) == pytest.approx(0.5, abs=0.05)


def test_the_noise_is_that_of_the_nearest_sample_to_either_side() -> None:
    made = model_env(loo_residuals=1e-3)
    policy = Push()
    _, nearest = made.rollouts(policy, 200, np.random.default_rng(7))
    first, second = policy.asked[:2]
    rows = nearest[: len(first)]
    distances = made.kernel.gram(first, made.data.states)
    np.testing.assert_array_equal(distances[np.arange(len(first)), rows], distances.max(axis=1))
    residual_signs = set()
    for state in second:
        away = state - first - [0.05, 0.01]
        found = np.abs(np.abs(away) - 1e-3 * (rows[:, None] + 1.0)).max(axis=1)
        assert found.min() < 1e-9
        residual_signs.add(np.sign(away[found.argmin(), 0]))
    assert residual_signs == {-1.0, 1.0}


def test_they_stay_in_the_range_of_the_data_but_angles_have_none() -> None:
    made = model_env(step=np.array([2.0, 1.0]))
    states, _ = made.rollouts(Push(2.0), 200, np.random.default_rng(8))
    speeds = made.data.points[:, 1]
    assert states[:, 1].max() == speeds.max()
    assert states[:, 0].max() > made.data.points[:, 0].max() + np.pi
    states, _ = made.rollouts(Push(-2.0), 200, np.random.default_rng(8))
    assert states[:, 1].min() == speeds.min()
    assert states[:, 0].min() < made.data.points[:, 0].min() - np.pi


# ---- who has them -----------------------------------------------------------------------------


def test_images_and_few_samples_are_not_simulated() -> None:
    data = Transitions.from_rollouts(turns(2, 2 * SAMPLES_PER_COEFFICIENT))
    assert len(data) == SAMPLES_PER_COEFFICIENT * (1 + 2 + 1)
    assert supports_model_rollouts(data, TASK)
    assert not supports_model_rollouts(
        Transitions.from_rollouts(turns(2, 2 * SAMPLES_PER_COEFFICIENT - 1)), TASK
    )
    image = TaskSpec(4, [-1.0], [1.0], groups=((0, 1, 2, 3),), image_shape=(2, 2))
    plenty = Transitions.from_rollouts(
        [Rollout(np.zeros((5000, 4)), np.zeros((4999, 1)), np.zeros(4999))],
    )
    assert not supports_model_rollouts(plenty, image)
    assert supports_model_rollouts(plenty, replace(image, groups=(), image_shape=None))


def updated(**settings: Any) -> tuple[kreps.KREPS, UpdateInfo]:
    learner = kreps.KREPS(TASK, **settings)
    info = learner.update(turns())
    assert isinstance(info, UpdateInfo)
    return learner, info


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
@pytest.mark.parametrize(
    ("settings", "floor"),
    [
        ({}, ETA_FLOOR_WITH_ACCEPTANCE_TEST),
        ({"judging_rollouts": 0}, ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST),
        ({"imagined": 0}, ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST),  # what is not imagined is not judged
        ({"model": "change"}, ETA_FLOOR_WITHOUT_ACCEPTANCE_TEST),  # nor is what is not simulated
        ({"eta_floor": 0.2}, 0.2),
    ],
)
def test_the_temperature_falls_lower_where_the_policy_is_judged(
    approximation: str, settings: dict[str, Any], floor: float
) -> None:
    learner, first = updated(approximation=approximation, **settings)
    second = learner.update(turns(seed=1))
    assert isinstance(second, UpdateInfo)
    assert second.eta_floor == floor
    assert (second.rejected is not None) == (
        floor == ETA_FLOOR_WITH_ACCEPTANCE_TEST or "eta_floor" in settings
    )
    assert first.eta_floor == floor and first.rejected is None  # there is none beside it


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
@pytest.mark.parametrize(
    ("settings", "led"),
    [({}, True), ({"imagined_rollouts": 0.0}, False), ({"model": "change"}, False)],
)
def test_the_policy_has_targets_where_no_roll_out_was(
    approximation: str, settings: dict[str, Any], from_model_rollouts: bool
) -> None:
    learner, info = updated(approximation=approximation, **settings)
    assert len(info.dual.weights) == (2 if from_model_rollouts else 4) * 120
    seen = {s.tobytes() for r in turns() for s in r.observations}
    support = learner.policy.process.states
    assert any(s.tobytes() not in seen for s in support) is from_model_rollouts


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_a_share_of_the_actions_is_drawn_along_them(
    approximation: str, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = reps if approximation == "exact" else low_rank
    outlooks: list[tuple[WorldModel, Any]] = []

    def watch(world: WorldModel, *others: Any) -> Any:
        outlooks.append((world, generate(world, *others)))
        return outlooks[-1][1]

    monkeypatch.setattr(module, "imagine", watch)
    updated(approximation=approximation, imagined_rollouts=share)
    split_budget = {"sampled": 0, "led to": 0}
    for world, found in outlooks:
        sampled = {s.tobytes() for s in world.states}
        known = np.mean([s.tobytes() in sampled for s in found.states])
        # only the beginnings of simulated roll-outs are states that are known
        assert known == 1.0 or known <= 0.3
        split_budget["sampled" if known == 1.0 else "led to"] += len(found.of)
        if known < 1.0:
            assert set(np.bincount(found.of)) == {round(4 * share)}
    assert split_budget == {"sampled": round(480 * (1.0 - share)), "led to": round(480 * share)}
    assert len(outlooks) == (2 if 0.0 < share < 1.0 else 1)


@pytest.mark.parametrize(("share", "drawn"), [(0.001, "sampled"), (0.999, "led to")])
def test_a_share_of_less_than_one_action_is_none(share: float, sample: str) -> None:
    learner, info = updated(imagined_rollouts=share)
    assert len(info.dual.weights) == 480
    seen = {s.tobytes() for r in turns() for s in r.observations}
    known = np.mean([s.tobytes() in seen for s in learner.policy.process.states])
    assert (known == 1.0) == (sample == "sampled")


def outlook_of(
    rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch, **settings: Any
) -> WorldModel:
    """What the exact update sees, of roll-outs of any width."""
    outlooks: list[WorldModel] = []

    def watch(world: WorldModel, *others: Any) -> Any:
        outlooks.append(world)
        return generate(world, *others)

    monkeypatch.setattr(reps, "imagine", watch)
    task = settings.pop("task", TASK)
    kreps.KREPS(task, approximation="exact", **settings).update(rollouts)
    assert all(world is outlooks[0] for world in outlooks)
    return outlooks[0]


def test_the_update_simulates_its_own_process(monkeypatch: pytest.MonkeyPatch) -> None:
    rollouts = [*turns(2, 12), *turns(2, 31, seed=1), *turns(2, 7, seed=2)]
    world = outlook_of(rollouts, monkeypatch, restart_probability=0.03, exploring_starts=0.4)
    np.testing.assert_allclose(world.phi(world.states), world.features, atol=1e-7)
    made = world.model_env
    assert made is not None
    assert (made.longest, made.restart_probability, made.exploring_starts) == (31, 0.03, 0.4)
    np.testing.assert_array_equal(made.data.states, world.states)


def test_what_cannot_be_simulated_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert outlook_of(turns(2, 19), monkeypatch).model_env is None  # too few
    assert outlook_of(turns(), monkeypatch, model="change").model_env is None
    image = TaskSpec(4, [-1.0], [1.0], groups=((0, 1, 2, 3),), image_shape=(2, 2))
    rng = np.random.default_rng(0)
    shots = [
        Rollout(rng.uniform(size=(41, 4)), rng.uniform(-1, 1, size=(40, 1)), rng.uniform(size=40))
        for _ in range(4)
    ]
    assert outlook_of(shots, monkeypatch, task=image).model_env is None
    plain = replace(image, groups=(), image_shape=None)
    assert outlook_of(shots, monkeypatch, task=plain).model_env is not None


class Known:
    """Roll-outs that are given: three states beside the samples 4, 0 and 2."""

    states = np.array([[0.3, 0.1], [0.7, -0.4], [-0.2, 0.9]])
    nearest = np.array([4, 0, 2])

    def rollouts(self, *arguments: Any) -> tuple[FloatArray, Any]:
        return self.states, self.nearest


@pytest.mark.parametrize("led", [False, True])
def test_each_state_has_its_own_features_and_the_noise_of_its_sample(
    from_model_rollouts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = outlook_of(turns(), monkeypatch)
    n = len(world.states)
    asked: list[tuple[Any, FloatArray]] = []

    def expected_features_at(rows: Any, inputs: FloatArray) -> FloatArray:
        asked.append((rows, inputs))
        return world.expected_features_at(rows, inputs)

    known: Any = Known()
    settings = settings_of(from_generated=2, imagined_rollouts=0.25)
    found = generate(
        replace(world, model_env=known, bonus=None, expected_features_at=expected_features_at),
        np.full(n, 1.0 / n),
        Push(),
        TASK,
        settings,
        0.3,
        np.random.default_rng(0),
        from_model_rollouts,
    )
    ahead = round(0.25 * 2 * n)
    [(rows, inputs)] = asked
    if from_model_rollouts:
        np.testing.assert_array_equal(found.states, Known.states)
        np.testing.assert_array_equal(np.bincount(found.of), np.full(3, ahead / 3))
        np.testing.assert_array_equal(rows, np.repeat(Known.nearest, ahead // 3))
    else:
        assert len(rows) == 2 * n - ahead
        np.testing.assert_array_equal(world.states[rows], found.states[found.of])
    np.testing.assert_array_equal(inputs[:, :2], found.states[found.of])
    wanted = feature_differences(
        world.phi(found.states[found.of]),
        world.expected_features_at(rows, inputs),
        world.restart,
        settings.restart_probability,
    )
    np.testing.assert_allclose(found.problem.differences, wanted, atol=1e-7)
    # it matters which sample a state is nearest to
    other = world.expected_features_at(np.zeros_like(rows), inputs)
    assert np.abs(other - world.expected_features_at(rows, inputs)).max() > 5e-5


def one_silent() -> list[Rollout]:
    """Roll-outs of which one tells nothing of the states."""
    first, *others = turns()
    return [replace(first, rewards=np.full(len(first), others[0].rewards.min())), *others]


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_sampled_states_stay_in_the_policy_where_not_each_roll_out_tells(
    approximation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = reps if approximation == "exact" else low_rank
    fitted: list[reps.PolicyTargets] = []
    fit = module.policy_hyperparameters

    def watch(samples: reps.PolicyTargets, *others: Any) -> FloatArray:
        fitted.append(samples)
        return fit(samples, *others)

    monkeypatch.setattr(module, "policy_hyperparameters", watch)
    shares = []
    for given in (turns(), one_silent()):
        kreps.KREPS(TASK, approximation=approximation).update(given)
        seen = {s.tobytes() for r in given for s in r.observations}
        shares.append(np.mean([s.tobytes() in seen for s in fitted[-1].states]))
    assert shares[0] < 0.3 < shares[1]


def test_the_support_of_an_exact_policy_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    def learnt() -> kreps.KREPS:
        learner = kreps.KREPS(TASK, approximation="exact", kl_bound=0.01)  # all weigh alike
        learner.update(one_silent())
        return learner

    many = learnt()
    count = len(many.policy.process.states)
    assert count > 120  # more targets than samples
    for module in (reps, policies):
        monkeypatch.setattr(module, "MAX_SUPPORT", 120)
    few = learnt()
    assert len(few.policy.process.states) == 120


def test_the_heaviest_targets_stay_in_order() -> None:
    weights = np.array([3.0, 1.0, 4.0, 1.0, 5.0])
    samples = reps.PolicyTargets(
        np.arange(10.0).reshape(5, 2), np.arange(5.0)[:, None], weights, 14.0, np.arange(5.0)
    )
    found = samples.top_by_weight(3)
    np.testing.assert_array_equal(found.weights, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(found.targets[:, 0], [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(found.target_variance, [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(found.states[:, 0], [0.0, 4.0, 8.0])
    assert found.evidence == 14.0
    assert samples.top_by_weight(5) is samples


def test_targets_of_both_steps_make_the_policy() -> None:
    ahead, behind = (
        reps.PolicyTargets(
            np.full((m, 2), float(m)), np.ones((m, 1)), np.full(m, w), m * w, np.zeros(m), spread
        )
        for m, w, spread in ((3, 2.0, 0.5), (4, 6.0, 0.1))
    )
    both = ahead.concat(behind)
    np.testing.assert_array_equal(both.states[:, 0], [3.0] * 3 + [4.0] * 4)
    np.testing.assert_allclose(both.weights, [2.0] * 3 + [6.0] * 4)
    assert both.evidence == pytest.approx(both.weights.sum())
    assert both.spread == pytest.approx((6.0 * 0.5 + 24.0 * 0.1) / 30.0)


def test_a_policy_is_followed_and_not_the_roll_outs() -> None:
    """Pushed to one side in the model, all that it is led to lies on that side."""
    data = Transitions.from_rollouts(turns(20))
    rng = np.random.default_rng(9)
    settings = settings_of(exploring_starts=0.0)
    kernel = reps.state_kernel(data, TASK, rng)
    dynamics, *_ = fit_dynamics(data, kernel, TASK, None, rng)
    made = ModelEnv(dynamics, data, kernel, TASK, settings.restart_probability, 0.0, 20)
    right, _ = made.rollouts(Push(2.0), 400, rng)
    left, _ = made.rollouts(Push(-2.0), 400, rng)
    assert right[:, 1].mean() > 0.5 and left[:, 1].mean() < -0.2
    # pushed for long the speed would go to 4; no more is known than the most that was seen
    most = data.points[:, 1].max()
    assert right[:, 1].max() == pytest.approx(most, rel=0.3)


# ---- what a policy earns in them --------------------------------------------------------------


def angle(inputs: FloatArray) -> FloatArray:
    return inputs[:, 0]


ALIKE = Kernel(TASK.state_factors, np.array([1e9, 1e9]))
"""To which all states are the same."""


def averaged(
    made: ModelEnv,
    policy: Any,
    reward: Any,
    count: int,
    seed: int = 0,
    least: float = -9.0,
    typical: float = 1.0,
) -> FloatArray:
    (model_rollouts,) = made.evaluate([policy], reward, count, np.random.default_rng(seed))
    return average_reward(
        model_rollouts.pessimistic_rewards(least, typical), made.restart_probability
    )


def test_a_step_counts_by_the_chance_that_no_restart_came_before_it() -> None:
    p = 0.1
    steps = ceil(EVALUATION_LENGTHS / p)
    assert (1 - p) ** steps == pytest.approx(np.exp(-EVALUATION_LENGTHS), rel=0.15)
    made = model_env(restart_probability=p, kernel=ALIKE)
    found = averaged(made, Push(1.0), angle, 40)
    share = p * (1 - p) ** np.arange(steps) / (1 - (1 - p) ** steps)
    # each push turns the wheel by 0.05
    wanted = STARTS[:, 0] + 0.05 * share @ np.arange(steps)
    assert found.shape == (40,)
    np.testing.assert_allclose(np.unique(np.round(found, 9)), np.sort(np.round(wanted, 9)))


def test_none_is_followed_for_longer_than_the_longest_that_was_seen() -> None:
    policy = Push()
    made = model_env(restart_probability=1e-6, longest=7)
    (model_rollouts,) = made.evaluate([policy], angle, 4, np.random.default_rng(0))
    assert len(policy.asked) == 7
    assert model_rollouts.rewards.shape == model_rollouts.similarity.shape == (7, 4)


def test_reward_is_of_the_actions_as_they_are_applied() -> None:
    np.testing.assert_allclose(
        averaged(model_env(kernel=ALIKE), Push(50.0), lambda x: x[:, 2], 3), 1.0
    )


def test_after_a_real_end_the_process_begins_again() -> None:
    policy = Push()
    made = model_env(end=1.0)
    averaged(made, policy, angle, 30)
    assert len(policy.asked) == ceil(EVALUATION_LENGTHS / made.restart_probability)
    for states in policy.asked:
        assert {tuple(s) for s in states} == {tuple(s) for s in STARTS}


def test_policies_side_by_side_meet_the_same_chance() -> None:
    """Where ends do not depend on the policy each is followed as it would be alone."""
    made = model_env(loo_residuals=1e-2, end=0.3, exploring_starts=0.5)
    forces = (-1.0, 0.0, 1.0)
    together = made.evaluate([*map(Push, forces)], angle, 20, np.random.default_rng(0))
    for force, concat in zip(forces, together, strict=True):
        (alone,) = made.evaluate([Push(force)], angle, 20, np.random.default_rng(0))
        np.testing.assert_array_equal(concat.terminated, alone.terminated)
        np.testing.assert_allclose(concat.rewards, alone.rewards)
        np.testing.assert_allclose(concat.similarity, alone.similarity)
    assert 0 < together[0].terminated.sum() < together[0].terminated.size
    assert not np.allclose(together[0].rewards, together[2].rewards)
    (other,) = made.evaluate([Push(0.0)], angle, 20, np.random.default_rng(1))
    assert not np.allclose(other.rewards, together[1].rewards)


def test_what_is_not_known_is_the_worst() -> None:
    made = model_env(step=np.array([3.0, 0.0]), kernel=Kernel(TASK.state_factors, np.ones(2)))
    policy = Push(2.0)  # three radians a step, at a speed that is known
    found = averaged(made, policy, lambda x: np.full(len(x), 5.0), 4, least=-7.0, typical=0.8)
    similarity = np.array(
        [made.kernel.gram(states, made.data.states).max(axis=1) for states in policy.asked]
    )
    assert similarity.min() < 0.6 and similarity.max() == pytest.approx(1.0)
    share = (1 - made.restart_probability) ** np.arange(len(similarity))
    wanted = share @ (-7.0 + 12.0 * np.minimum(similarity / 0.8, 1.0)) / share.sum()
    np.testing.assert_allclose(found, wanted)


# ---- which of two acts on ---------------------------------------------------------------------


class Fixed(ModelEnv):
    """Policies earn what they push, give or take what the generator says."""

    def evaluate(
        self, policies: Any, reward: Any, count: int, rng: np.random.Generator
    ) -> list[ModelRollouts]:
        assert self.exploring_starts == 0.0
        draws = rng.standard_normal(count)
        nothing = np.zeros((1, count))
        return [
            ModelRollouts(
                nothing + policy.force * (1.0 + policy.risk * draws) + 100.0 * draws,
                nothing + policy.similarity,
                nothing > 0.0,
            )
            for policy in policies
        ]


class Risky(Push):
    def __init__(self, force: float, risk: float = 0.0, similarity: float = 1.0) -> None:
        super().__init__(force)
        self.risk, self.similarity = risk, similarity


def tested(new: Any, before: Any, count: int = 100, seed: int = 0, **changes: Any) -> bool | None:
    made = model_env(exploring_starts=0.5)
    fixed = Fixed(**{name: getattr(made, name) for name in made.__dataclass_fields__})
    world: Any = WorldModel(
        states=np.zeros((2, 2)),
        features=np.zeros((2, 1)),
        phi=lambda states: states,
        restart=np.zeros(1),
        rewards=np.array([-1000.0, 0.0]),
        expected_features_at=lambda rows, inputs: inputs,
        reward=lambda inputs: inputs[:, :1],
        model_env=fixed,
        bonus=None,
    )
    rng = np.random.default_rng(seed)
    settings = settings_of(judging_rollouts=count)
    return rejects(new, before, replace(world, **changes), settings, rng)


def test_a_policy_that_earns_less_is_refused() -> None:
    # the common chance is two hundred times as large as the difference
    assert tested(Risky(1.0), Risky(1.5)) is True
    assert tested(Risky(1.5), Risky(1.0)) is False
    assert tested(Risky(1.0), Risky(1.0)) is False


def test_what_may_be_chance_is_not_held_against_it() -> None:
    rejected = [tested(Risky(1.0, 8.0), Risky(1.02), seed=seed) for seed in range(200)]
    # the difference is 0.025 standard errors, so chance refuses about one in six
    assert np.mean(np.array(rejected, dtype=float)) == pytest.approx(0.165, abs=0.08)


def test_a_policy_that_leaves_what_is_known_is_refused() -> None:
    assert tested(Risky(2.0, similarity=0.5), Risky(1.0)) is True
    # but where no two states are alike, the states of the policy before are the measure
    assert tested(Risky(2.0, similarity=1e-3), Risky(1.0, similarity=1e-3)) is False
    assert tested(Risky(2.0, similarity=0.0), Risky(1.0, similarity=0.0)) is False


def test_an_optimist_is_judged_by_what_it_hopes_for() -> None:
    bonus = NoveltyBonus(optimistic_reward=100.0, average_reward_=0.0, known_radius=0.1)
    assert tested(Risky(0.5, similarity=0.5), Risky(1.0), bonus=bonus) is False
    assert tested(Risky(0.5), Risky(1.0), bonus=bonus) is True  # there it is known


def test_without_a_policy_before_or_a_simulator_nothing_is_judged() -> None:
    assert tested(Risky(1.0), None) is None
    assert tested(Risky(1.0), Risky(1.5), model_env=None) is None
    assert tested(Risky(1.0), Risky(1.5), count=0) is None


# ---- in an update -----------------------------------------------------------------------------


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_a_policy_that_is_refused_does_not_act(
    approximation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = reps if approximation == "exact" else low_rank
    asked: list[tuple[Any, Any, int]] = []
    said = iter((None, True, False))

    def judge(new: Any, before: Any, world: Any, settings: Any, rng: Any) -> bool | None:
        asked.append((new, before, settings.judging_rollouts))
        return next(said)

    monkeypatch.setattr(module, "refuses", judge)
    learner = kreps.KREPS(TASK, approximation=approximation, judging_rollouts=7)
    policies, infos = [], []
    for seed in range(3):
        info = learner.update(turns(seed=seed))
        assert isinstance(info, UpdateInfo)
        infos.append(info)
        policies.append(learner.state.policy)
    assert [info.rejected for info in infos] == [None, True, False]
    assert ["refused" in info.shown()["note"] for info in infos] == [False, True, False]
    assert policies[1] is policies[0] and policies[2] is not policies[0]
    assert [before for _, before, _ in asked] == [None, policies[0], policies[0]]
    assert asked[1][0] is not policies[0] and asked[2][0] is policies[2]
    assert {count for _, _, count in asked} == {7}


@pytest.mark.parametrize("approximation", ["exact", "pivoted"])
def test_a_resumed_learner_judges_as_it_would_have(approximation: str, tmp_path: Path) -> None:
    learner = kreps.KREPS(TASK, approximation=approximation, kl_bound=0.1)
    for seed in range(2):
        learner.update(turns(seed=seed))
    learner.save(tmp_path / "before")
    again = kreps.KREPS.resume(tmp_path / "before")
    for one in (learner, again):
        info = one.update(turns(seed=2))
        assert isinstance(info, UpdateInfo) and info.rejected is not None
    states = turns()[0].observations
    noise = np.ones((len(states), 1))
    np.testing.assert_array_equal(
        *(one.policy.process.act(states, noise) for one in (learner, again))
    )


def test_what_judges_is_what_the_update_expects(monkeypatch: pytest.MonkeyPatch) -> None:
    world = outlook_of(turns(), monkeypatch)
    inputs = np.random.default_rng(0).normal(size=(50, 3))
    wild = replace(world, reward=lambda x: 1e3 * x[:, :1])
    found = wild.expected_rewards(inputs)
    low, high = world.rewards.min(), world.rewards.max()
    assert (found.min(), found.max()) == (low, high)
    said = world.rewards.mean() + world.reward(inputs)[:, 0]
    np.testing.assert_array_equal(world.expected_rewards(inputs), np.clip(said, low, high))


def test_a_learnt_model_tells_the_better_of_two_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    faster = [replace(r, rewards=r.observations[1:, 1]) for r in turns()]
    world = outlook_of(faster, monkeypatch)
    settings = settings_of(judging_rollouts=20)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        assert rejects(Push(-0.15), Push(0.15), world, settings, rng) is True
        assert rejects(Push(0.15), Push(-0.15), world, settings, rng) is False
