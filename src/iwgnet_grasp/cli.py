"""`scripts/iwgnet`: the command line of the learning side.

Torch is imported by the commands that need it, so that help and refusals come at once.
"""

import logging
import warnings
from collections.abc import Callable
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
    help="Train a grasp network on a folder of grasp data, or the [b]detector[/b].\n\n"
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
    batch: Annotated[int, typer.Option(min=1, help="Images a step and device.")] = 16,
    learning_rate: Annotated[float, typer.Option(min=1e-7)] = 2e-3,
    split: Annotated[
        Split, typer.Option(help="Hold out whole objects (or scenes), or single images.")
    ] = Split["object"],
    limit: Annotated[int, typer.Option(min=0, help="Use the first N samples; 0: all.")] = 0,
    patience: Annotated[
        int, typer.Option(min=0, help="Stop after N epochs without a better top-1; 0: never.")
    ] = 0,
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
        seed=seed,
    )
    typer.echo(f"seed {seed}, network {network}, data {', '.join(map(str, data))}")
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


@app.command("evaluate")
def evaluate(
    weights: Annotated[
        list[str], typer.Option(help="Name in models/ or path; give it again for more.")
    ] = ["iwgnet"],  # noqa: B006
    data: Annotated[Path, typer.Option(help="Held-out folder.")] = Path("data/val"),
    backend: Annotated[str, typer.Option(help="auto, openvino or torch.")] = "auto",
    limit: Annotated[int, typer.Option(min=0, help="Use the first N samples; 0: all.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Also write this file.")] = None,
) -> None:
    """Rectangle metric, errors and latency of trained grasp networks, as a Markdown table."""
    from iwgnet_grasp.training import evaluation

    rows = [evaluation.evaluate(name, data, backend, limit) for name in weights]
    typer.echo(evaluation.as_markdown(rows), nl=False)
    if json_file:
        evaluation.write_json(json_file, data, rows)


@app.command("dataset", context_settings=_FORWARD)
def dataset(context: typer.Context) -> None:
    """Make a labelled data set with the simulator; options: iwgnet dataset --help."""
    from iwgnet_grasp.data import generate

    _forward(context, generate.generate, "dataset")


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
