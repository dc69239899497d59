"""The table of a run, as the paper's, on the terminal and as Markdown."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from iwgnet_grasp.trials.statistics import CAUSES, PAPER_SUCCESSES, PAPER_TRIALS

Rows = list[list[str]]


def success_rows(summary: dict) -> tuple[list[str], Rows]:
    """Head and rows: a scene a row, the paper's figure beside ours."""
    head = ["scene", "success", "rate", "95 % interval", "paper", "attempts", "GSR", "pushes"]
    head += ["set aside", "cleared", "picks/h", "slip mm", "slip deg", "placement mm"]
    head += ["simulated s", "wall s", "x real"]
    rows = []
    for scene, s in summary["scenes"].items():
        paper = PAPER_SUCCESSES.get(scene)
        rows.append(
            [
                scene.replace("_", " "),
                f"{s['successes']}/{s['trials']}",
                percent(s["success_rate"]),
                interval(s["interval_95"]),
                f"{paper}/{PAPER_TRIALS} ({percent(paper / PAPER_TRIALS)})" if paper else "",
                *_speed_and_care(s),
            ]
        )
    if len(rows) > 1:
        s = summary["all"]
        full = all(scene in summary["scenes"] for scene in PAPER_SUCCESSES)
        average = sum(PAPER_SUCCESSES.values()) / len(PAPER_SUCCESSES) / PAPER_TRIALS
        rows.append(
            [
                "all",
                f"{s['successes']}/{s['trials']}",
                percent(summary["average_success_rate"]),
                interval(s["interval_95"]),
                percent(average) if full else "",
                *_speed_and_care(s),
            ]
        )
    return head, rows


def cause_rows(summary: dict) -> tuple[list[str], Rows]:
    """Head and rows: failed trials by what failed first."""
    counted = [s["failed_trials_by_cause"] for s in summary["scenes"].values()]
    others = sorted({cause for counts in counted for cause in counts} - set(CAUSES))
    head = ["scene", "failed", *CAUSES, *others, "seeds"]
    rows = []
    for scene, s in summary["scenes"].items():
        counts = s["failed_trials_by_cause"]
        rows.append(
            [
                scene.replace("_", " "),
                str(s["trials"] - s["successes"]),
                *(str(counts.get(cause, 0)) for cause in (*CAUSES, *others)),
                " ".join(sorted(s["failed_seeds"], key=int)),
            ]
        )
    return head, rows


def comparison_rows(comparison: dict) -> tuple[list[str], Rows]:
    """Head and rows: a variant and scene a row."""
    head = ["variant", "scene", "success", "rate", "95 % interval", "GSR", "pushes"]
    head += ["cleared", "picks/h"]
    rows = []
    for variant in comparison["variants"]:
        for scene, s in variant["summary"]["scenes"].items():
            rows.append(
                [
                    variant["name"],
                    scene.replace("_", " "),
                    f"{s['successes']}/{s['trials']}",
                    percent(s["success_rate"]),
                    interval(s["interval_95"]),
                    percent(s["gsr"]),
                    str(s.get("pushes", 0)),
                    percent(s["cleared"]),
                    number(s["picks_per_hour"]),
                ]
            )
    return head, rows


def print_comparison(comparison: dict) -> None:
    head, rows = comparison_rows(comparison)
    table = Table(title=comparison["title"], box=None, padding=(0, 2, 0, 0), header_style="")
    for i, name in enumerate(head):
        table.add_column(name, justify="left" if i < 2 else "right")
    for row in rows:
        table.add_row(*row)
    _console().print(table)


def print_table(summary: dict) -> None:
    console = _console()
    for head, rows in (success_rows(summary), cause_rows(summary)):
        # A column a figure does not fit 80 columns: the figures stand below each other.
        table = Table(box=None, padding=(0, 2, 0, 0), show_header=True, header_style="")
        columns = list(zip(head, *rows, strict=True))
        table.add_column("")
        for row in rows:
            table.add_column(row[0], justify="right", overflow="fold")
        for name, *values in columns[1:]:
            if any(value not in ("", "0") for value in values) or name in ("success", "failed"):
                table.add_row(name, *values)
        console.print(table)
        console.print()
    if len(summary["commits"]) > 1:
        console.print(
            f"the trials ran with {len(summary['commits'])} versions of the code: "
            + ", ".join(summary["commits"])
        )


def markdown(head: list[str], rows: Rows) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _console() -> Console:
    console = Console(highlight=False)
    if not console.is_terminal:  # a file has no edge to break lines at
        console.width = 200
    return console


def percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %".replace("100.0", "100")


def interval(bounds: list[float]) -> str:
    return f"{100 * bounds[0]:.0f}-{100 * bounds[1]:.0f} %"


def number(value: float | None, digits: int = 0) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _speed_and_care(s: dict) -> list[str]:
    def spread(value: dict | None) -> str:
        return f"{value['median']:.1f} / {value['max']:.1f}" if value else ""

    trials = max(s["trials"], 1)
    return [
        f"{s['good_attempts']}/{s['attempts']}",
        percent(s["gsr"]),
        str(s.get("pushes", 0)),  # neither is in the summary of an older run
        str(s.get("set_aside", 0)),
        percent(s["cleared"]),
        number(s["picks_per_hour"]),
        spread(s["slip_mm"]),
        spread(s["slip_deg"]),
        spread(s["placement_mm"]),
        number(s["sim_time_s"] / trials, 1),
        number(s["wall_time_s"] / trials, 1),
        number(s["times_real"], 1),
    ]
