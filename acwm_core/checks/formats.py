"""`check_dataset_importer` and `check_dataset_exporter`: what `acwm data` relies on in a format."""

from __future__ import annotations

import inspect
import pickle
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from acwm_core.catalog import catalog
from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.data.card import DatasetCard
from acwm_core.data.check import check_dataset
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.formats import DatasetExporter, DatasetImporter, export_dataset, options_of
from acwm_core.data.recordings import RecordedDataset, Recording, import_dataset, recorded_card
from acwm_core.environment import ActionSpec
from acwm_core.registry import ComponentKind

MIN_PSNR = 25.0  # dB: lossy video of smooth frames has more
TAKEN = {"out", "workers", "data"}  # what the commands have themselves


class Trial:
    """A format, by its registered name or its class, and an empty folder to try it in."""

    def __init__(self, kind: ComponentKind, component: str | Any, folder: Path) -> None:
        self.make, self.folder = factory(kind, component), folder
        named = isinstance(component, str)
        self.target: Any = catalog().component(kind, component).load() if named else component
        importers = {each.name: each for each in catalog().registry("dataset_importer")}
        self.reader = importers.get(component) if named else None


def check_dataset_importer(importer: str | Callable[..., Any]) -> Iterator[CheckResult]:
    """Check an importer against the contract of `acwm_core.data.formats.DatasetImporter`.

    Args:
        importer: a registered name, or the class.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial("dataset_importer", importer, Path(folder))
        yield from run_checks((imports_its_example, documents_its_options), trial)


def check_dataset_exporter(exporter: str | Callable[..., Any]) -> Iterator[CheckResult]:
    """Check an exporter against the contract of `acwm_core.data.formats.DatasetExporter`.

    Arguments and errors are those of `check_dataset_importer`.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial("dataset_exporter", exporter, Path(folder))
        checks = writes_the_same_bytes_again, reads_back, documents_its_options
        yield from run_checks(checks, trial)


def documents_its_options(trial: Trial) -> None:
    """Give every parameter a type and, in the docstring, a text."""
    for parameter, text in options_of(trial.target):
        name = parameter.name
        expect(parameter.annotation is not inspect.Parameter.empty, f"{name} has no type")
        expect(text, f"Args of the docstring do not say what {name} is")
        expect(name not in TAKEN, f"{name} is an option of every format: call it otherwise")


def imports_its_example(trial: Trial) -> None:
    """Make sound datasets of the example, the same at a second import."""
    (place := trial.folder / "example").mkdir()
    parameters = trial.target.example(place)
    expect_is_a(trial.make(**parameters), DatasetImporter)
    for at, recorded in _datasets(trial.make(**parameters).read()).items():
        card = _imported(recorded, trial.folder / "one" / at)
        problems = [str(each) for each in check_dataset(trial.folder / "one" / at) if each.problem]
        expect(not problems, "; ".join(problems))
        expect("train" in card.splits, "nothing is there to train on")
        again = _datasets(trial.make(**parameters).read())[at]
        expect(_imported(again, trial.folder / "two" / at) == card, "a second import differs")
        _read_backwards(recorded)


def writes_the_same_bytes_again(trial: Trial) -> None:
    """Write files, the same at a second call."""
    action = ActionSpec(("x", "y"), ("", ""), (-1.0, -1.0), (1.0, 1.0), "delta")
    card = recorded_card("waves", action, summary="", frame_size=(32, 48), fps=10, horizon=8)
    splits = {"train": [_waves(0), _waves(1)], "ind_test": [_waves(2)]}
    facts = {"kind": "example", "name": "waves"}
    _imported(RecordedDataset(card, cast(Any, splits), facts), trial.folder / "data")
    expect_is_a(trial.make(), DatasetExporter)
    files: list[dict[str, bytes]] = []
    for name in ("one", "two"):
        out = trial.folder / name
        export_dataset(trial.folder / "data", out, trial.make(), progress=False)
        found = [path for path in sorted(out.rglob("*")) if path.is_file()]
        files.append({str(path.relative_to(out)): path.read_bytes() for path in found})
    expect(any(files[0].values()), "nothing is written")
    expect(files[0] == files[1], "a second export differs")


def reads_back(trial: Trial) -> None:
    """Write what the importer of the same name, if there is one, reads as the same episodes."""
    if trial.reader is None:
        return
    found = _datasets(trial.reader.load()(trial.folder / "one").read())
    expect(len(found) == 1, f"it reads {len(found)} datasets")
    back = _imported(next(iter(found.values())), trial.folder / "back")
    for split in back.splits:
        before, after = (EpisodeDataset(trial.folder / f, split) for f in ("data", "back"))
        expect(before.lengths == after.lengths, f"{split} comes back with {after.lengths} frames")
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


def _datasets(found: object) -> Mapping[str, RecordedDataset]:
    if isinstance(found, Mapping):
        return cast(Mapping[str, RecordedDataset], found)
    expect_is_a(found, RecordedDataset)
    return {".": cast(RecordedDataset, found)}
