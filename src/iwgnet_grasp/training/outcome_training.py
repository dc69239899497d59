"""`iwgnet train outcome`: the network that foresees what becomes of a grasp."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import Progress
from torch import Tensor
from torch.utils.data import DataLoader

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.pick_outcomes import describe_picks
from iwgnet_grasp.data.pick_views import PickViewDataset, PickViews, load_pick_views, pile_files
from iwgnet_grasp.networks import count_parameters
from iwgnet_grasp.networks.pick_outcome import (
    NAME,
    OUTPUTS,
    PickOutcome,
    area_under_curve,
    outcome_loss,
)
from iwgnet_grasp.networks.weights import save_weights
from iwgnet_grasp.training.card import short_generator
from iwgnet_grasp.training.fitting import SmallTraining, fit, prepare


@dataclass(frozen=True)
class OutcomeTrainingSettings:
    """Everything that decides the result, stored in the card."""

    network: str = NAME
    epochs: int = 20
    batch: int = 32
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    warm_up: float = 0.1  # share of the steps
    held_out: float = 0.1  # share of the piles, the last ones
    seed: int = 0


class OutcomeTraining(SmallTraining):
    """Cross entropy, validated by how well the outputs order picks by what became of them."""

    def __init__(
        self, settings: OutcomeTrainingSettings, training: PickViews, validation: PickViews
    ) -> None:
        super().__init__(settings, PickOutcome(), len(training))
        self.picks, self.held_out = training, validation
        self._logits: list[Tensor] = []

    def train_dataloader(self) -> DataLoader:
        return self.shuffled(lambda seed: PickViewDataset(self.picks, seed))

    def val_dataloader(self) -> DataLoader:
        return DataLoader(PickViewDataset(self.held_out), self.settings.batch)

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        views, outcomes = batch
        loss = outcome_loss(self.logits(views), outcomes)
        self.log("train/loss", loss, batch_size=len(outcomes))
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        views, _ = batch
        self._logits.append(self.logits(views))

    def on_validation_epoch_end(self) -> None:
        logits = torch.cat(self._logits)
        self._logits.clear()
        truth = torch.from_numpy(self.held_out.outcomes)
        self.log("val/loss", outcome_loss(logits, truth.float()), prog_bar=True)
        for i, name in enumerate(OUTPUTS):
            area = area_under_curve(logits[:, i], truth[:, i])
            self.log(f"val/auc_{name}", area.float(), prog_bar=True)


def train_outcome_network(
    settings: OutcomeTrainingSettings,
    data: list[Path],
    out: Path,
    log_dir: Path,
    resume: bool = False,
    threads: int = 0,
) -> Path:
    """Writes OUT/pick-outcome.safetensors and its card after the last epoch; returns the path.

    DataError names data that cannot be used. `resume` goes on from LOG_DIR/pick-outcome/last.ckpt.
    KeyboardInterrupt when the user stops it.
    """
    prepare(settings.seed, threads)
    described, files, held_out = [], [], []
    for folder in data:
        piles = pile_files(folder)
        made = {"piles": len(piles)}  # fewer than were asked for where the run was stopped
        described.append({"folder": folder.name, **short_generator(describe_picks(folder)), **made})
        kept = len(piles) - max(round(settings.held_out * len(piles)), 1)
        files += piles[:kept]
        held_out += piles[kept:]
    if not files:
        raise DataError(f"{data[0]}: one pile is not enough, one is held out for validation")
    with Progress(transient=True) as bar:
        task = bar.add_task("reading piles", total=len(files) + len(held_out))
        training = load_pick_views(files, lambda: bar.advance(task))
        validation = load_pick_views(held_out, lambda: bar.advance(task))
    module = OutcomeTraining(settings, training, validation)
    scores = fit(module, settings.epochs, log_dir / NAME, resume)
    pose_only = area_under_curve(
        torch.from_numpy(validation.pose_quality), torch.from_numpy(validation.outcomes[:, 0])
    )
    card = {
        "network": NAME,
        "parameters": count_parameters(module.network),
        "data": {
            "training": described,
            "picks": len(training),
            "shares": dict(zip(OUTPUTS, np.round(training.outcomes.mean(0), 4), strict=True)),
            "validation_picks": len(validation),
        },
        "training": asdict(settings),
        "validation": {key.removeprefix("val/"): round(value, 4) for key, value in scores.items()}
        | {"auc_good_of_pose_quality": round(float(pose_only), 4)},
        "torch": torch.__version__,
    }
    return save_weights(module.network, out / f"{NAME}.safetensors", card)


def train_outcome(
    data: Annotated[
        list[Path], typer.Option(help="Folder of 'iwgnet picks'; give it again for more.")
    ] = [Path("data/picks")],  # noqa: B006
    epochs: Annotated[int, typer.Option(min=1)] = 20,
    batch: Annotated[int, typer.Option(min=1)] = 32,
    learning_rate: Annotated[float, typer.Option(min=1e-7)] = 2e-3,
    seed: Annotated[int, typer.Option(help="Of weights, order and augmentation.")] = 0,
    resume: Annotated[bool, typer.Option(help="Go on from the last checkpoint.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the weights and their card.")] = Path(
        "models"
    ),
    log_dir: Annotated[Path, typer.Option(help="TensorBoard logs and checkpoint.")] = Path(
        "results/training"
    ),
    threads: Annotated[int, typer.Option(min=0, help="CPU threads of torch; 0: all.")] = 0,
) -> None:
    """Train the network that foresees what becomes of a grasp, on picks of 'iwgnet picks'; writes
    OUT/pick-outcome.safetensors and its card. A tenth of the piles is held out."""
    settings = OutcomeTrainingSettings(
        epochs=epochs, batch=batch, learning_rate=learning_rate, seed=seed
    )
    try:
        weights = train_outcome_network(settings, data, out, log_dir, resume, threads)
    except KeyboardInterrupt:
        typer.echo("stopped; the same command with --resume goes on", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"wrote {weights} and {weights.with_suffix('.json')}")
