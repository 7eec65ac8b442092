"""`acwm compare`: what is paired, what is found, and what is refused."""

import io
import json

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_report.comparison import Comparison, Difference, compare_runs
from acwm_report.terminal import print_tables
from tests.report import synthetic

RNG = np.random.default_rng(11)
BASE = RNG.normal(24, 2, 20)
BETTER = BASE + RNG.normal(0.8, 0.5, 20)
LIKE = BASE + RNG.normal(0.0, 0.5, 20) - 0.02


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    scores = {"base": BASE, "better": BETTER, "like": LIKE}
    for name, each in scores.items():
        outside = each - 3 + RNG.normal(0, 0.3, 20)
        rows = [*synthetic.clips(each), *synthetic.clips(outside, "ood_test")]
        synthetic.run(folder / name, rows)
    return folder


def by_pair(comparison, split, metric):
    chosen = [d for d in comparison.differences if (d.split, d.metric) == (split, metric)]
    return {(d.first, d.second): d for d in chosen}


def test_differences_are_those_that_were_put_in(runs):
    found = compare_runs([runs / "base", runs / "better", runs / "like"])
    assert (found.environment, found.protocol, found.warnings) == ("drift", "full", [])
    assert found.tests == len(found.differences) == 3 * 2 * 2
    pairs = by_pair(found, "ind_test", "psnr")
    real, chance = pairs["base", "better"], pairs["base", "like"]
    expected = stats.ttest_rel(BETTER, BASE)
    interval = expected.confidence_interval(0.95)
    assert real.difference == pytest.approx(np.mean(BETTER - BASE))
    assert (real.low, real.high) == pytest.approx((interval.low, interval.high), abs=0.05)
    assert real.second_better == (BETTER > BASE).sum()
    assert real.first_better == (BETTER < BASE).sum()
    assert (real.winner, chance.winner) == ("better", None)
    assert pairs["better", "like"].winner == "better"
    # A smaller error is better: the sign turns, the winner does not.
    error = by_pair(found, "ind_test", "mse")["base", "better"]
    assert error.difference < 0
    assert error.second_better == real.second_better
    assert error.winner == "better"
    assert all(d.p_corrected >= d.p for d in found.differences)


def test_clips_of_an_episode_are_one_observation(tmp_path):
    """Ten copies of each episode make no better evidence."""
    one = np.random.default_rng(13).normal(24, 2, (8, 1))
    two = one + np.random.default_rng(14).normal(0.3, 0.5, (8, 1))
    starts = tuple(range(0, 50, 5))
    single = compare_runs(
        [synthetic.run(tmp_path / f"s{i}", synthetic.clips(x)) for i, x in enumerate((one, two))]
    )
    repeated = compare_runs(
        [
            synthetic.run(tmp_path / f"r{i}", synthetic.clips(np.tile(x, 10), starts=starts))
            for i, x in enumerate((one, two))
        ]
    )
    for few, many in zip(single.differences, repeated.differences, strict=True):
        assert few.episodes == many.episodes == 8
        assert few.p == pytest.approx(many.p, abs=1e-3)
        assert (few.low, few.high) == pytest.approx((many.low, many.high))


def test_undefined_scores_leave_both_runs(tmp_path):
    hole = BASE.copy()
    hole[3] = np.nan
    runs = [synthetic.run(tmp_path / n, synthetic.clips(x)) for n, x in (("a", hole), ("b", LIKE))]
    (found,) = compare_runs(runs, metrics=["psnr"]).differences
    assert found.episodes == 19
    assert found.second_mean == pytest.approx(np.delete(LIKE, 3).mean())


def test_only_common_clips_are_compared_and_the_reader_is_told(tmp_path, runs):
    short = synthetic.run(tmp_path / "short", synthetic.clips(BASE[:7]))
    found = compare_runs([runs / "better", short])
    assert {d.split for d in found.differences} == {"ind_test"}
    assert {d.episodes for d in found.differences} == {7}
    assert found.warnings == [
        "ind_test: the runs predicted 20, 7 clips; only the 7 clips common to all are compared"
    ]


def test_other_settings_are_named(tmp_path, runs):
    words = {"steps": 50, "version": "0.2.0", "estimator": {"weights": "ab", "limits": "cd"}}
    other = synthetic.run(tmp_path / "other", synthetic.clips(LIKE), **words)
    found = compare_runs([runs / "base", other])
    assert found.warnings == [
        "numbers of sampling steps differ: base 5, other 50",
        "estimators of states differ: base none, other weights ab and limits cd",
        "versions of acwm differ: base 0.1.0, other 0.2.0",
    ]


def test_what_cannot_be_paired_is_refused(tmp_path, runs):
    base, rows = runs / "base", synthetic.clips(BASE)
    bad = {
        "on different environments (drift, reacher)": {"environment": "reacher"},
        "on different test data (ind_test aaaaaaaa, cccccccc)": {
            "checksums": {"ind_test": "c" * 64}
        },
        "by different protocols (full, acwm-phys)": {"protocol": "acwm-phys"},
        "from different numbers of given frames (1, 5)": {"given": 5},
    }
    for number, (reason, words) in enumerate(bad.items()):
        own = moved(rows, "copy", 0.1) if "checksums" in words else rows
        other = synthetic.run(tmp_path / str(number), own, **words)
        with pytest.raises(DataError) as refused:
            compare_runs([base, other])
        assert f"base and {number} were evaluated {reason}" in str(refused.value)
    shifted = synthetic.run(tmp_path / "shifted", synthetic.clips(BASE, starts=(4,)))
    with pytest.raises(DataError, match="no clip of ind_test in common"):
        compare_runs([base, shifted])
    for again in ([base], [base, base], [base, base / ".." / "base"]):
        with pytest.raises(DataError, match="at least two different runs"):
            compare_runs(again)
    with pytest.raises(DataError, match=r"no metric 'psn' .*did you mean 'psnr'"):
        compare_runs([base, runs / "like"], metrics=["psn"])
    with pytest.raises(DataError, match="no split 'train'"):
        compare_runs([base, runs / "like"], splits=["train"])


def moved(rows, kind, decibels):
    """The scores with those of one row changed."""
    return [
        synthetic.clip(each.kind, each.episode, each.values["psnr"] + decibels, split=each.split)
        if each.kind == kind
        else each
        for each in rows
    ]


def test_data_that_another_kind_of_processor_simulated_are_compared(runs, tmp_path):
    """Bytes and checksums differ, but still pictures are as far from the truth."""
    base, rows = runs / "base", synthetic.clips(BASE)
    words = {"checksums": {"ind_test": "c" * 64}, "weights": "2" * 64}
    like = synthetic.run(tmp_path / "like", moved(rows, "copy", 1e-5), **words)
    found = compare_runs([base, like])
    (warning,) = [each for each in found.warnings if "different kinds of machines" in each]
    assert "ind_test aaaaaaaa, cccccccc" in warning
    assert found.differences
    fewer = synthetic.run(tmp_path / "fewer", moved(rows, "copy", 1e-5)[:-8], **words)
    assert compare_runs([base, fewer]).differences[0].episodes == len(BASE) - 2
    for name, change in {
        "seed": 1,
        "factors": {"mass": 2.0},
        "source": {"kind": "lerobot"},
    }.items():
        other = synthetic.run(tmp_path / name, rows, dataset={name: change}, **words)
        with pytest.raises(DataError, match="on different test data"):
            compare_runs([base, other])


def test_an_unfinished_run_is_told(runs, tmp_path):
    early = synthetic.run(tmp_path / "early", synthetic.clips(BASE), planned=3000, weights="3" * 64)
    assert (
        "early is trained for 200 of 3,000 steps" in compare_runs([runs / "base", early]).warnings
    )


def test_runs_of_one_name_are_told_apart(tmp_path):
    folders = [
        synthetic.run(tmp_path / x / "run", synthetic.clips(s))
        for x, s in (("a", BASE), ("b", LIKE))
    ]
    assert list(compare_runs(folders).runs) == ["a/run", "b/run"]


def test_the_command_prints_a_table_and_writes_json(tmp_path, runs, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    out = tmp_path / "deep" / "compared.json"
    words = [str(runs / "base"), str(runs / "better"), "--metric", "psnr", "--out", str(out)]
    with pytest.raises(SystemExit) as ended:
        main(["compare", *words])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    lines = iter(shown.splitlines())
    assert any(each.strip() == "ind_test" for each in lines)
    line = next(each for each in lines if each.startswith("psnr"))
    assert shown.splitlines()[:2] == ["A: base", "B: better"]
    assert line.split()[-1] == "B"
    assert f"{np.mean(BETTER - BASE):+.3g} dB" in line
    assert "2 comparisons (Holm)" in shown
    written = json.loads(out.read_text())
    assert written["tests"] == 2
    first = written["differences"][0]
    assert first["difference"] == pytest.approx(np.mean(BETTER - BASE))
    assert first["winner"] == "better"
    assert set(written["hashes"]) == set(written["runs"]) == {"base", "better"}
    assert written["hashes"]["base"] == {
        "recipe": "r" * 64,
        "weights": "w" * 64,
        **synthetic.facts()["dataset"]["checksums"],
    }


@pytest.mark.parametrize(
    ("pair", "gate", "code", "said"),
    [
        (("better", "base"), ["--gate"], 1, "gate: base is worse in mse on ind_test"),
        (("better", "base"), ["--gate", "psnr"], 1, "gate: base is worse in psnr on ind_test"),
        (("base", "better"), ["--gate"], 0, "not significantly worse"),
        (("base", "like"), ["--gate", "psnr,mse"], 0, "not significantly worse"),
        (("better", "base"), [], 0, "B: base"),
    ],
)
def test_the_gate_fails_only_if_the_second_run_is_worse(runs, capsys, pair, gate, code, said):
    with pytest.raises(SystemExit) as ended:
        main(["compare", *(str(runs / name) for name in pair), "--split", "ind_test", *gate])
    shown = capsys.readouterr().out
    assert ended.value.code == code
    assert said in shown
    if gate[1:] == ["psnr"]:
        assert "mse" not in shown
        assert "1 comparison (Holm)" in shown  # others cost the gate no power


def test_a_gate_that_cannot_tell_does_not_open(tmp_path, runs, capsys):
    few = [
        str(synthetic.run(tmp_path / name, synthetic.clips(scores[:3])))
        for name, scores in (("a", BETTER), ("b", BASE))
    ]
    for words, said in (
        ([*few, "--gate"], "too few episodes to tell whether b is worse than a"),
        ([*few, str(runs / "like"), "--gate"], "--gate compares two runs"),
        ([*few, "--metric", "mse", "--gate", "psnr"], "--gate compares two runs"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(["compare", *words])
        assert ended.value.code == 2
        assert said in capsys.readouterr().err


METRICS = {"long_name_of_a_metric_of_some_plugin": "", "psnr": "dB", "contact_precision": ""}


def comparison_of(metrics):
    """Numbers as wide as they come; every other difference is none, or cannot be told."""

    def difference(split, metric, number):
        numbers = (-1.23e-05, -2.22e-05, -1.02e-06, 1.2e-10, 1.2e-10)
        told = numbers if number % 3 else (*numbers[:1], None, None, None, None)
        winner = "two" if number % 3 == 1 else None
        return Difference(split, metric, "one", "two", 0.1, 0.2, *told, 1000, 24, 1024, winner)

    found = [
        difference(split, metric, number)
        for split in ("ind_test", "ood_test")
        for number, metric in enumerate(metrics)
    ]
    runs = {"one": "runs/one", "two": "runs/two"}
    return Comparison(runs, {}, "drift", "full", dict(metrics), {}, found, len(found), [])


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_the_table_loses_nothing_on_a_narrow_terminal(width):
    lines = printed(comparison_of(METRICS), terminal=True, width=width)
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).split())
    assert "…" not in text
    assert text.count("metric difference") == 2
    whole = {
        "-1.23e-05": 2 * len(METRICS),
        "-2.22e-05 to -1.02e-06": 4,
        "1000/1024": 6,
        "too few": 2,
    }
    for cell, count in whole.items():
        assert sum(line.count(cell) for line in lines) == count, cell
    assert sum("-1.23e-05 dB" in line for line in lines) == 2
    for name in METRICS:
        assert sum(line.startswith(name[:8]) for line in lines) >= 2


def test_in_a_file_every_comparison_is_one_line():
    lines = [line.split() for line in printed(comparison_of(METRICS), terminal=False)]
    assert len(lines) == 2 * (2 + len(METRICS))
    words = ["contact_precision", "A", "→", "B", "-1.23e-05", "-2.22e-05", "to", "-1.02e-06"]
    assert [*words, "1000/1024", "1.2e-10", "neither"] in lines


def printed(comparison, *, terminal, width=80):
    out = io.StringIO()
    console = Console(
        width=width if terminal else 10_000, file=out, force_terminal=terminal, color_system=None
    )
    print_tables(console, comparison, {"one": "A", "two": "B"})
    return out.getvalue().splitlines()
