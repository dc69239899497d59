"""Measures the project's figures and prints them beside their goals and peers.

scripts/benchmark [--only NAME ...] [--peers] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from iwgnet_grasp.benchmark.measure import BenchmarkError
from iwgnet_grasp.benchmark.rows import ROWS, Result, Run


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="scripts/benchmark",
        description="Measures the project's figures: name, ours, goal, peer, ratio.",
        epilog="rows: " + ", ".join(f"{row.name} ({row.what})" for row in ROWS),
    )
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="this row alone; may be repeated"
    )
    parser.add_argument(
        "--peers",
        action="store_true",
        help="measure the peers in the same run (installs them into .venv-peers once)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there as well")
    arguments = parser.parse_args()
    known = {row.name: row for row in ROWS}
    for name in arguments.only or []:
        if name not in known:
            parser.error(f"no row '{name}'; known: {', '.join(known)}")
    rows = [known[name] for name in arguments.only] if arguments.only else list(ROWS)

    console = Console()
    results: list[Result] = []
    failed = False
    for row in rows:

        def say(text: str, name: str = row.name) -> None:
            console.print(f"{name}: {text}", style="dim")

        with console.status(f"{row.name}: {row.what} ..."):
            try:
                results.append(row.measure(Run(arguments.peers, say)))
            except BenchmarkError as error:
                failed = True
                console.print(f"{row.name}: {error}", style="red")
                continue
        print_line(console, results[-1])
    console.print(table(results))
    if arguments.json:
        machine = {"cores": os.cpu_count(), "platform": platform.platform()}
        text = json.dumps({"machine": machine, "rows": [r.as_dict() for r in results]}, indent=2)
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(text + "\n")
    return 1 if failed else 0


def print_line(console: Console, result: Result) -> None:
    console.print(f"{result.name}: {result.value:.4g} {result.unit}  ({result.detail})")


def table(results: list[Result]) -> Table:
    view = Table(title="iwgnet_grasp benchmark")
    for heading in ("name", "ours", "goal", "met", "peer", "ours / peer"):
        view.add_column(heading)
    for r in results:
        view.add_row(
            r.name,
            f"{r.value:.4g} {r.unit}",
            r.goal.text(r.unit) if r.goal else "",
            "" if r.met is None else ("yes" if r.met else "NO"),
            f"{r.peer_value:.4g} {r.unit} {r.peer}" if r.peer_value is not None else "",
            f"{r.value / r.peer_value:.3g}" if r.peer_value else "",
        )
    return view


if __name__ == "__main__":
    sys.exit(main())
