"""What the documentation names must exist."""

from __future__ import annotations

import csv
import json
import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from kreps.experiments.figures import markdown_table, named_rows, steps_table
from kreps.experiments.search import search_table
from kreps.experiments.verdicts import claims_table, write_claims

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "benchmarks")]
import coverage  # noqa: E402
import delays  # noqa: E402
import few_data  # noqa: E402
import peers_seconds  # noqa: E402
import peers_table  # noqa: E402
import recorded_data  # noqa: E402
import robot_time  # noqa: E402
import stale_results  # noqa: E402
import suite  # noqa: E402
import suite_peers  # noqa: E402
from fill_tables import filled  # noqa: E402

PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
PAPER_MAP = (ROOT / "docs/paper_map.md").read_text()
MAPPED_NAMES = sorted(set(re.findall(r"`(kreps\.[\w.]+)`", PAPER_MAP)))


def resolve(dotted: str) -> object:
    """The object of a dotted name: the longest importable module, then attributes."""
    words = dotted.split(".")
    for split in range(len(words), 0, -1):
        try:
            found: object = import_module(".".join(words[:split]))
        except ModuleNotFoundError:
            continue
        for word in words[split:]:
            found = getattr(found, word)
        return found
    raise AttributeError(dotted)


def test_the_paper_map_names_every_equation() -> None:
    for item in ("Eq. 1", "Eq. 2", "Eq. 3", "Eq. 4", "Eq. 5", "Algorithm 1"):
        assert f"| {item} |" in PAPER_MAP
    assert len(MAPPED_NAMES) >= 20


@pytest.mark.parametrize("name", MAPPED_NAMES)
def test_each_name_of_the_paper_map_exists(name: str) -> None:
    assert resolve(name) is not None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_table_that_is_shown_has_a_result_file(page: Path) -> None:
    names = re.findall(r"<!-- results: (.+?) -->", page.read_text())
    assert [name for name in names if not (ROOT / f"results/{name}.md").exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_relative_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    broken = [
        link for link in links if "://" not in link and not (page.parent / link).resolve().exists()
    ]
    assert broken == []


def tables_of(page: Path) -> list[str]:
    return re.findall(r"<!-- results: (.+?) -->", page.read_text())


@pytest.mark.parametrize("page", [p for p in PAGES if tables_of(p)], ids=lambda page: page.name)
def test_tables_show_what_the_result_files_hold(page: Path) -> None:
    assert filled(page) == page.read_text()
    for name in tables_of(page):
        table = (ROOT / "results" / f"{name}.md").read_text().strip()
        if name.endswith("-steps"):
            with open(ROOT / "results" / f"{name.removesuffix('-steps')}.csv", newline="") as file:
                assert table == steps_table(named_rows(list(csv.DictReader(file))))
            continue
        if name in ("peers", "robot-time"):
            assert table == {"peers": peers_table, "robot-time": robot_time}[name].table()
            continue
        folder = ROOT / ("src/kreps/experiments" if name == "search" else "results")
        content = json.loads((folder / f"{name}.json").read_text())
        if name == "claims":
            assert table == claims_table(content)
        elif name == "search":
            assert table == search_table(content)
        elif name == "stale":
            assert table == stale_results.table(content)
        elif name == "coverage":
            assert table == coverage.table(content["rows"])
            assert "+" not in content["commit"]
        elif name == "delays":
            assert table == delays.table(content["results"]).strip()
            assert "+" not in content["commit"]
        elif name == "recorded-data":
            assert table == recorded_data.table(content["rows"]).strip()
            assert "+" not in content["commit"]
        elif name in ("suite", "few-data"):
            writer = {"suite": suite, "few-data": few_data}[name]
            assert table == writer.table(content["results"])
            assert "+" not in content["commit"]
        elif name == "suite-peers":
            assert table == suite_peers.table(content["runs"]).strip()
            assert "+" not in content["commit"]
        elif name == "peers-seconds":
            assert table == peers_seconds.table(content["rows"])
            assert "+" not in content["commit"]
        elif name in ("benchmarks", "predict", "low-rank-scale"):  # theirs are not made by kreps
            assert "+" not in (content["facts"] if name == "benchmarks" else content)["commit"]
        else:
            assert table == markdown_table(content["summary"])
            assert "+" not in content["commit"]


def test_claims_are_those_of_the_result_files(tmp_path: Path) -> None:
    if "claims" in json.loads((ROOT / "results/stale.json").read_text()):
        pytest.skip("the claims are declared stale: they may be about other curves")
    for path in (ROOT / "results").glob("figure-*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    write_claims(tmp_path)
    for name in ("claims.json", "claims.md"):
        assert (tmp_path / name).read_text() == (ROOT / "results" / name).read_text()


def test_the_public_names_exist() -> None:
    kreps = import_module("kreps")
    for name in kreps.__all__:
        assert getattr(kreps, name) is not None
    with pytest.raises(AttributeError, match="no attribute"):
        _ = kreps.no_such_name


def test_version_agrees_everywhere() -> None:
    kreps = import_module("kreps")
    assert f'version = "{kreps.__version__}"' in (ROOT / "pyproject.toml").read_text()
    assert f"\nversion: {kreps.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    releases = re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert releases[0] == kreps.__version__


def test_the_changelog_keeps_its_form() -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    unreleased, *releases = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert unreleased == "[Unreleased]" and releases
    assert all(re.fullmatch(r"\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d", each) for each in releases)
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    for part in re.split(r"^## .+$", text, flags=re.MULTILINE)[1:]:
        found = re.findall(r"^### (.+)$", part, re.MULTILINE)
        assert len(found) == len(set(found)) and set(found) <= kinds


def test_the_line_below_the_title_of_the_readme_is_true() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    (status,) = re.findall(r"Status :: \d - (\w+)", "\n".join(project["classifiers"]))
    pythons = f"{', '.join(versions[:-1])} and {versions[-1]}"
    line = f"Python {pythons} | {project['license']} licence | {status.lower()} |"
    assert (ROOT / "README.md").read_text().splitlines()[2].startswith(line)
