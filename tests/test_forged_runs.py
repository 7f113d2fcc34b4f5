"""Run folders: forged or damaged text files, and two processes that learn in one folder."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.algorithms.dual import Outcome
from kreps.app import cli
from kreps.app.progress_file import ADDED_COLUMNS, COLUMNS, read_progress
from kreps.app.report import diagnosis_of
from kreps.app.run_folder import RunFolder
from kreps.errors import StorageError
from kreps.learning.storage.lock import locked

NAME = "kreps/SwingUp-v0"
TINY = ["--no-report", "--set", "initial_rollouts=6", "--set", "rollouts_per_iteration=3"]
TINY += ["--set", "restart_probability=0.1"]


def call(*arguments: Any) -> None:
    """A command in this process; what `main` would print as one line is raised."""
    assert cli.app([str(a) for a in arguments], standalone_mode=False) in (None, 0)


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    call("train", NAME, "--out", run, "--iterations", 3, *TINY)
    return run


@pytest.fixture
def run(learnt: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(learnt, tmp_path / "run"))


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def text_of(rows: list[dict[str, str]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0].keys())
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# ---- progress.csv -----------------------------------------------------------------------------

COUNTS = ["iteration", "rollouts", "steps", "samples", "support", "rank", "weighted", "max_rank"]
COUNTS += ["time_limit", "action_repeat"]
POSITIVE = ["kl_bound", "eta", "effective_samples", "ridge"]
NOT_NEGATIVE = [
    *("jitter", "eta_floor", "policy_noise", "model_error", "newton_iterations"),
    *("dynamics_error", "worst_dynamics_error", "worst_coordinate"),
    *("termination_error", "reward_error", "robot_seconds", "policy_kl"),
    *(name for name in COLUMNS if name.startswith("cpu_seconds")),
]
SHARES = ["clipped", "exploring", "rejected", "terminated", "explorer_share"]
SHARES += ["restart_probability"]
ANY_SIZE = ["inf", "-inf", "1e101", "-1e200", "", "x", "1e999", "\x1b[2J", "9" * 5000]
IMPOSSIBLE: dict[str, list[str]] = dict.fromkeys(COLUMNS, ANY_SIZE)
for names, values in (
    (COUNTS, ["0", "-1", "1.5", "2e1", "9" * 400, "1000000000000001"]),
    (POSITIVE, ["0", "-0.0", "-1", "1e-300"]),
    (NOT_NEGATIVE, ["-1", "-1e-9"]),
    (SHARES, ["-0.1", "1.1", "2"]),
    ([name for name in COLUMNS if name not in ADDED_COLUMNS], ["nan"]),
):
    IMPOSSIBLE |= {name: [*IMPOSSIBLE[name], *values] for name in names}


@pytest.mark.parametrize("name", COLUMNS)
def test_impossible_numbers_in_progress_csv_are_an_error_that_names_them(
    name: str, run: Path
) -> None:
    good = rows_of((run / "progress.csv").read_text())
    for value in IMPOSSIBLE[name]:
        (run / "progress.csv").write_text(text_of([*good[:-1], {**good[-1], name: value}]))
        with pytest.raises(StorageError, match=r"progress\.csv is damaged") as caught:
            read_progress(run / "progress.csv")
        assert str(caught.value).isprintable() and len(str(caught.value)) < 400


@pytest.mark.parametrize("numbers", [[1, 2, 2], [3, 2, 1], [1, 3, 2]])
def test_iterations_that_do_not_ascend_are_an_error(numbers: list[int], run: Path) -> None:
    rows = rows_of((run / "progress.csv").read_text())
    for row, number in zip(rows, numbers, strict=True):
        row["iteration"] = str(number)
    (run / "progress.csv").write_text(text_of(rows))
    with pytest.raises(StorageError, match="its iterations do not ascend"):
        RunFolder(run).rows()


POSSIBLE: dict[str, list[str]] = {}
for names, values in (
    (COLUMNS, ["1e100", "-1e100", "0", "1", "1e-100"]),
    (COUNTS, ["1", "1000000000000000"]),
    (POSITIVE, ["1e-100", "1", "1e100"]),
    (NOT_NEGATIVE, ["0", "1", "1e100"]),
    (SHARES, ["0", "1"]),
    (["newton_iterations", "worst_coordinate"], ["0", "1000000000000000"]),
    (["iteration"], ["1000000000000000"]),
    (["outcome"], [*Outcome.__members__]),
):
    POSSIBLE |= dict.fromkeys(names, values)
"""Possible numbers, of all sizes."""


@pytest.mark.parametrize("name", COLUMNS)
def test_any_possible_number_in_progress_csv_can_be_diagnosed(name: str, run: Path) -> None:
    good = rows_of((run / "progress.csv").read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for value in POSSIBLE[name]:
            for rows in ([*good[:-1], {**good[-1], name: value}], [{**good[0], name: value}]):
                (run / "progress.csv").write_text(text_of(rows))
                for finding in diagnosis_of(RunFolder(run)):
                    assert "nan" not in finding.sentence.split()


@pytest.mark.parametrize("choice", range(3))
def test_extreme_numbers_in_progress_csv_can_be_drawn(choice: int, run: Path) -> None:
    good = rows_of((run / "progress.csv").read_text())
    changes = {
        name: POSSIBLE[name][choice % len(POSSIBLE[name])]
        for name in COLUMNS
        if name != "iteration"
    }
    (run / "progress.csv").write_text(text_of([*good[:-1], {**good[-1], **changes}]))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        call("diagnose", run)
        call("plot", run)


def test_damaged_bytes_of_progress_csv_are_read_or_refused(run: Path) -> None:
    path, rng = run / "progress.csv", np.random.default_rng(0)
    content, refused = path.read_bytes(), 0
    for _ in range(300):
        damaged = bytearray(content)
        for _ in range(int(rng.integers(1, 4))):
            damaged[rng.integers(len(content))] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            read_progress(path)
        except StorageError as error:
            assert str(error).isprintable()
            refused += 1
    assert refused > 50


# ---- evaluation.json and config.json ----------------------------------------------------------

EVALUATED: dict[str, Any] = {"mean": -1.0, "standard_error": 0.1, "episodes": 2, "steps": 5}
NO_NUMBERS: list[Any] = ["NaN", "Infinity", "9" * 400, "1e101", "-1e200", '"1"', "null", "[]"]


@pytest.mark.parametrize("field", ["mean", "standard_error"])
@pytest.mark.parametrize("value", [*NO_NUMBERS, "true", "{}", "9" * 5000])
def test_an_evaluation_of_impossible_numbers_is_an_error(field: str, value: str, run: Path) -> None:
    content = json.dumps({"iteration": 3, "stochastic": EVALUATED, "greedy": EVALUATED})
    first = f'"{field}": {EVALUATED[field]}'
    assert content.count(first) == 2
    (run / "evaluation.json").write_text(content.replace(first, f'"{field}": {value}', 1))
    with pytest.raises(StorageError, match=r"evaluation\.json is damaged") as caught:
        call("diagnose", run)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


@pytest.mark.parametrize("content", ["[]", "3", '{"iteration": 3}', '{"stochastic": []}', "\0", ""])
def test_an_evaluation_of_another_form_is_an_error(content: str, run: Path) -> None:
    (run / "evaluation.json").write_text(content)
    with pytest.raises(StorageError, match=r"evaluation\.json is damaged"):
        RunFolder(run).evaluation(3)


def test_an_evaluation_without_a_standard_error_has_none(run: Path) -> None:
    old = {"mean": -2}
    (run / "evaluation.json").write_text(
        json.dumps({"iteration": 3, "stochastic": old, "greedy": EVALUATED})
    )
    assert RunFolder(run).evaluation(3) == {
        "stochastic": {"mean": -2.0, "standard_error": 0.0},
        "greedy": {"mean": -1.0, "standard_error": 0.1},
    }
    assert RunFolder(run).evaluation(2) is None


HOSTILE: list[Any] = [
    *(None, [], {}, 0, 1, -1, 1.5, True, 10**30, 10**400, 1e300, "", "x" * 400),
    *(
        "\x1b[2J\x1b]0;title\x07\n",
        "$a",
        r"$\frac$",
        [1],
        ["x"],
        {"x": 1},
        {"restart_probability": 0},
    ),
]


@pytest.mark.parametrize(
    "field", ["environment", "iterations", "seed", "preset", "settings", "periodic", "arguments"]
)
def test_a_forged_configuration_is_an_error_of_the_library_or_harmless(
    field: str, run: Path
) -> None:
    good = json.loads((run / "config.json").read_text())
    (run / "checkpoint.safetensors").unlink()  # so that the configuration decides
    for value in HOSTILE:
        if field == "iterations" and type(value) is int and value > 0:
            continue  # would be learnt
        (run / "config.json").write_text(json.dumps({**good, "iterations": 0, field: value}))
        for arguments in (("resume", run, "--no-report"), ("plot", run), ("evaluate", run)):
            try:
                call(*arguments)
            except kreps.KrepsError as error:
                assert str(error).isprintable() and len(str(error)) < 2000


@pytest.mark.parametrize(
    "name", ["\x1b[2J\x1b]0;title\x07\n", "$a", r"$\frac$", "x" * 400, "a\udcffb"]
)
def test_any_name_of_an_environment_can_be_shown(
    name: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**good, "environment": name}))
    call("diagnose", run)
    with pytest.raises(kreps.KrepsError):
        call("evaluate", run)
    assert "\x1b" not in capsys.readouterr().out


# ---- paths ------------------------------------------------------------------------------------

LONG = "y" * 300


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", NAME, "--out", LONG, *TINY],
        *([command, LONG] for command in ("resume", "evaluate", "plot", "diagnose", "video")),
        ["export", LONG, "--out", "x.safetensors"],
        ["export", "run", "--out", f"{LONG}.safetensors"],
        ["diagnose", "run", "--out", f"{LONG}.png"],
        ["video", "run", "--out", f"{LONG}.gif", "--steps", "2"],
    ],
)
def test_a_path_that_is_too_long_is_an_error_of_the_library(
    arguments: list[str], run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    with pytest.raises(kreps.KrepsError):
        call(*arguments)
    assert [path.name for path in run.parent.iterdir()] == ["run"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", NAME, "--out", "", *TINY],
        *([command, ""] for command in ("resume", "evaluate", "plot", "diagnose", "video")),
        ["export", "", "--out", "x.safetensors"],
        ["export", "run", "--out", ""],
        ["diagnose", "run", "--out", ""],
        ["video", "run", "--out", ""],
        ["reproduce", "figure-1a", "--out", ""],
        ["search", "--out", ""],
    ],
)
def test_an_empty_path_is_not_the_current_folder(
    arguments: list[str], run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    with pytest.raises(Exception, match="the path is empty") as caught:
        call(*arguments)
    assert hasattr(caught.value, "show")  # is a usage error, which `main` prints
    assert [path.name for path in run.parent.iterdir()] == ["run"]


# ---- one process at a time --------------------------------------------------------------------


@pytest.fixture
def busy(run: Path) -> Iterator[Path]:
    """A run in which another process learns."""
    code = "import sys, time; from kreps.app.run_folder import RunFolder\n"
    code += "with RunFolder(sys.argv[1]).learning():\n    print('in', flush=True); time.sleep(600)"
    other = subprocess.Popen([sys.executable, "-c", code, str(run)], stdout=subprocess.PIPE)
    assert other.stdout is not None and other.stdout.readline() == b"in\n"
    yield run
    other.kill()
    other.wait()


def test_two_processes_do_not_learn_in_one_folder(busy: Path) -> None:
    before = {path.name: path.read_bytes() for path in busy.iterdir()}
    for arguments in (
        ["resume", busy, "--iterations", 4, "--no-report"],
        ["train", NAME, "--out", busy, *TINY],
    ):
        with pytest.raises(StorageError, match=r"run is in use by process \d+ on .*; wait until"):
            call(*arguments)
    assert {path.name: path.read_bytes() for path in busy.iterdir()} == before
    call("diagnose", busy)  # reading is not learning


def test_a_folder_is_free_after_a_kill_and_cleared_of_what_was_left(run: Path) -> None:
    code = "import os, sys; from kreps.app.run_folder import RunFolder\n"
    code += "with RunFolder(sys.argv[1]).learning():\n    os.kill(os.getpid(), 9)"
    done = subprocess.run([sys.executable, "-c", code, str(run)], check=False)
    assert done.returncode == -9 and (run / ".lock").exists()
    for name in ("config.json", "progress.csv", "policy.safetensors", "checkpoint.safetensors"):
        (run / f".{name}.0123456789abcdef.part").write_bytes(b"half")
    (run / ".notes.txt.0123456789abcdef.part").write_bytes(b"of another program")
    call("resume", run, "--iterations", 4, "--no-report")
    hidden = [path.name for path in run.iterdir() if path.name.startswith(".")]
    assert hidden == [".notes.txt.0123456789abcdef.part"]


def test_a_lock_is_taken_by_one_at_a_time_and_leaves_nothing(tmp_path: Path) -> None:
    with locked(tmp_path / ".lock"):
        assert (tmp_path / ".lock").read_text().startswith("process ")
        for _ in range(2):
            with (
                pytest.raises(StorageError, match="is in use by process"),
                locked(tmp_path / ".lock"),
            ):
                pass
    assert [*tmp_path.iterdir()] == []
    with locked(tmp_path / ".lock"):
        pass


def test_where_no_lock_can_be_made_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot write"), locked(tmp_path / "missing" / ".lock"):
        pass
