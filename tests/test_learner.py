"""The public interface of learners, and a linear-quadratic problem with a known optimum."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import kreps
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, DataError
from kreps.kernels.arrays import FloatArray
from kreps.learning.collect import collect
from kreps.learning.evaluate import Greedy, evaluate
from kreps.learning.iteration import IterationReport
from kreps.policies.base import StochasticPolicy
from kreps.policies.exploration import BangBang, Gaussian

TINY: dict[str, Any] = {
    "initial_rollouts": 6,
    "rollouts_per_iteration": 3,
    "growth": 0.0,
    "window": 6,
    "window_steps": 0,
    "model_based.improvement_steps": 1,
    "model_based.acceptance_rollouts": 10,
}
NO_EXPLORER: dict[str, Any] = {"model_based.exploration_bonus": 0.0}
STATES = np.stack([np.linspace(-1.5, 4.5, 7), np.linspace(-6.0, 6.0, 7)], axis=1)


def swing_up(seed: int = 0, **settings: Any) -> kreps.KREPS:
    return kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=seed, **{**TINY, **settings})


def without_model() -> kreps.KREPS:
    """A learner with fast updates, for what does not depend on them."""
    return kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=0, initial_rollouts=6, model_based=None)


@pytest.fixture(scope="module")
def learnt() -> kreps.KREPS:
    """After two iterations.  Tests must not change it."""
    return swing_up().learn(2, progress=False)


@pytest.fixture(scope="module")
def without_explorer() -> kreps.KREPS:
    """The same, of which every rollout is the acting policy's."""
    return swing_up(**NO_EXPLORER).learn(2, progress=False)


# ---- learning ---------------------------------------------------------------------------------


def test_any_gymnasium_environment_can_be_learnt_in() -> None:
    learner = kreps.KREPS(gym.make("Pendulum-v1"), seed=0, **TINY)
    assert learner.learn(2, progress=False) is learner
    assert learner.state.iteration == 2
    assert learner.state.rollouts == 9
    assert learner.task.observation_size == 3 and learner.task.periodic == ()
    action, _ = learner.policy.predict(np.array([1.0, 0.0, 0.0]))
    assert action.shape == (1,) and np.abs(action) <= 2.0


def collected(learner: kreps.KREPS, policy: StochasticPolicy, iteration: int) -> Rollouts:
    """The rollouts that `learn` collects for an update, with `TINY`."""
    assert learner.env is not None
    return collect(
        learner.env,
        learner.task,
        policy,
        3 if iteration else 6,
        seed=0,
        iteration=iteration,
        restart_probability=0.02,
        stratified=learner.settings.rollout_lengths == "stratified",
    )


def test_counts_include_forgotten_rollouts(without_explorer: kreps.KREPS) -> None:
    state = without_explorer.state
    assert (state.iteration, state.rollouts) == (2, 9)
    assert len(state.window.rollouts) == 6
    first = collected(without_explorer, BangBang(without_explorer.task), 0)
    assert state.steps == first.steps + state.window.rollouts[3:].steps
    for mine, theirs in zip(state.window.rollouts[:3], first[3:], strict=True):
        np.testing.assert_array_equal(mine.actions, theirs.actions)


@pytest.mark.parametrize(("noise", "kind"), [("bang-bang", BangBang), ("gaussian", Gaussian)])
def test_the_first_policy_is_that_of_the_settings(noise: Any, kind: Any) -> None:
    learner = swing_up(exploration=kreps.Exploration(noise, 0.5))
    learner.learn(1, progress=False)
    actions = learner.state.window.rollouts.actions
    if kind is BangBang:
        assert set(np.unique(actions)) == {-30.0, 30.0}
    else:
        assert actions.std() == pytest.approx(0.5 * 30.0, rel=0.2)


def test_updates_from_given_rollouts_need_no_environment(learnt: kreps.KREPS) -> None:
    rollouts = learnt.state.window.rollouts
    learner = kreps.KREPS(TaskSpec(2, [-30.0], [30.0], (0,)), seed=0, **TINY)
    info = learner.update(list(rollouts))
    assert info.samples == rollouts.steps
    assert learner.state.iteration == 1 and learner.state.rollouts == 6
    assert info.dual.kl <= learner.settings.kl_bound * (1 + 1e-3)
    action, _ = learner.policy.predict([3.0, 0.0], deterministic=True)
    assert abs(action[0]) <= 30.0
    learner.update(iter(rollouts[:2]))  # any iterable
    assert learner.state.rollouts == 8


def test_learn_is_collect_and_update(without_explorer: kreps.KREPS) -> None:
    by_hand = swing_up(**NO_EXPLORER)
    policy: StochasticPolicy = BangBang(by_hand.task)
    for iteration in (0, 1):
        by_hand.update(collected(by_hand, policy, iteration))
        assert by_hand.state.policy is not None
        policy = by_hand.state.policy
    np.testing.assert_allclose(
        by_hand.policy.predict(STATES, deterministic=True)[0],
        without_explorer.policy.predict(STATES, deterministic=True)[0],
        rtol=0,
        atol=1e-6,
    )


def test_learning_without_an_environment_raises_with_a_remedy() -> None:
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]))
    with pytest.raises(ConfigurationError, match=r"no environment.*update\(\)"):
        learner.learn(1)


def test_results_before_the_first_update_raise() -> None:
    learner = swing_up()
    for result in (
        lambda: learner.policy,
        lambda: learner.value_function,
        lambda: learner.predict([0.0, 0.0]),
    ):
        with pytest.raises(ConfigurationError, match="before the first update"):
            result()


def test_a_second_call_of_learn_continues_the_first(learnt: kreps.KREPS) -> None:
    learner = swing_up().learn(1, progress=False).learn(1, progress=False)
    assert learner.state.iteration == 2
    np.testing.assert_array_equal(
        learner.policy.predict(STATES, deterministic=True)[0],
        learnt.policy.predict(STATES, deterministic=True)[0],
    )


def test_an_update_is_bounded_in_kl_for_each_bound() -> None:
    for bound in (0.2, 0.8):
        reports: list[IterationReport] = []
        learner = swing_up(kl_bound=bound, eta_floor=0.0)
        learner.learn(1, progress=False, callback=lambda _, r, into=reports: into.append(r))
        assert reports[0].update.dual.kl == pytest.approx(bound, rel=1e-3)


# ---- reproducibility --------------------------------------------------------------------------


def test_same_seed_same_bytes_and_another_seed_another_policy(
    learnt: kreps.KREPS, tmp_path: Path
) -> None:
    learnt.policy.save(tmp_path / "first")
    swing_up().learn(2, progress=False).policy.save(tmp_path / "again")
    swing_up(seed=1).learn(2, progress=False).policy.save(tmp_path / "other")
    contents = [(tmp_path / name).read_bytes() for name in ("first", "again", "other")]
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]


def test_neither_global_randomness_nor_predicting_changes_what_is_learnt(
    learnt: kreps.KREPS,
) -> None:
    learner = swing_up().learn(1, progress=False)
    np.random.seed(123)  # noqa: NPY002 (the global state is what must not matter)
    for _ in range(5):
        learner.predict([3.0, 0.0])
    learner.learn(1, progress=False)
    np.testing.assert_array_equal(
        learner.policy.predict(STATES, deterministic=True)[0],
        learnt.policy.predict(STATES, deterministic=True)[0],
    )


# ---- callbacks --------------------------------------------------------------------------------


def test_callbacks_are_called_in_order_with_a_report() -> None:
    calls: list[tuple[str, int]] = []
    reports: list[IterationReport] = []

    def first(learner: kreps.KREPS, report: IterationReport) -> None:
        calls.append(("first", report.iteration))
        assert learner.state.iteration == report.iteration  # after the update
        assert report.steps == learner.state.steps
        reports.append(report)

    def second(learner: kreps.KREPS, report: IterationReport) -> bool:
        calls.append(("second", report.iteration))
        return True

    learner = swing_up(**NO_EXPLORER)
    learner.learn(3, callback=[first, second], progress=False)
    assert calls == [(name, i) for i in (1, 2, 3) for name in ("first", "second")]
    assert [r.rollouts for r in reports] == [6, 9, 12]
    new = learner.state.window.rollouts[-3:]
    assert reports[-1].average_reward == pytest.approx(
        np.concatenate([r.rewards for r in new]).mean(), rel=1e-12
    )
    assert reports[-1].steps - reports[-2].steps == new.steps
    for report in reports:
        assert report.update.dual.kl <= 1.0 + 1e-3
        assert report.rollout_seconds >= 0
        assert {"basis", "embedding", "dual", "policy"} <= set(report.update.seconds)
        # of the model-based step: the samples and as many states of model rollouts
        weighted = 2 * report.update.samples
        assert len(report.update.dual.weights) == weighted
        assert 1.0 <= report.update.effective_samples <= weighted


def test_a_callback_that_returns_false_stops_learning_after_all_were_called() -> None:
    seen: list[int] = []

    def stop(learner: kreps.KREPS, report: IterationReport) -> bool:
        return report.iteration < 2

    def count(learner: kreps.KREPS, report: IterationReport) -> None:
        seen.append(report.iteration)

    learner = without_model()
    learner.learn(4, callback=[stop, count], progress=False)
    assert learner.state.iteration == 2
    assert seen == [1, 2]


@pytest.mark.parametrize("false", [np.False_, np.array(False), np.mean([1.0]) > 2.0])
def test_a_callback_may_return_the_false_of_numpy(false: Any) -> None:
    learner = without_model()
    learner.learn(3, callback=lambda learner, report: false, progress=False)
    assert learner.state.iteration == 1


@pytest.mark.parametrize("other", [np.True_, None, 0, 0.0, np.float64(0.0), [], np.zeros(2)])
def test_whatever_else_a_callback_returns_does_not_stop_learning(other: Any) -> None:
    learner = without_model()
    learner.learn(2, callback=[lambda learner, report: other], progress=False)
    assert learner.state.iteration == 2


@pytest.mark.parametrize("callback", [None, (), []])
def test_there_may_be_no_callback(callback: Any) -> None:
    learner = without_model().learn(1, callback=callback, progress=False)
    assert learner.state.iteration == 1


class Stop:
    """A callback whose constructor takes as many arguments as a callback is called with."""

    def __init__(self, reward: float, patience: int) -> None: ...

    def __call__(self, learner: kreps.KREPS, report: IterationReport) -> None: ...


@pytest.mark.parametrize(
    ("callback", "says"),
    [
        (7, r"callback = 7"),
        (object(), "must be a function of learner and report"),
        ([None], "callback = None"),
        ("stop", "callback = 's'"),
        (Stop, "give an object of it"),
        ([Stop(1.0, 2), Stop], "give an object of it"),
        (lambda report: None, "too many positional arguments"),
        (lambda learner, report, more: None, "missing a required argument: 'more'"),
    ],
)
def test_a_wrong_callback_is_refused_before_anything_is_collected(callback: Any, says: str) -> None:
    env = Unstarted(gym.make("Pendulum-v1"))
    with pytest.raises(ConfigurationError, match=says):
        kreps.KREPS(env, **TINY).learn(1, callback=callback, progress=False)


class Unstarted(gym.Wrapper[Any, Any, Any, Any]):
    def reset(self, **options: Any) -> Any:
        raise AssertionError("the environment was started")


def test_an_exception_in_a_callback_keeps_the_update() -> None:
    def fail(learner: kreps.KREPS, report: IterationReport) -> None:
        raise RuntimeError("disk full")

    learner = without_model()
    with pytest.raises(RuntimeError, match="disk full"):
        learner.learn(1, callback=fail, progress=False)
    assert learner.state.iteration == 1
    learner.learn(1, progress=False)
    assert learner.state.iteration == 2


def test_progress_prints_a_line_per_iteration_without_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    learner = swing_up().learn(2)
    *lines, last = capsys.readouterr().out.splitlines()
    assert last.startswith("CPU seconds: rollouts ")
    assert len(lines) == 2
    for number, line in enumerate(lines, 1):
        assert line.startswith(f"iter {number} ")
        assert all(name in line for name in ("steps", "reward", "KL / bound", "eta", "ESS"))
    assert f"steps {learner.state.steps} " in lines[-1]


# ---- predict ----------------------------------------------------------------------------------


def test_predict_takes_one_observation_or_a_batch(learnt: kreps.KREPS) -> None:
    policy = learnt.policy
    batch, state = policy.predict(STATES, deterministic=True)
    assert batch.shape == (7, 1) and state is None
    for row, expected in zip(STATES, batch, strict=True):
        action, _ = policy.predict(row, deterministic=True)
        assert action.shape == (1,)
        np.testing.assert_allclose(action, expected, rtol=0, atol=1e-9)
    as_list, memory = policy.predict([3, 0], "memory", np.array([True]), True)
    assert memory == "memory"
    np.testing.assert_array_equal(
        as_list, policy.predict(np.array([3.0, 0.0]), None, None, True)[0]
    )


def test_predict_of_an_empty_batch_is_empty_without_a_warning(
    learnt: kreps.KREPS, recwarn: pytest.WarningsRecorder
) -> None:
    actions, _ = learnt.policy.predict(np.empty((0, 2)), deterministic=True)
    assert actions.shape == (0, 1)
    assert [str(w.message) for w in recwarn] == []


def test_deterministic_prediction_is_the_mean_and_repeats(learnt: kreps.KREPS) -> None:
    policy = learnt.policy
    first, second = (policy.predict(STATES, deterministic=True)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    mean = policy.process.greedy(STATES)
    np.testing.assert_array_equal(first, np.clip(mean, -30.0, 30.0))


def test_stochastic_prediction_has_the_moments_of_the_policy(learnt: kreps.KREPS) -> None:
    policy = learnt.policy
    rng = np.random.default_rng(0)
    candidates = np.stack([rng.uniform(-1.5, 4.7, 500), rng.uniform(-8, 8, 500)], axis=1)
    mean = policy.process.greedy(candidates)[:, 0]
    spread = policy.process.standard_deviation(candidates)[:, 0]
    inside = np.flatnonzero(np.abs(mean) + 3 * spread < 30.0)  # clipping does not matter
    if len(inside) == 0:  # otherwise where it matters least
        inside = np.array([np.argmin(np.abs(mean) + 3 * spread)])
    i = inside[0]
    draws = policy.predict(np.tile(candidates[i], (4000, 1)))[0][:, 0]
    expected = np.clip(rng.normal(mean[i], spread[i], 400_000), -30.0, 30.0)
    assert draws.mean() == pytest.approx(expected.mean(), abs=5 * spread[i] / np.sqrt(4000))
    assert draws.std() == pytest.approx(expected.std(), rel=0.06)


def test_stochastic_prediction_differs_from_call_to_call(learnt: kreps.KREPS) -> None:
    policy = learnt.policy
    # many may be equal, as they are clipped; here the force is near its middle
    candidates = np.random.default_rng(0).uniform([-1.5, -8.0], [4.7, 8.0], (500, 2))
    state = candidates[np.argmin(np.abs(policy.process.greedy(candidates)[:, 0]))]
    actions = [float(policy.predict(state)[0][0]) for _ in range(300)]
    assert len(set(actions)) > 100


def test_predict_of_the_learner_differs_from_call_to_call_too(learnt: kreps.KREPS) -> None:
    candidates = np.random.default_rng(0).uniform([-1.5, -8.0], [4.7, 8.0], (500, 2))
    state = candidates[np.argmin(np.abs(learnt.policy.process.greedy(candidates)[:, 0]))]
    actions = [float(learnt.predict(state)[0][0]) for _ in range(300)]
    assert len(set(actions)) > 100


@dataclass(frozen=True)
class Noise:
    """A policy whose actions are the numbers it explores with."""

    task: TaskSpec

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return noise


def noise_after(updates: int, learner: kreps.KREPS) -> FloatArray:
    """The first five numbers that `predict` explores with after so many updates."""
    policy: Any = Noise(learner.task)
    learner.state = dataclasses.replace(learner.state, policy=policy, iteration=updates)
    return np.array([learner.predict([3.0, 0.0])[0] for _ in range(5)])


def test_exploration_noise_does_not_begin_anew_after_an_update() -> None:
    learner = swing_up()
    numbers = [noise_after(updates, learner) for updates in (1, 2, 3)]
    assert len(np.unique(numbers)) == 15
    # addressed by the iteration, so that a resumed learner explores with the same numbers
    np.testing.assert_array_equal(noise_after(2, swing_up()), numbers[1])
    assert not np.isin(noise_after(2, swing_up(seed=1)), numbers).any()


def test_exploration_noise_goes_on_between_two_updates_and_is_new_after_a_rejected_one() -> None:
    learner = swing_up()
    first = noise_after(1, learner)
    process = learner.policy.process
    more = learner.predict([3.0, 0.0])[0]
    assert more not in first
    learner.state = dataclasses.replace(learner.state, iteration=2)  # the same policy acts
    assert learner.policy.process is process
    assert learner.predict([3.0, 0.0])[0] not in [*first, more]


def test_actions_are_clipped_to_the_limits(learnt: kreps.KREPS) -> None:
    states = np.tile([np.pi, 0.0], (2000, 1))
    actions, _ = learnt.policy.predict(states)
    assert np.abs(actions).max() == 30.0  # the noise is still large, so that some are clipped
    assert np.abs(actions).min() < 30.0


@pytest.mark.parametrize(
    "observation",
    [
        [1.0],
        [1.0, 2.0, 3.0],
        1.0,
        np.zeros((2, 2, 2)),
        np.zeros((2, 3)),
        [np.nan, 0.0],
        [[0.0, 0.0], [0.0, np.inf]],
        "upright",
        None,
        [[1.0, 2.0], [3.0]],
        {"theta": 1.0},
    ],
)
def test_invalid_observations_raise(learnt: kreps.KREPS, observation: Any) -> None:
    with pytest.raises(DataError, match="observation"):
        learnt.policy.predict(observation)


def test_predictions_far_from_all_data_are_finite(learnt: kreps.KREPS) -> None:
    far = np.array([[0.0, 1e6], [1e12, 0.0], [0.0, -1e99]])
    for states in (far[0], far[1], far[2], far):
        for deterministic in (True, False):
            actions, _ = learnt.policy.predict(states, deterministic=deterministic)
            assert np.isfinite(actions).all() and np.abs(actions).max() <= 30.0


def test_an_outlier_in_a_batch_does_not_change_other_actions(learnt: kreps.KREPS) -> None:
    alone, _ = learnt.policy.predict([3.0, 0.5], deterministic=True)
    for far in (1e5, 1e10, 1e100):
        batch, _ = learnt.policy.predict([[3.0, 0.5], [0.0, far]], deterministic=True)
        assert batch[0, 0] == pytest.approx(alone[0], abs=1e-4)


# ---- invalid arguments ------------------------------------------------------------------------


def test_an_unknown_keyword_names_the_valid_ones() -> None:
    with pytest.raises(ConfigurationError) as caught:
        swing_up(kl_bond=0.5)
    message = str(caught.value)
    assert "kl_bond" in message
    for name in ("kl_bound", "ridge", "window", "restart_probability"):
        assert name in message


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"seed": True}, "seed"),
        ({"preset": "printed"}, "preset"),
        ({"kl_bound": 0.0}, "kl_bound"),
        ({"kl_bound": float("nan")}, "kl_bound"),
        ({"window": 2.5}, "window"),
        ({"model": "magic"}, "model"),
        ({"restart_probability": 1.0}, "restart_probability"),
    ],
)
def test_invalid_arguments_are_named(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        kreps.KREPS(gym.make("kreps/SwingUp-v0"), **arguments)


def _rollout(ds: int = 2, da: int = 1) -> Rollout:
    rng = np.random.default_rng(0)
    return Rollout(rng.normal(size=(5, ds)), rng.normal(size=(4, da)), rng.normal(size=4))


@pytest.mark.parametrize(
    ("rollouts", "says"),
    [
        (lambda: [], "no new rollout"),
        (lambda: [_rollout(ds=3)], "3 observation"),
        (lambda: [_rollout(da=2)], "2 action"),
        (
            lambda: [_rollout(), _rollout(da=2)],
            r"rollout 1 has .*\(2, 2\), those before it \(2, 1\)",
        ),
        (lambda: _rollout(), r"write \[rollout\]"),
        (lambda: [np.zeros((3, 2))], r"item 0 is a ndarray, not a kreps\.Rollout"),
        (lambda: [_rollout(), None], "item 1 is a NoneType"),
    ],
)
def test_invalid_rollouts_raise_and_leave_the_learner_unchanged(
    rollouts: Callable[[], list[Any]], says: str
) -> None:
    learner = swing_up()
    learner.update([_rollout()])
    before = learner.state
    with pytest.raises(DataError, match=says):
        learner.update(rollouts())
    assert learner.state is before


# ---- a linear-quadratic problem with a known optimum ------------------------------------------

P = 0.1
GAMMA = 1.0 - P
A = np.array([[1.0, 0.2], [0.0, 1.0]])
B = np.array([[0.02], [0.2]])
Q = np.diag([1.0, 0.1])
R = np.array([[0.1]])
NOISE, START, START_SPREAD = 0.1, np.array([1.0, 0.0]), 0.2


class DoubleIntegrator(gym.Env[Any, Any]):
    """A mass under a force, with quadratic cost, noise on the velocity and wide force limits."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gym.spaces.Box(-4.0, 4.0, (1,), np.float64)
        self.batch_model = self

    def observe(self, states: FloatArray) -> FloatArray:
        return states

    def initial(self, rngs: Any) -> FloatArray:
        return np.array([START + START_SPREAD * rng.standard_normal(2) for rng in rngs])

    def step(self, x: FloatArray, u: FloatArray, rngs: Any) -> Any:  # type: ignore[override]
        rewards = -np.einsum("ij,jk,ik->i", x, Q, x) - R[0, 0] * u[:, 0] ** 2
        noise = NOISE * np.array([[0.0, rng.standard_normal()] for rng in rngs])
        return x @ A.T + u @ B.T + noise, rewards, np.zeros(len(x), dtype=bool)


@dataclass(frozen=True)
class LinearFeedback:
    gain: FloatArray

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return -states @ self.gain.T


def optimum() -> tuple[FloatArray, float]:
    """Gain and average reward of the process with restarts, by a discounted Riccati equation."""
    root = math.sqrt(GAMMA)
    cost = solve_discrete_are(root * A, root * B, Q, R)
    gain = np.linalg.solve(R + GAMMA * B.T @ cost @ B, GAMMA * B.T @ cost @ A)
    start = np.outer(START, START) + START_SPREAD**2 * np.eye(2)
    noise = np.diag([0.0, NOISE**2])
    return gain, float(-P * np.trace(cost @ start) - GAMMA * np.trace(cost @ noise))


def average_reward(task: TaskSpec, policy: StochasticPolicy) -> float:
    return evaluate(
        DoubleIntegrator(), task, policy, restart_probability=P, episodes=200, steps=150, seed=1
    ).mean


def test_evaluation_agrees_with_the_riccati_equation() -> None:
    gain, best = optimum()
    task = TaskSpec(2, [-4.0], [4.0])
    assert average_reward(task, LinearFeedback(gain)) == pytest.approx(best, rel=0.03)
    for factor in (0.5, 2.0):  # other gains are worse
        assert average_reward(task, LinearFeedback(factor * gain)) < 1.05 * best


FEW_STEPS = {"model_based.improvement_steps": 3, "model_based.acceptance_rollouts": 20}


@pytest.mark.parametrize(
    ("preset", "few", "iterations"), [("model_based", FEW_STEPS, 5), ("single_step", {}, 10)]
)
def test_the_learnt_policy_is_near_the_optimum_of_a_linear_quadratic_problem(
    preset: str, few: dict[str, Any], iterations: int
) -> None:
    # Measured with seeds 0 to 7: with the preset "single_step" the cost is 1.02 to 1.07 of the
    # optimum.  With "model_based" and few steps it is 1.03 to 1.14 for five of them, 1.21 to 1.23
    # for three.
    # The cost of the first policy is 54 times the optimum, that of zero actions 4.6.
    _, best = optimum()
    shares = []
    for seed in range(5):
        learner = kreps.KREPS(
            DoubleIntegrator(),
            seed=seed,
            preset=preset,
            restart_probability=P,
            exploration=kreps.Exploration("gaussian"),
            initial_rollouts=40,
            rollouts_per_iteration=20,
            window=40,
            **few,
        )
        learner.learn(iterations, progress=False)
        assert learner.state.policy is not None
        shares.append(average_reward(learner.task, Greedy(learner.state.policy)) / best)
    first = (
        average_reward(TaskSpec(2, [-4.0], [4.0]), Gaussian(TaskSpec(2, [-4.0], [4.0]), 1.0)) / best
    )
    assert sorted(shares)[3] < (1.15 if preset == "single_step" else 1.25)  # at least four of five
    assert max(shares) < 1.5
    assert first > 10 * max(shares)


def test_contradicting_arguments_raise() -> None:
    task = kreps.TaskSpec(2, [-1.0], [1.0])
    with pytest.raises(ConfigurationError, match="periodic"):
        kreps.KREPS(task, periodic=(0,))
    restarting = kreps.RandomRestart(gym.make("kreps/SwingUp-v0"), 0.1)
    assert kreps.KREPS(restarting).settings.restart_probability == 0.1
    with pytest.raises(ConfigurationError, match="restart_probability"):
        kreps.KREPS(restarting, restart_probability=0.02)
    with pytest.raises(ConfigurationError, match="threads"):
        kreps.KREPS(task, threads="many")  # type: ignore[arg-type]
    for no_environment in ("Pendulum-v1", None, 3):
        with pytest.raises(ConfigurationError, match="gymnasium"):
            kreps.KREPS(no_environment)  # type: ignore[arg-type]


def test_a_preset_can_be_a_settings_object() -> None:
    settings = kreps.Settings(kl_bound=0.3, window=7)
    task = kreps.TaskSpec(2, [-1.0], [1.0])
    assert kreps.KREPS(task, preset=settings).settings == settings
    assert kreps.KREPS(task, preset=settings, window=9).settings.window == 9


def test_the_fraction_of_clipped_actions_is_of_the_new_rollouts() -> None:
    rng = np.random.default_rng(4)

    def fresh(scale: float) -> Rollout:
        return Rollout(rng.standard_normal((9, 2)), np.full((8, 1), scale), np.zeros(8))

    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]), window=4)
    assert learner.update([fresh(0.5)]).clipped == 0.0
    assert learner.update([fresh(2.0)]).clipped == 1.0


def test_rollouts_beyond_the_window_are_counted_but_not_kept() -> None:
    rng = np.random.default_rng(5)
    batch = [Rollout(rng.standard_normal((9, 2)), np.zeros((8, 1)), np.zeros(8)) for _ in "abc"]
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]), window=2, window_steps=0)
    info = learner.update(batch)
    assert info.samples == 16
    assert (learner.state.rollouts, learner.state.steps) == (3, 24)
    kept = learner.state.window.rollouts
    np.testing.assert_array_equal(kept.points, np.concatenate([r.observations for r in batch[1:]]))
