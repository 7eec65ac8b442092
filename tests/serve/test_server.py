"""The server with the client that users copy, and with clients that do everything wrong."""

import socket as sockets
import threading
import time
import urllib.request

import msgpack
import numpy as np
import pytest
from click.testing import CliRunner
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from acwm_core.cli.main import main
from tests.serve.conftest import TOKEN
from tests.serve.test_engine import actions, picture, rolled_out

HEADERS = {"Authorization": f"Bearer {TOKEN}"}
SIZE = (32, 32)


def metrics(server):
    request = urllib.request.Request(f"http://{server.host}:{server.port}/metrics", headers=HEADERS)
    with urllib.request.urlopen(request) as answer:
        text = answer.read().decode()
    samples = [s for family in text_string_to_metric_families(text) for s in family.samples]
    return {sample.name: sample.value for sample in samples if not sample.labels}


def until(condition):
    """Wait until something is so."""
    for _ in range(200):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail("it never was so")


def map_of(array, **changes):
    facts = {"data": array.tobytes(), "dtype": array.dtype.str, "shape": list(array.shape)}
    return {"__ndarray__": True, **facts, **changes}


def test_frames_of_many_clients_are_those_of_a_rollout(served, carrying, client_class):
    """Eight at once, in threads; each asks for several latent frames in one message, too."""
    server, shown = served(carrying), {}

    def drive(seed):
        with client_class(server.address, TOKEN) as client:
            assert client.facts["frame_size"] == [*SIZE]
            rows = actions(6 * client.facts["stride"], seed)
            client.start(picture(seed, SIZE), seed=seed)
            first = [client.step(part)["frames"] for part in np.split(rows[: len(rows) // 2], 3)]
            shown[seed] = np.concatenate([*first, client.step(rows[len(rows) // 2 :])["frames"]])

    threads = [threading.Thread(target=drive, args=(seed,)) for seed in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    for seed in range(8):
        rows = actions(len(shown[seed]), seed)
        wanted = rolled_out(carrying, picture(seed, SIZE), rows, seed)
        assert np.abs(shown[seed] - wanted).max() <= 0.501
    counts = metrics(server)
    frames = sum(len(video) for video in shown.values())
    assert counts["acwm_frames_total"] == frames + 8
    assert counts["acwm_batch_size_count"] < frames / server.engine.stride + 8  # some together
    until(lambda: metrics(server)["acwm_sessions"] == 0)


def test_a_start_begins_a_new_video(served, exact, client_class):
    server, rows = served(exact), actions(4)
    with client_class(server.address, TOKEN) as client:
        first = []
        for _ in range(2):
            client.start(picture(1, SIZE))
            first.append(client.step(rows)["frames"])
    assert np.array_equal(*first)


WRONG = {
    "actions first": ({"actions": np.zeros((4, 2))}, "send `frames` to start"),
    "no map": ([1, 2], "a message is a map in msgpack, not a list"),
    "half a message": (msgpack.packb({"frames": b"x" * 100})[:50], "not 50 other bytes"),
    "text": ("hello", "a message is a map in msgpack, not text"),
    "wrong size": ({"frames": np.zeros((16, 16, 3), np.uint8)}, "not uint8 [16, 16, 3]"),
    "wrong type": ({"frames": np.zeros((32, 32, 3))}, "not float64 [32, 32, 3]"),
    "no array": ({"frames": "a.png"}, "not str"),
    "short array": ({"frames": map_of(np.zeros(3), shape=[9])}, "does not have 24 bytes"),
    "objects": ({"frames": map_of(np.zeros(3), dtype="|O")}, "an array is bytes `data`"),
    "negative": ({"frames": map_of(np.zeros(3), shape=[-3])}, "an array is bytes `data`"),
    "seed": ({"frames": picture(0, SIZE), "seed": -1}, "seed is a whole number"),
    "want": ({"frames": picture(0, SIZE), "want": ["sound"]}, "this server gives"),
    "goal": ({"frames": picture(0, SIZE), "goal": picture(1, SIZE)}, "want distance"),
    "key": ({"frames": picture(0, SIZE), "sed": 1}, "did you mean 'seed'?"),
}

WRONG_ACTIONS = {
    "NaN": (np.full((4, 2), np.nan), "finite"),
    "infinite": (np.full((4, 2), np.inf), "finite"),
    "out of bounds": (np.full((4, 2), 100.0), "2"),
    "too few": (np.zeros((3, 2)), "N from 4 to 256 in steps of 4, not float64 [3, 2]"),
    "none": (np.zeros((0, 2)), "not float64 [0, 2]"),
    "too many": (np.zeros((1000, 2)), "not float64 [1000, 2]"),
    "wrong width": (np.zeros((4, 3)), "actions are numbers [4, 2], not float64 [4, 3]"),
    "a list": ([[0.0, 0.0]], "not list"),
}


def raw(value):
    """What goes through the socket."""
    if isinstance(value, (str, bytes)):
        return value
    return msgpack.packb(value, default=map_of)


def test_wrong_messages_get_a_sentence_and_change_nothing(served, exact, client_class):
    server, rows = served(exact), actions(8).astype(float)
    with client_class(server.address, TOKEN) as client:
        for name, (message, said) in WRONG.items():
            client.socket.send(raw(message))
            answer = client.socket.recv()
            assert isinstance(answer, str), name
            assert said in answer, (name, answer)
        client.start(picture(1, SIZE))
        shown = [client.step(rows[:4])["frames"]]
        for name, (wrong, said) in WRONG_ACTIONS.items():
            client.socket.send(raw({"actions": wrong}))
            answer = client.socket.recv()
            assert isinstance(answer, str), name
            assert said in answer, (name, answer)
        with pytest.raises(RuntimeError, match="finite"):
            client.step(np.full((4, 2), np.nan))
        shown.append(client.step(rows[4:])["frames"])
    wanted = rolled_out(exact, picture(1, SIZE), rows.astype(np.float32), 0)
    assert np.abs(np.concatenate(shown) - wanted).max() <= 0.501
    assert metrics(server)["acwm_refused_total"] == len(WRONG) + len(WRONG_ACTIONS) + 1


def test_a_message_that_is_too_long_ends_its_session_alone(served, exact, client_class):
    server = served(exact)
    with client_class(server.address, TOKEN) as good, client_class(server.address, TOKEN) as bad:
        bad.socket.send(b"x" * 1_000_000)
        with pytest.raises(ConnectionClosed, match="1009"):
            bad.socket.recv()
        good.start(picture(0, SIZE))


@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer " + "u" * 43}])
def test_a_wrong_token_is_refused(served, exact, headers):
    server = served(exact)
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(server.address, additional_headers=headers),
    ):
        pass
    assert refused.value.response.status_code == 401
    assert b"send the token that `acwm serve` printed" in refused.value.response.body


def test_sessions_are_limited_and_clients_that_die_make_room(served, exact, client_class):
    server = served(exact, sessions=2)
    first = client_class(server.address, TOKEN).__enter__()
    with client_class(server.address, TOKEN) as second:
        with pytest.raises(InvalidStatus) as refused, client_class(server.address, TOKEN):
            pass
        assert refused.value.response.status_code == 503
        assert b"2 sessions are open already" in refused.value.response.body
        # As a killed process: half a frame, and the end of the connection.
        first.socket.socket.sendall(b"\x82\xfe")
        first.socket.socket.shutdown(sockets.SHUT_RDWR)
        until(lambda: metrics(server)["acwm_sessions"] == 1)
        second.start(picture(0, SIZE))
        with client_class(server.address, TOKEN) as third:
            third.start(picture(0, SIZE))


def slowly(server, monkeypatch):
    """Let the model wait for an event; returns it, and one that is set once it waits."""
    go, waits, step = threading.Event(), threading.Event(), server.engine.step

    def wait(steps):
        waits.set()
        assert go.wait(30)
        return step(steps)

    monkeypatch.setattr(server.engine, "step", wait)
    return go, waits


def asking(client, rows, said):
    """Ask in a thread; what comes is added to `said`."""

    def ask():
        try:
            said.append(client.step(rows)["frames"])
        except RuntimeError as error:
            said.append(str(error))

    thread = threading.Thread(target=ask)
    thread.start()
    return thread


@pytest.mark.parametrize(
    ("limits", "sentence"),
    [({"queue": 1, "batch": 1}, "1 requests wait already"), ({"timeout": 0.1}, "waited for 0.1 s")],
    ids=["full", "slow"],
)
def test_a_full_queue_and_a_slow_model_are_told(
    served, exact, client_class, monkeypatch, limits, sentence
):
    """The video of the client that is refused has not moved, and the others get their frames."""
    server, rows, said = served(exact, **limits), actions(4), []
    clients = [client_class(server.address, TOKEN).__enter__() for _ in range(3)]
    for client in clients:
        client.start(picture(2, SIZE))
    go, waits = slowly(server, monkeypatch)
    threads = [asking(clients[0], rows, said)]
    assert waits.wait(10)
    if "queue" in limits:
        threads.append(asking(clients[1], rows, said))
        until(lambda: metrics(server)["acwm_waiting_requests"] == 1)
    with pytest.raises(RuntimeError, match=sentence):
        clients[2].step(rows)
    go.set()
    for thread in threads:
        thread.join(30)
    wanted = rolled_out(exact, picture(2, SIZE), rows, 0)
    for frames in [*said, clients[2].step(rows)["frames"]]:
        assert np.abs(frames - wanted).max() <= 0.501
    for client in clients:
        client.socket.close()


def test_pings_are_answered_while_the_model_computes(served, exact, client_class, monkeypatch):
    """Else a client would take a server that is busy for one that is gone."""
    server, said = served(exact), []
    with client_class(server.address, TOKEN) as client:
        client.start(picture(2, SIZE))
        go, waits = slowly(server, monkeypatch)
        thread = asking(client, actions(4), said)
        assert waits.wait(10)
        assert client.socket.ping().wait(10)
        go.set()
        thread.join(30)
    assert len(said) == 1


def test_an_idle_session_ends(served, exact, client_class):
    server = served(exact, idle=0.2)
    refused = pytest.raises(ConnectionClosed, match=r"no message for 0\.2 s")
    with client_class(server.address, TOKEN) as client, refused:
        client.socket.recv(timeout=10)


def test_the_health_needs_no_token_and_metrics_do(served, exact):
    server = served(exact)
    with urllib.request.urlopen(f"http://{server.host}:{server.port}/health") as answer:
        assert b'"status": "ok"' in answer.read()
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(f"http://{server.host}:{server.port}/metrics")
    assert metrics(server)["process_resident_memory_bytes"] > 0


def test_a_port_that_is_taken_and_a_short_token_are_told(exact):
    with sockets.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        told = CliRunner().invoke(main, ["serve", str(exact), "--port", str(port)])
        assert "give another --host or --port" in told.output
    told = CliRunner().invoke(main, ["serve", str(exact), "--token", "secret"])
    assert "at least 16 plain characters" in told.output


def test_a_client_receives_plans_beside_frames(served, exact, carrying, client_class):
    frame, goal = picture(0, SIZE), picture(1, SIZE)
    with client_class(served(exact, task="place").address, TOKEN) as client:
        assert client.facts["plans"]
        planned = client.plan(frame[None], goal, seed=1)["actions"]
        assert planned.shape[1] == 2
        assert np.abs(planned).max() <= 2
        assert client.start(frame)["frames"].shape == (1, *SIZE, 3)
    with client_class(served(carrying).address, TOKEN) as client:
        assert not client.facts["plans"]
        with pytest.raises(RuntimeError, match="--task"):
            client.plan(frame[None], goal)
