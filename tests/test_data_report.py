"""What is noticed in a recording, the commands on it, and how far a policy extrapolates from it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import DT, NAMES, columns_of, table_of
from test_cli import call, rejected

import kreps
from kreps.app.data_report import (
    data_report,
    frozen_values,
    left_out,
    sampling,
    saturated_actions,
    suspicious_values,
    wrapped_angles,
)
from kreps.app.diagnosis import Finding
from kreps.app.report import diagnosis_of
from kreps.app.run_folder import RunFolder
from kreps.data.rollouts import Rollout, Rollouts
from kreps.data.task import TaskSpec
from kreps.learning.extrapolation import extrapolation_of
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.recordings.columns import columns_of as as_columns
from kreps.recordings.recording import Recording, recording_of

TASK = TaskSpec(2, [-1.0], [1.0], dt=DT)
STEPS = 60


def pushes(count: int = 8, seed: int = 0, gain: float = 0.0, noise: float = 0.4) -> Rollouts:
    """A mass that is pushed by a linear controller with Gaussian noise."""
    rng, made = np.random.default_rng(seed), []
    for number in range(count):
        points, actions = [rng.normal(size=2)], []
        for _ in range(STEPS):
            x, v = points[-1]
            actions.append([gain * v + noise * rng.normal()])
            push = np.clip(actions[-1][0], -1.0, 1.0) + 0.1 * rng.normal()
            points.append(np.array([x + DT * v, 0.95 * v + push]))
        o, times = np.array(points), DT * np.arange(STEPS + 1) + 10.0 * number
        made.append(Rollout(o, actions, -(o[:-1, 0] ** 2), times=times))
    return Rollouts.from_list(made)


CLEAN = columns_of(pushes())


def recorded(**changed: Any) -> Recording:
    columns = {**{name: values.copy() for name, values in CLEAN.items()}, **changed}
    return recording_of(table_of(columns), as_columns(NAMES))


def one(report: Any, recording: Recording, *task: TaskSpec) -> tuple[str, str]:
    """Severity and sentence of the only finding of a function."""
    made = report(recording, *task)
    (finding,) = [made] if isinstance(made, Finding) else made
    return finding.severity, finding.sentence


def test_a_clean_recording_has_no_finding_that_is_not_fine() -> None:
    report = data_report(recorded(), TASK)
    assert [each for each in report if each.severity != "fine"] == []
    names = {each.name for each in report}
    assert names >= {"sampling", "missing values", "suspicious values", "saturated actions"}
    assert names >= {"idle columns", "delay or hidden state"}
    assert report[0].sentence.startswith("The control period is 0.05 s (20 Hz); it varies by 0.0%")


def test_each_fault_is_found_with_its_rows() -> None:
    row, rng = 100, np.random.default_rng(0)
    jitter = CLEAN["t"] + 0.4 * DT * rng.uniform(-0.5, 0.5, len(CLEAN["t"]))
    severity, sentence = one(sampling, recorded(t=jitter), TASK)
    assert severity == "note" and "the longest is 0.06" in sentence
    severity, sentence = one(sampling, recorded(t=2.0 * CLEAN["t"]), TASK)
    assert severity == "limit" and sentence.endswith("The dt of the task is 0.05 s.")
    later = CLEAN["t"] + 3 * DT * (np.arange(len(CLEAN["t"])) > row)
    assert one(left_out, recorded(t=later)) == (
        "note",
        "About 3 rows missing in 1 gap, after row 100; rollouts are cut there.",
    )
    angle = CLEAN["angle"].copy()
    angle[row] = np.nan
    severity, sentence = one(left_out, recorded(angle=angle))
    assert severity == "note" and sentence.startswith("angle has no finite number in row 100;")
    angle[row] = 1e6
    severity, sentence = one(suspicious_values, recorded(angle=angle))
    assert severity == "limit" and sentence.startswith("angle is 1e+06 in row 100, ")
    angle[row : row + 15] = angle[row + 1]
    severity, sentence = one(frozen_values, recorded(angle=angle))
    assert (severity, sentence) == ("note", "angle has the same value in 15 rows, from row 100.")
    severity, sentence = one(saturated_actions, recorded(torque=np.sign(CLEAN["torque"])), TASK)
    assert (severity, sentence) == (
        "note",
        "torque is at a limit or beyond it in 100% of the steps.",
    )
    severity, sentence = one(saturated_actions, recorded(torque=0.0 * CLEAN["torque"]), TASK)
    assert severity == "limit" and sentence.startswith("torque never changes")


def test_a_full_report_has_what_needs_the_task() -> None:
    cost = -(np.clip(CLEAN["torque"], -1.0, 1.0) ** 2)
    report = data_report(recorded(velocity=2.0 * CLEAN["angle"], gain=cost), TASK)
    by_name = {each.name: each for each in report}
    assert by_name["reward"].severity == "limit"
    assert "velocity is a copy of angle" in by_name["idle columns"].sentence
    assert by_name["delay or hidden state"].remedy.endswith("(--set history=auto).")


def test_angles_that_wrap_are_found_in_either_unit() -> None:
    turns = np.arange(len(CLEAN["t"])) * 0.3
    for unit, scale in (("rad", 1.0), ("degrees", 180.0 / np.pi)):
        wrapped = recorded(angle=scale * (np.mod(turns + np.pi, 2 * np.pi) - np.pi))
        severity, sentence = one(wrapped_angles, wrapped, TASK)
        assert severity == "limit" and f"an angle in {unit} that is taken for a number" in sentence
        assert "after row 10, row 31, row 52 and " in sentence
    periodic = TaskSpec(2, [-1.0], [1.0], periodic=(0,), dt=DT)
    wrapped = recorded(angle=np.mod(turns + np.pi, 2 * np.pi) - np.pi)
    assert one(wrapped_angles, wrapped, periodic)[0] == "fine"
    assert list(wrapped_angles(recorded(angle=turns), TASK)) == []


# ---- extrapolation ----------------------------------------------------------------------------


def controller(gain: float, offset: float, noise: float) -> CostSensitiveGP:
    """A policy that is linear in the velocity, up to the smoothness of its kernel."""
    rng = np.random.default_rng(1)
    states = np.column_stack([rng.normal(size=300), 2.0 * rng.normal(size=300)])
    from kreps.kernels.kernel import Kernel, factors_of

    return CostSensitiveGP(
        TASK,
        Kernel(factors_of(2), np.array([5.0, 5.0])),
        states,
        gain * states[:, 1:] + offset,
        np.ones(300),
        signal=1.0,
        noise=noise**2,
    )


def test_extrapolation_is_none_of_the_recorded_controller_and_grows_with_the_distance() -> None:
    rollouts = pushes(gain=-0.2, noise=0.15)
    rng = np.random.default_rng(0)
    results = [
        extrapolation_of(controller(-0.2, offset, 0.15), rollouts, rng)
        for offset in (0.0, 0.2, 0.6)
    ]
    same, near, far = results
    assert same.steps == rollouts.steps == 480
    assert same.outside < 0.1 and same.effective_samples > 0.7 * same.steps
    # of a Gaussian that is shifted by z standard deviations the share is exp(-z^2)
    assert near.effective_samples / near.steps == pytest.approx(np.exp(-16 / 9), abs=0.12)
    assert near.outside < 0.2
    assert far.outside > 0.8 and far.effective_samples < 0.05 * far.steps
    assert str(far).startswith("the policy takes actions outside the data in ")
    with pytest.raises(kreps.DataError, match="no rollout"):
        extrapolation_of(controller(0.0, 0.0, 0.1), [], rng)


# ---- commands ---------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Rollouts as ``kreps import`` writes them, and their spec."""
    kreps.save_rollouts(pushes(6), tmp_path / "pushes.safetensors")
    spec = tmp_path / "robot.toml"
    spec.write_text("[task]\naction_low = [-1.0]\naction_high = [1.0]\n")
    return tmp_path / "pushes.safetensors", spec


def test_import_reports_and_writes_rollouts(files: tuple[Path, Path], tmp_path: Path) -> None:
    data, spec = files
    out = tmp_path / "rollouts.safetensors"
    code, text = call("import", data, "--spec", spec, "--out", out)
    assert code == 0
    assert "366 rows; 6 rollouts of 360 steps, 0 of them terminated; 2 observation coord" in text
    assert "Fine: sampling. The control period is 0.05 s" in text
    np.testing.assert_array_equal(kreps.load_rollouts(out).points, pushes(6).points)
    first = ["--column", "observations=observations[1],observations[0]"]
    code, text = call("import", data, *first, "--column", "reward=rewards")
    assert code == 0 and "Give the action limits in [task]" in text
    assert "2 observation coordinates (observations[1], observations[0])" in text
    code, text = call("import", data)
    assert code == 0 and "observations x 2: -" in text  # the columns are listed
    wrong = ["--column", "observations=angle"]
    assert "no column 'angle'; there are observations, " in rejected("import", data, *wrong)
    assert "ends in .safetensors" in rejected("import", data, "--out", tmp_path / "r.csv")
    assert "is not NAME=COLUMN" in rejected("import", data, "--column", "angle")


def test_a_first_policy_is_learnt_from_recorded_data_alone(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    data, spec = files
    run = tmp_path / "run"
    small = ["--set", "model_based=none"]
    code, text = call("train", "--data", data, "--spec", spec, "--out", run, *small)
    assert code == 0
    assert "Extrapolation: the policy takes actions outside the data in" in text
    learner = kreps.KREPS.resume(run / "checkpoint.safetensors")
    assert (learner.state.steps, learner.task.dt, learner.settings.window) == (360, DT, None)
    # the same bytes as from the library
    again = kreps.KREPS(learner.task, window=None, model_based=None)
    again.update(kreps.read_rollouts(data, spec))
    states = np.array([[1.0, 0.0], [-1.0, 0.0]])
    actions, _ = again.policy.predict(states, deterministic=True)
    np.testing.assert_array_equal(learner.policy.predict(states, deterministic=True)[0], actions)
    assert kreps.load_policy(run / "policy.safetensors").extrapolation(pushes(2)).steps == 120
    # what needs an environment says so
    for command in ("evaluate", "resume"):
        assert "this run is from recorded data and has no environment" in rejected(command, run)
    assert "give either an environment" in rejected("train", "--out", tmp_path / "x")
    both = ["train", "Pendulum-v1", "--data", data, "--out", tmp_path / "x"]
    assert "give either an environment" in rejected(*both)
    more = ["train", "--data", data, "--spec", spec, "--iterations", "3", "--out", tmp_path / "x"]
    assert "recorded data give one update" in rejected(*more)
    assert not (tmp_path / "x").exists()


def test_no_remedy_for_recorded_data_needs_an_environment(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    data, spec = files
    still = [Rollout(r.observations, r.actions, 0.0 * r.rewards) for r in pushes(6)]
    kreps.save_rollouts(still, data)
    run = tmp_path / "run"
    code, text = call("train", "--data", data, "--spec", spec, "--out", run)
    assert code == 0 and "goal. No rollout" in text and "resume" not in text
    found = {finding.name: finding.remedy for finding in diagnosis_of(RunFolder(run))}
    assert "goal" in found and "progress" not in found
    assert "resume" not in " ".join(found.values())


def test_the_commands_of_the_page_about_recorded_data_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pd = pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    pd.DataFrame(columns_of(pushes(2))).to_csv("recording.csv", index=False)
    page = (Path(__file__).resolve().parents[1] / "docs/recorded_data.md").read_text()
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", page, re.M | re.S)
    (spec,) = [text for language, text in blocks if language == "toml"]
    Path("robot.toml").write_text(spec)
    commands = [line for language, text in blocks if not language for line in text.splitlines()]
    imports = [line.split()[1:] for line in commands if line.startswith("kreps import rec")]
    assert len(imports) == 2
    for arguments in imports:
        assert call(*arguments)[0] == 0
    assert len(kreps.load_rollouts("rollouts.safetensors")) == 2
