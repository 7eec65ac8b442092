"""Checks of formats: what `acwm data import` and `acwm data export` require of them."""

from __future__ import annotations

import functools
import inspect
import pickle
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from acwm_core.checks.result import NotTried, Suite, expect, expect_is_a
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_formats.check import check_dataset
from acwm_formats.format import Format, export_dataset, options_of
from acwm_formats.options import NAMES
from acwm_formats.reading import divided, episode_name, opened
from acwm_formats.recordings import import_dataset
from acwm_formats.timeline import ActionFacts, RecordedDataset, Recording, TimedRecording

MIN_PSNR = 25.0  # in dB; lossy video of smooth frames has more
TAKEN = {"out", "workers", "data", *NAMES}  # options that the commands define themselves


class FormatChecks(Suite):
    """Checks of an `acwm_formats.format.Format`: of what it reads, on its own example, and writes.

    What it writes are episodes of moving waves.
    """

    kind = "format"

    @functools.cached_property
    def _folder(self) -> Path:
        self._kept = tempfile.TemporaryDirectory()  # until the checks are done
        return Path(self._kept.name)

    @functools.cached_property
    def _example(self) -> dict[str, Any]:
        """The parameters to read the example, which is in an own folder."""
        (place := self._folder / "example").mkdir()
        return self.target.example(place)

    @functools.cached_property
    def _exported(self) -> Path:
        """The folder of waves as it writes them; those that it should be are beside it."""
        actions = ActionFacts(("x", "y"), kind="delta", bounds=((-1.0, -1.0), (1.0, 1.0)))
        splits: Any = {"train": [_waves(0), _waves(1)], "ind_test": [_waves(2)]}
        facts = {"kind": "example", "name": "waves"}
        waves = RecordedDataset("waves", splits, facts, fps=10, actions=actions)
        _imported(waves, self._folder / "waves")
        return self._export("one")

    def _export(self, name: str) -> Path:
        out = self._folder / name
        return export_dataset(self._folder / "waves", out, self.make(), progress=False)

    def documents_its_options(self) -> None:
        """Read or write, and give every parameter a type and a description in the docstring."""
        expect(issubclass(self.target, Format), "it is not a Format")
        expect(self.target.reads() or self.target.writes(), "it neither reads nor writes")
        for method in (self.target.read, self.target.write):
            if method in (Format.read, Format.write):
                continue
            for parameter, text in options_of(method):
                name = parameter.name
                expect(parameter.annotation is not inspect.Parameter.empty, f"{name} has no type")
                expect(text, f"Args of the docstring do not say what {name} is")
                expect(
                    name not in TAKEN, f"{name} is an option of every format: choose another name"
                )

    def detects_its_example(self) -> None:
        """Know its own example, if that is a path, and no folder that is empty."""
        (empty := self._folder / "empty").mkdir()
        expect(not self.target.detect(empty), "it recognises an empty folder")
        (path, *_) = [*self._example.values(), None]
        if self.target.reads() and isinstance(path, Path):
            expect(self.target.detect(path), "it does not recognise its own example")

    def imports_its_example(self) -> None:
        """Import the example as valid datasets, which are the same at a second import."""
        if not self.target.reads():
            raise NotTried("it is only written")
        for at, recorded in _datasets(self.make().read(**self._example)).items():
            card = _imported(recorded, self._folder / "first" / at)
            findings = check_dataset(self._folder / "first" / at)
            problems = [str(finding) for finding in findings if finding.problem]
            expect(not problems, "; ".join(problems))
            expect("train" in card.splits, "there is nothing to train on")
            again = _datasets(self.make().read(**self._example))[at]
            same = _imported(again, self._folder / "second" / at) == card
            expect(same, "a second import differs")
            _read_backwards(recorded)

    def writes_the_same_bytes_again(self) -> None:
        """Write files, which are the same at a second call."""
        if not self.target.writes():
            raise NotTried("it is only read")
        files: list[dict[Path, bytes]] = []
        for out in (self._exported, self._export("two")):
            paths = [path for path in sorted(out.rglob("*")) if path.is_file()]
            files.append({path.relative_to(out): path.read_bytes() for path in paths})
        expect(any(files[0].values()), "nothing is written")
        expect(files[0] == files[1], "a second export differs")

    def reads_back(self) -> None:
        """Read the same episodes from what it wrote, if it does both."""
        if not (self.target.reads() and self.target.writes()):
            raise NotTried("it is not both read and written")
        expect(self.target.detect(self._exported), "it does not recognise what it wrote")
        datasets = _datasets(self.make().read(self._exported))
        expect(len(datasets) == 1, f"it reads {len(datasets)} datasets")
        back = _imported(next(iter(datasets.values())), self._folder / "back")
        for split in back.splits:
            before, after = (EpisodeDataset(self._folder / f, split) for f in ("waves", "back"))
            expect(before.lengths == after.lengths, f"{split} comes back with {after.lengths}")
            for one, other in zip(before, after, strict=True):
                expect(np.allclose(one.actions, other.actions, atol=1e-5), "actions change")
                error = np.mean((one.video.astype(float) - other.video) ** 2)
                expect(error < 255**2 / 10 ** (MIN_PSNR / 10), "the video comes back changed")


def _read_backwards(recorded: RecordedDataset) -> None:
    """Check that recordings do not depend on reading order: workers read copies, in any order."""
    for split, (recordings, places) in divided(recorded, None).items():
        copy = pickle.loads(pickle.dumps(recordings))
        for index in reversed(places):
            name = episode_name(split, index)
            one, other = (_arrays(opened(r, index, name, 1.0)) for r in (recordings, copy))
            same = all(np.array_equal(*pair) for pair in zip(one, other, strict=True))
            expect(same, f"recording {index} of {split} differs when it is read first")


def _arrays(recording: TimedRecording) -> list[Any]:
    arrays = [recording.actions.values, *(rows.values for rows in recording.states.values())]
    for frames in recording.cameras.values():
        arrays += [frames.times, *([] if frames.depth else frames.read(range(len(frames.times))))]
    return arrays


def _imported(recorded: RecordedDataset, out: Path) -> DatasetCard:
    return import_dataset(recorded, out, workers=0, progress=False)


def _waves(seed: int) -> Recording:
    y, x, t = np.ogrid[0:32, 0:48, 0 : 6 + seed]
    waves = 128 + 90 * np.sin(0.2 * y + 0.1 * x + 0.7 * t + seed)
    video = np.repeat(np.moveaxis(waves, 2, 0)[..., None], 3, 3).astype(np.uint8)
    return Recording(video, np.random.default_rng(seed).uniform(-1, 1, (5 + seed, 2)))


def _datasets(result: Any) -> dict[str, RecordedDataset]:
    if isinstance(result, Mapping):
        return dict(cast(Mapping[str, RecordedDataset], result))
    expect_is_a(result, RecordedDataset)
    return {".": result}


check_format = FormatChecks.check
