"""Algorithm 1 on small synthetic data: one update, its parts, and its odd cases."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kreps.algorithms.dual import DualProblem, Outcome, kl_from_uniform
from kreps.algorithms.exact import ExactBatch
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.report import UpdateInfo
from kreps.algorithms.reps import reps_step
from kreps.algorithms.state import LearnerState, Stopwatch
from kreps.algorithms.update import update
from kreps.data.compute import Compute
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.errors import DataError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel, factors_of
from kreps.models.transition import feature_differences, restart_features, successor_features
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.presets import settings_of
from kreps.settings import RKHS, Grid, Settings

TASK = TaskSpec(2, np.array([-2.0]), np.array([2.0]))
SINGLE_STEP = settings_of("single_step")
"""One step on the sampled actions, without generated ones."""


def collect(
    rollouts: int = 10, steps: int = 15, seed: int = 0, terminated: bool = False
) -> list[Rollout]:
    """A point mass with friction, pushed at random and rewarded for resting at the origin."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(rollouts):
        state = np.array([rng.normal(), 0.0])
        observations, actions, rewards = [state], [], []
        for _ in range(steps):
            action = rng.normal(0.0, 2.0, size=1)  # often beyond the limits
            force = TASK.clip(action)[0]
            rewards.append(-(state[0] ** 2) - 0.1 * state[1] ** 2 - 0.01 * force**2)
            velocity = 0.9 * state[1] + 0.3 * force + 0.05 * rng.normal()
            state = np.array([state[0] + 0.3 * velocity, velocity])
            observations.append(state)
            actions.append(action)
        found.append(
            Rollout(np.array(observations), np.array(actions), np.array(rewards), terminated)
        )
    return found


def new_state(capacity: int = 30, task: TaskSpec = TASK) -> LearnerState:
    return LearnerState(ReplayWindow(task, capacity))


def run(
    rollouts: list[Rollout],
    settings: Settings | None = None,
    state: LearnerState | None = None,
    seed: int = 0,
    task: TaskSpec = TASK,
) -> tuple[LearnerState, UpdateInfo]:
    return update(
        new_state(task=task) if state is None else state,
        rollouts,
        SINGLE_STEP if settings is None else settings,
        np.random.default_rng(seed),
        Compute(),
    )


def with_rewards(rollouts: list[Rollout], change: Any) -> list[Rollout]:
    return [replace(r, rewards=change(r.rewards)) for r in rollouts]


def fingerprint(state: LearnerState) -> list[bytes]:
    """The bytes of everything that was learnt."""
    assert state.policy is not None
    assert state.value is not None
    arrays = [
        state.policy.states,
        state.policy.targets,
        state.policy.weights,
        state.policy.alpha,
        state.policy.kernel.lengthscales,
        np.array([state.policy.signal, state.policy.noise]),
        state.policy.predictor.mean_weights,
        state.policy.predictor.explained,
        state.value.centres,
        state.value.alpha,
        state.value.kernel.lengthscales,
    ]
    arrays += [a for a in (state.embedding_start, state.policy_start) if a is not None]
    return [a.tobytes() for a in arrays]


def assert_bounded(info: UpdateInfo, settings: Settings) -> None:
    """KL is at its bound, or below it with the temperature at its floor."""
    dual = info.dual
    assert dual.converged
    weights = info.samples
    if settings.model_based is not None:
        weights *= settings.model_based.actions_per_state
        if settings.model == "dynamics" and info.samples >= 40:
            # the last step is in states of model rollouts
            weights = round(settings.model_based.model_rollout_fraction * weights)
    assert len(dual.weights) == weights
    assert dual.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert (dual.weights >= 0.0).all()
    kl = kl_from_uniform(dual.weights)
    if dual.outcome is Outcome.AT_FLOOR:
        assert dual.eta == pytest.approx(info.eta_floor)
        assert kl <= settings.kl_bound * (1.0 + 1e-4)
    else:
        assert kl == pytest.approx(settings.kl_bound, rel=1.01e-4)


@pytest.mark.parametrize(
    ("preset", "model"),
    [
        ("model_based", "change"),
        ("model_based", "embedding"),
        ("single_step", "embedding"),
        ("single_step", "sample"),
        ("paper", "embedding"),
        ("paper", "sample"),
    ],
)
def test_the_kl_of_the_weights_is_at_its_bound_or_eta_at_its_floor(preset: str, model: str) -> None:
    settings = settings_of(preset, model=model)
    _, info = run(collect(), settings)
    assert_bounded(info, settings)
    assert info.samples == 150
    assert info.effective_samples == pytest.approx(1.0 / np.sum(info.dual.weights**2))
    assert info.effective_samples < 140.0 / 150.0 * len(info.dual.weights)
    assert info.rank_residual <= 1e-6
    assert (info.embedding_parameters is None) == (model == "sample")


def test_grid_features_are_centred_over_all_states() -> None:
    settings = settings_of("single_step", value=Grid(6))
    rollouts = collect()
    state, info = run(rollouts, settings)
    assert_bounded(info, settings)
    assert info.rank == 36
    assert info.rank_residual == 0.0
    assert state.value is not None
    points = np.concatenate([r.observations for r in rollouts])
    np.testing.assert_allclose(state.value.centres.min(axis=0), points.min(axis=0))
    np.testing.assert_allclose(state.value.centres.max(axis=0), points.max(axis=0))


def test_at_a_high_floor_the_kl_stays_below_its_bound() -> None:
    settings = settings_of("single_step", kl_bound=3.0, eta_floor=2.0)
    _, info = run(collect(), settings)
    assert info.dual.outcome is Outcome.AT_FLOOR
    assert info.dual.eta == 2.0
    assert 0.0 < info.dual.kl < 2.0


@pytest.mark.parametrize("value", [RKHS(angle_wrap="continuous"), Grid()], ids=["rkhs", "grid"])
@pytest.mark.parametrize("model", ["embedding", "sample"])
def test_the_weights_are_the_exponentials_of_the_bellman_errors(
    model: str, value: RKHS | Grid
) -> None:
    """Eqs. 1, 4 and 5 put together from the learnt V and hyper-parameters, in plain NumPy."""
    restart = 0.07
    rollouts = collect(steps=12) + collect(4, 5, seed=1, terminated=True)
    settings = settings_of("single_step", model=model, value=value, restart_probability=restart)
    state, info = run(rollouts, settings)
    v = state.value
    assert v is not None

    states = np.concatenate([r.observations[:-1] for r in rollouts])
    rewards = np.concatenate([r.rewards for r in rollouts])
    at_start = np.mean([v(r.observations[:1])[0] for r in rollouts])
    after = []
    for r in rollouts:
        successors = v(r.observations[1:])
        if r.terminated:
            successors[-1] = at_start
        after.append(successors)
    expected = np.concatenate(after)
    if model == "embedding":
        assert info.embedding_parameters is not None
        applied = np.clip(np.concatenate([r.actions for r in rollouts]), -2.0, 2.0) / 2.0
        inputs = np.column_stack([states, applied]) / info.embedding_parameters[:-1]
        squares = ((inputs[:, None] - inputs) ** 2).sum(axis=2)
        gram = np.exp(-0.5 * squares)
        noise = info.embedding_parameters[-1] * np.eye(len(gram))
        expected = gram @ np.linalg.solve(gram + noise, expected)
    ends = np.concatenate([[*[False] * (len(r) - 1), r.terminated] for r in rollouts])
    # the deviation of all rewards, zeros after terminations included
    steps = (1.0 - restart) / restart
    share = np.append(np.full(len(ends), 1.0), steps * ends.sum())
    scatter = np.average(np.append(rewards, 0.0) ** 2, weights=share)
    unit = np.sqrt(scatter - np.average(np.append(rewards, 0.0), weights=share) ** 2)
    delta = rewards + (1.0 - restart) * expected + restart * at_start - v(states)
    p, scale = info.dual.weights, info.dual.eta * unit
    # the value of a termination, from the heaviest sample with and without one
    i, j = np.where(ends, p, 0.0).argmax(), np.where(ends, 0.0, p).argmax()
    value = scale * (np.log(p[i]) - np.log(p[j])) - (delta[i] - delta[j])
    average = p @ rewards / (1.0 + steps * p @ ends)
    assert value == pytest.approx(steps * (0.0 - average), abs=0.02 * unit)
    delta = delta + value * ends
    wanted = np.exp((delta - delta.max()) / scale)
    wanted /= wanted.sum()
    assert np.abs(p - wanted).sum() < 1e-5


def test_the_policy_is_the_weighted_gaussian_process_of_the_commanded_actions() -> None:
    rollouts = collect()
    state, info = run(rollouts)
    assert state.policy is not None
    p = info.dual.weights
    kept = 150 * p >= 0.05
    assert 0 < kept.sum() < 150
    assert info.support == kept.sum()
    weights = p[kept] / np.sum(p**2)
    states = np.concatenate([r.observations[:-1] for r in rollouts])[kept]
    commanded = np.concatenate([r.actions for r in rollouts])[kept] / 2.0
    assert np.abs(commanded).max() > 1.0  # not the clipped ones
    signal, noise = info.policy_parameters[-2:]
    kernel = Kernel(factors_of(2), info.policy_parameters[:-2])
    query = np.random.default_rng(3).normal(size=(12, 2))
    c = signal * kernel.gram(states) + noise * np.diag(1.0 / weights)
    k = signal * kernel.gram(states, query)
    np.testing.assert_allclose(
        state.policy.greedy(query), 2.0 * k.T @ np.linalg.solve(c, commanded), rtol=1e-6, atol=1e-8
    )
    variance = signal - np.einsum("ij,ij->j", k, np.linalg.solve(c, k)) + noise
    np.testing.assert_allclose(
        state.policy.standard_deviation(query)[:, 0], 2.0 * np.sqrt(variance), rtol=1e-6
    )


class RecordingBatch(ExactBatch):
    """Records the start points of the fits, and ends each at a given point."""

    def __init__(self, state: LearnerState, rollouts: list[Rollout]) -> None:
        super().__init__(state.append(rollouts), rollouts, SINGLE_STEP, Stopwatch())
        self.starts: list[FloatArray | None] = []

    def transition_model(self, features: Any, kernel: Any, start: Any, rng: Any) -> Any:
        self.starts.append(start)
        return super().transition_model(features, kernel, start, rng)

    def fit_policy(self, targets: Any, kernel: Any, start: Any, *others: Any) -> Any:
        self.starts.append(start)
        return super().fit_policy(targets, kernel, start, *others)


def test_fits_start_where_those_of_the_last_update_ended() -> None:
    state, _ = run(collect(seed=1))
    assert state.embedding_start is not None
    assert state.policy_start is not None
    batch = RecordingBatch(state, collect(seed=2))
    step = reps_step(batch, state, 0.1, np.random.default_rng(0))
    embedding_start, policy_start = batch.starts
    assert embedding_start is state.embedding_start
    assert policy_start is state.policy_start
    after, _ = run(collect(seed=2), state=state)
    assert after.embedding_start is not None and step.model.parameters is not None
    np.testing.assert_array_equal(after.embedding_start, step.model.parameters)
    np.testing.assert_array_equal(after.policy_start, step.policy.x)
    assert not np.array_equal(after.embedding_start, state.embedding_start)


def test_the_new_policy_pushes_towards_the_origin() -> None:
    state, _ = run(collect(20, 15, seed=5))
    assert state.policy is not None
    left, right = state.policy.greedy(np.array([[-1.0, 0.0], [1.0, 0.0]]))[:, 0]
    assert left > 0.1
    assert right < -0.1


def test_one_seed_gives_one_policy_byte_for_byte() -> None:
    # More than 500 points and 300 samples, so that every random choice is really made.
    rollouts = collect(36, 15)
    state = new_state(40)
    first, second, other = (run(rollouts, state=state, seed=seed)[0] for seed in (7, 7, 8))
    assert fingerprint(first) == fingerprint(second)
    assert fingerprint(first) != fingerprint(other)


def test_the_old_state_is_not_modified() -> None:
    first, _ = run(collect(seed=1))
    before = fingerprint(first)
    kept = first.window.rollouts
    bytes_kept = [r.observations.tobytes() + r.rewards.tobytes() for r in kept]
    second, _ = run(collect(seed=2), state=first)
    assert fingerprint(first) == before
    assert first.window.rollouts is kept
    assert [r.observations.tobytes() + r.rewards.tobytes() for r in kept] == bytes_kept
    assert (first.iteration, first.rollouts, first.steps) == (1, 10, 150)
    assert (second.iteration, second.rollouts, second.steps) == (2, 20, 300)
    assert fingerprint(second) != before


def test_forgotten_rollouts_are_counted_but_not_learnt_from() -> None:
    old, new = collect(6, seed=1), collect(6, 10, seed=2)
    sample = settings_of("single_step", model="sample")
    first, _ = run(old, sample, new_state(6))
    second, info = run(new, sample, replace(first, policy_start=None))
    alone, _ = run(new, sample, new_state(6))
    assert info.samples == 60
    assert (second.rollouts, second.steps) == (12, 6 * 15 + 6 * 10)
    assert fingerprint(second) == fingerprint(alone)


def test_an_update_without_new_rollouts_uses_those_of_the_window() -> None:
    first, _ = run(collect(5))
    second, info = run([], state=first)
    assert info.samples == 75
    assert (second.iteration, second.rollouts, second.steps) == (2, 5, 75)


def test_an_update_without_any_rollout_is_an_error() -> None:
    with pytest.raises(DataError):
        run([])


@pytest.mark.parametrize(("ds", "da"), [(3, 1), (1, 1), (2, 2)])
def test_rollouts_of_another_width_are_an_error(ds: int, da: int) -> None:
    stranger = Rollout(np.zeros((4, ds)), np.zeros((3, da)), np.zeros(3))
    state = new_state()
    with pytest.raises(DataError):
        run([*collect(2), stranger], state=state)
    assert len(state.window.rollouts) == 0


@pytest.mark.parametrize("scale", [1e-8, 1e8])
@pytest.mark.parametrize("preset", ["model_based", "single_step", "paper", "authors"])
def test_v_scales_with_the_reward_and_the_weights_do_not(preset: str, scale: float) -> None:
    rollouts = collect()
    settings = settings_of(preset)
    state, info = run(rollouts, settings)
    scaled_state, scaled = run(with_rewards(rollouts, lambda r: scale * r), settings)
    np.testing.assert_allclose(scaled.dual.weights, info.dual.weights, atol=1e-6)
    assert state.value is not None
    assert scaled_state.value is not None
    query = np.random.default_rng(4).normal(size=(10, 2))
    v = state.value(query)
    np.testing.assert_allclose(scaled_state.value(query) / scale, v, atol=1e-5 * np.abs(v).max())


def test_a_constant_added_to_the_reward_changes_nothing() -> None:
    rollouts = collect()
    _, info = run(rollouts)
    _, moved = run(with_rewards(rollouts, lambda r: r + 100.0))
    np.testing.assert_allclose(moved.dual.weights, info.dual.weights, atol=1e-8)


@pytest.mark.parametrize("preset", ["model_based", "single_step", "paper", "authors"])
def test_equal_rewards_give_a_usable_policy(preset: str) -> None:
    settings = settings_of(preset)
    state, info = run(with_rewards(collect(), lambda r: np.full_like(r, -3.0)), settings)
    assert_bounded(info, replace(settings, model_based=None))  # no sample is generated
    if preset == "model_based":  # and the floor is that without an acceptance test
        assert (info.rejected, info.eta_floor) == (None, 0.05)
    assert_usable(state)


def assert_usable(state: LearnerState, task: TaskSpec = TASK) -> None:
    assert state.policy is not None
    assert state.value is not None
    query = np.random.default_rng(5).normal(size=(20, task.observation_size))
    assert np.isfinite(state.policy.greedy(query)).all()
    assert (state.policy.standard_deviation(query) > 0.0).all()
    assert np.isfinite(state.value(query)).all()


@pytest.mark.parametrize("model", ["embedding", "sample"])
def test_duplicated_samples_share_their_weight(model: str) -> None:
    rollouts = collect(4, 10)
    settings = settings_of("single_step", model=model)
    state, info = run(rollouts * 3, settings)
    assert_bounded(info, settings)
    assert_usable(state)
    assert info.rank <= 44
    # Copies of a sample share its weight.
    weights = info.dual.weights.reshape(3, 40)
    np.testing.assert_allclose(weights[1:], weights[:1].repeat(2, axis=0), atol=1e-9)


@pytest.mark.parametrize("preset", ["model_based", "single_step"])
def test_a_single_distinct_state_gives_a_usable_policy(preset: str) -> None:
    rng = np.random.default_rng(6)
    still = [
        Rollout(np.full((6, 2), 0.3), rng.normal(size=(5, 1)), rng.normal(size=5)) for _ in range(4)
    ]
    settings = settings_of(preset)
    state, info = run(still, settings)
    assert info.rank == 1
    assert_bounded(info, settings)
    assert_usable(state)


@pytest.mark.parametrize("preset", ["model_based", "single_step", "paper", "authors"])
def test_a_single_distinct_action_is_learnt(preset: str) -> None:
    same = [replace(r, actions=np.full_like(r.actions, 0.5)) for r in collect()]
    settings = settings_of(preset)
    state, info = run(same, settings)
    assert_bounded(info, settings)
    assert_usable(state)
    if settings.model_based is not None:  # without the bonus of unexplored actions
        without = {
            "model_based.exploration_bonus": 0.0,
            "model_based.random_policies": 0,
            "model_based.regulators": 0,
            "model_based.gradient_steps": 0,
        }
        settings = settings_of(settings, **without)
    state, info = run(same, settings)
    assert isinstance(state.policy, CostSensitiveGP)
    if settings.model_based is not None:
        weights = state.policy.weights / state.policy.weights.sum()
        near = state.policy.states[weights > 0.01]
    else:
        near = np.concatenate([r.observations[:-1] for r in same])[info.dual.weights > 0.01]
    # generated actions are around the policy, with its noise
    tolerance = 0.1 if settings.model_based is None else 0.25
    np.testing.assert_allclose(state.policy.greedy(near), 0.5, atol=tolerance)


@pytest.mark.parametrize("preset", ["model_based", "single_step", "paper", "authors"])
def test_a_single_step_gives_a_usable_policy(preset: str) -> None:
    one = [Rollout(np.array([[0.0, 0.0], [0.1, 0.3]]), np.array([[1.0]]), np.array([-1.0]))]
    settings = settings_of(preset)
    state, info = run(one, settings)
    # one sample does not identify an action cost, so the model-based step generates others from it
    samples = 4 if preset == "model_based" else 1
    np.testing.assert_allclose(info.dual.weights, np.full(samples, 1.0 / samples), atol=1e-4)
    assert info.dual.outcome is Outcome.AT_FLOOR
    assert info.support == 1
    assert_usable(state)


@pytest.mark.parametrize("preset", ["model_based", "single_step"])
def test_one_enormous_negative_reward_has_no_weight(preset: str) -> None:
    rollouts = collect()
    spoilt = np.array(rollouts[0].rewards)
    spoilt[3] = -1e9
    rollouts[0] = replace(rollouts[0], rewards=spoilt)
    settings = settings_of(preset)
    state, info = run(rollouts, settings)
    assert_bounded(info, settings)
    if settings.model_based is None:
        assert info.dual.weights[3] < 1e-6
    assert_usable(state)


def test_policy_and_value_are_periodic_in_an_angle() -> None:
    task = replace(TASK, periodic=(0,))
    state, _ = run(collect(), task=task)
    assert state.policy is not None
    assert state.value is not None
    query = np.random.default_rng(9).normal(size=(10, 2))
    turned = query + np.array([2.0 * np.pi, 0.0])
    np.testing.assert_allclose(state.policy.greedy(turned), state.policy.greedy(query), atol=1e-8)
    np.testing.assert_allclose(state.value(turned), state.value(query), atol=1e-6)


@pytest.mark.parametrize("preset", ["model_based", "single_step"])
def test_several_actions_of_different_scale_are_learnt(preset: str) -> None:
    rng = np.random.default_rng(10)
    task = TaskSpec(2, np.array([-2.0, 0.0]), np.array([2.0, 1000.0]))
    rollouts = [
        replace(r, actions=np.column_stack([r.actions, rng.uniform(0, 1000, len(r))]))
        for r in collect()
    ]
    settings = settings_of(preset)
    state, info = run(rollouts, settings, task=task)
    assert_bounded(info, settings)
    assert state.policy is not None
    mean = state.policy.greedy(np.array([[0.0, 0.0], [50.0, 50.0]]))
    assert mean.shape == (2, 2)
    np.testing.assert_allclose(mean[1], [0.0, 500.0], atol=1e-6)  # far away: the centre


# Parts


def transitions(terminated: bool) -> tuple[Transitions, FloatArray]:
    rollouts = collect(3, 4, terminated=terminated) + collect(1, 2, seed=3)
    data = Transitions.from_rollouts(rollouts)
    return data, np.random.default_rng(11).normal(size=(len(data.points), 5))


def test_successor_features_are_those_of_the_next_point() -> None:
    data, features = transitions(terminated=False)
    np.testing.assert_array_equal(successor_features(data, features), features[data.state + 1])


def test_after_a_termination_the_successor_features_are_those_of_the_mean_start() -> None:
    data, features = transitions(terminated=True)
    before = features.copy()
    found = successor_features(data, features)
    ends = np.array([3, 7, 11])
    mean_start = (features[0] + features[5] + features[10] + features[15]) / 4.0
    np.testing.assert_allclose(found[ends], np.tile(mean_start, (3, 1)))
    others = np.setdiff1d(np.arange(len(data)), ends)
    np.testing.assert_array_equal(found[others], features[data.successor[others]])
    np.testing.assert_array_equal(features, before)


@pytest.mark.parametrize("restart", [0.02, 0.5])
def test_the_restart_mixes_the_expectation_with_the_mean_start(restart: float) -> None:
    data, features = transitions(terminated=False)
    expected = np.random.default_rng(12).normal(size=(len(data), 5))
    own, starts = features[data.state], features[data.start].mean(axis=0)
    found = feature_differences(own, expected, starts, restart)
    mean_start = (features[0] + features[5] + features[10] + features[15]) / 4.0
    for i, row in enumerate(found):
        wanted = (1.0 - restart) * expected[i] + restart * mean_start - features[data.state[i]]
        np.testing.assert_allclose(row, wanted, atol=1e-14)


def test_a_share_of_the_restart_features_is_of_sampled_states() -> None:
    starts, states = np.array([1.0, 0.0]), np.array([0.0, 4.0])
    for share, wanted in [(0.0, [1.0, 0.0]), (0.25, [0.75, 1.0]), (1.0, [0.0, 4.0])]:
        found = restart_features(starts, states, share)
        np.testing.assert_array_equal(found, wanted)


def test_exploring_starts_give_weight_to_the_best_action_off_the_path() -> None:
    """Two states: staying in the first is best, and the second is reached only from there."""
    eye = np.eye(2)
    state, after = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    stay, leave, back, remain = range(4)
    rewards = np.array([0.0, -1.0, -1.0, -1.0])
    found = {}
    for share in (0.0, 0.25):
        restart = restart_features(eye[0], eye[state].mean(axis=0), share)
        differences = feature_differences(eye[state], eye[after], restart, 0.1)
        problem = DualProblem(rewards, differences, kl_bound=2.0, ridge=1e-6, eta_floor=0.05)
        found[share] = solve_dual(problem).weights
    for p in found.values():
        assert p[stay] > 0.9
        assert p[leave] < 1e-3
    assert found[0.0][[back, remain]].sum() < 1e-4
    second = 0.1 * 0.25 * 0.5  # restarts there, and leaves at once
    assert found[0.25][back] == pytest.approx(second, rel=0.1)
    assert found[0.25][remain] < 0.1 * found[0.25][back]
