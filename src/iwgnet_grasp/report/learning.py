"""Figures of training.comparison as a page: Markdown tables and plots."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from iwgnet_grasp.files import write_whole
from iwgnet_grasp.report.results_page import PAGE, write_section
from iwgnet_grasp.trials.statistics import wilson_interval

SUCCESS_PICTURE = "learning_success.png"
QUALITY_PICTURE = "learning_quality.png"
_DPI = 110
_COLOURS = (  # Okabe and Ito 2008
    *("#0072b2", "#56b4e9", "#009e73", "#e69f00"),
    *("#d55e00", "#cc79a7", "#000000", "#f0e442"),
)

_INTRODUCTION = """\
## Learning

Written by `{command}`. {networks} on {sets}.

- **top-1, top-5**: the first, or one of the first five, local maxima of the quality map matches a
  label: IoU above 0.25 and angle within 30 deg. Over all held-out objects that have an executable
  labelled grasp; *good*: over those with a label of quality 0.5 or more.
- **width, angle**: mean error of right first grasps. **ECE**: expected calibration error of the
  predicted quality, against the quality of the label that was hit (0 if none) and against lifts.
- **ms**: the network alone, one crop, median, on the backend named.
"""
_LIFTS = """\
- **lifted**: the first grasp carried out open loop in Bullet on the same {count} objects of each
  set for every network (drawn with seed {seed}), by friction and contact force alone, from the
  depth that the D455 measures. A grasp that fingers or arm have no room for, a wrong part, a slip
  beyond 5 mm or 5 deg and a collision all count as failures. In brackets: Wilson's 95 %.
"""


def write_report(
    comparison: dict[str, Any], out: Path, command: str, publish: bool = False
) -> list[Path]:
    """Writes evaluation.json, evaluation.md and the plots into `out`; with `publish` also the
    section of docs/results.md and docs/pictures. Returns the paths. Raises OSError."""
    out.mkdir(parents=True, exist_ok=True)
    content = {"command": command, **comparison}
    write_whole(out / "evaluation.json", (json.dumps(content, indent=1) + "\n").encode())
    page = as_markdown(comparison, command, ".")
    write_whole(out / "evaluation.md", page.encode())
    paths = [out / "evaluation.json", out / "evaluation.md", *write_plots(comparison, out)]
    if publish:
        paths += write_plots(comparison, PAGE.parent / "pictures")
        write_section("learning", as_markdown(comparison, command, "pictures"))
        paths.append(PAGE)
    return paths


def as_markdown(comparison: dict[str, Any], command: str, pictures: str) -> str:
    """The section "learning" of docs/results.md. pictures: folder of the plots as seen from it."""
    networks, sets = comparison["networks"], comparison["sets"]
    introduction = _INTRODUCTION.format(
        command=command,
        networks=_counted(len(networks), "network"),
        sets=_counted(len(sets), "held-out set"),
    )
    if comparison["lifts"]["count"]:
        introduction += _LIFTS.format(**comparison["lifts"])
    lines = [introduction, f"![Success by set and network]({pictures}/{SUCCESS_PICTURE})\n"]
    for name, facts in sets.items():
        lines += [_set_heading(name, facts), _set_table(networks, name)]
    for fact, title in (("family", "By family"), ("arrangement", "By arrangement")):
        table = _fact_table(networks, fact)
        if table:
            lines += [f"### {title}: top-1 (lifted)\n", table]
    outcomes = _outcome_table(networks)
    if outcomes:
        lines += ["### What became of the lifts\n", outcomes]
    lines.append("### Is the predicted quality worth what it says?\n")
    lines.append(f"![Reliability of the predicted quality]({pictures}/{QUALITY_PICTURE})\n")
    if comparison["detector"]:
        lines += ["### Detector\n", _detector_table(comparison["detector"])]
    return "\n".join(line for line in lines if line)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _set_heading(name: str, facts: dict[str, Any]) -> str:
    made = (
        f" of {facts['scenes']} scenes, seed {facts['seed']}" if facts["seed"] is not None else ""
    )
    families = f": {', '.join(facts['families'])}" if facts["families"] else ""
    return f"### `{name}`{families}\n\n{facts['objects']} objects{made}.\n"


def _set_table(networks: Sequence[dict], name: str) -> str:
    head = (
        "weights | parameters | ms | backend | top-1 | good | top-5 | lifted "
        "| width px | angle deg | ECE label | ECE lift"
    )
    rows = []
    for network in networks:
        on_set = network["sets"][name]
        score, lifts = on_set["score"], on_set["lifts"]
        rows.append(
            f"{network['weights']} | {network['parameters']:,} | {network['milliseconds']:.1f} "
            f"| {network['backend']} | {_percent(score['top1'])} | {_percent(score['top1_good'])} "
            f"| {_percent(score['top5'])} | {_lifted(lifts)} | {_number(score['width_error_px'])} "
            f"| {_number(score['angle_error_deg'])} | {_number(on_set['quality']['error'], 3)} "
            f"| {_number(lifts['quality']['error'], 3)}"
        )
    return _table(head, rows)


def _fact_table(networks: Sequence[dict], fact: str) -> str:
    """Rows: the values of a fact in each set; columns: networks."""
    rows = []
    for name in networks[0]["sets"] if networks else ():
        for value, first in networks[0]["sets"][name][fact].items():
            cells = []
            for network in networks:
                part = network["sets"][name][fact][value]
                lifts = part["lifts"]
                lifted = f" ({_percent(lifts['share'])})" if lifts["tried"] else ""
                cells.append(f"{_percent(part['score']['top1'])}{lifted}")
            tried = first["lifts"]["tried"]
            count = f"{first['score']['objects']}" + (f" ({tried})" if tried else "")
            rows.append(f"{name} | {value} | {count} | " + " | ".join(cells))
    head = "set | " + fact + " | objects | " + " | ".join(n["weights"] for n in networks)
    return _table(head, rows) if rows else ""


def _outcome_table(networks: Sequence[dict]) -> str:
    """Over all sets; "" without lifts."""
    totals: list[dict[str, int]] = []
    for network in networks:
        total: dict[str, int] = {}
        for on_set in network["sets"].values():
            for outcome, count in on_set["lifts"]["outcomes"].items():
                total[outcome] = total.get(outcome, 0) + count
        totals.append(total)
    outcomes = sorted(
        {o for t in totals for o in t}, key=lambda o: -sum(t.get(o, 0) for t in totals)
    )
    if not outcomes:
        return ""
    rows = [
        f"{network['weights']} | " + " | ".join(str(total.get(o, 0)) for o in outcomes)
        for network, total in zip(networks, totals, strict=True)
    ]
    return _table("weights | " + " | ".join(o.replace("_", " ") for o in outcomes), rows)


def _detector_table(detector: dict[str, Any]) -> str:
    rows = []
    for name, metrics in detector.items():
        parts = {"all": metrics} | metrics["arrangements"]
        for kind, part in parts.items():
            speed = f"{metrics['milliseconds']:.1f} ({metrics['backend']})" if kind == "all" else ""
            rows.append(
                f"{metrics['weights']} | {name} | {kind} | {part['scenes']} "
                f"| {_number(part['map50'], 4)} | {_number(part['map50_95'], 4)} "
                f"| {_number(part['recall'], 4)} | {speed}"
            )
    head = "weights | set | scenes shown | scenes | mAP50 | mAP50-95 | recall | ms an image"
    return "Boxes of any class, COCO's evaluation.\n\n" + _table(head, rows)


def _table(head: str, rows: Sequence[str]) -> str:
    rule = "|".join("---" for _ in head.split(" | "))
    return "\n".join([f"| {head} |", f"|{rule}|", *(f"| {row} |" for row in rows)]) + "\n"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _lifted(lifts: dict[str, Any]) -> str:
    if not lifts["tried"]:
        return "-"
    low, high = lifts["interval_95"]
    return f"{_percent(lifts['share'])} ({100 * low:.0f}-{100 * high:.0f})"


# Plots ----------------------------------------------------------------------------------------


def write_plots(comparison: dict[str, Any], folder: Path) -> list[Path]:
    """Writes both pictures into the folder, which is made if need be. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = {SUCCESS_PICTURE: _success(comparison), QUALITY_PICTURE: _quality(comparison)}
    paths = []
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=_DPI)
        plt.close(figure)
        paths.append(folder / name)
    return paths


def _success(comparison: dict[str, Any]) -> plt.Figure:
    """Bars of top-1, and of lifts where there are any, with their 95 % intervals."""
    networks, names = comparison["networks"], list(comparison["sets"])
    panels = _panels(comparison)
    figure, axes = plt.subplots(
        1, len(panels), figsize=(4.5 * len(panels), 3.2), constrained_layout=True, squeeze=False
    )
    width = 0.8 / len(networks)
    for axis, lifts in zip(axes[0], panels, strict=True):
        for i, network in enumerate(networks):
            shares = [_share(network["sets"][name], lifts) for name in names]
            at = [j + (i - (len(networks) - 1) / 2) * width for j in range(len(names))]
            axis.bar(
                at,
                [100 * share for share, _, _ in shares],
                0.9 * width,
                color=_COLOURS[i % len(_COLOURS)],
                label=network["weights"],
                yerr=[
                    [100 * (share - low) for share, low, _ in shares],
                    [100 * (high - share) for share, _, high in shares],
                ],
                error_kw={"elinewidth": 0.8, "ecolor": "#404040"},
            )
        axis.set_xticks(range(len(names)), names)
        what = "lifted in Bullet" if lifts else "right by the rectangle metric"
        axis.set_title(f"First grasp {what}, % of the objects", fontsize=10)
        axis.grid(axis="y", linewidth=0.4)
        axis.set_axisbelow(True)
        axis.set_ylim(0, 100)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncol=3, fontsize=8)
    return figure


def _panels(comparison: dict[str, Any]) -> tuple[bool, ...]:
    """Whether a plot's panels show lifts."""
    lifts = any(s["lifts"]["tried"] for n in comparison["networks"] for s in n["sets"].values())
    return (False, True) if lifts else (False,)


def _share(on_set: dict[str, Any], lifts: bool) -> tuple[float, float, float]:
    """Share and the ends of its interval; NaN where nothing was lifted."""
    if lifts:
        if not on_set["lifts"]["tried"]:
            return math.nan, math.nan, math.nan
        return on_set["lifts"]["share"], *on_set["lifts"]["interval_95"]
    score = on_set["score"]
    right = round(score["top1"] * score["objects"])
    return score["top1"], *wilson_interval(right, score["objects"])


def _quality(comparison: dict[str, Any]) -> plt.Figure:
    """Reliability diagrams over all sets: predicted quality against labels and against lifts."""
    panels = _panels(comparison)
    figure, axes = plt.subplots(
        1, len(panels), figsize=(4.5 * len(panels), 3.9), constrained_layout=True, squeeze=False
    )
    for axis, lifts in zip(axes[0], panels, strict=True):
        axis.plot([0, 1], [0, 1], color="#909090", linewidth=0.8)
        for i, network in enumerate(comparison["networks"]):
            bins = _pooled(network, lifts)
            colour = _COLOURS[i % len(_COLOURS)]
            predicted, observed = [b["predicted"] for b in bins], [b["observed"] for b in bins]
            axis.plot(predicted, observed, color=colour, linewidth=1, label=network["weights"])
            # The more predictions, the bigger the mark.
            sizes = [4 + 2 * b["count"] ** 0.5 for b in bins]
            axis.scatter(predicted, observed, s=sizes, color=colour)
        axis.set_xlim(0, 1)
        axis.set_ylim(0, 1)
        axis.set_xlabel("predicted quality of the first grasp")
        axis.set_ylabel(
            "share of the grasps that lifted" if lifts else "quality of the label that was hit"
        )
        axis.grid(linewidth=0.4)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncol=3, fontsize=8)
    return figure


def _pooled(network: dict[str, Any], lifts: bool) -> list[dict[str, float]]:
    """The reliability bins of all sets together; bins with fewer than 5 predictions say nothing."""
    tenths: dict[int, list[dict]] = {}
    for on_set in network["sets"].values():
        quality = on_set["lifts"]["quality"] if lifts else on_set["quality"]
        for b in quality["bins"]:
            tenths.setdefault(min(int(10 * b["predicted"]), 9), []).append(b)
    pooled = []
    for _, parts in sorted(tenths.items()):
        count = sum(p["count"] for p in parts)
        if count >= 5:
            mean = {
                key: sum(p["count"] * p[key] for p in parts) / count
                for key in ("predicted", "observed")
            }
            pooled.append({"count": count, **mean})
    return pooled
