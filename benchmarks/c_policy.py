"""Time and accuracy of a policy as C source: the table of docs/how_to/export.md.

    python benchmarks/c_policy.py

Learns a policy of the swing-up (seed 0, 6 updates), exports it on all and on fewer centres,
compiles it by gcc with -O2, and prints a Markdown table: mean and longest time of 1e5 calls on this
machine, and the largest difference from Python in 2,000 observations, in units of the action scale.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np

import kreps
from kreps.learning.storage.c_source import TYPES

OBSERVATIONS = 2000
GCC = ("gcc", "-std=c99", "-O2")


def row(policy: kreps.Policy, centres: int, dtype: str, folder: Path) -> str:
    """One row of the table; the folder must be new, as a library is loaded once for each path."""
    arithmetic = policy.export_c(folder / "policy.c", dtype)
    source, link = folder / "policy.c", "-lm"
    subprocess.run([*GCC, "-shared", "-fPIC", "-o", folder / "policy.so", source, link], check=True)
    subprocess.run([*GCC, "-DKREPS_BENCHMARK", "-o", folder / "time", source, link], check=True)
    words = subprocess.run([folder / "time"], check=True, capture_output=True, text=True).stdout
    mean, longest = (float(words.split()[i]) for i in (3, 6))

    rng, act = np.random.default_rng(4), ctypes.CDLL(str(folder / "policy.so")).policy_act
    angles, speeds = rng.uniform(-9.0, 9.0, OBSERVATIONS), rng.uniform(-15.0, 15.0, OBSERVATIONS)
    at = np.stack([angles, speeds], axis=1).astype(dtype)
    found = np.zeros((OBSERVATIONS, 1), dtype)
    for observation, action in zip(at, found, strict=True):
        act(ctypes.c_void_p(observation.ctypes.data), ctypes.c_void_p(action.ctypes.data))
    wanted, _ = policy.predict(at.astype(np.float64), deterministic=True)
    error = np.abs((found - wanted) / policy.process.task.action_scale).max()
    types = [f"`{TYPES[each][0]}`" for each in (dtype, arithmetic)]
    cells = [str(centres), *types, f"{mean:.2f} µs", f"{longest:.0f} µs", f"{error:.0e}"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    exact = kreps.KREPS(gym.make("kreps/SwingUp-v0"), seed=0).learn(6, progress=False).policy
    for centres in (len(exact.process.predictor.states), 50, 20):  # type: ignore[attr-defined]
        for dtype in TYPES:
            with tempfile.TemporaryDirectory() as folder:
                print(row(exact.compressed(centres), centres, dtype, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
