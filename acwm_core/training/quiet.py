"""Keeps Lightning's housekeeping messages out of the user's terminal."""

from __future__ import annotations

import logging
import warnings

import lightning.pytorch as lightning_pytorch

IRRELEVANT = (
    r".*does not have many workers.*",  # decoding is cheap or cached; data.workers is ours to set
    r".*module\(s\) in eval mode at the start of training.*",  # the codec and the average are
    r".*Checkpoint directory .* exists and is not empty.*",  # a resumed run
    r".*callbacks used to create the checkpoint need to be provided.*",  # trainer.max_time's
    r".*`srun` command is available.*",
    r".*Starting from v1\.9\.0, `tensorboardX`.*",
    r".*isinstance\(treespec, LeafSpec\).*",  # torch's pytree, from within lightning
    r".*`torch\.distributed\.reduce_op` is deprecated.*",
    r".*weights_only.*",
    r".*The `lightning` package.*",
    r".*Total length of `list` across ranks is zero.*",  # data.validation_episodes=0
    r".*defined a `validation_step` but have no `val_dataloader`.*",  # the same
    r".*find_unused_parameters=True was specified.*",
    r".*assuming the intent is to load in a single process.*",  # it is
    r".*Dynamo detected a call to a `functools.lru_cache`.*",  # of what depends on arguments alone
)
"""Warnings about what is as it should be."""


def quiet_lightning() -> None:
    """Silence tips and warnings that a user of acwm can do nothing about; errors stay."""
    for name in (lightning_pytorch.__name__, "lightning.fabric"):  # imported: it sets levels, too
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("torch.distributed").setLevel(logging.ERROR)
    for message in IRRELEVANT:
        warnings.filterwarnings("ignore", message=message)
