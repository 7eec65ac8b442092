"""Whole runs of `fit` on tiny parts: files, resumption, refusals, and what a user sees."""

import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from tensorboard.backend.event_processing import event_accumulator
from torchmetrics.functional.image import structural_similarity_index_measure

from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import AcwmWarning, TrainingError
from acwm_core.recipe import Recipe
from acwm_core.training.callbacks import CpuTime
from acwm_core.training.fit import fit
from acwm_core.training.module import VALIDATION_NOISE, generator_of
from acwm_core.training.precision import automatic_precision
from acwm_core.training.resume import checkpoint_to_resume
from acwm_core.training.run import load_run, read_metadata
from acwm_core.training.run_folder import RunFolder
from acwm_metrics.torchmetrics import as_torchmetric
from tests.tiny import tiny_recipe
from tests.training.callbacks import Kill, Killed
from tests.training.runs import assert_same, killable, killed_run, numbers, weights

OF_ROLLOUTS = {"val/psnr", "val/ssim", "val/psnr_over_first_frame"}


def test_a_run_leaves_its_files(whole):
    for path in (whole.recipe, whole.card, whole.last_checkpoint, whole.weights, whole.metrics):
        assert path.is_file(), path
    assert (whole.checkpoints / "best.ckpt").is_file()
    assert list((whole.path / "tensorboard").glob("events.*"))
    assert read_metadata(whole.weights)["step"] == 16
    losses = [float(v) for (_, name), v in numbers(whole).items() if name == "train/loss"]
    assert len(losses) == 16
    assert losses[-1] < 0.5 * losses[0]
    assert {name for _, name in numbers(whole)} >= {"val/loss", "train/gradient_norm"}


def test_cpu_time_is_counted_on_after_a_resume():
    resumed = CpuTime()
    resumed.load_state_dict({"cpu_seconds": 1000.0})
    before = time.process_time()
    sum(range(300_000))
    spent = time.process_time() - before
    assert 1000 + spent <= resumed.state_dict()["cpu_seconds"] <= 1000 + spent + 1


def test_what_training_started_from_stays_through_a_resume():
    start = {"name": "first", "step": 3, "cpu_seconds": 2.0}
    resumed = CpuTime()
    resumed.load_state_dict(CpuTime(start).state_dict())
    assert resumed.state_dict()["init_from"] == start


def test_validation_measures_the_average_on_the_held_out_clips(whole, data):
    """The logged loss, computed again from the saved weights and the dataset."""
    world_model = load_run(whole.path).world_model
    clips = ClipDataset(EpisodeDataset(data, "train"), frames=9, stride=2, indices=[6, 7])
    assert len(clips) == 4
    video, actions = (torch.stack([clip[key] for clip in clips]) for key in ("video", "actions"))
    latents = world_model.encode(video.float() / 255).half().float()  # as they are cached
    generators = [generator_of(0, VALIDATION_NOISE, clip) for clip in range(4)]
    with torch.autocast("cpu", torch.bfloat16, enabled=automatic_precision("cpu") == "bf16-mixed"):
        loss = world_model.loss(latents, actions, generators)
    assert float(numbers(whole)["15", "val/loss"]) == pytest.approx(loss.item(), rel=1e-5)


def test_validation_predicts_held_out_clips(whole, data):
    """The logged scores, computed again by our metrics from the saved weights and the dataset."""
    world_model = load_run(whole.path).world_model
    clips = ClipDataset(EpisodeDataset(data, "train"), frames=9, stride=12, indices=[6, 7])
    video, actions = (torch.stack([clip[key] for clip in clips]) for key in ("video", "actions"))
    truth = video.float() / 255
    predicted = world_model.rollout(truth[:, 0], actions, steps=world_model.objective.steps)
    psnr, still = as_torchmetric("psnr"), as_torchmetric("psnr")
    psnr.update(predicted, truth)
    still.update(truth[:, :1].expand_as(truth), truth)
    logged = {name: float(value) for (step, name), value in numbers(whole).items() if step == "15"}
    assert logged["val/psnr"] == pytest.approx(psnr.compute().item(), abs=1e-3)
    gap = (psnr.compute() - still.compute()).item()
    assert logged["val/psnr_over_first_frame"] == pytest.approx(gap, abs=1e-3)
    uniform = {"gaussian_kernel": False, "kernel_size": 7, "data_range": 1.0}
    ssim = structural_similarity_index_measure(predicted[0], truth[0], **uniform)
    ssim += structural_similarity_index_measure(predicted[1], truth[1], **uniform)
    assert logged["val/ssim"] == pytest.approx(ssim.item() / 2, abs=1e-4)


def test_validations_rollouts_leave_the_weights_alone(whole, data, tmp_path):
    run = RunFolder(fit(killable(data, training={"validation_rollouts": 0}), tmp_path / "run"))
    rest = {key: value for key, value in numbers(whole).items() if key[1] not in OF_ROLLOUTS}
    assert numbers(run) == rest
    ours = weights(run)
    assert all(torch.equal(value, ours[name]) for name, value in weights(whole).items())


@pytest.mark.parametrize(
    "batches", [[5, 11], *(pytest.param([n], marks=pytest.mark.slow) for n in (3, 8, 12, 15))]
)
def test_a_killed_run_resumes_on_the_same_curve(batches, whole, data, tmp_path, monkeypatch):
    """Killed twice; after a checkpoint, after a validation, between two, and near the end."""
    run = RunFolder(tmp_path / "run")
    for batch in batches:
        monkeypatch.setattr(Kill, "batch", batch)
        with pytest.raises(Killed):
            fit(killable(data), run.path, resume=run.path if run.path.exists() else None)
    monkeypatch.setattr(Kill, "batch", None)
    assert len(numbers(run)) < len(numbers(whole))
    assert fit(killable(data), tmp_path / "unused", resume=run.path) == run.path
    assert_same(whole, run)
    assert not (tmp_path / "unused").exists()


@pytest.mark.parametrize("every", [pytest.param(3, marks=pytest.mark.slow), 4])
def test_a_run_killed_in_validation_resumes_on_the_same_curve(
    every, whole, data, tmp_path, monkeypatch
):
    """With the last checkpoint before, and in the very step of, the validation (step 8)."""
    monkeypatch.setattr(Kill, "batch", 7)
    monkeypatch.setattr(Kill, "in_validation", True)
    changed = {"training": {"checkpoint_every_n_steps": every}}
    run = killed_run(data, tmp_path / "run", monkeypatch, **changed)
    fit(killable(data, **changed), "", resume=run.path)
    assert_same(whole, run)


@pytest.mark.parametrize(
    "changed",
    [
        {"trainer": {"accumulate_grad_batches": 2}},
        *(
            pytest.param(changed, marks=pytest.mark.slow)
            for changed in (
                {"data": {"cache_latents": False}},
                {"data": {"workers": 1}},
                {"training": {"schedule": "constant", "ema_decay": 0.0}},
                {"trainer": {"precision": "bf16-mixed"}},
                {"data": {"validation_episodes": 0}},
                {"training": {"compile": True}},
            )
        ),
    ],
    ids=["accumulated", "video", "worker", "constant", "bfloat16", "unvalidated", "compiled"],
)
def test_resuming_is_exact_for_other_recipes(changed, data, tmp_path, monkeypatch):
    whole = RunFolder(fit(killable(data, **changed), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 11)
    run = killed_run(data, tmp_path / "run", monkeypatch, **changed)
    fit(killable(data, **changed), "", resume=run.path)
    assert_same(whole, run)


def test_a_finished_run_goes_on_with_more_steps(data, tmp_path):
    constant = {"training": {"schedule": "constant"}}
    whole = RunFolder(fit(tiny_recipe(data, **constant), tmp_path / "whole"))
    shorter = tiny_recipe(data, trainer={"max_steps": 7}, **constant)
    run = RunFolder(fit(shorter, tmp_path / "run"))
    with pytest.raises(TrainingError, match=r"is finished after 7 steps.*raise trainer.max_steps"):
        fit(shorter, "", resume=run.path)
    fit(tiny_recipe(data, **constant), "", resume=run.path)
    assert_same(whole, run)


def test_a_longer_schedule_is_followed_at_once_and_reported(data, tmp_path):
    """The rates of all later steps are those of a run that had this length from the start."""
    growing = {"training": {"growing_horizon": 0.5}}
    whole = RunFolder(fit(tiny_recipe(data, **growing), tmp_path / "whole"))
    run = fit(tiny_recipe(data, trainer={"max_steps": 7}, **growing), tmp_path / "run")
    said = (
        r"trainer.max_steps was 7, is 16: the learning rate goes from 0 to 0.00562 at step 7, as "
        r"training.schedule=linear .*; clips are shorter again until step 8"
    )
    with pytest.warns(AcwmWarning, match=said):
        fit(tiny_recipe(data, **growing), "", resume=run)
    rates = [
        numbers(each)[f"{s}", "train/learning_rate"]
        for each in (RunFolder(run), whole)
        for s in range(7, 16)
    ]
    assert rates[:9] == rates[9:]


@pytest.mark.parametrize(
    "flags", [{"limit_train_batches": 0}, {"max_steps": 9, "max_time": "00:00:00:00"}]
)
def test_a_run_of_no_step_is_no_success(flags, data, tmp_path):
    with pytest.raises(TrainingError, match="nothing was trained, as the flags allowed 0 steps"):
        fit(tiny_recipe(data, trainer=flags), tmp_path / "run")
    assert not (tmp_path / "run" / "recipe.yaml").exists()


def test_max_time_ends_a_run_that_goes_on_exactly(data, tmp_path):
    constant = {"training": {"schedule": "constant"}}
    limit = {"max_steps": -1, "max_time": "00:00:00:01"}
    run = RunFolder(fit(tiny_recipe(data, trainer=limit, **constant), tmp_path / "run"))
    done = read_metadata(run.weights)["step"]
    assert done > 0
    assert max(int(step) for step, _ in numbers(run)) == done - 1
    longer = tiny_recipe(data, trainer={"max_steps": done + 6}, **constant)
    fit(longer, "", resume=run.path)
    whole = RunFolder(fit(longer, tmp_path / "whole"))
    at_the_limit = {(str(done - 1), name) for name in ("step", "val/loss", *OF_ROLLOUTS)}
    ours = {key: value for key, value in numbers(run).items() if key not in at_the_limit}
    assert ours.items() <= numbers(whole).items()
    assert numbers(whole).keys() - ours.keys() <= at_the_limit
    assert all(torch.equal(weights(run)[n], weights(whole)[n]) for n in weights(whole))


def test_a_nan_stops_the_run_and_keeps_the_last_good_checkpoint(data, tmp_path):
    poison = {"class_path": "tests.training.callbacks.Poison", "init_args": {"batch": 7}}
    run = RunFolder(tmp_path / "run")
    with pytest.raises(TrainingError, match=r"in step 7 \(.*last\.ckpt is the last good"):
        fit(tiny_recipe(data, trainer={"callbacks": [poison]}), run.path)
    kept = torch.load(run.last_checkpoint, weights_only=True)
    assert kept["global_step"] == 6
    assert all(value.isfinite().all() for value in kept["state_dict"].values())
    assert load_run(run.path).world_model is not None
    assert "nan" not in run.metrics.read_text()


def test_sample_videos_show_the_truth_beside_the_average(data, tmp_path):
    every = {"sample_every_n_steps": 8, "sample_videos": 2}
    run = RunFolder(fit(tiny_recipe(data, training=every), tmp_path / "run"))
    gifs = sorted(run.samples.iterdir())
    assert [gif.name for gif in gifs] == ["step-0000008.gif", "step-0000016.gif"]
    with Image.open(gifs[-1]) as image:
        assert image.size == (2 * 16, 2 * 16)
        frames = [np.asarray(f.convert("RGB"), float) / 255 for f in ImageSequence.Iterator(image)]
    world_model = load_run(run.path).world_model
    clip = ClipDataset(EpisodeDataset(data, "train"), frames=9, stride=2, indices=[6])[0]
    truth = clip["video"].float() / 255
    predicted = world_model.rollout(truth[None, 0], clip["actions"][None])[0]
    for shown, wanted in ((frames[0][:16, :16], truth[0]), (frames[-1][:16, 16:], predicted[-1])):
        np.testing.assert_allclose(shown, wanted.permute(1, 2, 0).numpy(), atol=0.03)
    events = event_accumulator.EventAccumulator(
        str(run.path / "tensorboard"), size_guidance={event_accumulator.IMAGES: 0}
    ).Reload()
    logged = events.Images("samples: truth | prediction")
    assert [(image.step, image.encoded_image_string) for image in logged] == [
        (8, gifs[0].read_bytes()),
        (16, gifs[1].read_bytes()),
    ]


def test_a_taken_folder_and_another_recipe_are_refused(whole, data):
    before = whole.weights.read_bytes()
    with pytest.raises(
        TrainingError, match=r"holds a run already: continue it with `acwm fit resume="
    ):
        fit(killable(data), whole.path)
    changed = killable(data, model={"width": 6}, training={"seed": 1})
    with pytest.raises(
        TrainingError, match=r"model\.width was 8, is 6; training\.seed was 0, is 1"
    ):
        fit(changed, "", resume=whole.path)
    assert whole.weights.read_bytes() == before


def test_data_of_another_environment_is_refused(data, tmp_path):
    with pytest.raises(TrainingError, match=r"holds episodes of tiny_world.*set env=tiny_world"):
        fit(tiny_recipe(data, env={"name": "push_cube"}), tmp_path / "run")
    with pytest.raises(TrainingError, match=r"frames of 16×16: leave out env\.size"):
        fit(tiny_recipe(data, env={"size": 32}), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_card_may_say_more_of_the_scene_when_a_run_resumes_and_not_otherwise(
    whole, data, tmp_path
):
    run, recipe = RunFolder(tmp_path / "run"), Recipe.from_yaml(whole.recipe)
    shutil.copytree(whole.path, run.path)
    card = DatasetCard.read(data)
    (position,) = card.environment.state
    declared, otherwise = (
        replace(card, environment=replace(card.environment, state=(replace(position, kind=kind),)))
        for kind in ("position", "vector")
    )
    assert checkpoint_to_resume(run, recipe, declared, run.path) == run.last_checkpoint
    declared.write(run.path)
    assert checkpoint_to_resume(run, recipe, card, run.path) == run.last_checkpoint
    with pytest.raises(TrainingError, match="otherwise of its state position"):
        checkpoint_to_resume(run, recipe, otherwise, run.path)


def test_there_must_be_something_to_resume(data, tmp_path, monkeypatch):
    with pytest.raises(TrainingError, match=r"nothing to resume.*holds no run"):
        fit(killable(data), "", resume=tmp_path / "nowhere")
    monkeypatch.setattr(Kill, "batch", 1)
    run = killed_run(data, tmp_path / "run", monkeypatch)
    with pytest.raises(TrainingError, match="no trained weights yet"):
        load_run(run.path)
    fit(killable(data), "", resume=run.path)  # it starts, as nothing was saved
    shutil.rmtree(run.checkpoints)
    with pytest.raises(TrainingError, match="holds weights but no checkpoint to resume from"):
        fit(killable(data), "", resume=run.path)


def test_what_fails_before_its_first_step_does_not_take_the_folder(data, tmp_path, monkeypatch):
    monkeypatch.setattr(Kill, "batch", 0)
    run = killed_run(data, tmp_path / "run", monkeypatch)
    assert not run.recipe.exists()
    fit(killable(data, training={"seed": 1}), run.path)
    assert run.weights.exists()
