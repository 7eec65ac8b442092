"""The public names of `acwm`: who changes one changes it here, too, and tells in CHANGELOG.md."""

import inspect
import subprocess
import sys
import typing

import pytest

import acwm

SIGNATURES = {
    "ClipDataset": "(episodes, *, frames=37, stride=4, indices=None, temporal_stride=None, "
    "given=1, per_length=1, symmetries=(), states=(), weights=None)",
    "EpisodeDataset": "(path, split, *, growing=False)",
    "Recipe": "(env, codec, model, conditioner, objective, training, data, evaluation, trainer)",
    "WorldModel": "(codec, model, conditioner, objective, action_low, action_high, *, "
    "clip_frames=37, context_frames=1, state_shapes=None)",
    "build_world_model": "(recipe, card)",
    "compose": "(recipe, overrides=(), *, sections=None, trusted=None)",
    "evaluate": "(run, *, data=None, overrides=(), out=None, overwrite=False, progress=True)",
    "fit": "(recipe, run_dir, *, resume=None)",
    "generate": "(environment, out, *, episodes, seed=0, size=None, factors=None, exploration=0.0, "
    "shift=0.0, workers=None, executor=None, shard_episodes=32, progress=True)",
    "load": "(path)",
    "make_env": "(name, *, task=None, **params)",
    "make_planner": "(name, **params)",
    "make_task": "(environment, name)",
    "register": "()",
    "save": "(path, recipe, card, world_model, *, step=0)",
}

OF_A_WORLD_MODEL = {
    "encode": "(self, video)",
    "loss": "(self, latents, actions, generators=(), states=None, weights=None)",
    "rollout": "(self, given, actions, *, mode=None, steps=None, window=None, seeds=None, "
    "check=True)",
    "stream": "(self, given, actions=None, *, steps=None, context=None, seeds=None)",
}


def written(function):
    signature = inspect.signature(function)
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    return str(inspect.Signature(bare))


def test_the_public_names_are_these():
    assert set(acwm.__all__) == {*SIGNATURES, "AcwmError", "__version__"}
    assert set(acwm.__all__) <= set(dir(acwm))
    assert issubclass(acwm.AcwmError, Exception)


@pytest.mark.parametrize("name", SIGNATURES)
def test_signatures_are_pinned_and_documented(name):
    found = getattr(acwm, name)
    assert written(found) == SIGNATURES[name]
    assert inspect.getdoc(found)


@pytest.mark.parametrize("name", OF_A_WORLD_MODEL)
def test_methods_of_a_world_model_are_pinned(name):
    assert written(getattr(acwm.WorldModel, name)) == OF_A_WORLD_MODEL[name]


def test_what_type_checkers_read_is_what_is_imported():
    """The imports under `TYPE_CHECKING` and the table of lazy names must not drift apart."""
    code = inspect.getsource(acwm)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typing, "TYPE_CHECKING", True)
        read: dict[str, object] = {"__name__": "acwm_as_type_checkers_read_it"}
        exec(compile(code, "acwm.py", "exec"), read)
    for name in acwm._HOMES:
        assert read[name] is getattr(acwm, name), name


def test_a_misspelt_name_is_an_attribute_error_that_knows_the_near_one():
    code = "import acwm; acwm.build_wold_model"
    failed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "Did you mean: 'build_world_model'?" in failed.stderr
