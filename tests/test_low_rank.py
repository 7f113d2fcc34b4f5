"""REPS in low rank: the exact update at full rank, and the same on chunks as in memory."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.algorithms import low_rank
from kreps.algorithms.dual import DualProblem, DualSolution, Outcome, kl_from_uniform
from kreps.algorithms.newton import GAP_TOLERANCE, KL_TOLERANCE, solve_dual
from kreps.algorithms.reps import (
    MIN_RELATIVE_WEIGHT,
    PolicyTargets,
    UpdateInfo,
    policy_hyperparameters,
)
from kreps.algorithms.streaming import StreamedProblem
from kreps.data import dataset as dataset_module
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError
from kreps.kernels import regression as embedding
from kreps.kernels.arrays import FloatArray, IntArray
from kreps.kernels.basis import FourierExpansion, KernelExpansion
from kreps.learning.collect import collect
from kreps.policies import cost_sensitive_gp as policies
from kreps.policies.exploration import BangBang
from kreps.policies.sparse_gp import SparseGP
from kreps.settings import Settings

TASK = TaskSpec(2, [-30.0], [30.0], (0,))  # type: ignore[arg-type]
FULL: dict[str, Any] = {"basis_tolerance": 1e-9, "max_rank": 5000, "rank": 5000}
LOW: dict[str, Any] = {"max_rank": 60, "rank": 80}


def swing_ups(seed: int, rollouts: int) -> list[Rollout]:
    env = gym.make("kreps/SwingUp-v0")
    return collect(
        env,
        TASK,
        BangBang(TASK),
        rollouts,
        seed=seed,
        iteration=0,
        restart_probability=0.02,
    )


@pytest.fixture(scope="module")
def rollouts() -> list[Rollout]:
    """345 samples; no more than 400, so that no fit has to choose among them at random."""
    found = swing_ups(1, 6)
    assert 300 < sum(map(len, found)) < 400
    return found


def updated(
    given: list[Rollout] | Dataset, compute: Compute | None = None, seed: int = 0, **settings: Any
) -> tuple[kreps.KREPS, UpdateInfo]:
    """One update, of one step unless another recipe is asked for."""
    settings = {"recipe": "observed", **settings}
    learner = kreps.KREPS(TASK, seed=seed, compute=compute, **settings)
    info = learner.update(given)
    assert isinstance(info, UpdateInfo)
    return learner, info


def visited(rollouts: list[Rollout]) -> FloatArray:
    return np.concatenate([r.observations[:-1] for r in rollouts])


def shift(found: UpdateInfo, wanted: UpdateInfo) -> float:
    """Between the weights, as a share of all: between 0 and 2."""
    return float(np.abs(found.dual.weights - wanted.dual.weights).sum())


def moments(learner: kreps.KREPS, states: FloatArray) -> FloatArray:
    """Means and standard deviations of the actions, in units of the action scale."""
    process = learner.policy.process
    return np.concatenate([process.greedy(states), process.standard_deviation(states)]) / 30.0


def assert_close(
    found: tuple[kreps.KREPS, UpdateInfo],
    wanted: tuple[kreps.KREPS, UpdateInfo],
    states: FloatArray,
    *,
    weights: float,
    policy: float,
) -> None:
    """Weights and V to one tolerance, relative to their sum and range, the policy to another."""
    assert shift(found[1], wanted[1]) < weights
    v, truth = found[0].value_function(states), wanted[0].value_function(states)
    assert np.abs(v - truth).max() < weights * np.ptp(truth)
    assert np.abs(moments(found[0], states) - moments(wanted[0], states)).max() < policy


def assert_certified(info: UpdateInfo, kl_bound: float = 1.0) -> None:
    """The bound is met, and the dual value proves that nothing better could have been found."""
    dual = info.dual
    assert dual.outcome is Outcome.BOUND_ACTIVE
    assert dual.weights.shape == (info.samples,)
    assert dual.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert kl_from_uniform(dual.weights) == pytest.approx(kl_bound, rel=1.01 * KL_TOLERANCE)
    # What the gap consists of: not stationary, and off the bound.
    assert abs(dual.gap) <= GAP_TOLERANCE + 1.01 * dual.eta * KL_TOLERANCE * kl_bound


def content(learner: kreps.KREPS, path: Path) -> bytes:
    learner.save(path / "checkpoint.safetensors")
    return (path / "checkpoint.safetensors").read_bytes()


# ---- at full rank -----------------------------------------------------------------------------

VARIANTS: dict[str, dict[str, Any]] = {
    "dynamics": {"model": "dynamics"},
    "change": {},
    "embedding": {"model": "embedding"},
    "sample": {"model": "sample"},
    "grid": {"features": "grid", "grid_size": 6},
    "grid of the sample": {"features": "grid", "grid_size": 6, "model": "sample"},
    "paper": {"recipe": "paper", "eta_floor": 0.0},
    "exploring starts": {"exploring_starts": 0.5},
}


@pytest.fixture
def nothing_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exact update leaves out of the dynamics what their noise hides; here next to nothing."""
    for module in (embedding, policies):
        monkeypatch.setattr(module, "MAX_RESIDUAL_RATIO", 1e-9)


@pytest.mark.usefixtures("nothing_left_out")
@pytest.mark.parametrize("variant", VARIANTS)
def test_at_full_rank_it_is_the_exact_update(variant: str, rollouts: list[Rollout]) -> None:
    settings = FULL | VARIANTS[variant]
    exact = updated(rollouts, approximation="exact", **settings)
    found = updated(rollouts, approximation="pivoted", **settings)
    assert isinstance(found[0].policy.process, SparseGP)
    assert found[1].samples == exact[1].samples == 345
    assert found[1].rank == exact[1].rank
    # A squared residual of 1e-9 in the embedding's kernel moves the weights by 1e-8, as measured;
    # in the policy's, divided by its noise, the mean by 2e-7.
    assert_close(found, exact, visited(rollouts), weights=1e-6, policy=1e-5)


def test_it_learns_commands_beyond_the_limits_as_they_were_given(rollouts: list[Rollout]) -> None:
    beyond = [replace(r, actions=1.5 * r.actions) for r in rollouts]
    exact = updated(beyond, approximation="exact", **FULL)
    found = updated(beyond, approximation="pivoted", **FULL)
    assert np.abs(moments(exact[0], visited(rollouts))).max() > 1.1
    assert_close(found, exact, visited(rollouts), weights=1e-6, policy=5e-5)


@pytest.mark.usefixtures("nothing_left_out")
@pytest.mark.parametrize("model", ["dynamics", "change", "embedding", "sample"])
def test_steps_that_really_end_are_followed_by_the_mean_start(
    model: str, rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = [replace(r, terminated=i % 2 == 0) for i, r in enumerate(rollouts)]
    exact = updated(ended, approximation="exact", model=model, **FULL)
    found = updated(ended, approximation="pivoted", model=model, **FULL)
    assert_close(found, exact, visited(rollouts), weights=1e-6, policy=1e-5)
    _, unended = updated(rollouts, approximation="pivoted", model=model, **FULL)
    assert shift(found[1], unended) > 1e-3  # that they end is felt
    # In chunks the start states of one chunk count for the ends of another.
    monkeypatch.setattr(dataset_module, "CHUNK", 50)
    in_chunks = updated(ended, approximation="pivoted", model=model, **FULL)
    assert_close(in_chunks, exact, visited(rollouts), weights=1e-6, policy=1e-5)


# Random Fourier features err by the root of 2 / 345, pivots at random by what few points are left.
@pytest.mark.parametrize(("approximation", "error"), [("uniform", 1e-2), ("fourier", 0.3)])
def test_other_features_come_near_the_exact_update_too(
    approximation: str, error: float, rollouts: list[Rollout]
) -> None:
    exact, wanted = updated(rollouts, approximation="exact")
    few, coarse = updated(rollouts, approximation=approximation, max_rank=10, rank=10)
    many, fine = updated(rollouts, approximation=approximation, max_rank=345, rank=345)
    assert_certified(fine)
    # Measured with four seeds: 0.7 to 1 with 10 features; 2e-5 to 4e-3, or 0.14 to 0.21, with 345.
    assert shift(fine, wanted) < error < 0.6 < shift(coarse, wanted)
    states = visited(rollouts)
    few_v, many_v, v = (each.value_function(states) for each in (few, many, exact))
    assert np.corrcoef(many_v, v)[0, 1] > 0.97 > 0.8 > np.corrcoef(few_v, v)[0, 1]


@pytest.mark.parametrize("variant", ["change", "embedding", "sample"])
def test_the_error_falls_as_the_rank_grows(variant: str, rollouts: list[Rollout]) -> None:
    exact, wanted = updated(rollouts, approximation="exact", **VARIANTS[variant])
    states = visited(rollouts)
    weights, policies = [], []
    for rank in (20, 60, 90, 180):
        found, info = updated(
            rollouts, approximation="pivoted", max_rank=rank, rank=rank, **VARIANTS[variant]
        )
        assert_certified(info)
        weights.append(shift(info, wanted))
        policies.append(float(np.abs(moments(found, states) - moments(exact, states)).max()))
    # Measured with "change": 0.8, 0.3, 0.06 and 4e-4; 1.2, 0.5, 0.9 and 2e-4.
    assert weights[0] > 2.0 * weights[1] > 4.0 * weights[2] > 100.0 * weights[3]
    # the largest difference of two policies need not fall with every feature, but in the end
    assert policies[0] == max(policies) and min(policies[:3]) > 100.0 * policies[3]


def test_the_basis_of_v_alone_decides_the_rank_and_the_residual(rollouts: list[Rollout]) -> None:
    learner, info = updated(rollouts, approximation="pivoted", max_rank=40, rank=70)
    assert info.rank == 40
    assert info.support == 70 == len(learner.policy.process.states)
    assert isinstance(learner.value_function, KernelExpansion)
    assert learner.value_function.centres.shape == (40, 2)
    assert 0.0 < info.rank_residual < 1.0
    _, fourier = updated(rollouts, approximation="fourier", max_rank=41, rank=70)
    assert (fourier.rank, fourier.rank_residual, fourier.support) == (40, 0.0, 70)


# ---- in chunks --------------------------------------------------------------------------------


@pytest.fixture
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset_module, "CHUNK", 60)


@pytest.fixture
def streamed(short_chunks: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Most samples are in no sample of them, so that the dual is solved in chunks."""
    monkeypatch.setattr(low_rank, "SAMPLE", 200)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("approximation", ["pivoted", "uniform", "fourier"])
def test_sums_over_chunks_are_those_over_all_samples(
    approximation: str, variant: str, rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"approximation": approximation} | LOW | VARIANTS[variant]
    whole = updated(rollouts, **settings)
    monkeypatch.setattr(dataset_module, "CHUNK", 60)
    assert len(Dataset.from_rollouts(rollouts).chunks) > 2
    found = updated(rollouts, **settings)
    # What the order of summation does; random pivots are ill-conditioned. Measured:
    # 5e-10, 2e-9 and 2e-5.
    assert shift(found[1], whole[1]) < 1e-7
    states = visited(rollouts)
    v, truth = (each[0].value_function(states) for each in (found, whole))
    np.testing.assert_allclose(v, truth, rtol=0.0, atol=1e-7 * np.ptp(truth))
    np.testing.assert_allclose(moments(found[0], states), moments(whole[0], states), atol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.usefixtures("streamed")
def test_the_dual_in_chunks_is_that_in_memory(
    variant: str, rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[tuple[StreamedProblem, DualSolution]] = []

    def spy(
        problem: StreamedProblem, settings: Settings, sample: Transitions, sampled: IntArray
    ) -> DualSolution:
        assert len(sample) == len(sampled) == 200
        assert (np.diff(sampled) > 0).all() and sampled[0] < 20 and sampled[-1] > 325  # all over
        solved.append((problem, solve(problem, settings, sample, sampled)))
        return solved[-1][1]

    solve = low_rank.solve
    monkeypatch.setattr(low_rank, "solve", spy)
    settings = LOW | VARIANTS[variant]
    _, info = updated(rollouts, approximation="pivoted", **settings)
    [(problem, found)] = solved
    assert len(problem.dataset.chunks) > 2
    assert info.dual is found
    assert_certified(info, problem.kl_bound)
    in_memory = DualProblem(
        problem.rewards,
        problem.rows(problem.dataset.take(np.arange(345))),
        problem.kl_bound,
        problem.ridge,
        problem.eta_floor,
    )
    theta = np.random.default_rng(0).normal(size=problem.rank)
    np.testing.assert_allclose(
        problem.bellman_errors(theta), in_memory.bellman_errors(theta), atol=1e-9
    )
    wanted = solve_dual(in_memory)
    # Each may be off the optimum by what the tolerance of the KL bound permits.
    assert found.eta == pytest.approx(wanted.eta, rel=1e-3)
    assert found.dual == pytest.approx(wanted.dual, abs=GAP_TOLERANCE)
    assert np.abs(found.weights - wanted.weights).sum() < 1e-3


@pytest.mark.usefixtures("short_chunks")
def test_the_dual_grows_from_part_to_part(
    rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part is solved with the ridge of the next, and the next begins where it ended."""
    monkeypatch.setattr(low_rank, "SAMPLE", 40)
    solved: list[tuple[Any, Any, DualSolution]] = []

    def spy(problem: Any, *, start: Any = None) -> DualSolution:
        solved.append((problem, start, solve_dual(problem, start=start)))
        return solved[-1][2]

    monkeypatch.setattr(low_rank, "solve_dual", spy)
    learner, info = updated(rollouts, approximation="pivoted", **LOW)
    sizes = [len(problem.rewards) for problem, _, _ in solved]
    assert sizes[0] == 40 and 40 < sizes[1] < 345 and sizes[2:] == [345]
    ridges = [problem.ridge * size for (problem, _, _), size in zip(solved, sizes, strict=True)]
    wanted = [learner.settings.ridge * size / min(4 * size, 345) for size in sizes]
    np.testing.assert_allclose(ridges, wanted, rtol=1e-12)
    for (_, _, before), (_, start, _) in itertools.pairwise(solved):
        assert start == (before.eta, before.theta)
    assert info.dual is solved[-1][2]
    assert_certified(info, learner.settings.kl_bound)


@pytest.mark.usefixtures("streamed")
def test_the_dual_of_all_samples_starts_from_the_solution_for_some(
    rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    starts: list[Any] = []
    ends: list[DualSolution] = []

    def spy(problem: Any, *, start: Any = None) -> DualSolution:
        starts.append(start)
        ends.append(solve_dual(problem, start=start))
        return ends[-1]

    monkeypatch.setattr(low_rank, "solve_dual", spy)
    _, info = updated(rollouts, approximation="pivoted", **LOW)
    assert starts[0] is None
    assert starts[1][0] == ends[0].eta and starts[1][1] is ends[0].theta
    assert len(ends[0].weights) == 200
    assert info.dual is ends[1]
    starts.clear()
    updated(rollouts[:2], approximation="pivoted", **LOW)  # 187 samples: all are in the sample
    assert starts == [None]


@pytest.mark.usefixtures("streamed")
def test_the_prior_of_the_policy_is_weighed_against_all_samples(
    rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[PolicyTargets] = []

    def spy(samples: PolicyTargets, *others: Any) -> FloatArray:
        seen.append(samples)
        return policy_hyperparameters(samples, *others)

    monkeypatch.setattr(low_rank, "policy_hyperparameters", spy)
    _, info = updated(rollouts, approximation="pivoted", **LOW)
    weights = info.dual.weights / np.sum(info.dual.weights**2)
    kept = 345 * info.dual.weights >= MIN_RELATIVE_WEIGHT
    assert kept.sum() > 200 == len(seen[0].weights)
    assert seen[0].evidence == pytest.approx(weights[kept].sum(), rel=1e-12)


@pytest.mark.usefixtures("streamed")
def test_rewards_of_all_samples_are_brought_to_one_unit(rollouts: list[Rollout]) -> None:
    scaled = [replace(r, rewards=1e4 * r.rewards + 7.0) for r in rollouts]
    one, info = updated(rollouts, approximation="pivoted", **LOW)
    other, found = updated(scaled, approximation="pivoted", **LOW)
    assert shift(found, info) < 1e-8
    states = visited(rollouts)
    v = one.value_function(states)
    np.testing.assert_allclose(other.value_function(states), 1e4 * v, atol=1e-3 * np.ptp(v))


@pytest.mark.usefixtures("streamed")
def test_equal_rewards_are_learnt_from_without_harm(rollouts: list[Rollout]) -> None:
    level = [replace(r, rewards=np.full(len(r), -3.0)) for r in rollouts]
    learner, info = updated(level, approximation="pivoted", **LOW)
    assert info.dual.outcome is Outcome.AT_FLOOR
    assert info.dual.kl < 1.0
    assert np.isfinite(moments(learner, visited(rollouts))).all()


@pytest.mark.usefixtures("streamed")
def test_a_chunk_without_any_weight_says_nothing_of_the_policy(rollouts: list[Rollout]) -> None:
    # The rewards of one chunk are so low that none of its samples is heard.
    bad = [replace(r, rewards=r.rewards - 1e4) for r in swing_ups(2, 3)]
    _, info = updated([*bad, *rollouts], approximation="pivoted", model="sample", **LOW)
    dataset = Dataset.from_rollouts([*bad, *rollouts])
    first = dataset.split(info.dual.weights)[0]
    assert len(first) * first.max() < MIN_RELATIVE_WEIGHT
    assert info.dual.converged


@pytest.mark.parametrize("approximation", ["pivoted", "uniform", "fourier"])
@pytest.mark.usefixtures("streamed")
def test_one_seed_gives_one_learner_to_the_last_byte(
    approximation: str, rollouts: list[Rollout], tmp_path: Path
) -> None:
    settings: dict[str, Any] = {"approximation": approximation, **LOW}
    first, again, other = (
        content(updated(rollouts, seed=seed, **settings)[0], tmp_path) for seed in (7, 7, 8)
    )
    assert first == again
    assert first != other
    with ThreadPoolExecutor(3) as pool:
        shared = updated(rollouts, Compute(pool), seed=7, **settings)[0]
    assert content(shared, tmp_path) == first


@pytest.mark.usefixtures("streamed")
def test_a_set_of_the_same_rollouts_gives_the_same_policy(rollouts: list[Rollout]) -> None:
    listed, info = updated(rollouts, approximation="pivoted", **LOW)
    states = visited(rollouts)
    found, _ = updated(Dataset.from_rollouts(rollouts), **LOW)  # "auto" is pivoted for any set
    np.testing.assert_array_equal(moments(found, states), moments(listed, states))
    arrays = Dataset.from_arrays(
        np.concatenate([r.observations for r in rollouts]),
        np.concatenate([r.actions for r in rollouts]),
        np.concatenate([r.rewards for r in rollouts]),
        [len(r) for r in rollouts],
    )
    _, of_arrays = updated(arrays, **LOW)  # in chunks of other sizes
    assert shift(of_arrays, info) < 1e-8


# ---- which update is made ---------------------------------------------------------------------


@pytest.mark.parametrize(("limit", "low_rank"), [(345, False), (344, True)])
def test_auto_is_exact_up_to_its_limit(
    limit: int, low_rank: bool, rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(low_rank, "EXACT_LIMIT", limit)
    learner, _ = updated(rollouts[:3], **LOW)
    assert not isinstance(learner.policy.process, SparseGP)
    learner.update(rollouts[3:])  # what is kept counts too
    assert isinstance(learner.policy.process, SparseGP) is low_rank


def test_an_exact_update_is_never_approximated(
    rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(low_rank, "EXACT_LIMIT", 10)
    learner, _ = updated(rollouts, approximation="exact")
    assert not isinstance(learner.policy.process, SparseGP)
    with pytest.raises(ConfigurationError, match="exact"):
        learner.update(Dataset.from_rollouts(rollouts))
    assert learner.state.iteration == 1


@pytest.mark.parametrize("approximation", ["auto", "pivoted"])
def test_a_set_is_always_learnt_from_in_low_rank(
    approximation: str, rollouts: list[Rollout]
) -> None:
    learner, _ = updated(Dataset.from_rollouts(rollouts), approximation=approximation, **LOW)
    assert isinstance(learner.policy.process, SparseGP)


# ---- from update to update --------------------------------------------------------------------


def test_a_window_without_end_keeps_everything(rollouts: list[Rollout]) -> None:
    learner = kreps.KREPS(TASK, window=None, approximation="pivoted", **LOW)
    for i in range(3):
        info = learner.update(rollouts[2 * i : 2 * i + 2])
        assert info.samples == sum(map(len, rollouts[: 2 * i + 2]))
    assert [id(r) for r in learner.state.window.rollouts] == [id(r) for r in rollouts]


def test_a_short_window_forgets_in_low_rank_too(rollouts: list[Rollout]) -> None:
    learner = kreps.KREPS(TASK, window=3, approximation="pivoted", **LOW)
    learner.update(rollouts[:3])
    assert learner.update(rollouts[3:5]).samples == sum(map(len, rollouts[2:5]))
    assert (learner.state.rollouts, learner.state.steps) == (5, sum(map(len, rollouts[:5])))


def test_a_set_is_counted_but_not_kept(rollouts: list[Rollout]) -> None:
    learner, _ = updated(rollouts[:2], approximation="pivoted", **LOW)
    kept = learner.state.window.rollouts
    info = learner.update(Dataset.from_rollouts(rollouts[2:]))
    assert info.samples == sum(map(len, rollouts[2:]))
    assert learner.state.window.rollouts == kept
    state = learner.state
    assert (state.iteration, state.rollouts, state.steps) == (2, 6, 345)
    assert learner.update(rollouts[2:3]).samples == sum(map(len, rollouts[:3]))


def test_no_new_rollouts_are_learnt_from_when_old_ones_are_kept(rollouts: list[Rollout]) -> None:
    learner, _ = updated(rollouts, approximation="pivoted", **LOW)
    rng = np.random.default_rng(0)
    state, info = low_rank.update(learner.state, [], TASK, learner.settings, rng, learner.compute)
    assert info.samples == 345
    assert (state.iteration, state.rollouts, state.steps) == (2, 6, 345)
    assert learner.state.iteration == 1


def test_fits_start_where_those_of_the_last_update_ended(
    rollouts: list[Rollout], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[FloatArray | None] = []

    def spy(function: Callable[..., Any], to_device: int) -> Callable[..., Any]:
        def spied(*arguments: Any) -> Any:
            given.append(arguments[to_device])
            return function(*arguments)

        return spied

    for name, to_device in (("embedding_hyperparameters", 4), ("policy_hyperparameters", 3)):
        monkeypatch.setattr(low_rank, name, spy(getattr(low_rank, name), to_device))
    learner, _ = updated(rollouts, approximation="pivoted", **LOW)
    ends = [learner.state.embedding_start, learner.state.policy_start]
    learner.update(rollouts[:1])
    assert given[:2] == [None, None]
    for start, end in zip(given[2:], ends, strict=True):
        np.testing.assert_array_equal(start, end)


TINY: dict[str, Any] = {
    "initial_rollouts": 4,
    "rollouts_per_iteration": 2,
    "window": 6,
    **LOW,
}


def swing_up(**settings: Any) -> kreps.KREPS:
    return kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=3, **{**TINY, **settings})


@pytest.mark.parametrize("approximation", ["pivoted", "uniform", "fourier"])
def test_a_resumed_learner_goes_on_to_the_same_bytes(approximation: str, tmp_path: Path) -> None:
    learner = swing_up(approximation=approximation).learn(2, progress=False)
    kind = FourierExpansion if approximation == "fourier" else KernelExpansion
    assert isinstance(learner.value_function, kind)
    saved = content(learner, tmp_path)
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint.safetensors", gym.make("kreps/SwingUp-v0"))
    assert content(resumed, tmp_path) == saved
    states = np.random.default_rng(0).normal(size=(20, 2))
    np.testing.assert_array_equal(resumed.value_function(states), learner.value_function(states))
    learner.learn(1, progress=False)
    resumed.learn(1, progress=False)
    assert content(resumed, tmp_path) == content(learner, tmp_path) != saved


def test_learning_goes_on_after_a_set(rollouts: list[Rollout], tmp_path: Path) -> None:
    learner = swing_up()
    learner.update(Dataset.from_rollouts(rollouts))
    assert learner.state.window.rollouts == ()
    saved = content(learner, tmp_path)
    resumed = kreps.KREPS.resume(tmp_path / "checkpoint.safetensors", gym.make("kreps/SwingUp-v0"))
    assert content(resumed, tmp_path) == saved
    for each in (learner, resumed):
        each.learn(1, progress=False)
        assert each.state.rollouts == 8  # the set's six, and two of the new policy
        assert len(each.state.window.rollouts) == 2
    assert content(resumed, tmp_path) == content(learner, tmp_path)


def test_a_step_of_low_rank_improves_the_policy(rollouts: list[Rollout]) -> None:
    # Hanging at rest: the weighted samples earn more than the samples do on average.
    _, info = updated(rollouts, approximation="pivoted", **LOW)
    rewards = np.concatenate([r.rewards for r in rollouts])
    assert info.dual.weights @ rewards > rewards.mean() + 0.3 * rewards.std()


@pytest.fixture(autouse=True)
def _no_warning_of_numpy() -> Iterator[None]:
    with np.errstate(all="raise", under="ignore"):
        yield
