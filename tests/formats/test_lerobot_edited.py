"""LeRobot datasets that were edited: features of other names, null ones, and removed episodes."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.lerobot import LeRobot
from acwm_planning.rewards.columns import find_column
from acwm_planning.rewards.training import train_reward
from tests.formats.conftest import episodes_of, imported, psnr
from tests.formats.corpus import files
from tests.formats.corpus.cases import Case, three
from tests.formats.test_from_lerobot import LENGTHS, REFERENCE, change_info, reference_video

DATA = "data/chunk-000/file-000.parquet"
PLACES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(params=["video", "image"])
def root(request, tmp_path):
    """A copy of the library's dataset to edit."""
    return shutil.copytree(REFERENCE / request.param, tmp_path / "toy")


def features(root, change):
    info = json.loads((root / "meta/info.json").read_text())
    change(info["features"])
    (root / "meta/info.json").write_text(json.dumps(info))


def rows(root, change):
    table = pq.read_table(root / DATA)
    pq.write_table(change(table), root / DATA)


def renamed(root, *names):
    """Give the first of the names to the actions, and the others to copies of them."""

    def in_info(found):
        action = found.pop("action")
        found.update({name: {**action} for name in names})

    def in_table(table):
        action, table = table.column("action"), table.drop_columns(["action"])
        for name in names:
            table = table.append_column(name, action)
        return table

    features(root, in_info)
    rows(root, in_table)


@pytest.mark.parametrize("name", ["actions", "action.continuous", "Action", "action_0"])
def test_actions_of_another_name(root, tmp_path, name):
    renamed(root, name)
    card = imported(LeRobot().read(root), tmp_path / "data", test_episodes=0)
    assert card.environment.action.names == ("shoulder", "elbow")
    assert f"Actions are {name}." in card.source["notes"]
    for number, episode in enumerate(episodes_of(tmp_path / "data")):
        expected = [(number + 0.25, t - 3.5) for t in range(LENGTHS[number] - 1)]
        np.testing.assert_array_equal(episode.actions[:-1], expected)


def test_actions_in_several_features(root, tmp_path):
    renamed(root, "action.arm", "action.hand")
    with pytest.raises(DataError, match=r"has action\.arm, action\.hand, but none.*--actions"):
        LeRobot().read(root)
    with pytest.raises(DataError, match=r"no numbers 'action\.han'; did you mean 'action\.hand'"):
        LeRobot().read(root, actions="action.arm,action.han")
    recorded = LeRobot().read(root, actions="action.hand,action.arm")
    card = imported(recorded, tmp_path / "data", test_episodes=0)
    assert card.environment.action.size == 4
    assert "--actions action.hand,action.arm" in card.source["command"]
    (first, *_) = episodes_of(tmp_path / "data")
    np.testing.assert_array_equal(first.actions[:, :2], first.actions[:, 2:])


def test_what_lies_beside_the_actions_is_named(root):
    renamed(root, "action", "action.gripper", "pressure")
    (note,) = [note for note in LeRobot().read(root).notes if "left out" in note]
    assert "action.gripper, pressure" in note


def test_a_dataset_without_actions_names_the_option(root):
    renamed(root, "command")
    with pytest.raises(DataError, match=r"give --actions NAME, one or more of .*command"):
        LeRobot().read(root)
    assert LeRobot().read(root, actions="command").actions.names == ("shoulder", "elbow")


@pytest.mark.parametrize("kept", [(0, 2), (1, 3), (0,), (3,), (1, 2)])
def test_episodes_that_were_removed_leave_gaps(root, tmp_path, kept):
    """Their rows and frames stay in the files, before, between and behind those of the others."""
    table = pq.read_table(root / PLACES)
    pq.write_table(table.filter(pa.array([e in kept for e in range(4)])), root / PLACES)
    change_info(root, splits={"train": "0:4"})
    recorded = LeRobot().read(root)
    imported(recorded, tmp_path / "data", test_episodes=0)
    found = episodes_of(tmp_path / "data")
    assert [len(episode.video) for episode in found] == [LENGTHS[number] for number in kept]
    for number, episode in zip(kept, found, strict=True):
        assert psnr(episode.video, reference_video(number)) > 27
        assert episode.actions[0, 0] == number + 0.25


def test_gaps_in_version_2(tmp_path):
    path, _ = files.lerobot(tmp_path, Case("plain", three()))
    index = path / "meta/episodes.jsonl"
    index.write_text("".join(index.read_text().splitlines(keepends=True)[::2]))
    found = LeRobot().read(path).splits
    assert [found[place].name for place in range(len(found))] == ["episode 0", "episode 2"]
    np.testing.assert_array_equal(found[1].actions.values, three()[2].rows)


def test_splits_name_episodes_by_their_numbers(root):
    table = pq.read_table(root / PLACES)
    pq.write_table(table.filter(pa.array([True, False, True, True])), root / PLACES)
    change_info(root, splits={"train": "0:3", "test": "3:4"})
    assert LeRobot().read(root).tests == {"ind_test": [2]}


def test_an_episode_that_is_there_twice(root):
    table = pq.read_table(root / PLACES)
    pq.write_table(pa.concat_tables([table, table.slice(1, 1)]), root / PLACES)
    with pytest.raises(DataError, match="episode 1 twice"):
        LeRobot().read(root)


@pytest.mark.parametrize("kind", [None, pa.list_(pa.float32()), pa.list_(pa.float32(), 2)])
def test_a_state_that_is_null_is_left_out(root, tmp_path, kind):
    """Rows that are null, or vectors of nulls."""

    def empty(table):
        place, count = table.column_names.index("observation.state"), len(table)
        values = pa.nulls(count) if kind is None else pa.array([[None, None]] * count, kind)
        return table.set_column(place, "observation.state", values)

    rows(root, empty)
    card = imported(LeRobot().read(root), tmp_path / "data", test_episodes=0)
    assert card.environment.state == ()
    assert any("null: observation.state" in note for note in card.source["notes"])


def outcomes(root, **columns):
    """Give the dataset further features of one number for each row."""
    kinds = {name.replace("_", "."): pa.array(values) for name, values in columns.items()}

    def in_table(table):
        for name, values in kinds.items():
            table = table.append_column(name, values)
        return table

    about = {
        name: {"dtype": "bool" if pa.types.is_boolean(values.type) else "float32", "shape": [1]}
        for name, values in kinds.items()
    }
    features(root, lambda found: found.update(about))
    rows(root, in_table)


def test_rewards_and_successes_are_facts_of_which_a_head_is_learnt(root, tmp_path):
    """The success is that of the rows of the file, and `--from` knows it by the file's name."""
    solved = [t >= length - 3 for length in LENGTHS for t in range(length)]
    outcomes(root, next_success=solved, next_reward=[float(t) for t in range(sum(LENGTHS))])
    imported(LeRobot().read(root), tmp_path / "data", test_episodes=0)
    episodes = EpisodeDataset(tmp_path / "data", "train")
    kept = [episodes.about(number)["facts"] for number in range(4)]
    assert [won for facts in kept for won in facts["successes"]] == solved
    assert [value for facts in kept for value in facts["rewards"]] == [*range(sum(LENGTHS))]
    head = train_reward(tmp_path / "data", "next.success", tmp_path / "head", steps=10)
    assert (head.card.column, head.card.ahead, head.card.two_valued) == ("successes", True, True)
    found = find_column(episodes, "next.success").rewards(episodes, 0)
    assert found.tolist()[1:] == [*solved[: LENGTHS[0] - 2], solved[LENGTHS[0] - 1]]


def test_a_success_that_nobody_recorded_is_named(root, tmp_path):
    outcomes(root, next_success=pa.nulls(sum(LENGTHS), pa.bool_()))
    card = imported(LeRobot().read(root), tmp_path / "data", test_episodes=0)
    assert any("null: next.success" in note for note in card.source["notes"])
    assert "successes" not in EpisodeDataset(tmp_path / "data", "train").about(0)["facts"]


@pytest.mark.parametrize("name", ["observation.state", "action"])
def test_an_entry_that_is_null_is_named(root, tmp_path, name):
    def hole(table):
        place = table.column_names.index(name)
        values = table.column(name).to_pylist()
        values[3][1] = None
        return table.set_column(place, name, pa.array(values, pa.list_(pa.float32())))

    rows(root, hole)
    with pytest.raises(DataError, match=rf"{name} has an entry that is null in row 3"):
        imported(LeRobot().read(root), tmp_path / "data", test_episodes=0)


@pytest.mark.parametrize("name", ["observation.state", "action"])
def test_a_row_that_is_null_is_named(root, tmp_path, name):
    def hole(table):
        place = table.column_names.index(name)
        values = table.column(name).to_pylist()
        values[3] = None
        return table.set_column(place, name, pa.array(values, table.schema.field(name).type))

    rows(root, hole)
    with pytest.raises(DataError, match=rf"{name} is null in row 3"):
        imported(LeRobot().read(root), tmp_path / "data", test_episodes=0)


def test_a_feature_that_says_nothing_is_named(root):
    features(root, lambda found: found.update({"observation.state": None}))
    with pytest.raises(DataError, match=r"says of the feature observation\.state only None"):
        LeRobot().read(root)
    features(root, lambda found: found.update({"observation.state": {"dtype": None}}))
    assert LeRobot().read(root).state == ()
