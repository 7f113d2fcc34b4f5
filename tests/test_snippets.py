"""Every snippet of README and of the site runs, and prints what its page shows.

Tutorials run as they are.  Elsewhere names that a page takes for granted, such as a robot, are
given here, and learning is made short.  The pages of docs/methods have a test of their own.
"""

from __future__ import annotations

import ast
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from threading import current_thread, main_thread
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import gymnasium as gym
import numpy as np
import pytest
import typer.main
from recorded import columns_of, rollouts

import kreps
from kreps.app.cli import app

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = ROOT / "docs/tutorials"
RECORDED_DATA = ROOT / "docs/recorded_data.md"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if p.parent.name != "methods"),
]
FENCE = re.compile(r'^```(\w*)(?: title="(.+?)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Language, title and text of each code block of a page."""
    return FENCE.findall(page.read_text())


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


# ---- what pages take for granted --------------------------------------------------------------

TASK = kreps.TaskSpec(observation_size=2, action_low=[-30.0], action_high=[30.0])


def recordings(count: int = 4) -> list[kreps.Rollout]:
    rng = np.random.default_rng(0)
    return [
        kreps.Rollout(rng.normal(size=(31, 2)), 9.0 * rng.normal(size=(30, 1)), rng.normal(size=30))
        for _ in range(count)
    ]


def recorded_policy() -> kreps.Policy:
    learner = kreps.KREPS(TASK, preset="single_step")
    learner.update(recordings())
    return learner.policy


class Arm:
    """A robot of two numbers."""

    state = np.zeros(2)

    def go_to_start(self) -> None:
        self.state = np.ones(2)

    def read(self) -> Any:
        return self.state

    def send(self, action: Any) -> None:
        self.state = 0.9 * self.state + 0.01 * np.asarray(action)


class Clock:
    """Time that passes by the sleep of the program only, not by that of a watchdog's thread."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        if current_thread() is main_thread():
            self.now += seconds
        else:
            time.sleep(0.01)


class Turns:
    """True for a number of questions."""

    def __init__(self, turns: int) -> None:
        self.left = turns

    def __bool__(self) -> bool:
        self.left -= 1
        return self.left >= 0


def robot() -> dict[str, Any]:
    return {
        "arm": Arm(),
        "clock": Clock(),
        "reward_of": lambda observation, action: -float(observation @ observation),
        "fell": lambda observation: False,
    }


def of_readme() -> dict[str, Any]:
    kreps.save_rollouts(recordings(), Path("recordings/0.safetensors"))
    rng = np.random.default_rng(0)
    arrays = {"observations": rng.normal(size=(21, 2)), "actions": rng.normal(size=(20, 1))}
    return {
        **robot(),
        **arrays,
        "rewards": rng.normal(size=20),
        "pool": ThreadPoolExecutor(1),
    }


def of_low_rank() -> dict[str, Any]:
    kreps.save_rollouts(recordings(), Path("recordings/0.safetensors"))
    return {"kreps": kreps, "task": TASK, "ProcessPoolExecutor": ThreadPoolExecutor}


def of_export() -> dict[str, Any]:
    recorded_policy().save("swing-up.safetensors")
    return {}


class Executor:
    """In place of submitit's: a job is a command whose options are checked."""

    def __init__(self, folder: str) -> None:
        pass

    def update_parameters(self, **given: Any) -> None:
        pass

    def map_array(self, function: Any, lines: list[list[str]]) -> list[Any]:
        for _, *words in lines:
            check_options(words)
        return [SimpleNamespace(result=lambda: 0) for _ in lines]


def of_tuning() -> dict[str, Any]:
    Path("submitit.py").write_text(f"from {__name__} import Executor as AutoExecutor\n")
    return {}


def of_loggers() -> dict[str, Any]:
    run = SimpleNamespace(config=MagicMock(), log=MagicMock())
    return {"wandb": SimpleNamespace(init=lambda **_: nullcontext(run))}


def of_checksums() -> dict[str, Any]:
    recorded_policy().compressed(10).export_onnx("policy.onnx")
    return {}


def of_delays() -> dict[str, Any]:
    return {
        "kreps": kreps,
        "env": gym.make("kreps/SwingUp-v0"),
        "policy": recorded_policy(),
        "running": Turns(3),
        "observation": np.zeros(2),
    }


def of_recorded_data() -> dict[str, Any]:
    """The description of the robot on the page, and a recording with its columns."""
    (spec,) = [text for language, _, text in blocks(RECORDED_DATA) if language == "toml"]
    Path("robot.toml").write_text(spec)
    columns = columns_of(rollouts((30, 30, 30)))
    rows, header = np.column_stack(list(columns.values())), ",".join(columns)
    np.savetxt("recording.csv", rows, delimiter=",", header=header, comments="")
    return {}


TAKEN_FOR_GRANTED: dict[str, Callable[[], dict[str, Any]]] = {
    "README.md": of_readme,
    "docs/decisions/0018-checksums.md": of_checksums,
    "docs/delays.md": of_delays,
    "docs/how_to/export.md": of_export,
    "docs/how_to/loggers.md": of_loggers,
    "docs/how_to/tuning.md": of_tuning,
    "docs/results/low_rank.md": of_low_rank,
    "docs/recorded_data.md": of_recorded_data,
    "docs/real_robot.md": lambda: {"kreps": kreps, **robot()},
}


class Reduced(ast.NodeTransformer):
    """Makes learning short: one update of one step from few and short rollouts."""

    def visit_List(self, node: ast.List) -> ast.List:
        node.elts = [e for e in node.elts if not (isinstance(e, ast.Constant) and e.value is ...)]
        return node

    def visit_Call(self, node: ast.Call) -> ast.Call:
        self.generic_visit(node)
        changes: dict[str, str] = {}
        match ast.unparse(node.func).rpartition(".")[2]:
            case "KREPS":
                changes = {"initial_rollouts": "3", "restart_probability": "0.1"}
                if all(k.arg not in ("preset", None) for k in node.keywords):
                    changes["preset"] = "'single_step'"
            case "learn":
                node.args = []
                changes = {"iterations": "1", "progress": "False"}
            case "rollouts":
                changes = {"updates": "1"}
            case "session":
                changes = {"clock": "clock", "watchdog": "1e4"}  # which is in real time
        node.keywords = [k for k in node.keywords if k.arg not in changes]
        for name, value in changes.items():
            node.keywords.append(ast.keyword(name, ast.parse(value, mode="eval").body))
        return node


# ---- snippets run -----------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty current folder, with the examples importable."""
    registered = set(gym.registry)
    (tmp_path / "recordings").mkdir()
    monkeypatch.chdir(tmp_path)
    for modules in (tmp_path, ROOT / "examples"):
        monkeypatch.syspath_prepend(str(modules))
    yield tmp_path
    for module in (*(ROOT / "examples").glob("*.py"), *tmp_path.glob("*.py")):
        sys.modules.pop(module.stem, None)
    for name in set(gym.registry) - registered:
        del gym.registry[name]


def run(code: str, page: Path, names: dict[str, Any], *, whole: bool) -> None:
    tree: Any = ast.parse(code)
    if not whole:
        tree = ast.fix_missing_locations(Reduced().visit(tree))
    exec(compile(tree, name_of(page), "exec"), names)


PAGES_WITH_CODE = [page for page in PAGES if any(b[0] == "python" for b in blocks(page))]


@pytest.mark.parametrize("page", [p for p in PAGES_WITH_CODE if p.parent != TUTORIALS], ids=name_of)
def test_the_snippets_of_a_page_run(
    page: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"__name__": "snippet", **TAKEN_FOR_GRANTED.get(name_of(page), dict)()}
    for language, _, code in blocks(page):
        if language == "python":
            run(code, page, names, whole=False)
    assert "Traceback" not in capsys.readouterr().err


# ---- tutorials run as they are, and print what they show --------------------------------------


def alike(shown: str, printed: str) -> bool:
    """Whether two words are equal, or numbers that differ by a fifth at most."""
    if shown == printed:
        return True
    try:
        a, b = (float(word.strip("(),;:%")) for word in (shown, printed))
    except ValueError:
        return False
    return abs(a - b) <= 0.2 * abs(a)


def differing(shown: str, printed: str) -> list[tuple[str, str]]:
    """The lines that are shown and do not agree with any line that follows in what was printed.

    A line ``...`` stands for lines that are not shown.
    """
    rest, missing = printed.splitlines(), []
    for line in shown.splitlines():
        if line.strip() == "...":
            continue
        words = line.split()
        for number, other in enumerate(rest):
            found = other.split()
            if len(found) == len(words) and all(map(alike, words, found)):
                rest = rest[number + 1 :]
                break
        else:
            missing.append((line, "\n".join(rest)))
    return missing


def command(line: str) -> None:
    """Run a line of a terminal, ``kreps ...``, in this process."""
    words = shlex.split(line.removeprefix("$ "), comments=True)
    assert words[0] == "kreps", line
    app(words[1:], standalone_mode=False)


@pytest.mark.parametrize("page", sorted(TUTORIALS.glob("*.md")), ids=lambda page: page.stem)
def test_a_tutorial_runs_and_prints_what_it_shows(
    page: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names: dict[str, Any] = {"__name__": "tutorial"}
    printed = ""
    for language, title, text in blocks(page):
        if title:
            assert text == (ROOT / "examples" / title).read_text()
        elif language == "python":
            run(text, page, names, whole=True)
            printed = capsys.readouterr().out
        elif language == "console":
            line, _, shown = text.partition("\n")
            command(line)
            assert differing(shown, capsys.readouterr().out) == []
        elif language == "text":
            assert differing(text, printed) == []


def test_what_is_shown_and_not_printed_is_found() -> None:
    printed = "3 rollouts\nreward -1.5\n"
    assert differing("...\nreward -1.4\n", printed) == []
    assert differing("reward -3.0\n", printed) == [("reward -3.0", printed.strip())]
    assert differing("reward -1.5\n3 rollouts\n", printed) == [("3 rollouts", "")]
    assert differing("reward\n", printed) != []


# ---- commands of the pages are commands of the program ----------------------------------------


def check_options(words: list[str]) -> None:
    """Let the program read the words after ``kreps``; options that it has not are an error."""
    group = typer.main.get_command(app)
    assert isinstance(group, typer.main.TyperGroup)
    group.commands[words[0]].make_context(words[0], words[1:])


def commands(page: Path) -> list[str]:
    lines = "\n".join(text for language, _, text in blocks(page) if language in ("", "console"))
    joined = lines.replace("\\\n", " ")
    return [line.removeprefix("$ ") for line in re.findall(r"^(?:\$ )?kreps .+$", joined, re.M)]


METHODS = sorted((ROOT / "docs/methods").glob("*.md"))
PAGES_WITH_COMMANDS = [page for page in [*PAGES, *METHODS] if commands(page)]


@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS, ids=name_of)
def test_commands_have_options_that_exist(page: Path) -> None:
    for line in commands(page):
        _, *words = shlex.split(line, comments=True)
        if words != ["--version"]:
            check_options(words)
