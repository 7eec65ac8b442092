import asyncio

import pytest

from acwm_play import simulator
from acwm_play.pool import WorldPool
from acwm_play.worlds import playable
from tests.browsing import DESK
from tests.play import follower, scenes
from tests.play.pages import Served, until


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run of push_cube whose model follows actions; tests must not change it."""
    pytest.importorskip("mujoco", reason="needs the extra rigid")
    return follower.make_run(tmp_path_factory.mktemp("play") / "follower")


@pytest.fixture(scope="module")
def pool(run):
    """What servers share: a simulator is started once."""
    made = WorldPool(playable([run]))
    yield made
    asyncio.run(made.close())


@pytest.fixture(autouse=True)
def known_scenes(monkeypatch):
    """No test depends on the scene that is drawn."""
    monkeypatch.setattr(simulator, "secrets", scenes.known())


@pytest.fixture(scope="module")
def served(run, tmp_path_factory):
    made = Served(run, tmp_path_factory.mktemp("served"))
    made.start()
    yield made
    made.kill()


@pytest.fixture
def page(browser, served):
    """A page that plays; it must not complain in the end."""
    opened = browser.new_page(viewport=DESK)
    opened.complaints = []
    opened.on("pageerror", lambda error: opened.complaints.append(str(error)))
    opened.on(
        "console",
        lambda said: opened.complaints.append(said.text) if said.type == "error" else None,
    )
    opened.goto(served.url)
    until(opened, "Number(document.body.dataset.alone) > 0")
    yield opened
    assert opened.complaints == []
    opened.close()
