"""Training of a grasp network: data folder in, weights and card out."""

import io
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from rich.progress import Progress
from torch.utils.data import DataLoader

from iwgnet_grasp.data.augmentation import Augmentation
from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.grasp_dataset import GraspDataset, Views, find_samples, load_views
from iwgnet_grasp.data.grasp_rectangle import QUALITY
from iwgnet_grasp.data.sample import image_wise_split, object_wise_split
from iwgnet_grasp.files import disk_error, write_whole
from iwgnet_grasp.networks import count_parameters, create_network
from iwgnet_grasp.networks.decode import decode_grasps
from iwgnet_grasp.networks.weights import (
    load_state,
    load_weights,
    read_card,
    save_weights,
    weights_path,
)
from iwgnet_grasp.training.card import earlier_stage, make_card
from iwgnet_grasp.training.losses import grasp_loss
from iwgnet_grasp.training.rectangle_metric import any_match

log = logging.getLogger(__name__)

HARD_QUALITY = 0.5

SPLITS = {"object": object_wise_split, "image": image_wise_split}


@dataclass(frozen=True)
class GraspTrainingSettings:
    """Everything that decides the result, stored in the card."""

    network: str = "iwgnet"
    epochs: int = 30
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    warm_up: float = 0.05  # share of the steps
    input_px: int = 176  # the longest rod is 170 px at 0.6 m
    # Least share of an epoch whose best grasp has a quality below HARD_QUALITY: buried parts
    # are a quarter of the crops and nine tenths of the wrong predictions.
    hard_share: float = 0.5
    quality_power: float = 1.0  # of the labels' quality in the target (losses.grasp_loss)
    validation: float = 0.1  # share held out of the data when there is no validation folder
    split: str = "object"
    patience: int = 0  # epochs without a better top-1 until training stops; 0: never
    seed: int = 0


@dataclass(frozen=True)
class TrainingResources:
    """What decides the speed only."""

    accelerator: str = "auto"
    devices: int = 1
    nodes: int = 1
    workers: int = 1
    threads: int = 0  # of torch on the CPU; 0: torch's choice


class GraspTraining(lightning.LightningModule):
    """AdamW with a one-cycle schedule on `grasp_loss`, validated by the top-1 rectangle metric."""

    def __init__(
        self, settings: GraspTrainingSettings, training: Views, validation: Views, workers: int = 0
    ) -> None:
        super().__init__()
        self.settings = settings
        self.run: dict[str, Any] = asdict(settings)  # what a checkpoint must agree in
        self.views = training
        self.validation_set = GraspDataset(validation, settings.input_px)
        self.workers = workers
        network = create_network(settings.network)
        network.quality_power = settings.quality_power
        self.network = network.to(memory_format=torch.channels_last)

    def train_dataloader(self) -> DataLoader:
        """Made anew each epoch: order and augmentation depend on seed and epoch alone, so that a
        resumed run sees what the whole run would have seen."""
        settings, epoch = self.settings, self.current_epoch
        # Not by shuffle=True: a loader may be iterated more than once after a resume.
        best = np.array([rows[:, QUALITY].max() for rows in self.views.rectangles])
        rng = np.random.default_rng((settings.seed, epoch))
        order = draw(best < HARD_QUALITY, settings.hard_share, rng)
        dataset = GraspDataset(
            self.views, settings.input_px, Augmentation(), seed=(settings.seed, epoch), order=order
        )
        return DataLoader(
            dataset,
            min(settings.batch, len(dataset)),
            drop_last=True,
            num_workers=self.workers,
        )

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.validation_set, self.settings.batch)

    def training_step(self, batch: tuple[torch.Tensor, torch.Tensor], _: int) -> torch.Tensor:
        loss = self._loss(batch)
        self.log_dict(
            {f"train/{k}": v for k, v in loss._asdict().items()}, batch_size=len(batch[0])
        )
        return loss.total

    def validation_step(self, batch: tuple[torch.Tensor, torch.Tensor], index: int) -> None:
        loss = self._loss(batch)
        dataset = self.validation_set
        maps = self.network(batch[0].to(memory_format=torch.channels_last))
        predictions = torch.stack(list(maps), dim=1).float().cpu().numpy()
        # The loader neither shuffles nor drops: item i of the batch is item start + i of the set,
        # on several devices every world_size-th one.
        world, rank = self.trainer.world_size, self.trainer.global_rank
        start = index * self.settings.batch
        hits = []
        for i, prediction in enumerate(predictions):
            item = min((start + i) * world + rank, len(dataset) - 1)
            grasps = decode_grasps(*prediction, max_grasps=1)
            hits.append(any_match(grasps, dataset.crop(item)[1]))
        scores = {"val/loss": loss.total, "val/quality": loss.quality, "val/angle": loss.angle}
        scores |= {"val/width": loss.width, "val/top1": torch.tensor(float(np.mean(hits)))}
        self.log_dict(scores, batch_size=len(batch[0]), sync_dist=True, prog_bar=True)

    def _loss(self, batch: tuple[torch.Tensor, torch.Tensor]):
        heights, labels = batch
        return grasp_loss(
            self.network.logits(heights.to(memory_format=torch.channels_last)),
            labels,
            self.settings.quality_power,
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["run"] = self.run

    def configure_optimizers(self) -> dict[str, Any]:
        settings = self.settings
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        rest = [p for p in self.network.parameters() if p.ndim <= 1]
        optimizer = torch.optim.AdamW(
            [{"params": decayed}, {"params": rest, "weight_decay": 0.0}],
            lr=settings.learning_rate,
            weight_decay=settings.weight_decay,
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            settings.learning_rate,
            total_steps=max(int(self.trainer.estimated_stepping_batches), 2),
            pct_start=settings.warm_up,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def check_checkpoint(path: Path, module: lightning.LightningModule) -> None:
    """DataError unless `module` can go on from the checkpoint as if it had never stopped.

    module: with `run`, what both must agree in, and `settings.network`, its name.
    """
    if not path.is_file():
        raise DataError(f"{path}: no checkpoint to resume from; train without --resume")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        run, state = checkpoint.get("run", module.run), checkpoint["state_dict"]
    except Exception as error:  # torch raises whatever its reader trips over
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DataError(
            f"{path}: not a whole checkpoint ({reason}); train without --resume"
        ) from None
    differing = [
        f"{key} {run.get(key)}, not {value}"
        for key, value in module.run.items()
        if run.get(key) != value
    ]
    if differing:
        raise DataError(
            f"{path}: belongs to a training with {'; '.join(differing)}; give the same options "
            "and data, or train without --resume"
        )
    shapes = {name: tensor.shape for name, tensor in module.state_dict().items()}
    if {name: tensor.shape for name, tensor in state.items()} != shapes:
        raise DataError(
            f"{path}: holds another network than this '{module.settings.network}'; train without "
            "--resume"
        )


class WholeCheckpoints(TorchCheckpointIO):
    """Lightning's own way copies from a temporary folder: a full disk would leave half a file."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        write_whole(Path(path), content.getvalue())


def draw(hard: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Indices of an epoch, as many as there are samples: at least `share` of them hard ones.

    hard: (n,) bool. Each kind is gone through whole before one of its samples comes again.
    """
    kinds = np.flatnonzero(hard), np.flatnonzero(~hard)
    if min(len(kind) for kind in kinds) == 0:
        return rng.permutation(len(hard))
    hard_count = max(len(kinds[0]), round(share * len(hard)))
    counts = hard_count, len(hard) - hard_count
    drawn = []
    for kind, count in zip(kinds, counts, strict=True):
        rounds = [rng.permutation(kind) for _ in range(-(-count // len(kind)))]
        drawn.append(np.concatenate([*rounds, kind[:0]])[:count])
    return rng.permutation(np.concatenate(drawn))


class _Weights(Callback):
    """Writes weights and card whenever the validation has got better."""

    def __init__(self, path: Path, card: dict[str, Any]) -> None:
        self.path, self.card = path, card
        self.best = (-1.0, -np.inf)

    def on_validation_end(self, trainer: lightning.Trainer, module: GraspTraining) -> None:
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        metrics = {k: float(v) for k, v in trainer.callback_metrics.items()}
        score = (metrics["val/top1"], -metrics["val/loss"])
        if score <= self.best:
            return
        self.best = score
        validation = {k[4:]: round(v, 5) for k, v in metrics.items() if k.startswith("val/")}
        card = self.card | {
            "epoch": trainer.current_epoch + 1,
            "steps": trainer.global_step,
            "validation": validation,
        }
        save_weights(module.network, self.path, card)

    def state_dict(self) -> dict[str, Any]:
        return {"best": list(self.best), "before": self.card.get("before")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.best = tuple(state["best"])
        if state.get("before"):
            self.card["before"] = state["before"]


def train_grasp_network(
    settings: GraspTrainingSettings,
    data: Sequence[Path],
    out: Path,
    log_dir: Path,
    validation_data: Path | None = None,
    initial: str | Path | None = None,
    resume: bool = False,
    limit: int = 0,
    resources: TrainingResources | None = None,
    progress: bool = True,
) -> Path:
    """Trains on all folders of `data`, writes OUT/NETWORK.safetensors and its card.

    Returns the path. `initial`: weights of the same network to start from.

    DataError names data that cannot be used; ValueError an unknown network or setting. `resume`
    goes on from LOG_DIR/NETWORK/last.ckpt; a run that was killed ends as if it had not been.
    KeyboardInterrupt when the user stops it.
    """
    resources = resources or TrainingResources()
    if settings.split not in SPLITS:
        raise ValueError(f"no split '{settings.split}'; known: {', '.join(SPLITS)}")
    create_network(settings.network)
    for chatty in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    if resources.threads:
        torch.set_num_threads(resources.threads)
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    samples = [sample for folder in data for sample in find_samples(folder)]
    if limit:
        samples = samples[:limit]
    if validation_data:
        training, held_out = samples, find_samples(validation_data)
    else:
        split = SPLITS[settings.split]
        training, held_out = split(samples, settings.validation, settings.seed)
    if not training or not held_out:
        raise DataError(f"{len(samples)} samples are too few to train and to validate on")
    with Progress(transient=True, disable=not progress) as bar:
        task = bar.add_task("reading samples", total=len(training) + len(held_out))
        views = load_views(training, lambda _: bar.advance(task))
        held_out_views = load_views(held_out, lambda _: bar.advance(task))
    module = GraspTraining(settings, views, held_out_views, resources.workers)

    folder = log_dir / settings.network
    if initial and not resume:
        load_state(module.network, weights_path(initial), settings.network)
    weights = out / f"{settings.network}.safetensors"
    parameters = count_parameters(module.network)
    card = make_card(settings, parameters, data, len(views), validation_data, len(held_out_views))
    if initial and not resume:
        card["before"] = earlier_stage(read_card(initial), card)
    module.run |= {"data": [folder.name for folder in data], "samples": len(views)}
    # Rewritten each epoch; the best weights are kept by _Weights.
    checkpoint = ModelCheckpoint(dirpath=folder, filename="last", enable_version_counter=False)
    callbacks: list[Callback] = [_Weights(weights, card), checkpoint]
    if settings.patience:
        callbacks.append(EarlyStopping("val/top1", mode="max", patience=settings.patience))
    if progress:
        callbacks.append(RichProgressBar(leave=True))
    cuda = resources.accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    bfloat16 = cuda or torch.cpu._is_avx512_bf16_supported()
    trainer = lightning.Trainer(
        accelerator=resources.accelerator if cuda else "cpu",
        devices=resources.devices,
        num_nodes=resources.nodes,
        precision="bf16-mixed" if bfloat16 else "32-true",
        max_epochs=settings.epochs,
        logger=TensorBoardLogger(folder, name="", version=""),
        callbacks=callbacks,
        plugins=[WholeCheckpoints()],
        enable_progress_bar=progress,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=5,
        reload_dataloaders_every_n_epochs=1,
    )
    last = folder / "last.ckpt"
    if resume:
        check_checkpoint(last, module)
    try:
        trainer.fit(module, ckpt_path=last if resume else None, weights_only=True)
    except SystemExit:  # Lightning's way to end when the user stops it
        raise KeyboardInterrupt from None
    except OSError as error:
        again = "run it again with --resume" if last.is_file() else "run it again"
        raise DataError(disk_error(error, folder, again)) from None
    load_weights(weights)  # what was written can be read
    return weights
