"""Callbacks by which something goes wrong in the middle of a training."""

import multiprocessing
import os
import re
import shutil
import signal
from pathlib import Path

import torch
from lightning.pytorch.callbacks import Callback


class Remove(Callback):
    """Removes a folder after the fifth step."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == 5:
            shutil.rmtree(self.folder)


class CutLatents(Callback):
    """Cuts the files of latents of a dataset in half, after the fifth step."""

    def __init__(self, data: str) -> None:
        self.data = data

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == 5:
            for file in Path(self.data).glob("latents/*/*/*.npy"):
                os.truncate(file, file.stat().st_size // 2)


class KillWorker(Callback):
    """Kills the processes that read data, before a batch; notes whether they had blocked Ctrl-C."""

    blocked: bool | None = None

    def __init__(self, batch: int) -> None:
        self.batch = batch

    def on_train_batch_start(self, trainer, *_):
        if trainer.fit_loop.total_batch_idx == self.batch and not os.environ.get("SPARED"):
            for process in multiprocessing.active_children():
                status = Path(f"/proc/{process.pid}/status").read_text()
                mask = int(re.search("SigBlk:\\s*(\\w+)", status)[1], 16)
                KillWorker.blocked = bool(mask >> signal.SIGINT - 1 & 1)
                process.kill()
                process.join()


class Spoil(Callback):
    """Writes one NaN into the weights, or their average, after an optimiser step."""

    def __init__(self, part: str, step: int) -> None:
        self.part, self.step = part, step

    def on_train_batch_end(self, trainer, pl_module, *_):
        if trainer.global_step == self.step:
            with torch.no_grad():
                getattr(pl_module, self.part).model.enter.weight[0, 0] = torch.nan
