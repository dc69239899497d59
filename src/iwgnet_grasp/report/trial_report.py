"""The report of trials: sections of docs/results.md and one self-contained HTML page."""

from __future__ import annotations

import base64
import html
import io
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from iwgnet_grasp.report import trial_figures as figures
from iwgnet_grasp.report.film import write_gif
from iwgnet_grasp.report.pictures import (
    boxes_picture,
    grasps_picture,
    merged_depth_picture,
    scene_picture,
)
from iwgnet_grasp.report.results_page import PAGE, write_section
from iwgnet_grasp.report.strip import trial_strip
from iwgnet_grasp.trials.replay import Replay
from iwgnet_grasp.trials.statistics import causes
from iwgnet_grasp.trials.table import (
    cause_rows,
    comparison_rows,
    markdown,
    percent,
    success_rows,
)

Rows = list[list[str]]


@dataclass(frozen=True)
class Report:
    """runs: title -> summary.json; comparisons as read_comparison() gives them; examples: one
    replayed trial of a scene or more."""

    runs: dict[str, dict]
    comparisons: Sequence[dict]
    examples: Sequence[Replay]


def conditions_line(run: dict) -> str:
    """What a summary's trials had in common, in words."""
    last = run["first_seed"] + run["trials"] - 1
    parts = [f"seeds {run['first_seed']} to {last}"]
    parts.append("one look" if run["replan"] == "once" else "a look after each pick")
    parts.append("over ROS" if run["transport"] == "ros" else "in process")
    if run["camera_offset"] >= 0:
        parts.append(f"camera mounted off its nominal pose (seed {run['camera_offset']})")
    parts.append("calibrated camera pose" if run["calibration"] else "nominal camera pose")
    parts += [f"{key} = {value}" for key, value in run["overrides"].items()]
    return ", ".join(parts)


def command_line(run: dict) -> str:
    """The command that makes a run."""
    words = ["scripts/run_trials", "--scene", ",".join(run["scenes"])]
    words += ["--trials", str(run["trials"]), "--seed", str(run["first_seed"])]
    words += ["--replan", run["replan"]]
    if run["transport"] != "inprocess":
        words += ["--transport", run["transport"]]
    if run["camera_offset"] >= 0:
        words += ["--camera-offset", str(run["camera_offset"])]
    if run["calibration"]:
        words += ["--calibration", Path(run["calibration"]).name]
    for key, value in run["overrides"].items():
        words += ["--set", f"{key}={json.dumps(value)}"]
    return " ".join(words)


# docs/results.md ----------------------------------------------------------------------------------


def write_docs(report: Report, page: Path = PAGE) -> list[str]:
    """Writes the sections "trials" and "priority" with their pictures; returns those written."""
    pictures = page.parent / "pictures"
    written = []
    about_order = [c for c in report.comparisons if _about_order(c)]
    others = [c for c in report.comparisons if not _about_order(c)]
    if report.runs:
        write_section("trials", _trials_markdown(report, others, pictures), page)
        written.append("trials")
    if about_order:
        text = ["## Priority"]
        for comparison in about_order:
            text.append(_comparison_markdown(comparison, pictures))
        write_section("priority", "\n\n".join(text), page)
        written.append("priority")
    return written


def _trials_markdown(report: Report, others: Sequence[dict], pictures: Path) -> str:
    text = ["## Trials"]
    text.append(
        "A trial succeeds when every object ends in the tray by its first grasp without slip "
        "(5 mm, 5 deg), drop or collision; the simulator's judge says so. GSR: grasps that "
        "succeed of all that were tried. Pushes: objects pushed aside, not gripped, where no grasp "
        "was good (the paper has none). Slip and placement: median / largest. picks/h counts "
        "computation at its wall time."
    )
    figures.write_figure(figures.success_figure(report.runs), pictures / "trials.png")
    text.append("![Success by scene against the paper](pictures/trials.png)")
    for title, summary in report.runs.items():
        run = summary["run"]
        text.append(
            f"### {title}\n\n`{command_line(run)}`: {conditions_line(run)}.{_code(summary)}"
        )
        text.append(markdown(*_without_empty(*success_rows(summary))))
        if _failed(summary):
            text.append("Failed trials by what failed first:")
            text.append(markdown(*_without_empty(*cause_rows(summary))))
        else:
            text.append("No trial failed.")
    text += [_comparison_markdown(comparison, pictures) for comparison in others]
    for example in report.examples:
        record = example.record
        if example.frames:
            name = f"{record['scene']}.gif"
            write_gif(pictures / name, example.frames, example.captions())
            text.append(f"![{record['scene']}, seed {record['seed']}](pictures/{name})")
    return "\n\n".join(text)


def _comparison_markdown(comparison: dict, pictures: Path) -> str:
    name = comparison["name"] + ".png"
    figures.write_figure(figures.comparison_figure(comparison), pictures / name)
    run = comparison["variants"][0]["summary"]["run"]
    return "\n\n".join(
        [
            f"### {comparison['title']}",
            f"`{comparison['command']}`: {run['trials']} trials of each scene from seed "
            f"{run['first_seed']} on, the same for each row.",
            markdown(*comparison_rows(comparison)),
            f"![{comparison['title']}](pictures/{name})",
        ]
    )


def _about_order(comparison: dict) -> bool:
    keys = [key for variant in comparison["variants"] for key in variant["settings"]]
    return bool(keys) and all(key.startswith("priority.") for key in keys)


def _code(summary: dict) -> str:
    commits = summary["commits"]
    return f" Code: {', '.join(commits)}." if commits else ""


def _without_empty(head: list[str], rows: Rows) -> tuple[list[str], Rows]:
    """The table without the columns that say nothing in any row."""
    kept = [i for i in range(len(head)) if any(row[i] not in ("", "0") for row in rows)]
    kept = [i for i, name in enumerate(head) if i in kept or name == "failed"]
    return [head[i] for i in kept], [[row[i] for i in kept] for row in rows]


# HTML ---------------------------------------------------------------------------------------------

_CSS = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c1e22; background: #fafaf8;
  max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.5rem; border-top: 1px solid #d8d8d4; padding-top: 1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #e3e3df;
  white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
th { font-weight: 600; color: #5d6167; }
code { font-size: 13px; background: #efefeb; padding: .1rem .3rem; }
img, svg { max-width: 100%; height: auto; }
figure { margin: 1rem 0; }
figcaption { color: #5d6167; font-size: 14px; }
.good { color: #1a7f4b; } .bad { color: #b3361f; }
"""


def write_page(report: Report, path: Path) -> Path:
    """Writes the page: everything is in the one file. Raises OSError."""
    body = ["<h1>Clearing a table of connecting rods</h1>"]
    if report.runs:
        body.append(_overview(report))
    for title, summary in report.runs.items():
        body.append(_run_html(title, summary))
    for comparison in report.comparisons:
        run = comparison["variants"][0]["summary"]["run"]
        body.append(f"<h2>{html.escape(comparison['title'])}</h2>")
        body.append(
            f"<p><code>{html.escape(comparison['command'])}</code>: {run['trials']} trials of each "
            f"scene from seed {run['first_seed']} on, the same for each row.</p>"
        )
        body.append(_table(*comparison_rows(comparison)))
        body.append(f"<figure>{figures.as_svg(figures.comparison_figure(comparison))}</figure>")
    body += [_example_html(example) for example in report.examples]
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Trials</title><style>{_CSS}</style></head><body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(page)
    shutil.move(temporary, path)
    return path


def _overview(report: Report) -> str:
    lines = []
    for title, summary in report.runs.items():
        average = percent(summary["average_success_rate"])
        lines.append(f"<li>{html.escape(title)}: {average} of the trials succeed</li>")
    return (
        f"<ul>{''.join(lines)}<li>paper: 50, 46 and 43 of 50 trials, 92.7 % on average</li></ul>"
        f"<figure>{figures.as_svg(figures.success_figure(report.runs))}"
        "<figcaption>Bars: Wilson 95 % intervals, the paper's from its 50 trials a scene."
        "</figcaption></figure>"
        "<p>A trial succeeds when every object ends in the tray by its first grasp without slip "
        "(5 mm, 5 deg), drop or collision; the simulator's judge says so.</p>"
    )


def _failed(summary: dict) -> bool:
    return any(scene["successes"] < scene["trials"] for scene in summary["scenes"].values())


def _run_html(title: str, summary: dict) -> str:
    run = summary["run"]
    failures = ["<h3>No trial failed</h3>"]
    if _failed(summary):
        failures = [
            "<h3>Failed trials by what failed first</h3>",
            f"<figure>{figures.as_svg(figures.cause_figure(summary))}</figure>",
            _table(*_without_empty(*cause_rows(summary))),
        ]
    return "\n".join(
        [
            f"<h2>{html.escape(title)}</h2>",
            f"<p><code>{html.escape(command_line(run))}</code><br>"
            f"{html.escape(conditions_line(run))}.{html.escape(_code(summary))}</p>",
            _table(*_without_empty(*success_rows(summary))),
            "<p>GSR: grasps that succeed of all that were tried. Pushes: objects pushed aside, not "
            "gripped, where no grasp was good (the paper has none). Slip and placement: median / "
            "largest. picks/h counts computation at its wall time.</p>",
            *failures,
        ]
    )


def _example_html(example: Replay) -> str:
    record = example.record
    name = f"{record['scene'].replace('_', ' ')}, seed {record['seed']}"
    end = (
        '<span class="good">success</span>'
        if record["success"]
        else f'<span class="bad">failed: {html.escape(", ".join(causes(record)))}</span>'
    )
    parts = [f"<h2>Example: {name}</h2><p>{end}, {record['sim_time_s']:.1f} s simulated</p>"]
    if example.frames:
        film = io.BytesIO()
        write_gif(film, example.frames, example.captions())
        parts.append(_figure_html(_data("gif", film.getvalue()), "The trial, four frames a second"))
    if example.plans:
        first = example.plans[0]
        chosen = {t.object_id: t.grasp for t in first.targets if t.feasible}
        for picture, caption in (
            (scene_picture(first.look), "Scene: empty depth, colour, depth"),
            (boxes_picture(first.look), "Boxes of the detector"),
            (merged_depth_picture(first.look), "Merged depth, what the grasp network sees"),
            (grasps_picture(first.look, first.ranking, chosen), "Grasps, scores and order"),
        ):
            parts.append(_figure_html(_jpeg(picture), caption))
    strip = trial_strip(record, example.plans, example.frames)
    parts.append(_figure_html(_jpeg(strip), "Pick by pick: the grasp that was chosen, the lift"))
    return "\n".join(parts)


def _table(head: list[str], rows: Rows) -> str:
    cells = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    lines = "".join(
        "<tr>" + "".join(f"<td>{html.escape(value)}</td>" for value in row) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><tr>{cells}</tr>{lines}</table></div>'


def _figure_html(source: str, caption: str) -> str:
    text = html.escape(caption)
    return f'<figure><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def _jpeg(image: np.ndarray, most: int = 1600) -> str:
    picture = Image.fromarray(image)
    picture.thumbnail((most, 10 * most))
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=82)
    return _data("jpeg", data.getvalue())


def _data(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
