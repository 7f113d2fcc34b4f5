"""Whole updates from many samples, through the same `learner.update`.

A million takes many minutes: ``make bench LARGEST=1000000``.  Sizes that no update can serve are
skipped.  Memory is what the update allocates beside the roll-outs that it is given.
"""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from criteria import Criterion, Gigabytes, Seconds, TimesAsLong
from measuring import Measure

from kreps import KREPS, ConfigurationError, Rollout
from kreps.policies import BangBang
from kreps.rollout import simulate

STEPS = 50  # of a roll-out
SEED = 100


@cache
def rollouts(n: int) -> list[Rollout]:
    """n steps of the swing-up by the first policy."""
    learner = KREPS(gym.make("kreps/SwingUp-v0"), seed=SEED)
    assert learner.env is not None
    count = n // STEPS
    noises = [np.random.default_rng([SEED, j]) for j in range(count)]
    policy = BangBang(learner.task)
    return simulate(learner.env, learner.task, policy, range(count), noises, [STEPS] * count)


@pytest.mark.parametrize(
    ("n", "seconds", "gigabytes"),
    [(10_000, None, None), (100_000, 60.0, None), (1_000_000, None, 4.0)],
)
def bench_update_from_many(
    measure: Measure,
    request: pytest.FixtureRequest,
    n: int,
    seconds: float | None,
    gigabytes: float | None,
) -> None:
    """Cost is to grow like n: ten times the samples take ten times as long, and a little more."""

    if n > request.config.getoption("largest"):
        pytest.skip(f"takes minutes: --largest={n}")

    def update(n: int) -> None:
        KREPS(gym.make("kreps/SwingUp-v0"), seed=SEED, window=n).update(rollouts(n))

    criteria: list[Criterion] = [Seconds(at_most=seconds), Gigabytes(at_most=gigabytes)]
    if n > 10_000:
        tenth = n // 10
        rollouts(tenth)
        criteria.append(TimesAsLong(f"n = {tenth:,}", lambda: update(tenth), at_most=12.0))
    rollouts(n)
    try:
        measure("whole update", f"n = {n:,}", lambda: update(n), *criteria, rounds=1)
    except ConfigurationError as error:
        pytest.skip(str(error))
