"""`scripts/run_trials`: tables of trials, comparisons, replays and reports."""

from __future__ import annotations

import signal
import sys
import time
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from iwgnet_grasp.cluster import ClusterError
from iwgnet_grasp.overrides import parse_overrides
from iwgnet_grasp.progress import interrupt_on
from iwgnet_grasp.supervisor import CellError
from iwgnet_grasp.trials.batch import (
    BatchError,
    Run,
    read_records,
    read_run,
    read_summary,
    run_trials,
    scene_names,
)
from iwgnet_grasp.trials.comparison import compare, named_comparison, read_comparison, sweep
from iwgnet_grasp.trials.pool import PoolError
from iwgnet_grasp.trials.progress import Progress, trial_line
from iwgnet_grasp.trials.table import print_comparison, print_table
from iwgnet_grasp.trials.worker import PACKAGE, Conditions

app = typer.Typer(
    name="run_trials",
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_UsageError = typer.BadParameter.__base__  # typer does not give it a name of its own
Replan = StrEnum("Replan", ["once", "every"])
Transport = StrEnum("Transport", ["inprocess", "ros"])

SceneOption = Annotated[
    str, typer.Option("--scene", help="Of config/scenes.yaml, several with commas, or all.")
]
TrialsOption = Annotated[int, typer.Option("--trials", help="Trials of each scene.")]
SeedOption = Annotated[int, typer.Option("--seed", help="Of the first trial; they count up.")]
ReplanOption = Annotated[
    Replan, typer.Option(help="every: look again after each pick; once: one look (paper).")
]
TransportOption = Annotated[Transport, typer.Option(help="In one process or over the ROS graph.")]
WorkersOption = Annotated[int, typer.Option(min=1, help="Trials at a time; Ray from 2 on.")]
AddressOption = Annotated[
    str | None, typer.Option(help="Ray cluster: HOST:PORT, ray://HOST:PORT or auto.")
]
SetOption = Annotated[
    list[str], typer.Option("--set", help="FILE.KEY=VALUE of config/; give it again for more.")
]
CalibrationOption = Annotated[
    Path | None, typer.Option(help="File with the camera pose to plan with; else the nominal one.")
]
CameraOffsetOption = Annotated[
    int, typer.Option(min=-1, help="Seed of what the camera's mounting is off by; -1: nothing.")
]


@app.callback(invoke_without_command=True)
def run(
    context: typer.Context,
    scene: SceneOption = "all",
    trials: TrialsOption = 50,
    seed: SeedOption = 0,
    replan: ReplanOption = Replan.every,
    transport: TransportOption = Transport.inprocess,
    workers: WorkersOption = 1,
    address: AddressOption = None,
    changes: SetOption = [],  # noqa: B006
    calibration: CalibrationOption = None,
    camera_offset: CameraOffsetOption = -1,
    out: Annotated[
        Path | None, typer.Option(help="Folder; one that holds this run is gone on with.")
    ] = None,
) -> None:
    """Clears simulated tables, trial after trial, and says how often that succeeds.

    Example: scripts/run_trials --scene ten_stacked --trials 50 --workers 2

    Exit status: 0 all trials have run, 1 they broke off, 2 bad arguments.
    """
    if context.invoked_subcommand:
        return
    scenes = chosen_scenes(scene)
    conditions = Conditions(
        replan.value,
        transport.value,
        parse_overrides(changes),
        _existing(calibration),
        camera_offset,
    )
    out = out or _new_folder(scene)
    with Progress() as progress:
        summary = run_shown(Run(scenes, trials, seed, conditions), out, workers, address, progress)
    print_table(summary)
    typer.echo(f"trials and summary in {out}")


@app.command("replay")
def replay_command(
    seed: Annotated[int, typer.Option(min=0, help="Of the trial.")],
    scene: Annotated[str, typer.Option(help="Of config/scenes.yaml.")],
    out: Annotated[Path, typer.Option(help="Folder for trial.json, pictures, strip and film.")],
    like: Annotated[
        Path | None, typer.Option(help="Folder of a run: its settings, and its trial to compare.")
    ] = None,
    replan: ReplanOption = Replan.every,
    changes: SetOption = [],  # noqa: B006
    calibration: CalibrationOption = None,
    camera_offset: CameraOffsetOption = -1,
    frames: Annotated[bool, typer.Option("--frames", help="Write each frame, too.")] = False,
) -> None:
    """Runs one trial of a table again, in process, and writes a film and a strip of it.

    Example: scripts/run_trials replay --like DIR --scene ten_stacked --seed 7 --out DIR/replay

    To watch it in rviz: scripts/start_grasping scene:=ten_stacked seed:=7 rviz:=true
    """
    from iwgnet_grasp.trials.replay import differences, replay, write_replay

    scenes = chosen_scenes(scene)
    if len(scenes) != 1:
        raise BatchError(f"--scene {scene}: a replay is of one scene")
    conditions = Conditions(
        replan.value, "inprocess", parse_overrides(changes), _existing(calibration), camera_offset
    )
    before = None
    if like is not None:
        if changes or calibration or camera_offset >= 0 or replan is not Replan.every:
            raise BatchError("--like: takes all settings from the run; give none beside it")
        conditions = replace(read_run(like).conditions, transport="inprocess")
        found = [r for r in read_records(like) if (r["scene"], r["seed"]) == (scenes[0], seed)]
        if not found:
            raise BatchError(f"--like {like}: holds no trial of {scene} with seed {seed}")
        before = found[0]
    result = replay(conditions, scenes[0], seed)
    paths = write_replay(result, out, frames)
    typer.echo(trial_line(result.record))
    if before is not None:
        different = differences(before, result.record)
        typer.echo(
            f"differs from the trial in {like} in: {', '.join(different)}; the code, the settings "
            f"or the backend changed since (commit {before.get('commit')})"
            if different
            else f"the same trial as in {like}"
        )
    typer.echo(f"wrote {', '.join(str(path) for path in paths)} and the pictures of each look")


@app.command("compare")
def compare_command(
    name: Annotated[
        str | None, typer.Argument(help="Of config/comparisons.yaml, such as priority.")
    ] = None,
    axes: Annotated[
        list[str], typer.Option("--sweep", help="FILE.KEY=V1,V2,...; two give every combination.")
    ] = [],  # noqa: B006
    scene: SceneOption = "ten_stacked",
    trials: TrialsOption = 20,
    seed: SeedOption = 200,
    replan: ReplanOption = Replan.every,
    transport: TransportOption = Transport.inprocess,
    workers: WorkersOption = 1,
    address: AddressOption = None,
    changes: SetOption = [],  # noqa: B006
    calibration: CalibrationOption = None,
    camera_offset: CameraOffsetOption = -1,
    out: Annotated[
        Path | None, typer.Option(help="Folder; one that holds this comparison is gone on with.")
    ] = None,
) -> None:
    """Runs variants of the settings on the same seeds: a named comparison, or a sweep.

    Examples: scripts/run_trials compare priority --trials 30

    scripts/run_trials compare --sweep priority.beta=0,0.5,1,2,4 --scene seven_stacked,ten_stacked
    """
    if (name is None) == (not axes):
        raise BatchError("compare: give a comparison's name, or --sweep FILE.KEY=V1,V2,...")
    comparison = named_comparison(name) if name else sweep(axes)
    conditions = Conditions(
        replan.value,
        transport.value,
        parse_overrides(changes),
        _existing(calibration),
        camera_offset,
    )
    base = Run(chosen_scenes(scene), trials, seed, conditions)
    out = out or _new_folder(f"compare_{comparison.name}")
    with Progress() as progress:
        result = compare(
            comparison,
            base,
            out,
            lambda run, folder, title: run_shown(run, folder, workers, address, progress, title),
        )
    print_comparison(result)
    typer.echo(f"trials, summaries and comparison in {out}")


@app.command("report")
def report_command(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, the headline first.")],
    comparisons: Annotated[
        list[Path], typer.Option("--compare", help="Folder of a comparison; again for more.")
    ] = [],  # noqa: B006
    page: Annotated[Path, typer.Option("--html", help="The page to write.")] = PACKAGE
    / "results"
    / "trials.html",
    docs: Annotated[bool, typer.Option(help="Write docs/results.md, too.")] = True,
    examples: Annotated[
        bool, typer.Option(help="Replay the first run's first trial of each scene, with a film.")
    ] = True,
) -> None:
    """Writes the page and docs/results.md of finished runs and comparisons.

    Example: scripts/run_trials report RUN_EVERY RUN_ONCE --compare PRIORITY --compare NETWORKS
    """
    from iwgnet_grasp.report.trial_report import Report, write_docs, write_page
    from iwgnet_grasp.trials.replay import replay

    summaries = {}
    for folder in runs:
        summary = read_summary(folder)
        once = summary["run"]["replan"] == "once"
        title = "One look, one sequence" if once else "A look after each pick"
        if summary["run"]["transport"] == "ros":
            title += ", over ROS"
        if title in summaries:
            title += f" ({folder.name})"
        summaries[title] = summary
    compared = [read_comparison(folder) for folder in comparisons]
    shown = []
    if examples:
        run = read_run(runs[0])
        conditions = replace(run.conditions, transport="inprocess")
        for scene in run.scenes:
            typer.echo(f"replaying {scene} seed {run.first_seed}", err=True)
            shown.append(replay(conditions, scene, run.first_seed))
    report = Report(summaries, compared, shown)
    typer.echo(f"wrote {write_page(report, page)}")
    if docs:
        typer.echo(f"wrote the sections {', '.join(write_docs(report))} of docs/results.md")


def run_shown(
    run: Run, out: Path, workers: int, address: str | None, progress: Progress, name: str = ""
) -> dict:
    """run_trials() with a progress bar."""
    progress.begin(run, name)
    try:
        return run_trials(run, out, workers, address, progress.found, progress.add, progress.say)
    except (KeyboardInterrupt, CellError, PoolError):
        if progress.finished:
            progress.say(
                f"{progress.finished} finished trials are in {out}; the same command with "
                f"--out {out} goes on from there"
            )
        raise


def chosen_scenes(text: str) -> tuple[str, ...]:
    """The scenes of --scene. Raises BatchError."""
    known = scene_names()
    names = known if text == "all" else text.split(",")
    for name in names:
        if name not in known:
            raise BatchError(f"--scene: '{name}' is not one of all, {', '.join(known)}")
    return tuple(dict.fromkeys(names))


def _new_folder(name: str) -> Path:
    return PACKAGE / "results" / "runs" / f"{time.strftime('%Y%m%d-%H%M%S')}_{name}"


def _existing(path: Path | None) -> str:
    if path is None:
        return ""
    if not path.is_file():
        raise BatchError(f"--calibration {path}: no such file")
    return str(path.resolve())


def main() -> None:
    """Entry point: what a user can mend ends in one line."""
    interrupt_on(signal.SIGTERM)
    try:
        status = app(prog_name="run_trials", standalone_mode=False)
        if status == 130:  # what typer makes of ctrl-C
            _end("interrupted", 1)
    except (typer.Abort, KeyboardInterrupt):
        _end("interrupted", 1)
    except _UsageError as error:
        _end(" ".join(error.format_message().split()), 2)
    except (CellError, PoolError) as error:
        _end(str(error), 1)
    except (BatchError, ClusterError, ValueError) as error:
        _end(str(error), 2)
    except OSError as error:
        _end(f"{error.filename or 'file'}: {error.strerror or error}", 2)


def _end(line: str, status: int) -> None:
    print(f"run_trials: {line}", file=sys.stderr)
    sys.exit(status)
