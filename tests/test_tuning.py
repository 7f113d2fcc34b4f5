"""Studies of settings: what a trial is worth, pruning, sharing, and what is left at the end."""

from __future__ import annotations

import csv
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.app import cli
from kreps.app.cli.tune import parse_range
from kreps.app.run_folder import RunConfig
from kreps.app.tuning import DEFAULT_SPACE, Choice, Interval, space_for
from kreps.errors import ConfigurationError

NAME = "kreps/SwingUp-v0"
TINY = [
    *("--preset", "single_step", "--restart-probability", "0.1", "--iterations", "3"),
    *("--initial-rollouts", "3", "--rollouts-per-iteration", "2", "--seeds", "1", "--window", "4"),
]
SEARCH = ["--search", "kl_bound=0.1:3:log", "--search", "exploration.noise=pink,gaussian"]
CONFIG = RunConfig(NAME, 3, 0, "model_based", {}, None)


def call(*arguments: str | Path) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["kreps", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    return int(stop.value.code or 0)


def tune(out: Path, trials: int, *more: str) -> int:
    return call("tune", NAME, "--trials", str(trials), "--out", out, *TINY, *SEARCH, *more)


def rows(out: Path) -> list[dict[str, str]]:
    with open(out / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


# ---- ranges -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "name", "wanted"),
    [
        ("kl_bound=0.1:3", "kl_bound", Interval(0.1, 3.0)),
        ("kl_bound=1e-1:3:log", "kl_bound", Interval(0.1, 3.0, log=True)),
        ("window=10:60", "window", Interval(10, 60, whole=True)),
        ("exploring_starts=0:1", "exploring_starts", Interval(0.0, 1.0)),
        ("exploration.noise=pink,gaussian", "exploration.noise", Choice(("pink", "gaussian"))),
        ("low_rank=none,low_rank", "low_rank", Choice((None, "low_rank"))),
        ("value.size=5,10", "value.size", Choice((5, 10))),
    ],
)
def test_ranges_are_read_by_the_type_of_the_setting(text: str, name: str, wanted: Any) -> None:
    assert parse_range(text) == (name, wanted)


@pytest.mark.parametrize("text", ["kl_bound", "a=1", "a=3:1", "a=0:1:log", "a=x:y", "a=1:inf"])
def test_what_is_no_range_is_rejected(text: str) -> None:
    with pytest.raises(ConfigurationError, match="NAME=LOW:HIGH:log with LOW above 0, or NAME=A,B"):
        parse_range(text)


def test_the_space_leaves_out_what_is_fixed_or_absent() -> None:
    assert space_for(CONFIG, {}) == DEFAULT_SPACE
    fixed = RunConfig(NAME, 3, 0, "model_based", {"kl_bound": 0.5, "model_based": None}, None)
    assert set(space_for(fixed, {})) == {"exploring_starts", "exploration.noise"}
    for space, says in (
        ({"kl_bound": Interval(0.1, 1.0)}, "kl_bound is fixed to 0.5 and searched as well"),
        ({"kl_bond": Interval(0.1, 1.0)}, "kl_bond"),
        ({"exploring_starts": Interval(0.0, 2.0)}, "exploring_starts = 2"),
        ({"model": Choice(("dynamics", "cake"))}, "cake"),
    ):
        with pytest.raises(ConfigurationError, match=says):
            space_for(fixed, space)


def test_without_optuna_the_remedy_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert tune(tmp_path / "study", 1) == 2
    assert "pip install 'kreps[tune]'" in capsys.readouterr().err


# ---- studies ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("optuna")
    out = tmp_path_factory.mktemp("tuning") / "study"
    assert tune(out, 7) == 0
    return out


def test_a_trial_is_worth_the_evaluated_reward_of_its_settings(study: Path) -> None:
    best = rows(study)[0]
    assert best["state"] == "complete"
    evaluation = kreps.EvalCallback()
    kreps.KREPS(
        gym.make(NAME),
        preset="single_step",
        restart_probability=0.1,
        initial_rollouts=3,
        rollouts_per_iteration=2,
        window=4,
        kl_bound=float(best["kl_bound"]),
        exploration=best["exploration.noise"],
    ).learn(3, callback=evaluation, progress=False)
    assert float(best["reward"]) == evaluation.evaluations[-1][1].mean


def test_only_trials_below_the_median_are_pruned(study: Path) -> None:
    import optuna
    from optuna.storages.journal import JournalFileBackend

    storage = optuna.storages.JournalStorage(JournalFileBackend(str(study / "study.log")))
    trials = optuna.load_study(study_name="kreps", storage=storage).trials
    assert [trial.number for trial in trials] == list(range(7))
    pruned = [trial for trial in trials if trial.state.name == "PRUNED"]
    assert pruned
    for trial in pruned:
        updates = max(trial.intermediate_values)
        others = [t.intermediate_values for t in trials[: trial.number] if t.state.name != "PRUNED"]
        assert len(others) >= 5 and updates < 3
        median = np.median([each[updates] for each in others])
        assert max(trial.intermediate_values.values()) < median
    states = {row["trial"]: row["state"] for row in rows(study)}
    assert {int(n) for n, state in states.items() if state == "pruned"} == {
        trial.number for trial in pruned
    }


def test_a_study_that_was_stopped_goes_on_as_if_it_was_not(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune(tmp_path / "parts", 3) == 0
    assert len(rows(tmp_path / "parts")) == 3
    assert tune(tmp_path / "parts", 7) == 0
    assert (tmp_path / "parts/trials.csv").read_bytes() == (study / "trials.csv").read_bytes()
    printed = capsys.readouterr().out
    assert "Importance" in printed and "kl_bound" in printed
    assert (tmp_path / "parts/importance.png").stat().st_size > 10_000
    command = shlex.split(printed.strip().splitlines()[-1])
    best = rows(study)[0]
    assert command[:3] == ["kreps", "train", NAME]
    assert f"kl_bound={best['kl_bound']}" in command and "window=4" in command
    assert command[command.index("--seed") + 1] == "1"  # the first one that no trial has used
    assert tune(tmp_path / "parts", 7, "--ridge", "0.2") == 2
    assert "another settings; give what it was begun with" in capsys.readouterr().err


def test_processes_share_a_study(tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    out = tmp_path / "study"
    command = [sys.executable, "-m", "kreps", "tune", NAME, "--trials", "3", "--out", str(out)]
    workers = [subprocess.Popen([*command, *TINY, *SEARCH]) for _ in range(2)]
    assert [worker.wait() for worker in workers] == [0, 0]
    found = rows(out)
    assert 3 <= len(found) <= 4  # both may be at work on the last one
    assert len({row["kl_bound"] for row in found}) == len(found)
