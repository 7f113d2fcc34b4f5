"""The pages of docs/methods: the same skeleton, and statements that agree with the code."""

from __future__ import annotations

import ast
import inspect
import operator
import pkgutil
import re
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import kreps
from kreps import settings
from kreps.algorithms import npalp, reps, value_iteration
from kreps.algorithms.report import UpdateInfo
from kreps.experiments.search import CANDIDATES
from kreps.experiments.specs import COLUMNS, FIGURES, METHODS, Method
from kreps.kernels.kernel import IMAGE_BLUR
from kreps.learning.iteration import IterationReport
from kreps.learning.methods import LEARNERS
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.presets import PRESETS, changed, flat
from kreps.settings import Settings

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
    "kernel_reps": "kernel REPS (paper)",
    "sample_model": "REPS, sample model (paper)",
    "feature_reps": "REPS, RBF grid (paper)",
    "value_iteration": "value iteration (default)",
    "grid_value_iteration": "value iteration on a grid (default)",
    "npalp": "NPALP (default)",
}
"""Of each page, the method in the column of the printed text."""
REPORT_OF_LEARNER: dict[str, type[Any]] = {
    "reps": UpdateInfo,
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


def given(method: Method) -> dict[str, Any]:
    """The options of a method that are not the default of its class."""
    return {name: value for name, value in method.options.items() if value != "default"}


def changed_fields(preset: str) -> set[str]:
    """Names of the fields, sections as a whole, in which a preset differs from the default."""
    default = Settings()
    return {
        f.name
        for f in fields(Settings)
        if getattr(PRESETS[preset], f.name) != getattr(default, f.name)
    }


def anchor(heading: str) -> str:
    """The anchor of a heading, as on GitHub."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


# ---- the skeleton -----------------------------------------------------------------------------


def test_there_is_a_page_for_every_compared_method() -> None:
    assert {page.stem for page in PAGES} == set(METHOD_OF_PAGE)
    compared = {name for columns in COLUMNS.values() for _, name in columns["As printed"]}
    assert set(METHOD_OF_PAGE.values()) == compared
    index = INDEX.read_text()
    for page in PAGES:
        figures = ", ".join(name[7:] for name in figures_of(METHOD_OF_PAGE[page.stem]))
        row = next(row for row in table_rows(index) if f"({page.name})" in row[0])
        method = METHODS[METHOD_OF_PAGE[page.stem]]
        assert f"`{LEARNERS[method.learner].__name__}`" in row[4]
        named = re.findall(r'`(\w+)="(.+?)"`', row[4])
        assert dict(named) == given(method)
        assert row[-1].rstrip(" |") == figures
    assert index.index("one_update.md") > index.index("Reading order")


@EVERY_PAGE
def test_each_page_has_the_same_headings_in_the_same_order(page: Path) -> None:
    text = without_code(page.read_text())
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == HEADINGS
    assert len(re.findall(r"^# .+$", text, re.MULTILINE)) == 1
    for heading in HEADINGS:
        assert len(section(page, heading).strip()) > 100, heading
    name = METHOD_OF_PAGE[page.stem].partition(" (")[0]
    assert f'"{name}", with the preset in brackets' in " ".join(text.split("## Idea")[0].split())


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
            file = inspect.getsourcefile(found)
        else:
            home = pkgutil.resolve_name(name.rpartition(".")[0])
            assert isinstance(home, ModuleType), name
            file = home.__file__
        # relative, as the package that is tested may be an installed one
        module = Path(str(file)).relative_to(Path(kreps.__file__).parents[1])
        assert ROOT / "src" / module == path, name


@EVERY_PAGE
def test_every_equation_names_what_computes_it(page: Path) -> None:
    steps = re.split(r"^\d+\. ", section(page, "Equations"), flags=re.MULTILINE)[1:]
    assert len(steps) >= 5
    silent = [step for step in steps if "[`kreps." not in step]
    # the linear program as it is printed, and the size of a grid, are computed by no function
    assert len(silent) <= (1 if page.stem in ("npalp", "grid_value_iteration") else 0)


# ---- results and commands ---------------------------------------------------------------------


@EVERY_PAGE
def test_the_figures_are_those_with_the_method(page: Path) -> None:
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
    name = method.partition("(")[0]
    assert searched == [
        task for task, methods in CANDIDATES.items() if any(m.startswith(name) for m in methods)
    ]
    trained = re.findall(r"^kreps train \S+ (.*)--out \S+$", text, re.MULTILINE)
    if METHODS[method].learner == "reps":
        (asked,) = trained
        options = dict(re.findall(r"--(preset) (\S+)", asked))
        options |= dict(re.findall(r"--set (\w+)=(\w+)", asked))
        assert options == given(METHODS[method])
    else:
        assert trained == [] and "`kreps train` learns by REPS only" in " ".join(text.split())


# ---- parameters -------------------------------------------------------------------------------


@EVERY_PAGE
def test_the_table_of_parameters_agrees_with_the_settings(page: Path) -> None:
    method = METHODS[METHOD_OF_PAGE[page.stem]]
    kind = LEARNERS[method.learner].settings_type
    text = section(page, "Parameters")
    assert f"[`kreps.settings.{kind.__name__}`]" in text
    rows = table_rows(text)
    assert all(len(row) == 4 for row in rows)
    shown = {name.strip("`"): ast.literal_eval(default.strip("`")) for name, default, *_ in rows}
    # of the features of V, each page has the parameters of the kind that it is about
    of_value = {name: value for name, value in method.options.items() if name == "value"}
    wanted = flat(changed(kind(), of_value))
    assert shown == wanted
    assert all(type(shown[name]) is type(wanted[name]) for name in wanted)
    for name, value in given(method).items():
        assert f'`{name}="{value}"`' in text


@pytest.mark.parametrize("preset", ["single_step", "paper", "authors"])
def test_the_page_has_the_settings_that_a_preset_changes(preset: str) -> None:
    (sentence,) = re.findall(
        rf'^`preset="{preset}"` changes (.+?);', KERNEL_PAGE, re.MULTILINE | re.DOTALL
    )
    assert set(re.findall(r"`(\w+)`", sentence)) == changed_fields(preset)


def test_the_differences_of_the_default_and_the_preset_paper_are_listed() -> None:
    deviations = (ROOT / "docs/deviations.md").read_text()
    listed = deviations.split("## What the default preset changes")[1].split("\n## ")[0]
    items = re.findall(r"^\d+\. `(\w+) = ([^`]+)` instead of `([^`]+)`", listed, re.MULTILINE)
    assert {name for name, *_ in items} == changed_fields("paper")
    assert "in fourteen settings" in listed and len(items) == 14
    names = vars(settings)
    for name, default, paper in items:
        assert getattr(Settings(), name) == eval(default, dict(names))
        assert getattr(PRESETS["paper"], name) == eval(paper, dict(names))


def test_the_limits_on_the_pages_are_those_of_the_code() -> None:
    assert value_iteration.MAX_SWEEPS == 300
    for name in ("value_iteration", "grid_value_iteration"):
        assert "300 is the limit" in (FOLDER / f"{name}.md").read_text()
    assert npalp.MAX_IMPROVEMENTS == 1000
    assert "1000 is the limit" in (FOLDER / "npalp.md").read_text()
    words = " ".join(KERNEL_PAGE.split())
    assert MAX_SUPPORT == 6000
    assert "more than 6000 raise an error" in words
    assert IMAGE_BLUR == 0.3
    assert "smoothing of 0.3 of their side" in words
    assert settings.ModelBased().max_samples == 20_000
    assert "at most `model_based.max_samples` (20000)" in words
    assert reps.MIN_RIDGE == 1e-3
    assert "and it is at least `1e-3`" in words


# ---- metrics, and the example -----------------------------------------------------------------

TINY = {
    "initial_rollouts": 3,
    "restart_probability": 0.1,
    "grid_states": 4,
    "grid_actions": 3,
    "value.size": 4,
    "actions": 5,
}
"""Settings of few and short rollouts, and of coarse grids."""


class Reduced(ast.NodeTransformer):
    """Changes the example of a page: few and short rollouts, one update, a short evaluation.

    Args:
        changes: of the learner's settings.
    """

    def __init__(self, changes: dict[str, Any]) -> None:
        self.changes = changes

    def visit_Call(self, node: ast.Call) -> ast.Call:
        self.generic_visit(node)
        name = ast.unparse(node.func)
        if name in {kind.__name__ for kind in LEARNERS.values()}:
            extra = f"f(**{self.changes!r})"
        elif name == "learner.learn":
            node.keywords = [k for k in node.keywords if k.arg != "iterations"]
            extra = "f(iterations=1, callback=keep, progress=False)"
        elif name == "evaluate":
            extra = "f(episodes=2, steps=5)"
        else:
            return node
        call = ast.parse(extra, mode="eval").body
        assert isinstance(call, ast.Call)
        node.keywords += call.keywords
        return node


def reported(info: Any, name: str) -> Any:
    return operator.attrgetter(name)(info)


@EVERY_PAGE
def test_the_example_runs_and_reports_the_fields_of_the_page(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(
        r"^```python\n(.*?)^```", section(page, "Command"), re.DOTALL | re.MULTILINE
    )
    method = METHODS[METHOD_OF_PAGE[page.stem]]
    kind = LEARNERS[method.learner]
    options = {name: value for name, value in method.options.items() if name != "preset"}
    preset = PRESETS.get(method.options["preset"])
    of_method = changed(preset or kind.settings_type(), options)
    tiny = {name: value for name, value in TINY.items() if name in flat(of_method)}
    reports: list[IterationReport] = []
    found: dict[str, Any] = {"keep": lambda _, report: reports.append(report)}
    tree = ast.fix_missing_locations(Reduced(tiny).visit(ast.parse(code)))
    exec(compile(tree, str(page), "exec"), found)

    learner = found["learner"]
    assert type(learner) is kind
    ours, theirs = flat(learner.settings), flat(changed(of_method, tiny))
    differing = {name for name in ours if ours[name] != theirs[name]}
    of_example = {"exploration.noise", "exploration.scale", "ranges", "lipschitz"}
    assert differing <= of_example
    assert np.isfinite([float(word) for word in capsys.readouterr().out.split()]).all()

    (report,) = reports
    info = REPORT_OF_LEARNER[method.learner]
    assert type(report.update) is info
    text = section(page, "Metrics")
    assert f"[`{info.__module__}.{info.__name__}`]" in text
    rows = table_rows(text)
    assert all(len(row) == 3 for row in rows)
    explained = [row[0].strip("`") for row in rows]
    for name in explained:
        reported(report.update, name)
    assert set(report.update.numbers()) <= {name.rpartition(".")[2] for name in explained}
    if page.stem not in ("sample_model", "feature_reps"):  # these refer to the first page
        assert {f.name for f in fields(info)} - {"dual", "held_out"} <= set(explained)
