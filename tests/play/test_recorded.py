"""A model of recorded data: the person drives it alone, beside the recorded video."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import RecipeError
from acwm_core.recipe import Recipe
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.inverse.latent_label import label_latent
from acwm_play.pool import WorldPool
from acwm_play.worlds import playable
from tests.browsing import DESK
from tests.play import follower
from tests.play.pages import Served, until
from tests.play.test_server import played, white
from tests.tiny import save_run

FRAMES = 40


def recording(seed):
    rng = np.random.default_rng(seed)
    video = rng.integers(0, 200, (FRAMES, 64, 64, 3), dtype=np.uint8)
    return Recording(video, rng.uniform(-0.5, 0.5, (FRAMES - 1, 2)))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose model draws a disc where actions point, of data that nothing simulates."""
    folder = tmp_path_factory.mktemp("recorded")
    action = ActionSpec(("x", "y"), ("", ""), (-1, -1), (1, 1), "absolute")
    splits = {"train": [recording(0)], "ind_test": [recording(1), recording(2)]}
    write_dataset(folder / "data", splits, name="mine", action=action, fps=10, progress=False)
    card = DatasetCard.read(folder / "data")
    shown = replace(card.environment, views=("cameras.top", "cameras.wrist"))
    replace(card, environment=shown).write(folder / "data")
    return follower_of(folder / "data", folder / "run")


def follower_of(data, folder):
    """A run on some data of the model that draws a disc where actions point."""
    follower.register()
    recipe = Recipe.from_dict(
        {
            "codec": {"name": "identity"},
            "model": {"name": "follower"},
            "conditioner": {"name": "raw"},
            "objective": {"name": "regression"},
            "data": {"path": str(data), "clip_frames": 9},
        }
    )
    return save_run(folder, recipe, DatasetCard.read(data))


@pytest.fixture(scope="module")
def pool(run):
    made = WorldPool(playable([run]))
    yield made
    asyncio.run(made.close())


@pytest.mark.ci
def test_the_keys_of_any_actions_send_latent_ones(tmp_path):
    """Of a model of data whose actions were learnt: a key is a level of one of them."""
    action = ActionSpec(("x", "y"), ("", ""), (-1, -1), (1, 1), "absolute")
    splits = {"train": [recording(0), recording(1)]}
    write_dataset(tmp_path / "data", splits, name="mine", action=action, fps=10, progress=False)
    label_latent(tmp_path / "data", tmp_path / "latent", 2, steps=1, progress=False)
    pool = WorldPool(playable([follower_of(tmp_path / "latent", tmp_path / "run")]))

    async def story(page, client):
        await page.say("open", index=0)
        await page.next()
        first, second = page.seen["world"]["controls"]
        assert (first["name"], first["keys"]) == ("latent_0", ["ArrowLeft", "ArrowRight"])
        assert (second["low"], second["high"], second["holds"]) == (-2, 2, False)
        await page.say("act", values=[1.0, 0.0])  # half of the way to the bound
        await page.until(
            lambda found: abs(white(found[2][-1])[0] / 64 - (0.5 + 0.5 * 0.388)) < 0.03
        )

    try:
        played(pool, tmp_path / "takes", story)
    finally:
        asyncio.run(pool.close())


def test_the_person_drives_the_model_and_the_recording_goes_on(pool, tmp_path):
    truth = recording(2).video

    async def story(page, client):
        await page.say("open", index=1)
        head, true, seen = await page.next()
        assert page.seen["world"]["recorded"]
        assert page.seen["world"]["index"] == 1
        np.testing.assert_array_equal(true[0], truth[0])
        np.testing.assert_allclose(true.astype(int), seen, atol=1)
        await page.say("act", values=[0.5, 0.0])
        head, true, seen = await page.until(
            lambda found: abs(white(found[2][-1])[0] / 64 - (0.5 + 0.5 * 0.388)) < 0.03
        )
        shown = round(10 * head["alone"])
        np.testing.assert_array_equal(true, truth[shown - 3 : shown + 1])
        assert head["pixel_error"] is None  # the video is not of these actions
        await page.say("drive", by="policy")  # the model starts over, and both are compared
        head, true, seen = await page.until(lambda found: found[0]["pixel_error"] is not None)
        assert head["alone"] == 0
        np.testing.assert_allclose(true.astype(int), seen, atol=1)
        await page.say("record", on=True)
        assert "Not saved: the model has a recording" in (await page.told("notice"))["text"]

    played(pool, tmp_path, story)
    assert not list(tmp_path.iterdir())


def test_the_recorded_actions_can_drive_until_the_recording_ends(pool, tmp_path):
    actions = recording(1).actions

    async def story(page, client):
        await page.say("drive", by="policy")
        await page.say("open", index=0)
        await page.next()
        head, _, seen = await page.until(lambda found: found[0]["alone"] > 1)
        assert head["pixel_error"] > 0
        x = actions[round(10 * head["alone"]) - 1][0]  # the action that led to the last frame
        assert abs(white(seen[-1])[0] / 64 - (0.5 + 0.388 * x)) < 0.03
        assert "has ended" in (await page.told("notice"))["text"]
        await page.say("open", index=1)
        assert (await page.until(lambda found: found[0]["alone"] == 0))[0]["n"] == 1

    played(pool, tmp_path, story)


def test_the_page_names_the_views_and_says_what_is_not_compared(run, browser, tmp_path):
    served = Served(run, tmp_path)
    served.start()
    try:
        page = browser.new_page(viewport=DESK)
        page.goto(served.url)
        until(page, "document.body.classList.contains('uncompared')")  # the person drives
        names = page.locator(".sim .views span")
        assert names.all_inner_texts() == ["top", "wrist"]
        box, wrist = page.locator("#sim").bounding_box(), names.nth(1).bounding_box()
        assert wrist["x"] == pytest.approx(box["x"] + box["width"] / 2, abs=1)
        assert "does not follow" in page.locator(".sim .veil").inner_text()
        assert not page.locator("#record").is_visible()
        assert not page.locator("#factors-title").is_visible()
        page.keyboard.press("p")
        page.keyboard.press("b")  # from its start, as it may have ended
        until(page, "!document.body.classList.contains('uncompared')")
        assert not page.locator(".sim .veil").is_visible()
        page.close()
    finally:
        served.kill()


def test_one_line_says_what_is_left_out(run, monkeypatch):
    monkeypatch.setattr("acwm_play.serve.serve", lambda worlds, **_: None)
    done = CliRunner().invoke(main, ["play", str(run)])
    assert done.exit_code == 0, done.output
    (line,) = done.output.splitlines()
    assert "not available for recorded data (mine): the simulator" in line


def test_without_simulator_and_data_nothing_is_played(run, tmp_path):
    (gone := tmp_path / "run").mkdir()
    for each in ("recipe.yaml", "card.yaml", "model.safetensors"):
        (gone / each).write_bytes((run / each).read_bytes())
    recipe = gone / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace(str(run.parent / "data"), "nowhere"))
    with pytest.raises(RecipeError, match="no dataset in nowhere"):
        playable([gone])
