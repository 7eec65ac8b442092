"""The runner of tables: what it plays, in which order, and with how many threads."""

import pytest
import torch

from acwm_core.errors import AcwmWarning, DataError
from acwm_core.training import threads
from acwm_planning.resumable import ResumableResults
from acwm_planning.runner import EpisodeTable, play_missing


class Table(EpisodeTable):
    """Records which rows it was asked for; rows named "bad" fail."""

    def __init__(self, rows):
        super().__init__(rows)
        self.played, self.threads = [], []

    def lines(self, seed, rows):
        for row in rows:
            self.played.append((seed, row))
            self.threads.append(torch.get_num_threads())
            with self.left.trying(row, seed):
                if row == "bad":
                    raise DataError("no such thing")
                yield {"row": row, "seed": seed}

    def estimate(self, missing):
        return f"about 3 s for {sum(map(len, missing.values()))} episodes"


def test_what_is_missing_is_played_seed_by_seed(tmp_path, capsys):
    results = ResumableResults(tmp_path, {})
    results.add({"row": "one", "seed": 1})
    table, reported = Table(("one", "two")), []
    play_missing(table, results, (0, 1), report=reported.append, progress="playing")
    assert table.played == [(0, "one"), (0, "two"), (1, "two")]
    assert [(line["seed"], line["row"]) for line in reported] == table.played
    assert "about 3 s for 3 episodes" in capsys.readouterr().err
    play_missing(table, results, (0, 1), progress="playing")
    assert len(table.played) == 3
    assert "about" not in capsys.readouterr().err


def test_a_line_that_is_finished_outlives_a_later_failure(tmp_path):
    results = ResumableResults(tmp_path, {})

    def interrupt(line):
        if line["row"] == "two":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play_missing(Table(("one", "two", "three")), results, (0,), report=interrupt)
    assert [line["row"] for line in results.finished()] == ["one", "two"]


def test_the_first_error_is_raised_if_nothing_could_be_played(tmp_path):
    results = ResumableResults(tmp_path, {})
    with (
        pytest.warns(AcwmWarning, match="bad with seed 0 is left out"),
        pytest.raises(DataError, match="no such thing"),
    ):
        play_missing(Table(("bad",)), results, (0,))
    results.add({"row": "one", "seed": 0})
    with pytest.warns(AcwmWarning, match="bad with seed 0 is left out"):
        play_missing(Table(("bad", "one")), results, (0,))


@pytest.fixture
def two_threads(monkeypatch):
    for name in ("OMP_NUM_THREADS", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


def test_every_seed_takes_a_thread_per_idle_core(tmp_path, monkeypatch, two_threads):
    idle = iter([1.2, 0.1, 1.9, 7.0])
    monkeypatch.setattr(threads, "idle_cores", lambda: next(idle))
    table = Table(("one",))
    play_missing(table, ResumableResults(tmp_path, {}), range(4))
    assert table.threads == [1, 1, 2, 2]
    assert torch.get_num_threads() == 2


def test_users_say_how_many_threads(tmp_path, monkeypatch, two_threads):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(threads, "idle_cores", lambda: 1.0)
    table = Table(("one",))
    play_missing(table, ResumableResults(tmp_path, {}), (0,))
    assert table.threads == [2]
