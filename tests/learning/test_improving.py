"""`acwm policy improve`: what is collected, what each round leaves, and what a kill costs."""

import csv
import json

import numpy as np
import pytest

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import TaskEnvironment
from acwm_core.errors import DataError, RecipeError
from acwm_core.training.fit import fit
from acwm_formats.check import check_dataset
from acwm_planning.policies.saved import SavedPolicy
from acwm_policy import improve as module
from acwm_policy.collect import Collection, collect
from acwm_policy.improve import improve_policy
from acwm_policy.settings import PolicySettings
from acwm_report.policy_page import rounds_beside
from tests import tiny
from tests.learning.world import straight

CARD = tiny.Slide.card


@pytest.fixture(scope="module")
def model(parts, tmp_path_factory):
    """A scene that was hardly trained, and its data."""
    folder = tmp_path_factory.mktemp("scene")
    generate("slide", folder / "data", episodes={"train": 6}, workers=0, progress=False)
    recipe = tiny.tiny_recipe(
        folder / "data",
        env={"name": "slide"},
        model={"name": "scene", "channels": 4, "width": 8, "blocks": 1},
        objective={"name": "scene", "motion_steps": 2},
        data={"states": ["position"], "clip_frames": 13},
        trainer={"max_steps": 2},
    )
    return fit(recipe, folder / "run"), folder / "data"


@pytest.fixture
def policy(parts, tmp_path):
    return straight(tmp_path / "straight")


def distances(episode, goal):
    return np.linalg.norm(episode.states["position"] - goal.state["position"], axis=-1)


def goal_of(spec):
    task = TaskEnvironment(make_environment("slide"), tiny.PLACE)
    task.reset(options={"spec": spec})
    return task.goal


def test_what_a_policy_does_is_recorded_as_the_simulator_shows_it(policy, tmp_path):
    """Two behaviour episodes, two of the best policy, which then go straight to their goals."""
    collection = Collection(CARD, (policy,), 2, 0.0)
    collect(collection, tmp_path / "data", workers=0)
    episodes = EpisodeDataset(tmp_path / "data", "train")
    assert len(episodes) == 4
    for episode in episodes:
        again = simulate(make_environment("slide"), episode.spec, episode.actions)
        np.testing.assert_array_equal(episode.video, again.video)
    behaviour = simulate(make_environment("slide"), episodes[1].spec)
    np.testing.assert_array_equal(episodes[1].actions, behaviour.actions)
    for number in (2, 3):
        away = distances(episodes[number], goal_of(episodes[number].spec))
        assert away[-1] < 0.5 * away[0]
    assert [f for f in check_dataset(tmp_path / "data") if f.problem] == []


def test_a_collection_grows_and_keeps_what_there_was(policy, tmp_path):
    few = Collection(CARD, (policy,), 2, 0.3)
    collect(few, tmp_path / "data", workers=0)
    before = [e.actions for e in EpisodeDataset(tmp_path / "data", "train")]
    more = Collection(CARD, (policy, policy), 2, 0.3)
    collect(more, tmp_path / "data", workers=0)
    after = [e.actions for e in EpisodeDataset(tmp_path / "data", "train")]
    assert len(after) == 6
    for one, other in zip(before, after, strict=False):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(DataError, match="holds another dataset"):
        collect(Collection(CARD, (policy,) * 3, 2, 0.1), tmp_path / "data", workers=0)


def test_noise_moves_what_a_policy_does(policy):
    task, saved = TaskEnvironment(make_environment("slide"), tiny.PLACE), SavedPolicy.read(policy)
    spec = EpisodeSpec("slide", "train", 5)
    calm, one, again = (
        Collection(CARD, (), 2, noise).actions(task, saved, spec) for noise in (0.0, 0.5, 0.5)
    )
    np.testing.assert_array_equal(one, again)
    assert 0.1 < np.abs(one - calm).mean() < 2
    assert (np.abs(one) <= 2).all()


def test_a_dataset_that_is_given_comes_first(policy, model, tmp_path):
    _, data = model
    collect(Collection(CARD, (policy,), 4, 0.0, base=data), tmp_path / "data", workers=0)
    episodes, given = EpisodeDataset(tmp_path / "data", "train"), EpisodeDataset(data, "train")
    assert len(episodes) == 8  # of six given ones, one whole shard of four
    for number in range(4):
        np.testing.assert_array_equal(episodes[number].video, given[number].video)
    with pytest.raises(RecipeError, match="holds no simulated episodes of slide"):
        Collection(CARD, (policy,), 4, 0.0, base=tmp_path / "data").dataset()


def improved(run, out, **options):
    quick = PolicySettings("backprop", parameters={"net_arch": [8], "horizon": 2})
    return improve_policy(
        *(run, "slide.place"),
        settings=quick,
        out=out,
        **{
            **{"rounds": 1, "seeds": range(2), "episodes": 2, "steps": 16, "scenes": 2},
            **{"starts": 4, "workers": 0, "device": "cpu", "recipe": ("trainer.max_steps=1",)},
            **options,
        },
    )


class Killed(BaseException):
    pass


@pytest.mark.ci
def test_it_goes_on_where_it_was_killed(model, tmp_path, monkeypatch):
    """Killed after each of its stages, it ends with the rounds of one that was not."""
    run, _ = model
    whole = improved(run, tmp_path / "whole", rounds=2)
    stages = ["collect", "fit", "train_policy", "evaluate_policy", "write_table"]
    done = []
    for name in stages:
        stage = getattr(module, name)

        def stage_and_die(*given, stage=stage, name=name, **options):
            found = stage(*given, **options)
            if name not in done:
                done.append(name)
                raise Killed
            return found

        monkeypatch.setattr(module, name, stage_and_die)
    for _ in stages:
        with pytest.raises(Killed):
            improved(run, tmp_path / "killed", rounds=2)
    assert sorted(done) == sorted(stages)
    assert improved(run, tmp_path / "killed", rounds=2) == whole
    assert [line["round"] for line in whole] == [0, 1, 2]
    assert [line["frames"] for line in whole] == [0, 4 * 13, 6 * 13]  # two of them of behaviour
    assert [line["steps"] for line in whole] == [16, 32, 48]
    rows = [*csv.DictReader((tmp_path / "killed" / "rounds.csv").open())]
    assert [float(row["simulator"]) for row in rows] == [e["simulator"]["value"] for e in whole]
    models = [(tmp_path / "killed" / f"round-{n}/model/model.safetensors") for n in (1, 2)]
    assert models[0].read_bytes() != models[1].read_bytes()


def test_other_settings_do_not_go_on(run, tmp_path):
    out = tmp_path / "improved"
    improved(run, out, rounds=0)
    assert [json.loads(line)["frames"] for line in (out / "rounds.jsonl").open()] == [0]
    with pytest.raises(DataError, match="holds results of another noise"):
        improved(run, out, rounds=0, noise=0.5)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["algorithm=clone"], "clone does not learn in a dream"),
        (["algorithm=backprop", "--noise", "2"], "0<=x<=1"),
        (["one", "two"], "give one model, not one, two"),
    ],
)
def test_wrong_words_are_one_sentence(run, tmp_path, capsys, words, said):
    models = [str(run)] if "two" not in words else []
    with pytest.raises(SystemExit) as ended:
        main(["policy", "improve", "slide.place", *models, *words, "--out", str(tmp_path / "x")])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_a_policy_that_learns_in_the_simulator_is_the_curve_beside(run, tmp_path, capsys):
    """Its frames are those of its own steps, and rounds of another task are refused."""
    library = PolicySettings("ppo", parameters={"n_steps": 4, "batch_size": 4})
    options = {"settings": library, "place": "simulator", "scenes": 1, "steps": 8}
    lines = improve_policy(
        *(run, "slide.place"),
        **{**options, "out": tmp_path / "free", "rounds": 1, "seeds": range(2), "starts": 4},
    )
    steps = [line["steps"] for line in lines]
    assert [line["frames"] for line in lines] == [4 * count for count in steps]
    assert steps[1] > steps[0] >= 8
    assert [line["dream"] for line in lines] == [None, None]
    assert not (tmp_path / "free" / "data").exists()
    curve = rounds_beside(tmp_path / "free", "slide.place", 2)
    assert [*curve.x] == [line["frames"] for line in lines]
    assert [*curve.y] == [100 * line["simulator"]["value"] for line in lines]
    assert [*curve.high] == [100 * line["simulator"]["high"] for line in lines]
    words = ["slide.place", str(run), "algorithm=backprop", "--beside", str(tmp_path / "free")]
    with pytest.raises(SystemExit) as ended:
        main(["policy", "improve", *words, "--seeds", "0..2", "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert "takes those of slide.place on the same 3" in capsys.readouterr().err


def test_the_command_writes_a_page_with_every_round(run, tmp_path, capsys):
    few = ["net_arch=[8]", "horizon=2", "--steps", "16", "--scenes", "2", "--starts", "4"]
    words = ["algorithm=backprop", *few, "--rounds", "0", "--seeds", "0..1"]
    (tmp_path / "free").mkdir()
    header = "task,round,frames,episodes,simulator,simulator_low,simulator_high"
    (tmp_path / "free/rounds.csv").write_text(f"{header}\nslide.place,0,96,2,0.5,0.1,0.9\n")
    words += ["--beside", str(tmp_path / "free")]
    with pytest.raises(SystemExit) as ended:
        main(["policy", "improve", "slide.place", str(run), *words, "--out", str(tmp_path / "out")])
    said = capsys.readouterr()
    assert ended.value.code == 0, said.err
    assert "Round 0" in said.out
    page = (tmp_path / "out" / "index.html").read_text()
    assert "in the simulator: free" in page
    assert "Rounds of slide.place" in page
    assert "simulated frames" in page
