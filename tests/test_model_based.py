"""The model-based step: bounded steps on generated samples, then the acceptance test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.algorithms import candidates, model_based
from kreps.algorithms.acceptance import ModelComparison
from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.generated import StateSource
from kreps.algorithms.low_rank import LowRankBatch
from kreps.algorithms.model_based import (
    GeneratedStep,
    generated_step,
    generates_samples,
    has_acceptance_test,
    has_model_rollouts,
    world_model,
)
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.policy_targets import PolicyTargets, exploration_noise
from kreps.algorithms.report import UpdateInfo
from kreps.algorithms.reps import Step, reps_step
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.algorithms.update import batch_of, update
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray
from kreps.models.transition import state_actions, state_kernel
from kreps.models.world_model import WorldModel
from kreps.policies.sparse_gp import SparseGP
from kreps.presets import settings_of
from kreps.settings import LowRank, Settings

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]), periodic=(0,))
"""An angle and a speed."""

KINDS: dict[str, LowRank | None] = {"exact": None, "low rank": LowRank(above=0)}

exact_and_low_rank = pytest.mark.parametrize("low_rank", KINDS.values(), ids=list(KINDS))


def turns(rollouts: int = 6, steps: int = 20, seed: int = 0) -> list[Rollout]:
    """A wheel that is pushed at random; the reward is the cosine of its angle."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(rollouts):
        states = [np.array([[3.0, 0.0], [-3.0, 0.5]][number % 2])]
        actions = rng.normal(0.0, 1.5, size=(steps, 1))
        for push in TASK.clip(actions)[:, 0]:
            speed = 0.9 * states[-1][1] + 0.2 * push + 0.02 * rng.normal()
            states.append(np.array([states[-1][0] + 0.3 * speed, speed]))
        observations = np.array(states)
        found.append(Rollout(observations, actions, np.cos(observations[:-1, 0])))
    return found


def one_uninformative() -> list[Rollout]:
    """Rollouts of which one has a constant reward."""
    first, *others = turns()
    return [replace(first, rewards=np.full(len(first), others[0].rewards.min())), *others]


def faster() -> list[Rollout]:
    """The reward is the speed after the step."""
    return [replace(rollout, rewards=rollout.observations[1:, 1]) for rollout in turns()]


@dataclass(frozen=True)
class Case:
    """The state of an update before its model-based step."""

    batch: Any
    state: LearnerState
    step: Step
    world: WorldModel
    rng: np.random.Generator

    @classmethod
    def learnt(
        cls, samples: list[Rollout] | None = None, task: TaskSpec = TASK, **changes: Any
    ) -> Case:
        rng, state = np.random.default_rng(3), LearnerState(ReplayWindow(task, 30))
        settings = settings_of(**changes)
        batch = batch_of(state, turns() if samples is None else samples, settings, rng, Compute())
        step = reps_step(batch, state, 0.01, rng)
        world = replace(world_model(batch, step, state, rng)[0], bonus=None)
        rng.integers(2**63)  # the seed of the comparisons
        return cls(batch, state, step, world, rng)

    def generated(
        self, previous: GeneratedStep | None, source: StateSource, deflated: bool = False
    ) -> GeneratedStep:
        return generated_step(
            self.batch, self.world, self.step, previous, source, deflated, self.rng
        )


def updated(samples: list[Rollout] | Dataset, **settings: Any) -> tuple[kreps.KREPS, UpdateInfo]:
    learner = kreps.KREPS(TASK, seed=settings.pop("seed", 0), **settings)
    info = learner.update(samples)
    assert isinstance(info, UpdateInfo)
    return learner, info


# ---- updates with a model-based step ----------------------------------------------------------


IMAGE = TaskSpec(4, [-1.0], [1.0], groups=((0, 1, 2, 3),), image_shape=(2, 2))


def shots() -> list[Rollout]:
    """Random images, enough of them for model rollouts."""
    rng = np.random.default_rng(0)
    return [
        Rollout(rng.uniform(size=(41, 4)), rng.uniform(-1, 1, size=(40, 1)), rng.uniform(size=40))
        for _ in range(4)
    ]


@exact_and_low_rank
@pytest.mark.parametrize(
    ("changes", "samples", "task", "steps"),
    [
        ({}, turns(), TASK, (True, True, True)),
        ({"model_based": None}, turns(), TASK, (False, False, False)),
        ({"model_based.acceptance_rollouts": 0}, turns(), TASK, (True, True, False)),
        ({"model": "change"}, turns(), TASK, (True, False, False)),
        ({}, turns(2, 19), TASK, (True, False, False)),  # fewer than 40 samples
        ({}, shots(), IMAGE, (True, False, False)),
        ({}, shots(), replace(IMAGE, groups=(), image_shape=None), (True, True, True)),
    ],
)
def test_which_updates_have_generated_samples_model_rollouts_and_a_test(
    low_rank: LowRank | None,
    changes: dict[str, Any],
    samples: list[Rollout],
    task: TaskSpec,
    steps: tuple[bool, bool, bool],
) -> None:
    state, settings = LearnerState(ReplayWindow(task, 30)), settings_of(**changes)
    settings = replace(settings, low_rank=low_rank)
    batch = batch_of(state, samples, settings, np.random.default_rng(0), Compute())
    found = generates_samples(batch), has_model_rollouts(batch), has_acceptance_test(batch)
    assert found == steps
    if steps[0]:
        case = Case.learnt(samples, task, low_rank=low_rank, **changes)
        assert (case.world.model_env is not None) == steps[1]


@exact_and_low_rank
def test_no_samples_are_generated_until_a_reward_depends_on_the_state(
    low_rank: LowRank | None,
) -> None:
    level = [replace(rollout, rewards=np.full(len(rollout), -1.0)) for rollout in turns()]
    _, info = updated(level, low_rank=low_rank)
    assert len(info.dual.weights) == info.samples
    assert "generated samples" not in info.seconds
    _, info = updated([*level[:3], *turns(3)], low_rank=low_rank)
    assert "generated samples" in info.seconds


def test_an_update_from_a_data_set_generates_no_samples() -> None:
    _, info = updated(Dataset.from_rollouts(turns()))
    assert len(info.dual.weights) == info.samples == 120
    assert "generated samples" not in info.seconds


@exact_and_low_rank
@pytest.mark.parametrize(
    "settings", [{"model_based": None}, {"model": "sample", "preset": "single_step"}]
)
def test_without_a_model_based_step_the_weights_are_those_of_the_samples(
    low_rank: LowRank | None, settings: dict[str, Any]
) -> None:
    _, info = updated(turns(), low_rank=low_rank, **settings)
    assert len(info.dual.weights) == info.samples == 120
    assert "generated samples" not in info.seconds and "acceptance test" not in info.seconds


@exact_and_low_rank
def test_the_model_rollouts_are_those_of_the_updates_process(low_rank: LowRank | None) -> None:
    rollouts = [*turns(2, 12), *turns(2, 31, seed=1), *turns(2, 7, seed=2)]
    case = Case.learnt(rollouts, low_rank=low_rank, restart_probability=0.03, exploring_starts=0.4)
    world = case.world
    np.testing.assert_allclose(world.phi(world.states), world.features, atol=1e-7)
    env = world.model_env
    assert env is not None
    assert (env.max_steps, env.restart_probability, env.exploring_starts) == (31, 0.03, 0.4)
    np.testing.assert_array_equal(env.data.states, world.states)
    assert world.reward_model.mean == case.batch.rewards.mean()
    smallest, largest = case.batch.rewards.min(), case.batch.rewards.max()
    assert (world.reward_model.smallest, world.reward_model.largest) == (smallest, largest)


# ---- the two steps ----------------------------------------------------------------------------


@exact_and_low_rank
def test_each_step_starts_from_v_of_the_step_before_and_its_temperature_if_above_one(
    low_rank: LowRank | None,
) -> None:
    case = Case.learnt(low_rank=low_rank)
    first = case.generated(None, StateSource.REPLAY)
    second = case.generated(first, StateSource.MODEL_ROLLOUT)
    matters = []
    hot = replace(first, dual=replace(first.dual, eta=3.0))
    third = case.generated(hot, StateSource.MODEL_ROLLOUT)
    assert first.dual.eta < 1.0 and case.step.dual.eta < 1.0
    for before, found in ((case.step, first), (first, second), (hot, third)):
        rewards = found.samples.problem.rewards
        problem = replace(found.samples.problem, rewards=rewards - rewards.max())
        wanted = solve_dual(problem, start=(max(1.0, before.dual.eta), before.dual.theta))
        np.testing.assert_array_equal(found.dual.weights, wanted.weights)
        assert found.dual.iterations == wanted.iterations
        cold = solve_dual(problem)
        matters.append(not np.array_equal(found.dual.weights, cold.weights))
    assert any(matters)  # a start that is worse than none is not used
    assert len(first.dual.weights) == len(second.dual.weights) == 240
    problems = first.samples.problem, second.samples.problem
    for problem in problems:
        assert problem.ridge * 240 == pytest.approx(case.step.problem.ridge * 120)
        assert problem.kl_bound == case.step.problem.kl_bound
        assert problem.eta_floor == case.step.problem.eta_floor == 0.01


@pytest.mark.parametrize("gain", [-1.0, 1.0])
def test_a_random_policy_explores_if_it_is_better_and_never_acts(
    gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[SparseGP] = []
    compare = ModelComparison.returns

    def draw(
        comparison: ModelComparison, policy: SparseGP, count: int, rng: np.random.Generator
    ) -> SparseGP:
        assert comparison.world.bonus is not None and count == 20
        drawn.append(replace(policy, mean_weights=-policy.mean_weights))
        return drawn[-1]

    def returns(comparison: ModelComparison, policy: Any, copies: int = 1) -> FloatArray:
        if drawn and policy is drawn[-1]:
            return np.full(comparison.rollouts, gain * 1e6)
        return compare(comparison, policy, copies)

    monkeypatch.setattr(candidates, "best_random_policy", draw)
    monkeypatch.setattr(ModelComparison, "returns", returns)
    learner, _ = updated(turns(), **{"model_based.gradient_steps": 0})
    assert len(drawn) == 1
    assert (learner.state.explorer is drawn[0]) == (gain > 0.0)
    assert learner.state.policy is not drawn[0]


@pytest.mark.parametrize("ends", [True, False])
def test_where_episodes_end_a_policy_has_to_reach_what_the_previous_one_earned(
    ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Better in the model is not enough then."""
    monkeypatch.setattr(model_based, "is_rejected", lambda gain, has_ends: False)
    rollouts = [replace(each, terminated=ends) for each in turns()]
    parts = ("random_policies", "improvement_steps", "regulators", "gradient_steps")
    quick = {f"model_based.{part}": 0 for part in parts}
    for real, rejected in ((None, False), (1e6, ends), (-1e6, False)):
        monkeypatch.setattr(model_based, "real_return", lambda *arguments, real=real: real)
        learner, first = updated(rollouts, **quick)
        assert first.rejected is None
        second = learner.update(rollouts)
        assert isinstance(second, UpdateInfo) and second.rejected is rejected


@exact_and_low_rank
def test_an_update_is_algorithm_1_and_the_two_generated_steps(low_rank: LowRank | None) -> None:
    """The same random numbers give the same bytes."""
    state = LearnerState(ReplayWindow(TASK, 30))
    steps = {
        "model_based.improvement_steps": 0,
        "model_based.random_policies": 0,
        "model_based.regulators": 0,
        "model_based.gradient_steps": 0,
    }
    settings = settings_of(low_rank=low_rank, **steps)
    after, info = update(state, turns(), settings, np.random.default_rng(3), Compute())
    case = Case.learnt(low_rank=low_rank)
    first = case.generated(None, StateSource.REPLAY)
    # the last policy acts, with its standard deviation deflated
    second = case.generated(first, StateSource.MODEL_ROLLOUT, deflated=True)
    np.testing.assert_array_equal(info.dual.weights, second.dual.weights)
    np.testing.assert_array_equal(after.policy_start, second.policy.x)
    np.testing.assert_array_equal(info.policy_parameters, np.exp(second.policy.x))
    assert after.policy is not None
    np.testing.assert_array_equal(
        after.policy.greedy(np.eye(2)), second.policy.policy.greedy(np.eye(2))
    )
    assert info.noise == second.policy.noise
    assert len({id(each.policy) for each in (case.step.policy, first.policy, second.policy)}) == 3


class RecordingBatch(ExactBatch):
    """Records the start points of the fits of policy and reward model."""

    def __init__(self, state: LearnerState, rollouts: list[Rollout], settings: Settings) -> None:
        super().__init__(state.append(rollouts), rollouts, settings, Stopwatch())
        self.policy_starts: list[FloatArray | None] = []
        self.reward_starts: list[FloatArray | None] = []

    def fit_policy(self, targets: Any, kernel: Any, start: Any, *others: Any) -> Any:
        self.policy_starts.append(start)
        return super().fit_policy(targets, kernel, start, *others)

    def fit_reward(self, kernel: Any, start: Any, rng: Any) -> Any:
        self.reward_starts.append(start)
        return super().fit_reward(kernel, start, rng)


def test_each_fit_of_the_policy_starts_from_the_one_before() -> None:
    settings, rng = settings_of(), np.random.default_rng(0)
    state, _ = update(LearnerState(ReplayWindow(TASK, 30)), turns(seed=1), settings, rng, Compute())
    batch = RecordingBatch(state, turns(), settings)
    step = reps_step(batch, state, 0.01, rng)
    world, reward_start = world_model(batch, step, state, rng)
    first = generated_step(batch, world, step, None, StateSource.REPLAY, False, rng)
    generated_step(batch, world, step, first, StateSource.MODEL_ROLLOUT, True, rng)
    starts = batch.policy_starts
    assert len(starts) == 3
    assert starts[0] is state.policy_start
    assert starts[1] is step.policy.x
    assert starts[2] is first.policy.x
    assert batch.reward_starts == [state.reward_start]
    assert reward_start.shape == (5,) and not np.array_equal(reward_start, state.reward_start)


@exact_and_low_rank
@pytest.mark.parametrize(
    ("changes", "visited"),
    [
        ({}, True),
        ({"model_based.model_rollout_fraction": 0.0}, False),
        ({"model": "change"}, False),
    ],
)
def test_the_policy_has_targets_in_visited_states_if_there_are_model_rollouts(
    low_rank: LowRank | None, changes: dict[str, Any], visited: bool
) -> None:
    learner, info = updated(turns(), low_rank=low_rank, **changes)
    assert len(info.dual.weights) == (2 if visited else 4) * 120
    seen = {s.tobytes() for r in turns() for s in r.observations}
    support = learner.policy.process.states
    assert any(s.tobytes() not in seen for s in support) is visited


@exact_and_low_rank
def test_targets_in_replayed_states_are_kept_if_a_rollout_is_uninformative(
    low_rank: LowRank | None,
) -> None:
    for samples, kept in ((turns(), False), (one_uninformative(), True)):
        case = Case.learnt(samples, low_rank=low_rank)
        first = case.generated(None, StateSource.REPLAY)
        second = case.generated(first, StateSource.MODEL_ROLLOUT)
        alone = PolicyTargets.from_generated(second.samples, second.dual.weights, TASK)
        wanted = alone.concat(first.targets) if kept else alone
        np.testing.assert_array_equal(second.targets.states, wanted.states)
        np.testing.assert_array_equal(second.targets.weights, wanted.weights)
        assert second.targets.total_weight == wanted.total_weight


def test_an_exact_policy_has_at_most_one_support_point_per_replayed_state() -> None:
    settings = {
        "model_based.actions_per_state": 20,
        "model_based.model_rollout_fraction": 0.0,
        "model_based.regulators": 0,
        "model_based.gradient_steps": 0,
    }
    learner, info = updated(turns(), **settings)
    assert len(info.dual.weights) == 20 * 120
    assert 30 < info.support <= 120
    assert info.support == len(learner.state.policy.states)  # type: ignore[union-attr]
    seen = {s.tobytes() for r in turns() for s in r.observations[:-1]}
    assert {s.tobytes() for s in learner.state.policy.states} <= seen  # type: ignore[union-attr]


@exact_and_low_rank
def test_actions_are_sampled_with_inflated_deviation_and_the_policy_is_deflated(
    low_rank: LowRank | None,
) -> None:
    standardised = {}
    for scale in (1.0, 1.7):
        changes = {"model_based.actions_per_state": 20, "model_based.proposal_std_scale": scale}
        case = Case.learnt(low_rank=low_rank, **changes)
        first = case.generated(None, StateSource.REPLAY)
        second = case.generated(first, StateSource.MODEL_ROLLOUT, deflated=True)
        for source, before, found in (("replay", case.step, first), ("visited", first, second)):
            states = found.samples.states[found.samples.state_of]
            policy = before.policy.policy
            deviation = (found.samples.actions - policy.greedy(states)) / (
                policy.standard_deviation(states)
            )
            standardised[source, scale] = deviation
        signal, fitted = np.exp(second.policy.x[-2:])
        noise = exploration_noise(second.targets, float(fitted))[1]
        assert second.policy.policy.signal == pytest.approx(signal / scale**2)  # type: ignore[attr-defined]
        assert second.policy.noise == pytest.approx(noise / scale**2)
    for source in ("replay", "visited"):
        assert np.std(standardised[source, 1.0]) == pytest.approx(1.0, rel=0.1)
        assert np.std(standardised[source, 1.7]) == pytest.approx(1.7, rel=0.1)
    np.testing.assert_allclose(
        standardised["replay", 1.7], 1.7 * standardised["replay", 1.0], atol=1e-6
    )


class FirstRows(np.random.Generator):
    """Draws the first rows in place of random ones."""

    def choice(self, n: Any, size: Any = None, replace: bool = True, *_: Any) -> Any:
        return np.arange(size)


def test_the_reward_model_of_a_subsample_regularises_like_that_of_all_samples() -> None:
    """Four copies of each sample, of which one is in memory."""
    copies, noise = 4, np.random.default_rng(1)
    samples = [replace(r, rewards=r.rewards + noise.normal(size=len(r))) for r in turns(2)]
    window = ReplayWindow(TASK, None).append(samples * copies)
    low_rank = LowRank(subsample=40)
    rng = FirstRows(np.random.PCG64(0))
    batch = LowRankBatch(window, [], settings_of(), low_rank, Stopwatch(), Compute(), rng)
    assert (batch.size, len(batch.data)) == (160, 40)
    kernel = state_kernel(batch.data, TASK, np.random.default_rng(0))
    model, x = batch.fit_reward(kernel, None, np.random.default_rng(0))

    whole = ReplayWindow(TASK, None).append(samples * copies).transitions
    inputs = state_actions(whole, TASK)
    scale = np.exp(x[:-1])
    angles = np.column_stack([np.cos(inputs[:, 0]), np.sin(inputs[:, 0])]) / scale[0]
    wrapped = np.mod(inputs[:, 0] - kernel_begin(batch), 2.0 * np.pi) / scale[2]
    embedded = np.column_stack([angles, inputs[:, 1] / scale[1], wrapped, inputs[:, 2] / scale[3]])
    squares = np.sum((embedded[:, None] - embedded[None]) ** 2, axis=2)
    gram = np.exp(-0.5 * squares)
    targets = np.tile(batch.rewards - batch.rewards.mean(), copies)
    wanted = gram @ np.linalg.solve(gram + np.exp(x[-1]) * np.eye(160), targets)
    error = np.abs(model.regression(inputs)[:, 0] - wanted).max()
    # with the whole ridge the predictions of a quarter of the samples would be smoother
    part = gram[:40, :40]
    other = part @ np.linalg.solve(part + np.exp(x[-1]) * np.eye(40), targets[:40])
    assert error < 0.05 * np.abs(other - wanted[:40]).max()


def kernel_begin(batch: LowRankBatch) -> float:
    """Where the angles of the reward model wrap around."""
    angles = batch.data.points[:, 0]
    return float(0.5 * (angles.min() + angles.max()) - np.pi)


@pytest.mark.parametrize("seed", range(4))
def test_generated_actions_improve_on_those_that_were_sampled(seed: int) -> None:
    """The reward is largest at an action of 1, while the sampled ones are around -0.5."""
    rng = np.random.default_rng(seed)
    task = TaskSpec(2, np.array([-2.0]), np.array([2.0]))
    rollouts = []
    for _ in range(15):
        observations = rng.uniform(-1.0, 1.0, size=(9, 2))
        actions = rng.normal(-0.5, 0.6, size=(8, 1))
        rewards = -((actions[:, 0] - 1.0) ** 2) - 1e-3 * observations[:-1, 0] ** 2
        rollouts.append(Rollout(observations, actions, rewards))
    states = rng.uniform(-0.8, 0.8, size=(50, 2))
    means = []
    for changes in ({"preset": "single_step"}, {"model_based.exploration_bonus": 0.0}):
        learner = kreps.KREPS(task, **changes)  # type: ignore[arg-type]
        learner.update(rollouts)
        means.append(float(learner.policy.process.greedy(states).mean()))
    single, generated = means
    assert -0.5 < single < generated < 1.3
    assert abs(generated - 1.0) < 0.8 * abs(single - 1.0)


# ---- the acceptance test in an update ---------------------------------------------------------


class Push:
    """A constant action as the previous policy."""

    def __init__(self, force: float) -> None:
        self.force = force

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return np.full((len(states), 1), self.force)


@exact_and_low_rank
@pytest.mark.parametrize(("force", "rejected"), [(2.0, True), (-2.0, False)])
def test_a_rejected_policy_does_not_act(
    low_rank: LowRank | None, force: float, rejected: bool
) -> None:
    without = {"model_based.regulators": 0}
    settings = settings_of(low_rank=low_rank, kl_bound=0.01, **without)
    previous: Any = Push(force)
    state = replace(LearnerState(ReplayWindow(TASK, 30)), policy=previous, iteration=9)
    after, info = update(state, faster(), settings, np.random.default_rng(0), Compute())
    assert info.rejected is rejected
    assert (after.policy is previous) is rejected
    assert ("rejected" in info.shown()["note"]) is rejected
    assert after.value is not None and after.policy_start is not None  # of the update itself
    assert after.iteration == 10


@exact_and_low_rank
def test_the_first_policy_is_not_tested(low_rank: LowRank | None) -> None:
    _, info = updated(turns(), low_rank=low_rank)
    assert info.rejected is None
    assert "rejected" not in info.shown()["note"]


@exact_and_low_rank
@pytest.mark.parametrize(
    ("changes", "floor", "tested"),
    [
        ({}, 0.01, True),
        ({"model_based.acceptance_rollouts": 0}, 0.05, False),
        ({"model_based": None}, 0.05, False),
        ({"model": "change"}, 0.05, False),
        ({"eta_floor": 0.2}, 0.2, True),
    ],
)
def test_the_temperature_floor_is_lower_where_policies_are_tested(
    low_rank: LowRank | None, changes: dict[str, Any], floor: float, tested: bool
) -> None:
    learner, first = updated(turns(), low_rank=low_rank, **changes)
    second = learner.update(turns(seed=1))
    assert isinstance(second, UpdateInfo)
    assert (first.eta_floor, first.rejected) == (floor, None)
    assert second.eta_floor == floor
    assert (second.rejected is not None) == tested


@exact_and_low_rank
def test_a_resumed_learner_tests_its_policy_in_the_same_way(
    low_rank: LowRank | None, tmp_path: Any
) -> None:
    steps = {"model_based.improvement_steps": 2}
    learner = kreps.KREPS(TASK, low_rank=low_rank, kl_bound=0.1, **steps)
    for seed in range(2):
        learner.update(turns(seed=seed))
    learner.save(tmp_path / "before")
    again = kreps.KREPS.resume(tmp_path / "before")
    infos = [each.update(turns(seed=2)) for each in (learner, again)]
    assert infos[0].rejected is infos[1].rejected is not None  # type: ignore[attr-defined]
    states = turns()[0].observations
    noise = np.ones((len(states), 1))
    np.testing.assert_array_equal(
        *(each.policy.process.act(states, noise) for each in (learner, again))
    )
    # of the update itself, also where the previous policy is kept
    np.testing.assert_array_equal(learner.state.policy_start, again.state.policy_start)


# ---- exact and low rank -----------------------------------------------------------------------


@exact_and_low_rank
def test_one_seed_gives_one_learner_byte_for_byte(low_rank: LowRank | None, tmp_path: Any) -> None:
    contents, actions = [], []
    for seed in (7, 7, 8):
        learner, info = updated(turns(), seed=seed, low_rank=low_rank)
        assert "generated samples" in info.seconds
        learner.save(tmp_path / "learner")
        contents.append((tmp_path / "learner").read_bytes())
        actions.append(learner.policy.process.greedy(np.eye(2)))
    assert contents[0] == contents[1]
    np.testing.assert_array_equal(actions[0], actions[1])
    assert np.abs(actions[2] - actions[0]).min() > 1e-6  # other actions were generated
