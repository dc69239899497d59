"""Long work: how much is done, since when, how long it will still take, and how it is stopped."""

import signal

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


def progress_bar(quiet: bool = False) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        disable=quiet,
    )


def interrupt_on(*signals: signal.Signals) -> None:
    """Makes KeyboardInterrupt of these signals: a shell starts what runs in its background with
    SIGINT ignored, and SIGTERM would end a process without any clearing up."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    for number in signals:
        signal.signal(number, interrupt)
