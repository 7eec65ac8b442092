"""What shells complete, as click's own completion classes for them see it."""

import pytest
from click.shell_completion import BashComplete, FishComplete, ZshComplete

from acwm_core.cli import main
from acwm_core.recipe import compose

SHELLS = [BashComplete, ZshComplete, FishComplete]


def found(words, incomplete="", shell=ZshComplete):
    complete = shell(main, {}, "acwm", "_ACWM_COMPLETE")
    return [item.value for item in complete.get_completions(words.split(), incomplete)]


@pytest.mark.parametrize("shell", SHELLS)
def test_commands_are_completed(shell):
    assert found("", "ex", shell) == ["experiment"]
    assert "data" in found("", "", shell)
    assert found("data", "imp", shell) == ["import"]


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_of_each_shell_can_be_had(shell):
    script = shell(main, {}, "acwm", "_ACWM_COMPLETE").source()
    assert "_ACWM_COMPLETE" in script


def test_names_of_components():
    tasks = ["push_cube_two_pushers.place", "push_cube_two_pushers.place_and_turn"]
    assert found("check", "push_cube_t") == ["push_cube_two_pushers", *tasks]
    assert found("check", "cross") == ["cross_attention"]
    assert "icem" in found("check")
    assert found("generate", "rea") == ["reacher"]
    assert found("list", "cod") == ["codec"]


def test_recipes_and_experiments():
    assert found("fit", "push_cube_s")[:-1] == ["push_cube_small"]
    assert found("experiment", "ablations/conditioning_")[:-1] == ["ablations/conditioning_small"]


def test_keys_come_with_their_values():
    rate = compose("push_cube_small").training["learning_rate"]
    assert found("fit push_cube_small", "training.learning") == [f"training.learning_rate={rate}"]
    assert found("fit push_cube_small", "model.wi") == ["model.width=128"]
    assert "model=dit_l" in found("show push_cube_small", "model=")
    assert "codec=compact" in found("show push_cube_small", "cod")
    assert found("fit push_cube_small", "+sm") == ["+small"]


@pytest.mark.parametrize(
    ("words", "incomplete", "wanted"),
    [
        ("fit push_cube_small", "conditioner=c", ["conditioner=cross_attention"]),
        ("fit push_cube_small conditioner =", "c", ["cross_attention"]),  # as bash splits it
        (
            "fit push_cube_small objective =",
            "",
            [
                "diffusion_forcing",
                "full_sequence",
                "next_frame",
                "regression",
                "scene",
                "shortcut",
            ],
        ),
        ("fit push_cube_small data.clip_starts", "", ["anywhere", "episode"]),
        ("fit push_cube_small", "training.compile=t", ["training.compile=true"]),
        ("fit push_cube_small", "training.nonsuch=", []),
        ("fit nonsuch", "model.", []),
    ],
)
def test_values_are_those_that_the_type_lists(words, incomplete, wanted):
    assert found(words, incomplete) == wanted
