"""The server and its sessions with a real simulator, without a browser."""

import asyncio
import contextlib
import json
import struct

import numpy as np
import pytest
from aiohttp import WSMsgType, WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer

from acwm_core.data.dataset import EpisodeDataset
from acwm_formats.check import check_dataset
from acwm_play import serve

TOKEN = "t" * 43


class Page:
    """What a page does, by hand."""

    def __init__(self, socket):
        self.socket = socket
        self.seen = {}

    async def say(self, kind, **values):
        await self.socket.send_str(json.dumps({"type": kind, **values}))

    async def hear(self):
        """The next message: frames, or None for text."""
        message = await asyncio.wait_for(self.socket.receive(), 300)
        if message.type is WSMsgType.TEXT:
            said = json.loads(message.data)
            self.seen[said["type"]] = said
            return None
        assert message.type is WSMsgType.BINARY, message
        (length,) = struct.unpack_from("<I", message.data)
        head = json.loads(message.data[4 : 4 + length])
        pixels = np.frombuffer(message.data[4 + length :], np.uint8)
        return head, *pixels.reshape(2, head["n"], *head["size"], 3)

    async def next(self):
        """The next frames: header, and the two videos `[n, H, W, 3]`."""
        while (found := await self.hear()) is None:
            pass
        return found

    async def until(self, condition):
        """The first frames for which something is so."""
        while True:
            found = await self.next()
            if condition(found):
                return found

    async def silence(self):
        """Hear what is still under way, until nothing comes any more."""
        for _ in range(40):
            try:
                await asyncio.wait_for(self.hear(), 2)
            except TimeoutError:
                return
        pytest.fail("it goes on and on")

    async def told(self, kind, condition=lambda said: True):
        """A message of that type, as it came or comes."""
        while not (kind in self.seen and condition(self.seen[kind])):
            await self.hear()
        return self.seen[kind]


def played(pool, out, story):
    """Run `story(page, client)` against a server of its own."""

    async def go():
        server = TestServer(serve.Server(pool, out, TOKEN).application())
        async with TestClient(server) as client:
            origin = f"http://{client.host}:{client.port}"
            async with client.ws_connect(f"/{TOKEN}/socket", origin=origin) as socket:
                await story(Page(socket), client)

    asyncio.run(go())


def dark(frame):
    """Where the pusher of the simulator is, `(x, y)` in pixels: it is all but black."""
    return middle(frame.max(-1) < 75)


def white(frame):
    """Where the disc of the model is."""
    return middle(frame.min(-1) > 250)


def middle(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) if len(rows) else np.array([np.nan, np.nan])


@pytest.mark.ci
def test_both_pictures_follow_the_same_actions(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=3)
        head, true, seen = await page.next()
        assert (head["n"], head["alone"]) == (1, 0)
        np.testing.assert_allclose(true.astype(int), seen, atol=1)  # from the same frame
        world = page.seen["world"]
        assert world["points"] == 1
        assert (world["index"], world["stride"], world["ood"]) == (3, 4, [])
        for target in ([0.3, 0.3], [0.7, 0.6]):
            await page.say("point", places=[target], seq=7)
            head, true, seen = await page.until(
                lambda found, at=target: (
                    found[0]["n"] == 4
                    and np.abs(white(found[2][-1]) / 64 - at).max() < 0.03
                    and np.abs(dark(found[1][-1]) / 64 - at).max() < 0.06
                )
            )
            assert head["seqs"][-1] == 7
        assert head["alone"] > 0
        await page.say("act", values=[-9.0, 0.0])  # out of bounds: clipped
        await page.until(lambda found: abs(white(found[2][-1])[0] / 64 - (0.5 - 0.388)) < 0.03)

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_the_model_takes_the_simulators_state_over(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=5)
        await page.say("point", places=[[0.2, 0.8]])
        await page.until(lambda found: found[0]["alone"] > 1)
        await page.say("take_over")
        head, true, seen = await page.until(lambda found: found[0]["n"] == 1)
        assert head["alone"] == 0
        np.testing.assert_allclose(true.astype(int), seen, atol=1)
        assert (await page.next())[0]["alone"] == pytest.approx(0.4)

    played(pool, tmp_path, story)


def test_scenes_come_again_and_factors_shift_them(pool, tmp_path):
    async def story(page, client):
        firsts = {}
        for name, wanted in {
            "one": {"index": 8},
            "again": {"index": 8},
            "more": {"index": 8, "factors": {"cube_count": 5}},
            "other": {},
        }.items():
            page.seen.clear()
            await page.say("open", **wanted)
            _, true, _ = await page.until(
                lambda found: found[0]["n"] == 1 and page.seen.get("world")
            )
            firsts[name] = true[0], page.seen["world"]
        np.testing.assert_array_equal(firsts["one"][0], firsts["again"][0])
        assert (firsts["one"][0] != firsts["more"][0]).any()
        assert firsts["more"][1]["ood"] == ["cube_count=5"]
        assert firsts["more"][1]["drawn"]["cube_count"] == 5
        assert (firsts["one"][0] != firsts["other"][0]).any()
        page.seen.clear()
        await page.say("open", index=8, factors={"mass": 1e9})
        said = await page.told("notice")
        assert said["wrong"]
        assert "factors.mass" in said["text"]
        await page.told("world", lambda world: world["asked"] == {})  # the last possible one
        await page.until(lambda found: found[0]["n"] == 4)

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_pausing_stepping_and_the_policy(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=2)
        await page.until(lambda found: found[0]["n"] == 4)
        await page.say("pause", on=True)
        await page.silence()
        assert page.seen["state"]["paused"]
        await page.say("step")
        head, *_ = await page.next()
        assert head["n"] == 4
        alone = head["alone"]
        await page.say("step")
        assert (await page.next())[0]["alone"] == pytest.approx(alone + 0.4)
        await page.say("drive", by="policy")
        await page.say("pause", on=False)
        places = [(await page.next())[0]["places"] for _ in range(12)]
        assert len({json.dumps(each) for each in places}) > 1  # it acts
        figures = await page.told("figures")
        assert set(figures["values"]) == {"position_error", "mask_iou"}
        assert figures["floors"]["position_error"] < 0.01

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_a_session_becomes_episodes_that_the_check_accepts(pool, tmp_path):
    async def story(page, client):
        await page.say("open", index=2)
        await page.until(lambda found: found[0]["n"] == 4)
        await page.say("drive", by="policy")
        await page.say("record", on=True)
        await page.until(lambda found: found[0]["recorded"] > 12)
        await page.say("record", on=False)
        said = await page.told("notice")
        assert "episode 0" in said["text"]
        page.seen.clear()
        await page.say("record", on=True)
        await page.until(lambda found: found[0]["recorded"] > 8)
        await page.say("open", index=4, factors={"cube_count": 5})  # ends an episode
        assert "episode 1" in (await page.told("notice"))["text"]
        await page.until(lambda found: found[0]["recorded"] > 4)
        await page.socket.close()  # a closed tab loses nothing

    played(pool, tmp_path, story)
    folder = tmp_path / "push_cube-64x64"
    assert [item.problem for item in check_dataset(folder)] == [None] * 5
    episodes = [*EpisodeDataset(folder, "train")]
    assert len(episodes) == 3
    assert [each.ood_label for each in episodes] == [None, None, "cube_count=5"]
    assert len(list(tmp_path.glob("push_cube-64x64-*.mp4"))) == 3
    first = episodes[0]
    place = 32 + 64 * 0.388 / 0.26 * first.states["pusher_position"][:, 0] * [[1, -1]]
    found = np.array([middle(mask == 2) for mask in first.masks])
    assert np.abs(found - place).max() < 4  # pictures and states belong together
    moved = np.linalg.norm(np.diff(first.states["pusher_position"][:, 0], axis=0), axis=-1)
    assert (moved < 0.1).all()  # without a gap
    assert np.abs(first.actions[:-1]).max() > 0


def test_strangers_are_refused(pool, tmp_path):
    async def story(page, client):
        origin = f"http://{client.host}:{client.port}"
        for path in ("/", "/socket", f"/{TOKEN[:-1]}/", f"/{TOKEN}x/play.js", "/%FF/"):
            assert (await client.get(path)).status in (403, 404), path
        assert (await client.get(f"/{TOKEN}/", headers={"Host": "evil.example"})).status == 403
        assert (await client.get(f"/{TOKEN}/secrets")).status == 404
        assert (await client.get(f"/{TOKEN}/../../pyproject.toml")).status in (403, 404)
        answer = await client.get(f"/{TOKEN}/")
        assert answer.status == 200
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert "unsafe" not in answer.headers["Content-Security-Policy"]
        for where, who in (
            (f"/{TOKEN}/socket", None),
            (f"/{TOKEN}/socket", "https://evil.example"),
            (f"/{TOKEN}/socket", "null"),
            ("/wrong/socket", origin),
        ):
            with pytest.raises(WSServerHandshakeError) as refused:
                await client.ws_connect(where, origin=who)
            assert refused.value.status == 403

    played(pool, tmp_path, story)


def test_tabs_are_bounded_and_nonsense_ends_one_alone(pool, tmp_path, monkeypatch):
    monkeypatch.setattr(serve, "MAX_SESSIONS", 2)

    async def story(page, client):
        origin, where = f"http://{client.host}:{client.port}", f"/{TOKEN}/socket"
        await page.say("open", index=1)
        await page.next()
        async with client.ws_connect(where, origin=origin) as second:
            async with client.ws_connect(where, origin=origin) as third:
                assert (await third.receive()).data == 1013
            await second.send_str("nonsense")
            closed = await second.receive()
            assert closed.data == 1008
        async with client.ws_connect(where, origin=origin) as large:
            with contextlib.suppress(ConnectionError):
                await large.send_str("x" * 100_000)
            assert (await large.receive()).type in (WSMsgType.CLOSE, WSMsgType.CLOSED)
        await page.until(lambda found: found[0]["alone"] > 1)  # the first one plays on

    played(pool, tmp_path, story)


@pytest.mark.ci
def test_a_simulator_that_is_killed_is_started_again(pool, tmp_path):
    async def story(page, client):
        import multiprocessing

        await page.say("open", index=1)
        await page.until(lambda found: found[0]["n"] == 4)
        (simulator,) = multiprocessing.active_children()
        simulator.kill()
        said = await page.told("notice")
        assert "has ended" in said["text"]
        await page.say("open", index=1)
        await page.until(lambda found: found[0]["alone"] > 1)

    played(pool, tmp_path, story)
