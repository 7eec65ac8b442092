"""The table: intervals and tests against their definitions, and results that are kept."""

import itertools
import json
import math

import pytest
from scipy.stats import beta

from acwm_core.errors import AcwmWarning, DataError
from acwm_planning.results import PlanTable
from acwm_planning.resumable import EPISODES_FILE, ResumableResults
from acwm_planning.runner import missing_rows
from acwm_planning.table import EpisodeLine, mcnemar, summarise
from acwm_report.plans import plan_table
from acwm_report.terminal import print_page_table


def line(row, seed, success, **facts):
    usual = {"failed": False, "steps": 4, "start_distance": 1.0, "distance": 0.5 - 0.4 * success}
    return {"row": row, "seed": seed, "success": success, **usual, **facts}


def test_shares_have_the_interval_of_clopper_and_pearson():
    for successes, episodes in [(0, 10), (3, 10), (10, 10), (1, 50)]:
        lines = [line("model", seed, seed < successes) for seed in range(episodes)]
        (row,) = summarise(lines)
        assert (row.successes, row.episodes, row.success.value) == (
            successes,
            episodes,
            successes / episodes,
        )
        failures = episodes - successes
        low = beta.ppf(0.025, successes, failures + 1) if successes else 0.0
        high = beta.ppf(0.975, successes + 1, failures) if failures else 1.0
        assert (row.success.low, row.success.high) == pytest.approx((low, high))


def test_pairs_that_differ_are_tested_like_coins():
    """Against all outcomes of as many coins, counted."""
    first = {seed: line("model", seed, seed < 8) for seed in range(12)}
    other = {seed: line("still", seed, seed == 11) for seed in range(12)}
    coins = [sum(outcome) for outcome in itertools.product((0, 1), repeat=9)]  # 8 and 1 differ
    extreme = sum(min(heads, 9 - heads) <= 1 for heads in coins)
    assert mcnemar(first, other) == pytest.approx(extreme / 2**9)
    assert mcnemar(first, first) == 1.0
    assert mcnemar(first, {99: line("still", 99, True)}) == 1.0


def test_rows_stand_in_their_order_beside_the_first():
    lines = [line("still", n, False) for n in range(6)]
    lines += [
        line("model", n, True, seconds_per_decision=n, rollouts_per_decision=8) for n in range(6)
    ]
    model, still = summarise(lines)
    assert (model.row, still.row) == ("model", "still")
    assert (model.p, still.p) == (None, pytest.approx(2 / 2**6))
    assert (model.seconds_per_decision, model.rollouts_per_decision) == (2.5, 8)
    assert still.seconds_per_decision is None
    assert (model.distance.value, still.distance.value) == pytest.approx((0.1, 0.5))


def test_finished_episodes_are_kept_and_the_cut_off_one_is_played_again(tmp_path):
    results = ResumableResults(tmp_path / "out", {"task": "place", "steps": (1, 2)})
    results.add(line("model", 0, True))
    with (results.folder / EPISODES_FILE).open("a") as file:
        file.write('{"row": "model", "see')
    again = ResumableResults(tmp_path / "out", {"task": "place", "steps": (1, 2)})
    assert [each["seed"] for each in again.finished()] == [0]
    rows = ("model", "still")
    assert missing_rows(rows, (0, 1), again) == {0: ["still"], 1: ["model", "still"]}
    again.add(line("still", 0, False))
    again.add(line("model", 1, False))
    assert missing_rows(rows, (0, 1), again) == {1: ["still"]}


def test_results_of_other_settings_are_not_mixed(tmp_path):
    ResumableResults(tmp_path, {"task": "place", "past": 0})
    with pytest.raises(DataError, match="holds results of another past: choose another --out"):
        ResumableResults(tmp_path, {"task": "place", "past": 1})


def test_a_number_that_is_not_finite_is_no_result(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        ResumableResults(tmp_path, {}).add(line("model", 0, True, distance=math.nan))
    assert json.loads((tmp_path / "settings.json").read_text()) == {}


def test_damaged_results_are_told_and_their_episodes_played_again(tmp_path):
    def results():
        return ResumableResults(tmp_path, {"past": 0}, kind=EpisodeLine)

    results().add(*(line("model", seed, True) for seed in range(4)))
    path = tmp_path / EPISODES_FILE
    lines = path.read_bytes().splitlines()
    lines[0] = b"\xff\xfe" + lines[0]
    lines[1] = lines[1].replace(b'"success": true', b'"success": "yes"')
    lines[2] = b"[1, 2]"
    path.write_bytes(b"\n".join(lines) + b"\n")
    with pytest.warns(AcwmWarning, match=r"damaged lines \(3\)"):
        assert [each["seed"] for each in results().finished()] == [3]
    for content in (b"", b"[]", b"{", b"\xff"):
        (tmp_path / "settings.json").write_bytes(content)
        with pytest.raises(DataError, match=r"settings\.json is not settings"):
            results()


def test_no_distance_is_below_zero():
    distances = (0.0, 0.1, 0.2, 0.3, 0.1, 9.0, 0.2, 0.1)
    lines = [line("model", seed, True, distance=value) for seed, value in enumerate(distances)]
    (row,) = summarise(lines)
    assert row.distance.low == 0


@pytest.mark.parametrize("width", [80, 45])
def test_the_printed_table_fits_a_terminal(capsys, monkeypatch, width):
    """On a narrow one, columns follow below each other, and no number is broken."""
    monkeypatch.setenv("COLUMNS", str(width))
    more = {"seconds_per_decision": 12.345, "rollouts_per_decision": 4096.0}
    lines = [line("model", seed, True, **more) for seed in range(50)]
    for row in ("simulator", "codec"):
        lines += [line(row, seed, seed % 7 == 0, **more) for seed in range(50)]
    print_page_table(plan_table(PlanTable("slide", "place", summarise(lines), "px")))
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= width
    assert printed.count("Solved") == 1
    assert printed.count("Controller") == (1 if width == 80 else 3)
    for text in ("50/50", "8/50", "4096", "4.5e-13", "Clopper"):
        assert text in printed
