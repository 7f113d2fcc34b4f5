"""What is published: the metadata, the page made of the README, the wheel and the sdist."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes, policy
from email.message import EmailMessage
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(!?)\[([^\]]+)\]\(([^)\s]+)\)")


class Built(NamedTuple):
    """A distribution built from the source tree: its metadata and the paths of its files."""

    metadata: EmailMessage
    files: set[str]

    @property
    def page(self) -> str:
        return self.metadata.get_content()


def build(source: Path, folder: Path, target: str) -> Path:
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)],
        cwd=source,
        check=True,
        capture_output=True,
        timeout=120,
    )
    (found,) = folder.glob("*.tar.gz" if target == "sdist" else "*.whl")
    return found


def parsed(metadata: bytes) -> EmailMessage:
    message = message_from_bytes(metadata, policy=policy.default.clone(utf8=True))
    assert isinstance(message, EmailMessage)
    return message


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT, tmp_path_factory.mktemp("sdist"), "sdist")


@pytest.fixture(scope="module")
def of_sdist(sdist: Path) -> Built:
    with tarfile.open(sdist) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
        member = archive.extractfile(f"{sdist.name.removesuffix('.tar.gz')}/PKG-INFO")
        assert member is not None
        return Built(parsed(member.read()), files)


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The wheel as an installer makes it: from the unpacked sdist."""
    folder = tmp_path_factory.mktemp("wheel")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (source,) = folder.iterdir()
    with zipfile.ZipFile(build(source, folder / "dist", "wheel")) as archive:
        files = set(archive.namelist())
        (name,) = (file for file in files if file.endswith(".dist-info/METADATA"))
        return Built(parsed(archive.read(name)), files)


def test_wheel_and_sdist_have_the_same_metadata(wheel: Built, of_sdist: Built) -> None:
    assert wheel.metadata.items() == of_sdist.metadata.items()
    assert wheel.page == of_sdist.page


def test_the_metadata_name_the_paper_the_maturity_and_the_python_versions(wheel: Built) -> None:
    urls = wheel.metadata.get_all("Project-URL", [])
    assert "Paper, https://jmlr.org/papers/v18/16-142.html" in urls
    assert all(re.fullmatch(r"\w+, https://\S+", url) for url in urls)
    classifiers = wheel.metadata.get_all("Classifier", [])
    assert "Development Status :: 4 - Beta" in classifiers
    versions = [c.rpartition(" ")[2] for c in classifiers if re.search(r":: 3\.\d+$", c)]
    assert versions == ["3.11", "3.12", "3.13"]
    assert wheel.metadata["Requires-Python"] == ">=3.11"


def test_no_link_or_picture_of_the_project_page_is_relative(wheel: Built) -> None:
    assert wheel.metadata["Description-Content-Type"] == "text/markdown"
    links = [found[2] for found in LINK.findall(wheel.page)]
    assert [link for link in links if not link.startswith(("https://", "#"))] == []
    assert "](" not in wheel.page.replace("](https://", "")
    assert "low rank (`docs/results/low_rank.md`)" in wheel.page
    assert "(Picture `docs/pictures/swing_up.gif` of the source distribution: " in wheel.page


def test_the_project_page_is_the_readme_but_for_its_links(wheel: Built) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    code = r"(?ms)^```.*?^```$"
    assert re.findall(code, wheel.page) == re.findall(code, readme)
    headings = r"(?m)^#+ .*$"
    assert re.findall(headings, wheel.page) == re.findall(headings, readme)
    for _, text, path in LINK.findall(readme):
        assert text in wheel.page
        assert path.partition("#")[0].removesuffix("README.md") in wheel.page


def test_every_file_that_the_project_page_names_is_in_the_sdist(of_sdist: Built) -> None:
    named = set(re.findall(r"`((?:docs|results|research)/[\w./-]*)`", of_sdist.page))
    assert len(named) >= 15
    for path in named:
        assert path in of_sdist.files or any(file.startswith(path) for file in of_sdist.files)


def test_the_sdist_has_tests_documentation_examples_and_changelog(of_sdist: Built) -> None:
    for name in ("CHANGELOG.md", "README.md", "LICENSE", "CITATION.cff", "CONTRIBUTING.md"):
        assert name in of_sdist.files
    assert {"Makefile", "constraints.txt", "pyproject.toml"} <= of_sdist.files
    for folder, pattern in (
        ("src", "*.py"),
        ("tests", "test_*.py"),
        ("docs", "*.md"),
        ("docs", "*.png"),
        ("examples", "*.py"),
        ("benchmarks", "*.py"),
        ("research", "*.md"),
        ("results", "*.md"),
    ):
        paths = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob(pattern)}
        assert paths
        assert paths - of_sdist.files == set()


def test_the_wheel_has_the_package_and_nothing_else(wheel: Built) -> None:
    version = wheel.metadata["Version"]
    assert {file.split("/")[0] for file in wheel.files} == {"kreps", f"kreps-{version}.dist-info"}
    modules = {path.relative_to(ROOT / "src").as_posix() for path in (ROOT / "src").rglob("*.py")}
    assert modules <= wheel.files
    assert {"kreps/py.typed", "kreps/experiments/search.json"} <= wheel.files
