"""Updates from smooth, nearly deterministic samples.  Results: docs/results/low_rank.md.

python benchmarks/smooth.py    # each row in a process of its own; CPU seconds, memory, outcome

On such data the model has almost no error, so the ridge of the dual is at its smallest value, the
temperature falls to its floor, and Newton's method needs many passes over the samples.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from low_rank import peak_memory

import kreps
from kreps.experiments.tables import markdown
from kreps.kernels.arrays import FloatArray
from kreps.kernels.threads import blas_threads

SEED = 2


@dataclass(frozen=True)
class Masses:
    """Unit masses on a line each, which a proportional and derivative controller brings to zero.

    Attributes:
        masses: m; an observation has the m positions and then the m velocities.
        steps: of a rollout, 0.1 s each.
        gain: of the position; that of the velocity is 1.6 times its square root.
        noise: standard deviation of the exploration noise, in units of the largest force.
    """

    masses: int
    steps: int
    gain: float
    noise: float

    @property
    def task(self) -> kreps.TaskSpec:
        return kreps.TaskSpec(2 * self.masses, [-1.0] * self.masses, [1.0] * self.masses)

    def rollouts(self, n: int) -> list[kreps.Rollout]:
        """n samples, from starts that are uniform in [-1, 1]."""
        rng = np.random.default_rng(SEED)
        shape = n // self.steps, self.masses
        x, v = rng.uniform(-1.0, 1.0, shape), rng.uniform(-1.0, 1.0, shape)
        points, actions, rewards = [np.hstack([x, v])], [], []
        for _ in range(self.steps):
            wanted = -self.gain * x - 1.6 * np.sqrt(self.gain) * v
            a = np.clip(wanted + self.noise * rng.standard_normal(shape), -1.0, 1.0)
            cost = (x**2).sum(axis=1) + (v**2).sum(axis=1) + 0.1 * (a**2).sum(axis=1)
            v = v + 0.1 * a
            x = x + 0.1 * v
            points.append(np.hstack([x, v]))
            actions.append(a)
            rewards.append(-cost)
        return rollouts_of(points, actions, rewards)


@dataclass(frozen=True)
class Pendulum:
    """A pendulum with damping actions and a reward that is quadratic in angle and velocity."""

    steps: int = 50

    @property
    def task(self) -> kreps.TaskSpec:
        return kreps.TaskSpec(2, [-2.0], [2.0], periodic=(0,))

    def rollouts(self, n: int) -> list[kreps.Rollout]:
        """n samples, from angles that are uniform on the circle."""
        rng = np.random.default_rng(SEED)
        count = n // self.steps
        angle, speed = rng.uniform(-np.pi, np.pi, count), rng.uniform(-1.0, 1.0, count)
        points, actions, rewards = [np.stack([angle, speed], axis=1)], [], []
        for _ in range(self.steps):
            a = np.clip(-speed + 0.3 * rng.standard_normal(count), -2.0, 2.0)
            wrapped = (angle + np.pi) % (2.0 * np.pi) - np.pi
            rewards.append(-(wrapped**2) - 0.1 * speed**2 - 0.001 * a**2)
            speed = np.clip(speed + 0.05 * (15.0 * np.sin(angle) + 3.0 * a), -8.0, 8.0)
            angle = angle + 0.05 * speed
            points.append(np.stack([angle, speed], axis=1))
            actions.append(a[:, None])
        return rollouts_of(points, actions, rewards)


def rollouts_of(
    points: list[FloatArray], actions: list[FloatArray], rewards: list[FloatArray]
) -> list[kreps.Rollout]:
    """Rollouts of equal length, from a list of arrays over the rollouts for each step."""
    parts = [np.stack(part, axis=1) for part in (points, actions, rewards)]
    return [kreps.Rollout(*each) for each in zip(*parts, strict=True)]


CASES: dict[str, Masses | Pendulum] = {
    "one mass": Masses(1, steps=50, gain=0.5, noise=0.1),
    "two masses": Masses(2, steps=50, gain=0.5, noise=0.1),
    "one mass at rest for long": Masses(1, steps=200, gain=2.0, noise=0.02),
    "pendulum": Pendulum(),
}


def updated(name: str, n: int) -> list[str]:
    """A row of the table: one update of n samples with default settings."""
    case = CASES[name]
    learner = kreps.KREPS(case.task, seed=0)
    data = kreps.Dataset.from_rollouts(case.rollouts(n))
    with blas_threads(1):
        started = time.process_time()
        info = learner.update(data)
        seconds = time.process_time() - started
    dual = info.dual
    return [
        name,
        f"{n:,}",
        f"{seconds:.1f}",
        f"{info.seconds['dual']:.1f}",
        str(dual.iterations),
        str(info.rank),
        f"{dual.eta:.3g}",
        f"{dual.gap:.0e}",
        dual.outcome.name,
        f"{peak_memory():.2f}",
    ]


HEADER = "data,samples,CPU s,of it the dual,Newton iterations,rank of V,eta,gap,outcome,peak GB"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--only", choices=CASES, help="one of the data sets")
    options = parser.parse_args()
    names = [options.only] if options.only else list(CASES)
    rows = []
    for name in names:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            rows.append(process.submit(updated, name, options.samples).result())
    print(markdown(HEADER.split(","), rows))


if __name__ == "__main__":
    main()
