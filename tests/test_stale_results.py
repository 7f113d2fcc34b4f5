"""Results have a fingerprint: what changes them makes them stale, and what does not leaves them."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kreps.experiments.fingerprint import changes, fingerprint, recorded, script_fingerprint
from kreps.experiments.runner import figure_trials
from kreps.experiments.source import hash_of_file
from kreps.experiments.trials import run_recorded, run_trial, trial_of
from kreps.kernels.gram import gaussian_gram
from kreps.presets import PRESETS

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))
import stale_results  # noqa: E402
from fill_tables import filled  # noqa: E402

FUNCTION = '''
LIMIT = 3.0

def limited(x: float) -> float:
    """The number, or the limit."""
    if x < 0.0:
        raise ValueError("negative")
    return min(x, LIMIT)
'''


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("The number", "A number", True),
        ('    """The number, or the limit."""\n', "", True),
        ("return min", "# a comment\n    return min", True),
        ("x: float", "x: int", True),
        ("negative", "x is below 0", True),
        ("min(x, LIMIT)", "max(x, LIMIT)", False),
        ("3.0", "4.0", False),
        ("x < 0.0", "x < 1.0", False),
    ],
)
def test_a_hash_is_of_what_decides_results(tmp_path: Path, old: str, new: str, same: bool) -> None:
    (tmp_path / "before.py").write_text(FUNCTION)
    (tmp_path / "after.py").write_text(FUNCTION.replace(old, new))
    hashes = {hash_of_file(tmp_path / name) for name in ("before.py", "after.py")}
    assert (len(hashes) == 1) == same


def test_a_fingerprint_has_the_functions_that_ran_and_what_they_name() -> None:
    with recorded() as code:
        gaussian_gram(np.zeros((1, 1)), np.ones((1, 1)))
    assert {"kreps.kernels.gram:gaussian_gram", "kreps.kernels.gram:BLOCK_ENTRIES"} <= code.keys()
    assert "kreps.kernels.kernel:Kernel" not in code
    assert changes(code) == []
    other = {**code, "kreps.kernels.gram:BLOCK_ENTRIES": "0", "kreps.kernels.gram:gone": "0"}
    assert changes(other) == ["kreps.kernels.gram:BLOCK_ENTRIES", "kreps.kernels.gram:gone"]


def test_a_fingerprint_has_the_classes_that_are_made() -> None:
    found = fingerprint(["kreps.learning.evaluate:discounted_average"])
    assert found.keys() >= {"kreps.learning.evaluate:Evaluation"}
    assert "kreps.learning.evaluate:evaluate" not in found


def test_a_script_stands_for_all_modules_that_it_imports() -> None:
    code = script_fingerprint(ROOT / "benchmarks/coverage.py")
    assert {"benchmarks/coverage.py", "kreps.experiments.statistics"} <= code.keys()
    assert "kreps.algorithms.dual" not in code
    assert changes(code) == []
    assert changes({**code, "benchmarks/coverage.py": "0"}) == ["benchmarks/coverage.py"]


# ---- golden values ----------------------------------------------------------------------------

COMPARED = ("steps", "training_reward", "stochastic", "greedy", "samples", "kl", "eta")


@pytest.fixture(scope="module")
def golden() -> list[dict[str, Any]]:
    """The trials of results/golden.csv, run again."""
    return [run_recorded(trial) for trial in figure_trials("golden", 1, 2)]


def test_committed_trials_come_out_the_same_again(golden: list[dict[str, Any]]) -> None:
    """To four digits: the rounding of other processors changes the sixth."""
    with open(ROOT / "results/golden.csv", newline="") as file:
        committed = list(csv.DictReader(file))
    again = [row for result in golden for row in result["rows"]]
    assert [row["method"] for row in committed] == [row["method"] for row in again]
    for old, new in zip(committed, again, strict=True):
        for name in COMPARED:
            assert (old[name] == "") == (name not in new)
            if old[name]:
                assert float(old[name]) == pytest.approx(new[name], rel=1e-4), (old, name)


def test_the_paper_preset_does_not_depend_on_the_model_based_step(
    golden: list[dict[str, Any]],
) -> None:
    paper = golden[0]
    assert paper["trial"]["options"] == {"preset": "paper"}
    assert "kreps.algorithms.reps:reps_step" in paper["code"]
    assert "kreps.algorithms.newton_step:GAP_TOLERANCE" in paper["code"]
    assert "kreps.envs.swing_up:MASS" in paper["code"]
    for name in ("algorithms.model_based:optimise", "models.dynamics:fit_dynamics"):
        assert f"kreps.{name}" not in paper["code"]
    assert not any(name.startswith(("kreps.settings", "kreps.sections")) for name in paper["code"])
    assert paper["settings"]["kl_bound"] == PRESETS["paper"].kl_bound == 0.5


# ---- what is stale ----------------------------------------------------------------------------


def result(folder: Path, **changed: Any) -> Path:
    """A folder with the golden result, changed."""
    content = json.loads((ROOT / "results/golden.json").read_text())
    content["code"] = fingerprint(["kreps.kernels.gram:gaussian_gram"])
    (folder / "golden.json").write_text(json.dumps({**content, **changed}))
    return folder


def test_a_result_is_stale_if_code_or_settings_differ(tmp_path: Path) -> None:
    assert stale_results.reasons("golden", result(tmp_path)) == []
    code = {"kreps.kernels.gram:gaussian_gram": "0"}
    why = stale_results.reasons("golden", result(tmp_path, code=code))
    assert why == ["kreps.kernels.gram:gaussian_gram"]
    content = json.loads((ROOT / "results/golden.json").read_text())
    curve = "swing-up: paper-like"
    content["settings"][curve] |= {"kl_bound": 0.7, "setting_of_a_later_version": 1}
    del content["settings"]["reaching, own start: NPALP (default)"]
    why = stale_results.reasons("golden", result(tmp_path, settings=content["settings"]))
    assert why == ["curve reaching, own start: NPALP (default)", f"{curve}: kl_bound"]


def test_every_result_has_a_command_that_renews_it() -> None:
    assert set(stale_results.names_of()) == set(stale_results.RENEWAL)


def test_pages_say_which_of_their_tables_are_stale(tmp_path: Path) -> None:
    (tmp_path / "one-steps.md").write_text("| a table |\n")
    page = tmp_path / "page.md"
    page.write_text("<!-- results: one-steps -->\n<!-- end of results -->")
    assert "Stale" not in filled(page, tmp_path)
    (tmp_path / "stale.json").write_text('{"one": "kreps reproduce one"}')
    note = (
        "*Stale: the present code or settings may give other numbers.\n"
        "To renew: `kreps reproduce one`.*"
    )
    assert note in filled(page, tmp_path)
    page.write_text(filled(page, tmp_path))
    assert filled(page, tmp_path) == page.read_text()


def test_links_of_a_table_lead_from_the_page_to_the_results(tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results/one.md").write_text("| [all runs](one.csv), [theirs](https://a.org) |\n")
    page = tmp_path / "docs/deep/page.md"
    page.parent.mkdir(parents=True)
    page.write_text("<!-- results: one -->\n<!-- end of results -->")
    shown = "| [all runs](../../results/one.csv), [theirs](https://a.org) |"
    assert shown in filled(page, tmp_path / "results")


def test_the_trial_that_is_not_recorded_has_its_settings_but_no_code() -> None:
    tiny = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "restart_probability": 0.1}
    trial = trial_of("swing-up", "paper-like", 0, tiny, iterations=1, episodes=(2, 2))
    found = run_trial(trial)
    assert found["code"] == {}
    assert found["settings"]["initial_rollouts"] == 6
