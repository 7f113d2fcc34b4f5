"""Writes measurements: numbers and provenance as JSON, a table as Markdown."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from measuring import Measured
from peak import Peak
from threadpoolctl import threadpool_info

from kreps.experiments.fingerprint import script_fingerprint
from kreps.experiments.provenance import commit
from kreps.experiments.tables import markdown
from kreps.versions import versions

BENCHMARKS = sorted(Path(__file__).parent.glob("bench_*.py"))

HEADINGS = ("work", "size", "CPU s", "MB", "number", "unit", "limit", "met")


def facts(command: str) -> dict[str, Any]:
    """The machine, libraries and commit that the numbers depend on."""
    blas = [
        {
            key: library[key]
            for key in ("internal_api", "prefix", "version", "architecture", "num_threads")
        }
        for library in threadpool_info()
        if library["user_api"] == "blas"
    ]
    return {
        "command": command,
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "code": {k: v for path in BENCHMARKS for k, v in script_fingerprint(path).items()},
        "cpu": _cpu_model(),
        "blas": blas,
        "versions": versions(),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def rows(done: Sequence[Measured], peak: float) -> list[dict[str, Any]]:
    """One row per benchmark and criterion."""
    return [
        {
            "work": measured.work,
            "size": measured.size,
            "cpu_seconds": min(measured.times),
            "cpu_seconds_median": median(measured.times),
            "rounds": len(measured.times),
            "memory_bytes": measured.memory,
            "reference_cpu_seconds": {
                name: min(measured.references[name]) for name in criterion.references
            },
            "number": number,
            "of_what": criterion.text,
            "at_least": criterion.at_least,
            "at_most": criterion.at_most,
            "met": (criterion.at_least is None or number >= criterion.at_least)
            and (criterion.at_most is None or number <= criterion.at_most)
            if _limit(criterion.at_least, criterion.at_most)
            else None,
            **measured.details,
        }
        for measured in done
        for criterion, number in measured.numbers(peak)
    ]


def _limit(at_least: float | None, at_most: float | None) -> str:
    parts = [] if at_least is None else [f">= {at_least:g}"]
    return ", ".join(parts if at_most is None else [*parts, f"<= {at_most:g}"])


def table(found: Sequence[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    return markdown(
        HEADINGS,
        [
            (
                row["work"],
                row["size"],
                f"{row['cpu_seconds']:.3g}",
                "" if row["memory_bytes"] is None else f"{row['memory_bytes'] / 1e6:.3g}",
                f"{row['number']:.3g}",
                row["of_what"],
                _limit(row["at_least"], row["at_most"]),
                {True: "yes", False: "**no**", None: ""}[row["met"]],
            )
            for row in found
        ],
    )


def stages(done: Sequence[Measured]) -> str:
    """A table of CPU seconds by stage, for the benchmarks that have stages."""
    staged = [measured for measured in done if "stages" in measured.details]
    names = list(staged[0].details["stages"]) if staged else []
    return markdown(
        ["CPU s by stage", *names],
        [
            [measured.work, *(f"{measured.details['stages'][name]:.3f}" for name in names)]
            for measured in staged
        ],
    )


def description(about: dict[str, Any], peak: Peak) -> str:
    libraries = ", ".join(
        f"{b['internal_api']} {b['version']} for {b['architecture']} with {b['num_threads']} "
        f"thread{'s' if b['num_threads'] > 1 else ''}"
        for b in about["blas"]
    )
    return (
        f"Peak: {peak.best / 1e9:.1f} GFLOP per CPU second, the best float64 matrix product of "
        f"this run. {about['cpu']}; {libraries}. `{about['command']}`, {about['date']}, "
        f"commit {about['commit']}."
    )


def write(folder: Path, done: Sequence[Measured], peak: Peak, command: str) -> None:
    """Write ``benchmarks.json`` and ``benchmarks.md`` into ``folder``."""
    about = facts(command)
    found = rows(done, peak.best)
    content = {
        "facts": about,
        "peak_flops": peak.best,
        "peak_probes": [{"n": n, "flops": rate} for n, rate in peak.probes],
        "rows": found,
    }
    folder.mkdir(exist_ok=True)
    (folder / "benchmarks.json").write_text(json.dumps(content, indent=1) + "\n")
    (folder / "benchmarks.md").write_text(
        f"{description(about, peak)}\n\n{table(found)}\n\n{stages(done)}\n"
    )
