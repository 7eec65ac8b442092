"""What a model sees, drawn over the panels of a video."""

import re

from acwm_core.data.video import write_mp4
from acwm_core.evaluation.results import FOLDER, VIDEOS, Summary, Tracks, VideoRecord
from acwm_report.page import write_report
from acwm_report.tracks import tracks
from tests.report import synthetic

SEEN = [[[0.25, 0.5], [None, None]], [[0.5, 0.5], [0.0, 1.0]], [[0.75, 0.5], [0.5, 1.0]]]
FOUND = Tracks(["cup", "<lid>"], [1.0, 0.0], 2, SEEN, SEEN[::-1])


def test_a_track_is_in_pixels_and_broken_where_nothing_is_seen():
    cup, lid = tracks(FOUND, "truth", height=32, width=64)
    assert cup.lines == ["16.00,16.00 32.00,16.00 48.00,16.00"]
    assert lid.lines == ["0.00,32.00 32.00,32.00"]
    assert lid.places.startswith("NaN,NaN ")
    assert cup.opacity == 1 > lid.opacity > 0
    assert cup.colour != lid.colour
    assert tracks(FOUND, "prediction", 32, 64)[0].lines == ["48.00,16.00 32.00,16.00 16.00,16.00"]


def test_the_page_shows_them_over_truth_and_prediction(tmp_path):
    run = synthetic.run(tmp_path / "run", synthetic.clips([20.0, 22.0]))
    summary = Summary.read(run)
    write_report([run])
    assert "What the model sees" not in (run / "report.html").read_text()
    record = VideoRecord(
        *("a.mp4", "ind_test", 0, None, "median", "model"), {}, [[0.0]] * 5, tracks=FOUND
    )
    summary.videos.append(record)
    summary.write(run / FOLDER)
    (run / FOLDER / VIDEOS).mkdir()
    write_mp4(run / FOLDER / VIDEOS / "a.mp4", synthetic.np.zeros((5, 32, 100, 3), "uint8"))
    write_report([run])
    page = (run / "report.html").read_text()
    assert Summary.read(run).videos[0].tracks == FOUND
    section = page[page.index("What the model sees") :]
    assert len(re.findall(r"<circle ", section)) == 4
    assert "&lt;lid&gt;" in section
    assert "<lid>" not in page
