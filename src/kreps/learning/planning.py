"""Rollouts before they are made: their random lengths, seeds and noise.

Random numbers of a rollout are addressed by its number and those of stratified lengths by the
iteration.  So a rollout can be planned again and is the same, whoever carries it out and whenever.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from kreps.data.task import TaskSpec
from kreps.envs.restart import restart_length, stratified_lengths
from kreps.kernels.arrays import FloatArray
from kreps.policies.exploration import WHITE, noise_rows
from kreps.seeding import Purpose, generator, integer_seed

MAX_BYTES = 2**30
"""Largest size of a batch of rollouts while it is collected."""

BYTES_PER_STEP = 400
"""Size of a step beside its numbers."""

MAX_EPISODE = 10_000
"""Largest number of steps of a rollout in a batch that would be larger, and in which therefore only
the environment can end a rollout."""


@dataclass(frozen=True)
class PlannedRollout:
    """A rollout before it is made.

    Attributes:
        iteration: updates before it.
        number: of the rollout in its iteration.
        length: number of decisions, unless the task ends the rollout before.
        exponent: of the spectrum of the policy's noise (`coloured_noise`).
        learner_seed: of the learner.
    """

    iteration: int
    number: int
    length: int
    exponent: float
    learner_seed: int

    @property
    def seed(self) -> int:
        """Seed of the environment: the start state and the noise of a simulator."""
        return integer_seed(self.learner_seed, Purpose.ENVIRONMENT, self.iteration, self.number)

    def noise(self, width: int) -> Iterator[FloatArray]:
        """The policy's noise: ``length`` rows (width,) of standard normal numbers."""
        rng = generator(self.learner_seed, Purpose.POLICY, self.iteration, self.number)
        return noise_rows(self.exponent, self.length, width, rng)


def planned_rollouts(
    count: int,
    *,
    seed: int,
    iteration: int,
    first: int = 0,
    restart_probability: float,
    stratified: bool = False,
    exponent: float = WHITE,
    decisions: int | None = None,
) -> list[PlannedRollout]:
    """Rollouts of random length.

    Args:
        count: number of rollouts.
        seed: of the learner.
        iteration: number of updates so far; with the seed it addresses all random numbers.
        first: number of the first of them in the iteration.
        restart_probability: p, which determines the distribution of lengths.
        stratified: whether lengths are stratified (`stratified_lengths`), so that each depends on
            ``count``.  If not, each is that of `RandomRestart` with the rollout's seed.
        exponent: of the spectrum of the policy's noise.
        decisions: largest number of decisions in an episode; None without a limit.
    """
    numbers = range(first, first + count)
    if stratified:
        rng = generator(seed, Purpose.RESTART, iteration, *([first] if first else ()))
        lengths = stratified_lengths(rng, restart_probability, count)
    else:
        seeds = (integer_seed(seed, Purpose.ENVIRONMENT, iteration, number) for number in numbers)
        rngs = (generator(each, Purpose.RESTART) for each in seeds)
        lengths = [restart_length(rng, restart_probability) for rng in rngs]
    limited = [length if decisions is None else min(length, decisions) for length in lengths]
    return [
        PlannedRollout(iteration, number, length, exponent, seed)
        for number, length in zip(numbers, limited, strict=True)
    ]


def longest_rollout(lengths: Sequence[int], task: TaskSpec) -> int:
    """Largest number of steps that a rollout may have, so that the batch fits in memory.

    Args:
        lengths: (R,) of the rollouts, unless the environment ends them before.
        task: how wide a step is.
    """
    numbers = task.observation_size + task.action_size + 1
    steps = MAX_BYTES // (8 * numbers + BYTES_PER_STEP)
    return max(lengths) if sum(lengths) <= steps else min(MAX_EPISODE, steps // len(lengths))
