"""Trains the small networks that help the grasp network: a checkpoint after each epoch."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.files import disk_error
from iwgnet_grasp.training.detector import has_bfloat16
from iwgnet_grasp.training.grasp_training import WholeCheckpoints, check_checkpoint


class SmallTraining(lightning.LightningModule):
    """What the trainings have in common. settings: dataclass with seed, batch, learning_rate,
    weight_decay and warm_up; samples: of the training set, what a checkpoint must agree in, too."""

    def __init__(self, settings: Any, network: torch.nn.Module, samples: int) -> None:
        super().__init__()
        self.settings = settings
        self.run: dict[str, Any] = asdict(settings) | {"samples": samples}
        self.network = network.to(memory_format=torch.channels_last)

    def logits(self, images: Tensor) -> Tensor:
        return self.network(images.to(memory_format=torch.channels_last)).float()

    def shuffled(self, make_dataset: Callable[[tuple[int, int]], Dataset]) -> DataLoader:
        """Batches of an epoch's dataset, a function of seed and epoch alone."""
        seed = (self.settings.seed, self.current_epoch)
        dataset = make_dataset(seed)
        order = torch.Generator().manual_seed(hash(seed))
        batch = min(self.settings.batch, len(dataset))
        return DataLoader(dataset, batch, shuffle=True, drop_last=True, generator=order)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["run"] = self.run

    def configure_optimizers(self) -> dict[str, Any]:
        """AdamW with a one-cycle schedule whose rate rises over the share warm_up of the steps."""
        s = self.settings
        optimizer = torch.optim.AdamW(
            self.parameters(), s.learning_rate, weight_decay=s.weight_decay
        )
        steps = max(int(self.trainer.estimated_stepping_batches), 2)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, s.learning_rate, total_steps=steps, pct_start=s.warm_up
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def prepare(seed: int, threads: int) -> None:
    """Quiet libraries, seeded; threads 0: all."""
    for chatty in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    if threads:
        torch.set_num_threads(threads)
    lightning.seed_everything(seed, workers=True, verbose=False)


def fit(module: SmallTraining, epochs: int, folder: Path, resume: bool) -> dict[str, float]:
    """Trains for `epochs`; returns the last validation's scores. FOLDER gets TensorBoard's log and
    last.ckpt, from which `resume` goes on: module.run is what both must agree in.

    DataError for a checkpoint that does not fit and a full disk; KeyboardInterrupt when the user
    stops it.
    """
    last = folder / "last.ckpt"
    if resume:
        check_checkpoint(last, module)
    trainer = lightning.Trainer(
        precision="bf16-mixed" if has_bfloat16() else "32-true",
        max_epochs=epochs,
        logger=lightning.pytorch.loggers.TensorBoardLogger(folder, name="", version=""),
        callbacks=[
            ModelCheckpoint(dirpath=folder, filename="last", enable_version_counter=False),
            RichProgressBar(leave=True),
        ],
        plugins=[WholeCheckpoints()],
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=5,
        reload_dataloaders_every_n_epochs=1,
    )
    try:
        trainer.fit(module, ckpt_path=last if resume else None, weights_only=True)
        (scores,) = trainer.validate(module, verbose=False)
    except SystemExit:  # Lightning's way to end when the user stops it
        raise KeyboardInterrupt from None
    except OSError as error:
        again = "run it again with --resume" if last.is_file() else "run it again"
        raise DataError(disk_error(error, folder, again)) from None
    return dict(scores)
