"""The landscape of a moment: of a model that knows its world, it is the simulator's."""

import numpy as np
import pytest
from PIL import Image

from acwm_core.cli import main
from acwm_core.training.run import load_run
from acwm_planning.landscape import landscape
from acwm_planning.run import EpisodePlayer
from acwm_planning.settings import settings_of
from tests import tiny

WORDS = ["cost=state", "planner.horizon=1", "cost.frames=1"]


@pytest.fixture(scope="module")
def found(parts, tmp_path_factory):
    """Of models that know their world and that ignore actions."""
    made = {}
    for model in ("exact", "blind"):
        run = tiny.make_exact_run(tmp_path_factory.mktemp(model) / "run", model)
        player = EpisodePlayer(load_run(run), "place", settings_of(WORDS))
        made[model] = run, landscape(player, 2)
        player.close()
    return made


def test_an_exact_model_sees_what_is_so_and_a_blind_one_nothing(found):
    exact, blind = found["exact"][1], found["blind"][1]
    np.testing.assert_allclose(exact.costs["model"], exact.costs["simulator"], atol=1.0)
    assert np.ptp(exact.costs["simulator"]) > 3  # tolerances
    assert np.ptp(blind.costs["model"]) == 0
    np.testing.assert_array_equal(blind.costs["simulator"], exact.costs["simulator"])


def test_the_solution_is_among_the_cheapest_where_the_model_is_exact(found):
    exact = found["exact"][1]
    assert exact.ranks["simulator"] < 0.1
    assert exact.ranks["model"] < 0.2
    nearest = [abs(exact.values[k] - exact.true[k]).argmin() for k in range(2)]
    least = exact.costs["simulator"].min()  # perhaps against a wall, which is as near
    assert exact.costs["simulator"][*nearest] == pytest.approx(least, abs=0.5)


def test_the_command_draws_it(found, tmp_path, capsys):
    run = found["exact"][0]
    words = ["plan", run, "place", *WORDS, "--landscape", "--out", tmp_path / "out"]
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    assert ended.value.code == 0
    assert "in the simulator" in capsys.readouterr().out
    with Image.open(tmp_path / "out/landscape-0000.png") as picture:
        assert picture.width > 800
    with pytest.raises(SystemExit) as ended:
        main([*map(str, [*words[:2], "shy", *words[3:]])])
    assert ended.value.code == 2
    assert "no scripted solution" in capsys.readouterr().err
