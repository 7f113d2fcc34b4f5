"""A session with a robot: the same rollouts as `learn`, whatever interrupts them, and in time."""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.errors import ConfigurationError, DataError, DataWarning, EnvironmentFailure
from kreps.learning.session import RobotSession
from kreps.learning.storage.files import reading

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
TINY: dict[str, Any] = {
    "preset": "single_step",
    "restart_probability": 0.1,
    "initial_rollouts": 6,
    "rollouts_per_iteration": 3,
}
PERIOD = 0.05
STOP = [0.5]


class Cart(gym.Env[Any, Any]):
    """A mass that is pushed with noise; the episode ends beyond 1 m.

    Not a batch, so that learners step it one rollout after the other, as a robot.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    metadata: dict[str, Any] = {"dt": PERIOD}  # noqa: RUF012

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = self.np_random.normal(scale=0.2, size=2)
        return self.state.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        x, v = self.state
        assert np.abs(action) <= 1.0
        self.state = np.array([x + 0.2 * v, v + 0.3 * action[0] + 0.05 * self.np_random.normal()])
        ended = bool(abs(self.state[0]) > 1.0)
        return self.state.copy(), float(-(x**2) - 0.1 * v**2), ended, False, {}


def cart() -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(Cart(), 15)


class FakeClock:
    """A clock that only moves when someone sleeps."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def learner(**settings: Any) -> kreps.KREPS:
    """One without an environment, that knows of the task what one in `cart` would know."""
    task = kreps.KREPS(cart(), **TINY, **settings).task
    return kreps.KREPS(task, seed=3, **TINY, **settings)


def drive(
    robot: RobotSession,
    updates: int,
    on_cycle: Callable[[], object] = lambda: None,
    on_rollout: Callable[[], object] = lambda: None,
) -> None:
    """A user's control loop, with the cart as the robot."""
    env = cart()
    for rollout in robot.rollouts(updates, progress=False):
        on_rollout()
        observation, _ = env.reset(seed=rollout.seed)
        action = robot.act(observation)
        while robot.running:
            on_cycle()
            robot.wait()
            observation, reward, terminated, _, _ = env.step(action)
            robot.reward(reward, terminated)
            action = robot.act(observation)


def files(folder: Path) -> dict[str, bytes]:
    """All that a session leaves."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def ends(folder: Path) -> list[str]:
    """Why each recorded rollout ended."""
    found = []
    for file in sorted((folder / "rollouts").iterdir()):
        with reading(file, "rollouts") as (_, header):
            found.append(header["end"])
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of three updates that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    with learner().session(folder, clock=FakeClock()) as robot:
        drive(robot, 3)
        assert robot.missed_deadlines == 0
    return folder


# ---- the rollouts of learn ----------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, {"action_repeat": 2, "rollout_lengths": "independent"}])
def test_a_session_is_learn_turned_inside_out(settings: dict[str, Any], tmp_path: Path) -> None:
    ours = learner(**settings)
    with ours.session(tmp_path / "session", clock=FakeClock()) as robot:
        drive(robot, 3)
    same = kreps.KREPS(cart(), seed=3, **TINY, **settings).learn(3, progress=False)
    same.save(tmp_path / "learn")
    expected = (tmp_path / "learn").read_bytes()
    assert (tmp_path / "session/checkpoint.safetensors").read_bytes() == expected
    assert ours.state.steps == same.state.steps
    assert {"terminated", "time limit", "drawn length"} == set(ends(tmp_path / "session"))
    data = kreps.rollout_folder(tmp_path / "session/rollouts")
    assert sum(len(chunk.load()) for chunk in data.chunks) == ours.state.rollouts


# ---- interruptions ------------------------------------------------------------------------------


def test_a_session_that_is_left_in_a_rollout_goes_on_with_the_same_bytes(
    tmp_path: Path, whole: Path
) -> None:
    left, cycles = 0, iter(np.random.default_rng(0).integers(5, 25, size=100).tolist())

    def leave() -> None:
        nonlocal count
        count -= 1
        if count < 0:
            raise InterruptedError

    done = False
    while not done:
        count = next(cycles)
        try:
            with learner().session(tmp_path, clock=FakeClock()) as robot:
                drive(robot, 3, leave)
                done = True
        except InterruptedError:
            left += 1
    assert left >= 3
    assert files(tmp_path) == files(whole)


@pytest.mark.slow
def test_a_session_that_is_killed_loses_at_most_one_rollout(tmp_path: Path, whole: Path) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        before = len(list((tmp_path / "rollouts").glob("0*")))
        reader, writer = os.pipe()
        if (child := os.fork()) == 0:
            try:
                tell = partial(os.write, writer)
                with learner().session(tmp_path, clock=FakeClock()) as robot:
                    drive(robot, 3, partial(tell, b"."), partial(tell, b"R"))
            finally:
                os._exit(0)
        os.close(writer)
        seen, most = b"", rng.integers(3, 20)
        while len(seen) < most and (new := os.read(reader, 1)):
            seen += new
        time.sleep(rng.uniform(0.0, 0.03))  # also into an update
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(reader)
        recorded = len(list((tmp_path / "rollouts").glob("0*")))
        assert recorded >= before + seen.count(b"R") - 1
    with learner().session(tmp_path, clock=FakeClock()) as robot:
        drive(robot, 3)
    assert files(tmp_path) == files(whole)


def test_only_the_learner_of_the_session_can_go_on(tmp_path: Path, whole: Path) -> None:
    task = learner().task
    for other, what in (
        (kreps.KREPS(task, seed=4, **TINY), "seed"),
        (kreps.KREPS(task, seed=3, **TINY, kl_bound=0.3), "settings"),
        (kreps.KREPS(kreps.TaskSpec(2, [-1.0], [1.0], dt=PERIOD), seed=3, **TINY), "task"),
    ):
        with pytest.raises(ConfigurationError, match=f"another {what} than"), other.session(whole):
            pass
    with (
        learner().session(whole),
        pytest.raises(kreps.StorageError, match="in use by"),
        learner().session(whole),
    ):
        pass
    ahead = learner()
    with ahead.session(whole):
        pass
    with learner().session(tmp_path):  # no update yet
        pass
    with pytest.raises(ConfigurationError, match="has made 3 updates"), ahead.session(tmp_path):
        pass


# ---- clock and watchdog -------------------------------------------------------------------------


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[tuple[RobotSession, FakeClock, Iterator[Any]]]:
    """A session in its first rollout, which has ten decisions at least."""
    clock = FakeClock()
    settings = TINY | {"restart_probability": 0.001}
    with kreps.KREPS(kreps.TaskSpec(2, [-1.0], [1.0]), **settings).session(
        tmp_path, period=PERIOD, stop_action=STOP, clock=clock
    ) as robot:
        turns = robot.rollouts(1, progress=False)
        assert next(turns).length >= 10
        yield robot, clock, turns


def cycles(robot: RobotSession, count: int) -> None:
    for number in range(count):
        assert robot.act([number, 0.0]) != STOP
        robot.reward(1.0)


def test_late_actions_are_counted_and_told(
    begun: tuple[RobotSession, FakeClock, Iterator[Any]],
) -> None:
    robot, clock, turns = begun
    for delay in (0.12, 0.01, 0.07, 0.08, 0.03, 0.05):  # the first is not timed
        cycles(robot, 1)
        clock.now += delay - PERIOD if delay == 0.12 else delay
        robot.wait()
    assert robot.missed_deadlines == 1
    assert clock.now == pytest.approx(0.07 + 0.05 + 0.07 + 0.08 + 0.05 + 0.05, abs=0.021)
    robot.abort()
    with pytest.warns(
        DataWarning, match=r"1 of 6 actions .* by 0\.0[3-5]\d* s; .*aborted.* 5 comp"
    ):
        next(turns)


def test_a_wrong_period_is_told(begun: tuple[RobotSession, FakeClock, Iterator[Any]]) -> None:
    robot, clock, turns = begun
    for _ in range(9):
        cycles(robot, 1)
        clock.now += 0.03  # without wait()
    robot.abort()
    with pytest.warns(DataWarning, match=r"took 0\.03 s on average, and the period .* 0\.05 s"):
        next(turns)


def test_an_observation_that_does_not_come_ends_the_rollout(
    begun: tuple[RobotSession, FakeClock, Iterator[Any]], tmp_path: Path
) -> None:
    robot, clock, turns = begun
    cycles(robot, 5)
    clock.now += 2.0 * PERIOD + 1e-9
    assert robot.act([5.0, 0.0]) == STOP and not robot.running
    robot.reward(1.0)  # of the stop action: ignored
    assert robot.act([6.0, 0.0]) == STOP
    with pytest.warns(DataWarning, match="watchdog"):
        next(turns)
    assert ends(tmp_path) == ["watchdog"]
    (rollout,) = kreps.load_rollouts(next((tmp_path / "rollouts").iterdir()))
    np.testing.assert_array_equal(rollout.observations[:, 0], np.arange(5.0))
    assert not rollout.terminated


def test_a_robot_that_never_answers_is_an_error(
    begun: tuple[RobotSession, FakeClock, Iterator[Any]],
) -> None:
    robot, _, turns = begun
    with pytest.warns(DataWarning, match="made again"):
        for _ in range(2):
            robot.act([0.0, 0.0])
            robot.abort()
            assert next(turns).number == 0
        robot.abort()
        with pytest.raises(EnvironmentFailure, match="3 times; check"):
            next(turns)


@pytest.mark.filterwarnings("ignore::kreps.errors.DataWarning")
def test_a_stuck_robot_is_stopped_within_two_periods(tmp_path: Path) -> None:
    code = "import time\nwhile True:\n    print(0.0, flush=True)\n    time.sleep(0.05)"
    stopped, when = threading.Event(), [0.0]

    def stop(action: Any) -> None:
        assert action == STOP
        when[0] = time.monotonic()
        stopped.set()

    ours = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]), **TINY | {"restart_probability": 0.001})
    with (
        ours.session(tmp_path, period=PERIOD, stop_action=STOP, stop=stop) as robot,
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process,
    ):
        assert process.stdout is not None
        next(robot.rollouts(1, progress=False))
        for _ in range(6):
            robot.act([float(process.stdout.readline())])
            robot.reward(0.0)
        last = time.monotonic()
        assert robot.running and not stopped.is_set()
        process.send_signal(signal.SIGSTOP)
        assert stopped.wait(5.0)
        process.kill()
        assert 1.9 * PERIOD < when[0] - last < 2.0 * PERIOD + 0.03
        assert not robot.running and robot.act([0.0]) == STOP


# ---- the order of calls, and what is refused ----------------------------------------------------


def test_calls_out_of_order_say_what_to_do(
    begun: tuple[RobotSession, FakeClock, Iterator[Any]],
) -> None:
    robot, _, turns = begun
    with pytest.raises(ConfigurationError, match="without an action before it"):
        robot.reward(1.0)
    robot.act([0.0, 0.0])
    with pytest.raises(ConfigurationError, match="before the reward of the last action"):
        robot.act([0.0, 0.0])
    for wrong in (np.nan, [1.0, 2.0], None):
        with pytest.raises(DataError):
            robot.reward(wrong)
    robot.reward(1.0)
    for wrong in ([np.nan, 0.0], [0.0]):
        with pytest.raises(DataError):
            robot.act(wrong)
    assert robot.running
    with pytest.raises(ConfigurationError, match="while one is running"):
        next(turns)


def test_leaving_the_block_in_a_rollout_stops_the_robot(tmp_path: Path) -> None:
    sent: list[float] = []
    ours = learner()
    session = ours.session(tmp_path, stop=lambda action: sent.append(float(action[0])))
    with pytest.raises(ConfigurationError, match="no rollout has begun"):
        session.act([0.0, 0.0])
    with pytest.raises(ConfigurationError, match="the session is not open"):
        next(session.rollouts(1, progress=False))
    with pytest.raises(ZeroDivisionError), session as robot:
        next(robot.rollouts(1))
        robot.act([0.0, 0.0])
        _ = 1 / 0
    assert sent == [0.0]
    # also before the first action, and after an abort
    with pytest.raises(ZeroDivisionError), session as robot:
        next(robot.rollouts(1))
        _ = 1 / 0
    with pytest.raises(ZeroDivisionError), session as robot:
        robot.abort()  # no rollout is running
        next(robot.rollouts(1))
        robot.act([0.0, 0.0])
        robot.abort()
        _ = 1 / 0
    assert sent == [0.0] * 3


def test_a_session_goes_on_with_the_history_that_its_updates_have_chosen(tmp_path: Path) -> None:
    def opened() -> Any:
        ours = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0], dt=0.1), history="auto")
        return ours, ours.session(tmp_path)

    ours, session = opened()
    ours.state = ours.state.with_history(1, 0)
    ours.task = ours.state.window.task
    ours.save(tmp_path / "checkpoint.safetensors")
    (tmp_path / "rollouts").mkdir()
    again, session = opened()
    with session:
        assert (again.task.delay, again.task.history) == (1, 0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({}, "one control period in s is needed"),
        ({"period": -1.0}, "must be a control period"),
        ({"period": 0.1, "stop_action": [2.0]}, "not within the limits"),
        ({"period": 0.1, "stop_action": [0.0, 0.0]}, "not within the limits"),
        ({"period": 0.1, "watchdog": 1.0}, "more than one period"),
    ],
)
def test_a_session_that_makes_no_sense_is_refused(arguments: dict[str, Any], says: str) -> None:
    ours = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]))
    with pytest.raises(ConfigurationError, match=says):
        ours.session(**arguments)
    timed = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0], dt=0.05))
    with pytest.raises(ConfigurationError, match=r"dt = 0\.05 of the task"):
        timed.session(period=0.1)


# ---- the example --------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::kreps.errors.DataWarning")
@pytest.mark.slow
def test_the_example_learns_from_a_robot_in_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    script = EXAMPLES / "real_robot.py"
    options = ["--folder", str(tmp_path), "--updates", "1", "--speed", "10"]
    monkeypatch.setattr(sys, "argv", [str(script), *options])
    names = runpy.run_path(str(script), run_name="__main__")
    state = names["learner"].state
    # as many as have the steps of ten mean rollouts, none of them longer than two
    assert state.iteration == 1 and 10 <= state.rollouts == len(ends(tmp_path)) <= 20
    points = state.window.rollouts.points
    hanging = np.abs(points[:, 0] - np.pi) + np.abs(points[:, 1])
    assert state.rollouts <= np.sum(hanging == 0.0) <= 2 * state.rollouts  # each starts so
    assert points[:, 2].std() > 10.0  # N m: torques were applied
