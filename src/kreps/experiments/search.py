"""The parameter search of the compared methods, on seeds that no figure uses.

Each method has the same number of candidates on each task.  The first candidate is the method's
preset, except where this needs a grid that is too large for the task.  With the preset ``authors``
the candidates are values that their scripts try (on a grid, other grids), so REPS, for which these
name one value, is not searched; nor is the default of this library.  All candidates learn on the
same seeds.  The score is the evaluated reward of the policy, half with its exploration and half
without, averaged over the last updates and the seeds.  With exploration alone the search would
choose value iteration with little exploration, whose greedy policy is far from its best.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from kreps.errors import StorageError
from kreps.experiments.specs import (
    FEATURES,
    GRID_VI,
    KERNEL,
    NPALP,
    SAMPLE,
    VALUES,
    with_preset,
)
from kreps.experiments.tables import markdown
from kreps.experiments.trials import Trial, code_of, commits_of, name_of, trial_of
from kreps.learning.storage import write_atomically

SEEDS = (200, 201, 202)
ITERATIONS = 10
COUNTED = 5
"""The score averages over so many of the latest updates."""

EPISODES = 20
"""Rollouts of each evaluation."""

Candidates = tuple[dict[str, Any], ...]


def _each(shared: Mapping[str, Any], *candidates: Mapping[str, Any]) -> Candidates:
    return tuple({**shared, **candidate} for candidate in candidates)


def _grids(*sizes: tuple[Any, int], **shared: Any) -> Candidates:
    return _each(shared, *({"grid_states": s, "grid_actions": a} for s, a in sizes))


# What the paper leaves open: bound, ridge and temperature floor.
_PAPER: Candidates = ({}, {"kl_bound": 1.0}, {"ridge": 0.01}, {"eta_floor": 0.1})
_PAPER_FEATURES: Candidates = ({}, {"value.size": 20}, {"ridge": 0.01}, {"eta_floor": 0.1})
_DEFAULT_SAMPLE: Candidates = ({}, {"kl_bound": 0.5}, {"ridge": 0.01}, {"eta_floor": 0.1})
_DEFAULT_FEATURES: Candidates = ({}, {"value.size": 20}, {"kl_bound": 0.5}, {"ridge": 0.1})
_TEMPERATURES: Candidates = (
    {},
    {"temperature": 0.1},
    {"temperature": 0.3},
    {"temperature": 3.0},
)
# Inverse temperatures of 3 (the preset), 1.5 and 1, and that of their grid, 20.
_AUTHORS_TEMPERATURES: Candidates = (
    {},
    {"temperature": 0.667},
    {"temperature": 1.0},
    {"temperature": 0.05},
)

CANDIDATES: dict[str, dict[str, Candidates]] = {
    "authors-reaching": {
        with_preset(VALUES, "authors"): _each({"actions": 100}, *_AUTHORS_TEMPERATURES),
        with_preset(GRID_VI, "authors"): _grids((5, 2), (4, 2), (3, 3), (4, 3), actions=100),
        with_preset(NPALP, "authors"): (
            {},
            {"noise_scale": 0.2},
            {"noise_fraction": 0.03, "noise_scale": 0.4},
            {"noise_fraction": 0.01},
        ),
    },
    "authors-swing-up": {
        with_preset(VALUES, "authors"): _AUTHORS_TEMPERATURES,
        with_preset(GRID_VI, "authors"): (
            {},
            {"temperature": 0.333},
            {"grid_states": [25, 17], "grid_actions": 13},
            {"grid_states": [25, 17], "grid_actions": 13, "temperature": 0.333},
        ),
    },
    "reaching": {
        with_preset(KERNEL, "paper"): _PAPER,
        with_preset(SAMPLE, "paper"): _PAPER,
        with_preset(SAMPLE, "default"): _DEFAULT_SAMPLE,
        with_preset(VALUES, "default"): _TEMPERATURES,
        with_preset(GRID_VI, "default"): _grids((4, 3), (3, 3), (3, 5), (5, 3)),
        with_preset(NPALP, "default"): (
            {},
            {"lipschitz": 30.0},
            {"lipschitz": 30.0, "noise_scale": 0.1},
            {"lipschitz": 30.0, "noise_scale": 0.1, "noise_fraction": 1.0},
        ),
    },
    "swing-up": {
        with_preset(KERNEL, "paper"): _PAPER,
        with_preset(SAMPLE, "paper"): _PAPER,
        with_preset(FEATURES, "paper"): _PAPER_FEATURES,
        with_preset(SAMPLE, "default"): _DEFAULT_SAMPLE,
        with_preset(FEATURES, "default"): _DEFAULT_FEATURES,
        with_preset(VALUES, "default"): _TEMPERATURES,
        with_preset(GRID_VI, "default"): _grids((15, 7), (10, 7), (20, 5), (25, 5)),
    },
    "images": {
        with_preset(KERNEL, "paper"): _PAPER,
        with_preset(SAMPLE, "paper"): _PAPER,
        with_preset(SAMPLE, "default"): _DEFAULT_SAMPLE,
    },
}


def search_trials(task: str, method: str) -> list[list[Trial]]:
    """The trials of each candidate: one list per candidate, one trial per seed."""
    return [
        [
            trial_of(
                task,
                method,
                seed,
                options,
                iterations=ITERATIONS,
                episodes=(EPISODES, EPISODES),
                label=f"candidate {number}",
            )
            for seed in SEEDS
        ]
        for number, options in enumerate(CANDIDATES[task][method])
    ]


def score(rows: Sequence[Mapping[str, Any]]) -> float:
    """The score of one trial from its rows, one per iteration."""
    counted = rows[-COUNTED:]
    return float(np.mean([[row["stochastic"], row["greedy"]] for row in counted]))


def outcome(task: str, method: str, results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The scores of all candidates of a method on a task, and the options of the best one.

    Args:
        task, method: keys of `CANDIDATES`.
        results: of the trials, by their names.
    """
    scores = [
        [round(score(results[trial.name]["rows"]), 4) for trial in trials]
        for trials in search_trials(task, method)
    ]
    best = int(np.argmax([np.mean(each) for each in scores]))
    candidates = CANDIDATES[task][method]
    return {
        "candidates": [
            {"options": options, "scores": each}
            for options, each in zip(candidates, scores, strict=True)
        ],
        "chosen": candidates[best],
    }


def write_search(
    path: Path, command: str, tasks: Sequence[str], results: Sequence[Mapping[str, Any]]
) -> Path:
    """Write the outcome on some tasks; what the file holds of other tasks stays.

    Args:
        path: of the JSON file; a table is written beside it.
        command: that made the results.
        tasks: keys of `CANDIDATES`.
        results: of all trials of these tasks.

    Raises:
        StorageError: the file is there but damaged, or cannot be written.
    """
    by_name = {name_of(result): result for result in results}
    try:
        found = json.loads(path.read_text())["outcome"]
    except FileNotFoundError:
        found = {}
    except (ValueError, KeyError, TypeError) as error:
        raise StorageError(f"{path} is damaged ({error!r}); remove it and search again") from error
    for task in tasks:
        found[task] = {m: outcome(task, m, by_name) for m in CANDIDATES[task]}
    content = {
        "command": command,
        "commit": commits_of(results),
        "seeds": SEEDS,
        "iterations": ITERATIONS,
        "score": "evaluated reward, half with exploration and half without, "
        f"mean of the last {COUNTED} iterations",
        "outcome": found,
        "code": code_of(results),
    }
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    write_atomically(path.with_suffix(".md"), (search_table(content) + "\n").encode())
    return path


def search_table(content: Mapping[str, Any]) -> str:
    """The documentation's table: scores of all candidates, the best in bold, and its options."""
    rows = []
    for task, methods in content["outcome"].items():
        for method, found in methods.items():
            means = [float(np.mean(each["scores"])) for each in found["candidates"]]
            places = 1 if max(map(abs, means)) >= 1 else 3
            shown = [f"{mean:.{places}f}" for mean in means]
            best = [each["options"] for each in found["candidates"]].index(found["chosen"])
            shown[best] = f"**{shown[best]}**"
            options = ", ".join(f"`{k}={v!r}`" for k, v in found["chosen"].items()) or "defaults"
            rows.append([task, method, ", ".join(shown), options])
    return markdown(("task", "method", "scores of the candidates", "chosen"), rows)


def tuned_options(task: str, method: str) -> dict[str, Any]:
    """The options of the best candidate, from the committed outcome; none if there is no search.

    Those of the first candidate where there is no outcome of the search yet.
    """
    candidates = CANDIDATES.get(task, {}).get(method, ({},))
    found = _committed_outcome().get(task, {}).get(method, {"chosen": candidates[0]})
    return dict(found["chosen"])


@cache
def _committed_outcome() -> dict[str, Any]:
    file = resources.files("kreps.experiments").joinpath("search.json")
    committed: dict[str, Any] = json.loads(file.read_text())["outcome"]
    return committed
