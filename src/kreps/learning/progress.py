"""The progress display of `Learner.learn`: a live table in a terminal, lines of text elsewhere."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping, Sequence
from itertools import accumulate
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO, cast

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
from rich.text import Text

from kreps.learning.environment import time_limit
from kreps.terminal import Output

if TYPE_CHECKING:
    from kreps.learning.iteration import IterationReport
    from kreps.learning.learner import Learner
    from kreps.models.history_choice import HistoryChoice

GAP = "  "
WIDTHS = {"iter": 4, "reward": 7, "ESS": 4, "CPU s": 5}
OTHER_WIDTH = 6
"""Smallest widths of columns; one grows where a value is longer."""

STAGES_PART = 5
"""The time of each stage takes at most this part of the height, so that rows stay visible."""

ALWAYS_SHOWN = 3
"""Number of columns that are shown however narrow the terminal is."""


def seconds_by_stage(report: IterationReport) -> dict[str, float]:
    """CPU seconds of each stage of one iteration, collecting rollouts included."""
    return {"rollouts": report.rollout_seconds, **report.update.seconds}


def ends_episodes(learner: Learner[Any]) -> bool:
    """Whether the task ends episodes: by a time limit, or by a termination in the window."""
    if learner.env is not None and time_limit(learner.env) < sys.maxsize:
        return True
    return bool(learner.state.window.rollouts.terminated.any())


class ProgressTable:
    """A callback that shows each iteration as a row, and the remaining time.

    In a terminal a row stays where it was printed, above a bar at the bottom, so that the newest
    row and the bar are visible in a window of any height.  The headings are repeated before they
    leave the window.  Columns that do not fit in its width are left out; all numbers are in the
    reports.  "robot s" is the robot time of all steps so far, without resets, where the control
    period is known.  "reward" is per step; "return", where the task ends episodes, is the mean sum
    of the rewards of the new rollouts, which random restarts may have cut.

    Args:
        target: number of updates after which learning ends.
    """

    def __init__(self, target: int) -> None:
        self._console = Console()
        self._output = cast(TextIO, Output(cast(TextIO, self._console.file)))
        self._console.file = self._output
        self._widths: dict[str, int] = {}
        self._headings: list[str] = []
        self._rows_below = 0  # the headings
        self._stages: dict[str, float] = {}
        self._history: tuple[int, int] | None = None
        self._bar = Progress(
            TextColumn("learning"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=self._console,
        )
        self._task = self._bar.add_task("learning", total=target, note="")
        self._live = Live(self._footer(), console=self._console, refresh_per_second=4)

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
            self._live.update(self._footer(), refresh=True)
            self._live.stop()
        elif self._stages:
            self._print_line(self._stage_line())

    def say(self, line: str) -> None:
        """Print a line above the table, unless it is empty."""
        if not line:
            return
        if self._console.is_terminal:
            self._console.print(Text(line), soft_wrap=True)
        else:
            self._print_line(line)

    def rollouts_done(self, count: int) -> None:
        """Show how many rollouts of the iteration are complete."""
        self._bar.update(self._task, note=f"{count} rollouts")

    def __call__(self, learner: Learner[Any], report: IterationReport) -> None:
        stages = seconds_by_stage(report)
        for name, seconds in stages.items():
            self._stages[name] = self._stages.get(name, 0.0) + seconds
        self._say_history(getattr(report.update, "history_choice", None))
        shown = report.update.shown()
        note = shown.pop("note", "")
        if report.explorer_share > 0.0:
            note = f"{note}  {report.explorer_share:.0%} of the steps by the explorer".strip()
        if learner.exploring:
            note = f"{note}  no state-dependent reward: exploring".strip()
        robot = learner.task.robot_seconds(report.steps)
        row = {
            "iter": f"{report.iteration}",
            "steps": f"{report.steps}",
            **({} if robot is None else {"robot s": f"{robot:.1f}"}),
            "reward": f"{report.average_reward:.4g}",
            **({"return": f"{report.mean_return:.4g}"} if ends_episodes(learner) else {}),
            **shown,
            "CPU s": f"{sum(stages.values()):.2f}",
        }
        if self._console.is_terminal:
            self._bar.update(self._task, completed=report.iteration)
            self._live.update(self._footer())
            self._print_row(row, note.strip())
        else:
            row["note"] = note
            self._print_line("  ".join(f"{name} {text}" for name, text in row.items() if text))

    def _say_history(self, choice: HistoryChoice | None) -> None:
        """Say which earlier steps the states have and why, at first and whenever that changes."""
        if choice is None:
            return
        chosen = choice.chosen.delay, choice.chosen.history
        if chosen != self._history:
            self._history = chosen
            self.say(str(choice))

    def _print_line(self, line: str) -> None:
        print(line, file=self._output, flush=True)

    def _print_row(self, row: Mapping[str, str], note: str) -> None:
        """Print a row above the bar, with its headings if they changed or left the window."""
        for name, value in row.items():
            least = WIDTHS.get(name, OTHER_WIDTH)
            self._widths[name] = max(self._widths.get(name, least), len(name), len(value))
        names = self._fitting_columns(list(row))
        headings = [name.rjust(self._widths[name]) for name in names]
        line = GAP.join(row[name].rjust(self._widths[name]) for name in names)
        if note and len(line) + len(GAP) + len(note) <= self._console.width:
            line, note = f"{line}{GAP}{note}", ""
        lines = [line]
        if note:  # below, as it does not fit
            indent = " " * (self._widths["iter"] + len(GAP))
            width = max(self._console.width, 2 * len(indent))
            lines += textwrap.wrap(note, width, initial_indent=indent, subsequent_indent=indent)
        height = self._console.height - len(lines) - len(self._console.render_lines(self._footer()))
        if headings != self._headings or self._rows_below >= height:
            self._console.print(Text(GAP.join(headings), style="bold"), soft_wrap=True)
            self._headings, self._rows_below = headings, 1
        self._rows_below += len(lines)
        self._console.print(Text("\n".join(lines)), soft_wrap=True)

    def _fitting_columns(self, names: Sequence[str]) -> list[str]:
        """The columns from the left that fit in the width."""
        ends = accumulate(len(GAP) + self._widths[name] for name in names)
        fitting = [
            name
            for name, end in zip(names, ends, strict=True)
            if end - len(GAP) <= self._console.width
        ]
        return list(names[: max(len(fitting), ALWAYS_SHOWN)])

    def _footer(self) -> Table:
        """What stays at the bottom: the bar, and the time of each stage where there is room."""
        footer = Table.grid()
        footer.add_row(self._bar)
        line = Text(self._stage_line(), style="dim")
        room = self._console.height // STAGES_PART
        if self._stages and len(line.wrap(self._console, self._console.width)) <= room:
            footer.add_row(line)
        return footer

    def _stage_line(self) -> str:
        stages = ", ".join(f"{name} {s:.1f}" for name, s in self._stages.items())
        return f"CPU seconds: {stages}"
