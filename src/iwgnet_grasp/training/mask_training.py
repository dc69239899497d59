"""`iwgnet train mask`: the networks that tell a part's pixels from its neighbours'."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.progress import Progress
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from iwgnet_grasp.data.augmentation import Augmentation
from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.mask_dataset import MaskDataset, MaskViews, find_masks, load_mask_views
from iwgnet_grasp.data.patch_dataset import PatchDataset
from iwgnet_grasp.networks import count_parameters, object_mask, same_part
from iwgnet_grasp.networks.object_mask import ObjectMask, mask_loss
from iwgnet_grasp.networks.weights import load_state, save_weights, weights_path
from iwgnet_grasp.training.card import describe_set
from iwgnet_grasp.training.fitting import SmallTraining, fit, prepare


@dataclass(frozen=True)
class _Task:
    """What the networks differ in."""

    network: Callable[[], ObjectMask]
    augmentation: Augmentation
    dataset: Callable[..., Dataset]  # of MaskViews, augmentation and seed
    input_px: int


TASKS = {
    object_mask.NAME: _Task(
        ObjectMask,
        Augmentation(any_turn=False),  # which object is meant is told by its upright box
        MaskDataset,
        object_mask.INPUT_PX,
    ),
    same_part.NAME: _Task(
        lambda: ObjectMask(same_part.CHANNELS),
        Augmentation(shift_px=0.0),
        PatchDataset,
        same_part.VIEW_CELLS,
    ),
}


@dataclass(frozen=True)
class MaskTrainingSettings:
    """Everything that decides the result, stored in the card."""

    network: str = object_mask.NAME  # of TASKS
    epochs: int = 20
    batch: int = 8
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    warm_up: float = 0.05  # share of the steps
    seed: int = 0


class MaskTraining(SmallTraining):
    """AdamW with a one-cycle schedule on mask_loss, validated by the mean IoU of the masks."""

    def __init__(
        self, settings: MaskTrainingSettings, training: MaskViews, validation: MaskViews
    ) -> None:
        self.task = TASKS[settings.network]
        super().__init__(settings, self.task.network(), len(training))
        self.views, self.held_out = training, validation

    def train_dataloader(self) -> DataLoader:
        task = self.task
        return self.shuffled(lambda seed: task.dataset(self.views, task.augmentation, seed))

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.task.dataset(self.held_out), self.settings.batch)

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        windows, masks = batch
        loss = mask_loss(self.logits(windows), masks)
        self.log("train/loss", loss, batch_size=len(masks))
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        windows, masks = batch
        logits = self.logits(windows)
        scores = {"val/loss": mask_loss(logits, masks), "val/iou": iou(logits > 0, masks > 0.5)}
        self.log_dict(scores, batch_size=len(masks), prog_bar=True)


def iou(found: Tensor, truth: Tensor) -> Tensor:
    """Mean intersection over union of masks [N, H, W] bool; 1 where both are empty."""
    both = (found & truth).sum((1, 2))
    either = (found | truth).sum((1, 2))
    return torch.where(either > 0, both / either.clamp(min=1), 1.0).mean()


def train_mask_network(
    settings: MaskTrainingSettings,
    data: list[Path],
    validation_data: Path,
    out: Path,
    log_dir: Path,
    initial: str | None = None,
    resume: bool = False,
    threads: int = 0,
) -> Path:
    """Writes OUT/NETWORK.safetensors and its card after the last epoch; returns the path.

    DataError names data that cannot be used. `resume` goes on from LOG_DIR/NETWORK/last.ckpt.
    KeyboardInterrupt when the user stops it.
    """
    prepare(settings.seed, threads)
    folders = [*data, validation_data]
    missing = [folder for folder in folders if not folder.is_dir()]
    if missing:
        raise DataError(f"{missing[0]}: no such folder; make a set with 'iwgnet dataset'")
    with Progress(transient=True) as bar:
        total = sum(len(find_masks(folder)) for folder in folders)
        task = bar.add_task("reading samples", total=total)
        training = load_mask_views(data, lambda: bar.advance(task))
        validation = load_mask_views([validation_data], lambda: bar.advance(task))
    module = MaskTraining(settings, training, validation)
    if initial and not resume:
        load_state(module.network, weights_path(initial), settings.network)
    scores = fit(module, settings.epochs, log_dir / settings.network, resume)
    card = {
        "network": settings.network,
        "parameters": count_parameters(module.network),
        "input_px": module.task.input_px,
        "data": {
            "training": [describe_set(folder) for folder in data],
            "samples": len(training),
            "validation": describe_set(validation_data),
            "validation_samples": len(validation),
        },
        "training": asdict(settings) | ({"initial": initial} if initial else {}),
        "augmentation": asdict(module.task.augmentation),
        "validation": {key: round(scores[f"val/{key}"], 4) for key in ("loss", "iou")},
        "torch": torch.__version__,
    }
    return save_weights(module.network, out / f"{settings.network}.safetensors", card)


def train_mask(
    data: Annotated[
        list[Path], typer.Option(help="Folder of 'iwgnet dataset'; give it again for more.")
    ] = [Path("data/train")],  # noqa: B006
    validation_data: Annotated[Path, typer.Option(help="Folder to validate on.")] = Path(
        "data/val"
    ),
    network: Annotated[
        str, typer.Option(help=f"{' or '.join(TASKS)}: of an object's box, of a part's patch.")
    ] = object_mask.NAME,
    epochs: Annotated[int, typer.Option(min=1)] = 20,
    batch: Annotated[int, typer.Option(min=1)] = 8,
    learning_rate: Annotated[float, typer.Option(min=1e-7)] = 3e-3,
    seed: Annotated[int, typer.Option(help="Of weights, order and augmentation.")] = 0,
    initial: Annotated[
        str | None, typer.Option(help="Weights to start from: a name in models/ or a path.")
    ] = None,
    resume: Annotated[bool, typer.Option(help="Go on from the last checkpoint.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the weights and their card.")] = Path(
        "models"
    ),
    log_dir: Annotated[Path, typer.Option(help="TensorBoard logs and checkpoint.")] = Path(
        "results/training"
    ),
    threads: Annotated[int, typer.Option(min=0, help="CPU threads of torch; 0: all.")] = 0,
) -> None:
    """Train a network of masks; writes OUT/NETWORK.safetensors and its card."""
    if network not in TASKS:
        raise typer.BadParameter(f"no network '{network}'; known: {', '.join(TASKS)}")
    settings = MaskTrainingSettings(
        network=network, epochs=epochs, batch=batch, learning_rate=learning_rate, seed=seed
    )
    try:
        weights = train_mask_network(
            settings, data, validation_data, out, log_dir, initial, resume, threads
        )
    except KeyboardInterrupt:
        typer.echo("stopped; the same command with --resume goes on", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"wrote {weights} and {weights.with_suffix('.json')}")
