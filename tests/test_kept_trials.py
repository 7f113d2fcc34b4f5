"""The trials in ``results/trials`` are those that the published figures show."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from kreps.experiments.runner import figure_trials
from kreps.experiments.trials import read_trial

RESULTS = Path(__file__).resolve().parents[1] / "results"


def as_published(row: dict[str, Any]) -> dict[str, str]:
    """A row of a trial as the table of its figure has it."""
    return {k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()}


@pytest.mark.parametrize("figure", ["figure-1a", "figure-1b", "figure-2b", "swing-up"])
def test_a_figure_shows_the_trials_that_are_kept(figure: str) -> None:
    with (RESULTS / f"{figure}.csv").open() as file:
        published = [{k: v for k, v in row.items() if v} for row in csv.DictReader(file)]
    seeds = {int(row["seed"]) for row in published}
    settings = json.loads((RESULTS / f"{figure}.json").read_text())["settings"]
    kept, fingerprints = [], set()
    for trial in figure_trials(figure, len(seeds), None):
        result = read_trial(trial, RESULTS / "trials")
        assert result is not None, f"{trial.name} is missing: kreps reproduce {figure}"
        kept += [as_published(row) for row in result["rows"]]
        if result["code"]:
            fingerprints.add(trial.curve)
        assert settings[f"{trial.task}: {trial.method}"] == result["settings"]
    assert len(kept) == len(published)
    assert all(row in published for row in kept)
    assert len(fingerprints) == len({trial.curve for trial in figure_trials(figure, 1, None)})
