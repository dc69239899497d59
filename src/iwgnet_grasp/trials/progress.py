"""What a person sees of a run: a bar with ETA and running rate, a line for each failed trial."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

from iwgnet_grasp.trials.batch import Run
from iwgnet_grasp.trials.statistics import Record, causes


class Progress:
    """A bar on a terminal; without one, a line for each trial."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self.finished = 0
        self._good = 0

    def __enter__(self) -> Progress:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def begin(self, run: Run, name: str = "") -> None:
        self.finished = self._good = 0
        self._total = len(run.tasks())
        self._name = name
        self._task = self._bars.add_task(name or "trials", total=self._total, rate="")

    def found(self, records: list[Record]) -> None:
        """Trials that were there before."""
        if records:
            self.say(f"{len(records)} trials are there already")
        self.finished += len(records)
        self._good += sum(record["success"] for record in records)
        self._show()
        # What was there took no time now: the estimate goes by what is left.
        self._bars.reset(self._task, completed=self.finished, total=self._total, rate=self._rate())

    def add(self, record: Record) -> None:
        self.finished += 1
        self._good += record["success"]
        self._show()
        if not record["success"] or not self._console.is_terminal:
            rate = "" if self._console.is_terminal else f"  [{self._rate()}]"
            self.say(trial_line(record) + rate)

    def say(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _rate(self) -> str:
        share = 100 * self._good / self.finished if self.finished else 0
        return f"{self._good}/{self.finished} succeed, {share:.0f} %" if self.finished else ""

    def _show(self) -> None:
        self._bars.update(self._task, completed=self.finished, rate=self._rate())


def trial_line(record: Record) -> str:
    """A trial's end in one line."""
    good = sum(pick["success"] for pick in record["picks"])
    line = (
        f"{'success' if record['success'] else 'FAILED '}  {record['scene']} seed {record['seed']}"
        f"  {good}/{len(record['picks'])} picks"
    )
    if record["in_tray"] is not None:
        line += f", {record['in_tray']}/{record['objects']} in the tray"
    line += f"  {record['sim_time_s']:.1f} s simulated, {record['wall_time_s']:.1f} s wall"
    why = causes(record)
    if why:
        line += f"  ({', '.join(why)})"
    return line + (f": {record['error']}" if record["error"] else "")
