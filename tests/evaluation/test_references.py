"""Rows that do not depend on the model: kept with the data, and never out of date."""

import shutil
import sys
import types
from dataclasses import replace

import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.remote import cache_folder
from acwm_core.evaluation import references
from acwm_core.evaluation.clips import plan_clips
from acwm_core.evaluation.evaluate import open_run
from acwm_core.evaluation.references import KEPT, package_hash, references_file
from acwm_core.evaluation.storage import load_scores, write_scores
from acwm_core.training.run_folder import RunFolder
from acwm_interventions.evaluate import evaluate_run
from tests import tiny


@pytest.fixture(scope="module")
def own(data, tmp_path_factory):
    """A dataset of one's own with kept rows, a run that was evaluated on it, and its scores."""
    home = tmp_path_factory.mktemp("own")
    folder = shutil.copytree(data, home / "data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ACWM_CACHE", str(home / "cache"))
        run = tiny.make_run(home / "run", folder, counterfactual_metrics=[], videos=0)
        yield folder, run, scores(run)


@pytest.fixture
def kept():
    """The folder in which rows are kept."""
    return cache_folder() / "references"


def scores(run):
    summary = evaluate_run(run, progress=False)
    return summary.splits, summary.gap


def test_a_second_run_scores_its_own_rows_alone_and_comes_to_the_same(own, kept, monkeypatch):
    _, run, first = own
    names = sorted(path.name for path in kept.iterdir())
    assert [name.rpartition("-")[0] for name in names] == ["ind_test", "ood_test"]

    scored = []
    score = references.Evaluator.scores

    def watched(self, plans, episodes, predictors=None):
        scored.append(predictors)
        return score(self, plans, episodes, predictors)

    monkeypatch.setattr(references.Evaluator, "scores", watched)
    assert scores(run) == first
    assert scored
    assert not {each for predictors in scored for each in predictors} & {*KEPT}
    assert sorted(path.name for path in kept.iterdir()) == names


def test_what_is_damaged_is_scored_again(own, kept):
    _, run, first = own
    for path in kept.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    assert scores(run) == first


@pytest.mark.parametrize("harm", ["read-only", "a file in its place"])
def test_without_a_place_to_keep_them_they_are_scored_again(own, harm, tmp_path, monkeypatch):
    _, run, first = own
    cache = tmp_path / "cache"
    monkeypatch.setenv("ACWM_CACHE", str(cache))
    if harm == "read-only":
        cache.mkdir(mode=0o500)
    else:
        cache.write_text("")
    assert scores(run) == first


def test_rows_that_come_with_the_data_are_not_believed(own, kept, tmp_path, monkeypatch):
    """A stranger's dataset holds rows in which a still picture is bad, and so any model is good."""
    folder, run, first = own
    theirs = shutil.copytree(folder, tmp_path / "data")
    for path in kept.iterdir():
        worse = [
            replace(each, values={name: 1e3 for name in each.values}) for each in load_scores(path)
        ]
        (theirs / "references").mkdir(exist_ok=True)
        write_scores(theirs / "references" / path.name, worse)
    summary = evaluate_run(run, data=theirs, overwrite=True, progress=False)
    assert (summary.splits, summary.gap) == first


def test_data_that_claim_the_checksums_of_others_have_rows_of_their_own(own, tmp_path):
    """Its manifest, which the checksum is of, is another's; its shards are not."""
    folder, run, first = own
    theirs = shutil.copytree(folder, tmp_path / "data")
    counts, other = {"ind_test": 5, "ood_test": 4}, tmp_path / "other"
    generate("drift", other, episodes=counts, seed=9, workers=0, progress=False, shard_episodes=3)
    for split in ("ind_test", "ood_test"):
        for shard in (other / split).glob("*.tar"):
            shutil.copy(shard, theirs / split)
    assert (
        EpisodeDataset(theirs, "ind_test").checksum == EpisodeDataset(folder, "ind_test").checksum
    )
    forged, _ = scores(tiny.make_run(tmp_path / "run", theirs, counterfactual_metrics=[], videos=0))
    again, _ = scores(run)
    assert again == first[0]
    still = [each["ind_test"].scores.rows["copy"]["mse"].value for each in (forged, again)]
    assert still[0] != still[1]


@pytest.mark.ci
def test_the_name_changes_with_whatever_the_rows_depend_on(own, monkeypatch):
    folder, run, _ = own
    _, evaluator = open_run(RunFolder(run), [])
    episodes = EpisodeDataset(folder, "ind_test")
    plans = plan_clips("ind_test", episodes.lengths, evaluator.config)

    def name(evaluator=evaluator, plans=plans, episodes=episodes):
        return references_file(evaluator, plans, episodes).name

    few = {"mse": evaluator.metrics["mse"]}
    others = [
        name(plans=plans[:-1]),
        name(plans=[replace(plan, start=1) for plan in plans]),
        name(plans=[replace(plan, noise_floor=False) for plan in plans]),
        name(episodes=EpisodeDataset(folder, "ood_test")),
        name(replace(evaluator, metrics=few)),
        name(replace(evaluator, config=replace(evaluator.config, metric_options={"mse": {}}))),
    ]
    monkeypatch.setattr(type(evaluator.world_model.codec), "fingerprint", lambda self: "other")
    others.append(name())
    monkeypatch.undo()
    monkeypatch.setattr(references, "package_hash", lambda name: "other code")
    others.append(name())
    monkeypatch.undo()
    monkeypatch.setattr(references, "installed_packages", lambda: [])
    others.append(name())
    monkeypatch.undo()
    assert name() == name()
    assert len({name(), *others}) == 1 + len(others)


def test_a_package_is_all_its_files_but_caches(tmp_path, monkeypatch):
    package = tmp_path / "measuring_of_a_third_party"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "weights.safetensors").write_bytes(b"1")
    monkeypatch.syspath_prepend(tmp_path)

    def hashed():
        package_hash.cache_clear()
        return package_hash(package.name)

    (package / "limits.json").write_text("{}")
    hashes = [hashed()]
    (package / "__pycache__").mkdir()
    (package / "__pycache__/__init__.cpython-311.pyc").write_bytes(b"3")
    assert hashed() == hashes[0]
    for name in ("weights.safetensors", "limits.json", "__init__.py"):
        (package / name).write_text("ERROR = 1")
        hashes.append(hashed())
    assert len(set(hashes)) == 4
    assert package_hash("__main__") is None  # so nothing is kept of a metric that was typed in


def test_a_module_made_in_memory_has_no_hash(monkeypatch):
    monkeypatch.setitem(sys.modules, "made_in_memory", types.ModuleType("made_in_memory"))
    assert package_hash("made_in_memory") is None
