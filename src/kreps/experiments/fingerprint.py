"""The code that a result depends on, by definition and hash, and whether it has changed since.

The functions that a trial calls are recorded while it runs.  What its method does not call may
change without making the result stale: work on the default leaves the results of the preset
``paper`` valid.  Settings are not code: results hold their values beside the fingerprint.
"""

from __future__ import annotations

import cProfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from kreps.experiments.source import (
    ROOT,
    hash_of,
    hash_of_file,
    imports_of_file,
    reachable,
    read_all,
    referred,
)

Fingerprint = dict[str, str]
"""Hashes by definition (``module:name``), module, or path from the root of the repository."""

NOT_RESULTS = (
    "kreps.checks",
    "kreps.errors",
    "kreps.legacy",
    "kreps.presets",
    "kreps.sections",
    "kreps.settings",
    "kreps.terminal",
    "kreps.learning.progress",
    "kreps.learning.storage",
)
"""Modules of settings, which results hold by value, of messages and of files."""


PROVENANCE = {f"kreps.experiments.{name}" for name in ("fingerprint", "provenance", "source")}
"""Modules that scripts import to describe their results."""


@contextmanager
def recorded() -> Iterator[Fingerprint]:
    """A fingerprint that holds, after the context, all functions of kreps that ran inside it.

    The functions run a quarter to a third slower.
    """
    read_all()
    found: Fingerprint = {}
    profile = cProfile.Profile(builtins=False, subcalls=False)
    profile.enable()
    try:
        yield found
    finally:
        profile.disable()
        codes = [each.code for each in profile.getstats() if not isinstance(each.code, str)]
        names = (_name_of(code.co_filename, code.co_qualname) for code in codes)
        found |= fingerprint(name for name in names if name is not None)


def _name_of(file: str, qualified: str) -> str | None:
    path = Path(file)
    if not path.is_relative_to(ROOT) or qualified.startswith("<"):
        return None
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    return f"{module}:{qualified.partition('.<locals>')[0]}"


def fingerprint(names: Iterable[str]) -> Fingerprint:
    """The present hashes of definitions, and of all constants and classes that they refer to."""
    open_, found = list(names), Fingerprint()
    while open_:
        name = open_.pop()
        value = hash_of(name)
        if value is None or name in found or name.startswith(NOT_RESULTS):
            continue
        found[name] = value
        open_ += referred(name)
    return dict(sorted(found.items()))


def script_fingerprint(path: Path) -> Fingerprint:
    """The present hashes of a script of the repository and of all modules that it imports.

    For scripts that measure time, which recording would change.
    """
    root = path.resolve().parents[1]
    found = {str(path.resolve().relative_to(root)): hash_of_file(path)}
    for module in sorted(reachable(imports_of_file(path)) - PROVENANCE):
        found[module] = str(hash_of(module))
    return found


def changes(old: Mapping[str, str], repository: Path = ROOT.parents[1]) -> list[str]:
    """What of a fingerprint has another hash now, or is gone.

    Args:
        old: of a result.
        repository: folder that paths of scripts start from.
    """
    return [name for name, value in old.items() if _present(name, repository) != value]


def _present(name: str, repository: Path) -> str | None:
    if not name.endswith(".py"):
        return hash_of(name)
    path = repository / name
    return hash_of_file(path) if path.exists() else None
