"""Latency of `Policy.predict`, growth of its memory, and reward lost by compression.

    python benchmarks/predict.py

Times single calls, as in a control loop, on one BLAS thread with garbage collection enabled.  Times
are by the clock and of the processor; other processes on the machine affect the former only.  The
policies are of the swing-up and have 1500 support points:

- learnt: a learnt policy with its 1500 support points of largest weight;
- rough: the same with lengthscales so short that every support point is needed;
- compressed: the learnt one, compressed to 50 centres.

Then policies of three seeds are compressed to several numbers of centres and evaluated.  Writes
``results/predict.json``, ``predict.md`` and ``predict.png``.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import kreps
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.tables import markdown
from kreps.kernels.arrays import FloatArray
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import task_of
from kreps.learning.evaluate import evaluate, stochastic_and_greedy
from kreps.learning.policy import mean_difference
from kreps.plotting import COLOURS, GREY, STYLE, save
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.versions import versions

SUPPORT = 1500
CENTRES = (10, 20, 30, 50, 100, 200)
SEEDS = (100, 101, 102)
RESTART = 0.02
MODES = ("greedy", "stochastic")
GOALS = {"greedy": 0.1, "with noise": 1.0}
"""Limits of the 99th percentile in ms."""


def learner_of(seed: int) -> kreps.KREPS:
    return kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=seed)


def top_by_weight(policy: CostSensitiveGP, count: int) -> CostSensitiveGP:
    """The policy restricted to its ``count`` samples of largest weight."""
    rows = np.sort(np.argsort(-policy.weights, kind="stable")[:count])
    return replace(
        policy,
        states=policy.states[rows],
        targets=policy.targets[rows],
        weights=policy.weights[rows],
    )


def policies_to_time() -> dict[str, kreps.Policy]:
    learner = learner_of(SEEDS[0])
    process = None
    while process is None or len(process.weights) < SUPPORT:
        if learner.state.iteration == 40:
            raise SystemExit(f"no policy of 40 updates has {SUPPORT} support points")
        process = learner.learn(1, progress=False).policy.process
        assert isinstance(process, CostSensitiveGP)
    learnt = rough = top_by_weight(process, SUPPORT)
    while len(rough.predictor.states) < SUPPORT:
        rough = replace(rough, kernel=rough.kernel.with_lengthscales(rough.kernel.lengthscales / 2))
    policies = {"learnt": kreps.Policy(learnt), "rough": kreps.Policy(rough)}
    return {**policies, "compressed": policies["learnt"].compressed(50)}


def milliseconds(
    policy: kreps.Policy, states: FloatArray, calls: int, greedy: bool
) -> tuple[FloatArray, FloatArray]:
    """Milliseconds (calls,) of each call, by the clock and of the processor."""
    rows = [row.copy() for row in states]
    clock, processor = np.empty(calls), np.empty(calls)
    for i in range(-1000, calls):  # the first 1000 calls fill the caches and are not recorded
        row = rows[i % len(rows)]
        used = time.thread_time_ns()
        started = time.perf_counter_ns()
        policy.predict(row, deterministic=greedy)
        stopped = time.perf_counter_ns()
        used = time.thread_time_ns() - used
        if i >= 0:
            clock[i], processor[i] = stopped - started, used
    return 1e-6 * clock, 1e-6 * processor


def memory(policy: kreps.Policy, states: FloatArray, calls: int, greedy: bool) -> dict[str, float]:
    """Memory in kB that is allocated after the calls, and at the peak, beyond that before."""
    rows = [row.copy() for row in states]
    policy.predict(rows[0], deterministic=greedy)
    tracemalloc.start()
    try:
        for i in range(100):  # allocations that are made once, such as those of tracemalloc
            policy.predict(rows[i % len(rows)], deterministic=greedy)
        gc.collect()
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        for i in range(calls):
            policy.predict(rows[i % len(rows)], deterministic=greedy)
        peak = tracemalloc.get_traced_memory()[1]
        gc.collect()
        after = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    return {"grown_kb": (after - before) / 1e3, "peak_kb": (peak - before) / 1e3}


def timings(calls: int) -> tuple[list[dict[str, Any]], dict[str, tuple[FloatArray, FloatArray]]]:
    """One row per policy and mode, and all times in ms, by clock and processor."""
    policies = policies_to_time()
    states = policies["learnt"].process.states
    rows, times = [], {}
    for name, policy in policies.items():
        process = policy.process
        sparse = process.predictor if isinstance(process, CostSensitiveGP) else process
        for mode, goal in GOALS.items():
            clock, processor = milliseconds(policy, states, calls, mode == "greedy")
            times[f"{name}, {mode}"] = clock, processor
            median, p99, p999 = np.quantile(clock, (0.5, 0.99, 0.999)).tolist()
            rows.append(
                {
                    "policy": name,
                    "mode": mode,
                    "support": SUPPORT,
                    "centres": len(sparse.states),
                    "median_ms": median,
                    "p99_ms": p99,
                    "p999_ms": p999,
                    "worst_ms": float(clock.max()),
                    "p99_processor_ms": float(np.quantile(processor, 0.99)),
                    "p999_processor_ms": float(np.quantile(processor, 0.999)),
                    "goal_p99_ms": goal,
                    "goal_met": p99 < goal,
                    **memory(policy, states, calls, mode == "greedy"),
                }
            )
            print(rows[-1], flush=True)
    return rows, times


def compression(iterations: int) -> list[dict[str, Any]]:
    """One row per seed and number of centres."""
    rows = []
    for seed in SEEDS:
        learner = learner_of(seed)
        policy = learner.learn(iterations, progress=False).policy
        exact = policy.process
        assert isinstance(exact, CostSensitiveGP)
        for centres in (*CENTRES, None):
            few = policy if centres is None else policy.compressed(centres)
            process = few.process
            env = gym.make("kreps/SwingUp-v0")
            row: dict[str, Any] = {"seed": seed, "centres": centres or "exact"}
            row["support"] = len(exact.weights)
            row["off_at_samples"] = mean_difference(policy, few)
            row["evaluated_centres"] = len(
                (exact.predictor if process is exact else process).states
            )
            for name, acting in stochastic_and_greedy(process).items():
                found = evaluate(env, task_of(env), acting, restart_probability=RESTART)
                row[name], row[f"{name}_standard_error"] = found.mean, found.standard_error
            rows.append(row)
            print(row, flush=True)
    return rows


def tables(content: dict[str, Any]) -> str:
    timed = markdown(
        (
            "policy",
            "mode",
            "centres",
            "median",
            "p99",
            "p99.9",
            "goal p99",
            "processor p99",
            "processor p99.9",
            "memory grown",
            "peak",
        ),
        [
            [
                row["policy"],
                row["mode"],
                str(row["centres"]),
                f"{row['median_ms']:.3f} ms",
                f"{row['p99_ms']:.3f} ms",
                f"{row['p999_ms']:.3f} ms",
                f"< {row['goal_p99_ms']:g} ms: {'met' if row['goal_met'] else 'MISSED'}",
                f"{row['p99_processor_ms']:.3f} ms",
                f"{row['p999_processor_ms']:.3f} ms",
                f"{row['grown_kb']:.1f} kB",
                f"{row['peak_kb']:.0f} kB",
            ]
            for row in content["timings"]
        ],
    )
    rows = content["compression"]
    exact = {row["seed"]: row for row in rows if row["centres"] == "exact"}
    body = []
    for c in CENTRES:
        entries = [str(c)]
        for seed, of in exact.items():
            (row,) = (r for r in rows if r["seed"] == seed and r["centres"] == c)
            # adding zero turns -0.0 into 0.0
            lost = " / ".join(f"{round(of[name] - row[name], 2) + 0.0:.2f}" for name in MODES)
            entries.append(f"{lost} ({row['off_at_samples']:.3f})")
        body.append(entries)
    headings = [
        f"seed {seed}: {of['evaluated_centres']} pivots of {of['support']}, "
        + " / ".join(f"{of[name]:.2f}" for name in MODES)
        for seed, of in exact.items()
    ]
    return (
        f"{timed}\n\n{content['calls']} calls each, on {content['processors']} processors "
        f"with a load average of {content['load_average_at_start']:.1f} at the start.\n\n"
        "Reward per step lost by compression, greedy / stochastic, and in brackets the root mean "
        "square difference of the actions at the samples, in units of the action scale. The "
        "headings have the rewards of the exact policies.\n\n"
        f"{markdown(('centres', *headings), body)}\n"
    )


def picture(
    content: dict[str, Any], times: dict[str, tuple[FloatArray, FloatArray]], path: Path
) -> None:
    with rc_context(STYLE):
        figure = Figure(figsize=(14.0, 4.4))
        left, middle, right = figure.subplots(1, 3)
        names = list(dict.fromkeys(row["policy"] for row in content["timings"]))
        for axes, which, title in ((left, 0, "by the clock"), (middle, 1, "of the processor")):
            for label, of_call in times.items():
                name, mode = label.split(", ")
                ms = np.sort(of_call[which])
                share = 1.0 - np.arange(len(ms)) / len(ms)
                colour, line = COLOURS[names.index(name)], "-" if mode == "greedy" else "--"
                axes.plot(ms, share, color=colour, ls=line, lw=1.4, label=label)
            axes.axhline(0.01, color=GREY, lw=0.8, ls=":", zorder=0)
            for mode, goal in GOALS.items():
                axes.plot(goal, 0.01, "v", color="black", ms=7)
                axes.annotate(f"goal, {mode}", (goal, 0.014), ha="center", fontsize=7)
            axes.set(xscale="log", yscale="log", xlim=(0.01, 100.0), ylim=(1e-4, 1.0))
            axes.set_xlabel("time of one call [ms]")
            axes.set_title(f"predict, {SUPPORT} support points: {title}")
        left.set_ylabel("share of calls that take longer")
        middle.legend(fontsize=7, loc="upper right")

        rows = content["compression"]
        exact = {row["seed"]: row for row in rows if row["centres"] == "exact"}
        for (seed, of), colour in zip(exact.items(), COLOURS, strict=False):
            mine = [row for row in rows if row["seed"] == seed and row["centres"] in CENTRES]
            for name, line in zip(MODES, ("-", "--"), strict=True):
                lost = [of[name] - row[name] for row in mine]
                label = f"seed {seed}, {name}"
                right.plot(CENTRES, lost, "o", ls=line, color=colour, ms=3, lw=1.2, label=label)
        right.axhline(0.0, color=GREY, lw=0.8, ls="--")
        right.set_xscale("log")
        right.set_yscale("symlog", linthresh=0.1)
        right.set_ylim(-10.0, 200.0)
        right.set_xticks(CENTRES, [str(c) for c in CENTRES])
        right.minorticks_off()
        right.set_xlabel("centres")
        right.set_ylabel("average reward per step lost against the exact policy")
        right.set_title(f"Compression after {content['iterations']} updates, {len(SEEDS)} seeds")
        right.legend(fontsize=7, handlelength=4)
        figure.supxlabel(f"{content['command']}, {content['commit']}", fontsize=6.5, color=GREY)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=100_000)
    parser.add_argument("--iterations", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("results"))
    options = parser.parse_args()
    command = "python benchmarks/predict.py"
    if options.calls != parser.get_default("calls"):
        command += f" --calls {options.calls}"
    if options.iterations != parser.get_default("iterations"):
        command += f" --iterations {options.iterations}"
    source = commit()  # now: the source tree may change while this runs
    code = script_fingerprint(Path(__file__))
    load = os.getloadavg()[0]
    assert gc.isenabled()
    with blas_threads(1):
        rows, times = timings(options.calls)
        compressed = compression(options.iterations)
    content = {
        "command": command,
        "commit": source,
        "code": code,
        "versions": versions(),
        "processors": os.cpu_count(),
        "load_average_at_start": load,
        "calls": options.calls,
        "iterations": options.iterations,
        "timings": rows,
        "compression": compressed,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "predict.json").write_text(json.dumps(content, indent=2) + "\n")
    (options.out / "predict.md").write_text(tables(content))
    picture(content, times, options.out / "predict.png")
    print(tables(content))


if __name__ == "__main__":
    main()
