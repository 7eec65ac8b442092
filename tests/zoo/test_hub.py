"""Runs are published on a hub and fetched from it; the hub is a server of the test's own."""

import base64
import functools
import hashlib
import http.server
import json
import os
import sys
import threading

import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import TrainingError
from acwm_core.training.run import load_run
from tests.zoo.test_packing import KEPT, files

hub = pytest.importorskip("acwm_zoo.hub")

SHA = 40 * "a"


class Hub(http.server.BaseHTTPRequestHandler):
    """One repository, org/name, whose files are `content`; commits go there."""

    content: dict[str, bytes]
    asked: list[str]

    def log_message(self, *_):
        pass

    def reply(self, body=b"", status=200, **headers):
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def tell(self, facts):
        self.reply(json.dumps(facts).encode())

    def handle_any(self):
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        path, here = self.path.split("?")[0], f"http://{self.headers['Host']}/org/name"
        self.asked.append(f"{self.command} {path}")
        files = self.content
        if path == "/api/repos/create":
            return self.tell({"url": here})
        if path == "/api/validate-yaml":
            assert body
            return self.tell({"errors": [], "warnings": []})
        if path == "/api/models/org/name/preupload/main":
            named = [each["path"] for each in json.loads(body)["files"]]
            about = {"uploadMode": "regular", "shouldIgnore": False}
            return self.tell({"files": [{"path": name, **about} for name in named]})
        if path == "/api/models/org/name/commit/main":
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            return self.tell({"commitUrl": f"{here}/commit/{SHA}", "commitOid": SHA})
        if path == "/api/models/org/name/revision/main":
            listed = [{"rfilename": name} for name in files]
            return self.tell({"id": "org/name", "sha": SHA, "siblings": listed})
        if path == f"/api/models/org/name/tree/{SHA}":
            return self.tell(
                [
                    {"type": "file", "path": name, "size": len(data), "oid": sha1(data)}
                    for name, data in files.items()
                ]
            )
        name = path.removeprefix(f"/org/name/resolve/{SHA}/")
        if name in files:
            return self.reply(files[name], ETag=f'"{sha1(files[name])}"', X_Repo_Commit=SHA)
        return self.reply(status=404)

    do_GET = do_POST = do_HEAD = handle_any


def sha1(data):
    return hashlib.sha1(data).hexdigest()


@pytest.fixture
def server(tmp_path, monkeypatch):
    """The hub is a server of this process, and nothing is kept outside of `tmp_path`."""
    from huggingface_hub import constants

    handler = type("OneHub", (Hub,), {"content": {}, "asked": []})
    running = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{running.server_port}"
    api = functools.partial(hub.HfApi, endpoint=address, token="secret")
    monkeypatch.setattr(hub, "HfApi", api)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    yield handler
    running.shutdown()
    running.server_close()


def invoke(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def test_a_run_is_published_and_fetched_by_its_address(server, run, data, tmp_path):
    done = invoke("push", run, "hf://org/name", "evaluation.episodes=2", "--data", data)
    assert done.exit_code == 0, done.output
    assert done.output.strip().endswith("/org/name")
    assert set(server.content) == KEPT
    assert b"acwm rollout hf://org/name" in server.content["README.md"]
    server.content |= {"setup.py": b"raise SystemExit", "model.pkl": b"x", "sub/recipe.yaml": b"x"}
    done = invoke("rollout", "hf://org/name", "--data", data)
    assert done.exit_code == 0, done.output
    assert done.stdout.strip() == "runs/trained/org--name/rollout.mp4"
    assert files(tmp_path / "runs/trained/org--name") == {*KEPT, "rollout.mp4"}
    assert not [asked for asked in server.asked if "setup.py" in asked or "model.pkl" in asked]
    ours, theirs = (load_run(each).world_model.state_dict() for each in ("hf://org/name", run))
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=1e-2, atol=1e-2)


def test_what_is_not_there_is_one_sentence(server, run):
    done = invoke("rollout", "hf://org/other")
    assert done.exit_code == 2
    assert done.output.startswith("acwm: hf://org/other is not available (")
    assert done.output.count("\n") == 1
    server.content["README.md"] = b"of something else"
    with pytest.raises(TrainingError, match="hf://org/name holds no trained run: it has no recipe"):
        load_run("hf://org/name")
    with pytest.raises(TrainingError, match="names no run: write hf://ORG/NAME"):
        load_run("hf://name")
    for wrong in ("org/name", "hf://name", "s3://org/name", "hf://org/name@v2"):
        done = invoke("push", run, wrong)
        assert done.exit_code == 2
        assert f"acwm: {wrong} is not a place to publish to: write hf://ORG/NAME" in done.output


def test_a_wrong_address_costs_no_evaluation(server, run, monkeypatch):
    monkeypatch.setattr("acwm_zoo.packing.pack", None)
    done = invoke("push", run, "hf://org/na me")
    assert done.exit_code == 2
    assert "hf://org/na me is not available (Repo id" in done.output


@pytest.fixture
def cached(server, run, data, tmp_path):
    """The folder in the cache of a run that was published, as the library left it."""
    invoke("push", run, "hf://org/name", "evaluation.episodes=2", "--data", data)
    hub.HfApi().snapshot_download("org/name")
    (recipe,) = (tmp_path / "cache").rglob("recipe.yaml")
    assert recipe.is_symlink()
    return recipe.parent


def test_a_cache_that_is_read_only(cached, monkeypatch):
    before = {file: file.is_symlink() for file in cached.rglob("*")}
    monkeypatch.setattr(os, "access", lambda *_: False)
    fetched = hub.fetch("org/name")
    assert files(fetched) == KEPT
    assert not any(file.is_symlink() for file in fetched.rglob("*"))
    assert {file: file.is_symlink() for file in cached.rglob("*")} == before


def test_a_cache_that_cannot_be_made_is_one_sentence(server, tmp_path, monkeypatch):
    from huggingface_hub import constants

    (tmp_path / "file").touch()
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "file" / "cache"))
    server.content["recipe.yaml"] = b""
    with pytest.raises(TrainingError, match="set HF_HOME to another folder"):
        hub.fetch("org/name")


def test_a_fetch_that_is_stopped_leaves_no_half_a_file(cached, monkeypatch):
    def stop(source, target):
        target.write_bytes(source.read_bytes()[:10])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shutil.copyfile", stop)
        with pytest.raises(KeyboardInterrupt):
            hub.fetch("org/name")
    load_run("hf://org/name")
    assert not [file for file in cached.rglob("*") if file.is_symlink() or "partial" in file.name]


@pytest.mark.parametrize("target", ["/etc/passwd", "/"])
def test_links_that_lead_out_of_the_cache_are_not_followed(cached, target):
    link = cached / "recipe.yaml"
    link.unlink()
    link.symlink_to(target)
    done = invoke("rollout", "hf://org/name")
    assert done.exit_code == 2
    said = done.output.splitlines()[-1]  # below the bars of the download
    assert said.startswith(f"acwm: {link} leads out of ")
    assert link.is_symlink()


@pytest.mark.parametrize(
    "answer", [b"<html>", b"[]", b"{}", b"[" * 100_000, b'{"sha": "../..", "siblings": [7]}']
)
def test_strange_answers_are_one_sentence(server, monkeypatch, answer):
    monkeypatch.setattr(server, "do_GET", lambda self: self.reply(answer))
    done = invoke("rollout", "hf://org/name")
    assert done.exit_code == 2
    assert done.output.startswith("acwm: hf://org/name is not available (")
    assert done.output.count("\n") == 1


@pytest.mark.parametrize("name", ["codec-/../../../../../evil.safetensors", "codec-\n.safetensors"])
def test_strange_names_are_one_sentence(server, tmp_path, name):
    server.content |= {"recipe.yaml": b"", name: b"x"}
    done = invoke("rollout", "hf://org/name")
    assert done.exit_code == 2
    assert "Traceback" not in done.output
    assert not [*tmp_path.parent.rglob("evil.safetensors")]


def test_the_message_names_the_extra(run, monkeypatch):
    monkeypatch.delitem(sys.modules, "acwm_zoo.hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for command in (["rollout", "hf://org/name"], ["push", run, "hf://org/name"]):
        done = invoke(*command)
        assert done.exit_code == 2
        needed = "trained model 'hf' needs 'huggingface_hub': pip install"
        assert needed in done.output
        assert "[hub]'" in done.output
