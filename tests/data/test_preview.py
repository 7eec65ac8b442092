"""A look into a dataset: facts that agree with the files, pictures that can be opened."""

import json
import shutil

import av
import numpy as np
import pytest
from click.testing import CliRunner
from conftest import EPISODES
from PIL import Image

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.preview import describe, preview
from acwm_formats.sheets import CURVES


def test_the_facts_agree_with_the_files(square_data):
    facts = describe(square_data)
    assert json.loads(json.dumps(facts)) == facts
    assert (facts["environment"], facts["frame_size"], facts["fps"]) == ("square", [32, 32], 10)
    for split, count in EPISODES.items():
        about = facts["splits"][split]
        files = list((square_data / split).glob("*.tar"))
        assert about["episodes"] == about["made"] == count
        assert (about["frames"], about["lengths"]) == (21 * count, [21, 21])
        assert about["shards"] == len(files)
        assert about["bytes"] == sum(file.stat().st_size for file in files)
    assert facts["splits"]["ood_test"]["ood_labels"] == {"colour=90": 3, "speed": 2}


def test_an_unfinished_dataset_can_be_described(square_data, tmp_path):
    shutil.copytree(square_data, tmp_path / "data")
    (tmp_path / "data/ood_test/manifest.jsonl").unlink()
    facts = describe(tmp_path / "data")["splits"]["ood_test"]
    assert (facts["episodes"], facts["made"]) == (5, 0)
    with pytest.raises(DataError, match="holds 0 of its 5 episodes"):
        preview(tmp_path / "data", tmp_path / "out")


def test_the_preview_shows_every_split_with_masks_and_actions(square_data, tmp_path):
    sheet, film = preview(square_data, tmp_path / "a/b", episodes=3, columns=5)
    picture = Image.open(sheet)
    frame, gap, label = 160, 6, 20  # frames of 32 are drawn five times as large
    row, legends = label + 2 * frame + CURVES, 2 * (gap + label)
    assert picture.size == (5 * frame + 4 * gap, 8 * row + 7 * gap + legends)
    mask = EpisodeDataset(square_data, "train")[0].masks[0]
    below = np.asarray(picture)[label + frame : label + 2 * frame, :frame].astype(int)[2::5, 2::5]
    blue = below[..., 2] - below[..., 0]  # the first instance is blue, all else is not
    assert blue[mask == 1].min() > 80 > blue[mask == 0].max()
    with av.open(str(film)) as container:
        frames = list(container.decode(container.streams.video[0]))
    assert len(frames) == 21
    assert (frames[0].width, frames[0].height) == (
        3 * 2 * frame + 2 * gap,
        3 * (frame + label + CURVES) + 2 * gap + legends,
    )


def test_a_place_that_cannot_be_written_is_told(square_data, tmp_path):
    (tmp_path / "preview").touch()
    with pytest.raises(DataError, match="is not a folder; choose another place with --out"):
        preview(square_data, tmp_path / "preview")


@pytest.mark.parametrize("command", ["preview", "report"])
def test_data_that_can_only_be_read_name_the_option(square_data, monkeypatch, command):
    def read_only(**_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("acwm_core.files.tempfile.TemporaryFile", read_only)
    done = CliRunner().invoke(main, ["data", command, str(square_data)])
    assert done.exit_code == 2
    assert done.stderr.endswith(
        "cannot be written (Read-only file system): choose another place with --out\n"
    )
