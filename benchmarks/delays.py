"""Held-out error of predictions by the number of earlier steps in a state, on delayed swing-ups.

    python benchmarks/delays.py

Six rollouts of random bang-bang actions in the swing-up: as it is, with actions that act two steps
later, and with the angle alone observed.  For each delay and history that ``history="auto"``
considers, the error of its predictions is computed.  Writes ``delays.json``, ``delays.md`` and
``delays.png`` to ``results/``.
"""

from __future__ import annotations

import argparse
import json
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from kreps import plotting
from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.kernels.threads import blas_threads
from kreps.learning.collect import collect
from kreps.learning.environment import task_of
from kreps.models.history_choice import HistoryChoice, choose_history
from kreps.policies.exploration import BangBang

ROLLOUTS, SEEDS = 6, 5
DELAY = 2


class DelayedActions(gym.Wrapper[Any, Any, Any, Any]):
    """Actions act `DELAY` steps later; before, no torque acts."""

    def reset(self, **arguments: Any) -> Any:
        self.waiting = deque([np.zeros(1)] * DELAY)
        return self.env.reset(**arguments)

    def step(self, action: Any) -> Any:
        self.waiting.append(np.array(action))
        return self.env.step(self.waiting.popleft())


def environments() -> dict[str, gym.Env[Any, Any]]:
    """The swing-up in three forms, by what is shown of it."""
    plain = gym.make("kreps/SwingUp-v0")
    angle = gym.spaces.Box(-np.pi, np.pi, (1,), np.float64)
    return {
        "as it is": plain,
        f"actions {DELAY} steps later": DelayedActions(gym.make("kreps/SwingUp-v0")),
        "velocity not observed": gym.wrappers.TransformObservation(
            gym.make("kreps/SwingUp-v0"), lambda observation: observation[:1], angle
        ),
    }


def choice_of(env: gym.Env[Any, Any], seed: int) -> HistoryChoice:
    """The choice from the first rollouts of a learner with this seed."""
    task = task_of(env, [0])
    rollouts = collect(
        env, task, BangBang(task), ROLLOUTS, seed=seed, iteration=0, restart_probability=0.02
    )
    choice = choose_history(rollouts, task, 0, np.random.default_rng(seed))
    assert choice is not None
    return choice


def measured() -> dict[str, list[dict[str, Any]]]:
    """Errors of all candidates and the chosen one, by environment and seed."""
    return {
        name: [
            {
                "chosen": [choice.chosen.delay, choice.chosen.history],
                "errors": [[each.delay, each.history, each.relative] for each in choice.all],
            }
            for choice in (choice_of(env, seed) for seed in range(SEEDS))
        ]
        for name, env in environments().items()
    }


def median_errors(runs: list[dict[str, Any]], *, histories: bool) -> tuple[list[int], list[float]]:
    """Number of earlier steps and median error over seeds, of histories or of delays alone."""
    errors: dict[int, list[float]] = {}
    for run in runs:
        for delay, history, error in run["errors"]:
            if (delay == 0 or delay <= history) if histories else history == 0:
                errors.setdefault(history if histories else delay, []).append(error)
    steps = [k for k in sorted(errors) if len(errors[k]) == len(runs)]
    return steps, [float(np.median(errors[k])) for k in steps]


def draw(found: dict[str, list[dict[str, Any]]]) -> Figure:
    """A panel for each environment: error against earlier steps."""
    with rc_context(plotting.STYLE):
        figure = Figure(figsize=(9.0, 2.9))
        panels = figure.subplots(1, 3, sharey=True)
        for axes, (name, runs) in zip(panels, found.items(), strict=True):
            for histories, label in ((False, "the last k actions"), (True, "the last k steps")):
                axes.plot(*median_errors(runs, histories=histories), marker="o", label=label)
            axes.set(title=name, xlabel="k", ylim=(0.0, 1.0), xticks=range(4))
        figure.axes[0].set_ylabel("held-out error")
        figure.axes[0].legend()
    return figure


def table(found: dict[str, list[dict[str, Any]]]) -> str:
    """What was chosen, by environment."""
    lines = ["| swing-up | error without | chosen (delay, history) by seed |", "|---|---|---|"]
    for name, runs in found.items():
        _, (without, *_) = median_errors(runs, histories=False)
        chosen = ", ".join(f"({run['chosen'][0]}, {run['chosen'][1]})" for run in runs)
        lines.append(f"| {name} | {without:.2f} | {chosen} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the results")
    out = parser.parse_args().out
    with blas_threads(1):
        found = measured()
    content = {
        "command": "python benchmarks/delays.py",
        "commit": commit(),
        "code": script_fingerprint(Path(__file__)),
        "rollouts": ROLLOUTS,
        "results": found,
    }
    (out / "delays.json").write_text(json.dumps(content, indent=2) + "\n")
    (out / "delays.md").write_text(table(found))
    plotting.save(draw(found), out / "delays.png")


if __name__ == "__main__":
    main()
