"""Final scores of recorded trials in the form that rliable takes (Agarwal et al. 2021)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kreps.errors import DataError
from kreps.kernels.arrays import FloatArray


def score_arrays(
    rows: Sequence[Mapping[str, Any]], measure: str = "stochastic"
) -> dict[str, FloatArray]:
    """Scores (runs, tasks) of each method after its last update.

    Tasks are in the order in which they first appear, and a column has the scores of the seeds of
    its task in ascending order.  Scores are not normalised: rewards of different tasks have
    different units, so normalise them before an average over tasks.

    Args:
        rows: of a table of results such as ``results/swing-up.csv``, as ``csv.DictReader`` reads
            it: "task", "method", "seed", "iteration" and the measure.
        measure: "stochastic" or "greedy", the average reward per step with or without noise.

    Raises:
        DataError: no row, or a method that has not the same number of seeds of every task.
    """
    last: dict[str, dict[str, dict[int, tuple[int, float]]]] = {}
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    for row in rows:
        seeds = last.setdefault(row["method"], {}).setdefault(row["task"], {})
        score = int(row["iteration"]), float(row[measure])
        seeds[int(row["seed"])] = max(score, seeds.get(int(row["seed"]), score))
    if not last:
        raise DataError("there is no row to take scores from; give those of a table of results")
    scores = {}
    for method, found in last.items():
        counts = {task: len(found.get(task, ())) for task in tasks}
        if len(set(counts.values())) > 1:
            raise DataError(
                f"the method {method!r} has {counts} seeds, but rliable needs equally many of "
                "every task; leave out the rows of some tasks or seeds"
            )
        columns = [[found[task][seed][1] for seed in sorted(found[task])] for task in tasks]
        scores[method] = np.array(columns).T
    return scores
