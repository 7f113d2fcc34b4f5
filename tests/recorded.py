"""Recordings for tests: rollouts as rows of a table, with a last observation per episode."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import kreps
from kreps.data.rollouts import Rollout, Rollouts
from kreps.recordings.table import Table

DT = 0.05
NAMES = {
    "observations": ["angle", "velocity"],
    "actions": ["torque"],
    "reward": "gain",
    "episode": "trial",
    "terminated": "fell",
    "time": "t",
}
LENGTHS, ENDED = (6, 4, 9), (True, False, True)


def rollouts(lengths: tuple[int, ...] = LENGTHS, seed: int = 0) -> Rollouts:
    """Rollouts of random numbers with time stamps, some of which terminated."""
    rng, start, made = np.random.default_rng(seed), 0.0, []
    for i, steps in enumerate(lengths):
        made.append(
            Rollout(
                rng.normal(size=(steps + 1, 2)),
                rng.normal(size=(steps, 1)),
                rng.normal(size=steps),
                ENDED[i % len(ENDED)],
                start + DT * np.arange(steps + 1),
            )
        )
        start += DT * (steps + 1)
    return Rollouts.from_list(made)


def columns_of(made: Rollouts) -> dict[str, NDArray[Any]]:
    """The rows of rollouts: a last row of each has an observation and a time stamp only."""
    parts: list[dict[str, NDArray[Any]]] = []
    for number, rollout in enumerate(made):
        steps, nothing = len(rollout), [np.nan]
        assert rollout.times is not None
        flags = np.zeros(steps + 1, bool)
        flags[steps - 1] = rollout.terminated
        parts.append(
            {
                "trial": np.full(steps + 1, number),
                "t": rollout.times,
                "angle": rollout.observations[:, 0],
                "velocity": rollout.observations[:, 1],
                "torque": np.append(rollout.actions[:, 0], nothing),
                "gain": np.append(rollout.rewards, nothing),
                "fell": flags,
            }
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def table_of(columns: dict[str, Any]) -> Table:
    return Table.from_columns({n: np.asarray(v) for n, v in columns.items()}, "memory")


def assert_same(found: Rollouts, made: Rollouts, *, times: bool = True) -> None:
    assert isinstance(found, kreps.Rollouts)
    np.testing.assert_array_equal(found.points, made.points)
    np.testing.assert_array_equal(found.actions, made.actions)
    np.testing.assert_array_equal(found.rewards, made.rewards)
    np.testing.assert_array_equal(found.offsets, made.offsets)
    np.testing.assert_array_equal(found.terminated, made.terminated)
    if times:
        assert found.times is not None and made.times is not None
        np.testing.assert_allclose(found.times - found.times[0], made.times - made.times[0])
