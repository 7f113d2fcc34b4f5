"""The progress display of `Learner.learn`: a live table in a terminal, lines of text elsewhere."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

if TYPE_CHECKING:
    from kreps.learning.learner import IterationReport, Learner

SHOWN_ROWS = 24
"""Rows of the live table: those of the latest iterations."""


def seconds_by_stage(report: IterationReport) -> dict[str, float]:
    """CPU seconds of each stage of one iteration, collecting rollouts included."""
    return {"rollouts": report.rollout_seconds, **report.update.seconds}


class ProgressTable:
    """A callback that shows each iteration as a row, and the remaining time.

    Args:
        target: number of updates after which learning ends.
    """

    def __init__(self, target: int) -> None:
        self._console = Console()
        self._rows: list[dict[str, str]] = []
        self._stages: dict[str, float] = {}
        self._bar = Progress(
            TextColumn("learning"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=self._console,
        )
        self._task = self._bar.add_task("learning", total=target, note="")
        self._live = Live(self._layout(), console=self._console, refresh_per_second=4)

    def __enter__(self) -> ProgressTable:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._console.is_terminal:
            self._bar.update(self._task, note="")
            self._live.update(self._layout(), refresh=True)
            self._live.stop()
        elif self._stages:
            print(self._stage_line(), flush=True)

    def rollouts_done(self, count: int) -> None:
        """Show how many rollouts of the iteration are complete."""
        self._bar.update(self._task, note=f"{count} rollouts")

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        stages = seconds_by_stage(report)
        for name, seconds in stages.items():
            self._stages[name] = self._stages.get(name, 0.0) + seconds
        shown = report.update.shown()
        note = shown.pop("note", "")
        if learner.exploring:
            note = f"{note}  no state-dependent reward: exploring".strip()
        row = {
            "iter": f"{report.iteration}",
            "steps": f"{report.steps}",
            "reward": f"{report.average_reward:.4g}",
            **shown,
            "CPU s": f"{sum(stages.values()):.2f}",
            "note": note,
        }
        if self._console.is_terminal:
            self._rows.append(row)
            self._bar.update(self._task, completed=report.iteration)
            self._live.update(self._layout())
        else:
            print("  ".join(f"{name} {value}" for name, value in row.items() if value), flush=True)

    def _layout(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in self._rows[-1] if self._rows else ():
            table.add_column(name, justify="left" if name == "note" else "right")
        for row in self._rows[-SHOWN_ROWS:]:
            table.add_row(*row.values())
        whole = Table.grid()
        whole.add_row(table)
        if self._stages:
            whole.add_row(f"[dim]{self._stage_line()}[/dim]")
        whole.add_row(self._bar)
        return whole

    def _stage_line(self) -> str:
        stages = ", ".join(f"{name} {s:.1f}" for name, s in self._stages.items())
        return f"CPU seconds: {stages}"
