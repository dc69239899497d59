"""Plots of many trials: success by scene against the paper, causes of failure, comparisons."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from iwgnet_grasp.trials.statistics import (
    CAUSES,
    PAPER_SUCCESSES,
    PAPER_TRIALS,
    wilson_interval,
)

INK, FAINT, PAPER_GREY = "#1c1e22", "#787c82", "#a9adb3"
SERIES = ("#2a78d6", "#d9822b", "#1a8f6b", "#a65fc0", "#c0504d")  # told apart by marker, too
MARKERS = ("o", "s", "^", "D", "v")
# From ruddy (the grasp itself) over yellow (seeing) to blue (moving), as in the legend's order.
CAUSE_COLORS = {
    "missed": "#8c2d19",
    "slipped": "#cc4c02",
    "dropped": "#ec7014",
    "collided": "#fe9929",
    "not detected": "#fec44f",
    "no grasp": "#fee391",
    "no plan": "#6baed6",
    "unreachable": "#2171b5",
}
_STYLE = {
    "font.size": 10,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": FAINT,
    "svg.fonttype": "none",
    "svg.hashsalt": "iwgnet_grasp",  # the same figure gives the same bytes
}


def success_figure(runs: dict[str, dict]) -> Figure:
    """Success rate by scene with Wilson 95 % intervals: each run (title -> summary) beside the
    paper's figures, whose intervals are computed likewise from its 50 trials."""
    scenes = _scenes(runs.values())
    figure, axes = _figure(8.0, 3.4)
    series: list[tuple[str, str, Callable[[str], tuple[int, int] | None]]] = [
        ("paper", PAPER_GREY, lambda scene: _paper(scene))
    ]
    for i, (title, summary) in enumerate(runs.items()):
        series.append((title, SERIES[i % len(SERIES)], _counts_of(summary)))
    for i, (title, color, counts_of) in enumerate(series):
        shift = (i - (len(series) - 1) / 2) * 0.25
        points = [(x + shift, *c) for x, s in enumerate(scenes) if (c := counts_of(s))]
        if points:
            _points(axes, points, color, MARKERS[i % len(MARKERS)], title)
            for x, good, n in points:
                text = f"{good}/{n}"
                axes.text(x + 0.025, 100 * good / n, text, fontsize=8, color=INK, va="center")
    axes.set_xticks(range(len(scenes)), [scene.replace("_", " ") for scene in scenes])
    axes.set_xlim(-0.5, len(scenes) - 0.4)
    axes.set_ylabel("trials that succeed, %")
    _finish(axes)
    return figure


def cause_figure(summary: dict) -> Figure:
    """Failed trials of one run by scene and by what failed first."""
    scenes = _scenes([summary])
    counts = {scene: summary["scenes"][scene]["failed_trials_by_cause"] for scene in scenes}
    others = sorted({cause for c in counts.values() for cause in c} - set(CAUSES))
    figure, axes = _figure(7.0, 0.9 + 0.5 * len(scenes))
    left = [0.0] * len(scenes)
    for cause in (*CAUSES, *others):
        widths = [counts[scene].get(cause, 0) for scene in scenes]
        if not any(widths):
            continue
        color = CAUSE_COLORS.get(cause, PAPER_GREY)
        bars = axes.barh(scenes, widths, left=left, height=0.6, color=color, label=cause)
        axes.bar_label(
            bars,
            [str(w) if w else "" for w in widths],
            label_type="center",
            fontsize=9,
            color="white" if cause in ("missed", "slipped", "unreachable") else INK,
        )
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.set_yticks(range(len(scenes)), [scene.replace("_", " ") for scene in scenes])
    axes.invert_yaxis()
    axes.set_xlim(0, max(1.0, *left) * 1.02)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel("failed trials")
    if any(left):
        axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    else:
        axes.text(0.5, 0.5, "none failed", transform=axes.transAxes, ha="center", color=FAINT)
    return figure


def comparison_figure(comparison: dict) -> Figure:
    """Variants of a comparison: trials that succeed, and grasps that do, with 95 % intervals."""
    variants = comparison["variants"]
    scenes = _scenes(variant["summary"] for variant in variants)
    figure, panels = _figure(max(7.0, 3.0 + 1.1 * len(variants)), 5.2, rows=2)
    measures = (
        ("trials that succeed, %", "successes", "trials"),
        ("grasps that succeed, %", "good_attempts", "attempts"),
    )
    for axes, (label, good, whole) in zip(panels, measures, strict=True):
        for i, scene in enumerate(scenes):
            shift = (i - (len(scenes) - 1) / 2) * 0.14
            points = []
            for x, variant in enumerate(variants):
                s = variant["summary"]["scenes"].get(scene)
                if s and s[whole]:
                    points.append((x + shift, s[good], s[whole]))
            color, marker = SERIES[i % len(SERIES)], MARKERS[i % len(MARKERS)]
            _points(axes, points, color, marker, scene.replace("_", " "))
        axes.set_ylabel(label)
        axes.set_xlim(-0.5, len(variants) - 0.5)
        _finish(axes, legend=axes is panels[0])
    panels[0].set_xticks(range(len(variants)), [""] * len(variants))
    names = [variant["name"].replace(", ", "\n").replace(" (", "\n(") for variant in variants]
    panels[1].set_xticks(range(len(variants)), names)
    panels[0].set_title(comparison["title"], loc="left", fontsize=11, color=INK)
    return figure


def as_svg(figure: Figure) -> str:
    """The figure as an <svg> element for a page."""
    text = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def write_figure(figure: Figure, path: Path) -> Path:
    """The figure as a PNG. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, metadata={"Software": None})
    return path


def _figure(width: float, height: float, rows: int = 1):
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(rows)


def _points(axes, points: Sequence[tuple[float, int, int]], color, marker, label) -> None:
    """(x, successes, of) as percentages with their Wilson 95 % intervals."""
    rates = [100 * good / n for _, good, n in points]
    bounds = [wilson_interval(good, n) for _, good, n in points]
    low = [max(0.0, rate - 100 * b[0]) for rate, b in zip(rates, bounds, strict=True)]
    high = [max(0.0, 100 * b[1] - rate) for rate, b in zip(rates, bounds, strict=True)]
    axes.errorbar(
        [x for x, _, _ in points],
        rates,
        yerr=[low, high],
        color=color,
        marker=marker,
        markersize=6,
        linestyle="none",
        elinewidth=1.2,
        capsize=3,
        label=label,
    )


def _finish(axes, legend: bool = True) -> None:
    """Percent from a round figure below the lowest interval to 100, legend beside the plot."""
    lowest = axes.dataLim.y0 if axes.has_data() else 0.0
    bottom = max(0.0, 10 * math.floor((lowest - 2) / 10))
    axes.set_ylim(bottom - 0.5, 100 + 0.03 * (100 - bottom))  # whole markers at 100, too
    axes.grid(axis="y", color="#e6e6e3", linewidth=0.8)
    axes.set_axisbelow(True)
    if legend:
        axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _scenes(summaries) -> list[str]:
    return list(dict.fromkeys(scene for summary in summaries for scene in summary["scenes"]))


def _paper(scene: str) -> tuple[int, int] | None:
    return (PAPER_SUCCESSES[scene], PAPER_TRIALS) if scene in PAPER_SUCCESSES else None


def _counts_of(summary: dict) -> Callable[[str], tuple[int, int] | None]:
    def counts(scene: str) -> tuple[int, int] | None:
        s = summary["scenes"].get(scene)
        return (s["successes"], s["trials"]) if s and s["trials"] else None

    return counts
