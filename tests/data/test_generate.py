"""Datasets: the same bytes by any workers, in any order; refusals; what the card says."""

import errno
import functools
import io
import json
import os
import shlex
import shutil

import numpy as np
import pytest
import rich.console
from click.testing import CliRunner
from conftest import EPISODES, checksums
from square_world import Square

from acwm_core.cli.main import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset, Manifest
from acwm_core.data.generate import ShardTask, generate, make_shard, parse_episodes
from acwm_core.data.shards import open_shard
from acwm_core.data.simulate import simulated
from acwm_core.errors import DataError, RecipeError
from acwm_core.executors import LocalExecutor, progress_bar
from acwm_core.files import alone, held
from acwm_core.plugins import catalog


def make(out, environment="square", **changes):
    settings = {"episodes": EPISODES, "workers": 0, "shard_episodes": 4, "progress": False}
    return generate(environment, out, **(settings | changes))


@pytest.mark.parametrize("workers", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_any_number_of_workers_makes_the_same_bytes(square_data, tmp_path, workers):
    make(tmp_path / "again", workers=workers)
    assert checksums(tmp_path / "again") == checksums(square_data)


def test_any_order_makes_the_same_shards(square_data, tmp_path):
    card = DatasetCard.read(square_data)
    source = functools.partial(simulated, catalog().component("environment", "square"))
    (tmp_path / "train").mkdir()
    for first in (8, 0, 4):
        path = tmp_path / "train" / f"shard-{first // 4:05d}.tar"
        count = min(4, 11 - first)
        task = ShardTask(source, card, path, "train", first, count)
        _, record = make_shard(task, lambda units: None)
        assert record == Manifest(square_data / "train").records[path.name]


def test_seed_size_and_factors_change_the_data(square_data, tmp_path):
    usual = Manifest(square_data / "train").checksum()
    for name, change in {
        "seed": {"seed": 1},
        "size": {"size": 64},
        "factors": {"factors": {"speed": "ood"}},
    }.items():
        make(tmp_path / name, **change)
        assert Manifest(tmp_path / name / "train").checksum() != usual, name
    assert open_shard(tmp_path / "size/train/shard-00000.tar").episode(0).video.shape[1:3] == (
        64,
        64,
    )
    about = open_shard(tmp_path / "factors/train/shard-00000.tar").about(0)
    assert about["ood_label"] == "speed"


def test_the_card_tells_all(square_data):
    card = DatasetCard.read(square_data)
    assert card.environment.name == "square"
    assert card.environment.factors == Square.card.factors
    assert card.splits == EPISODES
    assert card.options == {"size": [32, 32]}
    assert {"acwm", "numpy", "av", "platform"} <= set(card.versions)
    shards = [open_shard(path) for path in sorted((square_data / "train").glob("*.tar"))]
    actions = np.concatenate([s.episode(i).actions[:-1] for s in shards for i in range(len(s))])
    statistics = card.actions["train"]
    np.testing.assert_allclose(statistics["mean"], actions.mean(0, dtype=np.float64), atol=1e-9)
    np.testing.assert_allclose(statistics["std"], actions.std(0, dtype=np.float64), atol=1e-7)
    np.testing.assert_array_equal(statistics["min"], actions.min(0))
    np.testing.assert_array_equal(statistics["max"], actions.max(0))
    line = json.loads((square_data / "train/manifest.jsonl").read_text().splitlines()[-1])
    assert (line["episodes"], line["frames"], line["first"]) == (3, 63, 8)


def test_a_finished_dataset_is_left_alone(tmp_path):
    first = make(tmp_path / "data")
    files = {p: p.stat().st_ino for p in (tmp_path / "data").rglob("*.tar")}
    assert make(tmp_path / "data", workers=2) == first
    assert {p: p.stat().st_ino for p in (tmp_path / "data").rglob("*.tar")} == files


def test_a_split_can_be_added_later(square_data, tmp_path):
    for split, count in EPISODES.items():
        make(tmp_path / "data", episodes={split: count})
    assert checksums(tmp_path / "data") == checksums(square_data)


def test_missing_and_damaged_shards_are_made_again(square_data, tmp_path):
    folder = tmp_path / "data"
    make(folder)
    kept = (folder / "train/shard-00002.tar").stat().st_ino
    (folder / "train/shard-00000.tar").unlink()
    damaged = folder / "train/shard-00001.tar"
    damaged.write_bytes(damaged.read_bytes()[:-7000])
    make(folder)
    assert checksums(folder) == checksums(square_data)
    assert (folder / "train/shard-00002.tar").stat().st_ino == kept


def test_shards_that_were_not_yet_recorded_are_not_made_again(square_data, tmp_path):
    folder = tmp_path / "data"
    make(folder)
    manifest = folder / "train/manifest.jsonl"
    lines = manifest.read_text()
    manifest.write_text(lines[: len(lines) // 2])  # the last line is torn
    inodes = {p: p.stat().st_ino for p in folder.rglob("*.tar")}
    make(folder)
    assert checksums(folder) == checksums(square_data)
    assert {p: p.stat().st_ino for p in folder.rglob("*.tar")} == inodes


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"seed": 7}, "seed is 0 there, 7 now"),
        ({"size": 64}, r"environment.frame_size is \[32, 32\] there, \[64, 64\] now"),
        ({"factors": {"speed": 0.7}}, "factors.speed is not set there, 0.7 now"),
        ({"episodes": {"train": 12}}, "splits.train is 11 there, 12 now"),
        ({"shard_episodes": 5}, "shard_episodes is 4 there, 5 now"),
    ],
)
def test_another_dataset_in_the_folder_is_refused(square_data, change, difference):
    before = checksums(square_data)
    with pytest.raises(DataError, match=f"holds another dataset: .*{difference}"):
        make(square_data, **change)
    assert checksums(square_data) == before


def test_other_versions_matter_only_to_missing_shards(tmp_path):
    folder = tmp_path / "data"
    make(folder)
    card = DatasetCard.read(folder).to_dict()
    card["versions"]["numpy"] = "1.0"
    DatasetCard.from_dict(card).write(folder)
    make(folder)
    (folder / "train/shard-00000.tar").unlink()
    with pytest.raises(DataError, match=r"versions.numpy is 1\.0 there"):
        make(folder)


def test_folders_that_cannot_be_used_are_refused(tmp_path, square_data):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match=r"holds other files \(notes.txt\)"):
        make(tmp_path)
    with pytest.raises(DataError, match=r"cannot write to .*notes\.txt"):
        make(tmp_path / "notes.txt")
    with held(square_data), pytest.raises(DataError, match="another command is writing"):
        make(square_data)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_the_loser_of_two_commands_is_told_so_before_there_is_a_card(tmp_path, monkeypatch):
    """The winner has made its folders and is about to write the card."""
    monkeypatch.setattr("acwm_core.files.ENDING_SECONDS", 0.0)
    (tmp_path / "train").mkdir()
    with held(tmp_path), pytest.raises(DataError, match="another command is writing"):
        generate("square", tmp_path, episodes={"train": 2}, workers=0, progress=False)


def test_killed_before_there_is_a_card_it_resumes(tmp_path, monkeypatch):
    def killed(card, folder):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(DatasetCard, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            generate("square", tmp_path, episodes={"train": 2}, workers=0, progress=False)
    generate("square", tmp_path, episodes={"train": 2}, workers=0, progress=False)


def test_a_file_system_without_locks_is_no_obstacle(square_data, tmp_path, monkeypatch):
    def flock(file, flags):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr("fcntl.flock", flock)
    make(tmp_path / "data")
    assert checksums(tmp_path / "data") == checksums(square_data)
    with alone(tmp_path / "file") as mine:
        assert mine


def test_the_commands_that_are_advised_do_what_they_are_advised_for(tmp_path):
    out, again = tmp_path / "data", tmp_path / "again"
    other = {"size": (24, 40), "seed": 3, "factors": {"speed": 0.75}, "shard_episodes": 32}
    make(out, episodes={"train": 2}, **other)
    with pytest.raises(DataError, match="add it with") as refusal:
        EpisodeDataset(out, "ind_test")
    advised = shlex.split(str(refusal.value).split("`")[1])
    result = CliRunner().invoke(main, [*advised[1:], "--episodes", "3", "--workers", "0"])
    assert result.exit_code == 0, result.output
    assert len(EpisodeDataset(out, "ind_test")) == 3
    told = shlex.split(DatasetCard.read(out).command(again))
    assert CliRunner().invoke(main, [*told[1:], "--workers", "0"]).exit_code == 0
    assert checksums(again) == checksums(out)


def test_what_killed_writers_left_is_removed(square_data, tmp_path):
    out = tmp_path / "data"
    (out / "train").mkdir(parents=True)
    shutil.copy(square_data / "card.yaml", out)
    for name in (".card.yaml.node-1.partial", "train/.shard-00000.tar.node-2.partial"):
        (out / name).write_text("half of i")
    make(out)
    assert checksums(out) == checksums(square_data)


def test_impossible_requests_are_refused_before_anything_is_made(tmp_path):
    out = tmp_path / "data"
    for change, message in (
        ({"environment": "sqare"}, "did you mean 'square'"),
        ({"factors": {"sped": 1}}, "did you mean 'speed'"),
        ({"factors": {"colour": "blue"}}, "colour=blue is not possible"),
        ({"episodes": {"test": 1}}, "unknown split 'test'"),
        ({"episodes": {"train": -1}}, "-1 episodes of train"),
        ({"episodes": {"train": 0}}, "no episodes were requested"),
        ({"workers": -2}, "workers cannot be -2"),
        ({"shard_episodes": 0}, "shard_episodes"),
    ):
        with pytest.raises((RecipeError, RecipeError), match=message):
            make(out, **change)
    assert not out.exists()


@pytest.mark.parametrize("workers", [0, 2])
def test_an_episode_that_fails_is_named(tmp_path, workers):
    failed = r"paint\nin episode 5 of train of failing_square \(.*square_world\.py:\d+\)"
    with pytest.raises(ZeroDivisionError, match=failed):
        make(tmp_path / "data", "failing_square", workers=workers)
    with pytest.raises(DataError, match=r"train of .* holds \d of its 11 episodes: run the"):
        EpisodeDataset(tmp_path / "data", "train")


def test_progress_counts_every_episode():
    counted = []
    results = list(LocalExecutor(2).run(_double, [1, 2, 3, 4], counted.append))
    assert sorted(results) == [2, 4, 6, 8]
    assert sum(counted) == 10
    assert list(LocalExecutor(0).run(_double, [3, 1], counted.append)) == [6, 2]
    assert list(LocalExecutor(2).run(_double, [], counted.append)) == []


def test_workers_have_the_variables_of_the_shell_as_they_are_now(monkeypatch):
    for value in ("1", "2"):
        monkeypatch.setenv("ACWM_TEST", value)
        found = list(LocalExecutor(2).run(_variable, ["ACWM_TEST"] * 2, lambda units: None))
        assert found == [value] * 2


def test_a_process_that_was_forked_has_workers_of_its_own():
    numbers = [1, 2, 3]
    assert sorted(LocalExecutor(2).run(_double, numbers, lambda units: None)) == [2, 4, 6]
    child = os.fork()
    if not child:
        try:
            found = sorted(LocalExecutor(2).run(_double, numbers, lambda units: None))
            os._exit(0 if found == [2, 4, 6] else 2)
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0


def test_the_bar_tells_rate_and_remaining_time_of_what_was_missing(monkeypatch):
    """Ten episodes were there; the others take a minute and a half each."""
    screen, now = io.StringIO(), [1000.0]
    terminal = functools.partial(
        rich.console.Console,
        file=screen,
        force_terminal=True,
        color_system=None,
        width=200,
        get_time=lambda: now[0],
    )
    monkeypatch.setattr("rich.console.Console", lambda stderr: terminal())
    with progress_bar("square", 18, done=10) as report:
        for _ in range(4):
            now[0] += 90
            report(1)
    last = screen.getvalue().rpartition("square")[2]
    assert "14/18 episodes 0.7/min" in last
    assert "0:06:00" in last


def _variable(name, report):
    return os.environ[name]


def _double(number, report):
    for _ in range(number):
        report(1)
    return 2 * number


@pytest.mark.parametrize(
    ("text", "split", "expected"),
    [
        (None, "all", {"train": 100, "ind_test": 10, "ood_test": 20}),
        (None, "ood_test", {"ood_test": 20}),
        ("7", "train", {"train": 7}),
        ("1000", "all", {"train": 1000, "ind_test": 100, "ood_test": 200}),
        ("3", "all", {"train": 3, "ind_test": 1, "ood_test": 1}),
        ("50,6,0", "all", {"train": 50, "ind_test": 6, "ood_test": 0}),
    ],
)
def test_episode_counts_are_read(text, split, expected):
    assert parse_episodes(text, Square.card, split) == expected


@pytest.mark.parametrize(
    ("text", "split"),
    [("many", "all"), ("1,2", "all"), ("1,2,3", "train"), ("-1", "train"), ("", "all")],
)
def test_wrong_episode_counts_are_refused(text, split):
    with pytest.raises(RecipeError, match="--episodes"):
        parse_episodes(text, Square.card, split)
    with pytest.raises(RecipeError, match="did you mean 'train'"):
        parse_episodes("1", Square.card, "trian")
