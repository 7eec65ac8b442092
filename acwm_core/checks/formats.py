"""`check_dataset_importer` and `check_dataset_exporter`: what `acwm data` relies on in a format."""

from __future__ import annotations

import functools
import inspect
import pickle
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from acwm_core.catalog import catalog
from acwm_core.checks.result import CheckResult, checks_of, expect, expect_is_a, factory, run_checks
from acwm_core.data.card import DatasetCard
from acwm_core.data.check import check_dataset
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.formats import DatasetExporter, DatasetImporter, export_dataset, options_of
from acwm_core.data.recordings import RecordedDataset, Recording, import_dataset, recorded_card
from acwm_core.environment import ActionSpec
from acwm_core.registry import ComponentKind

MIN_PSNR = 25.0  # dB: lossy video of smooth frames has more
TAKEN = {"out", "workers", "data"}  # what the commands have themselves


def check_dataset_importer(importer: str | Callable[..., Any]) -> Iterator[CheckResult]:
    """Check an importer against the contract of `acwm_core.data.formats.DatasetImporter`.

    Args:
        importer: a registered name, or the class.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = ImporterChecks("dataset_importer", importer, Path(folder))
        yield from run_checks(checks_of(ImporterChecks, FormatChecks), trial)


def check_dataset_exporter(exporter: str | Callable[..., Any]) -> Iterator[CheckResult]:
    """Check an exporter against the contract of `acwm_core.data.formats.DatasetExporter`.

    Arguments and errors are those of `check_dataset_importer`.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = ExporterChecks("dataset_exporter", exporter, Path(folder))
        yield from run_checks(checks_of(ExporterChecks, FormatChecks), trial)


@dataclass
class FormatChecks:
    """Checks of a format, by its registered name or its class, in an empty folder."""

    kind: ComponentKind
    component: str | Any
    folder: Path

    @functools.cached_property
    def _target(self) -> Any:
        named = isinstance(self.component, str)
        return catalog().component(self.kind, self.component).load() if named else self.component

    def _made(self, **params: Any) -> Any:
        return factory(self.kind, self.component)(**params)

    def documents_its_options(self) -> None:
        """Give every parameter a type and, in the docstring, a text."""
        for parameter, text in options_of(self._target):
            name = parameter.name
            expect(parameter.annotation is not inspect.Parameter.empty, f"{name} has no type")
            expect(text, f"Args of the docstring do not say what {name} is")
            expect(name not in TAKEN, f"{name} is an option of every format: call it otherwise")


class ImporterChecks(FormatChecks):
    """Checks of an importer by its example."""

    def imports_its_example(self) -> None:
        """Make sound datasets of the example, the same at a second import."""
        (place := self.folder / "example").mkdir()
        parameters = self._target.example(place)
        expect_is_a(self._made(**parameters), DatasetImporter)
        for at, recorded in _datasets(self._made(**parameters)).items():
            card = _imported(recorded, self.folder / "one" / at)
            found = check_dataset(self.folder / "one" / at)
            problems = [str(each) for each in found if each.problem]
            expect(not problems, "; ".join(problems))
            expect("train" in card.splits, "nothing is there to train on")
            again = _datasets(self._made(**parameters))[at]
            same = _imported(again, self.folder / "two" / at) == card
            expect(same, "a second import differs")
            _read_backwards(recorded)


class ExporterChecks(FormatChecks):
    """Checks of an exporter on three episodes of moving waves."""

    def writes_the_same_bytes_again(self) -> None:
        """Write files, the same at a second call."""
        action = ActionSpec(("x", "y"), ("", ""), (-1.0, -1.0), (1.0, 1.0), "delta")
        card = recorded_card("waves", action, frame_size=(32, 48), fps=10, horizon=8)
        splits: Any = {"train": [_waves(0), _waves(1)], "ind_test": [_waves(2)]}
        facts = {"kind": "example", "name": "waves"}
        _imported(RecordedDataset(card, splits, facts), self.folder / "data")
        expect_is_a(self._made(), DatasetExporter)
        files: list[dict[Path, bytes]] = []
        for out in (self.folder / "one", self.folder / "two"):
            export_dataset(self.folder / "data", out, self._made(), progress=False)
            found = [path for path in sorted(out.rglob("*")) if path.is_file()]
            files.append({path.relative_to(out): path.read_bytes() for path in found})
        expect(any(files[0].values()), "nothing is written")
        expect(files[0] == files[1], "a second export differs")

    def reads_back(self) -> None:
        """Write what the importer of the same name, if there is one, reads as the same episodes."""
        if self.component not in catalog().registry("dataset_importer"):
            return
        reader = catalog().component("dataset_importer", self.component).load()
        found = _datasets(reader(self.folder / "one"))
        expect(len(found) == 1, f"it reads {len(found)} datasets")
        back = _imported(next(iter(found.values())), self.folder / "back")
        for split in back.splits:
            before, after = (EpisodeDataset(self.folder / f, split) for f in ("data", "back"))
            expect(before.lengths == after.lengths, f"{split} comes back with {after.lengths}")
            for one, other in zip(before, after, strict=True):
                expect(np.allclose(one.actions, other.actions, atol=1e-5), "actions change")
                error = np.mean((one.video.astype(float) - other.video) ** 2)
                expect(error < 255**2 / 10 ** (MIN_PSNR / 10), "the video comes back as another")


def _read_backwards(recorded: RecordedDataset) -> None:
    """Workers read any recording first, of a copy."""
    for split, recordings in recorded.splits.items():
        copy = pickle.loads(pickle.dumps(recordings))
        for index in reversed(range(len(recordings))):
            pairs = zip(_arrays(recordings[index]), _arrays(copy[index]), strict=True)
            same = all(np.array_equal(one, other) for one, other in pairs)
            expect(same, f"recording {index} of {split} is another when it is read first")


def _arrays(recording: Recording) -> list[Any]:
    return [recording.video, recording.actions, *recording.states.values()]


def _imported(recorded: RecordedDataset, out: Path) -> DatasetCard:
    return import_dataset(recorded, out, workers=0, progress=False)


def _waves(seed: int) -> Recording:
    y, x, t = np.ogrid[0:32, 0:48, 0 : 6 + seed]
    waves = 128 + 90 * np.sin(0.2 * y + 0.1 * x + 0.7 * t + seed)
    video = np.repeat(np.moveaxis(waves, 2, 0)[..., None], 3, 3).astype(np.uint8)
    return Recording(video, np.random.default_rng(seed).uniform(-1, 1, (5 + seed, 2)))


def _datasets(importer: DatasetImporter) -> Mapping[str, RecordedDataset]:
    """What an importer reads, by folder."""
    found: Any = importer.read()
    if isinstance(found, Mapping):
        return cast(Mapping[str, RecordedDataset], found)
    expect_is_a(found, RecordedDataset)
    return {".": found}
