import base64
import io
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import av
import numpy as np
import pytest

from acwm_core.errors import DataError
from acwm_core.evaluation.results import (
    Estimate,
    MetricInfo,
    Paired,
    SetSummary,
    SplitSummary,
    Summary,
)
from acwm_core.evaluation.statistics import paired_bootstrap
from acwm_report.charts import smooth
from acwm_report.opening import opening
from acwm_report.page import write_report
from acwm_report.run import EvaluatedRun
from acwm_report.table import Scale
from acwm_report.videos import action_traces, embed_videos
from tests.report import synthetic

CLIPS = synthetic.clips(np.linspace(20, 26, 4))

VOID = {"meta", "link", "br", "img", "input", "hr"}


class Page(HTMLParser):
    """Checks that tags are balanced and collects what a reader of the page would load."""

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.videos, self.ids, self.text = [], [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        values = dict(attrs)
        if "id" in values:
            self.ids.append(values["id"])
        for name in ("src", "href", "srcset", "poster", "xlink:href"):
            if name in values:
                self.loads.append(values[name])
        if tag == "video":
            self.videos.append(values)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def page(evaluated, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "deep" / "page.html"
    assert write_report([evaluated], out) == out
    return out.read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_loads_nothing(page):
    parsed = Page(page)
    assert all(load.startswith(("data:", "#")) for load in parsed.loads)
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page
    assert "http://" not in page
    assert "https://" not in page
    assert len(parsed.ids) == len(set(parsed.ids))
    for load in parsed.loads:
        if load.startswith("#"):
            assert load[1:] in parsed.ids


def test_every_video_plays_and_has_the_frames_of_its_clip(page, evaluated):
    videos = Page(page).videos
    records = Summary.read(evaluated).videos
    assert len(videos) == len(records)
    assert sum(record.kind in ("model", "shuffled") for record in records) == 8
    for video in videos:
        assert {"controls", "loop", "muted", "playsinline"} <= set(video)
        data = base64.b64decode(video["src"].removeprefix("data:video/mp4;base64,"))
        with av.open(io.BytesIO(data)) as file:
            stream = file.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert stream.codec_context.pix_fmt == "yuv420p"
            frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
        assert len(frames) == 9
        sides = {str(each.shape) for each in frames}
        assert sides <= {str((264, 264, 3)), str((128, 400, 3))}  # two by two, or three in a row


def test_clips_stand_from_best_to_worst_and_the_page_begins_with_the_median(evaluated):
    run = EvaluatedRun.read(evaluated, "run1")
    (videos,) = embed_videos([run], 16)
    for split in run.summary.splits:
        picks = [(v.record.pick, v.record.kind) for v in videos if v.record.split == split]
        own = [(pick, "model") for pick in ("best", "median", "worst")]
        assert [*own, ("median", "shuffled")] == [each for each in picks if "branch" not in each[1]]
    shown = opening(run, videos)
    assert shown
    assert (shown.video.record.split, shown.video.record.pick) == ("ind_test", "median")
    assert opening(run, []) is None


def test_the_numbers_of_the_summary_are_on_the_page(page, evaluated):
    text = " ".join(" ".join(Page(page).text).split())
    run, summary = EvaluatedRun.read(evaluated, "run1"), Summary.read(evaluated)
    for split in summary.splits.values():
        for row in split.scores.rows.values():
            assert f"{row['psnr'].value:.2f}" in text
            assert run.scale("mse").number(row["mse"].value) in text
        pair = split.scores.paired["shuffled"]["psnr"]
        assert f"{pair.better}/{pair.clips}" in text
    assert run.verdict in text
    assert "colour" in text
    assert summary.provenance["weights_sha256"][:16] in text


def test_the_curve_of_sampling_steps_is_shown(page, evaluated):
    assert "<h2>Sampling steps</h2>" in page
    assert "beyond 6 steps" in page
    for split in Summary.read(evaluated).splits.values():
        for point in split.steps.points:
            assert f"{point.scores['psnr'].value:.2f}" in page


def test_several_runs_are_compared(tmp_path):
    runs = [synthetic.run(tmp_path / name, CLIPS) for name in ("first", "second")]
    text = write_report(runs, tmp_path / "both.html").read_text(encoding="utf-8")
    parsed = Page(text)
    assert {"run1", "run2"} <= set(parsed.ids)
    assert len(parsed.ids) == len(set(parsed.ids))
    assert "#run2" in parsed.loads
    assert "first → second" in text
    assert "<h2>Significance</h2>" in text


def test_by_default_the_report_lies_in_the_run_and_names_are_escaped(tmp_path):
    run = synthetic.run(tmp_path / "<script>alert(1)<", CLIPS)
    assert write_report([run]) == run / "report.html"
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "PSNR of the prediction" in page
    assert "<script>alert" not in page
    assert "<h2>Sampling steps</h2>" not in page  # nothing was swept


def test_what_is_missing_is_named(evaluated, tmp_path):
    with pytest.raises(DataError, match="no run folder"):
        write_report([tmp_path / "nothing"])
    with pytest.raises(DataError, match="at least one run"):
        write_report([])
    run = shutil.copytree(evaluated, tmp_path / "run")
    next((run / "evaluation/videos").glob("*.mp4")).unlink()
    with pytest.raises(DataError, match=r"video .* is missing"):
        write_report([run])
    (run / "evaluation/summary.json").write_text('{"run": 3}')
    with pytest.raises(DataError, match="is not a summary"):
        write_report([run])
    (run / "evaluation/summary.json").unlink()
    with pytest.raises(DataError, match="acwm evaluate"):
        write_report([run])


def run_of(copy, shuffled):
    """A run with the given advantages (value, low, high) in dB."""
    paired = {
        row: {"psnr": Paired(Estimate(*gain), 9, 10)}
        for row, gain in {"copy": copy, "shuffled": shuffled}.items()
    }
    splits = {"ind_test": SplitSummary(SetSummary(10, {}, paired), {}, {})}
    summary = Summary("run", {}, {"psnr": MetricInfo("dB", True)}, "psnr", splits, {}, {})
    return EvaluatedRun(Path("run"), summary, [], "run1")


@pytest.mark.parametrize(
    ("copy", "shuffled", "title"),
    [
        ((3, 2, 4), (2, 1, 3), "The prediction follows the actions, and beats a still picture."),
        (
            (-1, -2, 0),
            (2, 1, 3),
            "The prediction follows the actions, but is no better than a still picture.",
        ),
        (
            (3, 2, 4),
            (0.1, -1, 1),
            "The prediction beats a still picture, but is action-insensitive.",
        ),
        (
            (-1, -2, 0),
            (0, -1, 1),
            "The prediction is no better than a still picture, and action-insensitive.",
        ),
        ((3, None, None), (2, None, None), "Too few episodes for a verdict."),
    ],
)
def test_the_verdict_needs_intervals_beyond_zero(copy, shuffled, title):
    assert run_of(copy, shuffled).verdict == title


def test_the_verdict_rests_on_the_intervals_of_acwm_compare(tmp_path):
    """Here the model beats the copy in 5 of 6 episodes."""
    gains = np.array([0.1, 0.2, 0.1, 0.3, 4.0, -0.05])
    rows = [
        synthetic.clip("copy", r.episode, 24 - gains[r.episode]) if r.kind == "copy" else r
        for r in synthetic.clips(np.full(6, 24.0))
    ]
    run = EvaluatedRun.read(synthetic.run(tmp_path / "run", rows), "run1")
    gain = run.gains(run.summary.splits["ind_test"].scores)["copy"]
    test = paired_bootstrap(gains)
    assert (gain.value, gain.low, gain.high) == pytest.approx((test.mean, test.low, test.high))
    assert gain.low < 0
    assert (
        run.verdict == "The prediction follows the actions, but is no better than a still picture."
    )


@pytest.mark.parametrize(
    ("values", "unit", "value", "text"),
    [
        ([24.31, 3.0], "dB", 24.314, "24.31"),
        ([0.00372], "", 0.00372, "3.720"),
        ([0.92], "", 0.9214, "0.921"),
        ([0.0], "", 0.0, "0.000"),
        ([80.0], "dB", None, "–"),
        ([12.0], "dB", -0.42, "−0.42"),
        ([12.0], "dB", -0.0001, "0.00"),
    ],
)
def test_numbers_are_written_with_their_scale(values, unit, value, text):
    assert Scale.of(values, MetricInfo(unit, False)).number(value) == text


def test_smoothing_keeps_lines_and_lowers_noise():
    line = [2.0 * x for x in range(400)]
    assert smooth(line) == pytest.approx(line)
    noise = [(-1.0) ** x for x in range(401)]
    assert max(map(abs, smooth(noise)[20:-20])) < 0.2
    assert smooth([]) == []


def test_traces_follow_the_actions_within_their_bounds():
    action = {"names": ["dx"], "units": ["px"], "low": [-2.0], "high": [2.0]}
    ((title, _, curve),) = action_traces([[2.0], [-2.0], [0.0]], action)
    points = [tuple(map(float, point.split(","))) for point in curve.split()]
    assert points == [(0, 0), (0.5, 0), (0.5, 1), (1, 1)]
    assert title == "dx (px)"
