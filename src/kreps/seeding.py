"""The only place where randomness is derived.

A draw is addressed by ``(seed, purpose, *indices)``, never by the order in which code happens to
run.  So a resumed run needs no stored generator state: it derives the same generators again.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What a generator is for.  The numbers are part of the file format: never renumber."""

    ENVIRONMENT = 0
    POLICY = 1
    UPDATE = 2
    EVALUATION_ENVIRONMENT = 3
    EVALUATION_POLICY = 4
    PREDICT = 5
    RESTART = 6
    BOOTSTRAP = 7


def _sequence(seed: int, purpose: Purpose, indices: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(int(purpose), *indices))


def generator(seed: int, purpose: Purpose, *indices: int) -> np.random.Generator:
    """The generator of one purpose: ``generator(seed, Purpose.POLICY, iteration, rollout)``."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, purpose, indices)))


def integer_seed(seed: int, purpose: Purpose, *indices: int) -> int:
    """A 32-bit seed for an interface that takes one, such as ``gymnasium.Env.reset``."""
    return int(_sequence(seed, purpose, indices).generate_state(1)[0])
