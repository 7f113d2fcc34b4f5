"""The dual of Eq. 2 over chunks of samples, and its solution from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Generic, TypeVar

import numpy as np

from kreps.algorithms.dual import DualProblem, DualSolution, Moments
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.streaming import BellmanRows
from kreps.data.compute import Compute
from kreps.data.dataset import Chunk, Dataset
from kreps.kernels.arrays import Array, FloatArray, IntArray, as_numpy, like

Result = TypeVar("Result")

GROWTH = 4
"""Factor by which the number of chunks grows from one solve of the dual to the next.  A Newton
iteration on each of the smaller parts costs a third of one on all samples, taken together."""


MAX_KEPT_BYTES = 2**29
"""Rows of B up to this size (0.5 GB) are computed once per solve and kept: 160,000 samples at rank
400.  To make them anew takes six times as long as the Hessian that a pass computes from them, and
eighty times as long as the gradient."""


@dataclass(frozen=True)
class MomentsOfRows:
    """`Moments` of a chunk at one point of the dual.

    Attributes:
        eta: temperature.
        theta: (r,) coordinates of V.
        with_covariance: whether the covariance is computed.
    """

    eta: float
    theta: FloatArray
    with_covariance: bool

    def __call__(self, b: Array, rewards: FloatArray) -> Moments:
        """Of rows b (n, r) of B and rewards (n,)."""
        delta = like(rewards, b) + b @ like(self.theta, b)
        return Moments.from_rows(delta, b, self.eta, with_covariance=self.with_covariance)


@dataclass(frozen=True)
class ErrorsOfRows:
    """Bellman errors (Eq. 5) of a chunk, (n,), at theta (r,)."""

    theta: FloatArray

    def __call__(self, b: Array, rewards: FloatArray) -> FloatArray:
        """Of rows b (n, r) of B and rewards (n,)."""
        return rewards + as_numpy(b @ like(self.theta, b))


@dataclass(frozen=True)
class ChunkRows:
    """Rows of B of a chunk, (n, r)."""

    rows: BellmanRows

    def __call__(self, chunk: Chunk) -> Array:
        return self.rows(chunk.load().transitions)


@dataclass(frozen=True)
class OfChunk(Generic[Result]):
    """A function of the rows of B and the rewards, as a function of the chunk and the rewards."""

    function: Callable[[Array, FloatArray], Result]
    rows: ChunkRows

    def __call__(self, chunk: Chunk, rewards: FloatArray) -> Result:
        return self.function(self.rows(chunk), rewards)


@dataclass(frozen=True)
class StreamedProblem:
    """A `kreps.algorithms.dual.Problem` whose rows of B are computed chunk by chunk.

    They are made anew in each pass over the samples, unless they are kept (`keeping_rows`).

    Attributes:
        dataset: n samples.
        rows: computes the rows of B.
        rewards: (n,) in units of their standard deviation; the largest one is zero.
        kl_bound, ridge, eta_floor: as of `kreps.algorithms.dual.DualProblem`.
        compute: the workers.
        kept: rows of B of each chunk, (n_j, r); None if each pass makes them anew.
    """

    dataset: Dataset
    rows: BellmanRows
    rewards: FloatArray
    kl_bound: float
    ridge: float
    eta_floor: float
    compute: Compute
    kept: tuple[Array, ...] | None = None

    @property
    def rank(self) -> int:
        return len(self.rows.restart)

    def part(self, chosen: slice) -> StreamedProblem:
        """The problem of a slice of the chunks, with the same ridge."""
        return replace(
            self,
            dataset=Dataset(self.dataset.chunks[chosen]),
            rewards=np.concatenate(self.dataset.split(self.rewards)[chosen]),
            kept=None if self.kept is None else self.kept[chosen],
        )

    def keeping_rows(self, limit: int = MAX_KEPT_BYTES) -> StreamedProblem:
        """The same problem, with its rows in memory if they take at most ``limit`` bytes.

        Results have the same bytes.  The rows are not kept either if the workers are in other
        processes, to which they would have to be sent in each pass.
        """
        size = len(self.rewards) * self.rank * np.dtype(np.float64).itemsize
        if self.kept is not None or size > limit or not self.compute.shares_memory:
            return self
        rows = self.compute.map(ChunkRows(self.rows), self.dataset.chunks)
        return replace(self, kept=tuple(rows))

    def releasing_rows(self) -> StreamedProblem:
        """The same problem, whose rows are made anew in each pass."""
        return replace(self, kept=None)

    def bellman_errors(self, theta: FloatArray) -> FloatArray:
        return np.concatenate(list(self._map(ErrorsOfRows(theta))))

    def moments(self, eta: float, theta: FloatArray, *, with_covariance: bool) -> Moments:
        return reduce(add, self._map(MomentsOfRows(eta, theta, with_covariance)))

    def _map(self, function: Callable[[Array, FloatArray], Result]) -> Iterator[Result]:
        rewards = self.dataset.split(self.rewards)
        if self.kept is not None:
            return self.compute.map(function, self.kept, rewards)
        of_chunk = OfChunk(function, ChunkRows(self.rows))
        return self.compute.map(of_chunk, self.dataset.chunks, rewards)


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
        dual = solve_dual(part.keeping_rows(), start=(dual.eta, dual.theta))
    return dual


def strides(samples: int, subsample_size: int) -> list[int]:
    """Distances between the chunks of each part: descending powers of `GROWTH`, down to one.

    The smallest part has at least twice as many samples as are in memory.
    """
    found = [1]
    while samples >= 2 * GROWTH * found[0] * subsample_size:
        found.insert(0, GROWTH * found[0])
    return found
