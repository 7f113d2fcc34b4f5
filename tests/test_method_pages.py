"""The pages of docs/methods: one skeleton, and everything they name must be as they say."""

from __future__ import annotations

import ast
import inspect
import operator
import pkgutil
import re
from dataclasses import MISSING, fields, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import kreps.evaluation
import numpy as np
import pytest

from kreps.algorithms import npalp, reps, value_iteration
from kreps.algorithms.generated import MAX_GENERATED
from kreps.experiments.search import CANDIDATES
from kreps.experiments.specs import FIGURES, METHODS
from kreps.kernels.kernel import IMAGE_BLUR
from kreps.learning.learner import IterationReport, Learner
from kreps.learning.methods import LEARNERS
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.settings import PRESETS, Settings

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs/methods"
INDEX = FOLDER / "README.md"
PAGES = sorted(path for path in FOLDER.glob("*.md") if path != INDEX)
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)

HEADINGS = [
    "Idea",
    "Equations",
    "When to use it",
    "Metrics",
    "Results",
    "Command",
    "Parameters",
    "Choices",
]
KERNEL_PAGE = (FOLDER / "kernel_reps.md").read_text()

METHOD_OF_PAGE = {
    "kernel_reps": "kernel REPS",
    "sample_model": "REPS, sample model",
    "feature_reps": "REPS, RBF grid",
    "value_iteration": "value iteration",
    "grid_value_iteration": "value iteration on a grid (simulator set to any state)",
    "npalp": "NPALP",
}
REPORT_OF_LEARNER: dict[str, type[Any]] = {
    "reps": reps.UpdateInfo,
    "value-iteration": value_iteration.ValueIterationInfo,
    "grid-value-iteration": value_iteration.ValueIterationInfo,
    "npalp": npalp.NPALPInfo,
}


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def section(page: Path, heading: str) -> str:
    found = re.search(
        rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", page.read_text(), re.DOTALL | re.MULTILINE
    )
    assert found, heading
    return found[1]


def table_rows(text: str) -> list[list[str]]:
    """The cells of the first table in a text, without its heading."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def figures_of(method: str) -> list[str]:
    return [
        name
        for name, curves in FIGURES.items()
        if name.startswith("figure-") and method in {of_curve for _, of_curve in curves}
    ]


def differ(a: object, b: object, name: str) -> bool:
    return bool(getattr(a, name) != getattr(b, name))


def anchor(heading: str) -> str:
    """The link to a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


# ---- the skeleton -----------------------------------------------------------------------------


def test_there_is_a_page_for_every_compared_method() -> None:
    assert {page.stem for page in PAGES} == set(METHOD_OF_PAGE)
    compared = {name for name, method in METHODS.items() if method.tuned}
    assert set(METHOD_OF_PAGE.values()) == compared
    index = INDEX.read_text()
    for page in PAGES:
        figures = ", ".join(name[7:] for name in figures_of(METHOD_OF_PAGE[page.stem]))
        row = next(row for row in table_rows(index) if f"({page.name})" in row[0])
        method = METHODS[METHOD_OF_PAGE[page.stem]]
        assert f"`{LEARNERS[method.learner].__name__}`" in row[4]
        named = re.findall(r'`(\w+)="(.+?)"`', row[4])
        assert dict(named) == dict(method.options)
        assert row[-1].rstrip(" |") == figures
    assert index.index("one_update.md") > index.index("Reading order")


@EVERY_PAGE
def test_each_page_has_the_same_headings_in_the_same_order(page: Path) -> None:
    text = without_code(page.read_text())
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == HEADINGS
    assert len(re.findall(r"^# .+$", text, re.MULTILINE)) == 1
    for heading in HEADINGS:
        assert len(section(page, heading).strip()) > 100, heading
    assert f'"{METHOD_OF_PAGE[page.stem]}"' in " ".join(text.split("## Idea")[0].split())


@pytest.mark.parametrize("page", [INDEX, *PAGES], ids=lambda page: page.stem)
def test_lines_are_short(page: Path) -> None:
    lines = page.read_text().splitlines()
    assert [line for line in lines if len(line) > 115 and not line.startswith("|")] == []


# ---- what is named exists ---------------------------------------------------------------------


@pytest.mark.parametrize("page", [INDEX, *PAGES], ids=lambda page: page.stem)
def test_relative_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
        if "://" in link:
            continue
        target, _, heading = link.partition("#")
        path = (page.parent / target).resolve()
        assert path.exists()
        if heading:
            assert heading in map(anchor, re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE))


@EVERY_PAGE
def test_dotted_names_exist_in_the_files_that_they_link_to(page: Path) -> None:
    text = page.read_text()
    names = re.findall(r"`(kreps\.[\w.]+)`", text)
    linked = re.findall(r"\[`(kreps\.[\w.]+)`\]\(([^)]+)\)", text)
    assert len(linked) == len(names) >= 6
    for name, link in linked:
        found = pkgutil.resolve_name(name)
        path = (page.parent / link).resolve()
        if inspect.isclass(found) or inspect.isroutine(found):
            assert inspect.getsourcefile(found) == str(path), name
        else:
            home = pkgutil.resolve_name(name.rpartition(".")[0])
            assert isinstance(home, ModuleType) and home.__file__ == str(path), name


@EVERY_PAGE
def test_every_equation_names_what_computes_it(page: Path) -> None:
    steps = re.split(r"^\d+\. ", section(page, "Equations"), flags=re.MULTILINE)[1:]
    assert len(steps) >= 5
    silent = [step for step in steps if "[`kreps." not in step]
    # the linear program as it is printed, and the size of a grid, are computed by no function
    assert len(silent) <= (1 if page.stem in ("npalp", "grid_value_iteration") else 0)


# ---- results and commands ---------------------------------------------------------------------


@EVERY_PAGE
def test_the_figures_are_those_that_show_the_method(page: Path) -> None:
    text = section(page, "Results")
    wanted = figures_of(METHOD_OF_PAGE[page.stem])
    shown = re.findall(r"<!-- results: (.+?) -->\n.*?\n?<!-- end of results -->", text, re.DOTALL)
    assert shown == wanted
    assert re.findall(r"!\[[^\]]+\]\(\.\./\.\./results/(.+?)\.png\)", text) == wanted


@EVERY_PAGE
def test_the_commands_are_those_of_the_method(page: Path) -> None:
    text, method = section(page, "Command"), METHOD_OF_PAGE[page.stem]
    reproduced = re.findall(r"^kreps reproduce (\S+) --trials 10 --workers 2$", text, re.MULTILINE)
    assert reproduced == figures_of(method)
    searched = re.findall(r"^kreps search (\S+)$", text, re.MULTILINE)
    assert searched == [task for task, methods in CANDIDATES.items() if method in methods]
    trained = re.findall(r"^kreps train \S+ (.*)--out \S+$", text, re.MULTILINE)
    if METHODS[method].learner == "reps":
        (asked,) = trained
        options = dict(re.findall(r"--(recipe) (\S+)", asked))
        options |= dict(re.findall(r"--set (\w+)=(\w+)", asked))
        assert options == dict(METHODS[method].options)
    else:
        assert trained == [] and "`kreps train` learns by REPS only" in " ".join(text.split())


# ---- parameters -------------------------------------------------------------------------------


@EVERY_PAGE
def test_the_table_of_parameters_agrees_with_the_settings(page: Path) -> None:
    method = METHODS[METHOD_OF_PAGE[page.stem]]
    settings = LEARNERS[method.learner].settings_type
    text = section(page, "Parameters")
    assert f"[`kreps.settings.{settings.__name__}`]" in text
    rows = table_rows(text)
    assert all(len(row) == 4 for row in rows)
    shown = {name.strip("`"): ast.literal_eval(default.strip("`")) for name, default, *_ in rows}
    assert all(f.default is not MISSING for f in fields(settings))
    wanted = {f.name: f.default for f in fields(settings)}
    assert shown == wanted
    assert all(type(shown[name]) is type(wanted[name]) for name in wanted)
    for name, value in method.options.items():
        assert f'`{name}="{value}"`' in text


@pytest.mark.parametrize("recipe", [name for name in PRESETS if name != "default"])
def test_what_a_recipe_changes_is_said(recipe: str) -> None:
    changed = {f.name for f in fields(Settings) if differ(PRESETS[recipe], Settings(), f.name)}
    (sentence,) = re.findall(
        rf'^`recipe="{recipe}"` changes (.+?);', KERNEL_PAGE, re.MULTILINE | re.DOTALL
    )
    assert set(re.findall(r"`(\w+)`", sentence)) == changed


def test_how_the_default_departs_from_the_paper_recipe_is_said() -> None:
    changed = {f.name for f in fields(Settings) if differ(PRESETS["paper"], Settings(), f.name)}
    deviations = (ROOT / "docs/deviations.md").read_text()
    listed = deviations.split("## What the default recipe changes")[1].split("\n## ")[0]
    items = re.findall(
        r'^\d\. `(\w+) = (\S+)`(?: instead of `?([\w."]+\w"?)`?)?', listed, re.MULTILINE
    )
    assert {name for name, *_ in items} == changed
    numbers = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    assert f"in {numbers[len(changed)]} settings" in listed
    for name, default, paper in items:
        assert getattr(Settings(), name) == ast.literal_eval(default)
        if paper:
            assert getattr(PRESETS["paper"], name) == ast.literal_eval(paper)


def test_limits_are_those_of_the_code() -> None:
    sweeps = f"{value_iteration.MAX_SWEEPS} is the limit"
    for name in ("value_iteration", "grid_value_iteration"):
        assert sweeps in (FOLDER / f"{name}.md").read_text()
    assert f"{npalp.MAX_IMPROVEMENTS} is the limit" in (FOLDER / "npalp.md").read_text()
    assert f"more than {MAX_SUPPORT} are refused" in KERNEL_PAGE
    assert f"smoothing of {IMAGE_BLUR:g} of their side" in KERNEL_PAGE
    assert f"of them but at most {MAX_GENERATED}" in KERNEL_PAGE
    (least,) = re.findall(
        r"^   model's own error, .* and at least `(\S+)`:$", KERNEL_PAGE, re.MULTILINE
    )
    assert float(least) == reps.MIN_RIDGE


# ---- metrics, and the example -----------------------------------------------------------------


def reported(info: Any, name: str) -> Any:
    return operator.attrgetter(name)(info)


@EVERY_PAGE
def test_the_example_runs_and_reports_what_the_page_explains(
    page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With few and short roll-outs, a coarse grid and one update."""
    reports: list[IterationReport] = []
    tiny = {
        "initial_rollouts": 3,
        "restart_probability": 0.1,
        "grid_states": 4,
        "grid_actions": 3,
        "grid_size": 4,
        "actions": 5,
    }
    learn = Learner.learn

    def learn_little(self: Learner[Any], iterations: int) -> Learner[Any]:
        changes = {n: v for n, v in tiny.items() if n in {f.name for f in fields(self.settings)}}
        self.settings = replace(self.settings, **changes)
        assert iterations >= 1
        return learn(self, 1, callback=lambda _, report: reports.append(report), progress=False)

    monkeypatch.setattr(Learner, "learn", learn_little)
    short = partial(kreps.evaluation.evaluate, episodes=2, steps=5)
    monkeypatch.setattr(kreps.evaluation, "evaluate", short)
    (code,) = re.findall(
        r"^```python\n(.*?)^```", section(page, "Command"), re.DOTALL | re.MULTILINE
    )
    found: dict[str, Any] = {}
    exec(compile(code, str(page), "exec"), found)

    learner = found["learner"]
    method = METHODS[METHOD_OF_PAGE[page.stem]]
    assert type(learner) is LEARNERS[method.learner]
    options = dict(method.options)
    recipe = options.pop("recipe", None)
    for name, value in options.items():
        assert getattr(learner.settings, name) == value
    if recipe is not None:
        protocol = {"exploration", "exploration_scale"}
        changed = {
            f.name for f in fields(Settings) if differ(learner.settings, PRESETS[recipe], f.name)
        }
        assert changed <= options.keys() | tiny.keys() | protocol
    assert np.isfinite([float(word) for word in capsys.readouterr().out.split()]).all()

    (report,) = reports
    kind = REPORT_OF_LEARNER[method.learner]
    assert type(report.update) is kind
    text = section(page, "Metrics")
    assert f"[`{kind.__module__}.{kind.__name__}`]" in text
    rows = table_rows(text)
    assert all(len(row) == 3 for row in rows)
    explained = [row[0].strip("`") for row in rows]
    for name in explained:
        reported(report.update, name)
    assert set(report.update.numbers()) <= {name.rpartition(".")[2] for name in explained}
    if page.stem not in ("sample_model", "feature_reps"):  # they refer to the first page
        assert {f.name for f in fields(kind)} - {"dual"} <= set(explained)
