"""The progress display in windows of any size: what is on the screen after each iteration."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from kreps.data.task import TaskSpec
from kreps.learning import progress
from kreps.learning.progress import ProgressTable
from kreps.terminal import Output

NOTE = "eta at its floor  rejected: the previous policy acts"


class Update:
    """The report of an update with a long note and many stages."""

    seconds = dict.fromkeys(
        ("basis", "embedding fit", "embedding", "dual", "policy fit", "generated samples"), 0.1
    )

    def shown(self) -> dict[str, str]:
        return {
            "KL / bound": "0.239 / 1",
            "eta": "0.01",
            "ESS": "1733",
            "gap": "3e-08",
            "note": NOTE,
        }


def report(iteration: int, reward: float = -1.234e-6) -> Any:
    return SimpleNamespace(
        iteration=iteration,
        steps=500 * iteration,
        average_reward=reward,
        mean_return=50 * reward,
        update=Update(),
        rollout_seconds=0.1,
        explorer_share=0.0,
    )


def learner(
    exploring: bool = False,
    terminated: bool = False,
    env: gym.Env[Any, Any] | None = None,
    dt: float | None = None,
) -> Any:
    """What the table reads of a learner."""
    rollouts = SimpleNamespace(terminated=np.array([False, terminated]))
    state = SimpleNamespace(window=SimpleNamespace(rollouts=rollouts))
    task = TaskSpec(1, np.array([-1.0]), np.array([1.0]), dt=dt)
    return SimpleNamespace(exploring=exploring, env=env, state=state, task=task)


class Screen:
    """What a terminal of some size has received: all lines, of which the last ones are visible."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.lines, self.row, self.column = [""], 0, 0

    def receive(self, text: str) -> None:
        for part in re.findall(r"\x1b\[[0-9;?]*[A-Za-z]|[^\x1b]", text):
            if part.startswith("\x1b"):
                number = int(re.sub(r"\D", "", part) or 1)
                if part.endswith("A"):  # the cursor stops at the upper edge
                    self.row = max(self.row - number, len(self.lines) - self.height, 0)
                elif part.endswith("K"):
                    self.lines[self.row] = ""
            elif part == "\r":
                self.column = 0
            elif part == "\n" or self.column == self.width:
                self.row, self.column = self.row + 1, 0
                self.lines += [""] * (self.row == len(self.lines))
            if len(part) == 1 and part not in "\r\n":
                line = self.lines[self.row].ljust(self.column)
                self.lines[self.row] = line[: self.column] + part + line[self.column + 1 :]
                self.column += 1

    @property
    def visible(self) -> list[str]:
        return self.lines[-self.height :]


def screens(
    width: int, height: int, iterations: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Screen]:
    """The screen after each iteration."""
    out, screen = io.StringIO(), Screen(width, height)
    console = Console(file=out, force_terminal=True, width=width, height=height)
    monkeypatch.setattr(progress, "Console", lambda: console)
    with ProgressTable(iterations) as table:
        for i in range(1, iterations + 1):
            table(learner(), report(i))
            table._live.refresh()
            screen.receive(out.getvalue())
            out.truncate(0)
            out.seek(0)
            yield screen


@pytest.mark.parametrize(("width", "height"), [(80, 24), (40, 20), (120, 50), (80, 10), (40, 6)])
def test_the_newest_row_the_headings_and_the_bar_are_visible(
    width: int, height: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for i, screen in enumerate(screens(width, height, 30, monkeypatch), start=1):
        lines = screen.visible
        assert any(line.split()[:2] == [str(i), str(500 * i)] for line in lines)
        assert any(line.startswith("iter") for line in lines)
        assert any(f"{i}/30" in line for line in lines)
        assert " ".join(NOTE.split()) in " ".join(" ".join(lines).split())


def test_all_rows_stay_above_and_no_value_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    *_, screen = screens(40, 20, 30, monkeypatch)
    rows = [line.split() for line in screen.lines if re.match(r" *\d+ +\d+ ", line)]
    assert rows == [[str(i), str(500 * i), "-1.234e-06", "0.239", "/", "1"] for i in range(1, 31)]
    assert sum(line.startswith("iter") for line in screen.lines) < 15
    assert "…" not in "".join(screen.lines)


@pytest.mark.parametrize(
    ("width", "headings"),
    [
        (80, "iter steps reward KL / bound eta ESS gap CPU s"),
        (40, "iter steps reward KL / bound"),
        (26, "iter steps reward"),
    ],
)
def test_columns_that_do_not_fit_are_left_out(
    width: int, headings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (screen,) = screens(width, 24, 1, monkeypatch)
    text = " ".join(" ".join(screen.lines).split())
    assert text.startswith(f"{headings} 1 500 -1.234e-06")


def test_a_lost_output_does_not_end_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(progress, "Console", lambda: Console(file=Full()))
    with ProgressTable(2) as table:
        for i in (1, 2):
            table(learner(), report(i))
    assert isinstance(table._console.file, Output)
    assert table._console.file.error is not None


def test_in_a_file_each_iteration_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressTable(2) as table:
        table(learner(exploring=True), report(1))
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("iter 1  steps 500  reward -1.234e-06  KL / bound 0.239 / 1")
    assert "no state-dependent reward: exploring" in first
    assert last.startswith("CPU seconds: rollouts 0.1, basis 0.1")


def test_the_return_is_shown_where_the_task_ends_episodes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    limited = gym.wrappers.TimeLimit(gym.make("kreps/SwingUp-v0"), 80)
    for ends in (learner(env=limited), learner(terminated=True)):
        with ProgressTable(1) as table:
            table(ends, report(1))
        assert "reward -1.234e-06  return -6.17e-05  KL" in capsys.readouterr().out
    with ProgressTable(1) as table:
        table(learner(env=gym.make("kreps/SwingUp-v0")), report(1))
    assert "return" not in capsys.readouterr().out


def test_all_columns_fit_in_eighty_letters_with_a_return(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=80, height=24)
    monkeypatch.setattr(progress, "Console", lambda: console)
    with ProgressTable(1) as table:
        table(learner(terminated=True), report(1))
    assert re.search(r"iter +steps +reward +return +KL / bound.* CPU s", out.getvalue())


def test_the_robot_time_is_shown_where_the_control_period_is_known(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for dt, shown in ((0.05, "steps 1500  robot s 75.0  reward"), (None, "steps 1500  reward")):
        with ProgressTable(3) as table:
            table(learner(dt=dt), report(3))
        assert shown in capsys.readouterr().out


def test_all_columns_fit_in_eighty_letters_with_a_robot_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=80, height=24)
    monkeypatch.setattr(progress, "Console", lambda: console)
    with ProgressTable(30) as table:
        table(learner(terminated=True, dt=0.05), report(30, reward=-22.13))
    assert re.search(r"iter +steps +robot s +reward +return.* CPU s", out.getvalue())
    assert re.search(r"30 +15000 +750\.0 +-22\.13", out.getvalue())
