"""A driver acts towards the goal of a task: beside a real simulator, without a browser."""

import asyncio
import base64
from types import SimpleNamespace

import numpy as np
import pytest

from acwm_core.plugins import catalog
from acwm_play.action_source import PERSON, POLICY, ActionSource
from acwm_play.messages import Point
from acwm_play.worlds import tasks_of
from tests.play import drivers
from tests.play.test_server import dark, played


@pytest.fixture(autouse=True)
def known_drivers(monkeypatch):
    drivers.register()
    drivers.plan_briefly(monkeypatch)
    drivers.Stuck.begun.clear()
    drivers.Stuck.stopped.clear()


@pytest.mark.ci
def test_a_driver_gets_the_goal_of_the_scene_and_solves_it(pool, tmp_path):
    task = catalog().component("environment", "push_cube").load_task("place")
    goal, actions, distances = drivers.solved("push_cube", task, 3)

    async def story(page, client):
        await page.say("drive", by="replay")
        await page.say("open", index=3)
        told = await page.told("goal")
        assert (told["task"], told["solved"], told["failed"]) == ("place", False, False)
        assert told["distance"] == distances[0]
        picture = np.frombuffer(base64.b64decode(told["pixels"]), np.uint8)
        np.testing.assert_array_equal(picture.reshape(*told["size"], 3), goal.frame)
        found, head = [], {"n": 0}
        while not (head.get("progress") and head["progress"]["solved"]):
            head, *_ = await page.next()
            if head["n"] == 4:
                found.append(head["progress"]["distance"])
        assert found[:-1] == distances[4 : 4 * len(found) : 4]
        last = await page.told("attempt", lambda said: said["phase"] == "solved")
        assert last["decisions"] == -(-len(actions) // 5)
        assert last["took"] >= 0
        await page.silence()  # it holds still until the page asks
        await page.say("drive", by="you")
        assert (await page.next())[0]["progress"]["solved"]  # the goal stays
        await page.say("open", index=4)
        head, *_ = await page.until(lambda found: found[0]["n"] == 4)
        assert head["progress"] is None

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_it_stops_at_once_when_the_person_takes_over_or_asks_for_a_scene(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=5)
        await page.say("drive", by="stuck", task="place_and_turn")
        said = await page.told("attempt", lambda said: said["phase"] == "planning")
        assert (said["task"], said["decisions"]) == ("place_and_turn", 0)
        await page.silence()  # the simulator holds still
        await page.say("take_over")  # the page is heard meanwhile
        await page.until(lambda found: found[0]["alone"] == 0)
        assert not drivers.Stuck.stopped.is_set()
        await page.say("drive", by="you")
        await page.say("point", places=[[0.3, 0.3]])
        await page.until(lambda found: np.abs(dark(found[1][-1]) / 64 - 0.3).max() < 0.06)
        assert page.seen["attempt"]["phase"] is None
        assert await asyncio.to_thread(drivers.Stuck.stopped.wait, 60)
        drivers.Stuck.begun.clear()
        drivers.Stuck.stopped.clear()
        await page.say("drive", by="stuck")
        assert await asyncio.to_thread(drivers.Stuck.begun.wait, 60)
        page.seen.clear()
        await page.say("open", index=8)
        assert (await page.told("world"))["index"] == 8
        assert await asyncio.to_thread(drivers.Stuck.stopped.wait, 60)
        assert (await page.told("goal"))["task"] == "place_and_turn"  # it drives on in the new one
        assert page.seen["state"]["driver"] == "stuck"

    played(pool, tmp_path, story)
    assert drivers.Stuck.stopped.is_set()  # also when the page has gone


def test_when_one_fails_the_person_drives(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=5)
        await page.say("drive", by="throws")
        said = await page.told("notice")
        assert said["wrong"]
        assert "driver 'throws'" in said["text"]
        assert "no idea" in said["text"]
        await page.told("state", lambda state: state["driver"] == "you")
        await page.until(lambda found: found[0]["alone"] > 1)

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_a_pause_lets_it_think_and_a_step_takes_its_actions(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=3)
        await page.say("pause", on=True)
        await page.say("drive", by="replay", task="place")
        await page.told("attempt", lambda said: said["phase"] == "acting")
        await page.silence()
        await page.say("step")
        head, *_ = await page.next()
        assert head["n"] == 4
        assert head["places"] is not None
        await page.silence()

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_the_planner_plans_with_the_model_that_is_played(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=3)
        world = await page.told("world")
        assert [each["name"] for each in world["drivers"]] == [
            "planner",
            "replay",
            "stuck",
            "throws",
            "trained_policy",
        ]
        assert [each["name"] for each in world["tasks"]] == ["place", "place_and_turn"]
        assert (world["tasks"][0]["unit"], world["tasks"][0]["tolerance"]) == ("m", 0.015)
        await page.say("drive", by="planner")
        places = [(await page.next())[0]["places"] for _ in range(3)]
        said = await page.told("attempt", lambda said: said["phase"] == "acting")
        assert said["took"] > 0
        head, *_ = await page.until(lambda found: found[0]["places"] not in (None, *places))
        assert head["progress"]["distance"] > 0

    played(pool, tmp_path, story)


def test_nobody_unknown_drives_and_none_in_a_world_without_tasks():
    assert tasks_of("cloth_move_8d") == {}
    told = []
    source = ActionSource(lambda kind, **values: told.append(kind))
    live = SimpleNamespace(tasks={})
    source.hand_to("nobody")
    assert source.driver == PERSON
    source.hand_to(POLICY)
    source.begin(live)
    assert source.driver == POLICY
    source.hand_to("stuck", "place")
    source.begin(live)
    assert source.driver == PERSON
    assert asyncio.run(source.ready(live, asyncio.Event()))
    assert told == []


def test_places_that_a_world_does_not_have_are_passed_over():
    acted = []

    async def act(action):
        acted.append(action)

    async def still():
        return np.zeros(2)

    simulator = SimpleNamespace(
        pointing=SimpleNamespace(action=np.ravel),
        card=SimpleNamespace(action=SimpleNamespace(size=2)),
        still=still,
    )
    source = ActionSource(lambda kind, **values: None)
    for places in ([[0.25, 0.5]], [[0.25, 0.5], [0.75, 1.0]]):
        source.hold(Point(places))
        asyncio.run(source.act(SimpleNamespace(simulator=simulator, act=act)))
    assert [each.tolist() for each in acted] == [[0.25, 0.5], [0, 0]]
