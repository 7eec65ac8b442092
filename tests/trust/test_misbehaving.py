"""Components that give what they may not: one sentence with the part, and no number that is wrong.

No such result may be used: it would be broadcast, cut or rounded, and nobody would notice.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.generate import generate
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.model.build import build_world_model
from acwm_core.plugin_code import WrongResultError
from acwm_core.plugins import catalog
from acwm_core.recipe import compose
from tests.evaluation import tiny
from tests.planning import tiny as planning
from tests.trust import misbehaving

FEW = {
    "metrics": ["psnr"],
    "counterfactual_episodes": 0,
    "perturbed_episodes": 0,
    "counterfactual_metrics": [],
    "videos": 0,
}


@pytest.fixture(scope="module", autouse=True)
def parts():
    torch.set_num_threads(1)
    planning.register()
    for plugin in (misbehaving.MisbehavingPlugin, misbehaving.MisledPlugin):
        if plugin.__name__ not in catalog().plugins:
            catalog().add_plugin(plugin, plugin.__name__)


@pytest.fixture(scope="module")
def run(parts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    data = tiny.make_dataset(folder / "data", ind_test=2, ood_test=2)
    return tiny.make_run(folder / "run", data, **FEW)


@pytest.fixture(scope="module")
def misled(parts, tmp_path_factory):
    """A run in the environment of wrong tasks."""
    folder = tmp_path_factory.mktemp("misled")
    counts = {"train": 1, "ind_test": 2, "ood_test": 2}
    generate("misled", folder / "data", episodes=counts, workers=0, progress=False)
    return tiny.make_run(folder / "run", folder / "data", parts={"env": {"name": "misled"}}, **FEW)


def refused(*words):
    """The sentence that ends a command."""
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 2, (result.output, result.exception)
    assert "Traceback" not in result.output
    return result.stderr.strip().splitlines()[-1]


METRICS = [
    ("gives_none", "WrongResultError: per_frame gives None, not numbers"),
    ("gives_one_for_all", "per_frame gives ndarray [1] float64, not the shape [9]"),
    ("gives_texts", "per_frame gives ndarray [9] <U1, not numbers"),
    ("gives_too_few", "per_frame gives ndarray [8] float64, not the shape [9]"),
    ("exits", "SystemExit: 0"),
    ("presses", "KeyboardInterrupt"),
    ("value_per_frame", "value gives ndarray [9] float64, not the shape []"),
    ("negative_weight", "weight gives -1.0, not a finite number of at least 0"),
    ("no_features", "features gives None, not numbers"),
]


@pytest.mark.parametrize(("name", "told"), METRICS)
def test_metrics(run, name, told):
    words = [f"evaluation.metrics=[psnr,{name}]", "--overwrite"]
    said = refused("evaluate", run, *words)
    assert f"metric '{name}' failed in episode 0 of ind_test, from frame 0: " in said
    assert told in said
    assert not (run / "evaluation/summary.json").exists()


@pytest.mark.parametrize("name", ["no_summary", "no_distance"])
def test_summaries_of_metrics(run, name):
    said = refused("evaluate", run, f"evaluation.metrics=[psnr,{name}]")
    assert f"metric '{name}' failed when it sums clips up: WrongResultError: " in said
    assert " gives None, not numbers" in said


def test_what_metrics_depend_on_can_be_written_down(run):
    said = refused("evaluate", run, "evaluation.metrics=[psnr,strange_provenance]")
    assert "Errors" not in said
    assert "metric 'strange_provenance' failed: WrongResultError: provenance gives" in said


NETWORKS = [
    ("codec", "drops_a_frame", "_encode gives Tensor [1, 0, 3, 8, 8]"),
    ("codec", "drops_a_channel", "_encode gives Tensor [1, 1, 2, 8, 8]"),
    ("codec", "decodes_grey", "_decode gives Tensor [1, 9, 1, 32, 32]"),
    ("conditioner", "of_one_frame", "modulation gives Tensor [1, 1, 4]"),
    ("conditioner", "of_one_width", "modulation gives Tensor [1, 5, 1]"),
    ("conditioner", "no_conditioning", "forward gives None, not a Conditioning"),
    ("model", "one_channel", "forward gives Tensor [1, 5, 1, 8, 8]"),
    ("model", "predicts_less", "predict gives Tensor [1, 4, 3, 8, 8]"),
    ("model", "model_exits", "SystemExit: 0"),
]


def with_part(run, folder, kind, name):
    """A run with another component, whose weights fit."""
    made = Path(shutil.copytree(run, folder / "run"))
    recipe = yaml.safe_load((made / "recipe.yaml").read_text())
    recipe[kind] = {"name": name}
    (made / "recipe.yaml").write_text(yaml.safe_dump(recipe))
    return made


@pytest.mark.parametrize(("kind", "name", "told"), NETWORKS)
def test_networks(run, tmp_path, kind, name, told):
    made = with_part(run, tmp_path, kind, name)
    said = refused("rollout", made, "--out", tmp_path / "video.mp4")
    assert f"{kind} '{name}' failed: " in said
    assert told in said
    assert not (tmp_path / "video.mp4").exists()


def test_python_is_told_as_well(run, tmp_path):
    made = with_part(run, tmp_path, "conditioner", "of_one_width")
    card = DatasetCard.read(made / "card.yaml").environment
    world = build_world_model(compose(made / "recipe.yaml", []), card)
    with pytest.raises(WrongResultError, match=re.escape("not the shape [2, 5, 4]")):
        world.rollout(torch.zeros(2, 3, 32, 32), torch.zeros(2, 9, 2))
    with pytest.raises(WrongResultError, match="modulation gives"):
        world.loss(torch.zeros(1, 5, 3, 8, 8), torch.zeros(1, 9, 2), [torch.Generator()])


@pytest.mark.parametrize("name", ["model_exits", "loss_of_many", "predicts_less"])
def test_training(run, tmp_path, name):
    recipe = with_part(run, tmp_path, "model", name) / "recipe.yaml"
    words = ["trainer.max_steps=1", "data.batch_size=2", "training.validate_every_n_steps=1"]
    said = refused("fit", recipe, *words, "--out", tmp_path / "again")
    where = "a rollout after" if name == "predicts_less" else "training"
    assert f"model '{name}' failed in {where} step 1: " in said


def test_codecs_are_described_truly(run):
    data = run.parent / "data"
    assert "'no_stride' has temporal_stride=0" in refused("encode", data, "--codec", "no_stride")
    said = refused("encode", data, "--codec", "climbs", "--frames", "9")
    assert "the fingerprint '../../climbed', not a valid name" in said
    assert not list(data.parent.rglob("climbed"))


WORLDS = [
    ("no_state", "environment 'no_state' failed in episode 0 of train: AttributeError"),
    ("presses_while_it_moves", "failed in episode 0 of train: KeyboardInterrupt ("),
    ("half_a_contact", "environment 'half_a_contact' failed in episode 0 of train: TypeError"),
    ("replaces", "episode 0 of train of replaces could not be simulated: the environment replaces"),
]


@pytest.mark.parametrize(("name", "told"), WORLDS)
def test_environments(tmp_path, name, told):
    out = tmp_path / "data"
    assert told in refused("generate", name, "--episodes", "1", "--workers", "0", "--out", out)


def test_environments_that_hand_out_the_same_arrays_are_recorded_truly():
    spec = EpisodeSpec("drift", factors={"colour": "train"})
    usual = simulate(make_environment("drift"), spec)
    same = simulate(make_environment("same_arrays"), spec)
    np.testing.assert_array_equal(same.video, usual.video)
    np.testing.assert_array_equal(same.masks, usual.masks)
    assert same.factors == usual.factors


FAST = ("planner.candidates=4", "planner.iterations=1", "planner.elites=2", "planner.horizon=2")

RANK = ("rank", "--policies", "solution", "--policies", "behaviour", "--seeds", "0")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("success_in_words", "success gives ndarray [1] <U2, not of type bool"),
        ("success_nan", "not of type bool"),
        ("no_goal", "sample_goal gives None, not a Goal"),
        ("wild", "solution gives 9.0, not actions from [-2.0, -2.0] to [2.0, 2.0]"),
    ],
)
def test_tasks(misled, tmp_path, name, told):
    words = ["plan", misled, name, "--row", "solution", "--out", tmp_path / "out", "--videos", "0"]
    said = refused(*words, *FAST)
    assert f"task '{name}' of environment 'misled' failed in episode 0 of ind_test" in said
    assert told in said


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("plans_nan", "plan gives nan, not actions from"),
        ("plans_nothing", "plan gives Tensor [0, 2] torch.float32, not actions"),
        ("plans_out_of_bounds", "plan gives 9.0, not actions from"),
        ("plans_another_shape", "plan gives ndarray [4, 7] float32, not the shape [n, 2]"),
        ("no_plan", "plan gives None, not a Plan"),
    ],
)
def test_planners(misled, tmp_path, name, told):
    words = ["plan", misled, "place", f"planner={name}", "--out", tmp_path / "out", "--videos", "0"]
    said = refused(*words)
    assert f"planner '{name}' failed in episode 0 of ind_test: WrongResultError: {told}" in said


def test_a_tasks_own_success_counts(misled, tmp_path):
    out = tmp_path / "out"
    words = ["plan", misled, "never", "--row", "solution", "--out", out, "--videos", "0", *FAST]
    for more in ([], ["max_steps=20"]):
        result = CliRunner().invoke(main, [*map(str, words), *more])
        assert result.exit_code == 0, result.output
        assert '"success": false' in (out / "episodes.jsonl").read_text()
        shutil.rmtree(out)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("short", "(masks) gives ndarray [1, 32, 32] uint8, not the shape ["),
        ("one_place", "(position) gives ndarray [1, 2] float64, not the shape ["),
        ("half_masks", ", 32, 32] float64, not of type uint8"),
        ("far", "(position) gives inf, not finite numbers, or NaN"),
        ("text", " <U32, not numbers"),
    ],
)
@pytest.mark.parametrize("command", [("plan", "cost=state", "--videos", "0", *FAST), RANK])
def test_estimators(misled, tmp_path, monkeypatch, command, name, told):
    monkeypatch.setitem(misbehaving.WRONG, "now", misbehaving.WRONG[name])
    verb, *words = command
    said = refused(verb, misled, "place", *words, "--out", tmp_path / "out")
    assert "estimator 'misled' failed in episode 0 of ind_test" in said
    assert "WrongResultError: estimate (" in said
    assert told in said


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("one_for_both", "solution gives ndarray [1] float64, not the shape [2]"),
        ("in_digits", "solution gives ['1', '1'], not numbers"),
        ("steps_nan", "solution gives nan, not"),
        ("untold", "distance gives nan, not a number in its own states"),
        ("endless", "distance gives inf, not finite numbers of at least 0"),
        ("beyond", ", not finite numbers of at least 0"),
        ("small_picture", "(frame) gives ndarray [4, 4, 3] uint8, not the shape [32, 32, 3]"),
        ("grey_picture", "(frame) gives ndarray [32, 32, 3] float64, not of type uint8"),
    ],
)
@pytest.mark.parametrize("command", [("plan", "--row", "solution", "--videos", "0", *FAST), RANK])
def test_tasks_are_believed_nowhere(misled, tmp_path, command, name, told):
    verb, *words = command
    said = refused(verb, misled, name, *words, "--out", tmp_path / "out")
    assert f"task '{name}' of environment 'misled' failed in episode 0 of ind_test" in said
    assert told in said


@pytest.mark.parametrize(
    "name", ["tolerance_nan", "tolerance_in_words", "steps_in_words", "half_a_step"]
)
def test_tasks_describe_themselves_in_numbers(misled, tmp_path, name):
    said = refused("plan", misled, name, *FAST, "--out", tmp_path / "out")
    assert f"task '{name}' of misled avoids instances that are not on its card, has no " in said


def cost_of_one(futures, task, goal):
    return torch.zeros(())


def imaginary_cost(futures, task, goal):
    return futures.latents([0]).mean((1, 2, 3, 4)) + 1j


@pytest.mark.parametrize(
    ("name", "told"), [("cost_of_one", "not the shape ["), ("imaginary_cost", "not real numbers")]
)
@pytest.mark.parametrize("row", ["model", "simulator"])
def test_costs(misled, tmp_path, row, name, told):
    words = ["cost=callable", f"cost.function={__name__}:{name}", *FAST, "--videos", "0"]
    said = refused("plan", misled, "place", *words, "--row", row, "--out", tmp_path / "out")
    assert "cost 'callable' failed in episode 0 of ind_test: WrongResultError: cost gives" in said
    assert told in said
