"""Executors: order and number of chunks, errors, and the same policy from every executor."""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import kreps
from kreps.data.compute import Compute
from kreps.data.dataset import Dataset
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.errors import DataError
from kreps.learning.collect import collect
from kreps.policies.exploration import BangBang

TASK = TaskSpec(2, [-30.0], [30.0], (0,))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(40) as pool:
        yield pool


class Recorder(Executor):
    """Computes each submitted call at once, and counts them."""

    def __init__(self) -> None:
        self.submitted = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.submitted += 1
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


# ---- order, bounds, errors --------------------------------------------------------------------


def test_results_are_in_the_order_of_the_arguments(threads: Executor) -> None:
    finished: list[int] = []

    def slow_at_first(i: int, name: str) -> tuple[int, str]:
        time.sleep(0.03 if i % 8 == 0 else 0.0)
        finished.append(i)
        return i, name

    names = [str(i) for i in range(40)]
    found = list(Compute(threads).map(slow_at_first, range(40), names))
    assert found == list(zip(range(40), names, strict=True))
    assert sorted(finished) == list(range(40)) != finished


@pytest.mark.parametrize("executor", [None, Recorder()], ids=["here", "executor"])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 48])
def test_every_argument_has_its_result(executor: Executor | None, count: int) -> None:
    assert list(Compute(executor).map(str, range(count))) == [str(i) for i in range(count)]


def test_at_most_sixteen_chunks_are_pending() -> None:
    recorder, asked = Recorder(), []

    def arguments() -> Iterator[int]:
        for i in range(80):
            asked.append(i)
            yield i

    results = Compute(recorder).map(abs, arguments())
    for taken in range(80):
        assert recorder.submitted == min(taken + 15 if taken else 0, 80)
        assert len(asked) == recorder.submitted  # arguments are taken as late as possible
        next(results)


def test_at_most_sixteen_workers_are_busy(threads: Executor) -> None:
    lock, busy, largest = threading.Lock(), 0, 0

    def work(_: int) -> None:
        nonlocal busy, largest
        with lock:
            busy += 1
            largest = max(largest, busy)
        time.sleep(0.002)
        with lock:
            busy -= 1

    list(Compute(threads).map(work, range(100)))
    assert 2 <= largest <= 16


@pytest.mark.parametrize("where", ["this process", "threads"])
def test_an_error_of_a_worker_is_raised(where: str, threads: Executor) -> None:
    def fails_at_seven(i: int) -> int:
        if i == 7:
            raise DataError("seven")
        return i

    results = Compute(threads if where == "threads" else None).map(fails_at_seven, range(30))
    found = []
    with pytest.raises(DataError, match="seven"):
        for each in results:
            found.append(each)
    assert found == list(range(7))


# ---- the same policy from all -----------------------------------------------------------------


@pytest.fixture(scope="module")
def rollouts() -> list[Rollout]:
    env, policy = gym.make("kreps/SwingUp-v0"), BangBang(TASK)
    return list(collect(env, TASK, policy, 6, seed=1, iteration=0, restart_probability=0.02))


@pytest.fixture
def folder(rollouts: list[Rollout], tmp_path: Path) -> Path:
    for i in range(3):
        kreps.save_rollouts(rollouts[2 * i : 2 * i + 2], tmp_path / f"{i}.safetensors")
    return tmp_path


CHUNK_SIZE = 100
"""So short that every sum is taken over several chunks."""


def allow_two_blas_threads() -> None:
    threadpool_limits(2, user_api="blas")


def blas_threads_used(*_: int) -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    """Two workers with two BLAS threads each, unless limited."""
    with ProcessPoolExecutor(
        2, mp_context=get_context("spawn"), initializer=allow_two_blas_threads
    ) as pool:
        yield pool


def test_a_worker_process_uses_one_blas_thread(processes: Executor) -> None:
    assert list(Compute(processes).map(blas_threads_used, range(4))) == [{1}] * 4
    assert processes.submit(blas_threads_used).result() == {2}


def learnt(given: Dataset | list[Rollout], executor: Executor | None, path: Path) -> bytes:
    """A checkpoint after one update, in which the dual is solved in chunks."""
    learner = kreps.KREPS(
        TASK,
        value=kreps.RKHS(max_rank=60),
        low_rank=kreps.LowRank(rank=60, above=0, subsample=200),
        compute=Compute(executor, chunk_size=CHUNK_SIZE),
        **{"model_based.improvement_steps": 1},
    )
    learner.update(given)
    learner.save(path)
    return path.read_bytes()


@pytest.mark.parametrize("form", ["list", "set", "arrays", "folder"])
def test_processes_learn_the_same_policy_byte_for_byte(
    form: str, rollouts: list[Rollout], folder: Path, processes: Executor
) -> None:
    given: Dataset | list[Rollout] = {
        "list": lambda: rollouts,
        "set": lambda: Dataset.from_rollouts(rollouts, chunk_size=CHUNK_SIZE),
        "arrays": lambda: Dataset.from_arrays(
            np.concatenate([r.observations for r in rollouts]),
            np.concatenate([r.actions for r in rollouts]),
            np.concatenate([r.rewards for r in rollouts]),
            [len(r) for r in rollouts],
            chunk_size=CHUNK_SIZE,
        ),
        "folder": lambda: kreps.rollout_folder(folder),
    }[form]()
    here = learnt(given, None, folder / "here.ckpt")
    assert learnt(given, processes, folder / "there.ckpt") == here


@pytest.mark.slow
def test_a_dask_cluster_learns_the_same_policy(folder: Path) -> None:
    distributed = pytest.importorskip("distributed")
    files = kreps.rollout_folder(folder)
    here = learnt(files, None, folder / "here.ckpt")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        there = learnt(files, client.get_executor(), folder / "there.ckpt")
    assert there == here


def test_a_chunk_that_cannot_be_read_is_an_error_of_the_update(
    folder: Path, processes: Executor
) -> None:
    files = kreps.rollout_folder(folder)
    learner = kreps.KREPS(TASK, compute=Compute(processes))
    (folder / "1.safetensors").unlink()
    with pytest.raises(kreps.StorageError, match=r"1\.safetensors"):
        learner.update(files)
    assert learner.state.iteration == 0


def test_a_pickled_chunk_does_not_contain_its_file(folder: Path) -> None:
    chunk = kreps.rollout_folder(folder).chunks[0]
    assert len(pickle.dumps(chunk)) < 1000
