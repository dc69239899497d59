"""`scripts/iwgnet`: the command line of the learning side.

Torch is imported by the commands that need it, so that help and refusals come at once.
"""

import logging
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from iwgnet_grasp.data.errors import DataError

app = typer.Typer(
    name="iwgnet",
    help="Data, training and evaluation of the grasp networks and of the detector.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
train_app = typer.Typer(
    help="Train a grasp network on a folder of grasp data, the [b]detector[/b] or the object "
    "[b]mask[/b] network.\n\n"
    "Example: iwgnet train --network iwgnet --data data/train --epochs 30",
    invoke_without_command=True,
    rich_markup_mode="rich",
)
app.add_typer(train_app, name="train")

Split = StrEnum("Split", {"object": "object", "image": "image"})


@train_app.callback()
def train(
    context: typer.Context,
    network: Annotated[
        str,
        typer.Option(
            help="iwgnet; without one of its modules: iwgnet-noinception, iwgnet-nowff; "
            "a rival: ggcnn, ggcnn2, grconvnet."
        ),
    ] = "iwgnet",
    data: Annotated[
        list[Path],
        typer.Option(help="Folder in Jacquard's or Cornell's layout; give it again for more."),
    ] = [Path("data/train")],  # noqa: B006
    validation_data: Annotated[
        Path | None, typer.Option(help="Folder to validate on; by default a share of --data.")
    ] = None,
    initial: Annotated[
        str | None, typer.Option(help="Weights to start from: a name in models/ or a path.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the weights and their card.")] = Path(
        "models"
    ),
    log_dir: Annotated[Path, typer.Option(help="TensorBoard logs and checkpoints.")] = Path(
        "results/training"
    ),
    epochs: Annotated[int, typer.Option(min=1)] = 30,
    batch: Annotated[int, typer.Option(min=1, help="Images a step and device.")] = 8,
    learning_rate: Annotated[float, typer.Option(min=1e-7)] = 2e-3,
    split: Annotated[
        Split, typer.Option(help="Hold out whole objects (or scenes), or single images.")
    ] = Split["object"],
    limit: Annotated[int, typer.Option(min=0, help="Use the first N samples; 0: all.")] = 0,
    patience: Annotated[
        int, typer.Option(min=0, help="Stop after N epochs without a better top-1; 0: never.")
    ] = 0,
    hard_share: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Least share of crops of parts that are hard to grasp; 0: as they come.",
        ),
    ] = 0.5,
    quality_power: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=1,
            help="Of the labels' quality in what Q learns; 1: the mean quality of a place, lower: "
            "more whether there is a grasp at all.",
        ),
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Of weights, order, augmentation and split.")] = 0,
    resume: Annotated[bool, typer.Option(help="Go on from the last checkpoint.")] = False,
    accelerator: Annotated[str, typer.Option(help="auto, cpu or gpu.")] = "auto",
    devices: Annotated[int, typer.Option(min=1, help="GPUs (or CPU processes) a node.")] = 1,
    nodes: Annotated[int, typer.Option(min=1, help="Machines.")] = 1,
    workers: Annotated[int, typer.Option(min=0, help="Processes that prepare images.")] = 1,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads of torch; 0: all.")] = 0,
) -> None:
    """Train a grasp network; writes OUT/NETWORK.safetensors and OUT/NETWORK.json.

    Watch it with: tensorboard --logdir results/training
    """
    if context.invoked_subcommand:
        return
    from iwgnet_grasp.training.grasp_training import (
        GraspTrainingSettings,
        TrainingResources,
        train_grasp_network,
    )

    settings = GraspTrainingSettings(
        network=network,
        epochs=epochs,
        batch=batch,
        learning_rate=learning_rate,
        split=split.value,
        patience=patience,
        hard_share=hard_share,
        quality_power=quality_power,
        seed=seed,
    )
    typer.echo(f"seed {seed}, network {network}, data {', '.join(map(str, data))}")
    try:
        weights = train_grasp_network(
            settings,
            data,
            out,
            log_dir,
            validation_data=validation_data,
            initial=initial,
            resume=resume,
            limit=limit,
            resources=TrainingResources(accelerator, devices, nodes, workers, threads),
        )
    except KeyboardInterrupt:
        typer.echo("stopped; the same command with --resume goes on", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"wrote {weights} and {weights.with_suffix('.json')}")


_FORWARD = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


def _forward(context: typer.Context, command: Callable[..., None], name: str) -> None:
    """Runs a command of another module, with its own options and help."""
    inner = typer.Typer(rich_markup_mode="rich", pretty_exceptions_enable=False)
    inner.command()(command)
    inner(args=context.args, prog_name=f"iwgnet {name}")


@train_app.command("detector", context_settings=_FORWARD)
def train_detector(context: typer.Context) -> None:
    """Train the object detector (YOLOv5s); options: iwgnet train detector --help."""
    from iwgnet_grasp.training import detector

    _forward(context, detector.train_detector, "train detector")


@train_app.command("mask", context_settings=_FORWARD)
def train_mask(context: typer.Context) -> None:
    """Train the object mask network; options: iwgnet train mask --help."""
    from iwgnet_grasp.training import mask_training

    _forward(context, mask_training.train_mask, "train mask")


@train_app.command("outcome", context_settings=_FORWARD)
def train_outcome(context: typer.Context) -> None:
    """Train the network that foresees a pick's outcome; options: iwgnet train outcome --help."""
    from iwgnet_grasp.training import outcome_training

    _forward(context, outcome_training.train_outcome, "train outcome")


@app.command("evaluate")
def evaluate(
    weights: Annotated[
        list[str] | None,
        typer.Option(
            help="Name in models/ or path; give it again for more. Default: all grasp networks "
            "in models/."
        ),
    ] = None,
    data: Annotated[
        list[Path], typer.Option(help="Held-out folder in any layout; give it again for more.")
    ] = [Path("data/val")],  # noqa: B006
    backend: Annotated[str, typer.Option(help="auto: the fastest that agrees.")] = "auto",
    limit: Annotated[int, typer.Option(min=0, help="First N samples of a set; 0: all.")] = 0,
    lifts: Annotated[
        int,
        typer.Option(
            min=0,
            help="Objects of each set whose first grasp is carried out in Bullet (about 0.5 s a "
            "lift and network); 0: none.",
        ),
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Chooses the objects that are lifted.")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes that lift; 0: one a core.")] = 0,
    address: Annotated[
        str | None, typer.Option(help="Of a Ray cluster that lifts, instead of this machine.")
    ] = None,
    detector: Annotated[
        str, typer.Option(help="Weights of the detector: name in models/ or path; '': none.")
    ] = "yolov5s",
    out: Annotated[
        Path,
        typer.Option(help="Folder for evaluation.json, evaluation.md, plots and lifts.jsonl."),
    ] = Path("results/evaluation"),
    publish: Annotated[
        bool, typer.Option(help="Also write docs/results.md and its pictures.")
    ] = False,
) -> None:
    """Compare trained networks on held-out data: rectangle metric, lifts, calibration, latency.

    A run that was stopped goes on with the lifts it has. Example: iwgnet evaluate --data data/val
    --data data/test_rods
    """
    from iwgnet_grasp.networks.weights import weights_path
    from iwgnet_grasp.report.learning import write_report
    from iwgnet_grasp.training.comparison import compare_networks
    from iwgnet_grasp.training.evaluation import trained_networks

    comparison = compare_networks(
        weights or trained_networks(),
        data,
        out,
        backend=backend,
        limit=limit,
        lifts=lifts,
        seed=seed,
        workers=workers,
        address=address,
        detector=weights_path(detector) if detector else None,
    )
    for path in write_report(comparison, out, command_line(sys.argv[1:]), publish):
        typer.echo(f"wrote {path}", err=True)
    typer.echo((out / "evaluation.md").read_text(), nl=False)


def command_line(arguments: Sequence[str]) -> str:
    """The command as it can be typed again."""
    return shlex.join(["scripts/iwgnet", *arguments])


@app.command("dataset", context_settings=_FORWARD)
def dataset(context: typer.Context) -> None:
    """Make a labelled data set with the simulator; options: iwgnet dataset --help."""
    from iwgnet_grasp.data import generate

    _forward(context, generate.generate, "dataset")


@app.command("picks", context_settings=_FORWARD)
def picks(context: typer.Context) -> None:
    """Carry out grasps of simulated piles for 'train outcome'; options: iwgnet picks --help."""
    from iwgnet_grasp.data import pick_outcomes

    _forward(context, pick_outcomes.pick, "picks")


@app.command("export")
def export(
    weights: Annotated[
        str, typer.Option(help="Name in models/ or path, of a grasp network or the detector.")
    ] = "iwgnet",
    format_: Annotated[
        str, typer.Option("--format", help="onnx, openvino, tensorrt or all that are installed.")
    ] = "all",
    size: Annotated[
        int | None,
        typer.Option(min=32, help="Edge of a grasp network's input, px; by default its card's."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the files.")] = Path("results/export"),
    precision: Annotated[
        str | None,
        typer.Option(
            help="fp32, bf16, fp16 or int8: what a TensorRT engine may compute in (by default "
            "fp16); fp16 also halves the file of OpenVINO. ONNX is always fp32."
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of 'iwgnet dataset': calibrates int8 and is compared as well."),
    ] = None,
) -> None:
    """Write weights as ONNX, OpenVINO and TensorRT files for other programs.

    Each file is run and compared with torch in float32; one that differs is not written. Example:
    iwgnet export --weights iwgnet --size 300
    """
    from iwgnet_grasp.networks.export import PRECISIONS
    from iwgnet_grasp.networks.export import export as write

    formats = list(PRECISIONS) if format_ == "all" else [format_]
    written, left_out = write(weights, formats, out, size, precision, data)
    for file in written:
        typer.echo(
            f"wrote {out / file.file} ({file.precision}): differs from torch by at most "
            f"{file.largest_difference:.1e}, on average {file.mean_difference:.1e} "
            f"({file.inputs_compared} inputs)"
        )
    for line in left_out:
        typer.echo(f"left out {line}", err=True)


@app.command("calibrate", context_settings=_FORWARD)
def calibrate(context: typer.Context) -> None:
    """Solve a camera calibration again from its file; options: iwgnet calibrate --help."""
    from iwgnet_grasp.calibration import offline

    _forward(context, offline.calibrate, "calibrate")


def main() -> None:
    """Entry point: errors that a user can mend end in one line, not in a traceback."""
    logging.basicConfig(format="%(levelname)s %(message)s")
    warnings.filterwarnings("ignore", module="lightning|torch")
    try:
        app(prog_name="iwgnet")
    except (DataError, ValueError) as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(2) from None
    except OSError as error:
        typer.echo(f"error: {error.filename or 'file'}: {error.strerror or error}", err=True)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
