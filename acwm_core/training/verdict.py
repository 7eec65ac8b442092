"""The first process decides whether a training can start, and informs the others."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
from collections.abc import Generator
from datetime import timedelta

from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from torch.distributed import DistError, TCPStore  # pyright: ignore[reportPrivateImportUsage]

from acwm_core.errors import TrainingError

PATIENCE = timedelta(minutes=30)
"""How long processes wait for the first one's verdict, as long as Lightning waits for them."""

HEARD = timedelta(minutes=5)
"""How long the first one stays to tell others that start later that it refused."""

_numbers = itertools.count()
"""Of the decisions; all processes make equally many."""


@functools.cache
def _meeting() -> tuple[TCPStore, int, int] | None:
    """What all processes see, the rank of this one, and their number; None if it is alone.

    Processes that Lightning starts come after the decision, so here the first one is alone. The
    first one keeps it open, at the address where PyTorch lets them meet again later.
    """
    for kind in (TorchElasticEnvironment, SLURMEnvironment):
        if kind.detect() and (number := kind().world_size()) > 1:
            cluster, rank = kind(), kind().global_rank()
            has_store = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"  # torchrun's
            store = TCPStore(
                cluster.main_address,
                cluster.main_port,
                is_master=rank == 0 and not has_store,
                timeout=PATIENCE,
                wait_for_workers=False,
                multi_tenant=True,
            )
            return store, rank, number
    return None


@contextlib.contextmanager
def first_decides() -> Generator[None]:
    """Let the other processes go on when the first one has left this context.

    Raises:
        TrainingError: the first one failed in it. Without this, the others would wait for it.
    """
    if (meeting := _meeting()) is None:
        yield
        return
    store, rank, number = meeting
    verdict = f"acwm/verdict/{next(_numbers)}"
    if rank > 0:
        refusal = store.get(verdict).decode()
        store.set(f"{verdict}/{rank}", "heard")
        if refusal:
            raise TrainingError(refusal)
        yield
        return
    try:
        yield
    except Exception as error:
        store.set(verdict, str(error) or type(error).__name__)
        with contextlib.suppress(DistError):
            store.wait([f"{verdict}/{other}" for other in range(1, number)], HEARD)
        raise
    store.set(verdict, "")
