import pytest

from acwm_core.errors import RecipeError
from acwm_core.recipe.check import check_names, check_section
from acwm_core.training.config import TrainingConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("weight_decay", -1.0),
        ("betas", (0.9, 1.0)),
        ("betas", (0.9,)),
        ("warmup_steps", -1),
        ("schedule", "exponential"),
        ("decay_start", 1.0),
        ("ema_decay", 1.0),
        ("seed", -1),
        ("cpu_threads", 0),
        ("validate_every_n_steps", 0),
        ("checkpoint_every_n_steps", 0),
        ("sample_every_n_steps", -1),
        ("sample_videos", 0),
        ("validation_rollouts", -1),
    ],
)
def test_impossible_values_are_refused_by_name(name, value):
    with pytest.raises(RecipeError, match=rf"training\.{name}="):
        check_section("training", {name: value})


def test_lists_from_yaml_become_tuples():
    assert TrainingConfig(betas=[0.8, 0.9]).betas == (0.8, 0.9)


def test_muon_is_refused_with_shards_before_anything_is_imported():
    recipe = {"training": {"optimizer": "muon"}, "trainer": {"strategy": "fsdp"}}
    names = {"codec": "identity", "model": "recurrent", "conditioner": "adaln"}
    parts = {part: {"name": name} for part, name in (*names.items(), ("objective", "regression"))}
    with pytest.raises(RecipeError, match="muon needs whole matrices"):
        check_names({**parts, "data": {"path": "x"}, **recipe})
