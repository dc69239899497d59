"""Training of YOLOv5s on a data set of the simulator: `iwgnet train detector`."""

from __future__ import annotations

import copy
import json
import logging
import math
import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import lightning
import numpy as np
import torch
import typer
from lightning.pytorch.callbacks import EMAWeightAveraging, ModelCheckpoint
from torch import Tensor
from torch.utils.data import DataLoader

from iwgnet_grasp.data.detection import (
    Augmentation,
    DetectionScene,
    DetectionSet,
    DetectionWindows,
    WholeScenes,
    collate,
    load_detection_set,
)
from iwgnet_grasp.data.letterbox import WHOLE, Region, checked_region
from iwgnet_grasp.files import read_config
from iwgnet_grasp.networks.weights import load_state, read_card, save_weights
from iwgnet_grasp.networks.yolov5s import ANCHORS, YOLOv5s, decode, non_maximum_suppression
from iwgnet_grasp.training.card import describe_set, earlier_stage
from iwgnet_grasp.training.detector_loss import LossWeights, detection_loss
from iwgnet_grasp.training.detector_metrics import ImageBoxes, average_precision

PACKAGE = Path(__file__).resolve().parents[3]
DEFAULT_CONFIG = PACKAGE / "config" / "detector_training.yaml"
IOU_THRESHOLD = 0.6  # of the suppression, as in config/perception.yaml

Anchors = tuple[tuple[tuple[float, float], ...], ...]  # (width, height) px, three a scale


class DetectorTrainingError(ValueError):
    """A training config or run that cannot be used: one line saying what and where."""


@dataclass(frozen=True)
class Phase:
    """A part of the training: `epochs` epochs of `images` windows of `size` (rows, columns)."""

    epochs: int
    images: int
    size: tuple[int, int]
    zoom: float
    batch: int

    @property
    def steps(self) -> int:
        """Optimiser steps of an epoch on one machine."""
        return math.ceil(self.images / self.batch)


@dataclass(frozen=True)
class DetectorTrainingConfig:
    """config/detector_training.yaml."""

    phases: tuple[Phase, ...]
    input: tuple[int, int] = (416, 640)
    region: Region = WHOLE
    anchors: Anchors = ANCHORS
    held_out: float = 0.1
    seed: int = 0
    learning_rate: float = 2e-3
    final_learning_rate: float = 2e-5
    warmup_steps: int = 100
    weight_decay: float = 5e-3
    ema_decay: float = 0.99
    batch_norm_images: int = 0
    loss: LossWeights = field(default_factory=LossWeights)

    @staticmethod
    def load(path: str | Path = DEFAULT_CONFIG) -> DetectorTrainingConfig:
        """Raises DetectorTrainingError for a file that is missing, malformed or lacks a key."""
        return read_config(
            path, "detector training config", DetectorTrainingConfig._of, DetectorTrainingError
        )

    @staticmethod
    def _of(text: Any) -> DetectorTrainingConfig:
        phases = tuple(
            Phase(
                epochs=int(p["epochs"]),
                images=int(p["images"]),
                size=_size(p["size"]),
                zoom=float(p["zoom"]),
                batch=int(p["batch"]),
            )
            for p in text["phases"]
        )
        loss = text["loss"]
        return DetectorTrainingConfig(
            phases=phases,
            input=_size(text["input"]),
            region=checked_region(text["region"]),
            anchors=_anchors(text["anchors"]),
            held_out=float(text["held_out"]),
            seed=int(text["seed"]),
            learning_rate=float(text["learning_rate"]),
            final_learning_rate=float(text["final_learning_rate"]),
            warmup_steps=int(text["warmup_steps"]),
            weight_decay=float(text["weight_decay"]),
            ema_decay=float(text["ema_decay"]),
            batch_norm_images=int(text["batch_norm_images"]),
            loss=LossWeights(
                box=float(loss["box"]),
                objectness=float(loss["objectness"]),
                classes=float(loss["class"]),
                anchor_ratio=float(loss["anchor_ratio"]),
                balance=tuple(float(b) for b in loss["balance"]),
            ),
        )

    @property
    def epochs(self) -> int:
        return sum(phase.epochs for phase in self.phases)

    @property
    def steps(self) -> int:
        return sum(phase.epochs * phase.steps for phase in self.phases)

    def phase(self, epoch: int) -> Phase:
        """The phase that an epoch (from 0) belongs to."""
        for phase in self.phases:
            if epoch < phase.epochs:
                return phase
            epoch -= phase.epochs
        return self.phases[-1]


class DetectionData(lightning.LightningDataModule):
    """Windows of the current phase to train on, whole scenes to validate on."""

    def __init__(
        self, config: DetectorTrainingConfig, train: DetectionSet, test: DetectionSet, workers: int
    ) -> None:
        super().__init__()
        self.config = config
        self.train = train
        self.test = test
        self.workers = workers

    def train_dataloader(self) -> DataLoader:
        epoch = self.trainer.current_epoch
        phase = self.config.phase(epoch)
        windows = DetectionWindows(
            self.train.scenes, phase.images, phase.size, phase.zoom, self.config.seed, epoch
        )
        return DataLoader(
            windows,
            batch_size=max(1, phase.batch // self.trainer.world_size),
            num_workers=self.workers,
            collate_fn=collate,
        )

    def val_dataloader(self) -> DataLoader:
        return DataLoader(WholeScenes(self.test.scenes), batch_size=4, collate_fn=collate)


class DetectorTraining(lightning.LightningModule):
    """One model, its loss, its optimiser and its metrics."""

    def __init__(self, config: DetectorTrainingConfig, classes: int) -> None:
        super().__init__()
        self.config = config
        self.model = YOLOv5s(classes).to(memory_format=torch.channels_last)
        self.model.anchors.copy_(torch.tensor(config.anchors))
        self.metrics: dict[str, float] = {}
        self._truth: list[ImageBoxes] = []
        self._found: list[ImageBoxes] = []
        self._losses: list[Tensor] = []
        self._images = 0
        self._epoch_start = 0.0

    def configure_optimizers(self) -> dict[str, Any]:
        kernels = [p for p in self.model.parameters() if p.ndim > 1]
        others = [p for p in self.model.parameters() if p.ndim <= 1]
        config = self.config
        optimizer = torch.optim.AdamW(
            [
                {"params": kernels, "weight_decay": config.weight_decay},
                {"params": others, "weight_decay": 0.0},
            ],
            lr=config.learning_rate,
            betas=(0.9, 0.99),
        )

        def factor(step: int) -> float:
            if step < config.warmup_steps:
                return (step + 1) / config.warmup_steps
            part = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
            low = config.final_learning_rate / config.learning_rate
            return low + (1 - low) * (1 + math.cos(math.pi * min(part, 1.0))) / 2

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def on_train_epoch_start(self) -> None:
        self._losses, self._images, self._epoch_start = [], 0, time.monotonic()

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        images, targets = batch
        loss, _terms = detection_loss(
            self.model(network_input(images)), targets, self.model.anchors, self.config.loss
        )
        self._losses.append(loss.detach())
        self._images += len(images)
        return loss

    def on_validation_epoch_start(self) -> None:
        self._truth, self._found = [], []

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        truth, found = compare(self.model, *batch)
        self._truth += truth
        self._found += found

    def on_validation_epoch_end(self) -> None:
        self.metrics = average_precision(self._truth, self._found, self.model.classes)
        for name, value in self.metrics.items():
            self.log(f"val/{name}", value, sync_dist=True)
        if self.trainer.sanity_checking or not self._losses:
            return
        loss = float(torch.stack(self._losses).mean())
        rate = self._images / max(time.monotonic() - self._epoch_start, 1e-6)
        self.log("train/loss", loss, sync_dist=True)
        if self.trainer.is_global_zero:
            print(
                f"epoch {self.current_epoch + 1}/{self.config.epochs}: loss {loss:.4f}, "
                f"mAP50 {self.metrics['map50']:.4f}, mAP50-95 {self.metrics['map50_95']:.4f}, "
                f"{rate:.1f} images/s",
                flush=True,
            )


def fit(
    config: DetectorTrainingConfig,
    train: DetectionSet,
    test: DetectionSet,
    run: Path,
    *,
    initial: Path | None = None,
    resume: bool = False,
    workers: int = 0,
    devices: int = 1,
    nodes: int = 1,
) -> DetectorTraining:
    """Trains to the end and returns the module with its averaged weights and last metrics.

    run: folder of this run; holds last.ckpt after each epoch, from which `resume` goes on.
    initial: weights to begin with instead of random ones. Raises DetectorTrainingError when there
    is nothing to resume, WeightsError for initial weights of another network or other classes.
    """
    checkpoint = run / "last.ckpt"
    if resume and not checkpoint.is_file():
        raise DetectorTrainingError(f"{checkpoint}: no run to resume; train without --resume")
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    lightning.seed_everything(config.seed, verbose=False)
    module = DetectorTraining(config, len(train.classes))
    if initial is not None:
        load_state(module.model, initial, "yolov5s")
        module.model.anchors.copy_(torch.tensor(config.anchors))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        trainer = lightning.Trainer(
            max_epochs=config.epochs,
            precision="bf16-mixed" if has_bfloat16() else "32-true",
            accelerator="auto",
            devices=devices,
            num_nodes=nodes,
            reload_dataloaders_every_n_epochs=1,
            gradient_clip_val=10.0,
            num_sanity_val_steps=0,
            callbacks=[
                # Not from the first step: the average would long remember the random start. The
                # batch norms' statistics are averages already, and must follow a change of phase.
                EMAWeightAveraging(
                    decay=config.ema_decay,
                    use_buffers=False,
                    update_starting_at_step=config.warmup_steps,
                ),
                ModelCheckpoint(dirpath=run, filename="last", enable_version_counter=False),
            ],
            logger=lightning.pytorch.loggers.CSVLogger(run, name=None, version=""),
            enable_progress_bar=False,
            enable_model_summary=False,
            log_every_n_steps=50,
        )
        trainer.fit(
            module,
            datamodule=DetectionData(config, train, test, workers),
            ckpt_path=str(checkpoint) if resume else None,
            weights_only=False,
        )
    return module


def compare(
    model: YOLOv5s, images: Tensor, targets: Tensor
) -> tuple[list[ImageBoxes], list[ImageBoxes]]:
    """The true boxes and the found ones of a batch from data.detection.collate, in input px."""
    truth, found = [], []
    decoded = decode(model(network_input(images)), model.anchors, 0.01)
    for i, (boxes, scores) in enumerate(decoded):
        best = non_maximum_suppression(boxes, scores, 0.01, IOU_THRESHOLD, 100)
        found.append(ImageBoxes(*(_array(best[k]) for k in (0, 2, 1))))
        mine = targets[targets[:, 0] == i]
        low, size = mine[:, 2:4] - mine[:, 4:] / 2, mine[:, 4:]
        truth.append(ImageBoxes(_array(torch.cat((low, low + size), 1)), _array(mine[:, 1].long())))
    return truth, found


@torch.no_grad()
def measure(model: YOLOv5s, scenes: Sequence[DetectionScene]) -> dict[str, Any]:
    """average_precision's metrics on all scenes, and on those of each arrangement by its name."""
    device = next(model.parameters()).device
    model.eval()
    truth, found = [], []
    for images, targets in DataLoader(WholeScenes(scenes), batch_size=4, collate_fn=collate):
        with _autocast(device):
            real, guess = compare(model, images.to(device), targets.to(device))
        truth += real
        found += guess
    metrics: dict[str, Any] = average_precision(truth, found, model.classes)
    for kind in sorted({scene.arrangement for scene in scenes} - {""}):
        chosen = [i for i, scene in enumerate(scenes) if scene.arrangement == kind]
        metrics[kind] = {"scenes": len(chosen)} | average_precision(
            [truth[i] for i in chosen], [found[i] for i in chosen], model.classes
        )
    return metrics


@torch.no_grad()
def measure_batch_norm(model: YOLOv5s, batches: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Takes the batch norms' statistics anew, as the mean over `batches`: averaged weights have
    none of their own, and those of the training lag behind it."""
    device = next(model.parameters()).device
    norms = [m for m in model.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    momentum = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # the plain mean
    model.train()
    for images, _ in batches:
        with _autocast(device):
            model(network_input(images.to(device)))
    for norm, before in zip(norms, momentum, strict=True):
        norm.momentum = before
    model.eval()


def save_detector(
    model: YOLOv5s, path: str | Path, input_size: Sequence[int], labels: Sequence[str], card: dict
) -> Path:
    """Writes PATH.safetensors (float16) and its card with what the detector needs to run."""
    half = copy.deepcopy(model).half()
    whole = {
        "network": "yolov5s",
        "parameters": sum(p.numel() for p in model.parameters()),
        "input": list(input_size),
        "labels": list(labels),
        "stored_as": "float16",
        **card,
    }
    return save_weights(half, path, whole)


def train_detector(
    data: Annotated[
        list[Path], typer.Option(help="Folder made by 'iwgnet dataset'; give it again for more.")
    ] = [Path("data/train")],  # noqa: B006
    validation_data: Annotated[
        Path | None, typer.Option(help="Folder to validate on; by default a share of --data.")
    ] = None,
    output: Annotated[Path, typer.Option(help="Weight file to write.")] = PACKAGE
    / "models"
    / "yolov5s.safetensors",
    config: Annotated[Path, typer.Option(help="Training config.")] = DEFAULT_CONFIG,
    run: Annotated[Path, typer.Option(help="Folder for checkpoints and logs.")] = PACKAGE
    / "results"
    / "training"
    / "yolov5s",
    initial: Annotated[
        Path | None, typer.Option(help="Weight file to begin with, instead of random weights.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Instead of the config's.")] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads of torch.")] = None,
    limit: Annotated[int | None, typer.Option(help="At most this many scenes a folder.")] = None,
    workers: Annotated[int, typer.Option(help="Processes that prepare images.")] = 0,
    devices: Annotated[int, typer.Option(help="Accelerators (or processes) a machine.")] = 1,
    nodes: Annotated[int, typer.Option(help="Machines of a distributed run.")] = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run folder.")] = False,
) -> None:
    """Train the object detector (YOLOv5s) and write its weights and card."""
    settings = DetectorTrainingConfig.load(config)
    if seed is not None:
        settings = replace(settings, seed=seed)
    if threads is not None:
        torch.set_num_threads(threads)
    start = time.monotonic()
    train = DetectionSet((), ())
    for folder in data:
        more = load_detection_set(folder, settings.input, limit, region=settings.region)
        if train.scenes and more.classes != train.classes:
            raise DetectorTrainingError(
                f"{folder}: classes {more.classes} differ from the first folder's {train.classes}"
            )
        train = DetectionSet((*train.scenes, *more.scenes), more.classes)
    if validation_data is None:
        train, test = train.split(settings.held_out)
    else:
        test = load_detection_set(validation_data, settings.input, region=settings.region)
        if test.classes != train.classes:
            raise DetectorTrainingError(
                f"{validation_data}: classes {test.classes} differ from the data's {train.classes}"
            )
    boxes = sum(len(scene.boxes) for scene in train.scenes)
    print(
        f"{len(train.scenes)} scenes with {boxes} boxes to train on, {len(test.scenes)} held out, "
        f"classes {', '.join(train.classes)}; seed {settings.seed}, {settings.steps} steps",
        flush=True,
    )
    module = fit(
        settings,
        train,
        test,
        run,
        initial=initial,
        resume=resume,
        workers=workers,
        devices=devices,
        nodes=nodes,
    )
    if not module.trainer.is_global_zero:
        return
    if settings.batch_norm_images:
        measure_batch_norm(module.model, last_windows(settings, train.scenes))
    metrics = measure(module.model, test.scenes)
    card = detector_card(settings, data, len(train.scenes), validation_data, len(test.scenes))
    card["validation"] = rounded(metrics)
    card["minutes"] = round((time.monotonic() - start) / 60, 1)
    if initial is not None:
        card["before"] = earlier_stage(read_card(initial), card)
    path = save_detector(module.model, output, settings.input, train.classes, card)
    print(
        f"wrote {path}: mAP50 {metrics['map50']:.4f}, mAP50-95 {metrics['map50_95']:.4f}",
        flush=True,
    )


def rounded(metrics: dict[str, Any]) -> dict[str, Any]:
    """For a card: four digits are more than the validation set's size allows."""
    return {k: rounded(v) if isinstance(v, dict) else round(v, 4) for k, v in metrics.items()}


def detector_card(
    settings: DetectorTrainingConfig,
    data: Sequence[Path],
    training_count: int,
    validation_data: Path | None,
    validation_count: int,
) -> dict[str, Any]:
    """What the training adds to the card of save_detector."""
    return {
        "region": list(settings.region),
        "data": {
            "training": [describe_set(folder) for folder in data],
            "scenes": training_count,
            "validation": describe_set(validation_data) if validation_data else "a share of them",
            "validation_scenes": validation_count,
        },
        # Lists for tuples, so that it equals what is read back.
        "training": json.loads(json.dumps(asdict(settings))),
        "augmentation": asdict(Augmentation()),
        "steps": settings.steps,
        "torch": torch.__version__,
    }


def last_windows(settings: DetectorTrainingConfig, scenes: Sequence[DetectionScene]) -> DataLoader:
    """`batch_norm_images` windows as those of the last phase, which the training has not seen."""
    phase = settings.phases[-1]
    windows = DetectionWindows(
        scenes,
        settings.batch_norm_images,
        phase.size,
        phase.zoom,
        settings.seed,
        epoch=settings.epochs,
    )
    return DataLoader(windows, batch_size=phase.batch, collate_fn=collate)


def network_input(images: Tensor) -> Tensor:
    """(B, 3, H, W) uint8 RGB -> float32 in [0, 1], channels last."""
    return images.to(torch.float32, memory_format=torch.channels_last) / 255


def has_bfloat16() -> bool:
    """True where bfloat16 beats float32: accelerators, and CPUs with instructions for it."""
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported()
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def _autocast(device: torch.device) -> torch.autocast:
    return torch.autocast(device.type, torch.bfloat16, enabled=has_bfloat16())


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy()


def _anchors(value: Sequence) -> Anchors:
    sizes = tuple(tuple((float(w), float(h)) for w, h in scale) for scale in value)
    if [len(scale) for scale in sizes] != [3, 3, 3] or min(min(a) for s in sizes for a in s) <= 0:
        raise ValueError("anchors are not three widths and heights a scale")
    return sizes


def _size(value: Sequence[int]) -> tuple[int, int]:
    rows, columns = (int(v) for v in value)
    if rows % 32 or columns % 32 or rows <= 0 or columns <= 0:
        raise ValueError(f"size {rows}x{columns} is not a multiple of 32")
    return rows, columns
