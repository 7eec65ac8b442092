"""Sweeps of a factor: what is asked for, what is generated, what comes of it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.checks.disc import GAIN, SHADE
from acwm_core.cli.main import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.episode import Factor
from acwm_core.errors import DataError, RecipeError
from acwm_core.executors import LocalExecutor
from acwm_severity.curves import POINTS, parse_sweep, read_severity
from acwm_severity.sweep import sweep_severity
from tests import tiny

COUNT = Factor.discrete("count", "how many", train=(1, 2, 3), ood=(4, 5), nominal=2)
GRAINS = Factor.discrete("grains", "how many grains", train=(3000,), ood=(6000,), nominal=3000)
HALF = Factor.discrete("half", "a half, or three", train=(0.5,), ood=(1.5,), nominal=0.5)
FACTORS = (GAIN, SHADE, COUNT, GRAINS, HALF)


@pytest.mark.parametrize(
    ("text", "values", "left_out"),
    [
        ("factors.count=1..5", (1, 2, 3, 4, 5), ()),
        ("factors.count=1..6", (1, 2, 3, 4, 5), (6,)),
        ("factors.count=2..4", (2, 3, 4), ()),
        ("factors.count=5,1", (5, 1), ()),
        ("factors.gain=0.5..2:4", (0.5, 1.0, 1.5, 2.0), ()),
        ("factors.gain=0.25,1,1", (0.25, 1.0), ()),
        ("factors.gain=-1e-1..1:2", (-0.1, 1.0), ()),
        ("factors.shade=dark,light", ("dark", "light"), ()),
    ],
)
def test_values_are_read(text, values, left_out):
    sweep = parse_sweep(text, FACTORS)
    assert sweep.values == values
    assert sweep.left_out == left_out


def test_a_continuous_range_is_cut_evenly():
    values = parse_sweep("factors.gain=0.1..1.2", FACTORS).values
    assert len(values) == POINTS
    np.testing.assert_allclose(np.diff(values), 1.1 / (POINTS - 1), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "values", "left_out"),
    [
        ("factors.grains=3000..6000", (3000, 6000), ()),
        ("factors.grains=3000..6000:4", (3000, 4000, 5000, 6000), ()),
        ("factors.grains=2000..5000:4", (3000, 4000, 5000), (2000,)),
        ("factors.grains=3500,6000", (3500, 6000), ()),
        ("factors.count=1..5:3", (1, 3, 5), ()),
    ],
)
def test_whole_numbers_between_those_that_are_listed_can_be_asked_for(text, values, left_out):
    found = parse_sweep(text, FACTORS)
    assert (found.values, found.left_out) == (values, left_out)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("factors.gian=0..1", "did you mean 'gain'"),
        ("gain=0..1", "sweeps no factor"),
        ("factors.gain", "sweeps no factor"),
        ("factors.gain=2..1", "2 must lie below 1"),
        ("factors.gain=1..2:1", "give 2 to 100 points"),
        ("factors.gain=1..2:1000000", "give 2 to 100 points"),
        (f"factors.gain=1..2:{'9' * 5000}", "give train, ood, nominal or a number"),
        (f"factors.gain=1,{'9' * 5000}", "not valid YAML"),
        (f"factors.gain=1..{'9' * 5000}", "give ends between"),
        ("factors.gain=1", "fewer than two values"),
        ("factors.gain=1,1", "fewer than two values"),
        ("factors.gain=1,fast", "give train, ood, nominal or a number"),
        ("factors.gain=1,.nan", "not a value of a factor"),
        ("factors.gain=1,.inf", "not a value of a factor"),
        ("factors.gain=1,1" + "0" * 400, "not a value of a factor"),
        ("factors.gain=1,true", "not a value of a factor"),
        ("factors.gain=1,[2]", "not a value of a factor"),
        ("factors.gain=train,ood", "not a value of a factor"),
        ("factors.gain=1..2..3", "give train, ood, nominal or a number"),
        ("factors.gain=", "not a value of a factor"),
        ("factors.count=1,6", "factors.count=6 is not possible"),
        ("factors.count=7..9", "fewer than two values that count can take"),
        ("factors.count=7..9:3", "fewer than two values that count can take"),
        ("factors.half=0.5..1.5:3", "can only be 0.5, 1.5"),
        ("factors.shade=1..2", "can only be light, dark"),
        ("factors.shade=light,drak", "did you mean 'dark'"),
    ],
)
def test_impossible_sweeps_are_refused(text, sentence):
    with pytest.raises(RecipeError, match=sentence):
        parse_sweep(text, FACTORS)


@pytest.mark.parametrize("ends", ["0..1e400", "-1e400..0", "1e400..1e401", "-1.7e308..1.7e308"])
@pytest.mark.parametrize("factor", ["gain", "count"])
@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")  # of another test
def test_ends_that_cannot_be_computed_with_are_refused_without_a_warning(factor, ends):
    with pytest.raises(RecipeError, match=r"give ends between -1e\+300 and 1e\+300"):
        parse_sweep(f"factors.{factor}={ends}", FACTORS)


@pytest.fixture(scope="module")
def swept(data, tmp_path_factory):
    run = tiny.make_run(tmp_path_factory.mktemp("swept") / "run", data, severity_episodes=3)
    return run, sweep(run)


def sweep(run, text="factors.colour=200,220,90", **options):
    (curve,) = sweep_severity(run, [text], workers=0, progress=False, **options)
    return curve


def test_every_value_is_generated_and_scored(swept):
    run, curve = swept
    assert [(p.value, p.severity, p.in_train) for p in curve.points] == [
        (200, 0, True),
        (220, 0, True),
        (90, 1, False),
    ]
    for point in curve.points:
        folder = run / "evaluation" / "severity" / "3-episodes" / f"colour={point.value}"
        episodes = EpisodeDataset(folder, "ind_test")
        assert len(episodes) == point.scores.clips == curve.episodes == 3
        assert {episode.factors["colour"] for episode in episodes} == {point.value}
        assert episodes.checksum == point.checksum
        assert list(point.scores.rows) == ["model", "copy", "codec"]
        assert point.scores.rows["model"]["mse"].value > 0
    assert curve.train == [200, 220]
    assert curve.headline == "psnr"
    (read,) = read_severity(run)
    assert replace(read, provenance={}) == replace(curve, provenance={})
    assert read.provenance["weights_sha256"] == curve.provenance["weights_sha256"]


def test_episodes_of_two_values_start_alike_and_move_alike(swept):
    run, _ = swept
    one, other = (
        EpisodeDataset(
            run / "evaluation" / "severity" / "3-episodes" / f"colour={value}", "ind_test"
        )
        for value in (200, 90)
    )
    for ours, theirs in zip(one, other, strict=True):
        assert np.array_equal(ours.states["position"], theirs.states["position"])
        assert np.array_equal(ours.actions, theirs.actions)


def test_a_sweep_resumes_where_it_stopped(swept, monkeypatch):
    run, curve = swept
    made = []
    advance = tiny.Drift._advance

    def counted(self, action):
        made.append(self._factors["colour"])
        return advance(self, action)

    made_once = run / "evaluation" / "severity" / "3-episodes" / "colour=220" / "ind_test"
    (made_once / "shard-00000.tar").unlink()
    monkeypatch.setattr(tiny.Drift, "_advance", counted)
    again = sweep(run)
    frames = tiny.Drift.card.horizon - 1
    of_the_trial = tiny.Drift.card.horizon - 1 - 5  # TRIED_FRAMES of the dataset's own episode
    assert made.count(220) in (3 * frames, 3 * frames + of_the_trial)
    assert made.count(90) == 0
    assert again.points == curve.points


START = tiny.Drift._start


def picky(self, factors, rng):
    if factors["ground"] == 60:
        raise ValueError("too bright")
    START(self, factors, rng)


@pytest.mark.parametrize(
    ("second", "sentence"),
    [
        ("factors.color=90,200", "did you mean 'colour'"),
        ("factors.ground=30,20", "factors.ground=20 is not possible"),
        ("factors.ground=30,60", "ground=60 is not possible: .*too bright"),
        ("factors.colour=90,220", "colour is swept 2 times"),
    ],
)
def test_all_sweeps_are_checked_before_the_first_is_generated(
    data, tmp_path, monkeypatch, second, sentence
):
    run = tiny.make_run(tmp_path / "run", data, severity_episodes=2)
    monkeypatch.setattr(tiny.Drift, "_start", picky)
    texts = ["factors.colour=90,200", second]
    with pytest.raises(RecipeError, match=sentence):
        sweep_severity(run, texts, workers=0, progress=False)
    assert not (run / "evaluation").exists()


def test_another_number_of_episodes_is_generated_beside_what_is_there(swept, tmp_path):
    run = shutil.copytree(swept[0], tmp_path / "run")
    words = ["evaluation.severity_episodes=2"]
    few = sweep(run, "factors.colour=90,200", overrides=words, overwrite=True)
    assert [point.scores.clips for point in few.points] == [2, 2]
    assert sweep(run, overwrite=True).points == swept[1].points
    (read,) = read_severity(run)
    assert read.episodes == 3


def test_other_data_in_the_folder_is_not_taken_for_the_sweeps(swept, tmp_path):
    run = shutil.copytree(swept[0], tmp_path / "run")
    other = tmp_path / "other"
    generate("drift", other, episodes={"ind_test": 1}, seed=1, workers=0, progress=False)
    home = run / "evaluation" / "severity" / "3-episodes"
    with pytest.raises(DataError, match=f"{home / 'colour=200'} holds another.*: seed is 0 there"):
        sweep(run, data=other)
    shutil.rmtree(home)
    assert sweep(run, data=other).provenance["dataset"]["seed"] == 1


def test_the_command_sweeps(swept, monkeypatch):
    run, _ = swept
    monkeypatch.setattr("acwm_core.data.generate.LocalExecutor", lambda _: LocalExecutor(0))
    word = "evaluation.severity_episodes=3"
    words = ["--overwrite", "--sweep", "factors.colour=90..220", "--sweep", "factors.ground=30,60"]
    result = CliRunner().invoke(main, ["evaluate", str(run), word, *words])
    assert result.exit_code == 0, result.output
    assert result.output.count("psnr dB, 3 episodes each") == 2, result.output
    assert "train" in result.output
    assert "1.00" in result.output


def test_curves_of_another_version_say_what_to_do(swept, tmp_path):
    run, _ = swept
    stale = tmp_path / "run" / "evaluation" / "severity"
    stale.mkdir(parents=True)
    (stale / "gain.json").write_text("{}")
    with pytest.raises(DataError, match=r"--sweep factors\.gain=…` again"):
        read_severity(tmp_path / "run")
    assert read_severity(run / "nowhere") == []
