"""One damaged file among good ones: its defect is in the list, and the others can be imported."""

import pytest

from acwm_core.errors import DataError
from acwm_formats import recordings
from acwm_formats.alignment import Alignment
from acwm_formats.hdf5 import HDF5
from acwm_formats.mcap_logs import MCAP
from acwm_formats.reading import ImportOptions
from acwm_formats.videos import Videos
from tests.formats.conftest import imported
from tests.formats.corpus import arrays, files, logs
from tests.formats.corpus.cases import Case, three

GOOD = Case("good", three())


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(
    ("write", "read", "name"),
    [
        (files.videos, Videos, "*.csv"),
        (files.videos, Videos, "*.mp4"),
        (arrays.aloha, HDF5, "*.hdf5"),
        (logs.in_json, MCAP, "*.mcap"),
    ],
)
def test_the_others_are_imported(tmp_path, write, read, name, place):
    source = tmp_path / "source"
    source.mkdir()
    _, options = write(source, GOOD)
    spoilt = sorted(source.glob(name))[place]
    spoilt.write_bytes(spoilt.read_bytes()[:30])
    assert read.detect(source)
    recorded = read().read(source, **options)
    with pytest.raises(DataError, match=rf"1 of 3 recordings(.|\n)*{spoilt.stem}"):
        imported(recorded, tmp_path / "data", test_episodes=1)
    card = imported(recorded, tmp_path / "data", test_episodes=1, on_defect="skip")
    assert sum(card.splits.values()) == 2
    assert spoilt.stem in card.source["skipped"][0]


def test_what_needs_no_decoding_is_told_before_it(tmp_path, monkeypatch, capsys):
    _, options = files.videos(tmp_path, GOOD)
    tables = sorted(tmp_path.glob("*.csv"))
    tables[0].unlink()
    tables[1].write_text(tables[1].read_text().replace("0.1", "nan"))
    recorded, asked = Videos().read(tmp_path, **options), ImportOptions(test_episodes=1)
    with monkeypatch.context() as without:
        without.setattr(recordings, "stage", None)  # decodes
        with pytest.raises(TypeError):
            recordings.import_dataset(recorded, tmp_path / "data", asked, workers=0)
    said = capsys.readouterr().err
    assert "there is no table" in said
    assert "no finite number" in said
    with pytest.raises(DataError, match="2 of 3 recordings have defects"):
        recordings.import_dataset(recorded, tmp_path / "data", asked, workers=0)
    skipping = ImportOptions(test_episodes=1, alignment=Alignment(on_defect="skip"))
    made = recordings.import_dataset(recorded, tmp_path / "data", skipping, workers=0)
    assert made.splits == {"train": 1}
