"""`acwm rank`, from words to a table, and what it refuses."""

import json
import re
import shutil

import pytest

from acwm_core.cli import main


@pytest.fixture
def mine(exact, tmp_path):
    return shutil.copytree(exact, tmp_path / "run")


def acwm(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    captured = capsys.readouterr()
    return ended.value.code, captured.out, captured.err


def test_a_ranking_is_made_and_gone_on_with(mine, capsys, tmp_path, monkeypatch):
    (tmp_path / "walkers.py").write_text("def walker(frame):\n    return [1.0, 1.0]\n")
    monkeypatch.chdir(tmp_path)
    policies = ["solution", "behaviour", "walkers:walker"]
    words = ["rank", mine, "place", *(w for p in policies for w in ("--policies", p))]
    code, out, err = acwm(capsys, *words, "--seeds", "0,1")
    assert code == 0, err
    folder = mine / "ranking" / "place"
    made = [json.loads(text) for text in (folder / "episodes.jsonl").read_text().splitlines()]
    assert {(each["policy"], each["seed"]) for each in made} == {
        (policy, seed) for policy in (*policies, "decision") for seed in (0, 1)
    }
    assert {each["policy"]: each.get("loop") for each in made} == {
        **{"solution": "open", "behaviour": "open"},
        **{"walkers:walker": "closed", "decision": None},
    }
    kinds = [branch["kind"] for branch in made[-1]["branches"]]
    assert kinds == ["own", "another", "still", "reversed", "mirrored"]
    assert "3 policies, 2 episodes of each" in out
    assert "walkers:walker" in out
    assert str(folder) in out
    assert all(len(text) <= 80 for text in out.splitlines() if str(folder) not in text)
    assert re.search(r"about \d+ s for 2 starts", err)
    code, _, err = acwm(capsys, *words, "--seeds", "0..2")
    assert code == 0, err
    lines = (folder / "episodes.jsonl").read_text().splitlines()
    assert [json.loads(text) for text in lines[: len(made)]] == made
    assert len(lines) == len(made) + 4
    code, _, err = acwm(capsys, *words, "--steps", "3")
    assert (code, "holds results of another steps" in err) == (2, True)


def test_a_policy_that_fails_does_not_end_the_others(mine, capsys, tmp_path, monkeypatch):
    """Where one fails once, all are compared on the other episodes; one that always fails goes."""
    (tmp_path / "fallible.py").write_text(
        "calls = []\n"
        "def once(frame):\n"
        "    calls.append(frame)\n"
        "    if len(calls) == 1:\n"
        "        raise KeyError('first')\n"
        "    return [1.0, 1.0]\n"
        "def never(frame):\n"
        "    return [1.0]\n"
    )
    monkeypatch.chdir(tmp_path)
    policies = ["behaviour", "fallible:once", "fallible:never"]
    words = ["rank", mine, "place", *(w for p in policies for w in ("--policies", p))]
    code, out, err = acwm(capsys, *words, "--seeds", "0..2")
    assert code == 0, err
    assert "2 policies, 2 episodes of each" in out
    assert "fallible:once with seed 0 is left out: KeyError: 'first'" in err
    assert err.count("fallible:never with seed") == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "unknown slide task 'nowhere'"),
        (["place", "--policies", "solutoin"], "did you mean 'solution'"),
        (
            ["place", "--policies", "nothing_there:policy"],
            "nothing_there:policy cannot be imported",
        ),
        (["place", "--seeds", "3..1"], "give numbers of episodes"),
        (["place", "--steps", "0"], "0 is not in the range"),
        (["place", "--device", "warp"], "warp"),
    ],
)
def test_bad_words_are_one_sentence(exact, capsys, words, message):
    code, _, err = acwm(capsys, "rank", exact, *words)
    assert code == 2
    assert message in err
    assert "Traceback" not in err


def test_a_world_without_an_estimator_cannot_be_judged(tmp_path, capsys):
    from tests import tiny

    run = tiny.make_exact_run(tmp_path / "run", environment="unread")
    code, _, err = acwm(capsys, "rank", run, "place")
    assert (code, "no estimator reads the states of unread" in err) == (2, True)
