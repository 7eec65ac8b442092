"""The parts of `acwm play` that need neither a simulator nor a browser."""

import asyncio
import json
import socket
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import DataError, RecipeError, TrainingError
from acwm_play import address, clock, messages
from acwm_play.figures import pixel_error
from acwm_play.layout import controls
from acwm_play.messages import Outbox, parse
from acwm_play.worlds import playable


def test_messages_of_the_page_are_read():
    assert parse('{"type": "act", "values": [1, 0.5], "seq": 3}') == messages.Act([1, 0.5], 3)
    opened = parse('{"type": "open", "index": 4, "factors": {"friction": 1.0, "light": "noon"}}')
    assert opened == messages.Open(None, 4, {"friction": 1.0, "light": "noon"})
    assert parse('{"type": "take_over"}') == messages.TakeOver()


@pytest.mark.parametrize(
    "text",
    [
        *("", "{}", "[]", "7", '{"type": "launch"}', '{"type": ["act"]}'),
        '{"type": "act", "values": ["1"]}',
        '{"type": "act", "values": [NaN]}',
        '{"type": "act"}',
        '{"type": "pause", "on": "yes"}',
        '{"type": "open", "factors": {"friction": [1]}}',
    ],
)
def test_what_is_no_message_is_refused(text):
    with pytest.raises(DataError, match="an invalid message"):
        parse(text)


def test_a_slow_page_costs_bounded_memory_and_sees_the_present():
    box = Outbox()
    for number in range(10):
        box.put("figures", number=number)
        box.put_frames(bytes([number]))
    assert json.loads(box.take()) == {"type": "figures", "number": 9}
    assert [box.take() for _ in range(4)] == [b"\x07", b"\x08", b"\x09", None]
    assert box.dropped == 7


def test_texts_keep_their_order():
    box = Outbox()
    for kind in ("goal", "world", "goal"):
        box.put(kind)
    assert [json.loads(box.take())["type"] for _ in range(2)] == ["world", "goal"]


def test_frames_are_packed_as_the_page_reads_them():
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, 256, (2, 3, 16, 24, 3), np.uint8)
    packed = messages.pack({"seqs": [1, 2, 3]}, one, other)
    (length,) = struct.unpack_from("<I", packed)
    assert json.loads(packed[4 : 4 + length]) == {"n": 3, "size": [16, 24], "seqs": [1, 2, 3]}
    assert packed[4 + length :] == one.tobytes() + other.tobytes()


def test_the_pixel_error_is_a_share_of_full_scale():
    black, grey = np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 51, np.uint8)
    assert pixel_error(black, grey) == pytest.approx(0.2)
    assert pixel_error(grey, grey) == 0


def test_a_paused_clock_makes_nobody_wait():
    async def ticks():
        made = clock.Clock(0.001)
        made.paused = True
        await asyncio.wait_for(made.tick(), 500)  # a tick takes 1000 seconds

    asyncio.run(ticks())


@pytest.mark.parametrize(
    ("speed", "late", "times"),
    [
        (1.0, 0.0, [0.01, 0.02, 0.03, 0.04]),
        (0.25, 0.0, [0.04, 0.08, 0.12, 0.16]),
        (1.0, 0.005, [0.01, 0.02, 0.03, 0.04]),  # work between ticks, in time
        (1.0, 0.015, [0.015, 0.03, 0.045, 0.06]),  # and too late; nothing is made up for
    ],
)
def test_a_clock_ticks_no_faster_than_it_should(speed, late, times, monkeypatch):
    now = 100.0

    async def sleep(seconds):
        nonlocal now
        assert seconds >= 0
        now += seconds

    async def ticks():
        nonlocal now
        made, found = clock.Clock(100), []
        made.speed = speed
        for _ in range(4):
            now += late
            await made.tick()
            found.append(now - 100)
        return found

    monkeypatch.setattr(clock, "time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(clock, "asyncio", SimpleNamespace(sleep=sleep))
    assert asyncio.run(ticks()) == pytest.approx(times)


def test_the_token_is_kept_for_the_user_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("ACWM_CACHE", str(tmp_path / "cache"))
    token = address.token()
    file = tmp_path / "cache" / "play-token"
    assert len(token) >= 40
    assert address.token() == token
    assert file.stat().st_mode & 0o777 == 0o600
    file.chmod(0o644)  # somebody may have read it
    fresh = address.token()
    assert fresh != token
    assert file.stat().st_mode & 0o777 == 0o600
    file.write_text("short")
    assert len(address.token()) >= 40


def test_no_file_for_the_token_means_a_fresh_one(tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file where the folder should be")
    monkeypatch.setenv("ACWM_CACHE", str(tmp_path / "cache"))
    assert address.token() != address.token()


def test_a_port_that_is_taken_is_refused_and_the_usual_one_replaced(monkeypatch):
    with socket.socket() as taken:
        taken.bind((address.HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(RecipeError, match=f"port {port} is taken"):
            address.open_socket(port)
        monkeypatch.setattr(address, "PORT", port)
        with address.open_socket(None) as free:
            assert free.getsockname()[1] not in (port, 0)
            assert free.getsockname()[0] == "127.0.0.1"


def test_without_a_model_one_sentence_says_what_to_do(monkeypatch):
    monkeypatch.setattr("acwm_play.worlds.trained_models", list)
    with pytest.raises(TrainingError, match="no trained model is installed: train one"):
        playable([])
    with pytest.raises(TrainingError, match="no trained model of reacher is installed"):
        playable([], environment="reacher")


def test_trained_models_make_the_menu_and_the_world_asked_for_comes_first(run, monkeypatch):
    from tests.play import follower

    two = follower.make_run(run.parent / "two", "push_cube_two_pushers")
    monkeypatch.setattr("acwm_play.worlds.trained_models", lambda: ["one", "two"])
    monkeypatch.setattr("acwm_play.worlds.find_run", {"one": run, "two": two}.get)
    assert [world.name for world in playable([])] == ["one", "two"]
    found = playable([], environment="push_cube_two_pushers", frame_size=32)
    assert [(each.name, each.environment, each.size) for each in found] == [
        ("two", "push_cube_two_pushers", (32, 32)),
        ("one", "push_cube", (32, 32)),
    ]
    names = [world.name for world in playable([run, run])]
    assert names == ["follower", str(run), "one", "two"]


def test_bad_words_end_with_one_sentence(run, tmp_path):
    def said(*words):
        result = CliRunner().invoke(main, ["play", *map(str, words)])
        assert result.exit_code == 2
        assert "Traceback" not in result.output
        return result.output

    assert "there is no run folder" in said(tmp_path / "nothing")
    assert "push_cubes" in said(run, "--env", "push_cubes")
    assert "--size" in said(run, "--size", "big")
    assert "--port" in said(run, "--port", "0")


def card_of(name):
    return pytest.importorskip("acwm_core.plugins").catalog().component("environment", name)


def test_arrows_move_things_the_way_that_they_point():
    pytest.importorskip("taichi")
    from acwm_play.layout import physics_of

    def arrows(name):
        found = controls(card_of(name).load().card, physics_of(name))
        return {each["name"]: (each["place"], each["sign"]) for each in found if each["place"] < 2}

    assert arrows("pour_water") == {"delta_x": (0, 1), "delta_z": (1, 1)}
    assert arrows("push_rope") == {"delta_x": (0, 1), "delta_z": (1, 1)}
    pytest.importorskip("mujoco")
    assert arrows("reacher") == {"shoulder_torque": (0, 1), "elbow_torque": (1, 1)}


def test_torques_spring_back_and_settings_stay():
    pytest.importorskip("pybullet")
    card = card_of("stack_cube").load().card
    holds = {each["name"]: each["holds"] for each in controls(card, None)}
    assert holds == {name: name == "gripper" for name in card.action.names}
    keys = [each["keys"] for each in controls(card, None)]
    assert len({key for pair in keys for key in pair}) == 2 * card.action.size
