"""The number of BLAS threads: one for the process, asked for by contexts of several threads."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import kreps
from kreps.errors import ConfigurationError
from kreps.kernels.threads import blas_threads

TINY: dict[str, Any] = {"initial_rollouts": 2, "restart_probability": 0.2, "preset": "single_step"}


def in_use() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    """Three BLAS threads outside, set by a plain call, as scripts do it."""
    before = threadpool_limits(3, user_api="blas")
    assert in_use() == {3}
    yield
    assert in_use() == {3}
    before.restore_original_limits()


class Held:
    """A context that another thread is in until it is told to leave."""

    def __init__(self, count: int, *, exact: bool = False) -> None:
        self.inside, self.leave = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self._hold, args=(count, exact))
        self.thread.start()
        assert self.inside.wait(10)

    def _hold(self, count: int, exact: bool) -> None:
        with blas_threads(count, exact=exact):
            self.inside.set()
            self.leave.wait(10)

    def end(self) -> None:
        self.leave.set()
        self.thread.join(10)


def test_contexts_of_one_thread_are_nested() -> None:
    with blas_threads(2):
        assert in_use() == {2}
        with blas_threads(1):
            assert in_use() == {1}
            with blas_threads(None), blas_threads(2):
                assert in_use() == {2}
            assert in_use() == {1}
        assert in_use() == {2}


def test_an_exception_ends_a_context() -> None:
    with pytest.raises(RuntimeError), blas_threads(1):
        raise RuntimeError
    assert in_use() == {3}


@pytest.mark.parametrize("first_in_is_first_out", [True, False])
def test_contexts_of_two_threads_may_end_in_any_order(first_in_is_first_out: bool) -> None:
    one, other = Held(1), Held(1)
    if not first_in_is_first_out:
        one, other = other, one
    one.end()
    assert in_use() == {1}
    other.end()
    assert in_use() == {3}


def test_the_smallest_number_of_all_threads_is_used() -> None:
    two = Held(2)
    with blas_threads(1):
        assert in_use() == {1}
        two.end()
        assert in_use() == {1}
    two = Held(2)
    with blas_threads(1):
        pass
    assert in_use() == {2}
    two.end()


class Waiting(gym.Wrapper[Any, Any, Any, Any]):
    """Holds the learner inside its rollouts, and records the BLAS threads of later steps."""

    def __init__(self) -> None:
        super().__init__(gym.make("Pendulum-v1"))
        self.inside, self.go = threading.Event(), threading.Event()
        self.seen: set[int] = set()

    def step(self, action: Any) -> Any:
        self.inside.set()
        assert self.go.wait(30)
        self.seen |= in_use()
        return super().step(action)


def learning(env: Waiting, threads: int = 1) -> threading.Thread:
    learner = kreps.KREPS(env, seed=0, threads=threads, **TINY)
    thread = threading.Thread(target=learner.learn, args=(1,), kwargs={"progress": False})
    thread.start()
    assert env.inside.wait(30)
    return thread


def test_the_end_of_one_learner_does_not_lift_the_limit_of_another() -> None:
    envs = Waiting(), Waiting()
    first, second = (learning(env) for env in envs)
    envs[0].go.set()
    first.join(60)
    assert in_use() == {1}
    envs[1].go.set()
    second.join(60)
    assert envs[1].seen == {1}
    assert in_use() == {3}


def test_learners_with_different_numbers_are_not_run_at_the_same_time() -> None:
    env = Waiting()
    thread = learning(env)
    other = kreps.KREPS(gym.make("Pendulum-v1"), seed=0, threads=2, **TINY)
    with pytest.raises(ConfigurationError, match=r"threads = 2, but .* has threads = 1"):
        other.learn(1, progress=False)
    assert other.state.iteration == 0
    env.go.set()
    thread.join(60)
    assert other.learn(1, progress=False).state.iteration == 1


def test_what_is_loaded_meanwhile_is_no_conflict() -> None:
    loading = Held(1)
    with blas_threads(2, exact=True):
        assert in_use() == {1}
        loading.end()
        assert in_use() == {2}
