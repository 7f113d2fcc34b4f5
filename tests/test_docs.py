"""What the documentation names must exist."""

from __future__ import annotations

import json
import re
from importlib import import_module
from pathlib import Path

import pytest

from kreps.experiments.runner import markdown_table

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
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
def test_relative_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    broken = [
        link for link in links if "://" not in link and not (page.parent / link).resolve().exists()
    ]
    assert broken == []


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_tables_show_what_the_result_files_hold(page: str) -> None:
    text = (ROOT / page).read_text()
    shown = re.findall(r"<!-- results: (.+?) -->\n(.*?)\n?<!-- end of results -->", text, re.DOTALL)
    assert shown
    for name, table in shown:
        content = json.loads((ROOT / "results" / f"{name}.json").read_text())
        assert table == markdown_table(content["summary"])
        assert content["command"] in text
        assert not content["commit"].endswith("+")


def test_the_public_names_exist() -> None:
    kreps = import_module("kreps")
    for name in kreps.__all__:
        assert getattr(kreps, name) is not None
    with pytest.raises(AttributeError, match="no attribute"):
        _ = kreps.no_such_name


def test_version_agrees_everywhere() -> None:
    kreps = import_module("kreps")
    assert f'version = "{kreps.__version__}"' in (ROOT / "pyproject.toml").read_text()
    assert f"version: {kreps.__version__}" in (ROOT / "CITATION.cff").read_text()
