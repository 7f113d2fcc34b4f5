"""Files of the repository that pages link to, such as source code and research records, as pages.

A link that is right in the repository, such as ``../src/kreps/settings.py``, leaves the folder of
the documentation.  For the site its target becomes a page (Markdown, source code) or a file
(pictures, tables) below ``repository/``, and the link leads there.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
AREA = "repository"
LINK = re.compile(r"(\]\()([^)#\s]+)([^)\s]*\))")
FENCED = re.compile(r"(^ *```.*?^ *```)", re.MULTILINE | re.DOTALL)
LANGUAGES = {".py": "python", ".toml": "toml"}


def path_of(uri: str) -> str:
    """The path in the repository of a page of the site, given by its source's address."""
    if uri.startswith(f"{AREA}/"):
        path = uri.removeprefix(f"{AREA}/")
        stem = path.removesuffix(".md")
        return stem if (ROOT / stem).is_file() else path
    return f"docs/{uri}"


def uri_of(path: str) -> str:
    """The address in the site of a file of the repository."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    shown = Path(path).suffix in LANGUAGES
    return f"{AREA}/{path}.md" if shown else f"{AREA}/{path}"


def links(path: str, text: str) -> list[str]:
    """The paths in the repository to which the relative links of a page lead."""
    folder = posixpath.dirname(path)
    targets = [target for _, target, _ in LINK.findall("".join(FENCED.split(text)[::2]))]
    return [
        posixpath.normpath(posixpath.join(folder, target))
        for target in targets
        if "://" not in target and not target.startswith("mailto:")
    ]


def content_of(path: str) -> str:
    """The text of a page for a file of the repository."""
    text = (ROOT / path).read_text()
    if path.endswith(".md"):
        return text
    language = LANGUAGES[Path(path).suffix]
    return (
        f'---\nsearch:\n  exclude: true\n---\n# {path}\n\n````{language} linenums="1"\n{text}````\n'
    )


def on_files(files: Files, *, config: Any) -> Files:
    """Add each file outside of docs/ to which a page leads, directly or by other such pages."""
    waiting = [
        found
        for file in files.documentation_pages()
        for found in links(f"docs/{file.src_uri}", file.content_string)
    ]
    seen: set[str] = set()
    while waiting:
        path = waiting.pop()
        if path in seen or path.startswith("docs/") or not (ROOT / path).is_file():
            continue
        seen.add(path)
        uri = uri_of(path)
        if uri.endswith(".md"):
            content = content_of(path)
            files.append(File.generated(config, uri, content=content))
            if path.endswith(".md"):
                waiting += links(path, content)
        else:
            files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Lead the relative links of a page to where their targets are in the site."""
    uri = page.file.src_uri
    path = path_of(uri)
    folder, here = posixpath.dirname(path), posixpath.dirname(uri)

    def moved(found: re.Match[str]) -> str:
        before, target, after = found.groups()
        if "://" in target or target.startswith("mailto:"):
            return found[0]
        goal = posixpath.normpath(posixpath.join(folder, target))
        if goal.startswith("docs/") and path.startswith("docs/"):
            return found[0]
        if (ROOT / goal).is_dir():
            goal += "/README.md"
        return before + posixpath.relpath(uri_of(goal), here or ".") + after

    parts = FENCED.split(markdown)
    parts[::2] = [LINK.sub(moved, part) for part in parts[::2]]
    return "".join(parts)
