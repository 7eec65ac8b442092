import asyncio
import importlib.util
import threading
from pathlib import Path

import pytest
import torch

from acwm_core.data.generate import generate
from tests import tiny
from tests.dream import recurrent

for needed in ("msgpack", "prometheus_client", "websockets"):
    pytest.importorskip(needed, reason="needs the extra serve")

TOKEN = "t" * 43


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """Episodes of the sliding square; tests must not change them."""
    torch.set_num_threads(1)
    tiny.register()
    folder = tmp_path_factory.mktemp("serve") / "data"
    generate("slide", folder, episodes={"train": 2}, workers=0, progress=False)
    return folder


@pytest.fixture(scope="session")
def exact(data, tmp_path_factory):
    """A run whose model knows its world."""
    return tiny.make_exact_run(tmp_path_factory.mktemp("exact") / "run", path=str(data))


@pytest.fixture(scope="session")
def carrying(data, tmp_path_factory):
    """A run whose model carries a state."""
    return recurrent.make_run(tmp_path_factory.mktemp("carrying") / "run", data)


@pytest.fixture(scope="session")
def caching(data, tmp_path_factory):
    """A run of a transformer, which draws noise and caches the keys of earlier frames."""
    parts = {
        "env": {"name": "slide"},
        "codec": {"name": "identity"},
        "model": {"name": "dit_xs", "causal": True, "width": 16, "layers": 2},
        "conditioner": {"name": "adaln"},
        "objective": {"name": "diffusion_forcing", "steps": 2},
        "data": {"path": str(data), "clip_frames": 13},
    }
    return tiny.make_run(tmp_path_factory.mktemp("caching") / "run", data, parts=parts)


@pytest.fixture(scope="session")
def client_class():
    """The client that users copy."""
    path = Path(__file__).parents[2] / "examples" / "serve_client.py"
    spec = importlib.util.spec_from_file_location("serve_client", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Client


class Running:
    """A server in a thread of its own, with its engine."""

    def __init__(self, engine, **limits):
        from aiohttp.test_utils import TestServer

        from acwm_serve.server import Limits, Server

        self.engine, self.loop = engine, asyncio.new_event_loop()
        self.server = Server(engine, TOKEN, Limits(**limits))
        self._http = TestServer(self.server.application())
        self._thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self._thread.start()
        self._do(self._http.start_server())
        self.host, self.port = self._http.host, self._http.port
        self.address = f"ws://{self.host}:{self.port}"

    def _do(self, work):
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(30)

    def close(self):
        self._do(self._http.close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(10)
        self.loop.close()


@pytest.fixture
def served():
    """``served(run, …)``: a server that is closed in the end; `task` and limits are options."""
    from acwm_serve.engine import Engine

    opened = []

    def start(run, task=None, **limits):
        opened.append(Running(Engine(run, task=task, device="cpu"), **limits))
        return opened[-1]

    yield start
    for each in opened:
        each.close()
