"""Experiments: cells that run once, survive interruption, and are summed up without loss."""

from __future__ import annotations

import csv
import json
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kreps.errors import StorageError
from kreps.experiments import cells as cells_module
from kreps.experiments.cells import Cell, read_cell, run_cell, write_cell
from kreps.experiments.runner import (
    cells_of,
    commits_of,
    markdown_table,
    rows_of,
    run_cells,
    summarise,
    write_results,
)
from kreps.experiments.specs import EXPERIMENTS, Experiment, Method

TINY = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "window": 6}
EXPERIMENT = Experiment(
    "kreps/SwingUp-v0", 2, {"One": Method("default", TINY), "the other": Method("paper", TINY)}
)


class Inline(Executor):
    """Runs at once in this process, counts, and may fail at some call."""

    def __init__(self, fail_at: int | None = None) -> None:
        self.calls = 0
        self._fail_at = fail_at

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self.calls == self._fail_at:
            future.set_exception(RuntimeError("the power went out"))
        else:
            future.set_result(fn(*args, **kwargs))
        self.calls += 1
        return future


@pytest.fixture(autouse=True)
def short_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    full = cells_module.evaluate

    def short(*args: Any, **kwargs: Any) -> Any:
        return full(*args, **kwargs, episodes=5, steps=30)

    monkeypatch.setattr(cells_module, "evaluate", short)


def test_cells_are_each_method_with_each_seed_from_zero() -> None:
    cells = cells_of(EXPERIMENTS["swing-up"], 3, None)
    assert [(c.method, c.seed) for c in cells] == [
        (method, seed) for seed in range(3) for method in ("kreps (default)", "paper-like")
    ]
    assert {c.iterations for c in cells} == {20}
    assert len({c.name for c in cells}) == len(cells)


def test_a_cell_evaluates_every_iteration_and_repeats_exactly() -> None:
    cell = cells_of(EXPERIMENT, 1, None)[0]
    result = run_cell(cell)
    assert [row["iteration"] for row in result["rows"]] == [1, 2]
    steps = [row["steps"] for row in result["rows"]]
    assert steps[0] < steps[1]
    again = run_cell(cell)
    for row, same in zip(result["rows"], again["rows"], strict=True):
        assert (row["stochastic"], row["greedy"]) == (same["stochastic"], same["greedy"])


def test_what_is_done_is_never_run_again(tmp_path: Path) -> None:
    cells = cells_of(EXPERIMENT, 2, 1)
    broken = Inline(fail_at=2)
    with pytest.raises(RuntimeError, match="power"):
        run_cells(cells, broken, tmp_path)
    done = [cell for cell in cells if read_cell(cell, tmp_path)]
    assert len(done) == len(cells) - 1
    rest = Inline()
    results = run_cells(cells, rest, tmp_path)
    assert rest.calls == 1
    assert [r["cell"]["seed"] for r in results] == [c.seed for c in cells]
    idle = Inline()
    assert run_cells(cells, idle, tmp_path) == results
    assert idle.calls == 0


def test_a_cell_of_other_settings_is_run_again_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    cell = cells_of(EXPERIMENT, 1, 1)[0]
    write_cell(cell, tmp_path, {"commit": "x", **run_cell(cell)})
    assert read_cell(cell, tmp_path) is not None
    other = Cell(cell.method, cell.recipe, {"kl_bound": 0.1}, cell.environment, 1, cell.seed)
    assert read_cell(other, tmp_path) is None
    (tmp_path / f"{cell.name}.json").write_text("{")
    with pytest.raises(StorageError, match=cell.name):
        read_cell(cell, tmp_path)


def results_of(values: dict[str, list[float]]) -> list[dict[str, Any]]:
    return [
        {
            "commit": "abc",
            "rows": [
                {
                    "method": method,
                    "seed": seed,
                    "iteration": iteration,
                    "steps": 100 * iteration,
                    "stochastic": value - (2 - iteration),
                    "greedy": value + 1.0,
                    "update_cpu_seconds": 0.5,
                }
                for iteration in (1, 2)
            ],
        }
        for method, by_seed in values.items()
        for seed, value in enumerate(by_seed)
    ]


def test_the_summary_is_of_the_last_iteration_and_shows_the_worst_seed() -> None:
    results = results_of({"A": [-20.0, -22.0, -30.0], "B": [-5.0]})
    summary = summarise(rows_of(results))
    assert summary["A"]["stochastic"]["mean"] == pytest.approx(-24.0)
    error = 2 * np.std([-20.0, -22.0, -30.0], ddof=1) / np.sqrt(3)
    assert summary["A"]["stochastic"]["two_standard_errors"] == pytest.approx(error)
    assert summary["A"]["greedy"]["worst"] == -29.0
    assert summary["B"]["stochastic"]["by_seed"] == [-5.0]
    assert "| A | -24.00 ± 6.11 | -30.00 | -23.00 ± 6.11 | -29.00 | 0.50 |" in markdown_table(
        summary
    )


def test_written_results_hold_every_row_and_where_they_come_from(tmp_path: Path) -> None:
    results = results_of({"A": [-20.0, -22.0]})
    results[1]["commit"] = "def"
    summary = write_results(tmp_path, "try", "kreps reproduce try", EXPERIMENT, results)
    content = json.loads((tmp_path / "try.json").read_text())
    assert content["summary"] == json.loads(json.dumps(summary))
    assert (content["command"], content["commit"]) == ("kreps reproduce try", "abc, def")
    assert commits_of(results) == "abc, def"
    with open(tmp_path / "try.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["seed"], r["iteration"]) for r in rows] == [
        ("0", "1"),
        ("0", "2"),
        ("1", "1"),
        ("1", "2"),
    ]
    assert (tmp_path / "try.md").read_text().strip() == markdown_table(summary)
