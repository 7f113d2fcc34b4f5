"""Low-rank updates: distance from the exact update, and cost: docs/results/low_rank.md.

python benchmarks/low_rank.py accuracy    # distance of one update from the exact one, by rank
python benchmarks/low_rank.py variance    # standard deviation of policies far from their data
python benchmarks/low_rank.py scale       # CPU time and memory for 10^4 to 10^6 samples
python benchmarks/low_rank.py growth      # CPU time by rank, and by the size of observations
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import kreps
from kreps.data.compute import CHUNK_SIZE
from kreps.data.task import TaskSpec
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.tables import markdown
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.kernel import Kernel, factors_of
from kreps.kernels.threads import blas_threads
from kreps.learning.collect import collect, simulate
from kreps.plotting import BLUE, GREY, ORANGE, STYLE
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.exploration import BangBang
from kreps.policies.sparse_gp import PolicySums, SparseGP
from kreps.presets import changed

TASK = "kreps/SwingUp-v0"
SEEDS = range(110, 115)  # seeds that no other result uses
RANKS = (25, 50, 100, 200, 400, 800)
SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000)


def write(out: Path, name: str, content: dict[str, Any], figure: Figure, table: str) -> None:
    """Write numbers, picture and table, with the command and the commit that made them."""
    command = f"python benchmarks/low_rank.py {name}"
    out.mkdir(parents=True, exist_ok=True)
    source = {"command": command, "commit": commit(), "code": script_fingerprint(Path(__file__))}
    text = json.dumps({**source, **content}, indent=2)
    (out / f"low-rank-{name}.json").write_text(text + "\n")
    (out / f"low-rank-{name}.md").write_text(table + "\n")
    figure.get_layout_engine().set(rect=(0.0, 0.04, 1.0, 0.96))  # room for the source
    figure.text(0.01, 0.01, f"{command}   (commit {commit()})", fontsize=6, color=GREY)
    figure.savefig(out / f"low-rank-{name}.png", dpi=130, metadata={"Software": None})


# ---- accuracy ---------------------------------------------------------------------------------


def errors(seed: int) -> dict[int, tuple[float, float, float]]:
    """Distances of the ninth update from the exact one, by rank: of weights, V and mean action."""
    # a single step, so that all ranks learn from the same samples
    learner = kreps.KREPS(gym.make(TASK), seed=seed, preset="single_step")
    learner.learn(8, progress=False)
    state, settings = learner.state, learner.settings
    assert learner.env is not None and state.policy is not None
    fresh = collect(
        learner.env,
        learner.task,
        state.policy,
        settings.rollouts_per_iteration,
        seed=seed,
        iteration=state.iteration,
        restart_probability=settings.restart_probability,
    )
    states = np.concatenate([rollout.observations for rollout in fresh])

    def updated(**changes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        learner.state, learner.settings = state, changed(settings, changes)
        info = learner.update(fresh)
        policy = learner.state.policy
        assert policy is not None
        value = learner.value_function(states)
        return info.dual.weights, value - value.mean(), policy.greedy(states)

    exact = updated(low_rank=None)
    distances: dict[int, tuple[float, float, float]] = {}
    for rank in RANKS:
        weights, value, actions = updated(
            **{"low_rank.above": 0, "low_rank.rank": rank, "value.max_rank": rank}
        )
        distances[rank] = (
            float(np.abs(weights - exact[0]).sum() / 2.0),
            float((value - exact[1]).std() / exact[1].std()),
            float(np.sqrt(np.mean((actions - exact[2]) ** 2)) / learner.task.action_scale[0]),
        )
    return distances


def accuracy(out: Path) -> None:
    with blas_threads(1):
        by_seed = [errors(seed) for seed in SEEDS]
    names = ("weights (total variation)", "V (share of its spread)", "mean action (of half range)")
    values = np.array([[seed[rank] for rank in RANKS] for seed in by_seed])  # (seeds, ranks, 3)
    medians = np.median(values, axis=0)
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.2), layout="constrained")
        axes = figure.subplots(1, 3, sharex=True)
        for i, (axis, name) in enumerate(zip(axes, names, strict=True)):
            axis.loglog(RANKS, np.maximum(values[:, :, i].T, 1e-6), color=BLUE, lw=0.6, alpha=0.4)
            axis.loglog(RANKS, np.maximum(medians[:, i], 1e-6), "o-", color=BLUE, ms=3)
            axis.set_title(name, fontsize=9)
            axis.set_xlabel("rank of all bases")
            axis.set_xticks(RANKS, [str(rank) for rank in RANKS])
            axis.minorticks_off()
        axes[0].set_ylabel("distance from the exact update")
    rows = [
        [str(rank), *(f"{median:.1e}" for median in of_rank)]
        for rank, of_rank in zip(RANKS, medians, strict=True)
    ]
    content = {"seeds": list(SEEDS), "errors": by_seed}
    write(out, "accuracy", content, figure, markdown(["rank", *names], rows))


# ---- variance ---------------------------------------------------------------------------------


def variance(out: Path) -> None:
    """Standard deviations over states, with samples only at negative ones."""
    rng = np.random.default_rng(0)
    task = TaskSpec(1, np.array([-1.0]), np.array([1.0]))
    kernel = Kernel(factors_of(1), np.array([0.3]))
    states = rng.uniform(-2.0, 0.0, (400, 1))
    targets = np.sin(4.0 * states) + 0.3 * rng.standard_normal((400, 1))
    weights, signal, noise = np.ones(400), 1.0, 0.1
    exact = CostSensitiveGP(task, kernel, states, targets, weights, signal, noise)
    x = np.linspace(-2.5, 2.5, 501)[:, None]

    def regressors(basis: RKHSBasis) -> np.ndarray:
        """Subset of regressors: only the part of the variance that the features can express."""
        sums = PolicySums.from_samples(basis.features(states), weights, targets)
        z = basis.features(x)
        p = np.eye(z.shape[1]) + signal / noise * sums.precision
        explained = signal * np.einsum("ij,ij->i", z, np.linalg.solve(p, z.T).T)
        return np.sqrt(explained + noise)[:, None]

    pivoted, features = RKHSBasis.fit(kernel, states, tolerance=1e-6, max_rank=20)
    ours = SparseGP.fit(
        task, pivoted, PolicySums.from_samples(features, weights, targets), signal, noise
    )
    curves: dict[str, tuple[np.ndarray, str, str]] = {
        "exact": (exact.standard_deviation(x), GREY, "-"),
        "20 centres, projected process (kreps)": (ours.standard_deviation(x), BLUE, "--"),
        "20 centres, subset of regressors": (regressors(pivoted), ORANGE, "-"),
    }
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        axis = figure.subplots()
        for name, (values, colour, line) in curves.items():
            axis.plot(x[:, 0], values[:, 0], line, color=colour, label=name)
        axis.axhline(np.sqrt(signal + noise), color=GREY, lw=0.6, ls=":")
        axis.axvspan(-2.0, 0.0, color=GREY, alpha=0.1, lw=0)
        axis.set_xlabel("state (samples only in the grey part)")
        axis.set_ylabel("standard deviation of the action")
        axis.set_ylim(0.0, 1.2)
        axis.legend(frameon=False, fontsize=8, loc="lower right")
    far = {name: float(values[-1, 0]) for name, (values, _, _) in curves.items()}
    rows = [[name, f"{value:.3f}"] for name, value in far.items()]
    content = {"prior": float(np.sqrt(signal + noise)), "far_from_all_samples": far}
    write(out, "variance", content, figure, markdown(["policy", "deviation at state 2.5"], rows))


# ---- scale ------------------------------------------------------------------------------------


def make_data(folder: Path, n: int, steps: int = 50) -> None:
    """Arrays of n steps of the first policy, rollout after rollout."""
    env = gym.make(TASK)
    task = kreps.KREPS(env).task
    policy, count, block = BangBang(task), n // steps, 2000
    parts = []
    for first in range(0, count, block):
        seeds = range(first, min(first + block, count))
        noise = [np.random.default_rng([1, j]).standard_normal((steps, 1)) for j in seeds]
        parts += simulate(env, task, policy, seeds, noise)
    np.save(folder / "observations.npy", np.concatenate([r.observations for r in parts]))
    np.save(folder / "actions.npy", np.concatenate([r.actions for r in parts]))
    np.save(folder / "rewards.npy", np.concatenate([r.rewards for r in parts]))


def peak_memory() -> float:
    """Peak memory of this process in GB."""
    try:  # ru_maxrss includes the parent process
        status = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in status if line.startswith("VmHWM")).split()[1]) / 1e6
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def one_size(folder: Path, n: int, options: dict[str, Any], steps: int = 50) -> dict[str, Any]:
    """CPU seconds by stage and peak memory of one update; run it in a process of its own."""
    count = n // steps
    maps = [
        np.load(folder / f"{name}.npy", mmap_mode="r")
        for name in ("observations", "actions", "rewards")
    ]
    data = kreps.Dataset.from_arrays(
        maps[0][: n + count], maps[1][:n], maps[2][:n], [steps] * count
    )
    learner = kreps.KREPS(gym.make(TASK), seed=0, **options)
    started = time.process_time()
    info = learner.update(data)
    seconds = time.process_time() - started
    return {
        "samples": n,
        "cpu_seconds": seconds,
        "stages": info.seconds,
        "newton_iterations": info.dual.iterations,
        "outcome": info.dual.outcome.name,
        "rank_of_v": info.rank,
        "support": info.support,
        "peak_memory_gb": peak_memory(),
    }


VARIANTS: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "defaults (rank 1000, V up to 400)": ({}, SIZES),
}


def scale(out: Path, largest: int) -> None:
    sizes = [n for n in SIZES if n <= largest]
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in VARIANTS}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_data(folder, sizes[-1])
        work = [
            (n, variant, options)
            for variant, (options, wanted) in VARIANTS.items()
            for n in sizes
            if n in wanted
        ]
        work.sort(key=lambda each: (-each[0], -len(each[2])))  # longest first
        with ProcessPoolExecutor(
            2, mp_context=get_context("spawn"), max_tasks_per_child=1
        ) as fresh:
            running = [
                (variant, fresh.submit(one_size, folder, n, options))
                for n, variant, options in work
            ]
            for variant, row in running:
                found[variant].insert(0, row.result())
                print(variant, row.result(), flush=True)
    slopes = {}
    with rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        for (variant, rows), colour in zip(found.items(), (BLUE,), strict=True):
            x = [row["samples"] for row in rows]
            y = [row["cpu_seconds"] for row in rows]
            large = [i for i, n in enumerate(x) if n >= 30_000]
            slope = np.polyfit(np.log([x[i] for i in large]), np.log([y[i] for i in large]), 1)[0]
            slopes[variant] = float(slope)
            left.loglog(x, y, "o-", color=colour, ms=3, label=f"{variant}: slope {slope:.2f}")
            right.semilogx(x, [r["peak_memory_gb"] for r in rows], "o-", color=colour, ms=3)
        left.set_ylabel("CPU seconds of one update, one core")
        right.set_ylabel("peak memory of the process [GB]")
        right.set_ylim(0.0)
        left.legend(frameon=False, fontsize=8)
        for axis in (left, right):
            axis.set_xlabel("samples")
    table = markdown(
        ["variant", "samples", "CPU s", "of these the dual", "Newton iterations", "peak GB"],
        [
            [
                variant,
                f"{row['samples']:,}",
                f"{row['cpu_seconds']:.1f}",
                f"{row['stages']['dual']:.1f}",
                str(row["newton_iterations"]),
                f"{row['peak_memory_gb']:.2f}",
            ]
            for variant, rows in found.items()
            for row in rows
        ],
    )
    content = {"chunk": CHUNK_SIZE, "slopes_from_30000": slopes, "rows": found}
    write(out, "scale", content, figure, table)


# ---- growth -----------------------------------------------------------------------------------

DIMENSIONS = (2, 8, 32, 128, 512)
BASES = (100, 200, 400, 800, 1600)


def walks(dimension: int, n: int = 20_000, steps: int = 50) -> list[kreps.Rollout]:
    """Random walks pushed by one action, with rewards for staying near zero."""
    rng = np.random.default_rng(dimension)
    rollouts = []
    for _ in range(n // steps):
        actions = rng.uniform(-1.0, 1.0, (steps, 1))
        moves = 0.3 * rng.standard_normal((steps + 1, dimension))
        moves[1:, :1] += actions
        states = np.cumsum(moves, axis=0) / np.sqrt(dimension)
        rewards = -np.sum(states[:-1] ** 2, axis=1)
        rollouts.append(kreps.Rollout(states, actions, rewards))
    return rollouts


def seconds_of_update(dimension: int, rank: int) -> dict[str, Any]:
    """CPU seconds of one update of 20,000 samples with observations of this dimension."""
    task = kreps.TaskSpec(dimension, [-1.0], [1.0], groups=(tuple(range(dimension)),))
    learner = kreps.KREPS(
        task,
        preset="single_step",
        window=None,
        low_rank=kreps.LowRank(rank=rank, above=0),
        value=kreps.RKHS(max_rank=rank, tolerance=1e-12),
    )
    rollouts = walks(dimension)
    started = time.process_time()
    info = learner.update(rollouts)
    seconds = time.process_time() - started
    return {
        "dimension": dimension,
        "rank": rank,
        "cpu_seconds": seconds,
        "rank_of_v": info.rank,
        "support": info.support,
        "newton_iterations": info.dual.iterations,
        "stages": info.seconds,
    }


def growth(out: Path) -> None:
    # In many coordinates a basis is not complete before it has the wanted rank.
    by_rank = [seconds_of_update(32, rank) for rank in BASES]
    by_dimension = [seconds_of_update(dimension, 200) for dimension in DIMENSIONS]
    with rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        panels = zip(
            figure.subplots(1, 2), ("rank", "dimension"), (by_rank, by_dimension), strict=True
        )
        for axis, name, rows in panels:
            x = [row[name] for row in rows]
            whole = [row["cpu_seconds"] for row in rows]
            fits = [row["stages"]["embedding fit"] + row["stages"]["policy fit"] for row in rows]
            axis.loglog(x, whole, "o-", color=BLUE, ms=3, label="whole update")
            axis.loglog(x, fits, "o--", color=GREY, ms=3, label="hyper-parameters")
            axis.set_xticks(x, [str(value) for value in x])
            axis.minorticks_off()
        left, right = figure.axes
        left.set_xlabel("rank of every basis (32 coordinates)")
        right.set_xlabel("coordinates of an observation (rank 200)")
        left.set_ylabel("CPU seconds, n = 20,000")
        left.legend(frameon=False)
    table = markdown(
        ["coordinates", "rank", "CPU s", "Newton iterations"],
        [
            [
                str(row["dimension"]),
                str(row["rank"]),
                f"{row['cpu_seconds']:.1f}",
                str(row["newton_iterations"]),
            ]
            for row in (*by_rank, *by_dimension)
        ],
    )
    write(out, "growth", {"by_rank": by_rank, "by_dimension": by_dimension}, figure, table)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["accuracy", "variance", "scale", "growth"])
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument(
        "--largest", type=int, default=SIZES[-1], help="largest number of samples of scale"
    )
    options = parser.parse_args()
    work: dict[str, Callable[[], None]] = {
        "accuracy": lambda: accuracy(options.out),
        "variance": lambda: variance(options.out),
        "scale": lambda: scale(options.out, options.largest),
        "growth": lambda: growth(options.out),
    }
    work[options.what]()


if __name__ == "__main__":
    sys.exit(main())
