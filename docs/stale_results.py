"""Names the results that the present code or settings would not make: part of ``make check``.

    python docs/stale_results.py             # fails unless results/stale.json names just these
    python docs/stale_results.py --declare   # writes it, and results/stale.md; then `make tables`

A stale result may stay if it is declared: then the pages that show it say so.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from kreps.experiments.fingerprint import changes
from kreps.experiments.runner import figure_trials
from kreps.experiments.tables import markdown
from kreps.experiments.trials import settings_of_trial

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
SEARCH = ROOT / "src/kreps/experiments/search.json"

RENEWAL = {
    "ablation": "kreps reproduce ablation --trials 3 --iterations 14 --workers 2",
    "benchmarks": "make bench",
    "claims": "kreps reproduce all --trials 10 --workers 2",
    "coverage": "python benchmarks/coverage.py",
    "delays": "python benchmarks/delays.py",
    "few-data": "python benchmarks/few_data.py --workers 2",
    "figure-1a": "kreps reproduce figure-1a --trials 10 --workers 2",
    "figure-1b": "kreps reproduce figure-1b --trials 10 --workers 2",
    "figure-2b": "kreps reproduce figure-2b --trials 10 --workers 2",
    "forgetting": "kreps reproduce forgetting --trials 10 --workers 2",
    "golden": "kreps reproduce golden --trials 1 --iterations 2",
    "low-rank": "kreps reproduce low-rank --trials 10 --workers 2",
    "low-rank-accuracy": "python benchmarks/low_rank.py accuracy",
    "low-rank-growth": "python benchmarks/low_rank.py growth",
    "low-rank-scale": "python benchmarks/low_rank.py scale",
    "low-rank-variance": "python benchmarks/low_rank.py variance",
    "peers": "python benchmarks/peers.py",
    "peers-seconds": "python benchmarks/peers_seconds.py",
    "predict": "python benchmarks/predict.py",
    "reaching-optimum": "python benchmarks/reaching_optimum.py",
    "recorded-data": "python benchmarks/recorded_data.py",
    "search": "kreps search --workers 2",
    "suite-peers": "python benchmarks/suite_peers.py --seeds 23 --learners SAC",
    "suite": "python benchmarks/suite.py --seeds 23 24 --workers 2",
    "swing-up": "kreps reproduce swing-up --trials 10 --workers 2",
    "swing-up-optimum": "python benchmarks/swing_up_optimum.py",
    "untuned": "kreps reproduce untuned --trials 10 --workers 2",
}
"""The command that makes each result anew."""

SOURCES = {"claims": ("figure-1a", "figure-1b", "figure-2b")}
"""Results that are computed from others, and stale if one of them is."""


def content_of(name: str, results: Path = RESULTS) -> Any:
    path = SEARCH if name == "search" else results / f"{name}.json"
    return json.loads(path.read_text())


def reasons(name: str, results: Path = RESULTS) -> list[str]:
    """Why a result is stale; nothing if it is not."""
    if name in SOURCES:
        return [f"{source} is stale" for source in SOURCES[name] if reasons(source, results)]
    content = content_of(name, results)
    code = content["facts"].get("code") if "facts" in content else content.get("code")
    if code is None:
        return ["it is older than fingerprints"]
    return changes(code) + changed_settings(name, content.get("settings", {}))


def changed_settings(name: str, recorded: dict[str, dict[str, Any]]) -> list[str]:
    """Curves that are new or gone, and settings with another value.

    A setting that only one of the two has is no reason: what reads it is code.
    """
    if not recorded:
        return []
    present = {f"{t.task}: {t.method}": settings_of_trial(t) for t in figure_trials(name, 1, None)}
    found = [f"curve {curve}" for curve in sorted(recorded.keys() ^ present.keys())]
    for curve in recorded.keys() & present.keys():
        old, new = recorded[curve], present[curve]
        found += [f"{curve}: {k}" for k in sorted(old.keys() & new.keys()) if old[k] != new[k]]
    return found


def names_of(results: Path = RESULTS) -> list[str]:
    """All results of a folder, and the search."""
    names = {path.stem for path in results.glob("*.json")} - {"stale"}
    return sorted({*names, "search"})


def table(stale: dict[str, str]) -> str:
    """The documentation's table of stale results, from their commands."""
    rows = [(name, f"`{command}`") for name, command in stale.items()]
    return markdown(("stale result", "to renew"), rows)


def main() -> int:
    found = {name: reasons(name) for name in names_of()}
    stale = {name: RENEWAL[name] for name, why in found.items() if why}
    if "--declare" in sys.argv[1:]:
        (RESULTS / "stale.json").write_text(json.dumps(stale, indent=1) + "\n")
        (RESULTS / "stale.md").write_text(table(stale) + "\n")
        return 0
    declared = json.loads((RESULTS / "stale.json").read_text())
    for name in sorted(stale.keys() - declared.keys()):
        why = found[name]
        more = f" and {len(why) - 3} more" if len(why) > 3 else ""
        print(f"{name} is stale ({', '.join(why[:3])}{more}). To renew: {RENEWAL[name]}")
    for name in sorted(declared.keys() - stale.keys()):
        print(f"{name} is not stale any more")
    if stale != declared:
        print("Renew them, or declare what is stale:")
        print("  python docs/stale_results.py --declare && make tables")
    return int(stale != declared)


if __name__ == "__main__":
    sys.exit(main())
