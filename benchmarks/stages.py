"""Draws the time of each stage of an update, from result files.

    python benchmarks/stages.py

Reads ``results/benchmarks.json`` (`make bench`) and ``results/low-rank-scale.json``
(``python benchmarks/low_rank.py scale``), writes ``results/stages.png``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure

from kreps.plotting import GREY, STYLE

Stages = dict[str, float]


def exact(results: Path) -> dict[str, Stages]:
    found = json.loads((results / "benchmarks.json").read_text())
    rows = [row for row in found["rows"] if "stages" in row]
    return {f"exact, {row['size']}": row["stages"] for row in rows}


def low_rank(results: Path) -> dict[str, Stages]:
    found = json.loads((results / "low-rank-scale.json").read_text())
    rows = next(iter(found["rows"].values()))
    return {f"low rank, n = {row['samples']:,}": row["stages"] for row in rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=Path("results"))
    results = parser.parse_args().results
    panels = (exact(results), low_rank(results))
    names = list(dict.fromkeys(name for panel in panels for bar in panel.values() for name in bar))
    colours = dict(zip(names, colormaps["tab10"].colors, strict=False))
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.4), layout="constrained")
        for axis, panel in zip(figure.subplots(1, 2), panels, strict=True):
            for i, stages in enumerate(panel.values()):
                whole, left = sum(stages.values()), 0.0
                for name, seconds in stages.items():
                    axis.barh(i, seconds / whole, left=left, color=colours[name], height=0.6)
                    left += seconds / whole
                axis.text(1.01, i, f"{whole:.3g} s", va="center", fontsize=8, color=GREY)
            axis.set_yticks(range(len(panel)), list(panel), fontsize=8)
            axis.invert_yaxis()
            axis.set_xlim(0.0, 1.0)
            axis.set_xlabel("share of the CPU time of an update")
        handles = [figure.axes[0].barh(0, 0, color=colours[name]) for name in names]
        figure.legend(
            handles, names, loc="outside upper center", ncols=len(names), frameon=False, fontsize=8
        )
    figure.savefig(results / "stages.png", dpi=130, metadata={"Software": None})


if __name__ == "__main__":
    main()
