"""Complete low-rank updates by `learner.update`.

``python benchmarks/low_rank.py scale`` measures up to a million samples, and memory;
``python benchmarks/smooth.py`` more data sets of the second kind.
"""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
from criteria import Seconds, TimesAsLong
from measuring import Measure
from smooth import CASES

from kreps import KREPS, Rollout
from kreps.learning.collect import simulate
from kreps.policies.exploration import BangBang

STEPS = 50  # of a rollout
SEED = 100


@cache
def rollouts(n: int) -> list[Rollout]:
    """n steps of the swing-up with bang-bang actions."""
    learner = KREPS(gym.make("kreps/SwingUp-v0"), preset="single_step", seed=SEED)
    assert learner.env is not None
    count = n // STEPS
    noises = [np.random.default_rng([SEED, j]).standard_normal((STEPS, 1)) for j in range(count)]
    policy = BangBang(learner.task)
    return simulate(learner.env, learner.task, policy, range(count), noises)


def bench_update_from_many(measure: Measure) -> None:
    """Ten times the samples may take at most twelve times as long."""

    def update(n: int) -> None:
        KREPS(gym.make("kreps/SwingUp-v0"), preset="single_step", seed=SEED, window=None).update(
            rollouts(n)
        )

    large, small = 100_000, 10_000
    measure(
        "whole update, low rank",
        f"n = {large:,}",
        lambda: update(large),
        Seconds(at_most=60.0),
        TimesAsLong(f"n = {small:,}", lambda: update(small), at_most=12.0),
        rounds=1,
    )


def bench_update_from_nearly_deterministic_samples(measure: Measure) -> None:
    """The dual needs some hundred passes over the samples and over parts of them."""
    n, case = 100_000, CASES["one mass at rest for long"]
    given = case.rollouts(n)
    measure(
        "whole update, low rank, nearly deterministic",
        f"n = {n:,}",
        lambda: KREPS(case.task, seed=SEED, window=None).update(given),
        Seconds(at_most=60.0),
        rounds=1,
    )
