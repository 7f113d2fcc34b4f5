"""What a batch of rollouts will be: who acts, in how many rollouts, and of which lengths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kreps.envs.restart import restart_length, stratified_lengths
from kreps.kernels.arrays import FloatArray
from kreps.learning.batches import BatchPlan, Part
from kreps.seeding import Purpose, generator, integer_seed
from kreps.settings import Settings


class Policy:
    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        raise AssertionError("a plan makes no rollout")


ACTING, EXPLORER = Policy(), Policy()


def plan(size: float, *policies: Policy, **settings: Any) -> BatchPlan:
    """A batch of the fifth iteration, which grows; a mean rollout has 50 steps."""
    chosen = Settings(**{"restart_probability": 0.02, "growth": 0.25, **settings})
    return BatchPlan(policies or (ACTING,), 0.0, size, chosen, 3, 5)


def carried_out(batch: BatchPlan, steps: int) -> tuple[list[Part], int]:
    """The parts if every rollout has so many steps, and the number of acting rollouts."""
    parts, found = batch.parts(), []
    part = next(parts)
    while True:
        found.append(part)
        try:
            part = parts.send(steps * part.count)
        except StopIteration as done:
            return found, done.value


@pytest.mark.parametrize(
    ("size", "steps", "counts"),
    [
        (4.0, 50, [4]),  # of the mean length
        (4.0, 100, [4]),
        (4.0, 22, [4, 2, 1, 1]),  # 176 steps: less than half a mean rollout is missing
        (4.0, 29, [4, 2, 1]),  # 174 after six: more than half of one
        (2.6, 40, [3]),
        (3.0, 1, [*[3] * 9, 2, 1]),  # ten rollouts per mean rollout, however short
        (0.3, 50, [1]),
    ],
)
def test_a_growing_batch_has_the_steps_of_its_size(
    size: float, steps: int, counts: list[int]
) -> None:
    parts, acting = carried_out(plan(size), steps)
    assert [part.count for part in parts] == counts
    assert [part.first for part in parts] == np.cumsum([0, *counts[:-1]]).tolist()
    assert acting == sum(counts)


def test_each_policy_makes_an_equal_part_of_the_batch() -> None:
    growing, acting = carried_out(plan(4.0, ACTING, EXPLORER), 20)
    parts = [(part.policy, part.first, part.count) for part in growing]
    of_acting = [(ACTING, 0, 2), (ACTING, 2, 1), (ACTING, 3, 1)]
    of_explorer = [(EXPLORER, 4 + first, count) for _, first, count in of_acting]
    assert parts == of_acting + of_explorer and acting == 4
    fixed, acting = carried_out(plan(5, ACTING, EXPLORER, growth=0.0), 1)
    assert fixed == [Part(ACTING, 0, 3), Part(EXPLORER, 3, 2)] and acting == 3


def test_lengths_are_random_and_limited() -> None:
    count, first = 200, 7

    def lengths(batch: BatchPlan, decisions: int | None) -> list[int]:
        planned = batch.rollouts(Part(ACTING, first, count), decisions)
        assert [each.number for each in planned] == list(range(first, first + count))
        return [each.length for each in planned]

    drawn = stratified_lengths(generator(3, Purpose.RESTART, 5, first), 0.02, count)
    seeds = [integer_seed(3, Purpose.ENVIRONMENT, 5, first + i) for i in range(count)]
    alone = [restart_length(generator(seed, Purpose.RESTART), 0.02) for seed in seeds]
    assert max(drawn) > 100 and max(alone) > 100
    # no rollout of a growing batch is longer than two mean ones
    assert lengths(plan(4.0), None) == [min(length, 100) for length in drawn]
    assert lengths(plan(4.0), 30) == [min(length, 30) for length in drawn]
    assert lengths(plan(4.0), 500) == [min(length, 100) for length in drawn]
    independent = plan(4.0, rollout_lengths="independent", growth=0.0)
    assert lengths(independent, None) == alone
    assert lengths(independent, 150) == [min(length, 150) for length in alone]
