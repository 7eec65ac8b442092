"""A format of a third party: registered, listed, checked and used from the command line."""

import importlib
import re
import types
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.errors import DataError
from acwm_core.plugins import catalog, hookimpl
from acwm_formats.checks import check_format
from acwm_formats.format import Format
from acwm_formats.timeline import ActionFacts, RecordedDataset, Recording
from tests.checks.results import failures, installed

ACTION = ActionFacts(("x",), kind="delta", bounds=((-1.0,), (1.0,)))


class Folder(Format):
    """.npz files, read or written as raw frames."""

    @classmethod
    def detect(cls, path):
        return any(path.glob("*.npz"))

    def read(
        self,
        root: Path,
        *,
        rate: float = 10.0,
        order: Literal["up", "down"] = "up",
        mirror: bool = False,
        skip: tuple[int, ...] = (),
    ) -> RecordedDataset:
        """Import the .npz files in the folder ROOT.

        Args:
            root: the folder.
            rate: Frames per second.
            order: Which file is the first.
            mirror: Whether to mirror frames.
            skip: Numbers of files to leave out.
        """
        files = sorted(Path(root).glob("*.npz"), reverse=order == "down")
        if not files:
            raise DataError(f"{root} has no .npz file")
        recordings = [_read(file, mirror) for i, file in enumerate(files) if i not in skip]
        facts = {"kind": "npz", "name": Path(root).name}
        return RecordedDataset(
            "mine",
            {"train": recordings},
            facts,
            fps=rate,
            options={"rate": rate},
            actions=ACTION,
            summary="Mine.",
        )

    @classmethod
    def example(cls, folder):
        rng = np.random.default_rng(0)
        for i in range(3):
            video = rng.integers(0, 256, (4 + i, 16, 16, 3), np.uint8)
            np.savez(folder / f"{i}.npz", video=video, actions=rng.uniform(-1, 1, (3 + i, 1)))
        return {"root": folder}


def _read(path, mirror):
    file = np.load(path)
    return Recording(file["video"][:, :, :: -1 if mirror else 1], file["actions"])


class ToFolder(Format):
    """A .npz file per episode."""

    def write(self, export, *, digits: int = 3):
        """Write a .npz file per episode.

        Args:
            digits: How many digits the names have.
        """
        for split in export.splits:
            for i, episode in enumerate(export.episodes(split)):
                path = export.folder / f"{split}_{i:0{digits}d}.npz"
                path.write_bytes(episode.video.tobytes())

    @classmethod
    def example(cls, folder):
        return {}


@hookimpl
def register_formats(registry):
    registry.add("npz", f"{__name__}:Folder", summary="a folder of .npz files")
    registry.add("raw", f"{__name__}:ToFolder", summary="raw frames")


@pytest.fixture
def third_party(fresh_catalog):
    plugin = types.SimpleNamespace(register_formats=register_formats)
    catalog().add_plugin(plugin, "third_party")


@pytest.fixture
def root(tmp_path):
    (place := tmp_path / "mine").mkdir()
    return Folder.example(place)["root"]


def said(*words):
    return CliRunner().invoke(main, [str(word) for word in words], prog_name="acwm")


def test_it_is_listed_with_its_options(third_party):
    assert "third_party" in said("list", "format").output
    assert "a folder of .npz files" in said("data", "import", "--help").output
    text = " ".join(said("data", "import", "npz", "--help").output.split())
    assert "npz [OPTIONS] ROOT Import the .npz files in the folder ROOT." in text
    assert "Args" not in text
    for option in (
        "--rate FLOAT Frames per second. [default: 10.0]",
        "--order [up|down] Which file is the first. [default: up]",
        "--mirror / --no-mirror Whether to mirror frames.",
        "--skip NUMBERS Numbers of files to leave out.",
        "--workers INTEGER",
        "--out DIRECTORY Data folder to create. [required]",
    ):
        assert option in text
    export = " ".join(said("data", "export", "raw", "--help").output.split())
    assert "--digits INTEGER How many digits the names have. [default: 3]" in export


def test_it_imports_and_exports(third_party, root, tmp_path):
    out = tmp_path / "out"
    words = ["--rate", 5, "--skip", "1,2", "--mirror", "--order", "down", "--workers", 0]
    done = said("data", "import", "npz", root, "--out", out, *words)
    assert done.exit_code == 0, done.output
    assert "holds 1 train episodes of mine" in done.output
    card = DatasetCard.read(out)
    assert (card.environment.fps, card.source["kind"]) == (5, "npz")
    assert card.command("x") == "acwm data import npz mine --rate 5.0 --size 16x16 --out x"
    assert said("data", "export", "raw", out, "--out", tmp_path / "raw").exit_code == 0
    (file,) = (tmp_path / "raw").iterdir()
    assert file.name == "train_000.npz"
    assert file.read_bytes() == np.load(root / "2.npz")["video"][:, :, ::-1].tobytes()


def test_an_archive_is_to_be_unpacked(tmp_path):
    (tmp_path / "takes.zip").write_bytes(b"PK")
    done = said("data", "import", tmp_path / "takes.zip", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "unpack" in done.stderr


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["import", "npx", "."], "unknown format 'npx'; did you mean 'npz'?"),
        (["export", "rav", "."], "unknown format 'rav'; did you mean 'raw'?"),
        (["import", "raw", "."], "raw can only be exported, not imported"),
        (["export", "npz", "."], "npz can only be imported, not exported"),
        (["import", "."], ". is in no known format: give --format, one of"),
        (["import", ".", "--format", "npx"], "unknown format 'npx'; did you mean 'npz'?"),
        (["import", "npz", ".", "--rates", "5"], "No such option '--rates'"),
        (["import", "npz", ".", "--rate", "x"], "Invalid value for '--rate'"),
        (["import", "npz", ".", "--order", "left"], "Invalid value for '--order'"),
        (["import", "npz", ".", "--skip", "a"], "give a number such as 100, or several such as"),
        (["import", "npz"], "Missing argument 'ROOT'"),
        (["import", "npz", "nowhere"], "nowhere has no .npz file"),
    ],
)
def test_mistakes_are_one_sentence(third_party, words, problem, tmp_path):
    done = said("data", *words, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert done.stderr.startswith("acwm: ")
    assert problem in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_command_line_checks_it(third_party):
    done = said("check", "npz")
    assert done.exit_code == 0, done.output
    assert "format npz" in done.output
    assert "ok    imports its example" in done.output


def test_a_path_tells_its_format(third_party, root, tmp_path):
    for number, words in enumerate([[root], [root, "--format", "npz"], ["--format=npz", root]]):
        out = tmp_path / str(number)
        done = said("data", "import", *words, "--out", out, "--workers", 0, "--rate", 5)
        assert done.exit_code == 0, done.output
        assert ("is in the format npz" in done.output) == (number == 0)
        assert DatasetCard.read(out) == DatasetCard.read(tmp_path / "0")
    done = said("data", "export", out, "--format", "raw", "--out", tmp_path / "raw")
    assert done.exit_code == 0, done.output


def test_a_path_in_two_formats_needs_a_name(third_party, root, tmp_path):
    catalog().registry("format").add("also", f"{__name__}:Folder")
    done = said("data", "import", root, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "is in several formats: give --format, one of also, npz" in done.stderr


@pytest.mark.parametrize("component", installed("format"), ids=lambda c: c.name)
def test_installed_formats_conform(component):
    assert failures(check_format(component.name)) == {}


class Changing(Folder):
    """Never the same twice."""

    def read(self, root: Path):
        """Read.

        Args:
            root: the folder.
        """
        recorded, count = super().read(root), len(list(root.iterdir()))
        (root / f"{count}.npz").write_bytes((root / "0.npz").read_bytes())
        return recorded


class Untyped(Folder):
    """Takes anything."""

    def read(self, root: Path, *, untyped=1):
        """Read.

        Args:
            root: the folder.
        """
        return super().read(root)


class NoTraining(Folder):
    """Nothing to train on."""

    def read(self, root: Path):
        """Read.

        Args:
            root: the folder.
        """
        found = super().read(root)
        return replace(found, splits={"ind_test": found.splits["train"]})


class Everything(Folder):
    """Takes every folder for its own."""

    @classmethod
    def detect(cls, path):
        return True


class Shy(Folder):
    """Does not know its own."""

    @classmethod
    def detect(cls, path):
        return False


class Nothing(ToFolder):
    def write(self, export):
        pass


class Numbered(ToFolder):
    count = 0

    def write(self, export):
        super().write(export)
        Numbered.count += 1
        (export.folder / "number").write_text(str(Numbered.count))


class Taken(ToFolder):
    def write(self, export, *, out: int = 3):
        """Write.

        Args:
            out: What every format has.
        """
        super().write(export, digits=out)


class Strange(Folder):
    """Reads other files than it writes."""

    write = ToFolder.write


@pytest.mark.parametrize(
    ("flawed", "reason"),
    [
        (Changing, "a second import differs"),
        (Untyped, "untyped has no type"),
        (NoTraining, "there is nothing to train on"),
        (Everything, "it recognises an empty folder"),
        (Shy, "it does not recognise its own example"),
        (Nothing, "nothing is written"),
        (Numbered, "a second export differs"),
        (Taken, "out is an option of every format: choose another name"),
    ],
)
def test_flaws_are_found(flawed, reason):
    assert reason in failures(check_format(flawed)).values()


def test_a_format_that_does_not_come_back_is_found():
    assert [*failures(check_format(Strange))] == ["reads back"]


def test_the_one_in_the_documents_conforms(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "own-format.md").read_text()
    (code,) = [b for b in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S) if "Npz" in b]
    (tmp_path / "documented_format.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    target = importlib.import_module("documented_format").Npz
    assert failures(check_format(target)) == {}
