"""The dual of Eq. 2 over chunks of samples, and its solution from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import TypeVar

import numpy as np

from kreps.algorithms.dual import DualProblem, DualSolution, Moments
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.streaming import BellmanRows
from kreps.data.compute import Compute
from kreps.data.dataset import Chunk, Dataset
from kreps.kernels.arrays import FloatArray, IntArray, as_numpy, like

Result = TypeVar("Result")

GROWTH = 4
"""Factor by which the number of chunks grows from one solve of the dual to the next.  A Newton
iteration on each of the smaller parts costs a third of one on all samples, taken together."""


@dataclass(frozen=True)
class ChunkMoments:
    """`Moments` of a chunk at one point of the dual.

    Attributes:
        rows: computes the rows of B.
        eta: temperature.
        theta: (r,) coordinates of V.
        with_covariance: whether the covariance is computed.
    """

    rows: BellmanRows
    eta: float
    theta: FloatArray
    with_covariance: bool

    def __call__(self, chunk: Chunk, rewards: FloatArray) -> Moments:
        b = self.rows(chunk.load().transitions)
        delta = like(rewards, b) + b @ like(self.theta, b)
        return Moments.from_rows(delta, b, self.eta, with_covariance=self.with_covariance)


@dataclass(frozen=True)
class ChunkErrors:
    """Bellman errors (Eq. 5) of a chunk, (n,)."""

    rows: BellmanRows
    theta: FloatArray

    def __call__(self, chunk: Chunk, rewards: FloatArray) -> FloatArray:
        b = self.rows(chunk.load().transitions)
        return rewards + as_numpy(b @ like(self.theta, b))


@dataclass(frozen=True)
class StreamedProblem:
    """A `kreps.algorithms.dual.Problem` whose rows of B are never in memory all at once.

    They are computed chunk by chunk in each pass over the samples.

    Attributes:
        dataset: n samples.
        rows: computes the rows of B.
        rewards: (n,) in units of their standard deviation; the largest one is zero.
        kl_bound, ridge, eta_floor: as of `kreps.algorithms.dual.DualProblem`.
        compute: the workers.
    """

    dataset: Dataset
    rows: BellmanRows
    rewards: FloatArray
    kl_bound: float
    ridge: float
    eta_floor: float
    compute: Compute

    @property
    def rank(self) -> int:
        return len(self.rows.restart)

    def part(self, chosen: slice) -> StreamedProblem:
        """The problem of a slice of the chunks, with the same ridge."""
        rewards = self.dataset.split(self.rewards)[chosen]
        return replace(
            self, dataset=Dataset(self.dataset.chunks[chosen]), rewards=np.concatenate(rewards)
        )

    def bellman_errors(self, theta: FloatArray) -> FloatArray:
        return np.concatenate(list(self._map(ChunkErrors(self.rows, theta))))

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        return reduce(add, self._map(ChunkMoments(self.rows, eta, theta, with_covariance)))

    def _map(self, function: Callable[[Chunk, FloatArray], Result]) -> Iterator[Result]:
        return self.compute.map(function, self.dataset.chunks, self.dataset.split(self.rewards))


def coarse_to_fine(
    problem: StreamedProblem,
    ridge: float,
    differences: FloatArray,
    in_memory: IntArray,
    subsample_size: int,
    start: tuple[float, FloatArray] | None = None,
) -> DualSolution:
    """The solution of the dual, with most Newton iterations on a part of the samples.

    The dual is solved on the samples in memory first, then on more and more chunks.  Each solve
    starts from the solution before it, so that few passes over all samples are needed.

    Args:
        problem: of all n samples.
        ridge: rho times the number of samples.
        differences: (m, r) rows of B of the samples in memory.
        in_memory: (m,) numbers of these samples.
        subsample_size: largest number of samples in memory.
        start: eta and theta to start from, if any.
    """
    n = len(problem.rewards)
    # each part has the ridge of the next larger one, for whose solution it is the start
    in_part = DualProblem(
        rewards=problem.rewards[in_memory],
        differences=differences,
        kl_bound=problem.kl_bound,
        ridge=ridge / min(GROWTH * len(in_memory), n),
        eta_floor=problem.eta_floor,
    )
    dual = solve_dual(in_part, start=start)
    if len(in_memory) == n:
        return dual
    for stride in strides(n, subsample_size):
        part = problem.part(slice(None, None, stride))
        part = replace(part, ridge=ridge / min(GROWTH * len(part.rewards), n))
        dual = solve_dual(part, start=(dual.eta, dual.theta))
    return dual


def strides(samples: int, subsample_size: int) -> list[int]:
    """Distances between the chunks of each part: descending powers of `GROWTH`, down to one.

    The smallest part has at least twice as many samples as are in memory.
    """
    found = [1]
    while samples >= 2 * GROWTH * found[0] * subsample_size:
        found.insert(0, GROWTH * found[0])
    return found
