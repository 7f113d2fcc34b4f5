"""Perturbations: each against its definition, in lock step, revealed, composed and collected."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import kreps
from kreps.envs.batch import batch_model_of, time_stamps_of
from kreps.envs.perturb import (
    LEVELS,
    Backlash,
    DeadZone,
    Delay,
    Dropped,
    Hidden,
    Lag,
    Noise,
    Perturbation,
    Perturbed,
    Stuck,
    level,
)
from kreps.envs.perturb.perturbation import Chain
from kreps.envs.perturb.signal import Signal
from kreps.envs.swing_up import (
    INERTIA,
    SwingUp,
    SwingUpBatch,
    integrate,
    integrate_with_dry_friction,
)
from kreps.errors import ConfigurationError, SpaceError
from kreps.kernels.arrays import FloatArray
from kreps.learning.collect import collect
from kreps.learning.control_period import time_stamps
from kreps.learning.environment import task_of
from kreps.policies.exploration import BangBang

SWING_UP = "kreps/SwingUp-v0"
ALL: dict[str, Perturbation] = {
    "delay": Delay(2),
    "random delay": Delay(3, least=0),
    "noise": Noise(0.2),
    "dropped": Dropped(0.2, 2),
    "stuck": Stuck(0.2, 2),
    "lag": Lag(2.0),
    "dead zone": DeadZone(0.5),
    "backlash": Backlash(0.4),
}


def signal(size: int, limit: float = 100.0) -> Signal:
    high = np.full(size, limit)
    return Signal(-high, high, np.zeros(size, bool), ("x",) * size)


TURN = Signal(np.array([-0.5 * np.pi]), np.array([1.5 * np.pi]), np.array([True]), ("angle",))


def response(
    part: Perturbation, inputs: Any, source: Signal | None = None, seed: int = 0
) -> FloatArray:
    """What a perturbation makes of one sequence (T,) or (T, d), the first value at the start."""
    values = np.asarray(inputs, dtype=np.float64)
    values = values.reshape(len(values), -1)
    chain = Chain(source or signal(values.shape[1]), (part,))
    rngs = [np.random.default_rng(seed)]
    states, first = chain.start(values[:1], rngs)
    outputs = [first]
    for row in values[1:]:
        states, output = chain.step(states, row[None], rngs)
        assert states.shape == (1, len(chain.hidden))
        outputs.append(output)
    return np.concatenate(outputs).squeeze(axis=1 if values.shape[1] == 1 else ())


# ---- each perturbation against its definition -------------------------------------------------


def test_a_delayed_value_is_exactly_that_of_so_many_steps_ago() -> None:
    inputs = np.arange(10.0)
    np.testing.assert_array_equal(response(Delay(3), inputs), [0, 0, 0, 0, 1, 2, 3, 4, 5, 6])


def test_random_delays_are_uniform_and_never_beyond_their_range() -> None:
    inputs = np.arange(4000.0)
    delays = (inputs - response(Delay(3, least=1), inputs))[3:]
    counts = np.bincount(delays.astype(int), minlength=5) / len(delays)
    np.testing.assert_allclose(counts, [0.0, 1 / 3, 1 / 3, 1 / 3, 0.0], atol=0.03)


def test_the_response_of_a_lag_to_a_step_is_the_exact_exponential() -> None:
    found = response(Lag(4.0), [0.0, *[2.0] * 12])
    np.testing.assert_allclose(found, 2.0 * (1.0 - np.exp(-np.arange(13) / 4.0)), rtol=1e-12)


def test_a_dead_zone_is_continuous_and_odd() -> None:
    found = response(DeadZone(1.5), [-3.0, -1.5, -1.0, 0.0, 1.0, 1.5, 2.0])
    np.testing.assert_array_equal(found, [-1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5])


def test_backlash_has_the_loop_of_the_play_operator() -> None:
    up, down = np.arange(0.0, 2.0, 0.125), np.arange(2.0, -2.0, -0.125)
    inputs = np.concatenate([up, down, np.arange(-2.0, 2.0, 0.125)])
    found = response(Backlash(0.5), inputs)
    y, expected = 0.0, []
    for x in inputs:  # the definition
        y = min(max(y, x - 0.25), x + 0.25)
        expected.append(y)
    np.testing.assert_array_equal(found, expected)
    at = np.flatnonzero(inputs == 0.0)  # three passes through zero: up, down, up
    np.testing.assert_array_equal(found[at], [0.0, 0.25, -0.25])
    np.testing.assert_array_equal(response(Backlash(0.0), inputs), inputs)


def test_angles_take_the_smaller_way_round_where_their_numbers_wrap() -> None:
    turning = np.arange(-1.5, 12.0, 0.1)
    wrapped = TURN.wrap(turning[:, None])[:, 0]
    for part in (Backlash(0.3), Lag(2.0)):
        found = response(part, wrapped, TURN)
        straight = response(part, turning)
        assert (found >= TURN.low).all() and (found <= TURN.high).all()
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * straight), atol=1e-9)


def test_noise_has_its_standard_deviation_and_widens_the_space() -> None:
    found = response(Noise((0.5, 0.0)), np.ones((4000, 2)))
    assert found[:, 0].std() == pytest.approx(0.5, rel=0.05)
    assert found[:, 0].mean() == pytest.approx(1.0, abs=0.03)
    np.testing.assert_array_equal(found[:, 1], 1.0)
    wide = Noise((0.5, 0.0)).output(signal(2))
    np.testing.assert_array_equal(wide.high, [np.inf, 100.0])
    noisy = response(Noise(1.0), np.zeros(200), TURN)
    assert noisy.min() >= TURN.low[0] and noisy.max() <= TURN.high[0]
    np.testing.assert_array_equal(Noise(1.0).output(TURN).high, TURN.high)


@pytest.mark.parametrize("kind", [Dropped, Stuck])
def test_failures_begin_with_their_probability_and_last_exactly(kind: Any) -> None:
    inputs = 1.0 + np.arange(8000.0)
    found = response(kind(0.05, 4), inputs, signal(1, 1e9))
    failed = found != inputs
    begins = np.flatnonzero(failed & ~np.concatenate([[False], failed[:-1]]))
    ends = np.flatnonzero(failed & ~np.concatenate([failed[1:], [False]]))
    lengths = (ends - begins + 1)[:-1]
    assert (lengths % 4 == 0).all()  # one that begins right after another continues it
    # of the steps without a failure, one in twenty begins one
    assert failed.sum() / 4 / (len(found) - failed.sum()) == pytest.approx(0.05 / 0.95, rel=0.1)
    expected = np.zeros_like(inputs)
    if kind is Stuck:  # the value before the failure
        expected = inputs[np.maximum.accumulate(np.where(failed, 0, np.arange(len(inputs))))]
    np.testing.assert_array_equal(found[failed], expected[failed])


def test_failures_of_coordinates_are_independent() -> None:
    found = response(Dropped(0.3), np.ones((4000, 2))) == 0.0
    assert found.mean() == pytest.approx(0.3, abs=0.02)
    assert (found[:, 0] & found[:, 1]).mean() == pytest.approx(0.09, abs=0.02)


def test_hidden_coordinates_are_left_out() -> None:
    inputs = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(response(Hidden((0, 2)), inputs), inputs[:, [1]])
    env = Perturbed(SwingUp(), observations=[Hidden(1)])
    assert env.metadata["observation_labels"] == ("angle from upright [rad]",)
    assert task_of(env).periodic == (0,)
    with pytest.raises(SpaceError, match="coordinates 0 to 1"):
        Perturbed(SwingUp(), observations=[Hidden((0, 1))])
    with pytest.raises(SpaceError, match="coordinates 0 to 0"):  # of what is left
        Perturbed(SwingUp(), observations=[Hidden(1), Hidden(1)])


# ---- the wrapper ------------------------------------------------------------------------------


def perturbed(name: str, reveal: bool = False) -> gym.Env[Any, Any]:
    """An environment with one perturbation on either side, or with all of them."""
    both = list(ALL.values()) if name == "all" else [ALL[name]]
    return Perturbed(SwingUp("rgb_array"), actions=both, observations=both, reveal=reveal)


def trajectory(
    env: gym.Env[Any, Any], seed: int, actions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Observations (T + 1, ds) and rewards (T,)."""
    observations, rewards = [env.reset(seed=seed)[0]], []
    for action in actions:
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(rewards)


@pytest.mark.parametrize("reveal", [False, True])
@pytest.mark.parametrize("name", [*ALL, "all"])
def test_gymnasium_checker_has_no_warning(name: str, reveal: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity.*")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        check_env(perturbed(name, reveal), skip_render_check=True)


@pytest.mark.parametrize("reveal", [False, True])
@pytest.mark.parametrize("name", [*ALL, "all"])
def test_lock_step_and_wrapper_give_the_same_rows_from_the_same_seeds(
    name: str, reveal: bool
) -> None:
    env, seeds, steps = perturbed(name, reveal), [3, 14, 159], 25
    model = batch_model_of(env)
    assert model is not None
    actions = np.random.default_rng(0).uniform(-45.0, 45.0, (steps, len(seeds), 1))
    rngs = [gym.utils.seeding.np_random(seed)[0] for seed in seeds]
    states = model.initial(rngs)
    observed, earned = [model.observe(states)], []
    for row in actions:
        states, rewards, ends = model.step(states, row, rngs)
        assert not ends.any()
        observed.append(model.observe(states))
        earned.append(rewards)
    for j, seed in enumerate(seeds):
        observations, rewards = trajectory(env, seed, actions[:, j])
        np.testing.assert_allclose(observations, np.array(observed)[:, j], rtol=0, atol=1e-9)
        np.testing.assert_allclose(rewards, np.array(earned)[:, j], rtol=0, atol=1e-9)
        again, _ = trajectory(env, seed, actions[:, j])
        np.testing.assert_array_equal(observations, again)
    assert (observations != trajectory(env, 4, actions[:, -1])[0]).any()


def test_delayed_actions_act_so_many_steps_later_and_rest_before() -> None:
    actions = np.random.default_rng(1).uniform(-45.0, 45.0, (12, 1))
    late, _ = trajectory(Perturbed(SwingUp(), actions=[Delay(4)]), 0, actions)
    shifted = np.concatenate([np.zeros((4, 1)), actions[:-4]])
    np.testing.assert_array_equal(late, trajectory(SwingUp(), 0, shifted)[0])


def test_perturbations_compose_in_order_in_one_wrapper_and_in_several() -> None:
    actions = np.random.default_rng(1).uniform(-45.0, 45.0, (20, 1))
    parts: Sequence[Perturbation] = [DeadZone(3.0), Lag(2.0), Delay(2)]
    together = Perturbed(SwingUp(), actions=parts, observations=[Delay(1), Backlash((0.1, 0.0))])
    inner = Perturbed(SwingUp(), actions=parts[2:], observations=[Delay(1)])
    apart = Perturbed(inner, actions=parts[:2], observations=[Backlash((0.1, 0.0))])
    assert task_of(apart).periodic == (0,) and batch_model_of(apart) is not None
    found, expected = (trajectory(env, 0, actions)[0] for env in (apart, together))
    np.testing.assert_array_equal(found, expected)
    other = Perturbed(SwingUp(), actions=[parts[1], parts[0], parts[2]])
    assert (trajectory(other, 0, actions)[0] != trajectory(inner, 0, actions)[0]).any()


def test_the_full_state_is_revealed_and_the_environment_moves_as_without_it() -> None:
    actions = np.random.default_rng(1).uniform(-45.0, 45.0, (12, 1))
    sides: dict[str, Any] = {"actions": [Delay(2), Lag(3.0)], "observations": [Noise(0.5)]}
    env = Perturbed(SwingUp(), **sides, reveal=True)
    assert env.metadata["observation_labels"][2:] == (
        "torque [N m], 1 step ago",
        "torque [N m], 2 steps ago",
        "lagged torque [N m]",
    )
    assert task_of(env).periodic == (0,)
    np.testing.assert_array_equal(env.observation_space.high[2:], 30.0)  # type: ignore[attr-defined]
    full, rewards = trajectory(env, 0, actions)
    _, same = trajectory(Perturbed(SwingUp(), **sides), 0, actions)
    np.testing.assert_array_equal(rewards, same)
    clipped = np.clip(actions[:, 0], -30.0, 30.0)
    np.testing.assert_array_equal(full[1:, 2], clipped)
    np.testing.assert_array_equal(full[2:, 3], clipped[:-1])
    lagged = response(Lag(3.0), [0.0, 0.0, 0.0, *clipped[:-2]])
    np.testing.assert_allclose(full[1:, 4], lagged[1:], rtol=1e-12)
    # the reward has the angle and velocity that are revealed, and the torque that acts
    theta, velocity = full[:-1, 0], full[:-1, 1]
    cost = -10.0 * theta**2 - 0.1 * velocity**2 - 0.001 * full[1:, 4] ** 2
    np.testing.assert_allclose(rewards, cost, rtol=1e-12)


def test_an_environment_of_single_precision_without_a_batch_model_keeps_its_types() -> None:
    env = Perturbed(gym.make("Pendulum-v1"), **level("medium"))
    assert batch_model_of(env) is None and env.observation_space.dtype == np.float32
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert task_of(env).time_limit == 200 and task_of(env).dt == 0.05
    first, _ = env.reset(seed=5)
    seen = [first, *(env.step(np.array([2.0], np.float32))[0] for _ in range(9))]
    assert all(each in env.observation_space for each in seen)
    assert seen[0].tolist() == seen[6].tolist() != seen[9].tolist()  # delayed by six steps


def test_metadata_below_an_unknown_wrapper_are_not_taken_over() -> None:
    class Reversed(gym.ObservationWrapper[Any, Any, Any]):
        def observation(self, observation: Any) -> Any:
            return observation[::-1].copy()

    with pytest.warns(UserWarning, match="Perturbed and Reversed may change the observations"):
        assert task_of(Perturbed(Reversed(SwingUp()), observations=[Delay(1)])).periodic == ()


def test_levels_have_the_numbers_of_the_public_suite() -> None:
    found = {
        name: (p["delay"].steps, p["noise"].std, p["dropped"].probability, p["dropped"].steps)  # type: ignore[attr-defined]
        for name, p in LEVELS.items()
    }
    assert found == {
        "easy": (3, 0.1, 0.01, 1),
        "medium": (6, 0.3, 0.05, 5),
        "hard": (9, 1.0, 0.1, 10),
    }
    assert level("hard")["actions"] == [Delay(9), Noise(1.0)]
    assert level("hard")["observations"] == [Noise(1.0), Dropped(0.1, 10), Stuck(0.1, 10), Delay(9)]
    with pytest.raises(ConfigurationError, match="easy, medium, hard"):
        level("extreme")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Delay(0), "Delay.steps = 0"),
        (lambda: Delay(2, least=3), "at most steps = 2"),
        (lambda: Noise(-0.1), "at least 0"),
        (lambda: Noise(float("nan")), "finite"),
        (lambda: Dropped(1.5), "Dropped.probability = 1.5"),
        (lambda: Stuck(0.1, 0), "Stuck.steps"),
        (lambda: Lag(0.0), "a positive number"),
        (lambda: Perturbed(SwingUp(), observations=[Noise((0.1, 0.1, 0.1))]), "3 values of std"),
        (lambda: Perturbed(SwingUp(), actions=["delay"]), "no perturbation"),  # type: ignore[list-item]
        (lambda: Perturbed(gym.make("CartPole-v1")), "action space is Discrete"),
        (lambda: SwingUp(jitter=1.0), r"\[0, 1\)"),
        (lambda: SwingUp(dry_friction=-1.0), "at least 0 N m"),
    ],
)
def test_impossible_parameters_are_refused(make: Any, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        make()


# ---- dry friction -----------------------------------------------------------------------------


def test_a_pendulum_with_dry_friction_sticks_up_to_its_torque() -> None:
    theta, velocity = np.full(3, np.pi), np.zeros(3)
    for _ in range(40):
        theta, velocity = integrate_with_dry_friction(
            theta, velocity, np.array([4.9, 5.1, -5.1]), 5.0
        )
    assert (theta[0], velocity[0]) == (np.pi, 0.0)
    assert theta[1] > np.pi > theta[2]


def test_dry_friction_opposes_the_motion_with_its_size_and_ends_it() -> None:
    theta, velocity = np.array([0.5, 0.5]), np.array([6.0, 6.0])
    rubbed = integrate_with_dry_friction(theta, velocity, np.zeros(2), 5.0)
    braked = integrate(theta, velocity, np.full(2, -5.0))
    np.testing.assert_allclose(rubbed, braked, rtol=1e-12)
    np.testing.assert_allclose(
        integrate_with_dry_friction(theta, velocity, np.ones(2), 0.0),
        integrate(theta, velocity, np.ones(2)),
        rtol=1e-12,
    )
    theta, velocity = np.array([np.pi + 0.05]), np.array([0.3])
    for _ in range(40):
        theta, velocity = integrate_with_dry_friction(theta, velocity, np.zeros(1), 5.0)
    # at rest where friction holds the weight, 49.05 N m sin, and not at the bottom
    assert velocity[0] == 0.0
    assert 0.01 < abs(theta[0] - np.pi) <= np.arcsin(5.0 / 49.05)


# ---- jitter of the sampling time --------------------------------------------------------------

JITTERED = ["kreps/SwingUp-v0", "kreps/Reaching-v0", "kreps/ImageSwingUp-v0"]


@pytest.mark.parametrize("name", JITTERED)
def test_control_periods_vary_in_lock_step_as_in_the_environment(name: str) -> None:
    env = Perturbed(gym.make(name, jitter=0.4), actions=[Delay(1)])
    model = batch_model_of(env)
    assert model is not None
    rngs = [gym.utils.seeding.np_random(seed)[0] for seed in (3, 4)]
    states = model.initial(rngs)
    infos = [[env.reset(seed=seed)[1]] for seed in (3, 4)]
    stamps = [time_stamps_of(model, states)]
    actions = np.ones((2, *env.action_space.shape))  # type: ignore[misc]
    for _ in range(30):
        states, *_ = model.step(states, actions, rngs)
        stamps.append(time_stamps_of(model, states))
    observation, info = env.reset(seed=4)
    times = [info["time"]]
    for _ in range(30):
        observation, *_, info = env.step(actions[1])
        times.append(info["time"])
    assert infos[0] == [{"time": 0.0}]
    np.testing.assert_array_equal(np.array(stamps)[:, 1], times)
    np.testing.assert_allclose(observation, model.observe(states)[1], rtol=0, atol=1e-9)
    periods = np.diff(np.array(stamps), axis=0)
    assert 0.03 <= periods.min() < 0.034 and 0.066 < periods.max() <= 0.07
    assert time_stamps_of(SwingUpBatch(), SwingUpBatch().initial(rngs)) is None


def test_a_period_of_other_length_is_that_of_the_equation_of_motion() -> None:
    theta, velocity = np.array([1.0, 1.0]), np.array([-1.0, -1.0])
    half, twice = integrate(theta, velocity, np.ones(2), period=np.array([0.025, 0.1]))
    first = integrate(theta[:1], velocity[:1], np.ones(1), period=0.025)
    np.testing.assert_allclose([half[0], twice[0]], np.ravel(first), rtol=1e-12)
    second = integrate(*integrate(theta[1:], velocity[1:], np.ones(1)), np.ones(1))
    np.testing.assert_allclose([half[1], twice[1]], np.ravel(second), rtol=1e-6)
    # an impulse of 1 N m for 0.001 s on a body at rest
    _, speed = integrate(np.array([np.pi]), np.zeros(1), np.ones(1), period=0.001)
    assert speed[0] == pytest.approx(0.001 / INERTIA, rel=1e-3)


def test_rollouts_have_time_stamps_in_lock_step_and_step_by_step_and_in_files(
    tmp_path: Any,
) -> None:
    env = gym.make(SWING_UP, jitter=0.4)
    task = task_of(env)
    batch, single = (
        collect(each, task, BangBang(task), 4, seed=0, iteration=0, restart_probability=0.05)
        for each in (env, gym.Wrapper(env))
    )
    assert batch.times is not None and single.times is not None
    np.testing.assert_allclose(batch.times, single.times, rtol=1e-12)
    assert len(batch[1].times) == len(batch[1]) + 1 and batch[1].times[0] == 0.0  # type: ignore[arg-type,index]
    kreps.save_rollouts(batch, tmp_path / "r")
    loaded = kreps.load_rollouts(tmp_path / "r")
    np.testing.assert_array_equal(loaded[1:3].times, batch[1:3].times)  # type: ignore[arg-type]
    plain = kreps.Rollout(np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2))
    assert kreps.Rollouts.from_list([*batch, plain]).times is None
    kreps.save_rollouts([plain], tmp_path / "p")
    assert b"times" not in (tmp_path / "p").read_bytes()  # as files of before
    assert kreps.load_rollouts(tmp_path / "p").times is None
    learner = kreps.KREPS(env, preset="single_step", initial_rollouts=3).learn(1, progress=False)
    learner.save(tmp_path / "c")
    resumed = kreps.KREPS.resume(tmp_path / "c", env)
    np.testing.assert_array_equal(
        resumed.state.window.rollouts.times,  # type: ignore[arg-type]
        learner.state.window.rollouts.times,
    )


@pytest.mark.parametrize("wrong", [[0.0, 1.0], [0.0, 1.0, 1.0], [0.0, np.nan, 2.0]])
def test_time_stamps_that_do_not_fit_are_refused_and_foreign_ones_ignored(wrong: Any) -> None:
    with pytest.raises(kreps.DataError, match="times"):
        kreps.Rollout(np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2), times=np.array(wrong))
    if len(wrong) == 3:
        assert time_stamps(wrong) is None
    assert time_stamps([None, "noon"]) is None
    np.testing.assert_array_equal(time_stamps([0, 0.5]), [0.0, 0.5])  # type: ignore[arg-type]


def test_a_learner_learns_from_a_perturbed_environment_in_lock_step() -> None:
    env = Perturbed(gym.make(SWING_UP), actions=[Delay(3)], observations=[Noise((0.1, 0.3))])
    learner = kreps.KREPS(env, seed=0, preset="single_step", initial_rollouts=5)
    assert batch_model_of(learner.env) is not None and learner.task.periodic == (0,)  # type: ignore[arg-type]
    learner.learn(2, progress=False)
    assert learner.state.window.rollouts.points.shape[1] == 2


def test_a_command_without_some_coordinates_is_refused() -> None:
    env = gym.make("kreps/Reaching-v0")
    with pytest.raises(SpaceError, match="number of action coordinates from 2 to 1"):
        Perturbed(env, actions=[Hidden(0)])


class Counting(gym.Env[Any, Any]):
    """Takes whole numbers, and keeps the last one."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    action_space = gym.spaces.Box(0, 10, (1,), np.int64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        self.got = action
        return np.zeros(1), 0.0, False, False, {}


def test_whole_commands_are_rounded_to_the_nearest() -> None:
    inside = Counting()
    env = Perturbed(inside, actions=[Lag(1.0)])
    env.reset(seed=0)
    for _ in range(8):
        env.step(np.array([3]))
    assert inside.got.dtype == np.int64 and inside.got.tolist() == [3]
