"""Fixtures of the tests of formats."""

import shutil

import numpy as np
import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_formats.alignment import Alignment
from acwm_formats.published import Published
from acwm_formats.reading import ImportOptions
from acwm_formats.recordings import import_dataset
from tests.folders import checksums as checksums
from tests.formats import release


@pytest.fixture(scope="session")
def published(tmp_path_factory):
    """One environment in the published layout and what its videos and actions were made of."""
    folder = tmp_path_factory.mktemp("release") / "rigid_dynamics" / "push_block"
    return folder, release.environment(folder)


@pytest.fixture(scope="session")
def simulated(tmp_path_factory):
    """A small simulated dataset with all its ground truth."""
    folder = tmp_path_factory.mktemp("simulated") / "push_cube"
    counts = {"train": 3, "ind_test": 2, "ood_test": 2}
    generate("push_cube", folder, episodes=counts, size=64, workers=0, progress=False)
    return folder


def episodes_of(folder):
    """All episodes of a data folder, split after split."""
    return [e for split in DatasetCard.read(folder).splits for e in EpisodeDataset(folder, split)]


def psnr(a, b):
    """Of two uint8 videos, in dB."""
    return -10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2 + 1e-12)


@pytest.fixture
def folder(published, tmp_path):
    """A copy of the release to spoil."""
    return shutil.copytree(published[0], tmp_path / "push_block")


def load_published(folder, out, workers=0, shard_episodes=2, **options):
    return imported(Published().read(folder), out, workers, shard_episodes, **options)


def imported(recorded, out, workers=0, shard_episodes=2, **options):
    """Import with options, of which those of the alignment need no other name."""
    how = {name: options.pop(name) for name in ("on_defect", "fps", "max_gap") if name in options}
    asked = ImportOptions(alignment=Alignment(**how), **options)
    return import_dataset(
        recorded, out, asked, workers=workers, shard_episodes=shard_episodes, progress=False
    )
