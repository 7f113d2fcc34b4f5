"""The diagnosis of a run on one page: curves with their thresholds, and the findings."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    PercentFormatter,
)

from kreps.app.diagnosis import Finding, Row, Severity, thresholds
from kreps.app.diagnosis.columns import (
    all_recorded,
    average_rewards,
    column,
    effective_share,
    latest,
    policy_targets,
)
from kreps.app.diagnosis.trend import reward_trend
from kreps.errors import ConfigurationError
from kreps.kernels.arrays import FloatArray
from kreps.plotting import BLUE, GREY, STYLE, limits_of_most, mark_beyond
from kreps.plotting import COLOURS as COLOURS_OF_CURVES

COLOURS: dict[Severity, str] = {"limit": "#c0392b", "note": "#b07d10", "fine": "#2a8c7e"}
PAGES = (".png", ".pdf", ".svg")
WIDTH, HEIGHT, TEXT_WIDTH = 14.0, 8.8, 5.1
"""Of the page, and of its column of text, in inches."""

MAX_FONT_SIZE, MIN_FONT_SIZE = 9.5, 4.25
"""Of the text in points; the largest size at which all findings fit is taken."""

PANELS: dict[str, tuple[str, ...]] = {
    "Average reward per step, and its trend": (
        "goal",
        "local optimum",
        "progress",
        "acceptance test",
        "episodes",
        "rollout length",
        "action cost",
    ),
    "KL divergence [nats]": ("KL bound",),
    "Temperature eta [s.d. of the reward]": ("KL bound", "dual solver"),
    "Effective sample size, share of all": ("effective sample size",),
    "Model: relative leave-one-out errors": (
        "transition model",
        "dynamics",
        "terminations",
        "reward model",
        "delay or hidden state",
        "idle columns",
    ),
    "Basis of V: number of features": ("basis of V",),
    "Policy s.d. [half the action range]": ("exploration noise",),
    "Actions beyond the limits, share": ("clipped actions",),
}
"""Headings in reading order, each with the findings whose severity the panel shows."""


def check_page_name(path: Path) -> None:
    """Raise `ConfigurationError` unless the name ends in one of `PAGES`."""
    if path.suffix not in PAGES:
        endings = f"{', '.join(PAGES[:-1])} or {PAGES[-1]}"
        raise ConfigurationError(f"{path.name!r} is not the name of a page; end it in {endings}")


def page(
    rows: Sequence[Row], findings: Sequence[Finding], references: Mapping[str, float], title: str
) -> Figure:
    """Eight panels over the iterations beside the findings.

    Args:
        rows: of ``progress.csv``.
        findings: about these rows, the most severe first.
        references: reference rewards of the task by name, from best to worst.
        title: of the page.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT))
        engine = figure.get_layout_engine()
        assert isinstance(engine, ConstrainedLayoutEngine)
        engine.set(w_pad=0.12, h_pad=0.07)
        halves: Any = figure.subfigures(1, 2, width_ratios=(WIDTH - TEXT_WIDTH, TEXT_WIDTH))
        left, right = halves
        plots = dict(zip(PANELS, left.subplots(4, 2, sharex=True).flat, strict=True))
        reward, kl, eta, effective, model, basis, noise, clipped = plots.values()
        _draw_reward(reward, rows, references)
        _draw_kl(kl, rows)
        _draw_eta(eta, rows)
        _draw_effective_samples(effective, rows)
        _draw_model(model, rows)
        _draw_basis(basis, rows)
        _draw_noise(noise, rows)
        _draw_clipping(clipped, rows)
        for name, axes in plots.items():
            axes.set_title(name)
            _mark(axes, [f.severity for f in findings if f.name in PANELS[name]])
        for axes in (noise, clipped):
            axes.set_xlabel("iteration")
            axes.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
        figure.suptitle(f"What limits this run: {title}", fontweight="bold", fontsize=12)
        _write(right, findings)
    return figure


# ---- panels -----------------------------------------------------------------------------------


def _mark(axes: Axes, severities: Sequence[Severity]) -> None:
    """Write the most severe of some severities above the panel, on the right."""
    for severity in COLOURS:
        if severity in severities:
            axes.set_title(f"● {severity}", loc="right", color=COLOURS[severity], fontsize=9)
            return


def _curve(axes: Axes, rows: Sequence[Row], values: FloatArray) -> None:
    """Plot values (m,) over the iterations; a remark if all of them are NaN."""
    if np.isfinite(values).any():
        axes.plot(column(rows, "iteration"), values, "o-", color=BLUE, ms=3, lw=1.2)
    else:
        axes.text(
            0.5, 0.55, "none or not recorded", transform=axes.transAxes, ha="center", color=GREY
        )


def _curve_of_most(
    axes: Axes, rows: Sequence[Row], values: FloatArray, always: Sequence[float]
) -> FloatArray:
    """As `_curve`, but a few values far from the others are drawn as arrows at the edge.

    Args:
        axes: of the panel.
        rows: m iterations.
        values: (m,) of them.
        always: values that the axis contains in any case.

    Returns:
        The values (m,), moved to the edge where they are beyond it.
    """
    limits = limits_of_most(values, 1 + len(rows) // 8, always)
    if limits is None:
        _curve(axes, rows, values)
        return values
    shown = np.clip(values, *limits)
    _curve(axes, rows, shown)
    mark_beyond(axes, column(rows, "iteration"), values, limits, BLUE)
    return shown


def _line(
    axes: Axes,
    value: float,
    text: str,
    colour: str = GREY,
    *,
    below: bool = False,
    right: bool = False,
) -> None:
    """A horizontal line with its name above or below its left or right end."""
    axes.axhline(value, color=colour, lw=0.9, ls="--", zorder=0)
    axes.annotate(
        text,
        (float(right), value),
        xycoords=("axes fraction", "data"),
        xytext=(-3 if right else 3, -2 if below else 1.5),
        textcoords="offset points",
        va="top" if below else "bottom",
        ha="right" if right else "left",
        color=colour,
        fontsize=7,
    )


def _shade(axes: Axes, low: float, high: float, severity: Severity) -> None:
    """Shade values in the colour of a severity."""
    axes.axhspan(low, high, color=COLOURS[severity], alpha=0.07, lw=0, zorder=-1)


def _plain_decades(axes: Axes) -> None:
    """Few ticks on a logarithmic axis, as plain numbers."""
    low, high = axes.get_ylim()
    subs = (1.0, 3.0) if high < 1e3 * low else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=subs, numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _draw_reward(axes: Axes, rows: Sequence[Row], references: Mapping[str, float]) -> None:
    values = average_rewards(rows)
    shown = dict(list(references.items())[:-1])
    axes.margins(y=0.15)
    _curve_of_most(axes, rows, values, list(shown.values()))
    for name, value in shown.items():  # named at the end where the curve is not
        _line(axes, value, f"{name}  {value:g}", right=bool(value < np.median(values)))
    found = reward_trend(rows)
    if found is not None:
        time = column(rows, "iteration")[-found.iterations :]
        line = found.rise * np.linspace(-0.5, 0.5, found.iterations)
        line += np.median(values[-found.iterations :] - line)
        axes.plot(time, line, color="#222222", lw=1.4)


def _draw_kl(axes: Axes, rows: Sequence[Row]) -> None:
    bound = column(rows, "kl_bound")
    _curve(axes, rows, column(rows, "kl"))
    top = float(bound.max())
    _line(axes, float(bound[-1]), f"bound {bound[-1]:g}")
    _line(axes, thresholds.LOW_KL_SHARE * float(bound[-1]), f"{thresholds.LOW_KL_SHARE:.0%} of it")
    axes.set_ylim(0.0, 1.25 * top)


def _draw_eta(axes: Axes, rows: Sequence[Row]) -> None:
    _curve(axes, rows, column(rows, "eta"))
    axes.set_yscale("log")
    floor = latest(rows, "eta_floor")
    low, high = float(column(rows, "eta").min()), float(column(rows, "eta").max())
    if np.isfinite(floor):
        _line(axes, floor, f"floor {floor:.2g}", below=True)
        low = min(low, floor)
    axes.set_ylim(low * (low / high / 4.0) ** 0.25, 2.0 * high)
    _plain_decades(axes)


def _draw_effective_samples(axes: Axes, rows: Sequence[Row]) -> None:
    _curve(axes, rows, effective_share(rows))
    share = thresholds.MIN_EFFECTIVE_SHARE
    count_as_share = thresholds.MIN_EFFECTIVE_SAMPLES / float(policy_targets(rows)[-1])
    severity: Severity = "note" if share >= count_as_share else "limit"
    minimum = max(share, count_as_share)
    text = f"{share:.0%}" if severity == "note" else f"{thresholds.MIN_EFFECTIVE_SAMPLES:g} samples"
    _line(axes, minimum, text, COLOURS[severity])
    _shade(axes, 0.0, minimum, severity)
    axes.set_ylim(0.0, 1.0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


ERRORS = {
    "model_error": ("V's features", "o"),
    "dynamics_error": ("dynamics", "s"),
    "termination_error": ("terminations", "^"),
    "reward_error": ("reward", "D"),
}
"""Columns of errors, each with its name and marker."""


def _draw_model(axes: Axes, rows: Sequence[Row]) -> None:
    note, limit = thresholds.MODEL_ERROR_NOTE, thresholds.MODEL_ERROR_LIMIT
    known = {name: column(rows, name) for name in ERRORS}
    known = {name: values for name, values in known.items() if np.isfinite(values).any()}
    if not known:
        _curve(axes, rows, column(rows, "model_error"))
    iterations, all_values = column(rows, "iteration"), np.concatenate([*known.values(), [np.nan]])
    limits = limits_of_most(all_values, len(known) * (1 + len(rows) // 8), [0.0, 1.0])
    low, high = limits or (-np.inf, np.inf)
    for colour, (name, values) in zip(COLOURS_OF_CURVES, known.items(), strict=False):
        label, marker = ERRORS[name]
        shown = np.clip(values, low, high)
        axes.plot(iterations, shown, marker + "-", color=colour, ms=3, lw=1.0, label=label)
        if limits is not None:
            mark_beyond(axes, iterations, values, limits, colour)
    top = max(1.1, 1.04 * float(np.nanmax(np.minimum(all_values, high), initial=0.0)))
    if len(known) > 1:
        top *= 1.2  # for the names
        axes.legend(loc="upper right", fontsize=7, ncols=4, borderaxespad=0.1, columnspacing=1.0)
    axes.set_ylim(0.0, top)
    _line(axes, note, f"note {note:g}", COLOURS["note"], below=True)
    _line(axes, limit, f"limit {limit:g}", COLOURS["limit"])
    _shade(axes, note, limit, "note")
    _shade(axes, limit, top, "limit")


def _draw_basis(axes: Axes, rows: Sequence[Row]) -> None:
    rank = column(rows, "rank")
    _curve(axes, rows, rank)
    max_rank = latest(rows, "max_rank")
    top = float(rank.max())
    if np.isfinite(max_rank):
        _line(axes, max_rank, f"largest {max_rank:.0f}")
        top = max(top, max_rank)
    axes.set_ylim(0.0, 1.25 * top)
    residual = latest(rows, "rank_residual")
    fixed = all_recorded(rows) and not np.isfinite(max_rank)
    axes.text(
        0.99,
        0.06,
        "residual not measured" if fixed else f"squared residual {residual:.1g}",
        transform=axes.transAxes,
        ha="right",
        color=GREY,
        fontsize=7,
    )


def _draw_noise(axes: Axes, rows: Sequence[Row]) -> None:
    values = column(rows, "policy_noise")
    _curve(axes, rows, values)
    low_std, high_std = thresholds.MIN_POLICY_STD, thresholds.MAX_POLICY_STD
    _line(axes, low_std, f"limit {low_std:g}", COLOURS["limit"])
    _line(axes, high_std, f"note {high_std:g}", COLOURS["note"])
    known = values[np.isfinite(values)]
    low = 0.5 * min([low_std, *known])
    high = 2.5 * max([high_std, *known])
    _shade(axes, low, low_std, "limit")
    _shade(axes, high_std, high, "note")
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    _plain_decades(axes)


def _draw_clipping(axes: Axes, rows: Sequence[Row]) -> None:
    _curve(axes, rows, column(rows, "clipped"))
    note = thresholds.CLIPPED_NOTE
    _line(axes, note, f"note {note:.0%}", COLOURS["note"], below=True)
    _shade(axes, note, 1.04, "note")
    axes.set_ylim(0.0, 1.04)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


# ---- text -------------------------------------------------------------------------------------


def _write(side: SubFigure, findings: Sequence[Finding]) -> None:
    """All findings below each other, in the largest font size at which they fit."""
    room = 72.0 * (HEIGHT - 0.75)
    for size in np.arange(MAX_FONT_SIZE, MIN_FONT_SIZE - 0.25, -0.25):
        lines = _lines(findings, size)
        if sum(skip for _, _, skip in lines) <= room:
            break
    y = 1.0
    for text, style, skip in lines:
        y -= skip / 72.0 / HEIGHT
        side.text(0.03, y, text, fontsize=size, va="bottom", parse_math=False, **style)


def _lines(findings: Sequence[Finding], size: float) -> list[tuple[str, dict[str, Any], float]]:
    """Lines of text, their styles, and the distance of each from the one above in points."""
    width = int(72.0 * (TEXT_WIDTH - 0.4) / (0.535 * size))
    lines: list[tuple[str, dict[str, Any], float]] = []
    for finding in findings:
        heading = f"{finding.severity.upper()}   {finding.name}"
        bold = {"fontweight": "bold", "color": COLOURS[finding.severity]}
        lines.append((heading, bold, 2.1 * size))
        sentence = _wrapped(finding.sentence, width)
        lines += [(text, {"color": "#222222"}, 1.3 * size) for text in sentence]
        if finding.remedy:
            remedy = _wrapped(f"Try: {finding.remedy}", width)
            lines += [(text, {"color": BLUE}, 1.3 * size) for text in remedy]
    return lines


def _wrapped(text: str, width: int) -> list[str]:
    """Lines of at most ``width`` letters; an option and its value stay on one line."""
    text = text.replace("--set ", "--set\N{NO-BREAK SPACE}")
    return textwrap.wrap(text, width, break_on_hyphens=False)
