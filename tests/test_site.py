"""What the pages of the site take from the code and from README."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from kreps.app.cli import app
from kreps.presets import PRESETS, flat

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs/hooks"))
import reference  # noqa: E402
import sections  # noqa: E402


def cells(name: str) -> list[str]:
    (row,) = re.findall(
        rf"^\| `{re.escape(name)}` \|(.+)\|$", reference.settings().split("## Val")[0], re.M
    )
    return [cell.strip() for cell in row.split(" | ")]


def test_the_table_of_settings_has_each_setting_once_with_its_values() -> None:
    for name, value in flat(PRESETS["model_based"]).items():
        if name not in ("exploration", "value", "low_rank", "model_based"):
            default, *_ = cells(name)
            assert default.startswith(f"`{value!r}`"), name
    default, kind, meaning = cells("kl_bound")
    assert default == "`1.0`<br>paper, authors: `0.5`" and kind == "float" and "Eq. 2" in meaning
    default, kind, _ = cells("rollout_lengths")
    assert default == "`'stratified'`<br>single_step, paper, authors: `'independent'`"
    assert kind == "'independent' or 'stratified'"
    assert cells("history")[1] == "int or 'auto'"


def test_the_page_of_the_command_line_has_every_command_and_option() -> None:
    text = reference.command_line()
    names = [command.name or command.callback.__name__ for command in app.registered_commands]  # type: ignore[union-attr]
    assert re.findall(r"^## kreps (\w+)$", text, re.M) == names
    assert "| `--iterations <int range>` | Policy updates to make; 20 if not given" in text
    assert "[bold]" not in text


def test_pages_have_a_mark_for_everything_that_is_generated() -> None:
    pages = [path.read_text() for path in (ROOT / "docs").rglob("*.md")]
    marks = [name for text in pages for name in reference.MARK.findall(text)]
    assert sorted(marks) == sorted(reference.GENERATED)


def test_a_section_of_the_readme_has_links_that_lead_from_docs() -> None:
    text = sections.section("When to use it, and when not")
    assert "](../research/2026-tables-of-deviations.md#policy-acceptance-test)" in text
    assert "\n## " not in text and "Do not use it where" in text
    with pytest.raises(ValueError, match="no section 'Nothing'"):
        sections.section("Nothing")
