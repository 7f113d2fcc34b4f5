"""Random generators, all derived here from the seed.

A generator is addressed by ``(seed, purpose, *indices)`` and does not depend on the order of calls.
So a checkpoint needs no generator state: a resumed run derives the same generators again.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What a generator is used for.

    A resumed run needs the same numbers, so they must never change.
    """

    ENVIRONMENT = 0
    POLICY = 1
    UPDATE = 2
    EVALUATION_ENVIRONMENT = 3
    EVALUATION_POLICY = 4
    PREDICT = 5
    RESTART = 6
    BOOTSTRAP = 7
    PREDICTION = 8
    EXTRAPOLATION = 9
    TUNING = 10


def _sequence(seed: int, purpose: Purpose, indices: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(int(purpose), *indices))


def generator(seed: int, purpose: Purpose, *indices: int) -> np.random.Generator:
    """The generator of an address: ``generator(seed, Purpose.POLICY, iteration, rollout)``."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, purpose, indices)))


def integer_seed(seed: int, purpose: Purpose, *indices: int) -> int:
    """The 32-bit seed of an address, for interfaces such as ``gymnasium.Env.reset``."""
    return int(_sequence(seed, purpose, indices).generate_state(1)[0])
