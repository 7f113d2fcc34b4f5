"""Writes the tables of ``results/`` into the documentation pages: ``make tables``.

The text between ``<!-- results: NAME -->`` and ``<!-- end of results -->`` is a copy of
``results/NAME.md``, with its links as from the page.  Below it stands whether the result is stale
(``results/stale.json``).
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(\]\()(?!https?:|#)([^)]+\))")
SHOWN = re.compile(r"(<!-- results: (.+?) -->\n)(.*?)\n?(<!-- end of results -->)", re.DOTALL)


def filled(page: Path, results: Path = ROOT / "results") -> str:
    """The text of a page with its tables replaced by those of the result files.

    A table without a result file is removed.
    """
    folder = Path(os.path.relpath(results, page.parent)).as_posix()

    declared = results / "stale.json"
    stale = json.loads(declared.read_text()) if declared.exists() else {}

    def table(match: re.Match[str]) -> str:
        path = results / f"{match[2]}.md"
        content = path.read_text().strip() + "\n" if path.exists() else ""
        content = LINK.sub(rf"\1{folder}/\2", content)
        command = stale.get(match[2].removesuffix("-steps"))
        if content and command:
            content += (
                "\n*Stale: the present code or settings may give other numbers.\n"
                f"To renew: `{command}`.*\n"
            )
        return match[1] + content + match[4]

    return SHOWN.sub(table, page.read_text())


if __name__ == "__main__":
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        before = page.read_text()
        after = filled(page)
        if after != before:
            page.write_text(after)
            print(f"filled {page.relative_to(ROOT)}")
