"""Checkpoints that are damaged, of another kind or made to do harm, and words that don't fit."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from acwm_core.errors import DataError, PluginError, RecipeError
from acwm_core.plugins import catalog
from acwm_zoo.importing import import_checkpoint
from tests.dit.latest import WORDS, content, writer
from tests.plugins import Attack, plugin_of


@pytest.fixture
def latest(tmp_path):
    """Write a checkpoint and return its path."""
    return writer(tmp_path)


@pytest.mark.parametrize("zipped", [True, False])
def test_pickled_code_is_not_run(zipped, latest, tmp_path):
    mark = tmp_path / "mark"
    path = latest({**content(), "config": Attack(mark)}, _use_new_zipfile_serialization=zipped)
    with pytest.raises(DataError, match="nothing in it was run"):
        import_checkpoint(path, tmp_path / "run", WORDS)
    assert not mark.exists()
    assert not (tmp_path / "run").exists()
    torch.load(path, weights_only=False)  # the attack is real
    assert mark.exists()


def test_numbers_of_numpy_and_old_files_are_read(latest, tmp_path):
    values = {**content(), "best_loss": np.float64(0.1), "history": np.zeros(3)}
    path = latest(values, _use_new_zipfile_serialization=False)
    made = import_checkpoint(path, tmp_path / "run", WORDS)
    assert "best_loss, history" in made.notes[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_proj__weight": None}, "lacks x_proj.weight"),
        ({"x_proj__weight": torch.zeros(64, 16)}, "x_proj.weight has shape"),
        ({"blocks__1__t_block__ffwd__0__bias": None}, r"lacks blocks\.1\.t_block\.ffwd\.0\.bias"),
        ({"blocks__1__t_block__ffwd__0__bias": torch.zeros(3)}, r"ffwd\.0\.bias has shape \(3,\)"),
        ({"blocks__9__s_block__ffwd__0__bias": torch.zeros(3)}, r"lacks blocks\.2"),
        ({"final_layer__linear__bias": torch.full((64,), float("nan"))}, "bias are not finite"),
        ({"head__weight": torch.zeros(3)}, "holds head.weight"),
        ({"final_layer__linear__bias": 3}, "final_layer.linear.bias'"),
    ],
)
def test_a_wrong_tensor_is_named(changes, message, latest, tmp_path):
    with pytest.raises(DataError, match=message):
        import_checkpoint(latest(content(**changes)), tmp_path / "run", WORDS)
    assert not (tmp_path / "run").exists()


def test_an_entry_beside_the_network_is_named(latest, tmp_path):
    values = content()
    values["model_state_dict"]["discriminator.weight"] = torch.zeros(2)
    with pytest.raises(DataError, match=r"'discriminator\.weight'"):
        import_checkpoint(latest(values), tmp_path / "run", WORDS)


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (("env=push_cube",), DataError, "heads: add the override model.heads="),
        (("model.heads=4",), DataError, "data.path=FOLDER or one of .*env=push_cube"),
        (("model.heads=4", "env=stack_cube"), DataError, "size 2, and those of stack_cube have 7"),
        (("model.heads=5", "env=push_cube"), RecipeError, "5 heads"),
        ((*WORDS, "conditioner=cross_attention"), DataError, "convolutional"),
        ((*WORDS, "model.layers=3"), DataError, r"lacks blocks\.2"),
        ((*WORDS, "model.depth=3"), RecipeError, "no parameter 'depth'"),
        (("model.heads=4", "data.path=nowhere"), DataError, "no dataset in nowhere"),
    ],
)
def test_wrong_words_are_refused(words, error, message, latest, tmp_path):
    with pytest.raises(error, match=message):
        import_checkpoint(latest(content()), tmp_path / "run", words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"state_dict": {}, "epoch": 3},
            "not a checkpoint that published_dit knows; it holds state",
        ),
        ([1, 2], "holds a list"),
        ({}, "holds nothing"),
    ],
)
def test_other_files_are_refused(values, message, latest, tmp_path):
    with pytest.raises(DataError, match=message):
        import_checkpoint(latest(values), tmp_path / "run", WORDS)


def test_damaged_and_missing_files_are_refused(latest, tmp_path):
    path = latest(content())
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DataError, match="damaged"):
        import_checkpoint(path, tmp_path / "run", WORDS)
    with pytest.raises(DataError, match="is missing"):
        import_checkpoint(tmp_path / "nothing.pt", tmp_path / "run", WORDS)
    save_file({"weight": torch.zeros(2)}, tmp_path / "other.safetensors")
    with pytest.raises(DataError, match="it holds weight"):
        import_checkpoint(tmp_path / "other.safetensors", tmp_path / "run", WORDS)


Broken = plugin_of(
    environments={"no_environment": "builtins:dict", "nowhere": "no_such_package.world:World"}
)


def test_broken_environments_hide_none_that_fit(fresh_catalog, latest, tmp_path):
    catalog().add_plugin(Broken, "broken")
    with pytest.raises(DataError, match=r"one of .*env=push_cube"):
        import_checkpoint(latest(content()), tmp_path / "run", ("model.heads=4",))


def test_an_environment_without_a_card_is_named(fresh_catalog, latest, tmp_path):
    catalog().add_plugin(Broken, "broken")
    with pytest.raises(PluginError, match="environment 'no_environment' has no EnvironmentCard"):
        import_checkpoint(
            latest(content()), tmp_path / "run", ("model.heads=4", "env=no_environment")
        )
    assert not (tmp_path / "run").exists()
